"""Messages and progress of a command: on a terminal, in the log of a farm, in a file.

All are records of one logger. Handlers print them as a progress bar and lines on a terminal, as lines elsewhere, as
JSON, or in the format of Open Job Description. Results, such as tables of `ravg compare`, are no records and go to
standard output.
"""

import codecs
import json
import logging
import os
import sys
import time
from collections.abc import Iterable, Iterator, Sequence
from contextlib import contextmanager
from pathlib import Path
from typing import TYPE_CHECKING, Any, Literal

from hybrid.runtime.streams import open_standard_streams

if TYPE_CHECKING:
    from rich.console import Console
    from rich.progress import Progress as Bar

LOG = logging.getLogger("ravg")
LOG.propagate = False

LogFormat = Literal["text", "json", "openjd"]
# ASCII replacements of the signs that are used here.
_PLAIN = {"≤": "<=", "×": "x", "–": "-", "−": "-", "—": "-", "…": "...", "·": ".", "≈": "~", "∞": "inf", "→": "->"}


def summarize(label: str, text: str) -> None:
    """Log a line of a command's summary: a label, and what it is about."""
    LOG.info(printable(text), extra={"label": label, "facts": {"label": label}})


class Progress:
    """Progress of a command's `task` in `total` steps of `unit`; every step is a record."""

    def __init__(self, task: str, total: float, unit: str = "frames") -> None:
        self.task, self.total, self.unit = task, total, unit
        self.done = 0.0
        self._start = time.monotonic()
        # Seconds and steps at the first advance: the first step also reads a whole window, which is not repeated.
        self._first: tuple[float, float] | None = None
        self._record(task, {})

    def advance(self, by: float = 1, message: str = "", **facts: object) -> None:
        self.done += by
        self._first = self._first or (self.elapsed, self.done)
        seconds, steps = self._first
        left = 0.0 if self.done == self.total else None
        if steps < self.done < self.total:
            left = (self.elapsed - seconds) / (self.done - steps) * (self.total - self.done)
        self._record(message or self.task, {**facts, **({} if left is None else {"seconds_left": round(left, 1)})})

    @property
    def elapsed(self) -> float:
        return time.monotonic() - self._start

    def _record(self, message: str, facts: dict[str, object]) -> None:
        share = self.done / self.total if self.total else 1.0
        facts = {"done": self.done, "total": self.total, "percent": round(100 * share, 1), **facts}
        LOG.info(message, extra={"facts": facts, "progress": self})


def start_log(
    form: LogFormat = "text", file: Path | None = None, *, quiet: bool = False, verbose: bool = False
) -> None:
    """Send records to standard error, and to a file; raise ValueError if the file is no text."""
    from rich.console import Console

    console = Console(stderr=True)
    on_terminal = form == "text" and console.is_terminal and not console.is_dumb_terminal
    handlers: list[logging.Handler] = [_Terminal(console) if on_terminal else _Lines(sys.stderr, form)]
    handlers[0].setLevel(logging.WARNING if quiet else logging.NOTSET)
    if file is not None:
        if file.exists() and (not file.is_file() or b"\0" in file.open("rb").read(4096)):
            raise ValueError(f"log-file {str(file)!r} is there and no text, expected a log or a new name")
        form = "json" if form == "json" else "text"
        handlers.append(_Lines(file.open("a", encoding="utf-8"), form, owns_stream=True))
    end_log()  # not before: errors of the file go to the old handlers
    LOG.setLevel(logging.DEBUG if verbose else logging.INFO)
    for handler in handlers:
        LOG.addHandler(handler)


def log_file() -> Path | None:
    names = [handler.stream.name for handler in LOG.handlers if isinstance(handler, _Lines) and handler.owns_stream]
    return Path(names[0]) if names else None


def end_log() -> None:
    for handler in tuple(LOG.handlers):
        LOG.removeHandler(handler)
        handler.close()


def print_table(heads: Sequence[str], rows: Iterable[Sequence[str]], title: str = "") -> None:
    """Print a table of results; names from files are no markup."""
    from rich.box import SIMPLE_HEAD
    from rich.console import Console
    from rich.table import Table
    from rich.text import Text

    table = Table(*heads, title=Text(title), title_justify="left", box=SIMPLE_HEAD, pad_edge=False)
    for row in rows:
        table.add_row(*(Text(printable(words)) for words in row))
    Console().print(table)


LONGEST = 2000  # most characters of a message, which may quote a file


def one_line(error: BaseException) -> str:
    """Return the message of an error in one printable line."""
    said = str(error)
    if isinstance(error, OSError) and error.strerror and error.filename is not None:
        said = f"{error.filename}: {error.strerror}"
    words = printable(" ".join(said.split()))
    return words if len(words) <= LONGEST else f"{words[: LONGEST // 2]}…{words[-LONGEST // 2 :]}"


def printable(words: str) -> str:
    """Escape control characters: a name from a file may hold sequences that control a terminal."""
    return "".join(c if c.isprintable() else c.encode("unicode_escape").decode("ascii") for c in words)


class _Lines(logging.StreamHandler[Any]):
    """Records as lines; progress of less than a percent is skipped, except for programs at the end of a frame."""

    def __init__(self, stream: Any, form: LogFormat, *, owns_stream: bool = False) -> None:
        super().__init__(stream)
        self.owns_stream = owns_stream
        self.setFormatter(_JsonLine() if form == "json" else _TextLine(times=owns_stream, openjd=form == "openjd"))
        self._each_frame = form != "text"
        self._percent = -1

    def emit(self, record: logging.LogRecord) -> None:
        facts = getattr(record, "facts", {})
        if hasattr(record, "progress"):
            if int(facts["percent"]) == self._percent and not (self._each_frame and "frame" in facts):
                return
            self._percent = int(facts["percent"])
        super().emit(record)

    def handleError(self, record: logging.LogRecord) -> None:
        """Ignore errors of a log that cannot be written."""

    def close(self) -> None:
        if self.owns_stream:
            self.stream.close()
        super().close()


class _TextLine(logging.Formatter):
    """Text; with `openjd`, also the lines that a worker of Open Job Description reads."""

    def __init__(self, *, times: bool = False, openjd: bool = False) -> None:
        super().__init__()
        self._times, self._openjd = times, openjd

    def format(self, record: logging.LogRecord) -> str:
        text = _message(record)
        facts = getattr(record, "facts", {})
        if (progress := getattr(record, "progress", None)) is not None:
            left = f", about {duration(facts['seconds_left'])} left" if "seconds_left" in facts else ""
            count = f"{progress.done:.0f} of {progress.total:.0f} {progress.unit}, " if progress.unit != "%" else ""
            text = f"{text}: {count}{facts['percent']:.0f} %{left}"
        lines = [text]
        if self._openjd and progress is not None:
            lines += [f"openjd_progress: {facts['percent']:.1f}", f"openjd_status: {text}"]
        if self._openjd and record.levelno >= logging.ERROR:
            lines.append(f"openjd_fail: {record.getMessage()}")
        if self._times:
            lines = [f"{_time(record)} {line}" for line in text.splitlines()]
        return "\n".join(lines)


class _JsonLine(logging.Formatter):
    """One JSON object per record: time, level, message, and facts."""

    def format(self, record: logging.LogRecord) -> str:
        document = {"time": _time(record), "level": record.levelname.lower(), "message": record.getMessage()}
        return json.dumps({**document, **getattr(record, "facts", {})}, default=str)


class _Terminal(logging.Handler):
    """Lines above a progress bar."""

    def __init__(self, console: "Console") -> None:
        super().__init__()
        self._console = console
        self._bar: Bar | None = None
        self._progress: Progress | None = None

    def emit(self, record: logging.LogRecord) -> None:
        progress = getattr(record, "progress", None)
        if progress is not None:
            self._show(progress, record.getMessage())
        else:
            if self._progress is not None and self._progress.done >= self._progress.total:
                self._stop()  # lines about the result stand below the bar
            self._console.print(_message(record), highlight=False, markup=False, soft_wrap=True)

    def close(self) -> None:
        self._stop()
        super().close()

    def _show(self, progress: Progress, text: str) -> None:
        from rich.progress import BarColumn, MofNCompleteColumn, TextColumn, TimeElapsedColumn, TimeRemainingColumn
        from rich.progress import Progress as Bar

        if self._progress is not progress:
            self._stop()
            words = TextColumn("{task.description}", markup=False), BarColumn(), MofNCompleteColumn()
            unit = TextColumn(progress.unit, markup=False)
            speed = TextColumn("{task.fields[rate]}", markup=False)
            self._bar = Bar(*words, unit, speed, TimeElapsedColumn(), TimeRemainingColumn(), console=self._console)
            self._bar.add_task(progress.task, total=progress.total, rate="")
            self._bar.start()
            self._progress = progress
        if self._bar is not None:
            rate = f"{progress.elapsed / progress.done:.2g} s each" if progress.done else ""
            self._bar.update(self._bar.task_ids[0], completed=progress.done, description=text, rate=rate)

    def _stop(self) -> None:
        if self._bar is not None:
            self._bar.stop()
        self._bar = self._progress = None


def _message(record: logging.LogRecord) -> str:
    before = f"{record.levelname.lower()}: " if record.levelno >= logging.WARNING else ""
    if (label := getattr(record, "label", None)) is not None:
        before = f"{label:<12}"
    return before + record.getMessage()


def _time(record: logging.LogRecord) -> str:
    return time.strftime("%Y-%m-%dT%H:%M:%S%z", time.localtime(record.created))


def duration(seconds: float) -> str:
    if seconds < 100:
        return f"{seconds:.0f} s"
    return f"{seconds / 60:.0f} min" if seconds < 6000 else f"{seconds / 3600:.1f} h"


@contextmanager
def tolerant_streams() -> Iterator[None]:
    """Let the command continue if standard output or error is closed or takes only ASCII."""
    open_standard_streams()
    before = sys.stdout, sys.stderr
    codecs.register_error("plain", _replace_sign)
    sys.stdout, sys.stderr = _TolerantStream.of(sys.stdout), _TolerantStream.of(sys.stderr)
    try:
        yield
    finally:
        for stream in (sys.stdout, sys.stderr):
            stream.flush()
        sys.stdout, sys.stderr = before


def _replace_sign(error: UnicodeError) -> tuple[str, int]:
    if not isinstance(error, UnicodeEncodeError):
        raise error
    return "".join(_PLAIN.get(sign, "?") for sign in error.object[error.start : error.end]), error.end


class _TolerantStream:
    """A stream that ignores errors of writing."""

    def __init__(self, stream: Any) -> None:
        self._stream = stream
        self._closed = False

    @classmethod
    def of(cls, stream: Any) -> Any:
        if stream is None:  # the stream was closed before Python started
            stream = Path(os.devnull).open("w", encoding="utf-8")  # noqa: SIM115 - open until the process ends
        if hasattr(stream, "reconfigure"):
            stream.reconfigure(errors="plain")
        return cls(stream)

    def write(self, text: str) -> int:
        if not self._closed:
            with self._ignoring_errors():
                self._stream.write(text)
        return len(text)

    def flush(self) -> None:
        if not self._closed:
            with self._ignoring_errors():
                self._stream.flush()

    def __getattr__(self, name: str) -> Any:
        return getattr(self._stream, name)

    @contextmanager
    def _ignoring_errors(self) -> Iterator[None]:
        try:
            yield
        except OSError:  # closed pipe, terminal hung up
            self._closed = True
            # Python's buffer would be written to the closed stream when the process ends.
            null = os.open(os.devnull, os.O_WRONLY)
            os.dup2(null, self._stream.fileno())
            os.close(null)
