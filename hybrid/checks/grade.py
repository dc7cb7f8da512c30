"""Color grade of denoised pictures: factors that bring them to the level of their samples."""

from collections.abc import Sequence
from typing import NamedTuple

import numpy as np

from hybrid.files.frame import Array

TILE = 8  # sides of the tiles whose means are compared: the mean of 64 pixels has an eighth of a pixel's noise


class Grade(NamedTuple):
    """Factors by channel that bring denoised pictures to the level of their samples; None if no factor does."""

    factors: tuple[float, float, float] | None
    message: str


def find_grade(pictures: Sequence[tuple[Array, Array]]) -> Grade | None:
    """Compare the level of denoised pictures with that of their samples, channel by channel.

    `pictures` are (denoised picture, samples) of some frames, each (H, W, 3), linear; non-finite pixels are excluded.
    Returns None if the levels agree within their uncertainty, or if frames have no common level.

    For tiles of 8×8 pixels with the means e of the picture and s of the samples, the factor is the median of s / e,
    weighted by e. It differs from 1 only if the ratio of the sums of s and e does so too: the median of skewed noise
    lies below its mean, and fireflies, which denoisers remove, lie above.
    """
    tiles = [_tiles(*pair) for pair in pictures]
    levels = [np.log(part[1].sum() / part[0].sum()) for part in tiles if part[0].sum() > 0 and part[1].sum() > 0]
    if levels and max(levels) - min(levels) > np.log(1.5):
        return None  # the frames differ among themselves: each is checked when it is read
    e, s, noise = (np.concatenate(parts) for parts in zip(*tiles, strict=True))
    factors, graded = [], False
    for c in range(3):
        # Tiles below a hundredth of the mean light are excluded: empty areas are equal in any grade.
        lit = (e[:, c] > 0.01 * max(float(e[:, c].sum()), 0) / max(len(e), 1)) & (e[:, c] > 0) & (s[:, c] > 0)
        if np.count_nonzero(lit) < 16:  # fewer tiles are no evidence
            factors.append(1.0)
            continue
        weights, ratio = e[lit, c], np.log(s[lit, c] / e[lit, c])
        middle = _median(ratio, weights)
        spread = _median(np.abs(ratio - middle), weights)
        # Beyond the noise of the tiles: no factor explains half of the light.
        if spread > 0.15 + _median(noise[lit, c] / s[lit, c], weights):
            return Grade(None, "differs from the samples by another curve than one factor for each channel")
        total = float(np.log(s[lit, c].sum() / weights.sum()))
        # Denoisers are off by some percent, and skewed noise moves a median by as much: a tenth is no grade, nor are
        # five standard errors. 1.5: spread of a normal distribution, 1.25: error of its median.
        least = max(np.log(1.1), 5 * 1.5 * 1.25 * spread / np.sqrt(np.count_nonzero(lit)))
        graded |= min(abs(middle), abs(total)) > least and middle * total > 0
        factors.append(float(np.exp(middle)))
    if not graded:
        return None
    red, green, blue = factors
    said = ", ".join(f"{1 / factor:.3g}" for factor in factors)
    return Grade((red, green, blue), f"has {said} times the level of the samples in R, G, B")


def _tiles(picture: Array, samples: Array) -> tuple[Array, Array, Array]:
    """Means of both over tiles, (T, 3), and the standard error of the samples' means."""
    height, width = (side // TILE * TILE for side in picture.shape[:2])
    split = height // TILE, TILE, width // TILE, TILE, 3
    both = [
        np.asarray(layer[:height, :width], np.float64).reshape(split).swapaxes(1, 2).reshape(-1, TILE**2, 3)
        for layer in (picture, samples)
    ]
    finite = np.isfinite(both[0]).all(axis=(1, 2)) & np.isfinite(both[1]).all(axis=(1, 2))
    e, s = both[0][finite], both[1][finite]
    level = s.mean(axis=1) / np.maximum(e.mean(axis=1), np.finfo(np.float32).tiny)  # no division by 0 on black
    return e.mean(axis=1), s.mean(axis=1), (s - level[:, None] * e).std(axis=1) / TILE


def _median(values: Array, weights: Array) -> float:
    """Weighted median."""
    order = np.argsort(values)
    total = np.cumsum(weights[order])
    return float(values[order][np.searchsorted(total, total[-1] / 2)])
