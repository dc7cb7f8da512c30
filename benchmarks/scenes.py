"""Write scenes of small bright lamps, glass and metal: shots to judge the denoiser by.

    python benchmarks/scenes.py FOLDER [NAME ...]

writes FOLDER/NAME.blend with ``bpy`` 5.0.1 for each NAME, all by default:

- neon: a sign of curved tubes before a dim brick wall and above a glossy floor; an arrow swings, balls roll.
- headlamps: a dark car at night with two small lamps drives over a wet street.
- chandelier: twenty bulbs among glass drops turn before the walls of a room with a mirror.
- water: a pool with waves, glints of a small sun, caustics on the tiles, a ball and a ring afloat.

Camera and objects move on frames 0 to 25; materials are Principled, textures procedural. The middle 60 % of the
picture hold the subject, since shots are crops. Each shot of the second ladder is rendered by

    ravg simulate FOLDER/NAME.blend --out second/NAME --film 320x180 --size 192x108 --frames 4-10 \\
        --levels s032=32,s128=128 --reference 384 --reference-frames 6,7,8 --python BLENDER/bin/python

which writes two references of 192 samples each, `reference_a` and `reference_b`; frames with Blender's default
settings, beside those that Blender has denoised, by

    python examples/render_shot.py FOLDER/NAME.blend second_blender/NAME --defaults --size 192x108 --film 480x270 \\
        --frames 4-10 --reference-frames 6-8 --levels s008=8,s064=64 --reference 300 --second-reference
"""

import sys
from collections.abc import Callable
from math import cos, pi, radians, sin, tau
from pathlib import Path
from random import Random
from typing import Any

import bpy
import numpy as np
from mathutils import Vector

Triple = tuple[float, float, float]
FRAMES = range(26)
ORIGIN: Triple = (0, 0, 0)
UPRIGHT: Triple = (pi / 2, 0, 0)
SIDEWAYS: Triple = (0, pi / 2, 0)
BRICK = {"Brick_Width": 0.3, "Row_Height": 0.1, "Mortar_Size": 0.008}
TILE = {"Brick_Width": 0.2, "Row_Height": 0.2, "Mortar_Size": 0.008}


def material(color: Triple = (0.8, 0.8, 0.8), roughness: float = 0.5, **inputs: Any) -> Any:
    """A Principled material; inputs are sockets, with _ for spaces."""
    made = bpy.data.materials.new("material")
    for socket, value in {"Base_Color": (*color, 1), "Roughness": roughness, **inputs}.items():
        made.node_tree.nodes["Principled BSDF"].inputs[socket.replace("_", " ")].default_value = value
    return made


def lamp(color: Triple, strength: float) -> Any:
    return material(ORIGIN, Emission_Color=(*color, 1), Emission_Strength=strength)


def glass(ior: float = 1.5) -> Any:
    return material((1, 1, 1), 0, IOR=ior, Transmission_Weight=1)


def metal(color: Triple = (0.9, 0.88, 0.85), roughness: float = 0.05) -> Any:
    return material(color, roughness, Metallic=1)


def pattern(surface: Any, texture: str, scale: float, dark: Triple, bright: Triple, **values: Any) -> Any:
    """Connect a texture of object coordinates, from dark to bright, to a socket, the base color by default."""
    nodes, link = surface.node_tree.nodes, surface.node_tree.links.new
    socket = values.pop("socket", "Base Color")
    node, ramp = nodes.new(f"ShaderNodeTex{texture}"), nodes.new("ShaderNodeValToRGB")
    for name, value in {"Scale": scale, **values}.items():
        node.inputs[name.replace("_", " ")].default_value = value
    if texture == "Brick":
        node.offset = 0 if values == TILE else 0.5
        for name, shade in (("Color1", 1), ("Color2", 0.6), ("Mortar", 0)):
            node.inputs[name].default_value = (shade, shade, shade, 1)
    for stop, color, position in zip(ramp.color_ramp.elements, (dark, bright), (0.4, 0.6), strict=True):
        stop.color, stop.position = (*color, 1), position if texture == "Noise" else stop.position
    link(nodes.new("ShaderNodeTexCoord").outputs["Object"], node.inputs["Vector"])
    link(node.outputs[0], ramp.inputs["Fac"])
    link(ramp.outputs["Color"], nodes["Principled BSDF"].inputs[socket])
    return surface


def place(item: Any, surface: Any, at: Triple = ORIGIN, turn: Triple = ORIGIN, scale: Triple = (1, 1, 1)) -> Any:
    if surface is not None:
        item.data.materials.append(surface)
    item.location, item.rotation_euler, item.scale = at, turn, scale
    return item


def link(data: Any, surface: Any = None, *pose: Triple, on: Any = None) -> Any:
    """Add an object of data, in the coordinates of the object that it hangs `on`; without data, a pivot for others."""
    item = bpy.data.objects.new("item", data)
    bpy.context.collection.objects.link(item)
    item.parent = on
    return place(item, surface, *pose)


def add(shape: str, surface: Any, *pose: Triple, on: Any = None, flat: bool = False, **options: Any) -> Any:
    """Add a primitive mesh."""
    getattr(bpy.ops.mesh, f"primitive_{shape}_add")(**options)
    item = bpy.context.object
    item.parent = on
    if not flat:
        item.data.shade_smooth()
        item.data.set_sharp_from_angle(angle=0.7)
    return place(item, surface, *pose)


def ball(surface: Any, radius: float, *pose: Triple, on: Any = None) -> Any:
    return add("uv_sphere", surface, *pose, on=on, radius=radius, segments=48, ring_count=24)


def rod(surface: Any, radius: float, depth: float, *pose: Triple, on: Any = None) -> Any:
    return add("cylinder", surface, *pose, on=on, radius=radius, depth=depth, vertices=64)


def tube(surface: Any, radius: float, points: list[Triple], closed: bool = False, on: Any = None) -> Any:
    """Add a round tube along a smooth curve through points."""
    curve = bpy.data.curves.new("tube", "CURVE")
    curve.dimensions, curve.bevel_depth, curve.use_fill_caps = "3D", radius, True
    spline = curve.splines.new("BEZIER")
    spline.use_cyclic_u = closed
    spline.bezier_points.add(len(points) - 1)
    for knot, point in zip(spline.bezier_points, points, strict=True):
        knot.co, knot.handle_left_type, knot.handle_right_type = point, "AUTO", "AUTO"
    return link(curve, surface, on=on)


def prism(surface: Any, width: float, profile: list[tuple[float, float]], on: Any) -> Any:
    """Add a body with a side view of points (y, z), `width` along x, and round edges."""
    count = len(profile)
    mesh = bpy.data.meshes.new("prism")
    corners = [(x, y, z) for x in (-width / 2, width / 2) for y, z in profile]
    sides = [(k, (k + 1) % count, count + (k + 1) % count, count + k) for k in range(count)]
    mesh.from_pydata(corners, [], [*sides, tuple(range(count))[::-1], tuple(range(count, 2 * count))])
    mesh.shade_smooth()
    item = link(mesh, surface, on=on)
    rounding = item.modifiers.new("bevel", "BEVEL")
    rounding.width, rounding.segments, rounding.harden_normals = 0.06, 4, True
    return item


def animate(item: Any, path: str, value: Callable[[int], Any]) -> None:
    """Set a property on every frame."""
    for frame in FRAMES:
        setattr(item, path, value(frame))
        item.keyframe_insert(path, frame=frame)


def shoot(lens: float, eyes: tuple[Triple, Triple], targets: tuple[Triple, Triple]) -> None:
    """Add a camera that moves between two eyes and turns between two targets."""
    camera = link(bpy.data.cameras.new("camera"))
    camera.name, camera.data.lens, bpy.context.scene.camera = "Camera_move", lens, camera
    eye, target = (lambda f, a=a, b=b: Vector(a).lerp(Vector(b), f / FRAMES[-1]) for a, b in (eyes, targets))
    animate(camera, "location", eye)
    animate(camera, "rotation_euler", lambda f: (target(f) - eye(f)).to_track_quat("-Z", "Y").to_euler())


def sky(color: Triple, strength: float) -> None:
    bpy.context.scene.world = bpy.data.worlds.new("world")
    background = bpy.context.scene.world.node_tree.nodes["Background"]
    background.inputs["Color"].default_value, background.inputs["Strength"].default_value = (*color, 1), strength


def neon() -> None:
    sky((0.4, 0.5, 0.8), 0.015)
    brick = pattern(material(roughness=0.6), "Brick", 1, (0.12, 0.1, 0.09), (0.38, 0.13, 0.08), **BRICK)
    floor = pattern(material((0.06, 0.055, 0.06)), "Noise", 3, (0.03,) * 3, (0.2,) * 3, socket="Roughness")
    add("plane", brick, (0, 1, 3), UPRIGHT, size=14)
    add("plane", floor, size=14)
    text = bpy.data.curves.new("text", "FONT")
    text.body, text.size, text.fill_mode, text.bevel_depth, text.align_x = "BAR", 0.75, "NONE", 0.014, "CENTER"
    link(text, lamp((1, 0.1, 0.35), 40), (-0.3, 0.9, 1.1), UPRIGHT)
    frame = [(1.16, 1), (1.16, 1.72), (1, 1.88), (-1, 1.88), (-1.16, 1.72), (-1.16, 1), (-1, 0.84), (1, 0.84)]
    tube(lamp((0.1, 0.35, 1), 60), 0.012, [(x, 0.92, z) for x, z in frame], closed=True)
    green, yellow, steel = lamp((0.15, 1, 0.4), 40), lamp((1, 0.6, 0.1), 40), metal(roughness=0.3)
    cup = [(0.5, 1.6), (0.6, 1.48), (0.72, 1.34), (0.84, 1.48), (0.94, 1.6), (0.72, 1.61), (0.5, 1.6)]
    for stroke in (cup, [(0.72, 1.34), (0.72, 1.2), (0.72, 1.07)], [(0.6, 1.06), (0.72, 1.07), (0.84, 1.06)]):
        tube(green, 0.012, [(x, 0.9, z) for x, z in stroke])
    arrow = link(None, None, (0, 0.8, 0.84))
    tube(yellow, 0.012, [(0.55, 0, -0.3), (0.2, 0, -0.2), (-0.15, 0, -0.32), (-0.6, 0, -0.2)], on=arrow)
    tube(yellow, 0.012, [(-0.42, 0, -0.1), (-0.6, 0, -0.2), (-0.46, 0, -0.35)], on=arrow)
    for x in (-0.25, 0.3):
        rod(steel, 0.006, 0.28, (x, 0, -0.12), on=arrow)
    animate(arrow, "rotation_euler", lambda f: (0.12 * sin(0.3 * f), 0.1 * sin(0.22 * f + 1), 0))
    roller, marble = ball(metal(), 0.17), ball(glass(), 0.14)
    animate(roller, "location", lambda f: (-0.9 + 0.03 * f, 0.1, 0.17))
    animate(marble, "location", lambda f: (0.75 - 0.015 * f, -0.4, 0.14))
    drum = pattern(material(roughness=0.3), "Noise", 5, (0.05, 0.12, 0.2), (0.1, 0.25, 0.35), Detail=8)
    rod(drum, 0.22, 0.6, (1.1, 0.6, 0.3))
    shoot(24, ((-0.35, -3.3, 1.0), (0.35, -3.2, 0.95)), ((-0.05, 0.9, 0.7), (0.1, 0.9, 0.7)))


def headlamps() -> None:
    sky((0.3, 0.4, 0.8), 0.03)
    street = pattern(material(), "Noise", 0.9, (0.03,) * 3, (0.4,) * 3, socket="Roughness", Detail=5)
    pattern(street, "Noise", 40, (0.025, 0.025, 0.03), (0.07, 0.07, 0.075))
    brick = pattern(material(), "Brick", 0.5, (0.15, 0.14, 0.13), (0.3, 0.2, 0.16), **BRICK)
    add("plane", street, (0, 10, 0), size=60)
    add("plane", brick, (3.2, 8, 2.5), (pi / 2, 0, -pi / 2), size=40)
    paint, steel, chrome = material(), metal(roughness=0.35), metal()
    lantern, filament = lamp((1, 0.6, 0.25), 800), lamp((1, 0.9, 0.75), 1500)
    for k in range(6):
        add("plane", paint, (-1.6, -1 + 2.5 * k, 0.003), ORIGIN, (0.07, 0.7, 1))
        rod(steel, 0.07, 0.9, (2.0, -0.5 + 2.2 * k, 0.45))
        rod(steel, 0.05, 2.8, (-3.0, 3.1 + 4 * k, 1.4))
        ball(lantern, 0.07, (-2.9, 3 + 4 * k, 2.8))
    car = link(None)
    lacquer = material((0.03, 0.008, 0.008), 0.25, Coat_Weight=1.0, Coat_Roughness=0.03)
    prism(lacquer, 1.7, [(-1.95, 0.35), (-2.05, 0.6), (-1.95, 0.85), (-0.8, 0.98), (1.9, 0.98), (2.05, 0.35)], car)
    prism(material(ORIGIN, 0.02), 1.4, [(-0.9, 0.9), (-0.25, 1.4), (1.1, 1.42), (1.7, 0.9)], car)
    prism(lacquer, 1.46, [(-0.3, 1.38), (-0.2, 1.5), (1.0, 1.5), (1.2, 1.38)], car)
    bowl = {"radius1": 0.13, "radius2": 0.03, "depth": 0.14, "end_fill_type": "NOTHING"}
    tire = material((0.02,) * 3)
    for x in (-0.6, 0.6):
        add("cone", chrome, (x, -2.1, 0.68), (pi / 2, 0, 0), on=car, **bowl)
        add("torus", chrome, (x, -2.17, 0.68), UPRIGHT, on=car, major_radius=0.135, minor_radius=0.018)
        ball(filament, 0.035, (x, -2.14, 0.68), on=car)
        for y in (-1.3, 1.25):
            wheel = add("torus", tire, (1.3 * x, y, 0.33), SIDEWAYS, on=car, major_radius=0.23, minor_radius=0.1)
            add("cylinder", chrome, on=wheel, flat=True, radius=0.17, depth=0.14, vertices=6)
            animate(wheel, "rotation_euler", lambda f: (0.05 * f / 0.33, pi / 2, 0))
    for k in range(5):
        rod(chrome, 0.015, 0.75, (0, -2.06, 0.56 + 0.06 * k), SIDEWAYS, on=car)
    rod(chrome, 0.06, 1.6, (0, -2.12, 0.42), SIDEWAYS, on=car)
    add("cube", material((0.7, 0.65, 0.4)), (0, -2.19, 0.42), ORIGIN, (0.24, 0.006, 0.05), on=car)
    animate(car, "location", lambda f: (0.35 - 0.008 * f, 4.6 - 0.05 * f, 0))
    animate(car, "rotation_euler", lambda f: (0, 0, -0.3 + 0.004 * f))
    shoot(31, ((-0.7, -3.4, 1.15), (-0.3, -3.3, 1.1)), ((0.05, 2.5, 0.5), (0, 2.5, 0.5)))


def chandelier() -> None:
    paper = pattern(material(roughness=0.8), "Wave", 1.6, (0.3, 0.07, 0.07), (0.45, 0.2, 0.14))
    wood = pattern(material(roughness=0.3), "Noise", 4, (0.1, 0.045, 0.02), (0.22, 0.11, 0.05), Detail=8)
    canvas = pattern(material(), "Voronoi", 5, (0.05, 0.12, 0.2), (0.75, 0.6, 0.3))
    plaster, gold = material((0.75, 0.72, 0.66), 0.9), metal((0.95, 0.68, 0.3), 0.2)
    for k in range(4):
        add("plane", paper, (3.2 * sin(k * pi / 2), 3.2 * cos(k * pi / 2), 1.6), (pi / 2, 0, -k * pi / 2), size=6.4)
    for surface, z in ((wood, 0), (plaster, 3.2)):
        add("plane", surface, (0, 0, z), size=6.4)
    for surface, z, height in ((plaster, 3.1, 0.1), (wood, 0.5, 0.5)):
        add("cube", surface, (0, 3.2, z), ORIGIN, (3.2, 0.06, height))
    for x, inside in ((-0.5, metal(roughness=0)), (1.4, canvas)):
        add("cube", gold, (x, 3.17, 1.85), ORIGIN, (0.73, 0.03, 0.65))
        add("plane", inside, (x, 3.13, 1.85), UPRIGHT, (0.65, 0.57, 1))
    hub = link(None, None, (0, 0.4, 2.15))
    brass, crystal, bulb = metal((0.9, 0.62, 0.28), 0.12), glass(1.52), lamp((1, 0.8, 0.55), 350)
    rod(brass, 0.012, 0.8, (0, 0, 0.7), on=hub)
    for z, radius in ((0.34, 0.05), (0.2, 0.08), (0.05, 0.06), (-0.12, 0.09), (-0.24, 0.05)):
        ball(brass, radius, (0, 0, z), on=hub)
    ball(crystal, 0.07, (0, 0, -0.36), on=hub)
    long = (1, 1, 1.8)
    drop = add("ico_sphere", crystal, (0, 0, -0.48), ORIGIN, long, on=hub, flat=True, radius=0.024).data
    for count, reach, height in ((12, 0.62, 0.0), (8, 0.36, 0.28)):
        for x, y in ((reach * cos(tau * k / count), reach * sin(tau * k / count)) for k in range(count)):
            bends = ((0.05, -0.1), (0.4, -0.2), (0.8, -0.15), (1, 0.0))
            tube(brass, 0.009, [(x * r, y * r, height + z) for r, z in bends], on=hub)
            add("cone", brass, (x, y, height), on=hub, radius1=0.012, radius2=0.045, depth=0.03)
            rod(plaster, 0.013, 0.09, (x, y, height + 0.055), on=hub)
            ball(bulb, 0.02, (x, y, height + 0.13), ORIGIN, long, on=hub)
            string = [(1, -0.07 - 0.09 * k, 1 - 0.2 * k) for k in range(3)]
            string += [(r, 0.44 * (1 - r) ** 2 - 0.02, 0.6) for r in (0.25, 0.4, 0.55, 0.7, 0.85)]
            for r, z, size in string:
                link(drop, None, (x * r, y * r, height + z), (0, 0, 7 * x + z), (size, size, 1.5 * size), on=hub)
    animate(hub, "rotation_euler", lambda f: (0, 0, 0.012 * f))
    shoot(29, ((-1.0, -2.4, 1.7), (-0.65, -2.4, 1.75)), ((-0.05, 0.4, 2.08), (-0.02, 0.4, 2.08)))


def waves(surface: Any, rng: Random) -> Any:
    """Add a square of water whose shape keys are travelling waves, two keys for all waves of one frequency."""
    item = add("grid", surface, size=6, x_subdivisions=300, y_subdivisions=300)
    item.shape_key_add(name="flat")
    still = np.array([corner.co for corner in item.data.vertices])
    for length in (1.3, 0.7, 0.4, 0.22):
        number, frequency = tau / length, (9.8 * tau / length) ** 0.5 / 24
        height = np.zeros((2, len(still)))
        for _ in range(4):
            angle = rng.uniform(0, tau)
            phase = number * (still[:, 0] * cos(angle) + still[:, 1] * sin(angle)) + rng.uniform(0, tau)
            height += 0.04 / number * np.array([np.cos(phase), np.sin(phase)])
        for part, turn in zip(height, (cos, sin), strict=True):
            key = item.shape_key_add(name="wave")
            key.slider_min = -1
            key.data.foreach_set("co", (still + np.outer(part, (0, 0, 1))).ravel())
            animate(key, "value", lambda f, turn=turn, frequency=frequency: turn(frequency * f))
    return item


def water() -> None:
    sky((0.35, 0.55, 0.9), 0.5)
    tile = pattern(material(roughness=0.2), "Brick", 1, (0.5, 0.52, 0.5), (0.08, 0.4, 0.5), **TILE)
    stone = pattern(material(), "Noise", 6, (0.4, 0.36, 0.3), (0.6, 0.56, 0.48), Detail=8)
    hedge = pattern(material(roughness=0.9), "Noise", 14, (0.01, 0.04, 0.01), (0.1, 0.22, 0.05), Detail=6)
    surface, sides = waves(glass(1.33), Random(4)), [add("plane", tile, (0, 0, -0.8), size=6)]
    for k in range(4):
        x, y = sin(k * pi / 2), cos(k * pi / 2)
        sides.append(add("plane", tile, (3 * x, 3 * y, -2.95), (pi / 2, 0, -k * pi / 2), size=6))
        add("cube", stone, (3.5 * x, 3.5 * y, 0.07), (0, 0, -k * pi / 2), (4, 0.5, 0.06))
    add("cube", hedge, (0, 4.8, 0.5), ORIGIN, (8, 0.4, 0.6))
    for x in (0.75, 1.15):
        bends = ((3.4, 0.1), (3.35, 0.7), (3.0, 0.85), (2.8, 0.5), (2.8, -0.2), (2.8, -0.6))
        tube(metal(), 0.025, [(x, y, z) for y, z in bends])
    stripes = pattern(material(roughness=0.15), "Wave", 1.2, (0.75, 0.06, 0.04), (0.85, 0.82, 0.75))
    toy, orange = ball(stripes, 0.22), material((0.9, 0.5, 0.03), 0.2)
    ring = add("torus", orange, major_radius=0.33, minor_radius=0.083)
    animate(toy, "location", lambda f: (-0.75 + 0.014 * f, 1.5, 0.09 + 0.02 * sin(0.3 * f)))
    animate(toy, "rotation_euler", lambda f: (0.3, 0.04 * f, 0.02 * f))
    animate(ring, "location", lambda f: (0.75, 0.75 + 0.008 * f, 0.03 + 0.02 * sin(0.3 * f + 2)))
    animate(ring, "rotation_euler", lambda f: (0.06 * sin(0.25 * f), 0.05 * cos(0.25 * f), 0.02 * f))
    sun = link(bpy.data.lights.new("sun", "SUN"))
    sun.data.energy, sun.data.angle, sun.data.color = 4, radians(0.8), (1, 0.9, 0.75)
    sun.rotation_euler = Vector((0.15, -1, -0.72)).to_track_quat("-Z", "Y").to_euler()
    # Cycles connects the tiles with the sun through the surface; else few paths in a million would find the caustics.
    sun.data.cycles.is_caustics_light = surface.cycles.is_caustics_caster = True
    for side in sides:
        side.cycles.is_caustics_receiver = True
    shoot(26, ((-0.3, -2.6, 1.5), (0.2, -2.5, 1.45)), ((-0.05, 1.1, 0), (0.05, 1.1, 0)))


SCENES: dict[str, Callable[[], None]] = {scene.__name__: scene for scene in (neon, headlamps, chandelier, water)}

if __name__ == "__main__":
    folder = Path(sys.argv[1]).resolve()
    folder.mkdir(parents=True, exist_ok=True)
    for name in sys.argv[2:] or SCENES:
        bpy.ops.wm.read_factory_settings(use_empty=True)
        scene = bpy.context.scene
        scene.render.engine, scene.cycles.use_animated_seed = "CYCLES", True
        scene.frame_start, scene.frame_end = 1, 24
        SCENES[name]()
        bpy.ops.wm.save_as_mainfile(filepath=str(folder / f"{name}.blend"))
