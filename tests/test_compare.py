"""The comparison: each method judged, timed and weighed by itself, and none dropped in silence."""

from __future__ import annotations

import os
from collections.abc import Iterator
from dataclasses import dataclass, replace
from functools import partial
from importlib.util import find_spec
from pathlib import Path

import numpy as np
import pytest
from numpy.typing import NDArray
from rich.console import Console

from hybrid import compare
from hybrid.compare import METHODS, compare_shot, load_frame, motion_between, noisy, result_table, run_method
from hybrid.frames import Frame
from hybrid.metrics import mean_bias, psnr, relmse
from hybrid.oidn import denoise_oidn

Array = NDArray[np.float32]
SIZE = (24, 32)
needs_oidn = [
    pytest.mark.oidn,
    pytest.mark.skipif(find_spec("pyoidn") is None, reason="pyoidn is not installed"),
]


@dataclass
class MemoryShot:
    """What a method uses of a `Shot`, without files."""

    frames: dict[int, Frame]

    @property
    def numbers(self) -> tuple[int, ...]:
        return tuple(self.frames)

    def read(self, number: int) -> Frame:
        return self.frames[number]


def make_shots(numbers: tuple[int, ...] = (4, 5, 6)) -> tuple[MemoryShot, MemoryShot]:
    """A still noisy shot with vectors, and its reference."""
    rng = np.random.default_rng(9)
    albedo = rng.uniform(0.2, 0.9, (*SIZE, 3)).astype(np.float32)
    normal = np.zeros_like(albedo)
    normal[..., 2] = 1
    clean, rendered = {}, {}
    for number in numbers:
        clean[number] = Frame(number, albedo)
        color = (albedo * rng.gamma(4, 0.25, (*SIZE, 1))).astype(np.float32)
        vectors = np.zeros((*SIZE, 4), np.float32)
        rendered[number] = Frame(number, color, albedo, normal, motion=vectors, motion_convention="cycles")
    return MemoryShot(rendered), MemoryShot(clean)


# Methods, at module level: they run in another process.


def perfect(shot: MemoryShot) -> Iterator[tuple[int, Array]]:
    for number in shot.numbers:
        yield number, shot.read(number).albedo


def not_installed(shot: MemoryShot) -> Iterator[tuple[int, Array]]:
    raise ImportError("needs the package unheard-of")
    yield


def killed(shot: MemoryShot) -> Iterator[tuple[int, Array]]:
    os._exit(9)
    yield


def hungry(shot: MemoryShot, *, megabytes: int) -> Iterator[tuple[int, Array]]:
    for number in shot.numbers:
        yield number, shot.read(number).color + 0 * np.ones(megabytes * 2**18, np.float32)[0]


def lazy(shot: MemoryShot) -> Iterator[tuple[int, Array]]:
    yield shot.numbers[0], shot.read(shot.numbers[0]).color


def test_every_method_gets_its_figures_or_its_reason(tmp_path: Path) -> None:
    shot, reference = make_shots()
    methods = {"noisy": noisy, "perfect": perfect, "gone": not_installed, "dead": killed, "again": noisy}
    results = {r.name: r for r in compare_shot(shot, reference, methods, folder=tmp_path)}
    assert list(results) == list(methods)

    measured = results["noisy"].metrics
    for key, measure in {"psnr": psnr, "relmse": relmse, "mean_bias": mean_bias}.items():
        values = [measure(shot.read(n).color, reference.read(n).color) for n in shot.numbers]
        assert measured[key].values == pytest.approx(values)
    assert len(measured["temporal_psnr"].values) == 2
    assert results["again"].metrics == measured
    assert results["perfect"].metrics["psnr"].mean == results["perfect"].metrics["temporal_psnr"].mean == np.inf
    assert results["gone"].absent_reason == "needs the package unheard-of"
    assert "died" in (results["dead"].absent_reason or "")
    assert not results["gone"].metrics
    np.testing.assert_array_equal(load_frame(tmp_path, "noisy", 5), shot.read(5).color)
    np.testing.assert_array_equal(load_frame(tmp_path, "reference", 5), reference.read(5).color)

    console = Console(width=160, record=True, file=open(os.devnull, "w"))  # noqa: SIM115 - of no use after the test
    console.print(result_table(list(results.values())))
    text = console.export_text()
    assert all(name in text for name in methods)
    assert "needs the package unheard-of" in text
    assert "∞" in text
    assert f"{measured['psnr'].mean:.2f}" in text


def test_peak_memory_is_the_methods_own() -> None:
    """Neither the comparing process's memory nor that of the method before counts."""
    shot, reference = make_shots()
    ballast = np.ones(300 * 2**18, np.float32)  # 300 MiB in this process
    methods = {"hungry": partial(hungry, megabytes=200), "modest": partial(hungry, megabytes=1)}
    large, small = compare_shot(shot, reference, methods)
    assert ballast.nbytes == 300 * 2**20
    assert large.peak_bytes is not None
    assert small.peak_bytes is not None
    # The interpreter and its libraries are in both, and vary by a few MiB from run to run.
    assert 180 < (large.peak_bytes - small.peak_bytes) / 2**20 < 220


def test_reading_and_warming_up_are_not_counted(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    class Clock:
        now = 0.0
        compiled = False

        def perf_counter(self) -> float:
            return self.now

        process_time = perf_counter

    clock = Clock()
    monkeypatch.setattr(compare, "time", clock)
    shot, _ = make_shots()

    class SlowShot(MemoryShot):
        def read(self, number: int) -> Frame:
            clock.now += 10
            return super().read(number)

        def window(self, number: int) -> Frame:
            return self.read(number)

    def method(shot: SlowShot) -> Iterator[tuple[int, Array]]:
        clock.now += 0 if clock.compiled else 1000
        clock.compiled = True
        for number in shot.numbers:
            color = shot.window(number).color
            clock.now += 3
            yield number, color

    run = run_method(method, SlowShot(shot.frames), tmp_path, "method")
    assert run.seconds == run.cpu_seconds == 9
    assert run.megapixels == pytest.approx(3 * SIZE[0] * SIZE[1] / 1e6)


def test_only_frames_and_neighbours_that_are_there_are_judged() -> None:
    shot, _ = make_shots((1, 2, 4, 5, 6))
    _, reference = make_shots((1, 2, 4, 6))
    (result,) = compare_shot(shot, reference, {"noisy": noisy})
    assert len(result.metrics["psnr"].values) == 4
    assert len(result.metrics["temporal_psnr"].values) == 1


def test_reference_in_halves_loses_its_noise() -> None:
    """A perfect method is perfect against two noisy references, and is not against one."""
    shot, reference = make_shots()

    def render(seed: int) -> MemoryShot:
        rng = np.random.default_rng(seed)
        gain = {n: 1 + 0.05 * rng.normal(size=(*SIZE, 3)) for n in reference.numbers}
        frames = {n: Frame(n, (f.color * gain[n]).astype(np.float32)) for n, f in reference.frames.items()}
        return MemoryShot(frames)

    halves = render(1), render(2)
    (judged,) = compare_shot(shot, halves, {"perfect": perfect}, measures=("psnr", "ssim", "mean_bias"))
    (fooled,) = compare_shot(shot, halves[0], {"perfect": perfect})
    # 2304 values a frame: what is left of the product of two errors is about 1/50 of their square, 17 dB.
    for key in ("psnr", "temporal_psnr"):
        assert judged.metrics[key].mean > fooled.metrics[key].mean + 8
    # 0.05/√2 noise of the mean over 6912 values: a standard error of 0.05 %.
    assert abs(judged.metrics["mean_bias"].mean) < 0.003


def test_without_vectors_there_is_no_temporal_figure() -> None:
    shot, reference = make_shots()
    still = {n: replace(f, motion=None, motion_convention=None) for n, f in shot.frames.items()}
    (result,) = compare_shot(MemoryShot(still), reference, {"noisy": noisy})
    assert set(result.metrics) == {"psnr", "relmse", "mean_bias"}


def test_wrong_input_is_an_error() -> None:
    shot, reference = make_shots()
    with pytest.raises(ValueError, match="none in common"):
        compare_shot(shot, make_shots((8, 9))[1], {"noisy": noisy})
    with pytest.raises(ValueError, match="'lazy' gave no frame 5"):
        compare_shot(shot, reference, {"lazy": lazy})


class TestMotionBetween:
    """Vectors in Cycles' convention: previous at (x + X, y − Y), next at (x − Z, y + W)."""

    @staticmethod
    def frame(vector: tuple[float, ...] | None, albedo: Array | None = None) -> Frame:
        color = np.ones((*SIZE, 3), np.float32)
        motion = None if vector is None else np.tile(np.float32(vector), (*SIZE, 1))
        convention = {None: None, 4: "cycles", 2: "backward"}[vector and len(vector)]
        return Frame(1, color, albedo, motion=motion, motion_convention=convention)

    def test_valid_where_it_leads_back(self) -> None:
        flow, valid = motion_between(self.frame((0, 0, -3, 1)), self.frame((-3, 1, 0, 0)))
        np.testing.assert_array_equal(flow, np.tile(np.float32((-3, -1)), (*SIZE, 1)))
        expected = np.ones(SIZE, bool)
        expected[:, :3] = expected[:1] = False  # came in from outside
        np.testing.assert_array_equal(valid, expected)

    def test_hidden_and_unknown_pixels_are_not_valid(self) -> None:
        previous, current = self.frame((0, 0, -3, 0)), self.frame((-3, 0, 0, 0))
        previous.motion[10:15, 10:15] = (0, 0, 4, 0)  # something else went the other way
        current.motion[20, 20] = np.nan
        _, valid = motion_between(previous, current)
        assert not valid[10:15, 13:18].any()
        assert not valid[20, 20]
        assert valid[:10, 3:].all()

    def test_albedo_decides_where_there_is_no_way_back(self) -> None:
        albedo = np.full((*SIZE, 3), 0.5, np.float32)
        other = albedo.copy()
        other[5:9, 5:9, 1] = 0.9
        _, valid = motion_between(self.frame((0, 0), other), self.frame((0, 0), albedo))
        assert not valid[5:9, 5:9].any()
        assert valid.sum() == valid.size - 16

    def test_none_without_vectors(self) -> None:
        assert motion_between(self.frame((0, 0)), self.frame(None)) is None


def test_non_finite_pixels_of_the_render_are_nobodys_fault(tmp_path: Path) -> None:
    shot, _ = make_shots()
    shot.frames[5].color[3, 3] = np.inf
    run_method(noisy, shot, tmp_path, "noisy")
    assert np.isfinite(load_frame(tmp_path, "noisy", 5)).all()


class TestOidn:
    pytestmark = needs_oidn

    @pytest.mark.parametrize(("name", "prefilter"), [("OIDN high", False), ("OIDN best", True)])
    def test_is_a_method(self, tmp_path: Path, name: str, prefilter: bool) -> None:
        shot, _ = make_shots((7,))
        run_method(METHODS[name], shot, tmp_path, name)
        frame = shot.read(7)
        expected = denoise_oidn(frame.color, frame.albedo, frame.normal, prefilter=prefilter)
        np.testing.assert_array_equal(load_frame(tmp_path, name, 7), expected)
