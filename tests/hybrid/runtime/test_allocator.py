"""Freed memory is kept where the C library is glibc."""

from __future__ import annotations

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
