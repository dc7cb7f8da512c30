"""Fixed shots, the same for every seed: `validation:NAME` to validate with, `test:NAME` to test on."""

from __future__ import annotations

from typing import Any

import bpy
import numpy as np

from hybrid.simulate import evaluation, validation
from hybrid.simulate.motion import set_crop
from hybrid.simulate.scene_assets import add_object
from hybrid.simulate.shot import ShotSettings

SHOTS = {"validation": validation.SHOTS, "test": evaluation.SHOTS}


def fixed_shot(shot: ShotSettings) -> dict[str, Any]:
    """Build the shot that `shot.scene` names; return its description."""
    kind, _, name = shot.scene.partition(":")
    bpy.ops.wm.read_factory_settings(use_empty=True)
    scene = bpy.context.scene
    scene.frame_start, scene.frame_end = shot.keyed[0], shot.keyed[-1]
    film, center = shot.film or shot.size, shot.center or (0.5, 0.5)
    scene.render.resolution_x, scene.render.resolution_y = film
    scene.camera = add_object("camera", bpy.data.cameras.new("camera"))
    # Not `shot.keyed`: Blender's frame_start is never below 0, and the shots are built around the middle of this range.
    frames = range(scene.frame_start, scene.frame_end + 1)
    SHOTS[kind][name](np.random.default_rng(7), frames)  # the shot's seed is that of the samples alone
    set_crop(scene.render, film, shot.size, center)
    scene.frame_set(shot.middle)
    return {kind: name, "film": list(film), "center": list(center)}
