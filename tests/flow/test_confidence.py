"""Confidence: what is out of frame, hidden or different is not trusted."""

from itertools import pairwise

import numpy as np
import pytest

from flow.confidence import (
    NOISE_LIMIT,
    GuideNoise,
    compare_guides,
    estimate_confidence,
    find_coverage,
    local_variance,
    measure_share,
    mix_centre,
    outline_variance,
)
from flow.warp import warp

SHAPE = (16, 20)
STILL = np.zeros((*SHAPE, 2), np.float32)
INSIDE = np.ones(SHAPE, bool)


def constant(*values: float) -> np.ndarray:
    return np.broadcast_to(np.float32(values), (*SHAPE, len(values))).copy()


def test_a_still_frame_is_trusted_everywhere() -> None:
    rng = np.random.default_rng(0)
    albedo = rng.random((*SHAPE, 3), np.float32)
    normal = rng.normal(size=(*SHAPE, 3)).astype(np.float32)
    confidence = estimate_confidence(
        STILL, inside=INSIDE, reverse=STILL, albedo=albedo, other_albedo=albedo, normal=normal, other_normal=normal
    )  # fmt: skip
    # The cosine of a vector with itself, in float32.
    np.testing.assert_allclose(confidence, 1, atol=1e-5)
    assert confidence.dtype == np.float32


def test_out_of_frame_and_bad_pixels_are_zero_with_their_neighbours() -> None:
    flow = np.broadcast_to(np.float32([3, 0]), (*SHAPE, 2))
    _, inside = warp(np.zeros(SHAPE), flow)
    confidence = estimate_confidence(flow, inside=inside)
    assert not confidence[:, 16:].any()
    assert (confidence[:, :16] == 1).all()
    good = INSIDE.copy()
    good[5, 5] = False
    confidence = estimate_confidence(STILL, inside=good)
    assert not confidence[4:7, 4:7].any()
    assert confidence.sum() == confidence.size - 9


def test_an_occlusion_fails_forward_and_backward() -> None:
    """A square moves right by 6 px over a resting ground."""
    flow, reverse = STILL.copy(), STILL.copy()
    flow[4:12, 3:9, 0] = 6
    reverse[4:12, 9:15, 0] = -6
    confidence = estimate_confidence(flow, inside=INSIDE, reverse=reverse)
    assert not confidence[4:12, 9:15].any()  # ground that the square will cover
    assert (confidence[5:11, 4:8] == 1).all()  # the square
    assert (confidence[:2] == 1).all()


def test_albedo_falls_off_as_a_gaussian_relative_above_one() -> None:
    def agreement(a: float, b: float) -> float:
        result = estimate_confidence(STILL, inside=INSIDE, albedo=constant(a, a, a), other_albedo=constant(b, b, b))
        return float(result[3, 3])

    # exp(-3 · 0.05² / 0.1²); float32.
    assert agreement(0.5, 0.55) == pytest.approx(np.exp(-0.75), rel=1e-4)
    assert agreement(0.5, 0.9) < 1e-3
    # The same relative difference on an emitter as at 1.
    assert agreement(95, 100) == pytest.approx(agreement(0.95, 1), rel=1e-4)
    assert agreement(0, 0) == 1


def test_normals_of_any_length_and_of_no_surface() -> None:
    def agreement(a: tuple[float, float, float], b: tuple[float, float, float]) -> float:
        result = estimate_confidence(STILL, inside=INSIDE, normal=constant(*a), other_normal=constant(*b))
        return float(result[3, 3])

    tilt = float(np.arccos(0.9))
    tilted = (np.sin(tilt), 0.0, np.cos(tilt))
    assert agreement((0, 0, 1), (0, 0, 0.5)) == pytest.approx(1, abs=1e-5)
    assert agreement((0, 0, 1), tilted) == pytest.approx(0.5, abs=1e-5)  # (0.9 - 0.8) / 0.2
    assert agreement((0, 0, 1), (1, 0, 0)) == 0
    assert agreement((0, 0, 0), (0, 0, 0)) == 1  # sky and sky
    assert agreement((0, 0, 1), (0, 0, 0)) == 0  # surface and sky


def test_guides_that_are_not_finite_give_zero() -> None:
    albedo = constant(0.5, 0.5, 0.5)
    bad = albedo.copy()
    bad[3, 3], bad[10, 10] = np.nan, np.inf
    confidence = estimate_confidence(STILL, inside=INSIDE, albedo=albedo, other_albedo=bad)
    assert np.isfinite(confidence).all()
    assert not confidence[2:5, 2:5].any()
    assert not confidence[9:12, 9:12].any()
    assert confidence.sum() == confidence.size - 18


def test_errors_name_the_argument() -> None:
    with pytest.raises(ValueError, match="albedo and other_albedo come together"):
        estimate_confidence(STILL, inside=INSIDE, albedo=constant(1, 1, 1))
    with pytest.raises(ValueError, match="inside has shape"):
        estimate_confidence(STILL, inside=INSIDE[:3])
    with pytest.raises(ValueError, match="confidence"):
        mix_centre(constant(1), constant(1), INSIDE[:3])


def test_mixing_is_linear_and_untrusted_pixels_cannot_spoil_it() -> None:
    confidence = np.linspace(0, 1, SHAPE[0] * SHAPE[1], dtype=np.float32).reshape(SHAPE)
    mixed = mix_centre(constant(4, 8), constant(2, 2), confidence)
    np.testing.assert_allclose(mixed, 2 + confidence[..., None] * [2, 6], rtol=1e-6)
    warped = constant(4)[..., 0]
    warped[0, 0] = np.nan
    mixed = mix_centre(warped, constant(2)[..., 0], confidence)
    assert mixed[0, 0] == 2
    assert np.isfinite(mixed).all()


def test_guides_of_the_neighbour_are_sampled_along_the_flow() -> None:
    rng = np.random.default_rng(1)
    albedo, normal = rng.random((2, *SHAPE, 3), np.float32)
    flow = np.broadcast_to(np.float32([2.25, -1.5]), (*SHAPE, 2)).copy()
    rows = slice(4, 12)
    moved = {name: warp(layer, flow)[0] for name, layer in (("albedo", albedo), ("normal", normal))}
    given = {"inside": INSIDE[rows], "first_row": rows.start, "other_albedo": albedo, "other_normal": normal}
    own = {name: layer[rows] for name, layer in moved.items()}
    np.testing.assert_allclose(estimate_confidence(flow[rows], **given, **own), 1, atol=1e-5)
    assert estimate_confidence(STILL[rows], **given, **own).mean() < 0.1
    with pytest.raises(ValueError, match="other_albedo has 16 rows"):
        estimate_confidence(flow[rows], inside=INSIDE[rows], albedo=albedo[rows], other_albedo=albedo, first_row=9)


def test_coverage_needs_a_valid_vector_into_the_frame_and_four_measured_pixels() -> None:
    flow = np.broadcast_to(np.float32([0.5, 0]), (*SHAPE, 2)).copy()
    valid, measured = INSIDE.copy(), INSIDE.copy()
    valid[2, 3], measured[9, 9] = False, False
    flow[14, 5] = 100, 0
    rows = slice(1, 16)
    expected = INSIDE.copy()
    expected[2, 3] = expected[9, 8] = expected[9, 9] = expected[14, 5] = False
    np.testing.assert_array_equal(find_coverage(flow[rows], valid[rows], measured, rows.start), expected[rows])


def sampled(samples: int, seed: int, objects: slice = slice(8, 40)) -> dict[str, np.ndarray]:
    """Albedo and normals of a striped object on a plane, a few samples in each pixel."""
    rng = np.random.default_rng(seed)
    y, x = (places[..., None] + rng.random((64, 64, samples)) for places in np.mgrid[:64, :64].astype(np.float64))
    inside = (x > objects.start + 0.4) & (x < objects.stop + 0.3)
    stripe = inside & ((0.3 * x + y) % 5 < 2.5)
    albedo = np.where(stripe, 0.8, np.where(inside, 0.2, 0.5)).mean(-1)[..., None] * np.ones(3)
    normal = np.stack([np.where(inside, -0.6, 0), np.zeros_like(x), np.where(inside, 0.8, 1)], -1).mean(-2)
    return {"albedo": albedo.astype(np.float32), "normal": normal.astype(np.float32)}


def pair(here: dict[str, np.ndarray], there: dict[str, np.ndarray]) -> dict[str, np.ndarray]:
    still, inside = np.zeros((64, 64, 2), np.float32), np.ones((64, 64), bool)
    return {"flow": still, "inside": inside, **here, **{f"other_{name}": guide for name, guide in there.items()}}


def noise_of(here: dict[str, np.ndarray], there: dict[str, np.ndarray]) -> GuideNoise:
    arrays = pair(here, there)
    distance, variance = compare_guides(**arrays), local_variance(**here)
    return GuideNoise(variance, measure_share(outline_variance(variance, distance), distance, arrays["inside"]))


def test_outlines_of_few_samples_are_trusted_and_another_surface_is_not() -> None:
    """Samples fall on either side of an outline by chance: textured objects had half of their confidence."""
    here, there, moved = sampled(8, 1), sampled(8, 2), sampled(8, 3, objects=slice(14, 46))
    noise = noise_of(here, there)
    assert max(noise.share) == NOISE_LIMIT
    strict, lenient = (estimate_confidence(**pair(here, there), noise=n) for n in (None, noise))
    assert strict[:, 8:40].mean() < 0.3
    assert lenient[:, 8:40].mean() > 0.9
    occluded = estimate_confidence(**pair(here, moved), noise=noise)
    assert occluded[:, 11:14].max() < 0.01  # the object in one frame, the plane in the other
    assert occluded[:, 42:45].max() < 0.01


def test_noise_at_outlines_falls_with_the_samples() -> None:
    shares = [noise_of(sampled(n, 1), sampled(n, 2)).share for n in (32, 128, 512)]
    for few, many in pairwise(shares):
        np.testing.assert_allclose(np.divide(few, many), 4, rtol=0.4)
    assert noise_of(sampled(512, 1), sampled(512, 1)).share == (0, 0)


def test_noise_everywhere_makes_no_outlines() -> None:
    """As behind a lens: there geometry has to be strict, since vectors are averages over what a pixel shows."""
    rng = np.random.default_rng(0)
    here, there = ({"albedo": rng.normal(0.5, 0.1, (64, 64, 3)).astype(np.float32)} for _ in range(2))
    variance = local_variance(here["albedo"], None)
    outlines = outline_variance(variance, compare_guides(**pair(here, there)))
    assert outlines.mean() < 0.02 * variance[..., 0].mean()


def test_noise_forgives_no_guide_that_is_not_finite() -> None:
    here, there = sampled(8, 1), sampled(8, 2)
    noise = noise_of(here, there)
    for name, value in (("albedo", np.nan), ("normal", np.inf)):
        for guides in (here, there):
            kept = guides[name].copy()
            guides[name][30, 30] = value
            confidence = estimate_confidence(**pair(here, there), noise=noise)
            assert not confidence[29:32, 29:32].any()
            assert np.isfinite(confidence).all()
            assert np.isfinite(local_variance(**here)).all()
            guides[name][:] = kept


def test_a_missing_guide_has_no_noise() -> None:
    variance = local_variance(None, sampled(8, 1)["normal"])
    assert not variance[..., 0].any()
    assert variance[..., 1].any()
    with pytest.raises(ValueError, match="albedo and normal"):
        local_variance(None, None)
