"""Weights of OIDN: from its library, where they are found by their digest; all that is read is checked."""

from __future__ import annotations

import contextlib
import hashlib
from importlib.util import find_spec
from pathlib import Path

import numpy as np
import pytest

pytest.importorskip("torch")
import torch

from network import oidn_weights
from network.oidn_weights import OIDN_WEIGHTS, build_unet, load_oidn, read_tza
from network.unet import OidnUNet, OidnUNetConfig
from tests.network.oidn_like import tza, weights_of

pytestmark = pytest.mark.neural


@pytest.mark.oidn
@pytest.mark.skipif(find_spec("pyoidn") is None, reason="pyoidn is not installed")
def test_every_entry_is_a_network_for_its_inputs() -> None:
    for name in OIDN_WEIGHTS:
        layers = name.removesuffix("_small").removesuffix("_large").split("_")[1:]
        assert load_oidn(name).config.inputs == 3 * len(layers)


@pytest.fixture
def tensors() -> dict[str, np.ndarray]:
    rng = np.random.default_rng(1)
    return {
        "conv.weight": rng.normal(size=(2, 3, 3, 3)).astype(np.float16),
        "conv.bias": rng.normal(size=2).astype(np.float32),
    }


def test_weights_without_the_library(monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr(oidn_weights.importlib.util, "find_spec", lambda name: None)
    with pytest.raises(FileNotFoundError, match="libOpenImageDenoise_core of the package pyoidn, found none"):
        load_oidn("rt_alb")
    with pytest.raises(ValueError, match=r"expected one of rt_hdr, .*, got 'rt_ldr'"):
        load_oidn("rt_ldr")


def test_weights_are_found_by_their_digest(monkeypatch: pytest.MonkeyPatch, tmp_path: Path) -> None:
    blob = tza(weights_of(OidnUNet(OidnUNetConfig(3, "small"))))
    other = tza(weights_of(OidnUNet(OidnUNetConfig(3, "small")), seed=9))
    monkeypatch.setitem(OIDN_WEIGHTS, "rt_alb", (len(blob), hashlib.sha256(blob).hexdigest()))
    path = tmp_path / "libOpenImageDenoise_core.so"
    monkeypatch.setattr(oidn_weights, "find_library", lambda: path)
    path.write_bytes(b"elsewhere" + other + blob + b"more")
    assert torch.equal(load_oidn("rt_alb").last.bias, read_tza(blob)["last.bias"])
    for altered in (blob[:1000] + bytes([blob[1000] ^ 1]) + blob[1001:], blob[:-1]):
        path.write_bytes(other + altered)
        with pytest.raises(ValueError, match=r"expected rt_alb of OIDN 2\.5\.1 in libOpenImageDenoise_core\.so, found"):
            load_oidn("rt_alb")


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


@pytest.mark.parametrize("size", ["small", "base", "large"])
@pytest.mark.parametrize("inputs", [3, 9])
def test_size_is_found_from_the_tensors(size: str, inputs: int) -> None:
    values = weights_of(OidnUNet(OidnUNetConfig(inputs, size)))
    made = build_unet(read_tza(tza(values)))
    assert made.config == OidnUNetConfig(inputs, size)
    for name, value in made.state_dict().items():
        np.testing.assert_array_equal(value.numpy(), values[name].astype(np.float32))


def test_other_tensors_are_refused(tensors: dict[str, np.ndarray]) -> None:
    with pytest.raises(ValueError, match="small, base or large U-Net, got 2 other tensors"):
        build_unet(read_tza(tza(tensors)))
    with pytest.raises(ValueError, match="got 0 other tensors"):
        build_unet({})
    values = weights_of(OidnUNet(OidnUNetConfig(9, "small")))
    values["last.bias"] = values["last.bias"][:2]
    with pytest.raises(ValueError, match="small, base or large U-Net"):
        build_unet(read_tza(tza(values)))
