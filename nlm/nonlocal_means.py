"""Joint non-local means over an aligned window, steered by variance and features."""

from __future__ import annotations

import numpy as np
from numba import njit
from numpy.typing import NDArray

from loops.parallel import run_bands

Floats = NDArray[np.float32]
Mask = NDArray[np.bool_]

# The image is cut into tiles whose planes stay in the cache. Long rows, because every pass over a row
# costs as much again before its first pixel (64 wide: 2.5 times slower than 512).
_TILE_HEIGHT, _TILE_WIDTH = 32, 512
# A relative difference of 1e-3 is never told from noise: half floats are no finer (2^-11), and it keeps the
# colour distance finite where the variance is 0. Relative, so that the filter stays scale equivariant.
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
# A value that lies 28 deviations from the centre's is no tap: (u_p − u_q)² > 400 (V_p + V_q). A firefly so
# never leaks into its surroundings. Generous, because the tail of ordinary noise has to be averaged with
# the rest: at ten deviations it stayed, at a cost of up to 0.4 dB against references of three Cycles shots.
_FAR = 400.0
# From this distance on a weight is 0.
_NEVER = 16.0


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
        Aligned frames, linear irradiance (or radiance), in any unit; the centre is ``T // 2``. Non-finite values are
        left out.
    variance : (H, W, C) float32
        Variance of the centre's values, in squared units, smoothed. It serves all frames.
    features : (H, W, F) float32, optional
        The centre's albedo, normal, depth …, of about unit range and prefiltered: see `prefilter_guide`. The frames are
        aligned, so they serve all of them.
    confidence : (T, H, W) float32, optional
        Trust in each pixel of each frame, in [0, 1]; 1 if not given.
    radius, patch_radius : int
        Of the search, and of the patches that are compared, in pixels.
    k : float
        Strength of the colour distance: more smooths more.
    where : (H, W) bool, optional
        Pixels that call for it; a tile without any stays as the centre is.

    Returns
    -------
    (H, W, C) float32
        The filtered centre frame: at every pixel a convex combination of values of the window. Where no value
        is trusted, the centre's own, or 0 where it is not finite.

    Raises
    ------
    ValueError
        If a shape does not fit, or a parameter is out of its range.

    Notes
    -----
    For pixels p of the centre and q of the window, u the values and V their variance::

        d(p, q) = ((u_p − u_q)² − (V_p + min(V_p, V_q))) / (k² (V_p + V_q))    averaged over patch and channels
        f(p, q) = max over features (f_p − f_q)² / max(|∇f_p|², 1e-3)
        w(p, q) = confidence_q · exp(−max(d, f, 0))

    A share of u² (1e-6 / k²) is added to V: no division by 0, and the filter stays scale equivariant. In a
    patch a pixel adds at most 25 to the distance; a value 28 deviations from the centre's gets no weight.
    So a firefly leaks nowhere, but stays: `reject_outliers` first. e^-d is (1 - d/16)^16, which vectorises.
    The sums down the columns of a patch are running ones, so its height costs nothing.

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
    tiles = -(-height // _TILE_HEIGHT) * -(-width // _TILE_WIDTH)
    given = window, variance, features, confidence, where, radius, patch_radius, np.float32(k)
    run_bands(_filter, tiles, *given, out)
    return out


@njit(cache=True, nogil=True, error_model="numpy", boundscheck=False)
def _add_color_distance(d: Floats, pu: Floats, pa: Floats, qu: Floats, qa: Floats, cancel: np.float32) -> None:
    for x in range(d.size):
        diff = pu[x] - qu[x]
        a, b = pa[x], qa[x]
        low = a if a < b else b
        v = (diff * diff - cancel * (a + low)) / (a + b)
        d[x] += v if v < np.float32(_PIXEL_CAP) else np.float32(_PIXEL_CAP)


@njit(cache=True, nogil=True, error_model="numpy", boundscheck=False)
def _max_feature_distance(d: Floats, pf: Floats, qf: Floats, scale: Floats) -> None:
    for x in range(d.size):
        diff = pf[x] - qf[x]
        v = diff * diff * scale[x]
        d[x] = v if v > d[x] else d[x]


@njit(cache=True, nogil=True, error_model="numpy", boundscheck=False)
def _reject_far(d: Floats, pu: Floats, pa: Floats, qu: Floats, qa: Floats, limit: np.float32) -> None:
    for x in range(d.size):
        diff = pu[x] - qu[x]
        d[x] = np.float32(_NEVER) if diff * diff > limit * (pa[x] + qa[x]) else d[x]


@njit(cache=True, nogil=True, error_model="numpy", boundscheck=False)
def _accumulate(total: Floats, w: Floats, values: Floats, centre: Floats) -> None:
    # The difference from the centre: hundreds of roundings of a sum would shift even a constant picture.
    for x in range(w.size):
        total[x] += w[x] * (values[x] - centre[x])


@njit(cache=True, nogil=True, boundscheck=False)
def _load(target: Floats, source: Floats, top: int, left: int) -> None:
    """Copy a tile of (H, W, C) into planes (C, h, w); beyond the frame the edge is repeated."""
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
def _load_frame(
    u: Floats,
    a: Floats,
    trust: Floats,
    frame: Floats,
    variance: Floats,
    confidence: Floats,
    k: np.float32,
    top: int,
    left: int,
) -> None:
    """Load values `u`, their noise term `a` and the weight `trust` of each tap, 0 outside the frame."""
    channels, h, w = u.shape
    height, width = confidence.shape
    _load(u, frame, top, left)
    _load(a, variance, top, left)
    trust[:] = 0
    for y in range(max(-top, 0), min(height - top, h)):
        for x in range(max(-left, 0), min(width - left, w)):
            trust[y, x] = confidence[top + y, left + x]
    for c in range(channels):
        for y in range(h):
            for x in range(w):
                value = u[c, y, x]
                if not abs(value) < _HUGE:
                    u[c, y, x] = value = np.float32(0)
                    trust[y, x] = np.float32(0)
                noise = k * k * a[c, y, x] + np.float32(_RELATIVE_VARIANCE) * value * value
                a[c, y, x] = noise if noise > np.float32(_TINY) else np.float32(_TINY)


@njit(cache=True, nogil=True, error_model="numpy", boundscheck=False)
def _load_features(f: Floats, scale: Floats, features: Floats, top: int, left: int) -> None:
    """Load the centre's features `f`, and what turns a squared difference into a distance."""
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
def _filter(
    first: int, last: int, window: Floats, variance: Floats, features: Floats, confidence: Floats, where: Mask,
    radius: int, patch: int, k: np.float32, out: Floats,
) -> None:  # fmt: skip
    """Filter the tiles from `first` to `last`, which are counted along rows of tiles."""
    T, H, W, C = window.shape
    F = features.shape[2]
    centre = T // 2
    columns = -(-W // _TILE_WIDTH)
    cancel, far = np.float32(1 / (k * k)), np.float32(_FAR / (k * k))
    norm = np.float32(1 / (C * (2 * patch + 1) ** 2))
    for tile in range(first, last):
        y0, x0 = tile // columns * _TILE_HEIGHT, tile % columns * _TILE_WIDTH
        th, tw = min(_TILE_HEIGHT, H - y0), min(_TILE_WIDTH, W - x0)
        if not where[y0 : y0 + th, x0 : x0 + tw].any():
            out[y0 : y0 + th, x0 : x0 + tw] = window[centre, y0 : y0 + th, x0 : x0 + tw]
            continue
        pw = tw + 2 * patch
        margin = radius + patch
        h, w = th + 2 * margin, tw + 2 * margin
        top, left = y0 - margin, x0 - margin
        pu, pa = np.empty((C, h, w), np.float32), np.empty((C, h, w), np.float32)
        qu, qa = np.empty((C, h, w), np.float32), np.empty((C, h, w), np.float32)
        trust = np.empty((h, w), np.float32)
        pf, qf = np.empty((F, th, tw), np.float32), np.empty((F, h, w), np.float32)
        fs = np.empty((F, th, tw), np.float32)
        total, weight = np.zeros((C, th, tw), np.float32), np.zeros((th, tw), np.float32)
        ring = np.empty((2 * patch + 1, pw), np.float32)
        column, wrow, frow = np.empty(pw, np.float32), np.empty(tw, np.float32), np.empty(tw, np.float32)
        _load_frame(pu, pa, trust, window[centre], variance, confidence[centre], k, top, left)
        _load_features(pf, fs, features, y0, x0)
        _load(qf, features, top, left)
        for t in range(T):
            _load_frame(qu, qa, trust, window[t], variance, confidence[t], k, top, left)
            for dy in range(-radius, radius + 1):
                for dx in range(-radius, radius + 1):
                    column[:] = 0
                    ring[:] = 0
                    for y in range(-patch, th + patch):
                        row = ring[(y + patch) % (2 * patch + 1)]
                        for x in range(pw):
                            column[x] -= row[x]
                            row[x] = 0
                        py, qy, qx = y + margin, y + margin + dy, radius + dx
                        for c in range(C):
                            _add_color_distance(
                                row,
                                pu[c, py, radius : radius + pw],
                                pa[c, py, radius : radius + pw],
                                qu[c, qy, qx : qx + pw],
                                qa[c, qy, qx : qx + pw],
                                cancel,
                            )
                        for x in range(pw):
                            column[x] += row[x]
                        oy = y - patch
                        if oy < 0:
                            continue
                        qy, qx = oy + margin + dy, margin + dx
                        wrow[:] = 0
                        for n in range(2 * patch + 1):
                            for x in range(tw):
                                wrow[x] += column[x + n]
                        frow[:] = 0
                        for f in range(F):
                            _max_feature_distance(frow, pf[f, oy], qf[f, qy, qx : qx + tw], fs[f, oy])
                        for c in range(C):
                            _reject_far(
                                frow,
                                pu[c, oy + margin, margin : margin + tw],
                                pa[c, oy + margin, margin : margin + tw],
                                qu[c, qy, qx : qx + tw],
                                qa[c, qy, qx : qx + tw],
                                far,
                            )
                        trow = trust[qy, qx : qx + tw]
                        for x in range(tw):
                            d = wrow[x] * norm
                            d = d if d > frow[x] else frow[x]
                            # (1 - d/16)^16 is e^-d for all that matters, and vectorises
                            e = np.float32(1) - d * np.float32(1 / _NEVER)
                            e = e if e > np.float32(0) else np.float32(0)
                            e *= e
                            e *= e
                            e *= e
                            wrow[x] = e * e * trow[x]
                        for x in range(tw):
                            weight[oy, x] += wrow[x]
                        for c in range(C):
                            middle = pu[c, oy + margin, margin : margin + tw]
                            _accumulate(total[c, oy], wrow, qu[c, qy, qx : qx + tw], middle)
        for y in range(th):
            for x in range(tw):
                for c in range(C):
                    if weight[y, x] > 0:
                        out[y0 + y, x0 + x, c] = pu[c, y + margin, x + margin] + total[c, y, x] / weight[y, x]
                    else:
                        out[y0 + y, x0 + x, c] = pu[c, y + margin, x + margin]
