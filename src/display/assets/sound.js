// Sound: the scores of predictions with their counts, and a spectrogram with the predicted unstable frequencies over it.

import { next } from "./clock.js";
import { NONE, colour, fixed, known, time } from "./format.js";

const at = (id) => document.getElementById(id);
/** Interval between pictures of a running node, ms. */
const EVERY = 2000;
/** Finer columns and rows are requested once the view rests, ms; of more than the view, so that it can be moved: by this share
 * of its length and height on every side; and again if it is this many times shorter. */
const RESTS = 150;
const BESIDE = 0.5;
const FINER = 2;
/** A prediction is drawn up to the next one if that follows within this time, s. */
const HOLDS_S = 2;
/** Room for the labels of the axes, px. */
const LEFT = 52;
const BELOW = 22;

export class Sound {
  constructor(about, history, go) {
    this.live = about.kind === "live";
    this.history = history;
    this.go = go;
    this.picture = null;
    this.covers = null;
    this.part = null;
    this.refining = false;
    this.squeals = [];
    this.view = null;
    this.asked = -Infinity;
    this.busy = false;
    this.loads = 0;
    this.moment = null;
    this.canvas = at("spectrogram");
    at("sound-channel").addEventListener("change", () => this.#load());
    at("sound-in").addEventListener("click", () => this.#zoom(0.5));
    at("sound-out").addEventListener("click", () => this.#zoom(2));
    at("sound-all").addEventListener("click", () => this.#all());
    this.canvas.addEventListener("wheel", (event) => {
      if (!this.view) return;
      event.preventDefault();
      this.#zoom(event.deltaY > 0 ? 1.25 : 0.8, this.#place(event), event.shiftKey);
    }, { passive: false });
    this.canvas.addEventListener("pointerdown", (event) => this.#drag(event));
    this.canvas.addEventListener("keydown", (event) => this.#key(event));
    // For tests.
    this.canvas.position = (seconds, hz) => this.position(seconds, hz);
    this.canvas.view = () => this.picture && this.view;
    this.canvas.painted = () => this.painted;
    this.canvas.refined = () => !this.refining && !this.#unrefined() && (this.part?.covers ?? true);
    new ResizeObserver(() => this.draw()).observe(this.canvas.parentElement);
  }

  /** Asks for scores and picture if it is time; `squeals` are those of the table of events. */
  async refresh(ask) {
    if (this.busy || document.hidden || performance.now() - this.asked < EVERY) return;
    this.busy = true;
    this.asked = performance.now();
    try {
      await this.show(await ask("sound.json"));
    } catch {
      // The connection is lost: the next state asks again.
    } finally {
      this.busy = false;
    }
  }

  async show({ channels, scores }) {
    const panel = at("sound");
    panel.hidden = channels.length + scores.length === 0;
    if (panel.hidden) return;
    const choice = at("sound-channel");
    if ([...choice.options].map((option) => option.value).join("\n") !== channels.join("\n")) {
      const before = choice.value;
      choice.replaceChildren(...channels.map((name) => new Option(name, name)));
      if (channels.includes(before)) choice.value = before;
    }
    at("sound-scores").replaceChildren(...scores.map(score));
    await this.#load();
  }

  async #load() {
    const name = at("sound-channel").value;
    if (!name) return;
    const order = ++this.loads;
    const found = await spectrogram({ channel: name });
    // If two requests overlap, the later one counts.
    if (!found || order !== this.loads) return;
    const { picture, covers } = found;
    this.picture = picture;
    this.part = null;
    this.shown = name;
    const follows = !this.view || !this.covers || this.view.to >= this.covers.to_s;
    const whole = !this.view || (this.covers && this.view.from <= this.covers.from_s && follows);
    this.covers = covers;
    if (whole) this.view = this.#whole();
    // At the end of the time shown, new sound moves it on.
    else if (this.live && follows) this.view = { ...this.view, from: covers.to_s - (this.view.to - this.view.from), to: covers.to_s };
    this.draw();
  }

  #whole() {
    const { from_s: from, to_s: to, bottom_hz: low, top_hz: high } = this.covers;
    return { from, to, low: Math.max(0, low), high };
  }

  #all() {
    if (!this.covers) return;
    this.view = this.#whole();
    this.draw();
  }

  /** Time and frequency below a pointer, as shares of the view. */
  #place(event) {
    const box = this.canvas.getBoundingClientRect();
    const share = (value, from, length) => Math.min(1, Math.max(0, (value - from) / length));
    return [share(event.clientX, box.left + LEFT, box.width - LEFT), 1 - share(event.clientY, box.top, box.height - BELOW)];
  }

  /** Makes the view `factor` times as long, or as high, about a place. */
  #zoom(factor, [x, y] = [0.5, 0.5], frequency = false) {
    if (!this.view) return;
    const { from, to, low, high } = this.view;
    const about = (a, b, share, least) => {
      const length = Math.max(least, (b - a) * factor);
      const middle = a + share * (b - a);
      return [middle - share * length, middle + (1 - share) * length];
    };
    if (frequency) [this.view.low, this.view.high] = about(low, high, y, 100);
    else [this.view.from, this.view.to] = about(from, to, x, 0.2);
    this.#hold();
    this.draw();
  }

  /** Keeps the view inside what there is. */
  #hold() {
    const inside = (a, b, first, last) => {
      const length = Math.min(b - a, last - first);
      const start = Math.min(Math.max(a, first), last - length);
      return [start, start + length];
    };
    const { from: first, to: last, low: bottom, high: top } = this.#whole();
    [this.view.from, this.view.to] = inside(this.view.from, this.view.to, first, last);
    [this.view.low, this.view.high] = inside(this.view.low, this.view.high, bottom, top);
  }

  #move(seconds, hz) {
    const { from, to, low, high } = this.view;
    this.view = { from: from + seconds, to: to + seconds, low: low + hz, high: high + hz };
    this.#hold();
    this.draw();
  }

  #drag(event) {
    if (!this.view) return;
    const [x, y] = [event.clientX, event.clientY];
    const began = { ...this.view };
    const box = this.canvas.getBoundingClientRect();
    let moved = false;
    const move = (now) => {
      moved ||= Math.hypot(now.clientX - x, now.clientY - y) > 4;
      const seconds = ((x - now.clientX) / (box.width - LEFT)) * (began.to - began.from);
      const hz = ((now.clientY - y) / (box.height - BELOW)) * (began.high - began.low);
      this.view = { ...began };
      this.#move(seconds, hz);
    };
    const end = (now) => {
      this.canvas.removeEventListener("pointermove", move);
      // A click leads the time line to that moment.
      if (!moved && this.go) this.go(this.view.from + this.#place(now)[0] * (this.view.to - this.view.from));
    };
    this.canvas.setPointerCapture(event.pointerId);
    this.canvas.addEventListener("pointermove", move);
    this.canvas.addEventListener("pointerup", end, { once: true });
  }

  #key(event) {
    if (!this.view) return;
    const [length, height] = [this.view.to - this.view.from, this.view.high - this.view.low];
    const actions = {
      "+": () => this.#zoom(0.5), "-": () => this.#zoom(2), 0: () => this.#all(),
      ArrowLeft: () => this.#move(-0.1 * length, 0), ArrowRight: () => this.#move(0.1 * length, 0),
      ArrowUp: () => this.#move(0, 0.1 * height), ArrowDown: () => this.#move(0, -0.1 * height),
    };
    if (!actions[event.key]) return;
    event.preventDefault();
    event.stopPropagation();
    actions[event.key]();
  }

  /** Where a time and a frequency are drawn, px. */
  position(seconds, hz) {
    const { from, to, low, high } = this.view;
    const [width, height] = [this.canvas.clientWidth - LEFT, this.canvas.clientHeight - BELOW];
    return [LEFT + ((seconds - from) / (to - from)) * width, height * (1 - (hz - low) / (high - low))];
  }

  /** Draws with the next frame, once for all changes before it. */
  draw() {
    next(this.#paint);
  }

  #paint = () => {
    const { canvas } = this;
    const [width, height] = [canvas.clientWidth, canvas.clientHeight];
    if (!width || !height) return;
    const ratio = window.devicePixelRatio || 1;
    const [across, down] = [Math.round(width * ratio), Math.round(height * ratio)];
    if (canvas.width !== across || canvas.height !== down) [canvas.width, canvas.height] = [across, down];
    const pen = canvas.getContext("2d");
    pen.setTransform(1, 0, 0, 1, 0, 0);
    pen.clearRect(0, 0, across, down);
    if (!this.picture || !this.view) return;
    pen.save();
    pen.beginPath();
    pen.rect(LEFT * ratio, 0, (width - LEFT) * ratio, (height - BELOW) * ratio);
    pen.clip();
    this.#image(pen, ratio, this);
    if (this.part) this.#image(pen, ratio, this.part);
    this.#overlay(pen, ratio);
    pen.restore();
    pen.scale(ratio, ratio);
    this.#axes(pen, width, height);
    this.#marker();
    const shown = this.view.to - this.view.from;
    canvas.setAttribute("aria-label", `Spectrogram of ${this.shown}, ${fixed(shown, 1)} s, ${fixed(this.view.low, 0)} to ${fixed(this.view.high, 0)} Hz`);
    this.painted = { channel: this.shown, ...this.view };
    clearTimeout(this.later);
    this.later = setTimeout(() => this.#refine(), RESTS);
  };

  /** Time and frequencies around the view to be requested in finer columns and rows; none if they are there, or cannot be had. */
  #unrefined() {
    if (!this.view) return undefined;
    const whole = this.#whole();
    const { from, to, low, high } = this.view;
    const [length, height] = [to - from, high - low];
    if (length >= whole.to - whole.from && height >= whole.high - whole.low) return undefined;
    const part = {
      channel: this.shown,
      from_s: Math.max(whole.from, from - BESIDE * length), to_s: Math.min(whole.to, to + BESIDE * length),
      low_hz: Math.max(whole.low, low - BESIDE * height), high_hz: Math.min(whole.high, high + BESIDE * height),
    };
    if (part.to_s - part.from_s > this.covers.longest_part_s) return undefined;
    const there = this.part?.asked;
    const covered = there && there.from_s <= from && there.to_s >= to && there.low_hz <= low && there.high_hz >= high;
    const finest = 1 + 2 * BESIDE;
    const fine = there && there.to_s - there.from_s <= FINER * finest * length && there.high_hz - there.low_hz <= FINER * finest * height;
    return covered && fine ? undefined : part;
  }

  /** Requests one part at a time; if the view has moved out of it meanwhile, the next. */
  async #refine() {
    if (this.refining) return;
    this.refining = true;
    try {
      for (let asked = this.#unrefined(); asked; asked = this.#unrefined()) {
        const found = await spectrogram(asked);
        if (asked.channel !== this.shown) continue;
        // Without samples the whole is all there is.
        this.part = { asked, ...found };
        this.draw();
      }
    } catch {
      // The connection is lost: the next view asks again.
    } finally {
      this.refining = false;
    }
  }

  /** Draws the part of a picture in sight: as a whole, magnified, it would be too large to be placed to a pixel. */
  #image(pen, ratio, { picture, covers }) {
    if (!picture) return;
    const { view } = this;
    const across = (seconds) => ((seconds - covers.from_s) / (covers.to_s - covers.from_s)) * picture.width;
    const down = (hz) => ((covers.top_hz - hz) / (covers.top_hz - covers.bottom_hz)) * picture.height;
    const [from, to] = [Math.max(view.from, covers.from_s), Math.min(view.to, covers.to_s)];
    const [low, high] = [Math.max(view.low, covers.bottom_hz), Math.min(view.high, covers.top_hz)];
    if (from >= to || low >= high) return;
    const [left, upper] = this.position(from, high).map((px) => px * ratio);
    const [right, lower] = this.position(to, low).map((px) => px * ratio);
    pen.imageSmoothingEnabled = false;
    pen.drawImage(picture, across(from), down(high), across(to) - across(from), down(low) - down(high), left, upper, right - left, lower - upper);
  }

  /** Frequencies predicted to be unstable, and frames around the squeals; in pixels of the screen. */
  #overlay(pen, ratio) {
    const { bins, binS } = this.history;
    const place = (seconds, hz) => this.position(seconds, hz).map((px) => px * ratio);
    // Whole pixels, at most half a one off.
    const thick = Math.max(1, Math.round(1.5 * ratio));
    pen.fillStyle = "#40e0ff";
    for (let k = firstFrom(bins, (this.view.from - HOLDS_S) / binS); k < bins.length && bins[k].k * binS <= this.view.to; k++) {
      const upTo = bins[k + 1]?.k - bins[k].k <= HOLDS_S / binS ? bins[k + 1].k : bins[k].k + 1;
      for (const [hz] of bins[k].u ?? []) {
        const [x, y] = place(bins[k].k * binS, hz);
        const [end] = place(upTo * binS, hz);
        pen.fillRect(Math.floor(x), Math.round(y - thick / 2), Math.max(1, Math.round(end) - Math.floor(x)), thick);
      }
    }
    pen.strokeStyle = "#fff";
    pen.lineWidth = 1.5 * ratio;
    for (const squeal of this.squeals.filter((squeal) => squeal.channel === this.shown)) {
      const [x, y] = place(squeal.onset_s, squeal.frequency_hz);
      const [end] = place(squeal.end_s ?? this.covers.to_s, squeal.frequency_hz);
      pen.strokeRect(x, y - 8 * ratio, Math.max(2, end - x), 16 * ratio);
    }
  }

  /** Marks the moment of a recording that the rest of the page shows, and keeps it in sight. */
  mark(moment) {
    const moves = this.moment !== null && moment !== this.moment;
    this.moment = moment;
    if (!this.view) return;
    const { from, to } = this.view;
    if (moves && (moment < from || moment > to)) return this.#move(moment - from - 0.1 * (to - from), 0);
    this.#marker();
  }

  #marker() {
    const marker = at("sound-moment");
    const { from, to } = this.view;
    marker.hidden = this.moment === null || this.moment < from || this.moment > to;
    if (!marker.hidden) marker.style.transform = `translateX(${this.position(this.moment, 0)[0].toFixed(1)}px)`;
  }

  #axes(pen, width, height) {
    pen.fillStyle = colour("--muted");
    pen.font = "12px system-ui, sans-serif";
    pen.textBaseline = "middle";
    pen.textAlign = "right";
    for (const hz of ticks(this.view.low, this.view.high, (height - BELOW) / 34)) {
      const y = this.position(this.view.from, hz)[1];
      if (y > 7 && y < height - BELOW - 4) pen.fillText(`${fixed(hz / 1000, hz % 1000 ? (hz % 100 ? 2 : 1) : 0)} kHz`, LEFT - 5, y);
    }
    pen.textAlign = "center";
    const start = this.live ? 0 : this.covers.from_s;
    for (const seconds of ticks(this.view.from - start, this.view.to - start, (width - LEFT) / 90)) {
      const x = this.position(seconds + start, 0)[0];
      const decimals = this.view.to - this.view.from < 8 ? 1 : 0;
      const label = this.live ? time(seconds, decimals) : `${fixed(seconds, decimals)} s`;
      if (x > LEFT + 24 && x < width - 24) pen.fillText(label, x, height - BELOW / 2);
    }
  }
}

/** The spectrogram of a channel, or of a part of it, and what it covers; undefined if there is none. */
async function spectrogram(asked) {
  const answer = await fetch(`spectrogram.png?${new URLSearchParams(asked)}`);
  if (!answer.ok) return undefined;
  const covers = JSON.parse(answer.headers.get("x-covers"));
  return { picture: await createImageBitmap(await answer.blob()), covers };
}

/** Index of the first bin whose number is at least `number`. */
function firstFrom(bins, number) {
  let [low, high] = [0, bins.length];
  while (low < high) {
    const middle = (low + high) >> 1;
    if (bins[middle].k < number) low = middle + 1;
    else high = middle;
  }
  return low;
}

/** Round values from `low` to `high`, at most `most` of them. */
function ticks(low, high, most) {
  const rough = (high - low) / Math.max(1, most);
  const power = 10 ** Math.floor(Math.log10(rough));
  const step = [1, 2, 5, 10].map((factor) => factor * power).find((step) => step >= rough);
  const found = [];
  for (let k = Math.ceil(low / step); k * step <= high; k++) found.push(k * step);
  return found;
}

/** The scores of a channel, each with its counts. */
function score(of) {
  const row = document.createElement("dl");
  row.className = "score";
  const share = (value) => (known(value) ? fixed(value, 2) : NONE);
  const { hits, misses, false_alarms: alarms, quiet } = of.slots;
  const entries = [
    [of.channel, "", `${fixed(of.judged_s, 0)} s judged`],
    ["recall", share(of.recall), `${of.hits} hits, ${of.misses} misses`],
    ["precision", share(of.precision), `${of.confirmed} found, ${of.false_alarms} false alarms`],
    ["MCC", share(of.mcc), `of seconds: ${hits} hit, ${misses} missed, ${alarms} false, ${quiet} quiet`],
    ["lead", known(of.median_lead_s) ? `${fixed(of.median_lead_s, 2)} s` : NONE, `median of ${of.hits} hits`],
  ];
  for (const [name, value, counts] of entries) {
    const box = document.createElement("div");
    const [term, data, small] = ["dt", "dd", "dd"].map((kind) => document.createElement(kind));
    small.className = "counts";
    [term.textContent, data.textContent, small.textContent] = [name, value, counts];
    box.append(term, ...(value ? [data, small] : [small]));
    row.append(box);
  }
  return row;
}
