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

from flow.motion import CYCLES, MotionConvention
from hybrid.comparison import compare
from hybrid.comparison.compare import (
    Run,
    compare_shot,
    load_frame,
    map_titles,
    motion_between,
    result_table,
    run_method,
    spread_seconds,
)
from hybrid.comparison.methods import METHODS, Frames, Method, external, noisy
from hybrid.comparison.metrics import mean_bias, psnr, relmse
from hybrid.files.frames import Frame
from hybrid.oidn import denoise_oidn

Array = NDArray[np.float32]
SIZE = (24, 32)
QUICK = ("psnr", "relmse", "mean_bias")
needs_oidn = [
    pytest.mark.oidn,
    pytest.mark.skipif(find_spec("pyoidn") is None, reason="pyoidn is not installed"),
]


@dataclass(eq=False)
class MemoryShot:
    """What a method uses of a `Shot`, without files."""

    frames: dict[int, Frame]

    @property
    def numbers(self) -> tuple[int, ...]:
        return tuple(self.frames)

    def has(self, number: int) -> bool:
        return number in self.frames

    step = 1

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
        rendered[number] = Frame(number, color, albedo, normal, motion=vectors, motion_convention=CYCLES)
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


def with_maps(shot: MemoryShot) -> Iterator[tuple[int, dict[str, Array]]]:
    for number in shot.numbers:
        yield number, {"Confidence": np.full(SIZE, 0.5, np.float32)}


def lazy(shot: MemoryShot) -> Iterator[tuple[int, Array]]:
    yield shot.numbers[0], shot.read(shot.numbers[0]).color


def ways(**runs: Frames) -> dict[str, Method]:
    return {name: Method(run, "Tests") for name, run in runs.items()}


NOISY = {"noisy": METHODS["noisy"]}


def test_every_method_gets_its_figures_or_its_reason(tmp_path: Path) -> None:
    shot, reference = make_shots()
    methods = NOISY | ways(perfect=perfect, gone=not_installed, dead=killed, again=noisy)
    results = {r.name: r for r in compare_shot(shot, reference, methods, measures=QUICK, folder=tmp_path).results}
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
    methods = ways(hungry=partial(hungry, megabytes=200), modest=partial(hungry, megabytes=1))
    large, small = compare_shot(shot, reference, methods, measures=QUICK).results
    assert ballast.nbytes == 300 * 2**20
    assert large.peak_bytes is not None
    assert small.peak_bytes is not None
    # The interpreter and its libraries are in both, and vary by a few MiB from run to run.
    assert 180 < (large.peak_bytes - small.peak_bytes) / 2**20 < 220


def test_reading_and_warming_up_are_not_counted(monkeypatch: pytest.MonkeyPatch) -> None:
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


def test_times_are_medians_with_their_range() -> None:
    runs = {"a": [Run(0.5, seconds, seconds / 2, 0) for seconds in (1.0, 40.0, 2.0)]}  # one met something else
    assert spread_seconds(runs) == {"a": (4.0, 2.0, 80.0, 2.0)}


def test_rounds_take_turns_and_what_is_there_already_runs_once() -> None:
    shot, reference = make_shots()
    asked: list[str] = []
    methods = NOISY | ways(a=perfect, b=perfect, c=perfect)
    comparison = compare_shot(
        shot, reference, methods, measures=QUICK, rounds=2, progress=lambda what, done, total: asked.append(what)
    )
    assert asked[:8] == ["noisy", "a", "b", "c", "b", "c", "noisy", "a"]
    noisy_result, a, *_ = comparison.results
    assert (noisy_result.seconds_per_megapixel, noisy_result.spread) == (0, None)
    assert a.spread is not None
    assert a.spread[0] <= (a.seconds_per_megapixel or 0) <= a.spread[1]


def test_a_finished_sequence_is_judged_and_not_timed() -> None:
    shot, reference = make_shots()
    other = MemoryShot({n: Frame(n, f.color * np.float32(1.1)) for n, f in reference.frames.items()})
    (result,) = compare_shot(shot, reference, {"theirs": external(other)}, measures=QUICK).results
    assert result.metrics["mean_bias"].mean == pytest.approx(0.1, abs=1e-6)
    assert result.seconds_per_megapixel is None
    assert result.peak_bytes is None
    del other.frames[5]
    with pytest.raises(ValueError, match="'theirs' gave no frame 5"):
        compare_shot(shot, reference, {"theirs": external(other)}, measures=QUICK)


def test_worth_in_samples_follows_the_levels() -> None:
    """Gamma noise at 4, 8 and 16 samples, a method whose error is that of 16: worth twice the shot's 8."""

    def render(samples: int, seed: int) -> MemoryShot:
        rng = np.random.default_rng(seed)
        _, clean = make_shots()
        grain = {n: 1 + 0.4 / np.sqrt(samples) * rng.normal(size=(*SIZE, 3)) for n in clean.numbers}
        return MemoryShot({n: Frame(n, (f.color * grain[n]).astype(np.float32)) for n, f in clean.frames.items()})

    _, reference = make_shots()
    methods = NOISY | {"better": external(render(16, 1))}
    comparison = compare_shot(
        render(8, 2), reference, methods, measures=QUICK, samples=8, levels=[(render(4, 3), 4), (render(64, 4), 64)]
    )
    # 6912 squared errors: 1.7 % each of method and level, doubled by the reading between levels.
    assert comparison.results[1].worth == pytest.approx(2, rel=0.07)
    assert "as 1/n asks" in comparison.facts["Worth in samples"]
    # A clean reference: what is left for its noise is far below the least error that was measured.
    assert "measured levels" in comparison.facts["Reference"]


def test_maps_are_left_for_the_page(tmp_path: Path) -> None:
    shot, reference = make_shots()
    methods = NOISY | {"mapped": Method(perfect, "Tests", with_maps)}
    compare_shot(shot, reference, methods, measures=("psnr",), maps=True, folder=tmp_path)
    assert map_titles(tmp_path, "noisy", 5) == []
    assert map_titles(tmp_path, "mapped", 5) == ["Confidence"]
    assert load_frame(tmp_path, "mapped map Confidence", 5).shape == SIZE


def test_static_pixels_flicker_by_what_was_put_in() -> None:
    """A still shot whose reference stands still: the deviation over time is that of the noise put in."""
    _, clean = make_shots(tuple(range(1, 9)))
    sigma = 0.02
    rng = np.random.default_rng(3)
    frames = {}
    for number, frame in clean.frames.items():
        tone = frame.color / (1 + frame.color) + sigma * rng.normal(size=frame.color.shape)
        vectors = np.zeros((*SIZE, 4), np.float32)
        color = (tone / (1 - tone)).astype(np.float32)
        frames[number] = Frame(number, color, motion=vectors, motion_convention=CYCLES)
    comparison = compare_shot(MemoryShot(frames), clean, NOISY, measures=QUICK)
    assert comparison.facts["Pixels that stand still"] == "100.0%"
    # 2304 values × 7 degrees of freedom: a standard error of 0.6 %.
    assert comparison.results[0].metrics["static_std"].mean == pytest.approx(sigma, rel=0.03)


def test_only_frames_and_neighbours_that_are_there_are_judged() -> None:
    shot, _ = make_shots((1, 2, 4, 5, 6))
    _, reference = make_shots((1, 2, 4, 6))
    (result,) = compare_shot(shot, reference, NOISY, measures=QUICK).results
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
    comparison = compare_shot(shot, halves, ways(perfect=perfect), measures=("psnr", "ssim", "mean_bias"))
    (judged,) = comparison.results
    (fooled,) = compare_shot(shot, halves[0], ways(perfect=perfect), measures=QUICK).results
    # 2304 values a frame: what is left of the product of two errors is about 1/50 of their square, 17 dB.
    for key in ("psnr", "temporal_psnr"):
        assert judged.metrics[key].mean > fooled.metrics[key].mean + 8
    # 0.05/√2 noise of the mean over 6912 values: a standard error of 0.05 %.
    assert abs(judged.metrics["mean_bias"].mean) < 0.003


def test_without_vectors_there_is_no_temporal_figure() -> None:
    shot, reference = make_shots()
    still = {n: replace(f, motion=None, motion_convention=None) for n, f in shot.frames.items()}
    comparison = compare_shot(MemoryShot(still), reference, NOISY, measures=QUICK)
    assert set(comparison.results[0].metrics) == {"psnr", "relmse", "mean_bias"}
    assert comparison.facts["Pixels that stand still"] == "0.0%"


def test_wrong_input_is_an_error() -> None:
    shot, reference = make_shots()
    with pytest.raises(ValueError, match="none in common"):
        compare_shot(shot, make_shots((8, 9))[1], NOISY)
    with pytest.raises(ValueError, match="'lazy' gave no frame 5"):
        compare_shot(shot, reference, ways(lazy=lazy))


def test_wrong_input_is_found_before_any_method_runs(monkeypatch: pytest.MonkeyPatch) -> None:
    """A long comparison must not end in an error that could have been seen at its start."""
    monkeypatch.setattr(compare, "time_methods", lambda *_, **__: pytest.fail("methods were run"))
    shot, reference = make_shots()
    small = MemoryShot({n: Frame(n, f.color[:, 1:]) for n, f in shot.frames.items()})
    short = MemoryShot({n: f for n, f in reference.frames.items() if n != 5})

    def refuses(words: str, methods: dict[str, Method] = NOISY, *, reference=reference, **more: object) -> None:
        with pytest.raises(ValueError, match=words):
            compare_shot(shot, reference, methods, measures=QUICK, **more)

    refuses("frame 4 of reference is 31x24, expected 32x24", reference=small)
    refuses("frame 4 of reference is 31x24, expected 32x24", reference=(reference, small))
    refuses("'theirs' gave no frame 5, expected all of 4–6", NOISY | {"theirs": external(short)})
    refuses("frame 4 of method 'theirs' is 31x24, expected 32x24", NOISY | {"theirs": external(small)})
    refuses("levels need the samples per pixel of the shot", levels=[(shot, 4)])
    refuses("expected the method 'noisy'", ways(perfect=perfect), samples=8, levels=[(shot, 4)])
    refuses("expected some of 4–6", samples=8, levels=[(make_shots((8, 9))[0], 4)])
    refuses("frame 4 of level of 4 samples is 31x24", samples=8, levels=[(small, 4)])


class TestMotionBetween:
    """Vectors in Cycles' convention: previous at (x + X, y − Y), next at (x − Z, y + W)."""

    @staticmethod
    def frame(vector: tuple[float, ...] | None, albedo: Array | None = None) -> Frame:
        color = np.ones((*SIZE, 3), np.float32)
        motion = None if vector is None else np.tile(np.float32(vector), (*SIZE, 1))
        convention = {None: None, 4: CYCLES, 2: MotionConvention()}[vector and len(vector)]
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
    run_method(METHODS["noisy"], shot, "noisy", tmp_path)
    assert np.isfinite(load_frame(tmp_path, "noisy", 5)).all()


class TestOidn:
    pytestmark = needs_oidn

    @pytest.mark.parametrize(
        ("name", "prefilter"), [("OIDN high", None), ("OIDN best", "high"), ("OIDN balanced", None)]
    )
    def test_is_a_method(self, tmp_path: Path, name: str, prefilter: str | None) -> None:
        shot, _ = make_shots((7,))
        run_method(METHODS[name], shot, name, tmp_path)
        frame = shot.read(7)
        quality = "balanced" if "balanced" in name else "high"
        expected = denoise_oidn(frame.color, frame.albedo, frame.normal, quality=quality, prefilter=prefilter)
        np.testing.assert_array_equal(load_frame(tmp_path, name, 7), expected)
