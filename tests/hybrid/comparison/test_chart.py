# ruff: noqa: E402 - skipped by name without the extra `compare`

import math
import xml.etree.ElementTree as ElementTree
from dataclasses import replace

import cv2
import numpy as np
import pytest

for _package in ("jinja2", "matplotlib"):
    pytest.importorskip(_package)

from matplotlib.figure import Figure
from matplotlib.lines import Line2D
from matplotlib.text import Text

from hybrid.comparison import chart
from hybrid.comparison.results import MethodResult, Metric
from tests.hybrid.comparison.outcomes import EVIL, PSNR, RELMSE, RESULTS, SECONDS, result


def draw(results: tuple[MethodResult, ...] | list[MethodResult], metric: Metric = PSNR) -> Figure:
    figure = chart.draw_chart(results, metric, SECONDS)
    assert figure is not None
    figure.draw_without_rendering()
    return figure


def lines(figure: Figure, kind: str) -> dict[int, Line2D]:
    """The lines named ``kind-number``, by number."""
    named = [line for line in figure.axes[0].lines if (line.get_gid() or "").startswith(f"{kind}-")]
    return {int(str(line.get_gid()).split("-")[1]): line for line in named}


def pixel_of(figure: Figure, index: int) -> tuple[float, float]:
    """Where a point is, in dots from the bottom left."""
    ((x, y),) = figure.axes[0].transData.transform(lines(figure, "point")[index].get_xydata())
    return x, y


@pytest.mark.parametrize("metric", [PSNR, RELMSE])
def test_better_is_up_dearer_is_right_and_the_axis_is_logarithmic(metric: Metric) -> None:
    figure = draw([*RESULTS, result("ten", 20.0, 0.02), result("eleven", 20.0, 20.0)], metric)
    at = {r.name: pixel_of(figure, i) for i, r in enumerate(RESULTS[:5])}
    ten, eleven = pixel_of(figure, 6), pixel_of(figure, 7)
    assert at["final"][1] > at["average"][1] > at["noisy"][1]
    assert figure.axes[0].get_title(loc="left").endswith("better ↑")
    assert figure.axes[0].get_xlabel().startswith("← better")
    assert at["average"][0] - ten[0] == pytest.approx(at["slow"][0] - at["average"][0])  # 0.02, 0.2, 2
    assert at["noisy"][0] < ten[0] < eleven[0] < at["other"][0]  # costs nothing; unknown
    assert [tick.get_text() for tick in figure.axes[0].get_xticklabels()][-2:] == ["nothing", "unknown"]


def test_a_ladder_is_drawn_on_logarithmic_axes_from_its_errors() -> None:
    curve = ((8, 0.4), (32, 0.1), (128, 0.05))
    figure = chart.draw_ladder({"psnr": {"noisy": curve, "_ours": curve[:2]}, "flip": {"_ours": curve}})
    assert figure is not None
    assert [axes.get_title(loc="left") for axes in figure.axes] == ["Squared error, better ↑", "FLIP, better ↑"]
    first, second = figure.axes
    assert (first.get_xscale(), first.get_yscale()) == ("log", "log")
    assert first.yaxis_inverted()
    assert [tick.get_text() for tick in first.get_xticklabels()] == ["8", "32", "128"]
    np.testing.assert_array_equal(first.lines[0].get_xydata(), curve)
    assert first.lines[1].get_color() == second.lines[0].get_color() != first.lines[0].get_color()
    assert [text.get_text() for text in figure.legends[0].get_texts()] == ["noisy", "_ours"]
    assert chart.draw_ladder({}) is None


def test_every_point_is_named_inside_and_never_on_another_name() -> None:
    """Most of a crowd were not."""
    rng = np.random.default_rng(3)
    crowd = [result(f"method {i:02d}", float(rng.uniform(28, 32)), float(rng.uniform(0.5, 3))) for i in range(30)]
    figure = draw(crowd)
    labels = [text for text in figure.axes[0].findobj(Text) if (text.get_gid() or "").startswith("name-")]
    boxes = [label.get_window_extent() for label in labels]
    assert len(boxes) == len(crowd)
    assert all(box.x0 >= 0 and box.x1 <= figure.bbox.width for box in boxes)
    assert not any(a.overlaps(b) for i, a in enumerate(boxes) for b in boxes[:i])


def test_families_differ_in_shape_and_colour_and_dominated_points_are_hollow() -> None:
    pairs = {(i % len(chart.COLORS), i % len(chart.MARKERS)) for i in range(63)}
    assert len(pairs) == 63
    figure = draw(RESULTS)
    pixels = cv2.imdecode(np.frombuffer(chart.to_png(figure), np.uint8), cv2.IMREAD_COLOR)[..., ::-1]
    assert pixels.shape[1] == 1600
    for index, expected in ((3, chart.COLORS[1]), (2, "#ffffff")):  # final is on the front, slow is not
        x, y = np.array(pixel_of(figure, index)) * chart.PNG_DPI / figure.dpi
        assert "#" + pixels[pixels.shape[0] - round(y), round(x)].tobytes().hex() == expected


def test_the_front_leads_up_to_its_end() -> None:
    figure = draw(RESULTS)
    (front,) = [line for line in figure.axes[0].lines if line.get_gid() is None]
    heights = [float(y) for y in np.asarray(front.get_ydata())]
    assert heights[1:] == pytest.approx([28, 34, 34])
    # The noisy input, at 22 dB, would press the denoisers together: it is at the edge, and says its value.
    assert heights[0] == pytest.approx(figure.axes[0].get_ylim()[0])
    assert 22 < heights[0] < 28
    (said,) = [text.get_text() for text in figure.axes[0].findobj(Text) if text.get_gid() == "name-0"]
    assert said == "noisy 22.00, off the scale"
    assert front.get_drawstyle() == "steps-post"


def test_curves_over_frames_show_the_pair_in_color() -> None:
    series = [
        result("a", [30.0, 31.0, 29.0], 1),
        result("b", [28.0, 28.5, 28.0], 1),
        result("c", [20.0, 21.0, 22.0], 1),
    ]
    drawing = chart.draw_curves(series, PSNR, ("a", "b"), (1008, 1010, 1012))
    assert drawing is not None
    for number in (1008, 1010, 1012):
        assert f">{number}</text>" in drawing
    assert [drawing.count(color) > 0 for color in chart.COLORS[:3]] == [True, True, False]
    assert chart.draw_curves([result("a", [30.0, 31.0], 1)], PSNR, None, (1, 2)) is None  # too few frames for a curve


def test_the_legend_has_every_family_and_as_many_rows_as_it_takes() -> None:
    names = [f"_a family $number {i}" for i in range(9)]
    crowd = [result(name, 30.0 + i, 1.0 + i, family=name) for i, name in enumerate(names)]
    figure, small = (chart.draw_chart(some, PSNR, SECONDS, legend=True) for some in (crowd, crowd[:1]))
    assert figure is not None
    assert small is not None
    assert [text.get_text() for text in figure.legends[0].get_texts()] == names
    figure.draw_without_rendering()
    box = figure.legends[0].get_window_extent()
    assert box.x0 >= 0 and box.x1 <= figure.bbox.width and box.y0 >= 0  # noqa: PT018
    assert figure.bbox.height > small.bbox.height


def test_svg_is_well_formed_whatever_the_names_are() -> None:
    figure = draw([replace(RESULTS[3], name=EVIL), replace(RESULTS[1], name="$x$ \\frac"), RESULTS[0]])
    text = chart.to_svg(figure, "chart0")
    assert "http" not in text
    tree = ElementTree.fromstring(text.replace("xlink:", ""))
    ids = {element.get("id") for element in tree.iter()}
    assert {"chart0-point-0", "chart0-point-1", "chart0-name-0", "chart0-bar-2"} <= ids
    assert {EVIL[:33] + "…", "$x$ \\frac"} <= {element.text for element in tree.iter()}


def test_charts_of_one_page_share_no_id() -> None:
    first, second = (chart.to_svg(draw(RESULTS), prefix) for prefix in ("chart0", "chart1"))
    ids = [
        {element.get("id") for element in ElementTree.fromstring(text.replace("xlink:", "")).iter("path")} - {None}
        for text in (first, second)
    ]
    assert ids[0]
    assert not ids[0] & ids[1]


def test_a_marker_is_a_polygon_around_the_origin() -> None:
    for family in range(len(chart.MARKERS)):
        corners = np.array([pair.split(",") for pair in chart.marker(family).split()], float)
        assert len(corners) >= 4
        assert np.abs(corners).max() < 11


def test_a_chart_of_nothing_finite_is_none() -> None:
    assert chart.draw_chart([result("a", [math.inf, math.inf], 1.0)], PSNR, SECONDS) is None
