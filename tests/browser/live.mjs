// A page on a running `demo`: node live.mjs URL [pictures]. Prints the content of the page as JSON, for comparison.
import { readFileSync } from "node:fs";
import { check, launch, open, picture, until, violations } from "./browser.mjs";

const [url, pictures] = process.argv.slice(2);
const faults = [];
const browser = await launch();
const level = (page) => page.locator("#status").getAttribute("data-level");
const reaches = (page, wanted) => page.waitForSelector(`#status[data-level="${wanted}"]`);

/** The numbers of one moment, as they are on the page. */
const look = (page) => page.evaluate(() => {
  const value = (id) => ({ text: document.getElementById(id).textContent, value: document.getElementById(id).value });
  const ids = ["margin", "mu", "answer-mu", "growth", "worst", "load", "speed", "unstable"];
  const modes = [...document.querySelectorAll("#modes tbody tr")].map((row) => ({
    id: Number(row.querySelector("button").dataset.mode),
    values: [...row.querySelectorAll("data")].map((data) => data.value),
  }));
  return { level: document.getElementById("status").dataset.level, seq: document.getElementById("seq").value, numbers: Object.fromEntries(ids.map((id) => [id, value(id)])), modes };
});
const cursor = (page) => page.locator("#map-growth .mu-cursor").evaluate((line) => line.getBoundingClientRect().x);

const page = await open(browser, url, { acceptDownloads: true }, faults);
const paint = await page.evaluate(() => new Promise((resolve) => {
  new PerformanceObserver((list) => resolve(list.getEntriesByName("first-contentful-paint")[0]?.startTime))
    .observe({ type: "paint", buffered: true });
}));
await page.waitForSelector("#map-growth canvas");
await page.waitForSelector("#modes tbody tr");

// It reaches SQUEAL and returns.
const shown = [];
const places = new Set();
/** Looks at moment after moment until `count` of them have `unstable` modes, or none. */
async function lookAt(count, unstable) {
  let found = 0;
  await until(`${count} moments ${unstable ? "with" : "without"} unstable modes`, async () => {
    const moment = await look(page);
    if (moment.seq === "" || moment.seq === shown.at(-1)?.seq) return false;
    shown.push(moment);
    places.add(Math.round(await cursor(page)));
    found += Number(moment.numbers.unstable.value) > 0 === unstable;
    return found >= count;
  });
}
await reaches(page, "squeal");
await lookAt(8, true);
await picture(page, pictures, "1280-light-squeal");
await page.waitForFunction(() => document.getElementById("status").dataset.level !== "squeal");
await lookAt(6, false);
check(places.size > 3, `the cursor stood at ${[...places]}`);

// The words agree with the colours.
const [word, panel] = await page.evaluate(() => [document.getElementById("level").textContent, document.getElementById("status").dataset.level]);
check(word.toLowerCase() === panel, `${word} on a panel of ${panel}`);

// The work of the page with everything in sight, at 30 states a second: processor time of its thread.
const wall = await open(browser, url, { viewport: { width: 2560, height: 1440 } }, faults);
await wall.waitForSelector("#map-growth canvas");
const session = await wall.context().newCDPSession(wall);
await session.send("Performance.enable", { timeDomain: "threadTicks" });
const worked = async () => (await session.send("Performance.getMetrics")).metrics.find((metric) => metric.name === "TaskDuration").value;
await wall.waitForTimeout(1000);
const [began, work0] = [Date.now(), await worked()];
await wall.waitForTimeout(5000);
const work = ((await worked()) - work0) * 1000 / (Date.now() - began);
await wall.context().close();

// A mode moves when chosen, and stops when paused.
// A WebGL canvas cannot be read back; it publishes its displacements instead.
const pixels = () => page.locator("#shape").evaluate((canvas) => (canvas.displacements ? JSON.stringify(canvas.displacements()) : canvas.toDataURL()));
await page.locator("#modes .mode-button").nth(2).click();
await page.locator("#stage").scrollIntoViewIfNeeded();
await page.waitForFunction(() => !/no mode/.test(document.getElementById("shape-note").textContent));
const first = await pixels();
await until("the mode moves", async () => (await pixels()) !== first);
await page.locator("#shape-play").click();
// The last picture may still be on its way, and a new shape may come with new conditions: then it is looked at again.
await until("the mode is at rest while paused", async () => {
  const still = await pixels();
  await page.waitForTimeout(300);
  return (await pixels()) === still;
});

// Keyboard: the table, the choices and the button are reached and work.
await page.locator("#modes .mode-button").nth(0).focus();
await page.keyboard.press("Enter");
check((await page.locator("#modes .mode-button").nth(0).getAttribute("aria-pressed")) === "true", "Enter does not choose a mode");
await page.locator("input[name=map-range][value=near]").focus();
await page.keyboard.press("ArrowRight");
check(await page.locator("input[name=map-range][value=all]").isChecked(), "the arrow does not change the range");

// The CSV.
await page.waitForSelector("#events tbody tr");
const [download] = await Promise.all([page.waitForEvent("download"), page.locator("#csv").click()]);
const csv = readFileSync(await download.path(), "utf8");
check(csv.startsWith("number,kind,onset"), `CSV begins with ${csv.slice(0, 40)}`);
check(csv.trim().split("\n").length >= 2, "CSV without an event");

// The layout is stable: the panels stay where they are for a while.
const boxes = () => page.evaluate(() => [...document.querySelectorAll(".panel")].map((panel) => {
  const { x, y, width, height } = panel.getBoundingClientRect();
  return [x, y, width, height].map(Math.round).join(",");
}).join(" "));
const before = await boxes();
await page.waitForTimeout(2000);
check((await boxes()) === before, `the layout moved from ${before} to ${await boxes()}`);
const accessible = { "1280 light": await violations(page) };

// Light and dark from a telephone to a wall.
for (const [width, height] of [[360, 740], [1280, 900], [2560, 1440]]) {
  for (const colorScheme of ["light", "dark"]) {
    const other = await open(browser, url, { viewport: { width, height }, colorScheme }, faults);
    await other.waitForSelector("#map-growth canvas");
    await other.waitForSelector("#modes tbody tr");
    await other.waitForTimeout(700);
    const wide = await other.evaluate(() => document.documentElement.scrollWidth - innerWidth);
    check(wide <= 0, `at ${width} px the page is ${wide} px too wide`);
    accessible[`${width} ${colorScheme}`] = await violations(other);
    await picture(other, pictures, `${width}-${colorScheme}`);
    await other.context().close();
  }
}
for (const [where, found] of Object.entries(accessible)) check(found.length === 0, `axe-core at ${where}: ${found.join("\n")}`);
await browser.close();
check(faults.length === 0, faults.join("\n"));
console.log(JSON.stringify({ first_paint_ms: paint, work, csv, shown }));
