"""Noise of a neighbour at the pixels of the centre: its samples minus its first pass."""

from typing import Any, NamedTuple

import numpy as np
from numba import njit

from flow.warp import locate
from hybrid.alignment.transfer import ALBEDO_FLOOR
from hybrid.files.frame import Array
from loops.parallel import run_bands
from nlm.cells import Axis, cell_axis
from nlm.pooling import RESIDUAL_LIMIT
from nlm.variance import gaussian_mean

_FLOOR = np.float32(ALBEDO_FLOOR)
# Light that the limit of residuals takes is spread over a Gaussian of this deviation, pixels, in cells of so many: the
# light of a few bright samples. Means over half or twice as many pixels give the same pictures within 0.1 dB.
_SIGMA, _SIDE = 16.0, 8
# Difference of two albedos over their sum from which on their quotient says nothing. With 0.4 one shot behind a lens
# loses 0.3 dB at 512 samples, with 1 another gains 0.1 less at 8.
_APART = np.float32(0.7)
# Less than this share of the light is no loss that anybody sees.
_LOST = 1e-3


class Limited(NamedTuple):
    """The light that `nlm.pooling.RESIDUAL_LIMIT` takes from the residuals of a frame."""

    lost: Array  # (3, rows of cells, columns of cells): per unit of light, the first pass plus `exposure`
    rows: Axis
    columns: Axis
    exposure: np.float32


def warp_residual(
    irradiance: Array,
    first_pass: Array,
    albedo: Array | None,
    flow: Array | None,
    start: tuple[int, int],
    out: Array,
    limited: Limited | None = None,
    modulation: Array | None = None,
) -> None:
    """Write irradiance − first pass of a frame (H, W, 3), warped to the nearest pixel, into contiguous `out` (h, w, 3).

    The first pass is radiance; `albedo` divides it (`hybrid.alignment.transfer.demodulate`), None where irradiance is
    radiance. The flow (h, w, 2), pixels, leads from a part of the centre, whose first row and column are `start`, to
    the frame; None: no motion. With `limited` from `measure_limited` residuals are limited, and the light that this
    takes is added.

    Noise that color and albedo share cancels in their quotient while it is small. Where it is large, as in glass and
    behind lenses, residuals over a frame's own albedo a, plus floor, are far from 0 in the mean. With `modulation` (h,
    w, 3), m, radiance of an irradiance of 1 at the centre, they are multiplied by 1 + x² (a / m − 1), with
    x = |a − m| / (0.7 (a + m)), at most 1: then they are the residuals of the radiance.
    """
    absent = np.empty((0, 0, 0), np.float32)
    given = irradiance, first_pass, albedo, flow, modulation
    layers = [absent if layer is None else np.ascontiguousarray(layer, np.float32) for layer in given]
    run_bands(_warp_residual, len(out), *layers, *start, limited or _NOTHING, out)


def measure_limited(irradiance: Array, first_pass: Array, albedo: Array | None, exposure: float) -> Limited | None:
    """Measure the light that the limit of residuals takes from a frame; None where it takes next to nothing.

    The limit cuts bright samples alone, so that what is left is too dark: by 14 % in a room at 8 samples. Arrays are
    those of `warp_residual`, the exposure that of the irradiance.

    With r the residual, r' the limited one (`nlm.pooling.pool_samples`), l the first pass plus exposure and K a
    Gaussian mean, the light lost is −K[r' / l], which is 0 for a first pass that is right in the mean, but between 0
    and K[(r − r') / l]: no more than was cut, however wrong the first pass, and however bright one sample.
    """
    absent = np.empty((0, 0, 0), np.float32)
    layers = [absent if layer is None else np.ascontiguousarray(layer) for layer in (irradiance, first_pass, albedo)]
    rows, columns = (cell_axis(length, _SIDE) for length in irradiance.shape[:2])
    sums = np.zeros((6, len(rows.pixels) // _SIDE, len(columns.pixels) // _SIDE), np.float32)
    run_bands(_sum_limited, sums.shape[1], *layers, np.float32(exposure), rows, columns, sums)
    kept, cut = np.split(np.stack([gaussian_mean(plane / np.float32(_SIDE**2), _SIGMA / _SIDE) for plane in sums]), 2)
    lost = np.clip(-kept, np.minimum(cut, 0), np.maximum(cut, 0))
    return Limited(lost, rows, columns, np.float32(exposure)) if np.abs(lost).max() > _LOST else None


_NOTHING = Limited(np.empty((0, 0, 0), np.float32), cell_axis(1, 1), cell_axis(1, 1), np.float32(0))


@njit(nogil=True, inline="always")
def _limit(residual: Any, light: Any) -> Any:
    """Factor that limits a residual to `RESIDUAL_LIMIT` times the light, in the mean over channels."""
    limit = RESIDUAL_LIMIT * light
    return limit / max(abs((residual[0] + residual[1] + residual[2]) / np.float32(3)), limit)


@njit(nogil=True, inline="always")
def _difference(irradiance: Any, first_pass: Any, albedo: Any, row: Any, column: Any, residual: Any) -> Any:
    """Write irradiance − first pass of a pixel; return the first pass, in the mean over channels and at least 0."""
    level, zero = np.float32(0), np.float32(0)
    for c in range(3):
        light = first_pass[row, column, c]
        if albedo.size:
            light /= max(albedo[row, column, c], zero) + _FLOOR
        residual[c] = irradiance[row, column, c] - light
        level += light
    return max(level / np.float32(3), zero)


@njit(nogil=True, cache=True, error_model="numpy")
def _sum_limited(
    first: int, last: int, irradiance: Array, first_pass: Array, albedo: Array, exposure: np.float32, rows: Axis,
    columns: Axis, sums: Array,
) -> None:  # fmt: skip
    """Sum over cells the limited residuals per unit of light, and what the limit cuts off."""
    side, residual = len(rows.pixels) // sums.shape[1], np.empty(3, np.float32)
    for row in range(first, last):
        for y in rows.pixels[row * side : (row + 1) * side]:
            for column in range(sums.shape[2]):
                for x in columns.pixels[column * side : (column + 1) * side]:
                    light = _difference(irradiance, first_pass, albedo, y, x, residual) + exposure
                    share = _limit(residual, light)
                    for c in range(3):
                        sums[c, row, column] += share * residual[c] / light
                        sums[3 + c, row, column] += (np.float32(1) - share) * residual[c] / light


@njit(nogil=True, cache=True, error_model="numpy")
def _warp_residual(
    first: int, last: int, irradiance: Array, first_pass: Array, albedo: Array, flow: Array, modulation: Array,
    first_row: int, first_column: int, limited: Limited, out: Array,
) -> None:  # fmt: skip
    height, width, _ = irradiance.shape
    half, residual = np.float32(0.5), np.empty(3, np.float32)
    lost, rows, columns, exposure = limited
    for y in range(first, last):
        for x in range(out.shape[1]):
            row, column = np.uintp(first_row + y), np.uintp(first_column + x)
            if flow.size:
                across, down = np.float32(first_column + x) + flow[y, x, 0], np.float32(first_row + y) + flow[y, x, 1]
                place = locate(across, down, width, height)
                row = np.uintp(place.y1 if place.fy >= half else place.y0)
                column = np.uintp(place.x1 if place.fx >= half else place.x0)
            light = _difference(irradiance, first_pass, albedo, row, column, residual) + exposure
            if lost.size:
                share = _limit(residual, light)
                for c in range(3):
                    upper = _between(lost[c, rows.before[row]], columns, column)
                    lower = _between(lost[c, rows.after[row]], columns, column)
                    residual[c] = share * residual[c] + light * (upper + rows.share[row] * (lower - upper))
            for c in range(3):
                if albedo.size and modulation.size:
                    own, clean = max(albedo[row, column, c], np.float32(0)) + _FLOOR, modulation[y, x, c]
                    apart = (own - clean) / (_APART * (own + clean))
                    residual[c] *= np.float32(1) + min(apart * apart, np.float32(1)) * (own / clean - np.float32(1))
                out[y, x, c] = residual[c]


@njit(nogil=True, inline="always")
def _between(cells: Any, columns: Any, x: Any) -> Any:
    """Value between the centres of a row's cells."""
    first = cells[columns.before[x]]
    return first + columns.share[x] * (cells[columns.after[x]] - first)
