"""Which rendered frames are noisy renders, read from their headers; needs no Blender."""

from pathlib import Path

import numpy as np
import OpenEXR
import pytest

from tests.blender.wheels import load_module

frames = load_module("frames")

PASSES = {"Combined": "RGBA", "Denoising Albedo": "RGB", "Denoising Normal": "XYZ"}


def write(path: Path, layers: dict[str, dict[str, str]], attributes: dict[str, str], *, parts: bool) -> Path:
    """Write a file as Blender does: layers of passes, in one part or in a part for each pass."""
    header = {"compression": OpenEXR.ZIP_COMPRESSION, "type": OpenEXR.scanlineimage, **attributes}
    pixels = np.ones((3, 4), np.float32)
    found = {f"{x}.{name}": letters for x, passes in layers.items() for name, letters in passes.items()}
    channels = [{f"{name}.{c}": OpenEXR.Channel(pixels) for c in letters} for name, letters in found.items()]
    if parts:
        named = zip(found, channels, strict=True)
        OpenEXR.File([OpenEXR.Part({**header}, has, name) for name, has in named]).write(str(path))
    else:
        OpenEXR.File(header, {name: c for part in channels for name, c in part.items()}).write(str(path))
    return path


@pytest.mark.parametrize("parts", [False, True])
@pytest.mark.parametrize(
    ("layers", "attributes", "reason"),
    [
        ({"View.Layer": PASSES}, {"cycles.View.Layer.samples": "4"}, ""),
        ({"A": PASSES, "B": PASSES}, {"cycles.A.samples": "4", "cycles.B.samples": "4"}, ""),
        (
            {"A": PASSES, "B": {"Combined": "RGBA"}},
            {"cycles.A.samples": "4", "cycles.B.samples": "4"},
            "layer B has no",
        ),
        ({"A": {"Combined": "RGBA"}}, {"cycles.A.samples": "4"}, "has no pass Denoising Albedo"),
        ({"Composite": {"Combined": "RGBA"}, "A": PASSES}, {"cycles.A.samples": "4"}, "compositor"),
        ({"A": PASSES}, {}, "Cycles has not rendered its view layer A"),
        ({"A": PASSES}, {"cycles.A.samples": "4", "ravg/preset": "fast"}, "denoised already"),
        ({"A": {"Depth": "Z"}}, {}, "no Combined"),
    ],
)
def test_a_frame_is_noisy_or_the_reason_says_why_not(tmp_path, layers, attributes, reason, parts):
    found = frames.refusal(write(tmp_path / "a.exr", layers, attributes, parts=parts), cycles=True)
    assert reason in found
    assert bool(found) == bool(reason)


def test_other_engines_have_neither_passes_nor_attributes_of_cycles(tmp_path):
    path = write(tmp_path / "a.exr", {"A": {"Combined": "RGBA"}}, {}, parts=True)
    assert frames.refusal(path, cycles=False) == ""


@pytest.mark.parametrize("size", [0, 3, 8, 40, 200])
def test_a_file_that_ends_within_its_header_is_refused(tmp_path, size):
    path = write(tmp_path / "a.exr", {"A": PASSES}, {"cycles.A.samples": "4"}, parts=True)
    path.write_bytes(path.read_bytes()[:size])
    assert "cannot be read as OpenEXR" in frames.refusal(path, cycles=True)


def test_a_name_without_an_end_is_refused(tmp_path):
    path = tmp_path / "a.exr"
    path.write_bytes(frames.struct.pack("<II", frames.MAGIC, 2) + b"x" * 1000)
    assert "a name of more than 255 bytes" in frames.refusal(path, cycles=True)


def test_a_file_of_another_kind_is_refused(tmp_path):
    path = tmp_path / "a.exr"
    path.write_bytes(b"\x89PNG\r\n\x1a\n" * 20)
    assert "wrong first bytes" in frames.refusal(path, cycles=True)


@pytest.mark.parametrize(
    ("numbers", "text"),
    [
        ([], ""),
        ([7], "7"),
        ([4, 5, 6], "4-6"),
        ([4, 6], "4,6"),
        ([1, 3, 5, 7], "1-7x2"),
        ([12, 1, 2, 3, 9], "1-3,9,12"),
        (range(1, 20001), "1-20000"),
    ],
)
def test_frames_are_named_in_ranges(numbers, text):
    assert frames.ranges(numbers) == text
