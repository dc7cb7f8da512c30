"""Decide which stages run on a window, from what was measured in its frames.

Each decision carries the measured figure, its threshold and the reason in words; nothing is skipped silently. A stage
is decided here and nowhere else.
"""

from collections.abc import Iterable, Mapping, Sequence
from dataclasses import dataclass, field, replace
from typing import NamedTuple

import numpy as np

from hybrid.alignment.measure import FrameFacts, PairFacts, least_outline_noise
from hybrid.alignment.noise import FIXED_NOISE_ABOVE, STILL, Correlation, near_correlation
from hybrid.files.sequences import format_frames

#: Stages by name, in order. A figure calls for some; others (`_switch`) run wherever their input is there.
STAGES = {
    "whiten": "undo the renderer's pixel filter, by which neighbouring pixels share noise, and apply it to the result",
    "fireflies": "remove single bright samples of a frame before anything spreads them",
    "demodulate": "divide by the albedo and filter the light alone",
    "outliers": "reject samples far above the aligned window",
    "warp": "warp neighbouring frames along the motion",
    "dense-flow": "estimate the motion from the pictures by TV-L1",
    "refine": "correct the renderer's vectors by TV-L1",
    "reflections": "follow reflections and refractions where they move otherwise than their surfaces",
    "fade": "scale neighbouring frames to the light of the centre where a factor of each channel explains the change",
    "gate": "do not average over time where the light itself changes",
    "drift": "average less of denoised frames whose light drifts, as far as samples show",
    "fixed-noise": "do not average noise that stands still on the screen: average denoised frames alone",
    "prefilter": "filter noisy albedo and normals before they guide anything",
    "clean-guides": "filter albedo and normals for networks that need them without noise, and average them over time",
    "stabilize": "average each result with those of the neighbouring frames",
    "restore-mean": "restore the local means of the samples, fireflies included, as far as these are certain",
    "blend-samples": "blend samples into results where their noise is small against the difference",
    "alpha": "average the alpha channel over frames, as the network averages the color",
    "clean-alpha": "filter the noise of the alpha channel in space, as a network filters albedo",
    "skip": "leave tiles without noise out of the network",
}
NEURAL_STAGES = frozenset({"clean-guides", "stabilize", "alpha", "clean-alpha", "skip"})  # stages of networks alone

# Correlation of the noise of neighbouring pixels, along x or y, whichever is less: as changes of a clean picture add to
# it, up to 0.1 is measured for independent noise, on forty shots; the narrowest tent leaves 0.17.
WHITEN_ABOVE = 0.13
# Its lower quartile over a frame alone: of independent noise in 910 frames of forty shots at most 0.11, and with the
# filter [0.2 1 0.2] 0.25 in most; a kernel that is assumed wrongly costs 5 to 12 dB.
WHITEN_ALONE_ABOVE = 0.17
# Mean correlation of the noise of pixels three and four apart, from which on the filter is not undone. Filters of
# renderers cause 0.02, wider ones that can be undone in part 0.05, frames of 80 pixels 0.07; errors of denoised
# pictures have 0.12 and more.
WHITEN_BELOW = 0.09
# Share of pixels, in areas of 9×9, whose brightness the vectors do not explain. To change them is worth its time for
# reflections and shadows of some size; the gate is cheap and already pays for a small highlight.
UNEXPLAINED_ABOVE = 0.01
GATE_ABOVE = 0.002
OUTLIERS_ABOVE = 1e-5  # one firefly in a hundred thousand pixels is twenty in a 1080p frame: visible
# Upper quartile of |Δalbedo| between frames, along the vectors. Surfaces under film sampling differ by less;
# with few samples, under depth of field or behind glass by more.
GUIDE_NOISE_ABOVE = 0.003
# Noise of guides at outlines from which on they are filtered for networks: at 8 samples it is 0.04 and more, and
# `quality` gains 0.07 dB; at 32 samples it is 0.005 to 0.03, and the gain 0.03.
OUTLINE_NOISE_ABOVE = 0.02
# Light has more noise than this, as a share of it, at one or two samples a pixel, and in dim rooms at 30. With one
# sample Cycles makes the guides of all frames alike, their noise included.
FEW_SAMPLES = 0.5
# Noise of alpha that is filtered: 128 samples leave 0.03 in a pixel that is half transparent, and smooth shadows and
# rims vary by less than 0.002 themselves. Alpha without noise is changed by 0.006 at a rim.
ALPHA_NOISE_ABOVE = 0.01
RADIUS = 2  # frames on each side of a window as it is planned for a whole shot


class Context(NamedTuple):
    """The window that a plan is for."""

    first_pass: bool  # whether its frames come with denoised frames
    radius: int = RADIUS  # frames on each side of the centre
    filters_guides: bool = True  # whether the denoiser has the guides of frames filtered
    reads_guides: bool = True  # whether the denoiser, or the filter of AOVs, reads guides or samples beside them


ONE_SEED = (
    "the render has one seed for all frames: samples of neighbours add little; in Blender, switch on "
    "Render > Sampling > Advanced > Animate Seed (the clock beside Seed)"
)

#: A window of noisy frames alone, and one with a first pass.
NOISY, DENOISED = Context(first_pass=False), Context(first_pass=True)


@dataclass(frozen=True)
class Decision:
    """One stage, whether it runs, and why."""

    stage: str  # a key of `STAGES`
    on: bool  # whether the stage runs
    # the measured figure and its threshold; None for a switch, and where there was nothing to measure
    figure: float | None
    threshold: float | None
    reason: str  # the same in words
    forced: bool = False  # whether the user decided, and not the figure
    frames: tuple[int, ...] = ()  # in a plan of several frames, those with the stage


@dataclass(frozen=True)
class Plan:
    """The decisions for one window, or for a shot: then a stage is on if it is for any frame."""

    decisions: tuple[Decision, ...]  # one for each of `STAGES`
    cuts: tuple[tuple[int, int], ...] = ()  # neighbouring frames of different shots: nothing is averaged over them
    repeats: tuple[tuple[int, int], ...] = ()  # neighbouring frames with equal samples, which count once
    # the share of the picture, in [0, 1], on which a stage ran that runs only in places
    shares: Mapping[str, float] = field(default_factory=dict)

    @property
    def stages(self) -> frozenset[str]:
        """Names of the stages that run."""
        return frozenset(decision.stage for decision in self.decisions if decision.on)

    @property
    def noisy_guides(self) -> bool:
        """Whether the guides hold noise, filtered or not."""
        figures = {decision.stage: (decision.figure, decision.threshold) for decision in self.decisions}
        figure, threshold = figures["prefilter"]
        return figure is not None and threshold is not None and figure > threshold


@dataclass(frozen=True)
class Rules:
    """The stages that the user has forced; ValueError for one that does not exist, or is both on and off."""

    # stages that run, or do not, without regard to the figures
    on: frozenset[str] = frozenset()
    off: frozenset[str] = frozenset()

    def __post_init__(self) -> None:
        for name in sorted(self.on | self.off):
            if name not in STAGES:
                raise ValueError(f"stage is {name!r}, expected one of {', '.join(STAGES)}")
        if both := self.on & self.off:
            raise ValueError(f"stage {min(both)!r} is both forced on and forced off")

    @property
    def allowed(self) -> frozenset[str]:
        """The stages that may run on some frame."""
        return frozenset(STAGES) - self.off

    @property
    def forced(self) -> str:
        """The forced stages as text: +warp -gate."""
        return " ".join([*(f"+{name}" for name in sorted(self.on)), *(f"-{name}" for name in sorted(self.off))])

    def whitens(self, correlation: Correlation | None, alone: float | None = None) -> bool:
        """Whether the pixel filter of a frame is undone whose noise has this correlation, and lower quartile alone."""
        return correlation is not None and self._applied(_decide_whiten([(correlation, alone)]), (), NOISY).on

    def decide(self, frames: Sequence[FrameFacts], pairs: Sequence[PairFacts], context: Context = NOISY) -> Plan:
        """Decide the stages of a window, from the facts of its frames that are there, and of all neighbours among them.

        Denoised frames are compared in any case (the stage gate), and their outliers are bounded where they are
        averaged. Drift is the change of denoised frames over two frames on a side.
        """
        measured = measure_stages(frames, pairs)
        return replace(measured, decisions=tuple(self._applied(d, pairs, context) for d in measured.decisions))

    def _applied(self, decision: Decision, pairs: Sequence[PairFacts], context: Context) -> Decision:
        """A decision with the forced stages applied, in this window."""
        stage, on, reason = decision.stage, decision.on, decision.reason
        vectors = bool(pairs) and all(pair.vectors for pair in pairs)
        # Forcing warp on a shot without vectors implies dense flow.
        implied = stage == "dense-flow" and "warp" in self.on and bool(pairs) and not vectors and stage not in self.off
        forced = stage in self.on | self.off or implied
        if forced:
            on, reason = stage not in self.off, f"forced; measured: {reason}"
        if stage == "gate" and context.first_pass and not on and stage not in self.off:
            on, reason = True, f"denoised frames are compared in any case; measured: {reason}"
        if stage == "outliers" and context.first_pass and on:
            on, reason = False, f"the averaging of denoised frames bounds what single samples add; {reason}"
        if stage == "refine" and context.first_pass and on and not forced:
            # On forty shots and levels `balanced` loses 0.03 dB by it, and `quality` gains 0.01; a sixth of the time.
            why = "denoised frames that vectors misplace do not count (forced, it corrects vectors that are off)"
            on, reason = False, f"{why}; {reason}"
        if stage == "reflections" and on and not context.first_pass:
            on, reason = False, f"needs denoised frames; {reason}"
        if stage == "drift" and on and (not context.first_pass or context.radius < 2):
            on, reason = False, f"needs denoised frames, and windows of five or more; {reason}"
        if stage == "prefilter" and on and context.first_pass and not context.reads_guides and not forced:
            # The albedo is divided out of the average and multiplied in again. Six shots at four levels gain up to
            # 0.04 dB by it and lose up to 0.02, and `fast` takes 1.08 times the CPU time.
            on, reason = False, f"the average of denoised frames reads no guides; {reason}"
        if stage == "clean-guides" and on and not context.filters_guides:
            on, reason = False, f"this denoiser has no filter of guides; {reason}"
        return replace(decision, on=on, reason=reason, forced=forced)


def measure_stages(frames: Sequence[FrameFacts], pairs: Sequence[PairFacts]) -> Plan:
    """Decide which stages the measurements of a window call for, with nothing forced; cuts do not count."""
    cuts = tuple(pair.numbers for pair in pairs if pair.cut)
    repeats = tuple(pair.numbers for pair in pairs if pair.repeated)
    pairs = [pair for pair in pairs if not pair.cut]
    vectors = bool(pairs) and all(pair.vectors for pair in pairs)
    changed = max((pair.changed for pair in pairs), default=0.0)
    unexplained = max((pair.unexplained for pair in pairs), default=0.0)
    speed = max((pair.speed for pair in pairs), default=0.0)
    moves = speed > STILL if vectors else changed > GATE_ABOVE
    fade = max((float(np.abs(np.log2(pair.fade)).max()) for pair in pairs), default=0.0)
    fades = "the light of the whole picture changes by {:.2g} stops between frames" if fade else "no fade was found"
    changes = "{:.2%} of the picture changes its light between frames" + ("" if vectors else " (motion included)")
    outliers = "{:.2g} of the pixels stand alone far above their neighbours"
    fireflies = sum(frame.fireflies for frame in frames)
    spread = max((frame.albedo_spread for frame in frames if frame.albedo_spread is not None), default=None)
    albedo = "no albedo in the file" if spread is None else f"the albedo varies by {spread:.3g}"
    neighbours = f"{len(pairs)} pairs of neighbouring frames without a cut between them"
    clean = min(frame.noise_free for frame in frames)
    transparent = max((frame.transparent for frame in frames if frame.transparent is not None), default=None)
    alpha = "no alpha in the file" if transparent is None else f"{transparent:.1%} of the picture is transparent"
    grain = "soft parts of the alpha channel vary by {:.2g} from pixel to pixel"
    prefilter = _decide_prefilter(
        [frame.guide_grain for frame in frames if frame.guide_grain is not None],
        [pair.guide_noise for pair in pairs],
        not pairs or max(frame.noise for frame in frames) > FEW_SAMPLES,
    )
    decisions = (
        _decide_whiten([(frame.noise_correlation, frame.noise_correlation_alone) for frame in frames]),
        _switch("fireflies", fireflies > 0, f"{fireflies} single bright samples"),
        # With one constant albedo this changes nothing; neighbouring frames may have another.
        _switch("demodulate", spread is not None, albedo),
        _decide("outliers", max(frame.outliers for frame in frames), OUTLIERS_ABOVE, outliers),
        _decide_warp(pairs, vectors, moves, speed, changed),
        _decide_dense_flow(pairs, vectors, moves),
        _decide_vectors("refine", vectors, moves, unexplained),
        # Reflections move on surfaces that stand still, too.
        _decide_vectors("reflections", vectors, bool(pairs), unexplained),
        _decide("fade", fade, 0, fades),
        _decide("gate", unexplained, GATE_ABOVE, changes),
        # Samples show light that moves by less than the noise of a pixel, which no figure of this plan shows.
        _switch("drift", bool(pairs), neighbours),
        _decide_fixed_noise([pair.fixed_noise for pair in pairs if pair.fixed_noise is not None]),
        prefilter,
        _decide_clean_guides(prefilter, least_outline_noise(pairs), [frame.samples for frame in frames]),
        _switch("stabilize", bool(pairs), neighbours),
        _switch("restore-mean", clean < 1, f"{1 - clean:.1%} of the tiles hold noise"),
        _decide_blend_samples([pair.shared_noise for pair in pairs]),
        _switch("alpha", bool(transparent), alpha),
        _decide("clean-alpha", max(frame.alpha_grain for frame in frames), ALPHA_NOISE_ABOVE, grain),
        _switch("skip", clean > 0, f"{clean:.1%} of the tiles hold no noise"),
    )
    return Plan(decisions, cuts, repeats)


def merge(plans: Mapping[int, Plan]) -> Plan:
    """Merge the plans of frames: each stage's most decisive decision, and the frames on which the stage runs."""
    merged = []
    for index, stage in enumerate(STAGES):
        decisions = {number: plan.decisions[index] for number, plan in plans.items()}
        on = tuple(number for number, decision in decisions.items() if decision.on)
        most = max(on or decisions, key=lambda n: -np.inf if (figure := decisions[n].figure) is None else figure)
        reason = decisions[most].reason
        if stage in plans[most].shares:
            reason += f"; it ran on {plans[most].shares[stage]:.0%} of the picture"
        if 0 < len(on) < len(plans):
            reason += f"; frames {format_frames(on)} of {format_frames(plans)}"
        merged.append(replace(decisions[most], reason=reason, frames=on))
    cuts, repeats = ({pair for plan in plans.values() for pair in getattr(plan, name)} for name in ("cuts", "repeats"))
    return Plan(tuple(merged), tuple(sorted(cuts)), tuple(sorted(repeats)))


def _decide(stage: str, figure: float, threshold: float, reason: str) -> Decision:
    return Decision(stage, figure > threshold, figure, threshold, reason.format(figure))


def _switch(stage: str, on: bool, reason: str) -> Decision:
    return Decision(stage, on, None, None, reason)


def _decide_whiten(correlations: Sequence[tuple[Correlation | None, float | None]]) -> Decision:
    """Decide by the correlation of the noise of frames, each with the lower quartile if it was measured in it alone."""
    decisions = [_decide_lags(lags, alone) for lags, alone in correlations if lags]
    decisions = [decision for decision in decisions if decision.figure is not None] or decisions
    if not decisions:
        return Decision("whiten", False, None, WHITEN_ABOVE, "no frame in which noise can be told from the picture")
    return max(decisions, key=lambda decision: (decision.on, decision.figure or 0.0))


def _decide_lags(lags: Correlation, alone: float | None) -> Decision:
    far = float(np.mean([along[2:] for along in lags]))
    wide = f"that of pixels three apart by {far:.2f}"
    if alone is not None:
        if far >= WHITEN_BELOW:  # as denoised pictures have it
            return Decision("whiten", False, None, WHITEN_ALONE_ABOVE, f"single frames may have no noise: {wide}")
        reason = "the noise of neighbouring pixels correlates by {:.2f} in three quarters of single frames"
        return _decide("whiten", alone, WHITEN_ALONE_ABOVE, reason)
    near = near_correlation(lags)
    decision = _decide("whiten", near, WHITEN_ABOVE, "the noise of neighbouring pixels correlates by {:.2f}")
    if not decision.on or far < WHITEN_BELOW:
        return decision
    why = f"{wide}: no pixel filter that can be undone; render with a narrower one"
    return replace(decision, on=False, reason=f"{decision.reason}, {why}")


def _decide_warp(pairs: Sequence[PairFacts], vectors: bool, moves: bool, speed: float, changed: float) -> Decision:
    if not pairs:
        return Decision("warp", False, None, STILL, "no two neighbouring frames")
    if vectors:
        reason = "the fastest thousandth moves {:.2f} px per frame" if moves else "nothing moves: at most {:.3f} px"
        return Decision("warp", moves, speed, STILL, reason.format(speed))
    reason = "{:.2%} of the picture changes between frames" if moves else "nothing changes between frames but {:.2%}"
    return Decision("warp", moves, changed, GATE_ABOVE, reason.format(changed))


def _decide_dense_flow(pairs: Sequence[PairFacts], vectors: bool, moves: bool) -> Decision:
    if moves and not vectors:
        reason = "no motion vectors in the file: the motion has to be found in the pictures"
    elif vectors:
        reason = "motion vectors are there"
    else:
        reason = "nothing moves" if pairs else "no two neighbouring frames"
    return Decision("dense-flow", moves and not vectors, None, 0, reason)


def _decide_vectors(stage: str, vectors: bool, moves: bool, unexplained: float) -> Decision:
    """Decide a stage that corrects, or adds to, the renderer's vectors."""
    if not vectors:
        return Decision(stage, False, None, UNEXPLAINED_ABOVE, "no vectors in the file; see dense-flow")
    if not moves:
        return Decision(stage, False, None, UNEXPLAINED_ABOVE, "nothing moves")
    return _decide(stage, unexplained, UNEXPLAINED_ABOVE, "the vectors leave {:.2%} of the picture unexplained")


def _decide_fixed_noise(figures: Sequence[float]) -> Decision:
    if not figures:
        return Decision("fixed-noise", False, None, FIXED_NOISE_ABOVE, "no two neighbouring frames")
    figure = float(np.median(figures))
    reason = "{:.2f} of the noise of neighbouring frames is the same at equal pixels"
    if figure > FIXED_NOISE_ABOVE:
        reason += f": {ONE_SEED}"
    return _decide("fixed-noise", figure, FIXED_NOISE_ABOVE, reason)


def _decide_blend_samples(shares: Sequence[float]) -> Decision:
    if (share := float(np.median(shares or 0.0))) > FIXED_NOISE_ABOVE:
        reason = f"neighbouring frames share {share:.2f} of their noise by their denoised pictures: {ONE_SEED}"
        return Decision("blend-samples", False, share, FIXED_NOISE_ABOVE, reason)
    return _switch("blend-samples", True, "each pixel is compared with its samples")


def _decide_prefilter(grain: Sequence[float], noise: Iterable[float], unknown: bool) -> Decision:
    if not grain:
        return Decision("prefilter", False, None, GUIDE_NOISE_ABOVE, "no guides in the file")
    figure, reason = max(noise, default=0.0), "the guides differ by {:.3f} between frames"
    if figure == 0 and unknown:
        figure = max(grain)
        reason = "the guides differ by {:.3f} from pixel to pixel, and not at all between frames"
    return _decide("prefilter", figure, GUIDE_NOISE_ABOVE, reason)


def _decide_clean_guides(
    prefilter: Decision, noise: tuple[float, float] | None, samples: Sequence[float | None]
) -> Decision:
    if prefilter.on or prefilter.figure is None:
        return replace(prefilter, stage="clean-guides")
    if noise is None:
        # Filtering costs at most 0.02 dB where guides have no noise, and gains 1.3 dB where they are of 8 samples.
        reason = "the noise of the guides at outlines is unknown: no motion vectors of whole pixels"
        counts = [count for count in samples if count is not None]
        if len(counts) < len(samples):
            return Decision("clean-guides", True, None, OUTLINE_NOISE_ABOVE, reason)
        # A pixel that an outline divides in halves has this variance, over that of its surroundings.
        return _decide(
            "clean-guides", 1 / min(counts), OUTLINE_NOISE_ABOVE, f"{reason}; {{:.3f}} by the samples per pixel"
        )
    return _decide(
        "clean-guides", max(noise), OUTLINE_NOISE_ABOVE, "{:.3f} of the variance of the guides at outlines is noise"
    )
