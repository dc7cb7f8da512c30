"""Means over cells of pixels, and their values between the cells' centres."""

from typing import NamedTuple

import cv2
import numpy as np

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


def cell_means(plane: Floats, rows: Axis, columns: Axis) -> Floats:
    """Means of a plane (H, W) over cells."""
    size = columns.after[-1] + 1, rows.after[-1] + 1
    if plane.shape != (len(rows.pixels), len(columns.pixels)):
        plane = plane[rows.pixels[:, None], columns.pixels]
    return np.asarray(cv2.resize(plane, size, interpolation=cv2.INTER_AREA), np.float32)


def between_cells(cells: Floats, rows: Axis, columns: Axis) -> Floats:
    """Values of cells (rows, columns) at all pixels: (H, W)."""
    size = len(columns.pixels), len(rows.pixels)
    whole = cv2.resize(cells, size, interpolation=cv2.INTER_LINEAR)
    return np.asarray(whole[: len(rows.share), : len(columns.share)], np.float32)
