"""A run makes what a fresh one would: rows 6, 7, 15, 16, 22, 23 and 24 of docs/dev/reliability.md."""

# ruff: noqa: E501 - tables of cases, one a line

import os
import re
import shutil
import socket
import subprocess
import sys
import threading
import time
from collections.abc import Callable, Sequence
from pathlib import Path

import numpy as np
import pytest

from tests.commands import ROOT, ravg, run_python
from tests.reliability.shots import (
    ALBEDO,
    DRAFT,
    RAW,
    SIZE,
    Edit,
    Layers,
    blurred,
    cases,
    difference,
    draft,
    exchange,
    names,
    no_leftovers,
    nothing,
    read_layers,
    render_again,
    same,
    shot,
    wall,
    weights,
    write,
)

pytestmark = [pytest.mark.reliability, pytest.mark.posix]


# --- 7: kept estimates are those that would be made


def kept(folder: Path, first: Sequence[str], then: Sequence[str], change: Callable[[Path], object] = nothing) -> None:
    """Assert that estimates that were kept never show in what would be made without."""
    shot(folder / "in", 4, step=(2, 1), **RAW)
    words = ["denoise", "in", *DRAFT]
    ravg(*words, "-o", "first", *first, "--keep-first-pass", "kept", folder=folder).succeeds()
    change(folder)
    if ravg(*words, "-o", "out", *then, "--keep-first-pass", "kept", folder=folder).ends("either").code == 0:
        ravg(*words, "-o", "fresh", *then, folder=folder).succeeds()
        same(folder / "fresh", folder / "out")


KEPT: dict[str, Callable[[Path], object]] = {
    "a frame of the same time and size": lambda f: render_again(f / "in/shot.1002.exr"),
    "a kept picture cut short": lambda f: os.truncate(f / "kept/shot.1002.exr", 2000),
    "a kept picture of another frame": lambda f: shutil.copy2(f / "kept/shot.1001.exr", f / "kept/shot.1002.exr"),
    "the output in its place": lambda f: shutil.copy2(f / "first/shot.1002.exr", f / "kept/shot.1002.exr"),
}
FAST = ["--first-pass", "oidn-fast"]


@pytest.mark.oidn
@cases(KEPT, "change")
def test_kept_estimates_after_a_change(folder, change):
    kept(folder, FAST, FAST, change)


# --- 6, 15: --resume makes again what would be another: with another file, option, profile, layer or weights

MINE = """
[layers]
color = ["Combined"]
albedo = ["Denoising Albedo"]
normal = ["Denoising Normal"]
motion = ["Vector"]
[motion]
direction = "both"
y = "up"
"""


def write_albedo(folder: Path, *, seed: int = 0) -> None:
    """A sequence that holds one layer, always of one time."""
    for index in range(6):
        found = wall(index, (2, 1))[ALBEDO]
        noise = np.random.default_rng((seed, index)).normal(0, 0.02 * bool(seed), found.shape)
        path = write(folder / f"{1001 + index:04d}.exr", {"": (found + noise).astype(np.float32)}, **RAW)
        os.utime(path, (1.7e9, 1.7e9))


def as_fresh(
    folder: Path,
    before: Sequence[object],
    after: Sequence[object],
    change: Callable[[Path], object],
    command: Sequence[object] = ("denoise", "in", *DRAFT),
    edit: Edit | None = None,
) -> None:
    """Assert that after a change --resume leaves the frames of a run into an empty folder."""
    blurred(folder / "single", shot(folder / "in", 6, edit, step=(2, 1), **RAW))
    write_albedo(folder / "albedo")
    (folder / "mine.toml").write_text(MINE)
    weights(folder, ROOT)
    ravg(*command, "-o", "out", *before, folder=folder).succeeds()
    change(folder)
    for out, more in (("out", ["--resume"]), ("fresh", [])):
        ravg(*command, "-o", out, *after, *more, folder=folder).succeeds()
    same(folder / "fresh", folder / "out")


def renumber(folder: Path) -> None:
    for path in sorted((folder / "in").iterdir(), reverse=True):
        path.rename(path.with_name(f"shot.{int(path.name[5:9]) + 1}.exr"))


Other = tuple[Sequence[str], Sequence[str], Callable[[Path], object]]
ELSEWHERE = ["--layer", "albedo=albedo/####.exr"]
PROFILE = ["--profile", "mine.toml"]
ESTIMATES = ["--first-pass", "single"]
OTHERS: dict[str, Other] = {
    "the last frame rendered again, of the same time": ([], [], lambda f: render_again(f / "in/shot.1006.exr")),
    "two frames swapped": ([], [], lambda f: exchange(f / "in/shot.1003.exr", f / "in/shot.1006.exr")),
    "noisy frames as estimates": (ESTIMATES, ESTIMATES, lambda f: [shutil.copy2(x, f / "single") for x in (f / "in").iterdir()]),
    "an empty output": ([], [], lambda f: os.truncate(f / "out/shot.1004.exr", 0)),
    "an output that is an input": ([], [], lambda f: shutil.copy2(f / "in/shot.1004.exr", f / "out")),
    "a layer left out": (ESTIMATES, [*ESTIMATES, "--layer", "normal=Denoising Albedo"], nothing),
    "a stage forced on": (ESTIMATES, [*ESTIMATES, "--stages", "refine"], nothing),
    "a stage forced off": (ESTIMATES, [*ESTIMATES, "--no-stages", "gate"], nothing),
    "another preset": (ESTIMATES, ["--preset", "final", "--first-pass", "none"], nothing),
    "no estimates": (ESTIMATES, ["--first-pass", "none"], nothing),
    "our own estimates": (ESTIMATES, ["--first-pass", "nlm"], nothing),
    "OIDN's estimates": (ESTIMATES, ["--first-pass", "oidn-fast"], nothing),
    "--motion next": ([], ["--motion", "next,y-up"], nothing),
    "--motion, another scale": (["--motion", "both,y-up"], ["--motion", "both,y-up,scale=2"], nothing),
    "a profile instead of none": ([], PROFILE, nothing),
    "a profile that was edited": (PROFILE, PROFILE, lambda f: (f / "mine.toml").write_text(MINE.replace('"up"', '"down"'))),
    "albedo from elsewhere": ([], ELSEWHERE, nothing),
    "albedo from elsewhere made again, at the same time": (ELSEWHERE, ELSEWHERE, lambda f: write_albedo(f / "albedo", seed=3)),
    "albedo from another sequence": (ELSEWHERE, ["--layer", "albedo=in/shot.####.exr:ViewLayer.Combined"], nothing),
    "a part of the frames first": (["--frames", "1002-1003"], [], nothing),
    "every second frame first": (["--frames", "1001-1005x2"], [], nothing),
    "with and without --max-memory": (["--max-memory", "4G"], [], nothing),
    "frames renumbered by one": ([], [], renumber),
    "a frame in the middle gone": ([], [], lambda f: (f / "in/shot.1003.exr").unlink()),
    "another compression, the same pixels": ([], [], lambda f: write(f / "in/shot.1002.exr", read_layers(f / "in/shot.1002.exr"))),
    "an output made read-only": ([], ["--no-stages", "gate"], lambda f: os.chmod(f / "out/shot.1002.exr", 0o444)),
}  # fmt: skip
NETWORK: dict[str, Other] = {
    "another precision": (["--precision", "bfloat16"], ["--precision", "float32"], nothing),
    "a layer denoised along": ([], ["--aov", ALBEDO], nothing),
    "two passes": ([], ["--passes", "2"], nothing),
    "two passes, and a frame rendered again": (["--passes", "2"], ["--passes", "2"], lambda f: render_again(f / "in/shot.1001.exr")),
    "two passes, and then one": (["--passes", "2"], [], nothing),
}  # fmt: skip


@cases(OTHERS)
def test_resume_with_something_else(folder, case):
    as_fresh(folder, *case)


@pytest.mark.neural
@cases(NETWORK)
def test_resume_of_the_network_with_something_else(folder, case):
    as_fresh(folder, *case, command=["denoise", "in", "--first-pass", "nlm", "--weights", "w.safetensors"])


@pytest.mark.neural
def test_resume_with_another_threshold(folder):
    as_fresh(folder, [], ["--threshold", "0.3"], nothing, command=["denoise", "in", "--weights", KERNELS])


KERNELS = ROOT / "tests" / "data" / "small.safetensors"


def two_layers(index: int, layers: Layers) -> None:
    layers |= {name.replace("ViewLayer", "Fog"): layer.copy() for name, layer in layers.items()}


LAYERED: dict[str, Other] = {
    "nothing changes": ([], [], nothing),
    "one is rendered again": ([], [], lambda f: render_again(f / "in/shot.1003.exr", layer="Fog.Combined")),
    "then one alone": ([], ["--layer", "color=Fog.Combined"], nothing),
}


@cases(LAYERED)
def test_resume_of_two_view_layers(folder, case):
    as_fresh(folder, *case, edit=two_layers)


# --- 16: estimates from a sequence that does not fit


def gone(*numbers: int) -> Callable[[Path], object]:
    return lambda f: [(f / f"shot.{number}.exr").unlink() for number in numbers]


def renumbered(by: int) -> Callable[[Path], object]:
    return lambda f: [p.rename(f / f"x.{int(p.name[5:9]) + by}.exr") for p in sorted(f.iterdir())]


def replaced(make: Callable[[Path], object]) -> Callable[[Path], object]:
    return lambda f: [(f / "shot.1001.exr").unlink(), make(f / "shot.1001.exr")]


UNFIT: dict[str, tuple[Callable[[Path], object], Sequence[str], bool]] = {
    "one frame missing": (gone(1003), [], False),
    "a frame missing that was not asked for": (gone(1008), ["--frames", "1002-1003"], True),
    "a neighbour missing": (gone(1004), ["--frames", "1002-1003"], True),
    "a frame missing that was asked for": (gone(1003), ["--frames", "1002-1003"], False),
    "all missing but one": (gone(*range(1002, 1009)), [], False),
    "frames of other numbers": (renumbered(100), [], False),
    "frames numbered from one": (renumbered(-1000), [], False),
    "one frame of another size": (replaced(lambda p: write(p, {k: v[:-2] for k, v in wall(0).items()})), [], False),
    "two sequences": (lambda f: shutil.copy(f / "shot.1001.exr", f / "other.1001.exr"), [], False),
    "an empty folder": (gone(*range(1001, 1009)), [], False),
    "a pipe in a frame's place": (replaced(os.mkfifo), [], False),
    "a text in a frame's place": (replaced(lambda p: p.write_text("x")), [], False),
    "a frame without color": (replaced(lambda p: write(p, {"Depth": np.ones(SIZE, np.float32)})), [], False),
}


@cases(UNFIT)
def test_estimates_of_a_sequence_that_does_not_fit_are_refused(folder, case):
    change, more, fits = case
    blurred(folder / "single", shot(folder / "in", 8, step=(2, 1)))
    change(folder / "single")
    done = ravg(*draft("--first-pass", "single", *more), folder=folder).ends("works" if fits else "refused")
    assert bool(names(folder / "out")) == (done.code == 0)


# --- 22: several runs at once, and chunks on a cluster

TOGETHER: dict[str, Sequence[Sequence[str]]] = {
    "the same twice": [DRAFT, DRAFT],
    "two presets": [DRAFT, ("--preset", "final")],
    "both with --resume": [(*DRAFT, "--resume"), (*DRAFT, "--resume")],
    "halves of a shot": [(*DRAFT, "--frames", "1001-1004"), (*DRAFT, "--frames", "1003-1006")],
}


@cases(TOGETHER, "runs")
def test_runs_into_one_folder_at_once_leave_the_frames_of_one_of_them(folder, runs):
    shot(folder / "in", 6, step=(2, 1))
    command = [sys.executable, "-P", "-m", "ravg", "denoise", "in", "-o", "out"]
    settings = {"cwd": folder, "env": {**os.environ, "PYTHONPATH": str(ROOT)}, "stderr": subprocess.PIPE, "text": True}
    running = [subprocess.Popen([*command, *more], **settings) for more in runs]  # type: ignore[call-overload]
    for process in running:
        assert process.communicate(timeout=300)[1] is not None
        assert process.returncode == 0
    for index, more in enumerate(runs):
        options = [word for word in more if word != "--frames" and not word.startswith("100")]
        ravg("denoise", "in", "-o", f"alone{index}", *options, folder=folder).succeeds()
    for name in names(folder / "in"):
        assert not all(difference(folder / f"alone{index}", folder / "out", {name}) for index in range(len(runs)))
    no_leftovers(folder / "out")


@pytest.mark.cluster
@cases((True, False), "stale")
def test_chunks_on_a_cluster_make_again_what_is_not_what_it_was(folder, stale):
    pytest.importorskip("distributed")
    shot(folder / "in", 6, step=(2, 1), **RAW)
    with socket.socket() as free:
        free.bind(("127.0.0.1", 0))
        port = free.getsockname()[1]
    address = f"tcp://127.0.0.1:{port}"
    scheduler = ["distributed.cli.dask_scheduler", "--host", "127.0.0.1", "--port", str(port), "--no-dashboard"]
    worker = ["distributed.cli.dask_worker", address, "--nthreads", "1", "--no-dashboard", "--no-nanny"]
    quiet = {"cwd": folder, "env": {**os.environ, "PYTHONPATH": str(ROOT)}, "stdout": -3, "stderr": -3}
    running = [subprocess.Popen([sys.executable, "-m", *words], **quiet) for words in (scheduler, worker)]  # type: ignore[call-overload]
    try:
        time.sleep(5)
        words = ["-m", "ravg", *draft("--scheduler", address, "--chunk", "2")]
        run_python(*words, folder=folder).succeeds()
        if stale:
            render_again(folder / "in" / "shot.1004.exr")
        else:
            os.truncate(folder / "out" / "shot.1004.exr", 1000)
        run_python(*words, folder=folder).succeeds()
    finally:
        for process in running:
            process.terminate()
            process.wait(20)
    ravg("denoise", "in", "-o", "fresh", *DRAFT, folder=folder).succeeds()
    same(folder / "fresh", folder / "out")


# --- 23: stereo

STEREO: dict[str, tuple[Callable[[Path], object], Sequence[str]]] = {
    "nothing changes": (nothing, []),
    "the right view is rendered again": (lambda f: render_again(f / "in/shot.right.1002.exr"), []),
    "the views are exchanged": (
        lambda f: [exchange(f / f"in/shot.left.{n}.exr", f / f"in/shot.right.{n}.exr") for n in range(1001, 1005)],
        [],
    ),
    "another option": (nothing, ["--no-stages", "warp"]),
}


def two_views(folder: Path, frames: int) -> None:
    for index, view in enumerate(("left", "right")):
        shot(folder / "in", frames, step=(2 + index, 1), name=f"shot.{view}.{{:04d}}.exr", **RAW)


@cases(STEREO)
def test_views_of_a_pattern_are_made_each_by_itself(folder, case):
    change, after = case
    two_views(folder, 4)
    words = ["denoise", "in/shot.%V.####.exr", *DRAFT]
    ravg(*words, "-o", "out/done.%V.####.exr", folder=folder).succeeds()
    change(folder)
    for out, more in (("out", ["--resume"]), ("fresh", [])):
        ravg(*words, "-o", f"{out}/done.%V.####.exr", *after, *more, folder=folder).succeeds()
    assert len(names(folder / "fresh")) == 8
    same(folder / "fresh", folder / "out")


# --- 24: two things taken for one


@cases(("1001-1007", "1003-1006", "1005"), "frames")
def test_every_second_frame_is_the_same_whatever_range_is_asked_for(folder, frames):
    noisy = shot(folder / "in", 7, step=(1, 0))
    for number in (1002, 1004, 1006):
        (noisy / f"shot.{number}.exr").unlink()
    ravg("denoise", "in", "-o", "all", *DRAFT, folder=folder).succeeds()
    ravg("denoise", "in", "-o", "part", *DRAFT, "--frames", frames, "--keep-going", folder=folder)
    same(folder / "part", folder / "all")


def test_a_frame_that_is_exchanged_while_it_is_used_ends_the_run(folder):
    """For another of its size and time."""
    for name, noise in (("in", 0.3), ("other", 0.5)):
        shot(folder / name, 12, size=(160, 240), step=(2, 1), noise=noise, **RAW)
    old, new = (folder / name / "shot.1008.exr" for name in ("in", "other"))
    status = old.stat()
    os.utime(new, ns=(status.st_atime_ns, status.st_mtime_ns))

    def swap() -> None:
        while not (folder / "out" / "shot.1006.exr").exists():
            time.sleep(0.002)
        new.replace(old)

    threading.Thread(target=swap, daemon=True).start()
    done = run_python("-m", "ravg", *draft(), folder=folder).is_refused()
    assert re.search(r"shot\.1008\.exr", done.said)
