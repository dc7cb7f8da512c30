"""The paper's networks, which predict kernels from noisy frames alone: for research, off the way of `ravg denoise`."""

from pathlib import Path

#: Weights of a small `network.paper.models.TKPCN`, for comparisons.
TKPCN_WEIGHTS = Path(__file__).parent / "weights" / "tkpcn.safetensors"
