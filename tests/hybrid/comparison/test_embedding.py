"""Pictures inside a page: nothing that can be seen is lost, and what does not fit is left out and said."""

import base64
import zlib
from typing import Any

import numpy as np
import pytest

from hybrid.comparison import embedding
from hybrid.comparison.embedding import MethodImages, ShotImages, embed_pictures


def decompress(text: str, shape: tuple[int, int, int], levels: int) -> np.ndarray:
    """The inverse of `compress`, pixel by pixel, as the page does it."""
    height, width, channels = shape
    raw = zlib.decompress(base64.b64decode(text))
    size, half = height * width * channels, levels // 2
    planes = np.zeros((channels, height, width), int)
    for i in range(size):
        c, y, x = i // (height * width), i // width % height, i % width
        above = planes[c, y - 1, x] if y else 0
        left = planes[c, y, x - 1] if x else above
        corner = (planes[c, y - 1, x - 1] if y else 0) if x else (planes[c, y - 2, 0] if y > 1 else 0)
        low, high = min(left, above), max(left, above)
        guess = low if corner >= high else high if corner <= low else left + above - corner
        folded = raw[i] | raw[size + i] << 8
        planes[c, y, x] = (guess + (-((folded + 1) >> 1) if folded & 1 else folded >> 1)) % levels
    if channels == 3:
        green, red, blue = planes
        planes = np.stack([(red + green - half) % levels, green, (blue + green - half) % levels])
    return np.moveaxis(planes, 0, -1)


@pytest.mark.parametrize("shape", [(7, 5, 3), (1, 6, 3), (6, 1, 1), (9, 11, 1)])
def test_compression_loses_nothing(shape: tuple[int, int, int]) -> None:
    levels = 1024 if shape[2] == 3 else 64
    rng = np.random.default_rng(1)
    codes = rng.integers(0, levels, shape).astype(np.int32)
    codes[0, 0], codes[-1, -1] = levels - 1, 0
    assert np.array_equal(decompress(embedding.compress(codes, levels), shape, levels), codes)


def test_codes_keep_radiance_to_a_percent_and_mark_what_is_not_finite() -> None:
    level = 0.3
    radiance = np.geomspace(level, 1e4 * level, 3000, dtype=np.float32).reshape(-1, 1, 3)
    back = level / 64 * (2.0 ** (embedding.to_codes(radiance, level) / embedding.CODES_PER_STOP) - 1)
    # Half a step of 1/48 stop is 0.73 %, a little more where the linear part still counts.
    assert np.max(np.abs(back / radiance - 1)) < 0.0075
    lost = np.array([[[np.nan, np.inf, -1.0]]], np.float32)
    assert embedding.to_codes(lost, level).tolist() == [[[embedding.NOT_FINITE, embedding.NOT_FINITE, 0]]]


def test_what_is_left_out_is_said_and_the_limit_kept(monkeypatch: pytest.MonkeyPatch) -> None:
    rng = np.random.default_rng(0)
    noise = {n: rng.exponential(1.0, (270, 480, 3)).astype(np.float32) for n in (8, 9, 10)}
    noise[9][:, :240] = 1  # like the reference
    still = np.ones((270, 480, 3), np.float32)
    images = ShotImages([MethodImages("average", lambda n: noise[n])], lambda n: still, [8, 9, 10])

    def embed(limit: float) -> tuple[dict[str, Any], int]:
        monkeypatch.setattr(embedding, "LIMIT", limit)
        pictures = embed_pictures(images)
        return pictures.info, sum(len(text) for _, text in pictures.elements)

    info, size = embed(24e6)
    assert (info["width"], info["height"], info["frames"]) == (480, 270, [8, 9, 10])
    assert info["extent"] == "Frames 8 to 10, 480 × 270 pixels"
    assert size < 24e6
    info, size = embed(0.4e6)
    assert size < 0.4e6
    assert 160 < info["width"] < 480
    assert info["origin"][0] + info["width"] > 300  # where the methods differ
    assert "of 480 × 270; the rest is left out to keep the page below 0 MB" in info["extent"]
    info, size = embed(0.12e6)
    assert size < 0.12e6
    assert info["width"] == 160
    assert len(info["frames"]) < 3
    assert "of 8 to 10" in info["extent"]
