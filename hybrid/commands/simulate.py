"""`ravg simulate`: make shots with Cycles."""

from __future__ import annotations

import sys
from collections.abc import Sequence
from dataclasses import replace
from pathlib import Path
from typing import Annotated, Any

import typer

from hybrid.simulate.run import missing, parse_center, parse_frames, parse_numbers, parse_size, shots_of, simulate
from hybrid.simulate.shot import FIXED, RANDOM, ShotSettings


def simulate_command(
    scene: Annotated[str, typer.Argument(help="A .blend file, random, hard, validation, test, or one as test:NAME.")],
    out: Annotated[Path, typer.Option("-o", "--out", help="Folder for the frames and meta.json.")],
    frames: Annotated[str, typer.Option(help="How many, or FIRST-LAST.")] = "7",
    size: Annotated[str, typer.Option(help="Of what is rendered, WxH.")] = "320x180",
    film: Annotated[str | None, typer.Option(help="Of the whole camera, WxH; what is rendered is a crop.")] = None,
    center: Annotated[str | None, typer.Option(help="Of the crop, as fractions X,Y with y down.")] = None,
    spp: Annotated[str, typer.Option(help="Samples per pixel, n; as LOW-HIGH drawn for each shot.")] = "16",
    levels: Annotated[str, typer.Option(help="Noise levels, such as n,n/e,4 or noisy=n.")] = "n,n/e,4",
    reference: Annotated[int, typer.Option(help="Samples per pixel of a reference; 0: none.")] = 0,
    reference_frames: Annotated[str | None, typer.Option(help="Of these frames only, such as 1,4,7.")] = None,
    seed: Annotated[int, typer.Option(help="All that is random comes from it.")] = 1,
    shots: Annotated[int, typer.Option(help="How many shots, with seeds that count up.")] = 1,
    camera: Annotated[str | None, typer.Option(help="Which of the file's cameras, or random.")] = None,
    motion: Annotated[str, typer.Option(help="auto: add motion to a file that has none; keep; add.")] = "auto",
    movers: Annotated[int | None, typer.Option(help="How many moving things to add, with added motion.")] = None,
    motion_blur: Annotated[bool, typer.Option("--motion-blur", help="Blur what moves.")] = False,
    halves: Annotated[bool, typer.Option("--halves", help="Half buffers, for the variance.")] = False,
    effects: Annotated[str, typer.Option(help="auto: what the scene calls for; all: everything.")] = "auto",
    jobs: Annotated[int, typer.Option(help="Blender processes at a time.")] = 1,
    threads: Annotated[int | None, typer.Option(help="Of each; by default the cores are shared out.")] = None,
    python: Annotated[str | None, typer.Option(help="A Python that has bpy, if this one has not.")] = None,
) -> None:
    """Make shots with Cycles: noise levels, guides, motion vectors, references; only the effects a scene calls for."""
    known = [*RANDOM, *FIXED, *(f"{kind}:{name}" for kind, names in FIXED.items() for name in names)]
    if scene not in known and not Path(scene).is_file():
        raise FileNotFoundError(f"scene: no file {scene}; expected a .blend file or one of {', '.join(known)}")
    if jobs < 1:
        raise ValueError(f"jobs: got {jobs}, expected at least 1")
    first = ShotSettings(
        scene=scene,
        seed=seed,
        frames=parse_frames(frames),
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
    # Half buffers last: they ask for levels of two samples, and the levels are only now read.
    asked = [(replace(shot, halves=halves), out) for shot, out in shots_of(scene, out, shots, spp, levels, first)]
    _run_with_progress(asked, jobs, threads, python)


def _run_with_progress(
    shots: Sequence[tuple[ShotSettings, Path]], jobs: int, threads: int | None, python: str | None
) -> None:
    from rich.console import Console
    from rich.progress import (
        BarColumn,
        MofNCompleteColumn,
        Progress,
        TextColumn,
        TimeElapsedColumn,
        TimeRemainingColumn,
    )

    console = Console(stderr=True)
    # The bar counts samples, not frames: they tell the time that is left whatever the levels.
    total = sum(missing(shot, out, frame) for shot, out in shots for frame in shot.frames)
    pictures = sum(len(shot.pictures(frame)) for shot, _ in shots for frame in shot.frames)
    if total == 0:
        console.print(f"all {pictures} pictures are there")
        return
    columns = (TextColumn("{task.description}"), BarColumn(), MofNCompleteColumn(), TextColumn("spp·frames"))
    with Progress(*columns, TimeElapsedColumn(), TimeRemainingColumn(), console=console) as progress:
        bar = progress.add_task("rendering", total=total)

        def show(kind: str, out: Path, message: dict[str, Any]) -> None:
            if kind == "frame":
                progress.update(bar, advance=message["samples"], description=f"{out.name}/{message['file']}")
                return
            plan = message["plan"]
            console.print(f"{out}: {_one_line(plan['description'])}", markup=False, highlight=False)
            if len(shots) == 1:
                for line in plan["printed"]:
                    console.print(f"  {line}", markup=False, highlight=False)

        simulate(shots, jobs=jobs, threads=threads, python=python, on_event=show)


def _one_line(description: dict[str, Any]) -> str:
    return ", ".join(f"{key} {value}" for key, value in description.items() if value not in ([], {}, "still"))


def main() -> None:
    """Run the command by itself: `python -m hybrid.commands.simulate`."""
    application = typer.Typer(pretty_exceptions_enable=False)
    application.command()(simulate_command)
    try:
        application()
    except (ValueError, OSError) as error:
        sys.stderr.write(f"error: {error}\n")
        raise SystemExit(1) from None


if __name__ == "__main__":
    main()
