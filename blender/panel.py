"""The panel in Output properties."""

from __future__ import annotations

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
        problems = scenes.problems(scene)
        if problems:
            column = layout.box().column(align=True)
            for problem in problems:
                column.label(text=problem.text, icon="ERROR")
            if any(problem.fixable for problem in problems):
                column.operator("ravg.set_up", icon="TOOL_SETTINGS")
        column = layout.column()
        column.prop(scene.ravg, "preset")
        column.prop(scene.ravg, "light_passes")
        column.prop(scene.ravg, "noisy", placeholder=scenes.noisy_pattern(scene))
        column.prop(scene.ravg, "folder", placeholder=str(scenes.output_folder(scene)))
        column.prop(scene.ravg, "resume")
        job = jobs.current
        if job is not None:
            row = layout.row(align=True)
            row.progress(text=job.text, factor=job.factor)
            row.operator("ravg.cancel", icon="X")
            return
        row = layout.row(align=True)
        row.operator("ravg.denoise", text="Render and Denoise", icon="RENDER_ANIMATION").render = True
        row.operator("ravg.denoise", icon="SHADERFX")
        row = layout.row(align=True)
        row.operator("ravg.show", icon="IMAGE_DATA")
        row.operator("ravg.add_to_compositor", icon="NODE_COMPOSITING")
