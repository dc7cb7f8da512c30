"""Weights of warped frames by errors of the warp that exceed the noise of the samples."""

import cv2
import numpy as np

from loops.parallel import Floats

# Box, pixels, over which the noise of the samples is measured, as in `nlm.gate`.
_NOISE_SIZE = (15, 15)
# Square of the error of bicubic interpolation over that of its difference from bilinear: at an edge of one pixel the
# difference is half of the error.
_ERROR = np.float32(4)
# Square of the deviations of a sample up to which two denoised frames may differ: their errors stay below three.
_DEVIATIONS = np.float32(9)


def measure_noise(noisy: Floats, estimate: Floats) -> Floats:
    """Measure the variance of a frame's samples.

    Parameters
    ----------
    noisy, estimate : (H, W, 3) float32, the frame as rendered and denoised, in one unit

    Returns
    -------
    (H, W) float32
        The 15×15 mean of (noisy − estimate)², in the mean over channels.
    """
    # The running sums of a box filter round to a little below 0.
    return np.asarray(np.maximum(cv2.blur(_mean_square(noisy - estimate), _NOISE_SIZE), 0), np.float32)


def interpolation_weight(warped: Floats, bilinear: Floats, centre: Floats, variance: Floats) -> Floats:
    """Weigh a warped frame by how much its warp errs.

    Parameters
    ----------
    warped, bilinear : (H, W, 3) float32, a denoised frame warped by bicubic and by bilinear interpolation
    centre : (H, W, 3) float32, the denoised frame that it is warped to
    variance : (H, W) float32, of the centre's samples, from `measure_noise`, in the square of their unit

    Returns
    -------
    (H, W) float32
        In [0, 1], and 1 where all are equal.

    Notes
    -----
    v / (v + 4 e² + max(0, d² − 9 v)), e the difference of both warps, d that from the centre, squares in the mean over
    channels, v the variance. At the rim of a lamp of a thousand times the light beside it interpolation errs by more
    than the noise of the samples, and a highlight in glass moves otherwise than its surface: the gate compares means of
    9×9 pixels on a curve, where both are small. e gains 0.3 and 0.4 dB on a shot of sharp outlines at 128 and 512
    samples; d 0.8 dB on a glass ball, and costs 0.1 / 0.2 dB on turned metal.
    """
    error = _ERROR * _mean_square(warped - bilinear)
    error += np.maximum(_mean_square(warped - centre) - _DEVIATIONS * variance, 0)
    # Least float32: without noise, and where nothing differs, the weight is 1.
    least = np.finfo(np.float32).tiny
    return np.asarray((variance + least) / (variance + error + least), np.float32)


def _mean_square(x: Floats) -> Floats:
    return np.asarray(np.square(x).mean(axis=-1), np.float32)
