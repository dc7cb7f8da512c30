"""The report of a comparison: an HTML page, a PNG of its chart, and JSON for scripts.

The page is one file that holds all it shows and requests nothing; a content security policy enforces this. Its
templates are in `hybrid.comparison.page`.
"""

import math
import tempfile
from collections.abc import Mapping, Sequence
from functools import partial
from pathlib import Path
from typing import Any, NamedTuple

from markupsafe import Markup

from hybrid.comparison import chart, page, tables
from hybrid.comparison.animations import embed_animations, write_movies
from hybrid.comparison.embedding import MethodImages, ShotImages, embed_pictures
from hybrid.comparison.results import (
    CHART_METRICS,
    COSTS,
    METRICS,
    Comparison,
    Cost,
    MethodResult,
    Metric,
    best_and_ties,
    join,
    leading_pair,
    opening_pair,
    pareto_front,
    present_metrics,
    read_comparison,
    to_document,
    to_json,
    to_plain_numbers,
)
from hybrid.comparison.store import MAP_TITLES, REFERENCE, FrameStore
from hybrid.files.replace import check_outputs, write_file

MOVIES = "movies"  # folder next to the page
FILES = ("report.html", "results.json", "chart.png", "ladder.png")


class Report(NamedTuple):
    # the shot of the page, methods in the order of the tables. Gains are relative to the method "noisy".
    comparison: Comparison
    images: ShotImages | None = None  # frames and maps for the viewer
    others: Sequence[Comparison] = ()  # comparisons of other shots, for a table of all shots
    cost: Cost = "seconds_per_megapixel"  # one of `COSTS`: the chart's first choice, and that of chart.png
    rate: float = 24.0  # frames per second at which the page plays first
    movies: bool = False  # also write the animations in full size into a folder ``movies``


def write_report(folder: Path | str, report: Report) -> Path:
    """Write `FILES` into a folder (``ladder.png`` with a ladder alone), named as results; return the page's path."""
    folder, results = Path(folder), report.comparison.results
    check_report(folder)
    embedded = _embed(folder, report)
    document = to_document(report.comparison)
    write_file(folder / "results.json", to_json(document, indent=1))
    charted = present_metrics(results, [m for m in METRICS if m.key in CHART_METRICS])
    figure = chart.draw_chart(results, charted[0], report.cost, legend=True) if charted else None
    if figure is not None:
        write_file(folder / "chart.png", chart.to_png(figure))
    if (ladder := chart.draw_ladder(report.comparison.ladder)) is not None:
        write_file(folder / "ladder.png", chart.to_png(ladder))
    write_file(folder / "report.html", _page(report, embedded, document, charted))
    return folder / "report.html"


def check_report(folder: Path, inputs: Sequence[Path] = ()) -> None:
    """Make the folder of a report; raise ValueError or OSError if an input or a file of other origin would be lost."""
    check_outputs([("report", folder / name) for name in FILES], [("results", path) for path in inputs])
    if there := [folder / name for name in (*FILES, MOVIES) if (folder / name).exists()]:
        try:
            read_comparison(folder / "results.json")
        except (OSError, ValueError):
            words = f"{there[0]} exists and was not written by ravg compare: expected another folder"
            raise ValueError(words) from None
    try:
        folder.mkdir(parents=True, exist_ok=True)
        with tempfile.TemporaryFile(dir=folder):
            pass
    except OSError as error:
        raise type(error)(error.errno, f"cannot write a report: {error.strerror}", str(folder)) from None


def report_images(
    store: FrameStore, comparison: Comparison, frames: Sequence[int], exposure: float = 1.0
) -> ShotImages:
    """Return the images that `compare_shot` has stored."""

    def images_of(owner: str) -> MethodImages:
        titles = [title for title in MAP_TITLES if store.has(owner, frames[0], title)]
        maps = {title: partial(store.load, owner, title=title) for title in titles}
        return MethodImages(owner, partial(store.load, owner), maps)

    methods = [images_of(result.name) for result in comparison.results if result.absent_reason is None]
    reference = images_of(REFERENCE)
    return ShotImages(methods, reference.frame, frames, exposure, reference.maps)


def _embed(folder: Path, report: Report) -> dict[str, Any]:
    """Encode the images of a page, `animations` of more than one frame, and write the movies next to it by method."""
    images = report.images
    pictures = None if images is None else embed_pictures(images)
    if images is None or len(images.frames) < 2:
        return {"pictures": pictures, "animations": None, "movies": None}
    movies = write_movies(folder / MOVIES, images, report.rate) if report.movies else None
    return {"pictures": pictures, "animations": embed_animations(images), "movies": movies}


def _page(
    report: Report, embedded: Mapping[str, Any], document: Mapping[str, Any], charted: Sequence[Metric]
) -> Markup:
    comparison, results = report.comparison, report.comparison.results
    metrics = present_metrics(results, METRICS)
    pair = leading_pair(results, metrics[0]) if metrics else None
    present = [r for r in results if r.absent_reason is None]
    costs = {key: COSTS[key] for key in (report.cost, *(c for c in COSTS if c != report.cost))}
    data = {
        **document,
        "chart": [m.key for m in charted],
        "cost": report.cost,
        "opens": metrics and opening_pair(results, metrics[0]),
        "exposure": report.images.exposure if report.images is not None else 1.0,
        **{name: embedded[name] and embedded[name].info for name in ("pictures", "animations")},
    }
    return page.render(
        "report.html",
        comparison=comparison,
        verdict=_verdict(results, metrics, pair, report.cost),
        curves=[(m, curve) for m in charted if (curve := chart.draw_curves(present, m, pair, comparison.frames))],
        metrics=metrics,
        charted=charted,
        costs=costs,
        families=chart.families(results),
        colors=chart.COLORS,
        marker=chart.marker,
        plots=[_plot(results, m, c, f"chart{i}") for i, (m, c) in enumerate((m, c) for m in charted for c in costs)],
        methods=_method_table(present, metrics),
        absent=[r for r in results if r.absent_reason is not None],
        ladder=None if (ladder := chart.draw_ladder(comparison.ladder)) is None else chart.to_svg(ladder, "ladder"),
        ladder_rows=tables.ladder_rows(comparison.ladder),
        shots=_shot_table([comparison, *report.others]),
        **embedded,
        rates=sorted({4, 12, 24, 25, 30, 60, report.rate}),
        fps=report.rate,
        data=to_plain_numbers(data),
    )


class Verdict(NamedTuple):
    """Head of the page: the best method by the first measure, its rival, its ties, and (figure, unit, label)."""

    leader: str
    rival: str | None
    ties: list[str]
    figures: list[tuple[str, str, str]]


def _verdict(
    results: Sequence[MethodResult], metrics: Sequence[Metric], pair: tuple[str, str] | None, cost: Cost
) -> Verdict | None:
    best, ties = best_and_ties(results, metrics[0]) if metrics else (None, set())
    if best is None:
        return None
    metric, by_name = metrics[0], {r.name: r for r in results}
    leader = by_name[best]
    figures = [(tables.format_value(leader.metrics[metric.key].mean, metric), metric.unit, metric.label)]
    for gained in (m for m in metrics[:2] if pair and not m.logarithmic):
        means = [by_name[name].metrics[gained.key].mean for name in pair or () if gained.key in by_name[name].metrics]
        if len(means) == 2:
            label = f"{gained.label} over {pair[1] if pair else ''}"
            figures.append((tables.format_change(means[0] - means[1], gained), gained.unit, label))
    if leader.worth is not None and math.isfinite(leader.worth):
        figures.append((tables.format_worth(leader.worth), "", "worth in samples"))
    if (spent := getattr(leader, cost)) is not None:
        figures.append((tables.format_seconds(spent), "", COSTS[cost]))
    return Verdict(best, pair and pair[1], [r.name for r in results if r.name in ties], figures)


class Plot(NamedTuple):
    """A chart, None without finite values, and (budget, method, figure) of the recommendations."""

    metric: Metric
    cost: Cost
    drawing: Markup | None
    advice: list[tuple[str, str, str]]


def _plot(results: Sequence[MethodResult], metric: Metric, cost: Cost, prefix: str) -> Plot:
    figure = chart.draw_chart(results, metric, cost)
    by_name = {r.name: r for r in results}
    advice = []
    for name in pareto_front(results, metric, cost):
        spent = getattr(by_name[name], cost)
        budget = tables.format_bytes(spent) if cost == "peak_bytes" else f"{tables.format_seconds(spent)} s"
        value = f"{tables.format_value(by_name[name].metrics[metric.key].mean, metric)} {metric.unit}".strip()
        advice.append(("nothing" if spent == 0 else budget, name, value))
    return Plot(metric, cost, None if figure is None else chart.to_svg(figure, prefix), advice)


class Column(NamedTuple):
    """A measure as a column of a table: the best method, its ties, and the range of all values."""

    metric: Metric
    best: str | None
    ties: set[str]
    low: float
    high: float

    def percent(self, value: float) -> str:
        """Position of a value along a cell, in the range of all methods."""
        if not math.isfinite(value):
            return "100.0%"
        share = (_along(value, self.metric) - self.low) / ((self.high - self.low) or 1.0)
        return f"{100 * min(max(share, 0), 1):.1f}%"


def _along(value: float, metric: Metric) -> float:
    return math.log10(max(value, 1e-12)) if metric.logarithmic else value


def _columns(results: Sequence[MethodResult], metrics: Sequence[Metric]) -> list[Column]:
    columns = []
    for metric in metrics:
        shown = [r.metrics[metric.key] for r in results if metric.key in r.metrics]
        ends = [_along(v, metric) for s in shown for v in (s.minimum, s.maximum) if math.isfinite(v)] or [0.0]
        columns.append(Column(metric, *best_and_ties(results, metric), min(ends), max(ends)))
    return columns


class MethodTable(NamedTuple):
    """Methods by family, and the measures as columns."""

    columns: list[Column]
    families: dict[str, list[MethodResult]]


def _method_table(results: Sequence[MethodResult], metrics: Sequence[Metric]) -> MethodTable:
    families = {name: [r for r in results if r.family == name] for name in chart.families(results)}
    return MethodTable(_columns(results, metrics), families)


class ShotTable(NamedTuple):
    """Joined results of several shots, and the results of each shot by name."""

    columns: list[Column]
    joined: list[MethodResult]
    tables: list[tuple[str, dict[str, MethodResult]]]


def _shot_table(comparisons: Sequence[Comparison]) -> ShotTable | None:
    if len(comparisons) < 2:
        return None
    joined = join(comparisons)
    metrics = [m for m in present_metrics(joined, METRICS) if m.key in CHART_METRICS]
    tables = [(c.shot, {r.name: r for r in c.results}) for c in comparisons]
    return ShotTable(_columns(joined, metrics), joined, tables)
