"""Costs of motion vectors on patches of a pair of frames."""

from collections.abc import Sequence
from dataclasses import dataclass
from functools import cached_property

import cv2
import numpy as np
from numba import njit

from flow.guide import estimate_noise, median_luminance, tone_map
from flow.motion import ABSURD_LENGTH, MotionConvention, decode_motion
from flow.tvl1 import rough_flow

# Patches of 9 x 9 pixels: the noise of their means is a ninth of a pixel's.
RADIUS = 4
# Enough for 0.2 % of the picture to be eight of them, few enough for milliseconds a convention.
MOST_PATCHES = 4096
# Conventions are screened on so many patches of one pair: half are those that change most, half lie anywhere.
SCREENED = 192
# A difference of means within noise: the scale of `nlm.gate.color_gate`, a third of a pixel's noise and one step of
# 8 bits. Noise alone exceeds twice this scale in one of a thousand patches.
NOISE_SHARE, NOISE_FLOOR = 0.3, 0.004
# A convention that moves more of the change out of the picture than it keeps explains nothing.
INSIDE = 0.5
# Vectors explain at least this share of the change that an estimated flow explains, or another convention.
WORTH = 0.5
# Frames that differ in a greater share of the picture may be two shots.
CUT = 0.5


@dataclass(frozen=True, eq=False)
class FramePair:
    """Two neighbouring frames with the motion vectors as rendered."""

    earlier: np.ndarray  # (H, W, 3) linear radiance, noisy; NaN counts as 0, Inf as white
    later: np.ndarray
    earlier_vectors: np.ndarray  # (H, W, C)
    later_vectors: np.ndarray
    resolution: tuple[int, int]  # height and width, pixels, of the whole picture
    frames: int = 1  # from the earlier to the later; vectors span one
    lift: float = 0.0  # added to both pictures, so that no value of a normal is negative


ONE_PIXEL = np.ones(2, np.float32)
_Flows = tuple[np.ndarray | None, np.ndarray | None]


class Patches:
    """A pair of frames, sampled by patches at the same places of both: luminance, and vectors of the patches."""

    def __init__(self, pair: FramePair) -> None:
        self.resolution, self.frames = pair.resolution, pair.frames
        exposure = median_luminance(pair.earlier, pair.lift)
        pictures = [tone_map(color, exposure, pair.lift) for color in (pair.earlier, pair.later)]
        box = _lit_box(np.logical_or(*(picture > 0 for picture in pictures)))
        self.pictures = tuple(np.ascontiguousarray(picture[box]) for picture in pictures)
        layers = pair.earlier_vectors[box], pair.later_vectors[box]
        # Closed: noise leaves single pixels of a lit area black.
        near = np.ones((3, 3), np.uint8)
        masks = (cv2.morphologyEx((picture > 0).astype(np.uint8), cv2.MORPH_CLOSE, near) for picture in self.pictures)
        self.shown = tuple(mask.astype(bool) for mask in masks)
        self.radius = min(RADIUS, (min(self.pictures[0].shape) - 1) // 2)
        self.size = 2 * self.radius + 1
        self.rows, self.columns = self._places(layers)
        noise = [estimate_noise(picture)[self.rows, self.columns] ** 2 for picture in self.pictures]
        deviation = np.sqrt(np.mean(noise, axis=0))
        # The scale is made for patches of 9 x 9; the means of smaller patches are noisier by the ratio of the sides.
        self.scale = 2 * (NOISE_SHARE * deviation * ((2 * RADIUS + 1) / self.size) + NOISE_FLOOR)
        # Two means differ by noise with the variance 2 s² / size².
        self.expected = 2 * np.square(deviation / (self.size * self.scale))
        self.all = np.arange(len(self.rows))
        # Without motion a pixel that is lit in one frame alone has changed: black counts as lit.
        everywhere = (np.ones_like(self.shown[0]),) * 2
        unmoved = np.zeros((len(self.rows) * self.size, self.size, 2), np.float32)
        self.still = self._costs((1, 0), unmoved, self.all, shown=everywhere)
        self.few = _informative(self.still)
        self.vectors = [self.gather(layer, self.all) for layer in layers]
        self.few_vectors = [self.gather(layer, self.few) for layer in layers]
        self.tried: dict[tuple[MotionConvention, bool], np.ndarray] = {}
        self.decoded: dict[tuple[str, str, float, bool], tuple[_Flows, _Flows]] = {}

    def _places(self, layers: Sequence[np.ndarray]) -> tuple[np.ndarray, np.ndarray]:
        """Rows and columns of the patches: a grid over the lit pixels that have vectors, if there are any."""
        height, width = self.pictures[0].shape
        spacing = max(self.size, int(np.ceil(np.sqrt(height * width / MOST_PATCHES))))
        lit = np.logical_or(*self.shown)
        known = np.zeros_like(lit)
        for plane in (plane for layer in layers for plane in np.moveaxis(layer, -1, 0)):
            known |= plane != 0
        known &= lit
        rows, columns, kept = self._grid(spacing, known if known.any() else lit)
        if kept.any() and not kept.all():
            # As many patches as the kept part of the picture holds, so that an object of 1 % of it has enough.
            finer = max(1, int(spacing * np.sqrt(kept.mean())))
            rows, columns, kept = self._grid(finer, known if known.any() else lit)
            rows, columns = rows[kept], columns[kept]
        return rows, columns

    def _grid(self, spacing: int, lit: np.ndarray) -> tuple[np.ndarray, np.ndarray, np.ndarray]:
        """Rows and columns of a grid, and which patches are lit at least half as far as the fullest.

        The means of fewer pixels have more noise.
        """
        inner = [np.arange(self.radius, side - self.radius, spacing) for side in lit.shape]
        rows, columns = (grid.ravel() for grid in np.meshgrid(*inner, indexing="ij"))
        share = cv2.blur(lit.astype(np.float32), (self.size, self.size))[rows, columns]
        return rows, columns, np.asarray((share > 0) & (2 * share >= share.max()))

    def costs(self, convention: MotionConvention, *, few: bool = False) -> np.ndarray:
        """Cost of each patch, or of the `few` most informative, under a convention, in [0, 1]; NaN outside."""
        if (convention, few) not in self.tried:
            self.tried[convention, few] = self._try(convention, few)
        return self.tried[convention, few]

    def _try(self, convention: MotionConvention, few: bool) -> np.ndarray:
        unit = np.array(convention.factors(self.resolution), np.float32) * np.float32(self.frames)
        earlier, later = self._decoded(convention, few)
        at = self.few if few else self.all
        flows = (((0, 1), earlier[1]), ((1, 0), later[0]))
        sides = [self._costs(order, flow, at, unit) for order, flow in flows if flow is not None]
        if len(sides) == 1:
            return sides[0]
        return np.where(np.isnan(sides[0]), sides[1], np.where(np.isnan(sides[1]), sides[0], (sides[0] + sides[1]) / 2))

    def _decoded(self, convention: MotionConvention, few: bool) -> tuple[_Flows, _Flows]:
        """Vectors of the earlier and of the later frame, cached: many conventions differ in their unit alone."""
        kind = convention.direction, convention.encoding, convention.offset, few
        if kind not in self.decoded:
            earlier, later = self.few_vectors if few else self.vectors
            self.decoded[kind] = decode_motion(earlier, convention), decode_motion(later, convention)
        return self.decoded[kind]

    @cached_property
    def found(self) -> np.ndarray:
        """Cost of each patch under a flow estimated from the pictures."""
        return self._costs((1, 0), self.gather(rough_flow(*self.pictures), self.all), self.all)

    @cached_property
    def unrelated(self) -> bool:
        """Whether hardly anything of one frame is found in the other."""
        changes = float(np.mean(self.still - self.expected))
        if changes <= CUT:
            return False
        left = mean_cost(self.found, self.still) - float(np.mean(self.expected))
        return left > (1 - WORTH) * changes

    @cached_property
    def one_off(self) -> float:
        """Mean cost of an offset by one pixel: the structure in the picture."""
        steps = np.zeros((len(self.rows) * self.size, self.size, 2), np.float32)
        costs = []
        for axis in (0, 1):
            steps[:] = np.eye(2)[axis]
            costs.append(self._costs((1, 1), steps, self.all))
        known = np.isfinite(costs)
        return float(np.mean(costs, where=known)) if known.any() else 0.0

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
        """Extract the patches `at` of a layer (H, W, C), one below the other, (P · size, size, C)."""
        reach = np.arange(-self.radius, self.radius + 1)
        rows = self.rows[at, None, None] + reach[:, None]
        columns = self.columns[at, None, None] + reach
        return np.asarray(layer[rows, columns].reshape(-1, len(reach), layer.shape[2]))

    def _costs(
        self,
        order: tuple[int, int],
        flow: np.ndarray,
        at: np.ndarray,
        unit: np.ndarray = ONE_PIXEL,
        shown: tuple[np.ndarray, ...] | None = None,
    ) -> np.ndarray:
        """Costs of the patches `at`: centre and neighbour are the frames of these indices, `order`."""
        centre, other = (self.pictures[index] for index in order)
        own_lit, other_lit = ((shown or self.shown)[index] for index in order)
        difference, flow = np.empty(len(at), np.float32), np.ascontiguousarray(flow, np.float32)
        _compare(centre, other, own_lit, other_lit, flow, unit, self.rows[at], self.columns[at], difference)
        return np.asarray(np.minimum(np.square(difference / self.scale[at]), 1))


@njit(nogil=True, cache=True)
def _compare(
    centre: np.ndarray, other: np.ndarray, own_lit: np.ndarray, other_lit: np.ndarray, flow: np.ndarray,
    unit: np.ndarray, rows: np.ndarray, columns: np.ndarray, out: np.ndarray,
) -> None:  # fmt: skip
    """Mean of other(x + v) − centre(x) over the lit part of patches; NaN where half of it leaves.

    Times the root of the lit share, as the mean of fewer pixels has more noise.
    """
    size, half, zero = flow.shape[1], np.float32(0.5), np.float32(0)
    last_row, last_column = np.float32(other.shape[0] - 1), np.float32(other.shape[1] - 1)
    for patch in range(len(rows)):
        total, count, most = zero, 0, 0
        for i in range(size):
            y = rows[patch] + i - size // 2
            for j in range(size):
                x = columns[patch] + j - size // 2
                if not own_lit[y, x]:
                    continue
                most += 1
                v = flow[patch * size + i, j]
                row, column = np.float32(y) + v[1] * unit[1], np.float32(x) + v[0] * unit[0]
                # NaN compares false.
                if not (-half <= row <= last_row + half and -half <= column <= last_column + half):
                    continue
                row, column = min(max(row, zero), last_row), min(max(column, zero), last_column)
                y0, x0 = int(row), int(column)
                fy, fx = row - np.float32(y0), column - np.float32(x0)
                y1, x1 = y0 + (fy > zero), x0 + (fx > zero)
                if other_lit[y0, x0] and other_lit[y1, x1]:
                    above = other[y0, x0] + fx * (other[y0, x1] - other[y0, x0])
                    below = other[y1, x0] + fx * (other[y1, x1] - other[y1, x0])
                    total += above + fy * (below - above) - centre[y, x]
                    count += 1
        enough = count > 0 and 2 * count >= most
        out[patch] = total / np.float32(np.sqrt(count) * size) if enough else np.nan


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


def keeps_change(inside: np.ndarray, still: np.ndarray) -> bool:
    """Return whether most of the change without motion, of costs (P,), is inside."""
    return bool(inside.any()) and float(still[inside].sum()) >= INSIDE * float(still.sum())


def mean_cost(costs: np.ndarray, still: np.ndarray) -> float:
    """Return the mean cost; patches outside (NaN) cost as large a share of their cost without motion as others."""
    inside = ~np.isnan(costs)
    if not keeps_change(inside, still):
        return float(still.mean())
    change = float(still[inside].sum())
    factor = min(float(costs[inside].sum()) / change, 1.0) if change > 0 else 1.0
    return float(np.where(inside, costs, factor * still).mean())


def _informative(still: np.ndarray) -> np.ndarray:
    """Indices of `SCREENED` patches: half of them those that change most, half spread evenly."""
    if len(still) <= SCREENED:
        return np.arange(len(still))
    half = SCREENED // 2
    changing = np.argpartition(still, -half)[-half:]
    spread = np.linspace(0, len(still) - 1, half).round().astype(int)
    return np.union1d(changing, spread)
