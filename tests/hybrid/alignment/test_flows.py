import numpy as np
import pytest

from hybrid.denoising.stream import FrameStream
from hybrid.files.shots import open_shot
from tests.scenes import Scene, only

STAGES = {"demodulate", "outliers", "warp"}
# Two frames' worth of a fast wall: 14 pixels to the right and 9 down are beyond what TV-L1 finds by itself.
FAST = Scene(height=96, width=128, step=(14, 9))
INNER = np.s_[24:-24, 32:-32]


def wrong_by_a_pixel(index, layers):
    """Vectors as a renderer gives them that knows of the wall, and not of what moves in it."""
    layers["ViewLayer.Vector"] += np.float32([1.2, -0.9, 1.2, -0.9])


def flow_error(folder, stages, **options) -> float:
    """Mean length, pixels, of what the flow to the next frame is off by, away from the border."""
    aligner = FrameStream(open_shot(folder), only(stages), radius=1, **options)
    flow, _ = aligner.flow(FAST.first + 1, FAST.first + 2)
    return float(np.hypot(*np.moveaxis(flow - np.float32(FAST.step), -1, 0))[INNER].mean())


@pytest.fixture(scope="module")
def fast_folder(tmp_path_factory):
    return FAST.write(tmp_path_factory.mktemp("fast"), edit=wrong_by_a_pixel)


def test_flows_over_several_frames_are_not_kept_beyond_their_window(tmp_path):
    """They are a fifth of the memory of a window of seven frames while it is denoised."""
    scene = Scene(frames=5, height=48)
    stream = FrameStream(open_shot(scene.write(tmp_path)), only(STAGES))
    window = stream.window(scene.first + 2)
    np.testing.assert_array_equal(window.links[0].forward.vectors[24, 30], [-4, -2])
    kept = {frames for kind, frames in stream._cache if kind == "flows"}
    assert kept == {(n, n + 1) for n in range(scene.first, scene.first + 4)}


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

    aligner = FrameStream(open_shot(fast_folder), only(STAGES | {"refine"}), radius=1, refine=solve)
    assert aligner.window(FAST.first + 1).refined == pytest.approx((part,) * 4)
    assert FrameStream(open_shot(fast_folder), only(STAGES), radius=1).window(FAST.first + 1).refined == ()


def test_without_refinement_nothing_is_refined(fast_folder):
    def fail(guides, start):
        raise AssertionError("refined")

    assert flow_error(fast_folder, STAGES, refine=fail) == pytest.approx(1.5, abs=0.01)
