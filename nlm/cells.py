"""Means over cells of pixels, and their values between the cells' centres."""

from typing import NamedTuple

import numpy as np
from numba import njit

from loops.parallel import Floats, Places


class Axis(NamedTuple):
    """The cells along rows or columns; incomplete ones at the end are completed by mirroring."""

    pixels: Places  # (cells · side,) the pixel that each place of a cell shows
    before: Places  # (pixels,) the cell whose centre is before a pixel
    after: Places  # (pixels,) the cell whose centre is behind it
    share: Floats  # (pixels,) of the cell behind


def cell_axis(length: int, side: int) -> Axis:
    """Divide the pixels of an axis of this length into cells of `side` pixels."""
    cells = -(-length // side)
    pixels = np.pad(np.arange(length), (0, cells * side - length), mode="symmetric")
    position = np.clip((np.arange(length) + 0.5) / side - 0.5, 0, cells - 1)
    before = position.astype(np.intp)
    return Axis(pixels, before, np.minimum(before + 1, cells - 1), (position - before).astype(np.float32))


@njit(cache=True, nogil=True, inline="always")
def blend_rows(cells: Floats, axis: Axis, y: int, blended: Floats) -> None:
    """Write the values of cells (K, rows, columns) at the height of a row `y` of pixels into `blended` (K, columns)."""
    above, below, share = axis.before[y], axis.after[y], axis.share[y]
    for k in range(cells.shape[0]):
        for column in range(cells.shape[2]):
            first = cells[k, above, column]
            blended[k, column] = first + share * (cells[k, below, column] - first)


@njit(cache=True, nogil=True, inline="always")
def blend_columns(blended: Floats, k: int, axis: Axis, x: int) -> np.float32:
    """Value of plane `k` at a pixel `x` of the columns' axis, from `blend_rows`."""
    first = blended[k, axis.before[x]]
    value: np.float32 = first + axis.share[x] * (blended[k, axis.after[x]] - first)
    return value
