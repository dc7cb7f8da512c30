"""Detect the convention of motion vectors by testing candidate conventions on pairs of frames."""

from collections.abc import Callable, Collection, Iterator, Sequence
from dataclasses import dataclass, fields, replace
from itertools import product

import numpy as np

from flow.motion import UNITS, VERTICAL, MotionConvention
from flow.patches import WORTH, Patches, keeps_change, mean_cost

# Conventions of least cost that are tried on all patches of all pairs.
FINALISTS = 4
# With fewer patches the spread of differences is unknown, and no convention is clearly better.
FEWEST = 8
# Standard errors of the mean difference by which a convention is clearly better.
CLEARLY = 3.0
# The cost of noise is known to about 1 % of the picture: a convention that leaves less than this is good.
LEAST = 0.02
# A convention that leaves less than this share of the change needs no comparison. Vectors of half the length left 0.4
# of the change on the bundled shot, right ones less than 0.02.
GOOD = 0.25
# With an unknown scale other lengths are tried unless a plain one leaves less than this share.
EXACT = 0.05
# Vectors may span half a frame (a shutter of 180 degrees) or two, and point either way.
SCALES = (1.0, -1.0, 2.0, -2.0, 0.5, -0.5)
# Conventions whose vectors (their ninth decile) are shorter, pixels, or longer, picture widths, are not tried.
SHORTEST, LONGEST = 0.02, 1.0
# Lengths, pixels, tried for the ninth decile of the vectors where nothing better explains the pictures.
LENGTHS = 0.5 * 2 ** np.arange(0, 8.5, 0.5)

PARTS = tuple(field.name for field in fields(MotionConvention))


@dataclass(frozen=True)
class Trial:
    """A convention, and the share of the picture that it leaves unexplained."""

    convention: MotionConvention
    unexplained: float


@dataclass(frozen=True)
class Choice:
    """The convention found, and the evidence. Shares of the picture are in [0, 1]."""

    convention: MotionConvention | None  # None: no convention explains the pictures
    unexplained: float  # share that `convention`, or else the best, leaves unexplained
    still: float  # the same without motion
    found: float | None  # the same with a flow estimated from the pictures, where the decision needed one
    open: tuple[str, ...]  # parts that are neither stated nor settled by the pictures: as assumed
    trials: tuple[Trial, ...]  # conventions tried on all patches, best first
    unrelated: tuple[int, ...] = ()  # pairs across a cut, which are left out unless all are such
    by_surfaces: bool = False  # surfaces have decided, and all shares are those of surfaces
    contradicted: bool = False  # the pictures contradict what the user has stated

    @property
    def certain(self) -> bool:
        """Whether something changes, the convention leaves next to nothing of it, and no other leaves as little."""
        return not self.open and self.still > LEAST and self.unexplained <= max(GOOD * self.still, LEAST)


def choose_convention(
    pairs: Sequence[Patches],
    assumed: MotionConvention,
    settled: Collection[str] = PARTS,
    surfaces: Callable[[], Sequence[Patches]] = tuple,
    typed: Collection[str] = (),
) -> Choice:
    """Find the convention of motion vectors that explains the pictures.

    Parameters
    ----------
    pairs : sequence of Patches
        At least one, of frames of one size. Costs are cached in the pairs.
    assumed : MotionConvention, used where the pictures do not decide
    settled : collection of str, parts that are known; other values are tried only if the known ones explain little
    surfaces : callable
        Returns such pairs of a layer that does not depend on light, such as albedo; called only where light leaves a
        doubt.
    typed : collection of str, parts that the user has stated; nothing overrules these

    Returns
    -------
    Choice
        `convention` is None if no part is typed, surfaces do not confirm the vectors, and the vectors are clearly worse
        than no motion or explain less than half of what an estimated flow explains.

    Raises
    ------
    ValueError
        No pairs, or vectors with fewer channels than `assumed` has.

    Notes
    -----
    Both frames' luminance, L / (L + exposure), is compared on patches of 9 x 9 pixels. m is the mean over a
    patch of neighbour(x + v) − centre(x), q = 0.3 s + 0.004, s the noise of a pixel. The cost of a patch is min(1,
    (m/2q)²) less the cost of noise alone. Patches that a convention moves out of the visible part cost as much as the
    rest; all are unexplained if these hold more than half of the change. A convention is clearly better than another if
    the mean difference, over the patches that both keep, is three times its standard error. The picture is the smallest
    rectangle that holds all that is lit in either frame. Patches that are mostly black in both frames, or have vectors
    of 0 in both, do not count.

    Where shadows move, no vectors explain the light, and a flow that follows the shadows explains it best. Surfaces
    confirm a convention that leaves less than a quarter of the cost of an offset by one pixel, or that is clearly
    better than no motion and explains three quarters of what a flow estimated on surfaces does.
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
        # No motion explains a change of light. Vectors are wrong where an estimated flow explains more.
        found = trials.search()
        believed = trials.worth(chosen, WORTH) or found >= (1 - WORTH) * trials.left(None)
    choice = trials.choice(chosen, settled, found=found, unrelated=unrelated)
    if believed:
        return choice
    return replace(choice, contradicted=True) if typed else replace(choice, convention=None, open=())


def _related(pairs: Sequence[Patches]) -> Sequence[Patches]:
    """Pairs that show the same scene; all pairs if none does."""
    return [pair for pair in pairs if not pair.unrelated] or pairs


class _Trials:
    """Costs of conventions on some pairs; each convention is tested once."""

    def __init__(self, pairs: Sequence[Patches]) -> None:
        self.pairs = pairs
        self.expected = float(np.mean(np.concatenate([pair.expected for pair in self.pairs])))
        # The pair with most change.
        self.screen = max(self.pairs, key=lambda pair: float(np.mean(pair.still - pair.expected)))
        self.tried: dict[MotionConvention, None] = {}  # in the order they were tried

    def costs(self, reading: MotionConvention | None) -> np.ndarray:
        """Cost of each patch of all pairs; None: no motion."""
        if reading is None:
            return np.concatenate([pair.still for pair in self.pairs])
        self.tried[reading] = None
        return np.concatenate([pair.costs(reading) for pair in self.pairs])

    def _screened(self, reading: MotionConvention) -> float:
        return mean_cost(self.screen.costs(reading, few=True), self.screen.still[self.screen.few])

    def mean(self, reading: MotionConvention | None) -> float:
        """Mean cost, noise included."""
        return mean_cost(self.costs(reading), self.costs(None))

    def left(self, reading: MotionConvention | None) -> float:
        """Share of the picture that a convention leaves unexplained."""
        return max(self.mean(reading) - self.expected, 0.0)

    def good(self, reading: MotionConvention, share: float = GOOD) -> bool:
        """Whether a convention leaves so little of the change that no other need be tried."""
        return self.left(reading) <= max(share * self.left(None), LEAST)

    def clearly_better(self, a: MotionConvention | None, b: MotionConvention | None) -> bool:
        """Whether a costs less than b where both stay in the picture, by more than chance."""
        difference, still = self.costs(b) - self.costs(a), self.costs(None)
        inside = ~np.isnan(difference)
        if np.count_nonzero(inside) < FEWEST or not keeps_change(inside, still):
            return False
        difference = difference[inside]
        return bool(difference.mean() > CLEARLY * difference.std() / np.sqrt(len(difference)))

    def overrules(self, other: MotionConvention, stated: MotionConvention) -> bool:
        """Whether another convention leaves half of what the stated one does, or explains twice as much.

        The latter where no motion explains much of the change: reflections, disocclusions.
        """
        clearly = self.clearly_better(other, stated) and self.clearly_better(other, None)
        gain, stated_gain = (self.left(None) - self.left(reading) for reading in (other, stated))
        return clearly and (self.left(other) <= WORTH * self.left(stated) or stated_gain <= WORTH * gain)

    def confirm(self, reading: MotionConvention) -> bool:
        """Whether surfaces, which do not depend on light, confirm a convention."""
        one_off = float(np.mean([pair.one_off for pair in self.pairs]))
        if one_off <= LEAST:
            return False
        if self.left(reading) <= GOOD * one_off:
            return True
        return self.clearly_better(reading, None) and self.worth(reading, 1 - GOOD)

    def worth(self, reading: MotionConvention, share: float) -> bool:
        """Whether a convention explains this share of what an estimated flow does."""
        change = self.left(None)
        explained = change - self.left(reading)
        # A flow explains no more than all; the search for it takes seconds.
        return explained >= share * change or explained >= share * (change - self.search())

    def read(self, assumed: MotionConvention, settled: frozenset[str], typed: frozenset[str]) -> MotionConvention:
        """The best convention with the settled parts, or one that overrules those settled parts that are not typed."""
        chosen = self.best(assumed, settled)
        if settled - typed and (self.clearly_better(None, chosen) or not self.good(chosen)):
            other = self.best(assumed, typed)
            if self.overrules(other, chosen):
                return other
        return chosen

    def best(self, assumed: MotionConvention, settled: frozenset[str]) -> MotionConvention:
        """The convention of least cost, or one that is preferred to it and not clearly worse."""
        readings = self._readings(assumed, settled)
        if len(readings) > FINALISTS:
            rank = sorted(readings, key=self._screened)
            readings = [reading for reading in readings if reading == assumed or reading in rank[:FINALISTS]]
        least = min(readings, key=self.mean)
        if "scale" not in settled:
            exact = self.good(least, EXACT)
            fitted = self._fit_scale(least if exact else self._fit_length(assumed, settled))
            # Two lengths that nobody has stated, and that are not exact, go behind one for both axes that fits better.
            unlikely = not exact and least.unit != assumed.unit and self._axes(fitted) < self._axes(least)
            if self.overrules(fitted, least) or (unlikely and self.mean(fitted) < self.mean(least)):
                return fitted
        return next(reading for reading in readings if not self.clearly_better(least, reading))

    def _axes(self, reading: MotionConvention) -> int:
        """Count the lengths of a convention's unit: two where width and height of the picture are units."""
        return len({abs(factor) for factor in reading.factors(self.screen.resolution)})

    def _readings(self, assumed: MotionConvention, settled: frozenset[str]) -> list[MotionConvention]:
        """Conventions with the settled parts and plausible lengths, the preferred ones first."""
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
        # As many vectors as assumed first, then positive scales, then the fewest changed parts.
        changes = {r: sum(getattr(r, part) != getattr(assumed, part) for part in PARTS) for r in readings.values()}
        return sorted(readings.values(), key=lambda r: (r.pair != assumed.pair, r.scale < 0, changes[r]))

    def _fit_length(self, assumed: MotionConvention, settled: frozenset[str]) -> MotionConvention:
        """The convention of least cost among vectors of about any length."""
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
        """The convention with the nearby scale of least cost."""
        best = min(_near(reading, 0.5), key=self._screened)
        if best == reading:
            return reading
        for octaves in (0.125, 0.03):
            best = min(_near(best, octaves), key=self.mean)
        return best

    def search(self) -> float:
        """Share of the picture that estimated flows leave unexplained, in [0, 1]."""
        costs = np.concatenate([pair.found for pair in self.pairs])
        return max(mean_cost(costs, self.costs(None)) - self.expected, 0.0)

    def open_parts(self, chosen: MotionConvention, settled: frozenset[str]) -> tuple[str, ...]:
        """Parts in which conventions differ that cost no more than the chosen one; all, if that explains nothing."""
        if not self.clearly_better(chosen, None):
            return tuple(part for part in PARTS if part not in settled)
        # Without those that differ by a fitted scale alone, or hold one vector where this one holds two.
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
        """The choice of a convention, with its evidence."""
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
        """Every convention that was tried on all patches, best first."""
        order = sorted(self.tried, key=self.mean)
        return tuple(Trial(reading, self.left(reading)) for reading in order)


def _near(reading: MotionConvention, octaves: float) -> list[MotionConvention]:
    """The convention, and others up to so many octaves longer and shorter."""
    factors = 2.0 ** np.linspace(-octaves, octaves, 9)
    return [reading, *(replace(reading, scale=reading.scale * float(factor)) for factor in factors)]


def _agreeing(
    assumed: MotionConvention, settled: frozenset[str], vectors: Sequence[np.ndarray]
) -> Iterator[MotionConvention]:
    """All conventions with the settled parts, the preferred ones first."""
    # The scale varies slowest: plain lengths go before all others.
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
    """Encodings that vectors with such values may have."""
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
