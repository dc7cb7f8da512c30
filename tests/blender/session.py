"""Blender as a process of its own, for the tests of the extension: how a script is run, and what scripts begin with."""

import json
import os
import re
import subprocess
import sys
import textwrap
import tomllib
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import numpy as np
import OpenEXR
import pytest

ROOT = Path(__file__).parents[2]
EXTENSION = ROOT / "blender"
VERSION = tomllib.loads((EXTENSION / "blender_manifest.toml").read_text(encoding="utf-8"))["version"]
NAME = "bl_ext.user_default.ravg"
RAVG = os.environ.get("RAVG_COMMAND", "")
needs_ravg = pytest.mark.skipif(not RAVG, reason="runs ravg: RAVG_COMMAND is to name it")

# A camera that passes a wall and a ball under one lamp, rendered as new files are: PNG, one seed, no passes.
SCENE = """
bpy.ops.wm.read_factory_settings()
scene = bpy.context.scene
for item in list(bpy.data.objects):
    bpy.data.objects.remove(item)
def surface(scale):
    made = bpy.data.materials.new("m"); made.use_nodes = True
    tree = made.node_tree
    noise = tree.nodes.new("ShaderNodeTexNoise")
    noise.inputs["Scale"].default_value = scale
    tree.links.new(noise.outputs["Color"], tree.nodes["Principled BSDF"].inputs["Base Color"])
    return made
bpy.ops.mesh.primitive_plane_add(size=12, location=(0, 2, 0), rotation=(1.5708, 0, 0))
bpy.context.active_object.data.materials.append(surface(3))
bpy.ops.mesh.primitive_uv_sphere_add(radius=0.8)
bpy.context.active_object.data.materials.append(surface(6))
bpy.ops.object.light_add(type="AREA", location=(2, -3, 3), rotation=(0.9, 0, 0.5))
bpy.context.active_object.data.energy = 400
bpy.ops.object.camera_add(location=(0, -6, 0), rotation=(1.5708, 0, 0))
scene.camera = bpy.context.active_object
for frame in (1, 10):
    scene.camera.location.x = 0.05 * frame
    scene.camera.keyframe_insert("location", frame=frame)
scene.render.engine = "CYCLES"
scene.cycles.samples, scene.cycles.use_denoising, scene.cycles.use_adaptive_sampling = 4, False, False
scene.render.resolution_x, scene.render.resolution_y, scene.render.resolution_percentage = 96, 54, 100
scene.frame_start, scene.frame_end = 4, 6
scene.render.filepath = "//movie/shot_"
bpy.ops.wm.save_as_mainfile(filepath=FILE)
"""

# Functions for scripts: the same steps in all versions of Blender.
STEPS = """
def choose_format(image, kind, file_format, depth=""):
    if hasattr(image, "media_type"):  # since Blender 5.0
        image.media_type = kind
    image.file_format = file_format
    if depth:
        image.color_depth = depth
def movie(name):
    choose_format(scene.render.image_settings, "IMAGE", "OPEN_EXR", "32")
    scene.render.filepath = f"//{name}/"
    bpy.ops.render.render(animation=True)
def empty_compositor():
    if not hasattr(scene, "compositing_node_group"):
        scene.use_nodes = True
        scene.node_tree.nodes.clear()
        return scene.node_tree, scene.node_tree.nodes.new("CompositorNodeComposite")
    tree = scene.compositing_node_group = bpy.data.node_groups.new("Mine", "CompositorNodeTree")
    tree.interface.new_socket("Image", in_out="OUTPUT", socket_type="NodeSocketColor")
    return tree, tree.nodes.new("NodeGroupOutput")
def file_output(tree):
    files = tree.nodes.new("CompositorNodeOutputFile")
    choose_format(files.format, "MULTI_LAYER_IMAGE", "OPEN_EXR_MULTILAYER", "32")
    if hasattr(files, "file_output_items"):
        files.file_output_items.new("RGBA", "Image")
    return files
def aim(files, directory, name):
    if hasattr(files, "directory"):
        files.directory, files.file_name = directory, name
    else:
        files.base_path = directory + name
def end_of(tree):
    return next(node for node in tree.nodes if node.type in ("GROUP_OUTPUT", "COMPOSITE"))
def add_strip():
    editor = scene.sequence_editor_create()
    strips = editor.strips if hasattr(editor, "strips") else editor.sequences
    end = {"length": 20} if bpy.app.version >= (5, 0, 0) else {"frame_end": 21}
    strips.new_effect(name="red", type="COLOR", channel=1, frame_start=1, **end)
"""


@dataclass(frozen=True)
class Blender:
    """Blender with settings of its own, started anew for every script."""

    resources: Path
    archive: Path
    installed: bool = True

    def run(self, code: str, *, blend: Path | None = None, command: str = RAVG, **names: object) -> Any:
        """Run a script, with the extension switched on where it is installed; return what it leaves in `answer`."""
        script = "import bpy, json, sys, time\nimport addon_utils\nfrom pathlib import Path\nanswer = None\n"
        if blend is not None:
            script += f"bpy.ops.wm.open_mainfile(filepath={str(blend)!r})\n"
        if self.installed:
            script += f"addon_utils.enable({NAME!r}, default_set=True)\n"
            script += f"bpy.context.preferences.addons[{NAME!r}].preferences.command = {command!r}\n"
        script += (
            STEPS + "scene = bpy.context.scene\n" + "".join(f"{name} = {value!r}\n" for name, value in names.items())
        )
        script += textwrap.dedent(code) + "\nprint('ANSWER', json.dumps(answer, default=str))\n"
        done = subprocess.run(
            [sys.executable, "-c", script],
            capture_output=True,
            text=True,
            check=False,
            env={**os.environ, "BLENDER_USER_RESOURCES": str(self.resources)},
        )
        found = re.search(r"^ANSWER (.*)$", done.stdout, re.MULTILINE)
        assert found, done.stdout + done.stderr
        return json.loads(found[1])


def blender_extension(*arguments: str) -> subprocess.CompletedProcess[str]:
    """`blender --command extension …`, which Blender's module has as a function only."""
    code = (
        "import bpy, sys; from bl_pkg.bl_extension_cli import cli_extension_handler as run; sys.exit(run(sys.argv[1:]))"
    )
    return subprocess.run([sys.executable, "-c", code, *arguments], capture_output=True, text=True, check=False)


def channels(path: Path) -> dict[str, np.ndarray]:
    """The channels of all parts of a file, less the name of the view layer."""
    with OpenEXR.File(str(path), separate_channels=True) as file:
        found = {name: channel.pixels for part in file.parts for name, channel in part.channels.items()}
    return {name.removeprefix("ViewLayer."): pixels for name, pixels in found.items()}


def picture(path: Path, name: str = "Combined") -> np.ndarray:
    """One pass of a file, (H, W, 3)."""
    found = channels(path)
    return np.stack([found[f"{name}.{c}"] for c in "RGB"], axis=-1).astype(np.float64)


PROBLEMS = """
from bl_ext.user_default.ravg import scenes
def texts():
    return [problem.text.partition(":")[0].partition(" is ")[0] for problem in scenes.problems(scene)]
"""

# As one makes a movie: the compositor gets the denoised frames, and the animation is rendered through it.
COMPOSE = """
bpy.ops.ravg.add_to_compositor()
tree = getattr(scene, "compositing_node_group", None) or scene.node_tree
"""

FAILING = """
try:
    bpy.ops.ravg.denoise()
except RuntimeError as error:
    answer = [str(error).strip(), bpy.ops.ravg.denoise.poll(), "ravg.log" in bpy.data.texts]
"""

# Blender draws panels only in a window. This stands in for its layout: it records texts, and refuses what the layout of
# this version of Blender would refuse.
DRAWN = """
from types import SimpleNamespace
from bl_ext.user_default.ravg import jobs, operators, panel
functions = bpy.types.UILayout.bl_rna.functions
drawn = []
def operator(name):
    return getattr(bpy.ops.ravg, name).get_rna_type()
class Chosen:
    def __init__(self, kind): self.__dict__["kind"] = kind
    def __setattr__(self, name, value): assert name in self.kind.properties, name
class Layout:
    def __getattr__(self, name):
        parameters = {p.identifier: p for p in functions[name].parameters}
        names = [p.identifier for p in parameters.values() if not p.is_output]
        def call(*values, **how):
            how.update(zip(names, values))
            for key, value in how.items():
                assert key in names, (name, key)
                items = parameters[key].enum_items if parameters[key].type == "ENUM" else ()
                assert not items or value in items, (name, key, value)
            text = how.get("text")
            if name == "prop":
                text = how["data"].bl_rna.properties[how["property"]].name if text is None else None
            elif name == "prop_enum":
                text = how["data"].bl_rna.properties[how["property"]].enum_items[how["value"]].name
            elif name == "operator":
                kind = operator(how["operator"].partition(".")[2])
                text = text or kind.name
            elif name == "progress":
                assert 0 <= how["factor"] <= 1
            drawn.extend([text] if text else [])
            return Chosen(kind) if name == "operator" else self
        return call
def draw(kind=panel.OutputPanel, **how):
    drawn.clear()
    kind.draw(SimpleNamespace(layout=Layout(), **how), bpy.context)
    return list(drawn)
"""
