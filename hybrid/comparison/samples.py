"""How many samples per pixel a denoiser is worth: the error of the noisy render against its samples."""

from __future__ import annotations

import math
from collections.abc import Sequence
from dataclasses import dataclass
from itertools import pairwise

import numpy as np

from hybrid.files.exr import read_exr
from hybrid.files.shots import Shot


def decibels(error: float | np.floating) -> str:
    """PSNR of a mean squared error, in words; ∞ where it is zero, or less as an unbiased estimate may be."""
    return f"{-10 * math.log10(error):.2f} dB" if error > 0 else "∞ dB"


@dataclass(frozen=True)
class NoiseLaw:
    """Mean squared error of the noisy render, measured at some numbers of samples, and the law between and beyond.

    Attributes
    ----------
    levels : tuple of (float, float)
        (samples, error) pairs by rising samples; the first samples need not be the shot's own.
    samples : float
        Those of the shot that was denoised.
    floor : float
        The reference's own part in every measured error, taken off by `worth`; 0 where halves did that.
    """

    levels: tuple[tuple[float, float], ...]
    samples: float = 1.0
    floor: float = 0.0

    @property
    def slope(self) -> float | None:
        """Power with which the error, without the floor, goes with the samples: −1 by the law; None for one level."""
        known = [(math.log(n), math.log(e - self.floor)) for n, e in self.levels if e > self.floor]
        if len(known) < 2:
            return None
        x, y = np.transpose(known)
        return float(np.polyfit(x, y, 1)[0])

    def worth(self, error: float) -> float:
        """Times the shot's samples at which the noisy render would have this mean squared error.

        Between measured levels on a straight line of the logarithms, beyond them by 1/n. Infinite where the
        error cannot be told from the reference's noise; NaN where the noisy render has no error to compare with.
        """
        known = [(n, e - self.floor) for n, e in self.levels if e > self.floor]
        rest = error - self.floor
        if not known or math.isnan(rest):
            return float("nan")
        if rest <= 0:
            return float("inf")
        for (n0, e0), (n1, e1) in pairwise(known):
            if min(e0, e1) <= rest <= max(e0, e1) and e0 != e1:
                share = math.log(rest / e0) / math.log(e1 / e0)
                return float(n0 * (n1 / n0) ** share / self.samples)
        n, e = known[-1] if rest < known[-1][1] else known[0]
        return n * e / rest / self.samples

    def describe(self) -> str:
        """Say in words where the figures come from, and whether the law holds."""
        measured = ", ".join(f"{n:g}: {decibels(e)}" for n, e in self.levels)
        if self.slope is None:
            return "By the 1/n law from the noisy render's own error; not checked, no other level was given."
        verdict = "as 1/n asks" if abs(self.slope + 1) < 0.1 else "not as 1/n, which is assumed beyond them"
        return (
            f"Measured at these samples per pixel: {measured}. The error goes as n^{self.slope:.2f}, {verdict}. "
            "Between the levels interpolated, beyond them by 1/n."
        ).replace("n^-", "n^−")


def reference_floor(error: float, samples: float, reference_samples: float) -> float:
    """Find the reference's part in a measured error.

    Parameters
    ----------
    error : float
        Measured mean squared error a/n + a/m.
    samples : float
        n, of the render that is judged.
    reference_samples : float
        m, of the reference.

    Returns
    -------
    float
        a/m.
    """
    return error * samples / (samples + reference_samples)


def fit_floor(levels: Sequence[tuple[float, float]]) -> float:
    """Find what a reference of unknown samples adds to every error.

    Parameters
    ----------
    levels : sequence of (float, float)
        Two or more pairs of samples n and error a/n + b.

    Returns
    -------
    float
        b ≥ 0. Relative residuals are fitted, so that the noisiest level does not decide alone.
    """
    n, e = np.transpose(np.asarray(levels, np.float64))
    matrix = np.stack([1 / n, np.ones_like(n)], axis=1) / e[:, None]
    _, b = np.linalg.lstsq(matrix, np.ones_like(n), rcond=None)[0]
    return float(np.clip(b, 0, 0.99 * e.min()))


def samples_of(shot: Shot) -> int | None:
    """Samples per pixel, where the header of the first frame tells them, as Cycles' does."""
    for part in read_exr(shot.path(shot.numbers[0]), pixels=False).parts:
        for name, value in part.header.items():
            if name.startswith("cycles.") and name.endswith(".samples") and str(value).isdigit():
                return int(value)
    return None
