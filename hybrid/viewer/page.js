// The page of `ravg view`: shows what the server has, and asks again while frames are still being made.

const POLL_MS = 2000;
const KEPT_BYTES = 512e6; // of decoded pictures
const AHEAD = 6; // frames that are asked for before it is their turn
const AMPLIFY = 3; // doublings of a difference: eight times

const $ = (selector) => document.querySelector(selector);
const canvas = $("#picture");
const context = canvas.getContext("2d");

let state = { rate: 24, sequences: [] };
let numbers = []; // of the frames that any sequence has, ascending
const sides = { a: { sequence: 0, layer: "" }, b: { sequence: 0, layer: "" } };
const view = { index: 0, mode: "wipe", split: 0.5, ev: 0, zoom: 1, x: 0, y: 0, flipped: false, playing: false };

// --- pictures ---------------------------------------------------------------------------------------------

const pictures = new Map(); // address → { bitmap, error, pending }, the one used last at the end

function address(side, number, kind) {
  const { sequence, layer } = sides[side];
  const version = state.sequences[sequence]?.frames[number];
  if (version === undefined || !layer) return null;
  return `frame/${sequence}/${number}.${kind}?layer=${encodeURIComponent(layer)}&ev=${view.ev}&version=${version}`;
}

/** The picture at an address if it is there; asks for it if not, and draws when it comes. */
function picture(url) {
  if (url === null) return null;
  let entry = pictures.get(url);
  if (entry) {
    pictures.delete(url);
  } else {
    entry = { bitmap: null, error: "", pending: load(url) };
  }
  pictures.set(url, entry);
  return entry;
}

async function load(url) {
  let bitmap = null, error = "";
  try {
    const answer = await fetch(url);
    if (answer.ok) bitmap = await createImageBitmap(await answer.blob());
    else error = await answer.text();
  } catch (failure) {
    error = String(failure);
  }
  const entry = pictures.get(url);
  if (!entry) return bitmap?.close();
  Object.assign(entry, { bitmap, error, pending: null });
  forget();
  draw();
}

function forget() {
  const bytes = (entry) => (entry.bitmap ? entry.bitmap.width * entry.bitmap.height * 4 : 0);
  let sum = 0;
  for (const entry of pictures.values()) sum += bytes(entry);
  for (const [url, entry] of pictures) {
    if (sum <= KEPT_BYTES) break;
    sum -= bytes(entry);
    entry.bitmap?.close();
    pictures.delete(url);
  }
}

/** What to show of a side now: exact where the picture stands still, quick while it plays. */
function current(side, number) {
  const quick = pictures.get(address(side, number, "jpg"));
  if (view.playing) return quick ?? picture(address(side, number, "jpg"));
  const exact = picture(address(side, number, "png"));
  return exact === null || exact.bitmap || exact.error || !quick?.bitmap ? exact : quick;
}

// --- drawing ----------------------------------------------------------------------------------------------

let waiting = false;

function draw() {
  if (waiting) return;
  waiting = true;
  canvas.dataset.exact = false; // until what is asked for now is painted
  requestAnimationFrame(() => {
    waiting = false;
    paint();
  });
}

function paint() {
  const ratio = window.devicePixelRatio || 1;
  const width = Math.round(canvas.clientWidth * ratio), height = Math.round(canvas.clientHeight * ratio);
  if (canvas.width !== width || canvas.height !== height) Object.assign(canvas, { width, height });
  context.reset();
  const number = numbers[view.index];
  const shown = { a: current("a", number), b: current("b", number) };
  const image = shown.a?.bitmap ?? shown.b?.bitmap;
  if (image) {
    context.imageSmoothingEnabled = scale(image, width, height) < 2; // from twice the size on, pixels are to be seen
    arrangements[view.mode](shown.a?.bitmap, shown.b?.bitmap, width, height);
  }
  describe(number, shown);
}

const drawn = { width: 1, height: 1 }; // of a picture, in pixels of the canvas

function scale(image, width, height) {
  return Math.min(width / image.width, height / image.height) * view.zoom;
}

/** Draw a picture into a part of the canvas, fitted, zoomed and panned. */
function place(image, left, width, height) {
  if (!image) return;
  const factor = scale(image, width, height);
  const w = image.width * factor, h = image.height * factor;
  Object.assign(drawn, { width: w, height: h });
  context.drawImage(image, left + (width - w) / 2 + view.x * w, (height - h) / 2 + view.y * h, w, h);
}

function clipped(left, right, height, work) {
  context.save();
  context.beginPath();
  context.rect(left, 0, right - left, height);
  context.clip();
  work();
  context.restore();
}

const arrangements = {
  wipe(a, b, width, height) {
    const at = Math.round(view.split * width);
    clipped(0, at, height, () => place(a, 0, width, height));
    clipped(at, width, height, () => place(b, 0, width, height));
  },
  pair(a, b, width, height) {
    const half = Math.floor(width / 2);
    clipped(0, half, height, () => place(a, 0, half, height));
    clipped(half, width, height, () => place(b, half, width - half, height));
  },
  flip(a, b, width, height) {
    place(view.flipped ? b : a, 0, width, height);
  },
  difference(a, b, width, height) {
    if (!a || !b) return;
    place(a, 0, width, height);
    context.globalCompositeOperation = "difference";
    place(b, 0, width, height);
    context.globalCompositeOperation = "lighter"; // a picture added to itself is twice as bright
    for (let i = 0; i < AMPLIFY; i++) context.drawImage(canvas, 0, 0);
    context.globalCompositeOperation = "source-over";
  },
};

function describe(number, shown) {
  const label = (side) => {
    const { sequence, layer } = sides[side];
    return `${state.sequences[sequence]?.name ?? ""} · ${layer}`;
  };
  const single = view.mode === "flip" ? (view.flipped ? "b" : "a") : null;
  $("#name-a").textContent = single === "b" ? "" : label("a");
  $("#name-b").textContent = single === "a" ? "" : label("b");
  $("#divider").hidden = view.mode !== "wipe";
  $("#divider").style.left = `${view.split * 100}%`;
  $("#divider").setAttribute("aria-valuenow", Math.round(view.split * 100));
  $("#number").textContent = number ?? "";
  const missing = ["a", "b"].filter((side) => single === null || side === single).map((side) => {
    if (number === undefined) return "no frames yet";
    if (shown[side] === null) return `frame ${number} of ${state.sequences[sides[side].sequence]?.name} is not there yet`;
    return shown[side].error;
  });
  $("#message").textContent = [...new Set(missing.filter(Boolean))].join("; ");
  const exact = (side) => pictures.get(address(side, number, "png"))?.bitmap;
  canvas.dataset.frame = number ?? "";
  canvas.dataset.exact = Boolean(exact("a") && exact("b"));
}

// --- time -------------------------------------------------------------------------------------------------

let playedUntil = 0; // when the frame that is shown has been shown long enough

function play(now) {
  if (!view.playing) return;
  const next = (view.index + 1) % numbers.length;
  for (let step = 1; step <= AHEAD; step++) {
    const number = numbers[(view.index + step) % numbers.length];
    for (const side of ["a", "b"]) picture(address(side, number, "jpg"));
  }
  const ready = ["a", "b"].every((side) => {
    const url = address(side, numbers[next], "jpg");
    return url === null || !pictures.get(url)?.pending;
  });
  if (now >= playedUntil && ready) {
    const span = 1000 / state.rate;
    // In step with the clock; after a wait for pictures it starts anew.
    playedUntil = now - playedUntil < span ? playedUntil + span : now + span;
    go(next);
  }
  requestAnimationFrame(play);
}

function setPlaying(on) {
  view.playing = on && numbers.length > 1;
  $("#play").textContent = view.playing ? "❚❚" : "▶";
  $("#play").setAttribute("aria-label", view.playing ? "Stop" : "Play");
  if (view.playing) requestAnimationFrame(play);
  else showFacts();
  draw();
}

function go(index) {
  view.index = Math.max(0, Math.min(index, numbers.length - 1));
  $("#scrub").value = view.index;
  $("#scrub").setAttribute("aria-valuetext", `frame ${numbers[view.index]}`);
  if (!view.playing) showFacts();
  draw();
}

function drawFinished() {
  const strip = $("#finished"), frames = state.sequences[0]?.frames ?? {};
  strip.width = strip.clientWidth;
  const paintbrush = strip.getContext("2d"), each = strip.width / numbers.length;
  const style = getComputedStyle(document.documentElement);
  numbers.forEach((number, index) => {
    paintbrush.fillStyle = style.getPropertyValue(number in frames ? "--mark" : "--line");
    paintbrush.fillRect(index * each, 0, Math.max(1, each - 1), strip.height);
  });
}

// --- what the server knows --------------------------------------------------------------------------------

let known = "";

async function poll() {
  let text;
  try {
    text = await (await fetch("state")).text();
  } catch {
    $("#message").textContent = "the server has ended";
    return;
  }
  if (text === known) return;
  const first = known === "";
  known = text;
  state = { ...JSON.parse(text), rate: first ? JSON.parse(text).rate : state.rate };
  const number = numbers[view.index];
  numbers = [...new Set(state.sequences.flatMap((sequence) => Object.keys(sequence.frames).map(Number)))].sort((a, b) => a - b);
  if (first) {
    sides.a.sequence = state.sequences.length > 1 ? 1 : 0;
    $("#rate").value = state.rate;
  }
  $("#scrub").max = Math.max(0, numbers.length - 1);
  fillSides();
  drawFinished();
  showRecord();
  const finished = Object.keys(state.sequences[0].frames).length;
  $("#count").textContent = `${finished} of ${numbers.length} frames are finished`;
  go(Math.max(0, numbers.indexOf(number)));
}

function fillSides() {
  for (const [name, side] of Object.entries(sides)) {
    const box = document.querySelector(`[data-side="${name}"]`);
    options(box.querySelector(".sequence"), state.sequences.map((sequence, index) => [index, sequence.name]), side.sequence);
    const { layers, layer } = state.sequences[side.sequence];
    if (!layers.includes(side.layer)) side.layer = layer;
    options(box.querySelector(".layer"), layers.map((each) => [each, each]), side.layer);
  }
}

function options(select, items, chosen) {
  select.replaceChildren(...items.map(([value, text]) => new Option(text, value, false, value === chosen)));
}

let factsOf = "";

async function showFacts() {
  const number = numbers[view.index], version = state.sequences[0]?.frames[number];
  if (factsOf === `${number} ${version}`) return;
  factsOf = `${number} ${version}`;
  let facts = { file: "not finished", made: {}, weights: {} };
  if (version !== undefined) {
    const answer = await fetch(`facts/0/${number}.json`);
    if (factsOf !== `${number} ${version}`) return; // another frame is shown by now
    if (answer.ok) facts = await answer.json();
  }
  pairs($("#frame-facts dl"), { file: facts.file, ...facts.made });
  const hint = version !== undefined && Object.keys(facts.weights).length === 0;
  $("#no-weights").hidden = !hint;
  $("#weights").replaceChildren(...Object.entries(facts.weights).map(([frame, weight]) => {
    const row = document.createElement("div"), meter = document.createElement("meter");
    meter.value = weight;
    row.append(element("span", frame), meter, element("span", weight.toFixed(3)));
    return row;
  }));
}

function showRecord() {
  const { stages = {}, plan = [], command, preset, estimate, asked = [], peak_bytes: peak } = state.sequences[0].record;
  $("#record").hidden = !command;
  pairs($("#record dl"), { command, preset, estimate, frames: asked.length, ...(peak && { memory: mebibytes(peak) }) });
  $("#record tbody").replaceChildren(...Object.entries(stages).map(([name, cost]) => {
    const row = document.createElement("tr");
    row.append(element("td", name), element("td", cost.seconds.toFixed(2)), element("td", mebibytes(cost.peak_bytes)));
    return row;
  }));
  $("#plan").replaceChildren(...plan.map((decision) => {
    const item = element("li", decision.stage);
    item.classList.toggle("on", decision.on);
    item.append(element("span", decision.reason));
    return item;
  }));
}

function pairs(list, facts) {
  const given = Object.entries(facts).filter(([, value]) => value !== undefined);
  list.replaceChildren(...given.flatMap(([name, value]) => [element("dt", name), element("dd", String(value))]));
}

function element(kind, text) {
  const made = document.createElement(kind);
  made.textContent = text; // names come from files: never as markup
  return made;
}

const mebibytes = (bytes) => `${Math.round(bytes / 2 ** 20)} MiB`;

// --- controls ---------------------------------------------------------------------------------------------

function setMode(mode) {
  if (mode === "flip" && view.mode === "flip") view.flipped = !view.flipped;
  view.mode = mode;
  document.querySelector(`#modes [value="${mode}"]`).checked = true;
  draw();
}

function setExposure(ev) {
  view.ev = Math.max(-6, Math.min(6, ev));
  $("#ev").value = view.ev;
  $("#ev-text").textContent = `${view.ev > 0 ? "+" : ""}${view.ev} EV`;
  draw();
}

/** Zoom; what is at a place of the canvas, given from the middle of the picture's part of it, stays there. */
function setZoom(zoom, atX = 0, atY = 0) {
  const factor = Math.max(1, Math.min(32, zoom)) / view.zoom;
  view.zoom *= factor;
  view.x = view.zoom === 1 ? 0 : view.x + (atX / drawn.width) * (1 / factor - 1);
  view.y = view.zoom === 1 ? 0 : view.y + (atY / drawn.height) * (1 / factor - 1);
  draw();
}

function swap() {
  [sides.a, sides.b] = [sides.b, sides.a];
  fillSides();
  draw();
}

for (const [name, side] of Object.entries(sides)) {
  const box = document.querySelector(`[data-side="${name}"]`);
  box.querySelector(".sequence").addEventListener("change", (event) => {
    sides[name].sequence = Number(event.target.value);
    sides[name].layer = state.sequences[sides[name].sequence].layer;
    fillSides();
    draw();
  });
  box.querySelector(".layer").addEventListener("change", (event) => {
    sides[name].layer = event.target.value;
    draw();
  });
}
$("#swap").addEventListener("click", swap);
$("#modes").addEventListener("change", (event) => setMode(event.target.value));
$("#ev").addEventListener("input", (event) => setExposure(Number(event.target.value)));
$("#play").addEventListener("click", () => setPlaying(!view.playing));
$("#scrub").addEventListener("input", (event) => go(Number(event.target.value)));
$("#rate").addEventListener("change", (event) => {
  if (event.target.value > 0) state.rate = Number(event.target.value);
});
canvas.addEventListener("wheel", (event) => {
  event.preventDefault();
  const ratio = canvas.width / canvas.clientWidth, part = canvas.width / (view.mode === "pair" ? 2 : 1);
  const x = ((event.offsetX * ratio) % part) - part / 2, y = event.offsetY * ratio - canvas.height / 2;
  setZoom(view.zoom * 1.2 ** -Math.sign(event.deltaY), x, y);
}, { passive: false });
drag(canvas, (event) => {
  if (view.zoom === 1) return;
  const ratio = canvas.width / canvas.clientWidth;
  view.x += (event.movementX * ratio) / drawn.width;
  view.y += (event.movementY * ratio) / drawn.height;
  draw();
});
drag($("#divider"), (event) => {
  const box = canvas.getBoundingClientRect();
  setSplit((event.clientX - box.x) / box.width);
});
$("#divider").addEventListener("keydown", (event) => {
  const step = { ArrowLeft: -0.02, ArrowRight: 0.02 }[event.key];
  if (!step) return;
  event.stopPropagation();
  setSplit(view.split + step);
});

function setSplit(split) {
  view.split = Math.max(0, Math.min(1, split));
  draw();
}

function drag(target, move) {
  target.addEventListener("pointerdown", (event) => target.setPointerCapture(event.pointerId));
  target.addEventListener("pointermove", (event) => {
    if (target.hasPointerCapture(event.pointerId)) move(event);
  });
}

const keys = {
  " ": () => setPlaying(!view.playing),
  ArrowLeft: () => go(view.index - 1),
  ArrowRight: () => go(view.index + 1),
  w: () => setMode("wipe"),
  s: () => setMode("pair"),
  f: () => setMode("flip"),
  d: () => setMode("difference"),
  x: swap,
  "[": () => setExposure(view.ev - 0.25),
  "]": () => setExposure(view.ev + 0.25),
  "+": () => setZoom(view.zoom * 1.5),
  "-": () => setZoom(view.zoom / 1.5),
  0: () => setZoom(1),
};
addEventListener("keydown", (event) => {
  const typing = event.target.matches("select, input:not([type=radio])") || event.ctrlKey || event.metaKey || event.altKey;
  const action = keys[event.key.length === 1 ? event.key.toLowerCase() : event.key];
  if (typing || !action || (event.key === " " && event.target.matches("button"))) return;
  event.preventDefault();
  action();
});
new ResizeObserver(() => { draw(); drawFinished(); }).observe($("#stage"));

setExposure(0);
poll();
setInterval(poll, POLL_MS);
