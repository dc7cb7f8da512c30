import importlib.util
from pathlib import Path

import pytest
import torch

from hybrid.neural import train as module
from hybrid.neural.train import TrainInputs, _initial_model
from network.checkpoint import load_model, shipped_weights
from network.oidn_weights import load_oidn
from network.presets import build_preset
from network.training.config import TrainConfig


class FiveFrames:
    """All that is asked of clips."""

    frames = 5


INPUTS = TrainInputs(Path("clips"), "balanced")


def weights(model):
    return {name: value.clone() for name, value in model.state_dict().items()}


def equal(one, other):
    return all(torch.equal(value, other[name]) for name, value in one.items())


def test_a_preset_begins_with_the_weights_of_its_seed():
    model = _initial_model(INPUTS, FiveFrames(), seed=3)
    assert equal(weights(model), weights(build_preset("balanced", seed=3)))
    assert not equal(weights(model), weights(build_preset("balanced", seed=4)))


@pytest.mark.oidn
@pytest.mark.skipif(importlib.util.find_spec("pyoidn") is None, reason="pyoidn is not installed")
def test_oidn_is_the_backbone_that_training_begins_with():
    model = _initial_model(INPUTS._replace(init="oidn"), FiveFrames(), seed=3)
    assert equal(weights(model.backbone), load_oidn("rt_hdr_alb_nrm").state_dict())
    assert not equal(weights(model.backbone), weights(build_preset("balanced", seed=3).backbone))


def test_oidn_is_asked_for_its_weights(monkeypatch):
    given = []
    monkeypatch.setattr(module, "start_from_oidn", given.append)
    model = _initial_model(INPUTS._replace(init="oidn"), FiveFrames(), seed=3)
    assert given == [model]
    with pytest.raises(ValueError, match="init is 'oidn', expected with it a preset on OIDN's backbone, not 'unet'"):
        _initial_model(INPUTS._replace(preset="unet", init="oidn"), FiveFrames(), seed=3)


def test_a_preset_that_ships_is_what_training_begins_with():
    model = _initial_model(INPUTS._replace(init="balanced"), FiveFrames(), seed=3)
    assert equal(weights(model), weights(load_model(shipped_weights("balanced"))))


def test_a_training_reuses_freed_memory(monkeypatch, tmp_path):
    """Without it a step takes a tenth longer: features of all frames are allocated anew in each."""
    calls = []
    monkeypatch.setattr(module, "open_clips", lambda *args: FiveFrames())
    monkeypatch.setattr(module, "split_by_shot", lambda clips, shots: (clips, clips))
    monkeypatch.setattr(module, "reuse_freed_memory", lambda: calls.append("reuse"))
    monkeypatch.setattr(module, "train", lambda *args, **more: calls.append("train"))
    module.train_network(INPUTS, tmp_path / "w", TrainConfig(steps=1), threads=None, resume=False, log=print)
    assert calls == ["reuse", "train"]


@pytest.mark.parametrize(
    ("init", "asked", "used"), [(None, None, "input"), ("balanced", None, "start"), ("fast", "input", "input")]
)
def test_losses_are_over_those_at_the_start_where_weights_are_given(init, asked, used, monkeypatch, tmp_path):
    given = []
    monkeypatch.setattr(module, "open_clips", lambda *args: FiveFrames())
    monkeypatch.setattr(module, "split_by_shot", lambda clips, shots: (clips, clips))
    monkeypatch.setattr(module, "train", lambda *args, **more: given.append(args[3].against))
    inputs, config = INPUTS._replace(init=init), TrainConfig(steps=1, against=asked)
    module.train_network(inputs, tmp_path / "w", config, threads=None, resume=False, log=print)
    assert given == [used]


def test_windows_of_another_length_are_asked_for_by_name():
    with pytest.raises(ValueError, match="expected windows of 7 frames, as quality has, got 5; --window 5 trains"):
        _initial_model(INPUTS._replace(preset="quality"), FiveFrames(), seed=3)
    assert _initial_model(INPUTS._replace(preset="quality", window=5), FiveFrames(), seed=3).frames == 5
