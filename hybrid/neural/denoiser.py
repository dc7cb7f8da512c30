"""Running a network: an aligned window becomes tensors, tiles go through the network, a picture comes out.

HWC becomes NCHW here, for running, and for training alike.
"""

from __future__ import annotations

from collections.abc import Iterator
from copy import copy
from pathlib import Path

import cv2
import numpy as np
import torch
from numpy.typing import NDArray

import network
from hybrid.alignment.align import AlignedWindow
from hybrid.alignment.prepare import ALPHA
from hybrid.breakdown import Breakdown, layers_of, stage_layers
from hybrid.pipeline import Denoised
from hybrid.timing import Timings
from network.checkpoint import load_model
from network.devices import find_device
from network.models import denoise_tile, for_inference, window_length
from network.stabilizer import Stabilizer

Array = NDArray[np.float32]

# Pixels of context around a tile: what a network sees beyond them changes a picture by less than 1e-5 of its mean. The
# coarsest shares of a `Stabilizer`, of 32 pixels, see farthest.
HALO, HALO_OF_SHARES = 48, 128
# Sides of a tile: halos take half as much again at 1920×1080 with the first, and the second needs half of the memory.
TILE, SMALL_TILE = 640, 384
PRECISIONS = ("auto", "float32", "bfloat16")

Block = tuple[slice, slice]


def shipped_weights(preset: str) -> Path:
    """Path of the weights that come with the package.

    Raises
    ------
    ValueError
        If there is no such preset; names those there are.
    """
    folder = Path(network.__file__).parent / "weights"
    path = folder / f"{preset}.safetensors"
    if not path.is_file():
        known = ", ".join(sorted(p.stem for p in folder.glob("*.safetensors"))) or "none"
        raise ValueError(f"preset is {preset!r}, expected one of: {known}")
    return path


def has_bfloat16(device: torch.device) -> bool:
    """Whether a device computes in bfloat16 faster than in float32; a processor with AVX-512 bf16 or AMX."""
    if device.type != "cpu":
        return device.type == "cuda" and torch.cuda.is_bf16_supported(including_emulation=False)
    capabilities = torch.cpu.get_capabilities() if hasattr(torch.cpu, "get_capabilities") else {}
    return bool(capabilities.get("avx512_bf16") or capabilities.get("amx_bf16"))


class Denoiser:
    """Runs a Robust Average network on aligned windows; an estimator for `hybrid.pipeline.denoise_frames`.

    Parameters
    ----------
    weights : Path
        A file written by training.
    tile : int
        Side of the squares that the network sees at once, pixels; a halo is added around each.
    precision : str
        One of `PRECISIONS`; "auto" takes bfloat16 where the processor has it.
    device : str
        What it computes on, as for `network.devices.find_device`.
    threshold : float, optional
        t·K of the kernels, in [0, 1); higher stays closer to the input. Without: what it was trained with.
    breakdown : Breakdown, optional
        Where to count the weights of the frames; each frame's contribution and weight then come as extra layers.
    timings : Timings, optional
        Where to count the stages of the estimate, and "network".

    Raises
    ------
    ValueError
        A bad option, or a file that holds no such model.
    """

    def __init__(
        self,
        weights: Path,
        *,
        tile: int = TILE,
        precision: str = "auto",
        device: str = "cpu",
        threshold: float | None = None,
        breakdown: Breakdown | None = None,
        timings: Timings | None = None,
    ) -> None:
        if precision not in PRECISIONS:
            raise ValueError(f"precision is {precision!r}, expected one of {', '.join(PRECISIONS)}")
        if tile < 16:
            raise ValueError(f"tile is {tile}, expected at least 16 pixels")
        if threshold is not None and not 0 <= threshold < 1:
            raise ValueError(f"threshold is {threshold}, expected 0 <= threshold < 1, in units of 1/K")
        self.device, self._device = find_device(device)
        half = precision == "bfloat16" or (precision == "auto" and has_bfloat16(self._device))
        self.precision = "bfloat16" if half else "float32"
        self.model = for_inference(load_model(weights), half).to(self._device)
        self.tile = tile
        self.threshold = threshold
        self.breakdown = breakdown
        self.timings = timings or Timings()

    @property
    def takes_estimate(self) -> bool:
        """Whether the network works beside per-frame estimates."""
        return isinstance(self.model, Stabilizer)

    @property
    def halo(self) -> int:
        """Pixels of context around a tile."""
        return HALO_OF_SHARES if self.takes_estimate else HALO

    @property
    def radius(self) -> int:
        """Frames on each side that the network looks at."""
        return window_length(self.model) // 2

    def __call__(self, aligned: AlignedWindow) -> Denoised:
        """Denoise the centre of an aligned window."""
        with self.timings.stage("network"):
            return self._run(aligned)

    def counting(self, breakdown: Breakdown) -> Denoiser:
        """Return the same denoiser, which counts the weights of the frames and adds what each contributes as layers."""
        other = copy(self)
        other.breakdown = breakdown
        return other

    def _run(self, aligned: AlignedWindow) -> Denoised:
        layers = self._layers(aligned)
        irradiance, aovs, parts = self._run_tiles(aligned, layers)
        extra = {}
        if parts is not None and self.breakdown is not None:
            self.breakdown.add(parts[..., 3])
            extra = layers_of(parts[..., :3] * aligned.modulation, parts[..., 3]) | stage_layers(aligned, irradiance)
        return Denoised(irradiance * aligned.modulation, _modulated(aovs, aligned), extra)

    def _layers(self, aligned: AlignedWindow) -> dict[str, Array]:
        """What the network is given of a window, and all AOVs side by side."""
        layers = {"color": aligned.mixed(aligned.color), "confidence": aligned.confidence[..., None]}
        if aligned.albedo is not None:
            layers["albedo"] = aligned.mixed(aligned.albedo)
        if aligned.normal is not None:
            layers["normal"] = aligned.mixed(aligned.normal)
        if aligned.estimate is not None:
            layers["estimate"] = aligned.estimate
        if aligned.aovs:
            layers["aovs"] = np.concatenate([aligned.mixed(layer) for layer in aligned.aovs.values()], axis=-1)
        return layers

    def _run_tiles(self, aligned: AlignedWindow, layers: dict[str, Array]) -> tuple[Array, Array, Array | None]:
        """Irradiance (H, W, 3), AOVs side by side (H, W, C), and with a breakdown the frames' parts (T, H, W, 4)."""
        color, centre = layers["color"], aligned.centre
        frames, height, width = color.shape[:3]
        others = layers.get("aovs", np.empty((frames, height, width, 0), np.float32))
        given = {name: layer for name, layer in layers.items() if name != "aovs"}
        exposure = exposure_of(aligned).to(self._device)
        irradiance, filtered = np.empty_like(color[centre]), np.empty_like(others[centre])
        parts = None if self.breakdown is None else np.zeros((frames, height, width, 4), np.float32)
        for inner, outer, offset in tiles(aligned.inner, height, width, self.tile, self.halo, self.model.multiple):
            # Where nothing varies in time nor in space, not even by rounding, the mean is the pixel.
            if "skip" in aligned.stages and not aligned.variance[outer].any():
                irradiance[inner], filtered[inner] = color[centre][inner], others[centre][inner]
                if parts is not None:
                    parts[centre][inner] = np.dstack([irradiance[inner], np.ones_like(irradiance[inner][..., :1])])
                continue
            window = {name: self._cut(layer, outer) for name, layer in given.items()} | {"exposure": exposure}
            aovs = self._cut(others, outer) if others.size else None
            out, sums, through = denoise_tile(self.model, window, threshold=self.threshold, aovs=aovs)
            irradiance[inner] = image_of(out)[offset]
            if through is not None:
                filtered[inner] = image_of(through)[offset]
            if parts is not None:
                tile = torch.cat(sums.parts(), 2)[0].permute(0, 2, 3, 1).cpu().numpy()
                parts[:, *inner] = tile[:, *offset]
        return irradiance, filtered, parts

    def _cut(self, layer: Array, outer: Block) -> torch.Tensor:
        return tensor_of(_pad(layer[:, *outer], self.model.multiple)).to(self._device)


def _modulated(filtered: Array, aligned: AlignedWindow) -> dict[str, Array]:
    """The AOVs of a window apart again, light times the albedo it was divided by."""
    aovs, start = {}, 0
    for name, layer in aligned.aovs.items():
        stop = start + layer.shape[-1]
        light, start = filtered[..., start:stop], stop
        if name == ALPHA:
            aovs[name] = np.where(_solid(layer[aligned.centre]), layer[aligned.centre], light)
        elif light.shape[-1] == 3:
            aovs[name] = light * aligned.modulation
        else:
            aovs[name] = light * aligned.modulation.mean(axis=-1, keepdims=True)
    return aovs


def _solid(alpha: Array) -> NDArray[np.bool_]:
    """Where a pixel and all around it are wholly covered, or not at all: there is nothing to filter (H, W, 1)."""
    box = np.ones((3, 3), np.uint8)
    covered, empty = (cv2.erode((alpha[..., 0] == value).astype(np.uint8), box) > 0 for value in (1, 0))
    return np.logical_or(covered, empty)[..., None]


def exposure_of(aligned: AlignedWindow) -> torch.Tensor:
    """Brightness that a network is told a window has, (1,): in training and in running."""
    return torch.tensor([aligned.exposure], dtype=torch.float32)


def tensor_of(window: Array) -> torch.Tensor:
    """(T, H, W, C) to (1, T, C, H, W)."""
    return torch.from_numpy(np.ascontiguousarray(window.transpose(0, 3, 1, 2)))[None]


def image_of(tensor: torch.Tensor) -> Array:
    """(1, C, H, W) to (H, W, C)."""
    return tensor[0].permute(1, 2, 0).float().cpu().numpy()


def _pad(window: Array, multiple: int) -> Array:
    """Repeat the last row and column until height and width are what the network needs."""
    bottom, right = (-window.shape[1] % multiple, -window.shape[2] % multiple)
    return np.pad(window, ((0, 0), (0, bottom), (0, right), (0, 0)), mode="edge") if bottom or right else window


def tiles(
    rows: slice, height: int, width: int, tile: int, halo: int, multiple: int
) -> Iterator[tuple[Block, Block, Block]]:
    """Cover some rows of an image with tiles.

    Parameters
    ----------
    rows : slice
        To be covered.
    height, width : int
        Of the image.
    tile : int
        Pixels on a side of a tile, rounded up to `multiple`.
    halo : int
        Pixels around a tile that its result depends on, rounded up to `multiple`.
    multiple : int
        Where tiles may start, so that each samples its coarse scales where the whole image would.

    Yields
    ------
    tuple of three pairs of slices
        Where a tile's result goes, what it is computed from, and where in that the result is.
    """
    # The halo starts on a multiple, so that every tile samples its coarse scales where the whole image would.
    halo = -(-halo // multiple) * multiple
    tile = -(-tile // multiple) * multiple
    for top in range(rows.start, rows.stop, tile):
        for left in range(0, width, tile):
            inner, outer, offset = [], [], []
            for start, end, size in ((top, rows.stop, height), (left, width, width)):
                stop = min(start + tile, end)
                first, last = max(start - halo, 0), min(stop + halo, size)
                inner.append(slice(start, stop))
                outer.append(slice(first, last))
                offset.append(slice(start - first, stop - first))
            yield (inner[0], inner[1]), (outer[0], outer[1]), (offset[0], offset[1])
