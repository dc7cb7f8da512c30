"""Scenes from TOML files of the folder ``shots``: all that is neither drawn at random nor computed.

A file has `materials` by name, `outlines` for lathes, `parts`, `lamps`, a `world` and a `camera`. The keys of a
material say its kind: `grain` (wood), `glow`, `glass`, `dark` and `light` (`two_tone`), or `color`. A part is a
`lathe`, a `sphere` (radius, points), a `box` (with a `bevel`), a `wire` or nothing but a parent of others, at a place,
with a motion. Other keys are parameters of functions in `hybrid.simulate.scene_assets` and `hybrid.simulate.motion`.
"""

import tomllib
from importlib.resources import files
from typing import Any

from hybrid.simulate import scene_assets as assets
from hybrid.simulate.motion import aim_camera, key_motion, key_swing


class SceneFile:
    """The scene of a file in Blender, with keys at `frames`: its materials, outlines and parts by name."""

    def __init__(self, name: str, frames: range) -> None:
        data = tomllib.loads((files("hybrid.simulate") / "shots" / f"{name}.toml").read_text(encoding="utf-8"))
        self.frames = frames
        self.materials = {key: make_material(key, values) for key, values in data["materials"].items()}
        self.outlines = data.get("outlines", {})
        self.parts: dict[str, Any] = {}
        if "world" in data:
            light_by_image(**data["world"])
        for part in data.get("parts", ()):
            self._add_part(part)
        for lamp in data.get("lamps", ()):
            self._add_lamp(**lamp)
        self._aim(**data["camera"])

    def _add_part(self, part: dict[str, Any]) -> None:
        name, surface = part["name"], self.materials.get(part.get("material", ""))
        if "bevel" in part:
            item = assets.bevelled((0, 0, 0), part["box"], surface, part["bevel"], name)
        elif "box" in part:
            item = assets.add_box((0, 0, 0), part["box"], surface, name)
        elif "wire" in part:
            item = assets.wire(part["wire"], part["radius"], surface, name)
        elif "lathe" in part or "sphere" in part:
            outline = part["lathe"] if "lathe" in part else assets.sphere_profile(*part["sphere"])
            item = assets.lathe(name, outline, surface, segments=part.get("segments", 72))
        else:
            item = assets.add_object(name, None)
        parent = self.parts.get(part.get("parent", ""))
        assets.place(item, part.get("at", (0, 0, 0)), part.get("turn", (0, 0, 0)), parent=parent)
        item.scale = part.get("scale", (1, 1, 1))
        self._move(item, part)
        self.parts[name] = item

    def _move(self, item: Any, motion: dict[str, Any]) -> None:
        if "swing" in motion:
            key_swing(item, self.frames, *motion["swing"])
        if "velocity" in motion or "spin" in motion:
            key_motion(item, self.frames, motion.get("velocity", (0, 0, 0)), motion.get("spin", (0, 0, 0)))

    def _add_lamp(self, kind: str, **lamp: Any) -> None:
        item = assets.add_lamp(kind, *(lamp.pop(key) for key in ("at", "power", "size", "target", "tint")))
        self._move(item, lamp)
        for key in lamp.keys() - {"spin"}:
            setattr(item.data, key, lamp[key])

    def _aim(self, eye: Any, focus: Any, lens: float, **camera: Any) -> None:
        item = aim_camera(eye, focus, lens)
        item.data.clip_start = camera.get("near", item.data.clip_start)
        item.data.dof.use_dof = "dof" in camera
        for key, value in camera.get("dof", {}).items():
            setattr(item.data.dof, key, value)
        self._move(item, camera)


def make_material(name: str, values: dict[str, Any]) -> Any:
    if "grain" in values:
        return assets.wood(*values.pop("grain"), **values)
    if "glow" in values:
        return assets.glow(values["glow"], values["strength"])
    if "glass" in values:
        return assets.plain(name, values["glass"], Roughness=0, Transmission_Weight=1, IOR=values["ior"])
    return assets.two_tone(name, **values) if "dark" in values else assets.plain(name, **values)


def light_by_image(image: str = "", strength: float = 0.0, turn: float = 0.0) -> None:
    """Light the scene by one of Blender's environment images, turned around z; not at all without one."""
    world = assets.new_world()
    tree = world.node_tree
    background = tree.nodes["Background"]
    background.inputs["Strength"].default_value = strength
    if image:
        assets.sample_image_coarsely(world)
        generated = assets.node(tree, "TexCoord").outputs["Generated"]
        where = assets.node(tree, "Mapping", Vector=generated, Rotation=(0, 0, turn))
        texture = assets.node(tree, "TexEnvironment", Vector=where.outputs[0])
        texture.image = assets.studio_light(image)
        tree.links.new(texture.outputs["Color"], background.inputs["Color"])
