"""Chart of a measure against a cost, drawn by matplotlib: SVG for the page, PNG for papers."""

import io
import math
import re
import warnings
from collections.abc import Collection, Sequence
from dataclasses import dataclass
from itertools import product

import numpy as np
from markupsafe import Markup
from matplotlib import rc_context
from matplotlib.axes import Axes
from matplotlib.figure import Figure
from matplotlib.lines import Line2D
from matplotlib.markers import MarkerStyle
from matplotlib.ticker import FuncFormatter, LogLocator, MaxNLocator
from matplotlib.transforms import Affine2D, Bbox

from hybrid.comparison.ladder import INPUT
from hybrid.comparison.results import COSTS, INPUT_FAMILY, METRICS, Cost, Ladder, MethodResult, Metric, pareto_front
from hybrid.comparison.tables import column_title, format_bytes, format_seconds, format_value

# Okabe and Ito's palette, which people with any common color blindness can distinguish, without its yellow, which is
# invisible on white. Seven colors and nine markers: families repeat neither until the 64th.
COLORS = ("#0072b2", "#d55e00", "#009e73", "#cc79a7", "#e69f00", "#56b4e9", "#6b6b6b")
MARKERS = "osD^vPXhp"
WIDTH, PNG_DPI = 10.0, 160  # inches, and dots per inch
LEGEND_ROW = 0.3  # height in inches
ERRORS = {"psnr": "Squared error", "temporal_psnr": "Squared error of changes"}  # where a measure is not the error


@dataclass(frozen=True)
class _Point:
    """A method on the chart: index and result, position in units of the axes, index of its family."""

    index: int
    result: MethodResult
    x: float
    y: float
    family: int
    on_front: bool


def families(results: Sequence[MethodResult]) -> list[str]:
    """Return the families in order of appearance, which determines color and marker."""
    return list(dict.fromkeys(r.family for r in results if r.absent_reason is None))


def draw_chart(results: Sequence[MethodResult], metric: Metric, cost: Cost, *, legend: bool = False) -> Figure | None:
    """Draw the chart, better up, cost on a logarithmic axis; None if no method has a finite value.

    Groups of the SVG are named for the page's script: ``point-i``, ``bar-i`` and ``name-i`` belong to result i.
    """
    shown = {i: r for i, r in enumerate(results) if _is_drawable(r, metric)}
    if not shown:
        return None
    names, front = families(results), pareto_front(results, metric, cost)
    height = 5.4 + (LEGEND_ROW * -(-len(names) // 4) if legend else 0)
    figure = Figure(figsize=(WIDTH, height), facecolor="none", layout="constrained")
    axes = figure.add_subplot(facecolor="none")
    places = _set_cost_axis(axes, {i: getattr(r, cost) for i, r in shown.items()}, cost)
    _set_measure_axis(axes, metric)
    low, high = _leave_out_input(axes, shown.values(), metric)
    heights = {i: float(np.clip(r.metrics[metric.key].mean, low, high)) for i, r in shown.items()}
    points = [_Point(i, r, places[i], heights[i], names.index(r.family), r.name in front) for i, r in shown.items()]
    for point in points:
        _draw_point(axes, point, metric, cost)
    _draw_front(axes, points)
    if legend:
        _draw_legend(figure, names, columns=4)
    _draw_labels(figure, axes, points, metric)
    return figure


def _is_drawable(result: MethodResult, metric: Metric) -> bool:
    mean = result.metrics[metric.key].mean if metric.key in result.metrics else math.nan
    return math.isfinite(mean) and (mean > 0 or not metric.logarithmic)


def _set_cost_axis(axes: Axes, costs: dict[int, float | None], cost: Cost) -> dict[int, float]:
    """Set up the logarithmic axis, in seconds or MiB, and its gutters; return the position of each result."""
    unit = 2**20 if cost == "peak_bytes" else 1
    known = [value / unit for value in costs.values() if value] or [1.0]
    span = math.log10(max(known) / min(known))
    margin = 10 ** max(0.06 * span, 0.12)
    low, high = min(known) / margin, max(known) * margin
    ticks = [float(t) for t in LogLocator(subs=(1, 2, 5) if span < 3 else (1,)).tick_values(low, high)]
    ticks = [t for t in ticks if low <= t <= high]
    texts = [format_bytes(round(t * unit)) if cost == "peak_bytes" else format_seconds(t) for t in ticks]
    gutter = (high / low) ** 0.09  # columns of methods that cost nothing, and of those whose cost is unknown
    free, unknown, left, right = low / math.sqrt(gutter), high * math.sqrt(gutter), low, high
    if 0 in costs.values():
        left = low / gutter
        axes.axvspan(left, low, color="#8888881c", linewidth=0)
        ticks, texts = [*ticks, free], [*texts, "nothing"]
    if None in costs.values():
        right = high * gutter
        axes.axvspan(high, right, color="#8888881c", linewidth=0)
        ticks, texts = [*ticks, unknown], [*texts, "unknown"]
    axes.set_xscale("log")
    axes.set_xlim(left, right)
    axes.set_xticks(ticks, texts)
    axes.minorticks_off()
    axes.set_xlabel(f"← better: {COSTS[cost]}", loc="right")
    return {i: unknown if value is None else value / unit if value else free for i, value in costs.items()}


def _set_measure_axis(axes: Axes, metric: Metric) -> None:
    if metric.logarithmic:
        axes.set_yscale("log")
        _set_plain_ticks(axes)
    axes.yaxis.set_inverted(metric.better != "higher")
    axes.set_title(f"{column_title(metric)}, better ↑", loc="left", fontsize=10)
    axes.grid(color="#88888833", linewidth=0.8)
    axes.set_axisbelow(True)
    axes.tick_params(length=0, labelsize=9, labelcolor="#555")
    axes.spines[["top", "left", "right"]].set_visible(False)


def _set_plain_ticks(axes: Axes) -> None:
    axes.yaxis.set_major_locator(LogLocator(subs=(1, 2, 5)))
    axes.yaxis.set_major_formatter(FuncFormatter(lambda value, _: f"{value:g}"))
    axes.yaxis.minorticks_off()


def _leave_out_input(axes: Axes, shown: Collection[MethodResult], metric: Metric) -> tuple[float, float]:
    """Set the range of the measure to that of the denoisers, which the noisy input would press together; return it."""
    statistics = [r.metrics[metric.key] for r in shown if r.family != INPUT_FAMILY]
    values = [v for s in statistics for v in (s.mean, s.low, s.high) if math.isfinite(v)]
    if metric.logarithmic or len(statistics) == len(shown) or len({s.mean for s in statistics}) < 2:
        return -math.inf, math.inf
    margin = 0.1 * (max(values) - min(values))
    bottom, top = min(values) - 2 * margin, max(values) + margin
    axes.set_ylim((bottom, top) if metric.better == "higher" else (top + margin, bottom + margin))
    low, high = sorted(axes.get_ylim())
    return low, high


def _draw_point(axes: Axes, point: _Point, metric: Metric, cost: Cost) -> None:
    """Marker and error bars of a method: filled on the front."""
    result, statistic = point.result, point.result.metrics[metric.key]
    color, kind = _style(point.family)
    bars = [((point.x, point.x), (statistic.low, statistic.high))]
    if cost == "seconds_per_megapixel" and result.spread and result.spread[0] > 0:
        bars.append((result.spread, (point.y, point.y)))
    for xs, ys in bars:
        if all(math.isfinite(y) and (y > 0 or not metric.logarithmic) for y in ys):
            axes.plot(xs, ys, color=color, linewidth=0.9, alpha=0.6, gid=f"bar-{point.index}")
    axes.plot(
        [point.x],
        [point.y],
        linestyle="none",
        marker=kind,
        markersize=8 + point.on_front,
        markerfacecolor=color if point.on_front else "white",
        markeredgecolor="white" if point.on_front else color,
        markeredgewidth=0.8 if point.on_front else 1.4,
        zorder=4 if point.on_front else 3,
        clip_on=False,
        gid=f"point-{point.index}",
    )


def _draw_front(axes: Axes, points: Sequence[_Point]) -> None:
    front = sorted((p.x, p.y) for p in points if p.on_front)
    if front:
        xs, ys = zip(*front, (axes.get_xlim()[1], front[-1][1]), strict=True)
        axes.step(xs, ys, where="post", color="black", linewidth=1.1, alpha=0.8, zorder=2)


def _draw_labels(figure: Figure, axes: Axes, points: Sequence[_Point], metric: Metric) -> None:
    """Names of all points, the front's first, where it is crowded farther off with a line to the point."""
    figure.draw_without_rendering()
    figure.set_layout_engine("none")  # labels do not move the axes
    taken = [Bbox.from_bounds(x - 6, y - 6, 12, 12) for x, y in (axes.transData.transform((p.x, p.y)) for p in points)]
    frame = Bbox.from_extents(0, axes.bbox.y0, figure.bbox.width, figure.bbox.height)
    for p in sorted(points, key=lambda p: (not p.on_front, p.x)):
        name = " ".join(p.result.name.split())
        if p.y != (mean := p.result.metrics[metric.key].mean):
            name += f" {format_value(mean, metric)}, off the scale"
        words = name if len(name) <= 34 else name[:33] + "…"
        weight, color = ("bold", "#222") if p.on_front else ("normal", "#555")
        text = axes.annotate(words, (p.x, p.y), (0, 0), textcoords="offset points", annotation_clip=False, fontsize=9)
        text.set(weight=weight, color=color, parse_math=False, gid=f"name-{p.index}")
        # The front's line leads to a point from below and from it to the right, so labels above cross it least.
        sides = [(dx, dy) for dy in ((1, 0, -1) if p.on_front else (0, -1, 1)) for dx in (-1, 0, 1) if dx or dy]
        for distance, (dx, dy) in product(range(7, 240, 9), sides):  # in points
            text.set(position=(distance * dx, distance * dy))
            text.set(horizontalalignment={-1: "right", 0: "center", 1: "left"}[dx])
            text.set(verticalalignment={-1: "top", 0: "center", 1: "bottom"}[dy])
            box = text.get_window_extent()
            if np.array_equal(Bbox.union([box, frame]).extents, frame.extents) and not box.count_overlaps(taken):
                break
        taken.append(box)
        if distance > 7:
            start = axes.transData.transform((p.x, p.y))
            end = axes.transData.inverted().transform(start + np.multiply(text.get_position(), figure.dpi / 72))
            line = Line2D([p.x, end[0]], [p.y, end[1]], color=color, linewidth=0.5, zorder=1, clip_on=False)
            line.set_gid(f"bar-{p.index}")
            axes.add_artist(line)


def draw_curves(
    results: Sequence[MethodResult], metric: Metric, pair: tuple[str, str] | None, frames: Sequence[int]
) -> Markup | None:
    """Draw a measure over the frames, of all methods in gray and of a pair in color; None below three frames.

    `frames` are the numbers of the frames; a measure of pairs of frames has a value less, at the later one.
    """
    drawn = [r for r in results if metric.key in r.metrics and r.family != INPUT_FAMILY]
    series = {r.name: r.metrics[metric.key].values for r in drawn}
    length = max(map(len, series.values()), default=0)
    if length < 3:
        return None
    figure = Figure(figsize=(WIDTH, 2.6), facecolor="none", layout="constrained")
    axes = figure.add_subplot(facecolor="none")
    _set_measure_axis(axes, metric)
    named = len(frames) - length in (0, 1)
    numbers = frames[-length:] if named else range(1, length + 1)
    lines = sorted((name for name in series if len(series[name]) == length), key=lambda name: name in (pair or ()))
    for name in lines:
        color = COLORS[(pair or ()).index(name)] if name in (pair or ()) else "#88888866"
        axes.plot(numbers, series[name], color=color, linewidth=1.6 if name in (pair or ()) else 0.8)
        if name in (pair or ()):
            place = 1.01, 0.9 - 0.12 * (pair or ()).index(name)
            axes.text(*place, name, transform=axes.transAxes, color=color, fontsize=9, parse_math=False)
    axes.xaxis.set_major_locator(MaxNLocator(integer=True))
    axes.set_xlabel("frame" if named else "frames in their order, from 1", loc="right")
    return to_svg(figure, f"curve-{metric.key}")


def draw_ladder(ladder: Ladder) -> Figure | None:
    """Draw error against samples per pixel, both logarithmic, one panel for each measure; None without a curve."""
    metrics = [m for m in METRICS if m.key in ladder]
    if not metrics:
        return None
    names = list(dict.fromkeys(name for m in metrics for name in ladder[m.key]))
    height = 4.0 + LEGEND_ROW * -(-len(names) // 5)
    figure = Figure(figsize=(WIDTH, height), facecolor="none", layout="constrained")
    panels = figure.subplots(1, len(metrics), squeeze=False)[0]
    for metric, axes in zip(metrics, panels, strict=True):
        axes.set_facecolor("none")
        counts = sorted({n for curve in ladder[metric.key].values() for n, _ in curve})
        for name, curve in ladder[metric.key].items():
            color, kind = _style(names.index(name))
            style = "--" if name == INPUT else "-"
            axes.plot(*zip(*curve, strict=True), color=color, marker=kind, markersize=6.4, linestyle=style)
        axes.set(xscale="log", yscale="log")
        if metric.key not in ERRORS:  # the range of FLIP seldom has a power of ten
            _set_plain_ticks(axes)
        axes.set_xticks(counts, [f"{n:g}" for n in counts])
        axes.xaxis.minorticks_off()
        axes.set_xlabel("samples per pixel →", loc="right")
        axes.yaxis.set_inverted(True)  # better is up on every chart
        axes.set_title(f"{ERRORS.get(metric.key, metric.label)}, better ↑", loc="left", fontsize=11)
        axes.grid(color="#88888833", linewidth=0.8)
        axes.tick_params(which="both", length=0, labelcolor="#555")
        axes.spines[["top", "left", "right"]].set_visible(False)
    _draw_legend(figure, names, columns=5, lines=True)
    return figure


def _style(index: int) -> tuple[str, str]:
    """Color and marker, by the index of a family or of a method."""
    return COLORS[index % len(COLORS)], MARKERS[index % len(MARKERS)]


def _draw_legend(figure: Figure, names: Sequence[str], columns: int, *, lines: bool = False) -> None:
    handles = []
    for i, name in enumerate(names):
        color, kind = _style(i)
        handle = Line2D([], [], color=color, marker=kind, markersize=8)
        handle.set_linestyle("" if not lines else "--" if name == INPUT else "-")
        handles.append(handle)
    legend = figure.legend(handles, ["-"] * len(names), loc="outside lower left", ncols=columns, frameon=False)
    for text, name in zip(legend.get_texts(), names, strict=True):  # given as labels, names with a leading "_" are lost
        text.set(text=" ".join(name.split()), parse_math=False, fontsize=9)


def to_svg(figure: Figure, prefix: str) -> Markup:
    """Return the chart as an SVG element for a page, on which the prefix of its ids is its own."""
    out = io.StringIO()
    for artist in figure.findobj(lambda artist: artist.get_gid() is not None):
        artist.set_gid(f"{prefix}-{artist.get_gid()}")
    with rc_context({"svg.fonttype": "none", "svg.hashsalt": prefix}):
        figure.savefig(out, format="svg", metadata=dict.fromkeys(("Creator", "Date", "Format", "Type")))
    text = out.getvalue()
    # An element of an HTML page needs no namespaces.
    return Markup(re.sub(r' xmlns(:\w+)?="[^"]*"', "", text[text.index("<svg") :]))


def to_png(figure: Figure) -> bytes:
    """Return the chart as a PNG file on white, 1600 pixels wide."""
    out = io.BytesIO()
    with warnings.catch_warnings():
        warnings.filterwarnings("ignore", "Glyph")  # names may hold letters that matplotlib's font lacks
        figure.savefig(out, format="png", dpi=PNG_DPI, facecolor="white")
    return out.getvalue()


def marker(family: int) -> str:
    """Return the points of an SVG polygon with the marker of a family, by its index, around the origin."""
    style = MarkerStyle(_style(family)[1])
    path = style.get_path().transformed(style.get_transform() + Affine2D().scale(13, -13))
    return " ".join(f"{x:.2f},{y:.2f}" for x, y in np.asarray(path.to_polygons()[0]))
