"""NaN, +Inf and -Inf in every layer: the picture is finite, the damage stays where it is, and is told of once."""

from functools import lru_cache
from itertools import product

import numpy as np
import pytest

from hybrid.cli import main
from hybrid.comparison.metrics import psnr
from hybrid.denoising.first_pass import PerFrame
from hybrid.denoising.pseudo_reference import FINAL, STANDARD, filter_window
from tests.hard_cases.hard import (
    MIDDLE,
    SCENE,
    STAGES,
    SUPPORT,
    align,
    denoise,
    frame,
    itself,
    shot,
    spoil,
    truth,
    within_range,
)
from tests.scenes import Scene
from tests.seldom import seldom

values = pytest.mark.parametrize("value", [np.nan, *seldom(np.inf, -np.inf)], ids=["nan", "inf", "minus-inf"])
PLACES = {
    "pixel": (slice(20, 21), slice(28, 29)),
    "block": (slice(10, 26), slice(14, 40)),
    "frame": (slice(None), slice(None)),
}
LAYERS = ("color", "albedo", "normal", "depth", "motion", "variance", "together")
WHICH = {"centre": (MIDDLE,), "side": (MIDDLE - 1,), "all": range(SCENE.frames)}
# Each place and each choice of frames once; the other pairs are tried seldom.
PAIRS = [("pixel", "all"), ("block", "side"), ("frame", "centre")]
where = pytest.mark.parametrize("where", [*PAIRS, *seldom(*(p for p in product(PLACES, WHICH) if p not in PAIRS))])


def with_variance():
    return [spoil(f, variance=(0.09 * f.color**2).astype(np.float32)) for f in shot()]


def corrupted(frames, layer, value, place, which):
    """The frames with `value` at a place of a layer (of one channel, where it has several) of some of them."""
    out = list(frames)
    names = LAYERS[:-1] if layer == "together" else (layer,)
    for index in which:
        changed = {}
        for name in names:
            plane = getattr(out[index], name).copy()
            plane[(*place, *([1] if plane.ndim == 3 else []))] = value
            changed[name] = plane
        out[index] = spoil(out[index], **changed)
    return out


@values
@where
@pytest.mark.parametrize("layer", LAYERS)
def test_the_picture_is_finite_and_in_range(layer, value, where):
    window, image = denoise(corrupted(with_variance(), layer, value, PLACES[where[0]], WHICH[where[1]]))
    assert np.isfinite(image).all()
    assert (image >= 0).all()
    assert within_range(window, image)


@pytest.mark.neural
@pytest.mark.parametrize("precision", ["bfloat16", *seldom("float32")])
@values
@where
def test_the_network_is_finite(value, precision, where):
    from hybrid.neural import open_network
    from network.checkpoint import shipped_weights

    denoiser = open_network(shipped_weights("fast"), precision=precision)
    for layer in ("color", "together"):
        frames = corrupted(with_variance(), layer, value, PLACES[where[0]], WHICH[where[1]])
        image = denoiser(align(frames, first_pass=PerFrame(itself))).color
        assert np.isfinite(image).all()
        assert (image >= 0).all()


def test_pixels_of_any_layer_are_counted_once_each():
    frames = shot()
    one = frames[MIDDLE]
    color, albedo, normal = one.color.copy(), one.albedo.copy(), one.normal.copy()
    color[3, 4] = np.nan, np.inf, -np.inf
    albedo[3, 4, 0] = np.nan  # the same pixel
    albedo[5, 6] = np.inf
    normal[7, 8, 2] = np.nan
    mask = np.ones((SCENE.height, SCENE.width, 1), np.float32)
    mask[9, 10] = np.nan
    frames = [spoil(f, aovs={"mask": np.ones_like(mask)}) for f in frames]
    frames[MIDDLE] = spoil(one, color=color, albedo=albedo, normal=normal, aovs={"mask": mask})
    window = align(frames)
    assert window.centre.frame.repaired == 4
    assert np.isfinite(window.aovs["mask"]).all()


def test_each_frame_with_lost_pixels_is_told_of_once(tmp_path, capsys):
    def lose(index, layers):
        if index < 2:
            layers["ViewLayer.Combined"][5, 6 : 9 + index] = np.nan

    folder = Scene().write(tmp_path / "in", edit=lose)
    assert main(["denoise", str(folder), "-o", str(tmp_path / "out"), "--preset", "draft"]) == 0
    said = [line for line in capsys.readouterr().err.splitlines() if "not finite" in line]
    assert said == [
        "warning: frame 1001: 3 pixels were not finite or beyond 1e14, filled in from neighbours; check the render",
        "warning: frame 1002: 4 pixels were not finite or beyond 1e14, filled in from neighbours; check the render",
    ]


def test_a_frame_without_a_finite_pixel_fails_as_a_damaged_one(tmp_path, capsys):
    def lose(index, layers):
        if index == 1:
            layers["ViewLayer.Combined"][:] = np.nan

    folder, out = Scene().write(tmp_path / "in", edit=lose), tmp_path / "out"
    assert main(["denoise", str(folder), "-o", str(out), "--preset", "draft", "--keep-going"]) == 1
    said = [line for line in capsys.readouterr().err.splitlines() if line.startswith("error")]
    assert said == [
        "error: frame 1002: no pixel of color is finite, expected a rendered frame",
        "error: frames not made: 1002",
    ]
    assert len(list(out.glob("*.exr"))) == len(list(folder.glob("*.exr"))) - 1


@lru_cache
def undamaged(scene):
    return denoise(shot(scene))[1]


@values
@pytest.mark.parametrize("layer", ["color", "albedo", "normal", "motion"])
def test_damage_stays_within_the_support(layer, value, record_property):
    scene = Scene(height=64, width=96, frames=5)
    plain = undamaged(scene)
    place = slice(30, 32), slice(40, 42)
    # The warp moves a side frame by 2 px at most here; a wrong vector fetches from elsewhere, but into its own pixel.
    reach = SUPPORT + 2
    far = np.ones(plain.shape[:2], bool)
    far[30 - reach : 32 + reach, 40 - reach : 42 + reach] = False
    assert far.sum() > 1000
    for which in ((MIDDLE,), (MIDDLE - 1,)):
        image = denoise(corrupted(shot(scene), layer, value, place, which))[1]
        # The guides' mean and deviation over the frame, and the exposure, change by what four pixels are in 6144.
        np.testing.assert_allclose(image[far], plain[far], rtol=5e-3)
    record_property("cases", 2)


@pytest.mark.parametrize("preset", [STANDARD, FINAL])
def test_a_lost_frame_is_made_of_its_neighbours(preset):
    """It came out black: the filter compared the neighbours with the zeros that had been filled in."""
    frames = shot()
    frames[MIDDLE] = spoil(frames[MIDDLE], color=np.full_like(frames[MIDDLE].color, np.nan))
    image = filter_window(align(frames), preset)
    inner = slice(4, -4), slice(6, -6)  # where the neighbours see the same
    assert psnr(image[inner], truth()[inner]) > psnr(frame(MIDDLE).color[inner], truth()[inner]) + 3


def test_a_lost_block_is_made_of_its_neighbours():
    """Its middle was a smear of its rim."""
    frames = shot()
    color = frames[MIDDLE].color.copy()
    block = slice(12, 28), slice(16, 40)
    color[block] = np.nan
    frames[MIDDLE] = spoil(frames[MIDDLE], color=color)
    image = denoise(frames)[1]
    assert psnr(image[block], truth()[block]) > psnr(frame(MIDDLE).color[block], truth()[block]) + 3


def test_a_lost_shot_is_black_and_not_nan():
    frames = [spoil(f, color=np.full_like(f.color, np.nan)) for f in shot()]
    window, image = denoise(frames)
    assert window.centre.frame.repaired == SCENE.height * SCENE.width
    assert (image == 0).all()


def test_infinities_of_both_signs_raise_no_warning(recwarn):
    """Their sum is NaN, which numpy remarked on."""
    frames = corrupted(shot(), "color", np.inf, PLACES["pixel"], (MIDDLE,))
    frames[MIDDLE].color[3, 3] = -np.inf
    denoise(frames, stages=STAGES)
    assert not recwarn.list
