"""Motion of reflections beside vectors of surfaces: a highlight over a texture, in frames with errors of their own."""

import numpy as np
import pytest

from flow.reflections import find_reflections

H, W, PLACE = 60, 80, (30, 40)
Y, X = np.mgrid[:H, :W]


def texture(x=0.0):
    return (0.4 + 0.1 * np.sin(0.7 * (X - x)) * np.cos(0.5 * Y))[..., None] * np.float32([1, 0.8, 0.6])


def highlight(y, x):
    return 3 * np.exp(-((Y - y) ** 2 + (X - x) ** 2) / 12)[..., None]


def window(motion, pan=0.0, frames=5, noise=0.01, light=highlight):
    """Frames of a surface that pans, with a highlight that moves otherwise, and the flows of the surface."""
    middle, rng = frames // 2, np.random.default_rng(1)
    pictures, flows = [], []
    for t in range(-middle, middle + 1):
        picture = texture(pan * t) + light(PLACE[0] + t * motion[1], PLACE[1] + t * (pan + motion[0]))
        pictures.append(np.float32(picture * (1 + noise * rng.normal(size=picture.shape))))
        flows.append(np.full((H, W, 2), np.float32((pan * t, 0))))
    return pictures, flows


@pytest.mark.parametrize("motion", [(2.0, 0.0), (-1.5, 1.0), (0.0, -3.0), (0.5, 0.5)])
@pytest.mark.parametrize("pan", [0.0, 1.3])
def test_a_highlight_is_followed_and_its_surface_stays(motion, pan):
    found = find_reflections(*window(motion, pan), 0.5)
    assert found.shape == (H, W, 2)
    np.testing.assert_allclose(found[PLACE], motion, atol=0.2)
    far = np.hypot(Y - PLACE[0], X - PLACE[1]) > 24
    assert np.mean(found[far].any(axis=-1)) < 0.02


def test_the_unit_of_light_does_not_matter():
    pictures, flows = window((2, 1))
    found = find_reflections(pictures, flows, 0.5)
    np.testing.assert_array_equal(find_reflections([p * 1024 for p in pictures], flows, 512), found)


def test_without_such_motion_nothing_is_found():
    assert find_reflections(*window((0, 0), 1.3, noise=0), 0.5) is None
    found = find_reflections(*window((0, 0), 1.3), 0.5)
    assert found is None or found.any(axis=-1).mean() < 0.02


def test_frames_on_both_sides_are_needed():
    pictures, flows = window((2, 0))
    assert find_reflections(pictures, [*flows[:3], None, None], 0.5) is None
    assert find_reflections([None, None, *pictures[2:]], flows, 0.5) is None
    found = find_reflections(pictures, [None, *flows[1:4], None], 0.5)
    np.testing.assert_allclose(found[PLACE], (2, 0), atol=0.3)


def test_light_that_leaves_the_frame_is_not_followed():
    """Two frames on, the highlight is 6 pixels beyond the border."""
    found = find_reflections(*window((0, -3), light=lambda y, x: highlight(y - 30, x)), 0.5)
    assert found is None or not found[0].any()


def test_black_frames_and_one_of_nan_are_no_motion():
    pictures, flows = window((2, 0))
    assert find_reflections([np.zeros_like(p) for p in pictures], flows, 1.0) is None
    pictures[1][:] = np.nan
    assert find_reflections(pictures, flows, 0.5) is None
