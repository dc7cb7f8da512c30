"""Which convention motion vectors follow, measured: readings of them are tried on pairs of frames."""

from __future__ import annotations

from collections.abc import Callable, Collection, Iterator, Sequence
from dataclasses import dataclass, fields, replace
from functools import cached_property
from itertools import product

import cv2
import numpy as np
from numba import njit

from flow.guide import estimate_noise, median_luminance, pair_guides, smooth_tones, tone_map
from flow.motion import ABSURD_LENGTH, UNITS, VERTICAL, MotionConvention, decode_motion
from flow.tvl1 import dense_flow
from flow.warp import locate

# Patches of 9 x 9 pixels: the noise of their means is a ninth of a pixel's.
RADIUS = 4
# Enough for 0.2 % of the picture to be eight of them, few enough for a reading to take milliseconds.
MOST_PATCHES = 4096
# Readings are screened on this many of one pair: half are those that change most, half lie anywhere.
SCREENED = 192
# So many of those that leave least are tried on all patches of all pairs.
FINALISTS = 4
# A difference of means that is taken for noise: the scale of `nlm.gate.color_gate`, a third of a pixel's noise and
# one step of 8 bits. Noise alone brings twice that once in a thousand patches.
NOISE_SHARE, NOISE_FLOOR = 0.3, 0.004
# A reading that moves a greater share of what changes out of the picture than it keeps there explains nothing.
INSIDE = 0.5
# Of fewer patches the spread of their differences is unknown: nothing is clearly better by them.
FEWEST = 8
# Standard errors, of the differences patch by patch, by which one reading is clearly better than another.
CLEARLY = 3.0
# What noise alone gives is known to about 1 % of the picture: a reading that leaves less than this is good.
LEAST = 0.02
# Readings that leave this share of what changes need no comparison with any others. Half as long as they should be,
# vectors left 0.4 of it on the bundled shot, right ones less than 0.02.
GOOD = 0.25
# Where nothing is known of the scale, other lengths are tried unless a plain one leaves less than this share.
EXACT = 0.05
# What overrules what was stated leaves less than this share of what that leaves; or, where no motion explains much
# of the change (reflections, what was hidden), that explains less than this share of what it does.
OVERRULES = 0.5
# Vectors explain at least this share of what a flow found in the pictures does, where that explains as much.
WORTH = 0.5
# Neighbours that differ in more of the picture than this may be two shots.
CUT = 0.5
# The flow is found in pictures of at most so many pixels.
FOUND_PIXELS = 2**17
# Vectors may span half a frame (a shutter of 180 degrees) or two, and point either way.
SCALES = (1.0, -1.0, 2.0, -2.0, 0.5, -0.5)
# Readings whose vectors (their ninth decile) are shorter, pixels, or longer, picture widths, are not tried.
SHORTEST, LONGEST = 0.02, 1.0
# Lengths, pixels, tried for the ninth decile of the vectors where nothing better explains the pictures.
LENGTHS = 0.5 * 2 ** np.arange(0, 8.5, 0.5)

PARTS = tuple(field.name for field in fields(MotionConvention))


@dataclass(frozen=True, eq=False)
class FramePair:
    """Two neighbouring frames, with the vectors of each as the renderer wrote them.

    Attributes
    ----------
    earlier, later : (H, W, 3) array
        Linear radiance, as noisy as it is. NaN counts as 0, Inf as white.
    earlier_vectors, later_vectors : (H, W, C) array
        Their motion vectors.
    resolution : (int, int)
        Height and width, pixels, of the whole picture.
    frames : int
        How many frames lie from one to the other; vectors span one.
    """

    earlier: np.ndarray
    later: np.ndarray
    earlier_vectors: np.ndarray
    later_vectors: np.ndarray
    resolution: tuple[int, int]
    frames: int = 1


@dataclass(frozen=True)
class Trial:
    """One reading, and the share of the picture that it leaves unexplained."""

    convention: MotionConvention
    unexplained: float


@dataclass(frozen=True)
class Choice:
    """What vectors were found to mean.

    Attributes
    ----------
    convention : MotionConvention or None
        The reading to take; None: none explains the pictures.
    unexplained : float
        Share of the picture, in [0, 1], that it leaves unexplained; without a reading, that the best leaves.
    still : float
        The same without any motion.
    found : float or None
        The same with a flow found in the pictures, where that was needed to decide.
    open : tuple of str
        Parts that nobody has stated and these pictures do not settle: they are as was assumed.
    trials : tuple of Trial
        What was tried on all patches, best first.
    unrelated : tuple of int
        Indices of pairs that show something else in each frame, as at a cut. They are not asked, unless all are such.
    by_surfaces : bool
        Whether surfaces have decided, and not light; all shares are then those of what surfaces show.
    contradicted : bool
        Whether the pictures contradict the reading, which is taken because the user has stated it.
    """

    convention: MotionConvention | None
    unexplained: float
    still: float
    found: float | None
    open: tuple[str, ...]
    trials: tuple[Trial, ...]
    unrelated: tuple[int, ...] = ()
    by_surfaces: bool = False
    contradicted: bool = False

    @property
    def certain(self) -> bool:
        """Whether something changes, the reading leaves next to nothing of it, and no other leaves as little."""
        return not self.open and self.still > LEAST and self.unexplained <= max(GOOD * self.still, LEAST)


def choose_convention(
    pairs: Sequence[Patches],
    assumed: MotionConvention,
    settled: Collection[str] = PARTS,
    surfaces: Callable[[], Sequence[Patches]] = tuple,
    typed: Collection[str] = (),
) -> Choice:
    """Find the reading of motion vectors that explains the pictures.

    Parameters
    ----------
    pairs : sequence of Patches
        At least one, of frames of one size. What was tried on them is kept, and not tried again.
    assumed : MotionConvention
        What is taken where the pictures cannot tell.
    settled : collection of str
        The parts of it that are known. They are tried otherwise only if they explain little.
    surfaces : callable
        Gives such pairs of what does not depend on light, an albedo say. Asked only where light leaves a doubt.
    typed : collection of str
        The parts that the user has stated. Nothing overrules them.

    Returns
    -------
    Choice
        `convention` is None if no part is typed, surfaces do not confirm the vectors, and these are clearly worse than
        no motion or explain less than half of what a flow found in the pictures explains.

    Raises
    ------
    ValueError
        No pairs, or vectors with fewer channels than `assumed` has.

    Notes
    -----
    Both frames' luminance, L / (L + exposure), is compared on patches of 9 x 9 pixels. m is the mean over a patch of
    neighbour(x + v) − centre(x), q = 0.3 s + 0.004, s the noise of a pixel. A patch is unexplained by min(1, (m/2q)²)
    less what noise alone gives. Of what a reading moves out of what is seen as large a share is unexplained as of the
    rest; all is, if that is more than half of what changes. One reading is clearly better than another if the mean
    difference, over the patches that both keep, is three times its standard error. The picture is the smallest
    rectangle that holds all that is seen in either frame. Patches that are mostly black in both frames, or have vectors
    of 0 in both, count for nothing.

    Where shadows move, light is explained by no vectors, and best by a flow that follows them. Surfaces confirm a
    reading that leaves less than a quarter of what one pixel more or less would, or that is clearly better than no
    motion and explains three quarters of what a flow found in the surfaces does.
    """
    if not pairs:
        raise ValueError("pairs is empty, expected at least one")
    unrelated = tuple(index for index, pair in enumerate(pairs) if pair.unrelated)
    trials, settled, typed = _Trials(_related(pairs)), frozenset(settled), frozenset(typed)
    chosen = trials.best(assumed, settled)
    if (trials.clearly_better(None, chosen) or not trials.good(chosen)) and (shown := surfaces()):
        of_surfaces = _Trials(_related(shown))
        reading = of_surfaces.read(assumed, settled, typed)
        if of_surfaces.confirm(reading):
            return of_surfaces.choice(reading, settled, unrelated=unrelated, by_surfaces=True)
    chosen = trials.read(assumed, settled, typed)
    believed, found = not trials.clearly_better(None, chosen), None
    if believed and not trials.good(chosen) and len(trials.costs(None)) >= FEWEST:
        # A change of light is explained by no motion. Vectors are wrong where a search explains what they do not.
        found = trials.search()
        believed = trials.worth(chosen, WORTH) or found >= (1 - WORTH) * trials.left(None)
    choice = trials.choice(chosen, settled, found=found, unrelated=unrelated)
    if believed:
        return choice
    return replace(choice, contradicted=True) if typed else replace(choice, convention=None, open=())


ONE_PIXEL = np.ones(2, np.float32)
_Flows = tuple[np.ndarray | None, np.ndarray | None]


class Patches:
    """A pair of frames, seen through patches at the same places of both.

    Parameters
    ----------
    pair : FramePair
        Of it no more is kept than its luminance and the patches' vectors.
    """

    def __init__(self, pair: FramePair) -> None:
        self.resolution, self.frames = pair.resolution, pair.frames
        exposure = median_luminance(pair.earlier)
        pictures = [tone_map(color, exposure) for color in (pair.earlier, pair.later)]
        box = _lit_box(np.maximum(*pictures) > 0)
        self.pictures = tuple(np.ascontiguousarray(picture[box]) for picture in pictures)
        layers = pair.earlier_vectors[box], pair.later_vectors[box]
        # Closed: noise leaves single pixels of what is seen black.
        near = np.ones((3, 3), np.uint8)
        masks = (cv2.morphologyEx((picture > 0).astype(np.uint8), cv2.MORPH_CLOSE, near) for picture in self.pictures)
        self.shown = tuple(mask.astype(bool) for mask in masks)
        height, width = self.pictures[0].shape
        self.radius = min(RADIUS, (min(height, width) - 1) // 2)
        size = 2 * self.radius + 1
        spacing = max(size, int(np.ceil(np.sqrt(height * width / MOST_PATCHES))))
        inner = [np.arange(self.radius, side - self.radius, spacing) for side in (height, width)]
        self.rows, self.columns = (grid.ravel() for grid in np.meshgrid(*inner, indexing="ij"))
        lit = np.logical_or(*self.shown)
        known = lit & np.logical_or(*(np.any(layer != 0, axis=-1) for layer in layers))
        lit = known if known.any() else lit
        seen = self._holds(lit, size)
        if seen.any() and not seen.all():
            # As many patches as the seen part of the picture holds, so that an object of 1 % of it has enough of them.
            finer = max(1, int(spacing * np.sqrt(seen.mean())))
            inner = [np.arange(self.radius, side - self.radius, finer) for side in (height, width)]
            self.rows, self.columns = (grid.ravel() for grid in np.meshgrid(*inner, indexing="ij"))
            seen = self._holds(lit, size)
            self.rows, self.columns = self.rows[seen], self.columns[seen]
        noise = [estimate_noise(picture)[self.rows, self.columns] ** 2 for picture in self.pictures]
        deviation = np.sqrt(np.mean(noise, axis=0))
        # The scale is made for patches of 9 x 9; the means of smaller ones are as much noisier as they are smaller.
        self.scale = 2 * (NOISE_SHARE * deviation * ((2 * RADIUS + 1) / size) + NOISE_FLOOR)
        # Two means differ by noise with the variance 2 s² / size².
        self.expected = 2 * np.square(deviation / (size * self.scale))
        self.all = np.arange(len(self.rows))
        # Without motion what is seen in one frame alone has changed: it is compared with black.
        seen_of, self.shown = self.shown, (np.ones_like(self.shown[0]),) * 2
        self.still = self._costs(1, np.zeros((len(self.rows) * size, size, 2), np.float32), self.all, ONE_PIXEL)
        self.shown = seen_of
        self.few = _informative(self.still, SCREENED)
        self.vectors = [self.gather(layer, self.all) for layer in layers]
        self.few_vectors = [self.gather(layer, self.few) for layer in layers]
        self.tried: dict[tuple[MotionConvention, bool], np.ndarray] = {}
        self.decoded: dict[tuple[str, str, float, bool], tuple[_Flows, _Flows]] = {}

    def _holds(self, shown: np.ndarray, size: int) -> np.ndarray:
        """Which patches hold most of what the fullest does of these: the means of fewer pixels have more noise."""
        share = cv2.blur(shown.astype(np.float32), (size, size))[self.rows, self.columns]
        return np.asarray((share > 0) & (2 * share >= share.max()))

    def costs(self, convention: MotionConvention, *, few: bool = False) -> np.ndarray:
        """What a reading leaves of each patch, or of the `few` that tell most, in [0, 1]; NaN outside."""
        if (convention, few) not in self.tried:
            self.tried[convention, few] = self._try(convention, few)
        return self.tried[convention, few]

    def _try(self, convention: MotionConvention, few: bool) -> np.ndarray:
        unit = np.array(convention.factors(self.resolution), np.float32) * np.float32(self.frames)
        earlier, later = self._decoded(convention, few)
        sides = [
            self._costs(centre, flow, self.few if few else self.all, unit)
            for centre, flow in enumerate((earlier[1], later[0]))
            if flow is not None
        ]
        if len(sides) == 1:
            return sides[0]
        return np.where(np.isnan(sides[0]), sides[1], np.where(np.isnan(sides[1]), sides[0], (sides[0] + sides[1]) / 2))

    def _decoded(self, convention: MotionConvention, few: bool) -> tuple[_Flows, _Flows]:
        """Vectors of the earlier and of the later frame; many readings differ in their unit alone."""
        kind = convention.direction, convention.encoding, convention.offset, few
        if kind not in self.decoded:
            earlier, later = self.few_vectors if few else self.vectors
            self.decoded[kind] = decode_motion(earlier, convention), decode_motion(later, convention)
        return self.decoded[kind]

    @cached_property
    def found(self) -> np.ndarray:
        """What a flow that is found in the pictures leaves of each patch."""
        return self._costs(1, self.gather(rough_flow(*self.pictures), self.all), self.all, ONE_PIXEL)

    @cached_property
    def unrelated(self) -> bool:
        """Whether hardly anything of one frame is found in the other."""
        changes = float(np.mean(self.still - self.expected))
        if changes <= CUT:
            return False
        left = _mean(self.found, self.still) - float(np.mean(self.expected))
        return left > (1 - WORTH) * changes

    @cached_property
    def one_off(self) -> float:
        """Share of the picture in which it would show if everything were one pixel off: what structure there is."""
        steps = np.zeros((len(self.rows) * (2 * self.radius + 1), 2 * self.radius + 1, 2), np.float32)
        costs = []
        for axis in (0, 1):
            steps[:] = np.eye(2)[axis]
            costs.append(self._compared(1, 1, steps, self.all, ONE_PIXEL))
        return float(np.nanmean(costs))

    def length(self, convention: MotionConvention) -> float:
        """Ninth decile of the lengths of the vectors, pixels; 0 without any."""
        unit = np.array(convention.factors(self.resolution), np.float32)
        lengths = []
        for flow in (flow for flows in self._decoded(convention, True) for flow in flows if flow is not None):
            with np.errstate(over="ignore", invalid="ignore"):
                length = np.hypot(*np.moveaxis(flow * unit, -1, 0))
            lengths.append(length[length <= ABSURD_LENGTH])
        every = np.concatenate(lengths)
        return float(np.quantile(every, 0.9)) if every.size else 0.0

    def gather(self, layer: np.ndarray, at: np.ndarray) -> np.ndarray:
        """The patches `at` of a layer (H, W, C), one below the other, (P · size, size, C)."""
        reach = np.arange(-self.radius, self.radius + 1)
        rows = self.rows[at, None, None] + reach[:, None]
        columns = self.columns[at, None, None] + reach
        return np.asarray(layer[rows, columns].reshape(-1, len(reach), layer.shape[2]))

    def _costs(self, centre: int, flow: np.ndarray, at: np.ndarray, unit: np.ndarray) -> np.ndarray:
        return self._compared(centre, 1 - centre, flow, at, unit)

    def _compared(self, here: int, there: int, flow: np.ndarray, at: np.ndarray, unit: np.ndarray) -> np.ndarray:
        difference = np.empty(len(at), np.float32)
        pictures = self.pictures[here], self.pictures[there], self.shown[here], self.shown[there]
        _compare(*pictures, flow, unit, self.rows[at], self.columns[at], self.radius, difference)
        return np.asarray(np.minimum(np.square(difference / self.scale[at]), 1))


@njit(nogil=True, cache=True)
def _compare(
    centre: np.ndarray,
    other: np.ndarray,
    centre_shown: np.ndarray,
    other_shown: np.ndarray,
    flow: np.ndarray,
    unit: np.ndarray,
    rows: np.ndarray,
    columns: np.ndarray,
    radius: int,
    difference: np.ndarray,
) -> None:
    """Mean of other(x + v) − centre(x), v = unit · flow, over the seen part of patches; NaN where half of it goes."""
    height, width = other.shape
    size = 2 * radius + 1
    one = np.float32(1)
    for p in range(len(rows)):
        total, count, seen = np.float32(0), 0, 0
        for j in range(size):
            for i in range(size):
                y, x = rows[p] - radius + j, columns[p] - radius + i
                if not centre_shown[y, x]:
                    continue
                seen += 1
                u, v = unit[0] * flow[p * size + j, i, 0], unit[1] * flow[p * size + j, i, 1]
                inside, x0, y0, x1, y1, fx, fy = locate(np.float32(x) + u, np.float32(y) + v, width, height)
                if inside and other_shown[y0, x0] and other_shown[y1, x1]:
                    total -= centre[y, x]
                    total += (one - fy) * ((one - fx) * other[y0, x0] + fx * other[y0, x1])
                    total += fy * ((one - fx) * other[y1, x0] + fx * other[y1, x1])
                    count += 1
        difference[p] = total / count if count > 0 and 2 * count >= seen else np.nan


def _related(pairs: Sequence[Patches]) -> Sequence[Patches]:
    """Those that do not show something else in each frame; all, if all do."""
    return [pair for pair in pairs if not pair.unrelated] or pairs


class _Trials:
    """What readings leave of some pairs; each is tried once."""

    def __init__(self, pairs: Sequence[Patches]) -> None:
        self.pairs = pairs
        self.expected = float(np.mean(np.concatenate([pair.expected for pair in self.pairs])))
        # The pair that tells most.
        self.screen = max(self.pairs, key=lambda pair: float(np.mean(pair.still - pair.expected)))
        self.tried: dict[MotionConvention, None] = {}  # in the order they were tried

    def costs(self, reading: MotionConvention | None) -> np.ndarray:
        """What a reading leaves of each patch of all pairs; None: no motion."""
        if reading is None:
            return np.concatenate([pair.still for pair in self.pairs])
        self.tried[reading] = None
        return np.concatenate([pair.costs(reading) for pair in self.pairs])

    def _screened(self, reading: MotionConvention) -> float:
        return _mean(self.screen.costs(reading, few=True), self.screen.still[self.screen.few])

    def mean(self, reading: MotionConvention | None) -> float:
        """Mean of what a reading leaves, noise included."""
        return _mean(self.costs(reading), self.costs(None))

    def left(self, reading: MotionConvention | None) -> float:
        """Share of the picture that a reading leaves unexplained."""
        return max(self.mean(reading) - self.expected, 0.0)

    def good(self, reading: MotionConvention, share: float = GOOD) -> bool:
        """Whether a reading leaves so little of what changes that there is nothing more to ask."""
        return self.left(reading) <= max(share * self.left(None), LEAST)

    def clearly_better(self, a: MotionConvention | None, b: MotionConvention | None) -> bool:
        """Whether a leaves less than b where both stay in the picture, by more than chance."""
        difference, still = self.costs(b) - self.costs(a), self.costs(None)
        inside = ~np.isnan(difference)
        if np.count_nonzero(inside) < FEWEST or not _keeps(inside, still):
            return False
        difference = difference[inside]
        return bool(difference.mean() > CLEARLY * difference.std() / np.sqrt(len(difference)))

    def overrules(self, other: MotionConvention, stated: MotionConvention) -> bool:
        """Whether another reading leaves half of what the stated one does, or that explains half of what this does."""
        clearly = self.clearly_better(other, stated) and self.clearly_better(other, None)
        gain, stated_gain = (self.left(None) - self.left(reading) for reading in (other, stated))
        return clearly and (self.left(other) <= OVERRULES * self.left(stated) or stated_gain <= OVERRULES * gain)

    def confirm(self, reading: MotionConvention) -> bool:
        """Whether surfaces, which light does not change, show that a reading is right."""
        one_off = float(np.mean([pair.one_off for pair in self.pairs]))
        if one_off <= LEAST:
            return False
        if self.left(reading) <= GOOD * one_off:
            return True
        return self.clearly_better(reading, None) and self.worth(reading, 1 - GOOD)

    def worth(self, reading: MotionConvention, share: float) -> bool:
        """Whether a reading explains this share of what a search does."""
        return self.left(None) - self.left(reading) >= share * (self.left(None) - self.search())

    def read(self, assumed: MotionConvention, settled: frozenset[str], typed: frozenset[str]) -> MotionConvention:
        """The best reading that agrees with what is settled, or one that overrules what of it is not typed."""
        chosen = self.best(assumed, settled)
        if settled - typed and (self.clearly_better(None, chosen) or not self.good(chosen)):
            other = self.best(assumed, typed)
            if self.overrules(other, chosen):
                return other
        return chosen

    def best(self, assumed: MotionConvention, settled: frozenset[str]) -> MotionConvention:
        """The reading that leaves least, or one that is preferred to it and not clearly worse."""
        readings = self._readings(assumed, settled)
        if len(readings) > FINALISTS:
            rank = sorted(readings, key=self._screened)
            readings = [reading for reading in readings if reading == assumed or reading in rank[:FINALISTS]]
        least = min(readings, key=self.mean)
        if "scale" not in settled:
            fitted = self._fit_scale(least if self.good(least, EXACT) else self._fit_length(assumed, settled))
            if self.overrules(fitted, least):
                return fitted
        return next(reading for reading in readings if not self.clearly_better(least, reading))

    def _readings(self, assumed: MotionConvention, settled: frozenset[str]) -> list[MotionConvention]:
        """The readings that agree with what is settled and lead to plausible places, the preferred ones first."""
        if settled >= set(PARTS):
            return [assumed]
        resolution = self.screen.resolution
        lengths: dict[tuple[str, str], float] = {}
        readings: dict[object, MotionConvention] = {}
        for reading in _agreeing(assumed, settled, self.screen.few_vectors):
            kind = reading.direction, reading.encoding
            if kind not in lengths:
                lengths[kind] = self.screen.length(replace(reading, unit="pixels", scale=1.0))
            x, y = reading.factors(resolution)
            if reading == assumed or SHORTEST <= lengths[kind] * abs(x) <= LONGEST * resolution[1]:
                # Half NDC twice as long is NDC.
                readings.setdefault((kind, reading.offset, x, y), reading)
        # As many vectors as are assumed; forward rather than backward turned round; then what changes least.
        changes = {r: sum(getattr(r, part) != getattr(assumed, part) for part in PARTS) for r in readings.values()}
        return sorted(readings.values(), key=lambda r: (r.pair != assumed.pair, r.scale < 0, changes[r]))

    def _fit_length(self, assumed: MotionConvention, settled: frozenset[str]) -> MotionConvention:
        """Of vectors of about any length, those that leave least."""
        fits: dict[MotionConvention, float] = {assumed: np.inf}
        for reading in _agreeing(assumed, settled, self.screen.few_vectors):
            # Units differ in their length, which is free here, and in the aspect of the picture.
            alike = reading.unit in {"screen", "half-ndc"} - {assumed.unit} or abs(reading.scale) != 1
            length = 0.0 if alike or reading.pair != assumed.pair else self.screen.length(reading)
            if length > 0:
                tried = [replace(reading, scale=reading.scale * float(scale)) for scale in LENGTHS / length]
                costs = [self._screened(one) for one in tried]
                fits[tried[int(np.argmin(costs))]] = min(costs)
        # A quarter: the step of the lengths is coarse.
        return next(reading for reading, cost in fits.items() if cost <= 1.25 * min(fits.values()))

    def _fit_scale(self, reading: MotionConvention) -> MotionConvention:
        """The reading with the scale nearby that leaves least."""
        best = min(_near(reading, 0.5), key=self._screened)
        if best == reading:
            return reading
        for octaves in (0.125, 0.03):
            best = min(_near(best, octaves), key=self.mean)
        return best

    def search(self) -> float:
        """Share of the picture that flows found in the pictures leave unexplained; 0 to 1."""
        costs = np.concatenate([pair.found for pair in self.pairs])
        return max(_mean(costs, self.costs(None)) - self.expected, 0.0)

    def open_parts(self, chosen: MotionConvention, settled: frozenset[str]) -> tuple[str, ...]:
        """Parts in which readings differ that explain no less than the chosen one; all, if that explains nothing."""
        if not self.clearly_better(chosen, None):
            return tuple(part for part in PARTS if part not in settled)
        # Not those that differ by a fitted scale alone, nor those that tell less.
        others = [r for r in self.tried if r.pair == chosen.pair and not 0.8 < r.scale / chosen.scale < 1 / 0.8]
        others += [r for r in self.tried if r.pair == chosen.pair and r.scale == chosen.scale]
        equals = [r for r in others if not self.clearly_better(chosen, r)]
        differ = {part for r in equals for part in PARTS if getattr(r, part) != getattr(chosen, part)}
        return tuple(part for part in PARTS if part in differ - settled)

    def choice(
        self,
        chosen: MotionConvention,
        settled: frozenset[str],
        *,
        found: float | None = None,
        unrelated: tuple[int, ...],
        by_surfaces: bool = False,
    ) -> Choice:
        """The choice of a reading, with what it and the others leave."""
        return Choice(
            convention=chosen,
            unexplained=self.left(chosen),
            still=self.left(None),
            found=found,
            open=self.open_parts(chosen, settled),
            trials=self.table(),
            unrelated=unrelated,
            by_surfaces=by_surfaces,
        )

    def table(self) -> tuple[Trial, ...]:
        """Every reading that was tried on all patches, best first."""
        order = sorted(self.tried, key=self.mean)
        return tuple(Trial(reading, self.left(reading)) for reading in order)


def _lit_box(lit: np.ndarray) -> tuple[slice, slice]:
    """The smallest rectangle that holds all lit pixels (H, W), of at least 3 pixels on a side; all, if none is lit."""
    box = []
    for axis, side in enumerate(lit.shape):
        at = np.flatnonzero(lit.any(axis=1 - axis))
        if not at.size:
            return slice(None), slice(None)
        first = max(min(int(at[0]), side - 3), 0)
        box.append(slice(first, max(int(at[-1]) + 1, first + 3)))
    return box[0], box[1]


def _keeps(inside: np.ndarray, still: np.ndarray) -> bool:
    """Whether most of what changes without motion is inside."""
    return bool(inside.any()) and float(still[inside].sum()) >= INSIDE * float(still.sum())


def _mean(costs: np.ndarray, still: np.ndarray) -> float:
    """Mean of the costs; those outside, NaN, differ from the cost without motion by the factor of those inside."""
    inside = ~np.isnan(costs)
    if not _keeps(inside, still):
        return float(still.mean())
    change = float(still[inside].sum())
    factor = min(float(costs[inside].sum()) / change, 1.0) if change > 0 else 1.0
    return float(np.where(inside, costs, factor * still).mean())


def _informative(still: np.ndarray, count: int) -> np.ndarray:
    """Indices of patches: half of them those that change most, half spread evenly."""
    if len(still) <= count:
        return np.arange(len(still))
    changing = np.argpartition(still, -(count // 2))[-(count // 2) :]
    spread = np.linspace(0, len(still) - 1, count - count // 2).round().astype(int)
    return np.union1d(changing, spread)


def _near(reading: MotionConvention, octaves: float) -> list[MotionConvention]:
    """The reading, and others up to so many octaves longer and shorter."""
    factors = 2.0 ** np.linspace(-octaves, octaves, 9)
    return [reading, *(replace(reading, scale=reading.scale * float(factor)) for factor in factors)]


def _agreeing(
    assumed: MotionConvention, settled: frozenset[str], vectors: Sequence[np.ndarray]
) -> Iterator[MotionConvention]:
    """All readings that agree with what is settled, the preferred ones first."""
    # The scale varies slowest: vectors of the length they are in their unit go before all others.
    options: dict[str, Sequence[object]] = {
        "scale": SCALES,
        "offset": (0.0,),
        "direction": ("cycles", "both", "previous", "next"),
        "unit": tuple(UNITS),
        "y": tuple(VERTICAL),
        "encoding": () if "encoding" in settled else _encodings(vectors),
        "premultiplied": (),
    }
    for part, others in options.items():
        first = getattr(assumed, part)
        options[part] = [first] if part in settled else [first, *(other for other in others if other != first)]
    for values in product(*options.values()):
        reading = MotionConvention(**dict(zip(options, values, strict=True)))  # type: ignore[arg-type]
        if reading.channels <= vectors[0].shape[2]:
            yield reading


def _encodings(vectors: Sequence[np.ndarray]) -> list[str]:
    """How vectors with such values may be encoded."""
    sample = np.concatenate([layer.reshape(-1, layer.shape[-1])[::16] for layer in vectors])
    sample = sample[np.isfinite(sample).all(axis=1)]
    if not sample.size or not sample[:, :2].any() or sample[:, :2].min() < 0 or sample[:, :2].max() > 1:
        return ["plain"]
    if sample.shape[1] >= 3:
        moving = sample[sample[:, 2] > 0]
        length = np.hypot(*(2 * moving[:, :2] - 1).T)
        # A unit direction, up to the rounding of half floats.
        if len(moving) and float(np.quantile(np.abs(length - 1), 0.5)) < 0.01:
            return ["magnitude", "plain", "gray"]
    return ["plain", "gray"]


def rough_flow(earlier: np.ndarray, later: np.ndarray) -> np.ndarray:
    """Find a flow in two pictures, reduced to at most `FOUND_PIXELS` pixels: good enough to tell whether there is one.

    Parameters
    ----------
    earlier, later : (H, W) array
        From `flow.guide.tone_map`.

    Returns
    -------
    (H, W, 2) array of float32
        Pixels, from the later picture to the earlier.
    """
    height, width = later.shape
    factor = min(1.0, float(np.sqrt(FOUND_PIXELS / (height * width))))
    size = max(1, round(width * factor)), max(1, round(height * factor))
    pictures = (
        picture if factor == 1 else cv2.resize(picture, size, interpolation=cv2.INTER_AREA)
        for picture in (later, earlier)
    )
    flow = dense_flow(pair_guides(*(smooth_tones(picture) for picture in pictures)))
    if factor == 1:
        return flow
    return cv2.resize(flow, (width, height)) * np.array([width / size[0], height / size[1]], np.float32)
