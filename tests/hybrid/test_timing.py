from contextlib import suppress

import numpy as np
import pytest

from hybrid.files.replace import replace_file
from hybrid.timing import Timings, peak_memory


def test_stages_add_up():
    timings = Timings()
    for _ in range(3):
        with timings.stage("warp"):
            np.ones(10).sum()
    stage = timings.stages["warp"]
    assert stage.calls == 3
    assert stage.seconds > 0
    assert stage.peak_bytes == pytest.approx(peak_memory(), rel=0.5)


def test_a_stage_that_fails_is_counted_too():
    timings = Timings()
    with pytest.raises(KeyError), timings.stage("flow"):
        raise KeyError
    assert timings.stages["flow"].calls == 1


def test_peak_memory_grows_with_what_is_used():
    before = peak_memory()
    block = np.ones(64 * 2**20, np.uint8)  # 64 MiB, touched
    assert peak_memory() >= before
    assert peak_memory() > block.nbytes


def test_a_file_is_replaced_as_a_whole_or_not_at_all(tmp_path):
    path = tmp_path / "frame"
    path.write_text("old")
    with suppress(KeyboardInterrupt), replace_file(path) as temporary:
        temporary.write_text("half of the new")
        raise KeyboardInterrupt
    assert path.read_text() == "old"
    with replace_file(path) as temporary:
        temporary.write_text("new")
    assert path.read_text() == "new"
    assert list(tmp_path.iterdir()) == [path]


def test_a_folder_that_is_not_there_is_named_by_the_file_that_was_wanted(tmp_path):
    with pytest.raises(FileNotFoundError, match="cannot write") as caught, replace_file(tmp_path / "no" / "x.exr"):
        pass
    assert caught.value.filename == str(tmp_path / "no" / "x.exr")
