"""The plan: what a shot calls for, measured before anything runs.

No stage is paid for that the shot does not have, and nothing is skipped silently: each decision carries the
figure that was measured, the threshold it was held against, and the reason in words.
"""

from __future__ import annotations

from collections.abc import Collection, Iterator
from dataclasses import dataclass, replace

import cv2
import numpy as np
from numpy.typing import NDArray

from flow.warp import warp
from hybrid.alignment.align import Aligner
from hybrid.alignment.prepare import PreparedFrame, prepare, rendered_flow
from hybrid.alignment.transfer import compress, measure_exposure
from hybrid.files.frames import Shot
from nlm.average import reject_outliers
from nlm.gate import color_gate

Array = NDArray[np.float32]

STAGES = {
    "demodulate": "filter light instead of light times texture",
    "outliers": "reject fireflies",
    "warp": "move side frames along the motion",
    "dense-flow": "find the motion in the pictures",
    "refine": "correct the renderer's vectors by TV-L1",
    "gate": "do not average over time where the light itself changes",
    "fixed-noise": "do not average noise that stands still on the screen",
    "prefilter": "filter noisy albedo and normals before they guide anything",
    "alpha": "filter the alpha channel with the network's kernels",
    "skip": "leave tiles without noise out of the network",
}

# Motion below a twentieth of a pixel blurs a bilinear sample by less than 1 % of its contrast.
STILL = 0.05
# Share of pixels, in areas of 9×9, whose brightness the vectors do not explain. Refinement is worth its time for
# reflections and shadows of some size; the gate is cheap and already pays for a small highlight.
REFINE_ABOVE = 0.01
GATE_ABOVE = 0.002
# One firefly in a hundred thousand pixels is twenty in a 1080p frame: visible.
OUTLIERS_ABOVE = 1e-5
# Correlation of the noise of neighbouring frames at equal pixels. Nine shots of changing seeds stayed below 0.17, what
# correlates there being unresolved detail of a still picture; one of one seed for all frames had 0.39.
FIXED_NOISE_ABOVE = 0.25
# Upper quartile of |Δalbedo| between frames, along the vectors. Surfaces under film sampling differ by less;
# with few samples, under depth of field or behind glass by more.
GUIDE_NOISE_ABOVE = 0.003
# A tile that differs from its own smoothed self by less than this, relative to exposure, has no noise.
NOISE_FREE = 1e-4
TILE = 32
SAMPLES = 3
# What frames are prepared with to be measured: without texture, and with their light.
MEASURED = frozenset({"demodulate", "gate"})


@dataclass(frozen=True)
class Decision:
    """One stage, whether it runs, and why.

    Attributes
    ----------
    stage : str
        A key of `STAGES`.
    on : bool
        Whether the stage runs.
    figure : float or None
        What was measured; None where there was nothing to measure.
    threshold : float
        What it was held against.
    reason : str
        The same in words.
    forced : bool
        True where the user, not the figure, decided.
    """

    stage: str
    on: bool
    figure: float | None
    threshold: float
    reason: str
    forced: bool = False


@dataclass(frozen=True)
class Plan:
    """The decisions for one shot."""

    decisions: tuple[Decision, ...]

    @property
    def stages(self) -> frozenset[str]:
        """Names of the stages that run."""
        return frozenset(decision.stage for decision in self.decisions if decision.on)

    def force(self, on: Collection[str] = (), off: Collection[str] = ()) -> Plan:
        """Switch stages on or off whatever was measured.

        Raises
        ------
        ValueError
            An stage that does not exist, or one that is to be both on and off.
        """
        for name in [*on, *off]:
            if name not in STAGES:
                raise ValueError(f"stage is {name!r}, expected one of {', '.join(STAGES)}")
        if both := set(on) & set(off):
            raise ValueError(f"stage {sorted(both)[0]!r} is both forced on and forced off")
        return Plan(
            tuple(
                replace(d, on=d.stage in on, forced=True, reason=f"forced; measured: {d.reason}")
                if d.stage in on or d.stage in off
                else d
                for d in self.decisions
            )
        )


@dataclass(frozen=True)
class _Pair:
    """Two neighbouring frames of the shot, prepared."""

    here: PreparedFrame
    there: PreparedFrame


@dataclass(frozen=True)
class _Figures:
    """What was measured on one pair, so that the frames need not be kept."""

    albedo_spread: float | None
    has_guide: bool
    has_vectors: bool
    speed: float
    still: float
    unexplained: float
    outliers: float
    noise_correlation: float
    guide_noise: float
    noise_free: float


def plan_shot(shot: Shot) -> Plan:
    """Measure a shot on a few pairs of frames and decide which stages it calls for.

    Parameters
    ----------
    shot : Shot
        Up to `SAMPLES` pairs of neighbouring frames, spread over it, are read.

    Returns
    -------
    Plan
        One decision for each of `STAGES`.
    """
    figures = [_measure(pair) for pair in _sample_pairs(shot)]
    single = not figures
    if single:
        only = prepare(shot.read(shot.numbers[0]), MEASURED)
        figures = [_measure(_Pair(only, only))]
    first = figures[0]
    still = max(pair.still for pair in figures)
    speed = max(pair.speed for pair in figures) if first.has_vectors else float("nan")
    unexplained = max(pair.unexplained for pair in figures) if first.has_vectors else still
    moves = not single and (speed > STILL if first.has_vectors else unexplained > GATE_ABOVE)
    decisions = [
        _decide_demodulate(first.albedo_spread),
        _decide(
            "outliers",
            max(pair.outliers for pair in figures),
            OUTLIERS_ABOVE,
            "{:.2g} of the pixels stand alone far above their neighbours",
        ),
        _decide_warp(single, first.has_vectors, moves, speed, still),
        Decision(
            "dense-flow",
            moves and not first.has_vectors,
            None,
            0,
            "no motion vectors in the file: the motion has to be found in the pictures"
            if moves and not first.has_vectors
            else "motion vectors are there"
            if first.has_vectors
            else "nothing moves",
        ),
        _decide_refine(moves, first.has_vectors, unexplained),
        _decide(
            "gate",
            0.0 if single else unexplained,
            GATE_ABOVE,
            "{:.2%} of the picture changes its light between frames"
            + ("" if first.has_vectors else " (motion included)"),
        ),
        _decide_fixed_noise([pair.noise_correlation for pair in figures], single),
        _decide_prefilter(first.has_guide, max(pair.guide_noise for pair in figures)),
        _decide_alpha(shot),
        _decide(
            "skip",
            min(pair.noise_free for pair in figures),
            0.0,
            "{:.1%} of the tiles hold no noise",
        ),
    ]
    return Plan(tuple(decisions))


def _sample_pairs(shot: Shot) -> Iterator[_Pair]:
    """Pairs spread over the shot, one at a time."""
    numbers = list(shot.numbers)
    count = min(SAMPLES, len(numbers))
    picked = sorted({numbers[(2 * i + 1) * len(numbers) // (2 * count)] for i in range(count)})
    aligner = Aligner(shot, MEASURED, radius=1)
    for number in picked:
        previous, _, following = aligner.around(number, 1)
        other = following if shot.has(following) else previous
        if shot.has(other):
            aligner.load([number, other])
            here, there = aligner.frame(number), aligner.frame(other)
            if here is not None and there is not None:
                yield _Pair(here, there)


def _measure(pair: _Pair) -> _Figures:
    vectors = rendered_flow(pair.here, pair.there)
    still = _unexplained(pair, None)
    return _Figures(
        albedo_spread=None if pair.here.albedo is None else float(pair.here.albedo.std()),
        has_guide=pair.here.albedo is not None or pair.here.normal is not None,
        has_vectors=vectors is not None,
        speed=_speed(pair),
        still=still,
        unexplained=still if vectors is None else _unexplained(pair, vectors),
        outliers=_outlier_share(pair.here),
        noise_correlation=noise_correlation(pair.here, pair.there),
        guide_noise=_guide_noise(pair),
        noise_free=_noise_free_share(pair.here),
    )


def _decide(stage: str, figure: float, threshold: float, words: str) -> Decision:
    return Decision(stage, figure > threshold, figure, threshold, words.format(figure))


def _decide_demodulate(spread: float | None) -> Decision:
    if spread is None:
        return Decision("demodulate", False, None, 0, "no albedo in the file")
    words = "the albedo varies by {:.3g}" if spread > 0 else "the albedo is the same everywhere"
    return _decide("demodulate", spread, 0, words)


def _decide_warp(single: bool, has_vectors: bool, moves: bool, speed: float, still: float) -> Decision:
    if single:
        return Decision("warp", False, None, STILL, "no two neighbouring frames")
    if has_vectors:
        words = "the fastest thousandth moves {:.2f} px per frame" if moves else "nothing moves: at most {:.3f} px"
        return Decision("warp", moves, speed, STILL, words.format(speed))
    words = "{:.2%} of the picture changes between frames" if moves else "nothing changes between frames but {:.2%}"
    return Decision("warp", moves, still, GATE_ABOVE, words.format(still))


def _decide_refine(moves: bool, has_vectors: bool, unexplained: float) -> Decision:
    if not has_vectors:
        return Decision("refine", False, None, REFINE_ABOVE, "no vectors to refine; see dense-flow")
    if not moves:
        return Decision("refine", False, None, REFINE_ABOVE, "nothing moves")
    return _decide("refine", unexplained, REFINE_ABOVE, "the vectors leave {:.2%} of the picture unexplained")


def _decide_fixed_noise(correlations: list[float], single: bool) -> Decision:
    if single:
        return Decision("fixed-noise", False, None, FIXED_NOISE_ABOVE, "no two neighbouring frames")
    figure = float(np.median(correlations))
    words = "the noise of neighbouring frames correlates {:.2f} at equal pixels"
    if figure > FIXED_NOISE_ABOVE:
        words += ": the render has one seed for all frames, and time adds little where nothing moves; in Blender, "
        words += "switch on Render > Sampling > Advanced > Animate Seed (the clock beside Seed)"
    return _decide("fixed-noise", figure, FIXED_NOISE_ABOVE, words)


def _decide_prefilter(has_guide: bool, noise: float) -> Decision:
    if not has_guide:
        return Decision("prefilter", False, None, GUIDE_NOISE_ABOVE, "no guides in the file")
    return _decide("prefilter", noise, GUIDE_NOISE_ABOVE, "the guides differ by {:.3f} between frames")


def _decide_alpha(shot: Shot) -> Decision:
    alpha = shot.read(shot.numbers[0]).alpha
    if alpha is None:
        return Decision("alpha", False, None, 0, "no alpha in the file")
    clear = float(np.mean(alpha < 0.999))
    return _decide("alpha", clear, 0, "{:.1%} of the picture is transparent")


def _speed(pair: _Pair) -> float:
    vectors = rendered_flow(pair.here, pair.there)
    if vectors is None:
        return 0.0
    length = np.hypot(vectors[0][..., 0], vectors[0][..., 1])
    return float(np.quantile(length, 0.999))


def _unexplained(pair: _Pair, vectors: tuple[Array, NDArray[np.bool_]] | None) -> float:
    """Share of the picture whose light differs between two frames by more than its noise, along `vectors`."""
    here, other = _light_of(pair.here), _light_of(pair.there)
    exposure = measure_exposure(here)
    inside = np.ones(here.shape[:2], bool)
    if vectors is not None:
        other, inside = warp(other, vectors[0])
        inside &= vectors[1]
    window = np.stack([other, here, other])
    weight = color_gate(window, pair.here.irradiance, exposure)[0]
    # The gate is e^-1 where 9×9 means differ by its scale, as 1 or 2 % of them do by noise alone. At twice the scale
    # noise brings one in a thousand.
    return float(np.mean(weight[inside] < np.exp(-4))) if inside.any() else 0.0


def noise_correlation(a: PreparedFrame, b: PreparedFrame) -> float:
    """Correlation of the noise of two frames at equal pixels.

    Parameters
    ----------
    a, b : PreparedFrame
        Of one size, prepared with "gate", which estimates their light.

    Returns
    -------
    float
        In [−1, 1]; 0 where either has no noise.

    Notes
    -----
    Noise is what the frame differs from its own smoothed light by, relative to that light, less its 5×5 mean, which
    holds what the smoothing has lost. It is clipped at three times its median size: fireflies must not decide.
    """
    signals = []
    for frame in (a, b):
        light = _light_of(frame).mean(axis=-1)
        # A hundredth of the exposure, so that black corners do not divide by nothing.
        floor = 0.01 * measure_exposure(light[..., None])
        noise = (frame.irradiance.mean(axis=-1) - light) / (light + floor)
        noise = noise - cv2.blur(noise, (5, 5))
        limit = 3 * float(np.median(np.abs(noise)))
        signals.append(np.clip(noise, -limit, limit))
    first, second = (signal - signal.mean() for signal in signals)
    power = float(np.sqrt(np.mean(first**2) * np.mean(second**2)))
    return float(np.mean(first * second)) / power if power > 0 else 0.0


def _light_of(frame: PreparedFrame) -> Array:
    if frame.light is None:
        raise ValueError(f"frame {frame.number} was prepared without the light that the plan compares")
    return frame.light


def _outlier_share(frame: PreparedFrame) -> float:
    _, rejected = reject_outliers(frame.irradiance[None], frame.valid[None].astype(np.float32))
    return float(np.mean(rejected))


def _guide_noise(pair: _Pair) -> float:
    here, there = pair.here.guide, pair.there.guide
    if here is None or there is None:
        return 0.0
    vectors = rendered_flow(pair.here, pair.there)
    warped = there if vectors is None else warp(there, vectors[0])[0]
    return float(np.quantile(np.abs(here - warped).max(axis=-1), 0.75))


def _noise_free_share(frame: PreparedFrame) -> float:
    light = _light_of(frame)
    exposure = measure_exposure(light)
    removed = np.abs(compress(frame.irradiance, exposure) - compress(light, exposure)).max(axis=-1)
    tiles = [
        removed[y : y + TILE, x : x + TILE].max() < NOISE_FREE
        for y in range(0, removed.shape[0], TILE)
        for x in range(0, removed.shape[1], TILE)
    ]
    return float(np.mean(tiles))
