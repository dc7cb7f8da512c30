"""`ravg denoise`."""

import os
import shlex
import subprocess
import time
from collections.abc import Callable, Collection, Iterator, Mapping
from contextlib import contextmanager, suppress
from dataclasses import asdict, dataclass, replace
from functools import partial
from importlib.metadata import version
from pathlib import Path
from typing import Annotated, Any, NamedTuple

import numpy as np
import typer

from hybrid.checks.validation import Finding
from hybrid.commands import options as opt
from hybrid.commands import shots
from hybrid.commands.chunks import Chunk, arguments_of, run_jobs
from hybrid.commands.cluster import run_on_cluster
from hybrid.commands.log import LOG, Progress, duration, log_file, one_line, print_table, printable, summarize
from hybrid.denoising.first_pass import SPECS
from hybrid.denoising.plan import NEURAL_STAGES, Plan, merge
from hybrid.files.layers import summarize_layers
from hybrid.files.profile import ROLE_FACTS
from hybrid.files.sequences import format_frames
from hybrid.files.shots import Shot, output_path
from hybrid.run.job import DenoiseOptions, Job, Step, check_paths
from hybrid.run.memory import parse_size
from hybrid.run.pipeline import Failed, Finished
from hybrid.run.preview import check_png, check_preview, write_contact_sheet, write_preview
from hybrid.run.records import FOLDER, Record, read_records, record_path, sequence_name
from hybrid.runtime.interrupt import INTERRUPTED, interruptible
from hybrid.runtime.system import peak_memory
from hybrid.runtime.timing import Timings


@dataclass(frozen=True)
class Request:
    """The options of the command, of all views or of one."""

    shot: shots.ShotInput
    output: str
    options: DenoiseOptions
    preview: Path | None
    contact_sheet: Path | None
    fps: float

    def __post_init__(self) -> None:
        with opt.usage():
            if self.preview is not None:
                check_preview(self.preview)
            if self.contact_sheet is not None:
                check_png(self.contact_sheet, "contact-sheet")

    @property
    def further(self) -> dict[str, Path | None]:
        """Files that are written beside the frames."""
        return {"preview": self.preview, "contact-sheet": self.contact_sheet, "log-file": log_file()}

    def of_views(self) -> list[tuple[str, "Request"]]:
        """Return the stereo views, or "", each with its own request; BadParameter for names that all would share."""
        views, first_pass = shots.views_of(self.shot.shot), self.options.first_pass
        files = {
            "first-pass": None if first_pass in SPECS else first_pass,
            "preview": self.preview,
            "contact-sheet": self.contact_sheet,
            "breakdown": self.options.breakdown,
        }
        folders = {"output": self.output, "keep-first-pass": self.options.keep_first_pass}
        shots.expect_views_apart(views, self.shot, folders, files)
        return [(view, shots.in_view(self, view)) for view in views]


@opt.command("denoise", shots.ShotInput, DenoiseOptions)
def denoise(
    context: typer.Context,
    shot: str,
    output: Annotated[str, opt.check_output],
    aov: list[str] | None = None,
    preview: Path | None = None,
    fps: float = 24,
    contact_sheet: Path | None = None,
    stages: list[str] | None = None,
    no_stages: list[str] | None = None,
    device: opt.Device = "auto",
    scheduler: str | None = None,
    chunk: int = 10,
    jobs: int = 1,
    **settings: Any,
) -> None:
    """Denoise each view of a shot, in this process, in several, or on a cluster."""
    reading = opt.take(shots.ShotInput, settings)
    with opt.usage():
        options = DenoiseOptions(
            **settings,
            stages=shots.split_stages(stages),
            no_stages=shots.split_stages(no_stages),
            device=device,
            strict=reading["strict"],
        )
        if (scheduler is not None or jobs > 1) and (options.budget is not None or options.breakdown is not None):
            raise ValueError("--budget and --breakdown run in one process, expected neither --scheduler nor --jobs")
        if scheduler is not None and jobs > 1:
            raise ValueError("--jobs starts processes on this machine, expected it without --scheduler")
    source = shots.ShotInput(shot=shot, aovs=tuple(aov or ()), **reading)
    requests = Request(source, output, options, preview, contact_sheet, fps).of_views()
    if options.method == "network":
        shots.import_neural()
    failed = False
    for view, request in requests:
        if view:
            LOG.info(f"view {view}")
        try:
            if scheduler is not None:
                # A chunk that is run again, after its worker died, skips the frames that are finished.
                _denoise_in_chunks(
                    context, request, view, lambda _: chunk, {"resume": True}, partial(run_on_cluster, scheduler)
                )
            elif jobs > 1:
                # Chunks as long as possible: each computes its neighbours as well.
                limit = options.max_memory and f"{parse_size(options.max_memory) // jobs / 2**20:.3f}M"
                changes = {"max_memory": limit, "jobs": None}
                _denoise_in_chunks(
                    context, request, view, lambda count: -(-count // jobs), changes, partial(run_jobs, jobs)
                )
            else:
                _denoise(request)
        except typer.Exit as end:
            if not options.keep_going or end.exit_code == INTERRUPTED:
                raise
            failed = True
    if failed:
        raise typer.Exit(1)


def _denoise_in_chunks(
    context: typer.Context,
    request: Request,
    view: str,
    size_of: Callable[[int], int],
    changes: Mapping[str, object],
    run: Callable[[str, Mapping[str, Chunk]], None],
) -> None:
    """Denoise the shot, a chunk of its frames in a process, by this command with other parameters."""
    start = time.monotonic()
    shot = request.shot.open()
    check_paths(shot, request.output, request.options, further=request.further)
    _summarize_shot(request, shot.views[0])
    first = output_path(request.output, shot, shot.numbers[0])
    folder, name = first.parent, sequence_name(first)
    before = {path: record["started"] for path, record in read_records(folder, name)}
    size, chunks, paths = size_of(len(shot.numbers)), {}, []
    for begin in range(0, len(shot.numbers), size):
        part = shot.numbers[begin : begin + size]
        words = arguments_of(context, {**changes, "frames": format_frames(part)})
        chunks[format_frames(part)] = Chunk(shots.in_view(words, view), len(part))
        paths.append(record_path(folder, name, part))
    failed = None
    try:
        run(str(context.info_name), chunks)
    except typer.Exit as end:
        if not request.options.keep_going or end.exit_code == INTERRUPTED:
            raise
        failed = end
    new = {p: record for p, record in read_records(folder, name) if p in paths and record["started"] != before.get(p)}
    frames = {int(n): entry for path in paths if path in new for n, entry in new[path]["frames"].items()}
    frames |= {n: {"state": "failed"} for n in (*shot.missing, *(shot.numbers if failed else ())) if n not in frames}
    peak = max((record.get("peak_bytes", 0) for record in new.values()), default=0)
    cost = _Cost(time.monotonic() - start, peak, " per process")
    _finish(request, shot.views[0], frames, cost, str(folder / FOLDER))
    if failed:
        raise failed


def _denoise(request: Request) -> None:
    """Denoise a shot; leave a record beside the frames however it ends; stopped by Ctrl-C, log what is finished."""
    start = time.monotonic()
    shot = request.shot.open()
    job = Job.open(shot, request.output, request.options, request.further, _failure_on_record(request, shot))
    _summarize_shot(request, job.views[0])
    _summarize_job(job)
    shots.log_findings(job.report, job.views)
    first = output_path(request.output, shot, shot.numbers[0])
    record = Record(
        first.parent,
        sequence_name(first),
        sorted((*shot.numbers, *shot.missing)),
        command="denoise",
        input=request.shot.shot,
        output=request.output,
        preset=job.preset,
        options={**asdict(request.shot), **asdict(job.options), **job.settings},
        first_pass=job.first_pass,
    )
    for number in shot.missing:
        record.add(number, "failed", error="there is no such frame")

    def report() -> None:
        done = record.numbers("made", "there")
        count = f"{len(done)} of {len(shot)} frames are finished"
        last = f", the last is {done[-1]}" if done else ""
        LOG.error(f"stopped: {count}{last}; --resume goes on from there")
        record.write(job.timings, "stopped")

    try:
        with interruptible(report):
            _run(job, record)
    except KeyboardInterrupt:
        raise typer.Exit(INTERRUPTED) from None
    except Exception as error:
        words = one_line(error)
        if left := [number for number in shot.numbers if number not in record.frames]:
            record.add(left[0], "failed", error=words)  # frames are made in their order
        with suppress(OSError):  # on a full disk, say
            record.write(job.timings, "failed", error=words)
        raise
    record.write(job.timings, "finished")
    cost = _Cost(time.monotonic() - start, peak_memory())
    _finish(request, job.views[0], record.frames, cost, f"-v, or {record.path}", job)


@contextmanager
def _failure_on_record(request: Request, shot: Shot) -> Iterator[None]:
    """Leave a record of an error that comes before the first frame, but not over one that has frames."""
    try:
        yield
    except (ValueError, OSError) as error:
        with suppress(ValueError, OSError):  # an error of the output would hide this one
            first = output_path(request.output, shot, shot.numbers[0])
            name, spec = sequence_name(first), request.shot.shot
            record = Record(first.parent, name, shot.numbers, command="denoise", input=spec)
            documents = dict(read_records(first.parent, name))
            if not documents.get(record.path, {}).get("frames"):
                record.write(Timings(), "failed", error=one_line(error))
        raise


def _summarize_shot(request: Request, view: Shot) -> None:
    """Log what is read."""
    layers, (height, width) = view.layers(view.numbers[0]), view.shape
    samples = [] if layers.samples is None else [f"{layers.samples:g} samples per pixel"]
    numbers = f"{format_frames(view.numbers)} ({len(view.numbers)})"
    facts = [f"frames {numbers}", f"{width}×{height}", layers.profile, *samples]
    summarize("Input", f"{request.shot.shot}, {', '.join(facts)}")


def _summarize_job(job: Job) -> None:
    """Log the settings, the layers that are used, and what each frame starts from."""
    view, source = job.views[0], job.first_passes[0]
    layers = view.layers(view.numbers[0])
    method = "" if job.options.method == "network" else f"method {job.options.method}"
    computed = dict.fromkeys([*job.denoiser.devices.values(), source.device, job.denoiser.settings.get("precision")])
    parts = [f"ravg {version('ravg')}", method, f"preset {job.preset}", *map(str, filter(None, computed))]
    summarize("Settings", ", ".join(filter(None, parts)))
    used, missing = [], []
    for role, texts in ROLE_FACTS.items():
        name, layer = texts.get("summary"), getattr(layers, role)
        if name and layer is not None:
            used.append(f"{name} ({layer.file})" if layer.file else name)
        elif "without" in texts and layer is None:
            missing.append(f"{name} ({texts['without']})")
    summarize("Passes", "; without ".join([", ".join(used), *filter(None, [", ".join(missing)])]))
    later = f"; {job.first_pass} for the last" if job.options.passes > 1 else ""
    summarize("First pass", f"{source.name} ({source.reason}){later}")


class _Cost(NamedTuple):
    """The time of a run in seconds, and its peak memory in bytes, of what."""

    seconds: float
    peak: int
    of: str = ""


def _finish(
    request: Request,
    view: Shot,
    frames: Mapping[int, Mapping[str, Any]],
    cost: _Cost,
    details: str,
    job: Job | None = None,
) -> None:
    """Log what a run made of its frames (`Record.frames`), and write pictures; typer.Exit with 1 if a frame failed."""
    made, there, failed = ([n for n in frames if frames[n]["state"] == state] for state in ("made", "there", "failed"))
    if shining := [n for n in made if frames[n].get("fireflies")]:
        count = sum(frames[n]["fireflies"] for n in shining)
        summarize("Fireflies", f"{count} removed (frames {format_frames(shining)})")
    if there:
        summarize("Resumed", f"{len(there)} of {len(view)} frames were finished already")
    if made:
        names = sorted(output_path(request.output, view, n) for n in made)
        last = f" to {names[-1].name}" if len(made) > 1 else ""
        summarize("Output", f"{names[0]}{last} ({len(made)} frames)")
        each = f", {cost.seconds / len(made):.2g} s per frame"
        peak = f"peak memory {cost.peak / 2**20:.0f} MiB{cost.of}"
        summarize("Total", f"{duration(cost.seconds)}{each}, {peak}")
    command = ["ravg", "view", request.output, "--beside", request.shot.shot]
    summarize("Next", subprocess.list2cmdline(command) if os.name == "nt" else shlex.join(command))
    summarize("Details", details)
    _write_pictures(request, view, {*made, *there})
    if job is not None:
        _print_weights(job)
    if failed:
        LOG.error(f"frames not made: {format_frames(sorted(failed))}")
        raise typer.Exit(1)


class _Report:
    """Logs each finished frame, and writes it to the record."""

    def __init__(self, job: Job, record: Record) -> None:
        self.job, self.record = job, record
        self.findings: list[Finding] = list(job.report.findings)
        self.pixels = self.outliers = 0
        self.means: list[tuple[float, float]] = []  # radiance of each noisy frame, with and without its fireflies
        self.plans: dict[int, Plan] = {}
        self.lost: set[int] = set()  # frames that others were made without

    def add(self, frame: Finished | Failed) -> str:
        """Add a frame; return the message of the progress bar."""
        if isinstance(frame, Failed):
            message = one_line(frame.error)
            LOG.error(_describe(frame))
            self.record.add(frame.number, "failed", error=message)
            self.record.write(self.job.timings)
            return f"frame {frame.number} failed"
        self.pixels += frame.pixels
        self.outliers += frame.outliers
        if frame.plan is not None:
            self.plans[frame.number] = frame.plan
            self.findings += shots.log_cuts(frame.plan, self.findings, strict=False)
        light = frame.mean + frame.removed_radiance
        share = frame.removed_radiance / light if light > 0 else 0.0
        self._log(frame, share)
        facts: dict[str, object] = {"file": frame.path.name, "seconds": round(frame.seconds, 3)}
        if not frame.resumed:
            self.means.append((light, frame.mean))
            facts |= {"mean": light, "light_removed": share, "fireflies": frame.fireflies}
        stages = sorted(frame.plan.stages) if frame.plan else None
        self.record.add(frame.number, "there" if frame.resumed else "made", **facts, stages=stages)
        findings = [vars(finding) for finding in self.findings]
        self.record.write(self.job.timings, pixels=self.pixels, outliers=self.outliers, findings=findings)
        return f"frame {frame.number}{' was there' if frame.resumed else ''}"

    def _log(self, frame: Finished, share: float) -> None:
        name = f"frame {frame.number}"
        for other in frame.lost:
            if other.number not in self.lost:
                self.lost.add(other.number)
                LOG.warning(
                    f"{_describe(other)}; the frames beside it are made without it, "
                    "and again by --resume once it is whole"
                )
        if frame.again:
            LOG.info(f"{name} is made again: {printable(frame.again)}")
        if frame.fireflies:
            LOG.debug(f"{name}: {frame.fireflies} fireflies removed, {share:.2%} of its light")
        if frame.repaired:
            lost = f"{name}: {frame.repaired} pixels were not finite or beyond 1e14, filled in from neighbours"
            LOG.warning(f"{lost}; check the render")
        if frame.clamped:
            LOG.warning(f"{name}: {frame.clamped} values too large for half, written as 65504; 32-bit input keeps them")

    def finish(self) -> None:
        """Log which stages ran, and a table of seconds and memory."""
        merged = merge(self.plans) if self.plans else None
        plan = () if merged is None else merged.decisions
        with_fireflies, without = np.mean(self.means, axis=0).tolist() if self.means else (None, None)
        mean = {"with_fireflies": with_fireflies, "without": without}
        timings = self.job.timings
        self.record.write(timings, plan=[vars(decision) for decision in plan], mean=mean)
        for decision in plan:
            if self.job.options.method == "network" or decision.stage not in NEURAL_STAGES:
                LOG.debug(f"  {'run' if decision.on else 'not run'}: {decision.stage} ({decision.reason})")
        if merged is not None:
            shots.log_noise(merged)
        LOG.debug(timings.table(self.pixels), extra={"facts": {"stages": timings.figures()}})


def _run(job: Job, record: Record) -> None:
    """Denoise; log progress, and everything that happens to a frame."""
    view = job.views[0]
    roles = view.layers(view.numbers[0])
    layers = summarize_layers(roles)
    LOG.debug(printable(f"layers: {layers}"))
    messages = [finding.message for finding in job.report.findings if not finding.warning]
    for note in (*roles.notes, *messages, *view.recompressed_parts(job.views[1:])):
        summarize("Note", note)
    findings = [vars(finding) for finding in job.report.findings]
    record.write(job.timings, layers=layers, warnings=view.warnings, findings=findings)
    report, bar = _Report(job, record), Progress("denoise", job.total())

    def advance(step: Step) -> None:
        number = step.result.number
        if step.run < step.runs:
            bar.advance(message=f"frame {number} of pass {step.run} of {step.runs}", frame=number)
            return
        facts: dict[str, object] = {"frame": number}
        if isinstance(step.result, Finished):
            facts |= {"seconds": round(step.result.seconds, 3), "path": str(step.result.path)}
        bar.advance(1, report.add(step.result), **facts)

    for _ in job.run(advance):
        pass
    report.finish()


def _print_weights(job: Job) -> None:
    """Print the weights of the frames of the window, if a breakdown was asked for."""
    if job.breakdown is None:
        return
    if job.breakdown.pixels:
        title = "Weights in the frames made by this run"
        print_table(("frame", "average weight", "minimum", "maximum"), job.breakdown.rows(), title)
    else:
        LOG.info("no weights to print: all frames were finished already")
    LOG.info(f"wrote {job.options.breakdown}")


def _write_pictures(request: Request, shot: Shot, finished: Collection[int]) -> None:
    """Write the preview and the contact sheet of the frames that are made, if any is."""
    shot = replace(shot, numbers=tuple(number for number in shot.numbers if number in finished))
    if request.preview is not None and shot.numbers:
        write_preview(shot, request.output, request.preview, rate=request.fps)
        LOG.info(f"wrote {request.preview}")
    if request.contact_sheet is not None and shot.numbers:
        write_contact_sheet(shot, request.output, request.contact_sheet)
        LOG.info(f"wrote {request.contact_sheet}")


def _describe(frame: Failed) -> str:
    """The error of a frame with its number, which the error may name itself."""
    name = f"frame {frame.number}: "
    return name + one_line(frame.error).removeprefix(name)
