"""Building blocks of random scenes: shader nodes, meshes, hair, fog, smoke, lamps and worlds.

Lengths are metres, z is up.
"""

import math
from collections.abc import Sequence
from typing import Any, NamedTuple

import bpy
import numpy as np
from mathutils import Vector

Rng = np.random.Generator
Point = Sequence[float]

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


def hair_material(melanin: float, redness: float, roughness: float) -> Any:
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
    """Add an object with the given data block and material."""
    item = bpy.data.objects.new(name, data)
    bpy.context.scene.collection.objects.link(item)
    if surface is not None:
        data.materials.clear()
        data.materials.append(surface)
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
    radius: float
    lean: Point  # what gravity and combing add to a strand at its tip, in strand lengths
    wave: float  # its curl, in strand lengths
    clumps: int  # strands that tips gather around
    clump: float  # by this share of the distance


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
