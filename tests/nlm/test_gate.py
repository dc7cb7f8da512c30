from __future__ import annotations

import numpy as np
import pytest

from nlm.gate import SHARE, color_gate, color_gates


@pytest.fixture
def rng() -> np.random.Generator:
    return np.random.default_rng(6)


def test_matches_the_formula_in_a_flat_picture():
    estimates = np.full((3, 40, 40, 3), 1, np.float32)
    estimates[0] = 1.02
    noisy = np.full((40, 40, 3), 1.1, np.float32)
    tone = lambda x: x / (x + 1)  # noqa: E731
    q = 0.3 * (tone(1.1) - tone(1)) + 0.004
    d = tone(1.02) - tone(1)
    weight = color_gate(estimates, noisy, 1.0)
    np.testing.assert_allclose(weight[0], np.exp(-((d / q) ** 2)), rtol=1e-4)  # 1 - 1/x in float32
    np.testing.assert_array_equal(weight[1:], 1)


def test_shuts_on_moving_light_and_stays_open_on_noise(rng):
    centre = np.full((48, 48, 3), 0.5, np.float32)
    noisy = centre + rng.normal(0, 0.1, centre.shape).astype(np.float32)
    estimates = np.stack([centre] * 3) + rng.normal(0, 0.005, (3, 48, 48, 3)).astype(np.float32)
    estimates[0, :, :16] *= 0.5  # a shadow that was there before
    weight = color_gate(estimates, noisy, 0.5)
    assert weight[0, :, :10].max() < 0.01
    assert weight[0, :, 28:].min() > 0.8
    assert weight[2].min() > 0.8
    assert weight.max() <= 1


def test_stays_open_on_errors_of_single_pixels(rng):
    """The weight must not choose the frames whose errors are the centre's."""
    estimates = np.full((3, 40, 40, 3), 0.5, np.float32)
    estimates += rng.choice([-0.08, 0.08], estimates.shape)
    noisy = estimates[1] + rng.normal(0, 0.1, estimates.shape[1:]).astype(np.float32)
    # Means of 9×9 pixels differ by 0.006 in tone-mapped units, a third of the gate's scale; pixels by twice the scale.
    assert color_gate(estimates, noisy, 0.5).mean() > 0.8


def test_of_two_shares_the_greater_passes_more(rng):
    estimates = rng.uniform(0.4, 0.6, (3, 40, 40, 3)).astype(np.float32)
    noisy = estimates[1] + rng.normal(0, 0.1, estimates.shape[1:]).astype(np.float32)
    strict, mild = color_gates(estimates, noisy, 0.5, (SHARE, 1.0))
    np.testing.assert_array_equal(strict, color_gate(estimates, noisy, 0.5))
    assert (strict <= mild).all()
    assert strict[0].mean() < mild[0].mean() - 0.05


def test_does_not_depend_on_the_exposure(rng):
    estimates, noisy = rng.random((3, 20, 20, 3), np.float32), rng.random((20, 20, 3), np.float32)
    np.testing.assert_allclose(
        color_gate(estimates * 512, noisy * 512, 128.0), color_gate(estimates, noisy, 0.25), rtol=1e-6
    )


def test_hard_values_do_not_spread(rng):
    estimates = rng.uniform(0.49, 0.5, (3, 40, 40, 3)).astype(np.float32)
    noisy = rng.random((40, 40, 3), np.float32)
    clean = color_gate(estimates, noisy, 1.0)
    estimates[0, 5, 5], estimates[1, 30, 30], noisy[10, 10] = np.nan, np.inf, 1e30
    weight = color_gate(estimates, noisy, 1.0)
    assert np.isfinite(weight).all()
    assert weight[0, 5, 5] == 0
    assert weight[2, 30, 30] == 0
    far = np.s_[:, 20:25, 12:20]
    np.testing.assert_allclose(weight[far], clean[far], rtol=1e-4)
    assert np.isfinite(color_gate(np.zeros_like(estimates), np.zeros_like(noisy), 1.0)).all()


@pytest.mark.parametrize(
    ("name", "arguments"),
    [
        ("estimates", (np.zeros((2, 8, 8, 3)), np.zeros((8, 8, 3)), 1.0)),
        ("noisy", (np.zeros((3, 8, 8, 3)), np.zeros((8, 9, 3)), 1.0)),
        ("exposure", (np.zeros((3, 8, 8, 3)), np.zeros((8, 8, 3)), 0.0)),
    ],
)
def test_arguments_are_checked(name, arguments):
    with pytest.raises(ValueError, match=f"^{name}:"):
        color_gate(*arguments)


def test_a_line_between_light_that_came_and_light_that_went_is_no_way_through() -> None:
    """On it the mean difference is 0: stripes of shadow that move by half their period."""
    _, x = np.mgrid[:48, :96].astype(np.float32)
    stripes = [np.where((x + shift) % 32 < 16, 1.0, 0.3) for shift in (0, 16)]
    there, here = (np.repeat(image[..., None], 3, axis=-1).astype(np.float32) for image in stripes)
    window = np.stack([there, here, here])
    noisy = here * np.random.default_rng(0).gamma(4, 0.25, here.shape).astype(np.float32)
    weight = color_gate(window, noisy, 0.5)
    assert weight[0][:, 8:-8].max() < 0.1
    assert (weight[1] == 1).all()
    np.testing.assert_allclose(weight[2], 1)
