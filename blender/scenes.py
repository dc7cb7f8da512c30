"""What a scene renders, what ravg needs of it, and what would spoil the result."""

from __future__ import annotations

import os
import re
from dataclasses import dataclass
from pathlib import Path

import bpy


@dataclass(frozen=True)
class Problem:
    """What a scene lacks, in one line; `fixable` where `set_up` mends it."""

    text: str
    fixable: bool


def problems(scene: bpy.types.Scene) -> list[Problem]:
    """Say what would spoil the denoised frames, or make them worse, the gravest first."""
    render, found = scene.render, []
    if render.image_settings.file_format != "OPEN_EXR_MULTILAYER":
        found.append(Problem("File format is not OpenEXR MultiLayer: the passes are not saved", True))
    if render.engine != "CYCLES":
        return [*found, Problem("Engine is not Cycles: there is no noise of the kind that ravg removes", False)]
    layers = _layers(scene)
    if any(not layer.cycles.denoising_store_passes for layer in layers):
        found.append(Problem("Denoising Data is off: textures blur, and noise that Blender removed is lost", True))
    vectors = [layer.use_pass_vector for layer in layers]
    if render.use_motion_blur and any(vectors):
        found.append(Problem("Motion Blur leaves the Vector pass empty: nothing would seem to move", True))
    elif not render.use_motion_blur and not all(vectors):
        found.append(Problem("Vector pass is off: motion has to be found in the pictures", True))
    if not (scene.cycles.use_animated_seed or _is_animated(scene, "cycles.seed")):
        found.append(Problem("Seed is constant: noise that stands still cannot be averaged away", True))
    if render.use_motion_blur and not any(vectors):
        found.append(Problem("Motion Blur is on: without vectors motion has to be found in the pictures", False))
    return found


def set_up(scene: bpy.types.Scene) -> list[str]:
    """Mend what is fixable among `problems`; return what was changed, in words."""
    render, changed = scene.render, []
    if render.image_settings.file_format != "OPEN_EXR_MULTILAYER":
        if hasattr(render.image_settings, "media_type"):  # Blender 5.0 and later choose the format in two steps
            render.image_settings.media_type = "MULTI_LAYER_IMAGE"
        render.image_settings.file_format = "OPEN_EXR_MULTILAYER"
        changed.append("OpenEXR MultiLayer")
    if render.engine != "CYCLES":
        return changed
    for layer in _layers(scene):
        if not layer.cycles.denoising_store_passes:
            layer.cycles.denoising_store_passes = True
            changed.append(f"Denoising Data of {layer.name}")
        if layer.use_pass_vector == render.use_motion_blur:
            layer.use_pass_vector = not render.use_motion_blur
            changed.append(f"{'Vector' if layer.use_pass_vector else 'no Vector'} of {layer.name}")
    if not (scene.cycles.use_animated_seed or _is_animated(scene, "cycles.seed")):
        scene.cycles.use_animated_seed = True
        changed.append("Animate Seed")
    return changed


def frame_files(scene: bpy.types.Scene) -> dict[int, Path]:
    """Frame number → the file that Blender writes for it, for the frames that the scene renders."""
    numbers = range(scene.frame_start, scene.frame_end + 1, scene.frame_step)
    return {number: _absolute(scene.render.frame_path(frame=number)) for number in numbers}


def frame_pattern(scene: bpy.types.Scene) -> str:
    """The files of all frames as one pattern, ``shot_####.exr``."""
    # Blender numbers by the last run of "#" in the name, or appends four digits.
    runs = re.findall("#+", re.split(r"[/\\]", scene.render.filepath)[-1])
    width = len(runs[-1]) if runs else 4
    one, two = (scene.render.frame_path(frame=int(digit * width)) for digit in "12")
    return str(_absolute("".join("#" if a != b else a for a, b in zip(one, two, strict=True))))


def output_folder(scene: bpy.types.Scene) -> Path:
    """Where the denoised frames go: the folder that the scene names, or ``denoised`` beside its frames."""
    named = scene.ravg.folder
    return _absolute(named) if named else Path(frame_pattern(scene)).parent / "denoised"


def denoised_files(scene: bpy.types.Scene) -> dict[int, Path]:
    """Frame number → the denoised file, whether it is there or not."""
    folder = output_folder(scene)
    return {number: folder / path.name for number, path in frame_files(scene).items()}


def load_denoised(scene: bpy.types.Scene) -> tuple[bpy.types.Image, int]:
    """Load the denoised frames as an image sequence; return it and its number of frames.

    Raises
    ------
    FileNotFoundError
        If there is none.
    """
    there = [path for path in denoised_files(scene).values() if path.is_file()]
    if not there:
        raise FileNotFoundError(f"no denoised frames in {output_folder(scene)}")
    image = bpy.data.images.load(str(there[0]), check_existing=True)
    image.source = "SEQUENCE"
    image.reload()
    return image, scene.frame_end - scene.frame_start + 1


def show_from(user: bpy.types.ImageUser | bpy.types.Node, scene: bpy.types.Scene, count: int) -> None:
    """Let an image editor, or a node, show at each frame of the scene the file of that number."""
    user.frame_duration = count
    user.frame_start, user.frame_offset = scene.frame_start, scene.frame_start - 1
    user.use_auto_refresh = True


def _layers(scene: bpy.types.Scene) -> list[bpy.types.ViewLayer]:
    return [layer for layer in scene.view_layers if layer.use]


def _is_animated(scene: bpy.types.Scene, path: str) -> bool:
    """Whether a driver or keys change a property of the scene."""
    data = scene.animation_data
    if data is None:
        return False
    curves = list(data.drivers)
    if data.action is not None:
        if hasattr(data.action, "fcurves"):
            curves += data.action.fcurves
        else:  # Blender 5.0 and later keep them in layers
            bags = [bag for layer in data.action.layers for strip in layer.strips for bag in strip.channelbags]
            curves += [curve for bag in bags for curve in bag.fcurves]
    return any(curve.data_path == path for curve in curves)


def _absolute(path: str) -> Path:
    return Path(os.path.abspath(bpy.path.abspath(path)))
