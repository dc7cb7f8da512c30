"""Backward warp of images and whole AOV stacks."""

from collections.abc import Callable
from typing import Any, NamedTuple

import numpy as np
from numba import njit

from loops.parallel import run_bands

Four = tuple[Any, Any, Any, Any]


# Part of a pixel beyond a whole one from which on a sample is one between pixels: sharp outlines are blurred there.
_BETWEEN = np.float32(1 / 8)


class RowOfPlaces(NamedTuple):
    """Whether positions are in the frame, their first pixels (x0, y0) of four, and their fractions from these.

    Arrays of n values, of which several are computed at once. The second column of pixels is x0 + 1 where fx is above
    0, and x0 elsewhere, so that on whole-pixel motion a neighbour of weight 0 cannot bring in a NaN; rows alike.
    """

    inside: np.ndarray  # bool
    x0: np.ndarray  # int32
    y0: np.ndarray
    fx: np.ndarray  # float32
    fy: np.ndarray


@njit(nogil=True)
def locate_row(flow: np.ndarray, y: int, corner: tuple[int, int], width: int, height: int, count: int) -> RowOfPlaces:
    """Find the pixels around the ends of a row of vectors, from the centre of the first pixel.

    Those of an empty flow are `count` vectors of 0. `corner` is where the flow begins. Positions outside the frame have
    the pixels of its edge; NaN and infinities are outside.
    """
    inside, pixels = np.empty(count, np.bool_), np.empty((2, count), np.int32)
    fractions = np.empty((2, count), np.float32)
    x0, y0, fx, fy = pixels[0], pixels[1], fractions[0], fractions[1]
    half, zero, top, left = np.float32(0.5), np.float32(0), corner[0] + y, corner[1]
    right, bottom = np.float32(width - 1), np.float32(height - 1)
    for x in range(count):
        px, py = np.float32(left + x), np.float32(top)
        if flow.size:
            px, py = px + flow[y, x, 0], py + flow[y, x, 1]
        # Written so that a NaN or infinite position fails the test.
        inside[x] = (px >= -half) & (px <= right + half) & (py >= -half) & (py <= bottom + half)
        # Clamping the position is the same as repeating the edge; NaN falls to 0.
        px, py = min(px, right) if px > zero else zero, min(py, bottom) if py > zero else zero
        x0[x], y0[x] = np.int32(px), np.int32(py)
        fx[x], fy[x] = px - np.float32(x0[x]), py - np.float32(y0[x])
    return RowOfPlaces(inside, x0, y0, fx, fy)


@njit(nogil=True)
def _mix(image: np.ndarray, channel: Any, corners: Four, weights: Four) -> np.float32:
    """Weigh four values of a flat image."""
    a, b, c, d = corners
    value: np.float32 = (
        weights[0] * image[a + channel] + weights[1] * image[b + channel]
        + weights[2] * image[c + channel] + weights[3] * image[d + channel]
    )  # fmt: skip
    return value


@njit(nogil=True)
def interpolate_row(image: np.ndarray, places: RowOfPlaces, planes: np.ndarray) -> None:
    """Sample an image (H, W, C) bilinearly at places; each channel is written into a plane of (C, n)."""
    one, zero = np.float32(1), np.float32(0)
    _, x0, y0, fx, fy = places
    flat, column, row = image.reshape(-1), np.uintp(image.shape[2]), np.uintp(image.shape[1] * image.shape[2])
    for x in range(np.uintp(len(x0))):
        a = np.uintp(y0[x]) * row + np.uintp(x0[x]) * column
        right, down = column if fx[x] > zero else np.uintp(0), row if fy[x] > zero else np.uintp(0)
        corners = a, a + right, a + down, a + down + right
        weights = (one - fy[x]) * (one - fx[x]), (one - fy[x]) * fx[x], fy[x] * (one - fx[x]), fy[x] * fx[x]
        for c in range(column):
            planes[c, x] = _mix(flat, c, corners, weights)


@njit(nogil=True)
def weigh_whole(fx: np.float32, fy: np.float32) -> np.float32:
    """Weight of a position by its distance from a whole pixel: 1 there, 0 from an eighth of a pixel on."""
    zero, one = np.float32(0), np.float32(1)
    return max(one - max(min(fx, one - fx), min(fy, one - fy)) / _BETWEEN, zero)


def at_whole_pixels(flow: np.ndarray) -> np.ndarray:
    """Where a finite flow (H, W, 2) ends near a whole pixel: (H, W) bool."""
    near: np.ndarray = np.abs(flow - np.round(flow)).max(axis=-1) < _BETWEEN / 2
    return near


@njit(nogil=True, cache=True)
def _bilinear(
    first: int, last: int, image: np.ndarray, flow: np.ndarray, corner: tuple[int, int], out: np.ndarray,
    inside: np.ndarray,
) -> None:  # fmt: skip
    height, width, channels = image.shape
    one, zero, count = np.float32(1), np.float32(0), out.shape[1]
    flat, result = image.reshape(-1), out.reshape(-1)
    column, row = np.uintp(channels), np.uintp(width * channels)
    for y in range(first, last):
        near, x0, y0, all_fx, all_fy = locate_row(flow, y, corner, width, height, count)
        for x in range(count):
            inside[y, x], fx, fy = near[x], all_fx[x], all_fy[x]
            weights = (one - fy) * (one - fx), (one - fy) * fx, fy * (one - fx), fy * fx
            start = np.uintp(y0[x]) * row + np.uintp(x0[x]) * column
            right, down = column if fx > zero else np.uintp(0), row if fy > zero else np.uintp(0)
            corners = start, start + right, start + down, start + down + right
            here = (np.uintp(y) * np.uintp(count) + np.uintp(x)) * column
            if channels == 3 and x + 1 < count and corners[3] + np.uintp(3) < np.uintp(len(flat)):
                # As in `_bicubic`: four values at once.
                red = _mix(flat, np.uintp(0), corners, weights)
                green = _mix(flat, np.uintp(1), corners, weights)
                blue = _mix(flat, np.uintp(2), corners, weights)
                next_red = _mix(flat, np.uintp(3), corners, weights)
                result[here], result[here + np.uintp(1)] = red, green
                result[here + np.uintp(2)], result[here + np.uintp(3)] = blue, next_red
            else:
                for c in range(column):
                    result[here + c] = _mix(flat, c, corners, weights)


def ends_inside(flow: np.ndarray, shape: tuple[int, ...], first_row: int) -> np.ndarray:
    """Where vectors (h, W, 2), of rows from `first_row` on, end in a frame of a shape (H, W); NaN ends outside."""
    x = flow[..., 0] + np.arange(flow.shape[1], dtype=np.float32)
    y = flow[..., 1] + np.arange(first_row, first_row + len(flow), dtype=np.float32)[:, None]
    inside: np.ndarray = (x >= -0.5) & (x <= shape[1] - 0.5)
    inside &= (y >= -0.5) & (y <= shape[0] - 0.5)
    return inside


def _nearest(
    first: int, last: int, image: np.ndarray, flow: np.ndarray, corner: tuple[int, int], out: np.ndarray,
    inside: np.ndarray,
) -> None:  # fmt: skip
    inside[first:last] = ends_inside(flow[first:last], image.shape, corner[0] + first)
    pixels = []
    starts = np.arange(corner[0] + first, corner[0] + last)[:, None], np.arange(corner[1], corner[1] + out.shape[1])
    for place, size, axis in zip(starts, image.shape, (1, 0), strict=False):
        end = place.astype(np.float32) + flow[first:last, :, axis]
        end = np.where(end > 0, np.minimum(end, np.float32(size - 1)), np.float32(0))  # NaN falls to 0
        pixel = end.astype(np.intp)
        pixels.append(pixel + (end - pixel >= 0.5))
    out[first:last] = image[tuple(pixels)]


@njit(nogil=True)
def _catmull_rom(t: np.float32) -> tuple[np.float32, np.float32, np.float32, np.float32]:
    """Weights of the samples at -1, 0, 1, 2 for a position t in [0, 1); they sum to 1."""
    half = np.float32(0.5)
    t2 = t * t
    t3 = t2 * t
    return (
        half * (-t3 + np.float32(2) * t2 - t),
        half * (np.float32(3) * t3 - np.float32(5) * t2 + np.float32(2)),
        half * (np.float32(-3) * t3 + np.float32(4) * t2 + t),
        half * (t3 - t2),
    )


@njit(nogil=True)
def _sample_bicubic(image: np.ndarray, channel: Any, columns: Four, rows: Four, wx: Four, wy: Four) -> np.float32:
    """Weigh sixteen values of a flat image, clamped to the range of the four central ones."""
    x0, x1, x2, x3 = columns
    y0, y1, y2, y3 = rows[0] + channel, rows[1] + channel, rows[2] + channel, rows[3] + channel
    a, b, c, d = image[y1 + x1], image[y1 + x2], image[y2 + x1], image[y2 + x2]
    first = wx[0] * image[y0 + x0] + wx[1] * image[y0 + x1] + wx[2] * image[y0 + x2] + wx[3] * image[y0 + x3]
    second = wx[0] * image[y1 + x0] + wx[1] * a + wx[2] * b + wx[3] * image[y1 + x3]
    third = wx[0] * image[y2 + x0] + wx[1] * c + wx[2] * d + wx[3] * image[y2 + x3]
    last = wx[0] * image[y3 + x0] + wx[1] * image[y3 + x1] + wx[2] * image[y3 + x2] + wx[3] * image[y3 + x3]
    total = wy[0] * first + wy[1] * second + wy[2] * third + wy[3] * last
    low, high = min(min(a, b), min(c, d)), max(max(a, b), max(c, d))
    value: np.float32 = min(max(total, low), high)
    return value


# Unsigned: with a signed index numba tests each time whether it counts from the end.
@njit(nogil=True, cache=True)
def _bicubic(
    first: int, last: int, image: np.ndarray, flow: np.ndarray, corner: tuple[int, int], out: np.ndarray,
    inside: np.ndarray,
) -> None:  # fmt: skip
    height, width, channels = image.shape
    flat, result = image.reshape(-1), out.reshape(-1)
    column, row = np.uintp(channels), np.uintp(width * channels)
    count = out.shape[1]
    for y in range(first, last):
        near, all_x0, all_y0, all_fx, all_fy = locate_row(flow, y, corner, width, height, count)
        for x in range(count):
            inside[y, x] = near[x]
            x0, y0, fx, fy = int(all_x0[x]), int(all_y0[x]), all_fx[x], all_fy[x]
            x1, y1 = x0 + 1 if fx > 0 else x0, y0 + 1 if fy > 0 else y0
            # A fraction of 0 has the weights (0, 1, 0, 0): read the one sample that counts.
            before, after = (max(x0 - 1, 0), min(x1 + 1, width - 1)) if fx > 0 else (x0, x0)
            above, below = (max(y0 - 1, 0), min(y1 + 1, height - 1)) if fy > 0 else (y0, y0)
            columns = np.uintp(before) * column, np.uintp(x0) * column, np.uintp(x1) * column, np.uintp(after) * column
            rows = np.uintp(above) * row, np.uintp(y0) * row, np.uintp(y1) * row, np.uintp(below) * row
            wx, wy = _catmull_rom(fx), _catmull_rom(fy)
            here = (np.uintp(y) * np.uintp(count) + np.uintp(x)) * column
            if channels == 3 and x + 1 < count and rows[3] + columns[3] + np.uintp(3) < np.uintp(len(flat)):
                # Four values at once (SLP). The fourth is one of the next pixel, which is written after this one.
                red = _sample_bicubic(flat, np.uintp(0), columns, rows, wx, wy)
                green = _sample_bicubic(flat, np.uintp(1), columns, rows, wx, wy)
                blue = _sample_bicubic(flat, np.uintp(2), columns, rows, wx, wy)
                next_red = _sample_bicubic(flat, np.uintp(3), columns, rows, wx, wy)
                result[here], result[here + np.uintp(1)] = red, green
                result[here + np.uintp(2)], result[here + np.uintp(3)] = blue, next_red
            else:
                for c in range(column):
                    result[here + c] = _sample_bicubic(flat, c, columns, rows, wx, wy)


_KERNELS: dict[str, Callable[..., None]] = {"nearest": _nearest, "bilinear": _bilinear, "bicubic": _bicubic}


def warp(
    image: np.ndarray,
    flow: np.ndarray,
    *,
    interpolation: str = "bilinear",
    first_row: int = 0,
    out: np.ndarray | None = None,
) -> tuple[np.ndarray, np.ndarray]:
    """Sample an image, or a stack of any number of AOV channels, at the positions of a flow.

    Parameters
    ----------
    image : (H, W) or (H, W, C) float array
        Taken as float32. Remove NaN and Inf first: a non-finite pixel spreads to every pixel that samples it.
    flow : (H, W, 2) or (h, W, 2) float array, pixels, x right then y down; of all rows, or of some
    interpolation : str
        "bilinear"; "bicubic": Catmull-Rom clamped to the range of the four pixels around the position, so that it never
        rings (nor goes below zero) beside a firefly; or "nearest", which keeps the statistics of noise.
    first_row : int, the image's row that the first row of `flow` belongs to
    out : float32 array, optional, contiguous, for the result

    Returns
    -------
    warped : float32 array
        The warped image, in the shape of `image` less the rows without flow: `image[y + v, x + u]`; outside the frame
        the edge value.
    inside : (H, W) or (h, W) bool array
        x + u in [-0.5, W - 0.5], and y + v alike. False where the flow is not finite.

    Raises
    ------
    ValueError
        If the shapes do not agree, `out` is not contiguous float32, or `interpolation` is unknown.

    Notes
    -----
    Weights are exact float32 products. `cv2.remap` is not used because its bilinear weights are quantised
    to 1/32 px before OpenCV 5, its cubic (a = -0.75, unclamped) undershoots at HDR edges, and it refuses images of
    32767 px or more.

    References
    ----------
    Catmull, Rom: A class of local interpolating splines. 1974. doi:10.1016/B978-0-12-079050-0.50020-5
    """
    if interpolation not in _KERNELS:
        raise ValueError(f"interpolation is {interpolation!r}, expected one of {', '.join(_KERNELS)}")
    if image.ndim not in (2, 3) or image.size == 0:
        raise ValueError(f"image has shape {image.shape}, expected a non-empty (H, W) or (H, W, C)")
    (height, width), rows = image.shape[:2], image.shape[0] - first_row
    if flow.ndim != 3 or flow.shape[1:] != (width, 2) or not 0 < flow.shape[0] <= rows <= height:
        raise ValueError(f"flow has shape {flow.shape}, expected {(rows, width, 2)}")
    source = np.ascontiguousarray(image, np.float32).reshape(*image.shape[:2], -1)
    shape = flow.shape[:2]
    whole = *shape, *image.shape[2:]
    if out is not None and (out.shape != whole or out.dtype != np.float32 or not out.flags.c_contiguous):
        raise ValueError(f"out is {out.dtype} of shape {out.shape}, expected contiguous float32 of shape {whole}")
    result = np.empty(whole, np.float32) if out is None else out
    warped = result.reshape(*shape, source.shape[2])
    inside = np.empty(shape, np.bool_)
    vectors = np.ascontiguousarray(flow, np.float32)
    run_bands(_KERNELS[interpolation], shape[0], source, vectors, (first_row, 0), warped, inside)
    return result, inside


def warp_block(image: np.ndarray, flow: np.ndarray, corner: tuple[int, int]) -> tuple[np.ndarray, np.ndarray]:
    """Warp a float32 image (H, W, C) bilinearly to a block (h, w, 2) at `corner`, as `warp`, on the calling thread."""
    warped, inside = np.empty((*flow.shape[:2], image.shape[2]), np.float32), np.empty(flow.shape[:2], np.bool_)
    _bilinear(0, len(flow), image, flow, corner, warped, inside)
    return warped, inside
