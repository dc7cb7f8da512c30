"""What the commands share: options, and how an input is opened and planned."""

from __future__ import annotations

from collections.abc import Sequence
from pathlib import Path
from typing import TYPE_CHECKING, Annotated, TypeVar

import typer

if TYPE_CHECKING:  # the commands import what they need: `ravg --help` must not wait for OpenCV and numba
    from hybrid.files.frames import Shot
    from hybrid.plan import Plan

Thing = TypeVar("Thing")

ShotArgument = Annotated[str, typer.Argument(metavar="SHOT", help="shot.####.exr, shot.%04d.exr, a folder, or a file")]
OutputOption = Annotated[str, typer.Option("-o", "--output", metavar="OUT", help="OUT.####.exr, or a folder")]
FramesOption = Annotated[str | None, typer.Option("--frames", metavar="RANGE", help="such as 1001-1010x2")]
LayerOption = Annotated[
    list[str] | None,
    typer.Option(
        "--layer",
        metavar="ROLE=LAYER",
        help="take a layer for color, albedo, normal, depth, motion, variance, half_a, half_b, estimate",
    ),
]
ProfileOption = Annotated[
    str | None,
    typer.Option(
        metavar="NAME|FILE",
        help="whose names and conventions to take: a renderer, or a TOML file (docs/renderers.md); else found",
    ),
]
MotionOption = Annotated[
    str | None,
    typer.Option(
        metavar="WORDS",
        help="what vectors mean, such as next,ndc,y-up,scale=2 (docs/renderers.md); auto: measured, none: not used; "
        "else as the renderer writes them",
    ),
]
PreviewOption = Annotated[
    Path | None,
    typer.Option(
        help="to look at: a .png of the middle frame, noisy and denoised, or a .mp4 or .webp of all as they play"
    ),
]
RateOption = Annotated[float, typer.Option("--fps", min=1, max=240, help="frames per second of a preview that plays")]
SheetOption = Annotated[
    Path | None, typer.Option("--contact", metavar="PNG", help="a sheet of frames from all over the shot")
]
OnOption = Annotated[
    list[str] | None, typer.Option("--stages", "--effects", metavar="NAME", help="run a stage, whatever the plan says")
]
OffOption = Annotated[
    list[str] | None, typer.Option("--no-stages", "--no-effects", metavar="NAME", help="do not run a stage")
]
EstimateOption = Annotated[
    str,
    typer.Option(
        metavar="SOURCE",
        help="denoised single frames to make stable: auto (in the file, else OIDN if installed, else our own), oidn, "
        "oidn-fast, oidn-clean, oidn-best, nlm (our own), none, or a finished sequence, OTHER.####.exr",
    ),
]
KeepOption = Annotated[
    str | None, typer.Option("--keep-estimates", metavar="OUT", help="keep OIDN's pictures, and take them from there")
]
ResumeOption = Annotated[
    bool, typer.Option("--resume", help="leave frames alone that an earlier run with these options has finished")
]
MemoryOption = Annotated[
    str | None, typer.Option(metavar="SIZE", help="such as 8G; frames are then worked on a part at a time")
]
PixelsOption = Annotated[
    int | None, typer.Option(metavar="N", help="refuse files that claim more pixels than this; 2^28 without")
]
AovOption = Annotated[
    list[str] | None, typer.Option("--aov", metavar="LAYER", help="filter this layer with the same kernels")
]


def import_neural():  # type: ignore[no-untyped-def]
    """The boundary to torch, or a clear word on how to get it."""
    try:
        from hybrid import neural
    except ModuleNotFoundError as error:
        if error.name not in ("torch", "safetensors"):
            raise
        raise ValueError(
            f"{error.name} is not installed; expected: pip install 'ravg[neural]' (`ravg pseudoref` works without)"
        ) from None
    return neural


def open_input(
    shot: str,
    frames: str | None,
    layer: Sequence[str] | None,
    aovs: Sequence[str] | None = None,
    *,
    profile: str | None = None,
    motion: str | None = None,
    max_pixels: int | None = None,
) -> Shot:
    from hybrid.files.exr import MAX_PIXELS
    from hybrid.files.frames import open_shot
    from hybrid.files.profile import open_profile, parse_motion

    try:
        if motion not in (None, "auto", "none"):
            parse_motion(motion or "")
        chosen = None if profile is None else open_profile(profile)
    except ValueError as error:
        raise typer.BadParameter(f"--{error}") from None

    overrides = {}
    for item in layer or ():
        role, separator, name = item.partition("=")
        if not separator:
            raise typer.BadParameter(f"--layer is {item!r}, expected ROLE=LAYER")
        overrides[role] = name
    # keep=0: whoever aligns a window keeps what he has made of a frame, not the frame.
    opened = open_shot(
        shot,
        frames=frames,
        layers=overrides,
        profile=chosen,
        motion=motion,
        aovs=tuple(aovs or ()),
        keep=0,
        max_pixels=MAX_PIXELS if max_pixels is None else max_pixels,
    )
    for warning in opened.warnings:
        typer.echo(f"warning: {warning}", err=True)
    return opened


def plan_input(shot: Shot, on: Sequence[str] | None, off: Sequence[str] | None) -> Plan:
    from hybrid.plan import plan_shot

    return plan_shot(shot).force(split_names(on), split_names(off))


def split_names(names: Sequence[str] | None) -> list[str]:
    """Names may be given one by one or separated by commas."""
    return [name for item in names or () for name in item.split(",")]


def choose(table: dict[str, Thing], name: str, option: str) -> Thing:
    if name not in table:
        raise typer.BadParameter(f"--{option} is {name!r}, expected one of {', '.join(table)}")
    return table[name]


def printable(words: str) -> str:
    """What a terminal shows as it is: a name from a file may hold sequences that command it."""
    return "".join(c if c.isprintable() else c.encode("unicode_escape").decode("ascii") for c in words)
