"""A highlight that moves otherwise than its wall: frames are averaged along its own motion, where it is."""

from dataclasses import replace

import cv2
import numpy as np
import pytest

from hybrid.alignment.align import _warp_along_surfaces, _warp_first_pass
from hybrid.denoising.denoisers import AverageDenoiser
from hybrid.denoising.first_pass import PerFrame
from hybrid.denoising.plan import DENOISED, NOISY, Rules
from hybrid.denoising.stream import FrameStream, plan_shot
from hybrid.files.shots import open_shot
from hybrid.run.memory import MemoryPlan
from hybrid.runtime.timing import Timings
from tests.scenes import Scene, denoise_view, grained

WALL = Scene(72, 112, 7, noise=0.2)
STILL = replace(WALL, step=(0, 0))
MIDDLE = WALL.first + 3
COLOR = "ViewLayer.Combined"
# A denoiser that blurs; the average should be its picture of the truth.
FIRST_PASS = PerFrame(lambda frame: cv2.GaussianBlur(frame.color, (0, 0), 1.0))
# The average alone: no samples correct it, and no result is averaged with it.
AVERAGE = Rules(off=frozenset({"stabilize", "restore-mean", "blend-samples", "fireflies"}))


# The highlight is too small a part of a tall frame to call for the stage.
RULES = Rules(on=frozenset({"reflections"}))


def near(index):
    """Where (H, W) the highlight is, as a bump of height 1."""
    y, x = np.mgrid[: WALL.height, : WALL.width]
    return np.exp(-((y - 30 - index) ** 2 + (x - 50 + index) ** 2) / 40).astype(np.float32)


def shine(index, layers):
    layers[COLOR] += grained(4 * near(index)[..., None], (5, index), 0.3)


def truth(scene, index):
    return cv2.GaussianBlur(scene.clean(index)[COLOR] + 4 * near(index)[..., None], (0, 0), 1.0)


def error(path, scene):
    made = open_shot(path).read(MIDDLE).color
    return float(np.square(made - truth(scene, 3))[near(3) > 0.05].mean())


@pytest.mark.parametrize("scene", [WALL, STILL])
def test_a_highlight_is_averaged_along_its_own_motion(tmp_path, scene):
    shot, errors = open_shot(scene.write(tmp_path / "in", edit=shine), frames=str(MIDDLE)), []
    for name, rules in (
        ("with", replace(AVERAGE, on=RULES.on)),
        ("without", replace(AVERAGE, off=AVERAGE.off | {"reflections"})),
    ):
        (made,) = denoise_view(shot, tmp_path / name, AverageDenoiser(Timings()), rules, FIRST_PASS)
        assert ("reflections" in made.plan.stages) == (name == "with")
        errors.append(error(tmp_path / name, scene))
    assert errors[0] < 0.75 * errors[1]


def test_the_plan_states_where_it_ran(tmp_path):
    shot = open_shot(WALL.write(tmp_path / "in", edit=shine))
    made = list(denoise_view(shot, tmp_path / "out", AverageDenoiser(Timings()), AVERAGE, FIRST_PASS))
    assert 0 < made[3].plan.shares["reflections"] < 0.3

    def decision(shot, context):
        return next(d for d in plan_shot(shot, context=context).decisions if d.stage == "reflections")

    assert decision(shot, DENOISED).on
    noisy = decision(shot, NOISY)
    assert not noisy.on
    assert noisy.reason.startswith("needs denoised frames; the vectors leave")
    calm = open_shot(replace(WALL, noise=0.02).write(tmp_path / "calm"))
    assert not decision(calm, DENOISED).on
    assert decision(open_shot(WALL.write(tmp_path / "no", without={"Vector"})), DENOISED).reason.startswith("no vec")


def test_bands_of_rows_make_no_difference(tmp_path):
    tall = np.zeros((520, 112), np.float32)

    def shine_low(index, layers):
        light = tall.copy()
        light[300:372] = near(index)
        layers[COLOR] += grained(4 * light[..., None], (5, index), 0.3)

    shot = open_shot(replace(WALL, height=520).write(tmp_path / "in", edit=shine_low), frames=str(MIDDLE))
    for rows in (None, 64):
        denoise, out = AverageDenoiser(Timings()), tmp_path / str(rows)
        (made,) = denoise_view(shot, out, denoise, RULES, FIRST_PASS, memory=MemoryPlan(rows))
        assert made.plan.shares["reflections"] > 0
    whole, bands = (open_shot(tmp_path / str(rows)).read(MIDDLE).color for rows in (None, 64))
    np.testing.assert_array_equal(bands, whole)


def test_guides_stay_on_their_surface_and_aovs_move_with_the_light(tmp_path):
    def edit(index, layers):
        shine(index, layers)
        layers["ViewLayer.Env"] = 4 * near(index)[..., None] * np.ones(3, np.float32)

    shot = open_shot(WALL.write(tmp_path / "in", edit=edit), aovs=["ViewLayer.Env"])
    aligned = FrameStream(shot, AVERAGE, FIRST_PASS).align(MIDDLE)
    inside = near(3) > 0.5
    for t in (1, 3):
        env = aligned.aovs["ViewLayer.Env"][t]
        assert np.abs(env - 4 * near(3)[..., None])[inside].mean() < 0.4
        assert np.abs(aligned.albedo[t] - aligned.albedo[2])[inside].max() < 1e-3


@pytest.mark.parametrize("rows", [slice(0, WALL.height), slice(20, 50), slice(64, 72)])
def test_samples_are_judged_along_surfaces(tmp_path, rows):
    """First passes are warped anew in the rows where light moves, and nowhere else."""
    stream = FrameStream(open_shot(WALL.write(tmp_path, edit=shine)), RULES, first_pass=FIRST_PASS)
    stream.keep(stream.around(MIDDLE, stream.support))
    window = stream.window(MIDDLE)
    assert window.reflecting[20:50].any()
    shape = len(window.frames), rows.stop - rows.start, WALL.width
    given = window.first_pass, np.ones(shape, np.float32), rows, Timings()
    along_light, _ = _warp_first_pass(window, *given, weigh=False)
    expected, _ = _warp_first_pass(replace(window, reflections=None), *given, weigh=False)
    assert (along_light == expected).all() != window.reflecting[rows].any()
    found = _warp_along_surfaces(window, given[0], along_light, *given[1:])
    np.testing.assert_array_equal(found, expected)
