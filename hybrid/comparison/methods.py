"""Denoisers that `ravg compare` runs, from a shot to denoised frames: parts of ravg, alone and together, and OIDN."""

from collections.abc import Callable, Iterator, Mapping, Sequence
from dataclasses import dataclass, field, replace
from functools import lru_cache, partial
from typing import TYPE_CHECKING, Any, Literal

import numpy as np

from flow.tvl1 import refine_flow
from hybrid.alignment.guides import GuideFilter
from hybrid.alignment.window import AlignedWindow
from hybrid.denoising.first_pass import (
    NETWORKS,
    OIDN_MODE_OF_NETWORKS,
    Backends,
    denoise_frame_oidn,
    named_first_pass,
    read_denoised,
)
from hybrid.denoising.oidn import Quality
from hybrid.denoising.plan import Rules
from hybrid.denoising.pseudo_reference import CLASSICAL_PRESETS, filter_window, gated_average
from hybrid.denoising.stabilize import FrameDenoiser
from hybrid.denoising.stream import FrameStream
from hybrid.files.frame import Array, Frames, MappedShot
from hybrid.files.shots import Shot
from nlm.average import average, replace_nonfinite, robust_average

if TYPE_CHECKING:
    from hybrid.neural.network_denoiser import NetworkDenoiser

Run = Callable[[Frames], Iterator[tuple[int, Array]]]
Maps = Callable[[Frames, Sequence[int]], Iterator[tuple[int, dict[str, Array]]]]
WindowFilter = Callable[[AlignedWindow], Array]  # to (H, W, 3) radiance


@dataclass(frozen=True)
class Method:
    # from a shot to (number, (H, W, 3) radiance) of each of its frames. It runs in another process and must be
    # picklable. An `ImportError` lists the method as absent.
    run: Run
    family: str  # methods of one family share color and marker on the chart
    # from a shot and frame numbers to (number, (H, W) maps in [0, 1] by title), for the report
    maps: Maps | None = None
    # "measured"; "free": the frames exist before any method runs; "unknown": another program made the frames
    cost: Literal["measured", "free", "unknown"] = "measured"
    threads: int = 0  # limit on the number of threads; 0: no limit
    seconds: float | None = None  # per frame, of "unknown" cost, as its user states them
    given: Shot | None = None  # frames that another denoiser has written: they are checked before any method runs
    # shown in the report; in a sweep, the settings that differ from those of `base`
    settings: Mapping[str, object] = field(default_factory=dict)
    # the setting that is varied, and the method that is varied
    sweep: str = ""
    base: str = ""


def noisy(shot: Frames) -> Iterator[tuple[int, Array]]:
    """Yield the frames as rendered, non-finite pixels replaced as in the pipeline."""
    for number in shot.numbers:
        yield number, replace_nonfinite(shot.read(number).color)[0]


def finished(shot: Frames, *, other: Shot) -> Iterator[tuple[int, Array]]:
    """Yield the frames that another denoiser has written (`hybrid.denoising.first_pass.read_denoised`)."""
    for number in shot.numbers:
        if other.has(number):
            yield number, read_denoised(other, number)


def external(other: Shot, seconds: float | None = None) -> Method:
    """Return a finished sequence as a method, with its seconds per frame if these are known."""
    return Method(partial(finished, other=other), "External", cost="unknown", seconds=seconds, given=other)


@dataclass(frozen=True)
class WindowSettings:
    """How windows are aligned: radius, source of the first pass, forced stages, vectors, settings of TV-L1."""

    radius: int = 2
    source: str = "none"
    rules: Rules = field(default_factory=Rules)
    vectors: bool = True  # whether the renderer's are read
    solver: Mapping[str, Any] = field(default_factory=dict)  # of TV-L1, which runs then

    def stream(self, shot: Frames, filter_guides: GuideFilter | None = None, reads_guides: bool = True) -> FrameStream:
        frames = shot
        if not self.vectors:
            frames = MappedShot(shot, lambda frame: replace(frame, motion=None, motion_convention=None))
        rules = replace(self.rules, on=self.rules.on | {"refine"}) if self.solver else self.rules
        backends = Backends()
        if self.source == "bundled":
            from hybrid.neural import denoise_bundled  # torch may be absent

            backends = Backends(bundled=denoise_bundled)
        chosen = named_first_pass(self.source, mode=OIDN_MODE_OF_NETWORKS, backends=backends)
        refine = partial(refine_flow, **self.solver)
        return FrameStream(
            frames,
            rules,
            chosen.first_pass,
            radius=self.radius,
            refine=refine,
            filter_guides=filter_guides,
            reads_guides=reads_guides,
        )


@dataclass(frozen=True)
class Classical:
    denoise: WindowFilter
    window: WindowSettings = field(default_factory=WindowSettings)

    def __call__(self, shot: Frames) -> Iterator[tuple[int, Array]]:
        stream = self.window.stream(shot)
        for number in shot.numbers:
            denoised, frame = self.denoise(stream.align(number)), stream.frame(number)
            assert frame is not None
            yield number, frame.with_filter(denoised)

    def maps(self, shot: Frames, numbers: Sequence[int]) -> Iterator[tuple[int, dict[str, Array]]]:
        stream = self.window.stream(shot)
        for number in numbers:
            yield number, window_maps(stream.align(number), self.denoise)


@dataclass(frozen=True)
class Network:
    """Denoise with a preset's weights and windows of its radius; others are options of `hybrid.neural.open_network`."""

    preset: str
    window: WindowSettings = field(default_factory=WindowSettings)
    tile: int | None = None
    precision: str = "auto"
    threshold: float | None = None

    def __call__(self, shot: Frames) -> Iterator[tuple[int, Array]]:
        denoiser = _denoiser(self.preset, self.tile, self.precision, self.threshold)
        frames = FrameDenoiser(self._stream(shot, denoiser), denoiser)
        for number in shot.numbers:
            yield number, frames.make(number).denoised.color

    def maps(self, shot: Frames, numbers: Sequence[int]) -> Iterator[tuple[int, dict[str, Array]]]:
        """Yield number and `window_maps` of some frames, in float32: differences of runs must exceed rounding."""
        denoiser = _denoiser(self.preset, None, "float32", None)
        stream = self._stream(shot, denoiser)
        for number in numbers:
            yield number, window_maps(stream.align(number), lambda window: denoiser(window).color)

    def _stream(self, shot: Frames, denoiser: "NetworkDenoiser") -> FrameStream:
        return replace(self.window, radius=denoiser.radius).stream(shot, denoiser.filter_guides, denoiser.reads_guides)


@lru_cache(maxsize=1)
def _denoiser(preset: str, tile: int | None, precision: str, threshold: float | None) -> "NetworkDenoiser":
    """A network with the weights of a preset, loaded once."""
    from hybrid import neural  # torch may be absent

    return neural.open_network(neural.find_weights(preset), tile=tile, precision=precision, threshold=threshold)


def aligned_average(aligned: AlignedWindow) -> Array:
    """Average over time, weighted by confidence."""
    return average(aligned.color, aligned.confidence) * aligned.modulation


def aligned_robust_average(aligned: AlignedWindow) -> Array:
    """Average over time, without the darkest and the brightest frame of each pixel."""
    return robust_average(aligned.color, aligned.confidence) * aligned.modulation


def window_maps(aligned: AlignedWindow, denoise: WindowFilter) -> dict[str, Array]:
    """Map (H, W), in [0, 1], the confidence in the neighbours of a window, and their contribution to a result.

    "Confidence" is the mean over the neighbours; "Temporal contribution" the fraction of the result that comes from the
    neighbours: the relative change of the result for a relative change of the neighbours' light. For a
    weighted mean that is the fraction of their weight in the light, and it is defined for any denoiser.
    """
    is_neighbour = np.arange(len(aligned.confidence)) != aligned.middle
    # Small enough to change no decision, and far above the rounding of float32.
    step = np.float32(1 / 256)
    gain = 1 + np.where(is_neighbour, step, 0).astype(np.float32)[:, None, None, None]
    first_pass = None if aligned.first_pass is None else aligned.first_pass * gain
    brighter = replace(aligned, aligned_color=aligned.color * gain, first_pass=first_pass)
    before, after = (denoise(window).mean(axis=-1) for window in (aligned, brighter))
    change = step * before  # underflows where the result is almost black
    contribution = np.divide(after - before, change, out=np.zeros_like(before), where=change > 0)
    return {
        "Confidence": aligned.confidence[is_neighbour].mean(axis=0),
        "Temporal contribution": np.clip(contribution, 0, 1).astype(np.float32),
    }


def oidn(shot: Frames, *, quality: Quality = "high", prefilter: Quality | None = None) -> Iterator[tuple[int, Array]]:
    """Run OIDN on each frame by itself; settings as for `hybrid.denoising.oidn.denoise_oidn`."""
    for number in shot.numbers:
        yield number, denoise_frame_oidn(shot.read(number), quality=quality, prefilter=prefilter)


def oidn_then_average(shot: Frames) -> Iterator[tuple[int, Array]]:
    """Run OIDN's best mode on each frame, then take the aligned robust average of the results."""
    best = partial(denoise_frame_oidn, prefilter="high")
    denoised = MappedShot(shot, lambda frame: replace(frame, color=best(frame), variance=None))
    stream = FrameStream(denoised, Rules(off=frozenset({"whiten"})))
    for number in shot.numbers:
        yield number, aligned_robust_average(stream.align(number))


def _aligned(family: str, denoise: WindowFilter, source: str = "none", **settings: object) -> Method:
    run = Classical(denoise, WindowSettings(source=source))
    first_pass = {} if source == "none" else {"first pass": source}
    return Method(run, family, run.maps, settings={"window": 2 * run.window.radius + 1, **first_pass, **settings})


def _network(preset: str, source: str) -> Method:
    run = Network(preset, WindowSettings(source=source))
    return Method(run, "Networks", run.maps, settings={"weights": preset, "first pass": source})


def _oidn(quality: Quality, prefilter: Quality | None = None) -> Method:
    guides = "prefiltered, cleanAux" if prefilter else "as given"
    run = partial(oidn, quality=quality, prefilter=prefilter)
    return Method(run, "OIDN", settings={"quality": quality, "guides": guides})


_CLASSICAL = {
    name: _aligned(
        "Pseudo-references",
        partial(filter_window, preset=preset),
        **{key.replace("_", " "): value for key, value in vars(preset).items() if key != "name"},
    )
    for name, preset in CLASSICAL_PRESETS.items()
}

METHODS: dict[str, Method] = {
    "noisy": Method(noisy, "Input", cost="free"),
    "aligned average": _aligned("Averages", aligned_average),
    "aligned robust average": _aligned("Averages", aligned_robust_average),
    **_CLASSICAL,
    "gated": _aligned("Gated averages", gated_average, source="nlm"),
    "gated OIDN fast": _aligned("Gated averages", gated_average, source="oidn-fast"),
    "gated OIDN": _aligned("Gated averages", gated_average, source="oidn"),
    "fast without OIDN": _network("fast", "bundled"),
    **{preset: _network(preset, OIDN_MODE_OF_NETWORKS) for preset in NETWORKS},
    "RA": _network("ra", "none"),
    "tKPCN": _network("tkpcn", "none"),
    "OIDN fast": _oidn("fast"),
    "OIDN high": _oidn("high"),
    "OIDN balanced": _oidn("balanced"),
    "OIDN best": _oidn("high", prefilter="high"),
    "OIDN balanced + clean guides": _oidn("balanced", prefilter="balanced"),
    "OIDN best + robust average": Method(oidn_then_average, "OIDN"),
}
# Those that run where none is named.
DEFAULTS = ("noisy", "OIDN high", "OIDN best", "balanced", "quality")
