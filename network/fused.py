"""The Robust Average block whose convolutions are 1×1, as one pass over memory. For running, on processors.

Torch makes some forty passes over the features of all frames, which at full resolution are far larger than any cache;
here each pixel is read once and written once, and bfloat16 is widened on the way.
"""

from __future__ import annotations

from collections.abc import Sequence
from typing import Any, cast

import numpy as np
import torch
from numba import njit
from numpy.typing import NDArray
from torch import Tensor, nn

from loops.cores import on_all_cores

#: Width between the convolutions: a constant, so that what is done for all of them becomes one instruction.
HIDDEN = 16
_PIXELS = 64  # at a time: all their features fit the fastest cache
_VALUES = 512  # likewise, where the weight is the same in all pixels
_ALIKE = (5, 7)  # frames of windows for which that is done by itself
_MOST = 15  # frames of a window, as a network may have (`network.checkpoint.BOUNDS`)


def can_blend(x: Tensor, on_frame: nn.Conv2d, frames: int) -> bool:
    """Whether `blend_pixels` does this block on these features.

    Parameters
    ----------
    x : Tensor
        Features.
    on_frame : Conv2d
        The block's first convolution.
    frames : int
        T.

    Returns
    -------
    bool
    """
    small = on_frame.kernel_size == (1, 1) and on_frame.out_channels == HIDDEN and 3 <= frames <= _MOST
    same = x.dtype == on_frame.weight.dtype and x.dtype in (torch.float32, torch.bfloat16)
    return small and same and x.device.type == "cpu" and not torch.is_autocast_enabled("cpu")


def blend_pixels(
    x: Tensor,
    frames: int,
    order: Sequence[int],
    on_frame: nn.Conv2d,
    on_average: nn.Conv2d,
    weight: nn.Conv2d,
    kept: Sequence[int],
) -> Tensor:
    """Do what `network.blocks.RobustAverage` does, in one pass.

    Parameters
    ----------
    x : Tensor
        ``(T·N, C, H, W)``, float32 or bfloat16, time first.
    frames : int
        T, 3 or more.
    order : sequence of int
        In which the frames are visited.
    on_frame, on_average, weight : Conv2d
        1×1, `HIDDEN` channels between them.
    kept : sequence of int
        The frames that are asked for.

    Returns
    -------
    Tensor
        As x, of these frames.
    """
    given = x.to(memory_format=torch.channels_last).permute(0, 2, 3, 1).contiguous()
    parameters = [layer.weight.float().flatten(1).t().contiguous().numpy() for layer in (on_frame, on_average)]
    bias = cast(Tensor, on_frame.bias).float().numpy()
    last = np.append(weight.weight.float().flatten().numpy(), cast(Tensor, weight.bias).float().numpy())
    batch, (height, width, channels) = len(x) // frames, given.shape[1:]
    result = given.new_empty(len(kept) * batch, height, width, channels)
    arguments = np.asarray(order), np.asarray(kept), *parameters, bias, last
    bits = torch.uint16 if x.dtype == torch.bfloat16 else torch.uint32
    images = [values.view(bits).numpy().reshape(-1, batch * height, width, channels) for values in (given, result)]
    if frames not in _ALIKE or last[:HIDDEN].any():
        on_all_cores(_blend, batch * height, *images, *arguments)
    else:  # before any training the weight is the same in all pixels, and no value depends on another
        rows = (image.reshape(len(image), batch * height, -1) for image in images)
        on_all_cores(_blend_alike, batch * height, *rows, *arguments[:2], 1 / (1 + np.exp(-last[HIDDEN])))
    return result.permute(0, 3, 1, 2)


@njit(nogil=True)
def _blend_pixels(
    state: Any, order: Any, on_frame: Any, on_average: Any, bias: Any, last: Any, average: Any, hidden: Any, share: Any
) -> None:
    # Pixels lie innermost, so that each step is the same instruction on many of them.
    T, C, P = state.shape
    for i in order:
        first, second = (1, 2) if i == 0 else ((0, 2) if i == 1 else (0, 1))
        for k in range(HIDDEN):
            hidden[k] = bias[k]
        for c in range(C):
            mean, low, high = average[c], share[0], share[1]
            for p in range(P):
                low[p] = min(state[first, c, p], state[second, c, p])
                high[p] = max(state[first, c, p], state[second, c, p])
                mean[p] = 0
            for t in range(second + 1, T):
                if t != i:
                    # The middle of (low, next, high) can no longer be extreme: it joins the sum (see `ravg`).
                    for p in range(P):
                        value = state[t, c, p]
                        mean[p] += max(low[p], min(value, high[p]))
                        low[p] = min(low[p], value)
                        high[p] = max(high[p], value)
            for p in range(P):
                mean[p] = mean[p] / np.float32(T - 3) if T > 3 else np.float32(0.5) * (low[p] + high[p])
            for k in range(HIDDEN):
                of_frame, of_average = on_frame[c, k], on_average[c, k]
                for p in range(P):
                    hidden[k, p] += state[i, c, p] * of_frame + mean[p] * of_average
        share[0] = last[HIDDEN]
        for k in range(HIDDEN):
            for p in range(P):
                share[0, p] += max(hidden[k, p], np.float32(0)) * last[k]
        for p in range(P):
            share[0, p] = np.float32(1) / (np.float32(1) + np.exp(-share[0, p]))
        for c in range(C):
            for p in range(P):
                state[i, c, p] += share[0, p] * (average[c, p] - state[i, c, p])


@njit(cache=True, nogil=True)
def _blend(
    first: int, stop: int, given: NDArray[Any], result: NDArray[Any], order: NDArray[Any], kept: NDArray[Any],
    on_frame: NDArray[Any], on_average: NDArray[Any], bias: NDArray[Any], last: NDArray[Any],
) -> None:  # fmt: skip
    # Both are bits, of float32 or of bfloat16, which is the upper half of a float32.
    T, _, W, C = given.shape
    low = np.uint32(32 - 8 * given.itemsize)
    bits, average = np.empty((T, C, _PIXELS), np.uint32), np.empty((C, _PIXELS), np.float32)
    state = bits.view(np.float32)
    hidden, share = np.empty((HIDDEN, _PIXELS), np.float32), np.empty((2, _PIXELS), np.float32)
    for y in range(first, stop):
        for start in range(0, W, _PIXELS):
            count = min(_PIXELS, W - start)
            for t in range(T):
                for p in range(_PIXELS):
                    x = start + min(p, count - 1)
                    for c in range(C):
                        bits[t, c, p] = np.uint32(given[t, y, x, c]) << low
            _blend_pixels(state, order, on_frame, on_average, bias, last, average, hidden, share)
            for n in range(len(kept)):
                for p in range(count):
                    for c in range(C):
                        value = bits[kept[n], c, p]
                        if low:
                            value += np.uint32(0x7FFF) + ((value >> low) & np.uint32(1))  # ties to even
                        result[n, y, start + p, c] = value >> low


# Rows of values come as arrays of their own: of others the compiler does not know that they lie side by side, and takes
# one after the other.
@njit(nogil=True)
def _widen(bits: Any, given: Any, low: Any) -> None:
    for p in range(len(given)):
        bits[p] = np.uint32(given[p]) << low


@njit(nogil=True)
def _narrow(result: Any, bits: Any, low: Any) -> None:
    for p in range(len(result)):
        value = bits[p]
        if low:
            value += np.uint32(0x7FFF) + ((value >> low) & np.uint32(1))  # ties to even
        result[p] = value >> low


@njit(nogil=True)
def _blend_four(x: Any, a: Any, b: Any, c: Any, d: Any, share: Any) -> None:
    for p in range(len(x)):
        lower, upper = max(min(a[p], b[p]), min(c[p], d[p])), min(max(a[p], b[p]), max(c[p], d[p]))
        x[p] += share * (np.float32(0.5) * (lower + upper) - x[p])


@njit(nogil=True)
def _blend_six(x: Any, a: Any, b: Any, c: Any, d: Any, e: Any, f: Any, share: Any) -> None:
    for p in range(len(x)):
        low, high = min(a[p], b[p]), max(a[p], b[p])
        total = max(low, min(c[p], high))
        low, high = min(low, c[p]), max(high, c[p])
        total += max(low, min(d[p], high))
        low, high = min(low, d[p]), max(high, d[p])
        total += max(low, min(e[p], high))
        low, high = min(low, e[p]), max(high, e[p])
        total += max(low, min(f[p], high))
        x[p] += share * (np.float32(0.25) * total - x[p])


@njit(cache=True, nogil=True)
def _blend_alike(
    first: int, stop: int, given: NDArray[Any], result: NDArray[Any], order: NDArray[Any], kept: NDArray[Any],
    share: np.float32,
) -> None:  # fmt: skip
    T, _, row = given.shape
    low = np.uint32(32 - 8 * given.itemsize)
    bits = np.zeros((T, _VALUES), np.uint32)
    state = bits.view(np.float32)
    for y in range(first, stop):
        for start in range(0, row, _VALUES):
            part = slice(start, min(start + _VALUES, row))
            for t in range(T):
                _widen(bits[t], given[t, y][part], low)
            for i in order:
                o = np.array([t for t in range(T) if t != i])
                if T == 5:
                    _blend_four(state[i], state[o[0]], state[o[1]], state[o[2]], state[o[3]], share)
                else:
                    _blend_six(
                        state[i], state[o[0]], state[o[1]], state[o[2]], state[o[3]], state[o[4]], state[o[5]], share
                    )
            for n in range(len(kept)):
                _narrow(result[n, y][part], bits[kept[n]], low)
