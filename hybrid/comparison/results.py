"""Results of a comparison: methods, measures, best and ties, Pareto fronts, and JSON."""

import json
import math
from collections.abc import Mapping, Sequence
from dataclasses import asdict, dataclass, field, replace
from pathlib import Path
from typing import Any, Literal

import numpy as np

from hybrid.comparison.metrics import bootstrap_interval, mean_over_shots

Cost = Literal["seconds_per_megapixel", "cpu_seconds_per_megapixel", "peak_bytes"]
COSTS: dict[Cost, str] = {
    "seconds_per_megapixel": "seconds per megapixel-frame",
    "cpu_seconds_per_megapixel": "CPU seconds per megapixel-frame",
    "peak_bytes": "peak memory",
}


@dataclass(frozen=True)
class Statistic:
    """One measure over the frames of one or more shots: mean, range, and 95 % interval (`low`, `high`) of the mean."""

    mean: float
    minimum: float
    maximum: float
    low: float
    high: float
    values: tuple[float, ...] = ()  # per frame, where known: ties are then decided by paired differences
    shots: tuple[int, ...] = ()  # number of values of each shot, if there are several shots


@dataclass(frozen=True)
class Metric:
    key: str
    label: str
    unit: str = ""
    digits: int = 2
    better: Literal["higher", "lower", "zero"] = "higher"
    logarithmic: bool = False  # axis of the chart; printed with three significant digits


@dataclass(frozen=True)
class MethodResult:
    """Accuracy and cost of one method on a shot."""

    name: str
    settings: Mapping[str, object] = field(default_factory=dict)
    family: str = "Methods"  # methods of one family share color and marker on the chart
    # median of the runs; 0 for frames that existed before, None where unknown
    seconds_per_megapixel: float | None = None
    spread: tuple[float, float] | None = None  # least and greatest seconds per megapixel of repeated runs
    cpu_seconds_per_megapixel: float | None = None
    peak_bytes: int | None = None  # None where unknown
    metrics: Mapping[str, Statistic] = field(default_factory=dict)  # by `Metric.key`
    worth: float | None = None  # the noisy render would need this many times its samples for the same error
    absent_reason: str | None = None  # why a requested method has no measurements


Curve = Sequence[tuple[float, float]]  # (samples per pixel, error), by rising samples
Ladder = Mapping[str, Mapping[str, Curve]]  # curves by `Metric.key` and name of the method


@dataclass(frozen=True)
class Comparison:
    """Results of all methods on one shot, and facts on how they were measured."""

    shot: str
    results: tuple[MethodResult, ...]
    facts: Mapping[str, str] = field(default_factory=dict)
    ladder: Ladder = field(default_factory=dict)  # of renders at several samples per pixel
    frames: tuple[int, ...] = ()  # numbers of the frames that were measured, where there is one shot


# Their definitions are in page/definitions.html.
METRICS: tuple[Metric, ...] = (
    Metric("psnr", "PSNR", unit="dB"),
    Metric("temporal_psnr", "Temporal PSNR", unit="dB"),
    Metric("ssim", "SSIM", digits=4),
    Metric("relmse", "relMSE", better="lower", logarithmic=True),
    Metric("relmse_trimmed", "relMSE, trimmed", better="lower", logarithmic=True),
    Metric("smape", "SMAPE", digits=4, better="lower"),
    Metric("flip", "FLIP", digits=4, better="lower"),
    Metric("mean_bias", "Bias", digits=4, better="zero"),
)
INPUT_FAMILY = "Input"
OTHER_FAMILIES = ("OIDN", "External")  # denoisers of others
MARKDOWN_METRICS = ("psnr", "temporal_psnr")  # the columns of the README's table
CHART_METRICS = ("psnr", "temporal_psnr", "relmse", "flip")  # in the order of the chart's menu


def summarize(values: Sequence[float], shots: Sequence[int] = ()) -> Statistic:
    """Summarize values, one per frame: mean over the shots' means, range, and 95 % bootstrap interval of the mean."""
    data = np.asarray(values, np.float64)
    low, high = bootstrap_interval(data, shots=shots)
    mean, frames = mean_over_shots(data, shots), tuple(float(v) for v in data)
    return Statistic(mean, float(data.min()), float(data.max()), low, high, frames, tuple(shots))


def join(comparisons: Sequence[Comparison]) -> list[MethodResult]:
    """Join the results of several shots: methods measured on all of them.

    Measures are means over shots, with intervals over shots and frames. Times are means too (shots need different
    stages), memory is the maximum, worth the geometric mean.
    """
    tables = [{r.name: r for r in c.results if r.absent_reason is None} for c in comparisons]
    common = [name for name in tables[0] if all(name in table for table in tables)] if tables else []
    return [_join_method([table[name] for table in tables]) for name in common]


def _join_method(results: Sequence[MethodResult]) -> MethodResult:
    metrics = {}
    for key in results[0].metrics:
        values = [r.metrics[key].values for r in results if key in r.metrics]
        if len(values) == len(results) and all(values):
            metrics[key] = summarize([v for part in values for v in part], [len(part) for part in values])
    log_worth = _mean_of_all([None if r.worth is None else math.log(r.worth) for r in results])
    return replace(
        results[0],
        settings={},
        seconds_per_megapixel=_mean_of_all([r.seconds_per_megapixel for r in results]),
        spread=None,
        cpu_seconds_per_megapixel=_mean_of_all([r.cpu_seconds_per_megapixel for r in results]),
        peak_bytes=max((r.peak_bytes for r in results if r.peak_bytes is not None), default=None),
        metrics=metrics,
        worth=None if log_worth is None else math.exp(log_worth),
    )


def _mean_of_all(values: Sequence[float | None]) -> float | None:
    """The mean; None if one of the values is unknown."""
    known = [value for value in values if value is not None]
    return float(np.mean(known)) if len(known) == len(values) else None


def best_and_ties(results: Sequence[MethodResult], metric: Metric) -> tuple[str | None, set[str]]:
    """Name the best method by a measure, None where no method has a mean, and the methods that tie with it.

    Methods tie where the bootstrap interval of their differences, frame by frame, contains 0; without values of
    the frames, where the intervals of the means overlap.
    """
    rated = {r.name: r.metrics[metric.key] for r in results if metric.key in r.metrics}
    rated = {name: s for name, s in rated.items() if not math.isnan(s.mean)}
    if not rated:
        return None, set()
    best = max(rated, key=lambda name: _goodness(rated[name].mean, metric))
    return best, {name for name in rated if name != best and _tied(rated[name], rated[best])}


def leading_pair(results: Sequence[MethodResult], metric: Metric) -> tuple[str, str] | None:
    """Name the best method and its strongest rival; None where fewer than two methods have a mean.

    For a method of ours the rival is the best of `OTHER_FAMILIES`, for one of those the best of ours, and of any family
    where the other side has none. The noisy input is a rival only where nothing else is.
    """
    rated = [r for r in results if metric.key in r.metrics and not math.isnan(r.metrics[metric.key].mean)]
    best, _ = best_and_ties(rated, metric)
    leader = next((r for r in rated if r.name == best), None)
    if leader is None:
        return None
    denoisers = [r for r in rated if r.family != INPUT_FAMILY]
    is_other = leader.family in OTHER_FAMILIES
    for rivals in ([r for r in denoisers if (r.family in OTHER_FAMILIES) != is_other], denoisers, rated):
        rival, _ = best_and_ties([r for r in rivals if r.name != leader.name], metric)
        if rival is not None:
            return leader.name, rival
    return None


def pareto_front(results: Sequence[MethodResult], metric: Metric, cost: Cost) -> list[str]:
    """Name the methods of known cost and finite mean that no other beats at the same cost or less, by rising cost."""
    points = [
        (spent, -_goodness(r.metrics[metric.key].mean, metric), r.name)
        for r in results
        if (spent := getattr(r, cost)) is not None
        and metric.key in r.metrics
        and math.isfinite(r.metrics[metric.key].mean)
    ]
    front: list[str] = []
    least = math.inf
    for _, badness, name in sorted(points):
        if badness < least:
            front.append(name)
            least = badness
    return front


def opening_pair(results: Sequence[MethodResult], metric: Metric) -> tuple[str, str] | None:
    """Name the noisy input and the best method of ours, or else the best of all, with which a page opens."""
    ours = [r for r in results if r.family not in (INPUT_FAMILY, *OTHER_FAMILIES)]
    shown = best_and_ties(ours, metric)[0] or best_and_ties(results, metric)[0]
    noisy = next((r.name for r in results if r.family == INPUT_FAMILY and r.name != shown), None)
    return None if noisy is None or shown is None else (noisy, shown)


def _goodness(value: float, metric: Metric) -> float:
    """A number that is larger where the method is better."""
    return {"higher": value, "lower": -value, "zero": -abs(value)}[metric.better]


def _tied(a: Statistic, b: Statistic) -> bool:
    if a.values and len(a.values) == len(b.values) and a.shots == b.shots:
        with np.errstate(invalid="ignore"):  # two perfect scores: inf − inf
            difference = np.subtract(a.values, b.values)
        low, high = bootstrap_interval(np.where(np.equal(a.values, b.values), 0.0, difference), shots=a.shots)
        return low <= 0 <= high
    return a.low <= b.high and b.low <= a.high


def present_metrics(results: Sequence[MethodResult], metrics: Sequence[Metric]) -> list[Metric]:
    return [m for m in metrics if any(m.key in r.metrics for r in results)]


def settings_as_text(result: MethodResult) -> dict[str, str]:
    """Format the settings for people: floats with four significant digits."""
    return {
        str(k).replace("_", " "): f"{v:.4g}" if isinstance(v, float) else str(v) for k, v in result.settings.items()
    }


def to_document(comparison: Comparison) -> dict[str, object]:
    """Return the content of ``results.json`` as plain dicts: the comparison and its fronts."""
    results, metrics = comparison.results, present_metrics(comparison.results, METRICS)
    return {
        "shot": comparison.shot,
        "facts": dict(comparison.facts),
        "metrics": [asdict(m) for m in metrics],
        # asdict copies mappings by their own type, which fails for MappingProxyType.
        "results": [
            {**vars(r), "settings": settings_as_text(r), "metrics": {k: asdict(v) for k, v in r.metrics.items()}}
            for r in results
        ],
        "fronts": {f"{m.key} {cost}": pareto_front(results, m, cost) for m in metrics for cost in COSTS},
        "ladder": comparison.ladder,
        "frames": comparison.frames,
    }


def to_plain_numbers(value: object) -> object:
    """Convert to types of JSON: NumPy numbers to Python's, numbers that are not finite to strings."""
    if isinstance(value, Mapping):
        return {str(k): to_plain_numbers(v) for k, v in value.items()}
    if isinstance(value, (list, tuple)):
        return [to_plain_numbers(v) for v in value]
    if isinstance(value, np.generic):
        return to_plain_numbers(value.item())
    if isinstance(value, float) and not math.isfinite(value):
        return "NaN" if math.isnan(value) else "Infinity" if value > 0 else "-Infinity"
    return value


def to_json(document: object, indent: int | None = None) -> str:
    """Write JSON in which numbers that are not finite are strings that ``float`` and ``Number`` both parse."""
    return json.dumps(to_plain_numbers(document), indent=indent, ensure_ascii=False, allow_nan=False) + "\n"


def read_comparison(path: Path) -> Comparison:
    """Read a ``results.json``, settings as text; ValueError if the file holds anything else."""
    text = path.read_text(encoding="utf-8")
    try:
        document = json.loads(text)
        results = tuple(_read_result(entry) for entry in document["results"])
        facts = {str(name): str(value) for name, value in document["facts"].items()}
        ladder = {
            str(key): {str(name): tuple((float(n), float(e)) for n, e in curve) for name, curve in curves.items()}
            for key, curves in document.get("ladder", {}).items()
        }
        return Comparison(str(document["shot"]), results, facts, ladder, tuple(map(int, document.get("frames", ()))))
    except (LookupError, TypeError, ValueError, AttributeError, RecursionError) as error:
        words = " ".join(f"{type(error).__name__}: {error}".split())[:200]
        raise ValueError(f"{path} is no result of a comparison: {words}") from None


def _read_result(entry: Mapping[str, Any]) -> MethodResult:
    """A result of `to_document`."""
    metrics = {}
    for key, found in entry["metrics"].items():
        numbers = {name: float(found[name]) for name in ("mean", "minimum", "maximum", "low", "high")}
        metrics[key] = Statistic(**numbers, values=tuple(map(float, found["values"])), shots=tuple(found["shots"]))
    values: dict[str, Any] = {name: str(entry[name]) for name in ("name", "family")}
    numbers_or_text = dict.fromkeys(("seconds_per_megapixel", "cpu_seconds_per_megapixel", "worth"), float)
    for name, kind in {**numbers_or_text, "peak_bytes": int, "absent_reason": str}.items():
        values[name] = None if entry[name] is None else kind(entry[name])
    if (spread := entry["spread"]) is not None:
        values["spread"] = float(spread[0]), float(spread[1])
    return MethodResult(settings=dict(entry["settings"]), metrics=metrics, **values)
