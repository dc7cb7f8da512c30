"""Pictures to look at: encoded as a screen expects them."""

import cv2
import numpy as np
import pytest

from hybrid.files.png import display_exposure, encode_bytes, encode_filmic, encode_srgb, write_png


def test_a_png_holds_the_srgb_values_in_their_order(tmp_path):
    linear = np.float32([[[0.002, 0.18, 1], [-1, 7, 0.5]]])
    path = tmp_path / "new" / "look.png"
    write_png(path, encode_srgb(linear))
    found = cv2.imread(str(path))[..., ::-1]
    # IEC 61966-2-1: 12.92 · 0.002, and 1.055 x^(1/2.4) − 0.055, times 255; what is beyond is cut.
    np.testing.assert_array_equal(found, [[[7, 118, 255], [0, 255, 188]]])
    assert [file.name for file in path.parent.iterdir()] == ["look.png"]


def test_the_table_of_8_bits_gives_what_the_formula_gives():
    linear = np.linspace(-0.1, 1.1, 100_003, dtype=np.float32).reshape(1, -1, 1)
    table, formula = encode_bytes(linear), encode_srgb(linear) * 255
    assert table.shape == linear.shape
    # Half a step of 8 bits for rounding, and half of a table's step, a twentieth at most.
    assert np.abs(table - formula).max() < 0.5 + 0.03
    assert np.array_equal(table[0, [0, -1], 0], [0, 255])


def test_middle_gray_is_that_of_the_room_and_not_of_its_window():
    room = np.full((96, 192, 3), 0.2, np.float32)
    lit = room.copy()
    lit[:24, :48] = 40  # 32 times the mean of the room, on 6 % of it
    assert lit.mean() > 10 * room.mean()
    assert display_exposure(room) == pytest.approx(0.2 / 0.18)
    assert display_exposure(lit) < 0.3 / 0.18
    assert display_exposure(1e3 * lit) == pytest.approx(1e3 * display_exposure(lit), rel=1e-5)


def test_middle_gray_is_not_that_of_noise():
    dark, lights = np.zeros((192, 384, 3), np.float32), np.random.default_rng(1).random((192, 384)) < 0.25
    dark[lights] = 0.8  # single samples of a light of 0.2
    assert display_exposure(dark) == pytest.approx(0.2 / 0.18, rel=0.05)
    assert display_exposure(np.zeros_like(dark)) == 1 / 0.18


def test_filmic_keeps_middle_gray_the_order_of_light_and_highlights():
    ramp = np.geomspace(1e-4, 1e4, 200, dtype=np.float32)[:, None].repeat(3, axis=1)
    shown = encode_filmic(ramp)
    assert (np.diff(shown[:, 0]) >= 0).all()
    np.testing.assert_allclose(encode_filmic(np.full(3, 0.18)), encode_srgb(np.full(3, 0.18)), rtol=1e-5)
    assert 0.9 < encode_filmic(np.full(3, 0.18 * 2**5))[0] < encode_filmic(np.full(3, 0.18 * 2**7))[0] < 1
    red = encode_filmic(np.float32([100, 0, 0]))
    assert red[0] > red[1] > 0.9, "bright colors turn white"
    np.testing.assert_allclose(encode_filmic(np.float32([np.inf] * 3)), 1)
    np.testing.assert_array_equal(encode_filmic(np.float32([-1, -1, -1])), 0)
