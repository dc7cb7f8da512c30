"""A 3×3 convolution of features at twice their size, and what stands beside them there. For running, on processors.

Of features that are enlarged by repeating them, the nine taps of a pixel fall on four: those that fall on the same one
are added up before. That leaves four ninths of the work, and nothing is enlarged or put side by side.
"""

from __future__ import annotations

from typing import NamedTuple

import torch
from torch import Tensor
from torch.nn import functional

from network.cpu.convolution import convolve


class Taps(NamedTuple):
    """The weights of a convolution as they fall on features of half the size, and beside them.

    Attributes
    ----------
    coarse : Tensor
        ``(4·O, C, 2, 2)``: of each of the four places in a pixel of half the size.
    beside : Tensor
        ``(O, D, 3, 3)``.
    """

    coarse: Tensor
    beside: Tensor


def add_taps(weight: Tensor, width: int) -> Taps:
    """Add up the taps that fall on the same pixel of half the size.

    Parameters
    ----------
    weight : Tensor
        ``(O, C + D, 3, 3)``.
    width : int
        C, how many channels are enlarged.

    Returns
    -------
    Taps
        Of an even row 2i the three taps fall on rows i − 1, i and i of the features, of an odd one, 2i + 1, on i, i and
        i + 1; so of columns.
    """
    kernels = [half for rows in _halves(weight[:, :width], 2) for half in _halves(rows, 3)]
    last = torch.channels_last
    return Taps(torch.cat(kernels).contiguous(memory_format=last), weight[:, width:].contiguous(memory_format=last))


def can_enlarge(*layers: Tensor) -> bool:
    """Whether `convolve_enlarged` takes these layers.

    Parameters
    ----------
    *layers : Tensor
        All that it is given.

    Returns
    -------
    bool
    """
    (dtype, *others) = {layer.dtype for layer in layers}
    return not others and dtype in (torch.float32, torch.bfloat16) and all(x.device.type == "cpu" for x in layers)


def convolve_enlarged(x: Tensor, skip: Tensor, taps: Taps, bias: Tensor) -> Tensor:
    """Enlarge features, put others beside them, convolve, and apply a ReLU.

    Parameters
    ----------
    x : Tensor
        ``(N, C, H, W)``.
    skip : Tensor
        ``(N, D, 2·H, 2·W)``.
    taps : Taps
        From `add_taps`.
    bias : Tensor
        ``(O,)``.

    Returns
    -------
    Tensor
        ``(N, O, 2·H, 2·W)``.
    """
    count, channels, (height, width) = len(x), len(bias), x.shape[2:]
    parts = functional.conv2d(x, taps.coarse, padding=1).unflatten(1, (2, 2, channels))
    size = count, channels, 2 * height, 2 * width
    whole = torch.empty(size, dtype=x.dtype, memory_format=torch.channels_last)
    for row in range(2):
        for column in range(2):
            part = parts[:, row, column, :, row : row + height, column : column + width]
            whole[:, :, row::2, column::2] = part
    return convolve(skip, taps.beside, bias, whole)


def _halves(weight: Tensor, axis: int) -> tuple[Tensor, Tensor]:
    """The taps along an axis as they fall on two: of even places, and of odd ones."""
    before, own, after = weight.unbind(axis)
    return torch.stack([before, own + after], axis), torch.stack([before + own, after], axis)
