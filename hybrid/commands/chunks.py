"""Run a command in chunks of frames or shots, each in a process of its own.

A process returns all memory at its end, and fails alone. `hybrid.commands.cluster` runs chunks on other machines.
"""

import json
import os
import subprocess
import sys
import threading
import time
from collections.abc import Callable, Iterable, Mapping, Sequence
from concurrent.futures import FIRST_COMPLETED, ThreadPoolExecutor, wait
from functools import partial
from pathlib import Path
from types import MappingProxyType
from typing import Any, NamedTuple

import typer

from hybrid.commands.log import LOG, Progress, summarize
from hybrid.runtime.interrupt import INTERRUPTED, STOP_WITH_STDIN, interruptible

# Parameters that concern the submitting process alone.
NOT_PASSED_ON = ("scheduler", "chunk", "log_format", "log_file", "quiet", "verbose", "preview", "contact_sheet", "fps")

ALIKE = "Settings", "Passes", "First pass", "Note"  # lines of a summary that do not depend on the frames of a chunk


class Chunk(NamedTuple):
    """A part of the work: arguments of its command, and its size in frames or samples."""

    arguments: Sequence[str]
    size: float


def arguments_of(context: typer.Context, changes: Mapping[str, Any]) -> list[str]:
    """Return the arguments of this command as they were given, with some parameters changed."""
    options, positional = [str(context.info_name)], []
    for parameter in context.command.params:
        name = str(parameter.name)
        value = changes.get(name, context.params.get(name))
        if name in NOT_PASSED_ON or value is None or value is False or value == "":
            continue
        values = [str(item) for item in value] if isinstance(value, list | tuple) else [str(value)]
        if parameter.param_type_name == "argument":
            positional += values
        elif value is True:
            options.append(_longest(parameter.opts))
        else:  # with "=", as a value may begin with a hyphen
            options += [f"{_longest(parameter.opts)}={item}" for item in values]
    return [*options, "--", *positional]


def _longest(names: Sequence[str]) -> str:
    return next(name for name in names if name.startswith("--"))


class ChunkLog:
    """Logs the progress, the warnings and the errors of all chunks, by the records of their processes."""

    def __init__(self, title: str, chunks: Mapping[str, Chunk], unit: str) -> None:
        self._chunks, self._shares = chunks, dict.fromkeys(chunks, 0.0)
        self._bar = Progress(title, sum(chunk.size for chunk in chunks.values()), unit)
        self._lock = threading.Lock()  # each chunk has a thread that reads its records
        self._failed: list[str] = []
        self._said: set[str] = set()  # lines of the summary
        self._errors: dict[str, list[str]] = {name: [] for name in chunks}  # those of each chunk that are logged

    def add(self, name: str, record: Mapping[str, Any]) -> None:
        """Log a warning, an error or a line of the summary, the latter two once, or advance the bar."""
        with self._lock:
            if "percent" in record:
                size = self._chunks[name].size
                self._shares[name] = max(self._shares[name], record["percent"] / 100 * size)
                if (gained := sum(self._shares.values()) - self._bar.done) > 0:
                    self._bar.advance(gained, record["message"])
            elif record.get("label") in ALIKE and record["message"] not in self._said:
                self._said.add(record["message"])
                summarize(record["label"], record["message"])
            elif record["level"] == "warning":
                LOG.warning(f"{name}: {record['message']}")
            elif record["level"] == "error" and record["message"] not in self._errors[name]:
                self._errors[name].append(record["message"])
                LOG.error(f"{name}: {record['message']}")

    def end(self, name: str, fault: str) -> None:
        """Log that a chunk is done, or its fault, without an error that is logged already."""
        if fault:
            self._failed.append(name)
            for message in self._errors[name]:
                if fault.endswith(f": {message}"):
                    return
                fault = fault.replace(f": {message}", "")
            LOG.error(f"{name}: {fault}")
        else:
            self.add(name, {"percent": 100, "message": f"{name} done"})

    def finish(self) -> None:
        """Raise typer.Exit with 1 if a chunk has failed."""
        if self._failed:
            LOG.error(f"{len(self._failed)} of {len(self._chunks)} chunks failed: {', '.join(self._failed)}")
            raise typer.Exit(1)


def log_stop(how: str) -> None:
    """Log that Ctrl-C has stopped all chunks, and how the work goes on."""
    LOG.error(f"stopped: what is finished is kept; {how} goes on from there")


def run_jobs(jobs: int, title: str, chunks: Mapping[str, Chunk]) -> None:
    """Run chunks, by name, on this machine, so many at a time, which share its cores, and log their progress.

    Raises typer.Exit with 1 if a chunk failed, after all others ended, or with 130 for Ctrl-C.
    """
    from loops.parallel import thread_count  # here, since numba takes a second to load

    log, stop = ChunkLog(title, chunks, "frames"), threading.Event()
    threads = {name: str(max(thread_count() // jobs, 1)) for name in ("NUMBA_NUM_THREADS", "OMP_NUM_THREADS")}
    with ThreadPoolExecutor(jobs) as pool:
        try:
            with interruptible(partial(log_stop, "--resume")):
                tasks = {
                    pool.submit(
                        run_command, chunk.arguments, stop.is_set, partial(log.add, name), environment=threads
                    ): name
                    for name, chunk in chunks.items()
                }
                waiting = set(tasks)
                while waiting:
                    # Windows delivers Ctrl-C only between two waits.
                    done, waiting = wait(waiting, timeout=0.2, return_when=FIRST_COMPLETED)
                    for task in done:
                        log.end(tasks[task], task.result())
        except BaseException as error:  # or the pool would wait for the other chunks
            stop.set()
            pool.shutdown(cancel_futures=True)
            if isinstance(error, KeyboardInterrupt):
                raise typer.Exit(INTERRUPTED) from None
            raise
    log.finish()


def run_command(
    arguments: Iterable[str],
    stopped: Callable[[], bool],
    add: Callable[[Mapping[str, Any]], object],
    *,
    folder: str | Path | None = None,
    environment: Mapping[str, str] = MappingProxyType({}),
) -> str:
    """Run a command of ravg in a process until it ends or is `stopped`; return its error, or "".

    It has this process's environment and these variables too, and ends with this process. `add` is called with each
    record of its log.
    """
    inherited = {key: value for key, value in os.environ.items() if key not in ("RAVG_SCHEDULER", "RAVG_LOG_FILE")}
    search = {"PYTHONPATH": os.pathsep.join(filter(None, sys.path)), "PYTHONUTF8": "1", STOP_WITH_STDIN: "1"}
    command = list(arguments)
    command.insert(command.index("--"), "--log-format=json")
    process = subprocess.Popen(
        [sys.executable, "-m", "hybrid.cli", *command],
        cwd=folder,
        env={**inherited, **search, **environment},
        stdin=subprocess.PIPE,
        stdout=subprocess.DEVNULL,
        stderr=subprocess.PIPE,
        text=True,
        encoding="utf-8",
        errors="replace",
    )

    def watch() -> None:
        while process.poll() is None:
            if stopped():
                process.terminate()
                return
            time.sleep(0.5)

    threading.Thread(target=watch, daemon=True).start()
    last = ""
    with process:
        for line in process.stderr or ():
            try:
                record = json.loads(line)
                level = record["level"]
            except (ValueError, TypeError, KeyError):  # of a library, or a traceback
                last = line.strip() or last
                continue
            if level == "error":
                last = record["message"]
            add(record)
    code = process.returncode
    return "" if code == 0 else f"ended with {code}: {last}"
