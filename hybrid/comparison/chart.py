"""The chart of a measure against what it costs, laid out once and drawn twice: as SVG for the page, and as PNG."""

from __future__ import annotations

import math
from collections.abc import Callable, Sequence
from dataclasses import dataclass, replace
from functools import cache
from itertools import pairwise

from font_manrope import font_files
from markupsafe import Markup
from PIL import ImageFont
from resvg_py import svg_to_bytes

from hybrid.comparison.page import render
from hybrid.comparison.results import COSTS, Cost, MethodResult, Metric, pareto_front
from hybrid.comparison.tables import format_bytes, format_seconds

WIDTH, HEIGHT = 1000, 540
LEFT, RIGHT, TOP, BOTTOM = 66, 20, 30, 484  # the plot's box, gutters included; RIGHT counts from the edge
GUTTER = 76  # beside the axis, for methods whose cost is nothing or not known
FONT = 13
FONTS = {400: "Manrope", 600: "ManropeSemiBold"}  # by weight: the files of font_manrope
SCALE = 1.6  # of the PNG against the units above
RADIUS = 6.5

# Okabe and Ito's palette, which people with any common colour blindness tell apart, without its yellow, which no
# one sees on white. Seven colours and nine shapes: families repeat neither until the 64th.
COLORS = ("#0072b2", "#d55e00", "#009e73", "#cc79a7", "#e69f00", "#56b4e9", "#6b6b6b")


def _star(points: int, inner: float, turn: float = 0.0) -> tuple[tuple[float, float], ...]:
    """A star around the origin, or a polygon where `inner` is 0 (no inner corners)."""
    corners = []
    for i in range(points):
        for radius, angle in ((1.0, i), (inner, i + 0.5)):
            if radius:
                a = 2 * math.pi * (angle / points + turn) - math.pi / 2
                corners.append((radius * math.cos(a), radius * math.sin(a)))
    return tuple(corners)


def _scaled(shape: tuple[tuple[float, float], ...], by: float) -> tuple[tuple[float, float], ...]:
    return tuple((x * by, y * by) for x, y in shape)


# Of about equal area, so that no family looks more important.
SHAPES = (
    _star(32, 0),  # circle
    _scaled(_star(4, 0, 1 / 8), 1.22),  # square
    _scaled(_star(3, 0), 1.42),  # triangle
    _scaled(_star(4, 0), 1.3),  # diamond
    _scaled(_star(5, 0.5), 1.45),  # star
    _scaled(_star(3, 0, 1 / 2), 1.42),  # triangle, point down
    _scaled(_star(4, 0.42, 1 / 8), 1.5),  # cross
    _scaled(_star(6, 0), 1.1),  # hexagon
    _scaled(_star(4, 0.42), 1.5),  # plus
)


@dataclass(frozen=True)
class Point:
    """A method on the chart: where it is, how far its bars reach, and whether anything beats it."""

    result: MethodResult
    x: float
    y: float
    bar_x: tuple[float, float] | None
    bar_y: tuple[float, float] | None
    family: int
    on_front: bool
    label: tuple[float, float, str] | None = None  # x of its left end, baseline, text

    @property
    def size(self) -> float:
        """Radius of the marker: less for points of a sweep; the edge of a filled one has the paper's color."""
        return RADIUS * (0.72 if self.result.sweep else 1) + self.on_front


@dataclass(frozen=True)
class Chart:
    """A chart laid out: everything in units of the picture, y down."""

    metric: Metric
    cost: Cost
    box: tuple[float, float, float, float]  # left, top, right, bottom of the axes
    ticks_x: list[tuple[float, str]]
    ticks_y: list[tuple[float, str]]
    gutters: Sequence[tuple[float, float, str]]  # left, right, title
    points: list[Point]
    front: list[tuple[float, float]]
    series: list[tuple[int, list[tuple[float, float]]]]  # family and places of what varies one number
    families: list[str]


def families(results: Sequence[MethodResult]) -> list[str]:
    """Name the families in their order, which decides on colour and shape."""
    return list(dict.fromkeys(r.family for r in results if r.absent_reason is None))


def lay_out(results: Sequence[MethodResult], metric: Metric, cost: Cost) -> Chart | None:
    """Lay out the chart of a metric against a cost.

    Parameters
    ----------
    results : sequence of MethodResult
        Those without the figure are left out.
    metric : Metric
        Up the chart: better is always up, so the axis of an error points down.
    cost : str
        One of `COSTS`, across the chart, logarithmic.

    Returns
    -------
    Chart, optional
        None where no method has a finite figure.
    """
    drawn = [r for r in results if metric.key in r.metrics and math.isfinite(r.metrics[metric.key].mean)]
    if metric.logarithmic:
        drawn = [r for r in drawn if r.metrics[metric.key].mean > 0]
    if not drawn:
        return None
    costs = {r.name: getattr(r, cost) for r in drawn}
    known = [c for c in costs.values() if c]
    free = any(c == 0 for c in costs.values())
    unknown = any(c is None for c in costs.values())
    left = LEFT + (GUTTER if free else 0)
    right = WIDTH - RIGHT - (GUTTER if unknown else 0)
    x_of, ticks_x = _log_axis(known or [1.0], left, right, format_seconds if cost != "peak_bytes" else _memory)
    y_of, ticks_y = _value_axis([r.metrics[metric.key].mean for r in drawn], metric)

    def across(result: MethodResult) -> float:
        spent = costs[result.name]
        if spent is None:
            return right + GUTTER / 2
        return x_of(spent) if spent else LEFT + GUTTER / 2

    front = pareto_front(results, metric, cost)
    names = families(results)
    points = []
    for r in drawn:
        s = r.metrics[metric.key]
        spread = r.spread if cost == "seconds_per_megapixel" and costs[r.name] else None
        ends = [v for v in (s.low, s.high) if math.isfinite(v) and (v > 0 or not metric.logarithmic)]
        points.append(
            Point(
                r,
                across(r),
                y_of(s.mean),
                (x_of(spread[0]), x_of(spread[1])) if spread and spread[0] > 0 else None,
                (_within(y_of(ends[0])), _within(y_of(ends[1]))) if len(ends) == 2 else None,
                names.index(r.family),
                r.name in front,
            )
        )
    by_name = {p.result.name: p for p in points}
    steps: list[tuple[float, float]] = []
    for p in (by_name[name] for name in front if name in by_name):
        steps += [(p.x, steps[-1][1]), (p.x, p.y)] if steps else [(p.x, p.y)]
    if steps:
        steps.append((right, steps[-1][1]))
    gutters = [(LEFT, LEFT + GUTTER, "nothing")] if free else []
    gutters += [(right, right + GUTTER, "not known")] if unknown else []
    return Chart(
        metric,
        cost,
        (left, TOP, right, BOTTOM),
        ticks_x,
        ticks_y,
        gutters,
        _labelled(points, steps),
        steps,
        _series(points),
        names,
    )


def _series(points: Sequence[Point]) -> list[tuple[int, list[tuple[float, float]]]]:
    """A line through the points of each sweep that varies one number."""
    groups: dict[tuple[str, str], list[Point]] = {}
    for p in points:
        if p.result.sweep:
            groups.setdefault((p.result.sweep, p.result.base), []).append(p)
    lines = []
    for group in groups.values():
        settings = [list(p.result.settings.items()) for p in group]
        if len({pairs[0][0] for pairs in settings if pairs}) == 1 and all(len(pairs) == 1 for pairs in settings):
            values = [pairs[0][1] for pairs in settings]
            if all(isinstance(v, (int, float)) for v in values):
                ordered = sorted(zip(values, group, strict=True), key=lambda pair: float(str(pair[0])))
                lines.append((group[0].family, [(p.x, p.y) for _, p in ordered]))
    return lines


def _memory(value: float) -> str:
    return format_bytes(int(value))


def _within(y: float) -> float:
    return min(max(y, TOP), BOTTOM)


def _log_axis(
    values: Sequence[float], start: float, end: float, text: Callable[[float], str]
) -> tuple[Callable[[float], float], list[tuple[float, str]]]:
    """A logarithmic scale with some room around the values, and its ticks at 1, 2 and 5 (or 1) × 10ⁿ."""
    unit = 2.0**20 if text is _memory else 1.0
    low, high = math.log10(min(values) / unit), math.log10(max(values) / unit)
    room = max(0.06 * (high - low), 0.12)
    low, high = low - room, high + room

    def position(value: float) -> float:
        return start + (math.log10(value / unit) - low) / (high - low) * (end - start)

    steps = (1, 2, 5) if high - low < 3.2 else (1,)
    marks = [s * 10.0**n for n in range(math.floor(low), math.ceil(high) + 1) for s in steps]
    return position, [(position(m * unit), text(m * unit)) for m in marks if low <= math.log10(m) <= high]


def _value_axis(values: Sequence[float], metric: Metric) -> tuple[Callable[[float], float], list[tuple[float, str]]]:
    """The scale of a measure, better up, and its ticks."""
    numbers = [math.log10(v) for v in values] if metric.logarithmic else list(values)
    low, high = min(numbers), max(numbers)
    room = max(0.08 * (high - low), 1e-3 * max(abs(high), abs(low)), 1e-9)
    low, high = low - room, high + room
    up = metric.better == "higher"

    def position(value: float) -> float:
        share = ((math.log10(value) if metric.logarithmic else value) - low) / (high - low)
        return BOTTOM - (share if up else 1 - share) * (BOTTOM - TOP)

    if metric.logarithmic:
        decades = range(math.floor(low), math.ceil(high) + 1)
        marks = [s * 10.0**n for n in decades for s in ((1, 2, 5) if high - low < 3.2 else (1,))]
        marks = [m for m in marks if low <= math.log10(m) <= high]
        return position, [(position(m), f"{m:g}") for m in marks]
    rough = (high - low) / 7
    scale = 10.0 ** math.floor(math.log10(rough))
    step = next(s * scale for s in (1, 2, 5, 10) if s * scale >= rough)
    digits = max(0, -math.floor(math.log10(step)))
    marks = [i * step for i in range(math.ceil(low / step), math.floor(high / step) + 1)]
    return position, [(position(m), f"{m:.{digits}f}".replace("-", "−")) for m in marks]


def _labelled(points: list[Point], front: Sequence[tuple[float, float]]) -> list[Point]:
    """Give names to as many points as have room for one, those on the front first; off the front's line if possible.

    Points of a sweep are named only on the front: their neighbours differ in one setting that hovering tells.
    """
    taken = [(p.x - 8, p.y - 8, p.x + 8, p.y + 8) for p in points]
    lines = [(a[0], min(a[1], b[1]), b[0], max(a[1], b[1])) for a, b in pairwise(front)]
    labels: dict[str, tuple[float, float, str]] = {}
    for p in sorted(points, key=lambda p: (not p.on_front, p.result.sweep, p.x)):
        if p.result.sweep and not p.on_front:
            continue
        text = p.result.label if len(p.result.label) <= 34 else p.result.label[:33] + "…"
        wide = _text_width(text, 600 if p.on_front else 400)
        ends = p.bar_x or (p.x, p.x)
        sides = (
            (max(p.x + 12, ends[1] + 5), p.y + 4.5),
            (min(p.x - 12, ends[0] - 5) - wide, p.y + 4.5),
            (p.x - wide / 2, p.y - 13),
            (p.x - wide / 2, p.y + 23),
            (p.x + 9, p.y - 9),
            (p.x + 9, p.y + 19),
            (p.x - 9 - wide, p.y - 9),
            (p.x - 9 - wide, p.y + 19),
        )
        free = []
        for x, y in sides:
            box = (x - 2, y - FONT, x + wide + 2, y + 4)
            outside = box[0] < LEFT or box[2] > WIDTH - 2 or box[1] < TOP - FONT or box[3] > BOTTOM
            if not outside and not any(_overlap(box, other) for other in taken):
                free.append((sum(_overlap(box, line) for line in lines), x, y, box))
        if free:
            _, x, y, box = min(free, key=lambda place: place[0])  # the first of the best
            taken.append(box)
            labels[p.result.name] = (x, y, text)
    return [replace(p, label=labels.get(p.result.name)) for p in points]


def _overlap(a: tuple[float, ...], b: tuple[float, ...]) -> bool:
    return a[0] < b[2] and b[0] < a[2] and a[1] < b[3] and b[1] < a[3]


def _text_width(text: str, weight: int = 400) -> float:
    """The width of a text of the chart's size."""
    return _font(weight).getlength(text) / 10


@cache
def _font(weight: int) -> ImageFont.FreeTypeFont:
    """A font ten times as large as the chart's: Pillow rounds what it measures to 1/64 pixel."""
    return ImageFont.truetype(font_files[FONTS[weight]], 10 * FONT)


def to_svg(chart: Chart) -> Markup:
    """Draw as an SVG element, which the page's style sheet colors.

    Each point is an element of class ``point`` that can have focus and says its method in ``data-name``.
    """
    return render(
        "chart.svg",
        chart=chart,
        costs=COSTS,
        width=WIDTH,
        height=HEIGHT,
        axis_left=LEFT,
        axis_right=WIDTH - RIGHT,
        colors=len(COLORS),
        marker=marker,
    )


def marker(family: int, size: float = RADIUS) -> str:
    """Give the corners of a family's marker around the origin.

    Parameters
    ----------
    family : int
        Index of the family.
    size : float
        Radius, in units of the chart.

    Returns
    -------
    str
        The points of an SVG polygon.
    """
    return " ".join(f"{x * size:.2f},{y * size:.2f}" for x, y in SHAPES[family % len(SHAPES)])


def to_png(chart: Chart) -> bytes:
    """Draw as a PNG file on white, 1600 pixels wide, with a legend of the families below."""
    legend = _lay_out_legend(chart.families)
    height = round(HEIGHT + 36 + legend[-1][1] - legend[0][1])
    picture = render(
        "picture.svg",
        width=WIDTH,
        height=height,
        colors=COLORS,
        drawing=to_svg(chart),
        legend=legend,
        radius=RADIUS,
        marker=marker,
    )
    # Fonts of the system stand in for letters that ours lacks.
    return svg_to_bytes(picture, zoom=SCALE, font_files=[font_files[name] for name in FONTS.values()])


def _lay_out_legend(names: Sequence[str]) -> list[tuple[float, float, int, str]]:
    """(x, y, family, name) of each marker, as many in a row as there is room for."""
    places = []
    x, y = LEFT + RADIUS, HEIGHT + 14.0
    for family, name in enumerate(names):
        wide = 3 * RADIUS + _text_width(name) + 22
        if x > LEFT + RADIUS and x + wide > WIDTH:
            x, y = LEFT + RADIUS, y + 24
        places.append((x, y, family, name))
        x += wide
    return places
