"""What `reliability.py` and `attacks.py` try things with: the command in processes of its own, and made-up shots.

Which packages are tried is said by the variable RAVG_UNDER_TEST: those of this checkout without.
"""

from __future__ import annotations

import argparse
import contextlib
import importlib
import json
import os
import pkgutil
import resource
import signal
import subprocess
import sys
import tempfile
import time
from collections.abc import Callable, Iterator, Mapping, Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import cv2
import numpy as np
import OpenEXR

HERE = Path(__file__).resolve().parent.parent
PACKAGES = Path(os.environ.get("RAVG_UNDER_TEST", HERE))
OURS = tuple(name for name in ("loops", "flow", "nlm", "network", "hybrid") if (PACKAGES / name).is_dir())
Layers = dict[str, np.ndarray]
Edit = Callable[[int, Layers], None]
# Makes what it needs in a folder of its own; None where all is as promised, else what is not.
Case = Callable[[Path], str | None]
Cases = Iterator[tuple[str, Case]]
Rows = Mapping[int, tuple[str, Callable[[], Cases]]]
SIZE = 32, 48
DRAFT = "--preset", "draft"
# What the packages under test call this: they had other names before `hybrid.files` was a package.
ON, OFF, STANDARD = (
    ("--stages", "--no-stages", "standard")
    if (PACKAGES / "hybrid" / "files").is_dir()
    else ("--effects", "--no-effects", "balanced")
)


class UntriedError(Exception):
    """This machine cannot try it."""


# --- running the command


@dataclass(frozen=True)
class Done:
    """How a command ended, and what it said."""

    code: int
    said: str

    @property
    def words(self) -> str:
        """What it said in one line, without what tables and boxes are drawn with."""
        return " ".join("".join(" " if "\u2500" <= sign <= "\u257f" else sign for sign in self.said).split())

    @property
    def refused(self) -> str | None:
        """None where it ended with an error in one line."""
        if self.code not in (1, 2):
            return f"exit code {self.code}: {self.said[-200:]}"
        if "Traceback" in self.said:
            return f"traceback: {self.said.strip().splitlines()[-1][:200]}"
        longest = max(map(len, self.said.splitlines() or [""]))
        return f"a line of {longest} characters" if longest > 2500 else None

    @property
    def failed(self) -> str | None:
        """None where it ended with 0."""
        return None if self.code == 0 else f"exit code {self.code}: {self.said.strip()[-300:]}"


def ravg(*words: object, seconds: float = 120, memory: int = 6 * 2**30, folder: Path | None = None) -> Done:
    """Run the command in a process of its own, forked, so that nothing has to be imported again; at most so long."""
    with tempfile.TemporaryFile() as said:
        child = os.fork()
        if child == 0:
            _be_command([str(word) for word in words], said.fileno(), memory, folder)
        code = _wait(child, seconds)
        said.seek(0)
        return Done(code, said.read().decode("utf-8", "replace"))


def _be_command(words: list[str], said: int, memory: int, folder: Path | None) -> None:
    code = 70
    try:
        for descriptor in (1, 2):
            os.dup2(said, descriptor)
        sys.stdout, sys.stderr = (os.fdopen(d, "w", encoding="utf-8", buffering=1, closefd=False) for d in (1, 2))
        if folder is not None:
            os.chdir(folder)
        used = int(Path("/proc/self/statm").read_text().split()[0]) * resource.getpagesize()
        resource.setrlimit(resource.RLIMIT_AS, (used + memory, used + memory))
        from hybrid.cli import main

        code = main(words)
    except BaseException:
        import traceback

        traceback.print_exc()
    finally:
        sys.stdout.flush()
        os._exit(code)


def _wait(child: int, seconds: float) -> int:
    """The exit code of a process; -9 where it hangs."""
    end = time.monotonic() + seconds
    while time.monotonic() < end:
        pid, status = os.waitpid(child, os.WNOHANG)
        if pid:
            return os.waitstatus_to_exitcode(status)
        time.sleep(0.01)
    os.kill(child, signal.SIGKILL)
    os.waitpid(child, 0)
    return -9


def alone(
    script: str, *words: object, packages: Path = PACKAGES, folder: Path | None = None, **environment: str
) -> Done:
    """Run a script in a new interpreter."""
    command = [sys.executable, "-P", "-c", script, *map(str, words)]
    env = {**os.environ, "PYTHONPATH": str(packages), **environment}
    done = subprocess.run(command, env=env, capture_output=True, check=False, timeout=600, cwd=folder)
    return Done(done.returncode, (done.stdout + done.stderr).decode("utf-8", "replace"))


COMMAND = "import sys; from hybrid.cli import main; sys.exit(main(sys.argv[1:]))"


# --- made-up shots


def wall(index: int, size: tuple[int, int] = SIZE, step: tuple[int, int] = (0, 0)) -> Layers:
    """A textured wall in a soft light, with Cycles' names; it passes by `step` pixels right and down per frame."""
    rng = np.random.default_rng(7)
    height, width = size[0] + 160, size[1] + 160
    texture = cv2.resize(rng.uniform(0.2, 0.8, (height // 5, width // 5, 3)).astype(np.float32), (width, height))
    y, x = 80 - step[1] * index, 80 - step[0] * index
    block = slice(y, y + size[0]), slice(x, x + size[1])
    light = np.linspace(0.7, 1.5, width, dtype=np.float32)[None, :, None]
    vector = np.zeros((*size, 4), np.float32)
    vector[:] = -step[0], step[1], -step[0], step[1]
    return {
        "ViewLayer.Combined": (texture * light)[block].copy(),
        "ViewLayer.Denoising Albedo": texture[block].copy(),
        "ViewLayer.Denoising Normal": np.broadcast_to(np.float32([0, 0, 1]), (*size, 3)).copy(),
        "ViewLayer.Vector": vector,
    }


def grained(picture: np.ndarray, seed: object, noise: float = 0.3) -> np.ndarray:
    """Unbiased noise, skewed as that of a path tracer."""
    grain = np.random.default_rng(seed).gamma(1 / noise**2, noise**2, (*picture.shape[:2], 1))  # type: ignore[arg-type]
    return np.asarray(picture * grain, np.float32)


def write(path: Path, layers: Layers, **header: object) -> Path:
    """A file of named layers."""
    path.parent.mkdir(parents=True, exist_ok=True)
    channels = {}
    for name, layer in layers.items():
        planes = layer[..., None] if layer.ndim == 2 else layer
        vector = name.endswith(("Normal", "Vector", "normal"))
        letters = "XYZW" if vector else "RGBA" if planes.shape[2] > 1 else "A" if name.endswith("Alpha") else "Z"
        for letter, plane in zip(letters, np.moveaxis(planes, 2, 0), strict=False):
            channels[f"{name}.{letter}" if name else letter] = np.ascontiguousarray(plane)
    header = {"compression": OpenEXR.ZIP_COMPRESSION, "type": OpenEXR.scanlineimage, **header}
    OpenEXR.File([OpenEXR.Part(header, channels, "")]).write(str(path))
    return path


def shot(
    folder: Path,
    frames: int = 6,
    edit: Edit | None = None,
    *,
    step: tuple[int, int] = (0, 0),
    size: tuple[int, int] = SIZE,
    noise: float = 0.3,
    name: str = "shot.{:04d}.exr",
    first: int = 1001,
    **header: object,
) -> Path:
    """A sequence; `edit` changes the layers of a frame before there is noise in the color, which 0 leaves out."""
    for index in range(frames):
        layers = wall(index, size, step)
        if edit is not None:
            edit(index, layers)
        for layer in layers if noise else ():
            if layer.endswith("Combined"):
                layers[layer][..., :3] = grained(layers[layer][..., :3], (3, index), noise)
        if late := layers.pop("late", None):  # what comes after the noise
            late(layers)  # type: ignore[operator]
        write(folder / name.format(first + index), layers, **header)
    return folder


def blurred(folder: Path, source: Path) -> Path:
    """What a cheap denoiser of single frames makes of a shot."""
    for path in sorted(source.glob("*.exr")):
        layers = wall(0)
        found = read(path)
        color = np.stack([found[f"ViewLayer.Combined.{c}"] for c in "RGB"], axis=-1)
        layers["ViewLayer.Combined"] = cv2.GaussianBlur(color, (0, 0), 1.5)
        write(folder / path.name, layers)
    return folder


def read(path: Path) -> Layers:
    """Channel → pixels."""
    return {
        name: channel.pixels
        for part in OpenEXR.File(str(path), separate_channels=True).parts
        for name, channel in part.channels.items()
    }


def header(path: Path) -> dict[str, Any]:
    return dict(OpenEXR.File(str(path), header_only=True).parts[0].header)


def color(path: Path, layer: str = "ViewLayer.Combined") -> np.ndarray:
    found = read(path)
    return np.stack([found[f"{layer}.{c}" if layer else c] for c in "RGB"], axis=-1).astype(np.float32)


def names(folder: Path) -> set[str]:
    return {path.name for path in folder.glob("*.exr")}


def differ(one: Path, other: Path, only: set[str] | None = None) -> str | None:
    """Say where two folders of frames do not hold the same pixels."""
    wanted = names(one) if only is None else only
    if not wanted or not wanted <= names(other):
        return f"frames {sorted(wanted)} are expected in both"
    for name in sorted(wanted):
        first, second = read(one / name), read(other / name)
        for channel in sorted(first.keys() | second.keys()):
            if channel not in first or channel not in second:
                return f"{name}: {channel} is in one alone"
            if not np.array_equal(first[channel], second[channel], equal_nan=True):
                most = float(np.nanmax(np.abs(first[channel].astype(float) - second[channel])))
                return f"{name}: {channel} differs by up to {most:.3g}"
    return None


def contents(*folders: Path) -> dict[Path, bytes]:
    """The bytes of every file there is."""
    files = (path for folder in folders for path in (folder.rglob("*") if folder.is_dir() else [folder]))
    return {path: path.read_bytes() for path in files if path.is_file()}


def first_of(*reasons: str | None) -> str | None:
    return next((reason for reason in reasons if reason), None)


# --- trying


def try_case(case: Case) -> str | None:
    """None where it holds, else what does not."""
    folder = Path(tempfile.mkdtemp(prefix="ravg-"))
    folder.chmod(0o755)
    try:
        return case(folder)
    except UntriedError:
        raise
    except Exception as error:  # what was expected is not even there
        return f"{type(error).__name__}: {error}"
    finally:
        subprocess.run(["rm", "-rf", str(folder)], check=False)


def try_rows(table: Rows, rows: Sequence[int]) -> dict[int, tuple[int, int]]:
    """Row → cases, and how many of them hold; what does not goes to standard error."""
    _import_all()
    _warm_up()
    counts = {}
    for row in rows:
        cases = holding = 0
        for name, case in table[row][1]():
            try:
                reason = try_case(case)
            except UntriedError as untried:
                print(f"{row}: {name}: not tried: {untried}", file=sys.stderr, flush=True)
                continue
            cases += 1
            holding += reason is None
            if reason is not None:
                print(f"{row}: {name}: {' '.join(reason.split())[:400]}", file=sys.stderr, flush=True)
        counts[row] = cases, holding
        print(f"row {row}: {holding} of {cases} hold", file=sys.stderr, flush=True)
    return counts


def _import_all() -> None:
    """Import what is tried, so that processes that are forked need not."""
    sys.path.insert(0, str(PACKAGES))
    # One thread, of a kind that a process may be forked from.
    os.environ |= {"NUMBA_NUM_THREADS": "1", "OMP_NUM_THREADS": "1", "NUMBA_THREADING_LAYER": "workqueue"}
    cv2.setNumThreads(1)
    for package in OURS:
        found = importlib.import_module(package)
        for module in pkgutil.walk_packages(found.__path__, f"{package}."):
            if "simulate" not in module.name:
                with contextlib.suppress(ImportError):
                    importlib.import_module(module.name)
    if not Path(sys.modules["hybrid"].__file__ or "").is_relative_to(PACKAGES):
        raise RuntimeError(f"hybrid is not that of {PACKAGES}")


def _warm_up() -> None:
    """Load the compiled loops here, once, and not in each process that is forked."""
    from hybrid.cli import main

    kept = [os.dup(descriptor) for descriptor in (1, 2)]
    with tempfile.TemporaryDirectory() as folder, open(os.devnull, "w") as nowhere:
        for descriptor in (1, 2):
            os.dup2(nowhere.fileno(), descriptor)
        for preset in ("draft", "final"):
            noisy = shot(Path(folder, "in"), 3, step=(2, 1))
            main(["pseudoref", str(noisy), "-o", str(Path(folder, preset)), "--preset", preset])
        for words in (["denoise", "--help"], ["inspect", str(noisy)]):
            main(words)
    for descriptor, original in zip((1, 2), kept, strict=True):
        os.dup2(original, descriptor)
        os.close(original)


def run(table: Rows, script: str, about: str, argv: Sequence[str] | None = None) -> int:
    """Run a script's rows as its arguments say, print the table, and tell by the exit code."""
    parser = argparse.ArgumentParser(description=about.split("\n")[0])
    parser.add_argument("--only", type=int, nargs="+", choices=table, default=list(table), metavar="ROW")
    parser.add_argument("--against", type=Path, metavar="CHECKOUT", help="of another revision")
    parser.add_argument("--json", type=Path, metavar="OUT", help="write the counts there too")
    options = parser.parse_args(argv)
    before: dict[int, tuple[int, int]] = {}
    if options.against is not None:
        with tempfile.NamedTemporaryFile(suffix=".json") as counts:
            words = [sys.executable, script, "--json", counts.name, "--only", *map(str, options.only)]
            environment = {**os.environ, "RAVG_UNDER_TEST": str(options.against.resolve()), "PYTHONPATH": ""}
            subprocess.run(words, env=environment, check=False, stdout=subprocess.DEVNULL)
            before = {int(row): tuple(count) for row, count in json.loads(Path(counts.name).read_text()).items()}
    now = try_rows(table, options.only)
    if options.json is not None:
        options.json.write_text(json.dumps(now))
    print("| promise | cases | held before | hold now |\n|---|---|---|---|")
    for row, (cases, holding) in now.items():
        print(f"| {row}. {table[row][0]} | {cases} | {before[row][1] if before else '–'} | {holding} |")
    sums = [sum(count[i] for count in counts.values()) for counts, i in ((now, 0), (before, 1), (now, 1))]
    print(f"| all | {sums[0]} | {sums[1] if before else '–'} | {sums[2]} |")
    return 0 if sums[0] == sums[2] else 1
