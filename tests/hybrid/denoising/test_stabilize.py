"""Finished pictures of neighbouring frames meet where they show the same, and nowhere else."""

import importlib.util
from dataclasses import replace
from types import SimpleNamespace

import cv2
import numpy as np
import pytest

from hybrid.alignment.align import Stillness, align_results, measure_stillness
from hybrid.alignment.prepare import prepare
from hybrid.alignment.unfiltered import Unfiltered
from hybrid.denoising import stabilize
from hybrid.denoising.first_pass import PerFrame
from hybrid.denoising.plan import Rules
from hybrid.denoising.stabilize import MOST, Denoised, FrameDenoiser, _changed, _with_unfiltered
from hybrid.denoising.stream import FrameStream, plan_shot
from hybrid.files.exr import read_exr
from hybrid.files.frame import Frame
from hybrid.files.shots import open_shot
from hybrid.files.sources import MADE_FROM
from hybrid.run.pipeline import BESIDE
from hybrid.run.records import read_records
from tests.scenes import Function, Scene, denoise_view, only

MOVING = Scene(frames=7, noise=0.1)
STILL = replace(MOVING, step=(0, 0))
MIDDLE = MOVING.first + 3
ALONE = Rules(off=frozenset({"stabilize", "restore-mean", "blend-samples"}))
# The average of pictures by itself: samples correct nothing.
STEADY = Rules(off=frozenset({"restore-mean", "blend-samples"}))
# Error of a denoiser: below what the gate lets pass (0.001 of the tone curve and a tenth of the noise), above rounding.
ERROR = 0.003


# First looks, which are what tells whether light drifts.
ESTIMATES = PerFrame(lambda frame: cv2.blur(np.nan_to_num(frame.color), (9, 9)))


def truth(scene, number, scale=1.0):
    return scene.clean(number - scene.first)["ViewLayer.Combined"] * np.float32(scale)


def nearly(scene, scale=1.0):
    """A denoiser that knows the truth, but for an error of its own in each pixel and frame."""

    def make(aligned):
        errors = np.random.default_rng(aligned.number).normal(0, ERROR, aligned.color.shape[1:])
        color = truth(scene, aligned.number, scale) * np.float32(1 + errors)
        return Denoised(np.asarray(color[: aligned.color.shape[1]], np.float32))

    return make


def pictures(shot, denoise, rules=None, first_pass=ESTIMATES, **options):
    return FrameDenoiser(FrameStream(shot, rules or STEADY, first_pass=first_pass), Function(denoise), **options)


def aligned_results(maker, number, colors):
    """Results of three frames as `FrameDenoiser` averages them, and their confidence."""
    result = maker._results[number]
    window = maker.stream.window_of_results(number, colors)
    stillness = measure_stillness(result.drift_weight, maker.stream.shot.shape)
    return align_results(window, result.geometry, stillness, result.exposure)


def made(shot, denoise, number=MIDDLE, rules=None, **options):
    return pictures(shot, denoise, rules, **options).make(number).denoised.color


def flicker(shot, scene, rules):
    maker = pictures(shot, nearly(scene), rules)
    errors = [maker.make(n).denoised.color - truth(scene, n) for n in (MIDDLE, MIDDLE + 1)]
    inside = np.s_[8:-8, 8:-8]  # what is in all frames
    return errors[0][inside].std()


@pytest.mark.parametrize("scene", [STILL, MOVING])
def test_errors_that_change_from_frame_to_frame_are_averaged(tmp_path, scene):
    shot = open_shot(scene.write(tmp_path))
    alone, steady = flicker(shot, scene, ALONE), flicker(shot, scene, STEADY)
    # With equal weights the deviation is 1/√3. A pixel moved by whole pixels is not interpolated.
    assert steady == pytest.approx(alone / np.sqrt(3), rel=0.05)


def test_it_is_the_average_weighted_by_confidence(tmp_path):
    shot = open_shot(STILL.write(tmp_path))
    denoise = nearly(STILL)
    maker = pictures(shot, denoise)
    color = maker.make(MIDDLE).denoised.color
    own = {n: denoise(FrameStream(shot, STEADY).align(n)).color for n in (MIDDLE - 1, MIDDLE, MIDDLE + 1)}
    window, confidence = aligned_results(maker, MIDDLE, own)
    np.testing.assert_allclose(window, np.stack(list(own.values())), rtol=0.01)  # nothing moves, in the same light
    assert confidence[1].min() == 1
    assert 0.5 < confidence[0].mean() < 1
    expected = (confidence[..., None] * window).sum(axis=0) / confidence.sum(axis=0)[..., None]
    np.testing.assert_allclose(color, expected, rtol=1e-5)


def test_light_that_has_changed_by_less_than_the_noise_stays_with_its_frame(tmp_path):
    """Only a neighbour's detail is averaged: without `relight` the picture is 3.1 % too bright."""
    shot, own = open_shot(STILL.write(tmp_path)), nearly(STILL)

    def make(aligned):
        light = np.float32(1 if aligned.number == MIDDLE else 1.05)
        return Denoised(own(aligned).color * light)

    inside = np.s_[8:-8, 8:-8]
    maker = pictures(shot, make)
    error = (maker.make(MIDDLE).denoised.color / truth(STILL, MIDDLE) - 1)[inside]
    assert abs(error.mean()) < 0.01


def test_of_two_frames_nothing_tells_whether_light_drifts(tmp_path):
    shot = open_shot(replace(STILL, frames=2).write(tmp_path))
    maker = pictures(shot, nearly(STILL))
    maker.make(STILL.first)
    _, confidence = aligned_results(maker, STILL.first, {n: truth(STILL, n) for n in shot.numbers})
    assert 0.4 < confidence[2].max() <= 0.5


def test_where_nothing_tells_whether_light_drifts_neighbours_count_half(tmp_path):
    shot = open_shot(STILL.write(tmp_path))
    maker = pictures(shot, nearly(STILL), first_pass=None)
    error = maker.make(MIDDLE).denoised.color - truth(STILL, MIDDLE)
    alone = pictures(shot, nearly(STILL), ALONE).make(MIDDLE).denoised.color - truth(STILL, MIDDLE)
    inside = np.s_[8:-8, 8:-8]
    # weights of 1, 2, 1
    assert error[inside].std() == pytest.approx(alone[inside].std() * np.sqrt(6) / 4, rel=0.05)


def under_a_shadow(index, width):
    """The light left under a soft edge that moves by three pixels a frame."""
    return 0.5 + 0.5 / (1 + np.exp(-(np.arange(width) - width / 2 - 3 * (index - 3)) / 3))[None, :, None]


def test_moving_shadows_are_not_averaged(tmp_path, monkeypatch):
    scene = replace(STILL, height=96, width=160, noise=0.3)

    def shade(index, layers):
        layers["ViewLayer.Combined"] = (layers["ViewLayer.Combined"] * under_a_shadow(index, 160)).astype(np.float32)

    def clean(number):
        return np.asarray(truth(scene, number)[..., :3] * under_a_shadow(number - scene.first, 160), np.float32)

    shot = open_shot(scene.write(tmp_path, edit=shade))
    estimates = PerFrame(lambda frame: clean(frame.number))

    def error():
        picture = made(shot, lambda aligned: Denoised(clean(aligned.number)), first_pass=estimates)
        return float(np.abs(picture / clean(MIDDLE) - 1)[8:-8, 60:100].mean())

    seen = error()
    still = Stillness(np.ones((scene.height, scene.width), np.float32), np.float32(1))
    monkeypatch.setattr(stabilize, "measure_stillness", lambda *_: still)
    assert seen < 0.5 * error()


@pytest.mark.parametrize("step", [0, 2])
def test_where_the_light_of_the_whole_frame_drifts_no_finished_picture_is_averaged(tmp_path, step):
    """Samples tell the drift in places alone: between them it was averaged."""
    scene = replace(STILL, height=96, width=160, noise=0.3)

    def waves(index):
        phase = 2 * np.pi * (np.arange(160) - step * index) / 60
        return (0.7 + 0.2 * np.sin(phase))[None, :, None].astype(np.float32)

    def shade(index, layers):
        layers["ViewLayer.Combined"] = (layers["ViewLayer.Combined"] * waves(index)).astype(np.float32)

    shot = open_shot(scene.write(tmp_path, edit=shade))
    lit = {n: truth(scene, n)[..., :3] * waves(n - scene.first) for n in shot.numbers}
    maker = pictures(shot, lambda aligned: Denoised(lit[aligned.number]), first_pass=PerFrame(lambda f: lit[f.number]))
    maker.make(MIDDLE)
    _, confidence = aligned_results(maker, MIDDLE, lit)
    assert np.all(confidence[1] == 1)
    if step:
        assert np.all(confidence[[0, 2]] == 0)
    else:
        assert confidence[[0, 2]].mean() > 0.8


def test_of_the_frame_before_only_what_is_averaged_is_kept(tmp_path):
    """Samples, trust and drift of the frame before stayed in memory, a tenth of what is kept; it can be made anew."""
    maker = pictures(open_shot(MOVING.write(tmp_path)), nearly(MOVING))
    color = maker.make(MIDDLE).denoised.color
    first = maker._results[MIDDLE - 1]  # also while the first windows of a run are denoised
    maker.make(MIDDLE + 1)
    for before in (first, maker._results[MIDDLE]):
        assert before.neighbour_samples is before.drift_weight is None
        assert not before.geometry
    np.testing.assert_array_equal(maker.make(MIDDLE).denoised.color, color)


def test_what_shows_another_light_is_left_out(tmp_path):
    def flare(index, layers):
        if index == 3:
            layers["ViewLayer.Combined"] = layers["ViewLayer.Combined"] * np.float32(1.3)

    shot = open_shot(STILL.write(tmp_path, edit=flare))

    def make(aligned):
        return Denoised(truth(STILL, aligned.number) * np.float32(1.3 if aligned.number == MIDDLE else 1))

    for number in (MIDDLE - 1, MIDDLE, MIDDLE + 1):
        np.testing.assert_allclose(
            made(shot, make, number), make(FrameStream(shot, only(())).align(number)).color, rtol=6e-3
        )


def test_nothing_is_averaged_over_a_cut(tmp_path):
    other = np.random.default_rng(5).uniform(0, 9, (*STILL.clean(0)["ViewLayer.Combined"].shape[:2], 3))

    def cut(index, layers):
        if index > 3:
            layers["ViewLayer.Combined"] = layers["ViewLayer.Denoising Albedo"] = other.astype(np.float32)
            layers["ViewLayer.Denoising Normal"] = -layers["ViewLayer.Denoising Normal"]

    shot = open_shot(STILL.write(tmp_path, edit=cut))
    assert plan_shot(shot).cuts == ((MIDDLE, MIDDLE + 1),)
    # Were the pictures alike, only the cut keeps them apart.
    maker = pictures(shot, nearly(STILL))
    both = {n: truth(STILL, n) for n in (MIDDLE - 1, MIDDLE, MIDDLE + 1)}
    maker.make(MIDDLE)
    _, confidence = aligned_results(maker, MIDDLE, both)
    assert confidence[0].max() > 0.5
    assert confidence[2].max() == 0


def test_one_frame_calls_for_none(tmp_path):
    shot = open_shot(replace(STILL, frames=1).write(tmp_path))
    result = pictures(shot, nearly(STILL)).make(STILL.first)
    np.testing.assert_array_equal(
        result.denoised.color, nearly(STILL)(FrameStream(shot, only(())).align(STILL.first)).color
    )
    assert "stabilize" not in result.plan.stages


@pytest.mark.parametrize("scale", [1e-4, 1e4])
def test_scale_is_kept(tmp_path, scale):
    one = made(open_shot(MOVING.write(tmp_path / "one")), nearly(MOVING))
    other = made(open_shot(MOVING.write(tmp_path / "other", scale=scale)), nearly(MOVING, scale))
    np.testing.assert_allclose(other / np.float32(scale), one, rtol=1e-4)


def test_a_part_of_a_frame_is_what_the_whole_is_there(tmp_path):
    scene = replace(MOVING, height=480)
    shot = open_shot(scene.write(tmp_path))

    def make(aligned):
        rows = slice(None)
        if aligned.color.shape[1] < scene.height:  # a part: find it in the frame
            albedo = scene.clean(aligned.number - scene.first)["ViewLayer.Denoising Albedo"]
            starts = range(0, scene.height, 64)
            top = next(
                max(s - 192, 0) for s in starts
                if np.array_equal(albedo[max(s - 192, 0) :][: aligned.color.shape[1]], aligned.albedo[aligned.middle])
            )  # fmt: skip
            rows = slice(top, top + aligned.color.shape[1])
        errors = np.random.default_rng(aligned.number).normal(0, ERROR, (scene.height, scene.width, 3))
        return Denoised((truth(scene, aligned.number) * np.float32(1 + errors))[rows].astype(np.float32))

    whole, parts = made(shot, make), made(shot, make, rows=64)
    np.testing.assert_allclose(parts, whole, rtol=1e-6)


def test_layers_that_add_up_to_the_color_still_do(tmp_path):
    shot = open_shot(MOVING.write(tmp_path))
    own = nearly(MOVING)

    def make(aligned):
        color = own(aligned).color
        key, depth = color * np.float32(0.3), np.full(color.shape, 7, np.float32)
        return Denoised(color, {"key": key, "depth": depth}, {"rest": color - key}, frozenset({"key", "rest"}))

    denoised = pictures(shot, make).make(MIDDLE).denoised
    assert (
        np.abs(denoised.color - make(FrameStream(shot, only(())).align(MIDDLE)).color).max() > 1e-4
    )  # something was averaged
    np.testing.assert_allclose(denoised.aovs["key"] + denoised.extra["rest"], denoised.color, rtol=1e-5)
    np.testing.assert_array_equal(denoised.aovs["depth"], 7)


def test_no_pixel_changes_by_more_than_a_factor(tmp_path):
    """One pixel of a frame is lost: its neighbours give it back as far as that goes, and a light is not doubled."""
    shot = open_shot(STILL.write(tmp_path))

    def make(aligned):
        color = truth(STILL, aligned.number)
        color[16:24, 26:34] *= np.float32(0.005)  # so dark that the gate sees no difference
        color[20, 30] *= np.float32(0.01) if aligned.number == MIDDLE else 1
        return Denoised(color)

    color = made(shot, make)
    assert color[20, 30] == pytest.approx(MOST * 0.01 * 0.005 * truth(STILL, MIDDLE)[20, 30])
    assert np.isfinite(color).all()


def test_detail_that_the_neighbours_lack_stays(tmp_path):
    def striped(color):
        color[::2] *= np.float32(0.8)
        color[1::2] *= np.float32(1.2)

    def edit(index, layers):
        if index == MIDDLE - STILL.first:
            striped(layers["ViewLayer.Combined"])

    def make(aligned):
        color = truth(STILL, aligned.number)
        if aligned.number == MIDDLE:
            striped(color)
        return Denoised(color)

    changed = made(open_shot(STILL.write(tmp_path, edit=edit)), make) / truth(STILL, MIDDLE)
    # Without `FINISHED_DETAIL` a third of the detail is left.
    inside = changed[8:-8, 8:-8]
    assert inside[::2].mean() == pytest.approx(0.8, abs=0.01)
    assert inside[1::2].mean() == pytest.approx(1.2, abs=0.01)


@pytest.fixture(scope="module")
def restored(tmp_path_factory):
    """The mean with the stages that restore it."""
    return TestMean().mean_of(tmp_path_factory.mktemp("restored"))


class TestMean:
    """Light that denoisers lose comes back, fireflies included, and no single sample is spread."""

    SCENE = Scene(height=160, width=200, frames=3, step=(0, 0), noise=0.5)
    NUMBER = SCENE.first + 1

    def mean_of(self, folder, edit=None, rules=None):
        shot = open_shot(self.SCENE.write(folder, edit=edit))
        maker = pictures(shot, lambda a: Denoised(np.float32(0.97) * truth(self.SCENE, a.number)), rules or Rules())
        return float(maker.make(self.NUMBER).denoised.color.mean() / truth(self.SCENE, self.NUMBER).mean())

    def test_what_a_denoiser_loses_comes_back(self, tmp_path, restored):
        assert self.mean_of(tmp_path / "off", rules=STEADY) == pytest.approx(0.97, abs=1e-4)
        # 32 000 pixels with a deviation of a half: the mean is known to 0.3 %.
        assert restored == pytest.approx(1, abs=0.005)

    def test_fireflies_belong_to_it(self, tmp_path):
        """Twenty pixels of each frame, others in each, shine, and are taken out. Held to the limit, they are 2.5 %."""

        def places(index):
            cells = np.mgrid[10:160:40, 10:200:40].reshape(2, -1)
            return tuple(cells + np.random.default_rng(index).integers(0, 20, cells.shape))  # none near another

        def shine(index, layers):
            color = layers["ViewLayer.Combined"] = layers["ViewLayer.Combined"].copy()
            color[places(index)] = 1600 * self.SCENE.clean(index)["ViewLayer.Combined"][places(index)]

        shot = open_shot(self.SCENE.write(tmp_path / "in", edit=shine))
        aligner = FrameStream(shot, Rules())
        frame, file = aligner.frame(self.NUMBER), shot.read(self.NUMBER).color
        assert frame.fireflies >= 15
        assert frame.radiance[places(1)].mean() < 0.3 * file[places(1)].mean()
        np.testing.assert_allclose(frame.rendered, file, rtol=1e-5)
        # The 3 % that the denoiser has lost come back in spite of them, and their own light as far as twenty samples
        # tell it, which is hardly.
        assert self.mean_of(tmp_path / "out", shine) == pytest.approx(1, abs=0.007)

    def test_one_bright_sample_is_not_spread(self, tmp_path, restored):
        def burn(index, layers):
            if index == 1:
                layers["ViewLayer.Combined"][80, 100] = 1e5

        assert self.mean_of(tmp_path, burn) == pytest.approx(restored, abs=1e-3)


@pytest.mark.parametrize("gray", [False, True])
def test_a_gray_part_adds_up(gray):
    """Made gray under a colored light, parts missed their sum by 5 % of a pixel."""
    rng = np.random.default_rng(3)
    parts = {name: rng.random((4, 5, 1 if gray else 3), np.float32) * np.ones(3, np.float32) for name in "ab"}
    apart = {**parts, "mask": rng.random((4, 5, 3), np.float32)}
    frame = SimpleNamespace(unfiltered=Unfiltered(gray=frozenset({"b", "mask", *(["color", "a"] if gray else [])})))
    frame.guide = np.ones((4, 5, 3), np.float32)
    result = _with_unfiltered(Denoised(parts["a"] + parts["b"], apart, parts=frozenset("ab")), frame)
    np.testing.assert_allclose(result.aovs["a"] + result.aovs["b"], result.color, rtol=1e-6)
    assert np.ptp(result.aovs["mask"], axis=-1).max() == 0


class TestInFiles:
    """`denoise_frames` makes the pictures beside a frame, and says so."""

    @staticmethod
    def run(shot, out, denoise, rules=None, **options):
        return list(denoise_view(shot, out, Function(denoise, 1), rules or STEADY, **options))

    def test_a_frame_depends_on_the_windows_beside_it(self, tmp_path):
        shot = open_shot(MOVING.write(tmp_path / "in"), frames=str(MIDDLE))
        begun = []

        def make(aligned):
            begun.append(aligned.number)
            return nearly(MOVING)(aligned)

        (frame,) = self.run(shot, tmp_path / "out", make)
        assert begun == [MIDDLE - 1, MIDDLE, MIDDLE + 1]
        header = read_exr(frame.path).parts[0].header
        assert header[BESIDE] == f"{MIDDLE - 1} {MIDDLE + 1}"
        assert "stabilize" in header["ravg/stages"].split()
        for n in range(MIDDLE - 3, MIDDLE + 4):  # the picture beside, its window, and one for what shines alone
            assert f"shot.{n}.exr" in header[MADE_FROM]

    def test_a_frame_beside_that_cannot_be_made_is_done_without_where_the_run_keeps_going(self, tmp_path):
        shot, broken = open_shot(MOVING.write(tmp_path / "in")), {MIDDLE + 1}

        def make(aligned):
            if aligned.number in broken:
                raise ValueError("no picture")
            return nearly(MOVING)(aligned)

        with pytest.raises(ValueError, match="no picture"):
            self.run(shot, tmp_path / "stopped", make)
        names = sorted(path.name for path in (tmp_path / "stopped").glob("*.exr"))
        assert names == [f"shot.{n}.exr" for n in range(MOVING.first, MIDDLE)]
        frames = self.run(shot, tmp_path / "out", make, keep_going=True)
        assert [type(frame).__name__ for frame in frames].count("Failed") == 1
        assert read_exr(tmp_path / "out" / f"shot.{MIDDLE}.exr").parts[0].header[BESIDE] == f"{MIDDLE - 1}"
        # The frame failed then and is whole now: those beside it are made again, and no others.
        broken.clear()
        again = self.run(shot, tmp_path / "out", make, resume=True)
        assert [frame.number for frame in again if not frame.resumed] == [MIDDLE, MIDDLE + 1, MIDDLE + 2]

    def test_a_finished_sequence_may_end_where_the_shot_does_not(self, tmp_path):
        folder = MOVING.write(tmp_path / "in")
        shot = open_shot(folder, frames=f"{MOVING.first}-{MIDDLE}")
        given = open_shot(replace(MOVING, frames=4).write(tmp_path / "given", clean=True))
        estimates = PerFrame(
            lambda frame: given.read(frame.number).color if given.has(frame.number) else None, files=given
        )
        *_, last = self.run(shot, tmp_path / "out", nearly(MOVING), first_pass=estimates)
        assert read_exr(last.path).parts[0].header[BESIDE] == f"{MIDDLE - 1}"


def test_the_change_of_a_pixel_that_was_nearly_black_does_not_overflow():
    """numpy warned of it in the terminal."""
    own = np.float32([[[1e-42, 0.0, 1.0]]])
    color = np.float32([[[1.0, 0.5, 1.2]]])
    with np.errstate(all="raise", under="ignore"):
        found = _changed(Denoised(own, {"part": own}, {}, frozenset({"part"})), color)
    np.testing.assert_allclose(found.color, [[[MOST * 1e-42, 0.5, 1.2]]], rtol=1e-2)
    np.testing.assert_allclose(found.aovs["part"], [[[MOST * 1e-42, 0.0, 1.2]]], rtol=1e-2)


@pytest.mark.neural
@pytest.mark.skipif(importlib.util.find_spec("torch") is None, reason="torch is not installed")
def test_the_network_makes_its_pictures_so(tmp_path):
    from hybrid.cli import main

    scene = replace(MOVING, frames=3)
    shot = scene.write(tmp_path / "in")

    def run(name, *words):
        given = ["denoise", str(shot), "-o", str(tmp_path / name), "--first-pass", "bundled", "--preset", "fast"]
        assert main([*given, "--frames", "1002", "-q", *words]) == 0
        *_, (_, record) = read_records(tmp_path / name)
        return read_exr(tmp_path / name / "shot.1002.exr").pixels(("ViewLayer.Combined.R",)), record

    steady, record = run("stabilize")
    alone, other = run("alone", "--no-stages", "stabilize")
    assert np.abs(steady - alone).max() > 1e-4
    assert "stabilize" in record["stages"]
    assert "stabilize" not in other["stages"]


class TestSamples:
    """A picture is nowhere worse than the samples that it was made from."""

    @staticmethod
    def blurred(aligned):
        return Denoised(cv2.blur(aligned.centre.irradiance * aligned.modulation, (5, 5)))

    def test_a_shot_without_noise_stays_as_it_is(self, tmp_path):
        scene = MOVING  # equal frames may be one seed's: these tell nothing
        shot = open_shot(scene.write(tmp_path, clean=True))
        inside = np.s_[8:-8, 12:-12]  # what other frames show as well
        wanted = truth(scene, MIDDLE)
        result = made(shot, self.blurred, rules=Rules())
        np.testing.assert_allclose(result[inside], wanted[inside], rtol=0.01)
        off = made(shot, self.blurred, rules=Rules(off=frozenset({"blend-samples"})))
        assert np.abs(off[inside] / wanted[inside] - 1).max() > 0.1

    @pytest.mark.parametrize("noise", [1.0, 0.1, 0.003])
    def test_a_bad_denoiser_does_no_harm_at_any_level_of_noise(self, tmp_path, noise):
        scene = replace(STILL, noise=noise)
        shot = open_shot(scene.write(tmp_path))
        wanted = truth(scene, MIDDLE)

        def error(image):
            return float(np.sqrt(np.mean(np.square(image - wanted))))

        result = made(shot, self.blurred, rules=Rules())
        assert error(result) <= 1.02 * error(shot.read(MIDDLE).color)

    def test_pixels_that_were_not_finite_are_no_samples(self, tmp_path):
        def spoil(index, layers):
            layers["ViewLayer.Combined"][20:24, 30:34] = np.nan

        shot = open_shot(STILL.write(tmp_path, clean=True, edit=spoil))
        result = made(shot, lambda a: Denoised(truth(STILL, a.number)), rules=Rules())
        np.testing.assert_allclose(result, truth(STILL, MIDDLE), rtol=1e-3)

    def test_a_black_frame_between_lit_ones_is_black(self, tmp_path):
        """Light that leaked into it from its neighbours was an error: a fade from black was not written at all."""

        def dark(index, layers):
            layers["ViewLayer.Combined"] *= index != 3

        shot = open_shot(STILL.write(tmp_path, edit=dark))
        for rules in (Rules(), STEADY):
            assert not made(shot, lambda a: Denoised(0.1 * truth(STILL, a.number)), rules=rules).any()

    def test_bands_of_a_frame_give_the_same_picture(self, tmp_path):
        scene = replace(MOVING, height=96)
        shot = open_shot(scene.write(tmp_path))
        whole, parts = (made(shot, self.blurred, rules=Rules(), rows=rows) for rows in (None, 32))
        np.testing.assert_array_equal(whole, parts)

    @pytest.mark.parametrize("rules", [Rules(), Rules(off=frozenset({"stabilize"}))], ids=["network", "classical"])
    def test_snow_that_a_denoiser_takes_for_noise_stays(self, tmp_path, rules):
        """Flakes of a pixel that fall by seven rows a frame, which no vector says."""
        flakes = np.random.default_rng(5).integers(0, (96, 160), (90, 2))
        scene = Scene(height=96, width=160, frames=5, step=(0, 0), noise=0.1)

        def snow(index, layers):
            color = layers["ViewLayer.Combined"]
            rows, columns = (flakes + np.array([7 * index, 0])).T
            color[rows % 96, columns] = 5

        shot = open_shot(scene.write(tmp_path, edit=snow))
        number = scene.first + 2
        blind = PerFrame(lambda frame: cv2.medianBlur(np.ascontiguousarray(frame.color), 5))

        def median(aligned):
            return Denoised(cv2.medianBlur(np.ascontiguousarray(aligned.centre.irradiance * aligned.modulation), 5))

        result = made(shot, median, number, rules, first_pass=blind)
        rows, columns = (flakes + np.array([14, 0])).T
        inside = (rows >= 8) & (rows < 88)
        assert np.mean(result[rows[inside] % 96, columns[inside]].mean(axis=-1) > 4) > 0.9
        elsewhere = np.ones((96, 160), bool)
        elsewhere[rows % 96, columns] = False
        assert np.abs(result - truth(scene, number))[elsewhere].mean() < 0.1
        # The light of the flakes, 3 % of the frame's, went into the mean of all other pixels too.
        assert result[elsewhere].mean() == pytest.approx(truth(scene, number)[elsewhere].mean(), rel=0.005)

    @pytest.mark.parametrize(
        ("rules", "place"),
        [(Rules(), 0), (Rules(off=frozenset({"stabilize"})), 2)],
        ids=["network, first frame", "classical, middle"],
    )
    def test_rain_that_a_denoiser_keeps_is_no_noise(self, tmp_path, rules, place):
        """Streaks that the picture shows: what each frame alone shows was taken for noise, and its detail was lost."""
        drops = np.random.default_rng(5).integers(0, (96, 160), (60, 2))
        scene = Scene(height=96, width=160, frames=5, step=(0, 0), noise=0.01)

        def rain(index, layers):
            color = layers["ViewLayer.Combined"]
            for k in range(3):
                rows, columns = (drops + np.array([9 * index + k, 0])).T
                inside = rows < 96
                color[rows[inside], columns[inside]] += 3

        shot = open_shot(scene.write(tmp_path, edit=rain))
        number, clean = scene.first + place, scene.clean(place)
        rain(place, clean)
        right = clean["ViewLayer.Combined"]

        def soft(aligned):
            picture = cv2.GaussianBlur(aligned.centre.irradiance * aligned.modulation, (0, 0), 0.4)
            return Denoised(np.ascontiguousarray(picture))

        result = made(shot, soft, number, rules, first_pass=PerFrame(lambda frame: frame.color))
        assert np.std(result - right) < 1.1 * np.std(shot.read(number).color - right)


def test_negative_light_follows_the_edges_of_the_guides():
    """Light that only one of two surfaces has stays on it, though the picture is the same on both."""
    albedo = np.full((40, 40, 3), 0.2, np.float32)
    albedo[:, 20:] = 0.9
    color = np.full_like(albedo, 0.5)
    color[:, 20:, 2] = -0.1
    prepared = prepare(Frame(1, color, albedo))
    made = _with_unfiltered(Denoised(np.full_like(albedo, 0.5)), prepared).color
    np.testing.assert_allclose(made[:, 17:20, 2], 0.5, atol=0.005)
    np.testing.assert_allclose(made[:, 20:23, 2], 0.4, atol=0.005)


@pytest.mark.parametrize("scale", [1, 1024])
def test_the_result_is_as_the_filter_of_the_renderer_makes_it(tmp_path, scale):
    scene, taps = Scene(frames=5, height=96, width=128), np.array([1, 4, 1], np.float32) / 6

    def spread(image):
        return cv2.sepFilter2D(image, -1, taps, taps, borderType=cv2.BORDER_REFLECT_101)

    def edit(_, layers):
        for name in ("Combined", "Denoising Albedo", "Denoising Normal"):
            layers[f"ViewLayer.{name}"] = spread(layers[f"ViewLayer.{name}"])

    shot = open_shot(scene.write(tmp_path, scale=scale, edit=edit))
    number = scene.first + 2
    # The denoiser knows the truth without a filter.
    rules = Rules(off=frozenset({"restore-mean", "blend-samples", "stabilize", "fireflies"}))
    frames = FrameDenoiser(
        FrameStream(shot, rules, first_pass=ESTIMATES),
        Function(lambda aligned: Denoised(truth(scene, aligned.number, scale))),
    )
    color = frames.make(number).denoised.color
    expected = spread(truth(scene, number, scale))
    unfiltered = np.abs(truth(scene, number, scale) - expected).mean()
    assert np.abs(color - expected).mean() < 0.3 * unfiltered
