"""OIDN's U-Nets: its own pictures where pyoidn is installed; what is read from elsewhere is checked."""

from __future__ import annotations

import contextlib
import hashlib
import struct
from importlib.util import find_spec
from pathlib import Path

import numpy as np
import pytest

pytest.importorskip("torch")
import torch
from torch import Tensor, nn
from torch.nn import functional

from network import unet as trunk
from network.cpu import convolution
from network.unet import (
    OIDN_WEIGHTS,
    Trunk,
    TrunkConfig,
    autoexposure,
    denoise_albedo,
    denoise_normal,
    denoise_picture,
    load_oidn,
    make_trunk,
    pu_forward,
    pu_inverse,
    read_tza,
    round_trunk,
    srgb_forward,
    srgb_inverse,
)

pytestmark = pytest.mark.neural
needs_oidn = [
    pytest.mark.oidn,
    pytest.mark.skipif(find_spec("pyoidn") is None, reason="pyoidn is not installed"),
]


def tza(tensors: dict[str, np.ndarray]) -> bytes:
    """A TZA file, written by its description; every tensor's values lie at a multiple of 64 bytes."""
    body, table = bytearray(64), struct.pack("<I", len(tensors))
    for name, value in tensors.items():
        kind, layout = "h" if value.dtype == np.float16 else "f", "x" if value.ndim == 1 else "oihw"
        table += struct.pack("<H", len(name)) + name.encode()
        table += struct.pack(f"<B{value.ndim}I", value.ndim, *value.shape)
        table += layout.encode() + kind.encode() + struct.pack("<Q", len(body))
        body += value.tobytes() + bytes(-value.nbytes % 64)
    struct.pack_into("<HBBQ", body, 0, 0x41D7, 2, 0, len(body))
    return bytes(body) + table


@pytest.fixture
def tensors() -> dict[str, np.ndarray]:
    rng = np.random.default_rng(1)
    return {
        "conv.weight": rng.normal(size=(2, 3, 3, 3)).astype(np.float16),
        "conv.bias": rng.normal(size=2).astype(np.float32),
    }


def weights_of(model: Trunk, seed: int = 2) -> dict[str, np.ndarray]:
    """Made-up values for every layer, of a size that keeps the picture's."""
    rng = np.random.default_rng(seed)
    return {
        name: rng.normal(0, np.sqrt(2 / max(np.prod(value.shape[1:]), 64)), tuple(value.shape)).astype(np.float16)
        for name, value in model.state_dict().items()
    }


@pytest.fixture
def made_up() -> Trunk:
    return make_trunk(read_tza(tza(weights_of(Trunk(TrunkConfig(9, "small"))))))


def scene(height: int = 50, width: int = 70) -> list[Tensor]:
    """Color with noise, a lamp and a black corner, albedo, normal; each (1, 3, H, W)."""
    rng = np.random.default_rng(3)
    y, x = np.mgrid[:height, :width].astype(np.float32)
    albedo = np.where(((x // 9 + y // 11) % 2 == 0)[..., None], [0.8, 0.3, 0.2], [0.1, 0.4, 1.3])
    normal = np.dstack([np.sin(x / 20), np.cos(y / 9), np.cos(x / 20)])
    light = np.exp(-((x - 40) ** 2 + (y - 30) ** 2) / 300) + 40 * ((x - 12) ** 2 + (y - 12) ** 2 < 20)
    light[-20:, -20:] = 0
    color = albedo * light[..., None] * rng.gamma(2, 0.5, (height, width, 3))
    return [torch.from_numpy(v.astype(np.float32)).permute(2, 0, 1)[None] for v in (color, albedo, normal)]


def decibels(a: Tensor, b: Tensor) -> float:
    return float(-10 * torch.log10(torch.mean((a.double() - b.double()) ** 2)))


def compressed(x: Tensor) -> Tensor:
    return x / (1 + x)


# ---------------------------------------------------------------- against OIDN itself


class TestOidn:
    pytestmark = needs_oidn

    @pytest.mark.parametrize(
        ("name", "inputs", "quality", "clean"),
        [
            ("rt_hdr", 1, "high", False),
            ("rt_hdr_small", 1, "fast", False),
            ("rt_hdr_alb", 2, "high", False),
            ("rt_hdr_alb_small", 2, "fast", False),
            ("rt_hdr_alb_nrm", 3, "high", False),
            ("rt_hdr_alb_nrm_small", 3, "fast", False),
            ("rt_hdr_calb_cnrm", 3, "balanced", True),
            ("rt_hdr_calb_cnrm_small", 3, "fast", True),
            ("rt_hdr_calb_cnrm_large", 3, "high", True),
        ],
    )
    def test_gives_oidns_pictures(self, name: str, inputs: int, quality: str, clean: bool) -> None:
        from hybrid.oidn import denoise_oidn

        layers = scene()[:inputs]
        expected = denoise_oidn(*map(as_image, layers), quality=quality, clean=clean, threads=1)  # type: ignore[arg-type]
        result = denoise_picture(load_oidn(name), *layers)
        # 120 dB and more were measured; another network's picture is 40 to 60 dB away.
        assert decibels(compressed(result), compressed(as_tensor(expected))) > 90

    @pytest.mark.parametrize(("quality", "suffix"), [("high", "_large"), ("balanced", "")])
    def test_gives_oidns_guides(self, quality: str, suffix: str) -> None:
        from hybrid.oidn import _execute

        _, albedo, normal = scene()
        expected = _execute({"albedo": as_image(albedo)}, quality, 1, "cpu")
        assert decibels(denoise_albedo(load_oidn(f"rt_alb{suffix}"), albedo), as_tensor(expected)) > 90
        expected = _execute({"normal": as_image(normal)}, quality, 1, "cpu")
        assert decibels(denoise_normal(load_oidn(f"rt_nrm{suffix}"), normal), as_tensor(expected)) > 90

    @pytest.mark.parametrize("name", ["rt_hdr_alb_nrm_small", "rt_hdr_alb_nrm", "rt_hdr_calb_cnrm_large"])
    def test_bfloat16_changes_little(self, name: str, monkeypatch: pytest.MonkeyPatch) -> None:
        exact = load_oidn(name)
        layers = scene(96, 96)
        wanted, rounded = denoise_picture(exact, *layers), denoise_picture(round_trunk(exact), *layers)
        # Layer by layer, as each rounds what it is given.
        monkeypatch.setattr(convolution, "_FUSED", frozenset())
        monkeypatch.setattr(trunk, "can_enlarge", lambda *_: False)
        monkeypatch.setattr(trunk, "can_end", lambda _: False)
        plain = denoise_picture(as_they_are(exact), *layers)
        monkeypatch.setattr(nn.Conv2d, "_conv_forward", convolve_exactly)
        emulated = denoise_picture(round_trunk(exact), *layers)
        error, exact_sums, naive = (decibels(compressed(x), compressed(wanted)) for x in (rounded, emulated, plain))
        # With sums in float32 as with the weights cast as they are, so that no processor's units decide: 63.4 to 64.4
        # dB, where those weights give 59.5 to 62.0.
        assert exact_sums > naive + 2
        # AVX2, AVX-512 with and without bfloat16, and AMX add up in orders of their own: 0.3 to 1.3 dB less.
        assert error > exact_sums - 1.5
        assert abs(float(emulated.mean() / wanted.mean()) - 1) < 4e-3  # 0.23 % measured
        assert abs(float(rounded.mean() / wanted.mean()) - 1) < 1e-2  # 0.7 % was measured without bf16 units

    def test_every_entry_is_a_network_for_its_inputs(self) -> None:
        for name in OIDN_WEIGHTS:
            layers = name.removesuffix("_small").removesuffix("_large").split("_")[1:]
            assert load_oidn(name).config.inputs == 3 * len(layers)


def as_image(layer: Tensor) -> np.ndarray:
    return np.ascontiguousarray(layer[0].permute(1, 2, 0).numpy())


def as_tensor(image: np.ndarray) -> Tensor:
    return torch.from_numpy(image).permute(2, 0, 1)[None]


def convolve_exactly(layer: nn.Conv2d, x: Tensor, weight: Tensor, bias: Tensor) -> Tensor:
    """The convolution of a layer, summed in float32 and rounded to the type of what it is given."""
    return functional.conv2d(x.float(), weight.float(), bias.float(), padding=1).to(x.dtype)


def as_they_are(model: Trunk) -> Trunk:
    """The weights cast to bfloat16, and nothing done about it."""
    plain = make_trunk({name: value.clone() for name, value in model.state_dict().items()})
    for layer in plain.convolutions:
        for parameter in layer.parameters():
            parameter.data = parameter.data.bfloat16().float()
        layer.register_forward_pre_hook(lambda _, inputs: (inputs[0].bfloat16().float(),))
    return plain


def test_weights_without_the_library(monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr(trunk.importlib.util, "find_spec", lambda name: None)
    with pytest.raises(FileNotFoundError, match="libOpenImageDenoise_core of the package pyoidn, found none"):
        load_oidn("rt_alb")
    with pytest.raises(ValueError, match=r"expected one of rt_hdr, .*, got 'rt_ldr'"):
        load_oidn("rt_ldr")


def test_weights_are_found_by_their_digest(monkeypatch: pytest.MonkeyPatch, tmp_path: Path) -> None:
    blob = tza(weights_of(Trunk(TrunkConfig(3, "small"))))
    other = tza(weights_of(Trunk(TrunkConfig(3, "small")), seed=9))
    monkeypatch.setitem(OIDN_WEIGHTS, "rt_alb", (len(blob), hashlib.sha256(blob).hexdigest()))
    path = tmp_path / "libOpenImageDenoise_core.so"
    monkeypatch.setattr(trunk, "find_library", lambda: path)
    path.write_bytes(b"elsewhere" + other + blob + b"more")
    assert torch.equal(load_oidn("rt_alb").last.bias, read_tza(blob)["last.bias"])
    for altered in (blob[:1000] + bytes([blob[1000] ^ 1]) + blob[1001:], blob[:-1]):
        path.write_bytes(other + altered)
        with pytest.raises(ValueError, match=r"expected rt_alb of OIDN 2\.5\.1 in libOpenImageDenoise_core\.so, found"):
            load_oidn("rt_alb")


# ---------------------------------------------------------------- TZA files


def test_reads_what_was_written(tensors: dict[str, np.ndarray]) -> None:
    read = read_tza(tza(tensors))
    assert list(read) == list(tensors)
    for name, value in tensors.items():
        assert read[name].dtype == torch.float32
        np.testing.assert_array_equal(read[name].numpy(), value.astype(np.float32))


def test_a_file_cut_short_anywhere_is_refused(tensors: dict[str, np.ndarray]) -> None:
    data = tza(tensors)
    for length in range(len(data)):
        with pytest.raises(ValueError, match=r"^TZA: expected") as error:
            read_tza(data[:length])
        assert "\n" not in str(error.value)


def test_a_byte_changed_anywhere_is_read_or_refused(tensors: dict[str, np.ndarray]) -> None:
    """Nothing but ValueError, no memory beyond the file's, no number that is not finite."""
    data, rng = tza(tensors), np.random.default_rng(4)
    for place in [*range(12), *range(data.index(b"conv.weight") - 6, len(data))]:
        for value in (0, 255, *rng.integers(256, size=4)):
            changed = bytearray(data)
            changed[place] = value
            with contextlib.suppress(ValueError):
                read = read_tza(bytes(changed))
                assert sum(v.numel() for v in read.values()) <= len(data)
                assert all(bool(v.isfinite().all()) for v in read.values())


@pytest.mark.parametrize(
    ("edit", "message"),
    [
        (lambda v: v.update({"conv.bias": np.float32([1, np.nan])}), "conv.bias: expected finite numbers"),
        (lambda v: v.update({"conv.bias": np.float32([])}), "conv.bias of shape .0,.: expected some values"),
    ],
)
def test_bad_values_are_refused(tensors, edit, message) -> None:
    edit(tensors)
    with pytest.raises(ValueError, match=message):
        read_tza(tza(tensors))


def test_what_is_no_tza_file_is_refused(tensors: dict[str, np.ndarray]) -> None:
    data = bytearray(tza(tensors))
    data[2] = 3
    with pytest.raises(ValueError, match="weights: expected magic 0x41d7 and version 2, got 0x41d7 and 3"):
        read_tza(bytes(data), "weights")
    with pytest.raises(ValueError, match="expected a new tensor, x or oihw"):
        read_tza(tza(tensors).replace(b"oihw", b"iohw"))


# ---------------------------------------------------------------- the network


@pytest.mark.parametrize("size", ["small", "base", "large"])
@pytest.mark.parametrize("inputs", [3, 9])
def test_size_is_found_from_the_tensors(size: str, inputs: int) -> None:
    values = weights_of(Trunk(TrunkConfig(inputs, size)))
    made = make_trunk(read_tza(tza(values)))
    assert made.config == TrunkConfig(inputs, size)
    for name, value in made.state_dict().items():
        np.testing.assert_array_equal(value.numpy(), values[name].astype(np.float32))


def test_parameters_are_as_many_as_oidn_says() -> None:
    counts = [sum(p.numel() for p in Trunk(TrunkConfig(9, size)).parameters()) for size in ("small", "base", "large")]
    assert counts == [320035, 919811, 3848387]


def test_other_tensors_are_refused(tensors: dict[str, np.ndarray]) -> None:
    with pytest.raises(ValueError, match="small, base or large U-Net, got 2 other tensors"):
        make_trunk(read_tza(tza(tensors)))
    with pytest.raises(ValueError, match="got 0 other tensors"):
        make_trunk({})
    values = weights_of(Trunk(TrunkConfig(9, "small")))
    values["last.bias"] = values["last.bias"][:2]
    with pytest.raises(ValueError, match="small, base or large U-Net"):
        make_trunk(read_tza(tza(values)))


@pytest.mark.parametrize(("field", "value"), [("inputs", 0), ("size", "huge")])
def test_bad_sizes_are_refused(field: str, value: object) -> None:
    with pytest.raises(ValueError, match=f"^{field}: expected"):
        TrunkConfig(**{field: value})  # type: ignore[arg-type]


def test_sides_must_be_multiples(made_up: Trunk) -> None:
    with pytest.raises(ValueError, match="expected a width that is a multiple of 16, got 20"):
        made_up(torch.zeros(1, 9, 16, 20))


def test_inputs_must_be_the_weights(made_up: Trunk) -> None:
    color, albedo, _ = scene()
    with pytest.raises(ValueError, match="expected 9 channels as the weights are for, got 6"):
        denoise_picture(made_up, color, albedo)


@pytest.mark.parametrize("size", [(1, 1), (16, 33), (50, 70)])
def test_any_size(made_up: Trunk, size: tuple[int, int]) -> None:
    result = denoise_picture(made_up, *(layer[..., : size[0], : size[1]] for layer in scene()))
    assert result.shape == (1, 3, *size)


def test_strips_and_the_whole_are_one_picture(made_up: Trunk, monkeypatch: pytest.MonkeyPatch) -> None:
    """Without gradients it goes over some rows at a time."""
    picture = torch.rand(2, 9, 48, 32, generator=torch.Generator().manual_seed(3))
    with torch.no_grad():
        whole = made_up(picture)
        monkeypatch.setattr(trunk, "ROWS", 6)
        strips = made_up(picture)
    # A sum may be taken in another order where there are fewer pixels.
    torch.testing.assert_close(strips, whole, rtol=1e-5, atol=1e-6)


def test_running_gives_what_training_sees(made_up: Trunk) -> None:
    """Without gradients sums are taken in another order (`network.cpu.upsample_conv`)."""
    picture = torch.rand(2, 9, 48, 32, generator=torch.Generator().manual_seed(3))
    with torch.no_grad():
        running = made_up(picture)
    # Of nine layers of some hundred products each; pictures lie in [0, 1].
    torch.testing.assert_close(running, made_up(picture).detach(), rtol=0, atol=1e-5)


def test_pictures_of_a_batch_do_not_see_each_other(made_up: Trunk) -> None:
    layers = scene()
    alone = denoise_picture(made_up, *layers)
    both = denoise_picture(made_up, *(torch.cat([layer, layer.flip(3) * 3]) for layer in layers))
    # Float32 sums in another order, times 16 by the curve's exponential.
    torch.testing.assert_close(both[:1], alone, rtol=1e-3, atol=1e-5)


def test_a_scaled_picture_is_denoised_to_a_scaled_one(made_up: Trunk) -> None:
    color, *guides = scene()
    result = denoise_picture(made_up, color, *guides)
    # Powers of two change nothing but the exposure's last bits.
    torch.testing.assert_close(denoise_picture(made_up, 64 * color, *guides), 64 * result, rtol=1e-4, atol=1e-5)


def test_what_is_not_finite_does_not_spread(made_up: Trunk) -> None:
    color, albedo, normal = scene()
    clean = denoise_picture(made_up, color.index_fill(2, torch.tensor([3]), 0), albedo, normal)
    for layer, value in ((color, torch.nan), (color, -torch.inf), (color, -5.0)):
        broken = layer.clone()
        broken[:, :, 3] = value
        torch.testing.assert_close(denoise_picture(made_up, broken, albedo, normal), clean)
    color[0, :, 5, 5] = torch.inf
    albedo[0, :, 6, 6] = torch.nan
    normal[0, :, 7, 7] = torch.nan
    for model in (made_up, round_trunk(made_up)):
        assert bool(denoise_picture(model, color, albedo, normal).isfinite().all())


def test_black_stays_finite(made_up: Trunk) -> None:
    black = torch.zeros(1, 3, 20, 20)
    assert bool(denoise_picture(made_up, black, black, black).isfinite().all())


def test_rounding_leaves_the_trunk_alone(made_up: Trunk) -> None:
    before = {name: value.clone() for name, value in made_up.state_dict().items()}
    rounded = round_trunk(made_up)
    assert rounded.first.weight.dtype == torch.bfloat16
    assert rounded.last.weight.dtype == torch.float32
    assert list(before) == list(made_up.state_dict())
    for name, value in made_up.state_dict().items():
        assert torch.equal(value, before[name])


def test_rounded_taps_keep_their_sums(made_up: Trunk) -> None:
    exact, rounded = (model.first.weight.detach().double() for model in (made_up, round_trunk(made_up)))
    # Half a step of the least tap, in place of that of the greatest: a sum may lie anywhere between.
    error = (rounded - exact).sum((2, 3)).abs()
    naive = (exact.bfloat16().double() - exact).sum((2, 3)).abs()
    assert float(error.mean()) < 0.1 * float(naive.mean())
    # No tap moves by more than a step of its own and the error of those before it.
    assert float((rounded - exact).abs().max()) <= 2 * float(exact.abs().max()) * 2**-8


# ---------------------------------------------------------------- exposure and curves


def plain_autoexposure(color: np.ndarray) -> float:
    """The same by a plain loop over bins, for one (H, W, 3) picture."""
    luminance = color @ np.array([0.212671, 0.715160, 0.072169])
    height, width = luminance.shape
    rows, columns = -(-height // 16), -(-width // 16)
    logs = []
    for i in range(rows):
        for j in range(columns):
            row = luminance[i * height // rows : (i + 1) * height // rows]
            level = row[:, j * width // columns : (j + 1) * width // columns].mean()
            if level > 1e-8:
                logs.append(np.log2(level))
    return 0.18 / 2 ** float(np.mean(logs)) if logs else 1.0


@pytest.mark.parametrize("size", [(1, 1), (15, 17), (50, 70), (33, 160)])
def test_autoexposure_is_that_of_bins(size: tuple[int, int]) -> None:
    color = torch.from_numpy(np.random.default_rng(5).gamma(0.3, 1, (2, 3, *size)).astype(np.float32))
    color[1, :, : size[0] // 2] = 0
    expected = [plain_autoexposure(np.moveaxis(picture.astype(np.float64), 0, -1)) for picture in color.numpy()]
    np.testing.assert_allclose(autoexposure(color).numpy(), expected, rtol=1e-5)  # float32


def test_autoexposure_scales_and_survives() -> None:
    color = torch.rand(1, 3, 40, 40, generator=torch.Generator().manual_seed(6))
    # The bins above 1e-8 are the same at both scales.
    torch.testing.assert_close(autoexposure(4 * color) * 4, autoexposure(color))
    assert autoexposure(torch.zeros(1, 3, 20, 20)).item() == 1
    color[0, 0, 3, 3] = torch.nan
    color[0, 1, 4, 4] = torch.inf
    assert bool(autoexposure(color).isfinite().all())


def test_curves_and_their_inverses() -> None:
    y = torch.logspace(-8, 5, 400)
    x = pu_forward(y)
    assert bool((x.diff() > 0).all())
    torch.testing.assert_close(pu_forward(torch.tensor([65504.0])), torch.ones(1))
    torch.testing.assert_close(pu_inverse(x), y, rtol=2e-4, atol=1e-9)  # the curve's constants have nine digits
    assert pu_forward(torch.zeros(1)).item() == 0
    assert pu_inverse(torch.zeros(1)).item() == 0
    y = torch.linspace(0, 1, 400)
    torch.testing.assert_close(srgb_inverse(srgb_forward(y)), y, rtol=0, atol=1e-6)


@pytest.mark.parametrize("dtype", [torch.float32, torch.bfloat16])
def test_fused_convolutions_give_the_same(made_up: Trunk, dtype: torch.dtype, monkeypatch: pytest.MonkeyPatch) -> None:
    if dtype not in convolution._FUSED:
        pytest.skip(f"torch without oneDNN, or a processor without {dtype}")
    picture = torch.rand(1, made_up.config.inputs, 48, 64, generator=torch.Generator().manual_seed(1))
    running = round_trunk(made_up) if dtype == torch.bfloat16 else made_up
    if dtype == torch.bfloat16:  # where something is added there is one rounding less than apart
        monkeypatch.setattr(trunk, "can_enlarge", lambda *_: False)
        monkeypatch.setattr(trunk, "can_end", lambda _: False)
    apart: list[nn.Module] = []
    for layer in running.modules():
        if isinstance(layer, nn.ReLU):
            layer.register_forward_hook(lambda module, *_: apart.append(module))
    with torch.no_grad():
        fused = running(picture)
        assert not apart
        monkeypatch.setattr(convolution, "_FUSED", frozenset())
        expected = running(picture)
    assert apart
    if dtype == torch.bfloat16:
        assert torch.equal(fused, expected)
    else:
        # Torch has a loop of its own for the smallest pictures, which sums in another order.
        torch.testing.assert_close(fused, expected, rtol=0, atol=1e-5)
