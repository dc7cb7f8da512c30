"""Image losses, and their conversion from space to time.

Image losses are scale invariant: ``loss(a·x, a·y, a·s) = loss(x, y, s)``. With noisy targets (Lehtinen et al. 2018)
they differ in the mean: a squared error is least at the mean of the targets, so `relmse`, whose weights depend on the
prediction alone and carry no gradient, is unbiased. `l1` is least at the median, and Monte Carlo noise is skewed, with
its median below its mean: it darkens. `smape` is an L1 error with a weight that depends on the target too and darkens
as well, where the noise is strong. `relmse` with a limit on outliers stays between the two: it only darkens by the
light beyond the limit.
"""

from itertools import combinations
from typing import Protocol

import torch
from torch import Tensor
from torch.nn import functional

from network.paper.kernels import Filtered

Term = tuple[tuple[int, ...], float]  # frames of a window, and the weight of the loss of their image

#: Weight of the fallback in the image of a subset of frames. The kernels sum to 1 over all frames; a subset to
#: which they give less than this is mostly its own unfiltered pixels, and dividing by its share stays harmless.
SUBSET_EPSILON = 1e-3

#: Floor of the denominator of `relmse`, in squared scales: pixels darker than a third of the scale count as that.
RELMSE_FLOOR = 0.1


class ImageLoss(Protocol):
    """An image loss, ``(N,)``, of ``(N, C, H, W)`` radiance, ``(N,)`` scale of the radiance, and weights of errors."""

    def __call__(self, prediction: Tensor, target: Tensor, scale: Tensor, weight: Tensor | None = None) -> Tensor: ...


def l1(prediction: Tensor, target: Tensor, scale: Tensor, weight: Tensor | None = None) -> Tensor:
    """Mean absolute error over the scale: ``mean |d − r| / s``. Darkens with noisy targets (median)."""
    return _mean((prediction - target).abs(), weight) / scale


def smape(prediction: Tensor, target: Tensor, scale: Tensor, weight: Tensor | None = None) -> Tensor:
    """Symmetric mean absolute percentage error: ``mean |d − r| / (|d| + |r| + ε s)``, ε = 1e-2, where "dark" starts.

    Vogels et al. 2018, "Denoising with Kernel Prediction and Asymmetric Loss Functions", doi:10.1145/3197517.3201388.
    """
    floor = 1e-2 * scale.view(-1, 1, 1, 1)
    return _mean((prediction - target).abs() / (prediction.abs() + target.abs() + floor), weight)


def relmse(
    prediction: Tensor, target: Tensor, scale: Tensor, weight: Tensor | None = None, limit: float = 4.0
) -> Tensor:
    """Relative squared error with denominators from the prediction: ``mean (d − r)² / (d̄² + ε s²)``, ε = 0.1.

    Beyond the relative error `limit` the square continues as a straight line (Huber), so that one firefly in a target
    is not the whole gradient; ``inf`` is the pure, unbiased square (Lehtinen et al. 2018, section 3.3,
    arXiv:1803.04189).

    ``d̄`` is the mean of the prediction over the channels, without gradient: dividing by each channel would let
    dark channels of saturated colors dominate. Pixels darker than ``sqrt(ε) s``, a third of the scale, count by
    absolute error.
    """
    level = prediction.detach().mean(1, keepdim=True)
    relative = (prediction - target) * torch.rsqrt(level**2 + RELMSE_FLOOR * scale.view(-1, 1, 1, 1) ** 2)
    return _mean(bent_square(relative, limit), weight)


def display(
    prediction: Tensor, target: Tensor, scale: Tensor, weight: Tensor | None = None, limit: float = 0.5
) -> Tensor:
    """Squared error on the display curve ``T(x) = x / (x + s)``, to first order: ``mean (T'(d) (d − r))²``.

    Beyond the error `limit`, of the range of T, the square continues as a straight line, as of `relmse`.

    About the square of `tone_mapped_psnr` at the exposure of the image. Its weights, ``T'(d) = s / (d + s)²``, depend
    on the prediction and carry no gradient, so that the noise of targets, which would darken a difference of T, leaves
    the mean alone but for light beyond the limit. Towards references it is better than `relmse`, which weighs dark
    pixels relative to themselves: a network trained so averaged more over time than the eye, or PSNR, would have it.
    """
    level = scale.view(-1, 1, 1, 1)
    slope = level / (functional.relu(prediction.detach()) + level).square()
    return _mean(bent_square((prediction - target) * slope, limit), weight)


def frame_pairs(frames: int) -> list[tuple[int, int]]:
    """Pairs of a frame before the centre and one after, ``(i, i + k + 1)`` of 2k + 1: 1st + 4th, 2nd + 5th of five."""
    half = frames // 2
    return [(i, i + half + 1) for i in range(half)]


def spatial_terms(frames: int) -> list[Term]:
    """One term, the whole window, as Vogels et al. 2018 train: the spatial loss of a temporal network."""
    return [(tuple(range(frames)), 1.0)]


def temporal_terms(frames: int, whole: float = 0.0) -> list[Term]:
    """The paper's terms in practice: the centre first, each of `frame_pairs`, and the whole window with its own weight.

    The paper uses the whole window's term only to train a model further, and downweighted, because on its own it
    leads away from using time; weight 0 leaves it out.
    """
    return [
        ((frames // 2,), 1.0),
        *((pair, 1.0) for pair in frame_pairs(frames)),
        *((subset, whole) for subset, _ in spatial_terms(frames) if whole and frames > 1),
    ]


def power_terms(frames: int) -> list[Term]:
    """The paper's equation in full: every subset of the window but the empty one, of equal weight; 31 for five."""
    sizes = range(1, frames + 1)
    return [(subset, 1.0) for size in sizes for subset in combinations(range(frames), size)]


def asymmetry(prediction: Tensor, target: Tensor, noisy: Tensor, slope: float) -> Tensor:
    """Weights of errors on the far side of the target: λ where ``(d − r)(r − c) > 0``, else 1; c the noisy centre.

    The greater the slope λ ≥ 1, the more the network prefers noise to lost detail. For clean targets: where the
    target's noise is independent of the input's, that noise decides on which side the prediction is. Vogels et al.
    2018, section 5.4.
    """
    beyond = (prediction.detach() - target) * (target - noisy) > 0
    return torch.where(beyond, slope, 1.0)


def temporal_loss(
    loss: ImageLoss,
    filtered: Filtered,
    color: Tensor,
    target: Tensor,
    modulation: Tensor,
    scale: Tensor,
    terms: list[Term],
    slope: float = 1.0,
) -> Tensor:
    """Spatial loss converted to a temporal one: the target is predicted from parts of the window.

    Returns ``(N,)`` weighted mean of the terms; images are ``(N, C, H, W)``, `color` is ``(N, T, C, H, W)`` aligned
    irradiance, the fallback of a subset to which the kernels give no weight; `scale` ``(N,)`` the exposure of the
    irradiance, `slope` the λ of `asymmetry`. A subset's image is the mean of its taps: the kernels of the other frames
    are zeroed and the rest renormalised (Kalojanov and Thurston 2023, section 5, equation 5).
    """
    centre = color.shape[1] // 2
    total = torch.zeros_like(scale)
    for subset, weight in terms:
        fallback = color[:, centre] if centre in subset else color[:, list(subset)].mean(1)
        image = filtered.image(fallback, subset, SUBSET_EPSILON)
        total = total + weight * image_loss(loss, image, color[:, centre], target, modulation, scale, slope)
    return total / sum(weight for _, weight in terms)


def image_loss(
    loss: ImageLoss, image: Tensor, noisy: Tensor, target: Tensor, modulation: Tensor, scale: Tensor, slope: float = 1.0
) -> Tensor:
    """Loss (N,) of the radiance of one image; parameters as for `temporal_loss`."""
    radiance = image * modulation
    weights = None if slope == 1 else asymmetry(radiance, target, noisy * modulation, slope)
    return loss(radiance, target, scale_of_radiance(scale, modulation), weights)


def difference_loss(
    loss: ImageLoss, images: Tensor, targets: Tensor, modulation: Tensor, scale: Tensor, to_next: Tensor, trust: Tensor
) -> Tensor:
    """Loss of flicker (N,): of changes between two successive images that their targets do not have.

    Images, targets and modulation are ``(N, 2, C, H, W)``, the earlier frame first, `scale` ``(N, 2)``; `to_next` ``(N,
    2, H, W)`` pixels, from each pixel of the first to its place in the second; `trust` ``(N, 1, H, W)`` in [0, 1].

    With ``e_i = d_i − r_i`` and W the warp along the motion it is ``loss(d_1, r_1 + W e_2)``, weighted by trust, and by
    0 where the motion leaves the crop: the error of the motion-compensated difference of the images, which is what
    temporal PSNR measures. Independent noise in the targets adds to it and does not move where it is least.
    """
    error = (images[:, 1] * modulation[:, 1]) - targets[:, 1]
    height, width = to_next.shape[-2:]
    rows, columns = (torch.arange(size, device=to_next.device, dtype=to_next.dtype) for size in (height, width))
    at_x, at_y = to_next[:, 0] + columns, to_next[:, 1] + rows[:, None]
    # grid_sample has −1 and 1 at the outer edges of the outer pixels.
    grid = torch.stack([(2 * at_x + 1) / width - 1, (2 * at_y + 1) / height - 1], -1)
    warped = functional.grid_sample(error, grid, mode="bilinear", padding_mode="border", align_corners=False)
    inside = (at_x >= 0) & (at_x <= width - 1) & (at_y >= 0) & (at_y <= height - 1)
    weight = (trust * inside[:, None]).expand_as(error)
    radiance = scale_of_radiance(scale[:, 0], modulation[:, 0])
    return loss(images[:, 0] * modulation[:, 0], targets[:, 0] + warped, radiance, weight)


def tone_mapped_psnr(prediction: Tensor, target: Tensor) -> Tensor:
    """PSNR (N,) of radiance on ``x / (1 + x)``, in dB, at most 120; negative radiance counts as 0."""
    error = functional.relu(prediction) / (1 + functional.relu(prediction))
    error = error - functional.relu(target) / (1 + functional.relu(target))
    return -10 * torch.log10(error.square().mean((1, 2, 3)).clamp_min(1e-12))


def scale_of_radiance(scale: Tensor, modulation: Tensor) -> Tensor:
    """Scale (N,) of the radiance of windows; a black modulation (no albedo anywhere) would make it 0."""
    return scale * modulation.mean((1, 2, 3)).clamp_min(1e-3)


def bent_square(errors: Tensor, limit: float) -> Tensor:
    """Quadratic inside the limit, tangent outside (Huber)."""
    # The minimum keeps an infinite limit from making inf − inf.
    size = errors.abs()
    inside = size.clamp(max=limit)
    return inside * (2 * size - inside)


def _mean(errors: Tensor, weight: Tensor | None) -> Tensor:
    """Mean per sample of errors, weighted where there are weights."""
    return (errors if weight is None else errors * weight).mean((1, 2, 3))
