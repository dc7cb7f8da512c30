"""Files with several pictures: stereo views and view layers are all denoised, each by itself."""

import json
from collections.abc import Callable
from pathlib import Path

import cv2
import numpy as np
import OpenEXR
import pytest

from hybrid.cli import main
from hybrid.files.exr import ExrImage, read_exr
from hybrid.files.shots import open_shot
from tests.commands import words_in
from tests.renderers import Channels, Truth, cycles_vector, layer, save, truths

FRAMES = truths(np.s_[20:68, 40:104])
WEIGHTS = Path(__file__).parent.parent / "data" / "small.safetensors"


def view(truth: Truth, name: str = "", *, other: bool = False) -> Channels:
    """One picture; the other is the same one mirrored, in another light."""
    turn: Callable[[np.ndarray], np.ndarray] = (lambda a: a[:, ::-1]) if other else (lambda a: a)
    sign = np.array([-1, 1, -1, 1]) if other else np.ones(4)
    end = f".{name}" if name else ""
    return (
        layer(f"ViewLayer.Combined{end}", "RGBA", turn(truth.color) * (0.5 if other else 1), turn(truth.alpha))
        | layer(f"ViewLayer.Denoising Albedo{end}", "RGB", turn(truth.albedo))
        | layer(f"ViewLayer.Denoising Normal{end}", "XYZ", turn(truth.normal) * ([-1, 1, 1] if other else 1))
        | layer(f"ViewLayer.Vector{end}", "XYZW", turn(cycles_vector(truth)) * sign)
    )


def run(spec: Path, out: Path, *options: str) -> Path:
    arguments = ["denoise", str(spec), "-o", str(out), "--frames", "10", "--preset", "draft", *options]
    assert main(arguments) == 0
    return out


def color(folder: Path, name: str) -> bytes:
    image = read_exr(next(folder.glob("*.0010.exr")))
    return b"".join(image.channel(f"{name}.{c}").tobytes() for c in "RGB")


@pytest.fixture(scope="module")
def mono(tmp_path_factory: pytest.TempPathFactory) -> dict[str, bytes]:
    """Each picture denoised alone."""
    made = {}
    for name in ("left", "right"):
        folder = tmp_path_factory.mktemp(name)
        for truth in FRAMES:
            save(folder / f"shot.{truth.number:04d}.exr", view(truth, other=name == "right"))
        made[name] = color(run(folder, folder / "out"), "ViewLayer.Combined")
    assert made["left"] != made["right"]
    return made


def test_both_eyes_of_a_stereo_file_are_those_of_mono_files(mono: dict[str, bytes], tmp_path: Path) -> None:
    for truth in FRAMES:
        channels = view(truth, "left") | view(truth, "right", other=True)
        save(tmp_path / f"shot.{truth.number:04d}.exr", channels, {"multiView": ["left", "right"]})
    out = run(tmp_path, tmp_path / "out")
    assert color(out, "ViewLayer.Combined.left") == mono["left"]
    assert color(out, "ViewLayer.Combined.right") == mono["right"]


def test_inspect_has_the_layers_and_the_plan_of_both_eyes(tmp_path: Path, capsys: pytest.CaptureFixture[str]) -> None:
    for number, truth in enumerate(FRAMES):
        turned = view(truth, "right", other=True)
        if number == 1:  # one frame of one eye alone
            turned |= {name: 3 * plane for name, plane in turned.items() if "Combined" in name and name[-1] in "RGB"}
        save(tmp_path / f"shot.{truth.number:04d}.exr", view(truth, "left") | turned)
    assert main(["inspect", str(tmp_path), "--json"]) == 0
    document = json.loads(capsys.readouterr().out)
    left, (right,) = document, document["others"]
    assert [eye["layers"][0]["layer"] for eye in (left, right)] == [
        f"ViewLayer.Combined.{eye}.RGB" for eye in ("left", "right")
    ]
    gates = [next(d for d in eye["plan"] if d["stage"] == "gate") for eye in (left, right)]
    assert gates[0]["figure"] < gates[1]["figure"]
    assert main(["inspect", str(tmp_path), "-v"]) == 0
    said = capsys.readouterr().out
    for words in ("Layers of ViewLayer.Combined.left", "Plan of ViewLayer.Combined.right"):
        assert words in said


def test_views_in_parts(mono: dict[str, bytes], tmp_path: Path) -> None:
    for truth in FRAMES:
        parts = []
        for eye in ("left", "right"):
            groups: dict[str, dict[str, np.ndarray]] = {}
            for name, plane in view(truth, other=eye == "right").items():
                groups.setdefault(name.rpartition(".")[0], {})[name] = np.ascontiguousarray(plane, np.float32)
            header = {"compression": OpenEXR.ZIP_COMPRESSION, "type": OpenEXR.scanlineimage, "view": eye}
            parts += [OpenEXR.Part(dict(header), planes, f"{name}-{eye}") for name, planes in groups.items()]
        OpenEXR.File(parts).write(str(tmp_path / f"shot.{truth.number:04d}.exr"))
    out = run(tmp_path, tmp_path / "out")
    assert color(out, "ViewLayer.Combined.left") == mono["left"]
    assert color(out, "ViewLayer.Combined.right") == mono["right"]


def bare(truth: Truth, eye: str = "", *, other: bool = False) -> Channels:
    """One picture by the names of a single-part file of the standard, with its view in each name but that of no eye."""
    names = {"Combined": "", "Denoising Albedo": "albedo.", "Denoising Normal": "normal.", "Vector": "motion."}
    end = f"{eye}." if eye else ""
    channels = view(truth, other=other).items()
    return {names[name.split(".")[1]] + end + name.rpartition(".")[2]: plane for name, plane in channels}


@pytest.mark.parametrize("default", ["", "left"], ids=["multiView", "left and right"])
def test_both_eyes_of_bare_channels_are_those_of_mono_files(default, mono, tmp_path, capsys):
    """The left one was denoised twice and the right one never, or only the left one was denoised."""
    header = {} if default else {"multiView": ["left", "right"]}
    for truth in FRAMES:
        name = f"shot.{truth.number:04d}.exr"
        save(tmp_path / "both" / name, bare(truth, default) | bare(truth, "right", other=True), header)
    capsys.readouterr()
    both = read_exr(run(tmp_path / "both", tmp_path / "both_out") / "shot.0010.exr")
    first = f"{default}.RGB" if default else "RGB"
    assert f"pictures: {first}, right.RGB: each is denoised" in words_in(capsys.readouterr().err)
    for eye, end in (("left", f"{default}." if default else ""), ("right", "right.")):
        assert b"".join(both.channel(end + c).tobytes() for c in "RGB") == mono[eye]
    right = run(tmp_path / "both", tmp_path / "chosen", "--layer", "color=right")
    assert color(right, "right") == mono["right"]


def test_every_view_layer_is_denoised_or_the_one_that_was_chosen(mono, tmp_path, capsys):
    for truth in FRAMES:
        channels = {n.replace("ViewLayer.", "Front."): p for n, p in view(truth).items()}
        channels |= {n.replace("ViewLayer.", "Back."): p for n, p in view(truth, other=True).items()}
        save(tmp_path / f"shot.{truth.number:04d}.exr", channels)
    both = run(tmp_path, tmp_path / "both")
    assert color(both, "Front.Combined") == mono["left"]
    assert color(both, "Back.Combined") == mono["right"]
    assert "Back.Combined.RGB, Front.Combined.RGB: each is denoised" in " ".join(capsys.readouterr().err.split())
    back = run(tmp_path, tmp_path / "back", "--layer", "color=Back.Combined")
    assert color(back, "Back.Combined") == mono["right"]
    noisy = color(tmp_path, "Front.Combined")
    assert color(back, "Front.Combined") == noisy != mono["left"]


def stereo(folder: Path) -> Path:
    for truth in FRAMES:
        channels = view(truth, "left") | view(truth, "right", other=True)
        save(folder / f"shot.{truth.number:04d}.exr", channels, {"multiView": ["left", "right"]})
    return folder


@pytest.mark.neural
def test_two_passes_and_the_breakdown_of_both_eyes_are_those_of_mono_files(tmp_path: Path) -> None:
    options = ["--weights", str(WEIGHTS), "--frames", "10", "--passes", "2", "--breakdown"]
    alone: dict[str, ExrImage] = {}
    sheets = {}
    for eye in ("left", "right"):
        for truth in FRAMES:
            save(tmp_path / eye / f"shot.{truth.number:04d}.exr", view(truth, other=eye == "right"))
        out, sheet = tmp_path / f"{eye}_out", tmp_path / f"{eye}.png"
        assert main(["denoise", str(tmp_path / eye), "-o", str(out), *options, str(sheet)]) == 0
        alone[eye], sheets[eye] = read_exr(out / "shot.0010.exr"), cv2.imread(str(sheet))
    out, sheet = tmp_path / "both_out", tmp_path / "both.png"
    assert main(["denoise", str(stereo(tmp_path / "both")), "-o", str(out), *options, str(sheet)]) == 0
    both = read_exr(out / "shot.0010.exr")
    for eye, mono in alone.items():
        for c in "RGB":
            expected = mono.channel(f"ViewLayer.Combined.{c}")
            np.testing.assert_array_equal(both.channel(f"ViewLayer.Combined.{eye}.{c}"), expected)
        added = [name for name in mono.channel_names if name.startswith(("weight.", "contribution."))]
        assert added
        for name in added:
            expected = mono.channel(name)
            np.testing.assert_array_equal(both.channel(f"ViewLayer.Combined.{eye}.{name}"), expected)
    np.testing.assert_array_equal(cv2.imread(str(sheet)), np.vstack([sheets["left"], sheets["right"]]))
    names = [picture.view for picture in open_shot(out).views]
    assert names == ["ViewLayer.Combined.left", "ViewLayer.Combined.right"]


def test_kept_estimates_of_both_eyes_lie_apart(mono: dict[str, bytes], tmp_path: Path) -> None:
    pytest.importorskip("pyoidn")
    spec, kept = stereo(tmp_path / "in"), tmp_path / "kept"
    options = ["--first-pass", "oidn-fast", "--keep-first-pass"]
    first = run(spec, tmp_path / "first", *options, str(kept))
    places = sorted(path.relative_to(kept).as_posix() for path in kept.rglob("*.0010.exr"))
    assert places == ["ViewLayer.Combined.left/shot.0010.exr", "ViewLayer.Combined.right/shot.0010.exr"]
    run(spec, tmp_path / "again", *options, str(tmp_path / "named" / "e.####.exr"))
    assert (tmp_path / "named" / "ViewLayer.Combined.left" / "e.0010.exr").is_file()
    before = {path: path.stat().st_mtime_ns for path in kept.rglob("*.exr")}
    second = run(spec, tmp_path / "second", *options, str(kept))
    assert before == {path: path.stat().st_mtime_ns for path in kept.rglob("*.exr")}
    for eye in ("left", "right"):
        assert color(first, f"ViewLayer.Combined.{eye}") == color(second, f"ViewLayer.Combined.{eye}") != mono[eye]


def test_layers_apart_need_to_know_of_which_picture_they_are(tmp_path: Path) -> None:
    for truth in FRAMES:
        channels = view(truth, "left") | view(truth, "right", other=True)
        save(tmp_path / "in" / f"shot.{truth.number:04d}.exr", channels, {"multiView": ["left", "right"]})
        save(tmp_path / "alb" / f"a.{truth.number:04d}.exr", layer("", "RGB", truth.albedo))
    shot = open_shot(tmp_path / "in", layers={"albedo": str(tmp_path / "alb" / "a.####.exr")})
    with pytest.raises(ValueError, match=r"and layers in other files: expected one \(--layer color=NAME\)"):
        _ = shot.views


@pytest.mark.parametrize(("pattern", "letter"), [("%V/shot.####.exr", False), ("shot_%v.####.exr", True)])
def test_a_file_for_each_eye(pattern: str, letter: bool, mono: dict[str, bytes], tmp_path: Path) -> None:
    for truth in FRAMES:
        for eye in ("left", "right"):
            name = pattern.replace("%V", eye).replace("%v", eye[0]).replace("####", f"{truth.number:04d}")
            save(tmp_path / name, view(truth, other=eye == "right"))
    run(tmp_path / pattern, tmp_path / f"out_{'%v' if letter else '%V'}")
    for eye, expected in mono.items():
        assert color(tmp_path / f"out_{eye[0] if letter else eye}", "ViewLayer.Combined") == expected


def test_a_frame_of_one_eye_that_cannot_be_made_leaves_the_other_eye_to_be_made(tmp_path: Path) -> None:
    """With --keep-going the second eye was not made, without a word."""
    for truth in FRAMES:
        for eye in ("left", "right"):
            save(tmp_path / eye / f"shot.{truth.number:04d}.exr", view(truth))
    damaged = tmp_path / "left" / f"shot.{FRAMES[-1].number:04d}.exr"
    damaged.write_bytes(damaged.read_bytes()[:-2000])
    words = ["denoise", str(tmp_path / "%V"), "-o", str(tmp_path / "out_%V"), "--preset", "draft"]
    assert main([*words, "--keep-going"]) == 1
    assert len(list((tmp_path / "out_right").glob("*.exr"))) == len(FRAMES)
    assert len(list((tmp_path / "out_left").glob("*.exr"))) < len(FRAMES)


def test_two_eyes_do_not_go_into_one_file(tmp_path: Path, capsys: pytest.CaptureFixture[str]) -> None:
    for eye in ("left", "right"):
        save(tmp_path / eye / "shot.0001.exr", view(FRAMES[0]))
    spec = str(tmp_path / "%V" / "shot.####.exr")
    words = ["denoise", "--method=classical", "-o"]
    assert main([*words, str(tmp_path / "out"), spec]) == 2
    assert "expected %V or %v in it" in words_in(capsys.readouterr().err)
    assert main([*words, str(tmp_path / "out_%V"), str(tmp_path / "none_%V.####.exr")]) == 1
    assert "no view is there" in capsys.readouterr().err


@pytest.mark.parametrize(
    ("option", "value"),
    [
        ("--keep-first-pass", "kept"),
        ("--keep-first-pass", "kept/e.####.exr"),
        ("--preview", "x.png"),
        ("--contact-sheet", "x.png"),
        ("--first-pass", "left/shot.####.exr"),
        ("--layer", "albedo=left/shot.####.exr"),
        ("--output", "out_%v"),
    ],
)
def test_two_eyes_share_nothing(option, value, tmp_path, monkeypatch, capsys):
    """One eye's picture was written over the other's, or made from its estimates, with exit code 0."""
    monkeypatch.chdir(tmp_path)
    for eye in ("left", "local"):
        save(tmp_path / eye / "shot.0001.exr", view(FRAMES[0]))
    assert main(["denoise", "%V/shot.####.exr", "--output", "out_%V", "--preset", "draft", option, value]) == 2
    assert "expected %V or %v in it" in words_in(capsys.readouterr().err)
    assert sorted(path.name for path in tmp_path.iterdir()) == ["left", "local"]


def test_kept_estimates_of_pictures_called_alike_lie_apart(tmp_path: Path) -> None:
    """Both lay in A_B.Combined, the last one's over the first one's."""
    pytest.importorskip("pyoidn")
    for truth in FRAMES:
        channels = {n.replace("ViewLayer.", "A B."): p for n, p in view(truth).items()}
        channels |= {n.replace("ViewLayer.", "A_B."): p for n, p in view(truth, other=True).items()}
        save(tmp_path / "in" / f"shot.{truth.number:04d}.exr", channels)
    run(tmp_path / "in", tmp_path / "out", "--first-pass", "oidn-fast", "--keep-first-pass", str(tmp_path / "kept"))
    folders = sorted(path.name for path in (tmp_path / "kept").iterdir())
    assert len(folders) == 2
    assert folders[0] == "A_B.Combined"
    assert folders[1].startswith("A_B.Combined-")
