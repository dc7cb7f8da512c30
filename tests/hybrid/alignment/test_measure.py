"""Frames that repeat another, by their noise."""

from __future__ import annotations

import numpy as np
import pytest

from hybrid.alignment.measure import FEW, REPEATED, equal_noise, repeats


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
