// The contact of a rig whose pairs open and close: node contact.mjs URL [pictures]. URL is a node with such a rig; made-up
// answers show pairs with places. Prints what the page says of the node's contact, and the fields that the answers have.
import { fileURLToPath } from "node:url";
import { check, choose, launch, open, picture, violations } from "./browser.mjs";
import { fields, serve } from "./canned.mjs";

const [url, pictures] = process.argv.slice(2);
const faults = [];
const browser = await launch();
const text = (page, id) => page.locator(`#${id}`).innerText();
const closes = (page) => page.waitForFunction(() => / pairs closed at /.test(document.getElementById("contact-note").textContent));

// Pairs on the interface: as many dots and rings as there are pairs, the leading edge on the left, nothing too wide.
const served = await serve(fileURLToPath(new URL("../../src/display/assets", import.meta.url)), "ok", { contact_state: true });
for (const [width, height] of [[360, 740], [1280, 800], [2560, 1440]]) {
  for (const colorScheme of ["light", "dark"]) {
    const where = `contact at ${width}, ${colorScheme}`;
    const page = await open(browser, served.url, { viewport: { width, height }, colorScheme }, faults);
    await page.waitForSelector('#status[data-level="ok"]');
    await choose(page, "shape-view", "contact");
    await closes(page);
    check((await page.locator("#contact-picture circle").count()) === 66, `${where}: dots`);
    check((await page.locator("#contact-picture .open").count()) === 19, `${where}: ${await page.locator("#contact-picture .open").count()} rings`);
    check(/^47 of 66 pairs closed at 500\.2 N, μ 0\.420$/.test(await text(page, "contact-note")), `${where}: ${await text(page, "contact-note")}`);
    check(/on the pad's back\s*500\.2 N/.test(await text(page, "contact-numbers")), `${where}: ${await text(page, "contact-numbers")}`);
    // At one moment: what is above it changes its height with the numbers it shows.
    const [edge, first, last, plan] = await page.evaluate(
      (selectors) => selectors.map((selector) => document.querySelector(selector).getBoundingClientRect().toJSON()),
      ["#contact-picture .edge", "#contact-picture .closed", "#contact-picture .open", "#contact-plan"],
    );
    check(edge.x < first.x && first.x < last.x, `${where}: the edge is at ${edge.x}, the largest force at ${first.x}, an open pair at ${last.x}`);
    check(first.width > 2 * last.width, `${where}: a force is ${first.width} px, an open pair ${last.width} px`);
    check(plan.height >= 80 && first.x >= plan.x && edge.y >= plan.y && edge.y + edge.height <= plan.y + plan.height + 1, `${where}: cut off`);
    check(!(await page.locator("#stage").isVisible()), `${where}: the shape is still there`);
    const wide = await page.evaluate(() => document.documentElement.scrollWidth - innerWidth);
    check(wide <= 0, `${where}: ${wide} px too wide`);
    const found = await violations(page);
    check(found.length === 0, `axe-core, ${where}: ${found.join("\n")}`);
    if (width === 360) await page.locator("#contact-plan").scrollIntoViewIfNeeded();
    await picture(page, pictures, `contact-${width}-${colorScheme}`);
    await choose(page, "shape-view", "shape");
    check((await page.locator("#stage").isVisible()) && !(await page.locator("#contact-plan").isVisible()), `${where}: no way back`);
    await page.context().close();
  }
}
served.stop();

// Rigs whose pairs are always closed offer nothing to choose.
const plain = await serve(fileURLToPath(new URL("../../src/display/assets", import.meta.url)), "ok");
let page = await open(browser, plain.url, {}, faults);
await page.waitForSelector('#status[data-level="ok"]');
check(!(await page.locator("#shape-view").isVisible()), "a contact is offered");
await page.context().close();
plain.stop();

// A node: bars by number.
page = await open(browser, url, {}, faults);
await page.waitForSelector('#status:is([data-level="ok"], [data-level="warn"], [data-level="squeal"])');
await choose(page, "shape-view", "contact");
await closes(page);
const shown = await page.evaluate(() => ({
  note: document.getElementById("contact-note").textContent,
  bars: [...document.querySelectorAll("#contact-picture rect")].map((bar) => Number(bar.getAttribute("height"))),
  titles: [...document.querySelectorAll("#contact-picture title")].map((title) => title.textContent),
}));
await picture(page, pictures, "contact-bars");
await page.context().close();
await browser.close();
check(faults.length === 0, faults.join("\n"));
console.log(JSON.stringify({ shown, fields: fields() }));
