"""The denoisers of aligned windows that need no network, and the stream that gives a denoiser its windows."""

from dataclasses import dataclass
from typing import Any

from hybrid.alignment.window import AlignedWindow
from hybrid.denoising.plan import Rules
from hybrid.denoising.pseudo_reference import ClassicalPreset, filter_window, gated_average
from hybrid.denoising.stabilize import Denoised, WindowDenoiser
from hybrid.denoising.stream import FirstPass, FrameStream
from hybrid.files.frame import Frames
from hybrid.runtime.timing import Timings


def open_stream(
    shot: Frames, rules: Rules, first_pass: FirstPass | None, denoiser: WindowDenoiser, **options: Any
) -> FrameStream:
    """Return the windows of a shot as a denoiser reads them; `options` as for `FrameStream`."""
    return FrameStream(
        shot,
        rules,
        first_pass,
        radius=denoiser.radius,
        filter_guides=denoiser.filter_guides,
        reads_guides=denoiser.reads_guides,
        **options,
    )


@dataclass(frozen=True)
class ClassicalDenoiser(WindowDenoiser):
    """Average or non-local means over the window, then a guided filter (`pseudo_reference.filter_window`)."""

    preset: ClassicalPreset
    timings: Timings
    needs_first_pass = False

    def __call__(self, aligned: AlignedWindow) -> Denoised:
        return Denoised(filter_window(aligned, self.preset, timings=self.timings))


@dataclass(frozen=True)
class AverageDenoiser(WindowDenoiser):
    """The gated average of a first pass (`hybrid.denoising.pseudo_reference.gated_average`)."""

    timings: Timings
    reads_guides = False

    def __call__(self, aligned: AlignedWindow) -> Denoised:
        return Denoised(gated_average(aligned, timings=self.timings))
