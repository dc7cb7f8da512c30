from dataclasses import replace

import numpy as np
import pytest

from hybrid.comparison.metrics import psnr
from hybrid.denoising.pseudo_reference import CLASSICAL_PRESETS, DRAFT, FINAL, STANDARD, filter_window
from hybrid.denoising.stream import FrameStream
from hybrid.files.shots import open_shot
from nlm.average import robust_average
from tests.scenes import Scene, only

MOVING = {"demodulate", "outliers", "warp"}
SCENE = Scene(frames=5)
MIDDLE = SCENE.first + 2


def align(folder, stages=MOVING, number=MIDDLE, **options):
    return FrameStream(open_shot(folder), only(stages), **options).align(number)


def test_exact_vectors_bring_every_frame_onto_the_centre(tmp_path):
    window = align(SCENE.write(tmp_path, clean=True))
    assert window.confidence.shape == (5, SCENE.height, SCENE.width)
    radiance = window.color * window.modulation
    truth = SCENE.clean(2)["ViewLayer.Combined"]
    for frame, confidence in zip(radiance, window.confidence, strict=True):
        # Whole-pixel vectors: the warp interpolates nothing; the division by albedo rounds.
        np.testing.assert_allclose(frame[confidence > 0.5], truth[confidence > 0.5], rtol=1e-5)
    # The frame two steps away has moved 4 px right and 2 down; the 3×3 minimum takes one more row and column.
    assert window.confidence[0][4:-4, 6:-6].min() > 0.9
    assert window.confidence[4][4:-4, 6:-6].min() > 0.9


@pytest.mark.parametrize("number", [SCENE.first, SCENE.first + SCENE.frames - 1])
def test_the_first_and_the_last_frame_lack_neighbours_and_are_estimated_all_the_same(tmp_path, number):
    window = align(SCENE.write(tmp_path), number=number)
    absent = slice(0, 2) if number == SCENE.first else slice(3, 5)
    assert (window.confidence[absent] == 0).all()
    assert (window.confidence[2] == 1).all()
    assert np.isfinite(filter_window(window, STANDARD)).all()


def test_a_hole_in_the_sequence_is_a_narrower_window(tmp_path):
    folder = SCENE.write(tmp_path)
    (folder / f"shot.{MIDDLE - 1}.exr").unlink()
    window = align(folder)
    # Flows are chained over the frame that is missing, so what lies beyond it cannot be reached.
    assert (window.confidence[:2] == 0).all()
    assert window.confidence[3:].max() > 0.9


def test_each_preset_beats_the_robust_average_and_final_the_noisy_frame_by_six_decibels(tmp_path):
    window = align(SCENE.write(tmp_path))
    truth = SCENE.clean(2)["ViewLayer.Combined"]
    noisy = psnr(SCENE.noisy(2)["ViewLayer.Combined"], truth)
    robust = psnr(robust_average(window.color, window.confidence) * window.modulation, truth)
    for preset in CLASSICAL_PRESETS.values():
        assert psnr(filter_window(window, preset), truth) > robust + 1
    assert psnr(filter_window(window, FINAL), truth) > noisy + 6


def test_draft_leaves_out_what_a_single_frame_shows(tmp_path):
    """Its average is the robust one: a ghost in one of five frames is the maximum, and not averaged in."""
    window = align(SCENE.write(tmp_path))
    ghost = window.color.copy()
    ghost[1, 12:28, 16:40] += 50
    seen = (replace(window, aligned_color=color) for color in (window.color, ghost))
    plain, haunted = (filter_window(shown, DRAFT) for shown in seen)
    inner = np.s_[14:26, 20:36]  # where four frames at least show the wall
    assert (window.confidence[:, *inner] > 0.9).all()
    # The ghost takes the place of what was the maximum before: a fifth of the noise, and not a fifth of 50.
    assert np.abs(haunted - plain)[inner].max() < 1
    assert np.abs(haunted - plain)[inner].max() > 0


def test_without_vectors_the_motion_is_found(tmp_path):
    scene = Scene(height=64, width=96, noise=0.05)
    folder = scene.write(tmp_path, without={"Vector"})
    aligner = FrameStream(open_shot(folder), only(MOVING | {"dense-flow"}))
    aligner.align(scene.first + 1)
    inner = aligner.flow(scene.first + 1, scene.first + 2)[0][16:-16, 16:-16]
    # The wall's 4 px squares have straight edges; most of the picture must be found to half a pixel.
    error = np.hypot(inner[..., 0] - scene.step[0], inner[..., 1] - scene.step[1])
    assert np.median(error) < 0.5


def test_aovs_travel_along_and_sum_to_the_beauty(tmp_path):
    def split(index, layers):
        layers["direct"] = 0.25 * layers["ViewLayer.Combined"]
        layers["indirect"] = 0.75 * layers["ViewLayer.Combined"]

    shot = open_shot(SCENE.write(tmp_path, edit=split), aovs=("direct", "indirect"))
    window = FrameStream(shot, only({"warp"})).align(MIDDLE)
    np.testing.assert_allclose(window.aovs["direct"] + window.aovs["indirect"], window.color, rtol=1e-5)
