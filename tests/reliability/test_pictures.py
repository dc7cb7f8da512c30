"""No picture is silently wrong: rows 1, 5, 14 and 21 of docs/dev/reliability.md."""

# ruff: noqa: E501 - tables of cases, one a line

import os
import re
from collections.abc import Callable, Sequence
from itertools import product
from pathlib import Path

import cv2
import numpy as np
import OpenEXR
import pytest

from hybrid.denoising.plan import Rules
from hybrid.denoising.stream import FrameStream
from hybrid.files.shots import open_shot
from tests.commands import ravg
from tests.reliability.shots import (
    ALBEDO,
    COLOR,
    DRAFT,
    NORMAL,
    RAW,
    SIZE,
    VECTOR,
    Edit,
    Layers,
    cases,
    color,
    draft,
    names,
    read,
    read_layers,
    same,
    shot,
    write,
)

pytestmark = [pytest.mark.reliability, pytest.mark.posix]

# --- 1: what one window has and no other is found there

ODD = 6


def cut(index: int, layers: Layers) -> None:
    for name in (COLOR, ALBEDO) if index >= ODD else ():
        layers[name] = np.ascontiguousarray(layers[name][::-1, ::-1])


def spread(index: int, layers: Layers) -> None:
    """A pixel filter of three pixels, which is undone; after a cut it is measured from later frames."""
    taps = np.array([0.2, 1, 0.2]) / 1.4
    for name in (COLOR, ALBEDO, NORMAL):
        layers[name] = cv2.sepFilter2D(layers[name], -1, taps, taps, borderType=cv2.BORDER_REFLECT_101)


@cases({"throughout": None, "with a cut": cut}, "event")
def test_a_frame_whose_pixels_share_noise_is_the_same_in_chunks(folder, event):
    """Frame 1007 is the first after the cut."""
    noisy = shot(folder / "in", 9, event, spread, size=(96, 128))
    stream = FrameStream(open_shot(noisy), Rules())
    assert all(stream.rendered(number).spread is not None for number in range(1001, 1010))
    for out, frames in (("all", "1001-1009"), ("part", "1006-1007"), ("part", "1008")):
        ravg("denoise", noisy, "-o", folder / out, *DRAFT, "--frames", frames).succeeds()
    same(folder / "part", folder / "all")


# --- 5: what is opaque stays opaque


def covered(hole: Callable[[int], bool], share: float = 0.0) -> Edit:
    """An alpha that is opaque but for a hole in some frames."""

    def edit(index: int, layers: Layers) -> None:
        alpha = np.ones((*SIZE, 1), np.float32)
        if hole(index):
            alpha[8:16, 8:16] = share
            layers[COLOR][8:16, 8:16] *= share
        layers[COLOR] = np.concatenate([layers[COLOR], alpha], axis=-1)

    return edit


@pytest.mark.neural
def test_alpha_is_denoised_where_some_frame_has_a_hole(folder):
    """Whatever the first frame has."""
    shot(folder / "in", 8, covered(lambda index: index >= 5, 0.5), step=(2, 0))
    for first in (1001, 1005):
        words = ["denoise", "in", "-o", f"from {first}", "--first-pass", "nlm", "--frames", f"{first}-1008"]
        ravg(*words, folder=folder).succeeds()
    same(folder / "from 1005", folder / "from 1001")


def test_the_classical_chain_claims_no_stage_of_a_network(folder):
    shot(folder / "in", 3, covered(lambda index: True))
    said = ravg(*draft(), "-v", folder=folder).succeeds().said
    assert not re.search(r"\brun: (alpha|skip)", re.sub(r"not run: \w+", "", said))


# --- 14: fireflies go, lamps stay

PLACES = [(12, 16), (20, 34), (8, 40), (25, 8)]


@pytest.mark.parametrize(
    ("value", "estimate", "count"),
    [*product((300.0, 20_000.0, 60_000.0), ("none", "nlm", "oidn", "oidn-fast", "oidn-best"), (1,)),
     (5000.0, "none", 4), (5000.0, "oidn", 4)],
)  # fmt: skip
def test_a_spark_leaves_no_ring(folder, value, estimate, count):
    """A spark leaves no ring of light in 9×13 pixels around it."""

    def late(index: int, layers: Layers) -> None:
        for at in PLACES[:count] if index == 2 else ():
            layers[COLOR][at] = value

    for name, change in (("plain", None), ("burnt", late)):
        noisy = shot(folder / f"{name} in", 5, late=change, step=(1, 0))
        words = ["--first-pass", estimate, "--preset", "standard"]
        ravg("denoise", noisy, "-o", folder / name, *words).succeeds()
    for number in (1002, 1003, 1004):
        plain, made = (color(folder / name / f"shot.{number}.exr") for name in ("plain", "burnt"))
        for y, x in PLACES[:count]:
            block = slice(y - 4, y + 5), slice(x - 6, x + 7)
            assert made[block].mean() / plain[block].mean() <= 1.1
            assert made[block].max() / plain[block].max() <= 1.5


# --- 21: a frame that is not like the others


def stored(path: Path, layers: Layers, kind: type = np.float32, parts: bool = False, **header: object) -> None:
    """Write layers as halves, as parts, in tiles, with another window."""
    settings = {"compression": OpenEXR.ZIP_COMPRESSION, "type": OpenEXR.scanlineimage, **header}
    named = {
        name: {
            f"{name}.{c}": np.ascontiguousarray(plane.astype(kind))
            for c, plane in zip("XYZW" if name in (VECTOR, NORMAL) else "RGBA", np.moveaxis(layer, 2, 0), strict=False)
        }
        for name, layer in layers.items()
    }
    if parts:
        made = [OpenEXR.Part(dict(settings), channels, name) for name, channels in named.items()]
    else:
        made = [OpenEXR.Part(settings, {k: v for channels in named.values() for k, v in channels.items()}, "")]
    OpenEXR.File(made).write(str(path))


def tiles() -> OpenEXR.TileDescription:
    found = OpenEXR.TileDescription()
    found.xSize = found.ySize = 16
    return found


def window(left: int, top: int, height: int, width: int, whole: Sequence[int]) -> dict[str, object]:
    """The data window of a header, and a display window: first column and row, last column and row."""
    last = left + width - 1, top + height - 1
    return {
        "dataWindow": (np.array([left, top], np.int32), np.array(last, np.int32)),
        "displayWindow": (np.array(whole[:2], np.int32), np.array(whole[2:], np.int32)),
    }


Change = Callable[[Path, Layers], object]


def edited(change: Callable[[np.ndarray], np.ndarray]) -> Change:
    """Change every layer."""
    return lambda p, x: write(p, {k: np.ascontiguousarray(change(v)) for k, v in x.items()})


def with_layer(name: str, change: Callable[[np.ndarray], np.ndarray]) -> Change:
    """Change one layer."""
    return lambda p, x: write(p, {**x, name: np.float32(change(x[name]))})


def without(*left_out: str) -> Change:
    return lambda p, x: write(p, {k: v for k, v in x.items() if not any(word in k for word in left_out)})


def cropped(p: Path, x: Layers) -> None:
    part = {k: np.ascontiguousarray(v[4:20, 8:40]) for k, v in x.items()}
    stored(p, part, **window(8, 4, 16, 32, (0, 0, SIZE[1] - 1, SIZE[0] - 1)))


def moved(p: Path, x: Layers) -> None:
    stored(p, x, **window(100, 50, *SIZE, (100, 50, 100 + SIZE[1] - 1, 50 + SIZE[0] - 1)))


UNLIKE: dict[str, tuple[Change, str]] = {
    "half as large": (edited(lambda v: v[::2, ::2]), "refused"),
    "one row less": (edited(lambda v: v[:-1]), "refused"),
    "turned by 90 degrees": (edited(lambda v: v.swapaxes(0, 1)), "refused"),
    "cropped": (cropped, "either"),
    "of another origin": (moved, "works"),
    "of halves": (lambda p, x: stored(p, x, np.float16), "works"),
    "in parts": (lambda p, x: stored(p, x, parts=True), "works"),
    "in tiles": (lambda p, x: stored(p, x, type=OpenEXR.tiledimage, tiles=tiles()), "works"),
    "of another compression": (lambda p, x: stored(p, x, compression=OpenEXR.PIZ_COMPRESSION), "works"),
    "uncompressed": (lambda p, x: stored(p, x, **RAW), "works"),
    "of PXR24": (lambda p, x: stored(p, x, compression=OpenEXR.PXR24_COMPRESSION), "either"),
    "without an albedo": (without("Albedo"), "refused"),
    "without a normal": (without("Normal"), "either"),
    "without vectors": (without("Vector"), "works"),
    "without any guide": (without("Albedo", "Normal", "Vector"), "refused"),
    "without a color": (without("Combined"), "refused"),
    "with a layer more": (lambda p, x: write(p, {**x, "ViewLayer.Mist": x[COLOR][..., 0]}), "works"),
    "with another view layer too": (lambda p, x: write(p, {**x, "Fog.Combined": x[COLOR]}), "either"),
    "of another view layer": (lambda p, x: write(p, {k.replace("ViewLayer", "Fog"): v for k, v in x.items()}), "refused"),
    "with an alpha": (with_layer(COLOR, lambda v: np.concatenate([v, np.ones((*SIZE, 1))], -1)), "either"),
    "of one channel": (lambda p, x: write(p, {"": x[COLOR][..., 0]}), "refused"),
    "that is black": (with_layer(COLOR, lambda v: 1e-20 + 0 * v), "either"),
    "of vectors that are not finite": (with_layer(VECTOR, lambda v: np.nan * v), "works"),
    "of vectors of a million": (with_layer(VECTOR, lambda v: 1e6 + v), "works"),
    "with normals of zero": (with_layer(NORMAL, lambda v: 0 * v), "works"),
    "with a negative albedo": (with_layer(ALBEDO, lambda v: -v), "works"),
    "with an albedo of zero": (with_layer(ALBEDO, lambda v: 0 * v), "works"),
    "with an albedo of a thousand": (with_layer(ALBEDO, lambda v: 1000 * v), "works"),
    "a thousand times brighter": (with_layer(COLOR, lambda v: 1000 * v), "works"),
    "a millionth as bright": (with_layer(COLOR, lambda v: 1e-6 * v), "works"),
    "of negative light": (with_layer(COLOR, lambda v: -v), "either"),
    "cut short": (lambda p, x: os.truncate(p, p.stat().st_size - 500), "refused"),
    "that is empty": (lambda p, x: os.truncate(p, 0), "refused"),
}  # fmt: skip


@cases(UNLIKE)
def test_a_frame_unlike_the_others_is_refused_by_its_name_or_keeps_what_it_had(folder, case):
    change, how = case
    path = shot(folder / "in", 5, step=(2, 1)) / "shot.1003.exr"
    change(path, read_layers(path))
    done = ravg(*draft(), folder=folder, seconds=60).ends(how)
    if done.code:
        assert "1003" in done.said
        return
    for name in names(folder / "in"):
        before, after = read(folder / "in" / name), read(folder / "out" / name)
        assert {k: (v.dtype, v.shape) for k, v in before.items()} == {k: (v.dtype, v.shape) for k, v in after.items()}
        red = next(k for k in before if k.endswith("Combined.R") or k == "R")
        assert np.isfinite(after[red]).all()
        assert 0.7 < after[red].mean() / before[red].mean() < 1.4
        for channel in before:
            if not channel.endswith(("Combined.R", "Combined.G", "Combined.B")):
                np.testing.assert_array_equal(before[channel], after[channel])
