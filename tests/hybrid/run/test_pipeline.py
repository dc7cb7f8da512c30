"""Frames are written in order, one beside the next; whatever goes wrong is told where it was."""

import threading
from dataclasses import replace

import pytest

from hybrid.denoising.plan import Rules
from hybrid.denoising.stabilize import Denoised
from hybrid.files.shots import Shot, open_shot
from hybrid.run import pipeline
from hybrid.run.memory import MemoryPlan
from hybrid.run.pipeline import Finished
from hybrid.runtime.timing import Timings
from tests.scenes import Function, Scene, denoise_view

SCENE = Scene(frames=4, noise=0.1)
FIRST = SCENE.first
# A frame is made of its own window alone.
ALONE = Rules(off=frozenset({"stabilize"}))


@pytest.fixture
def shot(tmp_path):
    return open_shot(SCENE.write(tmp_path / "in"))


def picture(aligned):
    return Denoised(aligned.color[aligned.middle] * aligned.modulation)


def outcomes(frames):
    return [(type(frame).__name__, frame.number) for frame in frames]


def test_a_frame_is_written_while_the_next_one_is_made(tmp_path, shot, monkeypatch):
    at_work, write = threading.Event(), Shot.write
    threads = set()

    def make(aligned):
        if aligned.number == FIRST + 1:
            at_work.set()
        return picture(aligned)

    def write_late(self, path, number, *rest):
        threads.add(threading.current_thread())
        assert number != FIRST or at_work.wait(60)  # would wait in vain if the next one had to wait for this one
        return write(self, path, number, *rest)

    monkeypatch.setattr(Shot, "write", write_late)
    timings = Timings()
    made = list(denoise_view(shot, tmp_path / "out", Function(make), ALONE, timings=timings))
    assert outcomes(made) == [("Finished", number) for number in shot.numbers]
    assert all(frame.path.is_file() and frame.seconds > 0 for frame in made)
    assert threading.main_thread() not in threads
    assert timings.stages["write"].calls == len(made)
    assert timings.stages["write"].cpu_seconds > 0


def test_without_it_a_frame_is_there_before_the_next_one_is_begun(tmp_path, shot, monkeypatch):
    read, whole = [], Shot.read

    def counted(self, number):
        read.append(number)
        return whole(self, number)

    monkeypatch.setattr(Shot, "read", counted)
    begun = []

    def make(aligned):
        begun.append(aligned.number)
        return picture(aligned)

    for frame in denoise_view(shot, tmp_path / "out", Function(make, 1), ALONE, memory=MemoryPlan(background=False)):
        assert frame.path.is_file()
        assert begun[-1] == frame.number
        # Its window, and perhaps one beyond for what shines in a frame alone.
        assert max(read) <= frame.number + 2
    assert sorted(read) == list(shot.numbers)


def test_the_next_frame_is_read_once_one_is_denoised_and_no_sooner(tmp_path, shot, monkeypatch):
    """While one is denoised, memory is at its fullest."""
    begun, read = [], {number: threading.Event() for number in shot.numbers}
    whole, check = Shot.read, pipeline.find_nonfinite

    def told(self, number):
        begun.append(number)
        frame = whole(self, number)
        read[number].set()
        return frame

    def make(aligned):
        assert max(begun) <= aligned.number + 1
        return picture(aligned)

    def check_late(layer):
        assert read[min(max(begun), FIRST + 2)].wait(60)  # of the next window
        return check(layer)

    monkeypatch.setattr(Shot, "read", told)
    monkeypatch.setattr(pipeline, "find_nonfinite", check_late)
    assert len(list(denoise_view(shot, tmp_path / "out", Function(make, 1), ALONE))) == 4


def fail_to_write(monkeypatch, bad):
    write = Shot.write

    def written(self, path, number, *rest):
        if number == bad:
            raise OSError(f"{path}: no space")
        return write(self, path, number, *rest)

    monkeypatch.setattr(Shot, "write", written)


def test_a_frame_that_cannot_be_written_ends_the_run_and_those_before_it_are_there(tmp_path, shot, monkeypatch):
    fail_to_write(monkeypatch, FIRST + 1)
    frames = denoise_view(shot, tmp_path / "out", Function(picture), ALONE)
    assert next(frames).number == FIRST
    with pytest.raises(OSError, match="no space"):
        next(frames)
    assert [path.name for path in (tmp_path / "out").iterdir()] == [shot.path(FIRST).name]


def test_all_others_are_made_in_order_with_keep_going(tmp_path, shot, monkeypatch):
    fail_to_write(monkeypatch, FIRST + 1)

    def make(aligned):
        if aligned.number == FIRST + 2:
            raise ValueError("no picture")
        return picture(aligned)

    frames = list(denoise_view(shot, tmp_path / "out", Function(make), ALONE, keep_going=True))
    assert outcomes(frames) == list(zip(("Finished", "Failed", "Failed", "Finished"), shot.numbers, strict=True))
    assert "no space" in str(frames[1].error)
    assert "no picture" in str(frames[2].error)


@pytest.mark.parametrize("error", [ValueError("no picture"), RuntimeError("a bug"), KeyboardInterrupt()])
def test_the_frame_before_the_one_that_ends_the_run_is_told_first(tmp_path, shot, error):
    def make(aligned):
        if aligned.number == FIRST + 2:
            raise error
        return picture(aligned)

    frames = denoise_view(shot, tmp_path / "out", Function(make), ALONE)
    told = [next(frames), next(frames)]
    with pytest.raises(type(error)):
        next(frames)
    assert outcomes(told) == [("Finished", FIRST), ("Finished", FIRST + 1)]
    assert sorted(path.name for path in (tmp_path / "out").iterdir()) == [f.path.name for f in told]


def test_whoever_stops_listening_finds_whole_frames(tmp_path, shot):
    frames = denoise_view(shot, tmp_path / "out", Function(picture), ALONE)
    next(frames)
    frames.close()
    there = sorted((tmp_path / "out").iterdir())
    assert [path.name for path in there] == [shot.path(number).name for number in (FIRST, FIRST + 1)]
    for frame in denoise_view(shot, tmp_path / "out", Function(picture), ALONE, resume=True):
        assert isinstance(frame, Finished)
        assert frame.resumed == (frame.number <= FIRST + 1)


def test_it_makes_no_difference_to_the_pictures(tmp_path, shot):
    for name, beside in (("one", True), ("other", False)):
        list(denoise_view(shot, tmp_path / name, Function(picture), ALONE, memory=MemoryPlan(background=beside)))
    for path in sorted((tmp_path / "one").iterdir()):
        assert path.read_bytes() == (tmp_path / "other" / path.name).read_bytes()
    wider = replace(SCENE, frames=6).write(tmp_path / "wider")
    steps = open_shot(wider, frames=f"{FIRST}-{FIRST + 4}x2")
    assert len(list(denoise_view(steps, tmp_path / "steps", Function(picture), ALONE))) == 3
