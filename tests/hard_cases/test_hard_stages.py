"""Every public stage of flow and nlm, on arrays with anything in them: finite, in range, never a warning turned NaN."""

import numpy as np
import pytest
from hypothesis import HealthCheck, given, settings
from hypothesis import strategies as st

from flow.confidence import estimate_confidence, mix_centre
from flow.guide import Guide, estimate_noise, make_guide, pair_guides
from flow.motion import CYCLES, MotionConvention, compose_flow, forward_backward_error, invert_flow, normalize_motion
from flow.selection import select_flow
from flow.tvl1 import dense_flow, refine_flow
from flow.warp import warp
from hybrid.alignment.transfer import compress, demodulate, expand, measure_exposure, remodulate
from nlm import variance as variances
from nlm.average import average, reject_outliers, replace_nonfinite, robust_average
from nlm.gate import color_gate
from nlm.guided import guided_filter
from nlm.nonlocal_means import joint_nlm
from nlm.relight import relight

EXAMPLES = 20
anything = settings(
    max_examples=EXAMPLES, deadline=None, derandomize=True, suppress_health_check=[HealthCheck.function_scoped_fixture]
)
SIZES = st.sampled_from([(1, 1), (1, 6), (6, 1), (2, 3), (5, 5), (7, 11), (16, 16), (17, 20)])
# Extremes of finite radiance: nothing, denormal, half's limit, fireflies.
ODD = np.float32([0, -0.0, 1e-42, 1e-38, 1e-20, 1e-6, 1, 3, 6.5e4, 1e6, 1e12])
WRONG = np.float32([np.nan, np.inf, -np.inf])


@pytest.fixture(autouse=True)
def counted(record_property):
    record_property("cases", EXAMPLES)


@st.composite
def images(draw, channels=3, frames=None, wrong=False, negative=False):
    """(H, W, C) or (T, H, W, C): noise, constants and odd values, some of them wrong."""
    size = draw(SIZES)
    rng = np.random.default_rng(draw(st.integers(0, 2**32 - 1)))
    shape = (*(() if frames is None else (frames,)), *size, channels)
    image = rng.gamma(1, 1, shape).astype(np.float32) * np.float32(draw(st.sampled_from([0, 1e-6, 1, 1e6])))
    if draw(st.booleans()):
        image = np.where(rng.random(shape) < 0.1, rng.choice(ODD, shape), image)
    if wrong and draw(st.booleans()):
        share = draw(st.sampled_from([0.02, 0.5, 1.0]))
        image = np.where(rng.random(shape) < share, rng.choice(WRONG, shape), image)
    if negative and draw(st.booleans()):
        image = image * rng.choice(np.float32([-1, 1]), shape)
    return np.ascontiguousarray(image, np.float32), rng


def flows(rng, shape, *, wrong=False):
    """Vectors from none to far out of the frame, and what is no vector."""
    flow = rng.normal(size=(*shape, 2)).astype(np.float32) * rng.choice(np.float32([0, 0.3, 3, 300, 1e4]))
    if wrong:
        flow = np.where(
            rng.random(flow.shape) < 0.2, rng.choice(np.float32([np.nan, np.inf, -np.inf, 1e9]), flow.shape), flow
        )
    return np.ascontiguousarray(flow, np.float32)


def weights(rng, shape):
    """Confidence: all, none, or anything between."""
    return rng.choice([np.zeros(shape), np.ones(shape), rng.random(shape), rng.integers(0, 2, shape)]).astype(
        np.float32
    )


def between(image, low, high, slack=1e-5):
    """Whether all of `image` lies between two bounds, rounding aside."""
    room = slack * np.maximum(np.abs(low), np.abs(high)) + 1e-37  # denormals have next to no digits
    return bool(np.isfinite(image).all() and (image >= low - room).all() and (image <= high + room).all())


# --- flow


@anything
@given(images(4, wrong=True, negative=True), st.sampled_from([CYCLES, MotionConvention()]))
def test_vectors_are_finite_and_bounded(drawn, convention):
    vectors, rng = drawn
    vectors = np.where(rng.random(vectors.shape) < 0.1, np.float32(1e9), vectors)
    motion = normalize_motion(vectors, convention)
    for known in motion:
        if known is not None:
            flow, valid = known
            assert np.isfinite(flow).all()
            assert (np.abs(flow) <= 1e4).all()
            assert (flow[~valid] == 0).all()


@anything
@given(images(3), st.sampled_from(["bilinear", "bicubic"]))
def test_a_warp_stays_in_the_images_range(drawn, interpolation):
    image, rng = drawn
    warped, inside = warp(image, flows(rng, image.shape[:2], wrong=True), interpolation=interpolation)
    assert between(warped, image.min(), image.max())
    assert inside.dtype == bool


@anything
@given(images(3), st.integers(0, 1000))
def test_a_warp_of_some_rows_is_some_rows_of_the_warp(drawn, start):
    image, rng = drawn
    flow = flows(rng, image.shape[:2])
    first = start % image.shape[0]
    whole, inside = warp(image, flow)
    part, there = warp(image, flow[first:], first_row=first)
    np.testing.assert_array_equal(part, whole[first:])
    np.testing.assert_array_equal(there, inside[first:])


@anything
@given(images(1))
def test_chained_and_inverted_flows_are_finite(drawn):
    image, rng = drawn
    shape = image.shape[:2]
    first, second = flows(rng, shape), flows(rng, shape)
    chained, _ = compose_flow(first, second)
    depth = np.where(rng.random(shape) < 0.2, np.float32(np.nan), rng.random(shape, np.float32))
    inverse, arrived = invert_flow(first, valid=rng.random(shape) < 0.9, depth=depth)
    assert np.isfinite(chained).all()
    assert np.isfinite(inverse).all()
    assert np.isfinite(forward_backward_error(first, second)).all()
    assert arrived.dtype == bool


@anything
@given(images(3, wrong=True, negative=True))
def test_confidence_is_between_nought_and_one(drawn):
    guide, rng = drawn
    shape = guide.shape[:2]
    other = np.roll(guide, 1, axis=1)
    confidence = estimate_confidence(
        flows(rng, shape), inside=rng.random(shape) < 0.9, reverse=flows(rng, shape), albedo=guide, other_albedo=other,
        normal=other, other_normal=guide,
    )  # fmt: skip
    assert ((confidence >= 0) & (confidence <= 1)).all()
    # Whatever is not finite is not trusted, nor are its neighbours; nor does it spread further.
    assert (confidence[~np.isfinite(guide).all(axis=-1)] == 0).all()
    mixed = mix_centre(other, np.zeros_like(guide), np.zeros(shape, np.float32))
    assert (mixed == 0).all()


@anything
@given(images(3, wrong=True, negative=True), st.booleans())
def test_the_guides_of_the_flow_are_between_nought_and_one(drawn, with_albedo):
    color, _ = drawn
    albedo = np.abs(np.nan_to_num(color, posinf=1e30, neginf=0)) if with_albedo else None
    guide = make_guide(color, albedo, exposure=measure_exposure(color))
    assert between(guide.planes, 0, 1)
    assert np.isfinite(guide.noise).all()
    assert np.isfinite(estimate_noise(guide.planes)).all()


@settings(anything, max_examples=15)  # the slowest
@given(images(2, wrong=True), st.booleans())
def test_refined_flow_is_finite(drawn, dense):
    planes, rng = drawn
    shape = planes.shape[:2]
    noise = rng.random(planes.shape, np.float32)
    guides = pair_guides(Guide(planes, noise), Guide(np.roll(planes, 1, axis=0), noise))
    start = flows(rng, shape, wrong=True)
    found = dense_flow(guides) if dense else refine_flow(guides, start)
    assert np.isfinite(found).all()
    flow, choice = select_flow([flows(rng, shape), found], guides)
    assert np.isfinite(flow).all()
    assert choice.max() <= 1


# --- nlm


@anything
@given(images(3, wrong=True, negative=True))
def test_filled_pixels_are_in_range_and_the_others_untouched(drawn):
    image, _ = drawn
    filled, mask = replace_nonfinite(image)
    np.testing.assert_array_equal(mask, ~np.isfinite(image).all(axis=-1))
    np.testing.assert_array_equal(filled[~mask], image[~mask])
    if mask.all():
        assert (filled == 0).all()
    else:
        assert between(filled, image[~mask].min(axis=0), image[~mask].max(axis=0))


@anything
@given(images(3, frames=5, wrong=True))
def test_averages_are_in_the_range_of_what_is_trusted(drawn):
    window, rng = drawn
    weight = weights(rng, window.shape[:3])
    weight[~np.isfinite(window).all(axis=-1)] = 0
    window[2] = np.nan_to_num(window[2], nan=0, posinf=0, neginf=0)
    trusted = (weight > 0)[..., None]
    low = np.where(trusted, window, np.inf).min(axis=0)
    high = np.where(trusted, window, -np.inf).max(axis=0)
    nobody = ~trusted.any(axis=0)
    low, high = np.where(nobody, window[2], low), np.where(nobody, window[2], high)
    assert between(average(window, weight), low, high)
    assert between(robust_average(window, weight), low, high)


@anything
@given(images(3, frames=5))
def test_rejecting_outliers_only_replaces_by_less(drawn):
    window, rng = drawn
    cleaned, mask = reject_outliers(window, weights(rng, window.shape[:3]))
    assert between(cleaned, window.min(), window.max())
    np.testing.assert_array_equal(cleaned[~mask], window[~mask])
    assert (cleaned[mask].mean(axis=-1) <= window[mask].mean(axis=-1)).all()


@anything
@given(images(3, frames=5))
def test_variances_are_finite_and_not_negative(drawn):
    window, rng = drawn
    confidence = weights(rng, window.shape[:3])
    found = [
        variances.variance_from_window(window, confidence),
        variances.variance_from_residual(window[2]),
        variances.variance_from_halves(window[0], window[1]),
        variances.smooth_variance(np.square(window[2])),
    ]
    for variance in found:
        assert np.isfinite(variance).all()
        assert variance.min() >= 0  # the running sums of a box filter rounded to -2e7 beside 1e24


@anything
@given(images(3, frames=3, wrong=True), st.sampled_from([0.0, 1e-12, 1.0, 1e12]), st.integers(0, 2), st.integers(0, 2))
def test_non_local_means_are_convex(drawn, level, radius, patch):
    window, rng = drawn
    size = window.shape[1:3]
    radius, patch = min(radius, *size), min(patch, *size)
    variance = np.full(window.shape[1:], level, np.float32)
    features = rng.choice([np.zeros((*size, 2)), rng.random((*size, 2))]).astype(np.float32)
    out = joint_nlm(
        window, variance, features, confidence=weights(rng, window.shape[:3]), radius=radius, patch_radius=patch
    )
    good = np.where(np.isfinite(window), window, 0)
    assert between(out, min(good.min(), 0), good.max())


@anything
@given(images(3, frames=3, negative=True))
def test_prefiltered_guides_are_in_range(drawn):
    guides, rng = drawn
    out = variances.prefilter_guide(guides[1], lambda rows: guides[:, rows], weights(rng, guides.shape[:3]))
    assert between(out, guides.min(), guides.max())


@anything
@given(images(3, wrong=True), images(4, wrong=True, negative=True), st.sampled_from([1, 2, 4]), st.sampled_from([1, 3]))
def test_the_guided_filter_stays_in_range(drawn, guides, subsample, radius):
    image, _ = drawn
    guide = np.resize(guides[0], (*image.shape[:2], 4))
    good = np.isfinite(image).all(axis=-1)
    out = guided_filter(image, guide, radius=radius, subsample=subsample)
    low, high = (image[good].min(), image[good].max()) if good.any() else (0, 0)
    assert between(out, low, high)


@anything
@given(images(3, frames=3, wrong=True, negative=True), st.sampled_from([1e-30, 1e-6, 1.0, 1e6]))
def test_the_gate_is_between_nought_and_one(drawn, exposure):
    estimates, _ = drawn
    weight = color_gate(estimates, estimates[0], exposure)
    assert ((weight >= 0) & (weight <= 1)).all()
    assert (weight[1] == 1).all()


@anything
@given(images(3, frames=3), st.floats(0, 1, width=32), st.sampled_from([1e-6, 1.0, 1e6]))
def test_light_is_taken_along_without_harm(drawn, share, exposure):
    window, rng = drawn
    before, trusted = window.copy(), rng.uniform(0, 1, window.shape[:3]).astype(np.float32)
    relight(window, trusted * np.float32(share), trusted, exposure)
    assert np.isfinite(window).all()
    assert (window >= np.minimum(before, 0)).all()
    np.testing.assert_array_equal(window[1], before[1])


# --- curves


@anything
@given(images(3))
def test_curves_are_finite_and_come_back(drawn):
    image, rng = drawn
    exposure = measure_exposure(image)
    assert exposure > 0
    assert np.isfinite(exposure)
    toned = compress(image, exposure)
    assert between(toned, 0, 1)
    dim = image < 1e3 * exposure  # three of seven digits are left there
    np.testing.assert_allclose(expand(toned[dim], exposure), image[dim], rtol=2e-3, atol=1e-6 * exposure)
    albedo = rng.random(image.shape, np.float32) * rng.choice(np.float32([0, 1, 1e6]))
    np.testing.assert_allclose(remodulate(demodulate(image, albedo), albedo), image, rtol=1e-5, atol=1e-36)
