"""The boundary to torch: running networks, making clips, training. Importing it needs torch."""

from hybrid.neural.clips import ClipSource, write_clips
from hybrid.neural.oidn_networks import BUNDLED, denoise_bundled
from hybrid.neural.opening import open_network
from hybrid.neural.train import TrainInputs, train_network
from network.checkpoint import find_weights, shipped_weights
from network.presets import PRESETS as TRAINING_PRESETS

__all__ = [
    "BUNDLED", "TRAINING_PRESETS", "ClipSource", "TrainInputs", "denoise_bundled",
    "find_weights", "open_network", "shipped_weights", "train_network", "write_clips",
]  # fmt: skip
