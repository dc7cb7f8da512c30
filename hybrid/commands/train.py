"""The commands that make training clips and train a network on them."""

from __future__ import annotations

import glob
import re
from functools import partial
from pathlib import Path
from typing import TYPE_CHECKING, Annotated

import typer

from hybrid.commands.cluster import Chunk, SchedulerOption, arguments_of, run_on_cluster
from hybrid.commands.log import LOG, Progress
from hybrid.commands.options import (
    INPUT,
    OUTPUT,
    RESOURCES,
    WHAT,
    DeviceOption,
    FramesOption,
    LayerOption,
    MotionOption,
    ProfileOption,
    StrictOption,
    check_first_pass,
    choose,
    usage,
)
from hybrid.commands.shots import import_neural, judge_alike, parse_input, parse_layers, say_cuts
from network.training.config import SamplerConfig, TrainConfig

if TYPE_CHECKING:
    from hybrid.files.profile import Profile
    from hybrid.files.shots import Shot

TRAINING = "Training"
DEFAULTS = TrainConfig(steps=1)  # one limit there must be


def open_levels(
    spec: str,
    samples: dict[str, float] | None = None,
    *,
    frames: str | None = None,
    layers: dict[str, str] | None = None,
    profile: Profile | None = None,
    motion: str | None = None,
) -> tuple[str, dict[str, Shot], list[float]]:
    """Find the noise levels of a shot.

    Parameters
    ----------
    spec : str
        A folder of one shot, with ``LEVEL.####.exr`` for each independent render of it (``reference`` and what begins
        so is left out), or one sequence.
    samples : dict of str to float, optional
        Levels to take, and their samples per pixel. Without: all there are, and what Cycles wrote in their headers.
    frames : str, optional
        As for `hybrid.files.shots.open_shot`.
    layers, profile, motion : optional
        The same.

    Returns
    -------
    str
        Name of the shot: of its folder.
    dict of str to Shot
        The levels by name.
    list of float
        Their samples per pixel.

    Raises
    ------
    FileNotFoundError
        If there is no such folder or sequence, or a level is not in it.
    ValueError
        If there are several levels and no samples of one of them.
    """
    from hybrid.comparison.samples import samples_of
    from hybrid.files.shots import open_shot

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
    levels = {
        name: open_shot(item, frames=frames, layers=layers or {}, profile=profile, motion=motion, keep=1)
        for name, item in specs.items()
    }
    counts = []
    for name, shot in levels.items():
        count = (samples or {}).get(name) or samples_of(shot)
        if count is None and len(levels) > 1:
            raise ValueError(f"levels: no samples in the header of {name}; expected --levels {name}=SAMPLES,…")
        counts.append(float(count or 1))
    return path.resolve().name, levels, counts


def make_clips(
    context: typer.Context,
    shots: Annotated[
        list[str],
        typer.Argument(metavar="SHOTS...", help="folders, each with LEVEL.####.exr at one or more noise levels"),
    ],
    output: Annotated[
        Path,
        typer.Option("-o", "--output", metavar="CLIPS", help="folder of training clips", rich_help_panel=OUTPUT),
    ],
    levels: Annotated[
        str | None,
        typer.Option(
            help="a=24,b=24,c=8: levels and their samples; else all, as Cycles' headers say", rich_help_panel=INPUT
        ),
    ] = None,
    tile: Annotated[
        int,
        typer.Option(min=0, help="pixels on a side of a clip; 0: whole frames, to validate on", rich_help_panel=WHAT),
    ] = 128,
    tiles: Annotated[
        int,
        typer.Option(
            min=1, help="clips of each frame, placed where noise, detail and motion are", rich_help_panel=WHAT
        ),
    ] = 4,
    window: Annotated[int, typer.Option(help="frames of a window: 1, 3, 5 or 7", rich_help_panel=WHAT)] = 5,
    first_pass: Annotated[
        str,
        typer.Option(
            metavar="SOURCE",
            callback=check_first_pass,
            help="first pass, as for denoise; clips hold it",
            rich_help_panel=WHAT,
        ),
    ] = "auto",
    reference: Annotated[
        bool,
        typer.Option(
            "--reference",
            help="only the frames that SHOT/reference.####.exr has, trained towards it",
            rich_help_panel=INPUT,
        ),
    ] = False,
    target: Annotated[
        str | None,
        typer.Option(
            metavar="LEVEL",
            help="the level whose pseudo-references the others are trained towards; itself it is none",
            rich_help_panel=INPUT,
        ),
    ] = None,
    seed: Annotated[int, typer.Option(help="of the places", rich_help_panel=WHAT)] = 0,
    frames: FramesOption = None,
    layer: LayerOption = None,
    profile: ProfileOption = None,
    motion: MotionOption = None,
    strict: StrictOption = False,
    scheduler: SchedulerOption = None,
) -> None:
    """Make training clips of shots at several noise levels.

    Clips are aligned windows with first passes and pseudo-references.

    Levels must be independent renders. A shot at a single level can be trained on too: towards its pseudo-reference.
    Shots that have clips already are left alone, so that the same command goes on where it was.
    """
    from hybrid.files.shots import open_shot
    from hybrid.plan import Context
    from hybrid.runtime.allocator import reuse_freed_memory
    from hybrid.stream import plan_shot

    if window not in (1, 3, 5, 7):
        raise typer.BadParameter(f"--window is {window}, expected 1, 3, 5 or 7")
    if reference and target is not None:
        raise typer.BadParameter("--target: expected none with --reference, which is the target")
    import_neural()
    from hybrid.neural import write_clips

    with usage():
        samples = None if levels is None else parse_samples(levels)
    roles, chosen = parse_layers(layer), parse_input(profile, motion)
    found = [open_levels(spec, samples, frames=frames, layers=roles, profile=chosen, motion=motion) for spec in shots]
    names = [name for name, _, _ in found]
    if twice := sorted({name for name in names if names.count(name) > 1}):
        raise ValueError(f"shots: expected folders of different names, got {twice[0]!r} twice")
    for name, there, _ in found:
        if target is not None and (target not in there or len(there) == 1):
            levels_there = ", ".join(there)
            raise ValueError(
                f"target: expected a level of {name} that is not the only one, {levels_there}, got {target!r}"
            )
    if scheduler is not None:
        frames_of = {name: len(next(iter(shot.values()))) for name, shot, _ in found}
        words = dict(zip(names, shots, strict=True))
        chunks = {
            name: Chunk(arguments_of(context, {"shots": [words[name]]}), count) for name, count in frames_of.items()
        }
        run_on_cluster(scheduler, "make-clips", chunks)
        return
    output.mkdir(parents=True, exist_ok=True)
    reuse_freed_memory()
    bar = Progress("make-clips", sum(len(next(iter(shot.values()))) for _, shot, _ in found))
    for name, shot, counts in found:
        first = next(iter(shot.values()))
        if any(output.glob(f"{glob.escape(name)}.[0-9][0-9][0-9][0-9].safetensors")):
            bar.advance(len(first), f"{name} has clips already")
            continue
        levels_of, _ = judge_alike(shot, strict=strict)
        towards = None if target is None else levels_of.pop(target)
        inputs = [count for level, count in zip(shot, counts, strict=True) if level != target]
        plan = plan_shot(next(iter(levels_of.values())), context=Context(True, window // 2))
        say_cuts(plan, (), strict=strict, name=name if len(found) > 1 else "")
        write_clips(
            levels_of,
            inputs,
            output,
            name,
            radius=window // 2,
            tile=tile,
            tiles=tiles,
            estimate=first_pass,
            reference=open_shot(first.path(first.numbers[0]).with_name("reference.####.exr"), keep=1)
            if reference
            else None,
            target=towards,
            seed=seed,
            advance=partial(bar.advance, message=name),
        )
    LOG.info(f"clips of {len(found)} shots are in {output}")


def parse_samples(text: str) -> dict[str, float]:
    """Read ``a=24,b=24,c=8``: levels, and their samples per pixel.

    Raises
    ------
    ValueError
        If it is not of that form.
    """
    samples = {}
    for item in text.split(","):
        name, _, count = item.partition("=")
        if not name or not re.fullmatch(r"\d+(\.\d+)?", count) or float(count) <= 0:
            raise ValueError(f"levels: expected NAME=SAMPLES,…, got {text!r}")
        samples[name] = float(count)
    return samples


def train(
    clips: Annotated[Path, typer.Argument(help="folder of clips, from ravg make-clips")],
    output: Annotated[
        Path, typer.Option("-o", "--output", metavar="W.safetensors", help="weights to write", rich_help_panel=OUTPUT)
    ],
    preset: Annotated[
        str, typer.Option(help="fast, balanced, quality, unet, multiscale, paper or tkpcn", rich_help_panel=WHAT)
    ] = "fast",
    init: Annotated[
        str | None,
        typer.Option(
            help="start from these weights: a file, a preset that ships, or oidn: OIDN's own, with a new final stage",
            rich_help_panel=INPUT,
        ),
    ] = None,
    window: Annotated[
        int | None,
        typer.Option(help="frames of a window: 1, 3, 5 or 7", rich_help_panel=WHAT),  # the middle ones of the clips'
    ] = None,
    validation: Annotated[
        list[str] | None,
        typer.Option(help="shots kept out of training; again or with commas for more", rich_help_panel=INPUT),
    ] = None,
    steps: Annotated[int | None, typer.Option(help="stop after so many steps", rich_help_panel=TRAINING)] = None,
    minutes: Annotated[float | None, typer.Option(help="stop after so many minutes", rich_help_panel=TRAINING)] = None,
    batch: Annotated[
        int, typer.Option(help="samples of a step, of all processes together", rich_help_panel=TRAINING)
    ] = DEFAULTS.batch,
    rate: Annotated[float, typer.Option(help="peak learning rate", rich_help_panel=TRAINING)] = DEFAULTS.rate,
    trunk_rate: Annotated[
        float,
        typer.Option(help="share of it for a trunk that knows how to denoise; 0: left alone", rich_help_panel=TRAINING),
    ] = DEFAULTS.trunk_rate,
    warmup: Annotated[
        int, typer.Option(help="steps in which the rate rises", rich_help_panel=TRAINING)
    ] = DEFAULTS.warmup,
    clip_norm: Annotated[
        float, typer.Option("--clip", help="largest norm of a gradient", rich_help_panel=TRAINING)
    ] = DEFAULTS.clip_norm,
    ema: Annotated[
        float, typer.Option(help="how slowly the weights that are kept follow", rich_help_panel=TRAINING)
    ] = DEFAULTS.ema,
    loss: Annotated[
        str,
        typer.Option(
            help="relmse, l1, smape, display (for clean targets), or perceptual (with --vgg)", rich_help_panel=TRAINING
        ),
    ] = DEFAULTS.loss,
    vgg: Annotated[
        str | None,
        typer.Option(help="torchvision's VGG19 weights: a file, or hub to fetch them", rich_help_panel=TRAINING),
    ] = None,
    terms: Annotated[
        str, typer.Option(help="temporal, power (every subset of the window), or spatial", rich_help_panel=TRAINING)
    ] = DEFAULTS.terms,
    whole: Annotated[
        float, typer.Option(help="weight of the whole window's term beside the temporal ones", rich_help_panel=TRAINING)
    ] = DEFAULTS.whole,
    differences: Annotated[
        float,
        typer.Option(
            help="weight of the error of what changes from frame to frame; wants clips of whole frames",
            rich_help_panel=TRAINING,
        ),
    ] = DEFAULTS.differences,
    pseudo: Annotated[
        float,
        typer.Option(help="chance of a pseudo-reference as target, beside renders", rich_help_panel=TRAINING),
    ] = DEFAULTS.sampler.pseudo,
    slope: Annotated[
        float, typer.Option(help="more than 1: asymmetric, rather noise than lost detail", rich_help_panel=TRAINING)
    ] = DEFAULTS.slope,
    drop_frames: Annotated[
        float, typer.Option(help="chance that frames of a sample are taken away", rich_help_panel=TRAINING)
    ] = DEFAULTS.sampler.drop_frames,
    crop: Annotated[
        int, typer.Option(help="pixels on a side of a sample", rich_help_panel=TRAINING)
    ] = DEFAULTS.sampler.crop,
    sets: Annotated[
        int, typer.Option(help="disjoint sets of clips, one an epoch", rich_help_panel=TRAINING)
    ] = DEFAULTS.sampler.sets,
    seed: Annotated[int, typer.Option(help="of initial weights and samples", rich_help_panel=TRAINING)] = DEFAULTS.seed,
    device: DeviceOption = "auto",
    threads: Annotated[int | None, typer.Option(min=1, help="of torch and numba", rich_help_panel=RESOURCES)] = None,
    workers: Annotated[
        int, typer.Option(min=0, help="processes that read clips", rich_help_panel=RESOURCES)
    ] = DEFAULTS.workers,
    float32: Annotated[bool, typer.Option("--float32", help="no bfloat16", rich_help_panel=RESOURCES)] = False,
    compile: Annotated[
        bool, typer.Option("--compile", help="compile the network; pays on a GPU", rich_help_panel=RESOURCES)
    ] = False,
    validate_minutes: Annotated[
        float, typer.Option(help="between validations, and between checkpoints", rich_help_panel=TRAINING)
    ] = DEFAULTS.validate_minutes,
    tensorboard: Annotated[
        Path | None, typer.Option(metavar="FOLDER", help="write TensorBoard's logs there", rich_help_panel=OUTPUT)
    ] = None,
    resume: Annotated[
        bool,
        typer.Option("--resume", help="go on from W.safetensors.state, with the same options", rich_help_panel=OUTPUT),
    ] = False,
) -> None:
    """Train a network on clips.

    ``torchrun -m hybrid.cli train …`` trains in several processes.

    Fine-tune on your own footage, without any reference: ravg prepare it, then --init fast --rate 1e-4.
    """
    import_neural()
    from hybrid.files.replace import check_outputs
    from hybrid.neural import train_network
    from network.models import PRESETS

    if init in (None, "oidn"):
        choose(PRESETS, preset, "preset")
    with usage():
        config = TrainConfig(
            steps=steps,
            minutes=minutes,
            batch=batch,
            rate=rate,
            trunk_rate=trunk_rate,
            warmup=warmup,
            clip_norm=clip_norm,
            ema=ema,
            loss=loss,
            vgg=vgg,
            terms=terms,
            whole=whole,
            differences=differences,
            slope=slope,
            bfloat16=not float32,
            compile=compile,
            device=device,
            workers=workers,
            seed=seed,
            checkpoint_minutes=validate_minutes,
            validate_minutes=validate_minutes,
            sampler=SamplerConfig(crop=crop, sets=sets, drop_frames=drop_frames, pseudo=pseudo),
        )
    read = [("clip", path) for path in sorted(clips.glob("*.safetensors"))]
    read += [(what, Path(path)) for what, path in (("init", init), ("vgg", vgg)) if path and Path(path).is_file()]
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

    train_network(
        clips,
        output,
        config,
        preset=preset,
        init=init,
        window=window,
        validation=[name for item in validation or () for name in item.split(",")],
        threads=threads,
        resume=resume,
        log=log,
    )
    if writer is not None:
        writer.close()
    LOG.info(f"wrote {output}")
