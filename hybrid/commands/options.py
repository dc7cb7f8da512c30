"""Options that several commands share. Importing this module loads neither numpy nor rich."""

import inspect
import math
import re
from collections.abc import Callable, Iterator
from contextlib import contextmanager
from dataclasses import dataclass, fields
from pathlib import Path
from typing import Annotated, Any, Literal, TypeVar, get_type_hints

import typer

Thing = TypeVar("Thing")


def panel(title: str) -> Callable[..., Any]:
    """Return a function that makes an option of a panel of the help, from its help text and its names."""

    def option(text: str, *names: str, **settings: Any) -> Any:
        return typer.Option(*names, help=text, rich_help_panel=title, **settings)

    return option


of_input, of_method = panel("Input"), panel("Method")
of_output, of_resources = panel("Output"), panel("Resources")


def with_fields(*configs: type, title: str) -> Callable[[Callable[..., None]], Callable[..., None]]:
    """Give a command an option for each field of dataclasses that has a help text; it gets their values by keyword.

    Such a field is ``Annotated[type, help, {…}]``: the panel if not `title`, names if not the field's, other settings;
    or it has an option as its type.
    """

    def add(command: Callable[..., None]) -> Callable[..., None]:
        signature = inspect.signature(command, eval_str=True)
        parameters = [p for p in signature.parameters.values() if p.kind is not inspect.Parameter.VAR_KEYWORD]
        for config in configs:
            hints = get_type_hints(config, include_extras=True)
            for item in fields(config):
                text, *rest = getattr(hints[item.name], "__metadata__", (None,))
                if text is None:
                    continue
                annotation = hints[item.name]
                if isinstance(text, str):
                    settings = {"show_default": item.default != "", **dict(*rest)}
                    names = settings.pop("names", (f"--{item.name.replace('_', '-')}",))
                    option = panel(settings.pop("panel", title))(text, *names, **settings)
                    annotation = Annotated[annotation.__origin__, option]
                kind = inspect.Parameter.KEYWORD_ONLY
                parameters.append(inspect.Parameter(item.name, kind, default=item.default, annotation=annotation))
        command.__signature__ = signature.replace(parameters=parameters)  # type: ignore[attr-defined]
        return command

    return add


def take(config: type, settings: dict[str, Any]) -> dict[str, Any]:
    """Remove the values of a dataclass's fields from a command's settings, and return them."""
    return {item.name: settings.pop(item.name) for item in fields(config) if item.name in settings}


# Stages in the order of `hybrid.plan.STAGES`, which this module cannot import: a test compares them.
STAGE_NAMES = (
    "fireflies, demodulate, outliers, warp, dense-flow, refine, gate, drift, fixed-noise, prefilter, stabilize, "
    "restore-mean, blend-samples, alpha, skip"
)

Device = Literal["auto", "cpu", "cuda", "hip", "sycl", "metal"]
DeviceOption = Annotated[
    Device,
    of_resources(
        "device for ravg's networks and OIDN's; auto: the first available of cuda, hip, sycl, cpu",
        "--device",
        envvar="RAVG_DEVICE",
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
    of_output(
        "denoised frames: OUT.####.exr, or a folder, which keeps the names of the input",
        "-o",
        "--output",
        metavar="OUT",
        callback=_check_output,
    ),
]
FramesOption = Annotated[
    str | None,
    of_input(
        "frames to use, such as 1001-1010, or 1001-1010x2 for every second one (default: all)",
        "--frames",
        metavar="RANGE",
    ),
]
LayerOption = Annotated[
    list[str] | None,
    of_input(
        "use a layer as color, albedo, normal, depth, motion, variance, half_a, half_b or estimate; or the layer of "
        "another sequence: albedo=path/alb.####.exr, with :LAYER if that has several; repeatable (default: by the "
        "names of the renderer)",
        "--layer",
        metavar="ROLE=LAYER",
    ),
]
ProfileOption = Annotated[
    str | None,
    of_input(
        "renderer whose layer names and conventions apply, or a TOML file (docs/renderers.md; default: detect)",
        metavar="NAME|FILE",
        envvar="RAVG_PROFILE",
    ),
]
MotionOption = Annotated[
    str | None,
    of_input(
        "motion-vector convention, such as next,ndc,y-up,scale=2 (docs/renderers.md); auto: detect; none: ignore "
        "the vectors (default: the renderer's)",
        metavar="WORDS",
    ),
]
StrictOption = Annotated[
    bool,
    of_input("stop at implausible layers and at cuts (default: warn, and leave such layers out)", "--strict"),
]


@dataclass(frozen=True, kw_only=True)
class ReadOptions:
    """The options that say how a shot is read."""

    frames: FramesOption = None
    layer: LayerOption = None
    profile: ProfileOption = None
    motion: MotionOption = None
    strict: StrictOption = False


AS_IT_IS = ReadOptions()
PreviewOption = Annotated[
    Path | None,
    of_output("noisy against denoised: a .png of the middle frame, or a .mp4 or .webp of all frames", metavar="FILE"),
]
RateOption = Annotated[float, of_output("frames per second at which movies and pages play", "--fps", min=1, max=240)]
SheetOption = Annotated[
    Path | None, of_output("one image of frames from all over the shot", "--contact-sheet", metavar="PNG")
]
OnOption = Annotated[
    list[str] | None,
    of_method(f"stages to force on, with commas between: {STAGE_NAMES}", "--stages", metavar="NAMES"),
]
OffOption = Annotated[list[str] | None, of_method("stages to force off, as --stages", "--no-stages", metavar="NAMES")]
PixelsOption = Annotated[
    int | None,
    of_resources(
        "refuse images with more pixels (default: 2^28, about 16384x16384)",
        metavar="N",
        min=1,
        envvar="RAVG_MAX_PIXELS",
    ),
]
AovOption = Annotated[
    list[str] | None,
    of_method(
        "denoise this layer too; all: every light pass and light group; repeatable",
        "--aov",
        metavar="LAYER",
    ),
]


def check_first_pass(spec: str) -> str:
    """Refuse a first pass as `hybrid.job.check_first_pass`."""
    from hybrid.job import check_first_pass as check

    with usage():
        check(spec)
    return spec


def choose(table: dict[str, Thing], name: str, option: str) -> Thing:
    """Return an entry of a table; BadParameter with its keys where there is none."""
    if name not in table:
        raise typer.BadParameter(f"--{option} is {name!r}, expected one of {', '.join(table)}")
    return table[name]


def split_number(item: str) -> tuple[str, float | None]:
    """Split NAME=NUMBER at the last "="; None in place of what is no number above 0."""
    name, _, text = item.rpartition("=")
    try:
        number = float(text)
    except ValueError:
        number = math.nan
    return name, number if 0 < number < math.inf else None


@contextmanager
def usage() -> Iterator[None]:
    """Turn ValueError about an option into bad usage, exit code 2."""
    try:
        yield
    except ValueError as error:
        raise typer.BadParameter(str(error)) from None
