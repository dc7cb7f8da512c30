"""Error against samples per pixel: how many times its samples a rival needs to be as good."""

import math
from collections.abc import Mapping, Sequence
from itertools import pairwise
from typing import Literal, NamedTuple

import numpy as np

from hybrid.comparison.results import Curve, Ladder, Statistic

RIVAL, INPUT = "OIDN best", "noisy"
LADDER_METRICS = ("psnr", "temporal_psnr", "flip")
LEAST_ERROR = 10**-6.5  # 65 dB: below, an error against two references is mostly their noise


class Factor(NamedTuple):
    """A factor on samples, or a bound of it where the samples lie outside the measured ones."""

    value: float
    bound: Literal["", "more than", "less than"] = ""


def samples_factor(rival: Curve, samples: float, error: float) -> Factor:
    """Return how many times `samples`, one of the rival's numbers of samples, the rival needs for this error.

    The logarithm of its error is interpolated linearly in that of its samples, and never extrapolated. Where its error
    does not fall steadily, the nearest samples count: more where it is worse at `samples`, fewer where it is better.
    """
    here = [n for n, _ in rival].index(samples)
    own = rival[here][1]
    if own == error:
        return Factor(1)
    is_worse = own > error
    path = rival[here:] if is_worse else rival[here::-1]
    for (n0, e0), (n1, e1) in pairwise(path):
        if e1 <= error if is_worse else e1 >= error:
            return Factor(n0 * (n1 / n0) ** (math.log(error / e0) / math.log(e1 / e0)) / samples)
    return Factor(path[-1][0] / samples, "more than" if is_worse else "less than")


def factors(curves: Mapping[str, Curve]) -> dict[str, dict[float, Factor]]:
    """Return the factor for each method but noisy frames and rival, by samples; empty without a rival."""
    rival = curves.get(RIVAL, ())
    measured = dict(rival)
    others = {name: curve for name, curve in curves.items() if name not in (RIVAL, INPUT)} if rival else {}
    return {name: {n: samples_factor(rival, n, e) for n, e in curve if n in measured} for name, curve in others.items()}


def build_ladder(measured: Mapping[float, Mapping[str, Mapping[str, Statistic]]]) -> Ladder:
    """Return the curves by measure and method, of statistics by samples, method and measure."""
    ladder: dict[str, dict[str, Curve]] = {}
    for key in LADDER_METRICS:
        points: dict[str, list[tuple[float, float]]] = {}
        for samples, methods in sorted(measured.items()):
            for name, metrics in methods.items():
                if key in metrics and math.isfinite(error := _error(metrics[key], key)):
                    points.setdefault(name, []).append((samples, error))
        if points:
            ladder[key] = {name: tuple(curve) for name, curve in points.items()}
    return ladder


def join_ladders(ladders: Sequence[Ladder]) -> Ladder:
    """Return the geometric means of the errors (means of decibels) that the ladders of several shots all have."""
    joined: dict[str, dict[str, Curve]] = {}
    for key, curves in (ladders[0] if ladders else {}).items():
        for name in curves:
            tables = [dict(ladder.get(key, {}).get(name, ())) for ladder in ladders]
            common = [n for n in tables[0] if all(n in table for table in tables)]
            if common:
                errors = [float(np.exp(np.mean([math.log(table[n]) for table in tables]))) for n in common]
                joined.setdefault(key, {})[name] = tuple(zip(common, errors, strict=True))
    return joined


def _error(statistic: Statistic, key: str) -> float:
    """The mean error of the frames: squared, for a measure in decibels."""
    values = np.asarray(statistic.values)
    return max(float(np.mean(values if key == "flip" else 10 ** (-values / 10))), LEAST_ERROR)
