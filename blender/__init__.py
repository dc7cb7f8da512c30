"""ravg in Blender: set up passes, render, denoise with the installed command, and load the result."""

import bpy

from . import jobs, operators, panel, settings, terminal

CLASSES = (
    settings.Preferences,
    settings.SceneSettings,
    operators.SetUp,
    operators.Denoise,
    operators.Install,
    operators.Cancel,
    operators.Conclude,
    operators.Show,
    operators.Compare,
    operators.AddToCompositor,
    panel.OutputPanel,
)
HANDLERS = (
    ("load_pre", jobs.stop_current),
    ("load_pre", jobs.end_viewer),
    ("load_post", jobs.restore_all),
    ("save_pre", jobs.make_relative),
    ("render_init", jobs.protect),
    ("render_write", jobs.count_written),
    ("render_complete", jobs.completed),
    ("render_cancel", jobs.cancelled),
)
_command = []  # the handle that unregisters the command line


def register() -> None:
    for cls in CLASSES:
        bpy.utils.register_class(cls)
    bpy.types.Scene.ravg = bpy.props.PointerProperty(type=settings.SceneSettings)
    for name, handler in HANDLERS:
        getattr(bpy.app.handlers, name).append(handler)
    _command.append(bpy.utils.register_cli_command(terminal.NAME, terminal.run))


def unregister() -> None:
    jobs.stop_current()
    jobs.end_viewer()
    bpy.utils.unregister_cli_command(_command.pop())
    for name, handler in HANDLERS:
        getattr(bpy.app.handlers, name).remove(handler)
    del bpy.types.Scene.ravg
    for cls in reversed(CLASSES):
        bpy.utils.unregister_class(cls)
