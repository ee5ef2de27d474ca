// A run from before its beginning to after its end, as a browser sees it. Prints `waiting`, `seen`, `ended` and `back` for
// the test that starts and ends things; reads a line before each next step.
import readline from "readline";
import { launch, open, picture, stat, until, check, checkPage, lines } from "./browser.mjs";

const [address] = lines;
const input = readline.createInterface({ input: process.stdin })[Symbol.asyncIterator]();
const step = async (word) => { console.log(word); await input.next(); };

const browser = await launch();
try {
  const page = await open(browser, address);
  await until(page, "the page", (s) => s.link === "waiting for a run");
  await picture(page, "live-waiting");
  await step("waiting");

  await until(page, "poses", (s) => s.joined && s.poses > 3);
  const s = await until(page, "points, frames and a path", (s) => s.points > 1000 && s.keyframes > 1 && s.frames > 2 && s.path > 3 && s.state === "tracking" && s.drawn > 500 && s.lit > 2000);
  await until(page, "depth over the image", (s) => s.overlay > 100);
  for (const colour of ["depth", "height", "sigma", "brightness"]) {
    await page.click(`[data-colour=${colour}]`);
    await until(page, `light by ${colour}`, (s) => s.lit > 2000);
  }
  await page.mouse.move(400, 400); await page.mouse.down(); await page.mouse.move(520, 430, { steps: 4 }); await page.mouse.up();
  await page.mouse.wheel(0, -200);
  await until(page, "light after turning", (s) => s.lit > 1000);
  await page.click("[data-view=top]"); await page.waitForTimeout(400); await picture(page, "live-top");
  await page.click("[data-view=follow]"); await page.waitForTimeout(800); await picture(page, "live-follow");
  await page.click("[data-view=orbit]"); await page.waitForTimeout(400); await picture(page, "live");
  const rows = await page.$$eval("#processes tbody tr", (all) => all.map((row) => row.innerText));
  check("three processes", rows.length === 3 && rows.every((row) => /running|ready|stale|finished/.test(row)), rows.join("|"));
  check("a histogram", (await page.$$("#latency rect.all")).length > 3);

  const late = await open(browser, address, { viewport: { width: 400, height: 820 }, hasTouch: true, isMobile: true });
  const l = await until(late, "a page that comes late to have the whole map", (s2) => s2.keyframes >= s.keyframes && s2.poses > 1);
  check("the path from its beginning", l.path > 3, JSON.stringify(l));
  await checkPage(late, "400 px"); await picture(late, "live-400");
  await late.context().close();

  await page.click("#save");
  await page.waitForFunction(() => /^saved in |failed|not|cannot/.test(document.getElementById("saved").textContent));
  const saved = await page.textContent("#saved");
  check("the map is saved", saved.startsWith("saved in "), saved);
  await checkPage(page, "live");
  console.log(saved);
  await step("seen");

  await until(page, "the end of the run", (s) => s.link === "run has ended" && !s.joined);
  check("the map stays", (await stat(page)).points > 1000);
  await step("ended");

  const again = await until(page, "the next run", (s) => s.run > 1 && s.joined && s.points > 500);
  check("it is another map", again.run > s.run);
  await checkPage(page, "the next run");
  page.mayFail = true;
  await step("again");

  await until(page, "the loss of the server", (s) => s.link === "no connection");
  await step("gone");
  await until(page, "a new connection by itself", (s) => s.link !== "no connection");
  check("errors", page.errors.length === 0, page.errors.join("\n"));
  console.log("back");
} finally { await browser.close(); }
