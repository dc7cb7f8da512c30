"""Faults from outside: kills, Ctrl-C, full disks, little memory. Nothing is lost, and nothing is half there."""

import os
import re
import shutil
import signal
import subprocess
import sys
import time
from contextlib import suppress

import numpy as np
import OpenEXR
import pytest

from hybrid.cli import main
from hybrid.denoising.first_pass import Classical, PerFrame
from hybrid.denoising.oidn import HOLDS, HOLDS_FAST
from hybrid.denoising.plan import STAGES, Rules
from hybrid.denoising.pseudo_reference import CLASSICAL_PRESETS, filter_window
from hybrid.denoising.stream import FrameStream
from hybrid.files.exr import read_exr, write_exr
from hybrid.files.replace import remove_leftovers, remove_unfinished, temporary_folder
from hybrid.files.shots import open_shot
from hybrid.run.memory import MemoryPlan, parse_size, plan_memory
from hybrid.runtime.interrupt import interruptible
from tests.hard_cases.test_hard_files import ROOT, run_alone
from tests.scenes import Scene, only
from tests.seldom import seldom


def draft(folder, out, *more):
    return main(["denoise", str(folder), "-o", str(out), "--preset", "draft", *more])


def contents(folder):
    """Bytes of the frames in a folder, of which there is one at least."""
    found = {path.name: path.read_bytes() for path in folder.glob("*.exr")}
    assert found
    return found


def stamps(folder):
    return {path.name: path.stat().st_mtime_ns for path in folder.glob("*.exr")}


def test_resume_makes_only_what_is_missing_damaged_or_outdated(tmp_path, capsys):
    folder, out = Scene().write(tmp_path / "in"), tmp_path / "out"
    assert draft(folder, out) == 0
    whole = {path.name: path.read_bytes() for path in out.glob("*.exr")}
    before = stamps(out)

    def made_again(*more):
        nonlocal before
        assert draft(folder, out, "--resume", *more) == 0
        after = stamps(out)
        names = {name for name in after if after[name] != before.get(name)}
        before = after
        return names

    assert made_again() == set()
    assert "3 of 3 frames were finished already" in capsys.readouterr().err
    (out / "shot.1002.exr").unlink()
    assert made_again() == {"shot.1002.exr"}
    damaged = out / "shot.1001.exr"
    damaged.write_bytes(damaged.read_bytes()[:-100])
    before = stamps(out)
    assert made_again() == {"shot.1001.exr"}
    assert {path.name: path.read_bytes() for path in out.glob("*.exr")} == whole
    # other settings, other pixels: the wall moves, so the plan has what is forced off here
    assert len(made_again("--no-stages", "warp")) == 3
    assert len(made_again("--preset", "standard")) == 3
    assert len(made_again()) == 3
    # a frame that was rendered again changes itself and its neighbours
    later = time.time() + 5
    os.utime(folder / "shot.1003.exr", (later, later))
    assert len(made_again()) == 3


def render_again(path, note, seconds=None):
    """The same file but for a word in its header, with a time of its own."""
    before = path.stat().st_mtime
    write_exr(path, read_exr(path), {}, attributes={"note": note})
    seconds = before if seconds is None else seconds
    os.utime(path, (seconds, seconds))


@pytest.mark.parametrize(
    ("what", "again"),
    [
        ("a frame of the same size and time", range(1001, 1010)),
        ("a frame that comes late", range(1005, 1011)),
        ("a frame that is gone", range(1005, 1010)),
        ("an estimate made again", range(1001, 1010)),
        ("other vectors", range(1001, 1011)),
        ("another version", range(1001, 1011)),
        ("the project unpacked elsewhere", ()),
    ],
)
def test_resume_makes_again_what_was_made_from_something_else(tmp_path, capsys, monkeypatch, what, again):
    """Times alone were compared: what was older, or came late, or was no frame at all, was "finished already"."""
    scene, out = Scene(height=24, width=32, frames=10), tmp_path / "out"
    folder, estimates = scene.write(tmp_path / "in"), scene.write(tmp_path / "estimates", clean=True)
    frame, estimate, last = folder / "shot.1004.exr", estimates / "shot.1004.exr", folder / "shot.1010.exr"
    for path in (frame, estimate):
        render_again(path, "first")
    if what == "a frame that comes late":
        last.rename(tmp_path / "late.exr")
    more = []
    assert draft(folder, out, "--first-pass", str(estimates)) == 0
    before = stamps(out)
    if what == "a frame of the same size and time":
        render_again(frame, "other")
    elif what == "a frame that comes late":
        (tmp_path / "late.exr").rename(last)
        os.utime(last, (1e9, 1e9))
    elif what == "a frame that is gone":
        last.unlink()
    elif what == "an estimate made again":
        render_again(estimate, "other")
    elif what == "other vectors":
        more = ["--motion", "none"]
    elif what == "another version":
        monkeypatch.setattr("hybrid.files.sources.version", lambda package: "1999")
    else:
        for path in (folder, estimates):
            shutil.copytree(path, tmp_path / "elsewhere" / path.name)
            for file in (tmp_path / "elsewhere" / path.name).iterdir():  # archives keep whole seconds
                os.utime(file, (int(file.stat().st_mtime), int(file.stat().st_mtime)))
        folder, estimates = tmp_path / "elsewhere" / "in", tmp_path / "elsewhere" / "estimates"
    capsys.readouterr()
    assert draft(folder, out, "--resume", "--first-pass", str(estimates), *more) == 0
    after = stamps(out)
    assert {int(name.split(".")[1]) for name in after if after[name] != before.get(name)} == {*again}
    reasons = re.findall(r"frame (\d+) is made again: (.+)", capsys.readouterr().err)
    assert {int(number) for number, _ in reasons} == {n for n in again if f"shot.{n}.exr" in before}


def test_a_frame_in_the_place_of_another_is_made_again(tmp_path, capsys):
    """One window held the whole shot, so all frames were made from the same files."""
    folder, out = Scene().write(tmp_path / "in"), tmp_path / "out"
    assert draft(folder, out) == 0
    whole = contents(out)
    (out / "shot.1001.exr").replace(out / "shot.1002.exr")
    shutil.copy(out / "shot.1003.exr", out / "shot.1001.exr")
    assert draft(folder, out, "--resume") == 0
    assert contents(out) == whole
    said = capsys.readouterr().err
    assert "frame 1001 is made again: frame was 1003, is 1001" in said
    assert "1 of 3 frames were finished already" in said


def test_a_frame_that_is_rendered_again_while_it_is_used_ends_the_run(tmp_path, capsys, monkeypatch):
    """Half of what was written came from the old file, half from the new, and --resume found it finished."""
    scene, out = Scene(height=24, width=32, frames=4), tmp_path / "out"
    folder = scene.write(tmp_path / "in")
    made = []

    def filter_and_render(window, *args, **kwargs):
        made.append(window.number)
        if len(made) == 2:
            render_again(folder / "shot.1003.exr", "again")
        return filter_window(window, CLASSICAL_PRESETS["draft"])

    monkeypatch.setattr("hybrid.denoising.denoisers.filter_window", filter_and_render)
    assert draft(folder, out) == 1
    assert "shot.1003.exr has changed since it was read" in capsys.readouterr().err
    assert set(stamps(out)) == {"shot.1001.exr"}
    monkeypatch.undo()
    before = stamps(out)
    assert draft(folder, out, "--resume") == 0
    assert stamps(out)["shot.1001.exr"] != before["shot.1001.exr"]  # whose window had the old one


@pytest.mark.neural
def test_resume_of_the_network_gives_the_same_bytes(tmp_path):
    folder = Scene().write(tmp_path / "in")
    words = ["denoise", str(folder), "--first-pass", "nlm", "-o"]
    assert main([*words, str(tmp_path / "whole")]) == 0
    assert main([*words, str(tmp_path / "parts")]) == 0
    (tmp_path / "parts" / "shot.1002.exr").unlink()
    kept = stamps(tmp_path / "parts")
    assert main([*words, str(tmp_path / "parts"), "--resume"]) == 0
    assert kept.items() <= stamps(tmp_path / "parts").items()
    assert contents(tmp_path / "whole") == contents(tmp_path / "parts")


BUSY = """
import hashlib, pathlib, sys
from hybrid.files.replace import replace_file
from hybrid.runtime.interrupt import interruptible
try:
    with interruptible(lambda: print("2 of 5", flush=True)), replace_file(pathlib.Path(sys.argv[1])) as temporary:
        print("begun", flush=True)
        hashlib.pbkdf2_hmac("sha256", b"", b"", 200_000_000)  # a minute of compiled code that sees no signal
except KeyboardInterrupt:  # it came before that code did; the command ends with the same code then
    sys.exit(130)
"""


@pytest.mark.posix
@pytest.mark.parametrize("number", [signal.SIGINT, signal.SIGTERM])
@pytest.mark.usefixtures("interrupts")
def test_a_stop_is_heard_in_the_midst_of_compiled_code(tmp_path, number):
    words = [sys.executable, "-c", BUSY, str(tmp_path / "frame.exr")]
    environment = {**os.environ, "PYTHONPATH": os.pathsep.join([str(ROOT), *sys.path])}
    child = subprocess.Popen(words, env=environment, stdout=subprocess.PIPE, text=True)
    assert child.stdout.readline() == "begun\n"
    child.send_signal(number)
    said, _ = child.communicate(timeout=30)  # it would be a minute; on a quiet machine it is a second
    assert child.returncode == 130
    assert said == "2 of 5\n"
    assert list(tmp_path.iterdir()) == []


READING = """
import hashlib, os, sys, threading, time
from hybrid.files import exr
from hybrid.runtime.interrupt import interruptible

def read():
    with exr._library_messages():
        os.write(1, b"begun\\n")
        time.sleep(float(sys.argv[1]))

with interruptible(lambda: print("2 of 5", file=sys.stderr, flush=True)):
    threading.Thread(target=read, daemon=True).start()
    hashlib.pbkdf2_hmac("sha256", b"", b"", 200_000_000)
"""


@pytest.mark.posix
@pytest.mark.parametrize("seconds", [0.5, 600])
@pytest.mark.usefixtures("interrupts")
def test_the_report_of_a_stop_is_seen_while_a_file_is_read_beside_the_work(seconds):
    """Messages of the library for files are listened for on the descriptor that the report goes to."""
    environment = {**os.environ, "PYTHONPATH": os.pathsep.join([str(ROOT), *sys.path])}
    words = [sys.executable, "-c", READING, str(seconds)]
    child = subprocess.Popen(words, env=environment, stdout=subprocess.PIPE, stderr=subprocess.PIPE, text=True)
    assert child.stdout.readline() == "begun\n"
    child.send_signal(signal.SIGINT)
    _, said = child.communicate(timeout=30)
    # Ended by the thread that waits, or by Python itself where the computation had not begun yet.
    assert child.returncode in (130, -signal.SIGINT)
    assert said.startswith("2 of 5\n")


WRITING = """
import pathlib, sys, time
from hybrid.files.replace import replace_file
with replace_file(pathlib.Path(sys.argv[1])) as temporary:
    temporary.write_bytes(b"half")
    print("begun", flush=True)
    time.sleep(600)
"""


def begin(script, path):
    """A process that is in the midst of writing."""
    environment = {**os.environ, "PYTHONPATH": os.pathsep.join([str(ROOT), *sys.path])}
    child = subprocess.Popen(
        [sys.executable, "-c", script, str(path)], env=environment, stdout=subprocess.PIPE, text=True
    )
    assert child.stdout.readline() == "begun\n"
    return child


@pytest.mark.posix
def test_what_a_killed_process_has_left_is_removed_and_nothing_else(tmp_path, monkeypatch):
    """Ownership was told by host name and process number: two containers cleared each other's live files."""
    child = begin(WRITING, tmp_path / "shot.0001.exr")
    others = [tmp_path / name for name in (".tmp", "shot.0002.exr", ".shot.0001.exr.ravg-0.tmp")]
    for path in others:
        path.touch()
    link = tmp_path / f".shot.0001.exr.ravg-{16 * '0'}.tmp"
    link.symlink_to(others[1])
    # Another container: no process here has that number, and the host is called the same.
    monkeypatch.setattr(os, "kill", lambda *_: (_ for _ in ()).throw(ProcessLookupError()))
    remove_leftovers(tmp_path)
    assert len(list(tmp_path.iterdir())) == 5
    monkeypatch.undo()
    child.kill()
    child.communicate()
    remove_leftovers(tmp_path)
    assert sorted(tmp_path.iterdir()) == sorted([*others, link])


LONG = """
import pathlib, sys, time
from hybrid.files.replace import temporary_folder
with temporary_folder(pathlib.Path(sys.argv[1])) as folder:
    (folder / "shot.0001.exr").touch()
    print("begun", flush=True)
    time.sleep(600)
"""


def test_the_folder_of_a_killed_process_is_removed_by_the_next_and_that_of_a_living_one_is_not(tmp_path):
    """Folders between passes used to bear names that no later run knew."""
    child = begin(LONG, tmp_path / "pass1")
    with temporary_folder(tmp_path / "pass1") as ours:
        assert len([path for path in tmp_path.iterdir() if path.is_dir()]) == 2
        child.kill()
        child.communicate()
        remove_leftovers(tmp_path)
        assert [path for path in tmp_path.iterdir() if path.is_dir()] == [ours]
        assert len(list(tmp_path.iterdir())) == 2  # and its lock
        (ours / "shot.0001.exr").touch()
        remove_unfinished()  # as Ctrl-C does where Python does not hear it
        assert list(tmp_path.iterdir()) == []
    with temporary_folder(tmp_path / "pass1") as ours:
        (ours / "shot.0001.exr").touch()
    assert list(tmp_path.iterdir()) == []


# --- memory


def test_sizes_are_understood_or_refused():
    assert parse_size("8G") == parse_size("8 GiB") == parse_size("8192M") == 8 * 2**30
    assert parse_size("1.5g") == 1.5 * 2**30
    for words in ("", "8", "8B", "8 apples", "-1G", "G", "8GG", "nan", "0", "0.0G", "9" * 400, "1" + "0" * 400 + "G"):
        with pytest.raises(ValueError, match=r"max-memory is .*, expected a size with its unit, such as 8G"):
            parse_size(words)


TALL = Scene(height=400, width=24, frames=5)


@pytest.fixture(scope="module")
def tall(tmp_path_factory):
    return TALL.write(tmp_path_factory.mktemp("tall"))


@pytest.mark.parametrize("stages", [{"demodulate", "outliers", "warp", "gate", "prefilter"}, {"warp", "refine"}, set()])
def test_a_frame_made_in_parts_is_the_frame(tall, stages, record_property):
    """The promise is 1e-5; the classical chain keeps every bit."""
    shot, number, preset = open_shot(tall), TALL.first + 2, CLASSICAL_PRESETS["final"]  # which reaches furthest
    whole = filter_window(FrameStream(shot, only(stages)).align(number), preset)
    for rows in (64, 320):
        aligner = FrameStream(shot, only(stages))
        parts = []
        for top in range(0, TALL.height, rows):
            aligned = aligner.align(number, slice(top, min(top + rows, TALL.height)))
            parts.append(filter_window(aligned, preset)[aligned.inner])
        np.testing.assert_array_equal(np.concatenate(parts), whole)
    record_property("cases", 2)


def test_an_interrupt_within_a_dispatcher_of_numba_is_one():
    """C code that finds an exception where it expects none raises a SystemError with that as its cause."""
    said = []
    inner, outer = (SystemError("returned a result with an exception set") for _ in range(2))
    inner.__cause__ = KeyboardInterrupt()
    with pytest.raises(KeyboardInterrupt), interruptible(lambda: said.append("3 of 5")):
        raise outer from inner
    assert said == ["3 of 5"]
    with pytest.raises(SystemError), interruptible(lambda: said.append("never")):
        raise SystemError("something else") from ValueError()
    assert said == ["3 of 5"]


@pytest.mark.neural
@pytest.mark.parametrize("rows", [192, *seldom(64)])
def test_the_network_in_parts_is_the_network(tall, rows):
    from hybrid.neural import open_network
    from network.checkpoint import shipped_weights

    shot, number = open_shot(tall), TALL.first + 2
    denoiser = open_network(shipped_weights("fast"), precision="float32")
    stages = {"demodulate", "outliers", "warp"}
    whole = denoiser(
        FrameStream(shot, only(stages), first_pass=Classical(CLASSICAL_PRESETS["draft"])).align(number)
    ).color
    aligner = FrameStream(shot, only(stages), first_pass=Classical(CLASSICAL_PRESETS["draft"]))
    parts = []
    for top in range(0, TALL.height, rows):
        aligned = aligner.align(number, slice(top, min(top + rows, TALL.height)))
        parts.append(denoiser(aligned).color[aligned.inner])
    assert np.abs(np.concatenate(parts) - whole).max() < 1e-5 * whole.mean()


def test_memory_is_planned_or_refused(tall, tmp_path, capsys, monkeypatch):
    shot = open_shot(tall)
    assert plan_memory(2**40, shot, STAGES, None) == (None, False, True)
    assert draft(tall, tmp_path / "out", "--max-memory", "10M") == 1
    assert "expected at least" in capsys.readouterr().err
    monkeypatch.setattr(type(shot), "shape", (2160, 3840))
    rows: list[int] = []
    background: list[bool] = []
    for size in range(2, 33):
        with suppress(ValueError):  # too little
            plan = plan_memory(size * 2**30, shot, STAGES, None)
            rows.append(plan.rows or 2160)
            background.append(plan.background)
            assert plan.in_files or plan.rows is None  # bands of rows cost more than files
    assert rows == sorted(rows)  # more memory, more rows
    assert background == sorted(background)  # and with enough for two more frames these are read and written meanwhile
    assert {*background} == {False, True}
    assert len(set(rows)) > 2
    assert rows[-1] == 2160


PEAKS = [
    # Size, bytes of a pixel that the network takes, OIDN; peak memory of the command with a limit that it is far below.
    ((180, 320), None, 0, 0.27),  # --preset draft
    ((540, 960), None, 0, 0.81),
    ((540, 960), None, HOLDS, 1.17),  # with --first-pass oidn-best
    ((540, 960), None, HOLDS_FAST, 0.76),  # with --first-pass oidn-fast
    ((180, 320), 100, 0, 0.50),  # denoise --preset fast
    ((540, 960), 100, 0, 0.90),
    ((1080, 1920), 100, 0, 2.03),
]


@pytest.mark.parametrize(("size", "scratch", "holds", "peak"), PEAKS)
def test_memory_that_is_planned_is_what_was_measured(tmp_path, monkeypatch, size, scratch, holds, peak):
    """320×180 was refused "at least 2.3 GiB" for a run that peaks at 0.54 GiB."""
    shot = open_shot(Scene(frames=5).write(tmp_path))
    monkeypatch.setattr(type(shot), "shape", size)
    estimates = PerFrame(lambda frame: frame.color, holds=holds)

    def plan(gibibytes):
        def network(shape):
            return None if scratch is None else scratch * shape[0] * shape[1]

        return plan_memory(round(gibibytes * 2**30), shot, WITHOUT_REFLECTIONS, estimates, network=network)

    # OIDN is at its fullest before all frames are there.
    assert plan((1.5 if holds else 1.15) * peak)[:2] == (None, False)
    with suppress(ValueError):
        assert plan(0.85 * peak).in_files


# Peaks were measured on shots where no reflections are followed; with them more is planned.
WITHOUT_REFLECTIONS = Rules().allowed - {"reflections"}
PEAKS_IN_FILES = [
    # Size, bytes of a pixel that the final stage takes, and a first pass; peak memory with whole frames in files, GiB.
    ((1080, 1920), 200, 420, 1.45),  # denoise --preset fast, in float32
    ((1080, 1920), 300, 420, 1.63),  # balanced
    ((1080, 1920), 500, 420, 2.04),  # quality, with windows of seven frames
    ((2160, 3840), 200, 420, 3.44),  # fast
]


@pytest.mark.parametrize(("size", "scratch", "first", "peak"), PEAKS_IN_FILES)
def test_whole_frames_lie_in_files_before_bands_of_rows_are_worked_on(
    tmp_path, monkeypatch, size, scratch, first, peak
):
    """At half the memory `fast` took four times as long as without a limit, as it worked on bands of 64 rows."""
    shot = open_shot(Scene(frames=7).write(tmp_path))
    monkeypatch.setattr(type(shot), "shape", size)

    def plan(gibibytes):
        limit, first_pass = round(gibibytes * 2**30), PerFrame(lambda frame: frame.color)
        pixels = min(size[0] * size[1], size[0] * 2272)  # of a tile
        return plan_memory(
            limit, shot, WITHOUT_REFLECTIONS, first_pass, radius=3 if scratch == 500 else 2,
            network=lambda _: scratch * pixels, first_network=lambda _: first * pixels,
        )  # fmt: skip

    assert plan(1.15 * peak)[:2] == (None, True)
    assert plan(1.06 * peak) == (None, True, False)
    with suppress(ValueError):  # less than the fewest rows take
        assert plan(0.97 * peak).rows is not None


def test_a_frame_of_8k_fits_6_gibibytes(tmp_path, monkeypatch):
    """The comparison of pairs alone took 8.4 GiB. The peak of such a run was 5.6 GiB."""
    shot = open_shot(Scene(frames=3).write(tmp_path))
    monkeypatch.setattr(type(shot), "shape", (4320, 7680))
    first_pass = PerFrame(lambda frame: frame.color)
    plan = plan_memory(parse_size("6GiB"), shot, Rules().allowed, first_pass, network=lambda _: 2**29)
    assert plan.in_files
    assert plan.rows is not None


def test_the_least_memory_that_a_refusal_names_is_enough(tall):
    shot = open_shot(tall)
    with pytest.raises(ValueError, match=r"max-memory is 0\.10 GiB, expected at least (\d\.\d\d) GiB") as error:
        plan_memory(parse_size("0.1G"), shot, STAGES)
    least = str(error.value).split("at least ")[1].split()[0]
    assert plan_memory(parse_size(f"{least}G"), shot, STAGES).rows in (None, 64)


def test_too_little_memory_is_refused_before_any_pixel_is_read(tmp_path, monkeypatch, capsys):
    """Layers were judged first, which asked for gigabytes where data windows lie far apart."""
    for number, at in ((1, 0), (2, 5000)):
        header = {"dataWindow": ((at, at), (at + 7, at + 7)), "displayWindow": ((0, 0), (7, 7))}
        channels = dict.fromkeys("RGB", np.ones((8, 8), np.float32))
        OpenEXR.File({**header, "compression": OpenEXR.ZIP_COMPRESSION}, channels).write(f"{tmp_path}/s.{number}.exr")

    def headers_only(path, *, pixels=True, **options):
        assert not pixels
        return read_exr(path, pixels=False, **options)

    monkeypatch.setattr("hybrid.files.reader.read_exr", headers_only)
    assert draft(tmp_path, tmp_path / "out", "--max-memory", "1G") == 1
    assert "expected at least" in capsys.readouterr().err


def test_little_memory_gives_the_same_bytes(tall, tmp_path, monkeypatch):
    assert draft(tall, tmp_path / "whole") == 0
    monkeypatch.setattr("hybrid.run.job.plan_memory", lambda *_, **__: MemoryPlan(64, True, False))
    monkeypatch.setattr("hybrid.runtime.kept.SMALLEST", 1)
    assert draft(tall, tmp_path / "parts", "--max-memory", "1G") == 0
    assert contents(tmp_path / "whole") == contents(tmp_path / "parts")


@pytest.mark.reliability
def test_one_thread_or_two_give_the_same_bytes(tmp_path):
    folder = Scene(height=80, width=96).write(tmp_path / "in")
    for count in ("1", "2"):
        words = ["-m", "hybrid.cli", "denoise", str(folder), "-o", str(tmp_path / count)]
        words += ["--preset", "standard", "--stages", "refine"]
        done = run_alone(*words, NUMBA_NUM_THREADS=count, OMP_NUM_THREADS=count)
        assert done.returncode == 0, done.stderr
    assert contents(tmp_path / "1") == contents(tmp_path / "2")
