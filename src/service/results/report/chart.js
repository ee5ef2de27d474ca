// Draws the charts of a report as wide as the page allows, and shows the values under the pointer.
"use strict";
(() => {
  const TEXT = 12, LETTER = 6.8, TOP = 10, RIGHT = 12, BOTTOM = 40;
  const make = (parent, name, attributes, text) => {
    const isSvg = parent.namespaceURI.endsWith("svg") || name === "svg";
    const node = document.createElementNS(isSvg ? "http://www.w3.org/2000/svg" : "http://www.w3.org/1999/xhtml", name);
    for (const [key, value] of Object.entries(attributes)) node.setAttribute(key, value);
    if (text !== undefined) node.textContent = text;
    return parent.appendChild(node);
  };
  /** Round values within a range, about `count` of them. */
  const ticks = ([low, high], count) => {
    const least = (high - low) / Math.max(count, 1), decade = 10 ** Math.floor(Math.log10(least));
    const step = decade * ([1, 2, 5].find((f) => f * decade >= least * (1 - 1e-9)) ?? 10), list = [];
    for (let i = Math.ceil(low / step); i * step <= high * (1 + 1e-12) && list.length < 50; i++) list.push(i * step);
    // One alone says nothing of the scale.
    return list.length < 3 && count < 20 ? ticks([low, high], count + 1) : list.map((value) => [value, written(value, step)]);
  };
  const decadeTicks = ([low, high], count) => {
    const list = [], stride = Math.ceil((Math.floor(high) - Math.ceil(low) + 1) / Math.max(count, 1));
    for (let i = Math.ceil(low); i <= high && stride > 0; i += stride) list.push([i, written(10 ** i, 10 ** i)]);
    return list;
  };
  /** A number in steps of `step`. */
  const written = (value, step) => {
    if (Math.abs(value) >= 1e7 || step < 1e-7) return value.toPrecision(3);
    const text = value.toFixed(Math.max(0, -Math.floor(Math.log10(step) + 1e-9)));
    return /^-?[0.]+$/.test(text) ? "0" : text;
  };
  /** "error [m]": what is measured, and its unit. */
  const quantity = (label) => { const [, name, unit] = label.match(/^(.*?)\s*(?:\[(.*)\])?$/); return { name, unit: unit ?? "" }; };

  class Plot {
    constructor(figure, chart) {
      Object.assign(this, { figure, chart, x: quantity(chart.xLabel), y: quantity(chart.yLabel) });
      const box = this.box = make(figure, "div", { class: "live" });
      figure.prepend(box);
      figure.classList.add("drawn");
      make(box, "h3", {}, chart.title);
      this.legend(make(box, "p", { class: "legend" }));
      make(box, "p", { class: "axis" }, chart.yLabel);
      this.svg = make(box, "svg", { role: "img", "aria-label": chart.title, tabindex: 0 });
      this.tip = make(box, "div", { class: "tip", hidden: "" });
      for (const s of chart.series) s.count = s.points.length / 2;
      for (const type of ["pointermove", "pointerdown"]) this.svg.addEventListener(type, (event) => this.hover(event));
      this.svg.addEventListener("pointerleave", (event) => { if (event.pointerType === "mouse") this.leave(); });
      this.svg.addEventListener("blur", () => this.leave());
      new ResizeObserver(() => { const width = box.clientWidth; if (width && width !== this.width) this.draw(width); }).observe(box);
    }
    legend(line) {
      const named = this.chart.series.filter((s) => s.name);
      for (const s of named) {
        const entry = make(line, "span", {});
        const key = make(entry, "svg", { width: 18, height: 10, class: "key" });
        make(key, "path", { d: s.mark === "dots" ? "M9 5h0" : s.mark === "bars" ? "M1 5H17" : "M0 5H18", ...this.stroke(s), "stroke-width": s.mark === "dots" ? 7 : 3 });
        const at = s.mark === "rule" ? ` ${this.value(s.points[0], "x")}` : "";
        entry.append(s.name + at);
      }
      if (!named.length) line.remove();
    }
    stroke(s) { return { stroke: s.colour, fill: "none", "stroke-linejoin": "round", "stroke-linecap": s.mark === "dots" ? "round" : "butt", ...(s.mark === "dashed" || s.mark === "rule" ? { "stroke-dasharray": "6 4" } : {}) }; }
    /** A value of an axis with its unit. */
    value(value, axis) {
      if (value === null || value === undefined) return "";
      const { scaling, x, y } = this.chart, isLog = axis === "y" && scaling === "decades";
      const range = scaling === "equal" ? Math.max(x[1] - x[0], y[1] - y[0]) : this.chart[axis][1] - this.chart[axis][0];
      const text = isLog ? String(+value.toPrecision(3)) : Number.isInteger(value) ? String(value) : written(value, range / 1000);
      return this[axis].unit ? `${text} ${this[axis].unit}` : text;
    }
    draw(width) {
      const { chart, svg } = this, isLog = chart.scaling === "decades";
      this.leave();
      this.width = width;
      let [x, y] = [chart.x, chart.y];
      const count = Math.max(2, Math.round(chart.height / 55));
      let left = 10 + LETTER * Math.max(...(isLog ? decadeTicks(y, count) : ticks(y, count)).map(([, text]) => text.length), 1);
      let plotWidth = width - left - RIGHT, plotHeight = Math.min(chart.height, 0.8 * width + 60) - TOP - BOTTOM;
      if (chart.scaling === "equal") {
        const most = Math.min(1.1 * plotWidth, 480), needed = plotWidth * (y[1] - y[0]) / (x[1] - x[0]);
        plotHeight = Math.min(Math.max(needed, 130), most);
        const unit = Math.max((x[1] - x[0]) / plotWidth, (y[1] - y[0]) / plotHeight);
        const widened = ([low, high], by) => [0.5 * (low + high - by), 0.5 * (low + high + by)];
        [x, y] = [widened(x, unit * plotWidth), widened(y, unit * plotHeight)];
      }
      const right = left + plotWidth, bottom = TOP + plotHeight;
      this.px = (v) => left + (v - x[0]) / (x[1] - x[0]) * plotWidth;
      this.py = (v) => TOP + (y[1] - (isLog ? Math.log10(v) : v)) / (y[1] - y[0]) * plotHeight;
      svg.replaceChildren();
      for (const [key, value] of Object.entries({ width, height: bottom + BOTTOM, viewBox: `0 0 ${width} ${bottom + BOTTOM}`, "font-size": TEXT, fill: "currentColor" })) svg.setAttribute(key, value);
      let grid = "";
      const label = (at, down, anchor, text) => make(svg, "text", { x: at, y: down, "text-anchor": anchor, opacity: 0.8 }, text);
      for (const [value, text] of ticks(x, Math.floor(plotWidth / 60))) { const at = this.px(value); grid += `M${at} ${TOP}V${bottom}`; label(at, bottom + 16, "middle", text); }
      for (const [value, text] of isLog ? decadeTicks(y, count) : ticks(y, Math.max(2, Math.round(plotHeight / 45)))) {
        const at = TOP + (y[1] - value) / (y[1] - y[0]) * plotHeight; grid += `M${left} ${at}H${right}`; label(left - 6, at + 4, "end", text);
      }
      label(left + plotWidth / 2, bottom + 34, "middle", chart.xLabel);
      make(svg, "path", { d: grid, stroke: "currentColor", opacity: 0.12 });
      make(svg, "path", { d: `M${left} ${TOP}V${bottom}H${right}`, stroke: "currentColor", fill: "none", opacity: 0.45 });
      for (const s of chart.series) this.drawSeries(s, bottom);
      if (!chart.series.some((s) => s.count)) label(left + plotWidth / 2, TOP + plotHeight / 2, "middle", "nothing to show");
      this.cursor = make(svg, "g", { "pointer-events": "none" });
      this.bounds = { left, right, bottom };
    }
    drawSeries(s, bottom) {
      let path = "", draws = false;
      const base = this.chart.scaling === "decades" ? bottom : this.py(0);
      for (let i = 0; i < s.count; i++) {
        const [x, y] = [s.points[2 * i], s.points[2 * i + 1]], isPoint = x !== null;
        if (isPoint) {
          const at = `${this.px(x).toFixed(1)} ${this.py(y).toFixed(1)}`;
          if (s.mark === "dots") path += `M${at}h0`;
          else if (s.mark === "bars") path += `M${at}H${this.px(x + s.size)}V${base}H${this.px(x)}z`;
          else if (s.mark === "rule") path += `M${this.px(x)} ${TOP}V${bottom}`;
          else path += (draws ? "L" : "M") + at;
        }
        draws = isPoint;
      }
      if (s.mark === "bars") make(this.svg, "path", { d: path, fill: s.colour, "fill-opacity": 0.75 });
      else make(this.svg, "path", { d: path, ...this.stroke(s), "stroke-width": s.mark === "dots" ? 2 * s.size : 1.7 });
    }
    /** The point of a series that is nearest: along x alone where all are lines over x. */
    nearest(s, u, v, alongX) {
      let best = null;
      for (let i = 0; i < s.count; i++) {
        const x = s.points[2 * i], y = s.points[2 * i + 1];
        if (x === null) continue;
        const across = this.px(s.mark === "bars" ? x + s.size / 2 : x) - u, distance = alongX ? Math.abs(across) : Math.hypot(across, this.py(y) - v);
        if (!best || distance < best.distance) best = { s, x, y, distance };
      }
      return best;
    }
    hover(event) {
      const at = this.svg.getBoundingClientRect(), u = event.clientX - at.left, v = event.clientY - at.top;
      const series = this.chart.series.filter((s) => s.mark !== "rule" && s.count);
      const alongX = !series.some((s) => s.mark === "dots") && this.chart.scaling !== "equal";
      let found = series.map((s) => this.nearest(s, u, v, alongX)).filter(Boolean).sort((a, b) => a.distance - b.distance);
      if (!found.length) return;
      if (!alongX) found = found.slice(0, 1);
      this.show(found.filter((point) => point.distance <= found[0].distance + 12));
    }
    show(found) {
      const { left, right, bottom } = this.bounds, [first] = found, middle = (p) => this.px(p.s.mark === "bars" ? p.x + p.s.size / 2 : p.x);
      this.cursor.replaceChildren();
      make(this.cursor, "path", { d: `M${middle(first)} ${TOP}V${bottom}`, stroke: "currentColor", opacity: 0.4 });
      for (const p of found) make(this.cursor, "circle", { cx: middle(p), cy: this.py(p.y), r: 4, fill: p.s.colour, stroke: "var(--paper)", "stroke-width": 1.5 });
      const x = first.s.mark === "bars" ? `${this.value(first.x, "x")} to ${this.value(first.x + first.s.size, "x")}` : this.value(first.x, "x");
      const nameOf = (s) => s.name || this.chart.series.find((other) => other.name && other.colour === s.colour)?.name || "";
      this.tip.replaceChildren();
      make(this.tip, "div", {}, `${this.x.name} ${x}`.trim());
      for (const p of found) {
        const line = make(this.tip, "div", {});
        make(line, "i", { style: `background:${p.s.colour}` });
        const name = nameOf(p.s), what = this.chart.scaling === "equal" ? [name, this.y.name].filter(Boolean).join(", ") : name || this.y.name;
        line.append(`${what} ${this.value(p.y, "y")}`);
      }
      this.tip.hidden = false;
      const width = this.tip.offsetWidth, after = middle(first) + 12;
      this.tip.style.left = `${Math.max(0, after + width > right ? middle(first) - 12 - width : after, 0)}px`;
      this.tip.style.top = `${this.svg.getBoundingClientRect().top - this.box.getBoundingClientRect().top + TOP}px`;
    }
    leave() { this.tip.hidden = true; this.cursor?.replaceChildren(); }
  }
  for (const script of document.querySelectorAll("script.chart-figures")) {
    try { new Plot(script.closest("figure"), JSON.parse(script.textContent)); } catch (error) { console.error(error); }
  }
})();
