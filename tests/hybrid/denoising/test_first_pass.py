"""Per-frame estimates: where they come from, and what time makes of them."""

import os
import re
from dataclasses import replace
from pathlib import Path

import numpy as np
import pytest

from hybrid.alignment.transfer import BLACK, measure_gain
from hybrid.cli import main
from hybrid.comparison.metrics import psnr
from hybrid.denoising import first_pass
from hybrid.denoising.first_pass import Backends, Classical, GuideAware, PerFrame, find_first_pass
from hybrid.denoising.plan import Rules
from hybrid.denoising.pseudo_reference import DRAFT, STANDARD, gated_average
from hybrid.denoising.stream import FrameStream
from hybrid.files import sources
from hybrid.files.reader import ShotReader
from hybrid.files.shots import open_shot
from hybrid.run.records import read_records
from tests.exr_files import write_layers
from tests.scenes import Scene, only

STAGES = {"demodulate", "outliers", "warp", "gate"}
SCENE = Scene(frames=5, height=48, width=64)
MIDDLE = SCENE.first + 2


def flickering(frame, seed=0):
    """A denoiser of single frames: the truth, but for a smooth error of its own in every frame."""
    rng = np.random.default_rng((seed, frame.number))
    truth = SCENE.clean(frame.number - SCENE.first)["ViewLayer.Combined"]
    return truth * np.float32(1 + 0.02 * rng.standard_normal())


def test_our_own_estimate_of_a_frame_does_not_depend_on_the_window_it_is_asked_from(tmp_path):
    shot = open_shot(SCENE.write(tmp_path))
    sliding = FrameStream(shot, only(STAGES), first_pass=Classical(DRAFT))
    windows = [sliding.align(number) for number in shot.numbers]
    alone = FrameStream(shot, only(STAGES), first_pass=Classical(DRAFT)).align(MIDDLE)
    np.testing.assert_array_equal(windows[2].first_pass, alone.first_pass)
    np.testing.assert_array_equal(gated_average(windows[2]), gated_average(alone))


def lost_pixels(index, layers):
    """Pixels that no denoiser may get."""
    layers["ViewLayer.Combined"][10, 20] = np.inf
    layers["ViewLayer.Denoising Albedo"][5, 6] = np.nan
    layers["ViewLayer.Denoising Normal"] = layers["ViewLayer.Denoising Normal"].copy()
    layers["ViewLayer.Denoising Normal"][7, 8] = np.nan


@pytest.mark.parametrize("stages", [STAGES, STAGES | {"prefilter"}])
def test_a_denoiser_is_told_whether_guides_hold_noise(tmp_path, stages):
    shot = open_shot(SCENE.write(tmp_path, edit=lost_pixels))
    seen = {}

    def denoise(frame, noisy_guides):
        assert frame.number not in seen
        assert noisy_guides == ("prefilter" in stages)
        seen[frame.number] = frame
        return frame.color

    aligner = FrameStream(shot, only(stages), first_pass=GuideAware(denoise))
    for number in shot.numbers:
        aligner.align(number)
    assert sorted(seen) == list(shot.numbers)
    given = shot.read(MIDDLE)
    for name in ("color", "albedo", "normal"):
        before, after = getattr(given, name), getattr(seen[MIDDLE], name)
        assert np.isfinite(after).all()
        known = np.isfinite(before).all(axis=-1) & np.isfinite(given.albedo).all(axis=-1)
        np.testing.assert_allclose(after[known], before[known], rtol=1e-5)


def test_guides_are_prefiltered_where_they_hold_noise(tmp_path, monkeypatch):
    calls = []
    monkeypatch.setattr(first_pass, "why_no_oidn", lambda: None)
    monkeypatch.setattr(first_pass, "denoise_oidn", lambda color, *_, **mode: calls.append(mode) or color)
    shot = open_shot(SCENE.write(tmp_path))
    scale = measure_gain(shot.read(MIDDLE).color, dark=BLACK)
    best = {"quality": "high", "prefilter": "high"}
    for mode, noisy, clean in (
        ("oidn", {"quality": "high"}, {"quality": "high"}),
        ("oidn-fast", {"quality": "fast"}, {"quality": "fast"}),
        ("oidn-clean", {**best, "prefilter": "balanced"}, {**best, "prefilter": None, "clean": True}),
        ("oidn-best", best, best),
    ):
        for stages, expected in ((STAGES | {"prefilter"}, noisy), (STAGES, clean)):
            calls.clear()
            FrameStream(shot, only(stages), radius=0, first_pass=find_first_pass(mode, shot).first_pass).align(MIDDLE)
            assert calls == [{**expected, "device": "cpu", "scale": pytest.approx(scale)}]


def test_frames_needed_are_those_that_are_read(tmp_path):
    scene = replace(SCENE, frames=15)
    shot = open_shot(scene.write(tmp_path))
    stages = STAGES | {"prefilter"}

    def same(frame):
        return frame.color

    for source in (None, PerFrame(same), GuideAware(lambda frame, _: frame.color), Classical(DRAFT)):
        aligner, read = FrameStream(shot, only(stages), first_pass=source), []
        aligner.shot.reader.read = lambda number, read=read: read.append(number) or ShotReader.read(shot.reader, number)
        aligner.align(scene.first + 7)
        reach = 2 if source is None else source.reach(2)
        assert sorted(read) == list(range(scene.first + 7 - reach, scene.first + 8 + reach))


def test_the_centres_estimate_comes_through_unchanged(tmp_path):
    window = FrameStream(open_shot(SCENE.write(tmp_path)), only(STAGES), first_pass=PerFrame(flickering)).align(MIDDLE)
    given = flickering(open_shot(tmp_path).read(MIDDLE))
    np.testing.assert_allclose(window.first_pass[2] * window.modulation, given, rtol=1e-6)


def test_where_colors_agree_geometry_cannot_take_all_trust_away(tmp_path):
    """An outline's albedo is mixed anew in each frame; here all of it is."""

    def mixed_anew(index, layers):
        name = "ViewLayer.Denoising Albedo"
        layers[name] = np.random.default_rng(index).uniform(0.1, 0.9, layers[name].shape).astype(np.float32)

    shot = open_shot(SCENE.write(tmp_path, edit=mixed_anew))

    def truth(frame):
        return SCENE.clean(frame.number - SCENE.first)["ViewLayer.Combined"]

    window = FrameStream(shot, only(STAGES - {"demodulate"}), first_pass=PerFrame(truth)).align(MIDDLE)
    # The wall passes by whole pixels: warped, the next frame is this one but for the light, which follows the camera.
    inside = np.s_[4:-4, 4:-4]
    assert np.median(window.confidence[3][inside]) == pytest.approx(0.3, abs=0.01)
    other = FrameStream(
        shot, only(STAGES - {"demodulate"}), first_pass=PerFrame(lambda f: truth(f) * (1 + (f.number == MIDDLE + 1)))
    )
    assert other.align(MIDDLE).confidence[3].max() < 0.05


def test_flicker_is_averaged_away(tmp_path):
    """Five independent errors: their mean has a fifth of the variance, 7 dB, less where frames lack the pixel."""
    shot = open_shot(SCENE.write(tmp_path))
    gain = []
    for seed in range(4):
        aligner = FrameStream(shot, only(STAGES), first_pass=PerFrame(lambda frame, seed=seed: flickering(frame, seed)))
        # Errors of one factor per frame are all that differs; the gate is wide, as the frames are noisy.
        window = aligner.align(MIDDLE)
        truth = SCENE.clean(2)["ViewLayer.Combined"]
        before = np.mean((window.first_pass[2] * window.modulation - truth) ** 2)
        gain.append((before, np.mean((gated_average(window) - truth) ** 2)))
    before, after = np.mean(gain, axis=0)
    assert after < before / 2.5


def test_light_that_changes_is_not_averaged(tmp_path):
    """A shadow that falls on the centre frame only: geometry does not see it, the gate does."""

    def shadowed(index, layers):
        if index == 2:
            layers["ViewLayer.Combined"][:, :32] *= 0.25

    def estimate(frame):
        layers = SCENE.clean(frame.number - SCENE.first)
        shadowed(frame.number - SCENE.first, layers)
        return layers["ViewLayer.Combined"]

    shot = open_shot(SCENE.write(tmp_path, edit=shadowed))
    truth = estimate(shot.read(MIDDLE))
    errors = []
    for stages in (STAGES, STAGES - {"gate"}):
        result = gated_average(FrameStream(shot, only(stages), first_pass=PerFrame(estimate)).align(MIDDLE))
        errors.append(np.abs(result - truth)[:, :28].mean() / truth[:, :28].mean())
    assert errors[0] < 0.02  # of the shadow's light
    assert errors[1] > 1  # dragged in from the bright frames


def test_estimates_that_are_not_finite_are_repaired_and_others_refused(tmp_path):
    def broken(frame):
        image = flickering(frame)
        image[5, 5], image[9, 9] = np.nan, -1
        return image

    shot = open_shot(SCENE.write(tmp_path))
    result = gated_average(FrameStream(shot, only(STAGES), first_pass=PerFrame(broken)).align(MIDDLE))
    assert np.isfinite(result).all()
    assert result.min() >= 0
    with pytest.raises(ValueError, match=r"first pass of frame \d+ has shape \(3, 4, 3\), expected \(48, 64, 3\)"):
        FrameStream(shot, only(STAGES), first_pass=PerFrame(lambda frame: np.ones((3, 4, 3), np.float32))).align(MIDDLE)
    with pytest.raises(ValueError, match=f"frame {MIDDLE} has no first pass"):
        FrameStream(shot, only(STAGES), first_pass=PerFrame(lambda frame: None)).align(MIDDLE)
    with pytest.raises(ValueError, match="expected a window with first passes"):
        gated_average(FrameStream(shot, only(STAGES)).align(MIDDLE))


def test_a_neighbour_without_an_estimate_counts_for_nothing(tmp_path):
    shot = open_shot(SCENE.write(tmp_path))
    window = FrameStream(
        shot, only(STAGES), first_pass=PerFrame(lambda f: None if f.number == MIDDLE + 1 else flickering(f))
    ).align(MIDDLE)
    assert (window.confidence[3] == 0).all()
    assert window.confidence[1].max() > 0


def denoised(index, layers):
    """The layers that Cycles writes where it denoises at render time."""
    layers["ViewLayer.Noisy Image"] = layers["ViewLayer.Combined"]
    layers["ViewLayer.Combined"] = SCENE.clean(index)["ViewLayer.Combined"]


def test_auto_takes_what_is_in_the_file_then_oidn_then_our_own(tmp_path, monkeypatch):
    plain = open_shot(SCENE.write(tmp_path / "plain"))
    cycles = open_shot(SCENE.write(tmp_path / "cycles", edit=denoised))
    monkeypatch.setattr(first_pass, "why_no_oidn", lambda: None)
    assert find_first_pass("auto", cycles).name == "file"
    assert find_first_pass("auto", plain).name == "oidn-clean"
    monkeypatch.setattr(first_pass, "why_no_oidn", lambda: "pyoidn is not installed")
    source = find_first_pass("auto", plain, classical=STANDARD)
    assert (source.name, source.first_pass) == ("nlm", Classical(STANDARD))
    assert find_first_pass("none", plain).first_pass is None
    with pytest.raises(ImportError, match="pyoidn is not installed"):
        find_first_pass("oidn-fast", plain)


def test_a_finished_sequence_is_taken_frame_by_frame(tmp_path):
    shot = open_shot(SCENE.write(tmp_path / "noisy"))
    SCENE.write(tmp_path / "clean", clean=True, without={"Vector", "Depth"})
    source = find_first_pass(str(tmp_path / "clean" / "shot.####.exr"), shot)
    window = FrameStream(shot, only(STAGES), first_pass=source.first_pass).align(MIDDLE)
    assert psnr(gated_average(window), SCENE.clean(2)["ViewLayer.Combined"]) > 50
    replace(SCENE, frames=2).write(tmp_path / "short", clean=True)
    with pytest.raises(ValueError, match=f"expected frame {MIDDLE}, which the shot has"):
        find_first_pass(str(tmp_path / "short" / "shot.####.exr"), shot)
    with pytest.raises(FileNotFoundError):
        find_first_pass(str(tmp_path / "nothing.####.exr"), shot)


def test_of_a_sequence_that_cycles_has_denoised_the_denoised_picture_is_taken(tmp_path):
    shot = open_shot(SCENE.write(tmp_path / "noisy"))
    SCENE.write(tmp_path / "cycles", edit=denoised)
    source = find_first_pass(str(tmp_path / "cycles"), shot)
    np.testing.assert_array_equal(source.first_pass.function(shot.read(MIDDLE)), SCENE.clean(2)["ViewLayer.Combined"])


def test_pictures_that_are_kept_are_made_again_where_they_would_be_others(tmp_path, monkeypatch):
    """Whatever file was there was taken: of another mode, of other frames, of other guides, or none of ours."""
    made = []
    monkeypatch.setattr(first_pass, "why_no_oidn", lambda: None)
    monkeypatch.setattr(first_pass, "denoise_oidn", lambda color, *_, **mode: made.append(mode) or 0.5 * color)
    folder, kept = SCENE.write(tmp_path / "noisy"), tmp_path / "kept"

    def run(mode="oidn", **more):
        before = len(made)
        shot = open_shot(folder, **more.pop("opened", {}))
        find_first_pass(mode, shot, kept=str(kept), **more).first_pass.function(shot.read(MIDDLE))
        return len(made) - before

    assert [run(), run()] == [1, 0]
    assert run("oidn-fast") == 1
    assert made[-1]["quality"] == "fast"
    assert [run(), run()] == [1, 0]
    assert run(forced="-fireflies") == 1
    assert run(forced="-fireflies", opened={"layers": {"normal": "Denoising Albedo"}}) == 1
    assert run() == 1
    near = folder / f"shot.{MIDDLE + 1}.exr"  # by which fireflies are told
    os.utime(near, (1e9, 1e9))
    assert [run(), run()] == [1, 0]
    monkeypatch.setattr(sources, "version", lambda package: "1999")
    assert run() == 1
    mine = kept / f"shot.{MIDDLE}.exr"
    mine.write_bytes((folder / mine.name).read_bytes())
    with pytest.raises(ValueError, match="exists and was not written by --keep-first-pass"):
        run()
    assert mine.read_bytes() == (folder / mine.name).read_bytes()


def test_pictures_are_not_kept_where_others_are_read_or_written(tmp_path, monkeypatch, capfd):
    """They took the place of the output, frame by frame, and the output theirs."""
    monkeypatch.setattr(first_pass, "why_no_oidn", lambda: None)
    monkeypatch.setattr(first_pass, "denoise_oidn", lambda color, *_, **mode: 0.5 * color)
    folder, out = SCENE.write(tmp_path / "noisy"), tmp_path / "out"
    words = ["denoise", "--method=classical", str(folder), "-o", str(out), "--first-pass", "oidn", "--keep-first-pass"]
    for place in (out, tmp_path / "noisy" / ".." / "out", out / "shot.%04d.exr"):
        assert main([*words, str(place)]) == 1
        assert re.search("keep-first-pass .* would overwrite output", capfd.readouterr().err)
    assert main([*words, str(folder)]) == 1
    assert "would overwrite an input" in capfd.readouterr().err
    assert not out.exists()


def test_pictures_are_kept_in_a_file_each(tmp_path, monkeypatch):
    """Also where one frame was asked for: its neighbours are denoised as well."""
    monkeypatch.setattr(first_pass, "why_no_oidn", lambda: None)
    folder, one = SCENE.write(tmp_path), str(tmp_path / "kept.exr")
    with pytest.raises(ValueError, match=r"kept\.exr' names one file for 5 frames, expected OUT\.####\.exr"):
        find_first_pass("oidn", open_shot(folder, frames=str(MIDDLE)), kept=one)
    alone = open_shot(folder / f"shot.{MIDDLE}.exr")
    assert find_first_pass("oidn", alone, kept=one).reason == "asked for"


def test_where_nothing_is_kept_the_reason_says_so(tmp_path):
    shot = open_shot(SCENE.write(tmp_path / "noisy", edit=denoised))
    for spec in ("auto", "nlm", "none", str(tmp_path / "noisy")):
        assert "nothing of it is kept" in find_first_pass(spec, shot, kept=str(tmp_path / "kept")).reason
        assert "kept" not in find_first_pass(spec, shot).reason


def test_the_command_says_what_was_taken(tmp_path, capfd):
    folder = SCENE.write(tmp_path / "noisy", edit=denoised)
    out = tmp_path / "out"
    words = ["denoise", "--method=classical", str(folder), "-o", str(out), "--first-pass"]
    assert main([*words, "auto"]) == 0
    assert "First pass  file (the file holds a denoised picture)" in capfd.readouterr().err
    assert open_shot(out).numbers == open_shot(folder).numbers
    assert [record["first_pass"] for _, record in read_records(out)] == ["file"]
    assert main([*words, str(tmp_path / "no.####.exr")]) == 1


def test_a_shot_as_blenders_defaults_render_it_just_works(tmp_path, capfd):
    """Cycles with OIDN and its passes stored, adaptive sampling, one seed for all frames (examples/render_shot.py)."""
    folder = Path(__file__).parents[2] / "data" / "defaults"
    out = tmp_path / "stable.####.exr"
    words = ["denoise", "--method=classical", str(folder / "noisy.####.exr"), "-o", str(out)]
    assert main([*words, "--first-pass", "auto"]) == 0
    said = capfd.readouterr().err
    assert "First pass  file" in said
    assert "warning: constant seed: " in said
    before, after = open_shot(folder), open_shot(str(out))
    pictures = [before.read(10).estimate, after.read(10).estimate]  # Combined is replaced, the Noisy Image stays
    np.testing.assert_array_equal(after.read(10).color, before.read(10).color)
    assert 30 < psnr(pictures[1], pictures[0]) < 60  # changed, and not by much


def late(folder, by, step=(3, 1)):
    """Finished pictures, each in the place of a frame that comes so many after it."""
    scene = Scene(frames=8, height=48, width=64, step=step)
    folder.mkdir()
    for index in range(1, 7):
        layers = {"ViewLayer.Combined": scene.clean(index - by)["ViewLayer.Combined"]}
        write_layers(folder / f"done.{scene.first + index}.exr", layers)
    return scene


def denoise_late(folder):
    words = ["denoise", "--method=classical", str(folder / "in"), "-o", str(folder / "out"), "--frames", "1002-1007"]
    return main([*words, "--first-pass", str(folder / "done")])


@pytest.mark.parametrize(("by", "other"), [(1, "previous"), (-1, "next")])
def test_pictures_of_the_neighbouring_frames_are_refused(tmp_path, capsys, by, other):
    """Each frame came out as the one beside it, with exit code 0."""
    late(tmp_path / "done", by).write(tmp_path / "in")
    assert denoise_late(tmp_path) == 1
    assert f"each picture belongs to the {other} frame" in capsys.readouterr().err
    assert not list((tmp_path / "out").glob("*.exr"))


@pytest.mark.parametrize(("by", "step"), [(0, (3, 1)), (1, (0, 0))])
def test_pictures_that_are_alike_are_taken(tmp_path, by, step):
    late(tmp_path / "done", by, step).write(tmp_path / "in")
    assert denoise_late(tmp_path) == 0


@pytest.mark.parametrize("spec", ["bundled", "oidn-fast", "oidn-clean"])
def test_eight_frames_are_denoised_in_eight_orientations(tmp_path, spec, monkeypatch):
    """The errors of a network in an image and in the image turned differ, and average out, but for equal noise."""
    marks = []

    def denoise(color, albedo, normal, **_):
        np.testing.assert_array_equal(normal, albedo[..., ::-1])  # guides are turned with the color
        place = np.unravel_index(np.argmax(albedo[..., 0]), albedo.shape[:2])
        marks.append((albedo.shape, place))
        return color

    def mark(index, layers):
        albedo = layers["ViewLayer.Denoising Albedo"]
        albedo[3, 5] = 1
        layers["ViewLayer.Denoising Normal"] = albedo[..., ::-1]

    def held(index, layers):
        mark(index, layers)
        layers["ViewLayer.Combined"] = scene.noisy(0)["ViewLayer.Combined"]
        layers["ViewLayer.Combined"][:, :20] *= np.float32(1 + 0.1 * index)  # most of the picture stands still

    monkeypatch.setattr(first_pass, "why_no_oidn", lambda: None)
    monkeypatch.setattr(first_pass, "denoise_oidn", denoise)
    scene = Scene(frames=8, first=1, step=(0, 0))
    for name, edit, orientations in (("own", mark, 8), ("held", held, 1)):
        shot = open_shot(scene.write(tmp_path / name, edit=edit))
        source = find_first_pass(spec, shot, backends=Backends(bundled=denoise))
        stream = FrameStream(shot, Rules(), source.first_pass)
        for number in shot.numbers:
            denoised, clean = stream.denoised(number), spec == "oidn-clean"
            given = stream.frame(number).radiance if clean else stream.as_read(number).color
            np.testing.assert_array_equal(denoised, given)
        assert len(set(marks[-8:])) == orientations
