"""OIDN's networks in torch give OIDN's pictures, whatever its mode, and stand for it where they are quicker."""

import importlib.util
from dataclasses import replace

import numpy as np
import pytest
import torch

from hybrid.cli import main
from hybrid.comparison.metrics import psnr
from hybrid.denoising.first_pass import OIDN_MODES, Backends, denoise_frame_oidn, find_first_pass, named_first_pass
from hybrid.denoising.stream import FrameStream
from hybrid.files.frame import Frame
from hybrid.files.shots import open_shot
from hybrid.neural import oidn_networks
from hybrid.neural.oidn_networks import denoise_bundled, denoise_unet
from network.oidn_weights import OIDN_WEIGHTS
from network.unet import OidnUNet, OidnUNetConfig
from tests.scenes import Scene, only

pytestmark = [
    pytest.mark.neural,
    pytest.mark.oidn,
    pytest.mark.skipif(importlib.util.find_spec("pyoidn") is None, reason="pyoidn is not installed"),
]
SCENE = Scene(frames=3, height=72, width=90)


@pytest.fixture
def frame(tmp_path) -> Frame:
    return open_shot(SCENE.write(tmp_path / "noisy")).read(1002)


@pytest.mark.parametrize("mode", [*OIDN_MODES])
@pytest.mark.parametrize("guides", [0, 2])
def test_is_the_picture_of_oidn(frame, mode, guides) -> None:
    layers = [frame.albedo, frame.normal][:guides] + [None] * (2 - guides)
    plain = Frame(1002, frame.color, *layers)
    settings = OIDN_MODES[mode]
    expected = denoise_frame_oidn(plain, **settings)
    result = denoise_frame_oidn(plain, denoise_unet, **settings)
    assert result.shape == expected.shape
    # Another network's picture is 35 to 45 dB away; 60 was measured here.
    assert psnr(result, expected) > 52


def test_what_comes_with_ravg_is_oidns_base_network_for_each_quality(frame) -> None:
    """The image of another network is 35 to 45 dB away."""
    expected = denoise_unet(frame.color, frame.albedo, frame.normal, quality="high")
    for quality in ("fast", "high"):
        assert psnr(denoise_bundled(frame.color, frame.albedo, frame.normal, quality=quality), expected) > 55


def test_clean_guides_are_declared_so(frame) -> None:
    settings = {"quality": "high", "prefilter": None, "clean": True}
    assert psnr(denoise_frame_oidn(frame, denoise_unet, **settings), denoise_frame_oidn(frame, **settings)) > 52


@pytest.mark.parametrize("run", [None, denoise_unet])
def test_a_dark_picture_does_not_depend_on_its_unit(frame, run) -> None:
    """OIDN leaves what is darker than 1e-8 out of its exposure, whatever the unit: half a picture by another factor."""
    source = named_first_pass("auto" if run else "oidn", mode="oidn", backends=Backends(run))
    color = frame.color * np.where(np.arange(72) < 36, 1e-4, 1)[:, None, None].astype(np.float32)
    unit = np.float32(2.0**-14)
    bright, dark = (source.first_pass.function(replace(frame, color=scale * color)) for scale in (1, unit))
    np.testing.assert_allclose(dark / unit, bright, rtol=1e-3, atol=1e-6)


def test_tiles_do_not_show(frame, monkeypatch) -> None:
    tall = Frame(1, *(np.tile(layer, (5, 1, 1)) for layer in (frame.color, frame.albedo, frame.normal)))
    whole = denoise_frame_oidn(tall, denoise_unet, quality="high", prefilter="balanced")
    monkeypatch.setattr(oidn_networks, "TILE", 64)
    parts = denoise_frame_oidn(tall, denoise_unet, quality="high", prefilter="balanced")
    # Exact but for the order of sums in bfloat16.
    assert psnr(parts, whole) > 70


def test_auto_takes_what_is_quicker_and_a_name_what_it_names(tmp_path) -> None:
    shot = open_shot(SCENE.write(tmp_path))
    calls = []

    def quicker(color, *_, **mode):
        calls.append(mode)
        return color

    source = find_first_pass("auto", shot, mode="oidn-fast", backends=Backends(quicker))
    assert "torch" in source.reason
    FrameStream(shot, only({"demodulate"}), radius=0, first_pass=source.first_pass).align(1002)
    assert calls == [{"quality": "fast"}]
    named = find_first_pass("oidn-fast", shot, backends=Backends(quicker))
    FrameStream(shot, only({"demodulate"}), radius=0, first_pass=named.first_pass).align(1002)
    assert len(calls) == 1


@pytest.mark.parametrize(
    ("precision", "known"), [("float32", True), ("bfloat16", True), ("bfloat16", False), ("auto", True)]
)
def test_denoise_takes_them_unless_float32_is_asked_for(tmp_path, monkeypatch, precision, known) -> None:
    folder, calls = SCENE.write(tmp_path / "noisy"), []
    if not known:  # another version of OIDN
        oidn_networks._network.cache_clear()
        monkeypatch.setitem(OIDN_WEIGHTS, "rt_hdr_alb_nrm_small", (641480, "0" * 64))
    monkeypatch.setattr(oidn_networks, "denoise_unet", lambda color, *_, **mode: calls.append(mode) or color)
    words = ["denoise", str(folder), "-o", str(tmp_path / "out"), "--frames", "1002", "--precision", precision]
    assert main(words) == 0
    assert bool(calls) == (precision != "float32" and known)


@pytest.mark.parametrize(("there", "dtype"), [(True, torch.bfloat16), (False, torch.float32)])
def test_bfloat16_is_for_processors_that_have_it(there, dtype, monkeypatch):
    monkeypatch.setattr(oidn_networks, "has_bfloat16", lambda device: there)
    assert oidn_networks._for_inference(OidnUNet(OidnUNetConfig(9, "small"))).first.weight.dtype == dtype
