from pathlib import Path

import numpy as np
import OpenEXR

from flow.motion import MotionConvention
from hybrid.files.exr import read_exr
from hybrid.files.shots import open_shot
from tests.exr_files import SIZE, flat_image, write_layers


def test_two_half_buffers_give_the_variance_where_there_is_none(tmp_path):
    rng = np.random.default_rng(0)
    layers = {f"ViewLayer.{name}": rng.random((*SIZE, 3), np.float32) for name in ("Combined", "Half A", "Half B")}
    write_layers(tmp_path / "a.0001.exr", layers, half=False)
    frame = open_shot(tmp_path).read(1)
    difference = layers["ViewLayer.Half A"] - layers["ViewLayer.Half B"]
    np.testing.assert_allclose(frame.variance, difference**2 / 4, rtol=1e-6)
    np.testing.assert_array_equal(frame.color, layers["ViewLayer.Combined"])
    write_layers(tmp_path / "a.0001.exr", layers | {"ViewLayer.Variance": layers["ViewLayer.Combined"]}, half=False)
    np.testing.assert_array_equal(open_shot(tmp_path).read(1).variance, layers["ViewLayer.Combined"])
    write_layers(tmp_path / "a.0001.exr", {k: v for k, v in layers.items() if "B" not in k}, half=False)
    assert open_shot(tmp_path).read(1).variance is None


def test_vectors_that_are_multiplied_by_alpha_are_divided_by_it(tmp_path):
    alpha = np.linspace(0, 1, 24, dtype=np.float32).reshape(*SIZE, 1)
    layers = {"color": np.concatenate([flat_image(1), alpha], axis=-1), "motion": alpha * flat_image(-3, 2)}
    write_layers(tmp_path / "shot.0001.exr", layers)
    frame = open_shot(tmp_path, motion="previous,premultiplied").read(1)
    assert frame.motion_convention == MotionConvention()
    np.testing.assert_allclose(frame.motion[alpha[..., 0] > 0], -3, rtol=1e-3)  # half floats
    assert not frame.motion[0, 0].any()  # nothing is there, and nothing is known
    plain = open_shot(tmp_path, motion="previous").read(1)
    np.testing.assert_array_equal(plain.motion, layers["motion"])


def test_variance_of_one_channel_holds_for_all_three(tmp_path):
    write_layers(tmp_path / "a.exr", {"color": flat_image(1), "variance": flat_image(0.5, 1)})
    np.testing.assert_array_equal(open_shot(tmp_path / "a.exr").read(1).variance, flat_image(0.5))


def save_cropped(path: Path, left: int, top: int, pixels: np.ndarray, depth_at: tuple[int, int]) -> None:
    """A 10×8 picture of two parts, each with its own data window."""
    parts = []
    for name, (x, y), channels in (
        ("color", (left, top), {c: pixels[..., i] for i, c in enumerate("RGB")}),
        ("depth", depth_at, {"Z": pixels[..., 0]}),
    ):
        height, width = pixels.shape[:2]
        header = {
            "type": OpenEXR.scanlineimage,
            "compression": OpenEXR.ZIP_COMPRESSION,
            "dataWindow": (np.array([x, y], np.int32), np.array([x + width - 1, y + height - 1], np.int32)),
            "displayWindow": (np.array([5, 5], np.int32), np.array([14, 12], np.int32)),
        }
        planes = {n: np.ascontiguousarray(p) for n, p in channels.items()}
        parts.append(OpenEXR.Part(header, planes, name))
    OpenEXR.File(parts).write(str(path))


def test_frames_cropped_differently_are_read_onto_one_window_and_written_as_they_were(tmp_path):
    rng = np.random.default_rng(0)
    pixels = {1: rng.random((3, 4, 3), np.float32), 2: rng.random((2, 6, 3), np.float32)}
    save_cropped(tmp_path / "a.0001.exr", 6, 7, pixels[1], depth_at=(7, 8))
    save_cropped(tmp_path / "a.0002.exr", 4, 9, pixels[2], depth_at=(4, 9))
    shot = open_shot(tmp_path)
    first, second = shot.read(1), shot.read(2)
    # The union covers columns 4 … 9 and rows 7 … 10.
    expected = np.zeros((4, 6, 3), np.float32)
    expected[:3, 2:] = pixels[1]
    np.testing.assert_array_equal(first.color, expected)
    assert first.depth is not None
    np.testing.assert_array_equal(first.depth[1:, 3:], pixels[1][:, :3, 0])
    assert not first.depth[0].any()
    expected = np.zeros((4, 6, 3), np.float32)
    expected[2:] = pixels[2]
    np.testing.assert_array_equal(second.color, expected)

    shot = open_shot(tmp_path, aovs=["depth"])
    shot.write(tmp_path / "out.exr", 1, {"color": 2 * first.color, "depth": first.depth})
    source, again = read_exr(tmp_path / "a.0001.exr"), read_exr(tmp_path / "out.exr")
    for part, written in zip(source.parts, again.parts, strict=True):
        assert part.data_window == written.data_window
        assert part.display_window == written.display_window
    np.testing.assert_array_equal(again.pixels(tuple(f"color.{c}" for c in "RGB")), 2 * pixels[1])
    # The last column of depth lies outside of every color window: it was not read, and stays.
    np.testing.assert_array_equal(again.channel("depth.Z"), source.channel("depth.Z"))
    reopened = shot.reopened({1: tmp_path / "out.exr"})
    np.testing.assert_array_equal(reopened.read(1).color, 2 * first.color)  # on the canvas of both frames still
