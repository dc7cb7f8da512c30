"""Options and results reach what they are for: connections that could be cut without another test noticing."""

import json
import os
import shutil
from dataclasses import replace
from pathlib import Path
from types import SimpleNamespace

import numpy as np
import pytest

import ravg
from hybrid.alignment.align import align
from hybrid.cli import main
from hybrid.commands.shots import ShotInput
from hybrid.comparison.results import Comparison
from hybrid.denoising.plan import Rules
from hybrid.denoising.stabilize import Denoised, FrameDenoiser, FrameResult
from hybrid.denoising.stream import FrameStream
from hybrid.files.decode import decode_frame
from hybrid.files.exr import read_exr
from hybrid.files.replace import replace_file
from hybrid.files.shots import open_matching_sequence, open_shot
from hybrid.run import budget, job
from hybrid.run.memory import MemoryPlan, plan_memory
from hybrid.run.pipeline import View, denoise_frames
from hybrid.run.records import read_records
from tests.scenes import Function, Scene

ROOT = Path(__file__).parents[2]


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


def test_memory_is_shared_between_the_views_of_a_file(tmp_path, monkeypatch):
    """A limit with two view layers was refused, as the color could be either."""

    def edit(index, layers):
        layers |= {name.replace("ViewLayer", "Fog"): layer.copy() for name, layer in layers.items()}

    asked = []

    def plan(limit, *args, **options):
        asked.append(limit)
        return plan_memory(limit, *args, **options)

    monkeypatch.setattr(job, "plan_memory", plan)
    shot = open_shot(Scene(frames=2).write(tmp_path / "in", edit=edit))
    options = job.DenoiseOptions(preset="draft", max_memory="8G")
    assert len(job.Job.open(shot, tmp_path / "out", options).views) == 2
    assert asked[-1] == 4 * 2**30


@pytest.mark.parametrize("plan", [MemoryPlan(64, True, False), MemoryPlan(None, False, True)])
def test_a_run_keeps_to_its_plan_of_memory(shot_folder, tmp_path, monkeypatch, plan):
    asked = []
    monkeypatch.setattr(job, "plan_memory", lambda *_, **__: plan)
    monkeypatch.setattr(job, "denoise_frames", lambda *words, **_: iter(asked.append(words[4]) or ()))
    options = job.DenoiseOptions(preset="draft", max_memory="8G")
    assert list(job.Job.open(open_shot(shot_folder), tmp_path / "out", options).run()) == []
    assert [made.memory for made in asked] == [plan]


def test_the_number_of_threads_is_that_which_was_asked_for(shot_folder, tmp_path, monkeypatch):
    """Also while layers are checked, before the run: memory that was freed there was not used again."""
    asked, validate = [], job.validate_views
    monkeypatch.setattr(job, "limit_threads", asked.append)
    monkeypatch.setattr(job, "validate_views", lambda *words, **more: validate(*words, **more) if asked else None)
    shot = open_shot(shot_folder)
    assert len(list(ravg.denoise_shot(shot, tmp_path / "out", preset="draft", threads=2))) == 3
    assert asked == [2]


def test_a_matching_sequence_has_the_frames_that_were_asked_for(shot_folder):
    assert open_matching_sequence(shot_folder, open_shot(shot_folder), frames="1002-1003").numbers == (1002, 1003)


def test_the_network_has_the_tile_and_the_layers_that_were_asked_for(monkeypatch):
    """With a limit of memory too, as pictures depend on tiles; layers to be summed where the beauty is their sum."""
    fake = SimpleNamespace(
        shipped_weights=lambda preset: preset,
        open_network=lambda _, **options: SimpleNamespace(needs_first_pass=True, **options),
    )
    monkeypatch.setattr(job, "import_neural", lambda: fake)
    plain, limited, tiled, summed = (
        job.open_denoiser(job.DenoiseOptions(**options))
        for options in ({}, {"max_memory": "8G"}, {"max_memory": "8G", "tile": 64}, {"aov_sum": "beauty"})
    )
    assert [made.tile for made in (plain, limited, tiled)] == [None, None, 64]
    assert [made.add_layers for made in (plain, summed)] == [False, True]


@pytest.mark.neural
def test_only_the_last_pass_resumes_keeps_going_and_counts_weights(shot_folder, tmp_path, monkeypatch):
    runs = []

    def denoise_frames(views, output, denoiser, rules, settings, **options):
        runs.append((denoiser, settings.resume, settings.keep_going))
        yield from ()

    monkeypatch.setattr(job, "denoise_frames", denoise_frames)
    monkeypatch.setattr(job, "write_breakdown", lambda *_: None)
    asked = {"first_pass": "nlm", "passes": 2, "resume": True, "keep_going": True, "breakdown": tmp_path / "b.png"}
    opened = job.Job.open(open_shot(shot_folder), tmp_path / "out", job.DenoiseOptions(**asked))
    assert list(opened.run()) == []
    assert [run[1:] for run in runs] == [(False, False), (True, True)]
    assert [run[0] is opened.denoiser for run in runs] == [False, True]


@pytest.mark.neural
def test_the_weights_of_a_bundled_first_pass_are_in_the_header(shot_folder, tmp_path):
    options = job.DenoiseOptions(first_pass="bundled")
    made = job.Job.open(open_shot(shot_folder), tmp_path / "out", options).settings
    assert len(made["bundled"]) == len(made["weights"]) == 16


@pytest.mark.neural
def test_the_record_names_the_weights(denoise):
    out = denoise("out", "--weights", ROOT / "tests" / "data" / "small.safetensors")
    ((_, record),) = read_records(out)
    assert record["preset"] == "small.safetensors"


def test_chunks_of_a_cluster_resume_and_pictures_follow(shot_folder, tmp_path, monkeypatch):
    """A chunk that is run again, after its worker died, skips frames that are finished."""
    chunks, pictures = {}, []
    monkeypatch.setattr("hybrid.commands.denoise.run_on_cluster", lambda _, what, found: chunks.update(found))
    monkeypatch.setattr("hybrid.commands.denoise._write_pictures", lambda *_: pictures.append(dict(chunks)))
    words = ["denoise", str(shot_folder), "-o", str(tmp_path / "out"), "--preset", "draft", "--chunk", "2"]
    assert main([*words, "--scheduler", "tcp://127.0.0.1:1", "--preview", str(tmp_path / "x.png")]) == 0
    assert len(chunks) == 2
    assert all("--resume" in chunk.arguments for chunk in chunks.values())
    assert pictures == [chunks]


@pytest.mark.parametrize("where", ["the color of the second view", "another layer"])
def test_nothing_that_is_not_finite_is_written_of_any_view(tmp_path, where):
    def edit(index, layers):
        for name in list(layers):
            layers[name.replace("ViewLayer", "Zenith")] = layers[name] * np.float32(9 if "Combined" in name else 1)

    def denoise(aligned):
        color = aligned.color[aligned.middle] * aligned.modulation
        if where == "another layer":
            return Denoised(color, {"shadow": np.full(color.shape, np.nan, np.float32)})
        return Denoised(color * np.float32(np.nan) if color.mean() > 3 else color)

    views = [View(view) for view in open_shot(Scene(noise=0.1).write(tmp_path / "in", edit=edit)).views]
    assert len(views) == 2
    with pytest.raises(ValueError, match="it was not written"):
        list(denoise_frames(views, tmp_path / "out", Function(denoise), Rules(off=frozenset({"stabilize"}))))
    assert not list((tmp_path / "out").glob("*.exr"))


def test_a_first_pass_that_cannot_be_kept_is_refused_by_its_own_option(shot_folder, tmp_path, capsys):
    """The error named the output."""
    pytest.importorskip("pyoidn")
    words = ["denoise", str(shot_folder), "-o", str(tmp_path / "out"), "--method", "classical"]
    assert main([*words, "--first-pass", "oidn-fast", "--keep-first-pass", str(tmp_path / "k.exr")]) == 1
    assert "error: keep-first-pass" in capsys.readouterr().err


def test_a_report_has_the_options_of_compare(shot_folder, tmp_path, monkeypatch):
    pytest.importorskip("jinja2")
    pytest.importorskip("matplotlib")
    pages, asked, profiles, open_input = [], [], [], ShotInput.open

    def open_noted(read):
        profiles.append(read.profile)
        return open_input(read)

    def compare_shot(shot, reference, methods, options, **more):
        asked.append(options)
        return Comparison(options.title, (), {})

    monkeypatch.setattr("hybrid.commands.compare.compare_shot", compare_shot)
    monkeypatch.setattr("hybrid.comparison.report.report_images", lambda *_: None)
    monkeypatch.setattr("hybrid.comparison.report.write_report", lambda _, report: pages.append(report))
    monkeypatch.setattr("hybrid.commands.compare.read_comparison", lambda path: Comparison(path.parent.name, (), {}))
    monkeypatch.setattr(ShotInput, "open", open_noted)
    folder, other = str(shot_folder), str(tmp_path / "other")
    words = ["compare", folder, "--reference", folder, "--methods", "draft", "-o", str(tmp_path / "report")]
    words += ["--rounds", "7", "--name", "title", "--clock", "cpu", "--fps", "5", "--with-report", other]
    main([*words, "--profile", "cycles", "--level", f"{folder}=8"])
    assert profiles == ["cycles", "cycles"]
    assert (asked[0].title, asked[0].rounds) == ("title", 7)
    assert pages[0].cost == "cpu_seconds_per_megapixel"
    assert [other.shot for other in pages[0].others] == ["other"]
    assert pages[0].rate == 5


def test_a_frame_that_is_not_to_be_demodulated_is_not(shot_folder):
    frame = FrameStream(open_shot(shot_folder), Rules(off=frozenset({"demodulate"}))).frame(1002)
    np.testing.assert_array_equal(frame.irradiance, frame.radiance)


def test_the_header_has_the_stages_of_the_first_view_and_the_neighbours_of_all(tmp_path, monkeypatch):
    def edit(index, layers):
        layers |= {name.replace("ViewLayer", "Zenith"): layer for name, layer in layers.items()}

    fakes = []

    class Fake:
        def __init__(self, stream, denoise, **options):
            self.stream, self.first = stream, not fakes
            fakes.append(self)

        def neighbours(self, number):
            return [number]

        def make(self, number):
            plan = SimpleNamespace(stages={"gate" if self.first else "warp"})
            color = self.stream.frame(number).radiance
            averaged = (number, number + 1) if self.first else (number,)
            return FrameResult(Denoised(color), plan, averaged, 0.0, 0.0, 0, 0, 0, 0)

    monkeypatch.setattr("hybrid.run.pipeline.FrameDenoiser", Fake)
    views = open_shot(Scene(frames=2).write(tmp_path / "in", edit=edit)).views
    assert len(list(denoise_frames([View(view) for view in views], tmp_path / "out", Function(Denoised), Rules()))) == 2
    header = read_exr(tmp_path / "out" / "shot.1001.exr").parts[0].header
    assert header["ravg/stages"] == "gate"
    assert header["ravg/beside"] == ""


def test_the_outliers_of_all_bands_are_counted(shot_folder, monkeypatch):
    monkeypatch.setattr(
        "hybrid.denoising.stabilize.align", lambda *args, **options: replace(align(*args, **options), outliers=3)
    )
    stream = FrameStream(open_shot(shot_folder), Rules(off=frozenset({"stabilize"})))

    def denoise(aligned):
        return Denoised(aligned.color[aligned.middle] * aligned.modulation)

    denoiser = FrameDenoiser(stream, Function(denoise), rows=20)
    assert denoiser.make(1002).outliers == 3 * Scene.height // 20


def test_a_frame_that_changes_while_it_is_read_is_an_error(shot_folder, monkeypatch):
    """Half of it would be of the old file."""
    shot = open_shot(shot_folder)

    def decode_and_render(*args):
        os.utime(shot.path(1002), (1, 1))
        return decode_frame(*args)

    monkeypatch.setattr("hybrid.files.reader.decode_frame", decode_and_render)
    with pytest.raises(OSError, match="has changed since it was read"):
        shot.read(1002)


@pytest.mark.posix
def test_a_run_removes_what_a_killed_one_has_left(denoise, tmp_path):
    (tmp_path / "out").mkdir()
    with replace_file(tmp_path / "out" / "shot.1002.exr") as temporary:
        temporary.write_bytes(b"half")
        shutil.copy(temporary, tmp_path / "half")
        name = temporary.name
    shutil.copy(tmp_path / "half", tmp_path / "out" / name)
    denoise("out", "--preset", "draft")
    assert [path.name for path in (tmp_path / "out").iterdir() if path.name.startswith(".")] == []


def test_the_status_of_a_sequence_is_not_that_of_its_folder(shot_folder, tmp_path, capsys):
    for name, frames in (("a", "1001-1003"), ("b", "1002")):
        words = ["denoise", str(shot_folder), "-o", str(tmp_path / "out" / f"{name}.####.exr"), "--frames", frames]
        assert main([*words, "--preset", "draft"]) == 0
    capsys.readouterr()
    assert main(["status", str(tmp_path / "out" / "b.####.exr"), "--json"]) == 0
    assert json.loads(capsys.readouterr().out)["sequences"][0]["asked"] == [1002]
