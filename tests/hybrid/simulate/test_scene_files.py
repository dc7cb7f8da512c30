"""The files of the fixed shots, and what is made of them in Blender."""

import importlib.util
import tomllib
from pathlib import Path

import pytest

from hybrid.simulate.shot import FIXED

ROOT = Path(__file__).parents[3]


@pytest.mark.parametrize("name", [name for names in FIXED.values() for name in names])
def test_a_fixed_shot_has_a_file_whose_parts_have_their_materials_and_parents(name):
    scene = tomllib.loads((ROOT / "hybrid" / "simulate" / "shots" / f"{name}.toml").read_text(encoding="utf-8"))
    assert {"eye", "focus", "lens"} <= scene["camera"].keys()
    known: set[str] = set()
    for part in scene.get("parts", ()):
        assert part.get("material") in {None, *scene["materials"]}
        assert part.get("parent") in {None, *known}
        known.add(part["name"])


@pytest.mark.cycles
@pytest.mark.skipif(importlib.util.find_spec("bpy") is None, reason="bpy is not installed")
def test_a_file_makes_parts_with_motion_a_world_and_a_camera():
    import bpy

    from hybrid.simulate.scene_assets import add_object
    from hybrid.simulate.scene_files import SceneFile

    bpy.ops.wm.read_factory_settings(use_empty=True)
    scene = bpy.context.scene
    scene.camera = add_object("camera", bpy.data.cameras.new("camera"))
    made = SceneFile("lens", range(1, 8))
    assert made.parts["top"].data.materials[0] == made.materials["brass"]
    assert tuple(made.parts["spoon"].scale) == pytest.approx((0.016, 0.004, 0.026))
    places = []
    for frame in (1, 7):
        scene.frame_set(frame)
        places.append(made.parts["marble"].location.y)
    assert places[1] - places[0] == pytest.approx(6 * 0.008)
    assert scene.world.node_tree.nodes["Background"].inputs["Strength"].default_value == pytest.approx(0.6)
    data = scene.camera.data
    assert (data.lens, data.dof.aperture_blades, data.dof.use_dof) == (26, 7, True)
    SceneFile("shadow", range(1, 8))
    scene.frame_set(4)
    pendulum = bpy.data.objects["pendulum"]
    assert bpy.data.objects["bob"].parent == pendulum
    assert pendulum.rotation_euler.y == pytest.approx(0.35 * 0.29552, rel=1e-3)
