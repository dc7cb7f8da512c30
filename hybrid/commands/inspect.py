"""`ravg inspect`: which channels are taken for what, and what the shot calls for."""

from __future__ import annotations

import json
from collections.abc import Sequence
from dataclasses import asdict
from typing import Annotated

import typer
from rich.box import SIMPLE_HEAD
from rich.console import Console
from rich.table import Table
from rich.text import Text

from hybrid.commands.log import LOG, Progress, printable
from hybrid.commands.options import (
    OUTPUT,
    FramesOption,
    LayerOption,
    MotionOption,
    OffOption,
    OnOption,
    PixelsOption,
    ProfileOption,
    ShotArgument,
    StrictOption,
)
from hybrid.commands.shots import ShotInput, expect_views_apart, in_view, log_cuts, log_findings, rules_of, views_of
from hybrid.files.layers import Layers, describe_layers
from hybrid.job import validate_views
from hybrid.plan import STAGES, Decision, Rules
from hybrid.stream import plan_shot


def inspect(
    shot: ShotArgument,
    frames: FramesOption = None,
    layer: LayerOption = None,
    profile: ProfileOption = None,
    motion: MotionOption = None,
    strict: StrictOption = False,
    stages: OnOption = None,
    no_stages: OffOption = None,
    as_json: Annotated[bool, typer.Option("--json", help="print one JSON object", rich_help_panel=OUTPUT)] = False,
    max_pixels: PixelsOption = None,
) -> None:
    """Show which channels are used as what, and which stages the shot calls for, with figures and reasons.

    Examples:

    ravg inspect "shot.####.exr"

    ravg inspect "shot.####.exr" --json > shot.json
    """
    read = ShotInput(shot, frames, tuple(layer or ()), profile=profile, motion=motion, max_pixels=max_pixels)
    rules = rules_of(stages, no_stages)
    views = views_of(shot)
    expect_views_apart(views, read, {}, {})
    for view in views:
        if view:
            LOG.info(f"view {view}")
        _inspect(in_view(read, view), rules, strict=strict, as_json=as_json)


def _inspect(read: ShotInput, rules: Rules, *, strict: bool, as_json: bool) -> None:
    """Print layers, findings and plan of a shot."""
    opened = read.open()
    pictures, judgement = validate_views(opened, strict=strict)
    log_findings(judgement, pictures)
    height, width = opened.shape
    progress = Progress("look", len(opened) * len(pictures))
    layers = [picture.layers(picture.numbers[0]) for picture in pictures]
    rows = [describe_layers(taken) for taken in layers]
    plans, judged = [], list(judgement.findings)
    for picture in pictures:
        plans.append(plan_shot(picture, rules, advance=progress.advance))
        judged += log_cuts(plans[-1], judged, strict=strict)
    if as_json:
        of_each = [
            {
                "layers": [dict(zip(("role", "layer", "note"), row, strict=True)) for row in roles],
                "plan": [asdict(decision) for decision in plan.decisions],
            }
            for roles, plan in zip(rows, plans, strict=True)
        ]
        document = {
            "frames": opened.numbers,
            "width": width,
            "height": height,
            "warnings": opened.warnings,
            "profile": layers[0].profile,
            "reason": layers[0].reason,
            "judged": [asdict(finding) for finding in judged],
            "motion": judgement.readings(),
            **of_each[0],
            **({"others": of_each[1:]} if len(pictures) > 1 else {}),
        }
        typer.echo(json.dumps(document, indent=1))
        return
    console = Console()
    console.print(f"{len(opened)} frames, {opened.numbers[0]}-{opened.numbers[-1]}, {width}×{height}", highlight=False)
    profile_line = f"profile: {printable(layers[0].profile)} ({printable(layers[0].reason)})\n"
    console.print(profile_line, highlight=False, markup=False)

    def show(title: str, heads: Sequence[str], lines: Sequence[Sequence[str]]) -> None:
        table = Table(*heads, title=Text(title), title_justify="left", box=SIMPLE_HEAD, pad_edge=False)
        for line in lines:
            table.add_row(*(Text(printable(words)) for words in line))  # names from a file are no markup
        console.print(table)

    def named(title: str, taken: Layers) -> str:
        return f"{title} of {printable(str(taken.color))}" if len(pictures) > 1 else title

    for taken, roles in zip(layers, rows, strict=True):
        show(named("Layers", taken), ("role", "taken from", "note"), roles)
    for finding in judgement.findings:
        if not finding.warning:
            console.print(f"{printable(finding.message)}\n", highlight=False, markup=False)
    if readings := judgement.readings():
        seen = "surfaces" if judgement.motion is not None and judgement.motion.by_surfaces else "picture"
        show("Motion: what the vectors leave unexplained", ("", "read as", f"of the {seen}"), readings)
    for taken, plan in zip(layers, plans, strict=True):
        lines = [
            (
                "on" if decision.on else "off",
                decision.stage,
                _measured(decision),
                f"{decision.reason} ({STAGES[decision.stage]})",
            )
            for decision in plan.decisions
        ]
        show(named("Plan", taken), ("", "stage", "measured", "why"), lines)


def _measured(decision: Decision) -> str:
    """A figure beside the threshold that it was held against."""
    if decision.figure is None or decision.threshold is None:
        return "–"
    sign = ">" if decision.figure > decision.threshold else "≤"
    return f"{decision.figure:.3g} {sign} {decision.threshold:.3g}"
