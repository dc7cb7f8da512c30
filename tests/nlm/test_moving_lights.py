"""Bright pixels that move together are content; those that do not are noise."""

import numpy as np
import pytest

from nlm.moving_lights import confirmed_by_neighbour, find_bright, passing_lights, shared_motions, trail_of
from tests.seldom import seldom

SHAPE = (96, 128)


def excess(places: np.ndarray, light: float = 2.0, seed: int = 1) -> np.ndarray:
    """Weak noise, and bright pixels at these rows and columns, as far as they are in the frame."""
    image = np.random.default_rng(seed).normal(0, 0.03, SHAPE).astype(np.float32)
    inside = (places >= 0).all(axis=1) & (places < SHAPE).all(axis=1)
    image[tuple(places[inside].T)] = light
    return image


@pytest.fixture
def flakes() -> np.ndarray:
    return np.random.default_rng(2).integers(0, SHAPE, (120, 2))


@pytest.mark.parametrize("motion", [(9, 0), (-3, 14), (3, 0), (0, -31)])
def test_flakes_that_fall_together_are_found(flakes, motion) -> None:
    here, there = excess(flakes), excess(flakes + motion, seed=3)
    bright = find_bright(here), find_bright(there)
    assert shared_motions(*bright) == [motion]
    found = confirmed_by_neighbour(here, bright[0], there, bright[1], None)
    moved = flakes + motion
    stay = flakes[(moved >= 0).all(axis=1) & (moved < SHAPE).all(axis=1)]
    assert found[tuple(stay.T)].all()
    assert np.count_nonzero(found) == len(np.unique(stay, axis=0))


def test_two_speeds_at_once_are_found(flakes) -> None:
    moved = flakes + np.where(np.arange(120)[:, None] < 40, [13, 1], [9, 0])
    assert sorted(shared_motions(find_bright(excess(flakes)), find_bright(excess(moved)))) == [(9, 0), (13, 1)]


@pytest.mark.parametrize("share", [0.002, 0.01, 0.04])
@pytest.mark.parametrize("seed", [0, *seldom(1, 2, 3, 4)])
def test_fireflies_share_no_motion(share, seed) -> None:
    rng = np.random.default_rng(seed)
    frames = [excess(rng.integers(0, SHAPE, (int(share * 96 * 128), 2)), seed=seed + k) for k in (0, 9)]
    assert shared_motions(*map(find_bright, frames)) == []


def test_noise_that_stands_still_is_no_motion(flakes) -> None:
    bright = find_bright(excess(flakes))
    assert shared_motions(bright, bright) == []


def test_another_light_at_the_same_place_is_no_witness(flakes) -> None:
    here, there = excess(flakes), excess(flakes + np.array([9, 0]), light=9.0)
    assert not confirmed_by_neighbour(here, find_bright(here), there, find_bright(there), None).any()


def test_too_few_and_too_many_bright_pixels_tell_nothing() -> None:
    assert not find_bright(excess(np.array([[3, 4], [50, 60]]))).any()
    assert not find_bright(np.where(np.random.default_rng(4).random(SHAPE) < 0.2, 5, 0).astype(np.float32)).any()


def test_highlights_that_move_with_their_surfaces_are_left_to_the_denoiser(flakes) -> None:
    here, there = excess(flakes), excess(flakes + np.array([2, 9]), seed=3)
    flow = np.full((*SHAPE, 2), (9.5, 1.5), np.float32)
    bright = find_bright(here), find_bright(there)
    assert shared_motions(*bright) == [(2, 9)]
    assert not confirmed_by_neighbour(here, bright[0], there, bright[1], flow).any()
    assert confirmed_by_neighbour(here, bright[0], there, bright[1], -flow).any()


def neighbour(image: np.ndarray, flow: np.ndarray | None = None):
    return (image, find_bright(image)), flow


@pytest.mark.parametrize("times", [(-1, 1), (1,), (-1,)])
@pytest.mark.parametrize("motion", [(9, 0), (-3, 14)])
def test_lights_that_pass_steadily_are_found_with_their_motion(flakes, motion, times) -> None:
    here = excess(flakes)
    others = {t: neighbour(excess(flakes + t * np.array(motion), seed=5 + t)) for t in times}
    found, shared = passing_lights(here, find_bright(here), others)
    assert shared == motion
    assert (found == find_bright(here)).all()  # those that leave the frame too


def test_lights_that_turn_back_do_not_pass(flakes) -> None:
    here, there = excess(flakes), neighbour(excess(flakes + np.array([9, 0]), seed=3))
    assert not passing_lights(here, find_bright(here), {-1: there, 1: there})[0].any()


def test_noise_that_one_frame_confirms_by_chance_does_not_pass(flakes) -> None:
    """A third of the pixels move on, and the frame before shows others."""
    rng = np.random.default_rng(8)
    after = np.concatenate([flakes[:40] + np.array([9, 0]), rng.integers(0, SHAPE, (80, 2))])
    here, before = excess(flakes), rng.integers(0, SHAPE, (120, 2))
    others = {-1: neighbour(excess(before, seed=4)), 1: neighbour(excess(after, seed=3))}
    assert shared_motions(find_bright(here), others[1][0][1]) == [(9, 0)]
    assert not passing_lights(here, find_bright(here), others)[0].any()


@pytest.mark.parametrize("times", [(-1, 1), (1,)])
def test_the_edges_of_a_thing_do_not_pass(times) -> None:
    """Blocks of bright pixels have hundreds of motions from one to the other."""
    block = np.argwhere(np.ones((18, 18)))
    here = excess(block + np.array([40, 50]))
    others = {t: neighbour(excess(block + np.array([40 + 5 * t, 50]), seed=5 + t)) for t in times}
    assert not passing_lights(here, find_bright(here), others)[0].any()


def test_a_trail_is_where_aligned_neighbours_show_the_lights() -> None:
    """Surfaces move by (1, 2), rows and columns, a light by (4, 0): the second neighbour shows it once more.

    Lights that come over the edge behind the first neighbour are at its edge, and may be anywhere along it.
    """
    lights = np.zeros(SHAPE, bool)
    lights[20, 30] = lights[94, 3] = True
    flow = np.full((*SHAPE, 2), (2, 1), np.float32)
    trail = trail_of(lights, (4, 0), flow, 2)
    assert trail[:2].all()
    assert trail[:, -4:].all()
    assert np.argwhere(trail[2:, :-4]).tolist() == [[17, 28], [20, 26], [91, 1]]
    assert np.argwhere(trail_of(lights, (4, 0), None, 1)).tolist() == [[20, 30], [94, 3]]
