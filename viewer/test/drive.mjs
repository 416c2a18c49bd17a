// Drives the page in a headless Chromium: node drive.mjs CHROMIUM URL < steps.json; prints the results as JSON.
// A step is one of {goto}, {wait: js, ms}, {eval: js}, {click: selector}, {select: [selector, value]}, {range: [selector, value]},
// {drag: [x0, y0, x1, y1]} (shares of the canvas), {file: [selector, path]}, {shot: path}, {press: key}.
import { chromium } from "playwright-core";
import { readFileSync } from "node:fs";

const [executablePath, url] = process.argv.slice(2);
const steps = JSON.parse(readFileSync(0, "utf8"));
const browser = await chromium.launch({
  executablePath, headless: true,
  args: ["--no-sandbox", "--use-angle=swiftshader", "--use-gl=angle", "--enable-unsafe-swiftshader", "--ignore-gpu-blocklist", "--disable-dev-shm-usage"],
});
const context = await browser.newContext({ viewport: { width: 760, height: 460 }, deviceScaleFactor: 1 });
const page = await context.newPage();
page.setDefaultTimeout(60000);
const said = [], fetched = [];
page.on("console", (m) => { if (m.type() === "error") said.push(m.text()); });
page.on("pageerror", (e) => said.push(String(e)));
page.on("request", (r) => fetched.push(r.url().slice(0, 200)));
const results = [];
const session = await context.newCDPSession(page); // evaluates past the page's own policy, which forbids eval
async function evaluate(expression) {
  const { result, exceptionDetails } = await session.send("Runtime.evaluate", { expression, awaitPromise: true, returnByValue: true });
  if (exceptionDetails) throw new Error(exceptionDetails.exception?.description ?? exceptionDetails.text);
  return result.value;
}
async function until(expression, ms) {
  for (const end = Date.now() + ms; ; ) {
    if (await evaluate(expression)) return;
    if (Date.now() > end) throw new Error(`waited in vain for ${expression}`);
    await new Promise((done) => setTimeout(done, 100));
  }
}
try {
  await page.goto(url);
  for (const step of steps) {
    const [kind] = Object.keys(step), value = step[kind];
    if (kind === "goto") await page.goto(value);
    else if (kind === "wait") await until(value, step.ms ?? 60000);
    else if (kind === "eval") results.push(await evaluate(value));
    else if (kind === "click") await page.click(value);
    else if (kind === "select") await page.selectOption(...value);
    else if (kind === "range") await page.$eval(value[0], (e, v) => { e.value = v; e.dispatchEvent(new Event("input")); }, value[1]);
    else if (kind === "drag") {
      const box = await page.locator("#canvas").boundingBox();
      const at = (x, y) => [box.x + x * box.width, box.y + y * box.height];
      await page.mouse.move(...at(value[0], value[1]));
      await page.mouse.down();
      await page.mouse.move(...at(value[2], value[3]), { steps: 4 });
      await page.mouse.up();
    } else if (kind === "file") await page.setInputFiles(...value);
    else if (kind === "press") await page.keyboard.press(value);
    else if (kind === "shot") await page.screenshot({ path: value });
    else throw new Error(`unknown step ${kind}`);
  }
  console.log(JSON.stringify({ results, said, fetched }));
} catch (error) {
  console.log(JSON.stringify({ failed: String(error), results, said, fetched }));
} finally {
  await browser.close();
}
