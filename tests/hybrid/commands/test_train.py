"""The commands `prepare` and `train`, and what `denoise` says of a network's work."""

import os
import re
import shutil
import sys
from dataclasses import fields
from pathlib import Path

import cv2
import numpy as np
import pytest

from tests.scenes import Scene

torch = pytest.importorskip("torch")

from hybrid.cli import main  # noqa: E402
from hybrid.commands.shots import ShotInput  # noqa: E402
from hybrid.commands.train import open_levels, parse_samples  # noqa: E402
from hybrid.files.exr import read_exr  # noqa: E402
from hybrid.files.profile import open_profile  # noqa: E402
from hybrid.files.shots import open_shot  # noqa: E402
from hybrid.files.sources import MADE_FROM  # noqa: E402
from hybrid.neural import TrainInputs  # noqa: E402
from network.checkpoint import load_model, save_model  # noqa: E402
from network.presets import build_preset  # noqa: E402
from network.robust_unet import RobustUNet, RobustUNetConfig  # noqa: E402
from network.training.clips import open_clips  # noqa: E402
from network.training.config import SamplerConfig, TrainConfig  # noqa: E402
from tests.exr_files import write_layers  # noqa: E402
from tests.network.small import notes_of  # noqa: E402

pytestmark = pytest.mark.neural

SCENE = Scene(height=40, width=48)


@pytest.fixture(scope="module")
def shot(tmp_path_factory):
    """A shot at three levels with a reference, as ravg simulate leaves it."""
    folder = tmp_path_factory.mktemp("shots") / "wall"
    folder.mkdir()
    for number, level in enumerate(("a", "b", "c", "reference")):
        scene = Scene(height=40, width=48, noise=0.2 + 0.1 * number)
        for path in sorted(scene.write(folder / level).glob("*.exr")):
            path.rename(folder / path.name.replace("shot", level))
        (folder / level).rmdir()
    return folder


@pytest.fixture(scope="module")
def weights(tmp_path_factory):
    """A final stage of three frames without a U-Net: what one makes that is not trained is no image."""
    path = tmp_path_factory.mktemp("weights") / "small.safetensors"
    model = RobustUNet(RobustUNetConfig(frames=3, size="none"))
    save_model(path, model)
    return path


def run(*arguments):
    return main([str(argument) for argument in arguments])


def test_what_makes_no_sense_at_one_level_is_left_out_of_the_clips(shot, tmp_path, capsys):
    kept = tmp_path / "wall"
    shutil.copytree(shot, kept)
    for path in kept.glob("b.*.exr"):
        image = read_exr(path)
        layers = {layer.name: image.pixels(layer.channels) for layer in image.layers}
        layers["ViewLayer.Denoising Albedo"][:] = 0
        write_layers(path, layers)
    options = [kept, "-o", tmp_path / "clips", "--levels", "a=24,b=24", "--tile", 0]
    options += ["--first-pass", "nlm", "--window", 3]
    assert run("make-clips", *options, "--strict") == 1
    assert not list((tmp_path / "clips").glob("*.safetensors"))
    assert run("make-clips", *options, "--motion", "none") == 0
    said = " ".join(capsys.readouterr().err.split())
    assert "b: albedo (ViewLayer.Denoising Albedo.RGB) is black: left out" in said
    assert "a: albedo" not in said
    assert run("make-clips", *options, "--motion", "sideways") == 2


def test_a_cut_is_said_of_the_shot_that_has_it(shot, tmp_path, capsys):
    for name in ("one", "cut"):
        shutil.copytree(shot, tmp_path / name)
    *_, last = sorted((tmp_path / "cut").glob("a.*.exr"))
    image = read_exr(last)
    layers = {layer.name: image.pixels(layer.channels)[::-1, ::-1].copy() for layer in image.layers}
    write_layers(last, layers)
    options = ("--levels", "a=24", "--tile", 0, "--first-pass", "nlm", "--window", 3, "--motion", "none")
    words = ("make-clips", tmp_path / "one", tmp_path / "cut", "-o", tmp_path / "clips", *options)
    assert run(*words) == 0
    said = " ".join(capsys.readouterr().err.split())
    assert "cut: cut between frames 1002 and 1003" in said
    assert "one: frames" not in said
    shutil.rmtree(tmp_path / "clips")
    assert run(*words, "--strict") == 1


def test_clips_are_prepared_towards_references_where_asked(shot, tmp_path):
    kept = tmp_path / "wall"
    shutil.copytree(shot, kept)
    (kept / f"reference.{SCENE.first}.exr").unlink()
    levels = ("--levels", "a=24,c=8", "--tile", 0, "--first-pass", "nlm", "--window", 3)
    assert run("make-clips", kept, "-o", tmp_path / "clips", *levels, "--reference") == 0
    clips = open_clips(tmp_path / "clips")
    assert len(clips) == SCENE.frames - 1  # those that have one
    assert clips.pairs(0) == [[(0, "reference")], [(1, "reference")]]
    values = clips.read(0, 0, (0, "reference"))
    wanted = open_shot(str(kept / "reference.####.exr")).read(SCENE.first + 1).color
    ratio = values.target.float().permute(1, 2, 0).numpy() / wanted
    np.testing.assert_allclose(ratio, np.median(ratio), rtol=2e-3)  # over the exposure, in half


def test_targets_are_half_the_teachers_where_asked(shot, weights, tmp_path, capsys):
    options = ("--levels", "a=24,c=8", "--tile", 0, "--first-pass", "nlm", "--frames", SCENE.first, "--reference")
    for name, more in (("plain", ()), ("taught", ("--teacher", weights))):
        assert run("make-clips", shot, "-o", tmp_path / name, *options, "--window", 3, *more) == 0
    plain, taught = (
        [open_clips(tmp_path / name).read(0, level, (level, "reference")).target for level in range(2)]
        for name in ("plain", "taught")
    )
    assert torch.equal(*plain)  # levels share the reference
    assert not torch.equal(*taught)  # each has its own window's
    assert run("make-clips", shot, "-o", tmp_path / "no", *options, "--teacher", weights) == 1
    assert "teacher: expected --window 3, as" in capsys.readouterr().err
    assert run("make-clips", shot, "-o", tmp_path / "no", "--teacher", weights) == 2  # nothing to take the half of


def test_clips_are_prepared_towards_the_pseudo_references_of_a_level_where_asked(shot, tmp_path, capsys):
    options = (shot, "-o", tmp_path / "clips", "--tile", 0, "--first-pass", "nlm")
    levels = ("--levels", "a=24,b=24,c=8")
    assert run("make-clips", *options, *levels, "--target", "d") == 1
    assert "target: expected a level of wall that is not the only one, a, b, c, got 'd'" in capsys.readouterr().err
    assert run("make-clips", *options, *levels, "--target", "b", "--reference") == 2
    assert run("make-clips", *options, *levels, "--target", "b", "--frames", SCENE.first + 1) == 0
    clips = open_clips(tmp_path / "clips")
    both = [[(level, kind) for kind in ("reference", "rendered")] for level in range(2)]
    assert clips.pairs(0) == both  # b is none of them


def test_one_sequence_is_prepared_towards_the_reference_beside_it(shot, tmp_path):
    (tmp_path / "wall.b.0000.safetensors").touch()  # another shot's, whose name begins alike
    options = ("--tile", 0, "--first-pass", "nlm", "--window", 3, "--reference", "--frames", SCENE.first)
    assert run("make-clips", shot / "a.####.exr", "-o", tmp_path, *options) == 0
    assert (tmp_path / "wall.0000.safetensors").is_file()


def test_levels_of_a_shot_are_found_without_its_references(shot):
    name, levels, samples = open_levels(str(shot), {"a": 24, "c": 8})
    assert (name, list(levels), samples) == ("wall", ["a", "c"], [24, 8])
    with pytest.raises(ValueError, match=r"no samples in the header of a; expected --levels a=SAMPLES"):
        open_levels(str(shot))
    name, levels, samples = open_levels(str(shot / "a.####.exr"))
    assert (name, list(levels), samples) == ("wall", ["a"], [1])
    with pytest.raises(FileNotFoundError, match=r"levels: expected a, d in .*, got a, b, c, reference"):
        open_levels(str(shot), {"a": 24, "d": 8})


def test_levels_are_read_as_the_options_say(shot):
    albedo = "ViewLayer.Denoising Albedo"
    read = ShotInput(
        shot=str(shot), frames=str(SCENE.first), layer=[f"albedo={albedo}"], profile="arnold", motion="none"
    )
    level = open_levels(str(shot), {"a": 24}, read).first
    assert level.numbers == (SCENE.first,)
    assert level.profile.name == open_profile("arnold").name
    assert level.reader.files.layers == {"albedo": albedo}
    assert "motion" in level.reader.interpretation.left_out


def test_samples_are_read_from_cycles_headers():
    _, levels, samples = open_levels("examples/shot", {"noisy": 16})
    assert samples == [16]
    header = read_exr(levels["noisy"].path(8), pixels=False).parts[0].header
    assert any(key.startswith("cycles.") for key in header) == (open_levels("examples/shot")[2] == [16])


@pytest.mark.parametrize("text", ["", "a", "a=", "a=0", "a=x", "=4", "a=4,,b=4"])
def test_levels_that_are_no_list_are_an_error(text):
    with pytest.raises(ValueError, match="levels: expected NAME=SAMPLES"):
        parse_samples(text)


def test_clips_are_prepared_and_trained_on(shot, tmp_path, capsys, monkeypatch):
    clips, out = tmp_path / "clips", tmp_path / "w.safetensors"
    other = tmp_path / "other"
    shutil.copytree(shot, other)
    options = ["--levels", "a=24,b=24,c=8", "--window", "3", "--first-pass", "nlm"]
    assert run("make-clips", shot, "-o", clips, "--tile", "32", "--tiles", "2", *options) == 0
    assert run("make-clips", shot, other, "-o", clips, "--tile", "0", *options) == 0  # the first is there already
    found = open_clips(clips)
    assert (found.shots, len(found.of(["other"]))) == (["other", "wall"], 3)
    assert 3 <= len(found.of(["wall"])) <= 6  # two tiles of a frame, if they fit half a tile apart

    plain = ["train", clips, "-o", out, "--crop", "32", "--batch", "1", "--threads", "1", "--float32"]
    assert run(*plain, "--steps", "1") == 1
    said = "expected windows of 5 frames, as balanced has, got 3; --window 3 trains a network of so many"
    assert said in " ".join(capsys.readouterr().err.split())
    train = [*plain, "--window", "3"]
    with monkeypatch.context() as without:
        without.setitem(sys.modules, "tensorboardX", None)
        assert run(*train, "--steps", "2", "--tensorboard", tmp_path / "logs") == 1
    said = 'error: tensorboardX is not installed; expected: pip install "tensorboardX"'
    assert capsys.readouterr().err.splitlines()[-1] == said
    assert run(*train, "--steps", "2", "--validation", "other", "--tensorboard", tmp_path / "logs") == 0
    assert "denoised" in capsys.readouterr().err
    assert notes_of(out)["training"]["steps"] == 2
    assert load_model(out).config.frames == 3
    assert list((tmp_path / "logs").glob("events.*"))

    # On one's own footage, one level and no reference, from weights there are.
    own = tmp_path / "own"
    words = ["--tile", "32", "--window", "3", "--first-pass", "nlm"]
    assert run("make-clips", shot / "a.####.exr", "-o", own, *words) == 0
    tuned = tmp_path / "tuned.safetensors"
    assert run("train", own, "-o", tuned, "--init", out, "--steps", "1", "--crop", "32", "--rate", "1e-4") == 0
    assert load_model(tuned).config == load_model(out).config

    capsys.readouterr()
    for more, message in (
        (["--steps", "1", "--resume"], "resume: no file"),
        (["--steps", "1", "--crop", "40"], "crop: expected a multiple of 16, as this model needs, got 40"),
        (["--steps", "1", "--init", "fast"], "expected windows of 5 frames as fast has, got 3"),
        (["--steps", "1", "--validation", "nowhere"], "expected shots among"),
    ):
        assert run(*train, *more) == 1
        assert message in capsys.readouterr().err
    assert run("train", tmp_path / "logs", "-o", out, "--steps", "1") == 1
    assert "expected what ravg make-clips writes" in capsys.readouterr().err


# Every field of a training's configuration: the words that set it, and what they make of it.
OPTIONS = {
    "steps": (["--steps", 7], 7),
    "minutes": (["--minutes", 1.5], 1.5),
    "batch": (["--batch", 3], 3),
    "rate": (["--rate", 2e-3], 2e-3),
    "backbone_rate": (["--backbone-rate", 0.5], 0.5),
    "warmup": (["--warmup", 11], 11),
    "clip_norm": (["--clip", 0.5], 0.5),
    "ema": (["--ema", 0.9], 0.9),
    "loss": (["--loss", "perceptual"], "perceptual"),
    "vgg": (["--vgg", "vgg.pth"], "vgg.pth"),
    "against": (["--against", "start"], "start"),
    "terms": (["--terms", "power"], "power"),
    "whole": (["--whole", 0.25], 0.25),
    "differences": (["--differences", 0.75], 0.75),
    "slope": (["--slope", 2], 2.0),
    "float32": (["--float32"], True),
    "compile": (["--compile"], True),
    "device": (["--device", "cpu"], "cpu"),
    "workers": (["--workers", 2], 2),
    "seed": (["--seed", 5], 5),
    "validate_minutes": (["--validate-minutes", 3], 3.0),
    "sampler": (["--crop", 64, "--sets", 4, "--pseudo", 0.25], SamplerConfig(crop=64, sets=4, pseudo=0.25)),
}
NOT_OFFERED = {"weight_decay"}


@pytest.fixture
def asked(monkeypatch):
    """The calls of `train_network`, which trains nothing here."""
    calls = []
    monkeypatch.setattr("hybrid.neural.train_network", lambda *given, **more: calls.append((given, more)))
    return calls


def test_what_is_not_said_is_as_the_configuration_has_it(asked):
    assert run("train", "clips", "-o", "w.safetensors", "--steps", 7) == 0
    (((inputs, output, config), more),) = asked
    assert (inputs, str(output)) == (TrainInputs(Path("clips"), "balanced"), "w.safetensors")
    assert config == TrainConfig(steps=7)
    del more["log"]
    assert more == {"threads": None, "resume": False}


def test_every_option_arrives_where_it_belongs(asked):
    words = [word for option, _ in OPTIONS.values() for word in option]
    more = ["--preset", "quality", "--init", "balanced", "--window", 7, "--threads", 2, "--resume"]
    assert run("train", "clips", "-o", "w.safetensors", *words, *more, "--validation", "a,b", "--validation", "c") == 0
    (((inputs, _, config), settings),) = asked
    assert set(OPTIONS) | NOT_OFFERED == {field.name for field in fields(TrainConfig)}
    plain = TrainConfig(steps=1)
    for name, (_, value) in OPTIONS.items():
        assert getattr(config, name) == value, name
        assert getattr(plain, name) != value, f"{name}: the same without the option"
    assert inputs == TrainInputs(Path("clips"), "quality", "balanced", 7, ("a", "b", "c"))
    del settings["log"]
    assert settings == {"threads": 2, "resume": True}


def test_losses_over_those_at_the_start_need_weights_to_start_from(asked, capsys):
    assert run("train", "clips", "-o", "w.safetensors", "--steps", 1, "--against", "start") == 2
    assert "--against is 'start', expected 'input' without --init" in " ".join(capsys.readouterr().err.split())
    assert not asked


def test_the_former_name_of_an_option_still_works(asked):
    assert run("train", "clips", "-o", "w.safetensors", "--steps", 1, "--trunk-rate", 0.5) == 0
    (((_, _, config), _),) = asked
    assert config.backbone_rate == 0.5


@pytest.mark.posix
def test_training_writes_over_no_clip_and_not_over_what_it_starts_from(tmp_path, capsys):
    for name in ("wall.0000.safetensors", "mine.safetensors", "own.safetensors.state"):
        (tmp_path / name).write_text(name)
    (tmp_path / "link.safetensors").symlink_to("wall.0000.safetensors")
    for output, said in (
        ("wall.0000.safetensors", "output .* would overwrite an input: clip"),
        ("link.safetensors", "output .* would overwrite an input: clip"),
        ("mine.safetensors", "output .* would overwrite an input"),
    ):
        options = ("--steps", 1, "--init", tmp_path / "mine.safetensors")
        assert run("train", tmp_path, "-o", tmp_path / output, *options) == 1
        assert re.search(said, capsys.readouterr().err)
        assert (tmp_path / output).read_text() in ("wall.0000.safetensors", "mine.safetensors")


def test_a_breakdown_is_written_and_printed(shot, weights, tmp_path, capsys):
    picture = tmp_path / "parts.png"
    options = ["--weights", weights, "--first-pass", "nlm", "--precision", "float32", "--breakdown", picture]
    assert run("denoise", shot / "a.####.exr", "-o", tmp_path / "out", *options) == 0
    assert picture.stat().st_size > 1000
    printed = capsys.readouterr().out
    for name in ("before1", "centre", "after1"):
        assert name in printed
    layers = [f"{kind}.{name}" for kind in ("contribution", "weight") for name in ("before1", "centre", "after1")]
    frame = open_shot(tmp_path / "out", aovs=layers).read(SCENE.first + 1)
    total = sum(frame.aovs[layer] for layer in layers[:3])
    # Together they are what was gathered, whose local mean the picture has.
    assert total.mean() == pytest.approx(frame.color.mean(), rel=0.03)
    np.testing.assert_allclose(sum(frame.aovs[layer] for layer in layers[3:]), 1, rtol=2e-3)


@pytest.mark.parametrize("give_way", ["layers", "beauty"])
def test_layers_in_the_file_add_up_to_the_beauty_in_it(give_way, weights, tmp_path):
    """Light without its color, with alpha beside it; in files of half floats, of whose rounding the mean is free."""
    scene = Scene(height=40, width=48)

    def split(index, layers):
        color = layers["ViewLayer.Combined"]
        share = np.random.default_rng(index).uniform(0.2, 0.8, (40, 48, 1)).astype(np.float32)
        layers["ViewLayer.DiffCol"] = layers["ViewLayer.Denoising Albedo"].copy()
        layers["ViewLayer.DiffDir"] = share * color / layers["ViewLayer.DiffCol"]
        layers["ViewLayer.GlossDir"] = (1 - share) * color
        layers["ViewLayer.Combined"] = np.dstack([color, np.ones((40, 48), np.float32)])

    folder = scene.write(tmp_path / "in", edit=split)
    options = ["--weights", weights, "--first-pass", "nlm", "--precision", "float32", "--frames", scene.first + 1]
    parts = ("DiffDir", "GlossDir")
    assert run("denoise", folder, "-o", tmp_path / "out", *options, "--aov", "all", "--aov-sum", give_way) == 0
    frame = open_shot(tmp_path / "out", aovs=(*parts, "DiffCol")).read(scene.first + 1)
    together = frame.aovs["DiffDir"] * frame.aovs["DiffCol"] + frame.aovs["GlossDir"]
    assert abs((together - frame.color).mean()) < 1e-4 * frame.color.mean()
    np.testing.assert_array_equal(frame.alpha, 1)
    assert run("denoise", folder, "-o", tmp_path / "alone", *options) == 0
    alone = open_shot(tmp_path / "alone").read(scene.first + 1)
    assert np.array_equal(alone.color, frame.color) == (give_way == "layers")


def test_a_second_pass_reaches_further_in_time(weights, tmp_path, capsys):
    """A window of three frames sees the second frame from the first; what is in the third comes by way of that."""

    def other(index, layers):
        if index == 2:
            grain = np.random.default_rng(5).uniform(0.8, 1.2, (SCENE.height, SCENE.width, 1))
            layers["ViewLayer.Combined"] = (layers["ViewLayer.Combined"] * grain).astype(np.float32)

    folders = SCENE.write(tmp_path / "in"), SCENE.write(tmp_path / "other", edit=other)
    seen = []
    for passes in (1, 2):
        first = []
        for folder in folders:
            out = tmp_path / f"{folder.name}{passes}"
            options = ["--weights", weights, "--first-pass", folder, "--precision", "float32", "--stages", "warp"]
            code = run("denoise", folder, "-o", out, "--passes", passes, "--no-stages", "refine,stabilize", *options)
            assert code == 0, capsys.readouterr().err
            left = {item.name for item in out.iterdir()}  # nothing of the first pass
            assert left == {"ravg", *(f"shot.{number}.exr" for number in (1001, 1002, 1003))}
            first.append(open_shot(out).read(SCENE.first).color)
        seen.append(not np.array_equal(*first))
    assert seen == [False, True]
    assert run("denoise", folders[0], "-o", tmp_path, "--weights", weights, "--passes", "0") == 2


# All stages said, so that no plan is measured on other frames, or on a denoised picture.
STAGES = ["--stages", "demodulate,warp", "--no-stages", "outliers,refine,gate,fixed-noise,prefilter,alpha,skip"]


def test_a_second_pass_of_some_frames_is_that_of_all(weights, tmp_path, capsys, monkeypatch):
    """The first pass has to make the neighbours as well; it used to make only the frames asked for."""
    folder = Scene(height=40, width=48, frames=5).write(tmp_path / "in")
    monkeypatch.setattr("hybrid.files.exr.MAX_PIXELS", 100)  # so that all passes have to know of --max-pixels
    options = ["--weights", weights, "--precision", "float32", "--passes", 2, "--max-pixels", 4000, *STAGES]
    code = run("denoise", folder, "-o", tmp_path / "all", "--first-pass", "nlm", *options)
    assert code == 0, capsys.readouterr().err
    assert run("denoise", folder, "-o", tmp_path / "one", "--first-pass", "nlm", "--frames", "1003", *options) == 0
    name = "shot.1003.exr"
    assert {path.name for path in (tmp_path / "one").iterdir()} == {"ravg", name}
    one, every = (read_exr(tmp_path / folder / name) for folder in ("one", "all"))
    assert one.channel_names == every.channel_names
    for channel in one.channel_names:
        np.testing.assert_array_equal(one.channel(channel), every.channel(channel), err_msg=channel)
    # The header named the files between the passes, which are others in each run.
    assert (tmp_path / "one" / name).read_bytes() == (tmp_path / "all" / name).read_bytes()
    for path in sorted(folder.iterdir()):
        assert path.name in one.parts[0].header[MADE_FROM]
    capsys.readouterr()
    words = ["denoise", folder, "-o", tmp_path / "all", "--first-pass", "nlm", "--resume", *options]
    assert run(*words) == 0
    assert "5 of 5 frames were finished already" in capsys.readouterr().err
    os.utime(folder / "shot.1001.exr", (0, 0))
    assert run(*words) == 0
    assert "frame 1003 is made again: frame 1001, shot.1001.exr, has changed" in capsys.readouterr().err


def test_pictures_of_two_passes_show_what_was_rendered(weights, tmp_path):
    """On their left was what the first pass had made."""
    folder = SCENE.write(tmp_path / "in")
    noisy = []
    for passes in (1, 2):
        pictures = tmp_path / f"preview{passes}.png", tmp_path / f"parts{passes}.png"
        options = ["--weights", weights, "--first-pass", "nlm", "--precision", "float32", *STAGES]
        options += ["--passes", passes, "--preview", pictures[0], "--breakdown", pictures[1]]
        assert run("denoise", folder, "-o", tmp_path / f"out{passes}", *options) == 0
        noisy.append([cv2.imread(str(path))[: SCENE.height, : SCENE.width] for path in pictures])
    np.testing.assert_array_equal(*noisy)
    preview, parts = (picture.astype(int) for picture in noisy[0])
    np.testing.assert_allclose(preview, parts, atol=1)  # both are exposed alike; roundings differ


def test_resumed_frames_have_their_breakdown(weights, tmp_path, capsys):
    """Frames made without one used to pass for finished, and have no such layers; and if all were, there was a bug."""
    folder = SCENE.write(tmp_path / "in")
    words = ["denoise", folder, "-o", tmp_path / "out", "--weights", weights, "--first-pass", "nlm", "--resume"]
    picture = tmp_path / "parts.png"
    assert run(*words) == 0
    assert run(*words, "--breakdown", picture) == 0
    printed = capsys.readouterr()
    assert "finished already" not in printed.err
    assert "before1" in printed.out
    whole = picture.read_bytes()
    picture.unlink()
    assert run(*words, "--breakdown", picture) == 0
    printed = capsys.readouterr()
    assert "3 of 3 frames were finished already" in printed.err
    assert "no weights to print: all frames were finished already" in printed.err
    assert "average weight" not in printed.out
    assert picture.read_bytes() == whole


def test_a_network_without_estimates_says_so(tmp_path, capsys):
    path = tmp_path / "small.safetensors"
    save_model(path, build_preset("unet", frames=3))
    folder = SCENE.write(tmp_path / "in")
    words = ["denoise", folder, "--weights", path, "-o", tmp_path / "out", "--first-pass"]
    assert run(*words, "oidn") == 1
    assert "first-pass is 'oidn', expected auto or none: the network of small.safetensors takes none" in (
        capsys.readouterr().err
    )
    assert not (tmp_path / "out").exists()
    assert run(*words, "auto") == 0
    assert "First pass  none (the denoiser takes none)" in capsys.readouterr().err
    assert run(*words, "none", "--passes", 2) == 0
    assert "First pass  none (the denoiser takes none)" in capsys.readouterr().err
