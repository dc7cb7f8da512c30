"""Memory held from one window to the next: no more than is declared, and no layer of one repeated pixel."""

from collections.abc import Mapping

import cv2
import numpy as np
import pytest

from hybrid.alignment.align import align
from hybrid.denoising.first_pass import PerFrame
from hybrid.denoising.plan import Rules
from hybrid.denoising.stabilize import Denoised, FrameDenoiser
from hybrid.denoising.stream import FrameStream, kept_planes
from hybrid.files.shots import open_shot
from tests.scenes import Function, Scene

# Few bright samples, as in most frames; large beside the small figures that are held too.
SCENE = Scene(height=96, width=128, frames=9, noise=0.1)
FIRST_PASS = PerFrame(lambda frame: cv2.blur(np.nan_to_num(frame.color), (9, 9)))
MIDDLE = SCENE.first + 4


def buffers(value, found):
    """Add the arrays that own the memory of a value, of whatever it is made."""
    if isinstance(value, np.ndarray):
        while isinstance(value.base, np.ndarray):
            value = value.base
        found[id(value)] = value
    elif isinstance(value, Mapping):
        buffers(tuple(value.values()), found)
    elif isinstance(value, list | tuple):
        for part in value:
            buffers(part, found)
    elif hasattr(value, "__dict__") and type(value).__module__.startswith(("hybrid.", "nlm.")):
        buffers(vars(value), found)
    return found


def planes(value):
    """Float32 planes of the memory of a value."""
    return sum(array.nbytes for array in buffers(value, {}).values()) / (4 * SCENE.height * SCENE.width)


def shot_of(folder, alpha=1.0):
    def cover(_, layers):
        opacity = np.full((SCENE.height, SCENE.width, 1), alpha, np.float32)
        layers["ViewLayer.Combined"] = np.dstack([layers["ViewLayer.Combined"], opacity])

    return open_shot(SCENE.write(folder, edit=cover))


@pytest.mark.parametrize("filters_guides", [False, True])
def test_no_more_is_held_than_memory_is_planned_for(tmp_path, filters_guides):
    """The greatest part of memory: `--max-memory` trusts the owner's own count of it."""
    shot, held = shot_of(tmp_path), []

    def denoise(aligned):
        held.append(planes((maker.stream._cache, maker._results)))
        return Denoised(aligned.centre.irradiance * aligned.modulation)

    rules = Rules(on=frozenset({"clean-guides"}))
    filter_guides = {"filter_guides": dict} if filters_guides else {}
    maker = FrameDenoiser(FrameStream(shot, rules, FIRST_PASS, **filter_guides), Function(denoise))
    for number in range(MIDDLE - 1, MIDDLE + 2):
        maker.make(number)
    declared = kept_planes(shot, Rules().allowed, FIRST_PASS, 2, filters_guides=filters_guides)
    assert max(held) <= declared


def test_a_mask_of_one_value_takes_no_memory(tmp_path):
    stream = FrameStream(shot_of(tmp_path), Rules(), FIRST_PASS)
    frame = stream.frame(MIDDLE)
    for mask in (frame.alpha, frame.valid, frame.motion.to_next.valid, frame.motion.to_previous.valid):
        assert mask.all()
        assert planes(mask) < 0.01


@pytest.mark.parametrize("guided", [True, False])
def test_what_cleans_guides_is_kept_for_those_who_read_them(tmp_path, guided):
    window = FrameStream(shot_of(tmp_path), Rules(), FIRST_PASS).window(MIDDLE)
    aligned = align(window, guided=guided)
    assert (aligned.geometric_confidence is not None) == guided
    assert (aligned.centre.clean_albedo is not None) == guided


def test_of_an_excess_only_bright_pixels_are_kept(tmp_path):
    maker = FrameDenoiser(
        FrameStream(shot_of(tmp_path), Rules(), FIRST_PASS),
        Function(lambda aligned: Denoised(aligned.centre.first_pass)),
    )
    maker.make(MIDDLE)
    result = maker._results[MIDDLE]
    for excess in (result.excess, result.passing):
        assert planes(excess) < 0.3  # a mask of a byte
        relative, bright = excess.layers
        assert relative.shape == bright.shape
        assert not relative[~bright].any()
