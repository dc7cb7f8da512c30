"""Noise of a neighbour at the pixels of the centre."""

from __future__ import annotations

import numpy as np
import pytest

from flow.warp import warp
from hybrid.alignment.residual import warp_residual
from hybrid.alignment.transfer import demodulate


@pytest.mark.parametrize("moves", [False, True])
@pytest.mark.parametrize("divided", [False, True])
def test_the_difference_is_moved_by_whole_pixels(moves, divided):
    rng = np.random.default_rng(0)
    irradiance, first_pass, albedo = rng.random((3, 20, 30, 3), np.float32)
    flow, rows = rng.normal(0, 4, (20, 30, 2)).astype(np.float32), slice(3, 17)
    difference = irradiance - (demodulate(first_pass, albedo) if divided else first_pass)
    expected = warp(difference, flow[rows], interpolation="nearest", first_row=rows.start)[0]
    found = np.empty((14, 30, 3), np.float32)
    given = irradiance, first_pass, albedo if divided else None, flow[rows] if moves else None
    warp_residual(*given, (rows.start, 0), found)
    np.testing.assert_array_equal(found, expected if moves else difference[rows])
