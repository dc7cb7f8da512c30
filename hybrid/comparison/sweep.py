"""The sweep of a comparison: one setting varied at a time, to see what accuracy costs and which stage buys it."""

from __future__ import annotations

import os
from collections.abc import Iterator, Mapping
from dataclasses import replace
from functools import partial
from itertools import product
from typing import Any

from hybrid.comparison.methods import METHODS, Method
from hybrid.plan import Plan, Rules
from hybrid.pseudo_reference import STANDARD, filter_window

# What is varied around: the middle of the classical presets, and the network.
CLASSICAL, NETWORK, KERNELS = "standard", "network without OIDN", "tKPCN"

RADII = (0, 1, 2, 3)  # windows of 1, 3, 5 and 7 frames
SCALES, WARPS, ITERATIONS = (1, 3), (1, 3), (10, 30)  # of TV-L1
NLM_RADII, PATCH_RADII = (1, 2, 3, 5, 7), (1, 2, 3)
THRESHOLDS = (0.0, 0.25, 0.5, 0.75)  # of the kernels, in units of 1/K
PRECISIONS = ("float32", "bfloat16")
TILES = (64, 128, 256, 512)
THREADS = tuple(n for n in (1, 2, 4, 8, 16) if n <= (os.cpu_count() or 1))


def sweep_methods(plan: Plan) -> dict[str, Method]:
    """Name the variants that are worth comparing on a shot with this plan.

    Returns
    -------
    dict of str to Method
        By a name that tells what is varied. Each stage of the plan is switched to what the plan did not choose;
        the presets are among `METHODS` already.
    """
    return dict([*_stages(plan), *_windows(), *_tvl1(), *_nlm(), *_network(), *_threads()])


def _variant(sweep: str, base: str, settings: Mapping[str, object], **options: Any) -> tuple[str, Method]:
    """The method `base` with other options, by a name that tells the settings."""
    words = " ".join(f"{key} {value}" for key, value in settings.items())
    method = METHODS[base]
    run = partial(method.run, **options)
    return f"{base}, {words}", Method(run, method.family, settings=settings, sweep=sweep, base=base)


def _stages(plan: Plan) -> Iterator[tuple[str, Method]]:
    for decision in plan.decisions:
        turned = "off" if decision.on else "on"
        settings, rules = {decision.stage: turned}, Rules(**{turned: frozenset({decision.stage})})
        if decision.stage == "dense-flow":
            if not decision.on:  # there are vectors; without them this is what has to be run
                yield _variant("Stages", CLASSICAL, settings, vectors=False)
        elif decision.stage == "skip":  # tiles are the network's
            yield _variant("Stages", NETWORK, settings, rules=rules)
        elif decision.stage != "alpha":  # which has no part in the color
            yield _variant("Stages", CLASSICAL, settings, rules=rules)
    without = {"guided filter": replace(STANDARD, guided_radius=0), "NLM": replace(STANDARD, nlm_radius=0)}
    for stage, preset in without.items():
        yield _variant("Stages", CLASSICAL, {stage: "off"}, denoise=partial(filter_window, preset=preset))


def _windows() -> Iterator[tuple[str, Method]]:
    for radius in RADII:
        yield _variant("Window", CLASSICAL, {"window": 2 * radius + 1}, radius=radius)


def _tvl1() -> Iterator[tuple[str, Method]]:
    for scales, warps, iterations in product(SCALES, WARPS, ITERATIONS):
        solver = {"scales": scales, "warps": warps, "iterations": iterations}
        yield _variant("TV-L1", CLASSICAL, solver, solver=solver)


def _nlm() -> Iterator[tuple[str, Method]]:
    for radius, patch in product(NLM_RADII, PATCH_RADII):
        preset = replace(STANDARD, nlm_radius=radius, nlm_patch_radius=patch)
        settings = {"radius": radius, "patch": patch}
        yield _variant("NLM", CLASSICAL, settings, denoise=partial(filter_window, preset=preset))


def _network() -> Iterator[tuple[str, Method]]:
    for sweep, base, option, values in (
        ("Kernel threshold", KERNELS, "threshold", THRESHOLDS),
        ("Precision", NETWORK, "precision", PRECISIONS),
        ("Tile", NETWORK, "tile", TILES),
    ):
        for value in values:
            yield _variant(sweep, base, {option: value}, **{option: value})


def _threads() -> Iterator[tuple[str, Method]]:
    for base, threads in product((CLASSICAL, NETWORK), THREADS):
        name, method = _variant("Threads", base, {"threads": threads})
        yield name, replace(method, threads=threads)
