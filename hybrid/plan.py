"""The plan: what a shot calls for, measured before anything runs.

No stage is paid for that the shot does not have, and nothing is skipped silently: each decision carries the
figure that was measured, the threshold it was held against, and the reason in words.
"""

from __future__ import annotations

from collections.abc import Callable, Collection, Iterable, Mapping, Sequence
from dataclasses import dataclass, replace

import numpy as np

from hybrid.alignment.loading import LoadedFrames
from hybrid.alignment.measure import FIXED_NOISE_ABOVE, FrameFacts, PairFacts
from hybrid.files.frame import Frames
from hybrid.files.sequences import format_frames

STAGES = {
    "fireflies": "take single bright samples out of a frame before anything spreads them",
    "demodulate": "filter light instead of light times texture",
    "outliers": "reject what stands out of the aligned window",
    "warp": "move side frames along the motion",
    "dense-flow": "find the motion in the pictures",
    "refine": "correct the renderer's vectors by TV-L1",
    "gate": "do not average over time where the light itself changes",
    "drift": "average less of estimates whose light drifts, as samples tell that they do not know",
    "fixed-noise": "do not average noise that stands still on the screen",
    "prefilter": "filter noisy albedo and normals before they guide anything",
    "steady": "average finished frames with those beside them",
    "mean": "give pictures the local means of their samples, fireflies included, as far as these are known",
    "samples": "blend samples into pictures where their noise is small against the difference",
    "alpha": "filter the alpha channel with the network's kernels",
    "skip": "leave tiles without noise out of the network",
}
# Why what is called for may yet not run.
_NOT_RUN = {
    "outliers": "beside estimates what single samples may add is bounded instead",
    "drift": "needs estimates of five frames or more",
}
# Stages that only a network has.
NEURAL_STAGES = frozenset({"steady", "alpha", "skip"})

# Motion below a twentieth of a pixel blurs a bilinear sample by less than 1 % of its contrast.
STILL = 0.05
# Share of pixels, in areas of 9×9, whose brightness the vectors do not explain. Refinement is worth its time for
# reflections and shadows of some size; the gate is cheap and already pays for a small highlight.
REFINE_ABOVE = 0.01
GATE_ABOVE = 0.002
# One firefly in a hundred thousand pixels is twenty in a 1080p frame: visible.
OUTLIERS_ABOVE = 1e-5
# Upper quartile of |Δalbedo| between frames, along the vectors. Surfaces under film sampling differ by less;
# with few samples, under depth of field or behind glass by more.
GUIDE_NOISE_ABOVE = 0.003
# Frames on each side of a window as it is planned for a whole shot.
RADIUS = 2


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
    frames : tuple of int
        In a plan of several frames, those with the stage.
    """

    stage: str
    on: bool
    figure: float | None
    threshold: float
    reason: str
    forced: bool = False
    frames: tuple[int, ...] = ()


@dataclass(frozen=True)
class Plan:
    """The decisions for one window, or for a shot: then a stage is on if it is for any frame.

    Attributes
    ----------
    decisions : tuple of Decision
        One for each of `STAGES`.
    cuts : tuple of (int, int)
        Neighbouring frames that show something else: nothing is averaged over them.
    repeats : tuple of (int, int)
        Neighbouring frames of which one is the other once more: its samples count once.
    """

    decisions: tuple[Decision, ...]
    cuts: tuple[tuple[int, int], ...] = ()
    repeats: tuple[tuple[int, int], ...] = ()

    @property
    def stages(self) -> frozenset[str]:
        """Names of the stages that run."""
        return frozenset(decision.stage for decision in self.decisions if decision.on)

    def force(self, on: Collection[str] = (), off: Collection[str] = ()) -> Plan:
        """Switch stages on or off whatever was measured."""
        return replace(
            self,
            decisions=tuple(
                replace(d, on=d.stage in on, forced=True, reason=f"forced; measured: {d.reason}")
                if d.stage in on or d.stage in off
                else d
                for d in self.decisions
            ),
        )


def as_run(plan: Plan, stages: Collection[str], shares: Mapping[str, float] | None = None) -> Plan:
    """Say of the plan of a window what ran.

    Where there are estimates the gate compares them in any case, and no samples are rejected; where there are none, or
    of three frames alone, drift cannot be told.

    Parameters
    ----------
    plan : Plan
        Of a window.
    stages : collection of str
        That ran.
    shares : mapping of str to float, optional
        On what share of the picture, in [0, 1], for those that run only where they are called for.

    Returns
    -------
    Plan
    """
    decisions = []
    for decision in plan.decisions:
        ran, reason = decision.stage in stages, decision.reason
        if ran and not decision.on:
            reason = f"estimates are compared in any case; measured: {reason}"
        elif decision.on and not ran and decision.stage in _NOT_RUN:
            reason = f"{_NOT_RUN[decision.stage]}; {reason}"
        if shares is not None and decision.stage in shares:
            reason += f"; it ran on {shares[decision.stage]:.0%} of it"
        decisions.append(replace(decision, on=ran, reason=reason))
    return replace(plan, decisions=tuple(decisions))


@dataclass(frozen=True)
class Rules:
    """What decides the stages of a window: the figures, and what the user has forced.

    Attributes
    ----------
    on, off : frozenset of str
        Stages that run, or do not, whatever was measured.

    Raises
    ------
    ValueError
        A stage that does not exist, or one that is to be both on and off.
    """

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
        """What the user has forced, in words: +warp -gate."""
        return " ".join([*(f"+{name}" for name in sorted(self.on)), *(f"-{name}" for name in sorted(self.off))])

    def plan(self, frames: Sequence[FrameFacts], pairs: Sequence[PairFacts]) -> Plan:
        """Decide on a window by what its frames and its pairs of neighbours show."""
        vectors = bool(pairs) and all(pair.vectors for pair in pairs)
        # Who wants frames moved, and has no vectors, wants the motion found; or nobody says where to.
        found = {"dense-flow"} if "warp" in self.on and pairs and not vectors else set()
        return decide(frames, pairs).force(self.on | (found - self.off), self.off)

    def __call__(self, frames: Sequence[FrameFacts], pairs: Sequence[PairFacts]) -> frozenset[str]:
        """Return the stages of that plan."""
        return self.plan(frames, pairs).stages


def decide(frames: Sequence[FrameFacts], pairs: Sequence[PairFacts]) -> Plan:
    """Decide which stages a window calls for.

    Parameters
    ----------
    frames : sequence of FrameFacts
        Of all frames of the window that are there; at least one.
    pairs : sequence of PairFacts
        Of all neighbours among them. Of those across a cut nothing is asked.

    Returns
    -------
    Plan
        One decision for each of `STAGES`.
    """
    cuts = tuple(pair.numbers for pair in pairs if pair.cut)
    repeats = tuple(pair.numbers for pair in pairs if pair.repeated)
    pairs = [pair for pair in pairs if not pair.cut]
    vectors = bool(pairs) and all(pair.vectors for pair in pairs)
    changed = max((pair.changed for pair in pairs), default=0.0)
    unexplained = max((pair.unexplained for pair in pairs), default=0.0)
    speed = max((pair.speed for pair in pairs), default=0.0)
    moves = speed > STILL if vectors else changed > GATE_ABOVE
    changes = "{:.2%} of the picture changes its light between frames" + ("" if vectors else " (motion included)")
    pairs_beside = "{:.0f} pairs of neighbouring frames without a cut between them"
    transparent = [frame.transparent for frame in frames if frame.transparent is not None]
    return Plan(
        (
            _decide("fireflies", float(sum(f.fireflies for f in frames)), 0, "{:.0f} single samples shine alone"),
            _decide_demodulate([f.albedo_spread for f in frames if f.albedo_spread is not None]),
            _decide(
                "outliers",
                max(frame.outliers for frame in frames),
                OUTLIERS_ABOVE,
                "{:.2g} of the pixels stand alone far above their neighbours",
            ),
            _decide_warp(pairs, vectors, moves, speed, changed),
            _decide_dense_flow(pairs, vectors, moves),
            _decide_refine(moves, vectors, unexplained),
            _decide("gate", unexplained, GATE_ABOVE, changes),
            # Samples see what this plan cannot: light that moves by less than the noise of a pixel.
            _decide("drift", float(len(pairs)), 0, pairs_beside),
            _decide_fixed_noise([pair.fixed_noise for pair in pairs]),
            _decide_prefilter(any(frame.guides for frame in frames), [pair.guide_noise for pair in pairs]),
            _decide("steady", float(len(pairs)), 0, pairs_beside),
            _decide("mean", 1 - min(frame.noise_free for frame in frames), 0, "{:.1%} of the tiles hold noise"),
            # Each pixel decides by itself; a picture is nowhere to be worse than its samples.
            Decision("samples", True, None, 0, "each pixel is compared with its samples"),
            Decision("alpha", False, None, 0, "no alpha in the file")
            if not transparent
            else _decide("alpha", max(transparent), 0, "{:.1%} of the picture is transparent"),
            _decide("skip", min(frame.noise_free for frame in frames), 0.0, "{:.1%} of the tiles hold no noise"),
        ),
        cuts,
        repeats,
    )


def plan_shot(
    shot: Frames, rules: Rules | None = None, *, radius: int = RADIUS, advance: Callable[[], object] = lambda: None
) -> Plan:
    """Plan every frame of a shot, and say on which frames each stage runs.

    Parameters
    ----------
    shot : Frames
        All of its frames are read.
    rules : Rules, optional
        What was forced.
    radius : int
        Frames on each side of a window.
    advance : callable
        Called after each frame.

    Returns
    -------
    Plan
        One decision for each of `STAGES`, with the figure of the window that calls for it most.
    """
    rules = rules or Rules()
    frames = LoadedFrames(shot, rules)
    plans = {}
    for number in shot.numbers:
        window = frames.around(number, radius)
        frames.load(window)
        plans[number] = rules.plan(*frames.facts_of(window))
        advance()
    return merge(plans)


def merge(plans: dict[int, Plan]) -> Plan:
    """Put the plans of several frames into one, which says where each stage runs.

    Parameters
    ----------
    plans : dict of int to Plan
        By frame number; at least one.

    Returns
    -------
    Plan
        Of each stage the decision whose figure lies farthest on the side that was decided for.
    """
    merged = []
    for stage, *decisions in zip(STAGES, *(plan.decisions for plan in plans.values()), strict=True):
        on = tuple(number for number, decision in zip(plans, decisions, strict=True) if decision.on)
        candidates = [d for d in decisions if d.on] or decisions
        most = max(candidates, key=lambda d: -np.inf if d.figure is None else d.figure)
        where = f"; frames {format_frames(on)} of {format_frames(plans)}" if 0 < len(on) < len(plans) else ""
        assert stage == most.stage
        merged.append(replace(most, reason=most.reason + where, frames=on))
    cuts, repeats = ({pair for plan in plans.values() for pair in getattr(plan, name)} for name in ("cuts", "repeats"))
    return Plan(tuple(merged), tuple(sorted(cuts)), tuple(sorted(repeats)))


def _decide(stage: str, figure: float, threshold: float, words: str) -> Decision:
    return Decision(stage, figure > threshold, figure, threshold, words.format(figure))


def _decide_demodulate(spreads: Sequence[float]) -> Decision:
    if not spreads:
        return Decision("demodulate", False, None, 0, "no albedo in the file")
    # On frames of one albedo it changes nothing; that their neighbours have another is not for them to know.
    return Decision("demodulate", True, max(spreads), 0, f"the albedo varies by {max(spreads):.3g}")


def _decide_warp(pairs: Sequence[PairFacts], vectors: bool, moves: bool, speed: float, changed: float) -> Decision:
    if not pairs:
        return Decision("warp", False, None, STILL, "no two neighbouring frames")
    if vectors:
        words = "the fastest thousandth moves {:.2f} px per frame" if moves else "nothing moves: at most {:.3f} px"
        return Decision("warp", moves, speed, STILL, words.format(speed))
    words = "{:.2%} of the picture changes between frames" if moves else "nothing changes between frames but {:.2%}"
    return Decision("warp", moves, changed, GATE_ABOVE, words.format(changed))


def _decide_dense_flow(pairs: Sequence[PairFacts], vectors: bool, moves: bool) -> Decision:
    if moves and not vectors:
        words = "no motion vectors in the file: the motion has to be found in the pictures"
    elif vectors:
        words = "motion vectors are there"
    else:
        words = "nothing moves" if pairs else "no two neighbouring frames"
    return Decision("dense-flow", moves and not vectors, None, 0, words)


def _decide_refine(moves: bool, vectors: bool, unexplained: float) -> Decision:
    if not vectors:
        return Decision("refine", False, None, REFINE_ABOVE, "no vectors to refine; see dense-flow")
    if not moves:
        return Decision("refine", False, None, REFINE_ABOVE, "nothing moves")
    return _decide("refine", unexplained, REFINE_ABOVE, "the vectors leave {:.2%} of the picture unexplained")


def _decide_fixed_noise(figures: Sequence[float]) -> Decision:
    if not figures:
        return Decision("fixed-noise", False, None, FIXED_NOISE_ABOVE, "no two neighbouring frames")
    figure = float(np.median(figures))
    words = "{:.2f} of the noise of neighbouring frames is the same at equal pixels"
    if figure > FIXED_NOISE_ABOVE:
        words += ": the render has one seed for all frames, and time adds little where nothing moves; in Blender, "
        words += "switch on Render > Sampling > Advanced > Animate Seed (the clock beside Seed)"
    return _decide("fixed-noise", figure, FIXED_NOISE_ABOVE, words)


def _decide_prefilter(guides: bool, noise: Iterable[float]) -> Decision:
    if not guides:
        return Decision("prefilter", False, None, GUIDE_NOISE_ABOVE, "no guides in the file")
    return _decide(
        "prefilter", max(noise, default=0.0), GUIDE_NOISE_ABOVE, "the guides differ by {:.3f} between frames"
    )
