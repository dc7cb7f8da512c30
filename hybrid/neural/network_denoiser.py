"""Shared parts of running networks on aligned windows: device, precision, tiles, breakdown."""

from abc import abstractmethod
from collections.abc import Callable, Mapping
from dataclasses import dataclass
from typing import Any, NamedTuple

import numpy as np
import torch

from hybrid.alignment.window import AlignedWindow
from hybrid.denoising.breakdown import Breakdown, layers_of, stage_layers
from hybrid.denoising.first_pass import Backends
from hybrid.denoising.stabilize import WindowDenoiser
from hybrid.files.frame import Array
from hybrid.neural.oidn_networks import denoise_bundled, first_pass_memory, torch_backend
from hybrid.neural.tiling import Block, image_of, tiles
from hybrid.runtime.timing import Timings


@dataclass(frozen=True)
class Setup:
    """Device, precision and outputs of a network."""

    device: str
    torch_device: torch.device
    bfloat16: bool
    exact: bool  # whether float32 was asked for
    tile: int | None
    add_layers: bool  # whether the image is the sum of its light passes
    breakdown: Breakdown | None
    timings: Timings


class Tile(NamedTuple):
    """Result of a network on a tile: ``(1, C, H, W)`` irradiance and AOVs, and a function for the frames' parts."""

    irradiance: torch.Tensor
    aovs: torch.Tensor | None
    parts: Callable[[], tuple[torch.Tensor, torch.Tensor]]


class Result(NamedTuple):
    """Result of a network on a window: irradiance (H, W, 3), AOVs (H, W, C), parts of the frames (T, H, W, 4)."""

    irradiance: Array
    aovs: Array
    parts: Array | None


class NetworkDenoiser(WindowDenoiser):
    """A network and its `Setup`."""

    packages = ("torch",)
    halo: int  # pixels of context around a tile
    default_tile: int  # default side of a tile, pixels
    threshold: float | None = None  # threshold of predicted kernels, where it is not that of the training

    def __init__(self, model: Any, setup: Setup, bytes_per_pixel: int) -> None:
        self.model = model.to(setup.torch_device)
        self.setup, self.tile = setup, setup.tile or self.default_tile
        self._bytes_per_pixel = bytes_per_pixel  # of a tile, in bfloat16; float32 takes twice as many

    @property
    def radius(self) -> int:
        return int(self.model.frames // 2)

    @property
    def settings(self) -> Mapping[str, object]:
        precision = "bfloat16" if self.setup.bfloat16 else "float32"
        return {"tile": self.tile, "threshold": self.threshold, "precision": precision}

    @property
    def devices(self) -> Mapping[str, str]:
        return {"network": self.setup.device}

    @property
    def backends(self) -> Backends:
        """Functions for the first pass: OIDN's networks in torch, and a network that ships with ravg."""
        return Backends(torch_backend(self.setup.device, exact=self.setup.exact), denoise_bundled, first_pass_memory)

    def memory(self, shape: tuple[int, int]) -> int:
        """Bytes that the network takes while it runs on frames of this height and width, beside its weights."""
        height, width = (min(side, self.tile + 2 * self.halo) for side in shape)
        return self._bytes_per_pixel * height * width * (1 if self.setup.bfloat16 else 2)

    @abstractmethod
    def _run_tile(self, aligned: AlignedWindow, window: Any, outer: Block) -> Tile:
        """Run the network on a tile of a window."""

    def _run(self, aligned: AlignedWindow, window: Any, aovs: Array, black: bool = False) -> Result:
        """Run the network tile by tile; `aovs` are the centre's (H, W, C), used where nothing varies or is lit."""
        frames, height, width = aligned.confidence.shape
        filtered, irradiance = np.empty_like(aovs), np.empty((0, 0, 3), np.float32)
        parts = None if self.setup.breakdown is None else np.zeros((frames, height, width, 4), np.float32)
        for inner, outer, offset in tiles(aligned.inner, height, width, self.tile, self.halo, self.model.multiple):
            # Without variance in time and space, not even by rounding, the pixel is the mean.
            skipped = black or ("skip" in aligned.stages and not aligned.variance[outer].any())
            with torch.inference_mode():
                tile = None if skipped else self._run_tile(aligned, window, outer)
            if not irradiance.size:  # not before: while a network runs, memory is at its fullest
                irradiance = np.zeros_like(aligned.centre.irradiance)  # rows without tiles are not read
            if tile is None:
                irradiance[inner], filtered[inner] = aligned.centre.irradiance[inner], aovs[inner]
                if parts is not None:
                    weight = np.ones_like(irradiance[inner][..., :1])
                    parts[aligned.middle][inner] = np.dstack([irradiance[inner], weight])
                continue
            with torch.inference_mode():
                irradiance[inner] = image_of(tile.irradiance)[offset]
                if tile.aovs is not None:
                    filtered[inner] = image_of(tile.aovs)[offset]
                if parts is not None:
                    contributions = torch.cat(tile.parts(), 2)[0].permute(0, 2, 3, 1).cpu().numpy()
                    parts[:, *inner] = contributions[:, *offset]
        return Result(irradiance, filtered, parts)

    def _count_parts(self, aligned: AlignedWindow, result: Result) -> dict[str, Array]:
        """Count the frames' weights, and make layers of weights and contributions."""
        if self.setup.breakdown is None or result.parts is None:
            return {}
        contributions, weights = result.parts[..., :3] * aligned.modulation, result.parts[..., 3]
        self.setup.breakdown.add(weights)
        return layers_of(contributions, weights) | stage_layers(aligned, result.irradiance)


def exposure_of(aligned: AlignedWindow) -> torch.Tensor:
    """Brightness of a window, (1,), as networks get it in training and in running."""
    return torch.tensor([aligned.brightness.exposure], dtype=torch.float32)
