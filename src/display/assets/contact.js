// The contact of a rig whose pairs open and close: the force of every pair, at its place on the interface or by number.

import { fixed } from "./format.js";

const at = (id) => document.getElementById(id);
/** Radius of the dot of the largest force, and of the ring of an open pair, as fractions of the distance of neighbours. */
const [DOT, RING] = [0.47, 0.17];
/** Most pairs whose numbers are written below their bars. */
const NUMBERED = 24;

const drawn = (name, attributes, text) => {
  const element = document.createElementNS("http://www.w3.org/2000/svg", name);
  for (const [key, value] of Object.entries(attributes)) element.setAttribute(key, value);
  if (text !== undefined) element.textContent = text;
  return element;
};

export class ContactView {
  /** `wanted` is called when the contact is chosen. */
  constructor(about, wanted) {
    this.panel = document.querySelector(".panel.shape");
    at("shape-view").hidden = !about.contact_state;
    for (const input of document.querySelectorAll("input[name=shape-view]")) {
      input.addEventListener("change", () => {
        this.panel.dataset.view = input.value;
        at("shape-title").textContent = this.chosen ? "Contact" : "Mode shape";
        if (this.chosen) wanted();
      });
    }
  }

  /** Whether the contact is shown instead of the shape. */
  get chosen() {
    return this.panel.dataset.view === "contact";
  }

  /** Fades the picture while nothing is known about the rig. */
  still(stopped) {
    at("contact-plan").classList.toggle("still", stopped);
  }

  missing(reason) {
    at("contact-note").textContent = reason;
    at("contact-picture").replaceChildren();
    at("contact-numbers").replaceChildren();
  }

  show(contact) {
    const { force_n: forces, places, pairs_closed: closed } = contact;
    const largest = Math.max(0, ...forces);
    const summary = `${closed} of ${forces.length} pairs closed`;
    at("contact-note").textContent = `${summary} at ${fixed(contact.normal_load_n, 1)} N, μ ${fixed(contact.friction_coefficient, 3)}`;
    at("contact-edges").hidden = places.length === 0;
    const picture = at("contact-picture");
    picture.setAttribute("aria-label", `Forces of the contact pairs: ${summary}`);
    const parts = places.length ? this.#plan(picture, forces, places, largest) : this.#bars(picture, forces, largest);
    picture.replaceChildren(...parts);
    const entry = (kind, text) => Object.assign(document.createElement(kind), { textContent: text });
    const facts = { "contact force": contact.contact_force_n, "on the pad's back": contact.back_force_n, [`largest, pair ${forces.indexOf(largest) + 1}`]: largest };
    at("contact-numbers").replaceChildren(...Object.entries(facts).map(([name, force]) => {
      const pair = document.createElement("div");
      pair.append(entry("dt", name), entry("dd", `${fixed(force, 1)} N`));
      return pair;
    }));
  }

  /** A dot for each pair at its place, its area the force; a ring for an open one. */
  #plan(picture, forces, places, largest) {
    const mm = places.map(({ along_m, outward_m }) => [1000 * along_m, -1000 * outward_m]);
    const [low, high] = [Math.min, Math.max].map((most) => [0, 1].map((axis) => most(...mm.map((place) => place[axis]))));
    const apart = distance(mm) || 1;
    // The second face of the disc is drawn below the first.
    const below = high[1] - low[1] + 3 * apart;
    const faces = places.some(({ opposite }) => opposite) ? 2 : 1;
    const edge = low[0] - 1.2 * apart;
    picture.setAttribute("viewBox", [edge - 0.5 * apart, low[1] - apart, high[0] - edge + 1.5 * apart, high[1] - low[1] + 2 * apart + (faces - 1) * below].join(" "));
    const parts = [];
    for (let face = 0; face < faces; face++) {
      const [from, to] = [low[1], high[1]].map((y) => y + face * below);
      parts.push(drawn("line", { class: "edge", x1: edge, x2: edge, y1: from - 0.5 * apart, y2: to + 0.5 * apart, "stroke-width": 0.2 * apart }));
    }
    forces.forEach((force, k) => {
      const [cx, cy] = [mm[k][0], mm[k][1] + (places[k].opposite ? below : 0)];
      const open = force <= 0;
      const r = open ? RING * apart : Math.max(0.03 * apart, DOT * apart * Math.sqrt(force / largest));
      const dot = drawn("circle", { class: open ? "open" : "closed", cx, cy, r, "stroke-width": 0.07 * apart });
      dot.append(drawn("title", {}, `pair ${k + 1}: ${open ? "open" : `${fixed(force, 2)} N`}`));
      parts.push(dot);
    });
    return parts;
  }

  /** A bar for each pair, its height the force; a ring for an open one. */
  #bars(picture, forces, largest) {
    const [width, height] = [10 * forces.length, 5 * forces.length];
    const text = 0.055 * width;
    const numbered = forces.length <= NUMBERED;
    picture.setAttribute("viewBox", `0 ${-0.03 * height} ${width} ${1.06 * height + (numbered ? 1.4 * text : 0)}`);
    const parts = [drawn("line", { class: "ground", x1: 0, x2: width, y1: height, y2: height, "stroke-width": 0.006 * width })];
    forces.forEach((force, k) => {
      const [open, middle] = [force <= 0, 10 * k + 5];
      const tall = largest > 0 ? height * force / largest : 0;
      const bar = open
        ? drawn("circle", { class: "open", cx: middle, cy: height - 2.5, r: 1.8, "stroke-width": 0.6 })
        : drawn("rect", { class: "closed", x: middle - 3, y: height - tall, width: 6, height: tall });
      bar.append(drawn("title", {}, `pair ${k + 1}: ${open ? "open" : `${fixed(force, 2)} N`}`));
      parts.push(bar);
      if (numbered) parts.push(drawn("text", { x: middle, y: height + 1.2 * text, "font-size": text, "text-anchor": "middle" }, String(k + 1)));
    });
    return parts;
  }
}

/** The usual distance of a pair to its nearest neighbour. */
function distance(places) {
  const nearest = places.map(([x, y], k) => places.reduce((least, [u, v], j) => {
    const apart = Math.hypot(x - u, y - v);
    return j !== k && apart > 0 ? Math.min(least, apart) : least;
  }, Infinity)).filter(Number.isFinite).sort((a, b) => a - b);
  return nearest[Math.floor(nearest.length / 2)];
}
