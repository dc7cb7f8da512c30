"""Layers in sequences of their own: the same bytes as from one file; missing frames are named."""

import os
from pathlib import Path

import numpy as np
import pytest

from hybrid.cli import main
from hybrid.files.exr import ExrError, read_exr
from hybrid.files.sequences import pattern_of
from hybrid.files.shots import open_shot
from hybrid.files.sidecars import find_companions, names_sequence
from tests.renderers import Channels, Truth, cycles_vector, layer, save, truths
from tests.seldom import seldom

FRAMES = truths(np.s_[12:76, 24:120])


def color(truth: Truth) -> Channels:
    return layer("", "RGBA", truth.color, truth.alpha)


def others(truth: Truth) -> dict[str, Channels]:
    return {
        "albedo": layer("", "RGB", truth.albedo),
        "normal": layer("", "XYZ", truth.normal),
        "depth": layer("", "Z", truth.depth),
        "motion": layer("", "XYZW", cycles_vector(truth)),
    }


def merged(folder: Path) -> Path:
    """All layers in one file, by plain names."""
    for truth in FRAMES:
        channels = color(truth)
        for role, planes in others(truth).items():
            channels |= {f"{role}.{name}": plane for name, plane in planes.items()}
        save(folder / f"shot.{truth.number:04d}.exr", channels)
    return folder / "shot.####.exr"


def split(folder: Path, names: dict[str, str]) -> None:
    """Each layer in a file of its own, by these names."""
    for truth in FRAMES:
        for role, channels in {"color": color(truth), **others(truth)}.items():
            save(folder / names[role].replace("####", f"{truth.number:04d}"), channels)


def made(spec: Path, out: Path, *options: str) -> bytes:
    arguments = ["denoise", str(spec), "-o", str(out), "--frames", "10", "--preset", "draft", *options]
    assert main(arguments) == 0
    image = read_exr(next(out.glob("*0010*exr")))
    return b"".join(image.channel(name).tobytes() for name in "RGBA")


ROLES = ("albedo", "normal", "depth", "motion")
VRAY = ("DiffuseFilter", "Normals", "ZDepth", "Velocity")
APART = {role: f"{role}/{role}.####.exr" for role in ROLES} | {"color": "beauty/beauty.####.exr"}


def read_all(spec: Path, **layers: str) -> dict[str, np.ndarray]:
    """All layers of a frame."""
    frame = open_shot(spec, layers=layers).read(10)
    return {name: getattr(frame, name) for name in ("color", "alpha", *ROLES)}


@pytest.fixture(scope="module")
def whole(tmp_path_factory: pytest.TempPathFactory) -> dict[str, np.ndarray]:
    return read_all(merged(tmp_path_factory.mktemp("merged")))


def same(found: dict[str, np.ndarray], expected: dict[str, np.ndarray]) -> None:
    for name, array in expected.items():
        np.testing.assert_array_equal(found[name], array, err_msg=name)


def test_sequences_apart_give_the_same_bytes_as_one_file(tmp_path: Path, capsys: pytest.CaptureFixture[str]) -> None:
    expected = made(merged(tmp_path / "merged"), tmp_path / "out")
    split(tmp_path / "named", APART)
    named = [word for role in ROLES for word in ("--layer", f"{role}={tmp_path / 'named' / APART[role]}")]
    assert made(tmp_path / "named" / APART["color"], tmp_path / "out of named", *named) == expected
    split(tmp_path / "found", ELEMENTS["plain"])
    capsys.readouterr()
    assert made(tmp_path / "found", tmp_path / "out of found") == expected
    (said,) = [line for line in capsys.readouterr().err.splitlines() if line.startswith("Passes")]
    for role in ROLES:
        words = {"motion": "motion vectors"}.get(role, role)
        assert f"{words} ({ELEMENTS['plain'][role]})" in said


def test_a_folder_for_each_layer_is_found_by_their_names(whole: dict[str, np.ndarray], tmp_path: Path) -> None:
    split(tmp_path, APART)
    same(read_all(tmp_path), whole)


def test_a_file_for_each_layer_is_found_by_their_names(whole: dict[str, np.ndarray], tmp_path: Path) -> None:
    split(tmp_path, {role: f"sh_010.{role}.####.exr" for role in ROLES} | {"color": "sh_010.beauty.####.exr"})
    same(read_all(tmp_path), whole)


ELEMENTS = {
    "V-Ray for Maya": {r: f"view.{n}.####.exr" for r, n in zip(ROLES, VRAY, strict=True)} | {"color": "view.####.exr"},
    "3ds Max": {r: f"view_VRay{n}####.exr" for r, n in zip(ROLES, VRAY, strict=True)} | {"color": "view####.exr"},
    "hyphens": {r: f"s-v2-{r}-####.exr" for r in ROLES} | {"color": "s-v2-####.exr"},
    "behind": {r: f"view.####.{r}.exr" for r in ROLES} | {"color": "view.####.exr"},
    "numbers": {r: f"####_{r}.exr" for r in ROLES} | {"color": "####.exr"},
    "plain": {r: f"010_{r}.####.exr" for r in ROLES} | {"color": "010.####.exr"},
}


@pytest.mark.parametrize("names", ELEMENTS.values(), ids=ELEMENTS)
def test_elements_beside_a_color_without_a_name_of_its_own(whole, names, tmp_path):
    """The folder was refused; named by its pattern the color was denoised without its guides, and nothing was said."""
    home = tmp_path / "in"
    split(home, names)
    for truth in FRAMES:  # further elements are left alone
        other = names["albedo"].replace("iffuseFilter", "iffuse").replace("albedo", "glow")
        save(home / other.replace("####", f"{truth.number:04d}"), layer("", "RGB", truth.color))
    for spec in (home, home / names["color"]):
        same(read_all(spec), whole)
        layers = open_shot(spec).layers(10)
        assert [getattr(layers, role).file for role in ROLES] == [names[role] for role in ROLES]


def test_what_the_color_has_itself_and_other_pictures_are_not_taken_from_beside_it(tmp_path: Path) -> None:
    for truth in FRAMES:
        own = color(truth) | layer("albedo", "RGB", truth.albedo)
        save(tmp_path / f"view.{truth.number:04d}.exr", own)
        for name in ("albedo", "denoised", "alpha", "beauty", "2"):
            save(tmp_path / f"view.{name}.{truth.number:04d}.exr", layer("", "RGB", truth.color))
        save(tmp_path / f"view2.normals.{truth.number:04d}.exr", layer("", "XYZ", truth.normal))
    layers = open_shot(tmp_path / "view.####.exr").layers(10)
    assert str(layers.albedo) == "albedo.RGB"
    assert (layers.normal, layers.estimate) == (None, None)
    assert str(layers.alpha) == "A"


def test_elements_that_lack_a_frame_are_refused(tmp_path: Path) -> None:
    split(tmp_path, ELEMENTS["plain"])
    (tmp_path / "010_normal.0011.exr").unlink()
    for spec in (tmp_path, tmp_path / "010.####.exr"):
        with pytest.raises(FileNotFoundError, match=r"normal .*: no frame 11; it has 9-10,12, expected all frames"):
            open_shot(spec)


def test_in_any_mixture(whole: dict[str, np.ndarray], tmp_path: Path) -> None:
    """Albedo apart, beside the color's own and worse; normal and motion in one other file."""
    spec = merged(tmp_path)
    for truth in FRAMES:
        path = tmp_path / f"shot.{truth.number:04d}.exr"
        kept = {n: read_exr(path).channel(n) for n in [*"RGBA", "albedo.R", "albedo.G", "albedo.B", "depth.Z"]}
        save(path, kept | {"albedo.R": 0 * kept["R"]})
        save(tmp_path / "apart" / f"alb.{truth.number:04d}.exr", layer("", "RGB", truth.albedo))
        both = layer("nrm", "XYZ", truth.normal) | layer("vec", "XYZW", cycles_vector(truth))
        save(tmp_path / "apart" / f"two.{truth.number:04d}.exr", both)
    apart = {"albedo": "alb.####.exr", "normal": "two.####.exr:nrm", "motion": "two.####.exr:vec"}
    same(read_all(spec, **{role: str(tmp_path / "apart" / name) for role, name in apart.items()}), whole)


def test_renderman_s_variance_file_is_found_beside_the_beauty(tmp_path: Path) -> None:
    for truth in FRAMES:
        save(tmp_path / f"sh.{truth.number:04d}.exr", layer("Ci", "rgb", truth.color) | {"a": truth.alpha})
        rest = layer("albedo", "rgb", truth.albedo) | layer("normal", "rgb", truth.normal)
        rest |= layer("mse", "rgb", truth.variance) | layer("backward", "rg", truth.previous)
        save(tmp_path / f"sh_variance.{truth.number:04d}.exr", rest)
    for spec in (tmp_path / "sh.####.exr", tmp_path):
        shot = open_shot(spec)
        layers = shot.layers(10)
        assert (layers.profile, layers.reason) == ("RenderMan", "sh_variance.####.exr beside it")
        assert str(layers.color) == "Ci.rgb"
        assert str(layers.albedo) == "sh_variance.####.exr:albedo.rgb"
        assert str(layers.motion) == "sh_variance.####.exr:backward.rg"
        frame = shot.read(10)
        np.testing.assert_array_equal(frame.albedo, FRAMES[1].albedo)
        np.testing.assert_array_equal(frame.variance, FRAMES[1].variance)
        assert shot.is_input(tmp_path / "sh_variance.0010.exr")  # and nothing writes over it
    assert main(["inspect", str(tmp_path / "sh_variance.####.exr")]) == 1  # it holds no color


@pytest.mark.parametrize(
    ("profile", "names"),
    [
        ("LuxCore", {"color": "RGB_IMAGEPIPELINE_####.exr", "albedo": "ALBEDO_####.exr", "depth": "DEPTH_####.exr"}),
        (
            "Unreal",
            {
                "color": "Sh.FinalImage.####.exr",
                "depth": "Sh.FinalImageMovieRenderQueue_WorldDepth.####.exr",
                "motion": "Sh.FinalImageMovieRenderQueue_MotionVectors.####.exr",
            },
        ),
    ],
)
def test_renderers_that_write_a_file_for_each_output(profile: str, names: dict[str, str], tmp_path: Path) -> None:
    for truth in FRAMES:
        for role, channels in {"color": color(truth), **others(truth)}.items():
            if role in names:
                save(tmp_path / names[role].replace("####", f"{truth.number:04d}"), channels)
    # Named alone the color lost its albedo, without a hint.
    for spec in (tmp_path, tmp_path / names["color"], tmp_path / names["color"].replace("####", "0010")):
        layers = open_shot(spec).layers(10)
        assert layers.profile == profile
        assert {role for role in ROLES if getattr(layers, role) is not None} == {*names} - {"color"}
    assert find_companions(pattern_of(tmp_path / names["depth"].replace("####", "0010")).files()) == (None, [])


def test_each_color_of_a_folder_has_its_own_guides(tmp_path: Path) -> None:
    for shot in ("a", "b"):
        split(tmp_path, {role: f"{shot}_{role}.####.exr" for role in ROLES} | {"color": f"{shot}_beauty.####.exr"})
    layers = open_shot(tmp_path / "b_beauty.####.exr").layers(10)
    assert [getattr(layers, role).file for role in ROLES] == [f"b_{role}.####.exr" for role in ROLES]


def test_a_layer_that_was_made_again_makes_the_frame_again(tmp_path: Path, capsys: pytest.CaptureFixture[str]) -> None:
    split(tmp_path / "in", APART)
    command = ["denoise", str(tmp_path / "in"), "-o", str(tmp_path / "out"), "--frames", "9", "--preset", "draft"]
    assert main([*command, "--resume"]) == 0
    finished = tmp_path / "out" / "beauty.0009.exr"
    first = finished.stat().st_mtime_ns
    assert main([*command, "--resume"]) == 0
    assert finished.stat().st_mtime_ns == first
    albedo = tmp_path / "in" / "albedo"
    (albedo / "albedo.0010.exr").write_bytes((albedo / "albedo.0011.exr").read_bytes())
    assert main([*command, "--resume"]) == 0
    assert finished.stat().st_mtime_ns != first


@pytest.mark.parametrize("role", ["albedo", *seldom("normal")])
def test_sequences_of_one_name_in_several_folders_are_told_apart(tmp_path, capsys, role):
    """A folder for each layer, with equal names in all: what stood for one of them stood for all."""
    split(tmp_path, {name: f"{name}/####.exr" for name in (*ROLES, "color")})
    named = [word for name in ROLES for word in ("--layer", f"{name}={tmp_path / name / '####.exr'}")]
    words = ["denoise", str(tmp_path / "color"), "-o", str(tmp_path / "out"), "--preset", "draft", *named]
    assert main(words) == 0
    path = tmp_path / role / "0010.exr"
    os.utime(path, (1e9, 1e9))
    assert main([*words, "--resume"]) == 0
    assert f"frame 10 {role}, 0010.exr, has changed" in capsys.readouterr().err


def test_a_missing_frame_is_an_error_that_names_it(tmp_path: Path, capsys: pytest.CaptureFixture[str]) -> None:
    split(tmp_path, APART)
    (tmp_path / "albedo" / "albedo.0011.exr").unlink()
    spec = tmp_path / APART["albedo"]
    assert main(["inspect", str(tmp_path / APART["color"]), "--layer", f"albedo={spec}"]) == 1
    assert f"albedo ({spec}): no frame 11; it has 9-10,12" in " ".join(capsys.readouterr().err.split())


def test_another_size_and_several_layers_are_errors(tmp_path: Path) -> None:
    split(tmp_path, APART)
    for truth in FRAMES:
        save(tmp_path / "small" / f"a.{truth.number:04d}.exr", layer("", "RGB", truth.albedo[::2, ::2]))
        two = layer("one", "RGB", truth.albedo) | layer("two", "RGB", truth.albedo)
        save(tmp_path / "two" / f"a.{truth.number:04d}.exr", two)
    spec = tmp_path / APART["color"]
    shot = open_shot(spec, layers={"albedo": str(tmp_path / "small" / "a.####.exr")})
    with pytest.raises(ValueError, match="albedo is 48x32, expected the size of the color, 96x64"):
        shot.read(10)
    with pytest.raises(ExrError, match=r"albedo can be one\.RGB, two\.RGB, expected one"):
        open_shot(spec, layers={"albedo": str(tmp_path / "two" / "a.####.exr")}).layers(10)
    with pytest.raises(ValueError, match=r"color is .* expected that sequence as the shot"):
        open_shot(spec, layers={"color": str(spec)})


def test_two_sequences_with_the_name_of_one_layer_are_refused(tmp_path: Path) -> None:
    split(tmp_path, APART)
    for truth in FRAMES:
        save(tmp_path / "N" / f"n.{truth.number:04d}.exr", layer("", "XYZ", truth.normal))
    with pytest.raises(ValueError, match="normal can be"):
        open_shot(tmp_path)


def test_what_names_a_sequence_and_what_a_layer() -> None:
    for value in ("a/alb.####.exr", "alb.%04d.EXR", "alb.####.exr:RGBA", "a.####.exr 8-10"):
        assert names_sequence(value)
    for value in ("albedo", "ViewLayer.Denoising Albedo", "exr", "a.exrs", "no/folder"):
        assert not names_sequence(value)


def test_a_guide_that_is_named_settles_which_of_two_beside_the_color(tmp_path: Path) -> None:
    for truth in FRAMES:
        number = f"{truth.number:04d}.exr"
        save(tmp_path / f"shot.{number}", color(truth))
        for name in ("N", "normal"):
            save(tmp_path / f"shot.{name}.{number}", layer("", "XYZ", truth.normal))
    spec, chosen = tmp_path / "shot.####.exr", str(tmp_path / "shot.N.####.exr")
    with pytest.raises(ValueError, match="normal can be"):
        open_shot(spec)
    normal = open_shot(spec, layers={"normal": chosen}).layers(10).normal
    assert normal is not None
    assert normal.file == chosen
