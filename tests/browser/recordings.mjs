// Several recordings in the page: node recordings.mjs URL NAMES [pictures], NAMES a JSON list of which the last cannot be read and
// the others are simulated. Prints the rig that each page names.
import { check, launch, open, picture, violations } from "./browser.mjs";

const [url, list, pictures] = process.argv.slice(2);
const names = JSON.parse(list);
const readable = names.length - 1;
const faults = [];
const browser = await launch();
const page = await open(browser, `${url}${readable}/`, {}, faults);
const shown = () => page.waitForFunction(() => Number(document.getElementById("seq").value) >= 0 && document.querySelector("#modes tbody tr"));
const rigs = [];
for (let number = readable; number >= 1; number--) {
  await page.locator("#recordings").selectOption(names[number - 1]);
  await page.waitForURL(`${url}${number}/`);
  await shown();
  check((await page.locator("#recordings").evaluate((choice) => choice.selectedOptions[0].label)) === names[number - 1], "the choice names another one");
  rigs.unshift(await page.locator("#rig").textContent());
}
const found = await violations(page);
check(found.length === 0, found.join("\n"));
await picture(page, pictures, "recordings-1280");
check(faults.length === 0, faults.join("\n"));

// One that cannot be read says why, and another can be chosen.
await page.locator("#recordings").selectOption(names[readable]);
await page.waitForFunction((name) => document.getElementById("reason").textContent.includes(name), names[readable]);
await picture(page, pictures, "recordings-unreadable-1280");
await page.locator("#recordings").selectOption(names[0]);
await shown();

// A narrow header has room for the choice and for the sign of a simulation.
for (const width of [360, 560, 800]) {
  const narrow = await open(browser, `${url}1/`, { viewport: { width, height: 740 } }, []);
  await narrow.waitForSelector("#simulated:not([hidden])");
  await narrow.waitForFunction(() => document.getElementById("recordings").options.length > 0);
  for (const alone of [false, true]) {
    // As of the page of a single recording.
    await narrow.evaluate((alone) => { document.querySelector(".recordings").hidden = alone; }, alone);
    await fits(narrow, width);
  }
  await narrow.evaluate(() => { document.querySelector(".recordings").hidden = false; });
  await picture(narrow, pictures, `recordings-${width}`);
  await narrow.context().close();
}

/** The header is no wider than the page, its first row holds all but the choice, and the rig's name has room. */
async function fits(page, width) {
  const [wide, apart, rig] = await page.evaluate(() => {
    const parts = [...document.querySelectorAll("header, header *:not(.unseen)")].map((part) => part.getBoundingClientRect().right);
    const place = (id) => document.getElementById(id).getBoundingClientRect();
    const wide = Math.max(document.documentElement.scrollWidth, ...parts) - document.documentElement.clientWidth;
    return [wide, place("theme").top - place("rig").bottom, place("rig").width];
  });
  check(wide <= 0, `${width} px: the header is ${wide} px too wide`);
  check(apart < 0, `${width} px: the header has another row`);
  check(rig > 40, `${width} px: the name of the rig has ${rig} px`);
}
await browser.close();
console.log(JSON.stringify({ rigs }));
