"""Run the final stage on aligned windows: images from the frames' samples and first passes."""

from functools import partial
from typing import Any

import numpy as np
import torch

from hybrid.alignment.guides import GuideFilter
from hybrid.alignment.transfer import measure_exposure, measure_gain
from hybrid.alignment.window import AlignedWindow
from hybrid.files.frame import Array
from hybrid.neural.aovs import filter_aovs, share_out
from hybrid.neural.network_denoiser import NetworkDenoiser, Setup, Tile, exposure_of
from hybrid.neural.oidn_networks import HALO, has_oidn_networks, prefilter_guides
from hybrid.neural.tiling import Block, tensor_of
from hybrid.stabilize import Denoised
from network.robust_unet import MIRRORED, Borders, RobustUNet, denoise_window, for_inference
from network.windows import UNetWindow
from nlm.pooling import clamp_to_range

# Bytes for each pixel of a tile in bfloat16, by the size of the backbone; measured.
SCRATCH = {"small": 100, "base": 150, "large": 250}


class UNetDenoiser(NetworkDenoiser):
    """Runs a `network.robust_unet.RobustUNet` on aligned windows that have a first pass; from `open_network`."""

    needs_first_pass = clamps = True
    halo = HALO
    default_tile = 2048  # 1920×1080 is one tile

    def __init__(self, model: RobustUNet, setup: Setup) -> None:
        super().__init__(for_inference(model, setup.bfloat16), setup, SCRATCH[model.config.size])
        self.guided = setup.breakdown is not None or (model.config.clean_guides and not has_oidn_networks())

    @property
    def filter_guides(self) -> GuideFilter | None:
        return prefilter_guides if self.model.config.clean_guides and has_oidn_networks() else None

    def __call__(self, aligned: AlignedWindow) -> Denoised:
        if aligned.first_pass is None or aligned.centre_first_pass is None:
            raise ValueError("estimate: expected those of the frames, as this network takes, got none")
        with self.setup.timings.stage("network"):
            # `measure_exposure` returns 1 for an image without light, as far as numbers go.
            black = aligned.centre_first_pass.max() < 1 and measure_exposure(aligned.centre_first_pass) == 1
            nothing = np.empty((*aligned.centre_irradiance.shape[:2], 0), np.float32)
            result = self._run(aligned, self._window(aligned), nothing, bool(black))
            limited = clamp_to_range(result.irradiance, aligned.sample_range)
            result = result._replace(irradiance=limited)
            filtered = filter_aovs(aligned, limited)
            shared = share_out(aligned, filtered, limited, add=self.setup.add_layers)
            return Denoised(shared.color, shared.aovs, self._count_parts(aligned, result), shared.parts)

    def _run_tile(self, aligned: AlignedWindow, window: UNetWindow, outer: Block) -> Tile:
        def border(part: slice, size: int) -> tuple[int, int]:
            before, after = MIRRORED * (part.start == 0), MIRRORED * (part.stop == size)
            return before, after + -(part.stop - part.start + before + after) % self.model.multiple

        # Mirrored at the borders of the image, and up to the size that a U-Net needs.
        height, width = aligned.confidence.shape[1:]
        borders: Borders = border(outer[0], height), border(outer[1], width)
        layers = {name: layer for name, layer in window._asdict().items() if layer is not None}
        parts = {name: layer if layer.ndim == 1 else layer[..., *outer] for name, layer in layers.items()}
        tile = window._replace(**{name: part.to(self.setup.torch_device) for name, part in parts.items()})
        in_strips = partial(_residual_rows, aligned, outer) if window.residual is None else None
        output = denoise_window(self.model, tile, borders=borders, residual=in_strips)
        return Tile(output.irradiance, None, output.parts)

    def _window(self, aligned: AlignedWindow) -> UNetWindow:
        """The window as tensors that are views of its arrays."""
        layers: Any = aligned.first_pass, aligned.confidence[..., None], aligned.modulation[None]
        first_pass, confidence, modulation = (tensor_of(layer, copied=False) for layer in layers)
        # On a processor the residual is made strip by strip; a breakdown reads the whole.
        whole = None if self.setup.torch_device.type == "cpu" and self.setup.breakdown is None else aligned.residual
        residual = None if whole is None else tensor_of(whole, copied=False)
        guides = clean_guides(aligned) if self.model.config.clean_guides else aligned.guides
        centre = {n: tensor_of(np.asarray(g, np.float32)[None], copied=False)[:, 0] for n, g in guides.items()}
        gain, exposure = gain_of(aligned), exposure_of(aligned)
        return UNetWindow(first_pass, residual, confidence, modulation[:, 0], exposure, gain, **centre)


def _residual_rows(aligned: AlignedWindow, outer: Block, rows: slice) -> Array:
    """Rows of the residual within a tile, (T, h, w, 3)."""
    top = outer[0].start
    return aligned.sources.residual((slice(top + rows.start, top + rows.stop), outer[1]), limited=True)


def clean_guides(aligned: AlignedWindow) -> dict[str, Array]:
    """The centre's albedo and normal, denoised where the plan has found noise: in training and in running."""
    guides = aligned.guides
    if aligned.filtered_guides is not None:
        return aligned.filtered_guides
    if "prefilter" not in aligned.stages or not guides or has_oidn_networks() or aligned.guide is None:
        return guides
    # The filtered guide of the window is less accurate where guides are very noisy.
    return dict(zip(guides, np.split(aligned.guide, len(guides), axis=-1), strict=True))


def gain_of(aligned: AlignedWindow) -> torch.Tensor:
    """Factor of radiance before the transfer curve, (1,): in training and in running."""
    if aligned.centre_first_pass is None:
        raise ValueError("aligned: expected a window with estimates, got none")
    return torch.tensor([measure_gain(aligned.centre_first_pass)], dtype=torch.float32)
