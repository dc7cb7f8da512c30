"""What the commands share: options, and how an input is opened and planned."""

from __future__ import annotations

import gc
import re
from collections.abc import Callable, Iterator, Mapping, Sequence
from contextlib import contextmanager
from dataclasses import replace
from pathlib import Path
from types import ModuleType
from typing import TYPE_CHECKING, Annotated, Literal, TypeVar

import typer

from hybrid.commands.log import LOG, printable

if TYPE_CHECKING:  # the commands import what they need: `ravg --help` must not wait for OpenCV and numba
    from hybrid.files.profile import Profile
    from hybrid.files.shots import Shot
    from hybrid.plan import Plan, Rules
    from hybrid.validation import Finding, ValidationReport

Thing = TypeVar("Thing")

# The groups of options in the help.
INPUT, WHAT, OUTPUT, RESOURCES = "Input", "What to run", "Output", "Resources"

Device = Literal["auto", "cpu", "cuda", "hip", "sycl", "metal"]
DeviceOption = Annotated[
    Device,
    typer.Option(
        "--device",
        envvar="RAVG_DEVICE",
        help="what computes networks, OIDN's and ravg's alike; auto: the first that is there of cuda, hip, sycl, cpu",
        rich_help_panel=RESOURCES,
    ),
]

# Of which every view has its own, where the shot has several.
_OF_A_VIEW = ("output", "keep_estimates", "estimate", "preview", "contact", "breakdown")

# What a folder is not called: somebody wants pictures of a kind that is not written.
_OTHER_KINDS = re.compile(r"\.(avi|bmp|dpx|gif|hdr|jpe?g|mkv|mov|mp4|pfm|png|tga|tiff?|webp)", re.IGNORECASE)


def _check_output(output: str) -> str:
    """Refuse what can be neither a sequence of EXR files nor a folder for one."""
    if not output.strip():
        raise typer.BadParameter("it is empty, expected OUT.####.exr, or a folder")
    if _OTHER_KINDS.fullmatch(Path(output).suffix) and not Path(output).is_dir():
        raise typer.BadParameter(f"it is {output!r}, expected OUT.####.exr, or a folder: frames are written as OpenEXR")
    return output


def _check_size(size: str | None) -> str | None:
    """Refuse what is no size, before anything is made."""
    from hybrid.memory import parse_size

    if size is not None:
        with usage():
            parse_size(size)
    return size


def check_estimate(spec: str) -> str:
    """Refuse a word that is neither a source nor the name of anything there is, before anything is made."""
    from hybrid.estimates import SPECS

    if spec not in SPECS and re.fullmatch(r"[\w-]*", spec) and not Path(spec).exists():
        raise typer.BadParameter(f"it is {spec!r}, expected one of {', '.join(SPECS)}, or OTHER.####.exr")
    return spec


ShotArgument = Annotated[str, typer.Argument(metavar="SHOT", help="shot.####.exr, shot.%04d.exr, a folder, or a file")]
OutputOption = Annotated[
    str,
    typer.Option(
        "-o",
        "--output",
        metavar="OUT",
        callback=_check_output,
        help="OUT.####.exr, or a folder",
        rich_help_panel=OUTPUT,
    ),
]
FramesOption = Annotated[
    str | None, typer.Option("--frames", metavar="RANGE", help="such as 1001-1010x2", rich_help_panel=INPUT)
]
LayerOption = Annotated[
    list[str] | None,
    typer.Option(
        "--layer",
        metavar="ROLE=LAYER",
        help="take a layer for color, albedo, normal, depth, motion, variance, half_a, half_b, estimate; or a sequence "
        "that holds it: albedo=path/alb.####.exr, with :LAYER where that has several",
        rich_help_panel=INPUT,
    ),
]
ProfileOption = Annotated[
    str | None,
    typer.Option(
        metavar="NAME|FILE",
        envvar="RAVG_PROFILE",
        help="whose names and conventions to take: a renderer, or a TOML file (docs/renderers.md); else found",
        rich_help_panel=INPUT,
    ),
]
MotionOption = Annotated[
    str | None,
    typer.Option(
        metavar="WORDS",
        help="what vectors mean, such as next,ndc,y-up,scale=2 (docs/renderers.md); auto: measured, none: not used; "
        "else as the renderer writes them",
        rich_help_panel=INPUT,
    ),
]
StrictOption = Annotated[
    bool,
    typer.Option(
        "--strict",
        help="stop with an error where a layer makes no sense, instead of leaving it out",
        rich_help_panel=INPUT,
    ),
]
PreviewOption = Annotated[
    Path | None,
    typer.Option(
        metavar="FILE",
        help="to look at: a .png of the middle frame, noisy and denoised, or a .mp4 or .webp of all as they play",
        rich_help_panel=OUTPUT,
    ),
]
RateOption = Annotated[
    float,
    typer.Option("--fps", min=1, max=240, help="frames per second of what plays", rich_help_panel=OUTPUT),
]
SheetOption = Annotated[
    Path | None,
    typer.Option("--contact", metavar="PNG", help="a sheet of frames from all over the shot", rich_help_panel=OUTPUT),
]
OnOption = Annotated[
    list[str] | None,
    typer.Option("--stages", metavar="NAME", help="run a stage, whatever the plan says", rich_help_panel=WHAT),
]
OffOption = Annotated[
    list[str] | None,
    typer.Option("--no-stages", metavar="NAME", help="do not run a stage", rich_help_panel=WHAT),
]
EstimateOption = Annotated[
    str,
    typer.Option(
        metavar="SOURCE",
        callback=check_estimate,
        help="denoised single frames to start from: auto (in the file, else OIDN if installed, else bundled), oidn, "
        "oidn-fast, oidn-clean, oidn-best, bundled (a network that comes with ravg), nlm (without one), none, "
        "or a finished sequence, OTHER.####.exr",
        rich_help_panel=WHAT,
    ),
]
KeepOption = Annotated[
    str | None,
    typer.Option(
        "--keep-estimates",
        metavar="OUT",
        help="keep OIDN's pictures, and take them from there",
        rich_help_panel=OUTPUT,
    ),
]
ResumeOption = Annotated[
    bool,
    typer.Option(
        "--resume",
        help="leave frames alone that an earlier run with these options has finished",
        rich_help_panel=OUTPUT,
    ),
]
KeepGoingOption = Annotated[
    bool,
    typer.Option(
        "--keep-going",
        envvar="RAVG_KEEP_GOING",
        help="make all frames that can be made, and end with 1 where one could not; else end at the first such frame",
        rich_help_panel=OUTPUT,
    ),
]
MemoryOption = Annotated[
    str | None,
    typer.Option(
        metavar="SIZE",
        callback=_check_size,
        envvar="RAVG_MAX_MEMORY",
        help="such as 8G; frames are then worked on a part at a time",
        rich_help_panel=RESOURCES,
    ),
]
PixelsOption = Annotated[
    int | None,
    typer.Option(
        metavar="N",
        min=1,
        envvar="RAVG_MAX_PIXELS",
        help="refuse files that claim more pixels than this; 2^28 without",
        rich_help_panel=RESOURCES,
    ),
]
AovOption = Annotated[
    list[str] | None,
    typer.Option(
        "--aov",
        metavar="LAYER",
        help="denoise this layer along; all: every layer whose name is known for a part of the light",
        rich_help_panel=WHAT,
    ),
]


def import_neural() -> ModuleType:
    """The boundary to torch, or a clear word on how to get it."""
    gc.disable()
    try:
        from hybrid import neural
    except ModuleNotFoundError as error:
        if error.name not in ("torch", "safetensors"):
            raise
        raise ValueError(
            f'{error.name} is not installed; expected: pip install "{error.name}" (`ravg pseudoref` works without)'
        ) from None
    finally:
        gc.enable()
    # Hundreds of thousands of objects of libraries, which stay: looking for garbage among them took 2 % of the CPU time
    # of ten frames of 1920×1080 by `fast`.
    gc.freeze()
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
    from hybrid.files.sequences import parse_frames
    from hybrid.files.shots import open_shot
    from hybrid.runtime.compiled import watch_compiling

    watch_compiling()
    chosen = parse_input(profile, motion)
    overrides = parse_layers(layer)
    if frames is not None:
        with usage():
            parse_frames(frames)
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
        LOG.warning(warning)
    return opened


def parse_input(profile: str | None, motion: str | None) -> Profile | None:
    """The profile that is asked for; what is no convention is refused."""
    from hybrid.files.profile import open_profile, parse_motion

    with usage():
        if motion not in (None, "auto", "none"):
            parse_motion(motion or "")
        return None if profile is None else open_profile(profile)


def parse_layers(layer: Sequence[str] | None) -> dict[str, str]:
    """Roles and the layers that are to play them."""
    from hybrid.files.profile import ROLES

    overrides = {}
    for item in layer or ():
        role, _, name = item.partition("=")
        if role not in ROLES or not name:
            raise typer.BadParameter(f"--layer is {item!r}, expected ROLE=LAYER; roles: {', '.join(ROLES)}")
        if role in overrides:
            raise typer.BadParameter(f"--layer names {role} twice, expected once")
        overrides[role] = name
    return overrides


def each_view(command: Callable[..., None], given: Mapping[str, object]) -> bool:
    """Run a command for each stereo view that %V or %v stands for in the shot's name; False where it has neither."""
    from hybrid.files.sequences import find_views, name_view

    spec = str(given["shot"])
    views = find_views(spec)
    if views:
        _expect_apart(given, views)
    for view in views:
        LOG.info(f"view {view}")
        here = {
            option: type(value)(name_view(str(value), view)) if isinstance(value, str | Path) else value
            for option, value in given.items()
        }
        here["layer"] = [name_view(item, view) for item in given.get("layer") or ()]  # type: ignore[attr-defined]
        command(**here)
    return bool(views)


def _expect_apart(given: Mapping[str, object], views: Sequence[str]) -> None:
    """Refuse what both views would be written to, or be made from, as if they were one."""
    from hybrid.estimates import SPECS
    from hybrid.files.sequences import name_view
    from hybrid.files.sidecars import names_sequence

    def shared(value: str) -> bool:
        return len({name_view(value, view) for view in views}) < len(views)

    files_are_apart = not shared(Path(str(given["shot"])).name)
    words = {name: str(given[name]) for name in _OF_A_VIEW if given.get(name) is not None}
    words |= {f"layer {role}": value for role, value in parse_layers(given.get("layer")).items()}  # type: ignore[arg-type]
    for name, value in words.items():
        if name in ("output", "keep_estimates") and files_are_apart and not value.lower().endswith(".exr"):
            continue  # a folder, where files are called as those of the shot
        if (name == "estimate" and value in SPECS) or (name.startswith("layer") and not names_sequence(value)):
            continue
        if shared(value):
            option = name.replace("_", "-")
            raise typer.BadParameter(f"{option} is {value!r}, expected %V or %v in it, as the shot has")


def judge_input(shot: Shot, *, strict: bool) -> tuple[tuple[Shot, ...], ValidationReport]:
    """The pictures of the shot, without the layers that make no sense.

    Each of those is said in a line; it is an error if `strict`. The judgement is that of the first picture, with what
    was found in the others.
    """
    from hybrid.validation import validate_layers

    pictures = shot.views
    judged = [validate_layers(picture) for picture in pictures]
    findings = [finding for judgement in judged for finding in judgement.findings]
    judgement = replace(judged[0], findings=tuple(dict.fromkeys(findings)))
    _say(judgement, shot, strict=strict)
    if len(pictures) > 1:
        colors = ", ".join(str(picture.layers(picture.numbers[0]).color) for picture in pictures)
        LOG.info(f"pictures: {printable(colors)}: each is denoised; --layer color=NAME chooses one")
    return tuple(own.apply(picture) for own, picture in zip(judged, pictures, strict=True)), judgement


def judge_alike(shots: Mapping[str, Shot], *, strict: bool) -> tuple[dict[str, Shot], list[str]]:
    """Renders of one shot, without the layers that make no sense in one of them; what was found is said as ever.

    Of files with several pictures one has to be chosen. Also returned is what was said.
    """
    from hybrid.validation import validate_layers

    judged = {name: validate_layers(shot) for name, shot in shots.items()}
    for name, judgement in judged.items():
        _say(judgement, shots[name], strict=strict, name=name if len(shots) > 1 else "")
    findings = tuple(dict.fromkeys(finding for judgement in judged.values() for finding in judgement.findings))
    apply = {name: replace(judgement, findings=findings).apply(shots[name]) for name, judgement in judged.items()}
    return apply, [finding.message for finding in findings]


def _say(judgement: ValidationReport, shot: Shot, *, strict: bool, name: str = "") -> None:
    if strict and (warnings := [*shot.warnings, *judgement.warnings]):
        raise ValueError(f"{name}: {'; '.join(warnings)}" if name else "; ".join(warnings))
    for warning in judgement.warnings:
        LOG.warning(printable(f"{name}: {warning}" if name else warning))


def say_cuts(plan: Plan, known: Sequence[Finding], *, strict: bool, name: str = "") -> list[Finding]:
    """Log a plan's cuts, an error if `strict`, and its repeated frames, a line each, beyond what is known."""
    from hybrid.validation import find_cut, find_repeat

    found = [finding for cut in plan.cuts if (finding := find_cut(*cut)) not in known]
    words = [f"{name}: {finding.message}" if name else finding.message for finding in found]
    if strict and found:
        raise ValueError("; ".join(words))
    repeats = [finding for pair in plan.repeats if (finding := find_repeat(*pair)) not in known]
    found += repeats
    words += [f"{name}: {finding.message}" if name else finding.message for finding in repeats]
    for line in words:
        LOG.warning(printable(line))
    return found


def rules_of(on: Sequence[str] | None, off: Sequence[str] | None) -> Rules:
    """What decides which stages run, with those that the user has forced."""
    from hybrid.plan import Rules

    with usage():
        return Rules(frozenset(split_names(on)), frozenset(split_names(off)))


def split_names(names: Sequence[str] | None) -> list[str]:
    """Names may be given one by one or separated by commas."""
    return [name for item in names or () for name in item.split(",")]


def choose(table: dict[str, Thing], name: str, option: str) -> Thing:
    if name not in table:
        raise typer.BadParameter(f"--{option} is {name!r}, expected one of {', '.join(table)}")
    return table[name]


@contextmanager
def usage() -> Iterator[None]:
    """Let what is wrong with an option be bad usage, exit code 2, in every command alike."""
    try:
        yield
    except ValueError as error:
        raise typer.BadParameter(str(error)) from None
