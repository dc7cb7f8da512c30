"""Predicted kernels: activation with a threshold, and applying them frame by frame.

A kernel has one weight per tap: the K×K neighbours of a pixel in each frame of the aligned window (time, then
row, then column). All taps of a pixel are normalised together. Applying them keeps the frames apart: numerators
``S_t = Σ k_i x_i`` and denominators ``N_t = Σ k_i`` over the taps of frame t. The filtered image is ``Σ S_t / Σ N_t``;
images of any subset of the frames, and the share of each frame, are sums of the same.
"""

import math
from collections.abc import Iterator, Sequence
from dataclasses import dataclass
from itertools import product
from typing import Any, NamedTuple, Self

import torch
from numba import njit
from numpy.typing import NDArray
from torch import Tensor
from torch.autograd.function import once_differentiable
from torch.nn import functional

from loops.parallel import run_bands

_PROCESSOR = "cpu"  # where compiled loops run; elsewhere torch's own operations


def predict_kernel(weights: Tensor, threshold: float | Tensor | None = None, *, centre: int) -> Tensor:
    """Kernel ``(N, K, H, W)`` of raw weights on any scale, ≥ 0, sums to 1: ``η_t(η_0(w))``; float32 or float64.

    ``η_t(w_i) = max(0, w_i − t) / Σ_j max(0, w_j − t)`` (the paper, section 4). ``t < 1/K``, by default ``1 / (2K)``,
    keeps a kernel of equal weights alive. Where no weight exceeds it, the kernel is the identity: all weight on the tap
    `centre`, gradient 0.

    Without the first normalisation t would be compared with numbers whose scale the network chooses, and the same t
    would mean something else in each pixel. As ``η_t(w / s) = η_{t s}(w)``, the first normalisation needs only its sum.
    Kept in float32: in half precision a weight near 1/K has lost the digits that distinguish it from t.
    """
    weights = weights if weights.dtype == torch.float64 else weights.float()
    threshold = 0.5 / weights.shape[1] if threshold is None else threshold
    kernel: Tensor = _Threshold.apply(weights, threshold, centre)  # type: ignore[no-untyped-call]
    return kernel


def apply_kernels(kernels: Tensor, frames: Tensor) -> tuple[Tensor, Tensor]:
    """Apply kernels ``(N, T·K·K, H, W)``, K odd, each frame's to its frame, ``(N, T, C, H, W)``, any linear quantity.

    Returns numerators ``(N, T, C, H, W)``, ``S_t(x) = Σ_d k_{t,d}(x) · frame_t(x + d)``, and denominators ``(N, T, 1,
    H, W)``, ``N_t(x) = Σ_d k_{t,d}(x)``, both over the taps inside the image, so that dividing renormalises the rest of
    a kernel at the border. Both directions accumulate in place, in float32 or float64: unfolding would write each frame
    K·K times.
    """
    size = math.isqrt(kernels.shape[1] // frames.shape[1])
    dtype = torch.promote_types(kernels.dtype, frames.dtype)
    working = dtype if dtype == torch.float64 else torch.float32
    # The numerators of a further channel of ones are the denominators; the margin around the image is zero.
    (n, t, c, h, w), margin = frames.shape, size // 2
    padded = frames.new_zeros((n, t, c + 1, h + 2 * margin, w + 2 * margin), dtype=working)
    padded[:, :, :c, margin : margin + h, margin : margin + w] = frames
    padded[:, :, c, margin : margin + h, margin : margin + w] = 1
    sums: Tensor = _ApplyKernels.apply(kernels.to(working), padded, size)  # type: ignore[no-untyped-call]
    numerators, denominators = sums.to(dtype).split((c, 1), 2)
    return numerators, denominators


def mean_of(numerators: Tensor, denominators: Tensor, fallback: Tensor, epsilon: float = 1e-6) -> Tensor:
    """Filtered image ``(N, C, H, W)`` of the frames in the sums: ``(Σ S_t + ε x) / (Σ N_t + ε)``, x the fallback."""
    return (numerators.sum(1) + epsilon * fallback) / (denominators.sum(1) + epsilon)


class Pyramid(NamedTuple):
    """Kernels at several resolutions, each half of the one before, and how they are blended."""

    kernels: tuple[Tensor, ...]  # ``(N, taps, H / 2^s, W / 2^s)``, finest first
    # one fewer, α_s in [0, 1] of ``(N, 1, H / 2^s, W / 2^s)``: share of the low frequencies of scale s that comes from
    # the next coarser scale
    blends: tuple[Tensor, ...]


@dataclass(frozen=True)
class Filtered:
    """A window after its kernels, frame by frame: the images of any of its frames are sums of these.

    Notes
    -----
    ``o_s = f_s + α_s U(o_{s+1} − D f_s)``, with f_s the image of this resolution, D the mean of 2×2 pixels and U linear
    interpolation: with α = 1 all but the finest detail is that of the coarser image.

    References
    ----------
    Vogels et al. 2018, section 5.3 (multi-scale reconstruction), doi:10.1145/3197517.3201388.
    """

    # ``(N, T, C, H, W)`` and ``(N, T, 1, H, W)`` of `apply_kernels`
    numerators: Tensor
    denominators: Tensor
    kernels: Tensor | Pyramid  # the kernels
    centre: Tensor  # ``(N, C, H, W)``: the centre frame before filtering
    coarse: "Filtered | None" = None  # the same at half the resolution
    blend: Tensor | None = None  # ``(N, 1, H, W)``, α of `Pyramid`; with coarse

    @classmethod
    def of(cls, kernels: Tensor | Pyramid, color: Tensor) -> Self:
        """Apply kernels of one or more resolutions to ``(N, T, C, H, W)``, any linear quantity."""
        centre = color[:, color.shape[1] // 2]
        if isinstance(kernels, Tensor):
            return cls(*apply_kernels(kernels, color), kernels, centre)
        sums = apply_kernels(kernels.kernels[0], color)
        if not kernels.blends:
            return cls(*sums, kernels, centre)
        rest = Pyramid(kernels.kernels[1:], kernels.blends[1:])
        return cls(*sums, kernels, centre, cls.of(rest, halve(color)), kernels.blends[0])

    def apply(self, layers: Tensor) -> Tensor:
        """Filter other layers of the window, ``(N, T, C, H, W)``, with the same kernels to ``(N, C, H, W)``."""
        return Filtered.of(self.kernels, layers).irradiance

    @property
    def irradiance(self) -> Tensor:
        """Image of all frames, ``(N, C, H, W)``; the centre where the kernels have no weight."""
        return self.image(self.centre)

    def image(self, fallback: Tensor, frames: Sequence[int] | None = None, epsilon: float = 1e-6) -> Tensor:
        """Image ``(N, C, H, W)`` of some frames together, by default of all, by `mean_of`."""
        numerators, denominators = self.numerators, self.denominators
        if frames is not None:
            numerators, denominators = numerators[:, list(frames)], denominators[:, list(frames)]
        fine = mean_of(numerators, denominators, fallback, epsilon)
        if self.coarse is None or self.blend is None:
            return fine
        low = self.coarse.image(halve(fallback), frames, epsilon)
        return fine + self.blend * double(low - halve(fine))

    def parts(self) -> tuple[Tensor, Tensor]:
        """Contribution of each frame to the image of all, ``(N, T, C, H, W)``, and its weight, ``(N, T, 1, H, W)``.

        They sum to the image and to 1. With coarser resolutions a weight may leave [0, 1] a little, since low
        frequencies are subtracted before the coarser image replaces them.
        """
        # 1e-6: as in `mean_of`; a kernel has no weight left only where no tap is inside the image, which cannot be.
        total = self.denominators.sum(1, keepdim=True).clamp_min(1e-6)
        parts, shares = self.numerators / total, self.denominators / total
        if self.coarse is None or self.blend is None:
            return parts, shares
        blend = self.blend.unsqueeze(1)
        coarse_parts, coarse_shares = self.coarse.parts()
        return (
            parts + blend * double(coarse_parts - halve(parts)),
            shares + blend * double(coarse_shares - halve(shares)),
        )


def check_threshold(relative: float) -> float:
    """Return a threshold t·K, in units of the mean weight of K taps; ValueError if it is outside [0, 1)."""
    if not 0 <= relative < 1:
        raise ValueError(f"threshold: expected 0 <= t·K < 1, so that t < 1/K, got t·K = {relative}")
    return relative


def halve(image: Tensor) -> Tensor:
    """Means over 2×2 pixels of ``(..., H, W)``, H and W even."""
    halved: Tensor = functional.avg_pool2d(image.flatten(0, -4), 2).unflatten(0, image.shape[:-3])
    return halved


def double(image: Tensor) -> Tensor:
    """Linear interpolation of ``(..., H, W)`` to twice the size."""
    flat = functional.interpolate(image.flatten(0, -4), scale_factor=2.0, mode="bilinear", align_corners=False)
    doubled: Tensor = flat.unflatten(0, image.shape[:-3])
    return doubled


class _Threshold(torch.autograd.Function):
    """η_t of normalised weights; one buffer instead of autograd's eight."""

    @staticmethod
    def forward(ctx: Any, weights: Tensor, threshold: float | Tensor, centre: int) -> Tensor:
        buffer = torch.relu(weights)
        cut = threshold * buffer.sum(1, keepdim=True)
        kernel = torch.sub(weights, cut, out=buffer).relu_()
        total = kernel.sum(1, keepdim=True)
        # Also a denormal, whose reciprocal is infinite.
        nothing = total < 1e-30
        kernel.div_(total.masked_fill_(nothing, torch.inf))
        kernel[:, centre : centre + 1] += nothing  # no gradient: it is divided by the total, infinity
        ctx.save_for_backward(weights, kernel, total)
        ctx.threshold = threshold
        return kernel

    @staticmethod
    @once_differentiable
    def backward(ctx: Any, gradient: Tensor) -> tuple[Tensor | None, ...]:
        weights, kernel, total = ctx.saved_tensors
        mean = (gradient * kernel).sum(1, keepdim=True)
        above = kernel > 0
        to_weights = torch.sub(gradient, mean).div_(total).mul_(above)
        # The cut is t times the sum of the positive weights.
        to_cut = to_weights.sum(1, keepdim=True).mul_(ctx.threshold)
        to_weights.sub_(to_cut * (weights > 0))
        return to_weights, None, None


class _ApplyKernels(torch.autograd.Function):
    """Sums of every frame over its taps, ``(N, T, C, H, W)``, of frames with a margin; see `apply_kernels`."""

    @staticmethod
    def forward(ctx: Any, kernels: Tensor, padded: Tensor, size: int) -> Tensor:
        kernels = kernels.unflatten(1, (-1, size * size)).contiguous()
        sums = padded.new_zeros(*padded.shape[:3], *kernels.shape[3:])
        if padded.device.type == _PROCESSOR:
            rows = sums.shape[0] * sums.shape[1] * sums.shape[3]
            run_bands(_add_taps, rows, _planes(kernels), _planes(padded), _planes(sums), tuple(range(size)))
        else:
            for tap, window in _windows(padded, size):
                sums.addcmul_(kernels[:, :, tap, None], window)
        ctx.save_for_backward(kernels, padded)
        ctx.size = size
        return sums

    @staticmethod
    @once_differentiable
    def backward(ctx: Any, to_sums: Tensor) -> tuple[Tensor | None, ...]:
        kernels, padded = ctx.saved_tensors
        to_kernels = torch.empty_like(kernels) if ctx.needs_input_grad[0] else None
        to_padded = torch.zeros_like(padded) if ctx.needs_input_grad[1] else None
        to_sums = to_sums.contiguous()
        if padded.device.type == _PROCESSOR:
            frames, height = to_sums.shape[0] * to_sums.shape[1], to_sums.shape[3]
            if to_kernels is not None:
                run_bands(_to_taps, frames * height, _planes(to_sums), _planes(padded), _planes(to_kernels), ctx.size)
            if to_padded is not None:
                run_bands(_to_frames, frames, _planes(to_sums), _planes(kernels), _planes(to_padded), ctx.size)
        else:
            for tap, window in _windows(padded, ctx.size):
                if to_kernels is not None:
                    torch.sum(to_sums * window, 2, out=to_kernels[:, :, tap])
            if to_padded is not None:
                for tap, window in _windows(to_padded, ctx.size):
                    window.addcmul_(kernels[:, :, tap, None], to_sums)
        return None if to_kernels is None else to_kernels.flatten(1, 2), to_padded, None


def _windows(padded: Tensor, size: int) -> Iterator[tuple[int, Tensor]]:
    """Each tap of a kernel, and the view of the frames that it reads."""
    height, width = padded.shape[3] - size + 1, padded.shape[4] - size + 1
    for tap, (top, left) in enumerate(product(range(size), repeat=2)):
        yield tap, padded[..., top : top + height, left : left + width]


def _planes(tensor: Tensor) -> NDArray[Any]:
    """Planes of each frame, ``(N·T, planes, H, W)``, for compiled code."""
    planes: NDArray[Any] = tensor.detach().flatten(0, 1).numpy()
    return planes


@njit(nogil=True, cache=True, error_model="numpy")
def _add_taps(
    first: int, last: int, kernels: NDArray[Any], padded: NDArray[Any], sums: NDArray[Any], columns: tuple[int, ...]
) -> None:  # pragma: no cover - compiled
    """Add the taps' products to the sums. The number of columns is known to the compiler, which unrolls them."""
    size, (_, channels, height, width) = len(columns), sums.shape
    for job in range(first, last):
        frame, y = job // height, job % height
        for row in range(size):
            for channel in range(channels):
                for x in range(width):
                    total = sums[frame, channel, y, x]
                    for column in range(len(columns)):
                        tap = row * size + column
                        total += kernels[frame, tap, y, x] * padded[frame, channel, y + row, x + column]
                    sums[frame, channel, y, x] = total


@njit(nogil=True, cache=True, error_model="numpy")
def _to_taps(
    first: int, last: int, to_sums: NDArray[Any], padded: NDArray[Any], to_kernels: NDArray[Any], size: int
) -> None:  # pragma: no cover - compiled
    """Gradient of the kernels."""
    _, channels, height, width = to_sums.shape
    for job in range(first, last):
        frame, y = job // height, job % height
        for tap in range(size * size):
            row, column = tap // size, tap % size
            gradient = to_kernels[frame, tap, y]
            gradient[:] = 0
            for channel in range(channels):
                # Rows are separate arrays, or the compiler vectorises no loop over x.
                given = to_sums[frame, channel, y]
                read = padded[frame, channel, y + row, column : column + width]
                for x in range(width):
                    gradient[x] += given[x] * read[x]


@njit(nogil=True, cache=True, error_model="numpy")
def _to_frames(
    first: int, last: int, to_sums: NDArray[Any], kernels: NDArray[Any], to_padded: NDArray[Any], size: int
) -> None:  # pragma: no cover - compiled
    """Gradient of the frames, scattered to where the taps have read; frame by frame, as rows overlap."""
    _, channels, height, width = to_sums.shape
    for frame in range(first, last):
        for y in range(height):
            for tap in range(size * size):
                row, column = tap // size, tap % size
                weight = kernels[frame, tap, y]
                for channel in range(channels):
                    given = to_sums[frame, channel, y]
                    gradient = to_padded[frame, channel, y + row, column : column + width]
                    for x in range(width):
                        gradient[x] += weight[x] * given[x]
