import math

import pytest
import torch

from network.paper.kernels import Filtered, apply_kernels, mean_of, predict_kernel
from network.training.losses import (
    SUBSET_EPSILON,
    asymmetry,
    difference_loss,
    display,
    frame_pairs,
    l1,
    power_terms,
    relmse,
    smape,
    spatial_terms,
    temporal_loss,
    temporal_terms,
    tone_mapped_psnr,
)

LOSSES = [l1, smape, relmse, display]


def uniform(*shape: int, seed: int = 0) -> torch.Tensor:
    return torch.rand(*shape, generator=torch.Generator().manual_seed(seed), dtype=torch.float64)


def by_loops(name: str, d: torch.Tensor, r: torch.Tensor, s: float) -> float:
    """Each equation, pixel by pixel, for one sample (C, H, W)."""
    values = []
    for y in range(d.shape[1]):
        for x in range(d.shape[2]):
            level = sum(d[:, y, x].tolist()) / len(d)
            for a, b in zip(d[:, y, x].tolist(), r[:, y, x].tolist(), strict=True):
                if name == "l1":
                    values.append(abs(a - b) / s)
                elif name == "smape":
                    values.append(abs(a - b) / (abs(a) + abs(b) + 0.01 * s))
                elif name == "display":
                    e = abs(a - b) * s / (a + s) ** 2
                    values.append(e**2 if e <= 0.5 else 0.5**2 + 2 * 0.5 * (e - 0.5))
                else:
                    e = abs(a - b) / math.sqrt(level**2 + 0.1 * s**2)
                    values.append(e**2 if e <= 4 else 4**2 + 2 * 4 * (e - 4))
    return sum(values) / len(values)


@pytest.mark.parametrize("loss", LOSSES)
def test_losses_against_loops(loss) -> None:  # type: ignore[no-untyped-def]
    prediction, target = uniform(2, 3, 4, 5), uniform(2, 3, 4, 5, seed=1)
    target[1, :, 2, 2] = 40  # beyond the limits of relmse and display
    scale = torch.tensor([0.5, 2.0], dtype=torch.float64)
    expected = [by_loops(loss.__name__, prediction[i], target[i], float(scale[i])) for i in range(2)]
    torch.testing.assert_close(loss(prediction, target, scale), torch.tensor(expected, dtype=torch.float64))


@pytest.mark.parametrize("loss", LOSSES)
def test_losses_do_not_depend_on_the_scale(loss) -> None:  # type: ignore[no-untyped-def]
    prediction, target, scale = uniform(1, 3, 4, 5), uniform(1, 3, 4, 5, seed=1), uniform(1, seed=2)
    torch.testing.assert_close(loss(prediction * 1e4, target * 1e4, scale * 1e4), loss(prediction, target, scale))


@pytest.mark.parametrize("loss", LOSSES)
def test_losses_of_equal_and_of_black_images_are_zero(loss) -> None:  # type: ignore[no-untyped-def]
    image, scale = uniform(1, 3, 4, 5), torch.ones(1, dtype=torch.float64)
    assert loss(image, image, scale).tolist() == [0]
    assert loss(image * 0, image * 0, scale).tolist() == [0]


@pytest.mark.parametrize("loss", LOSSES)
def test_gradients_of_losses(loss) -> None:  # type: ignore[no-untyped-def]
    prediction, target = uniform(1, 3, 2, 2).requires_grad_(), uniform(1, 3, 2, 2, seed=1)
    scale = torch.ones(1, dtype=torch.float64)
    if loss in (relmse, display):  # their denominators are meant to have none
        (gradient,) = torch.autograd.grad(loss(prediction, target, scale).sum(), prediction)
        level = prediction.detach().mean(1, keepdim=True)
        below = level**2 + 0.1 if loss is relmse else (prediction + 1) ** 4
        expected = 2 * (prediction - target) / below / prediction.numel()
        torch.testing.assert_close(gradient, expected.detach())
    else:
        assert torch.autograd.gradcheck(lambda x: loss(x, target, scale), prediction)


def pull_at_the_mean(loss) -> float:  # type: ignore[no-untyped-def]
    """Slope of the loss at the true mean, where targets have the skewed noise of path tracing (gamma, mean 1).

    Positive: the loss falls towards darker predictions. In relative units, so that losses compare.
    """
    generator = torch.Generator().manual_seed(0)
    # Sum of two exponentials over 2: mean 1, standard deviation 0.71, median 0.84.
    target = -torch.log(torch.rand(2, 1, 3, 200, 200, generator=generator, dtype=torch.float64)).mean(0)
    target = target / target.mean()
    prediction = torch.ones_like(target, requires_grad=True)
    (gradient,) = torch.autograd.grad(loss(prediction, target, torch.ones(1, dtype=torch.float64)).sum(), prediction)
    return float(gradient.sum() / gradient.abs().sum())


def test_squares_do_not_bias_the_mean_and_the_others_darken_it() -> None:
    # Exactly zero but for rounding: the sample's own mean is 1.
    for square in (relmse, display):
        assert abs(pull_at_the_mean(lambda *a, of=square: of(*a, limit=math.inf))) < 1e-9
    # 59 % of such targets are below their mean; L1 counts heads: 0.59 − 0.41.
    assert pull_at_the_mean(l1) == pytest.approx(0.19, abs=0.02)
    assert pull_at_the_mean(smape) > 0.1
    # Values beyond four times, and three times, the mean are 0.3 and 1.7 % here: the limits cost next to nothing.
    assert 0 <= pull_at_the_mean(relmse) < 0.01
    assert 0 <= pull_at_the_mean(display) < 0.03


def test_display_is_the_squared_difference_of_what_is_seen_to_first_order() -> None:
    target, scale = 3 * uniform(1, 3, 8, 8), torch.full((1,), 0.7, dtype=torch.float64)
    prediction = target * (1 + 1e-4 * uniform(1, 3, 8, 8, seed=1))
    seen = ((prediction / (prediction + 0.7)) - (target / (target + 0.7))).square().mean()
    torch.testing.assert_close(display(prediction, target, scale)[0], seen, rtol=1e-3, atol=0)


def a_pair(size: int = 8) -> dict[str, torch.Tensor]:
    """Two pictures of a motion by (2, −1) pixels whose errors do not move with it, and the same of the targets."""
    targets = uniform(1, 2, 3, size, size) + 1
    to_next = torch.tensor([2.0, -1.0], dtype=torch.float64)[None, :, None, None].expand(1, 2, size, size)
    return {
        "images": targets + 0.1 * uniform(1, 2, 3, size, size, seed=1),
        "targets": targets,
        "modulation": torch.ones_like(targets),
        "scale": torch.ones(1, 2, dtype=torch.float64),
        "to_next": to_next,
        "trust": torch.ones(1, 1, size, size, dtype=torch.float64),
    }


def test_the_loss_of_differences_is_that_of_errors_compared_along_the_motion() -> None:
    pair = a_pair()
    pair["trust"][..., 3, 3] = 0
    error = pair["images"] - pair["targets"]
    total = 0.0
    for y in range(8):
        for x in range(8):
            v, u = y - 1, x + 2
            if 0 <= v < 8 and 0 <= u < 8 and (y, x) != (3, 3):
                total += float((error[0, 0, :, y, x] - error[0, 1, :, v, u]).abs().sum())
    assert float(difference_loss(l1, **pair)) == pytest.approx(total / error[0, 0].numel(), rel=1e-9)


def test_an_error_that_stays_with_the_motion_does_not_flicker() -> None:
    pair = a_pair()
    error = uniform(1, 3, 8, 8, seed=2)
    # The point at (y, x) in the first frame is at (y − 1, x + 2) in the second.
    moved = error.roll((-1, 2), (-2, -1))
    pair["images"] = pair["targets"] + torch.stack([error, moved], 1)
    assert float(difference_loss(display, **pair)) < 1e-20
    pair["to_next"] = torch.zeros_like(pair["to_next"])
    assert float(difference_loss(display, **pair)) > 1e-4


def test_vectors_that_point_nowhere_leave_the_loss_of_differences_finite() -> None:
    pair = a_pair()
    pair["to_next"] = torch.full_like(pair["to_next"], 60000.0)
    images = pair.pop("images").requires_grad_()
    value = difference_loss(display, images, **pair)
    (gradient,) = torch.autograd.grad(value.sum(), images)
    assert value.tolist() == [0]
    assert bool(torch.isfinite(gradient).all())


def test_the_limit_bounds_what_one_firefly_does() -> None:
    target = torch.ones(1, 3, 8, 8, dtype=torch.float64)
    target[0, :, 3, 3] = 1e6
    prediction = torch.ones_like(target, requires_grad=True)
    (gradient,) = torch.autograd.grad(relmse(prediction, target, torch.ones(1)).sum(), prediction)
    assert float(gradient.abs().max()) <= 2 * 4 / 192 + 1e-12  # 2 · limit over the number of values


def test_pairs_are_one_frame_before_and_one_after() -> None:
    assert frame_pairs(5) == [(0, 3), (1, 4)]  # the paper's: first and fourth, second and fifth
    assert frame_pairs(3) == [(0, 2)]
    assert frame_pairs(7) == [(0, 4), (1, 5), (2, 6)]
    assert frame_pairs(1) == []


@pytest.mark.parametrize("loss", LOSSES)
def test_weights_multiply_the_errors(loss) -> None:  # type: ignore[no-untyped-def]
    prediction, target, weight = uniform(1, 3, 4, 5), uniform(1, 3, 4, 5, seed=1), uniform(1, 3, 4, 5, seed=2)
    one = torch.ones(1, dtype=torch.float64)
    parts = [loss(prediction, target, one, (weight == w).double()) * w for w in weight.flatten()]
    torch.testing.assert_close(loss(prediction, target, one, weight), sum(parts))
    torch.testing.assert_close(loss(prediction, target, one, 0 * weight + 1), loss(prediction, target, one))


def test_asymmetry_against_loops() -> None:
    d, r, c = uniform(1, 3, 4, 5), uniform(1, 3, 4, 5, seed=1), uniform(1, 3, 4, 5, seed=2)
    weights = asymmetry(d, r, c, 2.5)
    for index in torch.cartesian_prod(*(torch.arange(n) for n in d.shape)).tolist():
        i = tuple(index)
        assert weights[i] == (2.5 if (d[i] - r[i]) * (r[i] - c[i]) > 0 else 1.0)
    # On the target or between it and the input nothing is punished; beyond it is.
    assert asymmetry(r, r, c, 2.5).unique().tolist() == [1]
    assert asymmetry((r + c) / 2, r, c, 2.5).unique().tolist() == [1]
    assert asymmetry(2 * r - c, r, c, 2.5).unique().tolist() == [2.5]


def test_terms_are_the_papers() -> None:
    assert temporal_terms(5) == [((2,), 1.0), ((0, 3), 1.0), ((1, 4), 1.0)]
    assert temporal_terms(5, 0.25)[-1] == ((0, 1, 2, 3, 4), 0.25)
    assert temporal_terms(1, 0.25) == [((0,), 1.0)]  # the centre is the whole
    assert spatial_terms(3) == [((0, 1, 2), 1.0)]
    assert [subset for subset, _ in power_terms(3)] == [(0,), (1,), (2,), (0, 1), (0, 2), (1, 2), (0, 1, 2)]
    assert len(power_terms(5)) == 2**5 - 1


@pytest.mark.parametrize(
    "terms",
    [*map(temporal_terms, (1, 3, 5)), temporal_terms(5, 0.25), power_terms(3), spatial_terms(5)],
)
def test_temporal_loss_is_the_loss_of_renormalised_subsets(terms) -> None:  # type: ignore[no-untyped-def]
    """Zero the excluded frames' weights, renormalise the kernel, apply it: section 5 of the paper."""
    frames = 1 + max(frame for subset, _ in terms for frame in subset)
    kernels = predict_kernel(uniform(2, frames * 9, 6, 5), 0.0, centre=frames * 9 // 2)
    color, target = uniform(2, frames, 3, 6, 5, seed=1), uniform(2, 3, 6, 5, seed=2)
    modulation, scale = uniform(2, 3, 6, 5, seed=3), torch.tensor([0.5, 2.0], dtype=torch.float64)
    filtered = Filtered.of(kernels, color)

    expected = 0
    for subset, weight in terms:
        kept = torch.zeros(frames, 1, dtype=torch.float64)
        kept[list(subset)] = 1
        part = kernels * kept.expand(frames, 9).reshape(1, -1, 1, 1)
        part = part / part.sum(1, keepdim=True)
        image = mean_of(*apply_kernels(part, color), color[:, frames // 2], 0) * modulation
        expected = expected + weight * l1(image, target, scale * modulation.mean((1, 2, 3)))
    expected = expected / sum(weight for _, weight in terms)
    got = temporal_loss(l1, filtered, color, target, modulation, scale, terms)
    # A subset has a share of about 1/5 or more; its fallback weighs 1e-3 beside that.
    torch.testing.assert_close(got, expected, rtol=2e-2, atol=0)
    assert SUBSET_EPSILON == 1e-3


def test_frames_without_weight_are_judged_by_their_own_pixels() -> None:
    """All weight on the centre: the pairs' images are the plain means of the pairs, and nothing is NaN."""
    color, target = uniform(1, 5, 3, 4, 4), uniform(1, 3, 4, 4, seed=1)
    numerators, denominators = torch.zeros(1, 5, 3, 4, 4).double(), torch.zeros(1, 5, 1, 4, 4).double()
    numerators[:, 2], denominators[:, 2] = color[:, 2], 1
    filtered = Filtered(numerators, denominators, denominators, color[:, 1])
    one = torch.ones(1, dtype=torch.float64)
    got = temporal_loss(l1, filtered, color, target, torch.ones_like(target), one, temporal_terms(5))
    images = [color[:, 2], color[:, [0, 3]].mean(1), color[:, [1, 4]].mean(1)]
    torch.testing.assert_close(got, sum(l1(image, target, one) for image in images) / 3)


def test_temporal_loss_does_not_depend_on_the_scale() -> None:
    color, target, modulation = uniform(1, 3, 3, 4, 4), uniform(1, 3, 4, 4, seed=1), uniform(1, 3, 4, 4, seed=2)
    sums = apply_kernels(predict_kernel(uniform(1, 27, 4, 4), centre=13), color)
    scale = torch.ones(1, dtype=torch.float64)
    terms = temporal_terms(3, 1.0)
    once = temporal_loss(relmse, Filtered(*sums, sums[1], color[:, 1]), color, target, modulation, scale, terms, 3.0)
    numerators, denominators = sums
    bright = Filtered(numerators * 512, denominators, denominators, color[:, 1])
    scaled = temporal_loss(relmse, bright, color * 512, target * 512, modulation, scale * 512, terms, 3.0)
    torch.testing.assert_close(scaled, once)


def test_the_slope_weighs_each_terms_errors() -> None:
    color, target = uniform(1, 3, 3, 4, 4), uniform(1, 3, 4, 4, seed=1)
    sums = apply_kernels(predict_kernel(uniform(1, 27, 4, 4), centre=13), color)
    one = torch.ones(1, dtype=torch.float64)
    got = temporal_loss(
        smape, Filtered(*sums, sums[1], color[:, 1]), color, target, torch.ones_like(target), one, spatial_terms(3), 2.0
    )
    image = mean_of(*sums, color[:, 1], SUBSET_EPSILON)
    expected = smape(image, target, one, asymmetry(image, target, color[:, 1], 2.0))
    torch.testing.assert_close(got, expected)
    assert got > smape(image, target, one)


def test_psnr_on_the_tone_curve() -> None:
    a, b = torch.full((1, 3, 4, 4), 1.0), torch.full((1, 3, 4, 4), 3.0)
    # 1/2 against 3/4: an error of 1/4.
    assert tone_mapped_psnr(a, b).tolist() == pytest.approx([-20 * math.log10(0.25)], abs=1e-5)
    assert tone_mapped_psnr(-a, 0 * a).tolist() == pytest.approx([120])  # negative counts as 0; 1e-12 is the floor
