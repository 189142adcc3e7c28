// Status as word, colour and shape; the next squeal; the gauge of the margin; the numbers.

import { Decimals, NONE, asserts, fixed, known, leastGrowth, put, signed } from "./format.js";

const WORDS = { ok: "OK", warn: "WARN", squeal: "SQUEAL", fault: "FAULT", waiting: "WAITING", no_data: "NO DATA", inactive: "INACTIVE" };
/** The statuses in which nothing is received. */
const SILENT = ["waiting", "no_data", "inactive"];
const at = (id) => document.getElementById(id);

/** Where the node expects its inputs, and how to simulate them. */
function listening(inputs) {
  if (!inputs) return "";
  const { places, start } = inputs;
  const text = places.length ? `Listens to ${places.join(" and ")}.` : "Listens to no bus.";
  return start ? `${text} Without a rig, start: ${start}` : text;
}

export class Status {
  constructor(about) {
    this.warn = about.warn_margin;
    this.muMax = about.mu_max;
    this.rig = about.rig;
    this.listening = listening(about.inputs);
    this.reach = 0;
    this.decimals = { growth: new Decimals(4, 2), worst: new Decimals(6, 1), load: new Decimals(5, 1), speed: new Decimals(4, 2) };
    this.#scale(Math.max(0.1, 2 * this.warn));
    this.#show("none", "");
  }

  /** Shows the status immediately, together with its message. */
  level({ status, message }) {
    if (at("status").dataset.level !== status) this.#show(status, message);
  }

  #show(status, message) {
    at("status").dataset.level = status;
    document.documentElement.dataset.level = status;
    at("status-shape").setAttribute("href", `#shape-${SILENT.includes(status) ? "none" : status}`);
    const word = WORDS[status] ?? "CONNECTING";
    at("level").textContent = word;
    document.title = `${word} · ${this.rig} · squealcast`;
    put(at("reason"), message);
  }

  /** Marks the page as outdated while there is no connection. */
  disconnected(gone) {
    const panel = at("status");
    if (panel.classList.contains("stale") === gone) return;
    panel.classList.toggle("stale", gone);
    if (!gone) return;
    // An old OK must not be mistaken for a new one. The next state sets its own level.
    const before = asserts({ status: panel.dataset.level }) ? `; the last was ${WORDS[panel.dataset.level]}` : "";
    this.#show("no_data", `no connection to the node${before}`);
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

  /** `padShare` gives the pad's share of a mode if the prediction does not contain it. */
  numbers(state, age, padShare) {
    const { growth, worst, load, speed } = this.decimals;
    for (const [, [hz]] of state.modes ?? []) growth.of(leastGrowth(hz));
    const fresh = !at("status").classList.contains("stale");
    // The numbers in the message change with every state, too fast to be read.
    if (fresh) put(at("reason"), state.message ?? "");
    this.#answer(state, padShare, fresh);
    put(at("margin"), signed(state.margin, 4), state.margin);
    put(at("mu"), fixed(state.mu, 4), state.mu);
    put(at("growth"), growth.text(state.growth), state.growth);
    put(at("worst"), worst.text(state.worst_hz), state.worst_hz);
    put(at("load"), load.text(state.load), state.load);
    put(at("speed"), speed.text(state.speed), state.speed);
    put(at("unstable"), fixed(state.unstable, 0), state.unstable);
    this.#temperature(state.temperature);
    put(at("age"), known(age) ? fixed(age, 1) : "none yet", age);
    at("age-unit").hidden = !known(age);
    put(at("seq"), known(state.seq) ? String(state.seq) : NONE, state.seq);
    put(at("rate"), fixed(state.rate_hz, 0), state.rate_hz);
    if (state.counters) {
      const { ros2_falls, ...counts } = state.counters;
      const words = Object.entries(counts).map(([name, count]) => `${count} ${name.replaceAll("_", " ")}`);
      if (ros2_falls) words.push(`ROS 2 started again ${ros2_falls}`);
      put(at("counters"), words.join(", "));
    }
    this.#trend(state);
  }

  /** The temperature of the contact, if one was received; the rig's own where it follows with a dead-band. */
  #temperature(temperature) {
    at("temperature-fact").hidden = !temperature;
    if (!temperature) return;
    const { celsius, of_rig: ofRig, stale } = temperature;
    put(at("temperature"), fixed(celsius, 1), celsius);
    put(at("temperature-note"), stale ? "°C, stale" : known(ofRig) ? `°C, rig at ${fixed(ofRig, 1)}` : "°C");
  }

  /** The present or next squeal: the modes, their frequency, the friction coefficient, and the part that moves. */
  #answer(state, padShare, fresh) {
    const { fastest, next, status, mu } = state;
    const answered = asserts(state) && (fastest || next);
    at("answer-facts").hidden = !answered;
    at("answer-text").hidden = Boolean(answered);
    const silent = SILENT.includes(status);
    const listening = status === "inactive" ? this.listening.replace(/^Listens/, "Once active, listens") : this.listening;
    put(at("answer-title"), status === "squeal" ? "Squeals now" : silent ? "Inputs" : "Squeals next");
    if (!answered) {
      const stable = state.map ? `Nothing up to μ ${fixed(this.muMax, 2)}.` : "Not known yet: the stability map is being made.";
      put(at("answer-text"), !fresh ? "" : asserts(state) ? stable : silent ? listening : "Not known: there is no prediction for this input.");
      return;
    }
    const ids = fastest ? [fastest.id] : next.ids;
    const hz = (fastest ?? next).frequency_hz;
    put(at("answer-modes"), ids.length ? ids.join(" + ") : "none: static");
    put(at("answer-modes-name"), ids.length > 1 ? "modes" : "mode");
    put(at("answer-hz"), hz > 0 ? fixed(hz, hz >= 100 ? 1 : 4) : NONE, hz);
    put(at("answer-mu-name"), !next ? "end, μ" : next.inside ? "ends at μ" : mu > next.mu ? "below μ" : "from μ");
    put(at("answer-mu"), fixed(next?.mu, 4), next?.mu);
    const share = (state.modes ?? []).find(([id]) => id === ids[0])?.[1][3] ?? padShare?.(ids[0]);
    const part = share >= 0.5 ? `pad ${fixed(100 * share, 0)} %` : `disc ${fixed(100 * (1 - share), 0)} %`;
    put(at("answer-part"), known(share) ? part : NONE, share);
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

  /** Position on the gauge, %. */
  #x(margin) {
    return 50 + 47.5 * Math.max(-1, Math.min(1, margin / this.reach));
  }

  /** The scale only grows, in steps, so that it does not follow the needle. */
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
