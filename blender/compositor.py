"""Put the denoised frames into a scene's compositor, find them there again, and tell what Render Animation writes."""

from collections.abc import Iterator
from contextlib import suppress
from pathlib import Path

import bpy

from . import frames, scenes

LABEL = "Denoised"  # of our image nodes; what identifies them, their property, also holds their view layer
OURS = "ravg"
_NAMES = {"Image": "Combined"}  # socket of a Render Layers node → socket of an Image node, where they differ
_LAYER = {"IMAGE": "layer", "CRYPTOMATTE_V2": "layer_name"}  # types of our nodes → property of their layer
_ENDS = ("GROUP_OUTPUT", "COMPOSITE", "OUTPUT_FILE")  # types of nodes that write or return an image


def add(scene: bpy.types.Scene, image: bpy.types.Image, count: int) -> None:
    """Replace the scene's Render Layers nodes by the denoised frames; nodes of ours that exist are used again.

    Cryptomatte nodes read their mattes from the same files.
    A Render Layers node that has no links left is muted: Blender then composites without rendering the scene again.
    Where no node leads to an output that is free, the denoised frames are linked to it. ValueError for a scene in
    stereo, or if nothing reads the frames in the end.
    """
    if scene.render.use_multiview:
        raise ValueError(scenes.STEREO)
    tree = _tree(scene)
    scene.render.use_compositing = True
    repoint(scene, image, count)
    for render in list(_render_layers(scene)):
        node = _node(render.id_data, render.layer, scene, image, count)
        node.location = render.location.x, render.location.y - 50.0
        for link in [link for output in render.outputs for link in output.links]:
            name = link.from_socket.name
            if (output := node.outputs.get(_NAMES.get(name, name))) is not None:
                render.id_data.links.new(output, link.to_socket)
        render.mute = not any(output.is_linked for output in render.outputs)
    for _, node in list(scenes.nodes(scene)):
        if node.type == "CRYPTOMATTE_V2" and node.source == "RENDER" and node.scene in (None, scene):
            _show(node, node.layer_name, scene, image, count)
    if not any(_is_read(node) for node in _ours(scene)) and (end := _free_end(tree)) is not None:
        tree.links.new(_node(tree, "", scene, image, count).outputs["Combined"], end)
    if not any(_is_read(node) for node in _ours(scene)):
        raise ValueError(f"nothing reads the node {LABEL}: link it to the compositor's output")


def repoint(scene: bpy.types.Scene, image: bpy.types.Image, count: int) -> None:
    """Let our nodes show the frames in `image`, as links and layers are."""
    for node in _ours(scene):
        layer = getattr(node, _LAYER[node.type]) if node.has_layers else ""
        layer = layer or node.get(OURS, "")  # unknown where the file is gone
        _show(node, layer, scene, image, count)


def repoint_lost(scene: bpy.types.Scene) -> None:
    """Let our nodes whose files are gone, as in a folder that was moved, show the scene's denoised frames if any."""
    lost = [node for node in _ours(scene) if node.image is None or not _file(node.image).is_file()]
    if lost and scenes.denoised_frames(scene):
        repoint(scene, *scenes.load_denoised(scene))


def problems(scene: bpy.types.Scene) -> Iterator[scenes.Problem]:
    """Yield why Render Animation would not write the denoised frames that the compositor is to show."""
    if not (shown := [node for node in _ours(scene) if _is_read(node)]) or not scenes.is_placed(scene):
        return
    for node in shown:
        first, last = node.frame_start, node.frame_start + node.frame_duration - 1
        if node.image is None or not scenes.is_denoised(scene, _file(node.image)):
            folder = scenes.output_folder(scene)
            yield scenes.Problem(f"The compositor does not show the frames in {folder}: Add to Compositor", False)
            return
        if first > scene.frame_start or last < scene.frame_end or node.frame_offset != first - 1:
            text = f"The compositor shows frames {first}-{last}, the scene has others: Add to Compositor"
            yield scenes.Problem(text, False)
            return
    if missing := set(scenes.frame_numbers(scene)) - scenes.denoised_frames(scene).keys():
        text = f"Frames {frames.ranges(missing)} are not denoised: the movie is transparent there, Denoise Frames"
        yield scenes.Problem(text, False)


def movie(scene: bpy.types.Scene) -> str:
    """Return in one line what Render Animation writes; empty before frames are denoised."""
    if not scenes.denoised_frames(scene):
        return ""
    if not any(_is_read(node) for node in _ours(scene)):
        return "Render Animation renders the noisy scene"
    if not scene.render.use_compositing or not getattr(scene, "use_nodes", True):
        return "Render Animation renders the noisy scene: Compositing is off"
    if any(_is_read(node) for node in _render_layers(scene)):
        return "Render Animation renders the scene again, too: Render Layers is linked"
    return "Render Animation writes the denoised frames"


def _ours(scene: bpy.types.Scene) -> list[bpy.types.Node]:
    """The nodes that show denoised frames, within groups too."""
    return [node for _, node in scenes.nodes(scene) if node.type in _LAYER and (OURS in node or _is_old(node))]


def _is_old(node: bpy.types.Node) -> bool:
    """Whether an earlier version has made a node."""
    return node.type == "IMAGE" and node.label == LABEL and node.image is not None and node.image.source == "SEQUENCE"


def _render_layers(scene: bpy.types.Scene) -> Iterator[bpy.types.Node]:
    """The nodes that render the scene."""
    for _, node in scenes.nodes(scene):
        if node.type == "R_LAYERS" and node.scene in (None, scene) and not node.mute:
            yield node


def _is_read(node: bpy.types.Node) -> bool:
    """Whether links lead from a node to an output."""
    found, seen = [node], set()
    while found:
        links = [link for output in found.pop().outputs for link in output.links]
        if any(link.to_node.type in _ENDS for link in links):
            return True
        found += [link.to_node for link in links if link.to_node.name not in seen]
        seen |= {link.to_node.name for link in links}
    return False


def _free_end(tree: bpy.types.NodeTree) -> bpy.types.NodeSocket | None:
    """The input of the compositor's output, or of the reroute before it, if nothing is linked to it."""
    end = next((node.inputs[0] for node in tree.nodes if node.type in _ENDS[:2]), None)
    while end is not None and end.is_linked:
        source = end.links[0].from_node
        end = source.inputs[0] if source.type == "REROUTE" else None  # Blender 4.5 begins with one
    return end


def _node(
    tree: bpy.types.NodeTree, layer: str, scene: bpy.types.Scene, image: bpy.types.Image, count: int
) -> bpy.types.Node:
    """Our node of a view layer in a tree, of the first one without a name, made if missing."""
    for node in _ours(scene):
        if node.id_data == tree and node.type == "IMAGE" and (not layer or not node.has_layers or node.layer == layer):
            return node
    node = tree.nodes.new("CompositorNodeImage")
    node.label = LABEL
    _show(node, layer, scene, image, count)
    return node


def _show(node: bpy.types.Node, layer: str, scene: bpy.types.Scene, image: bpy.types.Image, count: int) -> None:
    """Let a node show a layer of the image; the first one if it has none of that name."""
    if node.type == "CRYPTOMATTE_V2":
        node.source = "IMAGE"
    node.image, node[OURS] = image, layer
    with suppress(TypeError):  # no such layer, or no layers at all
        setattr(node, _LAYER[node.type], layer)
    scenes.show_from(node, scene, count)


def _file(image: bpy.types.Image) -> Path:
    return scenes.absolute(image.filepath)


def _tree(scene: bpy.types.Scene) -> bpy.types.NodeTree:
    """The node tree of the scene's compositor, made if missing."""
    if not hasattr(scene, "compositing_node_group"):  # before Blender 5.0
        scene.use_nodes = True
        return scene.node_tree
    if scene.compositing_node_group is None:
        tree = bpy.data.node_groups.new("Compositor", "CompositorNodeTree")
        tree.interface.new_socket("Image", in_out="OUTPUT", socket_type="NodeSocketColor")
        tree.nodes.new("NodeGroupOutput").location = 400.0, 0.0
        scene.compositing_node_group = tree
    return scene.compositing_node_group
