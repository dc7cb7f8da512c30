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


def adds_up(parts: Sequence[Floats], whole: Floats, factors: Sequence[Floats | None]) -> bool:
    """Tell whether layers as rendered are all of the whole's light.

    Parameters
    ----------
    parts : sequence of (H, W, 3) float32
        Layers of light.
    whole : (H, W, 3) float32
        The picture; fireflies may have been taken out of it.
    factors : sequence of (H, W, 3) float32 or None
        What each part is multiplied by before they are added; None: 1.

    Returns
    -------
    bool
        Whether a hundredth of the light at most is in none of them.
    """
    return _found(_rest(parts, whole, factors), whole)


def split_light(
    parts: Sequence[Floats],
    whole: Floats | None,
    denoised: Floats,
    guide: Floats | None,
    *,
    exposure: float,
    moments: NDArray[np.float64] | None = None,
    factors: Sequence[Floats | None] | None = None,
) -> list[Floats]:
    """Share a denoised picture out to the parts that it is the sum of.

    Parameters
    ----------
    parts : sequence of (H, W, 3) float32
        Layers of light, averaged over time as `whole` is, at least 0 but for interpolation.
    whole : (H, W, 3) float32 or None
        The picture, averaged over time; None where it is known to have no other light (`adds_up`).
    denoised : (H, W, 3) float32
        The picture, denoised.
    guide : (H, W, G) float32, optional
        What steers the filter of the parts, of the denoised light and more; without, the denoised picture.
    exposure : float
        Radiance of middle brightness.
    moments : (2, G) float64, optional
        As for `nlm.guided.guided_filter`.
    factors : sequence of (H, W, 3) float32 or None, optional
        What each part is multiplied by before they are added, at least 0; None: 1.

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
    With F a guided filter, c the factors and R = max(whole − Σ c L, 0), what no part accounts for,

        o_k = denoised · (F(L_k) + ε) / Σ_j c_j (F(L_j) + ε) ,

    the sum over all parts and R, if there is more of it than of what rounding leaves. A share of light is smoother than
    light, and what the denoiser knows of the picture's detail is in `denoised`.
    """
    if not parts:
        return []
    steered, total = _filter_parts(
        parts, whole, denoised, guide, factors, moments, least=_EPSILON * np.float32(exposure)
    )
    # Where every factor is 0 no part can hold any light.
    ratio = np.divide(denoised, total, out=np.zeros_like(total), where=total > 0)
    return [np.asarray(ratio * part, np.float32) for part in steered]


def add_light(
    parts: Sequence[Floats],
    whole: Floats | None,
    denoised: Floats,
    guide: Floats | None,
    *,
    moments: NDArray[np.float64] | None = None,
    factors: Sequence[Floats | None] | None = None,
) -> tuple[list[Floats], Floats]:
    """Denoise the parts of a picture each by itself, and add them up.

    Parameters
    ----------
    parts : sequence of (H, W, 3) float32
        As for `split_light`.
    whole : (H, W, 3) float32 or None
        The same.
    denoised : (H, W, 3) float32
        The picture, denoised; no more is taken of it than what steers the filter.
    guide : (H, W, G) float32, optional
        As for `split_light`.
    moments : (2, G) float64, optional
        The same.
    factors : sequence of (H, W, 3) float32 or None, optional
        The same.

    Returns
    -------
    parts : list of (H, W, 3) float32
        F(L_k).
    picture : (H, W, 3) float32
        Σ c F(L), and F(R) if there is such.

    Raises
    ------
    ValueError
        If shapes differ.
    """
    if not parts:
        return [], denoised
    return _filter_parts(parts, whole, denoised, guide, factors, moments, least=np.float32(0))


def _filter_parts(
    parts: Sequence[Floats],
    whole: Floats | None,
    denoised: Floats,
    guide: Floats | None,
    factors: Sequence[Floats | None] | None,
    moments: NDArray[np.float64] | None,
    *,
    least: np.float32,
) -> tuple[list[Floats], Floats]:
    """The parts filtered, `least` or more, and their sum with what is in none of them."""
    for layer in (*parts, *([] if whole is None else [whole])):
        if layer.shape != denoised.shape:
            raise ValueError(f"parts: expected shape {denoised.shape} like the picture's, got {layer.shape}")
    factors = factors or [None] * len(parts)
    others = []
    if whole is not None and not _found(rest := _rest(parts, whole, factors), whole):
        others.append(rest)
    layers = np.concatenate([np.maximum(layer, 0) for layer in (*parts, *others)], axis=-1)
    steered = guided_filter(
        layers,
        denoised if guide is None else guide,
        radius=_RADIUS,
        eps=_EPS,
        moments=None if guide is None else moments,
    )
    steered = np.maximum(steered, 0) + least
    filtered = [np.ascontiguousarray(steered[..., 3 * k : 3 * k + 3]) for k in range(len(parts) + len(others))]
    total = np.zeros_like(denoised)
    for layer, factor in zip(filtered, [*factors, *(None for _ in others)], strict=True):
        total += layer if factor is None else factor * layer
    return filtered[: len(parts)], total


def _rest(parts: Sequence[Floats], whole: Floats, factors: Sequence[Floats | None]) -> Floats:
    """The light that is in no part."""
    rest = whole.copy()
    for layer, factor in zip(parts, factors, strict=True):
        rest -= layer if factor is None else factor * layer
    return np.maximum(rest, 0)


def _found(rest: Floats, whole: Floats) -> bool:
    """Whether what is left is no more than fireflies that are in the parts alone, and the rounding of halves."""
    return bool(rest.mean() <= _ABOVE * np.abs(whole).mean())
