"""Comparison of denoisers: run every method on a shot and evaluate its frames against a reference."""

import os
import platform
from collections.abc import Callable, Mapping, Sequence
from concurrent.futures import ThreadPoolExecutor
from contextlib import nullcontext
from dataclasses import dataclass
from pathlib import Path
from tempfile import TemporaryDirectory

from hybrid.comparison.evaluation import Evaluator, Level, mean_error, store_flows, store_reference
from hybrid.comparison.ladder import build_ladder
from hybrid.comparison.methods import METHODS, Method
from hybrid.comparison.metrics import halves_of
from hybrid.comparison.results import Comparison, Ladder, MethodResult, Statistic
from hybrid.comparison.running import ENOUGH, WARM_UP, OnStep, RunCost, run_in_process, summarize_runs, time_methods
from hybrid.comparison.samples import NoiseLaw
from hybrid.comparison.store import REFERENCE, FrameStore
from hybrid.files.frame import Frames
from hybrid.files.sources import versions
from hybrid.runtime.system import load_average, processor_name

VERSIONS = ("numpy", "numba", "opencv-contrib-python-headless", "torch", "pyoidn")


@dataclass(frozen=True)
class CompareOptions:
    title: str = "shot"  # name of the shot
    # factor before the tone curve, and on the radiance of relMSE and SMAPE, one for the whole shot
    exposure: float = 1.0
    rounds: int = 1  # runs of each method, in turns with the others
    # samples per pixel of the shot, and of the reference (both halves together)
    samples: float | None = None
    reference_samples: float | None = None
    levels: Sequence[Level] = ()  # renders of the shot at other samples per pixel, to measure how the error falls
    ladder: bool = False  # run the methods on the levels too
    findings: Sequence[str] = ()  # findings on the shot's layers, for the facts
    # returns further findings; called in the background while reference and motion are read. An exception ends the
    # comparison before any method runs.
    check_shot: Callable[[], Sequence[str]] | None = None


def compare_shot(
    shot: Frames,
    reference: Frames | tuple[Frames, Frames],
    methods: Mapping[str, Method] = METHODS,
    options: CompareOptions | None = None,
    *,
    folder: Path | None = None,
    on_step: OnStep = lambda what: None,
) -> Comparison:
    """Run every method on a shot and evaluate its frames against the reference; one result per method, in their order.

    Frames without a reference are not evaluated. Two independent renders as reference remove its noise from PSNR,
    relMSE and temporal PSNR: 512 samples per pixel of a bathroom had half of the squared error that OIDN's best mode
    showed against them. The empty `folder`, or a temporary one, receives a `FrameStore`. A method that is not
    installed, or whose process died, has an `absent_reason`. Raises ValueError before any method runs if an input lacks
    a frame or differs in size, or levels do not fit the shot, the methods or a ladder.
    """
    options = options or CompareOptions()
    halves = halves_of(reference)
    numbers = _common_frames(shot, halves)
    _check_levels(numbers, methods, options)
    inputs = _inputs(numbers, halves, methods, options.levels)
    on_step("read the shot, its motion and the reference")
    with nullcontext(folder) if folder is not None else TemporaryDirectory() as kept:
        store = FrameStore(Path(kept))
        with ThreadPoolExecutor(1) as background:
            check = None if options.check_shot is None else background.submit(options.check_shot)
            run_in_process(_check_sizes, shot, inputs)
            store_reference(store, halves, numbers)
            pairs = run_in_process(store_flows, store, shot, numbers)
            findings = [*options.findings, *(check.result() if check is not None else ())]
        evaluator = Evaluator(store, numbers, pairs, options.exposure)
        height, width, _ = store.load(REFERENCE, numbers[0], lazily=True).shape
        load = load_average()
        timed = time_methods(methods, shot, options.rounds, store, on_step)
        statistics = _evaluate(evaluator, {name: methods[name] for name in timed.runs}, on_step)
        law, law_facts = _noise_law(evaluator, statistics, options)
        results = [
            _measured(name, method, timed.runs[name], statistics[name], law, height * width / 1e6)
            if name in timed.runs
            else MethodResult(name, method.settings, method.family, absent_reason=timed.absent[name])
            for name, method in methods.items()
        ]
        ladder = _measure_ladder(evaluator, methods, statistics, options, on_step)
    facts = {
        "Frames": f"{_span(numbers)}, {width} × {height} pixels",
        **law_facts,
    }
    if findings:
        facts["Layers"] = "; ".join(findings)
    facts |= _facts_of_runs(options, load)
    return Comparison(options.title, tuple(results), facts, ladder, tuple(numbers))


def count_steps(methods: Mapping[str, Method], options: CompareOptions) -> int:
    """Return the most steps of a comparison: reading, runs, FLIP, measuring, levels."""
    levels = len(options.levels) * (1 + len(_methods_of_levels(methods))) if options.ladder else 0
    return 1 + options.rounds * len(methods) + 1 + len(methods) + levels


def _common_frames(shot: Frames, halves: Sequence[Frames]) -> list[int]:
    """Frames of the shot for which there is a whole reference."""
    numbers = [n for n in shot.numbers if all(n in half.numbers for half in halves)]
    if not numbers:
        spans = " and ".join(_span(half.numbers) for half in halves)
        raise ValueError(f"reference has frames {spans}, the shot {_span(shot.numbers)}: none in common")
    return numbers


def _check_levels(numbers: Sequence[int], methods: Mapping[str, Method], options: CompareOptions) -> None:
    """Raise ValueError for levels that cannot be compared with the shot."""
    if options.levels and options.samples is None:
        raise ValueError("levels need the samples per pixel of the shot, which its files do not state")
    if options.levels and "noisy" not in methods:
        raise ValueError("levels are compared with the noise of the shot, expected the method 'noisy'")
    for level, count in options.levels:
        if not any(level.has(number) for number in numbers):
            spans = f"frames {_span(level.numbers)}, expected some of {_span(numbers)}"
            raise ValueError(f"level of {count:g} samples has {spans}")
    if options.ladder:
        counts = [options.samples, *(count for _, count in options.levels)]
        if twice := [count for count in counts if counts.count(count) > 1]:
            raise ValueError(f"the ladder has {twice[0]:g} samples per pixel twice, expected different levels")
        for level, count in options.levels:
            if missing := [number for number in numbers if number not in level.numbers]:
                raise ValueError(
                    f"level of {count:g} samples has no frame {missing[0]}, expected all of {_span(numbers)}"
                )


# A sequence that is read besides the shot, by name, and the frames that are needed.
_Input = tuple[str, Frames, Sequence[int]]


def _inputs(
    numbers: Sequence[int], halves: Sequence[Frames], methods: Mapping[str, Method], levels: Sequence[Level]
) -> list[_Input]:
    inputs: list[_Input] = [("reference", half, numbers) for half in halves]
    inputs += [(f"method {name!r}", m.given, numbers) for name, m in methods.items() if m.given is not None]
    inputs += [(f"level of {n:g} samples", level, [k for k in numbers if level.has(k)]) for level, n in levels]
    return inputs


def _check_sizes(shot: Frames, inputs: Sequence[_Input]) -> None:
    """Read the needed frames of all inputs; raise ValueError if one is missing or of another size than the shot.

    This takes seconds; the same error after the runs would cost all of their time. Called in another process, so that
    the frames are not pickled with the shot for the methods.
    """
    expected = shot.read(shot.numbers[0]).color.shape
    for name, sequence, numbers in inputs:
        for number in numbers:
            if not sequence.has(number):
                raise ValueError(f"{name} gave no frame {number}, expected all of {_span(numbers)}")
            found = sequence.read(number).color.shape
            if found != expected:
                sizes = f"{found[1]}x{found[0]}, expected {expected[1]}x{expected[0]}, the size of the shot"
                raise ValueError(f"frame {number} of {name} is {sizes}")


def _span(numbers: Sequence[int]) -> str:
    return f"{numbers[0]}–{numbers[-1]}" if numbers else "none"


def _evaluate(evaluator: Evaluator, methods: Mapping[str, Method], on_step: OnStep) -> dict[str, dict[str, Statistic]]:
    on_step("FLIP of all methods")
    evaluator.map_flip(list(methods))
    evaluator.map_changes(REFERENCE)  # true changes, which are no flicker
    statistics = {}
    for name in methods:
        on_step(f"measure {name}")
        statistics[name] = evaluator.measure(name)
        evaluator.map_changes(name)
    return statistics


def _noise_law(
    evaluator: Evaluator, statistics: Mapping[str, Mapping[str, Statistic]], options: CompareOptions
) -> tuple[NoiseLaw | None, dict[str, str]]:
    """The noise law if the noisy frames were measured, and its facts."""
    if "noisy" not in statistics:
        return None, {}
    law, words = evaluator.find_noise_law(
        statistics["noisy"]["psnr"], options.samples, options.levels, options.reference_samples
    )
    return law, {"Reference": words, "Worth in samples": law.describe()}


def _methods_of_levels(methods: Mapping[str, Method]) -> dict[str, Method]:
    """The methods that run on levels: finished frames show the shot alone."""
    return {name: method for name, method in methods.items() if method.given is None}


def _measure_ladder(
    evaluator: Evaluator,
    methods: Mapping[str, Method],
    statistics: Mapping[str, Mapping[str, Statistic]],
    options: CompareOptions,
    on_step: OnStep,
) -> Ladder:
    """The errors of the methods on the shot and on every level; frames of a level have names of their own."""
    if not options.ladder or options.samples is None:
        return {}
    chosen = _methods_of_levels(methods)
    measured = {options.samples: {name: statistics[name] for name in chosen if name in statistics}}
    for level, samples in options.levels:
        names = {f"{name} at {samples:g} samples": name for name in chosen if name in statistics}
        at_level = {long: chosen[name] for long, name in names.items()}
        timed = time_methods(at_level, level, 1, evaluator.store, on_step)
        on_step(f"measure the level of {samples:g} samples")
        evaluator.map_flip(list(timed.runs))
        measured[samples] = {names[long]: evaluator.measure(long) for long in timed.runs}
    return build_ladder(measured)


def _measured(
    name: str,
    method: Method,
    runs: Sequence[RunCost],
    metrics: Mapping[str, Statistic],
    law: NoiseLaw | None,
    megapixels: float,
) -> MethodResult:
    """The result of a method that has run on frames of so many megapixels."""
    seconds = summarize_runs(runs) if method.cost == "measured" else None
    unmeasured = 0.0 if method.cost == "free" else None
    stated = unmeasured if method.seconds is None else method.seconds / megapixels
    return MethodResult(
        name,
        method.settings,
        method.family,
        seconds_per_megapixel=seconds.median if seconds else stated,
        spread=(seconds.least, seconds.most) if seconds and len(runs) > 1 else None,
        cpu_seconds_per_megapixel=seconds.cpu if seconds else unmeasured,
        peak_bytes=None if method.cost == "unknown" else max(run.peak_bytes for run in runs),
        metrics=metrics,
        worth=None if law is None or name == "noisy" else law.worth(mean_error(metrics["psnr"].values)),
    )


def _facts_of_runs(options: CompareOptions, load: float | None) -> dict[str, str]:
    rounds = options.rounds
    packages = [f"{name} {number}" for name, number in versions("ravg", *VERSIONS).items()]
    return {
        "Tone curve": f"e·x / (1 + e·x) with e = {options.exposure:g}, one for the whole shot",
        "Timing": f"Each method ran {rounds} {'time' if rounds == 1 else 'times'} in turns with the others, "
        f"fewer if its runs took more than {ENOUGH:g} seconds, in a process of its own, warmed up with the middle of a "
        f"frame, up to {WARM_UP} pixels per side. Compilation, loading of weights and reading of files do not count. "
        "Median, and the range of the runs. Peak memory as counted by the operating system. Waiting threads sleep "
        f"(OMP_WAIT_POLICY=PASSIVE, GOMP_SPINCOUNT={os.environ.get('GOMP_SPINCOUNT', '0')}).",
        "Machine": f"{processor_name()}, {os.cpu_count()} cores, {platform.system()}"
        + ("" if load is None else f"; load average {load:.1f} at the start"),
        "Versions": ", ".join([f"Python {platform.python_version()}", *packages]),
    }
