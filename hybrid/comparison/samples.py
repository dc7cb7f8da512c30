"""The worth of a denoiser in samples per pixel: error of the noisy render against its number of samples."""

import math
from collections.abc import Sequence
from dataclasses import dataclass
from itertools import pairwise

import numpy as np


def decibels(error: float | np.floating) -> str:
    """Format a mean squared error as PSNR; ∞ for zero, and for negative unbiased estimates."""
    return f"{-10 * math.log10(error):.2f} dB" if error > 0 else "∞ dB"


@dataclass(frozen=True)
class NoiseLaw:
    """Mean squared error of the noisy render as a function of its samples."""

    levels: tuple[tuple[float, float], ...]  # measured (samples, error) by rising samples
    samples: float = 1.0  # samples per pixel of the shot that was denoised
    floor: float = 0.0  # contribution of the reference's noise to every measured error; 0 where halves have removed it

    @property
    def slope(self) -> float | None:
        """Exponent of the error, without the floor, in the samples: −1 by theory; None for one level."""
        above_floor = [(math.log(n), math.log(e - self.floor)) for n, e in self.levels if e > self.floor]
        if len(above_floor) < 2:
            return None
        x, y = np.transpose(above_floor)
        return float(np.polyfit(x, y, 1)[0])

    def worth(self, error: float) -> float:
        """Factor on the shot's samples at which the noisy render would have this mean squared error.

        Interpolated linearly in the logarithms between levels, extrapolated by 1/n. Infinite where the error is within
        the reference's noise; NaN where the noisy render has no error.
        """
        levels = [(n, e - self.floor) for n, e in self.levels if e > self.floor]
        rest = error - self.floor
        if not levels or math.isnan(rest):
            return float("nan")
        if rest <= 0:
            return float("inf")
        for (n0, e0), (n1, e1) in pairwise(levels):
            if min(e0, e1) <= rest <= max(e0, e1) and e0 != e1:
                share = math.log(rest / e0) / math.log(e1 / e0)
                return float(n0 * (n1 / n0) ** share / self.samples)
        n, e = levels[-1] if rest < levels[-1][1] else levels[0]
        return n * e / rest / self.samples

    def describe(self) -> str:
        measured = ", ".join(f"{n:g}: {decibels(e)}" for n, e in self.levels)
        if self.slope is None:
            return "By the 1/n law from the error of the noisy render; not verified, no other level was given."
        verdict = "close to 1/n" if abs(self.slope + 1) < 0.1 else "not as 1/n, which is assumed beyond the levels"
        return (
            f"Measured at these samples per pixel: {measured}. The error goes as n^{self.slope:.2f}, {verdict}. "
            "Interpolated between the levels, extrapolated by 1/n."
        ).replace("n^-", "n^−")


def reference_floor(error: float, samples: float, reference_samples: float) -> float:
    """Return the reference's part a/m of a mean squared error a/n + a/m; n and m are samples."""
    return error * samples / (samples + reference_samples)


def fit_floor(levels: Sequence[tuple[float, float]]) -> float:
    """Fit the constant b ≥ 0 of the reference in two or more errors a/n + b, (n, error), by relative residuals."""
    n, e = np.transpose(np.asarray(levels, np.float64))
    matrix = np.stack([1 / n, np.ones_like(n)], axis=1) / e[:, None]
    _, b = np.linalg.lstsq(matrix, np.ones_like(n), rcond=None)[0]
    return float(np.clip(b, 0, 0.99 * e.min()))
