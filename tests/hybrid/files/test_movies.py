"""Movies: what a player shows is what went in."""

import numpy as np
import pytest
from PIL import Image

from hybrid.files.movies import LARGEST, check_movie, write_movie

COLORS = np.array([[200, 30, 30], [30, 180, 60], [20, 40, 220], [128, 128, 128], [250, 250, 250], [5, 5, 5]], np.uint8)


def flats(count=6, height=36, width=64):
    """Pictures of one color each."""
    return [np.broadcast_to(COLORS[i % len(COLORS)], (height, width, 3)).copy() for i in range(count)]


def decode(path):
    """Pictures of an MP4 as a player that heeds its tags shows them, and frames per second."""
    av = pytest.importorskip("av", reason="decodes MP4: pip install av")
    with av.open(str(path)) as container:
        stream = container.streams.video[0]
        pictures = [frame.to_ndarray(format="rgb24") for frame in container.decode(stream)]
        assert stream.codec_context.pix_fmt == "yuv420p"
        return pictures, float(stream.average_rate)


@pytest.mark.parametrize("rate", [24, 23.976, 60])
def test_an_mp4_holds_every_picture_at_its_rate(tmp_path, rate):
    pytest.importorskip("av", reason="pip install av")
    write_movie(tmp_path / "new" / "a.mp4", iter(flats()), rate)
    pictures, played = decode(tmp_path / "new" / "a.mp4")
    assert played == pytest.approx(rate, rel=1e-4)
    assert len(pictures) == 6
    for picture, color in zip(pictures, COLORS, strict=True):
        # BT.601 in the place of BT.709 would be off by up to 20 levels; 8-bit YUV and compression by 4.
        np.testing.assert_allclose(picture.mean((0, 1)), color, atol=4)


def test_odd_sizes_are_made_even_by_their_own_edge(tmp_path):
    pytest.importorskip("av", reason="pip install av")
    write_movie(tmp_path / "a.mp4", flats(1, 35, 63), 24)
    (picture,), _ = decode(tmp_path / "a.mp4")
    assert picture.shape == (36, 64, 3)
    np.testing.assert_allclose(picture[-1, -1], COLORS[0], atol=6)


def test_a_webp_plays_for_ever_in_true_time(tmp_path):
    write_movie(tmp_path / "a.webp", iter(flats()), 24)
    with Image.open(tmp_path / "a.webp") as image:
        assert (image.n_frames, image.info["loop"]) == (6, 0)
        shown, ends = [], []
        for index in range(6):
            image.seek(index)
            shown.append(np.asarray(image.convert("RGB")).mean((0, 1)))
            ends.append(image.info["timestamp"] + image.info["duration"])
    np.testing.assert_allclose(shown, COLORS, atol=6)
    # 41.67 ms a picture: rounded one by one they would end at 252.
    assert ends[-1] == 250


@pytest.mark.parametrize("name", ["a.mp4", "a.webp"])
def test_what_is_larger_than_a_screen_is_made_smaller(tmp_path, name):
    if name == "a.mp4":
        pytest.importorskip("av", reason="pip install av")
    write_movie(tmp_path / name, flats(1, 540, 2400), 24)
    largest = LARGEST[(tmp_path / name).suffix]
    if name == "a.mp4":
        assert decode(tmp_path / name)[0][0].shape == (largest * 540 // 2400, largest, 3)
    else:
        with Image.open(tmp_path / name) as image:
            assert image.size == (largest, largest * 540 // 2400)


@pytest.mark.parametrize("name", ["a.mp4", "a.webp"])
def test_a_movie_is_whole_or_not_there(tmp_path, name):
    if name == "a.mp4":
        pytest.importorskip("av", reason="pip install av")

    def broken():
        yield from flats(3)
        raise OSError("disk on fire")

    with pytest.raises(OSError, match="disk on fire"):
        write_movie(tmp_path / name, broken(), 24)
    assert not list(tmp_path.iterdir())


def test_what_cannot_be_written_is_said_first(tmp_path, monkeypatch):
    with pytest.raises(ValueError, match=r"a\.gif is no movie, expected a name that ends in \.mp4 or \.webp"):
        check_movie(tmp_path / "a.gif")
    monkeypatch.setattr("hybrid.files.movies.importlib.util.find_spec", lambda name: None)
    with pytest.raises(ImportError, match=r'PyAV.*pip install "av"'):
        check_movie(tmp_path / "a.mp4")
    check_movie(tmp_path / "a.webp")
