"""What a user chooses: where the command is, and how a scene is denoised."""

import tomllib
from pathlib import Path

import bpy

from . import command, install

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
        description="A path, or a name that PATH knows; without one, what Install ravg has installed, or ravg on PATH",
        subtype="FILE_PATH",
    )

    def draw(self, context: bpy.types.Context) -> None:
        self.layout.prop(self, "command")
        self.layout.operator("ravg.install", icon="IMPORT")


class SceneSettings(bpy.types.PropertyGroup):
    """Saved with the scene."""

    preset: bpy.props.EnumProperty(name="Preset", description="Accuracy against time", items=PRESETS, default="fast")
    light_passes: bpy.props.BoolProperty(
        name="Light Passes",
        description="Denoise the passes that add up to the light along, so that they still do",
        default=False,
    )
    noisy: bpy.props.StringProperty(
        name="Noisy Frames",
        description="Where noisy frames are rendered to and read from, as Output Path; without one, beside the file",
        subtype="FILE_PATH",
    )
    folder: bpy.props.StringProperty(
        name="Denoised Frames",
        description="Folder for the denoised frames; without one, a folder denoised beside that of the noisy frames",
        subtype="DIR_PATH",
    )
    lent: bpy.props.StringProperty(
        name="Lent Settings",
        description="The render settings, as JSON, that the scene gets back when ravg's render has ended",
        options={"HIDDEN"},
    )
    resume: bpy.props.BoolProperty(
        name="Resume",
        description="Leave frames alone that an earlier run with these settings has finished",
        default=False,
    )


def preferences() -> Preferences:
    """The preferences of this extension."""
    return bpy.context.preferences.addons[__package__].preferences


def home() -> Path:
    """The folder that this extension may write to; updates leave it alone."""
    return Path(bpy.utils.extension_path_user(__package__))


def version() -> str:
    """The version of this extension."""
    manifest = Path(__file__).parent / "blender_manifest.toml"
    return tomllib.loads(manifest.read_text(encoding="utf-8"))["version"]


def executable() -> str:
    """The path of the command ravg: the one that is named, else the installed one, else that on PATH.

    Raises
    ------
    FileNotFoundError
        If there is none.
    """
    named = preferences().command.strip()
    return command.find_command(named or install.installed(home()))
