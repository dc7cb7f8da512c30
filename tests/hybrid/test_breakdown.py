"""What each stage did where: maps in [0, 1] that show it where it was done and nowhere else."""

from __future__ import annotations

from dataclasses import replace

import numpy as np

from hybrid.alignment.window import AlignedWindow
from hybrid.breakdown import stage_layers
from hybrid.files.shots import open_shot
from hybrid.first_pass import PerFrame
from hybrid.stream import FrameStream
from nlm.average import average
from tests.scenes import Scene, only


def align(folder, frames: int = 3) -> AlignedWindow:
    def brighter(index, layers):
        layers["ViewLayer.Combined"][:20, :16] *= 1 + 9 * index  # a light that comes on, in one corner

    scene = Scene(frames=frames, step=(0, 0), height=48, width=64, noise=1e-3)
    shot = open_shot(scene.write(folder, edit=brighter))
    stages = {"gate", "demodulate"}
    return FrameStream(shot, only(stages), radius=1, first_pass=PerFrame(lambda frame: frame.color)).align(
        shot.numbers[frames // 2]
    )


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
    first = replace(window, trust=window.trust.copy(), confidence=window.confidence.copy())
    first.trust[0] = first.confidence[0] = 0
    np.testing.assert_array_equal(stage_layers(first, window.color[1])["stage.align"], window.trust[2])
    alone = align(tmp_path / "one", frames=1)
    assert not stage_layers(alone, alone.color[1])["stage.align"].any()
