from dataclasses import replace

import numpy as np
import pytest

from hybrid.alignment.window import warp_rows
from hybrid.denoising.first_pass import PerFrame
from hybrid.denoising.stream import FrameStream
from hybrid.files.shots import open_shot
from nlm.average import replace_nonfinite
from tests.scenes import Scene, only

STAGES = {"demodulate", "outliers", "warp"}
SCENE = Scene(frames=5)
MIDDLE = SCENE.first + 2


def window(folder):
    return FrameStream(open_shot(folder), only(STAGES)).align(MIDDLE)


@pytest.mark.parametrize("step", [0, 2])
def test_a_layer_is_moved_to_rows_of_the_centre(step):
    layer = np.random.default_rng(0).random((40, 30, 3), np.float32)
    warped = np.empty((25, 30, 3), np.float32)
    warp_rows(layer, np.full((25, 30, 2), (step, 0), np.float32), 5, warped)
    np.testing.assert_array_equal(warped[:, : 30 - step], layer[5:30, step:])  # whole pixels


def test_the_centre_takes_the_place_of_what_is_not_trusted(tmp_path):
    aligned = window(SCENE.write(tmp_path))
    spoilt = aligned.color.copy()
    nowhere = aligned.confidence == 0
    assert 0.02 < nowhere.mean() < 0.5  # what has left the frame
    spoilt[nowhere] = 1e6
    mixed = replace(aligned, aligned_color=spoilt).mixed(spoilt)
    for index in range(5):
        np.testing.assert_array_equal(mixed[index][nowhere[index]], aligned.color[2][nowhere[index]])
        sure = aligned.confidence[index] == 1
        np.testing.assert_array_equal(mixed[index][sure], spoilt[index][sure])
    half = replace(aligned, confidence=np.full_like(aligned.confidence, 0.5))
    np.testing.assert_allclose(half.mixed(aligned.color)[0], (aligned.color[0] + aligned.color[2]) / 2, rtol=1e-6)


def test_colors_beside_estimates_are_those_without(tmp_path):
    """They are aligned when they are asked for; what a frame has lost is as it was in those around it."""

    def lose(index, layers):
        if index == 2:
            layers["ViewLayer.Combined"][10:14, 20:24] = np.nan

    shot = open_shot(SCENE.write(tmp_path, edit=lose))
    stages = {"demodulate", "outliers", "warp"}
    beside = FrameStream(
        shot, only(stages), first_pass=PerFrame(lambda frame: replace_nonfinite(frame.color)[0])
    ).align(MIDDLE)
    without = FrameStream(shot, only(stages - {"outliers"})).align(MIDDLE)
    assert beside.aligned_color is None
    assert "outliers" not in beside.stages
    assert (beside.confidence[2, 10:14, 20:24] == 0).all()
    np.testing.assert_array_equal(beside.color, without.color)
    np.testing.assert_array_equal(beside.centre.irradiance, without.color[2])


def test_the_guides_of_all_frames_are_aligned_as_these_are(tmp_path):
    """When they are asked for; the centre's are there in any case."""
    folder = SCENE.write(tmp_path)
    (folder / f"shot.{MIDDLE + 1}.exr").unlink()
    aligned, alone = window(folder), open_shot(folder).read(MIDDLE)
    for name in ("albedo", "normal"):
        layer, own = getattr(aligned, name), aligned.centre.guides[name]
        np.testing.assert_array_equal(own, getattr(alone, name))
        np.testing.assert_array_equal(layer[2], own)
        np.testing.assert_array_equal(layer[3], own)  # a frame that is missing
        sure = aligned.geometric_confidence[1] > 0.9
        assert sure.mean() > 0.5
        # Whole-pixel vectors: nothing is interpolated.
        np.testing.assert_allclose(layer[1][sure], own[sure], atol=1e-5)
    still = FrameStream(open_shot(folder), only(set())).align(MIDDLE)
    assert not np.allclose(still.albedo[1][sure], still.albedo[2][sure], atol=0.01)  # something has moved
