"""New EXR files for tests and benchmarks."""

import os
from collections.abc import Iterable, Mapping
from pathlib import Path

import numpy as np
import OpenEXR

from hybrid.files.exr import _convert, _is_vector, _named, _write


def write_layers(
    path: str | Path,
    layers: Mapping[str, np.ndarray],
    *,
    half: bool = True,
    attributes: Mapping[str, str] | None = None,
) -> int:
    """Write a new single-part file (ZIP, scan lines); return how many finite values were too large for half.

    A layer is (H, W) or (H, W, C ≤ 4), its components named R G B A; X Y Z W where the name ends in normal, vector,
    motion or position; Z for depth; Y for other single channels; "" writes bare R, G, B, A. With `half`, R, G, B, A
    and Y are stored as half; X, Y, Z, W and depth stay float32, as in Blender: half has three digits, too few for a
    motion of 100 pixels.
    """
    sizes = {name: values.shape[:2] for name, values in layers.items()}
    if len(set(sizes.values())) != 1:
        raise ValueError(f"layers must be of one size, got {sizes}")
    channels, clamped = {}, 0
    for name, values in layers.items():
        for channel, plane in _named(name, values).items():
            data = _is_vector(name) or channel.endswith(".Z")
            kind = np.dtype(np.float16 if half and not data else np.float32)
            pixels, count = _convert(plane, plane.dtype if plane.dtype == np.uint32 else kind)
            clamped += count
            channels[channel] = OpenEXR.Channel(channel, pixels)
    header = {"compression": OpenEXR.ZIP_COMPRESSION, "type": OpenEXR.scanlineimage, **(attributes or {})}
    _write(Path(path), [OpenEXR.Part(header, channels, "")])
    return clamped


SIZE = 4, 6


def flat_image(value: float, count: int = 3, size: tuple[int, int] = SIZE) -> np.ndarray:
    return np.full((*size, count), value, np.float32)


def save_frames(
    folder: Path, numbers: Iterable[int], name: str = "shot.{:04d}.exr", size: tuple[int, int] = SIZE
) -> Path:
    """Frames whose color is their number."""
    for number in numbers:
        layers = {"color": flat_image(number, size=size), "motion": flat_image(-number, 2, size)}
        write_layers(folder / name.format(number), layers)
    return folder


def exchange(path: Path) -> None:
    """Put another file of the same size and time in a file's place; an unused header value differs."""
    before = path.stat()
    spare = path.with_name("spare")
    content = bytearray(path.read_bytes())
    name = b"screenWindowWidth\0float\0\4\0\0\0"
    content[content.index(name) + len(name)] ^= 1
    spare.write_bytes(content)
    os.utime(spare, ns=(before.st_atime_ns, before.st_mtime_ns))
    spare.replace(path)
