from pathlib import Path

import pytest

from hybrid.files.sequences import find_files, find_views, name_holes, parse_frames, parse_pattern
from hybrid.files.shots import open_shot

NOT_ON_WINDOWS = [pytest.param(name, marks=pytest.mark.posix) for name in ("back\\slash", "new\nline")]


@pytest.fixture
def folder(tmp_path):
    """Frames 8 to 12 of a sequence whose name holds numbers, a second sequence, and a temporary file."""
    for number in range(8, 13):
        (tmp_path / f"aov1_v002.{number:04d}.exr").touch()
    (tmp_path / ".aov1_v002.0008.exr.host-1-1.tmp").touch()
    (tmp_path / "notes.txt").touch()
    return tmp_path


@pytest.mark.parametrize(
    "place", ["####", "@@@@", "%04d", "%d", "#", "$F4", "$F", "${F4}", "<frame04>", "<Frame4>", "<f4>", "<frame>"]
)
def test_places_for_a_number_of_every_program(folder, place):
    files, frames = find_files(f"{folder}/aov1_v002.{place}.exr")
    assert list(files) == [8, 9, 10, 11, 12]
    assert files[9] == folder / "aov1_v002.0009.exr"
    assert frames is None


@pytest.mark.parametrize(
    "name",
    [
        "aov1_v002.####.exr 8-10",  # Nuke
        "aov1_v002.%04d.exr 8-10",
        "aov1_v002.$F4.exr  8,9,10",
        "aov1_v002.8-10####.exr",  # RV
        "aov1_v002.8-10@@@@.exr",
        "aov1_v002.8-10%04d.exr",
        "aov1_v002.00[01][890].exr",  # a glob; neighbours need not match
    ],
)
def test_ranges_that_are_pasted_along(folder, name):
    files, frames = find_files(f"{folder}/{name}")
    assert list(files) == [8, 9, 10, 11, 12]
    assert parse_frames(frames) == [8, 9, 10]


def test_globs_and_folders_of_one_sequence(folder):
    assert list(find_files(f"{folder}/*.exr")[0]) == [8, 9, 10, 11, 12]
    assert list(find_files(str(folder))[0]) == [8, 9, 10, 11, 12]
    assert find_files(f"{folder}/aov1_v002.0009.exr") == ({9: folder / "aov1_v002.0009.exr"}, None)
    (folder / "other.0008.exr").touch()
    for spec in (f"{folder}/*.exr", str(folder)):
        with pytest.raises(ValueError, match=r"several sequences.*aov1_v002\.#### 8-12|aov1_v002\.####\.exr 8-12"):
            find_files(spec)


def test_a_range_in_a_name_that_is_its_own(tmp_path):
    (tmp_path / "take1-2.0001.exr").touch()
    (tmp_path / "take1-20001.exr").touch()
    assert find_files(f"{tmp_path}/take1-2.####.exr") == ({1: tmp_path / "take1-2.0001.exr"}, None)
    assert find_files(f"{tmp_path}/take1-2####.exr") == ({1: tmp_path / "take1-20001.exr"}, None)


@pytest.mark.parametrize("name", ["plates_####", "100%04d", "[1]", "a b 1-3", "$F4", "v@2"])
def test_folders_may_have_names_that_look_like_patterns(tmp_path, name):
    home = tmp_path / name
    home.mkdir()
    (home / "a.0001.exr").touch()
    for spec in (f"{home}/a.####.exr", f"{home}/a.*.exr", f"{home}/a.####.exr 1-1", str(home), f"{home}/a.0001.exr"):
        assert find_files(spec)[0] == {1: home / "a.0001.exr"}


def test_the_hyphen_of_a_name_is_no_sign(tmp_path):
    for number in range(1, 4):
        (tmp_path / f"shot-{number:04d}.exr").touch()
    for spec in (tmp_path, tmp_path / "shot-####.exr", tmp_path / "shot-*.exr"):
        assert list(find_files(str(spec))[0]) == [1, 2, 3]
    assert list(find_files(f"{tmp_path}/shot-0002.exr")[0]) == [2]
    other = tmp_path / "other"
    other.mkdir()
    (other / "shot.-001.exr").touch()
    assert list(find_files(str(other))[0]) == [-1]
    assert parse_pattern(f"{other}/shot.####.exr")[0].path(-1).name == "shot.-001.exr"


def test_numbers_of_several_widths(tmp_path):
    for name in ("a.9999.exr", "a.10000.exr", "a.01.exr", "a.0001.exr"):
        (tmp_path / name).touch()
    files, _ = find_files(f"{tmp_path}/a.####.exr")
    assert {n: path.name for n, path in files.items()} == {1: "a.0001.exr", 9999: "a.9999.exr", 10000: "a.10000.exr"}
    assert find_files(f"{tmp_path}/a.##.exr")[0][1].name == "a.01.exr"


def test_what_is_not_there_is_said_with_what_is(folder):
    for spec in ("beauty.####.exr", "beauty.$F4.exr", "beauty.exr", "b*.exr"):
        with pytest.raises(FileNotFoundError, match=r"aov1_v002\.####\.exr 8-12"):
            find_files(f"{folder}/{spec}")
    with pytest.raises(FileNotFoundError, match="there is no folder"):
        find_files(f"{folder}/nowhere/a.####.exr")


def test_numbers_that_are_padded_differently_are_not_one_sequence(tmp_path):
    """Whatever numbers did not clash were mixed: two takes, one picture from each."""
    for name in ("a.10.exr", "a.11.exr", "a.0012.exr", "a.0013.exr", "b.998.exr", "b.1000.exr"):
        (tmp_path / name).touch()
    assert list(find_files(f"{tmp_path}/a.##.exr")[0]) == [10, 11]
    assert list(find_files(f"{tmp_path}/a.####.exr")[0]) == [12, 13]
    assert list(find_files(f"{tmp_path}/b.#.exr")[0]) == [998, 1000]
    for name in ("a.###.exr", "a.*.exr"):
        with pytest.raises((ValueError, FileNotFoundError), match=r"a\.####\.exr 12-13, a\.##\.exr 10-11"):
            find_files(f"{tmp_path}/{name}")


def test_a_file_that_is_called_like_a_pattern_is_not_taken_for_its_frames(tmp_path):
    (tmp_path / "a.####.exr").touch()
    assert list(find_files(f"{tmp_path}/a.####.exr")[0]) == [1]
    (tmp_path / "a.0001.exr").touch()
    with pytest.raises(ValueError, match="is a file, and a pattern that others match"):
        find_files(f"{tmp_path}/a.####.exr")


@pytest.mark.parametrize("name", ["a+b", "take(2)", "x{1,2}", *NOT_ON_WINDOWS])
def test_the_rest_of_a_name_is_taken_as_it_is_written(tmp_path, name):
    for file in (f"{name}.0001.exr", f"{name}.0002.exr", "axb.0003.exr", "aab.0004.exr"):
        (tmp_path / file).touch()
    assert list(find_files(f"{tmp_path}/{name}.####.exr")[0]) == [1, 2]


@pytest.mark.posix
def test_hidden_files_folders_and_other_digits_are_no_frames(tmp_path):
    for name in ("a.0001.exr", "._a.0001.exr", ".a.0002.exr", "a.\u0663.exr"):
        (tmp_path / name).touch()
    (tmp_path / "a.0003.exr").mkdir()
    (tmp_path / "a.0004.exr").symlink_to("a.0004.exr")  # a loop: named when it is read
    assert list(find_files(f"{tmp_path}/a.####.exr")[0]) == [1, 4]


@pytest.mark.parametrize("form", ["{:04d}", "{:d}", "{:03d}"])
def test_negative_numbers_are_padded_with_their_sign(tmp_path, form):
    """A folder from -2 to 10 was said to hold two sequences: ### and ####."""
    numbers = [-12, -2, -1, 0, 1, 10]
    for number in numbers:
        (tmp_path / f"a.{form.format(number)}.exr").touch()
    files, _ = find_files(str(tmp_path))
    assert list(files) == numbers
    assert [path.name for path in files.values()] == [f"a.{form.format(number)}.exr" for number in numbers]


def test_negative_numbers_with_nothing_before_them(tmp_path):
    """Half of -0002 to 0001 was left out, or the order was reversed: the hyphen was taken for a name."""
    names = ["-0002.exr", "-0001.exr", "0000.exr", "0001.exr"]
    for name in names:
        (tmp_path / name).touch()
    for spec in (str(tmp_path), f"{tmp_path}/####.exr", f"{tmp_path}/%04d.exr", f"{tmp_path}/*.exr"):
        files, _ = find_files(spec)
        assert [(number, path.name) for number, path in files.items()] == [*zip(range(-2, 2), names, strict=True)]
    assert list(find_files(f"{tmp_path}/-0001.exr")[0]) == [-1]
    for spec in (f"{tmp_path}/####.exr -2--1", f"{tmp_path}/-2--1####.exr", f"{tmp_path}/-*.exr"):
        assert parse_frames(find_files(spec)[1] or "") == [-2, -1]
    (tmp_path / "other.0001.exr").touch()
    with pytest.raises(ValueError, match=r" ####\.exr -2-1, other\.####\.exr 1"):
        find_files(str(tmp_path))
    with pytest.raises(ValueError, match=r"the hyphen is the sign of negative numbers, expected the pattern ####\.exr"):
        find_files(f"{tmp_path}/-####.exr")


@pytest.mark.parametrize("before", ["a.", "shot_", "", "v2_", "foo ", "foo-", "foo("])
@pytest.mark.parametrize("form", ["-{:04d}", "-{:03d}", "-{:d}"])
@pytest.mark.parametrize("least", [0, 1, 9])
def test_signs_beside_numbers_of_any_width(tmp_path, before, form, least):
    """Blender pads the number and puts the sign before it; most others count the sign as a digit."""
    expected = {-n: f"{before}{form.format(n)}.exr" for n in (12, 2, 1)}
    expected |= {n: f"{before}{n:0{4 if '0' in form else 1}d}.exr" for n in (least, least + 1)}
    for name in expected.values():
        (tmp_path / name).touch()
    files, _ = find_files(f"{tmp_path}/{before}####.exr")
    assert {number: path.name for number, path in files.items()} == expected
    assert find_files(str(tmp_path))[0] == files


def test_two_files_of_one_negative_frame_are_refused(tmp_path):
    for name in ("a.-001.exr", "a.-0001.exr", "a.0000.exr"):
        (tmp_path / name).touch()
    with pytest.raises(ValueError, match=r"frame -1 is a\.-0*1\.exr and a\.-0*1\.exr, expected one of them"):
        find_files(f"{tmp_path}/a.####.exr")


def test_a_hyphen_that_may_be_a_sign_is_refused(tmp_path):
    """Blender writes shot-0001.exr before shot0000.exr; of either pattern half was left out without a word."""
    for name in ("shot-0002.exr", "shot-0001.exr", "shot0000.exr", "shot0001.exr"):
        (tmp_path / name).touch()
    for spec in ("shot####.exr", "shot-####.exr"):
        with pytest.raises(ValueError, match=r"shot-0001\.exr may be frame -1 of shot####\.exr or frame 1 of"):
            find_files(f"{tmp_path}/{spec}")
    with pytest.raises(ValueError, match=r"several sequences.*shot####\.exr"):
        find_files(str(tmp_path))
    (tmp_path / "shot0000.exr").unlink()  # of every second frame none may be 0
    for spec in ("shot####.exr", "shot-####.exr"):
        with pytest.raises(ValueError, match=r"shot-0001\.exr may be frame -1 of shot####\.exr or frame 1 of"):
            find_files(f"{tmp_path}/{spec}")
    (tmp_path / "shot0001.exr").unlink()
    assert list(find_files(f"{tmp_path}/shot-####.exr")[0]) == [1, 2]


@pytest.mark.parametrize("frames", ["1-" + "9" * 400, "1-2x" + "9" * 400, "9" * 400 + "-1x-" + "9" * 400])
def test_ranges_of_hundreds_of_digits_are_none(frames):
    with pytest.raises(ValueError, match="is not a range") as caught:
        parse_frames(frames)
    assert len(str(caught.value)) < 200


def test_millions_of_missing_frames_are_not_counted_one_by_one(tmp_path):
    """Three files that were numbered by their dates took all memory."""
    for number in (1, 3, 10**15):
        (tmp_path / f"a.{number}.exr").touch()
    shot = open_shot(tmp_path / "a.#.exr")
    assert shot.warnings == (f"missing frames 2,4-{10**15 - 1}: the windows beside them are narrower",)
    assert name_holes(range(0, 100, 5), 1).endswith(" and 11 more ranges")
    assert name_holes([1, 3, 9, 11], 2) == "5-7x2"
    with pytest.raises(ValueError, match="is not a range"):
        parse_frames("1-100000000000")


@pytest.mark.parametrize(("there", "asked"), [("Ünï.{}.exr", "ÜNÏ.####.exr"), ("u\u0308.{}.exr", "\u00fc.####.EXR")])
def test_names_that_the_file_system_takes_for_the_same_are_one_sequence(tmp_path, monkeypatch, there, asked):
    """Windows and macOS ignore case, macOS how accents are composed; a listing of a folder has other names then."""
    for number in (8, 9):
        (tmp_path / there.format(f"{number:04d}")).touch()
    if not (tmp_path / asked.replace("####", "0008")).exists():
        with pytest.raises(FileNotFoundError, match="no frame matches"):
            find_files(str(tmp_path / asked))
        monkeypatch.setattr(Path, "exists", lambda path: True)
    files, _ = find_files(str(tmp_path / asked))
    assert list(files) == [8, 9]
    assert files[9].name == asked.replace("####", "0009")


def test_globs_and_views_ignore_case_where_the_file_system_does(tmp_path, monkeypatch):
    """macOS ignores case, but its patterns with * and %V did not."""
    for view in ("left", "right"):
        (tmp_path / f"Shot_{view}.0008.exr").touch()
    glob, views = str(tmp_path / "SHOT_l*.EXR"), str(tmp_path / "SHOT_%V.####.EXR")
    if not (tmp_path / "SHOT_LEFT.0008.EXR").exists():
        with pytest.raises(FileNotFoundError, match="no such file"):
            find_files(glob)
        with pytest.raises(FileNotFoundError, match="no view is there"):
            find_views(views)
        exists = Path.exists
        known = {str(path).lower() for path in tmp_path.iterdir()}
        monkeypatch.setattr(Path, "exists", lambda path: str(path).lower() in known or exists(path))
    assert list(find_files(glob)[0]) == [8]
    assert find_views(views) == ["left", "right"]
