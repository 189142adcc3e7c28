// The last minutes: ranges of load, speed, friction coefficient, growth rate, margin and measured vibration, and a
// waterfall of the unstable and the measured frequencies.

import { NONE, colour, fixed, known, labels, put, time } from "./format.js";

const at = (id) => document.getElementById(id);
/** `least` is the minimum range shown of a quantity, so that noise does not fill the plot. */
const ROWS = [
  { key: "load", label: "load", unit: "N", paint: "--mode-6", least: 20, range: (bin) => bin.r[0] },
  { key: "speed", label: "speed", unit: "rad/s", paint: "--mode-6", least: 0.5, range: (bin) => bin.r[1] },
  { key: "mu", label: "μ", unit: "", paint: "--mode-0", least: 0.05, range: (bin) => bin.r[2] },
  { key: "growth", label: "growth", unit: "1/s", paint: "--squeal-line", least: 1e-3, range: (bin) => bin.r[3] },
  { key: "margin", label: "margin", unit: "", paint: "--mode-2", least: 0.05, range: (bin) => bin.r[4] },
];
const MEASURED = { key: "measured", label: "measured", unit: "dB", paint: "--mode-3", least: 20, range: (bin) => bin.v && [bin.v.lo, bin.v.hi] };

/** Lines are broken at intervals without data longer than this and than five times the usual spacing, s. */
const GAP_S = 2;

/** A larger difference to the present means that the stamps are from another clock, s. */
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

  /** Loads the complete history. */
  load({ bin_s: binS, bins }) {
    this.binS = binS;
    this.bins = bins;
    this.refresh();
  }

  /** Adds new bins; false if bins in between are missing. */
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
    holder.classList.toggle("measured", this.measured);
    const rows = this.measured ? [...ROWS, MEASURED] : ROWS;
    this.columns = columns(holder);
    // In several columns each plot has its own time axis.
    this.plots = rows.map((row) => this.#row(holder, row, this.columns > 1 && row.key === "margin"));
    this.plots.push(this.#waterfall(holder));
    this.refresh();
  }

  #element(holder, row, name) {
    const box = document.createElement("div");
    box.className = `row ${name} ${row.key}`;
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

  /** `filled` says whether there are data for which to label the axes. */
  #options(element, xAxis, y, filled) {
    const ink = colour("--muted");
    const grid = { stroke: colour("--grid"), width: 1 };
    const px = Math.round(parseFloat(getComputedStyle(element).fontSize) * 0.75);
    const font = `${px}px system-ui, sans-serif`;
    return {
      width: Math.max(120, element.clientWidth),
      height: Math.max(40, element.clientHeight),
      // The last label of the time axis extends this far on both sides of its tick.
      padding: [5, 2.4 * px, xAxis ? 0 : 5, 0],
      pxAlign: 0,
      legend: { show: false },
      cursor: { show: false },
      scales: { x: { time: true, range: () => this.#span() }, y },
      axes: [
        { show: xAxis, stroke: ink, grid, ticks: grid, font, size: 2.2 * px, space: 6 * px, values: (_, ticks) => ticks.map((tick) => (this.bins.length || this.live ? this.#clock(tick) : "")) },
        // Labels at the ends would touch those of the next plot.
        { stroke: ink, grid, ticks: { ...grid, size: 4 }, font, size: 5 * px, space: (u, axis, low, high, height) => Math.min(1.9 * px, 0.45 * height), values: (u, ticks) => {
          const height = u.bbox.height / uPlot.pxRatio;
          const inside = (tick) => Math.abs(u.valToPos(tick, "y") - height / 2) < height / 2 - 0.4 * px;
          return filled() ? labels(ticks).map((label, k) => (inside(ticks[k]) ? label : "")) : ticks.map(() => "");
        } },
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
    // Time advances in silence too, unless the stamps are from another clock.
    const end = this.now - last < ANOTHER_CLOCK_S ? Math.max(last, this.now) : last;
    // A short session fills the width, but at least a minute is shown.
    const start = this.live ? Math.max(end - this.length, Math.min(this.#start(), end - 60)) : this.#start();
    return [Math.min(start, end - this.binS), end];
  }

  #row(holder, row, xAxis) {
    const element = this.#element(holder, row, "range");
    let some = false;
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
      ...this.#options(element, xAxis, y, () => some),
      series: [{}, { stroke: paint, width: 1.5, points: { show: false } }, { stroke: paint, width: 1.5, points: { show: false } }],
      bands: [{ series: [2, 1], fill: `${paint}66` }],
      hooks: { drawClear: [zero] },
    }, [[], [], []], element);
    return { u, element, marker: this.#marker(u), data: (bins) => {
      const range = bins.map(row.range);
      some = range.some(Boolean);
      return [bins.map((bin) => (bin.k + 0.5) * this.binS), range.map((r) => r?.[0] ?? null), range.map((r) => r?.[1] ?? null)];
    } };
  }

  #waterfall(holder) {
    const element = this.#element(holder, { key: "unstable", label: "unstable", unit: "Hz" }, "waterfall");
    let shown = [];
    let measured = [];
    let range = null;
    const heat = heatScale();
    const paint = (u) => {
      const { ctx, bbox } = u;
      const fastest = Math.max(1e-12, ...shown.flatMap((bin) => bin.u.map(([, growth]) => growth)));
      put(at("heat-low"), "0");
      put(at("heat-high"), shown.length ? `${Number(fastest.toPrecision(3))} 1/s` : `${NONE} 1/s`);
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
      // Measured frequencies as small dots, so that they do not hide the predictions.
      ctx.fillStyle = colour("--ink");
      const dot = 2 * devicePixelRatio;
      for (const bin of measured) {
        ctx.fillRect(u.valToPos((bin.k + 0.5) * this.binS, "x", true) - dot / 2, u.valToPos(bin.v.hz, "y", true) - dot / 2, dot, dot);
      }
    };
    const u = new uPlot({
      ...this.#options(element, true, { range: () => range ?? [0, 1] }, () => range !== null),
      series: [{}, { show: true, stroke: "transparent", points: { show: false } }],
      hooks: { draw: [paint] },
    }, [[], []], element);
    return { u, element, marker: this.#marker(u), data: (bins) => {
      shown = bins.filter((bin) => bin.u.length > 0);
      measured = bins.filter((bin) => bin.v && bin.v.hi >= this.threshold);
      const all = [...shown.flatMap((bin) => bin.u.map(([hz]) => hz)), ...measured.map((bin) => bin.v.hz)];
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

  /** Redraws if the plot is visible and has moved by some pixels. */
  refreshIfDue() {
    const [from, to] = this.#span();
    const each = Math.min(1000, Math.max(500, 2500 * (to - from) / this.plots[0].u.width));
    if (this.visible && !(performance.now() - this.drawnAt < each)) this.refresh();
  }

  /** Redraws. */
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

  /** The bins of the time shown, at most one for every second pixel. */
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

  /** Marks the moment of a recording that the rest of the page shows. */
  mark(seconds) {
    this.moment = seconds;
    for (const { u, marker } of this.plots) {
      marker.hidden = false;
      marker.style.transform = `translateX(${u.valToPos(seconds, "x").toFixed(1)}px)`;
    }
  }

  #resize() {
    if (columns(at("history-plots")) !== this.columns) return this.draw();
    for (const { u, element } of this.plots) {
      const size = { width: Math.max(120, element.clientWidth), height: Math.max(40, element.clientHeight) };
      if (size.width !== u.width || size.height !== u.height) u.setSize(size);
    }
    if (this.moment !== null) this.mark(this.moment);
  }
}

/** Merges bins to `each` times the length, as the node does; an empty one where `gap` or more are missing. */
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

/** Number of plots side by side. */
function columns(holder) {
  const { display, gridTemplateColumns } = getComputedStyle(holder);
  return display === "grid" ? gridTemplateColumns.split(" ").length : 1;
}

/** The colour of a growth rate from 0 to 1: contrast increases with growth. Also paints the scale next to the plot. */
function heatScale() {
  const stops = [0, 1, 2, 3].map((k) => colour(`--heat-${k}`).match(/[0-9a-f]{2}/gi).map((pair) => parseInt(pair, 16)));
  const heat = (share) => {
    const place = Math.min(0.9999, Math.max(0, share)) * (stops.length - 1);
    const k = Math.floor(place);
    return `rgb(${stops[k].map((value, i) => Math.round(value + (place - k) * (stops[k + 1][i] - value))).join(" ")})`;
  };
  const scale = at("heat");
  const ctx = scale.getContext("2d");
  for (let x = 0; x < scale.width; x++) {
    ctx.fillStyle = heat(x / (scale.width - 1));
    ctx.fillRect(x, 0, 1, scale.height);
  }
  return heat;
}
