"""Where compiled loops are kept, and what becomes of them where that fails.

numba asks this module because `hybrid.threads.CACHE_LOCATORS` names it. It would raise "cannot cache function" where
neither the package's folder nor the user's can be written to, as on a render farm, and whatever unpickling raises where
a file was cut short.

As a program it compiles the loop that takes longest, for the process that has started it beside its own work.
"""

from __future__ import annotations

import atexit
import logging
import os
import shutil
import stat
import subprocess
import sys
import tempfile
from contextlib import suppress
from functools import lru_cache, wraps
from pathlib import Path
from typing import Any

import numpy as np
from numba.core import event
from numba.core.caching import Cache, UserWideCacheLocator

LOG = logging.getLogger("ravg")

# Of all that a first run compiles, non-local means take a third of the time, and are called for last.
_LONGEST = "nlm.nonlocal_means"


class _FirstRun(event.Listener):
    """Where a loop is compiled, that is said, and another core compiles the longest one meanwhile."""

    begun = False
    beside: subprocess.Popen[bytes] | None = None

    def on_start(self, event: Any) -> None:
        if self.begun:
            return
        self.begun = True
        LOG.info("compiling for this processor, once: some ten seconds, and kept for later runs")
        kept = (
            getattr(event.data["dispatcher"]._cache, "cache_path", None) or os.devnull
        )  # a loop that is not kept has none
        if not kept.startswith(os.devnull):
            options: dict[str, Any] = dict.fromkeys(("stdin", "stdout", "stderr"), subprocess.DEVNULL)
            if sys.platform == "win32":  # no console window of its own where this process has none
                options["creationflags"] = subprocess.CREATE_NO_WINDOW
            with suppress(OSError):
                self.beside = subprocess.Popen([sys.executable, "-m", "hybrid.runtime.compiled"], **options)

    def on_end(self, event: Any) -> None:
        pass

    def has_made(self, loop: Any) -> bool:
        """Whether that other process was to make a loop; it has ended then."""
        if self.beside is None or loop.__module__ != _LONGEST:
            return False
        with suppress(subprocess.TimeoutExpired):
            self.beside.wait(60)
        return True


_FIRST_RUN = _FirstRun()


@lru_cache(maxsize=1)
def watch_compiling() -> None:
    """Say so, once, where loops are compiled, and use two cores for it; later runs find them."""
    event.register("numba:compile", _FIRST_RUN)  # type: ignore[no-untyped-call]


class Fallback(UserWideCacheLocator):
    """A folder among temporary files, where no other can be written to; none at all, where not even that can."""

    def __init__(self, py_func: Any, py_file: str) -> None:
        super().__init__(py_func, py_file)  # type: ignore[no-untyped-call]
        folder = _temporary_folder()
        # A name that cannot be made: nothing is found there, and what cannot be written is done without.
        within = self.get_suitable_cache_subpath(py_file)  # type: ignore[no-untyped-call]
        self._cache_path = os.path.join(folder or os.devnull, within)

    @classmethod
    def from_function(cls, py_func: Any, py_file: str) -> Fallback:
        """Take any function: this is the last place that is asked."""
        return cls(py_func, py_file)


@lru_cache(maxsize=1)
def _temporary_folder() -> str | None:
    """A folder of this user's own; what is read from it is run, so nobody else may have written it."""
    try:
        folder = Path(tempfile.gettempdir()) / "ravg-compiled"
        if sys.platform != "win32":  # where the folder of temporary files is the user's own
            folder = folder.with_name(f"ravg-compiled-{os.geteuid()}")
        with suppress(FileExistsError):
            folder.mkdir(mode=0o700)
        if not _is_private(folder):
            folder = Path(tempfile.mkdtemp(prefix="ravg-compiled-"))
            atexit.register(shutil.rmtree, folder, ignore_errors=True)
        tempfile.TemporaryFile(dir=folder).close()
    except OSError:
        LOG.warning("compiled loops cannot be kept anywhere: each run compiles them for some fifteen seconds")
        return None
    LOG.info(f"compiled loops are kept in {folder}: neither where ravg is installed nor in ~/.cache can be written to")
    return str(folder)


def _is_private(folder: Path) -> bool:
    """Whether this is a folder that only this user can write to."""
    status = folder.lstat()
    if sys.platform != "win32" and (status.st_uid != os.geteuid() or stat.S_IMODE(status.st_mode) & 0o077):
        return False
    return stat.S_ISDIR(status.st_mode)


def _load(load: Any) -> Any:
    @wraps(load)
    def load_or_forget(self: Any, *args: Any) -> Any:
        try:
            found = load(self, *args)
            if found is None and _FIRST_RUN.has_made(self._py_func):
                found = load(self, *args)
            return found
        except Exception as error:  # unpickling half a file raises whatever it likes
            LOG.debug(f"compiled loops in {self.cache_path} cannot be read, and are made again: {error!r}")
            with suppress(OSError):
                self.flush()
            return None

    return load_or_forget


def _save(save: Any) -> Any:
    @wraps(save)
    def save_or_leave(self: Any, *args: Any) -> None:
        try:
            save(self, *args)
        except Exception as error:  # a full disk, say, or half an index that cannot be replaced
            LOG.debug(f"compiled loops cannot be kept in {self.cache_path}: {error!r}")

    return save_or_leave


Cache.load_overload = _load(Cache.load_overload)  # type: ignore[method-assign]
Cache.save_overload = _save(Cache.save_overload)  # type: ignore[method-assign]


if __name__ == "__main__":
    from nlm.nonlocal_means import joint_nlm

    joint_nlm(np.zeros((1, 4, 4, 1), np.float32), np.zeros((4, 4, 1), np.float32))
