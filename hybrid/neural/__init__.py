"""The boundary to torch: what runs a network, makes its clips, and trains it. Importing it needs torch."""

from hybrid.neural.clips import write_clips
from hybrid.neural.denoiser import SMALL_TILE, TILE, Denoiser, shipped_weights
from hybrid.neural.train import train_network
from hybrid.neural.unet import denoise_unet, has_unet

__all__ = [
    "SMALL_TILE",
    "TILE",
    "Denoiser",
    "denoise_unet",
    "has_unet",
    "shipped_weights",
    "train_network",
    "write_clips",
]
