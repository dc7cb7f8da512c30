"""The chart of a measure against what it costs, laid out once and drawn twice: as SVG and as pixels."""

from __future__ import annotations

import math
from collections.abc import Callable, Sequence
from dataclasses import dataclass
from itertools import pairwise

import cv2
import numpy as np
from markupsafe import Markup
from numpy.typing import NDArray

from hybrid.comparison.page import render
from hybrid.comparison.results import (
    COSTS,
    Cost,
    MethodResult,
    Metric,
    column_title,
    format_bytes,
    format_seconds,
    pareto_front,
)

WIDTH, HEIGHT = 1000, 540
LEFT, RIGHT, TOP, BOTTOM = 66, 20, 30, 484  # the plot's box, gutters included; RIGHT counts from the edge
GUTTER = 76  # beside the axis, for methods whose cost is nothing or not known
FONT = 13
HAS_FONTS = hasattr(cv2, "FontFace")  # OpenCV 5; before it only Hershey's strokes
HERSHEY_HEIGHT = 32.0  # pixels of a line at scale 1
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
    """Lay out the chart of a metric against a cost; None where no method has a finite figure.

    The cost axis is logarithmic. Better is always up, so the axis of an error points down.
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
    return [
        Point(p.result, p.x, p.y, p.bar_x, p.bar_y, p.family, p.on_front, labels.get(p.result.name)) for p in points
    ]


def _overlap(a: tuple[float, ...], b: tuple[float, ...]) -> bool:
    return a[0] < b[2] and b[0] < a[2] and a[1] < b[3] and b[1] < a[3]


def _text_width(text: str, weight: int = 400) -> float:
    """The width of a text of the chart's size; measured ten times as large, since OpenCV rounds to pixels."""
    if HAS_FONTS:
        return cv2.getTextSize((1, 1), text, (0, 0), cv2.FontFace("sans"), 10 * FONT, weight)[2] / 10
    return cv2.getTextSize(text, cv2.FONT_HERSHEY_DUPLEX, 10 * FONT / HERSHEY_HEIGHT, 1)[0][0] / 10


# As SVG


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
    """The corners of a family's marker around the origin, as the points of an SVG polygon."""
    return " ".join(f"{x * size:.2f},{y * size:.2f}" for x, y in SHAPES[family % len(SHAPES)])


# As pixels

SCALE = 1.6  # of the finished picture against the units above
FINE = 2  # drawn so much larger, then averaged: OpenCV's own anti-aliasing is for thin lines only
INK, FAINT, RULE, PAPER = "#1d1d1f", "#6e6e73", "#e4e4e7", "#ffffff"


def to_pixels(chart: Chart) -> NDArray[np.uint8]:
    """Draw as (H, W, 3) BGR on white, 1600 pixels wide, with a legend of the families below."""
    rows = _legend_rows(chart.families)
    tall = HEIGHT + 12 + 24 * len(rows)
    zoom = SCALE * FINE
    canvas = np.full((round(tall * zoom), round(WIDTH * zoom), 3), 255, np.uint8)
    _, top, right, bottom = chart.box

    def line(a: tuple[float, float], b: tuple[float, float], color: str, width: float = 1.0) -> None:
        cv2.line(canvas, _pixel(a, zoom), _pixel(b, zoom), _bgr(color), max(1, round(width * zoom)), cv2.LINE_AA)

    def text(x: float, y: float, words: str, color: str, weight: int = 400, anchor: float = 0.0) -> None:
        x -= anchor * _text_width(words, weight)
        at, size = _pixel((x, y), zoom), FONT * zoom
        if HAS_FONTS:
            cv2.putText(canvas, words, at, _bgr(color), cv2.FontFace("sans"), round(size), weight)
        else:
            thick, size = round(zoom / 2), size / HERSHEY_HEIGHT
            cv2.putText(canvas, words, at, cv2.FONT_HERSHEY_DUPLEX, size, _bgr(color), thick, cv2.LINE_AA)

    def mark(x: float, y: float, family: int, filled: bool, size: float) -> None:
        shape = np.array(SHAPES[family % len(SHAPES)]) * size + (x, y)
        corners = np.rint(shape * zoom * 16).astype(np.int32)
        color = COLORS[family % len(COLORS)]
        cv2.fillPoly(canvas, [corners], _bgr(color if filled else PAPER), cv2.LINE_AA, 4)
        edge = PAPER if filled else color
        cv2.polylines(canvas, [corners], True, _bgr(edge), round(1.6 * zoom), cv2.LINE_AA, 4)

    for start, end, title in chart.gutters:
        box = [_pixel((start, top), zoom), _pixel((end, bottom), zoom)]
        cv2.rectangle(canvas, box[0], box[1], _bgr("#f6f6f7"), -1)
        text((start + end) / 2, bottom + 22, title, FAINT, anchor=0.5)
    for x, words in chart.ticks_x:
        line((x, top), (x, bottom), RULE)
        text(x, bottom + 22, words, FAINT, anchor=0.5)
    for y, words in chart.ticks_y:
        line((LEFT, y), (WIDTH - RIGHT, y), RULE)
        text(LEFT - 10, y + 4.5, words, FAINT, anchor=1)
    line((LEFT, bottom), (WIDTH - RIGHT, bottom), INK, 1.2)
    text(2, 14, f"{column_title(chart.metric)}, better ↑", INK, 600)
    text(right, bottom + 46, f"{COSTS[chart.cost]} →", INK, 600, anchor=1)
    for family, points in chart.series:
        for a, b in pairwise(points):
            line(a, b, COLORS[family % len(COLORS)], 0.8)
    for a, b in pairwise(chart.front):
        line(a, b, INK, 1.4)
    for p in sorted(chart.points, key=lambda p: (p.on_front, p.x)):
        if p.bar_x:
            line((p.bar_x[0], p.y), (p.bar_x[1], p.y), COLORS[p.family % len(COLORS)])
        if p.bar_y:
            line((p.x, p.bar_y[0]), (p.x, p.bar_y[1]), COLORS[p.family % len(COLORS)])
        mark(p.x, p.y, p.family, p.on_front, p.size)
        if p.label:
            text(*p.label, INK if p.on_front else FAINT, 600 if p.on_front else 400)
    for k, row in enumerate(rows):
        for x, family in row:
            y = HEIGHT + 14 + 24 * k
            mark(x + RADIUS, y, family, True, RADIUS + 1)
            text(x + 3 * RADIUS, y + 4.5, chart.families[family], FAINT)
    size = (round(WIDTH * SCALE), round(tall * SCALE))
    return np.asarray(cv2.resize(canvas, size, interpolation=cv2.INTER_AREA), np.uint8)


def _legend_rows(names: Sequence[str]) -> list[list[tuple[float, int]]]:
    """Rows of (x, family), as many families in each as there is room for."""
    rows: list[list[tuple[float, int]]] = [[]]
    x = float(LEFT)
    for family, name in enumerate(names):
        wide = 3 * RADIUS + _text_width(name) + 22
        if rows[-1] and x + wide > WIDTH:
            rows.append([])
            x = float(LEFT)
        rows[-1].append((x, family))
        x += wide
    return rows


def _pixel(at: tuple[float, float], zoom: float) -> tuple[int, int]:
    return round(at[0] * zoom), round(at[1] * zoom)


def _bgr(color: str) -> tuple[int, int, int]:
    red, green, blue = (int(color[i : i + 2], 16) for i in (1, 3, 5))
    return blue, green, red
