from dataclasses import replace
from functools import partial

import numpy as np
import pytest

from hybrid.alignment.fade import NO_FADE
from hybrid.alignment.measure import FrameFacts
from hybrid.denoising.first_pass import PerFrame
from hybrid.denoising.plan import DENOISED, NOISY, STAGES, Context, Rules, merge
from hybrid.denoising.stream import FrameStream, plan_shot
from hybrid.files.frame import MappedShot
from hybrid.files.shots import open_shot
from tests.scenes import Scene, grained, only

FACTS = FrameFacts(1, None, 0.1, None, 0, 0.0, None, 0.0, None)


def decisions(folder):
    plan = plan_shot(open_shot(folder), context=NOISY)
    return {decision.stage: decision for decision in plan.decisions}


def test_every_effect_is_decided_once_with_a_reason(shot_folder):
    plan = plan_shot(open_shot(shot_folder))
    assert [d.stage for d in plan.decisions] == list(STAGES)
    assert all(d.reason for d in plan.decisions)


def test_exact_vectors_are_used_as_they_are(shot_folder):
    found = decisions(shot_folder)
    assert found["warp"].on
    assert found["warp"].figure == pytest.approx(np.hypot(2, 1), abs=1e-3)
    assert not found["refine"].on
    assert not found["dense-flow"].on
    assert not found["gate"].on


def test_nothing_is_warped_where_nothing_moves(tmp_path):
    found = decisions(Scene(step=(0, 0)).write(tmp_path))
    assert not found["warp"].on
    assert not found["refine"].on


def test_without_vectors_motion_is_looked_for_only_where_something_moves(tmp_path):
    moving = decisions(Scene(noise=0.05).write(tmp_path / "moving", without={"Vector"}))
    still = decisions(Scene(noise=0.05, step=(0, 0)).write(tmp_path / "still", without={"Vector"}))
    assert moving["dense-flow"].on
    assert moving["warp"].on
    assert not still["dense-flow"].on
    assert not still["warp"].on


def reflect(index, layers):
    """A bright disc that stands still while the vectors say that everything moves: a reflection."""
    y, x = np.mgrid[: Scene.height, : Scene.width]
    layers["ViewLayer.Combined"][(y - 20) ** 2 + (x - 10 - 14 * index) ** 2 < 64] *= 5


def test_vectors_that_do_not_explain_the_picture_call_for_refinement_and_the_gate(tmp_path):
    found = decisions(Scene().write(tmp_path, edit=reflect))
    assert found["refine"].on
    assert found["gate"].on


def test_denoised_frames_call_for_no_refinement_unless_it_is_forced(tmp_path):
    shot = open_shot(Scene().write(tmp_path, edit=reflect))
    for rules, on in ((Rules(), False), (Rules(on=frozenset({"refine"})), True)):
        found = decision_of("refine", plan_shot(shot, rules, context=DENOISED))
        assert found.on == on
        assert "the vectors leave" in found.reason


def test_what_ran_on_a_part_of_the_picture_says_on_how_much(shot_folder):
    plan = plan_shot(open_shot(shot_folder), Rules(on=frozenset({"refine"})))
    before = {d.stage: d for d in merge({1: plan}).decisions}
    ran = {d.stage: d for d in merge({1: replace(plan, shares={"refine": 0.19})}).decisions}
    assert ran["refine"].reason == f"{before['refine'].reason}; it ran on 19% of the picture"
    assert ran["warp"] == before["warp"]


def test_samples_that_are_not_rejected_are_not_said_to_be(tmp_path):
    shot, rules = open_shot(Scene().write(tmp_path)), Rules(on=frozenset({"outliers"}))
    noisy, denoised = (decision_of("outliers", plan_shot(shot, rules, context=c)) for c in (NOISY, DENOISED))
    assert noisy.on
    assert not denoised.on
    assert denoised.reason.startswith("the averaging of denoised frames bounds")


def test_denoised_frames_are_compared_in_any_case_unless_the_gate_is_off(shot_folder):
    shot = open_shot(shot_folder)
    gates = [decision_of("gate", plan_shot(shot, context=c)) for c in (NOISY, DENOISED)]
    assert [gate.on for gate in gates] == [False, True]
    assert gates[1].reason == f"denoised frames are compared in any case; measured: {gates[0].reason}"
    assert not decision_of("gate", plan_shot(shot, Rules(off=frozenset({"gate"})), context=DENOISED)).on


def decision_of(stage, plan):
    return next(decision for decision in plan.decisions if decision.stage == stage)


def test_drift_that_cannot_be_told_is_not_said_to_run(shot_folder):
    shot, rules = open_shot(shot_folder), Rules(on=frozenset({"drift"}))
    assert decision_of("drift", plan_shot(shot, rules, context=DENOISED)).on
    for context in (NOISY, Context(first_pass=True, radius=1)):
        decision = decision_of("drift", plan_shot(shot, rules, context=context))
        assert not decision.on
        assert decision.reason.startswith("needs denoised frames, and windows of five or more; forced")


def test_fireflies_call_for_rejection(tmp_path):
    def burn(index, layers):
        layers["ViewLayer.Combined"][7 + index, 9] = 1e5

    assert not decisions(Scene(noise=0.1).write(tmp_path / "calm"))["outliers"].on
    assert decisions(Scene(noise=0.1).write(tmp_path / "burnt", edit=burn))["outliers"].on


def test_only_a_denoiser_with_a_filter_of_guides_has_them_filtered(shot_folder):
    """The plan of every preset listed a stage that one of them has."""
    shot, rules = open_shot(shot_folder), Rules(on=frozenset({"clean-guides"}))
    assert decision_of("clean-guides", plan_shot(shot, rules)).on
    stage = decision_of("clean-guides", plan_shot(shot, rules, context=DENOISED._replace(filters_guides=False)))
    assert not stage.on
    assert stage.reason.startswith("this denoiser has no filter of guides; forced")


def blur(index, layers):
    noise = np.random.default_rng(index).normal(0, 0.1, layers["ViewLayer.Denoising Albedo"].shape)
    layers["ViewLayer.Denoising Albedo"] += noise.astype(np.float32)


def test_an_average_of_first_passes_has_no_guides_filtered(tmp_path):
    noisy, average = open_shot(Scene().write(tmp_path, edit=blur)), DENOISED._replace(reads_guides=False)
    plan = plan_shot(noisy, context=average)
    assert not decision_of("prefilter", plan).on
    assert decision_of("prefilter", plan).reason.startswith("the average of denoised frames reads no guides")
    assert plan.noisy_guides
    assert decision_of("prefilter", plan_shot(noisy, context=NOISY._replace(reads_guides=False))).on
    assert decision_of("prefilter", plan_shot(noisy, Rules(on=frozenset({"prefilter"})), context=average)).on
    assert not plan_shot(open_shot(Scene().write(tmp_path / "sharp")), context=average).noisy_guides


def test_noise_in_the_guides_calls_for_prefiltering(tmp_path):
    assert not decisions(Scene().write(tmp_path / "sharp"))["prefilter"].on
    found = decisions(Scene().write(tmp_path / "noisy", edit=blur))
    assert found["prefilter"].on
    assert found["clean-guides"].on


def test_noise_at_outlines_calls_for_guides_without_it(tmp_path):
    """Few pixels have it, so that the quartile which calls for prefiltering does not show it. Unknown noise counts."""

    def mix(samples):
        def edit(index, layers):
            albedo = layers["ViewLayer.Denoising Albedo"]
            column = np.indices(albedo.shape[:2])[1][..., None] % 14
            mixed = np.random.default_rng(index).binomial(samples, 0.5, albedo.shape[:2])[..., None] / samples
            albedo[:] = np.where(column == 6, 0.2 + 0.6 * mixed, np.where(column < 6, 0.2, 0.8))

        return edit

    scene = Scene(step=(0, 0))
    unknown = decisions(scene.write(tmp_path / "unknown", without={"Vector"}))["clean-guides"]
    assert unknown.on
    assert unknown.reason.startswith("the noise of the guides at outlines is unknown")
    shot = open_shot(tmp_path / "unknown")
    for samples, on in ((32, True), (64, False)):  # the variance of their noise is a part of so many
        counted = MappedShot(shot, partial(replace, samples=samples))
        by_samples = decision_of("clean-guides", plan_shot(counted))
        assert by_samples.on == on
        assert by_samples.figure == 1 / samples
    without = {"Vector", "Denoising Albedo", "Denoising Normal"}
    assert not decisions(scene.write(tmp_path / "none", without=without))["clean-guides"].on
    few, many = (decisions(scene.write(tmp_path / str(n), edit=mix(n)))["clean-guides"] for n in (8, 512))
    assert few.on
    assert few.figure > 10 * many.figure > 0
    assert not many.on
    assert not decisions(scene.write(tmp_path / "8"))["prefilter"].on


@pytest.mark.parametrize(("frames", "noise", "filtered"), [(1, 0.1, True), (3, 1.5, True), (3, 0.1, False)])
def test_noise_that_all_guides_share_calls_for_prefiltering(tmp_path, frames, noise, filtered):
    """Cycles makes the guides of one sample a pixel alike in all frames, which then do not differ; nor does one."""

    def blur(index, layers):
        grain = np.random.default_rng(3).normal(0, 0.1, layers["ViewLayer.Denoising Albedo"].shape)
        layers["ViewLayer.Denoising Albedo"] += grain.astype(np.float32)

    def smooth(index, layers):
        layers["ViewLayer.Denoising Albedo"][:] = 0.5

    scene = Scene(frames=frames, step=(0, 0), noise=noise)
    assert not decisions(scene.write(tmp_path / "smooth", edit=smooth))["prefilter"].on
    assert decisions(scene.write(tmp_path / "noisy", edit=blur))["prefilter"].on == filtered


def test_without_albedo_there_is_no_demodulation(tmp_path):
    found = decisions(Scene().write(tmp_path, without={"Denoising Albedo"}))
    assert not found["demodulate"].on
    assert found["demodulate"].figure is None


def test_the_user_may_force_what_was_measured(shot_folder):
    plan = plan_shot(open_shot(shot_folder), Rules(on=frozenset({"refine"}), off=frozenset({"warp"})))
    assert "refine" in plan.stages
    assert "warp" not in plan.stages
    forced = [d for d in plan.decisions if d.forced]
    assert {d.stage for d in forced} == {"refine", "warp"}
    assert all(d.reason.startswith("forced") for d in forced)


@pytest.mark.parametrize(("on", "off"), [(["wrap"], []), (["steady"], []), ([], ["wrap"]), (["warp"], ["warp"])])
def test_forcing_nonsense_is_refused(on, off):
    with pytest.raises(ValueError, match=r"wrap|steady|both"):
        Rules(on=frozenset(on), off=frozenset(off))


@pytest.mark.parametrize("moving", [False, True])
@pytest.mark.parametrize("fixed", [False, True])
def test_noise_that_stands_still_on_the_screen_is_found(tmp_path, moving, fixed):
    """One seed for all frames: the grain is a function of the pixel, not of the frame."""
    scene = Scene(height=64, width=96, frames=4, step=(2, 1) if moving else (0, 0))

    def one_seed(index, layers):
        grain = np.random.default_rng(5).gamma(11, 1 / 11, (scene.height, scene.width, 1)).astype(np.float32)
        layers["ViewLayer.Combined"] = scene.clean(index)["ViewLayer.Combined"] * grain

    shot = open_shot(scene.write(tmp_path, edit=one_seed if fixed else None))
    decision = next(d for d in plan_shot(shot).decisions if d.stage == "fixed-noise")
    assert decision.on == fixed
    assert ("Animate Seed" in decision.reason) == fixed


def test_noise_that_stands_still_is_neither_averaged_nor_taken_for_no_noise(tmp_path, monkeypatch):
    scene = Scene(height=48, width=64, frames=5, step=(0, 0))

    def one_seed(index, layers):
        grain = np.random.default_rng(5).gamma(11, 1 / 11, (scene.height, scene.width, 1)).astype(np.float32)
        layers["ViewLayer.Combined"] = scene.clean(index)["ViewLayer.Combined"] * grain

    shot = open_shot(scene.write(tmp_path, edit=one_seed))
    monkeypatch.setattr(FrameStream, "_repeats", lambda *_: False)  # equal frames, which this scene has as well
    stages = {"demodulate", "warp", "fixed-noise"}
    window = FrameStream(shot, only(stages)).align(scene.first + 2)
    assert (window.confidence[[0, 1, 3, 4]] == 0).all()
    trusting = FrameStream(shot, only(stages - {"fixed-noise"})).align(scene.first + 2)
    assert trusting.variance.max() < 1e-10  # five times the same picture
    # Grain of a standard deviation of 0.3: what is left of it says so, within what a 5×5 box of it varies.
    truth = (0.3 * scene.clean(2)["ViewLayer.Combined"] / window.modulation) ** 2
    assert np.median(window.variance / truth) == pytest.approx(1, abs=0.35)


def test_a_cut_is_seen_in_the_texture_where_both_sides_are_lit_alike(tmp_path):
    """The average over it would be of light divided by the albedo, which alone would not show it."""

    def cut(index, layers):
        if index >= 2:
            for name in ("ViewLayer.Combined", "ViewLayer.Denoising Albedo"):
                layers[name][:] = layers[name][::-1].copy()

    scene = Scene(frames=4, height=64, width=96, noise=0.2)
    assert plan_shot(open_shot(scene.write(tmp_path / "cut", edit=cut))).cuts == ((1002, 1003),)
    assert plan_shot(open_shot(scene.write(tmp_path / "blind", edit=cut, without={"Vector"}))).cuts == ((1002, 1003),)
    assert plan_shot(open_shot(scene.write(tmp_path / "whole"))).cuts == ()
    fast = Scene(frames=4, height=64, width=96, noise=0.2, step=(9, 4))
    assert plan_shot(open_shot(fast.write(tmp_path / "fast"))).cuts == ()
    assert plan_shot(open_shot(fast.write(tmp_path / "searched", without={"Vector"}))).cuts == ()


def faded(factor):
    """An edit that multiplies the light by `factor` from frame to frame."""

    def edit(index, layers):
        layers["ViewLayer.Combined"] *= np.float32(factor**index)

    return edit


@pytest.mark.parametrize("factor", [0.5, 4])
def test_a_fade_is_a_decision_with_its_stops(tmp_path, factor):
    shot = open_shot(Scene().write(tmp_path, edit=faded(factor)))
    decision = next(d for d in plan_shot(shot).decisions if d.stage == "fade")
    assert decision.on
    assert decision.figure == pytest.approx(abs(np.log2(factor)), abs=0.05)
    assert "stops" in decision.reason
    window = FrameStream(shot, Rules(off=frozenset({"fade"})), radius=1).window(1002)
    means = [frame.irradiance.mean() for frame in window.frames]
    np.testing.assert_allclose(np.divide(means[1:], means[:-1]), factor, rtol=0.1)  # each as it was rendered
    assert "fade" not in plan_shot(open_shot(Scene().write(tmp_path / "plain"))).stages


def test_a_flash_of_pictures_alone_is_no_cut(tmp_path):
    """Pictures ten times as bright share no pixel, and there are no guides that do."""

    def flash(index, layers):
        layers["ViewLayer.Combined"] *= np.float32(10 if index == 2 else 1)

    scene, alone = Scene(frames=4, height=64, width=96), {"Vector", "Denoising Albedo", "Denoising Normal", "Depth"}
    plan = plan_shot(open_shot(scene.write(tmp_path, edit=flash, without=alone)))
    assert plan.cuts == ()
    assert "fade" in plan.stages


def test_a_fade_of_a_small_thing_without_vectors_around_it_is_found(tmp_path):
    def small(index, layers):
        item = np.zeros((64, 96, 1), np.float32)
        item[20 + index : 44 + index, 30 + 2 * index : 54 + 2 * index] = 0.5**index
        layers["ViewLayer.Combined"] *= item
        layers["ViewLayer.Vector"][item[..., 0] == 0] = np.nan

    scene = Scene(height=64, width=96, noise=0.1)
    stream = FrameStream(open_shot(scene.write(tmp_path, edit=small)), Rules(), radius=1)
    assert [pair.fade[1] for pair in stream.measurements([1001, 1002, 1003])[1]] == pytest.approx([0.5, 0.5], rel=0.05)


def test_light_of_pixels_without_vectors_is_no_fade(tmp_path):
    def blink(index, layers):
        layers["ViewLayer.Combined"][:, :64] *= np.float32(3 ** (index % 2))
        layers["ViewLayer.Vector"][:, :64] = np.nan

    stream = FrameStream(open_shot(Scene(height=64, width=96).write(tmp_path, edit=blink)), Rules(), radius=1)
    assert [pair.fade for pair in stream.measurements([1001, 1002, 1003])[1]] == [NO_FADE, NO_FADE]


def test_a_fade_is_the_same_at_any_scale(tmp_path):
    fades = []
    for scale in (1, 2.0**10, 2.0**-10):
        shot = open_shot(Scene().write(tmp_path / str(scale), edit=faded(0.7), scale=scale))
        fades.append([pair.fade for pair in FrameStream(shot, Rules()).measurements(shot.numbers)[1]])
    assert fades[0] == fades[1] == fades[2] != [NO_FADE, NO_FADE]


def test_light_of_three_fifths_of_a_picture_is_no_fade(tmp_path):
    def blink(index, layers):
        layers["ViewLayer.Combined"][:, :58] *= np.float32(1.5 ** (index % 2))

    stream = FrameStream(open_shot(Scene(height=64, width=96, step=(0, 0)).write(tmp_path, edit=blink)), Rules())
    assert [pair.fade for pair in stream.measurements([1001, 1002, 1003])[1]] == [NO_FADE, NO_FADE]


@pytest.mark.parametrize("factors", [(0.94, 0.94, 0.94), (1, 1, 1), (1.2, 1, 0.8)])
def test_factors_that_noise_hides_in_single_areas_are_found(tmp_path, factors):
    """Light that alternates by 6 % came out at half of that, and one factor served for all channels."""

    def alternate(index, layers):
        layers["ViewLayer.Combined"] *= np.float32(factors) ** np.float32(index % 2)

    scene = Scene(height=64, width=96, frames=4, noise=0.2)
    stream = FrameStream(open_shot(scene.write(tmp_path, edit=alternate)), Rules(), radius=1)
    found = [pair.fade for pair in stream.measurements([1001, 1002, 1003, 1004])[1]]
    if factors == (1, 1, 1):
        assert found == 3 * [NO_FADE]
    else:
        np.testing.assert_allclose(found, np.float64(factors) ** [[1], [-1], [1]], rtol=0.02)


@pytest.mark.parametrize("change", [np.repeat((1.06, 1), 48), np.linspace(1.03, 1.11, 96)], ids=["half", "slope"])
@pytest.mark.parametrize("noise", [0.01, 0.05])
def test_light_that_changes_in_places_is_no_fade(tmp_path, change, noise):
    """A factor leaves more than noise in half of the picture, or at both ends of a slope."""

    def alternate(index, layers):
        layers["ViewLayer.Combined"] *= np.float32(change[:, None] ** (index % 2))

    scene = Scene(height=64, width=96, noise=noise, step=(0, 0))
    stream = FrameStream(open_shot(scene.write(tmp_path, edit=alternate)), Rules(), radius=1)
    assert [pair.fade for pair in stream.measurements([1001, 1002, 1003])[1]] == [NO_FADE, NO_FADE]


def test_a_cut_to_other_light_is_a_cut_and_no_fade(tmp_path):
    def cut(index, layers):
        if index >= 2:
            layers["ViewLayer.Combined"][:] = 20 * layers["ViewLayer.Combined"][::-1, ::-1].copy()

    scene, alone = Scene(frames=4, height=64, width=96, noise=0.2), {"Vector", "Denoising Albedo", "Denoising Normal"}
    plan = plan_shot(open_shot(scene.write(tmp_path, edit=cut, without=alone)))
    assert plan.cuts == ((1002, 1003),)
    assert "fade" not in plan.stages


@pytest.mark.parametrize("half", [False, True])
def test_one_seed_is_found_in_a_fade(tmp_path, half):
    """Fireflies of one seed would pass for lamps, and its noise for certain samples."""
    scene = Scene(height=64, width=96, step=(0, 0))

    def edit(index, layers):
        color = scene.noisy(0)["ViewLayer.Combined"]
        color[np.random.default_rng(3).random((64, 96)) < 0.003] += 240
        color *= np.float32(0.8**index)
        layers["ViewLayer.Combined"] = color.astype(np.float16 if half else np.float32).astype(np.float32)

    stream = FrameStream(open_shot(scene.write(tmp_path, edit=edit)), Rules(), radius=1)
    pairs = stream.measurements([1001, 1002, 1003])[1]
    assert [pair.fade[1] for pair in pairs] == pytest.approx([0.8, 0.8], rel=1e-3)
    assert all(pair.repeated for pair in pairs)
    assert stream.frame(1002).fireflies > 10


def test_lamps_fade_with_the_picture_or_stay_as_they_are(tmp_path):
    """Either way the neighbours show them."""
    for fade in (0.5, 1):

        def lamps(index, layers, fade=fade):
            layers["ViewLayer.Combined"] *= np.float32(0.5**index)
            layers["ViewLayer.Combined"][8::16, 8::16] = 40 * fade**index

        scene = Scene(height=64, width=96, step=(0, 0), noise=0.1)
        stream = FrameStream(open_shot(scene.write(tmp_path / str(fade), edit=lamps)), Rules(), radius=1)
        for index, number in enumerate(stream.shot.numbers):
            light = stream.frame(number).highlights.light
            assert len(light) >= 12  # of 24: the texture hides some
            np.testing.assert_allclose(light.mean(axis=-1), 40 * fade**index, rtol=0.05)


def test_aovs_fade_by_factors_of_their_own(tmp_path):
    """The key light fades, the fill light and a noisy mask stay as they are."""
    scene = Scene(height=64, width=96, step=(0, 0))

    def split(index, layers):
        key = layers["ViewLayer.Combined"] * np.float32(0.5**index)
        fill = grained(np.full_like(key, 0.1), (3, index))
        mask = grained(layers["ViewLayer.Denoising Albedo"], (4, index))
        lights = {"ViewLayer.Combined_key": key, "ViewLayer.Combined_fill": fill, "ViewLayer.emission": mask}
        layers |= {"ViewLayer.Combined": key + fill, **lights}

    window = FrameStream(open_shot(scene.write(tmp_path, edit=split), aovs=["all"]), Rules(), radius=1).window(1002)
    assert "fade" in window.stages
    for name, layer in window.centre.aovs.items():
        means = [frame.aovs[name].mean() for frame in window.frames]
        np.testing.assert_allclose(means, layer.mean(), rtol=0.1, err_msg=name)


NONE = (0.0, 0.0, 0.0, 0.0)


@pytest.mark.parametrize(
    ("x", "y", "on", "words"),
    [
        ((0.4, 0.05, 0.01, 0.0), (0.35, 0.05, 0.0, 0.02), True, "correlates by 0.35"),
        ((0.4, 0.05, 0.01, 0.0), NONE, False, "correlates by 0.00"),  # light that moves up or down
        ((0.8, 0.5, 0.3, 0.2), (0.8, 0.5, 0.3, 0.2), False, "render with a narrower one"),
    ],
)
def test_a_pixel_filter_is_undone_where_noise_is_shared_both_ways_and_not_far(x, y, on, words):
    rules = Rules()
    assert rules.whitens((x, y)) == on
    facts = replace(FACTS, noise_correlation=(x, y))
    decision = next(d for d in rules.decide([facts, FACTS], []).decisions if d.stage == "whiten")
    assert decision.on == on
    assert words in decision.reason
    assert not Rules(off=frozenset({"whiten"})).whitens((x, y))


WIDE = (0.6, 0.4, 0.2, 0.1)


@pytest.mark.parametrize(
    ("lags", "least", "on", "words"),
    [
        ((0.4, 0.05, 0.01, 0.0), 0.3, True, "correlates by 0.30 in three quarters"),
        ((0.4, 0.05, 0.01, 0.0), 0.15, False, "correlates by 0.15 in three quarters"),
        (WIDE, 0.4, False, "may have no noise"),  # a picture that has been denoised
    ],
)
def test_in_a_frame_alone_the_lower_quartile_decides(lags, least, on, words):
    correlation = (lags, lags)
    assert Rules().whitens(correlation, least) == on
    facts = replace(FACTS, noise_correlation=correlation, noise_correlation_alone=least)
    decision = next(d for d in Rules().decide([facts], []).decisions if d.stage == "whiten")
    assert decision.on == on
    assert words in decision.reason
    assert (decision.figure is None) == (lags == WIDE)  # without a figure the log warns of nothing


def test_a_frame_whose_noise_cannot_be_compared_stays_as_it_is():
    assert not Rules(on=frozenset({"whiten"})).whitens(None)
    decision = next(d for d in Rules().decide([FACTS], []).decisions if d.stage == "whiten")
    assert not decision.on
    assert decision.figure is None


@pytest.mark.parametrize(("forced", "runs"), [(False, False), (True, True)])
def test_flows_between_denoised_frames_are_the_renderers_unless_refinement_is_forced(tmp_path, forced, runs):
    """The plan of a window said so, and each pair of frames was refined nevertheless."""
    ran = []

    def refine(guides, flow):
        ran.append(flow.shape)
        return flow

    rules = Rules(on=frozenset({"refine"} if forced else ()))
    shot = open_shot(Scene().write(tmp_path, edit=reflect))
    stream = FrameStream(shot, rules, PerFrame(lambda frame: frame.color), refine=refine)
    stream.align(shot.numbers[1])
    assert bool(ran) == runs
