"""Noise of a neighbour at the pixels of the centre: its samples minus its first pass."""

from __future__ import annotations

import numpy as np
from numba import njit
from numpy.typing import NDArray

from flow.warp import locate
from hybrid.alignment.transfer import ALBEDO_FLOOR
from loops.parallel import run_bands

Array = NDArray[np.float32]

_FLOOR = np.float32(ALBEDO_FLOOR)


def warp_residual(
    irradiance: Array,
    first_pass: Array,
    albedo: Array | None,
    flow: Array | None,
    start: tuple[int, int],
    out: Array,
) -> None:
    """Write irradiance − first pass of a frame, warped to the nearest pixel.

    Parameters
    ----------
    irradiance : (H, W, 3) array
    first_pass : (H, W, 3) array
        Radiance.
    albedo : (H, W, 3) array or None
        Divides the first pass (`hybrid.alignment.transfer.demodulate`); None where irradiance is radiance.
    flow : (h, w, 2) array or None
        From a part of the centre to the frame, pixels; None for no motion.
    start : (int, int)
        The first row and column of that part.
    out : (h, w, 3) array
        The result, contiguous.
    """
    absent = np.empty((0, 0, 0), np.float32)
    given = irradiance, first_pass, albedo, flow
    layers = [absent if layer is None else np.ascontiguousarray(layer, np.float32) for layer in given]
    run_bands(_warp_residual, len(out), *layers, *start, out)


@njit(nogil=True, cache=True, error_model="numpy")
def _warp_residual(
    first: int, last: int, irradiance: Array, first_pass: Array, albedo: Array, flow: Array, first_row: int,
    first_column: int, out: Array,
) -> None:  # fmt: skip
    height, width, channels = irradiance.shape
    half, zero = np.float32(0.5), np.float32(0)
    for y in range(first, last):
        for x in range(out.shape[1]):
            row, column = np.uintp(first_row + y), np.uintp(first_column + x)
            if flow.size:
                across, down = np.float32(first_column + x) + flow[y, x, 0], np.float32(first_row + y) + flow[y, x, 1]
                place = locate(across, down, width, height)
                row = np.uintp(place.y1 if place.fy >= half else place.y0)
                column = np.uintp(place.x1 if place.fx >= half else place.x0)
            for c in range(channels):
                light = first_pass[row, column, c]
                if albedo.size:
                    light /= max(albedo[row, column, c], zero) + _FLOOR
                out[y, x, c] = irradiance[row, column, c] - light
