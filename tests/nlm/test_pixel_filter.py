import cv2
import numpy as np
import pytest

from nlm.pixel_filter import find_filter, measure_alone, measure_correlation

SHAPE = 192, 256
NOTHING = np.zeros(SHAPE, np.float32)


def white(seed: int) -> np.ndarray:
    """Noise with the long tail of few samples."""
    return (np.random.default_rng(seed).gamma(0.3, 1, SHAPE) - 0.3).astype(np.float32)


def spread(noise: np.ndarray, r: float) -> np.ndarray:
    taps = np.array([r, 1, r], np.float32) / (1 + 2 * r)
    return cv2.sepFilter2D(noise, -1, taps, taps, borderType=cv2.BORDER_REFLECT_101)


def measured(noise: np.ndarray, trusted: np.ndarray | None = None) -> np.ndarray:
    found = measure_correlation(noise, np.ones(SHAPE, bool) if trusted is None else trusted, NOTHING)
    assert found is not None
    return found


@pytest.mark.parametrize("r", [0, 0.1, 0.2, 0.3, 0.45])
def test_the_correlation_is_that_of_the_filter(r):
    taps = np.array([r, 1, r])
    lags = np.convolve(taps, taps)[3:] / np.square(taps).sum()
    expected = [*lags, 0, 0]
    np.testing.assert_allclose(measured(spread(white(1), r)), [expected, expected], atol=0.04)


def test_each_direction_is_measured_by_itself():
    taps = np.array([0.2, 1, 0.2], np.float32)
    across = cv2.sepFilter2D(white(1), -1, taps, np.ones(1, np.float32))
    (x, *_), (y, *_) = measured(across)
    assert x == pytest.approx(0.37, abs=0.03)
    assert y == pytest.approx(0, abs=0.03)


def test_light_that_moves_is_no_correlation():
    noise = white(1)
    noise[:, :80] += 3 * np.sin(np.arange(80, dtype=np.float32) / 2)  # a third of the picture
    assert abs(measured(noise)[:, 0]).max() < 0.06


def test_pixels_that_are_not_trusted_and_bright_samples_decide_nothing():
    noise = spread(white(1), 0.2)
    expected = measured(noise)
    noise[60, 70] = 1e6
    assert measured(noise) == pytest.approx(expected, abs=0.03)
    noise[:, :80], trusted = 1e3, np.ones(SHAPE, bool)
    trusted[:, :84] = False
    assert measured(noise, trusted) == pytest.approx(expected, abs=0.05)


def test_the_unit_of_light_does_not_matter():
    noise = spread(white(1), 0.2)
    np.testing.assert_array_equal(measured(1024 * noise), measured(noise))


def test_too_little_noise_gives_no_correlation():
    everywhere = np.ones(SHAPE, bool)
    assert measure_correlation(white(1), everywhere, np.full(SHAPE, 10, np.float32)) is None
    assert measure_correlation(NOTHING, everywhere, NOTHING) is None
    assert measure_correlation(white(1), np.zeros(SHAPE, bool), NOTHING) is None
    small = np.s_[:16, :64]  # four tiles
    assert measure_correlation(white(1)[small], everywhere[small], NOTHING[small]) is None


def rendered(r: float, noise: float = 0.1) -> np.ndarray:
    """A picture of smooth light and edges, with noise, as a pixel filter shows both."""
    y, x = np.mgrid[: SHAPE[0], : SHAPE[1]].astype(np.float32)
    light = 2 + np.sin(x / 20) * np.cos(y / 25) + (x > 100) + 2 * (y > 90) + 3 * (x + 2 * y > 500)
    return spread(light * (1 + noise * white(1)), r)


def alone(image: np.ndarray) -> tuple[np.ndarray, float]:
    found = measure_alone(image, np.ones(SHAPE, bool), NOTHING, NOTHING)
    assert found is not None
    return found


@pytest.mark.parametrize("r", [0, 0.1, 0.2, 0.3, 0.45])
def test_the_correlation_is_measured_in_one_frame_whose_light_differs(r):
    taps = np.array([r, 1, r])
    lags = np.convolve(taps, taps)[3:] / np.square(taps).sum()
    expected = [*lags, 0, 0]
    found, least = alone(rendered(r))
    # By fewer independent differences than between frames.
    np.testing.assert_allclose(found, [expected, expected], atol=0.06)
    assert 0.03 < lags[0] - least < 0.2  # the spread of single tiles


def test_in_one_frame_detail_in_less_than_three_quarters_is_no_certain_correlation():
    detail = cv2.GaussianBlur(white(3), (0, 0), 1)
    image = white(1) + np.where(np.arange(SHAPE[1]) < 0.6 * SHAPE[1], 100 * detail, 0).astype(np.float32)
    found, least = alone(image)
    assert found[:, 0].min() > 0.4
    assert least < 0.1


def test_in_one_frame_each_direction_is_measured_by_itself():
    across = cv2.sepFilter2D(white(1), -1, np.array([0.2, 1, 0.2], np.float32), np.ones(1, np.float32))
    for image, order in ((across, slice(None)), (np.ascontiguousarray(across.T), slice(None, None, -1))):
        found = measure_alone(image, np.ones(image.shape, bool), *np.zeros((2, *image.shape), np.float32))
        assert found is not None
        (x, *_), (y, *_) = found[0][order]
        assert x == pytest.approx(0.37, abs=0.05)
        assert y == pytest.approx(0, abs=0.05)
        assert found[1] < 0


def test_in_one_frame_pixels_that_are_not_trusted_and_bright_samples_decide_nothing():
    noise = spread(white(1), 0.2)
    expected, _ = alone(noise)
    noise[60, 70] = 1e4
    assert alone(noise)[0] == pytest.approx(expected, abs=0.03)
    noise[:, :80], trusted = 1e3 * white(2)[:, :80], np.ones(SHAPE, bool)
    trusted[:, :80] = False
    found = measure_alone(noise, trusted, NOTHING, NOTHING)
    assert found is not None
    assert found[0] == pytest.approx(expected, abs=0.06)


@pytest.mark.parametrize(("share", "known"), [(0.3, True), (0.7, False)])
def test_in_one_frame_most_of_the_noise_must_exceed_texture(share, known):
    texture = np.where(np.arange(SHAPE[1]) < share * SHAPE[1], np.float32(10), np.float32(0)) * np.ones_like(NOTHING)
    assert (measure_alone(white(1), np.ones(SHAPE, bool), NOTHING, texture) is not None) == known


def test_too_little_noise_in_one_frame_gives_no_correlation():
    everywhere = np.ones(SHAPE, bool)
    for levels in ((np.full(SHAPE, 10, np.float32), NOTHING), (NOTHING, np.full(SHAPE, 10, np.float32))):
        assert measure_alone(white(1), everywhere, *levels) is None
    assert measure_alone(NOTHING, everywhere, NOTHING, NOTHING) is None
    assert measure_alone(white(1), np.zeros(SHAPE, bool), NOTHING, NOTHING) is None
    for small in (np.s_[:16, :96], np.s_[:8, :8], np.s_[:3, :200]):
        assert measure_alone(white(1)[small], everywhere[small], NOTHING[small], NOTHING[small]) is None


@pytest.mark.parametrize("r", [0.1, 0.2, 0.3])
def test_a_filter_undone_leaves_white_noise_and_applied_again_the_image(r):
    image = spread(white(1), r)[..., None]
    found = find_filter(measured(image[..., 0]))
    undone = found.undo(image)
    assert abs(measured(undone[..., 0])).max() < 0.05
    assert undone.var() == pytest.approx(found.gain * image.var(), rel=0.1)
    np.testing.assert_allclose(found.apply(undone), image, atol=2e-3 * image.std())


def test_a_small_picture_gets_no_halos():
    """Correlations of 80×48 pixels, which err by 0.05: the edge of a lamp was spread by a twentieth of it."""
    lamp = np.full((40, 60), 0.05, np.float32)
    lamp[10:30, 20:40] = 5
    seen = spread(lamp, 0.2)[..., None]
    for along_x, along_y in (
        ((0.423, 0.083, 0.066, 0.021), (0.394, 0.089, 0.028, -0.02)),
        ((0.417, 0.067, 0.107, 0.062), (0.345, 0.086, 0.067, 0.051)),
        ((0.389, -0.006, -0.058, -0.029), (0.446, 0.141, 0.003, -0.019)),
    ):
        found = find_filter(np.array([along_x, along_y]))
        shown = found.apply(np.maximum(found.undo(seen), 0))  # denoisers count negative light as 0
        np.testing.assert_allclose(shown, seen, atol=0.12)


def test_a_constant_stays():
    found = find_filter(np.array([[0.4, 0.05, 0, 0], [0.3, 0.02, 0, 0]]))
    flat = np.full((20, 30, 3), 5, np.float32)
    np.testing.assert_allclose(found.undo(flat), flat, rtol=1e-5)
    np.testing.assert_allclose(found.apply(flat), flat, rtol=1e-5)


def test_what_a_wide_filter_leaves_of_no_frequency_is_not_amplified():
    found = find_filter(np.array([[0.8, 0.4, 0.1, 0], [0.8, 0.4, 0.1, 0]]))
    assert np.abs(np.outer(found.inverse, found.inverse)).sum() < 1000  # without the least power millions
