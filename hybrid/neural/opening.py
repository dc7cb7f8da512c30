"""Open the denoiser that a file of weights belongs to."""

from pathlib import Path

from hybrid.denoising.breakdown import Breakdown
from hybrid.neural.network_denoiser import NetworkDenoiser, Setup
from hybrid.neural.unet_denoiser import UNetDenoiser
from hybrid.runtime.timing import Timings
from network.checkpoint import load_model
from network.devices import find_device, has_bfloat16
from network.robust_unet import RobustUNet


def open_network(
    weights: Path,
    *,
    tile: int | None = None,
    precision: str = "auto",
    device: str = "cpu",
    threshold: float | None = None,
    breakdown: Breakdown | None = None,
    add_layers: bool = False,
    timings: Timings | None = None,
) -> NetworkDenoiser:
    """Load weights, and return the denoiser that runs them; options are those of `hybrid.run.job.DenoiseOptions`.

    A breakdown counts the weights of the frames; each frame's contribution and weight are then further layers. With
    `add_layers` the image is the sum of its light passes, instead of these being scaled to it. Raises ValueError for a
    threshold for a network without kernels, a device that is not there, or a file without a model.
    """
    name, torch_device = find_device(device)
    bfloat16 = precision == "bfloat16" or (precision == "auto" and has_bfloat16(torch_device))
    setup = Setup(
        device=name,
        torch_device=torch_device,
        bfloat16=bfloat16,
        exact=precision == "float32",
        tile=tile,
        add_layers=add_layers,
        breakdown=breakdown,
        timings=timings or Timings(),
    )
    model = load_model(weights)
    if isinstance(model, RobustUNet):
        if threshold is not None:
            raise ValueError(f"threshold is {threshold}, expected none: the network of {weights.name} has no kernels")
        return UNetDenoiser(model, setup)
    from hybrid.neural.kernel_denoiser import KernelDenoiser  # here, since no preset needs it

    return KernelDenoiser(model, setup, threshold)
