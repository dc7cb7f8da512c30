"""Files that are whole or not there at all."""

from __future__ import annotations

import os
import platform
import re
import threading
from collections.abc import Iterator
from contextlib import contextmanager, suppress
from pathlib import Path

# What this process is writing to just now.
_unfinished: set[Path] = set()


@contextmanager
def replace_file(path: Path) -> Iterator[Path]:
    """Give a temporary name beside `path` to write to; rename it to `path` when the block ends without error.

    Parameters
    ----------
    path : Path
        The file to be written, in a folder that exists.

    Yields
    ------
    Path
        An empty file. It is removed where the block raises, a keyboard interrupt included.

    Raises
    ------
    OSError
        If the folder cannot be written to; it names `path`, not the temporary file.
    """
    # Host, process and thread: whoever else writes the same frame at the same time has a file of its own.
    writer = f"{_host()}-{os.getpid()}-{threading.get_ident()}"
    temporary = path.with_name(f".{path.name}.{writer}.tmp")
    _unfinished.add(temporary)
    try:
        with temporary.open("wb"):
            pass
        yield temporary
        with temporary.open("rb+") as file:
            os.fsync(file.fileno())
        os.replace(temporary, path)
    except BaseException as error:
        with suppress(OSError):
            temporary.unlink()
        if isinstance(error, OSError) and error.filename == str(temporary):
            raise type(error)(error.errno, f"cannot write: {error.strerror}", str(path)) from None
        raise
    finally:
        _unfinished.discard(temporary)


def remove_unfinished() -> None:
    """Remove what this process is writing to, because it is about to end in the midst of it."""
    for temporary in tuple(_unfinished):
        with suppress(OSError):
            temporary.unlink()


def remove_leftovers(folder: Path) -> None:
    """Remove temporary files of processes that were killed: those of this host whose process is no more."""
    pattern = re.compile(rf"\..*\.{re.escape(_host())}-(\d+)-\d+\.tmp")
    for path in folder.iterdir():
        if (match := pattern.fullmatch(path.name)) and not _runs(int(match[1])):
            with suppress(OSError):
                path.unlink()


def _host() -> str:
    return re.sub(r"\W", "_", platform.node()) or "host"


def _runs(process: int) -> bool:
    try:
        os.kill(process, 0)
    except ProcessLookupError:
        return False
    except OSError:  # it runs, and is somebody else's
        pass
    return True
