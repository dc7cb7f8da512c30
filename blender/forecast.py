"""The time that denoising will take, stated before it starts: by the rate of earlier runs on this machine."""

import json
import os
from pathlib import Path

import bpy

from . import frames, scenes, settings

_RATES = "rates.json"  # preset → seconds per frame of a million pixels
_UNITS = ((5400, 3600, "hours"), (90, 60, "minutes"), (0, 1, "seconds"))  # from how many seconds, and their length


def line(scene: bpy.types.Scene) -> str:
    """Return in one line how many frames are denoised, for how long, and from which first pass."""
    count, source = len(scenes.frame_numbers(scene)), f"from {_first_pass(scene)}"
    if (each := seconds_per_frame(scene)) is None:
        return f"{count} frames {source}; the first run measures the time"
    return f"{count} frames, about {duration(each)} each, {duration(each * count)}, {source}"


def duration(seconds: float) -> str:
    """Format a time as one number, ``17 minutes``."""
    _, length, name = next(unit for unit in _UNITS if seconds >= unit[0])
    return f"{seconds / length:.2g} {name}" if seconds < 10 * length else f"{seconds / length:.0f} {name}"


def seconds_per_frame(scene: bpy.types.Scene) -> float | None:
    """The time of a frame with the scene's preset and resolution; None before the first run."""
    rate = _read().get(_kind(scene))
    return None if rate is None else rate * _megapixels(scene)


def learn(scene: bpy.types.Scene, seconds: float) -> None:
    """Note the time that a frame took."""
    rates = {**_read(), _kind(scene): seconds / _megapixels(scene)}
    path = _path()
    path.parent.mkdir(parents=True, exist_ok=True)
    new = path.with_suffix(".new")
    new.write_text(json.dumps(rates), encoding="utf-8")
    os.replace(new, path)


def _first_pass(scene: bpy.types.Scene) -> str:
    """The source of the first pass, by the first noisy frame, else by the settings that it will be rendered with."""
    denoised = scene.render.engine == "CYCLES" and scene.cycles.use_denoising
    if path := next(iter(scenes.rendered_files(scene).values()), None):
        denoised = frames.is_denoised_too(path)
    return "Blender's denoised frames" if denoised else "noisy frames"


def _kind(scene: bpy.types.Scene) -> str:
    return f"{scene.ravg.preset}{' light passes' if scene.ravg.light_passes else ''}"


def _megapixels(scene: bpy.types.Scene) -> float:
    render = scene.render
    return render.resolution_x * render.resolution_y * (render.resolution_percentage / 100) ** 2 / 1e6


def _path() -> Path:
    return settings.home() / _RATES


def _read() -> dict[str, float]:
    try:
        found = json.loads(_path().read_text(encoding="utf-8"))
    except (OSError, ValueError):  # none yet, or not ours
        return {}
    return {kind: rate for kind, rate in found.items() if isinstance(rate, float)} if isinstance(found, dict) else {}
