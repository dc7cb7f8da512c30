"""A 3×3 convolution of upsampled features and a skip connection without upsampling them, for inference on CPUs.

In features enlarged by repetition, the nine taps of a pixel read only four different values: taps that read the same
value are added beforehand. That leaves four ninths of the work, and nothing is enlarged or concatenated.
"""

from typing import Any, NamedTuple

import torch
from numba import njit
from numpy.typing import NDArray
from torch import Tensor
from torch.nn import functional

from loops.parallel import run_bands
from network.cpu.convolution import convolve


class UpsampleTaps(NamedTuple):
    """Weights of a convolution over upsampled features and a skip connection."""

    coarse: Tensor  # ``(4·O, C, 2, 2)``: merged taps on the features, for each of the four pixels that a feature covers
    skip: Tensor  # ``(O, D, 3, 3)``: taps on the skip connection


def merge_taps(weight: Tensor, channels: int) -> UpsampleTaps:
    """Add the taps ``(O, C + D, 3, 3)`` that read the same feature of the C upsampled channels.

    Those of an even row 2i read rows i − 1, i and i, of an odd row 2i + 1 rows i, i and i + 1; columns likewise.
    """
    kernels = [half for rows in _halves(weight[:, :channels], 2) for half in _halves(rows, 3)]
    layout = torch.channels_last
    coarse = torch.cat(kernels).contiguous(memory_format=layout)
    return UpsampleTaps(coarse, weight[:, channels:].contiguous(memory_format=layout))


def can_upsample(*layers: Tensor) -> bool:
    """Whether `convolve_upsampled` takes these layers and weights: on a CPU, all float32 or all bfloat16."""
    (dtype, *others) = {layer.dtype for layer in layers}
    return not others and dtype in (torch.float32, torch.bfloat16) and all(x.device.type == "cpu" for x in layers)


def convolve_upsampled(x: Tensor, skip: Tensor, taps: UpsampleTaps, bias: Tensor) -> Tensor:
    """Upsample ``(N, C, H, W)``, concatenate the skip ``(N, D, 2·H, 2·W)``, convolve to O channels, apply a ReLU."""
    count, channels, (height, width) = len(x), len(bias), x.shape[2:]
    parts = functional.conv2d(x, taps.coarse, padding=1).permute(0, 2, 3, 1).contiguous()
    upsampled = parts.new_empty(count, 2 * height, 2 * width, channels)
    kind = torch.int16 if x.dtype == torch.bfloat16 else torch.int32
    given = parts.view(kind).numpy().reshape(count, height + 1, width + 1, 2, 2, channels)
    result = upsampled.view(kind).numpy().reshape(count, 2 * height, width, 2, channels)
    for image, enlarged in zip(given, result, strict=True):
        run_bands(_interleave, 2 * height, image, enlarged)
    return convolve(skip, taps.skip, bias, upsampled.permute(0, 3, 1, 2))


@njit(cache=True, nogil=True)
def _interleave(first: int, last: int, parts: NDArray[Any], result: NDArray[Any]) -> None:
    """Put the four parts of the pixels beside each other."""
    _, width, _, channels = result.shape
    for y in range(first, last):
        i, row = y // 2, y % 2
        for x in range(width):
            for column in range(2):
                for c in range(channels):
                    result[y, x, column, c] = parts[i + row, x + column, row, column, c]


def _halves(weight: Tensor, axis: int) -> tuple[Tensor, Tensor]:
    """Three taps along an axis merged to two: for even pixels, and for odd pixels."""
    before, centre, after = weight.unbind(axis)
    return torch.stack([before, centre + after], axis), torch.stack([before + centre, after], axis)
