"""The command in processes of its own, forked from a process that has loaded and compiled everything."""

from __future__ import annotations

import contextlib
import importlib
import os
import pkgutil
import signal
import subprocess
import sys
import tempfile
import traceback
from collections.abc import Callable
from dataclasses import dataclass
from functools import lru_cache
from multiprocessing import forkserver, get_context
from multiprocessing.process import BaseProcess
from pathlib import Path
from unittest import mock

ROOT = Path(__file__).parent.parent
OURS = tuple(name for name in ("loops", "flow", "nlm", "network", "hybrid", "ravg") if (ROOT / name).is_dir())
EXCEEDED = 98


def words_in(printed: str) -> str:
    """The words of an output in one line, without the lines of tables and boxes (ASCII in pipes on Windows)."""
    return " ".join("".join(" " if "\u2500" <= sign <= "\u257f" or sign == "|" else sign for sign in printed).split())


@dataclass(frozen=True)
class Done:
    """Exit code of a command, and what it printed."""

    code: int
    said: str

    @property
    def words(self) -> str:
        """The output in one line, without the lines of tables and boxes."""
        return words_in(self.said)

    def succeeds(self) -> Done:
        """Assert exit code 0."""
        assert self.code == 0, f"exit code {self.code}: {self.said.strip()[-400:]}"
        return self

    def is_refused(self) -> Done:
        """Assert an error in one line."""
        assert self.code in (1, 2), f"exit code {self.code}: {self.said.strip()[-400:]}"
        assert "Traceback" not in self.said, self.said[-400:]
        assert max(map(len, self.said.splitlines() or [""])) < 2500
        return self

    def ends(self, how: str) -> Done:
        """Assert one of "works", "refused", "either"."""
        works = how == "works" or (how == "either" and self.code == 0)
        return self.succeeds() if works else self.is_refused()


@lru_cache(maxsize=1)
def _server() -> forkserver.ForkServer:
    """A server of this module's own: that of `multiprocessing` may have been started with other modules."""
    server = forkserver.ForkServer()
    server.set_forkserver_preload(["tests.loaded"])
    # One thread, of a kind that a process may be forked from.
    settings = {f"{name}_NUM_THREADS": "1" for name in ("NUMBA", "OMP", "MKL")} | {"NUMBA_THREADING_LAYER": "workqueue"}
    with mock.patch.dict(os.environ, {**settings, "PYTHONPATH": os.pathsep.join([str(ROOT), *sys.path])}):
        server.ensure_running()
    return server


def start(said: Path, *words: object, **setup: object) -> BaseProcess:
    """Start the command in a process that writes what it prints to `said`; `setup` is that of `_run`."""
    server = _server()
    process = get_context("forkserver").Process(target=_run, args=(said, [str(word) for word in words]), kwargs=setup)
    with mock.patch.object(forkserver, "connect_to_new_process", server.connect_to_new_process):
        process.start()
    return process


def ravg(*words: object, seconds: float = 120, **setup: object) -> Done:
    """Run the command, for at most `seconds`, after which the exit code is −9."""
    with tempfile.NamedTemporaryFile() as said:
        process = start(Path(said.name), *words, **setup)
        process.join(seconds)
        if process.exitcode is None:
            process.kill()
            process.join()
        return Done(process.exitcode, Path(said.name).read_text(encoding="utf-8", errors="replace"))


def _run(
    said: Path,
    words: list[str],
    folder: Path | None = None,
    memory: int = 6 * 2**30,
    before: Callable[[], object] | None = None,
    most: tuple[float, int] | None = None,
) -> None:
    """Be the command, in `folder`.

    `memory` is how many bytes may be allocated, `before` is called first, and with `most` the exit code is EXCEEDED
    after more CPU seconds, or more bytes of resident memory.
    """
    import resource  # not on Windows

    code = 70
    try:
        for descriptor in (1, 2):
            os.dup2(os.open(said, os.O_WRONLY | os.O_APPEND), descriptor)
        sys.stdout, sys.stderr = (os.fdopen(d, "w", encoding="utf-8", buffering=1, closefd=False) for d in (1, 2))
        signal.signal(signal.SIGINT, signal.default_int_handler)
        resource.setrlimit(resource.RLIMIT_CORE, (0, 0))
        if folder is not None:
            os.chdir(folder)
        used = int(Path("/proc/self/statm").read_text().split()[0]) * resource.getpagesize()
        resource.setrlimit(resource.RLIMIT_AS, (used + memory, used + memory))
        if before is not None:
            before()
        resident = resource.getrusage(resource.RUSAGE_SELF).ru_maxrss
        from hybrid.cli import main

        code = main(words)
        usage = resource.getrusage(resource.RUSAGE_SELF)
        seconds, grown = usage.ru_utime + usage.ru_stime, 1024 * (usage.ru_maxrss - resident)
        if most is not None and (seconds > most[0] or grown > most[1]):
            print(f"took {seconds:.1f} CPU seconds and {grown / 2**20:.0f} MiB")
            code = EXCEEDED
    except KeyboardInterrupt:  # before the command listened
        code = 130
    except BaseException:
        traceback.print_exc()
    finally:
        sys.stdout.flush()
        os._exit(code)


def run_python(*words: object, packages: Path = ROOT, folder: Path | None = None, **environment: str) -> Done:
    """Run a new interpreter: `-c` and a script, or `-m` and a module, and arguments."""
    env = {**os.environ, "PYTHONPATH": str(packages), **environment}
    command = [sys.executable, "-P", *map(str, words)]
    done = subprocess.run(command, env=env, capture_output=True, check=False, timeout=600, cwd=folder)
    return Done(done.returncode, (done.stdout + done.stderr).decode("utf-8", "replace"))


def import_all() -> None:
    """Import every module of the project but those that render."""
    for package in OURS:
        for module in pkgutil.walk_packages(importlib.import_module(package).__path__, f"{package}."):
            if "simulate" not in module.name and not module.name.endswith("__main__"):
                with contextlib.suppress(ImportError):
                    importlib.import_module(module.name)
