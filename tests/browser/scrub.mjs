// A long recording with sound in the page, moved through: node scrub.mjs URL WHAT [pictures], WHAT a JSON object: `per_s`, the
// predictions in a second, and `channels` with `name`, and of a tone `hz` and `time_s` since the epoch. Prints how fast it was.
import { check, launch, open, picture, until } from "./browser.mjs";
import { column, predicted, refined, settled } from "./spectrogram.mjs";

const [url, what, pictures] = process.argv.slice(2);
const { per_s: rate, channels } = JSON.parse(what);
const faults = [];
const browser = await launch();
const began = Date.now();
const page = await open(browser, url, {}, faults);
await page.waitForSelector("#events tbody tr");
await page.waitForSelector("#sound .score");
await settled(page);
const opened = Date.now() - began;

// The time line, step by step: the page shows the prediction of each moment. The moments are between two predictions.
const length = await page.locator("#scrub").evaluate((slider) => Number(slider.max));
const moments = Array.from({ length: 30 }, (_, k) => (Math.floor(((k * 0.618) % 1) * length * rate) + 0.5) / rate);
const steps = await page.evaluate(async ([moments, rate]) => {
  const [slider, shown] = ["scrub", "seq"].map((id) => document.getElementById(id));
  const waits = [];
  for (const moment of moments) {
    const began = performance.now();
    slider.value = moment;
    slider.dispatchEvent(new Event("input", { bubbles: true }));
    while (Number(shown.value) !== Math.floor(moment * rate)) {
      if (performance.now() - began > 60000) throw new Error(`at ${moment} s the page shows prediction ${shown.value}`);
      await new Promise((next) => setTimeout(next, 1));
    }
    waits.push(performance.now() - began);
  }
  return waits;
}, [moments, rate]);

// Dragged over the whole length, without waiting: it keeps up, and ends where the hand ends.
const drag = await page.evaluate(async ([length, rate]) => {
  const [slider, shown] = ["scrub", "seq"].map((id) => document.getElementById(id));
  const seen = new Set();
  let [longest, before] = [0, performance.now()];
  for (let k = 1; k <= 90; k++) {
    slider.value = (Math.floor((k / 90) * (length - 1) * rate) + 0.5) / rate;
    slider.dispatchEvent(new Event("input", { bubbles: true }));
    await new Promise(requestAnimationFrame);
    const now = performance.now();
    [longest, before] = [Math.max(longest, now - before), now];
    seen.add(shown.value);
  }
  const last = Math.floor(Number(slider.value) * rate);
  const began = performance.now();
  while (Number(shown.value) !== last) {
    if (performance.now() - began > 60000) throw new Error(`the page stays at prediction ${shown.value}, not ${last}`);
    await new Promise((next) => setTimeout(next, 1));
  }
  return { shown: seen.size, longest_frame_ms: longest, last_ms: performance.now() - began };
}, [length, rate]);

// Every channel: its tone is where it was planted, and a prediction is over it.
const history = await page.evaluate(async () => (await fetch("history.json")).json());
const canvas = page.locator("#spectrogram");
await canvas.scrollIntoViewIfNeeded();
const choices = [];
for (const { name, hz, time_s: seconds } of channels) {
  const began = Date.now();
  await page.locator("#sound-channel").selectOption(name);
  await settled(page, name);
  choices.push(Date.now() - began);
  const { light, median, lightest } = await column(page, seconds, hz);
  const row = await page.evaluate(() => 31.25 * (document.getElementById("spectrogram").clientHeight - 22) / 4000);
  check(light > median + 40, `channel ${name}: lightness ${light} at ${hz} Hz, ${median} elsewhere`);
  check(lightest <= row + 1, `channel ${name}: the tone is ${lightest} px off ${hz} Hz, rows are ${row} px high`);
  const near = predicted(history, seconds, hz);
  const { off } = await column(page, near.seconds, near.hz);
  check(off <= 1, `channel ${name}: the prediction of ${near.hz} Hz is drawn ${off} px off`);
}
await picture(page, pictures, "scrub-1280");

// In detail: narrower columns, from the samples in the recording.
const at = await page.evaluate(([seconds, hz]) => document.getElementById("spectrogram").position(seconds, hz), [channels[3].time_s - 15, channels[3].hz]);
const box = await canvas.boundingBox();
const view = () => page.evaluate(() => ({ ...document.getElementById("spectrogram").view() }));
await page.mouse.move(box.x + at[0], box.y + at[1]);
for (let k = 0; k < 25; k++) await page.mouse.wheel(0, -100);
await until("it is zoomed", async () => { const { from, to } = await view(); return to - from < 0.004 * length; });
const asked = Date.now();
await refined(page);
const detail = Date.now() - asked;
// The tone begins within a few columns of 1/2400 of twice the time shown, and frames of √(4.6 s / 4 kHz) = 34 ms.
const onset = channels[3].time_s - 15;
const [before, after] = [await column(page, onset - 0.1, channels[3].hz), await column(page, onset + 0.1, channels[3].hz)];
check(after.light > before.light + 80, `lightness ${before.light} before the onset, ${after.light} after it`);
await picture(page, pictures, "scrub-detail-1280");
await page.locator("#sound-all").click();
await settled(page);

// The spectrogram, zoomed and dragged: each step is drawn.
const [middleX, y] = [box.x + box.width / 2, box.y + box.height / 2];
await page.mouse.move(middleX, y);
for (let k = 0; k < 8; k++) await page.mouse.wheel(0, -100);
await until("it is zoomed", async () => { const { from, to } = await view(); return to - from < 0.17 * length; });
await settled(page);
const start = await view();
await page.mouse.down();
// After the page's own listener, which the press has added.
await page.evaluate(() => {
  const canvas = document.getElementById("spectrogram");
  window.waits = [];
  canvas.addEventListener("pointermove", async () => {
    const began = performance.now();
    const wanted = canvas.view().from;
    while (canvas.painted().from !== wanted && canvas.view().from === wanted) await new Promise((next) => setTimeout(next, 1));
    window.waits.push(performance.now() - began);
  });
});
for (let k = 1; k <= 40; k++) await page.mouse.move(middleX - 10 * k, y);
await page.mouse.up();
await settled(page);
const end = await view();
const moved = (end.from - start.from) / (start.to - start.from);
check(Math.abs(moved - 400 / (box.width - 52)) < 0.01, `400 px of ${box.width} moved it by ${moved} of its length`);
const panned = await page.evaluate(() => window.waits);
// The moment is marked, and the spectrogram goes on to a moment out of sight.
await page.locator("#scrub").evaluate((slider) => {
  slider.value = 1;
  slider.dispatchEvent(new Event("input", { bubbles: true }));
});
await until("the spectrogram follows the time line", async () => {
  const [marker, view] = await page.evaluate(() => [document.getElementById("sound-moment").getBoundingClientRect().x, document.getElementById("spectrogram").view()]);
  const start = await page.evaluate(async () => (await (await fetch("about.json")).json()).span_s[0]);
  const at = box.x + 52 + ((start + 1 - view.from) / (view.to - view.from)) * (box.width - 52);
  return view.from <= start + 1 && Math.abs(marker + 1 - at) < 1.5;
});
await picture(page, pictures, "scrub-zoomed-1280");
await browser.close();
check(faults.length === 0, faults.join("\n"));
const summary = (waits) => { const sorted = [...waits].sort((a, b) => a - b); return { median: sorted[sorted.length >> 1], most: sorted[sorted.length - 1] }; };
console.log(JSON.stringify({ opened_ms: opened, step_ms: summary(steps), drag, choose_ms: summary(choices), detail_ms: detail, pan_ms: summary(panned) }));
