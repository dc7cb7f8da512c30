"""The comparison: each method judged, timed and weighed by itself, and none dropped in silence."""

from dataclasses import replace
from functools import partial
from pathlib import Path

import numpy as np
import pytest

from hybrid.comparison import compare
from hybrid.comparison.compare import CompareOptions, compare_shot
from hybrid.comparison.ladder import LEAST_ERROR
from hybrid.comparison.methods import Method, external, noisy
from hybrid.comparison.metrics import mean_bias, psnr, relmse
from hybrid.comparison.store import CHANGE_MAP, FLIP_MAP, MAP_TITLES, REFERENCE, FrameStore
from hybrid.files.frame import Frame
from tests.hybrid.comparison.shots import NOISY, SIZE, MemoryShot, make_shots, perfect, use_this_process, ways
from tests.hybrid.comparison.test_running import killed, not_installed

here = pytest.fixture(use_this_process, autouse=True)

# Methods, at module level: they run in another process.


def test_every_method_gets_its_figures_or_its_reason(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.undo()  # in processes of their own: one dies
    shot, reference = make_shots()
    methods = NOISY | ways(perfect=perfect, gone=not_installed, dead=killed, again=noisy)
    results = {r.name: r for r in compare_shot(shot, reference, methods, folder=tmp_path).results}
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
    store = FrameStore(tmp_path)
    np.testing.assert_array_equal(store.load("noisy", 5), shot.read(5).color)
    np.testing.assert_array_equal(store.load(REFERENCE, 5), reference.read(5).color)


def test_a_finished_sequence_is_judged_and_not_timed() -> None:
    shot, reference = make_shots()
    other = MemoryShot({n: Frame(n, f.color * np.float32(1.1)) for n, f in reference.frames.items()})
    (result,) = compare_shot(shot, reference, {"theirs": external(other)}).results
    assert result.metrics["mean_bias"].mean == pytest.approx(0.1, abs=1e-6)
    assert result.seconds_per_megapixel is None
    assert result.peak_bytes is None
    del other.frames[5]
    with pytest.raises(ValueError, match="'theirs' gave no frame 5"):
        compare_shot(shot, reference, {"theirs": external(other)})


def test_methods_run_on_the_levels_of_a_ladder() -> None:
    """Finished frames show the shot alone."""
    shot, reference = make_shots()
    halfway = {n: (f.color + reference.read(n).color) / 2 for n, f in shot.frames.items()}
    level = MemoryShot({n: replace(f, color=halfway[n]) for n, f in shot.frames.items()})
    methods = NOISY | ways(perfect=perfect, gone=not_installed) | {"theirs": external(reference)}
    steps: list[str] = []
    options = CompareOptions(samples=32, levels=[(level, 8)])
    run = partial(compare_shot, shot, reference, methods, on_step=steps.append)
    comparison = run(replace(options, ladder=True))
    curves = comparison.ladder["psnr"]
    assert curves.keys() == {"noisy", "perfect"}
    for (samples, error), frames in zip(curves["noisy"], (level, shot), strict=True):
        errors = [10 ** (-psnr(frames.read(n).color, reference.read(n).color) / 10) for n in shot.numbers]
        assert (samples, error) == (8 if frames is level else 32, pytest.approx(np.mean(errors)))
    assert curves["perfect"] == ((8, LEAST_ERROR), (32, LEAST_ERROR))
    assert comparison.ladder.keys() == {"psnr", "temporal_psnr", "flip"}
    assert len(steps) <= compare.count_steps(methods, replace(options, ladder=True))
    assert [result.name for result in comparison.results] == list(methods)
    assert run(options).ladder == {}


def test_maps_are_left_for_the_page(tmp_path: Path) -> None:
    shot, reference = make_shots()
    compare_shot(shot, reference, NOISY, folder=tmp_path)
    store = FrameStore(tmp_path)
    assert [title for title in MAP_TITLES if store.has("noisy", 5, title)] == [FLIP_MAP, CHANGE_MAP]
    assert store.load("noisy", 5, FLIP_MAP).shape == SIZE


def test_progress_says_what_is_being_done() -> None:
    shot, reference = make_shots()
    told: list[str] = []
    methods = NOISY | ways(perfect=perfect, gone=not_installed)
    compare_shot(shot, reference, methods, on_step=told.append)
    assert compare.count_steps(methods, CompareOptions()) == 8
    assert told == [
        "read the shot, its motion and the reference",
        "run noisy",
        "run perfect",
        "run gone",
        "FLIP of all methods",
        "measure noisy",
        "measure perfect",  # what is not there is not measured
    ]


def test_findings_of_the_background_check_are_a_fact() -> None:
    shot, reference = make_shots()
    options = CompareOptions(findings=["no depth"], check_shot=lambda: ["a cut"])
    facts = compare_shot(shot, reference, NOISY, options).facts
    assert facts["Layers"] == "no depth; a cut"


def test_wrong_input_is_an_error() -> None:
    shot, _ = make_shots()
    with pytest.raises(ValueError, match="none in common"):
        compare_shot(shot, make_shots((8, 9))[1], NOISY)


def test_wrong_input_is_found_before_any_method_runs(monkeypatch: pytest.MonkeyPatch) -> None:
    """A long comparison must not end in an error that could have been seen at its start."""
    monkeypatch.setattr(compare, "time_methods", lambda *_, **__: pytest.fail("methods were run"))
    shot, reference = make_shots()
    small = MemoryShot({n: Frame(n, f.color[:, 1:]) for n, f in shot.frames.items()})
    short = MemoryShot({n: f for n, f in reference.frames.items() if n != 5})

    def refuses(words: str, methods: dict[str, Method] = NOISY, *, reference=reference, **more: object) -> None:
        with pytest.raises(ValueError, match=words):
            compare_shot(shot, reference, methods, CompareOptions(**more))

    refuses("frame 4 of reference is 31x24, expected 32x24", reference=small)
    refuses("frame 4 of reference is 31x24, expected 32x24", reference=(reference, small))
    refuses("'theirs' gave no frame 5, expected all of 4–6", NOISY | {"theirs": external(short)})
    refuses("frame 4 of method 'theirs' is 31x24, expected 32x24", NOISY | {"theirs": external(small)})

    def look() -> list[str]:
        raise ValueError("this shot is cut")

    refuses("this shot is cut", check_shot=look)
    refuses("levels need the samples per pixel of the shot", levels=[(shot, 4)])
    refuses("expected the method 'noisy'", ways(perfect=perfect), samples=8, levels=[(shot, 4)])
    refuses("expected some of 4–6", samples=8, levels=[(make_shots((8, 9))[0], 4)])
    refuses("frame 4 of level of 4 samples is 31x24", samples=8, levels=[(small, 4)])
    refuses("ladder has 8 samples per pixel twice", samples=8, levels=[(shot, 8)], ladder=True)
    refuses("level of 4 samples has no frame 5", samples=8, levels=[(short, 4)], ladder=True)
