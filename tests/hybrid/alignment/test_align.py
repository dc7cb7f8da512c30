"""What connects the frames of a window: flows, estimates, confidence, and the centre where nothing is trusted."""

from __future__ import annotations

from dataclasses import replace

import numpy as np
import pytest

from hybrid.alignment.align import Aligner
from hybrid.alignment.transfer import ALBEDO_FLOOR
from hybrid.estimates import OfFrames
from hybrid.files.frames import open_shot
from tests.scenes import Scene

STAGES = {"demodulate", "outliers", "warp"}
SCENE = Scene(frames=5)
MIDDLE = SCENE.first + 2
# Two frames' worth of a fast wall: 14 pixels to the right and 9 down are beyond what TV-L1 finds by itself.
FAST = Scene(height=96, width=128, step=(14, 9))
INNER = np.s_[24:-24, 32:-32]


def wrong_by_a_pixel(index, layers):
    """Vectors as a renderer gives them that knows of the wall, and not of what moves in it."""
    layers["ViewLayer.Vector"] += np.float32([1.2, -0.9, 1.2, -0.9])


def flow_error(folder, stages, **options) -> float:
    """Mean length, pixels, of what the flow to the next frame is off by, away from the border."""
    aligner = Aligner(open_shot(folder), stages, radius=1, **options)
    aligner.align(FAST.first + 1)
    flow, _ = aligner.flow(FAST.first + 1, FAST.first + 2)
    return float(np.hypot(*np.moveaxis(flow - np.float32(FAST.step), -1, 0))[INNER].mean())


@pytest.fixture(scope="module")
def fast_folder(tmp_path_factory):
    return FAST.write(tmp_path_factory.mktemp("fast"), edit=wrong_by_a_pixel)


def test_refinement_starts_from_the_vectors_and_its_result_is_used(fast_folder):
    assert flow_error(fast_folder, STAGES) == pytest.approx(1.5, abs=0.01)  # as they were written
    # The bound that the project sets itself for perturbed vectors.
    assert flow_error(fast_folder, STAGES | {"refine"}) < 0.2


def test_what_refines_is_given_the_vectors_of_the_renderer(fast_folder):
    seen = []

    def keep(guides, start):
        seen.append(start)
        return start

    assert flow_error(fast_folder, STAGES | {"refine"}, refine=keep) == pytest.approx(1.5, abs=0.01)
    # To the previous frame and to the next one, in our convention.
    found = sorted({tuple(float(f"{v:.3f}") for v in start[40, 50]) for start in seen})
    assert found == [(-12.8, -8.1), (12.8, 8.1)]


@pytest.mark.parametrize("part", [0.0, 0.25, 1.0])
def test_the_window_says_on_what_share_of_the_picture_vectors_were_solved_for(fast_folder, part):
    def solve(guides, start):
        solved = start.copy()
        solved[: round(part * len(start))] += 1
        return solved

    aligner = Aligner(open_shot(fast_folder), STAGES | {"refine"}, radius=1, refine=solve)
    assert aligner.align(FAST.first + 1).shares == {"refine": pytest.approx(part)}
    assert Aligner(open_shot(fast_folder), STAGES, radius=1).align(FAST.first + 1).shares == {}


def test_without_refinement_nothing_is_refined(fast_folder):
    def fail(guides, start):
        raise AssertionError("refined")

    assert flow_error(fast_folder, STAGES, refine=fail) == pytest.approx(1.5, abs=0.01)


def window(folder, **options):
    return Aligner(open_shot(folder), STAGES, **options).align(MIDDLE)


def test_the_centre_takes_the_place_of_what_is_not_trusted(tmp_path):
    aligned = window(SCENE.write(tmp_path))
    spoilt = aligned.color.copy()
    nowhere = aligned.confidence == 0
    assert 0.02 < nowhere.mean() < 0.5  # what has left the frame
    spoilt[nowhere] = 1e6
    mixed = replace(aligned, color=spoilt).mixed(spoilt)
    for index in range(5):
        np.testing.assert_array_equal(mixed[index][nowhere[index]], aligned.color[2][nowhere[index]])
        sure = aligned.confidence[index] == 1
        np.testing.assert_array_equal(mixed[index][sure], spoilt[index][sure])
    half = replace(aligned, confidence=np.full_like(aligned.confidence, 0.5))
    np.testing.assert_allclose(half.mixed(aligned.color)[0], (aligned.color[0] + aligned.color[2]) / 2, rtol=1e-6)


def test_estimates_are_aligned_as_the_frames_are(tmp_path):
    """An estimate that is the clean frame itself becomes the clean centre wherever a frame shows it."""
    clean = open_shot(SCENE.write(tmp_path / "clean", clean=True))
    source = OfFrames(lambda frame: clean.read(frame.number).color)
    aligned = window(SCENE.write(tmp_path / "noisy"), estimates=source)
    layers = SCENE.clean(2)
    light = layers["ViewLayer.Combined"] / (layers["ViewLayer.Denoising Albedo"] + ALBEDO_FLOOR)
    for estimate, confidence in zip(aligned.estimate, aligned.confidence, strict=True):
        sure = confidence > 0.5
        assert sure.mean() > 0.5
        # Whole-pixel vectors: nothing is interpolated; files are float32.
        np.testing.assert_allclose(estimate[sure], light[sure], rtol=1e-4)


def test_a_part_of_a_frame_is_that_part_of_the_whole(tmp_path):
    folder = Scene(height=448, width=40, frames=3).write(tmp_path)
    number = SCENE.first + 1
    whole, part = (Aligner(open_shot(folder), STAGES, radius=1).align(number, rows) for rows in (None, slice(64, 128)))
    assert part.color.shape[1] < 448
    for name in ("color", "albedo", "normal", "confidence"):
        np.testing.assert_array_equal(getattr(part, name)[:, part.inner], getattr(whole, name)[:, 64:128])
    np.testing.assert_array_equal(part.modulation[part.inner], whole.modulation[64:128])
    assert part.exposure == whole.exposure
    np.testing.assert_array_equal(part.moments, whole.moments)


def test_frames_that_are_missing_have_no_confidence(tmp_path):
    folder = SCENE.write(tmp_path)
    (folder / f"shot.{MIDDLE + 1}.exr").unlink()
    aligned = window(folder)
    assert not aligned.confidence[3:].any()
    np.testing.assert_array_equal(aligned.color[3], aligned.color[2])
    assert aligned.confidence[1].mean() > 0.5


def test_the_guides_of_all_frames_are_aligned_as_these_are(tmp_path):
    """When they are asked for; the centre's are there in any case."""
    folder = SCENE.write(tmp_path)
    (folder / f"shot.{MIDDLE + 1}.exr").unlink()
    aligned, alone = window(folder), open_shot(folder).read(MIDDLE)
    for name in ("albedo", "normal"):
        layer, own = getattr(aligned, name), aligned.guides[name]
        np.testing.assert_array_equal(own, getattr(alone, name))
        np.testing.assert_array_equal(layer[2], own)
        np.testing.assert_array_equal(layer[3], own)  # a frame that is missing
        sure = aligned.trust[1] > 0.9
        assert sure.mean() > 0.5
        # Whole-pixel vectors: nothing is interpolated.
        np.testing.assert_allclose(layer[1][sure], own[sure], atol=1e-5)
    still = Aligner(open_shot(folder), set()).align(MIDDLE)
    assert not np.allclose(still.albedo[1][sure], still.albedo[2][sure], atol=0.01)  # something has moved
