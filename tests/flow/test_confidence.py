"""Confidence: what is out of frame, hidden or different is not trusted."""

from __future__ import annotations

import numpy as np
import pytest

from flow.confidence import estimate_confidence, find_coverage, mix_centre
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


@pytest.mark.parametrize("shape", [(1, 1), (1, 9), (5, 5)])
def test_tiny_frames(shape: tuple[int, int]) -> None:
    still, inside = np.zeros((*shape, 2)), np.ones(shape, bool)
    assert (estimate_confidence(still, inside=inside, reverse=still) == 1).all()


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
