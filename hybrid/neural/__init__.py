"""The boundary to torch: what runs a network, makes its clips, and trains it. Importing it needs torch."""

from hybrid.neural.clips import write_clips
from hybrid.neural.denoiser import SMALL_TILE, Denoiser
from hybrid.neural.train import train_network
from hybrid.neural.unet import bundled_preset, denoise_bundled
from network.checkpoint import shipped_weights

__all__ = [
    "SMALL_TILE",
    "Denoiser",
    "bundled_preset",
    "denoise_bundled",
    "shipped_weights",
    "train_network",
    "write_clips",
]
