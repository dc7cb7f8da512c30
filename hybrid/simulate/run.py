"""Run Blender processes that render shots with Cycles, and resume; without Blender, so that the help works."""

import json
import os
import re
import secrets
import subprocess
import sys
import tempfile
import time
from collections import deque
from collections.abc import Callable, Sequence
from pathlib import Path
from typing import Any

from hybrid.files.replace import write_file
from hybrid.simulate.shot import RANDOM, ShotSettings

NO_BLENDER = (
    'Blender\'s Python module (bpy) is not installed in {python}: `pip install "bpy==5.0.1"` with Python 3.11, '
    "or name an interpreter that has it with --python"
)


class SimulationError(ChildProcessError):
    """Blender is missing, or failed; one line that says why."""


def check_blender(python: str) -> None:
    """Raise SimulationError if `python` has no bpy, which is not loaded for this test."""
    find = "import importlib.util as u, sys; sys.exit(0 if u.find_spec('bpy') else 3)"
    try:
        found = subprocess.run([python, "-c", find], check=False).returncode
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
    """Render shots, each into a folder of its own, which holds `LEVEL.####.exr` and `meta.json`; skip finished frames.

    `jobs` is the number of Blender processes at a time, which divide the frames of few shots, and the machine's cores
    unless `threads` are given; `python` an interpreter that has bpy, by default this one. `on_event(kind, shot folder,
    message)` is called with the kinds `plan` and `frame`. Raises SimulationError if bpy is missing, or Blender failed;
    ValueError if a folder holds a shot with other settings.
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
        left = [frame for frame in shot.frames if samples_left(shot, out, frame)]
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
                    waiting.append((shot, out, frames))  # another process is planning this shot
                    continue
                running.append(_Worker(shot, out, frames, plan, threads, python))
            for worker in list(running):
                ended = worker.ended()  # before reading, so that no last message is missed
                for message in worker.messages():
                    if "plan" in message:
                        metas[worker.out]["plan"] = message["plan"]
                    else:
                        metas[worker.out]["seconds"][message["file"]] = message["seconds"]
                    meta = json.dumps(metas[worker.out], indent=1, ensure_ascii=False)
                    write_file(worker.out / "meta.json", f"{meta}\n")
                    if on_event is not None:
                        on_event("plan" if "plan" in message else "frame", worker.out, message)
                if ended:
                    running.remove(worker)
                    worker.close()
            time.sleep(0.05)
    finally:
        for worker in running:
            worker.stop()


def samples_left(shot: ShotSettings, out: Path, frame: int) -> int:
    """Return how many samples per pixel of a frame are still to be rendered, all levels together."""
    return sum(spp for name, spp in shot.renders(frame).items() if not (out / f"{name}.{frame:04d}.exr").exists())


def read_meta(shot: ShotSettings, out: Path) -> dict[str, Any]:
    """Read `meta.json` of a folder, which need not exist.

    Return "shot", the settings as asked for; "seconds" by render, and "plan" if the shot was planned. Raise ValueError
    if the folder holds a shot with other settings, or an invalid `meta.json`.
    """
    path = out / "meta.json"
    asked = json.loads(json.dumps(shot.to_json()))
    if not path.exists():
        return {"shot": asked, "seconds": {}}
    try:
        meta: dict[str, Any] = json.loads(path.read_text(encoding="utf-8"))
        there = meta["shot"]
        there.setdefault("moving_objects", there.pop("movers", None))  # the name until version 0.2
    except (AttributeError, ValueError, KeyError, TypeError, RecursionError) as error:
        raise ValueError(f"{path}: expected what ravg simulate writes, got {error!r}") from error
    for name, value in asked.items():
        # More frames may be asked for; the existing plan is kept.
        if name != "frames" and there.get(name) != value:
            raise ValueError(f"{out}: holds a shot with {name} {there.get(name)!r}, expected {value!r}")
    if there["frames"] != asked["frames"] and shot.scene in RANDOM:
        raise ValueError(f"{out}: holds a random shot of other frames; its motion is drawn for them")
    return {**meta, "shot": asked}


class _Worker:
    """A Blender process and its messages."""

    def __init__(self, shot: ShotSettings, out: Path, frames: list[int], plan: Any, threads: int, python: str) -> None:
        self.out = out
        self._folder = tempfile.TemporaryDirectory(prefix="ravg-")
        job, self._log, answers = (Path(self._folder.name) / name for name in ("job.json", "log", "answers"))
        # Not the number of the process: behind a launcher, as in an environment on Windows, the renderer has another.
        self._mark = secrets.token_hex(8)
        data = {"shot": shot.to_json(), "out": str(out.resolve()), "frames": frames, "plan": plan, "threads": threads}
        data["mark"] = self._mark
        job.write_text(json.dumps(data), encoding="utf-8")
        path = os.pathsep.join(filter(None, [str(Path(__file__).parents[2]), os.environ.get("PYTHONPATH")]))
        # Files rather than pipes: reading a file never blocks, on any system.
        with answers.open("wb") as output, self._log.open("wb") as errors:
            self._process = subprocess.Popen(
                [python, "-m", "hybrid.simulate.cycles", str(job)],
                stdin=subprocess.PIPE,  # which closes however this process ends: the renderer ends then
                stdout=output,
                stderr=errors,
                env={**os.environ, "PYTHONPATH": path},
            )
        self._answers = answers.open("rb")
        self._unread = b""

    def messages(self) -> list[dict[str, Any]]:
        *lines, self._unread = (self._unread + self._answers.read()).split(b"\n")
        return [json.loads(line) for line in lines if line.startswith(b"{")]

    def ended(self) -> bool:
        return self._process.poll() is not None

    def close(self) -> None:
        """Remove the process's files; raise SimulationError if it failed."""
        self._close()
        lines = [line for line in self._log.read_text(encoding="utf-8", errors="replace").splitlines() if line.strip()]
        self._folder.cleanup()
        if self._process.returncode != 0:
            last = lines[-1].strip() if lines else "no word"
            raise SimulationError(f"{self.out}: Blender ended with {self._process.returncode}: {last}")

    def _close(self) -> None:
        self._answers.close()
        assert self._process.stdin is not None
        self._process.stdin.close()

    def stop(self) -> None:
        """End the process and remove unfinished renders; finished ones stay."""
        self._process.terminate()
        try:
            self._process.wait(5)
        except subprocess.TimeoutExpired:
            self._process.kill()
            self._process.wait()
        self._close()
        for partial in self.out.glob(f".{self._mark}-*"):
            partial.unlink()
        self._folder.cleanup()


def shots_of(
    scene: str, out: Path, first_seed: int, count: int, settings: Callable[[str, int], ShotSettings]
) -> list[tuple[ShotSettings, Path]]:
    """Return `count` shots, made by `settings(scene, seed)` with seeds that count up, and their folders.

    One shot goes into `out` itself, several into `out/SCENE_SEED`.
    """
    seeds = range(first_seed, first_seed + count)
    return [(settings(scene, seed), out if count == 1 else out / f"{Path(scene).stem}_{seed:04d}") for seed in seeds]


def parse_size(text: str, name: str) -> tuple[int, int]:
    """Parse `WIDTHxHEIGHT` in pixels; `name` is the option's, for the error."""
    match = re.fullmatch(r"(\d+)x(\d+)", text)
    if match is None:
        raise ValueError(f"{name}: got {text!r}, expected WIDTHxHEIGHT")
    return int(match[1]), int(match[2])


def parse_center(text: str) -> tuple[float, float]:
    """Parse `X,Y`, fractions of the film."""
    match = re.fullmatch(r"([01]?\.?\d+),([01]?\.?\d+)", text)
    if match is None or max(where := (float(match[1]), float(match[2]))) > 1:
        raise ValueError(f"center: got {text!r}, expected X,Y, both from 0 to 1")
    return where
