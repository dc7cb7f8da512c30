"""Frames in memory are denoised as those of files."""

import doctest
import warnings

import cv2
import numpy as np
import pytest

import ravg
from hybrid.files.shots import open_shot
from hybrid.run import arrays
from hybrid.run.job import validate_views
from tests.scenes import Scene
from tests.seldom import seldom

SCENE = Scene(frames=5)


@pytest.fixture
def shot(tmp_path):
    return open_shot(SCENE.write(tmp_path / "in"))


def layers_of(shot):
    """The layers as the command reads them: without those that make no sense."""
    (shot,), _ = validate_views(shot)
    frames = {number: shot.read(number) for number in shot.numbers}
    names = ("color", "albedo", "normal", "depth", "motion")
    layers = {number: {name: getattr(frame, name) for name in names} for number, frame in frames.items()}
    return {number: {n: layer for n, layer in found.items() if layer is not None} for number, found in layers.items()}


@pytest.mark.parametrize("options", [{"preset": "draft"}, {"method": "classical", "first_pass": "nlm"}])
def test_they_are_the_frames_of_files(shot, tmp_path, options):
    convention = shot.read(shot.numbers[0]).motion_convention
    assert (convention.direction, convention.unit) == ("cycles", "pixels")
    motion = f"cycles,pixels,y-{convention.y},scale={convention.scale}"
    made = {result.number: result for result in ravg.denoise_arrays(layers_of(shot), motion=motion, **options)}
    assert [*made] == [*shot.numbers]
    files = {f.number: f for f in ravg.denoise_shot(shot, tmp_path / "out", **options)}
    denoised = open_shot(tmp_path / "out")
    for number, result in made.items():
        np.testing.assert_array_equal(result.layers["color"], denoised.read(number).color)
        assert result.plan.stages == files[number].plan.stages


@pytest.mark.neural
@pytest.mark.parametrize("strength", [0.25, *seldom(0.0)])
def test_a_share_of_the_noise_stays_in_all_layers(strength):
    """Parts add up to the color as before, and what was not rendered is repaired all the same."""
    random = np.random.default_rng(1)
    diffuse, glossy = random.gamma(2, 0.2, (2, 3, 32, 48, 3)).astype(np.float32)
    alpha = random.uniform(0.2, 0.8, (3, 32, 48)).astype(np.float32)
    frames = [
        {"color": d + g, "diffuse": d, "glossy": g, "alpha": a} for d, g, a in zip(diffuse, glossy, alpha, strict=True)
    ]
    frames[1]["color"] = frames[1]["color"].copy()
    frames[1]["color"][5, 6] = np.nan
    whole, part = (
        next(ravg.denoise_arrays(frames, first_pass="nlm", preset="fast", numbers=[1], strength=share)).layers
        for share in (1, strength)
    )
    for name in ("color", "diffuse", "glossy", "alpha"):
        noisy = frames[1][name].reshape(whole[name].shape)
        expected = np.where(np.isfinite(noisy), strength * whole[name] + (1 - strength) * noisy, whole[name])
        np.testing.assert_allclose(part[name], expected, rtol=1e-5, atol=1e-6)


def test_only_the_numbers_that_are_asked_for_are_denoised(shot):
    frames = [{"color": layers["color"]} for layers in layers_of(shot).values()]
    whole = {result.number: result.layers["color"] for result in ravg.denoise_arrays(frames, preset="draft")}
    (middle,) = ravg.denoise_arrays(frames, preset="draft", numbers=[2])
    np.testing.assert_array_equal(middle.layers["color"], whole[2])
    assert [*whole] == [0, 1, 2, 3, 4]


def test_frames_are_looked_up_as_they_are_needed_and_work_ends_where_asked(shot):
    class Lazy(dict):
        def __getitem__(self, number):
            looked_up.append(number)
            return super().__getitem__(number)

    looked_up = []
    frames = Lazy({n: {"color": np.ones((16, 16, 3), np.float32)} for n in range(50)})
    ended = list(ravg.denoise_arrays(frames, preset="draft", progress=lambda result: result.number < 1))
    assert [result.number for result in ended] == [0, 1]
    assert max(looked_up) < 10


@pytest.mark.neural
def test_a_network_takes_a_first_pass_and_aovs_from_memory(shot):
    frames = [
        {**layers, "estimate": layers["color"], "glow": layers["color"]}
        for layers in ({"color": frame["color"]} for frame in layers_of(shot).values())
    ]
    results = [next(ravg.denoise_arrays(frames, first_pass=source)) for source in ("auto", "nlm")]
    assert not np.array_equal(results[0].layers["color"], results[1].layers["color"])
    assert results[0].layers["glow"].shape == (40, 56, 3)


PLAIN = {"color": np.ones((4, 4, 3))}


@pytest.mark.parametrize(
    ("frames", "options", "words"),
    [
        ([], {}, "at least one"),
        ([{"albedo": np.ones((4, 4, 3))}], {}, "expected the layer color"),
        ([{**PLAIN, "motion": np.ones((4, 4, 2))}], {}, "expected its convention"),
        ([PLAIN], {"passes": 2, "method": "network"}, "expected none for frames in memory"),
        ([PLAIN], {"first_pass": "x.####.exr"}, "expected one of"),
        ([PLAIN], {"numbers": [3]}, "frame 3 is not there"),
        ([PLAIN], {"numbers": 0}, "numbers is 0, expected a list"),
        ([PLAIN], {"motion": "none"}, "expected a convention"),
        ([{**PLAIN, "glow": np.ones((4, 4, 3))}], {}, "'glow' is an AOV, expected none"),
        ([{**PLAIN, "Albedo": np.ones((4, 4, 3))}], {}, "layer 'Albedo' is unknown, expected albedo"),
        ([{**PLAIN, "albdeo": np.ones((4, 4, 3))}], {}, "layer 'albdeo' is unknown, expected albedo"),
        ([{"colour": np.ones((4, 4, 3))}], {}, "layer 'colour' is unknown, expected color"),
        ([{"color": np.ones((4, 4, 3), complex)}], {}, "color has type complex128, expected float radiance"),
        ([{"color": np.ones((4, 4, 3), np.uint8)}], {}, "color has type uint8, expected float radiance"),
        ([{**PLAIN, "depth": np.ones((4, 4), int)}], {}, "depth has type int64, expected float"),
        ([{**PLAIN, "depth": np.ones((4, 5))}], {}, r"frame 0: depth is float32 \(4, 5\)"),
        (
            [{**PLAIN, "motion": np.ones((4, 4, 3))}],
            {"motion": "next,pixels,y-down"},
            r"frame 0: motion is \(4, 4, 3\), expected \(4, 4, 2\) for next,pixels,y-down",
        ),
        ([{"color": np.ones((0, 4, 3))}], {}, "expected at least one pixel"),
        ([np.ones((4, 4, 3))], {}, "frame 0 is a ndarray, expected names of layers"),
        (PLAIN, {}, "a mapping of numbers to frames"),
        ((PLAIN for _ in range(2)), {}, "expected a list of at least one frame"),
        ([PLAIN], {"method": "network", "aov_sum": "beauty"}, "AOVs of which the color is the sum"),
    ],
)
def test_what_cannot_be_done_is_refused_at_once(frames, options, words):
    with pytest.raises(ValueError, match=words):
        ravg.denoise_arrays(frames, **({"method": "classical"} | options))


@pytest.mark.neural
def test_light_passes_add_up_to_the_color_as_those_of_files():
    rng = np.random.default_rng(1)
    frames = []
    for _ in range(3):
        parts = {name: rng.gamma(4, 0.25, (24, 32, 3)).astype(np.float32) for name in ("diffuse", "specular")}
        mask = np.ones((24, 32), np.float32)
        frames.append({"color": parts["diffuse"] + parts["specular"], **parts, "mask": mask})
    for result in ravg.denoise_arrays(frames, preset="fast", first_pass="bundled"):
        layers = result.layers
        np.testing.assert_allclose(layers["diffuse"] + layers["specular"], layers["color"], rtol=1e-4, atol=1e-5)
        np.testing.assert_array_equal(layers["mask"], frames[0]["mask"][..., None])  # without noise: not denoised


def moving(vector):
    """Three frames of a picture that moves by 3 pixels to the right, with this vector everywhere."""
    noise = np.random.default_rng(0).gamma(1, 1, (64, 110, 3)).astype(np.float32)
    picture = cv2.GaussianBlur(noise, (0, 0), 1.5)
    vectors = np.zeros((64, 96, 2), np.float32) + np.float32(vector)
    return [{"color": picture[:, 10 - 3 * n : 106 - 3 * n], "motion": vectors} for n in range(3)]


@pytest.mark.parametrize(
    ("vector", "words"),
    [
        ((3, 0), None),
        ((-3, 0), "frames 0 and 1 match along previous,pixels,y-down, not along next,pixels,y-down"),
        ((6, 6), "frames 0 and 1 match along the vectors in no sign or unit"),
    ],
)
def test_vectors_along_which_frames_do_not_match_are_reported_once(vector, words):
    with warnings.catch_warnings(record=True) as found:
        warnings.simplefilter("always")
        assert len(list(ravg.denoise_arrays(moving(vector), motion="next,pixels,y-down", preset="draft"))) == 3
    assert len(found) == (words is not None)
    assert all(words in str(warning.message) and warning.filename == __file__ for warning in found)


def test_a_frame_without_a_finite_pixel_is_refused_and_its_neighbours_are_made_without_it():
    frames = {number: {"color": np.ones((16, 24, 3))} for number in (4, 5, 6)}
    frames[4]["color"][3:] = np.nan
    frames[5]["color"][:] = np.nan
    with pytest.raises(ValueError, match="frame 5: no pixel of color is finite"):
        list(ravg.denoise_arrays(frames, preset="draft", numbers=[5]))
    made = list(ravg.denoise_arrays(frames, preset="draft", numbers=[4, 6]))
    assert all((result.layers["color"] == 1).all() for result in made)


@pytest.mark.parametrize("change", [lambda x: x[::-1].copy()[::-1], lambda x: np.frombuffer(x.tobytes(), x.dtype)])
@pytest.mark.parametrize("layer", ["color", "albedo", "normal"])
@pytest.mark.neural
def test_flipped_and_read_only_arrays_are_read_as_copies_of_them(change, layer):
    layers = {"color": np.float32(0.5), "albedo": np.float32(0.3), "normal": np.float32(0.6)}
    generator = np.random.default_rng(3)
    frames = [
        {name: generator.uniform(0, 1, (16, 24, 3)).astype(np.float32) * value for name, value in layers.items()}
        for _ in range(3)
    ]
    changed = [{**frame, layer: change(frame[layer]).reshape(frame[layer].shape)} for frame in frames]
    images = ([result.layers["color"] for result in ravg.denoise_arrays(given)] for given in (frames, changed))
    np.testing.assert_array_equal(*map(np.stack, images))


def test_frames_of_another_size_are_refused():
    frames = [{"color": np.ones((8, 8, 3))}, {"color": np.ones((8, 9, 3))}]
    with pytest.raises(ValueError, match=r"frame 1 has shape \(8, 9\), expected \(8, 8\)"):
        list(ravg.denoise_arrays(frames, preset="draft"))


@pytest.mark.neural
def test_the_example_runs():
    tried = doctest.testmod(arrays)
    assert (tried.attempted, tried.failed) == (4, 0)
