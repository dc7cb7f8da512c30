"""How many rows of a frame may be worked on at a time, for a given amount of memory.

The frames of a window are held as a whole; the planes of alignment and filters, several times as many, only for some
rows. Memory therefore has a lower bound, below which a run is refused.
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
# Bytes of a process that has read nothing: Python, the libraries, the compiled code; and with torch.
BASE, BASE_NEURAL = 220 * 2**20, 470 * 2**20
# Bytes of OIDN: its code, most of which torch loads anyway; and for each pixel, up to its limit, in its slowest mode.
OIDN, OIDN_NEURAL, OIDN_OF_PIXEL = 230 * 2**20, 80 * 2**20, 750
# The part of it that stays when OIDN has run.
CODE = 64 * 2**20
# Share of the limit that is planned for; the allocator rounds up, and does not return all memory at once: at 960×540
# the peak is 4 % above the plan.
SHARE = 0.94
# Temporary planes while a frame is prepared, while rows of a window are filtered, and while a network reads them.
PREPARING, FILTERING, GIVING = 14, 40, 12
# Temporary planes while TV-L1 solves for a flow.
REFINING = 45
_UNITS = {"K": 2**10, "M": 2**20, "G": 2**30, "T": 2**40}


def parse_size(words: str) -> int:
    """Bytes of a size such as ``8G``, ``8GiB`` or ``500M``; units are powers of 1024.

    Raises ValueError if it is no size, has no unit, is nothing, or more than there is anywhere.
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
    pools: bool = False,
) -> int | None:
    """Find how many rows of a frame may be worked on at a time: a multiple of 64, or None for all.

    The result is the same for the same arguments, on every machine. `stages` are those that may run on some frame,
    `network` the bytes that a network takes while it runs; with `pools` samples are pooled and denoised by OIDN. Raises
    ValueError, with what is needed, if not even the fewest rows fit.

    Counted in planes of one float32 a pixel: planes kept for a window, and the most that exist at once while a frame is
    prepared, written or worked on. `tests/reliability/test_memory.py` measures the true peak.
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
    if pools:
        holds = max(holds, HOLDS_FAST)
        worked += 3 * (2 * radius + 1) + 18  # residuals, pooled samples and their average
    oidn = min(holds, code + OIDN_OF_PIXEL * height * width * holds // HOLDS)

    def needed(rows: int) -> int:
        share = min(rows + 2 * MARGIN, height) / height
        # A first pass is made while frames are prepared; pooled samples are denoised while rows are worked on.
        at_once = max(plane * passing + oidn, plane * worked * share + (oidn if pools else min(oidn, CODE)))
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
