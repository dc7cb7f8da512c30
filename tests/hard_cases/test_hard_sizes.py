"""Frames of every size, from one pixel to more than OpenCV samples."""

import numpy as np
import pytest

from flow.tvl1 import dense_flow, refine_flow
from hybrid.denoising.first_pass import PerFrame
from hybrid.denoising.pseudo_reference import CLASSICAL_PRESETS
from hybrid.denoising.stream import plan_shot
from hybrid.run.arrays import denoise_arrays
from tests.flow.scenes import plain
from tests.hard_cases.hard import STAGES, Reel, align, constant, denoise, itself, spoil
from tests.seldom import seldom

SIZES = [(1, 1), (1, 2), (2, 1), (1, 17), (17, 1), (2, 3), (3, 3), (5, 5), (7, 11), (13, 31), (31, 13), (16, 16)]


def noisy(size, frames=5):
    """Constant guides and 30 % of noise."""
    rng = np.random.default_rng(size)
    return [
        spoil(f, color=f.color * rng.gamma(9, 1 / 9, (*size, 1)).astype(np.float32))
        for f in constant(1.0, size, frames)
    ]


@pytest.mark.parametrize("size", [*SIZES[::3], *seldom(*SIZES[1::3], *SIZES[2::3])], ids=str)
def test_any_size_works(size, record_property):
    frames = noisy(size)
    for stages in (STAGES, STAGES | {"refine"}, STAGES - {"warp"}):
        for preset in CLASSICAL_PRESETS:
            window, image = denoise(frames, preset, stages=stages)
            assert image.shape == (*size, 3)
            assert np.isfinite(image).all()
            light = image / window.modulation
            assert window.color.min() * 0.9999 <= light.min()
            assert light.max() <= window.color.max() * 1.0001
    record_property("cases", 3 * len(CLASSICAL_PRESETS))


@pytest.mark.neural
@pytest.mark.parametrize("size", SIZES, ids=[f"{h}x{w}" for h, w in SIZES])
def test_the_network_takes_any_size(size):
    from hybrid.neural import open_network
    from network.checkpoint import shipped_weights

    image = open_network(shipped_weights("balanced"))(align(noisy(size), first_pass=PerFrame(itself))).color
    assert image.shape == (*size, 3)
    assert np.isfinite(image).all()


@pytest.mark.neural
@pytest.mark.parametrize("source", ["bundled", pytest.param("oidn-fast", marks=pytest.mark.oidn)])
@pytest.mark.parametrize(
    "size", [(1, 1), (7, 11), *seldom((1, 64), (64, 1), (2, 3))], ids=["1x1", "7x11", "1x64", "64x1", "2x3"]
)
def test_first_passes_of_any_size_keep_the_light(size, source):
    """In all eight orientations, one for each frame."""
    frames = [{"color": frame.color, "albedo": frame.albedo, "normal": frame.normal} for frame in noisy(size, 9)]
    light = np.mean([frame["color"] for frame in frames])
    results = [result.layers["color"] for result in denoise_arrays(frames, preset="balanced", first_pass=source)]
    assert np.mean(results) == pytest.approx(light, rel=0.05)


@pytest.mark.parametrize("size", SIZES, ids=[f"{h}x{w}" for h, w in SIZES])
def test_motion_is_looked_for_in_any_size(size):
    rng = np.random.default_rng(0)
    guides = plain(*rng.random((2, *size), np.float32))
    assert np.isfinite(dense_flow(guides)).all()
    assert np.isfinite(refine_flow(guides, np.zeros((*size, 2), np.float32))).all()


@pytest.mark.parametrize("size", [(3, 33_000), *seldom((33_000, 3))], ids=["wide", "tall"])
def test_more_than_32767_pixels_on_a_side(size):
    window, image = denoise(noisy(size, 3), number=1, stages=STAGES | {"refine"})
    assert image.shape == (*size, 3)
    assert np.isfinite(image).all()
    assert (window.confidence[1:4, 1:-1, 1:-1] > 0).any()


@pytest.mark.neural
@pytest.mark.reliability
def test_more_than_32767_pixels_through_the_network():
    from hybrid.neural import open_network
    from network.checkpoint import shipped_weights

    window = align(noisy((3, 33_000), 3), number=1, first_pass=PerFrame(itself))
    image = open_network(shipped_weights("balanced"))(window).color
    assert image.shape == (3, 33_000, 3)
    assert np.isfinite(image).all()


@pytest.mark.parametrize("size", [(1, 1), (1, 9), (5, 5), (13, 31)], ids=["1x1", "1x9", "5x5", "13x31"])
def test_a_plan_is_made_for_any_size(size):
    reel = Reel(noisy(size, 3))
    assert plan_shot(reel).decisions


@pytest.mark.neural
@pytest.mark.reliability
@pytest.mark.parametrize(("precision", "tolerance"), [("float32", 1e-5), ("bfloat16", 1e-3)])
def test_tiles_of_any_size_give_the_same_picture(precision, tolerance):
    """Relative to the mean. In bfloat16 features have 8 bits, and rounding depends on where a tile begins.

    The picture is wider than a tile with its halo, so that tiles lack what is beyond.
    """
    from hybrid.neural import open_network
    from network.checkpoint import shipped_weights

    height, width = 40, 448
    window = align(noisy((height, width)), first_pass=PerFrame(itself))

    def denoiser(tile):
        return open_network(shipped_weights("balanced"), tile=tile, precision=precision)

    whole = denoiser(width)(window).color
    for tile in (32, 64, 100):
        assert 2 * denoiser(tile).halo + tile < width
        image = denoiser(tile)(window).color
        np.testing.assert_allclose(image, whole, rtol=0, atol=tolerance * whole.mean())
