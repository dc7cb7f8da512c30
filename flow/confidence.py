"""Confidence of warped pixels, and the mix with the centre where confidence is low."""

from __future__ import annotations

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
    warped_albedo: np.ndarray | None = None,
    normal: np.ndarray | None = None,
    warped_normal: np.ndarray | None = None,
    first_row: int = 0,
) -> np.ndarray:
    """Estimate how far each pixel of a warped neighbour shows the same as the centre.

    Parameters
    ----------
    flow : (H, W, 2) float array, pixels, finite, centre to neighbour
    inside : (H, W) bool array
        From `flow.warp.warp`; False also where the vector, or a pixel it leads to, is invalid.
    reverse : (H, W, 2) float array, optional
        Pixels, neighbour to centre; always of the whole frame, also where the other arrays are a part of its rows.
    albedo, warped_albedo : (H, W) or (H, W, C) float array, optional
        Of the centre and the warped neighbour, both or none; likewise the normals.
    normal, warped_normal : (H, W, 3) float array, optional
        In any one space, of any length, 0 where there is no surface.
    first_row : int, the frame's row that the first row of `flow` belongs to

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
    pairs = {"albedo": (albedo, warped_albedo), "normal": (normal, warped_normal)}
    for name, (centre, warped) in pairs.items():
        if (centre is None) != (warped is None):
            raise ValueError(f"{name} and warped_{name} come together, got only one of them")
        if centre is not None and warped is not None and (centre.shape != warped.shape or centre.shape[:2] != shape):
            raise ValueError(f"{name} has shape {centre.shape}, warped_{name} {warped.shape}, expected both {shape}")
    if inside.shape != shape:
        raise ValueError(f"inside has shape {inside.shape}, expected {shape}")

    confidence = np.empty(shape, np.float32)
    absent = np.empty((0, 0, 0), np.float32)
    layers = [
        tuple(absent if x is None else np.ascontiguousarray(x, np.float32).reshape(*x.shape[:2], -1) for x in pair)
        for pair in ((flow, reverse), (albedo, warped_albedo), (normal, warped_normal))
    ]
    run_bands(_agree, shape[0], np.ascontiguousarray(inside, np.bool_), *layers, first_row, confidence)
    return cv2.erode(confidence, np.ones((3, 3), np.uint8)).reshape(shape)


@njit(nogil=True, cache=True, error_model="numpy")
def _agree(
    first: int, last: int, inside: np.ndarray, flows: _Pair, albedos: _Pair, normals: _Pair, first_row: int,
    out: np.ndarray,
) -> None:  # fmt: skip
    """Multiply the agreement of motion, albedo and normal; layers of size 0 are left out."""
    flow, reverse = flows
    albedo, warped_albedo = albedos
    normal, warped_normal = normals
    one = np.float32(1)
    for y in range(first, last):
        for x in range(out.shape[1]):
            out[y, x] = 0
            if not inside[y, x]:
                continue
            u, v = flow[y, x, 0], flow[y, x, 1]
            if reverse.size:
                height, width = reverse.shape[:2]
                place = locate(np.float32(x) + u, np.float32(first_row + y) + v, width, height)
                weights = weigh(place)
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
                    a, b = albedo[y, x, c], warped_albedo[y, x, c]
                    difference += (a - b) ** 2
                    greatest = max(greatest, max(a, b))
                # Relative where the albedo is above 1 (emitters, sky).
                weight *= np.exp(-difference / (greatest * greatest * np.float32(_ALBEDO_SIGMA**2)))
            if normal.size:
                square, warped_square, product = np.float32(0), np.float32(0), np.float32(0)
                for c in range(normal.shape[2]):
                    a, b = normal[y, x, c], warped_normal[y, x, c]
                    square += a * a
                    warped_square += b * b
                    product += a * b
                # Below a tenth of the samples on a surface, the direction is that of a stray sample.
                surface, warped_surface = square > np.float32(0.01), warped_square > np.float32(0.01)
                if surface and warped_surface:
                    cosine = product / np.sqrt(max(square * warped_square, np.float32(1e-4)))
                    weight *= min(max((cosine - np.float32(0.8)) / np.float32(0.2), np.float32(0)), one)
                elif surface != warped_surface:
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
