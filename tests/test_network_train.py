"""Training, resuming it, and the files it leaves."""

# ruff: noqa: E402 - nothing of network can be imported before it is known that torch is there

from __future__ import annotations

import json
from dataclasses import replace
from itertools import pairwise
from pathlib import Path

import numpy as np
import pytest

torch = pytest.importorskip("torch")

from safetensors import safe_open
from safetensors.torch import save_file

import network.train
from network.checkpoint import build, describe, load_model, load_notes, save_model
from network.clips import Clip, Sampler, SamplerConfig
from network.models import (
    TKPCN,
    KernelConfig,
    Model,
    RAResNet,
    RAResNetConfig,
    RAUNet,
    RAUNetConfig,
    TKPCNConfig,
)
from network.train import TrainConfig, batch_loss, main, train, validate

pytestmark = pytest.mark.neural


def make_clip(seed: int, shot: str, size: int = 40) -> Clip:
    """A smooth picture under strong noise; two independent renders of it, and a poor estimate."""
    rng = np.random.default_rng(seed)
    y, x = np.mgrid[:size, :size].astype(np.float32) / size
    waves = [1 + np.sin(5 * x * rng.uniform(-1, 1) + 5 * y * rng.uniform(-1, 1) + rng.uniform(0, 6)) for _ in range(3)]
    clean = np.stack(waves, -1) + 0.1
    noisy = clean * rng.gamma(2, 0.5, (3, size, size, 1))
    return Clip(
        color=noisy,
        albedo=np.zeros_like(noisy),
        normal=np.zeros_like(noisy),
        confidence=np.ones((3, size, size)),
        modulation=np.ones_like(clean),
        estimate=np.broadcast_to(clean.mean((0, 1)), (3, *clean.shape)).copy(),
        target=clean * rng.gamma(2, 0.5, (size, size, 1)),
        target_kind="noisy",
        shot=shot,
    )


CLIPS = [make_clip(seed, f"shot{seed}") for seed in range(4)]
CONFIG = TrainConfig(
    steps=6, batch=2, rate=3e-3, warmup=3, ema=0.9, bfloat16=False, seed=0, sampler=SamplerConfig(crop=16)
)


def make_model(seed: int = 0) -> RAUNet:
    torch.manual_seed(seed)
    return RAUNet(
        RAUNetConfig(KernelConfig(frames=3, size=3, estimate_size=1, estimate_share=0.5), widths=(8, 8), ra_scales=(1,))
    )


def equal_weights(a: Model, b: Model) -> bool:
    return all(torch.equal(p, q) for p, q in zip(a.parameters(), b.parameters(), strict=True))


# Training


def test_training_on_noisy_targets_approaches_the_clean_image(tmp_path: Path) -> None:
    """Noise2Noise: no clean picture is ever shown, and still the error against it falls."""
    # Without fireflies: to reject those takes longer to learn, and until then they rule the loss.
    sampler = replace(CONFIG.sampler, fireflies=0)
    model, config = make_model(), replace(CONFIG, steps=60, warmup=10, loss="l1", sampler=sampler)
    batch = Sampler(CLIPS[:3], config.sampler, 7).batch(16)
    clean = replace(CLIPS[3], target=make_clean(3))
    loss_before, before = batch_loss(model, batch, config).item(), validate(model, [clean])
    train(CLIPS[:3], [], model, config, tmp_path / "w.safetensors")
    assert batch_loss(model, batch, config).item() < loss_before
    after = validate(load_model(tmp_path / "w.safetensors"), [clean])
    # It has found out that the estimates, half of the image at the start, are worth nothing: 10 dB when written.
    assert after["denoised"] > before["denoised"] + 5
    assert after["denoised"] > after["noisy"] + 10


def make_clean(seed: int, size: int = 40) -> np.ndarray:
    """The picture under the noise of `make_clip`: its generator's first draws."""
    rng = np.random.default_rng(seed)
    y, x = np.mgrid[:size, :size].astype(np.float32) / size
    waves = [1 + np.sin(5 * x * rng.uniform(-1, 1) + 5 * y * rng.uniform(-1, 1) + rng.uniform(0, 6)) for _ in range(3)]
    return np.stack(waves, -1) + 0.1


def test_a_training_is_determined_by_its_seed(tmp_path: Path) -> None:
    runs = [train(CLIPS, [], make_model(), CONFIG, tmp_path / f"{i}.safetensors") for i in range(2)]
    assert runs[0] == runs[1]
    other = train(CLIPS, [], make_model(), replace(CONFIG, seed=1), tmp_path / "c.safetensors")
    assert other != runs[0]


def test_bfloat16_training_stays_near_float32(tmp_path: Path) -> None:
    full = train(CLIPS, [], make_model(), CONFIG, tmp_path / "a.safetensors")
    half = train(CLIPS, [], make_model(), replace(CONFIG, bfloat16=True), tmp_path / "b.safetensors")
    assert half != full
    assert half == pytest.approx(full, rel=0.02)  # 8 bits in the features, averaged over all pixels


def test_a_model_without_estimates_trains_too(tmp_path: Path) -> None:
    torch.manual_seed(0)
    model = RAResNet(RAResNetConfig(KernelConfig(frames=3, size=3), width=4, blocks=2, ra_after=(1, 2), skips=1))
    before = [p.clone() for p in model.parameters()]
    losses = train(CLIPS, [], model, replace(CONFIG, steps=2), tmp_path / "w.safetensors")
    assert np.isfinite(losses).all()
    assert all(not torch.equal(p, q) for p, q in zip(model.parameters(), before, strict=True))


def test_a_resumed_training_goes_on_as_if_nothing_had_happened(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    out = tmp_path / "w.safetensors"
    unbroken_model = make_model()
    unbroken = train(CLIPS[:3], CLIPS[3:], unbroken_model, CONFIG, out)
    assert not Path(f"{out}.state").exists()  # nothing to resume
    unbroken_average = load_model(out)

    # The same, with a checkpoint after every step, cut off before the fifth loss.
    every_step = replace(CONFIG, checkpoint_minutes=0.0)
    calls = 0

    def cut_off(*args: object) -> torch.Tensor:
        nonlocal calls
        calls += 1
        if calls == 5:
            raise KeyboardInterrupt
        return batch_loss(*args)

    monkeypatch.setattr(network.train, "batch_loss", cut_off)
    with pytest.raises(KeyboardInterrupt):
        train(CLIPS[:3], CLIPS[3:], make_model(), every_step, out)
    monkeypatch.undo()
    model = make_model(seed=9)  # other weights: they must come from the file
    assert train(CLIPS[:3], CLIPS[3:], model, CONFIG, out, resume=True) == unbroken[4:]
    assert equal_weights(model, unbroken_model)
    assert equal_weights(load_model(out), unbroken_average)
    assert not Path(f"{out}.state").exists()


def test_a_state_that_is_missing_cut_short_or_of_another_training_is_an_error(tmp_path: Path) -> None:
    out = tmp_path / "w.safetensors"
    with pytest.raises(FileNotFoundError, match="resume: no file"):
        train(CLIPS, [], make_model(), CONFIG, out, resume=True)
    state = Path(f"{out}.state")
    every_step = replace(CONFIG, checkpoint_minutes=0.0)
    kept = tmp_path / "kept"

    def keep(line: str) -> None:
        if state.exists():
            kept.write_bytes(state.read_bytes())

    train(CLIPS[:3], CLIPS[3:], make_model(), replace(every_step, validate_minutes=0.0), out, report=keep)
    state.write_bytes(kept.read_bytes()[:2000])
    with pytest.raises(ValueError, match="no training state, or cut short"):
        train(CLIPS[:3], CLIPS[3:], make_model(), CONFIG, out, resume=True)
    state.write_bytes(kept.read_bytes())
    with pytest.raises(ValueError, match="expected the same model and configuration"):
        train(CLIPS[:3], CLIPS[3:], make_model(), replace(CONFIG, rate=1e-5), out, resume=True)


def test_validation_measures_what_it_says() -> None:
    clip = replace(CLIPS[0], target=CLIPS[0].color[1].copy(), estimate=CLIPS[0].color.copy())
    values = validate(make_model(), [clip])
    assert values["noisy"] == values["estimate"] == pytest.approx(120)  # both are the target; the floor is 1e-12
    assert 15 < values["denoised"] < 100
    assert values["mean"] == pytest.approx(1, abs=0.02)  # kernels sum to 1; the noise of 1600 pixels is left
    assert 0.5 < values["side"] < 0.75  # two thirds: the start's kernels, at full confidence


def test_the_learning_rate_warms_up_and_falls() -> None:
    config = replace(CONFIG, steps=1000, warmup=100)
    rates = [network.train._rate(config, step, step / 1000) for step in range(1000)]
    assert rates[0] == pytest.approx(0.01, rel=1e-3)
    assert max(rates) == pytest.approx(rates[99]) == pytest.approx(1, abs=0.03)
    assert all(b < a for a, b in pairwise(rates[99:]))
    assert rates[-1] == pytest.approx(0.01, abs=1e-4)


@pytest.mark.parametrize(
    ("change", "message"),
    [
        ({"steps": None}, "steps, minutes: expected at least one limit"),
        ({"steps": 0}, "steps: expected a positive"),
        ({"batch": 0}, "batch: expected a positive"),
        ({"rate": -1.0}, "rate: expected a positive"),
        ({"ema": 1.0}, "ema: expected 0 <= ema < 1"),
        ({"loss": "l3"}, "loss: expected one of"),
    ],
)
def test_configurations_say_what_is_wrong(change: dict[str, object], message: str) -> None:
    with pytest.raises(ValueError, match=message):
        replace(CONFIG, **change)


def test_the_command_trains_and_says_how_it_went(tmp_path: Path, capsys: pytest.CaptureFixture[str]) -> None:
    clips, out = tmp_path / "clips", tmp_path / "w.safetensors"
    clips.mkdir()
    for clip in CLIPS[:2]:
        clip.save(clips / f"{clip.shot}.npz")
    options = [str(clips), "-o", str(out), "--crop", "16", "--batch", "1", "--validation", "shot1"]
    assert main([*options, "--steps", "2"]) == 0
    assert "validation" in capsys.readouterr().out
    assert load_notes(out)["training"]["steps"] == 2
    assert main([*options, "--steps", "2", "--resume"]) == 1
    assert capsys.readouterr().err.startswith("error: resume: no file")
    assert main([str(tmp_path), *options[1:], "--steps", "2"]) == 1
    assert "no *.npz" in capsys.readouterr().err
    with pytest.raises(SystemExit) as error:
        main(options)  # no limit
    assert error.value.code == 2


# Weights


@pytest.mark.parametrize("dtype", [torch.float32, torch.float16])
def test_weights_come_back(tmp_path: Path, dtype: torch.dtype) -> None:
    path, model = tmp_path / "w.safetensors", make_model()
    save_model(path, model, {"hours": 0.5}, dtype)
    loaded = load_model(path)
    assert loaded.config == model.config
    for (name, value), other in zip(model.named_parameters(), loaded.parameters(), strict=True):
        assert other.dtype == torch.float32, name
        assert torch.equal(other, value.to(dtype).float())
    assert load_notes(path) == {"hours": 0.5}
    assert [p.name for p in tmp_path.iterdir()] == ["w.safetensors"]


def test_every_model_is_built_from_its_description() -> None:
    resnet = RAResNet(RAResNetConfig(width=4, blocks=3, ra_after=(1, 3), skips=1))
    for model in (make_model(), resnet, TKPCN(TKPCNConfig(width=4, blocks=1))):
        again = build(json.loads(json.dumps(describe(model))))
        assert type(again) is type(model)
        assert again.config == model.config


@pytest.mark.parametrize(
    "description",
    [
        {},
        {"model": "RAUNet"},
        {"model": "Transformer", "config": {"kernel": {}}},
        {"model": "RAUNet", "config": {"kernel": {"frames": 5}, "depth": 3}},
        {"model": "RAUNet", "config": {"kernel": {"frames": 4}}},
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
    for change, message in [
        ({"format": "other"}, "expected format 'ravg-network', got 'other'"),
        ({"version": "99"}, "expected version 1, got 99"),
        ({"description": "{"}, "bad.safetensors"),
        ({"description": json.dumps(describe(RAResNet(RAResNetConfig(width=4))))}, "expected shape"),
    ]:
        save_file(tensors, bad, {**metadata, **change})
        with pytest.raises(ValueError, match=message):
            load_model(bad)
    save_file(tensors, bad)
    with pytest.raises(ValueError, match="expected format 'ravg-network', got None"):
        load_model(bad)
    del tensors["stem.bias"]
    save_file(tensors, bad, metadata)
    with pytest.raises(ValueError, match=r"stem\.bias: expected shape \(8,\), got None"):
        load_model(bad)
