"""Training of a network on clips: a plain loop, in one process or several.

Several processes are those of ``torchrun``: each makes its share of every batch, gradients are averaged, and the first
process validates and writes. Plain torch does it in a few lines, so no framework is needed.

Set ``OMP_WAIT_POLICY=PASSIVE`` in the environment (it is read when torch is imported): OpenMP's threads
otherwise spin while they wait, and a step takes ten times as long on a machine that has other work.
"""

import copy
import itertools
import json
import math
import os
import time
from collections.abc import Callable, Iterator, Sequence
from dataclasses import asdict, replace
from pathlib import Path
from typing import Any, cast

import torch
from torch import Tensor, nn
from torch.nn import functional
from torch.nn.parallel import DistributedDataParallel
from torch.utils.data import DataLoader

from network.checkpoint import describe, new_partial, save_model
from network.devices import find_device, has_bfloat16
from network.paper.inputs import KernelWindow
from network.paper.kernels import Filtered, mean_of
from network.paper.models import filter_window
from network.presets import Model
from network.robust_average import UNetWindow
from network.robust_unet import RobustUNet, UNetOutput
from network.training import losses
from network.training.clips import Clips, Sample, Samples, whole_frames
from network.training.config import TrainConfig
from network.training.perceptual import Perceptual, load_vgg19
from network.unet import channels_last

#: Share of the starting network's error from which on a crop counts, with `TrainConfig.against` "start": gains beyond
#: 15 % of a crop would pay for losses in others.
ENOUGH = 0.85
#: Least error of the starting network in a crop, over that of the clip's best input: ratios to smaller errors would
#: outweigh all other crops.
LEAST = 0.05


def predict(
    model: Model, batch: Sample, bfloat16: bool = False, run: Callable[..., Any] | None = None
) -> Filtered | UNetOutput:
    """Run a model, or `run` where it is wrapped, on a batch; the output has ``irradiance`` and ``parts()``."""
    with torch.autocast(batch.color.device.type, torch.bfloat16, enabled=bfloat16):
        if not isinstance(model, RobustUNet):
            window = KernelWindow(batch.color, batch.confidence, batch.exposure, batch.albedo, batch.normal)
            return filter_window(model, window, run=run)
        clean = model.config.clean_guides
        inputs = UNetWindow(
            batch.estimate,
            batch.residual,
            batch.confidence,
            batch.modulation,
            batch.exposure,
            batch.gain,
            batch.clean_albedo if clean else centre_of(batch.albedo),
            batch.clean_normal if clean else centre_of(batch.normal),
        )
        output: UNetOutput = (model if run is None else run)(inputs)
        return output


def centre_of(layers: Tensor) -> Tensor:
    """Centre frame of ``(N, T, C, H, W)``."""
    return layers[:, layers.shape[1] // 2]


def keep_frames(batch: Sample, frames: Sequence[int]) -> Sample:
    """A batch in which only these frames of the window have any confidence."""
    kept = torch.zeros_like(batch.confidence)
    kept[:, list(frames)] = 1
    return batch._replace(confidence=batch.confidence * kept)


def loss_terms(config: TrainConfig, frames: int) -> list[losses.Term]:
    """Terms of the loss of a network with windows of so many frames; "temporal" by default."""
    if config.terms in (None, "temporal"):
        return losses.temporal_terms(frames, config.whole)
    return losses.power_terms(frames) if config.terms == "power" else losses.spatial_terms(frames)


def image_loss(config: TrainConfig) -> losses.ImageLoss:
    """The image loss of a training; reads VGG19 for the perceptual one."""
    if config.vgg is not None:
        return Perceptual(load_vgg19(config.vgg))
    return {"l1": losses.l1, "smape": losses.smape, "relmse": losses.relmse, "display": losses.display}[config.loss]


def batch_loss(
    model: Model,
    batch: Sample,
    config: TrainConfig,
    loss: losses.ImageLoss,
    run: Callable[..., Any] | None = None,
    start: Model | None = None,
) -> Tensor:
    """Training loss of a batch: mean of log(1 + loss of each crop, relative to that of its clip's best input).

    With `start`, the network that the training began with, it is the mean of max(0, q − `ENOUGH`)², with q the crop's
    loss over that of `start`, and a straight line from half beyond `ENOUGH` on: the network is to be no worse anywhere,
    rather than much better in a few places.

    Possible gains differ by orders of magnitude between shots, and the targets' noise adds a floor. Each crop's loss is
    divided by that of its whole clip's best input (the mean of the window weighted by confidence, or the centre's first
    pass), so that every clip counts about the same. Where clips are whole frames and a crop was divided by its own
    input's loss, flat crops, in which averaging can do no harm, outweighed the edges, and the network averaged where it
    should not. The logarithm is for the few crops that are twenty times worse than their clip: one of them would undo
    the gradients of a hundred others.
    """
    if start is not None:
        # Not without gradients, where networks take the fused operations of inference: both compute alike.
        before = _crop_losses(start, batch, config, loss).detach()
        ratio = _crop_losses(model, batch, config, loss, run) / before.clamp_min(LEAST)
        return losses.bent_square(functional.relu(ratio - ENOUGH), 0.5).mean()
    return torch.log1p(_crop_losses(model, batch, config, loss, run)).mean()


def _crop_losses(
    model: Model, batch: Sample, config: TrainConfig, loss: losses.ImageLoss, run: Callable[..., Any] | None = None
) -> Tensor:
    """Loss (N,) of each crop over that of its clip's best input."""
    if neighbours := config.differences > 0:
        batch = Sample(*(pair.flatten(0, 1) for pair in batch))
    color, facts = batch.color, (batch.target, batch.modulation, batch.exposure)
    terms = loss_terms(config, color.shape[1])
    if isinstance(model, RobustUNet):
        # An image of the U-Net is no sum of frames: the network runs once on each subset of the window.
        value = torch.zeros_like(batch.error)
        for subset, weight in terms:
            output = predict(model, keep_frames(batch, subset), not config.float32, run)
            value = value + weight * losses.image_loss(loss, output.irradiance, centre_of(color), *facts, config.slope)
        value = value / sum(weight for _, weight in terms)
    else:
        output = cast(Filtered, predict(model, batch, not config.float32, run))
        value = losses.temporal_loss(loss, output, color, *facts, terms, config.slope)
    value = value / batch.error
    if neighbours:
        image, target, modulation, exposure, error = (
            pair.unflatten(0, (-1, 2)) for pair in (output.irradiance, *facts, batch.error)
        )
        after = color.shape[1] // 2 + 1
        trust = batch.confidence[::2, min(after, color.shape[1] - 1)]
        flicker = losses.difference_loss(loss, image, target, modulation, exposure, batch.to_next[::2], trust)
        value = value.unflatten(0, (-1, 2)).mean(1) + config.differences * flicker / error.mean(1)
    return value


@torch.no_grad()
def validate(model: Model, clips: Clips) -> dict[str, float]:
    """Means over whole validation clips, each at all of its noise levels.

    PSNR in dB on x/(1+x) against the targets, which may be noisy: ``noisy``, ``estimate`` (the centre's first pass),
    ``gated`` (average of the first passes) and ``denoised``. ``mean``: radiance of denoised over that of the targets.
    ``side``: weight of the side frames.
    """
    sums: dict[str, float] = {}
    device = next(model.parameters()).device
    batches = [batch for index in range(len(clips)) for batch in whole_frames(clips, index, model.multiple)]
    for batch in batches:
        batch = Sample(*(value.to(device) for value in batch))
        output, first_pass = predict(model, batch), centre_of(batch.estimate)
        images = {
            "noisy": centre_of(batch.color),
            "estimate": first_pass,
            "gated": mean_of(batch.estimate * batch.confidence, batch.confidence, first_pass),
            "denoised": output.irradiance,
        }
        values = {n: float(losses.tone_mapped_psnr(x * batch.modulation, batch.target)) for n, x in images.items()}
        values["mean"] = float((output.irradiance * batch.modulation).sum() / batch.target.sum().clamp_min(1e-6))
        values["side"] = 1 - float(centre_of(output.parts()[1]).mean())
        for name, value in values.items():
            sums[name] = sums.get(name, 0.0) + value / len(batches)
    return sums


def train(
    training: Clips,
    validation: Clips,
    model: Model,
    config: TrainConfig,
    out: str | os.PathLike[str],
    *,
    resume: bool = False,
    log: Callable[[int, dict[str, float]], None] = lambda step, values: None,
) -> list[float]:
    """Train a model in place and write the moving average of its weights; return the loss of each step of this process.

    `out` is written at each checkpoint and at the end; ``OUT.state`` beside it holds what `resume` continues from as if
    nothing had been interrupted. `log` is called in the first process with the steps done and, after each,
    ``train/loss``, ``train/rate``, ``train/norm`` (of the gradient), ``done`` (0 to 1) and ``seconds``; after a
    validation with its values. In a process group (``torch.distributed``) each process trains on its share of every
    batch, and gradients are averaged: the same as one process on the whole batch.

    Raises ValueError if the state to resume is cut short or of another training, the batch cannot be shared evenly, or
    crops or terms do not fit the model; FileNotFoundError if there is no state to resume.
    """
    rank, world = (torch.distributed.get_rank(), torch.distributed.get_world_size()) if _in_group() else (0, 1)
    if config.batch % world:
        raise ValueError(f"batch: expected a multiple of the {world} processes, got {config.batch}")
    if config.sampler.crop % model.multiple:
        raise ValueError(
            f"crop: expected a multiple of {model.multiple}, as this model needs, got {config.sampler.crop}"
        )
    device = _device(config.device)
    state_path = Path(f"{os.fspath(out)}.state")
    channels_last(model.to(device).train())
    average = copy.deepcopy(model).requires_grad_(False)
    start = copy.deepcopy(average) if config.against == "start" else None
    groups = _groups(model, config.backbone_rate)
    optimizer = torch.optim.AdamW(groups, lr=config.rate, weight_decay=config.weight_decay)
    saved: dict[str, Any] = {"model": model, "average": average, "optimizer": optimizer}
    if start is not None:
        saved["start"] = start
    # These settings may change between an interruption and its resumption.
    fixed = {name: value for name, value in asdict(config).items() if name not in ("validate_minutes", "workers")}
    identity = json.dumps({"model": describe(model), "training": fixed}, sort_keys=True)
    # Where a processor has no bfloat16, torch computes it in loops that take ten times as long as float32.
    config = replace(config, float32=config.float32 or not has_bfloat16(device))
    step, before = 0, 0.0
    history: list[dict[str, float]] = []
    if resume:
        state = _read_state(state_path, identity)
        for name, part in saved.items():
            part.load_state_dict(state[name])
        progress = json.loads(state["progress"])
        step, before, history = progress["step"], progress["seconds"], progress["history"]
    loss_of_image = image_loss(config)
    if isinstance(loss_of_image, nn.Module):
        loss_of_image.to(device)
    run: nn.Module = DistributedDataParallel(model) if world > 1 else model
    if config.compile:
        run = cast(nn.Module, torch.compile(run))
    samples = Samples(training, config.sampler, config.seed, loss_of_image, neighbours=config.differences > 0)
    batches = _batches(samples, config, step, rank, world)

    def validate_average() -> None:
        history.append({"step": step, **validate(average, validation)})
        log(step, {f"validation/{name}": value for name, value in history[-1].items() if name != "step"})

    def write_weights() -> None:
        save_model(out, average, {"training": asdict(config), "validation": history})

    started = time.monotonic() - before
    checkpointed = before
    values: list[float] = []
    while (done := _done(config, step, _agreed(time.monotonic() - started, device))) < 1:
        rate = config.rate * _rate(config, step, done)
        for group, part in zip(optimizer.param_groups, groups, strict=True):
            group["lr"] = rate * part["share"]
        batch = Sample(*(value.to(device, non_blocking=True) for value in next(batches)))
        loss = batch_loss(model, batch, config, loss_of_image, run, start)
        optimizer.zero_grad(set_to_none=True)
        loss.backward()
        norm = float(nn.utils.clip_grad_norm_(model.parameters(), config.clip_norm))
        if math.isfinite(norm):
            optimizer.step()
        _follow(average, model, min(config.ema, (1 + step) / (10 + step)))
        step += 1
        values.append(loss.item())
        if rank:
            continue
        now = time.monotonic() - started
        done = _done(config, step, now)
        log(step, {"train/loss": values[-1], "train/rate": rate, "train/norm": norm, "done": done, "seconds": now})
        if now - checkpointed > 60 * config.validate_minutes:
            if len(validation):
                validate_average()
            write_weights()
            progress = {"step": step, "seconds": now, "history": history}
            _write_state(state_path, identity, saved, progress)
            checkpointed = time.monotonic() - started
    if rank == 0:
        if len(validation):
            validate_average()
        write_weights()
        state_path.unlink(missing_ok=True)
    if world > 1:
        torch.distributed.barrier()  # a process that fails while it ends would stop the first one before it has written
    return values


def _groups(model: Model, backbone_rate: float) -> list[dict[str, Any]]:
    """Parameters with their share of the rate: a pretrained backbone should forget nothing."""
    if not isinstance(model, RobustUNet):
        return [{"params": list(model.parameters()), "share": 1.0}]
    new = [value for name, value in model.named_parameters() if not name.startswith("backbone.")]
    # Frozen parameters need no gradient.
    backbone = nn.Module() if model.backbone is None else model.backbone
    backbone.requires_grad_(backbone_rate > 0)
    pretrained = {"params": list(backbone.parameters()), "share": backbone_rate}
    return [{"params": new, "share": 1.0}, *([pretrained] if backbone_rate and pretrained["params"] else [])]


def _in_group() -> bool:
    return torch.distributed.is_available() and torch.distributed.is_initialized()


def _device(name: str) -> torch.device:
    """Device to train on; in a group each process has a GPU of its own."""
    _, device = find_device(name)
    return device if device.type == "cpu" else torch.device(device.type, int(os.environ.get("LOCAL_RANK", 0)))


def _batches(samples: Samples, config: TrainConfig, first: int, rank: int, world: int) -> Iterator[Sample]:
    """Endless batches from step `first` on: of each the share of this process."""
    share = config.batch // world
    numbers = ([step * config.batch + rank * share + k for k in range(share)] for step in itertools.count(first))
    loader: DataLoader[Sample] = DataLoader(
        samples, batch_sampler=cast(Any, numbers), num_workers=config.workers, pin_memory=torch.cuda.is_available()
    )
    return iter(loader)


def _agreed(seconds: float, device: torch.device) -> float:
    """The first process's clock, so that all stop at the same step."""
    if not _in_group():
        return seconds
    clock = torch.tensor(seconds, dtype=torch.float64, device=device)
    torch.distributed.broadcast(clock, 0)
    return float(clock)


def _done(config: TrainConfig, step: int, seconds: float) -> float:
    """Finished share of the training, by the nearer limit."""
    by_step = step / config.steps if config.steps else 0.0
    by_time = seconds / (60 * config.minutes) if config.minutes else 0.0
    return max(by_step, by_time)


def _rate(config: TrainConfig, step: int, done: float) -> float:
    """Learning rate over its peak: linear warm-up, half a cosine down to a hundredth."""
    return min(1.0, (step + 1) / max(1, config.warmup)) * (0.505 + 0.495 * math.cos(math.pi * done))


@torch.no_grad()
def _follow(average: nn.Module, model: nn.Module, decay: float) -> None:
    torch._foreach_lerp_(list(average.parameters()), list(model.parameters()), 1 - decay)


def _write_state(path: Path, identity: str, parts: dict[str, Any], progress: dict[str, Any]) -> None:
    """Everything the next step depends on, of modules and optimizer; replaces the last state whole."""
    partial = new_partial(path)
    state = {name: part.state_dict() for name, part in parts.items()}
    state |= {"identity": identity, "progress": json.dumps(progress)}
    torch.save(state, partial)
    os.replace(partial, path)


def _read_state(path: Path, identity: str) -> dict[str, Any]:
    """State of an interrupted training of this model and configuration; nothing but tensors is unpickled."""
    if not path.is_file():
        raise FileNotFoundError(f"resume: no file {os.fspath(path)!r}")
    try:
        state: dict[str, Any] = torch.load(path, map_location="cpu", weights_only=True)
        found = state["identity"]
    except Exception as error:  # torch raises errors of many classes for bad files
        raise ValueError(f"resume {os.fspath(path)!r}: no training state, or cut short ({error})") from error
    if found != identity:
        raise ValueError(f"resume {os.fspath(path)!r}: expected the same model and configuration, got another")
    return state
