"""Random materials, objects and worlds. All random numbers come from the generator that is passed in.

Lengths are metres, z is up. Brightness is only relative: the exposure of a shot is chosen when it is planned.
"""

import math
from collections.abc import Callable
from typing import Any

import bpy
import numpy as np
from mathutils import Vector

from hybrid.simulate import scene_assets as assets

# Blender's other two environment images, courtyard and night, light the scenes to judge on in examples/scenes.
SKIES = ("city", "forest", "interior", "studio", "sunrise", "sunset")


def weighted_choice(rng: assets.Rng, weights: dict[str, float]) -> str:
    """Draw a key with probability proportional to its value."""
    values = np.array(list(weights.values()))
    return str(rng.choice(list(weights), p=values / values.sum()))


def log_uniform(rng: assets.Rng, low: float, high: float) -> float:
    """Draw from [low, high], uniformly in the logarithm."""
    return float(np.exp(rng.uniform(math.log(low), math.log(high))))


def color(rng: assets.Rng, brightness: float | None = None) -> tuple[float, float, float, float]:
    """Draw a linear, mostly muted RGBA color; its largest component is `brightness`, by default 0.04 to 0.85."""
    hue, saturation = rng.random(), rng.beta(1.2, 2.6)
    rgb = np.clip(np.abs((hue * 6 + np.array([0.0, 4.0, 2.0])) % 6 - 3) - 1, 0, 1)
    rgb = (1 - saturation + saturation * rgb) * (log_uniform(rng, 0.04, 0.85) if brightness is None else brightness)
    return (float(rgb[0]), float(rgb[1]), float(rgb[2]), 1.0)


def painted_image(rng: assets.Rng) -> Any:
    """Draw an image texture of 512×512: spectral noise, stripes, plaid, patches or rows of marks like writing."""
    size = 512
    y, x = np.mgrid[:size, :size] / size
    kind = weighted_choice(rng, {"spectral": 3, "stripes": 1, "plaid": 1, "patches": 2, "writing": 2})
    if kind == "spectral":
        frequency = np.hypot(np.fft.fftfreq(size)[:, None], np.fft.rfftfreq(size)[None]) + 1 / size
        spectrum = np.fft.rfft2(rng.standard_normal((size, size))) * frequency ** -rng.uniform(0.6, 2.0)
        field = np.fft.irfft2(spectrum, (size, size))
        field = (field - field.min()) / np.ptp(field)
    elif kind in ("stripes", "plaid"):
        angle, count = rng.uniform(0, np.pi), log_uniform(rng, 4, 90)
        field = (np.sin(2 * np.pi * count * (x * np.cos(angle) + y * np.sin(angle))) > rng.uniform(-0.7, 0.7)) * 0.6
        if kind == "plaid":
            field = field + 0.4 * (np.sin(2 * np.pi * count * rng.uniform(0.3, 1) * (y * np.cos(angle) - x)) > 0)
    elif kind == "patches":
        points, values = rng.random((60, 2)), rng.random(60)
        distance = (x[..., None] - points[:, 0]) ** 2 + (y[..., None] - points[:, 1]) ** 2
        field = values[np.argmin(distance, axis=-1)]
    else:
        rows = int(log_uniform(rng, 6, 40))
        marks = rng.random((rows, rows * 4)) < 0.55
        inside = ((y * rows) % 1 > 0.35) & ((x * rows * 4) % 1 > 0.2)
        field = np.where(inside & marks[(y * rows).astype(int), (x * rows * 4).astype(int)], 0.0, 1.0)
    field = np.clip(field, 0, 1)[..., None]
    dark = np.array(color(rng, log_uniform(rng, 0.05, 0.5)))
    light = np.array(color(rng, rng.uniform(0.3, 0.95)))
    pixels = dark * (1 - field) + light * field
    pixels[..., 3] = 1
    return _new_image("painted", pixels)


def painted_sky(rng: assets.Rng) -> Any:
    """Draw an environment image of 256×128: a gradient over a ground, and some bright windows or blobs."""
    height = 128
    y, x = np.mgrid[:height, : 2 * height] / height
    up = (np.array(color(rng, 0.8))[:3], np.array(color(rng, 0.15))[:3])
    pixels = np.where(y[..., None] > 0.5, up[0] * y[..., None], up[1])
    for _ in range(int(rng.integers(1, 7))):
        cx, cy, radius = rng.uniform(0, 2), rng.uniform(0.52, 0.95), log_uniform(rng, 0.01, 0.15)
        dx = np.minimum(np.abs(x - cx), 2 - np.abs(x - cx))
        soft = rng.random() < 0.5
        inside = np.exp(-(dx**2 + (y - cy) ** 2) / radius**2) if soft else (dx < radius) & (np.abs(y - cy) < radius)
        pixels = pixels + inside[..., None] * np.array(color(rng, 1.0))[:3] * 0.1 / radius**1.5
    return _new_image("sky", np.concatenate([pixels, np.ones_like(pixels[..., :1])], -1), linear=True)


def _new_image(name: str, pixels: np.ndarray, linear: bool = False) -> Any:
    """Make an image of (H, W, 4) pixels; `linear` keeps values above 1."""
    image = bpy.data.images.new(name, pixels.shape[1], pixels.shape[0], float_buffer=linear)
    if linear:
        image.colorspace_settings.name = "Linear Rec.709"
    image.pixels.foreach_set(pixels.astype(np.float32).ravel())
    image.update()
    return image


def texture(rng: assets.Rng, tree: Any, coordinates: Any, scale: float) -> tuple[Any, Any]:
    """Add a texture of `scale` features per unit of the coordinates; return its color and its scalar socket."""
    kinds = {"Noise": 4, "Voronoi": 2, "Wave": 1.5, "Checker": 1, "Brick": 1.5, "Magic": 0.5, "Image": 3}
    kind = weighted_choice(rng, kinds)
    made = assets.node(tree, f"Tex{kind}")
    if kind == "Image":
        made.image, made.projection = painted_image(rng), "BOX"
        turn = (0, 0, rng.uniform(0, 0.3))
        mapping = assets.node(tree, "Mapping", Scale=(min(scale / 4, 4),) * 3, Rotation=turn, Vector=coordinates)
        tree.links.new(mapping.outputs["Vector"], made.inputs["Vector"])
        return made.outputs["Color"], made.outputs["Color"]
    tree.links.new(coordinates, made.inputs["Vector"])
    values: dict[str, Any] = {"Scale": scale}
    if kind == "Noise":
        values |= {"Detail": rng.uniform(0, 10), "Roughness": rng.uniform(0.3, 0.75)}
        values["Distortion"] = rng.choice([0.0, 0.0, rng.uniform(0, 3)])
    elif kind == "Voronoi":
        made.feature = str(rng.choice(["F1", "F2", "DISTANCE_TO_EDGE"]))
    elif kind == "Wave":
        made.wave_type = str(rng.choice(["BANDS", "RINGS"]))
        values |= {"Distortion": rng.uniform(0, 12), "Detail": rng.uniform(0, 6)}
    elif kind in ("Checker", "Brick"):
        names = ("Color1", "Color2", "Mortar") if kind == "Brick" else ("Color1", "Color2")
        values |= {name: color(rng) for name in names}
    for name, value in values.items():
        made.inputs[name].default_value = value
    if kind in ("Checker", "Brick"):
        return made.outputs["Color"], made.outputs[1]
    scalar = made.outputs["Fac"] if "Fac" in made.outputs else made.outputs["Distance"]
    ramp = assets.node(tree, "ValToRGB")
    ramp.color_ramp.interpolation = str(rng.choice(["LINEAR", "CONSTANT", "EASE"]))
    first, last = sorted(rng.uniform(0.1, 0.9, 2))
    ramp.color_ramp.elements[0].position, ramp.color_ramp.elements[1].position = float(first), float(last)
    if rng.random() < 0.6:
        ramp.color_ramp.elements.new(float((first + last) / 2))
    for stop in ramp.color_ramp.elements:
        stop.color = color(rng)
    tree.links.new(scalar, ramp.inputs["Fac"])
    return ramp.outputs["Color"], scalar


SURFACES = {
    "diffuse": 0.28, "plastic": 0.24, "metal": 0.14, "mirror": 0.04, "glass": 0.07, "subsurface": 0.07,
    "coated": 0.08, "velvet": 0.04, "emission": 0.04,
}  # fmt: skip


def _shader_inputs(rng: assets.Rng, surface: str) -> dict[str, Any]:
    """Draw the inputs of the Principled shader that make a kind of surface."""
    if surface == "diffuse":
        return {"Roughness": 1.0, "Specular IOR Level": 0.0}
    if surface == "metal":
        return {"Metallic": 1.0, "Base Color": color(rng, rng.uniform(0.5, 0.95)), "Roughness": rng.beta(1.2, 2.5)}
    if surface == "mirror":
        return {"Metallic": 1.0, "Roughness": rng.choice([0.0, 0.03]), "Base Color": (0.9, 0.9, 0.9, 1)}
    if surface == "glass":
        roughness = rng.choice([0.0, 0.0, rng.uniform(0.02, 0.4)])
        glass = {"Transmission Weight": 1.0, "Roughness": roughness, "Base Color": color(rng, 0.95)}
        return {**glass, "IOR": rng.uniform(1.2, 1.8)}
    if surface == "subsurface":
        scattering = {"Subsurface Weight": 1.0, "Subsurface Scale": log_uniform(rng, 0.005, 0.08)}
        return {**scattering, "Base Color": color(rng, rng.uniform(0.4, 0.9))}
    if surface == "coated":
        return {"Coat Weight": 1.0, "Coat Roughness": rng.uniform(0, 0.15)}
    if surface == "velvet":
        return {"Sheen Weight": 1.0}
    if surface == "emission":
        return {"Emission Color": color(rng, 1.0), "Emission Strength": log_uniform(rng, 0.5, 8)}
    return {}


def material(rng: assets.Rng, surface: str | None = None, in_world: bool = False) -> Any:
    """Draw a material; its kind too, unless given.

    With `in_world` its texture uses world coordinates, 1 to 60 features per metre: for static objects. Otherwise the
    texture follows the object, 2 to 60 features across it.
    """
    surface = surface or weighted_choice(rng, SURFACES)
    made, tree = assets.new_material(surface)
    inputs = tree.nodes["Principled BSDF"].inputs
    values = {"Base Color": color(rng), "Roughness": rng.uniform(0.25, 0.8)}
    for name, value in {**values, **_shader_inputs(rng, surface)}.items():
        inputs[name].default_value = value
    if surface in ("mirror", "glass", "emission") and rng.random() < 0.7:
        return made
    where = assets.node(tree, "NewGeometry" if in_world else "TexCoord")
    coordinates = where.outputs["Position" if in_world else "Generated"]
    if rng.random() < 0.85:
        shade, scalar = texture(rng, tree, coordinates, log_uniform(rng, 1 if in_world else 2, 60))
        if surface not in ("glass", "emission", "mirror"):
            tree.links.new(shade, inputs["Base Color"])
        if surface in ("plastic", "metal", "coated") and rng.random() < 0.35:
            low = rng.uniform(0.02, 0.5)
            spread = assets.node(tree, "MapRange", To_Min=low, To_Max=low + 0.4, Value=scalar)
            tree.links.new(spread.outputs["Result"], inputs["Roughness"])
    if rng.random() < 0.35:
        grain = assets.node(tree, "TexNoise", Scale=log_uniform(rng, 5, 120), Vector=coordinates)
        bump = assets.node(tree, "Bump", Strength=rng.uniform(0.1, 0.8), Distance=0.01, Height=grain.outputs["Fac"])
        tree.links.new(bump.outputs["Normal"], inputs["Normal"])
    return made


def set_emission(surface: Any, rgba: assets.Point, strength: float) -> None:
    inputs = surface.node_tree.nodes["Principled BSDF"].inputs
    inputs["Emission Color"].default_value, inputs["Emission Strength"].default_value = rgba, strength


def random_lathe(rng: assets.Rng, surface: Any) -> Any:
    """Add a surface of revolution about one unit high: a vase, a bottle, a bowl, a pawn."""
    heights = np.linspace(-0.5, 0.5, 40)
    radius = 0.12 + 0.3 * rng.random() * np.abs(np.sin(heights * rng.uniform(1, 6) + rng.uniform(0, 6)))
    radius += 0.08 * rng.random() * np.sin(heights * rng.uniform(5, 30))
    radius = np.maximum(radius, 0.02)
    turns, ribs = 48, rng.integers(0, 2) * rng.uniform(0, 0.15)
    angles = np.arange(turns) * 2 * np.pi / turns
    wave = 1 + ribs * np.sin(angles * rng.integers(3, 13))
    ring = np.stack([np.cos(angles) * wave, np.sin(angles) * wave], -1)
    vertices = [(r * x, r * y, z) for r, z in zip(radius, heights, strict=True) for x, y in ring]
    bottom, top = np.arange(turns)[::-1], (len(heights) - 1) * turns + np.arange(turns)
    return assets.add_mesh(
        "turned", vertices, [*assets.grid_faces(len(heights), turns, closed=True), bottom, top], surface, True
    )


def hair_ball(rng: assets.Rng, surface: Any) -> Any:
    """Add a ball of hair: strands on a sphere, bent by gravity."""
    strands, points = 3000, 5
    root = rng.standard_normal((strands, 3))
    root *= 0.32 / np.linalg.norm(root, axis=1, keepdims=True)
    along = np.linspace(0, 1, points)[None, :, None]
    length = rng.uniform(0.1, 0.3)
    path = root[:, None] * (1 + along * length / 0.32) + along * rng.normal(0, 0.03, (strands, 1, 3))
    path[..., 2] -= along[..., 0] ** 2 * rng.uniform(0, 0.15)
    return assets.add_strands(path, np.linspace(0.0025, 0.0006, points), surface)


def random_wire(rng: assets.Rng, surface: Any) -> Any:
    """Add a round wire through random points."""
    data = bpy.data.curves.new("curve", "CURVE")
    data.dimensions, data.bevel_depth, data.bevel_resolution = "3D", rng.uniform(0.01, 0.08), 3
    spline = data.splines.new("NURBS")
    spline.points.add(int(rng.integers(5, 14)) - 1)
    for point in spline.points:
        point.co = (*rng.uniform(-0.5, 0.5, 3), 1)
    spline.use_endpoint_u = True
    return assets.add_object("curve", data, surface)


def random_text(rng: assets.Rng, surface: Any) -> Any:
    """Add one to four upright letters."""
    data = bpy.data.curves.new("text", "FONT")
    letters = rng.choice(list("ABCDEGHKMNPRSTXZabdefghkpq0123456789&"), int(rng.integers(1, 5)))
    data.body, data.align_x, data.align_y = "".join(letters), "CENTER", "CENTER"
    data.size, data.extrude, data.bevel_depth = 0.9 / len(letters) + 0.3, rng.uniform(0.02, 0.2), 0.01
    item = assets.add_object("text", data, surface)
    item.rotation_euler.x = math.pi / 2
    return item


BUILT = {"turned": random_lathe, "fur": hair_ball, "curve": random_wire, "text": random_text}
KINDS = {
    "box": 1.5, "sphere": 1, "cylinder": 1, "cone": 0.5, "torus": 1, "monkey": 1, "turned": 2.5, "blob": 1.5,
    "curve": 1, "text": 1, "fur": 0.25, "cage": 0.7,
}  # fmt: skip


def add_asset(rng: assets.Rng, surface: Any, kind: str | None = None) -> Any:
    """Add an object of about unit size at the origin; its kind is drawn, unless given."""
    kind = kind or weighted_choice(rng, KINDS)
    if kind in BUILT:
        return BUILT[kind](rng, surface)
    add = bpy.ops.mesh
    operators: dict[str, Callable[[], Any]] = {
        "box": lambda: add.primitive_cube_add(size=0.8),
        "sphere": lambda: add.primitive_uv_sphere_add(segments=48, ring_count=24, radius=0.5),
        "cylinder": lambda: add.primitive_cylinder_add(vertices=48, radius=0.35, depth=0.9),
        "cone": lambda: add.primitive_cone_add(vertices=40, radius1=0.45, depth=0.9),
        "torus": lambda: add.primitive_torus_add(major_radius=0.38, minor_radius=rng.uniform(0.04, 0.16)),
        "monkey": lambda: add.primitive_monkey_add(size=0.9),
        "blob": lambda: add.primitive_ico_sphere_add(subdivisions=6, radius=0.42),
        "cage": lambda: add.primitive_ico_sphere_add(subdivisions=int(rng.integers(1, 4)), radius=0.5),
    }
    operators[kind]()
    item = bpy.context.active_object
    item.data.materials.clear()
    item.data.materials.append(surface)
    if kind in ("sphere", "torus", "monkey", "blob") or (kind in ("cylinder", "cone") and rng.random() < 0.3):
        bpy.ops.object.shade_smooth()
    if kind == "box" and rng.random() < 0.6:
        bevel = item.modifiers.new("bevel", "BEVEL")
        bevel.width, bevel.segments = rng.uniform(0.01, 0.12), 3
    elif kind == "monkey":
        item.modifiers.new("subdivision", "SUBSURF").render_levels = 2
    elif kind == "blob":
        relief = bpy.data.textures.new("relief", str(rng.choice(["CLOUDS", "VORONOI", "MUSGRAVE", "WOOD"])))
        relief.noise_scale = log_uniform(rng, 0.06, 0.5)
        displace = item.modifiers.new("displace", "DISPLACE")
        displace.texture, displace.strength = relief, rng.uniform(0.08, 0.4)
    elif kind == "cage":
        item.modifiers.new("wire", "WIREFRAME").thickness = rng.uniform(0.03, 0.1)
    return item


def add_bulb_sphere(radius: float, position: assets.Point, surface: Any) -> None:
    """Add a small sphere of an emissive material."""
    bpy.ops.mesh.primitive_ico_sphere_add(subdivisions=2, radius=radius, location=position)
    bpy.context.active_object.data.materials.append(surface)


def scatter(rng: assets.Rng, count: int, draw_place: Callable[[], tuple[assets.Point, float]], kinds: int = 3) -> None:
    """Add `count` instances of `kinds` random objects; `draw_place` returns a position and a size."""
    originals = [add_asset(rng, material(rng)) for _ in range(kinds)]
    for number in range(count):
        source = originals[number % kinds]
        item = source if number < kinds else source.copy()  # a copy shares the mesh: an instance to Cycles
        if number >= kinds:
            bpy.context.scene.collection.objects.link(item)
        position, size = draw_place()
        item.location, item.scale = position, (size, size, size)
        item.rotation_euler = (item.rotation_euler.x, item.rotation_euler.y, rng.uniform(0, 2 * math.pi))


def clutter(
    rng: assets.Rng, center: assets.Point, half: tuple[float, float], count: int, sizes: tuple[float, float]
) -> None:
    """Stand up to `count` random objects on a plane of ±`half` around `center`, the largest first, without overlap."""
    placed: list[tuple[float, float, float]] = []
    surfaces = [material(rng) for _ in range(max(count // 2, 4))]
    for size in sorted((log_uniform(rng, *sizes) for _ in range(count)), reverse=True):
        for _ in range(12):
            x, y = center[0] + rng.uniform(-1, 1) * half[0], center[1] + rng.uniform(-1, 1) * half[1]
            if all(math.hypot(x - px, y - py) > 0.45 * (size + s) for px, py, s in placed):
                break
        else:
            continue
        placed.append((x, y, size))
        item = add_asset(rng, surfaces[int(rng.integers(len(surfaces)))])
        item.scale = (size, size, size)
        item.rotation_euler.z = rng.uniform(0, 2 * math.pi)
        item.location = (x, y, center[2])
        bpy.context.view_layer.update()
        lowest = min((item.matrix_world @ Vector(corner)).z for corner in item.bound_box)
        item.location.z += center[2] - lowest
        item["mobile"] = True


def warm(rng: assets.Rng) -> tuple[float, float, float]:
    """Draw the tint of a lamp, from candle to overcast sky."""
    t = rng.uniform(-1, 1)
    return (1.0, 1 + 0.35 * t, 1 + 0.7 * t) if t < 0 else (1 - 0.4 * t, 1 - 0.15 * t, 1.0)


def set_world(rng: assets.Rng, kind: str, strength: float) -> None:
    """Give the scene a world of light: none, constant, image (Blender's or painted) or sky."""
    world = assets.new_world()
    if kind == "image":
        assets.sample_image_coarsely(world)
    tree = world.node_tree
    background = tree.nodes["Background"]
    background.inputs["Strength"].default_value = strength if kind != "none" else 0.0
    background.inputs["Color"].default_value = color(rng, 1.0)
    if kind in ("none", "constant"):
        return
    coordinates = assets.node(tree, "TexCoord")
    mapping = assets.node(tree, "Mapping", Rotation=(0, 0, rng.uniform(0, 2 * math.pi)))
    if kind == "sky":
        light = assets.node(tree, "TexSky")
        light.sky_type = str(rng.choice(["SINGLE_SCATTERING", "MULTIPLE_SCATTERING"]))
        light.sun_elevation = rng.uniform(0.06, 1.3)
        light.sun_rotation = rng.uniform(0, 2 * math.pi)
        light.sun_disc = bool(rng.random() < 0.75)
        light.sun_size = log_uniform(rng, 0.009, 0.08)
    else:
        light = assets.node(tree, "TexEnvironment")
        light.image = assets.studio_light(str(rng.choice(SKIES))) if rng.random() < 0.6 else painted_sky(rng)
        tree.links.new(coordinates.outputs["Generated"], mapping.inputs["Vector"])
        tree.links.new(mapping.outputs["Vector"], light.inputs["Vector"])
    tree.links.new(light.outputs["Color"], background.inputs["Color"])
