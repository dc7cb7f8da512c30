"""The fixed shots: three to validate with and to view, five to test on, never to train on.

Those to validate with hold every effect together, those to test on what temporal denoising helps least, framed as film
frames it, under Blender's skies *courtyard* or *night*, which random shots never take. Made for a camera of 1920×1080
pixels, of which the middle is rendered. Lengths are metres, z is up. Materials, outlines and whatever stands alone are
in the files of ``shots``.
"""

import math
from typing import Any

import bpy
import numpy as np
from mathutils import Matrix, Vector

from hybrid.simulate import scene_assets as assets
from hybrid.simulate.motion import key_motion, key_swing
from hybrid.simulate.random_assets import add_asset, material, printed, set_world
from hybrid.simulate.scene_files import SceneFile

WARM, COOL = (1.0, 0.62, 0.3), (0.62, 0.78, 1.0)
FACING = (math.pi / 2, 0, 0)  # turns the axis of a lathed object from z to y


# Shots to validate with


def table(rng: assets.Rng, frames: range) -> None:
    """Build a table in a closed room: one lamp turned to the ceiling, one small and bright."""
    made = SceneFile("table", frames)
    assets.add_box((0, 0.3, -0.04), (2.6, 2.0, 0.08), material(rng, "plastic", True))
    assets.add_box((0.5, 2.38, 0.9), (1.4, 0.04, 1.0), material(rng, "diffuse"), "picture")
    set_world(rng, "none", 0)
    assets.place(add_asset(rng, made.materials["glass"], "sphere"), (-0.3, -0.1, 0.17), size=0.34)
    assets.place(add_asset(rng, made.materials["wax"], "monkey"), (0.12, 0.25, 0.22), (0, 0, 0.3), 0.42)
    assets.place(add_asset(rng, made.materials["hair"], "fur"), (0.52, -0.05, 0.17), size=0.4)
    assets.place(add_asset(rng, material(rng, "metal"), "torus"), (-0.62, 0.45, 0.06), size=0.4)
    assets.place(add_asset(rng, material(rng, "diffuse"), "box"), (0.2, 0.95, 0.12), (0, 0, 0.7), 0.3)
    turning = assets.place(add_asset(rng, material(rng, "plastic"), "cage"), (0.28, -0.42, 0.11), size=0.22)
    key_motion(turning, frames, spin=(0, 0, 0.25))


def night(rng: assets.Rng, frames: range) -> None:
    """Build a street at night: sixty bulbs, fog, a mirror, a wet floor, and a ball that rolls by."""
    SceneFile("night", frames)
    assets.add_box((0, 9, 2), (24, 0.2, 6), material(rng, "diffuse", True))
    stone = material(rng, "diffuse", True)
    for x in (-2.6, -1.2, 1.2, 2.6):
        for y in (1.5, 4.0, 6.5):
            assets.add_box((x, y, 1.25), (0.3, 0.3, 2.5), stone)
    for number in range(60):
        x, y = -3 + 6 * (number % 10) / 9, 1.2 + 6 * (number // 10) / 5
        height = 2.2 - 0.35 * math.sin(math.pi * (number % 10) / 9)
        hue = ((1, 0.55, 0.2), (1, 0.8, 0.5), (0.35, 0.6, 1), (1, 0.3, 0.35))[number % 4]
        assets.add_lamp("POINT", (x, y, height), 20, 0.025, (0, 0, 0), hue)
    assets.place(add_asset(rng, material(rng, "coated"), "monkey"), (0.75, 2.2, 0.55), (0, 0, -0.2), 0.9)
    ball = assets.place(add_asset(rng, material(rng, "diffuse"), "sphere"), (0.0, 1.0, 0.3), size=0.5)
    key_motion(ball, frames, velocity=(0.12, 0, 0), spin=(0, 0.4, 0))
    set_world(rng, "none", 0)
    assets.fill_with_fog((0, 3, 2), (11.5, 11.5, 4.4), density=0.02, forward=0.5)


def garden(rng: assets.Rng, frames: range) -> None:
    """Build a bush of cut-out leaves and grass under sky and sun, with one object that flies and one that bends."""
    made = SceneFile("garden", frames)
    assets.add_box((0, 4, -0.05), (30, 30, 0.1), material(rng, "diffuse", True))
    assets.add_box((1.5, 5, 1), (5, 0.3, 2), material(rng, "diffuse", True))
    leaf = made.materials["leaf"]
    tree = leaf.node_tree
    cut, where, edge = (assets.node(tree, kind) for kind in ("TexGradient", "TexCoord", "Math"))
    cut.gradient_type, edge.operation = "SPHERICAL", "GREATER_THAN"
    edge.inputs[1].default_value = 0.15
    tree.links.new(where.outputs["Object"], cut.inputs["Vector"])
    tree.links.new(cut.outputs["Fac"], edge.inputs[0])
    tree.links.new(edge.outputs["Value"], tree.nodes["Principled BSDF"].inputs["Alpha"])
    card = assets.add_mesh("leaf", [(-1, -1, 0), (1, -1, 0), (1, 1, 0), (-1, 1, 0)], [(0, 1, 2, 3)], leaf)
    bpy.context.scene.collection.objects.unlink(card)
    for direction in rng.normal(0, 1, (260, 3)):
        item = assets.add_object("leaf", card.data)
        item.location = Vector((-0.9, 1.6, 0.75)) + Vector(direction).normalized() * float(rng.uniform(0.35, 0.7))
        item.rotation_euler, item.scale = rng.uniform(-math.pi, math.pi, 3), (0.11, 0.06, 1)
    assets.place(add_asset(rng, made.materials["grass"], "fur"), (0.9, 0.6, 0.1), size=1.2)
    flying = assets.place(add_asset(rng, material(rng, "coated"), "box"), (0.3, 0.9, 0.95), (0, 0, 0.4), 0.3)
    key_motion(flying, frames, velocity=(-0.09, 0, 0.02), spin=(0.1, 0.05, 0.15))
    bending = assets.place(add_asset(rng, material(rng, "plastic"), "monkey"), (0.55, 1.9, 0.45), (0, 0, -0.3), 0.7)
    bending.shape_key_add(name="basis")
    bent = bending.shape_key_add(name="bent")
    for point in bent.data:
        point.co.x += 0.4 * point.co.z**2
    for frame in frames:
        bent.value = 0.5 + 0.5 * math.sin(0.5 * frame)
        bent.keyframe_insert("value", frame=frame)
    set_world(rng, "sky", 0.045)
    sky = next(found for found in bpy.context.scene.world.node_tree.nodes if found.type == "TEX_SKY")
    sky.sky_type, sky.sun_disc, sky.sun_elevation, sky.sun_rotation = "MULTIPLE_SCATTERING", True, 0.6, 2.2
    sky.sun_size = 0.0095


# Shots to test on


def twig(rng: assets.Rng, leaves: int, length: float, surface: Any, stem: Any, size: float) -> Any:
    """Add a twig along x with leaves of `size` on both sides; return its stem, the parent of the leaves."""

    def along(t: float) -> tuple[float, float, float]:
        return length * t, 0, 0.08 * length * math.sin(2.5 * t)

    made = assets.wire([along(t) for t in np.linspace(0, 1, 6)], 0.012 * size + 0.0008, stem, "twig")
    for k in range(leaves):
        item = assets.leaf_shape(size * float(rng.uniform(0.8, 1.15)), 0.42 * size, surface)
        side = 0.0 if k == leaves - 1 else (1.0 if k % 2 else -1.0) * float(rng.uniform(0.7, 1.1))
        turn = (float(rng.normal(0, 0.5)), -0.35, side)
        assets.place(item, along(0.15 + 0.85 * k / max(leaves - 1, 1)), turn, parent=made)
    return made


def lens(rng: assets.Rng, frames: range) -> None:
    """Build a café table at dusk: a top that spins in focus, a marble that rolls through it, lights far behind."""
    made = SceneFile("lens", frames)
    boards = [assets.wood(light=(0.34 * f, 0.17 * f, 0.07 * f)) for f in (0.7, 1.0, 0.85, 1.15)]
    for k in range(-4, 5):
        board = assets.bevelled((0, 0.11 * k + 0.02, -0.012), (2.4, 0.108, 0.024), boards[k % 4], 0.002, "board")
        board.location.x = float(rng.uniform(-0.3, 0.3))
    bean = made.parts["bean"]
    for k in range(34):
        item = bean if k == 0 else assets.add_object("bean", bean.data)
        x, y = float(rng.normal(0.075, 0.05)), float(rng.normal(0.05, 0.07))
        x += 0.06 * (x < 0.06 and y < 0.03)  # leaves the way of the marble free
        assets.place(item, (x, y, 0.0028), (math.pi / 2, float(rng.uniform(0, 6)), float(rng.uniform(0, 6))))
        item.scale = (0.0085, 0.0062, 0.0105)
    mark = [(0, -0.0006), (0.0016, -0.0006), (0.0018, 0.0004), (0, 0.0008)]
    for k in range(5):
        at = (0.0098 * math.cos(1.2566 * k), 0.0098 * math.sin(1.2566 * k), 0.0192)
        assets.lathe("mark", mark, made.materials["glaze"], at, (0, 0.1, 0), segments=20, parent=made.parts["top"])
    shelf = assets.wood(gloss=0.5)
    tones = ((0.3, 0.12, 0.05), (0.08, 0.2, 0.12), (0.45, 0.35, 0.2), (0.1, 0.13, 0.3))
    for row, height in enumerate((-0.62, -0.3, 0.02)):
        assets.add_box((0, 4.4, height), (6, 0.3, 0.03), shelf)
        for k in range(40):
            surface = assets.plain("ware", tones[int(rng.integers(4))], Roughness=0.25)
            ware = assets.bottle(int(rng.integers(len(assets.BOTTLES))), surface)
            assets.place(ware, (-2.1 + 0.108 * k + 0.02 * row, 4.35, height + 0.015), size=0.85)
    for k in range(24):
        y = float(rng.uniform(1.2, 3.9))
        x, z = float(rng.uniform(-0.16, 0.16)) * (y + 0.9), 0.115 - (y + 0.85) * float(rng.uniform(0.02, 0.1))
        hue = (WARM, (1, 0.8, 0.55), (1, 0.35, 0.16), COOL)[k % 4]
        assets.bulb(0.014, assets.glow(hue, float(rng.uniform(1.2, 5))), (x, y, z), segments=20)
    sprig = twig(rng, 7, 0.1, made.materials["leaf"], assets.wood(), 0.04)
    assets.place(sprig, (-0.115, -0.36, 0.125), (0.3, 0.45, 0.25))
    key_swing(sprig, frames, "z", 0.12, 0.45)


def animal(rng: assets.Rng, head: Any, skin: Any) -> None:
    """Add a head with ears and a muzzle under one coat."""
    coat = assets.hair_material(0.42, 0.75, 0.28)
    for where, radius, strands in (
        ((0, 0, 0.028), 0.0225, 15000), ((-0.0165, 0.004, 0.0475), 0.0075, 2600),
        ((0.0165, 0.004, 0.0475), 0.0075, 2600), ((0, -0.017, 0.0215), 0.0095, 2600),
    ):  # fmt: skip
        part = assets.lathe("head", assets.sphere_profile(radius, 18), skin, where, segments=40, parent=head)
        length = 0.0075 if radius > 0.02 else 0.004
        assets.fur(
            rng, part, assets.Hair(strands, length, 0.00009, (0.05, 0.25, -0.65), 0.35, strands // 40, 0.55), coat
        )


def clockwork(made: SceneFile) -> None:
    """Add three turning wheels in mesh before the plate, and its screws."""
    brass, steel, parent = made.materials["brass"], made.materials["steel"], made.parts["clockwork"]
    # x, z, radius, teeth, phase, material, spokes, direction
    wheels = ((-0.009, 0.0, 0.021, 40, 0.0, brass, 6, 1),
              (-0.009 + 0.0222, 0.0222, 0.0105, 20, 0.5 * 2 * math.pi / 20, steel, 4, -1),
              (-0.009 + 0.0352, -0.0012, 0.014, 27, 0.2, brass, 5, 1))  # fmt: skip
    for number, (x, z, radius, teeth, phase, surface, spokes, sign) in enumerate(wheels):
        wheel = assets.gear(teeth, radius, 0.0024, surface, spokes)
        wheel.rotation_mode = "ZXY"  # x first, so that the turn is around the wheel's own axis, towards the camera
        y = -0.004 * number
        assets.place(wheel, (x, y, z), (math.pi / 2, 0, phase), parent=parent)
        key_motion(wheel, made.frames, spin=(0, 0, sign * 0.0021 / radius))
        assets.lathe("axle", made.outlines["axle"], steel, (x, y, z), FACING, segments=24, parent=parent)
        at = (x, y - 0.0072, z)
        assets.lathe("jewel", made.outlines["jewel"], made.materials["jewel"], at, FACING, segments=24, parent=parent)
    for x, z in ((-0.005, 0.005), (0.064, 0.0048), (0.064, 0.0555), (-0.0045, 0.0555)):
        at = (x, 0.0475 - 0.12 * (x - 0.03), z)
        assets.lathe("screw", made.outlines["screw"], brass, at, (math.pi / 2, 0, 0.4), segments=24)


def closeup(rng: assets.Rng, frames: range) -> None:
    """Build a close-up: a furry animal that turns its head, cut glass, and the wheels of a clockwork."""
    made = SceneFile("closeup", frames)
    assets.place(assets.curtain(1.2, 0.6, 9, 0.03, made.materials["velvet"]), (0, 0.28, 0))
    animal(rng, made.parts["head"], made.materials["skin"])
    clockwork(made)
    # A stopper cut in facets.
    cut, angle = made.outlines["cut"], np.arange(9) * 2 * math.pi / 9
    vertices = [
        (r * math.cos(a + k * 0.35), r * math.sin(a + k * 0.35), z) for k, (r, z) in enumerate(cut) for a in angle
    ]
    stopper = assets.add_mesh(
        "stopper", vertices, assets.grid_faces(len(cut), 9, closed=True), made.materials["crystal"]
    )
    assets.place(stopper, (0.006, -0.03, 0), (0, 0.0, 0.2), 1.15)


def bar_shelves(rng: assets.Rng, made: SceneFile) -> None:
    """Add four shelves of labelled bottles, with bulbs under their edges."""
    glasses = [made.materials[f"bottle{k}"] for k in range(7)]
    labels = [printed(rng) for _ in range(6)]
    for row, height in enumerate((1.06, 1.44, 1.82, 2.2)):
        assets.bevelled((0, 10.03, height), (3.75, 0.32, 0.03), made.materials["oak"], 0.004, "shelf")
        x = -1.78
        while x < 1.78:
            item = assets.bottle(int(rng.integers(5)), glasses[int(rng.integers(7))], labels[int(rng.integers(6))])
            y, turn = 9.98 + float(rng.uniform(-0.05, 0.06)), float(rng.uniform(0, 6))
            assets.place(item, (x, y, height + 0.016), (0, 0, turn), float(rng.uniform(0.8, 1.0)))
            x += float(rng.uniform(0.09, 0.17))
        for k in range(10):
            assets.bulb(0.014, made.materials["shelf"], (-1.7 + 0.37 * k + 0.05 * row, 9.9, height - 0.028))


def lamps(rng: assets.Rng, frames: range) -> None:
    """Build a bar at night: shelves of bottles in front of a mirror, lit by many small lamps; the camera pans."""
    made = SceneFile("lamps", frames)
    materials, outlines = made.materials, made.outlines
    bar_shelves(rng, made)
    # On the counter stand glasses and candles.
    for k in range(14):
        assets.bevelled((-2.1 + 0.33 * k, 8.5, 0.48), (0.28, 0.03, 0.9), materials["timber"], 0.012, "panel")
    for k in range(9):
        x, y = -1.1 + 0.27 * k + float(rng.uniform(-0.05, 0.05)), 8.62 + float(rng.uniform(-0.12, 0.15))
        if k % 3 == 1:
            assets.lathe("candle", outlines["candle"], materials["wax"], (x, y, 1.006), segments=40)
            assets.lathe("flame", outlines["flame"], materials["flame"], (x, y, 1.098), segments=16)
        else:
            assets.lathe("goblet", outlines["goblet"], materials["glass"], (x, y, 1.006), segments=48)
    # Three lamps under metal shades; one of them swings.
    for k, x in enumerate((-0.95, 0.05, 1.05)):
        hook = assets.place(assets.add_object("pendant", None), (x, 8.7, 3.0))
        assets.lathe("shade", outlines["shade"], materials["copper"], (0, 0, -1.0), parent=hook)
        assets.wire([(0, 0, 0), (0, 0, -0.5), (0, 0, -1.0)], 0.004, materials["cable"], "cable").parent = hook
        assets.bulb(0.024, materials["pendant"], (0, 0, -1.105), 13, 24, hook)
        if k == 1:
            key_swing(hook, frames, "y", 0.05, 0.35)
    for k in range(24):  # a string of coloured lamps above
        t = k / 23
        assets.bulb(
            0.012, materials[f"string{k % 4}"], (-2 + 4 * t, 9.6, 2.3 - 0.3 * math.sin(math.pi * ((3 * t) % 1)))
        )


def clock_marks(ink: Any) -> None:
    """Add the hours and the hands of the wall clock."""
    # angle, distance of the middle from the axis, y, width and length
    bars = [("tick", k * math.pi / 6, 0.065, 0.4745, 0.004, 0.016) for k in range(12)]
    bars += [("hand", a, long / 2, 0.473, 0.005, long) for a, long in ((1.1, 0.04), (4.2, 0.058))]
    for name, a, r, y, width, long in bars:
        bar = assets.add_box((0.3 + r * math.sin(a), y, 1.31 + r * math.cos(a)), (width, 0.003, long), ink, name)
        bar.rotation_euler.y = a


def shadow(rng: assets.Rng, frames: range) -> None:
    """Build a sunlit corner: window light that moves over a wall and objects, swaying leaves and a clock."""
    made = SceneFile("shadow", frames)
    materials = made.materials
    for k in range(7):
        assets.add_box((-3.1, -3.1 + 0.466 * k, 1.65), (0.06, 0.045, 1.7), materials["bar"])
    for k in range(5):
        assets.add_box((-3.1, -1.7, 0.86 + 0.4 * k), (0.05, 2.8, 0.04), materials["bar"])
    for k in range(9):
        stem = twig(rng, 9, 0.34, materials["leaf"], materials["board"], 0.085)
        assets.place(
            stem, (-0.19, 0.27, 1.1), (float(rng.normal(0, 0.6)), -1.25 + 0.28 * float(rng.normal()), 0.75 * k)
        )
        key_swing(stem, frames, "y", 0.055, 0.5, 0.9 * k)
    thickness = (0.035, 0.05, 0.03, 0.042)
    for k, thick in enumerate(thickness):
        center = (0.14, 0.26, 0.896 + sum(thickness[:k]))
        book = assets.bevelled(center, (0.2, 0.15, thick - 0.003), materials[f"cloth{k}"], 0.003, "book")
        pages = assets.add_box(center, (0.203, 0.142, thick - 0.011), materials["paper"])
        book.rotation_euler.z = pages.rotation_euler.z = 0.35 - 0.22 * k
    clock_marks(materials["ink"])
    assets.add_box((-0.02, 0.472, 1.62), (0.43, 0.005, 0.29), printed(rng), "picture")


def brick_material() -> Any:
    """Make a wall of bricks with relief, in the plane of x and z."""
    bricks = assets.plain("brick", (0.3, 0.12, 0.08), Roughness=0.85)
    tree = bricks.node_tree
    where = assets.node(tree, "Mapping", Vector=assets.node(tree, "TexCoord").outputs["Object"], Rotation=FACING)
    laid = assets.node(tree, "TexBrick", Vector=where.outputs["Vector"], Scale=6.5, Color1=(0.3, 0.11, 0.07, 1),
                       Color2=(0.16, 0.07, 0.05, 1), Mortar=(0.3, 0.28, 0.25, 1), Mortar_Size=0.025)  # fmt: skip
    relief = assets.node(tree, "Bump", Height=laid.outputs["Fac"], Strength=1.0, Distance=-0.006)
    shader = tree.nodes["Principled BSDF"]
    tree.links.new(laid.outputs["Color"], shader.inputs["Base Color"])
    tree.links.new(relief.outputs["Normal"], shader.inputs["Normal"])
    return bricks


def fan_in_wall(made: SceneFile) -> None:
    """Add a wall of brick with a round hole, and the blades of the turning fan behind a guard in the hole."""
    cx, cz, radius = -0.42, 1.62, 0.46
    center, rust = (cx, 2.5, cz), made.materials["rust"]
    wall = assets.add_box((0, 2.5, 1.8), (7, 0.16, 3.6), brick_material())
    hole = wall.modifiers.new("hole", "BOOLEAN")
    drum = assets.lathe("drum", [(0, -0.4), (radius, -0.4), (radius, 0.4), (0, 0.4)], None, center, FACING, segments=96)
    drum.hide_render = True
    drum.hide_set(True)
    hole.object, hole.operation = drum, "DIFFERENCE"
    assets.lathe("ring", made.outlines["ring"], rust, center, FACING, segments=96)
    for k in range(5):
        blade = assets.bevelled((0, 0, 0), (0.17, 0.008, radius - 0.1), rust, 0.003, "blade")
        blade.data.transform(Matrix.Translation((0, 0, 0.04 + radius / 2)))
        blade.rotation_mode = "ZYX"  # the pitch around the blade's own length first
        assets.place(blade, (0, 0, 0), (0, 2 * math.pi * k / 5, 0.5), parent=made.parts["fan"])
    for k in (-1, 0, 1):
        shift, across = 0.22 * k, math.sqrt(radius**2 - (0.22 * k) ** 2)
        for points in (
            [(cx + shift, 2.4, cz - across), (cx + shift, 2.38, cz), (cx + shift, 2.4, cz + across)],
            [(cx - across, 2.39, cz + shift), (cx, 2.37, cz + shift), (cx + across, 2.39, cz + shift)],
        ):
            assets.wire(points, 0.007, made.materials["iron"], "guard")


def volume(rng: assets.Rng, frames: range) -> None:
    """Build a workshop full of smoke: a fan turns before the light, its beams sweep past pipes, chains and barrels."""
    made = SceneFile("volume", frames)
    rust, iron, barrel = made.materials["rust"], made.materials["iron"], made.outlines["barrel"]
    fan_in_wall(made)
    for k, at in enumerate(((0.72, 0.9, 0.25), (1.25, 1.3, 0.25), (0.98, 1.15, 1.13), (-1.1, 0.6, 0.05))):
        assets.place(assets.lathe("barrel", barrel, (rust, iron)[k % 2]), at, (0, 0, float(rng.uniform(0, 6))), 0.8)
    for x, z in ((-1.12, 2.2), (0.3, 2.05), (0.42, 2.05)):
        assets.wire(
            [(x, 2.34, 0), (x, 2.34, z - 0.3), (x, 2.3, z), (x, 1.5, z + 0.05), (x, -4, z)], 0.045, rust, "pipe"
        )
    for strand, (x, y) in enumerate(((0.18, 0.9), (-0.75, 0.2))):
        hook = assets.place(assets.add_object("chain", None), (x, y, 3.6))
        for k in range(44):
            bpy.ops.mesh.primitive_torus_add(major_radius=0.03, minor_radius=0.008, major_segments=20, minor_segments=8)
            link = bpy.context.active_object
            link.data.materials.append(iron)
            bpy.ops.object.shade_smooth()
            assets.place(link, (0, 0, -0.053 * k), (math.pi / 2, 0, math.pi / 2 * (k % 2)), parent=hook)
            link.scale = (0.75, 1.2, 1)
        key_swing(hook, frames, "y", 0.03, 0.4, strand)
    assets.fill_with_smoke(frames, (0, -0.6, 1.8), (6.7, 6.0, 3.6), (0.02, 0.1), 1.6, 0.55)


FIXED_SHOTS = {
    "validation": {"table": table, "night": night, "garden": garden},
    "test": {"lens": lens, "closeup": closeup, "lamps": lamps, "shadow": shadow, "volume": volume},
}
