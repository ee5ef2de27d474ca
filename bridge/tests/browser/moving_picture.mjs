// Frames for the moving picture of the live page: node moving_picture.mjs TOOLS PICTURES ADDRESS [SECONDS [PER_SECOND]]
import { launch, lines, open, picture, until } from "./browser.mjs";

const [address, seconds = "12", perSecond = "5"] = lines;
const browser = await launch();
try {
  const page = await open(browser, address, { viewport: { width: 960, height: 600 } });
  await until(page, "a map", (s) => s.points > 500);
  const count = Number(seconds) * Number(perSecond), begin = Date.now();
  for (let i = 0; i < count; i++) {
    await picture(page, `frame-${String(i).padStart(3, "0")}`);
    await page.waitForTimeout(Math.max(0, begin + (i + 1) * 1000 / Number(perSecond) - Date.now()));
  }
} finally { await browser.close(); }
