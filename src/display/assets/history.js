// The last minutes: ranges of load, speed, friction, growth and margin, of the measured vibration where there is one, and
// a waterfall of the unstable frequencies with the measured ones.

import { colour, fixed, known, labels, time } from "./format.js";

const at = (id) => document.getElementById(id);
/** `least` is the least range shown of a quantity, so that noise does not fill the plot. */
const ROWS = [
  { key: "load", label: "load", unit: "N", paint: "--mode-6", least: 20, range: (bin) => bin.r[0] },
  { key: "speed", label: "speed", unit: "rad/s", paint: "--mode-6", least: 0.5, range: (bin) => bin.r[1] },
  { key: "mu", label: "μ", unit: "", paint: "--mode-0", least: 0.05, range: (bin) => bin.r[2] },
  { key: "growth", label: "growth", unit: "1/s", paint: "--squeal-line", least: 1e-3, range: (bin) => bin.r[3] },
  { key: "margin", label: "margin", unit: "", paint: "--mode-2", least: 0.05, range: (bin) => bin.r[4] },
];
const MEASURED = { key: "measured", label: "measured", unit: "dB", paint: "--mode-3", least: 20, range: (bin) => bin.v && [bin.v.lo, bin.v.hi] };

/** Without anything for longer than this, and than five times as usual, the lines are broken, s. */
const GAP_S = 2;

/** No silence is as long, s. */
const ANOTHER_CLOCK_S = 86400;

export class History {
  constructor(about) {
    this.live = about.kind === "live";
    this.binS = 0.2;
    this.bins = [];
    this.length = 300;
    this.plots = [];
    this.moment = null;
    this.now = -Infinity;
    this.threshold = about.vibration_threshold_db;
    this.measured = false;
    if (this.live) {
      at("history-range").addEventListener("change", (event) => {
        this.length = Number(event.target.value);
        this.refresh();
      });
    } else {
      at("history-range").hidden = true;
    }
    new ResizeObserver(() => this.#resize()).observe(at("history-plots"));
    new IntersectionObserver((entries) => {
      this.visible = entries.at(-1).isIntersecting;
    }).observe(at("history-plots"));
    this.draw();
  }

  /** All of it. */
  load({ bin_s: binS, bins }) {
    this.binS = binS;
    this.bins = bins;
    this.refresh();
  }

  /** What came since; false where something between is missing. */
  add(bins) {
    if (!bins?.length) return true;
    const last = this.bins[this.bins.length - 1];
    if (last && bins[0].k > last.k) return false;
    for (const bin of bins) {
      const tail = this.bins[this.bins.length - 1];
      if (tail && tail.k === bin.k) this.bins[this.bins.length - 1] = bin;
      else if (!tail || tail.k < bin.k) this.bins.push(bin);
    }
    if (this.bins.length > 3000) this.bins.splice(0, this.bins.length - 3000);
    return true;
  }

  draw() {
    for (const plot of this.plots) plot.u.destroy();
    const holder = at("history-plots");
    holder.replaceChildren();
    const rows = this.measured ? [...ROWS, MEASURED] : ROWS;
    this.plots = rows.map((row) => this.#row(holder, row));
    this.plots.push(this.#waterfall(holder));
    this.refresh();
  }

  #element(holder, row, name) {
    const box = document.createElement("div");
    box.className = `row ${name}`;
    const label = document.createElement("p");
    label.innerHTML = `<b></b><span></span>`;
    label.firstChild.textContent = row.label;
    label.lastChild.textContent = row.unit;
    const plot = document.createElement("div");
    plot.className = "plot";
    plot.setAttribute("role", "img");
    plot.setAttribute("aria-label", `${row.label} over time`);
    box.append(label, plot);
    holder.append(box);
    return plot;
  }

  #options(element, xAxis, y) {
    const ink = colour("--muted");
    const grid = { stroke: colour("--grid"), width: 1 };
    const px = Math.round(parseFloat(getComputedStyle(element).fontSize) * 0.75);
    const font = `${px}px system-ui, sans-serif`;
    return {
      width: Math.max(120, element.clientWidth),
      height: Math.max(40, element.clientHeight),
      // The last time of the axis is as wide as this on either side of its tick.
      padding: [5, 2.4 * px, xAxis ? 0 : 5, 0],
      pxAlign: 0,
      legend: { show: false },
      cursor: { show: false },
      scales: { x: { time: true, range: () => this.#span() }, y },
      axes: [
        { show: xAxis, stroke: ink, grid, ticks: grid, font, size: 2.2 * px, space: 6 * px, values: (_, ticks) => ticks.map((tick) => this.#clock(tick)) },
        { stroke: ink, grid, ticks: { ...grid, size: 4 }, font, size: 5 * px, space: 1.9 * px, values: (_, ticks) => labels(ticks) },
      ],
    };
  }

  #clock(seconds) {
    return this.live ? time(seconds, 0) : `${fixed(seconds - this.#start(), 0)} s`;
  }

  #start() {
    return this.bins.length ? this.bins[0].k * this.binS : 0;
  }

  #span() {
    const last = this.bins.length ? (this.bins[this.bins.length - 1].k + 1) * this.binS : Date.now() / 1000;
    // Time goes on in silence too, unless the stamps are of another clock.
    const end = this.now - last < ANOTHER_CLOCK_S ? Math.max(last, this.now) : last;
    // A young session fills the width; it is never less than a minute.
    const start = this.live ? Math.max(end - this.length, Math.min(this.#start(), end - 60)) : this.#start();
    return [Math.min(start, end - this.binS), end];
  }

  #row(holder, row) {
    const element = this.#element(holder, row, "range");
    const paint = colour(row.paint);
    const y = {
      range: (_, low, high) => {
        if (!known(low) || !known(high)) return [0, 1];
        const span = Math.max(high - low, row.least);
        const middle = (high + low) / 2;
        return [middle - 0.56 * span, middle + 0.56 * span];
      },
    };
    const zero = (u) => {
      const level = { margin: 0, growth: 0, measured: this.threshold }[row.key];
      if (level === undefined) return;
      const { ctx, bbox } = u;
      const y = u.valToPos(level, "y", true);
      if (y < bbox.top || y > bbox.top + bbox.height) return;
      ctx.fillStyle = colour("--muted");
      ctx.fillRect(bbox.left, y, bbox.width, devicePixelRatio);
    };
    const u = new uPlot({
      ...this.#options(element, false, y),
      series: [{}, { stroke: paint, width: 1.5, points: { show: false } }, { stroke: paint, width: 1.5, points: { show: false } }],
      bands: [{ series: [2, 1], fill: `${paint}66` }],
      hooks: { drawClear: [zero] },
    }, [[], [], []], element);
    return { u, element, marker: this.#marker(u), data: (bins) => {
      const range = bins.map(row.range);
      return [bins.map((bin) => (bin.k + 0.5) * this.binS), range.map((r) => r?.[0] ?? null), range.map((r) => r?.[1] ?? null)];
    } };
  }

  #waterfall(holder) {
    const element = this.#element(holder, { label: "unstable", unit: "Hz" }, "waterfall");
    let shown = [];
    let heard = [];
    let range = [0, 1];
    const paint = (u) => {
      const { ctx, bbox } = u;
      const fastest = Math.max(1e-12, ...shown.flatMap((bin) => bin.u.map(([, growth]) => growth)));
      const width = Math.max(1.5 * devicePixelRatio, bbox.width * this.shownS / (u.scales.x.max - u.scales.x.min) + 1);
      const height = 6 * devicePixelRatio;
      for (const bin of shown) {
        const x = u.valToPos((bin.k + 0.5) * this.binS, "x", true) - width / 2;
        if (x < bbox.left - width) continue;
        for (const [hz, growth] of bin.u) {
          ctx.fillStyle = heat(growth / fastest);
          ctx.fillRect(x, u.valToPos(hz, "y", true) - height / 2, width, height);
        }
      }
      // What was heard, as dots: small, so that they do not hide what was predicted.
      ctx.fillStyle = colour("--ink");
      const dot = 2 * devicePixelRatio;
      for (const bin of heard) {
        ctx.fillRect(u.valToPos((bin.k + 0.5) * this.binS, "x", true) - dot / 2, u.valToPos(bin.v.hz, "y", true) - dot / 2, dot, dot);
      }
    };
    const u = new uPlot({
      ...this.#options(element, true, { range: () => range }),
      series: [{}, { show: true, stroke: "transparent", points: { show: false } }],
      hooks: { draw: [paint] },
    }, [[], []], element);
    return { u, element, marker: this.#marker(u), data: (bins) => {
      shown = bins.filter((bin) => bin.u.length > 0);
      heard = bins.filter((bin) => bin.v && bin.v.hi >= this.threshold);
      const all = [...shown.flatMap((bin) => bin.u.map(([hz]) => hz)), ...heard.map((bin) => bin.v.hz)];
      if (all.length) {
        const low = Math.min(...all);
        const high = Math.max(...all);
        const pad = Math.max(0.3 * (high - low), 0.08 * high);
        range = [Math.max(0, low - pad), high + pad];
      }
      return [bins.map((bin) => (bin.k + 0.5) * this.binS), bins.map((bin) => bin.u[0]?.[0] ?? null)];
    } };
  }

  #marker(u) {
    const marker = document.createElement("div");
    marker.className = "mu-cursor";
    marker.hidden = true;
    u.over.append(marker);
    return marker;
  }

  /** Draws anew if that shows much: where it is in sight, and went on by some pixels. */
  refreshIfDue() {
    const [from, to] = this.#span();
    const each = Math.min(1000, Math.max(500, 2500 * (to - from) / this.plots[0].u.width));
    if (this.visible && !(performance.now() - this.drawnAt < each)) this.refresh();
  }

  /** Draws anew. */
  refresh() {
    this.drawnAt = performance.now();
    if (!this.measured && this.bins.some((bin) => bin.v)) {
      this.measured = true;
      return this.draw();
    }
    const bins = this.#seen();
    for (const plot of this.plots) plot.u.setData(plot.data(bins));
    if (this.moment !== null) this.mark(this.moment);
  }

  /** The bins of the time shown, one for every other pixel at most. */
  #seen() {
    const from = this.#span()[0];
    let first = this.bins.findIndex((bin) => (bin.k + 1) * this.binS >= from);
    if (first < 0) first = 0;
    const bins = first ? this.bins.slice(first) : this.bins;
    const each = Math.max(1, Math.ceil(2 * bins.length / this.plots[0].u.width));
    this.shownS = each * this.binS;
    const usual = (bins[bins.length - 1]?.k - bins[0]?.k) / bins.length;
    return merged(bins, each, Math.max(GAP_S / this.binS, 5 * usual));
  }

  /** The moment of a recording that the rest of the page shows. */
  mark(seconds) {
    this.moment = seconds;
    for (const { u, marker } of this.plots) {
      marker.hidden = false;
      marker.style.transform = `translateX(${u.valToPos(seconds, "x").toFixed(1)}px)`;
    }
  }

  #resize() {
    for (const { u, element } of this.plots) {
      const size = { width: Math.max(120, element.clientWidth), height: Math.max(40, element.clientHeight) };
      if (size.width !== u.width || size.height !== u.height) u.setSize(size);
    }
    if (this.moment !== null) this.mark(this.moment);
  }
}

/** Bins of `each` times the length, as the node merges them; an empty one where `gap` or more are missing. */
function merged(bins, each, gap) {
  const all = [];
  let before = Infinity;
  for (const bin of bins) {
    const place = Math.floor(bin.k / each);
    const tail = all[all.length - 1];
    if (bin.k - before > gap) all.push({ k: before + 1, r: bin.r.map(() => null), u: [] });
    before = bin.k;
    if (tail?.place !== place) {
      all.push({ ...bin, place, k: (place + 0.5) * each - 0.5, r: bin.r.slice() });
      continue;
    }
    if (bin.r[3] && !(tail.r[3]?.[1] >= bin.r[3][1])) tail.u = bin.u;
    bin.r.forEach((range, k) => {
      if (range) tail.r[k] = tail.r[k] ? [Math.min(tail.r[k][0], range[0]), Math.max(tail.r[k][1], range[1])] : range;
    });
    if (bin.v) tail.v = tail.v ? { hz: (bin.v.hi > tail.v.hi ? bin.v : tail.v).hz, lo: Math.min(tail.v.lo, bin.v.lo), hi: Math.max(tail.v.hi, bin.v.hi) } : bin.v;
  }
  return all;
}

/** From dark to bright with rising growth; its brightness alone tells (after cividis). */
function heat(share) {
  const stops = [[0, 59, 111], [87, 93, 109], [138, 134, 120], [196, 179, 92], [254, 232, 56]];
  const place = Math.min(0.9999, Math.max(0, share)) * (stops.length - 1);
  const k = Math.floor(place);
  const mix = stops[k].map((value, i) => Math.round(value + (place - k) * (stops[k + 1][i] - value)));
  return `rgb(${mix.join(" ")})`;
}
