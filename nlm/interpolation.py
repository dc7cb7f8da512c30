"""Weights of warped frames by errors of the warp that exceed the noise of the samples."""

import cv2
import numpy as np

from loops.parallel import Floats
from nlm.average import channel_mean, mean_square
from nlm.gate import AROUND_SIZE


def measure_noise(noisy: Floats, estimate: Floats, exposure: float) -> Floats:
    """Measure the variance of a frame's samples.

    Parameters
    ----------
    noisy, estimate : (H, W, 3) float32, the frame as rendered and denoised, in one unit
    exposure : float, in that unit

    Returns
    -------
    (H, W) float32
        (l + exposure) · K[(noisy − estimate)² / (l + exposure)], l the estimate and the square in the mean over
        channels, K the 15×15 mean.

    Notes
    -----
    The variance of samples grows with their light. In the plain mean a lamp of thousands of exposures gives its noise
    to the dark pixels beside it, and warped frames that spread the lamp over these count: 0.9 dB of a car's headlamps
    at 128 samples.
    """
    light = np.maximum(channel_mean(estimate), 0) + np.float32(exposure)
    # The running sums of a box filter round to a little below 0.
    return np.asarray(light * np.maximum(cv2.blur(mean_square(noisy - estimate) / light, AROUND_SIZE), 0), np.float32)


def interpolation_weight(warped: Floats, bilinear: Floats, variance: Floats) -> Floats:
    """Weigh a warped frame by how much its interpolation errs.

    Parameters
    ----------
    warped, bilinear : (H, W, 3) float32, a denoised frame warped by bicubic and by bilinear interpolation
    variance : (H, W) float32, of the centre's samples, from `measure_noise`, in the square of their unit

    Returns
    -------
    (H, W) float32
        In [0, 1], and 1 where both are equal.

    Notes
    -----
    v / (v + e²), e the difference of both warps, squared in the mean over channels, and v the variance. At outlines
    and rims of lamps interpolation errs by more than the noise of the samples, and more so with many samples: three
    shots of the ladder gain 0.04, 0.05 and 0.2 dB at 32, 128 and 512 (*garden* 0.2 and 0.3). Through 4 e² lamps and
    glass lose 0.1 dB more, and with differences from the centre of over three deviations of a sample 0.2 dB more.
    """
    error = mean_square(warped - bilinear)
    # Least float32: without noise, and where nothing differs, the weight is 1.
    least = np.finfo(np.float32).tiny
    return np.asarray((variance + least) / (variance + error + least), np.float32)
