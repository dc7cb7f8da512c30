"""The interface of every denoiser of aligned windows, and the denoisers that need no network."""

from collections.abc import Mapping
from dataclasses import dataclass
from typing import ClassVar, Protocol

from hybrid.alignment.guides import GuideFilter
from hybrid.alignment.window import AlignedWindow
from hybrid.denoising.first_pass import Backends
from hybrid.denoising.pseudo_reference import ClassicalPreset, filter_window, gated_average
from hybrid.denoising.stabilize import Denoised
from hybrid.runtime.timing import Timings


class WindowDenoiser(Protocol):
    """A denoiser of aligned windows. Callers use nothing else, and never ask for the class."""

    needs_first_pass: ClassVar[bool] = True  # whether windows must hold a first pass
    guided: bool = True  # whether `AlignedWindow.guide` or its confidence by geometry is read where there are no AOVs
    reads_guides: bool = True  # whether windows' guides, or samples beside first passes, are read
    packages: ClassVar[tuple[str, ...]] = ()  # packages that pixels depend on

    @property
    def filter_guides(self) -> GuideFilter | None:
        """Function that filters a frame's albedo and normal, for networks that need them without noise."""
        return None

    @property
    def radius(self) -> int:
        """Frames on each side of the centre."""
        return 2

    @property
    def settings(self) -> Mapping[str, object]:
        """JSON values that pixels depend on; the header of each frame holds them."""
        return {}

    @property
    def devices(self) -> Mapping[str, str]:
        """Library → the device that it computes on."""
        return {}

    @property
    def backends(self) -> Backends:
        """Functions for the first pass."""
        return Backends()

    def memory(self, shape: tuple[int, int]) -> int | None:
        """Bytes that a network takes while it runs on frames of this height and width; None without a network."""
        return None

    def __call__(self, aligned: AlignedWindow) -> Denoised:
        """Denoise the centre of a window."""


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
