// Growth rates and frequencies against the friction coefficient, with the present one as a moving cursor.

import { colour, fixed, known, labels, modeColour, put } from "./format.js";

/** Seven colours; beyond that, dashes tell the modes apart. */
const DASHES = [undefined, [8, 4], [2, 3]];
/** From the middle of a dot to the edge of its strip, px. */
const REACH = 6;

const at = (id) => document.getElementById(id);

export class StabilityMap {
  constructor(about) {
    this.muMax = about.mu_max;
    this.plots = [];
    this.curves = null;
    this.highest = 0;
    this.range = "near";
    at("map-range").addEventListener("change", (event) => {
      this.range = event.target.value;
      this.#zoom();
    });
    new ResizeObserver(() => this.#resize()).observe(at("map-growth"));
  }

  /** A new map. */
  show(curves) {
    this.curves = curves;
    const { normal_load_n: load, disc_speed_rad_s: speed, critical_friction: critical } = curves;
    const judged = known(critical) ? `critical μ ${fixed(critical, 4)}` : "stable in the whole range";
    put(at("map-note"), `${fixed(load, 0)} N, ${fixed(speed, 2)} rad/s: ${judged}${curves.complete ? "" : " (search cut short)"}`);
    this.draw();
  }

  /** Builds the plots anew, in the colours of the day. */
  draw() {
    for (const plot of this.plots) plot.u.destroy();
    this.plots = [];
    if (!this.curves) return;
    this.plots = [
      this.#plot(at("map-growth"), "growth rate, 1/s", (mode) => mode.growth_rate_per_s, true),
      this.#plot(at("map-frequency"), "frequency, Hz", (mode) => mode.frequency_hz, false),
    ];
    this.#resize();
    if (this.state) this.cursor(this.state);
  }

  #limits() {
    const { mu, critical_friction: critical } = this.curves;
    const last = mu[mu.length - 1];
    if (this.range === "all") return [mu[0], last];
    const wanted = Math.max(known(critical) ? 1.6 * critical : 0, 1.15 * this.highest, 0.05);
    const step = 10 ** Math.floor(Math.log10(wanted)) / 4;
    return [mu[0], Math.min(last, Math.ceil(wanted / step) * step)];
  }

  #zoom() {
    if (!this.curves) return;
    const [min, max] = this.#limits();
    for (const { u } of this.plots) u.setScale("x", { min, max });
    if (this.state) this.cursor(this.state);
  }

  #plot(element, label, quantity, zero) {
    const { mu, modes, windows } = this.curves;
    const ink = colour("--muted");
    const grid = { stroke: colour("--grid"), width: 1 };
    const px = Math.round(parseFloat(getComputedStyle(element).fontSize) * 0.78);
    const font = `${px}px system-ui, sans-serif`;
    const [min, max] = this.#limits();
    const wash = colour("--window");
    const edge = colour("--window-edge");
    const shade = (u) => {
      const { ctx } = u;
      const { left, top, width, height } = u.bbox;
      ctx.save();
      ctx.beginPath();
      ctx.rect(left, top, width, height);
      ctx.clip();
      for (const window of windows) {
        const from = u.valToPos(window.mu_from, "x", true);
        const to = known(window.mu_to) ? u.valToPos(window.mu_to, "x", true) : left + width;
        ctx.fillStyle = wash;
        ctx.fillRect(from, top, to - from, height);
        ctx.strokeStyle = edge;
        ctx.lineWidth = devicePixelRatio;
        ctx.setLineDash([6 * devicePixelRatio, 4 * devicePixelRatio]);
        ctx.strokeRect(from, top - 2, to - from, height + 4);
      }
      ctx.setLineDash([]);
      if (zero) {
        const y = u.valToPos(0, "y", true);
        ctx.strokeStyle = ink;
        ctx.lineWidth = devicePixelRatio;
        ctx.beginPath();
        ctx.moveTo(left, y);
        ctx.lineTo(left + width, y);
        ctx.stroke();
      }
      ctx.restore();
    };
    const size = this.#size(element);
    const values = (_, ticks) => labels(ticks);
    const u = new uPlot({
      ...size,
      padding: [8, 12, 0, 0],
      pxAlign: 0,
      legend: { show: false },
      cursor: { show: false },
      scales: { x: { time: false, min, max, auto: false, range: (_, low, high) => [low, high] }, y: { range: padded } },
      axes: [
        { stroke: ink, grid, ticks: grid, font, labelFont: font, label: zero ? undefined : "friction coefficient μ", labelSize: zero ? 0 : 1.7 * px, size: 2.3 * px, values },
        { stroke: ink, grid, ticks: grid, font, labelFont: font, label, labelSize: 1.7 * px, size: 5.8 * px, values },
      ],
      series: [{}, ...modes.map((mode) => ({ stroke: modeColour(mode.id), width: 2, dash: DASHES[Math.floor(mode.id / 7) % DASHES.length], points: { show: false } }))],
      hooks: { drawClear: [shade] },
    }, [mu, ...modes.map(quantity)], element);
    const spread = document.createElement("div");
    spread.className = "mu-spread";
    const line = document.createElement("div");
    line.className = "mu-cursor";
    const dots = document.createElement("canvas");
    dots.className = "mu-dots";
    dots.setAttribute("aria-hidden", "true");
    u.over.append(spread, line, dots);
    return { u, element, spread, line, dots, growth: zero };
  }

  #size(element) {
    return { width: Math.max(200, element.clientWidth), height: Math.max(120, element.clientHeight) };
  }

  #resize() {
    for (const { u, element } of this.plots) {
      const size = this.#size(element);
      if (size.width !== u.width || size.height !== u.height) u.setSize(size);
    }
    if (this.state) this.cursor(this.state);
  }

  /** Moves the cursor to the present conditions, with a dot where each mode is. */
  cursor(state) {
    this.state = state;
    const { mu, spread } = state;
    if (known(mu) && mu > this.highest) {
      this.highest = mu;
      if (this.plots.length && mu > 0.95 * this.plots[0].u.scales.x.max) this.#zoom();
    }
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

  /** A strip as wide as a dot that the cursor carries along; drawn anew where a dot went up or down. */
  #dots({ u, dots, growth }, modes) {
    const ratio = devicePixelRatio;
    const [width, height] = [Math.round(2 * REACH * ratio), Math.round(u.bbox.height * ratio / uPlot.pxRatio)];
    const places = modes.map(([id, [hz, sigma]]) => [id, Math.round(u.valToPos(growth ? sigma : hz, "y") * ratio) / ratio]);
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
      ctx.arc(REACH, y, 4.5, 0, 2 * Math.PI);
      ctx.fill();
      ctx.stroke();
    }
  }
}

function padded(_, low, high) {
  if (!known(low) || !known(high)) return [0, 1];
  const span = Math.max(high - low, 1e-3 * Math.abs(high), 1e-9);
  return [low - 0.07 * span, high + 0.07 * span];
}
