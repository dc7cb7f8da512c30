"""What is freed is kept, and given back when that is asked for."""

from __future__ import annotations

import platform
import subprocess
import sys

import pytest

HELD = """
import numpy as np
from hybrid.heap import keep_freed_memory, return_freed_memory

def resident():
    return int(open("/proc/self/statm").read().split()[1]) * 4096 / 2**20

keep_freed_memory()
before = resident()
blocks = [np.ones(2**22, np.float64) for _ in range(8)]  # 32 MiB each, and one between each two that stays
kept, blocks = blocks[1::2], None
print(resident() - before)
return_freed_memory()
print(resident() - before)
"""


@pytest.mark.skipif(platform.libc_ver()[0] != "glibc", reason="the C library is not glibc")
def test_what_is_freed_between_what_is_in_use_stays_until_it_is_given_back():
    done = subprocess.run([sys.executable, "-c", HELD], capture_output=True, text=True, check=True)
    kept, given_back = map(float, done.stdout.split())
    assert kept > 240
    assert 120 < given_back < 150
