"""Files that are whole or not there at all."""

from __future__ import annotations

import os
import platform
import re
import shutil
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
    temporary = _temporary(path)
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


@contextmanager
def temporary_folder(path: Path) -> Iterator[Path]:
    """Make a folder beside `path` to work in; it goes, with all that is in it, when the block ends.

    Parameters
    ----------
    path : Path
        What the folder is named after. The folder it is in is made, and cleared of what killed processes have left.

    Yields
    ------
    Path
        The folder.
    """
    path.parent.mkdir(parents=True, exist_ok=True)
    remove_leftovers(path.parent)
    folder = _temporary(path)
    _unfinished.add(folder)
    try:
        folder.mkdir(exist_ok=True)
        yield folder
    finally:
        _remove(folder)
        _unfinished.discard(folder)


def remove_unfinished() -> None:
    """Remove what this process is writing to, because it is about to end in the midst of it."""
    for temporary in tuple(_unfinished):
        _remove(temporary)


def remove_leftovers(folder: Path) -> None:
    """Remove temporary files and folders of processes that were killed: those of this host whose process is no more."""
    pattern = re.compile(rf"\..*\.{re.escape(_host())}-(\d+)-\d+\.tmp")
    for path in folder.iterdir():
        if (match := pattern.fullmatch(path.name)) and not _runs(int(match[1])):
            _remove(path)


def _temporary(path: Path) -> Path:
    # Host, process and thread: whoever else writes the same frame at the same time has a file of its own.
    return path.with_name(f".{path.name}.{_host()}-{os.getpid()}-{threading.get_ident()}.tmp")


def _remove(path: Path) -> None:
    if path.is_dir():
        shutil.rmtree(path, ignore_errors=True)
    else:
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
