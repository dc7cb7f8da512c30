"""Operations on features at full resolution as one pass over memory, for inference on CPUs.

- The Robust Average block with one weight per channel: torch makes some forty passes over the features of all frames,
  which are far larger than any cache.
- The last convolution, to three channels: torch computes sixteen channels, and takes three times as long.
- The greatest of 2×2 features: torch also finds where each was, and takes ten times as long.
- The input in bfloat16 with the low bits of its color: torch takes four times as long.

Each pixel is read once and written once; bfloat16 is widened to float32 in between.
"""

from collections.abc import Sequence
from typing import Any

import numpy as np
import torch
from numba import njit
from numpy.typing import NDArray
from torch import Tensor
from torch.nn import functional

from loops.parallel import Floats, run_bands

_VALUES = 512  # processed together, about: the values of all frames fit the fastest cache
_UNROLLED = (3, 5, 7)  # lengths of windows that `_blend` is written for


def can_blend(x: Tensor, frames: int) -> bool:
    """Whether `blend_channels` takes these features and this length of the window."""
    supported = x.dtype in (torch.float32, torch.bfloat16) and frames in _UNROLLED
    return supported and x.device.type == "cpu" and not torch.is_autocast_enabled("cpu")


def blend_channels(
    x: Tensor, frames: int, order: Sequence[int], weight: Tensor, returned: Sequence[int], common: Tensor | None = None
) -> Tensor:
    """Run a `network.robust_average.ChannelAverage` block on ``(T·N, C, H, W)``, time first, T 3, 5 or 7.

    Frames are blended in the given order with the ``(C,)`` weight of the robust average; those in `returned` come back,
    with `common` ``(N, C, H, W)`` added and then a ReLU.
    """
    pixels = x.to(memory_format=torch.channels_last).permute(0, 2, 3, 1).contiguous()
    batch, (height, width, channels) = len(x) // frames, pixels.shape[1:]
    result = pixels.new_empty(len(returned) * batch, height, width, channels)
    added = pixels[:0] if common is None else common.permute(0, 2, 3, 1).contiguous()
    lengths = frames, len(returned), int(common is not None)
    layers = zip((pixels, result, added), lengths, strict=True)
    rows = [_bits(values).reshape(n, batch * height, width * channels) for values, n in layers]
    tiled = np.tile(weight.detach().float().numpy(), max(_VALUES // channels, 1))
    run_bands(_blend, batch * height, *rows, np.asarray(order), np.asarray(returned), tiled)
    return result.permute(0, 3, 1, 2)


def can_project(x: Tensor) -> bool:
    """Whether `convolve_to_rgb` takes these features: on a CPU, without gradients."""
    supported = x.dtype in (torch.float32, torch.bfloat16)
    return supported and x.device.type == "cpu" and not torch.is_grad_enabled()


def convolve_to_rgb(x: Tensor, weight: Tensor, bias: Tensor) -> Tensor:
    """Convolve ``(N, C, H, W)`` to three float32 channels, channels last; features beyond the borders count as 0."""
    pixels = x.to(memory_format=torch.channels_last).permute(0, 2, 3, 1).contiguous()
    count, height, width, _ = pixels.shape
    result = torch.empty(count, height, width, 3)
    taps = weight.detach().contiguous().numpy()
    for features, image in zip(_bits(pixels).reshape(count, height, -1), result.numpy(), strict=True):
        run_bands(_convolve_to_rgb, height, features, taps, bias.detach().numpy(), image)
    return result.permute(0, 3, 1, 2)


def halve(x: Tensor) -> Tensor:
    """Return the greatest of each 2×2 features ``(N, C, H, W)``, H and W even; features are at least 0."""
    if not can_project(x):
        return functional.max_pool2d(x, 2)
    pixels = x.permute(0, 2, 3, 1).contiguous()
    count, height, width, channels = pixels.shape
    result = pixels.new_empty(count, height // 2, width // 2, channels)
    # As signed integers, the bits of values of at least 0 are in the order of the values.
    source, target = (layer.view(torch.int16 if layer.itemsize == 2 else torch.int32) for layer in (pixels, result))
    rows = source.numpy().reshape(-1, width // 2, 2, channels), target.numpy().reshape(-1, width // 2, channels)
    run_bands(_halve, len(rows[1]), *rows)
    return result.permute(0, 3, 1, 2)


def with_low_bits(x: Tensor, colors: int) -> Tensor:
    """Round float32 ``(N, C, H, W)`` to bfloat16; the first channels' rounding errors become further channels."""
    if not can_project(x):
        rounded = x.to(torch.bfloat16, memory_format=torch.channels_last)
        return torch.cat([rounded, (x[:, :colors] - rounded[:, :colors]).to(rounded.dtype)], 1)
    pixels = x.permute(0, 2, 3, 1).contiguous()
    *size, channels = pixels.shape
    result = torch.empty(*size, channels + colors, dtype=torch.bfloat16)
    rows = [layer.numpy().reshape(-1, *layer.shape[2:]) for layer in (pixels, result.view(torch.uint16))]
    run_bands(_split, len(rows[0]), rows[0], rows[0].view(np.uint32), rows[1])
    return result.permute(0, 3, 1, 2)


def _bits(values: Tensor) -> NDArray[Any]:
    """The values as unsigned integers of their size."""
    return values.view(torch.uint16 if values.dtype == torch.bfloat16 else torch.uint32).numpy()


@njit(cache=True, nogil=True)
def _halve(first: int, stop: int, source: NDArray[Any], result: NDArray[Any]) -> None:
    _, width, channels = result.shape
    for y in range(first, stop):
        for x in range(width):
            for c in range(channels):
                upper = max(source[2 * y, x, 0, c], source[2 * y, x, 1, c])
                lower = max(source[2 * y + 1, x, 0, c], source[2 * y + 1, x, 1, c])
                result[y, x, c] = max(upper, lower)


@njit(nogil=True, inline="always")
def _round(bits: Any) -> Any:
    """Bits of a float32 to those of a bfloat16, ties to even."""
    return (bits + np.uint32(0x7FFF) + ((bits >> np.uint32(16)) & np.uint32(1))) >> np.uint32(16)


@njit(cache=True, nogil=True)
def _split(first: int, stop: int, source: Floats, bits: NDArray[np.uint32], result: NDArray[np.uint16]) -> None:
    _, width, channels = source.shape
    pair = np.empty(2, np.float32)
    pair_bits = pair.view(np.uint32)
    for y in range(first, stop):
        for x in range(width):
            for c in range(channels):
                result[y, x, c] = _round(bits[y, x, c])
            for c in range(result.shape[2] - channels):
                pair_bits[0] = np.uint32(result[y, x, c]) << np.uint32(16)
                pair[1] = source[y, x, c] - pair[0]
                result[y, x, channels + c] = _round(pair_bits[1])


# Rows are separate arrays: the compiler vectorises loops only over arrays that it knows to be contiguous.
@njit(nogil=True)
def _widen(bits: Any, source: Any, low: Any) -> None:
    for p in range(len(source)):
        bits[p] = np.uint32(source[p]) << low


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


@njit(nogil=True)
def _add(x: Any, y: Any) -> None:
    for p in range(len(x)):
        x[p] = max(x[p] + y[p], np.float32(0))


@njit(cache=True, nogil=True)
def _blend(
    first: int, stop: int, source: NDArray[Any], result: NDArray[Any], added: NDArray[Any], order: NDArray[Any],
    returned: NDArray[Any], share: Floats,
) -> None:  # fmt: skip
    # Input and result are bits of float32, or of bfloat16, which is the upper half of a float32.
    T, _, row = source.shape
    low = np.uint32(32 - 8 * source.itemsize)
    bits = np.zeros((T + 1, len(share)), np.uint32)
    state = bits.view(np.float32)
    others = np.empty((T, T - 1), np.intp)
    for t in range(T):
        for n in range(T - 1):
            others[t, n] = n + (n >= t)
    for y in range(first, stop):
        for start in range(0, row, len(share)):
            part = slice(start, min(start + len(share), row))
            for t in range(T):
                _widen(bits[t], source[t, y][part], low)
            for i in order:
                o = others[i]
                if T == 3:
                    _blend_two(state[i], state[o[0]], state[o[1]], share)
                elif T == 5:
                    _blend_four(state[i], state[o[0]], state[o[1]], state[o[2]], state[o[3]], share)
                else:
                    _blend_six(
                        state[i], state[o[0]], state[o[1]], state[o[2]], state[o[3]], state[o[4]], state[o[5]], share
                    )
            if len(added):
                _widen(bits[T], added[0, y][part], low)
                for n in returned:
                    _add(state[n], state[T])
            for n in range(len(returned)):
                _narrow(result[n, y][part], bits[returned[n]], low)


# Transposes a row to planes of its channels, so that sums run over adjacent pixels, each in its own order.
@njit(nogil=True)
def _spread(bits: Any, source: Any, low: Any) -> None:
    channels, width = len(bits), bits.shape[1] - 2
    for x in range(width):
        pixel = source[x * channels : (x + 1) * channels]
        for c in range(channels):
            bits[c, x + 1] = np.uint32(pixel[c]) << low


@njit(nogil=True)
def _nine(t: Any) -> Any:
    return t[0, 0], t[0, 1], t[0, 2], t[1, 0], t[1, 1], t[1, 2], t[2, 0], t[2, 1], t[2, 2]


@njit(nogil=True)
def _add_taps(red: Any, green: Any, blue: Any, above: Any, centre: Any, below: Any, taps: Any) -> None:
    r, g, b = taps
    for x in range(np.uintp(len(red))):  # unsigned: numba tests signed indices for counting from the end
        after, beyond = x + np.uintp(1), x + np.uintp(2)
        a0, a1, a2 = above[x], above[after], above[beyond]
        c0, c1, c2 = centre[x], centre[after], centre[beyond]
        b0, b1, b2 = below[x], below[after], below[beyond]
        upper, middle = r[0] * a0 + r[1] * a1 + r[2] * a2, r[3] * c0 + r[4] * c1 + r[5] * c2
        red[x] += upper + middle + (r[6] * b0 + r[7] * b1 + r[8] * b2)
        upper, middle = g[0] * a0 + g[1] * a1 + g[2] * a2, g[3] * c0 + g[4] * c1 + g[5] * c2
        green[x] += upper + middle + (g[6] * b0 + g[7] * b1 + g[8] * b2)
        upper, middle = b[0] * a0 + b[1] * a1 + b[2] * a2, b[3] * c0 + b[4] * c1 + b[5] * c2
        blue[x] += upper + middle + (b[6] * b0 + b[7] * b1 + b[8] * b2)


@njit(cache=True, nogil=True)
def _convolve_to_rgb(first: int, stop: int, source: NDArray[Any], taps: Floats, bias: Floats, image: Floats) -> None:
    height, row = source.shape
    width = image.shape[1]
    channels, low = row // width, np.uint32(32 - 8 * source.itemsize)
    # Three rows in float32, with a pixel of zeros before and after.
    bits = np.zeros((3, channels, width + 2), np.uint32)
    rows = bits.view(np.float32)
    sums = np.empty((3, width), np.float32)
    for y in range(max(first - 1, 0), first + 1):
        _spread(bits[y % 3], source[y], low)
    for y in range(first, stop):
        if y + 1 < height:
            _spread(bits[(y + 1) % 3], source[y + 1], low)
        else:
            bits[(y + 1) % 3] = 0
        above, centre, below = rows[(y - 1) % 3], rows[y % 3], rows[(y + 1) % 3]
        for color in range(3):
            sums[color] = bias[color]
        for c in range(channels):
            nine = _nine(taps[0, c]), _nine(taps[1, c]), _nine(taps[2, c])
            _add_taps(sums[0], sums[1], sums[2], above[c], centre[c], below[c], nine)
        for x in range(width):
            image[y, x, 0], image[y, x, 1], image[y, x, 2] = sums[0, x], sums[1, x], sums[2, x]
