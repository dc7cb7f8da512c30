"""The operators behind the panel's buttons."""

import sys
from collections.abc import Callable
from typing import Any

import bpy

from . import compositor, frames, jobs, scenes


class SetUp(bpy.types.Operator):
    """Switch on what ravg reads: Denoising Data and Vector, a seed that changes, and Blender's denoiser for Fast"""

    bl_idname = "ravg.set_up"
    bl_label = "Set Up Passes"
    bl_options = {"REGISTER", "UNDO"}  # noqa: RUF012 - Blender reads it

    def execute(self, context: bpy.types.Context) -> set[str]:
        changed = scenes.set_up(context.scene)
        self.report({"INFO"}, f"Set up: {', '.join(changed)}" if changed else "All is set up already")
        return {"FINISHED"}


EXISTING = (
    ("ASK", "Ask", "Make nothing if frames exist"),
    ("KEEP", "Keep Finished Frames", "Make what is missing, and denoise again what other settings or frames have made"),
    ("REPLACE", "Make All Again", "Replace the existing frames"),
)
CHOICE = "existing='KEEP' or 'REPLACE'"  # the command line has other names


class _WhenIdle:
    """An operator that is not available during a job."""

    @classmethod
    def poll(cls, context: bpy.types.Context) -> bool:
        cls.poll_message_set("ravg is at work")
        return jobs.current is None


class Denoise(_WhenIdle, bpy.types.Operator):
    """Denoise the rendered frames with the installed ravg, in the background, and load the result"""

    bl_idname = "ravg.denoise"
    bl_label = "Denoise Frames"

    render: bpy.props.BoolProperty(
        name="Render", description="Set up the passes and render the animation first", options={"SKIP_SAVE"}
    )
    existing: bpy.props.EnumProperty(
        name="Existing Frames", description="How to treat frames that exist", items=EXISTING, options={"SKIP_SAVE"}
    )
    wait: bpy.props.BoolProperty(
        name="Wait", description="Return at the end, for scripts", default=True, options={"SKIP_SAVE", "HIDDEN"}
    )

    def invoke(self, context: bpy.types.Context, event: bpy.types.Event) -> set[str]:
        """Ask about existing frames; then return at once, and let a timer follow."""
        self.wait = bpy.app.background
        if not self.wait and (there := self._existing(context.scene)):
            self.existing = "KEEP"
            button = "Render and Denoise" if self.render else self.bl_label
            return context.window_manager.invoke_props_dialog(self, title=f"{there} are there", confirm_text=button)
        return self.execute(context)

    def _existing(self, scene: bpy.types.Scene) -> str:
        """Name the frames that would be replaced; empty without any."""
        found = {"denoised frames": scenes.denoised_frames(scene)}
        if self.render:
            found = {"noisy frames": scenes.rendered_files(scene), **found}
        return " and ".join(f"{name} {frames.ranges(there)}" for name, there in found.items() if there)

    def draw(self, context: bpy.types.Context) -> None:
        for value, *_ in EXISTING[1:]:  # "Ask" is no answer
            self.layout.prop_enum(self, "existing", value)

    def execute(self, context: bpy.types.Context) -> set[str]:
        """Denoise; with `wait`, as in scripts and without a window, until the end."""
        return _follow(self, context, lambda: self._begin(context.scene))

    def _begin(self, scene: bpy.types.Scene) -> None:
        job = jobs.begin(scene, keep=self.existing == "KEEP")
        if self.existing == "ASK" and (there := self._existing(scene)):
            raise FileExistsError(f"{there} are there already: choose {CHOICE}")
        if not self.render:
            job.start()
            return
        if bpy.app.is_job_running("RENDER"):  # whose settings `override` would change
            raise RuntimeError("Blender is rendering: wait for its end, or stop it")
        scenes.set_up(scene)
        job.to_render = len(scenes.frame_numbers(scene))
        if self.existing == "KEEP":
            job.to_render -= len(scenes.rendered_files(scene))
        scenes.override(scene, replace=self.existing == "REPLACE")
        how = "EXEC_DEFAULT" if self.wait else "INVOKE_DEFAULT"
        if bpy.ops.render.render(how, animation=True, scene=scene.name) == {"CANCELLED"}:
            raise RuntimeError("Blender has not rendered the frames: its console may say why")


class Install(_WhenIdle, bpy.types.Operator):
    """Install ravg for Blender alone, in its configuration folder, or repair it"""

    bl_idname = "ravg.install"
    bl_label = "Install ravg"

    wheel: bpy.props.StringProperty(
        name="Wheel",
        description="A wheel file of ravg in place of the extension's; wheels of requirements may lie beside it",
        subtype="FILE_PATH",
        options={"SKIP_SAVE"},
    )
    gpu: bpy.props.BoolProperty(
        name="For GPUs", description="Install torch with CUDA, which takes more room", options={"SKIP_SAVE"}
    )
    wait: bpy.props.BoolProperty(default=True, options={"SKIP_SAVE", "HIDDEN"})

    def invoke(self, context: bpy.types.Context, event: bpy.types.Event) -> set[str]:
        """Ask for the wheel; then return at once, and let a timer follow."""
        self.wait = bpy.app.background
        if self.wait:
            return self.execute(context)
        return context.window_manager.invoke_props_dialog(self, title="Install ravg", confirm_text="Install", width=480)

    def draw(self, context: bpy.types.Context) -> None:
        column = self.layout.column()
        source = jobs.install_source(self.wheel, gpu=self.gpu)
        bundled = source.wheel is not None or self.wheel
        column.prop(self, "wheel", placeholder="the extension's own" if bundled else "ravg-…-py3-none-any.whl")
        if not source.online:
            column.label(text="Online Access is off: wheels of all requirements are needed beside it", icon="ERROR")
            return
        if sys.platform == "linux":
            column.prop(self, "gpu")
        download, disk = source.sizes
        column.label(text=f"Downloads about {download:g} GB, and takes {disk:g} GB on disk")

    def execute(self, context: bpy.types.Context) -> set[str]:
        return _follow(self, context, lambda: jobs.begin_install(self.wheel, gpu=self.gpu))


class Cancel(bpy.types.Operator):
    """Stop ravg; finished frames stay, and Denoise Frames goes on from there"""

    bl_idname = "ravg.cancel"
    bl_label = "Stop"

    @classmethod
    def poll(cls, context: bpy.types.Context) -> bool:
        return jobs.current is not None

    def execute(self, context: bpy.types.Context) -> set[str]:
        jobs.current.cancel()
        return {"FINISHED"}


class Conclude(bpy.types.Operator):
    """Report the result of ravg, and load its frames"""

    bl_idname = "ravg.conclude"
    bl_label = "Conclude"
    bl_options = {"INTERNAL"}  # noqa: RUF012

    def invoke(self, context: bpy.types.Context, event: bpy.types.Event) -> set[str]:
        """Conclude at the next event: Blender shows no reports of an operator that Python has called."""
        if bpy.app.background:
            return self.execute(context)
        manager = context.window_manager
        self._timer = manager.event_timer_add(0.01, window=context.window)
        manager.modal_handler_add(self)
        return {"RUNNING_MODAL"}

    def modal(self, context: bpy.types.Context, event: bpy.types.Event) -> set[str]:
        context.window_manager.event_timer_remove(self._timer)
        return self.execute(context)

    def execute(self, context: bpy.types.Context) -> set[str]:
        return conclude(self, context)


class Show(bpy.types.Operator):
    """Show the denoised frames in an image editor"""

    bl_idname = "ravg.show"
    bl_label = "Show"

    def execute(self, context: bpy.types.Context) -> set[str]:
        scene = context.scene
        here = [context.window] if context.window else []  # an editor in another window may be hidden by this one
        return _load(self, scene, lambda image, count: show(here, scene, image, count))


class Compare(bpy.types.Operator):
    """Play noisy, Blender's and ravg's frames side by side in the web browser: each is a layer of the left or right"""

    bl_idname = "ravg.compare"
    bl_label = "Compare"

    def execute(self, context: bpy.types.Context) -> set[str]:
        try:
            jobs.compare(context.scene)
        except OSError as error:
            self.report({"ERROR"}, str(error))
            return {"CANCELLED"}
        self.report({"INFO"}, "ravg view opens in the web browser")
        return {"FINISHED"}


class AddToCompositor(bpy.types.Operator):
    """Replace the Render Layers nodes by the denoised frames, so that the scene is not rendered again"""

    bl_idname = "ravg.add_to_compositor"
    bl_label = "Add to Compositor"
    bl_options = {"REGISTER", "UNDO"}  # noqa: RUF012

    def execute(self, context: bpy.types.Context) -> set[str]:
        scene = context.scene
        done = _load(self, scene, lambda image, count: compositor.add(scene, image, count))
        if done == {"FINISHED"}:
            self.report({"INFO"}, "The compositor reads the denoised frames, and Render Animation writes its output")
        return done


def _follow(operator: bpy.types.Operator, context: bpy.types.Context, begin: Callable[[], Any]) -> set[str]:
    """Begin a job; follow it to its end if the operator waits, else by a timer."""
    try:
        begin()
        if not operator.wait:
            bpy.app.timers.register(jobs.follow, first_interval=jobs.INTERVAL)
            return {"FINISHED"}
        jobs.wait()
    except (OSError, ValueError, RuntimeError) as error:  # RuntimeError: Blender's, of a failed render
        jobs.stop_current()
        operator.report({"ERROR"}, str(error).strip().removeprefix("Error: "))
        return {"CANCELLED"}
    except BaseException:
        jobs.stop_current()
        raise
    return conclude(operator, context)


def conclude(operator: bpy.types.Operator, context: bpy.types.Context) -> set[str]:
    """Report the result of the job, keep its log as a text, and show its frames if all are made."""
    job, jobs.current = jobs.current, None
    jobs.redraw()
    if job.run is not None:
        text = bpy.data.texts.get(jobs.LOG) or bpy.data.texts.new(jobs.LOG)
        text.from_string(job.run.log)
    if not job.conclude(operator.report):
        return {"CANCELLED"}
    if job.scene is None:  # nothing to show: ravg was installed, or the scene was removed
        return {"FINISHED"}
    windows = [*context.window_manager.windows]

    def use(image: bpy.types.Image, count: int) -> None:
        compositor.repoint(job.scene, image, count)
        show(windows, job.scene, image, count)

    return _load(operator, job.scene, use)


def show(windows: list[bpy.types.Window], scene: bpy.types.Scene, image: bpy.types.Image, count: int) -> None:
    """Show a sequence in an image editor of these windows, else in a new window."""
    areas = [area for window in windows for area in window.screen.areas]
    editor = next((area for area in areas if area.type == "IMAGE_EDITOR"), None)
    if editor is None:
        if bpy.app.background:
            return
        bpy.ops.wm.window_new()
        editor = bpy.context.window_manager.windows[-1].screen.areas[0]
        editor.type = "IMAGE_EDITOR"
    editor.spaces.active.image = image
    scenes.show_from(editor.spaces.active.image_user, scene, count)


def _load(operator: bpy.types.Operator, scene: bpy.types.Scene, use: Callable[..., None]) -> set[str]:
    """Load the denoised frames and call `use(image, count)`."""
    try:
        use(*scenes.load_denoised(scene))
    except (OSError, ValueError, RuntimeError) as error:  # RuntimeError: Blender's, of an unreadable file
        operator.report({"ERROR"}, str(error).strip())
        return {"CANCELLED"}
    return {"FINISHED"}
