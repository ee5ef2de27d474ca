// What the scripts share: a browser without a screen, and checks that say what they waited for.
import { createRequire } from "module";

const [tools, pictures] = process.argv.slice(2);
const { chromium } = createRequire(`${tools}/`)("playwright-core");
// Of a debug build under load nothing is fast; this ends a test that hangs.
const LONGEST_WAIT = 120000;

export const lines = process.argv.slice(4);
export const picture = (page, name) => page.screenshot({ path: `${pictures}/${name}.png` });

export async function launch() {
  return chromium.launch({
    executablePath: process.env.CHROMIUM || "/usr/bin/chromium",
    args: ["--no-sandbox", "--use-angle=swiftshader", "--enable-unsafe-swiftshader", "--ignore-gpu-blocklist",
      "--disable-background-networking", "--disable-sync", "--disable-component-update", "--no-first-run"],
  });
}

/** A page that fails the test at its first error. */
export async function open(browser, address, options = {}) {
  const context = await browser.newContext({ viewport: { width: 1280, height: 800 }, colorScheme: "dark", ...options });
  context.setDefaultTimeout(LONGEST_WAIT);
  const page = await context.newPage();
  page.errors = [];
  page.on("console", (m) => { if (m.type() === "error" && !page.mayFail) page.errors.push(m.text()); });
  page.on("pageerror", (e) => page.errors.push(String(e)));
  // Nothing may be loaded from elsewhere.
  page.on("request", (r) => { const u = new URL(r.url()); if (["http:", "https:"].includes(u.protocol) && u.hostname !== "127.0.0.1") page.errors.push(`asks for ${r.url()}`); });
  await page.goto(address);
  return page;
}

export const stat = (page) => page.evaluate(() => window.stat.get());

/** Waits until the page's figures are as wanted. */
export async function until(page, what, isSo) {
  const begin = Date.now();
  for (;;) {
    const s = await page.evaluate(() => window.stat ? window.stat.get() : null);
    if (s && isSo(s)) return s;
    if (Date.now() - begin > LONGEST_WAIT) throw new Error(`waited in vain for ${what}: ${JSON.stringify(s)}; errors: ${page.errors}`);
    await page.waitForTimeout(250);
  }
}

export function check(what, isSo, detail = "") { if (!isSo) throw new Error(`${what} ${detail}`); }

/** No horizontal scrolling, and no errors. */
export async function checkPage(page, name) {
  const [wide, room] = await page.evaluate(() => [document.documentElement.scrollWidth, window.innerWidth]);
  check(`${name}: scrolls sideways`, wide <= room, `${wide} of ${room}`);
  check(`${name}: errors`, page.errors.length === 0, page.errors.join("\n"));
}
