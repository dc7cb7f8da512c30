"""Sequences that are watched: what is there, and how layers become pictures."""

import json
import os
import shutil
from pathlib import Path

import cv2
import numpy as np
import OpenEXR
import pytest

from hybrid.files.exr import ExrError, read_exr
from hybrid.files.png import encode_srgb
from hybrid.run.records import Record
from hybrid.runtime.timing import Timings
from hybrid.viewer import sequence as module
from hybrid.viewer.sequence import Sequence, encode_picture
from tests.exr_files import write_layers
from tests.scenes import Scene

DEFAULTS = Path(__file__).parents[2] / "data" / "defaults"


def level(linear):
    return np.round(encode_srgb(np.float32(linear)) * 255)


@pytest.fixture
def scene(tmp_path):
    return Sequence(str(Scene().write(tmp_path / "shot", clean=True)), finished=False)


def test_frames_appear_and_change(tmp_path):
    watched = Sequence(str(tmp_path / "out"), finished=True)
    assert watched.versions() == {}, "a folder that is not there yet"
    Scene(frames=1).write(tmp_path / "out")
    first = watched.versions()
    Scene().write(tmp_path / "out")
    later = watched.versions()
    assert sorted(later) == [1001, 1002, 1003]
    os.utime(tmp_path / "out" / "shot.1001.exr", ns=(1, 1))
    assert watched.versions()[1001] != first[1001]


def test_a_range_that_is_named_with_the_pattern_is_heeded(tmp_path):
    Scene().write(tmp_path)
    watched = Sequence(f"{tmp_path}/shot.####.exr 1002-1010", finished=True)
    assert list(watched.versions()) == [1002, 1003]


def test_a_half_written_temporary_file_is_no_frame(tmp_path):
    Scene(frames=1).write(tmp_path)
    (tmp_path / ".shot.1002.exr.host-1-2.tmp").write_bytes(b"half")
    assert list(Sequence(str(tmp_path), finished=True).versions()) == [1001]


def test_radiance_is_exposed_and_encoded(scene):
    names, first = scene.layers(1001)
    assert first == "ViewLayer.Combined"
    assert names == sorted(names)
    truth = Scene().clean(0)["ViewLayer.Combined"]
    for gain in (0.5, 2.0):
        shown = scene.picture(1001, first, gain, 0)
        # One level: float32 files, and rounding.
        np.testing.assert_allclose(shown, level(truth * gain), atol=1)


def test_albedo_is_brightened_by_stops_alone(scene):
    truth = Scene().clean(0)["ViewLayer.Denoising Albedo"]
    shown = scene.picture(1001, "ViewLayer.Denoising Albedo", 100.0, 1)
    np.testing.assert_allclose(shown, level(truth * 2), atol=1)


def test_vectors_have_zero_at_middle_gray(scene):
    vector = scene.picture(1001, "ViewLayer.Vector", 1, 0)
    # (-2, 1) over a range of 2; of the four channels two lead to the frame before.
    assert np.abs(vector.astype(int) - [0, 191, 128]).max() <= 1
    normal = scene.picture(1001, "ViewLayer.Denoising Normal", 1, 0)
    assert np.abs(normal.astype(int) - [128, 128, 255]).max() <= 1


def test_single_channels_share_the_range_of_the_first_frame(tmp_path):
    for number, top in ((1, 10.0), (2, 20.0)):
        ramp = np.tile(np.linspace(0, top, 101, dtype=np.float32), (4, 1))
        write_layers(tmp_path / f"a.{number}.exr", {"color": np.ones((4, 101, 3)), "depth": ramp, "w": ramp / 20})
    watched = Sequence(str(tmp_path), finished=False)
    shown = [watched.picture(number, "depth", 1, 0)[0, :, 0].tolist() for number in (1, 2)]
    assert [shown[0][i] for i in (0, 50, 100)] == pytest.approx([0, 127, 255], abs=2)
    assert shown[1][25] == pytest.approx(127, abs=2), "no flicker of the range"
    assert watched.picture(1, "w", 1, 1)[0, 100, 0] == 255, "a stop brighter"
    weight = watched.picture(1, "w", 1, 0).tolist()
    assert weight[0][100][0] == pytest.approx(127, abs=1), "what lies in [0, 1] is shown as it is"


def test_a_flat_channel_and_nan_are_shown_and_not_an_error(tmp_path):
    broken = np.full((4, 4), np.nan, np.float32)
    layers = {"color": np.full((4, 4, 3), np.nan), "depth": np.full((4, 4), 7.0), "vector": np.zeros((4, 4, 4))}
    write_layers(tmp_path / "a.1.exr", {**layers, "broken": broken}, half=False)
    watched = Sequence(str(tmp_path), finished=False)
    assert watched.picture(1, "color", 1, 0).max() == 0
    assert watched.picture(1, "depth", 1, 0).max() == 0
    assert set(watched.picture(1, "vector", 1, 0).ravel()) <= {127, 128}
    assert watched.picture(1, "broken", 1, 0).max() == 0


def test_another_data_window_lies_where_it_belongs(tmp_path):
    header = {"dataWindow": ((2, 1), (5, 3)), "displayWindow": ((0, 0), (3, 3)), "compression": OpenEXR.ZIP_COMPRESSION}
    ramp = np.arange(12, dtype=np.float32).reshape(3, 4) / 12
    OpenEXR.File(header, {"R": ramp, "G": ramp, "B": ramp}).write(str(tmp_path / "a.1.exr"))
    sequence = Sequence(str(tmp_path), finished=False)
    shown = sequence.picture(1, "RGBA", 1, 0)[..., 0]
    expected = np.zeros((4, 4))
    expected[1:, 2:] = ramp[:, :2]
    np.testing.assert_allclose(shown, level(expected), atol=1)
    assert sequence.values(1, "RGBA", 3, 2)["R"] == ramp[1, 1]
    assert sequence.values(1, "RGBA", 1, 2) == {}


def test_around_the_data_is_black_whatever_zero_is_shown_as(tmp_path):
    header = {"dataWindow": ((1, 1), (2, 2)), "displayWindow": ((0, 0), (3, 3)), "compression": OpenEXR.ZIP_COMPRESSION}
    plane = np.zeros((2, 2), np.float32)
    channels = {"R": plane, "G": plane, "B": plane, "vector.X": plane, "vector.Y": plane}
    OpenEXR.File(header, channels).write(str(tmp_path / "a.1.exr"))
    shown = Sequence(str(tmp_path), finished=False).picture(1, "vector", 1, 0)
    assert set(shown[1:3, 1:3].ravel()) <= {127, 128}
    shown[1:3, 1:3] = 0
    assert shown.max() == 0


@pytest.mark.parametrize("side", [60000, 65501])
def test_a_display_window_that_cannot_be_shown_is_refused_before_memory_is_taken(tmp_path, side):
    """A file of 4 pixels asked for 40 GiB."""
    size = (side - 1, 59999 if side == 60000 else 1)
    header = {"dataWindow": ((0, 0), (1, 1)), "displayWindow": ((0, 0), size), "compression": OpenEXR.ZIP_COMPRESSION}
    OpenEXR.File(header, {c: np.ones((2, 2), np.float32) for c in "RGB"}).write(str(tmp_path / "a.1.exr"))
    watched = Sequence(str(tmp_path), finished=False)
    for ask in (watched.check_sizes, lambda: watched.picture(1, "RGBA", 1, 0)):
        with pytest.raises(ExrError, match=rf"a\.1\.exr: display window of {side}x\d+ pixels, expected sides up to"):
            ask()


def test_a_replaced_file_is_read_anew(tmp_path):
    path = tmp_path / "a.1.exr"
    watched = Sequence(str(tmp_path), finished=False)
    write_layers(path, {"color": np.ones((4, 4, 3), np.float32)})
    bright = watched.picture(1, "color", 1, 0)
    write_layers(path, {"color": np.zeros((4, 4, 3), np.float32)})
    os.utime(path, ns=(1, 1))
    assert (bright.min(), watched.picture(1, "color", 1, 0).max()) == (255, 0)


def test_a_file_of_the_same_size_and_time_is_another_version(tmp_path):
    """The old one was shown for as long as the page was open."""
    path, spare = tmp_path / "a.1.exr", tmp_path / "spare.exr"
    watched = Sequence(str(path), finished=True)
    for place, value in ((path, 1), (spare, 0.5)):
        write_layers(place, {"color": np.full((4, 4, 3), value, np.float32)})
    first, bright = watched.versions(), watched.picture(1, "color", 1, 0)
    status = path.stat()
    assert spare.stat().st_size == status.st_size
    os.utime(spare, ns=(status.st_atime_ns, status.st_mtime_ns))
    spare.replace(path)
    assert watched.versions() != first
    assert watched.picture(1, "color", 1, 0).max() < bright.min()


def test_another_exposure_does_not_read_again(scene, monkeypatch):
    scene.picture(1001, "ViewLayer.Combined", 1, 0)

    def headers_only(path, *, pixels=True):
        assert not pixels
        return read_exr(path, pixels=False)

    monkeypatch.setattr(module, "read_exr", headers_only)
    scene.picture(1001, "ViewLayer.Combined", 2, 1)


def test_what_is_kept_is_bounded(scene, monkeypatch):
    one = 40 * 56 * 3 * 4
    monkeypatch.setattr(module, "CACHE_BYTES", 2 * one)
    for number in (1001, 1002, 1003):
        scene.picture(number, "ViewLayer.Combined", 1, 0)
    assert sum(pixels.nbytes for pixels in scene._cache.values()) == 2 * one


def test_a_result_begins_with_the_denoised_picture_and_an_input_with_the_noisy_one(tmp_path):
    """Blender's own files hold both."""
    folder = str(shutil.copytree(DEFAULTS, tmp_path / "shot"))
    assert Sequence(folder, finished=True).layers(9)[1].endswith("Combined")
    assert Sequence(folder, finished=False).layers(9)[1].endswith("Noisy Image")


def test_facts_tell_how_a_frame_was_made_and_what_its_neighbours_weigh(tmp_path):
    weights = {"before1": 0.25, "centre": 0.5, "after1": 0.125}
    layers = {f"weight.{name}": np.full((4, 4), value, np.float32) for name, value in weights.items()}
    devices = {"network": "cpu", "oidn": "cpu"}
    settings = json.dumps(
        {"tile": 640, "method": "network", "aovs": [], "passes": 1, "device": devices, "precision": "x"}
    )
    attributes = {"ravg/preset": "fast", "ravg/first-pass": "file", "ravg/forced": "", "owner": "somebody"}
    attributes |= {"ravg/settings": settings, "ravg/versions": '{"ravg": "0.2.0", "numpy": "2"}'}
    write_layers(tmp_path / "a.1.exr", {"color": np.ones((4, 4, 3)), **layers}, attributes=attributes)
    facts = Sequence(str(tmp_path), finished=True).facts(1)
    assert facts["file"] == "a.1.exr"
    words = {"method": "network", "preset": "fast", "first pass": "file", "computed on": "cpu", "precision": "x"}
    assert facts["made"] == {**words, "ravg": "0.2.0"}
    assert list(facts["weights"].items()) == list(weights.items()), "in the order of time"


@pytest.mark.parametrize("hostile", ["", "[", "[]", '"x"', '{"device": 3, "aovs": "x"}', "[" * 99999])
def test_headers_that_hold_no_facts_make_none(tmp_path, hostile):
    attributes = {"ravg/preset": "fast", "ravg/settings": hostile, "ravg/versions": hostile}
    write_layers(tmp_path / "a.1.exr", {"color": np.ones((4, 4, 3))}, attributes=attributes)
    assert Sequence(str(tmp_path), finished=True).facts(1)["made"] == {"preset": "fast"}


def test_values_are_those_of_the_pixel_on_the_display_window(tmp_path):
    color = np.zeros((4, 6, 3), np.float32)
    color[1, 2] = 0.5, 2, np.nan
    write_layers(tmp_path / "a.1.exr", {"color": color})
    watched = Sequence(str(tmp_path), finished=True)
    (name, *_), _ = watched.layers(1)
    assert watched.values(1, name, 2, 1) == {"R": 0.5, "G": 2, "B": None}
    assert watched.values(1, name, 6, 1) == watched.values(1, name, -1, 1) == {}
    with pytest.raises(KeyError):
        watched.values(1, "nothing", 0, 0)


def test_of_several_pictures_the_first_is_shown_and_the_weights_of_all_are_told(tmp_path):
    flat = np.ones((4, 4), np.float32)
    layers = {f"{name}.Combined": np.ones((4, 4, 3), np.float32) for name in ("Back", "Front")}
    layers |= {
        f"{name}.Combined.weight.{frame}": flat / 2 for name in ("Back", "Front") for frame in ("centre", "before1")
    }
    write_layers(tmp_path / "a.1.exr", layers)
    watched = Sequence(str(tmp_path), finished=True)
    names, first = watched.layers(1)
    assert first == "Back.Combined"
    assert {"Front.Combined", "Front.Combined.weight.centre"} <= set(names)
    assert watched.picture(1, "Front.Combined", 1, 0).mean() == 255
    told = watched.facts(1)["weights"]
    assert list(told) == [f"{name}.Combined.{frame}" for name in ("Back", "Front") for frame in ("before1", "centre")]


def test_the_record_is_what_lies_beside_the_frames(tmp_path):
    Scene(frames=1).write(tmp_path)
    watched = Sequence(str(tmp_path), finished=True)
    assert watched.versions()
    assert watched.record() == {}
    for preset in ("fast", "quality"):
        Record(tmp_path, "shot", [1], preset=preset).write(Timings())
        assert watched.record()["preset"] == preset, "the latest"
    (tmp_path / "ravg" / "shot.1.json").write_text("[1]", encoding="utf-8")
    assert watched.record() == {}


def test_what_is_not_there_is_a_key_error(scene):
    with pytest.raises(KeyError):
        scene.picture(1, "ViewLayer.Combined", 1, 0)
    with pytest.raises(KeyError):
        scene.picture(1001, "../../etc/passwd", 1, 0)


def test_pictures_are_encoded_exactly_and_quickly():
    picture = np.random.default_rng(0).integers(0, 255, (8, 9, 3), dtype=np.uint8)
    exact = cv2.imdecode(np.frombuffer(encode_picture(picture, "png"), np.uint8), cv2.IMREAD_COLOR)
    assert (exact[..., ::-1] == picture).all()
    assert encode_picture(picture, "jpg")[:2] == b"\xff\xd8"
