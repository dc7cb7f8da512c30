"""Arrays are checked where they enter and where they leave: an error that names the frame, and no file."""

import re

import numpy as np
import pytest

from hybrid.cli import main
from hybrid.comparison.metrics import psnr
from hybrid.denoising.pseudo_reference import CLASSICAL_PRESETS, filter_window
from hybrid.files.exr import read_exr
from hybrid.files.shots import open_shot
from tests.scenes import Scene
from tests.seldom import seldom

SCENE = Scene(height=32, width=48, frames=5)
MIDDLE = SCENE.first + 2


def draft(folder, out, *more):
    return main(["denoise", str(folder), "-o", str(out), "--preset", "draft", *map(str, more)])


@pytest.fixture(scope="module")
def plain(tmp_path_factory):
    """The frames denoised as they are."""
    folder = tmp_path_factory.mktemp("plain")
    assert draft(SCENE.write(folder / "in"), folder / "out") == 0
    return folder / "out"


def colors(folder):
    shot = open_shot(folder)
    return {number: shot.read(number).color for number in shot.numbers}


@pytest.mark.parametrize("value", [1e30, *seldom(1e15, -1e30, 3e38)])
@pytest.mark.parametrize("layer", ["Combined", "Denoising Albedo", "Denoising Normal", "Depth", "Vector"])
def test_one_finite_but_absurd_value_leaves_the_frames_around_alone(tmp_path, plain, layer, value):
    """A pixel of 1e30 made NaN of five frames."""

    def edit(index, layers):
        if index == 2:
            layers[f"ViewLayer.{layer}"][10, 20] = value

    assert draft(SCENE.write(tmp_path / "in", edit=edit), tmp_path / "out") == 0
    expected = colors(plain)
    for number, color in colors(tmp_path / "out").items():
        assert np.isfinite(color).all()
        # The pixel is lost, and filled in; another plan may be made where it was the only thing that moved.
        assert psnr(color, expected[number]) > 30


@pytest.mark.parametrize(
    ("what", "said"),
    [
        ("nan", f"the first pass of frame {MIDDLE}: 1536 of 1536 pixels are not finite"),
        ("half nan", f"the first pass of frame {MIDDLE}: 768 of 1536 pixels are not finite"),
        ("exposed", f"the first pass of frame {MIDDLE}: it has 4.* times the light in channel R"),
        ("no red", f"the first pass of frame {MIDDLE}: it has 0 times the light in channel R"),
    ],
)
def test_an_estimate_that_cannot_be_right_is_named_and_nothing_is_made_of_it(tmp_path, capsys, what, said):
    """The neighbours of a frame of NaN fell to 0.8 of their light."""

    def edit(index, layers):
        color = layers["ViewLayer.Combined"]
        if index == 2:
            color[: 16 if what == "half nan" else None] *= {"exposed": 4, "no red": 1}.get(what, np.nan)
            color[..., 0] *= 0 if what == "no red" else 1

    estimates = SCENE.write(tmp_path / "estimates", clean=True, edit=edit)
    out = tmp_path / "out"
    assert draft(SCENE.write(tmp_path / "in"), out, "--first-pass", estimates) == 1
    assert re.search(f"error: {said}", capsys.readouterr().err)
    assert not list(out.glob("*.exr"))  # all windows have it


def test_few_lost_pixels_of_an_estimate_are_filled_in(tmp_path):
    def edit(index, layers):
        layers["ViewLayer.Combined"][5, 5:10] = np.nan

    estimates = SCENE.write(tmp_path / "estimates", clean=True, edit=edit)
    assert draft(SCENE.write(tmp_path / "in"), tmp_path / "out", "--first-pass", estimates) == 0
    assert all(np.isfinite(color).all() for color in colors(tmp_path / "out").values())


@pytest.mark.parametrize(
    ("factor", "said"),
    [
        (np.nan, "color: 1536 of 1536 pixels are not finite; it was not written"),
        (4, r"[34]\.?\d? times the light in channel R.*; it was not written"),
        (0, "0 times the light in channel R.*; it was not written"),
    ],
)
def test_a_picture_that_cannot_be_right_is_not_written(tmp_path, capsys, monkeypatch, factor, said):
    """Whatever made it so: the command ended with 0, and the file was there."""

    def spoiled(window, *args, **kwargs):
        image = filter_window(window, CLASSICAL_PRESETS["draft"])
        return image * np.float32(factor) if window.number == MIDDLE else image

    monkeypatch.setattr("hybrid.denoising.denoisers.filter_window", spoiled)
    folder, out = SCENE.write(tmp_path / "in"), tmp_path / "out"
    assert draft(folder, out) == 1
    assert re.search(f"error: frame {MIDDLE}.*{said}", capsys.readouterr().err)
    names = {path.name for path in out.glob("*.exr")}
    assert names == {f"shot.{number}.exr" for number in range(SCENE.first, MIDDLE)}
    assert draft(folder, out, "--keep-going") == 1
    names = {path.name for path in out.glob("*.exr")}
    assert names == {f"shot.{number}.exr" for number in range(SCENE.first, SCENE.first + 5) if number != MIDDLE}


@pytest.mark.neural
@pytest.mark.parametrize("scale", [30.0, -30.0])
def test_absurd_weights_make_no_pictures_that_are_not_finite(tmp_path, capsys, scale):
    torch = pytest.importorskip("torch")
    from network.checkpoint import load_model, save_model, shipped_weights

    model = load_model(shipped_weights("fast"))
    with torch.no_grad():
        for parameter in model.parameters():
            parameter.mul_(scale)
    save_model(tmp_path / "w.safetensors", model)
    folder, out = SCENE.write(tmp_path / "in"), tmp_path / "out"
    code = main(
        ["denoise", str(folder), "-o", str(out), "--first-pass", "nlm", "--weights", str(tmp_path / "w.safetensors")]
    )
    assert code == 0 or "it was not written" in capsys.readouterr().err
    for path in out.glob("*.exr"):
        image = read_exr(path)
        assert np.isfinite(image.channel("ViewLayer.Combined.R")).all()


def test_a_black_frame_between_bright_ones_is_no_error(tmp_path):
    def edit(index, layers):
        if index == 2:
            layers["ViewLayer.Combined"][:] = 0

    assert draft(SCENE.write(tmp_path / "black", edit=edit), tmp_path / "black out") == 0
