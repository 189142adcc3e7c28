// Growth rates and frequencies over the friction coefficient, with a cursor at the present one and readout of any
// other.

import { colour, fixed, known, labels, leastGrowth, modeColour, put, signed } from "./format.js";

/** Seven colours; beyond that, dashes distinguish the modes. */
const DASHES = [undefined, [8, 4], [2, 3]];
/** Distance from the centre of a dot to the edge of its strip, px. */
const REACH = 6;
/** Number of modes that are read off at a time. */
const MOST_READ = 4;
/** Number of steps of the arrow keys over the range shown. */
const STEPS = 100;

const at = (id) => document.getElementById(id);

export class StabilityMap {
  constructor(about) {
    this.muMax = about.mu_max;
    this.plots = [];
    this.curves = null;
    this.range = "near";
    put(at("map-readout"), "");
    /** The axis limits shown; `null` before the first map. */
    this.limits = null;
    /** The friction coefficient being read off; `null` if none. */
    this.read = null;
    at("map-range").addEventListener("change", (event) => {
      this.range = event.target.value;
      this.draw();
    });
    const plots = at("map-plots");
    plots.addEventListener("keydown", (event) => this.#key(event));
    plots.addEventListener("blur", () => this.#readAt(null));
    plots.addEventListener("pointerleave", () => this.#readAt(null));
    for (const kind of ["pointermove", "pointerdown"]) plots.addEventListener(kind, (event) => this.#point(event));
    new ResizeObserver(() => this.#resize()).observe(plots);
  }

  /** Shows a new map. */
  show(curves) {
    this.curves = curves;
    const { normal_load_n: load, disc_speed_rad_s: speed, windows } = curves;
    const judged = windows.length ? `${windows.length} window${windows.length > 1 ? "s" : ""} of instability` : "stable in the whole range";
    put(at("map-note"), `${fixed(load, 0)} N, ${fixed(speed, 2)} rad/s: ${judged}${curves.complete ? "" : " (search cut short)"}`);
    this.draw();
  }

  /** Rebuilds the plots in the current colours. */
  draw() {
    for (const plot of this.plots) plot.u.destroy();
    this.plots = [];
    if (!this.curves) return;
    this.focus = this.#focus();
    this.limits = this.range === "near" ? this.#near() : this.#all();
    this.plots = [
      this.#plot(at("map-growth"), "growth rate, 1/s", (mode) => mode.growth_rate_per_s, "growth"),
      this.#plot(at("map-frequency"), "frequency, Hz", (mode) => mode.frequency_hz, "frequency"),
    ];
    this.#resize();
    if (this.state) this.cursor(this.state);
    this.#readAt(this.read);
  }

  /** The unstable modes, else those that will become unstable next; all modes if that is unknown. */
  #focus() {
    const { modes, windows } = this.curves;
    const { fastest, next, mu } = this.state ?? {};
    const holds = (window) => window.mu_from <= mu && !(known(window.mu_to) && window.mu_to < mu) && window.mode_ids.includes(fastest?.id);
    const ids = fastest ? [fastest.id, ...(windows.find(holds)?.mode_ids ?? [])] : next?.ids ?? windows[0]?.mode_ids ?? [];
    const found = modes.filter((mode) => ids.includes(mode.id)).map((mode) => mode.id);
    return found.length ? found : modes.map((mode) => mode.id);
  }

  /** The friction coefficients that must be visible. */
  #points() {
    const { mu, spread, next } = this.state ?? {};
    return [mu, ...(spread ?? []), next?.mu ?? this.curves.windows[0]?.mu_from].filter(known);
  }

  /** A range around the present friction coefficient and the nearest end, scaled to the modes that merge there. */
  #near() {
    const { mu } = this.curves;
    const [first, last] = [mu[0], mu[mu.length - 1]];
    const points = this.#points();
    if (!points.length) return this.#all();
    const [low, high] = [Math.min(...points), Math.max(...points)];
    const pad = Math.max(0.4 * (high - low), 0.04 * (last - first));
    const x = [Math.max(first, low - pad), Math.min(last, high + pad)];
    const [frequency, growth] = ["frequency_hz", "growth_rate_per_s"].map((quantity) => this.#span(this.focus, quantity, x));
    const least = leastGrowth(Math.max(frequency[1], 1));
    // Modes that decay faster than any mode grows are not of interest.
    const fastest = Math.max(0, growth[1]);
    return { x, frequency: padded(frequency, 0.15, 0.02 * frequency[1]), growth: padded([Math.max(-fastest, Math.min(0, growth[0])), fastest], 0.1, least) };
  }

  #all() {
    const { mu, modes } = this.curves;
    const x = [mu[0], mu[mu.length - 1]];
    const [frequency, growth] = ["frequency_hz", "growth_rate_per_s"].map((quantity) => this.#span(modes.map((mode) => mode.id), quantity, x));
    return { x, frequency: padded(frequency, 0.05), growth: padded(growth, 0.07) };
  }

  /** Smallest and largest value of some modes over a range of friction coefficients. */
  #span(ids, quantity, [from, to]) {
    let [low, high] = [Infinity, -Infinity];
    for (const mode of this.curves.modes) {
      if (!ids.includes(mode.id)) continue;
      this.curves.mu.forEach((mu, k) => {
        const value = mode[quantity][k];
        if (mu < from || mu > to || !known(value)) return;
        low = Math.min(low, value);
        high = Math.max(high, value);
      });
    }
    return low <= high ? [low, high] : [0, 1];
  }

  /** Whether the near range must be chosen again. It does not follow every state. */
  #outgrown() {
    const [low, high] = this.limits.x;
    const margin = 0.03 * (high - low);
    const [first, last] = [this.curves.mu[0], this.curves.mu.at(-1)];
    const points = this.#points();
    const inSight = (mu) => (mu >= low + margin || low <= first) && (mu <= high - margin || high >= last);
    const width = Math.max(...points) - Math.min(...points);
    return !points.every(inSight) || width + 0.08 * (last - first) < 0.35 * (high - low) || String(this.#focus()) !== String(this.focus);
  }

  #plot(element, label, quantity, axis) {
    const { mu, modes } = this.curves;
    const ink = colour("--muted");
    const grid = { stroke: colour("--grid"), width: 1 };
    const px = Math.round(parseFloat(getComputedStyle(element).fontSize) * 0.78);
    const font = `${px}px system-ui, sans-serif`;
    const size = this.#size(element);
    const growth = axis === "growth";
    // All growth rates together span decades: their axis is compressed around zero.
    const compressed = growth && this.range === "all";
    const values = (_, ticks) => labels(ticks);
    const decades = (_, axis, low, high) => [0, 1, 2, 3, 4, 5].flatMap((power) => [-(10 ** power), 10 ** power]).concat(0).filter((tick) => tick >= low && tick <= high && Math.abs(tick) !== 1).sort((a, b) => a - b);
    const spaced = compressed ? { splits: decades, filter: (_, ticks) => ticks, values: (_, ticks) => ticks.map((tick) => fixed(tick, 0)) } : { values };
    const [min, max] = this.limits.x;
    const u = new uPlot({
      ...size,
      padding: [8, 5 * px, 0, 0],
      pxAlign: 0,
      legend: { show: false },
      cursor: { show: false },
      scales: {
        x: { time: false, min, max, auto: false, range: (_, low, high) => [low, high] },
        y: { distr: compressed ? 4 : 1, asinh: 1, range: () => this.limits[axis] },
      },
      axes: [
        { stroke: ink, grid, ticks: grid, font, labelFont: font, label: growth ? undefined : "friction coefficient μ", labelSize: growth ? 0 : 1.7 * px, size: 2.3 * px, values: (_, ticks) => labels(ticks) },
        { stroke: ink, grid, ticks: grid, font, labelFont: font, label: compressed ? "growth, 1/s (asinh)" : label, labelSize: 1.7 * px, size: 4.8 * px, space: 1.6 * px, ...spaced },
      ],
      series: [{}, ...modes.map((mode) => ({ stroke: modeColour(mode.id), width: this.focus.includes(mode.id) ? 2.5 : 1.25, dash: DASHES[Math.floor(mode.id / 7) % DASHES.length], points: { show: false } }))],
      hooks: { drawClear: [(u) => this.#shade(u, growth)], draw: [(u) => this.#name(u, quantity, growth, font, px)] },
    }, [mu, ...modes.map(quantity)], element);
    const box = (name, kind = "div") => {
      const part = document.createElement(kind);
      part.className = name;
      u.over.append(part);
      return part;
    };
    const [spread, line, read, dots] = [box("mu-spread"), box("mu-cursor"), box("mu-read"), box("mu-dots", "canvas")];
    dots.setAttribute("aria-hidden", "true");
    read.hidden = true;
    return { u, element, spread, line, read, dots, axis };
  }

  /** Draws what is behind the curves: the windows of instability, and the line of zero growth. */
  #shade(u, zero) {
    const { ctx } = u;
    const { left, top, width, height } = u.bbox;
    ctx.save();
    ctx.beginPath();
    ctx.rect(left, top, width, height);
    ctx.clip();
    ctx.lineWidth = devicePixelRatio;
    for (const window of this.curves.windows) {
      const from = u.valToPos(window.mu_from, "x", true);
      const to = known(window.mu_to) ? u.valToPos(window.mu_to, "x", true) : left + width;
      ctx.fillStyle = colour("--window");
      ctx.fillRect(from, top, to - from, height);
      ctx.strokeStyle = colour("--window-edge");
      ctx.setLineDash([6 * devicePixelRatio, 4 * devicePixelRatio]);
      ctx.strokeRect(from, top - 2, to - from, height + 4);
    }
    ctx.setLineDash([]);
    if (zero) {
      ctx.fillStyle = colour("--muted");
      ctx.fillRect(left, u.valToPos(0, "y", true), width, devicePixelRatio);
    }
    ctx.restore();
  }

  /** Labels each mode at the right end of its line if there is room, modes in focus first. */
  #name(u, quantity, growth, font, px) {
    const { ctx } = u;
    const { left, top, width, height } = u.bbox;
    const { mu, modes } = this.curves;
    const end = u.scales.x.max;
    const last = mu.findLastIndex((value) => value <= end);
    // The growth rates of all other modes are close to zero.
    const named = growth ? modes.filter((mode) => this.focus.includes(mode.id)) : modes;
    const ends = named
      .map((mode) => ({ id: mode.id, value: quantity(mode)[last], focus: this.focus.includes(mode.id) }))
      .filter(({ value }) => known(value))
      .map((name) => ({ ...name, y: u.valToPos(name.value, "y", true) }))
      .filter(({ y }) => y >= top && y <= top + height)
      .sort((a, b) => b.focus - a.focus || a.id - b.id);
    const room = 1.05 * px * uPlot.pxRatio;
    const placed = [];
    for (const name of ends) {
      const near = placed.find((other) => Math.abs(other.y - name.y) < room);
      if (!near) placed.push({ ...name, ids: [name.id] });
      // Merged modes share a line and its label.
      else if (name.focus && Math.abs(near.y - name.y) < 0.5 * room && near.ids.length < 2) near.ids.push(name.id);
    }
    ctx.save();
    ctx.font = font.replace(/^[\d.]+/, (size) => String(size * uPlot.pxRatio));
    ctx.textBaseline = "middle";
    ctx.textAlign = "left";
    for (const { ids, y, focus } of placed) {
      ctx.fillStyle = modeColour(ids[0]);
      ctx.fillRect(left + width + 2 * uPlot.pxRatio, y - 1.5 * uPlot.pxRatio, 5 * uPlot.pxRatio, 3 * uPlot.pxRatio);
      ctx.fillStyle = colour(focus ? "--ink" : "--muted");
      ctx.fillText(`m${ids.join(",")}`, left + width + 10 * uPlot.pxRatio, y);
    }
    ctx.restore();
  }

  #size(element) {
    return { width: Math.max(200, element.clientWidth), height: Math.max(90, element.clientHeight) };
  }

  #resize() {
    for (const { u, element } of this.plots) {
      const size = this.#size(element);
      if (size.width !== u.width || size.height !== u.height) u.setSize(size);
    }
    if (this.state) this.cursor(this.state);
    this.#readAt(this.read);
  }

  /** Moves the cursor to the present conditions, with a dot for each mode. */
  cursor(state) {
    this.state = state;
    if (!this.plots.length) return;
    if (this.range === "near" && this.#outgrown()) return this.draw();
    const { mu, spread } = state;
    const shown = known(mu);
    for (const plot of this.plots) {
      plot.line.hidden = plot.dots.hidden = !shown;
      plot.spread.hidden = !shown || !spread;
      if (!shown) continue;
      const x = plot.u.valToPos(mu, "x").toFixed(1);
      plot.line.style.transform = plot.dots.style.transform = `translateX(${x}px)`;
      if (spread) {
        const [low, high] = spread.map((value) => plot.u.valToPos(value, "x"));
        plot.spread.style.transform = `translateX(${low.toFixed(1)}px) scaleX(${Math.max(1, high - low).toFixed(1)})`;
      }
      this.#dots(plot, state.modes ?? []);
    }
  }

  /** A strip as wide as a dot that moves with the cursor; redrawn when a dot moves up or down. */
  #dots({ u, dots, axis }, modes) {
    const ratio = devicePixelRatio;
    const [width, height] = [Math.round(2 * REACH * ratio), Math.round(u.bbox.height * ratio / uPlot.pxRatio)];
    const place = ([id, [hz, sigma]]) => [id, Math.round(u.valToPos(axis === "growth" ? sigma : hz, "y") * ratio) / ratio];
    // Modes in focus are drawn above the others.
    const places = [...modes].sort((a, b) => this.focus.includes(a[0]) - this.focus.includes(b[0])).map(place);
    const picture = `${height} ${colour("--panel")} ${places}`;
    if (dots.picture === picture) return;
    dots.picture = picture;
    if (dots.width !== width || dots.height !== height) [dots.width, dots.height] = [width, height];
    const ctx = dots.getContext("2d");
    ctx.setTransform(ratio, 0, 0, ratio, 0, 0);
    ctx.clearRect(0, 0, 2 * REACH, height);
    ctx.lineWidth = 1.5;
    ctx.strokeStyle = colour("--panel");
    for (const [id, y] of places) {
      ctx.fillStyle = modeColour(id);
      ctx.beginPath();
      ctx.arc(REACH, y, this.focus.includes(id) ? 4.5 : 3, 0, 2 * Math.PI);
      ctx.fill();
      ctx.stroke();
    }
  }

  #point(event) {
    const plot = this.plots.find(({ u }) => u.over.contains(event.target));
    if (!plot) return this.#readAt(null);
    const { left, top } = plot.u.over.getBoundingClientRect();
    this.#readAt(plot.u.posToVal(event.clientX - left, "x"), { axis: plot.axis, u: plot.u, y: event.clientY - top });
  }

  #key(event) {
    if (!this.limits || event.ctrlKey || event.metaKey || event.altKey) return;
    const [low, high] = this.limits.x;
    const from = this.read ?? this.state?.mu ?? low;
    const step = (high - low) / STEPS;
    const to = { ArrowLeft: from - step, ArrowDown: from - step, ArrowRight: from + step, ArrowUp: from + step, PageDown: from - 10 * step, PageUp: from + 10 * step, Home: low, End: high, Escape: null }[event.key];
    if (to === undefined) return;
    event.preventDefault();
    this.#readAt(to);
  }

  /** Reads the curves at a friction coefficient; `pointed` is the position of the pointer. */
  #readAt(mu, pointed) {
    const { limits, curves } = this;
    this.read = known(mu) && limits ? Math.min(limits.x[1], Math.max(limits.x[0], mu)) : null;
    for (const { u, read } of this.plots) {
      read.hidden = this.read === null;
      if (this.read !== null) read.style.transform = `translateX(${u.valToPos(this.read, "x").toFixed(1)}px)`;
    }
    const plots = at("map-plots");
    if (limits) {
      plots.setAttribute("aria-valuemin", limits.x[0]);
      plots.setAttribute("aria-valuemax", limits.x[1]);
      plots.setAttribute("aria-valuenow", this.read ?? this.state?.mu ?? limits.x[0]);
    }
    const text = this.read === null || !curves ? "" : this.#values(this.read, pointed);
    put(at("map-readout"), text || (curves ? "Point at the map, or focus it and use the arrow keys, to read values off." : ""));
    plots.setAttribute("aria-valuetext", text || "nothing read off");
  }

  /** The values at a friction coefficient as text: of the visible modes nearest to the pointer, or growing fastest. */
  #values(mu, pointed) {
    const { mu: grid, modes } = this.curves;
    const after = Math.max(1, grid.findIndex((value) => value >= mu));
    const share = (mu - grid[after - 1]) / (grid[after] - grid[after - 1]);
    const between = (values) => (known(values[after - 1]) && known(values[after]) ? values[after - 1] + share * (values[after] - values[after - 1]) : null);
    const [low, high] = this.limits.frequency;
    const found = modes
      .map((mode) => ({ id: mode.id, hz: between(mode.frequency_hz), growth: between(mode.growth_rate_per_s) }))
      .filter(({ hz }) => known(hz) && hz >= low && hz <= high);
    const away = ({ hz, growth }) => (pointed ? Math.abs(pointed.u.valToPos(pointed.axis === "growth" ? growth : hz, "y") - pointed.y) : -growth);
    const near = found.sort((a, b) => away(a) - away(b)).slice(0, MOST_READ).sort((a, b) => a.id - b.id);
    const texts = near.map(({ id, hz, growth }) => `mode ${id}: ${fixed(hz, hz >= 100 ? 1 : 4)} Hz, ${signed(growth, 2)} 1/s`);
    return `μ ${fixed(mu, 4)}   ${texts.join("   ")}`;
  }
}

/** A range with padding at both ends and a minimum width. */
function padded([low, high], share, least = 0) {
  const span = Math.max(high - low, least, 1e-3 * Math.abs(high), 1e-9);
  const middle = 0.5 * (low + high);
  return [middle - (0.5 + share) * span, middle + (0.5 + share) * span];
}
