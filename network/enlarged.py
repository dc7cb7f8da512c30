"""A 3×3 convolution of features at twice their size, and what stands beside them there. For running, on processors.

Of features that are enlarged by repeating them, the nine taps of a pixel fall on four: those that fall on the same one
are added up before. That leaves four ninths of the work, and nothing is enlarged or put side by side.
"""

from __future__ import annotations

import numpy as np
import torch
from numba import njit
from numpy.typing import NDArray
from torch import Tensor
from torch.nn import functional

from loops.cores import on_all_cores


def can_enlarge(*layers: Tensor) -> bool:
    """Whether `convolve_enlarged` takes these layers: in bfloat16 sums of taps are other than those that were trained.

    Parameters
    ----------
    *layers : Tensor
        All that it is given.

    Returns
    -------
    bool
    """
    return all(layer.dtype == torch.float32 and layer.device.type == "cpu" for layer in layers)


def convolve_enlarged(x: Tensor, skip: Tensor, weight: Tensor, bias: Tensor) -> Tensor:
    """Enlarge features, put others beside them, convolve, and apply a ReLU.

    Parameters
    ----------
    x : Tensor
        ``(N, C, H, W)``.
    skip : Tensor
        ``(N, D, 2·H, 2·W)``.
    weight, bias : Tensor
        Of the convolution: ``(O, C + D, 3, 3)``, and ``(O,)``.

    Returns
    -------
    Tensor
        ``(N, O, 2·H, 2·W)``.

    Notes
    -----
    Of an even row 2i the three taps fall on rows i − 1, i and i of x, of an odd one, 2i + 1, on i, i and i + 1; so of
    columns. That is one convolution of 2×2 taps for each of the four places in a pixel of x.
    """
    last, width = torch.channels_last, x.shape[1]
    first = weight[:, :width]
    kernels = [half for rows in _halves(first, 2) for half in _halves(rows, 3)]
    taps = torch.cat(kernels).contiguous(memory_format=last)
    parts = functional.conv2d(x, taps, padding=1).permute(0, 2, 3, 1).contiguous()
    beside = weight[:, width:].contiguous(memory_format=last)
    whole = functional.conv2d(skip, beside, bias, padding=1).permute(0, 2, 3, 1).contiguous()
    on_all_cores(_add_parts, whole.shape[0] * whole.shape[1], parts.numpy(), whole.numpy())
    return whole.permute(0, 3, 1, 2)


def _halves(weight: Tensor, axis: int) -> tuple[Tensor, Tensor]:
    """The taps along an axis as they fall on two: of even places, and of odd ones."""
    before, own, after = weight.unbind(axis)
    return torch.stack([before, own + after], axis), torch.stack([before + own, after], axis)


@njit(cache=True, nogil=True)
def _add_parts(first: int, last: int, parts: NDArray[np.float32], whole: NDArray[np.float32]) -> None:
    _, height, width, channels = whole.shape
    zero = np.float32(0)
    for row in range(first, last):
        n, y = row // height, row % height
        for x in range(width):
            given, out = parts[n, (y + 1) // 2, (x + 1) // 2], whole[n, y, x]
            start = (2 * (y % 2) + x % 2) * channels
            for c in range(channels):
                out[c] = max(out[c] + given[start + c], zero)
