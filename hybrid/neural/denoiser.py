"""Running a network: an aligned window becomes tensors, tiles go through the network, a picture comes out.

HWC becomes NCHW here, for running, and for training alike.
"""

from __future__ import annotations

from collections.abc import Callable, Mapping
from pathlib import Path

import cv2
import numpy as np
import torch
from numpy.typing import NDArray

from hybrid.alignment.prepare import ALPHA
from hybrid.alignment.transfer import compress, measure_exposure, measure_gain
from hybrid.alignment.window import AlignedWindow
from hybrid.breakdown import Breakdown, layers_of, stage_layers
from hybrid.denoisers import Backends, WindowDenoiser
from hybrid.files.passes import BEAUTY
from hybrid.neural.tiling import Block, image_of, pad, tensor_of, tiles
from hybrid.neural.unet import HALO as HALO_OF_TRUNK
from hybrid.neural.unet import denoise_bundled, denoise_unet, has_unet, prefilter_guides
from hybrid.runtime.timing import Timings
from hybrid.stabilize import Denoised
from network.checkpoint import load_model
from network.devices import find_device, has_bfloat16
from network.models import denoise_tile, for_inference, window_length
from network.robust_unet import MIRRORED, Borders, RobustUNet
from nlm.average import average
from nlm.parts import add_light, filter_layers, split_light
from nlm.pooling import clamp_to_window

Array = NDArray[np.float32]

# Pixels of context around a tile: what a network sees beyond them changes a picture by less than 1e-5 of its mean.
HALO = 48
# Sides of a tile: what predicts kernels, what makes pictures, which needs less memory for a pixel and more around it
# (1920×1080 is one tile); and where memory is short.
TILE, TILE_OF_TRUNK, SMALL_TILE = 640, 2048, 384
# Bytes that a network takes for each pixel of a tile while it runs in bfloat16, by measurement: of what makes pictures,
# by the size of its trunk; of what predicts kernels. float32 takes twice as much.
SCRATCH_OF_TRUNK, SCRATCH = {"small": 100, "base": 100, "large": 500}, 2500
PRECISIONS = ("auto", "float32", "bfloat16")


class Denoiser(WindowDenoiser):
    """Runs a Robust Average network on aligned windows; an estimator for `hybrid.pipeline.denoise_frames`.

    Parameters
    ----------
    weights : Path
        A file written by training.
    tile : int, optional
        Side of the squares that the network sees at once, pixels; a halo is added around each. Without: `TILE`, or
        `TILE_OF_TRUNK` for the final stage.
    precision : str
        One of `PRECISIONS`; "auto" takes bfloat16 where the processor has it.
    device : str
        What it computes on, as for `network.devices.find_device`.
    threshold : float, optional
        t·K of the kernels, in [0, 1); higher stays closer to the input. Without: what it was trained with.
    breakdown : Breakdown, optional
        Where to count the weights of the frames; each frame's contribution and weight then come as extra layers.
    add_layers : bool
        Whether the picture is the sum of its layers where these are parts of it, and they do not give way to it.
    timings : Timings, optional
        Where to count the stages of the estimate, and "network".

    Raises
    ------
    ValueError
        A bad option, a threshold for a network without one, or a file that holds no such model.
    """

    def __init__(
        self,
        weights: Path,
        *,
        tile: int | None = None,
        precision: str = "auto",
        device: str = "cpu",
        threshold: float | None = None,
        breakdown: Breakdown | None = None,
        add_layers: bool = False,
        timings: Timings | None = None,
    ) -> None:
        if precision not in PRECISIONS:
            raise ValueError(f"precision is {precision!r}, expected one of {', '.join(PRECISIONS)}")
        if tile is not None and tile < 16:
            raise ValueError(f"tile is {tile}, expected at least 16 pixels")
        if threshold is not None and not 0 <= threshold < 1:
            raise ValueError(f"threshold is {threshold}, expected 0 <= threshold < 1, in units of 1/K")
        self.device, self._device = find_device(device)
        self._exact = precision == "float32"
        half = precision == "bfloat16" or (precision == "auto" and has_bfloat16(self._device))
        self.precision = "bfloat16" if half else "float32"
        self.model = for_inference(load_model(weights), half).to(self._device)
        if threshold is not None and self.needs_first_pass:
            raise ValueError(f"threshold is {threshold}, expected none: the network of {weights.name} has no kernels")
        self.tile = tile or (TILE_OF_TRUNK if self.needs_first_pass else TILE)
        self.threshold = threshold
        self.breakdown = breakdown
        self.add_layers = add_layers
        self.timings = timings or Timings()

    @property
    def needs_first_pass(self) -> bool:
        """Whether the network works beside per-frame estimates."""
        return isinstance(self.model, RobustUNet)

    @property
    def quicker(self) -> Callable[..., Array] | None:
        """What may stand for OIDN where it makes the estimates (`hybrid.first_pass.find_first_pass`).

        Not where "float32" was asked for: then the pictures are OIDN's own.
        """
        return denoise_unet if self.device == "cpu" and not self._exact and has_unet() else None

    @property
    def backends(self) -> Backends:
        """Functions for the first pass: OIDN's networks in torch, and a network that ships with ravg."""
        return Backends(self.quicker, denoise_bundled)

    @property
    def settings(self) -> Mapping[str, object]:
        """JSON values that pixels depend on."""
        return {"tile": self.tile, "threshold": self.threshold, "precision": self.precision}

    @property
    def devices(self) -> Mapping[str, str]:
        """The network's device."""
        return {"network": self.device}

    @property
    def packages(self) -> tuple[str, ...]:
        """Packages that pixels depend on."""
        return ("torch",)

    @property
    def halo(self) -> int:
        """Pixels of context around a tile."""
        return HALO_OF_TRUNK if self.needs_first_pass else HALO

    def memory(self, shape: tuple[int, int]) -> int:
        """Bytes that the network takes while it runs on frames of this height and width, beside its weights."""
        model = self.model
        each = SCRATCH_OF_TRUNK[model.config.size] if isinstance(model, RobustUNet) else SCRATCH
        height, width = (min(side, self.tile + 2 * self.halo) for side in shape)
        return each * height * width * (1 if self.precision == "bfloat16" else 2)

    @property
    def radius(self) -> int:
        """Frames on each side that the network looks at."""
        return window_length(self.model) // 2

    def __call__(self, aligned: AlignedWindow) -> Denoised:
        """Denoise the centre of an aligned window."""
        with self.timings.stage("network"):
            return self._run(aligned)

    def _run(self, aligned: AlignedWindow) -> Denoised:
        layers = self._layers(aligned)
        irradiance, filtered, parts = self._run_tiles(aligned, layers)
        if self.needs_first_pass:
            irradiance = clamp_to_window(irradiance, layers["estimate"], layers["residual"])
        alone = _averaged(aligned, irradiance) if self.needs_first_pass else _apart(filtered, aligned)
        aovs, color, add_up = _share_out(aligned, alone, irradiance, add=self.add_layers)
        extra = {}
        if parts is not None and self.breakdown is not None:
            self.breakdown.add(parts[..., 3])
            extra = layers_of(parts[..., :3] * aligned.modulation, parts[..., 3]) | stage_layers(aligned, irradiance)
            if not self.needs_first_pass:
                add_up |= {name for name, layer in extra.items() if layer.ndim == 3}
        return Denoised(color, aovs, extra, frozenset(add_up))

    def _layers(self, aligned: AlignedWindow) -> dict[str, Array]:
        """What the network is given of a window, (T, H, W, C) each, and all AOVs side by side."""
        layers = {"confidence": aligned.confidence[..., None]}
        if self.needs_first_pass:
            if aligned.first_pass is None or aligned.residual is None:
                raise ValueError("estimate: expected those of the frames, as this network takes, got none")
            guides = self._guides(aligned)
            layers |= {"estimate": aligned.first_pass, "residual": aligned.residual} | guides
            layers["modulation"] = aligned.modulation[None]
        else:
            layers["color"] = aligned.mixed(aligned.color)
            for name, guide in (("albedo", aligned.albedo), ("normal", aligned.normal)):
                if guide is not None:
                    layers[name] = aligned.mixed(guide)
        if aligned.aovs and not self.needs_first_pass:
            layers["aovs"] = np.concatenate([aligned.mixed(layer) for layer in aligned.aovs.values()], axis=-1)
        return layers

    def _guides(self, aligned: AlignedWindow) -> dict[str, Array]:
        """The centre's guides, (1, H, W, 3), without noise where the network wants them so."""
        clean = isinstance(self.model, RobustUNet) and self.model.config.clean_guides
        guides = clean_guides(aligned) if clean else aligned.guides
        return {name: np.asarray(layer, np.float32)[None] for name, layer in guides.items()}

    def _run_tiles(self, aligned: AlignedWindow, layers: dict[str, Array]) -> tuple[Array, Array, Array | None]:
        """Irradiance (H, W, 3); AOVs side by side (H, W, C); with a breakdown the frames' parts (T, H, W, 4)."""
        own, centre = aligned.centre_irradiance, aligned.centre
        frames, height, width = aligned.confidence.shape
        others = layers.get("aovs", np.empty((frames, height, width, 0), np.float32))
        given = {name: layer for name, layer in layers.items() if name != "aovs"}
        facts = {"exposure": exposure_of(aligned).to(self._device)}
        if aligned.centre_first_pass is not None:
            facts["gain"] = gain_of(aligned).to(self._device)
        # Where no tile lies, nobody looks.
        irradiance, filtered = np.zeros_like(own), np.empty_like(others[centre])
        # A picture that is black, as far as numbers go, is left as it is.
        dark = (
            aligned.centre_first_pass is not None
            and measure_exposure(aligned.centre_first_pass) == 1 > aligned.centre_first_pass.max()
        )
        parts = None if self.breakdown is None else np.zeros((frames, height, width, 4), np.float32)
        for inner, outer, offset in tiles(aligned.inner, height, width, self.tile, self.halo, self.model.multiple):
            # Where nothing varies in time nor in space, not even by rounding, the mean is the pixel.
            if dark or ("skip" in aligned.stages and not aligned.variance[outer].any()):
                irradiance[inner], filtered[inner] = own[inner], others[centre][inner]
                if parts is not None:
                    parts[centre][inner] = np.dstack([irradiance[inner], np.ones_like(irradiance[inner][..., :1])])
                continue
            window = {name: self._cut(layer, outer) for name, layer in given.items()} | facts
            if "modulation" in window:
                window["modulation"] = window["modulation"][:, 0]
            aovs = self._cut(others, outer) if others.size else None
            borders = self._borders(outer, height, width)
            out, sums, through = denoise_tile(self.model, window, threshold=self.threshold, aovs=aovs, borders=borders)
            irradiance[inner] = image_of(out)[offset]
            if through is not None:
                filtered[inner] = image_of(through)[offset]
            if parts is not None:
                tile = torch.cat(sums.parts(), 2)[0].permute(0, 2, 3, 1).cpu().numpy()
                parts[:, *inner] = tile[:, *offset]
        return irradiance, filtered, parts

    def _borders(self, outer: Block, height: int, width: int) -> Borders:
        """By how many pixels a part is mirrored: where the picture ends, and up to the size that a trunk needs."""
        if not self.needs_first_pass:
            return (0, 0), (0, 0)

        def border(part: slice, size: int) -> tuple[int, int]:
            before, after = MIRRORED * (part.start == 0), MIRRORED * (part.stop == size)
            return before, after + -(part.stop - part.start + before + after) % self.model.multiple

        rows, columns = outer
        return border(rows, height), border(columns, width)

    def _cut(self, layer: Array, outer: Block) -> torch.Tensor:
        # The final stage reads them where they lie, and mirrors them itself.
        if self.needs_first_pass:
            return tensor_of(layer[:, *outer], copied=False).to(self._device)
        return tensor_of(pad(layer[:, *outer], self.model.multiple)).to(self._device)


def _apart(filtered: Array, aligned: AlignedWindow) -> dict[str, Array]:
    """AOVs that lie side by side, (H, W, C), by name."""
    edges = np.cumsum([layer.shape[-1] for layer in aligned.aovs.values()])[:-1]
    return dict(zip(aligned.aovs, np.split(filtered, edges, axis=-1), strict=True)) if aligned.aovs else {}


def _averaged(aligned: AlignedWindow, irradiance: Array) -> dict[str, Array]:
    """The AOVs of a window averaged over time, and filtered each by its own light; alpha is averaged alone."""
    means = {name: average(layer, aligned.confidence) for name, layer in aligned.aovs.items()}
    names = [name for name in means if name != ALPHA]
    if not names:
        return means
    for name in names:
        if aligned.aovs[name][aligned.centre].min() >= 0:
            np.maximum(means[name], 0, out=means[name])  # interpolation undershoots
    light = compress(irradiance.mean(axis=-1, keepdims=True), aligned.exposure)
    guide = np.concatenate([*([] if aligned.guide is None else [aligned.guide]), light], axis=-1)
    moments = aligned.moments[:, : guide.shape[-1]]
    if any(not found.complete for found in aligned.passes.sums):
        means[BEAUTY] = average(aligned.color, aligned.confidence)
        names.append(BEAUTY)
    return means | dict(zip(names, filter_layers([means[n] for n in names], guide, moments=moments), strict=True))


def _share_out(
    aligned: AlignedWindow, filtered: dict[str, Array], irradiance: Array, *, add: bool
) -> tuple[dict[str, Array], Array, set[str]]:
    """The AOVs, the picture, and which of them are parts of it: they add up if they did.

    Either they give way to the denoised picture, or, if that is to `add` them, it to them.
    """
    sums, exposure = aligned.passes.sums, aligned.exposure
    seen = filtered.pop(BEAUTY, irradiance) * aligned.modulation
    factors = {name: _factor(name, aligned) for name in filtered}
    pictures = {name: add_light([part], [factors[name]]) for name, part in filtered.items()}
    pictures[BEAUTY] = irradiance * aligned.modulation
    aovs = dict(filtered)
    # The picture gives way to one sum alone; other sums of the same light give way to it then.
    first = next((found for found in sums if found.whole == BEAUTY and found.complete), None) if add else None
    for found in ([first] if first else []) + [other for other in sums if other is not first]:
        parts, whole = [filtered[name] for name in found.parts], found.whole
        by = [factors[name] for name in found.parts]
        if found is first:
            pictures[BEAUTY] = add_light(parts, by)
            split = parts
        elif found.complete:
            bounds = [
                average(aligned.aovs[name], aligned.confidence) if name in aligned.pass_colors else None
                for name in found.parts
            ]
            split = split_light(parts, pictures[whole], exposure=exposure, factors=by, bounds=bounds)
        else:
            # Beside what is in no layer.
            rest = np.maximum(seen - add_light(parts, by), 0)
            split = split_light([*parts, rest], pictures[whole], exposure=exposure, factors=[*by, None])[:-1]
        for name, part, factor in zip(found.parts, split, by, strict=True):
            aovs[name] = part
            pictures[name] = add_light([part], [factor])
    among = {name for found in sums for name in found.parts}
    for name in aovs:
        if name == ALPHA:
            own = aligned.aovs[name][aligned.centre]
            aovs[name] = np.where(_solid(own), own, aovs[name])
        elif name not in aligned.pass_colors and (factor := factors[name]) is not None:
            aovs[name] = aovs[name] * factor
    return aovs, pictures[BEAUTY], among


def _factor(name: str, aligned: AlignedWindow) -> Array | None:
    """What a filtered AOV is multiplied by to be radiance; None: 1."""
    if name in aligned.pass_colors:
        return aligned.pass_colors[name]
    if name not in aligned.passes.textured:
        return None
    modulation = aligned.modulation
    return modulation if aligned.aovs[name].shape[-1] == 3 else modulation.mean(axis=-1, keepdims=True)


def _solid(alpha: Array) -> NDArray[np.bool_]:
    """Where a pixel and all around it are wholly covered, or not at all: there is nothing to filter (H, W, 1)."""
    box = np.ones((3, 3), np.uint8)
    covered, empty = (cv2.erode((alpha[..., 0] == value).astype(np.uint8), box) > 0 for value in (1, 0))
    return np.logical_or(covered, empty)[..., None]


def clean_guides(aligned: AlignedWindow) -> dict[str, Array]:
    """The centre's albedo and normal, without noise where the plan has found some: in training and in running."""
    guides = aligned.guides
    if "prefilter" not in aligned.stages or not guides:
        return guides
    if has_unet():
        return prefilter_guides(guides)
    if aligned.guide is None:
        return guides
    # Ours: less good where guides are very noisy.
    return dict(zip(guides, np.split(aligned.guide, len(guides), axis=-1), strict=True))


def exposure_of(aligned: AlignedWindow) -> torch.Tensor:
    """Brightness that a network is told a window has, (1,): in training and in running."""
    return torch.tensor([aligned.exposure], dtype=torch.float32)


def gain_of(aligned: AlignedWindow) -> torch.Tensor:
    """What radiance is multiplied by before a trunk's transfer curve, (1,): in training and in running."""
    if aligned.centre_first_pass is None:
        raise ValueError("aligned: expected a window with estimates, got none")
    return torch.tensor([measure_gain(aligned.centre_first_pass)], dtype=torch.float32)
