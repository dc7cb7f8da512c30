"""Put the denoised frames into a scene's compositor."""

import bpy

from . import scenes

_NAMES = {"Image": "Combined"}  # socket of a Render Layers node → socket of an Image node, where they differ


def add(scene: bpy.types.Scene, image: bpy.types.Image, count: int) -> None:
    """Replace the scene's Render Layers nodes by the denoised frames; ValueError for a scene in stereo.

    A Render Layers node that has no links left is muted: Blender then composites without rendering the scene again.
    Without such nodes, the denoised frames become the output of an empty compositor.
    """
    if scene.render.use_multiview:
        raise ValueError(scenes.STEREO)
    tree = _tree(scene)
    rendered = [x for x in tree.nodes if x.type == "R_LAYERS" and x.scene in (None, scene) and not x.mute]
    for render in rendered:
        node = _node(tree, scene, image, count)
        node.location = render.location.x, render.location.y - 50.0
        if node.has_layers:
            node.layer = render.layer
        for link in [link for output in render.outputs for link in output.links]:
            name = link.from_socket.name
            if (output := node.outputs.get(_NAMES.get(name, name))) is not None:
                tree.links.new(output, link.to_socket)
        render.mute = not any(output.is_linked for output in render.outputs)
    if not rendered:
        node = _node(tree, scene, image, count)
        end = next((x for x in tree.nodes if x.type in ("GROUP_OUTPUT", "COMPOSITE")), None)
        if end is not None and not end.inputs[0].is_linked:
            tree.links.new(node.outputs["Combined"], end.inputs[0])


def _node(tree: bpy.types.NodeTree, scene: bpy.types.Scene, image: bpy.types.Image, count: int) -> bpy.types.Node:
    """Add an image node that shows the denoised frames."""
    node = tree.nodes.new("CompositorNodeImage")
    node.image, node.label = image, "Denoised"
    scenes.show_from(node, scene, count)
    return node


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
