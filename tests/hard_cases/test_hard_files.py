"""Files: damaged, enormous, of odd kinds, and with names that were chosen to do harm."""

import os
import re
import subprocess
import sys
from pathlib import Path

import numpy as np
import OpenEXR
import pytest

from hybrid.cli import main
from hybrid.files.exr import read_exr, write_exr
from hybrid.files.shots import open_shot, output_path
from tests.exr_files import write_layers
from tests.scenes import Scene

ROOT = Path(__file__).parents[2]


def run_alone(*words: str, **environment: str) -> subprocess.CompletedProcess[str]:
    """Run a script of the project in a process of its own."""
    variables = {**os.environ, "PYTHONPATH": os.pathsep.join([str(ROOT), *sys.path]), **environment}
    return subprocess.run([sys.executable, *words], cwd=ROOT, env=variables, capture_output=True, text=True)


def save(path: Path, channels: dict, **header) -> Path:
    header = {"compression": OpenEXR.ZIP_COMPRESSION, "type": OpenEXR.scanlineimage, **header}
    OpenEXR.File([OpenEXR.Part(header, dict(channels), "")]).write(str(path))
    return path


def claim(path: Path, width: int, height: int) -> Path:
    """A small file whose header claims to be this large."""
    data = save(path, {c: np.zeros((4, 4), np.float16) for c in "RGB"}).read_bytes()
    for window in (b"dataWindow", b"displayWindow"):
        at = data.index(window + b"\0box2i\0") + len(window) + 7 + 4
        box = np.array([0, 0, width - 1, height - 1], "<i4").tobytes()
        data = data[:at] + box + data[at + 16 :]
    path.write_bytes(data)
    return path


@pytest.mark.parametrize("size", [(2**31 - 1, 2**31 - 1), (60_000, 60_000), (2**20, 2**20), (65_000, 4_200)])
def test_enormous_claims_are_refused_before_memory_is_taken(tmp_path, capsys, size):
    path = claim(tmp_path / "huge.exr", *size)
    assert main(["denoise", str(path), "-o", str(tmp_path / "out"), "--preset", "draft"]) == 1
    assert capsys.readouterr().err.strip().splitlines()[-1].startswith(f"error: {path}")
    assert {path.name for path in tmp_path.glob("out/*")} <= {"ravg"}  # the record of it


def test_the_limit_is_an_option(tmp_path, capsys):
    folder = Scene(frames=1).write(tmp_path / "in")
    pixels = Scene.height * Scene.width
    for command in (
        ["inspect", str(folder)],
        ["denoise", str(folder), "-o", str(tmp_path / "out"), "--preset", "draft"],
    ):
        assert main([*command, "--max-pixels", str(pixels - 1)]) == 1
        assert f"56x40 pixels, more than the {pixels - 1} accepted" in capsys.readouterr().err
        assert main([*command, "--max-pixels", str(pixels)]) == 0


HOSTILE = {
    "markup": "[red]Combined[/blue]",
    "link": "[link=https://example.org]x",
    "escape": "\x1b]0;owned\x07\x1b[2J",
    "path": "../../../tmp/owned",
    "absolute": "/tmp/owned",
    "home": "~root/owned",
    "variable": "$HOME`id`$(id)",
    "template": "{0.__class__}%s%n",
    "long": "x" * 250,
    "newline": "a\nerror: b",
}


@pytest.mark.parametrize("name", HOSTILE.values(), ids=HOSTILE)
def test_names_from_files_are_only_shown(tmp_path, capsys, name):
    """A channel called [/blue] ended `ravg inspect` with a traceback, and escape sequences reached the terminal."""
    rng = np.random.default_rng(0)
    folder = tmp_path / "in"
    folder.mkdir()
    layers = {"color": rng.random((12, 16, 3)).astype(np.float32), name: np.ones((12, 16, 3), np.float32)}
    path = folder / "shot.0001.exr"
    write_layers(path, layers, attributes={"owner": name, "comments": name})
    before = sorted(tmp_path.rglob("*"))
    for words in (["--layer", f"albedo={name}"], ["--layer", "albedo=none such"]):
        code = main(["inspect", str(path), "-v", *words])
        out, err = capsys.readouterr()
        assert code == (0 if words[1].endswith(name) else 1)
        assert "Traceback" not in err
        assert all(c.isprintable() or c == "\n" for c in out + err)
    assert sorted(tmp_path.rglob("*")) == before
    out = tmp_path / "out" / "done.exr"
    assert main(["denoise", str(path), "-o", str(out), "--preset", "draft"]) == 0
    assert sorted(p.name for p in (tmp_path / "out").iterdir()) == ["done.exr", "ravg"]
    assert sorted(p for p in tmp_path.rglob("*") if tmp_path / "out" not in [p, *p.parents]) == before
    kept = read_exr(out)
    assert kept.parts[0].header["comments"] == name
    np.testing.assert_array_equal(kept.channel(f"{name}.R"), 1)


def test_parts_may_be_called_anything(tmp_path):
    parts = []
    for name in ("../../up", "/abs", "[red]"):
        header = {"compression": OpenEXR.ZIP_COMPRESSION, "type": OpenEXR.scanlineimage}
        parts.append(OpenEXR.Part(header, {c: np.ones((4, 6), np.float16) for c in "RGB"}, name))
    folder = tmp_path / "in"
    folder.mkdir()
    OpenEXR.File(parts).write(str(folder / "a.exr"))
    for name in ("../../up", "/abs", "[red]"):
        assert main(["inspect", str(folder / "a.exr"), "--layer", f"color={name}"]) == 0
    shot = open_shot(folder / "a.exr")
    assert output_path(tmp_path / "out", shot, 1) == tmp_path / "out" / "a.exr"
    write_exr(tmp_path / "b.exr", read_exr(folder / "a.exr"), {})
    assert (tmp_path / "b.exr").read_bytes() == (folder / "a.exr").read_bytes()


WINDOWS = {  # data and display window: first column and row, last column and row
    "overscan": ((-4, -2, 19, 13), (0, 0, 15, 11)),
    "crop": ((3, 2, 9, 8), (0, 0, 15, 11)),
    "no overlap": ((100, 100, 115, 111), (0, 0, 15, 11)),
    "one pixel": ((5, 5, 5, 5), (0, 0, 15, 11)),
    "negative": ((-20, -20, -5, -9), (-30, -30, 15, 11)),
}


@pytest.mark.parametrize("windows", WINDOWS.values(), ids=WINDOWS)
def test_every_relation_of_the_windows_is_kept(tmp_path, windows):
    data, display = ((np.array(box[:2], np.int32), np.array(box[2:], np.int32)) for box in windows)
    width, height = data[1] - data[0] + 1
    rng = np.random.default_rng(0)
    channels = {c: rng.random((height, width)).astype(np.float16) for c in "RGBA"}
    path = save(tmp_path / "a.exr", channels, dataWindow=data, displayWindow=display)
    assert main(["denoise", str(path), "-o", str(tmp_path / "out" / "a.exr"), "--preset", "draft"]) == 0
    kept = read_exr(tmp_path / "out" / "a.exr")
    for name in ("data_window", "display_window"):
        assert getattr(kept.parts[0], name) == getattr(read_exr(path).parts[0], name)
    np.testing.assert_array_equal(kept.channel("A"), channels["A"])


@pytest.mark.posix
def test_side_outputs_spare_all_that_is_read_and_all_that_is_made(tmp_path, capsys):
    """Previews and breakdowns went over frames of estimates, over weights, over each other and over devices."""
    folder, estimates = (
        Scene(frames=2).write(tmp_path / "in"),
        Scene(frames=2).write(tmp_path / "estimates", clean=True),
    )
    out = tmp_path / "out"
    profile = tmp_path / "mine.toml"
    profile.write_text('[layers]\ncolor = ["Combined"]\n')
    (tmp_path / "soft.png").symlink_to(estimates / "shot.1001.exr")
    os.link(profile, tmp_path / "hard.png")
    (tmp_path / "null.png").symlink_to("/dev/null")
    (tmp_path / "folder.png").mkdir()
    before = {path: path.read_bytes() for path in tmp_path.rglob("*") if path.is_file() and path.name != "null.png"}
    words = ["denoise", str(folder), "-o", str(out), "--preset", "draft", "--first-pass", str(estimates)]
    words += ["--profile", str(profile)]
    same = str(tmp_path / "same.png")
    for more, said in [
        (["--preview", str(tmp_path / "soft.png")], "preview .* would overwrite an input: first-pass"),
        (["--contact-sheet", str(tmp_path / "hard.png")], "contact-sheet .* would overwrite an input: profile"),
        (["--preview", str(tmp_path / "null.png")], "null.png is a device"),
        (["--preview", str(tmp_path / "folder.png")], "folder.png is a folder"),
        (["--preview", same, "--contact-sheet", same], "contact-sheet .* would overwrite preview"),
        (["-o", str(estimates)], "output .* would overwrite an input: first-pass"),
    ]:
        assert main([*words, *more]) == 1
        assert re.search(said, capsys.readouterr().err)
    assert {path: path.read_bytes() for path in before} == before
    assert not out.exists()


@pytest.mark.posix
def test_a_folder_for_records_that_leads_elsewhere_is_refused(tmp_path, capsys):
    folder, out = Scene(frames=1).write(tmp_path / "in"), tmp_path / "out"
    for path in (out, tmp_path / "elsewhere"):
        path.mkdir()
    (out / "ravg").symlink_to(tmp_path / "elsewhere")
    assert main(["denoise", str(folder), "-o", str(out), "--preset", "draft"]) == 1
    assert "is a link, expected a folder for records" in capsys.readouterr().err
    assert list((tmp_path / "elsewhere").iterdir()) == []
