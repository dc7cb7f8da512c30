"""How much of a frame may be worked on at a time, for a given amount of memory.

The frames of a window are held as a whole; what is made of them while they are aligned and filtered, which is several
times as much, only for some rows. So memory has a lower bound, and what is asked for below it is refused.
"""

from __future__ import annotations

import math
import re
from collections.abc import Collection

from hybrid.alignment.align import MARGIN, aligned_planes
from hybrid.alignment.prepare import prepared_planes
from hybrid.files.shots import Shot
from hybrid.oidn import HOLDS, HOLDS_FAST
from hybrid.stream import FirstPass, can_refine, kept_planes

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
    first_pass: FirstPass | None = None,
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
    first_pass : FirstPass, optional
        Of the shot.
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
    layers, neural = shot.layers(shot.numbers[0]), network is not None
    kept = kept_planes(shot, stages, first_pass, radius)
    # Reading: the file as it is, the frame as read, and the planes of its preparation.
    reading = len(shot.header(shot.numbers[0]).channel_names) + prepared_planes(layers) + PREPARING
    passing = max(reading, REFINING if can_refine(stages) else 0)
    # A first pass made of windows is filtered beside a network too.
    filtered = not neural or (first_pass is not None and first_pass.from_noisy)
    worked = 2.0 * (2 * radius + 1) * aligned_planes(layers) + (FILTERING if filtered else GIVING)
    plane = 4 * height * width
    base, code = (BASE, OIDN) if network is None else (BASE_NEURAL + network, OIDN_NEURAL)
    holds = 0 if first_pass is None else first_pass.holds
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
