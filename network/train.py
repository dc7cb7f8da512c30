"""Training of a network on clips: a plain loop.

``python -m network.train CLIPS -o W.safetensors --minutes 30``

Set ``OMP_WAIT_POLICY=PASSIVE`` in the environment (it is read when torch is imported): OpenMP's threads
otherwise spin while they wait, and a step takes ten times as long on a machine that has other work.
"""

from __future__ import annotations

import argparse
import copy
import json
import math
import os
import sys
import time
from collections.abc import Callable, Sequence
from dataclasses import asdict, dataclass, field
from pathlib import Path
from typing import Any

import torch
from torch import Tensor, nn

from network import losses
from network.checkpoint import describe, load_model, save_model
from network.clips import Clip, Sampler, SamplerConfig, load_clips, split_by_shot, whole_frame
from network.inputs import network_inputs
from network.kernels import filter_window, mean_of
from network.models import Model, fast, paper

LOSSES: dict[str, losses.ImageLoss] = {"l1": losses.l1, "smape": losses.smape, "relmse": losses.relmse}
TERMS = ("temporal", "power", "spatial")


@dataclass(frozen=True)
class TrainConfig:
    """One training; with the clips and the model it determines the weights."""

    steps: int | None = None  # stop after so many steps; reproducible from the seed
    minutes: float | None = None  # or after so long, whichever comes first
    batch: int = 2
    rate: float = 1e-3  # peak learning rate
    warmup: int = 200  # steps of linear rise; the kernels start at a sane mean, and must not be thrown off it
    weight_decay: float = 1e-4
    clip_norm: float = 1.0  # largest norm of the gradient; one firefly is one sample
    ema: float = 0.999  # of the weights that are validated and kept
    loss: str = "relmse"
    terms: str = "temporal"  # parts of the window that must give the target: one of TERMS
    whole: float = 1.0  # weight of the whole window's term beside the temporal ones
    slope: float = 1.0  # λ of Vogels' asymmetric loss; for clean targets
    bfloat16: bool = True  # for the convolutions; kernels and losses are float32
    seed: int = 0
    checkpoint_minutes: float = 5.0
    validate_minutes: float = 5.0
    sampler: SamplerConfig = field(default_factory=SamplerConfig)

    def __post_init__(self) -> None:
        if self.steps is None and self.minutes is None:
            raise ValueError("steps, minutes: expected at least one limit, got none")
        for name in ("steps", "minutes", "batch", "rate", "clip_norm"):
            value = getattr(self, name)
            if value is not None and not value > 0:
                raise ValueError(f"{name}: expected a positive number, got {value}")
        if not 0 <= self.ema < 1:
            raise ValueError(f"ema: expected 0 <= ema < 1, got {self.ema}")
        if self.loss not in LOSSES:
            raise ValueError(f"loss: expected one of {sorted(LOSSES)}, got {self.loss!r}")
        if self.terms not in TERMS:
            raise ValueError(f"terms: expected one of {', '.join(TERMS)}, got {self.terms!r}")
        if self.whole < 0 or self.slope < 1:
            raise ValueError(f"whole, slope: expected whole >= 0 and slope >= 1, got {self.whole} and {self.slope}")

    def loss_terms(self, frames: int) -> list[losses.Term]:
        """Terms of the loss for a window of so many frames."""
        if self.terms == "temporal":
            return losses.temporal_terms(frames, self.whole)
        return losses.power_terms(frames) if self.terms == "power" else losses.spatial_terms(frames)


def predict(model: Model, batch: dict[str, Tensor], bfloat16: bool = False) -> tuple[Tensor, Tensor]:
    """Numerators and denominators of a batch from `Sampler.batch`; see `network.kernels.filter_window`."""
    config = model.config.kernel
    takes_estimate = config.estimate_size > 0
    present = batch["present"] if takes_estimate else torch.zeros_like(batch["present"])
    estimate = batch["estimate"] * present.view(-1, 1, 1, 1, 1) if takes_estimate else None
    features = network_inputs(
        batch["color"],
        batch["albedo"],
        batch["normal"],
        batch["confidence"],
        batch["exposure"],
        takes_estimate=takes_estimate,
        estimate=estimate,
        present=present,
    )
    with torch.autocast(features.device.type, torch.bfloat16, enabled=bfloat16):
        kernels = model(features, batch["confidence"], present)
    return filter_window(kernels, batch["color"], config.size, estimate, batch["confidence"])


def batch_loss(model: Model, batch: dict[str, Tensor], config: TrainConfig) -> Tensor:
    """Training loss of a batch: the temporal loss of each crop, relative to that of its best input.

    Notes
    -----
    What a crop can still gain differs by orders of magnitude between shots, and its targets' noise adds a floor.
    Each crop's loss is divided by the loss of the mean of the window weighted by confidence, or of the centre's
    estimate if that is lower, so that every crop counts about the same.
    """
    loss = LOSSES[config.loss]
    numerators, denominators = predict(model, batch, config.bfloat16)
    color, confidence, modulation = batch["color"], batch["confidence"], batch["modulation"]
    terms = config.loss_terms(color.shape[1])
    value = losses.temporal_loss(
        loss, numerators, denominators, color, batch["target"], modulation, batch["exposure"], terms, config.slope
    )
    with torch.no_grad():
        scale = batch["exposure"] * modulation.mean((1, 2, 3)).clamp_min(1e-3)
        mean = mean_of(color * confidence, confidence, color[:, color.shape[1] // 2])
        # The floor matters only where the input equals the target, as in a synthetic or an empty crop.
        alone = batch["estimate"][:, color.shape[1] // 2]
        inputs = [loss(image * modulation, batch["target"], scale) for image in (mean, alone)]
        reference = torch.minimum(*inputs).clamp_min(1e-4)
    return (value / reference).mean()


@torch.no_grad()
def validate(model: Model, clips: Sequence[Clip]) -> dict[str, float]:
    """Means over whole validation clips.

    Parameters
    ----------
    model : Model
        The model.
    clips : sequence of Clip
        At least one.

    Returns
    -------
    dict
        PSNR in dB on x/(1+x) against the targets, which may be noisy: ``noisy``, ``estimate`` (the centre's),
        ``gated`` (their average), ``denoised``, and ``blind``, denoised without estimates. ``mean``: radiance of
        denoised over that of the targets. ``side``: weight of the side frames.
    """
    sums: dict[str, float] = {}
    for clip in clips:
        batch = whole_frame(clip, model.multiple)
        centre = len(clip.color) // 2
        modulation, target = batch["modulation"], batch["target"]
        estimate, confidence = batch["estimate"], batch["confidence"]
        images = {
            "noisy": batch["color"][:, centre],
            "estimate": estimate[:, centre],
            "gated": mean_of(estimate * confidence, confidence, estimate[:, centre]),
        }
        for name, present in (("blind", 0.0), ("denoised", 1.0)):
            batch["present"] = torch.full((1,), present)
            numerators, share = predict(model, batch)
            images[name] = mean_of(numerators, share, batch["color"][:, centre])
        values = {name: float(losses.tone_mapped_psnr(image * modulation, target)) for name, image in images.items()}
        values["mean"] = float((images["denoised"] * modulation).sum() / target.sum().clamp_min(1e-6))
        values["side"] = 1 - float(share[:, centre].mean() / share.sum(1).mean())
        for name, value in values.items():
            sums[name] = sums.get(name, 0.0) + value / len(clips)
    return sums


def train(
    training: Sequence[Clip],
    validation: Sequence[Clip],
    model: Model,
    config: TrainConfig,
    out: str | os.PathLike[str],
    *,
    resume: bool = False,
    report: Callable[[str], None] = lambda line: None,
) -> list[float]:
    """Train a model and write its averaged weights.

    Parameters
    ----------
    training, validation : sequence of Clip
        Of disjoint shots; validation may be empty.
    model : Model
        Trained in place from the weights it has.
    config : TrainConfig
        How.
    out : path
        Safetensors file, written at each checkpoint and at the end; ``OUT.state`` beside it holds what resuming
        needs and is removed at the end.
    resume : bool
        Go on from ``OUT.state``, as if the training had not been interrupted.
    report : callable
        Is given lines of text on how it goes.

    Returns
    -------
    list of float
        Loss of each step of this run.

    Raises
    ------
    ValueError
        If the state to resume is cut short or of another training.
    FileNotFoundError
        If there is no state to resume.
    """
    state_path = Path(f"{os.fspath(out)}.state")
    model.train()
    average = copy.deepcopy(model).requires_grad_(False)
    optimizer = torch.optim.AdamW(model.parameters(), lr=config.rate, weight_decay=config.weight_decay)
    sampler = Sampler(training, config.sampler, config.seed)
    identity = json.dumps({"model": describe(model), "training": _identity(config)}, sort_keys=True)
    step, before = 0, 0.0
    history: list[dict[str, float]] = []
    if resume:
        state = _read_state(state_path, identity)
        model.load_state_dict(state["model"])
        average.load_state_dict(state["average"])
        optimizer.load_state_dict(state["optimizer"])
        progress = json.loads(state["progress"])
        step, before, history = progress["step"], progress["seconds"], progress["history"]
        sampler.rng.bit_generator.state = progress["rng"]
    report(
        f"{sum(p.numel() for p in model.parameters())} parameters, {len(training)} clips for training, "
        f"{len(validation)} for validation, {torch.get_num_threads()} threads"
    )

    start = time.monotonic() - before
    checkpointed = validated = spoken = before
    values: list[float] = []
    while (done := _done(config, step, time.monotonic() - start)) < 1:
        optimizer.param_groups[0]["lr"] = config.rate * _rate(config, step, done)
        loss = batch_loss(model, sampler.batch(config.batch), config)
        optimizer.zero_grad(set_to_none=True)
        loss.backward()
        norm = nn.utils.clip_grad_norm_(model.parameters(), config.clip_norm)
        if bool(torch.isfinite(norm)):
            optimizer.step()
        _follow(average, model, min(config.ema, (1 + step) / (10 + step)))
        step += 1
        values.append(loss.item())

        now = time.monotonic() - start
        if now - spoken > 15:
            spoken = now
            left = now / done * (1 - done) if done > 0 else math.nan
            recent = values[-100:]
            report(f"step {step}  loss {sum(recent) / len(recent):.4f}  {now / 60:.1f} min, {left / 60:.1f} min left")
        if validation and now - validated > 60 * config.validate_minutes:
            history.append({"step": step, **validate(average, validation)})
            report(_line(history[-1]))
            validated = time.monotonic() - start
        if now - checkpointed > 60 * config.checkpoint_minutes:
            _write(out, average, config, history)
            progress = {"step": step, "seconds": now, "history": history, "rng": sampler.rng.bit_generator.state}
            _write_state(state_path, identity, model, average, optimizer, progress)
            checkpointed = now
    if validation:
        history.append({"step": step, **validate(average, validation)})
        report(_line(history[-1]))
    _write(out, average, config, history)
    state_path.unlink(missing_ok=True)
    return values


def _done(config: TrainConfig, step: int, seconds: float) -> float:
    """Part of the training that is done, by the limit that is nearer."""
    by_step = step / config.steps if config.steps else 0.0
    by_time = seconds / (60 * config.minutes) if config.minutes else 0.0
    return max(by_step, by_time)


def _rate(config: TrainConfig, step: int, done: float) -> float:
    """Learning rate over its peak: linear warm-up, half a cosine down to a hundredth."""
    return min(1.0, (step + 1) / max(1, config.warmup)) * (0.505 + 0.495 * math.cos(math.pi * done))


@torch.no_grad()
def _follow(average: nn.Module, model: nn.Module, decay: float) -> None:
    """Exponential moving average of the weights."""
    torch._foreach_lerp_(list(average.parameters()), list(model.parameters()), 1 - decay)


def _line(values: dict[str, float]) -> str:
    """One validation in one line."""
    return "validation  " + "  ".join(f"{name} {value:.3f}" for name, value in values.items())


def _identity(config: TrainConfig) -> dict[str, Any]:
    """The configuration less what may change between an interruption and its resumption."""
    values = asdict(config)
    for name in ("checkpoint_minutes", "validate_minutes"):
        del values[name]
    return values


def _write(out: str | os.PathLike[str], average: Model, config: TrainConfig, history: list[Any]) -> None:
    """The weights to keep, with where they come from."""
    save_model(out, average, {"training": asdict(config), "validation": history})


def _write_state(
    path: Path,
    identity: str,
    model: Model,
    average: Model,
    optimizer: torch.optim.Optimizer,
    progress: dict[str, Any],
) -> None:
    """Everything the next step depends on; replaces the last state whole."""
    partial = path.with_name(path.name + ".part")
    state = {
        "identity": identity,
        "model": model.state_dict(),
        "average": average.state_dict(),
        "optimizer": optimizer.state_dict(),
        "progress": json.dumps(progress),
    }
    torch.save(state, partial)
    os.replace(partial, path)


def _read_state(path: Path, identity: str) -> dict[str, Any]:
    """State of an interrupted training, if it is one of this model and configuration."""
    if not path.is_file():
        raise FileNotFoundError(f"resume: no file {os.fspath(path)!r}")
    try:
        state: dict[str, Any] = torch.load(path, map_location="cpu", weights_only=True)
        found = state["identity"]
    except Exception as error:  # torch has no one class for what may be wrong with a file
        raise ValueError(f"resume {os.fspath(path)!r}: no training state, or cut short ({error})") from error
    if found != identity:
        raise ValueError(f"resume {os.fspath(path)!r}: expected the same model and configuration, got another")
    return state


def main(arguments: Sequence[str] | None = None) -> int:
    """The command ``ravg train``; returns the exit status."""
    parser = argparse.ArgumentParser(prog="ravg train", description="Train a network on clips.")
    parser.add_argument("clips", help="folder of .npz clips")
    parser.add_argument("-o", "--out", required=True, help="safetensors file to write")
    parser.add_argument("--preset", choices=("fast", "paper"), default="fast")
    parser.add_argument("--init", help="weights to start from, of any preset; without: random ones of --preset")
    parser.add_argument("--minutes", type=float, help="stop after so many minutes")
    parser.add_argument("--steps", type=int, help="stop after so many steps")
    parser.add_argument("--validation", nargs="*", default=[], metavar="SHOT", help="shots kept out of training")
    parser.add_argument("--batch", type=int, default=TrainConfig.batch)
    parser.add_argument("--rate", type=float, default=TrainConfig.rate)
    parser.add_argument("--loss", choices=sorted(LOSSES), default=TrainConfig.loss)
    parser.add_argument("--whole", type=float, default=TrainConfig.whole, help="weight of the whole window's term")
    parser.add_argument("--crop", type=int, default=SamplerConfig.crop)
    parser.add_argument("--seed", type=int, default=0)
    parser.add_argument("--threads", type=int, help="threads of torch")
    parser.add_argument("--float32", action="store_true", help="no bfloat16")
    parser.add_argument("--resume", action="store_true", help="go on from OUT.state")
    options = parser.parse_args(arguments)
    try:
        config = TrainConfig(
            steps=options.steps,
            minutes=options.minutes,
            batch=options.batch,
            rate=options.rate,
            loss=options.loss,
            whole=options.whole,
            bfloat16=not options.float32,
            seed=options.seed,
            sampler=SamplerConfig(crop=options.crop),
        )
    except ValueError as error:
        parser.error(str(error))
    if options.threads:
        torch.set_num_threads(options.threads)
    presets: dict[str, Callable[..., Model]] = {"fast": fast, "paper": paper}
    try:
        training, validation = split_by_shot(load_clips(options.clips), options.validation)
        if options.init:
            model = load_model(options.init).float().train().requires_grad_(True)
        else:
            model = presets[options.preset](frames=training[0].color.shape[0], seed=options.seed)
        train(
            training,
            validation,
            model,
            config,
            options.out,
            resume=options.resume,
            report=lambda line: print(line, flush=True),
        )
    except (ValueError, FileNotFoundError) as error:
        print(f"error: {error}", file=sys.stderr)
        return 1
    return 0


if __name__ == "__main__":
    sys.exit(main())
