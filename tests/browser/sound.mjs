// The sound of a recording in the page: node sound.mjs URL PLANTED [pictures], PLANTED a JSON list of frequencies in Hz and times
// in s since the epoch. Prints the scores shown.
import { check, launch, open, picture, until, violations } from "./browser.mjs";
import { column, predicted, refined, settled } from "./spectrogram.mjs";

const [url, list, pictures] = process.argv.slice(2);
const planted = JSON.parse(list);
const faults = [];
const browser = await launch();
// Without the fade of the banner from one status to the next, during which axe-core would meet colours on the way.
const page = await open(browser, url, { reducedMotion: "reduce" }, faults);
const canvas = page.locator("#spectrogram");
await page.waitForSelector("#sound .score");
await settled(page);
await canvas.scrollIntoViewIfNeeded();

const history = await page.evaluate(async () => (await fetch("history.json")).json());

/** The prediction nearest to a planted squeal is drawn where it is, to a pixel. */
async function overlays(seconds, hz) {
  const near = predicted(history, seconds, hz);
  const { off } = await column(page, near.seconds, near.hz);
  check(off <= 1, `the prediction of ${near.hz} Hz is drawn ${off} px off`);
}
for (const { hz, time_s: seconds } of planted) await overlays(seconds, hz);

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
  return to - from < 0.33 * (whole.to - whole.from) && high - low < 0.07 * (whole.high - whole.low);
});
const detail = await refined(page);
const zoomed = await view(page);
check(detail.from_s <= zoomed.from && detail.to_s >= zoomed.to && detail.bottom_hz <= zoomed.low && detail.top_hz >= zoomed.high, `${JSON.stringify(detail)} for ${JSON.stringify(zoomed)}`);
const [zoomedX, zoomedY] = await page.evaluate(([seconds, hz]) => document.getElementById("spectrogram").position(seconds, hz), [seconds, hz]);
// Browsers round the place of a pointer to whole pixels, which the zoom magnifies.
const [timesX, timesY] = [(whole.to - whole.from) / (zoomed.to - zoomed.from), (whole.high - whole.low) / (zoomed.high - zoomed.low)];
check(Math.abs(zoomedX - x) <= timesX && Math.abs(zoomedY - y) <= timesY, `zooming moved the squeal from ${x}, ${y} to ${zoomedX}, ${zoomedY}`);
// In detail, the lightest pixel is in the row of the tone or, where a prediction covers that, beside it.
const { light, median, lightest } = await column(page, seconds, hz);
const row = (detail.row_hz / (zoomed.high - zoomed.low)) * (box.height - 22);
check(light > median + 40, `lightness ${light} at the planted ${hz} Hz, ${median} elsewhere`);
check(lightest <= row + 1, `the tone is ${lightest} px off ${hz} Hz, rows are ${row} px high`);
await overlays(seconds, hz);
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
    await settled(other);
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
