"""Blocks of the paper's networks: residual, Robust Average with a weight per pixel, temporal module."""

from typing import cast

import torch
from torch import Tensor, nn

from network.paper.ravg import ravg
from network.robust_average import outermost_first


class ResidualBlock(nn.Module):
    """``x + conv(relu(conv(relu(x))))``, without normalisation, at constant width (doi:10.1109/CVPR.2016.90)."""

    def __init__(self, channels: int, kernel_size: int = 3) -> None:
        super().__init__()
        self.first = nn.Conv2d(channels, channels, kernel_size, padding=kernel_size // 2)
        self.second = nn.Conv2d(channels, channels, kernel_size, padding=kernel_size // 2)

    def forward(self, x: Tensor) -> Tensor:
        return x + cast(Tensor, self.second(torch.relu(self.first(torch.relu(x)))))


class RobustAverage(nn.Module):
    """Robust Average block: blends each frame with the robust average of the others, by a learned weight per pixel.

    For each frame i, outermost frames first and the centre last, with the results of the earlier steps in place: ``a =
    ravg(x_j, j ≠ i)``, ``w = sigmoid(conv(relu(conv([x_i, a]))))``, ``x_i ← (1 − w) x_i + w a``. The parameters are
    shared over the steps. The first convolution is held as two halves: as each frame is excluded before it has been
    changed, the half on x_i runs on all frames at once, and nothing is concatenated.
    """

    def __init__(self, channels: int, kernel_size: int = 3) -> None:
        super().__init__()
        padding = kernel_size // 2
        self.on_frame = nn.Conv2d(channels, channels, kernel_size, padding=padding)
        self.on_average = nn.Conv2d(channels, channels, kernel_size, padding=padding, bias=False)
        self.weight = nn.Conv2d(channels, 1, kernel_size, padding=padding)

    def forward(self, x: Tensor, frames: int) -> Tensor:
        """Blend ``(T·N, C, H, W)``, time first, over T frames; the identity for one frame."""
        if frames == 1:
            return x
        of_frame = self.on_frame(x).chunk(frames)
        state = list(x.chunk(frames))
        for i in outermost_first(frames):
            average = ravg(state[:i] + state[i + 1 :])
            weight = torch.sigmoid(self.weight(torch.relu(of_frame[i] + self.on_average(average))))
            state[i] = torch.lerp(state[i], average, weight)
        return torch.cat(state)


class TemporalModule(nn.Module):
    """Temporal module of Vogels et al. 2018, section 5.2: convolutions on the features of all frames together.

    The features of all frames, concatenated, become features of the window; these pass the residual blocks, and a 1×1
    convolution gives each frame its own again, from which its kernel is predicted. Robust Average blocks mix frames at
    many depths with one set of parameters; this does it once, at the end, with weights for each position in the window.
    """

    def __init__(self, channels: int, frames: int, blocks: int = 2, kernel_size: int = 3) -> None:
        super().__init__()
        self.join = nn.Conv2d(frames * channels, channels, kernel_size, padding=kernel_size // 2)
        self.blocks = nn.ModuleList(ResidualBlock(channels, kernel_size) for _ in range(blocks))
        self.split = nn.Conv2d(channels, frames * channels, 1)

    def forward(self, x: Tensor, frames: int) -> Tensor:
        """Mix the T frames of ``(T·N, C, H, W)``, time first."""
        joint = self.join(torch.cat(torch.relu(x).chunk(frames), 1))
        for block in self.blocks:
            joint = block(joint)
        return torch.cat(self.split(torch.relu(joint)).chunk(frames, 1))
