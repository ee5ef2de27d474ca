// The time slider of a finished run: plays the trajectory and the map as it grew.
"use strict";

/** The time slider. */
class Player {
  constructor(view, end, parts) {
    Object.assign(this, { view, end, parts, t: end, isPlaying: false, rate: 1, before: 0 });
    parts.bar.hidden = false; parts.time.max = end; parts.time.step = Math.max(end / 2000, 0.001);
    parts.time.oninput = () => { this.isPlaying = false; this.seek(+parts.time.value); };
    parts.play.onclick = () => { this.isPlaying = !this.isPlaying; if (this.isPlaying && this.t >= end) this.seek(0); this.show(); };
    parts.speed.onclick = () => { this.rate = { 1: 2, 2: 4, 4: 10, 10: 1 }[this.rate]; this.show(); };
    const loop = (now) => {
      if (this.isPlaying) this.seek(Math.min(this.t + this.rate * (now - this.before) / 1000, end));
      if (this.t >= end) this.isPlaying = false;
      this.before = now; this.show(); requestAnimationFrame(loop);
    };
    this.seek(end); requestAnimationFrame(loop);
  }
  seek(t) { this.t = t; this.view.seek(t); }
  show() {
    this.parts.time.value = this.t; this.parts.play.textContent = this.isPlaying ? "❚❚" : "▶"; this.parts.speed.textContent = `${this.rate}×`;
    this.parts.clock.textContent = `${this.t.toFixed(1)} of ${this.end.toFixed(1)} s`;
  }
}
