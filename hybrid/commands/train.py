"""The commands that make training clips and train a network on them."""

import glob
from dataclasses import replace
from functools import partial
from pathlib import Path
from typing import Annotated, Any, NamedTuple

import typer

from hybrid.commands import options as opt
from hybrid.commands.chunks import Chunk, arguments_of
from hybrid.commands.cluster import run_on_cluster
from hybrid.commands.log import LOG, Progress
from hybrid.commands.shots import ShotInput, import_neural, log_cuts, validate_renders
from hybrid.denoising.plan import Context
from hybrid.denoising.stream import plan_shot
from hybrid.files.replace import check_outputs
from hybrid.files.shots import Shot, open_shot
from hybrid.runtime.allocator import reuse_freed_memory
from network.training.config import SamplerConfig, TrainConfig


class Levels(NamedTuple):
    name: str  # of the shot
    shots: dict[str, Shot]
    samples: list[float]  # per pixel

    @property
    def first(self) -> Shot:
        return next(iter(self.shots.values()))


def open_levels(spec: str, samples: dict[str, float] | None = None, read: ShotInput | None = None) -> Levels:
    """Find the noise levels of a shot: all independent renders in a folder, ``LEVEL.####.exr``, or one sequence.

    `samples` are the levels to open and their samples per pixel, by default all but those named ``reference…``, as the
    headers of Cycles have them. Raises FileNotFoundError if there is no such folder, sequence or level, and ValueError
    if there are several levels and no samples of one of them.
    """
    path = Path(spec)
    if path.is_dir():
        found = sorted({item.name.partition(".")[0] for item in path.glob("*.exr") if not item.name.startswith(".")})
        names = [name for name in found if not name.startswith("reference")] if samples is None else list(samples)
        if not names or not set(names) <= set(found):
            wanted = ", ".join(names) or "LEVEL.####.exr"
            raise FileNotFoundError(f"levels: expected {wanted} in {spec}, got {', '.join(found) or 'no .exr'}")
        specs = {name: str(path / f"{name}.####.exr") for name in names}
    else:
        path = path.parent
        specs = {Path(spec).name.partition(".")[0]: spec}
    levels = {name: replace(read or ShotInput(shot=spec), shot=item).open(keep=1) for name, item in specs.items()}
    counts = []
    for name, shot in levels.items():
        count = (samples or {}).get(name) or shot.samples
        if count is None and len(levels) > 1:
            raise ValueError(f"levels: no samples in the header of {name}; expected --levels {name}=SAMPLES,…")
        counts.append(float(count or 1))
    return Levels(path.resolve().name, levels, counts)


@opt.command("make-clips", ShotInput)
def make_clips(
    context: typer.Context,
    shots: list[str],
    output: Path,
    levels: str | None = None,
    tile: int = 128,
    tiles: int = 4,
    window: int = 5,
    first_pass: Annotated[str, opt.check_first_pass] = "auto",
    reference: bool = False,
    target: str | None = None,
    teacher: str | None = None,
    seed: int = 0,
    scheduler: str | None = None,
    **how: Any,
) -> None:
    """Write the clips of each shot, here or on a cluster."""
    if window not in (1, 3, 5, 7):
        raise typer.BadParameter(f"--window is {window}, expected 1, 3, 5 or 7")
    if reference and target is not None:
        raise typer.BadParameter("--target: expected none with --reference, which is the target")
    if teacher is not None and not reference:
        raise typer.BadParameter("--teacher: expected --reference beside it")
    neural = import_neural()
    with opt.usage():
        samples = None if levels is None else parse_samples(levels)
    read = ShotInput(shot=shots[0], **how)
    opened = [open_levels(spec, samples, read) for spec in shots]
    _check_levels(opened, target)
    if scheduler is not None:
        chunks = {
            each.name: Chunk(arguments_of(context, {"shots": [spec]}), len(each.first))
            for each, spec in zip(opened, shots, strict=True)
        }
        run_on_cluster(scheduler, "make-clips", chunks)
        return
    output.mkdir(parents=True, exist_ok=True)
    reuse_freed_memory()
    denoiser = None if teacher is None else neural.open_network(neural.find_weights(teacher))
    if denoiser is not None and denoiser.radius != window // 2:
        raise ValueError(f"teacher: expected --window {2 * denoiser.radius + 1}, as {teacher} has, got {window}")
    bar = Progress("make-clips", sum(len(each.first) for each in opened))
    for each in opened:
        if any(output.glob(f"{glob.escape(each.name)}.[0-9][0-9][0-9][0-9].safetensors")):
            bar.advance(len(each.first), f"{each.name} has clips already")
            continue
        inputs, _ = validate_renders(each.shots, strict=read.strict)
        render = None if target is None else inputs.pop(target)
        plan = plan_shot(next(iter(inputs.values())), context=Context(True, window // 2))
        log_cuts(plan, (), strict=read.strict, name=each.name if len(opened) > 1 else "")
        clean = each.first.path(each.first.numbers[0]).with_name("reference.####.exr")
        source = neural.ClipSource(
            each.name,
            inputs,
            [count for level, count in zip(each.shots, each.samples, strict=True) if level != target],
            reference=open_shot(clean, keep=1, max_pixels=each.first.max_pixels) if reference else None,
            target=render,
        )
        neural.write_clips(
            source,
            output,
            radius=window // 2,
            tile=tile,
            tiles=tiles,
            estimate=first_pass,
            teacher=None if denoiser is None else lambda aligned: denoiser(aligned).color,
            seed=seed,
            advance=partial(bar.advance, message=each.name),
        )
    LOG.info(f"clips of {len(opened)} shots are in {output}")


def _check_levels(opened: list[Levels], target: str | None) -> None:
    """Raise ValueError for shots of one name, or without the target."""
    names = [each.name for each in opened]
    if twice := sorted({name for name in names if names.count(name) > 1}):
        raise ValueError(f"shots: expected folders of different names, got {twice[0]!r} twice")
    for each in opened:
        if target is not None and (target not in each.shots or len(each.shots) == 1):
            levels = ", ".join(each.shots)
            raise ValueError(
                f"target: expected a level of {each.name} that is not the only one, {levels}, got {target!r}"
            )


def parse_samples(text: str) -> dict[str, float]:
    """Read ``a=24,b=24,c=8``: levels, and their samples per pixel; ValueError if it is not of that form."""
    samples = {}
    for item in text.split(","):
        name, count = opt.split_number(item)
        if not name or count is None:
            raise ValueError(f"levels: expected NAME=SAMPLES,…, got {text!r}")
        samples[name] = count
    return samples


@opt.command("train", TrainConfig, SamplerConfig)
def train(
    clips: Path,
    output: Path,
    preset: str = "balanced",
    init: str | None = None,
    window: int | None = None,
    validation: list[str] | None = None,
    device: opt.Device = "auto",
    threads: int | None = None,
    tensorboard: Path | None = None,
    resume: bool = False,
    **settings: Any,
) -> None:
    """Train a network, and log how it goes."""
    neural = import_neural()
    if init in (None, "oidn") and preset not in neural.TRAINING_PRESETS:
        known = ", ".join(neural.TRAINING_PRESETS)
        raise typer.BadParameter(f"--preset is {preset!r}, expected one of {known}")
    with opt.usage():
        sampler = SamplerConfig(**opt.take(SamplerConfig, settings))
        config = TrainConfig(**settings, device=device, sampler=sampler)
    if init is None and config.against == "start":
        raise typer.BadParameter("--against is 'start', expected 'input' without --init, which gives the weights there")
    read = [("clip", path) for path in sorted(clips.glob("*.safetensors"))]
    given = {"init": init, "vgg": config.vgg}
    read += [(what, Path(path)) for what, path in given.items() if path and Path(path).is_file()]
    check_outputs([("output", output), ("state", Path(f"{output}.state"))], read)
    writer = None
    if tensorboard is not None:
        try:
            from tensorboardX import SummaryWriter
        except ModuleNotFoundError:
            raise ValueError('tensorboardX is not installed; expected: pip install "tensorboardX"') from None
        writer = SummaryWriter(str(tensorboard))
    recent: list[float] = []
    bar = Progress("train", 100, "%")

    def log(step: int, values: dict[str, float]) -> None:
        if writer is not None:
            for name, value in values.items():
                writer.add_scalar(name, value, step)
        if "done" in values:
            recent.append(values["train/loss"])
            del recent[:-100]
            text = f"step {step}  loss {sum(recent) / len(recent):.4f}"
            bar.advance(100 * values["done"] - bar.done, text)
        else:
            figures = "  ".join(f"{name.partition('/')[2]} {value:.3f}" for name, value in values.items())
            LOG.info(f"step {step}: {figures}")

    shots = tuple(name for item in validation or () for name in item.split(","))
    inputs = neural.TrainInputs(clips, preset, init, window, shots)
    neural.train_network(inputs, output, config, threads=threads, resume=resume, log=log)
    if writer is not None:
        writer.close()
    LOG.info(f"wrote {output}")
