"""Denoisers side by side: accuracy against a reference, time, and memory.

A method is a function from a shot to its finished frames. Each runs in a process of its own, so that its
peak memory is its own, and leaves its frames on disk, so that a long shot does not fill this process's.
"""

from __future__ import annotations

import re
import time
from collections.abc import Callable, Collection, Iterator, Mapping, Sequence
from concurrent.futures import ProcessPoolExecutor
from concurrent.futures.process import BrokenProcessPool
from contextlib import contextmanager
from dataclasses import dataclass
from functools import partial
from itertools import pairwise
from multiprocessing import get_context
from pathlib import Path
from tempfile import TemporaryDirectory
from typing import cast

import numpy as np
from numpy.typing import NDArray
from rich.table import Table

from flow.motion import forward_backward_error, normalize_motion
from flow.warp import warp
from hybrid.estimates import choose_estimate
from hybrid.frames import Frame, Shot
from hybrid.metrics import Reference, flip, mean_bias, psnr, relmse, smape, ssim, temporal_psnr
from hybrid.oidn import Quality, denoise_oidn
from hybrid.plan import plan_shot
from hybrid.pseudo_reference import PRESETS, AlignedWindow, Aligner, estimate, gated_average
from hybrid.results import (
    METRICS,
    MethodResult,
    Statistic,
    best_and_ties,
    column_title,
    format_bytes,
    format_seconds,
    format_value,
    present_metrics,
    summarize,
)
from hybrid.timing import peak_memory
from nlm.average import average, replace_nonfinite, robust_average

Array = NDArray[np.float32]
Method = Callable[[Shot], Iterator[tuple[int, Array]]]
Measure = Callable[[Array, Reference, float], float]  # of image, reference, exposure


def _whole(reference: Reference) -> NDArray[np.floating]:
    """The reference as one image: the mean of its halves, where it comes in halves."""
    return (reference[0] + reference[1]) / 2 if isinstance(reference, tuple) else reference


# What can be measured on a frame by itself; "temporal_psnr" needs two and is always measured.
MEASURES: dict[str, Measure] = {
    "psnr": lambda x, r, e: psnr(x, r, exposure=e),
    "ssim": lambda x, r, e: ssim(x, _whole(r), exposure=e),
    "relmse": lambda x, r, e: relmse(x, r, exposure=e),
    "relmse_trimmed": lambda x, r, e: relmse(x, r, exposure=e, trim=0.001),
    "smape": lambda x, r, e: smape(x, _whole(r), exposure=e),
    "flip": lambda x, r, e: flip(x * np.float32(e), _whole(r) * np.float32(e)),
    "mean_bias": lambda x, r, _: mean_bias(x, _whole(r)),
}
QUICK_MEASURES = ("psnr", "relmse", "mean_bias")  # the first form of the table


# Methods


def noisy(shot: Shot) -> Iterator[tuple[int, Array]]:
    """The frames as they are, non-finite pixels replaced."""
    for number in shot.numbers:
        yield number, _finite(shot.read(number).color)


def oidn(shot: Shot, *, quality: Quality = "high", prefilter: bool = False) -> Iterator[tuple[int, Array]]:
    """OIDN on each frame by itself."""
    for number in shot.numbers:
        frame = shot.read(number)
        guides = [None if guide is None else _finite(guide) for guide in (frame.albedo, frame.normal)]
        yield number, denoise_oidn(_finite(frame.color), *guides, quality=quality, prefilter=prefilter)


def _finite(image: Array) -> Array:
    """Non-finite pixels replaced as the pipeline does it, so that no method is judged by them."""
    return replace_nonfinite(image)[0]


def classical(shot: Shot, *, estimator: Callable[[AlignedWindow], Array]) -> Iterator[tuple[int, Array]]:
    """A classical estimate of every aligned window, with the stages that the shot calls for."""
    aligner = Aligner(shot, plan_shot(shot).effects)
    for number in shot.numbers:
        yield number, estimator(aligner.align(number))


def aligned_average(aligned: AlignedWindow) -> Array:
    """The mean over time, weighted by confidence."""
    return average(aligned.color, aligned.confidence) * aligned.modulation


def aligned_robust_average(aligned: AlignedWindow) -> Array:
    """The same without the darkest and the brightest frame."""
    return robust_average(aligned.color, aligned.confidence) * aligned.modulation


def gated(shot: Shot, *, source: str) -> Iterator[tuple[int, Array]]:
    """Estimates of single frames, averaged where the light is the same."""
    aligner = Aligner(shot, plan_shot(shot).effects, estimate=choose_estimate(source, shot).estimate)
    for number in shot.numbers:
        yield number, gated_average(aligner.align(number))


def network(shot: Shot, *, preset: str, source: str) -> Iterator[tuple[int, Array]]:
    """The Robust Average network with the weights of a preset, on estimates from `source`."""
    from hybrid import neural  # torch may be absent

    denoiser = neural.Denoiser(neural.shipped_weights(preset))
    estimate = choose_estimate(source, shot).estimate
    aligner = Aligner(shot, plan_shot(shot).effects, radius=denoiser.radius, estimate=estimate)
    for number in shot.numbers:
        yield number, denoiser(aligner.align(number)).color


METHODS: dict[str, Method] = {
    "noisy": noisy,
    "aligned average": partial(classical, estimator=aligned_average),
    "aligned robust average": partial(classical, estimator=aligned_robust_average),
    **{name: partial(classical, estimator=partial(estimate, preset=preset)) for name, preset in PRESETS.items()},
    "gated": partial(gated, source="nlm"),
    "gated OIDN": partial(gated, source="oidn"),
    "network fast": partial(network, preset="fast", source="nlm"),
    "network fast, OIDN": partial(network, preset="fast", source="oidn"),
    "OIDN high": partial(oidn, quality="high"),
    "OIDN best": partial(oidn, quality="high", prefilter=True),
}


# What the chart draws alike.
FAMILIES = {
    **dict.fromkeys(("aligned average", "aligned robust average"), "Averages"),
    **dict.fromkeys(PRESETS, "Pseudo-references"),
    **dict.fromkeys(("OIDN high", "OIDN best"), "OIDN"),
    **dict.fromkeys(("gated", "gated OIDN"), "Gated averages"),
    **dict.fromkeys(("network fast", "network fast, OIDN"), "Networks"),
}


# Running one


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


def run_method(method: Method, shot: Shot, folder: Path, name: str) -> Run:
    """Run a method over a shot in this process, and leave its frames in `folder` for `load_frame`.

    The first frame is made once before the clock starts: compilation, weights and caches are paid for there.
    """
    next(method(shot), None)
    pixels, wall, cpu = 0, 0.0, 0.0
    with _clock_reading(shot) as reading:
        frames = method(shot)
        while True:
            wall_start, cpu_start = time.perf_counter(), time.process_time()
            done = next(frames, None)
            wall += time.perf_counter() - wall_start
            cpu += time.process_time() - cpu_start
            if done is None:
                break
            number, image = done
            pixels += image.shape[0] * image.shape[1]
            _save(folder, name, number, image)
    return Run(pixels / 1e6, wall - reading.seconds, cpu - reading.cpu_seconds, peak_memory())


def _apart() -> ProcessPoolExecutor:
    """A fresh process for one task.

    It is forked from a server and not from this process, whose peak memory Linux would count as its own.
    """
    context = get_context("forkserver")
    context.set_forkserver_preload([__name__])  # once, and not for every method
    return ProcessPoolExecutor(1, mp_context=context)


# Judging it


def compare_shot(
    shot: Shot,
    reference: Shot | tuple[Shot, Shot],
    methods: Mapping[str, Method] = METHODS,
    *,
    measures: Collection[str] = QUICK_MEASURES,
    exposure: float = 1.0,
    folder: Path | None = None,
) -> list[MethodResult]:
    """Run every method on a shot and measure what it gives against the reference.

    Parameters
    ----------
    shot : what to denoise.
    reference : the same frames, clean; frames it lacks are not judged. Two independent renders take the
        reference's noise out of PSNR, relMSE and temporal PSNR (`hybrid.metrics`). It is not small: 512
        samples a pixel of a bathroom had half of the squared error that OIDN's best mode shows against them.
    methods : functions from a shot to (number, (H, W, 3) radiance), by name. They run in processes of
        their own: what is neither a module's function nor a `functools.partial` of one cannot get there.
    measures : keys of `MEASURES`, beside the temporal PSNR.
    exposure : factor before the tone curve, and on the radiance of relMSE, one for the whole shot.
    folder : a new one, or an empty one. It keeps the frames of every method, and the reference as "reference",
        for `load_frame`. Without it they are removed in the end.

    Returns
    -------
    One result per method, in their order. A method that is not installed, or whose process died, comes with
    an `absent_reason` in place of figures. Seconds are wall time; the CPU's are among the settings. Without
    motion vectors there is no temporal PSNR.

    Raises
    ------
    ValueError
        If shot and reference have no frame in common or differ in size, or a method leaves frames out.
    """
    if folder is None:
        with TemporaryDirectory() as temporary:
            return compare_shot(shot, reference, methods, measures=measures, exposure=exposure, folder=Path(temporary))
    halves = reference if isinstance(reference, tuple) else (reference,)
    numbers = [n for n in shot.numbers if all(n in half.numbers for half in halves)]
    if not numbers:
        spans = " and ".join(map(_span, halves))
        raise ValueError(f"reference has frames {spans}, the shot {_span(shot)}: none in common")
    for number in numbers:
        images = [half.read(number).color for half in halves]
        _save(folder, "reference", number, np.mean(images, axis=0))
        if len(images) == 2:
            _save(folder, "reference a", number, images[0])
            _save(folder, "reference b", number, images[1])
    with _apart() as pool:  # so that the frames it reads do not travel to the methods inside the shot
        pairs = pool.submit(_save_pairs, shot, numbers, folder).result()
    results = []
    for name, method in methods.items():
        try:
            with _apart() as pool:
                run = pool.submit(run_method, method, shot, folder, name).result()
        except ImportError as error:
            results.append(MethodResult(name, name, absent_reason=str(error)))
            continue
        except BrokenProcessPool:
            results.append(MethodResult(name, name, absent_reason="its process died, out of memory perhaps"))
            continue
        result = MethodResult(
            name,
            name,
            settings={"cpu_seconds_per_megapixel": run.cpu_seconds / run.megapixels},
            family=FAMILIES.get(name, "Methods"),
            # Handing the frames on is no denoising; its few milliseconds would only stretch the axis of time.
            seconds_per_megapixel=0.0 if method is noisy else run.seconds / run.megapixels,
            peak_bytes=run.peak_bytes,
            metrics=_measure(folder, name, numbers, pairs, measures, exposure),
        )
        results.append(result)
    return results


def load_frame(folder: Path, name: str, number: int) -> Array:
    """Read a frame (H, W, 3) that `compare_shot` has left, by the method's name or "reference"."""
    image: Array = np.load(_file(folder, name, number))
    return image


def result_table(results: Sequence[MethodResult]) -> Table:
    """Lay the results out for a terminal: the best of a column bold, what ties with it marked "≈"."""
    columns = present_metrics(results, METRICS)
    verdicts = {m.key: best_and_ties(results, m) for m in columns}
    table = Table("method")
    for heading in (*map(column_title, columns), "s / MP", "CPU-s / MP", "peak"):
        table.add_column(heading, justify="right")
    for r in results:
        if r.absent_reason is not None:
            table.add_row(r.label, *("–" for _ in table.columns[1:]), style="dim")
            continue
        cells = []
        for m in columns:
            text = format_value(r.metrics[m.key].mean, m) if m.key in r.metrics else "–"
            best, ties = verdicts[m.key]
            cells.append(f"[bold]{text}[/]" if r.name == best else f"≈ {text}" if r.name in ties else text)
        cpu = cast("float | None", r.settings.get("cpu_seconds_per_megapixel"))
        costs = format_seconds(r.seconds_per_megapixel), format_seconds(cpu), format_bytes(r.peak_bytes)
        table.add_row(r.label, *cells, *costs)
    absent = [f"{r.label}: {r.absent_reason}" for r in results if r.absent_reason is not None]
    if absent:
        table.caption = "absent – " + "; ".join(absent)
    return table


def motion_between(previous: Frame, current: Frame) -> tuple[Array, NDArray[np.bool_]] | None:
    """Where the pixels of a frame were one frame before, by the renderer's vectors.

    Returns
    -------
    flow : (H, W, 2) array, pixels, from `current` to `previous`.
    valid : (H, W) mask; True where it leads to the same point of the scene: inside the frame, and back again
        by the previous frame's own vectors; where it has none, to the same albedo.
    None where `current` has no vectors.
    """
    if current.motion is None or current.motion_convention is None:
        return None
    motion = normalize_motion(current.motion, current.motion_convention)
    flow, valid = motion.to_previous, motion.previous_valid
    back = None
    if previous.motion is not None and previous.motion_convention is not None:
        back = normalize_motion(previous.motion, previous.motion_convention).to_next
    if back is not None:
        there, inside = warp(back, flow)
        lengths = np.sum(flow**2, axis=-1) + np.sum(there**2, axis=-1)
        # Sundaram et al. 2010, eq. 5: a hundredth of the motion, and half a square pixel for interpolation.
        agree = forward_backward_error(flow, back) ** 2 < 0.01 * lengths + 0.5
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


def _measure(
    folder: Path,
    name: str,
    numbers: Sequence[int],
    pairs: Sequence[tuple[int, int]],
    measures: Collection[str],
    exposure: float,
) -> dict[str, Statistic]:
    """Measure the frames a method has left, a frame and a pair of frames at a time."""
    missing = [number for number in numbers if not _file(folder, name, number).exists()]
    if missing:
        raise ValueError(f"method {name!r} gave no frame {missing[0]}, expected all of {len(numbers)}")
    values: dict[str, list[float]] = {key: [] for key in (*measures, "temporal_psnr")}
    for number in numbers:
        image, truth = load_frame(folder, name, number), _load_reference(folder, number)
        for key in measures:
            values[key].append(MEASURES[key](image, truth, exposure))
    for a, b in pairs:
        images = [load_frame(folder, name, n) for n in (a, b)]
        truths = [_load_reference(folder, n) for n in (a, b)]
        motion = load_frame(folder, "flow", b)
        score = temporal_psnr(images, truths, [motion[..., :2]], [motion[..., 2] > 0], exposure=exposure)
        values["temporal_psnr"].append(float(score[0]))
    return {key: summarize(series) for key, series in values.items() if series}


def _load_reference(folder: Path, number: int) -> Reference:
    if not _file(folder, "reference a", number).exists():
        return load_frame(folder, "reference", number)
    return load_frame(folder, "reference a", number), load_frame(folder, "reference b", number)


def _save(folder: Path, name: str, number: int, image: Array) -> None:
    path = _file(folder, name, number)
    path.parent.mkdir(parents=True, exist_ok=True)
    np.save(path, image)


def _file(folder: Path, name: str, number: int) -> Path:
    return folder / re.sub(r"[^\w.-]+", "_", name) / f"{number}.npy"


def _span(shot: Shot) -> str:
    return f"{shot.numbers[0]}–{shot.numbers[-1]}" if shot.numbers else "none"
