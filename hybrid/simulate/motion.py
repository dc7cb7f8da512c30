"""Cameras and motion, drawn in film pixels per frame and turned into keys by measuring what the camera sees."""

import math
from collections.abc import Callable
from typing import Any

import bpy
import numpy as np
from mathutils import Euler, Matrix, Quaternion, Vector

from hybrid.simulate.effects import film_pixel, visible_points
from hybrid.simulate.random_assets import add_asset, log_uniform, material, warm, weighted_choice
from hybrid.simulate.scene_assets import Rng, add_lamp, add_object
from hybrid.simulate.shot import ShotSettings


def key(owner: Any, name: str, frames: range, middle: int, value: Callable[[int], Any]) -> None:
    """Key a property on each frame; `value` is a function of the frames since `middle`."""
    for frame in frames:
        setattr(owner, name, value(frame - middle))
        owner.keyframe_insert(name, frame=frame)


# Cameras


def set_crop(render: Any, film: tuple[int, int], size: tuple[int, int], center: tuple[float, float]) -> None:
    """Render only `size` pixels of a `film`-sized camera, around `center`, fractions with y down."""
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


def frame_crop(rng: Rng, shot: ShotSettings, film: tuple[int, int]) -> tuple[float, float]:
    """Set the crop that the shot asks for, or else the one of twenty that shows most objects; return its center."""
    scene = bpy.context.scene
    best, best_score = shot.center or (0.5, 0.5), -1.0
    set_crop(scene.render, film, shot.size, best)
    if shot.center is not None or film == shot.size:
        return best
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
    """Add a camera at `eye` aimed at `focus`; nearer, if something is right in front of the lens."""
    scene = bpy.context.scene
    data = bpy.data.cameras.new("camera")
    data.lens, data.sensor_width, data.clip_start = log_uniform(rng, 18, 65), 36, 0.005
    camera = add_object("camera", data)
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


def camera_path(rng: Rng, kind: str) -> Callable[[float, float], Pose]:
    """Return a function of frames since the middle and speed; at speed 1 some hundredths of a radian per frame."""
    direction = rng.normal(0, 1, 3)
    direction /= np.linalg.norm(direction)
    phase, rate = rng.uniform(0, 2 * np.pi, (5, 3)), rng.uniform(0.3, 1.6, (5, 3))
    sign = float(rng.choice([-1, 1]))

    def path(frames: float, speed: float) -> Pose:
        zero, still, step = Vector((0, 0, 0)), Euler((0, 0, 0)), frames * speed
        if kind == "pan":
            return zero, Euler((0.01 * step * direction[0] * 0.5, 0.01 * step * sign, 0)), 0.0
        if kind == "dolly":
            return Vector(0.01 * step * direction * (1, 0.5, 1.5)), still, 0.0
        if kind == "orbit":
            angle = 0.01 * step * sign
            return Vector((math.sin(angle), 0, math.cos(angle) - 1)), Euler((0, angle, 0)), 0.0
        if kind == "handheld":  # the speed sets how far the camera shakes, not how often
            shake = (np.sin(rate * frames + phase) - np.sin(phase)).sum(axis=0)
            turn = Euler(0.006 * np.array([shake[1], shake[2], 0.3 * shake[0]]))
            return Vector(0.002 * shake) * speed, Euler([angle * speed for angle in turn]), 0.0
        if kind == "roll":
            return zero, Euler((0, 0, 0.01 * step * sign)), 0.0
        return zero, still, 0.01 * step * sign  # zoom

    return path


def move_camera(rng: Rng, shot: ShotSettings, kind: str, pixels: float) -> float:
    """Key a camera path with a median motion of `pixels` a frame in the crop, if a bounded speed allows; return it."""
    scene = bpy.context.scene
    camera = scene.camera
    points = [position for position, _ in visible_points(scene)]
    origin, lens = camera.matrix_world.copy(), camera.data.lens
    distance = float(np.median([(p - origin.translation).length for p in points])) if points else 5.0
    path = camera_path(rng, kind)

    def pose(step: float, speed: float) -> None:
        shift, turn, zoom = path(step, speed)
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
    for frame in shot.keyed:
        pose(frame - shot.middle, speed)
        camera.keyframe_insert("location", frame=frame)
        camera.keyframe_insert("rotation_quaternion", frame=frame)
        camera.data.keyframe_insert("lens", frame=frame)
    scene.frame_set(shot.middle)
    return result


# Objects


def screen_axes(scene: Any, position: Vector) -> tuple[Vector, Vector]:
    """Return the world vectors that move a point one film pixel to the right, and one down."""
    camera = scene.camera
    right, up, back = (Vector(camera.matrix_world.to_3x3().col[k]) for k in range(3))
    depth = -(position - camera.matrix_world.translation).dot(back)
    width = max(depth, 1e-6) * camera.data.sensor_width / camera.data.lens
    pixel = width / max(scene.render.resolution_x, scene.render.resolution_y)
    return right * pixel, -up * pixel


def add_floating(rng: Rng, shot: ShotSettings, surface: str | None = None, kind: str | None = None) -> Any:
    """Add a random object that floats in the crop, between the camera and what lies behind."""
    scene = bpy.context.scene
    points = visible_points(scene)
    eye = scene.camera.matrix_world.translation
    forward = -Vector(scene.camera.matrix_world.to_3x3().col[2])
    behind = points[int(rng.integers(len(points)))][0] if points else eye + 5 * forward
    position = eye + float(rng.uniform(0.45, 0.85)) * (behind - eye)
    across, _ = screen_axes(scene, position)
    item = add_asset(rng, material(rng, surface), "box" if surface == "mirror" else kind)
    size = across.length * shot.size[1] * log_uniform(rng, 0.2, 0.7)
    item.scale = (size, 0.05 * size, size) if surface == "mirror" else (size, size, size)
    item.location = position
    item.rotation_euler = rng.uniform(-math.pi, math.pi, 3) if surface != "mirror" else scene.camera.rotation_euler
    return item


def add_bend(rng: Rng, item: Any) -> Any:
    """Add a shape key to a mesh object that displaces it by a wave; return the key, of values from -1 to 1."""
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
    return key


def move_object(rng: Rng, shot: ShotSettings, item: Any, kind: str | None = None) -> dict[str, Any]:
    """Key a motion (line, swing, turn, deform; else drawn) of at most 40 pixels a frame; return its description."""
    scene = bpy.context.scene
    pixels = log_uniform(rng, 1, 20) if rng.random() < 0.85 else log_uniform(rng, 10, 40)
    deform = 1.5 if item.type == "MESH" else 0
    kind = kind or weighted_choice(rng, {"line": 4, "swing": 1.5, "turn": 2.5, "deform": deform})
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
    bend = add_bend(rng, item) if kind == "deform" else None
    item.rotation_mode = "XYZ"
    swing = kind == "swing"
    span = (shot.keyed, shot.middle)
    key(item, "location", *span, lambda t: start + velocity * (math.sin(rate * t) / rate if swing else t))
    key(item, "rotation_euler", *span, lambda t: [a + s * t for a, s in zip(turn, spin, strict=True)])
    if bend is not None:
        key(bend, "value", *span, lambda t: math.sin(rate * t))
    scene.frame_set(shot.middle)
    return {"object": item.name, "motion": kind, "pixels": round(pixels, 2)}


# Lights, and all of it


def turn_world(rng: Rng, shot: ShotSettings, mapping: Any) -> dict[str, Any]:
    """Key the rotation of the world's texture around z; return the description of the motion."""
    rotation = mapping.inputs["Rotation"]
    turn, speed = rotation.default_value[2], float(rng.choice([-1, 1]) * log_uniform(rng, 0.01, 0.2))
    for frame in shot.keyed:
        rotation.default_value[2] = turn + speed * (frame - shot.middle)
        rotation.keyframe_insert("default_value", index=2, frame=frame)
    return {"light": "world", "radians": round(speed, 3)}


def move_light(rng: Rng, shot: ShotSettings) -> dict[str, Any]:
    """Key the motion of a lamp, of the sky, or of a lamp's power; add a lamp if nothing gives light."""
    scene = bpy.context.scene
    lamps = [item for item in scene.objects if item.type == "LIGHT"]
    nodes = scene.world.node_tree.nodes if scene.world else ()
    mapping = next((found for found in nodes if found.type == "MAPPING"), None)
    if mapping is not None and (not lamps or rng.random() < 0.3):
        return turn_world(rng, shot, mapping)
    points = visible_points(scene)
    focus = points[len(points) // 2][0] if points else Vector((0, 0, 0))
    if not lamps:
        eye = scene.camera.matrix_world.translation
        distance = (focus - eye).length
        position = eye.lerp(focus, 0.5) + Vector((0, 0, 0.3 * distance))
        lamps = [add_lamp("POINT", position, 20 * distance**2, 0.02 * distance, focus, warm(rng))]
    lamp = min(lamps, key=lambda item: (item.location - focus).length)
    start, turn, power = lamp.location.copy(), lamp.rotation_euler.copy(), lamp.data.energy
    flicker = rng.random() < 0.25
    direction = Vector(rng.normal(0, 1, 3)).normalized()
    speed = log_uniform(rng, 0.01, 0.08)
    span = (shot.keyed, shot.middle)
    if flicker:
        key(lamp.data, "energy", *span, lambda t: power * float(1 + 0.5 * math.sin(1.3 * t)))
    elif lamp.data.type == "SUN":
        key(lamp, "rotation_euler", *span, lambda t: (turn.x + speed * t * 0.5, turn.y, turn.z + speed * t))
    else:
        key(lamp, "location", *span, lambda t: start + direction * speed * t * (start - focus).length)
    scene.frame_set(shot.middle)
    return {"light": lamp.name, "motion": "flicker" if flicker else "moves", "speed": round(speed, 3)}


def add_motion(rng: Rng, shot: ShotSettings, own_objects: bool) -> dict[str, Any]:
    """Draw and key what moves in a shot; `own_objects` allows objects of the scene. Return its description."""
    scene = bpy.context.scene
    kind = weighted_choice(rng, {"usual": 0.76, "still": 0.07, "light": 0.1, "mirror": 0.07})
    found: dict[str, Any] = {"motion": kind, "camera": "still", "moving_objects": [], "lights": []}
    drawn = shot.moving_objects is None
    count = int(rng.choice([0, 1, 2, 3], p=[0.25, 0.35, 0.25, 0.15])) if drawn else shot.moving_objects
    if kind == "mirror":
        found["moving_objects"].append(move_object(rng, shot, add_floating(rng, shot, "mirror")))
    elif kind == "usual" or shot.moving_objects:
        seen = {item.original for _, item in visible_points(scene) if item.original.get("mobile") and own_objects}
        candidates = sorted(seen, key=lambda item: str(item.name))
        for _ in range(count or 0):
            item = None
            if candidates and rng.random() < 0.5:
                item = candidates.pop(int(rng.integers(len(candidates))))
            found["moving_objects"].append(move_object(rng, shot, item or add_floating(rng, shot)))
    if kind == "light" or (kind == "usual" and rng.random() < 0.08):
        found["lights"].append(move_light(rng, shot))
    if kind in ("usual", "mirror") and (rng.random() < 0.8 or not found["moving_objects"]):
        moves = {"pan": 3.0, "dolly": 3.0, "orbit": 2.0, "handheld": 2.0, "zoom": 0.8, "roll": 0.4}
        found["camera"] = weighted_choice(rng, moves)
        small = shot.size[0] == scene.render.resolution_x
        pixels = log_uniform(rng, 1, 12 if small else 25)
        found["camera_pixels"] = round(move_camera(rng, shot, found["camera"], pixels), 2)
    return found
