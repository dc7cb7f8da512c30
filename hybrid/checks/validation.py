"""Which layers of a shot are used: each is checked on a few pairs of frames before anything runs.

Files are sometimes wrong about their content: a pass that was enabled and never filled, vectors of another convention,
guides of another frame. A layer that fails its check is left out, with one line that says so.
"""

from collections.abc import Callable, Collection, Iterator, Sequence
from contextlib import suppress
from dataclasses import dataclass, replace
from functools import partial
from typing import NamedTuple

import cv2
import numpy as np
from numpy.typing import NDArray

from flow.convention import SCALES, Choice, Trial, choose_convention
from flow.guide import median_luminance, tone_map
from flow.patches import FramePair, Patches
from hybrid.alignment.noise import correlation
from hybrid.alignment.prepare import SHORT_SIDE
from hybrid.checks.grade import Grade, find_grade
from hybrid.checks.pass_sums import classify_passes, sample_rows
from hybrid.files.frame import Array, Frame
from hybrid.files.layers import Layers
from hybrid.files.passes import NO_PASSES, Passes
from hybrid.files.profile import ROLE_FACTS, ROLES
from hybrid.files.reader import Interpretation
from hybrid.files.shots import Shot
from hybrid.runtime.kept import Keeper
from nlm.variance import second_differences

Mask = NDArray[np.bool_]

# Pairs that are read, spread over all files of the shot and not over the frames that were asked for: the result must
# not depend on the chunk that a frame comes in.
PAIRS = 2
LARGE = 2**24  # pixels above which the frames of these pairs lie in temporary files: four of 7680×4320 take 7 GiB
# Rows for the comparison of edges; larger frames are reduced to about so many.
EDGE_ROWS = 2 * SHORT_SIDE
# A layer whose values lie within this of each other, relative to the largest, is constant: half floats round by 5e-4.
SAME = 1e-3
# Share of pixels beyond its range that a layer may have, as filters with negative lobes overshoot at edges, or that an
# estimate may have lost.
STRAY = 0.01
# The mean of a denoised picture may differ from that of the noisy one by this factor.
LIGHT = 2.5


@dataclass(frozen=True)
class Finding:
    """One line about the layer of a role ("aov" for AOVs); no `warning` if the layer is as good as expected."""

    role: str
    message: str
    warning: bool = True
    left_out: bool = True


@dataclass(frozen=True)
class ValidationReport:
    """Findings about a shot's layers."""

    findings: tuple[Finding, ...] = ()  # in the order of the roles
    # the motion conventions that were tried; None without vectors, or without a pair of frames
    motion: Choice | None = None
    variance_scale: float | None = None  # measured factor of the variance
    passes: Passes = NO_PASSES  # how the AOVs add up to the beauty
    # measured factors of the denoised picture, if its level is not that of the samples
    estimate_factors: tuple[float, float, float] | None = None

    @property
    def warnings(self) -> tuple[str, ...]:
        return tuple(finding.message for finding in self.findings if finding.warning)

    def readings(self) -> list[tuple[str, str, str]]:
        """Rows of the six best motion conventions, and the chosen one: "taken" or "", convention, unexplained share."""
        if self.motion is None:
            return []
        chosen = self.motion.convention
        listed: list[Trial] = []
        for trial in self.motion.trials:
            plain = replace(trial.convention, scale=1.0)
            fitted = trial.convention.scale not in SCALES and any(
                plain == replace(other.convention, scale=1.0) for other in listed
            )
            if trial.convention == chosen or (not fitted and len(listed) < 6):
                listed.append(trial)
        rows = [(trial.convention == chosen, str(trial.convention), trial.unexplained) for trial in listed]
        rows.append((False, "no motion", self.motion.still))
        if self.motion.found is not None:
            rows.append((self.motion.convention is None, "optical flow of the pictures", self.motion.found))
        return [("taken" if taken else "", said, f"{share:.2%}") for taken, said, share in rows]

    def apply(self, shot: Shot) -> Shot:
        """Return the shot without the layers that are left out, with motion and variance as measured."""
        left_out = frozenset(finding.role for finding in self.findings if finding.left_out)
        convention = None if self.motion is None else self.motion.convention
        interpretation = Interpretation(left_out, convention, self.variance_scale, self.passes, self.estimate_factors)
        return shot.reinterpreted(interpretation)


def validate_layers(shot: Shot) -> ValidationReport:
    """Check every layer of a shot on pairs of neighbouring frames.

    One pair of all files is read, and up to `PAIRS` if that leaves a question; of a shot without neighbours one frame.
    The report depends on the files and on the options of `open_shot`, not on the frames asked for. A file that cannot
    be read is an error when it is denoised; until then the other pairs are used.
    """
    pairs = _pair_numbers(shot)
    try:
        return _validate_pairs(shot, pairs)
    except (ValueError, OSError):
        readable = [pair for pair in pairs if all(_can_read(shot, number) for number in pair)]
        if readable == pairs:
            raise
        return _validate_pairs(shot, readable) if readable else ValidationReport()


def find_cut(a: int, b: int) -> Finding:
    """Report that two neighbouring frames are a cut (`hybrid.alignment.measure.PairFacts`)."""
    message = f"cut between frames {a} and {b}: nothing is averaged across it; where there is no cut, check the vectors"
    return Finding("color", message, left_out=False)


def find_repeat(a: int, b: int) -> Finding:
    """Report that frame `b` repeats frame `a` (`PairFacts.repeated`)."""
    message = f"frame {b} repeats frame {a}: the same noise, whose samples count once; if not intended, render it again"
    return Finding("color", message, left_out=False)


def find_other_frame(shot: Shot, finished: Callable[[int], Array | None]) -> str | None:
    """Report if denoised pictures (H, W, 3) show the next or previous frame; reads pairs as `validate_layers`."""
    edges = []
    for pair in _pair_numbers(shot):
        with suppress(ValueError, OSError):  # a file that cannot be read is an error when it is denoised
            pictures = [picture for number in pair if (picture := finished(number)) is not None]
            colors = [shot.reader.read_color(number) for number in pair]
            if [picture.shape for picture in pictures] == [color.shape for color in colors]:
                edges.append(_match_edges(_edges_of(pictures), _edges_of(colors)))
    return _other_frame(edges) if edges else None


def find_sequence_grade(shot: Shot, finished: Callable[[int], Array | None]) -> Grade | None:
    """Compare the level of denoised pictures (H, W, 3) with that of a shot's samples; None if they agree."""
    numbers = sorted({number for pair in _pair_numbers(shot) for number in pair}) or [shot.available[0]]
    pictures = []
    for number in numbers:
        with suppress(ValueError, OSError):  # a file that cannot be read is an error when it is denoised
            picture, color = finished(number), shot.reader.read_color(number)
            if picture is not None and picture.shape == color.shape:
                pictures.append((picture, color))
    return find_grade(pictures) if pictures else None


def _can_read(shot: Shot, number: int) -> bool:
    try:
        shot.read(number)
    except (ValueError, OSError):
        return False
    return True


def _validate_pairs(shot: Shot, pairs: Sequence[tuple[int, int]]) -> ValidationReport:
    layers = shot.layers(shot.available[0])
    checks = _Checks(layers)
    if not pairs:
        checks.add(shot.read(shot.available[0]))
        return checks.with_passes(checks.report([], lambda roles: []))
    light: list[Patches] = []
    surfaces: list[Patches] = []

    # Pairs of frames this large lie in files, as all are compared until no question is left. Each check reads other
    # layers: those of the one before are released.
    height, width = shot.shape
    keeper = Keeper(in_files=height * width > LARGE)

    def add_surfaces(earlier: Frame, later: Frame, roles: Collection[str]) -> list[Patches]:
        for role in roles:
            first, second = getattr(earlier, role), getattr(later, role)
            both = first is not None and second is not None
            if both and (pair := _pair_of(earlier, later, first, second, shot.step)) is not None:
                surfaces.append(Patches(replace(pair, lift=float(role == "normal"))))
                keeper.release()
        return surfaces

    for a, b in pairs:
        earlier, later = keeper.keep(shot.read(a)), keeper.keep(shot.read(b))
        checks.add(earlier, later, done=keeper.release)
        if (pair := _pair_of(earlier, later, earlier.color, later.color, shot.step)) is not None:
            light.append(Patches(pair))
        keeper.release()
        report = checks.report(light, partial(add_surfaces, earlier, later))
        if not report.warnings and (report.motion is None or report.motion.certain):
            break  # no question is left
    return checks.with_passes(report)


def _pair_of(earlier: Frame, later: Frame, first: Array, second: Array, step: int) -> FramePair | None:
    """Pictures of two frames with their vectors; None if a frame has no vectors."""
    if earlier.motion is None or later.motion is None:
        return None
    resolution = earlier.resolution or earlier.motion.shape[:2]
    return FramePair(first, second, earlier.motion, later.motion, resolution, step)


def _pair_numbers(shot: Shot) -> list[tuple[int, int]]:
    """Neighbours, spread over all files of the shot."""
    pairs = [(a, a + shot.step) for a in shot.available if shot.has(a + shot.step)]
    count = min(PAIRS, len(pairs))
    return [pairs[(2 * i + 1) * len(pairs) // (2 * count)] for i in range(count)]


class _EdgeMatch(NamedTuple):
    """Correlations of edges: with the own frame, of the later frame's with the earlier, and the reverse."""

    centre: float
    late: float
    early: float


class _Checks:
    """Results of the checks of all layers but motion, so that frames need not be held."""

    def __init__(self, layers: Layers) -> None:
        self.layers = layers
        # Role → a message for each frame, or None if the layer passes its check.
        self.wrong: dict[str, list[str | None]] = {}
        self.edges: dict[str, list[_EdgeMatch]] = {}
        self.variances: list[Array] = []
        self.passes: list[Frame] = []
        self.pictures: list[tuple[Array, Array]] = []
        self.log_blacks: list[float | None] = []

    def add(self, *frames: Frame, done: Callable[[], object] = lambda: None) -> None:
        """Check one frame, or two neighbours; `done` is called when a layer has been read."""
        for frame in frames:
            thin = _thin(frame)
            self.log_blacks.append(_find_log_black(thin.color))
            if frame.aovs:
                self.passes.append(sample_rows(frame))
            for role, check in _CHECKS.items():
                if (layer := getattr(thin, role)) is not None:
                    self.wrong.setdefault(role, []).append(check(layer, thin.color))
            if frame.estimate is not None:
                self.pictures.append((frame.estimate, frame.color))
            if frame.variance is not None:
                self.variances.append(_variance_ratios(frame.variance, frame.color))
            done()
        if len(frames) == 2:
            shown = _edges_of([frame.color for frame in frames])
            done()
            for role in ("albedo", "normal"):
                guides = [getattr(frame, role) for frame in frames]
                if all(guide is not None for guide in guides):
                    slopes = [_slope(_shrink(guide)) for guide in guides]
                    self.edges.setdefault(role, []).append(_match_edges(slopes, shown))
                    done()

    def report(
        self, light: Sequence[Patches], surfaces: Callable[[Collection[str]], Sequence[Patches]]
    ) -> ValidationReport:
        """Return the findings so far, and choose the motion convention from patches of light, or of surfaces."""
        variance_scale, variance_findings = self._scale_variance()
        factors, grade_findings = self._grade_estimate()
        findings = [*variance_findings, *grade_findings]
        blacks = [black for black in self.log_blacks if black is not None]
        if blacks and len(blacks) == len(self.log_blacks):
            fault = f"looks encoded by a log curve (black is {blacks[0]:.3f}, nothing is above 1.5): averages"
            fault += " of it are too dark; write scene-linear color, or convert it (oiiotool --colorconvert)"
            findings.append(Finding("color", f"{self._name('color')} {fault}", left_out=False))
        for role, messages in self.wrong.items():
            if all(messages):
                findings.append(self._leave_out(role, str(messages[0])))
            elif role in self.edges and (other := _other_frame(self.edges[role])):
                findings.append(self._leave_out(role, f"belongs to {other}"))
        layers, choice = self.layers, None
        if layers.motion_convention is not None and light:
            sound = [role for role in ("albedo", "normal") if role not in {finding.role for finding in findings}]
            choice = choose_convention(
                light, layers.motion_convention, layers.settled, lambda: surfaces(sound), layers.typed
            )
            findings += _motion_findings(layers, choice)
        findings.sort(key=lambda finding: ROLES.index(finding.role))
        return ValidationReport(tuple(findings), choice, variance_scale, estimate_factors=factors)

    def with_passes(self, report: ValidationReport) -> ValidationReport:
        """Add how the AOVs add up to the beauty, with one line for each."""
        if not self.passes:
            return report
        passes, reasons = classify_passes(self.passes)
        lines = (
            Finding("aov", f"aov {name}: {reason}", warning=False, left_out=False) for name, reason in reasons.items()
        )
        return replace(report, findings=(*report.findings, *lines), passes=passes)

    def _scale_variance(self) -> tuple[float | None, list[Finding]]:
        """Estimate the variance scale if the profile does not state it."""
        if not self.variances or all(self.wrong["variance"]):
            return None, []
        ratio = float(np.quantile(np.concatenate(self.variances), 0.75))
        said = f"is {ratio:.3g} times that of the picture"
        # The third quartile of the ratio was 1.3 to 1.7 with right variances.
        if 1 / 4 <= ratio <= 4:
            return None, []
        samples, stated = self.layers.samples, self.layers.variance_scale is not None
        if self.layers.variance_of == "sample" and not stated and ratio > 1:
            message = f"{self._name('variance')} {said}, as the variance of samples is: divided by that"
            return 1 / ratio, [Finding("variance", message, warning=False, left_out=False)]
        if self.layers.variance_of is None and samples and 1 / 4 <= ratio / samples <= 4:
            message = f"{self._name('variance')} {said}: read as the variance of {samples:g} samples"
            return 1 / samples, [Finding("variance", message, left_out=False)]
        return None, [self._leave_out("variance", said)]

    def _grade_estimate(self) -> tuple[tuple[float, float, float] | None, list[Finding]]:
        """Measure the factors that bring the denoised picture to the level of the samples."""
        if not self.pictures or all(self.wrong["estimate"]) or (grade := find_grade(self.pictures)) is None:
            return None, []
        if grade.factors is None:
            return None, [self._leave_out("estimate", grade.message)]
        message = f"{self._name('estimate')} {grade.message}: brought to that"
        return grade.factors, [Finding("estimate", message, left_out=False)]

    def _leave_out(self, role: str, fault: str) -> Finding:
        loss = ROLE_FACTS[role]["left_out"]
        return Finding(role, f"{self._name(role)} {fault}: left out, {loss}; check the pass, or --layer {role}=NAME")

    def _name(self, role: str) -> str:
        return f"{role} ({getattr(self.layers, role) or 'of two halves'})"


def _motion_findings(layers: Layers, choice: Choice) -> Iterator[Finding]:
    """Report the chosen motion convention if it is not the stated one, or is uncertain."""
    name = f"motion ({layers.motion})"
    left, still = f"{choice.unexplained:.1%}", f"{choice.still:.1%}"
    if choice.convention is None:
        flow = "" if choice.found is None else f", optical flow {choice.found:.1%}"
        message = f"{name}: no convention explains the pictures (the best leaves {left}, no motion {still}{flow})"
        yield Finding(
            "motion",
            f"{message}: left out, replaced by optical flow, slower and less exact; check the pass, or --motion WORDS",
        )
    elif choice.contradicted:
        message = f"{name}: {choice.convention}, as stated, does not explain the pictures"
        yield Finding("motion", f"{message} (it leaves {left}, no motion {still}): used as stated", left_out=False)
    elif choice.convention != layers.motion_convention:
        contradicts = any(
            getattr(choice.convention, part) != getattr(layers.motion_convention, part) for part in layers.settled
        )
        as_stated = next((t.unexplained for t in choice.trials if t.convention == layers.motion_convention), None)
        stated = "" if as_stated is None else f"{layers.motion_convention} {as_stated:.1%}, "
        message = f"{name}: read as {choice.convention}, which leaves {left} unexplained ({stated}no motion {still})"
        yield Finding("motion", message, warning=contradicts, left_out=False)
    elif choice.open:
        message = f"{name}: the pictures do not determine {', '.join(choice.open)}: read as {choice.convention}"
        yield Finding("motion", message, warning=False, left_out=False)


def _thin(frame: Frame) -> Frame:
    """Every n-th row and column of a frame: shares and bounds need no more than `SHORT_SIDE` rows."""
    step = max(1, min(frame.color.shape[:2]) // SHORT_SIDE)
    roles = ("color", *_CHECKS)
    layers = {role: layer[::step, ::step] for role in roles if (layer := getattr(frame, role)) is not None}
    return Frame(frame.number, **layers)


def _find_log_black(color: Array) -> float | None:
    """The value of black in a color that seems to be encoded by a log curve; None in others."""
    least, greatest = float(color.min()), float(color.max())
    # Log curves of cameras and ACEScct encode black as 0.07 to 0.125, and all light below 1.5. Blender's gray world,
    # 0.051, is not in the range.
    if not 0.06 <= least <= 0.13 < greatest <= 1.5:
        return None
    black = (color <= least * (1 + SAME)).all(axis=-1)
    return least if black.mean() >= 1e-3 else None  # pixels without light share the least value


def _shrink(layer: Array) -> Array:
    """A layer (H, W, C) reduced by a whole factor to about `EDGE_ROWS` rows; non-finite values count as 0."""
    factor = max(1, min(layer.shape[:2]) // EDGE_ROWS)
    width, height = layer.shape[1] // factor, layer.shape[0] // factor
    small = np.empty((height, width, layer.shape[2]), np.float32)
    for top in range(0, height, SHORT_SIDE):  # in strips: frames are large
        rows = layer[top * factor : min(top + SHORT_SIDE, height) * factor, : width * factor]
        clean = np.where(np.isfinite(rows), rows, np.float32(0))
        size = width, len(rows) // factor
        reduced = clean if factor == 1 else cv2.resize(clean, size, interpolation=cv2.INTER_AREA)
        small[top : top + SHORT_SIDE] = reduced.reshape(-1, width, layer.shape[2])
    return small


def _edges_of(colors: Sequence[Array]) -> list[Array]:
    """The edges of pictures, tone-mapped by the exposure of the first."""
    small = [_shrink(color) for color in colors]
    exposure = median_luminance(small[0])
    # Averages of neighbours reduce the noise in the correlation.
    tones = [cv2.blur(tone_map(color, exposure), (3, 3)) for color in small]
    return [_slope(np.asarray(tone, np.float32)) for tone in tones]


def _match_edges(edges: Sequence[Array], shown: Sequence[Array]) -> _EdgeMatch:
    """Correlate edges of a layer with those of two frames; the better one is its own, as dim frames match anything."""
    centre = max(correlation(edges[0], shown[0]), correlation(edges[1], shown[1]))
    return _EdgeMatch(centre, correlation(edges[1], shown[0]), correlation(edges[0], shown[1]))


def _other_frame(edges: Sequence[_EdgeMatch]) -> str | None:
    """Name the frame, other than their own, whose edges pairs have; None if there is none."""
    centre, late, early = np.mean(edges, axis=0)
    # On the bundled shot an albedo has 0.61 with its own frame and 0.17 to 0.29 with the next, a normal 0.49 and 0.35.
    # Below 0.3 nothing matches: at few samples albedos of rooms have 0.00 to 0.07 with their own frame, and by chance
    # up to 0.20 with the next.
    if max(late, early) <= max(centre + 0.05, 0.3):
        return None
    figures = f"their edges correlate {max(late, early):.2f}, with its own frame's {centre:.2f}"
    return f"the {'previous' if late > early else 'next'} frame ({figures})"


def _check_guide(layer: Array) -> str | None:
    # Plane by plane, which is faster than over so short an axis.
    planes = [layer[..., c] for c in range(layer.shape[2])]
    finite = [plane[np.isfinite(plane)] for plane in planes]
    if not all(plane.size for plane in finite):
        return "has no finite value"
    ranges = [(float(plane.min()), float(plane.max())) for plane in finite]
    largest = max(max(-low, high) for low, high in ranges)
    if all(high - low <= SAME * largest for low, high in ranges):
        return "is constant" if largest > 0 else "is black"
    return None


def _check_albedo(layer: Array, _: Array) -> str | None:
    if (fault := _check_guide(layer)) is not None:
        return fault
    if (below := float(np.mean(layer.min(axis=-1) < -SAME))) > STRAY:
        return f"is negative in {below:.1%} of the picture"
    # Emitters and skies are written as brighter albedos by some, but not as half of a picture.
    if (above := float(np.mean(layer.max(axis=-1) > 2))) > 0.5:
        return f"is above 2 in {above:.1%} of the picture"
    return None


def _check_normal(layer: Array, _: Array) -> str | None:
    if (fault := _check_guide(layer)) is not None:
        return fault
    # Averages over a pixel are shorter than 1, rounding makes them longer by less than a tenth.
    long = float(np.mean(np.einsum("yxc,yxc->yx", layer, layer) > 1.1**2))
    return f"is longer than 1 in {long:.1%} of the picture" if long > STRAY else None


def _check_alpha(layer: Array, color: Array) -> str | None:
    if layer.min() == layer.max():
        return None  # opaque everywhere, or empty
    if any(_equal_share(layer, color[..., c], np.asarray(layer == color[..., c], bool)) > 0.99 for c in range(3)):
        return "is the color"
    outside = float(np.mean((layer < -STRAY) | (layer > 1 + STRAY)))
    return f"is not between 0 and 1 in {outside:.1%} of the picture" if outside > STRAY else None


def _check_variance(layer: Array, _: Array) -> str | None:
    if not np.nan_to_num(layer).any():
        return "is 0 everywhere"
    below = float(np.mean(layer.min(axis=-1) < 0))
    return f"is negative in {below:.1%} of the picture" if below > STRAY else None


def _check_estimate(layer: Array, color: Array) -> str | None:
    # Half floats are rounded by 5e-4 of their value.
    same = np.asarray(np.isclose(layer, color, rtol=SAME, atol=0).all(axis=-1), bool)
    return "is the noisy picture" if _equal_share(layer, color, same) > 0.99 else None


def _equal_share(a: Array, b: Array, same: Mask) -> float:
    """Share of equal pixels among the pixels where either layer is not 0; 0 without any."""
    lit = (a != 0) | (b != 0)
    lit = lit.any(axis=-1) if lit.ndim == 3 else lit
    return float(np.mean(same[lit])) if lit.any() else 0.0


# Role → check of its layer and the color; returns the fault, or None.
_CHECKS: dict[str, Callable[[Array, Array], str | None]] = {
    "albedo": _check_albedo,
    "normal": _check_normal,
    "depth": lambda layer, _: _check_guide(layer[..., None]),
    "variance": _check_variance,
    "alpha": _check_alpha,
    "estimate": _check_estimate,
}


def _slope(layer: Array) -> Array:
    """Length of the gradient of (H, W) or (H, W, C), over all channels."""
    square = np.square(cv2.Sobel(layer, -1, 1, 0)) + np.square(cv2.Sobel(layer, -1, 0, 1))
    return np.asarray(np.sqrt(square if layer.ndim == 2 else np.einsum("yxc->yx", square)), np.float32)


def _variance_ratios(variance: Array, color: Array) -> Array:
    """Ratio of the variance to that of the picture, for patches of 9×9 pixels, of green alone.

    Second differences over 6 have the noise's variance; texture makes it larger: flat patches are the most reliable.
    """
    green = np.nan_to_num(color[..., 1], posinf=0.0, neginf=0.0)
    measured = cv2.blur((second_differences(green) / 6) ** 2, (9, 9))[4::9, 4::9]
    given = cv2.blur(np.maximum(np.nan_to_num(variance[..., 1]), 0), (9, 9))[4::9, 4::9]
    lit = measured > 0
    return np.asarray(given[lit] / measured[lit], np.float32).ravel()


def find_nonfinite(picture: Array) -> str | None:
    """Report how many pixels of a picture (H, W) or (H, W, C) are not finite; None if all are."""
    if np.isfinite(picture.sum(dtype=np.float64)):
        return None
    lost = np.count_nonzero(~np.isfinite(picture.reshape(*picture.shape[:2], -1)).all(axis=-1))
    return f"{lost} of {picture.shape[0] * picture.shape[1]} pixels are not finite" if lost else None


def find_lost_light(picture: Array, noisy: Array, valid: Mask, around: Callable[[], float] = lambda: 0.0) -> str | None:
    """Report the channel in which a denoised picture has another brightness than the noisy one; None if none.

    `around` returns the mean of the brightest picture whose light may have leaked in; it is called only in doubt. With
    means a of the picture and b of the noisy one, where `valid`, a channel is at fault where |a − b| exceeds ten
    standard errors of b and a twentieth of `around`, and a > `LIGHT`·b or b > `LIGHT`·a.
    """
    if (count := np.count_nonzero(valid)) == 0:
        return None
    mask = valid.astype(np.uint8)
    a, b = (np.array(cv2.mean(image, mask)[:3]) for image in (picture, noisy))  # summed in float64
    if ((a <= LIGHT * b) & (b <= LIGHT * a)).all():
        return None
    # The light of single bright samples is uncertain. Errors are of independent pixels, where a renderer's filter and
    # denoisers make neighbours alike.
    error = cv2.meanStdDev(noisy, mask=mask)[1].ravel() / np.sqrt(count)
    leak = 0.05 * around()
    far = np.abs(a - b) > np.maximum(10 * error, leak)
    faulty = far & ((a > LIGHT * b) | (b > LIGHT * a)) & ((b > 0) | (leak > 0))
    for index in np.flatnonzero(faulty):
        share = f"{a[index] / b[index]:.2g} times the light" if b[index] > 0 else "light where none was rendered"
        return f"it has {share} in channel {'RGB'[index]}, expected at most {LIGHT:g} times more or less"
    return None
