"""Random shots, and shots of scenes from files. All random numbers come from the seed of the shot.

A random shot is a *set* (room, studio, outdoors, night, wall), objects in it, lights, a camera on a path, and a crop
of its film-size image. Lengths are metres, z is up. Brightness is left to `exposure`.
"""

import math
from collections.abc import Callable
from pathlib import Path
from typing import Any, NamedTuple

import bpy
import numpy as np
from mathutils import Vector

from hybrid.simulate import scene_assets as assets
from hybrid.simulate.effects import visible_points
from hybrid.simulate.motion import add_floating, add_motion, frame_crop, move_object, place_camera
from hybrid.simulate.random_assets import (
    add_bulb_sphere,
    clutter,
    color,
    log_uniform,
    material,
    scatter,
    set_emission,
    set_world,
    warm,
    weighted_choice,
)
from hybrid.simulate.shot import ShotSettings

FOG_BOX = ((0, 0, 4), (28, 28, 9))  # center and size


class View(NamedTuple):
    """A point worth looking at, and where the camera may stand."""

    focus: Vector
    eye: Vector


def room_set(rng: assets.Rng) -> View:
    """Build a room with windows, furniture and objects on it; lit from outside, by lamps, or both."""
    w, d, h = rng.uniform(3, 7), rng.uniform(4, 8), rng.uniform(2.4, 3.6)
    walls, floor, ceiling = (material(rng, surface, True) for surface in ("diffuse", None, "diffuse"))
    if floor.name.startswith(("glass", "emission", "mirror")):
        floor = material(rng, "plastic", True)
    for z, surface in ((-0.05, floor), (h + 0.05, ceiling)):
        assets.add_box((0, 0, z), (w + 0.4, d + 0.4, 0.1), surface)
    for y in (d / 2 + 0.1, -d / 2 - 0.1):
        assets.add_box((0, y, h / 2), (w + 0.4, 0.2, h), walls)
    daylight = rng.random() < 0.7
    for side in (-1, 1):
        x = side * (w / 2 + 0.1)
        if daylight and (side < 0 or rng.random() < 0.3):
            sill, top, width = rng.uniform(0.2, 1.0), rng.uniform(1.9, h - 0.2), rng.uniform(1.0, d - 1)
            assets.add_box((x, 0, sill / 2), (0.2, d, sill), walls)
            assets.add_box((x, 0, (h + top) / 2), (0.2, d, h - top), walls)
            for end in (-1, 1):
                assets.add_box((x, end * (d + width) / 4, (sill + top) / 2), (0.2, (d - width) / 2, top - sill), walls)
            bars, frame = int(rng.integers(0, 14)), material(rng, "plastic")
            across = rng.random() < 0.5
            for k in range(bars):
                t = (k + 0.5) / bars - 0.5
                if across:
                    assets.add_box((x, 0, (sill + top) / 2 + t * (top - sill)), (0.08, width, 0.04), frame)
                else:
                    assets.add_box((x, t * width, (sill + top) / 2), (0.08, 0.05, top - sill), frame)
        else:
            assets.add_box((x, 0, h / 2), (0.2, d, h), walls)
    if daylight:
        set_world(rng, weighted_choice(rng, {"sky": 2, "image": 2, "constant": 1}), 1.0)
        if rng.random() < 0.4:
            aim = Vector((rng.uniform(0.4, 1), rng.uniform(-0.5, 0.5), -rng.uniform(0.3, 0.9)))
            assets.add_lamp(
                "SUN", -10 * aim, log_uniform(rng, 2, 12), log_uniform(rng, 0.005, 0.05), (0, 0, 0), warm(rng)
            )
    else:
        set_world(rng, "none", 0)
    for _ in range(int(rng.integers(0 if daylight else 1, 5))):
        lamp = weighted_choice(rng, {"AREA": 2, "POINT": 2, "SPOT": 1})
        position = (rng.uniform(-0.4, 0.4) * w, rng.uniform(-0.4, 0.4) * d, h - rng.uniform(0.05, 0.8))
        size = rng.uniform(0.2, 1.2) if lamp == "AREA" else log_uniform(rng, 0.01, 0.15)
        assets.add_lamp(lamp, position, log_uniform(rng, 10, 80), size, (position[0], position[1], 0), warm(rng))
    wood = material(rng, "plastic")
    x, y, height = rng.uniform(-0.15, 0.15) * w, rng.uniform(0, 0.25) * d, rng.uniform(0.4, 0.9)
    tw, td = rng.uniform(1.0, 2.2), rng.uniform(0.7, 1.3)
    assets.add_box((x, y, height - 0.03), (tw, td, 0.06), wood)
    for sx in (-1, 1):
        for sy in (-1, 1):
            assets.add_box((x + sx * (tw / 2 - 0.05), y + sy * (td / 2 - 0.05), height / 2), (0.06, 0.06, height), wood)
    clutter(rng, (x, y, height), (tw / 2 - 0.1, td / 2 - 0.1), int(rng.integers(8, 22)), (0.07, 0.4))
    clutter(rng, (0, 0, 0), (w / 2 - 0.4, d / 2 - 0.4), int(rng.integers(4, 14)), (0.2, 0.9))
    shelf = material(rng, "plastic")
    for k in range(int(rng.integers(0, 4))):
        z = 0.8 + 0.5 * k
        if z < h - 0.4:
            assets.add_box((x, d / 2 - 0.15, z), (rng.uniform(1, 3), 0.3, 0.03), shelf)
            clutter(rng, (x, d / 2 - 0.17, z + 0.015), (0.8, 0.05), int(rng.integers(4, 12)), (0.1, 0.35))
    for _ in range(int(rng.integers(1, 5))):
        hang_picture(rng, (rng.uniform(-0.4, 0.4) * w, d / 2 - 0.02, rng.uniform(0.4, 0.8) * h))
    eye = Vector((rng.uniform(-0.3, 0.3) * w, -d / 2 + rng.uniform(0.3, 1.5), rng.uniform(0.9, 1.8)))
    return View(Vector((x + rng.uniform(-0.3, 0.3) * tw, y, height + rng.uniform(-0.1, 0.4))), eye)


def hang_picture(rng: assets.Rng, position: assets.Point) -> None:
    """Hang a framed picture, or now and then a mirror, around `position` on a wall that faces −y."""
    w, h = rng.uniform(0.3, 1.0), rng.uniform(0.3, 0.8)
    inside = material(rng, "mirror" if rng.random() < 0.2 else None)
    assets.add_box(position, (w, 0.02, h), inside, "picture")
    edge = material(rng)
    for sign in (-1, 1):
        assets.add_box((position[0] + sign * w / 2, position[1], position[2]), (0.04, 0.05, h + 0.04), edge)
        assets.add_box((position[0], position[1], position[2] + sign * h / 2), (w + 0.04, 0.05, 0.04), edge)


def studio_set(rng: assets.Rng) -> View:
    """Build a backdrop with a group of objects on plinths, lit by area lamps, one perhaps behind slats."""
    radius = log_uniform(rng, 0.5, 2.0)
    floor = material(rng, weighted_choice(rng, {"diffuse": 2, "plastic": 2, "metal": 1}), True)
    assets.add_box((0, 0, -0.05), (30, 30, 0.1), floor)
    if rng.random() < 0.7:
        assets.add_box((0, radius * 2.5, 5), (30, 0.1, 10), material(rng, "diffuse", True))
    for _ in range(int(rng.integers(0, 4))):
        x, y, height, side = *rng.uniform(-0.8, 0.8, 2) * radius, rng.uniform(0.1, 0.7) * radius, radius * 0.5
        assets.add_box((x, y, height / 2), (side, side, height), material(rng))
        clutter(rng, (x, y, height), (side / 3, side / 3), 4, (0.12 * radius, 0.4 * radius))
    clutter(rng, (0, 0, 0), (radius, radius), int(rng.integers(14, 36)), (0.08 * radius, 0.6 * radius))
    set_world(rng, weighted_choice(rng, {"none": 2, "constant": 1, "image": 3}), log_uniform(rng, 0.05, 1))
    for k in range(int(rng.integers(1, 4))):
        angle, distance = rng.uniform(math.pi * 0.9, math.pi * 2.1), radius * rng.uniform(1.5, 3.5)
        position = Vector((distance * math.cos(angle), distance * math.sin(angle), radius * rng.uniform(0.8, 3)))
        kind = weighted_choice(rng, {"AREA": 3, "SPOT": 1, "POINT": 1})
        size = radius * (rng.uniform(0.2, 1.5) if kind == "AREA" else log_uniform(rng, 0.01, 0.1))
        assets.add_lamp(
            kind, position, 60 * distance**2 * log_uniform(rng, 0.3, 3), size, (0, 0, 0.2 * radius), warm(rng)
        )
        if k == 0 and rng.random() < 0.3:
            slats, toward = material(rng, "diffuse"), Vector((0, 0, 0.2 * radius)) - position
            for t in np.linspace(-1, 1, 11):
                slat = assets.add_box((0, 0, 0), (radius * 2, 0.02, radius * 0.09), slats)
                slat.rotation_euler = toward.to_track_quat("Y", "Z").to_euler()
                slat.location = position + 0.35 * toward + Vector((0, 0, float(t) * radius))
    angle, distance = rng.uniform(-0.8, 0.8), radius * rng.uniform(1.6, 3)
    eye = Vector((distance * math.sin(angle), -distance * math.cos(angle), radius * rng.uniform(0.15, 1.4)))
    return View(Vector((*rng.uniform(-0.4, 0.4, 2) * radius, radius * rng.uniform(0.1, 0.4))), eye)


def outdoor_set(rng: assets.Rng) -> View:
    """Build rough ground under a sky, with scattered instances, walls and objects."""
    side, n = 24.0, 160
    y, x = np.mgrid[:n, :n] / (n - 1) - 0.5
    height = np.zeros((n, n))
    for octave in range(1, 6):
        for _ in range(3):
            kx, ky = rng.normal(0, 2**octave, 2)
            height += 1.2 * 2.0 ** (-1.2 * octave) * np.sin(2 * np.pi * (kx * x + ky * y + rng.random()))
    height *= rng.uniform(0.1, 1.0) * np.clip(np.hypot(x, y) * 4, 0.1, 1)
    vertices = np.stack([x * side, y * side, height], -1).reshape(-1, 3)
    ground = material(rng, weighted_choice(rng, {"diffuse": 4, "plastic": 1}), True)
    assets.add_mesh("ground", vertices, assets.grid_faces(n, n), ground, smooth=True)

    def on_ground(spread: float, sizes: tuple[float, float]) -> tuple[assets.Point, float]:
        px, py = rng.normal(0, spread, 2).clip(-0.48 * side, 0.48 * side)
        size = log_uniform(rng, *sizes)
        i, j = int((py / side + 0.5) * (n - 1)), int((px / side + 0.5) * (n - 1))
        return (px, py, float(height[i, j]) + 0.2 * size), size

    scatter(rng, int(rng.integers(60, 220)), lambda: on_ground(2.5, (0.06, 0.5)), 5)
    scatter(rng, int(rng.integers(10, 50)), lambda: on_ground(7.0, (0.5, 2.5)), 3)
    clutter(rng, (0, 0, 0.05), (1.6, 1.6), int(rng.integers(10, 26)), (0.15, 0.9))
    for _ in range(int(rng.integers(1, 6))):
        size = tuple(map(float, rng.uniform(1, 5, 3)))
        position = (rng.uniform(-8, 8), rng.uniform(3, 11), size[2] / 2 - 0.2)
        assets.add_box(position, size, material(rng, weighted_choice(rng, {"diffuse": 3, "plastic": 1}), True))
    set_world(rng, weighted_choice(rng, {"sky": 3, "image": 2}), 1.0)
    if rng.random() < 0.3:
        assets.add_lamp("SUN", (0, 0, 9), log_uniform(rng, 1, 6), 0.01, (*rng.normal(0, 5, 2), 0.0), warm(rng))
    angle, distance = rng.uniform(-0.7, 0.7), rng.uniform(2.5, 6)
    eye = Vector((distance * math.sin(angle), -distance * math.cos(angle), rng.uniform(0.7, 2.2)))
    return View(Vector((*rng.uniform(-0.6, 0.6, 2), rng.uniform(0.1, 0.6))), eye)


def night_set(rng: assets.Rng) -> View:
    """Build columns and blocks on a glossy floor, lit by many small bright lights."""
    floor = material(rng, weighted_choice(rng, {"plastic": 2, "coated": 1, "metal": 1}), True)
    assets.add_box((0, 0, -0.05), (40, 40, 0.1), floor)
    assets.add_box((0, 8, 3), (30, 0.2, 8), material(rng, "diffuse", True))
    stone = [material(rng, weighted_choice(rng, {"diffuse": 2, "plastic": 2, "metal": 1}), True) for _ in range(3)]
    for _ in range(int(rng.integers(8, 24))):
        x, y = rng.uniform(-6, 6), rng.uniform(0.5, 7.5)
        size = (*rng.uniform(0.2, 1.0, 2), rng.uniform(0.3, 4))
        assets.add_box((x, y, size[2] / 2), size, stone[int(rng.integers(3))])
    clutter(rng, (0, 0, 0), (2.5, 1.8), int(rng.integers(14, 32)), (0.12, 0.9))
    hues = [color(rng, 1.0) for _ in range(4)]
    bulbs = int(log_uniform(rng, 8, 70))
    glow = [material(rng, "emission") for _ in hues]
    for surface, hue in zip(glow, hues, strict=True):
        set_emission(surface, hue, log_uniform(rng, 30, 300))
    for number in range(bulbs):
        position = (rng.uniform(-5, 5), rng.uniform(-3, 7), rng.uniform(0.2, 3.5))
        if number % 2:
            assets.add_lamp("POINT", position, log_uniform(rng, 2, 40), 0.03, (0, 0, 0), hues[number % 4][:3])
        else:
            add_bulb_sphere(rng.uniform(0.015, 0.06), position, glow[number % 4])
    set_world(rng, "constant", 0.02)
    eye = Vector((rng.uniform(-2, 2), -rng.uniform(3, 6), rng.uniform(0.5, 1.8)))
    return View(Vector((rng.uniform(-1, 1), rng.uniform(-0.5, 1), rng.uniform(0.1, 0.8))), eye)


def wall_set(rng: assets.Rng) -> View:
    """Build a wall with relief, pictures, writing and pipes, lit from the side."""
    assets.add_box((0, 0.1, 2), (14, 0.2, 6), material(rng, None if rng.random() < 0.3 else "diffuse", True))
    assets.add_box((0, -3, -0.05), (14, 8, 0.1), material(rng, "plastic", True))
    for _ in range(int(rng.integers(3, 9))):
        hang_picture(rng, (rng.uniform(-3, 3), -0.02, rng.uniform(0.5, 2.6)))

    def on_wall() -> tuple[assets.Point, float]:
        return (rng.uniform(-3.5, 3.5), -rng.uniform(0, 0.15), rng.uniform(0.2, 3.2)), log_uniform(rng, 0.06, 0.5)

    scatter(rng, int(rng.integers(30, 120)), on_wall, 6)
    clutter(rng, (0, -0.6, 0), (3, 0.4), int(rng.integers(8, 20)), (0.15, 0.8))
    set_world(rng, weighted_choice(rng, {"none": 1, "constant": 2, "image": 3}), log_uniform(rng, 0.1, 1))
    for _ in range(int(rng.integers(1, 4))):
        position = (rng.choice([-1, 1]) * rng.uniform(1, 5), -rng.uniform(0.5, 3), rng.uniform(1, 4))
        kind = weighted_choice(rng, {"AREA": 2, "SPOT": 1, "POINT": 1})
        assets.add_lamp(kind, position, log_uniform(rng, 100, 900), rng.uniform(0.05, 0.8), (0, 0, 1.2), warm(rng))
    x = rng.uniform(-2, 2)
    eye = Vector((x + rng.uniform(-1.5, 1.5), -rng.uniform(1.8, 4), rng.uniform(0.8, 2)))
    return View(Vector((x, -0.1, rng.uniform(0.5, 2))), eye)


SETS: dict[str, tuple[float, Callable[[assets.Rng], View]]] = {
    "room": (0.32, room_set),
    "studio": (0.26, studio_set),
    "outdoor": (0.18, outdoor_set),
    "night": (0.12, night_set),
    "wall": (0.12, wall_set),
}
HARD = {"hair": 0.21, "glass": 0.21, "metal": 0.19, "lens": 0.19, "volume": 0.06, "dim": 0.14}
# The materials of what each of HARD adds; None is a random one.
SURFACES: dict[str, tuple[str | None, ...]] = {
    "hair": ("diffuse",),
    "glass": ("glass",),
    "metal": ("metal", "metal", "mirror"),
    "lens": (None,),
}
CREDIT = ("title", "author", "licence", "licence_url", "original")


def random_shot(shot: ShotSettings, attempt: int) -> dict[str, Any]:
    """Build a random shot in an empty Blender scene; return its description.

    Each attempt with one seed is another shot: when the first shows nothing, the next is tried. A shot of `hard` is
    the one of `random` with one to three of `HARD` added.
    """
    rng = np.random.default_rng([shot.seed, attempt])
    # A generator of its own, so that the same seeds give the same random shots with `HARD` and without.
    hard_rng = np.random.default_rng([shot.seed, attempt, 1])
    hard: list[str] = []
    if shot.scene == "hard":
        count = int(hard_rng.choice([1, 2, 3], p=[0.45, 0.4, 0.15]))
        hard = sorted(hard_rng.choice(list(HARD), count, replace=False, p=list(HARD.values())).tolist())
    bpy.ops.wm.read_factory_settings(use_empty=True)
    scene = bpy.context.scene
    scene.frame_start, scene.frame_end = shot.keyed[0], shot.keyed[-1]
    scene.frame_set(shot.middle)
    kind = weighted_choice(rng, {name: weight for name, (weight, _) in SETS.items()})
    view = SETS[kind][1](rng)
    camera = place_camera(rng, view.focus, view.eye)
    film = shot.film
    if film is None:
        # 0x0: no more than is rendered.
        films = {"1920x1080": 0.6, "2048x1152": 0.12, "2560x1440": 0.1, "0x0": 0.18}
        width, height = map(int, weighted_choice(rng, films).split("x"))
        film = max(width, shot.size[0]), max(height, shot.size[1])
    center = frame_crop(rng, shot, film)
    added = [motion for name in hard for motion in make_hard(hard_rng, shot, name)]
    if rng.random() < 0.15 or "lens" in hard:
        points = visible_points(scene)
        focus = (points[int(rng.integers(len(points)))][0] - camera.location).length if points else 3.0
        camera.data.dof.use_dof, camera.data.dof.focus_distance = True, focus
        camera.data.dof.aperture_fstop = log_uniform(rng, 0.7, 5.6)
        if "lens" in hard:
            distances = [(position - camera.location).length for position, _ in points]
            open_aperture(camera, distances, log_uniform(hard_rng, 4, 25) / film[0])
    if rng.random() < 0.04:
        density = log_uniform(rng, 0.1, 0.6) / (view.focus - view.eye).length  # the optical depth up to the focus
        assets.fill_with_fog(*FOG_BOX, density, rng.uniform(0, 0.7))
    motion = {"motion": "keep"} if shot.motion == "keep" else add_motion(rng, shot, own_objects=True)
    return {
        "set": kind,
        **({"hard": hard, "added": added} if hard else {}),
        "film": list(film),
        "center": [round(c, 4) for c in center],
        "lens": camera.data.lens,
        **motion,
    }


def open_aperture(camera: Any, distances: list[float], blur: float) -> None:
    """Set the aperture at which the most defocused of `distances` has a disc of `blur` times the image's width."""
    data = camera.data
    # The disc's diameter on the sensor is that of the aperture times lens · |1/focus − 1/distance|.
    apart = max((abs(1 / data.dof.focus_distance - 1 / distance) for distance in distances), default=0.0)
    diameter = blur * data.sensor_width / data.lens / max(apart, 1e-3)  # metres; a flat scene has no defocus
    data.dof.aperture_fstop = max(data.lens / 1000 / diameter, 0.1)


def make_hard(rng: assets.Rng, shot: ShotSettings, name: str) -> list[dict[str, Any]]:
    """Add one of `HARD`, but the aperture of `lens`, to a scene with a camera; return added objects' motion."""
    if name == "dim":
        light_by_bulbs(rng)
        return []
    if name == "volume":
        add_volume(rng, shot)
        return []
    motions = []
    surfaces = SURFACES[name]
    shapes = {"turned": 4, "sphere": 1, "torus": 1.5, "monkey": 1.5, "box": 1, "cage": 1, "blob": 1, "text": 0.5}
    if name == "hair":
        shapes = {"sphere": 2.0, "monkey": 1.0, "blob": 1.0}
    for _ in range(int(rng.integers(2, 5))):
        surface = surfaces[int(rng.integers(len(surfaces)))]
        item = add_floating(rng, shot, surface, weighted_choice(rng, shapes))
        if name == "hair":
            add_random_fur(rng, item)
        if rng.random() < 0.75:
            motions.append(move_object(rng, shot, item, "turn" if name == "metal" else None))
    return motions


def add_random_fur(rng: assets.Rng, item: Any) -> None:
    """Cover an object with hair of random color, length and curl."""
    if rng.random() < 0.7:
        coat = assets.hair_material(float(rng.uniform(0.05, 0.95)), float(rng.uniform(0, 1)), rng.uniform(0.15, 0.5))
    else:
        coat = material(rng, "diffuse")
    lean, length = [*rng.normal(0, 0.3, 2), rng.normal(-0.4, 0.3)], log_uniform(rng, 0.06, 0.35)
    strands, radius = int(log_uniform(rng, 3000, 16000)), log_uniform(rng, 0.0012, 0.005)
    wave, clumps, clump = rng.uniform(0, 0.6), int(log_uniform(rng, 40, 400)), rng.uniform(0, 0.8)
    assets.fur(rng, item, assets.Hair(strands, length, radius, lean, wave, clumps, clump), coat)


def add_volume(rng: assets.Rng, shot: ShotSettings) -> None:
    """Fill the scene with fog or smoke, and add a spot light's beam from the side that crosses the view."""
    scene = bpy.context.scene
    points = visible_points(scene)
    eye = scene.camera.matrix_world.translation
    focus = points[int(rng.integers(len(points)))][0] if points else Vector((0, 0, 0.5))
    distance = (focus - eye).length
    density = log_uniform(rng, 0.15, 1.0) / distance  # the optical depth up to the focus
    if rng.random() < 0.5:
        assets.fill_with_fog(*FOG_BOX, density, rng.uniform(0, 0.7))
    else:
        scale = log_uniform(rng, 1, 5) / distance
        assets.fill_with_smoke(shot.keyed, *FOG_BOX, (0.2 * density, 2 * density), scale, rng.uniform(0, 0.7))
    aim = eye.lerp(focus, float(rng.uniform(0.5, 1)))
    side = Vector(scene.camera.matrix_world.to_3x3().col[0]) * float(rng.choice([-1, 1]) * rng.uniform(0.4, 1))
    source = aim + distance * (side + Vector((0, 0, rng.uniform(0.2, 0.9))))
    beam = assets.add_lamp(
        "SPOT", source, 400 * distance**2 * log_uniform(rng, 0.3, 3), 0.02 * distance, aim, warm(rng)
    )
    beam.data.spot_size, beam.data.spot_blend = float(rng.uniform(0.12, 0.6)), float(rng.uniform(0, 0.4))


def light_by_bulbs(rng: assets.Rng) -> None:
    """Replace all lights of a scene by small bulbs, some of them visible."""
    scene = bpy.context.scene
    for item in [item for item in scene.objects if item.type == "LIGHT"]:
        bpy.data.objects.remove(item)
    set_world(rng, "none", 0)
    eye = scene.camera.matrix_world.translation
    points = [position for position, _ in visible_points(scene)] or [Vector((0, 0, 0.5))]
    distance = float(np.median([(position - eye).length for position in points]))
    shades = [material(rng, "emission") for _ in range(3)]
    for shade in shades:
        set_emission(shade, (*warm(rng), 1), log_uniform(rng, 50, 500))
    for number in range(int(log_uniform(rng, 5, 40))):
        # In front of a visible point, spread by an eighth of the distance.
        behind = points[int(rng.integers(len(points)))]
        where = eye.lerp(behind, float(rng.uniform(0.6, 0.95))) + Vector(rng.normal(0, 0.12 * distance, 3))
        where.z = max(where.z, 0.03)
        radius = distance * log_uniform(rng, 0.002, 0.01)
        if number % 2:
            assets.add_lamp("POINT", where, log_uniform(rng, 1, 12) * distance**2, radius, eye, warm(rng))
        else:
            add_bulb_sphere(radius, where, shades[number // 2 % 3])


def file_shot(shot: ShotSettings) -> dict[str, Any]:
    """Open a .blend file, choose its camera and crop, and add motion where it has none; return its description."""
    bpy.ops.wm.open_mainfile(filepath=str(Path(shot.scene).resolve()))
    scene = bpy.context.scene
    rng = np.random.default_rng([shot.seed, 0])
    cameras = sorted(item.name for item in scene.objects if item.type == "CAMERA")
    if shot.camera is not None and shot.camera not in cameras and shot.camera != "random":
        raise ValueError(f"camera: got {shot.camera!r}, expected one of {', '.join(cameras)} or random")
    if shot.camera is not None:
        scene.camera = scene.objects[str(rng.choice(cameras)) if shot.camera == "random" else shot.camera]
    if scene.camera is None:
        raise ValueError(f"scene: {shot.scene} has no camera")
    scene.frame_set(shot.middle)
    film = shot.film or shot.size
    center = frame_crop(rng, shot, film)
    description: dict[str, Any] = {
        "camera_name": scene.camera.name, "film": list(film), "center": [round(c, 4) for c in center],
        "credit": {key: scene[key] for key in CREDIT if key in scene},
    }  # fmt: skip
    animated = any(item.animation_data is not None and item.animation_data.action for item in scene.objects)
    if shot.motion == "add" or (shot.motion == "auto" and not animated):
        description |= add_motion(rng, shot, own_objects=False)
    return description


def rejection(passes: dict[str, np.ndarray]) -> str | None:
    """Return why the pilot of a random shot is not worth rendering, or None if it is."""
    radiance = _mean_radiance(passes)
    guides = np.concatenate([passes["Denoising Albedo"], passes["Denoising Normal"]], axis=-1).astype(np.float32)
    if (radiance <= 1e-3 * radiance.mean()).mean() > 0.4:
        return "most of it is black"
    if (passes["Depth"] > 1e9).mean() > 0.6:
        return "most of it is sky"
    if np.linalg.norm(guides.std(axis=(0, 1))) < 0.12:
        return "it shows next to nothing"
    if np.quantile(radiance, 0.98) > 300 * np.quantile(radiance, 0.3):
        return "one light drowns everything else"
    return None


def exposure(shot: ShotSettings, passes: dict[str, np.ndarray]) -> float:
    """Return a factor that puts a pilot's geometric mean some stops (σ 1.1, at most 2.5) around middle grey."""
    rng = np.random.default_rng([shot.seed, 99])
    radiance = _mean_radiance(passes)
    # Blocks, because single pixels of a few samples are black or very bright by chance.
    h, w = (n // 4 * 4 for n in radiance.shape)
    blocks = radiance[:h, :w].reshape(h // 4, 4, w // 4, 4).mean(axis=(1, 3)) if h and w else radiance
    middle = float(np.exp(np.log(blocks + 1e-3 * blocks.mean()).mean()))
    return 0.18 / middle * 2 ** float(np.clip(rng.normal(0, 1.1), -2.5, 2.5))


def _mean_radiance(passes: dict[str, np.ndarray]) -> np.ndarray:
    """Return the mean of red, green and blue of a pilot, (H, W)."""
    return np.asarray(np.nan_to_num(passes["Combined"][..., :3].astype(np.float32)).mean(axis=-1))
