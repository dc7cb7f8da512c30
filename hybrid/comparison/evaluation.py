"""Evaluation of the methods' frames against the reference: per frame, per pair of frames, and over time."""

import os
from collections.abc import Callable, Sequence
from concurrent.futures import ThreadPoolExecutor
from dataclasses import dataclass
from functools import partial
from itertools import pairwise

import numpy as np
from numpy.typing import NDArray

from flow.motion import Vectors, forward_backward_error, invert_flow
from flow.warp import warp
from hybrid.comparison import metrics
from hybrid.comparison.flip import flip_maps
from hybrid.comparison.results import Statistic, summarize
from hybrid.comparison.samples import NoiseLaw, decibels, fit_floor, reference_floor
from hybrid.comparison.store import CHANGE_MAP, FLIP_MAP, FLOW, HALVES, REFERENCE, FrameStore
from hybrid.files.frame import Array, Frame, Frames

Measure = Callable[[Array, metrics.Reference, float], float]  # of image, reference, exposure
Level = tuple[Frames, float]  # a render of the shot, and its samples per pixel


def _whole(reference: metrics.Reference) -> NDArray[np.floating]:
    """The reference as one image: the mean of its halves."""
    return (reference[0] + reference[1]) / 2 if isinstance(reference, tuple) else reference


# Frames measured in parallel: each of 1920×1080 takes half a gigabyte, in double precision.
AT_ONCE = min(os.cpu_count() or 1, 4)
# Measures of single frames, without FLIP.
MEASURES: dict[str, Measure] = {
    "psnr": lambda x, r, e: metrics.psnr(x, r, exposure=e),
    "ssim": lambda x, r, e: metrics.ssim(x, _whole(r), exposure=e),
    "relmse": lambda x, r, e: metrics.relmse(x, r, exposure=e),
    "relmse_trimmed": lambda x, r, e: metrics.relmse(x, r, exposure=e, trim=0.001),
    "smape": lambda x, r, e: metrics.smape(x, _whole(r), exposure=e),
    "mean_bias": lambda x, r, _: metrics.mean_bias(x, _whole(r)),
}


@dataclass(frozen=True)
class Evaluator:
    store: FrameStore  # holds the methods' frames, the reference, and the flow of each pair
    numbers: Sequence[int]  # frames to evaluate
    pairs: Sequence[tuple[int, int]]  # neighbouring frames with a flow between them, from `store_flows`
    exposure: float  # factor before the tone curve, one for the whole shot

    def map_flip(self, names: Sequence[str]) -> None:
        """Store the FLIP maps of several methods at once: they share the computations on the reference."""
        with ThreadPoolExecutor(AT_ONCE) as threads:
            list(threads.map(partial(self._map_flip, names), self.numbers))

    def map_changes(self, name: str) -> None:
        """Store the maps of changes between the frames of a method, or of the reference."""
        if self.pairs:
            with ThreadPoolExecutor(AT_ONCE) as threads:
                list(threads.map(partial(self._map_change, name), self.numbers))

    def measure(self, name: str) -> dict[str, Statistic]:
        """Measure frames, after `map_flip`; over time only with pairs of frames."""
        values: dict[str, list[float]] = {key: [] for key in (*MEASURES, "flip", "temporal_psnr")}

        def measure_frame(number: int) -> dict[str, float]:
            image, reference = self.store.load(name, number), self.store.load_reference(number)
            return {key: measure(image, reference, self.exposure) for key, measure in MEASURES.items()}

        with ThreadPoolExecutor(AT_ONCE) as threads:
            for measured in threads.map(measure_frame, self.numbers):
                for key, value in measured.items():
                    values[key].append(value)
            values["temporal_psnr"] += threads.map(partial(self._measure_pair, name), self.pairs)
        maps = (self.store.load(name, number, FLIP_MAP) for number in self.numbers)
        values["flip"] += [float(errors.mean(dtype=np.float64)) for errors in maps]
        return {key: summarize(series) for key, series in values.items() if series}

    def _map_flip(self, names: Sequence[str], number: int) -> None:
        images = [self.store.load(name, number, lazily=True) for name in names]
        maps = flip_maps(images, self.store.load(REFERENCE, number), self.exposure)
        for name, errors in zip(names, maps, strict=True):
            self.store.save(name, number, errors, FLIP_MAP)

    def _map_change(self, name: str, number: int) -> None:
        """Store the map of motion-compensated changes on the tone curve, amplified: (H, W) in [0, 1], 0.5: no change.

        With W the warp of the previous frame, the map is 0.5 + 25 mean(T(x_t) − W T(x_{t−1})) over the channels, and
        0.5 where no motion leads to a pixel. Unlike temporal PSNR it also shows real changes: light, reflections.
        """
        current = metrics.tone_map(self.store.load(name, number), self.exposure)
        previous = next((pair[0] for pair in self.pairs if pair[1] == number), None)
        changes = np.full(current.shape[:2], 0.5, np.float32)
        if previous is not None:
            motion = self.store.load(REFERENCE, number, FLOW)
            earlier = metrics.tone_map(self.store.load(name, previous), self.exposure).astype(np.float32)
            difference = (current - warp(earlier, motion[..., :2])[0]).mean(axis=2)
            valid = (motion[..., 2] > 0) & np.isfinite(difference)
            changes[valid] = np.clip(0.5 + 25 * difference[valid], 0, 1)  # a change of a fiftieth is black or white
        self.store.save(name, number, changes, CHANGE_MAP)

    def _measure_pair(self, name: str, pair: tuple[int, int]) -> float:
        images = [self.store.load(name, number) for number in pair]
        references = [self.store.load_reference(number) for number in pair]
        motion = self.store.load(REFERENCE, pair[1], FLOW)
        flows, valid = [motion[..., :2]], [motion[..., 2] > 0]
        return float(metrics.temporal_psnr(images, references, flows, valid, exposure=self.exposure)[0])

    def find_noise_law(
        self, noisy: Statistic, samples: float | None, levels: Sequence[Level], reference_samples: float | None
    ) -> tuple[NoiseLaw, str]:
        """Measure the error of the noisy render against its samples, and describe the reference's noise.

        From the PSNR of the noisy frames and of renders at other samples per pixel. If the samples of the noisy frames
        are unknown, `worth` is a ratio without a scale in samples.
        """
        errors, psnr = [(samples or 1.0, mean_error(noisy.values))], partial(metrics.psnr, exposure=self.exposure)
        for shot, count in levels:
            scores = [psnr(shot.read(n).color, self.store.load_reference(n)) for n in self.numbers if shot.has(n)]
            errors.append((count, mean_error(scores)))
        errors.sort()
        floor, words = self._find_floor(errors, samples, reference_samples)
        return NoiseLaw(tuple(errors), samples or 1.0, floor), words

    def _find_floor(
        self, errors: Sequence[tuple[float, float]], samples: float | None, reference_samples: float | None
    ) -> tuple[float, str]:
        """The reference's part in the errors of the levels, and a description of its noise."""
        if isinstance(self.store.load_reference(self.numbers[0]), tuple):
            # The error of the mean is a quarter of that between the halves.
            halves = (
                [metrics.tone_map(self.store.load(REFERENCE, n, half), self.exposure) for half in HALVES]
                for n in self.numbers
            )
            level = decibels(np.mean([float(np.mean((a - b) ** 2)) / 4 for a, b in halves]))
            return 0.0, (
                f"Two independent halves; their mean has a noise of {level} PSNR. PSNR, temporal PSNR and relMSE are "
                "products of the errors against both halves, free of that noise; the other measures use their mean."
            )
        if samples is not None and reference_samples is not None:
            floor = reference_floor(errors[-1][1], errors[-1][0], reference_samples)
            source = f"by the 1/n law of its {reference_samples:g} samples per pixel"
        elif len(errors) > 1:
            floor = fit_floor(errors)
            source = "from the common part of the measured levels"
        else:
            return 0.0, "One render; its noise is unknown and counts as error of the methods."
        return floor, (
            f"One render with a noise of {decibels(floor)} PSNR, {source}. The noise counts as error of the methods "
            "and reduces differences between methods close to it; it is subtracted for the worth in samples only."
        )


def mean_error(scores: Sequence[float]) -> float:
    """Mean squared error from the PSNR of frames."""
    return float(np.mean([float(10 ** (-score / 10)) for score in scores]))


def store_reference(store: FrameStore, halves: Sequence[Frames], numbers: Sequence[int]) -> None:
    """Store the reference of every frame: the mean of its halves, and the halves if there are two."""
    for number in numbers:
        images = [half.read(number).color for half in halves]
        store.save(REFERENCE, number, np.mean(images, axis=0))
        if len(images) == 2:
            for image, half in zip(images, HALVES, strict=True):
                store.save(REFERENCE, number, image, half)


def store_flows(store: FrameStore, shot: Frames, numbers: Sequence[int]) -> list[tuple[int, int]]:
    """Store flow and validity of neighbouring frames from the shot's vectors; return the pairs that have a flow."""
    pairs = []
    for a, b in pairwise(numbers):
        motion = motion_between(shot.read(a), shot.read(b)) if b == a + 1 else None
        if motion is not None:
            store.save(REFERENCE, b, np.dstack(motion).astype(np.float32), FLOW)
            pairs.append((a, b))
    return pairs


def motion_between(previous: Frame, current: Frame) -> tuple[Array, NDArray[np.bool_]] | None:
    """Return the flow (H, W, 2) from `current` to `previous` by the renderer's vectors, and its validity; None without.

    Valid (H, W) is where the flow leads to the same point of the scene: inside the frame, and back again by the
    previous frame's vectors (Sundaram et al. 2010, doi:10.1007/978-3-642-15549-9_32, eq. 5), or without these to the
    same albedo.
    """
    current_flows, previous_flows = current.flows(), previous.flows()
    forward = current_flows and current_flows.to_previous
    back = previous_flows and previous_flows.to_next
    if forward is None and back is not None:
        forward = Vectors(*invert_flow(back.flow, valid=back.valid, depth=previous.depth))
    if forward is None:
        return None
    flow, valid = forward
    if back is not None:
        warped_back, inside = warp(back.flow, flow)
        lengths = np.sum(flow**2, axis=-1) + np.sum(warped_back**2, axis=-1)
        # Sundaram's eq. 5: a hundredth of the motion, and half a square pixel for interpolation.
        agree = forward_backward_error(flow, back.flow) ** 2 < 0.01 * lengths + 0.5
    elif previous.albedo is not None and current.albedo is not None:
        warped_albedo, inside = warp(previous.albedo, flow)
        # Albedo is in [0, 1]. Another surface seldom differs by less; film sampling and a lens by less than this.
        agree = np.max(np.abs(warped_albedo - current.albedo), axis=-1) < 0.1
    else:
        _, inside = warp(flow, flow)
        agree = np.ones_like(inside)
    return flow, valid & inside & agree
