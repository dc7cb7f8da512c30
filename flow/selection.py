"""Choice, pixel by pixel, of the flow that explains the pictures."""

from collections.abc import Sequence

import cv2
import numpy as np

from flow.guide import GuidePair
from flow.warp import warp

# Share of the incumbent's error by which another flow must be better.
_MARGIN = 0.15
# Side, pixels, of the boxes over which errors are averaged: pixel by pixel, and for the frame as a whole.
_BOX, _WIDE_BOX = 9, 37


def select_flow(
    candidates: Sequence[np.ndarray], guides: GuidePair, *, visible: np.ndarray | None = None
) -> tuple[np.ndarray, np.ndarray]:
    """Select for each pixel the flow that explains the guides best: the first unless another is clearly better.

    Parameters
    ----------
    candidates : sequence of (H, W, 2) float array, flows, pixels, finite; the renderer's vectors first
    guides : GuidePair
    visible : (H, W) bool array, optional
        False where a pixel is hidden in the neighbour (a forward-backward error of several pixels): no match counts
        there.

    Returns
    -------
    flow : (H, W, 2) float32 array, pixels
    choice : (H, W) uint8 array, index of the selected candidate

    Notes
    -----
    Error: e = min(5, Σ_g |I₁(x + f) − I₀(x)| / (σ_g + 1/255)), mean over boxes of 9 x 9 pixels. A noisy
    guide counts for little, a difference below one step of 8 bits for nothing, and one pixel (an edge, a disocclusion)
    for at most five deviations. Candidate i beats j where e_i < 0.85 e_j − 3 s / 9, with s = Σ_g σ_g / (σ_g + 1/255):
    means over 81 noisy pixels differ by about s / 9 by chance. Where a candidate leaves the frame there is no evidence.

    The incumbent is the first candidate, and keeps every pixel where nothing beats it. Another candidate becomes the
    incumbent if, over boxes of 37 x 37 pixels, it beats the first on two fifths of the frame, and three times as often
    as it is beaten: then the given vectors are wrong as such. With an albedo among the guides, the refined flow beat
    exact vectors on 0 to 3 % of the pixels of three rendered shots, vectors perturbed by 1.2 px on 47 to 88 %; on noisy
    luminance alone on 8 to 70 %, where this rule may not be enough.
    """
    if not candidates:
        raise ValueError("candidates is empty, expected at least one flow")
    shape = guides.centre.shape[:2]
    # One step of 8 bits: the scale on which guides in [0, 1] are seen as different.
    scale = 1 / (guides.noise + np.float32(1 / 255))
    # By planes, which is faster than over so short an axis.
    chance = np.asarray(3 * sum(guides.noise[..., g] * scale[..., g] for g in range(scale.shape[-1])))
    errors, evidence = [], np.ones(shape, bool) if visible is None else visible.astype(bool)
    for index, candidate in enumerate(candidates):
        if candidate.shape != (*shape, 2):
            raise ValueError(f"candidates[{index}] has shape {candidate.shape}, expected {(*shape, 2)}")
        moved, inside = warp(guides.neighbour, candidate)
        evidence &= inside
        moved -= guides.centre
        np.multiply(np.abs(moved, out=moved), scale, out=moved)
        errors.append(np.minimum(sum(moved[..., g] for g in range(scale.shape[-1])), np.float32(5)))
    errors = [error * evidence for error in errors]
    incumbent = _find_incumbent([_box_mean(error, _WIDE_BOX) for error in errors], chance)
    errors = [_box_mean(error, _BOX) for error in errors]
    threshold = (1 - _MARGIN) * errors[incumbent] - chance / _BOX
    flow = np.array(candidates[incumbent], np.float32)
    choice = np.full(shape, incumbent, np.uint8)
    best = errors[incumbent]
    for index, candidate in enumerate(candidates):
        if index != incumbent:
            better = (errors[index] < threshold) & (errors[index] < best)
            flow[better], choice[better] = candidate[better], index
            best = np.where(better, errors[index], best)
    return flow, choice


def _find_incumbent(errors: Sequence[np.ndarray], chance: np.ndarray) -> int:
    """Index of the flow that keeps the pixels where nothing beats it."""
    incumbent, best_share = 0, 0.4
    first, *others = errors
    for index, other in enumerate(others, start=1):
        wins = (other < (1 - _MARGIN) * first - chance / _WIDE_BOX).mean()
        losses = (first < (1 - _MARGIN) * other - chance / _WIDE_BOX).mean()
        if wins > best_share and wins > 3 * losses:
            incumbent, best_share = index, wins
    return incumbent


def _box_mean(image: np.ndarray, side: int) -> np.ndarray:
    return cv2.blur(image, (side, side)).reshape(image.shape)
