"""The panel in Output properties."""

import textwrap
from pathlib import Path

import bpy

from . import compositor, forecast, jobs, scenes


class OutputPanel(bpy.types.Panel):
    """Properties > Output > Denoise with ravg."""

    bl_idname = "RAVG_PT_output"
    bl_label = "Denoise with ravg"
    bl_space_type = "PROPERTIES"
    bl_region_type = "WINDOW"
    bl_context = "output"

    def draw(self, context: bpy.types.Context) -> None:
        layout, scene = self.layout, context.scene
        layout.use_property_split = True
        layout.use_property_decorate = False
        job, missing = jobs.current, jobs.ravg_problem(wait=False)
        # All frames are looked at, and a job draws often.
        problems = [*scenes.problems(scene), *compositor.problems(scene)] if job is None else []
        if problems or missing:
            column = layout.box().column(align=True)
            if missing:
                _text(context, column, missing)
                if job is None:
                    column.operator("ravg.install", icon="IMPORT")
            for problem in problems:
                _text(context, column, problem.text)
            if any(problem.fixable for problem in problems):
                column.operator("ravg.set_up", icon="TOOL_SETTINGS")
        column = layout.column()
        column.prop(scene.ravg, "preset")
        column.prop(scene.ravg, "light_passes")
        column.prop(scene.ravg, "strength")
        # Names and buttons have lines of their own: side by side, Blender cuts them off at the panel's usual width.
        for name, default in (("noisy", scenes.noisy_pattern(scene)), ("folder", str(scenes.output_folder(scene)))):
            column.label(text=scene.ravg.bl_rna.properties[name].name)
            column.prop(scene.ravg, name, text="", placeholder=_shorten(default))
        column = layout.column(align=True)
        if job is not None:
            column.progress(text=job.text, factor=job.factor)
            column.operator("ravg.cancel", icon="X")
            return
        _text(context, column, forecast.line(scene), "INFO")
        column.operator("ravg.denoise", text="Render and Denoise", icon="RENDER_ANIMATION").render = True
        column.operator("ravg.denoise", icon="SHADERFX")
        total, there, made = (
            len(x(scene)) for x in (scenes.frame_numbers, scenes.rendered_files, scenes.denoised_frames)
        )
        layout.label(text=f"{there} of {total} noisy frames are there, {made} are denoised", icon="FILE_IMAGE")
        column = layout.column(align=True)
        column.operator("ravg.show", icon="IMAGE_DATA")
        column.operator("ravg.compare", icon="MOD_MIRROR")
        if jobs.viewer is not None and jobs.viewer.code:
            _text(context, column, f"ravg view: {jobs.viewer.error}")
        column.operator("ravg.add_to_compositor", icon="NODE_COMPOSITING")
        if movie := compositor.movie(scene):
            layout.label(text=movie, icon="RENDER_ANIMATION")


def _shorten(path: str) -> str:
    """Write a path below the file's folder as Blender does, ``//ravg/shot/noisy/Scene_####.exr``."""
    folder = Path(bpy.data.filepath).parent
    below = bpy.data.filepath and Path(path).is_relative_to(folder)
    return f"//{Path(path).relative_to(folder).as_posix()}" if below else path


def _text(context: bpy.types.Context, column: bpy.types.UILayout, text: str, icon: str = "ERROR") -> None:
    """Draw a text, wrapped at the panel's width, where Blender would cut it off."""
    # A letter is about seven pixels wide; without a region nothing is wrapped.
    width = 200
    if context.region is not None:
        width = max(20, int(context.region.width / (7 * context.preferences.system.ui_scale)) - 6)
    for index, line in enumerate(textwrap.wrap(text, width, break_on_hyphens=False)):
        column.label(text=line, icon="BLANK1" if index else icon)
