"""A picture of each effect, with it and without: `python benchmarks/effect_pictures.py SHEET.jpg --spp 96`.

Crops of the validation shots. Needs bpy; some minutes.
"""

from __future__ import annotations

import argparse
import sys
import tempfile
from collections.abc import Callable
from pathlib import Path
from typing import Any

import cv2
import numpy as np

SIZE, FILM = (160, 120), (480, 270)


def hide(scene: Any, *names: str, keep: int = 0) -> None:
    """Leave out the objects whose names begin so; of every `keep`, one stays."""
    found = sorted((item for item in scene.objects if item.name.startswith(names)), key=lambda item: str(item.name))
    for number, item in enumerate(found):
        item.hide_render = not keep or number % keep != 0


def shader(name: str) -> Any:
    """Return the Principled shader of a material."""
    import bpy

    return bpy.data.materials[name].node_tree.nodes["Principled BSDF"]


def opaque(scene: Any) -> None:
    """Leave the leaves uncut."""
    import bpy

    tree = bpy.data.materials["leaf"].node_tree
    tree.links.remove(shader("leaf").inputs["Alpha"].links[0])


def firm(scene: Any) -> None:
    """Let no light into the wax."""
    shader("wax").inputs["Subsurface Weight"].default_value = 0


def dim(scene: Any) -> None:
    """Leave a tenth of the sky."""
    scene.world.node_tree.nodes["Background"].inputs["Strength"].default_value /= 10


# Name, shot, centre of the crop, and what takes the effect away.
EFFECTS: list[tuple[str, str, tuple[float, float], Callable[[Any], Any]]] = [
    ("motion blur", "garden", (0.62, 0.45), lambda s: setattr(s.render, "use_motion_blur", False)),
    ("depth of field", "table", (0.75, 0.6), lambda s: setattr(s.camera.data.dof, "use_dof", False)),
    ("glass, caustics", "table", (0.2, 0.75), lambda s: setattr(s.cycles, "caustics_refractive", False)),
    ("subsurface", "table", (0.55, 0.4), firm),
    ("hair", "table", (0.8, 0.55), lambda s: hide(s, "fur")),
    ("volume", "night", (0.5, 0.4), lambda s: hide(s, "fog")),
    ("transparency", "garden", (0.27, 0.45), opaque),
    ("sky", "garden", (0.5, 0.4), dim),
    ("many lights", "night", (0.3, 0.5), lambda s: hide(s, "point", keep=12)),
    ("indirect light", "table", (0.3, 0.4), lambda s: setattr(s.cycles, "max_bounces", 0)),
]  # fmt: skip


def render(spp: int, effect: tuple[str, str, tuple[float, float], Callable[[Any], Any]], on: bool) -> np.ndarray:
    """Return a crop as sRGB, (H, W, 3) uint8, blue first."""
    import bpy

    from hybrid.simulate import cycles
    from hybrid.simulate.shot import ShotSettings

    name, place, center, off = effect
    shot = ShotSettings(f"validation:{place}", 1, (4,), SIZE, {"n": spp}, film=FILM, center=center, motion_blur=True)
    cycles.build(shot, 0, 1)
    scene = bpy.context.scene
    cycles.apply(scene, {**dict.fromkeys(cycles.PASSES, False), "render.use_motion_blur": True})
    if not on:
        off(scene)
    with tempfile.TemporaryDirectory() as folder:
        path = Path(folder) / "picture.exr"
        cycles.render_frame(scene, path, spp, 1)
        channels = cycles.read_channels(path)[1]
    linear = np.stack([channels[f"ViewLayer.Combined.{c}"] for c in "BGR"], axis=-1).astype(np.float32).clip(0)
    encoded = np.where(linear < 0.0031308, 12.92 * linear, 1.055 * np.maximum(linear, 0.0031308) ** (1 / 2.4) - 0.055)
    picture = np.ascontiguousarray((encoded.clip(0, 1) * 255).astype(np.uint8))
    cv2.rectangle(picture, (0, SIZE[1] - 15), (SIZE[0], SIZE[1]), (0, 0, 0), -1)
    text = name if on else "without"
    cv2.putText(picture, text, (4, SIZE[1] - 4), cv2.FONT_HERSHEY_SIMPLEX, 0.4, (255, 255, 255), 1, cv2.LINE_AA)
    return picture


def main() -> int:
    parser = argparse.ArgumentParser(description=__doc__.split("\n")[0])
    parser.add_argument("sheet", type=Path)
    parser.add_argument("--spp", type=int, default=96)
    options = parser.parse_args()
    pairs = [np.hstack([render(options.spp, effect, on) for on in (True, False)]) for effect in EFFECTS]
    rows = [np.hstack(pairs[k : k + 2]) for k in range(0, len(pairs), 2)]
    cv2.imwrite(str(options.sheet), np.vstack(rows), [cv2.IMWRITE_JPEG_QUALITY, 85])
    return 0


if __name__ == "__main__":
    sys.path.insert(0, str(Path(__file__).parents[1]))
    raise SystemExit(main())
