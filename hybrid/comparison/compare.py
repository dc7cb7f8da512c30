"""Denoisers side by side: every method runs on a shot, and is judged against a reference."""

from __future__ import annotations

import os
import platform
from collections.abc import Callable, Iterator, Mapping, Sequence
from concurrent.futures import ThreadPoolExecutor
from contextlib import nullcontext, suppress
from functools import partial
from importlib import metadata
from pathlib import Path
from tempfile import TemporaryDirectory

from hybrid.comparison.judging import Judge, error_of, find_static_pixels, store_flows, store_reference
from hybrid.comparison.methods import METHODS, Method
from hybrid.comparison.results import Comparison, MethodResult, Statistic
from hybrid.comparison.running import ENOUGH, WARM_UP, Progress, Run, run_apart, summarize_runs, time_methods
from hybrid.comparison.samples import NoiseLaw
from hybrid.comparison.store import FrameStore
from hybrid.files.shots import Shot
from hybrid.runtime.system import load_average

VERSIONS = ("numpy", "numba", "opencv-contrib-python-headless", "scikit-image", "torch", "pyoidn")
LARGE = 1 << 20  # pixels of a frame; above, the maps of all frames would take longer than the rest of a comparison


def compare_shot(
    shot: Shot,
    reference: Shot | tuple[Shot, Shot],
    methods: Mapping[str, Method] = METHODS,
    *,
    title: str = "shot",
    exposure: float = 1.0,
    rounds: int = 1,
    samples: float | None = None,
    reference_samples: float | None = None,
    levels: Sequence[tuple[Shot, float]] = (),
    said: Sequence[str] = (),
    look: Callable[[], Sequence[str]] | None = None,
    maps: bool = False,
    folder: Path | None = None,
    progress: Progress | None = None,
) -> Comparison:
    """Run every method on a shot and measure what it gives against the reference.

    Parameters
    ----------
    shot : Shot
        What to denoise.
    reference : Shot or tuple of two Shots
        The same frames, clean; frames it lacks are not judged. Two independent renders take the reference's noise out
        of PSNR, relMSE and temporal PSNR (`hybrid.comparison.metrics`). It is not small: 512 samples a pixel of a
        bathroom had half of the squared error that OIDN's best mode shows against them.
    methods : mapping of str to Method
        By name. They run in processes of their own.
    title : str
        Of the shot.
    exposure : float
        Factor before the tone curve, and on the radiance of relMSE, one for the whole shot.
    rounds : int
        How often each method runs, in turns with the others.
    samples, reference_samples : float, optional
        Per pixel, of the shot and of the (whole) reference.
    levels : sequence of (Shot, float)
        Further renders of the shot with their samples per pixel, to measure how the noisy error falls.
    said : sequence of str
        What there is to say of the shot's layers.
    look : callable, optional
        Looks what else there is to say, while reference and motion are read. What it raises ends the comparison before
        any method runs.
    maps : bool
        Whether the methods' own maps are made too, of the frames that `mapped_frames` chooses.
    folder : Path, optional
        A new one, or an empty one. It keeps the frames and maps of every method, and the reference, for a `FrameStore`.
        Without it they are removed in the end.
    progress : callable, optional
        Is told what is being done, and how many steps of all are done; those that turn out not to be needed are jumped.

    Returns
    -------
    Comparison
        One result per method, in their order, and the facts. A method that is not installed, or whose process died,
        comes with an `absent_reason` in place of figures.

    Raises
    ------
    ValueError
        If shot and reference have no frame in common; before any method runs, if what is given beside the shot
        lacks a frame or differs from it in size, or if levels come without samples or without "noisy" to compare
        with; afterwards, if a method has left frames out.
    """
    halves = reference if isinstance(reference, tuple) else (reference,)
    numbers = _common_frames(shot, halves)
    _check_levels(numbers, methods, samples, levels)
    mapped = [name for name, method in methods.items() if maps and method.maps is not None]
    run_steps = rounds * len(methods)  # after a first step; FLIP is one more
    total = 1 + run_steps + 1 + len(methods) + len(mapped)

    def tell(what: str, done: int, _: int = 0, *, before: int = 0) -> None:
        if progress is not None:
            progress(what, before + done, total)

    tell("look at the shot, its motion and the reference", 0)
    with nullcontext(folder) if folder is not None else TemporaryDirectory() as kept:
        store = FrameStore(Path(kept))
        with ThreadPoolExecutor(1) as beside:
            found = None if look is None else beside.submit(look)
            run_apart(_check_sizes, shot, _what_is_given(numbers, halves, methods, levels))
            store_reference(store, halves, numbers)
            pairs = run_apart(store_flows, store, shot, numbers)
            judge = Judge(store, numbers, pairs, exposure, find_static_pixels(store, numbers, pairs, exposure))
        said = [*said, *(found.result() if found is not None else ())]
        load = load_average()
        runs, absent = time_methods(methods, shot, rounds, store, partial(tell, before=1))
        chosen = {name: methods[name] for name in runs}
        statistics = _judge_methods(judge, chosen, partial(tell, before=1 + run_steps))
        law, facts = None, _facts_of_frames(judge)
        if "noisy" in statistics:
            law, facts["Reference"] = judge.find_noise_law(
                statistics["noisy"]["psnr"], samples, levels, reference_samples
            )
            facts["Worth in samples"] = law.describe()
        results = [
            _absent_result(name, method, absent[name])
            if name in absent
            else _result(name, method, runs[name], statistics[name], law)
            for name, method in methods.items()
        ]
        if said:
            facts["Layers"] = "; ".join(said)
        looked_at = mapped_frames(numbers, judge.static.size)
        if mapped and len(looked_at) < len(numbers):
            facts["Maps"] = f"confidence and contribution of frame {looked_at[0]} alone, for the frames are large"
        for done, name in enumerate(mapped):
            if name in runs:
                tell(f"maps of {name}", done, before=total - len(mapped))
                run_apart(_store_maps, methods[name], shot, looked_at, name, store)
        tell("done", total)
    return Comparison(title, tuple(results), facts | _facts_of_runs(exposure, rounds, load))


# Before anything runs


def _common_frames(shot: Shot, halves: Sequence[Shot]) -> list[int]:
    """Frames of the shot that all of the reference has."""
    numbers = [n for n in shot.numbers if all(n in half.numbers for half in halves)]
    if not numbers:
        spans = " and ".join(_span(half.numbers) for half in halves)
        raise ValueError(f"reference has frames {spans}, the shot {_span(shot.numbers)}: none in common")
    return numbers


def _check_levels(
    numbers: Sequence[int],
    methods: Mapping[str, Method],
    samples: float | None,
    levels: Sequence[tuple[Shot, float]],
) -> None:
    """Refuse levels that cannot be compared with the shot."""
    if levels and samples is None:
        raise ValueError("levels need the samples per pixel of the shot; its files do not tell them")
    if levels and "noisy" not in methods:
        raise ValueError("levels are compared with the shot's own noise, expected the method 'noisy'")
    for level, count in levels:
        if not any(level.has(number) for number in numbers):
            spans = f"frames {_span(level.numbers)}, expected some of {_span(numbers)}"
            raise ValueError(f"level of {count:g} samples has {spans}")


def _what_is_given(
    numbers: Sequence[int],
    halves: Sequence[Shot],
    methods: Mapping[str, Method],
    levels: Sequence[tuple[Shot, float]],
) -> list[tuple[str, Shot, list[int]]]:
    """Every sequence that is read beside the shot: its name, and the frames that are needed of it."""
    given = [("reference", half, list(numbers)) for half in halves]
    given += [(f"method {name!r}", m.given, list(numbers)) for name, m in methods.items() if m.given is not None]
    given += [(f"level of {count:g} samples", level, [n for n in numbers if level.has(n)]) for level, count in levels]
    return given


def _check_sizes(shot: Shot, given: Sequence[tuple[str, Shot, Sequence[int]]]) -> None:
    """Read the frames that are needed of what is given beside the shot; all must be there, and of its size.

    This costs seconds. Found when a method's frames are measured, the same would cost all that has run by then. It
    runs apart, so that the frames it reads do not travel to the methods inside the shot.
    """
    expected = shot.read(shot.numbers[0]).color.shape
    for what, sequence, numbers in given:
        for number in numbers:
            if not sequence.has(number):
                raise ValueError(f"{what} gave no frame {number}, expected all of {_span(numbers)}")
            found = sequence.read(number).color.shape
            if found != expected:
                sizes = f"{found[1]}x{found[0]}, expected {expected[1]}x{expected[0]}, the shot's"
                raise ValueError(f"frame {number} of {what} is {sizes}")


def _span(numbers: Sequence[int]) -> str:
    return f"{numbers[0]}–{numbers[-1]}" if numbers else "none"


# What is made of the runs


def _judge_methods(judge: Judge, methods: Mapping[str, Method], progress: Progress) -> dict[str, dict[str, Statistic]]:
    """Measures of each method; what only varies a setting is judged without FLIP."""
    progress("FLIP of all methods", 0, len(methods) + 1)
    judge.map_flip([name for name, method in methods.items() if not method.sweep])
    statistics = {}
    for done, (name, method) in enumerate(methods.items(), start=1):
        progress(f"measure {name}", done, len(methods) + 1)
        statistics[name] = judge.measure(name, flip=not method.sweep, change=not method.sweep)
    return statistics


def _result(
    name: str, method: Method, runs: Sequence[Run], metrics: Mapping[str, Statistic], law: NoiseLaw | None
) -> MethodResult:
    """The result of a method that has run. What is there anyway costs nothing: handing frames on is no denoising."""
    seconds = summarize_runs(runs) if method.timed else None
    return MethodResult(
        name,
        name,
        method.settings,
        method.family,
        method.sweep,
        method.base,
        seconds_per_megapixel=seconds.median if seconds else method.cost,
        spread=(seconds.least, seconds.most) if seconds and len(runs) > 1 else None,
        cpu_seconds_per_megapixel=seconds.cpu if seconds else method.cost,
        peak_bytes=None if method.cost is None else max(run.peak_bytes for run in runs),
        metrics=metrics,
        worth=None if law is None or name == "noisy" else law.worth(error_of(metrics["psnr"])),
    )


def _absent_result(name: str, method: Method, reason: str) -> MethodResult:
    return MethodResult(
        name, name, method.settings, method.family, method.sweep, method.base, absent_reason=reason
    )  # fmt: skip


def mapped_frames(numbers: Sequence[int], pixels: int) -> list[int]:
    """Choose the frames whose maps are made.

    Parameters
    ----------
    numbers : sequence of int
        Of the frames that are judged.
    pixels : int
        Of a frame.

    Returns
    -------
    list of int
        All; of frames above `LARGE` pixels the middle one, as a map costs more than the frame did.
    """
    return list(numbers) if pixels <= LARGE else [numbers[len(numbers) // 2]]


def _store_maps(method: Method, shot: Shot, numbers: Sequence[int], name: str, store: FrameStore) -> None:
    """Keep a method's maps of these frames."""
    for number, maps in method.maps(shot, numbers) if method.maps is not None else ():
        for title, values in maps.items():
            store.save(name, number, values, title)


# What to know about how it was measured


def _facts_of_frames(judge: Judge) -> dict[str, str]:
    height, width = judge.static.shape
    return {
        "Frames": f"{_span(judge.numbers)}, {width} × {height} pixels",
        "Pixels that stand still": f"{judge.static.mean():.1%}",
    }


def _facts_of_runs(exposure: float, rounds: int, load: float | None) -> dict[str, str]:
    return {
        "Tone curve": f"e·x / (1 + e·x) with e = {exposure:g}, one for the whole shot",
        "Timing": f"Each method ran {rounds} {'time' if rounds == 1 else 'times'} in turns with the others, "
        f"fewer where that took more than {ENOUGH:g} seconds, in a process of its own, warmed up with the middle of a "
        f"frame, up to {WARM_UP} pixels on a side. Compilation, weights and reading files are not counted. Median, and "
        "the range of the runs. Peak memory as the operating system counted it. Threads that wait sleep "
        f"(OMP_WAIT_POLICY=PASSIVE, GOMP_SPINCOUNT={os.environ.get('GOMP_SPINCOUNT', '0')}).",
        "Machine": f"{_processor()}, {os.cpu_count()} cores, {platform.system()}"
        + ("" if load is None else f"; load average {load:.1f} at the start"),
        "Versions": ", ".join(_versions()),
    }


def _processor() -> str:
    """The processor's name as Linux knows it, or its architecture."""
    try:
        lines = Path("/proc/cpuinfo").read_text(encoding="utf-8").splitlines()
        return next(line.partition(":")[2].strip() for line in lines if line.startswith("model name"))
    except (OSError, StopIteration):
        return platform.machine()


def _versions() -> Iterator[str]:
    yield f"Python {platform.python_version()}"
    for package in ("ravg", *VERSIONS):
        with suppress(metadata.PackageNotFoundError):
            yield f"{package} {metadata.version(package)}"
