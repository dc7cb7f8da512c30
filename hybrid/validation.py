"""Which layers of a shot make sense: each is judged on a few pairs of frames before anything runs.

Files say what they hold, and are sometimes wrong: a pass that was switched on and never filled, vectors of another
convention, guides of another frame. What does not make sense is left out, and a line says so.
"""

from __future__ import annotations

from collections.abc import Callable, Collection, Iterator, Sequence
from contextlib import suppress
from dataclasses import dataclass, replace
from functools import partial

import cv2
import numpy as np
from numpy.typing import NDArray

from flow.convention import SCALES, Choice, FramePair, Patches, Trial, choose_convention
from flow.guide import median_luminance, tone_map
from hybrid.files.frame import Frame
from hybrid.files.layers import Layers
from hybrid.files.passes import NO_PASSES, Passes
from hybrid.files.profile import ROLES
from hybrid.files.reader import Interpretation
from hybrid.files.shots import Shot
from hybrid.grade import Grade, find_grade
from hybrid.passes import classify_passes, sample_rows

Array = NDArray[np.float32]

# Pairs that are looked at, spread over all files of the shot and not over the frames that were asked for: what is
# decided must not depend on the chunk that a frame comes in.
PAIRS = 2
# Rows of which shares and bounds are taken, and to which pictures are reduced before their edges are compared.
THIN, EDGE_ROWS = 270, 540
# A layer whose values lie within this of each other, relative to the largest, is the same everywhere: half floats
# round by 5e-4.
SAME = 1e-3
# Share of pixels beyond its range that a layer may have: filters with negative lobes overshoot at edges.
STRAY = 0.01
# Reflectance is below 1; emitters and skies are written as brighter albedos by some, but not as half of a picture.
BRIGHT = 2.0
# Averages over a pixel are shorter than 1, rounding makes them longer by less than this.
LENGTH = 1.1
# Correlation of edges, of a guide with the colors of two frames: on the bundled shot an albedo has 0.61 with its own
# frame and 0.17 to 0.29 with the next, a normal 0.49 and 0.35.
EDGES = 0.05
# The variance may differ from what the picture shows by this factor: the third quartile of their ratio was 1.3 to 1.7.
VARIANCE = 4.0
# The mean of a denoised picture may differ from that of the noisy one by this factor. What single bright samples carry
# is uncertain: so it must differ by so many standard errors too (of independent pixels, where a renderer's filter and
# denoisers make neighbours alike), and by a share of the brightest frame around it, whose light leaks into a dark one.
LIGHT, ERRORS, LEAK = 2.5, 10.0, 0.05
# Share of its pixels that an estimate may have lost.
LOST = 0.01
# So many readings of the vectors are shown.
SHOWN = 6
# Two pictures of which so many pixels are equal are one, black pixels left out: empty areas of all layers are equal.
EQUAL = 0.99


@dataclass(frozen=True)
class Finding:
    """What was found about a layer.

    Attributes
    ----------
    role : str
        What the layer is to a denoiser; "aov" for the further layers.
    message : str
        One line.
    warning : bool
        False for what is as good as could be expected.
    left_out : bool
        Whether the layer is not used.
    """

    role: str
    message: str
    warning: bool = True
    left_out: bool = True


@dataclass(frozen=True)
class ValidationReport:
    """What was found about a shot's layers.

    Attributes
    ----------
    findings : tuple of Finding
        In the order of the roles.
    motion : Choice or None
        The readings of the vectors that were tried; None where there are no vectors, or no pair of frames.
    variance_scale : float or None
        What the variance is multiplied by, where that was measured.
    passes : Passes
        What the further layers are to the picture.
    estimate_factors : (float, float, float) or None
        What the denoised picture is multiplied by, where it has another level than the samples.
    """

    findings: tuple[Finding, ...] = ()
    motion: Choice | None = None
    variance_scale: float | None = None
    passes: Passes = NO_PASSES
    estimate_factors: tuple[float, float, float] | None = None

    @property
    def warnings(self) -> tuple[str, ...]:
        """One line for each thing that does not make sense."""
        return tuple(finding.message for finding in self.findings if finding.warning)

    def readings(self) -> list[tuple[str, str, str]]:
        """What was tried for the motion, the best first: "taken" or "", how vectors are read, and what that leaves.

        The one that is taken, or else the best, is always among them; of scales that were fitted only the best is.
        """
        if self.motion is None:
            return []
        chosen = self.motion.convention
        kept: list[Trial] = []
        for trial in self.motion.trials:
            plain = replace(trial.convention, scale=1.0)
            fitted = trial.convention.scale not in SCALES and any(
                plain == replace(k.convention, scale=1.0) for k in kept
            )
            if trial.convention == chosen or (not fitted and len(kept) < SHOWN):
                kept.append(trial)
        rows = [(trial.convention == chosen, str(trial.convention), trial.unexplained) for trial in kept]
        rows.append((False, "no motion", self.motion.still))
        if self.motion.found is not None:
            rows.append((self.motion.convention is None, "found in the pictures", self.motion.found))
        return [("taken" if taken else "", said, f"{share:.2%}") for taken, said, share in rows]

    def apply(self, shot: Shot) -> Shot:
        """The shot without the layers that do not make sense, and with vectors and variance as they were measured."""
        left_out = frozenset(finding.role for finding in self.findings if finding.left_out)
        convention = None if self.motion is None else self.motion.convention
        interpretation = Interpretation(left_out, convention, self.variance_scale, self.passes, self.estimate_factors)
        return shot.reinterpreted(interpretation)


def validate_layers(shot: Shot) -> ValidationReport:
    """Judge every layer of a shot on pairs of neighbouring frames.

    Parameters
    ----------
    shot : Shot
        One pair of all its files is read, and up to `PAIRS` where that leaves a question; of a shot without neighbours
        one frame.

    Returns
    -------
    ValidationReport
        Depends on the files and on the options that the shot was opened with, not on the frames asked for.

    Notes
    -----
    A file that cannot be read is an error when its turn comes; until then the other pairs are looked at.
    """
    pairs = _pair_numbers(shot)
    try:
        return _judge_pairs(shot, pairs)
    except (ValueError, OSError):
        readable = [pair for pair in pairs if all(_can_read(shot, number) for number in pair)]
        if readable == pairs:
            raise
        return _judge_pairs(shot, readable) if readable else ValidationReport()


def find_cut(a: int, b: int) -> Finding:
    """Say that two neighbouring frames show something else.

    Parameters
    ----------
    a, b : int
        Numbers of frames between which `hybrid.alignment.measure.PairFacts` has a cut.
    """
    return Finding(
        "color", f"frames {a} and {b} show something else: nothing is averaged over this cut", left_out=False
    )


def find_repeat(a: int, b: int) -> Finding:
    """Say that the later of two neighbouring frames is the earlier one once more (`PairFacts.repeated`).

    Parameters
    ----------
    a, b : int
        Numbers of the frames.
    """
    return Finding(
        "color", f"frame {b} is frame {a} once more: the same noise, whose samples count once", left_out=False
    )


def find_other_frame(shot: Shot, finished: Callable[[int], Array | None]) -> str | None:
    """Say whether denoised pictures of a shot are each of the frame before or after; None where they are not.

    Parameters
    ----------
    shot : Shot
        The noisy frames, of which as many pairs are read as for `validate_layers`.
    finished : callable
        From a frame's number to its denoised picture (H, W, 3); None where it has none.

    Returns
    -------
    str or None
        Which frame, in words, with figures. What cannot be read is an error when its turn comes.
    """
    edges = []
    for pair in _pair_numbers(shot):
        with suppress(ValueError, OSError):
            pictures = [picture for number in pair if (picture := finished(number)) is not None]
            colors = [shot.read_color(number) for number in pair]
            if [picture.shape for picture in pictures] == [color.shape for color in colors]:
                edges.append(_match_edges(_edges_shown(pictures), _edges_shown(colors)))
    return _other_frame(edges) if edges else None


def find_sequence_grade(shot: Shot, finished: Callable[[int], Array | None]) -> Grade | None:
    """Compare the level of denoised pictures with that of a shot's samples; None where they agree.

    Parameters
    ----------
    shot : Shot
        The noisy frames, of which those are read that `validate_layers` may read.
    finished : callable
        From a frame's number to its denoised picture (H, W, 3); None where it has none.
    """
    numbers = sorted({number for pair in _pair_numbers(shot) for number in pair}) or [shot.available[0]]
    pictures = []
    for number in numbers:
        with suppress(ValueError, OSError):  # what cannot be read is an error when its turn comes
            picture, color = finished(number), shot.read_color(number)
            if picture is not None and picture.shape == color.shape:
                pictures.append((picture, color))
    return find_grade(pictures) if pictures else None


def _can_read(shot: Shot, number: int) -> bool:
    try:
        shot.read(number)
    except (ValueError, OSError):
        return False
    return True


def _judge_pairs(shot: Shot, pairs: Sequence[tuple[int, int]]) -> ValidationReport:
    layers = shot.layers(shot.available[0])
    evidence = _Evidence(layers)
    if not pairs:
        evidence.add(shot.read(shot.available[0]))
        return evidence.classify_passes(_judge(evidence, layers, [], lambda roles: []))
    light: list[Patches] = []
    surfaces: list[Patches] = []

    def look_at_surfaces(earlier: Frame, later: Frame, roles: Collection[str]) -> list[Patches]:
        surfaces.extend(Patches(pair) for pair in _surface_pairs(earlier, later, roles, shot.step))
        return surfaces

    for a, b in pairs:
        earlier, later = shot.read(a), shot.read(b)
        evidence.add(earlier, later)
        if (pair := _pair_of(earlier, later, earlier.color, later.color, shot.step)) is not None:
            light.append(Patches(pair))
        judgement = _judge(evidence, layers, light, partial(look_at_surfaces, earlier, later))
        if not judgement.warnings and (judgement.motion is None or judgement.motion.certain):
            break  # nothing is left to ask
    return evidence.classify_passes(judgement)


def _pair_of(earlier: Frame, later: Frame, here: Array, there: Array, step: int) -> FramePair | None:
    """Pictures of two frames with their vectors; None where one has none."""
    if earlier.motion is None or later.motion is None:
        return None
    resolution = earlier.resolution or earlier.motion.shape[:2]
    return FramePair(here, there, earlier.motion, later.motion, resolution, step)


def _surface_pairs(earlier: Frame, later: Frame, roles: Collection[str], step: int) -> Iterator[FramePair]:
    """What two frames show of their surfaces in these guides, as pictures."""
    for role in roles:
        here, there = getattr(earlier, role), getattr(later, role)
        if here is not None and there is not None:
            lift = np.float32(role == "normal")  # none of it is negative then
            if (pair := _pair_of(earlier, later, here + lift, there + lift, step)) is not None:
                yield pair


def _judge(
    evidence: _Evidence,
    layers: Layers,
    light: Sequence[Patches],
    surfaces: Callable[[Collection[str]], Sequence[Patches]],
) -> ValidationReport:
    variance_scale, judged = evidence.judge_variance()
    grade, graded = evidence.judge_grade()
    findings = [*evidence.findings(), *judged, *graded]
    choice = None
    if layers.motion_convention is not None and light:
        sound = [role for role in ("albedo", "normal") if role not in {finding.role for finding in findings}]
        choice = choose_convention(
            light, layers.motion_convention, layers.settled, lambda: surfaces(sound), layers.typed
        )
        findings += _judge_motion(layers, choice)
    findings.sort(key=lambda finding: ROLES.index(finding.role))
    return ValidationReport(tuple(findings), choice, variance_scale, estimate_factors=grade)


def _pair_numbers(shot: Shot) -> list[tuple[int, int]]:
    """Neighbours, spread over all files of the shot."""
    pairs = [(a, a + shot.step) for a in shot.available if shot.has(a + shot.step)]
    count = min(PAIRS, len(pairs))
    return [pairs[(2 * i + 1) * len(pairs) // (2 * count)] for i in range(count)]


class _Evidence:
    """What frames show of each layer but motion; they need not be kept."""

    def __init__(self, layers: Layers) -> None:
        self.layers = layers
        # Of each frame: what is wrong with a layer, in words; of a layer that makes sense nothing.
        self.wrong: dict[str, list[str | None]] = {}
        self.edges: dict[str, list[tuple[float, float, float]]] = {}
        self.variances: list[Array] = []
        self.passes: list[Frame] = []
        self.pictures: list[tuple[Array, Array]] = []

    def add(self, *frames: Frame) -> None:
        """Look at one frame, or at two neighbours."""
        for frame in frames:
            thin = _thin(frame)
            if frame.aovs:
                self.passes.append(sample_rows(frame))
            for role, judge in _JUDGES.items():
                if getattr(frame, role) is not None:
                    self.wrong.setdefault(role, []).append(judge(thin))
            if frame.estimate is not None:
                self.pictures.append((frame.estimate, frame.color))
            if frame.variance is not None:
                self.variances.append(_variance_ratios(frame))
        if len(frames) == 2:
            shown = _edges_shown([frame.color for frame in frames])
            for role in ("albedo", "normal"):
                guides = [getattr(frame, role) for frame in frames]
                if all(guide is not None for guide in guides):
                    slopes = [_slope(_shrink(guide)) for guide in guides]
                    self.edges.setdefault(role, []).append(_match_edges(slopes, shown))

    def findings(self) -> Iterator[Finding]:
        """What is wrong in every frame that was looked at."""
        for role, words in self.wrong.items():
            if all(words):
                yield self._leave(role, str(words[0]))
            elif role in self.edges and (other := _other_frame(self.edges[role])):
                yield self._leave(role, f"belongs to {other}")

    def judge_variance(self) -> tuple[float | None, list[Finding]]:
        """What the variance is multiplied by where nobody has said so, and what there is to say of it."""
        if not self.variances or all(self.wrong["variance"]):
            return None, []
        ratio = float(np.quantile(np.concatenate(self.variances), 0.75))
        said = f"is {ratio:.3g} times what the picture shows"
        if 1 / VARIANCE <= ratio <= VARIANCE:
            return None, []
        samples, known = self.layers.samples, self.layers.variance_scale is not None
        if self.layers.variance_of == "sample" and not known and ratio > 1:
            words = f"{self._name('variance')} {said}, as that of samples is: divided by that"
            return 1 / ratio, [Finding("variance", words, warning=False, left_out=False)]
        if self.layers.variance_of is None and samples and 1 / VARIANCE <= ratio / samples <= VARIANCE:
            words = f"{self._name('variance')} {said}: taken as that of {samples:g} samples"
            return 1 / samples, [Finding("variance", words, left_out=False)]
        return None, [self._leave("variance", said)]

    def classify_passes(self, judgement: ValidationReport) -> ValidationReport:
        """The same with what the further layers are to the picture, and a line for each."""
        if not self.passes:
            return judgement
        passes, words = classify_passes(self.passes)
        lines = (Finding("aov", f"aov {name}: {said}", warning=False, left_out=False) for name, said in words.items())
        return replace(judgement, findings=(*judgement.findings, *lines), passes=passes)

    def judge_grade(self) -> tuple[tuple[float, float, float] | None, list[Finding]]:
        """What the denoised picture is multiplied by to have the level of the samples, and what there is to say."""
        if not self.pictures or all(self.wrong["estimate"]) or (grade := find_grade(self.pictures)) is None:
            return None, []
        if grade.factors is None:
            return None, [self._leave("estimate", grade.message)]
        words = f"{self._name('estimate')} {grade.message}: brought to that"
        return grade.factors, [Finding("estimate", words, left_out=False)]

    def _leave(self, role: str, words: str) -> Finding:
        return Finding(role, f"{self._name(role)} {words}: left out")

    def _name(self, role: str) -> str:
        return f"{role} ({getattr(self.layers, role) or 'of two halves'})"


def _thin(frame: Frame) -> Frame:
    """Every n-th row and column of a frame: shares of its pixels and their bounds need no more than `THIN` rows."""
    step = max(1, min(frame.color.shape[:2]) // THIN)
    roles = ("color", *_JUDGES)
    layers = {role: layer[::step, ::step] for role in roles if (layer := getattr(frame, role)) is not None}
    return Frame(frame.number, **layers)


def _shrink(layer: Array) -> Array:
    """A layer (H, W, C) reduced by a whole factor to about `EDGE_ROWS` rows; what is not finite counts as 0."""
    factor = max(1, min(layer.shape[:2]) // EDGE_ROWS)
    clean = np.where(np.isfinite(layer), layer, np.float32(0))
    if factor == 1:
        return np.asarray(clean, np.float32)
    size = layer.shape[1] // factor, layer.shape[0] // factor
    cut = clean[: size[1] * factor, : size[0] * factor]
    return np.asarray(cv2.resize(cut, size, interpolation=cv2.INTER_AREA), np.float32)


def _edges_shown(colors: Sequence[Array]) -> list[Array]:
    """The edges of pictures, as the first one is exposed."""
    small = [_shrink(color) for color in colors]
    exposure = median_luminance(small[0])
    # Of noise the correlation knows less where neighbours are averaged.
    tones = [cv2.blur(tone_map(color, exposure), (3, 3)) for color in small]
    return [_slope(np.asarray(tone, np.float32)) for tone in tones]


def _match_edges(found: Sequence[Array], shown: Sequence[Array]) -> tuple[float, float, float]:
    """Correlations of what two frames should show with what they show, of the second with the first, and back."""
    own = (_correlate(found[0], shown[0]) + _correlate(found[1], shown[1])) / 2
    return own, _correlate(found[1], shown[0]), _correlate(found[0], shown[1])


def _other_frame(edges: Sequence[tuple[float, float, float]]) -> str | None:
    """Which frame pairs show that is not their own, by `_match_edges`."""
    own, late, early = np.mean(edges, axis=0)
    if max(late, early) <= own + EDGES:
        return None
    figures = f"their edges correlate {max(late, early):.2f}, with its own frame's {own:.2f}"
    return f"the {'previous' if late > early else 'next'} frame ({figures})"


def _judge_guide(layer: Array) -> str | None:
    # Plane by plane, which is faster than over so short an axis.
    planes = [layer[..., c] for c in range(layer.shape[2])]
    known = [plane[np.isfinite(plane)] for plane in planes]
    if not all(plane.size for plane in known):
        return "has no finite value"
    ranges = [(float(plane.min()), float(plane.max())) for plane in known]
    largest = max(max(-low, high) for low, high in ranges)
    if all(high - low <= SAME * largest for low, high in ranges):
        return "is the same everywhere" if largest > 0 else "is black"
    return None


def _judge_albedo(frame: Frame) -> str | None:
    layer = frame.albedo
    if layer is None or (words := _judge_guide(layer)) is not None:
        return None if layer is None else words
    if (below := float(np.mean(layer.min(axis=-1) < -SAME))) > STRAY:
        return f"is negative in {below:.1%} of the picture"
    if (above := float(np.mean(layer.max(axis=-1) > BRIGHT))) > 0.5:
        return f"is above {BRIGHT:g} in {above:.1%} of the picture"
    return None


def _judge_normal(frame: Frame) -> str | None:
    layer = frame.normal
    if layer is None or (words := _judge_guide(layer)) is not None:
        return None if layer is None else words
    long = float(np.mean(np.einsum("yxc,yxc->yx", layer, layer) > LENGTH**2))
    return f"is longer than 1 in {long:.1%} of the picture" if long > STRAY else None


def _judge_depth(frame: Frame) -> str | None:
    return None if frame.depth is None else _judge_guide(frame.depth[..., None])


def _judge_alpha(frame: Frame) -> str | None:
    layer = frame.alpha
    if layer is None or layer.min() == layer.max():
        return None  # opaque everywhere, or empty
    if any(_equal_share(layer, frame.color[..., c], layer == frame.color[..., c]) > EQUAL for c in range(3)):
        return "is the color"
    outside = float(np.mean((layer < -STRAY) | (layer > 1 + STRAY)))
    return f"is not between 0 and 1 in {outside:.1%} of the picture" if outside > STRAY else None


def _judge_variance(frame: Frame) -> str | None:
    layer = frame.variance
    if layer is None:
        return None
    if not np.nan_to_num(layer).any():
        return "is 0 everywhere"
    below = float(np.mean(layer.min(axis=-1) < 0))
    return f"is negative in {below:.1%} of the picture" if below > STRAY else None


def _judge_estimate(frame: Frame) -> str | None:
    if frame.estimate is None:
        return None
    # Half floats differ from what they were by 5e-4 of it.
    same = np.isclose(frame.estimate, frame.color, rtol=SAME, atol=0).all(axis=-1)
    return "is the noisy picture" if _equal_share(frame.estimate, frame.color, same) > EQUAL else None


def _equal_share(a: Array, b: Array, same: NDArray[np.bool_]) -> float:
    """Share of the pixels that are the same, of those where either layer is not 0; 0 if none is such."""
    lit = (a != 0) | (b != 0)
    lit = lit.any(axis=-1) if lit.ndim == 3 else lit
    return float(np.mean(same[lit])) if lit.any() else 0.0


_JUDGES: dict[str, Callable[[Frame], str | None]] = {
    "albedo": _judge_albedo,
    "normal": _judge_normal,
    "depth": _judge_depth,
    "variance": _judge_variance,
    "alpha": _judge_alpha,
    "estimate": _judge_estimate,
}


def _slope(layer: Array) -> Array:
    """Length of the gradient of (H, W) or (H, W, C), over all channels."""
    square = np.square(cv2.Sobel(layer, -1, 1, 0)) + np.square(cv2.Sobel(layer, -1, 0, 1))
    return np.asarray(np.sqrt(square if layer.ndim == 2 else np.einsum("yxc->yx", square)), np.float32)


def _correlate(a: Array, b: Array) -> float:
    a, b = a - a.mean(), b - b.mean()
    power = float(np.sqrt(np.mean(a**2) * np.mean(b**2)))
    return float(np.mean(a * b)) / power if power > 0 else 0.0


def _variance_ratios(frame: Frame) -> Array:
    """Variance as given, over that which the picture shows, of patches of 9 x 9 pixels.

    The second difference in x of the second difference in y, [1 -2 1]ᵀ [1 -2 1] / 6, has the noise's own variance
    (Immerkær 1996); texture makes it larger, so that flat patches tell most. Green stands for all.
    """
    kernel = np.array([1, -2, 1], np.float32)
    green = np.nan_to_num(frame.color[..., 1], posinf=0.0, neginf=0.0)
    shown = cv2.blur((cv2.sepFilter2D(green, -1, kernel, kernel) / 6) ** 2, (9, 9))[4::9, 4::9]
    variance = np.zeros_like(green) if frame.variance is None else np.nan_to_num(frame.variance[..., 1])
    given = cv2.blur(np.maximum(variance, 0), (9, 9))[4::9, 4::9]
    lit = shown > 0
    return np.asarray(given[lit] / shown[lit], np.float32).ravel()


def _judge_motion(layers: Layers, choice: Choice) -> Iterator[Finding]:
    """What there is to say of the vectors."""
    name = f"motion ({layers.motion})"
    left, still = f"{choice.unexplained:.1%}", f"{choice.still:.1%}"
    if choice.convention is None:
        found = "" if choice.found is None else f", what is found in the pictures {choice.found:.1%}"
        words = f"{name}: no reading of the vectors explains the pictures (it leaves {left}, none {still}{found})"
        yield Finding("motion", f"{words}: left out, found in the pictures")
    elif choice.contradicted:
        words = f"{name}: {choice.convention}, as stated, does not explain the pictures"
        yield Finding("motion", f"{words} (it leaves {left}, no motion {still}): taken as stated", left_out=False)
    elif choice.convention != layers.motion_convention:
        contradicts = any(
            getattr(choice.convention, part) != getattr(layers.motion_convention, part) for part in layers.settled
        )
        as_stated = next((t.unexplained for t in choice.trials if t.convention == layers.motion_convention), None)
        stated = "" if as_stated is None else f"{layers.motion_convention} {as_stated:.1%}, "
        words = f"{name}: taken as {choice.convention}, which leaves {left} unexplained ({stated}no motion {still})"
        yield Finding("motion", words, warning=contradicts, left_out=False)
    elif choice.open:
        words = f"{name}: the pictures do not tell {', '.join(choice.open)}: taken as {choice.convention}"
        yield Finding("motion", words, warning=False, left_out=False)


def find_nonfinite(picture: Array) -> str | None:
    """Say how many pixels of a picture (H, W) or (H, W, C) are not finite; None where all are."""
    if np.isfinite(picture.sum(dtype=np.float64)):
        return None
    lost = np.count_nonzero(~np.isfinite(picture.reshape(*picture.shape[:2], -1)).all(axis=-1))
    return f"{lost} of {picture.shape[0] * picture.shape[1]} pixels are not finite" if lost else None


def find_lost_light(
    picture: Array, noisy: Array, valid: NDArray[np.bool_], around: Callable[[], float] = lambda: 0.0
) -> str | None:
    """Say by how much a denoised picture differs in brightness from the noisy one; None where it does not.

    Parameters
    ----------
    picture, noisy : (H, W, 3) array
        Radiance, finite.
    valid : (H, W) bool array
        Where the noisy picture has been rendered.
    around : callable
        Gives the mean of the brightest picture whose light may have been mixed in; asked only in doubt.

    Returns
    -------
    str or None
        The channel's share of the light, in words.

    Notes
    -----
    With means a of the picture and b of the noisy one, a channel is at fault where |a − b| exceeds `ERRORS` standard
    errors of b and `LEAK` of what is around, and a > `LIGHT`·b or b > `LIGHT`·a.
    """
    if (count := np.count_nonzero(valid)) == 0:
        return None
    mask = valid.astype(np.uint8)
    a, b = (np.array(cv2.mean(image, mask)[:3]) for image in (picture, noisy))  # summed in float64
    if ((a <= LIGHT * b) & (b <= LIGHT * a)).all():
        return None
    error = cv2.meanStdDev(noisy, mask=mask)[1].ravel() / np.sqrt(count)
    leak = LEAK * around()
    far = np.abs(a - b) > np.maximum(ERRORS * error, leak)
    faulty = far & ((a > LIGHT * b) | (b > LIGHT * a)) & ((b > 0) | (leak > 0))
    for index in np.flatnonzero(faulty):
        share = f"{a[index] / b[index]:.2g} times the light" if b[index] > 0 else "light where none was rendered"
        return f"it has {share} in channel {'RGB'[index]}, expected at most {LIGHT:g} times more or less"
    return None
