"""The methods of a comparison give finite frames nearer to the truth."""

from importlib.util import find_spec
from pathlib import Path

import numpy as np
import pytest

from hybrid.alignment.window import AlignedWindow
from hybrid.comparison import methods
from hybrid.comparison.methods import METHODS
from hybrid.comparison.metrics import psnr
from hybrid.denoising.plan import Rules
from hybrid.denoising.pseudo_reference import filter_window
from hybrid.denoising.stabilize import Denoised, WindowDenoiser
from hybrid.denoising.stream import FrameStream
from hybrid.files.shots import Shot, open_shot
from hybrid.files.sources import MADE_FROM
from tests.exr_files import write_layers
from tests.scenes import Scene, only

SCENE = Scene(frames=3, height=32, width=40)
NEEDS = {"OIDN": "pyoidn", "Networks": "torch"}


@pytest.fixture(scope="module")
def shot(tmp_path_factory: pytest.TempPathFactory) -> Shot:
    return open_shot(SCENE.write(tmp_path_factory.mktemp("shot")))


@pytest.mark.parametrize("name", [name for name in METHODS if name != "noisy"])
def test_every_method_gives_frames_nearer_to_the_truth(shot: Shot, name: str) -> None:
    for word, package in NEEDS.items():
        if word in (METHODS[name].family, *name.split()) and find_spec(package) is None:
            pytest.skip(f"{package} is not installed")
    number, image = next(METHODS[name].run(shot))
    noisy, truth = shot.read(number).color, SCENE.clean(number - SCENE.first)["ViewLayer.Combined"]
    assert image.shape == noisy.shape
    assert np.isfinite(image).all()
    assert psnr(image, truth) > psnr(noisy, truth)


@pytest.mark.parametrize(("names", "value"), [("Combined", 2), ("Image", 2), ("denoised", 2), ("other", 1)])
def test_of_a_finished_sequence_the_denoised_layer_is_read(shot, tmp_path, names, value):
    """The Noisy Image of Blender's files, which ravg leaves in its own, was measured."""
    size = shot.shape
    noisy = "Noisy Image" if names != "denoised" else "color"
    for number in shot.numbers:
        layers = {noisy: np.full((*size, 3), 1, np.float32), names: np.full((*size, 3), 2, np.float32)}
        write_layers(tmp_path / f"a.{number:04d}.exr", layers)
    pictures = dict(methods.finished(shot, other=open_shot(tmp_path)))
    assert [picture.mean() for picture in pictures.values()] == [value] * len(shot)


def test_of_ravg_s_own_files_what_it_has_written_is_read(shot: Shot, tmp_path: Path) -> None:
    """Another denoiser's picture beside it was read instead of the color that ravg has replaced."""
    layers = {"color": np.full((*shot.shape, 3), 1, np.float32), "denoised": np.full((*shot.shape, 3), 2, np.float32)}
    write_layers(tmp_path / f"a.{SCENE.first}.exr", layers, attributes={MADE_FROM: "{}"})
    pictures = dict(methods.finished(shot, other=open_shot(tmp_path)))
    assert pictures[SCENE.first].mean() == 1


def test_estimators_of_methods_are_those_of_the_library(shot: Shot) -> None:
    aligned = FrameStream(shot, Rules()).align(SCENE.first)
    np.testing.assert_array_equal(next(METHODS["standard"].run(shot))[1], filter_window(aligned))


def test_methods_are_told_apart_by_names_that_a_command_line_can_list() -> None:
    assert not any("," in name for name in METHODS)


def test_a_missing_estimate_makes_a_method_absent(shot: Shot, monkeypatch: pytest.MonkeyPatch, tmp_path: Path) -> None:
    from hybrid.denoising import first_pass

    monkeypatch.setattr(first_pass, "why_no_oidn", lambda: "pyoidn is not installed")
    with pytest.raises(ImportError, match="pyoidn is not installed"):
        next(METHODS["gated OIDN"].run(shot))


def test_a_network_gets_its_guides_filtered_as_in_a_run(shot: Shot, monkeypatch: pytest.MonkeyPatch) -> None:
    """Without them `quality` of a comparison was 1.1 dB below that of `ravg denoise` at 8 samples."""
    guided = []

    class Denoiser(WindowDenoiser):
        radius = 1
        filter_guides = staticmethod(dict)

        def __call__(self, aligned: AlignedWindow) -> Denoised:
            guided.append(aligned.centre.filtered_guides is not None)
            return Denoised(aligned.centre.irradiance * aligned.modulation)

    monkeypatch.setattr(methods, "Rules", lambda: only({"demodulate", "warp", "clean-guides"}))
    monkeypatch.setattr(methods, "_denoiser", lambda *settings: Denoiser())
    for _ in methods.network(shot, preset="quality", first_pass="nlm"):
        assert guided.pop()
