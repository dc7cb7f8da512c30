"""Noise of a neighbour at the pixels of the centre: its samples minus its first pass."""

from typing import NamedTuple

import numpy as np
from numba import njit

from flow.warp import locate_row
from hybrid.alignment.transfer import ALBEDO_FLOOR
from hybrid.files.frame import Array
from loops.parallel import run_bands
from nlm.cells import Axis, cell_axis
from nlm.drift import CELL, SIGMA
from nlm.pooling import RESIDUAL_LIMIT
from nlm.variance import gaussian_mean

_FLOOR = np.float32(ALBEDO_FLOOR)
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
    rows, columns = (cell_axis(length, CELL) for length in irradiance.shape[:2])
    sums = np.zeros((6, len(rows.pixels) // CELL, len(columns.pixels) // CELL), np.float32)
    run_bands(_sum_limited, sums.shape[1], *layers, np.float32(exposure), rows, columns, sums)
    kept, cut = np.split(np.stack([gaussian_mean(plane / np.float32(CELL**2), SIGMA) for plane in sums]), 2)
    lost = np.clip(-kept, np.minimum(cut, 0), np.maximum(cut, 0))
    return Limited(lost, rows, columns, np.float32(exposure)) if np.abs(lost).max() > _LOST else None


_NOTHING = Limited(np.empty((0, 0, 0), np.float32), cell_axis(1, 1), cell_axis(1, 1), np.float32(0))


@njit(nogil=True, cache=True, error_model="numpy")
def _sum_limited(
    first: int, last: int, irradiance: Array, first_pass: Array, albedo: Array, exposure: np.float32, rows: Axis,
    columns: Axis, sums: Array,
) -> None:  # fmt: skip
    """Sum over cells the limited residuals per unit of light, and the light that the limit cuts off."""
    side, residual = len(rows.pixels) // sums.shape[1], np.empty(3, np.float32)
    zero, third = np.float32(0), np.float32(3)
    for row in range(first, last):
        for y in rows.pixels[row * side : (row + 1) * side]:
            for column in range(sums.shape[2]):
                for x in columns.pixels[column * side : (column + 1) * side]:
                    level = zero
                    for c in range(3):
                        denoised = first_pass[y, x, c]
                        if albedo.size:
                            denoised /= max(albedo[y, x, c], zero) + _FLOOR
                        residual[c] = irradiance[y, x, c] - denoised
                        level += denoised
                    light = max(level / third, zero) + exposure
                    limit = RESIDUAL_LIMIT * light
                    share = limit / max(abs((residual[0] + residual[1] + residual[2]) / third), limit)
                    for c in range(3):
                        sums[c, row, column] += share * residual[c] / light
                        sums[3 + c, row, column] += (np.float32(1) - share) * residual[c] / light


@njit(nogil=True, cache=True, error_model="numpy")
def _warp_residual(
    first: int, last: int, irradiance: Array, first_pass: Array, albedo: Array, flow: Array, modulation: Array,
    first_row: int, first_column: int, limited: Limited, out: Array,
) -> None:  # fmt: skip
    """Gather the pixels of a row first, so that all else is computed for several of its values at once."""
    height, width, _ = irradiance.shape
    half, one, zero, third = np.float32(0.5), np.float32(1), np.float32(0), np.float32(3)
    lost, rows, columns, exposure = limited
    pixels, values = np.uintp(out.shape[1]), np.uintp(3 * out.shape[1])
    sources, light = np.empty((2, pixels), np.int32), np.empty(pixels, np.float32)
    layers, gathered = (irradiance, first_pass, albedo), np.empty((3, values), np.float32)
    residual, denoised, own = gathered[0], gathered[1], gathered[2]
    for y in range(first, last):
        _, x0, y0, fx, fy = locate_row(flow, y, (first_row, first_column), width, height, out.shape[1])
        for x in range(out.shape[1]):
            sources[0, x] = y0[x] + np.int32(fy[x] >= half)
            sources[1, x] = x0[x] + np.int32(fx[x] >= half)
        for n in range(3 if albedo.size else 2):
            layer, target = layers[n], gathered[n]
            for x in range(pixels):
                red, row, column = np.uintp(3) * x, np.uintp(sources[0, x]), np.uintp(sources[1, x])
                for c in range(np.uintp(3)):
                    target[red + c] = layer[row, column, c]
        if albedo.size:
            for i in range(values):
                own[i] = max(own[i], zero) + _FLOOR
                denoised[i] /= own[i]
        for i in range(values):
            residual[i] -= denoised[i]
        if lost.size:
            for x in range(pixels):
                red = np.uintp(3) * x
                light[x] = max((denoised[red] + denoised[red + 1] + denoised[red + 2]) / third, zero) + exposure
            for x in range(pixels):
                red, row, column = np.uintp(3) * x, np.uintp(sources[0, x]), np.uintp(sources[1, x])
                limit = RESIDUAL_LIMIT * light[x]
                share = limit / max(abs((residual[red] + residual[red + 1] + residual[red + 2]) / third), limit)
                above, below, down = np.uintp(rows.before[row]), np.uintp(rows.after[row]), rows.share[row]
                left, right, across = (
                    np.uintp(columns.before[column]), np.uintp(columns.after[column]), columns.share[column]
                )  # fmt: skip
                for c in range(np.uintp(3)):
                    upper = lost[c, above, left] + across * (lost[c, above, right] - lost[c, above, left])
                    lower = lost[c, below, left] + across * (lost[c, below, right] - lost[c, below, left])
                    residual[red + c] = share * residual[red + c] + light[x] * (upper + down * (lower - upper))
        result = out[y].reshape(-1)
        if albedo.size and modulation.size:
            clean = modulation[y].reshape(-1)
            for i in range(values):
                apart = (own[i] - clean[i]) / (_APART * (own[i] + clean[i]))
                result[i] = residual[i] * (one + min(apart * apart, one) * (own[i] / clean[i] - one))
        else:
            for i in range(values):
                result[i] = residual[i]
