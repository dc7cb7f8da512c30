"""Render a shot with Cycles: the worker process that `hybrid.simulate.run` starts.

Blender keeps state between scenes and can crash, so each shot is rendered in a process of its own:
`python -m hybrid.simulate.cycles JOB`, JOB being a JSON file. The worker answers in lines of JSON on standard output:
first the plan (unless the job brings one), then one line per finished render.
"""

import dataclasses
import json
import os
import secrets
import sys
import tempfile
import threading
import time
from collections.abc import Iterator
from contextlib import contextmanager
from pathlib import Path
from typing import Any

import bpy
import numpy as np
import OpenEXR

from hybrid.simulate import scenes
from hybrid.simulate.effects import EVERYTHING, PASSES, PILOT_SAMPLES, effects_of, facts_of, needed_bounces, settings_of
from hybrid.simulate.shot import RANDOM, ShotSettings, frame_seed

PILOT_PIXELS = 2400  # with 8 samples 19 thousand paths: a few tenths of a second, most of it to set up
SAMPLES = "cycles.ViewLayer.samples"  # Cycles' header attribute; it counts one render, which may be a part


def configure(scene: Any, settings: dict[str, Any], threads: int) -> None:
    """Set up Cycles for unbiased frames with the passes that denoising reads, then `apply` the settings.

    Denoising, adaptive sampling, clamping and glossy filtering are off: they would make levels differ by more than
    noise. Passes are chosen here, once: in Blender 5.0.1 a change of passes between two renders with persistent data
    leaves meshes with the wrong attributes, and images 5 to 15 % too bright or dark. For the same reason a shot with
    motion blur, which is switched on and off within a frame, is rendered without persistent data.
    """
    render, layer, cycles = scene.render, scene.view_layers[0], scene.cycles
    render.engine = "CYCLES"
    render.use_compositing = render.use_sequencer = render.use_motion_blur = False
    render.threads_mode, render.threads = "FIXED", threads
    for name in dir(render):
        if name.startswith("use_stamp"):
            setattr(render, name, False)  # the stamps hold paths of the machine
    render.image_settings.media_type = "MULTI_LAYER_IMAGE"
    render.image_settings.file_format = "OPEN_EXR_MULTILAYER"
    render.image_settings.color_depth = "16"
    render.image_settings.exr_codec = "ZIP"
    render.image_settings.use_exr_interleave = True
    cycles.use_denoising = cycles.use_adaptive_sampling = cycles.use_animated_seed = False
    cycles.use_sample_subset = cycles.use_fast_gi = cycles.volume_biased = False
    cycles.time_limit = cycles.sample_clamp_direct = cycles.sample_clamp_indirect = cycles.blur_glossy = 0
    layer.use_pass_combined = layer.use_pass_z = layer.use_pass_vector = True
    layer.cycles.denoising_store_passes = True
    apply(scene, settings)


def apply(scene: Any, settings: dict[str, Any]) -> None:
    """Set properties named `cycles.x`, `render.x`, `layer.x`, `camera.x` or `world.x`."""
    roots = {"layer": scene.view_layers[0], "camera": scene.camera.data, "world": scene.world}
    for name, value in settings.items():
        root, *path, last = name.split(".")
        owner = roots[root] if root in roots else getattr(scene, root)
        if owner is None:  # a scene may have no world
            continue
        for step in path:
            owner = getattr(owner, step)
        setattr(owner, last, value)


def render_frame(scene: Any, path: Path, samples: int, seed: int, subset: tuple[int, int] | None = None) -> None:
    """Render the current frame to `path`; of its samples, only the `subset` (offset, length) if given."""
    scene.cycles.samples, scene.cycles.seed = samples, seed
    scene.cycles.use_sample_subset = subset is not None
    if subset is not None:
        scene.cycles.sample_offset, scene.cycles.sample_subset_length = subset
    scene.render.filepath = str(path)
    bpy.ops.render.render(write_still=True)


def read_channels(path: Path) -> tuple[dict[str, Any], dict[str, np.ndarray]]:
    """Return the header and the channels, (H, W) each, of a file that Blender wrote."""
    with OpenEXR.File(str(path), separate_channels=True) as file:
        return dict(file.header()), {name: np.array(channel.pixels) for name, channel in file.channels().items()}


def render_small(scene: Any, settings: dict[str, Any], seed: int) -> dict[str, np.ndarray]:
    """Render a pilot of about `PILOT_PIXELS` with `settings` applied; return its passes by name, (H, W, C) each."""
    render = scene.render
    fraction = 1.0
    if render.use_border:
        fraction = (render.border_max_x - render.border_min_x) * (render.border_max_y - render.border_min_y)
    percentage = 100 * (PILOT_PIXELS / (render.resolution_x * render.resolution_y * fraction)) ** 0.5
    apply(scene, settings)
    render.resolution_percentage = int(min(max(percentage, 1), 100))
    try:
        with tempfile.TemporaryDirectory() as folder:
            path = Path(folder) / "pilot.exr"
            render_frame(scene, path, PILOT_SAMPLES, seed)
            channels = read_channels(path)[1]
    finally:
        render.resolution_percentage = 100
    stacked: dict[str, np.ndarray] = {}
    for name in dict.fromkeys(name.rpartition(".")[0] for name in channels):
        parts = [part for part in ("R", "G", "B", "A", "X", "Y", "Z", "W", "V") if f"{name}.{part}" in channels]
        stacked[name.partition(".")[2]] = np.stack([channels[f"{name}.{part}"] for part in parts], axis=-1)
    return stacked


def pilot(scene: Any, frames: list[int], settings: dict[str, Any], seed: int) -> np.ndarray:
    """Return pilots of some frames, one below the other, (H, W, 3) linear radiance."""
    images = []
    for frame in frames:
        scene.frame_set(frame)
        images.append(render_small(scene, settings, seed)["Combined"][..., :3])
    return np.concatenate(images).astype(np.float32)


def build(shot: ShotSettings, attempt: int, threads: int) -> dict[str, Any]:
    """Make the scene of a shot, ready to be planned; return its description. `attempt` counts shots of a seed."""
    description = scenes.random_shot(shot, attempt) if shot.scene in RANDOM else scenes.file_shot(shot)
    settings = EVERYTHING if shot.effects == "all" else {**EVERYTHING, **dict.fromkeys(PASSES, False)}
    configure(bpy.context.scene, settings, threads)
    bpy.context.scene.render.use_persistent_data = not shot.motion_blur
    return description


def make_plan(shot: ShotSettings, threads: int) -> dict[str, Any]:
    """Build the scene and decide its settings; return description, facts, decisions and settings for `meta.json`.

    A random shot that shows next to nothing is drawn again, and its exposure is chosen here: the geometric mean of the
    image is put some stops around middle grey, as the power of random lamps means nothing.
    """
    started = time.perf_counter()
    exposure: dict[str, Any] = {}
    for attempt in range(8):
        description = build(shot, attempt, threads)
        scene = bpy.context.scene
        scene.frame_set(shot.middle)
        if shot.scene not in RANDOM:
            break
        passes = render_small(scene, {}, 1)
        rejected = scenes.rejection(passes)
        if rejected is None:
            exposure = {"cycles.film_exposure": scenes.exposure(shot, passes)}
            break
        description["rejected"] = rejected
    facts = facts_of(scene, shot.frames, shot.motion_blur)
    decisions = effects_of(facts)
    if shot.effects == "all":
        settings = {**EVERYTHING, "render.use_motion_blur": shot.motion_blur}
    else:
        settings = settings_of(decisions)
        apply(scene, {name: value for name, value in settings.items() if name.startswith("camera.")})
        # Both ends, if something moves and there is much to render: what comes into view may need deeper paths.
        moves = facts.motion_pixels > 0 or facts.moving_lights
        work = shot.size[0] * shot.size[1] * sum(sum(shot.renders(frame).values()) for frame in shot.frames)
        both_ends = moves and work > 30e6  # samples
        frames = sorted({shot.frames[0], shot.frames[-1]}) if both_ends else [shot.middle]
        cleanest = max([*shot.levels.values(), shot.reference])
        bounces = needed_bounces(lambda s, seed: pilot(scene, frames, s, seed), settings, cleanest)
        decisions += bounces
        settings = settings_of(bounces, settings)
    settings |= exposure
    apply(scene, settings)
    return {
        "attempt": attempt,
        "description": description,
        "facts": dataclasses.asdict(facts),
        "decisions": [dataclasses.asdict(decision) for decision in decisions],
        "printed": [str(decision) for decision in decisions],
        "cycles": settings,
        "blender": bpy.app.version_string,
        "plan_seconds": round(time.perf_counter() - started, 2),
    }


@contextmanager
def renamed_when_whole(path: Path, mark: str) -> Iterator[Path]:
    """Yield a new file beside `path` to render to, renamed to `path` at the end, or removed after an error.

    Its name begins with the `mark` of the job, by which unfinished files are found after this process was killed. The
    rest is random: Blender cannot write through a link that somebody placed there.
    """
    partial = path.with_name(f".{mark}-{secrets.token_hex(8)}-{path.name}")
    partial.touch(exist_ok=False)  # O_EXCL follows no link
    try:
        yield partial
        partial.rename(path)
    finally:
        partial.unlink(missing_ok=True)


def render_halves(scene: Any, path: Path, samples: int, seed: int) -> tuple[dict[str, Any], dict[str, np.ndarray]]:
    """Render two halves of the samples; return the header and the channels of their mean, with both halves' color."""
    first = samples - samples // 2
    render_frame(scene, path, samples, seed, (0, first))
    header, half_a = read_channels(path)
    render_frame(scene, path, samples, seed, (first, samples - first))
    _, half_b = read_channels(path)
    share = np.float32(first / samples)  # of an odd number of samples, A has one more
    channels = {name: (share * half_a[name] + (1 - share) * half_b[name]).astype(half_a[name].dtype) for name in half_a}
    for letter, half in (("A", half_a), ("B", half_b)):
        channels |= {f"ViewLayer.Half {letter}.{c}": half[f"ViewLayer.Combined.{c}"] for c in "RGB"}
    return header, channels


def render_level(scene: Any, shot: ShotSettings, path: Path, samples: int, seed: int, mark: str = "") -> None:
    """Render the current frame to `path`, with half buffers and an unblurred guide pass where the shot needs them."""
    blur = scene.render.use_motion_blur
    with renamed_when_whole(path, mark) as partial:
        if shot.halves:
            header, channels = render_halves(scene, partial, samples, seed)
        else:
            render_frame(scene, partial, samples, seed)
            header, channels = read_channels(partial) if blur else ({}, {})
        if blur:
            # With blur, Cycles writes no vectors and smears guides. This pass needs no light but mirrors, and few
            # samples for its edges.
            lit = {"render.use_motion_blur": True, "cycles.diffuse_bounces": scene.cycles.diffuse_bounces}
            apply(scene, {"render.use_motion_blur": False, "cycles.diffuse_bounces": 0})
            render_frame(scene, partial, min(samples, 16), seed)
            apply(scene, lit)
            lighting = {name: channels[name] for name in channels if ".Combined." in name or ".Half " in name}
            channels = {**read_channels(partial)[1], **lighting}
        if channels:
            OpenEXR.File({**header, SAMPLES: str(samples)}, channels).write(str(partial))


def render_reference(scene: Any, shot: ShotSettings, folder: Path, frame: int, mark: str) -> None:
    """Render two halves of the reference with independent seeds, and write their mean; color only."""
    halves, half = [], max(shot.reference // 2, 1)
    for name in ("reference_a", "reference_b"):
        path = folder / f"{name}.{frame:04d}.exr"
        if not path.exists():
            with renamed_when_whole(path, mark) as partial:
                render_frame(scene, partial, half, frame_seed(shot.seed, name, frame))
                header, channels = read_channels(partial)
                color = {key: values for key, values in channels.items() if ".Combined." in key}
                OpenEXR.File(header, color).write(str(partial))
        halves.append(read_channels(path))
    (header, a), (_, b) = halves
    mean = {name: ((a[name].astype(np.float32) + b[name]) / 2).astype(np.float16) for name in a}
    with renamed_when_whole(folder / f"reference.{frame:04d}.exr", mark) as partial:
        OpenEXR.File({**header, SAMPLES: str(2 * half)}, mean).write(str(partial))


def main(job: dict[str, Any]) -> None:
    """Do one job: `shot`, `out`, `frames`, `threads`, `mark`, and `plan` where the shot is planned already."""
    answers = os.fdopen(os.dup(1), "w", buffering=1)
    os.dup2(2, 1)  # Blender prints to standard output; redirected to the log

    def answer(**message: Any) -> None:
        answers.write(json.dumps(message) + "\n")

    shot, out, plan = ShotSettings.from_json(job["shot"]), Path(job["out"]), job.get("plan")
    if plan is None:
        plan = make_plan(shot, job["threads"])
        answer(plan=plan)
    elif job["frames"]:
        build(shot, plan["attempt"], job["threads"])
        apply(bpy.context.scene, plan["cycles"])
    scene = bpy.context.scene
    for frame in job["frames"]:
        scene.frame_set(frame)
        for name, samples in shot.renders(frame).items():
            path = out / f"{name}.{frame:04d}.exr"
            if path.exists():
                continue
            started = time.perf_counter()
            if name == "reference":
                render_reference(scene, shot, out, frame, job["mark"])
            else:
                render_level(scene, shot, path, samples, frame_seed(shot.seed, name, frame), job["mark"])
            answer(file=path.name, samples=samples, seconds=round(time.perf_counter() - started, 3))


def end_with_parent() -> None:
    """End the process when its standard input is closed, as it is when the one that started it ends."""

    def wait() -> None:
        sys.stdin.buffer.read()
        os._exit(1)

    threading.Thread(target=wait, daemon=True).start()


if __name__ == "__main__":
    end_with_parent()
    main(json.loads(Path(sys.argv[1]).read_text(encoding="utf-8")))
    sys.stderr.flush()
    os._exit(0)  # all is written; an orderly exit of Blender sometimes crashes
