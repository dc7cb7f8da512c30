"""The chart: axes, labels, markers and lines, and its two drawings."""

# ruff: noqa: E402 - skipped by name without the extra `compare`

from __future__ import annotations

import math
import xml.etree.ElementTree as ElementTree
from dataclasses import replace

import cv2
import numpy as np
import pytest

for _package in ("jinja2", "resvg_py", "font_manrope"):
    pytest.importorskip(_package)

from hybrid.comparison import chart
from hybrid.comparison.results import Metric
from tests.hybrid.comparison.outcomes import EVIL, PSNR, RELMSE, RESULTS, SECONDS, SWEPT, result, swept


def at(layout: chart.Chart, name: str) -> chart.Point:
    return next(p for p in layout.points if p.result.name == name)


@pytest.mark.parametrize("metric", [PSNR, RELMSE])
def test_better_is_up_dearer_is_right_and_the_axis_is_logarithmic(metric: Metric) -> None:
    layout = chart.lay_out([*RESULTS, result("ten", 20.0, 0.02), result("eleven", 20.0, 20.0)], metric, SECONDS)
    assert layout is not None
    assert at(layout, "final").y < at(layout, "average").y < at(layout, "noisy").y
    a, b, c = (at(layout, n).x for n in ("ten", "average", "slow"))
    assert b - a == pytest.approx(c - b)  # 0.02, 0.2, 2
    assert at(layout, "noisy").x < layout.box[0]  # costs nothing: beside a logarithmic axis
    assert at(layout, "other").x > layout.box[2]  # not known
    assert [p.result.name for p in layout.points if p.on_front][-1] == "final"


def test_labels_lie_inside_and_never_on_each_other() -> None:
    rng = np.random.default_rng(3)
    crowd = [result(f"method {i:02d}", float(rng.uniform(28, 32)), float(rng.uniform(0.5, 3))) for i in range(30)]
    layout = chart.lay_out(crowd, PSNR, SECONDS)
    assert layout is not None
    boxes = []
    for p in layout.points:
        if p.label:
            x, y, text = p.label
            boxes.append((x, y - 10, x + chart._text_width(text), y + 2))
    assert len(boxes) >= 5
    assert all(b[0] >= 0 and b[2] <= chart.WIDTH for b in boxes)
    assert not any(chart._overlap(a, b) for i, a in enumerate(boxes) for b in boxes[:i])


def pixels_of(layout: chart.Chart) -> np.ndarray:
    """The PNG as red, green and blue."""
    return cv2.imdecode(np.frombuffer(chart.to_png(layout), np.uint8), cv2.IMREAD_COLOR)[..., ::-1]


def test_families_differ_in_shape_and_colour_and_dominated_points_are_hollow() -> None:
    pairs = {(i % len(chart.COLORS), i % len(chart.SHAPES)) for i in range(63)}
    assert len(pairs) == 63
    layout = chart.lay_out(RESULTS, PSNR, SECONDS)
    assert layout is not None
    pixels = pixels_of(layout)
    for name, filled in (("final", True), ("slow", False)):
        p = at(layout, name)
        color = "#" + pixels[round(p.y * chart.SCALE), round(p.x * chart.SCALE)].tobytes().hex()
        assert color == (chart.COLORS[p.family] if filled else "#ffffff")


def test_the_picture_has_text_of_our_own_font_whatever_the_system_has() -> None:
    layout = chart.lay_out(RESULTS, PSNR, SECONDS)
    assert layout is not None
    pixels = pixels_of(layout)
    assert pixels.shape[1] == 1600
    title = pixels[: round(20 * chart.SCALE)]
    inked = np.flatnonzero(title.max(axis=-1).min(axis=0) < 128) / chart.SCALE
    # From 2 pixels off the edge to where the font says; what is blank around a letter, or the arrow, is below 4 pixels.
    assert 2 <= inked[0] < 6
    assert inked[-1] == pytest.approx(2 + chart._text_width("PSNR (dB), better ↑", 600), abs=4)
    assert chart._text_width("PSNR", 600) > chart._text_width("PSNR", 400)


def test_the_legend_has_every_family_and_as_many_rows_as_it_takes() -> None:
    names = [f"a family with a long name, number {i}" for i in range(9)]
    places = chart._lay_out_legend(names)
    assert [(family, name) for _, _, family, name in places] == list(enumerate(names))
    assert len({y for _, y, *_ in places}) > 1
    assert all(x + 2 * chart.RADIUS + chart._text_width(name) <= chart.WIDTH for x, _, _, name in places)
    crowd = [result(name, 30.0 + i, 1.0 + i, family=name) for i, name in enumerate(names)]
    layout, small = chart.lay_out(crowd, PSNR, SECONDS), chart.lay_out(crowd[:1], PSNR, SECONDS)
    assert layout is not None
    assert small is not None
    assert pixels_of(layout).shape[0] > pixels_of(small).shape[0]


def test_a_line_joins_what_varies_one_number_in_its_order() -> None:
    layout = chart.lay_out([*SWEPT, swept("window 5", [33.0, 33.1, 33.2], 3.6, window=5)], PSNR, SECONDS)
    assert layout is not None
    ((family, line),) = layout.series  # stages are no numbers
    assert chart.families(SWEPT)[family] == "Methods"
    assert line == [(at(layout, n).x, at(layout, n).y) for n in ("window 1", "window 3", "window 5")]


def test_svg_is_well_formed_whatever_the_names_are() -> None:
    layout = chart.lay_out([replace(RESULTS[3], label=EVIL, name='"><b'), RESULTS[1]], PSNR, SECONDS)
    assert layout is not None
    tree = ElementTree.fromstring(chart.to_svg(layout))
    points = [e for e in tree.iter() if "point" in e.get("class", "").split()]
    assert [e.get("data-name") for e in points] == ["average", '"><b']
    assert EVIL in points[1].get("aria-label", "")


def test_a_chart_of_nothing_finite_is_none() -> None:
    assert chart.lay_out([result("a", [math.inf, math.inf], 1.0)], PSNR, SECONDS) is None
