"""The current job, followed by a timer: a modal operator would block Blender's automatic saving."""

import textwrap
import time
from collections.abc import Callable
from pathlib import Path
from typing import Any

import bpy

from . import command, compositor, forecast, frames, install, scenes, settings

INTERVAL = 0.25  # seconds between two updates
MEASURE_EVERY = 2.0  # seconds between two looks at an installation, whose files are ten thousands
LOG = "ravg.log"  # the text block that holds ravg's output
Report = Callable[[set[str], str], None]
WIDTH = 160  # letters of an error: Blender shows one line, cut off at its window


class Job:
    """A scene being denoised; `run` is None while Blender renders its frames. `keep`: finished frames stay."""

    def __init__(self, scene: bpy.types.Scene, *, keep: bool = False) -> None:
        self._scene = scene.session_uid  # a name may change
        self._keep = keep
        if reason := ravg_problem(wait=True):
            raise FileNotFoundError(reason)
        if reason := scenes.misplaced(scene):
            raise FileNotFoundError(reason)
        self.run: command.Run | None = None
        self._started = time.monotonic()
        self.to_render = self.written = 0  # frames
        self.rendered = False
        self.cancelled = False
        self.error = ""
        self._finished, self._remaining = 0, ""

    @property
    def scene(self) -> bpy.types.Scene | None:
        """The scene; None if it was removed."""
        return next((scene for scene in bpy.data.scenes if scene.session_uid == self._scene), None)

    def start(self) -> None:
        """Start `ravg` on the existing frames.

        FileNotFoundError without frames or scene; ValueError for a frame that is no noisy render, or a preset that
        denoises no light passes; OSError if the command cannot be started.
        """
        scene = self.scene
        if scene is None:
            raise FileNotFoundError("the scene was removed")
        there = list(scenes.rendered_files(scene))
        pattern = scenes.noisy_pattern(scene)
        if scene.ravg.light_passes and scene.ravg.preset == "average":
            raise ValueError(scenes.NO_LIGHT_PASSES)
        if reason := scenes.refused(scene):
            raise ValueError(f"{reason} ({Path(pattern).parent})")
        if not there:
            raise FileNotFoundError(f"no frames {pattern}: Render and Denoise renders them")
        chosen, folder = scene.ravg, scenes.output_folder(scene)
        average = ["--method=classical", "--first-pass=auto"]
        how = average if chosen.preset == "average" else [f"--preset={chosen.preset}"]
        arguments = [settings.executable(), "denoise", *how, pattern]
        arguments += [f"--output={folder}", f"--frames={frames.ranges(there)}"]
        if chosen.light_passes:
            arguments.append("--aov=all")
        if chosen.strength < 1:
            arguments.append(f"--strength={chosen.strength:.6g}")
        if self._keep:
            arguments.append("--resume")
        outputs = scenes.denoised_files(scene)
        self._folder = folder
        log = Path(bpy.app.tempdir) / "ravg.log"
        self._started = time.monotonic()
        self.run = command.Run(arguments, [outputs[number] for number in there], log)

    def advance(self) -> None:
        """When Blender has rendered, restore the scene's settings and start `ravg`; see how far it is."""
        if self.run is None and (self.rendered or self.cancelled):
            self._restore()
            if not self.cancelled:
                try:
                    self.start()
                except (OSError, ValueError) as error:
                    self.error = str(error)
                    self.cancel()
        if self.run is not None:  # not where it is drawn, which may be more often
            self._finished, self._remaining = self.run.finished, self.run.remaining

    @property
    def factor(self) -> float:
        """The progress, from 0 to 1."""
        done, total = (self.written, self.to_render) if self.run is None else (self._finished, self.run.total)
        return min(done / max(total, 1), 1.0)  # more are written where files vanish meanwhile

    @property
    def text(self) -> str:
        """The progress in words."""
        if self.run is None:
            text = f"Rendering: {self.written} of {self.to_render} frames"
            left = (self.to_render - self.written) * (time.monotonic() - self._started) / max(self.written, 1)
            return f"{text}, {forecast.duration(left)} left" if self.written else text
        text = f"Denoising: {self._finished} of {self.run.total} frames"
        return f"{text}, {self._remaining} left" if self._remaining else text

    def cancel(self) -> None:
        """Stop `ravg`, or do not start it."""
        self.cancelled = True
        if self.run is not None:
            self.run.stop()

    @property
    def ended(self) -> bool:
        return self.cancelled if self.run is None else self.run.code is not None

    def conclude(self, report: Report) -> bool:
        """Restore the scene's settings and report the result; return whether all frames are made."""
        if self.run is None:  # else they are restored, and what is lent may be that of another render
            self._restore()
            if self.error:
                report({"ERROR"}, self.error)
            return False
        for warning in self.run.warnings:
            report({"WARNING"}, warning)
        if self.run.stopped:
            report({"WARNING"}, f"Stopped: {self.run.finished} of {self.run.total} frames are finished")
            return False
        if self.run.code != 0:
            why = textwrap.shorten(self.run.error, WIDTH, placeholder="…")
            report({"ERROR"}, f"{why} (all of it in the text {LOG})")
            return False
        if self.scene is not None and not self._keep:
            forecast.learn(self.scene, (time.monotonic() - self._started) / self.run.total)
        report({"INFO"}, f"Denoised {self.run.total} frames into {self._folder}")
        return True

    def _restore(self) -> None:
        if self.scene is not None:
            scenes.restore(self.scene)


class Install:
    """The installation of ravg into an environment of its own, step by step."""

    scene = None

    def __init__(self, wheel: str, *, gpu: bool) -> None:
        self._source = install_source(wheel, gpu=gpu)
        self._source.requirements()  # raises for a wrong wheel, before anything is made
        self._home = settings.home()
        self._environment = install.new_environment(self._home)
        self._steps = install.steps(self._environment, self._source)
        self._step = 0
        self._error = ""
        self._size, self._measured = 0.0, -MEASURE_EVERY
        self.run = self._start()

    def _start(self) -> command.Run:
        log = Path(bpy.app.tempdir) / f"ravg-install-{self._step}.log"
        return command.Run(self._steps[self._step], [], log, TMPDIR=str(install.temporary(self._environment)))

    def advance(self) -> None:
        """Measure the progress; start the next step after a successful one."""
        if time.monotonic() - self._measured >= MEASURE_EVERY:
            self._size, self._measured = install.size(self._environment), time.monotonic()
        if self.run.code == 0 and not self.run.stopped and self._step < len(self._steps) - 1:
            self._step += 1
            try:
                self.run = self._start()
            except OSError as error:
                self._error = str(error)

    @property
    def factor(self) -> float:
        """The share of bytes that are there, of those downloaded and unpacked in the end."""
        return min(self._size / sum(self._source.sizes), 0.99)

    @property
    def text(self) -> str:
        """The progress in words: bytes and pip's last line."""
        lines = [line.strip() for line in self.run.log.splitlines() if line.strip()] or [""]
        return f"Installing ravg, {self.factor:.0%}: {lines[-1][:80]}"

    def cancel(self) -> None:
        self.run.stop()

    @property
    def ended(self) -> bool:
        last = self.run.stopped or bool(self._error) or self._step == len(self._steps) - 1
        return self.run.code is not None and (self.run.code != 0 or last)

    def conclude(self, report: Report) -> bool:
        """Make a complete environment the current one, or remove it; return whether it is complete."""
        if self.run.code == 0 and not self.run.stopped and not self._error:
            install.finish(self._home, self._environment)
            report({"INFO"}, f"Installed {self.run.log.strip()}")
            return True
        install.remove(self._environment)
        if self.run.stopped:
            report({"WARNING"}, "Stopped: ravg is not installed")
        else:
            why = self._error or install.explain(self.run.log, online=self._source.online)
            why = textwrap.shorten(why, WIDTH, placeholder="…")
            report({"ERROR"}, f"ravg is not installed: {why} (all of it in the text {LOG})")
        return False


current: Job | Install | None = None
viewer: command.Run | None = None  # `ravg view`
_version: command.Version | None = None


def ravg_problem(*, wait: bool) -> str:
    """Return why ravg cannot be run, with the remedy; empty if it can, or, unless `wait`, if this is unknown yet."""
    global _version
    try:
        executable = settings.executable()
    except FileNotFoundError as error:
        return str(error)
    expected = install.series(settings.version())
    # After a problem ask again: a slow command may answer now, and one in an editable clone may be of another version.
    if _version is None or not _version.is_of(executable) or (wait and _version.known and _version.problem(expected)):
        _version = command.Version(executable)
        bpy.app.timers.register(_redraw_when_known, first_interval=INTERVAL)
    return _version.problem(expected) if wait or _version.known else ""


def _redraw_when_known() -> float | None:
    if _version is not None and not _version.known:
        return INTERVAL
    redraw()
    return None


def follow() -> float | None:
    """Update the current job; the function of a timer."""
    if current is None:
        return None
    redraw()
    current.advance()
    if not current.ended:
        return INTERVAL
    with bpy.context.temp_override(window=bpy.context.window_manager.windows[0]):
        bpy.ops.ravg.conclude("INVOKE_DEFAULT")
    return None


def wait() -> None:
    """Follow the current job to its end, and print its output."""
    current.advance()
    run, printed = None, 0
    while current.run is not None:
        if current.run is not run:
            run, printed = current.run, 0
        ended, text = current.ended, run.log
        print(text[printed:], end="", flush=True)
        printed = len(text)
        if ended:
            return
        time.sleep(INTERVAL)
        current.advance()


def begin(scene: bpy.types.Scene, *, keep: bool = False) -> Job:
    """Make the current job; FileNotFoundError if the command is missing, or the frames have no folder."""
    global current
    current = Job(scene, keep=keep)
    return current


def compare(scene: bpy.types.Scene) -> None:
    """Start `ravg view` on the scene's frames; OSError without frames, or if the command cannot be started."""
    global viewer
    if not scenes.denoised_frames(scene):
        raise FileNotFoundError(f"no denoised frames in {scenes.output_folder(scene)}")
    end_viewer()
    noisy = Path(scenes.noisy_pattern(scene))
    arguments = [settings.executable(), "view", str(scenes.output_folder(scene) / noisy.name)]
    if scenes.rendered_files(scene):
        arguments += ["--beside", str(noisy)]
    viewer = command.Run(arguments, [], Path(bpy.app.tempdir) / "ravg-view.log")


@bpy.app.handlers.persistent
def end_viewer(*_: Any) -> None:
    """End `ravg view`, as its file or the extension is closed."""
    global viewer
    if viewer is not None:
        viewer.stop()
        viewer.wait()
        viewer = None


def install_source(wheel: str, *, gpu: bool) -> install.Source:
    """Where ravg is installed from: a wheel, or the one that the extension came with."""
    path = Path(bpy.path.abspath(wheel)) if wheel else install.bundled_wheel()
    return install.Source(settings.version(), path, bpy.app.online_access, gpu)


def begin_install(wheel: str, *, gpu: bool) -> Install:
    """Begin to install ravg; ValueError or OSError without a source, or if no environment can be made."""
    global current, _version
    current, _version = Install(wheel, gpu=gpu), None
    return current


@bpy.app.handlers.persistent
def stop_current(*_: Any) -> None:
    """End the current job, as its file or the extension is closed."""
    global current
    if current is not None:
        try:
            current.cancel()
            if current.run is not None:
                current.run.wait()
            current.conclude(lambda *_: None)
        finally:
            current = None


@bpy.app.handlers.persistent
def restore_all(*_: Any) -> None:
    """Restore all scenes of a file: settings as they were before a render, frames that have moved with the file."""
    for scene in bpy.data.scenes:
        scenes.restore(scene)
        try:
            compositor.repoint_lost(scene)
        except (OSError, RuntimeError) as error:  # RuntimeError: Blender's, of an unreadable file
            print(f"ravg: {error}")


@bpy.app.handlers.persistent
def make_relative(file: str, *_: Any) -> None:
    """Let a file be moved with its frames."""
    scenes.make_relative(file)


@bpy.app.handlers.persistent
def protect(scene: bpy.types.Scene, *_: Any) -> None:
    """Keep ravg's frames when a render that is not its own would overwrite them."""
    if not scene.ravg.lent:
        problems = [problem.text for problem in compositor.problems(scene)]
        for message in (*scenes.keep_existing(scene), *problems, compositor.movie(scene)):
            if message:
                print(f"ravg: {message}")


@bpy.app.handlers.persistent
def count_written(scene: bpy.types.Scene, *_: Any) -> None:
    """Count the frames that a job's render has written."""
    if (job := _waiting(scene)) is not None:
        job.written += 1


# Handlers run in another thread while Blender still reads the scene. They leave to the timer what belongs to a job, and
# restore only what `protect` has changed for a render of the user's.
@bpy.app.handlers.persistent
def completed(scene: bpy.types.Scene, *_: Any) -> None:
    """Let the timer start `ravg` where a job waits for this render; else restore what `protect` has changed."""
    if (job := _waiting(scene)) is not None:
        job.rendered = True
    else:
        scenes.restore(scene)


@bpy.app.handlers.persistent
def cancelled(scene: bpy.types.Scene, *_: Any) -> None:
    """End the job that waits for this render; else restore what `protect` has changed."""
    if (job := _waiting(scene)) is not None:
        job.cancel()
    else:
        scenes.restore(scene)


def _waiting(scene: bpy.types.Scene) -> Job | None:
    """The current job, if it waits for Blender to render a scene."""
    return current if isinstance(current, Job) and current.scene == scene and current.run is None else None


def redraw() -> None:
    for window in bpy.context.window_manager.windows:
        for area in window.screen.areas:
            if area.type == "PROPERTIES":
                area.tag_redraw()
