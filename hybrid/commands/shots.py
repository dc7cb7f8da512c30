"""How commands open a shot, validate its layers, and report findings."""

import gc
from collections.abc import Iterable, Mapping, Sequence
from dataclasses import dataclass, fields, is_dataclass, replace
from pathlib import Path
from types import ModuleType
from typing import Any, TypeVar

import typer

from hybrid.checks.validation import Finding, ValidationReport, find_cut, find_repeat, validate_layers
from hybrid.commands.log import LOG, printable
from hybrid.commands.options import usage
from hybrid.denoising.plan import Plan
from hybrid.files.exr import MAX_PIXELS
from hybrid.files.profile import ROLES, Profile, open_profile, parse_motion
from hybrid.files.sequences import find_views, name_view, parse_frames
from hybrid.files.shots import Shot, open_shot
from hybrid.files.sidecars import names_sequence
from hybrid.run.job import import_neural as import_torch
from hybrid.runtime.first_run import watch_compiling

Value = TypeVar("Value")


def import_neural() -> ModuleType:
    """Return the boundary to torch, as `hybrid.run.job.import_neural`, for a process that runs nothing else."""
    gc.disable()
    try:
        neural = import_torch()
    finally:
        gc.enable()
    # Hundreds of thousands of objects of libraries, which stay: looking for garbage among them took 2 % of the CPU time
    # of ten frames of 1920×1080 by `fast`.
    gc.freeze()
    return neural


@dataclass(frozen=True, kw_only=True)
class ShotInput:
    """The options that say which shot is read, and how; bad usage raises BadParameter before a file is opened."""

    shot: str
    aovs: Sequence[str] = ()
    frames: str | None = None
    layer: list[str] | None = None
    profile: str | None = None
    motion: str | None = None
    strict: bool = False
    max_pixels: int | None = None

    def __post_init__(self) -> None:
        parse_layers(self.layer)
        with usage():
            if self.frames is not None:
                parse_frames(self.frames)
        parse_input(self.profile, self.motion)

    def open(self, *, keep: int = 0) -> Shot:
        """Open the shot, which holds `keep` frames in memory; warnings are logged."""
        watch_compiling()
        opened = open_shot(
            self.shot,
            frames=self.frames,
            layers=parse_layers(self.layer),
            profile=parse_input(self.profile, self.motion),
            motion=self.motion,
            aovs=tuple(self.aovs),
            keep=keep,
            max_pixels=MAX_PIXELS if self.max_pixels is None else self.max_pixels,
        )
        for warning in opened.warnings:
            LOG.warning(warning)
        return opened


def parse_input(profile: str | None, motion: str | None) -> Profile | None:
    """Return the profile that is asked for; BadParameter for a motion that is no convention."""
    with usage():
        if motion not in (None, "auto", "none"):
            parse_motion(motion or "")
        return None if profile is None else open_profile(profile)


def parse_layers(layer: Iterable[str] | None) -> dict[str, str]:
    """Role → layer, of ROLE=LAYER."""
    overrides = {}
    for item in layer or ():
        role, _, name = item.partition("=")
        if role not in ROLES or not name:
            raise typer.BadParameter(f"--layer is {item!r}, expected ROLE=LAYER; roles: {', '.join(ROLES)}")
        if role in overrides:
            raise typer.BadParameter(f"--layer names {role} twice, expected once")
        overrides[role] = name
    return overrides


def views_of(spec: str) -> list[str]:
    """The stereo views that %V or %v stands for in the name of a shot; [""] where it has neither."""
    return find_views(spec) or [""]


def in_view(value: Value, view: str) -> Value:
    """Put the name of a view into all names that a value holds: strings, paths, lists and dataclasses of them."""
    named: Any = value
    if not view:
        return value
    if isinstance(value, str):
        named = name_view(value, view)
    elif isinstance(value, Path):
        named = Path(name_view(str(value), view))
    elif isinstance(value, list | tuple):
        named = type(value)(in_view(item, view) for item in value)
    elif is_dataclass(value):
        named = replace(value, **{f.name: in_view(getattr(value, f.name), view) for f in fields(value)})  # type: ignore[type-var]
    return named  # type: ignore[no-any-return]


def expect_views_apart(
    views: Sequence[str], shot: ShotInput, folders: Mapping[str, str | None], files: Mapping[str, object]
) -> None:
    """Refuse names that all views would share: frames written over each other, or denoised with each other's files.

    `folders` may be shared where they are folders and the files of the views have different names.
    """
    if views == [""]:
        return

    def is_shared(value: str) -> bool:
        return len({in_view(value, view) for view in views}) < len(views)

    different = not is_shared(Path(shot.shot).name)
    names = {n: v for n, v in folders.items() if v and not (different and not v.lower().endswith(".exr"))}
    names |= {name: str(value) for name, value in files.items() if value is not None}
    names |= {f"layer {role}": value for role, value in parse_layers(shot.layer).items() if names_sequence(value)}
    for name, value in names.items():
        if is_shared(value):
            raise typer.BadParameter(f"{name} is {value!r}, expected %V or %v in it, as the shot has")


def log_findings(report: ValidationReport, views: Sequence[Shot]) -> None:
    """Warn of each layer that makes no sense, and name the views where there are several."""
    for warning in report.warnings:
        LOG.warning(printable(warning))
    if len(views) > 1:
        colors = ", ".join(str(view.layers(view.numbers[0]).color) for view in views)
        LOG.info(f"pictures: {printable(colors)}: each is denoised; --layer color=NAME chooses one")


def validate_renders(shots: Mapping[str, Shot], *, strict: bool) -> tuple[dict[str, Shot], list[str]]:
    """Return renders of one shot without layers that make no sense in one, and findings, logged, errors if `strict`."""
    reports = {name: validate_layers(shot) for name, shot in shots.items()}
    for name, report in reports.items():
        prefix = f"{name}: " if len(shots) > 1 else ""
        if strict and (warnings := [*shots[name].warnings, *report.warnings]):
            raise ValueError(f"{prefix}{'; '.join(warnings)}")
        for warning in report.warnings:
            LOG.warning(printable(f"{prefix}{warning}"))
    findings = tuple(dict.fromkeys(finding for report in reports.values() for finding in report.findings))
    applied = {name: replace(report, findings=findings).apply(shots[name]) for name, report in reports.items()}
    return applied, [finding.message for finding in findings]


def log_cuts(plan: Plan, known: Sequence[Finding], *, strict: bool, name: str = "") -> list[Finding]:
    """Log cuts and repeated frames of a plan that are not `known`, and return them; cuts are errors if `strict`."""
    cuts = [finding for cut in plan.cuts if (finding := find_cut(*cut)) not in known]
    repeats = [finding for pair in plan.repeats if (finding := find_repeat(*pair)) not in known]
    lines = [f"{name}: {finding.message}" if name else finding.message for finding in (*cuts, *repeats)]
    if strict and cuts:
        raise ValueError("; ".join(lines[: len(cuts)]))
    for line in lines:
        LOG.warning(printable(line))
    return [*cuts, *repeats]


def log_noise(plan: Plan) -> list[str]:
    """Warn of noise that averaging does not remove: one seed for all frames, too wide a filter; return the causes."""
    found = []
    for decision in plan.decisions:
        if decision.forced or decision.figure is None or decision.threshold is None:
            continue
        shared = decision.stage == "blend-samples" and not decision.on
        if (decision.stage == "fixed-noise" and decision.on) or (shared and "seed" not in found):
            found.append("seed")
            LOG.warning(f"constant seed: {decision.reason}")
        elif decision.stage == "whiten" and not decision.on and decision.figure > decision.threshold:
            found.append("pixel filter")
            LOG.warning(f"pixel filter: {decision.reason} (docs/renderers.md)")
    return found


def split_stages(names: Sequence[str] | None) -> tuple[str, ...]:
    """Split names of stages."""
    return tuple(name for item in names or () for name in item.split(","))
