"""Props and materials for fixed shots: turned and bevelled things, hair on a mesh, wood, plaster, cloth, metal.

Sizes are metres, z is up. Textures sit in the object's own coordinates, so that they go with what moves.
"""

from __future__ import annotations

import math
from collections.abc import Sequence
from itertools import pairwise
from typing import Any

import bpy
import numpy as np
from mathutils import Vector

from hybrid.simulate.things import CUBE, CUBE_FACES, Rng, add_box, add_mesh, add_object, painted_image

Color = tuple[float, float, float]


def node(tree: Any, kind: str, **inputs: Any) -> Any:
    """Add a shader node; `inputs` are values or sockets to link, their names with underscores for blanks.

    Parameters
    ----------
    tree : bpy.types.NodeTree
        Where it is added.
    kind : str
        Its type, as Blender calls it.
    **inputs : object
        Values, or sockets to link, by name.

    Returns
    -------
    bpy.types.Node
    """
    made = tree.nodes.new(f"ShaderNode{kind}")
    for name, value in inputs.items():
        socket = made.inputs[name.replace("_", " ")]
        if isinstance(value, bpy.types.NodeSocket):
            tree.links.new(value, socket)
        else:
            socket.default_value = value
    return made


def plain(name: str, color: Sequence[float], **inputs: Any) -> Any:
    """Make a material of one colour; `inputs` are those of the Principled shader, blanks as underscores.

    Parameters
    ----------
    name : str
        What Blender calls it.
    color : sequence of float
        Linear.
    **inputs : object
        Of the Principled shader, by name.

    Returns
    -------
    bpy.types.Material
    """
    made = bpy.data.materials.new(name)
    made.use_nodes = True
    shader = made.node_tree.nodes["Principled BSDF"]
    shader.inputs["Base Color"].default_value = (*color, 1)
    for key, value in inputs.items():
        shader.inputs[key.replace("_", " ")].default_value = value
    return made


def two_tone(
    name: str,
    dark: Color,
    light: Color,
    *,
    scale: float,
    stretch: Sequence[float] = (1, 1, 1),
    detail: float = 8,
    distortion: float = 0.0,
    edges: tuple[float, float] = (0.35, 0.65),
    bump: float = 0.0,
    roughness: tuple[float, float] = (0.5, 0.5),
    **inputs: Any,
) -> Any:
    """Make a material of noise between two colours, `scale` features a metre, with relief and uneven gloss.

    `stretch` divides the features along the axes: grain and brushing are noise stretched along one of them.

    Parameters
    ----------
    name : str
        What Blender calls it.
    dark : tuple of float
        Linear color.
    light : tuple of float
        Linear color.
    scale : float
        Features a metre.
    stretch : sequence of float
        Divides the features along x, y and z.
    detail : float
        Octaves of the noise.
    distortion : float
        Of the noise.
    edges : (float, float)
        Of the noise, between which one color becomes the other.
    bump : float
        Strength of the relief.
    roughness : (float, float)
        From and to.
    **inputs : object
        Of the Principled shader, by name.

    Returns
    -------
    bpy.types.Material
    """
    made = plain(name, light, **inputs)
    tree = made.node_tree
    shader = tree.nodes["Principled BSDF"]
    where = node(tree, "TexCoord").outputs["Object"]
    mapped = node(tree, "Mapping", Vector=where, Scale=tuple(1 / s for s in stretch)).outputs["Vector"]
    noise = node(tree, "TexNoise", Vector=mapped, Scale=scale, Detail=detail, Roughness=0.6, Distortion=distortion)
    ramp = node(tree, "ValToRGB", Fac=noise.outputs["Fac"])
    for stop, position, tone in zip(ramp.color_ramp.elements, edges, (dark, light), strict=True):
        stop.position, stop.color = position, (*tone, 1)
    tree.links.new(ramp.outputs["Color"], shader.inputs["Base Color"])
    gloss = node(tree, "MapRange", Value=noise.outputs["Fac"], From_Min=0.3, From_Max=0.7, To_Min=roughness[0],
                 To_Max=roughness[1])  # fmt: skip
    tree.links.new(gloss.outputs["Result"], shader.inputs["Roughness"])
    if bump:
        relief = node(tree, "Bump", Height=noise.outputs["Fac"], Strength=1.0, Distance=bump)
        tree.links.new(relief.outputs["Normal"], shader.inputs["Normal"])
    return made


def wood(dark: Color = (0.09, 0.035, 0.012), light: Color = (0.33, 0.16, 0.06), gloss: float = 0.35) -> Any:
    """Make wood with its grain along x.

    Parameters
    ----------
    dark : tuple of float
        Linear color.
    light : tuple of float
        Linear color.
    gloss : float
        Roughness of its surface.

    Returns
    -------
    bpy.types.Material
    """
    return two_tone("wood", dark, light, scale=14, stretch=(14, 1, 1), distortion=1.2, edges=(0.3, 0.7),
                    bump=0.0006, roughness=(gloss + 0.15, gloss - 0.1))  # fmt: skip


def printed(rng: Rng, roughness: float = 0.6) -> Any:
    """Make a material of a painted image: labels, spines, pictures.

    Parameters
    ----------
    rng : numpy.random.Generator
        Where all chance comes from.
    roughness : float
        Of its surface.

    Returns
    -------
    bpy.types.Material
    """
    made = plain("printed", (1, 1, 1), Roughness=roughness)
    tree = made.node_tree
    image = node(tree, "TexImage", Vector=node(tree, "TexCoord").outputs["Generated"])
    image.image, image.projection = painted_image(rng), "BOX"
    tree.links.new(image.outputs["Color"], tree.nodes["Principled BSDF"].inputs["Base Color"])
    return made


def glow(color: Color, strength: float) -> Any:
    """Make a surface that gives light.

    Parameters
    ----------
    color : tuple of float
        Linear.
    strength : float
        Factor on the color.

    Returns
    -------
    bpy.types.Material
    """
    return plain("glow", (0, 0, 0), Emission_Color=(*color, 1), Emission_Strength=strength, Specular_IOR_Level=0)


def bevelled(center: Sequence[float], size: Sequence[float], surface: Any, width: float, name: str = "box") -> Any:
    """Add a box whose edges are rounded by `width`.

    Parameters
    ----------
    center : sequence of float
        Of the box, in metres.
    size : sequence of float
        Of the box along x, y and z, in metres.
    surface : bpy.types.Material
        What it is made of.
    width : float
        Of the rounding, in metres.
    name : str
        What Blender calls it.

    Returns
    -------
    bpy.types.Object
    """
    item = add_mesh(name, np.array(CUBE) * size, CUBE_FACES, surface, smooth=True)
    item.location = center
    bevel = item.modifiers.new("bevel", "BEVEL")
    bevel.width, bevel.segments, bevel.harden_normals = width, 3, True
    return item


def turned(profile: Sequence[tuple[float, float]], surface: Any, segments: int = 72, name: str = "turned") -> Any:
    """Add a thing turned around z, from radii and heights; rounded where its outline bends by less than 35°.

    Parameters
    ----------
    profile : sequence of (float, float)
        Radii and heights, in metres.
    surface : bpy.types.Material
        What it is made of.
    segments : int
        Around the axis.
    name : str
        What Blender calls it.

    Returns
    -------
    bpy.types.Object
    """
    points = np.array(profile, float)
    chord = np.concatenate([[0], np.cumsum(np.maximum(np.linalg.norm(np.diff(points, axis=0), axis=1), 1e-9))])
    fine = np.unique(np.concatenate([np.linspace(a, b, 7) for a, b in pairwise(chord)]))
    # Catmull and Rom's cubic, with chords as parameters: smooth, and through every point.
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
    faces = [
        (i * segments + j, i * segments + (j + 1) % segments, (i + 1) * segments + (j + 1) % segments,
         (i + 1) * segments + j)
        for i in range(len(outline) - 1)
        for j in range(segments)
    ]  # fmt: skip
    item = add_mesh(name, vertices, faces, surface, smooth=True)
    item.data.set_sharp_from_angle(angle=math.radians(35))
    return item


def gear(teeth: int, radius: float, depth: float, surface: Any, spokes: int = 5) -> Any:
    """Add a spoked gear wheel around its own z axis, `radius` that of the middle of its teeth.

    Parameters
    ----------
    teeth : int
        How many.
    radius : float
        Of the middle of its teeth, in metres.
    depth : float
        Along the axis.
    surface : bpy.types.Material
        What it is made of.
    spokes : int
        How many.

    Returns
    -------
    bpy.types.Object
    """
    pitch, tooth = 2 * math.pi / teeth, 2.2 * radius / teeth
    outer = []
    for k in range(teeth):
        for share, out in ((0.0, -1.1), (0.27, -1.1), (0.37, 1.0), (0.63, 1.0), (0.73, -1.1)):
            outer.append(((k + share - 0.5) * pitch, radius + out * tooth / 2))
    windows = []
    inner, rim = 0.32 * radius, radius - 1.6 * tooth
    for k in range(spokes):
        start, end = (k + 0.14) * 2 * math.pi / spokes, (k + 0.86) * 2 * math.pi / spokes
        arc = np.linspace(start, end, 14)
        narrow = np.linspace(start + 0.22, end - 0.22, 8)
        windows.append([(a, rim) for a in arc] + [(a, inner) for a in narrow[::-1]])
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


def wire(points: Sequence[Sequence[float]], radius: float, surface: Any, name: str = "wire") -> Any:
    """Add a round wire through `points`.

    Parameters
    ----------
    points : sequence of points
        In metres.
    radius : float
        Of the wire.
    surface : bpy.types.Material
        What it is made of.
    name : str
        What Blender calls it.

    Returns
    -------
    bpy.types.Object
    """
    data = bpy.data.curves.new(name, "CURVE")
    data.dimensions, data.bevel_depth, data.bevel_resolution, data.use_fill_caps = "3D", radius, 4, True
    spline = data.splines.new("NURBS")
    spline.points.add(len(points) - 1)
    for point, position in zip(spline.points, points, strict=True):
        point.co = (*position, 1)
    spline.use_endpoint_u, spline.order_u, spline.resolution_u = True, 3, 8
    return add_object(name, data, surface)


def curtain(width: float, height: float, folds: int, depth: float, surface: Any) -> Any:
    """Add cloth that hangs in folds, in the plane y = 0 around the origin, its top at `height`.

    Parameters
    ----------
    width : float
        Metres.
    height : float
        Of its top.
    folds : int
        How many.
    depth : float
        Of a fold.
    surface : bpy.types.Material
        What it is made of.

    Returns
    -------
    bpy.types.Object
    """
    across, down = 40 * folds, 24
    x, z = np.meshgrid(np.linspace(-0.5, 0.5, across), np.linspace(0, 1, down))
    y = np.sin(2 * math.pi * folds * (x + 0.015 * np.sin(9 * x + 2 * z)) + 0.6 * np.sin(5 * x))
    y = depth * (0.55 + 0.45 * z) * (y + 0.25 * np.sin(2 * math.pi * folds * 2.3 * x + 3 * z))
    vertices = np.stack([x * width, y, (1 - z) * height], axis=-1).reshape(-1, 3)
    k = (np.arange(down - 1)[:, None] * across + np.arange(across - 1)).ravel()
    return add_mesh("curtain", vertices, np.stack([k, k + 1, k + across + 1, k + across], -1), surface, smooth=True)


def leaf_shape(length: float, width: float, surface: Any) -> Any:
    """Add a leaf along x from the origin, folded a little along its middle and bent down.

    Parameters
    ----------
    length : float
        Metres.
    width : float
        Metres.
    surface : bpy.types.Material
        What it is made of.

    Returns
    -------
    bpy.types.Object
    """
    along, across = np.meshgrid(np.linspace(0, 1, 15), np.linspace(-1, 1, 7), indexing="ij")
    half = width / 2 * np.sin(math.pi * along**0.8) * (1 - 0.15 * along)
    x, y = along * length, across * half
    z = 0.25 * np.abs(y) - 0.35 * length * along**2 + 0.01 * length * np.sin(22 * along) * np.abs(across)
    k = (np.arange(14)[:, None] * 7 + np.arange(6)).ravel()
    return add_mesh("leaf", np.stack([x, y, z], -1).reshape(-1, 3), np.stack([k, k + 1, k + 8, k + 7], -1), surface,
                    smooth=True)  # fmt: skip


def fur(
    rng: Rng,
    item: Any,
    strands: int,
    length: float,
    surface: Any,
    *,
    radius: float = 0.00004,
    lean: Sequence[float] = (0, 0, -0.6),
    wave: float = 0.25,
    clumps: int = 400,
    clump: float = 0.5,
) -> Any:
    """Cover a mesh with hair that is its child and goes with it.

    Parameters
    ----------
    rng : numpy.random.Generator
        Where strands stand, how long they are and how they curl.
    item : bpy.types.Object
        A mesh object, as its modifiers leave it.
    strands : int
        How many.
    length : float
        Of a strand, in metres.
    surface : bpy.types.Material
        What it is made of.
    radius : float
        Of a strand, in metres.
    lean : sequence of float
        What gravity and combing add to the way of a strand, in lengths, at its tip.
    wave : float
        How much a strand curls, in lengths.
    clumps : int
        Tips gather around so many strands.
    clump : float
        By this share of the way.

    Returns
    -------
    bpy.types.Object
        The hair.
    """
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
    points = 8
    t = np.linspace(0, 1, points)[None, :, None]
    long = length * rng.uniform(0.6, 1.1, (strands, 1, 1))
    way = out + 0.25 * rng.standard_normal((strands, 3))
    curl, phase = rng.standard_normal((strands, 1, 3)), rng.uniform(0, 2 * math.pi, (strands, 1, 1))
    path = root[:, None] + long * (t * way[:, None] + t**2 * np.array(lean, float))
    path = path + long * wave * t * curl * np.sin(5 * t + phase) * 0.5
    leaders = path[rng.choice(strands, clumps, replace=False)]
    # The nearest leader, a block of strands at a time: the matrix of all distances would be large.
    nearest = np.concatenate(
        [((block[:, None] - leaders[None, :, 0]) ** 2).sum(-1).argmin(axis=1) for block in np.array_split(root, 40)]
    )
    path += clump * t**1.5 * (leaders[nearest] - path)
    data = bpy.data.hair_curves.new("fur")
    data.add_curves([points] * strands)
    data.position_data.foreach_set("vector", path.astype(np.float32).ravel())
    taper = np.broadcast_to(radius * np.linspace(1, 0.25, points), (strands, points))
    data.attributes.new("radius", "FLOAT", "POINT").data.foreach_set("value", taper.astype(np.float32).ravel())
    made = add_object("fur", data, surface)
    made.parent = item
    return made


def hair_material(melanin: float, redness: float, roughness: float = 0.3) -> Any:
    """Make Cycles' own hair, coloured by its pigments.

    Parameters
    ----------
    melanin : float
        How dark, in [0, 1].
    redness : float
        How red, in [0, 1].
    roughness : float
        Of the hair.

    Returns
    -------
    bpy.types.Material
    """
    made = bpy.data.materials.new("hair")
    made.use_nodes = True
    tree = made.node_tree
    tree.nodes.remove(tree.nodes["Principled BSDF"])
    shader = node(tree, "BsdfHairPrincipled")
    shader.parametrization = "MELANIN"
    values = {"Melanin": melanin, "Melanin Redness": redness, "Roughness": roughness, "Random Color": 0.35}
    for name, value in values.items():
        shader.inputs[name].default_value = value
    tree.links.new(shader.outputs[0], tree.nodes["Material Output"].inputs["Surface"])
    return made


def fill_with_smoke(
    frames: range,
    center: Sequence[float],
    size: Sequence[float],
    density: tuple[float, float],
    scale: float,
    forward: float,
) -> None:
    """Fill a box with smoke that drifts upwards, from thin to thick, `density` per metre, `scale` clouds a metre.

    `forward` is the mean cosine of its phase. It keeps out of the way of `ray_cast`, which sees surfaces only.

    Parameters
    ----------
    frames : range
        Of the shot.
    center : sequence of float
        Of the box, in metres.
    size : sequence of float
        Of the box along x, y and z, in metres.
    density : (float, float)
        Per metre, from thin to thick.
    scale : float
        Clouds a metre.
    forward : float
        Mean cosine of its phase.
    """
    surface = bpy.data.materials.new("smoke")
    surface.use_nodes = True
    tree = surface.node_tree
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
    add_box(center, size, surface, "smoke").hide_set(True)


def bottle(kind: int, surface: Any, label: Any = None) -> Any:
    """Add one of five bottles, some 0.3 high, standing on the origin, with a label if given.

    Parameters
    ----------
    kind : int
        Which of five.
    surface : bpy.types.Material
        What it is made of.
    label : bpy.types.Material, optional
        Of the label; none without.

    Returns
    -------
    bpy.types.Object
    """
    profiles = (
        [(0, 0), (0.036, 0), (0.037, 0.01), (0.037, 0.19), (0.016, 0.235), (0.014, 0.30), (0.016, 0.31), (0, 0.312)],
        [(0, 0), (0.042, 0), (0.044, 0.02), (0.044, 0.14), (0.03, 0.18), (0.014, 0.2), (0.013, 0.26), (0.017, 0.265),
         (0, 0.27)],
        [(0, 0), (0.03, 0), (0.032, 0.01), (0.038, 0.1), (0.034, 0.17), (0.013, 0.25), (0.012, 0.33), (0, 0.335)],
        [(0, 0), (0.05, 0), (0.055, 0.04), (0.05, 0.09), (0.022, 0.13), (0.013, 0.16), (0.012, 0.21), (0.02, 0.22),
         (0, 0.225)],
        [(0, 0), (0.033, 0), (0.033, 0.005), (0.033, 0.2), (0.03, 0.215), (0.014, 0.225), (0.014, 0.27), (0, 0.275)],
    )  # fmt: skip
    item = turned(profiles[kind], surface, 40, "bottle")
    if label is not None:
        radius = max(r for r, _ in profiles[kind]) + 0.0006
        band = turned([(radius, 0.05), (radius, 0.13)], label, 40, "label")
        band.parent = item
    return item


def place(item: Any, location: Sequence[float], turn: Sequence[float] = (0, 0, 0), size: float = 1.0) -> Any:
    """Put an item somewhere, turned and sized.

    Parameters
    ----------
    item : bpy.types.Object
        What is meant.
    location : sequence of float
        Metres.
    turn : sequence of float
        Radians around x, y and z.
    size : float
        Factor.

    Returns
    -------
    bpy.types.Object
    """
    item.location, item.rotation_euler, item.scale = Vector(location), turn, (size,) * 3
    return item
