"""The way in for other programs does what the command does."""

import doctest
from pathlib import Path

import numpy as np
import pytest

import hybrid
from hybrid import job
from hybrid.cli import main
from hybrid.files.exr import read_exr
from hybrid.pipeline import Failed
from tests.scenes import Scene

ROOT = Path(__file__).parents[2]


def same(made, expected):
    made, expected = ({p.name: read_exr(p) for p in folder.glob("*.exr")} for folder in (made, expected))
    assert made.keys() == expected.keys()
    assert made
    for name, image in made.items():
        for channel in image.channel_names:
            np.testing.assert_array_equal(image.channel(channel), expected[name].channel(channel))


@pytest.mark.parametrize(("preset", "estimate"), [("draft", None), ("draft", "nlm")])
def test_without_a_network_it_is_pseudoref(shot_folder, tmp_path, preset, estimate):
    shot = hybrid.open_shot(shot_folder)
    made = list(hybrid.denoise_shot(shot, tmp_path / "made", preset=preset, first_pass=estimate or ""))
    assert [frame.number for frame in made] == [1001, 1002, 1003]
    words = ["denoise", str(shot_folder), "-o", str(tmp_path / "out"), "--preset", preset]
    assert main([*words, *(["--first-pass", estimate] if estimate else [])]) == 0
    same(tmp_path / "made", tmp_path / "out")


@pytest.mark.neural
def test_with_a_network_it_is_denoise(shot_folder, tmp_path):
    pytest.importorskip("torch")
    shot = hybrid.open_shot(shot_folder)
    assert len(list(hybrid.denoise_shot(shot, tmp_path / "made", preset="fast", first_pass="nlm"))) == 3
    assert main(["denoise", str(shot_folder), "-o", str(tmp_path / "out"), "--first-pass", "nlm"]) == 0
    same(tmp_path / "made", tmp_path / "out")


def resumed(folder, out, **options):
    shot = hybrid.open_shot(folder, aovs=options.pop("aovs", ()))
    return [frame.resumed for frame in hybrid.denoise_shot(shot, out, resume=True, **options)]


@pytest.mark.parametrize("changed", [{"no_stages": ["gate"]}, {"stages": ["warp"]}, {"first_pass": "nlm"}])
def test_it_resumes_what_would_be_the_same_alone(shot_folder, tmp_path, changed):
    """Stages that were forced were no reason to make a frame again."""
    assert resumed(shot_folder, tmp_path / "out", preset="draft") == [False] * 3
    assert resumed(shot_folder, tmp_path / "out", preset="draft") == [True] * 3
    assert resumed(shot_folder, tmp_path / "out", preset="draft", **changed) == [False] * 3


@pytest.mark.neural
def test_it_resumes_with_the_same_weights_alone(shot_folder, tmp_path):
    """Weights exchanged under one name were no reason."""
    pytest.importorskip("torch")
    from safetensors import safe_open
    from safetensors.numpy import save_file

    weights, more = tmp_path / "w.safetensors", {"weights": tmp_path / "w.safetensors"}
    weights.write_bytes((ROOT / "tests" / "data" / "small.safetensors").read_bytes())
    assert resumed(shot_folder, tmp_path / "out", **more) == [False] * 3
    assert resumed(shot_folder, tmp_path / "out", **more) == [True] * 3
    with safe_open(weights, "np") as file:
        save_file({name: file.get_tensor(name) * 0.9 for name in file.keys()}, weights, file.metadata())  # noqa: SIM118
    assert resumed(shot_folder, tmp_path / "out", **more) == [False] * 3
    assert resumed(shot_folder, tmp_path / "out", aovs=("ViewLayer.Denoising Albedo",), **more) == [False] * 3


@pytest.mark.posix
def test_the_example_runs(tmp_path, monkeypatch):
    monkeypatch.chdir(tmp_path)
    (tmp_path / "examples").symlink_to(ROOT / "examples")
    tried = doctest.testmod(job)
    assert tried.attempted == 3
    assert tried.failed == 0


def test_frames_that_cannot_be_made(tmp_path):
    folder = Scene(frames=6).write(tmp_path / "in")
    victim = folder / "shot.1006.exr"
    victim.write_bytes(victim.read_bytes()[:-2000])
    made = list(hybrid.denoise_shot(hybrid.open_shot(folder), tmp_path / "out", preset="draft", keep_going=True))
    assert [frame.number for frame in made if isinstance(frame, Failed)] == [1004, 1005, 1006]
    with pytest.raises(ValueError, match=r"shot\.1006\.exr"):
        list(hybrid.denoise_shot(hybrid.open_shot(folder), tmp_path / "out", preset="draft"))


def test_the_input_is_spared(shot_folder):
    with pytest.raises(ValueError, match="overwrite"):
        next(hybrid.denoise_shot(hybrid.open_shot(shot_folder), shot_folder, preset="draft"))


def test_there_is_nothing_else():
    with pytest.raises(AttributeError, match="no attribute 'denoise'"):
        hybrid.denoise  # noqa: B018
