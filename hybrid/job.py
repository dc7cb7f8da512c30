"""Denoise a shot: one description of what is asked for, and one way to run it.

The command, the Python API, chunks on a cluster and ``--resume`` all go through `open_job` and `run_job`.
"""

from __future__ import annotations

import hashlib
import json
import logging
import re
import warnings
from collections.abc import Callable, Collection, Iterator, Mapping, Sequence
from contextlib import AbstractContextManager, ExitStack, nullcontext
from dataclasses import dataclass, fields, replace
from pathlib import Path
from types import ModuleType

from hybrid.breakdown import Breakdown, write_breakdown
from hybrid.budget import measure_presets, parse_budget
from hybrid.denoisers import AverageDenoiser, ClassicalDenoiser, PooledDenoiser, WindowDenoiser
from hybrid.files.passes import BEAUTY
from hybrid.files.replace import temporary_folder
from hybrid.files.sequences import format_frames
from hybrid.files.shots import Shot, output_path
from hybrid.files.sources import PACKAGES, versions
from hybrid.first_pass import OIDN_MODE_OF_PRESET, OIDN_MODES, SPECS, FirstPassSource, PerFrame, find_first_pass
from hybrid.memory import parse_size, plan_rows
from hybrid.oidn import find_device
from hybrid.pipeline import (
    Failed,
    Finished,
    RunSettings,
    SourcesOf,
    View,
    check_written,
    denoise_frames,
    sources_of,
    temporal_support,
)
from hybrid.plan import NEURAL_STAGES, Rules
from hybrid.preview import check_png
from hybrid.pseudo_reference import CLASSICAL_PRESETS, FINAL
from hybrid.runtime.allocator import reuse_freed_memory
from hybrid.runtime.threads import limit_threads
from hybrid.runtime.timing import Timings
from hybrid.stream import plan_shot
from hybrid.validation import ValidationReport, find_cut, validate_layers

LOG = logging.getLogger("ravg")

# Presets of each method, the default first.
PRESETS: dict[str, tuple[str, ...]] = {
    "network": ("fast", "balanced", "quality", "auto"),
    "classical": ("standard", "draft", "final"),
    "pooled": ("pooled",),
}
METHOD_OF_PRESET = {preset: method for method, presets in PRESETS.items() for preset in presets}
FIRST_PASS_OF_METHOD = {"network": "auto", "classical": "none", "pooled": "oidn-fast"}
PRECISIONS = ("auto", "float32", "bfloat16")
AOV_SUMS = ("layers", "beauty")
# Presets that --budget chooses from, the most accurate first.
MEASURED = tuple(reversed(OIDN_MODE_OF_PRESET))


@dataclass(frozen=True)
class DenoiseOptions:
    """Everything that is asked for when a shot is denoised, validated before any file is opened.

    Attributes
    ----------
    method : str
        "network" (needs torch), "classical" or "pooled"; without: that of the preset, or "network".
    preset : str
        One of `PRESETS` of the method; without: the first of them. "auto" needs `budget`.
    budget : str or None
        Time per frame, such as "10s": the most accurate preset that fits it is measured and taken.
    weights : Path or None
        A weights file in place of a preset.
    threshold : float or None
        For networks that predict kernels, in [0, 1): higher drops more taps.
    first_pass : str
        Source of the denoised image per frame (`hybrid.first_pass.find_first_pass`), or a finished sequence. Without:
        "auto" for a network, "none" for the classical chain, "oidn-fast" for pooled samples.
    keep_first_pass : str or None
        Pattern or folder where OIDN's first pass is kept for later runs.
    passes : int
        Runs over the shot, each on the frames of the one before.
    breakdown : Path or None
        PNG of the share that each frame of the window contributes; adds layers to the frames.
    aov_sum : str
        "layers": light passes are scaled to the denoised beauty; "beauty": the beauty is the sum of its layers.
    stages, no_stages : collection of str
        Stages that run, or do not, whatever was measured.
    tile : int or None
        Pixels on a side that the network is given at once, at least 16.
    precision : str
        Of the network: "float32", "bfloat16", or "auto", bfloat16 where the processor has it.
    device : str
        For ravg's networks and OIDN's: "cpu", "cuda", "hip", "sycl", "metal", or "auto", the first that is there.
    resume : bool
        Leave frames alone that are there, whole, and would be the same.
    keep_going : bool
        Go on after a frame that cannot be made.
    max_memory : str or None
        Such as "8G": frames are worked on in bands of rows.
    strict : bool
        Refuse layers that make no sense, and cuts, instead of working around them.
    reuse_freed_memory : bool
        Let the process keep memory that it frees, which saves a sixth of the CPU time; not with `max_memory`.
    threads : int or None
        Threads of numba, OpenCV and torch in this process; None leaves them as they are.

    Raises
    ------
    ValueError
        If an option does not exist, or two contradict each other.
    """

    method: str = ""
    preset: str = ""
    budget: str | None = None
    weights: Path | None = None
    threshold: float | None = None
    first_pass: str = ""
    keep_first_pass: str | None = None
    passes: int = 1
    breakdown: Path | None = None
    aov_sum: str = "layers"
    stages: Collection[str] = ()
    no_stages: Collection[str] = ()
    tile: int | None = None
    precision: str = "auto"
    device: str = "auto"
    resume: bool = False
    keep_going: bool = False
    max_memory: str | None = None
    strict: bool = False
    reuse_freed_memory: bool = True
    threads: int | None = None

    def __post_init__(self) -> None:
        preset = "pooled" if self.preset == "gathered" else self.preset  # its name for one release
        if preset == "tkpcn":
            weights = "network/paper/weights/tkpcn.safetensors"
            raise ValueError(f"preset is 'tkpcn', no preset any more, expected --weights {weights}")
        if preset and preset not in METHOD_OF_PRESET:
            raise ValueError(f"preset is {preset!r}, expected one of {', '.join(METHOD_OF_PRESET)}")
        method = self.method or METHOD_OF_PRESET.get(preset, "network")
        if method not in PRESETS:
            raise ValueError(f"method is {method!r}, expected one of {', '.join(PRESETS)}")
        preset = preset or PRESETS[method][0]
        if preset not in PRESETS[method]:
            expected = ", ".join(PRESETS[method])
            raise ValueError(f"preset is {preset!r}, expected one of {expected} with method {method}")
        first_pass = self.first_pass or FIRST_PASS_OF_METHOD[method]
        if method == "pooled" and first_pass == "none":
            first_pass = FIRST_PASS_OF_METHOD[method]
        for name, value in (("method", method), ("preset", preset), ("first_pass", first_pass)):
            object.__setattr__(self, name, value)
        check_first_pass(first_pass)
        self._check_values()
        self._check_method()

    def _check_values(self) -> None:
        for name, value, expected in (
            ("precision", self.precision, PRECISIONS),
            ("aov-sum", self.aov_sum, AOV_SUMS),
        ):
            if value not in expected:
                raise ValueError(f"{name} is {value!r}, expected one of {', '.join(expected)}")
        for name, number, least in (("passes", self.passes, 1), ("tile", self.tile, 16), ("threads", self.threads, 1)):
            if number is not None and number < least:
                raise ValueError(f"{name} is {number}, expected at least {least}")
        if self.threshold is not None and not 0 <= self.threshold < 1:
            raise ValueError(f"threshold is {self.threshold}, expected 0 <= threshold < 1, in units of 1/K")
        if (self.preset == "auto") != (self.budget is not None) or (self.weights is not None and self.budget):
            raise ValueError("--budget chooses the preset, expected it with --preset auto, and without --weights")
        if self.budget is not None:
            parse_budget(self.budget)
        if self.max_memory is not None:
            parse_size(self.max_memory)
        if self.breakdown is not None:
            check_png(self.breakdown, "breakdown")
            if self.max_memory is not None:
                raise ValueError("--breakdown looks at whole frames, expected no --max-memory with it")

    def _check_method(self) -> None:
        """Refuse stages that do not exist, and options of the network beside another method."""
        rules = self.rules
        if self.method == "network":
            return
        if neural := rules.on & NEURAL_STAGES:
            raise ValueError(f"--stages: {min(neural)} is a stage of the network, expected one that {self.method} has")
        defaults = {entry.name: entry.default for entry in fields(self)}
        for name in ("weights", "threshold", "passes", "breakdown", "aov_sum", "tile"):
            if getattr(self, name) != defaults[name]:
                option = name.replace("_", "-")
                raise ValueError(f"--{option} is of the network, expected none with method {self.method}")

    @property
    def rules(self) -> Rules:
        """The forced stages; those that only a network has are off without one."""
        off = frozenset(self.no_stages) if self.method == "network" else frozenset(self.no_stages) | NEURAL_STAGES
        return Rules(frozenset(self.stages), off)


def check_first_pass(spec: str) -> None:
    """Raise ValueError for a word that is neither a source of first passes nor the name of a file or folder."""
    if spec not in SPECS and re.fullmatch(r"[\w-]*", spec) and not Path(spec).exists():
        raise ValueError(f"first-pass is {spec!r}, expected one of {', '.join(SPECS)}, or OTHER.####.exr")


def import_neural() -> ModuleType:
    """Return the boundary to torch; ValueError with the way to get torch where it is missing."""
    try:
        import hybrid.neural as neural
    except ModuleNotFoundError as error:
        if error.name not in ("torch", "safetensors"):
            raise
        raise ValueError(
            f'{error.name} is not installed; expected: pip install "{error.name}" '
            "(`ravg denoise --method classical` works without)"
        ) from None
    return neural


def open_denoiser(
    options: DenoiseOptions, timings: Timings | None = None, breakdown: Breakdown | None = None
) -> WindowDenoiser:
    """Return the denoiser that is asked for.

    Parameters
    ----------
    options : DenoiseOptions
        With the preset "auto", the most accurate one.
    timings : Timings, optional
        Counts the stages of the denoiser.
    breakdown : Breakdown, optional
        Collects the weights of frames; layers of them are added to each result.

    Raises
    ------
    ValueError, OSError
        If weights cannot be read, a device is not there, or a threshold is given to a network without kernels.
    ImportError
        If OIDN is asked for and not installed.
    """
    timings = timings or Timings()
    if options.method == "pooled":
        return PooledDenoiser(find_device(options.device), timings)
    if options.method == "classical":
        if options.first_pass != "none":
            return AverageDenoiser(timings)
        return ClassicalDenoiser(CLASSICAL_PRESETS[options.preset], timings)
    neural = import_neural()
    return neural.open_network(  # type: ignore[no-any-return]
        weights_of(options),
        tile=neural.SMALL_TILE if options.tile is None and options.max_memory is not None else options.tile,
        precision=options.precision,
        device=options.device,
        threshold=options.threshold,
        breakdown=breakdown,
        add_layers=options.aov_sum == "beauty",
        timings=timings,
    )


def weights_of(options: DenoiseOptions) -> Path:
    """Return the weights file of a network; with the preset "auto", that of the most accurate preset."""
    if options.weights is not None:
        return Path(options.weights)
    preset = MEASURED[0] if options.preset == "auto" else options.preset
    return Path(import_neural().shipped_weights(preset))


@dataclass(frozen=True)
class Job:
    """A shot that is ready to be denoised: options and files are validated, and no frame is denoised yet.

    Attributes
    ----------
    options : DenoiseOptions
        With the preset that was chosen.
    output : str
        Pattern or folder of the frames.
    views : tuple of Shot
        Each view layer and stereo view of the files, without layers that make no sense.
    judgement : ValidationReport
        Of the first view, with the findings of all.
    denoiser : WindowDenoiser
    first_passes : tuple of FirstPassSource
        One for each view.
    rows : int or None
        Rows of a frame that are worked on at a time; None: all.
    settings : mapping of str to object
        JSON values that pixels depend on, beside preset, stages and versions.
    timings : Timings
        Seconds and memory of each stage.
    breakdown : Breakdown or None
        Weights of the frames, if they are asked for.
    """

    options: DenoiseOptions
    output: str
    views: tuple[Shot, ...]
    judgement: ValidationReport
    denoiser: WindowDenoiser
    first_passes: tuple[FirstPassSource, ...]
    rows: int | None
    settings: Mapping[str, object]
    timings: Timings
    breakdown: Breakdown | None

    @property
    def preset(self) -> str:
        """The preset, or the name of the weights file."""
        return self.options.preset if self.options.weights is None else Path(self.options.weights).name

    @property
    def first_pass(self) -> str:
        """Where the last pass over the shot has its denoised images per frame from."""
        passes = self.options.passes
        return self.first_passes[0].name if passes == 1 else f"pass {passes - 1} of {passes}"

    @property
    def total(self) -> int:
        """Frames of all passes together."""
        return sum(len(self.views[0].with_neighbours(margin)) for margin in self._margins)

    @property
    def _margins(self) -> list[int]:
        """For each pass, the frames on each side of those asked for that later passes need."""
        support = temporal_support(None, self.denoiser.radius, self.options.rules)
        return [support * (self.options.passes - number) for number in range(1, self.options.passes + 1)]

    def header(self) -> dict[str, str]:
        """Attributes for the header of each frame: where they differ, pixels may."""
        oidn = ["pyoidn"] if self.first_passes[0].name in OIDN_MODES else []
        packages = dict.fromkeys([*PACKAGES, *self.denoiser.packages, *oidn])
        return {
            "ravg/command": "denoise",
            "ravg/preset": self.preset,
            "ravg/first-pass": self.first_pass,
            "ravg/forced": self.options.rules.forced,
            "ravg/settings": json.dumps(self.settings, sort_keys=True),
            "ravg/versions": json.dumps(versions(*packages), sort_keys=True),
        }


@dataclass(frozen=True)
class Step:
    """The state of a job after a frame.

    Attributes
    ----------
    result : Finished or Failed
        The frame.
    run, runs : int
        Which pass over the shot it belongs to, from 1, and how many there are.
    done, total : int
        Frames of all passes.
    """

    result: Finished | Failed
    run: int
    runs: int
    done: int
    total: int


Progress = Callable[[Step], bool | None]


def check_paths(
    shot: Shot,
    output: str | Path,
    options: DenoiseOptions,
    sources: Sequence[FirstPassSource] = (),
    *,
    reads: Mapping[str, str | Path | None] = {},
    writes: Mapping[str, Path | None] = {},
) -> None:
    """Refuse, before anything is read or written, a run that would write over its inputs.

    Parameters
    ----------
    shot : Shot
        The noisy frames.
    output : str or Path
        Pattern or folder of the denoised frames.
    options : DenoiseOptions
        Name further files.
    sources : sequence of FirstPassSource
        First passes, whose files are read or written.
    reads, writes : mapping of str to path or None
        Further files.

    Raises
    ------
    ValueError, OSError
        As `hybrid.files.replace.check_outputs`.
    FileNotFoundError
        If frames were asked for that are not there, and `keep_going` is not set.
    """
    if shot.missing and not options.keep_going:
        missing = format_frames(shot.missing)
        raise FileNotFoundError(f"frames {missing} were asked for and are not there; --keep-going makes the others")
    weights = weights_of(options) if options.method == "network" else None
    check_written(shot, output, sources, {"weights": weights, **reads}, {"breakdown": options.breakdown, **writes})


def open_job(
    shot: Shot,
    output: str | Path,
    options: DenoiseOptions = DenoiseOptions(),
    *,
    reads: Mapping[str, str | Path | None] = {},
    writes: Mapping[str, Path | None] = {},
    judging: AbstractContextManager[object] | None = None,
) -> Job:
    """Validate everything that a job depends on, and read what decides its options.

    Parameters
    ----------
    shot : Shot
        The noisy frames.
    output : str or Path
        ``OUT.####.exr``, or a folder.
    options : DenoiseOptions
        What is asked for.
    reads, writes : mapping of str to path or None
        Further files, which the frames may not write over.
    judging : context manager, optional
        Entered while frames are read and validated.

    Raises
    ------
    ValueError, OSError, ImportError
        If an option cannot be had here, a file is damaged or would be overwritten, or memory does not suffice.
    """
    timings, breakdown = Timings(), None if options.breakdown is None else Breakdown()
    check_paths(shot, output, options, reads=reads, writes=writes)
    denoiser = open_denoiser(options, timings, breakdown)
    _check_first_pass_of(denoiser, options)
    if options.method != "network" and shot.aovs:
        raise ValueError(f"--aov: {options.method} denoises the color alone, expected none, got {shot.aovs[0]!r}")
    with judging or nullcontext():
        if options.max_memory is not None:  # even with no stage, before any pixel is read
            plan_rows(parse_size(options.max_memory), shot, ())
        views, judgement = judge_views(shot, strict=options.strict)
        if options.strict:
            _refuse_cuts(views, judgement)
        if options.aov_sum == "beauty":
            _check_sums(views)
    if options.preset == "auto":
        options = _fit_budget(views[0], options)
        denoiser = open_denoiser(options, timings, breakdown)
    first_passes = tuple(choose_first_pass(view, options, denoiser) for view in views)
    check_paths(shot, output, options, first_passes, reads=reads, writes=writes)
    settings = _settings(options, views[0], denoiser, first_passes[0])
    rows = _plan_rows(options, views, denoiser, first_passes[0])
    output = str(output)
    return Job(options, output, views, judgement, denoiser, first_passes, rows, settings, timings, breakdown)


def judge_views(shot: Shot, *, strict: bool = False) -> tuple[tuple[Shot, ...], ValidationReport]:
    """Return the views of a shot without layers that make no sense, and the findings.

    Parameters
    ----------
    shot : Shot
        Pairs of its frames are read.
    strict : bool
        Raise ValueError with all findings instead.
    """
    views = shot.views
    judged = [validate_layers(view) for view in views]
    findings = [finding for judgement in judged for finding in judgement.findings]
    judgement = replace(judged[0], findings=tuple(dict.fromkeys(findings)))
    if strict and (words := [*shot.warnings, *judgement.warnings]):
        raise ValueError("; ".join(words))
    return tuple(own.apply(view) for own, view in zip(judged, views, strict=True)), judgement


def _refuse_cuts(views: Sequence[Shot], judgement: ValidationReport) -> None:
    for view in views:
        cuts = [finding for cut in plan_shot(view).cuts if (finding := find_cut(*cut)) not in judgement.findings]
        if cuts:
            raise ValueError("; ".join(cut.message for cut in cuts))


def _check_sums(views: Sequence[Shot]) -> None:
    """Refuse to make a beauty of layers that do not add up to it."""
    for view in views:
        passes = view.passes
        if view.aovs and not any(found.whole == BEAUTY and found.complete for found in passes.sums):
            raise ValueError(
                f"{view.path(view.numbers[0])}: --aov-sum beauty: no layers add up to the beauty, all of them "
                f"together have {passes.light:.2f} times its light, expected layers of which it is the sum"
            )


def _check_first_pass_of(denoiser: WindowDenoiser, options: DenoiseOptions) -> None:
    if not denoiser.needs_first_pass and options.first_pass not in ("auto", "none"):
        raise ValueError(
            f"first-pass is {options.first_pass!r}, expected auto or none: the network of {weights_of(options).name} "
            "takes none"
        )


def choose_first_pass(view: Shot, options: DenoiseOptions, denoiser: WindowDenoiser) -> FirstPassSource:
    """Return the first pass of a view; a network that needs one has the classical one where none is asked for.

    Parameters
    ----------
    view : Shot
        The noisy frames.
    options : DenoiseOptions
        With the preset that was chosen.
    denoiser : WindowDenoiser
        Says whether it needs a first pass, and brings functions for it.

    Raises
    ------
    ValueError, ImportError, FileNotFoundError
        As `hybrid.first_pass.find_first_pass`.
    """
    if not denoiser.needs_first_pass:
        return FirstPassSource("none", None, "the denoiser takes none")
    support = temporal_support(None, denoiser.radius, options.rules)
    quicker, bundled = denoiser.backends
    return find_first_pass(
        "nlm" if options.first_pass == "none" else options.first_pass,
        view.with_neighbours(support * (options.passes - 1)),
        own=CLASSICAL_PRESETS.get(options.preset, FINAL),
        kept=options.keep_first_pass,
        mode=_oidn_mode(options),
        forced=options.rules.forced,
        quicker=quicker,
        bundled=bundled,
        device=options.device,
    )


def _oidn_mode(options: DenoiseOptions) -> str:
    """The mode of OIDN that the first pass "auto" has."""
    return "oidn-clean" if options.weights is not None else OIDN_MODE_OF_PRESET.get(options.preset, "oidn-clean")


def _fit_budget(view: Shot, options: DenoiseOptions) -> DenoiseOptions:
    """The options with the most accurate preset that is measured to fit the budget, or with the fastest."""

    def with_preset(preset: str) -> DenoiseOptions:
        return replace(options, preset=preset, budget=None)

    def load(preset: str) -> tuple[WindowDenoiser, FirstPassSource]:
        # Nothing is kept: the frames that are measured are parts.
        measured = replace(with_preset(preset), keep_first_pass=None)
        denoiser = open_denoiser(measured)
        return denoiser, choose_first_pass(view, measured, denoiser)

    limit, tried = parse_budget(str(options.budget)), []
    for measured in measure_presets(view, options.rules, MEASURED, load):
        tried.append(f"{measured.preset} {measured.seconds:.2g} s")
        fits = measured.seconds <= limit
        if fits:
            break
    LOG.info(f"preset: {measured.preset} ({', '.join(tried)} a frame; {options.budget} asked for)")
    if not fits:
        LOG.warning("not even the fastest preset fits")
    return with_preset(measured.preset)


def _settings(
    options: DenoiseOptions, view: Shot, denoiser: WindowDenoiser, first_pass: FirstPassSource
) -> dict[str, object]:
    """What pixels depend on beside preset, stages and versions, and without paths: frames name their files."""
    weights = {}
    if options.method == "network":
        weights["weights"] = _digest(weights_of(options))
    if first_pass.name == "bundled":
        neural = import_neural()
        bundled = neural.bundled_preset(OIDN_MODES[_oidn_mode(options)]["quality"])
        weights["bundled"] = _digest(neural.shipped_weights(bundled))
    return {
        "method": options.method,
        "aovs": list(view.aovs),
        "aov-sum": options.aov_sum,
        "first-pass": "sequence" if first_pass.files else options.first_pass,
        "passes": options.passes,
        "breakdown": options.breakdown is not None,
        "device": {**denoiser.devices, **({"oidn": first_pass.device} if first_pass.device else {})},
        **denoiser.settings,
        **weights,
    }


def _digest(path: Path) -> str:
    """Identify the content of a file of weights."""
    return hashlib.sha256(path.read_bytes()).hexdigest()[:16]


def _plan_rows(
    options: DenoiseOptions, views: Sequence[Shot], denoiser: WindowDenoiser, first_pass: FirstPassSource
) -> int | None:
    if options.max_memory is None:
        return None
    return plan_rows(
        parse_size(options.max_memory) // len(views),
        views[0],
        options.rules.allowed,
        first_pass.first_pass,
        radius=denoiser.radius,
        network=denoiser.memory(views[0].shape),
        gathers=denoiser.pools,
    )


def run_job(job: Job, progress: Progress | None = None) -> Iterator[Finished | Failed]:
    """Denoise the frames of a job and write them.

    Parameters
    ----------
    job : Job
        From `open_job`.
    progress : callable, optional
        Called after each frame of each pass; if it returns False, the job ends there.

    Yields
    ------
    Finished or Failed
        Each frame of the last pass. Frames that are written are whole, also where the generator is closed early.
    """
    options, runs, done = job.options, job.options.passes, 0
    if options.threads is not None:
        limit_threads(options.threads)
    if options.reuse_freed_memory and options.max_memory is None:
        reuse_freed_memory()
    views = [View(shot, source.first_pass) for shot, source in zip(job.views, job.first_passes, strict=True)]
    sources: SourcesOf | None = None
    home = output_path(job.output, job.views[0], job.views[0].numbers[0]).parent
    with ExitStack() as stack:
        for run, margin in enumerate(job._margins, start=1):
            last = run == runs
            shot = views[0].shot.with_neighbours(margin)
            output = job.output if last else str(stack.enter_context(temporary_folder(home / f"pass{run}")))
            settings = RunSettings(
                rows=job.rows,
                background=options.max_memory is None,
                resume=options.resume and last,
                keep_going=options.keep_going and last,
                attributes=job.header(),
                sources=sources,
            )
            frames = denoise_frames(
                [View(shot, views[0].first_pass), *views[1:]],
                output,
                job.denoiser if last or job.breakdown is None else open_denoiser(options, job.timings),
                options.rules,
                settings,
                radius=job.denoiser.radius,
                timings=job.timings,
            )
            for frame in frames:
                done += 1
                if progress is not None and progress(Step(frame, run, runs, done, job.total)) is False:
                    frames.close()  # type: ignore[attr-defined]
                    return
                if last:
                    yield frame
            if not last:
                sources = sources_of(views, job.denoiser.radius, options.rules, sources)
                files = {number: output_path(output, shot, number) for number in shot.numbers}
                views = [View(view.shot.reopened(files), PerFrame(lambda frame: frame.color)) for view in views]
        if options.breakdown is not None:
            write_breakdown(list(job.views), job.output, 2 * job.denoiser.radius + 1, options.breakdown)


def denoise_shot(
    shot: Shot,
    output: str | Path,
    options: DenoiseOptions | None = None,
    *,
    progress: Progress | None = None,
    **changes: object,
) -> Iterator[Finished | Failed]:
    """Denoise every frame of a shot and write it, as the command does: the same files, which ``--resume`` continues.

    Everything is validated when this function is called; frames are made while the iterator is consumed. Closing the
    iterator, or a `progress` that returns False, ends the work after a frame; frames that are written are whole.

    Parameters
    ----------
    shot : Shot
        From `hybrid.open_shot`. Each view layer and stereo view of its files is denoised.
    output : str or Path
        ``OUT.####.exr``, or a folder.
    options : DenoiseOptions, optional
        What is asked for.
    progress : callable, optional
        Called with a `Step` after each frame of each pass.
    **changes : object
        Fields of `DenoiseOptions`, in place of those of `options`.

    Yields
    ------
    Finished or Failed
        After each frame; `Failed` with `keep_going` alone.

    Raises
    ------
    ValueError
        If an option does not exist, or a file is damaged or would be overwritten.
    OSError
        If a file cannot be read or written.
    ImportError
        If OIDN is asked for and pyoidn is not installed.

    Examples
    --------
    >>> from hybrid import denoise_shot, open_shot
    >>> shot = open_shot("examples/shot/noisy.####.exr", frames="8-10")
    >>> [frame.path.name for frame in denoise_shot(shot, "out/denoised.####.exr", preset="draft")]
    ['denoised.0008.exr', 'denoised.0009.exr', 'denoised.0010.exr']
    """
    return run_job(open_job(shot, output, replace_options(options, changes)), progress)


def replace_options(options: DenoiseOptions | None, changes: Mapping[str, object]) -> DenoiseOptions:
    """Return options with some fields replaced.

    Parameters
    ----------
    options : DenoiseOptions or None
        None: the defaults.
    changes : mapping of str to object
        Field → value; the old names of fields are accepted with a warning, and None for a default.

    Raises
    ------
    ValueError
        If there is no such option.
    """
    known = {entry.name for entry in fields(DenoiseOptions)}
    given = {}
    for name, value in changes.items():
        if name == "estimate":
            warnings.warn("estimate is now first_pass, and goes in the next release", DeprecationWarning, stacklevel=3)
            name, value = "first_pass", value or ""
        if name not in known:
            raise ValueError(f"option {name!r} is not there, expected one of {', '.join(sorted(known))}")
        given[name] = value
    return DenoiseOptions(**given) if options is None else replace(options, **given)  # type: ignore[arg-type]
