// What every part of the page uses: what was measured, elements, and figures as text.

const report = JSON.parse(find("data").textContent);
const results = new Map(report.results.map((result) => [result.name, result]));
const metrics = new Map(report.metrics.map((metric) => [metric.key, metric]));

function find(id) {
  return document.getElementById(id);
}

function make(tag, text = "", kind = "") {
  const element = document.createElement(tag);
  element.textContent = text;
  if (kind) element.className = kind;
  return element;
}

function makeCanvas(width, height) {
  const canvas = document.createElement("canvas");
  canvas.width = width;
  canvas.height = height;
  return canvas;
}

function clamp(x, low, high) {
  return Math.min(Math.max(x, low), high);
}

// A number with so many significant digits, and without zeros at its end.
function rounded(value, digits) {
  return Number(Number(value).toPrecision(digits));
}

function figureText(value, metric) {
  const number = Number(value);
  if (Number.isNaN(number)) return "–";
  if (!Number.isFinite(number)) return number > 0 ? "∞" : "−∞";
  const text = metric.logarithmic ? String(rounded(number, 3)) : number.toFixed(metric.digits);
  return text.replace("-", "−") + (metric.unit ? " " + metric.unit : "");
}

function secondsText(value) {
  if (value === null) return "not known";
  return value === 0 ? "nothing" : rounded(value, 3) + " s";
}

function memoryText(value) {
  if (value === null) return "not known";
  return value < 2 ** 30 ? (value / 2 ** 20).toFixed(0) + " MiB" : (value / 2 ** 30).toFixed(2) + " GiB";
}

// A method's mean by a measure, with its unit; empty where it was not measured.
function meanText(name, key) {
  const statistic = results.get(name)?.metrics[key];
  return metrics.has(key) && statistic ? figureText(statistic.mean, metrics.get(key)) : "";
}
