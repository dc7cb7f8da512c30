"""Files that are damaged at random: each ends in one line, or is still a valid file and is read.

25 files belong to the quick tests; `pytest -m reliability` tries 1,975 others.
"""

import re
import struct
from collections import Counter
from pathlib import Path

import numpy as np
import OpenEXR
import pytest

from hybrid.files.exr import read_exr
from hybrid.run.records import FOLDER
from tests.commands import ravg
from tests.seldom import seldom

pytestmark = pytest.mark.posix
CASES = 25
MOST = 5.0, 2**30  # CPU seconds, and bytes of memory
COMPRESSIONS = ("NO", "RLE", "ZIPS", "ZIP", "PIZ", "PXR24", "B44", "B44A", "DWAA", "DWAB")


@pytest.fixture(scope="module")
def good_files(tmp_path_factory: pytest.TempPathFactory) -> list[bytes]:
    """Small files that are read, or refused for what they are, before anything is done to them."""
    rng = np.random.default_rng(0)
    path = tmp_path_factory.mktemp("good") / "good.exr"
    made = []

    def keep(parts: list[OpenEXR.Part]) -> None:
        OpenEXR.File(parts).write(str(path))
        made.append(path.read_bytes())

    def channels(size: tuple[int, int] = (20, 28)) -> dict[str, np.ndarray]:
        layers = {"Combined": "RGBA", "Denoising Albedo": "RGB", "Denoising Normal": "XYZ"}
        names = [f"ViewLayer.{layer}.{c}" for layer, components in layers.items() for c in components]
        planes = {name: rng.random(size).astype(np.float16) for name in names}
        planes |= {f"ViewLayer.Vector.{c}": rng.normal(size=size).astype(np.float32) for c in "XYZW"}
        planes["ViewLayer.Depth.Z"] = rng.random(size).astype(np.float32)
        return planes | {"id": np.arange(size[0] * size[1], dtype=np.uint32).reshape(size)}

    def header(compression: str = "ZIP", **more: object) -> dict[str, object]:
        kind = getattr(OpenEXR, f"{compression}_COMPRESSION")
        return {"compression": kind, "type": OpenEXR.scanlineimage, "owner": "nobody", "frame": 7, **more}

    for compression in COMPRESSIONS:
        keep([OpenEXR.Part(header(compression), channels(), "")])
    tiles = OpenEXR.TileDescription()
    tiles.xSize, tiles.ySize = 8, 8
    keep([OpenEXR.Part(header(type=OpenEXR.tiledimage, tiles=tiles), channels(), "")])
    layers = "Combined", "Denoising Albedo", "Denoising Normal", "Vector"
    keep([OpenEXR.Part(header(), {n: p for n, p in channels().items() if x in n}, f"ViewLayer.{x}") for x in layers])
    deep = np.empty((6, 6), object)
    for index in np.ndindex(6, 6):
        deep[index] = rng.random(1 + sum(index) % 3).astype(np.float32)
    keep([OpenEXR.Part({"compression": OpenEXR.ZIPS_COMPRESSION, "type": OpenEXR.deepscanline}, {"Z": deep}, "")])
    half = {c: OpenEXR.Channel(c, rng.random((20, 28)).astype(np.float16), 2, 2) for c in ("BY", "RY")}
    keep([OpenEXR.Part(header(), {"Y": rng.random((20, 28)).astype(np.float16), **half}, "")])
    return made


def header_size(data: bytes) -> int:
    """Bytes before the table of chunks, roughly: a header ends with an empty attribute name."""
    return min(len(data), 8 + max(data.rfind(b"screenWindowWidth"), 64) + 40)


def cut_short(data: bytes, rng: np.random.Generator) -> bytes:
    """Only the beginning, and rarely less than the header."""
    first = 0 if rng.random() < 0.2 else header_size(data)
    return data[: int(rng.integers(first, len(data)))]


def flip_bits(data: bytes, rng: np.random.Generator) -> bytes:
    """1 to 16 bits, anywhere."""
    out = bytearray(data)
    for position in rng.integers(0, len(out), 2 ** int(rng.integers(0, 5))):
        out[position] ^= 1 << int(rng.integers(8))
    return bytes(out)


def change_header(data: bytes, rng: np.random.Generator) -> bytes:
    """One to four bytes or 32-bit numbers of the header, by values that have broken readers before."""
    out = bytearray(data)
    numbers = (0, 1, 2, 255, 16384, 65535, 65536, 2**24, 2**30, 2**31 - 1, -1, -2, -(2**31))
    for _ in range(int(rng.integers(1, 5))):
        at = int(rng.integers(4, header_size(data) - 4))
        if rng.random() < 0.5:
            out[at] = int(rng.integers(256))
        else:
            out[at : at + 4] = struct.pack("<i", numbers[int(rng.integers(len(numbers)))])
    return bytes(out)


def change_size(data: bytes, rng: np.random.Generator) -> bytes:
    """The data window or the display window: huge, negative, inverted, moved far away."""
    out = bytearray(data)
    places = [match.end() for match in re.finditer(rb"(?:data|display)Window\0box2i\0\x10\0\0\0", data)]
    at = places[int(rng.integers(len(places)))] + 4 * int(rng.integers(4))
    size = int(2 ** rng.uniform(0, 31)) * int(rng.choice([-1, 1]))
    out[at : at + 4] = struct.pack("<i", max(min(size, 2**31 - 1), -(2**31)))
    return bytes(out)


def move_pieces(data: bytes, rng: np.random.Generator) -> bytes:
    """Take out, double or exchange pieces of up to 64 bytes."""
    a, b = sorted(int(n) for n in rng.integers(0, len(data) - 64, 2))
    length = int(rng.integers(1, 65))
    kind = int(rng.integers(3))
    if kind == 0:
        return data[:a] + data[a + length :]
    if kind == 1:
        return data[:b] + data[a : a + length] + data[b:]
    b = max(b, a + length)
    return data[:a] + data[b : b + length] + data[a + length : b] + data[a : a + length] + data[b + length :]


DAMAGES = cut_short, flip_bits, change_header, change_size, move_pieces


def run_case(source: Path, output: Path) -> bool:
    """Run the command on one file; whether it was refused."""
    words = ["denoise", source, "-o", output / "done.exr", "--preset", "draft"]
    done = ravg(*words, seconds=60, memory=64 * 2**30, most=MOST).ends("either")
    if done.code == 0:
        read_exr(output / "done.exr")
        return False
    assert done.code == 1
    lines = done.said.rstrip().splitlines()
    assert [line for line in lines if line.startswith("error: ")] == lines[-1:]
    assert {path.name for path in output.glob("*")} <= {FOLDER}
    return True


@pytest.mark.parametrize("batch", [0, *seldom(*range(1, 80))])
def test_damaged_files_end_in_one_line(tmp_path, good_files, record_property, batch):
    """Within 5 CPU seconds and 1 GiB, without output and without a crash of the interpreter."""
    refused = Counter[str]()
    for number in range(CASES):
        rng = np.random.default_rng((7 + batch, number))
        damage = DAMAGES[number % len(DAMAGES)]
        good = good_files[int(rng.integers(len(good_files)))]
        path = tmp_path / f"{number}.exr"
        path.write_bytes(damage(good, rng))
        refused[damage.__name__] += run_case(path, tmp_path / f"{number}")
    assert refused.total() > CASES / 2
    record_property("cases", CASES)
