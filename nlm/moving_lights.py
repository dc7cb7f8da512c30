"""Bright pixels that move together without motion vectors: snow, rain, sparks."""

import itertools
from collections.abc import Mapping

import numpy as np

from loops.parallel import Floats, Mask, Places

# A bright pixel exceeds the picture by half of the light, and by eight robust deviations of the excess.
_ABOVE, _DEVIATIONS = 0.5, 8.0
_ROWS = 256  # about so many rows are taken for the median: all rows of 1920×1080 pixels cost 20 ms
LEAST, _MOST = 20, 0.05  # fewer bright pixels show no motion; a greater share of all pixels is noise
_REACH, _BLOCK = 32, 512  # search radius, pixels a frame, and side of the searched block
# This share of the bright pixels must share a motion, and more than chance by six deviations and eight pixels.
_SHARE, _SIGMAS, _MORE = 0.2, 6.0, 8
# Bright pixels that move within so many pixels of the surfaces' motion are highlights with noisy samples: added back as
# rendered they cost 2.5 dB of a pan over a bar with many lamps.
_APART = 2.5
_ALIKE = 2.0  # the same light differs by a factor of two at most
# Where this share of the bright pixels move together, the others are content too: hidden, or leaving the frame.
CONTENT = 0.6
# Motions to the frames before and after are opposite but for so many pixels. A drop three pixels long has five motions
# from one frame to the next, the edges of a thing hundreds.
_STEADY, _FEW = 1, 9


def find_bright(excess: Floats) -> Mask:
    """Find bright pixels (H, W) of the excess over a picture, relative to the light; none if too few or too many."""
    rows = excess[:: max(len(excess) // _ROWS, 1)]
    bulk = 1.4826 * float(np.median(np.abs(rows)))
    bright = excess > max(_ABOVE, _DEVIATIONS * bulk)
    count = np.count_nonzero(bright)
    return bright if LEAST <= count <= _MOST * bright.size else np.zeros_like(bright)


def shared_motions(here: Mask, there: Mask) -> list[tuple[int, int]]:
    """Find the motions, above one pixel, that many bright pixels of one frame share on the way to another.

    The cross-correlation of both masks counts the pixels of each motion. Independent bright pixels, N and M of A, give
    N M / A with Poisson's deviation.
    """
    rows, columns = (_busiest(here.sum(axis=1 - axis)) for axis in (0, 1))
    a, b = (mask[rows, columns].astype(np.float64) for mask in (here, there))
    if a.sum() < LEAST or b.sum() < LEAST:
        return []
    size = [length + _REACH for length in a.shape]
    counts = np.fft.irfft2(np.conj(np.fft.rfft2(a, size)) * np.fft.rfft2(b, size), size).round()
    steps = np.arange(-_REACH, _REACH + 1)
    counts = counts[np.ix_(steps % size[0], steps % size[1])]
    counts[_REACH - 1 : _REACH + 2, _REACH - 1 : _REACH + 2] = 0
    chance = a.sum() * b.sum() / a.size
    enough = max(chance + _SIGMAS * np.sqrt(chance) + _MORE, _SHARE * a.sum())
    return [(int(y) - _REACH, int(x) - _REACH) for y, x in np.argwhere(counts >= enough)]


def confirmed_by_neighbour(
    excess: Floats, bright: Mask, other_excess: Floats, other_bright: Mask, flow: Floats | None
) -> Mask:
    """Return the bright pixels (H, W) that another frame shows at the end of a shared motion other than the surfaces'.

    Parameters
    ----------
    excess, bright, other_excess, other_bright : (H, W) array, as for and from `find_bright`, of both frames
    flow : (H, W, 2) float32 or None, motion of surfaces to the other frame, pixels, x first; None: nothing moves
    """
    found = np.zeros_like(bright)
    for motion in shared_motions(bright, other_bright):
        found |= _confirmed(excess, bright, other_excess, other_bright, flow, motion)[0]
    return found


def passing_lights(
    excess: Floats, bright: Mask, others: Mapping[int, tuple[tuple[Floats, Mask], Floats | None]]
) -> tuple[Mask, tuple[int, int]]:
    """Find the bright pixels (H, W) that the frames before and after show along one steady motion, rows and columns.

    `excess` and `bright` are as for `confirmed_by_neighbour`, `others` maps −1 (the frame before) and 1, or one of
    these, to both there and the `flow` to it. Edges of moving objects are bright in the excess too. So there must be
    few shared motions, as edges share many, and a motion must be opposite in both frames, unless the pixel leaves the
    frame. Noise is seldom confirmed twice. The motion is that to the frame after that most pixels share.
    """
    motions = {
        time: [(time * y, time * x) for y, x in shared_motions(bright, other_bright)]
        for time, ((_, other_bright), _) in others.items()
    }
    if max(map(len, motions.values())) > _FEW:
        return np.zeros_like(bright), (0, 0)
    found, most, greatest = np.zeros_like(bright), (0, 0), 0
    for motion in dict.fromkeys(itertools.chain(*motions.values())):
        if any(all(np.abs(np.subtract(motion, other)).max() > _STEADY for other in some) for some in motions.values()):
            continue
        ends = ((*other, flow, (time * motion[0], time * motion[1])) for time, (other, flow) in others.items())
        seen = np.array([_confirmed(excess, bright, *end) for end in ends])
        lights = seen[:, 0].any(axis=0) & seen.any(axis=1).all(axis=0)
        found |= lights
        if (count := int(np.count_nonzero(lights))) > greatest:
            greatest, most = count, motion
    return bright if np.count_nonzero(found) >= CONTENT * np.count_nonzero(bright) else found, most


def trail_of(lights: Mask, motion: tuple[int, int], flow: Floats | None, reach: int) -> Mask:
    """Return the pixels (H, W) of a frame at which neighbours that are aligned with it show lights, or may do so.

    Farther neighbours may show lights that have come over the edge of the picture since the next one.

    Parameters
    ----------
    lights : (H, W) bool, in the next neighbour
    motion : (int, int), of the lights from the frame to that neighbour, rows and columns
    flow : (H, W, 2) float32 or None, of the surfaces from the frame to that neighbour, x first
    reach : int, how many neighbours there are in that direction
    """
    trail = np.zeros_like(lights)
    rows, columns = np.nonzero(lights)
    own = np.zeros((1, 2), np.float32) if flow is None else flow[rows, columns]
    for time in range(1, reach + 1):
        y = np.rint(rows + (time - 1) * motion[0] - time * own[:, 1])
        x = np.rint(columns + (time - 1) * motion[1] - time * own[:, 0])
        inside = (y >= 0) & (y < lights.shape[0]) & (x >= 0) & (x < lights.shape[1])
        trail[y[inside].astype(int), x[inside].astype(int)] = True
    y, x = np.ogrid[: lights.shape[0], : lights.shape[1]]
    own = np.zeros((1, 1, 2), np.float32) if flow is None else flow
    for time in range(2, reach + 1):
        before_y = y - (time - 1) * motion[0] + time * own[..., 1]
        before_x = x - (time - 1) * motion[1] + time * own[..., 0]
        trail |= (before_y < 0) | (before_y >= len(y)) | (before_x < 0) | (before_x >= x.size)
    return trail


def _confirmed(
    excess: Floats, bright: Mask, other_excess: Floats, other_bright: Mask, flow: Floats | None, motion: tuple[int, int]
) -> tuple[Mask, Mask]:
    """Return the bright pixels that another frame shows at the end of a motion (rows, columns), and those leaving."""
    (down, right), (height, width) = motion, bright.shape
    found, left = np.zeros((2, *bright.shape), bool)
    rows, columns = np.nonzero(bright)
    y, x = rows + down, columns + right
    inside = (y >= 0) & (y < height) & (x >= 0) & (x < width)
    left[rows[~inside], columns[~inside]] = True
    own = np.zeros((1, 2), np.float32) if flow is None else flow[rows, columns]
    inside &= np.hypot(*(own - np.array([right, down], np.float32)).T) > _APART
    y, x, from_y, from_x = y[inside], x[inside], rows[inside], columns[inside]
    here, there = excess[from_y, from_x], other_excess[y, x]
    alike = other_bright[y, x] & (there <= _ALIKE * here) & (here <= _ALIKE * there)
    found[from_y[alike], from_x[alike]] = True
    return found, left


def _busiest(counts: Places) -> slice:
    """Return the `_BLOCK` rows or columns with the most bright pixels."""
    length = min(_BLOCK, len(counts))
    sums = np.convolve(counts, np.ones(length), "valid")
    first = int(np.argmax(sums))
    return slice(first, first + length)
