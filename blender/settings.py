"""Preferences of the extension, and settings of a scene."""

import tomllib
from pathlib import Path

import bpy

from . import command, install

PRESETS = (
    ("fast", "Fast", "Average of denoised frames"),
    ("balanced", "Balanced", "The average, and a network on the samples of all frames"),
    ("quality", "Quality", "The same with a large network and denoised guides"),
    ("average", "Without Network", "Temporal average of frames denoised by OIDN: needs no torch"),
)

# Blender 5.0 warns of "//" in a property that does not state this; earlier ones do not know it.
_RELATIVE = {"PATH_SUPPORTS_BLEND_RELATIVE"} if bpy.app.version >= (4, 5, 0) else set()


class Preferences(bpy.types.AddonPreferences):
    """Edit > Preferences > Add-ons."""

    bl_idname = __package__

    command: bpy.props.StringProperty(
        name="Command",
        description="Path of the command, or its name on PATH; default: the installed ravg, else ravg on PATH",
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
        description="Denoise the light passes too, and keep their sum equal to the denoised image",
        default=False,
    )
    strength: bpy.props.FloatProperty(
        name="Strength",
        description="Share of the noise that is removed: below 1 grain stays",
        subtype="FACTOR",
        default=1.0,
        min=0.0,
        max=1.0,
    )
    noisy: bpy.props.StringProperty(
        name="Noisy Frames",
        description="Path of the noisy frames, written as an Output Path; default: beside the file",
        subtype="FILE_PATH",
        options={"ANIMATABLE", *_RELATIVE},
    )
    folder: bpy.props.StringProperty(
        name="Denoised Frames",
        description="Folder of the denoised frames; default: a folder denoised beside that of the noisy frames",
        subtype="DIR_PATH",
        options={"ANIMATABLE", *_RELATIVE},
    )
    lent: bpy.props.StringProperty(
        name="Lent Settings",
        description="The scene's own render settings, as JSON, while ravg's render overrides them",
        options={"HIDDEN"},
    )


def preferences() -> Preferences:
    return bpy.context.preferences.addons[__package__].preferences


def home() -> Path:
    """The folder that this extension may write to; updates keep it."""
    return Path(bpy.utils.extension_path_user(__package__))


def version() -> str:
    manifest = Path(__file__).parent / "blender_manifest.toml"
    return tomllib.loads(manifest.read_text(encoding="utf-8"))["version"]


def executable() -> str:
    """The path of ravg: of the preferences, else the installed one, else on PATH; else FileNotFoundError."""
    return command.find_command(preferences().command.strip() or install.installed(home()))
