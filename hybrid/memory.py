"""How much of a frame may be worked on at a time, for a given amount of memory.

The frames of a window are held as a whole; what is made of them while they are aligned and filtered, which is several
times as much, only for some rows. So memory has a lower bound, and what is asked for below it is refused.
"""

from __future__ import annotations

import math
import re
from collections.abc import Collection

from hybrid.alignment.align import MARGIN
from hybrid.files.layers import Layers
from hybrid.files.shots import Shot
from hybrid.oidn import HOLDS, HOLDS_FAST
from hybrid.stream import FirstPass

# Rows are taken in whole strips of the guided filter.
STRIP = 64
# What a process takes before it has read anything: Python, the libraries, the compiled code; and with torch.
BASE, BASE_NEURAL = 220 * 2**20, 470 * 2**20
# What OIDN takes: its code, most of which is there beside torch anyway; and for each pixel, up to its limit, while it
# runs in its slowest mode.
OIDN, OIDN_NEURAL, OIDN_OF_PIXEL = 230 * 2**20, 80 * 2**20, 750
# And of that, what stays when it has run.
CODE = 64 * 2**20
# Of the memory that was asked for; the allocator rounds up, and does not give all back at once.
SHARE = 0.97
# Planes that come and go while a frame is prepared, while rows of a window are filtered, and while they are given to a
# network.
PREPARING, FILTERING, GIVING = 14, 40, 12
# And while TV-L1 solves for a flow.
REFINING = 45
_UNITS = {"K": 2**10, "M": 2**20, "G": 2**30, "T": 2**40}


def parse_size(words: str) -> int:
    """Bytes of a size such as ``8G``, ``8GiB`` or ``500M``; units are powers of 1024.

    Raises
    ------
    ValueError
        If it is no size, has no unit, is nothing, or more than there is anywhere.
    """
    match = re.fullmatch(r"\s*(\d+(?:\.\d+)?)\s*([KMGT])(?:i?B)?\s*", words, re.IGNORECASE)
    size = 0.0 if match is None else float(match[1]) * _UNITS[match[2].upper()]
    if not 1 <= size < 2.0**63:
        shown = words if len(words) < 60 else f"{words[:56]}…"
        raise ValueError(f"max-memory is {shown!r}, expected a size with its unit, such as 8G or 500M")
    return int(size)


def plan_rows(
    limit: int,
    shot: Shot,
    stages: Collection[str],
    estimates: FirstPass | None = None,
    *,
    radius: int = 2,
    network: int | None = None,
    gathers: bool = False,
) -> int | None:
    """Find how many rows of a frame may be worked on at a time.

    Parameters
    ----------
    limit : int
        Bytes.
    shot : Shot
        Its headers are read.
    stages : collection of str
        Which may run on some frame.
    estimates : FirstPass, optional
        Where the estimates of single frames come from.
    radius : int
        Frames on each side of the centre.
    network : int, optional
        Bytes that the network takes while it runs; None where none does.
    gathers : bool
        Whether samples are gathered, and denoised by OIDN.

    Returns
    -------
    int or None
        Rows, a multiple of 64; None for all. The same for the same arguments, on every machine.

    Raises
    ------
    ValueError
        If not even the fewest rows fit; says how much is needed.

    Notes
    -----
    Counted in planes, one float32 for each pixel: what is kept of each frame, and what there is at once while a frame
    is prepared, written, or worked on. `benchmarks/bench_memory.py` measures whether it is kept.
    """
    height, width = shot.shape
    kept, passing, worked = _planes(shot, stages, estimates, radius, network is not None)
    plane = 4 * height * width
    base, code = (BASE, OIDN) if network is None else (BASE_NEURAL + network, OIDN_NEURAL)
    holds = 0 if estimates is None else estimates.holds
    if gathers:
        holds = max(holds, HOLDS_FAST)
        worked += 3 * (2 * radius + 1) + 18  # residuals, and what is gathered and made of it
    oidn = min(holds, code + OIDN_OF_PIXEL * height * width * holds // HOLDS)

    def needed(rows: int) -> int:
        share = min(rows + 2 * MARGIN, height) / height
        # Estimates are made while frames are prepared; what is gathered is denoised while rows are worked on.
        at_once = max(plane * passing + oidn, plane * worked * share + (oidn if gathers else min(oidn, CODE)))
        return base + round(plane * kept + at_once)

    budget = round(SHARE * limit)
    if needed(height) <= budget:
        return None
    if needed(STRIP) > budget:
        least = math.ceil(100 * needed(STRIP) / SHARE / 2**30) / 100  # so much is enough
        raise ValueError(
            f"max-memory is {limit / 2**30:.2f} GiB, expected at least {least:.2f} GiB for {width}x{height} pixels"
        )
    rows = STRIP
    while needed(rows + STRIP) <= budget:
        rows += STRIP
    return rows


def _planes(
    shot: Shot, stages: Collection[str], estimates: FirstPass | None, radius: int, neural: bool
) -> tuple[float, float, float]:
    """Planes that are kept for a window; that come and go with a frame; and that are worked on for each row."""
    header, layers = shot.header(shot.numbers[0]), shot.layers(shot.numbers[0])
    frame = _planes_prepared(layers)
    reach = radius if estimates is None else estimates.reach(radius)
    frames = min(2 * reach + 1, shot.count)
    window = (2 * radius + 1) * _planes_aligned(layers)
    pictures = 3 if "stabilize" in stages else 1
    kept = frames * frame + _planes_of_flows(layers, stages, frames, radius) + pictures * _planes_written(layers)
    # Reading: the file as it is, the frame as read, and what its preparation takes. Writing: the file again.
    passing = max(len(header.channel_names) + frame + PREPARING, REFINING if _can_refine(stages) else 0)
    # Estimates that come from windows are filtered beside a network too.
    filtered = not neural or (estimates is not None and estimates.from_noisy)
    worked = 2.0 * window + (FILTERING if filtered else GIVING)
    return kept, passing, worked


def _planes_prepared(layers: Layers) -> float:
    """Count the float32 planes that a `PreparedFrame` of these layers holds, with its light."""
    given = (layers.albedo, layers.normal, layers.variance)
    motion = 0 if layers.motion is None else len(layers.motion.channels) + 0.5
    one_way = layers.motion_convention is not None and not layers.motion_convention.pair
    single = (layers.depth is not None and one_way) + (layers.alpha is not None)
    aovs = sum(len(layer.channels) for layer in (*layers.aovs.values(), *layers.pass_colors.values()))
    return 3 + 3 + 3 * sum(layer is not None for layer in given) + motion + single + aovs + 0.25  # validity: a byte


def _planes_aligned(layers: Layers) -> float:
    """Count the float32 planes that each frame of an `AlignedWindow` of these layers takes, with its estimate."""
    guides = 3 * (layers.albedo is not None) + 3 * (layers.normal is not None)
    return 3 + 3 + guides + _planes_written(layers) - 3 + 1


def _planes_written(layers: Layers) -> float:
    """Count the float32 planes that are made of a window: the color, and what is filtered along."""
    aovs = sum(len(layer.channels) for layer in layers.aovs.values())
    return 3 + aovs + (layers.alpha is not None)


def _planes_of_flows(layers: Layers, stages: Collection[str], frames: int, radius: int) -> float:
    """Count the float32 planes of the flows that a `FrameStream` keeps.

    Parameters
    ----------
    layers : Layers
        Of the shot: whether they have vectors.
    stages : collection of str
        That may run.
    frames : int
        Over which windows slide.
    radius : int
        Of the windows.

    Returns
    -------
    float
        Planes of the size of a frame, of four bytes a pixel.
    """
    if "warp" not in stages:
        return 0.0
    made = _can_refine(stages) or (layers.motion_convention is not None and not layers.motion_convention.pair)
    steps = 2 * (frames - 1) if made else 0  # the renderer's own are kept with the frames
    chains = 2 * (radius + 1) * max(radius - 1, 0)
    return (2 + 0.25) * (chains + steps)


def _can_refine(stages: Collection[str]) -> bool:
    """Whether flow may be solved for."""
    return bool({"refine", "dense-flow"} & {*stages})
