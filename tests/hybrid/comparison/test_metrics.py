"""Every measure against its definition, its peers, and made-up shots whose score is known."""

from itertools import pairwise

import cv2
import numpy as np
import pytest
from numpy.typing import NDArray
from skimage.metrics import structural_similarity

from flow.warp import warp
from hybrid.comparison.flip import flip_maps
from hybrid.comparison.metrics import (
    bootstrap_interval,
    mean_bias,
    mean_over_shots,
    psnr,
    relmse,
    smape,
    ssim,
    temporal_psnr,
    tone_map,
)
from tests.seldom import seldom

SIZE = (40, 56)


def flip(image: NDArray[np.float32], reference: NDArray[np.float32]) -> float:
    return float(flip_maps([image], reference)[0].mean(dtype=np.float64))


ONE_FRAME = [psnr, ssim, relmse, smape, mean_bias, flip]


@pytest.fixture
def rng() -> np.random.Generator:
    return np.random.default_rng(5)


def texture(rng: np.random.Generator, size: tuple[int, int] = SIZE) -> NDArray[np.float32]:
    """Smooth colourful radiance between 0.1 and about 3, with structure down to a few pixels."""
    noise = cv2.GaussianBlur(rng.normal(size=(*size, 3)), (0, 0), 2.0)
    return np.exp(noise / noise.std() * 0.7).astype(np.float32)


def noisy(image: NDArray[np.float32], rng: np.random.Generator, sigma: float = 0.2) -> NDArray[np.float32]:
    return np.maximum(image * (1 + sigma * rng.normal(size=image.shape)), 0).astype(np.float32)


def expand(tone: NDArray[np.floating]) -> NDArray[np.float32]:
    """Inverse of the tone curve at exposure 1: lets a test place an error of known size behind the curve."""
    return (tone / (1 - tone)).astype(np.float32)


def shift(image: NDArray[np.float32], pixels: int) -> NDArray[np.float32]:
    return np.roll(image, pixels, axis=1)


# One frame


def test_perfect_image_scores_perfect(rng: np.random.Generator) -> None:
    image = texture(rng)
    assert psnr(image, image) == np.inf
    assert ssim(image, image) == pytest.approx(1, abs=1e-12)  # rounding of the ratio of equal sums
    assert relmse(image, image) == smape(image, image) == mean_bias(image, image) == 0


def test_measures_equal_their_formulas(rng: np.random.Generator) -> None:
    reference = texture(rng)
    image = noisy(reference, rng)
    x, r = image.astype(float), reference.astype(float)
    assert tone_map(x, 2.0) == pytest.approx(2 * x / (1 + 2 * x))
    assert psnr(image, reference) == pytest.approx(-10 * np.log10(np.mean((x / (1 + x) - r / (1 + r)) ** 2)))
    assert relmse(image, reference) == pytest.approx(np.mean((x - r) ** 2 / (r**2 + 0.01)))
    assert smape(image, reference) == pytest.approx(np.mean(np.abs(x - r) / (np.abs(x) + np.abs(r) + 0.01)))
    assert mean_bias(image * np.float32(1.03), image) == pytest.approx(0.03, abs=1e-6)  # float32 product


def test_ssim_is_that_of_scikit_image(rng: np.random.Generator) -> None:
    reference = texture(rng)
    image = noisy(reference, rng)
    settings = {"data_range": 1.0, "gaussian_weights": True, "sigma": 1.5, "use_sample_covariance": False}
    theirs = structural_similarity(tone_map(reference), tone_map(image), channel_axis=-1, **settings)
    assert ssim(image, reference) == pytest.approx(theirs, abs=1e-9)  # both in float64


def test_relmse_trims_the_largest_errors_only(rng: np.random.Generator) -> None:
    reference = np.ones((*SIZE, 3), np.float32)
    image = reference + np.float32(0.1)
    expected = relmse(image, reference)
    image[3, 4] = 1e4  # one pixel of 2240: inside the 0.1 % (two pixels) that are trimmed
    assert relmse(image, reference) > 1e4
    assert relmse(image, reference, trim=0.001) == pytest.approx(expected)


def test_one_exposure_scales_every_measure(rng: np.random.Generator) -> None:
    reference = texture(rng)
    image = noisy(reference, rng)
    for measure in (psnr, ssim, relmse, smape):
        # A power of two is exact in float, so the two ways round differ in nothing.
        assert measure(image * 4, reference * 4) == pytest.approx(measure(image, reference, exposure=4))


def test_halves_take_the_references_noise_out(rng: np.random.Generator) -> None:
    size = (200, 200, 3)
    truth = rng.uniform(0.2, 0.8, size)
    image = expand(truth + 0.02 * rng.normal(size=size))
    # Right in the mean as light, which is what samples are.
    halves = tuple(expand(truth) + 0.05 * (1 - truth) ** -2 * rng.normal(size=size) for _ in range(2))
    # Known error 0.02; the product of errors has a relative spread of about (0.05/0.02)²/√120000 = 2 %.
    assert psnr(image, halves) == pytest.approx(-20 * np.log10(0.02), abs=0.3)
    assert psnr(image, (halves[0] + halves[1]) / 2) < psnr(image, halves) - 3


@pytest.mark.parametrize("exposure", [0.25, 1.0, 4.0])
def test_noise_of_halves_leaves_the_score_alone_and_makes_no_dark_picture_win(rng, exposure):
    """Skewed noise, as path tracing has: on a concave curve it darkens what is compared with."""
    y, x = np.mgrid[:160, :160]
    truth = np.dstack([1 + 0.8 * np.sin(x / 9 + k) * np.cos(y / 7) for k in range(3)]) / exposure
    image = truth * (1 + 0.06 * rng.normal(size=truth.shape))
    halves = tuple(truth * rng.gamma(11, 1 / 11, truth.shape) for _ in range(2))  # 30 % of the light
    gains = [
        psnr(image * f, halves, exposure=exposure) - psnr(image * f, truth, exposure=exposure) for f in (0.97, 1.03)
    ]
    # The product of errors spreads by 0.07² / √77000, a twentieth of what it is, and for both pictures alike. Without
    # the bias taken off the score is 1.3 dB too high for the dark picture and 0.7 too low for the bright one.
    assert gains == pytest.approx([0, 0], abs=0.6)
    assert gains[0] == pytest.approx(gains[1], abs=0.3)


def test_halves_that_explain_everything_give_infinity(rng: np.random.Generator) -> None:
    a, b = noisy(texture(rng), rng), noisy(texture(rng), rng)
    between = expand(0.5 * (tone_map(a) + tone_map(b)))
    assert psnr(between, (a, b)) == np.inf  # (x − a)(x − b) < 0 everywhere: no error can be told from zero


@pytest.mark.parametrize("measure", ONE_FRAME)
@pytest.mark.parametrize("value", [np.nan, *seldom(np.inf, -np.inf)])
def test_lost_pixel_makes_the_frame_nan(measure, value: float, rng: np.random.Generator) -> None:
    reference = texture(rng)
    image = reference.copy()
    image[5, 6, 1] = value
    assert np.isnan(measure(image, reference))


def test_trimming_does_not_hide_a_lost_pixel(rng: np.random.Generator) -> None:
    image = texture(rng)
    reference = image.copy()
    image[5, 6] = np.nan
    assert np.isnan(relmse(image, reference, trim=0.01))


@pytest.mark.parametrize("measure", ONE_FRAME)
def test_bad_references_are_errors(measure, rng: np.random.Generator) -> None:
    image = texture(rng)
    broken = image.copy()
    broken[0, 0, 0] = np.nan
    with pytest.raises(ValueError, match="reference must be finite, 1 of"):
        measure(image, broken)
    with pytest.raises(ValueError, match="alike"):
        measure(image, image[1:])


def test_black_reference_has_no_bias() -> None:
    black = np.zeros((*SIZE, 3), np.float32)
    assert np.isnan(mean_bias(black + 1, black))


# Time


def still(count: int) -> tuple[list[NDArray[np.float32]], list[NDArray[np.bool_]]]:
    """Zero flows and full masks for the `count` − 1 pairs of a shot that stands still."""
    pairs = count - 1
    return [np.zeros((*SIZE, 2), np.float32)] * pairs, [np.ones(SIZE, bool)] * pairs


def test_still_perfect_shot_is_perfect(rng: np.random.Generator) -> None:
    shot = [texture(rng)] * 4
    assert (temporal_psnr(shot, shot, *still(4)) == np.full(3, np.inf)).all()


def test_error_that_stays_is_no_flicker(rng: np.random.Generator) -> None:
    reference = texture(rng)
    assert (temporal_psnr([noisy(reference, rng)] * 3, [reference] * 3, *still(3)) == np.inf).all()


@pytest.mark.parametrize("size", [0.001, 0.02])
def test_flicker_of_known_size_is_recovered(size: float, rng: np.random.Generator) -> None:
    tone = tone_map(texture(rng)) * 0.9
    shot = [expand(tone + (size if t % 2 else 0)) for t in range(6)]
    scores = temporal_psnr(shot, [expand(tone)] * 6, *still(6))
    # float32 radiance behind the curve is exact to 1e-7, 1e-4 of the smaller flicker.
    np.testing.assert_allclose(scores, -20 * np.log10(size), atol=2e-3)


def test_flow_leads_back_to_the_previous_frame(rng: np.random.Generator) -> None:
    """An error that travels with the scene is no flicker if the flow is read in the right direction."""
    scene, error = texture(rng), np.float32(0.05) * texture(rng)
    references = [shift(scene, 2 * t) for t in range(4)]
    frames = [shift(scene + error, 2 * t) for t in range(4)]
    back = np.zeros((*SIZE, 2), np.float32)
    back[..., 0] = -2
    inside = np.ones(SIZE, bool)
    inside[:, :2] = False  # came in from outside the frame
    assert (temporal_psnr(frames, references, [back] * 3, [inside] * 3) == np.inf).all()
    wrong = temporal_psnr(frames, references, [-back] * 3, [inside] * 3)
    assert (wrong < 50).all()


def test_blur_does_not_win(rng: np.random.Generator) -> None:
    """A plain warp error puts blur above the truth. Against the reference's own differences it cannot."""
    scene, columns = texture(rng), np.arange(SIZE[1])
    back = np.zeros((*SIZE, 2), np.float32)
    back[..., 0] = -2
    inside = np.ones(SIZE, bool)
    inside[:, :2] = False
    # The texture moves by 2 px a frame, the edge of a shadow by 5: what vectors cannot explain.
    references = [shift(scene, 2 * t) * np.where(columns < 10 + 5 * t, 0.3, 1.0)[:, None] for t in range(6)]
    references = [r.astype(np.float32) for r in references]
    faithful = [expand(np.clip(tone_map(r) + 0.01 * rng.normal(size=r.shape), 0, 0.99)) for r in references]
    blurred = [cv2.GaussianBlur(r, (0, 0), 4.0) for r in references]

    def warp_error(shot: list[NDArray[np.float32]]) -> float:
        tones = [tone_map(frame).astype(np.float32) for frame in shot]
        return float(np.mean([((b - warp(a, back)[0])[inside] ** 2).mean() for a, b in pairwise(tones)]))

    assert warp_error(blurred) < warp_error(references)

    def score(shot: list[NDArray[np.float32]]) -> float:
        return float(temporal_psnr(shot, references, [back] * 5, [inside] * 5).mean())

    assert score(references) == np.inf
    assert score(faithful) > score(blurred) + 3


def test_temporal_psnr_takes_halves(rng: np.random.Generator) -> None:
    size, sigma = (*SIZE, 3), 0.02
    truth = rng.uniform(0.2, 0.8, size)
    frames = [expand(truth + sigma * rng.normal(size=size)) for _ in range(5)]
    halves = [tuple(expand(truth + 0.03 * rng.normal(size=size)) for _ in range(2)) for _ in range(5)]
    scores = temporal_psnr(frames, halves, *still(5))
    # The error of two frames differs by √2 σ; the spread over 6720 values × 4 pairs is about 0.1 dB.
    assert scores.mean() == pytest.approx(-20 * np.log10(np.sqrt(2) * sigma), abs=0.4)


def test_temporal_measures_are_nan_where_a_frame_is(rng: np.random.Generator) -> None:
    reference = texture(rng)
    lost = reference.copy()
    lost[2, 2] = np.nan
    shot = [reference, lost, reference, reference]
    scores = temporal_psnr(shot, [reference] * 4, *still(4))
    assert np.isnan(scores[:2]).all()
    assert scores[2] == np.inf
    empty = np.zeros(SIZE, bool)
    assert np.isnan(temporal_psnr([reference] * 2, [reference] * 2, still(2)[0], [empty])).all()


def test_series_that_do_not_belong_together_are_errors(rng: np.random.Generator) -> None:
    image = texture(rng)
    flows, masks = still(3)
    with pytest.raises(ValueError, match="shorter"):
        temporal_psnr([image] * 3, [image] * 2, flows, masks)
    with pytest.raises(ValueError, match="longer"):
        temporal_psnr([image] * 2, [image] * 2, flows, masks)


# Intervals


def test_bootstrap_interval_is_the_normal_one_for_normal_data(rng: np.random.Generator) -> None:
    values = rng.normal(3, 2, 400)
    low, high = bootstrap_interval(values)
    half = 1.96 * values.std() / np.sqrt(values.size)
    # The 2.5 % quantile of 2000 resamples has a standard error of about 3 % of the half width.
    assert low == pytest.approx(values.mean() - half, abs=0.15 * half)
    assert high == pytest.approx(values.mean() + half, abs=0.15 * half)
    assert bootstrap_interval(values) == (low, high)


def test_bootstrap_interval_of_special_values() -> None:
    assert bootstrap_interval([2.5]) == (2.5, 2.5)
    assert bootstrap_interval([np.inf, np.inf]) == (np.inf, np.inf)
    assert np.isnan(bootstrap_interval([1.0, np.nan])).all()


def test_bootstrap_over_shots_is_as_wide_as_they_differ(rng: np.random.Generator) -> None:
    """Many frames of three shots that differ tell the mean of shots no better than three figures do."""
    shots = (200, 100, 50)
    values = np.concatenate([mean + 0.1 * rng.normal(size=n) for mean, n in zip((1.0, 2.0, 6.0), shots, strict=True)])
    assert mean_over_shots(values, shots) == pytest.approx(3.0, abs=0.03)  # 0.1/√50 of the shortest, a third of it
    low, high = bootstrap_interval(values, shots=shots)
    # One resample in 27 takes the same shot three times: the ends are the shots themselves, a hundredth about them.
    assert low == pytest.approx(1.0, abs=0.05)
    assert high == pytest.approx(6.0, abs=0.05)
    narrow = bootstrap_interval(values)
    assert narrow[1] - narrow[0] < 0.5  # frames alone would claim to know it


def test_a_firefly_in_one_of_two_references_adds_no_error_around_it(rng):
    """Without the bound on the ratio of the halves the exact image scores 48 dB."""
    truth = rng.uniform(0.2, 0.8, (40, 40, 3))
    halves = [truth * rng.normal(1, 0.001, truth.shape) for _ in range(2)]
    halves[0][20, 20] = 50
    assert psnr(truth, (halves[0], halves[1])) > 65
