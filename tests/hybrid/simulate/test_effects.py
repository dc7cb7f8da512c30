"""The rules that turn what is in a scene into Cycles' settings, and the measurement of path depths; no renderer."""

from dataclasses import replace

import numpy as np
import pytest

from hybrid.simulate.effects import (
    BLUR_PIXELS,
    EVERYTHING,
    MEAN_FRACTION,
    NOISE_FRACTION,
    SceneFacts,
    effects_of,
    needed_bounces,
    settings_of,
)

FULL = SceneFacts(
    motion_pixels=5, moving_lights=1, blur_asked=True, aperture_pixels=4, glossy=3, mirrors=1, transmissive=2,
    transparent=1, subsurface=1, volumes=1, hair=1, lights=9, small_lights=3, world="sky",
)  # fmt: skip


def decided(facts):
    return {decision.effect: decision for decision in effects_of(facts)}


def test_an_empty_scene_calls_for_nothing():
    assert not any(decision.on for decision in effects_of(SceneFacts()))


def test_a_scene_with_everything_calls_for_every_effect():
    assert all(decision.on for decision in effects_of(FULL) if decision.effect != "more passes")


@pytest.mark.parametrize(
    ("field", "effect", "setting"),
    [
        ("glossy", "glossy paths", "cycles.glossy_bounces"),
        ("transmissive", "transmission", "cycles.transmission_bounces"),
        ("transparent", "transparency", "cycles.transparent_max_bounces"),
        ("volumes", "volumes", "cycles.volume_bounces"),
    ],
)
def test_a_kind_of_bounce_is_dropped_only_where_nothing_can_cause_it(field, effect, setting):
    without = decided(replace(FULL, **{field: 0}))
    assert not without[effect].on
    assert settings_of(without.values())[setting] == 0
    assert settings_of(effects_of(replace(FULL, **{field: 1})))[setting] == EVERYTHING[setting]


def test_caustics_follow_their_own_kind_of_surface():
    settings = settings_of(effects_of(replace(FULL, transmissive=0)))
    assert settings["cycles.caustics_reflective"]
    assert not settings["cycles.caustics_refractive"]


def test_motion_blur_needs_to_be_asked_for_and_something_that_moves():
    assert not decided(replace(FULL, blur_asked=False))["motion blur"].on
    assert not decided(replace(FULL, motion_pixels=0, moving_lights=0))["motion blur"].on
    assert decided(replace(FULL, motion_pixels=0))["motion blur"].on, "a moving light blurs its shadows"
    # The threshold is on what moves while the shutter is open, not on the whole frame's motion.
    slow = replace(FULL, moving_lights=0, motion_pixels=1.5 * BLUR_PIXELS)
    assert not decided(replace(slow, shutter=0.5))["motion blur"].on
    assert decided(replace(slow, shutter=1.0))["motion blur"].on


def test_depth_of_field_needs_a_circle_of_confusion_that_can_be_seen():
    assert decided(replace(FULL, aperture_pixels=BLUR_PIXELS))["depth of field"].on
    assert not decided(replace(FULL, aperture_pixels=0.9 * BLUR_PIXELS))["depth of field"].on


def test_one_light_needs_no_tree_and_a_black_world_is_not_sampled():
    settings = settings_of(effects_of(replace(FULL, lights=1, world="none")))
    assert not settings["cycles.use_light_tree"]
    assert settings["world.cycles.sampling_method"] == "NONE"
    assert settings_of(effects_of(FULL))["cycles.use_light_tree"]


def test_lamps_count_as_something_transparent_on_a_path():
    """Cycles lets an indirect ray that meets a lamp go on as a transparent bounce: depth 0 would end it there."""
    bare = replace(FULL, transparent=0)
    assert settings_of(effects_of(replace(bare, lamps=1)))["cycles.transparent_max_bounces"] > 0
    assert settings_of(effects_of(replace(bare, lamps=0)))["cycles.transparent_max_bounces"] == 0


def test_light_too_rare_for_the_pilot_to_have_measured_is_kept():
    """Missing 0.03 % of the mean is little, but all of it in one pixel says that it may as well be 0.09 %."""

    def render(settings, seed):
        picture = np.ones((32, 32, 3))
        if min(settings["cycles.diffuse_bounces"], settings["cycles.max_bounces"]) >= 2:
            picture[5, 5] += 0.0003 * 32 * 32
        return picture.astype(np.float32)

    assert depths(needed_bounces(render, EVERYTHING, 8))["cycles.diffuse_bounces"] == 2


def test_every_decision_says_its_figure_threshold_and_reason():
    for facts in (SceneFacts(), FULL):
        for decision in effects_of(facts):
            text = str(decision)
            assert text.startswith("+" if decision.on else "-")
            assert decision.reason in text
            assert str(decision.threshold) in text


class Renderer:
    """Stands in for Cycles: a picture is the sum of what each depth of each kind brings, plus noise of the seed."""

    def __init__(self, brings, noise=0.5):
        self.brings, self.noise, self.calls = brings, noise, 0

    def __call__(self, settings, seed):
        self.calls += 1
        picture = np.full((24, 32, 3), 1.0) + np.random.default_rng(seed).normal(0, self.noise, (24, 32, 3))
        for kind, light in self.brings.items():
            depth = min(settings[f"cycles.{kind}_bounces"], settings["cycles.max_bounces"])
            picture += sum(light[:depth])
        return picture.astype(np.float32)


def depths(decisions):
    return {name: value for decision in decisions for name, value in decision.settings.items()}


def test_depth_is_the_least_whose_missing_light_is_below_the_stated_fraction():
    # Depth d of a diffuse path brings 0.3^d: what is missing after d is 0.3^(d+1)/0.7. The picture's mean is about
    # 1.43 (direct light 1, and the sum); the first d with 0.3^(d+1)/0.7 ≤ 0.001·1.43 is 5.
    render = Renderer({"diffuse": [0.3 ** (d + 1) for d in range(32)]})
    found = depths(needed_bounces(render, {**EVERYTHING, "cycles.volume_bounces": 0}, 8))
    mean = 1 + 0.3 / 0.7
    missing = [0.3 ** (d + 1) / 0.7 / mean for d in range(8)]
    assert found["cycles.diffuse_bounces"] == next(d for d, m in enumerate(missing) if m <= MEAN_FRACTION)
    assert found["cycles.glossy_bounces"] == found["cycles.transmission_bounces"] == 0, "they bring nothing"
    assert "cycles.volume_bounces" not in found, "what is off already is not measured"


def test_light_that_no_mean_shows_but_the_noise_would_is_kept():
    """A tenth of the noise is the second criterion: light that adds here and takes there keeps the mean."""

    def render(settings, seed):
        picture = np.ones((32, 32, 3)) + np.random.default_rng(seed).normal(0, 0.01, (32, 32, 3))
        if min(settings["cycles.glossy_bounces"], settings["cycles.max_bounces"]) >= 3:
            picture[:16] += 0.01
            picture[16:] -= 0.01
        return picture.astype(np.float32)

    found = depths(needed_bounces(render, {**EVERYTHING}, 8))
    assert found["cycles.glossy_bounces"] == 3
    assert found["cycles.diffuse_bounces"] == 0


def test_a_cleaner_picture_needs_deeper_paths():
    def needs(samples):
        render = Renderer({"diffuse": [0.0004 / 2**d for d in range(32)]}, 0.02)
        return depths(needed_bounces(render, EVERYTHING, samples))["cycles.diffuse_bounces"]

    # 0.0008 of a mean of 1 is less than the first criterion, and half of what the second allows at 8 samples (a
    # normal deviate's mean size is 0.8 σ: 0.1 · 0.8 · 0.02 = 0.0016), but 11 times what it allows at 4096.
    assert NOISE_FRACTION * 0.8 * 0.02 * np.sqrt(8 / 4096) < 0.0001
    assert needs(8) == 0
    assert needs(4096) > 2


def test_scaling_the_light_changes_no_depth():
    render = Renderer({"diffuse": [0.3 ** (d + 1) for d in range(32)], "glossy": [0.1, 0.05]})
    brighter = depths(needed_bounces(lambda s, seed: 1000 * render(s, seed), EVERYTHING, 8))
    assert brighter == depths(needed_bounces(render, EVERYTHING, 8))


def test_a_black_picture_needs_no_paths_and_divides_by_nothing():
    found = depths(needed_bounces(lambda s, seed: np.zeros((4, 5, 3), np.float32), EVERYTHING, 8))
    assert set(found.values()) == {0}


def test_a_pilot_stays_a_pilot():
    """Bisection: at most four pictures a kind, not one per depth."""
    render = Renderer({kind: [0.9**d for d in range(32)] for kind in ("diffuse", "glossy", "transmission", "volume")})
    needed_bounces(render, EVERYTHING, 8)
    assert render.calls <= 2 + 6 * 4 + 1
