"""Freed memory is kept, and returned when asked for, where the C library is glibc."""

import platform
import subprocess
import sys

import pytest

FREED = """
import sys, threading
import numpy as np
from hybrid.runtime.allocator import reuse_freed_memory

def resident():
    return int(open("/proc/self/statm").read().split()[1]) * 4096 / 2**20

def take():
    block = np.ones(2**23)  # 64 MiB, which glibc would map anew, and unmap

if sys.argv[1] == "keep":
    reuse_freed_memory()
before = resident()
take()
print(resident() - before)
thread = threading.Thread(target=take)
thread.start()
thread.join()
print(resident() - before)
"""


@pytest.mark.skipif(platform.libc_ver()[0] != "glibc", reason="the C library is not glibc")
@pytest.mark.parametrize(("words", "low", "high"), [("keep", 60, 80), ("leave", -1, 10)])
def test_what_is_freed_is_kept_and_serves_every_thread(words, low, high):
    done = subprocess.run([sys.executable, "-c", FREED, words], capture_output=True, text=True, check=True)
    for held in map(float, done.stdout.split()):
        assert low < held < high


RETURNED = """
import numpy as np
from hybrid.runtime.allocator import return_freed_memory, reuse_freed_memory

def resident():
    return int(open("/proc/self/statm").read().split()[1]) * 4096 / 2**20

reuse_freed_memory()
blocks = [np.ones(2**21) for _ in range(8)]  # 16 MiB each
del blocks[::2]
full = resident()
return_freed_memory()
print(full - resident(), sum(block.sum() for block in blocks) == 4 * 2**21)
"""


@pytest.mark.skipif(platform.libc_ver()[0] != "glibc", reason="the C library is not glibc")
def test_free_memory_between_blocks_is_returned():
    done = subprocess.run([sys.executable, "-c", RETURNED], capture_output=True, text=True, check=True)
    returned, whole = done.stdout.split()
    assert 50 < float(returned) < 80
    assert whole == "True"
