"""Shots, the frames around a frame, and the names of files."""

from __future__ import annotations

import shutil
from pathlib import Path

import numpy as np
import OpenEXR
import pytest

from flow.motion import CYCLES, MotionConvention
from hybrid.alignment.loading import LoadedFrames
from hybrid.files import shots as shots_module
from hybrid.files.exr import ExrError, read_exr
from hybrid.files.shots import Shot, open_shot, output_path
from tests.exr_files import write_layers
from tests.renderers import layer
from tests.renderers import save as save_file

SIZE = 4, 6


def image(value: float, count: int = 3, size: tuple[int, int] = SIZE) -> np.ndarray:
    return np.full((*size, count), value, np.float32)


def save(folder: Path, numbers, name: str = "shot.{:04d}.exr", size: tuple[int, int] = SIZE) -> Path:
    """Frames whose color is their number."""
    for number in numbers:
        layers = {"color": image(number, size=size), "motion": image(-number, 2, size)}
        write_layers(folder / name.format(number), layers)
    return folder


def neighbours(shot: Shot, number: int, radius: int) -> list[int | None]:
    """Numbers of a frame and what there is around it."""
    around = LoadedFrames(shot, ()).around(number, radius)
    return [n if shot.has(n) else None for n in around]


# --- what is kept


def test_a_lossy_compression_of_what_is_kept_is_named(tmp_path):
    planes = layer("", "RGBA", image(1), image(1, 1)[..., 0]) | layer("Vector", "XY", image(1, 2))
    header = {"compression": OpenEXR.DWAA_COMPRESSION, "type": OpenEXR.scanlineimage}
    OpenEXR.File([OpenEXR.Part(header, {n: OpenEXR.Channel(n, p) for n, p in planes.items()}, "")]).write(
        str(tmp_path / "a.0001.exr")
    )
    said = ["files: DWAA would change layers that are kept, written with ZIP"]
    assert open_shot(tmp_path).recompressed_parts() == said
    assert open_shot(tmp_path, layers={"color": "RGB"}, aovs=["Vector"]).recompressed_parts() == []
    (tmp_path / "zip").mkdir()
    save(tmp_path / "zip", [1])
    assert open_shot(tmp_path / "zip").recompressed_parts() == []


# --- names


@pytest.mark.parametrize("pattern", ["shot.####.exr", "shot.%04d.exr", "shot.@@@@.exr", "shot.#.exr", ""])
def test_every_way_of_naming_a_shot_finds_the_same_frames(tmp_path, pattern):
    shot = open_shot(save(tmp_path, range(8, 12)) / pattern)
    assert shot.numbers == (8, 9, 10, 11)
    assert len(shot) == 4
    assert shot.warnings == []
    assert shot.path(9) == tmp_path / "shot.0009.exr"
    assert shot.read(9).color[0, 0, 0] == 9


def test_one_file_is_a_shot_of_one_frame(tmp_path):
    shot = open_shot(save(tmp_path, [8, 9]) / "shot.0009.exr")
    assert shot.numbers == (9,)
    assert neighbours(shot, 9, 1) == [None, 9, None]
    (warning,) = shot.warnings
    assert (
        warning
        == f"{tmp_path}/shot.0009.exr is taken alone; {tmp_path}/shot.####.exr 8-9 would take its neighbours too"
    )
    save(tmp_path, [1], "still.exr")
    assert open_shot(tmp_path / "still.exr").warnings == []
    assert open_shot(tmp_path / "still.exr").numbers == (1,)


def test_numbers_may_outgrow_their_padding_and_be_negative(tmp_path):
    save(tmp_path, [98, 99, 100, 101], "s.{:02d}.exr")
    assert open_shot(tmp_path / "s.##.exr").numbers == (98, 99, 100, 101)
    save(tmp_path, [-1, 0, 1], "n.{:04d}.exr")
    assert open_shot(tmp_path / "n.####.exr").numbers == (-1, 0, 1)


def test_width_of_the_pattern_decides_between_sequences_of_one_name(tmp_path):
    save(save(tmp_path, [10, 11], "a.{:02d}.exr"), [10, 12], "a.{:04d}.exr")
    assert open_shot(tmp_path / "a.##.exr").numbers == (10, 11)
    assert open_shot(tmp_path / "a.####.exr").numbers == (10, 12)


def test_no_match_names_the_pattern_and_what_is_there(tmp_path):
    save(tmp_path, [8, 9])
    with pytest.raises(FileNotFoundError, match=r"none\.####\.exr: no frame matches; .*shot\.####\.exr"):
        open_shot(tmp_path / "none.####.exr")
    with pytest.raises(FileNotFoundError, match=r"shot\.0010\.exr: no such file; .*shot\.####\.exr"):
        open_shot(tmp_path / "shot.0010.exr")
    with pytest.raises(FileNotFoundError, match="there is no folder"):
        open_shot(tmp_path / "nowhere" / "a.####.exr")
    (tmp_path / "empty").mkdir()
    with pytest.raises(FileNotFoundError, match="no EXR files in this folder"):
        open_shot(tmp_path / "empty")


def test_folder_of_several_sequences_lists_them(tmp_path):
    save(save(tmp_path, [8, 9]), [1, 2], "other.{:04d}.exr")
    with pytest.raises(ValueError, match=r"several sequences.*other\.####\.exr.*shot\.####\.exr"):
        open_shot(tmp_path)


# --- ranges, holes, neighbours


def test_range_selects_frames_and_neighbours_come_from_outside_of_it(tmp_path):
    save(tmp_path, range(1, 10))
    shot = open_shot(tmp_path, frames="3-7x2")
    assert shot.numbers == (3, 5, 7)
    assert shot.step == 1
    assert neighbours(shot, 3, 2) == [1, 2, 3, 4, 5]
    assert neighbours(open_shot(tmp_path), 9, 2) == [7, 8, 9, None, None]


@pytest.mark.parametrize("frames", ["abc", "1-", "", "1-2x0.5"])
def test_range_that_is_none_is_refused(tmp_path, frames):
    with pytest.raises(ValueError, match="is not a range of frames") as caught:
        open_shot(save(tmp_path, [1, 2]), frames=frames)
    assert "\n" not in str(caught.value)


def test_range_without_any_frame_is_not_found(tmp_path):
    with pytest.raises(FileNotFoundError, match=r"none of the frames 5-6 is there; .* has 1-2"):
        open_shot(save(tmp_path, [1, 2]), frames="5-6")


def test_frames_around_those_asked_for_are_those_there_are(tmp_path):
    shot = open_shot(save(tmp_path, (1, 2, 3, 5, 6, 9)), frames="3-5")
    assert shot.with_neighbours(0).numbers == (3, 5)
    assert shot.with_neighbours(2).numbers == (1, 2, 3, 5, 6)
    assert shot.numbers == (3, 5)
    # Of these files alone the step would be 2.
    made = shot.reopened({number: shot.path(number) for number in (1, 3, 5)})
    assert (made.numbers, made.step, shot.step) == ((3, 5), 1, 1)
    assert made.has(1)
    assert not made.has(2)


def test_hole_is_a_warning_and_a_narrower_window(tmp_path):
    shot = open_shot(save(tmp_path, [1, 2, 4, 5, 8]))
    assert shot.numbers == (1, 2, 4, 5, 8)
    assert shot.warnings == ["missing frames 3,6-7: the windows beside them are narrower"]
    assert neighbours(shot, 4, 2) == [2, None, 4, 5, None]
    asked = open_shot(tmp_path, frames="4-6")
    assert (asked.numbers, len(asked.warnings)) == ((4, 5), 1)


def test_every_second_frame_has_neighbours_two_away(tmp_path):
    shot = open_shot(save(tmp_path, [1, 3, 5, 9]))
    assert shot.step == 2
    assert neighbours(shot, 5, 1) == [3, 5, None]
    assert "missing frames 7" in shot.warnings[0]
    # Asked for all, the even ones are missing, and the odd ones as ever: a chunk of them has to be like the whole.
    asked = open_shot(tmp_path, frames="1-5")
    assert (asked.step, asked.numbers, asked.missing) == (2, (1, 3, 5), (2, 4))
    assert neighbours(asked, 3, 1) == [1, 3, 5]


# --- reading


def test_frame_has_all_roles_with_their_shapes(tmp_path):
    rng = np.random.default_rng(0)
    counts = {"color": 4, "albedo": 3, "normal": 3, "motion": 4, "variance": 3, "denoised": 3}
    layers = {name: rng.random((*SIZE, count), np.float32) for name, count in counts.items()}
    layers |= {"depth": rng.random(SIZE, np.float32), "glow": rng.random((*SIZE, 3), np.float32)}
    write_layers(tmp_path / "a.0001.exr", layers, half=False)
    frame = open_shot(tmp_path, aovs=["glow"]).read(1)
    np.testing.assert_array_equal(frame.color, layers["color"][..., :3])
    np.testing.assert_array_equal(frame.alpha, layers["color"][..., 3])
    np.testing.assert_array_equal(frame.estimate, layers["denoised"])
    np.testing.assert_array_equal(frame.aovs["glow"], layers["glow"])
    for name in ("albedo", "normal", "motion", "variance", "depth"):
        np.testing.assert_array_equal(getattr(frame, name), layers[name])
    assert frame.motion_convention == CYCLES
    assert frame.source == tmp_path / "a.0001.exr"


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
    layers = {"color": np.concatenate([image(1), alpha], axis=-1), "motion": alpha * image(-3, 2)}
    write_layers(tmp_path / "shot.0001.exr", layers)
    frame = open_shot(tmp_path, motion="previous,premultiplied").read(1)
    assert frame.motion_convention == MotionConvention()
    np.testing.assert_allclose(frame.motion[alpha[..., 0] > 0], -3, rtol=1e-3)  # half floats
    assert not frame.motion[0, 0].any()  # nothing is there, and nothing is known
    plain = open_shot(tmp_path, motion="previous").read(1)
    np.testing.assert_array_equal(plain.motion, layers["motion"])


def test_variance_of_one_channel_holds_for_all_three(tmp_path):
    write_layers(tmp_path / "a.exr", {"color": image(1), "variance": image(0.5, 1)})
    np.testing.assert_array_equal(open_shot(tmp_path / "a.exr").read(1).variance, image(0.5))


def test_overrides_and_missing_aovs(tmp_path):
    write_layers(tmp_path / "a.exr", {"key": image(1), "fill": image(2)})
    assert (open_shot(tmp_path / "a.exr", layers={"color": "fill"}).read(1).color == 2).all()
    with pytest.raises(ExrError, match=r"no layer 'rim'; it has fill\.RGB, key\.RGB"):
        open_shot(tmp_path / "a.exr", layers={"color": "key"}, aovs=["rim"]).read(1)


def test_frames_that_are_kept_are_read_once_and_no_more_are_held(tmp_path, monkeypatch):
    shot = open_shot(save(tmp_path, range(1, 13)), keep=5)
    opened: list[Path] = []

    def counted(path, *, pixels=True, **kwargs):
        if pixels:
            opened.append(path)
        return read_exr(path, pixels=pixels, **kwargs)

    monkeypatch.setattr(shots_module, "read_exr", counted)
    for number in shot.numbers:
        there = [near for near in neighbours(shot, number, 2) if near is not None]
        assert len(there) >= 3
        assert [shot.read(near).number for near in there] == there
        assert len(shot._held) <= 5
    assert sorted(opened) == [shot.path(number) for number in shot.numbers]


def test_opening_a_shot_reads_nothing_and_a_damaged_frame_is_an_error_when_met(tmp_path):
    save(tmp_path, [1, 2, 3])
    path = tmp_path / "shot.0003.exr"
    path.write_bytes(path.read_bytes()[:-30])
    (tmp_path / "shot.0004.exr").write_text("not an image")
    shot = open_shot(tmp_path)
    assert shot.read(1).number == 1
    with pytest.raises(ExrError, match=r"shot\.0003\.exr: damaged or truncated"):
        shot.read(3)


def test_frames_of_other_sizes_are_an_error_that_names_both(tmp_path):
    save(save(tmp_path, [1, 2]), [3], size=(4, 7))
    shot = open_shot(tmp_path)
    assert shot.read(2).number == 2
    with pytest.raises(ValueError, match="frame 1 is 6x4, frame 3 is 7x4"):
        shot.read(3)


@pytest.mark.parametrize("stale", [3, 4, 100])
def test_a_frame_of_another_size_outside_the_range_changes_nothing(tmp_path, stale):
    """It stopped the run as a neighbour, and shortened the step."""
    numbers = [number for number in (1, 3, 5, 7) if number != stale]
    save(tmp_path, [stale], size=(8, 8))
    shot = open_shot(save(tmp_path, numbers), frames="5-7")
    assert shot.step == 2
    assert list(shot.available) == numbers
    assert [shot.read(number).color[0, 0, 0] for number in shot.neighbours(5, 2)] == numbers
    assert f"frames {stale} differ in size from those asked for: left out" in shot.warnings


def test_frames_asked_for_must_be_of_one_size_still(tmp_path):
    save(tmp_path, [2], size=(8, 8))
    shot = open_shot(save(tmp_path, [1, 3]), frames="1-3")
    with pytest.raises(ValueError, match="frames differ in size: frame 1 is 6x4, frame 2 is 8x8"):
        shot.read(2)


def test_data_windows_that_lie_far_apart_are_refused_before_memory_is_taken(tmp_path):
    """Two files of 24 pixels asked for 4.5 GiB."""
    for number, at in ((1, 0), (2, 30000)):
        header = {"dataWindow": ((at, at), (at + 5, at + 3)), "displayWindow": ((0, 0), (5, 3))}
        OpenEXR.File({**header, "compression": OpenEXR.ZIP_COMPRESSION}, {c: image(1)[..., 0] for c in "RGB"}).write(
            str(tmp_path / f"shot.{number:04d}.exr")
        )
    with pytest.raises(ExrError, match=r"data windows of all frames lie within 30006x30004 pixels, more than the \d+"):
        open_shot(tmp_path).read(1)


def test_missing_frame_cannot_be_read(tmp_path):
    shot = open_shot(save(tmp_path, [1, 3, 4]))
    assert [shot.has(number) for number in (1, 2)] == [True, False]
    with pytest.raises(FileNotFoundError, match="frame 2 is not there; the shot has 1,3-4"):
        shot.read(2)


# --- cropped frames


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


# --- writing


def test_write_replaces_what_is_named_and_nothing_else(tmp_path):
    layers = {"Noisy Image": image(1, 4), "Combined": image(2, 4), "glow": image(3, 4)}
    write_layers(tmp_path / "a.0001.exr", layers)
    shot = open_shot(tmp_path, aovs=["glow"])
    out = tmp_path / "out.exr"
    assert shot.write(out, 1, {"color": image(5), "glow": image(1e5)}, {"map": image(0.5, 1)}, {"by": "us"}) == 72
    again = read_exr(out)

    def values(name: str) -> list[float]:
        return again.pixels(again.layer(name).channels)[0, 0].tolist()

    assert values("Noisy Image") == [1, 1, 1, 1]
    assert values("Combined") == [5, 5, 5, 2]  # alpha stays
    assert values("glow") == [65504, 65504, 65504, 3]
    assert values("map") == [0.5]
    assert again.parts[0].header["by"] == "us"
    with pytest.raises(ValueError, match=r"\(4, 5, 3\), expected \(4, 6\)"):
        shot.write(out, 1, {"color": image(5, size=(4, 5))})


@pytest.mark.parametrize(
    ("pattern", "expected"),
    [
        ("OUT.####.exr", "OUT.0009.exr"),
        ("OUT.%05d.exr", "OUT.00009.exr"),
        ("OUT_v002.#.exr", "OUT_v002.9.exr"),
        ("new", "new/shot.0009.exr"),
    ],
)
def test_output_path(tmp_path, pattern, expected):
    shot = open_shot(save(tmp_path, [8, 9]))
    assert output_path(tmp_path / pattern, shot, 9) == tmp_path / expected


@pytest.mark.parametrize("pattern", ["OUT.####", "OUT.%04d", "OUT.####.tif", "new/####"])
def test_an_output_with_a_place_for_a_number_ends_in_exr(tmp_path, pattern):
    """A folder was made of that name."""
    shot = open_shot(save(tmp_path, [8, 9]))
    with pytest.raises(ValueError, match=rf"does not end in \.exr, expected .*{pattern}\.exr"):
        output_path(tmp_path / pattern, shot, 9)
    (tmp_path / pattern).mkdir(parents=True)
    assert output_path(tmp_path / pattern, shot, 9) == tmp_path / pattern / "shot.0009.exr"


def test_output_of_several_frames_needs_a_placeholder_and_may_not_be_the_input(tmp_path):
    shot = open_shot(save(tmp_path, [8, 9]))
    for pattern in ("OUT.exr", "OUT.0001.exr"):
        with pytest.raises(ValueError, match="names one file for 2 frames"):
            output_path(tmp_path / pattern, shot, 8)
        assert output_path(tmp_path / pattern, open_shot(tmp_path, frames="8"), 8) == tmp_path / pattern
    for pattern in ("shot.####.exr", "", "../" + tmp_path.name):
        with pytest.raises(ValueError, match="overwrite an input frame"):
            output_path(tmp_path / pattern, shot, 8)
    with pytest.raises(ValueError, match="overwrite"):  # a neighbour, not the frame itself
        output_path(tmp_path / "shot.0009.exr", open_shot(tmp_path, frames="8"), 8)


def test_a_file_that_was_exchanged_is_seen_whatever_its_time_and_size(tmp_path):
    """A run that went on over it ended with exit code 0."""
    shot = open_shot(save(tmp_path, [1, 2]))
    shot.read(1)
    shot.check_unchanged([1, 2])
    Path(shutil.copy2(shot.path(1), tmp_path / "spare")).replace(shot.path(1))
    with pytest.raises(OSError, match=r"shot\.0001\.exr has changed since it was read"):
        shot.check_unchanged([1, 2])


def test_each_frame_has_the_variance_of_its_own_samples(tmp_path):
    """A frame that was rendered again with more of them had that of the first one's."""
    ones = np.ones(SIZE, np.float32)
    for number, samples in ((1, 64), (2, 256)):
        channels = layer("", "RGB", ones, ones, ones) | layer("Variance", "RGB", ones, ones, ones)
        save_file(tmp_path / f"a.{number}.exr", channels, {"samplesPerPixel": samples, "renderTimeSeconds": 1.0})
    shot = open_shot(tmp_path)
    assert [shot.read(number).variance.max() for number in (1, 2)] == [1 / 64, 1 / 256]
    assert "variance 0.00390625" in shot.layer_summary(2)
