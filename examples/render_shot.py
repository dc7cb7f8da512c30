"""Render a noisy shot, and a reference of it, with Cycles through ``bpy`` 5.0.1.

    python examples/render_shot.py scene.blend out/shot --spp 32 --reference 512

Writes one multi-layer EXR per frame and noise level, in the layout that Blender's own
"OpenEXR MultiLayer" output has: ``out/shot/noisy.0008.exr``, ``out/shot/reference.0008.exr``; two references are
``reference_a`` and ``reference_b``.
The image is a crop (render border) of a film-size camera, so that motion and texture have the
statistics of a real shot and not those of a thumbnail. Existing frames are skipped, so an interrupted
run can be resumed.

The script reproduces the bundled shot, the shots of the report, those that the weights were trained on, and frames
with Blender's default settings. For new shots use `ravg simulate`.
"""

import argparse
import os
import random
import sys
from pathlib import Path

import bpy
import numpy as np
import OpenEXR
from mathutils import Vector


def parse_arguments(argv: list[str]) -> argparse.Namespace:
    parser = argparse.ArgumentParser(description=__doc__.split("\n")[0])
    parser.add_argument("scene", type=Path)
    parser.add_argument("out", type=Path)
    parser.add_argument("--camera", default="Camera_move")
    parser.add_argument("--frames", default="8-14", help="first-last")
    parser.add_argument("--size", default="320x180", help="pixels of the rendered crop")
    parser.add_argument("--film", default="1920x1080", help="pixels of the whole camera")
    parser.add_argument("--center", default="0.5,0.5", help="center of the crop in the film, as fractions, y down")
    parser.add_argument("--levels", default="noisy=32", help="NAME=SPP[,NAME=SPP…]; independent seeds")
    parser.add_argument("--reference", type=int, default=0, help="samples per pixel of a reference; 0: none")
    parser.add_argument("--reference-frames", metavar="FIRST-LAST", help="frames with a reference; default: all")
    parser.add_argument(
        "--second-reference", action="store_true", help="write reference_a and reference_b, of other seeds"
    )
    parser.add_argument("--moving-objects", type=int, default=0, help="add objects that cross the crop")
    defaults = "Blender's defaults: OIDN with its passes stored, adaptive sampling, clamped indirect light, one seed"
    parser.add_argument("--defaults", action="store_true", help=defaults)
    parser.add_argument("--compact", action="store_true", help="write rounded halves, without denoising depth")
    parser.add_argument("--seed", type=int, default=1)
    parser.add_argument("--threads", type=int, default=2)
    return parser.parse_args(argv)


def set_crop(render: bpy.types.RenderSettings, film: str, size: str, center: str) -> None:
    """Render only `size` pixels of a `film`-sized camera, around `center`."""
    (film_w, film_h), (w, h) = (map(int, text.split("x")) for text in (film, size))
    cx, cy = map(float, center.split(","))
    left = min(max(round(cx * film_w - w / 2), 0), film_w - w)
    top = min(max(round(cy * film_h - h / 2), 0), film_h - h)
    render.resolution_x, render.resolution_y, render.resolution_percentage = film_w, film_h, 100
    render.use_border = render.use_crop_to_border = True
    render.border_min_x, render.border_max_x = left / film_w, (left + w) / film_w
    render.border_min_y, render.border_max_y = 1 - (top + h) / film_h, 1 - top / film_h


def random_material(rng: random.Random) -> bpy.types.Material:
    """Make a two-tone noise texture, diffuse to glossy, sometimes metal."""
    material = bpy.data.materials.new("mover")
    material.use_nodes = True
    nodes, links = material.node_tree.nodes, material.node_tree.links
    surface = nodes["Principled BSDF"]
    surface.inputs["Roughness"].default_value = rng.uniform(0.1, 0.9)
    surface.inputs["Metallic"].default_value = float(rng.random() < 0.25)
    texture, ramp = nodes.new("ShaderNodeTexNoise"), nodes.new("ShaderNodeValToRGB")
    texture.inputs["Scale"].default_value = 10 ** rng.uniform(0.3, 1.4)
    for stop in ramp.color_ramp.elements:
        stop.color = (*(rng.uniform(0.05, 0.85) for _ in range(3)), 1)
    ramp.color_ramp.elements[0].position, ramp.color_ramp.elements[1].position = 0.4, 0.6
    links.new(texture.outputs["Fac"], ramp.inputs["Fac"])
    links.new(ramp.outputs["Color"], surface.inputs["Base Color"])
    return material


def add_moving_object(scene: bpy.types.Scene, rng: random.Random, film: str, size: str, center: str, mid: int) -> None:
    """Add an object that crosses the crop at a few pixels per frame, between the camera and the scene."""
    (film_w, film_h), (w, h) = (map(int, text.split("x")) for text in (film, size))
    cx, cy = map(float, center.split(","))
    scene.frame_set(mid)
    camera = scene.camera
    frame = [camera.matrix_world @ corner for corner in camera.data.view_frame(scene=scene)]
    top_right, bottom_right, _, top_left = frame
    right, down = top_right - top_left, bottom_right - top_right
    x = cx + rng.uniform(-0.35, 0.35) * w / film_w
    y = cy + rng.uniform(-0.35, 0.35) * h / film_h
    eye = camera.matrix_world.translation
    direction = (top_left + x * right + y * down - eye).normalized()
    hit, position, *_ = scene.ray_cast(bpy.context.evaluated_depsgraph_get(), eye, direction)
    distance = (position - eye).length if hit else 10.0
    depth = rng.uniform(0.4, 0.8) * distance
    plane = (top_left + x * right + y * down - eye).length
    pixel = right.length / film_w * depth / plane  # world units per film pixel there
    shape = rng.choice(["monkey", "torus", "cube", "uv_sphere"])
    getattr(bpy.ops.mesh, f"primitive_{shape}_add")(location=eye + direction * depth)
    item = bpy.context.active_object
    item.scale = Vector((1, 1, 1)) * pixel * rng.uniform(0.12, 0.3) * h
    item.data.materials.clear()
    item.data.materials.append(random_material(rng))
    if item.data.polygons and rng.random() < 0.7:
        bpy.ops.object.shade_smooth()
    speed = 10 ** rng.uniform(0.2, 1.1)  # 1.6 to 12.6 film pixels per frame
    along = Vector((rng.gauss(0, 1), rng.gauss(0, 0.6)))
    along.normalize()
    velocity = (right.normalized() * along.x + down.normalized() * along.y) * pixel * speed
    start, turn = item.location.copy(), [rng.gauss(0, 0.06) for _ in range(3)]
    # Keys one window beyond the shot, so that the vectors are valid on its first and last frame.
    for frame_number in range(mid - 12, mid + 13):
        step = frame_number - mid
        item.location = start + velocity * step
        item.rotation_euler = [angle * step for angle in turn]
        item.keyframe_insert("location", frame=frame_number)
        item.keyframe_insert("rotation_euler", frame=frame_number)


def configure(scene: bpy.types.Scene, threads: int) -> None:
    render, view_layer = scene.render, scene.view_layers[0]
    render.engine = "CYCLES"
    render.use_persistent_data = True
    render.threads_mode, render.threads = "FIXED", threads
    for name in dir(render):
        if name.startswith("use_stamp"):
            setattr(render, name, False)  # the stamps hold paths of the machine
    render.image_settings.media_type = "MULTI_LAYER_IMAGE"
    render.image_settings.file_format = "OPEN_EXR_MULTILAYER"
    render.image_settings.color_depth = "16"
    render.image_settings.exr_codec = "ZIP"
    render.image_settings.use_exr_interleave = True
    scene.cycles.use_denoising = scene.cycles.use_adaptive_sampling = False
    scene.cycles.use_animated_seed = False
    for name in ("position", "normal", "z", "vector"):
        setattr(view_layer, f"use_pass_{name}", name in ("z", "vector"))
    view_layer.cycles.denoising_store_passes = True
    view_layer.cycles.pass_debug_sample_count = False


def set_defaults(scene: bpy.types.Scene) -> None:
    """Set the defaults of Blender 5.0, where `configure` differs from them."""
    cycles = scene.cycles
    cycles.use_denoising, cycles.denoiser = True, "OPENIMAGEDENOISE"
    cycles.use_adaptive_sampling, cycles.adaptive_threshold = True, 0.01
    cycles.sample_clamp_indirect = 10
    scene.view_layers[0].cycles.pass_debug_sample_count = True


def render_level(scene: bpy.types.Scene, folder: Path, name: str, spp: int, frames: range, seed: int) -> None:
    scene.cycles.samples = spp
    for frame in frames:
        path = folder / f"{name}.{frame:04d}.exr"
        if path.exists():
            continue
        if not scene.cycles.use_denoising:
            scene.cycles.seed = seed * 100_003 + frame  # another seed for every frame and level
        scene.frame_set(frame)
        partial = path.with_name(f".{os.getpid()}-{path.name}")
        scene.render.filepath = str(partial)
        bpy.ops.render.render(write_still=True)
        partial.rename(path)


STEPS = {"Denoising Albedo": 1 / 64, "Denoising Normal": 1 / 128, "Vector": 1 / 32}


def rounded(name: str, pixels: np.ndarray) -> np.ndarray:
    """A channel as half, rounded far below the noise of a few samples: to `STEPS`, others to six bits."""
    step = next((step for layer, step in STEPS.items() if layer in name), None)
    if step is None:
        fraction, exponent = np.frexp(pixels.astype(np.float32))
        return np.ldexp(np.round(fraction * 64) / 64, exponent).clip(-65504, 65504).astype(np.float16)
    return (np.round(pixels / step) * step).clip(-65504, 65504).astype(np.float16)


def compact(path: Path) -> None:
    """Rewrite a file as half, rounded, without the second depth: a fifth of the size, for shots in a repository."""
    source = OpenEXR.File(str(path), separate_channels=True)
    channels = {
        name: OpenEXR.Channel(rounded(name, channel.pixels))
        for name, channel in source.channels().items()
        if "Denoising Depth" not in name
    }
    partial = path.with_name(f".{os.getpid()}-{path.name}")
    OpenEXR.File(source.header() | {"compression": OpenEXR.ZIP_COMPRESSION}, channels).write(str(partial))
    partial.rename(path)


def main(argv: list[str]) -> int:
    options = parse_arguments(argv)
    if not options.scene.is_file():
        print(f"error: no scene {options.scene}", file=sys.stderr)
        return 1
    bpy.ops.wm.open_mainfile(filepath=str(options.scene.resolve()))
    scene = bpy.context.scene
    scene.camera = bpy.data.objects[options.camera]
    configure(scene, options.threads)
    if options.defaults:
        set_defaults(scene)
    set_crop(scene.render, options.film, options.size, options.center)
    first, last = map(int, options.frames.split("-"))
    frames = range(first, last + 1)
    rng = random.Random(options.seed)
    for _ in range(options.moving_objects):
        add_moving_object(scene, rng, options.film, options.size, options.center, (first + last) // 2)
    options.out.mkdir(parents=True, exist_ok=True)
    out = options.out.resolve()
    for number, level in enumerate(options.levels.split(",")):
        name, spp = level.split("=")
        render_level(scene, out, name, int(spp), frames, options.seed * 10 + number)
    if options.reference:
        # Blender 5.0 renders wrong pictures if passes change while it keeps the scene between renders.
        scene.render.use_persistent_data = False
        scene.cycles.use_denoising = scene.cycles.use_adaptive_sampling = False
        scene.view_layers[0].cycles.denoising_store_passes = False
        scene.view_layers[0].use_pass_z = scene.view_layers[0].use_pass_vector = False
        if options.reference_frames:
            first, last = map(int, options.reference_frames.split("-"))
            frames = range(first, last + 1)
        name = "reference_a" if options.second_reference else "reference"
        render_level(scene, out, name, options.reference, frames, options.seed * 10 + 9)
        if options.second_reference:
            render_level(scene, out, "reference_b", options.reference, frames, options.seed * 10 + 8)
    if options.compact:
        for path in sorted(out.glob("*.exr")):
            compact(path)
    return 0


if __name__ == "__main__":
    raise SystemExit(main(sys.argv[1:]))
