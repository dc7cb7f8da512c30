"""Frames that repeat another, by their noise."""

from __future__ import annotations

from dataclasses import replace

import numpy as np
import pytest

from hybrid.alignment.measure import FEW, FIXED_NOISE_ABOVE, REPEATED, equal_noise, fixed_noise, repeats
from hybrid.alignment.prepare import prepare
from hybrid.files.frame import Frame


@pytest.mark.parametrize("changed", [0.0, 0.005, 0.009, 0.02, 0.05, 1.0])
@pytest.mark.parametrize("top", [False, True])
def test_strips_find_what_the_whole_picture_shows(changed, top):
    rng = np.random.default_rng(0)
    here = rng.gamma(1, 1, (200, 50, 3)).astype(np.float32)
    there, count = here.copy(), round(changed * 200)
    rows = slice(0, count) if top else slice(200 - count, 200)
    there[rows] = rng.gamma(1, 1, there[rows].shape)
    grainy, equal = (np.count_nonzero(part) for part in equal_noise(here, there))
    expected = grainy >= FEW and equal >= REPEATED * grainy
    assert repeats(here, there) == expected
    assert expected == (changed < 0.01)


def test_pictures_without_noise_repeat_nothing():
    assert not repeats(np.ones((70, 20, 3), np.float32), np.ones((70, 20, 3), np.float32))


@pytest.mark.parametrize("half", [True, False])
@pytest.mark.parametrize("noise", [0.0005, 0.001, 0.003])
def test_noise_of_a_thousandth_is_not_taken_for_the_noise_of_one_seed(noise, half):
    """Every second sample lay within 0.1 % of its neighbour's: still shots next to convergence lost their window."""
    rng = np.random.default_rng(1)
    detail = rng.uniform(0.2, 0.8, (96, 128, 3))

    def frame(number, grain):
        color = (detail * grain).astype(np.float16 if half else np.float32)
        return prepare(Frame(number=number, color=color.astype(np.float32)))

    grains = rng.normal(1, noise, (2, 96, 128, 1))
    assert abs(fixed_noise(frame(1, grains[0]), frame(2, grains[1]), moves=False)) < 0.6 * FIXED_NOISE_ABOVE
    assert fixed_noise(frame(1, grains[0]), frame(2, grains[0]), moves=False) == pytest.approx(1, abs=0.01)


@pytest.mark.parametrize("lit", [0.1, 0.5])
def test_pixels_that_one_sample_hits_or_misses_have_no_fixed_noise(lit):
    """Most pixels were equal by chance: black, or with the whole light of a lamp."""
    rng = np.random.default_rng(4)
    hits = (rng.random((2, 96, 128, 1)) < lit) * np.ones(3, np.float32) / lit
    first, second = (prepare(Frame(number=n, color=hit)) for n, hit in enumerate(hits))
    assert abs(fixed_noise(first, second, moves=False)) < 0.3 * FIXED_NOISE_ABOVE
    light = rng.uniform(0.5, 1, (2, 96, 128, 1)).astype(np.float32)
    first, second = (prepare(Frame(number=n, color=hit)) for n, hit in enumerate(hits * light))
    again = replace(first, number=2)
    assert abs(fixed_noise(first, second, moves=False)) < 0.3 * FIXED_NOISE_ABOVE
    assert fixed_noise(first, again, moves=False) == pytest.approx(1, abs=0.01)
    grainy, equal = equal_noise(first.irradiance, second.irradiance)
    assert grainy.any()
    assert not equal.any()
    assert repeats(first.irradiance, again.irradiance)
