// The viewer: what it shows is its state, and `update` is the one way to change it.

class Viewer {
  constructor(info) {
    this.pictures = new Pictures(info);
    this.sources = this.pictures.sources;
    this.indices = new Map(this.sources.map((source, i) => [source.name, i]));
    this.state = this.firstState();
    this.painter = new Painter(this.pictures, this.state.ev);
    this.stage = new Stage(this.pictures, this.painter, this.state);
    this.slices = new Slices(this.pictures, this.painter, this.state);
    this.tick = 0; // the next frame of the animation, while it plays
    this.flips = 0; // the timer of the arrangement that flickers
  }

  // The noisy frames on the left, the last of the front on the right.
  firstState() {
    const { width, height, frames, black, row } = this.pictures;
    const front = report.fronts[`${report.chart[0]} ${report.cost}`] ?? [];
    const best = this.indices.get(front.findLast((name) => this.indices.has(name))) ?? this.sources.length - 1;
    const left = this.indices.get("noisy") ?? Math.min(1, this.sources.length - 1);
    // 0 EV is the exposure of the metrics; start where the shot's mean level is a comfortable middle grey.
    const ev = Math.round(2 * Math.log2(0.35 / (report.exposure * black * 64))) / 2;
    return {
      left, right: best === left ? 0 : best, view: "picture", layout: "slider",
      frame: Math.floor(frames.length / 2), ev, split: 0.5, zoom: 1, x: width / 2, y: height / 2, row, playing: false,
      flipped: false, magnify: false, at: null,
    };
  }

  // Two pictures in one place change twice a second: slow enough to look at each, and to be safe for anybody.
  arrange(layout) {
    clearInterval(this.flips);
    if (layout === "flicker") this.flips = setInterval(() => this.update({ flipped: !this.state.flipped }), 500);
    return this.update({ layout, flipped: false });
  }

  // Change the state, and draw again what shows it.
  update(change) {
    const { state, pictures } = this;
    Object.assign(state, change);
    const half = { x: pictures.width / 2 / state.zoom, y: pictures.height / 2 / state.zoom };
    state.x = clamp(state.x, half.x, pictures.width - half.x);
    state.y = clamp(state.y, half.y, pictures.height - half.y);
    if ("ev" in change) this.painter.expose(state.ev);
    if ("ev" in change || "row" in change) this.slices.draw();
    return this.draw();
  }

  async draw() {
    const panes = await this.stage.draw();
    if (panes) showState(this, this.stage.scaleOf(panes[0]));
  }

  // The point under the pointer stays where it is.
  zoom(factor, at = this.state) {
    const { state } = this, next = clamp(state.zoom * factor, 1, 64), keep = 1 - state.zoom / next;
    this.update({ zoom: next, x: state.x + (at.x - state.x) * keep, y: state.y + (at.y - state.y) * keep });
  }

  expose(ev) {
    const { min, max } = find("ev");
    this.update({ ev: clamp(ev, Number(min), Number(max)) });
  }

  setRow(row) {
    this.update({ row: clamp(row, 0, this.pictures.height - 1) });
  }

  swap() {
    this.update({ left: this.state.right, right: this.state.left });
  }

  step(by) {
    const { length } = this.pictures.frames;
    return this.update({ frame: (this.state.frame + by + length) % length });
  }

  play(on) {
    this.state.playing = on;
    showPlaying(on);
    cancelAnimationFrame(this.tick);
    let last = performance.now();
    const next = async (now) => {
      if (now - last >= 1000 / find("rate").value - 4) { // half a refresh early is nearer than a whole one late
        last = now;
        await this.step(1);
      }
      if (this.state.playing) this.tick = requestAnimationFrame(next);
    };
    if (on) this.tick = requestAnimationFrame(next);
  }

  // The radiance at a pixel, of both pictures and of the reference.
  async readOut(x, y) {
    const { width, height, count, origin, radiance } = this.pictures, px = Math.floor(x), py = Math.floor(y);
    if (px < 0 || py < 0 || px >= width || py >= height) return;
    const chosen = [...new Set([this.state.left, this.state.right, 0])];
    const all = await Promise.all(chosen.map((source) => this.pictures.colors(source, this.state.frame)));
    const texts = all.map((codes, k) => {
      const rgb = [0, 1, 2].map((c) => radiance[codes[c * count + py * width + px]]);
      const values = rgb.map((value) => Number.isNaN(value) ? "not finite" : rounded(value, 3));
      return `${this.sources[chosen[k]].label} ${values.join(" ")}`;
    });
    find("readout").textContent = `(${origin[0] + px}, ${origin[1] + py})   ${texts.join("   ·   ")}`;
  }

  // What the chart asks for

  has(name) {
    return this.indices.has(name);
  }

  choose(name) {
    if (this.has(name)) this.update({ right: this.indices.get(name) });
  }

  async thumbnail(name) {
    const { width, height } = this.pictures;
    const image = await this.painter.tile(this.indices.get(name), "picture", this.state.frame);
    const copy = makeCanvas(width, Math.round(height * 0.62));
    copy.getContext("2d").drawImage(image, 0, -height * 0.19);
    return copy;
  }
}
