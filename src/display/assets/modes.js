// The table of modes.

import { Decimals, NONE, fixed, known, leastGrowth, put } from "./format.js";

/** An error bound, rounded to its order of magnitude. */
const bound = (error) => (error === 0 ? "0" : error.toExponential(0).replace("-", "\u2212"));

export class Modes {
  /** `choose` shows the shape of a mode; `picked` is called when the user picks one. */
  constructor(about, choose, picked) {
    this.threshold = about.instability_threshold;
    this.body = document.querySelector("#modes tbody");
    this.scroll = this.body.closest(".scroll");
    this.rows = new Map();
    this.chosen = null;
    this.choose = choose;
    this.picked = picked;
    this.decimals = { frequency: new Decimals(6, 1), growth: new Decimals(4, 2) };
    // After a resize the chosen mode remains visible.
    new ResizeObserver(() => this.#reveal()).observe(this.scroll);
  }

  numbers(state) {
    const modes = [...(state.modes ?? [])].sort((a, b) => a[0] - b[0]);
    const count = this.rows.size;
    for (const id of [...this.rows.keys()]) {
      if (!modes.some((mode) => mode[0] === id)) {
        this.rows.get(id).row.remove();
        this.rows.delete(id);
      }
    }
    // The scales first, so that all rows of a column have the same number of digits.
    for (const [, [hz, growth]] of modes) {
      this.decimals.frequency.of(hz);
      this.decimals.growth.of(growth);
      this.decimals.growth.of(leastGrowth(hz));
    }
    modes.forEach(([id, [hz, growth, damping, pad, hzError, growthError]], place) => {
      const { row, cells } = this.rows.get(id) ?? this.#row(id);
      if (this.body.children[place] !== row) this.body.insertBefore(row, this.body.children[place] ?? null);
      row.classList.toggle("grows", known(damping) && damping < -this.threshold);
      put(cells[0], this.decimals.frequency.text(hz), hz);
      put(cells[1], this.decimals.growth.text(growth), growth);
      put(cells[2], fixed(damping, 5), damping);
      put(cells[3], known(pad) ? `${fixed(100 * pad, 0)} %` : NONE, pad);
      put(cells[4], known(hzError) ? bound(hzError) : NONE, hzError);
      put(cells[5], known(growthError) ? bound(growthError) : NONE, growthError);
    });
    if (this.rows.size !== count) this.#reveal();
  }

  #row(id) {
    const row = document.createElement("tr");
    const head = document.createElement("th");
    head.scope = "row";
    const button = document.createElement("button");
    button.type = "button";
    button.className = "mode-button";
    button.dataset.mode = id;
    button.setAttribute("aria-pressed", "false");
    button.setAttribute("aria-label", `Show mode ${id}`);
    const swatch = document.createElement("span");
    swatch.className = `swatch mode-${id % 7} dash-${Math.floor(id / 7) % 3}`;
    button.append(swatch, String(id));
    head.append(button);
    row.append(head);
    row.addEventListener("click", () => {
      this.picked();
      this.select(id);
      // On a small screen the shape is elsewhere on the page.
      document.querySelector(".panel.shape").scrollIntoView({ block: "nearest" });
    });
    const cells = Array.from({ length: 6 }, () => {
      const cell = document.createElement("td");
      const data = document.createElement("data");
      cell.append(data);
      row.append(cell);
      return data;
    });
    const entry = { row, cells, button };
    this.rows.set(id, entry);
    if (id === this.chosen) this.#mark(entry, true);
    return entry;
  }

  #mark({ row, button }, chosen) {
    row.classList.toggle("chosen", chosen);
    button.setAttribute("aria-pressed", String(chosen));
  }

  /** Scrolls the table, and only the table, to the chosen mode. */
  #reveal() {
    const row = this.rows.get(this.chosen)?.row;
    if (!row) return;
    const head = this.body.parentElement.tHead.offsetHeight;
    const { scroll } = this;
    const top = row.offsetTop - head;
    const bottom = row.offsetTop + row.offsetHeight;
    if (top < scroll.scrollTop) scroll.scrollTop = top;
    else if (bottom > scroll.scrollTop + scroll.clientHeight) scroll.scrollTop = bottom - scroll.clientHeight;
  }

  select(id) {
    const before = this.rows.get(this.chosen);
    if (before) this.#mark(before, false);
    this.chosen = id;
    const entry = this.rows.get(id);
    if (entry) this.#mark(entry, true);
    this.#reveal();
    this.choose(id);
  }
}
