"""Denoisers that `ravg compare` runs, from a shot to denoised frames: parts of ravg, alone and together, and OIDN."""

from collections.abc import Callable, Iterator, Mapping
from dataclasses import dataclass, field, replace
from functools import lru_cache, partial
from typing import TYPE_CHECKING, Literal

from hybrid.alignment.window import AlignedWindow
from hybrid.denoising.denoisers import open_stream
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
WindowFilter = Callable[[AlignedWindow], Array]  # to (H, W, 3) radiance


@dataclass(frozen=True)
class Method:
    # from a shot to (number, (H, W, 3) radiance) of each of its frames. It runs in another process and must be
    # picklable. An `ImportError` lists the method as absent.
    run: Run
    family: str  # methods of one family share color and marker on the chart
    # "measured"; "free": the frames exist before any method runs; "unknown": another program made the frames
    cost: Literal["measured", "free", "unknown"] = "measured"
    seconds: float | None = None  # per frame, of "unknown" cost, as its user states them
    given: Shot | None = None  # frames that another denoiser has written: they are checked before any method runs
    settings: Mapping[str, object] = field(default_factory=dict)  # shown in the report


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


def _stream(shot: Frames, first_pass: str, denoiser: "NetworkDenoiser | None" = None) -> FrameStream:
    """The windows of a shot, with the first pass of this name, as a network reads them or without one."""
    backends = Backends()
    if first_pass == "bundled":
        from hybrid.neural import denoise_bundled  # torch may be absent

        backends = Backends(bundled=denoise_bundled)
    source = named_first_pass(first_pass, mode=OIDN_MODE_OF_NETWORKS, backends=backends)
    if denoiser is None:
        return FrameStream(shot, Rules(), source.first_pass)
    return open_stream(shot, Rules(), source.first_pass, denoiser)


def filtered(shot: Frames, *, denoise: WindowFilter, first_pass: str = "none") -> Iterator[tuple[int, Array]]:
    """Yield the frames as a filter makes them of their aligned windows."""
    stream = _stream(shot, first_pass)
    for number in shot.numbers:
        denoised, frame = denoise(stream.align(number)), stream.frame(number)
        assert frame is not None
        yield number, frame.with_filter(denoised)


def network(shot: Frames, *, preset: str, first_pass: str) -> Iterator[tuple[int, Array]]:
    """Denoise with the weights of a preset, and windows of its radius."""
    denoiser = _denoiser(preset)
    frames = FrameDenoiser(_stream(shot, first_pass, denoiser), denoiser)
    for number in shot.numbers:
        yield number, frames.make(number).denoised.color


@lru_cache(maxsize=1)
def _denoiser(preset: str) -> "NetworkDenoiser":
    """A network with the weights of a preset, loaded once."""
    from hybrid import neural  # torch may be absent

    return neural.open_network(neural.find_weights(preset))


def aligned_average(aligned: AlignedWindow) -> Array:
    """Average over time, weighted by confidence."""
    return average(aligned.color, aligned.confidence) * aligned.modulation


def aligned_robust_average(aligned: AlignedWindow) -> Array:
    """Average over time, without the darkest and the brightest frame of each pixel."""
    return robust_average(aligned.color, aligned.confidence) * aligned.modulation


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


def _aligned(family: str, denoise: WindowFilter, first_pass: str = "none", **settings: object) -> Method:
    run = partial(filtered, denoise=denoise, first_pass=first_pass)
    named = {} if first_pass == "none" else {"first pass": first_pass}
    return Method(run, family, settings={"window": 5, **named, **settings})


def _network(preset: str, first_pass: str) -> Method:
    run = partial(network, preset=preset, first_pass=first_pass)
    return Method(run, "Networks", settings={"weights": preset, "first pass": first_pass})


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
    "gated": _aligned("Gated averages", gated_average, first_pass="nlm"),
    "gated OIDN fast": _aligned("Gated averages", gated_average, first_pass="oidn-fast"),
    "gated OIDN": _aligned("Gated averages", gated_average, first_pass="oidn"),
    "fast without OIDN": _network("fast", "bundled"),
    **{preset: _network(preset, OIDN_MODE_OF_NETWORKS) for preset in NETWORKS},
    "RA": _network("ra", "none"),
    "tKPCN": _network("tkpcn", "none"),
    "RA multiscale": _network("multiscale", "none"),
    "OIDN fast": _oidn("fast"),
    "OIDN high": _oidn("high"),
    "OIDN balanced": _oidn("balanced"),
    "OIDN best": _oidn("high", prefilter="high"),
    "OIDN balanced + clean guides": _oidn("balanced", prefilter="balanced"),
    "OIDN best + robust average": Method(oidn_then_average, "OIDN"),
}
# Those that run where none is named.
DEFAULTS = ("noisy", "OIDN high", "OIDN best", "balanced", "quality")
