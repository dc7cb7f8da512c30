// The charts: axes and families are chosen; points show their figures, and send their method to the viewer.
// Groups of chart i are named chart{i}-point-{j}, -bar-{j} and -name-{j} for result j.

function startChart(viewer) {
  if (!find("plots")) return;
  for (const point of document.querySelectorAll('.plot [id*="-point-"]')) listenToPoint(point, viewer);
  for (const box of document.querySelectorAll(".legend input")) {
    box.addEventListener("change", () => showFamily(box.dataset.name, box.checked));
  }
  find("axis-up").addEventListener("change", chooseAxes);
  find("axis-over").addEventListener("change", chooseAxes);
  chooseAxes();
}

function chooseAxes() {
  const axes = find("axis-up").value + " " + find("axis-over").value;
  for (const plot of document.querySelectorAll(".plot")) plot.hidden = plot.dataset.axes !== axes;
  hideTip();
  takeTabStop();
}

// The result of a point, bar or name.
function resultOf(element) {
  return report.results[Number(element.id.split("-").at(-1))];
}

function showFamily(name, visible) {
  for (const mark of document.querySelectorAll('.plot :is([id*="-point-"], [id*="-bar-"], [id*="-name-"])')) {
    if (resultOf(mark).family === name) mark.classList.toggle("off", !visible);
  }
  takeTabStop();
}

function shownPlot() {
  return document.querySelector(".plot:not([hidden])");
}

// The visible points from left to right.
function visiblePoints() {
  const left = (point) => point.getBoundingClientRect().left;
  return [...shownPlot().querySelectorAll('[id*="-point-"]:not(.off)')].sort((a, b) => left(a) - left(b));
}

// One point at a time is in the order of the Tab key; the arrows go from one to the next.
function takeTabStop(point = visiblePoints()[0]) {
  for (const each of shownPlot().querySelectorAll('[id*="-point-"]')) each.setAttribute("tabindex", each === point ? 0 : -1);
}

function listenToPoint(point, viewer) {
  const { name, seconds_per_megapixel: seconds } = resultOf(point), choose = () => viewer?.choose(name);
  point.setAttribute("role", "button");
  point.setAttribute("aria-label", `${name}: ${meanText(name, report.chart[0])}, ${secondsText(seconds)} per megapixel`);
  point.addEventListener("pointerenter", () => showTip(point, viewer));
  point.addEventListener("pointerleave", hideTip);
  point.addEventListener("focus", () => { takeTabStop(point); showTip(point, viewer); });
  point.addEventListener("blur", hideTip);
  point.addEventListener("click", choose);
  point.addEventListener("keydown", (event) => {
    const goal = neighbourByKey(point, event.key);
    if (goal) goal.focus();
    else if (event.key === "Escape") hideTip();
    else if (viewer && (event.key === "Enter" || event.key === " ")) choose();
    else return;
    event.preventDefault();
  });
}

// The point that a key leads to, if any.
function neighbourByKey(point, key) {
  const all = visiblePoints(), last = all.length - 1;
  const step = { ArrowRight: 1, ArrowUp: 1, ArrowLeft: -1, ArrowDown: -1 }[key];
  return step ? all[clamp(all.indexOf(point) + step, 0, last)] : { Home: all[0], End: all[last] }[key];
}

function hideTip() {
  find("tip").hidden = true;
}

function showTip(point, viewer) {
  const tip = find("tip"), result = resultOf(point);
  tip.dataset.name = result.name;
  tip.replaceChildren(make("strong", result.name), tipList(result));
  if (viewer?.has(result.name)) {
    tip.append(make("p", "Click or Enter: show it in the viewer, on the right."));
    viewer.thumbnail(result.name).then((canvas) => {
      if (tip.dataset.name === result.name) tip.prepend(canvas); // or another point was faster
    });
  }
  tip.hidden = false;
  placeTip(tip, point);
}

// Accuracy, cost and settings of a method.
function tipList(result) {
  const list = make("dl");
  const row = (term, value) => list.append(make("dt", term), make("dd", value));
  for (const key of Object.keys(result.metrics)) {
    if (report.chart.includes(key)) row(metrics.get(key).label, meanText(result.name, key));
  }
  const spread = result.spread ? ` (${result.spread.map((seconds) => rounded(seconds, 3)).join("–")})` : "";
  row("per megapixel", secondsText(result.seconds_per_megapixel) + spread);
  row("of CPU time", secondsText(result.cpu_seconds_per_megapixel));
  row("peak memory", memoryText(result.peak_bytes));
  if (result.worth !== null) row("worth", rounded(result.worth, 2) + "× the samples");
  for (const [name, value] of Object.entries(result.settings)) row(name, value);
  return list;
}

// Next to the point, on the side where there is space.
function placeTip(tip, point) {
  const box = find("plots").getBoundingClientRect(), at = point.getBoundingClientRect();
  const x = at.left + at.width / 2 - box.left, y = at.top + at.height / 2 - box.top;
  const left = x + 20 + tip.offsetWidth < box.width ? x + 20 : x - 20 - tip.offsetWidth;
  tip.style.left = Math.max(0, left) + "px";
  tip.style.top = Math.max(-40, y - 60) + "px";
}
