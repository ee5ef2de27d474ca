// The latency histogram: half octaves from 1 µs, as the processes count them; all of the run, and its last ten seconds.
"use strict";

const Charts = (() => {
  const RECENT_MS = 10000, WIDTH = 340, HEIGHT = 96, BASE = 78;
  const SVG = "http://www.w3.org/2000/svg";
  const endMs = (i) => 2 ** ((i + 1) / 2) / 1000;
  const history = [];

  function element(name, attributes, text) {
    const e = document.createElementNS(SVG, name);
    for (const [k, v] of Object.entries(attributes)) e.setAttribute(k, v);
    if (text !== undefined) e.textContent = text;
    return e;
  }
  const nice = (ms) => ms >= 100 ? `${Math.round(ms)} ms` : ms >= 1 ? `${+ms.toPrecision(2)} ms` : `${Math.round(ms * 1000)} µs`;

  /** Draws the counts into `place`; `times` has p50 and p99 in ms. */
  function latency(place, counts, times) {
    const now = performance.now();
    const before = history[history.length - 1];
    if (before && counts.some((n, i) => n < before.counts[i])) history.length = 0;
    history.push({ now, counts });
    while (history.length > 1 && now - history[1].now > RECENT_MS) history.shift();
    const recent = counts.map((n, i) => n - history[0].counts[i]);
    let low = counts.findIndex((n) => n > 0), high = counts.length - 1;
    if (low < 0) { place.textContent = "no frame yet"; return; }
    while (high > low && !counts[high]) high--;
    low = Math.max(0, Math.min(low - 1, high - 7)); high = Math.min(counts.length - 1, Math.max(high + 1, low + 8));
    const n = high - low + 1, step = WIDTH / n, all = Math.max(...counts), most = Math.max(...recent, 1);
    const svg = element("svg", { viewBox: `0 0 ${WIDTH} ${HEIGHT}`, role: "img" });
    const sum = recent.reduce((a, b) => a + b, 0);
    svg.append(element("title", {}, `p50 ${nice(times.p50 || 0)}, p99 ${nice(times.p99 || 0)} since the start; ${sum} frames in the last 10 s`));
    for (let i = low; i <= high; i++) {
      const x = (i - low) * step, tall = (v, m) => v > 0 ? Math.max(1.5, 66 * v / m) : 0;
      const bar = (cls, h, inset) => {
        const r = element("rect", { class: cls, x: x + inset, width: Math.max(step - 2 * inset, 1), y: BASE - h, height: h, rx: 1.5 });
        r.append(element("title", {}, `${nice(i ? endMs(i - 1) : 0)} to ${nice(endMs(i))}: ${counts[i]} frames since the start, ${recent[i]} in the last 10 s`));
        svg.append(r);
      };
      bar("all", tall(counts[i], all), 1); bar("recent", tall(recent[i], most), Math.min(4, step / 4));
      if ((i - low) % Math.max(1, Math.ceil(n / 6)) === 0) svg.append(element("text", { x, y: BASE + 13 }, nice(i ? endMs(i - 1) : 0)));
    }
    svg.append(element("line", { x1: 0, x2: WIDTH, y1: BASE, y2: BASE }));
    const at = (ms) => Math.max(0, Math.min(WIDTH, (2 * Math.log2(Math.max(ms, 1e-3) * 1000) - low) * step));
    for (const [name, ms] of [["p50", times.p50], ["p99", times.p99]]) {
      if (!(ms > 0)) continue;
      const mark = element("line", { class: "mark", x1: at(ms), x2: at(ms), y1: 2, y2: BASE });
      mark.append(element("title", {}, `${name} ${nice(ms)}`));
      svg.append(mark);
    }
    place.replaceChildren(svg);
  }
  return { latency, nice, forget: () => { history.length = 0; } };
})();
