"""Layers that are parts of a picture: found by adding up the noisy pixels, and denoised so that they still add up."""

from __future__ import annotations

from collections.abc import Sequence

import cv2
import numpy as np
from numpy.typing import NDArray

from nlm.guided import guided_filter

Floats = NDArray[np.float32]

# Of the guided filter: 9×9 pixels see the samples of a window 400 times, and what is a part of what changes slowly.
_RADIUS, _EPS = 4, 1e-2
# Added to what is divided by, of the exposure: where nothing is lit, all parts have the same share of nothing.
_EPSILON = np.float32(1e-6)
# A sum may differ from the whole by this share of both and of the exposure: half floats round by 5e-4 for each part
# and its color. Of the values a twentieth may differ by more: saturated halves, and pixels that are not finite.
_NEAR, _MOST = 5e-3, 0.05
# Subsets that are looked at, and values of a frame that each is compared on.
_SUBSETS, _VALUES = 20_000, 1_500
# A layer has noise where the median of its second differences, in patches of 9×9 pixels, exceeds this share of its
# mean; so it does in this share of its patches. Edges of masks fill no patch.
_NOISE, _PATCHES = 0.01, 0.02
# Albedo below which there is no color to speak of.
_DARK = 0.01
# How often what was bounded is shared out again to the other parts.
_ROUNDS = 3


def sums_to(parts: Sequence[Floats], whole: Floats, exposure: float) -> bool:
    """Tell whether layers add up to a picture, pixel by pixel.

    Parameters
    ----------
    parts : sequence of (..., C) float32
        Layers as rendered, each multiplied by its color where it is written without.
    whole : (..., C) float32
        The picture as rendered.
    exposure : float
        Radiance of middle brightness.

    Returns
    -------
    bool
        Whether 95 % of all values are within 0.5 % of each other.
    """
    total = np.zeros_like(whole)
    for part in parts:
        total += part
    with np.errstate(invalid="ignore"):  # infinities of saturated halves
        near = np.abs(total - whole) <= np.float32(_NEAR) * (np.abs(whole) + np.float32(exposure))
    return few_differ(float(1 - near.mean()))


def few_differ(share: float) -> bool:
    """Tell whether so few values differ, as a share in [0, 1], that a sum is still one: saturated halves, fireflies."""
    return share <= _MOST


def share_outside(part: Floats, whole: Floats, exposure: float) -> float:
    """Give the share of values in which a layer is negative or above the picture.

    Parameters
    ----------
    part, whole : (..., C) float32
        As rendered.
    exposure : float
        Radiance of middle brightness.

    Returns
    -------
    float
        In [0, 1].
    """
    slack = np.float32(_NEAR) * (np.abs(whole) + np.float32(exposure))
    return float(1 - ((part <= whole + slack) & (part >= -slack)).mean())


def shares_noise(part: Floats, whole: Floats) -> bool:
    """Tell whether a layer's noise is in a picture: its second differences are found in the picture's as they are.

    Parameters
    ----------
    part, whole : (H, W, 3) float32
        As rendered, finite.

    Returns
    -------
    bool
        Whether the slope of the regression is a half or more: it is 1 for a part, and 0 for other light.
    """
    of_part, of_whole = (_second_differences(layer).astype(np.float64) for layer in (part, whole))
    # Of the median's order alone: one bright sample has no vote of its own.
    most = 10 * np.median(np.abs(of_part)) or np.inf
    of_part, of_whole = (np.clip(found, -most, most) for found in (of_part, of_whole))
    power = float(np.mean(of_part**2))
    return power > 0 and float(np.mean(of_part * of_whole)) >= 0.5 * power


def is_noisy(layer: Floats) -> bool:
    """Tell whether a layer has noise anywhere: textures count as noise, edges do not.

    Parameters
    ----------
    layer : (H, W, C) float32
        As rendered, finite.
    """
    level = float(np.abs(layer).mean(dtype=np.float64))
    response = np.abs(_second_differences(layer)).max(axis=-1)
    height, width = response.shape
    rows, columns = max(height // 9, 1), max(width // 9, 1)
    patches = [
        np.median(block)
        for band in np.array_split(response, rows, axis=0)
        for block in np.array_split(band, columns, axis=1)
    ]
    return level > 0 and float(np.mean(np.asarray(patches) > _NOISE * level)) > _PATCHES


def is_textured(layer: Floats, albedo: Floats) -> bool:
    """Tell whether a layer was multiplied by the surfaces' color: its detail is that of the color.

    Parameters
    ----------
    layer : (H, W, C) float32
        As rendered, finite.
    albedo : (H, W, 3) float32
        In [0, 1].

    Returns
    -------
    bool
        Whether the slope of layer/mean(layer) on albedo/mean(albedo), means of 9×9 pixels, is a half or more: it is 1
        for albedo times light, and 0 for light alone.
    """
    color = albedo if layer.shape[-1] == albedo.shape[-1] else albedo.mean(axis=-1, keepdims=True)
    light, level = np.abs(_blur(layer)), _blur(color)
    lit = (light > 0) & (level > _DARK)
    # No further than once the mean: a firefly is no texture.
    of_layer, of_color = (
        np.clip((image[lit] - mean[lit]) / mean[lit], -1, 1).astype(np.float64)
        for image, mean in ((layer, light), (color, level))
    )
    power = float((of_color**2).sum())
    return power > 0 and float((of_layer * of_color).sum()) >= 0.5 * power


def find_sums(layers: Sequence[Floats], whole: Floats, exposure: float) -> list[tuple[int, ...]]:
    """Find layers that add up to a picture; sets of them that share none, those of the fewest layers first.

    Parameters
    ----------
    layers : sequence of (..., C) float32
        As for `sums_to`; negative light is allowed.
    whole : (..., C) float32
        The picture.
    exposure : float
        Radiance of middle brightness.

    Returns
    -------
    list of tuple of int
        Indices of layers.

    Notes
    -----
    A depth-first search. Of a set that is begun, all sums lie between that with all negative and that with all positive
    values of the layers not yet decided: where the whole is outside of this in too many values, nothing can follow.
    A layer of less light than the bound allows to be missing is taken in where that brings the sum nearer.
    """
    flat = np.asarray(whole, np.float32).ravel()
    step = max(1, flat.size // _VALUES)
    target = flat[::step]
    values = [np.asarray(layer, np.float32).ravel()[::step] for layer in layers]
    lit = sorted((k for k, v in enumerate(values) if v.any()), key=lambda k: -float(np.abs(values[k]).sum()))
    found = _search([values[k] for k in lit], target, np.float32(_NEAR) * (np.abs(target) + np.float32(exposure)))
    sets: list[tuple[int, ...]] = []
    taken: set[int] = set()
    for subset in sorted((tuple(lit[i] for i in chosen) for chosen in found), key=lambda s: (len(s), s)):
        if taken & {*subset} or not sums_to([layers[k] for k in subset], whole, exposure):
            continue
        total = np.sum([values[k] for k in subset], axis=0, dtype=np.float32)
        for k in lit:
            nearer = np.abs(target - total - values[k]).mean() < 0.7 * np.abs(target - total).mean()
            if k not in taken and k not in subset and nearer:
                subset, total = (*subset, k), total + values[k]
        sets.append(tuple(sorted(subset)))
        taken |= {*subset}
    return sets


def _search(values: Sequence[Floats], target: Floats, slack: Floats) -> list[tuple[int, ...]]:
    """All sets of vectors that add up to a target, of the first `_SUBSETS` that are begun; the brightest first."""
    if not values:
        return []
    nothing = np.zeros_like(target)
    lowest, highest = [nothing], [nothing]
    for layer in reversed(values):
        lowest.insert(0, lowest[0] + np.minimum(layer, 0))
        highest.insert(0, highest[0] + np.maximum(layer, 0))
    found: list[tuple[int, ...]] = []
    begun: list[tuple[int, tuple[int, ...], Floats]] = [(0, (), np.zeros_like(target))]
    for _ in range(_SUBSETS):
        if not begun:
            break
        k, chosen, total = begun.pop()
        with np.errstate(invalid="ignore"):
            possible = (total + lowest[k] <= target + slack) & (total + highest[k] >= target - slack)
        if not few_differ(1 - possible.mean()):
            continue
        if chosen and np.mean(np.abs(total - target) <= slack) >= 1 - _MOST:
            found.append(chosen)
            continue  # more of them add next to nothing
        if k < len(values):
            begun += [(k + 1, chosen, total), (k + 1, (*chosen, k), total + values[k])]
    return found


def filter_layers(
    layers: Sequence[Floats], guide: Floats, *, moments: NDArray[np.float64] | None = None
) -> list[Floats]:
    """Denoise layers each by its own light, steered by what is known of the picture's edges.

    Parameters
    ----------
    layers : sequence of (H, W, C) float32
        Averaged over time.
    guide : (H, W, G) float32
        What steers the filter: the denoised light and more.
    moments : (2, G) float64, optional
        As for `nlm.guided.guided_filter`.

    Returns
    -------
    list of (H, W, C) float32
        Each within its own range; none of its mean is lost.
    """
    if not layers:
        return []
    steered = guided_filter(np.concatenate(layers, axis=-1), guide, radius=_RADIUS, eps=_EPS, moments=moments)
    edges = np.cumsum([layer.shape[-1] for layer in layers])[:-1]
    return [np.ascontiguousarray(layer) for layer in np.split(steered, edges, axis=-1)]


def split_light(
    filtered: Sequence[Floats],
    denoised: Floats,
    *,
    exposure: float,
    factors: Sequence[Floats | None] | None = None,
    bounds: Sequence[Floats | None] | None = None,
) -> list[Floats]:
    """Share a denoised picture out to the parts that it is the sum of.

    Parameters
    ----------
    filtered : sequence of (H, W, 3) float32
        The parts, from `filter_layers`; negative light is allowed.
    denoised : (H, W, 3) float32
        The picture, denoised.
    exposure : float
        Radiance of middle brightness.
    factors : sequence of (H, W, 3) float32 or None, optional
        What each part is multiplied by before they are added, at least 0; None: 1.
    bounds : sequence of (H, W, 3) float32 or None, optional
        A layer within whose range, over 17×17 pixels, a part stays; None: without bounds.

    Returns
    -------
    list of (H, W, 3) float32
        The parts, denoised; they add up to `denoised` where the bounds leave it possible.

    Raises
    ------
    ValueError
        If shapes differ.

    Notes
    -----
    With F the filtered parts, c the factors, g = denoised − Σ c F what they lack:

        o_k = F_k + g · (|F_k| + ε) / Σ_j c_j (|F_j| + ε) ,

    which is denoised · F_k / Σ c F for light that is not negative. A share of light is smoother than light, and what
    the denoiser knows of the picture's detail is in `denoised`. What a bound cuts off is shared out to the others.
    """
    if not filtered:
        return []
    for part in filtered:
        if part.shape != denoised.shape:
            raise ValueError(f"parts: expected shape {denoised.shape} like the picture's, got {part.shape}")
    cs = [np.float32(1) if factor is None else factor for factor in factors or [None] * len(filtered)]
    limits = [None if layer is None else _range(layer) for layer in bounds or [None] * len(filtered)]
    weights = [np.abs(part) + _EPSILON * np.float32(exposure) for part in filtered]
    parts = list(filtered)
    for _ in range(1 if all(limit is None for limit in limits) else _ROUNDS):
        gap = denoised - add_light(parts, cs)
        total = add_light(weights, cs)
        # Where every factor is 0 no part can hold any light.
        share = np.divide(gap, total, out=np.zeros_like(gap), where=total > 0)
        for k, limit in enumerate(limits):
            part = parts[k] + share * weights[k]
            np.maximum(part, 0, out=part, where=(filtered[k] >= 0) & (denoised >= 0))  # but for rounding it is
            if limit is not None:
                bounded = np.clip(part, *limit)
                weights[k] = np.where(bounded == part, weights[k], np.float32(0))
                part = bounded
            parts[k] = np.asarray(part, np.float32)
    return parts


def add_light(parts: Sequence[Floats], factors: Sequence[Floats | np.float32 | None]) -> Floats:
    """Add parts up, each multiplied by its factor.

    Parameters
    ----------
    parts : sequence of (H, W, C) float32
        At least one.
    factors : sequence of (H, W, C) float32 or None
        As many; None: 1.

    Returns
    -------
    (H, W, C) float32
    """
    total = np.zeros_like(parts[0])
    for part, factor in zip(parts, factors, strict=True):
        total += part if factor is None else factor * part
    return total


def _range(layer: Floats) -> tuple[Floats, Floats]:
    """Least and greatest of what the filter has seen around each pixel."""
    box = np.ones((4 * _RADIUS + 1, 4 * _RADIUS + 1), np.uint8)
    return np.asarray(cv2.erode(layer, box), np.float32), np.asarray(cv2.dilate(layer, box), np.float32)


def _blur(layer: Floats) -> Floats:
    return np.asarray(cv2.blur(layer, (9, 9)), np.float32).reshape(layer.shape)


def _second_differences(layer: Floats) -> Floats:
    """[1 −2 1]ᵀ [1 −2 1] / 6, which has the variance of white noise (Immerkær 1996), without the outermost pixels."""
    kernel = np.array([1, -2, 1], np.float32)
    found = np.asarray(cv2.sepFilter2D(layer, -1, kernel, kernel) / 6, np.float32).reshape(layer.shape)
    return found[1:-1, 1:-1] if min(layer.shape[:2]) > 2 else found
