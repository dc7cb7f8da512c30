"""Run the final stage on aligned windows: images from the frames' samples and first passes."""

from dataclasses import replace
from functools import partial
from typing import NamedTuple

import numpy as np
import torch

from hybrid.alignment.guides import GuideFilter
from hybrid.alignment.transfer import measure_exposure, measure_gain
from hybrid.alignment.window import AlignedWindow, moves_over_noise
from hybrid.denoising.stabilize import Denoised
from hybrid.files.frame import Array
from hybrid.neural.aovs import filter_aovs, share_out
from hybrid.neural.network_denoiser import NetworkDenoiser, Setup, Tile, exposure_of
from hybrid.neural.oidn_networks import HALO, TILE, has_oidn_networks, prefilter_guides
from hybrid.neural.tiling import Block, tensor_of
from network.robust_average import UNetWindow, pool
from network.robust_unet import MIRRORED, RobustUNet, for_inference
from network.unet import Borders
from nlm.average import average
from nlm.pooling import PooledSamples

# Bytes for each pixel of a tile in bfloat16, by the size of the backbone; measured.
SCRATCH = {"none": 0, "small": 100, "base": 150, "large": 250}


class _Inputs(NamedTuple):
    """Layers of the centre that the network reads, and the weights of the frames."""

    pooled: PooledSamples
    guides: dict[str, Array]  # (H, W, 3)
    weights: Array  # (T, H, W)


class UNetDenoiser(NetworkDenoiser):
    """Runs a `network.robust_unet.RobustUNet` on aligned windows that have a first pass; from `open_network`."""

    needs_first_pass = True
    halo = HALO
    default_tile = TILE

    def __init__(self, model: RobustUNet, setup: Setup) -> None:
        super().__init__(for_inference(model, setup.bfloat16), setup, SCRATCH[model.config.size])
        self.reads_guides = model.backbone is not None or setup.breakdown is not None
        self.guided = setup.breakdown is not None or (model.config.clean_guides and not has_oidn_networks())

    @property
    def filter_guides(self) -> GuideFilter | None:
        return prefilter_guides if self.model.config.clean_guides and has_oidn_networks() else None

    def __call__(self, aligned: AlignedWindow) -> Denoised:
        if aligned.first_pass is None or aligned.centre.first_pass is None:
            raise ValueError("aligned: expected a window with first passes, got none")
        with self.setup.timings.stage("pool"):
            weights = self._weigh(aligned)
            guides = clean_guides(aligned) if self.model.config.clean_guides else aligned.centre.guides
            inputs = _Inputs(self._pool(aligned, weights), guides, weights)
            if self.setup.breakdown is None:
                # The samples are pooled: the aligned first passes are freed while the network runs.
                aligned = replace(aligned, first_pass=None)
        with self.setup.timings.stage("network"):
            # `measure_exposure` returns 1 for an image without light, as far as numbers go.
            assert aligned.centre.first_pass is not None
            black = aligned.centre.first_pass.max() < 1 and measure_exposure(aligned.centre.first_pass) == 1
            nothing = np.empty((*aligned.centre.irradiance.shape[:2], 0), np.float32)
            result = self._run(aligned, inputs, nothing, bool(black))
            filtered = filter_aovs(aligned, result.irradiance)
            shared = share_out(aligned, filtered, result.irradiance, add=self.setup.add_layers)
            return Denoised(shared.color, shared.aovs, self._count_parts(aligned, result), shared.parts)

    def _pools(self, aligned: AlignedWindow) -> bool:
        """Whether samples are pooled for a U-Net; else the result is the average of the first passes."""
        return self.model.backbone is not None and not moves_over_noise(aligned.stages)

    def _weigh(self, aligned: AlignedWindow) -> Array:
        """Weights (T, H, W) of the frames, from the Robust Average block."""
        if self.model.robust_average.is_prior:
            return aligned.confidence
        with torch.inference_mode():
            weights = self.model.robust_average(self._window(aligned, np.s_[:, :]))
        return np.ascontiguousarray(weights[0, :, 0].float().cpu().numpy())

    def _pool(self, aligned: AlignedWindow, weights: Array) -> PooledSamples:
        """The pooled samples, or in their place the average of the first passes, which is the image then."""
        if self._pools(aligned):
            return aligned.pool(weights)
        assert aligned.first_pass is not None
        mean = average(aligned.first_pass, weights)
        return PooledSamples(mean, mean)

    def _run_tile(self, aligned: AlignedWindow, window: _Inputs, outer: Block) -> Tile:
        def border(part: slice, size: int) -> tuple[int, int]:
            before, after = MIRRORED * (part.start == 0), MIRRORED * (part.stop == size)
            return before, after + -(part.stop - part.start + before + after) % self.model.multiple

        # Mirrored at the borders of the image, and up to the size that a U-Net needs.
        height, width = aligned.confidence.shape[1:]
        borders: Borders = border(outer[0], height), border(outer[1], width)
        layers = (*window.pooled[::-1], aligned.modulation, *(window.guides.get(n) for n in ("albedo", "normal")))
        gain = gain_of(aligned).to(self.setup.torch_device)
        if self._pools(aligned):
            image = self.model.denoise(*(self._cut(layer, outer) for layer in layers), gain, borders)
        else:
            image = tensor_of(window.pooled.average[None, *outer])[:, 0].clamp_min(0)
        return Tile(image, None, partial(self._parts, aligned, window.weights, outer))

    def _parts(self, aligned: AlignedWindow, weights: Array, outer: Block) -> tuple[torch.Tensor, torch.Tensor]:
        """Contribution and share of each frame within a tile, as `NetworkDenoiser` counts them."""
        window = self._window(aligned, outer)
        if not self._pools(aligned):
            window = window._replace(residual=torch.zeros_like(window.residual))
        pooled = pool(window, self._cut_window(weights[..., None], outer))
        return pooled.parts, pooled.share

    def _window(self, aligned: AlignedWindow, outer: Block) -> UNetWindow:
        """Part of a window as tensors."""
        assert aligned.first_pass is not None
        residual = aligned.sources.residual(outer, limited=True)
        return UNetWindow(
            self._cut_window(aligned.first_pass, outer),
            tensor_of(residual, copied=False).to(self.setup.torch_device),
            self._cut_window(aligned.confidence[..., None], outer),
            self._cut_window(aligned.modulation[None], outer)[:, 0],
            exposure_of(aligned).to(self.setup.torch_device),
            gain_of(aligned).to(self.setup.torch_device),
        )

    def _cut_window(self, layer: Array, outer: Block) -> torch.Tensor:
        return tensor_of(layer[:, *outer], copied=False).to(self.setup.torch_device)

    def _cut(self, layer: Array | None, outer: Block) -> torch.Tensor | None:
        if layer is None:
            return None
        return tensor_of(np.asarray(layer[*outer], np.float32)[None], copied=False)[:, 0].to(self.setup.torch_device)


def clean_guides(aligned: AlignedWindow) -> dict[str, Array]:
    """The centre's albedo and normal, denoised where the plan has found noise: in training and in running."""
    guides = aligned.centre.guides
    if aligned.centre.filtered_guides is not None:
        return aligned.centre.filtered_guides
    if "prefilter" not in aligned.stages or not guides or has_oidn_networks() or aligned.guide is None:
        return guides
    # The filtered guide of the window is less accurate where guides are very noisy.
    return dict(zip(guides, np.split(aligned.guide, len(guides), axis=-1), strict=True))


def gain_of(aligned: AlignedWindow) -> torch.Tensor:
    """Factor of radiance before the transfer curve, (1,): in training and in running."""
    if aligned.centre.first_pass is None:
        raise ValueError("aligned: expected a window with first passes, got none")
    return torch.tensor([measure_gain(aligned.centre.first_pass)], dtype=torch.float32)
