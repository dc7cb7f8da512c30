"""Radiance at its extremes: any exposure, none at all, fireflies, cuts; variance and guides that tell nothing."""

from functools import lru_cache

import cv2
import numpy as np
import pytest

from hybrid.comparison.metrics import psnr
from hybrid.denoising.first_pass import Classical
from hybrid.denoising.pseudo_reference import CLASSICAL_PRESETS, STANDARD
from hybrid.run.arrays import denoise_arrays
from tests.hard_cases.hard import MIDDLE, REACH, align, constant, denoise, frame, shot, spoil, truth, within_range
from tests.scenes import Scene
from tests.seldom import seldom

SCALES = [1e-6, 1e6]


@pytest.fixture(scope="module")
def network():
    pytest.importorskip("torch")
    from hybrid.neural import open_network
    from network.checkpoint import shipped_weights

    return {p: open_network(shipped_weights("balanced"), precision=p) for p in ("float32", "bfloat16")}


@pytest.mark.parametrize("preset", CLASSICAL_PRESETS)
def test_the_estimate_scales_with_the_light(preset, record_property):
    _, plain = denoise(shot(), preset)
    for scale in SCALES:
        _, image = denoise(shot(scale=scale), preset)
        # float32 through the chain; relative to the picture, for nearly black pixels have few digits
        assert np.abs(image / np.float32(scale) - plain).max() < 1e-3 * plain.mean()
    record_property("cases", len(SCALES))


@pytest.mark.neural
def test_the_network_scales_with_the_light(network, record_property):
    plain = network["float32"](align(shot(), first_pass=Classical(STANDARD))).color
    for scale in SCALES:
        image = network["float32"](align(shot(scale=scale), first_pass=Classical(STANDARD))).color
        assert np.abs(image / np.float32(scale) - plain).max() < 1e-3 * plain.mean()
    record_property("cases", len(SCALES))


@pytest.mark.neural
@pytest.mark.filterwarnings("error")  # the guides are read-only
@pytest.mark.parametrize(
    ("options", "factor"), [({"preset": "final"}, 1.5), ({"preset": "balanced", "first_pass": "bundled"}, 4)], ids=str
)
def test_a_bright_window_lets_no_noise_into_the_room(options, factor):
    """Errors of the room were measured against the mean with the window, and samples blended in for 2 to 6 dB."""
    size, rng = (64, 96), np.random.default_rng(3)
    truth = np.broadcast_to(np.linspace(0.2, 0.4, size[1], dtype=np.float32)[:, None], (*size, 3))
    albedo = np.full_like(truth, 0.5)

    def room_error(window):
        lit = truth.copy()
        lit[:40, :40] = window
        guides = {"albedo": albedo, "normal": np.broadcast_to(np.float32([0, 0, 1]), truth.shape)}
        grain = rng.gamma(8, 1 / 8, (5, *size, 1)).astype(np.float32)
        grain[:, :40, :40] = 1
        frames = [{"color": lit * one, **guides} for one in grain]
        (made,) = denoise_arrays(frames, numbers=[2], **options)
        beside = np.s_[46:, :40]
        return np.sqrt(np.mean(np.square(made.layers["color"][beside] / lit[beside] - 1)))

    assert room_error(300.0) < factor * room_error(0.3)


@pytest.mark.neural
@pytest.mark.parametrize("options", [{"preset": "final"}, {"preset": "balanced", "first_pass": "bundled"}], ids=str)
def test_frames_beside_a_black_one_scale_with_the_light(options):
    """Pairs with a black frame were compared by an exposure of 1, and networks leave a little light on black."""
    unit = np.float32(2.0**-12)

    def layers(frame, scale):
        color = frame.color * scale * np.float32(frame.number != MIDDLE)
        return {"color": color, "albedo": frame.albedo, "normal": frame.normal}

    frames = shot()
    plain, dark = (denoise_arrays([layers(frame, scale) for frame in frames], **options) for scale in (1, unit))
    for one, other in zip(plain, dark, strict=True):
        color = one.layers["color"]
        assert np.abs(other.layers["color"] / unit - color).max() <= 1e-3 * max(color.mean(), 1e-6)
        assert color.any() == (frames[one.number].number != MIDDLE)


@pytest.mark.neural
@pytest.mark.parametrize("precision", ["float32", "bfloat16"])
@pytest.mark.parametrize("scale", [0, 1e-42, *seldom(1e-38)])
def test_next_to_no_light_is_finite(network, precision, scale):
    """The reciprocal of a denormal exposure was infinite, and the picture NaN."""
    frames = shot(scale=scale)
    for image in (denoise(frames)[1], network[precision](align(frames, first_pass=Classical(STANDARD))).color):
        assert np.isfinite(image).all()
        assert (image >= 0).all()
        assert image.max() <= 10 * max(f.color.max() for f in frames)
        if scale == 0:
            assert (image == 0).all()


def test_a_spark_in_next_to_no_light_is_finite():
    """A light of 1e6 over an exposure of 1e-42 is infinite, and its tone-mapped value was NaN."""
    frames = shot(scale=1e-42)
    for f in frames:
        f.color[20, 28] = 1e6
    window, image = denoise(frames)
    assert np.isfinite(image).all()
    assert within_range(window, image)


@pytest.mark.parametrize("preset", CLASSICAL_PRESETS)
@pytest.mark.parametrize("value", [1e-6, 0.7, 1e4])
def test_a_constant_picture_is_kept(preset, value):
    _, image = denoise(constant(value), preset)
    np.testing.assert_allclose(image, value, rtol=1e-6)


@pytest.mark.neural
def test_the_network_keeps_a_constant_picture(network):
    for precision, model in network.items():
        image = model(align(constant(0.7), first_pass=Classical(STANDARD))).color
        # A trunk makes it anew. Before pictures were mirrored beyond their borders it was 28 % off there.
        np.testing.assert_allclose(image, 0.7, rtol=0.02, err_msg=precision)


def test_identical_frames_are_one_frame():
    one = frame(MIDDLE)
    still = spoil(one, motion=np.zeros_like(one.motion))
    window, image = denoise([spoil(still, number=n) for n in range(5)])
    assert (window.confidence[[0, 1, 3, 4]] == 0).all()  # equal samples count once
    assert within_range(window, image)


def test_one_frame_alone():
    window, image = denoise([spoil(frame(MIDDLE), number=MIDDLE)])
    assert (window.confidence[[0, 1, 3, 4]] == 0).all()
    assert psnr(image, truth()) > psnr(frame(MIDDLE).color, truth()) + 2


def test_a_black_frame_between_bright_ones_stays_black():
    frames = shot()
    frames[MIDDLE] = spoil(frames[MIDDLE], color=np.zeros_like(frames[MIDDLE].color))
    _, image = denoise(frames)
    assert image.max() < 1e-3 * frames[0].color.mean()


def test_black_frames_beside_a_bright_one_do_not_darken_it():
    frames = [spoil(f, color=f.color * (f.number == MIDDLE)) for f in shot()]
    _, image = denoise(frames)
    alone = denoise([frame(MIDDLE)])[1]
    assert image.mean() == pytest.approx(alone.mean(), rel=0.02)  # the noise of 30 % over 2240 pixels: 0.6 %


def test_a_cut_inside_the_window_mixes_no_scenes():
    """Other walls, other light: what came before the cut must not show through."""
    after = Scene(frames=5, step=(-3, 2))
    frames = [frame(n) if n < MIDDLE else spoil(frame(n, after), albedo=1 - frame(n, after).albedo) for n in range(5)]
    frames = [f if f.number < MIDDLE else spoil(f, color=f.color[::-1].copy()) for f in frames]
    image = denoise(frames)[1]
    alone = denoise(frames[MIDDLE:])[1]
    assert np.sqrt(np.mean((image - alone) ** 2)) < 0.05 * alone.mean()


# --- fireflies


burning = pytest.mark.parametrize("value", [1e6, *seldom(6.5e4)])


@lru_cache
def unburnt(preset):
    return denoise(shot(), preset)[1]


def burn(frames, value, size, which):
    for index in which:
        frames[index].color[20 : 20 + size, 28 : 28 + size] = value
    return frames


@burning
@pytest.mark.parametrize("which", [(MIDDLE,), (MIDDLE - 1,), (MIDDLE - 1, MIDDLE)], ids=["centre", "side", "both"])
def test_a_firefly_leaves_neither_hole_nor_halo(value, which, record_property):
    for preset in CLASSICAL_PRESETS:
        plain = unburnt(preset)
        image = denoise(burn(shot(), value, 1, which), preset)[1]
        clean = truth()
        for reach in (0, 1, 2, 4):
            ring = np.zeros(clean.shape[:2], bool)
            ring[20 - reach : 21 + reach, 28 - reach : 29 + reach] = True
            if reach:
                ring[21 - reach : 20 + reach, 29 - reach : 28 + reach] = False
            # The error of the picture without the firefly, and four deviations of a ring's mean beside: noise of
            # 0.3 averaged over the window (5) and the ring.
            noise = 4 * 0.3 / np.sqrt(5 * ring.sum())
            error = abs(image[ring].mean() / clean[ring].mean() - 1)
            assert error < abs(plain[ring].mean() / clean[ring].mean() - 1) + noise
    record_property("cases", 4 * len(CLASSICAL_PRESETS))


def ring_error(image, clean, size, near, far):
    """How far the mean is off between two distances from a square at (20, 28), and four deviations of its noise."""
    ring = np.zeros(clean.shape[:2], bool)
    ring[20 - far : 20 + size + far, 28 - far : 28 + size + far] = True
    ring[20 - near : 20 + size + near, 28 - near : 28 + size + near] = False
    return abs(image[ring].mean() / clean[ring].mean() - 1), 4 * 0.3 / np.sqrt(ring.sum())


@burning
@pytest.mark.parametrize("which", [(MIDDLE,), (MIDDLE - 1,)], ids=["centre", "side"])
def test_four_fireflies_together_leave_no_halo(value, which, record_property):
    """They passed for an object, and the non-local means left a thousand times the light three pixels away."""
    for preset in CLASSICAL_PRESETS:
        image = denoise(burn(shot(), value, 2, which), preset)[1]
        for near, far in ((0, 2), (2, 4), (4, 7)):
            error, noise = ring_error(image, truth(), 2, near, far)
            assert error < noise
    record_property("cases", 3 * len(CLASSICAL_PRESETS))


@burning
def test_what_may_be_an_object_does_not_leak_beyond_the_reach(value, record_property):
    """Nine bright pixels, or four in two frames, stay; a little of them is smeared over the reach of the filters."""
    for preset in CLASSICAL_PRESETS:
        for size, which in ((3, (MIDDLE,)), (3, (MIDDLE - 1,)), (2, (MIDDLE, MIDDLE + 1))):
            window, image = denoise(burn(shot(), value, size, which), preset)
            assert np.isfinite(image).all()
            assert within_range(window, image)
            error, noise = ring_error(image, truth(), size, REACH, REACH + 3)
            assert error < noise
    record_property("cases", 3 * len(CLASSICAL_PRESETS))


@pytest.mark.neural
@pytest.mark.parametrize("precision", ["float32", "bfloat16"])
def test_the_network_survives_fireflies(network, precision, record_property):
    for size in (1, 3):
        frames = burn(shot(), 1e6, size, (MIDDLE - 1, MIDDLE))
        image = network[precision](align(frames, first_pass=Classical(STANDARD))).color
        assert np.isfinite(image).all()
        assert (image >= 0).all()
    record_property("cases", 2)


def test_negative_radiance_stays_in_its_neighbourhood():
    frames = shot()
    frames[MIDDLE].color[10:12, 10:14] *= -1
    window, image = denoise(frames)
    assert np.isfinite(image).all()
    assert within_range(window, image)
    far = cv2.dilate((frames[MIDDLE].color.min(axis=-1) < 0).astype(np.uint8), np.ones((11, 11), np.uint8)) == 0
    assert (image[far] >= 0).all()


# --- variance and guides


@pytest.mark.parametrize("variance", [0.0, 1e-12, 1e3, 1e30, -1.0])
def test_any_variance_gives_a_picture_in_range(variance):
    frames = [spoil(f, variance=np.full_like(f.color, variance)) for f in shot()]
    window, image = denoise(frames)
    assert np.isfinite(image).all()
    assert within_range(window, image)


def unit(length):
    return lambda f: np.float32(length) * f.normal


GUIDES = {
    "no albedo": {"albedo": lambda f: np.zeros_like(f.albedo)},
    "constant albedo": {"albedo": lambda f: np.full_like(f.albedo, 0.5)},
    "albedo above one": {"albedo": lambda f: np.full_like(f.albedo, 40)},
    "negative albedo": {"albedo": lambda f: -f.albedo},
    "huge albedo": {"albedo": lambda f: np.full_like(f.albedo, 1e30)},
    "normals of length 0": {"normal": unit(0)},
    "normals of length 2": {"normal": unit(2)},
    "huge normals": {"normal": unit(1e30)},
    "noise for normals": {
        "normal": lambda f: np.random.default_rng(f.number).normal(size=f.normal.shape).astype(np.float32)
    },
    "noise for albedo": {"albedo": lambda f: np.random.default_rng(f.number).random(f.albedo.shape, np.float32)},
    "no guides": {"albedo": lambda f: None, "normal": lambda f: None},
    "no depth": {"depth": lambda f: np.zeros_like(f.depth)},
    "negative depth": {"depth": lambda f: -f.depth},
}


@pytest.mark.parametrize("changes", GUIDES.values(), ids=GUIDES)
def test_guides_that_tell_nothing_do_no_harm(changes):
    frames = [spoil(f, **{name: change(f) for name, change in changes.items()}) for f in shot()]
    window, image = denoise(frames)
    assert np.isfinite(image).all()
    assert (image >= 0).all()
    assert within_range(window, image)
