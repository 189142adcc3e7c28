// Formats numbers for reading, with the same number of digits from one moment to the next.

export const NONE = "–";

export const known = (value) => typeof value === "number" && Number.isFinite(value);

/** A number with fixed decimals and a true minus sign; a dash for an unknown value. */
export function fixed(value, decimals) {
  if (!known(value)) return NONE;
  const text = value.toFixed(decimals);
  return (Number(text) === 0 ? text.replace("-", "") : text).replace("-", "\u2212");
}

/** As `fixed`, always with a sign. */
export function signed(value, decimals) {
  const text = fixed(value, decimals);
  return text === NONE || text.startsWith("\u2212") ? text : `+${text}`;
}

/** Labels of evenly spaced ticks, with the decimals that their spacing (or a single tick itself) needs. */
export function labels(ticks) {
  const step = Math.abs(ticks.length > 1 ? ticks[1] - ticks[0] : ticks[0]);
  let decimals = 0;
  while (decimals < 8 && Math.abs(step * 10 ** decimals - Math.round(step * 10 ** decimals)) > 1e-6) decimals++;
  return ticks.map((tick) => fixed(tick, decimals));
}

/** Number of decimals of a quantity, from the largest value seen, so that it does not change with every value. */
export class Decimals {
  constructor(digits, least = 0) {
    this.digits = digits;
    this.least = least;
    this.largest = 0;
  }
  of(value) {
    if (known(value)) this.largest = Math.max(this.largest, Math.abs(value));
    const magnitude = this.largest > 0 ? Math.floor(Math.log10(this.largest)) : 0;
    return Math.min(8, Math.max(this.least, this.digits - 1 - magnitude));
  }
  text(value) { return fixed(value, this.of(value)); }
}

/** Smallest growth rate that is resolved: a damping ratio of 1e-4. */
export const leastGrowth = (hz) => 2e-4 * Math.PI * hz;

/** Writes a text and the exact value behind it, only if it changed, and into the existing text node. */
export function put(element, text, value) {
  const node = element.firstChild;
  if (node?.nodeType !== Node.TEXT_NODE) element.textContent = text;
  else if (node.data !== text) node.data = text;
  if (element.localName === "data") {
    const exact = known(value) ? String(value) : "";
    if (element.value !== exact) element.value = exact;
  }
}

export const time = (seconds, digits = 1) => {
  const date = new Date(seconds * 1000);
  const two = (n) => String(n).padStart(2, "0");
  const rest = (date.getSeconds() + date.getMilliseconds() / 1000).toFixed(digits).padStart(digits ? 3 + digits : 2, "0");
  return `${two(date.getHours())}:${two(date.getMinutes())}:${rest}`;
};

const colours = new Map();

/** A colour of the style sheet. */
export function colour(name) {
  if (!colours.has(name)) colours.set(name, getComputedStyle(document.documentElement).getPropertyValue(name).trim());
  return colours.get(name);
}

/** Forgets the cached colours after a change of theme. */
export const forgetColours = () => colours.clear();

export const modeColour = (id) => colour(`--mode-${id % 7}`);

export const LEVELS = ["ok", "warn", "squeal", "fault"];

/** Whether a state makes a statement about the rig; without inputs or after a fault nothing is known. */
export const asserts = (state) => ["ok", "warn", "squeal"].includes(state?.status);
