"""Five fixed shots to test on, never to train on: what temporal denoising helps least, framed as film frames it.

*lens*: a table through an open aperture, with motion in focus, behind it, and through it. *closeup*: hair, cut glass
and turning metal. *lamps*: a pan over a dim bar of many small lamps. *shadow*: sunlight that moves over a wall, a
pendulum and swaying leaves. *volume*: a fan that turns in front of a light, in smoke. Skies are Blender's *courtyard*
or *night*, which random shots never take. Lengths are metres, z is up; made for a camera of 1920×1080 pixels, of which
the middle is rendered.
"""

from __future__ import annotations

import math
from collections.abc import Callable
from typing import Any

import bpy
import numpy as np
from mathutils import Matrix, Vector

from hybrid.simulate.motion import aim_camera, key_motion, key_swing
from hybrid.simulate.random_assets import printed
from hybrid.simulate.scene_assets import (
    BOTTLES,
    Hair,
    Rng,
    add_box,
    add_lamp,
    add_mesh,
    add_object,
    bevelled,
    bottle,
    bulb,
    clear_glass,
    curtain,
    fill_with_smoke,
    fur,
    gear,
    glow,
    grid_faces,
    hair_material,
    lathe,
    leaf_shape,
    new_world,
    node,
    place,
    plain,
    sample_image_coarsely,
    sphere_profile,
    studio_light,
    two_tone,
    wire,
    wood,
)

WARM, COOL = (1.0, 0.62, 0.3), (0.62, 0.78, 1.0)
FACING = (math.pi / 2, 0, 0)  # turns the axis of a lathed object from z to y


def sky(name: str, strength: float, turn: float = 0.0) -> None:
    """Light the scene by one of Blender's environment images, turned around z."""
    world = new_world()
    sample_image_coarsely(world)
    tree = world.node_tree
    where = node(tree, "TexCoord").outputs["Generated"]
    image = node(tree, "TexEnvironment", Vector=node(tree, "Mapping", Vector=where, Rotation=(0, 0, turn)).outputs[0])
    image.image = studio_light(name)
    background = tree.nodes["Background"]
    background.inputs["Strength"].default_value = strength
    tree.links.new(image.outputs["Color"], background.inputs["Color"])


def black_world() -> None:
    """Give the scene a world without light."""
    new_world().node_tree.nodes["Background"].inputs["Strength"].default_value = 0


def empty(name: str, at: tuple[float, float, float], turn: tuple[float, float, float] = (0, 0, 0)) -> Any:
    """Add a parent for objects that move together."""
    return place(add_object(name, None), at, turn)


def twig(rng: Rng, leaves: int, length: float, surface: Any, stem: Any, size: float) -> Any:
    """Add a twig along x with leaves of `size` on both sides; return its stem, the parent of the leaves."""

    def along(t: float) -> tuple[float, float, float]:
        return length * t, 0, 0.08 * length * math.sin(2.5 * t)

    made = wire([along(t) for t in np.linspace(0, 1, 6)], 0.012 * size + 0.0008, stem, "twig")
    for k in range(leaves):
        item = leaf_shape(size * float(rng.uniform(0.8, 1.15)), 0.42 * size, surface)
        side = 0.0 if k == leaves - 1 else (1.0 if k % 2 else -1.0) * float(rng.uniform(0.7, 1.1))
        turn = (float(rng.normal(0, 0.5)), -0.35, side)
        place(item, along(0.15 + 0.85 * k / max(leaves - 1, 1)), turn, parent=made)
    return made


def handle(points: list[tuple[float, float]], radius: float, surface: Any, at: Any, turn: float) -> None:
    """Add the handle of a cup, a wire through (x, z) points, turned around z."""
    place(wire([(x, 0, z) for x, z in points], radius, surface, "handle"), at, (0, 0, turn))


def lens(rng: Rng, frames: range) -> None:
    """Build a café table at dusk: a top that spins in focus, a marble that rolls through it, lights far behind."""
    sky("night", 0.6, 1.0)
    boards = [wood(light=(0.34 * f, 0.17 * f, 0.07 * f)) for f in (0.7, 1.0, 0.85, 1.15)]
    for k in range(-4, 5):
        board = bevelled((0, 0.11 * k + 0.02, -0.012), (2.4, 0.108, 0.024), boards[k % 4], 0.002, "board")
        board.location.x = float(rng.uniform(-0.3, 0.3))
    china = plain("china", (0.78, 0.76, 0.72), Roughness=0.12, Coat_Weight=0.6, Coat_Roughness=0.05)
    blue = plain("glaze", (0.03, 0.09, 0.24), Roughness=0.1, Coat_Weight=1.0)
    silver = plain("silver", (0.9, 0.88, 0.85), Metallic=1.0, Roughness=0.12)
    brass = two_tone("brass", (0.62, 0.38, 0.12), (0.9, 0.62, 0.25), scale=60, stretch=(1, 1, 12), Metallic=1.0,
                     roughness=(0.12, 0.3))  # fmt: skip
    saucer = [(0, 0.004), (0.022, 0.002), (0.024, 0), (0.03, 0.002), (0.052, 0.012), (0.057, 0.016), (0.0555, 0.0175),
              (0.05, 0.014), (0.028, 0.0045), (0, 0.0045)]  # fmt: skip
    cup = [(0, 0.006), (0.017, 0.006), (0.019, 0.005), (0.021, 0.008), (0.029, 0.024), (0.0325, 0.045), (0.034, 0.055),
           (0.033, 0.0557), (0.0315, 0.045), (0.028, 0.025), (0.019, 0.0105), (0, 0.0095)]  # fmt: skip
    cup_at = (-0.046, 0.02, 0)
    lathe("saucer", saucer, china, cup_at)
    lathe("line", [(0.0537, 0.0158), (0.0571, 0.0182)], blue, (-0.046, 0.02, 0.0003))
    lathe("cup", cup, china, cup_at)
    lathe("line", [(0.0331, 0.0478), (0.0338, 0.0532)], blue, cup_at)
    coffee = two_tone("coffee", (0.012, 0.004, 0.002), (0.28, 0.13, 0.045), scale=90, edges=(0.42, 0.6), Roughness=0.08)
    lathe("coffee", [(0.0315, 0.0), (0.012, 0.0004), (0, 0.0004)], coffee, (-0.046, 0.02, 0.0455))
    ear = [(0.031, 0.044), (0.044, 0.05), (0.053, 0.043), (0.052, 0.03), (0.042, 0.02), (0.027, 0.02)]
    handle(ear, 0.0032, china, cup_at, math.pi + 0.5)
    spoon = lathe("spoon", [(0, -0.5), (0.35, -0.42), (0.5, 0), (0.35, 0.42), (0, 0.5)], silver, (0.006, -0.018, 0.016),
                  (math.pi / 2, 0.12, 0.55))  # fmt: skip
    spoon.scale = (0.016, 0.004, 0.026)
    stick = wire([(0.016, -0.034, 0.0165), (0.045, -0.083, 0.0125), (0.07, -0.13, 0.004)], 0.0013, silver, "handle")
    place(stick, (-0.004, 0.007, 0))
    roast = two_tone("bean", (0.03, 0.012, 0.005), (0.13, 0.055, 0.02), scale=300, roughness=(0.3, 0.5), bump=0.0002)
    bean = lathe("bean", [(0, -0.5), (0.3, -0.4), (0.42, 0), (0.3, 0.4), (0, 0.5)], roast, segments=24)
    for k in range(34):
        item = bean if k == 0 else add_object("bean", bean.data)
        x, y = float(rng.normal(0.075, 0.05)), float(rng.normal(0.05, 0.07))
        x += 0.06 * (x < 0.06 and y < 0.03)  # leaves the way of the marble free
        place(item, (x, y, 0.0028), (math.pi / 2, float(rng.uniform(0, 6)), float(rng.uniform(0, 6))))
        item.scale = (0.0085, 0.0062, 0.0105)
    # The top stands in the plane of focus; marks make its spin visible.
    top = lathe("top", [(0, 0), (0.0012, 0.004), (0.004, 0.0085), (0.0135, 0.014), (0.0145, 0.0165), (0.012, 0.019),
                        (0.004, 0.0205), (0.0022, 0.023), (0.002, 0.033), (0, 0.034)], brass)  # fmt: skip
    for k in range(5):
        at = (0.0098 * math.cos(1.2566 * k), 0.0098 * math.sin(1.2566 * k), 0.0192)
        lathe("mark", [(0, -0.0006), (0.0016, -0.0006), (0.0018, 0.0004), (0, 0.0008)], blue, at, (0, 0.1, 0),
              segments=20, parent=top)  # fmt: skip
    place(top, (0.056, 0.0, 0), (0.1, 0.06, 0))
    key_motion(top, frames, velocity=(0.0007, 0.0003, 0), spin=(0, 0, 0.22))
    swirl = two_tone("swirl", (0.5, 0.03, 0.02), (0.9, 0.75, 0.5), scale=45, stretch=(1, 1, 3), Distortion=2.5,
                     edges=(0.46, 0.54), Roughness=0.05, Coat_Weight=1.0)  # fmt: skip
    marble = lathe("marble", sphere_profile(0.0085, 24), swirl, (0.034, -0.03, 0.0085))
    key_motion(marble, frames, velocity=(-0.0016, 0.008, 0), spin=(-0.94, -0.19, 0))
    # Behind: a mug near the table's edge; lower, candles and lamps of the room, a lantern that is carried by.
    # Nothing here is glass, whose caustics of small lamps would be noise in the references.
    mug = [(0, 0.002), (0.03, 0), (0.034, 0.004), (0.035, 0.09), (0.0335, 0.0915), (0.032, 0.09), (0.031, 0.008),
           (0, 0.006)]  # fmt: skip
    mug_at = (0.1, 0.33, 0)
    lathe("mug", mug, china, mug_at)
    lathe("line", [(0.0351, 0.064), (0.0353, 0.078)], blue, mug_at)
    ear = [(0.034, 0.074), (0.052, 0.076), (0.06, 0.06), (0.058, 0.038), (0.049, 0.025), (0.034, 0.02)]
    handle(ear, 0.0042, china, mug_at, -0.4)
    wall = two_tone("plaster", (0.09, 0.055, 0.04), (0.2, 0.13, 0.1), scale=3, bump=0.002)
    add_box((0, 4.6, 0), (8, 0.1, 4), wall)
    shelf = wood(gloss=0.5)
    tones = ((0.3, 0.12, 0.05), (0.08, 0.2, 0.12), (0.45, 0.35, 0.2), (0.1, 0.13, 0.3))
    for row, height in enumerate((-0.62, -0.3, 0.02)):
        add_box((0, 4.4, height), (6, 0.3, 0.03), shelf)
        for k in range(40):
            made = plain("ware", tones[int(rng.integers(4))], Roughness=0.25)
            ware = bottle(int(rng.integers(len(BOTTLES))), made)
            place(ware, (-2.1 + 0.108 * k + 0.02 * row, 4.35, height + 0.015), size=0.85)
    for k in range(24):
        y = float(rng.uniform(1.2, 3.9))
        x, z = float(rng.uniform(-0.16, 0.16)) * (y + 0.9), 0.115 - (y + 0.85) * float(rng.uniform(0.02, 0.1))
        hue = (WARM, (1, 0.8, 0.55), (1, 0.35, 0.16), COOL)[k % 4]
        bulb(0.014, glow(hue, float(rng.uniform(1.2, 5))), (x, y, z), segments=20)
    lantern = lathe("lantern", sphere_profile(0.028, 9), glow((1, 0.45, 0.12), 2.5), (-0.06, 1.15, 0.02), segments=24)
    key_motion(lantern, frames, velocity=(0.008, 0, 0.001))
    green = two_tone("leaf", (0.03, 0.1, 0.02), (0.1, 0.26, 0.05), scale=40, roughness=(0.35, 0.5))
    sprig = twig(rng, 7, 0.1, green, wood(), 0.04)
    place(sprig, (-0.115, -0.36, 0.125), (0.3, 0.45, 0.25))
    key_swing(sprig, frames, "z", 0.12, 0.45)
    add_lamp("AREA", (-0.75, 0.25, 0.85), 26, 0.4, (0, 0, 0), (0.75, 0.87, 1.0))
    add_lamp("AREA", (0.7, 0.6, 0.5), 16, 0.12, (0, 0, 0.03), (1, 0.72, 0.42))
    camera = aim_camera((0.01, -0.8, 0.115), (0.004, 0, 0.037), 26)
    camera.data.dof.use_dof, camera.data.dof.aperture_fstop, camera.data.dof.aperture_blades = True, 1.8, 7
    camera.data.dof.focus_distance = 0.805
    camera.data.clip_start = 0.01
    key_motion(camera, frames, velocity=(0.0014, 0, 0.0002))


def animal(rng: Rng) -> Any:
    """Add a head with ears, a muzzle and eyes under one coat; return their parent."""
    skin = plain("skin", (0.25, 0.12, 0.06), Roughness=0.8)
    coat = hair_material(0.42, 0.75, 0.28)
    head = add_object("head", None)
    for where, radius, strands in (
        ((0, 0, 0.028), 0.0225, 15000), ((-0.0165, 0.004, 0.0475), 0.0075, 2600),
        ((0.0165, 0.004, 0.0475), 0.0075, 2600), ((0, -0.017, 0.0215), 0.0095, 2600),
    ):  # fmt: skip
        part = lathe("head", sphere_profile(radius, 18), skin, where, segments=40, parent=head)
        length = 0.0075 if radius > 0.02 else 0.004
        fur(rng, part, Hair(strands, length, 0.00009, (0.05, 0.25, -0.65), 0.35, strands // 40, 0.55), coat)
    black = plain("eye", (0.01, 0.008, 0.006), Roughness=0.03, Coat_Weight=1.0)
    for where, radius in (((-0.0095, -0.0215, 0.0325), 0.0032), ((0.0095, -0.0215, 0.0325), 0.0032),
                          ((0, -0.0285, 0.0245), 0.0027)):  # fmt: skip
        lathe("eye", sphere_profile(radius, 14), black, where, segments=28, parent=head)
    return head


def clockwork(frames: range) -> None:
    """Add three turning wheels in mesh before a plate."""
    # Brushed no finer than a pixel: finer grain would glitter.
    brushed: dict[str, Any] = {"scale": 700, "Detail": 2, "bump": 0.00002, "Metallic": 1.0}
    brass = two_tone("brass", (0.55, 0.32, 0.1), (0.88, 0.6, 0.24), stretch=(10, 1, 1), roughness=(0.2, 0.38),
                     **brushed)  # fmt: skip
    steel = two_tone("steel", (0.42, 0.43, 0.45), (0.7, 0.7, 0.72), stretch=(1, 14, 1), roughness=(0.15, 0.3),
                     **brushed)  # fmt: skip
    plate = bevelled((0.03, 0.052, 0.03), (0.075, 0.004, 0.06), steel, 0.001, "plate")
    plate.rotation_euler.z = -0.12
    parent = empty("clockwork", (0.03, 0.044, 0.03), (0, 0, -0.12))
    # x, z, radius, teeth, phase, material, spokes, direction
    wheels = ((-0.009, 0.0, 0.021, 40, 0.0, brass, 6, 1),
              (-0.009 + 0.0222, 0.0222, 0.0105, 20, 0.5 * 2 * math.pi / 20, steel, 4, -1),
              (-0.009 + 0.0352, -0.0012, 0.014, 27, 0.2, brass, 5, 1))  # fmt: skip
    for number, (x, z, radius, teeth, phase, surface, spokes, sign) in enumerate(wheels):
        wheel = gear(teeth, radius, 0.0024, surface, spokes)
        wheel.rotation_mode = "ZXY"  # x first, so that the turn is around the wheel's own axis, towards the camera
        y = -0.004 * number
        place(wheel, (x, y, z), (math.pi / 2, 0, phase), parent=parent)
        key_motion(wheel, frames, spin=(0, 0, sign * 0.0021 / radius))
        axle = [(0, 0.008), (0.0016, 0.0075), (0.0018, 0.006), (0.0018, -0.012)]
        lathe("axle", axle, steel, (x, y, z), FACING, segments=24, parent=parent)
        jewel = clear_glass("jewel", (0.7, 0.02, 0.05), 1.76)
        lathe("jewel", [(0.0028, 0), (0.0024, 0.0009), (0, 0.0011)], jewel, (x, y - 0.0072, z), FACING, segments=24,
              parent=parent)  # fmt: skip
    for x, z in ((-0.005, 0.005), (0.064, 0.0048), (0.064, 0.0555), (-0.0045, 0.0555)):
        screw = [(0, 0.0012), (0.0016, 0.0011), (0.002, 0.0006), (0.002, -0.001)]
        lathe("screw", screw, brass, (x, 0.0475 - 0.12 * (x - 0.03), z), (math.pi / 2, 0, 0.4), segments=24)


def closeup(rng: Rng, frames: range) -> None:
    """Build a close-up: a furry animal that turns its head, cut glass, and the wheels of a clockwork."""
    sky("courtyard", 0.35, 2.2)
    leather = two_tone("leather", (0.05, 0.02, 0.012), (0.13, 0.05, 0.028), scale=300, Detail=1, bump=0.0004,
                       roughness=(0.35, 0.6))  # fmt: skip
    add_box((0, 0.3, -0.01), (1.6, 1.4, 0.02), leather)
    velvet = plain("velvet", (0.05, 0.012, 0.02), Roughness=0.9, Sheen_Weight=0.6)
    place(curtain(1.2, 0.6, 9, 0.03, velvet), (0, 0.28, 0))
    head = place(animal(rng), (-0.032, 0.012, 0), (0, 0, 0.35))
    key_motion(head, frames, spin=(0, 0, 0.028))
    clockwork(frames)
    # Glass: a stopper cut in facets, and a small tumbler, half full.
    clear = clear_glass("crystal", ior=1.6)
    cut = [(0, 0), (0.0045, 0), (0.0075, 0.0035), (0.0095, 0.0085), (0.0075, 0.0125), (0.004, 0.015), (0, 0.0152)]
    angle = np.arange(9) * 2 * math.pi / 9
    vertices = [
        (r * math.cos(a + k * 0.35), r * math.sin(a + k * 0.35), z) for k, (r, z) in enumerate(cut) for a in angle
    ]
    stopper = add_mesh("stopper", vertices, grid_faces(len(cut), 9, closed=True), clear)
    place(stopper, (0.006, -0.03, 0), (0, 0.0, 0.2), 1.15)
    amber = clear_glass("amber", (1.0, 0.62, 0.22), 1.36)
    tumbler = [(0, 0), (0.011, 0), (0.0118, 0.001), (0.0135, 0.026), (0.0127, 0.026), (0.0109, 0.003), (0, 0.0028)]
    lathe("tumbler", tumbler, clear, (0.04, -0.018, 0))
    lathe("drink", [(0, 0.0028), (0.01075, 0.0031), (0.0117, 0.0145), (0, 0.0145)], amber, (0.04, -0.018, 0))
    add_lamp("AREA", (-0.35, -0.28, 0.42), 6.5, 0.3, (0, 0, 0.02), (1, 0.93, 0.84))
    add_lamp("AREA", (0.3, 0.2, 0.22), 4.5, 0.2, (-0.01, 0, 0.03), (0.8, 0.9, 1.0))
    camera = aim_camera((0.012, -0.62, 0.17), (0.003, 0, 0.0255), 31)
    camera.data.clip_start = 0.01
    key_motion(camera, frames, velocity=(0.0002, 0, 0))


def bar_shelves(rng: Rng, oak: Any) -> None:
    """Add four shelves of labelled bottles, with bulbs under their edges."""
    tints = ((0.9, 0.55, 0.2), (0.35, 0.7, 0.4), (0.95, 0.9, 0.82), (0.75, 0.2, 0.1), (0.3, 0.5, 0.75))
    glasses = [clear_glass("bottle", tint) for tint in tints[:2]]
    # Full of a dark liquid: opaque.
    glasses += [plain("bottle", tuple(0.12 * c for c in tint), Roughness=0.06, Coat_Weight=0.5) for tint in tints]
    labels = [printed(rng) for _ in range(6)]
    for row, height in enumerate((1.06, 1.44, 1.82, 2.2)):
        bevelled((0, 10.03, height), (3.75, 0.32, 0.03), oak, 0.004, "shelf")
        x = -1.78
        while x < 1.78:
            item = bottle(int(rng.integers(5)), glasses[int(rng.integers(7))], labels[int(rng.integers(6))])
            y, turn = 9.98 + float(rng.uniform(-0.05, 0.06)), float(rng.uniform(0, 6))
            place(item, (x, y, height + 0.016), (0, 0, turn), float(rng.uniform(0.8, 1.0)))
            x += float(rng.uniform(0.09, 0.17))
        for k in range(10):
            bulb(0.014, glow(WARM, 130), (-1.7 + 0.37 * k + 0.05 * row, 9.9, height - 0.028))


def lamps(rng: Rng, frames: range) -> None:
    """Build a bar at night: shelves of bottles in front of a mirror, lit by many small lamps; the camera pans."""
    black_world()
    timber, oak = wood((0.03, 0.012, 0.006), (0.12, 0.05, 0.022)), wood()
    paper = two_tone("paper", (0.16, 0.035, 0.03), (0.34, 0.11, 0.075), scale=26, Distortion=1.5, edges=(0.45, 0.5))
    for y in (10.25, -1.0):
        add_box((0, y, 1.6), (9, 0.1, 3.4), paper)
    for z, surface in ((-0.05, oak), (3.35, timber)):
        add_box((0, 4.6, z), (9, 11.4, 0.1), surface)
    mirror = two_tone("mirror", (0.62, 0.6, 0.55), (0.8, 0.78, 0.74), scale=2, Metallic=1.0, roughness=(0.02, 0.09))
    bevelled((0, 10.19, 1.63), (1.15, 0.02, 1.1), mirror, 0.004, "mirror")
    for x in (-1.85, -0.62, 0.62, 1.85):
        bevelled((x, 10.03, 1.6), (0.07, 0.34, 1.75), timber, 0.008, "post")
    bar_shelves(rng, oak)
    # The counter, with glasses and candles on it.
    bevelled((0, 8.7, 0.98), (4.4, 0.62, 0.05), oak, 0.012, "counter")
    for k in range(14):
        bevelled((-2.1 + 0.33 * k, 8.5, 0.48), (0.28, 0.03, 0.9), timber, 0.012, "panel")
    clear = clear_glass("glass", ior=1.45)
    goblet = [(0, 0), (0.034, 0), (0.034, 0.002), (0.005, 0.006), (0.004, 0.075), (0.02, 0.088), (0.036, 0.13),
              (0.031, 0.185), (0.03, 0.185), (0.0348, 0.13), (0.019, 0.09), (0, 0.082)]  # fmt: skip
    candle = [(0, 0), (0.028, 0), (0.028, 0.085), (0.024, 0.09), (0, 0.083)]
    flame = [(0, 0), (0.006, 0.008), (0.0045, 0.018), (0, 0.032)]
    wax = plain("wax", (0.85, 0.75, 0.55), Subsurface_Weight=1.0, Subsurface_Scale=0.02, Roughness=0.45)
    for k in range(9):
        x, y = -1.1 + 0.27 * k + float(rng.uniform(-0.05, 0.05)), 8.62 + float(rng.uniform(-0.12, 0.15))
        if k % 3 == 1:
            lathe("candle", candle, wax, (x, y, 1.006), segments=40)
            lathe("flame", flame, glow((1, 0.5, 0.16), 200), (x, y, 1.098), segments=16)
        else:
            lathe("goblet", goblet, clear, (x, y, 1.006), segments=48)
    # Three lamps under metal shades; one of them swings.
    shade = two_tone("copper", (0.5, 0.2, 0.1), (0.85, 0.42, 0.24), scale=40, Metallic=1.0, roughness=(0.2, 0.4))
    cone = [(0.018, 0), (0.03, -0.02), (0.1, -0.1), (0.125, -0.16), (0.122, -0.16), (0.096, -0.1), (0.026, -0.024)]
    for k, x in enumerate((-0.95, 0.05, 1.05)):
        hook = empty("pendant", (x, 8.7, 3.0))
        lathe("shade", cone, shade, (0, 0, -1.0), parent=hook)
        wire([(0, 0, 0), (0, 0, -0.5), (0, 0, -1.0)], 0.004, plain("cable", (0.01, 0.01, 0.01)), "cable").parent = hook
        bulb(0.024, glow((1, 0.68, 0.36), 110), (0, 0, -1.105), 13, 24, hook)
        if k == 1:
            key_swing(hook, frames, "y", 0.05, 0.35)
    hues = (WARM, (1, 0.25, 0.12), (0.3, 0.9, 0.4), COOL)
    for k in range(24):  # a string of coloured lamps above
        t = k / 23
        bulb(0.012, glow(hues[k % 4], 110), (-2 + 4 * t, 9.6, 2.3 - 0.3 * math.sin(math.pi * ((3 * t) % 1))))
    camera = aim_camera((-0.4, 0.8, 1.62), (-0.12, 9.3, 1.53), 25)
    key_motion(camera, frames, velocity=(0.006, 0, 0), spin=(0, 0, -0.0032))


def clock(frames: range, gold: Any) -> None:
    """Add a wall clock with a swinging pendulum."""
    rim = [(0, 0.0), (0.075, 0), (0.082, -0.012), (0.09, -0.012), (0.094, 0.0), (0.094, 0.02)]
    lathe("rim", rim, gold, (0.3, 0.488, 1.31), FACING)
    white = plain("dial", (0.8, 0.77, 0.68), Roughness=0.4)
    lathe("dial", [(0, 0), (0.08, 0)], white, (0.3, 0.476, 1.31), FACING)
    ink = plain("ink", (0.02, 0.02, 0.025), Roughness=0.4)
    # angle, distance of the middle from the axis, y, width and length
    bars = [("tick", k * math.pi / 6, 0.065, 0.4745, 0.004, 0.016) for k in range(12)]
    bars += [("hand", a, long / 2, 0.473, 0.005, long) for a, long in ((1.1, 0.04), (4.2, 0.058))]
    for name, a, r, y, width, long in bars:
        bar = add_box((0.3 + r * math.sin(a), y, 1.31 + r * math.cos(a)), (width, 0.003, long), ink, name)
        bar.rotation_euler.y = a
    pivot = empty("pendulum", (0.3, 0.46, 1.3))
    add_box((0, 0, -0.12), (0.006, 0.004, 0.24), gold, "rod").parent = pivot
    lathe("bob", [(0, 0.006), (0.03, 0.004), (0.034, 0), (0.03, -0.004), (0, -0.006)], gold, (0, 0, -0.25), FACING,
          parent=pivot)  # fmt: skip
    key_swing(pivot, frames, "y", 0.35, 0.4, 0.3)


def shadow(rng: Rng, frames: range) -> None:
    """Build a sunlit corner: window light that moves over a wall and objects, swaying leaves and a clock."""
    sky("courtyard", 2.0, 0.6)
    plaster = two_tone("plaster", (0.62, 0.55, 0.44), (0.72, 0.66, 0.55), scale=14, bump=0.0012, Roughness=0.9,
                       roughness=(0.8, 0.95))  # fmt: skip
    walls = (((0, 0.55, 1.3), (6, 0.1, 3.2)), ((0, -3.6, 3.0), (6.4, 9, 0.1)), ((3.1, -3.6, 1.4), (0.1, 9, 3.4)),
             ((0, -8.1, 1.4), (6.4, 0.1, 3.4)))  # fmt: skip
    for center, size in walls:
        add_box(center, size, plaster)
    add_box((0, -3.6, -0.05), (6.4, 9, 0.1), wood(gloss=0.4))
    # The wall on the left has a window of twelve panes, through which the sun comes.
    for y, z, sy, sz in ((-5.6, 1.5, 5, 3), (0.15, 1.5, 0.9, 3), (-1.7, 0.4, 2.8, 0.9), (-1.7, 2.75, 2.8, 0.6)):
        add_box((-3.1, y, z), (0.12, sy, sz), plaster)
    bar = plain("frame", (0.75, 0.72, 0.66), Roughness=0.3)
    for k in range(7):
        add_box((-3.1, -3.1 + 0.466 * k, 1.65), (0.06, 0.045, 1.7), bar)
    for k in range(5):
        add_box((-3.1, -1.7, 0.86 + 0.4 * k), (0.05, 2.8, 0.04), bar)
    board = wood((0.05, 0.02, 0.008), (0.22, 0.09, 0.035), gloss=0.3)
    bevelled((0.1, 0.3, 0.86), (1.5, 0.4, 0.035), board, 0.006, "sideboard")
    bevelled((0.1, 0.31, 0.5), (1.44, 0.36, 0.7), board, 0.006, "chest")
    stone = two_tone("stoneware", (0.1, 0.16, 0.18), (0.24, 0.34, 0.36), scale=30, roughness=(0.25, 0.5), bump=0.0006)
    vase = [(0, 0), (0.045, 0), (0.05, 0.01), (0.082, 0.08), (0.075, 0.15), (0.034, 0.2), (0.03, 0.225), (0.041, 0.245),
            (0.037, 0.245), (0.026, 0.222), (0, 0.2)]  # fmt: skip
    lathe("vase", vase, stone, (-0.19, 0.27, 0.878))
    green = two_tone("leaf", (0.04, 0.11, 0.02), (0.13, 0.27, 0.06), scale=20, roughness=(0.35, 0.5))
    for k in range(9):
        stem = twig(rng, 9, 0.34, green, board, 0.085)
        place(stem, (-0.19, 0.27, 1.1), (float(rng.normal(0, 0.6)), -1.25 + 0.28 * float(rng.normal()), 0.75 * k))
        key_swing(stem, frames, "y", 0.055, 0.5, 0.9 * k)
    books = ((0.035, (0.32, 0.05, 0.04)), (0.05, (0.05, 0.1, 0.2)), (0.03, (0.5, 0.4, 0.2)),
             (0.042, (0.08, 0.16, 0.08)))  # fmt: skip
    for k, (thick, tone) in enumerate(books):
        center = (0.14, 0.26, 0.896 + sum(below for below, _ in books[:k]))
        lighter = (1.5 * tone[0], 1.5 * tone[1], 1.5 * tone[2])
        cloth = two_tone("cloth", tone, lighter, scale=400, bump=0.0002)
        book = bevelled(center, (0.2, 0.15, thick - 0.003), cloth, 0.003, "book")
        paper = plain("paper", (0.8, 0.75, 0.62), Roughness=0.9)
        pages = add_box(center, (0.203, 0.142, thick - 0.011), paper)
        book.rotation_euler.z = pages.rotation_euler.z = 0.35 - 0.22 * k
    gold = plain("gold", (0.85, 0.6, 0.25), Metallic=1.0, Roughness=0.2)
    clock(frames, gold)
    bevelled((-0.02, 0.49, 1.62), (0.5, 0.03, 0.36), gold, 0.008, "frame")
    add_box((-0.02, 0.472, 1.62), (0.43, 0.005, 0.29), printed(rng), "picture")
    sun = add_lamp("SUN", (0, 0, 5), 6.5, 0.0093, (0, 0, 0), (1, 0.86, 0.66))
    sun.rotation_euler = Vector((3.05, 2.0, -1.0)).to_track_quat("-Z", "Y").to_euler()
    key_motion(sun, frames, spin=(0, 0, 0.004))
    camera = aim_camera((0.55, -3.7, 1.42), (0.02, 0.4, 1.18), 27)
    key_motion(camera, frames, velocity=(-0.002, 0, 0))


def brick_material() -> Any:
    """Make a wall of bricks with relief, in the plane of x and z."""
    bricks = plain("brick", (0.3, 0.12, 0.08), Roughness=0.85)
    tree = bricks.node_tree
    where = node(tree, "Mapping", Vector=node(tree, "TexCoord").outputs["Object"], Rotation=FACING)
    laid = node(tree, "TexBrick", Vector=where.outputs["Vector"], Scale=6.5, Color1=(0.3, 0.11, 0.07, 1),
                Color2=(0.16, 0.07, 0.05, 1), Mortar=(0.3, 0.28, 0.25, 1), Mortar_Size=0.025)  # fmt: skip
    relief = node(tree, "Bump", Height=laid.outputs["Fac"], Strength=1.0, Distance=-0.006)
    shader = tree.nodes["Principled BSDF"]
    tree.links.new(laid.outputs["Color"], shader.inputs["Base Color"])
    tree.links.new(relief.outputs["Normal"], shader.inputs["Normal"])
    return bricks


def fan_in_wall(frames: range, rust: Any, iron: Any) -> None:
    """Add a wall of brick with a round hole, and a turning fan behind a guard in the hole."""
    cx, cz, radius = -0.42, 1.62, 0.46
    center = (cx, 2.5, cz)
    wall = add_box((0, 2.5, 1.8), (7, 0.16, 3.6), brick_material())
    hole = wall.modifiers.new("hole", "BOOLEAN")
    drum = lathe("drum", [(0, -0.4), (radius, -0.4), (radius, 0.4), (0, 0.4)], None, center, FACING, segments=96)
    drum.hide_render = True
    drum.hide_set(True)
    hole.object, hole.operation = drum, "DIFFERENCE"
    ring = [(0.99, -0.16), (1.06, -0.19), (1.1, -0.18), (1.1, 0.2), (1.06, 0.21), (0.99, 0.2), (0.97, 0), (0.99, -0.16)]
    lathe("ring", [(radius * r, 0.5 * z) for r, z in ring], rust, center, FACING, segments=96)
    fan = empty("fan", center)
    hub = [(0, 0.07), (0.06, 0.07), (0.08, 0.04), (0.08, -0.05), (0, -0.05)]
    lathe("hub", hub, iron, (0, 0, 0), FACING, parent=fan)
    for k in range(5):
        blade = bevelled((0, 0, 0), (0.17, 0.008, radius - 0.1), rust, 0.003, "blade")
        blade.data.transform(Matrix.Translation((0, 0, 0.04 + radius / 2)))
        blade.rotation_mode = "ZYX"  # the pitch around the blade's own length first
        place(blade, (0, 0, 0), (0, 2 * math.pi * k / 5, 0.5), parent=fan)
    key_motion(fan, frames, spin=(0, 0.07, 0))
    for k in (-1, 0, 1):
        shift, across = 0.22 * k, math.sqrt(radius**2 - (0.22 * k) ** 2)
        for points in (
            [(cx + shift, 2.4, cz - across), (cx + shift, 2.38, cz), (cx + shift, 2.4, cz + across)],
            [(cx - across, 2.39, cz + shift), (cx, 2.37, cz + shift), (cx + across, 2.39, cz + shift)],
        ):
            wire(points, 0.007, iron, "guard")


def volume(rng: Rng, frames: range) -> None:
    """Build a workshop full of smoke: a fan turns before the light, its beams sweep past pipes, chains and barrels."""
    black_world()
    concrete = two_tone("concrete", (0.12, 0.11, 0.1), (0.3, 0.28, 0.26), scale=2.5, bump=0.004, roughness=(0.6, 0.95))
    wet = two_tone("floor", (0.04, 0.04, 0.04), (0.12, 0.11, 0.1), scale=4, bump=0.002, roughness=(0.1, 0.6))
    rust = two_tone("rust", (0.12, 0.035, 0.015), (0.3, 0.14, 0.07), scale=12, roughness=(0.45, 0.9), bump=0.002)
    iron = two_tone("iron", (0.05, 0.05, 0.055), (0.2, 0.2, 0.21), scale=20, Metallic=1.0, roughness=(0.3, 0.6))
    add_box((0, 0, -0.05), (7, 10, 0.1), wet)
    add_box((0, 0, 3.65), (7, 10, 0.1), concrete)
    for side in (-1, 1):
        add_box((side * 3.4, 0, 1.8), (0.1, 10, 3.6), concrete)
    fan_in_wall(frames, rust, iron)
    barrel = [(0, 0), (0.27, 0), (0.285, 0.01), (0.275, 0.03), (0.275, 0.27), (0.29, 0.285), (0.275, 0.3),
              (0.275, 0.57), (0.29, 0.585), (0.275, 0.6), (0.275, 0.85), (0.285, 0.87), (0.27, 0.88), (0.26, 0.865),
              (0, 0.865)]  # fmt: skip
    for k, at in enumerate(((0.72, 0.9, 0.25), (1.25, 1.3, 0.25), (0.98, 1.15, 1.13), (-1.1, 0.6, 0.05))):
        place(lathe("barrel", barrel, (rust, iron)[k % 2]), at, (0, 0, float(rng.uniform(0, 6))), 0.8)
    bevelled((1.0, 1.1, 0.12), (1.5, 1.0, 0.24), wood((0.04, 0.025, 0.015), (0.16, 0.1, 0.06), 0.7), 0.01, "pallet")
    for x, z in ((-1.12, 2.2), (0.3, 2.05), (0.42, 2.05)):
        wire([(x, 2.34, 0), (x, 2.34, z - 0.3), (x, 2.3, z), (x, 1.5, z + 0.05), (x, -4, z)], 0.045, rust, "pipe")
    for strand, (x, y) in enumerate(((0.18, 0.9), (-0.75, 0.2))):
        hook = empty("chain", (x, y, 3.6))
        for k in range(44):
            bpy.ops.mesh.primitive_torus_add(major_radius=0.03, minor_radius=0.008, major_segments=20, minor_segments=8)
            link = bpy.context.active_object
            link.data.materials.append(iron)
            bpy.ops.object.shade_smooth()
            place(link, (0, 0, -0.053 * k), (math.pi / 2, 0, math.pi / 2 * (k % 2)), parent=hook)
            link.scale = (0.75, 1.2, 1)
        key_swing(hook, frames, "y", 0.03, 0.4, strand)
    beam = add_lamp("SPOT", (-2.2, 6.4, 3.3), 38000, 0.06, (0.35, 0.9, 0.7), (1, 0.83, 0.6))
    beam.data.spot_size, beam.data.spot_blend = 0.6, 0.3
    add_lamp("POINT", (2.4, -1.5, 2.6), 130, 0.1, (0, 0, 0), (0.45, 0.65, 1.0))
    fill_with_smoke(frames, (0, -0.6, 1.8), (6.7, 6.0, 3.6), (0.02, 0.1), 1.6, 0.55)
    camera = aim_camera((0.25, -4.3, 1.35), (0.06, 2.4, 1.36), 16)
    key_motion(camera, frames, velocity=(0.012, 0, 0))


SHOTS: dict[str, Callable[[Rng, range], None]] = {
    "lens": lens,
    "closeup": closeup,
    "lamps": lamps,
    "shadow": shadow,
    "volume": volume,
}
