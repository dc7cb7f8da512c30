"""Shots that something is done to, and what is found in files afterwards."""

import os
import shutil
from collections.abc import Callable, Iterable, Mapping, Sequence
from pathlib import Path
from typing import Any

import cv2
import numpy as np
import OpenEXR
import pytest

from tests.exr_files import write_layers
from tests.scenes import Scene, grained

Layers = dict[str, np.ndarray]
Edit = Callable[[int, Layers], object]
SIZE = 32, 48
DRAFT = "--preset", "draft"
COLOR, ALBEDO, NORMAL, VECTOR = (
    f"ViewLayer.{name}" for name in ("Combined", "Denoising Albedo", "Denoising Normal", "Vector")
)
RAW = {"compression": OpenEXR.NO_COMPRESSION}  # so that other pixels are as many bytes


def cases(table: Mapping[str, object] | Iterable[object], name: str = "case") -> pytest.MarkDecorator:
    """Parametrize by a table: identifier → case, or by values that name themselves."""
    if isinstance(table, Mapping):
        return pytest.mark.parametrize(name, list(table.values()), ids=list(table))
    return pytest.mark.parametrize(name, list(table), ids=lambda value: str(value)[:40] or "empty")


def nothing(folder: Path) -> None:
    """Leave all as it is."""


def wall(index: int, step: tuple[int, int] = (0, 0), size: tuple[int, int] = SIZE) -> Layers:
    """The layers of a frame without noise; the wall moves by `step` pixels right and down per frame."""
    layers = Scene(*size, step=step).clean(index)
    del layers["ViewLayer.Depth"]
    return layers


def write(path: Path, layers: Layers, **header: object) -> Path:
    """Write a file of named layers as float32."""
    path.parent.mkdir(parents=True, exist_ok=True)
    write_layers(path, layers, half=False, attributes=header)  # type: ignore[arg-type]
    return path


def shot(
    folder: Path,
    frames: int = 6,
    edit: Edit | None = None,
    late: Edit | None = None,
    *,
    step: tuple[int, int] = (0, 0),
    size: tuple[int, int] = SIZE,
    noise: float = 0.3,
    name: str = "shot.{:04d}.exr",
    first: int = 1001,
    **header: object,
) -> Path:
    """Write a sequence: `edit` changes the layers of a frame before noise is added to the color, `late` after that."""
    for index in range(frames):
        layers = wall(index, step, size)
        if edit is not None:
            edit(index, layers)
        for layer in layers if noise else ():
            if layer.endswith("Combined"):
                layers[layer][..., :3] = grained(layers[layer][..., :3], (3, index), noise)
        if late is not None:
            late(index, layers)
        write(folder / name.format(abs(first + index)), layers, **header)
    return folder


def blurred(folder: Path, source: Path) -> Path:
    """Write what a cheap denoiser of single frames makes of a shot."""
    for path in sorted(source.glob("*.exr")):
        write(folder / path.name, {**wall(0), COLOR: cv2.GaussianBlur(color(path), (0, 0), 1.5)})
    return folder


def read(path: Path) -> Layers:
    """Channel → pixels."""
    parts = OpenEXR.File(str(path), separate_channels=True).parts
    return {name: channel.pixels for part in parts for name, channel in part.channels.items()}


def read_layers(path: Path) -> Layers:
    """Layer → pixels."""
    found = read(path)
    ordered = sorted(found, key=lambda name: "RGBAXYZW".find(name[-1]))
    groups = dict.fromkeys(name.rpartition(".")[0] for name in found)
    return {g: np.stack([found[name] for name in ordered if name.rpartition(".")[0] == g], -1) for g in groups}


def color(path: Path, layer: str = COLOR) -> np.ndarray:
    found = read(path)
    return np.stack([found[f"{layer}.{c}" if layer else c] for c in "RGB"], axis=-1).astype(np.float32)


def rewrite(path: Path, channels: Layers, seconds: float | None = None) -> None:
    """Write other pixels with the same header, in as many bytes; the time stays, or is `seconds`."""
    when = path.stat().st_mtime if seconds is None else seconds
    header: dict[str, Any] = dict(OpenEXR.File(str(path), header_only=True).parts[0].header)
    header.pop("channels", None)
    stored = {name: OpenEXR.Channel(name, pixels) for name, pixels in channels.items()}
    OpenEXR.File([OpenEXR.Part(header, stored, "")]).write(str(path))
    os.utime(path, (when, when))


def render_again(path: Path, seconds: float | None = None, layer: str = COLOR) -> None:
    """Turn the red of a layer."""
    found = read(path)
    red = found[f"{layer}.R"]
    rewrite(path, {**found, f"{layer}.R": red.reshape(-1)[::-1].copy().reshape(red.shape)}, seconds)


def exchange(a: Path, b: Path) -> None:
    spare = a.with_name("spare")
    a.rename(spare)
    b.rename(a)
    spare.rename(b)


def names(folder: Path) -> set[str]:
    return {path.name for path in folder.glob("*.exr")}


def difference(one: Path, other: Path, only: set[str] | None = None) -> str | None:
    """How the frames of two folders differ."""
    wanted = names(one) if only is None else only
    if not wanted or not wanted <= names(other):
        return f"{sorted(wanted)} are expected in both, found {sorted(names(other))}"
    for name in sorted(wanted):
        first, second = read(one / name), read(other / name)
        if first.keys() != second.keys():
            return f"{name}: {first.keys() ^ second.keys()} in one alone"
        for channel, pixels in first.items():
            if not np.array_equal(pixels, second[channel], equal_nan=True):
                return f"{name}: {channel} differs by up to {np.nanmax(np.abs(pixels.astype(float) - second[channel]))}"
    return None


def same(one: Path, other: Path) -> None:
    """Assert that the frames of one folder are in the other, with the same pixels."""
    assert difference(one, other) is None


def assert_no_worse(planned: np.ndarray, forced: np.ndarray, truth: np.ndarray, name: str) -> None:
    """Assert that a picture is not worse than another by more than 0.2 dB or 1 % of its mean."""
    scale = float(truth.mean()) or 1.0
    errors = [float(np.mean(np.square(x / (x + scale) - truth / (truth + scale)))) for x in (planned, forced)]
    means = [abs(float(x.mean() - truth.mean())) / scale for x in (planned, forced)]
    assert 10 * np.log10((errors[0] + 1e-9) / (errors[1] + 1e-9)) <= 0.2, name
    assert means[0] - means[1] <= 0.01, name


def contents(*folders: Path) -> dict[Path, bytes]:
    """The bytes of every file in folders."""
    return {path: path.read_bytes() for folder in folders for path in folder.rglob("*") if path.is_file()}


def unchanged(before: dict[Path, bytes]) -> None:
    """Assert that files are there with the bytes that they had."""
    assert [path for path, data in before.items() if not path.exists() or path.read_bytes() != data] == []


def no_leftovers(folder: Path) -> None:
    """Assert that there is no temporary file."""
    assert [path.name for path in folder.iterdir() if path.name.startswith(".")] == []


def weights(folder: Path, root: Path, name: str = "fast") -> Path:
    """A copy of weights that ship."""
    return Path(shutil.copy(root / "network" / "weights" / f"{name}.safetensors", folder / "w.safetensors"))


def draft(*more: object) -> Sequence[object]:
    """The words of the cheapest run from `in` to `out`."""
    return ["denoise", "in", "-o", "out", *DRAFT, *more]
