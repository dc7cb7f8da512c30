"""Means over cells of pixels, and their values between the cells' centres."""

from typing import NamedTuple

import numpy as np
from numba import njit
from numpy.typing import NDArray

Floats = NDArray[np.float32]
Places = NDArray[np.intp]


class Axis(NamedTuple):
    """The cells along rows or columns; incomplete ones at the end are completed by mirroring."""

    pixels: Places  # (cells · side,) the pixel that each place of a cell shows
    before: Places  # (pixels,) the cell whose centre is before a pixel
    after: Places  # (pixels,) the cell whose centre is behind it
    share: Floats  # (pixels,) of the cell behind


def cell_axis(length: int, side: int) -> Axis:
    """Divide the pixels of an axis into cells.

    Parameters
    ----------
    length : int
        Number of pixels.
    side : int
        Pixels of a cell.
    """
    cells = -(-length // side)
    pixels = np.pad(np.arange(length), (0, cells * side - length), mode="symmetric")
    position = np.clip((np.arange(length) + 0.5) / side - 0.5, 0, cells - 1)
    before = position.astype(np.intp)
    return Axis(pixels, before, np.minimum(before + 1, cells - 1), (position - before).astype(np.float32))


@njit(cache=True, nogil=True, inline="always")
def blend_rows(cells: Floats, axis: Axis, y: int, blended: Floats) -> None:
    """Write the values of planes at the height of a row of pixels.

    Parameters
    ----------
    cells : (K, rows of cells, columns of cells) float32
    axis : Axis
        Of the rows.
    y : int
        The row.
    blended : (K, columns of cells) float32
        The result.
    """
    above, below, share = axis.before[y], axis.after[y], axis.share[y]
    for k in range(cells.shape[0]):
        for column in range(cells.shape[2]):
            first = cells[k, above, column]
            blended[k, column] = first + share * (cells[k, below, column] - first)


@njit(cache=True, nogil=True, inline="always")
def blend_columns(blended: Floats, k: int, axis: Axis, x: int) -> np.float32:
    """Value of a plane at a pixel.

    Parameters
    ----------
    blended : (K, columns of cells) float32
        From `blend_rows`.
    k : int
        The plane.
    axis : Axis
        Of the columns.
    x : int
        The column.
    """
    first = blended[k, axis.before[x]]
    value: np.float32 = first + axis.share[x] * (blended[k, axis.after[x]] - first)
    return value
