"""What a user chooses: where the command is, and how a scene is denoised."""

import bpy

PRESETS = (
    ("fast", "Fast", "The network on OIDN's fast pictures"),
    ("balanced", "Balanced", "The network on OIDN's pictures"),
    ("quality", "Quality", "The network on OIDN's pictures, made with guides free of noise"),
    ("average", "Without Network", "Averages of denoised pictures over time: needs no torch"),
)


class Preferences(bpy.types.AddonPreferences):
    """In Edit > Preferences > Add-ons."""

    bl_idname = __package__

    command: bpy.props.StringProperty(
        name="Command",
        description="The command ravg: a path, or a name that PATH knows",
        default="ravg",
        subtype="FILE_PATH",
    )

    def draw(self, context: bpy.types.Context) -> None:
        self.layout.prop(self, "command")


class SceneSettings(bpy.types.PropertyGroup):
    """Saved with the scene."""

    preset: bpy.props.EnumProperty(name="Preset", description="Accuracy against time", items=PRESETS, default="fast")
    folder: bpy.props.StringProperty(
        name="Folder",
        description="For the denoised frames; without one, a folder denoised beside the rendered frames",
        subtype="DIR_PATH",
    )
    resume: bpy.props.BoolProperty(
        name="Resume",
        description="Leave frames alone that an earlier run with these settings has finished",
        default=False,
    )


def preferences() -> Preferences:
    """The preferences of this extension."""
    return bpy.context.preferences.addons[__package__].preferences
