"""Samples correct a picture as far as they are certain: nothing else moves it."""

import tracemalloc

import cv2
import numpy as np
import pytest

from nlm.samples import (
    SampleMean,
    average_neighbours,
    beside_lamps,
    blend_samples,
    limit_lamps,
    restore_mean,
)
from nlm.variance import spatial_variance
from tests.seldom import seldom

SHAPE = (96, 128)
ONES = np.ones((*SHAPE, 3), np.float32)


def lines(seed: int = 1) -> np.ndarray:
    """Detail that a denoiser loses: lines of one pixel over a soft gradient."""
    image = np.linspace(0.2, 1, SHAPE[1], dtype=np.float32)[None, :, None] * ONES
    image[::7] *= 3
    image[:, ::11] *= 0.3
    return image * np.random.default_rng(seed).uniform(0.9, 1.1, image.shape).astype(np.float32)


def noisy(truth: np.ndarray, noise: float, seed: int) -> np.ndarray:
    """Skewed, unbiased, multiplicative noise."""
    if noise == 0:
        return truth.copy()
    grain = np.random.default_rng(seed).gamma(1 / noise**2, noise**2, truth.shape[:2])[..., None]
    return (truth * grain).astype(np.float32)


def window(truth: np.ndarray, noise: float, firefly: tuple[int, int] | None = None) -> tuple[np.ndarray, SampleMean]:
    """The noisy centre, with a firefly, and the mean of the frames beside it."""
    frames = 5
    all_frames = np.stack([noisy(truth, noise, 10 + t) for t in range(frames)])
    if firefly is not None:
        all_frames[frames // 2][firefly] = 80
    confidence = np.ones(all_frames.shape[:3], np.float32)
    own = all_frames[frames // 2]
    return own, average_neighbours(all_frames, None, confidence, confidence, np.ones_like(truth), own)


def blend_smooth(
    truth: np.ndarray, frames: np.ndarray, confidence: np.ndarray | None = None, exposure: float = 0.5
) -> tuple[np.ndarray, np.ndarray]:
    """A slightly blurred picture with the samples of frames blended in, and the blurred one."""
    trust = np.ones(frames.shape[:3], np.float32) if confidence is None else confidence
    sides = average_neighbours(frames, None, trust, trust, ONES, frames[2])
    smooth = cv2.GaussianBlur(truth, (0, 0), 0.5)
    return blend_samples(smooth, frames[2], sides, exposure), smooth


def error(image: np.ndarray, truth: np.ndarray) -> float:
    return float(np.sqrt(np.mean(np.square(image - truth, dtype=np.float64))))


def test_the_mean_of_the_sides_is_its_definition() -> None:
    rng = np.random.default_rng(2)
    estimates = rng.random((5, 9, 11, 3), np.float32)
    residuals = rng.normal(0, 1, estimates.shape).astype(np.float32)
    confidence = rng.random((5, 9, 11), np.float32)
    confidence[:, 3] = 0
    estimates[0, 5] = np.nan
    modulation, own = rng.uniform(0.1, 1, (2, 9, 11, 3)).astype(np.float32)
    found = average_neighbours(estimates, [(0, residuals)], confidence, np.zeros_like(confidence), modulation, own)
    for y, x in np.ndindex(9, 11):
        sides = [t for t in (0, 1, 3, 4) if confidence[t, y, x] > 0 and np.isfinite(estimates[t, y, x]).all()]
        weights = confidence[sides, y, x].astype(np.float64)
        if not sides:
            assert not found.mean[y, x].any()
            assert found.frames[y, x] == found.trust[y, x] == found.nearest[y, x] == 0
            continue
        mean = (weights[:, None] * (estimates + residuals)[sides, y, x]).sum(axis=0) / weights.sum() * modulation[y, x]
        np.testing.assert_allclose(found.mean[y, x], mean, rtol=1e-5, atol=1e-6)
        assert found.frames[y, x] == pytest.approx(weights.sum() ** 2 / np.square(weights).sum(), rel=1e-5)
        assert found.trust[y, x] == pytest.approx(min(confidence[[0, 1, 3, 4], y, x].sum(), 1), rel=1e-5)
        apart = (estimates + residuals)[sides, y, x] * modulation[y, x] - own[y, x]
        distances = np.sort(np.square(apart).sum(axis=-1))
        expected = distances[1] * (0.33 * len(sides) - 0.28) if len(sides) > 1 else distances[0] / 1.7
        assert found.nearest[y, x] == pytest.approx(expected, rel=1e-4)


@pytest.mark.parametrize("frames", [3, 5, 7])
def test_the_second_nearest_sample_tells_the_variance(frames: int) -> None:
    """Noise of all channels together, which a warp has made smaller in the neighbours; other noise counts as more."""
    rng = np.random.default_rng(14)
    noise = rng.standard_normal((frames, *SHAPE, 1)).astype(np.float32) * ONES
    noise[np.arange(frames) != frames // 2] *= np.float32(np.sqrt(0.7))
    confidence = np.ones(noise.shape[:3], np.float32)
    found = average_neighbours(noise, None, confidence, confidence, ONES, noise[frames // 2])
    assert found.nearest.mean() == pytest.approx(3, rel=0.06)


@pytest.mark.parametrize("blurred", [True, False])
def test_samples_without_noise_win(blurred: bool) -> None:
    truth = lines()
    own, sides = window(truth, 0)
    wrong = 0.5 * truth + 0.5 * truth.mean() if blurred else 1.3 * truth
    # The share of the samples is 1 but for what float32 rounds.
    np.testing.assert_allclose(blend_samples(wrong, own, sides, 0.5), truth, rtol=1e-5)


@pytest.mark.parametrize("noise", [1.0, 0.1, 0.003, *seldom(0.3, 0.03, 0.01, 0.001)])
@pytest.mark.parametrize("wrong", [0.0, 0.02, 0.2])
def test_the_picture_is_never_worse_than_the_samples_or_itself(noise: float, wrong: float) -> None:
    """A ladder of noise: where the samples are better they win, and a right picture stays."""
    truth = lines()
    own, sides = window(truth, noise)
    smooth = truth + np.float32(wrong) * (truth.mean(axis=(0, 1)) - truth)
    result = blend_samples(smooth.astype(np.float32), own, sides, 0.5)
    # Noise that looks like detail by chance costs a thirtieth of itself.
    assert error(result, truth) <= 1.02 * min(error(own, truth), error(smooth, truth)) + 0.03 * error(own, truth)


@pytest.mark.parametrize("noise", [0.0, 0.001, 0.01])
def test_lights_that_pass_over_the_neighbours_are_no_noise(noise: float) -> None:
    """Snow of one pixel in a hundred in the frames beside the centre: it counted as noise of a tenth of the light."""
    truth = lines()
    frames = np.stack([noisy(truth, noise, 10 + t) for t in range(5)])
    rng = np.random.default_rng(15)
    for t in (0, 1, 3, 4):
        frames[t][rng.random(SHAPE) < 0.01] = 5
    result, smooth = blend_smooth(truth, frames)
    assert error(result, truth) < error(frames[2], truth) + 0.02 * error(smooth, truth)


def test_light_that_changes_where_one_neighbour_shows_the_place_is_no_noise() -> None:
    """A rim that came into the picture: the next frame alone shows it, in light that is 2 % brighter."""
    truth = lines()
    frames = np.stack([noisy(truth * np.float32(1 + 0.02 * (t - 2)), 0.001, 10 + t) for t in range(5)])
    confidence = np.ones(frames.shape[:3], np.float32)
    confidence[[0, 1, 4], :, :2] = 0
    result, _ = blend_smooth(truth, frames, confidence)
    assert error(result, truth) < 1.02 * error(frames[2], truth)


@pytest.mark.parametrize("noise", [0.0, 0.001, 0.01])
def test_lines_at_a_rim_that_no_frame_shows_are_no_noise_where_there_is_next_to_none(noise: float) -> None:
    """The rest of the frame tells the noise: a shot without any came out at 48 dB."""
    truth = lines()
    frames = np.stack([noisy(truth, noise, 10 + t) for t in range(5)])
    confidence = np.ones(frames.shape[:3], np.float32)
    confidence[[0, 1, 3, 4], :, :12] = 0
    result, _ = blend_smooth(truth, frames, confidence)
    assert error(result, truth) < 1.02 * error(frames[2], truth) + 1e-5


@pytest.mark.parametrize("noise", [0.001, 0.01])
def test_the_rim_of_an_object_on_black_is_no_noise(noise: float) -> None:
    """The object's own noise is known, and black has none: a rim that no frame shows was blurred by 10 %."""
    y, x = np.mgrid[:96, :128]
    inside = np.hypot(y - 48, x - 64) < 16
    truth = lines() * inside[..., None]
    frames = np.stack([noisy(truth, noise, 10 + t) for t in range(5)])
    known = cv2.erode(inside.astype(np.uint8), np.ones((3, 3), np.uint8)) > 0
    confidence = np.broadcast_to(known.astype(np.float32), frames.shape[:3]).copy()
    result, smooth = blend_smooth(truth, frames, confidence, 0.1)
    assert error(result, truth) < 1.02 * error(frames[2], truth) + 0.05 * error(smooth, truth)


def test_blending_takes_the_memory_of_few_planes() -> None:
    """At 7680×4320 it took 26, more than all else of a run within 6 GiB."""
    truth = lines().repeat(8, axis=0).repeat(8, axis=1)
    own, sides = window(truth, 0.1)
    blend_samples(truth, own, sides, 0.5)
    tracemalloc.start()
    blend_samples(truth, own, sides, 0.5)
    peak = tracemalloc.get_traced_memory()[1]
    tracemalloc.stop()
    assert peak < 15 * 4 * truth[..., 0].size


def test_a_firefly_of_one_frame_is_no_reason() -> None:
    truth = lines()
    own, sides = window(truth, 0.05, firefly=(40, 50))
    result = blend_samples(truth, own, sides, 0.5)
    assert np.abs(result[35:46, 45:56] - truth[35:46, 45:56]).max() < 0.1


def test_a_side_frame_that_shows_something_else_is_no_reason() -> None:
    """The samples of the centre have a veto: trusted neighbours that are wrong change nothing."""
    truth = lines()
    own = noisy(truth, 0.2, 3)
    other = np.ascontiguousarray(truth[::-1, ::-1])
    far = np.square(own - other).sum(axis=-1)
    sides = SampleMean(other, np.full(SHAPE, 4, np.float32), np.ones(SHAPE, np.float32), far)
    assert error(blend_samples(truth, own, sides, 0.5), truth) < 0.03 * error(other, truth)


def test_side_frames_in_another_light_tell_the_noise_nevertheless() -> None:
    truth = lines()
    own, sides = window(truth, 0.01)
    far = np.square(own - np.float32(0.7) * sides.mean).sum(axis=-1)
    dim = sides._replace(mean=np.float32(0.7) * sides.mean, nearest=far)
    smooth = np.broadcast_to(truth.mean(axis=(0, 1)), truth.shape).astype(np.float32)
    assert error(blend_samples(smooth, own, dim, 0.5), truth) < 1.5 * error(own, truth)


def test_a_frame_alone_that_is_flat_has_no_noise() -> None:
    alone = SampleMean(np.zeros_like(ONES), *np.zeros((3, *SHAPE), np.float32))
    flat = np.full_like(ONES, 0.5)
    textured = flat * np.random.default_rng(4).uniform(0.8, 1.1, flat.shape).astype(np.float32)
    np.testing.assert_allclose(blend_samples(textured, flat, alone, 0.5), flat, rtol=1e-5)


@pytest.mark.parametrize("spread", [1, 3])
def test_a_frame_alone_with_noise_is_left_to_the_picture(spread: int) -> None:
    """Filters of a renderer may spread samples over several pixels: smooth noise is noise nevertheless."""

    alone = SampleMean(np.zeros_like(ONES), *np.zeros((3, *SHAPE), np.float32))
    own = cv2.GaussianBlur(noisy(ONES, 0.5, 5), (0, 0), 0.8) if spread > 1 else noisy(ONES, 0.5, 5)
    assert np.abs(blend_samples(ONES, own, alone, 1.0) - ONES).max() < 0.02


@pytest.mark.parametrize("spread", [0.5, 0.8, 1.0])
def test_the_variance_of_noise_that_a_pixel_filter_spreads_is_measured(spread: float) -> None:
    grain = np.random.default_rng(7).standard_normal(ONES.shape).astype(np.float32)
    spread_grain = cv2.GaussianBlur(grain, (0, 0), spread)
    for noise in (grain, spread_grain):
        found = spatial_variance(ONES + np.float32(0.05) * noise, ONES, np.ones(SHAPE, np.float32), 4.0)
        assert found.mean() == pytest.approx(3 * 0.05**2 * noise.var(), rel=0.2)


def test_texture_in_the_albedo_is_no_noise() -> None:
    """On this wall it was 0.16, and pictures at 60 dB were left as they were."""
    albedo = np.random.default_rng(3).uniform(0.2, 0.8, (24, 32, 3)).astype(np.float32).repeat(4, 0).repeat(4, 1)
    own = noisy(albedo, 0.01, 8)
    found = spatial_variance(own, np.full_like(own, 0.5), 1 / albedo.mean(axis=-1), 4.0, albedo)
    assert found.mean() == pytest.approx(3 * 0.01**2, rel=0.3)  # channels vary by a fifth


def test_light_of_a_lamp_in_the_pixels_beside_it_is_taken_back() -> None:
    """Beside a sun of 5,000 any error counted as small, and lit rings of two pixels stayed."""
    truth = np.full_like(ONES, 0.5)
    truth[40:46, 60:66] = 5000
    spilt = truth.copy()
    spilt[38:48, 58:68] = np.maximum(truth[38:48, 58:68], 3)
    own, sides = window(truth, 0.01)
    beside = np.abs(blend_samples(spilt, own, sides, 0.5) - own)[truth < 1]
    assert beside.max() < 0.1


@pytest.mark.parametrize("seed", [0, *seldom(1, 2)])
def test_a_noisy_lamp_keeps_its_light(seed: int) -> None:
    """Weighed by one over each sample, a lamp of 140 pixels with noise of a third lost 17 % of its light."""
    truth = np.full_like(ONES, 0.5)
    truth[40:50, 60:74] = 1000
    frames = np.stack([noisy(truth, 0.35, 10 * seed + t) for t in range(5)])
    confidence = np.ones(frames.shape[:3], np.float32)
    sides = average_neighbours(frames, None, confidence, confidence, ONES, frames[2])
    blended = blend_samples(cv2.GaussianBlur(truth, (0, 0), 0.7), frames[2], sides, 0.5)
    lamp = truth[..., 0] > 1
    assert blended[lamp].mean() == pytest.approx(frames[2][lamp].mean(), rel=0.05)


def test_a_wrong_outline_is_mended_where_the_alignment_is_off_too() -> None:
    """Along an outline frames differ by more than their noise; the noise beside it is the same."""
    truth = np.where(np.arange(SHAPE[1]) < SHAPE[1] // 2, 0.2, 1.0).astype(np.float32)
    truth = np.broadcast_to(truth[:, None], ONES.shape).copy()
    soft = cv2.GaussianBlur(truth, (0, 0), 1.5)
    sides = window(cv2.GaussianBlur(np.roll(truth, 1, axis=1), (0, 0), 0.7), 0.003)[1]
    mended = blend_samples(soft, noisy(truth, 0.003, 8), sides, 0.5)
    assert error(mended, truth) < 0.4 * error(soft, truth)


def test_the_variance_of_the_renderer_counts_where_no_frame_beside_does() -> None:
    alone = SampleMean(np.zeros_like(ONES), *np.zeros((3, *SHAPE), np.float32))
    truth = lines()
    own = noisy(truth, 0.01, 6)
    known = np.square(np.float32(0.01) * truth)
    smooth = np.broadcast_to(truth.mean(axis=(0, 1)), truth.shape).astype(np.float32)
    assert error(blend_samples(smooth, own, alone, 0.5, known), truth) < 0.1 * error(smooth, truth)
    unsure = np.full_like(truth, 10)
    np.testing.assert_array_equal(blend_samples(smooth, own, alone, 0.5, unsure), smooth)


@pytest.mark.parametrize("scale", [2.0**-63, 2.0**-20, 2.0**20])
def test_both_corrections_scale_with_the_light(scale: float) -> None:
    truth = lines()
    own, sides = window(truth, 0.1)
    bright = sides._replace(mean=np.float32(scale) * sides.mean, nearest=np.float32(scale**2) * sides.nearest)
    smooth = np.float32(0.9) * truth
    more = np.float32(scale)
    np.testing.assert_allclose(
        blend_samples(more * smooth, more * own, bright, scale * 0.5), more * blend_samples(smooth, own, sides, 0.5),
        rtol=1e-4,
    )  # fmt: skip
    np.testing.assert_allclose(
        restore_mean(more * smooth, more * own, scale * 0.5), more * restore_mean(smooth, own, 0.5), rtol=1e-4
    )


def test_black_stays_black() -> None:
    black = np.zeros_like(ONES)
    sides = SampleMean(black, np.full(SHAPE, 4, np.float32), np.ones(SHAPE, np.float32), black[..., 0])
    np.testing.assert_array_equal(blend_samples(black, black, sides, 1.0), black)
    np.testing.assert_array_equal(restore_mean(black, black, 1.0), black)


def test_lost_light_comes_back_and_noise_stays_out() -> None:
    truth = np.linspace(0.4, 1.2, 160, dtype=np.float32)[:, None, None] * np.ones((160, 160, 3), np.float32)
    own = noisy(truth, 0.5, 7)
    dark = restore_mean(np.float32(0.97) * truth, own, 0.8)
    # 25 600 pixels with a deviation of a half: their mean is known to 0.3 %, and counts nearly in full.
    assert abs(dark.mean() / truth.mean() - 1) < 0.006
    # A correct picture moves by no more than its noise, and most of it hardly at all.
    right = np.abs(restore_mean(truth, own, 0.8) / truth - 1)
    assert right.max() < 0.04
    assert np.median(right) < 0.005


def test_light_of_one_channel_comes_back_in_that_channel() -> None:
    own = noisy(ONES, 0.3, 8)
    result = restore_mean(ONES * np.float32([0.95, 1, 1]), own, 1.0)
    np.testing.assert_allclose(result.mean(axis=(0, 1)), own.mean(axis=(0, 1)), rtol=0.004)


def test_dark_places_beside_bright_ones_have_a_mean_of_their_own() -> None:
    truth = np.where(np.arange(SHAPE[1])[None, :, None] < 64, np.float32(0.002), np.float32(0.7)) * ONES
    own = noisy(truth, 0.3, 9)
    wrong = truth * np.where(truth < 0.1, np.float32(1.4), np.float32(1))
    result = restore_mean(wrong, own, 0.35)
    assert abs(result[:, :40].mean() / truth[:, :40].mean() - 1) < 0.05
    assert abs(result[:, 90:].mean() / truth[:, 90:].mean() - 1) < 0.01


@pytest.mark.parametrize("wrong", [0.7, 1.4, 2.0])
@pytest.mark.parametrize("dark", [0.0005, 0.002, 0.02])
def test_the_mean_of_the_dark_is_that_of_its_own_samples(dark: float, wrong: float) -> None:
    """Bright pixels outweighed the dark ones over 48 pixels: up to 5 % of a wrong light stayed."""
    truth = np.where(np.arange(SHAPE[1])[None, :, None] < 64, np.float32(dark), np.float32(0.7)) * ONES
    own = noisy(truth, 0.3, 9)
    result = restore_mean(truth * np.where(truth < 0.1, np.float32(wrong), np.float32(1)), own, 0.35)
    # 5,376 pixels with a deviation of 30 %: their mean is known to 0.4 %.
    assert abs(result[:, :56].mean() / own[:, :56].mean() - 1) < 0.03


def test_means_that_thousands_of_samples_show_are_restored() -> None:
    """A tenth of a difference of 3 % that is known to 0.3 % stayed."""
    truth = np.full_like(ONES, 0.5)
    own = noisy(truth, 0.35, 9)
    result = restore_mean(np.float32(0.97) * truth, own, 0.35)
    assert abs(result.mean() / own.mean() - 1) < 0.0015


@pytest.mark.parametrize("lamp", [30.0, 1000.0, 65504.0])
def test_a_lamp_that_is_too_bright_darkens_nothing_around_it(lamp: float) -> None:
    truth = np.full_like(ONES, 0.3)
    y, x = np.mgrid[: SHAPE[0], : SHAPE[1]]
    inside = np.hypot(y - 48, x - 64) < 4
    truth[inside] = lamp
    own = noisy(truth, 0.2, 11)
    own[inside] = lamp
    picture = truth.copy()
    picture[inside] *= 1.1
    room = ~inside
    assert abs(restore_mean(picture, own, 0.3)[room].mean() / own[room].mean() - 1) < 0.005


@pytest.mark.parametrize("lamp", [10.0, 5000.0])
def test_a_lamp_is_no_brighter_than_its_samples(lamp: float) -> None:
    """A sun that moves without vectors came out at up to three times its light."""
    own = np.full_like(ONES, 0.3)
    own[40:43, 50:53] = lamp
    other = np.roll(own, 20, axis=1)
    held = limit_lamps(3 * np.maximum(own, other), [own, other], 0.3)
    assert held[40:43, 50:53].max() == held[40:43, 70:73].max() == lamp
    # Light below four exposures may be in the picture alone.
    assert held[0, 0].min() == pytest.approx(0.9)
    np.testing.assert_array_equal(limit_lamps(own, [other], 10 * lamp), own)


def test_the_halo_of_a_lamp_is_told_from_the_room() -> None:
    """Counted with the room it darkened that by 1 %."""
    truth = np.full_like(ONES, 0.3)
    y, x = np.mgrid[: SHAPE[0], : SHAPE[1]]
    distance = np.hypot(y - 48, x - 64)
    truth[distance < 4] = 1000
    own, picture = noisy(truth, 0.2, 11), truth.copy()
    picture[(distance >= 4) & (distance < 5.5)] = 10
    far = ~beside_lamps(picture, 0.3)
    room = distance >= 8
    assert far[room].all()
    assert not far[distance < 5.5].any()
    result = restore_mean(picture, np.where(far[..., None], own, picture), 0.3)
    assert abs(result[room].mean() / own[room].mean() - 1) < 0.002
    assert not beside_lamps(picture, 100.0).any()


def test_a_few_fireflies_glow_over_nothing() -> None:
    truth = np.full_like(ONES, 0.3)
    own = noisy(truth, 0.02, 12)
    rng = np.random.default_rng(13)
    own[rng.integers(0, SHAPE[0], 6), rng.integers(0, SHAPE[1], 6)] = 6
    assert np.abs(restore_mean(truth, own, 0.3) / truth - 1).max() < 0.002


def test_negative_light_is_no_less_than_it_was() -> None:
    picture = np.full_like(ONES, -0.05)
    assert restore_mean(picture, picture - 1, 1.0).min() >= -0.05


def test_shapes_must_fit() -> None:
    own, sides = window(lines(), 0.1)
    with pytest.raises(ValueError, match="noisy: expected shape"):
        blend_samples(lines()[1:], own, sides, 1.0)
    strips = [(0, np.zeros((3, 4, 4, 3)))]
    with pytest.raises(ValueError, match="residuals: expected shape"):
        average_neighbours(np.zeros((3, 4, 5, 3)), strips, *np.ones((2, 3, 4, 5)), *np.ones((2, 4, 5, 3)))


def test_a_wall_lit_by_rare_samples_has_no_dimples():
    """Where two frames happen to have no bright sample, both show less light than the wall has."""
    wall = np.full((160, 160, 3), 0.2, np.float32)

    def few_bright(rng: np.random.Generator) -> np.ndarray:
        bright, dark = rng.exponential(3, wall.shape[:2]), rng.exponential(0.02, wall.shape[:2])
        return np.where(rng.random(wall.shape[:2]) < 0.06, bright, dark)[..., None].astype(np.float32) * wall / 0.2

    found = []
    for seed in range(6):
        rng = np.random.default_rng(seed)
        frames = np.stack([few_bright(rng) for _ in range(3)])
        confidence = np.ones(frames.shape[:3], np.float32)
        sides = average_neighbours(frames, None, confidence, confidence, np.ones_like(wall), frames[1])
        found.append(float(np.abs(blend_samples(wall, frames[1], sides, 0.2) / wall - 1).max()))
    assert max(found) < 0.5  # 2.2 where the scatter of the noise does not count


@pytest.mark.parametrize("wrong", [1.0, 0.8, 1.3])
def test_light_of_rare_samples_darkens_no_picture(wrong):
    """Samples of fifty times the light count as twenty: a picture that is right is not too bright for them."""
    wall = np.full((256, 256, 3), 0.2, np.float32)
    bright = np.random.default_rng(0).random(wall.shape[:2]) < 0.02
    rendered = bright[..., None] * np.float32(50) * wall
    restored = restore_mean(np.float32(wrong) * wall, rendered, 0.2)
    assert restored.mean() / 0.2 > min(wrong, 1) - 0.05  # 0.2 without the light that is cut
    assert restored.mean() / 0.2 < max(wrong, 1) + 0.05


@pytest.mark.parametrize("scale", [1e-12, 1, 1e6])
def test_the_light_of_a_picture_with_too_little_contrast_is_restored(scale: float) -> None:
    """It was right in the mean of relative light, and 1 % too dark."""
    rng = np.random.default_rng(21)
    grain = cv2.GaussianBlur(rng.standard_normal((64, 96)).astype(np.float32), (0, 0), 1.5)
    shape = grain[..., None] * ONES[:64, :96] / grain.std()
    truth, flat = (np.float32(0.2 * scale) * np.exp(np.float32(contrast) * shape) for contrast in (0.7, 0.6))
    noise = np.float32(0.4) * rng.standard_normal((64, 96, 1)).astype(np.float32)
    picture = flat * np.median(truth / flat)
    assert picture.mean() / truth.mean() < 0.96
    noisy = truth * (1 + noise)
    picture[:, :30], noisy[:, :30] = truth[:, :30] * np.float32(0.003), noisy[:, :30] * np.float32(0.003)
    restored = restore_mean(picture, noisy, 0.2 * scale)
    assert restored.mean() == pytest.approx(noisy.mean(), rel=0.005)
    # The dark part beside it, which is right, stays: a factor of the whole picture made it 3 % too bright.
    assert restored[:, :30].mean() == pytest.approx(picture[:, :30].mean(), rel=0.01)


def test_a_mean_of_the_whole_picture_that_few_samples_make_is_not_known() -> None:
    picture = np.full((64, 96, 3), 0.2, np.float32)
    noisy = picture.copy()
    noisy[::16, ::16] += 3  # 24 samples
    np.testing.assert_array_equal(restore_mean(picture, noisy, 0.2), picture)
