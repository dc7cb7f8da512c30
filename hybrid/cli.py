"""The command ``ravg``."""

from __future__ import annotations

import hashlib
import json
import sys
from collections.abc import Iterator, Mapping, Sequence
from contextlib import ExitStack, contextmanager
from dataclasses import dataclass, replace
from functools import partial
from pathlib import Path
from typing import TYPE_CHECKING, Annotated, TypeVar

import typer

from hybrid.interrupt import INTERRUPTED, interruptible, is_interrupt
from hybrid.simulate.command import simulate_command
from hybrid.training import prepare_command, train_command

if TYPE_CHECKING:  # the commands import what they need: `ravg --help` must not wait for OpenCV and numba
    from rich.table import Table as RichTable

    from hybrid.estimates import EstimateSource
    from hybrid.frames import Shot
    from hybrid.methods import Method
    from hybrid.pipeline import Estimator
    from hybrid.plan import Plan
    from hybrid.timing import Timings

Thing = TypeVar("Thing")

app = typer.Typer(
    help="Denoise rendered animation, in time as well as in space.",
    no_args_is_help=True,
    add_completion=False,
    pretty_exceptions_enable=False,
)

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
PreviewOption = Annotated[
    Path | None, typer.Option(help="a PNG to look at: the middle frame, noisy and denoised side by side")
]
OnOption = Annotated[
    list[str] | None, typer.Option("--effects", metavar="NAME", help="run a stage, whatever the plan says")
]
OffOption = Annotated[list[str] | None, typer.Option("--no-effects", metavar="NAME", help="do not run a stage")]
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


@app.command()
def inspect(
    shot: ShotArgument,
    frames: FramesOption = None,
    layer: LayerOption = None,
    effects: OnOption = None,
    no_effects: OffOption = None,
    max_pixels: PixelsOption = None,
) -> None:
    """Show which channels are taken for what, and which stages the shot calls for."""
    from rich.console import Console
    from rich.table import Table
    from rich.text import Text

    from hybrid.exr import describe_layers
    from hybrid.plan import EFFECTS

    console = Console()
    opened = _open(shot, frames, layer, max_pixels=max_pixels)
    first = opened.numbers[0]
    height, width = opened.shape
    console.print(f"{len(opened)} frames, {first}-{opened.numbers[-1]}, {width}×{height}", highlight=False)
    table = Table("role", "taken from", "note", title="Layers", title_justify="left")
    for row in describe_layers(opened.layers(first)):
        table.add_row(*(Text(_printable(words)) for words in row))  # names from a file are no markup
    console.print(table)
    plan = _plan(opened, effects, no_effects)
    table = Table("stage", "", "measured", "threshold", "why", title="Plan", title_justify="left")
    for decision in plan.decisions:
        figure = "–" if decision.figure is None else f"{decision.figure:.4g}"
        threshold = "–" if decision.figure is None else f"{decision.threshold:.4g}"
        state = "on" if decision.on else "off"
        why = f"{decision.reason} ({EFFECTS[decision.effect]})"
        table.add_row(decision.effect, state, figure, threshold, why)
    console.print(table)


@app.command()
def pseudoref(
    shot: ShotArgument,
    output: OutputOption,
    preset: Annotated[str, typer.Option(help="of our own estimate: draft, balanced or final")] = "balanced",
    estimate: EstimateOption = "none",
    keep_estimates: KeepOption = None,
    preview: PreviewOption = None,
    frames: FramesOption = None,
    layer: LayerOption = None,
    effects: OnOption = None,
    no_effects: OffOption = None,
    resume: ResumeOption = False,
    max_memory: MemoryOption = None,
    max_pixels: PixelsOption = None,
) -> None:
    """Denoise without a network: align, average, non-local means, guided filter. Makes training targets too.

    With --estimate, pictures that are denoised already, each by itself, are made stable instead.
    """
    from hybrid.estimates import choose_estimate
    from hybrid.pipeline import Denoised
    from hybrid.pseudo_reference import PRESETS, gated_average
    from hybrid.pseudo_reference import estimate as estimate_centre
    from hybrid.timing import Timings

    chosen = _choose(PRESETS, preset, "preset")
    opened = _open(shot, frames, layer, max_pixels=max_pixels)
    timings = Timings()
    source = choose_estimate(estimate, opened, own=chosen, kept=keep_estimates)
    _spare_input(opened, output, source.files, preview=preview)
    if source.estimate is None:
        make = partial(estimate_centre, preset=chosen, timings=timings)
    else:
        make = partial(gated_average, timings=timings)
    _run(
        _Job(
            opened,
            output,
            lambda aligned: Denoised(make(aligned)),
            timings,
            source,
            command="pseudoref",
            preset=preset,
            settings={"layer": layer, "estimate": estimate},
            effects=(effects, no_effects),
            resume=resume,
            max_memory=max_memory,
        )
    )
    _preview(opened, output, preview)


@app.command()
def denoise(
    shot: ShotArgument,
    output: OutputOption,
    preset: Annotated[
        str, typer.Option(help="of the weights that come with ravg: fast, balanced, quality, or auto, with --budget")
    ] = "fast",
    budget: Annotated[
        str | None, typer.Option(metavar="TIME", help="per frame, such as 10s: the most accurate preset that fits it")
    ] = None,
    weights: Annotated[Path | None, typer.Option(help="a weights file of your own, instead of a preset")] = None,
    threshold: Annotated[
        float | None,
        typer.Option(help="from 0 to 1: higher keeps fewer frames or taps: closer to the one frame"),
    ] = None,
    estimate: EstimateOption = "auto",
    keep_estimates: KeepOption = None,
    passes: Annotated[
        int,
        typer.Option(
            help="run again on the result: a wider window in time, a softer picture; --resume makes all passes again"
        ),
    ] = 1,
    breakdown: Annotated[
        Path | None,
        typer.Option(metavar="PNG", help="a picture of what each frame contributes, with layers and figures of it"),
    ] = None,
    aov: AovOption = None,
    preview: PreviewOption = None,
    frames: FramesOption = None,
    layer: LayerOption = None,
    effects: OnOption = None,
    no_effects: OffOption = None,
    tile: Annotated[
        int | None,
        typer.Option(help="pixels on a side that the network sees at once; without: 640, with --max-memory 384"),
    ] = None,
    precision: Annotated[str, typer.Option(help="auto, float32 or bfloat16")] = "auto",
    resume: ResumeOption = False,
    max_memory: MemoryOption = None,
    max_pixels: PixelsOption = None,
) -> None:
    """Denoise with the Robust Average network."""
    neural = _neural()
    from rich.console import Console
    from rich.table import Table

    from hybrid.breakdown import Breakdown, write_breakdown
    from hybrid.estimates import MODE_OF, EstimateSource, choose_estimate
    from hybrid.timing import Timings

    if passes < 1:
        raise typer.BadParameter(f"--passes is {passes}, expected at least 1")
    if breakdown is not None and max_memory is not None:
        raise typer.BadParameter("--breakdown looks at whole frames, expected no --max-memory with it")
    opened = _open(shot, frames, layer, aov, max_pixels=max_pixels)
    timings = Timings()
    if (preset == "auto") != (budget is not None) or (weights is not None and budget is not None):
        raise typer.BadParameter("--budget chooses the preset, expected it with --preset auto, and without --weights")
    if budget is not None:
        preset = _fitting(opened, budget, estimate, _plan(opened, effects, no_effects), precision)
    path = weights or neural.shipped_weights(preset)
    if tile is None:
        tile = neural.TILE if max_memory is None else neural.SMALL_TILE
    denoiser = neural.Denoiser(path, tile=tile, precision=precision, threshold=threshold, timings=timings)
    if denoiser.takes_estimate:
        # From the noisy frames alone, such a network works beside our own.
        wanted = "nlm" if estimate == "none" else estimate
        mode = "oidn-clean" if weights is not None else MODE_OF[preset]
        made = opened.around(denoiser.radius * (passes - 1))  # by the first pass
        source = choose_estimate(wanted, made, kept=keep_estimates, mode=mode)
    elif estimate in ("auto", "none"):
        source = EstimateSource("none", None, "this network takes none")
    else:
        raise ValueError(f"estimate is {estimate!r}, expected auto or none: the network of {path.name} takes none")
    _spare_input(opened, output, source.files, preview=preview, breakdown=breakdown)
    settings = {
        "layer": layer,
        "estimate": estimate,
        "aov": aov,
        "tile": tile,
        "threshold": threshold,
        "breakdown": breakdown is not None,
        "precision": denoiser.precision,
        "weights": hashlib.sha256(path.read_bytes()).hexdigest()[:16],
    }
    job = _Job(
        opened,
        output,
        denoiser,
        timings,
        source,
        command="denoise",
        preset=preset if weights is None else path.name,
        settings=settings,
        effects=(effects, no_effects),
        resume=resume,
        max_memory=max_memory,
        radius=denoiser.radius,
        neural=True,
    )
    with _last_pass(job, passes) as last:
        if breakdown is not None:
            denoiser.breakdown = Breakdown()
        _run(last)
    _preview(opened, output, preview)
    if breakdown is not None and denoiser.breakdown is not None:
        write_breakdown(opened, output, 2 * denoiser.radius + 1, breakdown)
        if denoiser.breakdown.pixels:
            title = "Weights in the frames made by this run"
            table = Table("frame", "average weight", "minimum", "maximum", title=title, title_justify="left")
            for row in denoiser.breakdown.rows():
                table.add_row(*row)
            Console().print(table)
        else:
            typer.echo("no weights to print: all frames were finished already")
        typer.echo(f"wrote {breakdown}")


@app.command()
def compare(
    shot: Annotated[
        str | None, typer.Argument(metavar="SHOT", help="shot.####.exr, shot.%04d.exr, a folder, or a file")
    ] = None,
    reference: Annotated[
        list[str] | None,
        typer.Option(help="the same frames at many samples; twice: two independent halves, whose noise cancels"),
    ] = None,
    output: Annotated[
        Path | None, typer.Option("-o", "--output", metavar="REPORT", help="folder for a page with chart and pictures")
    ] = None,
    methods: Annotated[str | None, typer.Option(help="names, separated by commas; all without")] = None,
    external: Annotated[
        list[str] | None,
        typer.Option(metavar="NAME=PATTERN", help="frames that another denoiser has finished; may be repeated"),
    ] = None,
    sweep: Annotated[bool, typer.Option("--sweep", help="also vary stages and settings, one at a time")] = False,
    rounds: Annotated[int, typer.Option(min=1, help="runs of each method, in turns, whose median is the time")] = 3,
    samples: Annotated[
        float | None, typer.Option(help="per pixel of SHOT, where its files do not tell, as those of Cycles do")
    ] = None,
    level: Annotated[
        list[str] | None,
        typer.Option(metavar="PATTERN=SPP", help="SHOT at other samples per pixel, to measure how noise falls"),
    ] = None,
    exposure: Annotated[float, typer.Option(help="factor before the tone curve of the measures")] = 1.0,
    clock: Annotated[
        str, typer.Option(help="wall or cpu: the time that chart.png and the Markdown table show")
    ] = "wall",
    markdown: Annotated[bool, typer.Option("--markdown", help="print the table of the README")] = False,
    name: Annotated[str | None, typer.Option(help="of the shot, in tables and on the page")] = None,
    beside: Annotated[
        list[Path] | None,
        typer.Option(metavar="REPORT", help="folder of a finished comparison of another shot, to be shown beside"),
    ] = None,
    frames: FramesOption = None,
    layer: LayerOption = None,
) -> None:
    """Show accuracy against time: the noisy input, every preset, and other denoisers, against a reference."""
    import tempfile

    from rich.console import Console
    from rich.progress import BarColumn, MofNCompleteColumn, Progress, TextColumn, TimeElapsedColumn

    from hybrid.compare import compare_shot, result_table
    from hybrid.report import report_images, write_report
    from hybrid.results import Comparison, Cost, join, markdown_table, read_comparison
    from hybrid.samples import samples_of

    costs: dict[str, Cost] = {"wall": "seconds_per_megapixel", "cpu": "cpu_seconds_per_megapixel"}
    cost = _choose(costs, clock, "clock")
    others = [read_comparison(folder / "results.json") for folder in beside or ()]
    if shot is None or not reference:
        if not others or shot is not None or reference:
            raise typer.BadParameter("expected SHOT and --reference, or --beside with finished comparisons")
        joined = Comparison(" + ".join(c.shot for c in others), tuple(join(others)), {})
        if output is not None:
            typer.echo(f"wrote {write_report(output, joined, others=others, cost=cost)}", err=True)
        _show(markdown, markdown_table(others, cost=cost), result_table(joined.results))
        return
    if len(reference) > 2:
        raise typer.BadParameter(f"--reference is given {len(reference)} times, expected once or twice")
    noisy, clean = _open(shot, frames, layer), [_open(spec, frames, None) for spec in reference]
    chosen = _methods(methods, external, frames)
    if sweep:
        from hybrid.methods import METHODS
        from hybrid.plan import plan_shot
        from hybrid.sweep import CLASSICAL, NETWORK, sweep_methods

        # Another object, since the frames it keeps would travel to every method's process.
        plan = plan_shot(_open(shot, frames, layer))
        chosen = {**chosen, **{base: METHODS[base] for base in (CLASSICAL, NETWORK)}, **sweep_methods(plan)}
    pairs = [_pair(item, "--level", "PATTERN=SPP") for item in level or ()]
    levels = [(_open(pattern, frames, None), _number(count, "--level")) for pattern, count in pairs]
    console = Console(stderr=True)
    columns = (TextColumn("{task.description}"), BarColumn(), MofNCompleteColumn(), TimeElapsedColumn())
    with tempfile.TemporaryDirectory() as folder, Progress(*columns, console=console) as progress:
        task = progress.add_task("compare")
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
            maps=output is not None,
            folder=Path(folder),
            progress=lambda what, done, total: progress.update(task, description=what, completed=done, total=total),
        )
        if output is not None:
            judged = [number for number in noisy.numbers if all(number in half.numbers for half in clean)]
            progress.update(task, description="write the page")
            images, truth = report_images(Path(folder), comparison, judged)
            page = write_report(output, comparison, images, truth, judged, others=others, exposure=exposure, cost=cost)
            console.print(f"wrote {page}", highlight=False)
    _show(markdown, markdown_table([comparison, *others], cost=cost), result_table(comparison.results))


def _show(markdown: bool, text: str, table: RichTable) -> None:
    """Print results as Markdown for a file, or as a table for a terminal."""
    from rich.console import Console

    if markdown:
        typer.echo(text, nl=False)
    else:
        Console().print(table)


def _methods(names: str | None, external: Sequence[str] | None, frames: str | None) -> dict[str, Method]:
    """The methods asked for, and sequences that others have finished."""
    from hybrid.methods import METHODS
    from hybrid.methods import external as finished

    wanted = METHODS if names is None else {n.strip(): _choose(METHODS, n.strip(), "methods") for n in names.split(",")}
    chosen = dict(wanted)
    for item in external or ():
        name, pattern = _pair(item, "--external", "NAME=PATTERN")
        if name in METHODS or name == "reference":
            raise typer.BadParameter(f"--external is {item!r}, expected a name that no other method has")
        chosen[name] = finished(_open(pattern, frames, None))
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


app.command("prepare")(prepare_command)
app.command("train")(train_command)
app.command("simulate")(simulate_command)


def _neural():  # type: ignore[no-untyped-def]
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


def _open(
    shot: str,
    frames: str | None,
    layer: Sequence[str] | None,
    aovs: Sequence[str] | None = None,
    *,
    max_pixels: int | None = None,
) -> Shot:
    from hybrid.exr import MAX_PIXELS
    from hybrid.frames import open_shot

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
        aovs=tuple(aovs or ()),
        keep=0,
        max_pixels=MAX_PIXELS if max_pixels is None else max_pixels,
    )
    for warning in opened.warnings:
        typer.echo(f"warning: {warning}", err=True)
    return opened


def _plan(shot: Shot, on: Sequence[str] | None, off: Sequence[str] | None) -> Plan:
    from hybrid.plan import plan_shot

    return plan_shot(shot).force(_split(on), _split(off))


def _spare_input(shot: Shot, output: str, estimates: Shot | None = None, **pictures: Path | None) -> None:
    """Refuse to write over a frame of the shot, or of estimates, before anything is made."""
    from hybrid.frames import output_path

    for number in shot.numbers:
        frame = output_path(output, shot, number)
        if estimates is not None and estimates.reads(frame):
            raise ValueError(f"output {str(frame)!r} would overwrite a frame of the estimate")
    for option, path in pictures.items():
        if path is not None and shot.reads(path):
            raise ValueError(f"{option} {str(path)!r} would overwrite an input frame")


def _fitting(shot: Shot, budget: str, estimate: str, plan: Plan, precision: str) -> str:
    """The most accurate preset that is measured to fit a time per frame, or the fastest; says what was measured."""
    from hybrid.budget import measure_presets, parse_budget

    neural, seconds = _neural(), parse_budget(budget)

    def load(preset: str) -> tuple[Estimator, int]:
        denoiser = neural.Denoiser(neural.shipped_weights(preset), precision=precision)
        return denoiser, denoiser.radius

    tried = []
    for measured in measure_presets(shot, plan.effects, "nlm" if estimate == "none" else estimate, load):
        tried.append(f"{measured.preset} {measured.seconds:.2g} s")
        fits = measured.seconds <= seconds
        if fits:
            break
    typer.echo(f"preset: {measured.preset} ({', '.join(tried)} a frame; {budget} asked for)", err=True)
    if not fits:
        typer.echo("warning: not even the fastest preset fits", err=True)
    return measured.preset


def _split(names: Sequence[str] | None) -> list[str]:
    """Names may be given one by one or separated by commas."""
    return [name for item in names or () for name in item.split(",")]


def _choose(table: dict[str, Thing], name: str, option: str) -> Thing:
    if name not in table:
        raise typer.BadParameter(f"--{option} is {name!r}, expected one of {', '.join(table)}")
    return table[name]


@dataclass(frozen=True)
class _Job:
    """What `pseudoref` and `denoise` have to say before frames can be made."""

    shot: Shot
    output: str
    estimator: Estimator
    timings: Timings
    source: EstimateSource
    command: str
    preset: str
    settings: Mapping[str, object]  # all options that the pixels depend on
    effects: tuple[Sequence[str] | None, Sequence[str] | None]  # forced on, forced off
    resume: bool
    max_memory: str | None
    radius: int = 2
    neural: bool = False


@contextmanager
def _last_pass(job: _Job, passes: int) -> Iterator[_Job]:
    """Make all passes but the last, in folders that go when the block ends; it is given what is left to run."""
    from hybrid.estimates import EstimateSource
    from hybrid.files import temporary_folder
    from hybrid.frames import output_path

    command = job.command
    home = output_path(job.output, job.shot, job.shot.numbers[0]).parent
    with ExitStack() as stack:
        for number in range(1, passes):
            folder = stack.enter_context(temporary_folder(home / f"pass{number}"))
            made = job.shot.around(job.radius * (passes - number))  # what the windows of later passes reach
            _run(replace(job, shot=made, output=str(folder), command=f"{command}, pass {number} of {passes}"))
            job = replace(
                job,
                shot=job.shot.remade({n: output_path(folder, made, n) for n in made.numbers}),
                source=EstimateSource("denoised", lambda frame: frame.color, "the pass before has made them"),
                command=f"{command}, pass {passes} of {passes}",
            )
        yield job


def _run(job: _Job) -> None:
    """Denoise the shot; stopped by Ctrl-C, say what is finished."""
    done: list[int] = []

    def report() -> None:
        count = f"{len(done)} of {len(job.shot)} frames are finished"
        last = f", the last is {done[-1]}" if done else ""
        typer.echo(f"\nstopped: {count}{last}; --resume goes on from there", err=True)

    try:
        with interruptible(report):
            _denoise(job, done)
    except KeyboardInterrupt:
        raise typer.Exit(INTERRUPTED) from None


def _denoise(job: _Job, done: list[int]) -> None:
    """Denoise with a progress bar, say what was met on the way, and leave the timings beside the output."""
    from rich.console import Console
    from rich.markup import escape
    from rich.progress import BarColumn, MofNCompleteColumn, Progress, TextColumn, TimeRemainingColumn
    from rich.table import Table

    from hybrid.memory import keep_freed_memory, parse_size, plan_rows
    from hybrid.pipeline import denoise_shot
    from hybrid.plan import Plan

    shot, source, timings = job.shot, job.source, job.timings
    limit = None if job.max_memory is None else parse_size(job.max_memory)
    if limit is None:
        keep_freed_memory()
    fit = (
        partial(plan_rows, limit, shot, estimate=source.estimate, radius=job.radius, neural=job.neural)
        if limit
        else None
    )
    if fit is not None:
        fit(Plan(()))  # refuses what can never be enough before frames are read to make a plan
    plan = _plan(shot, *job.effects)
    rows = None if fit is None else fit(plan)
    console = Console(stderr=True)
    console.print("stages: " + ", ".join(d.effect for d in plan.decisions if d.on), highlight=False)
    for decision in plan.decisions:
        if not decision.on:
            console.print(f"  not run: {decision.effect} ({decision.reason})", highlight=False)
    console.print(f"estimates: {source.name} ({source.reason})", highlight=False)
    attributes = {
        "ravg/command": job.command,
        "ravg/preset": job.preset,
        "ravg/estimate": source.name,
        "ravg/effects": " ".join(sorted(plan.effects)),
        "ravg/settings": json.dumps(job.settings, sort_keys=True),
    }
    pixels, outliers, resumed, finished = 0, 0, 0, None
    columns = (TextColumn("{task.description}"), BarColumn(), MofNCompleteColumn(), TimeRemainingColumn())
    with Progress(*columns, console=console) as progress:
        task = progress.add_task(job.command, total=len(shot))
        frames = denoise_shot(
            shot,
            job.output,
            job.estimator,
            plan,
            radius=job.radius,
            estimate=source.estimate,
            attributes=attributes,
            rows=rows,
            resume=job.resume,
            timings=timings,
        )
        for finished in frames:
            progress.advance(task)
            done.append(finished.number)
            resumed += finished.resumed
            pixels += finished.pixels
            outliers += finished.outliers
            if finished.repaired:
                console.print(f"frame {finished.number}: {finished.repaired} pixels were not finite, filled in")
            if finished.clamped:
                console.print(
                    f"frame {finished.number}: {finished.clamped} values too large for half, written as 65504"
                )
    if finished is None:
        return
    if resumed:
        console.print(f"{resumed} of {len(shot)} frames were finished already")
    table = Table("stage", "seconds", "s per megapixel-frame", "peak memory")
    for row in timings.rows(pixels):
        table.add_row(*row)
    console.print(table)
    folder = finished.path.parent
    timings.write(
        folder / "ravg.json",
        command=job.command,
        preset=job.preset,
        estimate=source.name,
        frames=len(shot),
        resumed=resumed,
        pixels=pixels,
        outliers=outliers,
        plan=[vars(decision) for decision in plan.decisions],
    )
    console.print(
        escape(f"wrote {len(shot) - resumed} frames to {folder} and their timings to {folder / 'ravg.json'}"),
        highlight=False,
    )


def _preview(shot: Shot, output: str, path: Path | None) -> None:
    """Write the preview if one is asked for, and say so."""
    from hybrid.pipeline import write_preview

    if path is not None:
        write_preview(shot, output, path)
        typer.echo(f"wrote {path}", err=True)


def main(argv: Sequence[str] | None = None) -> int:
    """Run the command; 0: done, 1: bad data (one line on standard error), 2: bad usage. A bug shows its traceback.

    Parameters
    ----------
    argv : sequence of str, optional
        Arguments; the process's own without.
    """
    try:
        app(args=None if argv is None else list(argv), prog_name="ravg")
    except SystemExit as stop:  # typer's way to return a code; it has shown usage errors itself
        return stop.code if isinstance(stop.code, int) else 0
    except (KeyboardInterrupt, SystemError) as error:
        if not is_interrupt(error):
            raise
        return INTERRUPTED
    except ModuleNotFoundError:
        raise  # a broken installation, not something optional that is missing
    except (ValueError, OSError, ImportError) as error:
        typer.echo(f"error: {_one_line(error)}", err=True)
        return 1
    return 0


def _one_line(error: Exception) -> str:
    if isinstance(error, OSError) and error.strerror and error.filename is not None:
        return _printable(f"{error.filename}: {error.strerror}")
    return _printable(" ".join(str(error).split()))


def _printable(words: str) -> str:
    """What a terminal shows as it is: a name from a file may hold sequences that command it."""
    return "".join(c if c.isprintable() else c.encode("unicode_escape").decode("ascii") for c in words)


if __name__ == "__main__":
    sys.exit(main())
