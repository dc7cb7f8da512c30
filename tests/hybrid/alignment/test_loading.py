"""Frames that are loaded: read once, without fireflies, and forgotten."""

from __future__ import annotations

import pytest

from hybrid.alignment.loading import LoadedFrames
from hybrid.files.frames import open_shot
from hybrid.plan import Rules
from tests.scenes import Scene

# Locked off. Frame numbers 1001 to 1012.
CALM = Scene(frames=12, step=(0, 0), height=48, width=64)


def test_frames_are_forgotten_but_those_that_are_held(tmp_path):
    frames = LoadedFrames(open_shot(CALM.write(tmp_path)), ())
    frames.load([1001, 1002, 1003])
    held = frames[1001]
    frames.load([1004, 1005], hold=[1001])
    assert frames[1001] is held
    assert frames.get(1002) is None
    assert frames.get(1004) is not None
    frames.load([0, 1001])
    assert (frames.get(0), frames.get(1005)) == (None, None)
    assert frames[1001] is held


@pytest.mark.parametrize(("shining", "lamp"), [((4, 5), False), ((4, 5, 6), True)])
def test_what_one_neighbour_shows_too_is_kept_and_what_both_show_is_a_lamp(tmp_path, shining, lamp):
    """Noise with long tails is bright in two frames by chance; it was put back into pictures as it was rendered."""

    def shine(index, layers):
        if index in shining:
            layers["ViewLayer.Combined"][20, 30] = 500

    frames = LoadedFrames(open_shot(CALM.write(tmp_path, edit=shine)), Rules())
    frames.load(range(1004, 1009))
    frame = frames[1006]
    assert frame.fireflies == 0
    assert frame.radiance[20, 30].mean() == pytest.approx(500, rel=1e-3)
    assert (frame.lamps is not None and bool(frame.lamps[20, 30])) == lamp


def test_frames_with_their_fireflies_are_kept_for_the_next_alone(tmp_path, monkeypatch):
    """Each is read once, though it is asked about those of both neighbours; a window holds no frame twice."""

    def everywhere(index, layers):
        layers["ViewLayer.Combined"][20, 2 + 5 * index] = 5000

    read = []
    monkeypatch.setattr(LoadedFrames, "_read_once", spied(LoadedFrames._read_once, read))
    shot = open_shot(CALM.write(tmp_path, edit=everywhere))
    reads = []
    monkeypatch.setattr(type(shot), "read", spied(type(shot).read, reads))
    frames = LoadedFrames(shot, Rules())
    for number in shot.numbers:
        frames.load(frames.around(number, 2))
        assert frames[number].fireflies == 1
        # The newest, whose fireflies the next one is asked about, and what was read to ask it about its own.
        assert set(frames._read) <= {number + 2, number + 3, shot.numbers[-1]}
    assert len(read) > len(reads) == len(shot.numbers)


def spied(function, calls):
    return lambda self, number: calls.append(number) or function(self, number)
