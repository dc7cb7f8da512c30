"""Layers that make no sense are left out, with one line; they cost nothing but that line."""

import json
import re
from collections.abc import Callable
from dataclasses import replace
from pathlib import Path

import cv2
import numpy as np
import pytest

from hybrid.checks.validation import (
    _check_alpha,
    _check_estimate,
    _match_edges,
    _other_frame,
    find_cut,
    find_lost_light,
    find_nonfinite,
    validate_layers,
)
from hybrid.cli import main
from hybrid.comparison.metrics import psnr
from hybrid.denoising.stream import plan_shot
from hybrid.files.exr import read_exr
from hybrid.files.shots import Shot, open_shot
from hybrid.runtime.kept import Keeper
from tests.hybrid.test_renderers import denoised
from tests.renderers import RENDERERS, SAMPLES, SHOT, Channels, Truth, cycles_vector, layer, save, truths
from tests.scenes import Scene
from tests.seldom import seldom

FRAMES = truths()
REFERENCE = open_shot(SHOT / "reference.0010.exr").read(10).color
LIGHT = "ViewLayer.Combined"
EXAMPLE = Path(__file__).parents[2] / "data" / "bathroom"


def cycles(truth: Truth) -> Channels:
    return RENDERERS["cycles"].files(truth)["shot.####.exr"]


def write(folder: Path, edit: Callable[[int, Channels], None] = lambda index, channels: None) -> Path:
    """The shot as Cycles wrote it, but for what is edited."""
    for index, truth in enumerate(FRAMES):
        channels = cycles(truth)
        edit(index, channels)
        save(folder / f"shot.{truth.number:04d}.exr", channels, RENDERERS["cycles"].attributes)
    return folder / "shot.####.exr"


def without(*layers: str) -> Callable[[int, Channels], None]:
    def edit(index: int, channels: Channels) -> None:
        for name in [
            name for name in channels if name.rpartition(".")[0] in {f"ViewLayer.{known}" for known in layers}
        ]:
            del channels[name]

    return edit


def quality(spec: Path, out: Path, *options: str) -> tuple[float, str]:
    """PSNR of a frame with neighbours on either side, and what was said."""
    made, said = denoised(spec, out, "--frames", "10", *(options or ("--preset", "draft")))
    return psnr(made[10], REFERENCE), said


def stops(spec: Path) -> bool:
    """Whether --strict does."""
    return main(["denoise", "--method=classical", str(spec), "-o", str(spec.parent / "strict"), "--strict"]) == 1


def warnings(said: str) -> list[str]:
    return [line for line in said.splitlines() if line.startswith("warning:") and "old name" not in line]


def vector(change: Callable[[np.ndarray], np.ndarray]) -> Callable[[int, Channels], None]:
    def edit(index: int, channels: Channels) -> None:
        wrong = np.float32(change(cycles_vector(FRAMES[index])))
        channels.update(layer("ViewLayer.Vector", "XYZW", wrong))

    return edit


@pytest.fixture(scope="module")
def found_in_pictures(tmp_path_factory) -> float:
    folder = tmp_path_factory.mktemp("without")
    return quality(write(folder, without("Vector")), folder / "out")[0]


NOISE = np.random.default_rng(0)
WRONG = {
    "sign": lambda v: -v,
    "y": lambda v: v * [1, -1, 1, -1],
    "x": lambda v: v * [-1, 1, -1, 1],
    "transposed": lambda v: v[..., [1, 0, 3, 2]],
    "half": lambda v: 0.5 * v,
    "double": lambda v: 2 * v,
    "black": lambda v: 0 * v,
    "constant": lambda v: 0 * v + 3,
    "noise": lambda v: NOISE.normal(0, 5, v.shape),
    "NDC": lambda v: v / [144, 88, 144, 88],
}


@pytest.mark.parametrize("kind", ["sign", "noise", *seldom("double", "NDC")])
def test_wrong_vectors_are_as_good_as_none(kind, tmp_path, found_in_pictures) -> None:
    spec = write(tmp_path, vector(WRONG[kind]))
    wrong, said = quality(spec, tmp_path / "out")
    # Where the right reading is found it is better; half a hundredth of a decibel is chance.
    assert wrong > found_in_pictures - 0.005
    assert len(warnings(said)) == 1
    assert stops(spec)


ALIKE = "x", "half", "constant"


@pytest.mark.parametrize("kind", [*(kind for kind in WRONG if kind not in ALIKE), *seldom(*ALIKE)])
def test_wrong_vectors_are_named(kind, tmp_path) -> None:
    (warning,) = validate_layers(open_shot(write(tmp_path, vector(WRONG[kind])))).warnings
    assert warning.startswith("motion (ViewLayer.Vector.XYZW)")


def test_right_vectors_are_better_than_found_ones_and_need_no_warning(tmp_path, found_in_pictures) -> None:
    right, said = quality(write(tmp_path), tmp_path / "out")
    assert warnings(said) == []
    assert right > found_in_pictures


def in_shadows(index: int, channels: Channels) -> None:
    """Shadows as of leaves pass over the shot, faster than anything in it."""
    height, width = FRAMES[index].color.shape[:2]
    leaves = cv2.GaussianBlur(np.random.default_rng(1).normal(size=(height, width + 64)), (0, 0), 4)
    shade = np.clip(0.5 + leaves[:, 3 * index :][:, :width] / leaves.std(), 0.1, 1)
    for name in [name for name in channels if name.startswith(f"{LIGHT}.") and name[-1] in "RGB"]:
        channels[name] = np.float32(channels[name] * shade)


def test_right_vectors_are_kept_in_moving_shadows_and_wrong_ones_are_not(tmp_path) -> None:
    def judged(name: str, *edits: Callable[[int, Channels], None]) -> str:
        def edit(index: int, channels: Channels) -> None:
            for change in (in_shadows, *edits):
                change(index, channels)

        return " ".join(validate_layers(open_shot(write(tmp_path / name, edit))).warnings)

    assert judged("right") == ""
    left_out = "no convention explains the pictures"
    assert left_out in judged("noise", vector(WRONG["noise"]))  # more kinds: tests/flow/test_convention.py
    # Guides that make no sense themselves have no say.
    unseen, position = without("Denoising Albedo"), fill(*NORMAL, lambda t, i: t.normal * t.depth[..., None])
    assert judged("normal", unseen) == ""
    assert left_out in judged("none", unseen, without("Denoising Normal"))
    assert left_out in judged("position", unseen, position)


def fill(name: str, components: str, make: Callable[[Truth, int], np.ndarray]) -> Callable[[int, Channels], None]:
    def edit(index: int, channels: Channels) -> None:
        array = np.broadcast_to(
            np.float32(make(FRAMES[index], index)), (*FRAMES[index].color.shape[:2], len(components))
        )
        channels.update(layer(f"ViewLayer.{name}", components, array))

    return edit


ALBEDO, NORMAL = ("Denoising Albedo", "RGB"), ("Denoising Normal", "XYZ")
IMPLAUSIBLE = {
    "black albedo": (fill(*ALBEDO, lambda t, i: 0), ALBEDO[0], "is black: left out"),
    "albedo of one color": (fill(*ALBEDO, lambda t, i: 0.5), ALBEDO[0], "is constant: left out"),
    "negative albedo": (fill(*ALBEDO, lambda t, i: t.normal), ALBEDO[0], "is negative in"),
    "light as albedo": (fill(*ALBEDO, lambda t, i: 50 * t.color), ALBEDO[0], "is above 2 in"),
    "albedo of the previous frame": (
        fill(*ALBEDO, lambda t, i: FRAMES[max(i - 1, 0)].albedo), ALBEDO[0], "belongs to the previous frame"
    ),
    "albedo of the next frame": (
        fill(*ALBEDO, lambda t, i: FRAMES[min(i + 1, 3)].albedo), ALBEDO[0], "belongs to the next frame"
    ),
    "constant normal": (fill(*NORMAL, lambda t, i: [0, 0, 1]), NORMAL[0], "is constant: left out"),
    "position as normal": (fill(*NORMAL, lambda t, i: t.normal * t.depth[..., None]), NORMAL[0], "is longer than 1 in"),
    "normal of the previous frame": (
        fill(*NORMAL, lambda t, i: FRAMES[max(i - 1, 0)].normal), NORMAL[0], "belongs to the previous frame"
    ),
    "constant depth": (fill("Depth", "Z", lambda t, i: 7), "Depth", "depth (ViewLayer.Depth.Z) is constant"),
    "no variance": (fill("variance", "RGB", lambda t, i: 0), "variance", "is 0 everywhere: left out"),
    "negative variance": (fill("variance", "RGB", lambda t, i: t.normal), "variance", "is negative in"),
    "variance times 500": (fill("variance", "RGB", lambda t, i: 500 * t.variance), "variance", "times that of"),
    "variance over 20": (fill("variance", "RGB", lambda t, i: t.variance / 20), "variance", "times that of"),
}  # fmt: skip


@pytest.mark.parametrize(("edit", "layer", "message"), IMPLAUSIBLE.values(), ids=IMPLAUSIBLE)
def test_an_implausible_layer_is_left_out(edit, layer, message, tmp_path) -> None:
    shot = open_shot(write(tmp_path, edit))
    judgement = validate_layers(shot)
    (warning,) = judgement.warnings
    assert message in warning
    before, after = (str(judged.layers(10)) for judged in (shot, judgement.apply(shot)))
    assert f"ViewLayer.{layer}" in before
    assert f"ViewLayer.{layer}" not in after


def test_an_alpha_that_is_the_color_is_not_filtered(tmp_path) -> None:
    def edit(index: int, channels: Channels) -> None:
        channels[f"{LIGHT}.A"] = channels[f"{LIGHT}.R"]

    spec = write(tmp_path, edit)
    _, said = quality(spec, tmp_path / "out", "--preset", "draft", "-v")
    assert [line for line in warnings(said) if "alpha (ViewLayer.Combined.A) is the color: left out" in line]
    assert "alpha" not in next(line for line in said.splitlines() if line.startswith("layers:"))
    before, after = (
        read_exr(path).channel(f"{LIGHT}.A")
        for path in (tmp_path / "shot.0010.exr", tmp_path / "out" / "shot.0010.exr")
    )
    np.testing.assert_array_equal(before, after)


def test_a_denoised_picture_that_is_the_noisy_one_is_no_estimate(tmp_path) -> None:
    def edit(index: int, channels: Channels) -> None:
        channels.update({f"ViewLayer.Noisy Image.{c}": channels[f"{LIGHT}.{c}"] for c in "RGBA"})

    shot = open_shot(write(tmp_path, edit))
    judgement = validate_layers(shot)
    (warning,) = judgement.warnings
    assert warning.startswith("estimate (ViewLayer.Combined.RGB) is the noisy picture: left out, another first pass")
    layers = judgement.apply(shot).layers(10)
    assert layers.estimate is None
    assert str(layers.target) == "ViewLayer.Combined.RGB"  # which the denoised picture replaces all the same


@pytest.mark.parametrize("light", [lambda i: i != 2, lambda i: i % 2, lambda i: 0.003**i, lambda i: i == 2])
@pytest.mark.parametrize("step", [(0, 0), (2, 1)])
def test_a_black_frame_is_no_reason_to_leave_out_the_albedo(tmp_path, step, light) -> None:
    """The albedo of a still shot fits the lit frame beside a black one as well as its own."""

    def lit(index: int, layers: dict[str, np.ndarray]) -> None:
        layers[LIGHT] = layers[LIGHT] * np.float32(light(index))

    shot = open_shot(Scene(height=64, width=96, frames=4, step=step).write(tmp_path, edit=lit))
    assert not [line for line in validate_layers(shot).warnings if "albedo" in line]


def test_edges_that_match_no_frame_belong_to_none() -> None:
    """The albedo of a room where lamps light single objects correlates with the next frame by chance."""
    rng = np.random.default_rng(6)
    shown = [rng.normal(size=(108, 192)).astype(np.float32) for _ in range(2)]
    found = [rng.normal(size=(108, 192)).astype(np.float32) for _ in range(2)]
    found[0] += np.float32(0.08) * shown[1]
    match = _match_edges(found, shown)
    assert match.early > match.centre + 0.05
    assert _other_frame([match]) is None
    found[0] += np.float32(0.5) * shown[1]
    assert "the next frame" in _other_frame([_match_edges(found, shown)])


def test_equal_zeros_are_no_evidence() -> None:
    rng = np.random.default_rng(4)
    color = np.zeros((64, 96, 3), np.float32)
    alpha = np.zeros((64, 96), np.float32)
    color[30:34, 40:44] = rng.uniform(0.2, 1, (4, 4, 3))
    alpha[30:34, 40:44] = 1
    estimate = color * np.float32(1.1)
    assert _check_estimate(estimate, color) is None
    assert _check_alpha(alpha, color) is None
    assert _check_estimate(color, color) == "is the noisy picture"
    assert _check_alpha(color[..., 1], color) == "is the color"


@pytest.mark.parametrize("factor", [1.0, 1.8])
def test_an_estimate_of_another_level_is_brought_to_that_of_the_samples(factor, tmp_path) -> None:
    def edit(index: int, channels: Channels) -> None:
        noisy = np.stack([channels[f"{LIGHT}.{c}"] for c in "RGB"], axis=-1)
        clean = cv2.blur(noisy, (5, 5)) * np.float32(factor)
        channels.update({f"ViewLayer.Noisy Image.{c}": channels[f"{LIGHT}.{c}"] for c in "RGBA"})
        channels.update(layer(LIGHT, "RGB", clean))

    shot = open_shot(write(tmp_path, edit))
    judgement = validate_layers(shot)
    before, after = (opened.read(10).estimate for opened in (shot, judgement.apply(shot)))
    if factor == 1:
        assert judgement.estimate_factors is None
        np.testing.assert_array_equal(before, after)
    else:
        assert "times the level of the samples" in judgement.warnings[0]
        assert after.mean() == pytest.approx(shot.read(10).color.mean(), rel=0.03)


@pytest.mark.parametrize("encoded", [True, False])
def test_color_behind_a_log_curve_is_named(encoded: bool, tmp_path: Path) -> None:
    """It was averaged as if it were light: 3 % too dark, without a word."""

    def encode(index: int, layers: dict[str, np.ndarray]) -> None:
        light = layers[LIGHT]
        light[:, :20] = 0 if encoded else 0.051  # Blender's gray world is no log curve's black
        if encoded:  # ACEScct
            linear = light <= 0.0078125
            logarithm = (np.log2(np.maximum(light, 0.0078125)) + 9.72) / 17.52
            light[:] = np.where(linear, 10.5402377 * light + 0.0729055, logarithm)

    findings = validate_layers(open_shot(Scene(height=64, width=96).write(tmp_path, edit=encode))).findings
    said = [finding.message for finding in findings if finding.role == "color"]
    assert len(said) == encoded
    assert not encoded or "looks encoded by a log curve (black is 0.073, nothing is above 1.5)" in said[0]


def test_what_makes_sense_gives_no_finding() -> None:
    judgement = validate_layers(open_shot(SHOT / "noisy.####.exr"))
    assert judgement.findings == ()
    assert judgement.motion is not None
    assert judgement.variance_scale is None


def test_pairs_of_large_frames_lie_in_files_and_are_judged_alike(tmp_path, monkeypatch) -> None:
    """Two pairs of 7680×4320 took 10.4 GiB, more than a frame that is denoised under a limit of 6 GiB."""
    wrong = write(tmp_path, vector(lambda v: -v))
    expected = validate_layers(open_shot(wrong))
    monkeypatch.setattr("hybrid.checks.validation.LARGE", 0)
    monkeypatch.setattr("hybrid.runtime.kept.SMALLEST", 1)
    released: list[int] = []
    release = Keeper.release
    monkeypatch.setattr(Keeper, "release", lambda keeper: released.append(1) or release(keeper))
    found = validate_layers(open_shot(wrong))
    # For each of two pairs: two frames kept, two checked, three edges, light, albedo and normal.
    assert len(released) == 2 * 10
    assert found.findings == expected.findings
    assert found.motion == expected.motion


def test_no_frame_is_read_twice_and_a_second_pair_only_where_one_leaves_a_question(tmp_path, monkeypatch) -> None:
    bundled, wrong = EXAMPLE / "noisy.####.exr", write(tmp_path, vector(lambda v: -v))
    read = Shot.read
    for spec, motion, count in ((bundled, None, 2), (bundled, "auto", 2), (wrong, None, 4)):
        numbers: list[int] = []
        monkeypatch.setattr(Shot, "read", lambda shot, number, seen=numbers: seen.append(number) or read(shot, number))
        validate_layers(open_shot(spec, motion=motion))
        assert len(numbers) == len(set(numbers)) == count, (spec, motion)


def test_the_judgement_is_of_the_shot_and_not_of_the_frames_asked_for(tmp_path) -> None:
    def edit(index: int, channels: Channels) -> None:
        if index != 0:
            channels.update(layer("ViewLayer.Vector", "XYZW", 0 * cycles_vector(FRAMES[index])))

    spec = write(tmp_path, edit)
    judged = [validate_layers(open_shot(spec, frames=frames)) for frames in (None, "9", "11-12")]
    assert judged[0] == judged[1] == judged[2]


def test_variance_of_samples_is_divided_by_their_number_or_by_what_the_picture_shows(tmp_path) -> None:
    spec = write(tmp_path / "told", fill("variance", "RGB", lambda t, i: SAMPLES * t.variance))
    judgement = validate_layers(open_shot(spec))
    assert judgement.variance_scale == 1 / SAMPLES  # Cycles' header says how many
    assert len(judgement.warnings) == 1  # but not that the variance is theirs
    frame = judgement.apply(open_shot(spec)).read(10)
    np.testing.assert_allclose(frame.variance, FRAMES[1].variance, rtol=1e-5)

    # MoonRay's is documented as that of samples, whose number nothing tells.
    moonray = replace(RENDERERS["moonray"], files=lambda t: {
        "shot.####.exr": RENDERERS["moonray"].files(t)["shot.####.exr"] | layer("variance", "Y", 9 * t.variance[..., 1])
    })  # fmt: skip
    judgement = validate_layers(open_shot(moonray.write(tmp_path / "measured", FRAMES)))
    assert judgement.warnings == ()
    assert judgement.variance_scale == pytest.approx(1 / 9, rel=0.5)


def test_a_shot_of_one_frame_is_judged_too(tmp_path) -> None:
    save(tmp_path / "still.exr", cycles(FRAMES[0]) | layer("ViewLayer.Denoising Albedo", "RGB", 0 * FRAMES[0].albedo))
    judgement = validate_layers(open_shot(tmp_path / "still.exr"))
    assert [finding.role for finding in judgement.findings] == ["albedo"]
    assert judgement.motion is None


def test_vectors_are_not_judged_over_a_cut(tmp_path) -> None:
    def edit(index: int, channels: Channels) -> None:
        if index >= 1:
            channels.update({name: np.ascontiguousarray(plane[::-1, ::-1]) for name, plane in channels.items()})
            channels.update({name: -plane for name, plane in channels.items() if ".Vector." in name})

    spec = write(tmp_path, edit)
    judgement = validate_layers(open_shot(spec))
    assert judgement.findings == ()
    assert judgement.motion is not None
    assert judgement.motion.convention is not None
    assert plan_shot(judgement.apply(open_shot(spec))).cuts == ((9, 10),)


def test_a_cut_anywhere_is_noticed_said_once_and_nothing_is_averaged_over_it(tmp_path) -> None:
    """Also between the pairs that are judged before anything runs."""

    def edit(index: int, channels: Channels) -> None:
        if index >= 2:
            channels.update({name: np.ascontiguousarray(plane[::-1, ::-1]) for name, plane in channels.items()})
            channels.update({name: -plane for name, plane in channels.items() if ".Vector." in name})

    spec = write(tmp_path / "cut", edit)
    assert validate_layers(open_shot(spec)).warnings == ()
    made, said = denoised(spec, tmp_path / "out", "--preset", "draft")
    assert warnings(said) == [f"warning: {find_cut(10, 11).message}"]
    (record,) = (tmp_path / "out" / "ravg").glob("*.json")
    assert find_cut(10, 11).message in record.read_text()
    # As if the other half were not there.
    for number in (11, 12):
        (tmp_path / "cut" / f"shot.{number:04d}.exr").unlink()
    alone, _ = denoised(spec, tmp_path / "alone", "--preset", "draft")
    for number in (9, 10):
        np.testing.assert_array_equal(made[number], alone[number])


def test_a_gap_in_the_numbers_is_said_and_in_the_record(tmp_path) -> None:
    spec = write(tmp_path / "gap")
    (tmp_path / "gap" / "shot.0011.exr").unlink()
    _, said = denoised(spec, tmp_path / "out", "--preset", "draft")
    words = "missing frames 11: the windows beside them are narrower"
    assert warnings(said) == [f"warning: {words}"]
    (record,) = (tmp_path / "out" / "ravg").glob("*.json")
    assert json.loads(record.read_text())["warnings"] == [words]
    assert stops(spec)


def test_inspect_says_a_cut_and_is_strict_about_it(tmp_path, capsys) -> None:
    def edit(index: int, channels: Channels) -> None:
        if index >= 2:
            channels.update({name: np.ascontiguousarray(plane[::-1, ::-1]) for name, plane in channels.items()})

    spec = write(tmp_path, edit)
    assert main(["inspect", str(spec), "--motion", "none", "--json"]) == 0
    out, err = capsys.readouterr()
    assert "cut between frames 10 and 11" in " ".join(err.split())
    assert "cut between frames 10 and 11" in json.loads(out)["findings"][-1]["message"]
    assert main(["inspect", str(spec), "--motion", "none", "--strict"]) == 1
    words = ["denoise", "--method=classical", str(spec), "-o", str(tmp_path / "o"), "--motion", "none"]
    assert main([*words, "--strict"]) == 1
    assert not list((tmp_path / "o").glob("*.exr"))  # not even what comes before the cut


def test_the_table_has_the_reading_that_is_taken_and_no_crowd_of_fitted_scales() -> None:
    rows = validate_layers(open_shot(SHOT / "noisy.####.exr")).readings()
    assert [said for taken, said, _ in rows if taken] == ["cycles,pixels,y-up"]
    assert rows[-1][1] in ("no motion", "optical flow of the pictures")
    assert len([said for _, said, _ in rows if said.startswith("cycles,pixels,y-up,scale=0.9")]) <= 1


# --- what comes out


def test_a_picture_of_another_brightness_is_found_and_noise_is_not():
    rng = np.random.default_rng(0)
    truth = rng.uniform(0.5, 2, (40, 56, 3)).astype(np.float32)
    noisy = truth * rng.gamma(0.2, 5, (40, 56, 1)).astype(np.float32)  # four samples a pixel of a hard light, say
    valid = np.ones((40, 56), bool)
    assert find_lost_light(truth, noisy, valid) is None
    for scale, said in ((3, "[23].* times the light in channel R"), (0.3, "0.[23].* times the light in channel R")):
        assert re.search(said, find_lost_light(np.float32(scale) * truth, noisy, valid))
    red = truth.copy()
    red[..., 1] = 0
    assert "channel G" in find_lost_light(red, noisy, valid)
    for scale in (1e-12, 1e12):
        assert find_lost_light(np.float32(scale) * truth, np.float32(scale) * noisy, valid) is None
        assert find_lost_light(np.float32(4 * scale) * truth, np.float32(scale) * noisy, valid) is not None


def test_what_one_sample_carries_is_no_lost_light():
    """A firefly of a million times the light of all others together."""
    noisy = np.ones((40, 56, 3), np.float32)
    noisy[3, 4] = 1e6
    assert find_lost_light(np.ones_like(noisy), noisy, np.ones((40, 56), bool)) is None


def test_light_is_looked_for_only_where_it_was_rendered():
    noisy, valid = np.ones((8, 8, 3), np.float32), np.zeros((8, 8), bool)
    assert find_lost_light(5 * noisy, noisy, valid) is None
    valid[0] = True
    assert find_lost_light(5 * noisy, noisy, valid) is not None
    dark = np.zeros_like(noisy)
    valid[:] = True
    assert find_lost_light(noisy, dark, valid, lambda: 100.0) is None  # a hundredth of what is beside it
    assert "light where none was rendered" in find_lost_light(noisy, dark, valid, lambda: 2.0)


def test_pixels_that_are_not_finite_are_counted():
    picture = np.ones((4, 5, 3), np.float32)
    assert find_nonfinite(picture) is None
    assert find_nonfinite(np.full((4, 5), 3e38, np.float32)) is None
    picture[0, :2, 1], picture[1, 1] = np.inf, np.nan
    assert find_nonfinite(picture) == "3 of 20 pixels are not finite"
