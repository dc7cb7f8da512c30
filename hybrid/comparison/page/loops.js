// The shot as it plays: whole frames of two methods, small and with loss, frame by frame together.

class Loops {
  constructor(info) {
    Object.assign(this, info); // width, height, columns, frames, rate, sources, movies: see embed_loops
    this.canvas = find("loop-canvas");
    this.sheets = new Map();
    const index = (name) => this.sources.findIndex((source) => source.name === name);
    const left = Math.max(index("noisy"), 0), right = this.sources.length - 1;
    this.state = { left, right: right === left ? 0 : right, layout: "slider", split: 0.5, frame: 0, playing: false,
      flipped: false };
  }

  // The image with all frames of a source, decoded when it is first asked for.
  sheet(source) {
    if (!this.sheets.has(source)) {
      const image = new Image();
      image.src = "data:image/webp;base64," + find(`l${source}`).textContent;
      this.sheets.set(source, image.decode().then(() => image));
    }
    return this.sheets.get(source);
  }

  update(change) {
    Object.assign(this.state, change);
    return this.draw();
  }

  async draw() {
    const { canvas, width, height, state } = this, pair = state.layout === "pair";
    const [left, right] = await Promise.all([this.sheet(state.left), this.sheet(state.right)]);
    if (canvas.width !== (pair ? 2 : 1) * width) canvas.width = (pair ? 2 : 1) * width;
    canvas.height = height;
    const context = canvas.getContext("2d");
    const put = (image, from, to, at) => {
      const x = state.frame % this.columns * width, y = Math.floor(state.frame / this.columns) * height;
      if (to > from) context.drawImage(image, x + from, y, to - from, height, at + from, 0, to - from, height);
    };
    const column = Math.round(state.split * width);
    if (pair) {
      put(left, 0, width, 0);
      put(right, 0, width, width);
    } else if (state.layout === "flicker") {
      put(state.flipped ? right : left, 0, width, 0);
    } else {
      put(left, 0, column, 0);
      put(right, column, width, 0);
      context.fillStyle = "#fff";
      if (column > 0 && column < width) context.fillRect(column - 1, 0, 2, height);
    }
    this.show();
  }

  show() {
    const { state, sources, frames, canvas } = this, one = sources[state.flipped ? state.right : state.left].label;
    const [a, b] = [sources[state.left].label, sources[state.right].label];
    find("loop-names").textContent = state.layout === "flicker" ? one : `${a} | ${b}`;
    find("loop-frame").value = state.frame;
    find("loop-frame-text").textContent = `frame ${frames[state.frame]}`;
    find("loop-split").value = 100 * state.split;
    find("loop-split").parentElement.hidden = state.layout !== "slider";
    canvas.setAttribute("aria-label", `Frame ${frames[state.frame]}: ${find("loop-names").textContent}`);
  }

  // As on the stage above: twice a second, slow enough to look at each and safe for anybody.
  arrange(layout) {
    clearInterval(this.flips);
    if (layout === "flicker") this.flips = setInterval(() => this.update({ flipped: !this.state.flipped }), 500);
    return this.update({ layout, flipped: false });
  }

  play(on) {
    const { state, frames } = this, button = find("loop-play");
    state.playing = on;
    button.textContent = on ? "❚❚" : "▶";
    button.setAttribute("aria-label", on ? "Stop" : "Play");
    button.setAttribute("aria-pressed", on);
    cancelAnimationFrame(this.tick);
    const start = performance.now(), first = state.frame;
    const next = async (now) => {
      // By the clock: where the machine is too slow frames are left out, and the speed is right.
      const frame = (first + Math.floor(Math.max(0, now - start) * find("loop-rate").value / 1000)) % frames.length;
      if (frame !== state.frame) await this.update({ frame });
      if (state.playing) this.tick = requestAnimationFrame(next);
    };
    if (on) this.tick = requestAnimationFrame(next);
  }
}

function startLoops(info) {
  const loops = new Loops(info), { state } = loops;
  const listen = (id, kind, action) => find(id).addEventListener(kind, (event) => action(event.target.value));
  for (const id of ["left", "right"]) {
    find(`loop-${id}`).append(...loops.sources.map((source, i) => new Option(source.label, i)));
    find(`loop-${id}`).value = state[id];
    listen(`loop-${id}`, "change", (value) => loops.update({ [id]: Number(value) }));
  }
  find("loop-frame").max = loops.frames.length - 1;
  listen("loop-frame", "input", (value) => { loops.play(false); loops.update({ frame: Number(value) }); });
  listen("loop-split", "input", (value) => loops.update({ split: value / 100 }));
  listen("loop-play", "click", () => loops.play(!state.playing));
  for (const radio of document.querySelectorAll("[name=loop-layout]")) {
    radio.addEventListener("change", () => loops.arrange(radio.value));
  }
  find("loops").hidden = false;
  return loops.draw();
}
