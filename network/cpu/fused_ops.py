"""Operations on features at full resolution as one pass over memory, for inference on CPUs.

- The last convolution, to three channels: torch computes sixteen channels, and takes three times as long.
- The greatest of 2×2 features: torch also finds where each was, and takes ten times as long.
- The input in bfloat16 with the low bits of its color: torch takes four times as long.

Each pixel is read once and written once; bfloat16 is widened to float32 in between.
"""

from typing import Any

import numpy as np
import torch
from numba import njit
from numpy.typing import NDArray
from torch import Tensor
from torch.nn import functional

from loops.parallel import Floats, run_bands


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


def with_low_bits(x: Tensor) -> Tensor:
    """Round float32 ``(N, C, H, W)`` to bfloat16; the rounding errors of the first three become further channels."""
    if not can_project(x):
        rounded = x.to(torch.bfloat16, memory_format=torch.channels_last)
        return torch.cat([rounded, (x[:, :3] - rounded[:, :3]).to(rounded.dtype)], 1)
    pixels = x.permute(0, 2, 3, 1).contiguous()
    *size, channels = pixels.shape
    result = torch.empty(*size, channels + 3, dtype=torch.bfloat16)
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
