// Status in words, colour and shape; the gauge of the margin; the numbers.

import { Decimals, LEVELS, fixed, known, leastGrowth, put, signed } from "./format.js";

const WORDS = ["OK", "WARN", "SQUEAL", "FAULT"];
const CALM = "quiet: no mode grows";
const at = (id) => document.getElementById(id);

export class Status {
  constructor(about) {
    this.warn = about.warn_margin;
    this.reach = 0;
    this.decimals = { growth: new Decimals(4, 2), worst: new Decimals(6, 1), load: new Decimals(5, 1), speed: new Decimals(4, 2) };
    this.#scale(Math.max(0.1, 2 * this.warn));
  }

  /** The level at once, and its reason with it. */
  level(level, reason) {
    const name = LEVELS[level] ?? "none";
    const panel = at("status");
    if (panel.dataset.level !== name) {
      this.#reason(level, reason);
      panel.dataset.level = name;
      document.documentElement.dataset.level = name;
      at("status-shape").setAttribute("href", `#shape-${name}`);
      at("level").textContent = WORDS[level] ?? "WAITING";
    }
  }

  #reason(level, reason) {
    if (level !== undefined) put(at("reason"), reason || CALM);
  }

  /** No connection: what is shown is old. */
  disconnected(gone) {
    const panel = at("status");
    if (panel.classList.contains("stale") === gone) return;
    panel.classList.toggle("stale", gone);
    if (!gone) return;
    // An old OK must not be taken for a new one. The next state brings its own level.
    const before = WORDS[LEVELS.indexOf(panel.dataset.level)];
    panel.dataset.level = "none";
    at("status-shape").setAttribute("href", "#shape-none");
    at("level").textContent = "NO DATA";
    put(at("reason"), before ? `no connection to the node; the last was ${before}` : "no connection to the node");
  }

  needle(state) {
    const { margin, trend_per_s: trend, warn_margin: warn } = state;
    if (known(warn) && warn !== this.warn) {
      this.warn = warn;
      this.#scale(Math.max(this.reach, 2 * warn));
    }
    const needle = at("gauge-needle");
    needle.classList.toggle("none", !known(margin));
    at("gauge-trail").classList.toggle("none", !known(margin) || !known(trend));
    if (!known(margin)) return;
    if (Math.abs(margin) > this.reach) this.#scale(Math.abs(margin));
    const x = this.#x(margin);
    needle.style.transform = `translateX(${x.toFixed(2)}%)`;
    if (known(trend)) {
      const length = this.#x(margin + trend) - x;
      at("gauge-trail").style.transform = `translateX(${x.toFixed(2)}%) scaleX(${(length / 100).toFixed(4)})`;
    }
  }

  numbers(state, age) {
    const { growth, worst, load, speed } = this.decimals;
    for (const [, [hz]] of state.modes ?? []) growth.of(leastGrowth(hz));
    // Its numbers change with every state; nobody reads as fast.
    if (!at("status").classList.contains("stale")) this.#reason(state.level, state.reason);
    put(at("margin"), signed(state.margin, 4), state.margin);
    put(at("mu"), fixed(state.mu, 4), state.mu);
    put(at("critical"), fixed(state.critical, 4), state.critical);
    put(at("growth"), growth.text(state.growth), state.growth);
    put(at("worst"), worst.text(state.worst_hz), state.worst_hz);
    put(at("load"), load.text(state.load), state.load);
    put(at("speed"), speed.text(state.speed), state.speed);
    put(at("unstable"), fixed(state.unstable, 0), state.unstable);
    put(at("age"), known(age) ? fixed(age, 1) : "–", age);
    put(at("seq"), known(state.seq) ? String(state.seq) : "–", state.seq);
    put(at("rate"), fixed(state.rate_hz, 0), state.rate_hz);
    const c = state.counters;
    if (c) put(at("counters"), `${c.solved} solved, ${c.charted} charted, ${c.reused} reused, ${c.faults} faults, ${c.passed_over} passed over`);
    this.#trend(state);
  }

  #trend(state) {
    const { trend_per_s: slope, margin } = state;
    const element = at("trend");
    const slow = 0.005;
    const kind = !known(slope) || !known(margin) ? "none" : Math.abs(slope) < slow ? "steady" : slope > 0 ? "rising" : "falling";
    element.dataset.trend = kind;
    const arrow = { none: "", steady: "▬ steady", rising: "▲ rising", falling: "▼ falling" }[kind];
    put(element, arrow);
  }

  /** Place on the gauge, %. */
  #x(margin) {
    return 50 + 47.5 * Math.max(-1, Math.min(1, margin / this.reach));
  }

  /** The scale only grows, in steps: it does not follow the needle about. */
  #scale(reach) {
    const steps = [0.1, 0.2, 0.5, 1, 2, 5, 10, 20, 50, 100];
    this.reach = steps.find((step) => step >= reach) ?? reach;
    const warn = this.#x(this.warn);
    at("gauge-warn").style.width = `${Math.max(0, warn - 50)}%`;
    at("gauge-ok").style.left = `${warn}%`;
    put(at("gauge-low"), fixed(-this.reach, 1));
    put(at("gauge-high"), signed(this.reach, 1));
  }
}
