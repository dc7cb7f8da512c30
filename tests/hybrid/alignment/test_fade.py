"""Factors of light between two frames."""

import numpy as np
import pytest

from hybrid.alignment.fade import NO_FADE, inverse, measure_fade, relit, scaled
from hybrid.alignment.prepare import prepare
from hybrid.files.frame import Frame

SHAPE = (96, 128, 3)
EVERYWHERE = np.ones(SHAPE[:2], bool)


def noisy(seed: int, factor=(1.0, 1.0, 1.0)) -> np.ndarray:
    rng = np.random.default_rng(seed)
    light = np.linspace(0.2, 2, SHAPE[1], dtype=np.float32)[:, None] * np.array(factor, np.float32)
    return (light * rng.gamma(16, 1 / 16, (*SHAPE[:2], 1))).astype(np.float32)


@pytest.mark.parametrize("fade", [(0.5, 0.5, 0.5), (1.3, 1.3, 1.3), (0.7, 1.0, 1.3)])
def test_one_change_of_all_light_is_a_fade_for_each_channel(fade):
    found = measure_fade(noisy(1), noisy(2, fade), EVERYWHERE)
    assert found == pytest.approx(fade, rel=0.02)


def test_light_that_changes_in_half_of_the_picture_is_no_fade():
    changed = noisy(2)
    changed[:, :64] *= 2
    assert (measure_fade(noisy(1), changed, EVERYWHERE) == 1).all()


@pytest.mark.parametrize("uneven", [1.0, 4.0])
def test_a_lamp_that_is_switched_on_is_no_fade(uneven):
    """It lights one side more; taken for a fade its pattern of light was a ghost in the frame before, 4 dB worse."""
    lamp = np.float32(6) * np.geomspace(1 / uneven, 1, SHAPE[0], dtype=np.float32)[:, None, None]
    found = measure_fade(noisy(1), noisy(2) * lamp, EVERYWHERE)
    assert found == pytest.approx((6, 6, 6) if uneven == 1 else NO_FADE, rel=0.02)


def test_noise_alone_is_no_fade():
    assert measure_fade(noisy(1), noisy(2), EVERYWHERE) == pytest.approx(NO_FADE)


def test_a_relit_frame_has_the_light_of_the_centre_and_its_own_parts_likewise():
    fade = (0.5, 0.6, 0.8)
    first, second = (
        prepare(Frame(number, color, aovs={"part": part}))
        for number, color, part in ((1, noisy(1), noisy(3)), (2, noisy(2, fade), noisy(4, (0.25, 0.25, 0.25))))
    )
    found = relit(first, fade, second)
    np.testing.assert_allclose(found.irradiance, first.irradiance * np.array(fade, np.float32), rtol=1e-6)
    np.testing.assert_allclose(found.aovs["part"], 0.25 * first.aovs["part"], rtol=0.02)
    back = scaled(found, inverse(fade))
    np.testing.assert_allclose(back.irradiance, first.irradiance, rtol=1e-6)
