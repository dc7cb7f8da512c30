"""How far a warped pixel may be trusted, and what stands in for it where it may not."""

from __future__ import annotations

from functools import reduce

import cv2
import numpy as np
from numba import njit

from flow.motion import forward_backward_error
from loops.cores import on_all_cores

# Difference of albedo (norm over channels) at which the confidence falls to 1/e.
_ALBEDO_SIGMA = 0.1


def _agree_forward_backward(flow: np.ndarray, reverse: np.ndarray, first_row: int) -> np.ndarray:
    """Sundaram's test: 1 where going there and back ends near the start."""
    error = forward_backward_error(flow, reverse, first_row=first_row)
    # The loop is f + r, so r at the arrival is about -f within the error: |r| is taken as |f| + error at most.
    length = np.hypot(flow[..., 0], flow[..., 1])
    return np.asarray(error**2 < 0.01 * (length**2 + (length + error) ** 2) + 0.5)


def _agree_albedo(albedo: np.ndarray, warped: np.ndarray) -> np.ndarray:
    """exp(-d² / σ²) of the difference, relative where the albedo is above 1 (emitters, sky)."""
    with np.errstate(over="ignore", invalid="ignore"):
        difference = np.atleast_3d(albedo - warped)
        # Plane by plane: several times faster than a reduction over so short an axis.
        planes = (image[..., c] for image in map(np.atleast_3d, (albedo, warped)) for c in range(image.shape[-1]))
        greatest = reduce(np.maximum, planes)
        scale = np.square(np.maximum(greatest, 1))
        return np.asarray(np.exp(-np.einsum("yxc,yxc->yx", difference, difference) / (scale * _ALBEDO_SIGMA**2)))


def _agree_normal(normal: np.ndarray, warped: np.ndarray) -> np.ndarray:
    """clamp((n·n' - 0.8) / 0.2) of the directions; 1 where neither has a surface, 0 where only one has."""
    square, warped_square, product = (
        np.einsum("yxc,yxc->yx", a, b) for a, b in ((normal, normal), (warped, warped), (normal, warped))
    )
    # Below a tenth of the samples on a surface, the direction is that of a stray sample.
    surface, warped_surface = square > 0.01, warped_square > 0.01
    cosine = product / np.sqrt(np.maximum(square * warped_square, 1e-4))
    agreement = np.clip((cosine - 0.8) / 0.2, 0, 1)
    return np.asarray(np.where(surface & warped_surface, agreement, surface == warped_surface))


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
    """Estimate how far each pixel of a warped neighbour shows what the centre shows.

    Parameters
    ----------
    flow : (H, W, 2) float array
        Pixels, finite, centre to neighbour.
    inside : (H, W) bool array
        As `flow.warp.warp` gives it; false also where the vector, or a pixel it leads to, is no good.
    reverse : (H, W, 2) float array, optional
        Pixels, neighbour to centre. Of the whole frame, also where all else is of some of its rows.
    albedo, warped_albedo : (H, W) or (H, W, C) float array, optional
        Of the centre and of the warped neighbour. One may come with the other only; so for the normals.
    normal, warped_normal : (H, W, 3) float array, optional
        In any one space, of any length, 0 where there is no surface.
    first_row : int
        The frame's row that the first row of `flow` belongs to.

    Returns
    -------
    (H, W) float32 array
        In [0, 1]. Guides that are not finite give 0.

    Raises
    ------
    ValueError
        If half a pair is given, or shapes do not agree.

    Notes
    -----
    inside · [|f + r|² < 0.01 (|f|² + |r|²) + 0.5] · exp(−‖Δa‖² / 0.1²) · clamp((n·n′ − 0.8) / 0.2),
    then the minimum of 3 x 3 pixels, because what surrounds an occlusion is mixed into its border. Δa is divided by
    the albedo where that is above 1. What moves without the geometry (shadows, reflections) is invisible here.

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

    confidence = inside.astype(np.float32)
    if reverse is not None:
        confidence *= _agree_forward_backward(flow, reverse, first_row)
    with np.errstate(invalid="ignore"):
        if albedo is not None and warped_albedo is not None:
            confidence *= _agree_albedo(albedo, warped_albedo)
        if normal is not None and warped_normal is not None:
            confidence *= _agree_normal(normal, warped_normal)
    confidence = np.nan_to_num(confidence, nan=0.0).astype(np.float32)
    return cv2.erode(confidence, np.ones((3, 3), np.uint8)).reshape(shape)


def mix_centre(
    warped: np.ndarray, centre: np.ndarray, confidence: np.ndarray, out: np.ndarray | None = None
) -> np.ndarray:
    """Put the centre in the place of a warped neighbour where that cannot be trusted.

    Parameters
    ----------
    warped, centre : (H, W) or (H, W, C) float array
        In any unit.
    confidence : (H, W) float array
        In [0, 1].
    out : float32 array, optional
        Contiguous, of the shape of `centre`: where the result is written. Without: a new one.

    Returns
    -------
    float32 array
        Of the shape of `centre`: ``c · warped + (1 − c) · centre``, exactly the centre where c is 0, whatever `warped`
        holds there.

    Raises
    ------
    ValueError
        If shapes do not agree.
    """
    if warped.shape != centre.shape or confidence.shape != centre.shape[:2]:
        raise ValueError(
            f"warped has shape {warped.shape}, confidence {confidence.shape}, expected those of centre, {centre.shape}"
        )
    mixed = np.empty(centre.shape, np.float32) if out is None else out
    planes = (*centre.shape[:2], -1)
    warped, centre, confidence = (np.asarray(layer, np.float32) for layer in (warped, centre, confidence))
    layers = warped.reshape(planes), centre.reshape(planes), confidence, mixed.reshape(planes)
    on_all_cores(_mix, len(centre), *layers)
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
