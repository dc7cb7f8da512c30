"""Kill, stop, starve and double the command at random moments: nothing is lost, and --resume gives the same bytes.

    python benchmarks/kill_runs.py [--kills 50] [--seed 0] [--command denoise] [--json OUT]

A small shot is denoised by processes that are killed (SIGKILL) after a random share of the time a run takes, always
with --resume into the same folder; whenever a run gets to its end, the next folder is begun. After each kill every
frame that is there must be that of an undisturbed run, to the byte, and the input what it was. Then: Ctrl-C, no space,
a folder that may not be written to, and two runs at once into one folder.
"""

from __future__ import annotations

import argparse
import json
import os
import random
import re
import resource
import shutil
import signal
import subprocess
import sys
import tempfile
import time
import traceback
from collections.abc import Callable, Iterator
from contextlib import contextmanager
from pathlib import Path

# Processes are forked from one that has loaded everything, which OpenMP's threads would not survive.
os.environ.update(NUMBA_THREADING_LAYER="workqueue", NUMBA_NUM_THREADS="1", OMP_NUM_THREADS="1", MKL_NUM_THREADS="1")

import cv2
import numpy as np

sys.path.insert(0, str(Path(__file__).resolve().parent.parent))

from hybrid.cli import main as ravg
from hybrid.records import FOLDER
from tests.exr_files import write_layers

FRAMES = 6
NOBODY = 65534
FULL = 40_000  # bytes that a file may have, where space is to be short: less than a frame


def write_shot(folder: Path) -> None:
    """A few small frames of a picture that moves."""
    rng = np.random.default_rng(0)
    wall = rng.uniform(0.2, 0.8, (80, 120, 3)).astype(np.float32)
    folder.mkdir()
    for index in range(FRAMES):
        albedo = wall[index : index + 64, 2 * index : 2 * index + 96]
        vector = np.empty((64, 96, 4), np.float32)
        vector[:] = 2, -1, 2, -1
        noise = rng.gamma(8, 1 / 8, (64, 96, 1)).astype(np.float32)
        layers = {"color": albedo * noise, "albedo": albedo, "vector": vector}
        write_layers(folder / f"shot.{index + 1:04d}.exr", layers, half=False)


class Bench:
    """A shot, the command to run on it, and what it gives undisturbed."""

    def __init__(self, folder: Path, command: str) -> None:
        self.folder, self.words = folder, command.split()
        self.shot = folder / "shot"
        write_shot(self.shot)
        self.given = contents(self.shot)
        with quiet():  # loads and compiles all code
            code = ravg(self.arguments(folder / "whole"))
        if code != 0:
            raise RuntimeError(f"the undisturbed run ended with {code}")
        start = time.monotonic()
        self.wait(self.start(folder / "again"))
        self.seconds = time.monotonic() - start
        self.expected = frames(folder / "whole")
        self.problems: list[str] = []
        if frames(folder / "again") != self.expected:
            self.problems.append("two undisturbed runs differ")

    def arguments(self, output: Path, *more: str) -> list[str]:
        """The command line."""
        return [*self.words, str(self.shot), "-o", str(output), *more]

    def start(
        self, output: Path, *more: str, before: Callable[[], None] | None = None, said: Path | None = None
    ) -> int:
        """Fork a run; return its process."""
        child = os.fork()
        if child == 0:
            sink = os.open(said or os.devnull, os.O_WRONLY | os.O_CREAT | os.O_TRUNC)
            os.dup2(sink, 1)
            os.dup2(sink, 2)
            code = 99
            try:
                if before is not None:
                    before()
                code = ravg(self.arguments(output, *more))
            except KeyboardInterrupt:  # before the command was there to take it
                code = 130
            except BaseException:
                traceback.print_exc()
            finally:
                os._exit(code)
        return child

    def wait(self, child: int) -> int:
        """Exit code of a run, negative if it was killed."""
        return os.waitstatus_to_exitcode(os.waitpid(child, 0)[1])

    def check(self, what: str, output: Path, *, complete: bool = False, tidy: bool = False) -> None:
        """Note what is wrong with the folder after something has happened."""
        there = frames(output)
        if any(there[name] != self.expected[name] for name in there):
            self.problems.append(f"{what}: a frame differs")
        if complete and there.keys() != self.expected.keys():
            self.problems.append(f"{what}: frames are missing: {sorted(self.expected.keys() - there.keys())}")
        if tidy and (left := [path.name for path in output.glob(".*")]):
            self.problems.append(f"{what}: left {left}")
        if contents(self.shot) != self.given:
            self.problems.append(f"{what}: the input has changed")


@contextmanager
def quiet() -> Iterator[None]:
    """Send this process's output nowhere."""
    kept = [os.dup(1), os.dup(2)]
    sink = os.open(os.devnull, os.O_WRONLY)
    try:
        os.dup2(sink, 1)
        os.dup2(sink, 2)
        yield
    finally:
        for number, copy in enumerate(kept, start=1):
            os.dup2(copy, number)


def contents(folder: Path) -> dict[str, bytes]:
    """Name → bytes of all files."""
    return {path.name: path.read_bytes() for path in folder.iterdir()}


def frames(folder: Path) -> dict[str, bytes]:
    """Name → bytes of the finished frames."""
    return {path.name: path.read_bytes() for path in folder.glob("[!.]*.exr")}


def kill_at_random(bench: Bench, kills: int, seed: int) -> int:
    """SIGKILL; count the runs that got to their end before it."""
    rng = random.Random(seed)
    ended, folder = 0, bench.folder / "killed.0"
    for number in range(kills):
        child = bench.start(folder, "--resume")
        time.sleep(rng.uniform(0, 1.1) * bench.seconds)
        os.kill(child, signal.SIGKILL)
        code = bench.wait(child)
        if folder.exists():
            bench.check(f"kill {number}", folder, complete=code == 0)
        if code == 0:
            ended += 1
            folder = bench.folder / f"killed.{ended}"
    if bench.wait(bench.start(folder, "--resume")) != 0:
        bench.problems.append("--resume after the kills failed")
    bench.check("--resume after the kills", folder, complete=True, tidy=True)
    return ended


def stop_at_random(bench: Bench, stops: int, seed: int) -> float:
    """Ctrl-C; return the longest time to the end, seconds."""
    rng, longest = random.Random(seed), 0.0
    said = bench.folder / "said"
    folder = bench.folder / "stopped"
    for number in range(stops):
        shutil.rmtree(folder, ignore_errors=True)
        child = bench.start(folder, said=said)
        time.sleep(rng.uniform(0.1, 0.9) * bench.seconds)
        start = time.monotonic()
        os.kill(child, signal.SIGINT)
        code = bench.wait(child)
        longest = max(longest, time.monotonic() - start)
        words = said.read_text(errors="replace")
        if folder.exists():
            bench.check(f"Ctrl-C {number}", folder, tidy=True)
        if code == 0:
            continue
        told = re.search(r"stopped: (\d) of 6 frames are finished", words)
        if code not in (130, 1) or "Traceback" in words:
            bench.problems.append(f"Ctrl-C {number}: exit code {code}: {words[-600:]}")
        elif told and int(told[1]) > (there := len(frames(folder)) if folder.exists() else 0):
            bench.problems.append(f"Ctrl-C {number}: told of {told[1]} frames, there are {there}")
    return longest


def starve(bench: Bench) -> None:
    """No space: files may not grow beyond a limit; and, where we may mount one, a disk that is full."""
    folder = bench.folder / "full"

    def limit() -> None:
        resource.setrlimit(resource.RLIMIT_FSIZE, (FULL, FULL))

    said = bench.folder / "said"
    code = bench.wait(bench.start(folder, before=limit, said=said))
    check_refused(bench, "no space", code, said, folder)
    disk = bench.folder / "disk"
    disk.mkdir()
    if subprocess.run(["mount", "-t", "tmpfs", "-o", "size=256k", "tmpfs", disk], capture_output=True).returncode == 0:
        try:
            code = bench.wait(bench.start(disk / "out", said=said))
            if code != 1:
                bench.problems.append(f"full disk: exit code {code}")
            bench.check("full disk", disk / "out", tidy=True)
        finally:
            subprocess.run(["umount", disk], check=True)


def forbid(bench: Bench) -> None:
    """A folder that may not be written to, and the shot's own folder."""
    folder, said = bench.folder / "locked", bench.folder / "said"
    folder.mkdir(mode=0o555)

    def nobody() -> None:
        if os.geteuid() == 0:  # who may write anywhere
            os.setegid(NOBODY)
            os.seteuid(NOBODY)

    bench.folder.chmod(0o755)
    code = bench.wait(bench.start(folder, before=nobody, said=said))
    check_refused(bench, "read-only folder", code, said, folder)
    code = bench.wait(bench.start(bench.shot, said=said))
    if code != 1 or "overwrite" not in said.read_text():
        bench.problems.append(f"output over input: exit code {code}")
    bench.check("output over input", bench.folder / "whole")


def check_refused(bench: Bench, what: str, code: int, said: Path, folder: Path) -> None:
    """Exit code 1, one line, nothing left but the record of it."""
    words = said.read_text(errors="replace")
    if code != 1 or "Traceback" in words or not words.rstrip().splitlines()[-1].startswith("error: "):
        bench.problems.append(f"{what}: exit code {code}: {words[-600:]}")
    if left := {path.name for pattern in ("*", ".*") for path in folder.glob(pattern)} - {FOLDER}:
        bench.problems.append(f"{what}: left {left}")


def run_twice_at_once(bench: Bench, times: int) -> None:
    """Two processes on the same shot and folder."""
    for number in range(times):
        folder = bench.folder / f"twice.{number}"
        children = [bench.start(folder), bench.start(folder)]
        codes = [bench.wait(child) for child in children]
        if codes != [0, 0]:
            bench.problems.append(f"two at once: exit codes {codes}")
        bench.check("two at once", folder, complete=True, tidy=True)


def main(argv: list[str] | None = None) -> int:
    parser = argparse.ArgumentParser(description=__doc__.split("\n")[0])
    parser.add_argument("--kills", type=int, default=50)
    parser.add_argument("--seed", type=int, default=0)
    parser.add_argument("--command", default="pseudoref --preset standard")
    parser.add_argument("--json", type=Path, help="write the result there too")
    options = parser.parse_args(argv)
    cv2.setNumThreads(0)
    if options.command.startswith("denoise"):
        import torch

        torch.set_num_threads(1)
    with tempfile.TemporaryDirectory() as name:
        bench = Bench(Path(name), options.command)
        ended = kill_at_random(bench, options.kills, options.seed)
        longest = stop_at_random(bench, max(options.kills // 5, 3), options.seed)
        starve(bench)
        forbid(bench)
        run_twice_at_once(bench, 3)
    result = {
        "command": options.command,
        "kills": options.kills,
        "runs_that_ended_before": ended,
        "stops": max(options.kills // 5, 3),
        "longest_stop_seconds": round(longest, 2),
        "problems": bench.problems,
    }
    print(json.dumps(result))
    if options.json is not None:
        options.json.write_text(json.dumps(result, indent=2) + "\n", encoding="utf-8")
    return 1 if bench.problems else 0


if __name__ == "__main__":
    sys.exit(main())
