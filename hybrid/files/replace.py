"""Files that are whole or not there at all, and never somebody else's.

Whatever a command writes goes through here: `check_outputs` before anything is made, `replace_file` when it is.
"""

from __future__ import annotations

import os
import re
import secrets
import shutil
import stat
from collections.abc import Iterable, Iterator
from contextlib import contextmanager, suppress
from pathlib import Path

from hybrid.runtime.system import is_reserved, lock_file, open_file, replace_path, same_file, sync_file

# What this process is writing to just now.
_unfinished: set[Path] = set()
# Of a file's name so much is kept in its temporary name that folders which take 255 bytes take that too.
_KEPT = 24
_TEMPORARY = re.compile(r"\..+\.ravg-[0-9a-f]{16}\.tmp", re.DOTALL)
_LOCK = ".lock"


def check_outputs(outputs: Iterable[tuple[str, Path]], inputs: Iterable[tuple[str, Path]]) -> None:
    """Refuse to write over anything that is read, over what is no file, or to one place twice.

    Parameters
    ----------
    outputs : iterable of (str, Path)
        What is to be written: what to call it (``output``, ``preview``), and where.
    inputs : iterable of (str, Path)
        What is read, whether or not in this very run: what to call it, and where.

    Raises
    ------
    ValueError
        If an output is an input by whatever name (links, another spelling), or another output.
    OSError
        If an output is a folder, a device, a pipe or a socket.
    """
    names: dict[object, str] = {}
    for what, path in inputs:
        names |= dict.fromkeys(identities(path), f"{what} {str(path)!r}")
    written: dict[object, str] = {}
    for what, path in outputs:
        refuse_other_kinds(path)
        own = set(identities(path))
        for name in own:
            if name in names:
                raise ValueError(f"{what} {str(path)!r} would overwrite an input: {names[name]}")
            if name in written:
                raise ValueError(f"{what} {str(path)!r} would overwrite {written[name]}")
        written |= dict.fromkeys(own, f"{what} {str(path)!r}")


def identities(path: Path) -> Iterator[object]:
    """All that a file may be recognized by: its path without links, and what the operating system knows it by."""
    # Not Path.resolve, which raises RuntimeError for a loop of links.
    yield os.path.realpath(path)
    yield os.path.join(os.path.realpath(path.parent), path.name)  # a link itself, which would be replaced
    with suppress(OSError):
        status = path.stat()
        if status.st_ino:  # 0 on some network drives of Windows
            yield status.st_dev, status.st_ino


def refuse_other_kinds(path: Path) -> None:
    """Raise OSError for what is there and no file: a pipe would be waited for, a device has no end."""
    if is_reserved(path):
        raise OSError(f"{path}: Windows does not take {path.name!r} as a name of a file, expected another")
    try:
        mode = path.stat().st_mode
    except OSError:  # nothing there, or a link to nothing, which is replaced
        return
    if not stat.S_ISREG(mode):
        kinds = {stat.S_IFDIR: "folder", stat.S_IFIFO: "pipe", stat.S_IFSOCK: "socket"}
        raise OSError(f"{path} is a {kinds.get(stat.S_IFMT(mode), 'device')}, expected a file or a new name")


@contextmanager
def replace_file(path: Path) -> Iterator[Path]:
    """Give a temporary name beside `path` to write to; rename it to `path` when the block ends without error.

    Parameters
    ----------
    path : Path
        The file to be written, in a folder that exists. If it is a link, the link is replaced, not what it leads to.

    Yields
    ------
    Path
        An empty file, which only this process knows of. It is removed where the block raises, a keyboard interrupt
        included.

    Raises
    ------
    OSError
        If the folder cannot be written to, `path` is there and no file, or somebody has put another file in the
        place of the temporary one. It names `path`, not the temporary file.
    """
    refuse_other_kinds(path)
    temporary, descriptor = _create(path)
    try:
        yield temporary
        sync_file(descriptor)
        if not _is(temporary, descriptor):
            raise OSError(f"{path}: cannot write: its temporary file was exchanged")
        replace_path(temporary, path)
    except BaseException as error:
        with suppress(OSError):
            if _is(temporary, descriptor):
                temporary.unlink()
        # What fails in the middle of writing, as on a full disk, names no file at all.
        if isinstance(error, OSError) and error.errno and error.filename in (None, str(temporary)):
            raise type(error)(error.errno, f"cannot write: {error.strerror}", str(path)) from None
        raise
    finally:
        _unfinished.discard(temporary)
        os.close(descriptor)


def write_file(path: Path, content: str | bytes) -> None:
    """Write a file whole or not at all.

    Errors are those of `replace_file`.

    Parameters
    ----------
    path : Path
        The file to be written, in a folder that exists.
    content : str or bytes
        Text is written as UTF-8.
    """
    with replace_file(path) as temporary:
        temporary.write_bytes(content.encode() if isinstance(content, str) else content)


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
    # Folders cannot be locked everywhere (NFS), so the lock is a file beside it, which is there for longer.
    lock, descriptor = _create(path, _LOCK)
    folder = lock.with_name(lock.name.removesuffix(_LOCK))
    _unfinished.add(folder)
    try:
        folder.mkdir(mode=0o777)
        yield folder
    finally:
        _remove(folder)
        _unfinished.discard(folder)
        _remove(lock)
        _unfinished.discard(lock)
        os.close(descriptor)


def remove_unfinished() -> None:
    """Remove what this process is writing to, because it is about to end in the midst of it."""
    for temporary in tuple(_unfinished):
        _remove(temporary)


def remove_leftovers(folder: Path) -> None:
    """Remove temporary files and folders of processes that are no more.

    Each is locked by who writes it, and the kernel drops the lock with the process. That holds across containers,
    which may give two processes one number, and where the folder's file system locks for all its clients (NFS), across
    machines. Where it does not lock at all, nothing is removed.
    """
    for path in folder.iterdir():
        if not _TEMPORARY.fullmatch(path.name.removesuffix(_LOCK)):
            continue
        lock = path.with_name(path.name + _LOCK) if path.is_dir() and not path.is_symlink() else path
        with _abandoned(lock) as abandoned:
            if abandoned:
                _remove(path)
                _remove(lock)


def _create(path: Path, suffix: str = "") -> tuple[Path, int]:
    """A new file with a name beside `path` that nobody can guess, open and locked."""
    while True:
        # Unguessable, and never opened where something is: nobody can have put a link there to be written through.
        name = f".{path.name[:_KEPT]}.ravg-{secrets.token_hex(8)}.tmp{suffix}"
        temporary = path.with_name(name)
        _unfinished.add(temporary)
        try:
            descriptor = open_file(temporary, new=True)
        except OSError as error:
            _unfinished.discard(temporary)
            if isinstance(error, FileExistsError):
                continue
            raise type(error)(error.errno, f"cannot write: {error.strerror}", str(path)) from None
        locked = True
        try:
            lock_file(descriptor)
        except BlockingIOError:  # somebody who clears up was faster
            locked = False
        except OSError:  # this file system has no locks: then nobody clears up
            pass
        if locked and _is(temporary, descriptor):
            return temporary, descriptor
        _unfinished.discard(temporary)
        os.close(descriptor)
        _remove(temporary)


def _is(path: Path, descriptor: int) -> bool:
    """Whether a path still leads to an open file."""
    try:
        here = path.lstat()
    except FileNotFoundError:
        return False
    return same_file(here, os.fstat(descriptor))


@contextmanager
def _abandoned(lock: Path) -> Iterator[bool]:
    """Tell whether nobody holds the lock on a file, or the file is gone; nobody can take it within the block."""
    try:
        descriptor = open_file(lock, new=False)
    except FileNotFoundError:
        yield True
        return
    except OSError:  # a link, or not ours
        yield False
        return
    free = True
    try:
        try:
            lock_file(descriptor)
        except OSError:
            free = False
        yield free
    finally:
        os.close(descriptor)


def _remove(path: Path) -> None:
    if path.is_dir() and not path.is_symlink():
        shutil.rmtree(path, ignore_errors=True)
    else:
        with suppress(OSError):
            path.unlink()
