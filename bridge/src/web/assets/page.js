// The page: connects, takes messages apart, shows them; connects again whenever the connection is lost.
"use strict";

const $ = (id) => document.getElementById(id);
const RETRY_MS = [300, 700, 1500, 3000];
const POINT_BYTES = 8, PLACE_BYTES = 40, PATH_BYTES = 32;
// A relative deviation as its code, as a share of 255: see scene.rs.
const sigmaCode = (relative) => relative >= 1 ? 1 : (1 + 254 * Math.log(relative / 1e-3) / Math.log(1e3)) / 255;
const grouped = (n) => Math.round(n).toString().replace(/\B(?=(\d{3})+$)/g, " ");
const short = (n) => n >= 1e6 ? `${(n / 1e6).toFixed(2)} M` : n >= 1e4 ? `${Math.round(n / 1e3)} k` : grouped(n);

let viewer, overlay, socket, tries = 0, isFinished = false;
const seen = { poses: 0, run: null, joined: false, pose: null, health: {}, instance: "", lastPose: 0 };

// ---- theme ------------------------------------------------------------------------------------------------------
function setTheme(theme) {
  document.documentElement.dataset.theme = theme;
  if (viewer) viewer.set({ dark: theme === "dark" });
}
function startTheme() {
  const light = matchMedia("(prefers-color-scheme: light)");
  let chosen = null;
  try { chosen = localStorage.getItem("theme"); } catch { /* private window */ }
  setTheme(chosen || (light.matches ? "light" : "dark"));
  light.addEventListener("change", () => { if (!chosen) setTheme(light.matches ? "light" : "dark"); });
  $("theme").onclick = () => {
    chosen = document.documentElement.dataset.theme === "dark" ? "light" : "dark";
    setTheme(chosen);
    try { localStorage.setItem("theme", chosen); } catch { /* private window */ }
  };
}

// ---- connection -------------------------------------------------------------------------------------------------
function connect() {
  socket = new WebSocket(`ws://${location.host}/stream`);
  socket.binaryType = "arraybuffer";
  socket.onopen = () => { tries = 0; sayFrames(); };
  socket.onmessage = (event) => {
    try { take(event.data); } catch (error) { console.error(error); }
  };
  socket.onclose = () => {
    setLink("gone", "no connection");
    if (!seen.run) showMessage("No connection", "The server cannot be reached. This page reconnects automatically.");
    setTimeout(connect, RETRY_MS[Math.min(tries++, RETRY_MS.length - 1)]);
  };
}
function say(words) { if (socket && socket.readyState === 1) socket.send(JSON.stringify(words)); }
/** No images for a page that nobody sees. */
function sayFrames() { say({ frames: !document.hidden }); }
document.addEventListener("visibilitychange", sayFrames);

function take(data) {
  if (typeof data === "string") { const m = JSON.parse(data); (handlers[m.kind] || (() => {}))(m); return; }
  const length = new DataView(data).getUint32(0, true);
  const header = JSON.parse(new TextDecoder().decode(new Uint8Array(data, 4, length)));
  (handlers[header.kind] || (() => {}))(header, data, 4 + length);
}

const handlers = {
  hello(m) { seen.instance = m.instance; $("link").title = `semidense ${m.version}`; },
  run(m) {
    if (seen.run !== m.run) {
      seen.run = m.run;
      viewer.clear(); overlay.clear(); Charts.forget();
      Object.assign(seen, { pose: null, health: {} });
    }
    seen.joined = m.joined; seen.known = m.keyframes; seen.note = m.note;
    if (m.active !== null) viewer.setActive(m.active);
    setLink(m.joined ? "live" : "waiting", m.joined ? "live" : m.run ? "run has ended" : "waiting for a run");
    if (!m.joined && m.run === 0) showMessage("Waiting for a run", `No instance "${seen.instance}" is running yet. Start one with semidense run.`);
    else if (m.joined && !seen.pose) showMessage("Waiting for the first frame", "The processes are starting.");
    $("save").disabled = !m.joined;
    if (!m.joined) showState(m.run ? "ended" : "waiting", m.run ? "the map remains until the next run begins" : "for a run to begin", "none");
    figures();
  },
  health(m) { for (const p of m.processes) seen.health[p.process] = p; processes(); },
  pose(m) {
    seen.poses++; seen.pose = m; seen.lastPose = performance.now();
    hideMessage();
    viewer.setEpoch(m.epoch);
    const c = viewer.clusters.get(m.keyframe) || viewer.clusters.values().next().value;
    if (m.code !== 0) viewer.setCamera({ place: m.place, state: m.code, covariance: m.code === 3 ? null : m.covariance, k: c && c.k, size: c && c.size });
    if (seen.joined) showState(m.state, m.reason, m.state);
  },
  places(_, data, at) {
    const view = new DataView(data), list = new Map();
    for (let o = at; o + PLACE_BYTES <= data.byteLength; o += PLACE_BYTES) {
      const place = Array.from({ length: 8 }, (_, i) => view.getFloat32(o + 8 + 4 * i, true));
      const epoch = view.getUint32(o + 4, true);
      if (!list.has(epoch)) list.set(epoch, []);
      list.get(epoch).push([view.getUint32(o, true), place]);
    }
    const known = new Set();
    for (const [epoch, places] of list) { viewer.setPlaces(places, epoch); for (const [id] of places) known.add(id); }
    for (const id of [...viewer.clusters.keys()]) if (!known.has(id)) viewer.removeCluster(id);
  },
  path(m, data, at) {
    const view = new DataView(data);
    const poses = m.from ? viewer.path.slice(0, m.from) : [];
    for (let o = at; o + PATH_BYTES <= data.byteLength; o += PATH_BYTES) {
      poses.push({ t: view.getFloat64(o, true), local: [8, 12, 16].map((k) => view.getFloat32(o + k, true)),
        id: view.getUint32(o + 20, true), epoch: view.getUint32(o + 24, true), state: view.getUint32(o + 28, true) });
    }
    for (const pose of poses.slice(m.from)) viewer.placePose(pose);
    viewer.path = poses; viewer.pathDirty = true; viewer.touch();
  },
  keyframe(m, data, at) {
    const cluster = { id: m.id, epoch: m.epoch, t: m.t, k: m.k, size: m.size, depthStep: m.depthStep,
      count: (data.byteLength - at) / POINT_BYTES, data: new Uint8Array(data, at), place: viewer.places.get(m.id) || [0, 0, 0, 0, 0, 0, 1, 1] };
    const hadPlace = viewer.places.has(m.id);
    viewer.setCluster(cluster);
    if (!hadPlace) viewer.places.delete(m.id);
    say({ ack: 1 });
    figures();
  },
  frame(m, data, at) {
    overlay.setFrame(m, new Uint8Array(data, at)).then(() => cameraNote(m)).catch((error) => console.error(error)).finally(() => say({ ack: 1 }));
  },
};

function cameraNote(m) {
  $("camera-note").textContent = overlay.shown ? `frame ${m.sequence}: ${grouped(overlay.shown)} points of keyframe ${overlay.shownKeyframe}, projected with the pose` : `frame ${m.sequence}`;
}

// ---- words and figures ------------------------------------------------------------------------------------------
function setLink(kind, words) { $("link").dataset.link = kind; $("link").textContent = words; }
function showMessage(title, text) {
  const strong = document.createElement("strong"); strong.textContent = title;
  const span = document.createElement("span"); span.textContent = text;
  $("message").replaceChildren(strong, span); $("message").hidden = false;
}
function hideMessage() { $("message").hidden = true; }
function showState(word, reason, kind) {
  $("word").textContent = word; $("reason").textContent = reason; $("state").dataset.state = kind;
}
const number = (x, digits) => x === null || x === undefined ? "–" : x.toFixed(digits);
function processes() {
  const rows = [], causes = [];
  for (const name of ["capture", "tracker", "mapper"]) {
    const p = seen.health[name], row = document.createElement("tr");
    const cells = p ? [name, p.state, number(p.rate_hz, 1), grouped(p.dropped + (name === "capture" ? p.gaps : 0)), grouped(p.deadline_misses), number(p.latency_ms.p50, 1), number(p.latency_ms.p99, 1)] : [name, "–", "–", "–", "–", "–", "–"];
    cells.forEach((text, i) => {
      const cell = document.createElement("td"); cell.textContent = text;
      if (p && ((i === 1 && ["failed", "stale"].includes(p.state)) || (i === 3 && p.dropped > 0.01 * p.frames) || (i === 4 && p.deadline_misses > 0.01 * p.frames))) cell.className = "alarm";
      row.append(cell);
    });
    rows.push(row);
    if (p && p.cause) causes.push(`${name}: ${p.cause}`);
    if (p && p.warning) causes.push(`${name}: ${p.warning}`);
  }
  document.querySelector("#processes tbody").replaceChildren(...rows);
  $("causes").textContent = causes.length ? causes.join(" · ") : "times in ms since the start: capture from stamp to sending, tracker from stamp to pose, mapper per frame";
  const { capture, tracker } = seen.health;
  if (tracker) {
    Charts.latency($("latency"), tracker.latency_counts, tracker.latency_ms);
    const t = tracker.latency_ms;
    $("times").textContent = t.p50 ? `frame to pose: p50 ${Charts.nice(t.p50)}, p99 ${Charts.nice(t.p99)}` : "from the frame's stamp to its pose";
  }
  if (capture && capture.source) $("source").textContent = (seen.instance === "semidense" ? "" : `${seen.instance} · `) + capture.source;
  figures();
}
function list(pairs) {
  $("figures").replaceChildren(...pairs.filter(Boolean).flatMap(([name, value]) => {
    const dt = document.createElement("dt"), dd = document.createElement("dd");
    dt.textContent = name; dd.textContent = value;
    return [dt, dd];
  }));
}
function figures() {
  if (isFinished) return;
  const m = seen.health.mapper, p = seen.pose, hidden = [...viewer.clusters.values()].filter((c) => !viewer.isShown(c)).length;
  const missing = (seen.known || 0) - viewer.clusters.size;
  list([
    ["keyframes", `${grouped(seen.known || 0)}${hidden ? `, ${hidden} of other epochs hidden` : ""}`],
    ["points", short(viewer.totalPoints)],
    missing > 0 && ["depth still missing", `${missing} keyframes`],
    p && ["epoch, map revision", `${p.epoch}, ${p.map_revision}`],
    m && ["loops closed, held", `${m.loops.closed}, ${m.loops.held} of ${m.loops.searched} searches`],
    m && ["joint estimates", `${grouped(m.adjustments)}, ${m.adjustments_dropped} dropped`],
    p && ["points in view, explained", `${Math.round(100 * p.in_view)} %, ${Math.round(100 * p.inliers)} %`],
    p && ["position ±1σ", positionSigma(p.covariance)],
    seen.note && ["note", seen.note],
  ]);
}
/** Root of the largest variance of the position, map units. */
function positionSigma(c) {
  const trace = Math.max(c[0], 0) + Math.max(c[3], 0) + Math.max(c[5], 0);
  return trace < 1e4 ? `${(1000 * Math.sqrt(trace)).toPrecision(2)} / 1000 map units` : "unknown";
}
function legend() {
  const o = viewer.options, lines = [];
  const line = (...parts) => { const d = document.createElement("div"); d.append(...parts); lines.push(d); };
  const swatch = (colour) => { const s = document.createElement("span"); s.className = "swatch"; s.style.background = colour; return s; };
  const scale = (stops) => { const s = document.createElement("span"); s.className = "scale"; s.style.background = `linear-gradient(90deg, ${stops})`; return s; };
  const rainbow = "rgb(48,18,59),rgb(70,107,227),rgb(40,188,235),rgb(50,242,152),rgb(164,252,60),rgb(238,207,58),rgb(251,126,33),rgb(210,49,5),rgb(122,4,3)";
  const heat = "rgb(60,90,220),rgb(120,90,225),rgb(195,85,195),rgb(240,100,110),rgb(255,170,60),rgb(255,245,150)";
  if (o.colour === "depth") line("far", scale(rainbow), "near its keyframe");
  if (o.colour === "height") line("low", scale(rainbow), "high");
  if (o.colour === "sigma") line("σ/d 1 %", scale(heat), "30 %");
  line(swatch("rgb(64,156,255)"), "path, tracking", " "); line(swatch("rgb(255,176,32)"), "degraded");
  if (viewer.camera && viewer.camera.covariance) line(swatch("rgb(255,107,191)"), `position ±1σ, drawn ${grouped(viewer.exaggeration)}× as large`);
  if (o.grid && viewer.gridStep) line(`grid: squares of ${+viewer.gridStep.toPrecision(1)} map units`);
  $("legend").replaceChildren(...lines);
}

// ---- controls ---------------------------------------------------------------------------------------------------
function choose(group, button) { for (const b of group.children) b.classList.toggle("on", b === button); }
function controls() {
  for (const b of $("views").children) b.onclick = () => {
    if (b.dataset.view === "fit") { viewer.isTouched = false; viewer.fit(); return; }
    choose($("views"), b); viewer.isTouched = false; viewer.setView(b.dataset.view);
  };
  for (const b of $("colours").children) b.onclick = () => { choose($("colours"), b); viewer.set({ colour: b.dataset.colour }); legend(); };
  for (const b of $("overlays").children) b.onclick = () => { choose($("overlays"), b); overlay.mode = b.dataset.overlay; overlay.draw(); };
  const sigma = () => { const code = sigmaCode(+$("sigma").value); viewer.set({ maxSigma: code }); overlay.maxSigma = code; overlay.draw(); };
  $("sigma").onchange = sigma; sigma();
  for (const id of ["keyframes", "grid"]) $(id).onchange = () => viewer.set({ [id]: $(id).checked });
  $("save").onclick = save;
}
async function save() {
  $("save").disabled = true; $("saved").textContent = "saving …";
  try {
    const answer = await fetch("/api/save", { method: "POST" });
    const text = await answer.text();
    $("saved").textContent = answer.ok ? `saved in ${JSON.parse(text).folder}` : text;
  } catch (error) { $("saved").textContent = `not saved: ${error.message}`; }
  $("save").disabled = !seen.joined;
}

// ---- a finished run ---------------------------------------------------------------------------------------------
async function showFinished(folder, summary) {
  isFinished = true;
  document.body.classList.add("finished");
  setLink("waiting", "finished run"); $("source").textContent = folder;
  showMessage("Loading", "the map");
  const block = await (await fetch("/api/run")).arrayBuffer();
  const length = new DataView(block).getUint32(0, true);
  const header = JSON.parse(new TextDecoder().decode(new Uint8Array(block, 4, length)));
  viewer.load(header, new Uint8Array(block, 4 + length));
  hideMessage();
  showState("finished", "move the slider, or press ▶, to see the map grow", "none");
  finishedFigures(header, summary || {});
  new Player(viewer, header.end, { bar: $("player"), play: $("play"), time: $("time"), clock: $("clock"), speed: $("speed") });
}

/** The figures of the summary that a reader looks for first. */
function finishedFigures(header, s) {
  const percent = (part, all) => `${(100 * part / Math.max(all, 1)).toFixed(1)} %`, ms = (t) => t && `${t.p50.toFixed(1)} ms, p99 ${t.p99.toFixed(1)} ms`;
  list([
    s.source && ["source", s.source],
    s.mode && ["mode", s.mode],
    ["length", `${header.end.toFixed(1)} s`],
    s.frames_in && ["frames tracked", `${percent(s.frames_tracked, s.frames_in)} of ${grouped(s.frames_in)}`],
    s.lost_count !== undefined && ["lost", `${s.lost_count} times`],
    ["keyframes", grouped(header.clusters.length)],
    ["points of map.ply", header.shown < header.points ? `${grouped(header.shown)} of ${grouped(header.points)} shown` : grouped(header.points)],
    s.latency_ms && ["latency", ms(s.latency_ms)],
    s.track_ms && ["tracking a frame", ms(s.track_ms)],
    typeof s.ate_rmse_m === "number" && ["position error (ATE)", `${(100 * s.ate_rmse_m).toFixed(2)} cm`],
    s.grade && s.grade.level && ["grade", s.grade.level],
  ]);
}

// ---- start ------------------------------------------------------------------------------------------------------
function start() {
  startTheme();
  try {
    viewer = new Viewer($("map"), { dark: document.documentElement.dataset.theme === "dark" });
    overlay = new Overlay($("camera"), (id) => viewer.clusters.get(id));
  } catch (error) { showMessage("No 3D view", `${error.message}: turn on hardware acceleration, or use another browser`); return; }
  controls();
  setInterval(() => {
    legend();
    $("drawn").textContent = `${short(viewer.drawn)} of ${short(viewer.totalPoints)} points${viewer.fps && !viewer.isStill ? `, ${Math.round(viewer.fps)} frames/s` : ""}`;
    // Poses that stay away are no pose that holds.
    if (seen.joined && seen.pose && performance.now() - seen.lastPose > 3000) showState("no new poses", "for some seconds: the source is paused, or a process does not respond", "none");
  }, 400);
  // For tests and the curious.
  window.stat = { get: () => ({ lit: viewer.litPixels(), points: viewer.totalPoints, drawn: viewer.drawn, fps: viewer.fps, poses: seen.poses, keyframes: viewer.clusters.size, frames: overlay.images, overlay: overlay.shown || 0,
    state: $("word").textContent, run: seen.run, joined: seen.joined, path: viewer.visiblePath, budget: viewer.budget, link: $("link").textContent }), viewer: () => viewer };
  fetch("/api/mode").then((r) => r.json()).then((m) => m.mode === "finished" ? showFinished(m.folder, m.summary) : connect())
    .catch(() => connect());
}
start();
