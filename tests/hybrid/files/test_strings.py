"""Strings in headers: Latin-1, Shift-JIS, anything."""

import os
from pathlib import Path

import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st

from hybrid.files.exr import read_exr, write_exr
from hybrid.files.strings import find_strings
from tests.hybrid.files.test_exr import planes, save, save_parts

STRINGS = {
    "latin-1": "Ærø Müller".encode("latin-1"),
    "shift-jis": "レンダー太郎".encode("shift_jis"),
    "both": "Ærø, ".encode() + "Ærø".encode("latin-1"),
    "none": b"\xff\xfe\x80abc\x00\x81",
    "surrogates": b"\xed\xb3\xbf\xe9",
}


def exchange(path: Path, strings: dict[bytes, bytes]) -> Path:
    data = path.read_bytes()
    for old, new in strings.items():
        assert data.count(old) == 1
        assert len(old) == len(new)
        data = data.replace(old, new)
    path.write_bytes(data)
    return path


def decode(data):
    """Not `os.fsdecode`, which refuses such bytes on Windows."""
    return data.decode("utf-8", "surrogateescape")


@pytest.mark.parametrize("value", STRINGS.values(), ids=STRINGS)
def test_strings_of_any_encoding_are_kept_to_the_byte(tmp_path, value):
    """A file of a studio that writes Latin-1 was "damaged"."""
    channels, plain = planes(["R", "G", "B"]), "A" * len(value)
    source = exchange(save(tmp_path / "a.exr", channels, owner=plain, comments="Zoë"), {plain.encode(): value})
    image = read_exr(source)
    assert image.parts[0].header["owner"].encode("utf-8", "surrogateescape") == value
    assert image.parts[0].header["comments"] == "Zoë"
    assert read_exr(source, pixels=False).parts[0].header["owner"] == image.parts[0].header["owner"]
    write_exr(tmp_path / "b.exr", image, {"G": channels["B"]}, attributes={"note": decode(b"caf\xe9")})
    again = read_exr(tmp_path / "b.exr")
    assert again.parts[0].header["owner"] == image.parts[0].header["owner"]
    assert again.parts[0].header["note"] == decode(b"caf\xe9")
    np.testing.assert_array_equal(again.channel("G"), channels["B"])
    data = (tmp_path / "b.exr").read_bytes()
    assert b"owner\0string\0" + len(value).to_bytes(4, "little") + value in data


def test_names_of_parts_in_any_encoding_are_kept_too(tmp_path):
    parts = {"first": planes(["R", "G", "B"]), "AAAA": planes(["X", "Y", "Z"])}
    source = save_parts(tmp_path / "a.exr", parts, {"AAAA": {"owner": "BBBB"}})
    exchange(source, {b"AAAA": b"caf\xe9", b"BBBB": b"\x83\x8c\x83\x93"})
    image = read_exr(source)
    assert image.parts[1].name == decode(b"caf\xe9")
    assert decode(b"caf\xe9.X") in image.channel_names
    write_exr(tmp_path / "b.exr", image, {"first.R": image.channel("first.G")})
    again = read_exr(tmp_path / "b.exr")
    assert again.channel_names == image.channel_names
    assert again.parts[1].header["owner"] == decode(b"\x83\x8c\x83\x93")


@given(st.binary(max_size=400))
@settings(max_examples=200, deadline=None)
def test_strings_are_looked_for_in_anything(data):
    assert all(where.stop <= len(data) + 8 for _, _, where in find_strings(b"v/1\x01\x02\x10\0\0" + data))


@pytest.mark.skipif(os.name != "posix", reason="names are bytes on POSIX alone")
def test_folders_of_any_encoding_are_read_and_written(tmp_path):
    """OpenEXR 3.5 takes no string with bytes that are not UTF-8: all files in such a folder were "damaged"."""
    save(tmp_path / "a.exr", planes(["R", "G", "B"]))
    folder = Path(os.fsdecode(os.fsencode(tmp_path) + b"/caf\xe9"))
    folder.mkdir()
    (tmp_path / "a.exr").rename(folder / "a.exr")
    source = read_exr(folder / "a.exr")
    write_exr(folder / "b.exr", source, {"R": source.channel("R") + 1})
    np.testing.assert_array_equal(read_exr(folder / "b.exr").channel("R"), source.channel("R") + 1)
