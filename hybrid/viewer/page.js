// The page of `ravg view`: shows the sequences of the server, and polls it while frames are still being written.

const POLL_MS = 2000;
const CACHE_BYTES = 512e6; // of decoded pictures
const AHEAD = 6; // frames that are loaded before they are played

const $ = (selector) => document.querySelector(selector);

// A source of the player, which chooses { sequence, layer, ev, view } for each side; `ev` adds to that of the player.
class Frames {
  constructor() {
    this.sequences = [];
    this.frames = []; // numbers of the frames that any sequence has, ascending
    this.pictures = new Map(); // address → { bitmap, error, pending }, the last used one at the end
    this.shape = { width: 16, height: 9 }; // of the picture that was shown last
  }

  size() {
    return this.shape;
  }

  label({ sequence, layer, ev, view }) {
    const shown = [...(view === "filmic" ? ["filmic"] : []), ...(ev ? [`${ev > 0 ? "+" : "−"}${Math.abs(ev)} EV`] : [])];
    return [[this.sequences[sequence]?.name ?? "", layer, ...shown].join(" · ")];
  }

  // null where the sequence has no such frame.
  address({ sequence, layer, ev: own, view }, index, { ev }, kind) {
    const number = this.frames[index], version = this.sequences[sequence]?.frames[number];
    if (version === undefined || !layer) return null;
    return `frame/${sequence}/${number}.${kind}?layer=${encodeURIComponent(layer)}&ev=${ev + own}&view=${view}&version=${version}`;
  }

  // The picture of an address, loaded if it is not in the cache.
  entry(url) {
    if (url === null) return null;
    const entry = this.pictures.get(url) ?? { bitmap: null, error: "", pending: this.load(url) };
    this.pictures.delete(url);
    this.pictures.set(url, entry);
    return entry;
  }

  async load(url) {
    let bitmap = null, error = "";
    try {
      const answer = await fetch(url);
      if (answer.ok) bitmap = await createImageBitmap(await answer.blob());
      else error = await answer.text();
    } catch (failure) {
      error = String(failure);
    }
    const entry = this.pictures.get(url);
    if (!entry) return bitmap?.close();
    Object.assign(entry, { bitmap, error, pending: null });
    this.limitCache();
    player.draw();
  }

  limitCache() {
    const bytes = ({ bitmap }) => (bitmap ? bitmap.width * bitmap.height * 4 : 0);
    let sum = [...this.pictures.values()].reduce((total, entry) => total + bytes(entry), 0);
    for (const [url, entry] of this.pictures) {
      if (sum <= CACHE_BYTES) break;
      sum -= bytes(entry);
      entry.bitmap?.close();
      this.pictures.delete(url);
    }
  }

  // The picture to show now: exact while the frame stands still, fast while it plays.
  current(source, state) {
    const fast = this.pictures.get(this.address(source, state.frame, state, "jpg"));
    if (state.playing) return fast ?? this.entry(this.address(source, state.frame, state, "jpg"));
    const exact = this.entry(this.address(source, state.frame, state, "png"));
    return exact === null || exact.bitmap || exact.error || !fast?.bitmap ? exact : fast;
  }

  image(source, state) {
    const bitmap = this.current(source, state)?.bitmap;
    if (bitmap) this.shape = { width: bitmap.width, height: bitmap.height };
    return bitmap;
  }

  isExact(source, state) {
    return Boolean(this.pictures.get(this.address(source, state.frame, state, "png"))?.bitmap);
  }

  prefetch(state) {
    for (let ahead = 1; ahead <= AHEAD; ahead++) {
      const index = (state.frame + ahead) % this.frames.length;
      for (const side of [state.left, state.right]) this.entry(this.address(side, index, state, "jpg"));
    }
  }

  // Whether the next frame can be played.
  ready(state) {
    const next = (state.frame + 1) % this.frames.length;
    return [state.left, state.right].every((side) => !this.pictures.get(this.address(side, next, state, "jpg"))?.pending);
  }
}

class ViewPlayer extends Player {
  tall() {
    return this.stage.clientHeight;
  }

  draw() {
    this.canvas.dataset.exact = false; // until the requested pictures are drawn
    return super.draw();
  }

  arrange(layout) {
    const flipped = layout === "flicker" && this.state.layout === "flicker" && !this.state.flipped;
    return this.update({ layout, flipped });
  }

  showState(panes) {
    super.showState(panes);
    const { state, source } = this, number = source.frames[state.frame], { left, right } = state;
    const sides = state.layout === "flicker" ? [state.flipped ? right : left] : [left, right];
    const missing = sides.map((side) => {
      if (number === undefined) return "no frames yet";
      const picture = source.current(side, state);
      return picture === null ? `frame ${number} of ${source.sequences[side.sequence]?.name} does not exist yet` : picture.error;
    });
    const errors = source.sequences.map(({ error }) => error);
    $("#message").textContent = [...new Set([...missing, ...errors].filter(Boolean))].join("; ");
    this.canvas.dataset.frame = number ?? "";
    this.canvas.dataset.exact = [left, right].every((side) => source.isExact(side, state));
    if (!state.playing) showFacts();
    if (pointer) readOut(pointer);
  }
}

let pointer = null; // the latest event of the pointer over the picture
const source = new Frames();
const side = { sequence: 0, layer: "", ev: 0, view: "srgb" };
const player = new ViewPlayer(source, { flipMs: 0, state: { left: side, right: side } });

// --- what the server sends --------------------------------------------------------------------------------

let last = "";

async function poll() {
  let text;
  try {
    const answer = await fetch("state");
    text = await answer.text();
    if (!answer.ok) return void ($("#message").textContent = text);
  } catch {
    $("#message").textContent = "the server has ended";
    return;
  }
  if (text === last) return;
  const first = last === "", { rate, sequences } = JSON.parse(text), number = source.frames[player.state.frame];
  last = text;
  source.sequences = sequences;
  source.frames = [...new Set(sequences.flatMap(({ frames }) => Object.keys(frames).map(Number)))].sort((a, b) => a - b);
  const { left, right } = player.state;
  if (first) $("#rate").value = rate;
  const sides = [first ? { ...left, sequence: sequences.length > 1 ? 1 : 0 } : left, right].map(withLayer);
  drawFinished();
  showRecord();
  $("#count").textContent = `${Object.keys(sequences[0].frames).length} of ${source.frames.length} frames are finished`;
  choose({ left: sides[0], right: sides[1], frame: Math.max(0, source.frames.indexOf(number)) });
}

// The side with a layer that its sequence has.
function withLayer(side) {
  const { layers, layer: first } = source.sequences[side.sequence];
  return { ...side, layer: layers.includes(side.layer) ? side.layer : first };
}

function choose(change) {
  player.update(change);
  for (const name of ["left", "right"]) {
    const { sequence, layer, ev, view } = player.state[name], box = $(`[data-side="${name}"]`);
    fill(box.querySelector(".sequence"), source.sequences.map((each, index) => [index, each.name]), sequence);
    fill(box.querySelector(".layer"), source.sequences[sequence].layers.map((each) => [each, each]), layer);
    box.querySelector(".ev").value = ev;
    box.querySelector(".view").value = view;
  }
}

function fill(select, items, chosen) {
  select.replaceChildren(...items.map(([value, text]) => new Option(text, value, false, value === chosen)));
}

function drawFinished() {
  const strip = $("#finished"), frames = source.sequences[0]?.frames ?? {}, { frames: numbers } = source;
  strip.width = strip.clientWidth;
  const context = strip.getContext("2d"), each = strip.width / numbers.length;
  const style = getComputedStyle(document.documentElement);
  numbers.forEach((number, index) => {
    context.fillStyle = style.getPropertyValue(number in frames ? "--mark" : "--line");
    context.fillRect(index * each, 0, Math.max(1, each - 1), strip.height);
  });
}

let factsOf = "";

async function showFacts() {
  const number = source.frames[player.state.frame], version = source.sequences[0]?.frames[number];
  const asked = `${number} ${version}`;
  if (factsOf === asked) return;
  factsOf = asked;
  let facts = { file: "not finished", made: {}, weights: {} };
  if (version !== undefined) {
    const answer = await fetch(`facts/0/${number}.json`);
    if (factsOf !== asked) return; // another frame is shown by now
    if (answer.ok) facts = await answer.json();
  }
  showPairs($("#frame-facts dl"), { file: facts.file, ...facts.made });
  $("#no-weights").hidden = version === undefined || Object.keys(facts.weights).length > 0;
  $("#weights").replaceChildren(...Object.entries(facts.weights).map(([frame, value]) => {
    const row = make("div"), meter = Object.assign(make("meter"), { value });
    row.append(make("span", frame), meter, make("span", value.toFixed(3)));
    return row;
  }));
}

function showRecord() {
  const { stages = {}, plan = [], command, preset, first_pass, asked = [], peak_bytes: peak } = source.sequences[0].record;
  $("#record").hidden = !command;
  showPairs($("#record dl"), { command, preset, "first pass": first_pass, frames: asked.length, ...(peak && { memory: mebibytes(peak) }) });
  $("#record tbody").replaceChildren(...Object.entries(stages).map(([name, cost]) => {
    const row = make("tr");
    row.append(make("td", name), make("td", cost.seconds.toFixed(2)), make("td", mebibytes(cost.peak_bytes)));
    return row;
  }));
  $("#plan").replaceChildren(...plan.map((decision) => {
    const item = make("li", decision.stage, decision.on ? "on" : "");
    item.append(make("span", decision.reason));
    return item;
  }));
}

function showPairs(list, facts) {
  const given = Object.entries(facts).filter(([, value]) => value !== undefined);
  list.replaceChildren(...given.flatMap(([name, value]) => [make("dt", name), make("dd", String(value))]));
}

function mebibytes(bytes) {
  return `${Math.round(bytes / 2 ** 20)} MiB`;
}

// The values of the pixel under the pointer, of both sides; the answer to the latest place counts.
let pointed = 0;

async function readOut(event) {
  pointer = event;
  const { x, y } = player.under(event), { width, height } = source.size(), mine = ++pointed;
  const at = [Math.floor(x * width), Math.floor(y * height)], number = source.frames[player.state.frame];
  if (x < 0 || y < 0 || x >= 1 || y >= 1 || number === undefined || player.state.playing) return;
  const lines = await Promise.all([player.state.left, player.state.right].map(async ({ sequence, layer }) => {
    const query = `layer=${encodeURIComponent(layer)}&x=${at[0]}&y=${at[1]}`;
    const answer = await fetch(`values/${sequence}/${number}.json?${query}`);
    const values = answer.ok ? Object.entries(await answer.json()) : [];
    const texts = values.map(([name, value]) => `${name} ${value === null ? "not finite" : rounded(value, 4)}`);
    return `${source.sequences[sequence].name}: ${texts.join("  ") || "–"}`;
  }));
  if (mine === pointed) $("#readout").textContent = [`(${at.join(", ")})`, ...new Set(lines)].join("\n");
}

// --- controls ---------------------------------------------------------------------------------------------

for (const name of ["left", "right"]) {
  const box = $(`[data-side="${name}"]`);
  box.querySelector(".sequence").addEventListener("change", ({ target }) => {
    choose({ [name]: withLayer({ ...player.state[name], sequence: Number(target.value), layer: "" }) });
  });
  for (const field of ["layer", "ev", "view"]) {
    box.querySelector(`.${field}`).addEventListener("change", ({ target }) => {
      const value = field === "ev" ? clamp(target.valueAsNumber || 0, -12, 12) : target.value;
      choose({ [name]: { ...player.state[name], [field]: value } });
    });
  }
}
player.swap = () => choose({ left: player.state.right, right: player.state.left });
Object.assign(player.keys, {
  ArrowLeft: () => player.step(-1), ArrowRight: () => player.step(1), "[": () => player.expose(player.state.ev - 0.25),
  "]": () => player.expose(player.state.ev + 0.25), w: () => player.arrange("slider"), s: () => player.arrange("pair"),
  f: () => player.arrange("flicker"), d: () => player.arrange("difference"),
});
player.listen();
player.listenToKeys(document);
player.canvas.addEventListener("pointermove", readOut);
new ResizeObserver(drawFinished).observe($("#time"));

poll();
setInterval(poll, POLL_MS);
