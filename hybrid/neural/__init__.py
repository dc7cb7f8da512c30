"""The boundary to torch: what runs a network, makes its clips, and trains it. Importing it needs torch."""

from hybrid.neural.clips import write_clips
from hybrid.neural.denoiser import SMALL_TILE, TILE, Denoiser, shipped_weights
from hybrid.neural.train import train_network

__all__ = ["SMALL_TILE", "TILE", "Denoiser", "shipped_weights", "train_network", "write_clips"]
