"""Each option of `denoise` reaches the frames; old names do what they did."""

import json
from pathlib import Path

import numpy as np
import pytest

from hybrid.cli import main
from hybrid.files.exr import read_exr
from hybrid.files.shots import open_shot
from hybrid.run.records import read_records
from tests.scenes import Scene

KERNELS = Path(__file__).parents[2] / "data" / "small.safetensors"
NUMBER = 1002


@pytest.fixture
def run(shot_folder, tmp_path):
    """Denoise the middle of three frames with some options; return its color, and what its header says."""
    runs = iter(range(99))

    def denoise(*options, command="denoise"):
        out = tmp_path / f"out{next(runs)}"
        words = [command, str(shot_folder), "-o", str(out), "--frames", str(NUMBER), *map(str, options)]
        assert main(words) == 0
        header = read_exr(out / f"shot.{NUMBER}.exr").parts[0].header
        return open_shot(out).read(NUMBER).color, {**header, **json.loads(header["ravg/settings"])}

    return denoise


network = pytest.mark.neural
ALONE = ["--first-pass", "nlm", "--precision", "float32"]


@network
def test_the_preset_is_the_network_that_runs(run):
    made = {preset: run("--preset", preset, *ALONE) for preset in ("fast", "balanced", "quality")}
    assert {preset: header["ravg/preset"] for preset, (_, header) in made.items()} == {name: name for name in made}
    assert len({header["weights"] for _, header in made.values()}) == 3
    for one, other in (("fast", "balanced"), ("balanced", "quality")):
        assert not np.array_equal(made[one][0], made[other][0])
    np.testing.assert_array_equal(run(*ALONE)[0], made["balanced"][0])


@network
def test_tile_and_precision_are_those_that_were_asked_for(run):
    _, header = run(*ALONE, "--tile", 32)
    assert (header["tile"], header["precision"]) == (32, "float32")
    assert run("--first-pass", "nlm", "--precision", "bfloat16")[1]["precision"] == "bfloat16"


@network
def test_the_threshold_drops_taps(run):
    low, high = (run("--weights", KERNELS, "--threshold", value)[0] for value in (0, 0.9))
    assert not np.array_equal(low, high)


@network
def test_without_a_first_pass_a_network_takes_the_classical_one(run):
    color, header = run("--first-pass", "none", "--precision", "float32")
    assert header["ravg/first-pass"] == "nlm"
    np.testing.assert_array_equal(color, run(*ALONE)[0])


@network
def test_weights_of_a_preset_do_the_same_when_given_as_a_file(run):
    """Their first pass too: with another they seemed 0.9 dB better than the preset."""
    pytest.importorskip("pyoidn")
    from hybrid import neural

    color, header = run("--preset", "fast")
    given, other = run("--weights", neural.shipped_weights("fast"))
    assert header["ravg/first-pass"] == other["ravg/first-pass"] == "oidn-fast"
    np.testing.assert_array_equal(given, color)


def test_the_first_pass_is_kept_and_read_again(run, tmp_path):
    pytest.importorskip("pyoidn")
    options = ["--method", "classical", "--first-pass", "oidn-fast", "--keep-first-pass", tmp_path / "kept"]
    color, _ = run(*options)
    kept = tmp_path / "kept" / f"shot.{NUMBER}.exr"
    before = kept.stat().st_mtime_ns
    np.testing.assert_array_equal(run(*options)[0], color)
    assert kept.stat().st_mtime_ns == before


@network
def test_the_second_pass_starts_from_the_frames_of_the_first(run, tmp_path, capsys):
    _, header = run(*ALONE, "--passes", 2)
    assert header["ravg/first-pass"] == "pass 1 of 2"
    assert (header["first-pass"], header["passes"]) == ("nlm", 2)
    assert "First pass  nlm (asked for); pass 1 of 2 for the last" in capsys.readouterr().err
    assert not list(tmp_path.glob("out*/pass*"))


@pytest.mark.parametrize(
    "options",
    [
        ["--preset", "auto"],
        ["--budget", "5s", "--preset", "fast"],
        ["--budget", "5s", "--method", "classical"],
        ["--method", "classical", "--preset", "fast"],
        ["--method", "classical", "--passes", "2"],
        ["--method", "classical", "--tile", "64"],
        ["--method", "classical", "--stages", "skip"],
        ["--method", "classical", "--weights", "w.safetensors"],
        ["--method", "pooled"],
        ["--breakdown", "b.jpg"],
        ["--breakdown", "b.png", "--max-memory", "8G"],
        ["--first-pass", "theirs"],
        ["--stages", "no-stage"],
        ["--method", "classical", "--preview", "x.avi"],
        ["--method", "classical", "--contact-sheet", "x.jpg"],
    ],
)
@pytest.mark.parametrize("more", [[], ["--scheduler", "tcp://127.0.0.1:1"]])
def test_options_that_contradict_each_other_are_refused_before_a_file_is_opened(options, more, tmp_path, capsys):
    """With --scheduler every chunk failed on the cluster."""
    assert main(["denoise", str(tmp_path / "nowhere"), "-o", str(tmp_path / "out"), *options, *more]) == 2
    assert not (tmp_path / "out").exists()


def test_a_layer_that_makes_no_sense_ends_a_strict_run_and_is_on_record(tmp_path, capsys):
    folder = Scene().write(tmp_path / "in")  # whose normal is constant
    words = ["denoise", str(folder), "-o", str(tmp_path / "out"), "--preset", "draft"]
    assert main([*words, "--strict"]) == 1
    ((_, record),) = read_records(tmp_path / "out")
    assert record["state"] == "failed"
    assert "is constant" in record["error"]
    assert main(words) == 0


def test_a_run_that_fails_before_its_first_frame_leaves_the_record_of_one_that_made_frames(tmp_path, capsys):
    """The record was replaced, and status counted the finished frames as failed."""
    folder = Scene().write(tmp_path / "in")  # whose normal is constant
    words = ["denoise", str(folder), "-o", str(tmp_path / "out"), "--preset", "draft"]
    assert main(words) == 0
    before = list(read_records(tmp_path / "out"))
    assert main([*words, "--strict"]) == 1
    assert list(read_records(tmp_path / "out")) == before
    assert main(["status", str(tmp_path / "out")]) == 0
