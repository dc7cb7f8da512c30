import itertools

import pytest
import torch

import network.paper.kernels
from network.paper.kernels import (
    Filtered,
    Pyramid,
    apply_kernels,
    mean_of,
    predict_kernel,
)


def uniform(*shape: int, seed: int = 0, dtype: torch.dtype = torch.float64) -> torch.Tensor:
    return torch.rand(*shape, generator=torch.Generator().manual_seed(seed), dtype=dtype)


def eta(weights: list[float], t: float, centre: int) -> list[float]:
    """The paper's activation, tap by tap."""
    above = [max(0.0, w - t) for w in weights]
    total = sum(above)
    if total == 0:
        return [1.0 if i == centre else 0.0 for i in range(len(weights))]
    return [a / total for a in above]


def by_loops(kernels: torch.Tensor, frames: torch.Tensor) -> tuple[torch.Tensor, torch.Tensor]:
    n, t, c, h, w = frames.shape
    size = round((kernels.shape[1] / t) ** 0.5)
    numerators, denominators = torch.zeros(n, t, c, h, w).double(), torch.zeros(n, t, 1, h, w).double()
    for b, f, y, x, row, column in itertools.product(range(n), range(t), range(h), range(w), range(size), range(size)):
        yy, xx = y + row - size // 2, x + column - size // 2
        if 0 <= yy < h and 0 <= xx < w:
            k = kernels[b, f * size * size + row * size + column, y, x]
            numerators[b, f, :, y, x] += k * frames[b, f, :, yy, xx]
            denominators[b, f, 0, y, x] += k
    return numerators, denominators


@pytest.mark.parametrize("t", [0.0, 0.05, 0.1])
def test_predicted_kernel_is_normalised_thresholded_and_normalised(t: float) -> None:
    weights = uniform(1, 9, 3, 4, seed=1) * 7 - 2
    weights[0, :, 1, 1] = -3
    kernel = predict_kernel(weights, t, centre=4)
    for y, x in itertools.product(range(3), range(4)):
        expected = torch.tensor(eta(eta(weights[0, :, y, x].tolist(), 0, 4), t, 4), dtype=torch.float64)
        torch.testing.assert_close(kernel[0, :, y, x], expected)


def test_the_default_threshold_is_half_of_one_over_k() -> None:
    weights = uniform(1, 8, 2, 2)
    assert torch.equal(predict_kernel(weights, centre=0), predict_kernel(weights, 1 / 16, centre=0))


def test_equal_weights_survive_every_threshold_that_is_allowed() -> None:
    kernel = predict_kernel(torch.full((1, 25, 1, 1), 1 / 25, dtype=torch.float64), 0.0399, centre=12)
    torch.testing.assert_close(kernel, torch.full_like(kernel, 1 / 25))


def test_nothing_above_the_threshold_gives_the_identity_and_no_gradient() -> None:
    weights = torch.full((1, 9, 1, 2), -1.0, dtype=torch.float64)
    weights[0, :, 0, 1] = 1
    weights.requires_grad_()
    kernel = predict_kernel(weights, centre=4)
    assert kernel[0, :, 0, 0].tolist() == [0, 0, 0, 0, 1, 0, 0, 0, 0]
    (gradient,) = torch.autograd.grad((kernel * uniform(1, 9, 1, 2)).sum(), weights)
    assert torch.equal(gradient[..., 0], torch.zeros(1, 9, 1, dtype=torch.float64))
    assert bool(gradient[..., 1].any())


def test_a_higher_threshold_removes_taps_and_never_adds_one() -> None:
    weights = uniform(1, 25, 8, 8)
    used = [predict_kernel(weights, t, centre=12) > 0 for t in (0, 0.01, 0.02, 0.03, 0.039)]
    for less, more in itertools.pairwise(used):
        assert not bool((more & ~less).any())
        assert int(more.sum()) < int(less.sum())


def test_kernels_are_float32_even_of_bfloat16_weights() -> None:
    kernel = predict_kernel(uniform(1, 126, 4, 4).bfloat16(), centre=62)
    assert kernel.dtype == torch.float32
    torch.testing.assert_close(kernel.sum(1), torch.ones(1, 4, 4))


def test_activation_gradient() -> None:
    weights = (uniform(2, 9, 3, 2, seed=5) * 0.5 - 0.1).requires_grad_()
    assert torch.autograd.gradcheck(lambda w: predict_kernel(w, 0.06, centre=4), weights)


def test_activation_gradient_with_a_threshold_per_sample() -> None:
    weights = uniform(2, 9, 3, 2, seed=5).requires_grad_()
    threshold = torch.tensor([0.02, 0.1], dtype=torch.float64).view(2, 1, 1, 1)
    assert torch.autograd.gradcheck(lambda w: predict_kernel(w, threshold, centre=4), weights)


# 3×4 and 1×2 pixels are smaller than the 5×5 kernel, so that some taps are outside everywhere.
@pytest.mark.parametrize(("size", "shape"), [(1, (4, 5)), (3, (4, 5)), (5, (3, 4)), (5, (1, 2))])
def test_applying_kernels_against_loops(size: int, shape: tuple[int, int]) -> None:
    kernels, frames = uniform(2, 3 * size * size, *shape), uniform(2, 3, 2, *shape, seed=1)
    for got, expected in zip(apply_kernels(kernels, frames), by_loops(kernels, frames), strict=True):
        torch.testing.assert_close(got, expected)


@pytest.mark.parametrize("shape", [(2, 1), (1, 2)])
def test_gradient_of_applying_kernels(shape: tuple[int, int]) -> None:
    kernels = uniform(2, 18, *shape).requires_grad_()
    frames = uniform(2, 2, 2, *shape, seed=1).requires_grad_()
    assert torch.autograd.gradcheck(apply_kernels, (kernels, frames))


@pytest.mark.parametrize(("size", "shape"), [(1, (4, 5)), (3, (4, 5)), (5, (37, 6)), (7, (2, 20))])
def test_what_other_devices_compute_is_what_processors_do(size, shape, monkeypatch) -> None:  # type: ignore[no-untyped-def]
    kernels = uniform(2, 2 * size * size, *shape).requires_grad_()
    frames = uniform(2, 2, 3, *shape, seed=1).requires_grad_()
    found = []
    for device in ("cpu", "other"):
        monkeypatch.setattr(network.paper.kernels, "_PROCESSOR", device)
        sums = apply_kernels(kernels, frames)
        found.append([*sums, *torch.autograd.grad([s.square().sum() for s in sums], (kernels, frames))])
    for here, there in zip(*found, strict=True):
        torch.testing.assert_close(there, here)


@pytest.mark.parametrize("dtype", [torch.bfloat16, torch.float16])
def test_halves_are_summed_in_float32(dtype: torch.dtype) -> None:
    kernels, frames = uniform(1, 50, 6, 5).to(dtype), uniform(1, 2, 3, 6, 5, seed=1).to(dtype)
    for got, expected in zip(apply_kernels(kernels, frames), by_loops(kernels.double(), frames.double()), strict=True):
        assert got.dtype == dtype
        torch.testing.assert_close(got, expected.to(dtype))


def test_an_impulse_shows_where_each_tap_reads() -> None:
    """Tap (frame 1, row 0, column 2) of a 3×3 kernel reads the pixel above and to the right, in frame 1."""
    kernels = torch.zeros(1, 27, 5, 5)
    kernels[0, 9 + 2] = 1
    frames = torch.zeros(1, 3, 1, 5, 5)
    frames[0, 1, 0, 1, 3] = 1
    numerators, _ = apply_kernels(kernels, frames)
    assert numerators.nonzero().tolist() == [[0, 1, 0, 2, 2]]


def test_constants_are_preserved_also_at_the_border() -> None:
    kernels = predict_kernel(uniform(1, 75, 6, 7).float(), centre=37)
    frames = torch.full((1, 3, 3, 6, 7), 1e6)
    filtered = mean_of(*apply_kernels(kernels, frames), frames[:, 1])
    torch.testing.assert_close(filtered, frames[:, 1])  # float32 rounding


def test_without_any_weight_the_image_is_the_fallback() -> None:
    fallback = uniform(1, 3, 4, 4)
    image = mean_of(torch.zeros(1, 2, 3, 4, 4), torch.zeros(1, 2, 1, 4, 4), fallback)
    torch.testing.assert_close(image, fallback)


# Several resolutions


def pyramid(n: int = 1, frames: int = 3, size: int = 3, side: int = 8) -> Pyramid:
    taps = frames * size * size
    kernels = tuple(predict_kernel(uniform(n, taps, side >> s, side >> s, seed=s), centre=taps // 2) for s in range(3))
    return Pyramid(kernels, tuple(uniform(n, 1, side >> s, side >> s, seed=10 + s) for s in range(2)))


def halved(image: torch.Tensor) -> torch.Tensor:
    """Mean of 2×2 pixels, written out."""
    return (image[..., ::2, ::2] + image[..., 1::2, ::2] + image[..., ::2, 1::2] + image[..., 1::2, 1::2]) / 4


def doubled(image: torch.Tensor) -> torch.Tensor:
    """Linear interpolation to twice the size, row by row and column by column: weights 3/4 and 1/4, clamped."""
    for axis in (-2, -1):
        x = image.movedim(axis, 0)
        rows = []
        for i in range(len(x)):
            rows += [0.75 * x[i] + 0.25 * x[max(i - 1, 0)], 0.75 * x[i] + 0.25 * x[min(i + 1, len(x) - 1)]]
        image = torch.stack(rows).movedim(0, axis)
    return image


@pytest.mark.parametrize("subset", [None, (0, 2)])
def test_resolutions_are_blended_as_in_the_equation(subset: tuple[int, ...] | None) -> None:
    kernels, color = pyramid(), uniform(1, 3, 2, 8, 8, seed=5)
    fallback = color[:, 1]
    got = Filtered.of(kernels, color).image(fallback, subset)
    images = []
    for kernel in kernels.kernels:
        numerators, denominators = by_loops(kernel, color)
        index = list(subset or range(3))
        images.append((numerators[:, index].sum(1) + 1e-6 * color[:, 1]) / (denominators[:, index].sum(1) + 1e-6))
        color = halved(color)
    for fine, blend in ((1, 1), (0, 0)):
        images[fine] = images[fine] + kernels.blends[blend] * doubled(images[fine + 1] - halved(images[fine]))
    torch.testing.assert_close(got, images[0])


def test_parts_of_several_resolutions_sum_to_the_image_and_to_one() -> None:
    color = uniform(2, 3, 2, 8, 8, seed=5)
    for kernels in (pyramid(2), pyramid(2).kernels[0]):
        filtered = Filtered.of(kernels, color)
        parts, shares = filtered.parts()
        torch.testing.assert_close(parts.sum(1), filtered.image(color[:, 1]), rtol=1e-5, atol=1e-5)  # ε = 1e-6
        torch.testing.assert_close(shares.sum(1), torch.ones(2, 1, 8, 8, dtype=torch.float64))


def test_gradient_through_all_resolutions() -> None:
    kernels, color = pyramid(side=4), uniform(1, 3, 1, 4, 4, seed=5)
    leaves = [value.clone().requires_grad_() for value in (*kernels.kernels, *kernels.blends)]

    def image(*values: torch.Tensor) -> torch.Tensor:
        return Filtered.of(Pyramid(values[:3], values[3:]), color).image(color[:, 1], (0, 2), 1e-3)

    assert torch.autograd.gradcheck(image, leaves)
