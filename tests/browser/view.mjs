// A recording of ten minutes in the page: node view.mjs URL [pictures]. Prints how fast it was.
import { check, launch, open, picture, violations } from "./browser.mjs";

const [url, pictures] = process.argv.slice(2);
const faults = [];
const browser = await launch();
const began = Date.now();
const page = await open(browser, url, {}, faults);
await page.waitForSelector("#map-growth canvas");
await page.waitForSelector("#events tbody tr");
await page.waitForSelector("#modes tbody tr");
const opened = Date.now() - began;
check(await page.locator("#timeline").isVisible(), "no time line");
const clock = () => page.locator("#scrub").evaluate((slider) => Number(slider.value));
const seq = () => page.locator("#seq").evaluate((data) => Number(data.value));

// Scrub: how long until the numbers are those of the moment.
const waits = [];
for (const share of [0.1, 0.9, 0.35, 0.6, 0.2]) {
  const before = await seq();
  const wait = await page.evaluate(async (share) => {
    const slider = document.getElementById("scrub");
    const data = document.getElementById("seq");
    const old = data.value;
    const began = performance.now();
    slider.value = share * slider.max;
    slider.dispatchEvent(new Event("input", { bubbles: true }));
    while (data.value === old && performance.now() - began < 3000) await new Promise((next) => setTimeout(next, 1));
    return performance.now() - began;
  }, share);
  waits.push(wait);
  check((await seq()) !== before, `scrubbed to ${share}, still at input ${before}`);
}

// Jump: the event's onset is SQUEAL.
await page.locator("#events tr.squeal .jump").last().click();
await page.waitForSelector('#status[data-level="squeal"]', { timeout: 3000 });
const first = await clock();
await page.locator("#next").click();
await page.waitForFunction((from) => Number(document.getElementById("scrub").value) > from, first, { timeout: 3000 });

// Play, faster, pause; by keyboard too.
await page.locator("#play-speed").selectOption("5");
const from = await clock();
await page.locator("#play").click();
await page.waitForTimeout(1500);
await page.locator("#play").click();
const played = (await clock()) - from;
check(played > 4 && played < 15, `1.5 s at 5 times the speed played ${played} s`);
const still = await clock();
await page.waitForTimeout(300);
check((await clock()) === still, "it goes on while paused");
await page.locator("h1").click();
await page.keyboard.press("ArrowRight");
await page.waitForTimeout(200);
check(Math.abs((await clock()) - still - 1) < 0.05, "the arrow does not go on by a second");
await picture(page, pictures, "view-1280");
const found = await violations(page);
check(found.length === 0, found.join("\n"));
await browser.close();
check(faults.length === 0, faults.join("\n"));
console.log(JSON.stringify({ opened_ms: opened, scrub_ms: waits }));
