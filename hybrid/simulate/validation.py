"""Three fixed shots that together hold every effect: to validate with, and to view.

*table*: glass and its caustics, wax, hair, depth of field, indirect light. *night*: many small lights, fog, a mirror.
*garden*: sky, leaves cut out by transparency, fast motion. Each holds something that moves. Lengths are metres, z is
up.
"""

from __future__ import annotations

import math

import bpy
from mathutils import Vector

from hybrid.simulate.motion import key_motion
from hybrid.simulate.random_assets import add_asset, material, set_world
from hybrid.simulate.scene_assets import Rng, add_box, add_lamp, add_mesh, add_object, fill_with_fog, node, place
from hybrid.simulate.scene_files import SceneFile


def table(rng: Rng, frames: range) -> None:
    """Build a table in a closed room: one lamp turned to the ceiling, one small and bright."""
    made = SceneFile("table", frames)
    add_box((0, 0.3, -0.04), (2.6, 2.0, 0.08), material(rng, "plastic", True))
    add_box((0.5, 2.38, 0.9), (1.4, 0.04, 1.0), material(rng, "diffuse"), "picture")
    set_world(rng, "none", 0)
    place(add_asset(rng, made.materials["glass"], "sphere"), (-0.3, -0.1, 0.17), size=0.34)
    place(add_asset(rng, made.materials["wax"], "monkey"), (0.12, 0.25, 0.22), (0, 0, 0.3), 0.42)
    place(add_asset(rng, made.materials["hair"], "fur"), (0.52, -0.05, 0.17), size=0.4)
    place(add_asset(rng, material(rng, "metal"), "torus"), (-0.62, 0.45, 0.06), size=0.4)
    place(add_asset(rng, material(rng, "diffuse"), "box"), (0.2, 0.95, 0.12), (0, 0, 0.7), 0.3)
    turning = place(add_asset(rng, material(rng, "plastic"), "cage"), (0.28, -0.42, 0.11), size=0.22)
    key_motion(turning, frames, spin=(0, 0, 0.25))


def night(rng: Rng, frames: range) -> None:
    """Build a street at night: sixty bulbs, fog, a mirror, a wet floor, and a ball that rolls by."""
    SceneFile("night", frames)
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
    place(add_asset(rng, material(rng, "coated"), "monkey"), (0.75, 2.2, 0.55), (0, 0, -0.2), 0.9)
    ball = place(add_asset(rng, material(rng, "diffuse"), "sphere"), (0.0, 1.0, 0.3), size=0.5)
    key_motion(ball, frames, velocity=(0.12, 0, 0), spin=(0, 0.4, 0))
    set_world(rng, "none", 0)
    fill_with_fog((0, 3, 2), (11.5, 11.5, 4.4), density=0.02, forward=0.5)


def garden(rng: Rng, frames: range) -> None:
    """Build a bush of cut-out leaves and grass under sky and sun, with one object that flies and one that bends."""
    made = SceneFile("garden", frames)
    add_box((0, 4, -0.05), (30, 30, 0.1), material(rng, "diffuse", True))
    add_box((1.5, 5, 1), (5, 0.3, 2), material(rng, "diffuse", True))
    leaf = made.materials["leaf"]
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
    place(add_asset(rng, made.materials["grass"], "fur"), (0.9, 0.6, 0.1), size=1.2)
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


SHOTS = {"table": table, "night": night, "garden": garden}
