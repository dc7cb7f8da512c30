"""Nobody else's file is touched: rows 8, 9, 10 and 19 of docs/dev/reliability.md."""

# ruff: noqa: E501 - tables of cases, one a line

import os
import shutil
import subprocess
import sys
from collections.abc import Callable, Sequence
from pathlib import Path

import pytest

from tests.commands import OURS, ROOT, ravg, run_python
from tests.reliability.shots import DRAFT, blurred, cases, contents, draft, shot, unchanged

pytestmark = [pytest.mark.reliability, pytest.mark.posix]
Make = Callable[[Path], object]
ROOT_ONLY = pytest.mark.skipif(not hasattr(os, "geteuid") or os.geteuid() != 0, reason="needs root")

# --- 8: nobody else's file is written over


# --- 9: two containers leave each other's files alone

HOLD = """
import os, pathlib, sys
from hybrid.files.replace import replace_file, temporary_folder
kind, path, number = sys.argv[1], pathlib.Path(sys.argv[2]), int(sys.argv[3])
while os.getpid() < number:  # each child has the next number
    if child := os.fork():
        sys.exit(os.waitstatus_to_exitcode(os.waitpid(child, 0)[1]))
with (replace_file if kind == "file" else temporary_folder)(path) as temporary:
    inside = temporary if kind == "file" else temporary / "a.exr"
    inside.write_bytes(b"whole")
    print("begun", flush=True)
    sys.stdin.read(1)
    print(inside.read_bytes().decode(), flush=True)
"""


def hold(folder: Path, kind: str, number: int, *prefix: str) -> subprocess.Popen[str]:
    """A process that is in the midst of writing into `out`."""
    shot(folder / "in", 2)
    (folder / "out").mkdir()
    child = subprocess.Popen(
        [*prefix, sys.executable, "-P", "-c", HOLD, kind, str(folder / "out" / "other.0001.exr"), str(number)],
        env={**os.environ, "PYTHONPATH": str(ROOT)},
        stdin=subprocess.PIPE,
        stdout=subprocess.PIPE,
        text=True,
    )
    assert child.stdout is not None
    assert child.stdout.readline() == "begun\n"
    return child


@ROOT_ONLY
@pytest.mark.skipif(shutil.which("unshare") is None, reason="needs unshare")
@cases((False, True), "proc_of_its_own")
@cases(("file", "folder"), "kind")
def test_a_process_of_another_container_keeps_what_it_writes(folder, kind, proc_of_its_own):
    # The lowest number that no process has which is seen here: the other one may have it there.
    free = next(number for number in range(2, 10**6) if not Path(f"/proc/{number}").exists())
    words = ["unshare", "--pid", "--fork", *(["--mount-proc"] if proc_of_its_own else [])]
    child = hold(folder, kind, free, *words)
    ravg(*draft(), folder=folder).succeeds()
    said, _ = child.communicate("x")
    assert child.returncode == 0
    assert "whole" in said


# --- 10: a home that is read-only

# The interpreter itself may be root's alone: what it needs is loaded before.
AS_NOBODY = f"""
import os, sys
sys.path.insert(0, {str(ROOT)!r})
import numba
import tests.loaded
from tests.commands import OURS
numba.njit(lambda x: 2 * x)(1)
os.setegid(65534), os.seteuid(65534)
for name in [name for name in sys.modules if name.partition(".")[0] in OURS]:
    del sys.modules[name]
sys.path[0] = os.environ["INSTALLED"]
from hybrid.cli import main
sys.exit(main(sys.argv[1:]))
"""


@ROOT_ONLY
@cases((True, False), "temporary")
def test_a_user_without_a_home_runs_an_installation_of_roots(folder, temporary):
    """The packages as an administrator installs them: not for the user to write to."""
    for name in OURS:
        shutil.copytree(ROOT / name, folder / "installed" / name, ignore=shutil.ignore_patterns("__pycache__"))
    shot(folder / "in", 1)
    (folder / "tmp").mkdir()
    for path in (folder, folder / "tmp"):
        path.chmod(0o777)
    environment = {"HOME": "/nonexistent", "XDG_CACHE_HOME": "/nonexistent", "INSTALLED": str(folder / "installed")}
    environment["TMPDIR"] = str(folder / "tmp" if temporary else folder / "none")
    run_python("-c", AS_NOBODY, "inspect", "in", packages=Path("/nonexistent"), folder=folder, **environment).succeeds()


# --- 19: outputs in odd places


def linked(folder: Path, name: str, to: str) -> None:
    (folder / name).parent.mkdir(exist_ok=True)
    (folder / name).symlink_to(folder / to)


def written(path: Path) -> None:
    path.parent.mkdir(exist_ok=True)
    path.write_text("x")


def fifo(path: Path) -> None:
    path.parent.mkdir(exist_ok=True)
    os.mkfifo(path)


def nothing(folder: Path) -> None:
    """Leave all as it is."""


FRAMES = "in/shot.####.exr"
# The preparation; the options; how it ends.
ODD: dict[str, tuple[Make, Sequence[str], str]] = {
    "an output by a link to a folder": (lambda f: [(f / "real").mkdir(), linked(f, "out", "real")], ["-o", "out"], "works"),
    "an output by a link to the input": (lambda f: linked(f, "out", "in"), ["-o", "out"], "refused"),
    "an output by a dangling link": (lambda f: linked(f, "out", "none"), ["-o", "out"], "either"),
    "an output within the input": (nothing, ["-o", "in/out"], "works"),
    "another name in the input's folder": (nothing, [FRAMES, "-o", "in/done.####.exr"], "works"),
    "the input's name in other letters": (nothing, [FRAMES, "-o", "in/SHOT.####.EXR"], "either"),
    "the input, padded otherwise": (nothing, [FRAMES, "-o", "in/shot.#.exr"], "refused"),
    "the input by ./": (nothing, ["-o", "./in/../in/./shot.####.exr"], "refused"),
    "hard links as frames": (lambda f: (f / "in/shot.1004.exr").hardlink_to(f / "in/shot.1001.exr"), ["-o", "out"], "works"),
    "links as frames": (lambda f: linked(f, "in/shot.1004.exr", "in/shot.1001.exr"), ["-o", "out"], "works"),
    "an output that links to a frame": (lambda f: linked(f, "out/shot.1002.exr", "in/shot.1001.exr"), ["-o", "out"], "refused"),
    "an output that links to a stranger's": (lambda f: [written(f / "single/x"), linked(f, "out/shot.1002.exr", "single/x")], ["-o", "out"], "either"),
    "an output that is a folder": (lambda f: (f / "out/shot.1002.exr").mkdir(parents=True), ["-o", "out"], "refused"),
    "an output that is a pipe": (lambda f: fifo(f / "out/shot.1002.exr"), ["-o", "out"], "refused"),
    "a preview that is an output": (nothing, ["-o", "out", "--preview", "out/shot.1002.exr"], "refused"),
    "a preview without an extension": (nothing, ["-o", "out", "--preview", "out/x"], "refused"),
    "a preview in a folder that is not there": (nothing, ["-o", "out", "--preview", "no/such/x.png"], "either"),
    "a preview and a sheet in one file": (nothing, ["-o", "out", "--preview", "x.png", "--contact-sheet", "./x.png"], "refused"),
    "a log that is a frame": (nothing, ["-o", "out", "--log-file", "in/shot.1002.exr"], "refused"),
    "a log that is an output": (nothing, ["-o", "out", "--log-file", "out/shot.1002.exr"], "refused"),
    "a log that is the preview": (nothing, ["-o", "out", "--log-file", "x.png", "--preview", "x.png"], "refused"),
    "a log that is the record": (nothing, ["-o", "out", "--log-file", "out/ravg/shot.1001-1003.json"], "refused"),
    "a log that is a pipe": (lambda f: fifo(f / "pipe"), ["-o", "out", "--log-file", "pipe"], "refused"),
    "a log that is a folder": (nothing, ["-o", "out", "--log-file", "in"], "refused"),
    "records in a folder that is a file": (lambda f: written(f / "out/ravg"), ["-o", "out"], "refused"),
    "estimates that are the input": (nothing, ["-o", "out", "--first-pass", "in"], "either"),
    "estimates in the output": (nothing, ["-o", "single", "--first-pass", "single"], "refused"),
    "a very long name": (nothing, ["-o", "x" * 240 + ".####.exr"], "either"),
    "a name that is too long": (nothing, ["-o", "x" * 300 + ".####.exr"], "refused"),
    "a path that is too long": (nothing, ["-o", "/".join(["x" * 200] * 30)], "refused"),
    "a name with a zero": (nothing, ["-o", "a\0b"], "refused"),
    "a pattern with two places": (nothing, ["-o", "out_##/x.####.exr"], "works"),
    "one name for several frames": (nothing, ["-o", "out/x.exr"], "refused"),
    "the root": (nothing, ["-o", "/proc/x"], "refused"),
}  # fmt: skip


@cases(ODD)
def test_an_odd_place_works_or_is_refused_and_spares_what_is_there(folder, case):
    prepare, words, how = case
    blurred(folder / "single", shot(folder / "in", 3))
    prepare(folder)
    before = contents(folder / "in", folder / "single")
    source = [] if words[0] == FRAMES else ["in"]
    ravg("denoise", *DRAFT, *source, *words, folder=folder, seconds=60).ends(how)
    unchanged(before)
