"""Training on the clips of a folder."""

from __future__ import annotations

import os
from collections.abc import Callable, Sequence
from pathlib import Path

import torch

from hybrid.runtime.threads import limit_threads
from network.checkpoint import load_model, shipped_weights
from network.models import PRESETS, window_length
from network.robust_unet import RobustUNet, start_from_oidn
from network.training.clips import open_clips, split_by_shot
from network.training.config import TrainConfig
from network.training.loop import train


def train_network(
    clips: Path,
    output: Path,
    config: TrainConfig,
    *,
    preset: str,
    init: str | None,
    window: int | None,
    validation: Sequence[str],
    threads: int | None,
    resume: bool,
    log: Callable[[int, dict[str, float]], None],
) -> list[float]:
    """Train a preset, or weights there are, on the clips of a folder.

    Parameters
    ----------
    clips : Path
        From `write_clips`.
    output : Path
        Weights to write.
    config : TrainConfig
        All that determines the training beside clips and model; its seed is that of the initial weights too.
    preset : str
        Of `network.models.PRESETS`; not looked at with init.
    init : str, optional
        Weights to start from: a file, a preset that ships, or "oidn": the preset's, on OIDN's trunk.
    window : int, optional
        Frames of a window, the middle ones of those that the clips have; all without.
    validation : sequence of str
        Shots kept out of training.
    threads : int, optional
        Of torch and numba.
    resume : bool
        Whether to go on from what an interrupted training has left, as for `network.training.loop.train`.
    log : callable
        Is given a step and figures.

    Returns
    -------
    list of float
        The losses.

    Raises
    ------
    ValueError
        If settings, clips and model do not fit together.

    Notes
    -----
    Under ``torchrun``, which sets WORLD_SIZE, the processes train together, over nccl with GPUs and gloo without.
    """
    if threads is not None:
        limit_threads(threads)
    training, kept_out = split_by_shot(open_clips(clips, window), validation)
    if init is None or init == "oidn":
        if preset not in PRESETS:
            raise ValueError(f"preset is {preset!r}, expected one of {', '.join(PRESETS)}")
        model = PRESETS[preset](frames=training.frames, seed=config.seed)
        if init is not None:
            if not isinstance(model, RobustUNet):
                raise ValueError(f"init is {init!r}, expected with it a preset on OIDN's trunk, not {preset!r}")
            start_from_oidn(model)
    else:
        path = Path(init) if Path(init).suffix else shipped_weights(init)
        model = load_model(path)
        if window_length(model) != training.frames:
            raise ValueError(
                f"clips: expected windows of {window_length(model)} frames as {init} has, got {training.frames}"
            )
    output.parent.mkdir(parents=True, exist_ok=True)
    together = int(os.environ.get("WORLD_SIZE", "1")) > 1
    if together:
        torch.distributed.init_process_group()
    try:
        return train(training, kept_out, model, config, output, resume=resume, log=log)
    finally:
        if together:
            torch.distributed.destroy_process_group()
