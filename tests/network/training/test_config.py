"""Settings of a training: wrong ones are named, and no torch is needed to check them."""

from dataclasses import fields, replace

import pytest

from network.devices import DEVICES
from network.training.config import AGAINST, LOSSES, TERMS, SamplerConfig, TrainConfig

CONFIG = TrainConfig(steps=6)


@pytest.mark.parametrize(
    ("change", "message"),
    [
        ({"steps": None}, "steps, minutes: expected at least one limit"),
        ({"steps": 0}, "steps: expected a positive"),
        ({"batch": 0}, "batch: expected a positive"),
        ({"rate": -1.0}, "rate: expected a positive"),
        ({"ema": 1.0}, "ema: expected 0 <= ema < 1"),
        ({"loss": "l3"}, "loss: expected one of"),
        ({"terms": "all"}, "terms: expected one of"),
        ({"against": "me"}, "against: expected one of"),
        ({"device": "tpu"}, "device: expected one of"),
        ({"loss": "perceptual"}, "vgg: expected weights with the perceptual loss"),
        ({"slope": 0.5}, "slope: expected at least 1"),
        ({"differences": -1.0}, "differences: expected at least 0"),
    ],
)
def test_configurations_say_what_is_wrong(change: dict[str, object], message: str) -> None:
    with pytest.raises(ValueError, match=message):
        replace(CONFIG, **change)


@pytest.mark.parametrize(
    ("change", "message"),
    [
        ({"crop": 0}, "crop: expected a positive number, got 0"),
        ({"sets": 0}, "sets: expected a positive number, got 0"),
        ({"fireflies": 1.5}, "fireflies: expected a probability, got 1.5"),
    ],
)
def test_samplers_say_what_is_wrong(change: dict[str, float], message: str) -> None:
    with pytest.raises(ValueError, match=message):
        SamplerConfig(**change)


def test_every_choice_that_is_named_is_taken() -> None:
    for name, choices in (("against", AGAINST), ("terms", TERMS), ("device", DEVICES)):
        for choice in choices:
            assert getattr(replace(CONFIG, **{name: choice}), name) == choice
    for loss in LOSSES:
        assert replace(CONFIG, loss=loss, vgg="hub" if loss == "perceptual" else None).loss == loss


def test_a_limit_of_steps_or_of_time_is_all_that_is_needed() -> None:
    without = {field.name for field in fields(TrainConfig)} - {"steps", "minutes"}
    by_time = TrainConfig(minutes=1.0)
    assert all(getattr(by_time, name) == getattr(CONFIG, name) for name in without)
