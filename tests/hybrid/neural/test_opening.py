"""Files of weights are opened as the denoiser that they belong to."""

import pytest

from hybrid.denoising.stream import FrameStream
from hybrid.files.shots import open_shot
from hybrid.neural import open_network
from hybrid.neural.oidn_networks import HALO, SCRATCH, TILE
from network.checkpoint import find_weights, save_model, shipped_weights
from network.presets import build_preset
from tests.scenes import Scene, only


@pytest.fixture(params=["balanced", "unet"])
def weights(request, tmp_path):
    save_model(tmp_path / f"{request.param}.safetensors", build_preset(request.param))
    return tmp_path / f"{request.param}.safetensors"


def test_bad_options_are_refused(weights):
    for options, word in (
        ({"device": "abacus"}, "device"),
        *([({"threshold": 0.5}, "no kernels")] if weights.stem == "balanced" else []),
    ):
        with pytest.raises(ValueError, match=word):
            open_network(weights, **options)
    with pytest.raises(ValueError, match="expected one of"):
        shipped_weights("slowest")


def test_the_denoiser_is_that_of_the_weights():
    final, kernels = open_network(shipped_weights("quality")), open_network(find_weights("tkpcn"))
    assert (final.needs_first_pass, final.radius, final.tile) == (True, 3, 2048)
    assert (kernels.needs_first_pass, kernels.radius, kernels.tile) == (False, 2, 640)


def test_memory_is_that_of_a_tile_with_its_halo():
    """float32 takes twice as much, and a tile no more than the frame."""
    half, full = (open_network(shipped_weights("balanced"), precision=p, tile=64) for p in ("bfloat16", "float32"))
    assert half.memory((1080, 1920)) == 150 * (64 + 2 * half.halo) ** 2
    assert full.memory((1080, 1920)) == 2 * half.memory((1080, 1920))
    assert half.memory((10, 20)) == 150 * 10 * 20


def test_memory_of_a_first_pass_is_that_of_a_tile_with_its_halo(monkeypatch):
    network = open_network(shipped_weights("balanced"))
    sizes = []
    for bfloat16 in (True, False):
        monkeypatch.setattr("hybrid.neural.oidn_networks.has_bfloat16", lambda _, bfloat16=bfloat16: bfloat16)
        sizes.append([network.backends.memory(shape) for shape in ((10, 20), (20, 20), (9000, 9000))])
    assert sizes[0] == [SCRATCH * 200, SCRATCH * 400, SCRATCH * (TILE + 2 * HALO) ** 2]
    assert sizes[1] == [2 * size for size in sizes[0]]


def test_a_network_that_needs_a_first_pass_says_so(tmp_path):
    shot = open_shot(Scene(frames=5).write(tmp_path))
    window = FrameStream(shot, only({"warp"})).align(shot.numbers[2])
    with pytest.raises(ValueError, match="aligned: expected a window with first passes, got none"):
        open_network(shipped_weights("balanced"))(window)
