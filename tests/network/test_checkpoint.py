"""Weights in files: they come back, and what is no such file is refused."""

import json
import os
import stat
import subprocess
import sys
from pathlib import Path

import pytest
import torch
from safetensors import safe_open
from safetensors.torch import save_file

from network.checkpoint import build, describe, find_weights, load_model, save_model, shipped_weights
from tests.network.small import MODELS, make_model, make_robust, notes_of


def test_weights_come_back(tmp_path: Path) -> None:
    path, model = tmp_path / "w.safetensors", make_model()
    save_model(path, model, {"hours": 0.5})
    loaded = load_model(path)
    assert loaded.config == model.config
    for (name, value), other in zip(model.named_parameters(), loaded.parameters(), strict=True):
        assert other.dtype == torch.float32, name
        assert torch.equal(other, value.half().float())
    assert notes_of(path) == {"hours": 0.5}
    assert [p.name for p in tmp_path.iterdir()] == ["w.safetensors"]


def test_every_model_is_built_from_its_description() -> None:
    for model in (make_model(), *(make() for make in MODELS.values())):
        again = build(json.loads(json.dumps(describe(model))))
        assert type(again) is type(model)
        assert again.config == model.config


def test_the_activation_that_earlier_versions_wrote_is_the_only_one() -> None:
    description = {"model": "RAUNet", "config": {"kernel": {"frames": 3, "activation": "relu"}}}
    assert build(description).config.kernel.frames == 3


@pytest.mark.parametrize(
    "description",
    [
        {},
        {"model": "RAUNet"},
        {"model": "Transformer", "config": {"kernel": {}}},
        {"model": "RAUNet", "config": {"kernel": {"frames": 5}, "depth": 3}},
        {"model": "RAUNet", "config": {"kernel": {"frames": 4}}},
        {"model": "RAUNet", "config": {"kernel": {"activation": "softmax"}}},
    ],
)
def test_a_description_of_something_else_is_an_error(description: dict[str, object]) -> None:
    with pytest.raises(ValueError, match="model description"):
        build(description)


def test_weights_that_are_not_finite_are_not_written(tmp_path: Path) -> None:
    model = make_model()
    torch.nn.init.constant_(model.stem.bias, 1e6)  # too large for a half
    with pytest.raises(ValueError, match=r"stem\.bias: expected finite weights"):
        save_model(tmp_path / "w.safetensors", model)
    assert not list(tmp_path.iterdir())


def test_files_that_are_no_weights_of_ours_are_an_error(tmp_path: Path) -> None:
    path, bad = tmp_path / "w.safetensors", tmp_path / "bad.safetensors"
    with pytest.raises(FileNotFoundError, match="no such file"):
        load_model(path)
    save_model(path, make_model())
    whole = path.read_bytes()
    for length in (0, 5, 200, len(whole) - 1):
        bad.write_bytes(whole[:length])
        with pytest.raises(ValueError, match=r"bad\.safetensors.*no safetensors file, or cut short"):
            load_model(bad)

    with safe_open(path, framework="pt") as file:
        metadata, tensors = file.metadata(), {name: file.get_tensor(name) for name in file.keys()}  # noqa: SIM118
    del tensors["stem.bias"]
    save_file(tensors, bad, metadata)
    with pytest.raises(ValueError, match=r"stem\.bias: expected shape \(8,\), got None"):
        load_model(bad)


@pytest.mark.posix
def test_weights_are_not_written_through_a_link_that_was_planted(tmp_path: Path) -> None:
    """The name to write to first is known to everybody; a link of that name led elsewhere."""
    precious = tmp_path / "precious"
    precious.write_text("precious")
    path = tmp_path / "w.safetensors"
    path.with_name("w.safetensors.part").symlink_to(precious)
    save_model(path, make_model())
    assert precious.read_text() == "precious"
    assert sorted(item.name for item in tmp_path.iterdir()) == ["precious", "w.safetensors"]
    with pytest.raises(OSError, match="is there and no file"):
        save_model(tmp_path, make_model())


@pytest.mark.posix
@pytest.mark.skipif(os.name == "nt", reason="Windows has no umask")
@pytest.mark.parametrize("mask", [0o022, 0o027])
def test_weights_have_the_mode_that_the_umask_gives(tmp_path: Path, mask: int) -> None:
    """safetensors writes files that only their owner may read."""
    before = os.umask(mask)
    try:
        save_model(tmp_path / "w.safetensors", make_model())
    finally:
        os.umask(before)
    assert stat.S_IMODE((tmp_path / "w.safetensors").stat().st_mode) == 0o666 & ~mask


@pytest.mark.parametrize("version", ["3", "4"])
def test_older_files_of_the_papers_networks_are_read_and_those_of_the_final_stage_are_not(tmp_path, version):
    for make, readable in ((make_model, True), (make_robust, False)):
        path, old = tmp_path / "w.safetensors", tmp_path / "old.safetensors"
        save_model(path, make())
        with safe_open(path, framework="pt") as file:
            metadata, tensors = file.metadata(), {name: file.get_tensor(name) for name in file.keys()}  # noqa: SIM118
        save_file(tensors, old, {**metadata, "version": version})
        if readable:
            for loaded, value in zip(load_model(old).parameters(), load_model(path).parameters(), strict=True):
                assert torch.equal(loaded, value)
        else:
            with pytest.raises(ValueError, match=f"expected version 5 of a RobustUNet, got {version}.*train it anew"):
                load_model(old)


def test_networks_of_the_paper_are_weights_by_name_and_no_presets() -> None:
    for name in ("ra", "tkpcn", "multiscale"):
        assert find_weights(name).is_file()
        with pytest.raises(ValueError, match=f"preset is '{name}', a network for research, expected --weights {name}"):
            shipped_weights(name)
    assert find_weights("fast") == shipped_weights("fast")
    assert find_weights("mine.safetensors") == Path("mine.safetensors")
    with pytest.raises(ValueError, match="preset is 'other', expected one of"):
        find_weights("other")


def test_no_preset_needs_the_papers_networks() -> None:
    code = "import sys; from network.checkpoint import load_model, shipped_weights; load_model(shipped_weights('fast'))"
    code += "; print(*(name for name in sys.modules if name.startswith('network.paper')))"
    done = subprocess.run([sys.executable, "-c", code], capture_output=True, text=True, check=True)
    assert not done.stdout.strip()
