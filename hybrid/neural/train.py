"""Training on the clips of a folder."""

import gc
import os
from collections.abc import Callable, Sequence
from dataclasses import replace
from pathlib import Path
from typing import NamedTuple

import torch

from hybrid.runtime.allocator import reuse_freed_memory
from hybrid.runtime.threads import limit_threads
from network.checkpoint import find_weights, load_model
from network.presets import PRESETS, Model, build_preset
from network.robust_unet import RobustUNet, start_from_oidn
from network.training.clips import Clips, open_clips, split_by_shot
from network.training.config import TrainConfig
from network.training.loop import train


class TrainInputs(NamedTuple):
    clips: Path  # from `write_clips`
    preset: str  # of `network.presets.PRESETS`; not used with a file or a preset as init
    init: str | None = None  # initial weights: a file, a preset that ships, or "oidn": the preset's, on OIDN's backbone
    window: int | None = None  # frames of a window, the middle ones of the clips'; None: all
    validation: Sequence[str] = ()  # shots kept out of training


def train_network(
    inputs: TrainInputs,
    output: Path,
    config: TrainConfig,
    *,
    threads: int | None,
    resume: bool,
    log: Callable[[int, dict[str, float]], None],
) -> list[float]:
    """Train a preset, or given weights, on the clips of a folder; return the losses.

    The seed of `config` is that of the initial weights too; `threads` are those of torch and numba. Under ``torchrun``,
    the processes train together. Raises ValueError if settings, clips and model do not fit together.
    """
    if threads is not None:
        limit_threads(threads)
    reuse_freed_memory()
    config = replace(config, against=config.against or ("input" if inputs.init is None else "start"))
    training, validation = split_by_shot(open_clips(inputs.clips, inputs.window), inputs.validation)
    model = _initial_model(inputs, training, config.seed)
    output.parent.mkdir(parents=True, exist_ok=True)
    together = int(os.environ.get("WORLD_SIZE", "1")) > 1
    if together:
        torch.distributed.init_process_group()
    try:
        return train(training, validation, model, config, output, resume=resume, log=log)
    finally:
        if together:
            gc.collect()  # references in cycles keep the group's threads, which abort a process that ends under them
            torch.distributed.destroy_process_group()


def _initial_model(inputs: TrainInputs, training: Clips, seed: int) -> Model:
    init, preset = inputs.init, inputs.preset
    if init in (None, "oidn"):
        if inputs.window is None and preset in PRESETS and PRESETS[preset].frames != training.frames:
            raise ValueError(
                f"clips: expected windows of {PRESETS[preset].frames} frames, as {preset} has, got {training.frames}; "
                f"--window {training.frames} trains a network of so many"
            )
        model = build_preset(preset, training.frames, seed)
        if init is not None:
            if not isinstance(model, RobustUNet):
                raise ValueError(f"init is {init!r}, expected with it a preset on OIDN's backbone, not {preset!r}")
            start_from_oidn(model)
        return model
    assert init is not None
    model = load_model(find_weights(init))
    if model.frames != training.frames:
        raise ValueError(f"clips: expected windows of {model.frames} frames as {init} has, got {training.frames}")
    return model
