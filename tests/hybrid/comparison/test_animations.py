"""Animations hold the frames of every method in their order, small enough, and as movies in their own size."""

import base64
from pathlib import Path

import cv2
import numpy as np
import pytest

from hybrid.comparison import animations
from hybrid.comparison.animations import QUALITY, TALLEST, embed_animations, mid_exposure, write_movies
from hybrid.comparison.embedding import MethodImages, ShotImages
from hybrid.files.png import encode_srgb
from tests.hybrid.comparison.test_report import scene

FRAMES = [8, 9, 10]


def sheet(text: str) -> np.ndarray:
    return cv2.imdecode(np.frombuffer(base64.b64decode(text), np.uint8), cv2.IMREAD_COLOR)[..., ::-1]


def expected(level: float, number: int, exposure: float) -> float:
    """A flat frame in 8 bits: the tone curve at the exposure that makes the reference, 0.5, a middle gray."""
    x = exposure * 2 ** mid_exposure(exposure, 0.5 * 1.5) * level * (1 + 0.5 * (number - 8))
    return float(255 * encode_srgb(np.float32(x / (1 + x))))


@pytest.mark.parametrize("exposure", [1.0, 4.0])
def test_a_sheet_holds_all_frames_of_a_method(exposure: float) -> None:
    loops = embed_animations(ShotImages([MethodImages("dark", scene(0.1))], scene(0.5), FRAMES, exposure))
    assert [source["name"] for source in loops.info["sources"]] == ["reference", "dark"]
    assert (loops.info["frames"], loops.info["columns"]) == (FRAMES, 1)
    width, height = loops.info["width"], loops.info["height"]
    assert (width, height) == (32, 18)
    for (name, text), level in zip(loops.elements, (0.5, 0.1), strict=True):
        picture = sheet(text)
        assert picture.shape == (3 * height, width, 3), name
        for index, number in enumerate(FRAMES):
            part = picture[index * height + 4 : (index + 1) * height - 4]
            assert part.mean() == pytest.approx(expected(level, number, exposure), abs=3)  # WebP has loss


def test_many_frames_stand_in_columns_and_large_ones_are_made_smaller(monkeypatch: pytest.MonkeyPatch) -> None:
    def tall(number: int) -> np.ndarray:
        return scene(0.5, (400, 100))(8)

    count = TALLEST // 400 + 1
    monkeypatch.setattr(animations, "LIMIT", 1e9)
    loops = embed_animations(ShotImages([], tall, range(count)))
    assert loops.info["columns"] == 2
    assert max(sheet(loops.elements[0][1]).shape) <= TALLEST
    rng = np.random.default_rng(0)
    noise = rng.random((2, 300, 400, 3)).astype(np.float32)
    full = embed_animations(ShotImages([], lambda n: noise[n], [0, 1]))
    monkeypatch.setattr(animations, "LIMIT", 20_000)
    small = embed_animations(ShotImages([], lambda n: noise[n], [0, 1]))
    assert len(full.elements[0][1]) > 20_000 >= len(small.elements[0][1])
    assert small.info["width"] < full.info["width"] == 400
    assert QUALITY < 90  # at which noise would need far more


def test_movies_have_the_size_of_the_frames_and_names_that_are_none_of_the_users(tmp_path: Path) -> None:
    av = pytest.importorskip("av")
    images = [MethodImages("../up <b>", scene(0.1)), MethodImages("noisy", scene(2.0))]
    names = write_movies(tmp_path / "movies", ShotImages(images, scene(0.5), FRAMES), 24)
    assert names == {"reference": "00_reference.mp4", "../up <b>": "01__up_b_.mp4", "noisy": "02_noisy.mp4"}
    assert sorted(path.name for path in (tmp_path / "movies").iterdir()) == sorted(names.values())
    with av.open(str(tmp_path / "movies" / "02_noisy.mp4")) as movie:
        shown = [frame.to_ndarray(format="rgb24") for frame in movie.decode(video=0)]
    assert [picture.shape for picture in shown] == [(18, 32, 3)] * 3
    for number, picture in zip(FRAMES, shown, strict=True):
        assert picture.mean() == pytest.approx(expected(2.0, number, 1), abs=4)
