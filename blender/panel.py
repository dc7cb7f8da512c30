"""The panel in Output properties."""

from __future__ import annotations

import textwrap

import bpy

from . import jobs, scenes


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
        job, problems, missing = jobs.current, scenes.problems(scene), jobs.ravg_problem(wait=False)
        if problems or missing:
            column = layout.box().column(align=True)
            if missing:
                _warn(context, column, missing)
                if job is None:
                    column.operator("ravg.install", icon="IMPORT")
            for problem in problems:
                _warn(context, column, problem.text)
            if any(problem.fixable for problem in problems):
                column.operator("ravg.set_up", icon="TOOL_SETTINGS")
        column = layout.column()
        column.prop(scene.ravg, "preset")
        column.prop(scene.ravg, "light_passes")
        column.prop(scene.ravg, "noisy", placeholder=scenes.noisy_pattern(scene))
        column.prop(scene.ravg, "folder", placeholder=str(scenes.output_folder(scene)))
        column.prop(scene.ravg, "resume")
        if job is not None:
            row = layout.row(align=True)
            row.progress(text=job.text, factor=job.factor)
            row.operator("ravg.cancel", icon="X")
            return
        row = layout.row(align=True)
        row.operator("ravg.denoise", text="Render and Denoise", icon="RENDER_ANIMATION").render = True
        row.operator("ravg.denoise", icon="SHADERFX")
        column = layout.column()
        there, total = len(scenes.rendered_files(scene)), len(scenes.frame_numbers(scene))
        column.label(text=f"{there} of {total} noisy frames are there", icon="FILE_IMAGE")
        row = layout.row(align=True)
        row.operator("ravg.show", icon="IMAGE_DATA")
        row.operator("ravg.add_to_compositor", icon="NODE_COMPOSITING")


def _warn(context: bpy.types.Context, column: bpy.types.UILayout, text: str) -> None:
    """Draw a text, wrapped at the panel's width, where Blender would cut it off."""
    # A letter is about seven pixels wide; without a region nothing is wrapped.
    width = 200
    if context.region is not None:
        width = max(20, int(context.region.width / (7 * context.preferences.system.ui_scale)) - 6)
    for index, line in enumerate(textwrap.wrap(text, width)):
        column.label(text=line, icon="BLANK1" if index else "ERROR")
