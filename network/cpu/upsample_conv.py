"""A 3×3 convolution of upsampled features and a skip connection without upsampling them, for inference on CPUs.

In features enlarged by repetition, the nine taps of a pixel read only four different values: taps that read the same
value are added beforehand. That leaves four ninths of the work, and nothing is enlarged or concatenated.
"""

from itertools import product
from typing import NamedTuple

import torch
from torch import Tensor
from torch.nn import functional

from network.cpu.convolution import convolve
from network.cpu.winograd import can_transform, convolve_transformed


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
    if can_transform(x, taps.coarse):
        parts = convolve_transformed(x, taps.coarse, None, relu=False)
    else:
        parts = functional.conv2d(x, taps.coarse, padding=1)
    parts = parts.view(count, 2, 2, channels, height + 1, width + 1)
    upsampled = x.new_empty(count, channels, 2 * height, 2 * width).to(memory_format=torch.channels_last)
    for row, column in product(range(2), range(2)):
        part = parts[:, row, column, :, row : row + height, column : column + width]
        upsampled[..., row::2, column::2] = part
    return convolve(skip, taps.skip, bias, upsampled)


def _halves(weight: Tensor, axis: int) -> tuple[Tensor, Tensor]:
    """Three taps along an axis merged to two: for even pixels, and for odd pixels."""
    before, centre, after = weight.unbind(axis)
    return torch.stack([before, centre + after], axis), torch.stack([before + centre, after], axis)
