"""A scene's noisy and denoised files, the passes that ravg needs, and settings that would spoil the result."""

import functools
import glob
import json
import os
import re
from collections.abc import Iterator
from pathlib import Path
from typing import NamedTuple

import bpy

from . import frames

try:
    from _cycles import with_openimagedenoise as with_denoiser  # False in Debian's Blender
except ImportError:
    with_denoiser = True

NO_LIGHT_PASSES = "Without Network does not denoise them, choose another preset or switch Light Passes off"
# Seen with Blender 5.0.1: the left view of a multi-view OpenEXR image in all views.
STEREO = (
    "Stereo: Blender's compositor shows the left eye's image in both, and Render Animation renders the noisy scene: "
    "composite the denoised frames in another program"
)


class Problem(NamedTuple):
    """A problem of a scene, in one line; `fixable` if `set_up` repairs it."""

    text: str
    fixable: bool


def problems(scene: bpy.types.Scene) -> list[Problem]:
    """Return what prevents denoising or makes the result worse, with the remedy, the gravest first."""
    if reason := misplaced(scene):
        return [Problem(reason, False)]
    return [*_of_frames(scene), *_of_passes(scene)]


def _of_frames(scene: bpy.types.Scene) -> Iterator[Problem]:
    """Yield the problems of the frames on disk, and of those that a render would replace."""
    pattern = Path(noisy_pattern(scene))
    for other in bpy.data.scenes:  # default paths hold only the letters and digits of a scene's name
        if other != scene and Path(noisy_pattern(other)) == pattern:
            yield Problem(f"Scene {other.name} has these Noisy Frames too: both write them, choose another path", False)
    if reason := refused(scene):
        yield Problem(f"{reason} (Render and Denoise renders all again)", False)
    missing = set(frame_numbers(scene)) - rendered_files(scene).keys()
    if 0 < len(missing) < len(frame_numbers(scene)):
        yield Problem(f"Frames {frames.ranges(missing)} are missing: Render and Denoise renders them", False)
    if scene.render.use_multiview:
        yield Problem(STEREO, False)
    if scene.render.use_sequencer and scene.sequence_editor is not None and _strips(scene):
        remedy = "switch Post Processing > Sequencer off for the movie"
        yield Problem(f"Sequencer has strips: Render Animation renders those, {remedy}", False)
    if not scene.ravg.lent and would_be_written_over(scene):  # `override` sets this path for ravg's own render
        yield Problem("Output Path is that of ravg's frames: Render Animation skips them, name another", False)
    elif not scene.ravg.lent and _mixes(scene):
        text = "Output Path leads into the folder of ravg's frames: the movie mixes with them, name another"
        yield Problem(text, False)
    if nodes := file_outputs(scene):
        text = f"{', '.join(nodes.values())}: the folder is that of ravg's frames, and nothing is written, name another"
        yield Problem(text, False)


def _of_passes(scene: bpy.types.Scene) -> Iterator[Problem]:
    """Yield the problems of a render with the scene's current settings."""
    render = scene.render
    if render.engine != "CYCLES":
        yield Problem("Engine is not Cycles: its noise is not of the kind that ravg removes, choose Cycles", False)
        return
    if scene.frame_step > 1:
        text = "Frame Step is not 1: the Vector pass leads to frames that are missing, ravg gains less"
        yield Problem(f"{text}: set it to 1, or do not denoise them", False)
    layers = _layers(scene)
    if any(not layer.cycles.denoising_store_passes for layer in layers):
        yield Problem("Denoising Data is off: textures blur, and noise that Blender removed is lost", True)
    vectors = [layer.use_pass_vector for layer in layers]
    if render.use_motion_blur and any(vectors):
        yield Problem("Motion Blur leaves the Vector pass empty: nothing would seem to move", True)
    elif not render.use_motion_blur and not all(vectors):
        yield Problem("Vector pass is off: motion has to be found in the pictures", True)
    if not _has_seeds(scene):
        yield Problem("Seed is constant: noise that stands still cannot be averaged away", True)
    if _wrong_denoise(scene):
        text = "Render > Denoise is off: Fast is more accurate with Blender's own denoised frames"
        if scene.cycles.use_denoising:
            text = "Render > Denoise is on, but this Blender has no denoiser: the render would fail"
        yield Problem(text, True)
    if scene.ravg.light_passes and scene.ravg.preset == "average":
        yield Problem(f"Light Passes: {NO_LIGHT_PASSES}", False)
    elif scene.ravg.light_passes and not any(_light_passes(layer) for layer in layers):
        yield Problem("Light Passes: no view layer renders any, choose them in View Layer > Passes", False)
    if render.use_motion_blur and not any(vectors):
        text = "Motion Blur is on: motion has to be found in the pictures, switch it off and blur afterwards"
        yield Problem(text, False)


def set_up(scene: bpy.types.Scene) -> list[str]:
    """Repair what is fixable among `problems`; return the names of the changed settings."""
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
    if not _has_seeds(scene):
        scene.cycles.use_animated_seed = True
        changed.append("Animate Seed")
    if _wrong_denoise(scene):
        scene.cycles.use_denoising = not scene.cycles.use_denoising
        changed.append("Denoise" if scene.cycles.use_denoising else "no Denoise")
    if changed:
        forget_data(scene)
    return changed


def forget_data(scene: bpy.types.Scene) -> None:
    """Drop the data that Persistent Data has kept: with other passes, Blender would render wrong images from it."""
    if scene.render.use_persistent_data:
        scene.render.use_persistent_data = False
        scene.render.use_persistent_data = True


def _wrong_denoise(scene: bpy.types.Scene) -> bool:
    """Whether Render > Denoise is on where Blender was built without a denoiser, or off for Fast where it has one."""
    if not with_denoiser:
        return scene.cycles.use_denoising
    return scene.ravg.preset == "fast" and not scene.cycles.use_denoising


def frame_numbers(scene: bpy.types.Scene) -> range:
    return range(scene.frame_start, scene.frame_end + 1, scene.frame_step)


def noisy_files(scene: bpy.types.Scene) -> dict[int, Path]:
    """Frame number → file of the noisy render, existing or not."""
    before, width, after = _name(scene)
    return {n: Path(f"{before}{n:0{width}d}{after}") for n in frame_numbers(scene)}


def rendered_files(scene: bpy.types.Scene) -> dict[int, Path]:
    """Frame number → file of the noisy render, for existing files; lists their folder once."""
    return _existing(noisy_files(scene)) if is_placed(scene) else {}


def _existing(files: dict[int, Path]) -> dict[int, Path]:
    """Return the files that exist, all of one folder."""
    there = _names(next(iter(files.values())).parent) if files else set()
    return {number: path for number, path in files.items() if path.name in there}


def _names(folder: Path) -> set[str]:
    """The names in a folder, if it exists."""
    try:
        return set(os.listdir(folder))
    except OSError:
        return set()


def noisy_pattern(scene: bpy.types.Scene) -> str:
    """The pattern of the noisy frames, ``shot_####.exr``."""
    before, width, after = _name(scene)
    return f"{before}{'#' * width}{after}"


def output_folder(scene: bpy.types.Scene) -> Path:
    """The folder of the denoised frames: the scene's setting, or ``denoised`` beside the noisy frames."""
    if scene.ravg.folder:
        return absolute(scene.ravg.folder)
    noisy = Path(noisy_pattern(scene)).parent
    return (noisy if scene.ravg.noisy else noisy.parent) / "denoised"


def denoised_files(scene: bpy.types.Scene) -> dict[int, Path]:
    """Frame number → denoised file, existing or not."""
    folder = output_folder(scene)
    return {number: folder / path.name for number, path in noisy_files(scene).items()}


def denoised_frames(scene: bpy.types.Scene) -> dict[int, Path]:
    """Frame number → denoised file, for existing files; lists their folder once."""
    return _existing(denoised_files(scene)) if is_placed(scene) else {}


def is_denoised(scene: bpy.types.Scene, path: Path) -> bool:
    """Whether a path is that of a denoised frame, existing or not, of whatever number."""
    before, _, after = _name(scene)
    pattern = rf"{re.escape(os.path.basename(before))}\d+{re.escape(after)}"
    return path.parent == output_folder(scene) and bool(re.fullmatch(pattern, path.name))


def is_placed(scene: bpy.types.Scene) -> bool:
    """Whether the folder of the noisy frames is known; without a setting it is that of the saved file."""
    return bool(bpy.data.filepath) or bool(scene.ravg.noisy and not scene.ravg.noisy.startswith("//"))


def misplaced(scene: bpy.types.Scene) -> str:
    """Return why no frames can be rendered or denoised with the scene's paths, and the remedy; empty if they can."""
    chosen = scene.ravg
    if "{" in chosen.noisy or "}" in chosen.noisy:
        return "Noisy Frames has { or }: ravg fills in no variables of Blender, write out the path"
    # Without a file, other paths lead to the folder that Blender was started in.
    paths = chosen.noisy, chosen.folder or chosen.noisy
    if not bpy.data.filepath and not all(map(_is_absolute, paths)):
        return "File is not saved: save it, or write out the paths of Noisy Frames and Denoised Frames"
    if output_folder(scene) == Path(noisy_pattern(scene)).parent:
        return "Denoised Frames is the folder of the noisy frames: choose another"
    return ""


def refused(scene: bpy.types.Scene) -> str:
    """Return which file on disk is no noisy frame, and why; empty if all are."""
    cycles = scene.render.engine == "CYCLES"
    there = rendered_files(scene)
    if not there and (name := _other_format(scene)):
        return f"{name} is no noisy frame: ravg reads passes, which only OpenEXR MultiLayer files have"
    for path in there.values():
        try:
            reason = _refusal(path, path.stat().st_mtime_ns, cycles)
        except OSError as error:  # a link to nothing, or a file that was removed meanwhile
            reason = f"it cannot be read ({error.strerror})"
        if reason:
            return f"{path.name} is no noisy frame: {reason}"
    return ""


def _other_format(scene: bpy.types.Scene) -> str:
    """The first picture of another format that is named as a noisy frame but for the ending; empty without one."""
    if not is_placed(scene):
        return ""
    stems = {path.stem for path in noisy_files(scene).values()}  # the setting itself may end in ".png"
    names = _names(Path(noisy_pattern(scene)).parent)
    formats = set(bpy.path.extensions_image) - {".exr"}
    found = (x for x in names if Path(x).suffix.lower() in formats and {x, Path(x).stem} & stems)
    return min(found, default="")


@functools.lru_cache(maxsize=1 << 14)
def _refusal(path: Path, changed: int, cycles: bool) -> str:
    """`frames.refusal`, cached for each version of a file: the panel calls it at each redraw."""
    return frames.refusal(path, cycles=cycles)


def would_be_written_over(scene: bpy.types.Scene) -> list[Path]:
    """The noisy and denoised frames that Blender's own Render Animation would overwrite."""
    if not is_placed(scene):
        return []
    kept = {*noisy_files(scene).values(), *denoised_files(scene).values()}
    try:
        first = absolute(scene.render.frame_path(frame=scene.frame_start))
        if first.parent not in {path.parent for path in kept}:  # the common case, made fast for the panel
            return []
        written = {absolute(scene.render.frame_path(frame=number)) for number in frame_numbers(scene)}
    except RuntimeError:  # an invalid path template, to which Blender does not render either
        return []
    return sorted(path for path in kept & written if path.is_file())


def _mixes(scene: bpy.types.Scene) -> bool:
    """Whether Render Animation writes other files into a folder of ravg's frames."""
    if not is_placed(scene):
        return False
    kept = {*noisy_files(scene).values(), *denoised_files(scene).values()}
    try:
        written = absolute(scene.render.frame_path(frame=scene.frame_start))
    except RuntimeError:  # an invalid path template, to which Blender does not render either
        return False
    return written not in kept and written.parent in {path.parent for path in kept}


def file_outputs(scene: bpy.types.Scene) -> dict[str, str]:
    """Path in the scene of a File Output node that writes to a folder of ravg's frames → the node's name."""
    if not is_placed(scene):
        return {}
    kept = Path(noisy_pattern(scene)).parent, output_folder(scene)
    return {
        path: node.name
        for path, node in nodes(scene)
        if node.type == "OUTPUT_FILE" and any(folder.match(pattern) for pattern in _folders(node) for folder in kept)
    }


def nodes(scene: bpy.types.Scene) -> Iterator[tuple[str, bpy.types.Node]]:
    """Yield the compositor's nodes, those of groups too, with their paths in the scene."""
    name = "compositing_node_group" if hasattr(scene, "compositing_node_group") else "node_tree"  # since Blender 5.0
    if (tree := getattr(scene, name)) is not None:
        yield from _nodes(tree, name, set())


def _nodes(tree: bpy.types.NodeTree, where: str, seen: set[bpy.types.NodeTree]) -> Iterator[tuple[str, bpy.types.Node]]:
    """Yield the nodes of a tree and of the groups in it, each tree once, with their paths in the scene."""
    seen.add(tree)
    for node in tree.nodes:
        path = f'{where}.nodes["{bpy.utils.escape_identifier(node.name)}"]'
        yield path, node
        if (inner := getattr(node, "node_tree", None)) is not None and inner not in seen:
            yield from _nodes(inner, f"{path}.node_tree", seen)


def _folders(node: bpy.types.Node) -> Iterator[str]:
    """Yield the folders that a File Output node writes to, as patterns of `Path.match`."""
    if hasattr(node, "directory"):
        base, names = node.directory, [node.file_name]
    elif node.format.file_format == "OPEN_EXR_MULTILAYER":  # before Blender 5.0, here and below
        base, *names = os.path.split(node.base_path)
    else:
        base, names = node.base_path, [slot.path for slot in node.file_slots]
    for name in names:
        # A name may begin with a folder, and be empty after it. Blender joins both, whatever the name begins with.
        path = absolute(os.path.join(absolute(base or "/"), f"{name}_".lstrip("/\\")))
        # Since Blender 4.5 braces hold variables, which may stand for any name.
        yield re.sub(r"\{[^{}]*\}", "*", glob.escape(str(path.parent)))


def override(scene: bpy.types.Scene, *, replace: bool) -> None:
    """Set the render settings for noisy frames until `restore`; with `replace`, existing frames are rendered again.

    The scene's own settings are kept in ``scene.ravg.lent``, also in a file that is saved meanwhile. OSError if Blender
    would write other files than `noisy_files`.
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
    _override(scene, settings)
    forget_data(scene)
    first = scene.frame_start
    written, expected = absolute(scene.render.frame_path(frame=first)), noisy_files(scene)[first]
    if written != expected:
        restore(scene)
        raise OSError(f"Blender would write {written}, expected {expected}: give Noisy Frames a plainer name")


def keep_existing(scene: bpy.types.Scene) -> list[str]:
    """Let Blender's own render write over no frame of ravg, until `restore`; return messages about what is skipped."""
    settings: dict[str, object] = {}
    said = []
    if kept := would_be_written_over(scene):
        settings["render.use_overwrite"] = False
        said.append(f"{len(kept)} frames of ravg in {kept[0].parent} are not written over: name another Output Path")
    for path, name in file_outputs(scene).items():
        settings[f"{path}.mute"] = True
        said.append(f"{name} does not write into the folder of ravg's frames: name another folder in the node")
    if settings:
        _override(scene, settings)
    return said


def restore(scene: bpy.types.Scene) -> None:
    """Restore the scene's own render settings, except those of nodes that were renamed or removed meanwhile."""
    if lent := scene.ravg.lent:
        scene.ravg.lent = ""
        for path, value in json.loads(lent).items():
            try:
                _set(scene, path, value)
            except (AttributeError, TypeError, ValueError) as error:
                print(f"ravg: {path} is not restored to {value}: {error}")


def _override(scene: bpy.types.Scene, settings: dict[str, object]) -> None:
    """Set the settings that this version of Blender has, and keep the scene's own."""
    restore(scene)
    there = {path: value for path, value in settings.items() if hasattr(*_owner(scene, path))}
    scene.ravg.lent = json.dumps({path: getattr(*_owner(scene, path)) for path in there})
    try:
        for path, value in there.items():
            _set(scene, path, value)
    except BaseException:
        restore(scene)
        raise


def _owner(scene: bpy.types.Scene, path: str) -> tuple[object, str]:
    """The owner of a property of the scene, and the property's name."""
    owner, _, name = path.rpartition(".")
    return scene.path_resolve(owner), name


def _literal(path: str) -> str:
    """Escape a path for Blender's Output Path, in which braces hold variables since 4.5."""
    return path.replace("{", "{{").replace("}", "}}") if bpy.app.version >= (4, 5, 0) else path


def _set(scene: bpy.types.Scene, path: str, value: object) -> None:
    setattr(*_owner(scene, path), value)


def _name(scene: bpy.types.Scene) -> tuple[str, int, str]:
    """The absolute path of the noisy frames, before the number, the number's digits, and after the number."""
    stem = bpy.path.clean_name(Path(bpy.data.filepath).stem or "untitled")
    path = scene.ravg.noisy or f"//ravg/{stem}/noisy/{bpy.path.clean_name(scene.name)}_"
    folder, name = re.fullmatch(r"(.*[/\\])?(.*)", path, re.DOTALL).groups()
    name = re.sub(r"\.exr$", "", name, flags=re.IGNORECASE)
    # Blender's rule: the last run of "#" in the name is the number, or four digits follow the name.
    before, width, after = re.fullmatch(r"(.*?)(#*)([^#]*)", name, re.DOTALL).groups()
    if not width:
        before, after = name, ""
    return os.path.join(absolute(folder or "//"), before), len(width) or 4, f"{after}.exr"


def load_denoised(scene: bpy.types.Scene) -> tuple[bpy.types.Image, int]:
    """Load the denoised frames as an image sequence; return it and its length. FileNotFoundError without frames."""
    there = denoised_frames(scene)
    if not there:
        raise FileNotFoundError(f"no denoised frames in {output_folder(scene)}")
    path = str(next(iter(there.values())))
    image = bpy.data.images.load(path, check_existing=True)
    image.source = "SEQUENCE"
    if bpy.data.filepath and not _is_absolute(scene.ravg.folder or scene.ravg.noisy):
        image.filepath = bpy.path.relpath(path)  # moves along with the file, as the settings do
    image.reload()
    return image, scene.frame_end - scene.frame_start + 1


def make_relative(file: str) -> None:
    """Write the paths below the folder of the file to be saved as relative ones: the folder may be moved."""
    folder = os.path.join(os.path.dirname(file), "")
    for scene in bpy.data.scenes if file else ():
        for name in ("noisy", "folder"):
            if (path := getattr(scene.ravg, name)).startswith(folder):
                setattr(scene.ravg, name, f"//{path[len(folder) :]}")


def _is_absolute(path: str) -> bool:
    return os.path.isabs(path) and not path.startswith("//")


def show_from(user: bpy.types.ImageUser | bpy.types.Node, scene: bpy.types.Scene, count: int) -> None:
    """Let an image editor or a node show the file of each frame number of the scene."""
    user.frame_duration = count
    user.frame_start, user.frame_offset = scene.frame_start, scene.frame_start - 1
    user.use_auto_refresh = True


def _layers(scene: bpy.types.Scene) -> list[bpy.types.ViewLayer]:
    return [layer for layer in scene.view_layers if layer.use]


def _strips(scene: bpy.types.Scene) -> bool:
    editor = scene.sequence_editor
    return bool(editor.strips_all if hasattr(editor, "strips_all") else editor.sequences_all)  # before Blender 4.4


def _light_passes(layer: bpy.types.ViewLayer) -> bool:
    named = "use_pass_((diffuse|glossy|transmission)_(direct|indirect)|emit|environment)"
    return any(getattr(layer, name) for name in dir(layer) if re.fullmatch(named, name))


def _has_seeds(scene: bpy.types.Scene) -> bool:
    """Whether each frame has a seed of its own: by the switch, or by a driver or keys."""
    data = scene.animation_data
    if scene.cycles.use_animated_seed:
        return True
    if data is None:
        return False
    curves = list(data.drivers)
    if data.action is not None:
        if hasattr(data.action, "fcurves"):
            curves += data.action.fcurves
        else:  # Blender 5.0 and later keep them in layers
            bags = [bag for layer in data.action.layers for strip in layer.strips for bag in strip.channelbags]
            curves += [curve for bag in bags for curve in bag.fcurves]
    return any(curve.data_path == "cycles.seed" for curve in curves)


def absolute(path: str) -> Path:
    # Blender reads a backslash as the system's separator, as in a file that was saved on Windows.
    return Path(os.path.abspath(bpy.path.abspath(path).replace("\\", os.sep)))
