"""`ravg simulate`: render shots with Cycles."""

from collections.abc import Sequence
from pathlib import Path
from typing import Any

import typer

from hybrid.commands.chunks import Chunk, arguments_of
from hybrid.commands.cluster import run_on_cluster
from hybrid.commands.log import LOG, Progress
from hybrid.commands.options import command, usage
from hybrid.simulate.run import parse_center, parse_size, read_meta, samples_left, shots_of
from hybrid.simulate.run import simulate as render
from hybrid.simulate.shot import RANDOM, ShotSettings, parse_levels, parse_samples


@command("simulate", ShotSettings)
def simulate(
    context: typer.Context,
    scene: str,
    output: Path,
    frames: str = "1-7",
    size: str = "320x180",
    film: str | None = None,
    center: str | None = None,
    spp: str = "16",
    levels: str = "n,n/e,4",
    reference_frames: str | None = None,
    seed: int = 1,
    shots: int = 1,
    jobs: int = 1,
    threads: int | None = None,
    python: str | None = None,
    scheduler: str | None = None,
    **fields: Any,
) -> None:
    """Render the shots, here or on a cluster."""
    from hybrid.files.sequences import parse_frames

    if scene not in RANDOM and not Path(scene).is_file():
        raise FileNotFoundError(f"scene: no file {scene}; expected a .blend file, {' or '.join(RANDOM)}")

    def settings(scene: str, seed: int) -> ShotSettings:
        return ShotSettings(
            scene=scene,
            seed=seed,
            frames=tuple(parse_frames(frames)),
            size=parse_size(size, "size"),
            levels=parse_levels(levels, parse_samples(spp, seed)),
            reference_frames=tuple(parse_frames(reference_frames)) if reference_frames else None,
            film=parse_size(film, "film") if film else None,
            center=parse_center(center) if center else None,
            **fields,
        )

    with usage():
        asked = shots_of(scene, output, seed, shots, settings)
    for shot, folder in asked:
        read_meta(shot, folder)  # finished renders of another shot do not count
    if scheduler is None:
        _render(asked, jobs, threads, python)
        return
    chunks = {}
    for shot, folder in asked:
        samples = sum(samples_left(shot, folder, frame) for frame in shot.frames)
        if samples:
            changes = {"scene": shot.scene, "seed": shot.seed, "shots": 1, "output": folder}
            chunks[folder.name] = Chunk(arguments_of(context, changes), samples)
    run_on_cluster(scheduler, "rendering", chunks, "spp·frames")


def _render(shots: Sequence[tuple[ShotSettings, Path]], jobs: int, threads: int | None, python: str | None) -> None:
    """Render shots, and show progress in samples, which predict the remaining time whatever the levels."""
    total = sum(samples_left(shot, out, frame) for shot, out in shots for frame in shot.frames)
    if total == 0:
        renders = sum(len(shot.renders(frame)) for shot, _ in shots for frame in shot.frames)
        LOG.info(f"all {renders} renders exist")
        return
    bar = Progress("rendering", total, "spp·frames")

    def show(kind: str, out: Path, message: dict[str, Any]) -> None:
        if kind == "frame":
            bar.advance(message["samples"], f"{out.name}/{message['file']}")
            return
        plan = message["plan"]
        found = [f"{key} {value}" for key, value in plan["description"].items() if value not in ([], {}, "still")]
        LOG.info(f"{out}: {', '.join(found)}")
        for line in plan["printed"] if len(shots) == 1 else ():
            LOG.info(f"  {line}")

    render(shots, jobs=jobs, threads=threads, python=python, on_event=show)
