"""The Robust Average block whose weights are one for each channel, as one pass over memory. For running, on processors.

Torch makes some forty passes over the features of all frames, which at full resolution are far larger than any cache;
here each pixel is read once and written once, and bfloat16 is widened on the way.
"""

from __future__ import annotations

from collections.abc import Sequence
from typing import Any

import numpy as np
import torch
from numba import njit
from numpy.typing import NDArray
from torch import Tensor

from loops.cores import on_all_cores

_VALUES = 512  # at a time, about: those of all frames fit the fastest cache
_WRITTEN_OUT = (3, 5, 7)  # frames of windows for which the average is


def can_blend(x: Tensor, frames: int) -> bool:
    """Whether `blend_channels` does this block on these features.

    Parameters
    ----------
    x : Tensor
        Features.
    frames : int
        T.

    Returns
    -------
    bool
    """
    known = x.dtype in (torch.float32, torch.bfloat16) and frames in _WRITTEN_OUT
    return known and x.device.type == "cpu" and not torch.is_autocast_enabled("cpu")


def blend_channels(x: Tensor, frames: int, order: Sequence[int], weight: Tensor, kept: Sequence[int]) -> Tensor:
    """Do what `network.blocks.ChannelAverage` does, in one pass.

    Parameters
    ----------
    x : Tensor
        ``(T·N, C, H, W)``, float32 or bfloat16, time first.
    frames : int
        T: 3, 5 or 7.
    order : sequence of int
        In which the frames are visited.
    weight : Tensor
        ``(C,)``, of the average.
    kept : sequence of int
        The frames that are asked for.

    Returns
    -------
    Tensor
        As x, of these frames.
    """
    given = x.to(memory_format=torch.channels_last).permute(0, 2, 3, 1).contiguous()
    batch, (height, width, channels) = len(x) // frames, given.shape[1:]
    result = given.new_empty(len(kept) * batch, height, width, channels)
    bits = torch.uint16 if x.dtype == torch.bfloat16 else torch.uint32
    rows = [values.view(bits).numpy().reshape(-1, batch * height, width * channels) for values in (given, result)]
    share = np.tile(weight.detach().float().numpy(), max(_VALUES // channels, 1))
    on_all_cores(_blend, batch * height, *rows, np.asarray(order), np.asarray(kept), share)
    return result.permute(0, 3, 1, 2)


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
def _blend_two(x: Any, a: Any, b: Any, share: Any) -> None:
    for p in range(len(x)):
        x[p] += share[p] * (np.float32(0.5) * (a[p] + b[p]) - x[p])


@njit(nogil=True)
def _blend_four(x: Any, a: Any, b: Any, c: Any, d: Any, share: Any) -> None:
    for p in range(len(x)):
        lower, upper = max(min(a[p], b[p]), min(c[p], d[p])), min(max(a[p], b[p]), max(c[p], d[p]))
        x[p] += share[p] * (np.float32(0.5) * (lower + upper) - x[p])


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
        x[p] += share[p] * (np.float32(0.25) * total - x[p])


@njit(cache=True, nogil=True)
def _blend(
    first: int, stop: int, given: NDArray[Any], result: NDArray[Any], order: NDArray[Any], kept: NDArray[Any],
    share: NDArray[np.float32],
) -> None:  # fmt: skip
    # Both are bits, of float32 or of bfloat16, which is the upper half of a float32.
    T, _, row = given.shape
    low = np.uint32(32 - 8 * given.itemsize)
    bits = np.zeros((T, len(share)), np.uint32)
    state = bits.view(np.float32)
    for y in range(first, stop):
        for start in range(0, row, len(share)):
            part = slice(start, min(start + len(share), row))
            for t in range(T):
                _widen(bits[t], given[t, y][part], low)
            for i in order:
                o = np.array([t for t in range(T) if t != i])
                if T == 3:
                    _blend_two(state[i], state[o[0]], state[o[1]], share)
                elif T == 5:
                    _blend_four(state[i], state[o[0]], state[o[1]], state[o[2]], state[o[3]], share)
                else:
                    _blend_six(
                        state[i], state[o[0]], state[o[1]], state[o[2]], state[o[3]], state[o[4]], state[o[5]], share
                    )
            for n in range(len(kept)):
                _narrow(result[n, y][part], bits[kept[n]], low)
