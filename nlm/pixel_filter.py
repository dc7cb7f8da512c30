"""The pixel filter of a renderer, as the correlation of its noise shows it: measured, undone and applied again.

A renderer that adds each sample to all pixels under its filter makes neighbouring pixels share noise. Denoisers take
such noise for detail. With the filter undone the noise is that of a filter of one pixel.
"""

from typing import NamedTuple

import cv2
import numpy as np

from loops.parallel import Doubles, Floats, Mask

# Pixels apart at which noise is compared: that of a filter of five pixels, as renderers have at most, ends there.
_LAGS = (1, 2, 3, 4)
# Deviation, pixels, of the Gaussian mean without which noise is compared: light that moves differs by more than noise
# over so many pixels. It takes a hundredth of the noise with it, for which the measure accounts.
_MEAN = 4.0
# Side, pixels, of the tiles whose median is the measure, and the least number of them. In many tiles of a clean frame
# vectors do not explain the picture, which then differs as correlated noise does.
_TILE, _LEAST_TILES = 16, 8
# Fourth difference along rows or columns, which separates the noise of a single frame from its light: it removes smooth
# light, and edges along x and y. With second differences, light at 512 samples adds 0.06 more to the measure.
_FOURTH = (1, -4, 6, -4, 1)
# Pixels beyond the end of a filter of five pixels, at which differences are those of noise that is not shared.
_APART = (5, 6)
# Frequencies at which noise has a smaller share of its mean amplitude are not amplified further: below, errors of the
# measure decide. *classroom* filtered by [0.45 1 0.45], which leaves 0.1, loses 2.4 / 3.1 dB with 0.17.
_LEAST_SHARE = 0.14
# Taps one and two pixels from the middle one, over that one: filters of renderers, with negative lobes or without.
_NEAR_TAPS, _FAR_TAPS = np.arange(0, 0.8, 0.01), np.arange(-0.15, 0.4, 0.01)
# Half the taps of the inverse: that of the widest filter has ended there.
_REACH = 16


class PixelFilter(NamedTuple):
    """A separable, symmetric filter, alike along x and y, and its inverse, of `2 * 16 + 1` taps of sum 1."""

    spread: Floats
    inverse: Floats

    @property
    def gain(self) -> float:
        """By how much the filter, undone, raises the variance of noise that it has spread."""
        return float(np.square(self.spread, dtype=np.float64).sum()) ** -2

    def undo(self, image: Floats) -> Floats:
        """Filter an image (H, W, C) by the inverse; pixels beside bright ones may become negative."""
        return _filter(image, self.inverse)

    def apply(self, image: Floats) -> Floats:
        """Filter an image (H, W, C)."""
        return _filter(image, self.spread)


def measure_correlation(difference: Floats, trusted: Mask, least: Floats) -> Doubles | None:
    """Measure how neighbouring pixels share the noise of a frame.

    Parameters
    ----------
    difference : (H, W) float32, of two frames that show the same, so that it is noise
    trusted : (H, W) bool, where they do
    least : (H, W) float32, difference up to which there is no noise to measure

    Returns
    -------
    (2, 4) float64 or None
        Correlation of the noise at 1 to 4 pixels along x and along y; None with too little noise.

    Notes
    -----
    With h the difference without its Gaussian mean G of 4 pixels, each tile of 16×16 pixels gives Σ h h' / Σ h² over
    its trusted pixels. A picture that differs is alike along the diagonals too: half of the tiles count, those least
    alike two pixels along these, by their median m. One bright sample decides no more than its own tile. G takes a part
    of the noise with it: where ρ is its correlation, and S the sum of that over all pixels,

        m = (ρ − S b) / (1 − S b₀),    b = 2 G − G ⋆ G,

    which is solved by iteration.
    """
    h = np.where(trusted, difference - cv2.GaussianBlur(difference, (0, 0), _MEAN), np.float32(0))
    known = trusted.astype(np.float32)
    power, count, level = (_tile_sums(layer) for layer in (h * h, known, least * least))
    counted = (2 * count > _TILE**2) & (power > level)
    if np.count_nonzero(counted) < _LEAST_TILES:
        return None
    variance = power[counted] / count[counted]

    def alike(down: int, right: int) -> Doubles:
        shared, pairs = (_tile_sums(_product(layer, down, right))[counted] for layer in (h, known))
        return shared / (np.maximum(pairs, 1) * variance)

    across = alike(2, 2) + alike(2, -2)
    noise = across <= np.median(across)
    found = np.array(
        [[np.median(alike(*lag)[noise]) for lag in lags] for lags in ([(0, n) for n in _LAGS], [(n, 0) for n in _LAGS])]
    )
    distance = np.array([0, *_LAGS])
    taken = 2 * _gaussian(distance, _MEAN**2) - _gaussian(distance, 2 * _MEAN**2)
    correlation, total = found, 1.0
    for _ in range(20):  # each leaves less than a third of the error
        correlation = found * (1 - total * taken[0]) + total * taken[1:]
        total = float(np.prod(1 + 2 * correlation.sum(axis=1)))
    return correlation


def measure_alone(light: Floats, trusted: Mask, least: Floats, texture: Floats) -> tuple[Doubles, float] | None:
    """Measure how neighbouring pixels share the noise of a frame from that frame alone.

    Parameters
    ----------
    light : (H, W) float32, light and its noise without the texture of surfaces
    trusted : (H, W) bool, where it holds both
    least : (H, W) float32, deviation up to which there is no noise to measure
    texture : (H, W) float32, deviation that the light may have by texture

    Returns
    -------
    (2, 4) float64, and float; or None
        Correlation of the noise at 1 to 4 pixels along x and along y, and the lower quartile of the first of each, the
        lesser of both; None with too little noise, or where most of it may be texture.

    Notes
    -----
    With g the fourth difference of the light along y, E(n) is the mean of (g(x + n) − g(x))² over a tile of 16×16
    pixels. Where noise correlates by ρ(n) along x, E(n) is in proportion to 1 − ρ(n), however it correlates along y.
    The noise of a filter of five pixels is independent from n = 5 on: ρ(n) = 1 − 2 E(n) / (E(5) + E(6)), whose median
    over tiles is the measure. Light that g leaves adds to it where light has such detail. A filter spreads all noise,
    and independent noise shows in most tiles: the lower quartile tells them apart.
    """
    if min(light.shape) < _TILE:
        return None
    along_x = _along_rows(light, trusted, least, texture)
    along_y = _along_rows(light.T, trusted.T, least.T, texture.T)
    if along_x is None or along_y is None:
        return None
    lags = np.array([np.median(tiles, axis=1) for tiles in (along_x, along_y)])
    return lags, float(min(np.quantile(tiles[0], 0.25) for tiles in (along_x, along_y)))


def find_filter(correlation: Doubles) -> PixelFilter:
    """Find the filter that gives white noise this correlation (2, 4) along x and along y.

    It is the filter (b, a, 1, a, b) with the least squared difference from the mean of both directions, plus b²: most
    filters have next to no b. Then 80×48 pixels are enough, whose correlations err by 0.05; the inverse of four free
    lags had halos there. Without b² *classroom* filtered by [0.45 1 0.45] loses 0.7 / 3.1 dB.
    """
    a, b = (layer.ravel() for layer in np.meshgrid(_NEAR_TAPS, _FAR_TAPS))
    taps = np.stack([b, a, np.ones_like(a), a, b])
    lags = [np.einsum("tn,tn->n", taps[lag:], taps[: 5 - lag]) for lag in (0, *_LAGS)]
    off = np.square(np.array(lags[1:]) / lags[0] - correlation.mean(axis=0)[:, None]).sum(axis=0) + b * b
    spread = np.pad(taps[:, np.argmin(off)], _REACH - 2)
    share = np.fft.fft(np.fft.ifftshift(spread / np.linalg.norm(spread))).real
    inverse = np.fft.fftshift(np.fft.ifft(1 / np.maximum(share, _LEAST_SHARE)).real)
    return PixelFilter(*(np.asarray(found / found.sum(), np.float32) for found in (spread, inverse)))


def _filter(image: Floats, taps: Floats) -> Floats:
    found = cv2.sepFilter2D(np.ascontiguousarray(image, np.float32), -1, taps, taps, borderType=cv2.BORDER_REFLECT_101)
    return np.asarray(found, np.float32).reshape(image.shape)


def _product(layer: Floats, down: int, right: int) -> Floats:
    """The product of each pixel and another one, so many rows and columns further; 0 beyond the edge."""
    height, width = layer.shape
    product = np.zeros_like(layer)
    here = slice(height - down), slice(max(-right, 0), width - max(right, 0))
    product[here] = layer[here] * layer[down:, max(right, 0) : width + min(right, 0)]
    return product


def _along_rows(light: Floats, trusted: Mask, least: Floats, texture: Floats) -> Doubles | None:
    """Correlation (4, N) in N tiles at 1 to 4 pixels along rows, by `measure_alone`."""
    g, whole = np.zeros_like(light), np.zeros_like(trusted)
    rows = [slice(i, len(light) - 4 + i) for i in range(len(_FOURTH))]
    g[2:-2] = sum(np.float32(factor) * light[some] for factor, some in zip(_FOURTH, rows, strict=True))
    whole[2:-2] = np.logical_and.reduce([trusted[some] for some in rows])
    sums = [_squares(g, whole, lag) for lag in (*_LAGS, *_APART)]
    power, count = (np.stack(each) for each in zip(*sums, strict=True))
    none, drawn = (2 * np.square(_FOURTH).sum() * _tile_sums(plane**2 * whole) for plane in (least, texture))
    counted = (2 * count.min(axis=0) > _TILE**2) & (power[-1] > none)
    if np.count_nonzero(counted) < _LEAST_TILES or np.mean((power[-1] > drawn)[counted]) < 0.5:
        return None
    mean = power[:, counted] / count[:, counted]
    correlation: Doubles = 1 - mean[: len(_LAGS)] / mean[len(_LAGS) :].mean(axis=0)
    return correlation


def _squares(g: Floats, known: Mask, lag: int) -> tuple[Doubles, Doubles]:
    """Sums over tiles of squared differences of known pixels, so many columns apart, and their numbers."""
    squares, both = np.zeros_like(g), np.zeros_like(g)
    both[:, lag:] = known[:, lag:] & known[:, :-lag]
    squares[:, lag:] = np.square(g[:, lag:] - g[:, :-lag])
    return _tile_sums(squares * both), _tile_sums(both)


def _tile_sums(layer: Floats) -> Doubles:
    """Sums over whole tiles."""
    rows, columns = (size // _TILE for size in layer.shape)
    tiles = layer[: rows * _TILE, : columns * _TILE].reshape(rows, _TILE, columns, _TILE)
    return np.asarray(tiles.sum(axis=(1, 3), dtype=np.float64))


def _gaussian(distance: Doubles, variance: float) -> Doubles:
    """A Gaussian of two dimensions at a distance, pixels."""
    return np.exp(-np.square(distance) / (2 * variance)) / (2 * np.pi * variance)
