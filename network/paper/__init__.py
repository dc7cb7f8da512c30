"""The paper's networks, which predict kernels from noisy frames alone: for research, and apart from presets."""
