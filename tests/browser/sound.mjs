// The sound of a recording in the page: node sound.mjs URL PLANTED [pictures], PLANTED a JSON list of frequencies in Hz and times
// in s since the epoch. Prints the scores shown.
import { check, launch, open, picture, until, violations } from "./browser.mjs";

const [url, list, pictures] = process.argv.slice(2);
const planted = JSON.parse(list);
const faults = [];
const browser = await launch();
const page = await open(browser, url, {}, faults);
const canvas = page.locator("#spectrogram");
const drawn = (page) => page.waitForFunction(() => document.getElementById("spectrogram").view?.());
await page.waitForSelector("#sound .score");
await drawn(page);
await canvas.scrollIntoViewIfNeeded();

/** Lightness around a time and frequency, without the overlay; the median of its column; and how far, in px, the nearest
 * overlay is from a frequency. */
const look = (seconds, hz) => page.evaluate(([seconds, hz]) => {
  const canvas = document.getElementById("spectrogram");
  const ratio = canvas.width / canvas.clientWidth;
  const [x, y] = canvas.position(seconds, hz).map((px) => px * ratio);
  const copy = new OffscreenCanvas(1, canvas.height).getContext("2d", { willReadFrequently: true });
  copy.drawImage(canvas, -Math.round(x), 0);
  const column = copy.getImageData(0, 0, 1, canvas.height).data;
  const light = [];
  const lines = [];
  for (let k = 0; k < canvas.height; k++) {
    const [r, g, b] = column.slice(4 * k, 4 * k + 3);
    const isLine = b > r + 60 && g > r + 60;
    if (isLine) lines.push(k + 0.5);
    light.push(isLine ? 0 : 0.21 * r + 0.72 * g + 0.07 * b);
  }
  const near = light.slice(Math.max(0, Math.round(y) - 6), Math.round(y) + 7);
  const sorted = light.toSorted((a, b) => a - b);
  return { near: Math.max(...near), median: sorted[sorted.length >> 1], line: Math.min(...lines.map((k) => Math.abs(k - y))) / ratio };
}, [seconds, hz]);

/** The predicted frequency nearest to a planted one, as the history has it. */
const history = await page.evaluate(async () => (await fetch("history.json")).json());
const predicted = (seconds, hz) => {
  const bin = history.bins.findLast((bin) => bin.k * history.bin_s <= seconds);
  return bin.u.map(([hz]) => hz).sort((a, b) => Math.abs(a - hz) - Math.abs(b - hz))[0];
};

// Unzoomed, a row of 50 Hz is less than a pixel high and below the line.
for (const { hz, time_s: seconds } of planted) {
  const overlay = await look(seconds, predicted(seconds, hz));
  check(overlay.line <= 1.5, `the prediction is drawn ${overlay.line} px off ${hz} Hz`);
}

// Zoomed by the wheel about the squeal, in time and in frequency: the squeal stays under the pointer.
const view = (page) => page.evaluate(() => ({ ...document.getElementById("spectrogram").view() }));
const whole = await view(page);
const { hz, time_s: seconds } = planted[0];
const box = await canvas.boundingBox();
const [x, y] = await page.evaluate(([seconds, hz]) => document.getElementById("spectrogram").position(seconds, hz), [seconds, hz]);
await page.mouse.move(box.x + x, box.y + y);
for (let k = 0; k < 5; k++) await page.mouse.wheel(0, -100);
await page.keyboard.down("Shift");
for (let k = 0; k < 12; k++) await page.mouse.wheel(0, -100);
await page.keyboard.up("Shift");
await until("it is zoomed", async () => {
  const { from, to, low, high } = await view(page);
  return to - from < 0.5 * (whole.to - whole.from) && high - low < 0.5 * (whole.high - whole.low);
});
const [zoomedX, zoomedY] = await page.evaluate(([seconds, hz]) => document.getElementById("spectrogram").position(seconds, hz), [seconds, hz]);
// Browsers round the place of a pointer to whole pixels, which the zoom magnifies.
const zoomed = await view(page);
const [timesX, timesY] = [(whole.to - whole.from) / (zoomed.to - zoomed.from), (whole.high - whole.low) / (zoomed.high - zoomed.low)];
check(Math.abs(zoomedX - x) <= timesX && Math.abs(zoomedY - y) <= timesY, `zooming moved the squeal from ${x}, ${y} to ${zoomedX}, ${zoomedY}`);
const near = await look(seconds, hz);
check(near.near > near.median + 40, `${JSON.stringify(near)} at the planted ${hz} Hz`);
const line = await look(seconds, predicted(seconds, hz));
check(line.line <= 1.5, `zoomed, the prediction is drawn ${line.line} px off ${hz} Hz`);
await picture(page, pictures, "sound-zoomed-1280");

// Keys, the button, and a click that leads the time line there.
await canvas.focus();
await page.keyboard.press("ArrowRight");
check((await view(page)).from > (await view(page)).to - (whole.to - whole.from), "an arrow lost the view");
await page.locator("#sound-all").click();
check(JSON.stringify(await view(page)) === JSON.stringify(whole), "all is not all");
await page.mouse.click(box.x + x, box.y + y);
await page.waitForFunction(() => Number(document.getElementById("scrub").value) > 0);
const found = await violations(page);
check(found.length === 0, found.join("\n"));

const scores = await page.locator("#sound .score").allInnerTexts();
for (const width of [360, 1280, 2560]) {
  for (const colorScheme of ["light", "dark"]) {
    const other = await open(browser, url, { viewport: { width, height: width === 2560 ? 1440 : 800 }, colorScheme }, faults);
    await drawn(other);
    await picture(other, pictures, `sound-${width}-${colorScheme}`);
    const wide = await other.evaluate(() => {
      const panel = document.getElementById("sound");
      const parts = [panel, ...panel.querySelectorAll("*")].map((part) => part.getBoundingClientRect().right);
      return Math.max(...parts) - document.documentElement.clientWidth;
    });
    check(wide <= 0, `${width} px: the panel is ${wide} px too wide`);
    const [w, h] = await other.evaluate(() => { const c = document.getElementById("spectrogram"); return [c.clientWidth, c.clientHeight]; });
    check(w > 200 && h > 90, `${width} px: the spectrogram has ${w} x ${h} px`);
    await other.context().close();
  }
}
await browser.close();
check(faults.length === 0, faults.join("\n"));
console.log(JSON.stringify({ scores }));
