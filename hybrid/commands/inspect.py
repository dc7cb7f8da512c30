"""`ravg inspect`: which channels are taken for what, and what the shot calls for."""

from __future__ import annotations

import json
from dataclasses import asdict
from typing import TYPE_CHECKING, Annotated

import typer

from hybrid.commands.log import Progress, printable
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
    each_view,
    judge_input,
    open_input,
    rules_of,
    say_cuts,
)

if TYPE_CHECKING:
    from hybrid.plan import Decision


def inspect(
    shot: ShotArgument,
    frames: FramesOption = None,
    layer: LayerOption = None,
    profile: ProfileOption = None,
    motion: MotionOption = None,
    strict: StrictOption = False,
    stages: OnOption = None,
    no_stages: OffOption = None,
    as_json: Annotated[
        bool, typer.Option("--json", help="all of it as one JSON object", rich_help_panel=OUTPUT)
    ] = False,
    max_pixels: PixelsOption = None,
) -> None:
    """Show which channels are taken for what, and which stages the shot calls for."""
    if each_view(inspect, locals()):
        return
    from rich.box import SIMPLE_HEAD
    from rich.console import Console
    from rich.table import Table
    from rich.text import Text

    from hybrid.files.layers import describe_layers
    from hybrid.plan import STAGES, plan_shot

    opened = open_input(shot, frames, layer, profile=profile, motion=motion, max_pixels=max_pixels)
    (opened, *_), judgement = judge_input(opened, strict=strict)
    first = opened.numbers[0]
    height, width = opened.shape
    layers = opened.layers(first)
    rows = describe_layers(layers)
    rules = rules_of(stages, no_stages)
    progress = Progress("look", len(opened))
    plan = plan_shot(opened, rules, advance=progress.advance)
    judged = [*judgement.findings, *say_cuts(plan, judgement.findings, strict=strict)]
    if as_json:
        document = {
            "frames": opened.numbers,
            "width": width,
            "height": height,
            "warnings": opened.warnings,
            "profile": layers.profile,
            "reason": layers.reason,
            "layers": [dict(zip(("role", "layer", "note"), row, strict=True)) for row in rows],
            "judged": [asdict(finding) for finding in judged],
            "motion": judgement.readings(),
            "plan": [asdict(decision) for decision in plan.decisions],
        }
        typer.echo(json.dumps(document, indent=1))
        return
    console = Console()
    console.print(f"{len(opened)} frames, {first}-{opened.numbers[-1]}, {width}×{height}", highlight=False)
    console.print(f"profile: {printable(layers.profile)} ({printable(layers.reason)})\n", highlight=False, markup=False)
    table = Table("role", "taken from", "note", title="Layers", title_justify="left", box=SIMPLE_HEAD, pad_edge=False)
    for row in rows:
        table.add_row(*(Text(printable(words)) for words in row))  # names from a file are no markup
    console.print(table)
    for finding in judgement.findings:
        if not finding.warning:
            console.print(f"{printable(finding.message)}\n", highlight=False, markup=False)
    if readings := judgement.readings():
        title = "Motion: what the vectors leave unexplained"
        table = Table(
            "", "read as", "of the picture", title=title, title_justify="left", box=SIMPLE_HEAD, pad_edge=False
        )
        for row in readings:
            table.add_row(*row)
        console.print(table)
    table = Table("", "stage", "measured", "why", title="Plan", title_justify="left", box=SIMPLE_HEAD, pad_edge=False)
    for decision in plan.decisions:
        why = f"{decision.reason} ({STAGES[decision.stage]})"
        table.add_row("on" if decision.on else "off", decision.stage, _measured(decision), Text(printable(why)))
    console.print(table)


def _measured(decision: Decision) -> str:
    """A figure beside the threshold that it was held against."""
    if decision.figure is None:
        return "–"
    sign = ">" if decision.figure > decision.threshold else "≤"
    return f"{decision.figure:.3g} {sign} {decision.threshold:.3g}"
