"""Rendered frames on disk: ranges of numbers, and whether a file is a noisy render. Independent of Blender."""

import re
import struct
from collections.abc import Iterable
from pathlib import Path
from typing import BinaryIO

MAGIC = 20000630  # the first four bytes of every OpenEXR file
_PARTS = 0x1000  # the flag of files with several parts
_LONGEST = 255  # bytes of a name, by the format
_LARGEST = 1 << 24  # bytes of one header attribute; a broken file may claim any number


def ranges(numbers: Iterable[int]) -> str:
    """Format frame numbers as ``--frames`` takes them: ``4-6,9``, ``1-9x2``."""
    runs: list[list[int]] = []
    for number in sorted(numbers):
        run = runs[-1] if runs else []
        if len(run) == 1 or (len(run) > 1 and number - run[-1] == run[1] - run[0]):
            run.append(number)
        else:
            runs.append([number])
    return ",".join(text for run in runs for text in _texts(run))


def _texts(run: list[int]) -> list[str]:
    """Format one run of equal steps; two numbers that are no neighbours stay apart."""
    if len(run) == 1:
        return [str(run[0])]
    step = run[1] - run[0]
    if len(run) == 2 and step > 1:
        return [str(run[0]), str(run[1])]
    return [f"{run[0]}-{run[-1]}" + (f"x{step}" if step > 1 else "")]


def refusal(path: Path, *, cycles: bool) -> str:
    """Return why a file is not a noisy frame with the passes that ravg reads, or ""; `cycles`: rendered by Cycles."""
    try:
        attributes, channels = read_header(path)
    except (OSError, ValueError) as error:
        return f"it cannot be read as OpenEXR ({error})"
    if any(name.startswith("ravg/") for name in attributes):
        return "it is denoised already"
    layers = {found[1] for name in channels if (found := re.fullmatch(r"(.+)\.Combined\..+", name))}
    if "Composite" in layers:
        return "it is the compositor's, not a noisy render"
    if not layers:
        return "it has no Combined pass: it is no OpenEXR MultiLayer file of Blender"
    # Layers of the compositor and of copied files are black and lack these attributes.
    rendered = {found[1] for name in attributes if (found := re.fullmatch(r"cycles\.(.+)\.samples", name))}
    for layer in sorted(layers):
        if cycles and layer not in rendered:
            return f"Cycles has not rendered its view layer {layer}"
        for needed in ("Denoising Albedo", "Denoising Normal") if cycles else ():
            if not any(name.startswith(f"{layer}.{needed}.") for name in channels):
                return f"its view layer {layer} has no pass {needed}: Set Up Passes, then render again"
    return ""


def is_denoised_too(path: Path) -> bool:
    """Whether a frame holds the picture that Blender has denoised, beside its noisy one."""
    try:
        return any(".Noisy Image." in name for name in read_header(path)[1])
    except (OSError, ValueError):
        return False


def read_header(path: Path) -> tuple[set[str], set[str]]:
    """Return the names of attributes and channels of an OpenEXR file; OSError or ValueError if it cannot be read."""
    attributes: set[str] = set()
    channels: set[str] = set()
    with path.open("rb") as file:
        magic, version = struct.unpack("<II", _read(file, 8))
        if magic != MAGIC:
            raise ValueError("wrong first bytes")
        while name := _read_name(file):
            while name:
                kind, size = _read_name(file), struct.unpack("<I", _read(file, 4))[0]
                if size > _LARGEST:
                    raise ValueError(f"attribute {name} of {size} bytes")
                value = _read(file, size)
                attributes.add(name)
                if kind == "chlist":
                    channels |= _channels(value)
                name = _read_name(file)
            if not version & _PARTS:  # only a header of several parts ends with an empty one
                break
    return attributes, channels


def _channels(value: bytes) -> set[str]:
    """The names in a channel list: each ends with a zero byte and is followed by 16 bytes."""
    names = set()
    while (end := value.find(b"\0")) > 0:
        names.add(value[:end].decode("utf-8", "replace"))
        value = value[end + 17 :]
    return names


def _read(file: BinaryIO, size: int) -> bytes:
    data = file.read(size)
    if len(data) < size:
        raise ValueError("it ends within its header")
    return data


def _read_name(file: BinaryIO) -> str:
    name = b""
    while (byte := _read(file, 1)) != b"\0":
        name += byte
        if len(name) > _LONGEST:
            raise ValueError(f"a name of more than {_LONGEST} bytes")
    return name.decode("utf-8", "replace")
