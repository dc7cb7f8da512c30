"""Inputs of the final stage from an aligned window in one pass over memory, for inference on CPUs.

`network.robust_unet.pool_samples` and `network.robust_unet.pack_inputs` define the result; torch makes some sixty
passes over the frames for it, and copies of them that are mirrored beyond their borders. Here each pixel is read once,
where it lies, and each input of a convolution is written once.
"""

from __future__ import annotations

from collections.abc import Callable
from functools import lru_cache
from typing import Any, NamedTuple

import numpy as np
import torch
from numba import njit
from numpy.typing import NDArray
from torch import Tensor

from loops.parallel import run_bands
from network.transfer import PU_LINE, PU_LOG, PU_WHITE, pu_forward
from network.windows import FRAME_CHANNELS, SHARED_CHANNELS, STATIC_CHANNELS, PackedInputs, UNetWindow
from nlm.pooling import RESIDUAL_LIMIT

Floats = NDArray[np.float32]
Indices = NDArray[np.int64]

# The transfer curve is evaluated 21 times for a pixel of five frames: a power or a logarithm takes 14 ns, linear
# interpolation in a table 3 ns. The table has 512 entries for each power of two from 2^-20, below which the curve is a
# line, to 2^16: as exact as the functions in float32. The upper bits of a float32 are the index of its entry.
_LEAST, _GREATEST, _LOW_BITS = np.float32(2.0**-20), np.float32(2.0**16), np.uint32(14)
_FIRST, _LAST = (int(value.view(np.uint32) >> _LOW_BITS) for value in (_LEAST, _GREATEST))
_A, _WHITE = np.float32(PU_LINE), np.float32(PU_WHITE)
_E, _F, _G = map(np.float32, PU_LOG)


class _Source(NamedTuple):
    """Layers of one window, channels last; guides that are missing have no rows."""

    first_pass: Floats
    residual: Floats
    confidence: Floats
    modulation: Floats
    albedo: Floats
    normal: Floats


class _Target(NamedTuple):
    """Rows of the inputs of all windows, channels last."""

    frames: Floats
    shared: Floats
    static: Floats
    average: Floats


def can_pack(window: UNetWindow) -> bool:
    """Whether `packer` takes a window: all of its layers float32 on a CPU."""
    layers = [layer for layer in window if layer is not None]
    return all(layer.dtype == torch.float32 and layer.device.type == "cpu" for layer in layers)


def packer(window: UNetWindow, columns: Indices) -> Callable[[Indices], PackedInputs]:
    """Make a function that packs rows of a window: it maps h row numbers to inputs of h×w pixels.

    `columns` has the column of the window for each column of the inputs; layers whose channels are not last are copied.
    """
    layers = [_pixels(layer) for layer in (window.first_pass, window.residual, window.confidence, window.modulation)]
    batch, count = layers[0].shape[:2]
    missing = np.empty((batch, 0, 0, 3), np.float32)
    layers += [missing if guide is None else _pixels(guide) for guide in (window.albedo, window.normal)]
    scales = np.stack([window.exposure.numpy(), window.gain.numpy()], axis=1)

    def pack(rows: Indices) -> PackedInputs:
        size = len(rows), len(columns)
        frames = np.empty((count, batch, *size, FRAME_CHANNELS), np.float32)
        channels = SHARED_CHANNELS, STATIC_CHANNELS, 3
        shared, static, average = (np.empty((batch, *size, depth), np.float32) for depth in channels)
        for n in range(batch):
            source = _Source(*(layer[n] for layer in layers))
            target = _Target(frames[:, n], shared[n], static[n], average[n])
            run_bands(_pack, size[0], source, scales[n], rows, columns, target, _curve())
        flat = frames.reshape(count * batch, *size, FRAME_CHANNELS)
        return PackedInputs(
            *(torch.from_numpy(pixels).permute(0, 3, 1, 2) for pixels in (flat, shared, static, average))
        )

    return pack


def _pixels(layer: Tensor) -> Floats:
    """A layer with its channels last, copied only where they are not."""
    return layer.movedim(-3, -1).contiguous().numpy()


@lru_cache(maxsize=1)
def _curve() -> Floats:
    """Table of the transfer curve: value at each entry, and difference to the next entry, (K, 2)."""
    places = (np.arange(_FIRST, _LAST + 1, dtype=np.uint32) << _LOW_BITS).view(np.float32)
    values = pu_forward(torch.from_numpy(places.astype(np.float64))).numpy()
    return np.stack([values[:-1], np.diff(values)], axis=1).astype(np.float32)


@njit(cache=True, nogil=True)
def _on_curve(y: Any, curve: Any, value: Any, bits: Any) -> Any:
    """Evaluate the transfer curve; `value` and `bits` are views of the same four bytes of scratch memory."""
    if y < _LEAST:
        return _A * y / _WHITE
    if not y < _GREATEST:
        return (_E * np.log(y + _F) + _G) / _WHITE
    value[0] = y
    entry = np.int64(bits[0] >> _LOW_BITS) - _FIRST
    fraction = np.float32(np.int32(bits[0] & np.uint32(2**14 - 1))) * np.float32(2.0**-14)
    return curve[entry, 0] + fraction * curve[entry, 1]


@njit(cache=True, nogil=True)
def _pack(
    first: int, last: int, source: _Source, scales: Floats, rows: Indices, columns: Indices, target: _Target,
    curve: Floats,
) -> None:  # fmt: skip
    first_pass, residual, confidence, modulation, albedo, normal = source
    frames, shared, static, average = target
    exposure, gain = scales[0], scales[1]
    T, zero, one, half = len(first_pass), np.float32(0), np.float32(1), np.float32(0.5)
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
                    level += first_pass[t, row, column, c]
                    excess += residual[t, row, column, c]
                limit = RESIDUAL_LIMIT * (max(level / np.float32(3), zero) + exposure)
                kept = limit / max(abs(excess / np.float32(3)), limit)
                for c in range(3):
                    held[t, c] = residual[t, row, column, c] * kept
            samples = one / squares / np.float32(T)
            guides = shared[y, x]
            for c in range(3):
                guides[c] = min(max(albedo[row, column, c], zero), one) if len(albedo) else half
                guides[3 + c] = min(max(normal[row, column, c], -one), one) * half + half if len(normal) else half
            for c in range(3):
                light, noisy_light = zero, zero
                for t in range(T):
                    light += share[t] * first_pass[t, row, column, c]
                    noisy_light += share[t] * (first_pass[t, row, column, c] + held[t, c])
                average[y, x, c] = light
                scale = modulation[row, column, c] * gain
                centre_noise, mean = held[centre, c], zero
                for t in range(T):
                    linear = max((light + centre_noise + trust[t] * (held[t, c] - centre_noise)) * scale, zero)
                    encoded = _on_curve(linear, curve, value, bits)
                    frames[t, y, x, c] = encoded
                    mean += encoded
                pooled = _on_curve(max(noisy_light * scale, zero), curve, value, bits)
                shift = pooled - mean / np.float32(T)
                for t in range(T):
                    frames[t, y, x, c] += shift
                static[y, x, c] = pooled
                shared[y, x, 6 + c] = _on_curve(max(light * scale, zero), curve, value, bits)
            for c in range(6):
                static[y, x, 3 + c] = guides[c]
            shared[y, x, 9] = samples
            for t in range(T):
                frames[t, y, x, 3] = trust[t]
