"""Confidence of warped pixels, and the mix with the centre where confidence is low."""

import cv2
import numpy as np
from numba import njit

from flow.warp import interpolate, locate, weigh
from loops.parallel import run_bands

# Difference of albedo (norm over channels) at which the confidence falls to 1/e.
_ALBEDO_SIGMA = 0.1

_Pair = tuple[np.ndarray, np.ndarray]


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
) -> np.ndarray:
    """Estimate how far a neighbour shows the same as the centre at the end of each vector.

    Parameters
    ----------
    flow : (H, W, 2) float array, pixels, finite, centre to neighbour
    inside : (H, W) bool array, from `find_coverage`
    reverse : (H, W, 2) float array, optional, pixels, neighbour to centre
    albedo, other_albedo : (H, W, C) float array, optional
        Of the centre and the neighbour, both or none; likewise the normals.
    normal, other_normal : (H, W, 3) float array, optional, in any one space, of any length, 0 where there is no surface
    first_row : int
        The frame's row that the first row of `flow` belongs to, where the arrays of the centre are some of its rows;
        those of the neighbour are always of the whole frame.

    Returns
    -------
    (H, W) float32 array
        In [0, 1]. Non-finite guides give 0.

    Notes
    -----
    inside · [|f + r|² < 0.01 (|f|² + |r|²) + 0.5] · exp(−‖Δa‖² / 0.1²) · clamp((n·n′ − 0.8) / 0.2), then
    the minimum of 3 x 3 pixels, because the border of an occlusion holds a mix. Δa is divided by the albedo where that
    is above 1. Shadows and reflections, which move without the geometry, are not detected.

    References
    ----------
    Sundaram, Brox, Keutzer: Dense point trajectories by GPU-accelerated large displacement optical flow. 2010.
    doi:10.1007/978-3-642-15549-9_32
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

    confidence = np.empty(shape, np.float32)
    absent = np.empty((0, 0, 0), np.float32)
    layers = [
        tuple(absent if x is None else np.ascontiguousarray(x, np.float32).reshape(*x.shape[:2], -1) for x in pair)
        for pair in ((flow, reverse), (albedo, other_albedo), (normal, other_normal))
    ]
    run_bands(_agree, shape[0], np.ascontiguousarray(inside, np.bool_), *layers, first_row, confidence)
    return cv2.erode(confidence, np.ones((3, 3), np.uint8)).reshape(shape)


def find_coverage(flow: np.ndarray, valid: np.ndarray, measured: np.ndarray, first_row: int = 0) -> np.ndarray:
    """Find where valid vectors end in the frame, at pixels that have all been measured: (H, W) bool.

    The flow (h, W, 2), pixels, and its validity are those of rows of the centre from `first_row` on, `measured` (H, W)
    is of the whole neighbour.
    """
    covered = np.empty(valid.shape, np.bool_)
    given = (np.ascontiguousarray(layer) for layer in (flow, valid, measured))
    run_bands(_cover, len(covered), *given, bool(measured.all()), first_row, covered)
    return covered


def fill_uncovered(warped: np.ndarray, centre: np.ndarray, coverage: np.ndarray) -> None:
    """Write the centre's pixels (H, W, C) into a warped picture, in place, where its coverage (H, W) is 0."""
    run_bands(_fill, len(warped), warped, np.ascontiguousarray(centre), coverage)


@njit(nogil=True, cache=True)
def _cover(
    first: int, last: int, flow: np.ndarray, valid: np.ndarray, measured: np.ndarray, whole: bool, first_row: int,
    out: np.ndarray,
) -> None:  # fmt: skip
    height, width = measured.shape
    for y in range(first, last):
        for x in range(width):
            place = locate(np.float32(x) + flow[y, x, 0], np.float32(first_row + y) + flow[y, x, 1], width, height)
            if whole:
                out[y, x] = valid[y, x] and place.inside
                continue
            x0, y0, x1, y1 = np.uintp(place.x0), np.uintp(place.y0), np.uintp(place.x1), np.uintp(place.y1)
            weights, share = weigh(place), np.float32(0)
            share += weights[0] if measured[y0, x0] else np.float32(0)
            share += weights[1] if measured[y0, x1] else np.float32(0)
            share += weights[2] if measured[y1, x0] else np.float32(0)
            share += weights[3] if measured[y1, x1] else np.float32(0)
            # A pixel of which less than all is finite color is not measured.
            out[y, x] = valid[y, x] and place.inside and share > np.float32(0.999)


@njit(nogil=True, cache=True)
def _fill(first: int, last: int, warped: np.ndarray, centre: np.ndarray, coverage: np.ndarray) -> None:
    for y in range(first, last):
        for x in range(coverage.shape[1]):
            if coverage[y, x] == 0:
                for c in range(warped.shape[2]):
                    warped[y, x, c] = centre[y, x, c]


@njit(nogil=True, cache=True, error_model="numpy")
def _agree(
    first: int, last: int, inside: np.ndarray, flows: _Pair, albedos: _Pair, normals: _Pair, first_row: int,
    out: np.ndarray,
) -> None:  # fmt: skip
    """Multiply the agreement of motion, albedo and normal; layers of size 0 are left out."""
    flow, reverse = flows
    albedo, other_albedo = albedos
    normal, other_normal = normals
    one = np.float32(1)
    # All layers of the neighbour have its size, or none.
    height = max(len(reverse), len(other_albedo), len(other_normal), 1)
    for y in range(first, last):
        for x in range(out.shape[1]):
            out[y, x] = 0
            if not inside[y, x]:
                continue
            u, v = flow[y, x, 0], flow[y, x, 1]
            place = locate(np.float32(x) + u, np.float32(first_row + y) + v, out.shape[1], height)
            weights = weigh(place)
            if reverse.size:
                # Sundaram's test: there and back ends near the start.
                du, dv = interpolate(reverse, 0, place, weights) + u, interpolate(reverse, 1, place, weights) + v
                error = np.sqrt(du * du + dv * dv)
                # The loop is f + r, so r at the arrival is about -f within the error: |r| is |f| + error at most.
                length = np.sqrt(u * u + v * v)
                bound = np.float32(0.01) * (length**2 + (length + error) ** 2) + np.float32(0.5)
                if not error**2 < bound:
                    continue
            weight = one
            if albedo.size:
                difference, greatest = np.float32(0), one
                for c in range(albedo.shape[2]):
                    a, b = albedo[y, x, c], interpolate(other_albedo, c, place, weights)
                    difference += (a - b) ** 2
                    greatest = max(greatest, max(a, b))
                # Relative where the albedo is above 1 (emitters, sky).
                weight *= np.exp(-difference / (greatest * greatest * np.float32(_ALBEDO_SIGMA**2)))
            if normal.size:
                square, other_square, product = np.float32(0), np.float32(0), np.float32(0)
                for c in range(normal.shape[2]):
                    a, b = normal[y, x, c], interpolate(other_normal, c, place, weights)
                    square += a * a
                    other_square += b * b
                    product += a * b
                # Below a tenth of the samples on a surface, the direction is that of a stray sample.
                surface, other_surface = square > np.float32(0.01), other_square > np.float32(0.01)
                if surface and other_surface:
                    cosine = product / np.sqrt(max(square * other_square, np.float32(1e-4)))
                    weight *= min(max((cosine - np.float32(0.8)) / np.float32(0.2), np.float32(0)), one)
                elif surface != other_surface:
                    continue
            if weight > 0:  # not where a guide is not finite
                out[y, x] = weight


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
    planes = (*centre.shape[:2], -1)
    warped, centre, confidence = (np.asarray(layer, np.float32) for layer in (warped, centre, confidence))
    layers = warped.reshape(planes), centre.reshape(planes), confidence, mixed.reshape(planes)
    run_bands(_mix, len(centre), *layers)
    return mixed


@njit(nogil=True, cache=True)
def _mix(
    first: int, last: int, warped: np.ndarray, centre: np.ndarray, confidence: np.ndarray, out: np.ndarray
) -> None:
    for y in range(first, last):
        for x in range(out.shape[1]):
            weight = confidence[y, x]
            for channel in range(out.shape[2]):
                out[y, x, channel] = centre[y, x, channel]
                if weight > 0:
                    out[y, x, channel] = weight * warped[y, x, channel] + (np.float32(1) - weight) * out[y, x, channel]
