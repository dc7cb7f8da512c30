"""Light that changes, black frames, exposure, vectors over nothing, sums: no frame is worse than what went in.

Noise of 20 %, that of a path tracer, over a wall whose truth is known, for a network and the classical chain.
"""

from collections.abc import Callable, Iterator
from pathlib import Path

import numpy as np
import pytest

from ravg import denoise_shot, open_shot
from tests.reliability.test_noise_ladder import psnr
from tests.scenes import Scene, grained

pytestmark = pytest.mark.reliability
FRAMES, NOISE = 6, 0.2
STILL = Scene(72, 112, FRAMES, first=1, step=(0, 0))
MOVING = Scene(72, 112, FRAMES, first=1, step=(2, 1))
Layers = dict[str, np.ndarray]
Edit = Callable[[int, Layers], None]
COLOR, ALBEDO, NORMAL, VECTOR = (
    f"ViewLayer.{name}" for name in ("Combined", "Denoising Albedo", "Denoising Normal", "Vector")
)


def times(light: Callable[[int], object], where: tuple[slice, ...] = np.s_[:, :]) -> Edit:
    """Light times a factor that depends on the frame, in a part of the picture."""

    def edit(index: int, layers: Layers) -> None:
        layers[COLOR][where] *= np.float32(light(index))

    return edit


def dark_beside_bright(index: int, layers: Layers) -> None:
    layers[COLOR][:, :56] *= np.float32(0.004 * (1 + index % 2))


def shadow(index: int, layers: Layers) -> None:
    layers[COLOR][:, : 20 + 12 * index] *= np.float32(0.3)


def beam(index: int, layers: Layers) -> None:
    layers[COLOR][:, 10 + 15 * index] += 2


def sun(index: int, layers: Layers) -> None:
    y, x = np.mgrid[:72, :112]
    disk = np.hypot(y - 20, x - 20 - 6 * index) < 4
    layers[COLOR][disk], layers[ALBEDO][disk] = 5000, 1


def snow(index: int, layers: Layers) -> None:
    rng = np.random.default_rng(7)
    y, x = rng.integers(0, 72, 120), rng.integers(0, 112, 120)
    layers[COLOR][(y + 5 * index) % 72, (x - 2 * index) % 112] += 3


def rain(index: int, layers: Layers) -> None:
    rng = np.random.default_rng(7)
    y, x = rng.integers(0, 72, 60), rng.integers(0, 112, 60)
    for k in range(3):
        layers[COLOR][(y + 9 * index + k) % 72, x] += 1.5


def letterbox(_: int, layers: Layers) -> None:
    for name in (COLOR, ALBEDO, NORMAL, VECTOR):
        layers[name][:10] = layers[name][-10:] = 0


def cut(index: int, layers: Layers) -> None:
    if index >= 3:
        for name in (COLOR, ALBEDO):
            layers[name][:] = layers[name][::-1, ::-1]
        layers[COLOR] *= 2
        layers[VECTOR] *= -1


def object_on_black(background: float) -> Edit:
    """An object that moves with its texture, and vectors of a value where nothing is."""

    def edit(index: int, layers: Layers) -> None:
        y, x = np.mgrid[:72, :112]
        outside = np.hypot(y - 30 - index, x - 30 - 2 * index) >= 14
        for name in (COLOR, ALBEDO, NORMAL):
            layers[name][outside] = 0
        layers[VECTOR][outside] = background

    return edit


def black_emitters(_: int, layers: Layers) -> None:
    layers[ALBEDO][::9], layers[COLOR][::9], layers[VECTOR][::9] = 0, 0.8, 0


def black_lamps(index: int, layers: Layers) -> None:
    """Lamps of 6×6 pixels on the wall, without a surface."""
    y, x = np.mgrid[:72, :112]
    lamps = ((y - index) % 24 < 6) & ((x - 2 * index) % 28 < 6)
    layers[ALBEDO][lamps], layers[COLOR][lamps] = 0, 0.8


def dust(_: int, layers: Layers) -> None:
    lit = layers[COLOR][20:30, 30:40].copy()
    layers[COLOR] *= np.float32(1e-8)
    layers[COLOR][20:30, 30:40] = lit


def screen_in_a_fade(index: int, layers: Layers) -> None:
    layers[COLOR] *= np.float32(0.6**index)
    layers[COLOR][20:50, 30:70] = 0.5 * layers[ALBEDO][20:50, 30:70]


CASES: dict[str, tuple[Scene, Edit]] = {
    "a black frame": (STILL, times(lambda i: i != 3)),
    "every second frame black": (STILL, times(lambda i: i % 2)),
    "a fade from black": (STILL, times(lambda i: 0 if i == 0 else 4.0 ** (i - 5))),
    "lights go out": (STILL, times(lambda i: 1 if i < 3 else 1e-3)),
    "a white flash": (STILL, times(lambda i: 20 if i == 3 else 1)),
    "exposure grows": (MOVING, times(lambda i: 1.5**i)),
    "exposure alternates by 8": (MOVING, times(lambda i: 8 if i % 2 else 1)),
    "all at 10,000": (MOVING, times(lambda i: 1e4)),
    "all at 0.0001": (MOVING, times(lambda i: 1e-4)),
    "flicker of 1 %": (STILL, times(lambda i: 1.01 if i % 2 else 0.99)),
    "flicker of 20 %": (STILL, times(lambda i: 1.2 if i % 2 else 0.8)),
    "the hue alternates": (STILL, times(lambda i: (1.1, 1, 0.9) if i % 2 else (0.9, 1, 1.1))),
    "3 pixels blink": (STILL, times(lambda i: 3 if i % 2 else 1, np.s_[30:33, 50:53])),
    "9 pixels blink": (STILL, times(lambda i: 3 if i % 2 else 1, np.s_[30:39, 50:59])),
    "24 pixels blink by 10 %": (STILL, times(lambda i: 1.1 if i % 2 else 1, np.s_[24:48, 40:64])),
    "the dark alternates": (STILL, dark_beside_bright),
    "dust of 1e-8": (STILL, dust),
    "a shadow": (STILL, shadow),
    "a beam of a pixel": (STILL, beam),
    "a fade through black": (MOVING, times(lambda i: (1, 0.3, 0, 0, 0.3, 1)[i])),
    "channels fade": (MOVING, times(lambda i: (0.8**i, 0.6**i, 0.7**i))),
    "one step of light": (MOVING, times(lambda i: 1 if i < 3 else 0.5)),
    "a screen in a fade": (STILL, screen_in_a_fade),
    "half the picture fades": (STILL, times(lambda i: 0.6**i, np.s_[:, 50:])),
    "three fifths blink by 3 %": (STILL, times(lambda i: 1.03 if i % 2 else 0.97, np.s_[:, :68])),
    "a sun without vectors": (STILL, sun),
    "snow": (STILL, snow),
    "rain": (STILL, rain),
    "a letterbox": (MOVING, letterbox),
    "a cut": (MOVING, cut),
    "vectors NaN over nothing": (MOVING, object_on_black(np.nan)),
    "vectors of 1e10 over nothing": (MOVING, object_on_black(1e10)),
    "vectors of 0 over nothing": (MOVING, object_on_black(0)),
    "emitters of black albedo": (MOVING, black_emitters),
    "lamps of black albedo": (MOVING, black_lamps),
}


# Known faults: decibels below the samples by which a frame may lie in place of `WORST`; the test is then an expected
# failure. Lines of a pixel that cross the motion in every patch of pixels, so that vectors are not trusted, which is
# stated; a screen whose light stands still while the picture around it fades; and first passes of `fast` that err by
# more than such noise where few neighbours show the same.
WORST = 1
KNOWN = {
    ("emitters of black albedo", "fast"): 16,
    ("emitters of black albedo", "draft"): 16,
    ("a screen in a fade", "draft"): 9,
    ("a screen in a fade", "fast"): 3,
    ("a fade through black", "fast"): 1.5,
    ("a beam of a pixel", "fast"): 2,
    ("rain", "fast"): 2,
}


def allow(loss: float, bound: float, known: float | None) -> None:
    """Fail beyond the bound, and beyond that of a known fault; in between it is an expected failure."""
    assert loss <= (bound if known is None else known)
    if loss > bound:
        pytest.xfail(f"a known fault: {loss:.2f} dB, of at most {bound}")


def denoised(
    folder: Path, name: str, noise: float, preset: str
) -> Iterator[tuple[int, np.ndarray, np.ndarray, np.ndarray]]:
    """Denoise a case; number, truth, noisy and denoised color of each frame."""
    scene, edit = CASES[name]
    truths = []

    def with_noise(index: int, layers: Layers) -> None:
        edit(index, layers)
        truths.append(layers[COLOR].copy())
        # A sun has no noise; what is as bright on the whole has.
        lamp = (truths[-1] > 1000) & (np.median(truths[-1]) < 1000)
        layers[COLOR] = np.where(lamp, layers[COLOR], grained(layers[COLOR], (2, index), noise))

    shot = open_shot(scene.write(folder / "in", clean=True, edit=with_noise))
    frames = sorted(denoise_shot(shot, folder / "out", preset=preset), key=lambda frame: frame.number)
    for frame, truth in zip(frames, truths, strict=True):
        yield frame.number, truth, shot.read(frame.number).color, open_shot(frame.path).read(frame.number).color


@pytest.mark.filterwarnings("error")
@pytest.mark.parametrize("preset", ["fast", "draft"])
@pytest.mark.parametrize("name", CASES)
def test_no_frame_is_worse_than_its_input(tmp_path: Path, name: str, preset: str) -> None:
    losses = []
    for number, truth, noisy, made in denoised(tmp_path, name, NOISE, preset):
        losses.append(psnr(noisy, truth) - psnr(made, truth))
        if not truth.any():
            assert not made.any()
            continue
        # The sun covers 45 pixels, of which 24 are edges.
        lit, error = (0.06, 0) if name == "a sun without vectors" else (0.01, NOISE * truth.std() / truth.mean())
        off = made.mean() / truth.mean() - 1
        assert abs(off) < lit + 4 * (error + NOISE) / np.sqrt(np.count_nonzero(truth.any(axis=-1))), number
    # The dust's 100 lit pixels are as few as the first pass of `fast` errs over.
    allow(max(losses), 0.05, 0.2 if (name, preset) == ("dust of 1e-8", "fast") else None)


@pytest.mark.parametrize("preset", ["fast", "draft"])
@pytest.mark.parametrize("name", CASES)
def test_next_to_no_noise_costs_no_frame_a_decibel(tmp_path: Path, name: str, preset: str) -> None:
    frames = denoised(tmp_path, name, 0.01, preset)
    losses = [psnr(noisy, truth) - psnr(made, truth) for _, truth, noisy, made in frames]
    allow(max(losses), WORST, KNOWN.get((name, preset)))


@pytest.mark.parametrize("tint", [(1, 1, 1), (1, 0.6, 0.3)])
@pytest.mark.parametrize("share", [lambda i: 0.3, lambda i: 0.3 * (i % 2), lambda i: 2.0 * (i == 2)])
def test_parts_add_up_whatever_their_light_does(tmp_path, share, tint):
    """A gray or tinted gloss that stands, blinks or flashes beside a textured diffuse light."""

    def split(index: int, layers: Layers) -> None:
        diffuse = grained(layers[COLOR], (3, index), NOISE)
        gloss = grained(np.full_like(diffuse, share(index)) * np.float32(tint), (4, index), NOISE)
        parts = {"ViewLayer.diffuse": diffuse, "ViewLayer.specular": gloss}
        layers |= {COLOR: diffuse + gloss, **parts}

    shot = open_shot(STILL.write(tmp_path / "in", clean=True, edit=split), aovs=["all"])
    for frame in denoise_shot(shot, tmp_path / "out", preset="fast"):
        made = open_shot(frame.path, aovs=["all"]).read(frame.number)
        np.testing.assert_allclose(sum(made.aovs.values()), made.color, atol=1e-5 * made.color.mean())


def test_aovs_of_a_fade_keep_their_own_light(tmp_path: Path) -> None:
    """The key light fades; the fill light and a noisy color without light do not."""
    truths: dict[tuple[int, str], np.ndarray] = {}

    def split(index: int, layers: Layers) -> None:
        lights = {
            "ViewLayer.Combined_key": layers[COLOR] * np.float32(0.6**index),
            "ViewLayer.Combined_fill": 0.2 * layers[ALBEDO],
            "ViewLayer.emission": 3 * layers[ALBEDO],
        }
        truths.update({(index + 1, name): layer for name, layer in lights.items()})
        noisy = {name: grained(layer, (k, index), NOISE) for k, (name, layer) in enumerate(lights.items())}
        layers |= noisy | {COLOR: noisy["ViewLayer.Combined_key"] + noisy["ViewLayer.Combined_fill"]}

    shot = open_shot(STILL.write(tmp_path / "in", clean=True, edit=split), aovs=["all"])
    for frame in denoise_shot(shot, tmp_path / "out", preset="fast"):
        given = shot.read(frame.number).aovs
        for name, layer in open_shot(frame.path, aovs=["all"]).read(frame.number).aovs.items():
            truth = truths[frame.number, name]
            assert psnr(layer, truth) >= psnr(given[name], truth) - 0.05, (frame.number, name)
            assert abs(layer.mean() / truth.mean() - 1) < 0.03, (frame.number, name)


@pytest.mark.parametrize("preset", ["fast", "draft"])
def test_equal_frames_come_out_equal(tmp_path: Path, preset: str) -> None:
    """One seed for all frames, fireflies among its noise: nothing flickers, and in a fade they are removed as well."""

    def equal(fade: float) -> Edit:
        def edit(index: int, layers: Layers) -> None:
            color = grained(layers[COLOR], 5, NOISE)
            color[np.random.default_rng(3).random(color.shape[:2]) < 0.001] += 240
            layers[COLOR] = color * np.float32(fade**index)

        return edit

    least = np.inf
    for fade in (1, 0.8):
        folder = tmp_path / str(fade)
        shot = open_shot(STILL.write(folder / "in", clean=True, edit=equal(fade)))
        frames = sorted(denoise_shot(shot, folder / "out", preset=preset), key=lambda frame: frame.number)
        made = [open_shot(frame.path).read(frame.number).color for frame in frames]
        for index, picture in enumerate(made):
            least = min(least, psnr(picture, STILL.clean(index)[COLOR] * np.float32(fade**index)))
            if fade == 1:
                np.testing.assert_array_equal(picture, made[0])
    assert least > 33
