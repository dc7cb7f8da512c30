import pytest
import torch

from network import devices
from network.devices import DEVICES, find_device


def only(monkeypatch, *, cuda=False, hip=None, xpu=False, mps=False):
    monkeypatch.setattr(torch.cuda, "is_available", lambda: cuda)
    monkeypatch.setattr(torch.version, "hip", hip)
    monkeypatch.setattr(torch.xpu, "is_available", lambda: xpu)
    monkeypatch.setattr(torch.backends.mps, "is_available", lambda: mps)


def test_a_processor_is_always_there():
    assert find_device("cpu") == ("cpu", torch.device("cpu"))


@pytest.mark.parametrize(
    ("there", "name", "kind"),
    [
        ({}, "cpu", "cpu"),
        ({"cuda": True}, "cuda", "cuda"),
        ({"cuda": True, "hip": "6.2"}, "hip", "cuda"),
        ({"xpu": True}, "sycl", "xpu"),
        ({"cuda": True, "xpu": True}, "cuda", "cuda"),
    ],
)
def test_auto_takes_the_first_that_is_there_by_its_name(monkeypatch, there, name, kind):
    only(monkeypatch, **there)
    assert find_device("auto") == find_device(name) == (name, torch.device(kind))


def test_metal_is_taken_by_its_name_alone(monkeypatch):
    """Nobody has run it; "auto" would take it on every Mac."""
    only(monkeypatch, mps=True)
    assert find_device("auto") == ("cpu", torch.device("cpu"))
    assert find_device("metal") == ("metal", torch.device("mps"))


def test_one_that_is_not_there_is_named_with_those_that_are(monkeypatch):
    only(monkeypatch, xpu=True)
    with pytest.raises(ValueError, match=r"device is 'cuda', expected one that torch can use here: auto, sycl, cpu$"):
        find_device("cuda")
    with pytest.raises(ValueError, match="device is 'gpu', expected one that there is"):
        find_device("gpu")


def test_every_name_is_a_name_of_oidns_too():
    from hybrid.denoising.oidn import DEVICES as THEIRS

    assert set(DEVICES) == {"auto", *THEIRS}
    assert set(devices._accelerators()) <= set(THEIRS)


@pytest.mark.parametrize("held", [False, True])
def test_where_onednn_is_held_to_fewer_instructions_there_is_no_bfloat16(monkeypatch, held):
    """ONEDNN_MAX_CPU_ISA=AVX2 took ten times as long."""
    monkeypatch.setattr(torch.backends.mkldnn, "is_available", lambda: True)
    monkeypatch.setattr(torch.cpu, "get_capabilities", lambda: {"avx512_bf16": True}, raising=False)
    monkeypatch.setattr(torch.ops.mkldnn, "_is_mkldnn_bf16_supported", lambda: not held)
    assert devices.has_bfloat16(torch.device("cpu")) is not held
