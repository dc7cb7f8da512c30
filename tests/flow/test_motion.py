from pathlib import Path

import numpy as np
import pytest

from flow.motion import CYCLES, MotionConvention, compose_flow, forward_backward_error, invert_flow, normalize_motion
from flow.warp import warp

DATA = Path(__file__).parents[1] / "data"


def translation(height: int, width: int, u: float, v: float) -> np.ndarray:
    return np.broadcast_to(np.float32([u, v]), (height, width, 2))


def affine(height: int, width: int, matrix: np.ndarray, shift: np.ndarray) -> np.ndarray:
    """The flow that takes (x, y) to matrix · (x, y) + shift, about the centre."""
    y, x = np.mgrid[:height, :width].astype(np.float64)
    place = np.stack([x - (width - 1) / 2, y - (height - 1) / 2], axis=-1)
    return (place @ matrix.T + shift - place).astype(np.float32)


def test_cycles_convention_on_a_render_of_a_known_translation() -> None:
    """The plane of `data/render_translation.py` moves by (+3, -2) and then by (+4, +1) pixels."""
    with np.load(DATA / "translation_cycles.npz") as data:
        previous, centre, following = (data[f"frame{i}"].astype(np.float32) for i in (1, 2, 3))
        motion = normalize_motion(data["vector"], CYCLES)
    assert motion.to_previous is not None
    assert motion.to_next is not None
    # A point that moved by (+3, -2) came from (-3, +2). 1e-3 px: the render's own rounding.
    np.testing.assert_allclose(motion.to_previous.flow, translation(*centre.shape, -3, 2), atol=1e-3)
    np.testing.assert_allclose(motion.to_next.flow, translation(*centre.shape, 4, 1), atol=1e-3)
    assert motion.to_previous.valid.all()
    assert motion.to_next.valid.all()
    for neighbour, flow in ((previous, motion.to_previous.flow), (following, motion.to_next.flow)):
        warped, inside = warp(neighbour, flow)
        right = np.abs(warped - centre)[inside].mean()
        others = [
            np.abs(warp(neighbour, wrong)[0] - centre)[inside].mean()
            for wrong in (0 * flow, -flow, flow * [1, -1], flow * [-1, 1], flow[..., ::-1])
        ]
        # The noise of 64 samples per pixel against the texture's contrast of 0.07.
        assert right < 0.002
        assert min(others) > 0.02


def test_plain_vectors_are_offsets_to_the_previous_frame() -> None:
    vectors = np.random.default_rng(0).normal(size=(4, 6, 2)).astype(np.float32)
    motion = normalize_motion(vectors, MotionConvention())
    np.testing.assert_array_equal(motion.to_previous.flow, vectors)
    assert motion.to_next is None


# One motion of 6 px to the right and 3 px down, to the next frame, in a picture of 120 x 60, as others write it.
@pytest.mark.parametrize(
    ("written", "convention"),
    [
        ([6, 3], MotionConvention("next")),
        ([6, -3], MotionConvention("next", y="up")),
        ([0.05, 0.05], MotionConvention("next", "ndc")),
        ([0.1, -0.1], MotionConvention("next", "half-ndc", y="up")),
        ([0.05, 0.025], MotionConvention("next", "screen")),
        ([3, 1.5], MotionConvention("next", scale=2)),
        ([-6, -3], MotionConvention("next", scale=-1)),
        ([6.25, 3.25], MotionConvention("next", offset=-0.25)),
        ([0.875, 0.6875], MotionConvention("next", scale=8, encoding="gray")),
        ([0.5 + 0.5 * 0.8, 0.5 - 0.5 * 0.6, 5], MotionConvention("next", y="up", scale=1, encoding="magnitude")),
        ([9, 9, 6, 3], MotionConvention("both")),
        ([9, 9, -6, 3], MotionConvention("cycles", y="up")),
        ([6, 3, 7, 7], MotionConvention("next")),
    ],
    ids=str,
)
def test_every_convention_gives_the_same_flow(written: list[float], convention: MotionConvention) -> None:
    expected = (4, 3) if convention.encoding == "magnitude" else (6, 3)
    vectors = np.broadcast_to(np.float32(written), (2, 3, len(written)))
    motion = normalize_motion(vectors, convention, resolution=(60, 120))
    assert (motion.to_previous is None) == (not convention.pair)
    assert motion.to_next is not None
    assert motion.to_next.valid.all()
    # Rounding of float32 below 10.
    np.testing.assert_allclose(motion.to_next.flow, np.broadcast_to(np.float32(expected), (2, 3, 2)), atol=1e-5)


def test_ndc_counts_in_the_whole_picture_and_not_in_what_is_stored_of_it() -> None:
    vectors = np.full((2, 3, 2), 0.5, np.float32)
    cropped = normalize_motion(vectors, MotionConvention(unit="ndc"), resolution=(60, 120)).to_previous
    assert cropped is not None
    np.testing.assert_array_equal(cropped.flow[0, 0], [60, 30])
    whole = normalize_motion(vectors, MotionConvention(unit="ndc")).to_previous
    assert whole is not None
    np.testing.assert_array_equal(whole.flow[0, 0], [1.5, 1])


def test_conventions_say_themselves_in_the_words_of_the_option() -> None:
    assert str(CYCLES) == "cycles,pixels,y-up"
    assert str(MotionConvention("next", "ndc", scale=0.5, encoding="gray")) == "next,ndc,y-down,gray,scale=0.5"


def test_absurd_vectors_are_zero_and_reported() -> None:
    vectors = np.ones((3, 4, 4), np.float32)
    vectors[0, 0, 0], vectors[1, 1, 1], vectors[2, 2, 2], vectors[0, 3] = np.nan, np.inf, 1e9, -1e10
    motion = normalize_motion(vectors, CYCLES)
    assert motion.to_next is not None
    np.testing.assert_array_equal(np.argwhere(~motion.to_previous.valid), [[0, 0], [0, 3], [1, 1]])
    np.testing.assert_array_equal(np.argwhere(~motion.to_next.valid), [[0, 3], [2, 2]])
    assert not motion.to_previous.flow[~motion.to_previous.valid].any()
    assert not motion.to_next.flow[~motion.to_next.valid].any()
    assert np.isfinite(motion.to_previous.flow).all()


def test_what_is_no_convention_is_refused() -> None:
    with pytest.raises(ValueError, match="direction of motion is 'houdini', expected one of previous, next,"):
        MotionConvention("houdini")
    with pytest.raises(ValueError, match="unit of motion is 'inches', expected one of pixels, ndc"):
        MotionConvention(unit="inches")
    with pytest.raises(ValueError, match="scale of motion is nan, expected a number"):
        MotionConvention(scale=float("nan"))
    with pytest.raises(ValueError, match="scale of motion is 0, expected"):
        MotionConvention(scale=0)
    with pytest.raises(ValueError, match=r"expected \(H, W, 4 or more\) for cycles,pixels,y-up"):
        normalize_motion(np.zeros((2, 2, 2)), CYCLES)


def test_composition_of_translations_is_their_sum() -> None:
    flow, valid = compose_flow(translation(8, 9, 1.25, -2), translation(8, 9, 0.5, 3))
    np.testing.assert_array_equal(flow, translation(8, 9, 1.75, 1))
    # Only the first step must land in the frame: x + 1.25 <= 8.5, y - 2 >= -0.5.
    expected = np.zeros((8, 9), bool)
    expected[2:, :8] = True
    np.testing.assert_array_equal(valid, expected)


def test_composition_of_affine_flows_is_the_affine_composition() -> None:
    a, s = np.array([[1.02, 0.03], [-0.02, 0.98]]), np.array([1.5, -0.7])
    b, t = np.array([[0.97, -0.04], [0.05, 1.01]]), np.array([-2.2, 0.4])
    flow, valid = compose_flow(affine(40, 50, a, s), affine(40, 50, b, t))
    inner = valid & warp(np.zeros((40, 50)), affine(40, 50, a, s) * np.float32(1.2))[1]
    # Bilinear sampling is exact on a linear function, up to float32 rounding of positions below 64.
    difference = np.abs(flow - affine(40, 50, b @ a, b @ s + t)).max(axis=-1)
    assert inner.mean() > 0.9
    assert difference[1:-1, 1:-1][inner[1:-1, 1:-1]].max() < 0.05
    assert np.median(difference) < 1e-5


def test_composition_needs_every_vector_it_mixes() -> None:
    bad = np.ones((6, 6), bool)
    bad[3, 3] = False
    _, valid = compose_flow(translation(6, 6, 0.5, 0), translation(6, 6, 0, 0), second_valid=bad)
    np.testing.assert_array_equal(np.argwhere(~valid), [[3, 2], [3, 3]])
    _, valid = compose_flow(translation(6, 6, 0, 0), translation(6, 6, 0, 0), first_valid=bad)
    np.testing.assert_array_equal(np.argwhere(~valid), [[3, 3]])


def test_flows_of_different_sizes_are_not_chained() -> None:
    with pytest.raises(ValueError, match=r"first has shape \(3, 6, 2\), expected that of second, \(6, 6, 2\)"):
        compose_flow(translation(3, 6, 0, 0), translation(6, 6, 0, 0))


@pytest.mark.parametrize("shift", [(0, 0), (3, -2), (0.4, 0.25)])
def test_inverse_of_a_translation(shift: tuple[float, float]) -> None:
    inverse, arrived = invert_flow(translation(12, 15, *shift))
    np.testing.assert_allclose(inverse[arrived], np.broadcast_to(-np.float32(shift), inverse[arrived].shape), atol=1e-6)
    assert arrived.mean() > 0.6


def test_inverse_of_an_affine_flow() -> None:
    a, s = np.array([[1.03, 0.02], [-0.02, 1.01]]), np.array([1.5, -0.7])
    inverse, arrived = invert_flow(affine(40, 50, a, s))
    b = np.linalg.inv(a)
    expected = affine(40, 50, b, -b @ s)
    # Vectors within a pixel are averaged: their spread is at most a pixel times the slope of 0.03.
    assert np.abs(inverse - expected)[arrived].max() < 0.05
    # Stretched by 3 %, the vectors' pixels still overlap everywhere inside.
    assert arrived[4:-4, 4:-4].all()


def test_the_nearest_surface_wins_and_what_it_uncovers_has_no_vector() -> None:
    """A square that moves 5 px right in front of a resting ground; the flow given is that of the later frame."""
    flow, depth = np.zeros((20, 30, 2), np.float32), np.full((20, 30), 10, np.float32)
    flow[6:14, 12:20, 0], depth[6:14, 12:20] = -5, 2
    for given in (depth, None):
        inverse, arrived = invert_flow(flow, depth=given)
        expected = np.zeros((20, 30))
        expected[6:14, 7:15] = 5
        hidden = np.zeros((20, 30), bool)
        hidden[6:14, 15:20] = True  # ground that the square has covered in the later frame
        np.testing.assert_array_equal(arrived, ~hidden)
        np.testing.assert_allclose(inverse[..., 0][arrived], expected[arrived], atol=1e-6)
    behind, _ = invert_flow(flow, depth=20 - depth)
    # Now the ground, which uncovers nothing before column 12, lies in front.
    assert not behind[6:14, 7:12, 0].any()


def test_inverse_leaves_out_what_is_invalid() -> None:
    flow = np.zeros((5, 5, 2), np.float32)
    flow[2, 2] = np.nan
    inverse, arrived = invert_flow(flow)
    np.testing.assert_array_equal(np.argwhere(~arrived), [[2, 2]])
    assert not inverse.any()
    valid = np.ones((5, 5), bool)
    valid[1, 3] = False
    _, arrived = invert_flow(np.zeros((5, 5, 2)), valid=valid)
    np.testing.assert_array_equal(np.argwhere(~arrived), [[1, 3]])


def test_going_there_and_back() -> None:
    flow = affine(30, 30, np.array([[1.02, 0], [0, 0.99]]), np.array([1.0, 0.5]))
    reverse, _ = invert_flow(flow)
    # As for the affine inverse.
    assert forward_backward_error(flow, reverse)[4:-4, 4:-4].max() < 0.05
    np.testing.assert_allclose(forward_backward_error(flow, reverse + np.float32([3, 4]))[4:-4, 4:-4], 5, atol=0.1)
