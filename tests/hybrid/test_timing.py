import subprocess
import sys
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


PEAK = """
from hybrid.timing import peak_memory
before = peak_memory()
bytearray(256 * 2**20)  # zeroed, so touched; and freed
print(before, peak_memory())
"""


def test_peak_memory_grows_by_what_is_used():
    """In a process of its own: what this one has used before would be its peak already."""
    done = subprocess.run([sys.executable, "-c", PEAK], capture_output=True, text=True, check=True)
    before, after = (int(word) for word in done.stdout.split())
    # What the allocator adds is a matter of pages; what was free before, of a MiB or so.
    assert after - before == pytest.approx(256 * 2**20, rel=0.02)
    assert before < 256 * 2**20


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
