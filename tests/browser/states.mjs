// The page in every status, with made-up answers: node states.mjs [pictures]. Prints the fields that the answers have.
import { fileURLToPath } from "node:url";
import { check, choose, launch, open, picture, until, violations } from "./browser.mjs";
import { fields, serve } from "./canned.mjs";

const [pictures] = process.argv.slice(2);
const assets = fileURLToPath(new URL("../../src/display/assets", import.meta.url));
const faults = [];
const browser = await launch();
const LAPTOP = { viewport: { width: 1280, height: 800 } };

const text = (page, id) => page.locator(`#${id}`).innerText();
const reaches = (page, status) => page.waitForSelector(`#status[data-level="${status}"]`);
/** Displacements on the stage, to compare whether the shape moves. */
const showsMode = (page, id) => page.waitForFunction((id) => document.getElementById("shape-note").textContent.startsWith(`mode ${id},`), id);
const displacements = (page) => page.locator("#shape").evaluate((canvas) => JSON.stringify(canvas.displacements?.() ?? null));
/** Reads the map at the friction coefficient that a key leads to. */
const readAt = async (page, ...keys) => {
  await page.locator("#map-plots").focus();
  for (const key of keys) await page.keyboard.press(key);
  return { mu: Number(await page.locator("#map-plots").getAttribute("aria-valuenow")), text: await page.locator("#map-plots").getAttribute("aria-valuetext") };
};

const WORDS = { ok: "OK", warn: "WARN", squeal: "SQUEAL", fault: "FAULT", waiting: "WAITING", no_data: "NO DATA", inactive: "INACTIVE" };

// Every status at a glance, from a telephone to a wall, light and dark.
for (const [status, word] of Object.entries(WORDS)) {
  const served = await serve(assets, status);
  const asserts = ["ok", "warn", "squeal"].includes(status);
  for (const [width, height] of [[360, 740], [1280, 800], [2560, 1440]]) {
    for (const colorScheme of ["light", "dark"]) {
      const where = `${status} at ${width}, ${colorScheme}`;
      const page = await open(browser, served.url, { viewport: { width, height }, colorScheme }, faults);
      await reaches(page, status);
      if (asserts) await showsMode(page, 1);
      await page.waitForFunction(() => document.getElementById("seq").value !== "" || document.getElementById("age").textContent === "none yet");
      check((await text(page, "level")) === word, `${where}: ${await text(page, "level")}`);
      check((await page.title()).startsWith(`${word} · tribometer`), `${where}: the tab says ${await page.title()}`);
      check((await text(page, "link-text")) === (asserts ? "live" : "connected"), `${where}: ${await text(page, "link-text")}`);
      check((await text(page, "reason")).length > 0, `${where}: no message`);
      const temperature = { warn: " · 183.4 °C, rig at 182.0", squeal: " · 183.4 °C, stale" }[status];
      const shown = (await page.locator("#temperature-fact").isVisible()) ? await page.locator("#temperature-fact").textContent() : undefined;
      check(shown === temperature, `${where}: temperature ${shown}`);
      const numbers = await page.evaluate(() => ["margin", "growth", "worst", "unstable"].map((id) => document.getElementById(id).textContent));
      const known = status === "squeal" ? 4 : asserts ? 3 : 0;
      check(numbers.filter((number) => number !== "–").length === known, `${where}: ${numbers}`);
      check((await page.locator("#modes tbody tr").count()) === (asserts ? 16 : 0), `${where}: rows in the table of modes`);
      const answer = (await page.locator(".answer").innerText()).replace(/\s+/g, " ");
      if (asserts) {
        check(/740\.0 ?Hz/.test(answer) && /0\.6630/.test(answer) && /disc 80 %/.test(answer), `${where}: ${answer}`);
        check(status === "squeal" ? /Squeals now mode 1 /.test(answer) : /Squeals next modes 1 \+ 2 /.test(answer), `${where}: ${answer}`);
        check(/pad 40 %/.test(await text(page, "shape-parts")) && /disc 100 %/.test(await text(page, "shape-parts")), `${where}: ${await text(page, "shape-parts")}`);
        check(/stiffness\s*−2\.04/.test(await text(page, "shape-changes")), `${where}: ${await text(page, "shape-changes")}`);
      } else if (status !== "fault") {
        check(/\/rig\/operating_point \(ROS 2, domain 0\)/.test(answer) && /squealcast simulate/.test(answer), `${where}: ${answer}`);
      }
      const wide = await page.evaluate(() => document.documentElement.scrollWidth - innerWidth);
      check(wide <= 0, `${where}: ${wide} px too wide`);
      if (width > 1000) {
        for (const part of ["#stage", ".row.waterfall .plot", "#map-frequency"]) {
          const { y, height: tall } = await page.locator(part).boundingBox();
          check(y >= 0 && y + tall <= height && tall >= 80, `${where}: ${part} is at ${y} px, ${tall} px high`);
        }
      }
      const found = await violations(page);
      check(found.length === 0, `axe-core, ${where}: ${found.join("\n")}`);
      await picture(page, pictures, `${status}-${width}-${colorScheme}`);
      await page.context().close();
    }
  }
  served.stop();
}

// The map shows the window that is near at its own scale, and the whole range on request.
const served = await serve(assets, "warn");
let page = await open(browser, served.url, LAPTOP, faults);
await showsMode(page, 1);
const near = [await readAt(page, "Home"), await readAt(page, "End")];
check(near[0].mu < 0.637 && near[1].mu > 0.67 && near[1].mu - near[0].mu < 0.2, `near: ${near[0].mu} to ${near[1].mu}`);
check(/mode 1: 740\.0 Hz, \+2\d\.\d\d 1\/s/.test(near[1].text) && !/mode 14/.test(near[1].text), `near: ${near[1].text}`);
const step = await readAt(page, "Home", "ArrowRight");
check(Math.abs(step.mu - near[0].mu - 0.01 * (near[1].mu - near[0].mu)) < 1e-9, `a step leads to ${step.mu}`);
await choose(page, "map-range", "all");
const all = [await readAt(page, "Home"), await readAt(page, "End")];
check(all[0].mu === 0 && all[1].mu === 1 && /mode 14: 3110\.0 Hz/.test(all[1].text), `all: ${all[0].mu} to ${all[1].mu}, ${all[1].text}`);
await page.keyboard.press("Escape");
check((await page.locator("#map-plots").getAttribute("aria-valuetext")) === "nothing read off", "Escape still reads");
const box = await page.locator("#map-frequency .u-over").boundingBox();
await page.mouse.move(box.x + 0.25 * box.width, box.y + box.height / 2);
check(/^μ 0\.25/.test(await text(page, "map-readout")), `hover: ${await text(page, "map-readout")}`);
await choose(page, "map-range", "near");

// The shape follows the mode that grows, unless the user picked one; it stops without data.
served.turn("worst");
await showsMode(page, 14);
await page.locator("#modes .mode-button").nth(3).click();
await showsMode(page, 3);
check((await page.locator("#shape-follow").getAttribute("aria-pressed")) === "false", "a picked mode is not followed away from");
served.turn("squeal");
await page.waitForFunction(() => document.getElementById("answer-modes").textContent === "1");
await page.waitForTimeout(2000);
check((await text(page, "shape-note")).startsWith("mode 3,"), `picked mode 3, shown: ${await text(page, "shape-note")}`);
await page.locator("#shape-follow").click();
await showsMode(page, 1);
const moving = await displacements(page);
await until("the shape moves", async () => (await displacements(page)) !== moving);
served.turn("no_data");
await reaches(page, "no_data");
await page.waitForSelector("#stage.still");
// A frame that was already scheduled comes first.
await page.waitForTimeout(300);
const rest = await displacements(page);
await page.waitForTimeout(500);
check((await displacements(page)) === rest, "the shape moves without data");
// A lost connection is distinguished from a node without inputs.
served.turn("ok");
await reaches(page, "ok");
served.hang();
await reaches(page, "no_data");
await page.waitForFunction(() => document.getElementById("margin").textContent === "–");
check((await page.locator("#modes tbody tr").count()) === 0 && !(await page.locator("#answer-facts").isVisible()), "old numbers are shown after the connection went");
check(/no connection/.test(await text(page, "reason")) && /no answer/.test(await text(page, "link-text")), await text(page, "reason"));
await page.context().close();

// On a wall the chosen mode stays in sight in its table.
const wall = await serve(assets, "worst");
page = await open(browser, wall.url, { viewport: { width: 2560, height: 1440 } }, faults);
await showsMode(page, 14);
const [row, table] = await Promise.all([page.locator("tr.chosen").boundingBox(), page.locator(".modes .scroll").boundingBox()]);
check(row.y >= table.y && row.y + row.height <= table.y + table.height + 1, `the chosen row is at ${row.y}, the table from ${table.y} on, ${table.height} px high`);
await page.context().close();
wall.stop();
served.stop();

// A demo says that it is simulated.
const demo = await serve(assets, "ok", { simulated: true, inputs: null });
page = await open(browser, demo.url, LAPTOP, faults);
await reaches(page, "ok");
check(await page.locator("#simulated").isVisible(), "not called simulated");
await page.context().close();
demo.stop();

await browser.close();
check(faults.length === 0, faults.join("\n"));
console.log(JSON.stringify(fields()));
