import subprocess
import sys
import threading
import time
from contextlib import suppress

import numpy as np
import pytest

from hybrid.files.replace import replace_file
from hybrid.runtime.system import peak_memory
from hybrid.runtime.timing import Timings


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


def burn(seconds):
    start = time.thread_time()
    while time.thread_time() - start < seconds:
        pass


def test_what_goes_on_beside_the_work_is_counted_there_and_not_with_the_work():
    """CPU time, not the clock: half a second of it in a thread, over two stages of the work."""
    timings, half = Timings(), threading.Event()

    def read():
        with timings.background("read"):
            burn(0.25)
            half.set()
            burn(0.25)

    thread = threading.Thread(target=read)
    with timings.stage("warp"):
        thread.start()
        assert half.wait(60)
    with timings.stage("flow"):
        thread.join()
    with timings.stage("check"):
        burn(0.1)
    stages = timings.stages
    assert stages["read"].cpu_seconds == pytest.approx(0.5, rel=0.2)
    assert stages["read"].seconds == 0
    assert stages["warp"].cpu_seconds < 0.1
    assert stages["flow"].cpu_seconds < 0.1
    assert stages["check"].cpu_seconds == pytest.approx(0.1, rel=0.5)


PEAK = """
from hybrid.runtime.system import peak_memory
before = peak_memory()
bytearray(256 * 2**20)  # zeroed, so touched; and freed
print(before, peak_memory())
"""


def test_peak_memory_grows_by_what_is_used():
    """In a process of its own: what this one has used before would be its peak already."""
    done = subprocess.run([sys.executable, "-c", PEAK], capture_output=True, text=True, check=True)
    before, after = (int(word) for word in done.stdout.split())
    # The allocator adds some pages; a MiB or so was free before.
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
