// Numbers as people read them: the same number of digits from one moment to the next.

export const NONE = "–";

export const known = (value) => typeof value === "number" && Number.isFinite(value);

/** A number with fixed decimals and a true minus; a dash where there is none. */
export function fixed(value, decimals) {
  if (!known(value)) return NONE;
  const text = value.toFixed(decimals);
  return (Number(text) === 0 ? text.replace("-", "") : text).replace("-", "\u2212");
}

/** As `fixed`, with a sign always. */
export function signed(value, decimals) {
  const text = fixed(value, decimals);
  return text === NONE || text.startsWith("\u2212") ? text : `+${text}`;
}

/** Decimals for a quantity by the largest value seen: they do not change with every value. */
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

/** Writes text and the exact value behind it; only where it changed. */
export function put(element, text, value) {
  if (element.textContent !== text) element.textContent = text;
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

/** A colour of the style sheet. */
export const colour = (name) => getComputedStyle(document.documentElement).getPropertyValue(name).trim();

export const modeColour = (id) => colour(`--mode-${id % 7}`);

export const LEVELS = ["ok", "warn", "squeal", "fault"];
