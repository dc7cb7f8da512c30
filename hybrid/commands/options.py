"""Options that several commands share. Importing this module loads neither numpy nor rich."""

from __future__ import annotations

import re
from collections.abc import Iterator, Sequence
from contextlib import contextmanager
from pathlib import Path
from typing import Annotated, Literal, TypeVar

import typer

Thing = TypeVar("Thing")

# Groups of options in the help.
INPUT, WHAT, OUTPUT, RESOURCES = "Input", "What to run", "Output", "Resources"

Device = Literal["auto", "cpu", "cuda", "hip", "sycl", "metal"]
DeviceOption = Annotated[
    Device,
    typer.Option(
        "--device",
        envvar="RAVG_DEVICE",
        help="device for ravg's networks and OIDN's; auto: the first available of cuda, hip, sycl, cpu",
        rich_help_panel=RESOURCES,
    ),
]

# Suffixes of images and movies that no folder has: an output named so asks for a format that is not written.
_OTHER_KINDS = re.compile(r"\.(avi|bmp|dpx|gif|hdr|jpe?g|mkv|mov|mp4|pfm|png|tga|tiff?|webp)", re.IGNORECASE)


def _check_output(output: str) -> str:
    """Refuse a name that is neither a sequence of EXR files nor a folder."""
    if not output.strip():
        raise typer.BadParameter("it is empty, expected OUT.####.exr, or a folder")
    if _OTHER_KINDS.fullmatch(Path(output).suffix) and not Path(output).is_dir():
        raise typer.BadParameter(f"it is {output!r}, expected OUT.####.exr, or a folder: frames are written as OpenEXR")
    return output


ShotArgument = Annotated[
    str, typer.Argument(metavar="SHOT", help="noisy frames: shot.####.exr, shot.%04d.exr, a folder, or a file")
]
OutputOption = Annotated[
    str,
    typer.Option(
        "-o",
        "--output",
        metavar="OUT",
        callback=_check_output,
        help="denoised frames: OUT.####.exr, or a folder, which keeps the names of the input",
        rich_help_panel=OUTPUT,
    ),
]
FramesOption = Annotated[
    str | None,
    typer.Option("--frames", metavar="RANGE", help="frames, such as 1001-1010x2 (default: all)", rich_help_panel=INPUT),
]
LayerOption = Annotated[
    list[str] | None,
    typer.Option(
        "--layer",
        metavar="ROLE=LAYER",
        help="use a layer as color, albedo, normal, depth, motion, variance, half_a, half_b or estimate; or the layer "
        "of another sequence: albedo=path/alb.####.exr, with :LAYER if that has several; repeatable "
        "(default: by the names of the renderer)",
        rich_help_panel=INPUT,
    ),
]
ProfileOption = Annotated[
    str | None,
    typer.Option(
        metavar="NAME|FILE",
        envvar="RAVG_PROFILE",
        help="renderer whose layer names and conventions apply, or a TOML file (docs/renderers.md; default: detect)",
        rich_help_panel=INPUT,
    ),
]
MotionOption = Annotated[
    str | None,
    typer.Option(
        metavar="WORDS",
        help="motion-vector convention, such as next,ndc,y-up,scale=2 (docs/renderers.md); auto: detect; none: ignore "
        "the vectors (default: the renderer's)",
        rich_help_panel=INPUT,
    ),
]
StrictOption = Annotated[
    bool,
    typer.Option(
        "--strict",
        help="stop at layers that make no sense and at cuts (default: leave such layers out, and warn)",
        rich_help_panel=INPUT,
    ),
]
PreviewOption = Annotated[
    Path | None,
    typer.Option(
        metavar="FILE",
        help="noisy against denoised: a .png of the middle frame, or a .mp4 or .webp of all frames",
        rich_help_panel=OUTPUT,
    ),
]
RateOption = Annotated[
    float,
    typer.Option("--fps", min=1, max=240, help="frames per second of movies and players", rich_help_panel=OUTPUT),
]
SheetOption = Annotated[
    Path | None,
    typer.Option(
        "--contact-sheet", metavar="PNG", help="one image of frames from all over the shot", rich_help_panel=OUTPUT
    ),
]
OnOption = Annotated[
    list[str] | None,
    typer.Option(
        "--stages", metavar="NAME", help="stages to run, whatever was measured; see ravg inspect", rich_help_panel=WHAT
    ),
]
OffOption = Annotated[
    list[str] | None,
    typer.Option("--no-stages", metavar="NAME", help="stages not to run", rich_help_panel=WHAT),
]
FirstPassOption = Annotated[
    str | None,
    typer.Option(
        "--first-pass",
        metavar="SOURCE",
        help="denoised image per frame to start from: auto (layer of the file, else OIDN if installed, else bundled), "
        "oidn, oidn-fast, oidn-clean, oidn-best, bundled (network that ships with ravg), nlm (classical), none, or a "
        "finished sequence, OTHER.####.exr (default: auto; with --method classical: none, with pooled: oidn-fast)",
        rich_help_panel=WHAT,
    ),
]
KeepOption = Annotated[
    str | None,
    typer.Option(
        "--keep-first-pass",
        metavar="OUT",
        help="keep OIDN's first pass in this sequence or folder, and read it from there if it is the same",
        rich_help_panel=OUTPUT,
    ),
]
ResumeOption = Annotated[
    bool,
    typer.Option(
        "--resume",
        help="skip frames that an earlier run with the same options has finished",
        rich_help_panel=OUTPUT,
    ),
]
KeepGoingOption = Annotated[
    bool,
    typer.Option(
        "--keep-going",
        envvar="RAVG_KEEP_GOING",
        help="continue after a failed frame, and exit with 1 at the end (default: stop at the first failure)",
        rich_help_panel=OUTPUT,
    ),
]
MemoryOption = Annotated[
    str | None,
    typer.Option(
        metavar="SIZE",
        envvar="RAVG_MAX_MEMORY",
        help="limit, such as 8G: frames are denoised in bands of rows (default: whole frames)",
        rich_help_panel=RESOURCES,
    ),
]
PixelsOption = Annotated[
    int | None,
    typer.Option(
        metavar="N",
        min=1,
        envvar="RAVG_MAX_PIXELS",
        help="refuse files that claim more pixels (default: 2^28)",
        rich_help_panel=RESOURCES,
    ),
]
AovOption = Annotated[
    list[str] | None,
    typer.Option(
        "--aov",
        metavar="LAYER",
        help="denoise this layer too; all: every layer whose name is known for a part of the light; repeatable",
        rich_help_panel=WHAT,
    ),
]


def check_first_pass(spec: str) -> str:
    """Refuse a first pass as `hybrid.job.check_first_pass`."""
    from hybrid.job import check_first_pass as check

    with usage():
        check(spec)
    return spec


def split_names(names: Sequence[str] | None) -> list[str]:
    """Split names that are given one by one or separated by commas."""
    return [name for item in names or () for name in item.split(",")]


def choose(table: dict[str, Thing], name: str, option: str) -> Thing:
    """Return an entry of a table; BadParameter with its keys where there is none."""
    if name not in table:
        raise typer.BadParameter(f"--{option} is {name!r}, expected one of {', '.join(table)}")
    return table[name]


@contextmanager
def usage() -> Iterator[None]:
    """Turn ValueError about an option into bad usage, exit code 2."""
    try:
        yield
    except ValueError as error:
        raise typer.BadParameter(str(error)) from None
