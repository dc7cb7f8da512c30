"""Methods run apart: what they cost is their own, and none is dropped in silence."""

import os
import signal
import time
from collections.abc import Iterator
from dataclasses import replace
from functools import partial
from importlib.util import find_spec
from pathlib import Path
from threading import Thread

import numpy as np
import pytest

from hybrid.comparison import running
from hybrid.comparison.methods import METHODS, Method
from hybrid.comparison.running import RunCost, Seconds, run_in_process, run_method, summarize_runs, time_methods
from hybrid.comparison.store import FrameStore
from hybrid.denoising.oidn import denoise_oidn
from hybrid.files.frame import Frame
from hybrid.runtime import timing
from tests.hybrid.comparison.shots import NOISY, SIZE, Array, MemoryShot, make_shots, perfect, ways

needs_oidn = [pytest.mark.oidn, pytest.mark.skipif(find_spec("pyoidn") is None, reason="pyoidn is not installed")]


# Methods, at module level: they run in another process.


def hungry(shot: MemoryShot, *, megabytes: int) -> Iterator[tuple[int, Array]]:
    for number in shot.numbers:
        yield number, shot.read(number).color + 0 * np.ones(megabytes * 2**18, np.float32)[0]


def not_installed(shot: MemoryShot) -> Iterator[tuple[int, Array]]:
    raise ImportError("needs the package unheard-of")
    yield


def killed(shot: MemoryShot) -> Iterator[tuple[int, Array]]:
    os._exit(9)
    yield


def test_peak_memory_is_the_methods_own() -> None:
    """Neither the comparing process's memory nor that of the method before counts."""
    shot, _ = make_shots()
    ballast = np.ones(300 * 2**18, np.float32)  # 300 MiB in this process
    methods = ways(hungry=partial(hungry, megabytes=200), modest=partial(hungry, megabytes=1))
    runs = time_methods(methods, shot, 1).runs
    assert ballast.nbytes == 300 * 2**20
    # The interpreter and its libraries are in both, and vary by a few MiB from run to run.
    (large,), (small,) = runs["hungry"], runs["modest"]
    assert 180 < (large.peak_bytes - small.peak_bytes) / 2**20 < 220


def test_reading_and_warming_up_are_not_counted(monkeypatch: pytest.MonkeyPatch) -> None:
    class Clock:
        now = 0.0
        compiled = False

        def perf_counter(self) -> float:
            return self.now

        process_time = perf_counter

    clock = Clock()
    monkeypatch.setattr(timing, "time", clock)
    shot, _ = make_shots()

    class SlowShot(MemoryShot):
        def read(self, number: int) -> Frame:
            clock.now += 10
            return super().read(number)

    def method(shot: SlowShot) -> Iterator[tuple[int, Array]]:
        clock.now += 0 if clock.compiled else 1000
        clock.compiled = True
        for number in shot.numbers:
            color = shot.read(number).color
            clock.now += 3
            yield number, color

    run = run_method(Method(method, "Tests"), SlowShot(shot.frames))
    assert run.seconds == run.cpu_seconds == 9
    assert run.megapixels == pytest.approx(3 * SIZE[0] * SIZE[1] / 1e6)


def test_methods_warm_up_with_the_middle_of_large_frames(monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr(running, "WARM_UP", 10)
    shot, _ = make_shots()
    frames = {n: replace(f, aovs={"fog": f.color[..., :1].copy()}) for n, f in shot.frames.items()}
    seen: list[Frame] = []

    def method(shot: MemoryShot) -> Iterator[tuple[int, Array]]:
        for number in shot.numbers:
            seen.append(shot.read(number))
            assert seen[-1].color.shape[:2] == tuple(shot.shape)
            yield number, seen[-1].color

    run = run_method(Method(method, "Tests"), MemoryShot(frames))
    first, *rest = seen
    middle = np.s_[7:17, 11:21]
    for name in ("color", "albedo", "normal", "motion"):
        np.testing.assert_array_equal(getattr(first, name), getattr(frames[4], name)[middle])
    np.testing.assert_array_equal(first.aovs["fog"], frames[4].aovs["fog"][middle])
    assert first.resolution == SIZE  # which motion may be a fraction of
    assert [f.color.shape for f in rest] == [(*SIZE, 3)] * 3
    assert run.megapixels == pytest.approx(3 * SIZE[0] * SIZE[1] / 1e6)


def test_times_are_medians_with_their_range() -> None:
    runs = [RunCost(0.5, seconds, seconds / 2, 0) for seconds in (1.0, 40.0, 2.0)]  # one met something else
    assert summarize_runs(runs) == Seconds(median=4.0, least=2.0, most=80.0, cpu=2.0)


def test_rounds_take_turns_and_what_is_there_already_runs_once(tmp_path: Path) -> None:
    shot, _ = make_shots()
    asked: list[str] = []
    methods = NOISY | ways(a=perfect, gone=not_installed, dead=killed)
    store = FrameStore(tmp_path)
    timed = time_methods(methods, shot, 2, store, asked.append)
    # The second round starts half-way through.
    order = ["noisy", "a", "gone", "dead", "gone", "dead", "noisy", "a"]
    assert asked == [f"run {name}" for name in order]
    assert {name: len(series) for name, series in timed.runs.items()} == {"noisy": 1, "a": 2}
    assert timed.absent == {"gone": "needs the package unheard-of", "dead": "its process died, possibly out of memory"}
    assert store.has("a", 5)


def test_what_has_taken_long_is_not_run_again(monkeypatch: pytest.MonkeyPatch) -> None:
    shot, _ = make_shots()
    seconds = {"a": 1.2 * running.ENOUGH, "b": 0.6 * running.ENOUGH, "c": 0.1 * running.ENOUGH}
    monkeypatch.setattr(running, "run_in_process", lambda _, __, ___, name, store: RunCost(1.0, seconds[name], 1.0, 0))
    runs = time_methods(ways(a=perfect, b=perfect, c=perfect), shot, 4).runs
    assert {name: len(series) for name, series in runs.items()} == {"a": 1, "b": 2, "c": 4}


def test_non_finite_pixels_of_the_render_are_nobodys_fault(tmp_path: Path) -> None:
    shot, _ = make_shots()
    shot.frames[5].color[3, 3] = np.inf
    store = FrameStore(tmp_path)
    run_method(METHODS["noisy"], shot, "noisy", store)
    assert np.isfinite(store.load("noisy", 5)).all()


class TestOidn:
    pytestmark = needs_oidn

    @pytest.mark.parametrize(
        ("name", "prefilter"), [("OIDN high", None), ("OIDN best", "high"), ("OIDN balanced", None)]
    )
    def test_is_a_method(self, tmp_path: Path, name: str, prefilter: str | None) -> None:
        shot, _ = make_shots((7,))
        store = FrameStore(tmp_path)
        run_method(METHODS[name], shot, name, store)
        frame = shot.read(7)
        quality = "balanced" if "balanced" in name else "high"
        expected = denoise_oidn(frame.color, frame.albedo, frame.normal, quality=quality, prefilter=prefilter)
        np.testing.assert_array_equal(store.load(name, 7), expected)


def work(folder: Path) -> None:
    (folder / "begun").touch()
    time.sleep(5)
    (folder / "ended").touch()


@pytest.mark.posix
@pytest.mark.usefixtures("interrupts")
def test_ctrl_c_does_not_wait_for_the_work_of_a_process(tmp_path: Path) -> None:
    def interrupt() -> None:
        while not (tmp_path / "begun").exists():
            time.sleep(0.05)
        os.kill(os.getpid(), signal.SIGINT)

    thread = Thread(target=interrupt)
    thread.start()
    with pytest.raises(KeyboardInterrupt):
        run_in_process(work, tmp_path)
    thread.join()
    assert not (tmp_path / "ended").exists()
