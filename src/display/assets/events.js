// The table of onsets and ends.

import { NONE, fixed, known, time } from "./format.js";

const MOST = 200;

export class Events {
  constructor(about, jump) {
    this.body = document.querySelector("#events tbody");
    this.note = document.getElementById("events-note");
    this.jump = jump;
    this.start = about.span_s?.[0];
    this.events = [];
  }

  show(events) {
    this.events = events;
    const shown = events.slice(-MOST).reverse();
    const squeals = events.filter((event) => event.kind === "SQUEAL").length;
    this.note.textContent = events.length ? `${squeals} × squeal, ${events.length - squeals} × fault${events.length > MOST ? `, the last ${MOST} shown` : ""}` : "none so far";
    this.body.replaceChildren(...shown.map((event) => this.#row(event)));
  }

  #row(event) {
    const row = document.createElement("tr");
    row.className = event.kind.toLowerCase();
    const lasts = event.end_s === null;
    const values = [
      event.number, event.kind, this.start === undefined ? time(event.onset_s) : `${fixed(event.onset_s - this.start, 2)} s`,
      lasts ? "lasts" : fixed(event.end_s - event.onset_s, 2), event.mode_id ?? NONE, this.#frequency(event.frequency_hz),
      fixed(event.friction_coefficient, 4), fixed(event.normal_load_n, 1), fixed(event.disc_speed_rad_s, 2),
    ];
    values.forEach((value, k) => {
      const cell = document.createElement("td");
      if (k === 2 && this.jump) {
        const button = document.createElement("button");
        button.type = "button";
        button.className = "jump";
        button.textContent = value;
        button.setAttribute("aria-label", `Go to event ${event.number} at ${value}`);
        button.addEventListener("click", () => this.jump(event.onset_s));
        cell.append(button);
      } else {
        cell.textContent = value;
      }
      row.append(cell);
    });
    return row;
  }

  #frequency(hz) {
    return known(hz) ? fixed(hz, hz >= 100 ? 1 : 5) : NONE;
  }
}
