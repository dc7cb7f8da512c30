"""Run a command in chunks of frames or shots on the workers of a Dask cluster.

A chunk runs in a process of its own on the worker, which returns all memory at the end and fails alone. Folders must be
shared under the same paths. Dask gives the chunk of a worker that has died to another worker, which skips what is
finished.
"""

import json
import os
import subprocess
import sys
import threading
import time
from collections.abc import Mapping, Sequence
from pathlib import Path
from typing import Any, NamedTuple
from uuid import uuid4

import typer

from hybrid.commands.log import LOG, Progress
from hybrid.runtime.interrupt import INTERRUPTED, interruptible

# Parameters that concern the submitting process alone.
NOT_PASSED_ON = ("scheduler", "chunk", "log_format", "log_file", "quiet", "verbose", "preview", "contact_sheet", "fps")
PATIENCE = 10  # seconds that a connection may take


class Chunk(NamedTuple):
    """A part of the work: arguments of its command, and its size in frames or samples."""

    arguments: Sequence[str]
    size: float


def arguments_of(context: typer.Context, changes: Mapping[str, Any]) -> list[str]:
    """Return the arguments of this command as they were given, with some parameters changed."""
    words, positional = [str(context.info_name)], []
    for parameter in context.command.params:
        name = str(parameter.name)
        value = changes.get(name, context.params.get(name))
        if name in NOT_PASSED_ON or value is None or value is False or value == "":
            continue
        values = [str(item) for item in value] if isinstance(value, list | tuple) else [str(value)]
        if parameter.param_type_name == "argument":
            positional += values
        elif value is True:
            words.append(_longest(parameter.opts))
        else:  # with "=", as a value may begin with a hyphen
            words += [f"{_longest(parameter.opts)}={item}" for item in values]
    return [*words, "--", *positional]


def _longest(names: Sequence[str]) -> str:
    return next(name for name in names if name.startswith("--"))


def run_on_cluster(address: str, title: str, chunks: Mapping[str, Chunk], unit: str = "frames") -> None:
    """Run chunks, by name, on the workers of a scheduler, and log their progress.

    Raises OSError if the scheduler does not answer, and typer.Exit with 1 if a chunk failed, after all others ended,
    or with 130 for Ctrl-C.
    """
    try:
        from distributed import Client, Event, as_completed
    except ModuleNotFoundError as error:
        raise ImportError('distributed is not installed; expected: pip install "distributed"') from error
    try:
        client = Client(address, timeout=PATIENCE, set_as_default=False)
    except (OSError, TimeoutError, ValueError) as error:
        raise OSError(f"no Dask scheduler answers at {address}, expected one as `dask scheduler` starts it") from error
    topic = f"ravg-{uuid4().hex}"
    with client:
        workers = client.scheduler_info()["workers"]
        LOG.info(f"{len(chunks)} chunks for {len(workers)} workers of {address}")
        if not workers:
            LOG.warning("the scheduler has no workers yet, expected some as `dask worker` starts them")
        bar, shares = Progress(title, sum(chunk.size for chunk in chunks.values()), unit), dict.fromkeys(chunks, 0.0)

        client.subscribe_topic(topic, lambda event: _log_record(event[1], chunks, shares, bar))
        stop, failed = Event(f"{topic}-stop", client=client), []
        folder, tasks = str(Path.cwd()), {}
        for name, chunk in chunks.items():
            key = f"{topic}-{name}"
            tasks[client.submit(run_chunk, name, list(chunk.arguments), folder, topic, key=key, pure=False)] = name

        def report() -> None:
            LOG.error("stopped: what is finished is kept; the same command goes on from there")

        try:
            with interruptible(report):
                for task in as_completed(list(tasks), loop=client.loop):
                    try:
                        words = task.result()
                    except Exception as lost:  # its workers died too often, or could not start it
                        words = str(lost)
                    if words:
                        failed.append(tasks[task])
                        LOG.error(f"{tasks[task]}: {words}")
                    else:
                        done = {"chunk": tasks[task], "percent": 100, "message": f"{tasks[task]} done"}
                        _log_record(done, chunks, shares, bar)
        except KeyboardInterrupt:
            stop.set()
            client.cancel(list(tasks))
            raise typer.Exit(INTERRUPTED) from None
        if failed:
            LOG.error(f"{len(failed)} of {len(chunks)} chunks were not made: {', '.join(failed)}")
            raise typer.Exit(1)


def _log_record(record: dict[str, Any], chunks: Mapping[str, Chunk], shares: dict[str, float], bar: Progress) -> None:
    """Log a warning of a chunk, or advance the bar by its progress."""
    name = record["chunk"]
    if "percent" in record:
        shares[name] = max(shares[name], record["percent"] / 100 * chunks[name].size)
        if (gained := sum(shares.values()) - bar.done) > 0:
            bar.advance(gained, record["message"])
    elif record["level"] == "warning":
        LOG.warning(f"{name}: {record['message']}")


def run_chunk(name: str, arguments: Sequence[str], folder: str, topic: str) -> str:
    """Run a chunk on a worker, and send its log records to the topic; return its error, or ""."""
    from distributed import Event, get_client, get_worker

    worker = get_worker()
    stop = Event(f"{topic}-stop", client=get_client())
    environment = {key: value for key, value in os.environ.items() if key not in ("RAVG_SCHEDULER", "RAVG_LOG_FILE")}
    if not Path(folder).is_dir():
        return f"there is no folder {folder} on {worker.address}, expected shared folders with the same paths"
    positional = list(arguments).index("--")
    words = [*arguments[:positional], "--log-format=json", *arguments[positional:]]
    process = subprocess.Popen(
        [sys.executable, "-m", "hybrid.cli", *words],
        cwd=folder,
        env={**environment, "PYTHONPATH": os.pathsep.join(filter(None, sys.path)), "PYTHONUTF8": "1"},
        stdin=subprocess.DEVNULL,
        stdout=subprocess.DEVNULL,
        stderr=subprocess.PIPE,
        text=True,
        encoding="utf-8",
        errors="replace",
    )

    def watch() -> None:
        while process.poll() is None:
            if stop.is_set():
                process.terminate()
                return
            time.sleep(0.5)

    threading.Thread(target=watch, daemon=True).start()
    last = ""
    for line in process.stderr or ():
        try:
            record = json.loads(line)
        except ValueError:  # of a library, or a traceback
            last = line.strip() or last
            continue
        if record["level"] == "error":
            last = record["message"]
        worker.log_event(topic, {"chunk": name, **record})
    code = process.wait()
    return "" if code == 0 else f"ended with {code} on {worker.address}: {last}"
