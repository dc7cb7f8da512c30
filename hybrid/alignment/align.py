"""Align a window of frames to its centre (`align`, for all filters and networks), and results to each other."""

from collections.abc import Collection, Iterable, Iterator, Sequence
from dataclasses import replace
from typing import Any, NamedTuple

import numpy as np

from flow.confidence import GuideNoise, fill_uncovered, local_variance
from flow.warp import warp
from hybrid.alignment.guides import average_guides
from hybrid.alignment.neighbour import layers_of, novelty_of, trust_geometry, trust_light, warp_layers
from hybrid.alignment.prepare import ALPHA, PreparedFrame
from hybrid.alignment.transfer import demodulate, remodulate
from hybrid.alignment.window import AlignedWindow, Trust, WarpSources, Window, clean_guide
from hybrid.files.frame import Array
from hybrid.files.layers import Layers
from hybrid.runtime.timing import Timings
from nlm.average import average, reject_outliers
from nlm.drift import drift_weights, pull_to_centre
from nlm.gate import agreement_weight, color_gate, color_gates
from nlm.interpolation import interpolation_weight, measure_noise
from nlm.pooling import SampleRange
from nlm.relight import relight
from nlm.samples import SampleMean, average_neighbours

# How much of a frame's noise finished pictures may differ by: up to the first as they are, up to the second without
# their mean difference (`nlm.relight`), where the light stands still as far as samples show (`nlm.drift`). The second
# alone is steadier by 0.2 dB, and averages moving shadows: 2.7 dB of such a shot.
FINISHED = 0.1, 0.5
# The same without noise, in tone-mapped units, and by how many times more single pixels may differ: without the second
# a shot of sharp outlines loses 1 dB at 128 and 512 samples, half of it with 3; 1 costs still shots up to 8 dB in time.
FINISHED_FLOOR, FINISHED_DETAIL = 0.001, 2.0
# How much more finished pictures lose by a drift than first passes do, whose errors are several times as large: 20 and
# 100 differ by 0.05 dB, and by 0.25 dB where shadows move.
DRIFTED = 100
# Where the light of a frame drifts nearly everywhere, samples show it only in places, and the rest drifts too: finished
# pictures count in full where two fifths of the picture stand still, and not at all where less than a fifth does. Of
# nine validation shots one has such light, and gains 0.1 dB; one loses 0.04, the others nothing.
STANDING = 0.2, 0.4
# Rows around a band that its result depends on: 23 for all filters of the classical chain together, or the receptive
# field of a trunk (112), of the measure of drift (55) and of the gate (11). The mean of pooled samples (72) reaches
# beyond, for 2e-7 of the light. Whole strips of the guided filter (64 rows): it then sums in the order it would in the
# frame.
MARGIN = 192


class _Warped(NamedTuple):
    """Layers of all frames warped to the centre, and how far geometry trusts each."""

    layers: dict[str, Array]  # (T, h, W, C) each
    confidence: Array  # (T, h, W)
    trust: tuple[Trust | None, ...]


class _Trusted(NamedTuple):
    """How far geometry and light trust each frame, and how far its light drifts."""

    confidence: Array  # (T, h, W)
    pull: Array | None = None  # (T, h, W): weights by which first passes are pulled to the centre's; None without drift
    drift_weight: Array | None = None  # (h, W): as `AlignedWindow.drift_weight`


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
    ranged: bool = False,
    guided: bool = True,
    timings: Timings | None = None,
) -> AlignedWindow:
    """Warp all frames of a window to its centre, and measure how far each pixel can be trusted.

    With `rows` only these rows of the frame, and `MARGIN` around them. With `ranged` the range of the samples is found
    while they are averaged; without `guided` only the filter of AOVs reads `AlignedWindow.guide`. All frames have
    the same layers (`expect_equal_layers`). Raises ValueError if the centre has no first pass and others do.
    """
    timings = timings or Timings()
    centre, stages, denoised = window.centre, window.stages, window.first_pass is not None
    middle = len(window.frames) // 2
    padded, inner = _pad_rows(rows, len(centre.irradiance))
    light = "gate" in stages and not denoised
    layers = {name: layer[padded] for name, layer in layers_of(centre, light=light, alpha="alpha" in stages).items()}
    guides = {name: layer for name, layer in layers.items() if name in ("albedo", "normal")}
    # With a first pass few denoisers read the colors of all frames: these are warped when they are read.
    centre_irradiance = layers.pop("color") if denoised else layers["color"]
    warped, coverage = _warp_neighbours(window, layers, guides, padded, timings)
    flows = [None if link is None else link.forward.vectors[padded] for link in window.links]
    sources = WarpSources(window.frames, flows, window.first_pass or (), window.limited, padded, release=window.release)
    with timings.stage("confidence"):
        # Before the first pass is warped, whose place in memory the guide of all frames has until then.
        clean = clean_guide("albedo", guides, sources, warped.confidence, stages) if "albedo" in guides else None
        filtered = None
        if window.filtered_guides is not None:
            filtered = average_guides(window.filtered_guides, flows, warped.confidence, padded)
    # The first passes of all frames, or their colors.
    if window.first_pass is None:
        pictures = warped.layers.pop("color")
    else:
        pictures, exact = _warp_first_pass(window, window.first_pass, coverage, padded, timings)
    with timings.stage("confidence"):
        centre_irradiance = _fill_centre(warped, pictures, centre_irradiance, sources)
        bright = window.lit.as_light if "light" in warped.layers else window.lit.as_rendered
        outliers = 0
        if not denoised and "outliers" in stages:
            pictures, rejected = reject_outliers(pictures, warped.confidence)
            centre_irradiance, outliers = pictures[middle], int(np.count_nonzero(rejected[:, inner]))
        modulation = np.ones_like(centre_irradiance)
        if clean is not None and centre.demodulated:
            modulation = remodulate(modulation, clean)
            if "prefilter" in stages:
                sources = replace(sources, modulation=modulation)
        guided = guided or bool(centre.aovs)
        clean = clean if guided else None
        if denoised:
            # By the centre's albedo and not by each frame's own, which may be noisy as the first pass is not.
            pictures /= modulation
            gate = color_gate(pictures, centre_irradiance, bright.exposure)
            confidence = trust_light(warped.confidence, coverage, gate, stages)
            del coverage, gate  # windows are large
            for trust, weight in zip(confidence, exact, strict=True):
                if weight is not None:
                    trust *= weight
            trusted = _trust_denoised(window, pictures, centre_irradiance, confidence, bright.exposure, padded.start)
        else:
            trusted = _trust_noisy(warped, centre_irradiance, bright.exposure, stages)
        sides = found = None
        if "blend-samples" in stages:
            found = SampleRange.empty(centre_irradiance.shape) if ranged and denoised else None
            sides = _average_samples(sources, pictures, warped.confidence, trusted, modulation, centre, found)
        elif trusted.pull is not None:
            pull_to_centre(pictures, trusted.confidence, trusted.pull)
    return AlignedWindow(
        number=centre.number,
        centre_irradiance=centre_irradiance,
        aligned_color=None if denoised else pictures,
        guides=guides,
        sources=sources,
        confidence=trusted.confidence,
        modulation=modulation,
        clean_albedo=clean,
        geometric_confidence=warped.confidence if guided else None,
        rendered_variance=centre.variance,
        first_pass=pictures if denoised else None,
        centre_first_pass=None if window.first_pass is None else window.first_pass[middle],
        aovs={name.removeprefix("aov "): layer for name, layer in warped.layers.items() if name.startswith("aov ")},
        repaired=centre.repaired,
        outliers=outliers,
        fireflies=centre.fireflies,
        exposure=bright.exposure,
        moments=bright.moments,
        inner=inner,
        stages=stages,
        shares={"refine": float(np.mean(window.refined))} if window.refined else {},
        pass_colors={name: tint[padded] for name, tint in centre.pass_colors.items()},
        neighbour_samples=sides,
        neighbour_trust=(warped.trust[middle - 1], warped.trust[middle + 1]) if middle else (None, None),
        known_range=found,
        drift_weight=trusted.drift_weight,
        passes=centre.passes,
        filtered_guides=filtered,
    )


def align_results(
    window: Window,
    trust: Sequence[Trust | None],
    stillness: Stillness,
    exposure: float,
    rows: slice | None = None,
    *,
    timings: Timings | None = None,
) -> tuple[Array, Array]:
    """Align the results of a frame and its two neighbours, and measure how far they show the same.

    `window` holds three frames with their results in the place of a first pass, `trust` is that in the two neighbours
    for the whole frame, `exposure` that of the centre's irradiance as rendered, `rows` as for `align`. Returns radiance
    (3, h, W, 3) in the centre's light, its own where a frame shows or has none, and a confidence (3, h, W) in [0, 1].
    """
    timings = timings or Timings()
    centre, stages = window.centre, window.stages
    padded, inner = _pad_rows(rows, len(centre.irradiance))
    noisy = centre.irradiance[padded]
    shape = len(window.frames), *noisy.shape[:2]
    confidence, coverage = np.zeros(shape, np.float32), np.zeros(shape, np.float32)
    confidence[1] = coverage[1] = centre.valid[padded]
    for index, known in zip((0, 2), trust, strict=True):
        if known is not None and window.frames[index] is not None and window.links[index] is not None:
            here = Trust(known.coverage[padded], known.confidence[padded])
            _set_trust(confidence, coverage, window, index, here, padded)
    assert window.first_pass is not None
    results, _ = _warp_first_pass(window, window.first_pass, coverage, padded, timings, weigh=False)
    with timings.stage("stabilize"):
        divisor = None if centre.albedo is None or not centre.demodulated else centre.albedo[padded]
        light = results if divisor is None else demodulate(results, divisor)
        # Outlines are as geometry has them: finished ones are sharp, and their mean over frames is not. On the
        # bundled shot with its chrome that is worth 0.4 dB.
        gates = color_gates(light, noisy, exposure, FINISHED, floor=FINISHED_FLOOR, detail=FINISHED_DETAIL)
        alike, confidence = (trust_light(confidence, coverage, gate, stages, agreeing=0.0) for gate in gates)
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
    aovs = sum(len(layer.channels) for layer in layers.aovs.values()) + (layers.alpha is not None)
    return 3 + 3 + guides + aovs + 1


def measure_stillness(drift_weight: Array | None, shape: tuple[int, int]) -> Stillness:
    """Measure how far the light of a frame (H, W) stands still by the next frame's weight; 0, in all 1, if unknown."""
    if drift_weight is None:
        return Stillness(np.zeros(shape, np.float32), np.float32(1))
    still = np.reciprocal(drift_weight)  # 1 / (1 + DRIFTED (1 / w − 1)), in place: frames are large
    still *= np.float32(DRIFTED)
    still += np.float32(1 - DRIFTED)
    np.reciprocal(still, out=still)
    least, enough = STANDING
    return Stillness(still, _smooth_step(still.mean(), least, enough))


def _smooth_step(x: Any, least: float, enough: float) -> Any:
    """Rise from 0 at `least` to 1 at `enough`, as 3 t² − 2 t³, in float32."""
    t = np.clip((x - np.float32(least)) / np.float32(enough - least), 0, 1)
    return t * t * (3 - 2 * t)


def expect_equal_layers(frames: Sequence[PreparedFrame | None]) -> None:
    """Raise ValueError if frames of a window differ in layers: light divided by an albedo is no color."""
    centre = frames[len(frames) // 2]
    assert centre is not None
    for there in (frame for frame in frames if frame is not None):
        if different := sorted(_names(centre) ^ _names(there)):
            has, lacks = (there, centre) if different[0] in _names(there) else (centre, there)
            raise ValueError(
                f"frame {lacks.number} has no {different[0]}, which frame {has.number} has, expected one in both"
            )


def _names(frame: PreparedFrame) -> set[str]:
    """The layers that all frames of a window have, or none."""
    given = {"albedo": frame.albedo, "normal": frame.normal, ALPHA: frame.alpha, **frame.aovs}
    return {name for name, layer in given.items() if layer is not None}


def _warp_neighbours(
    window: Window, layers: dict[str, Array], guides: Collection[str], rows: slice, timings: Timings
) -> tuple[_Warped, Array]:
    """Warp the neighbours' layers to these rows of the centre. Guides serve the confidence alone and are not kept.

    With the coverage (T, h, W), an upper bound of the confidence: 0 where a frame shows nothing.
    """
    centre, count = window.centre, len(window.frames)
    shape = count, rows.stop - rows.start, centre.irradiance.shape[1]
    kept = {n: np.empty((*shape, layer.shape[-1]), np.float32) for n, layer in layers.items() if n not in guides}
    confidence, coverage = np.zeros(shape, np.float32), np.zeros(shape, np.float32)
    trusts: list[Trust | None] = [None] * count
    with timings.stage("confidence"):
        noise = None
        if any(window.outline_noise):
            noise = GuideNoise(local_variance(layers.get("albedo"), layers.get("normal")), window.outline_noise)
    for index, (there, link) in enumerate(zip(window.frames, window.links, strict=True)):
        if there is None or link is None:
            # The centre itself, or a frame that is missing.
            for name, layer in kept.items():
                layer[index] = layers[name]
            if index == count // 2:
                confidence[index] = coverage[index] = centre.valid[rows]
            continue
        with timings.stage("warp"):
            warp_layers(there, link.forward.vectors[rows], rows, {name: layer[index] for name, layer in kept.items()})
            trust = trusts[index] = trust_geometry(layers, there, link, rows, noise)
            _set_trust(confidence, coverage, window, index, trust, rows)
        window.release()
    return _Warped(kept, confidence, tuple(trusts)), coverage


def _set_trust(confidence: Array, coverage: Array, window: Window, index: int, trust: Trust, rows: slice) -> None:
    """Write a neighbour's confidence and coverage, as far as its samples count beside the centre's."""
    coverage[index], confidence[index] = trust
    if window.samples[index] < 1:
        coverage[index] *= window.samples[index]
        confidence[index] *= window.samples[index]
    if window.repeated[index]:  # a frame nearer to the centre has the same samples
        coverage[index] = confidence[index] = 0
    elif "fixed-noise" in window.stages and (link := window.links[index]) is not None:
        novelty = novelty_of(link.forward.vectors[rows])
        coverage[index] *= novelty
        confidence[index] *= novelty


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
    noise = measure_noise(window.centre.radiance[rows], middle[rows]) if weigh else None
    for index, (there, link) in enumerate(zip(first_pass, window.links, strict=True)):
        if link is None or there is None:
            warped[index] = middle[rows]
            if link is not None:
                coverage[index] = 0
            continue
        with timings.stage("warp"):
            # Denoised frames have no noise that interpolation could average, only detail to lose: bicubic is worth up
            # to 0.5 dB here.
            flow = link.forward.vectors
            if flow.any():
                warp(there, flow[rows], interpolation="bicubic", first_row=rows.start, out=warped[index])
                if noise is not None:
                    bilinear, _ = warp(there, flow[rows], first_row=rows.start)
                    weights[index] = interpolation_weight(warped[index], bilinear, noise)
            else:
                warped[index] = there[rows]
            fill_uncovered(warped[index], middle[rows], coverage[index])
        window.release()
    return warped, weights


def _trust_noisy(warped: _Warped, centre_irradiance: Array, exposure: float, stages: Collection[str]) -> _Trusted:
    """Combine geometry with the gate by the frames' rough light, without a first pass."""
    if "gate" not in stages:
        return _Trusted(warped.confidence)
    return _Trusted(warped.confidence * color_gate(warped.layers["light"], centre_irradiance, exposure))


def _trust_denoised(
    window: Window,
    first_pass: Array,
    centre_irradiance: Array,
    confidence: Array,
    exposure: float,
    first_row: int,
) -> _Trusted:
    """Multiply the confidence, in place, by the agreement of all neighbours, and measure drift."""
    stages, middle = window.stages, len(first_pass) // 2
    if "gate" in stages:
        agreement = agreement_weight(first_pass, centre_irradiance, confidence, exposure)
        confidence[:middle] *= agreement
        confidence[middle + 1 :] *= agreement
    if "drift" not in stages:
        return _Trusted(confidence)
    weight = drift_weights(first_pass, centre_irradiance, confidence, exposure, first_row=first_row)
    # A copy: a view would keep the weights of all frames in memory.
    return _Trusted(confidence, weight, weight[middle + 1].copy() if _shows_drift(window) else None)


def _average_samples(
    sources: WarpSources,
    pictures: Array,
    geometry: Array,
    trusted: _Trusted,
    modulation: Array,
    centre: PreparedFrame,
    found: SampleRange | None,
) -> SampleMean:
    """Average the neighbours' samples; pull first passes to the centre's, and add them with the samples to `found`."""
    residuals = None
    if sources.first_pass:
        residuals = _pull_behind(sources.residual_strips(), pictures, trusted.confidence, trusted.pull, found)
    noisy = centre.radiance[sources.rows]
    return average_neighbours(pictures, residuals, trusted.confidence, geometry, modulation, noisy)


def _pull_behind(
    residuals: Iterable[tuple[int, Array]],
    estimates: Array,
    confidence: Array,
    weight: Array | None,
    found: SampleRange | None,
) -> Iterator[tuple[int, Array]]:
    """Yield strips of residuals; when one has been used, pull its estimates to the centre's and add to the range.

    Neighbours are averaged before that: the samples stay as they are.
    """
    for top, strip in residuals:
        yield top, strip
        if weight is not None:
            pull_to_centre(estimates, confidence, weight, slice(top, top + strip.shape[1]))
        if found is not None:
            found.add(estimates, strip, top)


def _fill_centre(warped: _Warped, pictures: Array, centre_irradiance: Array, sources: WarpSources) -> Array:
    """Fill pixels of the centre without a finite color from the neighbours in time; return its irradiance.

    `pictures` are first passes where `sources` has these, else the colors.
    """
    denoised, middle = bool(sources.first_pass), len(pictures) // 2
    gone = warped.confidence[middle] == 0
    if gone.any():
        # The neighbours in space fill a single pixel well, a block badly: those in time come first.
        centre_irradiance = centre_irradiance.copy()
        centre_irradiance[gone] = average(
            sources.warp("irradiance", centre_irradiance) if denoised else pictures, warped.confidence
        )[gone]
        for layer in (*warped.layers.values(), *([pictures] if denoised else [])):
            layer[middle][gone] = average(layer, warped.confidence)[gone]
    if not denoised:
        pictures[middle] = centre_irradiance
    return centre_irradiance


def _shows_drift(window: Window) -> bool:
    """Whether two frames on one side of the centre have flows: `nlm.drift` compares them."""
    middle = len(window.links) // 2
    before, after = window.links[middle - 2 : middle], window.links[middle + 1 : middle + 3]
    return None not in before or None not in after
