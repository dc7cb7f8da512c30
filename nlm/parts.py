"""Layers that are parts of a picture: found by adding up noisy pixels, denoised so that their sum is kept."""

from collections.abc import Sequence

import cv2
import numpy as np
from numba import njit

from loops.parallel import Doubles, Floats, run_bands
from nlm.guided import guided_filter
from nlm.variance import second_differences

# Guided filter: 9×9 pixels hold the samples of a window 400 times, and shares of light change slowly.
_RADIUS, _EPS = 4, 1e-2
# Added to divisors, times the exposure: where nothing is lit, all parts have the same share.
_EPSILON = np.float32(1e-6)
# A sum may differ from the whole by this share of both and of the exposure: half floats round by 5e-4 for each part
# and its color. A twentieth of the values may differ by more: saturated halves, and non-finite pixels.
_NEAR, _MOST = 5e-3, 0.05
# Limit of tested subsets, and of compared values of a frame.
_SUBSETS, _VALUES = 20_000, 1_500
# A layer is noisy if the median of its second differences, in patches of 9×9 pixels, exceeds this share of its mean in
# this share of its patches. Edges of masks fill no patch.
_NOISE, _PATCHES = 0.01, 0.02
# Albedo below this carries no color.
_DARK = 0.01
# Rounds that distribute light beyond bounds over the other parts.
_ROUNDS = 3


def sums_to(parts: Sequence[Floats], whole: Floats, exposure: float) -> bool:
    """Return whether layers, times albedo where rendered without, add up to a picture: 95 % of values within 0.5 %."""
    total = np.zeros_like(whole)
    for part in parts:
        total += part
    with np.errstate(invalid="ignore"):  # infinities of saturated halves
        near = np.abs(total - whole) <= np.float32(_NEAR) * (np.abs(whole) + np.float32(exposure))
    return few_differ(float(1 - near.mean()))


def few_differ(share: float) -> bool:
    """Return whether a share in [0, 1] of differing values is small enough for a sum: saturated halves, fireflies."""
    return share <= _MOST


def share_outside(part: Floats, whole: Floats, exposure: float) -> float:
    """Return the share of values, in [0, 1], in which a layer is negative or above the picture."""
    slack = np.float32(_NEAR) * (np.abs(whole) + np.float32(exposure))
    return float(1 - ((part <= whole + slack) & (part >= -slack)).mean())


def shares_noise(part: Floats, whole: Floats) -> bool:
    """Return whether a picture holds a layer's noise: the slope of second differences, 1 for parts, is over a half."""
    of_part, of_whole = (_second_differences(layer).astype(np.float64) for layer in (part, whole))
    # Clipped near the median: a single bright sample must not decide.
    most = 10 * np.median(np.abs(of_part)) or np.inf
    of_part, of_whole = (np.clip(found, -most, most) for found in (of_part, of_whole))
    power = float(np.mean(of_part**2))
    return power > 0 and float(np.mean(of_part * of_whole)) >= 0.5 * power


def is_noisy(layer: Floats) -> bool:
    """Return whether a layer (H, W, C), as rendered and finite, has noise anywhere; texture counts as noise, edges do
    not.
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
    """Return whether a layer includes the albedo: the slope of layer/mean on albedo/mean, 9×9, is at least a half."""
    color = albedo if layer.shape[-1] == albedo.shape[-1] else albedo.mean(axis=-1, keepdims=True)
    light, level = np.abs(_blur(layer)), _blur(color)
    lit = (light > 0) & (level > _DARK)
    # Clipped to once the mean: a firefly is no texture.
    of_layer, of_color = (
        np.clip((image[lit] - mean[lit]) / mean[lit], -1, 1).astype(np.float64)
        for image, mean in ((layer, light), (color, level))
    )
    power = float((of_color**2).sum())
    return power > 0 and float((of_layer * of_color).sum()) >= 0.5 * power


def find_sums(layers: Sequence[Floats], whole: Floats, exposure: float) -> list[tuple[int, ...]]:
    """Find disjoint sets of layers, tuples of their indices, that add up to a picture, those of the fewest layers
    first.

    A depth-first search. All sums that continue a partial set lie between its sum with all negative and its
    sum with all positive values of the undecided layers: the branch is cut where too many values of the picture lie
    outside. A layer with less light than the tolerance is added where that brings the sum nearer. Negative light is
    allowed.
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
    """All sets of vectors that add up to a target, of the first `_SUBSETS` partial sets; the brightest first."""
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
            continue  # further layers add next to nothing
        if k < len(values):
            begun += [(k + 1, chosen, total), (k + 1, (*chosen, k), total + values[k])]
    return found


def filter_layers(layers: Sequence[Floats], guide: Floats, *, moments: Doubles | None = None) -> list[Floats]:
    """Denoise layers, averaged over time, each within its range and with its mean, by `nlm.guided.guided_filter`."""
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
    """Distribute a denoised picture over the parts that add up to it.

    Returns a list of (H, W, 3) float32, parts that add up to `denoised` where the bounds allow this.

    Parameters
    ----------
    filtered : sequence of (H, W, 3) float32, the parts, from `filter_layers`; negative light is allowed
    denoised : (H, W, 3) float32, the picture
    exposure : float
    factors : sequence of (H, W, 3) float32 or None, optional, factor of each part in the sum, at least 0; None: 1
    bounds : sequence of (H, W, 3) float32 or None, optional
        Layers whose range over 17×17 pixels bounds a part; None: no bounds.

    Notes
    -----
    With F the filtered parts, c the factors and g = denoised − Σ c F:

        o_k = F_k + g · (|F_k| + ε) / Σ_j c_j (|F_j| + ε) ,

    which is denoised · F_k / Σ c F for light that is not negative: a share of light is smoother than light, and the
    detail is in `denoised`. Light beyond a bound is distributed over the other parts.
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
            np.maximum(part, 0, out=part, where=(filtered[k] >= 0) & (denoised >= 0))  # differs by rounding alone
            if limit is not None:
                bounded = np.clip(part, *limit)
                weights[k] = np.where(bounded == part, weights[k], np.float32(0))
                part = bounded
            parts[k] = np.asarray(part, np.float32)
    return parts


def add_light(parts: Sequence[Floats], factors: Sequence[Floats | np.float32 | None]) -> Floats:
    """Return Σ factor · part, (H, W, C), where a factor None is 1."""
    total = np.zeros_like(parts[0])
    for part, factor in zip(parts, factors, strict=True):
        total += part if factor is None else factor * part
    return total


def _range(layer: Floats) -> tuple[Floats, Floats]:
    """Least and greatest value within the filter's support of each pixel."""
    box = np.ones((4 * _RADIUS + 1, 4 * _RADIUS + 1), np.uint8)
    return np.asarray(cv2.erode(layer, box), np.float32), np.asarray(cv2.dilate(layer, box), np.float32)


def _blur(layer: Floats) -> Floats:
    return np.asarray(cv2.blur(layer, (9, 9)), np.float32).reshape(layer.shape)


def _second_differences(layer: Floats) -> Floats:
    """[1 −2 1]ᵀ [1 −2 1] / 6, which has the variance of white noise (Immerkær 1996), without the outermost pixels."""
    found = np.asarray(second_differences(layer) / 6, np.float32)
    return found[1:-1, 1:-1] if min(layer.shape[:2]) > 2 else found


def limit_change(own: Floats, color: Floats, most: float, *, with_factor: bool) -> tuple[Floats, Floats]:
    """Change a picture (H, W, C), or black, to a color by a factor of at most `most`, and return that `with_factor`."""
    changed, factor = np.empty_like(own), np.empty(own.shape if with_factor else (0, 0, 0), np.float32)
    run_bands(_limit_change, len(own), own, np.ascontiguousarray(color), np.float32(most), changed, factor)
    return changed, factor


@njit(cache=True, nogil=True, error_model="numpy")
def _limit_change(
    first: int, last: int, own: Floats, color: Floats, most: np.float32, changed: Floats, factor: Floats
) -> None:
    for y in range(first, last):
        for x in range(own.shape[1]):
            for c in range(own.shape[2]):
                before, after, change = own[y, x, c], color[y, x, c], np.float32(1)
                if before > 0:
                    # Before the division, which may exceed float32.
                    bounded = min(max(after, before / most), before * most)
                    change = bounded / before
                    after = after if bounded == after else before * change
                changed[y, x, c] = after
                if factor.size:
                    factor[y, x, c] = change
