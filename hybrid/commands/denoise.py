"""`ravg denoise` and `ravg pseudoref`: with the network, and without."""

from __future__ import annotations

import hashlib
from collections.abc import Iterator, Mapping, Sequence
from contextlib import ExitStack, contextmanager, suppress
from dataclasses import asdict, dataclass, replace
from functools import partial
from pathlib import Path
from typing import TYPE_CHECKING, Annotated, Literal

import typer

from hybrid.commands.cluster import Chunk, ChunkOption, SchedulerOption, arguments_of, run_on_cluster
from hybrid.commands.log import LOG, Progress, log_file, one_line, print_table, printable
from hybrid.commands.options import (
    OUTPUT,
    RESOURCES,
    WHAT,
    AovOption,
    DeviceOption,
    EstimateOption,
    FramesOption,
    KeepGoingOption,
    KeepOption,
    LayerOption,
    MemoryOption,
    MotionOption,
    OffOption,
    OnOption,
    OutputOption,
    PixelsOption,
    PreviewOption,
    ProfileOption,
    RateOption,
    ResumeOption,
    SheetOption,
    ShotArgument,
    StrictOption,
    each_view,
    import_neural,
    judge_input,
    open_input,
    rules_of,
    say_cuts,
    usage,
)
from hybrid.runtime.interrupt import INTERRUPTED, interruptible

if TYPE_CHECKING:
    from hybrid.estimates import EstimateSource
    from hybrid.files.shots import Shot
    from hybrid.pipeline import SourcesOf
    from hybrid.plan import Rules
    from hybrid.records import Record
    from hybrid.runtime.timing import Timings
    from hybrid.steady import DenoiseWindow
    from hybrid.validation import ValidationReport


def pseudoref(
    context: typer.Context,
    shot: ShotArgument,
    output: OutputOption,
    frames: FramesOption = None,
    layer: LayerOption = None,
    profile: ProfileOption = None,
    motion: MotionOption = None,
    strict: StrictOption = False,
    preset: Annotated[
        Literal["draft", "standard", "final", "gathered"],
        typer.Option(
            help="of our own estimate; or gathered, the best: samples meet along the motion, and OIDN denoises them "
            "once more (pyoidn; --estimate is oidn-fast if not given)",
            rich_help_panel=WHAT,
        ),
    ] = "standard",
    estimate: EstimateOption = "none",
    keep_estimates: KeepOption = None,
    preview: PreviewOption = None,
    fps: RateOption = 24,
    contact: SheetOption = None,
    stages: OnOption = None,
    no_stages: OffOption = None,
    device: DeviceOption = "auto",
    resume: ResumeOption = False,
    keep_going: KeepGoingOption = False,
    max_memory: MemoryOption = None,
    max_pixels: PixelsOption = None,
    scheduler: SchedulerOption = None,
    chunk: ChunkOption = 10,
) -> None:
    """Denoise without a network: align, average, non-local means, guided filter. Makes training targets too.

    With --estimate, pictures that are denoised already, each by itself, are made stable instead.
    """
    given = dict(locals())
    if each_view(pseudoref, given):
        return
    from hybrid.estimates import choose_estimate
    from hybrid.oidn import find_device
    from hybrid.plan import NEURAL_STAGES
    from hybrid.pseudo_reference import CLASSICAL_PRESETS, FINAL, gated_average, gather_and_denoise
    from hybrid.pseudo_reference import filter_window as estimate_centre
    from hybrid.runtime.timing import Timings
    from hybrid.steady import Denoised

    rules = rules_of(stages, no_stages)
    if neural := rules.on & NEURAL_STAGES:
        raise typer.BadParameter(f"--stages: {min(neural)} is a stage of the network, expected one that pseudoref has")
    rules = replace(rules, off=rules.off | NEURAL_STAGES)
    chosen = CLASSICAL_PRESETS.get(preset, FINAL)
    gathers = preset == "gathered"
    if gathers and estimate == "none":
        estimate = "oidn-fast"
    opened = open_input(shot, frames, layer, profile=profile, motion=motion, max_pixels=max_pixels)
    _expect_all(opened, keep_going)
    if scheduler is not None:
        _spare_inputs(opened, output, (), {"profile": profile}, preview=preview, contact=contact)
        _hand_out(context, given, opened, scheduler, chunk)
        _look(opened.views[0], output, preview, fps, contact)
        return
    with _on_record(context, shot, opened, output):
        _expect_memory(opened, max_memory)
        (opened, *others), judgement = _judge(opened, strict=strict)
    timings = Timings()
    choose = partial(choose_estimate, estimate, own=chosen, kept=keep_estimates, forced=rules.forced, device=device)
    source, beside = choose(opened), [(other, choose(other)) for other in others]
    sources = [source, *(theirs for _, theirs in beside)]
    _spare_inputs(opened, output, sources, {"profile": profile}, preview=preview, contact=contact)
    if source.estimates is None:
        make = partial(estimate_centre, preset=chosen, timings=timings)
    else:
        make = partial(gated_average, timings=timings)
    second_look = find_device(device) if gathers else None
    if second_look is not None:
        make = partial(gather_and_denoise, device=second_look, timings=timings)
    _run(
        Job(
            shot,
            opened,
            output,
            lambda aligned: Denoised(make(aligned)),
            timings,
            source,
            command="pseudoref",
            preset=preset,
            settings={
                "layer": layer,
                "profile": profile,
                "motion": motion,
                "estimate": estimate,
                "device": {"oidn": where} if (where := second_look or source.device) else {},
            },
            rules=rules,
            resume=resume,
            keep_going=keep_going,
            max_memory=max_memory,
            judgement=judgement,
            gathers=gathers,
            others=beside,
        )
    )
    _look(opened, output, preview, fps, contact)


def denoise(
    context: typer.Context,
    shot: ShotArgument,
    output: OutputOption,
    frames: FramesOption = None,
    layer: LayerOption = None,
    profile: ProfileOption = None,
    motion: MotionOption = None,
    strict: StrictOption = False,
    preset: Annotated[
        Literal["fast", "balanced", "quality", "tkpcn", "auto"],
        typer.Option(
            metavar="NAME",
            help="of the weights that come with ravg: fast, balanced, quality or tkpcn; or auto, with --budget",
            rich_help_panel=WHAT,
        ),
    ] = "fast",
    budget: Annotated[
        str | None,
        typer.Option(
            metavar="TIME",
            help="per frame, such as 10s: the most accurate preset that fits it",
            rich_help_panel=WHAT,
        ),
    ] = None,
    weights: Annotated[
        Path | None,
        typer.Option(metavar="FILE", help="weights of your own, instead of a preset", rich_help_panel=WHAT),
    ] = None,
    threshold: Annotated[
        float | None,
        typer.Option(
            min=0,
            max=0.99,
            metavar="SHARE",
            help="higher keeps fewer frames or taps: closer to the one frame",
            rich_help_panel=WHAT,
        ),
    ] = None,
    estimate: EstimateOption = "auto",
    keep_estimates: KeepOption = None,
    passes: Annotated[
        int,
        typer.Option(
            min=1,
            metavar="N",
            help="run again on the result: a wider window in time, a softer picture; --resume leaves alone frames of "
            "the last pass",
            rich_help_panel=WHAT,
        ),
    ] = 1,
    breakdown: Annotated[
        Path | None,
        typer.Option(
            metavar="PNG",
            help="a picture of what each frame contributes, with layers and figures of it",
            rich_help_panel=OUTPUT,
        ),
    ] = None,
    aov: AovOption = None,
    give_way: Annotated[
        Literal["layers", "beauty"],
        typer.Option(
            help="where layers (--aov) are parts of the light: they are shared out of the denoised beauty, or it is "
            "their sum",
            rich_help_panel=WHAT,
        ),
    ] = "layers",
    preview: PreviewOption = None,
    fps: RateOption = 24,
    contact: SheetOption = None,
    stages: OnOption = None,
    no_stages: OffOption = None,
    tile: Annotated[
        int | None,
        typer.Option(
            min=16,
            metavar="N",
            help="pixels on a side that the network sees at once; without: 640 or 2048, with --max-memory 384",
            rich_help_panel=RESOURCES,
        ),
    ] = None,
    precision: Annotated[
        Literal["auto", "float32", "bfloat16"],
        typer.Option(envvar="RAVG_PRECISION", help="of the network", rich_help_panel=RESOURCES),
    ] = "auto",
    device: DeviceOption = "auto",
    resume: ResumeOption = False,
    keep_going: KeepGoingOption = False,
    max_memory: MemoryOption = None,
    max_pixels: PixelsOption = None,
    scheduler: SchedulerOption = None,
    chunk: ChunkOption = 10,
) -> None:
    """Denoise with the Robust Average network."""
    given = dict(locals())
    if each_view(denoise, given):
        return
    neural = import_neural()
    from rich.console import Console
    from rich.table import Table

    from hybrid.breakdown import Breakdown, write_breakdown
    from hybrid.estimates import MODE_OF, OIDN_MODES, EstimateSource, choose_estimate
    from hybrid.pipeline import reach_of
    from hybrid.runtime.timing import Timings

    if breakdown is not None and max_memory is not None:
        raise typer.BadParameter("--breakdown looks at whole frames, expected no --max-memory with it")
    opened = open_input(shot, frames, layer, aov, profile=profile, motion=motion, max_pixels=max_pixels)
    _expect_all(opened, keep_going)
    if scheduler is not None:
        if budget is not None or breakdown is not None:
            raise typer.BadParameter("--budget and --breakdown are of one machine, expected no --scheduler with them")
        inputs = {"weights": weights, "profile": profile}
        _spare_inputs(opened, output, (), inputs, preview=preview, contact=contact)
        _hand_out(context, given, opened, scheduler, chunk)
        _look(opened.views[0], output, preview, fps, contact)
        return
    with _on_record(context, shot, opened, output):
        _expect_memory(opened, max_memory)
        (opened, *others), judgement = _judge(opened, strict=strict)
        if give_way == "beauty":
            _expect_sum((opened, *others))
    timings = Timings()
    if (preset == "auto") != (budget is not None) or (weights is not None and budget is not None):
        raise typer.BadParameter("--budget chooses the preset, expected it with --preset auto, and without --weights")
    chosen: str = preset
    rules = rules_of(stages, no_stages)
    if budget is not None:
        chosen = _fitting(opened, budget, estimate, rules, precision, device)
    path = weights or neural.shipped_weights(chosen)
    if tile is None and max_memory is not None:
        tile = neural.SMALL_TILE
    denoiser = neural.Denoiser(
        path,
        tile=tile,
        precision=precision,
        device=device,
        threshold=threshold,
        add_layers=give_way == "beauty",
        timings=timings,
    )
    mode = "oidn-clean" if weights is not None else MODE_OF.get(chosen, "oidn-clean")
    if denoiser.takes_estimate:
        # From the noisy frames alone, such a network works beside our own.
        wanted = "nlm" if estimate == "none" else estimate
        ahead = reach_of(None, denoiser.radius, rules) * (passes - 1)  # what the first pass makes
        choose = partial(
            choose_estimate,
            wanted,
            mode=mode,
            quicker=denoiser.quicker,
            bundled=neural.denoise_bundled,
            kept=keep_estimates,
            forced=rules.forced,
            device=device,
        )
        source = choose(opened.with_neighbours(ahead))
        beside = [(other, choose(other.with_neighbours(ahead))) for other in others]
    elif estimate in ("auto", "none"):
        source = EstimateSource("none", None, "this network takes none")
        beside = [(other, source) for other in others]
    else:
        raise ValueError(f"estimate is {estimate!r}, expected auto or none: the network of {path.name} takes none")
    inputs = {"weights": path, "profile": profile}
    sources = [source, *(theirs for _, theirs in beside)]
    _spare_inputs(opened, output, sources, inputs, preview=preview, contact=contact, breakdown=breakdown)
    bundled = neural.bundled_preset(OIDN_MODES[mode]["quality"])
    settings = {
        "layer": layer,
        "profile": profile,
        "motion": motion,
        "estimate": estimate,
        "aov": aov,
        "give_way": give_way,
        "tile": denoiser.tile,
        "threshold": threshold,
        "breakdown": breakdown is not None,
        "precision": denoiser.precision,
        "weights": _digest(path),
        **({"bundled": _digest(neural.shipped_weights(bundled))} if source.name == "bundled" else {}),
        "device": {"network": denoiser.device, **({"oidn": source.device} if source.device else {})},
    }
    job = Job(
        shot,
        opened,
        output,
        denoiser,
        timings,
        source,
        command="denoise",
        preset=chosen if weights is None else path.name,
        settings=settings,
        rules=rules,
        resume=resume,
        keep_going=keep_going,
        max_memory=max_memory,
        judgement=judgement,
        others=beside,
        radius=denoiser.radius,
        network=denoiser.holds(opened.shape),
    )
    counted = Breakdown()
    with _last_pass(job, passes) as last:
        _run(last if breakdown is None else replace(last, denoise=denoiser.counting(counted)))
    _look(opened, output, preview, fps, contact)
    if breakdown is not None:
        write_breakdown([opened, *others], output, 2 * denoiser.radius + 1, breakdown)
        if counted.pixels:
            title = "Weights in the frames made by this run"
            table = Table("frame", "average weight", "minimum", "maximum", title=title, title_justify="left")
            for row in counted.rows():
                table.add_row(*row)
            Console().print(table)
        else:
            LOG.info("no weights to print: all frames were finished already")
        LOG.info(f"wrote {breakdown}")


def _digest(path: Path) -> str:
    """What tells a file of weights from another."""
    return hashlib.sha256(path.read_bytes()).hexdigest()[:16]


def _spare_inputs(
    shot: Shot,
    output: str,
    sources: Sequence[EstimateSource],
    inputs: Mapping[str, str | Path | None],
    **pictures: Path | None,
) -> None:
    """Refuse, before anything is made, to write over anything that is read, and what is no preview."""
    from hybrid.pipeline import check_written
    from hybrid.preview import check_png, check_preview

    check_written(shot, output, sources, inputs, {**pictures, "log-file": log_file()})
    with usage():
        if (preview := pictures.get("preview")) is not None:
            check_preview(preview)
        for what in ("contact", "breakdown"):
            if (picture := pictures.get(what)) is not None:
                check_png(picture, what)


def _hand_out(context: typer.Context, given: Mapping[str, object], shot: Shot, scheduler: str, size: int) -> None:
    """Let a cluster denoise the shot, a chunk of its frames at a time."""
    from hybrid.files.sequences import format_frames

    parts = [shot.numbers[start : start + size] for start in range(0, len(shot.numbers), size)]
    names = {format_frames(part): len(part) for part in parts}
    # A chunk that is run again, as a worker has died, leaves alone what was finished.
    chunks = {
        name: Chunk(arguments_of(context, {**given, "frames": name, "resume": True}), count)
        for name, count in names.items()
    }
    run_on_cluster(scheduler, str(context.info_name), chunks)
    if shot.missing:
        LOG.error(f"frames {format_frames(shot.missing)} were asked for and are not there")
        raise typer.Exit(1)


def _judge(shot: Shot, *, strict: bool) -> tuple[tuple[Shot, ...], ValidationReport]:
    """The pictures of the shot as `judge_input` has them; if `strict`, cuts are looked for too before any is made."""
    from hybrid.plan import plan_shot

    pictures, judgement = judge_input(shot, strict=strict)
    if strict:
        for picture in pictures:
            say_cuts(plan_shot(picture), judgement.findings, strict=True)
    return pictures, judgement


def _expect_sum(pictures: Sequence[Shot]) -> None:
    """Refuse to make a beauty of layers that do not add up to it."""
    from hybrid.files.passes import BEAUTY

    for picture in pictures:
        passes = picture.passes
        if picture.aovs and not any(found.whole == BEAUTY and found.complete for found in passes.sums):
            raise ValueError(
                f"{picture.path(picture.numbers[0])}: --give-way beauty: no layers add up to the beauty, all of them "
                f"together have {passes.light:.2f} times its light, expected layers of which it is the sum"
            )


@contextmanager
def _on_record(context: typer.Context, spec: str, shot: Shot, output: str) -> Iterator[None]:
    """Leave a record of what has failed before the first frame."""
    from hybrid.files.shots import output_path
    from hybrid.records import Record, sequence_name
    from hybrid.runtime.timing import Timings

    try:
        yield
    except (ValueError, OSError) as error:
        with suppress(ValueError, OSError):  # what is wrong with the output, if anything, is not what is to be said
            first = output_path(output, shot, shot.numbers[0])
            record = Record(first.parent, sequence_name(first), shot.numbers, command=context.info_name, input=spec)
            record.write(Timings(), "failed", error=one_line(error))
        raise


def _expect_all(shot: Shot, keep_going: bool) -> None:
    """Refuse to begin where a frame that was asked for is not there."""
    from hybrid.files.sequences import format_frames

    if shot.missing and not keep_going:
        missing = format_frames(shot.missing)
        raise FileNotFoundError(f"frames {missing} were asked for and are not there; --keep-going makes the others")


def _expect_memory(shot: Shot, max_memory: str | None) -> None:
    """Refuse, before any pixel is read, what is too little memory whatever runs; `_denoise` knows what does."""
    from hybrid.memory import parse_size, plan_rows

    if max_memory is not None:
        plan_rows(parse_size(max_memory), shot, ())


def _fitting(shot: Shot, budget: str, estimate: str, rules: Rules, precision: str, device: str) -> str:
    """The most accurate preset that is measured to fit a time per frame, or the fastest; says what was measured."""
    from hybrid.budget import measure_presets, parse_budget

    neural = import_neural()
    with usage():
        seconds = parse_budget(budget)

    def load(preset: str) -> tuple[DenoiseWindow, int]:
        denoiser = neural.Denoiser(neural.shipped_weights(preset), precision=precision, device=device)
        return denoiser, denoiser.radius

    tried = []
    for measured in measure_presets(shot, rules, "nlm" if estimate == "none" else estimate, load, device):
        tried.append(f"{measured.preset} {measured.seconds:.2g} s")
        fits = measured.seconds <= seconds
        if fits:
            break
    LOG.info(f"preset: {measured.preset} ({', '.join(tried)} a frame; {budget} asked for)")
    if not fits:
        LOG.warning("not even the fastest preset fits")
    return measured.preset


@dataclass(frozen=True)
class Job:
    """What `pseudoref` and `denoise` have to say before frames can be made."""

    input: str
    shot: Shot
    output: str
    denoise: DenoiseWindow
    timings: Timings
    source: EstimateSource
    command: str
    preset: str
    settings: Mapping[str, object]  # all options that the pixels depend on
    rules: Rules
    resume: bool
    keep_going: bool
    max_memory: str | None
    judgement: ValidationReport
    others: Sequence[tuple[Shot, EstimateSource]] = ()
    radius: int = 2
    network: int | None = None  # bytes that the network takes while it runs, if one does
    gathers: bool = False  # samples of the window, which OIDN then denoises
    before: SourcesOf | None = None  # what the shot was made from, if a pass has made it


@contextmanager
def _last_pass(job: Job, passes: int) -> Iterator[Job]:
    """Make all passes but the last, in folders that go when the block ends; it is given what is left to run."""
    from hybrid.estimates import OfFrames
    from hybrid.files.replace import temporary_folder
    from hybrid.files.shots import output_path
    from hybrid.pipeline import reach_of, sources_of

    command, given = job.command, OfFrames(lambda frame: frame.color)
    home = output_path(job.output, job.shot, job.shot.numbers[0]).parent
    with ExitStack() as stack:
        for number in range(1, passes):
            folder = stack.enter_context(temporary_folder(home / f"pass{number}"))
            reach = reach_of(None, job.radius, job.rules) * (passes - number)  # what later passes reach
            made = job.shot.with_neighbours(reach)
            early = replace(job, shot=made, output=str(folder), keep_going=False)
            _run(replace(early, command=f"{command}, pass {number} of {passes}"))
            files = {n: output_path(folder, made, n) for n in made.numbers}
            pictures = [(job.shot, job.source), *job.others]
            (again, source), *others = (
                (picture.reopened(files), replace(theirs, estimates=given, reason="the pass before"))
                for picture, theirs in pictures
            )
            job = replace(
                job,
                shot=again,
                source=source,
                others=others,
                command=f"{command}, pass {passes} of {passes}",
                before=sources_of(
                    [(shot, theirs.estimates) for shot, theirs in pictures], job.radius, job.rules, job.before
                ),
            )
        yield job


def _run(job: Job) -> None:
    """Denoise the shot; leave a record beside the frames however it ends; stopped by Ctrl-C, say what is finished."""
    from hybrid.files.sequences import format_frames
    from hybrid.files.shots import output_path
    from hybrid.records import Record, sequence_name

    first = output_path(job.output, job.shot, job.shot.numbers[0])
    record = Record(
        first.parent,
        sequence_name(first),
        sorted((*job.shot.numbers, *job.shot.missing)),
        command=job.command,
        input=job.input,
        output=job.output,
        preset=job.preset,
        options=job.settings,
        estimate=job.source.name,
    )
    for number in job.shot.missing:
        record.add(number, "failed", error="there is no such frame")

    def report() -> None:
        count = f"{len(record.done)} of {len(job.shot)} frames are finished"
        last = f", the last is {record.done[-1]}" if record.done else ""
        LOG.error(f"stopped: {count}{last}; --resume goes on from there")
        record.write(job.timings, "stopped")

    try:
        with interruptible(report):
            _denoise(job, record)
    except KeyboardInterrupt:
        raise typer.Exit(INTERRUPTED) from None
    except Exception as error:
        if not isinstance(error, typer.BadParameter):
            with suppress(OSError):  # on a full disk, say
                record.write(job.timings, "failed", error=one_line(error))
        raise
    record.write(job.timings, "finished")
    if there := len(record.done) - len(record.made):
        LOG.info(f"{there} of {len(job.shot)} frames were finished already")
    LOG.info(f"wrote {len(record.made)} frames to {first.parent} and a record of them to {record.path}")
    if record.failed:
        LOG.error(f"{len(record.failed)} frames could not be made: {format_frames(record.failed)}")
        raise typer.Exit(1)


def _denoise(job: Job, record: Record) -> None:
    """Denoise; say how far it has come, and what was met on the way."""
    import numpy as np
    from rich.table import Table

    from hybrid.files.layers import summarize_layers
    from hybrid.memory import parse_size, plan_rows
    from hybrid.pipeline import Failed, denoise_frames, describe_run
    from hybrid.plan import NEURAL_STAGES, Plan, merge
    from hybrid.runtime.allocator import reuse_freed_memory

    shot, source, timings = job.shot, job.source, job.timings
    with usage():
        limit = None if job.max_memory is None else parse_size(job.max_memory)
    if limit is None:
        reuse_freed_memory()
    rules = job.rules
    rows = None
    if limit is not None:
        rows = plan_rows(
            limit // (1 + len(job.others)),
            shot,
            rules.allowed,
            source.estimates,
            radius=job.radius,
            network=job.network,
            gathers=job.gathers,
        )
    taken = shot.layers(shot.numbers[0])
    layers = summarize_layers(taken)
    said = [finding.message for finding in job.judgement.findings if not finding.warning]
    for words in (f"layers: {layers}", *taken.notes, *said, *shot.recompressed_parts(other for other, _ in job.others)):
        LOG.info(printable(words))
    LOG.info(f"estimates: {source.name} ({source.reason})")
    # Not where things lie: what was read from there is told by the files and layers that each picture was made from.
    elsewhere = ("profile", "estimate" if source.files else "")
    settings = {name: value for name, value in job.settings.items() if name not in elsewhere}
    attributes = describe_run(job.command, job.preset, source, rules, settings, neural=job.network is not None)
    judged = list(job.judgement.findings)
    judgement = [vars(finding) for finding in judged]
    record.write(timings, layers=layers, warnings=shot.warnings, judged=judgement)
    pixels, outliers = 0, 0
    means: list[tuple[float, float]] = []  # radiance of each noisy frame, as rendered and without its fireflies
    plans: dict[int, Plan] = {}
    progress = Progress(job.command, len(shot))
    frames = denoise_frames(
        shot,
        job.output,
        job.denoise,
        rules,
        radius=job.radius,
        estimates=source.estimates,
        others=[(picture, theirs.estimates) for picture, theirs in job.others],
        attributes=attributes,
        rows=rows,
        beside=limit is None,
        resume=job.resume,
        keep_going=job.keep_going,
        timings=timings,
        before=job.before,
    )
    for finished in frames:
        if isinstance(finished, Failed):
            words = one_line(finished.error)
            LOG.error(f"frame {finished.number}: {words}")
            record.add(finished.number, "failed", error=words)
            record.write(timings)
            progress.advance(message=f"frame {finished.number} failed", frame=finished.number)
            continue
        pixels += finished.pixels
        outliers += finished.outliers
        if finished.plan is not None:
            plans[finished.number] = finished.plan
            judged += say_cuts(finished.plan, judged, strict=False)
        if finished.again:
            LOG.info(f"frame {finished.number} is made again: {printable(finished.again)}")
        light = finished.mean + finished.removed_radiance
        share = finished.removed_radiance / light if light > 0 else 0.0
        if finished.fireflies:
            LOG.info(f"frame {finished.number}: {finished.fireflies} fireflies taken out, {share:.2%} of its light")
        if finished.repaired:
            LOG.warning(f"frame {finished.number}: {finished.repaired} pixels were not finite, filled in")
        if finished.clamped:
            LOG.warning(f"frame {finished.number}: {finished.clamped} values too large for half, written as 65504")
        seconds = round(finished.seconds, 3)
        state, words = ("there", "was there") if finished.resumed else ("made", f"{seconds:.1f} s")
        facts: dict[str, object] = {"file": finished.path.name, "seconds": seconds}
        if not finished.resumed:
            means.append((light, finished.mean))
            facts |= {"mean": light, "light_removed": share}
        stages = sorted(finished.plan.stages) if finished.plan else None
        record.add(finished.number, state, **facts, stages=stages)
        record.write(timings, pixels=pixels, outliers=outliers, judged=[vars(finding) for finding in judged])
        message = f"frame {finished.number} {words}"
        progress.advance(message=message, frame=finished.number, seconds=seconds, path=str(finished.path))
    plan = merge(plans).decisions if plans else ()
    with_fireflies, without = np.mean(means, axis=0).tolist() if means else (None, None)
    means_of_shot = {"with_fireflies": with_fireflies, "without": without}
    record.write(timings, plan=[vars(decision) for decision in plan], mean=means_of_shot)
    for decision in plan:
        if job.network is not None or decision.stage not in NEURAL_STAGES:
            LOG.info(f"  {'run' if decision.on else 'not run'}: {decision.stage} ({decision.reason})")
    table = Table("stage", "seconds", "s per megapixel-frame", "peak memory")
    for row in timings.rows(pixels):
        table.add_row(*row)
    print_table(table, stages={name: asdict(stage) for name, stage in timings.stages.items()})


def _look(shot: Shot, output: str, preview: Path | None, fps: float, contact: Path | None) -> None:
    """Write the preview and the sheet that are asked for, and say so."""
    from hybrid.preview import write_contact_sheet, write_preview

    if preview is not None:
        write_preview(shot, output, preview, rate=fps)
        LOG.info(f"wrote {preview}")
    if contact is not None:
        write_contact_sheet(shot, output, contact)
        LOG.info(f"wrote {contact}")
