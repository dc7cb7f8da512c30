"""Run a kernel-predicting network of the paper on aligned windows, from noisy frames alone."""

import numpy as np
import torch

from hybrid.alignment.window import AlignedWindow
from hybrid.denoising.stabilize import Denoised
from hybrid.files.frame import Array
from hybrid.neural.aovs import share_out
from hybrid.neural.network_denoiser import NetworkDenoiser, Setup, Tile, exposure_of
from hybrid.neural.tiling import Block, pad, tensor_of
from network.paper.inputs import KernelWindow
from network.paper.models import KernelModel, filter_window, for_inference

SCRATCH = 2500  # bytes for each pixel of a tile in bfloat16; measured


class KernelDenoiser(NetworkDenoiser):
    """Runs a network that predicts kernels; from `open_network`. The kernels filter AOVs along with the color."""

    needs_first_pass = False
    halo = 48  # features beyond change an image by less than 1e-5 of its mean
    default_tile = 640

    def __init__(self, model: KernelModel, setup: Setup, threshold: float | None = None) -> None:
        super().__init__(for_inference(model, setup.bfloat16), setup, SCRATCH)
        self.threshold = threshold

    def __call__(self, aligned: AlignedWindow) -> Denoised:
        with self.setup.timings.stage("network"):
            guides = {"albedo": aligned.albedo, "normal": aligned.normal}
            layers = {"color": aligned.mixed(aligned.color), "confidence": aligned.confidence[..., None]}
            layers |= {name: aligned.mixed(guide) for name, guide in guides.items() if guide is not None}
            mixed = [aligned.mixed(layer) for layer in aligned.aovs.values()]
            empty = np.empty((*aligned.confidence.shape, 0), np.float32)
            aovs = np.concatenate([empty, *mixed], axis=-1)
            result = self._run(aligned, layers | ({"aovs": aovs} if mixed else {}), aovs[aligned.middle])
            edges = np.cumsum([layer.shape[-1] for layer in mixed])[:-1]
            filtered = dict(zip(aligned.aovs, np.split(result.aovs, edges, axis=-1), strict=True)) if mixed else {}
            shared = share_out(aligned, filtered, result.irradiance, add=self.setup.add_layers)
            extra = self._count_parts(aligned, result)
            contributions = {name for name, layer in extra.items() if layer.ndim == 3}
            return Denoised(shared.color, shared.aovs, extra, shared.parts | contributions)

    def _run_tile(self, aligned: AlignedWindow, window: dict[str, Array], outer: Block) -> Tile:
        def cut(layer: Array) -> torch.Tensor:
            return tensor_of(pad(layer[:, *outer], self.model.multiple)).to(self.setup.torch_device)

        tile = {name: cut(layer) for name, layer in window.items()}
        aovs = tile.pop("aovs", None)
        inputs = KernelWindow(**tile, exposure=exposure_of(aligned).to(self.setup.torch_device))
        output = filter_window(self.model, inputs, self.threshold)
        return Tile(output.irradiance.clamp_min(0), None if aovs is None else output.apply(aovs), output.parts)
