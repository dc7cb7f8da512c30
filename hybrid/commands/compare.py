"""`ravg compare`: accuracy against time."""

from __future__ import annotations

from collections.abc import Sequence
from functools import cache, partial
from importlib.util import find_spec
from pathlib import Path
from typing import TYPE_CHECKING, Annotated, Literal

import typer

from hybrid.commands.log import LOG, Progress
from hybrid.commands.options import (
    INPUT,
    OUTPUT,
    WHAT,
    FramesOption,
    LayerOption,
    MotionOption,
    ProfileOption,
    RateOption,
    StrictOption,
    choose,
)
from hybrid.commands.shots import judge_alike, open_input, say_cuts

if TYPE_CHECKING:
    from rich.table import Table as RichTable

    from hybrid.comparison.methods import Method
    from hybrid.files.shots import Shot


def compare(
    shot: Annotated[
        str | None, typer.Argument(metavar="SHOT", help="shot.####.exr, shot.%04d.exr, a folder, or a file")
    ] = None,
    reference: Annotated[
        list[str] | None,
        typer.Option(
            metavar="PATTERN",
            help="the same frames at many samples; twice: two independent halves, whose noise cancels",
            rich_help_panel=INPUT,
        ),
    ] = None,
    output: Annotated[
        Path | None,
        typer.Option(
            "-o",
            "--output",
            metavar="REPORT",
            help="folder for a page with chart and pictures",
            rich_help_panel=OUTPUT,
        ),
    ] = None,
    methods: Annotated[
        str | None,
        typer.Option(metavar="NAMES", help="separated by commas; all without", rich_help_panel=WHAT),
    ] = None,
    external: Annotated[
        list[str] | None,
        typer.Option(
            metavar="NAME=PATTERN",
            help="frames that another denoiser has finished; may be repeated",
            rich_help_panel=INPUT,
        ),
    ] = None,
    sweep: Annotated[
        bool, typer.Option("--sweep", help="also vary stages and settings, one at a time", rich_help_panel=WHAT)
    ] = False,
    rounds: Annotated[
        int, typer.Option(min=1, help="runs of each method, in turns, whose median is the time", rich_help_panel=WHAT)
    ] = 3,
    samples: Annotated[
        float | None,
        typer.Option(
            metavar="SPP",
            min=1,
            help="per pixel of SHOT, where its files do not tell, as those of Cycles do",
            rich_help_panel=INPUT,
        ),
    ] = None,
    level: Annotated[
        list[str] | None,
        typer.Option(
            metavar="PATTERN=SPP",
            help="SHOT at other samples per pixel, to measure how noise falls",
            rich_help_panel=INPUT,
        ),
    ] = None,
    exposure: Annotated[
        float, typer.Option(help="factor before the tone curve of the measures", rich_help_panel=WHAT)
    ] = 1.0,
    clock: Annotated[
        Literal["wall", "cpu"],
        typer.Option(help="the time that chart.png and the Markdown table show", rich_help_panel=OUTPUT),
    ] = "wall",
    markdown: Annotated[
        bool, typer.Option("--markdown", help="print the table of the README", rich_help_panel=OUTPUT)
    ] = False,
    name: Annotated[
        str | None, typer.Option(help="of the shot, in tables and on the page", rich_help_panel=OUTPUT)
    ] = None,
    beside: Annotated[
        list[Path] | None,
        typer.Option(
            metavar="REPORT",
            help="folder of a finished comparison of another shot, to be shown beside",
            rich_help_panel=INPUT,
        ),
    ] = None,
    fps: RateOption = 24,
    loops: Annotated[
        bool,
        typer.Option(
            "--loops", help="also write a movie of each method in its own size, beside the page", rich_help_panel=OUTPUT
        ),
    ] = False,
    frames: FramesOption = None,
    layer: LayerOption = None,
    profile: ProfileOption = None,
    motion: MotionOption = None,
    strict: StrictOption = False,
) -> None:
    """Show accuracy against time: the noisy input, every preset, and other denoisers, against a reference."""
    import tempfile

    from hybrid.comparison.compare import compare_shot
    from hybrid.comparison.results import Comparison, Cost, join, read_comparison
    from hybrid.comparison.running import run_apart
    from hybrid.comparison.samples import samples_of
    from hybrid.comparison.store import FrameStore
    from hybrid.comparison.tables import markdown_table, result_table
    from hybrid.runtime.allocator import reuse_freed_memory
    from hybrid.stream import plan_shot

    costs: dict[str, Cost] = {"wall": "seconds_per_megapixel", "cpu": "cpu_seconds_per_megapixel"}
    cost = costs[clock]
    if output is not None:  # before anything runs
        _need_page()
        from hybrid.comparison.report import check_report

        check_report(output, [folder / "results.json" for folder in beside or ()])
    if loops:
        from hybrid.files.movies import check_movie

        if output is None:
            raise typer.BadParameter("--loops writes beside a page, expected --output with it")
        check_movie(output / "loop.mp4")
    others = [read_comparison(folder / "results.json") for folder in beside or ()]
    if shot is None or not reference:
        if not others or shot is not None or reference:
            raise typer.BadParameter("expected SHOT and --reference, or --beside with finished comparisons")
        joined = Comparison(" + ".join(c.shot for c in others), tuple(join(others)), {})
        if output is not None:
            from hybrid.comparison.report import write_report

            LOG.info(f"wrote {write_report(output, joined, others=others, cost=cost)}")
        _show(markdown, markdown_table(others, cost), result_table(joined.results))
        return
    if len(reference) > 2:
        raise typer.BadParameter(f"--reference is given {len(reference)} times, expected once or twice")
    opened = open_input(shot, frames, layer, profile=profile, motion=motion)
    alike, said = judge_alike({"shot": opened}, strict=strict)
    noisy = alike["shot"]
    clean = [_open_matching_sequence(spec, noisy, frames) for spec in reference]
    chosen = _methods(methods, external, noisy, frames)
    plan = cache(partial(run_apart, plan_shot, noisy))
    if sweep:
        from hybrid.comparison.methods import METHODS
        from hybrid.comparison.sweep import CLASSICAL, NETWORK, sweep_methods

        LOG.info("plan the shot")
        chosen = {**chosen, **{base: METHODS[base] for base in (CLASSICAL, NETWORK)}, **sweep_methods(plan())}
    pairs = [_pair(item, "--level", "PATTERN=SPP") for item in level or ()]
    levels = [
        (open_input(pattern, frames, layer, profile=profile), _number(count, "--level")) for pattern, count in pairs
    ]
    bar: Progress | None = None

    def show(what: str, done: float, total: float) -> None:
        nonlocal bar
        if bar is None:
            bar = Progress(what, total, "steps")
        else:
            bar.advance(done - bar.done, what)

    reuse_freed_memory()
    with tempfile.TemporaryDirectory() as folder:
        comparison = compare_shot(
            noisy,
            clean[0] if len(clean) == 1 else (clean[0], clean[1]),
            chosen,
            title=name or (Path(shot) if Path(shot).is_dir() else Path(shot).parent).resolve().name,
            exposure=exposure,
            rounds=rounds,
            samples=samples or samples_of(noisy),
            reference_samples=samples_of(clean[0]),
            levels=levels,
            said=said,
            look=lambda: [finding.message for finding in say_cuts(plan(), (), strict=strict)],
            maps=output is not None,
            folder=Path(folder),
            progress=show,
        )
        if output is not None:
            from hybrid.comparison.report import report_images, write_report

            LOG.info("page: pack the pictures")
            judged = [number for number in noisy.numbers if all(number in half.numbers for half in clean)]
            images, truth = report_images(FrameStore(Path(folder)), comparison, judged)
            page = write_report(
                output,
                comparison,
                images,
                truth,
                judged,
                others=others,
                exposure=exposure,
                cost=cost,
                rate=fps,
                movies=loops,
            )
            LOG.info(f"wrote {page}")
    _show(markdown, markdown_table([comparison, *others], cost), result_table(comparison.results))


def _need_page() -> None:
    """Refuse a page that cannot be made here."""
    if missing := [name for name in ("jinja2", "resvg_py", "font_manrope") if find_spec(name) is None]:
        packages = " ".join(f'"{name}"' for name in missing)
        words = f"expected: pip install {packages} (the table alone is made without)"
        raise ValueError(f"the page of --output needs {missing[0]}, which is not installed; {words}")


def _show(markdown: bool, text: str, table: RichTable) -> None:
    """Print results as Markdown for a file, or as a table for a terminal."""
    from rich.console import Console

    if markdown:
        typer.echo(text, nl=False)
    else:
        Console().print(table)


def _open_matching_sequence(spec: str, shot: Shot, frames: str | None) -> Shot:
    """Open a reference or a finished sequence, and pass on its warnings."""
    from hybrid.files.shots import open_matching_sequence

    opened = open_matching_sequence(spec, shot, frames=frames)
    for warning in opened.warnings:
        LOG.warning(warning)
    return opened


def _methods(names: str | None, external: Sequence[str] | None, shot: Shot, frames: str | None) -> dict[str, Method]:
    """The methods asked for, and sequences that others have finished."""
    from hybrid.comparison.methods import METHODS
    from hybrid.comparison.methods import external as finished

    wanted = METHODS if names is None else {n.strip(): choose(METHODS, n.strip(), "methods") for n in names.split(",")}
    chosen = dict(wanted)
    for item in external or ():
        name, pattern = _pair(item, "--external", "NAME=PATTERN")
        if name in METHODS or name == "reference":
            raise typer.BadParameter(f"--external is {item!r}, expected a name that no other method has")
        chosen[name] = finished(_open_matching_sequence(pattern, shot, frames))
    return chosen


def _pair(item: str, option: str, form: str) -> tuple[str, str]:
    """Split at the last "=" for patterns that hold one, at the first otherwise."""
    first, separator, second = item.rpartition("=") if form.startswith("PATTERN") else item.partition("=")
    if not separator or not first or not second:
        raise typer.BadParameter(f"{option} is {item!r}, expected {form}")
    return first, second


def _number(text: str, option: str) -> float:
    try:
        value = float(text)
    except ValueError:
        value = 0.0
    if not value > 0:
        raise typer.BadParameter(f"{option} is {text!r}, expected a positive number")
    return value
