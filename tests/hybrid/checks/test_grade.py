import numpy as np
import pytest

from hybrid.checks.grade import find_grade


def shot(noise: float = 1.0, object_share: float = 1.0) -> tuple[np.ndarray, np.ndarray]:
    rng = np.random.default_rng(5)
    coarse = rng.uniform(0.05, 1, (16, 24, 3)) ** 2
    clean = np.float32(np.kron(coarse, np.ones((8, 8, 1))))
    if object_share < 1:
        side = int(128 * object_share**0.5)
        black = np.zeros_like(clean)
        black[:side, :side] = clean[:side, :side]
        clean = black
    shape = 1 / noise**2
    return clean, np.float32(clean * rng.gamma(shape, 1 / shape, clean.shape))


@pytest.mark.parametrize("noise", [0.1, 0.5, 1.0, 2.0])
@pytest.mark.parametrize("share", [1.0, 0.2])
@pytest.mark.parametrize("scale", [1e-4, 1.0, 1e4])
def test_a_healthy_picture_is_not_touched(noise, share, scale) -> None:
    clean, samples = shot(noise, share)
    assert find_grade([(clean * np.float32(scale), samples * np.float32(scale))]) is None


def test_fireflies_lamps_logos_and_lags_are_no_grade() -> None:
    clean, samples = shot(0.5)
    rng = np.random.default_rng(6)
    fireflies = samples.copy()
    fireflies[rng.integers(0, 128, 20), rng.integers(0, 192, 20)] = 500
    lamp = clean.copy(), samples.copy()
    for picture in lamp:
        picture[60:62, 60:62] = 1000
    logo = clean.copy()
    logo[100:120, 150:185] = 1
    lag = np.roll(clean, 2, axis=1)
    for pair in ((clean, fireflies), lamp, (logo, samples), (lag, samples)):
        assert find_grade([pair]) is None


@pytest.mark.parametrize("noise", [0.1, 1.0])
@pytest.mark.parametrize("share", [1.0, 0.2])
@pytest.mark.parametrize("factors", [(0.5, 0.5, 0.5), (2, 2, 2), (1.8, 1.8, 1.8), (1.3, 1, 0.7)], ids=str)
def test_an_exposure_and_gains_of_channels_are_found(noise, share, factors) -> None:
    clean, samples = shot(noise, share)
    grade = find_grade([(clean * np.float32(factors), samples)])
    assert grade is not None
    assert grade.factors == pytest.approx(1 / np.array(factors), rel=0.05)


def test_a_curve_is_no_factor() -> None:
    clean, samples = shot(0.5)
    grade = find_grade([(clean ** np.float32(1 / 2.2), samples)])
    assert grade is not None
    assert grade.factors is None


def test_black_pictures_tell_nothing() -> None:
    black = np.zeros((64, 96, 3), np.float32)
    assert find_grade([(black, black)]) is None
    assert find_grade([(black[:4, :4], black[:4, :4])]) is None
