"""A colour gate: which aligned frames show the same light as the centre."""

from __future__ import annotations

import cv2
import numpy as np
from numpy.typing import NDArray

Floats = NDArray[np.float32]
Mask = NDArray[np.bool_]

_MEAN_SIZE = (9, 9)
_NOISE_SIZE = (15, 15)
# q = _SHARE · s + _FLOOR in tone-mapped units: a difference of means of a third of the centre's noise is
# noise; 0.004, one step of 8 bits, is what the estimates themselves differ by where nothing is noisy.
_SHARE, _FLOOR = 0.3, 0.004


def color_gate(estimates: Floats, noisy: Floats, exposure: float) -> Floats:
    """Weigh aligned frames by how well their denoised colours agree with the centre's.

    Geometry cannot see a moving shadow, highlight or reflection; the colour of a clean enough estimate can.

    Parameters
    ----------
    estimates : (T, H, W, 3) float32
        Denoised, aligned frames, linear, at least 0; the centre is ``T // 2``.
    noisy : (H, W, 3) float32
        The centre frame as it was rendered, in the same unit.
    exposure : float
        The radiance that is mapped to one half; it scales with the frames, so that the gate does not
        depend on their scale.

    Returns
    -------
    (T, H, W) float32
        Weights in [0, 1]; 1 at the centre.

    Raises
    ------
    ValueError
        If the shapes do not fit each other, T is even, or `exposure` is not a positive number.

    Notes
    -----
    exp(−(m/q)²), q = 0.3 s + 0.004. All in x / (x + exposure): m is the RMS over channels of the 9×9 mean of the
    difference from the centre, s the 15×15 RMS of noisy − centre. Non-finite values get weight 0 and do not spread.

    A pixel's own difference says nothing beside: it is the error of the two estimates, and to weigh by it is to choose
    the frames whose errors are the centre's. Without it averages are up to 2 dB steadier, and gathered frames
    (`nlm.gather`) 0.5 dB better.
    """
    if estimates.ndim != 4 or estimates.shape[0] % 2 == 0:
        raise ValueError(f"estimates: expected (odd frames, height, width, channels), got {estimates.shape}")
    if noisy.shape != estimates.shape[1:]:
        raise ValueError(f"noisy: expected shape {estimates.shape[1:]} like an estimate, got {noisy.shape}")
    if not (exposure > 0 and np.isfinite(exposure)):
        raise ValueError(f"exposure: expected a positive number, got {exposure}")
    centre_index = estimates.shape[0] // 2
    centre, valid = _tone_map(estimates[centre_index], exposure)
    shown, known = _tone_map(noisy, exposure)
    error = np.where(valid & known, _mean_square(shown - centre), np.float32(0))
    # The running sums of a box filter round to a little below 0 where nothing differs.
    noise = np.sqrt(np.maximum(cv2.blur(error, _NOISE_SIZE), 0))
    rate = 1 / np.square(np.float32(_SHARE) * noise + np.float32(_FLOOR))
    weight = np.empty(estimates.shape[:3], np.float32)
    for t, estimate in enumerate(estimates):
        if t == centre_index:
            weight[t] = 1
            continue
        mapped, finite = _tone_map(estimate, exposure)
        both = finite & valid
        difference = np.where(both[..., None], mapped - centre, np.float32(0))
        mean = _mean_square(np.asarray(cv2.blur(difference, _MEAN_SIZE), np.float32))
        weight[t] = np.exp(-rate * mean) * both
    return weight


def _tone_map(image: Floats, exposure: float) -> tuple[Floats, Mask]:
    """x / (x + exposure) in [0, 1), 0 at non-finite pixels, and where the image is finite."""
    # einsum: several times faster than a reduction over so short an axis
    finite: Mask = np.isfinite(np.einsum("...c->...", image))
    x = np.where(finite[..., None], np.maximum(image, 0), np.float32(0))
    # exposure / (x + exposure) and not x / …: it cannot overflow
    mapped = 1 - np.float32(exposure) / (x + np.float32(exposure))
    return np.asarray(mapped, np.float32), finite


def _mean_square(x: Floats) -> Floats:
    return np.asarray(np.einsum("...c,...c->...", x, x) / np.float32(x.shape[-1]), np.float32)
