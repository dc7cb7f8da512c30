"""Motion of reflections and refractions, which a renderer's vectors of surfaces do not describe."""

from collections.abc import Sequence

import cv2
import numpy as np

from flow.warp import ends_inside, warp
from loops.parallel import Floats, Mask

# Motion is found in pictures of half the size: at full size a glass ball has 0.1 dB more, and the time is
# four times as long.
_SHRINK = 2
# Deviation, pixels, of the Gaussian over which the motion is one: 3 is as good, with 6 the glass ball loses 0.6 dB.
_SIGMA = 4.0
# Steps, and the deviation, pixels, by which pictures are blurred in each: about as far as a step reaches.
_STEPS, _BLUR = 3, 2.0
# Longest motion, pixels a frame; what reaches nearly so far may go on, and does not count.
_MOST, _REACHED = 4.0, 0.95
# Motion counts where it leaves less than so much of the squared difference of the frames. With 0.4 the glass ball loses
# 0.9 dB, with 0.6 it gains 0.1, and a shot of hair and glass loses 0.05 / 0.08.
_LEFT = 0.5
# Added to the squares of gradients, in tone-mapped units: an edge of one step of 8 bits a pixel.
_FLAT = np.float32(1e-5)


def find_reflections(
    pictures: Sequence[Floats | None], flows: Sequence[Floats | None], exposure: float
) -> Floats | None:
    """Find how reflections and refractions move beside the vectors of their surfaces.

    Parameters
    ----------
    pictures : sequence of (H, W, 3) float32, optional
        An odd number of denoised frames; None for one that is missing, which the middle one is not.
    flows : sequence of (H, W, 2) float32, optional
        Pixels, from the middle frame to each; None where there is none. That to the middle is not read.
    exposure : float, above 0, of the pictures

    Returns
    -------
    (H, W, 2) float32 or None
        Pixels per frame, x and y, to be added to the flow to a frame times its distance from the middle; 0 where the
        flows explain the pictures as well. None where all is 0, or no frame is there on one of the sides.

    Notes
    -----
    The method of Lucas and Kanade, with the change over time by regression on all frames. In x / (x + exposure), in the
    mean over channels, with p_t the pictures along flow and motion d, g the gradient of their mean, s the slope of p_t
    over t and K a Gaussian mean, each step solves

        K[g gᵀ] Δd = −K[g s].

    The errors of single pictures differ from frame to frame, and their slope is small. d counts where the sum of
    K[(p_t − p_0)²] falls below half of that without it.

    References
    ----------
    Lucas, Kanade: An iterative image registration technique with an application to stereo vision. 1981.
    """
    middle = len(pictures) // 2
    times = [t - middle for t, flow in enumerate(flows) if t != middle and flow is not None and pictures[t] is not None]
    if not (times and min(times) < 0 < max(times)):
        return None
    centre = _shrink(_tone(pictures[middle], exposure))
    given = [(pictures[middle + t], flows[middle + t]) for t in times]
    aligned = [_shrink(warp(_tone(picture, exposure), flow)[0]) for picture, flow in given]  # type: ignore[arg-type]

    def along(motion: Floats) -> list[Floats]:
        return [warp(p, motion * np.float32(t / _SHRINK))[0] for t, p in zip(times, aligned, strict=True)]

    def difference(moved: Sequence[Floats]) -> Floats:
        return sum((np.square(picture - centre) for picture in moved), np.zeros_like(centre))

    motion = np.zeros((*centre.shape, 2), np.float32)
    for _ in range(_STEPS):
        motion += _step([*along(motion), centre], [*times, 0])
        motion *= (_MOST / np.maximum(np.hypot(motion[..., 0], motion[..., 1]), _MOST))[..., None]
    counts = _mean(difference(along(motion))) < _LEFT * _mean(difference(aligned))
    counts &= np.hypot(motion[..., 0], motion[..., 1]) < _REACHED * _MOST
    if not counts.any():
        return None
    motion = np.where(counts[..., None], motion, np.float32(0))
    height, width = flows[middle + times[0]].shape[:2]  # type: ignore[union-attr]
    whole = np.asarray(cv2.resize(motion, (width, height), interpolation=cv2.INTER_LINEAR), np.float32)
    whole *= _stays_inside(whole, flows, times, middle)[..., None]
    return whole


def _tone(picture: Floats | None, exposure: float) -> Floats:
    """Mean over channels (H, W) of a picture (H, W, 3) as x / (x + exposure)."""
    assert picture is not None
    light = np.maximum(picture, np.float32(0))
    light /= light + np.float32(exposure)
    return np.asarray(cv2.transform(light, np.full((1, 3), 1 / 3, np.float32)), np.float32)


def _shrink(picture: Floats) -> Floats:
    height, width = (-(-side // _SHRINK) for side in picture.shape)
    return np.asarray(cv2.resize(picture, (width, height), interpolation=cv2.INTER_AREA), np.float32)


def _mean(plane: Floats, sigma: float = _SIGMA / _SHRINK) -> Floats:
    return np.asarray(cv2.GaussianBlur(plane, (0, 0), sigma), np.float32)


def _step(pictures: Sequence[Floats], times: Sequence[int]) -> Floats:
    """Motion (H, W, 2), pixels of the whole frame a unit of time, that best explains the change of pictures (H, W)."""
    blurred = [_mean(picture, _BLUR / _SHRINK) for picture in pictures]
    late = np.subtract(times, np.mean(times), dtype=np.float32)
    slope = sum((t * picture for t, picture in zip(late, blurred, strict=True)), np.zeros_like(blurred[0]))
    slope /= np.square(late).sum()
    mean = sum(blurred, np.zeros_like(slope)) / np.float32(len(blurred))
    # The sum of Sobel's weights on a side is 4, over two pixels.
    right, down = (cv2.Sobel(mean, -1, *axis, scale=1 / (8 * _SHRINK)) for axis in ((1, 0), (0, 1)))
    xx, yy = _mean(right * right) + _FLAT, _mean(down * down) + _FLAT
    xy, xt, yt = _mean(right * down), _mean(right * slope), _mean(down * slope)
    solved = np.stack([xy * yt - yy * xt, xy * xt - xx * yt], axis=-1) / (xx * yy - xy * xy)[..., None]
    return np.asarray(solved, np.float32)


def _stays_inside(motion: Floats, flows: Sequence[Floats | None], times: Sequence[int], middle: int) -> Mask:
    """Where (H, W) all flows with the motion end inside the frame."""
    inside = [ends_inside(flows[middle + t] + t * motion, motion.shape, 0) for t in times]  # type: ignore[operator]
    return np.asarray(np.logical_and.reduce(inside))
