// Starts the 3D view of a report.
"use strict";
(() => {
  const $ = (id) => document.getElementById(`map3d${id}`);
  try {
    const text = atob($("-data").textContent), bytes = new Uint8Array(text.length);
    for (let i = 0; i < text.length; i++) bytes[i] = text.charCodeAt(i);
    $("-data").remove();
    const length = new DataView(bytes.buffer).getUint32(0, true);
    const header = JSON.parse(new TextDecoder().decode(bytes.subarray(4, 4 + length)));
    const dark = matchMedia("(prefers-color-scheme: dark)");
    const view = new Viewer($(""), { dark: dark.matches });
    dark.addEventListener("change", () => view.set({ dark: dark.matches }));
    view.load(header, bytes.subarray(4 + length));
    const choose = (group, act) => { for (const b of group.children) b.onclick = () => { for (const o of group.children) o.classList.toggle("on", o === b); act(b.dataset); }; };
    choose($("-views"), (d) => { view.isTouched = false; view.setView(d.view); });
    choose($("-colours"), (d) => view.set({ colour: d.colour }));
    new Player(view, header.end, { bar: $("-player"), play: $("-play"), time: $("-time"), clock: $("-clock"), speed: $("-speed") });
    view.onFrame = () => { $("-note").textContent = view.gridStep ? `grid: squares of ${+view.gridStep.toPrecision(1)} map unit${view.gridStep === 1 ? "" : "s"}` : ""; };
    window.stat = { get: () => ({ lit: view.litPixels(), points: view.totalPoints, drawn: view.drawn, keyframes: view.clusters.size, path: view.visiblePath }) };
  } catch (error) { $("-note").textContent = `The 3D view does not start: ${error.message}`; }
})();
