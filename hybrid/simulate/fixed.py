"""Fixed shots, the same whatever the seed: `validation:NAME` to choose by, `test:NAME` to judge on."""

from __future__ import annotations

from typing import Any

import bpy
import numpy as np

from hybrid.simulate import evaluation, validation
from hybrid.simulate.motion import MARGIN, set_crop
from hybrid.simulate.shot import ShotSettings
from hybrid.simulate.things import add_object

SHOTS = {"validation": validation.SHOTS, "test": evaluation.SHOTS}


def fixed_shot(shot: ShotSettings) -> dict[str, Any]:
    """Build the shot that `shot.scene` names, `validation:NAME` or `test:NAME`; return its description."""
    kind, _, name = shot.scene.partition(":")
    bpy.ops.wm.read_factory_settings(use_empty=True)
    scene = bpy.context.scene
    scene.frame_start, scene.frame_end = shot.frames[0] - MARGIN, shot.frames[-1] + MARGIN
    film, center = shot.film or shot.size, shot.center or (0.5, 0.5)
    scene.render.resolution_x, scene.render.resolution_y = film
    scene.camera = add_object("camera", bpy.data.cameras.new("camera"), None)
    frames = range(scene.frame_start, scene.frame_end + 1)
    # What is drawn at random in a scene is the same whatever the seed of the samples.
    SHOTS[kind][name](np.random.default_rng(7), frames)
    set_crop(scene.render, film, shot.size, center)
    scene.frame_set(shot.frames[len(shot.frames) // 2])
    return {kind: name, "film": list(film), "center": list(center)}
