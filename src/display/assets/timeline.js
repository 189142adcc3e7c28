// The time line of a recording: move, play, pause, speed, jump to events.

import { colour, fixed, LEVELS } from "./format.js";

const at = (id) => document.getElementById(id);

export class Timeline {
  /** `look` is called with the moment to show and returns once it is shown. */
  constructor(about, look) {
    [this.start, this.end] = about.span_s;
    this.look = look;
    this.moment = this.start;
    this.playing = false;
    this.events = [];
    at("timeline").hidden = false;
    document.body.classList.add("has-timeline");
    const scrub = at("scrub");
    scrub.max = String(this.end - this.start);
    scrub.step = String(Math.max(0.01, (this.end - this.start) / 20000));
    scrub.addEventListener("input", () => this.go(this.start + Number(scrub.value)));
    at("play").addEventListener("click", () => this.play(!this.playing));
    at("back").addEventListener("click", () => this.jump(-1));
    at("next").addEventListener("click", () => this.jump(1));
    addEventListener("keydown", (event) => {
      if (event.target.closest("button, input, select, a, [tabindex]") || event.ctrlKey || event.metaKey || event.altKey) return;
      const action = { " ": () => this.play(!this.playing), ArrowLeft: () => this.go(this.moment - 1), ArrowRight: () => this.go(this.moment + 1), n: () => this.jump(1), p: () => this.jump(-1) }[event.key];
      if (!action) return;
      event.preventDefault();
      action();
    });
    this.#show();
  }

  go(moment) {
    this.moment = Math.min(this.end, Math.max(this.start, moment));
    this.#show();
    this.#fetch();
  }

  jump(way) {
    const onsets = this.events.map((event) => event.onset_s);
    const to = way > 0 ? onsets.find((onset) => onset > this.moment + 1e-6) : onsets.findLast((onset) => onset < this.moment - 0.5);
    if (to !== undefined) this.go(to);
  }

  play(playing) {
    if (playing && this.moment >= this.end) this.moment = this.start;
    this.playing = playing;
    const button = at("play");
    button.textContent = playing ? "Pause" : "Play";
    button.setAttribute("aria-pressed", String(playing));
    if (!playing) return;
    let before = performance.now();
    const step = (now) => {
      if (!this.playing) return;
      if (now - before >= 33) {
        this.moment = Math.min(this.end, this.moment + (now - before) / 1000 * Number(at("play-speed").value));
        before = now;
        this.#show();
        this.#fetch();
        if (this.moment >= this.end) this.play(false);
      }
      requestAnimationFrame(step);
    };
    requestAnimationFrame(step);
  }

  /** Requests one moment at a time; the latest one wins. */
  async #fetch() {
    if (this.asking) return;
    this.asking = true;
    let asked;
    try {
      do {
        asked = this.moment;
        await this.look(asked);
      } while (asked !== this.moment && !this.playing);
    } finally {
      this.asking = false;
    }
  }

  #show() {
    at("scrub").value = String(this.moment - this.start);
    const text = `${fixed(this.moment - this.start, 2)} s of ${fixed(this.end - this.start, 1)} s`;
    at("clock").textContent = text;
    at("scrub").setAttribute("aria-valuetext", text);
  }

  /** The most severe level over the recording behind the slider; measured squeals below, misses at full height. */
  paint({ bin_s: binS, bins }, measured) {
    const canvas = at("track-levels");
    const width = canvas.width = Math.round(canvas.clientWidth * devicePixelRatio);
    const height = canvas.height = Math.round(canvas.clientHeight * devicePixelRatio);
    const ctx = canvas.getContext("2d");
    const scale = width / Math.max(1e-9, this.end - this.start);
    for (const bin of bins) {
      if (bin.l === null) continue;
      ctx.fillStyle = colour(`--${LEVELS[bin.l]}`);
      ctx.fillRect((bin.k * binS - this.start) * scale, 0, Math.max(1, binS * scale + 0.5), height);
    }
    ctx.fillStyle = colour("--ink");
    for (const squeal of measured) {
      const share = squeal.verdict === "hit" ? 0.4 : 1;
      ctx.fillRect((squeal.onset_s - this.start) * scale, (1 - share) * height, Math.max(1, (squeal.end_s - squeal.onset_s) * scale), share * height);
    }
  }
}
