"""`ravg simulate`: render shots with Cycles."""

from __future__ import annotations

from collections.abc import Sequence
from pathlib import Path
from typing import Annotated, Any, Literal

import typer

from hybrid.commands.cluster import Chunk, SchedulerOption, arguments_of, run_on_cluster
from hybrid.commands.log import LOG, Progress
from hybrid.commands.options import INPUT, OUTPUT, RESOURCES, WHAT, usage
from hybrid.simulate.run import parse_center, parse_numbers, parse_size, read_meta, samples_left, shots_of
from hybrid.simulate.run import simulate as render
from hybrid.simulate.shot import FIXED, RANDOM, ShotSettings, parse_levels, parse_samples


def simulate(
    context: typer.Context,
    scene: Annotated[
        str, typer.Argument(metavar="SCENE", help="a .blend file, random, hard, validation, test, or one as test:NAME")
    ],
    output: Annotated[
        Path,
        typer.Option(
            "-o",
            "--output",
            "--out",
            metavar="OUT",
            help="folder for the frames and meta.json",
            rich_help_panel=OUTPUT,
        ),
    ],
    frames: Annotated[
        str, typer.Option("--frames", metavar="RANGE", help="such as 1001-1010x2", rich_help_panel=INPUT)
    ] = "1-7",
    size: Annotated[
        str, typer.Option(metavar="WxH", help="pixels of the rendered image", rich_help_panel=WHAT)
    ] = "320x180",
    film: Annotated[
        str | None,
        typer.Option(metavar="WxH", help="pixels of the whole camera, of which --size is a crop", rich_help_panel=WHAT),
    ] = None,
    center: Annotated[
        str | None,
        typer.Option(metavar="X,Y", help="center of the crop in the film, as fractions, y down", rich_help_panel=WHAT),
    ] = None,
    spp: Annotated[
        str,
        typer.Option(metavar="N", help="samples per pixel, n; LOW-HIGH: drawn for each shot", rich_help_panel=WHAT),
    ] = "16",
    levels: Annotated[
        str, typer.Option(help="noise levels, such as n,n/e,4 or noisy=n", rich_help_panel=WHAT)
    ] = "n,n/e,4",
    reference: Annotated[
        int,
        typer.Option(min=0, metavar="SPP", help="samples per pixel of a reference; 0: none", rich_help_panel=WHAT),
    ] = 0,
    reference_frames: Annotated[
        str | None,
        typer.Option(
            metavar="NUMBERS", help="frames with a reference, such as 1,4,7; default: all", rich_help_panel=WHAT
        ),
    ] = None,
    seed: Annotated[int, typer.Option(help="seed of all random numbers", rich_help_panel=INPUT)] = 1,
    shots: Annotated[
        int, typer.Option(min=1, metavar="N", help="number of shots, with seeds that count up", rich_help_panel=INPUT)
    ] = 1,
    camera: Annotated[str | None, typer.Option(help="a camera of the file, or random", rich_help_panel=INPUT)] = None,
    motion: Annotated[
        Literal["auto", "keep", "add"],
        typer.Option("--animate", help="auto: add motion to a file that has none", rich_help_panel=WHAT),
    ] = "auto",
    moving_objects: Annotated[
        int | None,
        typer.Option(min=0, metavar="N", help="number of moving objects in added motion", rich_help_panel=WHAT),
    ] = None,
    motion_blur: Annotated[
        bool, typer.Option("--motion-blur", help="render with motion blur", rich_help_panel=WHAT)
    ] = False,
    halves: Annotated[
        bool, typer.Option("--halves", help="add half buffers, for the variance", rich_help_panel=WHAT)
    ] = False,
    effects: Annotated[
        Literal["auto", "all"],
        typer.Option(help="auto: the effects that the scene needs; all: every effect", rich_help_panel=WHAT),
    ] = "auto",
    jobs: Annotated[
        int, typer.Option(min=1, metavar="N", help="Blender processes at a time", rich_help_panel=RESOURCES)
    ] = 1,
    threads: Annotated[
        int | None,
        typer.Option(
            min=1,
            metavar="N",
            envvar="RAVG_THREADS",
            help="threads of each process; default: the cores divided by --jobs",
            rich_help_panel=RESOURCES,
        ),
    ] = None,
    python: Annotated[
        str | None,
        typer.Option(
            metavar="FILE",
            envvar="RAVG_BLENDER_PYTHON",
            help="Python interpreter with bpy; default: this one",
            rich_help_panel=RESOURCES,
        ),
    ] = None,
    scheduler: SchedulerOption = None,
) -> None:
    """Render shots with Cycles: noise levels, guides, motion vectors, references; with the effects a scene needs."""
    from hybrid.files.sequences import parse_frames

    known = [*RANDOM, *FIXED, *(f"{kind}:{name}" for kind, names in FIXED.items() for name in names)]
    if scene not in known and not Path(scene).is_file():
        raise FileNotFoundError(f"scene: no file {scene}; expected a .blend file or one of {', '.join(known)}")

    def settings(scene: str, seed: int) -> ShotSettings:
        return ShotSettings(
            scene=scene,
            seed=seed,
            frames=tuple(parse_frames(frames)),
            size=parse_size(size, "size"),
            levels=parse_levels(levels, parse_samples(spp, seed)),
            reference=reference,
            reference_frames=parse_numbers(reference_frames) if reference_frames else None,
            film=parse_size(film, "film") if film else None,
            center=parse_center(center) if center else None,
            camera=camera,
            motion=motion,
            moving_objects=moving_objects,
            motion_blur=motion_blur,
            halves=halves,
            effects=effects,
        )

    with usage():
        asked = shots_of(scene, output, seed, shots, settings)
    for shot, folder in asked:
        read_meta(shot, folder)  # finished renders of another shot do not count
    if scheduler is None:
        _render(asked, jobs, threads, python)
        return
    chunks = {}
    for shot, folder in asked:
        samples = sum(samples_left(shot, folder, frame) for frame in shot.frames)
        if samples:
            changes = {"scene": shot.scene, "seed": shot.seed, "shots": 1, "output": folder}
            chunks[folder.name] = Chunk(arguments_of(context, changes), samples)
    run_on_cluster(scheduler, "rendering", chunks, "spp·frames")


def _render(shots: Sequence[tuple[ShotSettings, Path]], jobs: int, threads: int | None, python: str | None) -> None:
    """Render shots, and show progress in samples, which predict the remaining time whatever the levels."""
    total = sum(samples_left(shot, out, frame) for shot, out in shots for frame in shot.frames)
    if total == 0:
        renders = sum(len(shot.renders(frame)) for shot, _ in shots for frame in shot.frames)
        LOG.info(f"all {renders} renders exist")
        return
    bar = Progress("rendering", total, "spp·frames")

    def show(kind: str, out: Path, message: dict[str, Any]) -> None:
        if kind == "frame":
            bar.advance(message["samples"], f"{out.name}/{message['file']}")
            return
        plan = message["plan"]
        found = [f"{key} {value}" for key, value in plan["description"].items() if value not in ([], {}, "still")]
        LOG.info(f"{out}: {', '.join(found)}")
        for line in plan["printed"] if len(shots) == 1 else ():
            LOG.info(f"  {line}")

    render(shots, jobs=jobs, threads=threads, python=python, on_event=show)
