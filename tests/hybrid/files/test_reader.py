import shutil
from pathlib import Path

import numpy as np
import OpenEXR
import pytest

from hybrid.files import reader as reader_module
from hybrid.files.exr import ExrError, read_exr
from hybrid.files.shots import open_shot
from tests.exr_files import SIZE, exchange, flat_image, save_frames
from tests.renderers import layer
from tests.renderers import save as save_file


def test_frames_that_are_kept_are_read_once_and_no_more_are_held(tmp_path, monkeypatch):
    shot = open_shot(save_frames(tmp_path, range(1, 13)), keep=5)
    opened: list[Path] = []

    def counted(path, *, pixels=True, **kwargs):
        if pixels:
            opened.append(path)
        return read_exr(path, pixels=pixels, **kwargs)

    monkeypatch.setattr(reader_module, "read_exr", counted)
    for number in shot.numbers:
        there = shot.neighbours(number, 2)
        assert len(there) >= 3
        assert [shot.read(near).number for near in there] == there
        assert len(shot.reader._frames) <= 5
    assert sorted(opened) == [shot.path(number) for number in shot.numbers]


def test_opening_a_shot_reads_nothing_and_a_damaged_frame_is_an_error_when_met(tmp_path):
    save_frames(tmp_path, [1, 2, 3])
    path = tmp_path / "shot.0003.exr"
    path.write_bytes(path.read_bytes()[:-30])
    (tmp_path / "shot.0004.exr").write_text("not an image")
    shot = open_shot(tmp_path)
    assert shot.read(1).number == 1
    with pytest.raises(ExrError, match=r"shot\.0003\.exr: damaged or truncated"):
        shot.read(3)


def test_frames_of_other_sizes_are_an_error_that_names_both(tmp_path):
    save_frames(save_frames(tmp_path, [1, 2]), [3], size=(4, 7))
    shot = open_shot(tmp_path)
    assert shot.read(2).number == 2
    with pytest.raises(ValueError, match="frame 1 is 6x4, frame 3 is 7x4"):
        shot.read(3)


def test_data_windows_that_lie_far_apart_are_refused_before_memory_is_taken(tmp_path):
    """Two files of 24 pixels asked for 4.5 GiB."""
    for number, at in ((1, 0), (2, 30000)):
        header = {"dataWindow": ((at, at), (at + 5, at + 3)), "displayWindow": ((0, 0), (5, 3))}
        channels = {c: flat_image(1)[..., 0] for c in "RGB"}
        file = OpenEXR.File({**header, "compression": OpenEXR.ZIP_COMPRESSION}, channels)
        file.write(str(tmp_path / f"shot.{number:04d}.exr"))
    with pytest.raises(ExrError, match=r"data windows of all frames lie within 30006x30004 pixels, more than the \d+"):
        open_shot(tmp_path).read(1)


def test_missing_frame_cannot_be_read(tmp_path):
    shot = open_shot(save_frames(tmp_path, [1, 3, 4]))
    assert [shot.has(number) for number in (1, 2)] == [True, False]
    with pytest.raises(FileNotFoundError, match="frame 2 is not there; the shot has 1,3-4"):
        shot.read(2)


def test_a_file_that_was_exchanged_is_seen_whatever_its_time_and_size(tmp_path):
    """A run that went on over it ended with exit code 0."""
    shot = open_shot(save_frames(tmp_path, [1, 2]))
    shot.read(1)
    shot.reader.check_unchanged([1, 2])
    exchange(shot.path(1))
    with pytest.raises(OSError, match=r"shot\.0001\.exr has changed since it was read"):
        shot.reader.check_unchanged([1, 2])


def test_another_inode_of_the_same_content_is_no_change(tmp_path):
    """Some network drives change the inodes of files."""
    shot = open_shot(save_frames(tmp_path, [1]))
    shot.read(1)
    Path(shutil.copy2(shot.path(1), tmp_path / "spare")).replace(shot.path(1))
    shot.reader.check_unchanged([1])
    exchange(shot.path(1))
    with pytest.raises(OSError, match="has changed since it was read"):
        shot.reader.check_unchanged([1])


def test_each_frame_has_the_variance_of_its_own_samples(tmp_path):
    """A frame that was rendered again with more of them had that of the first one's."""
    ones = np.ones(SIZE, np.float32)
    for number, samples in ((1, 64), (2, 256)):
        channels = layer("", "RGB", ones, ones, ones) | layer("Variance", "RGB", ones, ones, ones)
        save_file(tmp_path / f"a.{number}.exr", channels, {"samplesPerPixel": samples, "renderTimeSeconds": 1.0})
    shot = open_shot(tmp_path)
    assert [shot.read(number).variance.max() for number in (1, 2)] == [1 / 64, 1 / 256]
    assert [shot.read(number).samples for number in (1, 2)] == [64, 256]
    assert "variance 0.00390625" in shot.reader.layer_summary(2)
