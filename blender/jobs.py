"""The one job at a time: wait for Blender to render where that was asked for, then follow `ravg` to its end.

A timer follows it, and no modal operator: Blender does not save automatically while one of those runs.
"""

from __future__ import annotations

from pathlib import Path
from typing import Any

import bpy

from . import command, scenes, settings

INTERVAL = 0.25  # seconds between two looks


class Job:
    """A scene being denoised; `run` is None while Blender renders its frames."""

    def __init__(self, scene: bpy.types.Scene) -> None:
        self.scene = scene.name
        self.executable = command.find_command(settings.preferences().command)
        self.run: command.Run | None = None
        self.cancelled = False
        self.error = ""

    def start(self) -> None:
        """Start `ravg` on the frames that are there.

        Raises
        ------
        FileNotFoundError
            If no frame of the scene is there.
        OSError
            If the command cannot be started.
        """
        scene = bpy.data.scenes[self.scene]
        there = [number for number, path in scenes.frame_files(scene).items() if path.is_file()]
        pattern = scenes.frame_pattern(scene)
        if not there:
            raise FileNotFoundError(f"no frames {pattern}: render the animation first")
        chosen, folder = scene.ravg, scenes.output_folder(scene)
        frames = ",".join(map(str, sorted(there)))
        network = ["denoise", f"--preset={chosen.preset}"]
        how = ["pseudoref", "--estimate=auto"] if chosen.preset == "average" else network
        arguments = [self.executable, *how, pattern, f"--output={folder}", f"--frames={frames}"]
        if chosen.resume:
            arguments.append("--resume")
        outputs = scenes.denoised_files(scene)
        log = Path(bpy.app.tempdir) / "ravg.log"
        self.run = command.Run(arguments, [outputs[number] for number in there], log)

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
    """Start `ravg` when Blender has rendered the animation; end the job if that is cancelled."""

    def rendered(*_: Any) -> None:
        forget()
        try:
            if not job.cancelled:
                job.start()
        except OSError as error:
            job.error = str(error)
            job.cancel()

    def cancelled(*_: Any) -> None:
        forget()
        job.cancel()

    def forget() -> None:
        bpy.app.handlers.render_complete.remove(rendered)
        bpy.app.handlers.render_cancel.remove(cancelled)

    bpy.app.handlers.render_complete.append(rendered)
    bpy.app.handlers.render_cancel.append(cancelled)


@bpy.app.handlers.persistent
def stop_current(*_: Any) -> None:
    """End the job with the file, or the extension, that it belongs to."""
    global current
    if current is not None:
        current.cancel()
        if current.run is not None:
            current.run.wait()
        current = None


def _redraw() -> None:
    for window in bpy.context.window_manager.windows:
        for area in window.screen.areas:
            if area.type == "PROPERTIES":
                area.tag_redraw()
