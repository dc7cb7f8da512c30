"""Building blocks of scenes: shader nodes, materials, meshes, curves, hair, smoke and lamps.

Lengths are metres, z is up. Textures use object coordinates, so that they follow a moving object.
"""

import math
from collections.abc import Sequence
from itertools import pairwise
from typing import Any, NamedTuple

import bpy
import numpy as np
from mathutils import Vector

Rng = np.random.Generator
Color = tuple[float, float, float]
Point = Sequence[float]
Profile = Sequence[tuple[float, float]]  # radii and heights

CUBE = [(x, y, z) for x in (-0.5, 0.5) for y in (-0.5, 0.5) for z in (-0.5, 0.5)]
CUBE_FACES = [(0, 1, 3, 2), (4, 6, 7, 5), (0, 4, 5, 1), (2, 3, 7, 6), (0, 2, 6, 4), (1, 5, 7, 3)]

# Materials


def node(tree: Any, kind: str, **inputs: Any) -> Any:
    """Add a shader node. `inputs` are values, or sockets to link; underscores in their names stand for blanks."""
    made = tree.nodes.new(f"ShaderNode{kind}")
    for name, value in inputs.items():
        socket = made.inputs[name.replace("_", " ")]
        if isinstance(value, bpy.types.NodeSocket):
            tree.links.new(value, socket)
        else:
            socket.default_value = value
    return made


def new_material(name: str) -> tuple[Any, Any]:
    """Make a material with a Principled shader; return the material and its node tree."""
    made = bpy.data.materials.new(name)
    made.use_nodes = True
    return made, made.node_tree


def plain(name: str, color: Point, **inputs: Any) -> Any:
    """Make a material of one linear color; `inputs` are those of the Principled shader, as for `node`."""
    made, tree = new_material(name)
    shader = tree.nodes["Principled BSDF"]
    for key, value in {"Base_Color": (*color, 1), **inputs}.items():
        shader.inputs[key.replace("_", " ")].default_value = value
    return made


def two_tone(
    name: str,
    dark: Color,
    light: Color,
    *,
    scale: float,
    stretch: Point = (1, 1, 1),
    edges: tuple[float, float] = (0.35, 0.65),
    bump: float = 0.0,
    roughness: tuple[float, float] = (0.5, 0.5),
    **inputs: Any,
) -> Any:
    """Make a material of noise between two linear colors, `scale` features per metre, with relief and uneven gloss.

    `stretch` divides the features along the axes (grain, brushing), `edges` are the noise values between which the
    color changes, `bump` is the height of the relief in metres. `Detail` and `Distortion` are inputs of the noise,
    all others inputs of the Principled shader.
    """
    texture = {key: inputs.pop(key, default) for key, default in (("Detail", 8), ("Distortion", 0.0))}
    made = plain(name, light, **inputs)
    tree = made.node_tree
    shader = tree.nodes["Principled BSDF"]
    where = node(tree, "TexCoord").outputs["Object"]
    mapped = node(tree, "Mapping", Vector=where, Scale=tuple(1 / s for s in stretch)).outputs["Vector"]
    noise = node(tree, "TexNoise", Vector=mapped, Scale=scale, Roughness=0.6, **texture).outputs["Fac"]
    ramp = node(tree, "ValToRGB", Fac=noise)
    for stop, position, tone in zip(ramp.color_ramp.elements, edges, (dark, light), strict=True):
        stop.position, stop.color = position, (*tone, 1)
    tree.links.new(ramp.outputs["Color"], shader.inputs["Base Color"])
    gloss = node(tree, "MapRange", Value=noise, From_Min=0.3, From_Max=0.7, To_Min=roughness[0], To_Max=roughness[1])
    tree.links.new(gloss.outputs["Result"], shader.inputs["Roughness"])
    if bump:
        relief = node(tree, "Bump", Height=noise, Strength=1.0, Distance=bump)
        tree.links.new(relief.outputs["Normal"], shader.inputs["Normal"])
    return made


def wood(dark: Color = (0.09, 0.035, 0.012), light: Color = (0.33, 0.16, 0.06), gloss: float = 0.35) -> Any:
    """Make wood with its grain along x and a mean roughness of `gloss`."""
    return two_tone("wood", dark, light, scale=14, stretch=(14, 1, 1), Distortion=1.2, edges=(0.3, 0.7),
                    bump=0.0006, roughness=(gloss + 0.15, gloss - 0.1))  # fmt: skip


def glow(color: Color, strength: float) -> Any:
    return plain("glow", (0, 0, 0), Emission_Color=(*color, 1), Emission_Strength=strength, Specular_IOR_Level=0)


def hair_material(melanin: float, redness: float, roughness: float = 0.3) -> Any:
    """Make Cycles' principled hair; `melanin` (darkness) and `redness` are in [0, 1]."""
    made, tree = new_material("hair")
    tree.nodes.remove(tree.nodes["Principled BSDF"])
    shader = node(tree, "BsdfHairPrincipled")
    shader.parametrization = "MELANIN"
    values = {"Melanin": melanin, "Melanin Redness": redness, "Roughness": roughness, "Random Color": 0.35}
    for name, value in values.items():
        shader.inputs[name].default_value = value
    tree.links.new(shader.outputs[0], tree.nodes["Material Output"].inputs["Surface"])
    return made


# Objects


def add_object(name: str, data: Any, surface: Any = None) -> Any:
    """Add an object with the given data block (None: an empty) and material."""
    item = bpy.data.objects.new(name, data)
    bpy.context.scene.collection.objects.link(item)
    if data is not None and surface is not None and hasattr(data, "materials"):
        data.materials.clear()
        data.materials.append(surface)
    return item


def place(item: Any, location: Point, turn: Point = (0, 0, 0), size: float = 1.0, parent: Any = None) -> Any:
    """Set an object's location, Euler angles in radians, uniform scale and parent; return the object."""
    item.location, item.rotation_euler, item.scale = Vector(location), turn, (size,) * 3
    if parent is not None:
        item.parent = parent
    return item


def add_mesh(name: str, vertices: Any, faces: Any, surface: Any, smooth: bool = False) -> Any:
    """Add an object from (N, 3) vertices and the vertex numbers of its faces."""
    mesh = bpy.data.meshes.new(name)
    mesh.from_pydata([tuple(map(float, v)) for v in vertices], [], [tuple(map(int, f)) for f in faces])
    mesh.update()
    if smooth:
        mesh.polygons.foreach_set("use_smooth", [True] * len(mesh.polygons))
    return add_object(name, mesh, surface)


def grid_faces(rows: int, columns: int, closed: bool = False) -> np.ndarray:
    """Return the quads of a grid of vertices, row by row; `closed` joins the last column to the first."""
    column = np.arange(columns if closed else columns - 1)
    start, following = columns * np.arange(rows - 1)[:, None], (column + 1) % columns
    corners = (start + column, start + following, start + columns + following, start + columns + column)
    return np.stack(corners, axis=-1).reshape(-1, 4)


def add_box(center: Point, size: Point, surface: Any, name: str = "box") -> Any:
    item = add_mesh(name, np.array(CUBE) * size, CUBE_FACES, surface)
    item.location = center
    return item


def bevelled(center: Point, size: Point, surface: Any, width: float, name: str = "box") -> Any:
    """Add a box with edges rounded by `width`."""
    item = add_mesh(name, np.array(CUBE) * size, CUBE_FACES, surface, smooth=True)
    item.location = center
    bevel = item.modifiers.new("bevel", "BEVEL")
    bevel.width, bevel.segments, bevel.harden_normals = width, 3, True
    return item


def lathe(name: str, profile: Profile, surface: Any, at: Point = (0, 0, 0), turn: Point = (0, 0, 0), *,
          segments: int = 72, parent: Any = None) -> Any:  # fmt: skip
    """Add a surface of revolution around z; edges are smooth where the profile bends by less than 35°."""
    points = np.array(profile, float)
    chord = np.concatenate([[0], np.cumsum(np.maximum(np.linalg.norm(np.diff(points, axis=0), axis=1), 1e-9))])
    fine = np.unique(np.concatenate([np.linspace(a, b, 7) for a, b in pairwise(chord)]))
    # Catmull-Rom cubic, parametrized by chord length: smooth, and through every point.
    slope = np.gradient(points, chord, axis=0, edge_order=1)
    index = np.clip(np.searchsorted(chord, fine, side="right") - 1, 0, len(chord) - 2)
    span = (chord[index + 1] - chord[index])[:, None]
    t = ((fine - chord[index]) / span[:, 0])[:, None]
    outline = (
        (2 * t**3 - 3 * t**2 + 1) * points[index]
        + (t**3 - 2 * t**2 + t) * span * slope[index]
        + (3 * t**2 - 2 * t**3) * points[index + 1]
        + (t**3 - t**2) * span * slope[index + 1]
    )
    outline[:, 0] = np.maximum(outline[:, 0], 0)
    angle = np.arange(segments) * 2 * math.pi / segments
    ring = np.stack([np.cos(angle), np.sin(angle)], axis=-1)
    vertices = [(r * x, r * y, z) for r, z in outline for x, y in ring]
    item = add_mesh(name, vertices, grid_faces(len(outline), segments, closed=True), surface, smooth=True)
    item.data.set_sharp_from_angle(angle=math.radians(35))
    return place(item, at, turn, parent=parent)


def sphere_profile(radius: float, points: int) -> Profile:
    """Return the profile of a sphere for `lathe`."""
    return [(radius * math.sin(a), -radius * math.cos(a)) for a in np.linspace(0, math.pi, points)]


def bulb(radius: float, surface: Any, at: Point, points: int = 9, segments: int = 16, parent: Any = None) -> Any:
    """Add a small emissive sphere."""
    return lathe("bulb", sphere_profile(radius, points), surface, at, segments=segments, parent=parent)


def gear(teeth: int, radius: float, depth: float, surface: Any, spokes: int = 5) -> Any:
    """Add a spoked gear wheel around z; `radius` is that of the middle of its teeth."""
    pitch, tooth = 2 * math.pi / teeth, 2.2 * radius / teeth
    outer = [
        ((k + share - 0.5) * pitch, radius + out * tooth / 2)
        for k in range(teeth)
        for share, out in ((0.0, -1.1), (0.27, -1.1), (0.37, 1.0), (0.63, 1.0), (0.73, -1.1))
    ]
    windows = []
    inner, rim = 0.32 * radius, radius - 1.6 * tooth
    for k in range(spokes):
        start, end = (k + 0.14) * 2 * math.pi / spokes, (k + 0.86) * 2 * math.pi / spokes
        narrow = np.linspace(start + 0.22, end - 0.22, 8)
        windows.append([(a, rim) for a in np.linspace(start, end, 14)] + [(a, inner) for a in narrow[::-1]])
    hole = [(a, 0.12 * radius) for a in np.linspace(0, 2 * math.pi, 32, endpoint=False)]
    data = bpy.data.curves.new("gear", "CURVE")
    data.dimensions, data.fill_mode = "2D", "BOTH"
    data.extrude, data.bevel_depth, data.bevel_resolution = depth / 2, 0.03 * radius, 2
    for outline in (outer, hole, *windows):
        spline = data.splines.new("POLY")
        spline.points.add(len(outline) - 1)
        spline.use_cyclic_u = True
        for point, (a, r) in zip(spline.points, outline, strict=True):
            point.co = (r * math.cos(a), r * math.sin(a), 0, 1)
    return add_object("gear", data, surface)


def wire(points: Sequence[Point], radius: float, surface: Any, name: str = "wire") -> Any:
    data = bpy.data.curves.new(name, "CURVE")
    data.dimensions, data.bevel_depth, data.bevel_resolution, data.use_fill_caps = "3D", radius, 4, True
    spline = data.splines.new("NURBS")
    spline.points.add(len(points) - 1)
    for point, position in zip(spline.points, points, strict=True):
        point.co = (*position, 1)
    spline.use_endpoint_u, spline.order_u, spline.resolution_u = True, 3, 8
    return add_object(name, data, surface)


def curtain(width: float, height: float, folds: int, depth: float, surface: Any) -> Any:
    """Add cloth that hangs in folds in the plane y = 0, its top edge at z = `height`."""
    across, down = 40 * folds, 24
    x, z = np.meshgrid(np.linspace(-0.5, 0.5, across), np.linspace(0, 1, down))
    y = np.sin(2 * math.pi * folds * (x + 0.015 * np.sin(9 * x + 2 * z)) + 0.6 * np.sin(5 * x))
    y = depth * (0.55 + 0.45 * z) * (y + 0.25 * np.sin(2 * math.pi * folds * 2.3 * x + 3 * z))
    vertices = np.stack([x * width, y, (1 - z) * height], axis=-1).reshape(-1, 3)
    return add_mesh("curtain", vertices, grid_faces(down, across), surface, smooth=True)


def leaf_shape(length: float, width: float, surface: Any) -> Any:
    """Add a leaf along x from the origin, folded along its middle and bent down."""
    along, across = np.meshgrid(np.linspace(0, 1, 15), np.linspace(-1, 1, 7), indexing="ij")
    half = width / 2 * np.sin(math.pi * along**0.8) * (1 - 0.15 * along)
    x, y = along * length, across * half
    z = 0.25 * np.abs(y) - 0.35 * length * along**2 + 0.01 * length * np.sin(22 * along) * np.abs(across)
    return add_mesh("leaf", np.stack([x, y, z], -1).reshape(-1, 3), grid_faces(15, 7), surface, smooth=True)


BOTTLES: tuple[Profile, ...] = (
    ((0, 0), (0.036, 0), (0.037, 0.01), (0.037, 0.19), (0.016, 0.235), (0.014, 0.30), (0.016, 0.31), (0, 0.312)),
    ((0, 0), (0.042, 0), (0.044, 0.02), (0.044, 0.14), (0.03, 0.18), (0.014, 0.2), (0.013, 0.26), (0.017, 0.265),
     (0, 0.27)),
    ((0, 0), (0.03, 0), (0.032, 0.01), (0.038, 0.1), (0.034, 0.17), (0.013, 0.25), (0.012, 0.33), (0, 0.335)),
    ((0, 0), (0.05, 0), (0.055, 0.04), (0.05, 0.09), (0.022, 0.13), (0.013, 0.16), (0.012, 0.21), (0.02, 0.22),
     (0, 0.225)),
    ((0, 0), (0.033, 0), (0.033, 0.005), (0.033, 0.2), (0.03, 0.215), (0.014, 0.225), (0.014, 0.27), (0, 0.275)),
)  # fmt: skip


def bottle(kind: int, surface: Any, label: Any = None) -> Any:
    """Add one of `BOTTLES`, standing on the origin; `label` is the material of its label, if any."""
    item = lathe("bottle", BOTTLES[kind], surface, segments=40)
    if label is not None:
        radius = max(r for r, _ in BOTTLES[kind]) + 0.0006
        lathe("label", [(radius, 0.05), (radius, 0.13)], label, segments=40, parent=item)
    return item


# Hair, volumes and lamps


def add_strands(path: np.ndarray, radii: np.ndarray, surface: Any) -> Any:
    """Add hair curves from (strands, points, 3) positions and the radii of their points."""
    strands, points = path.shape[:2]
    data = bpy.data.hair_curves.new("fur")
    data.add_curves([points] * strands)
    data.position_data.foreach_set("vector", path.astype(np.float32).ravel())
    taper = np.broadcast_to(radii, (strands, points))
    data.attributes.new("radius", "FLOAT", "POINT").data.foreach_set("value", taper.astype(np.float32).ravel())
    return add_object("fur", data, surface)


class Hair(NamedTuple):
    strands: int
    length: float
    radius: float = 0.00004
    lean: Point = (0, 0, -0.6)  # what gravity and combing add to a strand at its tip, in strand lengths
    wave: float = 0.25  # its curl, in strand lengths
    clumps: int = 400  # strands that tips gather around
    clump: float = 0.5  # by this share of the distance


def fur(rng: Rng, item: Any, hair: Hair, surface: Any) -> Any:
    """Cover a mesh, with its modifiers, with hair that is its child."""
    strands = hair.strands
    graph = bpy.context.evaluated_depsgraph_get()
    mesh = item.evaluated_get(graph).to_mesh()
    mesh.calc_loop_triangles()
    corners = np.empty(3 * len(mesh.loop_triangles), np.int32)
    mesh.loop_triangles.foreach_get("vertices", corners)
    places, normals = (np.empty(3 * len(mesh.vertices), np.float32) for _ in range(2))
    mesh.vertices.foreach_get("co", places)
    mesh.vertices.foreach_get("normal", normals)
    triangle, normal = (values.reshape(-1, 3)[corners.reshape(-1, 3)] for values in (places, normals))
    area = np.linalg.norm(np.cross(triangle[:, 1] - triangle[:, 0], triangle[:, 2] - triangle[:, 0]), axis=-1)
    chosen = rng.choice(len(area), strands, p=area / area.sum())
    weights = rng.dirichlet((1, 1, 1), strands)[..., None]
    root, out = (triangle[chosen] * weights).sum(axis=1), (normal[chosen] * weights).sum(axis=1)
    out /= np.linalg.norm(out, axis=-1, keepdims=True)
    item.evaluated_get(graph).to_mesh_clear()
    t = np.linspace(0, 1, 8)[None, :, None]
    long = hair.length * rng.uniform(0.6, 1.1, (strands, 1, 1))
    way = out + 0.25 * rng.standard_normal((strands, 3))
    curl, phase = rng.standard_normal((strands, 1, 3)), rng.uniform(0, 2 * math.pi, (strands, 1, 1))
    path = root[:, None] + long * (t * way[:, None] + t**2 * np.array(hair.lean, float))
    path = path + long * hair.wave * t * curl * np.sin(5 * t + phase) * 0.5
    leaders = path[rng.choice(strands, hair.clumps, replace=False)]
    # Blocks of strands: the matrix of all distances to the leaders would be large.
    nearest = np.concatenate(
        [((block[:, None] - leaders[None, :, 0]) ** 2).sum(-1).argmin(axis=1) for block in np.array_split(root, 40)]
    )
    path += hair.clump * t**1.5 * (leaders[nearest] - path)
    made = add_strands(path, hair.radius * np.linspace(1, 0.25, 8), surface)
    made.parent = item
    return made


def _fill(name: str, surface: Any, center: Point, size: Point) -> None:
    """Add a box of a volume, hidden from `ray_cast`, which finds surfaces only."""
    add_box(center, size, surface, name).hide_set(True)


def fill_with_fog(center: Point, size: Point, density: float, forward: float) -> None:
    """Fill a box with a uniform scattering volume, `density` per metre; `forward` is the mean cosine of its phase."""
    surface, tree = new_material("fog")
    tree.nodes.clear()
    volume = node(tree, "VolumeScatter", Density=density, Anisotropy=forward)
    tree.links.new(volume.outputs["Volume"], node(tree, "OutputMaterial").inputs["Volume"])
    _fill("fog", surface, center, size)


def fill_with_smoke(
    frames: range, center: Point, size: Point, density: tuple[float, float], scale: float, forward: float
) -> None:
    """Fill a box with smoke that drifts upwards, thin to thick by `density` per metre, `scale` clouds per metre."""
    surface, tree = new_material("smoke")
    tree.nodes.clear()
    where = node(tree, "Mapping", Vector=node(tree, "TexCoord").outputs["Object"])
    noise = node(tree, "TexNoise", Vector=where.outputs["Vector"], Scale=scale, Detail=2.0)
    thick = node(tree, "MapRange", Value=noise.outputs["Fac"], From_Min=0.35, From_Max=0.75, To_Min=density[0],
                 To_Max=density[1])  # fmt: skip
    shader = node(tree, "VolumeScatter", Density=thick.outputs["Result"], Anisotropy=forward)
    tree.links.new(shader.outputs["Volume"], node(tree, "OutputMaterial").inputs["Volume"])
    for frame in frames:
        where.inputs["Location"].default_value = (0.016 / scale * frame, 0.0, -0.032 / scale * frame)
        where.inputs["Location"].keyframe_insert("default_value", frame=frame)
    _fill("smoke", surface, center, size)


def add_lamp(kind: str, position: Point, power: float, size: float, target: Point, tint: Point) -> Any:
    """Add a lamp (POINT, AREA, SPOT or SUN) aimed at `target`.

    `power` is in watts (SUN: watts per square metre), `size` in metres (SUN: radians).
    """
    data = bpy.data.lights.new(kind.lower(), kind)
    data.energy, data.color = power, tint[:3]
    setattr(data, {"AREA": "size", "SUN": "angle"}.get(kind, "shadow_soft_size"), size)
    item = add_object(kind.lower(), data)
    item.location = position
    item.rotation_euler = (Vector(target) - Vector(position)).to_track_quat("-Z", "Y").to_euler()
    return item


def new_world() -> Any:
    world = bpy.context.scene.world = bpy.data.worlds.new("world")
    world.use_nodes = True
    return world


def sample_image_coarsely(world: Any) -> None:
    """Sample the world's image by 1024 columns: Cycles rebuilds its map for each render, at full size in seconds."""
    world.cycles.sampling_method, world.cycles.sample_map_resolution = "MANUAL", 1024


def studio_light(name: str) -> Any:
    """Load one of the environment images that come with Blender."""
    folder = bpy.utils.system_resource("DATAFILES", path="studiolights/world")
    return bpy.data.images.load(f"{folder}/{name}.exr")
