"""The network beside estimates: frame weights, shares of the residual, and where training starts."""

# ruff: noqa: E402 - nothing of network can be imported before it is known that torch is there

from __future__ import annotations

import pytest

torch = pytest.importorskip("torch")

from network.inputs import network_inputs
from network.models import denoise_tile, filter_window, for_inference
from network.stabilizer import Stabilized, Stabilizer, StabilizerConfig, shrink

pytestmark = pytest.mark.neural


def uniform(*shape: int, seed: int = 0) -> torch.Tensor:
    return torch.rand(*shape, generator=torch.Generator().manual_seed(seed))


def window(n: int = 1, t: int = 3, h: int = 16, w: int = 24) -> dict[str, torch.Tensor]:
    """A made-up aligned window; the estimates are darker than the frames on average."""
    color = uniform(n, t, 3, h, w) + 0.2
    return {
        "color": color,
        "albedo": uniform(n, t, 3, h, w, seed=1),
        "normal": uniform(n, t, 3, h, w, seed=2) * 2 - 1,
        "estimate": uniform(n, t, 3, h, w, seed=4) * 0.1 + 0.5,
        "confidence": uniform(n, t, 1, h, w, seed=3),
        "exposure": color.mean((1, 2, 3, 4)),
    }


def small(frames: int = 3, threshold: float = 0.05, cell: int = 2) -> Stabilizer:
    torch.manual_seed(0)
    return Stabilizer(StabilizerConfig(frames, cell, (16, 8), (0, 1), threshold))


def silent(model: Stabilizer) -> Stabilizer:
    """A model that corrects no weight and adds nothing of the residual."""
    with torch.no_grad():
        for parameter in (*model.weight.parameters(), *(p for head in model.shares for p in head.parameters())):
            parameter.zero_()
        for head in model.shares:
            head[-1].bias.fill_(-50)  # a share of 0.25 %, the least there is
    return model


@torch.no_grad()
def stabilized(model: Stabilizer, data: dict[str, torch.Tensor], threshold: float | None = None) -> Stabilized:
    return filter_window(model, data, threshold)


def denoised(model: Stabilizer, data: dict[str, torch.Tensor]) -> torch.Tensor:
    return denoise_tile(model, data)[0]


def test_without_corrections_it_is_the_gated_average() -> None:
    data = window()
    c, e = data["confidence"] + 1e-3, data["estimate"]
    expected = (c * e).sum(1) / c.sum(1)
    # But for a share of the residual, which is some tenths.
    torch.testing.assert_close(denoised(silent(small(threshold=0.0)), data), expected, rtol=0, atol=5e-3)
    weights = stabilized(silent(small(threshold=0.0)), data).denominators
    torch.testing.assert_close(weights, c / c.sum(1, keepdim=True))


def test_bands_and_shares_against_plain_loops() -> None:
    """One level: a 2×2 mean, its bilinear interpolation, and what that leaves."""
    residual = uniform(1, 1, 4, 4)
    fine, coarse = uniform(1, 1, 4, 4, seed=1), uniform(1, 1, 2, 2, seed=2)
    low = torch.stack([residual[0, 0, y : y + 2, x : x + 2].mean() for y in (0, 2) for x in (0, 2)]).view(2, 2)

    def up(image: torch.Tensor, y: int, x: int) -> torch.Tensor:
        total = torch.zeros(())
        for axis_y, weight_y in interpolate(y):
            for axis_x, weight_x in interpolate(x):
                total = total + weight_y * weight_x * image[axis_y, axis_x]
        return total

    def interpolate(place: int) -> list[tuple[int, float]]:
        at = min(max((place + 0.5) / 2 - 0.5, 0), 1)
        return [(0, 1 - at), (1, at)]

    expected = torch.zeros(1, 1, 4, 4)
    for y in range(4):
        for x in range(4):
            band = residual[0, 0, y, x] - up(low, y, x)
            expected[0, 0, y, x] = fine[0, 0, y, x] * band + up(low * coarse[0, 0], y, x)
    torch.testing.assert_close(shrink(residual, (fine, coarse)), expected)


def test_shares_of_one_give_the_residual_and_of_nought_nothing() -> None:
    residual = uniform(2, 3, 16, 24)
    for share in (0.0, 0.3, 1.0):
        shares = [torch.full((2, 1, 16 >> s, 24 >> s), share) for s in range(4)]
        torch.testing.assert_close(shrink(residual, shares), share * residual, rtol=1e-4, atol=1e-6)


def test_what_the_estimates_have_lost_comes_back_at_coarse_scales() -> None:
    """Estimates that are 10 % too dark everywhere: the coarsest share alone restores the mean."""
    model, data = silent(small()), window()
    data["estimate"] = torch.full_like(data["color"], 0.9)
    data["color"] = 0.5 + uniform(1, 3, 3, 16, 24)
    data["confidence"] = torch.ones_like(data["confidence"])
    with torch.no_grad():
        model.shares[-1][-1].bias.fill_(50)
    torch.testing.assert_close(denoised(model, data).mean(), data["color"].mean(), rtol=1e-3, atol=0)


@pytest.mark.parametrize("cell", [1, 2, 4])
def test_features_of_a_cell_are_bands_and_weights_of_its_pixels(cell: int) -> None:
    model, data = small(cell=cell), window(w=32)
    assert model.multiple == 4 * cell
    result = stabilized(model, data)
    # Each scale of the network, a coarser one, and the finer ones up to the picture's own.
    assert [share.shape[-2:] for share in result.shares] == [(16 >> k, 32 >> k) for k in range(2 + cell.bit_length())]
    bare = {**data, "confidence": torch.ones_like(data["confidence"])}
    weights = stabilized(model, bare).denominators
    assert not torch.equal(weights[..., ::cell, ::cell], weights[..., cell - 1 :: cell, cell - 1 :: cell]) or cell == 1


@pytest.mark.parametrize("frames", [1, 3, 5, 7])
def test_parts_of_the_frames_sum_to_the_image(frames: int) -> None:
    model, data = small(frames), window(n=2, t=frames)
    result = stabilized(model, data)
    parts, weights = result.parts()
    torch.testing.assert_close(parts.sum(1), result.image(data["color"][:, frames // 2]), rtol=1e-4, atol=1e-5)
    torch.testing.assert_close(weights.sum(1), torch.ones(2, 1, 16, 24))
    assert float(weights.min()) >= 0
    everything = result.image(data["color"][:, frames // 2], range(frames))
    torch.testing.assert_close(everything, result.image(data["color"][:, frames // 2]))


def test_a_frame_without_confidence_has_no_weight() -> None:
    data = window()
    data["confidence"] = torch.tensor([1.0, 1.0, 0.0]).view(1, 3, 1, 1, 1).expand(1, 3, 1, 16, 24)
    assert not bool(stabilized(small(), data).denominators[:, 2].any())


def test_a_higher_threshold_keeps_fewer_frames_and_never_none() -> None:
    data, used = window(), []
    for threshold in (0.0, 0.5, 0.9):
        weights = stabilized(small(), data, threshold).denominators
        torch.testing.assert_close(weights.sum(1), torch.ones(1, 1, 16, 24))
        used.append(int((weights > 0).sum()))
    assert used[0] > used[1] > used[2]


def test_it_is_scale_equivariant() -> None:
    model, data = small(), window()
    for scale in (1e-3, 37.0, 1e4):
        scaled = {**data, **{name: data[name] * scale for name in ("color", "estimate", "exposure")}}
        torch.testing.assert_close(denoised(model, scaled), denoised(model, data) * scale, rtol=1e-4, atol=0)


def test_the_side_frames_may_change_places() -> None:
    """Weights are shared over the frames, and an RA block sees a frame's opposite as it sees the frame."""
    data = window(t=3)
    swapped = {n: v if n == "exposure" else v[:, [2, 1, 0]] for n, v in data.items()}
    model = small()
    # Of three frames the first to be visited sees the other as it was, the second as it has become: close, not equal.
    torch.testing.assert_close(denoised(model, swapped), denoised(model, data), rtol=0.02, atol=0.02)


def test_a_firefly_in_the_residual_is_bounded() -> None:
    model, data = small(), window()
    before = denoised(model, data)
    data["color"][0, 1, :, 8, 8] = 1e6
    after = denoised(model, data)
    assert bool(torch.isfinite(after).all())
    assert float((after - before).abs().max()) < 4 * (1 + float(data["exposure"]))


def test_layers_are_averaged_with_the_frames_weights() -> None:
    model, data = small(), window()
    layers = uniform(1, 3, 2, 16, 24, seed=9)
    _, result, averaged = denoise_tile(model, data, aovs=layers)
    torch.testing.assert_close(averaged, (result.denominators * layers).sum(1), rtol=1e-4, atol=1e-5)


def test_bfloat16_is_close_to_float32() -> None:
    data = window()
    full = denoised(for_inference(small(), bfloat16=False), data)
    half = denoised(for_inference(small(), bfloat16=True), data)
    assert not torch.equal(half, full)
    torch.testing.assert_close(half, full, rtol=1e-2, atol=1e-2)  # 8 bits, in weights and shares alone


def test_what_does_not_fit_is_an_error() -> None:
    data, model = window(), small()
    with pytest.raises(ValueError, match="estimate: expected one beside color"):
        filter_window(model, {**data, "estimate": None})
    with pytest.raises(ValueError, match="expected a height that is a multiple of 8"):
        filter_window(model, window(h=12))
    features = network_inputs(data["color"], None, None, data["confidence"], data["exposure"])
    with pytest.raises(ValueError, match=r"features: expected \(N, 3, 16, H, W\)"):
        model(features, data["color"], data["estimate"], data["confidence"], data["exposure"])
    with pytest.raises(ValueError, match="threshold: expected 0 <= t·K < 1"):
        filter_window(model, data, 1.0)
    for change, message in (
        ({"frames": 4}, "frames: expected an odd number"),
        ({"cell": 3}, "cell: expected 1, 2, 4 or 8"),
        ({"widths": ()}, "widths: expected at least one"),
        ({"cell": 4, "widths": (8, 16)}, "widths: expected the first to be a multiple of 16"),
        ({"ra_scales": (3,)}, "ra_scales: expected scales 0 to 2"),
        ({"threshold": 1.0}, "threshold: expected"),
    ):
        with pytest.raises(ValueError, match=message):
            StabilizerConfig(**change)
