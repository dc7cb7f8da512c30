"""Options and results reach what they are for: connections that could be cut without another test noticing."""

import json

import numpy as np
import pytest

import hybrid
from hybrid import budget, job
from hybrid.cli import main
from hybrid.files.exr import read_exr
from hybrid.files.shots import open_matching_sequence, open_shot
from hybrid.memory import plan_rows
from tests.scenes import Scene


def color(path):
    return open_shot(path).read(1002).color


def settings(path):
    return json.loads(read_exr(path / "shot.1002.exr").parts[0].header["ravg/settings"])


@pytest.fixture
def denoise(shot_folder, tmp_path):
    """Denoise the middle of three frames; return the folder of the result."""

    def run(out, *options):
        words = ["denoise", str(shot_folder), "-o", str(tmp_path / out), "--frames", "1002", *map(str, options)]
        assert main(words) == 0
        return tmp_path / out

    return run


@pytest.mark.neural
def test_frames_that_are_measured_for_a_budget_are_not_kept(denoise, tmp_path, monkeypatch):
    """They are parts of frames."""
    pytest.importorskip("torch")
    pytest.importorskip("pyoidn")
    monkeypatch.setattr(budget, "SIDE", 16)
    words = ["--preset", "auto", "--budget", "1000s", "--first-pass", "oidn-fast"]
    denoise("out", *words, "--keep-first-pass", tmp_path / "kept")
    assert open_shot(tmp_path / "kept").shape == (Scene.height, Scene.width)


@pytest.mark.oidn
def test_a_first_pass_that_is_kept_is_that_of_the_forced_stages(denoise, tmp_path):
    pytest.importorskip("pyoidn")
    words = ["--method", "classical", "--first-pass", "oidn-fast", "--keep-first-pass", tmp_path / "kept"]
    times = []
    for more in ([], [], ["--no-stages", "fireflies"]):
        denoise("out", *words, *more)
        times.append((tmp_path / "kept" / "shot.1002.exr").stat().st_mtime_ns)
    assert times[0] == times[1] < times[2]


def test_the_classical_first_pass_has_the_preset(denoise):
    draft, final = (color(denoise(preset, "--preset", preset, "--first-pass", "nlm")) for preset in ("draft", "final"))
    assert not np.array_equal(draft, final)


@pytest.mark.oidn
def test_the_device_of_the_first_pass_is_in_the_header(denoise):
    pytest.importorskip("pyoidn")
    assert settings(denoise("out", "--preset", "draft", "--first-pass", "oidn-fast"))["device"] == {"oidn": "cpu"}


def test_memory_is_shared_between_the_views_of_a_file(tmp_path, monkeypatch):
    """A limit with two view layers was refused, as the color could be either."""

    def edit(index, layers):
        layers |= {name.replace("ViewLayer", "Fog"): layer.copy() for name, layer in layers.items()}

    asked = []

    def plan(limit, *args, **options):
        asked.append(limit)
        return plan_rows(limit, *args, **options)

    monkeypatch.setattr(job, "plan_rows", plan)
    shot = open_shot(Scene(frames=2).write(tmp_path / "in", edit=edit))
    options = job.DenoiseOptions(preset="draft", max_memory="8G")
    assert len(job.Job.open(shot, tmp_path / "out", options).views) == 2
    assert asked[-1] == 4 * 2**30


def test_the_number_of_threads_is_that_which_was_asked_for(shot_folder, tmp_path, monkeypatch):
    asked = []
    monkeypatch.setattr(job, "limit_threads", asked.append)
    shot = open_shot(shot_folder)
    assert len(list(hybrid.denoise_shot(shot, tmp_path / "out", preset="draft", threads=2))) == 3
    assert asked == [2]


def test_a_matching_sequence_has_the_frames_that_were_asked_for(shot_folder):
    assert open_matching_sequence(shot_folder, open_shot(shot_folder), frames="1002-1003").numbers == (1002, 1003)
