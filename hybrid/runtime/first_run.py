"""The first run of a user compiles loops: one line says so, and helper processes compile some of them.

As a program this module is such a helper: it compiles loops of `signatures.json` that no other process compiles.
"""

import gc
import logging
import os
import subprocess
import sys
from contextlib import suppress
from functools import lru_cache
from typing import Any

from numba.core import event

from hybrid.runtime.compiled import is_compiled_elsewhere
from hybrid.runtime.signatures import count_listed, listed_loops
from loops.parallel import thread_count

LOG = logging.getLogger("ravg")

MOST = 6  # helpers: the longest loop takes a seventh of the time of all


class FirstRun(event.Listener):
    """Logs that loops are compiled, and starts helper processes."""

    begun = False
    depth = 0  # a loop is compiled while another is that calls it
    collects = False

    def on_start(self, event: Any) -> None:
        if not self.depth:
            # The compiler makes hundreds of thousands of objects: the search for garbage took a fifth of its time.
            self.collects = gc.isenabled()
            gc.disable()
        self.depth += 1
        if self.begun:
            return
        self.begun = True
        seconds = -(-45 // min(thread_count(), MOST + 1))  # CPU time of one core of a Zen 3 for `balanced`
        LOG.info(
            f"compiling for this processor, in the first run only: up to {count_listed()} loops, about {seconds} s"
        )
        folder = getattr(event.data["dispatcher"]._cache, "cache_path", None)  # None without a cache
        if folder and not folder.startswith(os.devnull):
            _start_helpers()

    def on_end(self, event: Any) -> None:
        self.depth -= 1
        if self.collects and not self.depth:
            gc.enable()


@lru_cache(maxsize=1)
def watch_compiling() -> None:
    """Log once that loops are compiled, and use all cores; later runs find them in the cache."""
    event.register("numba:compile", FirstRun())  # type: ignore[no-untyped-call]


def compile_listed() -> None:
    """Compile the loops of `signatures.json` that no other process compiles."""
    for loop, signature in listed_loops():
        if not is_compiled_elsewhere(loop):
            loop.compile(signature)


def _start_helpers() -> None:
    """Start a helper for each core but the one of this process, and one for the networks' loops."""
    options: dict[str, Any] = dict.fromkeys(("stdin", "stdout", "stderr"), subprocess.DEVNULL)
    if sys.platform == "win32":  # no console window if this process has none
        options["creationflags"] = subprocess.CREATE_NO_WINDOW
    programs = [__name__] * min(thread_count() - 1, MOST)
    if programs and "torch" in sys.modules:
        programs.insert(0, "network.cpu.first_run")
    for program in programs:
        with suppress(OSError):
            subprocess.Popen([sys.executable, "-m", program], **options)


if __name__ == "__main__":
    gc.disable()
    compile_listed()
