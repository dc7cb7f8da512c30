import numpy as np
import pytest

from hybrid.neural.tiling import image_of, pad, tensor_of, tiles


def test_a_picture_comes_back_from_its_tensor() -> None:
    image = np.random.default_rng(0).random((5, 7, 3), np.float32)
    tensor = tensor_of(image[None])
    assert tensor.shape == (1, 1, 3, 5, 7)
    np.testing.assert_array_equal(image_of(tensor[:, 0]), image)


def test_edges_are_repeated_up_to_a_multiple() -> None:
    window = np.arange(2 * 3 * 5, dtype=np.float32).reshape(2, 3, 5, 1)
    padded = pad(window, 4)
    assert padded.shape == (2, 4, 8, 1)
    np.testing.assert_array_equal(padded[:, 3], padded[:, 2])
    np.testing.assert_array_equal(padded[:, :3, :5], window)
    np.testing.assert_array_equal(padded[:, :3, 7], window[:, :, 4])


@pytest.mark.parametrize(("rows", "tile"), [(slice(0, 50), 16), (slice(20, 41), 32), (slice(0, 50), 64)])
def test_tiles_cover_each_pixel_once_and_have_their_halo(rows: slice, tile: int) -> None:
    height, width, halo, multiple = 50, 70, 10, 8
    seen = np.zeros((height, width), int)
    for inner, outer, offset in tiles(rows, height, width, tile, halo, multiple):
        seen[inner] += 1
        for size, own, around, place in zip((height, width), inner, outer, offset, strict=True):
            assert (own.start - around.start, own.stop - around.start) == (place.start, place.stop)
            assert around.start <= max(own.start - halo, 0)
            assert around.stop >= min(own.stop + halo, size)
    assert (seen[rows] == 1).all()
    assert seen.sum() == (rows.stop - rows.start) * width
