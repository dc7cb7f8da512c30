"""A neighbour warped to the centre, and how far it is trusted."""

from __future__ import annotations

import numpy as np
import pytest

from flow.confidence import find_coverage
from hybrid.alignment.neighbour import AGREEING, layers_of, novelty_of, trust_light, warp_layers
from hybrid.alignment.prepare import prepare
from hybrid.files.shots import open_shot
from nlm.gate import color_gate
from tests.scenes import Scene

SCENE = Scene(frames=2, step=(0, 0))
ROWS = slice(5, 30)


@pytest.fixture
def frame(tmp_path):
    return prepare(open_shot(SCENE.write(tmp_path)).read(SCENE.first))


@pytest.mark.parametrize("step", [0, 2])
def test_layers_are_moved_and_what_was_not_measured_is_not_shown(frame, step):
    valid = frame.valid.copy()
    valid[20, 30] = False
    flow = np.full((25, frame.valid.shape[1], 2), (step, 0), np.float32)
    warped = {name: np.empty((25, *layer.shape[1:]), np.float32) for name, layer in layers_of(frame).items()}
    warp_layers(frame, flow, ROWS, warped)
    shown = find_coverage(flow, np.ones(flow.shape[:2], bool), valid, ROWS.start)
    assert {"color", "albedo", "normal"} <= {*warped}
    inside = slice(None, -step or None)
    for name, layer in warped.items():
        np.testing.assert_array_equal(layer[:, inside], layers_of(frame)[name][ROWS, step:])  # whole pixels
    assert not shown[20 - ROWS.start, 30 - step]
    assert np.count_nonzero(~shown[:, inside]) == 1
    assert not shown[:, shown.shape[1] - step :].any()  # beyond the border


def test_noise_of_one_seed_is_new_where_the_picture_has_moved():
    flow = np.zeros((1, 4, 2), np.float32)
    flow[0, :, 0] = 0.5, -1, 1.5, 9
    np.testing.assert_allclose(novelty_of(flow)[0], [0, 0.5, 1, 1])


def test_light_decides_where_geometry_does_not_trust_and_nothing_where_nothing_is_seen():
    shape = 3, 24, 24
    light = np.ones((*shape, 3), np.float32)
    light[2] = 4  # another light
    seen, none = np.ones(shape, np.float32), np.zeros(shape, np.float32)
    seen[0, :, :12] = 0
    gate = color_gate(light, light[1], 1.0)
    trusted = trust_light(none, seen, gate, {"gate"})
    np.testing.assert_array_equal(trusted[0, :, :12], 0)
    np.testing.assert_allclose(trusted[0, :, 12:], AGREEING, rtol=1e-6)
    assert trusted[2].max() < 0.01 * AGREEING
    sure = trust_light(np.ones(shape, np.float32), np.ones(shape, np.float32), gate, set())
    np.testing.assert_array_equal(sure, 1)  # nobody has asked the gate
