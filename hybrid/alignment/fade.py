"""Factors of light between two frames, as in a fade."""

from collections.abc import Sequence
from dataclasses import replace
from itertools import product

import numpy as np

from hybrid.alignment.prepare import SHORT_SIDE, PreparedFrame
from hybrid.alignment.transfer import NO_LIGHT
from hybrid.files.frame import Array
from loops.parallel import Doubles, Mask
from nlm.average import channel_mean
from nlm.pooling import RESIDUAL_LIMIT

# Rows and columns of areas over the lit part: their medians average noise.
AREAS = 4, 6
# A fade is accepted if one factor for the whole picture leaves less than `LEFT` of the change in three quarters of the
# areas; a slight fade, less than `LEFT_SLIGHT`. On rendered shots of 8 to 512 samples 0.59 to 1.2 are left where light
# moves, and less than 0.5 for 73 of 80 fades by 0.7. Factors of three channels are chosen where they leave less than
# `LEFT` of what one factor leaves.
LEFT, LEFT_SLIGHT = 0.5, 0.25
# Logarithm of a change beyond which no more may be left: that of fades by 0.7, by which the shares are chosen. A lamp
# that is switched on lights most of a room 6 times, and leaves a third of it.
MOST_LEFT = 0.36
# Logarithm of a fade that is slight: under one of 1.5 % that left 0.4 of the changes, a textured object in other light
# lost 1.5 dB where the noise is 1 %.
SLIGHT = 0.1
# Least logarithm of a fade; least number of areas that show one.
LEAST_FADE, LEAST_AREAS = 0.01, 6
# A fade is certain if its logarithm exceeds this many errors. The error is the upper quartile of the changes that the
# fade leaves in N areas, over √N. Rendered shots of 8 to 512 samples without a fade reach 4.9.
KNOWN = 6.0
# Noise explains what is left up to so many standard errors of an area: without a fade 0.6 to 1.5 of them are left where
# light stands still, and 2 to 20 where it moves.
EXPLAINED = 2.0
Fade = tuple[float, float, float]
# Rows and columns of an area of an image.
Cell = tuple[slice, slice]
NO_FADE: Fade = (1.0, 1.0, 1.0)


def inverse(fade: Fade) -> Fade:
    """Return the factors of the opposite direction."""
    red, green, blue = (1 / factor for factor in fade)
    return red, green, blue


def find_factors(first: Array, second: Array, compared: Mask, noise: Array | None = None) -> Doubles:
    """Median (C,) of the second of two images (H, W, C) over the first, where `compared`; 1 where that explains little.

    Changes are medians of logarithms in areas of the lit part. Factors explain the changes if they leave little of
    them, or are beyond their errors and the `noise` (H, W, C) of the first image explains what they leave.
    """
    mean = channel_mean(first)
    lit = compared & (np.minimum(mean, channel_mean(second)) > NO_LIGHT)
    if not lit.any():
        return np.ones(first.shape[2])
    cells = _lit_cells(lit)
    changes, factors = _choose_factors(first, second, mean, lit, cells)
    left, size = _upper_quartile(changes - factors), float(np.abs(factors).max())
    explains = left < (LEFT_SLIGHT if size < SLIGHT else LEFT) * min(_upper_quartile(changes), MOST_LEFT)
    if not explains and noise is not None and size > max(LEAST_FADE, KNOWN * left / np.sqrt(len(changes))):
        noise, light = (noise, first) if len(factors) == 3 else (channel_mean(noise)[..., None], mean[..., None])
        explains = left < EXPLAINED * _median_error(noise, light, lit, cells)
    explained = len(changes) >= LEAST_AREAS and explains
    return np.broadcast_to(np.exp(factors) if explained else np.ones(1), first.shape[2])


def _lit_cells(lit: Mask) -> list[Cell]:
    """Divide the lit part of an image into areas; return the indices of those with any lit pixel."""
    bands = []
    for axis, count in zip((1, 0), AREAS, strict=True):
        places = np.array_split(np.arange(*np.flatnonzero(lit.any(axis=axis))[[0, -1]] + (0, 1)), count)
        bands.append([slice(part[0], part[-1] + 1) for part in places if part.size])
    return [(y, x) for y, x in product(*bands) if lit[y, x].any()]


def _choose_factors(
    first: Array, second: Array, mean: Array, lit: Mask, cells: Sequence[Cell]
) -> tuple[Doubles, Doubles]:
    """Logarithms of changes in N areas, (N, 1) or (N, 3), and of one factor for all channels, or of one for each."""
    gray = _changes(mean, channel_mean(second), lit, cells)
    factor = np.array([np.median(gray)])
    if first.shape[2] == 3 and _is_tinted(first, second, lit):
        tinted = np.stack([_changes(first[..., c], second[..., c], lit, cells, gray) for c in range(3)], axis=1)
        factors = np.median(tinted, axis=0)
        if _upper_quartile(tinted - factors) < LEFT * _upper_quartile(tinted - factor):
            return tinted, factors
    return gray[:, None], factor


def _median_error(noise: Array, light: Array, lit: Mask, cells: Sequence[Cell]) -> float:
    """Median over areas of the standard error of a change by noise (H, W, C) of this light."""
    relative = np.abs(noise) / np.maximum(light, np.float32(NO_LIGHT))
    squares = np.square(np.minimum(relative, RESIDUAL_LIMIT)).mean(axis=2)
    errors = [np.sqrt(2 * np.mean(squares[cell][lit[cell]]) / np.count_nonzero(lit[cell])) for cell in cells]
    return float(np.median(errors))


def _is_tinted(first: Array, second: Array, lit: Mask) -> bool:
    """Whether the channels of a sixteenth of the pixels change by other factors."""
    some = np.s_[::4, ::4]
    before, after = first[some], second[some]
    both_lit = lit[some] & (np.minimum(before, after).min(axis=2) > NO_LIGHT)
    if not both_lit.any():
        return True
    return float(np.ptp(np.log(np.median(after[both_lit] / before[both_lit], axis=0)))) > LEAST_FADE / 2


def _changes(
    first: Array, second: Array, lit: Mask, cells: Sequence[Cell], otherwise: Doubles | None = None
) -> Doubles:
    """Median in each cell of the logarithm of the second of two images (H, W) over the first, where both are lit."""
    # A quotient, which is the same to the bit for frames times a power of two.
    both_lit = lit & (np.minimum(first, second) > NO_LIGHT)
    change = np.log(np.divide(second, first, out=np.ones(first.shape), where=both_lit, dtype=np.float64))
    changes = [np.median(change[cell][both_lit[cell]]) if both_lit[cell].any() else np.nan for cell in cells]
    return np.array(changes) if otherwise is None else np.where(np.isnan(changes), otherwise, changes)


def _upper_quartile(changes: Doubles) -> float:
    """Upper quartile over areas of the root mean square over channels of changes (N, C)."""
    return float(np.quantile(np.sqrt(np.mean(np.square(changes), axis=1)), 0.75))


def measure_fade(frame: Array, centre: Array, valid: Mask) -> Array:
    """Factors (C,) of light from one layer (H, W, C) to another, at equal pixels; 1 where none explain the change."""
    step = max(min(valid.shape) // SHORT_SIDE, 1)
    first, second = (np.ascontiguousarray(layer[::step, ::step]) for layer in (frame, centre))
    return find_factors(first, second, valid[::step, ::step]).astype(np.float32)


def scaled(frame: PreparedFrame, fade: Fade | Array) -> PreparedFrame:
    """Return a frame with `fade` times its light, but for its AOVs."""
    factor = np.array(fade, np.float32)
    variance = None if frame.variance is None else np.asarray(frame.variance * factor * factor)
    gray = None if frame.as_rendered_gray is None else frame.as_rendered_gray * factor.mean()
    return replace(frame, irradiance=np.asarray(frame.irradiance * factor), variance=variance, as_rendered_gray=gray)


def relit(frame: PreparedFrame, fade: Fade, centre: PreparedFrame) -> PreparedFrame:
    """Return a frame with `fade` times its light, as a neighbour of the centre; AOVs by the factors of their own."""
    valid = frame.valid & centre.valid
    aovs = {name: layer * measure_fade(layer, centre.aovs[name], valid) for name, layer in frame.aovs.items()}
    return replace(scaled(frame, fade), aovs=aovs)
