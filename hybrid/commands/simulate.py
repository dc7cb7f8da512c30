"""`ravg simulate`: render shots with Cycles."""

from collections.abc import Sequence
from pathlib import Path
from typing import Annotated, Any

import typer

from hybrid.commands.cluster import Chunk, SchedulerOption, arguments_of, run_on_cluster
from hybrid.commands.log import LOG, Progress
from hybrid.commands.options import of_input, of_method, of_output, of_resources, usage, with_fields
from hybrid.simulate.run import parse_center, parse_size, read_meta, samples_left, shots_of
from hybrid.simulate.run import simulate as render
from hybrid.simulate.shot import FIXED, RANDOM, ShotSettings, parse_levels, parse_samples


@with_fields(ShotSettings, title="Method")
def simulate(
    context: typer.Context,
    scene: Annotated[
        str, typer.Argument(metavar="SCENE", help="a .blend file, random, hard, validation, test, or one as test:NAME")
    ],
    output: Annotated[Path, of_output("folder for the frames and meta.json", "-o", "--output", "--out", metavar="OUT")],
    frames: Annotated[str, of_input("such as 1001-1010x2", "--frames", metavar="RANGE")] = "1-7",
    size: Annotated[str, of_method("pixels of the rendered image", metavar="WxH")] = "320x180",
    film: Annotated[
        str | None, of_method("pixels of the whole camera, of which --size is a crop", metavar="WxH")
    ] = None,
    center: Annotated[
        str | None, of_method("center of the crop in the film, as fractions, y down", metavar="X,Y")
    ] = None,
    spp: Annotated[str, of_method("samples per pixel, n; LOW-HIGH: drawn for each shot", metavar="N")] = "16",
    levels: Annotated[str, of_method("noise levels, such as n,n/e,4 or noisy=n")] = "n,n/e,4",
    reference_frames: Annotated[
        str | None, of_method("frames with a reference, such as 1,4,7; default: all", metavar="NUMBERS")
    ] = None,
    seed: Annotated[int, of_input("seed of all random numbers")] = 1,
    shots: Annotated[int, of_input("number of shots, with seeds that count up", min=1, metavar="N")] = 1,
    jobs: Annotated[int, of_resources("Blender processes at a time", min=1, metavar="N")] = 1,
    threads: Annotated[
        int | None,
        of_resources(
            "threads of each process; default: the cores divided by --jobs", min=1, metavar="N", envvar="RAVG_THREADS"
        ),
    ] = None,
    python: Annotated[
        str | None,
        of_resources("Python interpreter with bpy; default: this one", metavar="FILE", envvar="RAVG_BLENDER_PYTHON"),
    ] = None,
    scheduler: SchedulerOption = None,
    **fields: Any,
) -> None:
    """Render shots with Cycles for training and comparison: several noise levels, and references.

    Examples:

    ravg simulate random -o shots --shots 36 --levels n,n,n/e,4

    ravg simulate scene.blend -o shot --frames 1-7 --spp 32 --reference 512
    """
    from hybrid.files.sequences import parse_frames

    known = [*RANDOM, *FIXED, *(f"{kind}:{name}" for kind, names in FIXED.items() for name in names)]
    if scene not in known and not Path(scene).is_file():
        raise FileNotFoundError(f"scene: no file {scene}; expected a .blend file or one of {', '.join(known)}")

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
