"""Weights of OIDN: from its library, where they are found by their digest."""

import hashlib
from importlib.util import find_spec
from pathlib import Path

import numpy as np
import pytest
import torch

from network import oidn_weights
from network.oidn_weights import OIDN_WEIGHTS, build_unet, load_oidn, read_tza
from network.unet import OidnUNet, OidnUNetConfig
from tests.network.oidn_like import tza, weights_of


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


@pytest.mark.parametrize("size", ["small", "base", "large"])
@pytest.mark.parametrize("inputs", [3, 9])
def test_size_is_found_from_the_tensors(size: str, inputs: int) -> None:
    values = weights_of(OidnUNet(OidnUNetConfig(inputs, size)))
    made = build_unet(read_tza(tza(values)))
    assert made.config == OidnUNetConfig(inputs, size)
    for name, value in made.state_dict().items():
        np.testing.assert_array_equal(value.numpy(), values[name].astype(np.float32))
