"""What the network sees: the one place where a window becomes feature channels, for training and for running."""

from __future__ import annotations

import torch
from torch import Tensor

#: Channels of a frame: color, albedo, normal, confidence (the paper's).
CHANNELS = 10


def network_inputs(
    color: Tensor,
    albedo: Tensor | None,
    normal: Tensor | None,
    confidence: Tensor,
    exposure: Tensor,
) -> Tensor:
    """Feature channels of each frame of an aligned window.

    Parameters
    ----------
    color : Tensor
        ``(N, T, 3, H, W)`` aligned irradiance.
    albedo, normal : Tensor, optional
        ``(N, T, 3, H, W)``, albedo in [0, 1] mostly, normals in any fixed space. Zeros where missing.
    confidence : Tensor
        ``(N, T, 1, H, W)`` in [0, 1].
    exposure : Tensor
        ``(N,)``, positive: the brightness of each window as a whole, proportional to its radiance. Of whole frames and
        never of tiles: tiles of different exposure would show their seams.

    Returns
    -------
    Tensor
        ``(N, T, 10, H, W)``: ``log1p(color / exposure)``, ``log1p(albedo)``, normal, confidence.

    Raises
    ------
    ValueError
        If a shape does not fit color's.

    Notes
    -----
    The logarithm keeps a firefly of 1e6 at 14; negative radiance (bicubic warping makes some) counts as zero
    here, though not in what the kernels are applied to.
    """
    n, t, _, h, w = color.shape
    for name, value, depth in (("albedo", albedo, 3), ("normal", normal, 3), ("confidence", confidence, 1)):
        if value is not None and value.shape != (n, t, depth, h, w):
            raise ValueError(f"{name}: expected shape {(n, t, depth, h, w)}, got {tuple(value.shape)}")
    if exposure.shape != (n,):
        raise ValueError(f"exposure: expected shape {(n,)}, got {tuple(exposure.shape)}")
    scale = exposure.reciprocal().view(n, 1, 1, 1, 1)
    missing = color.new_zeros(()).expand(n, t, 3, h, w)
    # In place, as these are passes over memory and nothing else.
    channels = [
        (color * scale).clamp_min_(0).log1p_(),
        missing if albedo is None else albedo.clamp_min(0).log1p_(),
        missing if normal is None else normal,
        confidence,
    ]
    return torch.cat(channels, 2)
