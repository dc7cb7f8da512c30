"""What a comparison has measured: methods, measures, who is best, what ties, and all of it as JSON."""

from __future__ import annotations

import json
import math
from collections.abc import Callable, Mapping, Sequence
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
    """One measure over the frames of one or more shots: its mean, range, and the interval that the mean is known to."""

    mean: float
    minimum: float
    maximum: float
    low: float
    high: float
    values: tuple[float, ...] = ()  # frame by frame, where known: paired differences then decide on ties
    shots: tuple[int, ...] = ()  # how many of the values belong to each shot, where there are several


@dataclass(frozen=True)
class Metric:
    """How a measure is called, read and printed."""

    key: str
    label: str
    definition: str
    unit: str = ""
    digits: int = 2
    better: Literal["higher", "lower", "zero"] = "higher"
    logarithmic: bool = False  # on the chart; printed with three significant digits


@dataclass(frozen=True)
class MethodResult:
    """What one method, with one choice of settings, has reached and cost on a shot.

    `seconds_per_megapixel` is the median, `spread` the (low, high) of repeated runs; None where the time is not
    known, 0 where nothing was run. `worth` is the number of times the noisy render's samples that would
    bring it to the same error. Methods of one `family` share a marker. A point of a sweep names what is varied in
    `sweep` and the method it varies in `base`; its settings are those in which it differs. `absent_reason`
    says why a method that was asked for has no figures.
    """

    name: str
    label: str
    settings: Mapping[str, object] = field(default_factory=dict)
    family: str = "Methods"
    sweep: str = ""
    base: str = ""
    seconds_per_megapixel: float | None = None
    spread: tuple[float, float] | None = None
    cpu_seconds_per_megapixel: float | None = None
    peak_bytes: int | None = None
    metrics: Mapping[str, Statistic] = field(default_factory=dict)
    worth: float | None = None
    absent_reason: str | None = None


@dataclass(frozen=True)
class Comparison:
    """What one shot has shown: the methods' results, and what to know about how they were measured."""

    shot: str
    results: tuple[MethodResult, ...]
    facts: Mapping[str, str] = field(default_factory=dict)


METRICS: tuple[Metric, ...] = (
    Metric(
        "psnr",
        "PSNR",
        "Peak signal-to-noise ratio, −10 log₁₀ mean (T(x) − T(r))², on the tone curve T(x) = e·x / (1 + e·x) "
        "at one exposure e for the whole shot. Mean over frames.",
        unit="dB",
    ),
    Metric(
        "temporal_psnr",
        "Temporal PSNR",
        "PSNR of what changes from frame to frame: the difference of each frame to the one before, warped onto "
        "it, against the reference's own. Flicker lowers it; an error that stands still does not, so read "
        "it beside the PSNR.",
        unit="dB",
    ),
    Metric(
        "ssim",
        "SSIM",
        "Mean structural similarity on the same tone curve: Gaussian window, σ = 1.5, K = (0.01, 0.03); 1 at best.",
        digits=4,
    ),
    Metric(
        "relmse",
        "relMSE",
        "Relative mean squared error, mean (x − r)² / (r² + 0.01), on linear radiance. One firefly can decide it.",
        better="lower",
        logarithmic=True,
    ),
    Metric(
        "relmse_trimmed",
        "relMSE, trimmed",
        "relMSE without the 0.1 % of the pixels whose error is largest.",
        better="lower",
        logarithmic=True,
    ),
    Metric("smape", "SMAPE", "Mean |x − r| / (|x| + |r| + 0.01), in [0, 1].", digits=4, better="lower"),
    Metric(
        "flip",
        "FLIP",
        "Mean HDR-FLIP error: how different the two look when one flips between them, over the range of "
        "exposures the reference calls for; 0 at best, 1 at worst.",
        digits=4,
        better="lower",
    ),
    Metric(
        "mean_bias",
        "Bias",
        "Relative error of the mean radiance, mean x / mean r − 1: below zero where light was lost.",
        digits=4,
        better="zero",
    ),
    Metric(
        "static_std",
        "Static deviation",
        "Standard deviation over time, on the tone curve, of the pixels that stand still: the vectors stay below a "
        "twentieth of a pixel, and the reference's 9 × 9 means within 0.02. Frame by frame: √(n / (n − 1)) times "
        "the root mean square distance to each pixel's own mean over the n frames. 0 is no flicker at all, which "
        "blur reaches too.",
        better="lower",
        logarithmic=True,
    ),
)
MARKDOWN_METRICS = ("psnr", "temporal_psnr")  # the columns of the README's table
CHART_METRICS = ("psnr", "temporal_psnr", "relmse", "flip")  # those the chart offers, the first one first


def summarize(values: Sequence[float], shots: Sequence[int] = ()) -> Statistic:
    """Summarize a measure taken frame by frame: mean, range, and the 95 % bootstrap interval of the mean.

    Parameters
    ----------
    values : sequence of float
        N ≥ 1 figures, one per frame.
    shots : sequence of int
        How many of them belong to each shot, if to several. The mean is then that of the shots' means.

    Returns
    -------
    Statistic

    Raises
    ------
    ValueError
        If there are no values.
    """
    if len(values) == 0:
        raise ValueError("values must hold at least one frame, is empty")
    data = np.asarray(values, np.float64)
    return Statistic(
        mean_over_shots(data, shots),
        float(data.min()),
        float(data.max()),
        *bootstrap_interval(data, shots=shots),
        tuple(float(v) for v in data),
        tuple(shots),
    )


def join(comparisons: Sequence[Comparison]) -> list[MethodResult]:
    """Put the results of several shots together: the methods that none of them lacks, points of sweeps left out.

    Parameters
    ----------
    comparisons : sequence of Comparison
        Of the shots.

    Returns
    -------
    list of MethodResult
        Figures are means over shots, their intervals over frames and shots. Costs are means too (that of memory the
        maximum), since shots call for different stages; worth is the geometric mean.
    """
    tables = [{r.name: r for r in c.results if r.absent_reason is None and not r.sweep} for c in comparisons]
    joined = []
    for name, first in tables[0].items() if tables else ():
        each = [table[name] for table in tables if name in table]
        if len(each) < len(tables):
            continue
        metrics = {}
        for key in first.metrics:
            parts = [r.metrics[key].values for r in each if key in r.metrics]
            if len(parts) == len(each) and all(parts):
                metrics[key] = summarize([v for part in parts for v in part], [len(part) for part in parts])
        seconds = [r.seconds_per_megapixel for r in each if r.seconds_per_megapixel is not None]
        cpu = [r.cpu_seconds_per_megapixel for r in each if r.cpu_seconds_per_megapixel is not None]
        worths = [r.worth for r in each if r.worth is not None]
        joined.append(
            replace(
                first,
                settings={},
                seconds_per_megapixel=float(np.mean(seconds)) if len(seconds) == len(each) else None,
                spread=None,
                cpu_seconds_per_megapixel=float(np.mean(cpu)) if len(cpu) == len(each) else None,
                peak_bytes=max((r.peak_bytes for r in each if r.peak_bytes is not None), default=None),
                metrics=metrics,
                worth=math.exp(float(np.mean(np.log(worths)))) if len(worths) == len(each) else None,
            )
        )
    return joined


def best_and_ties(results: Sequence[MethodResult], metric: Metric) -> tuple[str | None, set[str]]:
    """Name the best method by a measure, and those that cannot be told from it.

    Parameters
    ----------
    results : sequence of MethodResult
        In any order.
    metric : Metric
        The measure.

    Returns
    -------
    best : str, optional
        The best mean's; None where no method has one.
    ties : set of str
        Those whose difference to it is a tie.

    Notes
    -----
    Two methods tie where the bootstrap interval of their differences frame by frame contains 0; where the
    values of the frames are not known, where the intervals of the means overlap.
    """
    rated = {r.name: r.metrics[metric.key] for r in results if metric.key in r.metrics}
    rated = {name: s for name, s in rated.items() if not math.isnan(s.mean)}
    if not rated:
        return None, set()
    best = max(rated, key=lambda name: _goodness(rated[name].mean, metric))
    return best, {name for name in rated if name != best and _tied(rated[name], rated[best])}


def pareto_front(results: Sequence[MethodResult], metric: Metric, cost: Cost) -> list[str]:
    """Name the methods that no other beats at the same cost or less, by rising cost.

    Parameters
    ----------
    results : sequence of MethodResult
        Those whose cost is not known, or whose measure is not finite, are left out.
    metric : Metric
        The measure.
    cost : str
        One of `COSTS`.

    Returns
    -------
    list of str
    """
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


@dataclass(frozen=True)
class StageValue:
    """What one stage changes: figures with it minus figures without it."""

    stage: str
    base: str
    on: bool  # in the plan
    gains: Mapping[str, float]  # of PSNR and temporal PSNR
    told: tuple[str, ...]  # those whose change is no tie
    seconds: float | None
    cpu_seconds: float | None


def stage_values(results: Sequence[MethodResult]) -> list[StageValue]:
    """Find what each stage buys and costs.

    Parameters
    ----------
    results : sequence of MethodResult
        With the points of a sweep named "Stages".

    Returns
    -------
    list of StageValue
        Empty without such a sweep.
    """
    by_name = {r.name: r for r in results if r.absent_reason is None}
    values = []
    for variant in by_name.values():
        base = by_name.get(variant.base)
        if variant.sweep != "Stages" or base is None:
            continue
        ((stage, state),) = variant.settings.items()
        ways = (base, variant) if state == "off" else (variant, base)
        gains, told = {}, []
        for m in METRICS:
            if m.key in MARKDOWN_METRICS and m.key in base.metrics and m.key in variant.metrics:
                gains[m.key] = ways[0].metrics[m.key].mean - ways[1].metrics[m.key].mean
                if not _tied(ways[0].metrics[m.key], ways[1].metrics[m.key]):
                    told.append(m.key)
        seconds, cpu = (
            None if ends[0] is None or ends[1] is None else ends[0] - ends[1]
            for ends in (
                [way.seconds_per_megapixel for way in ways],
                [way.cpu_seconds_per_megapixel for way in ways],
            )
        )
        values.append(StageValue(stage, base.label, state == "off", gains, tuple(told), seconds, cpu))
    return values


def _goodness(value: float, metric: Metric) -> float:
    """A figure that is larger where the method is better."""
    return {"higher": value, "lower": -value, "zero": -abs(value)}[metric.better]


def _tied(a: Statistic, b: Statistic) -> bool:
    if a.values and len(a.values) == len(b.values) and a.shots == b.shots:
        with np.errstate(invalid="ignore"):  # two perfect scores: inf − inf
            difference = np.subtract(a.values, b.values)
        low, high = bootstrap_interval(np.where(np.equal(a.values, b.values), 0.0, difference), shots=a.shots)
        return low <= 0 <= high
    return a.low <= b.high and b.low <= a.high


def present_metrics(results: Sequence[MethodResult], metrics: Sequence[Metric]) -> list[Metric]:
    """Return those of the metrics that at least one result has.

    Parameters
    ----------
    results : sequence of MethodResult
        In any order.
    metrics : sequence of Metric
        Those to look for.

    Returns
    -------
    list of Metric
    """
    return [m for m in metrics if any(m.key in r.metrics for r in results)]


def settings_as_text(result: MethodResult) -> dict[str, str]:
    """Print the settings for people: floats with four significant digits."""
    return {
        str(k).replace("_", " "): f"{v:.4g}" if isinstance(v, float) else str(v) for k, v in result.settings.items()
    }


def to_document(comparison: Comparison) -> dict[str, object]:
    """All that a comparison holds, and what follows from it, as plain dicts: what ``results.json`` is."""
    results, metrics = comparison.results, present_metrics(comparison.results, METRICS)
    return {
        "shot": comparison.shot,
        "facts": dict(comparison.facts),
        "metrics": [asdict(m) for m in metrics],
        "results": [_plain(r) for r in results],
        "fronts": {f"{m.key} {cost}": pareto_front(results, m, cost) for m in metrics for cost in COSTS},
        "stages": [asdict(s) for s in stage_values(results)],
    }


def _plain(result: MethodResult) -> dict[str, object]:
    """A result as plain dicts, settings as text: what they hold is the caller's business."""
    # asdict copies mappings by their own type, which a MappingProxy does not survive.
    metrics = {k: asdict(v) for k, v in result.metrics.items()}
    values = {name: getattr(result, name) for name in result.__dataclass_fields__}
    return {**values, "settings": settings_as_text(result), "metrics": metrics}


def to_plain_numbers(value: object) -> object:
    """What JSON can hold: NumPy's numbers as Python's, those that are not finite as text that ``float`` reads."""
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
    """Write JSON in which numbers that are not finite are strings that ``float`` and ``Number`` both read.

    Parameters
    ----------
    document : object
        Dicts, lists, text and numbers.
    indent : int, optional
        Spaces of a level; all on one line without.

    Returns
    -------
    str
        JSON.
    """
    return json.dumps(to_plain_numbers(document), indent=indent, ensure_ascii=False, allow_nan=False) + "\n"


def is_comparison(path: Path) -> bool:
    """Whether a file is there that `read_comparison` can read."""
    try:
        read_comparison(path)
    except (OSError, ValueError):
        return False
    return True


def read_comparison(path: Path) -> Comparison:
    """Read the ``results.json`` that `hybrid.comparison.report.write_report` has left.

    Parameters
    ----------
    path : Path
        The file.

    Returns
    -------
    Comparison
        Settings as text.

    Raises
    ------
    ValueError
        If it is no such file.
    """
    text = path.read_text(encoding="utf-8")
    try:
        document = json.loads(text)
        results = []
        for entry in document["results"]:
            statistics = {}
            for key, s in entry["metrics"].items():
                mean, minimum, maximum, low, high = (
                    float(s[end]) for end in ("mean", "minimum", "maximum", "low", "high")
                )
                values = tuple(map(float, s["values"]))
                statistics[key] = Statistic(mean, minimum, maximum, low, high, values, tuple(s["shots"]))
            fastest, slowest = map(float, entry["spread"] or (0, 0))
            spread = None if entry["spread"] is None else (fastest, slowest)
            numbers: dict[str, Callable[[Any], float]] = {"peak_bytes": int, "worth": float}
            numbers |= dict.fromkeys(("seconds_per_megapixel", "cpu_seconds_per_megapixel"), float)
            kept: dict[str, Any] = {
                name: None if entry[name] is None else kind(entry[name]) for name, kind in numbers.items()
            }
            kept |= {name: str(entry[name]) for name in ("name", "label", "family", "sweep", "base")}
            kept |= {"settings": dict(entry["settings"]), "metrics": statistics, "spread": spread}
            results.append(MethodResult(**{**entry, **kept}))
        facts = {str(name): str(value) for name, value in document["facts"].items()}
        return Comparison(str(document["shot"]), tuple(results), facts)
    except (LookupError, TypeError, ValueError, AttributeError, RecursionError) as error:
        words = " ".join(f"{type(error).__name__}: {error}".split())[:200]
        raise ValueError(f"{path} is no result of a comparison: {words}") from None
