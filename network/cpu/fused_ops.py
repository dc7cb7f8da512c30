"""What torch makes slowly of features at full resolution, as one pass over memory. For running, on processors.

- The Robust Average block whose weights are one for each channel: torch makes some forty passes over the features of
  all frames, which are far larger than any cache.
- The last convolution, to the three channels of a picture: torch computes sixteen, and takes three times as long.

Here each pixel is read once and written once, and bfloat16 is widened on the way.
"""

from __future__ import annotations

from collections.abc import Sequence
from typing import Any

import numpy as np
import torch
from numba import njit
from numpy.typing import NDArray
from torch import Tensor

from loops.parallel import run_bands

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
    """Do what `network.paper.blocks.ChannelAverage` does, in one pass.

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
    rows = [_bits(values).reshape(-1, batch * height, width * channels) for values in (given, result)]
    share = np.tile(weight.detach().float().numpy(), max(_VALUES // channels, 1))
    run_bands(_blend, batch * height, *rows, np.asarray(order), np.asarray(kept), share)
    return result.permute(0, 3, 1, 2)


def can_end(x: Tensor) -> bool:
    """Whether `convolve_to_picture` takes these features: on a processor, without gradients."""
    known = x.dtype in (torch.float32, torch.bfloat16)
    return known and x.device.type == "cpu" and not torch.is_grad_enabled()


def convolve_to_picture(x: Tensor, weight: Tensor, bias: Tensor) -> Tensor:
    """Convolve features to a picture, in float32.

    Parameters
    ----------
    x : Tensor
        ``(N, C, H, W)``, float32 or bfloat16.
    weight, bias : Tensor
        ``(3, C, 3, 3)`` and ``(3,)``, float32.

    Returns
    -------
    Tensor
        ``(N, 3, H, W)`` float32, channels last; features beyond the borders count as 0.
    """
    given = x.to(memory_format=torch.channels_last).permute(0, 2, 3, 1).contiguous()
    count, height, width, _ = given.shape
    result = torch.empty(count, height, width, 3)
    taps = weight.detach().contiguous().numpy()
    for features, picture in zip(_bits(given).reshape(count, height, -1), result.numpy(), strict=True):
        run_bands(_convolve_to_picture, height, features, taps, bias.detach().numpy(), picture)
    return result.permute(0, 3, 1, 2)


def _bits(values: Tensor) -> NDArray[Any]:
    return values.view(torch.uint16 if values.dtype == torch.bfloat16 else torch.uint32).numpy()


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


# Every channel of a row comes to lie by itself, so that the sums run over pixels side by side, each in its own order.
@njit(nogil=True)
def _spread(bits: Any, given: Any, low: Any) -> None:
    channels, width = len(bits), bits.shape[1] - 2
    for x in range(width):
        pixel = given[x * channels : (x + 1) * channels]
        for c in range(channels):
            bits[c, x + 1] = np.uint32(pixel[c]) << low


@njit(nogil=True)
def _add_taps(sums: Any, above: Any, own: Any, below: Any, taps: Any) -> None:
    a0, a1, a2, o0, o1, o2, b0, b1, b2 = taps
    for x in range(np.uintp(len(sums))):  # unsigned: of a signed index numba asks whether it counts from the end
        after, beyond = x + np.uintp(1), x + np.uintp(2)
        upper = a0 * above[x] + a1 * above[after] + a2 * above[beyond]
        middle = o0 * own[x] + o1 * own[after] + o2 * own[beyond]
        sums[x] += upper + middle + (b0 * below[x] + b1 * below[after] + b2 * below[beyond])


@njit(cache=True, nogil=True)
def _convolve_to_picture(
    first: int, stop: int, given: NDArray[Any], taps: NDArray[np.float32], bias: NDArray[np.float32],
    picture: NDArray[np.float32],
) -> None:  # fmt: skip
    height, row = given.shape
    width = picture.shape[1]
    channels, low = row // width, np.uint32(32 - 8 * given.itemsize)
    # Three rows at a time, widened, with a pixel of nothing before and after.
    bits = np.zeros((3, channels, width + 2), np.uint32)
    rows = bits.view(np.float32)
    sums = np.empty((3, width), np.float32)
    for y in range(max(first - 1, 0), first + 1):
        _spread(bits[y % 3], given[y], low)
    for y in range(first, stop):
        if y + 1 < height:
            _spread(bits[(y + 1) % 3], given[y + 1], low)
        else:
            bits[(y + 1) % 3] = 0
        above, own, below = rows[(y - 1) % 3], rows[y % 3], rows[(y + 1) % 3]
        for color in range(3):
            sums[color] = bias[color]
            for c in range(channels):
                t = taps[color, c]
                nine = t[0, 0], t[0, 1], t[0, 2], t[1, 0], t[1, 1], t[1, 2], t[2, 0], t[2, 1], t[2, 2]
                _add_taps(sums[color], above[c], own[c], below[c], nine)
        for x in range(width):
            picture[y, x, 0], picture[y, x, 1], picture[y, x, 2] = sums[0, x], sums[1, x], sums[2, x]
