"""Pictures to look at: encoded as a screen expects them."""

import cv2
import numpy as np

from hybrid.files.pictures import encode_srgb, write_png


def test_a_png_holds_the_srgb_values_in_their_order(tmp_path):
    linear = np.float32([[[0.002, 0.18, 1], [-1, 7, 0.5]]])
    path = tmp_path / "new" / "look.png"
    write_png(path, encode_srgb(linear))
    found = cv2.imread(str(path))[..., ::-1]
    # IEC 61966-2-1: 12.92 · 0.002, and 1.055 x^(1/2.4) − 0.055, times 255; what is beyond is cut.
    np.testing.assert_array_equal(found, [[[7, 118, 255], [0, 255, 188]]])
    assert [file.name for file in path.parent.iterdir()] == ["look.png"]
