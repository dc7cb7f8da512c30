"""Kernels of the paper's networks on a rendered shot."""

from itertools import pairwise
from pathlib import Path

import numpy as np

from hybrid.denoising.breakdown import Breakdown
from hybrid.denoising.stream import FrameStream
from hybrid.files.shots import open_shot
from hybrid.neural import open_network
from tests.scenes import only

STAGES = {"demodulate", "outliers", "warp"}


def test_more_threshold_stays_closer_to_the_input_and_to_its_own_frame():
    """On a rendered shot, with a small network that takes no estimates: 150 steps on two other scenes."""
    shot = open_shot("tests/data/bathroom/noisy.####.exr", frames="11")
    window = FrameStream(shot, only(STAGES)).align(11)
    noisy = window.color[2] * window.modulation
    distances, weights_of_centre = [], []
    for threshold in (0.0, 0.25, 0.5, 0.75, 0.95):
        counted = Breakdown()
        path = Path(__file__).parents[2] / "data" / "small.safetensors"
        image = open_network(path, precision="float32", threshold=threshold, breakdown=counted)(window).color
        distances.append(float(np.abs(image / (1 + image) - noisy / (1 + noisy)).mean()))
        weights_of_centre.append(float(list(counted.rows())[2][1]))
    assert all(more < less for less, more in pairwise(distances))
    assert all(more > less for less, more in pairwise(weights_of_centre))
