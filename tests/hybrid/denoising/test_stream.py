"""Frames of a stream: read once, without fireflies, and dropped."""

from dataclasses import replace

import cv2
import numpy as np
import pytest

from hybrid.alignment.noise import correlation_alone, fixed_noise, near_correlation, noise_correlation
from hybrid.commands.shots import log_noise
from hybrid.denoising.first_pass import PerFrame, find_first_pass
from hybrid.denoising.plan import DENOISED, Rules
from hybrid.denoising.stream import FrameStream, plan_shot
from hybrid.files.shots import open_shot
from nlm.pixel_filter import find_filter
from tests.exr_files import write_layers
from tests.scenes import Scene, grained

# Locked off. Frame numbers 1001 to 1012.
CALM = Scene(frames=12, step=(0, 0), height=48, width=64)


def test_a_value_is_kept_as_long_as_all_of_its_frames(tmp_path):
    stream = FrameStream(open_shot(CALM.write(tmp_path)), Rules())
    first, second = stream.frame(1001), stream.frame(1002)
    flow, last = stream.flow(1001, 1002), stream.flow(1002, 1003)
    stream.keep([1002, 1003])
    assert stream.frame(1002) is second
    assert stream.flow(1002, 1003) is last
    assert stream.frame(1001) is not first
    assert stream.flow(1001, 1002) is not flow
    assert stream.frame(0) is None


PLACE = np.s_[20, 30]


def shining(*indices, place=PLACE, light=500):
    def shine(index, layers):
        if index in indices:
            layers["ViewLayer.Combined"][place] = light

    return shine


def load(shot, numbers):
    stream = FrameStream(shot, Rules())
    return {number: stream.frame(number) for number in numbers}


@pytest.mark.parametrize(("seen", "lamp"), [((4, 5), False), ((5, 6), False), ((4, 5, 6), True)])
def test_what_one_neighbour_shows_too_is_kept_and_what_both_show_is_a_lamp(tmp_path, seen, lamp):
    """Noise with long tails is bright in two frames by chance; it was put back into pictures as it was rendered."""
    frame = load(open_shot(CALM.write(tmp_path, edit=shining(*seen))), range(1004, 1009))[1006]
    assert frame.fireflies == 0
    assert (frame.highlights is not None) == lamp
    # A lamp is added to the finished picture: what that is made of does not show it.
    assert (frame.radiance[PLACE].mean() > 400) == (not lamp)
    assert frame.with_highlights[PLACE].mean() == pytest.approx(500, rel=0.01)


def test_a_lamp_is_the_mean_of_the_frames_that_show_it(tmp_path):
    """It was one sample, as rendered."""

    def shine(index, layers):
        layers["ViewLayer.Combined"][PLACE] = 500 + 60 * (index % 3)

    frame = load(open_shot(CALM.write(tmp_path, edit=shine)), range(1004, 1009))[1006]
    assert frame.highlights is not None
    np.testing.assert_allclose(frame.highlights.light, 560, rtol=0.01)


@pytest.mark.parametrize("off", [(0, 2), (3, 0)])
def test_bright_samples_near_each_other_are_no_lamp(tmp_path, off):
    """They were one within three pixels, with vectors, and twelve without: ten a frame came out as rendered."""

    def shine(index, layers):
        layers["ViewLayer.Combined"][20 + off[0] * (index % 2), 30 + off[1] * (index % 2)] = 500

    frame = load(open_shot(CALM.write(tmp_path, edit=shine)), range(1004, 1009))[1006]
    assert frame.highlights is None


def test_a_lamp_moves_along_with_the_vectors(tmp_path):
    scene = replace(CALM, step=(2, 1))

    def shine(index, layers):
        layers["ViewLayer.Combined"][10 + index, 20 + 2 * index] = 500

    frame = load(open_shot(scene.write(tmp_path, edit=shine)), range(1003, 1008))[1005]
    assert frame.highlights is not None
    assert frame.highlights.pixels.tolist() == [[14, 28]]


@pytest.mark.parametrize("number", [1001, 1012])
def test_at_the_ends_of_a_shot_the_two_nearest_frames_know_a_lamp(tmp_path, number):
    shot = open_shot(CALM.write(tmp_path, edit=shining(*range(12))))
    assert load(shot, [number])[number].highlights is not None


def test_a_frame_alone_knows_no_lamp(tmp_path):
    shot = open_shot(replace(CALM, frames=1).write(tmp_path, edit=shining(0, light=2000)))
    frame = load(shot, [1001])[1001]
    assert (frame.fireflies, frame.highlights) == (1, None)


@pytest.mark.parametrize("held", [{4: 5}, {6: 5}, {4: 5, 6: 5}, {index: 5 for index in range(12)}])
def test_the_same_noise_once_more_is_no_witness(tmp_path, held):
    """A firefly of a frame that is shown twice, or of a shot with one seed, was a lamp."""

    def shine(index, layers):
        if held.get(index, index) == 5:
            layers["ViewLayer.Combined"][:] = CALM.noisy(5)["ViewLayer.Combined"]
            layers["ViewLayer.Combined"][PLACE] = 2000

    frame = load(open_shot(CALM.write(tmp_path, edit=shine)), range(1004, 1009))[1006]
    assert (frame.fireflies, frame.highlights) == (1, None)
    assert frame.radiance[PLACE].max() < 10


def test_a_frame_that_is_shown_twice_counts_once_and_is_named(tmp_path):
    """Its samples counted twice, and its vectors said that it moves."""
    scene = replace(CALM, step=(2, 1))

    def hold(index, layers):
        if index == 6:
            layers |= scene.noisy(5)

    shot = open_shot(scene.write(tmp_path, edit=hold))
    aligner = FrameStream(shot, Rules())
    for number, weightless in ((1006, {3}), (1007, {1}), (1005, {4}), (1004, set()), (1008, {0}), (1009, set())):
        window = aligner.align(number)
        assert {index for index, layer in enumerate(window.confidence) if not layer.any()} == weightless
    flow = aligner.flow(1006, 1007)
    assert flow is not None
    assert not flow.vectors.any()
    assert plan_shot(shot).repeats == ((1006, 1007),)
    assert plan_shot(shot).cuts == ()


@pytest.mark.parametrize("vectors", [True, False])
def test_dense_fireflies_are_taken_out(tmp_path, vectors):
    """A thousandth of the pixels: without vectors nine of ten were witnesses for each other."""
    rng = np.random.default_rng(0)
    scene = replace(CALM, height=96, width=128, frames=3)

    def shine(index, layers):
        layers["ViewLayer.Combined"][rng.random((96, 128)) < 0.001] = 2000

    shot = open_shot(scene.write(tmp_path, edit=shine, without=set() if vectors else {"Vector"}))
    frame = load(shot, range(1001, 1004))[1002]
    assert frame.highlights is None
    assert frame.fireflies >= 8
    assert np.count_nonzero(frame.radiance.mean(axis=-1) > 100) <= 3


def test_frames_with_their_fireflies_are_kept_for_the_next_alone(tmp_path, monkeypatch):
    """Each is read once, though it is asked about those of both neighbours; a window holds no frame twice."""

    def everywhere(index, layers):
        layers["ViewLayer.Combined"][20, 2 + 5 * index] = 5000

    read = []
    monkeypatch.setattr(FrameStream, "rendered", spied(FrameStream.rendered, read))
    shot = open_shot(CALM.write(tmp_path, edit=everywhere))
    reads = []
    monkeypatch.setattr(type(shot), "read", spied(type(shot).read, reads))
    stream = FrameStream(shot, Rules())
    for number in shot.numbers:
        stream.keep(stream.around(number, 2))
        # The newest, whose fireflies the next ones are compared with, and those read to compare with its own.
        kept = {frames[0] for kind, frames in stream._cache if kind in ("read", "rendered")}
        assert kept <= {number, number + 1, number + 2, number + 3, *shot.numbers[-2:]}
        for n in stream.around(number, 2):
            stream.frame(n)
        assert stream.frame(number).fireflies == 1
    assert len(read) > len(reads) == len(shot.numbers)


def spied(function, calls):
    return lambda self, number: calls.append(number) or function(self, number)


@pytest.mark.parametrize(("noise", "factor"), [(0.1, 8.0), (0.8, 0.7)])
def test_neighbours_have_the_light_of_the_centre(tmp_path, noise, factor):
    """They were left out where light changes as a whole: fades lost 4 dB against what went in."""

    def fade(index, layers):
        layers["ViewLayer.Combined"] *= np.float32(factor**index)

    shot = open_shot(Scene(frames=4, noise=noise).write(tmp_path, edit=fade))
    frames = FrameStream(shot, Rules(), radius=1).window(1003).frames
    means = [there.irradiance.mean() for there in frames]
    np.testing.assert_allclose(means, means[1], rtol=0.05)  # other parts of the wall, other noise
    assert means[1] == pytest.approx(FrameStream(shot, Rules()).frame(1003).irradiance.mean())


def test_neighbours_have_the_hue_of_the_centre(tmp_path):
    """Noisy frames and first passes: one factor for all channels leaves a fifth of each."""

    def fade(index, layers):
        layers["ViewLayer.Combined"] *= np.float32((0.8, 0.6, 0.7)) ** np.float32(index)

    shot = open_shot(Scene(frames=4, noise=0.1).write(tmp_path, edit=fade))
    window = FrameStream(shot, Rules(), PerFrame(lambda frame: frame.color), radius=1).window(1003)
    for images in ([there.irradiance for there in window.frames], window.first_pass):
        means = np.array([image.mean(axis=(0, 1)) for image in images])
        np.testing.assert_allclose(means, np.broadcast_to(means[1], means.shape), rtol=0.05)


def test_a_part_that_changes_leaves_the_light_of_others_alone(tmp_path):
    def blink(index, layers):
        layers["ViewLayer.Combined"][:, :8] *= np.float32(1 + 3 * (index % 2))

    stream = FrameStream(open_shot(Scene(step=(0, 0)).write(tmp_path, edit=blink)), Rules(), radius=1)
    assert all(
        there is stream.frame(n) for n, there in zip((1001, 1002, 1003), stream.window(1002).frames, strict=True)
    )


def test_equal_frames_of_one_color_under_textured_guides_are_no_frame_shown_twice(tmp_path):
    """Color over albedo, a texture, passed for noise: a warning said that a constant picture has one seed."""

    def plain(_, layers):
        layers["ViewLayer.Combined"][:] = 0.5

    scene = Scene(frames=2, step=(0, 0), height=80, width=96)
    stream = FrameStream(open_shot(scene.write(tmp_path, edit=plain)), Rules(), radius=1)
    _, (pair,) = stream.measurements([1001, 1002])
    assert not pair.repeated
    assert pair.fixed_noise == 0


@pytest.mark.parametrize("noise", [0, 0.1])
def test_equal_frames_without_noise_are_no_frame_shown_twice(tmp_path, noise):
    """A still shot without noise lost all of its small lamps: no other frame counted as their witness."""
    places = [(12, 10), (12, 40), (30, 24), (38, 50)]
    grain = grained(np.ones((48, 64, 3), np.float32), 5, noise) if noise else 1

    def lamps(_, layers):
        layers["ViewLayer.Combined"] = layers["ViewLayer.Combined"] * grain
        for place in places:
            layers["ViewLayer.Combined"][place] = 900

    scene = Scene(frames=3, step=(0, 0), height=48, width=64)
    stream = FrameStream(open_shot(scene.write(tmp_path, clean=True, edit=lamps)), Rules(), radius=1)
    (pair, _), frame = stream.measurements([1001, 1002, 1003])[1], stream.frame(1002)
    assert pair.repeated == (noise > 0)
    assert (pair.fixed_noise > 0.5) == (noise > 0)
    assert frame.fireflies == (len(places) if noise else 0)
    if not noise:
        assert sorted(map(tuple, frame.highlights.pixels)) == places


# Large enough for its noise to be measured.
GRAINY = Scene(frames=6, height=96, width=128)
TAPS = np.array([1, 5, 1], np.float32) / 7


def spread(image):
    """The image as a renderer's pixel filter of three pixels makes it."""
    return cv2.sepFilter2D(image, -1, TAPS, TAPS, borderType=cv2.BORDER_REFLECT_101)


def spread_layers(_, layers):
    for name in ("Combined", "Denoising Albedo", "Denoising Normal"):
        layers[f"ViewLayer.{name}"] = spread(layers[f"ViewLayer.{name}"])


def test_the_filter_of_a_renderer_is_undone_before_anything_is_measured(tmp_path):
    plain = load(open_shot(GRAINY.write(tmp_path / "plain")), [1003])[1003]
    shot = open_shot(GRAINY.write(tmp_path / "spread", edit=spread_layers))
    frame = load(shot, [1003])[1003]
    assert plain.spread is None
    assert frame.spread is not None
    before = np.abs(shot.read(1003).color - plain.radiance).mean()
    for name in ("radiance", "albedo"):
        assert np.abs(getattr(frame, name) - getattr(plain, name)).mean() < 0.3 * before
    assert frame.with_filter(frame.radiance) == pytest.approx(shot.read(1003).color, abs=0.02)
    off = FrameStream(shot, Rules(off=frozenset({"whiten"}))).frame(1003)
    np.testing.assert_allclose(off.radiance, shot.read(1003).color, rtol=1e-5)


def test_the_filter_is_measured_from_the_frames_beside_a_frame_alone(tmp_path):
    folder = GRAINY.write(tmp_path, edit=spread_layers)
    whole = FrameStream(open_shot(folder), Rules())
    for number in range(1001, 1005):
        expected = whole.frame(number)
    for number in (1001, 1002, 1006):
        (folder / f"shot.{number}.exr").unlink()
    part = FrameStream(open_shot(folder), Rules(off=frozenset({"fireflies"}))).frame(1004)
    np.testing.assert_array_equal(part.spread.inverse, expected.spread.inverse)


def test_the_filter_of_the_first_frame_after_a_cut_is_measured_from_the_one_after(tmp_path):
    def cut(index, layers):
        if index < 3:
            for name in ("Combined", "Denoising Albedo", "Denoising Normal"):
                layers[f"ViewLayer.{name}"] = 1 - layers[f"ViewLayer.{name}"][::-1, ::-1]
        spread_layers(index, layers)

    stream = FrameStream(open_shot(GRAINY.write(tmp_path, edit=cut)), Rules())
    assert stream.frame(1004).spread is not None
    np.testing.assert_array_equal(stream.frame(1004).spread.inverse, stream.frame(1005).spread.inverse)


def test_the_filter_of_a_frame_without_neighbours_is_measured_in_the_frame(tmp_path):
    single = replace(GRAINY, frames=1)
    plain = FrameStream(open_shot(single.write(tmp_path / "plain")), Rules())
    stream = FrameStream(open_shot(single.write(tmp_path / "spread", edit=spread_layers)), Rules())
    frame = stream.frame(1001)
    assert plain.frame(1001).spread is None
    assert frame.spread is not None
    (facts,), _ = stream.measurements([1001])
    assert facts.noise_correlation_alone > 0.17
    before = np.abs(stream.shot.read(1001).color - plain.frame(1001).radiance).mean()
    assert np.abs(frame.radiance - plain.frame(1001).radiance).mean() < 0.4 * before


@pytest.mark.parametrize("filtered", [False, True])
def test_shadows_of_leaves_that_move_are_no_noise_of_a_filter(tmp_path, filtered):
    """Their changes correlate by 0.24 at neighbouring pixels; by such ones *shadow* lost 3 dB at 128 samples."""
    leaves = cv2.GaussianBlur(np.random.default_rng(3).normal(0, 1, (96, 128)), (0, 0), 1.4)
    light = cv2.GaussianBlur(np.float32(1 - 0.5 * (leaves > 0.5 * leaves.std())), (0, 0), 0.7)[..., None]

    def sway(index, layers):
        layers["ViewLayer.Combined"][..., :3] *= np.roll(light, (3 * index, 5 * index), axis=(0, 1))
        if filtered:
            spread_layers(index, layers)

    stream = FrameStream(open_shot(GRAINY.write(tmp_path, edit=sway)), Rules())
    frame, before = stream.frame(1003), noise_correlation(stream._raw(1002), stream._raw(1003))
    alone, _ = correlation_alone(stream._raw(1003))
    assert near_correlation(before) > near_correlation(alone) + 0.2
    assert (frame.spread is not None) == filtered
    if filtered:
        np.testing.assert_array_equal(frame.spread.inverse, find_filter(np.array(alone)).inverse)


def test_texture_that_moves_is_no_noise(tmp_path):
    folder = GRAINY.write(tmp_path, without={"Vector", "Denoising Albedo", "Denoising Normal"})
    assert FrameStream(open_shot(folder), Rules(on=frozenset({"whiten"}))).frame(1003).spread is None


def test_what_another_denoiser_has_made_is_brought_into_the_light_without_the_filter(tmp_path):
    folder = GRAINY.write(tmp_path / "noisy", edit=spread_layers)
    finished = open_shot(GRAINY.write(tmp_path / "finished", clean=True, edit=spread_layers))
    source = find_first_pass(str(tmp_path / "finished" / "shot.####.exr"), open_shot(folder)).first_pass
    stream = FrameStream(open_shot(folder), Rules(), source)
    frame, picture = stream.frame(1003), stream.denoised(1003)
    np.testing.assert_array_equal(picture, np.maximum(frame.spread.undo(finished.read(1003).color), 0))


def test_frames_that_repeat_are_found_where_their_filter_is_undone(tmp_path):
    """The filters of two frames are measured from other pairs, so that equal samples differ without them."""
    still = replace(GRAINY, step=(0, 0), frames=4)

    def repeat(index, layers):
        layers |= still.noisy(index - (index == 3))
        spread_layers(index, layers)

    plan = plan_shot(open_shot(still.write(tmp_path, edit=repeat)))
    assert "whiten" in plan.stages
    assert plan.repeats == ((1003, 1004),)


SPARKS = [(20, 30), (40, 90), (60, 50), (70, 110)]


def write_slow_pan(folder, *, one_seed, denoised=False, sparks=False):
    """Five frames of a wall that moves by 0.4 pixels a frame; with one seed two thirds of the noise stay at a pixel."""
    y, x = np.mgrid[:96, :128].astype(np.float32)
    for index in range(5):
        at = x - np.float32(0.4 * index)
        wall = (0.5 + 0.05 * np.sin(1.7 * at) + 0.05 * np.sin(2.3 * y + 0.3 * at))[..., None].repeat(3, axis=-1)
        shared, own = (np.random.default_rng(seed).normal(size=(96, 128, 1)) for seed in (5, 6 + index))
        grain = np.exp(0.4 * (np.sqrt(0.67) * (shared if one_seed else own) + np.sqrt(0.33) * own[::-1]))
        noisy = (wall * grain).astype(np.float32)
        for spark in SPARKS if sparks else ():
            noisy[spark] = 200  # as clamped samples, all of one light
        pictures = {"Combined": wall, "Noisy Image": noisy} if denoised else {"Combined": noisy}
        layers = {f"ViewLayer.{name}": picture for name, picture in pictures.items()}
        layers["ViewLayer.Vector"] = np.full((96, 128, 4), (-0.4, 0, -0.4, 0), np.float32)
        write_layers(folder / f"pan.{1001 + index}.exr", layers)
    return open_shot(folder / "pan.####.exr")


@pytest.mark.parametrize("one_seed", [True, False])
def test_noise_of_one_seed_is_found_in_pans_slower_than_half_a_pixel(tmp_path, one_seed):
    """The noise passed for detail there, which lost up to 4 dB of frames that Blender had denoised."""
    stream = FrameStream(write_slow_pan(tmp_path, one_seed=one_seed), Rules())
    first, second = stream.rendered(1002), stream.rendered(1003)
    assert fixed_noise(first, second, moves=False) is None
    share = stream.same_noise(1002, 1003)
    assert share > 0.4 if one_seed else share < 0.1
    plan = stream.plan(stream.around(1003), DENOISED)
    assert ("fixed-noise" in plan.stages) == one_seed


@pytest.mark.parametrize("one_seed", [True, False])
def test_samples_that_share_noise_do_not_judge_a_picture(tmp_path, one_seed):
    stream = FrameStream(write_slow_pan(tmp_path, one_seed=one_seed, denoised=True), Rules())
    _, pair = stream.measurements([1001, 1002, 1003])[1]
    assert pair.shared_noise == pytest.approx(0.67 if one_seed else 0, abs=0.1)
    plan = stream.plan(stream.around(1003), DENOISED)
    assert ("blend-samples" in plan.stages) != one_seed
    assert log_noise(plan) == ["seed"] * one_seed
    alone = [decision for decision in plan.decisions if decision.stage != "fixed-noise"]
    assert log_noise(replace(plan, decisions=tuple(alone))) == ["seed"] * one_seed


def test_sparks_that_stay_at_their_pixels_are_no_lamps(tmp_path):
    """Clamped samples are equally bright: along a slow pan frames of one seed bore witness to each other."""
    stream = FrameStream(write_slow_pan(tmp_path, one_seed=True, sparks=True), Rules())
    frame = stream.frame(1003)
    assert frame.highlights is None
    assert frame.fireflies == len(SPARKS)
