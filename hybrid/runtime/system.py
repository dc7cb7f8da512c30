"""The differences between Linux, macOS and Windows: locks, open files, processes and their memory."""

from __future__ import annotations

import multiprocessing
import os
import signal
import stat
import sys
import time
from collections.abc import Sequence
from multiprocessing.context import BaseContext
from pathlib import Path, PureWindowsPath

import psutil

#: Signals that ask a command to end. Windows has no SIGTERM from outside; Ctrl-Break takes its place.
if sys.platform == "win32":
    INTERRUPTS = (signal.SIGINT, signal.SIGTERM, signal.SIGBREAK)
else:
    INTERRUPTS = (signal.SIGINT, signal.SIGTERM)

# Another program may have a frame open for a moment: a viewer, a virus scanner, an indexer. Seconds.
_PATIENCE = 2.0
_INTERVAL = 0.05

if sys.platform == "win32":
    import ctypes
    import msvcrt
    from ctypes import wintypes

    _KERNEL = ctypes.WinDLL("kernel32", use_last_error=True)

    class _Overlapped(ctypes.Structure):
        """OVERLAPPED of the Windows API."""

        _fields_ = (
            ("internal", ctypes.c_size_t),
            ("internal_high", ctypes.c_size_t),
            ("offset", wintypes.DWORD),
            ("offset_high", wintypes.DWORD),
            ("event", wintypes.HANDLE),
        )

    _KERNEL.CreateFileW.restype = wintypes.HANDLE
    _KERNEL.CreateFileW.argtypes = (
        wintypes.LPCWSTR,
        wintypes.DWORD,
        wintypes.DWORD,
        ctypes.c_void_p,
        wintypes.DWORD,
        wintypes.DWORD,
        wintypes.HANDLE,
    )
    _KERNEL.LockFileEx.argtypes = (
        wintypes.HANDLE,
        wintypes.DWORD,
        wintypes.DWORD,
        wintypes.DWORD,
        wintypes.DWORD,
        ctypes.POINTER(_Overlapped),
    )

    # Constants of the Windows API.
    _GENERIC_READ_WRITE = 0xC0000000
    _FILE_SHARE_ALL = 0x7
    _CREATE_NEW, _OPEN_EXISTING = 1, 3
    _FILE_FLAG_OPEN_REPARSE_POINT = 0x00200000
    _LOCKFILE_EXCLUSIVE_NOW = 0x3
    _ERROR_LOCK_VIOLATION = 33
    # The path is not found, the name is too long: whatever the reason. MAX_PATH less the zero at its end.
    _ERRORS_OF_LENGTH, _LONGEST_PATH = (3, 206), 259
    # High half of the position of the byte that is locked. Locks of Windows are mandatory: a byte far behind the end
    # leaves the content to the libraries that open the same file by its name.
    _LOCKED_HIGH = 2**30

    def open_file(path: Path, *, new: bool) -> int:
        """Open a file for reading and writing; never follow a link.

        Other processes may read, write, rename and delete the file while it is open. Child processes do not inherit it.

        Parameters
        ----------
        path : Path
            The file.
        new : bool
            Create it. Otherwise it is there.

        Returns
        -------
        int
            A file descriptor.

        Raises
        ------
        OSError
            If it is there and `new`, if it is not there otherwise, or if it cannot be opened.
        """
        handle = _KERNEL.CreateFileW(
            str(path),
            _GENERIC_READ_WRITE,
            _FILE_SHARE_ALL,
            None,
            _CREATE_NEW if new else _OPEN_EXISTING,
            _FILE_FLAG_OPEN_REPARSE_POINT,
            None,
        )
        if handle in (None, wintypes.HANDLE(-1).value):
            error = ctypes.get_last_error()
            said = ctypes.FormatError(error).strip()
            if error in _ERRORS_OF_LENGTH and (length := len(str(path.absolute()))) > _LONGEST_PATH:
                said = f"with its temporary name the path has {length} characters, Windows takes {_LONGEST_PATH}"
            raise OSError(None, said, str(path), error)
        return msvcrt.open_osfhandle(handle, os.O_RDWR | os.O_BINARY | os.O_NOINHERIT)

    def lock_file(descriptor: int) -> None:
        """Lock an open file until it is closed, without waiting.

        Parameters
        ----------
        descriptor : int
            Of `open_file`.

        Raises
        ------
        BlockingIOError
            If somebody else holds the lock.
        OSError
            If the file system has no locks.
        """
        place = _Overlapped(offset_high=_LOCKED_HIGH)
        handle = msvcrt.get_osfhandle(descriptor)
        if not _KERNEL.LockFileEx(handle, _LOCKFILE_EXCLUSIVE_NOW, 0, 1, 0, ctypes.byref(place)):
            error = ctypes.get_last_error()
            kind = BlockingIOError if error == _ERROR_LOCK_VIOLATION else OSError
            raise kind(ctypes.FormatError(error).strip())

else:
    import fcntl
    import resource

    def open_file(path: Path, *, new: bool) -> int:
        """Open a file for reading and writing; never follow a link."""
        flags = os.O_RDWR | os.O_NOFOLLOW | os.O_NONBLOCK | os.O_CLOEXEC
        return os.open(path, flags | os.O_CREAT | os.O_EXCL if new else flags, 0o666)

    def lock_file(descriptor: int) -> None:
        """Lock an open file until it is closed, without waiting."""
        fcntl.flock(descriptor, fcntl.LOCK_EX | fcntl.LOCK_NB)


def sync_file(descriptor: int) -> None:
    """Wait until the content of an open file is on the disk."""
    if sys.platform == "darwin":  # fsync of macOS leaves it in the disk's own cache
        try:
            fcntl.fcntl(descriptor, fcntl.F_FULLFSYNC)
            return
        except OSError:  # not on this file system
            pass
    os.fsync(descriptor)


def replace_path(source: Path, target: Path) -> None:
    """Rename a file to a name that may be there.

    Windows refuses this while another program has `target` open. It is tried for `_PATIENCE` seconds then.

    Parameters
    ----------
    source, target : Path
        In one folder.

    Raises
    ------
    OSError
        If that fails.
    """
    end = time.monotonic() + (_PATIENCE if sys.platform == "win32" else 0.0)
    while True:
        try:
            os.replace(source, target)
            return
        except PermissionError as error:
            if is_read_only(target):
                raise type(error)(error.errno, "the file there is read-only", str(source)) from None
            if time.monotonic() >= end:
                raise
            time.sleep(_INTERVAL)


def is_read_only(path: Path) -> bool:
    """Whether Windows keeps a file from being replaced by its read-only attribute; never so on other systems."""
    if sys.platform != "win32":
        return False
    try:
        return not path.lstat().st_mode & stat.S_IWRITE
    except OSError:
        return False


def is_reserved(path: Path) -> bool:
    """Whether Windows does not take the name for a file: aux, con, nul, a dot at the end; never so on other systems."""
    if sys.platform != "win32":
        return False
    reserved = getattr(os.path, "isreserved", None)  # of Python 3.13, where the other is deprecated
    return bool(reserved(path.name) if reserved else PureWindowsPath(path.name).is_reserved())


def expand_home(words: Sequence[str]) -> list[str]:
    """Put the user's folder in the place of ``~`` at the beginning of words, which no shell of Windows does."""
    if sys.platform != "win32":
        return [*words]
    return [os.path.expanduser(word) if word == "~" or word.startswith(("~/", "~\\")) else word for word in words]


def same_file(one: os.stat_result, other: os.stat_result) -> bool:
    """Whether two statuses are of one file, as far as its file system numbers files; network drives may not.

    Parameters
    ----------
    one, other : os.stat_result
        Of two paths.
    """
    return not (one.st_ino and other.st_ino) or os.path.samestat(one, other)


def process_lives(number: int) -> bool:
    """Whether a process of this machine lives. Unlike ``os.kill(number, 0)``, which is Ctrl-C on Windows."""
    return bool(psutil.pid_exists(number))


def peak_memory() -> int:
    """Return the peak resident memory of this process, in bytes, as the operating system counted it."""
    if sys.platform == "win32":
        return int(psutil.Process().memory_info().peak_wset)
    else:
        try:
            # Unlike getrusage's, Linux's own count does not include that of the process which started this one.
            lines = Path("/proc/self/status").read_text(encoding="ascii").splitlines()
            return next(int(line.split()[1]) * 1024 for line in lines if line.startswith("VmHWM:"))
        except (OSError, StopIteration):
            peak = resource.getrusage(resource.RUSAGE_SELF).ru_maxrss
            return peak if sys.platform == "darwin" else peak * 1024  # macOS counts bytes, others KiB


def start_context(preloaded: str) -> BaseContext:
    """Return how fresh processes are started.

    Parameters
    ----------
    preloaded : str
        Module that the processes need. On Linux a server imports it once, and they are forked from there. Windows has
        no fork, and libraries of macOS forbid it after their import: a process begins anew there.

    Returns
    -------
    multiprocessing.context.BaseContext
    """
    if sys.platform != "linux":
        return multiprocessing.get_context("spawn")
    context = multiprocessing.get_context("forkserver")
    context.set_forkserver_preload([preloaded])
    return context


def load_average() -> float | None:
    """Return the load average of the last minute; None where the system has none (Windows)."""
    if sys.platform == "win32":
        return None
    else:
        return os.getloadavg()[0]
