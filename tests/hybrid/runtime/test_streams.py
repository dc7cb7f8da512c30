"""Standard streams that are closed before the process starts, or lead nowhere."""

import os
import subprocess
import sys

import pytest

from hybrid.files.exr import read_exr
from tests.scenes import Scene

CHILD = """
import os, sys
for number in {closed}:
    os.close(number)
{run}
"""


def run_without(closed, run, **environment):
    """The exit code of a process that closes some of its standard streams and then runs some code."""
    code = CHILD.format(closed=closed, run=run)
    return subprocess.run([sys.executable, "-c", code], env=os.environ | environment).returncode


@pytest.mark.skipif(sys.platform == "win32", reason="closed descriptors cannot be handed on there")
@pytest.mark.parametrize("closed", [(2,), (1,), (0, 2), (1, 2), (0, 1, 2)])
def test_files_are_read_and_written_without_standard_streams(closed, tmp_path):
    """`os.dup` of a closed standard error raised OSError."""
    Scene(frames=1).write(tmp_path)
    path, again = tmp_path / "shot.1001.exr", tmp_path / "again.exr"
    run = f"""
from hybrid.files.exr import read_exr, write_exr
for _ in range(2):
    write_exr({str(again)!r}, read_exr({str(path)!r}), {{}})
"""
    assert run_without(closed, run) == 0
    assert read_exr(again).channel_names == read_exr(path).channel_names


@pytest.mark.skipif(sys.platform == "win32", reason="closed descriptors cannot be handed on there")
@pytest.mark.parametrize("closed", [(2,), (0, 1, 2)])
def test_what_libraries_print_is_never_written_into_a_file_that_was_opened_later(closed, tmp_path):
    """The first file that was opened took the number of the closed standard error."""
    path = tmp_path / "log"
    run = f"""
from hybrid.commands.log import tolerant_streams
with tolerant_streams(), open({str(path)!r}, "w") as file:
    os.write(2, b"printed")
"""
    assert run_without(closed, run) == 0
    assert path.read_bytes() == b""


@pytest.mark.skipif(sys.platform == "win32", reason="pipes without a reader are no error there")
def test_a_standard_error_that_nobody_reads_does_not_end_the_reading(tmp_path):
    """Lines that others print while a file is read are passed on afterwards."""
    path = Scene(frames=1).write(tmp_path) / "shot.1001.exr"
    run = f"""
from hybrid.files import exr
reader, writer = os.pipe()
os.dup2(writer, 2)
os.close(reader)
with exr._library_messages():
    os.write(2, b"printed by another thread\\n")
exr.read_exr({str(path)!r})
"""
    assert run_without((), run) == 0
