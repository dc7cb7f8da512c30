"""What enters the final stage of a window, as one pass over memory. For running, on processors.

`network.robust_unet.realise` says what it is; torch makes some sixty passes over the frames for it, and copies of
them that are mirrored beyond their borders. Here each pixel is read once, where it lies, and what a convolution takes
is written once.
"""

from __future__ import annotations

from collections.abc import Callable, Mapping
from functools import lru_cache
from typing import Any

import numpy as np
import torch
from numba import njit
from numpy.typing import NDArray
from torch import Tensor

from loops.parallel import run_bands
from network import unet as trunk

#: As in `nlm.pooling`: what a frame shows beyond its estimate counts up to so many times its light and the exposure.
RESIDUAL_LIMIT = 6.0
#: Channels of each frame: its picture, and confidence. Of all alike: the centre's albedo and normal, the gathered
#: average, samples gathered.
OWN, ALIKE = 4, 10
_LIMIT = np.float32(RESIDUAL_LIMIT)
# The transfer curve (`network.unet.pu_forward`), which a pixel of five frames asks for 21 times: 14 ns for a power or
# a logarithm, 3 ns for a line between two entries of a table. Of each power of two from 2^-20, below which it is one
# line, to 2^16 there are 512: as exact as the functions in float32. The upper bits of a float32 say which it is.
_LEAST, _GREATEST, _LOW_BITS = np.float32(2.0**-20), np.float32(2.0**16), np.uint32(14)
_FIRST, _LAST = (int(value.view(np.uint32) >> _LOW_BITS) for value in (_LEAST, _GREATEST))
_, _, _A, _, _, _, _E, _F, _G, _WHITE = map(np.float32, trunk.PU_CURVE)


def can_lay_out(*layers: Tensor) -> bool:
    """Whether `entering` takes a window of these layers.

    Parameters
    ----------
    *layers : Tensor
        All that it is given.

    Returns
    -------
    bool
    """
    return all(layer.dtype == torch.float32 and layer.device.type == "cpu" for layer in layers)


def entering(
    window: Mapping[str, Tensor], albedo: Tensor | None, normal: Tensor | None, columns: NDArray[np.int64]
) -> Callable[[NDArray[np.int64]], tuple[Tensor, Tensor, Tensor, Tensor]]:
    """Make what lays out some rows of what enters the network.

    Parameters
    ----------
    window : mapping of str to Tensor
        As `network.robust_unet.realise` takes it, float32; copied where the channels are not last.
    albedo, normal : Tensor, optional
        ``(N, 3, H, W)``: the centre's guides.
    columns : (w,) array of int
        Which column of the window stands in each column of the picture.

    Returns
    -------
    callable
        From the rows of the window that stand in h rows of the picture to four layers:

        - the frames, ``(T·N, 4, h, w)``, time first: `OWN`;
        - what they have alike, ``(N, 10, h, w)``: `ALIKE`;
        - ``(N, 9, h, w)``, the gathered picture, and albedo and normal of the centre in [0, 1];
        - the average of the estimates, irradiance, ``(N, 3, h, w)``.
    """
    layers = [_pixels(window[name]) for name in ("estimate", "residual", "confidence", "modulation")]
    batch, count = layers[0].shape[:2]
    nothing = np.empty((batch, 0, 0, 3), np.float32)
    layers += [nothing if guide is None else _pixels(guide) for guide in (albedo, normal)]
    exposure, gain = (window[name].numpy() for name in ("exposure", "gain"))

    def lay_out(rows: NDArray[np.int64]) -> tuple[Tensor, Tensor, Tensor, Tensor]:
        size = len(rows), len(columns)
        frames = np.empty((count, batch, *size, OWN), np.float32)
        alike, still, average = (np.empty((batch, *size, channels), np.float32) for channels in (ALIKE, 9, 3))
        for n in range(batch):
            given = *(layer[n] for layer in layers), exposure[n], gain[n], rows, columns
            run_bands(_enter, size[0], n, *given, frames, alike, still, average, _curve())
        own = frames.reshape(count * batch, *size, OWN)
        return _planes(own), _planes(alike), _planes(still), _planes(average)

    return lay_out


def _pixels(layer: Tensor) -> NDArray[np.float32]:
    """A layer with its channels last, copied only where it lies otherwise."""
    return layer.movedim(-3, -1).contiguous().numpy()


def _planes(pixels: NDArray[np.float32]) -> Tensor:
    return torch.from_numpy(pixels).permute(0, 3, 1, 2)


@lru_cache(maxsize=1)
def _curve() -> NDArray[np.float32]:
    """The transfer curve at each entry, and how far the next one is from it, (K, 2)."""
    places = (np.arange(_FIRST, _LAST + 1, dtype=np.uint32) << _LOW_BITS).view(np.float32)
    values = trunk.pu_forward(torch.from_numpy(places.astype(np.float64))).numpy()
    return np.stack([values[:-1], np.diff(values)], axis=1).astype(np.float32)


@njit(cache=True, nogil=True)
def _on_curve(y: Any, curve: Any, value: Any, bits: Any) -> Any:
    # The last two are one place in memory.
    if y < _LEAST:
        return _A * y / _WHITE
    if not y < _GREATEST:
        return (_E * np.log(y + _F) + _G) / _WHITE
    value[0] = y
    entry = np.int64(bits[0] >> _LOW_BITS) - _FIRST
    beyond = np.float32(np.int32(bits[0] & np.uint32(2**14 - 1))) * np.float32(2.0**-14)
    return curve[entry, 0] + beyond * curve[entry, 1]


@njit(cache=True, nogil=True)
def _enter(
    first: int, last: int, n: int, estimates: NDArray[np.float32], residuals: NDArray[np.float32],
    confidence: NDArray[np.float32], modulation: NDArray[np.float32], albedo: NDArray[np.float32],
    normal: NDArray[np.float32], exposure: np.float32, gain: np.float32, rows: NDArray[np.int64],
    columns: NDArray[np.int64], frames: NDArray[np.float32], alike: NDArray[np.float32],
    still: NDArray[np.float32], average: NDArray[np.float32], curve: NDArray[np.float32],
) -> None:  # fmt: skip
    T, zero, one, half = len(estimates), np.float32(0), np.float32(1), np.float32(0.5)
    centre = T // 2
    trust, share, held = np.empty(T, np.float32), np.empty(T, np.float32), np.empty((T, 3), np.float32)
    value = np.empty(1, np.float32)
    bits = value.view(np.uint32)
    for y in range(first, last):
        row = rows[y]
        for x in range(len(columns)):
            column = columns[x]
            total = zero
            for t in range(T):
                trust[t] = confidence[t, row, column, 0]
                total += trust[t]
            if not total > 0:
                trust[:] = zero
                trust[centre] = total = one
            squares = zero
            for t in range(T):
                share[t] = trust[t] / total
                squares += share[t] * share[t]
                level, excess = zero, zero
                for c in range(3):
                    level += estimates[t, row, column, c]
                    excess += residuals[t, row, column, c]
                limit = _LIMIT * (max(level / np.float32(3), zero) + exposure)
                kept = limit / max(abs(excess / np.float32(3)), limit)
                for c in range(3):
                    held[t, c] = residuals[t, row, column, c] * kept
            samples = one / squares / np.float32(T)
            guides = alike[n, y, x]
            for c in range(3):
                guides[c] = min(max(albedo[row, column, c], zero), one) if len(albedo) else half
                guides[3 + c] = min(max(normal[row, column, c], -one), one) * half + half if len(normal) else half
            for c in range(3):
                light, noise = zero, zero
                for t in range(T):
                    light += share[t] * estimates[t, row, column, c]
                    noise += share[t] * (estimates[t, row, column, c] + held[t, c])
                average[n, y, x, c] = light
                scale = modulation[row, column, c] * gain
                own, mean = held[centre, c], zero
                for t in range(T):
                    linear = max((light + own + trust[t] * (held[t, c] - own)) * scale, zero)
                    shown = _on_curve(linear, curve, value, bits)
                    frames[t, n, y, x, c] = shown
                    mean += shown
                picture = _on_curve(max(noise * scale, zero), curve, value, bits)
                shift = picture - mean / np.float32(T)
                for t in range(T):
                    frames[t, n, y, x, c] += shift
                still[n, y, x, c] = picture
                alike[n, y, x, 6 + c] = _on_curve(max(light * scale, zero), curve, value, bits)
            for c in range(6):
                still[n, y, x, 3 + c] = guides[c]
            alike[n, y, x, 9] = samples
            for t in range(T):
                frames[t, n, y, x, 3] = trust[t]
