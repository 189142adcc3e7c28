// Serves the page with made-up answers: every status, at once and the same each time. A rig like the embedded tribometer:
// modes 1 and 2 merge at 740 Hz in a narrow window, modes 14 and 15 at 3110 Hz where they grow 30 times as fast.
import { readFileSync } from "node:fs";
import { createServer } from "node:http";
import { extname, join } from "node:path";

const TYPES = { ".html": "text/html; charset=utf-8", ".css": "text/css; charset=utf-8", ".js": "text/javascript; charset=utf-8", ".svg": "image/svg+xml" };
const TAU = 2 * Math.PI;
/** Everything happened about this time, s since the epoch. */
const NOW = 1_700_000_000;
const BIN_S = 0.2;

/** Modes at rest, Hz, with what friction adds to each, Hz. */
const SINGLE = [[318, 4], [1120, 9], [1184, -6], [1410, 0], [1622, 12], [1875, -14], [2050, 3], [2231, 6], [2466, -9], [2590, 4], [2740, 2], [2905, -5]];
/** Pairs that merge: frequency, half their distance in it at no friction, first and last friction coefficient of the window. */
const PAIRS = [{ hz: 740, apart: 45, from: 0.663, to: 0.842 }, { hz: 3110, apart: 30, from: 0.788, to: undefined }];

const [IDS_SINGLE, IDS_PAIRS] = [[0, 3, 4, 5, 6, 7, 8, 9, 10, 11, 12, 13], [[1, 2], [14, 15]]];
const DAMPING = 1e-4;

/** Frequency and growth rate of every mode: λ² = s ± √d for a pair. */
export function modesAt(mu) {
  const modes = SINGLE.map(([hz, by], k) => [IDS_SINGLE[k], hz + by * mu, -DAMPING * TAU * hz]);
  PAIRS.forEach(({ hz, apart, from, to = Infinity }, p) => {
    // Proportional to the discriminant: 1 at no friction, 0 at the ends of the window.
    const d = (1 - mu / from) * (to === Infinity ? 1 : 1 - mu / to);
    const reach = apart * Math.sqrt(Math.abs(d));
    const [below, above] = IDS_PAIRS[p];
    const decay = -DAMPING * TAU * hz;
    if (d >= 0) modes.push([below, hz - reach, decay], [above, hz + reach, decay]);
    else modes.push([below, hz, decay + TAU * reach], [above, hz, decay - TAU * reach]);
  });
  return modes.sort((a, b) => a[0] - b[0]);
}

function map() {
  const mu = Array.from({ length: 401 }, (_, k) => k / 400);
  const at = mu.map(modesAt);
  const modes = at[0].map(([id], k) => ({ id, frequency_hz: at.map((all) => all[k][1]), growth_rate_per_s: at.map((all) => all[k][2]) }));
  const windows = PAIRS.map(({ hz, from, to = null }, p) => ({ mu_from: from, mu_to: to, frequency_hz: hz, kind: "flutter", mode_ids: IDS_PAIRS[p] }));
  return { normal_load_n: 500, disc_speed_rad_s: 13, mu, modes, windows, critical_friction: PAIRS[0].from, resolution: 1e-4, complete: true };
}

/** Displacements of pad and disc at the contact: a plane that tilts and a wave below it. */
function shape(id) {
  const nodes = [];
  for (let i = 0; i < 8; i++) for (let j = 0; j < 11; j++) nodes.push([0.088 + 0.026 * i / 7, 0, -0.02 + 0.04 * j / 10]);
  const part = (name, size, lag) => {
    const [re, im] = [[], []];
    for (const [x, , z] of nodes) {
      const phase = 120 * z * (1 + id % 3) + lag;
      re.push(0.3 * size * Math.cos(phase), size * Math.cos(phase), 20 * size * (x - 0.1));
      im.push(0.3 * size * Math.sin(phase), size * Math.sin(phase), 0);
    }
    return { name, spatial: true, nodes_m: nodes, re, im };
  };
  const [hz, growth] = modesAt(0.7).find((mode) => mode[0] === id).slice(1);
  const disc = { axis_point_m: [0, 0, 0], axis_direction: [0, 1, 0], normal: [0, 1, 0] };
  const growth_change = { friction: 1.31, load: 0, speed: 0, contact_stiffness: -2.04, contact_damping: 0 };
  return { id, frequency_hz: hz, growth_rate_per_s: growth, pad_share: 0.31, growth_change, disc, parts: [part("pad", 0.4, 0), part("disc", 1, 1)] };
}

/** Forces of pairs on a sector: larger at the leading edge, open at the trailing one. */
function contact() {
  const [places, force_n] = [[], []];
  for (let i = 0; i < 6; i++) for (let j = 0; j < 11; j++) {
    places.push({ along_m: 0.004 * (j - 5), outward_m: 0.005 * (i - 2.5), opposite: false });
    force_n.push(Math.max(0, 20 - 3 * j + i));
  }
  const contact_force_n = force_n.reduce((sum, force) => sum + force, 0);
  return { normal_load_n: 500.2, disc_speed_rad_s: 13.04, friction_coefficient: 0.42, pairs_closed: force_n.filter((force) => force > 0).length, contact_force_n, back_force_n: 500.2, force_n, places };
}

/** The node's prediction at a friction coefficient. */
function predicted(mu, seq) {
  const modes = modesAt(mu);
  const unstable = modes.filter((mode) => mode[2] > 0).sort((a, b) => b[2] - a[2]);
  const fastest = unstable[0];
  const inside = fastest && PAIRS[fastest[0] === 1 ? 0 : 1];
  const ends = PAIRS.flatMap(({ from, to }, p) => [[from, p], [to, p]]).filter(([end]) => end !== undefined);
  const [end, p] = inside ? [inside.from, PAIRS.indexOf(inside)] : ends.reduce((near, next) => (Math.abs(next[0] - mu) < Math.abs(near[0] - mu) ? next : near));
  const margin = inside ? -(mu - end) : Math.abs(end - mu);
  const level = inside ? 2 : margin < 0.05 ? 1 : 0;
  const next = { ids: IDS_PAIRS[p], frequency_hz: PAIRS[p].hz, mu: end, margin, error: 1e-6, inside: Boolean(inside) };
  const said = ["no mode grows", `modes ${next.ids.join(" and ")} merge near ${next.frequency_hz.toFixed(1)} Hz at μ ${end.toFixed(4)}, ${margin.toFixed(4)} from here`, fastest && `mode ${fastest[0]} grows at ${fastest[1].toFixed(1)} Hz by ${fastest[2].toFixed(1)} 1/s`];
  return {
    status: ["ok", "warn", "squeal"][level], message: said[level], level, reason: level ? said[level] : "", seq, stamp_s: NOW, reused: false,
    load: 500.2, speed: 13.04, mu, critical: PAIRS[0].from, margin, growth: Math.max(...modes.map((mode) => mode[2])),
    worst_hz: fastest?.[1] ?? null, unstable: unstable.length,
    fastest: fastest ? { id: fastest[0], frequency_hz: fastest[1], growth_rate_per_s: fastest[2] } : null, next,
    modes: modes.map(([id, hz, growth]) => [id, [hz, growth, -growth / (TAU * hz), id % 5 / 5, 1e-9, 1e-8]]),
    spread: [mu - 0.004, mu + 0.003], trend_per_s: level ? -0.01 : 0.001,
  };
}

/** The answer for a moment without data. */
const blank = (level, reason) => ({ level, reason, seq: 40, stamp_s: NOW, reused: false, load: null, speed: null, mu: null, critical: null, margin: null, growth: null, worst_hz: null, unstable: 0, modes: [], fastest: null, next: null, spread: null, trend_per_s: null });

const FAULT = "normal load -5 N is below its limit of 0 N";
const COUNTERS = { solved: 12, charted: 5003, reused: 201, faults: 0, passed_over: 0, ros2_falls: 0 };
const state = (what) => ({ time_s: NOW, age_s: 0.02, rate_hz: 200, warn_margin: 0.05, map: 1, events: 1, temperature: null, counters: COUNTERS, simulated: false, ...what });

export const SITUATIONS = {
  ok: state(predicted(0.42, 5216)),
  warn: state({ ...predicted(0.641, 5216), temperature: { celsius: 183.44, of_rig: 182, stale: false } }),
  squeal: state({ ...predicted(0.72, 5216), temperature: { celsius: 183.44, of_rig: null, stale: true } }),
  worst: state(predicted(0.93, 5216)),
  fault: state({ ...blank(3, FAULT), status: "fault", message: FAULT, load: -5, speed: 13.04, mu: 0.42 }),
  waiting: state({ age_s: null, rate_hz: 0, map: 0, events: 0, status: "waiting", message: "no input was received yet", counters: { solved: 0, charted: 0, reused: 0, faults: 1, passed_over: 0, ros2_falls: 0 }, spread: null, trend_per_s: null, fastest: null, next: null }),
  inactive: state({ age_s: null, rate_hz: 0, map: 0, events: 0, status: "inactive", message: "inactive: it waits to be activated over ROS 2", counters: { solved: 0, charted: 0, reused: 0, faults: 1, passed_over: 0, ros2_falls: 0 }, spread: null, trend_per_s: null, fastest: null, next: null }),
  no_data: state({ ...blank(3, "no input for 1 s"), age_s: 5.4, rate_hz: 0, status: "no_data", message: "operating points came and stopped" }),
};

/** Five minutes that end with the situation, friction rising and falling before. */
function history(situation) {
  if (["waiting", "inactive"].includes(situation)) return { bin_s: BIN_S, bins: [] };
  const last = Math.floor(NOW / BIN_S);
  const ends = SITUATIONS[situation].mu ?? 0.6;
  const bins = [];
  for (let k = last - 1500; k <= last; k++) {
    const left = (last - k) / 1500;
    const mu = ends + (situation === "no_data" || situation === "fault" ? 0 : 1) * 0.25 * Math.sin(9 * left) * Math.min(1, 6 * left);
    const { margin, growth, level, modes } = predicted(mu, k);
    const silent = situation === "no_data" && last - k < 27;
    if (silent) continue;
    const failed = situation === "fault" && last - k < 40;
    const around = (value, by) => (failed ? null : [value - by, value + by]);
    bins.push({ k, r: [around(500, 1.5), around(13, 0.02), around(mu, 0.003), around(growth, 0.02 * Math.abs(growth)), around(margin, 0.003)], l: failed ? 3 : level, u: failed ? [] : modes.filter(([, [, sigma]]) => sigma > 0).sort((a, b) => b[1][1] - a[1][1]).map(([, [hz, sigma]]) => [hz, sigma]) });
  }
  return { bin_s: BIN_S, bins };
}

const moment = (time_s, mu) => {
  const { fastest, load, speed, critical } = predicted(mu, 0);
  return { time_s, mode_id: fastest.id, frequency_hz: fastest.frequency_hz, growth_rate_per_s: fastest.growth_rate_per_s, normal_load_n: load, disc_speed_rad_s: speed, friction_coefficient: mu, critical_friction: critical };
};
const nothing = (time_s) => ({ time_s, mode_id: null, frequency_hz: null, growth_rate_per_s: null, normal_load_n: null, disc_speed_rad_s: null, friction_coefficient: null, critical_friction: null });
const events = () => [{ number: 1, kind: "SQUEAL", onset_s: NOW - 80, end_s: NOW - 60, interruptions: 0, input_seq: 1200, modes: [{ id: 1, low_hz: 739, high_hz: 741 }], reason: null, onset: moment(NOW - 80, 0.664), peak: moment(NOW - 71, 0.75) }, { number: 2, kind: "FAULT", onset_s: NOW - 40, end_s: NOW - 39, interruptions: 0, input_seq: 9200, modes: [], reason: FAULT, onset: { ...nothing(NOW - 40), normal_load_n: -5, disc_speed_rad_s: 13.04, friction_coefficient: 0.42 }, peak: null }];

const once = (name, heading, unit = "") => ({ name, heading, unit, moment: null });
const ofMoment = (name, heading, unit, decimals, from_onset = false) => ({ name, heading, unit, moment: { decimals, from_onset } });
const event_columns = [
  once("number", "no."), once("kind", "event"), once("onset_utc", "onset"), once("end_utc", "end"), once("duration_s", "duration", "s"),
  ofMoment("mode_id", "mode", "fastest", [0, 0]), ofMoment("frequency_hz", "frequency", "Hz", [1, 5]), ofMoment("normal_load_n", "load", "N", [1, 1]),
  ofMoment("disc_speed_rad_s", "speed", "rad/s", [2, 2]), ofMoment("friction_coefficient", "μ", "onset → fastest", [4, 4], true), once("reason", "reason"),
];

const about = { kind: "live", rig: "tribometer", content_hash: "0".repeat(64), version: "0.1.0", band_max_hz: 4000, mu_max: 1, warn_margin: 0.05, instability_threshold: 1e-6, vibration_threshold_db: 70, span_s: null, notes: [], event_columns, contact_state: false, simulated: false, inputs: { places: ["/rig/operating_point (ROS 2, domain 0)", "rig/operating_point (shared memory)"], start: "squealcast simulate" } };

/** Serves the page of `assets` in a situation, which `turn` changes. */
export function serve(assets, situation, more = {}) {
  let streams = [];
  const send = (stream) => stream.write(`data: ${JSON.stringify(SITUATIONS[situation])}\n\n`);
  const answers = {
    "/about.json": () => ({ ...about, ...more }),
    "/state.json": () => SITUATIONS[situation],
    "/history.json": () => history(situation),
    "/events.json": () => (["waiting", "inactive"].includes(situation) ? [] : events()),
    "/squeals-in-sound.json": () => [],
    "/comparison.json": () => null,
    "/sound.json": () => ({ channels: [], scores: [] }),
    "/map.json": map,
    "/contact.json": contact,
    "/shape.json": (query) => shape(Number(query.get("id"))),
  };
  const server = createServer((request, response) => {
    const { pathname, searchParams } = new URL(request.url, "http://localhost");
    if (pathname === "/stream") {
      response.writeHead(200, { "content-type": "text/event-stream" });
      streams.push(response);
      return send(response);
    }
    if (answers[pathname]) {
      response.writeHead(200, { "content-type": "application/json" });
      return response.end(JSON.stringify(answers[pathname](searchParams)));
    }
    try {
      const file = join(assets, pathname === "/" ? "index.html" : pathname.replaceAll("..", ""));
      response.writeHead(200, { "content-type": TYPES[extname(file)] ?? "text/plain" });
      response.end(readFileSync(file));
    } catch {
      response.writeHead(404).end();
    }
  });
  // As often as a quiet node.
  const ticks = setInterval(() => streams.forEach(send), 200);
  return new Promise((ready) => server.listen(0, "127.0.0.1", () => ready({
    url: `http://127.0.0.1:${server.address().port}/`,
    turn(other) { situation = other; },
    /** The node stops sending without closing the connection. */
    hang() { clearInterval(ticks); },
    stop() { clearInterval(ticks); server.closeAllConnections(); server.close(); },
  })));
}

/** The fields of every answer, and the columns of the events, to be compared with those of a node. */
export function fields() {
  const of = (answer) => Object.keys(answer).sort();
  const curves = map();
  const mode = shape(1);
  return { state: of(SITUATIONS.squeal), fastest: of(SITUATIONS.squeal.fastest), next: of(SITUATIONS.squeal.next), about: of(about), map: of(curves), curve: of(curves.modes[0]), window: of(curves.windows[0]), shape: of(mode), part: of(mode.parts[0]), contact: of(contact()), place: of(contact().places[0]), growth_change: of(mode.growth_change), disc: of(mode.disc), event: of(events()[0]), moment: of(events()[0].onset), event_columns };
}
