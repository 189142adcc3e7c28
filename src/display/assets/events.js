// The table of events; in a recording also session events and measured squeals.

import { NONE, fixed, known, time } from "./format.js";

const MOST = 200;
/** More notes than this would hide the events. */
const MOST_NOTES = 50;
const VERDICTS = { hit: "measured: hit", not_predicted: "measured: miss", other_frequency: "measured: miss" };

export class Events {
  constructor(about, jump) {
    this.body = document.querySelector("#events tbody");
    this.note = document.getElementById("events-note");
    this.jump = jump;
    this.start = about.span_s?.[0];
    this.notes = (about.notes ?? []).slice(0, MOST_NOTES).map((note) => ({ ...note, kind: note.what, class: "aside" }));
  }

  /** `comparison` is `null` without measurements. */
  show(events, comparison = null) {
    const measured = (comparison?.measured ?? []).map((squeal) => ({ ...squeal, kind: VERDICTS[squeal.verdict], class: squeal.verdict === "hit" ? "aside" : "missed" }));
    const alarms = new Set(comparison?.false_alarms);
    const judged = events.map((event) => (alarms.has(event.number) ? { ...event, note: "false alarm" } : event));
    const shown = [...judged, ...this.notes, ...measured].sort((a, b) => a.onset_s - b.onset_s).slice(-MOST).reverse();
    const counted = ["SQUEAL", "FAULT", "NO DATA"].map((kind) => [kind.toLowerCase(), events.filter((event) => event.kind === kind).length]);
    const counts = counted.filter(([, count]) => count).map(([kind, count]) => `${count} × ${kind}`).join(", ");
    const summary = events.length ? `${counts}${events.length > MOST ? `, the last ${MOST} shown` : ""}` : "none so far";
    const verdict = comparison && `; measured: ${measured.filter((squeal) => squeal.verdict === "hit").length} hits, ${measured.filter((squeal) => squeal.verdict !== "hit").length} misses, ${alarms.size} false alarms`;
    this.note.textContent = summary + (verdict ?? "");
    this.body.replaceChildren(...shown.map((event) => this.#row(event)));
  }

  #row(event) {
    const row = document.createElement("tr");
    row.className = event.class ?? (event.kind === "SQUEAL" ? "squeal" : "fault");
    const moment = (at_s) => (this.start === undefined ? time(at_s) : `${fixed(at_s - this.start, 2)} s`);
    const ends = known(event.end_s);
    // The moment of fastest growth; for a fault its onset. Notes and measurements have separate values.
    const shown = event.peak ?? event.onset ?? event;
    const values = [
      event.number ?? "", event.note ? `${event.kind}, ${event.note}` : event.kind, moment(event.onset_s),
      ends ? moment(event.end_s) : event.end_s === null ? "lasts" : NONE, ends ? fixed(event.end_s - event.onset_s, 2) : NONE, shown.mode_id ?? NONE, this.#frequency(shown.frequency_hz),
      this.#friction(event), fixed(shown.normal_load_n, 1), fixed(shown.disc_speed_rad_s, 2), event.reason ?? "",
    ];
    values.forEach((value, k) => {
      const cell = document.createElement("td");
      if (k === 2 && this.jump) {
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

  /** Friction coefficient at the onset and at the fastest growth. */
  #friction({ onset, peak, friction_coefficient: measured }) {
    const [from, to] = [onset, peak].map((moment) => moment?.friction_coefficient);
    return known(from) && known(to) ? `${fixed(from, 4)} → ${fixed(to, 4)}` : fixed(from ?? to ?? measured, 4);
  }

  #frequency(hz) {
    return known(hz) ? fixed(hz, hz >= 100 ? 1 : 5) : NONE;
  }
}
