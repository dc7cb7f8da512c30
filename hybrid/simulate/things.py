"""Things for random shots: materials, objects, lamps and worlds. Every draw comes from the generator handed in.

Units are metres, z is up. Brightness is only relative: the exposure of a shot is chosen when it is planned.
"""

from __future__ import annotations

import math
from collections.abc import Callable, Sequence
from pathlib import Path
from typing import Any

import bpy
import numpy as np
from mathutils import Vector

Rng = np.random.Generator
# Blender's other two skies, courtyard and night, are kept for evaluation.
SKIES = ("city", "forest", "interior", "studio", "sunrise", "sunset")


def choose(rng: Rng, weights: dict[str, float]) -> str:
    """Draw a key with probability proportional to its value.

    Parameters
    ----------
    rng : numpy.random.Generator
        Where all chance comes from.
    weights : dict of str to float
        What may be drawn, and how often.

    Returns
    -------
    str
    """
    values = np.array(list(weights.values()))
    return str(rng.choice(list(weights), p=values / values.sum()))


def log_uniform(rng: Rng, low: float, high: float) -> float:
    """Draw from [low, high], uniformly in the logarithm.

    Parameters
    ----------
    rng : numpy.random.Generator
        Where all chance comes from.
    low : float
        Above 0.
    high : float
        At least `low`.

    Returns
    -------
    float
    """
    return float(np.exp(rng.uniform(math.log(low), math.log(high))))


def color(rng: Rng, brightness: float | None = None) -> tuple[float, float, float, float]:
    """Draw a linear color: mostly muted, its largest component `brightness`, by default 0.04 to 0.85.

    Parameters
    ----------
    rng : numpy.random.Generator
        Where all chance comes from.
    brightness : float, optional
        Largest component; 0.04 to 0.85 without.

    Returns
    -------
    tuple of four floats
        Linear, with alpha.
    """
    hue, saturation = rng.random(), rng.beta(1.2, 2.6)
    rgb = np.clip(np.abs((hue * 6 + np.array([0.0, 4.0, 2.0])) % 6 - 3) - 1, 0, 1)
    rgb = (1 - saturation + saturation * rgb) * (log_uniform(rng, 0.04, 0.85) if brightness is None else brightness)
    return (float(rgb[0]), float(rgb[1]), float(rgb[2]), 1.0)


def painted_image(rng: Rng, size: int = 512) -> Any:
    """Draw an image texture: spectral noise, stripes, plaid, patches or rows of marks like writing.

    Parameters
    ----------
    rng : numpy.random.Generator
        Where all chance comes from.
    size : int
        Pixels each way.

    Returns
    -------
    bpy.types.Image
    """
    y, x = np.mgrid[:size, :size] / size
    kind = choose(rng, {"spectral": 3, "stripes": 1, "plaid": 1, "patches": 2, "writing": 2})
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
    dark, light = (
        np.array(color(rng, log_uniform(rng, 0.05, 0.5))),
        np.array(color(rng, rng.uniform(0.3, 0.95))),
    )
    pixels = dark * (1 - field) + light * field
    pixels[..., 3] = 1
    image = bpy.data.images.new("painted", size, size)
    image.pixels.foreach_set(pixels.astype(np.float32).ravel())
    image.update()
    return image


def texture(rng: Rng, tree: Any, coordinates: Any, scale: float) -> tuple[Any, Any]:
    """Add a texture; return its color and its scalar socket. `scale` is features per unit of the coordinates.

    Parameters
    ----------
    rng : numpy.random.Generator
        Where all chance comes from.
    tree : bpy.types.NodeTree
        Where it is added.
    coordinates : bpy.types.NodeSocket
        Where it lies.
    scale : float
        Features per unit of the coordinates.

    Returns
    -------
    two bpy.types.NodeSocket
        Color and scalar.
    """
    nodes, links = tree.nodes, tree.links
    kind = choose(rng, {"Noise": 4, "Voronoi": 2, "Wave": 1.5, "Checker": 1, "Brick": 1.5, "Magic": 0.5, "Image": 3})
    node = nodes.new(f"ShaderNodeTex{kind}")
    if kind == "Image":
        node.image = painted_image(rng)
        node.projection = "BOX"
        mapping = nodes.new("ShaderNodeMapping")
        mapping.inputs["Scale"].default_value = (min(scale / 4, 4),) * 3
        mapping.inputs["Rotation"].default_value = (0, 0, rng.uniform(0, 0.3))
        links.new(coordinates, mapping.inputs["Vector"])
        links.new(mapping.outputs["Vector"], node.inputs["Vector"])
        return node.outputs["Color"], node.outputs["Color"]
    links.new(coordinates, node.inputs["Vector"])
    node.inputs["Scale"].default_value = scale
    if kind == "Noise":
        node.inputs["Detail"].default_value = rng.uniform(0, 10)
        node.inputs["Roughness"].default_value = rng.uniform(0.3, 0.75)
        node.inputs["Distortion"].default_value = rng.choice([0.0, 0.0, rng.uniform(0, 3)])
    elif kind == "Voronoi":
        node.feature = str(rng.choice(["F1", "F2", "DISTANCE_TO_EDGE"]))
    elif kind == "Wave":
        node.wave_type = str(rng.choice(["BANDS", "RINGS"]))
        node.inputs["Distortion"].default_value = rng.uniform(0, 12)
        node.inputs["Detail"].default_value = rng.uniform(0, 6)
    elif kind in ("Checker", "Brick"):
        for name in ("Color1", "Color2", *(("Mortar",) if kind == "Brick" else ())):
            node.inputs[name].default_value = color(rng)
        return node.outputs["Color"], node.outputs[1]
    scalar = node.outputs["Fac"] if "Fac" in node.outputs else node.outputs["Distance"]
    ramp = nodes.new("ShaderNodeValToRGB")
    ramp.color_ramp.interpolation = str(rng.choice(["LINEAR", "CONSTANT", "EASE"]))
    first, last = sorted(rng.uniform(0.1, 0.9, 2))
    ramp.color_ramp.elements[0].position, ramp.color_ramp.elements[1].position = float(first), float(last)
    if rng.random() < 0.6:
        ramp.color_ramp.elements.new(float((first + last) / 2))
    for stop in ramp.color_ramp.elements:
        stop.color = color(rng)
    links.new(scalar, ramp.inputs["Fac"])
    return ramp.outputs["Color"], scalar


SURFACES = {
    "diffuse": 0.28, "plastic": 0.24, "metal": 0.14, "mirror": 0.04, "glass": 0.07, "subsurface": 0.07,
    "coated": 0.08, "velvet": 0.04, "emission": 0.04,
}  # fmt: skip


def material(rng: Rng, surface: str | None = None, in_world: bool = False) -> Any:
    """Draw a material.

    With `in_world` its texture sits in the world, 1 to 60 features per metre: for what stands still. Otherwise it
    goes with the object, 2 to 60 features across it.

    Parameters
    ----------
    rng : numpy.random.Generator
        Where all chance comes from.
    surface : str, optional
        Its kind; drawn without.
    in_world : bool
        Whether its texture stands still in the world.

    Returns
    -------
    bpy.types.Material
    """
    surface = surface or choose(rng, SURFACES)
    made = bpy.data.materials.new(surface)
    made.use_nodes = True
    tree = made.node_tree
    nodes, links = tree.nodes, tree.links
    shader = nodes["Principled BSDF"]
    inputs = shader.inputs
    inputs["Base Color"].default_value = color(rng)
    inputs["Roughness"].default_value = rng.uniform(0.25, 0.8)
    if surface == "diffuse":
        inputs["Roughness"].default_value, inputs["Specular IOR Level"].default_value = 1.0, 0.0
    elif surface == "metal":
        inputs["Metallic"].default_value = 1.0
        inputs["Base Color"].default_value = color(rng, rng.uniform(0.5, 0.95))
        inputs["Roughness"].default_value = rng.beta(1.2, 2.5)
    elif surface == "mirror":
        inputs["Metallic"].default_value, inputs["Roughness"].default_value = 1.0, rng.choice([0.0, 0.03])
        inputs["Base Color"].default_value = (0.9, 0.9, 0.9, 1)
    elif surface == "glass":
        inputs["Transmission Weight"].default_value = 1.0
        inputs["Roughness"].default_value = rng.choice([0.0, 0.0, rng.uniform(0.02, 0.4)])
        inputs["Base Color"].default_value = color(rng, 0.95)
        inputs["IOR"].default_value = rng.uniform(1.2, 1.8)
    elif surface == "subsurface":
        inputs["Subsurface Weight"].default_value = 1.0
        inputs["Subsurface Scale"].default_value = log_uniform(rng, 0.005, 0.08)
        inputs["Base Color"].default_value = color(rng, rng.uniform(0.4, 0.9))
    elif surface == "coated":
        inputs["Coat Weight"].default_value, inputs["Coat Roughness"].default_value = (
            1.0,
            rng.uniform(0, 0.15),
        )
    elif surface == "velvet":
        inputs["Sheen Weight"].default_value = 1.0
    elif surface == "emission":
        inputs["Emission Color"].default_value = color(rng, 1.0)
        inputs["Emission Strength"].default_value = log_uniform(rng, 0.5, 8)
    if surface in ("mirror", "glass", "emission") and rng.random() < 0.7:
        return made
    where = nodes.new("ShaderNodeNewGeometry" if in_world else "ShaderNodeTexCoord")
    coordinates = where.outputs["Position" if in_world else "Generated"]
    if rng.random() < 0.85:
        shade, scalar = texture(rng, tree, coordinates, log_uniform(rng, *((1, 60) if in_world else (2, 60))))
        if surface not in ("glass", "emission", "mirror"):
            links.new(shade, inputs["Base Color"])
        if surface in ("plastic", "metal", "coated") and rng.random() < 0.35:
            spread = nodes.new("ShaderNodeMapRange")
            low = rng.uniform(0.02, 0.5)
            spread.inputs["To Min"].default_value, spread.inputs["To Max"].default_value = low, low + 0.4
            links.new(scalar, spread.inputs["Value"])
            links.new(spread.outputs["Result"], inputs["Roughness"])
    if rng.random() < 0.35:
        grain, bump = nodes.new("ShaderNodeTexNoise"), nodes.new("ShaderNodeBump")
        grain.inputs["Scale"].default_value = log_uniform(rng, 5, 120)
        bump.inputs["Strength"].default_value = rng.uniform(0.1, 0.8)
        bump.inputs["Distance"].default_value = 0.01
        links.new(coordinates, grain.inputs["Vector"])
        links.new(grain.outputs["Fac"], bump.inputs["Height"])
        links.new(bump.outputs["Normal"], inputs["Normal"])
    return made


def add_mesh(name: str, vertices: Any, faces: Any, surface: Any, smooth: bool = False) -> Any:
    """Add an object from vertices and faces.

    Parameters
    ----------
    name : str
        What Blender calls it.
    vertices : (N, 3) sequence of float
        Metres.
    faces : sequence of sequences of int
        Indices of vertices.
    surface : bpy.types.Material
        What it is made of.
    smooth : bool
        Whether its faces are shaded as one.

    Returns
    -------
    bpy.types.Object
    """
    mesh = bpy.data.meshes.new(name)
    mesh.from_pydata([tuple(map(float, v)) for v in vertices], [], [tuple(map(int, f)) for f in faces])
    mesh.update()
    if smooth:
        mesh.polygons.foreach_set("use_smooth", [True] * len(mesh.polygons))
    return add_object(name, mesh, surface)


def add_object(name: str, data: Any, surface: Any) -> Any:
    """Add an object of some data and give it a material.

    Parameters
    ----------
    name : str
        What Blender calls it.
    data : bpy.types.ID
        A mesh, a curve, a light or a volume.
    surface : bpy.types.Material
        What it is made of.

    Returns
    -------
    bpy.types.Object
    """
    item = bpy.data.objects.new(name, data)
    bpy.context.scene.collection.objects.link(item)
    if data is not None and surface is not None and hasattr(data, "materials"):
        data.materials.clear()
        data.materials.append(surface)
    return item


CUBE = [(x, y, z) for x in (-0.5, 0.5) for y in (-0.5, 0.5) for z in (-0.5, 0.5)]
CUBE_FACES = [(0, 1, 3, 2), (4, 6, 7, 5), (0, 4, 5, 1), (2, 3, 7, 6), (0, 2, 6, 4), (1, 5, 7, 3)]


def add_box(center: Sequence[float], size: Sequence[float], surface: Any, name: str = "box") -> Any:
    """Add an axis-aligned box.

    Parameters
    ----------
    center : sequence of float
        Of the box, in metres.
    size : sequence of float
        Of the box along x, y and z, in metres.
    surface : bpy.types.Material
        What it is made of.
    name : str
        What Blender calls it.

    Returns
    -------
    bpy.types.Object
    """
    item = add_mesh(name, np.array(CUBE) * size, CUBE_FACES, surface)
    item.location = center
    return item


def fill_with_fog(center: Sequence[float], size: Sequence[float], density: float, forward: float) -> None:
    """Fill a box with a thin scattering volume, `density` per metre; `forward` is the mean cosine of its phase.

    Parameters
    ----------
    center : sequence of float
        Of the box, in metres.
    size : sequence of float
        Of the box along x, y and z, in metres.
    density : float
        Per metre.
    forward : float
        Mean cosine of its phase.
    """
    surface = bpy.data.materials.new("fog")
    surface.use_nodes = True
    tree = surface.node_tree
    tree.nodes.clear()
    volume, output = tree.nodes.new("ShaderNodeVolumeScatter"), tree.nodes.new("ShaderNodeOutputMaterial")
    volume.inputs["Density"].default_value, volume.inputs["Anisotropy"].default_value = density, forward
    tree.links.new(volume.outputs["Volume"], output.inputs["Volume"])
    add_box(center, size, surface, "fog").hide_set(True)


def add_turned(rng: Rng, surface: Any) -> Any:
    """Add a turned thing about one unit high: a vase, a bottle, a bowl, a pawn.

    Parameters
    ----------
    rng : numpy.random.Generator
        Where all chance comes from.
    surface : bpy.types.Material
        What it is made of.

    Returns
    -------
    bpy.types.Object
    """
    heights = np.linspace(-0.5, 0.5, 40)
    radius = 0.12 + 0.3 * rng.random() * np.abs(np.sin(heights * rng.uniform(1, 6) + rng.uniform(0, 6)))
    radius += 0.08 * rng.random() * np.sin(heights * rng.uniform(5, 30))
    radius = np.maximum(radius, 0.02)
    turns, ribs = 48, rng.integers(0, 2) * rng.uniform(0, 0.15)
    angles = np.arange(turns) * 2 * np.pi / turns
    wave = 1 + ribs * np.sin(angles * rng.integers(3, 13))
    ring = np.stack([np.cos(angles) * wave, np.sin(angles) * wave], -1)
    vertices = [(r * x, r * y, z) for r, z in zip(radius, heights, strict=True) for x, y in ring]
    faces: list[tuple[int, ...]] = [
        (i * turns + j, i * turns + (j + 1) % turns, (i + 1) * turns + (j + 1) % turns, (i + 1) * turns + j)
        for i in range(len(heights) - 1)
        for j in range(turns)
    ]
    faces += [tuple(range(turns))[::-1], tuple((len(heights) - 1) * turns + j for j in range(turns))]
    return add_mesh("turned", vertices, faces, surface, smooth=True)


def add_thing(rng: Rng, surface: Any, kind: str | None = None) -> Any:
    """Add a thing of about unit size at the origin.

    Parameters
    ----------
    rng : numpy.random.Generator
        Where all chance comes from.
    surface : bpy.types.Material
        What it is made of.
    kind : str, optional
        Of the thing; drawn without.

    Returns
    -------
    bpy.types.Object
    """
    kind = kind or choose(
        rng,
        {"box": 1.5, "sphere": 1, "cylinder": 1, "cone": 0.5, "torus": 1, "monkey": 1, "turned": 2.5, "blob": 1.5,
         "curve": 1, "text": 1, "fur": 0.25, "cage": 0.7},
    )  # fmt: skip
    if kind == "turned":
        return add_turned(rng, surface)
    if kind == "fur":
        return add_fur(rng, surface)
    if kind in ("curve", "text"):
        data = bpy.data.curves.new(kind, "CURVE" if kind == "curve" else "FONT")
        if kind == "curve":
            data.dimensions, data.bevel_depth, data.bevel_resolution = "3D", rng.uniform(0.01, 0.08), 3
            spline = data.splines.new("NURBS")
            count = int(rng.integers(5, 14))
            spline.points.add(count - 1)
            for point in spline.points:
                point.co = (*rng.uniform(-0.5, 0.5, 3), 1)
            spline.use_endpoint_u = True
        else:
            letters = rng.choice(list("ABCDEGHKMNPRSTXZabdefghkpq0123456789&"), int(rng.integers(1, 5)))
            data.body, data.align_x, data.align_y = "".join(letters), "CENTER", "CENTER"
            data.size, data.extrude, data.bevel_depth = 0.9 / len(letters) + 0.3, rng.uniform(0.02, 0.2), 0.01
        item = add_object(kind, data, surface)
        if kind == "text":
            item.rotation_euler.x = math.pi / 2
        return item
    operators: dict[str, Callable[[], Any]] = {
        "box": lambda: bpy.ops.mesh.primitive_cube_add(size=0.8),
        "sphere": lambda: bpy.ops.mesh.primitive_uv_sphere_add(segments=48, ring_count=24, radius=0.5),
        "cylinder": lambda: bpy.ops.mesh.primitive_cylinder_add(vertices=48, radius=0.35, depth=0.9),
        "cone": lambda: bpy.ops.mesh.primitive_cone_add(vertices=40, radius1=0.45, depth=0.9),
        "torus": lambda: bpy.ops.mesh.primitive_torus_add(major_radius=0.38, minor_radius=rng.uniform(0.04, 0.16)),
        "monkey": lambda: bpy.ops.mesh.primitive_monkey_add(size=0.9),
        "blob": lambda: bpy.ops.mesh.primitive_ico_sphere_add(subdivisions=6, radius=0.42),
        "cage": lambda: bpy.ops.mesh.primitive_ico_sphere_add(subdivisions=int(rng.integers(1, 4)), radius=0.5),
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


def add_fur(rng: Rng, surface: Any) -> Any:
    """Add a ball of hair: strands over a unit sphere, bent by gravity.

    Parameters
    ----------
    rng : numpy.random.Generator
        Where all chance comes from.
    surface : bpy.types.Material
        What it is made of.

    Returns
    -------
    bpy.types.Object
    """
    strands, points = 3000, 5
    root = rng.standard_normal((strands, 3))
    root *= 0.32 / np.linalg.norm(root, axis=1, keepdims=True)
    along = np.linspace(0, 1, points)[None, :, None]
    length = rng.uniform(0.1, 0.3)
    path = root[:, None] * (1 + along * length / 0.32) + along * rng.normal(0, 0.03, (strands, 1, 3))
    path[..., 2] -= along[..., 0] ** 2 * rng.uniform(0, 0.15)
    data = bpy.data.hair_curves.new("fur")
    data.add_curves([points] * strands)
    data.position_data.foreach_set("vector", path.astype(np.float32).ravel())
    radius = data.attributes.new("radius", "FLOAT", "POINT")
    taper = np.broadcast_to(np.linspace(0.0025, 0.0006, points), (strands, points))
    radius.data.foreach_set("value", taper.astype(np.float32).ravel())
    return add_object("fur", data, surface)


def scatter(rng: Rng, count: int, place: Callable[[], tuple[Sequence[float], float]], kinds: int = 3) -> None:
    """Add `count` instances of a few things; `place` draws a position and a size.

    Parameters
    ----------
    rng : numpy.random.Generator
        Where all chance comes from.
    count : int
        How many.
    place : callable
        Draws a position in metres, and a size.
    kinds : int
        Of things.
    """
    originals = [add_thing(rng, material(rng)) for _ in range(kinds)]
    for number in range(count):
        source = originals[number % kinds]
        item = source if number < kinds else source.copy()  # a copy shares the mesh: an instance to Cycles
        if number >= kinds:
            bpy.context.scene.collection.objects.link(item)
        position, size = place()
        item.location, item.scale = position, (size, size, size)
        item.rotation_euler = (item.rotation_euler.x, item.rotation_euler.y, rng.uniform(0, 2 * math.pi))


def clutter(
    rng: Rng, center: Sequence[float], half: tuple[float, float], count: int, sizes: tuple[float, float]
) -> None:
    """Put things on a plane around `center`, the larger ones spread first, sitting on it and not in each other.

    Parameters
    ----------
    rng : numpy.random.Generator
        Where all chance comes from.
    center : sequence of float
        Of the plane, in metres.
    half : (float, float)
        Half of its size along x and y.
    count : int
        How many things.
    sizes : (float, float)
        From and to, in metres.
    """
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
        item = add_thing(rng, surfaces[int(rng.integers(len(surfaces)))])
        item.scale = (size, size, size)
        item.rotation_euler.z = rng.uniform(0, 2 * math.pi)
        item.location = (x, y, center[2])
        bpy.context.view_layer.update()
        lowest = min((item.matrix_world @ Vector(corner)).z for corner in item.bound_box)
        item.location.z += center[2] - lowest
        item["mobile"] = True


def add_lamp(
    kind: str, position: Sequence[float], power: float, size: float, target: Sequence[float], tint: Any
) -> Any:
    """Add a lamp of `kind` (POINT, AREA, SPOT, SUN), aimed at `target`.

    Parameters
    ----------
    kind : str
        POINT, AREA, SPOT or SUN.
    position : sequence of float
        Metres.
    power : float
        Watts; of a SUN, watts per square metre.
    size : float
        Metres; of a SUN, radians.
    target : sequence of float
        What it is aimed at.
    tint : sequence of float
        Linear color.

    Returns
    -------
    bpy.types.Object
    """
    data = bpy.data.lights.new(kind.lower(), kind)
    data.energy, data.color = power, tint[:3]
    if kind == "AREA":
        data.size = size
    elif kind == "SUN":
        data.angle = size
    else:
        data.shadow_soft_size = size
    item = add_object(kind.lower(), data, None)
    item.location = position
    item.rotation_euler = (Vector(target) - Vector(position)).to_track_quat("-Z", "Y").to_euler()
    return item


def warm(rng: Rng) -> tuple[float, float, float]:
    """Draw the tint of a lamp, from candle to overcast sky."""
    t = rng.uniform(-1, 1)
    return (
        (1.0, 1 - 0.35 * max(-t, 0) - 0.1 * max(t, 0), 1 - 0.7 * max(-t, 0))
        if t < 0
        else (1 - 0.4 * t, 1 - 0.15 * t, 1.0)
    )


def set_world(rng: Rng, kind: str, strength: float) -> None:
    """Give the scene a world: none, constant, image (Blender's or painted) or sky.

    Parameters
    ----------
    rng : numpy.random.Generator
        Where all chance comes from.
    kind : str
        none, constant, image or sky.
    strength : float
        Factor on its light.
    """
    scene = bpy.context.scene
    scene.world = bpy.data.worlds.new("world")
    if kind == "image":
        # Read for each picture anew; at the size of the image that takes seconds, longer than a few samples.
        scene.world.cycles.sampling_method, scene.world.cycles.sample_map_resolution = "MANUAL", 1024
    scene.world.use_nodes = True
    tree = scene.world.node_tree
    background = tree.nodes["Background"]
    background.inputs["Strength"].default_value = strength if kind != "none" else 0.0
    background.inputs["Color"].default_value = color(rng, 1.0)
    if kind in ("none", "constant"):
        return
    coordinates, mapping = tree.nodes.new("ShaderNodeTexCoord"), tree.nodes.new("ShaderNodeMapping")
    mapping.inputs["Rotation"].default_value = (0, 0, rng.uniform(0, 2 * math.pi))
    if kind == "sky":
        node = tree.nodes.new("ShaderNodeTexSky")
        node.sky_type = str(rng.choice(["SINGLE_SCATTERING", "MULTIPLE_SCATTERING"]))
        node.sun_elevation = rng.uniform(0.06, 1.3)
        node.sun_rotation = rng.uniform(0, 2 * math.pi)
        node.sun_disc = bool(rng.random() < 0.75)
        node.sun_size = log_uniform(rng, 0.009, 0.08)
    else:
        node = tree.nodes.new("ShaderNodeTexEnvironment")
        if rng.random() < 0.6:
            folder = Path(bpy.utils.system_resource("DATAFILES", path="studiolights/world"))
            node.image = bpy.data.images.load(str(folder / f"{rng.choice(SKIES)}.exr"))
        else:
            node.image = painted_sky(rng)
        tree.links.new(coordinates.outputs["Generated"], mapping.inputs["Vector"])
        tree.links.new(mapping.outputs["Vector"], node.inputs["Vector"])
    tree.links.new(node.outputs["Color"], background.inputs["Color"])


def painted_sky(rng: Rng, height: int = 128) -> Any:
    """Draw a sky image: a gradient over a ground, and some bright windows or blobs.

    Parameters
    ----------
    rng : numpy.random.Generator
        Where all chance comes from.
    height : int
        Pixels.

    Returns
    -------
    bpy.types.Image
    """
    y, x = np.mgrid[:height, : 2 * height] / height
    up = (np.array(color(rng, 0.8))[:3], np.array(color(rng, 0.15))[:3])
    pixels = np.where(y[..., None] > 0.5, up[0] * y[..., None], up[1])
    for _ in range(int(rng.integers(1, 7))):
        cx, cy, radius = rng.uniform(0, 2), rng.uniform(0.52, 0.95), log_uniform(rng, 0.01, 0.15)
        dx = np.minimum(np.abs(x - cx), 2 - np.abs(x - cx))
        soft = rng.random() < 0.5
        inside = np.exp(-(dx**2 + (y - cy) ** 2) / radius**2) if soft else (dx < radius) & (np.abs(y - cy) < radius)
        pixels = pixels + inside[..., None] * np.array(color(rng, 1.0))[:3] * 0.1 / radius**1.5
    image = bpy.data.images.new("sky", 2 * height, height, float_buffer=True)
    image.colorspace_settings.name = "Linear Rec.709"
    image.pixels.foreach_set(np.concatenate([pixels, np.ones_like(pixels[..., :1])], -1).astype(np.float32).ravel())
    image.update()
    return image
