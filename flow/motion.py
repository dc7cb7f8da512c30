"""Renderers' motion vectors: converted into one convention, composed, inverted, checked."""

from dataclasses import dataclass, fields
from typing import NamedTuple

import cv2
import numpy as np
from numba import njit

from flow.warp import warp

# Longer than any frame is wide: renderers write 1e9, 1e10 or similar where motion is unknown.
ABSURD_LENGTH = 1e4

DIRECTIONS = {
    "previous": "from this frame to the previous one",
    "next": "from this frame to the next one",
    "both": "two vectors: from this frame to the previous one, then from it to the next",
    "cycles": "two vectors: from this frame to the previous one, then from the next to this one",
}
UNITS = {
    "pixels": "1 is a pixel",
    "ndc": "1 is the width of the picture in x, its height in y",
    "half-ndc": "1 is half the width of the picture in x, half its height in y",
    "screen": "1 is the width of the picture in x and in y",
}
VERTICAL = {"down": "y points down", "up": "y points up"}
ENCODINGS = {
    "plain": "x, y",
    "gray": "x, y in [0, 1], one half is still: v = 2 c - 1",
    "magnitude": "a direction in [0, 1] and a length: v = (2 c - 1) length",
}


@dataclass(frozen=True)
class MotionConvention:
    """A renderer's convention: v = scale · unit · (decode(c) + offset), y turned down; ValueError if invalid."""

    direction: str = "previous"  # a key of `DIRECTIONS`
    unit: str = "pixels"  # a key of `UNITS`
    y: str = "down"  # a key of `VERTICAL`
    scale: float = 1.0  # not 0: -1 where vectors point the other way, 2 where they span half a frame (180° shutter)
    offset: float = 0.0  # added to each decoded component, where no motion is not 0
    encoding: str = "plain"  # a key of `ENCODINGS`
    premultiplied: bool = False  # by alpha; a caller that has both divides before anything else

    def __post_init__(self) -> None:
        words = {"direction": DIRECTIONS, "unit": UNITS, "y": VERTICAL, "encoding": ENCODINGS}
        for name, known in words.items():
            if getattr(self, name) not in known:
                raise ValueError(f"{name} of motion is {getattr(self, name)!r}, expected one of {', '.join(known)}")
        for name in ("scale", "offset"):
            value = getattr(self, name)
            if isinstance(value, bool) or not isinstance(value, int | float) or not np.isfinite(value):
                raise ValueError(f"{name} of motion is {value!r}, expected a number")
        if not isinstance(self.premultiplied, bool):
            raise ValueError(f"premultiplied of motion is {self.premultiplied!r}, expected true or false")
        if self.scale == 0:
            raise ValueError("scale of motion is 0, expected a number that is not 0")

    @property
    def pair(self) -> bool:
        """Whether there are vectors to both neighbours."""
        return self.direction in ("both", "cycles")

    @property
    def channels(self) -> int:
        """Least number of channels of the vectors."""
        return (3 if self.encoding == "magnitude" else 2) * (2 if self.pair else 1)

    def factors(self, resolution: tuple[int, int]) -> tuple[float, float]:
        """Factors from decoded vectors to pixels, x right and y down, in a picture of height and width."""
        height, width = resolution
        x, y = {"pixels": (1, 1), "screen": (width, width)}.get(self.unit, (width, height))
        scale = self.scale / 2 if self.unit == "half-ndc" else self.scale
        return scale * x, scale * (y if self.y == "down" else -y)

    def __str__(self) -> str:
        """Format in the words of `--motion`, without default values."""
        said = [self.direction, self.unit, f"y-{self.y}"]
        said += [] if self.encoding == "plain" else [self.encoding]
        numbers = {"scale": self.scale, "offset": self.offset}
        said += [f"{f.name}={numbers[f.name]:.6g}" for f in fields(self) if numbers.get(f.name, f.default) != f.default]
        said += ["premultiplied"] if self.premultiplied else []
        return ",".join(said)


# Blender's Vector: the previous frame is sampled at (x + X, y - Y), the next one at (x - Z, y + W), y pointing down.
CYCLES = MotionConvention("cycles", y="up")


class Vectors(NamedTuple):
    """A flow (H, W, 2), pixels, and its validity (H, W); the flow is 0 where it is invalid."""

    flow: np.ndarray
    valid: np.ndarray


class Motion(NamedTuple):
    """Flows of one frame to its neighbours; None where the renderer gives no such vectors."""

    to_previous: Vectors | None
    to_next: Vectors | None


def normalize_motion(
    vectors: np.ndarray, convention: MotionConvention, *, resolution: tuple[int, int] | None = None
) -> Motion:
    """Convert a renderer's vectors (H, W, C) into flows (H, W, 2), pixels, to the previous and to the next frame.

    Channels beyond those of the convention are ignored. `resolution` is height and width of the whole picture, the base
    of NDC units, by default those of `vectors`. At least one flow is there; vectors that are NaN, infinite, or longer
    than `ABSURD_LENGTH` in a component are invalid. Raises ValueError for fewer channels than the convention has.
    """
    if vectors.ndim != 3 or vectors.shape[2] < convention.channels:
        expected = f"(H, W, {convention.channels} or more) for {convention}"
        raise ValueError(f"vectors has shape {vectors.shape}, expected {expected}")
    unit = np.array(convention.factors(resolution or (vectors.shape[0], vectors.shape[1])), np.float32)
    return Motion(*(None if v is None else _to_pixels(v, unit) for v in decode_motion(vectors, convention)))


def decode_motion(vectors: np.ndarray, convention: MotionConvention) -> tuple[np.ndarray | None, np.ndarray | None]:
    """Decode motion vectors into flows to the previous and next frame, before `MotionConvention.factors`."""
    size = convention.channels // (2 if convention.pair else 1)
    first = _decode(vectors[..., :size], convention)
    if convention.direction == "previous":
        return first, None
    if convention.direction == "next":
        return None, first
    second = _decode(vectors[..., size : 2 * size], convention)
    return first, -second if convention.direction == "cycles" else second


def _decode(vectors: np.ndarray, convention: MotionConvention) -> np.ndarray:
    with np.errstate(over="ignore", invalid="ignore"):
        flow = np.asarray(vectors[..., :2], np.float32)
        if convention.encoding != "plain":
            flow = 2 * flow - 1
        if convention.encoding == "magnitude":
            flow = np.asarray(flow * vectors[..., 2:3], np.float32)
        if convention.offset:
            flow = flow + np.float32(convention.offset)
    return flow


def _to_pixels(decoded: np.ndarray, unit: np.ndarray) -> Vectors:
    """Convert to pixels; 0 and False where a vector is not finite or absurdly long."""
    flow, valid = np.empty(decoded.shape, np.float32), np.ones(decoded.shape[:2], bool)
    for axis in (0, 1):  # by planes: numpy takes long over so short an axis
        with np.errstate(over="ignore", invalid="ignore"):
            part = decoded[..., axis] * unit[axis]
        flow[..., axis] = part
        valid &= np.abs(part, out=part) <= ABSURD_LENGTH  # NaN compares false
    if not valid.all():
        flow[~valid] = 0
    return Vectors(flow, valid)


def compose_flow(
    first: np.ndarray,
    second: np.ndarray,
    *,
    first_valid: np.ndarray | None = None,
    second_valid: np.ndarray | None = None,
) -> tuple[np.ndarray, np.ndarray]:
    """Chain the flow from t to t' with that from t' to t'': flow and validity from t to t''.

    Parameters
    ----------
    first, second : (H, W, 2) array of float, finite, pixels; `second` belongs to the frame that `first` points to
    first_valid, second_valid : (H, W) array of bool, optional, default: all True

    Returns
    -------
    flow : (H, W, 2) array of float32
        f₂(x) = f₁(x) + f₁'(x + f₁(x)), f₁' sampled bilinearly, with its edge value outside the frame.
    valid : (H, W) array of bool, `first` is valid, lands in the frame, and every sampled vector of `second` is valid
    """
    if first.shape != second.shape:
        raise ValueError(f"first has shape {first.shape}, expected that of second, {second.shape}")
    flow, valid = warp(second, first)
    flow += first
    if first_valid is not None:
        valid &= first_valid
    if second_valid is not None and not second_valid.all():
        valid &= warp(~second_valid, first)[0] == 0  # any invalid vector in the bilinear mix is too much
    return flow, valid


@njit(nogil=True, cache=True)
def _splat(
    flow: np.ndarray, valid: np.ndarray, depth: np.ndarray, nearest: np.ndarray, out: np.ndarray, weight: np.ndarray
) -> None:
    """Splat the reversed vectors: first the nearest depth of each pixel, then the mean of vectors at about it."""
    height, width = valid.shape
    for accumulate in (False, True):
        for y in range(height):
            for x in range(width):
                if not valid[y, x]:
                    continue
                px, py = x + flow[y, x, 0], y + flow[y, x, 1]
                x0, y0 = int(np.floor(px)), int(np.floor(py))
                for j in range(2):
                    for i in range(2):
                        tx, ty = x0 + i, y0 + j
                        w = (1 - abs(px - tx)) * (1 - abs(py - ty))
                        # A corner that is barely touched must not occlude: 1e-3 of a pixel's area.
                        if w < 1e-3 or tx < 0 or ty < 0 or tx >= width or ty >= height:
                            continue
                        d = depth[y, x]
                        if not accumulate:
                            nearest[ty, tx] = min(nearest[ty, tx], d)
                        # 5 %: slanted surfaces differ a little from pixel to pixel, objects by more.
                        elif d <= nearest[ty, tx] + np.float32(0.05) * abs(nearest[ty, tx]):
                            out[ty, tx, 0] -= w * flow[y, x, 0]
                            out[ty, tx, 1] -= w * flow[y, x, 1]
                            weight[ty, tx] += w


def invert_flow(
    flow: np.ndarray, *, valid: np.ndarray | None = None, depth: np.ndarray | None = None
) -> tuple[np.ndarray, np.ndarray]:
    """Invert the flow (H, W, 2), finite, from frame b to frame a by splatting: flow and validity from a to b.

    Where a renderer gives only vectors to the previous frame, those to the next frame are `invert_flow(the next frame's
    to_previous)`. Vectors of b that are not `valid` (H, W) are left out. Among pixels that arrive at one place the
    nearest by `depth` (H, W), above 0, wins, without depth the fastest, as fast objects tend to be in front. Where
    nothing arrives (hidden in b) the inverse is invalid, the mean of the neighbours within two pixels, else 0.
    """
    if flow.ndim != 3 or flow.shape[2] != 2:
        raise ValueError(f"flow has shape {flow.shape}, expected (H, W, 2)")
    shape = flow.shape[:2]
    for name, array in (("valid", valid), ("depth", depth)):
        if array is not None and array.shape != shape:
            raise ValueError(f"{name} has shape {array.shape}, expected {shape}")
    flow = np.ascontiguousarray(flow, np.float32)
    usable = (np.abs(flow[..., 0]) <= ABSURD_LENGTH) & (np.abs(flow[..., 1]) <= ABSURD_LENGTH)
    if valid is not None:
        usable &= valid
    # 1 / (1 + speed) orders by speed as a depth does by nearness, with steps of 5 % where speeds differ by that.
    order = 1 / (1 + np.hypot(flow[..., 0], flow[..., 1])) if depth is None else depth
    order = np.nan_to_num(np.asarray(order, np.float32), nan=np.inf)
    inverse, weight = np.zeros_like(flow), np.zeros(shape, np.float32)
    _splat(flow, usable, order, np.full(shape, np.inf, np.float32), inverse, weight)
    arrived = weight > 0
    inverse[arrived] /= weight[arrived, None]
    near = cv2.boxFilter(arrived.astype(np.float32), -1, (5, 5), normalize=False, borderType=cv2.BORDER_CONSTANT)
    total = cv2.boxFilter(inverse, -1, (5, 5), normalize=False, borderType=cv2.BORDER_CONSTANT)
    # Counts are whole numbers, up to the rounding of the filter's running sum.
    fill = ~arrived & (near > 0.5)
    inverse[fill] = total[fill] / near[fill, None]
    return inverse, arrived


def forward_backward_error(flow: np.ndarray, reverse: np.ndarray) -> np.ndarray:
    """Measure |f(x) + r(x + f(x))|, (H, W), pixels, from start to end of a round trip; r ends with its edge."""
    loop, _ = warp(reverse, flow)
    loop += flow
    return np.asarray(np.hypot(loop[..., 0], loop[..., 1]))
