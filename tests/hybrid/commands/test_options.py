"""Options made of the fields of dataclasses: where they stand in the help, and where their values go."""

from dataclasses import fields
from typing import Any

import pytest
import typer

from hybrid.cli import COMMANDS, LazyCommand, main
from hybrid.commands.compare import _Report
from hybrid.commands.options import LogOptions, check_first_pass, split_number
from hybrid.run.job import DenoiseOptions
from hybrid.run.option_texts import TEXTS, option_texts
from hybrid.simulate.shot import ShotSettings
from network.training.config import SamplerConfig, TrainConfig

CONFIGS = {
    "denoise": (DenoiseOptions,),
    "simulate": (ShotSettings,),
    "train": (TrainConfig, SamplerConfig),
    "compare": (_Report,),
    "status": (LogOptions,),
}
# Fields whose values a command makes of options of another type.
MADE = {"simulate": ("frames", "reference_frames", "size", "levels", "film", "center", "scene", "seed")}


def described() -> list[Any]:
    return [
        pytest.param(name, item, settings, id=f"{name} {item.name}")
        for name, configs in CONFIGS.items()
        for config in configs
        for item in fields(config)
        if (settings := option_texts(name).get(item.name)) and item.name not in MADE.get(name, ())
        if item.name not in ("stages", "no_stages")  # collections in Python, repeated in a command
    ]


@pytest.mark.parametrize(("command", "item", "settings"), described())
def test_a_field_is_an_option_with_its_help_names_panel_and_default(command, item, settings):
    options = {p.name: p for p in LazyCommand(command, COMMANDS[command]).load().params}
    option = options[item.name]
    assert (option.help, option.default) == (settings["help"], item.default)
    assert option.rich_help_panel == settings["panel"]
    assert {*option.opts} == {*settings.get("names", (f"--{item.name.replace('_', '-')}",))}
    assert option.envvar == settings.get("envvar")


@pytest.mark.parametrize("command", COMMANDS)
def test_each_text_is_that_of_an_option(command):
    names = {p.name for p in LazyCommand(command, COMMANDS[command]).load().params}
    assert {name for entries in TEXTS.get(command, {}).values() for name in entries} <= names


class AskedError(Exception):
    """The options that `Job.open` gets."""


@pytest.mark.neural
def test_denoise_hands_on_all_that_is_said(shot_folder, tmp_path, monkeypatch):

    def refuse(shot: Any, output: str, options: DenoiseOptions, *_: Any) -> None:
        raise AskedError(shot, output, options)

    monkeypatch.setattr("hybrid.commands.denoise.Job.open", refuse)
    values = {
        "--first-pass": "nlm", "--keep-first-pass": str(tmp_path / "kept"), "--aov-sum": "beauty", "--passes": "3",
        "--stages": "gate,refine", "--no-stages": "drift", "--tile": "64", "--precision": "float32", "--device": "cuda",
        "--max-memory": "8G", "--frames": "1002", "--max-pixels": "1000000",
    }  # fmt: skip
    flags = ["--resume", "--keep-going", "--strict"]
    words = [word for pair in values.items() for word in pair]
    with pytest.raises(AskedError) as caught:
        main(["denoise", str(shot_folder), "-o", str(tmp_path / "out"), "--preset", "quality", *words, *flags])
    shot, output, options = caught.value.args
    assert output == str(tmp_path / "out")
    assert (shot.numbers, shot.reader.files.max_pixels) == ((1002,), 1_000_000)
    assert options == DenoiseOptions(
        preset="quality", first_pass="nlm", keep_first_pass=str(tmp_path / "kept"), aov_sum="beauty", passes=3,
        stages=("gate", "refine"), no_stages=("drift",), tile=64, precision="float32", device="cuda", max_memory="8G",
        resume=True, keep_going=True, strict=True,
    )  # fmt: skip


@pytest.mark.parametrize(
    ("item", "expected"),
    [("a=24", ("a", 24.0)), ("x=1=.5", ("x=1", 0.5)), ("a", ("", None)), ("a=", ("a", None)), ("a=-1", ("a", None)),
     ("a=inf", ("a", None)), ("a=nan", ("a", None)), ("a=0", ("a", None))],
)  # fmt: skip
def test_a_name_and_a_number_are_split(item, expected):
    assert split_number(item) == expected


def test_bad_usage_is_that_of_the_option():
    with pytest.raises(typer.BadParameter, match="first-pass is 'unheard'"):
        check_first_pass("unheard")
