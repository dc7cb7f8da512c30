"""Where compiled loops are kept, and what becomes of them where that fails.

numba asks this module because the command names it (`hybrid.cli.FOLDERS`). It would raise "cannot cache function" where
neither the package's folder nor the user's can be written to, as on a render farm, and whatever unpickling raises where
a file was cut short.
"""

from __future__ import annotations

import atexit
import logging
import os
import shutil
import stat
import tempfile
from contextlib import suppress
from functools import lru_cache, wraps
from pathlib import Path
from typing import Any

from numba.core.caching import Cache, UserWideCacheLocator

LOG = logging.getLogger("ravg")


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
        folder = Path(tempfile.gettempdir()) / f"ravg-compiled-{os.geteuid()}"
        with suppress(FileExistsError):
            folder.mkdir(mode=0o700)
        status = folder.lstat()
        ours = status.st_uid == os.geteuid() and stat.S_IMODE(status.st_mode) & 0o077 == 0
        if not ours or not stat.S_ISDIR(status.st_mode):
            folder = Path(tempfile.mkdtemp(prefix="ravg-compiled-"))
            atexit.register(shutil.rmtree, folder, ignore_errors=True)
        tempfile.TemporaryFile(dir=folder).close()
    except OSError:
        LOG.warning("compiled loops cannot be kept anywhere: each run compiles them for some fifteen seconds")
        return None
    LOG.info(f"compiled loops are kept in {folder}: neither where ravg is installed nor in ~/.cache can be written to")
    return str(folder)


def _load(load: Any) -> Any:
    @wraps(load)
    def load_or_forget(self: Any, *args: Any) -> Any:
        try:
            return load(self, *args)
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
