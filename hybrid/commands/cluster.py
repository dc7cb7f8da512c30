"""Run a command in chunks of frames or shots on the workers of a Dask cluster.

A chunk runs in a process of its own on the worker (`hybrid.commands.chunks`). Folders must be shared under the same
paths. Dask gives the chunk of a worker that has died to another worker, which skips what is finished.
"""

from collections.abc import Mapping, Sequence
from functools import partial
from pathlib import Path
from uuid import uuid4

import typer

from hybrid.commands.chunks import Chunk, ChunkLog, log_stop, run_command
from hybrid.commands.log import LOG
from hybrid.runtime.interrupt import INTERRUPTED, interruptible


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
        client = Client(address, timeout=10, set_as_default=False)
    except (OSError, TimeoutError, ValueError) as error:
        raise OSError(f"no Dask scheduler answers at {address}, expected one as `dask scheduler` starts it") from error
    topic = f"ravg-{uuid4().hex}"
    with client:
        workers = client.scheduler_info()["workers"]
        LOG.info(f"{len(chunks)} chunks for {len(workers)} workers of {address}")
        if not workers:
            LOG.warning("the scheduler has no workers yet, expected some as `dask worker` starts them")
        log, stop = ChunkLog(title, chunks, unit), Event(f"{topic}-stop", client=client)
        client.subscribe_topic(topic, lambda event: log.add(event[1]["chunk"], event[1]))
        folder, tasks = str(Path.cwd()), {}
        for name, chunk in chunks.items():
            key = f"{topic}-{name}"
            tasks[client.submit(run_chunk, name, list(chunk.arguments), folder, topic, key=key, pure=False)] = name
        try:
            with interruptible(partial(log_stop, "the same command")):
                for task in as_completed(list(tasks), loop=client.loop):
                    try:
                        words = task.result()
                    except Exception as lost:  # its workers died too often, or could not start it
                        words = str(lost)
                    log.end(tasks[task], words)
        except KeyboardInterrupt:
            stop.set()
            client.cancel(list(tasks))
            raise typer.Exit(INTERRUPTED) from None
        log.finish()


def run_chunk(name: str, arguments: Sequence[str], folder: str, topic: str) -> str:
    """Run a chunk on a worker, and send its log records to the topic; return its error, or ""."""
    from distributed import Event, get_client, get_worker

    worker = get_worker()
    stop = Event(f"{topic}-stop", client=get_client())
    if not Path(folder).is_dir():
        return f"there is no folder {folder} on {worker.address}, expected shared folders with the same paths"
    fault = run_command(
        arguments, stop.is_set, lambda record: worker.log_event(topic, {"chunk": name, **record}), folder=folder
    )
    return fault and f"{fault} (on {worker.address})"
