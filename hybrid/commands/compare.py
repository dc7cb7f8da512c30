"""`ravg compare`: accuracy against time."""

import tempfile
from collections.abc import Iterator, Mapping, Sequence
from dataclasses import dataclass, replace
from functools import partial
from importlib.util import find_spec
from pathlib import Path
from typing import Any, Literal

import typer
from rich.console import Console

from hybrid.commands import options as opt
from hybrid.commands.log import LOG, Progress
from hybrid.commands.shots import ShotInput, log_cuts, validate_renders
from hybrid.comparison.animations import file_name
from hybrid.comparison.compare import CompareOptions, compare_shot, count_steps
from hybrid.comparison.embedding import ShotImages
from hybrid.comparison.ladder import join_ladders
from hybrid.comparison.methods import DEFAULTS, METHODS, Method
from hybrid.comparison.methods import external as finished
from hybrid.comparison.results import Comparison, Cost, join, read_comparison
from hybrid.comparison.running import run_in_process
from hybrid.comparison.store import FrameStore
from hybrid.comparison.tables import ladder_rows, ladder_table, markdown_rows, markdown_table, result_table
from hybrid.denoising.stream import plan_shot
from hybrid.files.movies import check_movie
from hybrid.files.shots import Shot, open_matching_sequence
from hybrid.runtime.allocator import reuse_freed_memory

FRAMES = "frames"  # folder next to the page


@dataclass(frozen=True)
class _Report:
    output: Path | None = None
    clock: Literal["wall", "cpu"] = "wall"  # the time that is drawn and printed
    markdown: bool = False
    with_report: list[Path] | None = None
    fps: float = 24
    movies: bool = False
    keep_frames: bool = False

    @property
    def cost(self) -> Cost:
        return "seconds_per_megapixel" if self.clock == "wall" else "cpu_seconds_per_megapixel"

    def check(self) -> None:
        """Raise an error for a report that cannot be written, before any method runs."""
        missing = [name for name in ("jinja2", "matplotlib") if find_spec(name) is None]
        if self.output is not None and missing:
            packages = " ".join(f'"{name}"' for name in missing)
            words = f"expected: pip install {packages} (the table alone needs neither)"
            raise ValueError(f"the page of --output needs {missing[0]}, which is not installed; {words}")
        if self.output is None and (self.movies or self.keep_frames):
            option = "--movies" if self.movies else "--keep-frames"
            raise typer.BadParameter(f"{option} writes next to a page, expected --output with it")
        if self.output is not None and self.movies:
            check_movie(self.output / "movie.mp4")
        self.read_others()
        if self.output is not None:  # last, as the folder is made
            from hybrid.comparison.report import check_report

            check_report(self.output, [folder / "results.json" for folder in self.with_report or ()])

    def read_others(self) -> list[Comparison]:
        return [read_comparison(folder / "results.json") for folder in self.with_report or ()]

    def show_joined(self) -> None:
        """Join finished comparisons, without running a method."""
        others = self.read_others()
        joined = Comparison(
            " + ".join(c.shot for c in others), tuple(join(others)), {}, join_ladders([c.ladder for c in others])
        )
        self.show(others, joined)
        if self.output is not None:
            self.write(joined, None)

    def write(self, comparison: Comparison, images: ShotImages | None) -> None:
        from hybrid.comparison.report import Report, write_report  # needs jinja2 and matplotlib

        assert self.output is not None
        report = Report(comparison, images, self.read_others(), self.cost, self.fps, self.movies)
        LOG.info(f"wrote {write_report(self.output, report)}")

    def show(self, comparisons: Sequence[Comparison], shown: Comparison) -> None:
        """Print results and ladder as Markdown, or as tables for a terminal."""
        rows = ladder_rows(shown.ladder)
        if self.markdown:
            typer.echo(markdown_table(comparisons, self.cost), nl=False)
            if rows:
                typer.echo("\n" + markdown_rows([rows[0], ["---"] * len(rows[0]), *rows[1:]]), nl=False)
        else:
            Console().print(result_table(shown.results))
            if rows:
                Console().print("", ladder_table(rows))


@opt.command("compare", ShotInput, _Report)
def compare(
    shot: str | None = None,
    reference: list[str] | None = None,
    methods: str | None = None,
    external: list[str] | None = None,
    external_seconds: list[str] | None = None,
    rounds: int = 3,
    samples: float | None = None,
    level: list[str] | None = None,
    ladder: bool = False,
    exposure: float = 1.0,
    name: str | None = None,
    **how: Any,
) -> None:
    """Run the methods, or join finished comparisons, and show the results."""
    report = _Report(**opt.take(_Report, how))
    if shot is None or not reference:
        if shot is not None or reference or not report.with_report:
            raise typer.BadParameter("expected SHOT and --reference, or --with-report with finished comparisons")
        report.check()
        report.show_joined()
        return
    if len(reference) > 2:
        raise typer.BadParameter(f"--reference is given {len(reference)} times, expected once or twice")
    if ladder and not level:
        raise typer.BadParameter("--ladder runs the methods on levels, expected --level with it")
    report.check()
    read = ShotInput(shot=shot, **how)
    strict = read.strict
    alike, findings = validate_renders({"shot": read.open()}, strict=strict)
    noisy = alike["shot"]
    clean = [_open_matching(spec, noisy, read.frames) for spec in reference]
    levels = list(_open_levels(level, read))
    if ladder:
        levels = [(validate_renders({"level": found}, strict=strict)[0]["level"], count) for found, count in levels]
    chosen = _methods(methods, external, _seconds(external_seconds), noisy, read.frames)
    options = CompareOptions(
        title=name or (Path(shot) if Path(shot).is_dir() else Path(shot).parent).resolve().name,
        exposure=exposure,
        rounds=rounds,
        samples=samples or noisy.samples,
        reference_samples=clean[0].samples,
        levels=levels,
        ladder=ladder,
        findings=findings,
        check_shot=lambda: [
            finding.message for finding in log_cuts(run_in_process(plan_shot, noisy), (), strict=strict)
        ],
    )
    reuse_freed_memory()
    bar = Progress("compare", count_steps(chosen, options), "steps")
    with tempfile.TemporaryDirectory() as folder:
        halves = clean[0] if len(clean) == 1 else (clean[0], clean[1])
        comparison = compare_shot(noisy, halves, chosen, options, folder=Path(folder), on_step=partial(bar.advance, 1))
        report.show([comparison, *report.read_others()], comparison)
        if report.output is not None:
            from hybrid.comparison.report import report_images

            LOG.info("page: encode the pictures")
            numbers = [n for n in noisy.numbers if all(n in half.numbers for half in clean)]
            images = report_images(FrameStore(Path(folder)), comparison, numbers, exposure)
            report.write(comparison, images)
            if report.keep_frames:
                _write_frames(report.output / FRAMES, noisy, images)


def _open_matching(spec: str, shot: Shot, frames: str | None) -> Shot:
    """Open a reference or a finished sequence, and log its warnings."""
    opened = open_matching_sequence(spec, shot, frames=frames)
    for warning in opened.warnings:
        LOG.warning(warning)
    return opened


def _write_frames(folder: Path, shot: Shot, images: ShotImages) -> None:
    """Write the reference and each method's frames as files of the shot with another color."""
    for index, source in enumerate(images.sources):
        name = file_name(index, source.name)
        (folder / name).mkdir(parents=True, exist_ok=True)
        for number in images.frames:
            shot.write(folder / name / f"{name}.{number:04d}.exr", number, {"color": source.frame(number)})
    LOG.info(f"wrote frames to {folder}")


def _seconds(stated: Sequence[str] | None) -> dict[str, float]:
    """Seconds per frame, by the names of --external."""
    seconds = {}
    for item in stated or ():
        name, count = opt.split_number(item)
        if not name or count is None:
            raise typer.BadParameter(f"--external-seconds is {item!r}, expected NAME=SECONDS, more than 0")
        seconds[name] = count
    return seconds


def _methods(
    names: str | None, external: Sequence[str] | None, seconds: Mapping[str, float], shot: Shot, frames: str | None
) -> dict[str, Method]:
    """The requested methods, and sequences of other denoisers with their seconds per frame."""
    wanted = DEFAULTS if names is None else METHODS if names == "all" else map(str.strip, names.split(","))
    chosen = {name: opt.choose(METHODS, name, "methods") for name in wanted}
    for item in external or ():
        name, separator, pattern = item.partition("=")
        if not separator or not name or not pattern:
            raise typer.BadParameter(f"--external is {item!r}, expected NAME=PATTERN")
        if name in METHODS or name == "reference":
            raise typer.BadParameter(f"--external is {item!r}, expected a name that no other method has")
        chosen[name] = finished(_open_matching(pattern, shot, frames), seconds.get(name))
    if unknown := sorted(seconds.keys() - chosen.keys()):
        raise typer.BadParameter(f"--external-seconds names {unknown[0]!r}, expected a name of --external")
    return chosen


def _open_levels(levels: Sequence[str] | None, read: ShotInput) -> Iterator[tuple[Shot, float]]:
    """Levels with their samples per pixel: stated (a pattern that holds "=" has them stated), or from their files."""
    for item in levels or ():
        pattern, stated = opt.split_number(item) if "=" in item else (item, None)
        if not pattern or ("=" in item and stated is None):
            raise typer.BadParameter(f"--level is {item!r}, expected PATTERN=SPP, more than 0 samples per pixel")
        level = replace(read, shot=pattern).open()
        if (samples := stated or level.samples) is None:
            raise ValueError(f"{pattern} does not state its samples per pixel, expected --level PATTERN=SPP")
        yield level, samples
