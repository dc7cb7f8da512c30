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
    rows = [_bits(values).reshape(-1, batch * height, width * channels) for values in (given, result)]
    share = np.tile(weight.detach().float().numpy(), max(_VALUES // channels, 1))
    on_all_cores(_blend, batch * height, *rows, np.asarray(order), np.asarray(kept), share)
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
    count, height, width, channels = given.shape
    result = torch.empty(count, height, width, 3)
    # Of each row of the kernel and each color the taps as they lie along a row of features.
    taps = weight.detach().permute(2, 0, 3, 1).reshape(3, 3, 3 * channels).contiguous().numpy()
    for features, picture in zip(_bits(given).reshape(count, height, -1), result.numpy(), strict=True):
        on_all_cores(_convolve_to_picture, height, features, taps, bias.detach().numpy(), picture)
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


# Sums may be taken in any order, which is what vectors need.
@njit(cache=True, nogil=True, error_model="numpy", fastmath={"reassoc", "contract"})
def _convolve_to_picture(
    first: int, stop: int, given: NDArray[Any], taps: NDArray[np.float32], bias: NDArray[np.float32],
    picture: NDArray[np.float32],
) -> None:  # fmt: skip
    height, row = given.shape
    width = picture.shape[1]
    channels, low = row // width, np.uint32(32 - 8 * given.itemsize)
    # Three rows at a time, widened, with a pixel of nothing before and after.
    bits = np.zeros((3, row + 2 * channels), np.uint32)
    rows = bits.view(np.float32)
    # Of each color the taps on the row above, the own and the one below: vectors need rows that are known to be whole.
    ra, ro, rb = taps[0, 0], taps[1, 0], taps[2, 0]
    ga, go, gb = taps[0, 1], taps[1, 1], taps[2, 1]
    ba, bo, bb = taps[0, 2], taps[1, 2], taps[2, 2]
    for y in range(max(first - 1, 0), first + 1):
        _widen(bits[y % 3][channels : channels + row], given[y], low)
    for y in range(first, stop):
        following = bits[(y + 1) % 3]
        if y + 1 < height:
            _widen(following[channels : channels + row], given[y + 1], low)
        else:
            following[:] = 0
        above, own, below = rows[(y - 1) % 3], rows[y % 3], rows[(y + 1) % 3]
        for x in range(width):
            # Unsigned: of a signed index numba asks each time whether it counts from the end.
            start = np.uintp(x) * np.uintp(channels)
            red, green, blue = bias[0], bias[1], bias[2]
            for k in range(np.uintp(3 * channels)):
                a, o, b = above[start + k], own[start + k], below[start + k]
                red += a * ra[k] + o * ro[k] + b * rb[k]
                green += a * ga[k] + o * go[k] + b * gb[k]
                blue += a * ba[k] + o * bo[k] + b * bb[k]
            picture[y, x, 0], picture[y, x, 1], picture[y, x, 2] = red, green, blue
