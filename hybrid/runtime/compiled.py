"""Cache of compiled loops, with a fallback where no folder can be written to.

numba loads this module because `hybrid.runtime.threads.CACHE_LOCATORS` names it. It would raise "cannot cache
function" where neither the package's folder nor the user's can be written to, as on a render farm, and any error of
unpickling a truncated file. It would use a loop that was compiled before a constant or a function from another module
changed. Where several processes need a loop, one compiles it and the others wait.
"""

import atexit
import hashlib
import logging
import os
import shutil
import stat
import sys
import tempfile
from collections.abc import Iterator
from contextlib import suppress
from functools import cache, lru_cache, wraps
from pathlib import Path
from types import CodeType, FunctionType
from typing import Any, Self

import numpy as np
from filelock import FileLock, Timeout
from numba.core.caching import Cache, UserWideCacheLocator

LOG = logging.getLogger("ravg")

PATIENCE = 60.0  # seconds to wait for another process that compiles a loop: five times as long as the longest takes


class Fallback(UserWideCacheLocator):
    """A folder among temporary files, if no other can be written to; no cache if this cannot either."""

    def __init__(self, py_func: Any, py_file: str) -> None:
        super().__init__(py_func, py_file)  # type: ignore[no-untyped-call]
        folder = _temporary_folder()
        # A path below the null device cannot be made: nothing is read from it or written to it.
        within = self.get_suitable_cache_subpath(py_file)  # type: ignore[no-untyped-call]
        self._cache_path = os.path.join(folder or os.devnull, within)

    @classmethod
    def from_function(cls, py_func: Any, py_file: str) -> Self:
        """Accept any function: this is the last locator."""
        return cls(py_func, py_file)


@lru_cache(maxsize=1)
def _temporary_folder() -> str | None:
    """A private folder of this user: its content is executed, so no other user may write to it."""
    try:
        folder = Path(tempfile.gettempdir()) / "ravg-compiled"
        if sys.platform != "win32":  # whose folder of temporary files is the user's own
            folder = folder.with_name(f"ravg-compiled-{os.geteuid()}")
        with suppress(FileExistsError):
            folder.mkdir(mode=0o700)
        if not _is_private(folder):
            folder = Path(tempfile.mkdtemp(prefix="ravg-compiled-"))
            atexit.register(shutil.rmtree, folder, ignore_errors=True)
        tempfile.TemporaryFile(dir=folder).close()
    except OSError:
        LOG.warning(
            "compiled loops cannot be kept anywhere: each run starts up to a minute later; "
            "set NUMBA_CACHE_DIR to a folder that can be written to"
        )
        return None
    LOG.info(f"compiled loops are kept in {folder}: neither where ravg is installed nor in ~/.cache can be written to")
    return str(folder)


def _is_private(folder: Path) -> bool:
    """Whether only this user can write to a folder."""
    status = folder.lstat()
    if sys.platform != "win32" and (status.st_uid != os.geteuid() or stat.S_IMODE(status.st_mode) & 0o077):
        return False
    return stat.S_ISDIR(status.st_mode)


def is_compiled_elsewhere(loop: Any) -> bool:
    """Whether another process compiles a loop now."""
    lock = _lock_of(loop._cache)
    with suppress(OSError, NotImplementedError):
        try:
            lock.acquire(timeout=0)
        except Timeout:
            return True
        lock.release()
    return False


def _lock_of(kept: Any) -> FileLock:
    """The lock of a loop's files, which the system releases if the process ends."""
    if not hasattr(kept, "lock"):
        kept.lock = FileLock(Path(kept.cache_path, f"{kept._impl.filename_base}.lock"))
    lock: FileLock = kept.lock
    return lock


def _load(load: Any) -> Any:
    def load_or_forget(self: Any, *args: Any) -> Any:
        try:
            return load(self, *args)
        except Exception as error:  # unpickling half a file may raise any error
            LOG.debug(f"compiled loops in {self.cache_path} cannot be read, and are compiled again: {error!r}")
            with suppress(OSError):
                self.flush()
            return None

    @wraps(load)
    def load_or_lock(self: Any, *args: Any) -> Any:
        found = load_or_forget(self, *args)
        if found is None:
            # A folder that cannot be written to, a time-out, or a file system without locks.
            with suppress(OSError, NotImplementedError):
                _lock_of(self).acquire(timeout=PATIENCE, poll_interval=0.02)
                found = load_or_forget(self, *args)  # another process may have compiled it
                if found is not None:
                    _lock_of(self).release()
        return found

    return load_or_lock


def _used_by(function: FunctionType, seen: set[FunctionType]) -> Iterator[str]:
    """Constants that a loop contains, and the files of functions that it calls; numba's key has its own file alone."""
    if function in seen:
        return
    seen.add(function)
    yield _digest_of(function.__code__.co_filename)
    codes = [function.__code__]
    for code in codes:
        codes += (constant for constant in code.co_consts if isinstance(constant, CodeType))
        for name in code.co_names:
            value = function.__globals__.get(name)
            if isinstance(called := getattr(value, "py_func", value), FunctionType):
                yield from _used_by(called, seen)
            elif isinstance(value, bool | int | float | str | tuple | np.generic):
                yield f"{name}={value!r}"
            elif isinstance(value, np.ndarray):
                yield f"{name}={value.dtype}{value.tolist()}"


@cache
def _digest_of(file: str) -> str:
    """Digest of a source file; empty where there is none, as in a zipped program."""
    with suppress(OSError):
        return hashlib.sha256(Path(file).read_bytes()).hexdigest()
    return ""


def _key(key: Any) -> Any:
    @wraps(key)
    def key_with_used(self: Any, *args: Any) -> Any:
        return (*key(self, *args), hashlib.sha256("\n".join(_used_by(self._py_func, set())).encode()).hexdigest())

    return key_with_used


def _save(save: Any) -> Any:
    @wraps(save)
    def save_or_leave(self: Any, *args: Any) -> None:
        try:
            save(self, *args)
        except Exception as error:  # a full disk, say, or half an index that cannot be replaced
            LOG.debug(f"compiled loops cannot be kept in {self.cache_path}: {error!r}")
        finally:
            _lock_of(self).release()

    return save_or_leave


Cache._index_key = _key(Cache._index_key)  # type: ignore[method-assign]
Cache.load_overload = _load(Cache.load_overload)  # type: ignore[method-assign]
Cache.save_overload = _save(Cache.save_overload)  # type: ignore[method-assign]
