"""The results of a comparison as one HTML page, and as PNG, CSV, JSON and Markdown for scripts and papers.

The page holds everything it shows: it asks for no library, font or file, and a content security policy keeps it
from doing so. Its templates are in `hybrid.comparison.page`.
"""

from __future__ import annotations

import math
from collections.abc import Callable, Sequence
from dataclasses import dataclass
from functools import partial
from pathlib import Path

import numpy as np
from markupsafe import Markup
from numpy.typing import NDArray

from hybrid.comparison import chart, page
from hybrid.comparison.embedding import ReportImages, embed_pictures
from hybrid.comparison.loops import embed_loops, write_loops
from hybrid.comparison.results import (
    CHART_METRICS,
    COSTS,
    METRICS,
    Comparison,
    Cost,
    MethodResult,
    Metric,
    best_and_ties,
    is_comparison,
    join,
    pareto_front,
    present_metrics,
    stage_values,
    to_document,
    to_json,
    to_plain_numbers,
)
from hybrid.comparison.store import MAP_TITLES, REFERENCE, FrameStore
from hybrid.comparison.tables import (
    format_bytes,
    format_change,
    format_seconds,
    format_value,
    format_worth,
    markdown_table,
    to_csv,
)
from hybrid.files.replace import check_outputs, write_file

Array = NDArray[np.float32]

# Frames per second that the page plays at, besides the one asked for.
RATES = (4, 12, 24, 25, 30, 60)
LOOPS = "loops"
FILES = ("report.html", "results.json", "results.csv", "results.md", "chart.png")


def write_report(
    folder: Path | str,
    comparison: Comparison,
    images: Sequence[ReportImages] = (),
    reference: Callable[[int], Array] | None = None,
    frames: Sequence[int] = (),
    *,
    others: Sequence[Comparison] = (),
    exposure: float = 1.0,
    cost: Cost = "seconds_per_megapixel",
    megabytes: float = 24.0,
    rate: float = 24.0,
    movies: bool = False,
) -> Path:
    """Write ``report.html``, ``results.json``, ``results.csv``, ``results.md`` and ``chart.png`` into a folder.

    Parameters
    ----------
    folder : Path or str
        Is made where it does not exist.
    comparison : Comparison
        Of the shot that the page is about, methods in the order of the tables. The one named "noisy" is what gains
        are counted from.
    images : sequence of ReportImages
        Of those methods that have pictures, in the order of the viewer; each read one frame at a time.
    reference : callable, optional
        From a frame number to (H, W, 3) linear radiance. Needed with `images`.
    frames : sequence of int
        Numbers of the consecutive frames whose pictures are embedded.
    others : sequence of Comparison
        Of further shots, which are shown beside this one and put together with it.
    exposure : float
        The factor e of the tone curve e·x / (1 + e·x) of the metrics: 0 EV in the viewer.
    cost : str
        One of `COSTS`: what the chart begins with, and what chart.png shows.
    megabytes : float
        Limit on the embedded pictures. What is left out to keep it is said on the page. Loops
        (`hybrid.comparison.loops`) may take a sixth of it beside.
    rate : float
        Frames per second, as the page plays at first.
    movies : bool
        Whether the loops are written in their own size too, into a folder ``loops`` beside the page.

    Returns
    -------
    Path
        Of the page.

    Raises
    ------
    ValueError
        Two results of one name; images without a result, a reference or frames; pictures of different shapes.
    """
    results = comparison.results
    _check(results, images, reference, frames)
    folder = Path(folder)
    check_report(folder)
    folder.mkdir(parents=True, exist_ok=True)
    pictures, labels = None, {r.name: r.label for r in results}
    if images and reference is not None:
        pictures = embed_pictures(images, labels, reference, frames, megabytes * 1e6)
    loops, beside = None, {}
    if images and reference is not None and len(frames) > 1:
        looped = {"exposure": exposure, "rate": rate}
        loops = embed_loops(images, labels, reference, frames, **looped, limit=megabytes * 1e6 / 6)
        if movies:
            beside = write_loops(folder / LOOPS, images, reference, frames, **looped)
    metrics = present_metrics(results, METRICS)
    charted = [m for m in metrics if m.key in CHART_METRICS]
    costs = {key: COSTS[key] for key in (cost, *(c for c in COSTS if c != cost))}
    document = to_document(comparison)
    write_file(folder / "results.json", to_json(document, indent=1))
    write_file(folder / "results.csv", to_csv(results, metrics))
    write_file(folder / "results.md", markdown_table([comparison, *others], cost))
    layout = chart.lay_out(results, charted[0], cost) if charted else None
    if layout is not None:
        write_file(folder / "chart.png", chart.to_png(layout))
    present = [r for r in results if r.absent_reason is None]
    text = page.render(
        "report.html",
        comparison=comparison,
        style=page.style(),
        script=page.script(),
        verdict=_verdict(results, metrics),
        metrics=metrics,
        charted=charted,
        costs=costs,
        families=chart.families(results),
        colors=len(chart.COLORS),
        marker=chart.marker,
        plots=[_plot(results, m, c) for m in charted for c in costs],
        methods=_method_table([r for r in present if not r.sweep], metrics),
        absent=[r for r in results if r.absent_reason is not None],
        sweeps=_sweep_tables(present, metrics),
        stages=stage_values(results),
        shots=_shot_table([comparison, *others]),
        pictures=pictures,
        loops=loops,
        movies=[(labels.get(name, "Reference"), file) for name, file in beside.items()],
        rates=sorted({*RATES, rate}),
        fps=rate,
        data=to_plain_numbers(
            {
                **document,
                "chart": [m.key for m in charted],
                "cost": cost,
                "exposure": exposure,
                "pictures": pictures and pictures.info,
                "loops": loops and loops.info,
            }
        ),
    )
    write_file(folder / "report.html", text)
    return folder / "report.html"


def check_report(folder: Path, inputs: Sequence[Path] = ()) -> None:
    """Refuse a folder where a report would be written over something that is none.

    Parameters
    ----------
    folder : Path
        As for `write_report`.
    inputs : sequence of Path
        Files that are read meanwhile.

    Raises
    ------
    ValueError, OSError
        If the folder has a file that a report would replace and that no comparison has left there, or that is read.
    """
    check_outputs([("report", folder / name) for name in FILES], [("results", path) for path in inputs])
    there = [folder / name for name in (*FILES, LOOPS) if (folder / name).exists()]
    if there and not is_comparison(folder / "results.json"):
        raise ValueError(f"{there[0]} is there, and of no earlier comparison: expected another folder")


def report_images(
    store: FrameStore, comparison: Comparison, frames: Sequence[int]
) -> tuple[list[ReportImages], Callable[[int], Array]]:
    """Name the pictures that `compare_shot` has left; they are read when asked for.

    Parameters
    ----------
    store : FrameStore
        Of the folder given to `compare_shot`.
    comparison : Comparison
        What it has returned.
    frames : sequence of int
        Numbers of the frames that were judged.

    Returns
    -------
    list of ReportImages
        Pictures and maps of every method. Points of sweeps are left out: there are too many, and they look alike.
    callable
        From a frame number to the reference.
    """
    images = [
        ReportImages(
            r.name,
            partial(store.load, r.name),
            {
                title: partial(_load_map, store, r.name, title)
                for title in MAP_TITLES
                if any(store.has(r.name, number, title) for number in frames)
            },
        )
        for r in comparison.results
        if r.absent_reason is None and not r.sweep
    ]
    return images, partial(store.load, REFERENCE)


def _load_map(store: FrameStore, name: str, title: str, number: int) -> Array | None:
    return store.load(name, number, title) if store.has(name, number, title) else None


def _check(
    results: Sequence[MethodResult],
    images: Sequence[ReportImages],
    reference: Callable[[int], Array] | None,
    frames: Sequence[int],
) -> None:
    """Refuse what would make a page that contradicts itself."""
    names = [r.name for r in results]
    for name in names:
        if names.count(name) > 1:
            raise ValueError(f"results must have different names, {name!r} appears {names.count(name)} times")
    if REFERENCE in names:
        raise ValueError(f"results must not be named {REFERENCE!r}: the viewer keeps that name")
    for entry in images:
        if entry.name not in names:
            raise ValueError(f"images of {entry.name!r} belong to no result; there are {', '.join(names)}")
    if images and (reference is None or not frames):
        raise ValueError("images need a reference and at least one frame")


# What the templates ask for


@dataclass(frozen=True)
class Verdict:
    """The page's head: who leads by the first measure, who ties with it, and (figure, unit, label) of what it gains."""

    leader: str
    ties: list[str]
    figures: list[tuple[str, str, str]]


def _verdict(results: Sequence[MethodResult], metrics: Sequence[Metric]) -> Verdict | None:
    if not metrics:
        return None
    metric, by_name = metrics[0], {r.name: r for r in results}
    best, ties = best_and_ties(results, metric)
    if best is None:
        return None
    leader, noisy = by_name[best], by_name.get("noisy")
    value = leader.metrics[metric.key].mean
    figures = [(format_value(value, metric), metric.unit, metric.label)]
    if noisy is not None and noisy is not leader and metric.key in noisy.metrics and not metric.logarithmic:
        gain = value - noisy.metrics[metric.key].mean
        figures.append((format_change(gain, metric), metric.unit, "over the noisy input"))
    if leader.worth is not None and math.isfinite(leader.worth):
        figures.append((format_worth(leader.worth), "", "the samples it is worth"))
    if leader.seconds_per_megapixel is not None:
        figures.append((format_seconds(leader.seconds_per_megapixel), "s", "per megapixel and frame"))
    return Verdict(leader.label, [r.label for r in results if r.name in ties], figures)


@dataclass(frozen=True)
class Plot:
    """One pair of axes: the drawing, None where nothing is finite, and (budget, label, figure) of what to use."""

    metric: Metric
    cost: Cost
    drawing: Markup | None
    advice: list[tuple[str, str, str]]


def _plot(results: Sequence[MethodResult], metric: Metric, cost: Cost) -> Plot:
    layout = chart.lay_out(results, metric, cost)
    by_name = {r.name: r for r in results}
    advice = []
    for name in pareto_front(results, metric, cost):
        result = by_name[name]
        spent = getattr(result, cost)
        budget = format_bytes(spent) if cost == "peak_bytes" else f"{format_seconds(spent)} s"
        figure = f"{format_value(result.metrics[metric.key].mean, metric)} {metric.unit}".strip()
        advice.append(("nothing" if spent == 0 else budget, result.label, figure))
    return Plot(metric, cost, None if layout is None else chart.to_svg(layout), advice)


@dataclass(frozen=True)
class Column:
    """A measure as a column of a table: the best method, those that tie with it, and the range of all figures."""

    metric: Metric
    best: str | None
    ties: set[str]
    low: float
    high: float

    def percent(self, value: float) -> str:
        """How far along a cell a figure lies, in the range of all methods."""
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


@dataclass(frozen=True)
class MethodTable:
    """Methods by family, the measures as columns, and how many of the methods are points of a sweep."""

    columns: list[Column]
    families: dict[str, list[MethodResult]]
    varied: int


def _method_table(results: Sequence[MethodResult], metrics: Sequence[Metric]) -> MethodTable:
    families = {name: [r for r in results if r.family == name] for name in chart.families(results)}
    return MethodTable(_columns(results, metrics), families, sum(bool(r.sweep) for r in results))


def _sweep_tables(present: Sequence[MethodResult], metrics: Sequence[Metric]) -> dict[str, MethodTable]:
    """The points of each sweep, below the methods that they vary."""
    tables = {}
    for sweep in dict.fromkeys(r.sweep for r in present if r.sweep):
        members = [r for r in present if r.sweep == sweep]
        bases = [r for r in present if not r.sweep and r.name in {m.base for m in members}]
        tables[sweep] = _method_table([*bases, *members], metrics)
    return tables


@dataclass(frozen=True)
class ShotTable:
    """What several shots have in common: their means as results, and the results of each shot by name."""

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
