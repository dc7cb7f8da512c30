import time
from dataclasses import replace

import numpy as np
import pytest

from hybrid import cli
from hybrid.denoising.first_pass import find_first_pass
from hybrid.denoising.plan import Rules
from hybrid.denoising.stabilize import Denoised, WindowDenoiser
from hybrid.files.frame import cut_middle
from hybrid.files.shots import open_shot
from hybrid.run import budget, job
from hybrid.run.budget import Measured, measure_presets, parse_budget
from hybrid.run.job import MEASURED, DenoiseOptions
from tests.scenes import Scene

SCENE = Scene(height=40, width=56, frames=5)


@pytest.mark.parametrize(
    ("text", "seconds"), [("10s", 10), ("10", 10), ("500ms", 0.5), ("2m", 120), ("1.5 min", 90), (".5s", 0.5)]
)
def test_times_are_understood(text, seconds):
    assert parse_budget(text) == pytest.approx(seconds)


@pytest.mark.parametrize("text", ["", "s", "-1s", "0", "10h", "1e3", "ten"])
def test_what_is_no_time_is_refused(text):
    with pytest.raises(ValueError, match="expected a time per frame"):
        parse_budget(text)


def test_a_part_is_cut_out_of_the_middle(tmp_path):
    shot = open_shot(SCENE.write(tmp_path))
    whole, part = (s.read(SCENE.first) for s in (shot, cut_middle(shot, 16)))
    np.testing.assert_array_equal(part.color, whole.color[12:28, 20:36])
    np.testing.assert_array_equal(part.motion, whole.motion[12:28, 20:36])
    assert part.depth.shape == (16, 16)
    np.testing.assert_array_equal(cut_middle(shot, 99).read(SCENE.first).color, whole.color)


class Fake(WindowDenoiser):
    """A denoiser that calls a function with each window."""

    radius = 1

    def __init__(self, function):
        self.function = function

    def __call__(self, window):
        self.function(window)
        return Denoised(window.color[1])


@pytest.mark.parametrize("estimate", ["nlm", "sequence"])
def test_presets_are_measured_in_turn(tmp_path, monkeypatch, estimate):
    monkeypatch.setattr(budget, "SIDE", 16)
    folder = SCENE.write(tmp_path)
    shot, seen = open_shot(folder), []
    source = find_first_pass(str(folder) if estimate == "sequence" else estimate, shot)

    def load(preset):
        return Fake(lambda window: seen.append((preset, window.number))), source

    measured = list(measure_presets(shot, Rules(), MEASURED, load))
    assert [m.preset for m in measured] == ["quality", "balanced", "fast"]
    assert all(m.seconds > 0 for m in measured)
    # Two frames in the middle, and those beside them, whose pictures they are averaged with.
    assert seen == [(m.preset, SCENE.first + k) for m in measured for k in (0, 1, 2, 3)]


def test_of_two_frames_that_are_all_both_count(tmp_path):
    shot = open_shot(replace(SCENE, frames=2).write(tmp_path))
    source = find_first_pass("nlm", shot)
    # Both pictures are made for the first frame; the second alone would have cost next to nothing.
    measured = measure_presets(shot, Rules(), MEASURED, lambda _: (Fake(lambda window: time.sleep(0.2)), source))
    assert all(m.seconds >= 0.2 for m in measured)


@pytest.mark.parametrize(("asked", "chosen", "tried"), [("9s", "quality", 1), ("5s", "balanced", 2), ("1s", "fast", 3)])
def test_the_most_accurate_that_fits_is_taken(tmp_path, monkeypatch, caplog, asked, chosen, tried):
    pytest.importorskip("torch")
    shot, times = open_shot(SCENE.write(tmp_path)), {"quality": 8.0, "balanced": 4.0, "fast": 2.0}
    measured = []

    def measure(*_):
        for preset, seconds in times.items():
            measured.append(preset)
            yield Measured(preset, seconds)

    monkeypatch.setattr(job, "measure_presets", measure)
    with caplog.at_level("INFO"):
        assert job._fit_budget(shot, DenoiseOptions(preset="auto", budget=asked)).preset == chosen
    assert len(measured) == tried  # nothing is measured that is not needed
    said = caplog.text
    assert f"preset: {chosen}" in said
    assert ("no preset fits --budget 1s: the fastest is used" in said) == (asked == "1s")


def test_a_budget_and_a_preset_are_not_both_chosen(tmp_path):
    pytest.importorskip("torch")
    shot = str(SCENE.write(tmp_path / "in"))
    for options in (
        ["--budget", "9s", "--preset", "fast"],
        ["--preset", "auto"],
        ["--preset", "auto", "--budget", "9s", "--weights", "w"],
    ):
        assert cli.main(["denoise", shot, "-o", str(tmp_path / "out"), *options]) == 2
    assert cli.main(["denoise", shot, "-o", str(tmp_path / "out"), "--preset", "auto", "--budget", "soon"]) == 2


def test_a_budget_alone_chooses_the_preset():
    assert DenoiseOptions(budget="9s").preset == "auto"
    assert DenoiseOptions().preset == "balanced"
