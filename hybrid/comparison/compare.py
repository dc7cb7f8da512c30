"""Denoisers side by side: accuracy against a reference, time, and memory.

Each method (`hybrid.comparison.methods`) runs in a process of its own, so that its peak memory is its own, and leaves
its frames on disk, so that a long shot does not fill this process's.
"""

from __future__ import annotations

import os
import platform
import time
from collections.abc import Callable, Collection, Iterator, Mapping, Sequence
from concurrent.futures import ProcessPoolExecutor
from concurrent.futures.process import BrokenProcessPool
from contextlib import contextmanager, suppress
from dataclasses import dataclass
from importlib import metadata
from importlib.util import find_spec
from itertools import pairwise
from multiprocessing import get_context
from pathlib import Path
from tempfile import TemporaryDirectory
from urllib.parse import quote

import cv2
import numba
import numpy as np
from numpy.typing import NDArray
from rich.markup import escape
from rich.table import Table

from flow.motion import Vectors, forward_backward_error, invert_flow
from flow.warp import warp
from hybrid.comparison.methods import METHODS, Method
from hybrid.comparison.metrics import (
    Reference,
    flip_map,
    mean_bias,
    psnr,
    relmse,
    smape,
    ssim,
    static_std,
    temporal_psnr,
    tone_map,
)
from hybrid.comparison.results import (
    CHART_METRICS,
    METRICS,
    Comparison,
    MethodResult,
    Statistic,
    best_and_ties,
    column_title,
    format_bytes,
    format_seconds,
    format_value,
    format_worth,
    present_metrics,
    summarize,
)
from hybrid.comparison.samples import NoiseLaw, fit_floor, reference_floor
from hybrid.files.frames import Frame, Shot
from hybrid.memory import keep_freed_memory
from hybrid.plan import STILL
from hybrid.timing import peak_memory

Array = NDArray[np.float32]
Measure = Callable[[Array, Reference, float], float]  # of image, reference, exposure
Progress = Callable[[str, int, int], None]  # what is being done, steps done, steps in all


def _whole(reference: Reference) -> NDArray[np.floating]:
    """The reference as one image: the mean of its halves, where it comes in halves."""
    return (reference[0] + reference[1]) / 2 if isinstance(reference, tuple) else reference


# What is measured on a frame by itself, beside FLIP and the measures over time.
MEASURES: dict[str, Measure] = {
    "psnr": lambda x, r, e: psnr(x, r, exposure=e),
    "ssim": lambda x, r, e: ssim(x, _whole(r), exposure=e),
    "relmse": lambda x, r, e: relmse(x, r, exposure=e),
    "relmse_trimmed": lambda x, r, e: relmse(x, r, exposure=e, trim=0.001),
    "smape": lambda x, r, e: smape(x, _whole(r), exposure=e),
    "mean_bias": lambda x, r, _: mean_bias(x, _whole(r)),
}
# A pixel's light stands still where the 9×9 means of the reference change by less than this, on the tone curve: well
# above their noise (a ninth of the pixels'), well below what anyone would call a change.
STEADY = 0.02
FLIP_MAP = "FLIP"
VERSIONS = ("numpy", "numba", "opencv-contrib-python-headless", "scikit-image", "torch", "pyoidn", "flip-evaluator")


# Running a method


@dataclass(frozen=True)
class Run:
    """What a method has cost: its frames together, seconds without the reading of files, peak bytes."""

    megapixels: float
    seconds: float
    cpu_seconds: float
    peak_bytes: int


@dataclass
class _Clock:
    seconds: float = 0.0
    cpu_seconds: float = 0.0


@contextmanager
def _clock_reading(shot: Shot) -> Iterator[_Clock]:
    """Count the time that `shot.read` takes, whoever calls it: on the instance, so that its own calls count."""
    clock, read = _Clock(), shot.read

    def clocked(number: int) -> Frame:
        wall, cpu = time.perf_counter(), time.process_time()
        try:
            return read(number)
        finally:
            clock.seconds += time.perf_counter() - wall
            clock.cpu_seconds += time.process_time() - cpu

    shot.read = clocked  # type: ignore[method-assign]
    try:
        yield clock
    finally:
        del shot.read


def run_method(method: Method, shot: Shot, name: str = "", folder: Path | None = None) -> Run:
    """Run a method over a shot in this process, and leave its frames in `folder` for `load_frame`.

    The first frame is made once before the clock starts: compilation, weights and the plan are paid for there.
    """
    if method.threads:
        _limit_threads(method.threads)
    next(method.run(shot), None)
    pixels, wall, cpu = 0, 0.0, 0.0
    with _clock_reading(shot) as reading:
        frames = method.run(shot)
        while True:
            wall_start, cpu_start = time.perf_counter(), time.process_time()
            done = next(frames, None)
            wall += time.perf_counter() - wall_start
            cpu += time.process_time() - cpu_start
            if done is None:
                break
            number, image = done
            pixels += image.shape[0] * image.shape[1]
            if folder is not None:
                _save(folder, name, number, image)
    return Run(pixels / 1e6, wall - reading.seconds, cpu - reading.cpu_seconds, peak_memory())


def _limit_threads(count: int) -> None:
    """Let this process's libraries use so many threads; torch reads the variable when it is imported."""
    os.environ["OMP_NUM_THREADS"] = str(count)
    cv2.setNumThreads(count)
    numba.set_num_threads(min(count, numba.get_num_threads()))


def _apart() -> ProcessPoolExecutor:
    """A fresh process for one task.

    It is forked from a server and not from this process, whose peak memory Linux would count as its own.
    """
    # Threads that wait in turns, instead of spinning, cost little alone, and on a busy machine ten times less CPU time
    # was counted. The libraries read this when the forked process first uses them.
    os.environ.setdefault("OMP_WAIT_POLICY", "PASSIVE")
    context = get_context("forkserver")
    context.set_forkserver_preload([__name__])  # once, and not for every method
    return ProcessPoolExecutor(1, mp_context=context, initializer=keep_freed_memory)


def time_methods(
    methods: Mapping[str, Method], shot: Shot, *, rounds: int = 3, folder: Path | None = None,
    progress: Progress | None = None,
) -> tuple[dict[str, list[Run]], dict[str, str]]:  # fmt: skip
    """Run the methods in turns, `rounds` times each, so that whatever else the machine does meets all of them.

    Returns
    -------
    runs : those of each method, a round after the other; `spread_seconds` makes figures of them.
    absent : why the others have none.
    """
    runs: dict[str, list[Run]] = {}
    absent: dict[str, str] = {}
    names = list(methods)
    for turn in range(rounds):
        # Each round starts elsewhere, so that no method always follows the same one.
        start = turn * len(names) // rounds
        for done, name in enumerate(names[start:] + names[:start]):
            if progress is not None:
                progress(name, turn * len(names) + done, rounds * len(names))
            if name in absent:
                continue
            if turn and not methods[name].timed:
                continue  # nothing to time again
            try:
                with _apart() as pool:
                    keep = folder if turn == 0 else None
                    run = pool.submit(run_method, methods[name], shot, name, keep).result()
            except ImportError as error:
                absent[name] = str(error)
            except BrokenProcessPool:
                absent[name] = "its process died, out of memory perhaps"
            else:
                runs.setdefault(name, []).append(run)
    return {name: runs[name] for name in names if name in runs and name not in absent}, absent


def spread_seconds(runs: Mapping[str, Sequence[Run]]) -> dict[str, tuple[float, float, float, float]]:
    """Median, least and most wall seconds per megapixel, and the median CPU seconds.

    Notes
    -----
    The median alone. Dividing out the load of a round (as all methods felt it), or of a run (by a fixed piece of work
    between its frames), made ratios repeat no better on a machine under eight times its load: that changes
    within seconds. More rounds do help; `benchmarks/bench_compare.py` shows how far the ratios can be trusted.
    """
    out = {}
    for name, series in runs.items():
        wall = np.array([run.seconds / run.megapixels for run in series])
        cpu = np.array([run.cpu_seconds / run.megapixels for run in series])
        out[name] = float(np.median(wall)), float(wall.min()), float(wall.max()), float(np.median(cpu))
    return out


# Judging it


def compare_shot(
    shot: Shot,
    reference: Shot | tuple[Shot, Shot],
    methods: Mapping[str, Method] = METHODS,
    *,
    title: str = "shot",
    measures: Collection[str] = (*MEASURES, "flip"),
    exposure: float = 1.0,
    rounds: int = 1,
    samples: float | None = None,
    reference_samples: float | None = None,
    levels: Sequence[tuple[Shot, float]] = (),
    maps: bool = False,
    folder: Path | None = None,
    progress: Progress | None = None,
) -> Comparison:
    """Run every method on a shot and measure what it gives against the reference.

    Parameters
    ----------
    shot : what to denoise.
    reference : the same frames, clean; frames it lacks are not judged. Two independent renders take the
        reference's noise out of PSNR, relMSE and temporal PSNR (`hybrid.comparison.metrics`). It is not small: 512
        samples a pixel of a bathroom had half of the squared error that OIDN's best mode shows against them.
    methods : by name. They run in processes of their own.
    title : of the shot.
    measures : keys of `MEASURES`, and "flip"; those over time are always taken, where there are vectors.
    exposure : factor before the tone curve, and on the radiance of relMSE, one for the whole shot.
    rounds : how often each method runs, in turns with the others.
    samples, reference_samples : per pixel, of the shot and of the (whole) reference.
    levels : further renders of the shot with their samples per pixel, to measure how the noisy error falls.
    maps : also make the methods' maps, for `load_frame` by "METHOD map TITLE", and keep FLIP's.
    folder : a new one, or an empty one. It keeps the frames of every method, and the reference as "reference",
        for `load_frame`. Without it they are removed in the end.
    progress : is told what is being done.

    Returns
    -------
    One result per method, in their order, and the facts. A method that is not installed, or whose process died, comes
    with an `absent_reason` in place of figures.

    Raises
    ------
    ValueError
        If shot and reference have no frame in common; before any method runs, if what is given beside the shot
        lacks a frame or differs from it in size, or if levels come without samples or without "noisy" to compare
        with; afterwards, if a method has left frames out.
    """
    if folder is None:
        with TemporaryDirectory() as temporary:
            return compare_shot(
                shot, reference, methods, title=title, measures=measures, exposure=exposure, rounds=rounds,
                samples=samples, reference_samples=reference_samples, levels=levels, maps=maps,
                folder=Path(temporary), progress=progress,
            )  # fmt: skip
    halves = reference if isinstance(reference, tuple) else (reference,)
    numbers = [n for n in shot.numbers if all(n in half.numbers for half in halves)]
    if not numbers:
        spans = " and ".join(map(_span, halves))
        raise ValueError(f"reference has frames {spans}, the shot {_span(shot)}: none in common")
    if levels and samples is None:
        raise ValueError("levels need the samples per pixel of the shot; its files do not tell them")
    if levels and ("noisy" not in methods or "psnr" not in measures):
        raise ValueError("levels are compared with the shot's own noise, expected the method 'noisy' and its PSNR")
    given = [("reference", half, numbers) for half in halves]
    given += [(f"method {name!r}", m.given, numbers) for name, m in methods.items() if m.given is not None]
    for level, count in levels:
        common = [number for number in numbers if level.has(number)]
        if not common:
            spans = f"frames {_span(level)}, expected some of {_span_of(numbers)}"
            raise ValueError(f"level of {count:g} samples has {spans}")
        given.append((f"level of {count:g} samples", level, common))
    with _apart() as pool:  # so that the frames it reads do not travel to the methods inside the shot
        pool.submit(_check_sizes, shot, given).result()
    for number in numbers:
        images = [half.read(number).color for half in halves]
        _save(folder, "reference", number, np.mean(images, axis=0))
        if len(images) == 2:
            _save(folder, "reference a", number, images[0])
            _save(folder, "reference b", number, images[1])
    facts = {"Frames": f"{_span_of(numbers)}, {images[0].shape[1]} × {images[0].shape[0]} pixels"}
    with _apart() as pool:
        pairs = pool.submit(_save_pairs, shot, numbers, folder).result()
    static = _static_pixels(folder, numbers, pairs, exposure)
    facts["Pixels that stand still"] = f"{static.mean():.1%}"
    if "flip" in measures and find_spec("flip_evaluator") is None:
        measures = [key for key in measures if key != "flip"]
        facts["FLIP"] = "absent: flip-evaluator is not installed"
    busy = os.getloadavg()[0]
    runs, absent = time_methods(methods, shot, rounds=rounds, folder=folder, progress=progress)
    costs = spread_seconds({name: series for name, series in runs.items() if methods[name].timed})
    statistics = {}
    for done, name in enumerate(runs):
        if progress is not None:
            progress(f"measure {name}", done, len(runs))
        # FLIP takes longer than many a method; what only varies a setting is judged without.
        wanted = [key for key in measures if key != "flip" or not methods[name].sweep]
        statistics[name] = _measure(folder, name, numbers, pairs, static, wanted, exposure)
    law = None
    if "noisy" in statistics and "psnr" in measures:
        known = _levels(folder, numbers, statistics["noisy"]["psnr"], samples, levels, exposure)
        floor, words = _floor(folder, numbers, known, len(halves) == 2, samples, reference_samples, exposure)
        law = NoiseLaw(tuple(known), known_samples(samples), floor)
        facts["Reference"] = words
        facts["Worth in samples"] = law.describe()
    results = []
    for name, method in methods.items():
        if name in absent:
            results.append(
                MethodResult(name, name, method.settings, method.family, method.sweep, method.base,
                             absent_reason=absent[name])
            )  # fmt: skip
            continue
        median, least, most, cpu = costs.get(name, (method.cost, 0.0, 0.0, method.cost))
        results.append(
            MethodResult(
                name,
                name,
                settings=method.settings,
                family=method.family,
                sweep=method.sweep,
                base=method.base,
                # Handing frames on is no denoising; its few milliseconds would only stretch the axis of time.
                seconds_per_megapixel=median,
                spread=(least, most) if name in costs and rounds > 1 else None,
                cpu_seconds_per_megapixel=cpu,
                peak_bytes=None if method.cost is None else max(run.peak_bytes for run in runs[name]),
                metrics=statistics[name],
                worth=None if law is None or name == "noisy" else law.worth(_mean_error(statistics[name]["psnr"])),
            )
        )
        if maps and method.maps is not None:
            with _apart() as pool:
                pool.submit(_save_maps, method, shot, numbers, name, folder).result()
    facts |= {
        "Tone curve": f"e·x / (1 + e·x) with e = {exposure:g}, one for the whole shot",
        "Timing": f"Each method ran {rounds} {'time' if rounds == 1 else 'times'} in turns with the others, in a "
        "process of its own, after a first frame that is not counted, as reading files is not. Median, and the "
        "range of the runs. Peak memory as the operating system counted it. Threads that wait sleep "
        "(OMP_WAIT_POLICY=PASSIVE).",
        "Machine": f"{_processor()}, {os.cpu_count()} cores, {platform.system()}; load average {busy:.1f} at the start",
        "Versions": ", ".join(_versions()),
    }
    return Comparison(title, tuple(results), facts)


def _check_sizes(shot: Shot, given: Sequence[tuple[str, Shot, Sequence[int]]]) -> None:
    """Read the frames that are needed of what is given beside the shot; all must be there, and of its size.

    This costs seconds. Found when a method's frames are measured, the same would cost all that has run by then.
    """
    expected = shot.read(shot.numbers[0]).color.shape
    for what, sequence, numbers in given:
        for number in numbers:
            if not sequence.has(number):
                raise ValueError(f"{what} gave no frame {number}, expected all of {_span_of(numbers)}")
            found = sequence.read(number).color.shape
            if found != expected:
                sizes = f"{found[1]}x{found[0]}, expected {expected[1]}x{expected[0]}, the shot's"
                raise ValueError(f"frame {number} of {what} is {sizes}")


def known_samples(samples: float | None) -> float:
    """Samples per pixel, or 1 where only ratios can be told."""
    return samples or 1.0


def load_frame(folder: Path, name: str, number: int) -> Array:
    """Read a frame (H, W, 3), or a map (H, W), that `compare_shot` has left.

    Parameters
    ----------
    name : a method's, "reference", "METHOD map TITLE", or "METHOD map FLIP".
    """
    image: Array = np.load(_file(folder, name, number))
    return image


def map_titles(folder: Path, name: str, number: int) -> list[str]:
    """Name the maps that `compare_shot` has left for a frame of a method."""
    return [
        t
        for t in (FLIP_MAP, "Confidence", "Temporal contribution")
        if _file(folder, f"{name} map {t}", number).exists()
    ]


def result_table(results: Sequence[MethodResult]) -> Table:
    """Lay the results out for a terminal: the best of a column bold, what ties with it marked "≈"."""
    columns = [m for m in present_metrics(results, METRICS) if m.key in CHART_METRICS]
    verdicts = {m.key: best_and_ties(results, m) for m in columns}
    table = Table("method")
    for heading in (*map(column_title, columns), "s / MP", "CPU-s / MP", "peak", "worth"):
        table.add_column(heading, justify="right")
    for r in results:
        if r.absent_reason is not None:
            table.add_row(escape(r.label), *("–" for _ in table.columns[1:]), style="dim")
            continue
        cells = []
        for m in columns:
            text = format_value(r.metrics[m.key].mean, m) if m.key in r.metrics else "–"
            best, ties = verdicts[m.key]
            cells.append(f"[bold]{text}[/]" if r.name == best else f"≈ {text}" if r.name in ties else text)
        costs = format_seconds(r.seconds_per_megapixel), format_seconds(r.cpu_seconds_per_megapixel)
        table.add_row(escape(r.label), *cells, *costs, format_bytes(r.peak_bytes), format_worth(r.worth))
    absent = [f"{r.label}: {r.absent_reason}" for r in results if r.absent_reason is not None]
    if absent:
        table.caption = escape("absent – " + "; ".join(absent))
    return table


def motion_between(previous: Frame, current: Frame) -> tuple[Array, NDArray[np.bool_]] | None:
    """Where the pixels of a frame were one frame before, by the renderer's vectors.

    Returns
    -------
    flow : (H, W, 2) array, pixels, from `current` to `previous`.
    valid : (H, W) mask; True where it leads to the same point of the scene: inside the frame, and back again
        by the previous frame's own vectors; where it has none, to the same albedo.
    None where neither has vectors between them.
    """
    here, before = current.flows(), previous.flows()
    known, back = here and here.to_previous, before and before.to_next
    if known is None and back is not None:
        known = Vectors(*invert_flow(back.flow, valid=back.valid, depth=previous.depth))
    if known is None:
        return None
    flow, valid = known
    if back is not None:
        there, inside = warp(back.flow, flow)
        lengths = np.sum(flow**2, axis=-1) + np.sum(there**2, axis=-1)
        # Sundaram et al. 2010, eq. 5: a hundredth of the motion, and half a square pixel for interpolation.
        agree = forward_backward_error(flow, back.flow) ** 2 < 0.01 * lengths + 0.5
    elif previous.albedo is not None and current.albedo is not None:
        there, inside = warp(previous.albedo, flow)
        # Albedo is in [0, 1]. Another surface seldom differs by less; film sampling and a lens by less than this.
        agree = np.max(np.abs(there - current.albedo), axis=-1) < 0.1
    else:
        _, inside = warp(flow, flow)
        agree = np.ones_like(inside)
    return flow, valid & inside & agree


def _save_pairs(shot: Shot, numbers: Sequence[int], folder: Path) -> list[tuple[int, int]]:
    """Save flow and validity of the pairs of neighbouring frames, once for all methods; name the pairs."""
    pairs = []
    for a, b in pairwise(numbers):
        motion = motion_between(shot.read(a), shot.read(b)) if b == a + 1 else None
        if motion is not None:
            _save(folder, "flow", b, np.dstack(motion).astype(np.float32))
            pairs.append((a, b))
    return pairs


def _save_maps(method: Method, shot: Shot, numbers: Sequence[int], name: str, folder: Path) -> None:
    """Leave a method's maps for `load_frame`."""
    for number, maps in method.maps(shot) if method.maps is not None else ():
        if number in numbers:
            for title, values in maps.items():
                _save(folder, f"{name} map {title}", number, values)


def _static_pixels(
    folder: Path, numbers: Sequence[int], pairs: Sequence[tuple[int, int]], exposure: float
) -> NDArray[np.bool_]:
    """Where nothing moves from the first frame to the last, and the reference's light stays what it is."""
    least = most = None
    for number in numbers:
        tone = cv2.blur(tone_map(load_frame(folder, "reference", number), exposure), (9, 9))
        least = tone if least is None else np.minimum(least, tone)
        most = tone if most is None else np.maximum(most, tone)
    if least is None or most is None or len(pairs) < len(numbers) - 1 or not pairs:
        return np.zeros(load_frame(folder, "reference", numbers[0]).shape[:2], bool)
    static: NDArray[np.bool_] = np.all(most - least < STEADY, axis=-1)
    for _, number in pairs:
        motion = load_frame(folder, "flow", number)
        static &= (np.hypot(motion[..., 0], motion[..., 1]) < STILL) & (motion[..., 2] > 0)
    return static


def _measure(
    folder: Path,
    name: str,
    numbers: Sequence[int],
    pairs: Sequence[tuple[int, int]],
    static: NDArray[np.bool_],
    measures: Collection[str],
    exposure: float,
) -> dict[str, Statistic]:
    """Measure the frames a method has left, a frame and a pair of frames at a time."""
    missing = [number for number in numbers if not _file(folder, name, number).exists()]
    if missing:
        raise ValueError(f"method {name!r} gave no frame {missing[0]}, expected all of {len(numbers)}")
    values: dict[str, list[float]] = {key: [] for key in (*measures, "temporal_psnr")}
    for number in numbers:
        image, truth = load_frame(folder, name, number), load_reference(folder, number)
        for key in measures:
            if key == "flip":
                errors = flip_map(image * np.float32(exposure), _whole(truth) * np.float32(exposure))
                _save(folder, f"{name} map {FLIP_MAP}", number, errors)
                values[key].append(float(errors.mean(dtype=np.float64)))
            else:
                values[key].append(MEASURES[key](image, truth, exposure))
    for a, b in pairs:
        images = [load_frame(folder, name, n) for n in (a, b)]
        truths = [load_reference(folder, n) for n in (a, b)]
        motion = load_frame(folder, "flow", b)
        score = temporal_psnr(images, truths, [motion[..., :2]], [motion[..., 2] > 0], exposure=exposure)
        values["temporal_psnr"].append(float(score[0]))
    if static.any():
        frames = (load_frame(folder, name, number) for number in numbers)
        values["static_std"] = list(static_std(frames, static, exposure=exposure))
    return {key: summarize(series) for key, series in values.items() if series}


def _levels(
    folder: Path,
    numbers: Sequence[int],
    noisy: Statistic,
    samples: float | None,
    levels: Sequence[tuple[Shot, float]],
    exposure: float,
) -> list[tuple[float, float]]:
    """Mean squared error on the tone curve of every level there is, the shot's own among them, by samples."""
    known = [(known_samples(samples), _mean_error(noisy))]
    for shot, count in levels:
        common = [number for number in numbers if shot.has(number)]
        scores = [psnr(shot.read(n).color, load_reference(folder, n), exposure=exposure) for n in common]
        known.append((count, float(np.mean([_error(score) for score in scores]))))
    return sorted(known)


def _floor(
    folder: Path,
    numbers: Sequence[int],
    known: Sequence[tuple[float, float]],
    in_halves: bool,
    samples: float | None,
    reference_samples: float | None,
    exposure: float,
) -> tuple[float, str]:
    """The reference's part in the errors of `known`, and in words what is known of its noise."""
    if in_halves:
        errors = []
        for number in numbers:
            a, b = (tone_map(load_frame(folder, f"reference {half}", number), exposure) for half in "ab")
            errors.append(float(np.mean((a - b) ** 2)) / 4)  # of the mean of two: half of half
        return 0.0, (
            f"Two independent halves; their mean has a noise of {_level(np.mean(errors))} PSNR. PSNR, temporal PSNR "
            "and relMSE are products of the errors against both, free of it; the others are taken against the mean."
        )
    if samples is not None and reference_samples is not None:
        floor = reference_floor(known[-1][1], known[-1][0], reference_samples)
        source = f"by the 1/n law of its {reference_samples:g} samples per pixel"
    elif len(known) > 1:
        floor = fit_floor(known)
        source = "by what the measured levels have in common"
    else:
        return 0.0, "One render; its noise is not known and counts as error of the methods."
    return floor, (
        f"One render with a noise of {_level(floor)} PSNR, {source}. It counts as error of the methods and compresses "
        "differences between those that come near it; it is taken off only for the worth in samples."
    )


def _level(error: float | np.floating) -> str:
    return f"{-10 * np.log10(error):.2f} dB" if error > 0 else "∞ dB"


def _mean_error(statistic: Statistic) -> float:
    return float(np.mean([_error(score) for score in statistic.values]))


def _error(score: float) -> float:
    """The mean squared error of a PSNR."""
    return float(10 ** (-score / 10))


def load_reference(folder: Path, number: int) -> Reference:
    """The reference of a frame that `compare_shot` has left, in halves where it came so."""
    if not _file(folder, "reference a", number).exists():
        return load_frame(folder, "reference", number)
    return load_frame(folder, "reference a", number), load_frame(folder, "reference b", number)


def _save(folder: Path, name: str, number: int, image: NDArray[np.floating]) -> None:
    path = _file(folder, name, number)
    path.parent.mkdir(parents=True, exist_ok=True)
    np.save(path, image)


def _file(folder: Path, name: str, number: int) -> Path:
    # A name may be ".." or hold a slash; `quote` leaves dots alone.
    return folder / quote(name, safe=" ,").replace(".", "%2E") / f"{number}.npy"


def _span(shot: Shot) -> str:
    return _span_of(shot.numbers)


def _span_of(numbers: Sequence[int]) -> str:
    return f"{numbers[0]}–{numbers[-1]}" if numbers else "none"


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
