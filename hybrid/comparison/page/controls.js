// The viewer's controls: they show its state, and change it by pointer, wheel, keys and the buttons beside it.

function startViewer(info) {
  const viewer = new Viewer(info);
  fillControls(viewer);
  listenToControls(viewer);
  listenToPointer(viewer);
  listenToDivider(viewer);
  listenToKeys(viewer);
  find("viewer").hidden = false;
  const still = viewer.pictures.frames.length < 2;
  find("time").hidden = still;
  document.querySelector(".transport").hidden = still;
  new ResizeObserver(() => viewer.draw()).observe(find("stage").parentElement);
  viewer.update({ row: viewer.state.row });
  return viewer;
}

function fillControls({ pictures, sources, state }) {
  for (const id of ["left", "right"]) find(id).append(...sources.map((source, i) => new Option(source.label, i)));
  const maps = [...new Set(sources.flatMap((source) => source.maps))];
  find("view").append(new Option("Picture", "picture"), new Option("Error", "error"),
    ...maps.map((title) => new Option(title, title)));
  Object.assign(find("ev"), { min: state.ev - 6, max: state.ev + 6 });
  find("frame").max = pictures.frames.length - 1;
  find("row").max = pictures.height - 1;
  find("extent").textContent = pictures.extent + ".";
}

function showState({ state, sources, pictures }, scale) {
  const left = sources[state.left].label, right = sources[state.right].label;
  const percent = Math.round(100 * state.split), divider = find("divider");
  divider.hidden = state.layout !== "slider";
  divider.style.left = 100 * state.split + "%";
  divider.setAttribute("aria-valuenow", percent);
  divider.setAttribute("aria-valuetext", `${percent} percent ${left}, the rest ${right}`);
  for (const id of ["left", "right", "frame", "ev", "row"]) find(id).value = state[id];
  find("magnify").checked = state.magnify;
  find("frame-text").textContent = `frame ${pictures.frames[state.frame]}`;
  find("ev-text").textContent = `${state.ev < 0 ? "−" : "+"}${Math.abs(state.ev).toFixed(2)} EV`;
  find("zoom-text").textContent = `${rounded(scale, 2)}×`;
  find("row-text").textContent = pictures.origin[1] + state.row;
  find("canvas").setAttribute("aria-label", `Frame ${pictures.frames[state.frame]}, `
    + `${find("view").selectedOptions[0].textContent}: `
    + (state.layout === "all" ? "all methods" : `${left} left, ${right} right`));
}

function showPlaying(on) {
  const button = find("play");
  button.textContent = on ? "❚❚" : "▶";
  button.setAttribute("aria-label", on ? "Stop" : "Play");
  button.setAttribute("aria-pressed", on);
}

function showScale(view) {
  const scale = find("scale"), [low, bar, high] = scale.children;
  scale.hidden = view === "picture";
  bar.style.background = `linear-gradient(90deg, ${scaleOfView(view).stops.join(", ")})`;
  low.textContent = scaleOfView(view) === GRAYS ? "darker" : "0";
  high.textContent = scaleOfView(view) === GRAYS ? "brighter" : view === "error" ? `≥ ${ERROR_RANGE} of T` : "1";
}

function listenToControls(viewer) {
  const listen = (id, kind, action) => find(id).addEventListener(kind, (event) => action(event.target.value));
  for (const id of ["left", "right"]) listen(id, "change", (value) => viewer.update({ [id]: Number(value) }));
  listen("view", "change", (view) => { showScale(view); viewer.update({ view }); });
  for (const radio of document.querySelectorAll("[name=layout]")) {
    radio.addEventListener("change", () => viewer.arrange(radio.value));
  }
  find("magnify").addEventListener("change", (event) => viewer.update({ magnify: event.target.checked }));
  listen("swap", "click", () => viewer.swap());
  listen("zoom-in", "click", () => viewer.zoom(1.5));
  listen("zoom-out", "click", () => viewer.zoom(1 / 1.5));
  listen("zoom-fit", "click", () => viewer.update({ zoom: 1 }));
  listen("ev", "input", (value) => viewer.expose(Number(value)));
  listen("frame", "input", (value) => viewer.update({ frame: Number(value) }));
  listen("row", "input", (value) => viewer.setRow(Number(value)));
  listen("play", "click", () => viewer.play(!viewer.state.playing));
}

// Drag to pan, double-click to zoom in, click to choose among all; the wheel zooms.
function listenToPointer(viewer) {
  const { stage, state } = viewer, { canvas } = stage;
  let drag = null;
  canvas.addEventListener("pointerdown", (event) => {
    canvas.setPointerCapture(event.pointerId);
    drag = { px: event.clientX, py: event.clientY, x: state.x, y: state.y, moved: false };
  });
  canvas.addEventListener("pointermove", (event) => {
    const at = stage.under(event);
    if (drag) {
      const scale = stage.scaleOf(at.pane), dx = event.clientX - drag.px, dy = event.clientY - drag.py;
      drag.moved ||= Math.hypot(dx, dy) > 3;
      viewer.update({ x: drag.x - dx / scale, y: drag.y - dy / scale });
    } else if (state.magnify) {
      viewer.update({ at });
    }
    viewer.readOut(at.x, at.y);
  });
  canvas.addEventListener("pointerleave", () => { if (state.magnify) viewer.update({ at: null }); });
  canvas.addEventListener("pointerup", (event) => {
    if (drag && !drag.moved && state.layout === "all") viewer.update({ right: stage.under(event).pane.source });
    drag = null;
  });
  canvas.addEventListener("pointercancel", () => { drag = null; });
  canvas.addEventListener("dblclick", (event) => {
    const at = stage.under(event);
    if (state.zoom < 60) viewer.zoom(2, at);
    viewer.setRow(Math.floor(at.y));
  });
  canvas.addEventListener("wheel", (event) => {
    if (document.activeElement !== canvas && !event.ctrlKey) return; // or the page could not be scrolled
    event.preventDefault();
    viewer.zoom(Math.exp(-event.deltaY * (event.deltaMode ? 0.05 : 0.002)), stage.under(event));
  }, { passive: false });
}

function listenToDivider(viewer) {
  const divider = find("divider"), { state } = viewer;
  divider.addEventListener("pointerdown", (event) => {
    divider.setPointerCapture(event.pointerId);
    divider.focus({ focusVisible: false });
    event.preventDefault();
  });
  divider.addEventListener("pointermove", (event) => {
    if (!divider.hasPointerCapture(event.pointerId)) return;
    const box = find("stage").getBoundingClientRect();
    viewer.update({ split: clamp((event.clientX - box.left) / box.width, 0, 1) });
  });
  divider.addEventListener("keydown", (event) => {
    const step = event.shiftKey ? 0.1 : 0.02;
    const goal = {
      ArrowLeft: state.split - step, ArrowDown: state.split - step, ArrowRight: state.split + step,
      ArrowUp: state.split + step, PageDown: state.split - 0.1, PageUp: state.split + 0.1, Home: 0, End: 1,
    }[event.key];
    if (goal === undefined) return;
    event.preventDefault();
    viewer.update({ split: clamp(goal, 0, 1) });
  });
}

function listenToKeys(viewer) {
  const { state, sources, pictures, stage } = viewer;
  const actions = {
    "+": () => viewer.zoom(1.5), "=": () => viewer.zoom(1.5), "-": () => viewer.zoom(1 / 1.5),
    "0": () => viewer.update({ zoom: 1 }),
    ",": () => viewer.step(-1), ".": () => viewer.step(1), " ": () => viewer.play(!state.playing),
    "[": () => viewer.expose(state.ev - 0.5), "]": () => viewer.expose(state.ev + 0.5),
    m: () => viewer.update({ magnify: !state.magnify }), M: () => viewer.update({ magnify: !state.magnify }),
    x: () => viewer.swap(), X: () => viewer.swap(),
  };
  for (let i = 0; i < Math.min(sources.length, 9); i++) actions[i + 1] = () => viewer.update({ right: i });
  const pan = (dx, dy) => {
    const reach = 0.1 * pictures.width / state.zoom;
    viewer.update({ x: state.x + dx * reach, y: state.y + dy * reach });
    viewer.readOut(state.x, state.y);
  };
  const pans = {
    ArrowLeft: () => pan(-1, 0), ArrowRight: () => pan(1, 0), ArrowUp: () => pan(0, -1), ArrowDown: () => pan(0, 1),
  };
  find("viewer").addEventListener("keydown", (event) => {
    const { tagName } = event.target;
    if (event.ctrlKey || event.metaKey || event.altKey || /^(SELECT|SUMMARY)$/.test(tagName)) return;
    if (event.key === " " && /^(INPUT|BUTTON)$/.test(tagName)) return; // which a space presses
    const action = (event.target === stage.canvas && pans[event.key]) || actions[event.key];
    if (!action) return;
    event.preventDefault();
    action();
  });
}
