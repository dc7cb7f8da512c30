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


# Rows are read from flat planes at an offset: a view of a row takes as long as ten of its pixels. Offsets are unsigned:
# with a signed index numba tests each time whether it counts from the end.
@njit(cache=True, nogil=True, error_model="numpy", boundscheck=False)
def _add_color_distance(
    d: Floats, far: Floats, pu: Floats, pa: Floats, p: np.uintp, qu: Floats, qa: Floats, q: np.uintp,
    cancel: np.float32, limit: np.float32,
) -> None:  # fmt: skip
    """Add the distances of one channel from p to q; those of values too far apart are marked in `far`."""
    for x in range(np.uintp(d.size)):
        diff = pu[p + x] - qu[q + x]
        a, b = pa[p + x], qa[q + x]
        low = a if a < b else b
        v = (diff * diff - cancel * (a + low)) / (a + b)
        d[x] += v if v < np.float32(_PIXEL_CAP) else np.float32(_PIXEL_CAP)
        far[x] = np.float32(_NEVER) if diff * diff > limit * (a + b) else far[x]


@njit(cache=True, nogil=True, error_model="numpy", boundscheck=False)
def _max_feature_distance(d: Floats, pf: Floats, qf: Floats, scale: Floats) -> None:
    for x in range(d.size):
        diff = pf[x] - qf[x]
        v = diff * diff * scale[x]
        d[x] = v if v > d[x] else d[x]


@njit(cache=True, nogil=True, error_model="numpy", boundscheck=False)
def _accumulate(
    total: Floats, out: np.uintp, w: Floats, values: Floats, q: np.uintp, centre: Floats, p: np.uintp
) -> None:
    # The difference from the centre: hundreds of roundings of a sum would shift even a constant picture.
    for x in range(np.uintp(w.size)):
        total[out + x] += w[x] * (values[q + x] - centre[p + x])


@njit(cache=True, nogil=True, boundscheck=False)
def _load(target: Floats, source: Floats, top: int, left: int) -> None:
    """Copy a tile of (H, W, C) into planes (C, h, w), with the edge repeated beyond the frame."""
    planes, h, w = target.shape
    height, width = source.shape[:2]
    first, last = max(-left, 0), min(width - left, w)
    for y in range(h):
        row = source[min(max(top + y, 0), height - 1)]
        for c in range(planes):
            line = target[c, y]
            for x in range(first):
                line[x] = row[0, c]
            for x in range(first, last):
                line[x] = row[left + x, c]
            for x in range(last, w):
                line[x] = row[width - 1, c]


@njit(cache=True, nogil=True, error_model="numpy", boundscheck=False)
def _load_frame(tile: _Tile, variance: Floats, frame: Floats, confidence: Floats, top: int, left: int) -> None:
    """Load values, their noise term of a `variance` (C, h, w) and the weight of each tap, 0 outside the frame."""
    channels, h, w = tile.values.shape
    height, width = confidence.shape
    huge, share, least = np.float32(_HUGE), np.float32(_RELATIVE_VARIANCE), np.float32(_TINY)
    _load(tile.values, frame, top, left)
    tile.trust[:] = 0
    for y in range(max(-top, 0), min(height - top, h)):
        for x in range(max(-left, 0), min(width - left, w)):
            tile.trust[y, x] = confidence[top + y, left + x]
    for c in range(channels):
        for y in range(h):
            values, noise, trust, own = tile.values[c, y], tile.noise[c, y], tile.trust[y], variance[c, y]
            for x in range(w):
                known = abs(values[x]) < huge
                values[x] = values[x] if known else np.float32(0)
                trust[x] = trust[x] if known else np.float32(0)
                term = own[x] + share * values[x] * values[x]
                noise[x] = term if term > least else least


@njit(cache=True, nogil=True, error_model="numpy", boundscheck=False)
def _load_features(f: Floats, scale: Floats, features: Floats, top: int, left: int) -> None:
    """Load the centre's features `f`, and the factor from squared difference to distance."""
    planes, h, w = f.shape
    height, width = features.shape[:2]
    _load(f, features, top, left)
    for y in range(h):
        up, down = features[max(top + y - 1, 0)], features[min(top + y + 1, height - 1)]
        here = features[top + y]
        for x in range(w):
            sx = left + x
            before, after = max(sx - 1, 0), min(sx + 1, width - 1)
            for c in range(planes):
                gx, gy = here[after, c] - here[before, c], down[sx, c] - up[sx, c]
                tolerance = max(np.float32(0.25) * (gx * gx + gy * gy), np.float32(_FEATURE_FLOOR))
                scale[c, y, x] = 1 / tolerance


@njit(cache=True, nogil=True, error_model="numpy", boundscheck=False)
def _weigh(
    weight: Floats, column: Floats, least: Floats, trust: Floats, q: np.uintp, patch: int, norm: np.float32
) -> None:
    """Write the weights of a row of taps: patch distance from the column sums, at least `least`."""
    size = np.uintp(weight.size)
    weight[:] = 0
    for n in range(np.uintp(2 * patch + 1)):
        for x in range(size):
            weight[x] += column[n + x]
    for x in range(size):
        d = weight[x] * norm
        d = d if d > least[x] else least[x]
        # (1 - d/16)^16 is e^-d to the precision needed, and vectorises
        e = np.float32(1) - d * np.float32(1 / _NEVER)
        e = e if e > np.float32(0) else np.float32(0)
        e *= e
        e *= e
        e *= e
        weight[x] = e * e * trust[q + x]


@njit(cache=True, nogil=True, error_model="numpy", boundscheck=False)
def _filter(first: int, last: int, given: _Inputs, radius: int, patch: int, k: np.float32, out: Floats) -> None:
    """Filter the tiles from `first` to `last`, which are counted along rows of tiles."""
    H, W, channels = out.shape
    columns, centre = -(-W // _TILE_WIDTH), given.window[len(given.window) // 2]
    for tile in range(first, last):
        top, left = tile // columns * BAND, tile % columns * _TILE_WIDTH
        bottom, right = min(top + BAND, H), min(left + _TILE_WIDTH, W)
        begin, end = right, left
        for y in range(top, bottom):
            for x in range(left, right):
                for c in range(channels):
                    out[y, x, c] = centre[y, x, c]
                if given.where[y, x]:
                    begin, end = min(begin, x), max(end, x + 1)
        if begin < end:
            begin, end = max(begin - _PAD, left), min(end + _PAD, right)
            _filter_tile(given, radius, patch, k, (top, begin), out[top:bottom, begin:end])


@njit(cache=True, nogil=True, error_model="numpy", boundscheck=False, inline="always")
def _filter_tile(given: _Inputs, radius: int, patch: int, k: np.float32, corner: tuple[int, int], out: Floats) -> None:
    """Average all taps of the tile at `corner`."""
    T, F, (th, tw, C), margin = len(given.window), given.features.shape[2], out.shape, radius + patch
    h, w, top, left = th + 2 * margin, tw + 2 * margin, corner[0] - margin, corner[1] - margin
    trust = np.empty((h, w), np.float32)
    features, scale = np.empty((F, th, tw), np.float32), np.empty((F, th, tw), np.float32)
    centre = _Tile(np.empty((C, h, w), np.float32), np.empty((C, h, w), np.float32), features, trust)
    padded = np.empty((F, h, w), np.float32)
    frame = _Tile(np.empty((C, h, w), np.float32), np.empty((C, h, w), np.float32), padded, trust)
    total, weight = np.zeros((C, th, tw), np.float32), np.zeros((th, tw), np.float32)
    variance = np.empty((C, h, w), np.float32)
    _load(variance, given.variance, top, left)
    variance *= k * k
    _load_frame(centre, variance, given.window[T // 2], given.confidence[T // 2], top, left)
    _load_features(features, scale, given.features, corner[0], corner[1])
    _load(padded, given.features, top, left)
    for t in range(T):
        _load_frame(frame, variance, given.window[t], given.confidence[t], top, left)
        for dy in range(-radius, radius + 1):
            for dx in range(-radius, radius + 1):
                _add_taps(centre, frame, scale, patch, (dy, dx), k, total, weight)
    for y in range(th):
        for x in range(tw):
            for c in range(C):
                mean = total[c, y, x] / weight[y, x] if weight[y, x] > 0 else np.float32(0)
                out[y, x, c] = centre.values[c, y + margin, x + margin] + mean


@njit(cache=True, nogil=True, error_model="numpy", boundscheck=False, inline="always")
def _add_taps(
    centre: _Tile, frame: _Tile, scale: Floats, patch: int, step: tuple[int, int], k: np.float32, total: Floats,
    weight: Floats,
) -> None:  # fmt: skip
    """Add the taps of one frame at the offset `step` to all pixels of a tile."""
    C, th, tw = total.shape
    h, w = frame.trust.shape
    margin, size = (h - th) // 2, 2 * patch + 1
    cancel, far, norm = np.float32(1 / (k * k)), np.float32(_FAR / (k * k)), np.float32(1 / (C * size**2))
    ring, column = np.zeros((size, tw + 2 * patch), np.float32), np.zeros(tw + 2 * patch, np.float32)
    beyond, tap = np.empty((size, tw + 2 * patch), np.float32), np.empty(tw, np.float32)
    own, own_noise = centre.values.reshape(-1), centre.noise.reshape(-1)
    other, other_noise, trust = frame.values.reshape(-1), frame.noise.reshape(-1), frame.trust.reshape(-1)
    sums, weights = total.reshape(-1), weight.reshape(-1)
    shift = step[0] * w + step[1]
    for y in range(-patch, th + patch):
        # The running sums over the columns of patches, with one row of distances replaced.
        row, distance = ring[(y + patch) % size], beyond[(y + patch) % size]
        for x in range(np.uintp(row.size)):
            column[x] -= row[x]
            row[x] = distance[x] = 0
        for c in range(C):
            p = (c * h + y + margin) * w + margin - patch
            q = np.uintp(p + shift)
            _add_color_distance(row, distance, own, own_noise, np.uintp(p), other, other_noise, q, cancel, far)
        for x in range(np.uintp(row.size)):
            column[x] += row[x]
        oy = y - patch
        if oy < 0:
            continue
        distance = beyond[(oy + patch) % size, patch : patch + tw]
        qy, left = oy + margin + step[0], margin + step[1]
        for f in range(len(scale)):
            there = frame.features[f, qy, left : left + tw]
            _max_feature_distance(distance, centre.features[f, oy], there, scale[f, oy])
        p, out = (oy + margin) * w + margin, oy * tw
        _weigh(tap, column, distance, trust, np.uintp(p + shift), patch, norm)
        for x in range(np.uintp(tw)):
            weights[np.uintp(out) + x] += tap[x]
        for c in range(C):
            q = np.uintp(p + shift + c * h * w)
            _accumulate(sums, np.uintp(out + c * th * tw), tap, other, q, own, np.uintp(p + c * h * w))
