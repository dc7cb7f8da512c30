// The stage: where each picture goes, drawing them there, and what a pointer is over.

const LENS = 120, MAGNIFIED = 4; // the side of a lens in CSS pixels, and how much larger than around it things are there

// Where each picture goes, in CSS pixels. With the slider both fill the stage, and are cut at the divider.
const LAYOUTS = {
  slider({ left, right, split }, { width, height }, wide, most) {
    const h = Math.min(wide * height / width, most);
    const pane = { x: 0, y: 0, w: wide, h };
    return { tall: h, panes: [{ ...pane, source: left, from: 0, to: split * wide },
      { ...pane, source: right, from: split * wide, to: wide }] };
  },
  pair({ left, right }, { width, height }, wide, most) {
    const w = wide / 2, h = Math.min(w * height / width, most);
    return { tall: h, panes: [left, right].map((source, i) => ({ source, ...cell(i * w, 0, w, h) })) };
  },
  flicker({ left, right, flipped }, { width, height }, wide, most) {
    const h = Math.min(wide * height / width, most);
    return { tall: h, panes: [{ source: flipped ? right : left, ...cell(0, 0, wide, h) }] };
  },
  all(state, { width, height, sources }, wide) {
    const columns = clamp(Math.min(sources.length, Math.floor(wide / 250)), 1, 4);
    const w = wide / columns, h = w * height / width;
    return { tall: Math.ceil(sources.length / columns) * h, panes: sources.map((_, source) =>
      ({ source, ...cell((source % columns) * w, Math.floor(source / columns) * h, w, h) })) };
  },
};

function cell(x, y, w, h) {
  return { x, y, w, h, from: x, to: x + w };
}

class Stage {
  constructor(pictures, painter, state) {
    Object.assign(this, { pictures, painter, state });
    this.element = find("stage");
    this.canvas = find("canvas");
    this.draws = 0;
  }

  layOut() {
    const most = Math.max(260, 0.74 * innerHeight);
    return LAYOUTS[this.state.layout](this.state, this.pictures, this.element.clientWidth, most);
  }

  // CSS pixels of a picture's pixel.
  scaleOf(pane) {
    return Math.min(pane.w / this.pictures.width, pane.h / this.pictures.height) * this.state.zoom;
  }

  // Returns the panes, or null where something newer is on its way.
  async draw() {
    const mine = ++this.draws, { tall, panes } = this.layOut(), { view, frame } = this.state;
    const tiles = await Promise.all(panes.map((pane) => this.painter.tile(pane.source, view, frame)));
    if (mine !== this.draws) return null;
    const context = this.clear(tall);
    // Whole enlarged pixels are shown as they are; smoothing would flatter.
    context.imageSmoothingEnabled = this.scaleOf(panes[0]) * devicePixelRatio < 2;
    panes.forEach((pane, i) => this.drawPane(context, pane, tiles[i]));
    if (this.state.magnify && this.state.at) await this.drawLenses(context, panes[0], this.state.at);
    this.drawLabels(panes);
    return panes;
  }

  clear(tall) {
    const { canvas, element } = this, context = canvas.getContext("2d");
    const w = Math.round(element.clientWidth * devicePixelRatio), h = Math.round(tall * devicePixelRatio);
    if (canvas.width !== w || canvas.height !== h) {
      Object.assign(canvas, { width: w, height: h });
      canvas.style.height = tall + "px";
    }
    context.setTransform(devicePixelRatio, 0, 0, devicePixelRatio, 0, 0);
    context.fillStyle = "#18181a";
    context.fillRect(0, 0, element.clientWidth, tall);
    return context;
  }

  drawPane(context, pane, tile) {
    const { width, height } = this.pictures, { x, y, row, layout } = this.state, scale = this.scaleOf(pane);
    const left = pane.x + pane.w / 2 - x * scale, top = pane.y + pane.h / 2 - y * scale;
    context.save();
    context.beginPath();
    context.rect(pane.from, pane.y, pane.to - pane.from, pane.h);
    context.clip();
    if (tile) context.drawImage(tile, left, top, width * scale, height * scale);
    else writeAmid(context, "no such map of this frame", (pane.from + pane.to) / 2, pane.y + pane.h / 2);
    if (layout !== "all") drawTicks(context, pane, top + (row + 0.5) * scale);
    if (layout !== "slider" && pane.x) {
      context.fillStyle = "#18181a"; // between this pane and the one left of it
      context.fillRect(pane.x - 1, pane.y, 2, pane.h);
    }
    context.restore();
  }

  // The left and the right picture where the pointer is, enlarged, side by side above it.
  async drawLenses(context, pane, { x, y, px, py }) {
    const { left, right, view, frame } = this.state, scale = this.scaleOf(pane) * MAGNIFIED;
    const tiles = await Promise.all([left, right].map((source) => this.painter.tile(source, view, frame)));
    const top = py > LENS + 20 ? py - LENS - 20 : py + 20;
    const start = clamp(px - LENS, 0, Math.max(0, this.element.clientWidth - 2 * LENS));
    context.imageSmoothingEnabled = scale * devicePixelRatio < 2;
    tiles.forEach((tile, i) => {
      const from = start + i * LENS, { width, height } = this.pictures;
      context.save();
      context.beginPath();
      context.rect(from, top, LENS, LENS);
      context.fillStyle = "#18181a";
      context.fill();
      context.clip();
      if (tile) {
        context.drawImage(tile, from + LENS / 2 - x * scale, top + LENS / 2 - y * scale, width * scale, height * scale);
      }
      context.restore();
      context.strokeStyle = "#fff";
      context.strokeRect(from + 0.5, top + 0.5, LENS - 1, LENS - 1);
    });
  }

  // What each pane shows, and its figure by the chart's first measure.
  drawLabels(panes) {
    const { layout } = this.state, labels = find("labels");
    labels.className = layout === "all" ? "tight" : "";
    labels.replaceChildren(...panes.map((pane, i) => {
      const { name, label } = this.pictures.sources[pane.source], element = make("div", label);
      const figure = meanText(name, report.chart[0]);
      if (figure) element.append(make("small", figure));
      element.style.top = pane.y + "px";
      if (layout === "slider" && i) element.style.right = 0;
      else element.style.left = pane.x + "px";
      if (layout !== "slider") element.style.maxWidth = pane.w - 20 + "px";
      return element;
    }));
  }

  // The pane under a pointer, and the coordinates of the picture there.
  under(event) {
    const box = this.canvas.getBoundingClientRect(), px = event.clientX - box.left, py = event.clientY - box.top;
    const inside = (pane) => px >= pane.from && px <= pane.to && py >= pane.y && py <= pane.y + pane.h;
    const { panes } = this.layOut(), pane = panes.find(inside) ?? panes[0], scale = this.scaleOf(pane);
    return { pane, px, py, x: this.state.x + (px - pane.x - pane.w / 2) / scale,
      y: this.state.y + (py - pane.y - pane.h / 2) / scale };
  }
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
