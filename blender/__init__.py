"""ravg in Blender: set up the passes, render, denoise with the installed command, and load the result."""

import bpy

from . import jobs, operators, panel, settings

CLASSES = (
    settings.Preferences,
    settings.SceneSettings,
    operators.SetUp,
    operators.Denoise,
    operators.Cancel,
    operators.Conclude,
    operators.Show,
    operators.AddToCompositor,
    panel.OutputPanel,
)


def register() -> None:
    for cls in CLASSES:
        bpy.utils.register_class(cls)
    bpy.types.Scene.ravg = bpy.props.PointerProperty(type=settings.SceneSettings)
    bpy.app.handlers.load_pre.append(jobs.stop_current)


def unregister() -> None:
    jobs.stop_current()
    bpy.app.handlers.load_pre.remove(jobs.stop_current)
    del bpy.types.Scene.ravg
    for cls in reversed(CLASSES):
        bpy.utils.unregister_class(cls)
