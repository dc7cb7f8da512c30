// What was measured, and figures as text.

const report = JSON.parse(find("data").textContent);
const results = new Map(report.results.map((result) => [result.name, result]));
const metrics = new Map(report.metrics.map((metric) => [metric.key, metric]));

function figureText(value, metric) {
  const number = Number(value);
  if (Number.isNaN(number)) return "–";
  if (!Number.isFinite(number)) return number > 0 ? "∞" : "−∞";
  const text = metric.logarithmic ? String(rounded(number, 3)) : number.toFixed(metric.digits);
  return text.replace("-", "−") + (metric.unit ? " " + metric.unit : "");
}

function secondsText(value) {
  if (value === null) return "unknown";
  return value === 0 ? "nothing" : rounded(value, 3) + " s";
}

function memoryText(value) {
  if (value === null) return "unknown";
  return value < 2 ** 30 ? (value / 2 ** 20).toFixed(0) + " MiB" : (value / 2 ** 30).toFixed(2) + " GiB";
}

// A method's mean by a measure, with its unit; empty where it was not measured.
function meanText(name, key) {
  const statistic = results.get(name)?.metrics[key];
  return metrics.has(key) && statistic ? figureText(statistic.mean, metrics.get(key)) : "";
}
