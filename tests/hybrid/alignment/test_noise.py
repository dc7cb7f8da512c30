"""The noise of frames: which samples two frames share, and how it correlates."""

from dataclasses import replace

import cv2
import numpy as np
import pytest

from hybrid.alignment.noise import (
    FEW,
    FIXED_NOISE_ABOVE,
    REPEATED,
    Grain,
    correlation_alone,
    equal_noise,
    fixed_noise,
    noise_correlation,
    repeats,
)
from hybrid.alignment.prepare import prepare
from hybrid.files.frame import Frame
from tests.reliability.test_noise_ladder import scene


@pytest.mark.parametrize("changed", [0.0, 0.005, 0.009, 0.02, 0.05, 1.0])
@pytest.mark.parametrize("top", [False, True])
def test_strips_find_what_the_whole_picture_shows(changed, top):
    rng = np.random.default_rng(0)
    here = rng.gamma(1, 1, (200, 50, 3)).astype(np.float32)
    there, count = here.copy(), round(changed * 200)
    rows = slice(0, count) if top else slice(200 - count, 200)
    there[rows] = rng.gamma(1, 1, there[rows].shape)
    grainy, equal = (np.count_nonzero(part) for part in equal_noise(Grain(here), Grain(there)))
    expected = grainy >= FEW and equal >= REPEATED * grainy
    assert repeats(here, there) == expected
    assert expected == (changed < 0.01)


def test_pictures_without_noise_repeat_nothing():
    assert not repeats(np.ones((70, 20, 3), np.float32), np.ones((70, 20, 3), np.float32))


@pytest.mark.parametrize("half", [True, False])
@pytest.mark.parametrize("noise", [0.0005, 0.001, 0.003])
def test_noise_of_a_thousandth_is_not_taken_for_the_noise_of_one_seed(noise, half):
    """Every second sample lay within 0.1 % of its neighbour's: still shots next to convergence lost their window."""
    rng = np.random.default_rng(1)
    detail = rng.uniform(0.2, 0.8, (96, 128, 3))

    def frame(number, grain):
        color = (detail * grain).astype(np.float16 if half else np.float32)
        return prepare(Frame(number=number, color=color.astype(np.float32)))

    grains = rng.normal(1, noise, (2, 96, 128, 1))
    assert abs(fixed_noise(frame(1, grains[0]), frame(2, grains[1]), moves=False)) < 0.6 * FIXED_NOISE_ABOVE
    assert fixed_noise(frame(1, grains[0]), frame(2, grains[0]), moves=False) == pytest.approx(1, abs=0.01)


@pytest.mark.parametrize("lit", [0.1, 0.5])
def test_pixels_that_one_sample_hits_or_misses_have_no_fixed_noise(lit):
    """Most pixels were equal by chance: black, or with the whole light of a lamp."""
    rng = np.random.default_rng(4)
    hits = (rng.random((2, 96, 128, 1)) < lit) * np.ones(3, np.float32) / lit
    first, second = (prepare(Frame(number=n, color=hit)) for n, hit in enumerate(hits))
    assert abs(fixed_noise(first, second, moves=False)) < 0.3 * FIXED_NOISE_ABOVE
    light = rng.uniform(0.5, 1, (2, 96, 128, 1)).astype(np.float32)
    first, second = (prepare(Frame(number=n, color=hit)) for n, hit in enumerate(hits * light))
    again = replace(first, number=2)
    assert abs(fixed_noise(first, second, moves=False)) < 0.3 * FIXED_NOISE_ABOVE
    assert fixed_noise(first, again, moves=False) == pytest.approx(1, abs=0.01)
    grainy, equal = equal_noise(Grain(first.irradiance), Grain(second.irradiance))
    assert grainy.any()
    assert not equal.any()
    assert repeats(first.irradiance, again.irradiance)


@pytest.mark.parametrize("light", [(1, 1, 1), (1.2, 1.2, 1.2), (0.05, 0.05, 0.05), (0.8, 1.1, 1.3)])
@pytest.mark.parametrize("filtered", [False, True])
def test_light_that_changes_between_frames_is_no_correlation_of_their_noise(light, filtered):
    """Texture that no albedo has, at 1 % of noise: a fade of 20 % was taken for a pixel filter of 0.4, and undone."""
    rng = np.random.default_rng(2)
    detail = np.kron(rng.uniform(0.2, 0.8, (40, 60, 1)), np.ones((4, 4, 3)))
    taps = np.array([0.2, 1, 0.2]) / 1.4

    def frame(number, factor):
        noise = rng.normal(0, 0.01, (160, 240, 1))
        noise = cv2.sepFilter2D(noise, -1, taps, taps)[..., None] if filtered else noise
        color = np.float32(detail * (1 + noise) * factor)
        return prepare(Frame(number=number, color=color, albedo=np.full_like(color, 0.5)))

    along_x, along_y = noise_correlation(frame(1, (1, 1, 1)), frame(2, light))
    expected = 0.4 / 1.08 if filtered else 0
    assert (along_x[0], along_y[0]) == pytest.approx((expected, expected), abs=0.04)


def test_an_object_on_black_has_no_correlation_of_noise_at_its_outline():
    """At 10 % of noise its outline was taken for a pixel filter of 0.16, as black pixels were counted."""

    def frame(number):
        layers, color = scene("object", number)
        grain = np.random.default_rng((2, number)).gamma(100, 0.01, (*color.shape[:2], 1))
        albedo = layers["ViewLayer.Denoising Albedo"].astype(np.float32)
        return prepare(Frame(number=number, color=(color * grain).astype(np.float32), albedo=albedo))

    correlation = noise_correlation(frame(1), frame(2))
    assert correlation is None or np.abs(correlation).max() < 0.1


def test_frames_without_common_light_have_no_correlation():
    color = np.random.default_rng(2).gamma(4, 0.1, (160, 240, 3)).astype(np.float32)
    lit, black = (
        Frame(number=1, color=color * k, albedo=np.full_like(color, 0.5)) for k in (np.float32(1), np.float32(0))
    )
    assert noise_correlation(prepare(lit), prepare(black)) is None


def test_equal_frames_without_noise_have_a_correlation_of_0():
    """So that the frame after is not read for it."""
    color = np.random.default_rng(2).gamma(4, 0.1, (160, 240, 3)).astype(np.float32)
    frame = prepare(Frame(number=1, color=color, albedo=np.full_like(color, 0.5)))
    assert not np.any(noise_correlation(frame, frame))


def test_texture_is_no_noise_of_a_frame_alone():
    """A photograph that guides do not show has the correlation of a filter without having noise."""
    rng = np.random.default_rng(2)
    fine = cv2.GaussianBlur(rng.gamma(2, 1, (160, 240, 3)).astype(np.float32), (0, 0), 0.6)
    albedo = np.where(np.arange(240)[:, None] < 120, np.float32(0.3), np.float32(0.6)) * np.ones_like(fine)
    normal = np.zeros_like(fine)
    normal[..., 2] = 1

    def found(**guides):
        return correlation_alone(prepare(Frame(number=1, color=fine, **guides)))

    assert found(albedo=albedo, normal=normal)[1] > 0.2  # this is noise for all that the guides show
    for guides in ({}, {"albedo": albedo}, {"normal": normal}):
        assert found(**guides) is None
    assert found(albedo=np.full_like(fine, 0.5), normal=normal) is None
    assert found(albedo=albedo, normal=np.zeros_like(normal)) is None  # behind the scene
    assert (
        correlation_alone(prepare(Frame(number=1, color=fine, albedo=albedo, normal=normal), demodulated=False)) is None
    )
    painted = 0.1 + 0.8 * fine / fine.max()
    for highlight in (0, 0.2):  # as bright on dark paint as on bright
        shown = Frame(number=1, color=painted + np.float32(highlight), albedo=painted, normal=normal)
        assert correlation_alone(prepare(shown)) is None
