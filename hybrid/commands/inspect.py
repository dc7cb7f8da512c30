"""`ravg inspect`: which channels are taken for what, and what the shot calls for."""

from __future__ import annotations

from hybrid.commands.options import (
    FramesOption,
    LayerOption,
    MotionOption,
    OffOption,
    OnOption,
    PixelsOption,
    ProfileOption,
    ShotArgument,
    open_input,
    plan_input,
    printable,
)


def inspect(
    shot: ShotArgument,
    frames: FramesOption = None,
    layer: LayerOption = None,
    profile: ProfileOption = None,
    motion: MotionOption = None,
    stages: OnOption = None,
    no_stages: OffOption = None,
    max_pixels: PixelsOption = None,
) -> None:
    """Show which channels are taken for what, and which stages the shot calls for."""
    from rich.console import Console
    from rich.table import Table
    from rich.text import Text

    from hybrid.files.layers import describe_layers
    from hybrid.plan import STAGES

    console = Console()
    opened = open_input(shot, frames, layer, profile=profile, motion=motion, max_pixels=max_pixels)
    first = opened.numbers[0]
    height, width = opened.shape
    console.print(f"{len(opened)} frames, {first}-{opened.numbers[-1]}, {width}×{height}", highlight=False)
    table = Table("role", "taken from", "note", title="Layers", title_justify="left")
    layers = opened.layers(first)
    console.print(f"profile: {printable(layers.profile)} ({printable(layers.reason)})", highlight=False, markup=False)
    for row in describe_layers(layers):
        table.add_row(*(Text(printable(words)) for words in row))  # names from a file are no markup
    console.print(table)
    plan = plan_input(opened, stages, no_stages)
    table = Table("stage", "", "measured", "threshold", "why", title="Plan", title_justify="left")
    for decision in plan.decisions:
        figure = "–" if decision.figure is None else f"{decision.figure:.4g}"
        threshold = "–" if decision.figure is None else f"{decision.threshold:.4g}"
        state = "on" if decision.on else "off"
        why = f"{decision.reason} ({STAGES[decision.stage]})"
        table.add_row(decision.stage, state, figure, threshold, why)
    console.print(table)
