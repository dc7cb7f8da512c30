import numpy as np
import pytest

from flow.guide import GuidePair
from flow.selection import select_flow
from tests.flow.scenes import HEIGHT, WIDTH, Shot, moved, plain

INNER = np.s_[10:-10, 10:-10]


@pytest.fixture(scope="module")
def shot() -> Shot:
    return moved()


def test_the_first_keeps_the_pixels_where_nothing_is_better(shot: Shot) -> None:
    selected, choice = select_flow([shot.flow, shot.flow + 0.02], shot.guides)
    assert not choice.any()
    np.testing.assert_array_equal(selected, shot.flow)


def test_the_best_is_taken_where_the_first_is_wrong(shot: Shot) -> None:
    wrong, worse = shot.flow.copy(), shot.flow + 5
    wrong[30:55, 40:65] += 3
    selected, choice = select_flow([wrong, worse, shot.flow], shot.guides)
    # Boxes of 9 px straddle the border of the patch.
    assert (choice[36:49, 46:59] == 2).mean() > 0.95
    assert (choice[70:] == 0).all()
    np.testing.assert_array_equal(selected[choice == 2], shot.flow[choice == 2])


def test_vectors_that_are_wrong_everywhere_lose_even_where_nothing_is_seen(shot: Shot) -> None:
    """One that beats them on most of the frame is the incumbent: it keeps also what a blank wall says nothing of."""
    centre, neighbour, noise = (planes.copy() for planes in shot.guides)
    for planes in (centre, neighbour):
        planes[30:60, 40:80] = 0.5
    guides = GuidePair(centre, neighbour, noise)
    _, choice = select_flow([shot.flow + 3, shot.flow], guides)
    assert (choice[36:54, 46:66] == 1).all()
    wrong_here = shot.flow.copy()
    wrong_here[30:60, 40:80] += 3
    _, choice = select_flow([wrong_here, shot.flow], guides)
    assert (choice[36:54, 46:66] == 0).all()  # they explain the rest, and nothing speaks against them here


def test_hidden_pixels_are_no_evidence(shot: Shot) -> None:
    candidates = [shot.flow + 3, shot.flow]
    _, choice = select_flow(candidates, shot.guides)
    assert choice[INNER].mean() > 0.9
    _, choice = select_flow(candidates, shot.guides, visible=np.zeros((HEIGHT, WIDTH), bool))
    assert not choice.any()


def test_what_leaves_the_frame_is_no_evidence() -> None:
    rng = np.random.default_rng(0)
    picture = rng.random((40, 40), np.float32)
    away, still = np.full((40, 40, 2), 100, np.float32), np.zeros((40, 40, 2), np.float32)
    for candidates in ([away, still], [still, away]):
        assert not select_flow(candidates, plain(picture, picture))[1].any()


def test_a_noisy_guide_counts_for_little() -> None:
    """The noisy one of two guides favors the first flow, the clean one the second."""
    rng = np.random.default_rng(1)
    left, right = rng.random((2, 48, 64), np.float32)
    still, step = np.zeros((48, 64, 2), np.float32), np.full((48, 64, 2), [4, 0], np.float32)
    centre = np.dstack([left, right])
    neighbour = np.dstack([left, np.roll(right, 4, axis=1)])
    for noisy, chosen in ((0, 1), (1, 0)):
        noise = np.zeros_like(centre)
        noise[..., noisy] = 0.5
        choice = select_flow([still, step], GuidePair(centre, neighbour, noise))[1]
        assert (choice[INNER] == chosen).mean() > 0.95


def test_given_arrays_are_not_written_to(shot: Shot) -> None:
    visible, flow = np.ones((HEIGHT, WIDTH), bool), shot.flow + 50  # much of it leaves the frame
    copies = [array.copy() for array in (*shot.guides, shot.flow)]
    select_flow([flow, shot.flow], shot.guides, visible=visible)
    assert visible.all()
    for array, copy in zip((*shot.guides, shot.flow), copies, strict=True):
        np.testing.assert_array_equal(array, copy)


def test_errors_name_the_argument() -> None:
    guides = plain(np.zeros((8, 9)), np.zeros((8, 9)))
    with pytest.raises(ValueError, match="candidates is empty"):
        select_flow([], guides)
    with pytest.raises(ValueError, match=r"candidates\[1\] has shape \(4, 9, 2\), expected \(8, 9, 2\)"):
        select_flow([np.zeros((8, 9, 2)), np.zeros((4, 9, 2))], guides)
