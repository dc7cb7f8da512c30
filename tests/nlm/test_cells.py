import numpy as np
import pytest

from nlm.cells import between_cells, cell_axis, cell_means


@pytest.mark.parametrize(("length", "side"), [(16, 4), (13, 4), (3, 8), (1, 2)])
def test_cells_cover_the_pixels_and_mirror_what_is_missing(length, side):
    axis = cell_axis(length, side)
    assert len(axis.pixels) == -(-length // side) * side
    np.testing.assert_array_equal(axis.pixels[:length], np.arange(length))
    assert axis.pixels.min() >= 0
    assert axis.pixels.max() < length
    if 0 < len(axis.pixels) - length <= length:
        np.testing.assert_array_equal(axis.pixels[length:], np.arange(length)[::-1][: len(axis.pixels) - length])


@pytest.mark.parametrize("shape", [(12, 20), (13, 18)])
def test_means_of_cells_are_those_of_their_pixels(shape):
    rows, columns = (cell_axis(length, 4) for length in shape)
    plane = np.random.default_rng(1).random(shape, np.float32)
    whole = plane[rows.pixels[:, None], columns.pixels]
    expected = whole.reshape(len(rows.pixels) // 4, 4, -1, 4).mean(axis=(1, 3))
    np.testing.assert_allclose(cell_means(plane, rows, columns), expected, rtol=1e-6)  # sums of 16 float32


def test_values_between_cells_are_linear_and_level_beyond_the_outermost():
    rows, columns = cell_axis(11, 4), cell_axis(20, 4)
    y, x = np.mgrid[:3, :5].astype(np.float32)
    across, down = (between_cells(4 * place + 1.5, rows, columns) for place in (x, y))
    np.testing.assert_allclose(across, np.broadcast_to(np.clip(np.arange(20), 1.5, 17.5), (11, 20)), rtol=1e-6)
    np.testing.assert_allclose(down, np.broadcast_to(np.clip(np.arange(11), 1.5, 9.5)[:, None], (11, 20)), rtol=1e-6)
