"""The Robust Average block on images: for how much each frame of a window counts, at each pixel.

Kalojanov and Thurston 2023, "Robust Average Networks for Monte Carlo Denoising", section 3: frames are visited
outermost first, the centre last; each is blended with the average a of the others, x ← (1 − w) x + w a, by one weight w
per pixel and frame. Here x are noisy images of the centre, one from each frame, in place of features, and the others
are the frames visited before. The paper's average drops the least and the greatest value; on linear radiance, whose
noise is skewed, that darkens (docs/dev/experiments.md), so the weights alone reject outliers.
"""

from typing import NamedTuple, cast

import torch
from torch import Tensor, nn
from torch.nn import functional

from network.transfer import pu_forward
from nlm.pooling import RESIDUAL_LIMIT

#: Boxes, pixels, over which first passes are compared: a pixel, the detail and the light around it.
SCALES = (1, 5, 17)
#: Box, pixels, over which the noise of the centre is measured.
NOISE_BOX = 9
#: Inputs of the correction: three differences at each scale; noise, prior odds, confidence.
FEATURES = 3 * len(SCALES) + 3
#: Greatest correction of log-odds either way: a factor of 55, which excludes a frame, and no overflow.
MOST = 4.0
#: Least difference and noise that are told apart, on the transfer curve: one step of 8 bits.
STEP = 1 / 255


class UNetWindow(NamedTuple):
    """An aligned window of T frames, float32."""

    first_pass: Tensor  # ``(N, T, 3, H, W)`` irradiance: each frame denoised by itself
    # ``(N, T, 3, H, W)`` irradiance of the noisy frames minus `first_pass`, each frame's in its own place, aligned to
    # the nearest pixel
    residual: Tensor
    confidence: Tensor  # ``(N, T, 1, H, W)``, at least 0
    modulation: Tensor  # ``(N, 3, H, W)``; radiance is irradiance times modulation
    exposure: Tensor  # ``(N,)``, positive: brightness of the irradiance of whole frames
    # ``(N,)``, positive: factor of radiance before the transfer curve (`hybrid.alignment.transfer.measure_gain`)
    gain: Tensor
    # ``(N, 3, H, W)`` guides of the centre, in [0, 1] and [−1, 1]
    albedo: Tensor | None = None
    normal: Tensor | None = None


class Pooled(NamedTuple):
    """The centre of a window, from the samples of all of its frames; irradiance."""

    image: Tensor  # ``(N, 3, H, W)``: noisy, unbiased
    average: Tensor  # ``(N, 3, H, W)``: average of the first passes
    parts: Tensor  # ``(N, T, 3, H, W)``: contribution of each frame to the image
    share: Tensor  # ``(N, T, 1, H, W)``: share of each frame, which add up to 1


def outermost_first(frames: int) -> list[int]:
    """Order in which a Robust Average block visits the frames of a window: 0, 4, 1, 3, 2 for five."""
    return sorted(range(frames), key=lambda i: (-abs(i - frames // 2), i))


def pool(window: UNetWindow, weight: Tensor) -> Pooled:
    """Average the frames' images of the centre by ``(N, T, 1, H, W)`` weights, with gradients.

    The formula is that of `nlm.pooling.pool_samples`, which is one pass over memory, without gradients.
    """
    centre = weight.shape[1] // 2
    total = weight.sum(1, keepdim=True)
    known = total > 0
    alone = torch.zeros_like(weight)
    alone[:, centre] = 1
    share = torch.where(known, weight / torch.where(known, total, 1), alone)
    light = window.first_pass.mean(2, keepdim=True).clamp_min(0) + window.exposure.view(-1, 1, 1, 1, 1)
    limit = float(RESIDUAL_LIMIT) * light
    excess = window.residual.mean(2, keepdim=True).abs()
    parts = share * (window.first_pass + window.residual * (known * limit / torch.maximum(excess, limit)))
    return Pooled(parts.sum(1), (share * window.first_pass).sum(1), parts, share)


class RobustAverage(nn.Module):
    """Robust Average block: weights of the frames of a window.

    The recursion, with c the confidence and s the frames in the order of `outermost_first`, is

        w_s = σ(log(Σ c / c_s) + f_s),    x_s ← (1 − w_s) x_s + w_s a_s,

    where Σ c is over the frames visited before, a_s is their result, and x_t of the centre t is the result of the
    block. The prior odds are those of the confidence, so that with f = 0 the result is Σ c x / Σ c, and a neighbour of
    no confidence does not count. As a step multiplies the weight of all frames before it by exp(f_s), the weights of
    the block are c_i Π exp(f_s) over the steps s after i, and x is averaged once.

    The correction f of a step, in [−4, 4], is predicted by three convolutions at half size from the differences between
    the first passes of the frame, of the average so far and of the centre, over the noise of the centre, at three
    scales; the noise; the prior odds; and the confidence. The last convolution starts at zero, and while it is zero
    nothing is computed.
    """

    def __init__(self, width: int = 16) -> None:
        super().__init__()
        layers = [nn.Conv2d(i, o, 3, padding=1) for i, o in ((FEATURES, width), (width, width), (width, 1))]
        nn.init.zeros_(layers[-1].weight)
        nn.init.zeros_(cast(Tensor, layers[-1].bias))
        self.correction = nn.Sequential(layers[0], nn.ReLU(), layers[1], nn.ReLU(), layers[2])

    @property
    def is_prior(self) -> bool:
        """Whether f is 0 everywhere: the weights are then the confidence."""
        return not any(bool(value.any()) for value in self.correction[-1].parameters())

    def forward(self, window: UNetWindow) -> Tensor:
        """Return the weights ``(N, T, 1, H, W)``, at least 0."""
        if self.is_prior and not torch.is_grad_enabled():
            return window.confidence
        weights = list(window.confidence.unbind(1))
        first, *following = outermost_first(len(weights))
        scale = window.modulation * window.gain.view(-1, 1, 1, 1)
        images = window.first_pass.unbind(1)
        centre = images[len(images) // 2]
        noisy = _encode(centre + window.residual[:, len(images) // 2], scale)
        noise = (_box((noisy - _encode(centre, scale)).square().mean(1, keepdim=True), NOISE_BOX)).sqrt() + STEP
        visited = [first]
        for frame in following:
            before = sum((weights[i] for i in visited), torch.zeros_like(weights[frame]))
            mean = sum((weights[i] * images[i] for i in visited), torch.zeros_like(centre))
            average = torch.where(before > 0, mean / torch.where(before > 0, before, 1), centre)
            features = self._features(images[frame], average, centre, scale, noise, before, weights[frame])
            factor = self._correct(features).exp()
            for i in visited:
                weights[i] = weights[i] * factor
            visited.append(frame)
        return torch.stack(weights, 1)

    def _features(
        self, image: Tensor, average: Tensor, centre: Tensor, scale: Tensor, noise: Tensor, before: Tensor, own: Tensor
    ) -> Tensor:
        """Inputs ``(N, FEATURES, H, W)`` of the correction of a step."""
        encoded = [_encode(x, scale) for x in (image, average, centre)]
        pairs = [encoded[i] - encoded[j] for i, j in ((0, 1), (0, 2), (1, 2))]
        sizes = [_box(pair, box).abs().mean(1, keepdim=True) + STEP for pair in pairs for box in SCALES]
        # The smallest share that matters, so that the logarithm is finite where a frame has no confidence.
        odds = ((before + 1e-3) / (own + 1e-3)).log()
        return torch.cat([*((size / noise).log() for size in sizes), noise.log(), odds, own], 1)

    def _correct(self, features: Tensor) -> Tensor:
        """The correction f of a step, ``(N, 1, H, W)``."""
        size = features.shape[-2:]
        half = self.correction(functional.avg_pool2d(features, 2, ceil_mode=True))
        return functional.interpolate(MOST * torch.tanh(half / MOST), size, mode="bilinear", align_corners=False)


def _encode(irradiance: Tensor, scale: Tensor) -> Tensor:
    """Radiance on the transfer curve."""
    return pu_forward((irradiance * scale).clamp_min(0))


def _box(image: Tensor, size: int) -> Tensor:
    """Box mean, of the pixels within the image."""
    return functional.avg_pool2d(image, size, 1, size // 2, count_include_pad=False) if size > 1 else image
