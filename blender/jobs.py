"""The one job at a time: wait for Blender to render where that was asked for, then follow `ravg` to its end.

A timer follows it, and no modal operator: Blender does not save automatically while one of those runs.
"""

from __future__ import annotations

from collections.abc import Callable
from pathlib import Path
from typing import Any

import bpy

from . import command, frames, scenes, settings

INTERVAL = 0.25  # seconds between two looks


class Job:
    """A scene being denoised; `run` is None while Blender renders its frames."""

    def __init__(self, scene: bpy.types.Scene) -> None:
        self.scene = scene.name
        self.executable = command.find_command(settings.preferences().command)
        if not scenes.is_placed(scene):
            raise FileNotFoundError("the file is not saved: save it, or name a folder in Noisy Frames")
        self.run: command.Run | None = None
        self.rendered = False
        self.cancelled = False
        self.error = ""
        self.forget: Callable[[], None] = lambda: None  # removes the handlers that wait for the render

    def start(self) -> None:
        """Start `ravg` on the frames that are there.

        Raises
        ------
        FileNotFoundError
            If no frame of the scene is there.
        ValueError
            If a frame is no noisy render with the passes that ravg reads.
        OSError
            If the command cannot be started.
        """
        scene = bpy.data.scenes[self.scene]
        there = [number for number, path in scenes.noisy_files(scene).items() if path.is_file()]
        pattern = scenes.noisy_pattern(scene)
        if not there:
            raise FileNotFoundError(f"no frames {pattern}: Render and Denoise renders them")
        if reason := scenes.refused(scene):
            raise ValueError(f"{reason} ({Path(pattern).parent})")
        chosen, folder = scene.ravg, scenes.output_folder(scene)
        network = ["denoise", f"--preset={chosen.preset}"]
        how = ["pseudoref", "--estimate=auto"] if chosen.preset == "average" else network
        arguments = [self.executable, *how, pattern, f"--output={folder}", f"--frames={frames.ranges(there)}"]
        if chosen.light_passes:
            arguments.append("--aov=all")
        if chosen.resume:
            arguments.append("--resume")
        outputs = scenes.denoised_files(scene)
        log = Path(bpy.app.tempdir) / "ravg.log"
        self.run = command.Run(arguments, [outputs[number] for number in there], log)

    def go_on(self) -> None:
        """Give the scene its own settings back once Blender has rendered, and start `ravg`."""
        if self.run is None and (self.rendered or self.cancelled):
            scenes.give_back(bpy.data.scenes[self.scene])
            if not self.cancelled:
                try:
                    self.start()
                except (OSError, ValueError) as error:
                    self.error = str(error)
                    self.cancel()

    @property
    def factor(self) -> float:
        """How much is done, from 0 to 1."""
        return 0.0 if self.run is None else self.run.finished / self.run.total

    @property
    def text(self) -> str:
        """What is being done, in a few words."""
        if self.run is None:
            return "Rendering"
        text = f"Denoising: {self.run.finished} of {self.run.total} frames"
        return f"{text}, {self.run.remaining} left" if self.run.remaining else text

    def cancel(self) -> None:
        """Ask `ravg` to stop, or do not start it."""
        self.cancelled = True
        if self.run is not None:
            self.run.stop()

    @property
    def ended(self) -> bool:
        """Whether there is no more to wait for."""
        return self.cancelled if self.run is None else self.run.code is not None


current: Job | None = None


def follow() -> float | None:
    """Look how far the job has come; a timer's function."""
    if current is None:
        return None
    _redraw()
    current.go_on()
    if not current.ended:
        return INTERVAL
    with bpy.context.temp_override(window=bpy.context.window_manager.windows[0]):
        bpy.ops.ravg.conclude("INVOKE_DEFAULT")
    _redraw()
    return None


def begin(scene: bpy.types.Scene) -> Job:
    """Make the current job.

    Raises
    ------
    FileNotFoundError
        If the command is not there.
    """
    global current
    current = Job(scene)
    return current


def start_when_rendered(job: Job) -> None:
    """Let the timer start `ravg` when Blender has rendered the animation; end the job if that is cancelled."""

    # Handlers run beside the interface, while Blender still reads the scene: the timer does the rest.
    def rendered(*_: Any) -> None:
        forget()
        job.rendered = True

    def cancelled(*_: Any) -> None:
        forget()
        job.cancel()

    def forget() -> None:
        for handlers, handler in (
            (bpy.app.handlers.render_complete, rendered),
            (bpy.app.handlers.render_cancel, cancelled),
        ):
            if handler in handlers:
                handlers.remove(handler)

    job.forget = forget
    bpy.app.handlers.render_complete.append(rendered)
    bpy.app.handlers.render_cancel.append(cancelled)


@bpy.app.handlers.persistent
def stop_current(*_: Any) -> None:
    """End the job with the file, or the extension, that it belongs to."""
    global current
    if current is not None:
        current.cancel()
        current.forget()
        if current.run is not None:
            current.run.wait()
        elif (scene := bpy.data.scenes.get(current.scene)) is not None:
            scenes.give_back(scene)
        current = None


@bpy.app.handlers.persistent
def give_back_all(*_: Any) -> None:
    """Give all scenes their own settings back: of a file that was saved, or lost, while it was rendered."""
    for scene in bpy.data.scenes:
        scenes.give_back(scene)


@bpy.app.handlers.persistent
def protect(scene: bpy.types.Scene, *_: Any) -> None:
    """Keep the frames of ravg when a render that is not its own would write over them."""
    if not scene.ravg.lent and (kept := scenes.would_be_written_over(scene)):
        scenes.keep_existing(scene)
        print(f"ravg: {len(kept)} of its frames in {kept[0].parent} are not written over: name another Output Path")


@bpy.app.handlers.persistent
def protected(scene: bpy.types.Scene, *_: Any) -> None:
    """Give a scene its own settings back after a render that `protect` has changed."""
    if current is None or current.scene != scene.name:
        scenes.give_back(scene)


def _redraw() -> None:
    for window in bpy.context.window_manager.windows:
        for area in window.screen.areas:
            if area.type == "PROPERTIES":
                area.tag_redraw()
