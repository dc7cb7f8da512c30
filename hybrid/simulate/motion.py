"""Cameras and motion: where the camera stands, what it crops, and how it, things and lights move.

Speeds are drawn in pixels of the film per frame, and turned into keys by measuring what the camera sees.
"""

from __future__ import annotations

import math
from collections.abc import Callable, Sequence
from typing import Any

import bpy
import numpy as np
from mathutils import Euler, Matrix, Quaternion, Vector

from hybrid.simulate.effects import film_pixel, visible_points
from hybrid.simulate.shot import ShotSettings
from hybrid.simulate.things import Rng, add_lamp, add_object, add_thing, choose, log_uniform, material, warm

MARGIN = 4  # frames keyed before and after the shot, so that vectors are valid on its first and last frame


def set_crop(render: Any, film: tuple[int, int], size: tuple[int, int], center: tuple[float, float]) -> None:
    """Render only `size` pixels of a `film`-sized camera, around `center`, fractions with y down.

    Parameters
    ----------
    render : bpy.types.RenderSettings
        Of the scene.
    film : (int, int)
        Pixels of the whole picture, across and down.
    size : (int, int)
        Pixels that are rendered, across and down.
    center : (float, float)
        Where in the film, as fractions, y down.
    """
    (film_w, film_h), (w, h) = film, size
    left = min(max(round(center[0] * film_w - w / 2), 0), film_w - w)
    top = min(max(round(center[1] * film_h - h / 2), 0), film_h - h)
    render.resolution_x, render.resolution_y, render.resolution_percentage = film_w, film_h, 100
    render.pixel_aspect_x = render.pixel_aspect_y = 1
    render.use_border = render.use_crop_to_border = film != size
    # Blender holds borders as 32-bit floats and rounds down: without the quarter of a pixel, now and then one less.
    bottom = film_h - top - h
    render.border_min_x, render.border_max_x = (left + 0.25) / film_w, min((left + w + 0.25) / film_w, 1)
    render.border_min_y, render.border_max_y = (bottom + 0.25) / film_h, min((bottom + h + 0.25) / film_h, 1)


def aim_crop(rng: Rng, shot: ShotSettings, film: tuple[int, int]) -> tuple[float, float]:
    """Choose where in the film to crop: of twenty places, the one that shows most things.

    Parameters
    ----------
    rng : numpy.random.Generator
        Where all chance comes from.
    shot : ShotSettings
        What is asked for.
    film : (int, int)
        Pixels of the whole picture, across and down.

    Returns
    -------
    (float, float)
        Its centre, as fractions, y down.
    """
    scene = bpy.context.scene
    best, best_score = (0.5, 0.5), -1.0
    for _ in range(20):
        center = (float(rng.uniform(0.2, 0.8)), float(rng.uniform(0.25, 0.75)))
        set_crop(scene.render, film, shot.size, center)
        points = visible_points(scene, 8, 5)
        score = len(points) / 40 + 0.4 * len({item.name for _, item in points}) + rng.uniform(0, 0.8)
        if score > best_score:
            best, best_score = center, score
    set_crop(scene.render, film, shot.size, best)
    return best


def place_camera(rng: Rng, focus: Vector, eye: Vector) -> Any:
    """Add a camera at `eye` that looks at `focus`; nearer, if something is right in front of the lens.

    Parameters
    ----------
    rng : numpy.random.Generator
        Where all chance comes from.
    focus : Vector
        What it looks at.
    eye : Vector
        Where it stands.

    Returns
    -------
    bpy.types.Object
    """
    scene = bpy.context.scene
    data = bpy.data.cameras.new("camera")
    data.lens, data.sensor_width, data.clip_start = log_uniform(rng, 18, 65), 36, 0.005
    camera = add_object("camera", data, None)
    scene.camera = camera
    bpy.context.view_layer.update()
    graph = bpy.context.evaluated_depsgraph_get()
    for _ in range(6):
        toward = focus - eye
        hit, position, *_ = scene.ray_cast(graph, eye, toward.normalized())
        if not hit or (position - eye).length > 0.35 * toward.length:
            break
        eye = position + 0.05 * toward
    camera.location = eye
    roll = Quaternion((0, 0, 1), float(rng.normal(0, 0.02)))
    camera.rotation_euler = ((focus - eye).to_track_quat("-Z", "Y") @ roll).to_euler()
    bpy.context.view_layer.update()
    return camera


Pose = tuple[Vector, Euler, float]  # shift in camera space, in units of the distance; turn; zoom (logarithm)


def camera_path(rng: Rng, kind: str) -> Callable[[float], Pose]:
    """Return a camera's pose after `step` frames, at unit speed: some hundredths of a radian a frame.

    Parameters
    ----------
    rng : numpy.random.Generator
        Where all chance comes from.
    kind : str
        Of the motion.

    Returns
    -------
    callable
        From a number of frames to the pose.
    """
    direction = rng.normal(0, 1, 3)
    direction /= np.linalg.norm(direction)
    phase, rate = rng.uniform(0, 2 * np.pi, (5, 3)), rng.uniform(0.3, 1.6, (5, 3))
    sign = float(rng.choice([-1, 1]))

    def path(step: float) -> Pose:
        zero, still = Vector((0, 0, 0)), Euler((0, 0, 0))
        if kind == "pan":
            return zero, Euler((0.01 * step * direction[0] * 0.5, 0.01 * step * sign, 0)), 0.0
        if kind == "dolly":
            return Vector(0.01 * step * direction * (1, 0.5, 1.5)), still, 0.0
        if kind == "orbit":
            angle = 0.01 * step * sign
            return Vector((math.sin(angle), 0, math.cos(angle) - 1)), Euler((0, angle, 0)), 0.0
        if kind == "handheld":
            shake = (np.sin(rate * step + phase) - np.sin(phase)).sum(axis=0)
            return Vector(0.002 * shake), Euler(0.006 * np.array([shake[1], shake[2], 0.3 * shake[0]])), 0.0
        if kind == "roll":
            return zero, Euler((0, 0, 0.01 * step * sign)), 0.0
        return zero, still, 0.01 * step * sign  # zoom

    return path


CAMERA_MOVES = {"pan": 3.0, "dolly": 3.0, "orbit": 2.0, "handheld": 2.0, "zoom": 0.8, "roll": 0.4}


def move_camera(rng: Rng, shot: ShotSettings, kind: str, pixels: float) -> float:
    """Key a camera path whose median motion in the rendered region is `pixels` a frame; return what it came to.

    The speed is bounded, so where what is seen is very near or far the motion may come out lower.

    Parameters
    ----------
    rng : numpy.random.Generator
        Where all chance comes from.
    shot : ShotSettings
        What is asked for.
    kind : str
        Of the motion.
    pixels : float
        Median motion that is asked for, a frame.

    Returns
    -------
    float
        What it came to.
    """
    scene = bpy.context.scene
    camera, middle = scene.camera, shot.frames[len(shot.frames) // 2]
    points = [position for position, _ in visible_points(scene)]
    origin, lens = camera.matrix_world.copy(), camera.data.lens
    eye = origin.translation
    distance = float(np.median([(p - eye).length for p in points])) if points else 5.0
    path = camera_path(rng, kind)

    def pose(step: float, speed: float) -> None:
        shift, turn, zoom = path(step * speed) if kind != "handheld" else path(step)
        if kind == "handheld":
            shift, turn = shift * speed, Euler([angle * speed for angle in turn])
        camera.matrix_world = origin @ Matrix.Translation(shift * distance) @ turn.to_matrix().to_4x4()
        camera.data.lens = lens * math.exp(zoom)

    def motion(speed: float) -> float:
        before = [film_pixel(scene, p) for p in points]
        pose(1, speed)
        bpy.context.view_layer.update()
        after = [film_pixel(scene, p) for p in points]
        pose(0, speed)
        bpy.context.view_layer.update()
        return float(np.nanmedian(np.linalg.norm(np.array(after) - np.array(before), axis=1)))

    camera.animation_data_clear()
    camera.data.animation_data_clear()
    speed = 1.0
    if points:
        for _ in range(3):
            speed *= float(np.clip(pixels / max(motion(speed), 1e-3), 0.02, 50))
            speed = min(speed, 8.0)  # 0.08 radian, or of the distance, a frame: a whip
    result = motion(speed) if points else 0.0
    camera.rotation_mode = "QUATERNION"
    for frame in range(shot.frames[0] - MARGIN, shot.frames[-1] + MARGIN + 1):
        pose(frame - middle, speed)
        camera.keyframe_insert("location", frame=frame)
        camera.keyframe_insert("rotation_quaternion", frame=frame)
        camera.data.keyframe_insert("lens", frame=frame)
    scene.frame_set(middle)
    return result


def screen_axes(scene: Any, position: Vector) -> tuple[Vector, Vector]:
    """Return the world vectors that move a point one film pixel to the right, and one down.

    Parameters
    ----------
    scene : bpy.types.Scene
        Blender's scene.
    position : Vector
        Of the point, in metres.

    Returns
    -------
    (Vector, Vector)
    """
    camera = scene.camera
    right, up, back = (Vector(camera.matrix_world.to_3x3().col[k]) for k in range(3))
    depth = -(position - camera.matrix_world.translation).dot(back)
    width = max(depth, 1e-6) * camera.data.sensor_width / camera.data.lens
    pixel = width / max(scene.render.resolution_x, scene.render.resolution_y)
    return right * pixel, -up * pixel


def spawn(rng: Rng, shot: ShotSettings, surface: str | None = None, kind: str | None = None) -> Any:
    """Add a thing that floats in the rendered region, between the camera and what lies behind.

    Parameters
    ----------
    rng : numpy.random.Generator
        Where all chance comes from.
    shot : ShotSettings
        What is asked for.
    surface : str, optional
        Kind of its material; drawn without.
    kind : str, optional
        Of the thing; drawn without.

    Returns
    -------
    bpy.types.Object
    """
    scene = bpy.context.scene
    points = visible_points(scene)
    eye = scene.camera.matrix_world.translation
    forward = -Vector(scene.camera.matrix_world.to_3x3().col[2])
    behind = points[int(rng.integers(len(points)))][0] if points else eye + 5 * forward
    position = eye + float(rng.uniform(0.45, 0.85)) * (behind - eye)
    across, _ = screen_axes(scene, position)
    item = add_thing(rng, material(rng, surface), "box" if surface == "mirror" else kind)
    size = across.length * shot.size[1] * log_uniform(rng, 0.2, 0.7)
    item.scale = (size, 0.05 * size, size) if surface == "mirror" else (size, size, size)
    item.location = position
    item.rotation_euler = rng.uniform(-math.pi, math.pi, 3) if surface != "mirror" else scene.camera.rotation_euler
    return item


def move_object(rng: Rng, shot: ShotSettings, item: Any, kind: str | None = None) -> dict[str, Any]:
    """Key an object's motion: along a line, swinging, turning, deforming; a few pixels a frame, at most 40.

    Parameters
    ----------
    rng : numpy.random.Generator
        Where all chance comes from.
    shot : ShotSettings
        What is asked for.
    item : bpy.types.Object
        What is meant.
    kind : str, optional
        Of the motion; drawn without.

    Returns
    -------
    dict
        What the motion is.
    """
    scene = bpy.context.scene
    middle = shot.frames[len(shot.frames) // 2]
    pixels = log_uniform(rng, 1, 20) if rng.random() < 0.85 else log_uniform(rng, 10, 40)
    kind = kind or choose(rng, {"line": 4, "swing": 1.5, "turn": 2.5, "deform": 1.5 if item.type == "MESH" else 0})
    right, down = screen_axes(scene, item.matrix_world.translation)
    angle = rng.uniform(0, 2 * math.pi)
    toward = Vector(scene.camera.matrix_world.to_3x3().col[2]) * right.length * float(rng.normal(0, 0.7))
    velocity = (right * math.cos(angle) + down * math.sin(angle) * 0.6 + toward) * pixels
    if kind in ("turn", "deform"):
        velocity = velocity * float(rng.uniform(0, 0.3))
    rate = rng.uniform(0.3, 0.9)
    half = max(right.length * 4, max(item.dimensions) / 2)
    spin = rng.normal(0, 1, 3)
    spin *= (min(pixels * right.length / half, 0.35) if kind == "turn" else 0.02) / np.linalg.norm(spin)
    start, turn = item.location.copy(), item.rotation_euler.copy()
    key = None
    if kind == "deform":
        if item.data.users > 1:
            item.data = item.data.copy()
        item.shape_key_add(name="basis")
        key = item.shape_key_add(name="bent")
        wave, push = rng.normal(0, 5, 3), rng.normal(0, 1, 3)
        amplitude = 0.25 / np.linalg.norm(push)
        extent = max(max(abs(c) for c in corner) for corner in item.bound_box) or 1.0
        for point, base in zip(key.data, item.data.vertices, strict=True):
            co = np.array(base.co) / extent
            point.co = tuple((co + amplitude * push * math.sin(float(co @ wave))) * extent)
        key.slider_min = -1
    item.rotation_mode = "XYZ"
    for frame in range(shot.frames[0] - MARGIN, shot.frames[-1] + MARGIN + 1):
        step = frame - middle
        travelled = math.sin(rate * step) / rate if kind == "swing" else step
        item.location = start + velocity * travelled
        item.rotation_euler = [a + s * step for a, s in zip(turn, spin, strict=True)]
        item.keyframe_insert("location", frame=frame)
        item.keyframe_insert("rotation_euler", frame=frame)
        if key is not None:
            key.value = math.sin(rate * step)
            key.keyframe_insert("value", frame=frame)
    scene.frame_set(middle)
    return {"object": item.name, "motion": kind, "pixels": round(pixels, 2)}


def move_light(rng: Rng, shot: ShotSettings) -> dict[str, Any]:
    """Key the motion of a lamp, of the sky, or of a lamp's power; a lamp is added where there is no light to move.

    Parameters
    ----------
    rng : numpy.random.Generator
        Where all chance comes from.
    shot : ShotSettings
        What is asked for.

    Returns
    -------
    dict
        What the motion is.
    """
    scene = bpy.context.scene
    first, last = shot.frames[0] - MARGIN, shot.frames[-1] + MARGIN
    middle = shot.frames[len(shot.frames) // 2]
    lamps = [item for item in scene.objects if item.type == "LIGHT"]
    mapping = next(
        (node for node in (scene.world.node_tree.nodes if scene.world else ()) if node.type == "MAPPING"),
        None,
    )
    if mapping is not None and (not lamps or rng.random() < 0.3):
        turn, speed = (
            mapping.inputs["Rotation"].default_value[2],
            float(rng.choice([-1, 1]) * log_uniform(rng, 0.01, 0.2)),
        )
        for frame in range(first, last + 1):
            mapping.inputs["Rotation"].default_value[2] = turn + speed * (frame - middle)
            mapping.inputs["Rotation"].keyframe_insert("default_value", index=2, frame=frame)
        return {"light": "world", "radians": round(speed, 3)}
    points = visible_points(scene)
    focus = points[len(points) // 2][0] if points else Vector((0, 0, 0))
    if not lamps:
        eye = scene.camera.matrix_world.translation
        position = eye.lerp(focus, 0.5) + Vector((0, 0, 0.3 * (focus - eye).length))
        power = 20 * (focus - eye).length ** 2
        lamps = [add_lamp("POINT", position, power, 0.02 * (focus - eye).length, focus, warm(rng))]
    lamp = min(lamps, key=lambda item: (item.location - focus).length)
    start, turn, power = lamp.location.copy(), lamp.rotation_euler.copy(), lamp.data.energy
    flicker = rng.random() < 0.25
    direction = Vector(rng.normal(0, 1, 3)).normalized()
    speed = log_uniform(rng, 0.01, 0.08)
    for frame in range(first, last + 1):
        step = frame - middle
        if flicker:
            lamp.data.energy = power * float(1 + 0.5 * math.sin(1.3 * step))
            lamp.data.keyframe_insert("energy", frame=frame)
        elif lamp.data.type == "SUN":
            lamp.rotation_euler = (turn.x + speed * step * 0.5, turn.y, turn.z + speed * step)
            lamp.keyframe_insert("rotation_euler", frame=frame)
        else:
            lamp.location = start + direction * speed * step * (start - focus).length
            lamp.keyframe_insert("location", frame=frame)
    scene.frame_set(middle)
    return {"light": lamp.name, "motion": "flicker" if flicker else "moves", "speed": round(speed, 3)}


def add_motion(rng: Rng, shot: ShotSettings, own_things: bool) -> dict[str, Any]:
    """Set a shot in motion: draw what moves, and key it.

    Parameters
    ----------
    rng : numpy.random.Generator
        Where all chance comes from.
    shot : ShotSettings
        What is asked for.
    own_things : bool
        Whether things that float may be added.

    Returns
    -------
    dict
        What moves, and how.
    """
    scene = bpy.context.scene
    kind = choose(rng, {"usual": 0.76, "still": 0.07, "light": 0.1, "mirror": 0.07})
    found: dict[str, Any] = {"motion": kind, "camera": "still", "movers": [], "lights": []}
    movers = shot.movers if shot.movers is not None else int(rng.choice([0, 1, 2, 3], p=[0.25, 0.35, 0.25, 0.15]))
    if kind == "mirror":
        found["movers"].append(move_object(rng, shot, spawn(rng, shot, "mirror")))
    elif kind == "usual" or shot.movers:
        seen = {item.original for _, item in visible_points(scene) if item.original.get("mobile") and own_things}
        candidates = sorted(seen, key=lambda item: str(item.name))
        for _ in range(movers):
            item = None
            if candidates and rng.random() < 0.5:
                item = candidates.pop(int(rng.integers(len(candidates))))
            found["movers"].append(move_object(rng, shot, item or spawn(rng, shot)))
    if kind == "light" or (kind == "usual" and rng.random() < 0.08):
        found["lights"].append(move_light(rng, shot))
    if kind in ("usual", "mirror") and (rng.random() < 0.8 or not found["movers"]):
        found["camera"] = choose(rng, CAMERA_MOVES)
        small = shot.size[0] == scene.render.resolution_x
        pixels = log_uniform(rng, 1, 12 if small else 25)
        found["camera_pixels"] = round(move_camera(rng, shot, found["camera"], pixels), 2)
    return found


def look(eye: Sequence[float], focus: Sequence[float], lens: float) -> Any:
    """Stand the camera at `eye`, looking at `focus`.

    Parameters
    ----------
    eye : sequence of float
        Where it stands, in metres.
    focus : sequence of float
        What it looks at.
    lens : float
        Focal length in millimetres.

    Returns
    -------
    bpy.types.Object
        The camera.
    """
    camera = bpy.context.scene.camera
    camera.data.lens, camera.location = lens, eye
    camera.rotation_euler = (Vector(focus) - Vector(eye)).to_track_quat("-Z", "Y").to_euler()
    return camera


def move(item: Any, frames: range, velocity: Sequence[float] = (0, 0, 0), spin: Sequence[float] = (0, 0, 0)) -> None:
    """Key steady motion, in metres and radians per frame; where the item stands now is where it is in the middle.

    Parameters
    ----------
    item : bpy.types.Object
        What is meant.
    frames : range
        Of the shot.
    velocity : sequence of float
        Metres per frame along x, y and z.
    spin : sequence of float
        Radians per frame around x, y and z.
    """
    place, turn, middle = Vector(item.location), Vector(item.rotation_euler), frames[len(frames) // 2]
    for frame in frames:
        item.location = place + Vector(velocity) * (frame - middle)
        item.rotation_euler = turn + Vector(spin) * (frame - middle)
        item.keyframe_insert("location", frame=frame)
        item.keyframe_insert("rotation_euler", frame=frame)
