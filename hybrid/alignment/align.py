"""Align a window of frames to its centre (`align`), and the results of three frames to each other."""

from collections.abc import Iterable, Sequence
from dataclasses import replace
from typing import NamedTuple

import numpy as np

from flow.confidence import GuideNoise, fill_uncovered, local_variance
from flow.warp import warp
from hybrid.alignment.guides import average_guides
from hybrid.alignment.neighbour import combine_confidence, confidence_by_geometry, novelty_of
from hybrid.alignment.prepare import ALPHA, PreparedFrame
from hybrid.alignment.transfer import demodulate, measure_exposure, remodulate
from hybrid.alignment.window import (
    AlignedWindow,
    Centre,
    Geometry,
    Neighbours,
    WarpSources,
    Window,
    clean_guide,
    moves_over_noise,
    warp_rows,
)
from hybrid.files.frame import Array
from hybrid.files.layers import Layers
from hybrid.runtime.timing import Timings
from nlm.average import average, reject_outliers
from nlm.drift import drift_weights, pull_to_centre
from nlm.gate import agreement_weight, color_gate, color_gates
from nlm.interpolation import interpolation_weight
from nlm.relight import relight
from nlm.samples import SampleMean, average_neighbours
from nlm.variance import variance_from_estimate

# Scale of the gate of results, relative to a frame's noise: everywhere, and where the light stands still (`nlm.drift`)
# and the mean difference is subtracted (`nlm.relight`). With the second alone results are steadier by 0.2 dB, and
# moving shadows are averaged: 2.7 dB of such a shot.
FINISHED = 0.1, 0.5
# The scale without noise, in tone-mapped units, and its factor for single pixels: without the factor a shot of sharp
# outlines loses 1 dB at 128 and 512 samples, half of it with 3; 1 costs still shots up to 8 dB in time.
FINISHED_FLOOR, FINISHED_DETAIL = 0.001, 2.0
# Drift costs results more than first passes, whose errors are several times as large, by this factor: 20 and 100 differ
# by 0.05 dB, and by 0.25 dB where shadows move.
DRIFTED = 100
# Shares of a frame that stand still: below the first its results are not averaged, from the second on they count in
# full. Light that drifts nearly everywhere is measured only in places. One of nine validation shots has such light and
# gains 0.1 dB; one loses 0.04, the others nothing.
STANDING = 0.2, 0.4
# Rows around a band that its result depends on: 23 for all filters of the classical chain together, or the receptive
# field of a U-Net (112), of the measure of drift (55) and of the gate (11). The mean of pooled samples (72) reaches
# beyond, for 2e-7 of the light. A multiple of the strips of the guided filter (64 rows), whose order of sums is then
# that of the whole frame.
MARGIN = 192


class Stillness(NamedTuple):
    """How far the light of a frame stands still."""

    local: Array  # (H, W), in [0, 1]
    whole: np.float32  # whether enough of the frame stands still, in [0, 1]


def _pad_rows(rows: slice | None, height: int) -> tuple[slice, slice]:
    """The rows of a frame that a band depends on, and the place of the band in them; the whole frame for None."""
    rows = slice(0, height) if rows is None else rows
    padded = slice(max(rows.start - MARGIN, 0), min(rows.stop + MARGIN, height))
    return padded, slice(rows.start - padded.start, rows.stop - padded.start)


def align(
    window: Window,
    rows: slice | None = None,
    *,
    guided: bool = True,
    timings: Timings | None = None,
) -> AlignedWindow:
    """Warp all frames of a window to its centre, and measure the confidence in each pixel.

    With `rows` only these rows of the frame, and `MARGIN` around them. Without `guided` only the
    filter of AOVs reads `AlignedWindow.guide`. All frames have the same layers (`expect_equal_layers`). Raises
    ValueError if the centre has no first pass and others do.
    """
    timings = timings or Timings()
    padded, inner = _pad_rows(rows, len(window.centre.irradiance))
    if window.first_pass is None:
        aligned = _align_noisy(window, padded, inner, timings)
    else:
        aligned = _align_denoised(window, window.first_pass, padded, inner, timings)
    if guided or window.centre.aovs:
        return aligned
    return replace(aligned, centre=replace(aligned.centre, clean_albedo=None), geometric_confidence=None)


def _align_noisy(window: Window, rows: slice, inner: slice, timings: Timings) -> AlignedWindow:
    """Align noisy frames.

    The confidence in a pixel of a neighbour is that by geometry, times the gate, which compares rough light.
    """
    stages, middle = window.stages, len(window.frames) // 2
    gated = "gate" in stages
    names = ("irradiance", "light") if gated else ("irradiance",)
    aligned, pictures, _ = _align_by_geometry(window, names, rows, inner, timings)
    with timings.stage("confidence"):
        _fill_centre([*pictures.values(), *aligned.aovs.values()], aligned.confidence)
        color, outliers = pictures.pop("irradiance"), 0
        if "outliers" in stages:
            color, rejected = reject_outliers(color, aligned.confidence)
            outliers = int(np.count_nonzero(rejected[:, inner]))
        confidence = aligned.confidence
        if gated:
            confidence = confidence * color_gate(pictures["light"], color[middle], aligned.brightness.exposure)
        samples = None
        if "blend-samples" in stages:
            noisy = window.centre.radiance[rows]
            samples = average_neighbours(color, None, confidence, aligned.confidence, aligned.modulation, noisy)
    return replace(
        aligned,
        centre=replace(aligned.centre, irradiance=color[middle]),
        neighbours=replace(aligned.neighbours, samples=samples),
        confidence=confidence,
        aligned_color=color,
        outliers=outliers,
    )


def _align_denoised(
    window: Window, first_pass: Sequence[Array | None], rows: slice, inner: slice, timings: Timings
) -> AlignedWindow:
    """Align frames that have a first pass.

    The confidence in a pixel of a neighbour is that by geometry, combined with the gate, which compares first passes,
    times the weight by interpolation, times the agreement of all neighbours. First passes that drift are pulled to the
    centre's.
    """
    stages, middle = window.stages, len(window.frames) // 2
    # Few denoisers read the colors of all frames: these are warped when they are read.
    aligned, _, coverage = _align_by_geometry(window, (), rows, inner, timings)
    sources, irradiance, exposure = aligned.sources, aligned.centre.irradiance, aligned.brightness.exposure
    filtered_guides = None
    if window.filtered_guides is not None:
        with timings.stage("confidence"):
            filtered_guides = average_guides(window.filtered_guides, sources.flows, aligned.confidence, rows)
    estimates, interpolation = _warp_first_pass(window, first_pass, coverage, rows, timings)
    along_surfaces = None
    if window.reflecting is not None and "blend-samples" in stages and not moves_over_noise(stages):
        along_surfaces = _warp_along_surfaces(window, first_pass, estimates, coverage, rows, timings)
        along_surfaces /= aligned.modulation
    with timings.stage("confidence"):
        pictures, complete = [estimates, *aligned.aovs.values()], aligned.confidence[middle].all()
        if not complete:
            pictures.append(sources.warp("irradiance", irradiance))
        _fill_centre(pictures, aligned.confidence)
        irradiance = irradiance if complete else pictures[-1][middle].copy()
        # By the centre's albedo and not by each frame's own, which may be noisy as the first pass is not.
        estimates /= aligned.modulation
        gate = color_gate(estimates, irradiance, exposure)
        confidence = combine_confidence(aligned.confidence, coverage, gate, stages)
        del coverage, gate, pictures  # windows are large
        for of_frame, weight in zip(confidence, interpolation, strict=True):
            if weight is not None:
                of_frame *= weight
        if "gate" in stages:
            agreement = agreement_weight(estimates, irradiance, confidence, exposure)
            confidence[:middle] *= agreement
            confidence[middle + 1 :] *= agreement
        pull = drift_weight = None
        if "drift" in stages:
            pull = drift_weights(estimates, irradiance, confidence, exposure, first_row=rows.start)
            before, after = window.links[middle - 2 : middle], window.links[middle + 1 : middle + 3]
            if None not in before or None not in after:  # two frames on one side show drift
                drift_weight = pull[middle + 1].copy()  # a view would keep the weights of all frames in memory
        samples = _average_samples(window, aligned, estimates, along_surfaces, confidence, rows)
        if pull is not None:
            pull_to_centre(estimates, confidence, pull)
    return replace(
        aligned,
        centre=replace(
            aligned.centre, irradiance=irradiance, filtered_guides=filtered_guides, first_pass=first_pass[middle]
        ),
        neighbours=replace(aligned.neighbours, samples=samples, drift_weight=drift_weight),
        confidence=confidence,
        first_pass=estimates,
    )


def _average_samples(
    window: Window,
    aligned: AlignedWindow,
    estimates: Array,
    along_surfaces: Array | None,
    confidence: Array,
    rows: slice,
) -> SampleMean | None:
    """Average the neighbours' samples for the stage *blend-samples*, along surfaces where reflections are followed.

    With next to no noise samples are right where the motion of a reflection is not.
    """
    if "blend-samples" not in window.stages:
        return None
    if moves_over_noise(window.stages):
        # Noise that frames share would pass for detail: 6 to 12 dB of a slow pan.
        return SampleMean.unknown(estimates.shape[1:])
    sources, counted = aligned.sources, confidence
    if along_surfaces is not None and window.reflecting is not None:
        estimates, sources = along_surfaces, replace(sources, light_flows=sources.flows)
        counted = confidence * ~window.reflecting[rows]  # elsewhere the gate compared other pixels
    noisy = window.centre.radiance[rows]
    return average_neighbours(
        estimates, sources.residual_strips(), counted, aligned.confidence, aligned.modulation, noisy
    )


def align_results(
    window: Window,
    geometry: Sequence[Geometry | None],
    stillness: Stillness,
    exposure: float,
    rows: slice | None = None,
    *,
    timings: Timings | None = None,
) -> tuple[Array, Array]:
    """Align the results of a frame and its two neighbours, and measure how far they show the same.

    `window` holds three frames with their results in the place of a first pass, `geometry` is that of the two
    neighbours for the whole frame, `exposure` that of the centre's irradiance as rendered, `rows` as for `align`.
    Returns radiance (3, h, W, 3) in the centre's light, its own where a frame shows or has none, and a confidence
    (3, h, W) in [0, 1].
    """
    timings = timings or Timings()
    centre, stages = window.centre, window.stages
    padded, inner = _pad_rows(rows, len(centre.irradiance))
    noisy = centre.irradiance[padded]
    shape = len(window.frames), *noisy.shape[:2]
    confidence, coverage = np.zeros(shape, np.float32), np.zeros(shape, np.float32)
    confidence[1] = coverage[1] = centre.valid[padded]
    for index, frame in zip((0, 2), geometry, strict=True):
        if frame is not None and window.frames[index] is not None and window.links[index] is not None:
            coverage[index], confidence[index] = frame.coverage[padded], frame.confidence[padded]
            _count_own_samples(window, index, padded, coverage[index], confidence[index])
    assert window.first_pass is not None
    results, _ = _warp_first_pass(window, window.first_pass, coverage, padded, timings, weigh=False)
    with timings.stage("stabilize"):
        divisor = None if centre.albedo is None or not centre.demodulated else centre.albedo[padded]
        light = results if divisor is None else demodulate(results, divisor)
        # No least confidence: outlines of results are sharp, and their mean over frames is not. It would cost the
        # bundled shot with its chrome 0.4 dB.
        gates = color_gates(light, noisy, exposure, FINISHED, floor=FINISHED_FLOOR, detail=FINISHED_DETAIL)
        alike, confidence = (combine_confidence(confidence, coverage, gate, stages, least=0.0) for gate in gates)
        local = stillness.local[padded]
        confidence -= alike
        confidence *= local
        confidence += alike
        relight(results, alike, confidence, exposure, first_row=padded.start)
        confidence[::2] *= stillness.whole * (1 + local) / 2
    return results[:, inner], confidence[:, inner]


def aligned_planes(layers: Layers) -> float:
    """Count the float32 planes of each frame of an `AlignedWindow` of these layers, with its first pass."""
    guides = 3 * (layers.albedo is not None) + 3 * (layers.normal is not None)
    return 3 + 3 + guides + layers.aov_channels + 1


def measure_stillness(drift_weight: Array | None, shape: tuple[int, int]) -> Stillness:
    """Measure how far the light of a frame stands still, 1 / (1 + `DRIFTED` (1 / w − 1)), w the next frame's weight.

    If w (H, W) is unknown: 0 locally, 1 for the frame.
    """
    if drift_weight is None:
        return Stillness(np.zeros(shape, np.float32), np.float32(1))
    still = np.reciprocal(drift_weight)  # in place: frames are large
    still *= np.float32(DRIFTED)
    still += np.float32(1 - DRIFTED)
    np.reciprocal(still, out=still)
    least, enough = STANDING
    t = np.clip((still.mean() - np.float32(least)) / np.float32(enough - least), 0, 1)
    return Stillness(still, t * t * (3 - 2 * t))  # a smooth step


def expect_equal_layers(frames: Sequence[PreparedFrame | None]) -> None:
    """Raise ValueError if frames of a window differ in layers: light divided by an albedo is no color."""
    centre = frames[len(frames) // 2]
    assert centre is not None
    for frame in filter(None, frames):
        if different := sorted(_names(centre) ^ _names(frame)):
            has, lacks = (frame, centre) if different[0] in _names(frame) else (centre, frame)
            raise ValueError(
                f"frame {lacks.number} has no {different[0]}, which frame {has.number} has, expected one in both"
            )


def _names(frame: PreparedFrame) -> set[str]:
    """The layers that all frames of a window have, or none."""
    given = {"albedo": frame.albedo, "normal": frame.normal, ALPHA: frame.alpha, **frame.aovs}
    return {name for name, layer in given.items() if layer is not None}


def _align_by_geometry(
    window: Window, names: Sequence[str], rows: slice, inner: slice, timings: Timings
) -> tuple[AlignedWindow, dict[str, Array], Array]:
    """Align a window by geometry alone, with these pictures (T, h, W, 3) of all frames; no light is compared.

    With the coverage (T, h, W), an upper bound of the confidence: 0 where a frame shows nothing.
    """
    centre, count, stages = window.centre, len(window.frames), window.stages
    shape = count, rows.stop - rows.start, centre.irradiance.shape[1]

    def layers_of(frame: PreparedFrame) -> list[Array]:
        alpha = [frame.alpha] if "alpha" in stages and frame.alpha is not None else []
        return [*(getattr(frame, name) for name in names), *(frame.aovs[name] for name in centre.aovs), *alpha]

    centre_layers = layers_of(centre)
    warped = [np.empty((*shape, layer.shape[-1]), np.float32) for layer in centre_layers]
    layers = {"albedo": centre.albedo, "normal": centre.normal}
    guides = {name: guide[rows] for name, guide in layers.items() if guide is not None}
    confidence, coverage = np.zeros(shape, np.float32), np.zeros(shape, np.float32)
    geometry: list[Geometry | None] = [None] * count
    light_flows = [window.light_flow(index, rows) for index in range(count)]
    with timings.stage("confidence"):
        noise = None
        if any(window.outline_noise):
            noise = GuideNoise(local_variance(guides.get("albedo"), guides.get("normal")), window.outline_noise)
    for index, (frame, link) in enumerate(zip(window.frames, window.links, strict=True)):
        if frame is None or link is None:
            # The centre itself, or a frame that is missing.
            for out, layer in zip(warped, centre_layers, strict=True):
                out[index] = layer[rows]
            if index == count // 2:
                confidence[index] = coverage[index] = centre.valid[rows]
            continue
        with timings.stage("warp"):
            flow = light_flows[index]
            assert flow is not None
            for out, layer in zip(warped, layers_of(frame), strict=True):
                warp_rows(layer, flow, rows.start, out[index])
            coverage[index], confidence[index] = geometry[index] = confidence_by_geometry(
                guides, frame, link, rows, noise
            )
            _count_own_samples(window, index, rows, coverage[index], confidence[index])
        window.release()
    flows = [None if link is None else link.forward.vectors[rows] for link in window.links]
    given = window.frames, flows, light_flows, window.first_pass or (), window.limited, rows
    sources = WarpSources(*given, release=window.release)
    modulation, clean_albedo = np.ones((*shape[1:], 3), np.float32), None
    with timings.stage("confidence"):
        if "albedo" in guides:
            clean_albedo = clean_guide("albedo", guides, sources, confidence, stages)
            if centre.demodulated:
                modulation = remodulate(modulation, clean_albedo)
                sources = replace(sources, modulation=modulation if "prefilter" in stages else None)
        brightness = window.lit.as_light if "light" in names else window.lit.as_rendered
    aligned = AlignedWindow(
        centre=Centre(centre, centre.irradiance[rows], guides, clean_albedo),
        neighbours=Neighbours((geometry[count // 2 - 1], geometry[count // 2 + 1]) if count > 1 else (None, None)),
        sources=sources,
        stages=stages,
        inner=inner,
        confidence=confidence,
        geometric_confidence=confidence,
        modulation=modulation,
        brightness=brightness,
        aovs=dict(zip([*centre.aovs, ALPHA], warped[len(names) :], strict=False)),
    )
    return aligned, dict(zip(names, warped, strict=False)), coverage


def _count_own_samples(window: Window, index: int, rows: slice, coverage: Array, confidence: Array) -> None:
    """Reduce the coverage and the confidence (h, W) of a neighbour, in place, to what its samples add to the centre."""
    link = window.links[index]
    factors: list[Array | np.float32] = [window.own_samples[index]]
    # Along a motion the errors of denoised frames differ, though the noise stands still.
    averaged = window.first_pass is not None and moves_over_noise(window.stages)
    if "fixed-noise" in window.stages and link is not None and not averaged:
        factors.append(novelty_of(link.forward.vectors[rows]))
    for factor in factors:
        coverage *= factor
        confidence *= factor


def _warp_first_pass(
    window: Window,
    first_pass: Sequence[Array | None],
    coverage: Array,
    rows: slice,
    timings: Timings,
    *,
    weigh: bool = True,
) -> tuple[Array, list[Array | None]]:
    """Warp first passes to these rows, (T, h, W, 3); the centre's, with coverage 0, where a neighbour has none.

    With the weight of each by its interpolation, (h, W), if `weigh`; None: 1.
    """
    middle = first_pass[len(first_pass) // 2]
    if middle is None:
        raise ValueError(f"frame {window.centre.number} has no first pass, expected one like its neighbours")
    warped = np.empty((len(first_pass), *middle[rows].shape), np.float32)
    weights: list[Array | None] = [None] * len(first_pass)
    noise = None
    if weigh:
        noise = variance_from_estimate(window.centre.radiance[rows], middle[rows], measure_exposure(middle))
    for index, (picture, link) in enumerate(zip(first_pass, window.links, strict=True)):
        flow = window.light_flow(index, rows)
        if link is None or flow is None or picture is None:
            warped[index] = middle[rows]
            if link is not None:
                coverage[index] = 0
            continue
        with timings.stage("warp"):
            # Denoised frames have detail to lose and no noise to average: bicubic interpolation gains up to 0.5 dB.
            warp_rows(picture, flow, rows.start, warped[index], interpolation="bicubic")
            if noise is not None and link.forward.vectors.any():
                bilinear, _ = warp(picture, flow, first_row=rows.start)
                weights[index] = interpolation_weight(warped[index], bilinear, noise)
            if noise is not None and window.reflecting is not None:
                # Motion that was found may be wrong where vectors are right, as at outlines.
                error_weight = interpolation_weight(warped[index], middle[rows], noise)
                error_weight[~window.reflecting[rows]] = 1
                known = weights[index]
                weights[index] = error_weight if known is None else known * error_weight
            fill_uncovered(warped[index], middle[rows], coverage[index])
        window.release()
    return warped, weights


def _warp_along_surfaces(
    window: Window,
    first_pass: Sequence[Array | None],
    along_light: Array,
    coverage: Array,
    rows: slice,
    timings: Timings,
) -> Array:
    """Warp first passes by the links alone, (T, h, W, 3): `along_light` but where light moves beside these."""
    assert window.reflecting is not None
    warped, moving = along_light.copy(), np.flatnonzero(window.reflecting[rows].any(axis=1))
    if moving.size:
        some = slice(int(moving[0]), int(moving[-1]) + 1)
        of_frame, surfaces = slice(rows.start + some.start, rows.start + some.stop), replace(window, reflections=None)
        warped[:, some], _ = _warp_first_pass(surfaces, first_pass, coverage[:, some], of_frame, timings, weigh=False)
    return warped


def _fill_centre(pictures: Iterable[Array], confidence: Array) -> None:
    """Fill pixels of the centre without a finite color, in place, by the mean of pictures (T, h, W, C) over time.

    The neighbours in space fill a single pixel well, a block badly: those in time come first.
    """
    middle = len(confidence) // 2
    gone = confidence[middle] == 0
    if gone.any():
        for picture in pictures:
            picture[middle][gone] = average(picture, confidence)[gone]
