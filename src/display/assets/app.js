// Connects the page with its source: a node's stream of states, or a recording that is queried for moments.

import { next } from "./clock.js";
import { ContactView } from "./contact.js";
import { Events } from "./events.js";
import { History } from "./history.js";
import { StabilityMap } from "./map.js";
import { Modes } from "./modes.js";
import { ShapeView } from "./shape.js";
import { Sound } from "./sound.js";
import { Status } from "./status.js";
import { Timeline } from "./timeline.js";
import { asserts, forgetColours, known } from "./format.js";

const at = (id) => document.getElementById(id);
const ask = async (path) => {
  const answer = await fetch(path);
  if (!answer.ok) throw new Error(await answer.text());
  return answer.json();
};
/** Interval between updates of the numbers, ms: faster changes cannot be read. */
const NUMBERS_EVERY = 300;

// Of several recordings each has its page below its number.
if (/\/\d+\/$/.test(location.pathname)) {
  const { names, number } = await ask("recordings.json");
  const choice = at("recordings");
  choice.append(...names.map((name, k) => new Option(name, k + 1, false, k + 1 === number)));
  choice.closest("label").hidden = false;
  choice.addEventListener("change", () => location.assign(`../${choice.value}/`));
}
const about = await ask("about.json").catch((error) => {
  at("level").textContent = "NO DATA";
  at("reason").textContent = error.message;
  at("link").dataset.link = "gone";
  at("link-text").textContent = "not shown";
  throw error;
});
const recording = about.kind === "recording";
at("rig").textContent = about.rig;
at("simulated").hidden = !about.simulated;

const status = new Status(about);
const map = new StabilityMap(about);
const history = new History(about);
const shape = new ShapeView();
const modes = new Modes(about, choose, () => follow(false));
const contact = new ContactView(about, showContact);
let timeline;
const events = new Events(about, recording ? (moment) => timeline.go(moment) : undefined);

const sound = new Sound(about, history, recording ? (moment) => timeline.go(moment) : undefined);

let latest = null;
let heardAt = 0;
let mapShown = 0;
let eventsShown = -1;
let asking = { map: false, history: false, events: false };

/** Time for which a shape stays before another one is requested, ms. */
const SETTLED = 1500;
/** The same before the shape of another mode is requested, ms. */
const FOLLOWED = 500;

let chosenAt = 0;
let later;
let chosenFor = [];
let choices = 0;
/** Whether the shape shown follows the fastest growing mode, or else the next mode to become unstable. */
let following = true;

/** The conditions, and how far each may change before the shape is requested again. */
const conditions = (state) => [state.mu, state.load, state.speed];
const moved = (now, then) => now.some((value, k) => !(Math.abs(value - then[k]) <= (k ? 0.02 * Math.abs(then[k]) : 0.005)));

async function choose(id) {
  const order = ++choices;
  chosenAt = performance.now();
  chosenFor = latest ? conditions(latest) : [];
  try {
    const moment = recording && latest ? `&at=${latest.time_s}` : "";
    const answer = await ask(`shape.json?id=${id}${moment}`);
    // If two requests overlap, the later one counts.
    if (order === choices) await shape.show(answer, Math.sign(latest?.speed ?? 1));
  } catch (error) {
    shape.missing(error.message);
  }
}

let contactAt = 0;
let contactFor = [];
let contacts = 0;

async function showContact() {
  const order = ++contacts;
  contactAt = performance.now();
  contactFor = latest ? conditions(latest) : [];
  try {
    const answer = await ask(recording && latest ? `contact.json?at=${latest.time_s}` : "contact.json");
    if (order === contacts) contact.show(answer);
  } catch (error) {
    if (order === contacts) contact.missing(error.message);
  }
}

function follow(on) {
  following = on;
  at("shape-follow").setAttribute("aria-pressed", String(on));
  if (on && latest) numbers();
}
at("shape-follow").addEventListener("click", () => follow(!following));

/** Runs one task of each kind at a time; requests made meanwhile are repeated with the next state. */
async function once(kind, work) {
  if (asking[kind]) return;
  asking[kind] = true;
  try {
    await work();
  } catch {
    // The connection is lost, or there is no such map yet: the next state requests it again.
  } finally {
    asking[kind] = false;
  }
}

const loadHistory = () => once("history", async () => history.load(await ask("history.json")));

/** Without inputs or after a fault, earlier predictions are not shown as if they still held. */
function sifted(state) {
  if (asserts(state)) return state;
  const nothing = { margin: null, growth: null, worst_hz: null, unstable: null, modes: [], fastest: null, next: null, spread: null, trend_per_s: null };
  const silent = state.status === "fault" ? {} : { mu: null, load: null, speed: null };
  return { ...state, ...nothing, ...silent };
}

function take(received) {
  const state = sifted(received);
  latest = state;
  heardAt = performance.now();
  if (!recording) connected();
  next(paint);
  if (!recording) history.now = state.time_s;
  if (!history.add(state.bins)) loadHistory();
  if (state.map && state.map !== mapShown) {
    once("map", async () => {
      const number = state.map;
      map.show(await ask(`map.json?number=${number}`));
      mapShown = number;
      // The map determines which mode to show first.
      if (recording) next(numbers);
    });
  }
  // The events of a recording are complete from the beginning.
  if (!recording && state.events !== eventsShown) {
    once("events", async () => {
      const change = state.events;
      const [all, squeals] = await Promise.all(["events.json", "squeals-in-sound.json"].map(ask));
      events.show(all, squeals);
      sound.squeals = squeals;
      eventsShown = change;
    });
  }
}

/** Draws what moves with every state. */
function paint() {
  // The frame may have been scheduled before the connection was lost.
  if (at("link").dataset.link === "gone") return;
  status.level(latest);
  status.needle(latest);
  shape.still(!asserts(latest));
  contact.still(!asserts(latest));
  map.cursor(latest);
}

function numbers() {
  if (!latest) return;
  const age = typeof latest.age_s === "number" ? latest.age_s + (recording ? 0 : (performance.now() - heardAt) / 1000) : undefined;
  status.numbers(latest, age, (id) => (shape.shape?.id === id ? shape.shape.pad_share : undefined));
  modes.numbers(latest);
  at("simulated").hidden = !(about.simulated || latest.simulated);
  if (!asserts(latest)) return;
  if (contact.chosen && performance.now() - contactAt > FOLLOWED && moved(conditions(latest), contactFor)) showContact();
  const wanted = latest.fastest?.id ?? latest.next?.ids[0] ?? modes.chosen ?? latest.modes?.[0]?.[0];
  const since = performance.now() - chosenAt;
  const settled = since > SETTLED;
  // A recording that is paused sends no further states.
  clearTimeout(later);
  if (recording && !settled) later = setTimeout(numbers, SETTLED);
  if (following && wanted !== undefined && wanted !== modes.chosen && (since > FOLLOWED || modes.chosen === null)) modes.select(wanted);
  // The shape of a mode changes with the conditions.
  else if (modes.chosen !== null && settled && known(latest.mu) && moved(conditions(latest), chosenFor)) choose(modes.chosen);
}

const refresh = () => history.refreshIfDue();

function link(kind, text) {
  at("link").dataset.link = kind;
  at("link-text").textContent = text;
  status.disconnected(kind === "gone");
  if (kind !== "gone") return;
  shape.still(true);
  contact.still(true);
  if (!latest) return;
  latest = sifted({ ...latest, status: "no_data" });
  status.needle(latest);
  map.cursor(latest);
}

/** The page is connected to the node; the sign is green only if the node receives inputs. */
function connected() {
  const kind = asserts(latest) ? "live" : "up";
  if (at("link").dataset.link !== kind) link(kind, kind === "live" ? "live" : "connected");
}

const THEMES = ["auto", "light", "dark"];
function theme() {
  const now = document.documentElement.dataset.theme ?? "auto";
  at("theme").querySelector(".choice-name").textContent = now;
}
function repaint() {
  forgetColours();
  map.draw();
  history.draw();
  sound.draw();
  shape.draw();
}
at("theme").addEventListener("click", () => {
  const chosen = THEMES[(THEMES.indexOf(document.documentElement.dataset.theme ?? "auto") + 1) % 3];
  if (chosen === "auto") delete document.documentElement.dataset.theme;
  else document.documentElement.dataset.theme = chosen;
  try {
    localStorage.setItem("squealcast-theme", chosen);
  } catch {
    // Storage is not available: the choice is not kept.
  }
  theme();
  repaint();
});
matchMedia("(prefers-color-scheme: dark)").addEventListener("change", repaint);
theme();

if (recording) {
  link("file", "recording");
  at("age-unit").textContent = "s before";
  at("work").hidden = true;
  timeline = new Timeline(about, async (moment) => {
    try {
      take(await ask(`state.json?at=${moment}`));
      link("file", "recording");
    } catch {
      return link("gone", "no answer");
    }
    numbers();
    history.mark(moment);
    sound.mark(moment);
  });
  const [whole, all, squeals, comparison] = await Promise.all(["history.json", "events.json", "squeals-in-sound.json", "comparison.json"].map(ask));
  history.load(whole);
  const measured = comparison?.measured ?? [];
  timeline.paint(whole, measured);
  events.show(all, squeals, comparison);
  sound.squeals = squeals;
  sound.refresh(ask);
  timeline.events = [...all, ...squeals, ...measured.filter((squeal) => squeal.verdict !== "hit")].sort((a, b) => a.onset_s - b.onset_s);
  new ResizeObserver(() => timeline.paint(whole, measured)).observe(at("track-levels"));
  timeline.go(about.span_s[0]);
} else {
  let stream;
  const listen = () => {
    heardAt = performance.now();
    stream = new EventSource("stream");
    stream.onopen = async () => {
      link("up", "connected");
      mapShown = 0;
      loadHistory();
      // Another node may be serving here by now.
      const now = await ask("about.json").catch(() => about);
      if (JSON.stringify(now) !== JSON.stringify(about)) location.reload();
    };
    stream.onerror = () => link("gone", "no connection");
    stream.onmessage = (event) => take(JSON.parse(event.data));
  };
  // A browser opens only a few connections to one origin: hidden pages leave theirs to others.
  document.addEventListener("visibilitychange", () => {
    stream?.close();
    stream = undefined;
    if (!document.hidden) listen();
  });
  if (!document.hidden) listen();
  setInterval(() => {
    if (document.hidden) return;
    // A running node sends at least twice a second.
    if (latest && performance.now() - heardAt > 3000) link("gone", "no answer");
    next(numbers);
    next(refresh);
    sound.refresh(ask);
  }, NUMBERS_EVERY);
}
