"""`ravg simulate`: make shots with Cycles."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import replace
from pathlib import Path
from typing import Annotated, Any, Literal

import typer

from hybrid.commands.cluster import Chunk, SchedulerOption, arguments_of, run_on_cluster
from hybrid.commands.log import LOG, Progress
from hybrid.commands.options import INPUT, OUTPUT, RESOURCES, WHAT, usage
from hybrid.simulate.run import missing, parse_center, parse_numbers, parse_size, read_meta, shots_of
from hybrid.simulate.run import simulate as render
from hybrid.simulate.shot import FIXED, RANDOM, ShotSettings


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
    size: Annotated[str, typer.Option(metavar="WxH", help="of what is rendered", rich_help_panel=WHAT)] = "320x180",
    film: Annotated[
        str | None,
        typer.Option(metavar="WxH", help="of the whole camera; what is rendered is a crop of it", rich_help_panel=WHAT),
    ] = None,
    center: Annotated[
        str | None,
        typer.Option(metavar="X,Y", help="of the crop, as fractions, y down", rich_help_panel=WHAT),
    ] = None,
    spp: Annotated[
        str,
        typer.Option(metavar="N", help="samples per pixel, n; as LOW-HIGH drawn for each shot", rich_help_panel=WHAT),
    ] = "16",
    levels: Annotated[
        str, typer.Option(help="noise levels, such as n,n/e,4 or noisy=n", rich_help_panel=WHAT)
    ] = "n,n/e,4",
    reference: Annotated[
        int,
        typer.Option(min=0, metavar="SPP", help="samples per pixel of a reference; 0: none", rich_help_panel=WHAT),
    ] = 0,
    reference_frames: Annotated[
        str | None, typer.Option(metavar="NUMBERS", help="of these alone, such as 1,4,7", rich_help_panel=WHAT)
    ] = None,
    seed: Annotated[int, typer.Option(help="all that is random comes from it", rich_help_panel=INPUT)] = 1,
    shots: Annotated[
        int, typer.Option(min=1, metavar="N", help="how many, with seeds that count up", rich_help_panel=INPUT)
    ] = 1,
    camera: Annotated[
        str | None, typer.Option(help="which of the file's cameras, or random", rich_help_panel=INPUT)
    ] = None,
    motion: Annotated[
        Literal["auto", "keep", "add"],
        typer.Option("--animate", help="auto: add motion to a file that has none", rich_help_panel=WHAT),
    ] = "auto",
    movers: Annotated[
        int | None,
        typer.Option(min=0, metavar="N", help="how many moving things to add, with added motion", rich_help_panel=WHAT),
    ] = None,
    motion_blur: Annotated[bool, typer.Option("--motion-blur", help="blur what moves", rich_help_panel=WHAT)] = False,
    halves: Annotated[
        bool, typer.Option("--halves", help="half buffers, for the variance", rich_help_panel=WHAT)
    ] = False,
    effects: Annotated[
        Literal["auto", "all"],
        typer.Option(help="auto: what the scene calls for; all: everything", rich_help_panel=WHAT),
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
            help="of each; without, the cores are shared out",
            rich_help_panel=RESOURCES,
        ),
    ] = None,
    python: Annotated[
        str | None,
        typer.Option(
            metavar="FILE",
            envvar="RAVG_BLENDER_PYTHON",
            help="an interpreter that has bpy, if this one has not",
            rich_help_panel=RESOURCES,
        ),
    ] = None,
    scheduler: SchedulerOption = None,
) -> None:
    """Make shots with Cycles: noise levels, guides, motion vectors, references; only the effects a scene calls for."""
    from hybrid.files.sequences import parse_frames

    known = [*RANDOM, *FIXED, *(f"{kind}:{name}" for kind, names in FIXED.items() for name in names)]
    if scene not in known and not Path(scene).is_file():
        raise FileNotFoundError(f"scene: no file {scene}; expected a .blend file or one of {', '.join(known)}")
    with usage():
        first = ShotSettings(
            scene=scene,
            seed=seed,
            frames=tuple(parse_frames(frames)),
            size=parse_size(size, "size"),
            levels={"noisy": 1},
            reference=reference,
            reference_frames=parse_numbers(reference_frames) if reference_frames else None,
            film=parse_size(film, "film") if film else None,
            center=parse_center(center) if center else None,
            camera=camera,
            motion=motion,
            movers=movers,
            motion_blur=motion_blur,
            halves=False,
            effects=effects,
        )
        several = shots_of(scene, output, shots, spp, levels, first)
        # Half buffers last: they ask for levels of two samples, and the levels are only now read.
        asked = [(replace(shot, halves=halves), folder) for shot, folder in several]
    for shot, folder in asked:
        read_meta(shot, folder)  # pictures of another shot are not those that are asked for
    if scheduler is not None:
        chunks = {}
        for shot, folder in asked:
            own = {"scene": shot.scene, "seed": shot.seed, "shots": 1, "output": folder}
            samples = sum(missing(shot, folder, frame) for frame in shot.frames)
            if samples:
                chunks[folder.name] = Chunk(arguments_of(context, own), samples)
        run_on_cluster(scheduler, "rendering", chunks, "spp·frames")
        return
    _run_with_progress(asked, jobs, threads, python)


def _run_with_progress(
    shots: Sequence[tuple[ShotSettings, Path]], jobs: int, threads: int | None, python: str | None
) -> None:
    # The bar counts samples, not frames: they tell the time that is left whatever the levels.
    total = sum(missing(shot, out, frame) for shot, out in shots for frame in shot.frames)
    pictures = sum(len(shot.pictures(frame)) for shot, _ in shots for frame in shot.frames)
    if total == 0:
        LOG.info(f"all {pictures} pictures are there")
        return
    bar = Progress("rendering", total, "spp·frames")

    def show(kind: str, out: Path, message: dict[str, Any]) -> None:
        if kind == "frame":
            bar.advance(message["samples"], f"{out.name}/{message['file']}")
            return
        plan = message["plan"]
        LOG.info(f"{out}: {_one_line(plan['description'])}")
        if len(shots) == 1:
            for line in plan["printed"]:
                LOG.info(f"  {line}")

    render(shots, jobs=jobs, threads=threads, python=python, on_event=show)


def _one_line(description: dict[str, Any]) -> str:
    return ", ".join(f"{key} {value}" for key, value in description.items() if value not in ([], {}, "still"))
