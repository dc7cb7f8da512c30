"""The options of a run, and the one way to run it: for the command, Python, chunks on a cluster and ``--resume``."""

from __future__ import annotations  # `help` then shows the names of types, not what they stand for

import hashlib
import json
import logging
import math
import re
from collections.abc import Callable, Collection, Iterable, Iterator, Mapping, Sequence
from contextlib import AbstractContextManager, ExitStack, nullcontext
from dataclasses import dataclass, fields, replace
from numbers import Integral, Real
from pathlib import Path
from types import MappingProxyType, ModuleType, NoneType
from typing import Literal, NamedTuple, Self, get_args, get_origin, get_type_hints

from hybrid.checks.validation import ValidationReport, find_cut, validate_layers
from hybrid.denoising.breakdown import Breakdown, write_breakdown
from hybrid.denoising.denoisers import AverageDenoiser, ClassicalDenoiser
from hybrid.denoising.first_pass import (
    NETWORKS,
    OIDN_MODE_ALONE,
    OIDN_MODE_OF_NETWORKS,
    OIDN_MODES,
    SPECS,
    FirstPassSource,
    PerFrame,
    find_first_pass,
)
from hybrid.denoising.plan import NEURAL_STAGES, Rules
from hybrid.denoising.pseudo_reference import CLASSICAL_PRESETS, FINAL
from hybrid.denoising.stabilize import WindowDenoiser
from hybrid.denoising.stream import plan_shot
from hybrid.files.passes import BEAUTY
from hybrid.files.replace import check_outputs, temporary_folder
from hybrid.files.sequences import format_frames
from hybrid.files.shots import Shot, output_path
from hybrid.files.sources import PACKAGES, versions
from hybrid.run.budget import measure_presets, parse_budget
from hybrid.run.memory import MemoryPlan, parse_size, plan_memory
from hybrid.run.option_texts import option_texts
from hybrid.run.pipeline import Failed, Finished, RunSettings, View, denoise_frames, sources_of, temporal_support
from hybrid.run.preview import check_png
from hybrid.runtime.allocator import reuse_freed_memory
from hybrid.runtime.threads import MOST_THREADS, limit_threads
from hybrid.runtime.timing import Timings

LOG = logging.getLogger("ravg")

# Presets of each method, the default first.
PRESETS: dict[str, tuple[str, ...]] = {
    "network": ("balanced", "fast", "quality", "auto"),
    "classical": ("standard", "draft", "final"),
}
METHOD_OF_PRESET = {preset: method for method, presets in PRESETS.items() for preset in presets}
LIMITS = {"passes": (1, math.inf), "tile": (16, math.inf), "threads": (1, MOST_THREADS)}
# Types of option values: those accepted for each, and their names in messages.
ACCEPTED: dict[type, type | tuple[type, ...]]
ACCEPTED = {str: (str, Path), Path: (str, Path), int: Integral, float: Real, bool: bool, NoneType: NoneType}
TYPE_NAMES = {str: "text", Path: "a path", int: "a whole number", float: "a number", bool: "True or False"}
OF_NETWORKS = ("weights", "threshold", "passes", "breakdown", "aov_sum", "tile")  # options that only a network has
MEASURED = tuple(reversed(NETWORKS))  # presets that a budget chooses from, the most accurate first


@dataclass(frozen=True)
class DenoiseOptions:
    """The options of `denoise_shot` and `denoise_arrays`, with the names of ``ravg denoise``.

    They are validated before any file is opened.

    Raises
    ------
    ValueError
        If an option does not exist, or two contradict each other.

    Attributes
    ----------
    stages : collection of str
        Stages that are forced on, whatever was measured.
    no_stages : collection of str
        Stages that are forced off.
    reuse_freed_memory : bool
        Let the process keep memory that it frees, which saves a sixth of the CPU time.
    threads : int or None
        Threads of numba, OpenCV and torch in this process; None leaves them unchanged.
    """

    method: str = ""
    preset: str = ""
    budget: str | None = None
    weights: Path | None = None
    threshold: float | None = None
    first_pass: str = ""
    keep_first_pass: str | None = None
    passes: int = 1
    strength: float = 1.0
    breakdown: Path | None = None
    aov_sum: Literal["layers", "beauty"] = "layers"
    stages: Collection[str] = ()
    no_stages: Collection[str] = ()
    tile: int | None = None
    precision: Literal["auto", "float32", "bfloat16"] = "auto"
    device: str = "auto"
    resume: bool = False
    keep_going: bool = False
    max_memory: str | None = None
    strict: bool = False
    reuse_freed_memory: bool = True
    threads: int | None = None

    def __post_init__(self) -> None:
        self._check_types()
        preset = self.preset
        if preset and preset not in METHOD_OF_PRESET:
            raise ValueError(f"preset is {preset!r}, expected one of {', '.join(METHOD_OF_PRESET)}")
        method = self.method or METHOD_OF_PRESET.get(preset, "network")
        if method not in PRESETS:
            raise ValueError(f"method is {method!r}, expected one of {', '.join(PRESETS)}")
        preset = preset or ("auto" if self.budget is not None and method == "network" else PRESETS[method][0])
        if preset not in PRESETS[method]:
            expected = ", ".join(PRESETS[method])
            raise ValueError(f"preset is {preset!r}, expected one of {expected} with method {method}")
        first_pass = self.first_pass or ("auto" if method == "network" else "none")
        for name, value in (("method", method), ("preset", preset), ("first_pass", first_pass)):
            object.__setattr__(self, name, value)
        check_first_pass(first_pass)
        self._check_values()
        self._check_combinations()

    def _check_types(self) -> None:
        """Refuse values of other types, and convert collections to tuples, text to paths and paths to text."""
        for name, hint in get_type_hints(DenoiseOptions).items():
            value = getattr(self, name)
            if get_origin(hint) is Collection:
                if isinstance(value, str) or not isinstance(value, Iterable):
                    raise ValueError(f"{name} is {value!r}, expected a list of names")
                object.__setattr__(self, name, tuple(value))
            elif get_origin(hint) is Literal:
                if value not in (choices := get_args(hint)):
                    raise ValueError(f"{name.replace('_', '-')} is {value!r}, expected one of {', '.join(choices)}")
            else:
                kinds = get_args(hint) or (hint,)
                accepted = any(isinstance(value, ACCEPTED[kind]) for kind in kinds)
                if not accepted or (isinstance(value, bool) and bool not in kinds):
                    expected = " or ".join(TYPE_NAMES[kind] for kind in kinds if kind is not NoneType)
                    raise ValueError(f"{name} is {value!r}, expected {expected}")
                if isinstance(value, (str, Path)):
                    object.__setattr__(self, name, Path(value) if Path in kinds else str(value))

    def _check_values(self) -> None:
        for name, (least, most) in LIMITS.items():
            if (number := getattr(self, name)) is not None and not least <= number <= most:
                bound = f"at least {least}" if number < least else f"at most {most}"
                raise ValueError(f"{name} is {number}, expected {bound}")
        if self.threshold is not None and not 0 <= self.threshold < 1:
            raise ValueError(f"threshold is {self.threshold}, expected 0 <= threshold < 1, in units of 1/K")
        if not 0 <= self.strength <= 1:
            raise ValueError(
                f"strength is {self.strength}, expected 0 <= strength <= 1, the share of the noise to remove"
            )
        if self.budget is not None:
            parse_budget(self.budget)
        if self.max_memory is not None:
            parse_size(self.max_memory)
        if self.breakdown is not None:
            check_png(self.breakdown, "breakdown")

    def _check_combinations(self) -> None:
        """Refuse options that contradict each other, and stages that do not exist."""
        if (self.preset == "auto") != (self.budget is not None) or (self.weights is not None and self.budget):
            raise ValueError(
                "--budget chooses the preset, expected no other --preset than auto with it, and no --weights"
            )
        if self.strength < 1 and self.passes > 1:
            raise ValueError("--strength keeps noise as rendered, which no second pass reads, expected --passes 1")
        if self.breakdown is not None and self.max_memory is not None:
            raise ValueError("--breakdown needs whole frames, expected no --max-memory with it")
        forced = Rules(frozenset(self.stages), frozenset(self.no_stages))  # refuses stages that do not exist
        if self.method == "network":
            return
        if neural := forced.on & NEURAL_STAGES:
            raise ValueError(f"--stages: {min(neural)} is a stage of the network, expected one that {self.method} has")
        for name in OF_NETWORKS:
            if getattr(self, name) != DEFAULTS[name]:
                option = name.replace("_", "-")
                raise ValueError(f"--{option} is of the network, expected none with method {self.method}")

    @property
    def rules(self) -> Rules:
        """The forced stages; those that only a network has are off without one."""
        off = frozenset(self.no_stages) | (frozenset() if self.method == "network" else NEURAL_STAGES)
        return Rules(frozenset(self.stages), off)

    @property
    def weights_file(self) -> Path | None:
        """The file of the network's weights; with the preset "auto", that of the most accurate preset."""
        if self.method != "network" or self.weights is not None:
            return None if self.weights is None else Path(import_neural().find_weights(self.weights))
        return Path(import_neural().shipped_weights(MEASURED[0] if self.preset == "auto" else self.preset))

    @property
    def oidn_mode(self) -> str:
        """The mode of OIDN in the first pass "auto": the same for given weights and for those that ship."""
        return OIDN_MODE_OF_NETWORKS if self.method == "network" else "oidn-clean"


DEFAULTS = {entry.name: entry.default for entry in fields(DenoiseOptions)}


def _describe_others() -> str:
    """Attributes of `DenoiseOptions` whose texts are those of the command's options, as its docstring has them."""
    lines, texts = [], option_texts("denoise")
    for name, hint in get_type_hints(DenoiseOptions).items():
        if name in texts and f" {name} : " not in str(DenoiseOptions.__doc__):
            chosen = ", ".join(map(repr, get_args(hint))) if get_origin(hint) is Literal else ""
            kind = hint.__name__ if isinstance(hint, type) else str(hint).replace("pathlib.", "")
            lines += [f"    {name} : {chosen or kind}", f"        {texts[name]['help']}"]
    return "\n".join([*lines, ""])


if DenoiseOptions.__doc__:  # none with python -OO
    first = "----------\n    stages"
    others = first.replace("    stages", f"{_describe_others()}    stages")
    DenoiseOptions.__doc__ = DenoiseOptions.__doc__.replace(first, others)


def replace_options(options: DenoiseOptions | None, changes: Mapping[str, object]) -> DenoiseOptions:
    """Return options, or the defaults, with some fields replaced; ValueError for a field that does not exist."""
    if not (options is None or isinstance(options, DenoiseOptions)):
        raise ValueError(f"options is {options!r}, expected DenoiseOptions, or keywords such as preset='fast'")
    if unknown := changes.keys() - DEFAULTS.keys():
        raise ValueError(f"option {min(unknown)!r} is not there, expected one of {', '.join(DEFAULTS)}")
    return DenoiseOptions(**changes) if options is None else replace(options, **changes)  # type: ignore[arg-type]


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


def prepare_process(options: DenoiseOptions) -> None:
    """Apply the options that concern the whole process: threads, and the reuse of freed memory."""
    if options.threads is not None:
        limit_threads(options.threads)
    if options.reuse_freed_memory:
        reuse_freed_memory()


def open_denoiser(
    options: DenoiseOptions, timings: Timings | None = None, breakdown: Breakdown | None = None
) -> WindowDenoiser:
    """Return the denoiser that is asked for; with the preset "auto", the most accurate one.

    A breakdown collects the weights of frames; layers of them are then added to each result. Raises ValueError or
    OSError if weights cannot be read, a device is not there, or a threshold is given to a network without kernels;
    ImportError if OIDN is asked for and not installed.
    """
    timings = timings or Timings()
    if options.method == "classical":
        if options.first_pass != "none":
            return AverageDenoiser(timings)
        return ClassicalDenoiser(CLASSICAL_PRESETS[options.preset], timings)
    neural = import_neural()
    denoiser: WindowDenoiser = neural.open_network(
        options.weights_file,
        tile=options.tile,
        precision=options.precision,
        device=options.device,
        threshold=options.threshold,
        breakdown=breakdown,
        add_layers=options.aov_sum == "beauty",
        timings=timings,
    )
    if not denoiser.needs_first_pass and options.first_pass not in ("auto", "none"):
        name = Path(str(options.weights_file)).name
        raise ValueError(
            f"first-pass is {options.first_pass!r}, expected auto or none: the network of {name} takes none"
        )
    return denoiser


def choose_first_pass(view: Shot, options: DenoiseOptions, denoiser: WindowDenoiser) -> FirstPassSource:
    """Return the first pass of a view; errors are those of `hybrid.denoising.first_pass.find_first_pass`."""
    if not denoiser.needs_first_pass:
        return FirstPassSource("none", None, "the denoiser takes none")
    support = temporal_support(None, denoiser.radius, options.rules)
    alone = options.method == "network" and len(view.with_neighbours(1).numbers) == 1
    return find_first_pass(
        "nlm" if options.first_pass == "none" else options.first_pass,  # the denoiser needs one
        view.with_neighbours(support * (options.passes - 1)),
        classical=CLASSICAL_PRESETS.get(options.preset, FINAL),
        kept=options.keep_first_pass,
        mode=OIDN_MODE_ALONE if alone else options.oidn_mode,
        forced=options.rules.forced,
        backends=denoiser.backends,
        device=options.device,
    )


def check_paths(
    shot: Shot,
    output: str | Path,
    options: DenoiseOptions,
    first_passes: Sequence[FirstPassSource] = (),
    further: Mapping[str, Path | None] = MappingProxyType({}),
) -> None:
    """Refuse, before any pixel is read, a run that would write over its inputs, or that lacks frames.

    `further` are files that are written beside the frames, by the names of their options.

    Raises ValueError or OSError as `hybrid.files.replace.check_outputs`; FileNotFoundError if frames were asked for
    that are not there, and `keep_going` is not set.
    """
    if shot.missing and not options.keep_going:
        missing = format_frames(shot.missing)
        raise FileNotFoundError(
            f"frames {missing} were asked for and are not there; render them, or add --keep-going to denoise the others"
        )
    written = [("output", output_path(output, shot, number)) for number in shot.numbers]
    written += [("keep-first-pass", path) for source in first_passes for path in source.kept]
    beside = {"breakdown": options.breakdown, **further}
    written += [(name, path) for name, path in beside.items() if path is not None]
    read = [("frame", path) for number in shot.files for path in shot.paths(number)]
    read += [("first-pass", path) for source in first_passes if source.files for path in source.files.files.values()]
    profile = shot.reader.files.profile
    inputs = {"weights": options.weights_file, "profile": None if profile is None else profile.file}
    read += [(name, path) for name, path in inputs.items() if path is not None]
    check_outputs(written, read)


def validate_views(shot: Shot, *, strict: bool = False) -> tuple[tuple[Shot, ...], ValidationReport]:
    """Return a shot's views without layers that make no sense in pairs of frames, and findings, errors if `strict`."""
    reports = [validate_layers(view) for view in shot.views]
    findings = [finding for report in reports for finding in report.findings]
    report = replace(reports[0], findings=tuple(dict.fromkeys(findings)))
    if strict and (lines := [*shot.warnings, *report.warnings]):
        raise ValueError("; ".join(lines))
    return tuple(own.apply(view) for own, view in zip(reports, shot.views, strict=True)), report


def _check_views(views: Sequence[Shot], report: ValidationReport, options: DenoiseOptions) -> None:
    """Refuse cuts, if `strict`, and to make a beauty of layers that do not add up to it."""
    for view in views:
        plan_cuts = plan_shot(view).cuts if options.strict else ()
        if cuts := [cut for pair in plan_cuts if (cut := find_cut(*pair)) not in report.findings]:
            raise ValueError("; ".join(cut.message for cut in cuts))
        complete = any(total.whole == BEAUTY and total.complete for total in view.passes.sums)
        if options.aov_sum == "beauty" and view.aovs and not complete:
            raise ValueError(
                f"{view.path(view.numbers[0])}: --aov-sum beauty: no layers add up to the beauty, all of them "
                f"together have {view.passes.light:.2f} times its light, expected layers of which it is the sum"
            )


def _fit_budget(view: Shot, options: DenoiseOptions) -> DenoiseOptions:
    """The options with the most accurate preset that is measured to fit the budget, or with the fastest."""

    def load(preset: str) -> tuple[WindowDenoiser, FirstPassSource]:
        # Nothing is kept: the frames that are measured are parts.
        measured = replace(options, preset=preset, budget=None, keep_first_pass=None)
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
        LOG.warning(
            f"no preset fits --budget {options.budget}: the fastest is used; allow more time, or lower the size"
        )
    return replace(options, preset=measured.preset, budget=None)


def _digest(path: Path) -> str:
    """Identify the content of a file of weights."""
    return hashlib.sha256(path.read_bytes()).hexdigest()[:16]


class Step(NamedTuple):
    """The state of a job after a frame of pass `run` of `runs`; `done` of `total` frames of all passes."""

    result: Finished | Failed
    run: int
    runs: int
    done: int
    total: int


Progress = Callable[[Step], bool | None]


@dataclass(frozen=True)
class Job:
    """A shot that is ready to be denoised: options and files are validated, and no frame is denoised yet."""

    options: DenoiseOptions  # with the preset that was chosen
    output: str  # pattern or folder of the frames
    views: tuple[Shot, ...]  # each view layer and stereo view of the files, without layers that make no sense
    report: ValidationReport  # of the first view, with the findings of all
    denoiser: WindowDenoiser
    first_passes: tuple[FirstPassSource, ...]  # one for each view
    timings: Timings  # seconds and memory of each stage
    breakdown: Breakdown | None  # weights of the frames, if they are asked for

    @classmethod
    def open(
        cls,
        shot: Shot,
        output: str | Path,
        options: DenoiseOptions,
        further: Mapping[str, Path | None] = MappingProxyType({}),
        validating: AbstractContextManager[object] | None = None,
    ) -> Self:
        """Prepare the process, and validate everything that a job depends on.

        `further` files are written beside the frames; `validating` is entered while frames are read and validated.

        Raises ValueError, OSError or ImportError if an option cannot be had here, a file is damaged or would be
        overwritten, or memory does not suffice.
        """
        prepare_process(options)
        timings, breakdown = Timings(), None if options.breakdown is None else Breakdown()
        check_paths(shot, output, options, further=further)
        denoiser = open_denoiser(options, timings, breakdown)
        if options.method != "network" and shot.aovs:
            raise ValueError(f"--aov: {options.method} denoises the color alone, expected none, got {shot.aovs[0]!r}")
        with validating or nullcontext():
            if options.max_memory is not None:  # before any pixel is read
                view, allowed = shot.views[0], options.rules.allowed
                limit = parse_size(options.max_memory) // len(shot.views)
                plan_memory(limit, view, allowed, radius=denoiser.radius, network=denoiser.memory)
            views, report = validate_views(shot, strict=options.strict)
            _check_views(views, report, options)
        if options.preset == "auto":
            options = _fit_budget(views[0], options)
            denoiser = open_denoiser(options, timings, breakdown)
        first_passes = tuple(choose_first_pass(view, options, denoiser) for view in views)
        check_paths(shot, output, options, first_passes, further)
        job = cls(options, str(output), views, report, denoiser, first_passes, timings, breakdown)
        job.plan_memory()
        return job

    @property
    def preset(self) -> str:
        """The preset, or the name of the weights file."""
        return self.options.preset if self.options.weights is None else Path(self.options.weights).name

    @property
    def first_pass(self) -> str:
        """The first pass of the last pass over the shot, which may be the pass before."""
        passes = self.options.passes
        return self.first_passes[0].name if passes == 1 else f"pass {passes - 1} of {passes}"

    @property
    def settings(self) -> dict[str, object]:
        """JSON values that pixels depend on, beside preset, stages and versions; frames name their files."""
        options, first_pass = self.options, self.first_passes[0]
        weights = {} if options.weights_file is None else {"weights": _digest(options.weights_file)}
        if first_pass.name == "bundled":
            neural = import_neural()
            weights["bundled"] = _digest(neural.shipped_weights(neural.BUNDLED))
        return {
            "method": options.method,
            "aovs": list(self.views[0].aovs),
            "aov-sum": options.aov_sum,
            "first-pass": "sequence" if first_pass.files else options.first_pass,
            "passes": options.passes,
            "strength": float(options.strength),
            "breakdown": options.breakdown is not None,
            "device": {**self.denoiser.devices, **({"oidn": first_pass.device} if first_pass.device else {})},
            **self.denoiser.settings,
            **weights,
        }

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

    def plan_memory(self) -> MemoryPlan:
        """How the run stays within its limit, if it has one; ValueError where not even a band of rows fits."""
        if self.options.max_memory is None:
            return MemoryPlan()
        return plan_memory(
            parse_size(self.options.max_memory) // len(self.views),
            self.views[0],
            self.options.rules.allowed,
            self.first_passes[0].first_pass,
            radius=self.denoiser.radius,
            network=self.denoiser.memory,
            first_network=self.denoiser.backends.memory,
            filters_guides=self.denoiser.filter_guides is not None,
        )

    def margins(self) -> list[int]:
        """For each pass, the frames on each side of the requested ones that later passes need."""
        support = temporal_support(None, self.denoiser.radius, self.options.rules)
        return [support * (self.options.passes - number) for number in range(1, self.options.passes + 1)]

    def total(self) -> int:
        return sum(len(self.views[0].with_neighbours(margin)) for margin in self.margins())

    def run(self, progress: Progress | None = None) -> Iterator[Finished | Failed]:
        """Denoise the frames and write them; yield each frame of the last pass.

        `progress` is called after each frame of each pass; if it returns False, the job ends there. Frames that are
        written are whole, also where the generator is closed early.
        """
        options, runs, done, total = self.options, self.options.passes, 0, self.total()
        views = [View(shot, source.first_pass) for shot, source in zip(self.views, self.first_passes, strict=True)]
        settings = RunSettings(self.plan_memory(), attributes=self.header())
        home = output_path(self.output, self.views[0], self.views[0].numbers[0]).parent
        with ExitStack() as stack:
            for run, margin in enumerate(self.margins(), start=1):
                last = run == runs
                shot, output = views[0].shot.with_neighbours(margin), self.output
                if not last:
                    output = str(stack.enter_context(temporary_folder(home / f"pass{run}")))
                frames = denoise_frames(
                    [View(shot, views[0].first_pass), *views[1:]],
                    output,
                    self.denoiser if last or self.breakdown is None else open_denoiser(options, self.timings),
                    options.rules,
                    replace(settings, resume=options.resume and last, keep_going=options.keep_going and last),
                    strength=options.strength,
                    timings=self.timings,
                )
                for frame in frames:
                    done += 1
                    ends = progress is not None and progress(Step(frame, run, runs, done, total)) is False
                    if ends:
                        frames.close()  # type: ignore[attr-defined]
                    if last:
                        yield frame
                    if ends:
                        return
                if not last:
                    sources = sources_of(views, self.denoiser.radius, options.rules, settings.sources)
                    settings = replace(settings, sources=sources)
                    files = {number: output_path(output, shot, number) for number in shot.numbers}
                    views = [View(view.shot.reopened(files), PerFrame(lambda frame: frame.color)) for view in views]
            if options.breakdown is not None:
                write_breakdown(list(self.views), self.output, 2 * self.denoiser.radius + 1, options.breakdown)


def denoise_shot(
    shot: Shot,
    output: str | Path,
    options: DenoiseOptions | None = None,
    *,
    progress: Progress | None = None,
    **changes: object,
) -> Iterator[Finished | Failed]:
    """Denoise every frame of a shot and write it, as the command does: the same files, which ``--resume`` continues.

    Everything is validated when this function is called; frames are denoised while the iterator is consumed. Closing
    the iterator, or a `progress` that returns False, ends the work after a frame; frames that are written are whole.

    Parameters
    ----------
    shot : Shot
        From `ravg.open_shot`. Each view layer and stereo view of its files is denoised.
    output : str or Path
        ``OUT.####.exr``, or a folder.
    options : DenoiseOptions, optional, what is asked for
    progress : callable, optional, called with a `Step` after each frame of each pass
    **changes : object, fields of `DenoiseOptions`, in place of those of `options`

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
    >>> from ravg import denoise_shot, open_shot
    >>> shot = open_shot("examples/shot/noisy.####.exr", frames="8-10")
    >>> [frame.path.name for frame in denoise_shot(shot, "out/denoised.####.exr")]
    ['denoised.0008.exr', 'denoised.0009.exr', 'denoised.0010.exr']
    """
    if not isinstance(shot, Shot):
        raise ValueError(f"shot is {shot!r}, expected a Shot from ravg.open_shot")
    if not isinstance(output, (str, Path)):
        raise ValueError(f"output is {output!r}, expected a pattern such as OUT.####.exr, or a folder")
    return Job.open(shot, output, replace_options(options, changes)).run(progress)
