"""Three fixed shots that together hold every effect: to validate with, and to view.

*table*: glass and its caustics, wax, hair, depth of field, indirect light. *night*: many small lights, fog, a mirror.
*garden*: sky, leaves cut out by transparency, fast motion. Each holds something that moves. Lengths are metres, z is
up.
"""

from __future__ import annotations

import math
from collections.abc import Callable

import bpy
from mathutils import Vector

from hybrid.simulate.motion import aim_camera, key_motion
from hybrid.simulate.random_assets import add_asset, material, set_world
from hybrid.simulate.scene_assets import (
    Rng,
    add_box,
    add_lamp,
    add_mesh,
    add_object,
    clear_glass,
    fill_with_fog,
    node,
    place,
    plain,
)


def table(rng: Rng, frames: range) -> None:
    """Build a table in a closed room: one lamp turned to the ceiling, one small and bright."""
    wall = plain("wall", (0.75, 0.72, 0.66), Specular_IOR_Level=0)
    for center, size in (
        ((0, 0, 2.6), (5, 5, 0.1)), ((0, 0, -0.85), (5, 5, 0.1)), ((0, 2.45, 0.9), (5, 0.1, 3.6)),
        ((0, -2.45, 0.9), (5, 0.1, 3.6)), ((2.45, 0, 0.9), (0.1, 5, 3.6)),
    ):  # fmt: skip
        add_box(center, size, wall)
    add_box((-2.45, 0, 0.9), (0.1, 5, 3.6), plain("red wall", (0.65, 0.12, 0.08), Specular_IOR_Level=0))
    add_box((0, 0.3, -0.04), (2.6, 2.0, 0.08), material(rng, "plastic", True))
    add_box((0.5, 2.38, 0.9), (1.4, 0.04, 1.0), material(rng, "diffuse"), "picture")
    set_world(rng, "none", 0)
    add_lamp("SPOT", (1.5, 1.2, 0.8), 500, 0.1, (1.0, 1.4, 2.6), (1, 0.9, 0.75))
    add_lamp("POINT", (-0.75, -0.35, 0.75), 40, 0.02, (0, 0, 0), (1, 0.85, 0.65))
    place(add_asset(rng, clear_glass("glass"), "sphere"), (-0.3, -0.1, 0.17), size=0.34)
    wax = plain("wax", (0.8, 0.55, 0.35), Subsurface_Weight=1, Subsurface_Scale=0.05, Roughness=0.4)
    place(add_asset(rng, wax, "monkey"), (0.12, 0.25, 0.22), (0, 0, 0.3), 0.42)
    place(add_asset(rng, plain("hair", (0.35, 0.18, 0.08), Roughness=0.4), "fur"), (0.52, -0.05, 0.17), size=0.4)
    place(add_asset(rng, material(rng, "metal"), "torus"), (-0.62, 0.45, 0.06), size=0.4)
    place(add_asset(rng, material(rng, "diffuse"), "box"), (0.2, 0.95, 0.12), (0, 0, 0.7), 0.3)
    turning = place(add_asset(rng, material(rng, "plastic"), "cage"), (0.28, -0.42, 0.11), size=0.22)
    key_motion(turning, frames, spin=(0, 0, 0.25))
    camera = aim_camera((0.1, -1.9, 0.75), (0.05, 0.1, 0.15), 50)
    camera.data.dof.use_dof, camera.data.dof.aperture_fstop = True, 0.8
    camera.data.dof.focus_distance = 2.1
    key_motion(camera, frames, velocity=(0.012, 0, 0))


def night(rng: Rng, frames: range) -> None:
    """Build a street at night: sixty bulbs, fog, a mirror, a wet floor, and a ball that rolls by."""
    add_box((0, 4, -0.05), (24, 24, 0.1), plain("wet", (0.05, 0.05, 0.06), Roughness=0.15))
    add_box((0, 9, 2), (24, 0.2, 6), material(rng, "diffuse", True))
    stone = material(rng, "diffuse", True)
    for x in (-2.6, -1.2, 1.2, 2.6):
        for y in (1.5, 4.0, 6.5):
            add_box((x, y, 1.25), (0.3, 0.3, 2.5), stone)
    for number in range(60):
        x, y = -3 + 6 * (number % 10) / 9, 1.2 + 6 * (number // 10) / 5
        height = 2.2 - 0.35 * math.sin(math.pi * (number % 10) / 9)
        hue = ((1, 0.55, 0.2), (1, 0.8, 0.5), (0.35, 0.6, 1), (1, 0.3, 0.35))[number % 4]
        add_lamp("POINT", (x, y, height), 20, 0.025, (0, 0, 0), hue)
    mirror = plain("mirror", (0.9, 0.9, 0.9), Metallic=1, Roughness=0)
    panel = add_box((-1.25, 2.6, 0.75), (1.0, 0.03, 1.5), mirror, "mirror")
    panel.rotation_euler.z = 0.5
    key_motion(panel, frames, spin=(0, 0, 0.004))
    place(add_asset(rng, material(rng, "coated"), "monkey"), (0.75, 2.2, 0.55), (0, 0, -0.2), 0.9)
    ball = place(add_asset(rng, material(rng, "diffuse"), "sphere"), (0.0, 1.0, 0.3), size=0.5)
    key_motion(ball, frames, velocity=(0.12, 0, 0), spin=(0, 0.4, 0))
    set_world(rng, "none", 0)
    fill_with_fog((0, 3, 2), (11.5, 11.5, 4.4), density=0.02, forward=0.5)
    camera = aim_camera((0.2, -3.2, 1.2), (0, 3, 0.9), 32)
    key_motion(camera, frames, spin=(0, 0, 0.004))


def garden(rng: Rng, frames: range) -> None:
    """Build a bush of cut-out leaves and grass under sky and sun, with one object that flies and one that bends."""
    add_box((0, 4, -0.05), (30, 30, 0.1), material(rng, "diffuse", True))
    add_box((1.5, 5, 1), (5, 0.3, 2), material(rng, "diffuse", True))
    leaf = plain("leaf", (0.16, 0.34, 0.06), Roughness=0.5)
    tree = leaf.node_tree
    cut, where, edge = (node(tree, kind) for kind in ("TexGradient", "TexCoord", "Math"))
    cut.gradient_type, edge.operation = "SPHERICAL", "GREATER_THAN"
    edge.inputs[1].default_value = 0.15
    tree.links.new(where.outputs["Object"], cut.inputs["Vector"])
    tree.links.new(cut.outputs["Fac"], edge.inputs[0])
    tree.links.new(edge.outputs["Value"], tree.nodes["Principled BSDF"].inputs["Alpha"])
    card = add_mesh("leaf", [(-1, -1, 0), (1, -1, 0), (1, 1, 0), (-1, 1, 0)], [(0, 1, 2, 3)], leaf)
    bpy.context.scene.collection.objects.unlink(card)
    for direction in rng.normal(0, 1, (260, 3)):
        item = add_object("leaf", card.data)
        item.location = Vector((-0.9, 1.6, 0.75)) + Vector(direction).normalized() * float(rng.uniform(0.35, 0.7))
        item.rotation_euler, item.scale = rng.uniform(-math.pi, math.pi, 3), (0.11, 0.06, 1)
    place(add_asset(rng, plain("grass", (0.25, 0.3, 0.08), Roughness=0.6), "fur"), (0.9, 0.6, 0.1), size=1.2)
    flying = place(add_asset(rng, material(rng, "coated"), "box"), (0.3, 0.9, 0.95), (0, 0, 0.4), 0.3)
    key_motion(flying, frames, velocity=(-0.09, 0, 0.02), spin=(0.1, 0.05, 0.15))
    bending = place(add_asset(rng, material(rng, "plastic"), "monkey"), (0.55, 1.9, 0.45), (0, 0, -0.3), 0.7)
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
    camera = aim_camera((0.1, -2.6, 1.0), (0, 1.5, 0.65), 35)
    key_motion(camera, frames, velocity=(0.015, 0, 0))


SHOTS: dict[str, Callable[[Rng, range], None]] = {"table": table, "night": night, "garden": garden}
