"""Means over cells, and the values between them."""

from __future__ import annotations

import numpy as np
import pytest

from nlm.cells import blend_columns, blend_rows, cell_axis


@pytest.mark.parametrize(("length", "side"), [(16, 4), (13, 4), (3, 8), (1, 2)])
def test_cells_cover_the_pixels_and_mirror_what_is_missing(length, side):
    axis = cell_axis(length, side)
    assert len(axis.pixels) == -(-length // side) * side
    np.testing.assert_array_equal(axis.pixels[:length], np.arange(length))
    assert axis.pixels.min() >= 0
    assert axis.pixels.max() < length
    if 0 < len(axis.pixels) - length <= length:
        np.testing.assert_array_equal(axis.pixels[length:], np.arange(length)[::-1][: len(axis.pixels) - length])


def test_values_between_cells_are_linear_and_level_beyond_the_outermost():
    rows, columns = cell_axis(12, 4), cell_axis(20, 4)
    y, x = np.mgrid[:3, :5].astype(np.float32)
    planes, blended = np.stack([4 * x + 1.5, 4 * y + 1.5]), np.empty((2, 5), np.float32)
    found = np.empty((2, 12, 20), np.float32)
    for row in range(12):
        blend_rows(planes, rows, row, blended)
        for column in range(20):
            for k in range(2):
                found[k, row, column] = blend_columns(blended, k, columns, column)
    np.testing.assert_allclose(found[0], np.broadcast_to(np.clip(np.arange(20), 1.5, 17.5), (12, 20)), rtol=1e-6)
    np.testing.assert_allclose(
        found[1], np.broadcast_to(np.clip(np.arange(12), 1.5, 9.5)[:, None], (12, 20)), rtol=1e-6
    )
