"""How many rows of a frame may be worked on at a time, for a given amount of memory, and where frames are kept.

Frames of a window lie in memory, or in temporary files; the planes of alignment and filters exist for some rows only. A
frame is read, prepared and finished as a whole: memory therefore has a lower bound, below which a run is refused.
"""

import math
import re
from collections.abc import Callable, Collection
from typing import NamedTuple

from hybrid.alignment.align import MARGIN, aligned_planes
from hybrid.alignment.prepare import prepared_planes
from hybrid.denoising.oidn import HOLDS
from hybrid.denoising.stream import FirstPass, can_refine, kept_planes
from hybrid.files.layers import Layers
from hybrid.files.shots import Shot
from loops.parallel import STRIP

MIB = 2**20
# Share of the limit that is planned for; the allocator rounds up, and does not return all memory at once: at 960×540
# the peak is 4 % above the plan.
SHARE = 0.94
# Temporary planes of the fullest steps: pairs of frames are compared before a run (4.9 GiB at 7680×4320), TV-L1 solves
# for a flow, rows of a window are filtered, samples correct a finished picture. A network takes its own memory beside
# `BESIDE_NETWORK` planes.
WORKING, BESIDE_NETWORK = 40, 24


def parse_size(text: str) -> int:
    """Bytes of a size such as ``8G``, ``8GiB`` or ``500M``, in powers of 1024; ValueError if it is none, or absurd."""
    match = re.fullmatch(r"\s*(\d+(?:\.\d+)?)\s*([KMGT])(?:i?B)?\s*", text, re.IGNORECASE)
    size = 0.0 if match is None else float(match[1]) * 2.0 ** (10 + 10 * "KMGT".index(match[2].upper()))
    if not 1 <= size < 2.0**63:
        shown = text if len(text) < 60 else f"{text[:56]}…"
        raise ValueError(f"max-memory is {shown!r}, expected a size with its unit, such as 8G or 500M")
    return int(size)


class MemoryPlan(NamedTuple):
    """How a run stays within its limit."""

    rows: int | None = None  # of a frame that are worked on at a time, a multiple of 64; None for all
    # whether the values that later windows read lie in temporary files, and freed memory is returned to the system
    in_files: bool = False
    background: bool = True  # whether the next frame is read, and the last one written, while a frame is worked on


def plan_memory(
    limit: int,
    shot: Shot,
    stages: Collection[str],
    first_pass: FirstPass | None = None,
    *,
    radius: int = 2,
    network: Callable[[tuple[int, int]], int | None] = lambda _: None,
    first_network: Callable[[tuple[int, int]], int] = lambda _: 0,
    filters_guides: bool = False,
) -> MemoryPlan:
    """Plan a run: whole frames in memory if they fit, else with kept values in files, and as many rows as then fit.

    With memory to spare a frame is read and one is written in the background: 0.93 of the time of `fast` at 1920×1080.
    `fast` there takes 1.18 times the CPU time with files and freed memory returned (two runs).
    The result is the same for the same arguments, on every machine. `stages` are those that may run on some frame,
    `network` maps height and width to the bytes that a network takes while it runs, `first_network` to those of one
    that makes a first pass; with `filters_guides` the guides of frames are filtered for a network. Raises ValueError,
    with the least memory, if not even the fewest rows fit.

    Counted in planes of one float32 a pixel: planes kept for a window, and the most that exist at once while a frame is
    prepared, finished or worked on. `tests/reliability/test_memory.py` measures the true peak.
    """
    height, width = shot.shape
    plane, network_bytes = 4 * height * width, network(shot.shape)
    layers, neural = shot.layers(shot.numbers[0]), network_bytes is not None
    kept = kept_planes(shot, stages, first_pass, radius, filters_guides=filters_guides)
    # The frame as read, with the file that it is read from, or with what is prepared of it.
    prepared = prepared_planes(layers)
    channels = len(shot.header(shot.numbers[0]).channel_names)
    reading = prepared + max(channels, prepared)
    # The next frame as read, the last one with its result, and the channels of a file for either.
    beside = 2 * prepared + 2 * channels
    # A first pass made of windows is filtered beside a network too.
    filtered = not neural or (first_pass is not None and first_pass.from_noisy)
    worked, aligned = _worked_planes(layers, 2 * radius + 1, filtered)
    if "reflections" in stages and first_pass is not None:
        # The flows of light, and first passes along surfaces beside those along light.
        aligned += 7.0 * (2 * radius + 1)
    # Python, the libraries and the compiled code; with torch more, and then less for OIDN, whose code torch has loaded.
    base, code = (470 * MIB, 80 * MIB) if neural else (220 * MIB, 230 * MIB)
    holds = 0 if first_pass is None else first_pass.holds
    oidn = min(holds, code + 750 * height * width * holds // HOLDS)  # bytes of each pixel in its slowest mode
    # OIDN filters the guides of a frame in 60 planes of float32.
    guides = 60 if filters_guides and "clean-guides" in stages else 0

    def needed(rows: int, in_files: bool, background: bool = False) -> int:
        share = min(rows + 2 * MARGIN, height) / height
        # From files the centre and one neighbour are read at a time (`hybrid.runtime.kept.Keeper.release`), and by a
        # network few rows of the neighbour.
        held, read = (0.0, prepared + 3) if in_files else (kept, 0.0)
        # The features of a strip are as large in a band.
        working = plane * share * (worked + read * (1 if neural else 2)) + (network_bytes or 0)
        working = max(working, plane * share * (aligned + 2 * read))
        working += min(oidn, 64 * MIB)  # stays when OIDN has made the first pass of a frame
        # Bands leave free memory in more pieces: `fast` takes 1429 MiB at 1920×1080 in bands of 448 rows, in float32.
        working *= 1.1 if rows < height else 1
        # 14 planes of the frame beside the network of a first pass. With frames in memory the final stage takes more.
        first_passes = plane * 14 + first_network(shot.shape) if in_files else 0
        steps = max(reading, WORKING if can_refine(stages) else 0)
        at_once = max(plane * steps + oidn, first_passes, plane * max(guides, WORKING), working)
        held += beside if background else 0.0
        return base + round(plane * held + at_once)

    budget = round(SHARE * limit)
    # With kept frames in files `fast` takes no less time if others are read and written in the background.
    for in_files, background in ((False, True), (False, False), (True, False)):
        if needed(height, in_files, background) <= budget:
            return MemoryPlan(None, in_files, background)
    if needed(STRIP, True) > budget:
        least = math.ceil(100 * needed(STRIP, True) / SHARE / 2**30) / 100  # so much is enough
        raise ValueError(
            f"max-memory is {limit / 2**30:.2f} GiB, expected at least {least:.2f} GiB for {width}x{height} pixels"
        )
    rows = STRIP
    while needed(rows + STRIP, True) <= budget:
        rows += STRIP
    return MemoryPlan(rows, in_files=True, background=False)


def _worked_planes(layers: Layers, frames: int, filtered: bool) -> tuple[float, float]:
    """Count the float32 planes of an aligned window of so many frames, with what reads it, and while it is aligned."""
    if filtered:
        return 2.0 * frames * aligned_planes(layers) + WORKING, 0.0
    # A network reads the first pass, confidences and AOVs alone.
    aovs = layers.aov_channels
    # While it is aligned, also the confidence by geometry and the weights of drift.
    return frames * (4 + 2.0 * aovs) + BESIDE_NETWORK, frames * (6 + 2.0 * aovs) + BESIDE_NETWORK
