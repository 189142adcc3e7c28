// Shared by all browser tests: Debian's Chromium, a record of errors and of requests to other origins, and a picture folder.
import { mkdirSync } from "node:fs";
import { createRequire } from "node:module";
import { chromium } from "playwright-core";

export const require = createRequire(import.meta.url);
const ARGS = [
  "--headless", "--no-sandbox", "--disable-gpu", "--disable-quic", "--no-first-run",
  "--disable-background-networking", "--disable-component-update", "--disable-sync",
  // three.js without a graphics card
  "--enable-unsafe-swiftshader",
];

export const launch = () => chromium.launch({ executablePath: process.env.CHROMIUM ?? "/usr/bin/chromium", headless: true, args: ARGS });

/** A page whose console errors and requests to other origins are collected in `faults`. */
export async function open(browser, url, options, faults) {
  const context = await browser.newContext({ viewport: { width: 1280, height: 900 }, ...options });
  // Long enough for any machine, however busy.
  context.setDefaultTimeout(180000);
  const page = await context.newPage();
  const { origin } = new URL(url);
  page.on("console", (message) => {
    // Software rendering warns that taking a picture waits for it.
    if (/GL Driver Message .*Performance/.test(message.text())) return;
    if (["error", "warning"].includes(message.type())) faults.push(`console: ${message.text()}`);
  });
  page.on("pageerror", (error) => faults.push(`error: ${error.stack}`));
  page.on("request", (request) => {
    if (new URL(request.url()).origin !== origin) faults.push(`request to elsewhere: ${request.url()}`);
  });
  page.on("requestfailed", (request) => {
    // The stream and what is under way end with the page.
    if (!request.failure()?.errorText.includes("ERR_ABORTED")) faults.push(`request failed: ${request.url()} ${request.failure()?.errorText}`);
  });
  await page.goto(url);
  return page;
}

/** Repeats until `holds` is true; the time this takes is not judged. */
export async function until(what, holds) {
  for (const began = Date.now(); !(await holds()); ) {
    check(Date.now() - began < 180000, `waited for 180 s: ${what}`);
    await new Promise((next) => setTimeout(next, 100));
  }
}

/** Chooses among radio buttons as a hand does: by the label, once it rests and nothing covers it. */
export async function choose(page, name, value) {
  const button = `input[name=${name}][value=${value}]`;
  await page.locator(`label:has(${button})`).click();
  check(await page.locator(button).isChecked(), `${name}: ${value} is not chosen by a click on its label`);
}

export async function picture(page, folder, name) {
  if (!folder) return;
  mkdirSync(folder, { recursive: true });
  await page.screenshot({ path: `${folder}/${name}.png`, fullPage: true });
}

/** axe-core's violations, each in a line; colours that are changing are judged when they have changed. */
export async function violations(page) {
  await page.evaluate(() => Promise.allSettled(document.getAnimations().map((animation) => animation.finished)));
  await page.evaluate(require("node:fs").readFileSync(require.resolve("axe-core/axe.min.js"), "utf8"));
  const { violations } = await page.evaluate(() => window.axe.run());
  return violations.map((found) => `${found.id} (${found.impact}): ${found.help}: ${found.nodes.slice(0, 4).map((node) => `${node.html} ${node.any[0]?.message ?? ""}`).join(" | ")}`);
}

export function check(condition, what) {
  if (!condition) throw new Error(what);
}
