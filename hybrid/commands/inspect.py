"""`ravg inspect`: which layer has which role, and which stages run."""

import json
import logging
from collections.abc import Sequence
from dataclasses import asdict
from typing import Any

import typer
from rich.console import Console

from hybrid.commands import options as opt
from hybrid.commands.log import LOG, Progress, print_table, printable
from hybrid.commands.shots import (
    ShotInput,
    expect_views_apart,
    in_view,
    log_cuts,
    log_findings,
    log_noise,
    split_stages,
    views_of,
)
from hybrid.denoising.plan import STAGES, Decision, Rules
from hybrid.denoising.stream import plan_shot
from hybrid.files.layers import describe_layers
from hybrid.run.job import validate_views


@opt.command("inspect", ShotInput)
def inspect(
    shot: str,
    stages: list[str] | None = None,
    no_stages: list[str] | None = None,
    as_json: bool = False,
    **how: Any,
) -> None:
    """Print layers, findings and plan of each view of a shot."""
    read = ShotInput(shot=shot, **how)
    with opt.usage():
        rules = Rules(frozenset(split_stages(stages)), frozenset(split_stages(no_stages)))
    views = views_of(shot)
    expect_views_apart(views, read, {}, {})
    for view in views:
        if view:
            LOG.info(f"view {view}")
        _inspect(in_view(read, view), rules, as_json=as_json)


def _inspect(read: ShotInput, rules: Rules, *, as_json: bool) -> None:
    """Print a verdict on a shot; if the log is verbose, layers, findings and plan too."""
    shot = read.open()
    views, report = validate_views(shot, strict=read.strict)
    log_findings(report, views)
    height, width = shot.shape
    progress = Progress("measuring frames", len(shot) * len(views))
    plans, findings = [], list(report.findings)
    for view in views:
        plans.append(plan_shot(view, rules, advance=progress.advance))
        findings += log_cuts(plans[-1], findings, strict=read.strict)
    layers = [view.layers(view.numbers[0]) for view in views]
    if as_json:
        keys = "role", "layer", "note"
        first, *others = (
            {
                "layers": [dict(zip(keys, row, strict=True)) for row in describe_layers(found)],
                "plan": [asdict(decision) for decision in plan.decisions],
            }
            for found, plan in zip(layers, plans, strict=True)
        )
        document = {
            "frames": shot.numbers,
            "width": width,
            "height": height,
            "warnings": shot.warnings,
            "profile": layers[0].profile,
            "reason": layers[0].reason,
            "findings": [asdict(finding) for finding in findings],
            "motion": report.readings(),
            **first,
            **({"others": others} if others else {}),
        }
        typer.echo(json.dumps(document, indent=1))
        return
    console = Console()
    roles = [
        *(found.role for found in findings if found.warning),
        *(found for plan in plans for found in log_noise(plan)),
    ]
    console.print(_verdict(["files"] * len(shot.warnings) + roles))
    console.print(f"{len(shot)} frames, {shot.numbers[0]}-{shot.numbers[-1]}, {width}×{height}", highlight=False)
    console.print(
        f"profile: {printable(layers[0].profile)} ({printable(layers[0].reason)})", highlight=False, markup=False
    )
    if not LOG.isEnabledFor(logging.DEBUG):
        console.print("-v shows layers, motion vectors and stages", highlight=False)
        return
    console.print()
    names = [f" of {printable(str(found.color))}" if len(views) > 1 else "" for found in layers]
    for found, name in zip(layers, names, strict=True):
        print_table(("role", "layer", "note"), describe_layers(found), f"Layers{name}")
    for finding in report.findings:
        if not finding.warning:
            console.print(f"{printable(finding.message)}\n", highlight=False, markup=False)
    if readings := report.readings():
        compared = "surfaces" if report.motion is not None and report.motion.by_surfaces else "picture"
        print_table(("", "convention", f"of the {compared}"), readings, "Motion: unexplained by the vectors")
    for plan, name in zip(plans, names, strict=True):
        rows = [
            ("on" if x.on else "off", x.stage, _measured(x), f"{x.reason} ({STAGES[x.stage]})") for x in plan.decisions
        ]
        print_table(("", "stage", "measured", "why"), rows, f"Plan{name}")


def _verdict(roles: Sequence[str]) -> str:
    """One line about the warnings, of which these are the roles."""
    if not roles:
        return "This shot is fine."
    found = "a warning says" if len(roles) == 1 else f"{len(roles)} warnings say"
    return f"This shot could be better ({', '.join(dict.fromkeys(roles))}): {found} how."


def _measured(decision: Decision) -> str:
    if decision.figure is None or decision.threshold is None:
        return "–"
    sign = ">" if decision.figure > decision.threshold else "<="
    return f"{decision.figure:.3g} {sign} {decision.threshold:.3g}"
