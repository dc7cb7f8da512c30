"""The sweep: each point varies what its name says, and nothing else."""

from __future__ import annotations

from dataclasses import replace

import numpy as np
import pytest

from hybrid.comparison import methods
from hybrid.comparison.methods import METHODS
from hybrid.comparison.sweep import CLASSICAL, KERNELS, NETWORK, sweep_methods
from hybrid.denoising.plan import STAGES
from hybrid.denoising.stream import plan_shot
from hybrid.files.shots import Shot, open_shot
from tests.scenes import Scene

SCENE = Scene(frames=3, height=32, width=40)


@pytest.fixture(scope="module")
def shot(tmp_path_factory: pytest.TempPathFactory) -> Shot:
    return open_shot(SCENE.write(tmp_path_factory.mktemp("shot")))


def test_every_decision_is_turned_once(shot: Shot) -> None:
    plan = plan_shot(shot)
    swept = sweep_methods(plan)
    stages = {next(iter(m.settings)): m for m in swept.values() if m.sweep == "Stages"}
    assert set(STAGES) - {"alpha"} <= set(stages)
    for decision in plan.decisions:
        if decision.stage in stages:
            assert stages[decision.stage].settings[decision.stage] == ("off" if decision.on else "on")
    assert {m.sweep for m in swept.values()} == {
        "Stages", "Window", "TV-L1", "NLM", "Kernel threshold", "Precision", "Tile", "Threads",
    }  # fmt: skip
    assert {m.base for m in swept.values()} == {CLASSICAL, NETWORK, KERNELS}


def test_variants_run_and_differ_from_their_base_where_they_should(shot: Shot) -> None:
    swept = sweep_methods(plan_shot(shot))

    def first(name: str) -> np.ndarray:
        return next(swept[name].run(shot))[1]

    base = next(METHODS[CLASSICAL].run(shot))[1]
    np.testing.assert_array_equal(first("standard, window 5"), base)
    np.testing.assert_array_equal(first("standard, radius 3 patch 2"), base)
    for name in (
        "window 1",
        "demodulate off",
        "warp off",
        "dense-flow on",
        "guided filter off",
        "radius 7 patch 2",
    ):
        assert not np.array_equal(first(f"standard, {name}"), base), name


def test_settings_of_the_solver_reach_it(shot: Shot, monkeypatch: pytest.MonkeyPatch) -> None:
    seen = []

    def spy(*arguments: np.ndarray, **settings: object) -> np.ndarray:
        seen.append(settings)
        return arguments[1]

    monkeypatch.setattr(methods, "refine_flow", spy)
    run = METHODS[CLASSICAL].run
    solver = {"scales": 1, "warps": 2, "iterations": 10}
    next(replace(run, window=replace(run.window, solver=solver))(shot))
    assert seen
    assert all({"scales": 1, "warps": 2, "iterations": 10}.items() <= settings.items() for settings in seen)


def test_a_threshold_changes_the_network(shot: Shot) -> None:
    pytest.importorskip("torch")
    low, high = (next(replace(METHODS[KERNELS].run, threshold=t)(shot))[1] for t in (0.0, 0.75))
    assert not np.array_equal(low, high)
