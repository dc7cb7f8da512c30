"""Commands that are killed, stopped, starved and doubled at random moments: --resume gives the bytes of one run.

A few of them with the classical chain belong to the quick tests, the others to `pytest -m reliability`.
"""

import os
import random
import re
import signal
import subprocess
import tempfile
import time
from collections.abc import Callable, Iterator
from contextlib import suppress
from dataclasses import dataclass
from multiprocessing.process import BaseProcess
from pathlib import Path

import pytest

from hybrid.run.records import FOLDER
from loops import parallel
from tests.commands import Done, start
from tests.scenes import Scene
from tests.seldom import seldom

pytestmark = pytest.mark.posix
SCENE = Scene(height=64, width=96, frames=6)
STOPS = 10
NOBODY = 65534
FULL = 40_000  # bytes that a file may have, where space is to be short: less than a frame


def frames(folder: Path) -> dict[str, bytes]:
    """Name → bytes of the finished frames."""
    return {path.name: path.read_bytes() for path in folder.glob("[!.]*.exr")}


@dataclass
class Bench:
    """A shot, a command to run on it, and the frames of an undisturbed run."""

    folder: Path
    command: list[str]

    def __post_init__(self) -> None:
        self.shot, self.said = SCENE.write(self.folder / "shot"), self.folder / "said"
        self.given = frames(self.shot)
        for out in ("whole", "again"):
            begun = time.monotonic()
            self.run(self.folder / out).succeeds()
            self.seconds = time.monotonic() - begun
        self.expected = frames(self.folder / "whole")
        assert frames(self.folder / "again") == self.expected

    def start(self, output: Path, *more: str, before: Callable[[], None] | None = None):
        """Start a run; return its process."""
        return start(self.said, *self.command, self.shot, "-o", output, *more, before=before)

    def run(self, output: Path, *more: str, before: Callable[[], None] | None = None) -> Done:
        """Run to the end."""
        self.said.write_bytes(b"")
        process = self.start(output, *more, before=before)
        self.join(process)
        return Done(process.exitcode, self.said.read_text(errors="replace"))

    def join(self, *processes: BaseProcess) -> None:
        """Wait for processes; kill those that hang, which pytest would wait for at its end."""
        for process in processes:
            process.join(120)
            if process.exitcode is None:
                process.kill()
                process.join()

    def check(self, output: Path, *, complete: bool = False, tidy: bool = False) -> None:
        """Assert that every frame that is there is whole, and that the input is what it was."""
        there = frames(output)
        assert there.items() <= self.expected.items()
        assert not complete or there.keys() == self.expected.keys()
        assert not tidy or not list(output.glob(".*"))
        assert frames(self.shot) == self.given

    def check_refused(self, done: Done, output: Path) -> None:
        """Assert one line, and nothing left but the record of it."""
        assert done.is_refused().code == 1
        assert done.said.rstrip().splitlines()[-1].startswith("error: ")
        assert {path.name for pattern in ("*", ".*") for path in output.glob(pattern)} <= {FOLDER}


COMMANDS = [
    "denoise --preset standard",
    pytest.param("denoise --first-pass nlm", marks=[pytest.mark.reliability, pytest.mark.neural]),
]


@pytest.fixture(scope="module", params=COMMANDS)
def bench(request: pytest.FixtureRequest) -> Iterator[Bench]:
    """In a folder that every user may enter."""
    with tempfile.TemporaryDirectory(prefix="ravg-") as name:
        Path(name).chmod(0o755)
        yield Bench(Path(name), request.param.split())


@pytest.mark.parametrize("kills", [10, *seldom(50)])
def test_kills_at_random_moments_lose_nothing(bench, record_property, kills):
    """After each kill the frames that are there are those of an undisturbed run, to the byte."""
    rng = random.Random(0)
    ended, output = 0, bench.folder / f"killed.{kills}.0"
    for _ in range(kills):
        process = bench.start(output, "--resume")
        process.join(rng.uniform(0, 1.1) * bench.seconds)
        process.kill()
        process.join()
        bench.check(output, complete=process.exitcode == 0)
        if process.exitcode == 0:
            ended += 1
            output = bench.folder / f"killed.{kills}.{ended}"
    bench.run(output, "--resume").succeeds()
    bench.check(output, complete=True, tidy=True)
    assert ended < 0.8 * kills  # else nothing was tried
    record_property("cases", kills)


def test_a_kill_while_threads_start_does_not_block_the_next_run(bench):
    """Killed there, a process kept numba's lock for all others of a fork."""
    assert bench.run(bench.folder / "blocked", before=die_while_threads_start).code == -signal.SIGKILL
    bench.run(bench.folder / "blocked").succeeds()
    bench.check(bench.folder / "blocked", complete=True, tidy=True)


@pytest.mark.parametrize("number", [0, 1, *seldom(*range(2, STOPS))])
def test_a_stop_leaves_whole_frames_and_says_how_many(bench, number):
    output = bench.folder / f"stopped.{number}"
    bench.said.write_bytes(b"")
    process = bench.start(output)
    time.sleep(random.Random(number).uniform(0.1, 0.9) * bench.seconds)
    with suppress(ProcessLookupError):  # it has ended
        os.kill(process.pid, signal.SIGINT)
    process.join(30)
    bench.check(output, tidy=True)
    said = bench.said.read_text(errors="replace")
    assert process.exitcode in (0, 1, 130), said
    assert "Traceback" not in said
    if told := re.search(r"stopped: (\d) of 6 frames are finished", said):
        assert int(told[1]) <= len(frames(output))


def limit_files() -> None:
    import resource

    resource.setrlimit(resource.RLIMIT_FSIZE, (FULL, FULL))


def die_while_threads_start() -> None:
    parallel._count = 2
    parallel._threads = lambda: os.kill(os.getpid(), signal.SIGKILL)


def be_nobody() -> None:
    if os.geteuid() == 0:  # who may write anywhere
        os.setegid(NOBODY)
        os.seteuid(NOBODY)


def test_no_space_for_a_file(bench):
    bench.check_refused(bench.run(bench.folder / "full", before=limit_files), bench.folder / "full")


def test_a_disk_that_is_full(bench):
    disk = bench.folder / "disk"
    disk.mkdir()
    if subprocess.run(["mount", "-t", "tmpfs", "-o", "size=256k", "tmpfs", disk], capture_output=True).returncode:
        pytest.skip("needs to mount a disk")
    try:
        assert bench.run(disk / "out").is_refused().code == 1
        bench.check(disk / "out", tidy=True)
    finally:
        subprocess.run(["umount", disk], check=True)


def test_a_folder_that_may_not_be_written_to(bench):
    (bench.folder / "locked").mkdir(mode=0o555)
    bench.said.touch()
    bench.said.chmod(0o666)
    bench.check_refused(bench.run(bench.folder / "locked", before=be_nobody), bench.folder / "locked")


def test_an_output_over_its_input(bench):
    done = bench.run(bench.shot)
    assert done.code == 1
    assert "overwrite" in done.said
    bench.check(bench.folder / "whole")


def test_two_runs_at_once_into_one_folder(bench):
    output = bench.folder / "twice"
    processes = [bench.start(output), bench.start(output)]
    bench.join(*processes)
    assert [process.exitcode for process in processes] == [0, 0]
    bench.check(output, complete=True, tidy=True)
