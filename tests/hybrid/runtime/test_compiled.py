"""Compiled loops: kept where they can be, done without where they cannot, made again where they are damaged."""

import os
import subprocess
import sys
import tempfile
from collections.abc import Iterator
from pathlib import Path

import pytest

ROOT = Path(__file__).parents[3]
NOBODY = 65534
LOOP = """
from numba import njit

@njit(cache=True)
def twice(x):
    return 2 * x
"""
RUN = """
import os, sys, tempfile
if "NO_TEMPORARY_FILES" in os.environ:
    tempfile.tempdir = "/nonexistent"
from hybrid.runtime.threads import CACHE_LOCATORS
from hybrid.commands.log import start_log
start_log()
os.environ["NUMBA_CACHE_LOCATOR_CLASSES"] = CACHE_LOCATORS
import numba, hybrid.runtime.compiled
numba.njit(lambda x: 2 * x)(1)  # all that compiling needs is loaded
if os.geteuid() == 0:  # who may write anywhere
    os.setegid(int(sys.argv[2]))
    os.seteuid(int(sys.argv[2]))
sys.path.insert(0, sys.argv[1])
import loop
print(loop.twice(21), loop.twice._cache.cache_path, sum(loop.twice.stats.cache_hits.values()))
"""


def run(folder: Path, **environment: str) -> tuple[str, Path, int, str]:
    """Run a loop of an installation that nobody but root may write to; its result, folder, and what was found there."""
    env = {"PATH": os.environ["PATH"], "PYTHONPATH": os.pathsep.join([str(ROOT), *sys.path]), **environment}
    words = [sys.executable, "-B", "-c", RUN, str(folder), str(NOBODY)]
    done = subprocess.run(words, env=env, capture_output=True, text=True, check=False)
    assert done.returncode == 0, done.stderr
    value, path, found = done.stdout.split()
    return value, Path(path), int(found), done.stderr


@pytest.fixture
def shared() -> Iterator[Path]:
    """A folder that every user may enter, unlike pytest's, which another run of pytest closes again."""
    with tempfile.TemporaryDirectory() as name:
        Path(name).chmod(0o777)
        yield Path(name)


@pytest.fixture
def installed(shared: Path) -> Iterator[Path]:
    """A folder with a loop in it, read-only as an installation of root's is to a farm's user."""
    folder = shared / "installed"
    folder.mkdir()
    (folder / "loop.py").write_text(LOOP)
    folder.chmod(0o555)
    yield folder
    folder.chmod(0o755)


@pytest.fixture
def temporary(shared: Path) -> Path:
    """A folder for temporary files that everybody may write to."""
    folder = shared / "tmp"
    folder.mkdir()
    folder.chmod(0o777)
    return folder


@pytest.mark.posix
def test_where_neither_home_nor_installation_can_be_written_to_loops_are_kept_among_temporary_files(
    installed, temporary
):
    """Every command ended in a traceback: cannot cache function."""
    home = {"HOME": "/nonexistent", "TMPDIR": str(temporary)}
    value, path, found, said = run(installed, **home)
    assert (value, found) == ("42", 0)
    assert path.is_relative_to(temporary)
    assert said.count("compiled loops are kept in") == 1
    assert path.parent.stat().st_mode & 0o077 == 0
    assert run(installed, **home)[2] == 1  # the next run has it


@pytest.mark.posix
def test_where_nothing_can_be_written_to_loops_are_compiled_in_each_run(installed):
    value, _, found, said = run(installed, HOME="/nonexistent", NO_TEMPORARY_FILES="1")
    assert (value, found) == ("42", 0)
    assert said.count("cannot be kept anywhere") == 1


@pytest.mark.posix
def test_a_folder_that_somebody_else_has_made_is_not_trusted(installed, temporary):
    """Files in it are run."""
    user = NOBODY if os.geteuid() == 0 else os.geteuid()
    planted = temporary / f"ravg-compiled-{user}"
    planted.mkdir()
    planted.chmod(0o777)
    path = run(installed, HOME="/nonexistent", TMPDIR=str(temporary))[1]
    assert not path.is_relative_to(planted)
    assert not path.exists()  # it was this run's own, and is gone


@pytest.mark.posix
def test_a_damaged_file_is_made_again(shared):
    """A process killed on a full disk left half a file, and all later ones a traceback."""
    (shared / "loop.py").write_text(LOOP)
    home = {"NUMBA_CACHE_DIR": str(shared / "kept")}
    assert run(shared, **home)[2] == 0
    for kind, share in (("nbi", 0), ("nbi", 0.99), ("nbc", 0.5)):
        (file,) = (shared / "kept").rglob(f"*.{kind}")
        data = file.read_bytes()
        file.write_bytes(data[: int(share * len(data))])
        value, _, found, _ = run(shared, **home)
        assert (value, found) == ("42", 0)
    assert run(shared, **home)[2] == 1


USES = """
from numba import njit
from limits import LIMIT
from halves import half

@njit(cache=True)
def twice(x):
    return min(half(4 * x), LIMIT)
"""
HALVES = """
from numba import njit
from limits import DIVISOR

@njit
def half(x):
    return x // DIVISOR + {more}
"""


def test_a_loop_is_compiled_again_when_a_constant_or_function_of_another_module_changes(shared):
    """A pull into an editable clone left half of the loops with the old limit: 0.9 dB lost on one shot."""
    home = {"NUMBA_CACHE_DIR": str(shared / "kept")}
    (shared / "loop.py").write_text(USES)

    def result(limit: int, divisor: int, more: int) -> tuple[str, int]:
        """The value, and the number of loops found in the cache."""
        (shared / "limits.py").write_text(f"LIMIT = {limit}\nDIVISOR = {divisor}\n")
        (shared / "halves.py").write_text(HALVES.format(more=more))
        value, _, found, _ = run(shared, **home)
        return value, found

    assert [result(99, 2, 0) for _ in range(2)] == [("42", 0), ("42", 1)]
    assert result(9, 2, 0) == ("9", 0)  # a constant of the loop
    assert result(99, 4, 0) == ("21", 0)  # a constant of a function that it calls
    assert [result(99, 2, 5) for _ in range(2)] == [("47", 0), ("47", 1)]  # that function


SLOW = """
from numba import njit

@njit(cache=True)
def twice(x):
    total = 0
    for a in range(x):
        for b in range(a, x):
            total += (a * b + x) % (b + 1) - (a * b + x) % (b + 1)
    return 2 * x + total
"""
TOGETHER = """
import sys
from hybrid.runtime.threads import prepare_libraries
prepare_libraries()
from numba.core import event
import hybrid.runtime.compiled
sys.path.insert(0, sys.argv[1])
import loop

print("ready", flush=True)
sys.stdin.readline()
with event.install_recorder("numba:compile") as compiled:
    value = loop.twice(21)
print(value, sum(each.is_start for _, each in compiled.buffer))
"""


def test_of_processes_that_need_a_loop_one_compiles_it(shared):
    """A second frame of a farm, started at the same time, compiled all loops again."""
    (shared / "loop.py").write_text(SLOW)
    env = {**os.environ, "NUMBA_CACHE_DIR": str(shared / "kept")}
    words = [sys.executable, "-c", TOGETHER, str(shared)]
    pipes = {"stdin": subprocess.PIPE, "stdout": subprocess.PIPE, "text": True}
    runs = [subprocess.Popen(words, env=env, cwd=ROOT, **pipes) for _ in range(3)]
    for one in runs:
        assert one.stdout.readline() == "ready\n"
    for one in runs:
        one.stdin.write("\n")
        one.stdin.flush()
    said = [one.communicate()[0].split() for one in runs]
    assert sorted(said) == [["42", "0"], ["42", "0"], ["42", "1"]]


LOCKED = """
import sys
from pathlib import Path
from hybrid.runtime.threads import prepare_libraries
prepare_libraries()
import hybrid.runtime.compiled as compiled
from filelock import FileLock
sys.path.insert(0, sys.argv[1])
import loop

kept = loop.twice._cache
Path(kept.cache_path).mkdir(parents=True, exist_ok=True)
compiled.PATIENCE = 0.1
lock = FileLock(Path(kept.cache_path, f"{kept._impl.filename_base}.lock"), timeout=0)
with lock:
    print(compiled.is_compiled_elsewhere(loop.twice), loop.twice(21))
print(compiled.is_compiled_elsewhere(loop.twice), loop.twice(10.5))
with lock:  # it was released
    print("free")
"""


def test_a_loop_that_is_compiled_elsewhere_for_too_long_is_compiled_here(shared):
    (shared / "loop.py").write_text(LOOP)
    env = {**os.environ, "NUMBA_CACHE_DIR": str(shared / "kept")}
    words = [sys.executable, "-c", LOCKED, str(shared)]
    done = subprocess.run(words, env=env, cwd=ROOT, capture_output=True, text=True, check=True)
    assert done.stdout.split() == ["True", "42", "False", "21.0", "free"]
