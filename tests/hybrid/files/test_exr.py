import os
from fractions import Fraction
from pathlib import Path

import numpy as np
import OpenEXR
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st
from hypothesis.extra.numpy import arrays

from flow import motion
from hybrid.files.exr import ExrError, read_exr, write_exr
from hybrid.files.layers import find_layers
from hybrid.files.sources import identify
from tests.exr_files import write_layers
from tests.hybrid.files.test_replace import make

CYCLES = {
    "Combined": "RGBA",
    "Denoising Albedo": "RGB",
    "Denoising Depth": "Z",
    "Denoising Normal": "XYZ",
    "Depth": "Z",
    "Normal": "XYZ",
    "Vector": "XYZW",
}


def planes(names: list[str], size=(5, 7), kind="f2", seed=0) -> dict[str, np.ndarray]:
    rng = np.random.default_rng(seed)
    return {name: (100 * rng.random(size)).astype(kind) for name in names}


def save(path: Path, channels: dict, **header) -> Path:
    header = {"compression": OpenEXR.ZIP_COMPRESSION, "type": OpenEXR.scanlineimage, **header}
    OpenEXR.File([OpenEXR.Part(header, dict(channels), "")]).write(str(path))  # it changes the dict
    return path


def save_parts(path: Path, parts: dict[str, dict], headers: dict[str, dict] | None = None) -> Path:
    made = []
    for name, channels in parts.items():
        header = {"compression": OpenEXR.ZIPS_COMPRESSION, "type": OpenEXR.scanlineimage}
        made.append(OpenEXR.Part({**header, **(headers or {}).get(name, {})}, channels, name))
    OpenEXR.File(made).write(str(path))
    return path


def cycles_names(layers=CYCLES, prefix="ViewLayer.") -> list[str]:
    return [f"{prefix}{layer}.{c}" for layer, components in layers.items() for c in components]


@pytest.mark.posix
@pytest.mark.parametrize("kind", ["pipe", "socket", "device", "folder"])
@pytest.mark.parametrize("look", [read_exr, identify])
def test_what_is_no_file_is_not_waited_for(tmp_path, kind, look, monkeypatch):
    """A pipe among the frames was read until somebody wrote to it: for ever."""
    monkeypatch.chdir(tmp_path)  # names of sockets are short
    make(kind, Path("a.exr"))
    with pytest.raises(OSError, match=f"a.exr is a {kind}, expected a file"):
        look(Path("a.exr"))


# --- reading


def test_channels_keep_their_type_and_every_bit(tmp_path):
    channels = {
        "R": np.array([[1.5, np.nan, np.inf]], np.float16),
        "G": np.array([[-np.inf, -0.0, 1e-7]], np.float16),
        "B": np.array([[1e30, np.nan, 1e-42]], np.float32),
        "id": np.array([[0, 2**31, 2**32 - 1]], np.uint32),
    }
    image = read_exr(save(tmp_path / "a.exr", channels))
    for name, values in channels.items():
        assert image.channel(name).dtype == values.dtype
        assert image.channel(name).tobytes() == values.tobytes()


def test_pixels_stacks_channels_as_float32_in_the_order_asked_for(tmp_path):
    channels = planes(["R", "G", "B"])
    pixels = read_exr(save(tmp_path / "a.exr", channels)).pixels(("B", "R"))
    assert pixels.dtype == np.float32
    assert pixels.flags.c_contiguous
    np.testing.assert_array_equal(pixels, np.stack([channels["B"], channels["R"]], -1).astype(np.float32))


def test_headers_alone_are_enough_to_find_layers_and_give_no_pixels(tmp_path):
    image = read_exr(save(tmp_path / "a.exr", planes(cycles_names())), pixels=False)
    assert find_layers(image).motion_convention == motion.CYCLES
    with pytest.raises(ValueError, match="not read"):
        image.channel("ViewLayer.Combined.R")


@pytest.mark.parametrize("fraction", [0.0, 0.01, 0.3, 0.6, 0.9, 0.999])
def test_truncated_file_is_an_error_of_one_line_and_nothing_is_printed(tmp_path, capfd, fraction):
    for path in (
        save(tmp_path / "single.exr", planes(["R", "G", "B"], (40, 30))),
        save_parts(tmp_path / "multi.exr", {"a": planes(["R"], (40, 30)), "b": planes(["R"], (40, 30))}),
    ):
        data = path.read_bytes()
        path.write_bytes(data[: int(fraction * len(data))])
        with pytest.raises(ExrError) as caught:
            read_exr(path)
        assert str(caught.value).startswith(f"{path}: ")
        assert "\n" not in str(caught.value)
        assert capfd.readouterr() == ("", "")


def test_others_may_print_while_the_library_is_listened_to(tmp_path, capfd, monkeypatch):
    path = save(tmp_path / "a.exr", planes(["R"]))
    opened = OpenEXR.File

    def chatty(*args, **kwargs):
        os.write(2, b"progress\n")
        return opened(*args, **kwargs)

    monkeypatch.setattr(OpenEXR, "File", chatty)
    read_exr(path, pixels=False)
    assert capfd.readouterr().err == "progress\n"


def test_one_damaged_part_of_several_is_an_error(tmp_path):
    gradient = np.repeat(np.arange(64, dtype=np.float16)[None], 9, 0)  # is stored compressed, with a checksum
    path = save_parts(tmp_path / "a.exr", {"a": {"R": gradient}, "b": {"R": gradient}})
    data = bytearray(path.read_bytes())
    data[-1] ^= 255  # in the last chunk of the last part
    path.write_bytes(data)
    assert len(read_exr(path, pixels=False).parts) == 2
    with pytest.raises(ExrError, match="damaged"):
        read_exr(path)


def test_what_is_not_a_rendered_frame_is_refused(tmp_path):
    text = tmp_path / "text.exr"
    text.write_text("not an image")
    with pytest.raises(ExrError, match="not an OpenEXR file"):
        read_exr(text)

    deep = np.empty((2, 2), object)
    for index in np.ndindex(2, 2):
        deep[index] = np.array([1.0], np.float32)
    header = {"compression": OpenEXR.ZIPS_COMPRESSION, "type": OpenEXR.deepscanline}
    OpenEXR.File(header, {"Z": deep}).write(str(tmp_path / "deep.exr"))
    with pytest.raises(ExrError, match="deep image, expected a flat one, or one with a flat part"):
        read_exr(tmp_path / "deep.exr")

    tiles = OpenEXR.TileDescription()
    tiles.xSize = tiles.ySize = 4
    tiles.mode = OpenEXR.MIPMAP_LEVELS
    save(tmp_path / "mip.exr", planes(["R"], (8, 8)), type=OpenEXR.tiledimage, tiles=tiles)
    with pytest.raises(ExrError, match="mip-mapped"):
        read_exr(tmp_path / "mip.exr")

    chroma = OpenEXR.Channel("BY", np.zeros((4, 4), np.float16), 2, 2)
    save(tmp_path / "chroma.exr", {"Y": np.zeros((4, 4), np.float16), "BY": chroma})
    with pytest.raises(ExrError, match="subsampled"):
        read_exr(tmp_path / "chroma.exr")


def test_size_is_checked_before_pixels_are_read(tmp_path):
    path = save(tmp_path / "a.exr", planes(["R", "G"], (10, 10)))
    data = path.read_bytes()
    path.write_bytes(data[: len(data) // 2])  # reading the pixels would fail first, otherwise
    with pytest.raises(ExrError, match="10x10 pixels, more than the 99"):
        read_exr(path, max_pixels=99)
    many = save(tmp_path / "b.exr", planes([f"l{i}.R" for i in range(17)], (10, 10)))
    with pytest.raises(ExrError, match="GiB"):  # 17 channels of 4 bytes against 64 bytes per pixel
        read_exr(many, max_pixels=100)
    read_exr(many, max_pixels=107)


def test_missing_file_is_an_oserror(tmp_path):
    with pytest.raises(FileNotFoundError, match=r"none\.exr"):
        read_exr(tmp_path / "none.exr")


# --- writing

ATTRIBUTES = {
    "dataWindow": (np.array([-2, 3], np.int32), np.array([4, 7], np.int32)),
    "displayWindow": (np.array([0, 0], np.int32), np.array([9, 9], np.int32)),
    "pixelAspectRatio": 2.0,
    "screenWindowCenter": np.array([0.25, -0.5], np.float32),
    "lineOrder": OpenEXR.DECREASING_Y,
    "chromaticities": (0.64, 0.33, 0.30, 0.60, 0.15, 0.06, 0.3127, 0.329),
    "timeCode": OpenEXR.TimeCode(),
    "a string": "ünï / cryptomatte {}",
    "strings": ["a", "b"],
    "floats": [1.5, 2.5],
    "float": 0.1,
    "double": np.array([0.1]),
    "int": -3,
    "rational": Fraction(24000, 1001),
    "v2i": np.array([1, -2], np.int32),
    "v3f": np.array([1, -2, 0.1], np.float32),
    "m44f": np.arange(16, dtype=np.float32).reshape(4, 4),
    "bytes": OpenEXR.Bytes(b"\x00\x01\xff", "hint"),
}


@pytest.mark.parametrize("compression", ["NO", "RLE", "ZIPS", "ZIP", "PIZ", "PXR24"])
@pytest.mark.parametrize("tiled", [False, True])
def test_rewriting_without_changes_gives_the_same_bytes(tmp_path, compression, tiled):
    header = {**ATTRIBUTES, "compression": getattr(OpenEXR, f"{compression}_COMPRESSION")}
    if tiled:
        tiles = OpenEXR.TileDescription()
        tiles.xSize, tiles.ySize = 4, 3
        header |= {"type": OpenEXR.tiledimage, "tiles": tiles, "lineOrder": OpenEXR.INCREASING_Y}
    channels = {**planes(["R", "G", "B"]), **planes(["Z"], kind="f4"), **planes(["id"], kind="u4")}
    path = save(tmp_path / "a.exr", channels, **header)
    assert write_exr(tmp_path / "b.exr", read_exr(path), {}) == 0
    assert (tmp_path / "b.exr").read_bytes() == path.read_bytes()


def test_rewriting_a_multi_part_file_gives_the_same_bytes(tmp_path):
    window = {"dataWindow": (np.array([1, 1], np.int32), np.array([3, 2], np.int32))}
    window["displayWindow"] = (np.array([0, 0], np.int32), np.array([6, 4], np.int32))
    display = {"displayWindow": window["displayWindow"]}
    path = save_parts(
        tmp_path / "a.exr",
        {"rgba_left": planes(["R", "G", "B"]), "crop": planes(["id"], (2, 3), "u4"), "z": planes(["Z"])},
        {"rgba_left": {"view": "left", **display}, "crop": window, "z": {**display, "owner": "me"}},
    )
    write_exr(tmp_path / "b.exr", read_exr(path), {})
    assert (tmp_path / "b.exr").read_bytes() == path.read_bytes()


@pytest.mark.parametrize("kind", [OpenEXR.deepscanline, OpenEXR.deeptile])
@pytest.mark.parametrize("first", [True, False])
def test_a_deep_part_beside_a_flat_one_is_kept(tmp_path, kind, first):
    """The file was refused, without the name of the part."""
    tiles = OpenEXR.TileDescription()
    tiles.xSize = tiles.ySize = 4
    rng = np.random.default_rng(1)
    counts = rng.integers(0, 3, (5, 7))
    deep = {name: np.empty((5, 7), object) for name in "ZA"}
    for name, half in (("Z", False), ("A", True)):
        for index, count in np.ndenumerate(counts):
            deep[name][index] = rng.random(count).astype("f2" if half else "f4") if count else None
    parts = {"deep": dict(deep), "rgba": planes([*"RGBA"])}
    headers = {"deep": {"type": kind, **({"tiles": tiles} if kind == OpenEXR.deeptile else {})}}
    names = ["deep", "rgba"] if first else ["rgba", "deep"]
    source = read_exr(save_parts(tmp_path / "a.exr", {name: parts[name] for name in names}, headers))
    assert source.channel_names == ("rgba.A", "rgba.B", "rgba.G", "rgba.R")
    write_exr(tmp_path / "b.exr", source, {"rgba.R": np.ones((5, 7))}, {"new": np.zeros((5, 7), "f4")})
    written = read_exr(tmp_path / "b.exr")
    assert (written.channel("rgba.R") == 1).all()
    assert "new.Y" in written.channel_names
    kept = written.parts[names.index("deep")]
    assert kept.header["type"] == kind
    for name in "ZA":
        for index, count in np.ndenumerate(counts):
            found = kept.channels[name].pixels[index]
            np.testing.assert_array_equal(found if count else [], deep[name][index] if count else [])


@pytest.mark.parametrize("compression", ["DWAA", "DWAB", "B44", "B44A", "PXR24", "ZIP"])
@pytest.mark.parametrize("kind", ["f2", "f4"])
def test_channels_that_are_kept_are_kept_to_the_bit_whatever_the_compression(tmp_path, compression, kind):
    """DWA changed vectors by a tenth of a pixel whenever a file was written."""
    names = [*"RGBA", "Matte.R", "Matte.G", "Matte.B", "Vector.X", "Vector.Y", "Z"]
    header = {"compression": getattr(OpenEXR, f"{compression}_COMPRESSION")}
    source = read_exr(save(tmp_path / "a.exr", planes(names, (40, 56), kind), **header))
    write_exr(tmp_path / "b.exr", source, {name: np.ones((40, 56)) for name in "RGB"})
    written = read_exr(tmp_path / "b.exr")
    for name in names[3:]:
        np.testing.assert_array_equal(written.channel(name), source.channel(name))
    assert written.parts[0].header["compression"].name.startswith("PXR24" if compression == "PXR24" else "ZIP")


def test_a_part_of_which_all_is_replaced_keeps_its_compression(tmp_path):
    header = {"compression": OpenEXR.DWAA_COMPRESSION}
    parts = {"rgba": planes([*"RGBA"], (40, 56)), "matte": planes([*"RGB"], (40, 56))}
    source = read_exr(save_parts(tmp_path / "a.exr", parts, dict.fromkeys(parts, header)))
    write_exr(tmp_path / "b.exr", source, {f"rgba.{name}": np.ones((40, 56)) for name in "RGB"})
    written = read_exr(tmp_path / "b.exr")
    assert [part.header["compression"].name for part in written.parts] == ["DWAA_COMPRESSION", "ZIP_COMPRESSION"]
    for name in ("rgba.A", "matte.R", "matte.G", "matte.B"):
        np.testing.assert_array_equal(written.channel(name), source.channel(name))


def test_only_the_replaced_channels_change(tmp_path):
    parts = {"ViewLayer.Combined": planes(["R", "G", "B", "A"]), "ViewLayer.Depth": planes(["Z"], kind="f4")}
    source = read_exr(save_parts(tmp_path / "a.exr", parts))
    new = np.random.default_rng(1).random((5, 7)).astype(np.float32)
    write_exr(tmp_path / "b.exr", source, {"ViewLayer.Combined.G": new})
    again = read_exr(tmp_path / "b.exr")
    for name in source.channel_names:
        expected = new.astype(np.float16) if name == "ViewLayer.Combined.G" else source.channel(name)
        assert again.channel(name).dtype == expected.dtype
        np.testing.assert_array_equal(again.channel(name), expected)


@settings(max_examples=30, deadline=None)
@given(values=arrays(np.float32, (3, 5), elements=st.floats(width=32)), kind=st.sampled_from([np.float16, np.float32]))
def test_written_values_are_the_nearest_and_no_inf_is_made(tmp_path_factory, values, kind):
    folder = tmp_path_factory.mktemp("exr")
    source = read_exr(save(folder / "a.exr", {"R": np.zeros((3, 5), kind)}))
    clamped = write_exr(folder / "b.exr", source, {"R": values})
    out = read_exr(folder / "b.exr").channel("R")
    np.testing.assert_array_equal(np.isnan(out), np.isnan(values))
    np.testing.assert_array_equal(np.isinf(out), np.isinf(values))
    limited = values if kind == np.float32 else np.where(np.isinf(values), values, values.clip(-65504, 65504))
    np.testing.assert_array_equal(out, limited.astype(kind))
    beyond = (np.abs(values) > 65504) & np.isfinite(values)
    assert clamped == (beyond.sum() if kind == np.float16 else 0)


def test_uint_channels_are_rounded_and_limited(tmp_path):
    source = read_exr(save(tmp_path / "a.exr", {"id": np.zeros((1, 5), np.uint32)}))
    values = np.array([[-3, 1.6, np.nan, 1e12, 7]], np.float32)
    write_exr(tmp_path / "b.exr", source, {"id": values})
    expected = [[0, 2, 0, 2**32 - 1, 7]]
    np.testing.assert_array_equal(read_exr(tmp_path / "b.exr").channel("id"), expected)


def test_layers_and_attributes_can_be_added(tmp_path):
    single = save(tmp_path / "a.exr", planes(["R", "G", "B"]), comment="before", frame=3)
    multi = save_parts(tmp_path / "b.exr", {"x": planes(["R"]), "y": planes(["R"])})
    extra = {"confidence": np.full((5, 7), 0.5, np.float32), "part.specular": np.ones((5, 7, 3), np.float16)}
    for path in (single, multi):
        source = read_exr(path)
        write_exr(tmp_path / "out.exr", source, {}, extra, {"comment": "after"})
        again = read_exr(tmp_path / "out.exr")
        assert set(source.channel_names) < set(again.channel_names)
        assert (again.pixels(again.layer("confidence").channels) == 0.5).all()
        assert again.layer("part.specular").channels == tuple(f"part.specular.{c}" for c in "RGB")
        assert again.channel("part.specular.R").dtype == np.float16
        assert again.parts[0].header["comment"] == "after"
    with pytest.raises(ValueError, match=r"'frame'.*not a string"):
        write_exr(tmp_path / "out.exr", read_exr(single), {}, None, {"frame": "4"})


def test_source_may_be_written_over(tmp_path):
    path = save(tmp_path / "a.exr", planes(["R", "G"]))
    green = read_exr(path).channel("G").copy()
    write_exr(path, read_exr(path), {"R": np.zeros((5, 7), np.float32)})
    again = read_exr(path)
    np.testing.assert_array_equal(again.channel("G"), green)
    assert not again.channel("R").any()


def test_wrong_channel_leaves_no_file(tmp_path):
    source = read_exr(save(tmp_path / "a.exr", planes(["R"])))
    with pytest.raises(ExrError, match="no channel 'G'; it has R"):
        write_exr(tmp_path / "b.exr", source, {"G": np.zeros((5, 7), np.float32)})
    assert [path.name for path in tmp_path.iterdir()] == ["a.exr"]


@pytest.mark.parametrize("error", [KeyboardInterrupt, OSError("disk full")])
def test_interrupted_write_leaves_the_old_file_and_nothing_else(tmp_path, monkeypatch, error):
    path = save(tmp_path / "a.exr", planes(["R"]))
    source, before = read_exr(path), path.read_bytes()

    def fail(*_):
        raise error

    monkeypatch.setattr(os, "fsync", fail)
    with pytest.raises(type(error) if isinstance(error, Exception) else error):
        write_exr(path, source, {"R": np.zeros((5, 7), np.float32)})
    assert path.read_bytes() == before
    assert [p.name for p in tmp_path.iterdir()] == ["a.exr"]


@pytest.mark.posix
def test_folder_that_cannot_be_written_is_an_oserror_naming_the_file(tmp_path):
    source = read_exr(save(tmp_path / "a.exr", planes(["R"])))
    with pytest.raises(FileNotFoundError, match=r"cannot write: No such file.*none.out\.exr'$"):
        write_exr(tmp_path / "none" / "out.exr", source, {})
    if os.geteuid() == 0:
        pytest.skip("root may write anywhere")
    locked = tmp_path / "locked"
    locked.mkdir(mode=0o555)
    with pytest.raises(PermissionError, match=r"cannot write: Permission denied.*out\.exr'$"):
        write_exr(locked / "out.exr", source, {})


def test_new_file_has_its_layers_found_again(tmp_path):
    rng = np.random.default_rng(0)
    shapes = {"color": 3, "albedo": 3, "normal": 3, "motion": 2, "variance": 3}
    layers = {name: rng.random((5, 3, count)).astype(np.float32) for name, count in shapes.items()}
    layers["depth"] = 1e6 * rng.random((5, 3)).astype(np.float32)
    layers["color"][0, 0] = 1e6, np.nan, np.inf
    path = tmp_path / "a.exr"
    assert write_layers(path, layers, attributes={"title": "test"}) == 1  # the 1e6
    image = read_exr(path)
    assert image.parts[0].header["title"] == "test"
    found = find_layers(image)
    for name in ("normal", "motion", "depth"):  # stay float32
        taken = image.pixels(getattr(found, name).channels)
        np.testing.assert_array_equal(taken, layers[name].reshape(taken.shape))
    np.testing.assert_array_equal(image.pixels(found.albedo.channels), layers["albedo"].astype(np.float16))
    np.testing.assert_array_equal(image.pixels(found.color.channels)[0, 0], [65504, np.nan, np.inf])
    assert write_layers(path, {"": layers["color"]}, half=False) == 0
    assert read_exr(path).channel("R")[0, 0] == 1e6
    with pytest.raises(ValueError, match="one size"):
        write_layers(path, {"a": np.zeros((2, 2), np.float32), "b": np.zeros((2, 3), np.float32)})
