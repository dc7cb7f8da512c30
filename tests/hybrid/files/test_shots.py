import re
from pathlib import Path

import numpy as np
import OpenEXR
import pytest

from flow.motion import CYCLES
from hybrid.denoising.plan import Rules
from hybrid.denoising.stream import FrameStream
from hybrid.files.exr import read_exr
from hybrid.files.reader import Interpretation
from hybrid.files.shots import Shot, open_shot, output_path
from tests.exr_files import SIZE, exchange, flat_image, save_frames, write_layers
from tests.renderers import layer


def neighbours(shot: Shot, number: int, radius: int) -> list[int | None]:
    """Numbers of a frame and what there is around it."""
    around = FrameStream(shot, Rules()).around(number, radius)
    return [n if shot.has(n) else None for n in around]


# --- what is kept


def test_a_lossy_compression_of_what_is_kept_is_named(tmp_path):
    planes = layer("", "RGBA", flat_image(1), flat_image(1, 1)[..., 0]) | layer("Vector", "XY", flat_image(1, 2))
    header = {"compression": OpenEXR.DWAA_COMPRESSION, "type": OpenEXR.scanlineimage}
    OpenEXR.File([OpenEXR.Part(header, {n: OpenEXR.Channel(n, p) for n, p in planes.items()}, "")]).write(
        str(tmp_path / "a.0001.exr")
    )
    said = ["files: DWAA would change layers that are kept, written with ZIP"]
    assert open_shot(tmp_path).recompressed_parts() == said
    assert open_shot(tmp_path, layers={"color": "RGB"}, aovs=["Vector"]).recompressed_parts() == []
    (tmp_path / "zip").mkdir()
    save_frames(tmp_path / "zip", [1])
    assert open_shot(tmp_path / "zip").recompressed_parts() == []


# --- names


def test_one_file_is_a_shot_of_one_frame(tmp_path):
    shot = open_shot(save_frames(tmp_path, [8, 9]) / "shot.0009.exr")
    assert shot.numbers == (9,)
    assert neighbours(shot, 9, 1) == [None, 9, None]
    (warning,) = shot.warnings
    alone, all_of_them = tmp_path / "shot.0009.exr", tmp_path / "shot.####.exr"
    assert warning == f"{alone} is taken alone; {all_of_them} 8-9 would take its neighbours too"
    save_frames(tmp_path, [1], "still.exr")
    assert open_shot(tmp_path / "still.exr").warnings == ()
    assert open_shot(tmp_path / "still.exr").numbers == (1,)


def test_no_match_names_the_pattern_and_what_is_there(tmp_path):
    save_frames(tmp_path, [8, 9])
    with pytest.raises(FileNotFoundError, match=r"none\.####\.exr: no frame matches; .*shot\.####\.exr"):
        open_shot(tmp_path / "none.####.exr")
    with pytest.raises(FileNotFoundError, match=r"shot\.0010\.exr: no such file; .*shot\.####\.exr"):
        open_shot(tmp_path / "shot.0010.exr")
    with pytest.raises(FileNotFoundError, match="there is no folder"):
        open_shot(tmp_path / "nowhere" / "a.####.exr")
    (tmp_path / "empty").mkdir()
    with pytest.raises(FileNotFoundError, match="no EXR files in this folder"):
        open_shot(tmp_path / "empty")


# --- ranges, holes, neighbours


def test_range_selects_frames_and_neighbours_come_from_outside_of_it(tmp_path):
    save_frames(tmp_path, range(1, 10))
    shot = open_shot(tmp_path, frames="3-7x2")
    assert shot.numbers == (3, 5, 7)
    assert shot.step == 1
    assert neighbours(shot, 3, 2) == [1, 2, 3, 4, 5]
    assert neighbours(open_shot(tmp_path), 9, 2) == [7, 8, 9, None, None]


@pytest.mark.parametrize("frames", ["abc", "1-", "", "1-2x0.5"])
def test_range_that_is_none_is_refused(tmp_path, frames):
    with pytest.raises(ValueError, match="is not a range of frames") as caught:
        open_shot(save_frames(tmp_path, [1, 2]), frames=frames)
    assert "\n" not in str(caught.value)


def test_range_without_any_frame_is_not_found(tmp_path):
    with pytest.raises(FileNotFoundError, match=r"none of the frames 5-6 is there; .* has 1-2"):
        open_shot(save_frames(tmp_path, [1, 2]), frames="5-6")


def test_frames_around_those_asked_for_are_those_there_are(tmp_path):
    shot = open_shot(save_frames(tmp_path, (1, 2, 3, 5, 6, 9)), frames="3-5")
    assert shot.with_neighbours(0).numbers == (3, 5)
    assert shot.with_neighbours(2).numbers == (1, 2, 3, 5, 6)
    assert shot.numbers == (3, 5)
    # The step of these files alone would be 2.
    made = shot.reopened({number: shot.path(number) for number in (1, 3, 5)})
    assert (made.numbers, made.step, shot.step) == ((3, 5), 1, 1)
    assert made.has(1)
    assert not made.has(2)


def test_hole_is_a_warning_and_a_narrower_window(tmp_path):
    shot = open_shot(save_frames(tmp_path, [1, 2, 4, 5, 8]))
    assert shot.numbers == (1, 2, 4, 5, 8)
    assert shot.warnings == ("missing frames 3,6-7: the windows beside them are narrower",)
    assert neighbours(shot, 4, 2) == [2, None, 4, 5, None]
    asked = open_shot(tmp_path, frames="4-6")
    assert (asked.numbers, len(asked.warnings)) == ((4, 5), 1)


def test_every_second_frame_has_neighbours_two_away(tmp_path):
    shot = open_shot(save_frames(tmp_path, [1, 3, 5, 9]))
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


@pytest.mark.parametrize("stale", [3, 4, 100])
def test_a_frame_of_another_size_outside_the_range_changes_nothing(tmp_path, stale):
    """It stopped the run as a neighbour, and shortened the step."""
    numbers = [number for number in (1, 3, 5, 7) if number != stale]
    save_frames(tmp_path, [stale], size=(8, 8))
    shot = open_shot(save_frames(tmp_path, numbers), frames="5-7")
    assert shot.step == 2
    assert list(shot.available) == numbers
    assert [shot.read(number).color[0, 0, 0] for number in shot.neighbours(5, 2)] == numbers
    assert f"frames {stale} differ in size from those asked for: left out" in shot.warnings


# --- writing


def test_write_replaces_what_is_named_and_nothing_else(tmp_path):
    layers = {"Noisy Image": flat_image(1, 4), "Combined": flat_image(2, 4), "glow": flat_image(3, 4)}
    write_layers(tmp_path / "a.0001.exr", layers)
    shot = open_shot(tmp_path, aovs=["glow"])
    out = tmp_path / "out.exr"
    images = {"color": flat_image(5), "glow": flat_image(1e5)}
    assert shot.write(out, 1, images, {"map": flat_image(0.5, 1)}, {"by": "us"}) == 72
    again = read_exr(out)

    def values(name: str) -> list[float]:
        return again.pixels(again.layer(name).channels)[0, 0].tolist()

    assert values("Noisy Image") == [1, 1, 1, 1]
    assert values("Combined") == [5, 5, 5, 2]  # alpha stays
    assert values("glow") == [65504, 65504, 65504, 3]
    assert values("map") == [0.5]
    assert again.parts[0].header["by"] == "us"
    with pytest.raises(ValueError, match=r"\(4, 5, 3\), expected \(4, 6\)"):
        shot.write(out, 1, {"color": flat_image(5, size=(4, 5))})


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
    shot = open_shot(save_frames(tmp_path, [8, 9]))
    assert output_path(tmp_path / pattern, shot, 9) == tmp_path / expected


@pytest.mark.parametrize("pattern", ["OUT.####", "OUT.%04d", "OUT.####.tif", "new/####"])
def test_an_output_with_a_place_for_a_number_ends_in_exr(tmp_path, pattern):
    """A folder was made of that name."""
    shot = open_shot(save_frames(tmp_path, [8, 9]))
    with pytest.raises(ValueError, match=rf"does not end in \.exr, expected .*{re.escape(str(Path(pattern)))}\.exr"):
        output_path(tmp_path / pattern, shot, 9)
    (tmp_path / pattern).mkdir(parents=True)
    assert output_path(tmp_path / pattern, shot, 9) == tmp_path / pattern / "shot.0009.exr"


def test_output_of_several_frames_needs_a_placeholder_and_may_not_be_the_input(tmp_path):
    shot = open_shot(save_frames(tmp_path, [8, 9]))
    for pattern in ("OUT.exr", "OUT.0001.exr"):
        with pytest.raises(ValueError, match="names one file for 2 frames"):
            output_path(tmp_path / pattern, shot, 8)
        assert output_path(tmp_path / pattern, open_shot(tmp_path, frames="8"), 8) == tmp_path / pattern
    for pattern in ("shot.####.exr", "", "../" + tmp_path.name):
        with pytest.raises(ValueError, match="overwrite an input frame"):
            output_path(tmp_path / pattern, shot, 8)
    with pytest.raises(ValueError, match="overwrite"):  # a neighbour, not the frame itself
        output_path(tmp_path / "shot.0009.exr", open_shot(tmp_path, frames="8"), 8)


@pytest.mark.parametrize(
    ("arguments", "error"),
    [
        ({"aovs": "all"}, r"aovs is 'all', expected a list of names: \['all'\]"),
        (
            {"profile": "cycles"},
            "profile is 'cycles', expected a Profile, as hybrid.files.profile.open_profile returns",
        ),
        ({"keep": -1}, "keep is -1, expected a number of frames, at least 0"),
        ({"keep": "2"}, "keep is '2', expected a number of frames, at least 0"),
    ],
)
def test_arguments_of_another_kind_are_refused(tmp_path, arguments, error):
    """The first had no layer 'a'; the others ended in an AttributeError, a KeyError and a TypeError."""
    with pytest.raises(ValueError, match=error):
        open_shot(save_frames(tmp_path, [1]), **arguments)


# --- shots made from a shot


def test_a_file_that_changes_after_validation_is_seen(tmp_path):
    shot = open_shot(save_frames(tmp_path, [1, 2]))
    shot.read(1)
    validated = shot.reinterpreted(Interpretation(variance_scale=2.0))
    exchange(shot.path(1))
    with pytest.raises(OSError, match="has changed since it was read"):
        validated.reader.check_unchanged([1])


def test_a_file_that_changes_between_two_views_is_seen(tmp_path):
    layers = {f"{name}.Combined": flat_image(1) for name in ("Front", "Back")}
    write_layers(tmp_path / "a.0001.exr", layers)
    first, second = open_shot(tmp_path).views
    first.read(1)
    exchange(first.path(1))
    with pytest.raises(OSError, match="has changed since it was read"):
        second.read(1)


def test_motion_that_is_ignored_stays_ignored_after_validation(tmp_path):
    shot = open_shot(save_frames(tmp_path, [1]), motion="none")
    assert shot.layers(1).motion is None
    assert shot.reinterpreted(Interpretation(frozenset({"albedo"}))).layers(1).motion is None


def test_a_shot_with_neighbours_holds_the_frames_that_were_read(tmp_path):
    shot = open_shot(save_frames(tmp_path, [1, 2, 3]), frames="2", keep=1)
    frame = shot.read(2)
    wider = shot.with_neighbours(1)
    assert wider.numbers == (1, 2, 3)
    assert wider.read(2) is frame
    assert shot.reinterpreted(Interpretation()).read(2) is not frame


def test_a_reopened_shot_leaves_out_the_same_layers(tmp_path):
    shot = open_shot(save_frames(tmp_path, [1])).reinterpreted(Interpretation(frozenset({"motion"})))
    assert shot.reopened({1: shot.path(1)}).layers(1).motion is None


def test_a_file_that_changed_since_it_was_read_is_not_written_over_with_its_picture(tmp_path):
    shot = open_shot(save_frames(tmp_path, [1]))
    color = shot.read(1).color
    exchange(shot.path(1))
    with pytest.raises(OSError, match="has changed since it was read"):
        shot.write(tmp_path / "out.exr", 1, {"color": color})
    assert not (tmp_path / "out.exr").exists()
