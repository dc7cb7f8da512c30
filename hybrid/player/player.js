// A player of two pictures: divided, side by side, in turns or subtracted; zoomed, panned, exposed and played.

function find(id) {
  return document.getElementById(id);
}

function make(tag, text = "", kind = "") {
  const element = document.createElement(tag);
  element.textContent = text; // names come from files: never as markup
  if (kind) element.className = kind;
  return element;
}

function makeCanvas(width, height) {
  return Object.assign(document.createElement("canvas"), { width, height });
}

function clamp(x, low, high) {
  return Math.min(Math.max(x, low), high);
}

// A number with so many significant digits, without trailing zeros.
function rounded(value, digits) {
  return Number(Number(value).toPrecision(digits));
}

const BACKGROUND = "#18181a";
const FLIP_MS = 500; // slow enough to look at each picture, and safe for photosensitive people
const DOUBLINGS = 3; // of a difference: eight times

// Panes in CSS pixels; each shows a source between `from` and `to`. With the slider both fill the stage.
const LAYOUTS = {
  slider({ state: { left, right, split } }, wide, tall) {
    const pane = { x: 0, y: 0, w: wide, h: tall(wide) };
    return [{ ...pane, source: left, from: 0, to: split * wide }, { ...pane, source: right, from: split * wide, to: wide }];
  },
  pair({ state: { left, right } }, wide, tall) {
    return [left, right].map((source, i) => ({ source, ...cell(i * wide / 2, 0, wide / 2, tall(wide / 2)) }));
  },
  flicker({ state: { left, right, flipped } }, wide, tall) {
    return [{ source: flipped ? right : left, ...cell(0, 0, wide, tall(wide)) }];
  },
  difference({ state: { left, right } }, wide, tall) {
    return [{ source: left, subtracted: right, ...cell(0, 0, wide, tall(wide)) }];
  },
};

function cell(x, y, w, h) {
  return { x, y, w, h, from: x, to: x + w };
}

// What is shown is the state, and `update` is the one way to change it. A source has
//   frames                the numbers of the frames
//   size()                width and height of a picture
//   image(source, state)  a canvas or bitmap or a promise of one, null where there is none
//   label(source)         [name, figure]
//   prefetch(state), ready(state)   where pictures are loaded while they are played
class Player {
  constructor(source, { prefix = "", state = {}, flipMs = FLIP_MS } = {}) {
    Object.assign(this, { source, prefix, flipMs });
    this.canvas = this.find("canvas");
    this.stage = this.find("stage");
    this.state = { left: 0, right: 0, layout: "slider", frame: 0, split: 0.5, zoom: 1, x: 0.5, y: 0.5, ev: 0,
      flipped: false, playing: false, ...state };
    this.draws = 0;
    this.keys = {
      "+": () => this.zoom(1.5), "=": () => this.zoom(1.5), "-": () => this.zoom(1 / 1.5), 0: () => this.update({ zoom: 1 }),
      ",": () => this.step(-1), ".": () => this.step(1), " ": () => this.play(!this.state.playing),
      "[": () => this.expose(this.state.ev - 0.5), "]": () => this.expose(this.state.ev + 0.5), x: () => this.swap(),
    };
  }

  find(name) {
    return find(this.prefix + name);
  }

  // Change the state, and draw again what shows it.
  update(change) {
    const { state } = this, half = 0.5 / (change.zoom ?? state.zoom);
    Object.assign(state, change);
    state.x = clamp(state.x, half, 1 - half);
    state.y = clamp(state.y, half, 1 - half);
    return this.draw();
  }

  arrange(layout) {
    clearInterval(this.flips);
    const flip = () => this.update({ flipped: !this.state.flipped });
    if (layout === "flicker" && this.flipMs) this.flips = setInterval(flip, this.flipMs);
    return this.update({ layout, flipped: false });
  }

  // The point `at` stays where it is.
  zoom(factor, at = this.state) {
    const { state } = this, zoom = clamp(state.zoom * factor, 1, 64), keep = 1 - state.zoom / zoom;
    return this.update({ zoom, x: state.x + (at.x - state.x) * keep, y: state.y + (at.y - state.y) * keep });
  }

  expose(ev) {
    const { min, max } = this.find("ev");
    return this.update({ ev: clamp(ev, Number(min), Number(max)) });
  }

  swap() {
    return this.update({ left: this.state.right, right: this.state.left });
  }

  step(by) {
    const { length } = this.source.frames;
    return this.update({ frame: (this.state.frame + by + length) % length });
  }

  // In step with the clock. Where pictures have to be loaded each frame is waited for, else late frames are skipped.
  play(on) {
    const { state, source } = this;
    state.playing = on && source.frames.length > 1;
    cancelAnimationFrame(this.tick);
    let due = performance.now();
    const next = async (now) => {
      source.prefetch?.(state);
      const span = 1000 / this.find("rate").value, late = Math.max(0, Math.floor((now - due) / span));
      if (now >= due - 4 && (source.ready?.(state) ?? true)) { // half a refresh early is closer than a whole one late
        due = source.ready && late ? now + span : due + (1 + late) * span;
        await this.step(source.ready ? 1 : (1 + late) % source.frames.length || 1);
      }
      if (state.playing) this.tick = requestAnimationFrame(next);
    };
    if (state.playing) this.tick = requestAnimationFrame(next);
    return this.draw();
  }

  // Drawing

  // The height of a stage or pane as wide as this, in CSS pixels.
  tall(wide) {
    const { width, height } = this.source.size();
    return Math.min(wide * height / width, Math.max(260, 0.74 * innerHeight));
  }

  layOut() {
    return LAYOUTS[this.state.layout](this, this.stage.clientWidth, (wide) => this.tall(wide));
  }

  // CSS pixels of a picture's pixel.
  scaleOf(pane) {
    const { width, height } = this.source.size();
    return Math.min(pane.w / width, pane.h / height) * this.state.zoom;
  }

  async draw() {
    const mine = ++this.draws, panes = this.layOut(), { state, source } = this;
    const load = (name) => panes.map((pane) => (pane[name] === undefined ? null : source.image(pane[name], state)));
    const [images, subtracted] = await Promise.all([Promise.all(load("source")), Promise.all(load("subtracted"))]);
    if (mine !== this.draws) return; // a newer one is in progress
    const context = this.clear(Math.max(...panes.map((pane) => pane.y + pane.h)));
    // Enlarged pixels are shown as they are; smoothing would flatter.
    context.imageSmoothingEnabled = this.scaleOf(panes[0]) * devicePixelRatio < 2;
    panes.forEach((pane, i) => this.drawPane(context, pane, images[i], subtracted[i]));
    await this.drawOver(context, panes);
    this.showLabels(panes);
    this.showState(panes);
  }

  clear(tall) {
    const { canvas, stage } = this, context = canvas.getContext("2d"), ratio = devicePixelRatio;
    const width = Math.round(stage.clientWidth * ratio), height = Math.round(tall * ratio);
    if (canvas.width !== width || canvas.height !== height) {
      Object.assign(canvas, { width, height });
      canvas.style.height = tall + "px";
    }
    context.setTransform(ratio, 0, 0, ratio, 0, 0);
    context.fillStyle = BACKGROUND;
    context.fillRect(0, 0, stage.clientWidth, tall);
    return context;
  }

  drawPane(context, pane, image, subtracted) {
    const { width, height } = this.source.size(), { x, y } = this.state, scale = this.scaleOf(pane);
    const w = width * scale, h = height * scale, left = pane.x + pane.w / 2 - x * w, top = pane.y + pane.h / 2 - y * h;
    context.save();
    context.beginPath();
    context.rect(pane.from, pane.y, pane.to - pane.from, pane.h);
    context.clip();
    if (pane.subtracted !== undefined) {
      context.fillStyle = "#000"; // which stays black when it is doubled
      context.fillRect(pane.x, pane.y, pane.w, pane.h);
    }
    if (image) context.drawImage(image, left, top, w, h);
    if (pane.subtracted !== undefined) this.subtract(context, subtracted, [left, top, w, h]);
    if (this.state.layout !== "slider" && pane.x) {
      context.fillStyle = BACKGROUND; // between this pane and the one left of it
      context.fillRect(pane.x - 1, pane.y, 2, pane.h);
    }
    context.restore();
  }

  subtract(context, image, place) {
    if (!image) return;
    context.globalCompositeOperation = "difference";
    context.drawImage(image, ...place);
    context.globalCompositeOperation = "lighter"; // a picture added to itself is twice as bright
    context.setTransform(1, 0, 0, 1, 0, 0);
    for (let i = 0; i < DOUBLINGS; i++) context.drawImage(this.canvas, 0, 0);
  }

  // For pages that draw more over the panes.
  drawOver() {}

  showLabels(panes) {
    const { layout } = this.state, labels = this.find("labels");
    labels.className = layout === "all" ? "labels tight" : "labels";
    const texts = panes.flatMap((pane) => (pane.subtracted === undefined ? [pane] : [pane, { ...pane, source: pane.subtracted }]));
    labels.replaceChildren(...texts.map((pane, i) => {
      const [name, figure] = this.source.label(pane.source), element = make("div", name);
      if (figure) element.append(make("small", figure));
      element.style.top = pane.y + "px";
      if ((layout === "slider" || layout === "difference") && i) element.style.right = 0;
      else element.style.left = pane.x + "px";
      if (layout !== "slider") element.style.maxWidth = pane.w - 20 + "px";
      return element;
    }));
  }

  // Controls show the state; a page may lack some of them.
  showState(panes) {
    const { state, source } = this, percent = Math.round(100 * state.split), set = (name, values) => {
      if (this.find(name)) Object.assign(this.find(name), values);
    };
    const [left, right] = [state.left, state.right].map((each) => source.label(each)[0]), number = source.frames[state.frame];
    set("divider", { hidden: state.layout !== "slider", ariaValueNow: percent,
      ariaValueText: `${percent} percent ${left}, the rest ${right}` });
    this.find("divider").style.left = 100 * state.split + "%";
    set("frame", { max: Math.max(0, source.frames.length - 1), value: state.frame, ariaValueText: `frame ${number}` });
    set("frame-text", { textContent: number === undefined ? "" : `frame ${number}` });
    set("ev", { value: state.ev });
    set("ev-text", { textContent: `${state.ev < 0 ? "−" : "+"}${Math.abs(state.ev).toFixed(2)} EV` });
    set("zoom-text", { textContent: `${rounded(this.scaleOf(panes[0]), 2)}×` });
    set("play", { textContent: state.playing ? "❚❚" : "▶", ariaLabel: state.playing ? "Stop" : "Play", ariaPressed: state.playing });
    const radio = document.querySelector(`[name="${this.prefix}layout"][value="${state.layout}"]`);
    if (radio) radio.checked = true;
    this.canvas.setAttribute("aria-label", `Frame ${number}: ${state.layout === "all" ? "all" : `${left} left, ${right} right`}`);
  }

  // Controls

  listen({ wheelNeedsFocus = false } = {}) {
    const on = (name, kind, action) => this.find(name)?.addEventListener(kind, (event) => action(Number(event.target.value)));
    on("frame", "input", (frame) => { this.play(false); this.update({ frame }); });
    on("ev", "input", (ev) => this.expose(ev));
    on("play", "click", () => this.play(!this.state.playing));
    on("swap", "click", () => this.swap());
    on("zoom-in", "click", () => this.zoom(1.5));
    on("zoom-out", "click", () => this.zoom(1 / 1.5));
    on("zoom-fit", "click", () => this.update({ zoom: 1 }));
    for (const radio of document.querySelectorAll(`[name="${this.prefix}layout"]`)) {
      radio.addEventListener("change", () => this.arrange(radio.value));
    }
    this.listenToPointer(wheelNeedsFocus);
    this.listenToDivider();
    new ResizeObserver(() => this.draw()).observe(this.stage.parentElement);
  }

  // The pane under a pointer, and the place in its picture in [0, 1].
  under(event) {
    const box = this.canvas.getBoundingClientRect(), px = event.clientX - box.left, py = event.clientY - box.top;
    const inside = (pane) => px >= pane.from && px <= pane.to && py >= pane.y && py <= pane.y + pane.h;
    const panes = this.layOut(), pane = panes.find(inside) ?? panes[0];
    const scale = this.scaleOf(pane), { width, height } = this.source.size();
    return { pane, px, py, x: this.state.x + (px - pane.x - pane.w / 2) / (scale * width),
      y: this.state.y + (py - pane.y - pane.h / 2) / (scale * height) };
  }

  // Drag to pan; the wheel zooms.
  listenToPointer(wheelNeedsFocus) {
    const { canvas, state } = this;
    let drag = null;
    canvas.addEventListener("pointerdown", (event) => {
      canvas.setPointerCapture(event.pointerId);
      drag = { ...this.under(event), startX: state.x, startY: state.y };
      this.moved = false;
    });
    canvas.addEventListener("pointermove", (event) => {
      if (!drag) return;
      const { px, py } = this.under(event), scale = this.scaleOf(drag.pane), { width, height } = this.source.size();
      this.moved ||= Math.hypot(px - drag.px, py - drag.py) > 3;
      this.update({ x: drag.startX - (px - drag.px) / (scale * width), y: drag.startY - (py - drag.py) / (scale * height) });
    });
    for (const kind of ["pointerup", "pointercancel"]) canvas.addEventListener(kind, () => { drag = null; });
    canvas.addEventListener("wheel", (event) => {
      if (wheelNeedsFocus && document.activeElement !== canvas && !event.ctrlKey) return; // or the page could not be scrolled
      event.preventDefault();
      this.zoom(Math.exp(-event.deltaY * (event.deltaMode ? 0.05 : 0.002)), this.under(event));
    }, { passive: false });
  }

  listenToDivider() {
    const divider = this.find("divider"), { state } = this;
    divider.addEventListener("pointerdown", (event) => {
      divider.setPointerCapture(event.pointerId);
      divider.focus({ focusVisible: false });
      event.preventDefault();
    });
    divider.addEventListener("pointermove", (event) => {
      if (!divider.hasPointerCapture(event.pointerId)) return;
      const box = this.stage.getBoundingClientRect();
      this.update({ split: clamp((event.clientX - box.left) / box.width, 0, 1) });
    });
    divider.addEventListener("keydown", (event) => {
      const step = event.shiftKey ? 0.1 : 0.02;
      const goal = {
        ArrowLeft: state.split - step, ArrowDown: state.split - step, ArrowRight: state.split + step,
        ArrowUp: state.split + step, PageDown: state.split - 0.1, PageUp: state.split + 0.1, Home: 0, End: 1,
      }[event.key];
      if (goal === undefined) return;
      event.preventDefault();
      event.stopPropagation();
      this.update({ split: clamp(goal, 0, 1) });
    });
  }

  // Keys that are pressed in an element, unless one of its controls takes them.
  listenToKeys(element, onCanvas = {}) {
    element.addEventListener("keydown", (event) => {
      const { target, key } = event;
      if (event.ctrlKey || event.metaKey || event.altKey || target.matches("select, summary, [type=number]")) return;
      if (target.matches("input, button") && (key === " " || key.startsWith("Arrow"))) return;
      const action = (target === this.canvas && onCanvas[key]) || this.keys[key.length === 1 ? key.toLowerCase() : key];
      if (!action) return;
      event.preventDefault();
      action();
    });
  }
}
