"""Feature channels of the kernel-predicting networks, for training and for running."""

from typing import NamedTuple

import torch
from torch import Tensor

CHANNELS = 10  # channels of a frame: color, albedo, normal, confidence (the paper's)


class KernelWindow(NamedTuple):
    """An aligned window of T frames, float32, finite."""

    color: Tensor  # ``(N, T, 3, H, W)`` irradiance, side frames mixed with the centre where they are not trusted
    confidence: Tensor  # ``(N, T, 1, H, W)`` in [0, 1]
    # ``(N,)``, positive: brightness of each window as a whole, proportional to its radiance. It belongs to whole
    # frames, never to tiles: tiles of different exposure would show their seams.
    exposure: Tensor
    # ``(N, T, 3, H, W)``, albedo in [0, 1] mostly, normals in any fixed space
    albedo: Tensor | None = None
    normal: Tensor | None = None


def network_inputs(window: KernelWindow) -> Tensor:
    """``(N, T, 10, H, W)``: ``log1p(color / exposure)``, ``log1p(albedo)``, normal, confidence; 0 for missing guides.

    The logarithm keeps a firefly of 1e6 at 14; negative radiance (bicubic warping makes some) counts as zero here,
    though not in the frames that kernels are applied to.
    """
    color, confidence, exposure, albedo, normal = window
    n, t, _, h, w = color.shape
    scale = exposure.reciprocal().view(n, 1, 1, 1, 1)
    missing = color.new_zeros(()).expand(n, t, 3, h, w)
    # In place: these are passes over memory.
    channels = [
        (color * scale).clamp_min_(0).log1p_(),
        missing if albedo is None else albedo.clamp_min(0).log1p_(),
        missing if normal is None else normal,
        confidence,
    ]
    return torch.cat(channels, 2)
