// A wave on a ring of 24 nodes: node wave.mjs URL [pictures]. Its growing mode moves as z = cos(2 theta + omega t + c).
import { check, launch, open, picture, violations } from "./browser.mjs";

const [url, pictures] = process.argv.slice(2);
const faults = [];
const browser = await launch();
const page = await open(browser, url, {}, faults);
// The page asks for the shape again as friction moves: a growing one is kept, what comes after it is held back.
let held = false;
await page.route("**/shape.json*", async (route) => {
  const response = held ? null : await route.fetch();
  if (!held) await route.fulfill({ response });
});
const growing = () => document.querySelector("#shape").displacements && /it grows/.test(document.querySelector("#shape-note").textContent);
for (let attempt = 0; ; attempt++) {
  held = false;
  await page.locator("tr.grows .mode-button").first().click();
  await page.waitForFunction(growing);
  held = true;
  await page.waitForTimeout(300);
  if (await page.evaluate(growing)) break;
  check(attempt < 50, "no growing shape stays on the stage");
}
await page.locator("#shape-play").click();
const turn = (degrees) => page.locator("#shape-phase").evaluate((slider, value) => {
  slider.value = value;
  slider.dispatchEvent(new Event("input", { bubbles: true }));
  return document.querySelector("#shape").displacements()[0];
}, degrees);
const pixels = () => page.locator("#shape").screenshot();

/** Phase of the wave with two waves around the ring: the argument of the sum of z e^{-2 i theta}. */
const phaseOf = (u) => {
  let [re, im] = [0, 0];
  for (let k = 0; k < 24; k++) {
    const theta = 2 * Math.PI * k / 24;
    re += u[3 * k + 2] * Math.cos(2 * theta);
    im -= u[3 * k + 2] * Math.sin(2 * theta);
  }
  return [Math.atan2(im, re), 2 * Math.hypot(re, im) / 24];
};
await page.locator("#stage").scrollIntoViewIfNeeded();
const [start, height] = phaseOf(await turn(0));
const before = await pixels();
check(Math.abs(height - 1) < 1e-3, `the wave is ${height} high, expected 1`);
for (const degrees of [30, 90, 210, 330]) {
  const [phase, high] = phaseOf(await turn(degrees));
  const turned = ((phase - start) * 180 / Math.PI + 720) % 360;
  check(Math.abs(turned - degrees) < 0.01, `at a phase of ${degrees} degrees the wave has turned by ${turned}: it travels the wrong way`);
  check(Math.abs(high - 1) < 1e-3, `the wave does not travel: ${high}`);
}
check(!before.equals(await pixels()), "the picture is the same at another phase");
await picture(page, pictures, "wave");
const found = await violations(page);
check(found.length === 0, found.join("\n"));
await browser.close();
check(faults.length === 0, faults.join("\n"));
console.log("{}");
