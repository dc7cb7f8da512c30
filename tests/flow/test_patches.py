"""Costs of vectors on patches: nothing for right ones, and only where there is something to see."""

import numpy as np
import pytest

from flow.motion import MotionConvention
from flow.patches import FramePair, Patches, keeps_change, mean_cost

SHAPE = 80, 120
NEXT = MotionConvention("next")


def wall(shift: float, seed: int = 0) -> np.ndarray:
    """A smooth pattern, (H, W, 3), moved to the right by so many pixels."""
    y, x = np.mgrid[: SHAPE[0], : SHAPE[1]].astype(np.float32)
    phases = np.random.default_rng(seed).uniform(0, 6, (6, 3)).astype(np.float32)
    waves = [np.sin(phases[k, 0] + (x - shift) * (0.1 + 0.07 * k) + y * 0.05 * phases[k, 1]) for k in range(6)]
    return np.repeat((2 + 0.3 * np.sum(waves, axis=0))[..., None], 3, axis=-1).astype(np.float32)


def panned(step: float = 3.0) -> Patches:
    vectors = np.tile(np.float32([step, 0]), (*SHAPE, 1))
    return Patches(FramePair(wall(0), wall(step), vectors, vectors, SHAPE))


def test_right_vectors_cost_no_more_than_noise() -> None:
    pair = panned()
    right = mean_cost(pair.costs(NEXT), pair.still)
    wrong = mean_cost(pair.costs(MotionConvention("next", scale=-1)), pair.still)
    assert right < 0.02 < 0.3 < pair.still.mean() < wrong


def test_patches_that_leave_the_picture_have_no_cost() -> None:
    costs = panned(30).costs(NEXT)
    assert 0.1 < np.isnan(costs).mean() < 0.4


def test_the_length_of_vectors_is_in_pixels() -> None:
    assert panned(3).length(NEXT) == pytest.approx(3)


def test_patches_lie_on_what_is_lit() -> None:
    color = np.zeros((*SHAPE, 3), np.float32)
    color[10:40, 20:60] = wall(0)[10:40, 20:60]
    vectors = np.ones((*SHAPE, 2), np.float32)
    pair = Patches(FramePair(color, color, vectors, vectors, SHAPE))
    assert pair.pictures[0].shape == (30, 40)
    assert len(pair.rows) >= 8


def test_another_scene_is_unrelated_and_a_moved_one_is_not() -> None:
    vectors = np.zeros((*SHAPE, 2), np.float32)
    rng = np.random.default_rng(1)
    other = np.repeat(np.float32(8) * rng.random((*SHAPE, 1), np.float32), 3, axis=-1)
    assert Patches(FramePair(0.05 * wall(0), other, vectors, vectors, SHAPE)).unrelated
    assert not panned().unrelated


def test_the_mean_counts_patches_outside_by_those_inside() -> None:
    still, costs = np.float32([1, 1, 1, 1]), np.float32([0.2, 0.4, 0.3, np.nan])
    assert mean_cost(costs, still) == pytest.approx(0.3)
    assert mean_cost(np.full(4, np.nan, np.float32), still) == 1
    assert not keeps_change(np.array([True, False, False, False]), still)
