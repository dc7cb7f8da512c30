"""Confidence of warped pixels, and the mix with the centre where confidence is low."""

from typing import NamedTuple

import cv2
import numpy as np
from numba import njit

from flow.warp import ends_inside, interpolate_row, locate_row, warp, weigh_whole
from loops.decay import decay
from loops.parallel import STRIP, run_bands

# Difference of albedo (norm over channels) at which the confidence falls to 1/e.
ALBEDO_SIGMA = 0.1
# Squared difference of unit normals at which the confidence falls to 0: of a cosine of 0.8.
_NORMAL_LIMIT = np.float32(0.4)
# How much of the squared difference from a neighbour is subtracted from the variance around a pixel: three times what
# noise adds to it. Where guides are all noise, as behind a lens, this leaves no outlines.
_NOISE_IN_VARIANCE = 1.4
# Least variance of an outline: half floats and textures of a few shades have less.
_LEAST_VARIANCE = np.float32(1e-4)
# Measured noise counts up to this: at 8 samples it is 0.05 to 0.15. With 0.15 a shot through a lens, whose guides hold
# more, loses 0.2 dB at 32 samples.
NOISE_LIMIT = 0.05
# Fewest pixels of outlines from which noise is measured.
_FEWEST = 50
# A difference of so many times the measured noise is no noise: few pixels have most of it. With 20 and 80 in place of
# 40 ten shots of 8 samples gain 0.02 dB less and as much.
_UNLIKELY = 40.0
# Difference of guides that is no noise: of unit normals that are opposite.
_LARGEST = np.float32(4)
# Squared length of a normal on a surface: below a tenth of the samples on one, its direction is that of a stray sample.
_SURFACE = np.float32(0.01)

_Pair = tuple[np.ndarray, np.ndarray]


class GuideNoise(NamedTuple):
    """Noise of a frame's guides at outlines, where few samples fall on either side by chance."""

    variance: np.ndarray  # (H, W, 2): variance of albedo and normal in 3×3 pixels, from `local_variance`
    share: tuple[float, float]  # squared difference of two frames, in units of it, from `measure_share`


def estimate_confidence(
    flow: np.ndarray,
    *,
    inside: np.ndarray,
    reverse: np.ndarray | None = None,
    albedo: np.ndarray | None = None,
    other_albedo: np.ndarray | None = None,
    normal: np.ndarray | None = None,
    other_normal: np.ndarray | None = None,
    first_row: int = 0,
    noise: GuideNoise | None = None,
) -> np.ndarray:
    """Estimate how far a neighbour shows the same as the centre at the end of each vector.

    Parameters
    ----------
    flow : (H, W, 2) float array, pixels, finite, centre to neighbour
    inside : (H, W) bool array, from `find_coverage`
    reverse : (H, W, 2) float array, optional, pixels, neighbour to centre
    albedo, other_albedo : (H, W, C) float array, optional
        Guides of the centre and the neighbour, both or none; likewise the normals.
    normal, other_normal : (H, W, 3) float array, optional, in any one space, of any length, 0 where there is no surface
    first_row : int
        The frame's row that the first row of `flow` belongs to, where the arrays of the centre are some of its rows;
        those of the neighbour are always of the whole frame.
    noise : GuideNoise, optional
        Noise of the centre's guides; None: no noise.

    Returns
    -------
    (H, W) float32 array
        In [0, 1]. Non-finite guides give 0.

    Notes
    -----
    inside · [|f + r|² < 0.01 (|f|² + |r|²) + 0.5] · exp(−D(Δa) / 0.1²) · max(1 − D(Δn) / 0.4, 0), then the minimum of
    3 x 3 pixels, because the border of an occlusion holds a mix. Δa is divided by the albedo where that is above 1, Δn
    is the difference of unit normals. Shadows and reflections, which move without the geometry, are not detected.

    D(Δ) = max(|Δ|² − 40 s b max(V − 1.4 K[|Δ|²], 0), 0), with V the variance of the guide in 3×3 pixels, s the `share`
    of the noise in it, K the mean of 3×3 pixels, and b 1 at whole pixels, 0 from an eighth of a pixel on: pixels of an
    outline differ from frame to frame by their samples, which took half of the confidence of textured objects at 8
    samples. Between pixels they differ by the interpolation, and the bundled shot would lose 0.1 to 0.3 dB.

    References
    ----------
    Sundaram, Brox, Keutzer: Dense point trajectories by GPU-accelerated large displacement optical flow. 2010.
    doi:10.1007/978-3-642-15549-9_32
    """
    flow, inside = (np.ascontiguousarray(x, t) for x, t in ((flow, np.float32), (inside, np.bool_)))
    distance = compare_guides(
        flow,
        inside=inside,
        albedo=albedo,
        other_albedo=other_albedo,
        normal=normal,
        other_normal=other_normal,
        first_row=first_row,
    )
    confidence = np.empty(flow.shape[:2], np.float32)
    back = np.empty((0, 0, 2), np.float32) if reverse is None else np.ascontiguousarray(reverse, np.float32)
    share = np.zeros(2, np.float32) if noise is None else np.array(noise.share, np.float32)
    outlines = outline_variance(noise.variance, distance) if noise is not None and share.any() else distance
    share *= np.float32(_UNLIKELY)
    whole = (len(layer) for layer in (reverse, other_albedo, other_normal) if layer is not None)
    height = max(whole, default=first_row + len(flow))
    run_bands(_agree, len(confidence), inside, flow, back, distance, outlines, share, first_row, height, confidence)
    return cv2.erode(confidence, np.ones((3, 3), np.uint8)).reshape(confidence.shape)


def compare_guides(
    flow: np.ndarray,
    *,
    inside: np.ndarray,
    albedo: np.ndarray | None = None,
    other_albedo: np.ndarray | None = None,
    normal: np.ndarray | None = None,
    other_normal: np.ndarray | None = None,
    first_row: int = 0,
) -> np.ndarray:
    """Squared differences of albedo and of unit normals at the end of each vector, (H, W, 2) float32, at most 4.

    Takes the arrays of `estimate_confidence`. A missing guide differs by 0; where a guide is not finite, or one frame
    alone has a surface, the difference is 4. Raises ValueError if the shapes do not agree.
    """
    shape = flow.shape[:2]
    if flow.ndim != 3 or flow.shape[2] != 2:
        raise ValueError(f"flow has shape {flow.shape}, expected (H, W, 2)")
    pairs = {"albedo": (albedo, other_albedo), "normal": (normal, other_normal)}
    for name, (centre, other) in pairs.items():
        if (centre is None) != (other is None):
            raise ValueError(f"{name} and other_{name} come together, got only one of them")
        if centre is not None and other is not None:
            if centre.shape[:2] != shape or centre.shape[1:] != other.shape[1:]:
                raise ValueError(
                    f"{name} has shape {centre.shape}, other_{name} {other.shape}, expected that of {shape}"
                )
            if not first_row + shape[0] <= len(other):
                raise ValueError(f"other_{name} has {len(other)} rows, expected at least {first_row + shape[0]}")
    if inside.shape != shape:
        raise ValueError(f"inside has shape {inside.shape}, expected {shape}")
    absent = np.empty((0, 0, 0), np.float32)
    layers = [
        tuple(absent if x is None else np.ascontiguousarray(x, np.float32).reshape(*x.shape[:2], -1) for x in pair)
        for pair in pairs.values()
    ]
    distance = np.empty((*shape, 2), np.float32)
    vectors, covered = np.ascontiguousarray(flow, np.float32), np.ascontiguousarray(inside, np.bool_)
    run_bands(_compare, shape[0], covered, vectors, *layers, first_row, distance)
    return distance


def local_variance(albedo: np.ndarray | None, normal: np.ndarray | None) -> np.ndarray:
    """Variance of albedo and of unit normals (H, W, C) in 3×3 pixels, summed over channels, (H, W, 2) float32.

    That of an albedo above 1 is relative, as in `compare_guides`; that of a missing guide is 0. Values that are not
    finite, or beyond 1e15, count as 0. Raises ValueError without any guide.
    """
    given = albedo if albedo is not None else normal
    if given is None:
        raise ValueError("albedo and normal: expected at least one of them, got none")
    variance = np.zeros((*given.shape[:2], 2), np.float32)
    for index, guide in enumerate((albedo, normal)):
        if guide is not None:
            run_bands(_spread, len(variance), np.ascontiguousarray(guide, np.float32), index == 0, variance[..., index])
    return variance


def outline_variance(variance: np.ndarray, distance: np.ndarray) -> np.ndarray:
    """Variance (H, W, 2) of the guides without the noise's part, estimated from the `distance` to a neighbour."""
    outlines = np.asarray(cv2.blur(distance, (3, 3)), np.float32).reshape(distance.shape)
    outlines *= np.float32(-_NOISE_IN_VARIANCE)
    outlines += variance
    return np.maximum(outlines, 0, out=outlines)


def measure_share(outlines: np.ndarray, distance: np.ndarray, inside: np.ndarray) -> tuple[float, float]:
    """Measure the noise of guides at outlines: squared differences of two frames over the variance, in [0, 0.05].

    Σ min(|Δ|², V) / Σ V over pixels inside (H, W), V their `outline_variance` where it is that of an outline; about
    1 / N with N samples per pixel. 0 where there are few outlines.
    """
    shares = []
    for spread, difference in zip(np.moveaxis(outlines, -1, 0), np.moveaxis(distance, -1, 0), strict=True):
        known = inside & (spread > _LEAST_VARIANCE)
        spread, difference = spread[known], difference[known]
        share = np.minimum(difference, spread).sum() / spread.sum() if len(spread) > _FEWEST else 0
        shares.append(min(float(share), NOISE_LIMIT))
    return shares[0], shares[1]


def find_coverage(flow: np.ndarray, valid: np.ndarray, measured: np.ndarray, first_row: int = 0) -> np.ndarray:
    """Find where valid vectors end in the frame, at pixels that have all been measured: (H, W) bool.

    The flow (h, W, 2), pixels, and its validity are those of rows of the centre from `first_row` on, `measured` (H, W)
    is of the whole neighbour.
    """
    if not measured.all():
        # A pixel of which less than all is finite color is not measured.
        share, inside = warp(measured, flow, first_row=first_row)
        return np.asarray(valid & inside & (share > np.float32(0.999)))
    covered = np.empty(valid.shape, np.bool_)
    for top in range(0, len(flow), STRIP):
        rows = slice(top, top + STRIP)
        covered[rows] = valid[rows] & ends_inside(flow[rows], measured.shape, first_row + top)
    return covered


def fill_uncovered(warped: np.ndarray, centre: np.ndarray, coverage: np.ndarray) -> None:
    """Write the centre's pixels (H, W, C) into a warped picture, in place, where its coverage (H, W) is 0."""
    cv2.copyTo(np.ascontiguousarray(centre), (coverage == 0).view(np.uint8), warped)


@njit(nogil=True, cache=True, error_model="numpy")
def _spread(first: int, last: int, guide: np.ndarray, is_albedo: bool, out: np.ndarray) -> None:
    """Write variances in 3×3 pixels, mirrored at borders, over the square of the albedo above 1 or of the normal."""
    height, width, channels = guide.shape
    ninth, size = np.float32(1 / 9), np.uintp(width)
    rows = np.empty((3, channels, width + 2), np.float32)
    spread, greatest, square = np.empty(width, np.float32), np.empty(width, np.float32), np.empty(width, np.float32)
    for y in range(first, last):
        for k, row in enumerate((min(abs(y - 1), height - 1), y, min(y + 1, max(2 * height - 3 - y, 0)))):
            # By planes: several pixels are computed at once.
            for c in range(channels):
                plane = rows[k, c]
                for x in range(width):
                    value = guide[row, x, c]
                    # Its square would overflow, or it is not finite.
                    plane[x + 1] = value if abs(value) < np.float32(1e15) else np.float32(0)
                plane[0], plane[width + 1] = plane[min(2, width)], plane[max(width - 1, 1)]
        spread[:], greatest[:], square[:] = 0, 1, 0
        for c in range(channels):
            a, b, d = rows[0, c], rows[1, c], rows[2, c]
            for x in range(size):
                total = a[x] + a[x + 1] + a[x + 2] + b[x] + b[x + 1] + b[x + 2] + d[x] + d[x + 1] + d[x + 2]
                mean, found = total * ninth, spread[x]
                found += (a[x] - mean) ** 2
                found += (a[x + 1] - mean) ** 2
                found += (a[x + 2] - mean) ** 2
                found += (b[x] - mean) ** 2
                found += (b[x + 1] - mean) ** 2
                found += (b[x + 2] - mean) ** 2
                found += (d[x] - mean) ** 2
                found += (d[x + 1] - mean) ** 2
                spread[x] = found + (d[x + 2] - mean) ** 2
                greatest[x] = max(greatest[x], b[x + 1])
                square[x] += b[x + 1] * b[x + 1]
        for x in range(width):
            scale = greatest[x] * greatest[x] if is_albedo else max(square[x], _SURFACE)
            out[y, x] = spread[x] * ninth / scale


@njit(nogil=True, cache=True, error_model="numpy")
def _compare(
    first: int, last: int, inside: np.ndarray, flow: np.ndarray, albedos: _Pair, normals: _Pair, first_row: int,
    out: np.ndarray,
) -> None:  # fmt: skip
    """Write squared differences of albedo and of unit normals; layers of size 0 are left out."""
    albedo, other_albedo = albedos
    normal, other_normal = normals
    zero, one, infinite, width = np.float32(0), np.float32(1), np.float32(np.inf), out.shape[1]
    # All layers of the neighbour have its size, or none.
    height = max(len(other_albedo), len(other_normal), 1)
    colors, directions = np.empty((albedo.shape[2], width), np.float32), np.empty((normal.shape[2], width), np.float32)
    difference, greatest = np.empty(width, np.float32), np.empty(width, np.float32)
    squares, product = np.empty((2, width), np.float32), np.empty(width, np.float32)
    square, other_square = squares[0], squares[1]
    for y in range(first, last):
        places = locate_row(flow, y, (first_row, 0), width, height, width)
        out[y] = zero
        if albedo.size:
            interpolate_row(other_albedo, places, colors)
            difference[:], greatest[:] = zero, one
            for c in range(albedo.shape[2]):
                other = colors[c]
                for x in range(width):
                    a, b = albedo[y, x, c], other[x]
                    difference[x] += (a - b) ** 2
                    greatest[x] = max(greatest[x], max(a, b))
            for x in range(width):
                # Relative where the albedo is above 1 (emitters, sky).
                found = difference[x] / (greatest[x] * greatest[x])
                found = found if found < _LARGEST else _LARGEST  # not where a guide is not finite
                out[y, x, 0] = found if inside[y, x] else zero
        if normal.size:
            interpolate_row(other_normal, places, directions)
            squares[:], product[:] = zero, zero
            for c in range(normal.shape[2]):
                other = directions[c]
                for x in range(width):
                    a, b = normal[y, x, c], other[x]
                    square[x] += a * a
                    other_square[x] += b * b
                    product[x] += a * b
            for x in range(width):
                surface, other_surface = square[x] > _SURFACE, other_square[x] > _SURFACE
                length = np.sqrt(max(square[x] * other_square[x], np.float32(1e-4)))
                bent = np.float32(2) * (one - product[x] / length)
                bent = bent if bent < _LARGEST else _LARGEST
                known = (surface == other_surface) & (square[x] + other_square[x] < infinite)
                alone = zero if known else _LARGEST
                out[y, x, 1] = (bent if surface & other_surface else alone) if inside[y, x] else zero


@njit(nogil=True, cache=True, error_model="numpy")
def _agree(
    first: int, last: int, inside: np.ndarray, flow: np.ndarray, reverse: np.ndarray, distance: np.ndarray,
    outlines: np.ndarray, share: np.ndarray, first_row: int, height: int, out: np.ndarray,
) -> None:  # fmt: skip
    """Multiply the agreement of motion, albedo and normal; the reverse flow is left out if it has no rows."""
    zero, one, width = np.float32(0), np.float32(1), out.shape[1]
    back, near = np.empty((2, width), np.float32), np.empty(width, np.bool_)
    painted, bent, paint, bend = np.empty(width, np.float32), np.empty(width, np.float32), share[0], share[1]
    for y in range(first, last):
        places = locate_row(flow, y, (first_row, 0), width, height, width)
        near[:] = True
        if reverse.size:
            interpolate_row(reverse, places, back)
            for x in range(width):
                # Sundaram's test: there and back ends near the start.
                u, v = flow[y, x, 0], flow[y, x, 1]
                du, dv = back[0, x] + u, back[1, x] + v
                error = np.sqrt(du * du + dv * dv)
                # The loop is f + r, so r at the arrival is about -f within the error: |r| is |f| + error at most.
                length = np.sqrt(u * u + v * v)
                near[x] = error**2 < np.float32(0.01) * (length**2 + (length + error) ** 2) + np.float32(0.5)
        for x in range(width):
            whole = weigh_whole(places.fx[x], places.fy[x])
            painted[x] = max(distance[y, x, 0] - whole * paint * outlines[y, x, 0], zero)
            bent[x] = max(distance[y, x, 1] - whole * bend * outlines[y, x, 1], zero)
            near[x] &= max(distance[y, x, 0], distance[y, x, 1]) < _LARGEST
        for x in range(width):
            weight = max(one - bent[x] / _NORMAL_LIMIT, zero) * decay(painted[x] / np.float32(ALBEDO_SIGMA**2))
            out[y, x] = weight if near[x] & inside[y, x] else zero


def mix_centre(
    warped: np.ndarray, centre: np.ndarray, confidence: np.ndarray, out: np.ndarray | None = None
) -> np.ndarray:
    """Return c · warped + (1 − c) · centre as float32: exactly the centre where c is 0, whatever `warped` holds there.

    Parameters
    ----------
    warped, centre : (H, W) or (H, W, C) float array
    confidence : (H, W) float array, in [0, 1]
    out : float32 array, optional, contiguous, for the result
    """
    if warped.shape != centre.shape or confidence.shape != centre.shape[:2]:
        raise ValueError(
            f"warped has shape {warped.shape}, confidence {confidence.shape}, expected those of centre, {centre.shape}"
        )
    mixed = np.empty(centre.shape, np.float32) if out is None else out
    mixed[...] = centre
    weight = np.asarray(confidence, np.float32).reshape(*confidence.shape, *[1] * (centre.ndim - 2))
    known = np.broadcast_to(weight > 0, mixed.shape)
    np.multiply(mixed, 1 - weight, out=mixed, where=known)
    np.add(mixed, np.multiply(weight, warped, where=known, out=np.zeros_like(mixed)), out=mixed, where=known)
    return mixed
