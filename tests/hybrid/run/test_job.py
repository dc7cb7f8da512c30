"""The way in for other programs does what the command does."""

import doctest
import inspect
import re
from dataclasses import fields
from pathlib import Path

import numpy as np
import pytest

import ravg
from hybrid.cli import main
from hybrid.files.exr import read_exr
from hybrid.run import job
from hybrid.run.job import PRESETS, DenoiseOptions, replace_options
from hybrid.run.records import read_records
from tests.scenes import Scene

ROOT = Path(__file__).parents[3]


@pytest.mark.neural
@pytest.mark.oidn
@pytest.mark.parametrize(("frames", "numbers", "mode"), [(1, "1001", "oidn"), (3, "1002", "oidn-fast")])
def test_a_frame_alone_starts_from_a_better_first_pass(tmp_path, frames, numbers, mode):
    """No average improves it; a frame of a shot has neighbours, though it is denoised alone."""
    shot = ravg.open_shot(Scene(height=32, width=48, frames=frames).write(tmp_path / "in"), frames=numbers)
    (opened,) = job.Job.open(shot, tmp_path / "out", DenoiseOptions(preset="fast")).first_passes
    assert opened.name == mode


def same(made, expected):
    made, expected = ({p.name: read_exr(p) for p in folder.glob("*.exr")} for folder in (made, expected))
    assert made.keys() == expected.keys()
    assert made
    for name, image in made.items():
        for channel in image.channel_names:
            np.testing.assert_array_equal(image.channel(channel), expected[name].channel(channel))


@pytest.mark.parametrize(("preset", "estimate"), [("draft", None), ("draft", "nlm")])
def test_without_a_network_it_is_the_command(shot_folder, tmp_path, preset, estimate):
    shot = ravg.open_shot(shot_folder)
    made = list(ravg.denoise_shot(shot, tmp_path / "made", preset=preset, first_pass=estimate or ""))
    assert [frame.number for frame in made] == [1001, 1002, 1003]
    words = ["denoise", str(shot_folder), "-o", str(tmp_path / "out"), "--preset", preset]
    assert main([*words, *(["--first-pass", estimate] if estimate else [])]) == 0
    same(tmp_path / "made", tmp_path / "out")


def resumed(folder, out, **options):
    shot = ravg.open_shot(folder, aovs=options.pop("aovs", ()))
    return [frame.resumed for frame in ravg.denoise_shot(shot, out, resume=True, **options)]


@pytest.mark.parametrize("changed", [{"no_stages": ["gate"]}, {"stages": ["warp"]}, {"first_pass": "nlm"}])
def test_it_resumes_what_would_be_the_same_alone(shot_folder, tmp_path, changed):
    """Stages that were forced were no reason to make a frame again."""
    assert resumed(shot_folder, tmp_path / "out", preset="draft") == [False] * 3
    assert resumed(shot_folder, tmp_path / "out", preset="draft") == [True] * 3
    assert resumed(shot_folder, tmp_path / "out", preset="draft", **changed) == [False] * 3


@pytest.mark.neural
def test_it_resumes_with_the_same_weights_alone(shot_folder, tmp_path):
    """Weights exchanged under one name were no reason."""
    from safetensors import safe_open
    from safetensors.numpy import save_file

    weights, more = tmp_path / "w.safetensors", {"weights": tmp_path / "w.safetensors"}
    weights.write_bytes((ROOT / "tests" / "data" / "small.safetensors").read_bytes())
    assert resumed(shot_folder, tmp_path / "out", **more) == [False] * 3
    assert resumed(shot_folder, tmp_path / "out", **more) == [True] * 3
    with safe_open(weights, "np") as file:
        scaled, facts = {name: file.get_tensor(name) * 0.9 for name in file.keys()}, file.metadata()  # noqa: SIM118
    save_file(scaled, weights, facts)  # Windows replaces no file that is mapped
    assert resumed(shot_folder, tmp_path / "out", **more) == [False] * 3
    assert resumed(shot_folder, tmp_path / "out", aovs=("ViewLayer.Denoising Albedo",), **more) == [False] * 3


@pytest.mark.neural
@pytest.mark.posix
def test_the_example_runs(tmp_path, monkeypatch):
    monkeypatch.chdir(tmp_path)
    (tmp_path / "examples").symlink_to(ROOT / "examples")
    tried = doctest.testmod(job)
    assert tried.attempted == 3
    assert tried.failed == 0


def states(folder, **options):
    """Whether each frame was there, by `denoise_shot` with resume."""
    return [frame.resumed for frame in ravg.denoise_shot(ravg.open_shot(folder), resume=True, **options)]


def command(folder, out, *words):
    """Whether each frame was there, by the command with --resume."""
    assert main(["denoise", str(folder), "-o", str(out), "--resume", *words]) == 0
    *_, (_, record) = read_records(out)
    return [entry["state"] == "there" for entry in record["frames"].values()]


@pytest.mark.parametrize(
    ("options", "words"),
    [
        ({"preset": "draft"}, ["--preset", "draft"]),
        pytest.param(
            {"first_pass": "nlm", "stages": ["warp"], "tile": 64, "passes": 2},
            ["--first-pass", "nlm", "--stages", "warp", "--tile", "64", "--passes", "2"],
            marks=pytest.mark.neural,
        ),
    ],
)
def test_the_command_and_the_api_continue_each_other(shot_folder, tmp_path, options, words):
    """Each made every frame of the other again, to the same pixels."""
    if "tile" in options:
        pytest.importorskip("torch")
    first, second = tmp_path / "first", tmp_path / "second"
    assert states(shot_folder, output=first, **options) == [False] * 3
    assert command(shot_folder, first, *words) == [True] * 3
    assert command(shot_folder, second, *words) == [False] * 3
    assert states(shot_folder, output=second, **options) == [True] * 3
    files = [{path.name: path.read_bytes() for path in out.glob("*.exr")} for out in (first, second)]
    assert files[0] == files[1]
    assert command(shot_folder, first, *words, "--no-stages", "gate") == [False] * 3


@pytest.mark.parametrize("passes", [1, pytest.param(2, marks=pytest.mark.neural)])
def test_progress_counts_the_frames_of_all_passes(shot_folder, tmp_path, passes):
    options = {"preset": "draft"}
    if passes > 1:
        pytest.importorskip("torch")
        options = {"first_pass": "nlm", "passes": passes}
    steps = []
    shot = ravg.open_shot(shot_folder)
    assert len(list(ravg.denoise_shot(shot, tmp_path / "out", progress=steps.append, **options))) == 3
    assert [(step.run, step.done, step.total) for step in steps] == [
        (1 + index // 3, index + 1, 3 * passes) for index in range(3 * passes)
    ]
    assert not list((tmp_path / "out").glob("pass*"))


def test_a_callback_or_closing_ends_the_work_after_a_frame(tmp_path):
    shot = ravg.open_shot(Scene(frames=9).write(tmp_path / "in"))
    ended = ravg.denoise_shot(shot, tmp_path / "a", preset="draft", progress=lambda step: step.done < 2)
    assert [frame.number for frame in ended] == [1001, 1002]
    closed = ravg.denoise_shot(shot, tmp_path / "b", preset="draft")
    next(closed)
    closed.close()
    for out in (tmp_path / "a", tmp_path / "b"):
        written = sorted(out.iterdir())
        assert 1 <= len(written) <= 4
        for path in written:
            assert read_exr(path).channel_names == read_exr(tmp_path / "in" / path.name).channel_names


@pytest.mark.parametrize(
    ("options", "words"),
    [
        ({"preset": "best"}, "expected one of balanced, fast"),
        ({"method": "magic"}, "expected one of network, classical"),
        ({"method": "classical", "preset": "fast"}, "expected one of standard, draft, final with method classical"),
        ({"preset": "auto"}, "budget chooses the preset"),
        ({"threshold": 1.0}, "expected 0 <= threshold < 1"),
        ({"tile": 3}, "tile is 3, expected at least 16"),
        ({"passes": 0}, "passes is 0, expected at least 1"),
        ({"precision": "float8"}, "expected one of auto, float32, bfloat16"),
        ({"aov_sum": "both"}, "expected one of layers, beauty"),
        ({"strength": 1.5}, "strength is 1.5, expected 0 <= strength <= 1"),
        ({"strength": 0.5, "passes": 2}, "expected --passes 1"),
        ({"stages": ["polish"]}, "stage is 'polish'"),
        ({"max_memory": "much"}, "max-memory is 'much'"),
        ({"preset": "draft", "breakdown": Path("b.png")}, "breakdown is of the network"),
        ({"colour": 1}, "option 'colour' is not there"),
        ({"threads": 10**6}, "threads is 1000000, expected at most 1024"),
        ({"threads": "2"}, "threads is '2', expected a whole number"),
        ({"tile": 64.5}, "tile is 64.5, expected a whole number"),
        ({"passes": True}, "passes is True, expected a whole number"),
        ({"threshold": "0.5"}, "threshold is '0.5', expected a number"),
        ({"budget": 10}, "budget is 10, expected text"),
        ({"max_memory": 8}, "max_memory is 8, expected text"),
        ({"resume": "no"}, "resume is 'no', expected True or False"),
        ({"stages": "gate"}, "stages is 'gate', expected a list of names"),
        ({"weights": 1}, "weights is 1, expected a path"),
        ({"method": "classical", "stages": ["stabilize"]}, "stabilize is a stage of the network"),
    ],
)
def test_options_are_validated_before_a_file_is_opened(options, words):
    with pytest.raises(ValueError, match=words):
        replace_options(None, options)


def test_text_stands_for_paths_and_lists_for_tuples():
    options = DenoiseOptions(preset="fast", breakdown="b.png", keep_first_pass=Path("kept"), stages=["gate"])
    assert (options.breakdown, options.keep_first_pass, options.stages) == (Path("b.png"), "kept", ("gate",))
    assert hash(options) == hash(replace_options(options, {"stages": ("gate",)}))


def test_what_is_no_shot_no_output_or_no_options_is_refused(shot_folder, tmp_path):
    shot = ravg.open_shot(shot_folder)
    for arguments, words in (
        (("shot.####.exr", tmp_path), "shot is 'shot.####.exr', expected a Shot from ravg.open_shot"),
        ((shot, None), "output is None, expected a pattern"),
        ((shot, tmp_path, "draft"), "options is 'draft', expected DenoiseOptions"),
    ):
        with pytest.raises(ValueError, match=words):
            ravg.denoise_shot(*arguments)


def test_presets_and_methods_belong_together():
    assert [DenoiseOptions(preset=name).method for name in ("quality", "draft")] == ["network", "classical"]
    assert [DenoiseOptions(method=name).preset for name in PRESETS] == ["balanced", "standard"]
    assert [DenoiseOptions(method=name).first_pass for name in PRESETS] == ["auto", "none"]


@pytest.mark.parametrize("in_memory", [False, True])
def test_threads_and_the_allocator_are_those_that_were_asked_for(shot_folder, tmp_path, monkeypatch, in_memory):
    called = []
    monkeypatch.setattr(job, "limit_threads", lambda count: called.append(count))
    monkeypatch.setattr(job, "reuse_freed_memory", lambda: called.append("reuse"))

    def run(**options):
        if in_memory:
            list(ravg.denoise_arrays([{"color": np.ones((16, 16, 3))}], preset="draft", **options))
        else:
            shot = ravg.open_shot(shot_folder, frames="1002")
            list(ravg.denoise_shot(shot, tmp_path / "out", preset="draft", **options))

    run()
    assert called == ["reuse"]
    run(threads=3, reuse_freed_memory=False)
    assert called == ["reuse", 3]


def test_help_in_python_states_every_option():
    text = inspect.getdoc(DenoiseOptions)
    for entry in fields(DenoiseOptions):
        assert re.search(rf"^{entry.name} : .+\n    \S", text, re.MULTILINE), entry.name
