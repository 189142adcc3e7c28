// The table of events; in a recording also session events and measured squeals.

import { NONE, fixed, known, time } from "./format.js";

const MOST = 200;
/** More notes than this would hide the events. */
const MOST_NOTES = 50;
/** What an event has once, by the name of its column. */
const CELLS = {
  number: (event) => event.number ?? "",
  kind: (event) => (event.note ? `${event.kind}, ${event.note}` : event.kind),
  onset_utc: (event, moment) => moment(event.onset_s),
  end_utc: (event, moment) => (known(event.end_s) ? moment(event.end_s) : event.end_s === null ? "lasts" : NONE),
  duration_s: (event) => (known(event.end_s) ? fixed(event.end_s - event.onset_s, 2) : NONE),
  reason: (event) => event.reason ?? "",
};
const VERDICTS = { hit: "measured: hit", not_predicted: "measured: miss", other_frequency: "measured: miss" };

function heading({ heading, unit }) {
  const cell = document.createElement("th");
  cell.scope = "col";
  cell.textContent = heading;
  if (unit) cell.append(Object.assign(document.createElement("i"), { textContent: unit }));
  return cell;
}

/** A value at the fastest growth, of a fault at its onset; if the column asks for it, the value at the onset before. */
function ofMoment(event, { name, moment: { decimals, from_onset } }) {
  const text = (value) => fixed(value, decimals[value >= 100 ? 0 : 1]);
  // Notes and measurements have separate values.
  const value = (event.peak ?? event.onset ?? event)[name];
  const from = event.onset?.[name];
  return from_onset && event.peak && known(from) && known(value) ? `${text(from)} → ${text(value)}` : text(value ?? from);
}

/** Channel, level and growth of a squeal found in samples. */
function describe({ channel, level_db, level_unit, growth_rate_per_s }) {
  const growth = known(growth_rate_per_s) ? `, growth ${fixed(growth_rate_per_s, 1)} 1/s` : "";
  return `${channel}: ${fixed(level_db, 1)} ${level_unit}${growth}`;
}

export class Events {
  constructor(about, jump) {
    this.body = document.querySelector("#events tbody");
    this.note = document.getElementById("events-note");
    this.jump = jump;
    this.start = about.span_s?.[0];
    this.columns = about.event_columns;
    document.querySelector("#events thead tr").replaceChildren(...this.columns.map(heading));
    this.notes = (about.notes ?? []).slice(0, MOST_NOTES).map((note) => ({ ...note, kind: note.what, class: "aside" }));
  }

  /** `sound` are the squeals found in samples; `comparison` is `null` without measurements. */
  show(events, sound = [], comparison = null) {
    const heard = sound.map((squeal) => ({ ...squeal, number: undefined, kind: `in sound: ${squeal.verdict}`, class: squeal.verdict === "miss" ? "missed" : "aside", reason: describe(squeal) }));
    const measured = (comparison?.measured ?? []).map((squeal) => ({ ...squeal, kind: VERDICTS[squeal.verdict], class: squeal.verdict === "hit" ? "aside" : "missed" }));
    const alarms = new Set(comparison?.false_alarms);
    const judged = events.map((event) => (alarms.has(event.number) ? { ...event, note: "false alarm" } : event));
    const shown = [...judged, ...this.notes, ...measured, ...heard].sort((a, b) => a.onset_s - b.onset_s).slice(-MOST).reverse();
    const counted = ["SQUEAL", "FAULT", "NO DATA"].map((kind) => [kind.toLowerCase(), events.filter((event) => event.kind === kind).length]);
    const counts = counted.filter(([, count]) => count).map(([kind, count]) => `${count} × ${kind}`).join(", ");
    const summary = events.length ? `${counts}${events.length > MOST ? `, the last ${MOST} shown` : ""}` : "none so far";
    const verdict = comparison && `; measured: ${measured.filter((squeal) => squeal.verdict === "hit").length} hits, ${measured.filter((squeal) => squeal.verdict !== "hit").length} misses, ${alarms.size} false alarms`;
    const inSound = sound.length ? `; in sound: ${sound.length}` : "";
    this.note.textContent = summary + (verdict ?? "") + inSound;
    this.body.replaceChildren(...shown.map((event) => this.#row(event)));
  }

  #row(event) {
    const row = document.createElement("tr");
    row.className = event.class ?? (event.kind === "SQUEAL" ? "squeal" : "fault");
    const moment = (at_s) => (this.start === undefined ? time(at_s) : `${fixed(at_s - this.start, 2)} s`);
    this.columns.forEach((column) => {
      const value = column.moment ? ofMoment(event, column) : CELLS[column.name](event, moment);
      const cell = document.createElement("td");
      if (column.name === "onset_utc" && this.jump) {
        const button = document.createElement("button");
        button.type = "button";
        button.className = "jump";
        button.textContent = value;
        button.setAttribute("aria-label", `Go to ${event.number ? `event ${event.number}` : event.kind} at ${value}`);
        button.addEventListener("click", () => this.jump(event.onset_s));
        cell.append(button);
      } else {
        cell.textContent = value;
      }
      row.append(cell);
    });
    return row;
  }
}
