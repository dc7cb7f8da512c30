"""Variants of methods for `ravg compare --sweep`: one setting varied at a time."""

import os
from collections.abc import Iterator, Mapping
from dataclasses import replace
from functools import partial
from itertools import product
from typing import Any

from hybrid.comparison.methods import METHODS, Classical, Method, Network, Run, WindowSettings
from hybrid.denoising.plan import Plan, Rules
from hybrid.denoising.pseudo_reference import STANDARD, ClassicalPreset, filter_window

# Methods that are varied: the middle classical preset, and networks.
CLASSICAL, NETWORK, KERNELS = "standard", "fast without OIDN", "tKPCN"

RADII = (0, 1, 2, 3)  # windows of 1, 3, 5 and 7 frames
SCALES, WARPS, ITERATIONS = (1, 3), (1, 3), (10, 30)  # of TV-L1
NLM_RADII, PATCH_RADII = (1, 2, 3, 5, 7), (1, 2, 3)
THRESHOLDS = (0.0, 0.25, 0.5, 0.75)  # of the kernels, in units of 1/K
PRECISIONS = ("float32", "bfloat16")
TILES = (64, 128, 256, 512)
THREADS = tuple(n for n in (1, 2, 4, 8, 16) if n <= (os.cpu_count() or 1))


def sweep_methods(plan: Plan) -> dict[str, Method]:
    """Return variants by a name that states the varied setting; each stage is switched to the opposite of the plan."""
    return dict([*_stages(plan), *_filters(), *_networks(), *_threads()])


def _variant(sweep: str, base: str, settings: Mapping[str, object], run: Run) -> tuple[str, Method]:
    words = " ".join(f"{key} {value}" for key, value in settings.items())
    return f"{base}, {words}", Method(run, METHODS[base].family, settings=settings, sweep=sweep, base=base)


def _classical(window: WindowSettings | None = None, preset: ClassicalPreset = STANDARD) -> Classical:
    """`CLASSICAL` with other settings of its windows or its filters."""
    return Classical(partial(filter_window, preset=preset), window or WindowSettings())


def _network_run(base: str) -> Network:
    run = METHODS[base].run
    assert isinstance(run, Network)
    return run


def _stages(plan: Plan) -> Iterator[tuple[str, Method]]:
    for decision in plan.decisions:
        inverted = "off" if decision.on else "on"
        settings, rules = {decision.stage: inverted}, Rules(**{inverted: frozenset({decision.stage})})
        if decision.stage == "dense-flow":
            if not decision.on:  # there are vectors; dense flow replaces them
                yield _variant("Stages", CLASSICAL, settings, _classical(WindowSettings(vectors=False)))
        elif decision.stage == "skip":  # a stage of the networks' tiles
            run = _network_run(NETWORK)
            yield _variant("Stages", NETWORK, settings, replace(run, window=replace(run.window, rules=rules)))
        elif decision.stage != "alpha":  # without effect on the color
            yield _variant("Stages", CLASSICAL, settings, _classical(WindowSettings(rules=rules)))
    without = {"guided filter": replace(STANDARD, guided_radius=0), "NLM": replace(STANDARD, nlm_radius=0)}
    for stage, preset in without.items():
        yield _variant("Stages", CLASSICAL, {stage: "off"}, _classical(preset=preset))


def _filters() -> Iterator[tuple[str, Method]]:
    """Lengths of the window, settings of TV-L1, and radii of the non-local means."""
    for radius in RADII:
        yield _variant("Window", CLASSICAL, {"window": 2 * radius + 1}, _classical(WindowSettings(radius=radius)))
    for scales, warps, iterations in product(SCALES, WARPS, ITERATIONS):
        solver = {"scales": scales, "warps": warps, "iterations": iterations}
        yield _variant("TV-L1", CLASSICAL, solver, _classical(WindowSettings(solver=solver)))
    for radius, patch in product(NLM_RADII, PATCH_RADII):
        preset = replace(STANDARD, nlm_radius=radius, nlm_patch_radius=patch)
        yield _variant("NLM", CLASSICAL, {"radius": radius, "patch": patch}, _classical(preset=preset))


def _networks() -> Iterator[tuple[str, Method]]:
    for sweep, base, name, values in (
        ("Kernel threshold", KERNELS, "threshold", THRESHOLDS),
        ("Precision", NETWORK, "precision", PRECISIONS),
        ("Tile", NETWORK, "tile", TILES),
    ):
        for value in values:
            settings: dict[str, Any] = {name: value}
            yield _variant(sweep, base, settings, replace(_network_run(base), **settings))


def _threads() -> Iterator[tuple[str, Method]]:
    for base, threads in product((CLASSICAL, NETWORK), THREADS):
        name, method = _variant("Threads", base, {"threads": threads}, METHODS[base].run)
        yield name, replace(method, threads=threads)
