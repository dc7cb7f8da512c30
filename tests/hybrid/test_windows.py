"""One odd window in a calm shot: what it calls for runs there, whatever part of the shot is asked for."""

from dataclasses import replace

import numpy as np
import pytest

from hybrid.alignment.noise import fixed_noise
from hybrid.alignment.prepare import prepare
from hybrid.cli import main
from hybrid.denoising.first_pass import PerFrame
from hybrid.denoising.plan import DENOISED, NOISY, STAGES, Rules
from hybrid.denoising.pseudo_reference import STANDARD, filter_window, gated_average
from hybrid.denoising.stabilize import Denoised
from hybrid.denoising.stream import FrameStream, plan_shot
from hybrid.files.exr import read_exr
from hybrid.files.shots import open_shot
from hybrid.run.records import read_records
from tests.scenes import Function, Scene, denoise_view
from tests.seldom import seldom

# Locked off: what is odd is odd by itself. Frame numbers 1001 to 1012; the odd one is 1009.
CALM = Scene(frames=12, step=(0, 0), height=48, width=64)
ODD = 8
FORCED = Rules(on=frozenset({"warp", "gate", "fireflies"}))


def brighter(index, layers):
    if index == ODD:
        layers["ViewLayer.Combined"] *= 5


def switched(index, layers):
    if index >= ODD:
        layers["ViewLayer.Combined"] *= np.float32(0.2)


def half(index, layers):
    if index == ODD:
        layers["ViewLayer.Combined"][:24] *= 4


def cut(index, layers):
    for name in ("ViewLayer.Combined", "ViewLayer.Denoising Albedo") if index >= ODD else ():
        layers[name] = np.ascontiguousarray(layers[name][::-1, ::-1])


def moving(index, layers):
    """From frame 1009 to 1011 the wall slides by three pixels per frame, and stops."""
    shift = 3 * min(max(index - ODD, 0), 3)
    for name in layers:
        if name != "ViewLayer.Vector":
            layers[name] = np.roll(layers[name], shift, axis=1)
    vector = layers["ViewLayer.Vector"]
    # The previous frame is sampled at (x + X, y - Y), the next one at (x - Z, y + W).
    vector[..., 0] = -3 if ODD < index <= ODD + 3 else 0
    vector[..., 2] = -3 if ODD <= index < ODD + 3 else 0


def burnt(index, layers):
    if index == ODD:
        layers["ViewLayer.Combined"][20, 30] = 5000


def picture(shot, number, rules, first_pass=None):
    window = FrameStream(shot, rules, first_pass).align(number)
    return filter_window(window, STANDARD) if first_pass is None else gated_average(window)


@pytest.mark.parametrize("change", [brighter, switched, moving, burnt])
@pytest.mark.parametrize("given", [False, True])
def test_every_frame_is_as_good_as_with_everything_on(tmp_path, change, given):
    shot = open_shot(CALM.write(tmp_path, edit=change))
    estimates = PerFrame(lambda frame: frame.color) if given else None
    for number in (1007, 1009):
        planned = picture(shot, number, Rules(), estimates)
        forced = picture(shot, number, FORCED, estimates)
        assert planned.mean() == pytest.approx(forced.mean(), rel=0.01), number
        error, bound = (np.abs(image - truth(change, number)).mean() for image in (planned, forced))
        assert error < 1.05 * bound, number  # 0.2 dB are 1.02 in amplitude; noise decides which pixels count


def truth(change, number):
    index = number - CALM.first
    layers = CALM.clean(index)
    if change is not burnt:
        change(index, layers)
    return layers["ViewLayer.Combined"]


def test_the_plan_says_on_which_frames_a_stage_runs(tmp_path):
    found = {d.stage: d for d in plan_shot(open_shot(CALM.write(tmp_path, edit=brighter)), context=NOISY).decisions}
    assert found["gate"].frames == tuple(range(1007, 1012))
    assert "frames 1007-1011 of 1001-1012" in found["gate"].reason
    assert found["warp"].frames == ()
    found = {d.stage: d for d in plan_shot(open_shot(CALM.write(tmp_path, edit=moving)), context=NOISY).decisions}
    assert found["warp"].frames == tuple(range(1008, 1013))
    assert not found["gate"].on
    found = {d.stage: d for d in plan_shot(open_shot(CALM.write(tmp_path, edit=burnt)), context=NOISY).decisions}
    assert found["fireflies"].frames == tuple(range(1007, 1012))


@pytest.mark.parametrize("change", [brighter, *seldom(moving, burnt, switched, half, cut)])
def test_a_frame_is_the_same_whatever_part_of_the_shot_is_asked_for(tmp_path, change):
    folder = CALM.write(tmp_path / "in", edit=change)

    def run(name, frames):
        shot = open_shot(folder, frames=frames)
        estimates = PerFrame(lambda frame: frame.color)
        for _ in denoise_view(
            shot, tmp_path / name, Function(lambda w: Denoised(gated_average(w))), Rules(), first_pass=estimates
        ):
            pass

    run("whole", None)
    for part in ("1001-1004", "1005", "1006-1008", "1009-1012"):
        run("parts", part)
    whole = sorted((tmp_path / "whole").glob("*.exr"))
    assert len(whole) == 12
    for path in whole:
        one, other = read_exr(path), read_exr(tmp_path / "parts" / path.name)
        assert one.parts[0].header["ravg/stages"] == other.parts[0].header["ravg/stages"]
        for name in one.channel_names:
            np.testing.assert_array_equal(one.channel(name), other.channel(name), err_msg=f"{path.name} {name}")


@pytest.mark.parametrize("step", [(0, 0), (2, 1)])
def test_a_lamp_that_estimates_have_lost_has_its_light_once(tmp_path, step):
    """OIDN, which sees one frame, takes a lamp of a pixel for a firefly; and what it left of it came on top.

    A hundredth of its light was left, and the mean of the samples spread the rest over the frame: 5 % everywhere.
    """
    scene = replace(CALM, frames=5, step=step)

    def lit(index, layers):
        layers["ViewLayer.Combined"][20 + step[1] * index, 30 + step[0] * index] = 500

    blind = PerFrame(lambda frame: np.minimum(frame.color, 5))

    def run(name, edit, rules):
        shot = open_shot(scene.write(tmp_path / name, edit=edit))
        out = tmp_path / f"{name}_out"
        for _ in denoise_view(shot, out, Function(lambda w: Denoised(gated_average(w))), rules, first_pass=blind):
            pass
        return read_exr(out / "shot.1003.exr").pixels(("ViewLayer.Combined.R",))[..., 0]

    made, dark = run("lit", lit, Rules()), run("dark", None, Rules())
    at = 20 + 2 * step[1], 30 + 2 * step[0]
    assert run("off", lit, Rules(off=frozenset({"fireflies", "blend-samples"})))[at] < 6
    assert made[at] == pytest.approx(500, rel=2e-3)
    around = np.s_[at[0] - 4 : at[0] + 5, at[1] - 4 : at[1] + 5]
    assert made[around].sum() == pytest.approx(500 + dark[around].sum(), rel=0.01)
    made[around] = dark[around]
    assert np.median(np.abs(made / dark - 1)) < 0.01


def test_what_fireflies_take_with_them_is_counted(tmp_path):
    shot = open_shot(CALM.write(tmp_path, edit=burnt))
    frame = FrameStream(shot, Rules()).frame(1009)
    assert frame.fireflies == 1
    assert frame.removed_radiance == pytest.approx(
        5000 / np.prod(CALM.clean(0)["ViewLayer.Combined"].shape[:2]), rel=0.2
    )
    estimated = picture(shot, 1009, Rules(), PerFrame(lambda frame: frame.color))
    clean = CALM.clean(ODD)["ViewLayer.Combined"]
    np.testing.assert_array_less(estimated[14:27, 24:37], 3 * clean[14:27, 24:37].max())
    spread = picture(shot, 1009, Rules(off=frozenset({"fireflies", "outliers", "gate"})), PerFrame(lambda f: f.color))
    assert spread.max() > 100  # that is what is guarded against


def test_the_mean_of_a_shot_with_and_without_fireflies_is_on_record(tmp_path):
    folder = CALM.write(tmp_path / "in", edit=burnt)
    words = ["denoise", str(folder), "-o", str(tmp_path / "out"), "--preset", "draft", "--frames", "1008-1010"]
    assert main(words) == 0
    ((_, record),) = read_records(tmp_path / "out")
    shot = open_shot(folder, frames="1008-1010")
    means = [float(shot.read(number).color.mean()) for number in shot.numbers]
    assert record["mean"]["with_fireflies"] == pytest.approx(np.mean(means), rel=1e-4)  # pixels of float32 are summed
    lost = 5000 / shot.read(1009).color[..., 0].size  # what else was there is a thousandth of it
    assert means[1] * record["frames"]["1009"]["light_removed"] == pytest.approx(lost, rel=0.01)
    kept = np.mean(means) - lost / 3
    assert record["mean"]["without"] == pytest.approx(kept, rel=0.01)


@pytest.mark.parametrize("samples", [16, 4096, *seldom(256)])
@pytest.mark.parametrize("step", [(0, 0), (3, 1)])
@pytest.mark.parametrize("fixed", [False, True])
@pytest.mark.parametrize("vectors", [True, False])
def test_noise_that_stands_still_is_told_from_detail(samples, step, fixed, vectors):
    """Detail of a single pixel, which no smoothing keeps, correlates at equal pixels as much as a fixed noise does."""
    scene = Scene(height=96, width=128, step=step)
    detail = np.random.default_rng(2).uniform(0.5, 1.5, (400, 400, 1)).astype(np.float32)

    def frame(index):
        layers = scene.clean(index)
        y, x = 200 - step[1] * index, 200 - step[0] * index
        shape = samples / 4
        grain = (
            np.random.default_rng(5 if fixed else 5 + index).gamma(shape, 1 / shape, (96, 128, 1)).astype(np.float32)
        )
        color = layers["ViewLayer.Combined"] * detail[y : y + 96, x : x + 128] * grain
        made = hard_frame(layers, color, index)
        return prepare(made if vectors else replace(made, motion=None, motion_convention=None))

    # A pixel or two that noise alone changes are enough for it to be asked of a still picture too.
    found = fixed_noise(frame(0), frame(1), moves=any(step) or not fixed)
    assert found > 0.6 if fixed else abs(found) < 0.15


@pytest.mark.parametrize("shared", [0, 0.5, 0.9])
def test_noise_that_a_slow_pan_shares_in_part_is_found(shared):
    """With one seed the samples of a pixel follow nearly the same paths: no value is equal, but half of the noise."""
    scene = Scene(height=96, width=128, step=(1, 0))

    def frame(index):
        common, own = (np.random.default_rng(seed).normal(size=(96, 128, 1)) for seed in (5, 6 + index))
        grain = np.exp(0.4 * (np.sqrt(shared) * common + np.sqrt(1 - shared) * own))
        layers = scene.clean(index)
        return prepare(hard_frame(layers, layers["ViewLayer.Combined"] * grain, index))

    found = fixed_noise(frame(0), frame(1), moves=True)
    assert found == pytest.approx(shared, abs=0.1)


def hard_frame(layers, color, index):
    from flow.motion import CYCLES
    from hybrid.files.frame import Frame

    return Frame(
        number=index,
        color=color.astype(np.float32),
        albedo=layers["ViewLayer.Denoising Albedo"],
        normal=layers["ViewLayer.Denoising Normal"],
        motion=layers["ViewLayer.Vector"],
        motion_convention=CYCLES,
    )


@pytest.mark.parametrize("stage", sorted(STAGES))
def test_every_stage_can_be_forced_either_way(tmp_path, stage):
    shot = open_shot(replace(CALM, frames=5, step=(2, 1)).write(tmp_path, edit=burnt))
    for rules, there in ((Rules(on=frozenset({stage})), True), (Rules(off=frozenset({stage})), False)):
        # With a first pass outliers are not rejected.
        first_pass = None if stage == "outliers" else PerFrame(lambda frame: frame.color)
        window = FrameStream(shot, rules, first_pass, filter_guides=dict).align(1003)
        assert (stage in window.stages) == there
        context = NOISY if stage == "outliers" else DENOISED
        decision = next(d for d in plan_shot(shot, rules, context=context).decisions if d.stage == stage)
        assert (decision.on, decision.forced) == (there, True)


def test_dense_flow_forced_on_leaves_the_vectors_alone_and_forced_off_has_no_neighbours(tmp_path):
    moving_scene = replace(CALM, frames=5, step=(3, 0))
    wrong = open_shot(moving_scene.write(tmp_path / "wrong", edit=lambda i, layers: layers["ViewLayer.Vector"].fill(7)))
    believed, found = (
        flow_of(wrong, Rules(on=frozenset(on), off=frozenset({"refine"}))) for on in ((), {"dense-flow"})
    )
    assert np.median(np.abs(believed[0][..., 0])) == 7
    assert np.median(np.abs(np.abs(found[0][10:-10, 10:-10, 0]) - 3)) < 1
    blind = open_shot(moving_scene.write(tmp_path / "blind", without={"Vector"}))
    window = FrameStream(blind, Rules(off=frozenset({"dense-flow"})), radius=1).align(1003)
    assert (window.confidence[[0, 2]] == 0).all()


def test_warp_forced_on_where_nothing_moves_and_no_vectors_are_keeps_the_neighbours(tmp_path):
    """Nobody was to say where to, so each frame was denoised alone."""
    still = open_shot(replace(CALM, frames=5).write(tmp_path, without={"Vector"}))
    window = FrameStream(still, Rules(on=frozenset({"warp"}))).align(1003)
    assert "dense-flow" in window.stages
    assert (np.median(window.confidence, axis=(1, 2)) > 0.5).all()
    alone = FrameStream(still, Rules(on=frozenset({"warp"}), off=frozenset({"dense-flow"}))).align(1003)
    assert (alone.confidence[[0, 1, 3, 4]] == 0).all()


@pytest.mark.parametrize("layer", ["Denoising Albedo", "Denoising Normal"])
@pytest.mark.parametrize("number", [1001, 1002, 1003])
def test_a_frame_without_a_layer_that_those_beside_it_have_is_named(tmp_path, layer, number):
    """Light divided by the albedo was averaged with color that was not."""

    def edit(index, layers):
        if index == 1:
            del layers[f"ViewLayer.{layer}"]

    shot = open_shot(replace(CALM, frames=3).write(tmp_path, edit=edit), frames=str(number))
    with pytest.raises(ValueError, match=f"frame 1002 has no {layer.split()[1].lower()}, which frame 100. has"):
        FrameStream(shot, Rules()).align(number)


@pytest.mark.parametrize("number", [1001, 1002, 1003])
def test_vectors_that_one_frame_lacks_are_taken_from_those_beside_it_or_found(tmp_path, number):
    def edit(index, layers):
        if index == 1:
            del layers["ViewLayer.Vector"]

    scene = replace(CALM, frames=3, step=(2, 0))
    window = FrameStream(open_shot(scene.write(tmp_path, edit=edit)), Rules()).align(number)
    there = slice(1003 - number, 1003 - number + 3)  # of the window of five
    assert (np.median(window.confidence[there], axis=(1, 2)) > 0.5).all()


def flow_of(shot, rules):
    aligner = FrameStream(shot, rules, radius=1)
    return aligner.flow(1002, 1003)


@pytest.mark.parametrize("factor", [1.0, 1.18, *seldom(0.84)])
@pytest.mark.parametrize("step", [(0, 0), (2, 1)])
def test_another_exposure_shows_through_noise_that_hides_it_in_small_areas(tmp_path, factor, step):
    """9×9 pixels of a noisy frame did not tell 18 % of light: two frames before it came out 2 % too bright."""

    def edit(index, layers):
        if index == 4:
            layers["ViewLayer.Combined"] *= np.float32(factor)

    scene = Scene(frames=8, step=step, height=64, width=96, noise=0.45)
    found = {d.stage: d for d in plan_shot(open_shot(scene.write(tmp_path, edit=edit)), context=NOISY).decisions}
    assert found["gate"].frames == (() if factor == 1 else tuple(range(1003, 1008)))


@pytest.mark.parametrize("noise", [0.1, 0.5])
def test_without_vectors_a_drift_of_one_pixel_shows_in_the_guides(tmp_path, noise):
    """Noise hides it in the color; averaged as if it stood still, such a shot lost 3 to 5 dB."""
    scene = replace(CALM, frames=3, step=(1, 0), noise=noise)
    found = plan_shot(open_shot(scene.write(tmp_path / "drift", without={"Vector"})), context=NOISY).stages
    assert {"warp", "dense-flow", "gate"} <= found
    still = replace(scene, step=(0, 0)).write(tmp_path / "still", without={"Vector"})
    assert not {"warp", "dense-flow", "gate"} & plan_shot(open_shot(still), context=NOISY).stages


def test_estimates_are_compared_in_any_case(tmp_path):
    """Denoised single frames of a calm shot may differ: the gate costs nothing there."""
    shot = open_shot(CALM.write(tmp_path))
    estimates = PerFrame(lambda frame: frame.color * np.float32(1 + 0.5 * (frame.number == 1005)))
    window = FrameStream(shot, Rules(), first_pass=estimates).align(1006)
    assert "gate" in window.stages
    assert np.median(window.confidence[1]) < 0.1
    off = FrameStream(shot, Rules(off=frozenset({"gate"})), first_pass=estimates).align(1006)
    assert "gate" not in off.stages
    assert np.median(off.confidence[1]) > 0.9
    assert "gate" not in plan_shot(shot, context=NOISY).stages


PART = np.s_[:, 64:]


def coming(light, number):
    """Light of a part that comes and goes around frame 1006, by less a frame than estimates are off."""
    light = light.copy()
    light[PART] *= np.float32(1 + 0.006 * (number - 1006) ** 2)
    return light


def test_estimates_whose_light_drifts_are_pulled_to_the_centre_and_samples_are_not(tmp_path):
    scene = replace(CALM, height=96, width=96, noise=0.1)

    def edit(index, layers):
        layers["ViewLayer.Combined"] = coming(layers["ViewLayer.Combined"], index + scene.first)

    shot = open_shot(scene.write(tmp_path, edit=edit))
    clean = scene.clean(0)["ViewLayer.Combined"]

    def estimate(frame):
        grain = np.random.default_rng(frame.number).normal(1, 0.005, clean.shape[:2])
        return coming(clean, frame.number) * grain.astype(np.float32)[..., None]

    pulled, plain = (
        FrameStream(shot, rules, first_pass=PerFrame(estimate)).align(1006)
        for rules in (Rules(on=frozenset({"drift"})), Rules(off=frozenset({"drift"})))
    )
    assert "drift" in pulled.stages
    assert "drift" not in plain.stages
    assert "drift" not in FrameStream(shot, Rules(on=frozenset({"drift"}))).align(1006).stages  # without estimates
    np.testing.assert_array_equal(pulled.confidence, plain.confidence)
    np.testing.assert_array_equal(pulled.residual, plain.residual)
    light = clean[PART].mean(dtype=float)
    off = [abs(gated_average(window)[PART].mean(dtype=float) / light - 1) for window in (pulled, plain)]
    assert off[1] > 0.006
    assert off[0] < 0.6 * off[1]


def test_neighbours_count_by_their_samples(tmp_path):
    """A frame of 512 samples among frames of 8 lost 2.9 dB to its neighbours."""

    def grain(index, layers):
        noise = np.random.default_rng(index).normal(1, 0.04 if index == ODD else 0.32, (180, 240, 1))
        layers["ViewLayer.Combined"] *= noise.astype(np.float32)

    scene = replace(CALM, height=180, width=240, noise=0.001)
    shot = open_shot(scene.write(tmp_path / "a", edit=grain), frames="1007-1011")
    stream = FrameStream(shot, Rules(), PerFrame(lambda frame: frame.color))
    # The square of 1 / 64, which is known to a fifth or so. A frame of fewer samples counts its neighbours in full.
    few = 1 / 64**2
    assert stream.window(1009).own_samples == pytest.approx([few, few, 1, few, few], rel=0.8)
    assert stream.window(1010).own_samples == (1, 1, 1, 1, 1)
    results = dict.fromkeys((1008, 1009, 1010), np.ones((180, 240, 3), np.float32))
    assert stream.window_of_results(1009, results).own_samples == pytest.approx([few, 1, few], rel=0.8)
    aligned = stream.align(1009)
    assert aligned.confidence[[0, 1, 3, 4]].max() < 2 * few
    assert aligned.confidence[2].min() == 1
