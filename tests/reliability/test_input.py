"""Odd, hostile and damaged input: rows 3, 12, 13, 18 and 20 of docs/dev/reliability.md."""

import json
import os
import subprocess
import sys
import urllib.request
from collections.abc import Callable, Sequence
from pathlib import Path

import pytest

from tests.commands import ROOT, ravg, run_python
from tests.reliability.shots import COLOR, DRAFT, cases, draft, names, nothing, same, shot, wall, write
from tests.scenes import grained

pytestmark = [pytest.mark.reliability, pytest.mark.posix]

# --- 3: names mean one thing, or are refused


@pytest.mark.neural
@cases(("normal", "albedo", "Combined", "ViewLayer.Combined", "color"), "name")
def test_an_aov_that_is_a_role_changes_nothing_else(folder, name):
    """Or it is refused."""
    shot(folder / "in", 3, step=(2, 0))
    words = ["denoise", "in", "--first-pass", "nlm"]
    if ravg(*words, "-o", "out", "--aov", name, folder=folder).ends("either").code == 0:
        ravg(*words, "-o", "plain", folder=folder).succeeds()
        same(folder / "plain", folder / "out")


# --- 12: no crash, no hang: one line


LOOPS = ["inspect", "a"], ["denoise", "in", "-o", "a/x"], draft("--preview", "a/x.png")
SIZES = "9" * 400, "1" + "0" * 400 + "G", "9" * 400 + ".5T", "1e400"


@cases([*LOOPS, *(draft("--max-memory", size) for size in SIZES)], "words")
def test_loops_of_links_and_numbers_without_end_are_refused(folder, words):
    shot(folder / "in", 3)
    (folder / "a").symlink_to(folder / "b")
    (folder / "b").symlink_to(folder / "a")
    ravg(*words, folder=folder).is_refused()


@cases((50, 300), "mebibytes")
def test_little_memory_ends_in_one_line(folder, mebibytes):
    shot(folder / "in", 3, size=(1500, 2000), noise=0)
    ravg(*draft(), folder=folder, memory=mebibytes * 2**20).is_refused()


# --- 13: words of any encoding, folders of any name


FOLDERS = (
    "a#b", "####", "a@b", "@@@@", "%04d", "$F4", "<frame04>", "[1]", "a[1-3]b", "a*b", "a?b", "{x}", "ä 渲", " a",
)  # fmt: skip


@cases((False, True), "pattern")
@cases(FOLDERS, "name")
def test_a_folder_may_be_called_anything(folder, name, pattern):
    noisy, out = shot(folder / name / "in", 2), folder / name / "out"
    spec, target = (noisy / "shot.####.exr", out / "made.####.exr") if pattern else (noisy, out)
    ravg("denoise", spec, "-o", target, *DRAFT).succeeds()
    assert len(names(out)) == 2


@cases((["inspect", "ä"], ["denoise", "ä", "-o", "ö", *DRAFT], ["denoise", "--help"]), "words")
def test_a_terminal_may_know_ascii_alone(folder, words):
    shot(folder / "ä", 2)
    run_python("-m", "ravg", *words, folder=folder, PYTHONIOENCODING="ascii", LC_ALL="C").succeeds()


# --- 18: the viewer, in odd folders


def record_of(make: Callable[[Path], object]) -> Callable[[Path], object]:
    return lambda f: [(f / "ravg").mkdir(), make(f / "ravg" / "shot.1.json")]


HOSTILE_RECORD = '{"ravg": 1, "asked": 1, "frames": [], "started": [], "state": {}}'
ODD_NAMES = (
    b"a#b", b"%04d", b"[1]", b"a b ", b"caf\xe9", "渲染".encode(), b"a'b\"c", b"<script>", b"a\nb", b"?x=1&y", b"..x",
)  # fmt: skip
VIEWED: dict[str, tuple[bytes, Callable[[Path], object]]] = {
    **{f"a folder called {name!r}": (name, nothing) for name in ODD_NAMES},
    "a record that is a pipe": (b"x", record_of(os.mkfifo)),
    "a record that is hostile": (b"x", record_of(lambda p: p.write_text(HOSTILE_RECORD))),
    "a picture of Windows' desktop": (b"x", lambda f: (f / "desktop.ini").write_bytes(b"\xff")),
}


@cases(VIEWED)
def test_the_viewer_shows_a_frame_whatever_else_there_is(folder, case):
    name, prepare = case
    out = Path(os.fsdecode(os.fsencode(folder) + b"/" + name))
    shot(folder / "plain", 2).rename(out)  # the library writes to no name that is not UTF-8
    prepare(out)
    words = [sys.executable, "-P", "-m", "ravg", "view", os.fsencode(out), "--no-browser"]
    environment = {**os.environ, "PYTHONPATH": str(ROOT), "PYTHONUNBUFFERED": "1"}
    child = subprocess.Popen(words, env=environment, stdout=subprocess.PIPE, stderr=subprocess.STDOUT)
    try:
        assert child.stdout is not None
        line = child.stdout.readline().decode("utf-8", "replace").strip()
        assert line.startswith("http://")
        with urllib.request.urlopen(f"{line}state", timeout=30) as answer:
            sequence = json.loads(answer.read())["sequences"][0]
        assert len(sequence["frames"]) == 2
        layer = urllib.request.quote(sequence["layer"])  # type: ignore[attr-defined]
        with urllib.request.urlopen(f"{line}frame/0/1002.png?ev=0&layer={layer}", timeout=30) as answer:
            assert answer.read(4)[1:] == b"PNG"
    finally:
        child.terminate()
        child.wait(30)


# --- 20: gaps, negative numbers, ranges

Numbers = Sequence[int | str]
NUMBERS: dict[str, tuple[Numbers, Sequence[str], str]] = {
    "a gap": ([1, 2, 3, 7, 8], [], "works"),
    "every second": ([2, 4, 6, 8], [], "works"),
    "every fifth, and one odd": ([5, 10, 15, 17], [], "works"),
    "negative numbers": (["shot.-002.exr", "shot.-001.exr", "shot.0000.exr", "shot.0001.exr"], [], "works"),
    "frame 0 alone": ([0], [], "works"),
    "of nine digits": ([10**8 + 1, 10**8 + 2], [], "works"),
    "dates": ([20260101, 20260301, 20261231], [], "works"),
    "far apart": ([1, 10**12], [], "works"),
    "more than 64 bits": ([f"shot.{10**25}.exr", f"shot.{10**25 + 1}.exr"], [], "either"),
    "hundreds of digits": (["shot." + "1" * 200 + ".exr", "shot." + "1" * 199 + "2.exr"], [], "either"),
    "padded and not": (["shot.1.exr", "shot.2.exr", "shot.0001.exr"], [], "refused"),
    "the same number twice": (["shot.01.exr", "shot.1.exr"], [], "refused"),
    "two sequences": (["a.1.exr", "b.1.exr"], [], "refused"),
    "numbers alone": (["0001.exr", "0002.exr"], [], "works"),
    "numbers before and behind": (["2shot1.exr", "2shot2.exr"], [], "works"),
    "in other letters": (["shot.1.EXR", "shot.2.EXR"], [], "works"),
    "mixed letters": (["shot.1.exr", "shot.2.EXR"], [], "either"),
    "other digits": (["shot.١.exr", "shot.٢.exr"], [], "either"),
    "a range without end": ([1, 2, 3], ["--frames", "1-100000000000"], "either"),
    "a range of steps": ([1, 2, 3], ["--frames", "1-3x2"], "works"),
    "a range backwards": ([1, 2, 3], ["--frames", "3-1"], "either"),
    "a step of nothing": ([1, 2, 3], ["--frames", "1-3x0"], "refused"),
    "a frame twice": ([1, 2, 3], ["--frames", "2,2,1-2"], "works"),
    "digits of another script": ([1, 2, 3], ["--frames", "١-٣"], "either"),
    "a range of 400 digits": ([1, 2], ["--frames", "1-" + "9" * 400], "either"),
    "a step of 400 digits": ([1, 2], ["--frames", "1-2x" + "9" * 400], "either"),
    "a hundred thousand commas": ([1, 2], ["--frames", "1," * 100_000 + "2"], "either"),
    "a glob": ([1, 2, 3], ["in/shot.*.exr"], "works"),
    "a glob of some": ([1, 2, 3, 12], ["in/shot.000[12].exr", "--frames", "1-2"], "works"),
    "a range within the name": ([1, 2, 3], ["in/shot.1-2####.exr", "--frames", "1-2"], "works"),
}


@cases(NUMBERS)
def test_each_frame_is_made_once_under_its_number(folder, case):
    """Or all is refused."""
    numbers, more, how = case
    for index, number in enumerate(numbers):
        layers = wall(index, (2, 1))
        layers[COLOR] = grained(layers[COLOR], index)
        write(folder / "in" / (number if isinstance(number, str) else f"shot.{number:04d}.exr"), layers)
    source = [] if more and not more[0].startswith("-") else ["in"]
    done = ravg("denoise", *source, *more, "-o", "out", *DRAFT, folder=folder, seconds=60, memory=2 * 2**30)
    done.ends(how)
    if done.code == 0 and "--frames" not in more:
        assert names(folder / "in") <= names(folder / "out")
