"""The page of `ravg view` in a real browser, beside frames that are still being made."""

import threading
from collections.abc import Iterator
from typing import Any

import numpy as np
import pytest

from hybrid.files.png import encode_filmic, encode_srgb
from hybrid.run.records import Record
from hybrid.runtime.timing import Stage, Timings
from hybrid.viewer.sequence import Sequence
from hybrid.viewer.server import ViewServer
from tests.scenes import Scene

pytestmark = pytest.mark.browser

# Radiance of noisy frame k is k times this, of denoised frame k half of it; frames are of one gray each.
GRAY = 0.1
FRAMES = 6
EVIL = "<img src=x onerror='window.pwned=1'>"


def gray(factor):
    def edit(index, layers):
        layers["ViewLayer.Combined"][:] = factor * GRAY * (index + 1)

    return edit


def write(folder, factor, frames):
    return Scene(frames=frames, first=1, height=36, width=64).write(folder, edit=gray(factor))


@pytest.fixture
def shot(tmp_path):
    """Six noisy frames, of which four are denoised."""
    write(tmp_path / "noisy", 1, FRAMES)
    out = write(tmp_path / "out", 0.5, 4)
    timings = Timings()
    timings.stages["network"] = Stage(seconds=1.5, peak_bytes=300 << 20)
    plan = [{"stage": "gate", "on": False, "reason": "nothing changes its light"}]
    Record(out, "shot", range(1, 7), command="denoise", preset=EVIL, plan=plan).write(timings)
    return tmp_path


@pytest.fixture
def served(shot):
    sequences = [Sequence(str(shot / "out"), finished=True), Sequence(str(shot / "noisy"), finished=False)]
    with ViewServer(sequences, rate=100) as server:
        threading.Thread(target=server.serve_forever, kwargs={"poll_interval": 0.01}, daemon=True).start()
        yield server
        server.shutdown()


@pytest.fixture
def page(browser: Any, served: Any) -> Iterator[Any]:
    tab = browser.new_page(viewport={"width": 1240, "height": 700})
    faults: list[str] = []
    asked: list[str] = []
    tab.on("pageerror", lambda error: faults.append(str(error)))
    tab.on("console", lambda message: faults.append(message.text) if message.type == "error" else None)
    tab.on("request", lambda request: asked.append(request.url))
    tab.goto(served.url)
    settle(tab, 1)
    yield tab
    assert not faults
    assert all(url.startswith((served.url, "data:", "blob:")) for url in asked), "nothing is asked of anybody else"
    tab.close()


def settle(tab: Any, number: int) -> None:
    """Wait until a frame is shown exactly."""
    tab.wait_for_selector(f'#canvas[data-frame="{number}"][data-exact="true"]', timeout=30_000)
    tab.evaluate("new Promise((done) => requestAnimationFrame(() => requestAnimationFrame(done)))")


def pixel(tab: Any, x: float, y: float = 0.5) -> list[int]:
    """Pixels of the canvas, at fractions of its size."""
    return tab.evaluate(
        "([x, y]) => { const c = document.querySelector('#canvas');"
        " return [...c.getContext('2d').getImageData(x * c.width, y * c.height, 1, 1).data].slice(0, 3); }",
        [x, y],
    )


def level(served: Any, radiance: float, ev: float = 0) -> list[int]:
    value = int(np.round(encode_srgb(np.float32(radiance * 2**ev / served.exposure)) * 255))
    return pytest.approx([value] * 3, abs=1)


def test_a_wipe_shows_noisy_left_and_denoised_right(page, served):
    assert pixel(page, 0.25) == level(served, GRAY)
    assert pixel(page, 0.75) == level(served, GRAY / 2)
    assert page.text_content("#labels div:nth-child(1)") == "noisy · ViewLayer.Combined"
    assert page.text_content("#labels div:nth-child(2)") == "out · ViewLayer.Combined"
    box = page.locator("#divider").bounding_box()
    page.mouse.move(box["x"] + 12, 300)
    page.mouse.down()
    page.mouse.move(box["x"] + 12 + 300, 300)
    page.mouse.up()
    page.wait_for_function("() => document.querySelector('#divider').getAttribute('aria-valuenow') > 75")
    settle(page, 1)
    assert pixel(page, 0.75) == level(served, GRAY)


def test_every_arrangement_shows_what_it_says(page, served):
    page.keyboard.press("s")
    settle(page, 1)
    assert (pixel(page, 0.25), pixel(page, 0.75)) == (level(served, GRAY), level(served, GRAY / 2))
    assert pixel(page, 0.25, 0.02) == [24, 24, 26], "a pair is smaller: nothing above it"
    page.keyboard.press("f")
    settle(page, 1)
    assert pixel(page, 0.75) == level(served, GRAY)
    page.keyboard.press("f")
    settle(page, 1)
    assert pixel(page, 0.25) == level(served, GRAY / 2)
    page.keyboard.press("d")
    settle(page, 1)
    noisy, denoised = (round(float(encode_srgb(np.float32(r / served.exposure))) * 255) for r in (GRAY, GRAY / 2))
    assert pixel(page, 0.5)[0] == pytest.approx(min(255, 8 * (noisy - denoised)), abs=16)
    page.click("text=Wipe")
    settle(page, 1)
    page.keyboard.press("x")
    settle(page, 1)
    assert pixel(page, 0.25) == level(served, GRAY / 2), "left and right are swapped"


def test_the_values_under_the_pointer_are_shown(page):
    assert page.text_content("#readout") == "drag to pan, wheel to zoom"
    box = page.locator("#canvas").bounding_box()
    page.mouse.move(box["x"] + box["width"] * 0.25, box["y"] + box["height"] / 2)
    page.wait_for_selector("#readout:has-text('noisy: R')")
    said = page.inner_text("#readout").splitlines()
    assert len(said) == 3
    values = {line.split(":")[0]: float(line.split("R ")[1].split()[0]) for line in said[1:]}
    assert values == {"noisy": pytest.approx(GRAY, rel=1e-3), "out": pytest.approx(GRAY / 2, rel=1e-3)}
    page.keyboard.press("x")  # the values are those of what is shown now
    swapped = "() => document.querySelector('#readout').innerText.split('\\n')[1].startsWith('out')"
    page.wait_for_function(swapped)


def test_exposure_is_in_stops(page, served):
    for _ in range(4):
        page.keyboard.press("]")
    assert page.text_content("#ev-text") == "+1.00 EV"
    settle(page, 1)
    assert pixel(page, 0.25) == level(served, GRAY, 1)


def test_each_side_has_an_exposure_and_a_view(page, served):
    page.fill('[data-side="right"] .ev', "-1")
    page.press('[data-side="right"] .ev', "Tab")
    page.select_option('[data-side="left"] .view', "filmic")
    settle(page, 1)
    filmic = encode_filmic(np.full(3, GRAY / served.exposure, np.float32))
    assert pixel(page, 0.25) == pytest.approx(list(np.round(filmic * 255)), abs=1)
    assert pixel(page, 0.25) != level(served, GRAY)
    assert pixel(page, 0.75) == level(served, GRAY / 2, -1)
    labels = [page.text_content(f"#labels div:nth-child({n})") for n in (1, 2)]
    assert labels == ["noisy · ViewLayer.Combined · filmic", "out · ViewLayer.Combined · −1 EV"]
    page.click("#swap")
    settle(page, 1)
    assert page.input_value('[data-side="right"] .view') == "filmic"


def test_a_sequence_that_comes_into_the_folder_is_offered(page, shot):
    path = shot / "out" / "other.0001.exr"
    path.write_bytes(next((shot / "out").glob("*.exr")).read_bytes())
    page.wait_for_selector(
        '[data-side="left"] .sequence option:nth-child(3):has-text("other.####.exr")', state="attached"
    )


def test_layers_can_be_chosen_on_either_side(page):
    page.select_option('[data-side="right"] .layer', "ViewLayer.Denoising Normal")
    settle(page, 1)
    assert pixel(page, 0.75) == pytest.approx([128, 128, 255], abs=1)
    page.select_option('[data-side="left"] .sequence', "0")
    settle(page, 1)
    assert page.text_content("#labels div:nth-child(1)") == "out · ViewLayer.Combined"


def test_frames_are_scrubbed_and_a_missing_one_is_said(page, served):
    for number in (2, 3, 4):
        page.keyboard.press("ArrowRight")
        settle(page, number)
        assert pixel(page, 0.25) == level(served, number * GRAY)
    page.evaluate("s = document.querySelector('#frame'); s.value = 5; s.dispatchEvent(new Event('input'))")
    page.wait_for_selector("#message:has-text('frame 6 of out does not exist yet')")
    assert page.text_content("#frame-text") == "frame 6"
    page.wait_for_selector("#frame-facts dd:has-text('not finished')")


def test_frames_that_are_finished_later_appear_by_themselves(page, served, shot):
    assert page.text_content("#count") == "4 of 6 frames are finished"
    write(shot / "out", 0.5, FRAMES)
    page.wait_for_selector("#count:has-text('6 of 6 frames are finished')", timeout=30_000)
    for _ in range(FRAMES - 1):
        page.keyboard.press("ArrowRight")
    settle(page, 6)
    assert pixel(page, 0.75) == level(served, 6 * GRAY / 2)


def test_a_frame_that_is_made_again_is_shown_anew(page, served, shot):
    write(shot / "out", 0.25, 1)
    page.wait_for_function(
        "(grey) => { const c = document.querySelector('#canvas');"
        " return Math.abs(c.getContext('2d').getImageData(0.75 * c.width, 0.5 * c.height, 1, 1).data[0] - grey) < 2; }",
        arg=int(np.round(encode_srgb(np.float32(GRAY / 4 / served.exposure)) * 255)),
        timeout=30_000,
    )


def test_it_plays_all_frames_and_stops(page):
    page.evaluate(
        "window.seen = new Set();"
        "new MutationObserver(() => seen.add(document.querySelector('#frame-text').textContent))"
        ".observe(document.querySelector('#frame-text'), { childList: true })"
    )
    page.keyboard.press(" ")
    page.wait_for_function(f"() => window.seen.size === {FRAMES}", timeout=30_000)
    assert page.get_attribute("#play", "aria-label") == "Stop"
    page.click("#play")
    page.wait_for_timeout(200)  # the frame that was its turn when it was stopped is painted after
    stopped = page.text_content("#frame-text")
    page.wait_for_timeout(200)
    assert page.text_content("#frame-text") == stopped


def test_zoom_stays_at_the_pointer_and_goes_back(page):
    page.select_option('[data-side="left"] .layer', "ViewLayer.Denoising Albedo")
    page.select_option('[data-side="right"] .layer', "ViewLayer.Denoising Albedo")
    settle(page, 1)
    box = page.locator("#canvas").bounding_box()
    before = pixel(page, 0.3, 0.4), pixel(page, 0.9, 0.5)
    page.mouse.move(box["x"] + 0.3 * box["width"], box["y"] + 0.4 * box["height"])
    for _ in range(8):
        page.mouse.wheel(0, -100)
    page.wait_for_timeout(100)
    settle(page, 1)
    assert pixel(page, 0.3, 0.4) == pytest.approx(before[0], abs=1)
    assert pixel(page, 0.9, 0.5) != before[1], "something else is at the edge now"
    page.keyboard.press("0")
    settle(page, 1)
    assert (pixel(page, 0.3, 0.4), pixel(page, 0.9, 0.5)) == before


def test_what_the_run_did_is_told_and_is_no_markup(page):
    assert page.text_content("#record tbody").split() == ["network1.50300", "MiB"]
    assert "nothing changes its light" in page.text_content("#plan")
    assert EVIL in page.text_content("#record dl")
    assert page.evaluate("window.pwned") is None
    assert "denoise --breakdown" in page.locator("#no-weights").inner_text()


def test_weights_of_the_frames_are_shown(browser, tmp_path):
    def weighed(index, layers):
        gray(1)(index, layers)
        for name, value in (("before1", 0.2), ("centre", 0.5), ("after1", 0.3)):
            layers[f"weight.{name}"] = np.full(layers["ViewLayer.Combined"].shape[:2], value, np.float32)

    out = Scene(frames=1, first=1).write(tmp_path / "out", edit=weighed)
    with ViewServer([Sequence(str(out), finished=True)]) as server:
        threading.Thread(target=server.serve_forever, kwargs={"poll_interval": 0.01}, daemon=True).start()
        tab = browser.new_page()
        tab.goto(server.url)
        tab.wait_for_selector("#weights meter")
        assert tab.text_content("#weights") == "before10.200centre0.500after10.300"
        assert tab.locator("#no-weights").is_hidden()
        tab.select_option('[data-side="right"] .layer', "weight.centre")
        settle(tab, 1)
        assert pixel(tab, 0.75) == pytest.approx([128] * 3, abs=1)
        tab.close()
        server.shutdown()
