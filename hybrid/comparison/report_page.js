"use strict";
(() => {
const find = (id) => document.getElementById(id);
const make = (tag, text = "", kind = "") => {
  const element = document.createElement(tag);
  element.textContent = text;
  if (kind) element.className = kind;
  return element;
};
const clamp = (x, low, high) => Math.min(Math.max(x, low), high);
const data = JSON.parse(find("data").textContent);
const results = new Map(data.results.map((r) => [r.name, r]));
const metrics = new Map(data.metrics.map((m) => [m.key, m]));

function figure(value, metric) {
  const number = Number(value);
  if (Number.isNaN(number)) return "–";
  if (!Number.isFinite(number)) return number > 0 ? "∞" : "−∞";
  const text = metric.logarithmic ? String(Number(number.toPrecision(3))) : number.toFixed(metric.digits);
  return text.replace("-", "−") + (metric.unit ? " " + metric.unit : "");
}
const seconds = (value) => value === null ? "not known" : value === 0 ? "nothing" : Number(value.toPrecision(3)) + " s";
const memory = (value) => value === null ? "not known"
  : value < 2 ** 30 ? (value / 2 ** 20).toFixed(0) + " MiB" : (value / 2 ** 30).toFixed(2) + " GiB";

// --- the chart ----------------------------------------------------------------------------------------

const viewer = data.pictures ? startViewer(data.pictures) : null;

(function startChart() {
  if (!find("plots")) return;
  const tip = find("tip");
  const up = find("axis-up"), over = find("axis-over");
  let plot = null;

  const points = () => [...plot.querySelectorAll(".point:not(.off)")]
    .sort((a, b) => place(a)[0] - place(b)[0]);
  const place = (point) => point.getAttribute("transform").match(/-?[\d.]+/g).map(Number);

  function choose() {
    for (const each of document.querySelectorAll(".plot")) {
      each.hidden = each.dataset.axes !== up.value + " " + over.value;
      if (!each.hidden) plot = each;
    }
    tip.hidden = true;
    enter();
  }

  // One point at a time is in the order of the Tab key; the arrows go from one to the next.
  function enter(point = points()[0]) {
    for (const each of plot.querySelectorAll(".point")) each.setAttribute("tabindex", each === point ? 0 : -1);
  }

  function show(point) {
    const result = results.get(point.dataset.name);
    const list = make("dl");
    const row = (term, value) => list.append(make("dt", term), make("dd", value));
    for (const [key, statistic] of Object.entries(result.metrics)) {
      if (metrics.has(key) && data.chart.includes(key)) row(metrics.get(key).label, figure(statistic.mean, metrics.get(key)));
    }
    const spread = result.spread ? ` (${result.spread.map((s) => Number(s.toPrecision(3))).join("–")})` : "";
    row("per megapixel", seconds(result.seconds_per_megapixel) + spread);
    row("of CPU time", seconds(result.cpu_seconds_per_megapixel));
    row("peak memory", memory(result.peak_bytes));
    if (result.worth !== null) row("worth", Number(Number(result.worth).toPrecision(2)) + "× the samples");
    for (const [name, value] of Object.entries(result.settings)) row(name, value);
    tip.replaceChildren(make("strong", result.label), list);
    const known = viewer && viewer.has(result.name);
    if (known) {
      tip.append(make("p", "Click or Enter: show it in the viewer, on the right."));
      viewer.thumbnail(result.name).then((canvas) => {
        if (canvas && tip.firstChild && tip.dataset.name === result.name) tip.prepend(canvas);
      });
    }
    tip.dataset.name = result.name;
    tip.hidden = false;
    const box = find("plots").getBoundingClientRect();
    const at = point.querySelector("polygon").getBoundingClientRect();
    const x = at.left + at.width / 2 - box.left, y = at.top + at.height / 2 - box.top;
    const left = x + 20 + tip.offsetWidth < box.width ? x + 20 : x - 20 - tip.offsetWidth;
    tip.style.left = Math.max(0, left) + "px";
    tip.style.top = Math.max(-40, y - 60) + "px";
  }

  for (const point of document.querySelectorAll(".point")) {
    point.addEventListener("pointerenter", () => show(point));
    point.addEventListener("pointerleave", () => { tip.hidden = true; });
    point.addEventListener("focus", () => { enter(point); show(point); });
    point.addEventListener("blur", () => { tip.hidden = true; });
    point.addEventListener("click", () => viewer && viewer.choose(point.dataset.name));
    point.addEventListener("keydown", (event) => {
      const all = points(), i = all.indexOf(point);
      const step = { ArrowRight: 1, ArrowUp: 1, ArrowLeft: -1, ArrowDown: -1 }[event.key];
      if (step) all[clamp(i + step, 0, all.length - 1)].focus();
      else if (event.key === "Home") all[0].focus();
      else if (event.key === "End") all[all.length - 1].focus();
      else if (event.key === "Escape") tip.hidden = true;
      else if ((event.key === "Enter" || event.key === " ") && viewer) viewer.choose(point.dataset.name);
      else return;
      event.preventDefault();
    });
  }
  for (const box of document.querySelectorAll(".legend input")) {
    box.addEventListener("change", () => {
      for (const mark of document.querySelectorAll(`.plot [data-family="${Number(box.dataset.family)}"]`)) {
        mark.classList.toggle("off", !box.checked);
      }
      enter();
    });
  }
  up.addEventListener("change", choose);
  over.addEventListener("change", choose);
  choose();
})();

// --- the pictures -------------------------------------------------------------------------------------

function startViewer(pictures) {
  const { width, height, frames, sources } = pictures;
  const count = width * height;
  const canvas = find("canvas"), stage = find("stage"), divider = find("divider"), labels = find("labels");
  const indices = new Map(sources.map((s, i) => [s.name, i]));
  const titles = [...new Set(sources.flatMap((s) => s.maps))];

  // 0 EV is the exposure of the metrics; start where the shot's mean level is a comfortable middle grey.
  const start = Math.round(2 * Math.log2(0.35 / (data.exposure * pictures.black * 64))) / 2;
  const front = [...(data.fronts[`${data.chart[0]} ${data.cost}`] || [])].reverse();
  const best = front.find((name) => indices.has(name));
  const state = {
    left: indices.get("noisy") ?? Math.min(1, sources.length - 1),
    right: indices.get(best) ?? sources.length - 1,
    view: "picture", layout: "slider", frame: Math.floor(frames.length / 2), ev: start,
    split: 0.5, zoom: 1, x: width / 2, y: height / 2, row: pictures.row, playing: false,
  };
  if (state.left === state.right) state.right = 0;

  // --- decoding: see _compress in hybrid/report.py

  const decoded = new Map();

  function planes(id, channels, levels) {
    if (!decoded.has(id)) decoded.set(id, inflate(id).then((raw) => unpack(raw, channels, levels)));
    return decoded.get(id);
  }
  const codesOf = (source, frame) => planes(`p${source}-${frame}`, 3, pictures.codes);
  const mapOf = (source, title, frame) => {
    const j = sources[source].maps.indexOf(title);
    return j < 0 ? null : planes(`m${source}-${j}-${frame}`, 1, pictures.mapLevels);
  };

  async function inflate(id) {
    const bytes = Uint8Array.from(atob(find(id).textContent), (c) => c.charCodeAt(0));
    const stream = new Blob([bytes]).stream().pipeThrough(new DecompressionStream("deflate"));
    return new Uint8Array(await new Response(stream).arrayBuffer());
  }

  function unpack(raw, channels, levels) {
    const total = channels * count, mask = levels - 1, half = levels >> 1;
    const out = new Uint16Array(total);
    for (let c = 0; c < channels; c++) {
      for (let y = 0, i = c * count; y < height; y++) {
        for (let x = 0; x < width; x++, i++) {
          const above = y ? out[i - width] : 0;
          const left = x ? out[i - 1] : above;
          const corner = x ? (y ? out[i - width - 1] : 0) : (y > 1 ? out[i - 2 * width] : 0);
          const small = Math.min(left, above), large = Math.max(left, above);
          const guess = corner >= large ? small : corner <= small ? large : left + above - corner;
          const folded = raw[i] | (raw[total + i] << 8);
          out[i] = (guess + (folded & 1 ? -((folded + 1) >> 1) : folded >> 1)) & mask;
        }
      }
    }
    if (channels === 3) {
      // Stored green, red − green, blue − green; wanted red, green, blue.
      for (let i = 0; i < count; i++) {
        const green = out[i], red = out[count + i], blue = out[2 * count + i];
        out[i] = (red + green - half) & mask;
        out[count + i] = green;
        out[2 * count + i] = (blue + green - half) & mask;
      }
    }
    return out;
  }

  // --- from codes to what is shown

  const radiance = Float64Array.from({ length: pictures.codes }, (_, c) =>
    c === pictures.codes - 1 ? NaN : pictures.black * (2 ** (c / pictures.codesPerStop) - 1));
  let tone, display;

  function setExposure(ev) {
    const gain = data.exposure * 2 ** ev;
    tone = radiance.map((x) => gain * x / (1 + gain * x));
    display = Uint8ClampedArray.from(tone, (t) =>
      255 * (t <= 0.0031308 ? 12.92 * t : 1.055 * t ** (1 / 2.4) - 0.055));
  }

  const ramp = (stops) => {
    const rgb = stops.map((hex) => [1, 3, 5].map((i) => parseInt(hex.slice(i, i + 2), 16)));
    const table = new Uint8ClampedArray(256 * 3);
    for (let i = 0; i < 256; i++) {
      const at = i / 255 * (rgb.length - 1), k = Math.min(Math.floor(at), rgb.length - 2);
      for (let c = 0; c < 3; c++) table[3 * i + c] = rgb[k][c] + (rgb[k + 1][c] - rgb[k][c]) * (at - k);
    }
    return { stops, table };
  };
  const magma = ramp(["#000004", "#180f3d", "#440f76", "#721f81", "#9e2f7f", "#cd4071", "#f1605d", "#fd9668", "#feca8d",
    "#fcfdbf"]);
  const viridis = ramp(["#440154", "#482878", "#3e4989", "#31688e", "#26828e", "#1f9e89", "#35b779", "#6ece58", "#b5de2b",
    "#fde725"]);
  const rampOf = (view) => view === "error" || /flip|error/i.test(view) ? magma : viridis;
  const ERROR_RANGE = 0.1; // of the tone curve: 20 dB at the bright end of the scale

  const tiles = new Map(); // finished pictures, by all they depend on

  async function tile(source, view, frame) {
    const key = [source, view, frame, view === "picture" || view === "error" ? state.ev : 0].join("|");
    if (!tiles.has(key)) {
      if (tiles.size > 96) tiles.delete(tiles.keys().next().value);
      tiles.set(key, paint(source, view, frame));
    }
    return tiles.get(key);
  }

  async function paint(source, view, frame) {
    const image = new ImageData(width, height), out = image.data;
    const put = (i, table, k) => {
      out[4 * i] = table[3 * k]; out[4 * i + 1] = table[3 * k + 1]; out[4 * i + 2] = table[3 * k + 2];
      out[4 * i + 3] = 255;
    };
    if (view === "picture") {
      const codes = await codesOf(source, frame), lost = pictures.codes - 1;
      for (let i = 0; i < count; i++) {
        const r = codes[i], g = codes[count + i], b = codes[2 * count + i];
        out[4 * i] = display[r]; out[4 * i + 1] = display[g]; out[4 * i + 2] = display[b]; out[4 * i + 3] = 255;
        if (r === lost || g === lost || b === lost) { out[4 * i] = 255; out[4 * i + 1] = 0; out[4 * i + 2] = 255; }
      }
    } else if (view === "error") {
      const [codes, truth] = await Promise.all([codesOf(source, frame), codesOf(0, frame)]);
      for (let i = 0; i < count; i++) {
        let error = 0;
        for (let c = i; c < 3 * count; c += count) error += Math.abs(tone[codes[c]] - tone[truth[c]]) / 3;
        put(i, magma.table, Number.isNaN(error) ? 255 : Math.min(255, Math.round(error / ERROR_RANGE * 255)));
      }
    } else {
      const map = await mapOf(source, view, frame);
      if (!map) return null;
      const { table } = rampOf(view);
      for (let i = 0; i < count; i++) put(i, table, Math.round(map[i] / (pictures.mapLevels - 1) * 255));
    }
    const tile = document.createElement("canvas");
    tile.width = width; tile.height = height;
    tile.getContext("2d").putImageData(image, 0, 0);
    return tile;
  }

  // --- the stage

  // Where each picture goes, in CSS pixels; with the slider both fill the stage and are cut at the divider.
  function panes() {
    const wide = stage.clientWidth, most = Math.max(260, 0.74 * innerHeight);
    if (state.layout === "all") {
      const columns = Math.max(1, Math.min(sources.length, Math.floor(wide / 250), 4));
      const w = wide / columns, h = w * height / width;
      return { tall: Math.ceil(sources.length / columns) * h, list: sources.map((_, i) =>
        ({ source: i, x: (i % columns) * w, y: Math.floor(i / columns) * h, w, h })) };
    }
    if (state.layout === "pair") {
      const h = Math.min(wide / 2 * height / width, most);
      return { tall: h, list: [state.left, state.right].map((source, i) =>
        ({ source, x: i * wide / 2, y: 0, w: wide / 2, h })) };
    }
    const h = Math.min(wide * height / width, most);
    return { tall: h, list: [state.left, state.right].map((source, i) => ({ source, x: 0, y: 0, w: wide, h,
      from: i ? state.split * wide : 0, to: i ? wide : state.split * wide })) };
  }
  const scaleOf = (pane) => Math.min(pane.w / width, pane.h / height) * state.zoom;

  let turn = 0;

  async function draw() {
    const mine = ++turn;
    const { tall, list } = panes();
    const images = await Promise.all(list.map((pane) => tile(pane.source, state.view, state.frame)));
    if (mine !== turn) return; // something newer is on its way
    const dense = devicePixelRatio || 1;
    const w = Math.round(stage.clientWidth * dense), h = Math.round(tall * dense);
    if (canvas.width !== w || canvas.height !== h) {
      canvas.width = w; canvas.height = h;
      canvas.style.height = tall + "px";
    }
    const context = canvas.getContext("2d");
    context.setTransform(dense, 0, 0, dense, 0, 0);
    context.fillStyle = "#18181a";
    context.fillRect(0, 0, stage.clientWidth, tall);
    const scale = scaleOf(list[0]);
    // Whole enlarged pixels are shown as they are; smoothing would flatter.
    context.imageSmoothingEnabled = scale * dense < 2;
    list.forEach((pane, i) => {
      context.save();
      context.beginPath();
      context.rect(pane.from ?? pane.x, pane.y, (pane.to ?? pane.x + pane.w) - (pane.from ?? pane.x), pane.h);
      context.clip();
      const left = pane.x + pane.w / 2 - state.x * scale, top = pane.y + pane.h / 2 - state.y * scale;
      if (images[i]) context.drawImage(images[i], left, top, width * scale, height * scale);
      else {
        context.fillStyle = "#a3a3ad";
        context.font = "14px system-ui, sans-serif";
        context.textAlign = "center";
        context.fillText("no such map", ((pane.from ?? pane.x) + (pane.to ?? pane.x + pane.w)) / 2, pane.y + pane.h / 2);
      }
      const row = top + (state.row + 0.5) * scale; // ticks at the row of the slices
      context.fillStyle = "#ffb000";
      for (const x of state.layout === "all" ? [] : [pane.x, pane.x + pane.w - 9]) context.fillRect(x, row - 1, 9, 2);
      if (state.layout !== "slider" && pane.x) { context.fillStyle = "#18181a"; context.fillRect(pane.x - 1, pane.y, 2, pane.h); }
      context.restore();
    });
    dress(list);
  }

  function dress(list) {
    divider.hidden = state.layout !== "slider";
    divider.style.left = 100 * state.split + "%";
    divider.setAttribute("aria-valuenow", Math.round(100 * state.split));
    divider.setAttribute("aria-valuetext",
      `${Math.round(100 * state.split)} percent ${sources[state.left].label}, the rest ${sources[state.right].label}`);
    labels.className = state.layout === "all" ? "tight" : "";
    labels.replaceChildren(...list.map((pane, i) => {
      const label = make("div", sources[pane.source].label);
      const metric = metrics.get(data.chart[0]);
      const statistic = metric && results.get(sources[pane.source].name)?.metrics[metric.key];
      if (statistic) label.append(make("small", figure(statistic.mean, metric)));
      label.style.top = pane.y + "px";
      if (state.layout === "slider" && i) label.style.right = 0; else label.style.left = pane.x + "px";
      if (state.layout !== "slider") label.style.maxWidth = pane.w - 20 + "px";
      return label;
    }));
    canvas.setAttribute("aria-label", `Frame ${frames[state.frame]}, ${find("view").selectedOptions[0].textContent}: `
      + (state.layout === "all" ? "all methods" : `${sources[state.left].label} left, ${sources[state.right].label} right`));
    find("left").value = state.left; find("right").value = state.right;
    find("frame").value = state.frame;
    find("frame-text").textContent = `frame ${frames[state.frame]}`;
    find("ev").value = state.ev;
    find("ev-text").textContent = `${state.ev < 0 ? "−" : "+"}${Math.abs(state.ev).toFixed(2)} EV`;
    find("zoom-text").textContent = `${Number(scaleOf(list[0]).toPrecision(2))}×`;
    find("row").value = state.row; find("row-text").textContent = pictures.origin[1] + state.row;
  }

  function redraw(change = {}) {
    Object.assign(state, change);
    const half = { x: width / 2 / state.zoom, y: height / 2 / state.zoom };
    state.x = clamp(state.x, half.x, width - half.x);
    state.y = clamp(state.y, half.y, height - half.y);
    return draw();
  }

  function zoom(factor, at = null) {
    const next = clamp(state.zoom * factor, 1, 64);
    const keep = 1 - state.zoom / next; // the point under the pointer stays where it is
    redraw({ zoom: next, x: state.x + (at ? (at.x - state.x) * keep : 0), y: state.y + (at ? (at.y - state.y) * keep : 0) });
  }

  // The picture coordinates under a pointer, and the pane it is over.
  function under(event) {
    const box = canvas.getBoundingClientRect(), px = event.clientX - box.left, py = event.clientY - box.top;
    const inside = (p) => px >= (p.from ?? p.x) && px <= (p.to ?? p.x + p.w) && py >= p.y && py <= p.y + p.h;
    const { list } = panes(), pane = list.find(inside) ?? list[0], scale = scaleOf(pane);
    return { pane, x: state.x + (px - pane.x - pane.w / 2) / scale, y: state.y + (py - pane.y - pane.h / 2) / scale };
  }

  async function readOut(x, y) {
    const px = Math.floor(x), py = Math.floor(y);
    if (px < 0 || py < 0 || px >= width || py >= height) return;
    const chosen = [...new Set([state.left, state.right, 0])];
    const all = await Promise.all(chosen.map((s) => codesOf(s, state.frame)));
    const texts = all.map((codes, k) => {
      const rgb = [0, 1, 2].map((c) => radiance[codes[c * count + py * width + px]]);
      return `${sources[chosen[k]].label} ${rgb.map((v) => Number.isNaN(v) ? "not finite" : Number(v.toPrecision(3))).join(" ")}`;
    });
    find("readout").textContent = `(${pictures.origin[0] + px}, ${pictures.origin[1] + py})   ${texts.join("   ·   ")}`;
  }

  // --- pointers and keys

  let drag = null;
  canvas.addEventListener("pointerdown", (event) => {
    canvas.setPointerCapture(event.pointerId);
    drag = { px: event.clientX, py: event.clientY, x: state.x, y: state.y, moved: false };
  });
  canvas.addEventListener("pointermove", (event) => {
    const at = under(event);
    if (drag) {
      const scale = scaleOf(at.pane), dx = event.clientX - drag.px, dy = event.clientY - drag.py;
      drag.moved ||= Math.hypot(dx, dy) > 3;
      redraw({ x: drag.x - dx / scale, y: drag.y - dy / scale });
    }
    readOut(at.x, at.y);
  });
  canvas.addEventListener("pointerup", (event) => {
    if (drag && !drag.moved && state.layout === "all") redraw({ right: under(event).pane.source });
    drag = null;
  });
  canvas.addEventListener("pointercancel", () => { drag = null; });
  canvas.addEventListener("dblclick", (event) => {
    const at = under(event);
    if (state.zoom < 60) zoom(2, at);
    setRow(Math.floor(at.y));
  });
  canvas.addEventListener("wheel", (event) => {
    if (document.activeElement !== canvas && !event.ctrlKey) return; // or the page could not be scrolled
    event.preventDefault();
    zoom(Math.exp(-event.deltaY * (event.deltaMode ? 0.05 : 0.002)), under(event));
  }, { passive: false });

  const slide = (event) => {
    const box = stage.getBoundingClientRect();
    redraw({ split: clamp((event.clientX - box.left) / box.width, 0, 1) });
  };
  divider.addEventListener("pointerdown", (event) => {
    divider.setPointerCapture(event.pointerId);
    divider.focus({ focusVisible: false });
    event.preventDefault();
  });
  divider.addEventListener("pointermove", (event) => { if (divider.hasPointerCapture(event.pointerId)) slide(event); });
  divider.addEventListener("keydown", (event) => {
    const step = (event.shiftKey ? 0.1 : 0.02) * ({ ArrowLeft: -1, ArrowDown: -1, ArrowRight: 1, ArrowUp: 1 }[event.key] ?? 0);
    const goal = { Home: 0, End: 1, PageDown: state.split - 0.1, PageUp: state.split + 0.1 }[event.key];
    if (!step && goal === undefined) return;
    event.preventDefault();
    redraw({ split: clamp(goal ?? state.split + step, 0, 1) });
  });

  find("viewer").addEventListener("keydown", (event) => {
    if (event.ctrlKey || event.metaKey || event.altKey || /^(SELECT|SUMMARY)$/.test(event.target.tagName)) return;
    const typing = /^(INPUT|BUTTON)$/.test(event.target.tagName);
    const reach = 0.1 * width / state.zoom;
    const pan = { ArrowLeft: [-1, 0], ArrowRight: [1, 0], ArrowUp: [0, -1], ArrowDown: [0, 1] }[event.key];
    if (pan && event.target === canvas) {
      redraw({ x: state.x + pan[0] * reach, y: state.y + pan[1] * reach });
      readOut(state.x, state.y);
    } else if (event.key === "+" || event.key === "=") zoom(1.5);
    else if (event.key === "-") zoom(1 / 1.5);
    else if (event.key === "0") redraw({ zoom: 1 });
    else if (event.key === " " && !typing) play(!state.playing);
    else if (event.key === ",") step(-1);
    else if (event.key === ".") step(1);
    else if (event.key === "[") expose(state.ev - 0.5);
    else if (event.key === "]") expose(state.ev + 0.5);
    else if (event.key === "x" || event.key === "X") redraw({ left: state.right, right: state.left });
    else if (/^[1-9]$/.test(event.key) && sources[event.key - 1]) redraw({ right: event.key - 1 });
    else return;
    event.preventDefault();
  });

  // --- exposure, frames, playing

  function expose(ev) {
    const input = find("ev");
    state.ev = clamp(ev, Number(input.min), Number(input.max));
    setExposure(state.ev);
    tiles.clear();
    redraw();
    drawSlices();
  }

  const step = (by) => redraw({ frame: (state.frame + by + frames.length) % frames.length });

  let clock = 0;

  async function play(on) {
    state.playing = on;
    const button = find("play");
    button.textContent = on ? "❚❚" : "▶";
    button.setAttribute("aria-label", on ? "Stop" : "Play");
    button.setAttribute("aria-pressed", on);
    cancelAnimationFrame(clock);
    if (!on) return;
    let last = performance.now();
    const tick = async (now) => {
      if (!state.playing) return;
      if (now - last >= 1000 / find("rate").value - 4) {
        last = now;
        await step(1);
      }
      if (state.playing) clock = requestAnimationFrame(tick);
    };
    clock = requestAnimationFrame(tick);
  }

  // --- slices through time

  const bands = sources.map((source, i) => {
    const name = make("div", source.label);
    const metric = metrics.get("temporal_psnr");
    const statistic = metric && results.get(source.name)?.metrics.temporal_psnr;
    if (statistic) name.append(make("small", `temporal PSNR ${figure(statistic.mean, metric)}`));
    const canvases = [0, 1].map((k) => {
      const band = document.createElement("canvas");
      band.width = width; band.height = frames.length;
      band.style.height = clamp(84 / frames.length, 5, 14) * frames.length + "px";
      band.setAttribute("role", "img");
      band.setAttribute("aria-label", `${source.label}: ${k ? "difference from the reference" : "picture"}, one row through time`);
      return band;
    });
    if (i === 0) canvases[1].style.visibility = "hidden";
    find("slices").append(name, ...canvases);
    return canvases;
  });

  let slicing = 0;

  async function drawSlices() {
    const mine = ++slicing;
    for (let s = 0; s < sources.length; s++) {
      const shown = new ImageData(width, frames.length), wrong = new ImageData(width, frames.length);
      for (let f = 0; f < frames.length; f++) {
        const [codes, truth] = await Promise.all([codesOf(s, f), codesOf(0, f)]);
        for (let x = 0, i = state.row * width, o = 4 * f * width; x < width; x++, i++, o += 4) {
          let error = 0;
          for (let c = 0; c < 3; c++) {
            const code = codes[c * count + i];
            shown.data[o + c] = display[code];
            error += (tone[code] - tone[truth[c * count + i]]) / 3;
          }
          const strength = Math.min(1, Math.abs(error) / ERROR_RANGE) ** 0.7;
          const hue = error > 0 ? [255, 165, 60] : [70, 165, 255];
          for (let c = 0; c < 3; c++) wrong.data[o + c] = Number.isNaN(error) ? 255 : hue[c] * strength;
          shown.data[o + 3] = wrong.data[o + 3] = 255;
        }
      }
      if (mine !== slicing) return;
      bands[s][0].getContext("2d").putImageData(shown, 0, 0);
      bands[s][1].getContext("2d").putImageData(wrong, 0, 0);
    }
  }

  function setRow(row) {
    redraw({ row: clamp(row, 0, height - 1) });
    drawSlices();
  }

  // --- controls

  for (const id of ["left", "right"]) {
    find(id).append(...sources.map((s, i) => new Option(s.label, i)));
    find(id).addEventListener("change", (event) => redraw({ [id]: Number(event.target.value) }));
  }
  find("view").append(new Option("Picture", "picture"), new Option("Error", "error"), ...titles.map((t) => new Option(t, t)));
  find("view").addEventListener("change", (event) => {
    const view = event.target.value, scale = find("scale");
    scale.hidden = view === "picture";
    const [low, bar, high] = scale.children;
    bar.style.background = `linear-gradient(90deg, ${rampOf(view).stops.join(", ")})`;
    low.textContent = "0";
    high.textContent = view === "error" ? `≥ ${ERROR_RANGE} of T` : "1";
    redraw({ view });
  });
  for (const radio of document.querySelectorAll("[name=layout]")) {
    radio.addEventListener("change", () => redraw({ layout: radio.value }));
  }
  find("swap").addEventListener("click", () => redraw({ left: state.right, right: state.left }));
  find("zoom-in").addEventListener("click", () => zoom(1.5));
  find("zoom-out").addEventListener("click", () => zoom(1 / 1.5));
  find("zoom-fit").addEventListener("click", () => redraw({ zoom: 1 }));
  Object.assign(find("ev"), { min: start - 6, max: start + 6 });
  find("ev").addEventListener("input", (event) => expose(Number(event.target.value)));
  find("frame").max = frames.length - 1;
  find("frame").addEventListener("input", (event) => redraw({ frame: Number(event.target.value) }));
  find("play").addEventListener("click", () => play(!state.playing));
  find("row").max = height - 1;
  find("row").addEventListener("input", (event) => setRow(Number(event.target.value)));
  find("extent").textContent = pictures.extent + ".";
  find("viewer").hidden = false;
  find("time").hidden = frames.length < 2;
  document.querySelector(".transport").hidden = frames.length < 2;
  setExposure(state.ev);
  new ResizeObserver(() => draw()).observe(stage.parentElement);
  draw();
  drawSlices();

  return {
    has: (name) => indices.has(name),
    choose: (name) => indices.has(name) && redraw({ right: indices.get(name) }),
    thumbnail: async (name) => {
      const image = await tile(indices.get(name), "picture", state.frame);
      const copy = document.createElement("canvas");
      copy.width = width; copy.height = Math.round(height * 0.62);
      copy.getContext("2d").drawImage(image, 0, -height * 0.19);
      return copy;
    },
  };
}
})();
