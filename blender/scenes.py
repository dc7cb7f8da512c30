"""What a scene renders, what ravg needs of it, and what would spoil the result."""

from __future__ import annotations

import functools
import json
import os
import re
from dataclasses import dataclass
from pathlib import Path

import bpy

from . import frames

NO_LIGHT_PASSES = "Without Network does not denoise them, choose another preset or switch Light Passes off"
# Seen with Blender 5.0.1: the left view of a multi-view OpenEXR image in all views.
STEREO = "Blender's compositor shows the left eye's image in both: composite the frames in another program"


@dataclass(frozen=True)
class Problem:
    """What a scene lacks, in one line; `fixable` where `set_up` mends it."""

    text: str
    fixable: bool


def problems(scene: bpy.types.Scene) -> list[Problem]:
    """Say what prevents denoising or makes the result worse, and what to do about it, the gravest first."""
    if not is_placed(scene):
        return [Problem("File is not saved: save it, or name a folder in Noisy Frames", False)]
    return [*_of_frames(scene), *_of_passes(scene)]


def _of_frames(scene: bpy.types.Scene) -> list[Problem]:
    """Say what is wrong with the frames on disk, and with those that a render would replace."""
    found = []
    if reason := refused(scene):
        found.append(Problem(f"{reason} (Render and Denoise renders all again)", False))
    missing = set(frame_numbers(scene)) - rendered_files(scene).keys()
    if 0 < len(missing) < len(frame_numbers(scene)):
        found.append(Problem(f"Frames {frames.ranges(missing)} are missing: Render and Denoise renders them", False))
    if scene.render.use_multiview:
        found.append(Problem(f"Stereo: both eyes are denoised, but {STEREO}", False))
    if scene.render.use_sequencer and scene.sequence_editor is not None and _strips(scene):
        text = (
            "Sequencer has strips: Render Animation renders those, switch Post Processing > Sequencer off for the movie"
        )
        found.append(Problem(text, False))
    if would_be_written_over(scene):
        found.append(Problem("Output Path is that of ravg's frames: Render Animation skips them, name another", False))
    return found


def _of_passes(scene: bpy.types.Scene) -> list[Problem]:
    """Say what a render of the scene as it is set lacks."""
    render, found = scene.render, []
    if render.engine != "CYCLES":
        return [Problem("Engine is not Cycles: its noise is not of the kind that ravg removes, choose Cycles", False)]
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
    if scene.ravg.preset == "fast" and not scene.cycles.use_denoising:
        found.append(Problem("Render > Denoise is off: Fast is more accurate with Blender's own denoised frames", True))
    if scene.ravg.light_passes and scene.ravg.preset == "average":
        found.append(Problem(f"Light Passes: {NO_LIGHT_PASSES}", False))
    elif scene.ravg.light_passes and not any(_light_passes(layer) for layer in layers):
        found.append(Problem("Light Passes: no view layer renders any, choose them in View Layer > Passes", False))
    if render.use_motion_blur and not any(vectors):
        text = "Motion Blur is on: motion has to be found in the pictures, switch it off and blur afterwards"
        found.append(Problem(text, False))
    return found


def set_up(scene: bpy.types.Scene) -> list[str]:
    """Mend what is fixable among `problems`; return what was changed, in words."""
    render, changed = scene.render, []
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
    if scene.ravg.preset == "fast" and not scene.cycles.use_denoising:
        scene.cycles.use_denoising = True
        changed.append("Denoise")
    return changed


def frame_numbers(scene: bpy.types.Scene) -> range:
    """The frames that the scene renders."""
    return range(scene.frame_start, scene.frame_end + 1, scene.frame_step)


def noisy_files(scene: bpy.types.Scene) -> dict[int, Path]:
    """Frame number → the file of its noisy render, whether it is there or not."""
    before, width, after = _name(scene)
    return {n: Path(f"{before}{n:0{width}d}{after}") for n in frame_numbers(scene)}


def rendered_files(scene: bpy.types.Scene) -> dict[int, Path]:
    """Frame number → the file of its noisy render, for those that are there: one listing of their folder."""
    files = noisy_files(scene) if is_placed(scene) else {}
    try:
        there = set(os.listdir(Path(noisy_pattern(scene)).parent))
    except OSError:
        there = set()
    return {number: path for number, path in files.items() if path.name in there}


def noisy_pattern(scene: bpy.types.Scene) -> str:
    """The files of all noisy frames as one pattern, ``shot_####.exr``."""
    before, width, after = _name(scene)
    return f"{before}{'#' * width}{after}"


def output_folder(scene: bpy.types.Scene) -> Path:
    """The folder of the denoised frames: the one that the scene names, or ``denoised`` beside its noisy ones."""
    if scene.ravg.folder:
        return _absolute(scene.ravg.folder)
    noisy = Path(noisy_pattern(scene)).parent
    return (noisy if scene.ravg.noisy else noisy.parent) / "denoised"


def denoised_files(scene: bpy.types.Scene) -> dict[int, Path]:
    """Frame number → the denoised file, whether it is there or not."""
    folder = output_folder(scene)
    return {number: folder / path.name for number, path in noisy_files(scene).items()}


def is_placed(scene: bpy.types.Scene) -> bool:
    """Whether the folder of the noisy frames is known: a file that was never saved has none of its own."""
    return bool(bpy.data.filepath) or bool(scene.ravg.noisy and not scene.ravg.noisy.startswith("//"))


def refused(scene: bpy.types.Scene) -> str:
    """Say which of the noisy frames on disk is none, and why; empty where all are."""
    cycles = scene.render.engine == "CYCLES"
    for path in rendered_files(scene).values():
        if reason := _refusal(path, path.stat().st_mtime_ns, cycles):
            return f"{path.name} is no noisy frame: {reason}"
    return ""


@functools.lru_cache(maxsize=1 << 14)
def _refusal(path: Path, changed: int, cycles: bool) -> str:
    """`frames.refusal`, read once for each version of a file: the panel asks whenever it is drawn."""
    return frames.refusal(path, cycles=cycles)


def would_be_written_over(scene: bpy.types.Scene) -> list[Path]:
    """The noisy and denoised frames that Blender's own Render Animation would replace, as the scene is set."""
    if not is_placed(scene):
        return []
    kept = {*noisy_files(scene).values(), *denoised_files(scene).values()}
    try:
        first = _absolute(scene.render.frame_path(frame=scene.frame_start))
        if first.parent not in {path.parent for path in kept}:  # the common case, as often as a panel is drawn
            return []
        written = {_absolute(scene.render.frame_path(frame=number)) for number in frame_numbers(scene)}
    except RuntimeError:  # a path that Blender cannot read as a template: it does not render to it either
        return []
    return sorted(path for path in kept & written if path.is_file())


def lend(scene: bpy.types.Scene, *, replace: bool) -> None:
    """Set the render settings for noisy frames until `give_back`: own files, every pass, nothing of the compositor.

    Parameters
    ----------
    scene : Scene
        Its own settings are kept in ``scene.ravg.lent``, which a file keeps that is saved meanwhile.
    replace : bool
        Whether frames that are there are rendered again.

    Raises
    ------
    OSError
        If Blender would write other files than `noisy_files`.
    """
    settings: dict[str, object] = {
        "render.filepath": _literal(noisy_pattern(scene)),
        "render.image_settings.media_type": "MULTI_LAYER_IMAGE",  # Blender 5.0 and later choose the format in two steps
        "render.image_settings.file_format": "OPEN_EXR_MULTILAYER",
        "render.image_settings.color_mode": "RGBA",
        "render.image_settings.color_depth": "32",
        "render.image_settings.exr_codec": "ZIP",
        "render.image_settings.color_management": "FOLLOW_SCENE",
        "render.use_file_extension": True,
        "render.use_placeholder": False,
        "render.use_overwrite": replace,
        "render.use_compositing": False,
        "render.use_sequencer": False,
    }
    if scene.render.use_multiview:  # both eyes in one file, which ravg denoises both
        settings["render.image_settings.views_format"] = "MULTIVIEW"
    _lend(scene, settings)
    first = scene.frame_start
    written, expected = _absolute(scene.render.frame_path(frame=first)), noisy_files(scene)[first]
    if written != expected:
        give_back(scene)
        raise OSError(f"Blender would write {written}, expected {expected}: give Noisy Frames a plainer name")


def keep_existing(scene: bpy.types.Scene) -> None:
    """Have Blender's own render skip the frames that are there, until `give_back`."""
    _lend(scene, {"render.use_overwrite": False})


def give_back(scene: bpy.types.Scene) -> None:
    """Give a scene its own render settings back."""
    if scene.ravg.lent:
        for path, value in json.loads(scene.ravg.lent).items():
            _set(scene, path, value)
        scene.ravg.lent = ""


def _lend(scene: bpy.types.Scene, settings: dict[str, object]) -> None:
    give_back(scene)
    there = {path: value for path, value in settings.items() if hasattr(*_owner(scene, path))}
    scene.ravg.lent = json.dumps({path: getattr(*_owner(scene, path)) for path in there})
    try:
        for path, value in there.items():
            _set(scene, path, value)
    except BaseException:
        give_back(scene)
        raise


def _owner(scene: bpy.types.Scene, path: str) -> tuple[object, str]:
    """The object that has a property of the scene, and the property's own name."""
    owner, _, name = path.rpartition(".")
    return (scene.path_resolve(owner), name)


def _literal(path: str) -> str:
    """A path as Blender's Output Path: since 5.0 braces name a variable there, unless they are doubled."""
    return path.replace("{", "{{").replace("}", "}}") if bpy.app.version >= (5, 0, 0) else path


def _set(scene: bpy.types.Scene, path: str, value: object) -> None:
    setattr(*_owner(scene, path), value)


def _name(scene: bpy.types.Scene) -> tuple[str, int, str]:
    """The path of the noisy frames, as absolute text before and after the number, and the number's digits."""
    stem = bpy.path.clean_name(Path(bpy.data.filepath).stem or "untitled")
    path = scene.ravg.noisy or f"//ravg/{stem}/noisy/{bpy.path.clean_name(scene.name)}_"
    folder, name = re.fullmatch(r"(.*[/\\])?(.*)", path, re.DOTALL).groups()
    name = re.sub(r"\.exr$", "", name, flags=re.IGNORECASE)
    # As Blender: the last run of "#" in the name is the number, or four digits follow the name.
    before, width, after = re.fullmatch(r"(.*?)(#*)([^#]*)", name, re.DOTALL).groups()
    if not width:
        before, after = name, ""
    return os.path.join(_absolute(folder or "//"), before), len(width) or 4, f"{after}.exr"


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


def _strips(scene: bpy.types.Scene) -> bool:
    editor = scene.sequence_editor
    return bool(editor.strips_all if hasattr(editor, "strips_all") else editor.sequences_all)  # before Blender 4.4


def _light_passes(layer: bpy.types.ViewLayer) -> bool:
    """Whether a view layer renders passes of parts of the light."""
    named = [
        name for name in dir(layer) if re.match(r"use_pass_(diffuse|glossy|transmission)_(direct|indirect)$", name)
    ]
    return any(getattr(layer, name) for name in [*named, "use_pass_emit", "use_pass_environment"])


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
