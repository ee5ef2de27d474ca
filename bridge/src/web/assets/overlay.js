// The camera's image with the depth of its keyframe over it: the points are brought into the image by the frame's own pose.
"use strict";

const Overlay = (() => {
  const IMAGE_VERTEX = `#version 300 es
    out vec2 at; void main() { at = vec2(gl_VertexID & 1, gl_VertexID >> 1); gl_Position = vec4(at.x * 2.0 - 1.0, 1.0 - at.y * 2.0, 0.0, 1.0); }`;
  const IMAGE_FRAGMENT = `#version 300 es
    precision mediump float; in vec2 at; uniform sampler2D image; uniform float dim; out vec4 o;
    void main() { o = vec4(texture(image, at).rgb * dim, 1.0); }`;
  const POINT_VERTEX = `#version 300 es
    precision highp float;
    layout(location=0) in vec3 q; layout(location=1) in vec2 g;
    uniform vec4 from, to; uniform vec2 size; uniform mat4 motion; uniform vec4 look;
    out vec3 colour;
    vec3 ramp(float x) {
      vec3 a = vec3(0.19, 0.24, 0.75), b = vec3(0.16, 0.74, 0.92), c = vec3(0.40, 0.95, 0.45), d = vec3(0.96, 0.78, 0.2), e = vec3(0.85, 0.18, 0.05);
      x = clamp(x, 0.0, 1.0) * 4.0;
      return x < 1.0 ? mix(a, b, x) : x < 2.0 ? mix(b, c, x - 1.0) : x < 3.0 ? mix(c, d, x - 2.0) : mix(d, e, x - 3.0);
    }
    void main() {
      float depth = 1.0 / max(q.z * look.x, 1e-6);
      vec4 p = motion * vec4((q.x - from.z) / from.x * depth, (q.y - from.w) / from.y * depth, depth, 1.0);
      vec2 at = vec2(to.x * p.x / p.z + to.z + 0.5, to.y * p.y / p.z + to.w + 0.5) / size;
      gl_Position = p.z > 1e-3 ? vec4(at.x * 2.0 - 1.0, 1.0 - at.y * 2.0, 0.0, 1.0) : vec4(2.0, 2.0, 2.0, 1.0);
      if (g.y > look.w) gl_Position = vec4(2.0, 2.0, 2.0, 1.0);
      gl_PointSize = look.y;
      colour = look.z < 0.0 ? ramp((g.y - 0.33) / 0.5) : ramp(look.z / p.z);
    }`;
  const POINT_FRAGMENT = `#version 300 es
    precision mediump float; in vec3 colour; out vec4 o; void main() { o = vec4(colour, 0.9); }`;

  function program(gl, vertex, fragment) {
    const p = gl.createProgram();
    for (const [kind, text] of [[gl.VERTEX_SHADER, vertex], [gl.FRAGMENT_SHADER, fragment]]) {
      const s = gl.createShader(kind);
      gl.shaderSource(s, text); gl.compileShader(s); gl.attachShader(p, s);
      if (!gl.getShaderParameter(s, gl.COMPILE_STATUS) && !gl.isContextLost()) throw new Error(gl.getShaderInfoLog(s));
    }
    gl.linkProgram(p);
    return p;
  }
  /** Column-major inverse of a rigid place [x y z qx qy qz qw]. */
  function inverse(p) {
    const [x, y, z, w] = p.slice(3, 7);
    const r = [1 - 2 * (y * y + z * z), 2 * (x * y - z * w), 2 * (x * z + y * w), 2 * (x * y + z * w), 1 - 2 * (x * x + z * z),
      2 * (y * z - x * w), 2 * (x * z - y * w), 2 * (y * z + x * w), 1 - 2 * (x * x + y * y)];
    const t = [0, 1, 2].map((i) => -(r[i] * p[0] + r[3 + i] * p[1] + r[6 + i] * p[2]));
    return [r[0], r[1], r[2], 0, r[3], r[4], r[5], 0, r[6], r[7], r[8], 0, t[0], t[1], t[2], 1];
  }

  return class Overlay {
    /** `clusterOf` gives the points of a keyframe by its id. */
    constructor(canvas, clusterOf) {
      this.canvas = canvas; this.clusterOf = clusterOf; this.mode = "depth"; this.frame = null; this.cluster = null; this.images = 0; this.maxSigma = 1;
      this.start();
      canvas.addEventListener("webglcontextlost", (e) => { e.preventDefault(); this.gl = null; });
      canvas.addEventListener("webglcontextrestored", () => { this.start(); this.draw(); });
    }
    start() {
      const gl = this.canvas.getContext("webgl2", { antialias: false, alpha: false });
      if (!gl) throw new Error("this browser has no WebGL 2");
      this.gl = gl;
      this.image = program(gl, IMAGE_VERTEX, IMAGE_FRAGMENT); this.points = program(gl, POINT_VERTEX, POINT_FRAGMENT);
      this.uniform = {};
      for (const name of ["from", "to", "size", "motion", "look"]) this.uniform[name] = gl.getUniformLocation(this.points, name);
      this.dim = gl.getUniformLocation(this.image, "dim");
      this.texture = gl.createTexture(); this.buffer = gl.createBuffer();
      gl.bindTexture(gl.TEXTURE_2D, this.texture);
      for (const [k, v] of [[gl.TEXTURE_MIN_FILTER, gl.LINEAR], [gl.TEXTURE_MAG_FILTER, gl.LINEAR], [gl.TEXTURE_WRAP_S, gl.CLAMP_TO_EDGE], [gl.TEXTURE_WRAP_T, gl.CLAMP_TO_EDGE]]) gl.texParameteri(gl.TEXTURE_2D, k, v);
      this.cluster = null;
    }
    /** Takes the points of a keyframe to the graphics card, unless they are there. */
    upload(cluster) {
      if (cluster === this.cluster) return;
      this.cluster = cluster;
      this.gl.bindBuffer(this.gl.ARRAY_BUFFER, this.buffer);
      this.gl.bufferData(this.gl.ARRAY_BUFFER, cluster.data, this.gl.STATIC_DRAW);
    }
    clear() { this.frame = null; this.cluster = null; }
    async setFrame(header, jpeg) {
      const bitmap = await createImageBitmap(new Blob([jpeg], { type: "image/jpeg" }));
      const gl = this.gl;
      if (!gl) return;
      if (this.canvas.width !== header.size[0] || this.canvas.height !== header.size[1]) {
        [this.canvas.width, this.canvas.height] = header.size;
        this.canvas.style.aspectRatio = `${header.size[0]} / ${header.size[1]}`;
      }
      gl.bindTexture(gl.TEXTURE_2D, this.texture);
      gl.texImage2D(gl.TEXTURE_2D, 0, gl.RGBA, gl.RGBA, gl.UNSIGNED_BYTE, bitmap);
      bitmap.close();
      this.frame = header; this.images++;
      this.draw();
    }
    /** The pose of the frame, and the points of the keyframe that it is relative to. */
    poseOfFrame() {
      const pose = this.frame.pose;
      if (!pose || pose.code === 0 || pose.code === 3) return null;
      const cluster = this.clusterOf(pose.keyframe);
      return cluster ? { pose, cluster } : null;
    }
    draw() {
      const gl = this.gl;
      if (!gl || !this.frame) return;
      const found = this.mode === "off" ? null : this.poseOfFrame();
      gl.viewport(0, 0, this.canvas.width, this.canvas.height);
      gl.disable(gl.BLEND); gl.useProgram(this.image); gl.uniform1f(this.dim, found ? 0.62 : 1);
      gl.disableVertexAttribArray(0); gl.disableVertexAttribArray(1);
      gl.drawArrays(gl.TRIANGLE_STRIP, 0, 4);
      this.shown = 0;
      this.shownKeyframe = found ? found.cluster.id : null;
      if (!found) return;
      const { pose, cluster: c } = found;
      this.upload(c);
      const u = this.uniform, scale = this.canvas.width / this.frame.size[0];
      gl.useProgram(this.points); gl.enable(gl.BLEND); gl.blendFunc(gl.SRC_ALPHA, gl.ONE_MINUS_SRC_ALPHA);
      gl.uniform4f(u.from, ...c.k); gl.uniform4f(u.to, ...this.frame.k); gl.uniform2f(u.size, ...this.frame.size);
      gl.uniformMatrix4fv(u.motion, false, inverse(pose.keyframe_from_camera));
      const near = c.bounds ? c.bounds.near : 1;
      gl.uniform4f(u.look, c.depthStep, Math.max(1.6 * scale, 1.5), this.mode === "sigma" ? -1 : 1 / Math.max(near, 1e-6), this.maxSigma);
      gl.bindBuffer(gl.ARRAY_BUFFER, this.buffer);
      gl.enableVertexAttribArray(0); gl.enableVertexAttribArray(1);
      gl.vertexAttribPointer(0, 3, gl.UNSIGNED_SHORT, false, 8, 0);
      gl.vertexAttribPointer(1, 2, gl.UNSIGNED_BYTE, true, 8, 6);
      gl.drawArrays(gl.POINTS, 0, c.count);
      this.shown = c.count;
    }
  };
})();
