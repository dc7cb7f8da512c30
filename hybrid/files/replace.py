"""Atomic writes: a file appears whole or not at all (`replace_file`), and never replaces an input (`check_outputs`)."""

import os
import re
import secrets
import shutil
import stat
from collections.abc import Iterable, Iterator
from contextlib import contextmanager, suppress
from pathlib import Path

from hybrid.runtime.system import is_reserved, lock_file, open_file, replace_path, same_file, sync_file

_unfinished: set[Path] = set()  # temporary files and folders of this process
_TEMPORARY = re.compile(r"\..+\.ravg-[0-9a-f]{16}\.tmp", re.DOTALL)
_LOCK = ".lock"


def check_outputs(outputs: Iterable[tuple[str, Path]], inputs: Iterable[tuple[str, Path]]) -> None:
    """Raise ValueError if an output would overwrite an input, by any name, or another output; OSError if it is no file.

    Files come with a name for the message (``output``, ``preview``). Inputs may be read by another run.
    """
    names: dict[object, str] = {}
    for name, path in inputs:
        names |= dict.fromkeys(identities(path), f"{name} {str(path)!r}")
    written: dict[object, str] = {}
    for name, path in outputs:
        refuse_other_kinds(path)
        known = set(identities(path))
        for identity in known:
            if identity in names:
                raise ValueError(f"{name} {str(path)!r} would overwrite an input: {names[identity]}")
            if identity in written:
                raise ValueError(f"{name} {str(path)!r} would overwrite {written[identity]}")
        written |= dict.fromkeys(known, f"{name} {str(path)!r}")


def identities(path: Path) -> Iterator[object]:
    """Yield the identities of a file: its path without links, and its device and inode."""
    # Not Path.resolve, which raises RuntimeError for a loop of links.
    yield os.path.realpath(path)
    yield os.path.join(os.path.realpath(path.parent), path.name)  # a link itself, which would be replaced
    with suppress(OSError):
        status = path.stat()
        if status.st_ino:  # 0 on some network drives of Windows
            yield status.st_dev, status.st_ino


def refuse_other_kinds(path: Path) -> None:
    """Raise OSError for a path that is no regular file: reading a pipe would block, a device has no end."""
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
    """Yield an empty temporary file in the same folder; rename it to `path` if the block ends without error.

    The temporary file is removed if the block raises, KeyboardInterrupt included. If `path` is a link, the link is
    replaced, not its target. Raises OSError, which names `path`, if the folder cannot be written to, `path` is no
    regular file, or another process has replaced the temporary file.
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
        # An error in the middle of writing, as on a full disk, names no file.
        if isinstance(error, OSError) and error.errno and error.filename in (None, str(temporary)):
            raise type(error)(error.errno, f"cannot write: {error.strerror}", str(path)) from None
        raise
    finally:
        _unfinished.discard(temporary)
        os.close(descriptor)


def write_file(path: Path, content: str | bytes) -> None:
    """Write a file by `replace_file`; text as UTF-8."""
    with replace_file(path) as temporary:
        temporary.write_bytes(content.encode() if isinstance(content, str) else content)


@contextmanager
def temporary_folder(path: Path) -> Iterator[Path]:
    """Yield a temporary folder named after `path`, in the same folder; it is removed when the block ends.

    The parent folder is made, and cleared of the leftovers of killed processes.
    """
    path.parent.mkdir(parents=True, exist_ok=True)
    remove_leftovers(path.parent)
    # Folders cannot be locked everywhere (NFS), so the lock is a file in the same folder that outlives it.
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
    """Remove the temporary files of this process, which is about to end."""
    for temporary in tuple(_unfinished):
        _remove(temporary)


def remove_leftovers(folder: Path) -> None:
    """Remove temporary files and folders of processes that have ended.

    Each is locked by its writer, and the kernel drops the lock with the process. The lock works across containers,
    which may give two processes one number, and across machines if the file system locks for all its clients (NFS).
    Without locks nothing is removed.
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
    """Make a file with an unguessable name in the folder of `path`; return it, open and locked."""
    while True:
        # Unguessable, and never opened if it exists: nobody can have placed a link there to write through. With all of
        # the file's name it might be longer than the 255 bytes that folders allow.
        name = f".{path.name[:24]}.ravg-{secrets.token_hex(8)}.tmp{suffix}"
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
        except BlockingIOError:  # another process that clears up was faster
            locked = False
        except OSError:  # this file system has no locks: then no process clears up
            pass
        if locked and _is(temporary, descriptor):
            return temporary, descriptor
        _unfinished.discard(temporary)
        os.close(descriptor)
        _remove(temporary)


def _is(path: Path, descriptor: int) -> bool:
    """Whether a path is still that of an open file."""
    try:
        here = path.lstat()
    except FileNotFoundError:
        return False
    return same_file(here, os.fstat(descriptor))


@contextmanager
def _abandoned(lock: Path) -> Iterator[bool]:
    """Yield whether no process holds the lock on a file, or the file is gone; the lock is held within the block."""
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
