"""Joint non-local means over an aligned window, steered by variance and features."""

from typing import NamedTuple

import numpy as np
from numba import njit

from loops.parallel import Floats, Mask, run_bands

# The image is cut into tiles whose planes stay in the cache. Long rows, because every pass over a row takes time before
# its first pixel: 128 and 512 wide take 1.4 and 1.1 times as long (Zen 3, three channels).
BAND, _TILE_WIDTH = 32, 256
# Columns beside those that are asked for, which are filtered too: the variance has been smoothed over as many.
_PAD = 8
# A relative difference of 1e-3 counts as noise: half floats are no finer (2^-11), and the colour distance stays finite
# where the variance is 0. Relative, so that the filter stays scale equivariant.
_RELATIVE_VARIANCE = 1e-6
# Below the square of any radiance worth keeping (1e-15); only there to make 0/0 a 0.
_TINY = 1e-30
# Squared difference of features (of unit range) that is always tolerated: Rousselle's tau.
_FEATURE_FLOOR = 1e-3
# Values beyond this would overflow float32 when squared; they are treated as non-finite.
_HUGE = 1e18
# Largest distance a single pixel adds to a patch: one firefly then cannot veto a patch of otherwise
# matching pixels, nor swamp the running sums.
_PIXEL_CAP = 25.0
# A value 28 deviations from the centre's is no tap: (u_p − u_q)² > 400 (V_p + V_q), so that no firefly leaks into its
# surroundings. The tail of ordinary noise must be averaged with the rest: at ten deviations the tail stayed, at a cost
# of up to 0.4 dB against references of three Cycles shots.
_FAR = 400.0
# From this distance on a weight is 0.
_NEVER = 16.0


class _Inputs(NamedTuple):
    window: Floats
    variance: Floats
    features: Floats
    confidence: Floats
    where: Mask


class _Tile(NamedTuple):
    """Planes of one frame around a tile: values (C, h, w), their noise term, features (F, h, w), weight of each tap."""

    values: Floats
    noise: Floats
    features: Floats
    trust: Floats


def joint_nlm(
    window: Floats,
    variance: Floats,
    features: Floats | None = None,
    confidence: Floats | None = None,
    *,
    radius: int = 3,
    patch_radius: int = 3,
    k: float = 0.5,
    where: Mask | None = None,
) -> Floats:
    """Average the pixels of an aligned window whose patches differ by no more than noise.

    Parameters
    ----------
    window : (T, H, W, C) float32
        Irradiance or radiance. Non-finite values are left out.
    variance : (H, W, C) float32, variance of the centre's values, smoothed; used for all frames
    features : (H, W, F) float32, optional
        The centre's albedo, normal, depth …, of about unit range and prefiltered (`nlm.variance.prefilter_guide`); used
        for all frames, as these are aligned.
    confidence : (T, H, W) float32, optional, in [0, 1]; default 1
    radius, patch_radius : int, of the search and of the compared patches, pixels
    k : float, strength of the colour distance: more smooths more
    where : (H, W) bool, optional, columns of a tile far from True pixels are copied from the centre

    Returns
    -------
    (H, W, C) float32
        Convex combinations of values of the window; the centre's value where no value is trusted, 0 where this is not
        finite.

    Notes
    -----
    For pixels p of the centre and q of the window, u the values and V their variance::

        d(p, q) = ((u_p − u_q)² − (V_p + min(V_p, V_q))) / (k² (V_p + V_q))    averaged over patch and channels
        f(p, q) = max over features (f_p − f_q)² / max(|∇f_p|², 1e-3)
        w(p, q) = confidence_q · exp(−max(d, f, 0))

    A share of u² (1e-6 / k²) is added to V: no division by 0, and the filter stays scale equivariant. A pixel adds at
    most 25 to the distance of a patch; a value 28 deviations from the centre's gets no weight. A firefly therefore
    spreads nowhere, but stays: run `reject_outliers` first. e^-d is (1 - d/16)^16, which vectorises.

    References
    ----------
    Rousselle, Knaus and Zwicker, Adaptive rendering with non-local means filtering, 2012,
    doi:10.1145/2366145.2366214; Robust denoising using feature and color information, 2013, doi:10.1111/cgf.12219
    """
    window = np.ascontiguousarray(window, np.float32)
    if window.ndim != 4 or window.shape[0] % 2 == 0:
        raise ValueError(f"window: expected (odd frames, height, width, channels), got {window.shape}")
    _, height, width, _ = window.shape
    if features is None:
        features = np.empty((height, width, 0), np.float32)
    if confidence is None:
        confidence = np.ones(window.shape[:3], np.float32)
    if features.ndim != 3 or features.shape[:2] != (height, width):
        raise ValueError(f"features: expected ({height}, {width}, channels), got {features.shape}")
    if where is None:
        where = np.ones((height, width), np.bool_)
    for name, array, shape in (
        ("variance", variance, window.shape[1:]),
        ("confidence", confidence, window.shape[:3]),
        ("where", where, (height, width)),
    ):
        if array.shape != shape:
            raise ValueError(f"{name}: expected shape {shape}, got {array.shape}")
    for name, number in (("radius", radius), ("patch_radius", patch_radius)):
        if not 0 <= number <= max(height, width):
            raise ValueError(f"{name}: expected 0 to {max(height, width)}, got {number}")
    if not k > 0:
        raise ValueError(f"k: expected a positive number, got {k}")
    variance, features, confidence = (
        np.ascontiguousarray(array, np.float32) for array in (variance, features, confidence)
    )
    out = np.empty(window.shape[1:], np.float32)
    tiles = -(-height // BAND) * -(-width // _TILE_WIDTH)
    given = _Inputs(window, variance, features, confidence, where)
    run_bands(_filter, tiles, given, radius, patch_radius, np.float32(k), out)
    return out


def _filter(first: int, last: int, given: _Inputs, radius: int, patch: int, k: np.float32, out: Floats) -> None:
    """Filter the tiles from `first` to `last`, which are counted along rows of tiles."""
    height, width, _ = out.shape
    columns, centre = -(-width // _TILE_WIDTH), given.window[len(given.window) // 2]
    for tile in range(first, last):
        top, left = tile // columns * BAND, tile % columns * _TILE_WIDTH
        rows, whole = slice(top, min(top + BAND, height)), slice(left, min(left + _TILE_WIDTH, width))
        out[rows, whole] = centre[rows, whole]
        asked = np.flatnonzero(given.where[rows, whole].any(axis=0))
        if asked.size:
            part = slice(left + max(asked[0] - _PAD, 0), min(left + asked[-1] + 1 + _PAD, whole.stop))
            _filter_tile(given, radius, patch, k, (top, part.start), out[rows, part])


def _filter_tile(given: _Inputs, radius: int, patch: int, k: np.float32, corner: tuple[int, int], out: Floats) -> None:
    """Average all taps of the tile at `corner`."""
    (height, width, channels), margin, middle = out.shape, radius + patch, len(given.window) // 2
    (top, left), size = (place - margin for place in corner), (height + 2 * margin, width + 2 * margin)
    variance = _load(given.variance, (top, left), size) * (k * k)
    padded = _load(given.features, (top, left), size)
    frames = [
        _load_frame(*both, variance, padded, (top, left)) for both in zip(given.window, given.confidence, strict=True)
    ]
    features, scale = _load_features(given.features, corner, (height, width))
    centre = frames[middle]._replace(features=features)
    total, weight = np.zeros((channels, height, width), np.float32), np.zeros((height, width), np.float32)
    for frame in frames:
        _add_frame(centre, frame, scale, radius, patch, k, total, weight)
    np.divide(total, weight, out=total, where=weight > 0)
    total += centre.values[:, margin : margin + height, margin : margin + width]
    out[...] = total.transpose(1, 2, 0)


def _load(source: Floats, corner: tuple[int, int], size: tuple[int, int]) -> Floats:
    """Copy a tile of (H, W, C) into planes (C, h, w), with the edge repeated beyond the frame."""
    (top, left), (h, w), (height, width, _) = corner, size, source.shape
    rows, columns = slice(max(top, 0), min(top + h, height)), slice(max(left, 0), min(left + w, width))
    above, below, before, after = rows.start - top, rows.stop - top, columns.start - left, columns.stop - left
    planes = np.empty((source.shape[2], h, w), np.float32)
    for c, plane in enumerate(planes):
        plane[above:below, before:after] = source[rows, columns, c]
    planes[:, :above], planes[:, below:] = planes[:, above : above + 1], planes[:, below - 1 : below]
    planes[..., :before], planes[..., after:] = planes[..., before : before + 1], planes[..., after - 1 : after]
    return planes


def _load_frame(
    frame: Floats, confidence: Floats, variance: Floats, features: Floats, corner: tuple[int, int]
) -> _Tile:
    """Load values, their noise term of a `variance` (C, h, w) and the weight of each tap, 0 outside the frame."""
    size, (top, left), (height, width) = variance.shape[1:], corner, confidence.shape
    values, trust = _load(frame, corner, size), np.zeros(size, np.float32)
    rows, columns = slice(max(top, 0), min(top + size[0], height)), slice(max(left, 0), min(left + size[1], width))
    trust[rows.start - top : rows.stop - top, columns.start - left : columns.stop - left] = confidence[rows, columns]
    known = np.abs(values) < np.float32(_HUGE)
    if not known.all():
        values[~known] = 0
        trust[~known.all(axis=0)] = 0
    noise = np.fmax(variance + np.float32(_RELATIVE_VARIANCE) * values * values, np.float32(_TINY))
    return _Tile(values, noise, features, trust)


def _load_features(features: Floats, corner: tuple[int, int], size: tuple[int, int]) -> tuple[Floats, Floats]:
    """Load the centre's features, and the factor from squared difference to distance."""
    around = _load(features, (corner[0] - 1, corner[1] - 1), (size[0] + 2, size[1] + 2))
    across, down = around[:, 1:-1, 2:] - around[:, 1:-1, :-2], around[:, 2:, 1:-1] - around[:, :-2, 1:-1]
    tolerance = np.maximum(np.float32(0.25) * (across * across + down * down), np.float32(_FEATURE_FLOOR))
    return np.ascontiguousarray(around[:, 1:-1, 1:-1]), np.reciprocal(tolerance)


# Rows are read from flat planes at an offset: a view of a row takes as long as ten of its pixels. Offsets are unsigned:
# with a signed index numba tests each time whether it counts from the end.
@njit(cache=True, nogil=True, error_model="numpy", boundscheck=False)
def _add_frame(
    centre: _Tile, frame: _Tile, scale: Floats, radius: int, patch: int, k: np.float32, total: Floats, weight: Floats
) -> None:
    """Add the taps of one frame to all pixels of a tile."""
    C, th, tw = total.shape
    h, w = frame.trust.shape
    margin, size = radius + patch, 2 * patch + 1
    cancel, limit, norm = np.float32(1 / (k * k)), np.float32(_FAR / (k * k)), np.float32(1 / (C * size**2))
    zero, one, cap, never = np.float32(0), np.float32(1), np.float32(_PIXEL_CAP), np.float32(_NEVER)
    wide = np.uintp(tw + 2 * patch)
    ring, beyond = np.empty((size, wide), np.float32), np.empty((size, wide), np.float32)
    column, tap = np.empty(wide, np.float32), np.empty(tw, np.float32)
    own, own_noise = centre.values.reshape(-1), centre.noise.reshape(-1)
    other, other_noise, trust = frame.values.reshape(-1), frame.noise.reshape(-1), frame.trust.reshape(-1)
    sums, weights = total.reshape(-1), weight.reshape(-1)
    for step in range((2 * radius + 1) ** 2):
        dy, dx = step // (2 * radius + 1) - radius, step % (2 * radius + 1) - radius
        shift = dy * w + dx
        ring[:], column[:] = zero, zero
        for y in range(-patch, th + patch):
            # The running sums over the columns of patches, with one row of distances replaced.
            row, distance = ring[(y + patch) % size], beyond[(y + patch) % size]
            for x in range(wide):
                column[x] -= row[x]
                row[x] = distance[x] = zero
            for c in range(C):
                p = np.uintp((c * h + y + margin) * w + radius)
                q = np.uintp(np.intp(p) + shift)
                for x in range(wide):
                    diff = own[p + x] - other[q + x]
                    a, b = own_noise[p + x], other_noise[q + x]
                    v = (diff * diff - cancel * (a + (a if a < b else b))) / (a + b)
                    row[x] += v if v < cap else cap
                    # A value too far from the centre's.
                    distance[x] = never if diff * diff > limit * (a + b) else distance[x]
            for x in range(wide):
                column[x] += row[x]
            oy = y - patch
            if oy < 0:
                continue
            least = beyond[(oy + patch) % size, patch : patch + tw]
            qy, left = oy + margin + dy, margin + dx
            for f in range(len(scale)):
                guide, guided, rate = centre.features[f, oy], frame.features[f, qy, left : left + tw], scale[f, oy]
                for x in range(tw):
                    diff = guide[x] - guided[x]
                    v = diff * diff * rate[x]
                    least[x] = v if v > least[x] else least[x]
            p = np.uintp((oy + margin) * w + margin)
            q, out = np.uintp(np.intp(p) + shift), np.uintp(oy * tw)
            tap[:] = zero
            for n in range(np.uintp(size)):
                for x in range(np.uintp(tw)):
                    tap[x] += column[n + x]
            for x in range(np.uintp(tw)):
                d = tap[x] * norm
                d = d if d > least[x] else least[x]
                # (1 - d/16)^16 is e^-d to the precision needed, and vectorises
                e = one - d * np.float32(1 / _NEVER)
                e = e if e > zero else zero
                e *= e
                e *= e
                e *= e
                tap[x] = e * e * trust[q + x]
            for x in range(np.uintp(tw)):
                weights[out + x] += tap[x]
            for c in range(C):
                here, there, into = p + np.uintp(c * h * w), q + np.uintp(c * h * w), out + np.uintp(c * th * tw)
                # The difference from the centre: hundreds of roundings of a sum would shift even a constant picture.
                for x in range(np.uintp(tw)):
                    sums[into + x] += tap[x] * (other[there + x] - own[here + x])
