"""Render a shot with Cycles: the process that does the work, started by `hybrid.simulate.run`.

Blender keeps state between scenes and can fall over, so each shot is rendered in a process of its own:
`python -m hybrid.simulate.cycles JOB`, JOB being JSON. It answers in lines of JSON on standard output: first
the plan (unless the job brings one), then one line per finished frame.
"""

from __future__ import annotations

import dataclasses
import json
import os
import secrets
import sys
import tempfile
import time
from pathlib import Path
from typing import Any

import bpy
import numpy as np
import OpenEXR

from hybrid.simulate import scenes
from hybrid.simulate.effects import EVERYTHING, PASSES, effects_of, facts_of, needed_bounces, settings_of
from hybrid.simulate.fixed import fixed_shot
from hybrid.simulate.shot import FIXED, RANDOM, ShotSettings, frame_seed

PILOT_SAMPLES = 8
PILOT_PIXELS = 2400  # with 8 samples 19 thousand paths: a few tenths of a second, most of it to set up
PILOT_BOTH_ENDS = 30e6  # samples of a shot above which the pilot may take the time for two frames
SAMPLES = "cycles.ViewLayer.samples"  # what Cycles writes in a header: of one rendering, which may be a part
GUIDE_SAMPLES = 16  # of the unblurred pass: edges are antialiased, and nothing is lit


def configure(scene: Any, settings: dict[str, Any], threads: int) -> None:
    """Set up Cycles for unbiased frames with the passes that denoising reads, and `settings` on top.

    Denoising, adaptive sampling, clamping and glossy filtering are off: they would make levels of noise differ
    by more than noise.

    Passes are chosen here, once: in Blender 5.0.1 a change of passes between two renders with persistent data
    leaves meshes with the wrong attributes, and pictures 5 to 15 % too bright or dark. The same care for motion
    blur, which goes on and off within a frame: without persistent data there.

    Parameters
    ----------
    scene : bpy.types.Scene
        Blender's scene.
    settings : dict of str to object
        As for `apply`.
    threads : int
        That Cycles may use.
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
    """Set properties named `cycles.x`, `render.x`, `layer.x`, `camera.x` or `world.x`.

    Parameters
    ----------
    scene : bpy.types.Scene
        Blender's scene.
    settings : dict of str to object
        Values by name.
    """
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
    """Render the scene's current frame to `path`; of its samples, only `subset` (offset, length) if given.

    Parameters
    ----------
    scene : bpy.types.Scene
        Blender's scene.
    path : Path
        Of the file.
    samples : int
        Per pixel, of the whole frame.
    seed : int
        Of everything random.
    subset : (int, int), optional
        Offset and length of those that are rendered; all without.
    """
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


def render_small(scene: Any, settings: dict[str, Any], samples: int, seed: int) -> dict[str, np.ndarray]:
    """Render a pilot, at a scale at which the rendered region has about `PILOT_PIXELS`, with all passes.

    Parameters
    ----------
    scene : bpy.types.Scene
        Blender's scene.
    settings : dict of str to object
        As for `configure`.
    samples : int
        Per pixel.
    seed : int
        Of everything random.

    Returns
    -------
    dict of str to array
        Passes by name.
    """
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
            render_frame(scene, path, samples, seed)
            channels = read_channels(path)[1]
    finally:
        render.resolution_percentage = 100
    stacked: dict[str, np.ndarray] = {}
    for name in dict.fromkeys(name.rpartition(".")[0] for name in channels):
        parts = [part for part in ("R", "G", "B", "A", "X", "Y", "Z", "W", "V") if f"{name}.{part}" in channels]
        stacked[name.partition(".")[2]] = np.stack([channels[f"{name}.{part}"] for part in parts], axis=-1)
    return stacked


def pilot(scene: Any, frames: list[int], settings: dict[str, Any], seed: int) -> np.ndarray:
    """Return small, quick pictures of some frames, one under the other: (H, W, 3) linear radiance.

    Parameters
    ----------
    scene : bpy.types.Scene
        Blender's scene.
    frames : list of int
        Of the shot.
    settings : dict of str to object
        As for `configure`.
    seed : int
        Of everything random.

    Returns
    -------
    (H, W, 3) array
        Linear radiance, the frames one under the other.
    """
    pictures = []
    for frame in frames:
        scene.frame_set(frame)
        pictures.append(render_small(scene, settings, PILOT_SAMPLES, seed)["Combined"][..., :3])
    return np.concatenate(pictures).astype(np.float32)


def build(shot: ShotSettings, attempt: int, threads: int) -> dict[str, Any]:
    """Make the scene of a shot in Blender, ready to be planned, and return its description.

    Parameters
    ----------
    shot : ShotSettings
        What is asked for.
    attempt : int
        Which of the shots of one seed.
    threads : int
        That Cycles may use.

    Returns
    -------
    dict
        Its description.
    """
    if shot.scene in RANDOM:
        description = scenes.random_shot(shot, attempt)
    elif shot.scene.partition(":")[0] in FIXED:
        description = fixed_shot(shot)
    else:
        description = scenes.open_shot(shot)
    settings = EVERYTHING if shot.effects == "all" else {**EVERYTHING, **dict.fromkeys(PASSES, False)}
    configure(bpy.context.scene, settings, threads)
    bpy.context.scene.render.use_persistent_data = not shot.motion_blur
    return description


def make_plan(shot: ShotSettings, threads: int) -> dict[str, Any]:
    """Build the scene and decide what it calls for: description, facts, decisions, settings, for `meta.json`.

    A random shot that shows next to nothing is drawn again, and its exposure is chosen here: the geometric mean of
    the picture is put some stops around middle grey, since nobody lights a film by drawing watts.

    Parameters
    ----------
    shot : ShotSettings
        What is asked for.
    threads : int
        That Cycles may use.

    Returns
    -------
    dict
        Description, facts, decisions and settings, for `meta.json`.
    """
    started = time.perf_counter()
    middle = shot.frames[len(shot.frames) // 2]
    exposure: dict[str, Any] = {}
    for attempt in range(8):
        description = build(shot, attempt, threads)
        scene = bpy.context.scene
        scene.frame_set(middle)
        if shot.scene not in RANDOM:
            break
        passes = render_small(scene, {}, PILOT_SAMPLES, 1)
        worth = scenes.worth_rendering(passes)
        if worth is None:
            exposure = {"cycles.film_exposure": scenes.exposure(shot, passes)}
            break
        description["rejected"] = worth
    facts = facts_of(scene, shot.frames, shot.motion_blur)
    decisions = effects_of(facts)
    if shot.effects == "all":
        settings = {**EVERYTHING, "render.use_motion_blur": shot.motion_blur}
    else:
        settings = settings_of(decisions)
        apply(scene, {name: value for name, value in settings.items() if name.startswith("camera.")})
        # The ends, if anything moves and there is much to render: what comes into view may need what the rest does not.
        moves = facts.motion_pixels > 0 or facts.moving_lights
        work = shot.size[0] * shot.size[1] * sum(sum(shot.pictures(frame).values()) for frame in shot.frames)
        looked_at = sorted({shot.frames[0], shot.frames[-1]}) if moves and work > PILOT_BOTH_ENDS else [middle]
        cleanest = max([*shot.levels.values(), shot.reference])
        bounces = needed_bounces(lambda s, seed: pilot(scene, looked_at, s, seed), settings, PILOT_SAMPLES, cleanest)
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


def render_picture(scene: Any, shot: ShotSettings, path: Path, samples: int, seed: int) -> None:
    """Render the current frame to `path`, with half buffers and an unblurred guide pass where called for.

    Parameters
    ----------
    scene : bpy.types.Scene
        Blender's scene.
    shot : ShotSettings
        What is asked for.
    path : Path
        Of the file.
    samples : int
        Per pixel.
    seed : int
        Of everything random.
    """
    partial = _new_partial(path)
    try:
        if shot.halves:
            first = samples - samples // 2
            render_frame(scene, partial, samples, seed, (0, first))
            header, half_a = read_channels(partial)
            render_frame(scene, partial, samples, seed, (first, samples - first))
            _, half_b = read_channels(partial)
            share = np.float32(first / samples)  # of an odd number of samples, A has one more
            channels = {name: share * half_a[name] + (1 - share) * half_b[name] for name in half_a}
            channels = {name: values.astype(half_a[name].dtype) for name, values in channels.items()}
            for letter, half in (("A", half_a), ("B", half_b)):
                for c in "RGB":
                    channels[f"ViewLayer.Half {letter}.{c}"] = half[f"ViewLayer.Combined.{c}"]
        else:
            render_frame(scene, partial, samples, seed)
            header, channels = read_channels(partial) if scene.render.use_motion_blur else ({}, {})
        if scene.render.use_motion_blur:
            # Blurred, Cycles gives no vectors and smeared guides. Light does not matter in this pass, mirrors do.
            lit = {"render.use_motion_blur": True, "cycles.diffuse_bounces": scene.cycles.diffuse_bounces}
            apply(scene, {"render.use_motion_blur": False, "cycles.diffuse_bounces": 0})
            render_frame(scene, partial, min(samples, GUIDE_SAMPLES), seed)
            apply(scene, lit)
            _, sharp = read_channels(partial)
            lighting = {name: channels[name] for name in channels if ".Combined." in name or ".Half " in name}
            channels = {**sharp, **lighting}
        if channels:
            OpenEXR.File({**header, SAMPLES: str(samples)}, channels).write(str(partial))
        partial.rename(path)
    finally:
        partial.unlink(missing_ok=True)


def _new_partial(path: Path) -> Path:
    """A new file to render to, by a name that nobody can guess, so that Blender writes through nobody's link."""
    partial = path.with_name(f".{os.getpid()}-{secrets.token_hex(8)}-{path.name}")
    partial.touch(exist_ok=False)  # O_EXCL follows no link
    return partial


def render_reference(scene: Any, shot: ShotSettings, folder: Path, frame: int) -> None:
    """Render two independent halves of the reference, and their mean; of all only the colour is kept.

    Parameters
    ----------
    scene : bpy.types.Scene
        Blender's scene.
    shot : ShotSettings
        What is asked for.
    folder : Path
        Where it goes.
    frame : int
        Its number.
    """
    halves, half = [], max(shot.reference // 2, 1)
    for name in ("reference_a", "reference_b"):
        path = folder / f"{name}.{frame:04d}.exr"
        if not path.exists():
            partial = _new_partial(path)
            render_frame(scene, partial, half, frame_seed(shot.seed, name, frame))
            header, channels = read_channels(partial)
            color = {key: values for key, values in channels.items() if ".Combined." in key}
            OpenEXR.File(header, color).write(str(partial))
            partial.rename(path)
        halves.append(read_channels(path))
    (header, a), (_, b) = halves
    path = folder / f"reference.{frame:04d}.exr"
    partial = _new_partial(path)
    mean = {name: ((a[name].astype(np.float32) + b[name]) / 2).astype(np.float16) for name in a}
    OpenEXR.File({**header, SAMPLES: str(2 * half)}, mean).write(str(partial))
    partial.rename(path)


def main(job: dict[str, Any]) -> None:
    """Do one job: `shot`, `out`, `frames`, `threads`, and `plan` where there is one already."""
    answers = os.fdopen(os.dup(1), "w", buffering=1)
    os.dup2(2, 1)  # Blender talks on standard output; that goes to the log

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
        for name, samples in shot.pictures(frame).items():
            path = out / f"{name}.{frame:04d}.exr"
            if path.exists():
                continue
            started = time.perf_counter()
            if name == "reference":
                render_reference(scene, shot, out, frame)
            else:
                render_picture(scene, shot, path, samples, frame_seed(shot.seed, name, frame))
            answer(file=path.name, samples=samples, seconds=round(time.perf_counter() - started, 3))


if __name__ == "__main__":
    main(json.loads(Path(sys.argv[1]).read_text(encoding="utf-8")))
    sys.stderr.flush()
    os._exit(0)  # all is written; taking Blender down in order now and then crashes it
