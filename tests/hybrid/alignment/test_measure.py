"""Measurements of frames and pairs, by which stages are chosen."""

import numpy as np
import pytest

from hybrid.alignment.measure import measure_frame, measure_pair, shrink
from hybrid.alignment.noise import UNEQUAL
from hybrid.alignment.prepare import prepare
from hybrid.files.frame import Frame


@pytest.mark.parametrize(("samples", "others", "lit"), [(8, 8, 1), (8, 16, 1), (64, 8, 1), (8, 512, 1), (8, 512, 0.3)])
def test_samples_of_two_frames_are_as_stated_or_as_their_noise_has_them(samples, others, lit) -> None:
    """With `lit` less than 1 the rest of the picture has no noise: a median over all pixels would be 0."""
    rng = np.random.default_rng(5)
    light = np.linspace(0.2, 2, 256, dtype=np.float32)[:, None]

    def frame(number: int, count: int, stated: float | None):
        noise = rng.gamma(count, 1 / count, (160, 256, 3)) if count < 512 else rng.normal(1, count**-0.5, (160, 256, 3))
        noise[: round((1 - lit) * 160)] = 1
        return prepare(Frame(number, (light * noise).astype(np.float32), samples=stated))

    def ratio(*stated: float | None) -> float:
        pair = frame(1, samples, stated[0]), frame(2, others, stated[1])
        return measure_pair(*pair, (shrink(pair[0]), shrink(pair[1]))).samples

    assert ratio(8.0, 512.0) == 64
    found = ratio(8.0, None)  # not stated by both
    expected = others / samples
    assert found == 1 if max(expected, 1 / expected) < UNEQUAL else found == pytest.approx(expected, rel=0.3)


def test_detail_that_comes_is_no_noise_of_fewer_samples() -> None:
    """The noise of more than half of the places seems greater, and that of the others is the same."""
    rng = np.random.default_rng(5)

    def frame(number: int, detail: float):
        color = rng.normal(1, 0.01, (160, 256, 3))
        color[:, :160] *= rng.normal(1, detail, (160, 160, 1))
        return prepare(Frame(number, color.astype(np.float32)))

    pair = frame(1, 0.0), frame(2, 0.1)
    assert measure_pair(*pair, (shrink(pair[0]), shrink(pair[1]))).samples == 1


@pytest.mark.parametrize("noise", [0, 0.05])
def test_alpha_has_noise_where_it_is_soft_and_none_at_outlines(noise) -> None:
    y, x = np.mgrid[:96, :128].astype(np.float32)
    outline = np.clip(40 - np.hypot(x - 64, y - 48), 0, 1)  # of one pixel
    shadow = np.clip(x / 128, 0.1, 0.9)
    noisy = noise * np.random.default_rng(2).normal(0, 1, shadow.shape).astype(np.float32)

    def grain(alpha) -> float:
        frame = prepare(Frame(1, np.ones((96, 128, 3), np.float32), alpha=np.float32(alpha)))
        return measure_frame(frame, shrink(frame)).alpha_grain

    assert grain(outline) == grain(outline > 0) == 0
    # The median of normal noise is 0.67 deviations.
    assert grain(shadow + noisy) == pytest.approx(0.67 * noise, rel=0.1, abs=1e-4)
