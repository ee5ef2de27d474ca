// The 3D view of a map: points of keyframes, keyframes, trajectory, camera. Plain WebGL2, no other file.
//
// Used by the live page, by `semidense view FOLDER` and, inlined, by report.html. Axes of a camera: x right, y down,
// z forward. A place is [tx, ty, tz, qx, qy, qz, qw, scale]: where the map has a keyframe, and its unit.
// A cluster holds the points of one keyframe, 8 bytes each: three u16, grey u8, relative deviation u8 (0 unknown,
// 1 to 255 from 0.1 % to 100 %, logarithmic), in random order, so that the first n are an even sample of all.
"use strict";

const Viewer = (() => {
  // Budget in points: adapted to the time of a frame between these. A software renderer manages the smallest.
  const SMALLEST_BUDGET = 50000, LARGEST_BUDGET = 4000000, FIRST_BUDGET = 400000;
  // Time of a frame in ms above which less is drawn, and below which more.
  const SLOW_MS = 30, FAST_MS = 19;
  // A view that does not move is drawn once more with more points, as many as take this long, at most so many budgets.
  const STILL_MS = 300, STILL_BUDGETS = 8, STILL_AFTER_MS = 250;
  const POINT_BYTES = 8, SEGMENT_BYTES = 32;
  const STATE_COLOURS = { 1: [64, 156, 255], 2: [255, 176, 32], 3: [235, 70, 70], 0: [150, 150, 160] };

  // ---- small vector algebra -------------------------------------------------------------------------------------
  const sub = (a, b) => [a[0] - b[0], a[1] - b[1], a[2] - b[2]];
  const add = (a, b, k = 1) => [a[0] + k * b[0], a[1] + k * b[1], a[2] + k * b[2]];
  const dot = (a, b) => a[0] * b[0] + a[1] * b[1] + a[2] * b[2];
  const cross = (a, b) => [a[1] * b[2] - a[2] * b[1], a[2] * b[0] - a[0] * b[2], a[0] * b[1] - a[1] * b[0]];
  const norm = (a) => Math.hypot(a[0], a[1], a[2]);
  const unit = (a) => { const n = norm(a); return n > 1e-12 ? [a[0] / n, a[1] / n, a[2] / n] : [0, 0, 1]; };
  const mix = (a, b, k) => a.map((x, i) => x + (b[i] - x) * k);

  /** Rotation of a quaternion x, y, z, w, row by row. */
  function rotation(x, y, z, w) {
    return [1 - 2 * (y * y + z * z), 2 * (x * y - z * w), 2 * (x * z + y * w),
      2 * (x * y + z * w), 1 - 2 * (x * x + z * z), 2 * (y * z - x * w),
      2 * (x * z - y * w), 2 * (y * z + x * w), 1 - 2 * (x * x + y * y)];
  }
  /** Column-major 4x4 of a place. */
  function matrixOf(p) {
    const r = rotation(p[3], p[4], p[5], p[6]), s = p.length > 7 ? p[7] : 1;
    return [r[0] * s, r[3] * s, r[6] * s, 0, r[1] * s, r[4] * s, r[7] * s, 0, r[2] * s, r[5] * s, r[8] * s, 0,
      p[0], p[1], p[2], 1];
  }
  const apply = (m, v) => [m[0] * v[0] + m[4] * v[1] + m[8] * v[2] + m[12],
    m[1] * v[0] + m[5] * v[1] + m[9] * v[2] + m[13], m[2] * v[0] + m[6] * v[1] + m[10] * v[2] + m[14]];
  function multiply(a, b) {
    const c = new Array(16);
    for (let j = 0; j < 4; j++) for (let i = 0; i < 4; i++) {
      c[4 * j + i] = a[i] * b[4 * j] + a[4 + i] * b[4 * j + 1] + a[8 + i] * b[4 * j + 2] + a[12 + i] * b[4 * j + 3];
    }
    return c;
  }
  function perspective(fovy, aspect, near, far) {
    const f = 1 / Math.tan(fovy / 2), d = 1 / (near - far);
    return [f / aspect, 0, 0, 0, 0, f, 0, 0, 0, 0, (near + far) * d, -1, 0, 0, 2 * near * far * d, 0];
  }
  function lookAt(eye, target, up) {
    const z = unit(sub(eye, target)), x = unit(cross(up, z)), y = cross(z, x);
    return [x[0], y[0], z[0], 0, x[1], y[1], z[1], 0, x[2], y[2], z[2], 0, -dot(x, eye), -dot(y, eye), -dot(z, eye), 1];
  }
  /** Lower triangle L of a covariance xx xy xz yy yz zz with L Lᵀ = it. */
  function cholesky(c) {
    const a = Math.sqrt(Math.max(c[0], 0)), b = a > 0 ? c[1] / a : 0, d = a > 0 ? c[2] / a : 0;
    const e = Math.sqrt(Math.max(c[3] - b * b, 0)), f = e > 0 ? (c[4] - b * d) / e : 0;
    return [a, b, d, e, f, Math.sqrt(Math.max(c[5] - d * d - f * f, 0))];
  }

  // ---- shaders --------------------------------------------------------------------------------------------------
  const POINT_VERTEX = `#version 300 es
    precision highp float;
    layout(location=0) in vec3 q; layout(location=1) in vec2 g;
    uniform mat4 transform; uniform vec4 camera, origin, step_, zrow; uniform vec4 look; uniform vec4 upward; uniform float sigma;
    uniform sampler2D scales; uniform vec2 tone;
    out vec3 colour; out float size;
    void main() {
      vec3 p = origin.w > 0.5 ? origin.xyz + q * step_.xyz
        : vec3((q.x - camera.z) * camera.x, (q.y - camera.w) * camera.y, 1.0) / max(q.z * step_.z, 1e-6);
      gl_Position = transform * vec4(p, 1.0);
      float depth = max(dot(zrow, vec4(p, 1.0)), 1e-6);
      size = clamp(look.x * depth / gl_Position.w, look.y, look.z);
      gl_PointSize = size;
      // Points that are less certain than wanted, and pixels without depth, leave the view.
      if (g.y > sigma || (origin.w < 0.5 && q.z < 0.5)) gl_Position = vec4(2.0, 2.0, 2.0, 1.0);
      if (look.w < 0.5) colour = vec3(mix(tone.x, tone.y, pow(g.x, 0.85))) * vec3(0.98, 0.99, 1.0);
      else if (look.w < 1.5) colour = texture(scales, vec2(clamp(step_.w / depth, 0.004, 0.996), 0.25)).rgb;
      else if (look.w < 2.5) colour = texture(scales, vec2(clamp((g.y - 0.33) / 0.5, 0.004, 0.996), 0.75)).rgb;
      else colour = texture(scales, vec2(clamp(dot(upward.xyz, p) + upward.w, 0.004, 0.996), 0.25)).rgb
        * (0.45 + 0.65 * g.x);
    }`;
  const POINT_FRAGMENT = `#version 300 es
    precision mediump float; in vec3 colour; in float size; out vec4 o;
    void main() { vec2 d = gl_PointCoord - 0.5; if (size > 2.5 && dot(d, d) > 0.25) discard; o = vec4(colour, 1.0); }`;
  const LINE_VERTEX = `#version 300 es
    precision highp float;
    layout(location=0) in vec3 a; layout(location=1) in vec3 b; layout(location=2) in vec4 c; layout(location=3) in float width;
    uniform mat4 transform; uniform vec2 pixels; uniform float near;
    out vec4 colour;
    void main() {
      vec4 p = transform * vec4(a, 1.0), r = transform * vec4(b, 1.0);
      // What lies behind the eye is cut off.
      if (p.w < near && r.w < near) { gl_Position = vec4(2.0, 2.0, 2.0, 1.0); return; }
      if (p.w < near) p = mix(p, r, (near - p.w) / (r.w - p.w));
      if (r.w < near) r = mix(r, p, (near - r.w) / (p.w - r.w));
      vec2 s = p.xy / p.w * pixels, t = r.xy / r.w * pixels, d = t - s;
      d = length(d) > 1e-4 ? normalize(d) : vec2(1.0, 0.0);
      float side = (gl_VertexID & 1) == 0 ? -1.0 : 1.0; bool end = gl_VertexID >= 2;
      vec4 v = end ? r : p;
      vec2 offset = vec2(-d.y, d.x) * side * width + d * (end ? 0.5 : -0.5) * width;
      gl_Position = v + vec4(offset / pixels * v.w, 0.0, 0.0);
      colour = c;
    }`;
  const LINE_FRAGMENT = `#version 300 es
    precision mediump float; in vec4 colour; out vec4 o; void main() { o = colour; }`;
  const BALL_VERTEX = `#version 300 es
    precision highp float; layout(location=0) in vec3 a; uniform mat4 transform; uniform mat3 shape; uniform vec3 centre, eye;
    out float rim;
    void main() {
      vec3 p = centre + shape * a; gl_Position = transform * vec4(p, 1.0);
      vec3 n = normalize(inverse(transpose(shape)) * a); rim = 1.0 - abs(dot(n, normalize(eye - p)));
    }`;
  const BALL_FRAGMENT = `#version 300 es
    precision mediump float; in float rim; uniform vec3 tint; out vec4 o;
    void main() { o = vec4(tint, 0.12 + 0.6 * rim * rim); }`;

  // Stops of the scales: inverse depth and height (far to near, low to high), and uncertainty (little to much).
  const RAINBOW = [[48, 18, 59], [70, 107, 227], [40, 188, 235], [50, 242, 152], [164, 252, 60], [238, 207, 58],
    [251, 126, 33], [210, 49, 5], [122, 4, 3]];
  const HEAT = [[60, 90, 220], [120, 90, 225], [195, 85, 195], [240, 100, 110], [255, 170, 60], [255, 245, 150]];
  function colourOf(stops, share) {
    const x = Math.min(Math.max(share, 0), 1) * (stops.length - 1), i = Math.min(Math.floor(x), stops.length - 2);
    return mix(stops[i], stops[i + 1], x - i);
  }

  function program(gl, vertex, fragment) {
    const p = gl.createProgram();
    for (const [kind, text] of [[gl.VERTEX_SHADER, vertex], [gl.FRAGMENT_SHADER, fragment]]) {
      const s = gl.createShader(kind);
      gl.shaderSource(s, text); gl.compileShader(s); gl.attachShader(p, s);
      if (!gl.getShaderParameter(s, gl.COMPILE_STATUS) && !gl.isContextLost()) throw new Error(gl.getShaderInfoLog(s));
    }
    gl.linkProgram(p);
    if (!gl.getProgramParameter(p, gl.LINK_STATUS) && !gl.isContextLost()) throw new Error(gl.getProgramInfoLog(p));
    const uniforms = {};
    for (let i = 0; i < gl.getProgramParameter(p, gl.ACTIVE_UNIFORMS); i++) {
      const name = gl.getActiveUniform(p, i).name;
      uniforms[name] = gl.getUniformLocation(p, name);
    }
    return { p, u: uniforms };
  }

  /** A list of thick line segments on the graphics card, 32 bytes each. */
  class Lines {
    constructor(gl) { this.gl = gl; this.buffer = gl.createBuffer(); this.count = 0; this.room = 0; this.fill(new Segments(0)); }
    fill(segments) {
      const gl = this.gl;
      gl.bindBuffer(gl.ARRAY_BUFFER, this.buffer);
      gl.bufferData(gl.ARRAY_BUFFER, segments.bytes.subarray(0, segments.count * SEGMENT_BYTES), gl.DYNAMIC_DRAW);
      this.count = segments.count;
    }
    draw(count = this.count) {
      if (!count) return;
      const gl = this.gl;
      gl.bindBuffer(gl.ARRAY_BUFFER, this.buffer);
      gl.vertexAttribPointer(0, 3, gl.FLOAT, false, SEGMENT_BYTES, 0);
      gl.vertexAttribPointer(1, 3, gl.FLOAT, false, SEGMENT_BYTES, 12);
      gl.vertexAttribPointer(2, 4, gl.UNSIGNED_BYTE, true, SEGMENT_BYTES, 24);
      gl.vertexAttribPointer(3, 1, gl.FLOAT, false, SEGMENT_BYTES, 28);
      for (let i = 0; i < 4; i++) { gl.enableVertexAttribArray(i); gl.vertexAttribDivisor(i, 1); }
      gl.drawArraysInstanced(gl.TRIANGLE_STRIP, 0, 4, count);
      for (let i = 0; i < 4; i++) { gl.vertexAttribDivisor(i, 0); if (i > 1) gl.disableVertexAttribArray(i); }
    }
  }
  class Segments {
    constructor(room) { this.count = 0; this.grow(Math.max(room, 1)); }
    grow(room) {
      const bytes = new Uint8Array(room * SEGMENT_BYTES);
      if (this.bytes) bytes.set(this.bytes);
      this.bytes = bytes; this.floats = new Float32Array(bytes.buffer); this.room = room;
    }
    add(a, b, colour, alpha, width) {
      if (this.count === this.room) this.grow(2 * this.room);
      const f = this.count * 8, c = f * 4 + 24;
      this.floats.set(a, f); this.floats.set(b, f + 3);
      this.bytes[c] = colour[0]; this.bytes[c + 1] = colour[1]; this.bytes[c + 2] = colour[2]; this.bytes[c + 3] = alpha * 255;
      this.floats[f + 7] = width;
      this.count++;
    }
  }

  /** Where most of a cluster's points are: centre and radius, and a near inverse depth, from a sample of them. */
  function measure(c) {
    const view = new DataView(c.data.buffer, c.data.byteOffset, c.data.byteLength);
    const num = Math.min(c.count, 400), xs = [[], [], []], ds = [];
    for (let i = 0; i < num; i++) {
      const o = i * POINT_BYTES;
      const q = [view.getUint16(o, true), view.getUint16(o + 2, true), view.getUint16(o + 4, true)];
      let p;
      if (c.box) p = q.map((x, k) => c.box.min[k] + x * c.box.step[k]);
      else {
        const d = q[2] * c.depthStep;
        if (!(d > 0)) continue;
        ds.push(d);
        p = [(q[0] - c.k[2]) / c.k[0] / d, (q[1] - c.k[3]) / c.k[1] / d, 1 / d];
      }
      p.forEach((x, k) => xs[k].push(x));
    }
    const at = (list, share) => list.length ? list[Math.min(list.length - 1, Math.floor(share * list.length))] : 0;
    for (const list of [...xs, ds]) list.sort((a, b) => a - b);
    const low = xs.map((l) => at(l, 0.05)), high = xs.map((l) => at(l, 0.95));
    return { centre: mix(low, high, 0.5), radius: Math.max(norm(sub(high, low)) / 2, 1e-6), near: at(ds, 0.95) || 0 };
  }

  return class Viewer {
    constructor(canvas, options = {}) {
      this.canvas = canvas;
      this.options = Object.assign({ colour: "brightness", view: "orbit", maxSigma: 1, dark: true, keyframes: true, grid: true }, options);
      this.clusters = new Map(); this.places = new Map(); this.path = []; this.camera = null; this.active = null; this.epoch = null;
      this.up = [0, -1, 0]; this.upIsGiven = false; this.time = Infinity; this.visiblePath = 0;
      this.budget = FIRST_BUDGET; this.drawn = 0; this.frames = 0; this.fps = 0; this.lastChange = 0; this.hasDrawn = false; this.isStill = false;
      this.eye = { yaw: 0.6, pitch: 0.55, distance: 4, target: [0, 0, 0] }; this.isFitted = false; this.isTouched = false;
      this.exaggeration = 1; this.fovy = 0.9; this.dirty = true; this.linesDirty = true; this.onFrame = null; this.matrices = null;
      this.start();
      canvas.addEventListener("webglcontextlost", (e) => { e.preventDefault(); this.gl = null; });
      canvas.addEventListener("webglcontextrestored", () => this.start());
      new ResizeObserver(() => this.touch()).observe(canvas);
      this.listen();
      // What a frame takes shows in when the next one may begin.
      let before = 0;
      const loop = (now) => {
        if (this.hasDrawn) this.adapt(now - before);
        before = now; this.hasDrawn = false;
        this.tick(now); requestAnimationFrame(loop);
      };
      requestAnimationFrame(loop);
    }

    /** Prepares the graphics card; again when that was lost. */
    start() {
      const gl = this.canvas.getContext("webgl2", { alpha: false, antialias: true, powerPreference: "high-performance" });
      if (!gl) throw new Error("this browser has no WebGL 2");
      this.gl = gl;
      this.points = program(gl, POINT_VERTEX, POINT_FRAGMENT);
      this.lines = program(gl, LINE_VERTEX, LINE_FRAGMENT);
      this.balls = program(gl, BALL_VERTEX, BALL_FRAGMENT);
      this.pathLines = new Lines(gl); this.keyframeLines = new Lines(gl); this.cameraLines = new Lines(gl); this.gridLines = new Lines(gl);
      this.makeBall(); this.makeScales();
      for (const c of this.clusters.values()) this.upload(c);
      this.linesDirty = true; this.touch();
    }
    makeScales() {
      const gl = this.gl, texels = new Uint8Array(256 * 2 * 4);
      for (let i = 0; i < 256; i++) [RAINBOW, HEAT].forEach((stops, row) => {
        texels.set([...colourOf(stops, i / 255).map(Math.round), 255], (row * 256 + i) * 4);
      });
      const texture = gl.createTexture();
      gl.bindTexture(gl.TEXTURE_2D, texture);
      gl.texImage2D(gl.TEXTURE_2D, 0, gl.RGBA, 256, 2, 0, gl.RGBA, gl.UNSIGNED_BYTE, texels);
      for (const [k, v] of [[gl.TEXTURE_MIN_FILTER, gl.LINEAR], [gl.TEXTURE_MAG_FILTER, gl.LINEAR],
        [gl.TEXTURE_WRAP_S, gl.CLAMP_TO_EDGE], [gl.TEXTURE_WRAP_T, gl.CLAMP_TO_EDGE]]) gl.texParameteri(gl.TEXTURE_2D, k, v);
    }
    makeBall() {
      const gl = this.gl, rings = 16, sectors = 24, v = [];
      const at = (i, j) => { const a = Math.PI * i / rings, b = 2 * Math.PI * j / sectors;
        return [Math.sin(a) * Math.cos(b), Math.cos(a), Math.sin(a) * Math.sin(b)]; };
      for (let i = 0; i < rings; i++) for (let j = 0; j < sectors; j++) {
        v.push(...at(i, j), ...at(i + 1, j), ...at(i, j + 1), ...at(i, j + 1), ...at(i + 1, j), ...at(i + 1, j + 1));
      }
      this.ball = { buffer: gl.createBuffer(), count: v.length / 3 };
      gl.bindBuffer(gl.ARRAY_BUFFER, this.ball.buffer);
      gl.bufferData(gl.ARRAY_BUFFER, new Float32Array(v), gl.STATIC_DRAW);
    }

    // ---- what is shown --------------------------------------------------------------------------------------------
    /** Something changed: the next frame is drawn. */
    touch() { this.dirty = true; this.lastChange = performance.now(); this.isStill = false; }
    set(options) { Object.assign(this.options, options); this.linesDirty = true; this.touch(); }

    /** Adds or replaces the points of a keyframe: { id, epoch, t, count, data, k, size, place, depthStep | box }. */
    setCluster(c) {
      const before = this.clusters.get(c.id);
      if (before && this.gl) this.gl.deleteBuffer(before.buffer);
      c.bounds = measure(c);
      if (c.place) this.places.set(c.id, c.place);
      c.matrix = matrixOf(this.places.get(c.id) || c.place);
      this.clusters.set(c.id, c);
      if (this.gl) this.upload(c);
      this.linesDirty = true; this.touch();
    }
    upload(c) {
      const gl = this.gl;
      c.buffer = gl.createBuffer();
      gl.bindBuffer(gl.ARRAY_BUFFER, c.buffer);
      gl.bufferData(gl.ARRAY_BUFFER, c.data, gl.STATIC_DRAW);
    }
    /** Moves keyframes: [[id, place]…]. Only matrices change. */
    setPlaces(list, epoch) {
      for (const [id, place] of list) {
        this.places.set(id, place);
        const c = this.clusters.get(id);
        if (c) { c.matrix = matrixOf(place); if (epoch !== undefined) c.epoch = epoch; }
      }
      this.placePath(); this.linesDirty = true; this.touch();
    }
    removeCluster(id) {
      const c = this.clusters.get(id);
      if (!c) return;
      if (this.gl) this.gl.deleteBuffer(c.buffer);
      this.clusters.delete(id); this.places.delete(id); this.linesDirty = true; this.touch();
    }
    clear() {
      for (const id of [...this.clusters.keys()]) this.removeCluster(id);
      this.places.clear(); this.path = []; this.camera = null; this.active = null; this.isFitted = false; this.upIsGiven = false;
      this.linesDirty = true; this.touch();
    }
    /** A pose of the path: { t, state, id, local } relative to keyframe `id`, or { t, state, at } in the map; no line leads to one that `begins`. */
    addPose(pose) {
      this.path.push(pose);
      this.placePose(pose); this.pathDirty = true;
    }
    setPath(poses) { this.path = poses; this.placePath(); this.pathDirty = true; this.touch(); }
    placePose(pose) {
      if (!pose.local) return;
      const place = this.places.get(pose.id);
      if (place) pose.at = apply(matrixOf(place), pose.local);
    }
    placePath() { for (const pose of this.path) this.placePose(pose); this.pathDirty = true; }
    /** The camera: { place, state, covariance (of its position, xx xy xz yy yz zz) }. */
    setCamera(camera) { this.camera = camera; this.cameraDirty = true; this.touch(); }
    setActive(id) { if (id !== this.active) { this.active = id; this.linesDirty = true; this.touch(); } }
    setEpoch(epoch) { if (epoch !== this.epoch) { this.epoch = epoch; this.linesDirty = true; this.pathDirty = true; this.touch(); } }
    setUp(up) { this.up = unit(up); this.upIsGiven = true; this.linesDirty = true; this.touch(); }
    /** Shows the map as it was at `t`. */
    setTime(t) { this.time = t; this.linesDirty = true; this.pathDirty = true; this.touch(); }
    isShown(c) { return c.t <= this.time && (this.epoch === null || c.epoch === undefined || c.epoch === this.epoch); }
    get totalPoints() { let n = 0; for (const c of this.clusters.values()) if (this.isShown(c)) n += c.count; return n; }

    /** The mean of what cameras had above them; a fit of the view to the points. */
    estimateUp() {
      if (this.upIsGiven) return;
      let sum = [0, 0, 0];
      for (const c of this.clusters.values()) if (this.isShown(c)) { const m = c.matrix; sum = add(sum, unit([-m[4], -m[5], -m[6]])); }
      if (norm(sum) > 0.1) this.up = unit(sum);
    }
    fit() {
      this.estimateUp();
      const list = [];
      for (const c of this.clusters.values()) {
        if (!this.isShown(c)) continue;
        const m = c.box ? c.bounds.centre : apply(c.matrix, c.bounds.centre);
        const r = c.bounds.radius * (c.box ? 1 : norm([c.matrix[0], c.matrix[1], c.matrix[2]]));
        for (const axis of [[1, 0, 0], [0, 1, 0], [0, 0, 1]]) list.push(add(m, axis, 0.75 * r), add(m, axis, -0.75 * r));
        const place = this.places.get(c.id);
        if (place) list.push([place[0], place[1], place[2]]);
      }
      if (!list.length) return false;
      // Most of it: what lies far out does not make the rest small.
      const span = (k) => { const x = list.map((p) => p[k]).sort((p, q) => p - q), n = x.length - 1; return [x[Math.floor(0.06 * n)], x[Math.ceil(0.94 * n)]]; };
      const spans = [0, 1, 2].map(span), target = spans.map(([p, q]) => (p + q) / 2);
      const reach = norm(spans.map(([p, q]) => (q - p) / 2)), narrow = Math.min(1, this.canvas.clientWidth / Math.max(this.canvas.clientHeight, 1));
      this.eye.target = target;
      this.eye.distance = Math.max(1.12 * reach / Math.sin(this.fovy / 2) * 0.8 / Math.sqrt(narrow), 1e-3);
      if (!this.isFitted) this.eye.yaw = this.yawBehind();
      this.isFitted = true; this.keyframeSize = 0; this.linesDirty = true; this.touch();
      return true;
    }
    /** A direction from which the first cameras look away. */
    yawBehind() {
      const first = this.clusters.values().next().value;
      if (!first) return 0.6;
      const [e1, e2] = this.level(), m = first.matrix, z = unit([m[8], m[9], m[10]]);
      return Math.atan2(-dot(z, e2), -dot(z, e1)) + 0.5;
    }
    /** Two axes of the level plane. */
    level() {
      const any = Math.abs(this.up[0]) < 0.8 ? [1, 0, 0] : [0, 0, 1];
      const e1 = unit(cross(any, this.up));
      return [e1, cross(this.up, e1)];
    }
    setView(view) {
      this.options.view = view;
      if (view === "top") this.eye.pitch = 1.5;
      if (view === "orbit" && this.eye.pitch > 1.3) this.eye.pitch = 0.55;
      if (view !== "follow") this.fit();
      this.touch();
    }

    // ---- hands ----------------------------------------------------------------------------------------------------
    listen() {
      const canvas = this.canvas, held = new Map();
      canvas.style.touchAction = "none";
      canvas.addEventListener("contextmenu", (e) => e.preventDefault());
      canvas.addEventListener("pointerdown", (e) => { canvas.setPointerCapture(e.pointerId); held.set(e.pointerId, [e.clientX, e.clientY]); });
      for (const end of ["pointerup", "pointercancel"]) canvas.addEventListener(end, (e) => held.delete(e.pointerId));
      canvas.addEventListener("pointermove", (e) => {
        const before = held.get(e.pointerId);
        if (!before) return;
        const now = [e.clientX, e.clientY], dx = now[0] - before[0], dy = now[1] - before[1];
        if (held.size === 2) {
          const other = [...held].find(([id]) => id !== e.pointerId)[1];
          const apart = (p) => Math.hypot(p[0] - other[0], p[1] - other[1]);
          this.zoom(apart(before) / Math.max(apart(now), 1)); this.pan(dx / 2, dy / 2);
        } else if (e.shiftKey || e.buttons & 6) this.pan(dx, dy);
        else this.orbit(dx, dy);
        held.set(e.pointerId, now);
      });
      canvas.addEventListener("wheel", (e) => { e.preventDefault(); this.zoom(Math.exp(Math.max(-60, Math.min(60, e.deltaY)) * 0.003)); }, { passive: false });
      canvas.addEventListener("dblclick", () => { this.fit(); });
      canvas.tabIndex = 0;
      canvas.addEventListener("keydown", (e) => {
        const moves = { ArrowLeft: [-20, 0], ArrowRight: [20, 0], ArrowUp: [0, -20], ArrowDown: [0, 20] };
        if (moves[e.key]) { this.orbit(...moves[e.key]); e.preventDefault(); }
        if (e.key === "+" || e.key === "-") this.zoom(e.key === "+" ? 0.9 : 1.1);
      });
    }
    orbit(dx, dy) {
      this.isTouched = true;
      this.eye.yaw -= dx * 0.006;
      this.eye.pitch = Math.max(-1.5, Math.min(1.5, this.eye.pitch + dy * 0.006));
      this.touch();
    }
    pan(dx, dy) {
      this.isTouched = true;
      const { x, y } = this.axes(), k = this.eye.distance / this.canvas.clientHeight * 0.95;
      this.eye.target = add(add(this.eye.target, x, -dx * k), y, dy * k);
      if (this.options.view === "follow") this.options.view = "orbit";
      this.touch();
    }
    zoom(factor) {
      this.isTouched = true;
      this.eye.distance = Math.min(Math.max(this.eye.distance * factor, 1e-3), 1e5);
      this.touch();
    }
    /** Where the eye is, and its axes. */
    axes() {
      const [e1, e2] = this.level(), { yaw, pitch, distance } = this.eye;
      const around = add(e1.map((v) => v * Math.cos(yaw)), e2, Math.sin(yaw));
      const back = add(around.map((v) => v * Math.cos(pitch)), this.up, Math.sin(pitch));
      const x = unit(cross(this.up, back)), y = cross(back, x);
      return { x, y, back, at: add(this.eye.target, back, distance) };
    }

    // ---- a frame --------------------------------------------------------------------------------------------------
    tick(now) {
      // Nobody sees it.
      if (!this.gl || !this.canvas.clientWidth) return;
      if (!this.dirty) {
        if (this.isStill || now - this.lastChange < STILL_AFTER_MS) return;
        this.isStill = true;
        this.draw(this.budget * Math.max(1, Math.min(STILL_BUDGETS, STILL_MS / (this.slowness || STILL_MS))));
        return;
      }
      this.dirty = false; this.hasDrawn = true;
      this.draw(this.budget);
      this.frames++;
    }
    adapt(ms) {
      // A hidden page is no slow one.
      if (ms > 5000) return;
      this.fps = this.fps ? 0.9 * this.fps + 0.1 * 1000 / ms : 1000 / ms;
      this.slowness = 0.7 * (this.slowness || 16) + 0.3 * ms;
      const budget = this.budget;
      if (ms > 4 * SLOW_MS) this.budget *= Math.max(0.4, SLOW_MS / ms);
      else if (this.slowness > SLOW_MS) this.budget *= 0.9;
      else if (this.slowness < FAST_MS && this.drawn > 0.9 * budget) this.budget *= 1.06;
      this.budget = Math.max(SMALLEST_BUDGET, Math.min(LARGEST_BUDGET, this.budget));
    }
    draw(budget) {
      const gl = this.gl, canvas = this.canvas, ratio = Math.min(window.devicePixelRatio || 1, 2);
      const width = Math.max(1, Math.round(canvas.clientWidth * ratio)), height = Math.max(1, Math.round(canvas.clientHeight * ratio));
      if (canvas.width !== width || canvas.height !== height) { canvas.width = width; canvas.height = height; }
      if (!this.isFitted || (!this.isTouched && this.options.view !== "follow" && this.clusters.size !== this.fittedClusters)) {
        this.fit(); this.fittedClusters = this.clusters.size;
      }
      if (this.options.view === "follow" && this.camera) this.follow();
      if (this.linesDirty) this.buildKeyframes();
      if (this.pathDirty) this.buildPath();
      this.prepareMatrices(width, height);
      const [r, g, b] = this.options.dark ? [0.043, 0.055, 0.075] : [0.965, 0.97, 0.98];
      gl.viewport(0, 0, width, height);
      gl.clearColor(r, g, b, 1); gl.clear(gl.COLOR_BUFFER_BIT | gl.DEPTH_BUFFER_BIT);
      gl.enable(gl.DEPTH_TEST); gl.disable(gl.BLEND);
      this.drawPoints(budget, height, ratio);
      this.drawLines(width, height, ratio);
      this.drawBall();
      if (this.onFrame) this.onFrame(this);
    }
    follow() {
      const m = matrixOf(this.camera.place), ahead = unit([m[8], m[9], m[10]]), [e1, e2] = this.level();
      const yaw = Math.atan2(-dot(ahead, e2), -dot(ahead, e1));
      const turn = Math.atan2(Math.sin(yaw - this.eye.yaw), Math.cos(yaw - this.eye.yaw));
      this.eye.yaw += 0.08 * turn;
      this.eye.target = mix(this.eye.target, add(this.camera.place, ahead, 0.25 * this.eye.distance), 0.15);
    }
    prepareMatrices(width, height) {
      const { at, y } = this.axes(), d = this.eye.distance;
      const near = Math.max(d * 0.01, 1e-4), far = d * 60;
      const view = lookAt(at, this.eye.target, y);
      this.matrices = { eye: at, transform: multiply(perspective(this.fovy, width / height, near, far), view), near, focal: height / 2 / Math.tan(this.fovy / 2) };
    }
    /** How many points of each cluster are drawn: by its size on the screen, within the budget. */
    share(budget, height) {
      const { transform, focal } = this.matrices, wanted = [];
      let sum = 0;
      for (const c of this.clusters.values()) {
        if (!this.isShown(c) || !c.count) continue;
        const s = c.box ? 1 : norm([c.matrix[0], c.matrix[1], c.matrix[2]]);
        const m = c.box ? c.bounds.centre : apply(c.matrix, c.bounds.centre), r = 1.6 * s * c.bounds.radius;
        const w = transform[3] * m[0] + transform[7] * m[1] + transform[11] * m[2] + transform[15];
        const x = transform[0] * m[0] + transform[4] * m[1] + transform[8] * m[2] + transform[12];
        const y = transform[1] * m[0] + transform[5] * m[1] + transform[9] * m[2] + transform[13];
        const k = focal * 2 / height;
        if (w < -r || Math.abs(x) > Math.abs(w) * this.aspect() + 2 * r * k || Math.abs(y) > Math.abs(w) + 2 * r * k) continue;
        const pixels = Math.PI * (focal * r / Math.max(w, 0.3 * r)) ** 2;
        const n = Math.min(c.count, Math.max(64, 0.6 * pixels));
        wanted.push([c, n]); sum += n;
      }
      const part = Math.min(1, budget / Math.max(sum, 1));
      return wanted.map(([c, n]) => [c, Math.max(1, Math.floor(n * part))]);
    }
    aspect() { return Math.max(1, this.canvas.width / this.canvas.height); }
    drawPoints(budget, height, ratio) {
      const gl = this.gl, { p, u } = this.points, { transform, focal } = this.matrices;
      const mode = ["brightness", "depth", "sigma", "height"].indexOf(this.options.colour);
      gl.useProgram(p);
      gl.enableVertexAttribArray(0); gl.enableVertexAttribArray(1);
      gl.uniform1f(u.sigma, this.options.maxSigma);
      gl.uniform2f(u.tone, ...(this.options.dark ? [0.1, 1] : [0.02, 0.8]));
      const [low, high] = this.heights();
      this.drawn = 0;
      for (const [c, n] of this.share(budget, height)) {
        const m = c.matrix, s = norm([m[0], m[1], m[2]]);
        const sparse = Math.min(Math.sqrt(c.count / n), 2.2);
        gl.uniformMatrix4fv(u.transform, false, c.box ? transform : multiply(transform, m));
        gl.uniform4f(u.camera, 1 / c.k[0], 1 / c.k[1], c.k[2], c.k[3]);
        const near = c.near || c.bounds.near || 1;
        if (c.box) {
          gl.uniform4f(u.origin, ...c.box.min, 1); gl.uniform4f(u.step_, ...c.box.step, 1 / near);
          gl.uniform4f(u.zrow, m[8] / s / s, m[9] / s / s, m[10] / s / s, -(m[8] * m[12] + m[9] * m[13] + m[10] * m[14]) / s / s);
        } else {
          gl.uniform4f(u.origin, 0, 0, 0, 0); gl.uniform4f(u.step_, 1, 1, c.depthStep, 1 / near);
          gl.uniform4f(u.zrow, 0, 0, 1, 0);
        }
        const a = this.up.map((v) => v / Math.max(high - low, 1e-9)), base = -low / Math.max(high - low, 1e-9);
        if (c.box) gl.uniform4f(u.upward, ...a, base);
        else gl.uniform4f(u.upward, dot(a, [m[0], m[1], m[2]]), dot(a, [m[4], m[5], m[6]]), dot(a, [m[8], m[9], m[10]]), dot(a, [m[12], m[13], m[14]]) + base);
        // A point is as large as its pixel was, seen from there.
        gl.uniform4f(u.look, 1.25 * sparse * focal * s / c.k[0], 1.1 * ratio, 7 * ratio, mode);
        gl.bindBuffer(gl.ARRAY_BUFFER, c.buffer);
        gl.vertexAttribPointer(0, 3, gl.UNSIGNED_SHORT, false, POINT_BYTES, 0);
        gl.vertexAttribPointer(1, 2, gl.UNSIGNED_BYTE, true, POINT_BYTES, 6);
        gl.drawArrays(gl.POINTS, 0, n);
        this.drawn += n;
      }
    }
    /** Lowest and highest of the clusters' middles along up, for colours by height and the grid. */
    heights() {
      const list = [];
      for (const c of this.clusters.values()) if (this.isShown(c)) {
        const m = c.box ? c.bounds.centre : apply(c.matrix, c.bounds.centre);
        const r = c.bounds.radius * (c.box ? 1 : norm([c.matrix[0], c.matrix[1], c.matrix[2]]));
        list.push(dot(this.up, m) - 0.6 * r, dot(this.up, m) + 0.6 * r);
      }
      list.sort((a, b) => a - b);
      return list.length ? [list[Math.floor(0.1 * list.length)], list[Math.floor(0.9 * list.length)]] : [-1, 1];
    }
    drawLines(width, height, ratio) {
      const gl = this.gl, { p, u } = this.lines;
      gl.useProgram(p);
      gl.enable(gl.BLEND); gl.blendFunc(gl.SRC_ALPHA, gl.ONE_MINUS_SRC_ALPHA);
      gl.uniformMatrix4fv(u.transform, false, this.matrices.transform);
      gl.uniform2f(u.pixels, width / ratio, height / ratio);
      gl.uniform1f(u.near, this.matrices.near);
      gl.depthMask(false);
      if (this.options.grid) { this.buildGrid(); this.gridLines.draw(); }
      if (this.options.keyframes) this.keyframeLines.draw();
      this.pathLines.draw(this.visiblePath);
      gl.depthMask(true);
      this.buildCamera(); this.cameraLines.draw();
      gl.disable(gl.BLEND);
    }
    drawBall() {
      const camera = this.camera;
      if (!camera || !camera.covariance) return;
      const l = cholesky(camera.covariance), largest = Math.max(l[0], Math.hypot(l[1], l[3]), Math.hypot(l[2], l[4], l[5]));
      if (!(largest > 0) || !Number.isFinite(largest)) return;
      // At least a 200th of the view: by a power of ten, which the legend says.
      this.exaggeration = Math.max(1, 10 ** Math.ceil(Math.log10(this.eye.distance / 200 / largest)));
      const k = this.exaggeration, e = 1e-4 * largest * k;
      const gl = this.gl, { p, u } = this.balls;
      gl.useProgram(p);
      gl.enable(gl.BLEND); gl.blendFunc(gl.SRC_ALPHA, gl.ONE_MINUS_SRC_ALPHA); gl.depthMask(false);
      gl.uniformMatrix4fv(u.transform, false, this.matrices.transform);
      gl.uniformMatrix3fv(u.shape, false, [k * l[0] + e, k * l[1], k * l[2], 0, k * l[3] + e, k * l[4], 0, 0, k * l[5] + e]);
      gl.uniform3f(u.centre, camera.place[0], camera.place[1], camera.place[2]);
      gl.uniform3f(u.eye, ...this.matrices.eye);
      gl.uniform3f(u.tint, 1.0, 0.42, 0.75);
      gl.bindBuffer(gl.ARRAY_BUFFER, this.ball.buffer);
      gl.enableVertexAttribArray(0); gl.disableVertexAttribArray(1);
      gl.vertexAttribPointer(0, 3, gl.FLOAT, false, 12, 0);
      gl.drawArrays(gl.TRIANGLES, 0, this.ball.count);
      gl.depthMask(true); gl.disable(gl.BLEND);
    }
    /** Edges of a camera at a place, `depth` long in map units. */
    frustum(out, place, k, size, depth, colour, alpha, width) {
      const m = matrixOf([...place.slice(0, 7), 1]), at = [place[0], place[1], place[2]];
      const corner = (u, v) => apply(m, [(u - k[2]) / k[0] * depth, (v - k[3]) / k[1] * depth, depth]);
      const c = [corner(0, 0), corner(size[0], 0), corner(size[0], size[1]), corner(0, size[1])];
      for (let i = 0; i < 4; i++) { out.add(at, c[i], colour, alpha, width); out.add(c[i], c[(i + 1) % 4], colour, alpha, width); }
      out.add(mix(c[0], c[1], 0.4), add(mix(c[0], c[1], 0.5), sub(c[0], c[3]), 0.18), colour, alpha, width);
      out.add(mix(c[0], c[1], 0.6), add(mix(c[0], c[1], 0.5), sub(c[0], c[3]), 0.18), colour, alpha, width);
    }
    markSize() { return 0.03 * this.eye.distance; }
    buildKeyframes() {
      this.linesDirty = false;
      const out = new Segments(this.clusters.size * 10 + 1), tone = this.options.dark ? [130, 190, 170] : [40, 110, 90];
      const depth = this.keyframeSize || (this.keyframeSize = this.markSize());
      for (const c of this.clusters.values()) {
        const place = this.places.get(c.id);
        if (!place || !c.size || !this.isShown(c)) continue;
        const isActive = c.id === this.active;
        this.frustum(out, place, c.k, c.size, isActive ? 1.3 * depth : 0.7 * depth, isActive ? [80, 220, 120] : tone, isActive ? 1 : 0.38, isActive ? 2.2 : 1.1);
      }
      this.keyframeLines.fill(out);
    }
    buildPath() {
      this.pathDirty = false;
      const out = new Segments(this.path.length + 1);
      this.visiblePath = 0;
      let before = null;
      for (const pose of this.path) {
        if (pose.t > this.time) break;
        const isHere = pose.at && (this.epoch === null || pose.epoch === undefined || pose.epoch === this.epoch);
        if (isHere && before && !pose.begins && pose.state !== 3 && pose.state !== 0) {
          out.add(before.at, pose.at, STATE_COLOURS[pose.state] || STATE_COLOURS[1], 0.95, 2.4);
        }
        before = isHere && pose.state !== 3 ? pose : null;
      }
      this.visiblePath = out.count;
      this.pathLines.fill(out);
    }
    buildCamera() {
      const out = new Segments(16), camera = this.camera;
      if (camera) this.frustum(out, camera.place, camera.k || [1, 1, 0.5, 0.4], camera.size || [1, 0.8], 1.6 * this.markSize(), STATE_COLOURS[camera.state] || STATE_COLOURS[1], 1, 2.6);
      this.cameraLines.fill(out);
    }
    /** A level grid at the lowest points, squares of 1, 2 or 5 times a power of ten. */
    buildGrid() {
      const [low] = this.heights(), [e1, e2] = this.level(), d = this.eye.distance;
      const raw = d / 7, power = 10 ** Math.floor(Math.log10(raw)), step = [1, 2, 5, 10].find((n) => n * power >= raw) * power;
      this.gridStep = step;
      const out = new Segments(128), tone = this.options.dark ? [120, 140, 170] : [90, 105, 130];
      const at = (i, j) => add(add(this.up.map((v) => v * low), e1, i), e2, j);
      const ci = Math.round(dot(this.eye.target, e1) / step), cj = Math.round(dot(this.eye.target, e2) / step), reach = 12;
      for (let i = -reach; i <= reach; i++) {
        const alpha = 0.17 * (1 - Math.abs(i) / (reach + 1));
        for (let j = -reach; j < reach; j++) {
          const fade = alpha * (1 - Math.abs(j + 0.5) / (reach + 0.5));
          if (fade < 0.01) continue;
          out.add(at((ci + i) * step, (cj + j) * step), at((ci + i) * step, (cj + j + 1) * step), tone, fade, 1);
          out.add(at((ci + j) * step, (cj + i) * step), at((ci + j + 1) * step, (cj + i) * step), tone, fade, 1);
        }
      }
      this.gridLines.fill(out);
    }
    /** Pixels that are not background, of a frame drawn now: for tests and pictures. */
    litPixels() {
      const gl = this.gl;
      if (!gl) return 0;
      const { grid, keyframes } = this.options;
      Object.assign(this.options, { grid: false, keyframes: false });
      this.draw(this.budget);
      const { width, height } = this.canvas, pixels = new Uint8Array(width * height * 4);
      gl.readPixels(0, 0, width, height, gl.RGBA, gl.UNSIGNED_BYTE, pixels);
      Object.assign(this.options, { grid, keyframes });
      let lit = 0;
      const b = [pixels[0], pixels[1], pixels[2]];
      for (let i = 0; i < pixels.length; i += 4) if (Math.abs(pixels[i] - b[0]) + Math.abs(pixels[i + 1] - b[1]) + Math.abs(pixels[i + 2] - b[2]) > 24) lit++;
      this.touch();
      return lit;
    }

    // ---- a finished run -------------------------------------------------------------------------------------------
    /** Loads a run as the program packs it: { header, bytes }; see scene.rs. */
    load(header, bytes) {
      this.clear();
      for (const c of header.clusters) {
        this.setCluster({ id: c.id, t: c.t, count: c.count, place: c.place, k: header.k, size: header.size, near: c.near,
          box: { min: c.min, step: c.step }, data: bytes.subarray(c.offset, c.offset + c.count * POINT_BYTES) });
      }
      if (header.up) this.setUp(header.up);
      this.setPath(header.path.map((p) => ({ t: p[0], place: p.slice(1, 8), at: p.slice(1, 4), state: 1 })));
      // A gap in time is a gap of the line, and so is another epoch.
      const gaps = new Set(header.gaps);
      this.path.forEach((p, i) => { p.begins = i > 0 && (gaps.has(i) || p.t - this.path[i - 1].t > header.gap); });
      this.run = header;
    }
    /** Puts time and camera at `t`, seconds of the recording. */
    seek(t) {
      const path = this.path;
      let low = 0, high = path.length - 1;
      while (low < high) { const mid = (low + high + 1) >> 1; if (path[mid].t <= t) low = mid; else high = mid - 1; }
      if (path.length) this.setCamera({ place: path[low].place, state: 1, k: this.run.k, size: this.run.size });
      let active = null;
      for (const c of this.clusters.values()) if (c.t <= t) active = c.id;
      this.setActive(active);
      this.setTime(t);
    }
  };
})();
if (typeof module !== "undefined") module.exports = { Viewer };
