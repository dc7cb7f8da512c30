// The viewer of the report: the player, with error maps, a magnifier, the radiance under the pointer and slices.

const LENS = 120, MAGNIFIED = 4; // the side of a lens in CSS pixels, and its magnification

// All methods in a grid, in the report only.
LAYOUTS.all = ({ pictures: { sources, width, height } }, wide) => {
  const columns = clamp(Math.min(Math.ceil(Math.sqrt(sources.length)), Math.floor(wide / 250)), 1, 4), w = wide / columns, h = w * height / width;
  return sources.map((_, i) => ({ source: i, ...cell((i % columns) * w, Math.floor(i / columns) * h, w, h) }));
};

class Viewer extends Player {
  constructor(info) {
    const pictures = new Pictures(info), painter = new Painter(pictures);
    super(painter, { state: firstState(pictures) });
    Object.assign(this, { pictures, painter });
    this.names = pictures.sources.map(({ name }) => name);
    this.slices = new Slices(pictures, painter, this.state);
    this.keys.m = () => this.update({ magnify: !this.state.magnify });
    this.names.slice(0, 9).forEach((_, i) => { this.keys[i + 1] = () => this.update({ right: i }); });
    this.painter.expose(this.state.ev);
  }

  update(change) {
    if ("ev" in change) this.painter.expose(change.ev);
    const drawn = super.update(change);
    if ("ev" in change || "row" in change) this.slices.draw();
    return drawn;
  }

  setRow(row) {
    return this.update({ row: clamp(row, 0, this.pictures.height - 1) });
  }

  async drawOver(context, panes) {
    const { height } = this.pictures, { row, layout, view, frame, y, magnify, at } = this.state;
    for (const pane of panes) {
      const top = pane.y + pane.h / 2 + (row + 0.5 - y * height) * this.scaleOf(pane);
      if (layout !== "all") drawTicks(context, pane, top);
      if (await this.painter.tile(pane.source, view, frame) === null) {
        writeAmid(context, "no such map of this frame", (pane.from + pane.to) / 2, pane.y + pane.h / 2);
      }
    }
    if (magnify && at) await this.drawLenses(context, panes[0], at);
  }

  // The left and the right picture at the pointer, enlarged, side by side above it.
  async drawLenses(context, pane, { x, y, px, py }) {
    const { left, right } = this.state, { width, height } = this.pictures, scale = this.scaleOf(pane) * MAGNIFIED;
    const tiles = await Promise.all([left, right].map((source) => this.painter.image(source, this.state)));
    const top = py > LENS + 20 ? py - LENS - 20 : py + 20;
    const start = clamp(px - LENS, 0, Math.max(0, this.stage.clientWidth - 2 * LENS));
    context.imageSmoothingEnabled = scale * devicePixelRatio < 2;
    tiles.forEach((tile, i) => {
      const from = start + i * LENS, w = width * scale, h = height * scale;
      context.save();
      context.beginPath();
      context.rect(from, top, LENS, LENS);
      context.fillStyle = BACKGROUND;
      context.fill();
      context.clip();
      if (tile) context.drawImage(tile, from + LENS / 2 - x * w, top + LENS / 2 - y * h, w, h);
      context.restore();
      context.strokeStyle = "#fff";
      context.strokeRect(from + 0.5, top + 0.5, LENS - 1, LENS - 1);
    });
  }

  showState(panes) {
    super.showState(panes);
    const { state, pictures } = this;
    for (const id of ["left", "right", "row"]) find(id).value = state[id];
    find("magnify").checked = state.magnify;
    find("row-text").textContent = pictures.origin[1] + state.row;
  }

  // The radiance at a place, of both pictures and of the reference.
  async readOut(x, y) {
    const { width, height, count, origin, radiance } = this.pictures, { left, right, frame } = this.state;
    const px = Math.floor(x * width), py = Math.floor(y * height);
    if (px < 0 || py < 0 || px >= width || py >= height) return;
    const chosen = [...new Set([left, right, 0])];
    const all = await Promise.all(chosen.map((source) => this.pictures.colors(source, frame)));
    const texts = all.map((codes, k) => {
      const rgb = [0, 1, 2].map((c) => radiance[codes[c * count + py * width + px]]);
      return `${this.names[chosen[k]]} ${rgb.map((value) => Number.isNaN(value) ? "not finite" : rounded(value, 3)).join(" ")}`;
    });
    find("readout").textContent = `(${origin[0] + px}, ${origin[1] + py})   ${texts.join("   ·   ")}`;
  }

  // For the chart

  has(name) {
    return this.names.includes(name);
  }

  choose(name) {
    if (this.has(name)) this.update({ right: this.names.indexOf(name) });
  }

  async thumbnail(name) {
    const { width, height } = this.pictures, copy = makeCanvas(width, Math.round(height * 0.62));
    const image = await this.painter.tile(this.names.indexOf(name), "picture", this.state.frame);
    copy.getContext("2d").drawImage(image, 0, -height * 0.19);
    return copy;
  }
}

// The noisy frames on the left, our best method on the right; without their pictures the first and the last.
function firstPair(names) {
  const [left, right] = (report.opens ?? []).map((name) => names.indexOf(name));
  return { left: Math.max(left ?? 0, 0), right: right >= 0 ? right : names.length - 1 };
}

function firstState({ sources, frames, black, row }) {
  // 0 EV is the exposure of the metrics; start where the shot's mean level is a comfortable middle gray.
  const ev = Math.round(2 * Math.log2(0.35 / (report.exposure * black * 64))) / 2;
  return { ...firstPair(sources.map(({ name }) => name)), view: "picture", frame: Math.floor(frames.length / 2), ev, row,
    magnify: false, at: null };
}

function writeAmid(context, text, x, y) {
  context.fillStyle = "#a3a3ad";
  context.font = "14px system-ui, sans-serif";
  context.textAlign = "center";
  context.fillText(text, x, y);
}

// Ticks at both edges, at the row of the slices.
function drawTicks(context, pane, y) {
  context.fillStyle = "#ffb000";
  for (const x of [pane.x, pane.x + pane.w - 9]) context.fillRect(x, y - 1, 9, 2);
}

function showScale(view) {
  const scale = find("scale"), [low, bar, high] = scale.children, grays = scaleOfView(view) === GRAYS;
  scale.hidden = view === "picture";
  bar.style.background = `linear-gradient(90deg, ${scaleOfView(view).stops.join(", ")})`;
  low.textContent = grays ? "darker" : "0";
  high.textContent = grays ? "brighter" : view === "error" ? `≥ ${ERROR_RANGE} of T` : "1";
}

function startViewer(info) {
  const viewer = new Viewer(info), { state, pictures, canvas } = viewer;
  const maps = [...new Set(pictures.sources.flatMap((source) => source.maps))];
  fillChoices(viewer, viewer.names);
  find("view").append(new Option("Picture", "picture"), new Option("Error", "error"), ...maps.map((title) => new Option(title)));
  Object.assign(find("ev"), { min: state.ev - 6, max: state.ev + 6 });
  find("row").max = pictures.height - 1;
  find("extent").textContent = pictures.extent + ".";
  find("view").addEventListener("change", ({ target }) => { showScale(target.value); viewer.update({ view: target.value }); });
  find("magnify").addEventListener("change", ({ target }) => viewer.update({ magnify: target.checked }));
  find("row").addEventListener("input", ({ target }) => viewer.setRow(Number(target.value)));
  canvas.addEventListener("pointermove", (event) => {
    const at = viewer.under(event);
    if (state.magnify) viewer.update({ at });
    viewer.readOut(at.x, at.y);
  });
  canvas.addEventListener("pointerleave", () => { if (state.magnify) viewer.update({ at: null }); });
  canvas.addEventListener("click", (event) => {
    if (!viewer.moved && state.layout === "all") viewer.update({ right: viewer.under(event).pane.source });
  });
  canvas.addEventListener("dblclick", (event) => {
    const at = viewer.under(event);
    if (state.zoom < 60) viewer.zoom(2, at);
    viewer.setRow(Math.floor(at.y * pictures.height));
  });
  viewer.listen({ wheelNeedsFocus: true });
  const pan = (dx, dy) => () => {
    viewer.update({ x: state.x + 0.1 * dx / state.zoom, y: state.y + 0.1 * dy * pictures.width / pictures.height / state.zoom });
    viewer.readOut(state.x, state.y);
  };
  const pans = { ArrowLeft: pan(-1, 0), ArrowRight: pan(1, 0), ArrowUp: pan(0, -1), ArrowDown: pan(0, 1) };
  viewer.listenToKeys(find("viewer"), pans);
  find("viewer").hidden = false;
  const still = pictures.frames.length < 2;
  find("time").hidden = still;
  find("transport").hidden = still;
  viewer.update({ row: state.row });
  return viewer;
}

// The menus of the left and the right source.
function fillChoices(player, names) {
  for (const side of ["left", "right"]) {
    const menu = player.find(side);
    menu.append(...names.map((name, i) => new Option(name, i)));
    menu.value = player.state[side];
    menu.addEventListener("change", () => player.update({ [side]: Number(menu.value) }));
  }
}
