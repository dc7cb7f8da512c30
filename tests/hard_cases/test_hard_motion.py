"""Motion vectors that lie: the picture is no worse than that of the frame alone."""

from functools import lru_cache

import numpy as np
import pytest

from hybrid.comparison.metrics import psnr
from tests.hard_cases.hard import SCENE, STAGES, denoise, frame, shot, spoil, truth, within_range
from tests.seldom import seldom

SHAPE = (SCENE.height, SCENE.width, 4)


def everywhere(value):
    return lambda f: np.full(SHAPE, value, np.float32)


def discontinuous(f):
    return np.random.default_rng(f.number).choice(np.float32([-20, 0, 3, 25]), SHAPE)


def in_the_corner(f):
    vectors = f.motion.copy()
    vectors[:10, :10] = 1e9, -1e9, np.inf, np.nan
    return vectors


VECTORS = {
    "1e9": everywhere(1e9),
    "-1e9": everywhere(-1e9),
    "nan": everywhere(np.nan),
    "inf": everywhere(np.inf),
    "out of the frame": everywhere(1000),
    "just out of the frame": everywhere(SCENE.width),
    "9999": everywhere(9999),
    "discontinuous": discontinuous,
    "sign flipped": lambda f: -f.motion,
    "bad in a corner": in_the_corner,
    "tiny": everywhere(1e-30),
}


@lru_cache
def alone():
    return denoise([frame(2)])[1]


@pytest.mark.parametrize("refine", [False, *seldom(True)], ids=["as given", "refined"])
@pytest.mark.parametrize("vectors", VECTORS.values(), ids=VECTORS)
def test_wrong_vectors_cost_no_more_than_time(vectors, refine):
    frames = [spoil(f, motion=vectors(f)) for f in shot()]
    stages = STAGES | {"refine"} if refine else STAGES
    window, image = denoise(frames, stages=stages)
    assert np.isfinite(window.color).all()
    assert ((window.confidence >= 0) & (window.confidence <= 1)).all()
    assert within_range(window, image)
    # Half a decibel: what wrongly trusted pixels may cost. Walls of 4 px with 2 px of error look alike here and there.
    assert psnr(image, truth()) > psnr(alone(), truth()) - 0.5
