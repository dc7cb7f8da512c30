"""Render the known translation that pins Cycles' motion vectors (needs ``bpy`` 5.0.1).

    python tests/data/render_translation.py

An orthographic camera, one world unit per pixel, looks at a textured, self-lit plane that moves by
(+3, -2) pixels (x right, y down) from frame 1 to frame 2, and by (+4, +1) from 2 to 3. The four numbers
differ in size, and so cannot be confused. Written beside this script: `translation_cycles.npz`, with the
luminance of the three frames and the Vector pass of the middle one.
"""

import tempfile
from pathlib import Path

import bpy
import numpy as np
import OpenEXR

WIDTH, HEIGHT = 56, 40
POSITIONS = {0: (-3, 2), 1: (0, 0), 2: (3, -2), 3: (7, -1), 4: (11, 0)}  # pixels, y down


def build_scene() -> bpy.types.Scene:
    bpy.ops.wm.read_factory_settings(use_empty=True)
    scene = bpy.context.scene
    scene.world = bpy.data.worlds.new("world")

    bpy.ops.mesh.primitive_plane_add(size=4 * WIDTH)
    plane = bpy.context.active_object
    material = bpy.data.materials.new("texture")
    material.use_nodes = True
    nodes, links = material.node_tree.nodes, material.node_tree.links
    nodes.clear()
    place, noise = nodes.new("ShaderNodeTexCoord"), nodes.new("ShaderNodeTexNoise")
    light, output = nodes.new("ShaderNodeEmission"), nodes.new("ShaderNodeOutputMaterial")
    noise.inputs["Scale"].default_value = 0.2  # one blob per five pixels
    links.new(place.outputs["Object"], noise.inputs["Vector"])
    links.new(noise.outputs["Fac"], light.inputs["Strength"])
    links.new(light.outputs["Emission"], output.inputs["Surface"])
    plane.data.materials.append(material)
    for frame, (x, y) in POSITIONS.items():
        plane.location = (x, -y, 0)  # the world's y points up
        plane.keyframe_insert("location", frame=frame)

    camera = bpy.data.cameras.new("camera")
    camera.type, camera.ortho_scale = "ORTHO", max(WIDTH, HEIGHT)
    scene.camera = bpy.data.objects.new("camera", camera)
    scene.camera.location = (0, 0, 10)
    scene.collection.objects.link(scene.camera)
    return scene


def configure(scene: bpy.types.Scene) -> None:
    render, view_layer = scene.render, scene.view_layers[0]
    render.engine = "CYCLES"
    render.resolution_x, render.resolution_y, render.resolution_percentage = WIDTH, HEIGHT, 100
    render.threads_mode, render.threads = "FIXED", 1
    scene.cycles.samples, scene.cycles.seed = 64, 1
    scene.cycles.use_denoising = scene.cycles.use_adaptive_sampling = False
    view_layer.use_pass_vector = True
    render.image_settings.media_type = "MULTI_LAYER_IMAGE"
    render.image_settings.file_format = "OPEN_EXR_MULTILAYER"
    render.image_settings.color_depth = "16"
    render.image_settings.use_exr_interleave = True


def main() -> int:
    scene = build_scene()
    configure(scene)
    arrays = {}
    with tempfile.TemporaryDirectory() as folder:
        for frame in (1, 2, 3):
            scene.frame_set(frame)
            scene.render.filepath = str(Path(folder) / f"{frame}.exr")
            bpy.ops.render.render(write_still=True)
            with OpenEXR.File(scene.render.filepath) as file:
                channels = file.channels()
                color = next(channels[name].pixels for name in channels if name.endswith("Combined"))
                arrays[f"frame{frame}"] = color[..., 1].astype(np.float16)
                if frame == 2:
                    prefix = next(name for name in channels if name.endswith("Vector.X"))[:-1]
                    vector = [channels[prefix + axis].pixels for axis in "XYZW"]
                    arrays["vector"] = np.stack(vector, axis=-1).astype(np.float32)
    np.savez_compressed(Path(__file__).with_name("translation_cycles.npz"), **arrays)
    return 0


if __name__ == "__main__":
    raise SystemExit(main())
