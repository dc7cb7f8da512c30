"""Ctrl-C, and the end of standard input where a program asks for that."""

import os
import subprocess
import sys
from pathlib import Path

import pytest

ROOT = Path(__file__).parents[3]
BUSY = """
import hashlib, pathlib, sys
from hybrid.files.replace import replace_file
from hybrid.runtime.interrupt import interruptible, stop_with_stdin
stop_with_stdin()
try:
    with interruptible(lambda: print("2 of 5", flush=True)), replace_file(pathlib.Path(sys.argv[1])):
        print("begun", flush=True)
        hashlib.pbkdf2_hmac("sha256", b"", b"", int(sys.argv[2]))
except KeyboardInterrupt:
    sys.exit(130)
"""
MINUTE = 200_000_000  # rounds of a computation that sees no signal


def start(path: Path, rounds: int, **environment: str) -> subprocess.Popen[str]:
    words = [sys.executable, "-c", BUSY, str(path), str(rounds)]
    environment |= {"PYTHONPATH": os.pathsep.join([str(ROOT), *sys.path])}
    pipe = subprocess.PIPE
    child = subprocess.Popen(words, env={**os.environ, **environment}, stdin=pipe, stdout=pipe, text=True)
    assert child.stdout is not None
    assert child.stdout.readline() == "begun\n"
    return child


def test_the_end_of_standard_input_ends_a_long_computation(tmp_path):
    child = start(tmp_path / "frame.exr", MINUTE, RAVG_STOP_WITH_STDIN="1")
    said, _ = child.communicate(timeout=30)  # closes standard input
    assert child.returncode == 130
    assert said == "2 of 5\n"
    assert list(tmp_path.iterdir()) == []


@pytest.mark.posix
def test_other_signals_end_nothing():
    code = """
import os, signal, time
from hybrid.runtime.interrupt import PATIENCE, interruptible
signal.signal(signal.SIGCHLD, lambda *_: None)
with interruptible(lambda: print("interrupted", flush=True)):
    os.kill(os.getpid(), signal.SIGCHLD)
    time.sleep(2 * PATIENCE)
print("finished")
"""
    environment = {**os.environ, "PYTHONPATH": os.pathsep.join([str(ROOT), *sys.path])}
    run = subprocess.run([sys.executable, "-c", code], env=environment, capture_output=True, text=True, check=False)
    assert (run.returncode, run.stdout) == (0, "finished\n")


@pytest.mark.parametrize("asked", ["", "0"])
def test_the_end_of_standard_input_ends_nothing_unless_asked(tmp_path, asked):
    child = start(tmp_path / "frame.exr", 1, RAVG_STOP_WITH_STDIN=asked)
    said, _ = child.communicate(timeout=30)
    assert child.returncode == 0
    assert said == ""
    assert [path.name for path in tmp_path.iterdir()] == ["frame.exr"]


def test_the_command_ends_with_its_standard_input(tmp_path):
    """The viewer would wait for a browser for ever."""
    folder = ROOT / "examples" / "shot"
    words = [sys.executable, "-m", "hybrid.cli", "view", str(folder / "noisy.####.exr"), "--no-browser"]
    environment = {**os.environ, "RAVG_STOP_WITH_STDIN": "1", "PYTHONPATH": os.pathsep.join([str(ROOT), *sys.path])}
    pipe = subprocess.PIPE
    child = subprocess.Popen(words, env=environment, cwd=tmp_path, stdin=pipe, stdout=pipe, text=True)
    try:
        assert child.stdout is not None
        assert child.stdout.readline().startswith("http://")
        assert child.poll() is None
        child.communicate(timeout=30)
        assert child.returncode in (0, 130)  # as Ctrl-C ends the viewer, and the command before it serves
    finally:
        child.kill()


def test_what_the_process_starts_inherits_neither_variable_nor_standard_input():
    code = """
import os, subprocess, sys
from hybrid.runtime.interrupt import stop_with_stdin
stop_with_stdin()
child = "import os, sys; print(os.environ.get('RAVG_STOP_WITH_STDIN'), len(sys.stdin.read()), flush=True)"
subprocess.run([sys.executable, "-c", child], check=True)
"""
    environment = {**os.environ, "RAVG_STOP_WITH_STDIN": "1", "PYTHONPATH": os.pathsep.join([str(ROOT), *sys.path])}
    pipe = subprocess.PIPE
    with subprocess.Popen([sys.executable, "-c", code], env=environment, stdin=pipe, stdout=pipe, text=True) as process:
        assert process.stdout is not None
        assert process.stdout.readline().split() == ["None", "0"]  # standard input of the parent is open still
