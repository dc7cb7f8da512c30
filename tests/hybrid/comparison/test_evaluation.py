from dataclasses import replace
from pathlib import Path
from threading import Barrier

import numpy as np
import pytest

from flow.motion import CYCLES, MotionConvention
from hybrid.comparison import evaluation
from hybrid.comparison.compare import CompareOptions, compare_shot
from hybrid.comparison.evaluation import motion_between
from hybrid.comparison.flip import flip_maps
from hybrid.comparison.methods import external
from hybrid.comparison.store import CHANGE_MAP, FLIP_MAP, FrameStore
from hybrid.files.frame import Frame
from tests.hybrid.comparison.shots import NOISY, SIZE, Array, MemoryShot, make_shots, perfect, use_this_process, ways

here = pytest.fixture(use_this_process, autouse=True)


def test_worth_in_samples_follows_the_levels() -> None:
    """Gamma noise at 4, 8 and 16 samples, a method whose error is that of 16: worth twice the shot's 8."""

    def render(samples: int, seed: int) -> MemoryShot:
        rng = np.random.default_rng(seed)
        _, clean = make_shots()
        grain = {n: 1 + 0.4 / np.sqrt(samples) * rng.normal(size=(*SIZE, 3)) for n in clean.numbers}
        return MemoryShot({n: Frame(n, (f.color * grain[n]).astype(np.float32)) for n, f in clean.frames.items()})

    _, reference = make_shots()
    methods = NOISY | {"better": external(render(16, 1))}
    options = CompareOptions(samples=8, levels=[(render(4, 3), 4), (render(64, 4), 64)])
    comparison = compare_shot(render(8, 2), reference, methods, options)
    # 6912 squared errors: 1.7 % each of method and level, doubled by the reading between levels.
    assert comparison.results[1].worth == pytest.approx(2, rel=0.07)
    assert "close to 1/n" in comparison.facts["Worth in samples"]
    # A clean reference: what is left for its noise is far below the least error that was measured.
    assert "measured levels" in comparison.facts["Reference"]


def test_what_changes_between_frames_is_kept_as_a_map(tmp_path: Path) -> None:
    """A wall is brighter by 1/100 of the tone curve on one frame: a quarter above gray there, and below after it."""
    tones = {1: 0.5, 2: 0.5, 3: 0.51, 4: 0.5, 6: 0.5}
    frames = {}
    for number, tone in tones.items():
        color = np.full((*SIZE, 3), tone / (1 - tone), np.float32)
        vectors = np.zeros((*SIZE, 4), np.float32)
        frames[number] = Frame(number, color, motion=vectors, motion_convention=CYCLES)
    reference = MemoryShot({n: Frame(n, np.full((*SIZE, 3), 1.0, np.float32)) for n in tones})
    compare_shot(MemoryShot(frames), reference, NOISY, folder=tmp_path)
    store = FrameStore(tmp_path)
    assert store.has("noisy", 1, CHANGE_MAP)
    maps = {number: store.load("noisy", number, CHANGE_MAP) for number in tones}
    # The frame after a gap has none before it: gray.
    expected = {1: 0.5, 2: 0.5, 3: 0.75, 4: 0.25, 6: 0.5}
    for number, value in expected.items():
        np.testing.assert_allclose(maps[number][4:-4, 4:-4], value, atol=1e-3)


def test_flip_is_the_mean_of_its_maps(tmp_path: Path) -> None:
    """At the exposure of the comparison, of every frame."""
    shot, reference = make_shots((1, 2, 4))
    methods = NOISY | ways(perfect=perfect)
    results = compare_shot(shot, reference, methods, CompareOptions(exposure=2.0), folder=tmp_path).results
    expected = [flip_maps([2 * shot.read(n).color], 2 * reference.read(n).color)[0].mean() for n in shot.numbers]
    assert results[0].metrics["flip"].values == pytest.approx(expected, rel=1e-5)  # means of float32
    assert results[1].metrics["flip"].mean == 0
    store = FrameStore(tmp_path)
    assert [float(store.load("noisy", n, FLIP_MAP).mean()) for n in shot.numbers] == pytest.approx(expected, rel=1e-5)


def test_the_shots_exposure_reaches_every_measure() -> None:
    """Very little light at a high exposure has the measures of as much light as the exposure makes of it.

    FLIP finds exposures of its own; they agree for all light but that below `hybrid.comparison.flip.BLACK`.
    """
    shot, reference = make_shots()

    def darker(frames: MemoryShot) -> MemoryShot:
        return MemoryShot({n: replace(f, color=f.color / 2**20) for n, f in frames.frames.items()})

    (expected,) = compare_shot(shot, reference, NOISY).results
    (exposed,) = compare_shot(darker(shot), darker(reference), NOISY, CompareOptions(exposure=2.0**20)).results
    (dark,) = compare_shot(darker(shot), darker(reference), NOISY).results
    keys = set(expected.metrics) - {"mean_bias"}
    assert keys == {"psnr", "ssim", "relmse", "relmse_trimmed", "smape", "flip", "temporal_psnr"}
    for key in keys:
        assert exposed.metrics[key].values == pytest.approx(expected.metrics[key].values, rel=1e-4), key
        assert dark.metrics[key].mean != pytest.approx(expected.metrics[key].mean, rel=1e-2), key


def test_temporal_psnr_follows_the_motion() -> None:
    """An error that moves with its surface is no flicker, whatever the pixels beside it are."""
    rng = np.random.default_rng(7)
    texture = rng.uniform(0.2, 0.8, (SIZE[0], SIZE[1] + 8, 3)).astype(np.float32)
    error = (1 + 0.1 * rng.normal(size=texture.shape)).astype(np.float32)
    clean, rendered = {}, {}
    for number in (1, 2, 3):
        part = np.s_[:, 8 - 2 * number : 8 - 2 * number + SIZE[1]]  # moves to the right by two pixels a frame
        vectors = np.zeros((*SIZE, 4), np.float32)
        vectors[..., 0], vectors[..., 2] = -2, -2  # previous at (x + X, y − Y), next at (x − Z, y + W)
        clean[number] = Frame(number, texture[part].copy())
        color = (texture * error)[part].copy()
        rendered[number] = Frame(number, color, motion=vectors, motion_convention=CYCLES)
    (result,) = compare_shot(MemoryShot(rendered), MemoryShot(clean), NOISY).results
    assert result.metrics["psnr"].mean < 40
    assert result.metrics["temporal_psnr"].mean > 80


def test_frames_are_measured_side_by_side(monkeypatch: pytest.MonkeyPatch) -> None:
    """Two frames wait for each other; the figures are in the order of the frames."""
    both = Barrier(2, timeout=60)
    monkeypatch.setattr(evaluation, "AT_ONCE", 2)
    shot, reference = make_shots((1, 2))
    alone = compare_shot(shot, reference, NOISY).results[0].metrics

    def meet(image: Array, *_: object) -> float:
        both.wait()
        return float(image.mean())

    monkeypatch.setitem(evaluation.MEASURES, "smape", meet)
    together = compare_shot(shot, reference, NOISY).results[0].metrics
    assert together["smape"].values == tuple(float(shot.read(number).color.mean()) for number in (1, 2))
    assert together["psnr"] == alone["psnr"]


def test_only_frames_and_neighbours_that_are_there_are_judged() -> None:
    shot, _ = make_shots((1, 2, 4, 5, 6))
    _, reference = make_shots((1, 2, 4, 6))
    (result,) = compare_shot(shot, reference, NOISY).results
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
    comparison = compare_shot(shot, halves, ways(perfect=perfect))
    (judged,) = comparison.results
    (fooled,) = compare_shot(shot, halves[0], ways(perfect=perfect)).results
    # 2304 values a frame: what is left of the product of two errors is about 1/50 of their square, 17 dB.
    for key in ("psnr", "temporal_psnr"):
        assert judged.metrics[key].mean > fooled.metrics[key].mean + 8
    # 0.05/√2 noise of the mean over 6912 values: a standard error of 0.05 %.
    assert abs(judged.metrics["mean_bias"].mean) < 0.003


def test_without_vectors_there_is_no_temporal_figure() -> None:
    shot, reference = make_shots()
    still = {n: replace(f, motion=None, motion_convention=None) for n, f in shot.frames.items()}
    comparison = compare_shot(MemoryShot(still), reference, NOISY)
    assert "temporal_psnr" not in comparison.results[0].metrics
    assert "psnr" in comparison.results[0].metrics


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
