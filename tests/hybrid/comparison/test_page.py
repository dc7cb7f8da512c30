"""The page: whatever a name holds stays text, and what it shows in a real browser, where there is one."""

# ruff: noqa: E402 - skipped by name without the extra `compare`

import json
from collections.abc import Iterator
from dataclasses import replace
from html.parser import HTMLParser
from importlib.resources import files
from itertools import pairwise
from pathlib import Path
from typing import Any

import numpy as np
import pytest

jinja2 = pytest.importorskip("jinja2")
pytest.importorskip("matplotlib")

from hybrid.comparison import page as templates
from hybrid.comparison.embedding import MethodImages, ShotImages
from hybrid.comparison.report import Report, write_report
from hybrid.comparison.results import Comparison, MethodResult, summarize
from tests.hybrid.comparison.outcomes import EVIL, RESULTS
from tests.hybrid.comparison.test_report import scene

HOSTILE = [
    "<script>alert(1)</script>",
    "</script><img src=x onerror=alert(1)>",
    "\"' onmouseover='alert(1)' x=\"",
    "--></style><b>",
    "{{ data }}{% raw %}{# ",
    "&lt;b&gt; & \\u003cb\\u003e",
]


class Outline(HTMLParser):
    """Elements of a page with the names of their attributes, and the text of those that hold data."""

    def __init__(self, text: str) -> None:
        super().__init__()
        self.elements: list[tuple[str, tuple[str, ...]]] = []
        self.data = ""
        self._inside = ""
        self.feed(text)

    def handle_starttag(self, tag: str, attrs: list[tuple[str, str | None]]) -> None:
        if tag not in ("g", "text"):  # names that find space on the chart
            self.elements.append((tag, tuple(name for name, _ in attrs)))
        self._inside = dict(attrs).get("id") or "" if tag == "script" else ""

    def handle_data(self, data: str) -> None:
        if self._inside == "data":
            self.data += data


def write(folder: Path, name: str) -> Outline:
    """A page in which everything that has a name has this one."""

    def result(suffix: str, **more: object) -> MethodResult:
        metrics = {"psnr": summarize([30.0, 31.0]), "temporal_psnr": summarize([29.0])}
        settings = {"settings": {name: name}, "family": name + suffix, "metrics": metrics, **more}
        return MethodResult(name + suffix, seconds_per_megapixel=1.0, peak_bytes=1 << 20, **settings)

    results = (
        result(""),
        result(" 2"),
        MethodResult(name + " 3", absent_reason=name),
    )
    pictures = MethodImages(
        name, lambda number: np.ones((18, 32, 3), np.float32), {name: lambda number: np.zeros((18, 32), np.float32)}
    )
    images = ShotImages([pictures], lambda number: np.ones((18, 32, 3), np.float32), [1, 2])
    report = Report(Comparison(name, results, {name: name}), images, others=[Comparison(name, results[:2])])
    text = write_report(folder, report).read_text(encoding="utf-8")
    assert "http" not in text.replace('http-equiv="Content-Security-Policy"', "")
    return Outline(text)


@pytest.fixture(scope="module")
def plain(tmp_path_factory: pytest.TempPathFactory) -> Outline:
    return write(tmp_path_factory.mktemp("plain"), "a name")


@pytest.mark.parametrize("name", HOSTILE)
def test_a_name_makes_no_element_and_no_attribute(plain: Outline, tmp_path: Path, name: str) -> None:
    hostile = write(tmp_path, name)
    assert len(plain.elements) > 200
    # Lines of the chart lead to names that find no place beside their points.
    drawn = "path", "g", "defs", "use"
    elements, expected = ([e for e in page.elements if e[0] not in drawn] for page in (hostile, plain))
    assert elements == expected
    # The script reads the name as it is.
    data = json.loads(hostile.data)
    assert data["shot"] == name
    assert data["pictures"]["sources"][1] == {"name": name, "maps": [name]}


def test_every_script_is_on_the_page_once() -> None:
    folder = files("hybrid.comparison.page")
    assert sorted(templates.SCRIPTS) == sorted(item.name for item in folder.iterdir() if item.name.endswith(".js"))
    assert [templates.script().count(each) for each in ("function startViewer(", "class Player ")] == [1, 1]


def test_a_template_that_misses_something_is_an_error() -> None:
    with pytest.raises(jinja2.UndefinedError, match="comparison"):
        templates.render("report.html")


# In a browser

LEVELS = {"reference": 0.5, "noisy": 0.05, "average": 0.5, "final": 2.0, "bright": 8.0}
EXPOSURE = 2.0


@pytest.fixture(scope="module")
def report_file(tmp_path_factory: pytest.TempPathFactory) -> Path:
    def spot(number: int) -> np.ndarray:
        image = scene(LEVELS["noisy"])(number)
        image[4, 6] = LEVELS["bright"] * (1 + 0.5 * (number - 8))  # one pixel to find again after zooming
        return image

    half = np.tile(np.linspace(0, 1, 32, dtype=np.float32), (18, 1))
    images = [
        MethodImages("noisy", spot),
        MethodImages("average", scene(LEVELS["average"])),
        MethodImages("final", scene(LEVELS["final"]), {"Confidence": lambda n: half if n == 9 else None}),
    ]
    results = tuple(replace(r, name=EVIL) if r.name == "other" else r for r in RESULTS)
    shown = ShotImages(images, scene(LEVELS["reference"]), [8, 9, 10], EXPOSURE)
    return write_report(tmp_path_factory.mktemp("report"), Report(Comparison("Hall", results), shown))


@pytest.fixture
def page(browser: Any, report_file: Path) -> Iterator[Any]:
    context = browser.new_context(viewport={"width": 1200, "height": 900}, offline=True, reduced_motion="reduce")
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
    page.locator(f"#viewer .segments label:has(input[value={layout}])").click()
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
    """A method's flat picture, from the page's own definition."""
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
    # It opens on the best method, and on the noisy input where the strongest rival has no pictures.
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
    page.select_option("#left", label="average")
    page.select_option("#right", label="reference")
    see(page, shown(page, "average"), 0.25)
    page.locator("#swap").click()
    until(page, "document.querySelector('#labels div').textContent.startsWith('reference')")


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
    page.select_option("#right", label="noisy")
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


def test_two_pictures_flicker_in_one_place(page: Any) -> None:
    arrange(page, "flicker")
    for _ in range(2):  # there and back
        see(page, shown(page, "noisy"), 0.25)
        see(page, shown(page, "final"), 0.25)
    assert page.locator("#divider").is_hidden()
    arrange(page, "pair")
    see(page, shown(page, "noisy"), 0.25)
    see(page, shown(page, "final"), 0.75)


def test_the_magnifier_shows_both_pictures_where_the_pointer_is(page: Any) -> None:
    page.locator("#canvas").focus()
    page.keyboard.press("m")
    until(page, "document.getElementById('magnify').checked")
    page.locator("#canvas").scroll_into_view_if_needed()
    box = page.locator("#canvas").bounding_box()
    x, y = 6.5 / 32 * box["width"], 4.5 / 18 * box["height"]  # the bright pixel of the noisy picture
    page.mouse.move(box["x"] + x, box["y"] + y)
    # Two lenses of 120 pixels, above the pointer where there is room: left the left picture, right the right one.
    middle = (y - 80 if y > 140 else y + 80) / box["height"]
    start = max(0.0, x - 120)
    see(page, shown(page, "bright"), (start + 60) / box["width"], middle)
    see(page, shown(page, "final"), (start + 180) / box["width"], middle)
    page.keyboard.press("m")
    see(page, shown(page, "noisy"), (start + 180) / box["width"], middle)


def loop_color(page: Any, x: float, y: float = 0.5) -> list[int]:
    script = """([x, y]) => { const c = document.getElementById('animation-canvas');
        return [...c.getContext('2d').getImageData(x * c.width, y * c.height, 1, 1).data].slice(0, 3); }"""
    return list(page.evaluate(script, [x, y]))


def see_loop(page: Any, method: str, x: float, number: int = 9) -> None:
    """Wait until a place of the loops shows a method, as WebP with loss has it: within 6 of 255."""
    level = LEVELS["reference"] * 1.5  # of the middle frame
    ev = round(2 * float(np.log2(0.35 / (EXPOSURE * level)))) / 2
    expected = shown(page, method, number, ev)
    for _ in range(100):
        found = loop_color(page, x)
        if max(abs(a - b) for a, b in zip(found, expected, strict=True)) <= 6:
            return
        page.wait_for_timeout(50)
    pytest.fail(f"at {x:.2f} the loop is {found}, expected {expected}, {method} at frame {number}")


def test_animations_of_any_two_methods_play_together(page: Any) -> None:
    page.locator("#animations").scroll_into_view_if_needed()
    see_loop(page, "noisy", 0.25, 8)
    see_loop(page, "final", 0.75, 8)
    page.select_option("#animation-right", label="average")
    see_loop(page, "average", 0.75, 8)
    page.locator("#animation-frame").focus()
    page.keyboard.press("ArrowRight")
    until(page, "document.getElementById('animation-frame-text').textContent === 'frame 9'")
    see_loop(page, "average", 0.75, 9)
    see_loop(page, "noisy", 0.25, 9)
    page.locator("#animation-divider").focus()
    page.keyboard.press("End")
    see_loop(page, "noisy", 0.95, 9)
    page.locator("label:has(input[name=animation-layout][value=pair])").click()
    see_loop(page, "average", 0.95, 9)
    assert page.locator("#animation-divider").is_hidden()
    page.locator("label:has(input[name=animation-layout][value=flicker])").click()
    for method in ("noisy", "average", "noisy"):
        see_loop(page, method, 0.5, 9)
    page.select_option("#animation-rate", "60")
    page.locator("#animation-play").click()
    for number in (10, 8):
        until(page, f"document.getElementById('animation-frame-text').textContent === 'frame {number}'")
    page.locator("#animation-play").click()
    assert page.locator("#animation-play").get_attribute("aria-pressed") == "false"
    assert page.input_value("#rate") == "24"


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
    assert float(page.locator("#readout").inner_text().split("noisy")[1].split()[0]) == pytest.approx(12, rel=0.0075)


def test_errors_and_maps_are_drawn_on_a_scale(page: Any) -> None:
    page.select_option("#right", label="average")  # the reference itself
    page.select_option("#view", label="Error")
    see(page, [0, 0, 4], 0.75)  # magma's zero
    see(page, [0xFC, 0xFD, 0xBF], 0.25)  # and its end: noisy is a tenth of the reference
    page.select_option("#right", label="final")
    page.select_option("#view", label="Confidence")
    page.locator("#divider").focus()
    page.keyboard.press("Home")
    see(page, [0x44, 0x01, 0x54], 0.01, 0.9)  # viridis from end to end
    see(page, [0xFD, 0xE7, 0x25], 0.99, 0.9)
    page.keyboard.press(",")  # the frame before has no such map
    see(page, [0x18, 0x18, 0x1A], 0.01, 0.9)
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
    plot.locator("[id*=point-3]").focus()
    tip = page.locator("#tip")
    assert "final" in tip.inner_text()
    assert "window" in tip.inner_text()
    page.keyboard.press("ArrowLeft")
    assert "slow" in tip.inner_text()
    page.keyboard.press("Home")
    assert "average" in tip.inner_text()
    page.keyboard.press("Enter")  # sends it to the viewer
    see(page, shown(page, "average"), 0.75)
    page.keyboard.press("Escape")
    assert tip.is_hidden()
    plot.locator("[id*=point-2]").hover()
    assert "slow" in tip.inner_text()


def test_a_family_can_be_hidden(page: Any) -> None:
    point = page.locator(".plot:not([hidden]) [id*=point-4]")
    assert point.is_visible()
    page.locator(".legend label", has_text="External").click()
    assert point.is_hidden()


def test_everything_is_reached_with_the_tab_key(page: Any) -> None:
    reached = set()
    for _ in range(80):
        page.keyboard.press("Tab")
        reached.add(page.evaluate("document.activeElement.id || document.activeElement.getAttribute('class')"))
    wanted = {"axis-up", "axis-over", "left", "right", "view", "ev", "canvas", "divider", "play", "frame", "row"}
    wanted |= {f"animation-{name}" for name in ("left", "right", "divider", "play", "frame", "rate")}
    assert wanted <= reached


@pytest.mark.parametrize("scheme", ["light", "dark"])
def test_text_is_readable_on_light_and_dark(page: Any, scheme: str) -> None:
    page.emulate_media(color_scheme=scheme)
    pairs = page.evaluate("""() => ['body', '.lead', '.hint', 'thead small', '.definitions dd']
        .map((s) => { const style = getComputedStyle(document.querySelector(s));
            return [s, style.color, getComputedStyle(document.body).backgroundColor]; })""")

    def luminance(text: str) -> float:
        parts = [int(v) / 255 for v in text[text.index("(") + 1 : -1].split(",")[:3]]
        linear = [v / 12.92 if v <= 0.04045 else ((v + 0.055) / 1.055) ** 2.4 for v in parts]
        return 0.2126 * linear[0] + 0.7152 * linear[1] + 0.0722 * linear[2]

    for selector, ink, paper in pairs:
        low, high = sorted((luminance(ink), luminance(paper)))
        assert (high + 0.05) / (low + 0.05) >= 4.5, selector  # WCAG 2 AA
    assert (luminance(pairs[0][2]) < 0.1) == (scheme == "dark")


def test_it_plays_the_noisy_frames_beside_the_best_method(browser: Any, tmp_path: Path) -> None:
    results = [replace(r, name="rival") if r.name == "other" else r for r in RESULTS]
    images = [MethodImages(name, scene(0.5)) for name in ("noisy", "final", "rival")]
    report = Report(Comparison("Hall", tuple(results)), ShotImages(images, scene(0.5), [8, 9, 10]))
    with browser.new_context(viewport={"width": 1440, "height": 900}) as context:
        tab = context.new_page()
        tab.goto(write_report(tmp_path, report).as_uri())
        until(tab, "document.getElementById('animation-play').getAttribute('aria-pressed') === 'true'")
        chosen = [tab.locator(f"#{name}").evaluate("e => e.selectedOptions[0].text") for name in PLAYED]
        assert chosen == ["noisy", "final"] * 2
        assert "over rival" in tab.inner_text(".figures")
        assert tab.evaluate("document.querySelector('#results .scroll').scrollWidth <= innerWidth")


PLAYED = ("animation-left", "animation-right", "left", "right")
