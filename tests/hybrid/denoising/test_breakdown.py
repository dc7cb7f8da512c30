"""Maps in [0, 1] that show each stage where it ran and nowhere else."""

from dataclasses import replace

import cv2
import numpy as np
import pytest

from hybrid.alignment.window import AlignedWindow
from hybrid.cli import main
from hybrid.denoising.breakdown import layers_of, stage_layers, write_breakdown
from hybrid.denoising.first_pass import PerFrame
from hybrid.denoising.stream import FrameStream
from hybrid.files.exr import read_exr
from hybrid.files.shots import open_shot
from nlm.average import average
from tests.scenes import Scene, only


def align(folder, frames: int = 3) -> AlignedWindow:
    def brighter(index, layers):
        layers["ViewLayer.Combined"][:20, :16] *= 1 + 9 * index  # a light that comes on, in one corner

    scene = Scene(frames=frames, step=(0, 0), height=48, width=64, noise=1e-3)
    shot = open_shot(scene.write(folder, edit=brighter))
    stages = {"gate", "demodulate"}
    first_pass = PerFrame(lambda frame: cv2.blur(frame.color, (3, 3)))
    return FrameStream(shot, only(stages), radius=1, first_pass=first_pass).align(shot.numbers[frames // 2])


def test_the_maps_show_where_geometry_trusts_light_differs_and_the_network_has_changed_something(tmp_path):
    window = align(tmp_path)
    result = average(window.first_pass, window.confidence)
    result[30:40, 50:60] *= 3
    maps = stage_layers(window, result)
    assert maps["stage.align"].min() > 0.99  # nothing moves
    assert maps["stage.gate"][:12, :8].max() < 0.1
    assert maps["stage.gate"][30:, 30:].min() > 0.9
    changed = maps["stage.network"] > 0
    assert changed[30:40, 50:60].all()
    assert changed.sum() == 100
    assert all(layer.min() >= 0 and layer.max() <= 1 for layer in maps.values())


def test_frames_that_are_missing_do_not_count_and_a_frame_alone_has_none(tmp_path):
    window = align(tmp_path / "three")
    trust, confidence = window.geometric_confidence.copy(), window.confidence.copy()
    first = replace(window, geometric_confidence=trust, confidence=confidence)
    first.geometric_confidence[0] = first.confidence[0] = 0
    layers = stage_layers(first, window.color[1])
    np.testing.assert_array_equal(layers["stage.align"], window.geometric_confidence[2])
    alone = align(tmp_path / "one", frames=1)
    assert not stage_layers(alone, alone.color[1])["stage.align"].any()


def test_layers_are_named_in_the_order_of_time():
    weights = np.arange(5, dtype=np.float32)[:, None, None] * np.ones((1, 2, 3), np.float32)
    layers = layers_of(weights[..., None] * np.ones(3, np.float32), weights)
    names = ("before2", "before1", "centre", "after1", "after2")
    for index, name in enumerate(names):
        assert (layers[f"weight.{name}"] == index).all()
        assert (layers[f"contribution.{name}"] == index).all()


def test_the_picture_shows_the_frames_in_the_order_of_time(tmp_path):
    """From the frame before on the left to the frame after on the right, above their weights."""
    scene = Scene(frames=1, height=24, width=32)
    shot = open_shot(scene.write(tmp_path / "noisy"))

    def add(index, layers):
        for value, name in enumerate(("before1", "centre", "after1")):
            layers[f"weight.{name}"] = np.full((24, 32), 0.25 * (value + 1), np.float32)
            layers[f"contribution.{name}"] = np.full((24, 32, 3), 0.05 * (value + 1), np.float32)

    out = scene.write(tmp_path / "out", edit=add)
    write_breakdown([shot], out, 3, tmp_path / "breakdown.png")
    picture = cv2.imread(str(tmp_path / "breakdown.png"))[..., 0]
    contributions, weights = (picture[top + 12, [16, 48, 80]] for top in (24, 48))
    assert contributions[0] < contributions[1] < contributions[2]
    np.testing.assert_allclose(weights, np.round(255 * np.array([0.25, 0.5, 0.75])), atol=1)


@pytest.mark.neural
def test_a_first_frame_gets_nothing_from_before_it(tmp_path):
    """The breakdown of a shot's first frame names the next one, as the one after."""
    scene = Scene(frames=2, step=(0, 0), height=64, width=64, noise=0.05)
    noisy = scene.write(tmp_path / "noisy")
    words = ["denoise", str(noisy), "-o", str(tmp_path / "out"), "--first-pass", "none"]
    assert main([*words, "--breakdown", str(tmp_path / "b.png")]) == 0
    first = sorted((tmp_path / "out").glob("*.exr"))[0]
    image = read_exr(first)
    means = {layer.name: float(image.pixels(layer.channels).mean()) for layer in image.layers if "weight" in layer.name}
    assert means["weight.before1"] == 0
    assert means["weight.after1"] > 0.1
