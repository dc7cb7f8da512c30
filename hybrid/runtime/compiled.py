"""Cache of compiled loops, with a fallback where no folder can be written to.

numba loads this module because `hybrid.runtime.threads.CACHE_LOCATORS` names it. It would raise "cannot cache
function" where neither the package's folder nor the user's can be written to, as on a render farm, and any error of
unpickling a truncated file. It would use a loop that was compiled before a constant or a function from another module
changed.

As a program it compiles loops that are needed late, for the process that has started it as a helper.
"""

import atexit
import gc
import hashlib
import logging
import os
import shutil
import stat
import subprocess
import sys
import tempfile
from collections.abc import Iterator
from contextlib import suppress
from functools import cache, lru_cache, wraps
from importlib import import_module
from pathlib import Path
from types import CodeType, FunctionType
from typing import Any, Self

import numpy as np
from numba.core import event
from numba.core.caching import Cache, UserWideCacheLocator

LOG = logging.getLogger("ravg")

# Loops that a first run needs late → the program that compiles them in a process of its own: non-local means are a
# fifth of the compilation time, those of the network, if torch has been imported, another.
_PROGRAMS = {"nlm.nonlocal_means": "hybrid.runtime.compiled", "network.cpu": "network.cpu.first_run"}


class _FirstRun(event.Listener):
    """Logs that loops are compiled, and starts helper processes that compile those needed late."""

    begun = False
    depth = 0  # a loop is compiled while another is that calls it
    collects = False

    def __init__(self) -> None:
        self.helpers: dict[str, subprocess.Popen[bytes]] = {}

    def on_start(self, event: Any) -> None:
        if not self.depth:
            # The compiler makes hundreds of thousands of objects: the search for garbage took a fifth of its time.
            self.collects = gc.isenabled()
            gc.disable()
        self.depth += 1
        if self.begun:
            return
        self.begun = True
        LOG.info("compiling for this processor, in the first run only: ten seconds to a minute")
        folder = getattr(event.data["dispatcher"]._cache, "cache_path", None)  # None without a cache
        if folder and not folder.startswith(os.devnull):
            options: dict[str, Any] = dict.fromkeys(("stdin", "stdout", "stderr"), subprocess.DEVNULL)
            if sys.platform == "win32":  # no console window if this process has none
                options["creationflags"] = subprocess.CREATE_NO_WINDOW
            for loops, program in _PROGRAMS.items():
                if loops != "network.cpu" or "torch" in sys.modules:
                    with suppress(OSError):
                        self.helpers[loops] = subprocess.Popen([sys.executable, "-m", program], **options)

    def on_end(self, event: Any) -> None:
        self.depth -= 1
        if self.collects and not self.depth:
            gc.enable()

    def waited_for(self, loop: Any) -> bool:
        """Whether a helper process compiles a loop; wait for its end."""
        helper = next((one for loops, one in self.helpers.items() if loop.__module__.startswith(loops)), None)
        if helper is None:
            return False
        with suppress(subprocess.TimeoutExpired):
            helper.wait(60)
        return True


_FIRST_RUN = _FirstRun()


@lru_cache(maxsize=1)
def watch_compiling() -> None:
    """Log once that loops are compiled, and use two processes; later runs find them in the cache."""
    event.register("numba:compile", _FIRST_RUN)  # type: ignore[no-untyped-call]


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


def _load(load: Any) -> Any:
    @wraps(load)
    def load_or_forget(self: Any, *args: Any) -> Any:
        try:
            found = load(self, *args)
            if found is None and _FIRST_RUN.waited_for(self._py_func):
                found = load(self, *args)
            return found
        except Exception as error:  # unpickling half a file may raise any error
            LOG.debug(f"compiled loops in {self.cache_path} cannot be read, and are compiled again: {error!r}")
            with suppress(OSError):
                self.flush()
            return None

    return load_or_forget


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

    return save_or_leave


if __name__ != "__main__":
    Cache._index_key = _key(Cache._index_key)  # type: ignore[method-assign]
    Cache.load_overload = _load(Cache.load_overload)  # type: ignore[method-assign]
    Cache.save_overload = _save(Cache.save_overload)  # type: ignore[method-assign]
else:
    # By its name this module changes numba's cache; changed twice, its keys would be found by no other process.
    import_module("hybrid.runtime.compiled")
    gc.disable()
    from nlm.nonlocal_means import joint_nlm
    from nlm.samples import average_neighbours, blend_samples, restore_mean

    joint_nlm(np.zeros((1, 4, 4, 1), np.float32), np.zeros((4, 4, 1), np.float32))
    window, image = np.zeros((3, 4, 4, 3), np.float32), np.zeros((4, 4, 3), np.float32)
    confidence = np.zeros(window.shape[:3], np.float32)
    # Every run reaches these late; what is compiled by then is loaded.
    mean = average_neighbours(window, [(0, window)], confidence, confidence, image, image)
    restore_mean(blend_samples(image, image, mean, 1.0), image, 1.0)
