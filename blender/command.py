"""Find the command `ravg` and run it in a process of its own. Independent of Blender."""

import os
import re
import shutil
import subprocess
import sys
import time
from collections.abc import Iterable, Sequence
from contextlib import suppress
from pathlib import Path
from typing import Any

WHERE = "press Install ravg, or name its path in Preferences > Add-ons > ravg"
ANSWER_WITHIN = 60.0  # seconds for `ravg --version`: a cold disk or a virus scanner may take many
# Seconds after the request to stop: `ravg` needs about one. A version that does not watch its input is terminated, and
# a process that does not end is killed.
TERMINATED_AFTER = 3.0
KILLED_AFTER = 10.0
# The log is shown as plain text: no colors, no wrapped lines, UTF-8 on every system.
_PLAIN = {"NO_COLOR": "1", "TERM": "dumb", "COLUMNS": "160", "PYTHONIOENCODING": "utf-8", "PYTHONUNBUFFERED": "1"}
# `ravg` stops as on Ctrl-C when its standard input closes: Windows has no signal for a process without a console.
_STOPPABLE = {"RAVG_STOP_WITH_STDIN": "1"}


def find_command(named: str) -> str:
    """Return the path of a command given by its path or its name on PATH, or raise FileNotFoundError."""
    found = shutil.which(os.path.expanduser(named.strip() or "ravg"))
    if found is None:
        raise FileNotFoundError(f"no command {named or 'ravg'!r}: {WHERE}")
    return found


class Version:
    """The version of a command, read in the background: a panel cannot wait for the answer."""

    def __init__(self, executable: str) -> None:
        self.executable = executable
        self._file = _version(Path(executable))
        self._text = ""
        try:
            self._process: subprocess.Popen[str] | None = subprocess.Popen(
                [executable, "--version"], stdin=subprocess.DEVNULL, stdout=subprocess.PIPE, stderr=subprocess.STDOUT,
                encoding="utf-8", errors="replace", env={**os.environ, **_PLAIN}, **_windowless(),
            )  # fmt: skip
        except OSError as error:
            self._process = None
            self._text = str(error)

    def is_of(self, executable: str) -> bool:
        """Whether the answer is that of a command, which may have been replaced."""
        return executable == self.executable and _version(Path(executable)) == self._file

    @property
    def known(self) -> bool:
        """Whether the command has answered."""
        return self._process is None or self._process.poll() is not None

    def problem(self, expected: str) -> str:
        """Wait for the answer; return why the command cannot be used, or "" if its version is `expected`, as in 0.2."""
        if self._process is not None:
            try:
                self._text = self._process.communicate(timeout=ANSWER_WITHIN)[0]
            except subprocess.TimeoutExpired:
                self._process.kill()
                self._text = f"no answer in {ANSWER_WITHIN:g} s"
            self._process = None
        found = re.search(r"^ravg (\d+\.\d+)\S*$", self._text, re.MULTILINE)
        if found is None:
            lines = [line.strip() for line in self._text.splitlines() if line.strip()]
            return f"{self.executable} does not start as ravg ({(lines or ['no output'])[-1]}): {WHERE}"
        if found[1] != expected:
            return f"{found[0]} is not of this extension's version, {expected}: {WHERE}"
        return ""


class Run:
    """A running command whose output goes to `log`; raises OSError if the command cannot be started.

    `outputs` are the files that it will write. Each is renamed into its place when complete, so that counting them
    measures the progress, but for frames that `--resume` leaves alone. `variables` are further ones of the environment.
    """

    def __init__(self, arguments: Sequence[str], outputs: Iterable[Path], log: Path, **variables: str) -> None:
        self._before = {path: _version(path) for path in outputs}
        self._log = log
        self._stopped_at: float | None = None
        with log.open("wb") as sink:
            self._process = subprocess.Popen(
                list(arguments), stdin=subprocess.PIPE, stdout=sink, stderr=subprocess.STDOUT,
                env={**os.environ, **_PLAIN, **_STOPPABLE, **variables}, **_windowless(),
            )  # fmt: skip

    @property
    def total(self) -> int:
        return len(self._before)

    @property
    def finished(self) -> int:
        """The number of finished frames; of those that were there before, only the log tells, up to a percent late."""
        made = sum(_version(path) not in (None, before) for path, before in self._before.items())
        counted = re.findall(r": (\d+) of \d+ frames(?:, \d+ %| are finished)", self.log)
        return max([made, *map(int, counted[-1:])])

    @property
    def stopped(self) -> bool:
        """Whether `stop` was called while the command ran."""
        return self._stopped_at is not None

    @property
    def code(self) -> int | None:
        """The exit code; None while the command runs. A stopped process that does not end is killed in time."""
        code = self._process.poll()
        if code is None and self._stopped_at is not None:
            waited = time.monotonic() - self._stopped_at
            with suppress(OSError):  # it may have ended meanwhile
                if waited > KILLED_AFTER:
                    self._process.kill()
                elif waited > TERMINATED_AFTER:
                    self._process.terminate()
        return code

    def stop(self) -> None:
        if self._stopped_at is None and self._process.poll() is None:
            self._stopped_at = time.monotonic()
            with suppress(OSError):
                self._process.stdin.close()

    def wait(self) -> int:
        while (code := self.code) is None:
            time.sleep(0.05)
        return code

    @property
    def log(self) -> str:
        return self._log.read_text(encoding="utf-8", errors="replace")

    @property
    def warnings(self) -> list[str]:
        marked = (line.partition("warning: ") for line in self.log.splitlines())
        return [text for before, mark, text in marked if mark and not before.strip()]

    @property
    def remaining(self) -> str:
        """The remaining time that the command printed last, such as ``7 min``; empty before the first."""
        return (re.findall(r"% *, about (.+) left$", self.log, re.MULTILINE) or [""])[-1]

    @property
    def error(self) -> str:
        """Why the command failed, in one line: its error message, else its last output."""
        # Usage errors are drawn in a frame: of box characters, or of + - | where the system has none.
        lines = [line.strip(" │╭╮╰╯─┌┐└┘|+") for line in self.log.splitlines()]
        lines = [line for line in lines if line.strip("-")]
        errors = [line.removeprefix("error: ") for line in lines if line.startswith("error: ")]
        return (errors or lines or [f"ravg ended with code {self.code}"])[-1]


def _windowless() -> dict[str, Any]:
    """Arguments that start a process without a console, its own or Blender's."""
    if sys.platform == "win32":
        return {"creationflags": subprocess.CREATE_NO_WINDOW}
    return {"start_new_session": True}  # Ctrl-C in Blender's terminal is Blender's


def _version(path: Path) -> tuple[int, int] | None:
    """Identify a file among others of its path; None if it is missing."""
    try:
        status = path.stat()
    except OSError:
        return None
    return status.st_ino, status.st_mtime_ns
