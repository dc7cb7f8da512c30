"""Fixtures of all tests: few threads, and a small shot on disk."""

# ruff: noqa: E402 - the libraries read their numbers of threads when they are imported

import os

# The pictures are small: threads gain nothing, and on a busy machine they wait for each other, ten times as long.
for _name in ("OMP_NUM_THREADS", "NUMBA_NUM_THREADS"):
    os.environ.setdefault(_name, "1")
# Neither the terminal of whoever runs the tests nor defaults of the commands decide what these print and do.
for _name in [name for name in os.environ if name.startswith("RAVG_") and name != "RAVG_COMMAND"]:
    del os.environ[_name]
for _name in ("COLUMNS", "LINES", "FORCE_COLOR", "NO_COLOR", "PY_COLORS"):
    os.environ.pop(_name, None)
os.environ["TERM"] = "xterm"
# Files of tests need not outlive the machine: waiting for the disk took a tenth of the time.
os.fsync = lambda descriptor: None

import argparse
import functools
import importlib.metadata
import importlib.util
import re
import shutil
import signal
import sys
import tempfile
import zlib
from collections.abc import Iterator
from pathlib import Path
from typing import Any

import pytest

# Versions of packages are in every header that is written, and none changes meanwhile.
importlib.metadata.version = functools.cache(importlib.metadata.version)

from tests.scenes import Scene

HAS_TORCH = importlib.util.find_spec("torch") is not None
NETWORKS = {Path(__file__).parent / "network", Path(__file__).parent / "hybrid" / "neural"}


def parse_part(text: str) -> tuple[int, int]:
    """K and N of "K/N"."""
    found = re.fullmatch(r"(\d{1,4})/(\d{1,4})", text)
    if found is None or not 1 <= int(found[1]) <= int(found[2]):
        raise argparse.ArgumentTypeError(f"part is {text!r}, expected K/N, where 1 <= K <= N")
    return int(found[1]), int(found[2])


def pytest_addoption(parser: pytest.Parser) -> None:
    parser.addoption("--part", type=parse_part, default=(1, 1), metavar="K/N", help="the K-th of N parts of the tests")


def pytest_collection_modifyitems(config: pytest.Config, items: list[pytest.Item]) -> None:
    """Leave out the tests of reliability unless `-m` names them, and other parts; skip what needs POSIX on Windows."""
    number, count = config.getoption("part")
    asked = "reliability" in config.option.markexpr

    def taken(item: pytest.Item) -> bool:
        """By a hash of its name, which is the same in every process and on every machine."""
        marked = item.get_closest_marker("reliability") is not None
        return (asked or not marked) and zlib.crc32(item.nodeid.encode()) % count == number - 1

    config.hook.pytest_deselected(items=[item for item in items if not taken(item)])
    items[:] = [item for item in items if taken(item)]
    for item in items:
        if needs_torch(item.path):
            item.add_marker(pytest.mark.neural)
        if not HAS_TORCH and item.get_closest_marker("neural"):
            item.add_marker(pytest.mark.skip(reason="torch is not installed"))
        if sys.platform == "win32" and item.get_closest_marker("posix"):
            item.add_marker(pytest.mark.skip(reason="needs POSIX: pipes, signals, links or shells"))


def needs_torch(path: Path) -> bool:
    """Whether tests are of networks: all files of two folders, but for that of the settings of trainings."""
    return path.name != "test_config.py" and not NETWORKS.isdisjoint(path.parents)


def pytest_ignore_collect(collection_path: Path) -> bool | None:
    return True if not HAS_TORCH and needs_torch(collection_path) else None


def pytest_report_header() -> str | None:
    return None if HAS_TORCH else "torch is not installed: tests/network and tests/hybrid/neural are left out"


@pytest.hookimpl(optionalhook=True)
def pytest_xdist_make_scheduler(config: pytest.Config, log: Any) -> Any:
    """Give all tests of a file to one process: what a file's fixtures make is made once."""
    from xdist.scheduler import LoadFileScheduling

    return LoadFileScheduling(config, log)


@pytest.fixture
def shot_folder(tmp_path: Path) -> Path:
    """Three noisy frames on disk."""
    return Scene().write(tmp_path / "noisy")


@pytest.fixture
def folder() -> Iterator[Path]:
    """An empty folder that every user may enter; `tmp_path` is its owner's alone."""
    with tempfile.TemporaryDirectory(prefix="ravg-", ignore_cleanup_errors=True) as name:
        Path(name).chmod(0o755)
        yield Path(name)


@pytest.fixture
def interrupts() -> Iterator[None]:
    """Processes that are started meanwhile do not ignore SIGINT, as those of a job in the background would."""
    before = signal.signal(signal.SIGINT, signal.default_int_handler)
    yield
    signal.signal(signal.SIGINT, before)


@pytest.fixture(scope="module")
def browser() -> Iterator[Any]:
    """Chromium without a window. For one module: Playwright keeps an event loop that other tests must not meet."""
    playwright = pytest.importorskip("playwright.sync_api", reason="playwright is not installed")
    program = shutil.which("chromium") or shutil.which("chromium-browser") or shutil.which("google-chrome")
    if program is None:
        pytest.skip("chromium is not installed")
    flags = ["--no-sandbox", "--disable-gpu", "--disable-quic", "--no-first-run", "--disable-background-networking"]
    flags += ["--disable-component-update", "--disable-sync", "--allow-file-access-from-files"]
    with playwright.sync_playwright() as running:
        instance = running.chromium.launch(executable_path=program, args=flags)
        yield instance
        instance.close()
