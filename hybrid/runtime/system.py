"""The differences between Linux, macOS and Windows: locks, open files, processes and their memory."""

import multiprocessing
import os
import platform
import signal
import stat
import subprocess
import sys
import threading
import time
from collections.abc import Callable, Sequence
from multiprocessing.context import BaseContext
from pathlib import Path, PureWindowsPath

import psutil

#: Signals that ask a command to end. Windows has no SIGTERM from outside; Ctrl-Break takes its place.
if sys.platform == "win32":
    INTERRUPTS = (signal.SIGINT, signal.SIGTERM, signal.SIGBREAK)
else:
    INTERRUPTS = (signal.SIGINT, signal.SIGTERM)

# Seconds to wait while another program has a frame open: a viewer, a virus scanner, an indexer.
_PATIENCE = 2.0

if sys.platform == "win32":
    import ctypes
    import msvcrt
    import winreg
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
    _DWORD = wintypes.DWORD
    _KERNEL.CreateFileW.argtypes = (wintypes.LPCWSTR, _DWORD, _DWORD, ctypes.c_void_p, _DWORD, _DWORD, wintypes.HANDLE)
    _KERNEL.LockFileEx.argtypes = (wintypes.HANDLE, _DWORD, _DWORD, _DWORD, _DWORD, ctypes.POINTER(_Overlapped))

    # Constants of the Windows API.
    _GENERIC_READ_WRITE = 0xC0000000
    _FILE_SHARE_ALL = 0x7
    _CREATE_NEW, _OPEN_EXISTING = 1, 3
    _FILE_FLAG_OPEN_REPARSE_POINT = 0x00200000
    _LOCKFILE_EXCLUSIVE_NOW = 0x3
    _ERROR_LOCK_VIOLATION = 33
    # Path not found, name too long: Windows reports either for a long path. MAX_PATH less its terminating zero.
    _ERRORS_OF_LENGTH, _LONGEST_PATH = (3, 206), 259
    # High half of the position of the locked byte. Locks of Windows are mandatory: with a byte far behind the end,
    # libraries can still open the same file by its name.
    _LOCKED_HIGH = 2**30

    def open_file(path: Path, *, new: bool) -> int:
        """Open or create a file for reading and writing, and return its descriptor; never follow a link.

        Other processes may read, write, rename and delete the file while it is open. Child processes do not inherit it.
        Raises OSError if a `new` file exists, or another one does not.
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

        Raises BlockingIOError if another process holds the lock, OSError if the file system has no locks.
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
    """Wait until the content of an open file is on disk."""
    if sys.platform == "darwin":  # fsync of macOS leaves it in the disk's own cache
        try:
            fcntl.fcntl(descriptor, fcntl.F_FULLFSYNC)
            return
        except OSError:  # not on this file system
            pass
    os.fsync(descriptor)


def replace_path(source: Path, target: Path) -> None:
    """Rename a file in its folder, replacing `target`; on Windows retry for `_PATIENCE` seconds while it is open."""
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
            time.sleep(0.05)


def is_read_only(path: Path) -> bool:
    """Whether Windows protects a file by its read-only attribute; False on other systems."""
    if sys.platform != "win32":
        return False
    try:
        return not path.lstat().st_mode & stat.S_IWRITE
    except OSError:
        return False


def is_reserved(path: Path) -> bool:
    """Whether Windows reserves the file's name: aux, con, nul, a dot at the end; False on other systems."""
    if sys.platform != "win32":
        return False
    reserved = getattr(os.path, "isreserved", None)  # since Python 3.13, which deprecates is_reserved
    return bool(reserved(path.name) if reserved else PureWindowsPath(path.name).is_reserved())


def expand_home(words: Sequence[str]) -> list[str]:
    """Replace ``~`` at the beginning of words by the user's folder, on Windows, whose shells do not."""
    if sys.platform != "win32":
        return [*words]
    return [os.path.expanduser(word) if word == "~" or word.startswith(("~/", "~\\")) else word for word in words]


def same_file(one: os.stat_result, other: os.stat_result) -> bool:
    """Return whether two statuses are of one file; by size and time where inodes differ, True where there are none."""
    if not (one.st_ino and other.st_ino) or os.path.samestat(one, other):
        return True
    return (one.st_size, one.st_mtime_ns) == (other.st_size, other.st_mtime_ns)


def process_lives(number: int) -> bool:
    """Whether a process of this machine is alive. ``os.kill(number, 0)`` would be Ctrl-C on Windows."""
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


def thread_clock() -> Callable[[], float]:
    """Return a function that other threads call for the CPU seconds of this one, while it runs."""
    if sys.platform != "win32" and sys.platform != "darwin":
        clock = time.pthread_getcpuclockid(threading.get_ident())
        return lambda: time.clock_gettime(clock)
    number, process = threading.get_native_id(), psutil.Process()
    return lambda: next((float(t.user_time + t.system_time) for t in process.threads() if t.id == number), 0.0)


def start_context(preloaded: str) -> BaseContext:
    """Return the context that starts fresh processes, which need the module `preloaded`.

    On Linux a server imports it once, and processes are forked from the server. Windows has no fork, and libraries of
    macOS forbid it after their import: processes are spawned there.
    """
    if sys.platform != "linux":
        return multiprocessing.get_context("spawn")
    context = multiprocessing.get_context("forkserver")
    context.set_forkserver_preload([preloaded])
    return context


def load_average() -> float | None:
    """Return the load average of the last minute; None on Windows, which has none."""
    if sys.platform == "win32":
        return None
    else:
        return os.getloadavg()[0]


def processor_name() -> str:
    """Return the processor's name, or its architecture if the system names none."""
    try:
        if sys.platform == "win32":
            with winreg.OpenKey(winreg.HKEY_LOCAL_MACHINE, r"HARDWARE\DESCRIPTION\System\CentralProcessor\0") as key:
                name = str(winreg.QueryValueEx(key, "ProcessorNameString")[0])
        elif sys.platform == "darwin":
            command = ["sysctl", "-n", "machdep.cpu.brand_string"]
            name = subprocess.check_output(command, text=True, stderr=subprocess.DEVNULL)
        else:
            lines = Path("/proc/cpuinfo").read_text(encoding="utf-8").splitlines()
            name = next(line.partition(":")[2] for line in lines if line.startswith("model name"))
    except (OSError, StopIteration, subprocess.CalledProcessError):
        name = ""
    return name.strip() or platform.machine()
