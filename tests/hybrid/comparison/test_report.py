"""The page of a comparison, its chart and its files; in a real browser where there is one."""

from __future__ import annotations

import base64
import csv
import json
import math
import shutil
import xml.etree.ElementTree as ElementTree
import zlib
from collections.abc import Callable, Iterator
from dataclasses import replace
from itertools import pairwise
from pathlib import Path
from typing import Any

import cv2
import numpy as np
import pytest

from hybrid.comparison import chart, embedding
from hybrid.comparison.embedding import ReportImages
from hybrid.comparison.report import check_report, write_report
from hybrid.comparison.results import (
    COSTS,
    METRICS,
    Comparison,
    MethodResult,
    Metric,
    Statistic,
    best_and_ties,
    join,
    markdown_table,
    pareto_front,
    read_comparison,
    stage_values,
    summarize,
)

PSNR, RELMSE = METRICS[0], next(m for m in METRICS if m.key == "relmse")
EVIL = "</script><img src=x onerror='window.pwned=1'> {{data}} & \"q\" | `x`"


def result(name: str, psnr: float | list[float], seconds: float | None, **more: Any) -> MethodResult:
    values = psnr if isinstance(psnr, list) else [psnr - 0.5, psnr, psnr + 0.5]
    metrics = {"psnr": summarize(values), "relmse": summarize([10 ** (-v / 10) for v in values])}
    settings = {"label": name.title(), "seconds_per_megapixel": seconds, "metrics": metrics, **more}
    return MethodResult(name, **settings)


RESULTS = (
    result("noisy", 22.0, 0.0, family="Input"),
    result("average", 28.0, 0.2, peak_bytes=200 << 20),
    result("slow", 27.0, 2.0, peak_bytes=400 << 20),
    result("final", 34.0, 4.0, peak_bytes=600 << 20, worth=14.2, spread=(3.8, 4.3), settings={"window": 5}),
    result("other", 33.0, None, family="External"),
    MethodResult("gone", "Gone", absent_reason="torch is not installed"),
)


# --- who is best ---------------------------------------------------------------------------------------


def test_a_difference_smaller_than_its_scatter_is_a_tie_and_a_steady_one_is_not() -> None:
    base = [30.0, 35.0, 31.0, 36.0, 30.5, 35.5]
    scattered = [b + d for b, d in zip(base, [-0.4, 0.3, -0.3, 0.4, -0.35, 0.3], strict=True)]
    steady = [b - 0.1 for b in base]  # far inside the scatter over frames, but the same on every frame
    best, ties = best_and_ties([result("a", base, 1), result("b", scattered, 1), result("c", steady, 1)], PSNR)
    assert best == "a"
    assert ties == {"b"}


def test_without_frames_overlapping_intervals_tie() -> None:
    a, b, c = Statistic(30, 29, 31, 29.5, 30.5), Statistic(29.4, 28, 30, 29, 29.6), Statistic(28, 27, 29, 27.5, 28.5)
    methods = [MethodResult(n, n, metrics={"psnr": s}) for n, s in zip("abc", (a, b, c), strict=True)]
    assert best_and_ties(methods, PSNR) == ("a", {"b"})


def test_two_perfect_scores_tie_and_a_lost_frame_never_wins() -> None:
    perfect, nan = [math.inf, math.inf], [math.nan, math.nan]
    methods = [result("a", perfect, 1), result("b", perfect, 1), result("c", nan, 1)]
    best, ties = best_and_ties(methods, PSNR)
    assert {best} | ties == {"a", "b"}


def test_lower_and_nearest_to_zero_are_better_where_the_metric_says_so() -> None:
    bias = Metric("bias", "Bias", "", better="zero")
    methods = [MethodResult(str(v), "", metrics={"bias": summarize([v])}) for v in (-0.5, 0.1, 0.3)]
    assert best_and_ties(methods, bias)[0] == "0.1"
    assert best_and_ties(RESULTS, RELMSE)[0] == "final"


def test_the_front_holds_what_nothing_cheaper_beats() -> None:
    assert pareto_front(RESULTS, PSNR, "seconds_per_megapixel") == ["noisy", "average", "final"]
    assert pareto_front(RESULTS, RELMSE, "peak_bytes") == ["average", "final"]
    # Equal cost: only the better one stays.
    assert pareto_front([result("a", 30.0, 1.0), result("b", 31.0, 1.0)], PSNR, "seconds_per_megapixel") == ["b"]


def test_markdown_marks_the_best_and_keeps_a_name_in_its_cell() -> None:
    evil = replace(RESULTS[1], name="evil", label=EVIL)
    other = Comparison("Other", (result("final", 30.0, 1.0), result("average", 31.0, 1.0)))
    rows = markdown_table([Comparison("Hall", (*RESULTS, evil)), other], chart_cost).splitlines()
    assert "| **34.00** | **" not in rows[5]
    assert "| **34.00** | 30.00 | 4 |" in rows[5]  # the costs are the first shot's
    assert "14×" in rows[5]
    assert "| 28.00 | **31.00** |" in rows[3]
    assert "<" not in rows[7]
    assert "absent: torch is not installed" in rows[8]
    bars = {row.replace("\\|", "").count("|") for row in rows}
    assert len(bars) == 1  # every row has as many cells as the head


def swept(name: str, psnr: list[float], seconds: float, **settings: Any) -> MethodResult:
    sweep = "Stages" if next(iter(settings.values())) in ("on", "off") else "Window"
    return result(name, psnr, seconds, family="Methods", settings=settings, sweep=sweep, base="final")


SWEPT = (
    *RESULTS,
    swept("without gate", [32.5, 33.0, 33.5], 3.5, gate="off"),  # steadily a decibel less, for half a second less
    swept("with refine", [33.4, 34.1, 34.4], 9.0, refine="on"),  # scattered about the same
    swept("window 3", [32.0, 32.5, 33.0], 3.0, window=3),
    swept("window 1", [29.0, 29.5, 30.0], 2.5, window=1),
)


def test_stages_are_worth_what_switching_them_changes() -> None:
    gate, refine = stage_values(SWEPT)
    assert (gate.stage, gate.on, refine.on) == ("gate", True, False)
    assert gate.gains["psnr"] == pytest.approx(1.0)  # 34 with it, 33 without
    assert gate.seconds == pytest.approx(0.5)
    assert gate.told == ("psnr",)
    assert refine.gains["psnr"] == pytest.approx(-1 / 30)  # what it would change if it were on
    assert refine.seconds == pytest.approx(5.0)
    assert refine.told == ()  # a tie


def test_several_shots_are_put_together_over_those_that_all_have() -> None:
    a = Comparison("A", (result("x", [30.0, 31.0], 1.0, peak_bytes=5, worth=4.0), result("y", [20.0, 21.0], 2.0)))
    b = Comparison("B", (result("x", [40.0, 41.0, 42.0, 43.0], 3.0, peak_bytes=9, worth=16.0),))
    (joined,) = join([a, b])
    assert joined.metrics["psnr"].mean == pytest.approx((30.5 + 41.5) / 2)  # of the shots, however long they are
    assert joined.metrics["psnr"].shots == (2, 4)
    assert (joined.seconds_per_megapixel, joined.peak_bytes, joined.worth) == (2.0, 9, pytest.approx(8.0))
    # On one shot x is better by 1, on the other y is: nothing is known of a third shot.
    c = Comparison("C", (result("x", [30.0, 30.1], 1.0), result("y", [29.0, 29.1], 1.0)))
    d = Comparison("D", (result("x", [39.5, 39.6], 1.0), result("y", [40.0, 40.1], 1.0)))
    assert best_and_ties(c.results, PSNR) == ("x", set())
    assert best_and_ties(join([c, d]), PSNR) == ("x", {"y"})


def test_results_are_read_back_as_they_were(tmp_path: Path) -> None:
    perfect = result("perfect", [math.inf, math.inf], 1.0)
    comparison = Comparison("Hall", (*RESULTS, perfect), {"Machine": "two cores"})
    write_report(tmp_path, comparison)
    again = read_comparison(tmp_path / "results.json")
    assert again.facts == comparison.facts
    for before, after in zip(comparison.results, again.results, strict=True):
        assert replace(before, settings={}) == replace(after, settings={})
    (tmp_path / "results.json").write_text('{"shot": "x"}')
    with pytest.raises(ValueError, match="is no result of a comparison"):
        read_comparison(tmp_path / "results.json")


# --- the chart -----------------------------------------------------------------------------------------


def at(layout: chart.Chart, name: str) -> chart.Point:
    return next(p for p in layout.points if p.result.name == name)


@pytest.mark.parametrize("metric", [PSNR, RELMSE])
def test_better_is_up_dearer_is_right_and_the_axis_is_logarithmic(metric: Metric) -> None:
    layout = chart.lay_out([*RESULTS, result("ten", 20.0, 0.02), result("eleven", 20.0, 20.0)], metric, chart_cost)
    assert layout is not None
    assert at(layout, "final").y < at(layout, "average").y < at(layout, "noisy").y
    a, b, c = (at(layout, n).x for n in ("ten", "average", "slow"))
    assert b - a == pytest.approx(c - b)  # 0.02, 0.2, 2
    assert at(layout, "noisy").x < layout.box[0]  # costs nothing: beside a logarithmic axis
    assert at(layout, "other").x > layout.box[2]  # not known
    assert [p.result.name for p in layout.points if p.on_front][-1] == "final"


chart_cost = "seconds_per_megapixel"


def test_labels_lie_inside_and_never_on_each_other() -> None:
    rng = np.random.default_rng(3)
    crowd = [result(f"method {i:02d}", float(rng.uniform(28, 32)), float(rng.uniform(0.5, 3))) for i in range(30)]
    layout = chart.lay_out(crowd, PSNR, chart_cost)
    assert layout is not None
    boxes = []
    for p in layout.points:
        if p.label:
            x, y, text = p.label
            boxes.append((x, y - 10, x + chart._text_width(text), y + 2))
    assert len(boxes) >= 5
    assert all(b[0] >= 0 and b[2] <= chart.WIDTH for b in boxes)
    assert not any(chart._overlap(a, b) for i, a in enumerate(boxes) for b in boxes[:i])


def test_families_differ_in_shape_and_colour_and_dominated_points_are_hollow() -> None:
    pairs = {(i % len(chart.COLORS), i % len(chart.SHAPES)) for i in range(63)}
    assert len(pairs) == 63
    layout = chart.lay_out(RESULTS, PSNR, chart_cost)
    assert layout is not None
    pixels = chart.to_pixels(layout)
    for name, filled in (("final", True), ("slow", False)):
        p = at(layout, name)
        color = pixels[round(p.y * chart.SCALE), round(p.x * chart.SCALE)]
        expected = chart._bgr(chart.COLORS[p.family]) if filled else (255, 255, 255)
        # The neighbours under a marker's middle have its colour: no anti-aliasing there.
        assert np.abs(color.astype(int) - expected).max() <= 2


def test_a_line_joins_what_varies_one_number_in_its_order() -> None:
    layout = chart.lay_out([*SWEPT, swept("window 5", [33.0, 33.1, 33.2], 3.6, window=5)], PSNR, chart_cost)
    assert layout is not None
    ((family, line),) = layout.series  # stages are no numbers
    assert chart.families(SWEPT)[family] == "Methods"
    assert line == [(at(layout, n).x, at(layout, n).y) for n in ("window 1", "window 3", "window 5")]


def test_every_resource_has_a_front_of_its_own() -> None:
    a = result("a", 30.0, 1.0, cpu_seconds_per_megapixel=4.0, peak_bytes=100)
    b = result("b", 29.0, 2.0, cpu_seconds_per_megapixel=2.0, peak_bytes=200)
    fronts = {cost: pareto_front([a, b], PSNR, cost) for cost in COSTS}
    assert fronts == {
        "seconds_per_megapixel": ["a"],
        "cpu_seconds_per_megapixel": ["b", "a"],
        "peak_bytes": ["a"],
    }


def test_svg_is_well_formed_whatever_the_names_are() -> None:
    layout = chart.lay_out([replace(RESULTS[3], label=EVIL, name='"><b'), RESULTS[1]], PSNR, chart_cost)
    assert layout is not None
    tree = ElementTree.fromstring(chart.to_svg(layout))
    points = [e for e in tree.iter() if "point" in e.get("class", "").split()]
    assert [e.get("data-name") for e in points] == ["average", '"><b']
    assert EVIL in points[1].get("aria-label", "")


def test_a_chart_of_nothing_finite_is_none() -> None:
    assert chart.lay_out([result("a", [math.inf, math.inf], 1.0)], PSNR, chart_cost) is None


# --- pictures ------------------------------------------------------------------------------------------


def decompress(text: str, shape: tuple[int, int, int], levels: int) -> np.ndarray:
    """The inverse of `compress`, pixel by pixel, as the page does it."""
    height, width, channels = shape
    raw = zlib.decompress(base64.b64decode(text))
    size, half = height * width * channels, levels // 2
    planes = np.zeros((channels, height, width), int)
    for i in range(size):
        c, y, x = i // (height * width), i // width % height, i % width
        above = planes[c, y - 1, x] if y else 0
        left = planes[c, y, x - 1] if x else above
        corner = (planes[c, y - 1, x - 1] if y else 0) if x else (planes[c, y - 2, 0] if y > 1 else 0)
        low, high = min(left, above), max(left, above)
        guess = low if corner >= high else high if corner <= low else left + above - corner
        folded = raw[i] | raw[size + i] << 8
        planes[c, y, x] = (guess + (-((folded + 1) >> 1) if folded & 1 else folded >> 1)) % levels
    if channels == 3:
        green, red, blue = planes
        planes = np.stack([(red + green - half) % levels, green, (blue + green - half) % levels])
    return np.moveaxis(planes, 0, -1)


@pytest.mark.parametrize("shape", [(7, 5, 3), (1, 6, 3), (6, 1, 1), (9, 11, 1)])
def test_compression_loses_nothing(shape: tuple[int, int, int]) -> None:
    levels = 1024 if shape[2] == 3 else 64
    rng = np.random.default_rng(1)
    codes = rng.integers(0, levels, shape).astype(np.int32)
    codes[0, 0], codes[-1, -1] = levels - 1, 0
    assert np.array_equal(decompress(embedding.compress(codes, levels), shape, levels), codes)


def test_codes_keep_radiance_to_a_percent_and_mark_what_is_not_finite() -> None:
    level = 0.3
    radiance = np.geomspace(level, 1e4 * level, 3000, dtype=np.float32).reshape(-1, 1, 3)
    back = level / 64 * (2.0 ** (embedding.to_codes(radiance, level) / embedding.CODES_PER_STOP) - 1)
    # Half a step of 1/48 stop is 0.73 %, a little more where the linear part still counts.
    assert np.max(np.abs(back / radiance - 1)) < 0.0075
    lost = np.array([[[np.nan, np.inf, -1.0]]], np.float32)
    assert embedding.to_codes(lost, level).tolist() == [[[embedding.NOT_FINITE, embedding.NOT_FINITE, 0]]]


def scene(level: float, shape: tuple[int, int] = (18, 32)) -> Callable[[int], np.ndarray]:
    """Flat pictures that grow brighter with the frame's number."""
    return lambda number: np.full((*shape, 3), level * (1 + 0.5 * (number - 8)), np.float32)


def test_every_file_is_written_and_readable(tmp_path: Path) -> None:
    page = write_report(tmp_path / "a" / "b", Comparison("Hall", RESULTS, {"Machine": "two cores"}))
    folder = page.parent
    names = {p.name for p in folder.iterdir()}
    assert names == {"report.html", "results.json", "results.csv", "results.md", "chart.png"}
    document = json.loads((folder / "results.json").read_text(encoding="utf-8"))
    assert document["fronts"]["psnr seconds_per_megapixel"] == ["noisy", "average", "final"]
    assert document["results"][3]["settings"] == {"window": "5"}
    rows = list(csv.DictReader((folder / "results.csv").open(encoding="utf-8", newline="")))
    assert [float(r["psnr_mean"]) for r in rows[:5]] == [22.0, 28.0, 27.0, 34.0, 33.0]
    assert rows[5]["absent_reason"] == "torch is not installed"
    picture = cv2.imread(str(folder / "chart.png"))
    assert picture is not None
    assert picture.shape[1] == 1600
    text = page.read_text(encoding="utf-8")
    assert "torch is not installed" in text
    assert "two cores" in text


def test_numbers_that_are_not_finite_survive_json(tmp_path: Path) -> None:
    write_report(tmp_path, Comparison("x", (result("a", [math.inf, math.nan], 1.0),)))
    statistic = json.loads((tmp_path / "results.json").read_text())["results"][0]["metrics"]["psnr"]
    assert [float(v) for v in statistic["values"]] == pytest.approx([math.inf, math.nan], nan_ok=True)


def test_the_page_shows_stages_sweeps_and_other_shots(tmp_path: Path) -> None:
    other = Comparison("Yard", (result("final", 30.0, 1.0), result("average", 31.0, 1.0)))
    page = write_report(tmp_path, Comparison("Hall", SWEPT), others=[other])
    text = page.read_text(encoding="utf-8")
    assert "What each stage buys" in text
    assert "+1.00" in text
    assert "Sweep of Window: 2 settings" in text
    assert "All shots" in text
    assert "Yard" in text
    assert "Yard: PSNR" in (tmp_path / "results.md").read_text(encoding="utf-8")
    alone = write_report(tmp_path, Comparison("Hall", RESULTS)).read_text(encoding="utf-8")
    assert "What each stage buys" not in alone
    assert "All shots" not in alone


def test_nothing_from_a_name_becomes_markup(tmp_path: Path) -> None:
    evil = replace(RESULTS[3], name=EVIL, label=EVIL, family=EVIL, settings={EVIL: EVIL})
    gone = MethodResult("gone", EVIL, absent_reason=EVIL)
    images = [ReportImages(EVIL, scene(1.0), {EVIL: lambda n: np.zeros((18, 32), np.float32)})]
    page = write_report(tmp_path, Comparison(EVIL, (evil, gone), {EVIL: EVIL}), images, scene(1.0), [8])
    text = page.read_text(encoding="utf-8")
    assert "<img" not in text
    assert text.count("</script>") == 2 + 3  # data, program; two pictures and a map
    assert text.count("{{data}}") > 5  # never filled in again
    assert "http" not in text.replace('http-equiv="Content-Security-Policy"', "")


def test_what_is_left_out_is_said_and_the_limit_kept(tmp_path: Path) -> None:
    rng = np.random.default_rng(0)
    noise = {n: rng.exponential(1.0, (270, 480, 3)).astype(np.float32) for n in (8, 9, 10)}
    still = np.ones((270, 480, 3), np.float32)
    images = [ReportImages("average", lambda n: noise[n])]
    page = write_report(tmp_path, Comparison("x", RESULTS), images, lambda n: still, [8, 9, 10], megabytes=0.4)
    info = json.loads(page.read_text().split('id="data">')[1].split("</script>")[0])["pictures"]
    assert info["width"] < 480
    assert "of 480 × 270" in info["extent"]
    assert "left out" in info["extent"]
    # The page's own text and program take about a tenth of a megabyte.
    assert page.stat().st_size < 0.4e6 + 0.2e6
    tiny = write_report(tmp_path, Comparison("x", RESULTS), images, lambda n: still, [8, 9, 10], megabytes=0.12)
    info = json.loads(tiny.read_text().split('id="data">')[1].split("</script>")[0])["pictures"]
    assert len(info["frames"]) < 3
    assert "of 8 to 10" in info["extent"]


def test_what_does_not_fit_together_is_refused(tmp_path: Path) -> None:
    picture = [ReportImages("average", scene(1.0))]
    with pytest.raises(ValueError, match="'noisy' appears 2 times"):
        write_report(tmp_path, Comparison("x", (RESULTS[0], RESULTS[0])))
    with pytest.raises(ValueError, match="'nobody' belong to no result"):
        write_report(tmp_path, Comparison("x", RESULTS), [ReportImages("nobody", scene(1.0))], scene(1.0), [8])
    with pytest.raises(ValueError, match="need a reference"):
        write_report(tmp_path, Comparison("x", RESULTS), picture)
    with pytest.raises(ValueError, match=r"average has the shape \(18, 32, 3\), expected \(18, 30, 3\)"):
        write_report(tmp_path, Comparison("x", RESULTS), picture, scene(1.0, (18, 30)), [8])
    assert not any(tmp_path.iterdir())  # refused before anything was written


# --- in a browser --------------------------------------------------------------------------------------

FLAGS = ["--no-sandbox", "--disable-gpu", "--disable-quic", "--no-first-run", "--disable-background-networking"]
FLAGS += ["--disable-component-update", "--disable-sync", "--allow-file-access-from-files"]
LEVELS = {"reference": 0.5, "noisy": 0.05, "average": 0.5, "final": 2.0, "bright": 8.0}
EXPOSURE = 2.0


@pytest.fixture(scope="module")
def browser() -> Iterator[Any]:
    playwright = pytest.importorskip("playwright.sync_api", reason="playwright is not installed")
    program = shutil.which("chromium") or shutil.which("chromium-browser") or shutil.which("google-chrome")
    if program is None:
        pytest.skip("chromium is not installed")
    with playwright.sync_playwright() as running:
        instance = running.chromium.launch(executable_path=program, args=FLAGS)
        yield instance
        instance.close()


@pytest.fixture(scope="module")
def report_file(tmp_path_factory: pytest.TempPathFactory) -> Path:
    def spot(number: int) -> np.ndarray:
        image = scene(LEVELS["noisy"])(number)
        image[4, 6] = LEVELS["bright"] * (1 + 0.5 * (number - 8))  # one pixel to find again after zooming
        return image

    half = np.tile(np.linspace(0, 1, 32, dtype=np.float32), (18, 1))
    images = [
        ReportImages("noisy", spot),
        ReportImages("average", scene(LEVELS["average"])),
        ReportImages("final", scene(LEVELS["final"]), {"Confidence": lambda n: half}),
    ]
    results = tuple(replace(r, label=EVIL) if r.name == "other" else r for r in RESULTS)
    folder = tmp_path_factory.mktemp("report")
    return write_report(
        folder, Comparison("Hall", results), images, scene(LEVELS["reference"]), [8, 9, 10], exposure=EXPOSURE
    )


@pytest.fixture
def page(browser: Any, report_file: Path) -> Iterator[Any]:
    context = browser.new_context(viewport={"width": 1200, "height": 900}, offline=True)
    tab = context.new_page()
    faults: list[str] = []
    asked: list[str] = []
    tab.on("console", lambda message: faults.append(message.text) if message.type == "error" else None)
    tab.on("pageerror", lambda error: faults.append(str(error)))
    tab.on("request", lambda request: asked.append(request.url))
    tab.goto(report_file.as_uri())
    until(tab, "document.querySelectorAll('#labels div').length === 2")
    yield tab
    assert faults == []
    assert asked == [report_file.as_uri()]  # nothing but the file itself
    assert tab.evaluate("window.pwned") is None
    context.close()


def arrange(page: Any, layout: str) -> None:
    """Choose an arrangement by its label; the radio button itself lies under it."""
    page.locator(f".segments label:has(input[value={layout}])").click()
    until(page, f"document.querySelector('[name=layout][value={layout}]').checked")


def until(page: Any, condition: str) -> None:
    """Wait for a JavaScript expression to become true; Playwright's own way needs eval, which the page forbids."""
    for _ in range(200):
        if page.evaluate(condition):
            return
        page.wait_for_timeout(50)
    pytest.fail(f"never became true: {condition}")


def color(page: Any, x: float, y: float = 0.5) -> list[int]:
    """The colour on the canvas at shares of its width and height, once the page has drawn."""
    page.evaluate("new Promise((done) => requestAnimationFrame(() => setTimeout(done, 60)))")
    script = """([x, y]) => { const c = document.getElementById('canvas');
        return [...c.getContext('2d').getImageData(x * c.width, y * c.height, 1, 1).data].slice(0, 3); }"""
    return list(page.evaluate(script, [x, y]))


def shown(page: Any, method: str, number: int = 9, ev: float | None = None) -> list[int]:
    """What a method's flat picture looks like, from the page's own definition."""
    gain = EXPOSURE * 2 ** (float(page.input_value("#ev")) if ev is None else ev)
    x = gain * LEVELS[method] * (1 + 0.5 * (number - 8))
    tone = x / (1 + x)
    return [round(255 * (1.055 * tone ** (1 / 2.4) - 0.055))] * 3


def see(page: Any, expected: list[int], x: float, y: float = 0.5) -> None:
    """Wait until a place on the canvas has a colour: a busy machine may draw late."""
    for _ in range(100):
        if close(found := color(page, x, y), expected):
            return
    pytest.fail(f"at ({x:.2f}, {y:.2f}) the canvas is {found}, expected {expected}")


def close(a: list[int], b: list[int]) -> bool:
    return max(abs(p - q) for p, q in zip(a, b, strict=True)) <= 2  # 1.5 % steps of radiance, and rounding


def test_the_slider_divides_two_pictures_and_follows_mouse_and_keys(page: Any) -> None:
    # It opens on the noisy input and the last of the front.
    see(page, shown(page, "noisy"), 0.25)
    see(page, shown(page, "final"), 0.75)
    assert not close(shown(page, "noisy"), shown(page, "final"))
    divider = page.locator("#divider")
    divider.scroll_into_view_if_needed()
    box, stage = divider.bounding_box(), page.locator("#stage").bounding_box()
    page.mouse.move(box["x"] + 15, box["y"] + box["height"] / 2)
    page.mouse.down()
    page.mouse.move(stage["x"] + 0.9 * stage["width"], box["y"] + 20, steps=4)
    page.mouse.up()
    see(page, shown(page, "noisy"), 0.75)
    until(page, "document.getElementById('divider').ariaValueNow === '90'")
    divider.focus()
    page.keyboard.press("Home")
    see(page, shown(page, "final"), 0.25)
    for _ in range(10):
        page.keyboard.press("ArrowRight")
    until(page, "document.getElementById('divider').ariaValueNow === '20'")
    see(page, shown(page, "noisy"), 0.1)
    see(page, shown(page, "final"), 0.3)


def test_any_two_methods_can_be_compared(page: Any) -> None:
    page.select_option("#left", label="Average")
    page.select_option("#right", label="Reference")
    see(page, shown(page, "average"), 0.25)
    page.locator("#swap").click()
    until(page, "document.querySelector('#labels div').textContent.startsWith('Reference')")


def test_frames_are_scrubbed_and_played(page: Any) -> None:
    page.locator("#frame").focus()
    page.keyboard.press("ArrowRight")
    until(page, "document.getElementById('frame-text').textContent === 'frame 10'")
    see(page, shown(page, "final", number=10), 0.75)
    page.locator("#canvas").focus()
    page.keyboard.press(",")
    see(page, shown(page, "final", number=9), 0.75)
    page.select_option("#rate", "24")
    page.keyboard.press("Escape")
    page.locator("#canvas").focus()
    page.keyboard.press(" ")
    until(page, "document.getElementById('frame-text').textContent !== 'frame 9'")
    page.keyboard.press(" ")
    assert page.locator("#play").get_attribute("aria-pressed") == "false"


def test_exposure_moves_both_pictures_as_the_curve_says(page: Any) -> None:
    before = float(page.input_value("#ev"))
    page.locator("#canvas").focus()
    for _ in range(6):
        page.keyboard.press("]")
    see(page, shown(page, "noisy", ev=before + 3), 0.25)
    see(page, shown(page, "final", ev=before + 3), 0.75)


def test_zoom_and_pan_are_the_same_in_both_panes(page: Any) -> None:
    page.select_option("#right", label="Noisy")
    arrange(page, "pair")
    page.locator("#canvas").focus()
    for _ in range(4):
        page.keyboard.press("+")
    # From the middle, (16, 9), to the bright pixel around (6.5, 4.5); a press is a tenth of what is in sight, 0.63.
    for key, times in (("ArrowLeft", 15), ("ArrowUp", 7)):
        for _ in range(times):
            page.keyboard.press(key)
    script = """() => { const c = document.getElementById('canvas'), half = c.width >> 1;
        const data = c.getContext('2d').getImageData(0, 0, c.width, c.height).data;
        const same = []; for (let y = 30; y < c.height; y += 7) for (let x = 12; x < half - 12; x += 7)
            same.push([data[4 * (y * c.width + x)], data[4 * (y * c.width + x + half)]]);
        return same; }"""
    until(page, "parseFloat(document.getElementById('zoom-text').textContent) > 20")
    color(page, 0.5)
    pairs = page.evaluate(script)
    assert all(a == b for a, b in pairs)
    assert len({a for a, _ in pairs}) > 1  # the bright pixel is in sight


def test_one_pixel_is_where_it_belongs(page: Any) -> None:
    page.locator("#divider").focus()
    page.keyboard.press("End")
    see(page, shown(page, "bright"), 6.5 / 32, 4.5 / 18)
    see(page, shown(page, "noisy"), 8.5 / 32, 4.5 / 18)
    for _ in range(200):
        # The page may still be settling: point again, at where the picture is now, until it has been noticed.
        box = page.locator("#canvas").bounding_box()
        page.mouse.move(box["x"] + 1, box["y"] + 1)
        page.mouse.move(box["x"] + 6.5 / 32 * box["width"], box["y"] + 4.5 / 18 * box["height"])
        if page.locator("#readout").inner_text().startswith("(6, 4)"):
            break
        page.wait_for_timeout(50)
    # 8 × 1.5 on frame 9, to half a step of 1.5 %
    assert float(page.locator("#readout").inner_text().split("Noisy")[1].split()[0]) == pytest.approx(12, rel=0.0075)


def test_errors_and_maps_are_drawn_on_a_scale(page: Any) -> None:
    page.select_option("#right", label="Average")  # the reference itself
    page.select_option("#view", label="Error")
    see(page, [0, 0, 4], 0.75)  # magma's zero
    see(page, [0xFC, 0xFD, 0xBF], 0.25)  # and its end: noisy is a tenth of the reference
    page.select_option("#right", label="Final")
    page.select_option("#view", label="Confidence")
    page.locator("#divider").focus()
    page.keyboard.press("Home")
    see(page, [0x44, 0x01, 0x54], 0.01, 0.9)  # viridis from end to end
    see(page, [0xFD, 0xE7, 0x25], 0.99, 0.9)
    arrange(page, "all")
    until(page, "document.querySelectorAll('#labels div').length === 4")


def test_slices_show_the_frames_downwards(page: Any) -> None:
    script = """() => { const c = document.querySelectorAll('#slices canvas')[6];
        const d = c.getContext('2d').getImageData(3, 0, 1, c.height).data; return [d[0], d[4], d[8]]; }"""
    until(page, f"({script})()[2] > 0")
    values = page.evaluate(script)
    expected = [shown(page, "final", number=n)[0] for n in (8, 9, 10)]
    assert close(values, expected)
    assert all(a < b for a, b in pairwise(values))


def test_the_axes_can_be_chosen_and_the_points_tell_their_settings(page: Any) -> None:
    plot = page.locator(".plot:not([hidden])")
    assert plot.get_attribute("data-axes") == "psnr seconds_per_megapixel"
    page.select_option("#axis-up", "relmse")
    page.select_option("#axis-over", "peak_bytes")
    assert plot.get_attribute("data-axes") == "relmse peak_bytes"
    assert page.locator(".plot:not([hidden]) svg").count() == 1
    plot.locator(".point[data-name=final]").focus()
    tip = page.locator("#tip")
    assert "Final" in tip.inner_text()
    assert "window" in tip.inner_text()
    page.keyboard.press("ArrowLeft")
    assert "Slow" in tip.inner_text()
    page.keyboard.press("Home")
    assert "Average" in tip.inner_text()
    page.keyboard.press("Enter")  # sends it to the viewer
    see(page, shown(page, "average"), 0.75)
    page.keyboard.press("Escape")
    assert tip.is_hidden()
    plot.locator(".point[data-name=slow] .target").hover()
    assert "Slow" in tip.inner_text()


def test_a_family_can_be_hidden(page: Any) -> None:
    point = page.locator(".plot:not([hidden]) .point[data-name=other]")
    assert point.is_visible()
    page.locator(".legend label", has_text="External").click()
    assert point.is_hidden()


def test_everything_is_reached_with_the_tab_key(page: Any) -> None:
    reached = set()
    for _ in range(60):
        page.keyboard.press("Tab")
        reached.add(page.evaluate("document.activeElement.id || document.activeElement.getAttribute('class')"))
    wanted = {"axis-up", "axis-over", "left", "right", "view", "ev", "canvas", "divider", "play", "frame", "row"}
    assert wanted <= reached


@pytest.mark.parametrize("scheme", ["light", "dark"])
def test_text_is_readable_on_light_and_dark(page: Any, scheme: str) -> None:
    page.emulate_media(color_scheme=scheme)
    pairs = page.evaluate("""() => ['body', '.lead', '.hint', '.plot .tick', 'thead small', '.definitions dd']
        .map((s) => { const style = getComputedStyle(document.querySelector(s));
            const ink = s.startsWith('.plot') ? style.fill : style.color;
            return [s, ink, getComputedStyle(document.body).backgroundColor]; })""")

    def luminance(text: str) -> float:
        parts = [int(v) / 255 for v in text[text.index("(") + 1 : -1].split(",")[:3]]
        linear = [v / 12.92 if v <= 0.04045 else ((v + 0.055) / 1.055) ** 2.4 for v in parts]
        return 0.2126 * linear[0] + 0.7152 * linear[1] + 0.0722 * linear[2]

    for selector, ink, paper in pairs:
        low, high = sorted((luminance(ink), luminance(paper)))
        assert (high + 0.05) / (low + 0.05) >= 4.5, selector  # WCAG 2 AA
    assert (luminance(pairs[0][2]) < 0.1) == (scheme == "dark")


def test_what_no_comparison_has_left_is_not_written_over(tmp_path: Path) -> None:
    comparison = Comparison("Hall", RESULTS)
    (tmp_path / "results.csv").write_text("mine")
    with pytest.raises(ValueError, match=r"results\.csv is there, and of no earlier comparison"):
        write_report(tmp_path, comparison)
    assert [path.name for path in tmp_path.iterdir()] == ["results.csv"]
    (tmp_path / "results.csv").unlink()
    write_report(tmp_path, comparison)
    write_report(tmp_path, comparison)  # over its own
    with pytest.raises(ValueError, match=r"report .* would overwrite an input: results"):
        check_report(tmp_path, [tmp_path / "results.json"])
