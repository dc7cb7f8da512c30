import numpy as np
import pytest

from nlm.average import average
from nlm.drift import drift_weights, pull_to_centre


def shot(rng, drift, *, frames=5, error=0.01, noise=0.1, size=96):
    """Estimates of light that grows by `drift` a frame, with errors of single pixels; the centre's samples; trust."""
    light = 0.5 + drift * (np.arange(frames) - frames // 2)
    estimates = light[:, None, None, None] + rng.normal(0, error, (frames, size, size, 3))
    noisy = 0.5 + rng.normal(0, noise, (size, size, 3))
    return estimates.astype(np.float32), noisy.astype(np.float32), np.ones((frames, size, size), np.float32)


@pytest.fixture
def rng() -> np.random.Generator:
    return np.random.default_rng(4)


def test_frames_are_weighed_by_their_error_over_all_that_they_are_off_by(rng):
    estimates, noisy, confidence = shot(rng, drift=0.02)
    weight = drift_weights(estimates, noisy, confidence, 0.5)
    # With v = 1e-4 and δ = 0.02 it is v / (v + l² δ²), and a little more for what is kept back for noise.
    for lag, expected in ((1, 1 / 5), (2, 1 / 17)):
        for t in (2 - lag, 2 + lag):
            assert expected * 0.9 < weight[t].mean() < expected * 1.4
    np.testing.assert_array_equal(weight[2], 1)
    assert weight.min() > 0


def test_the_average_is_nearer_to_the_light(rng):
    estimates, noisy, confidence = shot(rng, drift=0)
    estimates += 0.01 * np.square(np.arange(5) - 2)[:, None, None, None]  # comes and goes: what is off does not cancel
    before = np.square(average(estimates, confidence) - 0.5).mean()
    pull_to_centre(estimates, confidence, drift_weights(estimates, noisy, confidence, 0.5))
    assert np.square(average(estimates, confidence) - 0.5).mean() < before / 2


def test_light_that_stands_still_keeps_its_weight(rng):
    weight = drift_weights(*shot(rng, drift=0), 0.5)
    assert weight.mean() > 0.97
    assert weight.min() > 0.5


def test_fireflies_of_the_centre_tell_nothing(rng):
    estimates, noisy, confidence = shot(rng, drift=0)
    noisy[::16, ::16] = 1e30
    assert drift_weights(estimates, noisy, confidence, 0.5).mean() > 0.95


def test_drift_is_found_where_it_is(rng):
    estimates, noisy, confidence = shot(rng, drift=0, size=160)
    estimates[:, :64] += 0.02 * (np.arange(5) - 2)[:, None, None, None]
    weight = drift_weights(estimates, noisy, confidence, 0.5)
    assert weight[0, :24].mean() < 0.2
    assert weight[0, -24:].mean() > 0.8


def test_frames_that_nobody_trusts_tell_nothing(rng):
    estimates, noisy, confidence = shot(rng, drift=0.02)
    confidence[[0, 4]] = 0
    np.testing.assert_array_equal(drift_weights(estimates, noisy, confidence, 0.5), 1)
    estimates[:3, 40, 40] = np.nan
    assert np.isfinite(drift_weights(estimates, noisy, np.ones_like(confidence), 0.5)).all()


def test_three_frames_cannot_tell(rng):
    np.testing.assert_array_equal(drift_weights(*shot(rng, drift=0.02, frames=3), 0.5), 1)


@pytest.mark.parametrize("scale", [2.0**-40, 2.0**40])
def test_does_not_depend_on_the_unit(rng, scale):
    estimates, noisy, confidence = shot(rng, drift=0.01, size=40)
    weight = drift_weights(estimates, noisy, confidence, 0.5)
    scaled = drift_weights(estimates * np.float32(scale), noisy * np.float32(scale), confidence, 0.5 * scale)
    np.testing.assert_allclose(scaled, weight, rtol=1e-4)


@pytest.mark.parametrize("top", [8, 13])
def test_some_rows_are_weighed_as_in_the_whole_frame(rng, top):
    estimates, noisy, confidence = shot(rng, drift=0.01, size=200)
    whole = drift_weights(estimates, noisy, confidence, 0.5)
    part = drift_weights(estimates[:, top:], noisy[top:], confidence[:, top:], 0.5, first_row=top)
    np.testing.assert_array_equal(part[:, 72:], whole[:, top + 72 :])


def test_pulling_is_averaging_with_other_weights(rng):
    estimates, _, confidence = shot(rng, drift=0.1, frames=7, size=20)
    confidence *= rng.uniform(0, 1, confidence.shape).astype(np.float32)
    confidence[0, :4] = 0
    weight = rng.uniform(0.05, 1, confidence.shape).astype(np.float32)
    weight[3] = 1
    expected = average(estimates, confidence * weight)
    centre = estimates[3].copy()
    pull_to_centre(estimates, confidence, weight)
    np.testing.assert_allclose(average(estimates, confidence), expected, atol=1e-5)
    np.testing.assert_array_equal(estimates[3], centre)


@pytest.mark.parametrize(
    ("name", "arguments"),
    [
        ("window", (np.zeros((4, 8, 8, 3)), np.zeros((8, 8, 3)), np.ones((4, 8, 8)), 1.0)),
        ("noisy", (np.zeros((5, 8, 8, 3)), np.zeros((8, 9, 3)), np.ones((5, 8, 8)), 1.0)),
        ("noisy", (np.zeros((5, 8, 8, 1)), np.zeros((8, 8, 1)), np.ones((5, 8, 8)), 1.0)),
        ("exposure", (np.zeros((5, 8, 8, 3)), np.zeros((8, 8, 3)), np.ones((5, 8, 8)), 0.0)),
    ],
)
def test_arguments_are_checked(name, arguments):
    with pytest.raises(ValueError, match=name):
        drift_weights(*arguments)


def test_estimates_stay_where_the_only_trusted_frames_have_no_weight() -> None:
    """As where the centre is not finite, and its neighbours drift."""
    estimates = np.random.default_rng(3).random((5, 4, 6, 3)).astype(np.float32)
    kept, confidence, weight = estimates.copy(), np.ones((5, 4, 6), np.float32), np.zeros((5, 4, 6), np.float32)
    confidence[2], weight[2] = 0, 1
    pull_to_centre(estimates, confidence, weight)
    np.testing.assert_array_equal(estimates, kept)
