import json
import os
from pathlib import Path

import numpy as np
import pytest

from hybrid.files import sources
from hybrid.files.sources import HASHED, MADE_FROM, Source, describe_sources, identify, sources_in, why_stale
from tests.exr_files import write_layers

SOURCE = Source("a.exr", 3, 100.0, "00")


def picture(path: Path, files: dict[str, Source], *, attributes: dict[str, str] | None = None, **facts: object) -> Path:
    header = {MADE_FROM: describe_sources(files, **facts), **(attributes or {})}
    write_layers(path, {"color": np.ones((2, 3, 3), np.float32)}, attributes=header)
    return path


@pytest.mark.parametrize("size", [0, 1, HASHED - 1, HASHED, HASHED + 1, 5 * HASHED])
def test_any_other_render_is_another_file(tmp_path, size):
    """Two renders differ in most of their bytes, and most at their ends."""
    path = tmp_path / "a"
    rng = np.random.default_rng(0)
    path.write_bytes(rng.bytes(size))
    os.utime(path, (100, 100))
    before = identify(path)
    assert identify(path) == before
    assert (before.name, before.size, before.modified) == ("a", size, 100)
    if size:
        path.write_bytes(rng.bytes(size))
        os.utime(path, (100, 100))
        assert not identify(path).same_as(before)
        data = bytearray(path.read_bytes())
        data[-1] ^= 1  # the last byte counts
        again = identify(path)
        path.write_bytes(data)
        assert identify(path).hash != again.hash


def test_time_counts_to_two_seconds_and_the_name_not_at_all():
    """Projects are packed, moved and unpacked; tar and FAT keep whole seconds."""
    assert SOURCE.same_as(Source("b.exr", 3, 101.9, "00"))
    assert not SOURCE.same_as(Source("a.exr", 3, 102.5, "00"))
    assert not SOURCE.same_as(Source("a.exr", 3, 90.0, "00"))  # older is other, too
    assert not SOURCE.same_as(Source("a.exr", 4, 100.0, "00"))
    assert not SOURCE.same_as(Source("a.exr", 3, 100.0, "01"))


def test_the_reason_names_what_is_other(tmp_path):
    now = {"frame 1": SOURCE, "estimate 1": SOURCE}
    settings = {"ravg/settings": json.dumps({"tile": 640, "layer": None}), "ravg/preset": "fast"}
    path = picture(tmp_path / "p.exr", now, attributes=settings, layers="color RGB")

    def why(files: dict[str, Source] = now, **changed: str) -> str | None:
        facts = {"layers": "color RGB"} | {k: v for k, v in changed.items() if not k.startswith("ravg")}
        attributes = settings | {k.replace("__", "/"): v for k, v in changed.items() if k.startswith("ravg")}
        return why_stale(path, {**attributes, MADE_FROM: describe_sources(files, **facts)})

    assert why() is None
    assert why(ravg__preset="quality") == "preset was fast, is quality"
    assert why(ravg__settings=json.dumps({"tile": 384, "layer": None})) == "tile was 640, is 384"
    assert why(layers="color x.RGB") == "layers was color RGB, is color x.RGB"
    assert why({**now, "frame 2": SOURCE}) == "frame 2 was not there"
    assert why({"frame 1": SOURCE}) == "estimate 1 is not there any more"
    assert why({**now, "estimate 1": Source("e.exr", 3, 100, "01")}) == "estimate 1, e.exr, has changed"
    assert why_stale(tmp_path / "none.exr", {}) == ""


@pytest.mark.parametrize(
    "record", ["", "null", "[]", "{", '{"files": 3}', '{"files": {"frame 1": [1, 2]}}', "[" * 99999]
)
def test_a_hostile_record_is_none(tmp_path, record):
    write_layers(tmp_path / "p.exr", {"color": np.ones((2, 3, 3), np.float32)}, attributes={MADE_FROM: record})
    assert why_stale(tmp_path / "p.exr", {MADE_FROM: describe_sources({"frame 1": SOURCE})}) == "frame 1 was not there"
    assert isinstance(sources_in(tmp_path / "p.exr"), dict)


def test_a_damaged_picture_is_stale_and_of_a_kept_one_the_header_is_enough(tmp_path):
    path = picture(tmp_path / "p.exr", {"frame 1": SOURCE})
    now = {MADE_FROM: describe_sources({"frame 1": SOURCE})}
    assert why_stale(path, now) is None
    path.write_bytes(path.read_bytes()[:-10])
    assert why_stale(path, now) == "it is damaged"
    assert why_stale(path, now, whole=False) is None
    (tmp_path / "none.exr").write_text("no picture")
    assert sources_in(tmp_path / "none.exr") == {}


def test_versions_are_the_same_for_the_wheels_of_all_systems(monkeypatch):
    """torch is 2.13.0+cpu on Linux and 2.13.0 on Windows; `--resume` made all frames again on the other."""
    monkeypatch.setattr(sources, "version", lambda package: "2.13.0+cpu" if package == "torch" else "1.0")
    assert sources.versions("torch", "numpy") == {"torch": "2.13.0", "numpy": "1.0"}
