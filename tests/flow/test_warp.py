import cv2
import numpy as np
import pytest
from numba import njit

from flow.warp import RowOfPlaces, interpolate_row, locate_row, warp, warp_block


def random_flow(rng: np.random.Generator, height: int, width: int, length: float) -> np.ndarray:
    return rng.uniform(-length, length, (height, width, 2)).astype(np.float32)


def bilinear_reference(image: np.ndarray, flow: np.ndarray) -> np.ndarray:
    """The definition, pixel by pixel, in float64."""
    height, width = image.shape[:2]
    out = np.zeros(image.shape)
    for y in range(height):
        for x in range(width):
            px = min(max(x + float(flow[y, x, 0]), 0), width - 1)
            py = min(max(y + float(flow[y, x, 1]), 0), height - 1)
            x0, y0 = int(px), int(py)
            x1, y1 = min(x0 + 1, width - 1), min(y0 + 1, height - 1)
            fx, fy = px - x0, py - y0
            top = (1 - fx) * image[y0, x0] + fx * image[y0, x1]
            out[y, x] = (1 - fy) * top + fy * ((1 - fx) * image[y1, x0] + fx * image[y1, x1])
    return out


@pytest.mark.parametrize("interpolation", ["nearest", "bilinear", "bicubic"])
@pytest.mark.parametrize("shape", [(1, 1), (1, 7), (6, 1, 2), (5, 5, 3), (13, 17, 10)])
def test_no_motion_is_the_identity(interpolation: str, shape: tuple[int, ...]) -> None:
    image = np.random.default_rng(0).normal(size=shape).astype(np.float32)
    warped, inside = warp(image, np.zeros((*shape[:2], 2), np.float32), interpolation=interpolation)
    np.testing.assert_array_equal(warped, image)
    assert warped.dtype == np.float32
    assert inside.all()


@pytest.mark.parametrize("interpolation", ["nearest", "bilinear", "bicubic"])
def test_whole_pixels_are_copied_and_spread_no_nan(interpolation: str) -> None:
    image = np.random.default_rng(1).random((9, 11), np.float32)
    image[4, 5] = np.nan
    flow = np.broadcast_to(np.float32([2, -1]), (9, 11, 2))
    warped, inside = warp(image, flow, interpolation=interpolation)
    np.testing.assert_array_equal(warped[1:, :9], image[:-1, 2:])
    assert inside[1:, :9].all()
    assert not inside[0].any()
    assert not inside[:, 9:].any()
    assert np.isnan(warped).sum() == 1


def test_bilinear_matches_the_definition() -> None:
    rng = np.random.default_rng(2)
    image, flow = rng.random((14, 19, 10), np.float32), random_flow(rng, 14, 19, 6)
    # float32 positions below 32 have steps of 2e-6, times a slope of at most 1.
    np.testing.assert_allclose(warp(image, flow)[0], bilinear_reference(image, flow), atol=1e-5)


def test_nearest_takes_the_pixel_that_the_position_lies_on() -> None:
    rng = np.random.default_rng(2)
    image, flow = rng.random((14, 19, 3), np.float32), random_flow(rng, 14, 19, 6)
    flow[3, 4] = np.nan
    warped, inside = warp(image, flow, interpolation="nearest")
    assert not inside[3, 4]
    y, x = np.mgrid[:14, :19]
    flow[3, 4] = -x[3, 4], -y[3, 4]  # what is not finite falls to the first pixel
    # Half a pixel belongs to the next: np.rint would take the even one.
    column = np.clip(np.floor(x + flow[..., 0] + 0.5), 0, 18).astype(int)
    row = np.clip(np.floor(y + flow[..., 1] + 0.5), 0, 13).astype(int)
    np.testing.assert_array_equal(warped, image[row, column])


def test_bilinear_agrees_with_opencv() -> None:
    rng = np.random.default_rng(3)
    image, flow = rng.random((30, 40, 3), np.float32), random_flow(rng, 30, 40, 5)
    y, x = np.mgrid[:30, :40].astype(np.float32)
    expected = cv2.remap(image, x + flow[..., 0], y + flow[..., 1], cv2.INTER_LINEAR, borderMode=cv2.BORDER_REPLICATE)
    # OpenCV before 5 quantises positions to 1/32 px: half a step in x and y on slopes of up to 1.
    np.testing.assert_allclose(warp(image, flow)[0], expected, atol=1 / 32)


def test_bicubic_is_exact_on_a_parabola_and_better_than_bilinear() -> None:
    y, x = np.mgrid[:24, :24].astype(np.float32)
    flow = np.broadcast_to(np.float32([0.3, -0.4]), (24, 24, 2))

    def surface(x: np.ndarray, y: np.ndarray) -> np.ndarray:
        return 0.01 * (x + 4) ** 2 + 0.02 * x * (y + 4)

    # Catmull-Rom reproduces quadratics; the clamp is idle because the surface rises in x and in y.
    inner = (slice(3, -3), slice(3, -3))
    expected = surface(x + 0.3, y - 0.4)[inner]
    cubic = warp(surface(x, y), flow, interpolation="bicubic")[0][inner]
    linear = warp(surface(x, y), flow)[0][inner]
    np.testing.assert_allclose(cubic, expected, rtol=1e-5)
    assert np.abs(linear - expected).max() > 1e-3


def test_bicubic_stays_within_its_neighbours_beside_a_firefly() -> None:
    image = np.zeros((9, 9), np.float32)
    image[4, 4] = 1e6
    rng = np.random.default_rng(4)
    for _ in range(20):
        warped, _ = warp(image, random_flow(rng, 9, 9, 2), interpolation="bicubic")
        assert warped.min() >= 0
        assert warped.max() <= 1e6


def test_outside_has_the_edge_value_and_half_a_pixel_is_still_inside() -> None:
    image = np.arange(12, dtype=np.float32).reshape(3, 4)
    flow = np.zeros((3, 4, 2), np.float32)
    flow[0, 0] = -0.5, 0
    flow[1, 0] = -0.6, 0
    flow[2, 3] = 1e9, -1e9
    warped, inside = warp(image, flow)
    assert warped[0, 0] == image[0, 0]
    assert warped[1, 0] == image[1, 0]
    assert warped[2, 3] == image[0, 3]
    np.testing.assert_array_equal(np.argwhere(~inside), [[1, 0], [2, 3]])


@pytest.mark.parametrize("interpolation", ["nearest", "bilinear", "bicubic"])
def test_vectors_that_are_not_finite_are_outside(interpolation: str) -> None:
    image = np.ones((5, 6, 2), np.float32)
    flow = np.zeros((5, 6, 2), np.float32)
    flow[0, 0, 0], flow[2, 3, 1], flow[4, 5, 0] = np.nan, np.inf, -np.inf
    warped, inside = warp(image, flow, interpolation=interpolation)
    assert np.isfinite(warped).all()
    np.testing.assert_array_equal(np.argwhere(~inside), [[0, 0], [2, 3], [4, 5]])


def test_images_longer_than_opencv_takes() -> None:
    image = np.arange(40_000, dtype=np.float32)[None]
    warped, _ = warp(image, np.broadcast_to(np.float32([1, 0]), (1, 40_000, 2)))
    np.testing.assert_array_equal(warped[0, :-1], image[0, 1:])


def test_errors_name_the_argument() -> None:
    image, flow = np.zeros((4, 5)), np.zeros((4, 5, 2))
    with pytest.raises(ValueError, match="interpolation is 'lanczos'"):
        warp(image, flow, interpolation="lanczos")
    with pytest.raises(ValueError, match=r"flow has shape \(5, 4, 2\), expected \(4, 5, 2\)"):
        warp(image, np.zeros((5, 4, 2)))
    with pytest.raises(ValueError, match="image has shape"):
        warp(np.zeros((0, 5)), np.zeros((0, 5, 2)))


@pytest.mark.parametrize("interpolation", ["bilinear", "bicubic", "nearest"])
def test_the_result_is_written_where_it_is_asked_for(interpolation: str) -> None:
    rng = np.random.default_rng(7)
    image, flow = rng.random((9, 11, 3), np.float32), rng.normal(size=(9, 11, 2)).astype(np.float32)
    window = np.zeros((2, 9, 11, 3), np.float32)
    warped, inside = warp(image, flow, interpolation=interpolation, out=window[1])
    expected, expected_inside = warp(image, flow, interpolation=interpolation)
    assert np.shares_memory(warped, window)
    np.testing.assert_array_equal(window[1], expected)
    np.testing.assert_array_equal(inside, expected_inside)
    assert not window[0].any()


@pytest.mark.parametrize("out", [np.zeros((9, 11, 2), np.float32), np.zeros((9, 11, 3)), np.zeros((3, 9, 11), "f4").T])
def test_a_place_that_does_not_fit_is_refused(out: np.ndarray) -> None:
    image, flow = np.zeros((9, 11, 3), np.float32), np.zeros((9, 11, 2), np.float32)
    with pytest.raises(ValueError, match="out is float"):
        warp(image, flow, out=out)


@njit
def _row_and_places(flow: np.ndarray, image: np.ndarray, y: int) -> tuple[RowOfPlaces, np.ndarray]:
    planes = np.empty((image.shape[2], flow.shape[1]), np.float32)
    places = locate_row(flow, y, (3, 2), image.shape[1], image.shape[0], flow.shape[1])
    interpolate_row(image, places, planes)
    return places, planes


@pytest.mark.parametrize("channels", [1, 2, 3])
def test_the_places_of_a_row_are_those_of_its_pixels(channels: int) -> None:
    rng = np.random.default_rng(3)
    image = rng.random((20, 30, channels)).astype(np.float32)
    flow = rng.normal(0, 12, (10, 25, 2)).astype(np.float32)
    flow[4, :5] = [[0, 0], [np.nan, 1], [1, np.inf], [-np.inf, 0], [-2.5, -7.5]]
    whole = np.zeros((20, 30, 2), np.float32)
    whole[3:13, 2:27] = flow
    warped, inside = warp(image, whole)
    block, block_inside = warp_block(image, flow, (3, 2))
    np.testing.assert_array_equal(block, warped[3:13, 2:27])
    np.testing.assert_array_equal(block_inside, inside[3:13, 2:27])
    for y in (0, 4, 9):
        places, planes = _row_and_places(flow, image, y)
        np.testing.assert_array_equal(places.inside, inside[3 + y, 2:27])
        np.testing.assert_array_equal(planes.T, warped[3 + y, 2:27])
        known = np.isfinite(flow[y]).all(axis=-1)
        ends = flow[y, known] + np.float32([[2 + x, 3 + y] for x in np.flatnonzero(known)])
        found = np.stack([places.x0 + places.fx, places.y0 + places.fy], axis=-1)[known]
        np.testing.assert_allclose(found, np.clip(ends, 0, [29, 19]), atol=1e-5)  # the rounding of a sum in float32
    assert not inside.all()


def test_an_empty_flow_stays_where_it_is() -> None:
    places = locate_row(np.empty((0, 0, 0), np.float32), 2, (5, 7), 30, 20, 4)
    assert (places.x0 == [7, 8, 9, 10]).all()
    assert (places.y0 == 7).all()
    assert places.inside.all()
    assert not places.fx.any()
    assert not places.fy.any()
