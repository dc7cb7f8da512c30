"""Layers that are parts of a picture, denoised so that they still add up to it."""

from __future__ import annotations

from collections.abc import Sequence

import numpy as np
from numpy.typing import NDArray

from nlm.guided import guided_filter

Floats = NDArray[np.float32]

# Of the guided filter: 9×9 pixels see the samples of a window 400 times, and what is a part of what changes slowly.
_RADIUS, _EPS = 4, 1e-2
# Added to what is divided by, of the exposure: where nothing is lit, all parts have the same share of nothing.
_EPSILON = np.float32(1e-6)
# How far a part may exceed the whole, of both, before it is none: half floats and interpolation are within that. Of its
# pixels a hundredth may, as fireflies are taken out of the whole alone.
_ABOVE, _MOST = 1e-2, 0.01
# What changes less between frames, of its mean, is not light that was sampled: a mask, a matte.
_NOISE = 0.01


def is_part(layer: Floats, mean: Floats, whole: Floats, exposure: float) -> bool:
    """Tell whether a layer is light that the whole is the sum of, with others perhaps.

    Parameters
    ----------
    layer : (H, W, C) float32
        As rendered.
    mean : (H, W, C) float32
        Over the frames of a window.
    whole : (H, W, 3) float32
        The picture as rendered.
    exposure : float
        Radiance of middle brightness.

    Returns
    -------
    bool
        Whether it has three channels, is nowhere negative, nowhere more than the whole, and noisy.
    """
    if layer.shape != whole.shape:
        return False
    slack = np.float32(_ABOVE) * (np.abs(whole) + np.float32(exposure))
    beyond = (layer > whole + slack) | (layer < -slack)
    noise, level = np.abs(layer - mean).mean(dtype=np.float64), np.abs(mean).mean(dtype=np.float64)
    return bool(beyond.mean() < _MOST and noise > _NOISE * level)


def split_light(
    parts: Sequence[Floats],
    whole: Floats,
    denoised: Floats,
    guide: Floats | None,
    *,
    exposure: float,
    moments: NDArray[np.float64] | None = None,
) -> list[Floats]:
    """Share a denoised picture out to the parts that it is the sum of.

    Parameters
    ----------
    parts : sequence of (H, W, 3) float32
        Layers of light, averaged over time as `whole` is, at least 0 but for interpolation.
    whole : (H, W, 3) float32
        The picture, averaged over time.
    denoised : (H, W, 3) float32
        The picture, denoised.
    guide : (H, W, G) float32, optional
        What steers the filter of the parts, of the denoised light and more; without, the denoised picture.
    exposure : float
        Radiance of middle brightness.
    moments : (2, G) float64, optional
        As for `nlm.guided.guided_filter`.

    Returns
    -------
    list of (H, W, 3) float32
        The parts, denoised. If they add up to `whole` they add up to `denoised`.

    Raises
    ------
    ValueError
        If shapes differ.

    Notes
    -----
    With F a guided filter and R = max(whole − Σ L, 0), what no part accounts for,

        o_k = denoised · (F(L_k) + ε) / Σ_j (F(L_j) + ε) ,

    the sum over all parts and R, if there is more of it than of what rounding leaves. A share of light is smoother than
    light, and what the denoiser knows of the picture's detail is in `denoised`.
    """
    for layer in (*parts, whole):
        if layer.shape != denoised.shape:
            raise ValueError(f"parts: expected shape {denoised.shape} like the picture's, got {layer.shape}")
    if not parts:
        return []
    rest = np.maximum(whole - np.sum(parts, axis=0, dtype=np.float32), 0)
    # Fireflies that are in the parts alone, and halves: not light that other layers have.
    others = [rest] if rest.mean() > _ABOVE * np.abs(whole).mean() else []
    layers = np.concatenate([np.maximum(layer, 0) for layer in (*parts, *others)], axis=-1)
    steered = guided_filter(
        layers,
        denoised if guide is None else guide,
        radius=_RADIUS,
        eps=_EPS,
        moments=None if guide is None else moments,
    )
    steered = np.maximum(steered, 0) + _EPSILON * np.float32(exposure)
    shares = steered.reshape(*denoised.shape[:2], -1, 3)
    total = shares.sum(axis=2)
    return [np.asarray(denoised * shares[:, :, k] / total, np.float32) for k in range(len(parts))]
