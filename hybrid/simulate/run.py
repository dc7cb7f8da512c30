"""`ravg simulate`: make shots with Cycles, in processes of their own, and go on where a killed run stopped.

Nothing here imports Blender, so that the command's help works without it.
"""

from __future__ import annotations

import json
import os
import re
import subprocess
import sys
import tempfile
import threading
import time
from collections import deque
from collections.abc import Sequence
from dataclasses import replace
from pathlib import Path
from queue import SimpleQueue
from typing import Any

from hybrid.files.replace import write_file
from hybrid.simulate.shot import FIXED, RANDOM, ShotSettings, parse_levels, spp_of

NO_BLENDER = (
    'Blender\'s Python module (bpy) is not installed in {python}: `pip install "bpy==5.0.1"` with Python 3.11, '
    "or name an interpreter that has it with --python"
)


class SimulationError(ChildProcessError):
    """A renderer that is missing, or that failed; one line that says which and why."""


def check_blender(python: str) -> None:
    """Raise SimulationError if `python` has no bpy; quick, as bpy itself is not loaded."""
    look = "import importlib.util as u, sys; sys.exit(0 if u.find_spec('bpy') else 3)"
    try:
        found = subprocess.run([python, "-c", look], check=False).returncode
    except OSError as error:
        raise SimulationError(f"python: cannot run {python}: {error.strerror}") from error
    if found != 0:
        raise SimulationError(NO_BLENDER.format(python=python))


def simulate(
    shots: Sequence[tuple[ShotSettings, Path]],
    *,
    jobs: int = 1,
    threads: int | None = None,
    python: str | None = None,
    on_event: Any = None,
) -> None:
    """Render shots, each into a folder of its own.

    Parameters
    ----------
    shots : sequence of (ShotSettings, Path)
        Settings and folder of each. A folder holds `LEVEL.####.exr` and `meta.json`; frames that are there are left
        alone, and a folder made with other settings is refused.
    jobs : int
        Blender processes at a time. When there are fewer shots than jobs, the frames of a shot are shared out.
    threads : int, optional
        Of each process; None divides the machine's cores between the jobs.
    python : str, optional
        An interpreter that has bpy; None: this one.
    on_event : callable
        Called as `on_event(kind, shot folder, message)`, kind being `plan` or `frame`.

    Raises
    ------
    SimulationError
        bpy is missing, or Blender failed.
    ValueError
        A folder holds a shot with other settings.
    """
    python = python or sys.executable
    check_blender(python)
    threads = threads or max((os.cpu_count() or 1) // jobs, 1)
    waiting: deque[tuple[ShotSettings, Path, list[int]]] = deque()
    metas: dict[Path, dict[str, Any]] = {}
    parts = -(-jobs // len(shots)) if shots else 1
    for shot, out in shots:
        metas[out] = read_meta(shot, out)
        out.mkdir(parents=True, exist_ok=True)
        left = [frame for frame in shot.frames if missing(shot, out, frame)]
        for part in range(min(parts, len(left))):
            waiting.append((shot, out, left[part::parts]))
    running: list[_Worker] = []
    try:
        while waiting or running:
            for _ in range(len(waiting)):
                if len(running) >= jobs:
                    break
                shot, out, frames = waiting.popleft()
                plan = metas[out].get("plan")
                if plan is None and any(worker.out == out for worker in running):
                    waiting.append((shot, out, frames))  # someone is planning this shot
                    continue
                running.append(_Worker(shot, out, frames, plan, threads, python))
            for worker in list(running):
                ended = worker.ended()  # asked first, so that nothing said before the end is missed
                for message in worker.messages():
                    if "plan" in message:
                        metas[worker.out]["plan"] = message["plan"]
                    else:
                        metas[worker.out]["seconds"][message["file"]] = message["seconds"]
                    _write_meta(metas[worker.out], worker.out)
                    if on_event is not None:
                        on_event("plan" if "plan" in message else "frame", worker.out, message)
                if ended:
                    running.remove(worker)
                    worker.close()
            time.sleep(0.05)
    finally:
        for worker in running:
            worker.stop()


def missing(shot: ShotSettings, out: Path, frame: int) -> int:
    """Return how many samples per pixel of a frame are still to be rendered.

    Parameters
    ----------
    shot : ShotSettings
        What is asked for.
    out : Path
        Folder of the shot.
    frame : int
        Its number.

    Returns
    -------
    int
    """
    return sum(spp for name, spp in shot.pictures(frame).items() if not (out / f"{name}.{frame:04d}.exr").exists())


def read_meta(shot: ShotSettings, out: Path) -> dict[str, Any]:
    """Read what a folder says of the shot in it.

    Parameters
    ----------
    shot : ShotSettings
        What is asked for.
    out : Path
        The folder, which need not exist.

    Returns
    -------
    dict
        "shot", the settings as asked for; "seconds" by picture, and "plan" where there is one.

    Raises
    ------
    ValueError
        If the folder holds a shot with other settings, or its `meta.json` is not one.
    """
    path = out / "meta.json"
    asked = json.loads(json.dumps(shot.to_json()))
    if not path.exists():
        return {"shot": asked, "seconds": {}}
    try:
        meta: dict[str, Any] = json.loads(path.read_text(encoding="utf-8"))
        there = meta["shot"]
    except (ValueError, KeyError, TypeError, RecursionError) as error:
        raise ValueError(f"{path}: expected what ravg simulate writes, got {error!r}") from error
    for name, value in asked.items():
        # More frames may be asked for; the ones there were rendered with the plan that is there.
        if name != "frames" and there.get(name) != value:
            raise ValueError(f"{out}: holds a shot with {name} {there.get(name)!r}, expected {value!r}")
    if there["frames"] != asked["frames"] and shot.scene in RANDOM:
        raise ValueError(f"{out}: holds a random shot of other frames; its motion is drawn for them")
    return {**meta, "shot": asked}


def _write_meta(meta: dict[str, Any], out: Path) -> None:
    write_file(out / "meta.json", json.dumps(meta, indent=1, ensure_ascii=False) + "\n")


class _Worker:
    """A Blender process, what it has said, and its end."""

    def __init__(self, shot: ShotSettings, out: Path, frames: list[int], plan: Any, threads: int, python: str) -> None:
        self.out = out
        self._folder = tempfile.TemporaryDirectory(prefix="ravg-")
        job, log = Path(self._folder.name) / "job.json", Path(self._folder.name) / "log"
        data = {
            "shot": shot.to_json(),
            "out": str(out.resolve()),
            "frames": frames,
            "plan": plan,
            "threads": threads,
        }
        job.write_text(json.dumps(data), encoding="utf-8")
        self._log = log
        package = str(Path(__file__).parents[2])
        path = os.pathsep.join(filter(None, [package, os.environ.get("PYTHONPATH")]))
        with log.open("wb") as errors:
            self._process = subprocess.Popen(
                [python, "-m", "hybrid.simulate.cycles", str(job)],
                stdout=subprocess.PIPE,
                stderr=errors,
                env={**os.environ, "PYTHONPATH": path},
            )
        if self._process.stdout is None:
            raise SimulationError("Blender: its output cannot be read")
        self._pipe = self._process.stdout
        # A thread reads, as Python before 3.12 has no reading without waiting on Windows.
        self._lines: SimpleQueue[bytes] = SimpleQueue()
        self._reader = threading.Thread(target=self._read, daemon=True)
        self._reader.start()

    def _read(self) -> None:
        for line in self._pipe:
            self._lines.put(line)

    def messages(self) -> list[dict[str, Any]]:
        """Return what came since the last call."""
        if self.ended():
            self._reader.join(5)  # seconds; it reads to the end of the pipe
        lines = [self._lines.get() for _ in range(self._lines.qsize())]
        return [json.loads(line) for line in lines if line.startswith(b"{") and line.endswith(b"\n")]

    def ended(self) -> bool:
        """Return whether the process has ended."""
        return self._process.poll() is not None

    def close(self) -> None:
        """Clear up after the process; raise if it ended badly."""
        self._pipe.close()
        lines = [line for line in self._log.read_text(encoding="utf-8", errors="replace").splitlines() if line.strip()]
        self._folder.cleanup()
        if self._process.returncode != 0:
            last = lines[-1].strip() if lines else "no word"
            raise SimulationError(f"{self.out}: Blender ended with {self._process.returncode}: {last}")

    def stop(self) -> None:
        """End the process; what it was rendering is lost, what is finished stays."""
        self._process.terminate()
        try:
            self._process.wait(5)
        except subprocess.TimeoutExpired:
            self._process.kill()
            self._process.wait()
        self._reader.join(5)
        self._pipe.close()
        for partial in self.out.glob(f".{self._process.pid}-*"):
            partial.unlink()
        self._folder.cleanup()


def shots_of(
    scene: str, out: Path, count: int, spp: str, levels: str, first: ShotSettings
) -> list[tuple[ShotSettings, Path]]:
    """Return `count` shots with seeds that count up from that of `first`, and their folders.

    One shot goes into `out` itself, several into `out/SCENE_SEED`; those of `validation` and `test` into `out/NAME`.
    Samples given as a range are drawn per shot.

    Parameters
    ----------
    scene : str
        Its name, or the path of a .blend file.
    out : Path
        Where the shots go.
    count : int
        How many.
    spp : str
        Samples per pixel, or LOW-HIGH.
    levels : str
        NAME=SAMPLES,…, where there are several.
    first : ShotSettings
        Of the first shot.

    Returns
    -------
    list of (ShotSettings, Path)
    """
    if count < 1:
        raise ValueError(f"shots: got {count}, expected at least 1")
    kind, _, name = scene.partition(":")
    if kind in FIXED:
        if count > 1:
            raise ValueError(f"shots: got {count}, expected 1, as the {kind} shots are fixed")
        chosen = parse_levels(levels, spp_of(spp, first.seed))
        if name:
            return [(replace(first, levels=chosen), out)]
        return [(replace(first, scene=f"{kind}:{name}", levels=chosen), out / name) for name in FIXED[kind]]
    shots = []
    for seed in range(first.seed, first.seed + count):
        shot = replace(first, seed=seed, levels=parse_levels(levels, spp_of(spp, seed)))
        shots.append((shot, out if count == 1 else out / f"{Path(scene).stem}_{seed:04d}"))
    return shots


def parse_size(text: str, name: str) -> tuple[int, int]:
    """Read `WIDTHxHEIGHT`.

    Parameters
    ----------
    text : str
        What was given.
    name : str
        Of the option, for the error.

    Returns
    -------
    (int, int)
        Pixels across and down.
    """
    match = re.fullmatch(r"(\d+)x(\d+)", text)
    if match is None:
        raise ValueError(f"{name}: got {text!r}, expected WIDTHxHEIGHT")
    return int(match[1]), int(match[2])


def parse_center(text: str) -> tuple[float, float]:
    """Read `X,Y`, fractions of the camera's picture."""
    match = re.fullmatch(r"([01]?\.?\d+),([01]?\.?\d+)", text)
    if match is None or max(where := (float(match[1]), float(match[2]))) > 1:
        raise ValueError(f"center: got {text!r}, expected X,Y, both from 0 to 1")
    return where


def parse_numbers(text: str) -> tuple[int, ...]:
    """Read `1,4,7`, frames named one by one."""
    if re.fullmatch(r"\d+(,\d+)*", text) is None:
        raise ValueError(f"reference frames: got {text!r}, expected numbers with commas between")
    return tuple(map(int, text.split(",")))
