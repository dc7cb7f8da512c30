import numpy as np

from hybrid.alignment.neighbour import AGREEING, combine_confidence, novelty_of
from nlm.gate import color_gate


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
    trusted = combine_confidence(none, seen, gate, {"gate"})
    np.testing.assert_array_equal(trusted[0, :, :12], 0)
    np.testing.assert_allclose(trusted[0, :, 12:], AGREEING, rtol=1e-6)
    assert trusted[2].max() < 0.01 * AGREEING
    sure = combine_confidence(np.ones(shape, np.float32), np.ones(shape, np.float32), gate, set())
    np.testing.assert_array_equal(sure, 1)  # nobody has asked the gate
