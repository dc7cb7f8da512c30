"""The networks: what goes in, which kernels come out, and what connects the frames."""

from dataclasses import replace

import pytest
import torch

from network.paper.inputs import KernelWindow, network_inputs
from network.paper.kernels import apply_kernels, mean_of
from network.paper.models import (
    TKPCN,
    KernelConfig,
    KernelHead,
    MultiScale,
    MultiScaleConfig,
    RAResNet,
    RAResNetConfig,
    RAUNet,
    RAUNetConfig,
    TKPCNConfig,
    filter_window,
    for_inference,
)
from network.presets import build_preset

SMALL = KernelConfig(frames=3, size=3)


def uniform(*shape: int, seed: int = 0) -> torch.Tensor:
    return torch.rand(*shape, generator=torch.Generator().manual_seed(seed))


def window(n: int = 1, t: int = 3, h: int = 8, w: int = 12) -> dict[str, torch.Tensor]:
    """A made-up aligned window."""
    return {
        "color": uniform(n, t, 3, h, w),
        "albedo": uniform(n, t, 3, h, w, seed=1),
        "normal": uniform(n, t, 3, h, w, seed=2) * 2 - 1,
        "confidence": uniform(n, t, 1, h, w, seed=3),
    }


def small_unet(kernel: KernelConfig = SMALL, **sizes: tuple[int, ...]) -> RAUNet:
    torch.manual_seed(0)
    return RAUNet(RAUNetConfig(kernel, **{"widths": (4, 8, 8), **sizes}))


def small_resnet(kernel: KernelConfig = SMALL) -> RAResNet:
    torch.manual_seed(0)
    return RAResNet(RAResNetConfig(kernel, width=4, blocks=4, ra_after=(1, 2, 4), skips=2))


def small_tkpcn(kernel: KernelConfig = SMALL) -> TKPCN:
    torch.manual_seed(0)
    return TKPCN(TKPCNConfig(kernel, width=4, blocks=2))


def exposure(color: torch.Tensor) -> torch.Tensor:
    """Brightness of a window; 1 of a black one."""
    mean = color.mean((1, 2, 3, 4))
    return torch.where(mean > 0, mean, 1)


@torch.no_grad()
def run(model: RAUNet | RAResNet | TKPCN | MultiScale, data: dict[str, torch.Tensor]) -> torch.Tensor:
    """Kernels of a window."""
    return model(network_inputs(KernelWindow(**data, exposure=exposure(data["color"]))), data["confidence"])


# Kernels of an untrained model


def silent_head(config: KernelConfig) -> KernelHead:
    """A head that predicts no correction."""
    head = KernelHead(4, config)
    for parameter in head.parameters():
        torch.nn.init.zeros_(parameter)
    return head


def test_at_full_confidence_the_kernels_start_at_the_mean_over_time() -> None:
    kernels = silent_head(KernelConfig())(torch.zeros(5, 4, 6, 6), torch.ones(1, 5, 1, 6, 6))
    torch.testing.assert_close(kernels, torch.full((1, 125, 6, 6), 1 / 125))


@pytest.mark.parametrize("threshold", [0.0, 0.5, 0.9])
def test_the_kernels_start_at_the_confidence(threshold: float) -> None:
    config = KernelConfig(frames=3, size=3, threshold=threshold)
    confidence = torch.tensor([0.5, 1.0, 0.0]).view(1, 3, 1, 1, 1).expand(2, 3, 1, 4, 4)
    kernels = silent_head(config)(torch.zeros(6, 4, 4, 4), confidence)
    expected = torch.tensor([1 / 3, 2 / 3, 0]).view(1, 3, 1, 1).expand(2, 3, 4, 4)
    # 1e-3 is added to each confidence.
    torch.testing.assert_close(kernels.unflatten(1, (3, 9)).sum(2), expected, rtol=0, atol=2e-3)


def test_a_correction_gives_a_tap_any_weight_or_none() -> None:
    """All weight on one tap at the edge of each frame."""
    head = silent_head(SMALL)
    with torch.no_grad():
        head.window.bias.fill_(-50)
        head.window.bias[7] = 50
        kernels = head(torch.ones(3, 4, 5, 5), torch.ones(1, 3, 1, 5, 5))[0, :, 2, 2]
    expected = torch.zeros(27)
    expected[[7, 9 + 7, 18 + 7]] = 1 / 3
    torch.testing.assert_close(kernels, expected)


def test_a_higher_threshold_at_run_time_uses_fewer_taps() -> None:
    model = small_unet()
    with torch.no_grad():
        model.head.window.weight.mul_(30)  # an untrained head is nearly uniform
    data = window()
    features = network_inputs(KernelWindow(**data, exposure=torch.ones(1)))
    used = [int((model(features, data["confidence"], t) > 0).sum()) for t in (0, 0.3, 0.6, 0.95)]
    assert used[0] > used[1] > used[2] > used[3]


@pytest.mark.parametrize("threshold", [1.0, -0.1])
def test_a_threshold_of_one_or_more_is_an_error(threshold: float) -> None:
    data = window()
    features = network_inputs(KernelWindow(**data, exposure=torch.ones(1)))
    with pytest.raises(ValueError, match="threshold: expected 0 <= t·K < 1"):
        small_unet()(features, data["confidence"], threshold)
    with pytest.raises(ValueError, match="threshold: expected 0 <= t·K < 1"):
        KernelConfig(threshold=threshold)


# Models


@pytest.mark.parametrize("build", [small_unet, small_resnet, small_tkpcn])
@pytest.mark.parametrize("frames", [1, 3, 5, 7])
def test_kernels_of_any_window_length_are_kernels(build, frames: int) -> None:  # type: ignore[no-untyped-def]
    model = build(replace(SMALL, frames=frames))
    kernels = run(model, window(n=2, t=frames))
    assert kernels.shape == (2, frames * 9, 8, 12)
    assert float(kernels.min()) >= 0
    torch.testing.assert_close(kernels.sum(1), torch.ones(2, 8, 12))


@pytest.mark.parametrize("build", [small_unet, small_resnet, small_tkpcn])
def test_samples_of_a_batch_do_not_touch_each_other(build) -> None:  # type: ignore[no-untyped-def]
    model, data = build(), window(n=2)
    second = {name: value[1:] for name, value in data.items()}
    torch.testing.assert_close(run(model, data)[1:], run(model, second), rtol=1e-4, atol=1e-6)


@pytest.mark.parametrize("scales", [(), (0,), (1,), (2,), (0, 1, 2)])
def test_only_robust_average_blocks_connect_the_frames(scales: tuple[int, ...]) -> None:
    """The head's output for frame 0, before the frames' taps are normalised together, when frame 2 changes."""
    model = small_unet(ra_scales=scales)
    seen: list[torch.Tensor] = []
    model.head.window.register_forward_hook(lambda module, inputs, output: seen.append(output))
    data = window()
    run(model, data)
    data["albedo"] = data["albedo"].clone()
    data["albedo"][:, 2] = 0
    run(model, data)
    assert torch.equal(seen[0][0], seen[1][0]) == (not scales)
    assert not torch.equal(seen[0][2], seen[1][2])


def test_the_papers_network_is_wired_as_its_figure() -> None:
    """Residual blocks, RA blocks where the configuration says, and a skip around each of the first sections.

    A section is the blocks up to and with an RA block. Written down once more, without the model's own loop.
    """
    torch.manual_seed(0)
    model = RAResNet(RAResNetConfig(SMALL, width=4, blocks=6, ra_after=(2, 3, 6), skips=2))
    data = window()
    features = network_inputs(KernelWindow(**data, exposure=exposure(data["color"])))
    blocks, average, skip = model.blocks, model.average, model.skip
    with torch.no_grad():
        start = model.stem(features.transpose(0, 1).flatten(0, 1))
        first = average["2"](blocks[1](blocks[0](start)), 3)
        first = skip[0](torch.cat([first, start], 1))
        second = average["3"](blocks[2](first), 3)
        second = skip[1](torch.cat([second, first], 1))
        third = average["6"](blocks[5](blocks[4](blocks[3](second))), 3)  # not skipped
        torch.testing.assert_close(model.trunk(features), torch.relu(third))


def test_the_paper_has_its_ra_blocks_where_its_figure_has_them() -> None:
    """After blocks 3, 6, 9, 12, 15 and 24 of 24; the first four sections are skipped."""
    model = build_preset("paper")
    order: list[str] = []
    for name, module in model.named_modules():
        if name.startswith(("blocks.", "average.", "skip.")) and name.count(".") == 1:
            module.register_forward_hook(lambda *_, name=name: order.append(name))
    data = window(t=5)
    with torch.no_grad():
        model.trunk(network_inputs(KernelWindow(**data, exposure=exposure(data["color"]))))
    expected: list[str] = []
    for block in range(1, 25):
        expected.append(f"blocks.{block - 1}")
        if block in (3, 6, 9, 12, 15, 24):
            expected.append(f"average.{block}")
        if block in (3, 6, 9, 12):
            expected.append(f"skip.{block // 3 - 1}")
    assert order == expected


@pytest.mark.parametrize("scales", [(), (0,), (1,), (0, 2)])
def test_the_u_nets_ra_blocks_are_at_their_scales(scales: tuple[int, ...]) -> None:
    """Each sees features as large as its scale, of the encoder's residual block there."""
    model = small_unet(ra_scales=scales)
    seen: dict[str, tuple[torch.Tensor, torch.Tensor]] = {}
    outputs: dict[str, torch.Tensor] = {}
    for scale in range(3):
        model.encode[scale].register_forward_hook(lambda m, i, o, scale=scale: outputs.update({str(scale): o}))
    for name, block in model.average.items():
        block.register_forward_hook(lambda m, i, o, name=name: seen.update({name: (i[0], o)}))
    run(model, window())
    assert sorted(seen) == [str(scale) for scale in scales]
    for name, (given, made) in seen.items():
        assert given.shape[-2:] == (8 >> int(name), 12 >> int(name))
        assert torch.equal(given, outputs[name])
        assert not torch.equal(given, made)


def test_the_baselines_frames_meet_in_its_temporal_module_only() -> None:
    model = small_tkpcn()
    before, after = [], []
    model.blocks[-1].register_forward_hook(lambda module, inputs, output: before.append(output))
    model.temporal.register_forward_hook(lambda module, inputs, output: after.append(output))
    data = window()
    run(model, data)
    data["albedo"] = data["albedo"].clone()
    data["albedo"][:, 2] = 0
    run(model, data)
    assert torch.equal(before[0][:2], before[1][:2])
    assert not torch.equal(after[0][0], after[1][0])


def small_multi_scale(kernel: KernelConfig = SMALL) -> MultiScale:
    torch.manual_seed(0)
    return MultiScale(MultiScaleConfig(RAUNetConfig(kernel, widths=(4, 8), ra_scales=(1,))))


def test_kernels_at_several_resolutions_are_kernels() -> None:
    kernels = run(small_multi_scale(), window(n=2))
    assert [k.shape[-2:] for k in kernels.kernels] == [(8, 12), (4, 6), (2, 3)]
    assert [b.shape for b in kernels.blends] == [(2, 1, 8, 12), (2, 1, 4, 6)]
    for kernel in kernels.kernels:
        torch.testing.assert_close(kernel.sum(1), torch.ones_like(kernel[:, 0]))
    for blend in kernels.blends:
        assert 0 < float(blend.min()) <= float(blend.max()) < 0.2  # starts near the finest alone
    with pytest.raises(ValueError, match="expected a height that is a multiple of 4"):
        run(small_multi_scale(), window(h=10))


@pytest.mark.parametrize("base", [RAUNetConfig(SMALL, (4, 8), (1,)), RAResNetConfig(SMALL, 4, 2, (1, 2), 1)])
def test_any_robust_average_network_can_predict_at_several_resolutions(base: RAUNetConfig | RAResNetConfig) -> None:
    model = MultiScale(MultiScaleConfig(base))
    assert model.multiple == 4
    data = window()
    assert denoised(model, data).shape == (1, 3, 8, 12)
    constant = {**data, "color": torch.full_like(data["color"], 3.7)}
    torch.testing.assert_close(denoised(model, constant), torch.full((1, 3, 8, 12), 3.7))


def test_the_paper_network_has_the_parameters_it_should() -> None:
    """The parts' counts, width 80 and 3×3 convolutions; the sum is not the paper's 24 M."""
    conv = 80 * 80 * 9 + 80
    expected = {
        "stem": 10 * 80 * 9 + 80,
        "blocks": 24 * 2 * conv,
        "average": 6 * (160 * 80 * 9 + 80 + 80 * 9 + 1),
        "skip": 4 * (160 * 80 + 80),
        "head": 80 * 25 * 9 + 25,
    }
    model = build_preset("paper")
    found = {name: sum(p.numel() for p in part.parameters()) for name, part in model.named_children()}
    assert found == expected
    assert sum(expected.values()) == 3_541_471


@pytest.mark.parametrize(("height", "width", "axis"), [(9, 12, "height"), (8, 10, "width"), (0, 12, "height")])
def test_each_side_must_be_a_multiple(height: int, width: int, axis: str) -> None:
    model = small_unet()
    assert model.multiple == 4
    with pytest.raises(ValueError, match=f"expected a {axis} that is a multiple of 4"):
        model(torch.zeros(1, 3, 10, height, width), torch.ones(1, 3, 1, height, width))


@pytest.mark.parametrize(
    ("make", "message"),
    [
        (lambda: KernelConfig(frames=4), "frames: expected an odd number >= 1, got 4"),
        (lambda: KernelConfig(size=0), "size: expected an odd number"),
        (lambda: RAUNetConfig(widths=()), "widths: expected at least one"),
        (lambda: RAUNetConfig(ra_scales=(3,)), "ra_scales: expected scales 0 to 2"),
        (lambda: RAResNetConfig(ra_after=(3, 25)), "ra_after: expected ascending blocks 1 to 24"),
        (lambda: RAResNetConfig(skips=7), "skips: expected 0 to 6, got 7"),
        (lambda: RAResNetConfig(conv_size=4), "conv_size: expected an odd number"),
        (lambda: TKPCNConfig(blocks=-1), "blocks, temporal_blocks: expected 0 or more, got -1 and 2"),
        (lambda: TKPCNConfig(conv_size=2), "conv_size: expected an odd number"),
        (lambda: MultiScaleConfig(scales=0), "scales: expected at least 1, got 0"),
    ],
)
def test_configurations_say_what_is_wrong(make, message: str) -> None:  # type: ignore[no-untyped-def]
    with pytest.raises(ValueError, match=message):
        make()


# Denoising


@torch.no_grad()
def denoised(model: RAUNet, data: dict[str, torch.Tensor], **more: torch.Tensor) -> torch.Tensor:
    return filter_window(model, KernelWindow(**{"exposure": exposure(data["color"]), **data, **more})).irradiance


def test_denoising_is_scale_equivariant() -> None:
    model, data = small_unet(), window()
    once = denoised(model, data)
    for scale in (1e-3, 37.0, 1e4):
        scaled = denoised(model, {**data, "color": data["color"] * scale})
        torch.testing.assert_close(scaled, once * scale, rtol=1e-4, atol=0)  # float32 features, threshold edges


def test_a_constant_stays_constant() -> None:
    data = window()
    data["color"] = torch.full_like(data["color"], 3.7)
    torch.testing.assert_close(denoised(small_unet(), data), torch.full((1, 3, 8, 12), 3.7))


def test_denoising_stays_within_the_range_of_its_input() -> None:
    """A convex mean cannot leave it: no negative radiance, no overshoot beside a firefly."""
    data = window()
    data["color"][0, 1, :, 4, 4] = 1e6
    out = denoised(small_unet(), data)
    assert float(out.min()) >= float(data["color"].min())
    assert float(out.max()) <= 1e6
    assert bool(torch.isfinite(out).all())
    black = denoised(small_unet(), {**data, "color": torch.zeros_like(data["color"])})
    assert not bool(black.any())


def test_layers_are_filtered_with_the_kernels_of_the_color() -> None:
    model, data = small_unet(), window()
    layers = torch.cat([data["color"], data["color"][:, :, :1] * 2], 2)
    found = filter_window(model, KernelWindow(**data, exposure=torch.ones(1)))
    out = found.irradiance
    torch.testing.assert_close(found.apply(layers), torch.cat([out, out[:, :1] * 2], 1))


def test_bfloat16_is_close_to_float32() -> None:
    data = window(h=16, w=16)
    full = denoised(for_inference(small_unet(), bfloat16=False), data)
    half = denoised(for_inference(small_unet(), bfloat16=True), data)
    assert not torch.equal(half, full)
    assert half.dtype == torch.float32
    # bfloat16 has 8 bits; a weight may be off by 1 % and a pixel, being a mean of many, by less.
    torch.testing.assert_close(half, full, rtol=1e-2, atol=1e-2)


def test_a_tile_is_denoised_as_the_frame_is_if_it_has_its_halo() -> None:
    """Beyond its receptive field the network cannot see where a tile was cut."""
    model = small_unet(widths=(4, 4), ra_scales=(1,))
    data = window(h=48, w=48)
    brightness = exposure(data["color"])
    whole = denoised(model, data, exposure=brightness)
    tile = denoised(model, {k: v[..., :32, :32] for k, v in data.items()}, exposure=brightness)
    # The field's radius is 26 here, half of it from the chain of three RA steps at half scale.
    torch.testing.assert_close(tile[..., :4, :4], whole[..., :4, :4], rtol=1e-4, atol=1e-5)


def test_the_image_is_the_ratio_of_the_sums() -> None:
    model, data = small_unet(), window()
    expected = mean_of(*apply_kernels(run(model, data), data["color"]), data["color"][:, 1])
    torch.testing.assert_close(denoised(model, data), expected, rtol=1e-4, atol=1e-5)
