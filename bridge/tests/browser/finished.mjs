// A finished run in `semidense view`, and its report opened from a file.
import { launch, open, picture, stat, until, check, checkPage, lines } from "./browser.mjs";

/** Charts are as wide as their figures, can be read, and say what is under the pointer. */
async function checkCharts(page, name) {
  const charts = await page.evaluate(() => [...document.querySelectorAll("figure.drawn .live > svg")].map((svg) => ({
    width: svg.getBoundingClientRect().width / svg.closest("figure").clientWidth,
    text: Math.min(...[...svg.querySelectorAll("text")].map((t) => parseFloat(getComputedStyle(t).fontSize))),
  })));
  check(`${name}: charts`, charts.length > 2, JSON.stringify(charts));
  for (const c of charts) check(`${name}: a chart that can be read`, c.width > 0.8 && c.text >= 11, JSON.stringify(c));
  const first = page.locator("figure.drawn .live > svg").first();
  await first.scrollIntoViewIfNeeded(); await first.hover();
  const tip = await page.locator("figure.drawn .live .tip").first().textContent();
  check(`${name}: values under the pointer`, /\d/.test(tip) && !tip.includes("NaN"), tip);
}

const [address, report] = lines;
const browser = await launch();
try {
  for (const [name, options] of [["finished", {}], ["finished-400", { viewport: { width: 400, height: 820 }, colorScheme: "light" }]]) {
    const page = await open(browser, address, options);
    const all = await until(page, "the map", (s) => s.points > 500 && s.lit > 1000);
    await page.evaluate(() => { const t = document.getElementById("time"); t.value = 0; t.dispatchEvent(new Event("input")); });
    const begin = await stat(page);
    check("less of it at the beginning", begin.points < all.points && begin.path < all.path, JSON.stringify([begin, all]));
    await page.click("#play");
    await until(page, "the map to grow", (s) => s.points > begin.points);
    await until(page, "all of it", (s) => s.points === all.points && s.path === all.path);
    await page.waitForTimeout(600);
    await checkPage(page, name); await picture(page, name);
  }
  for (const [name, options] of [["report", {}], ["report-400", { viewport: { width: 400, height: 820 }, colorScheme: "light" }]]) {
    const page = await open(browser, report, options);
    await page.locator("#map3d").scrollIntoViewIfNeeded();
    const s = await until(page, "the map in the report", (s) => s.points > 500 && s.lit > 1000);
    check("a path in the report", s.path > 3, JSON.stringify(s));
    await checkCharts(page, name);
    await page.waitForTimeout(600);
    check(`${name}: errors`, page.errors.length === 0, page.errors.join("\n"));
    await picture(page, name);
  }
} finally { await browser.close(); }
