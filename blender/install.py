"""A Python environment for ravg, made with Blender's Python and pip. Independent of Blender."""

import os
import re
import shutil
import sys
from pathlib import Path
from typing import NamedTuple

_CURRENT = "current.txt"  # holds the name of the complete environment
# pip's output, after its retries, when no package index was reached.
_NO_NETWORK = re.compile(
    "NewConnectionError|ConnectTimeout|ReadTimeout|ProxyError|SSLError|Failed to establish a new connection"
    "|[Nn]ame resolution|getaddrinfo failed|Network is unreachable|Connection refused|No address associated"
)


class Source(NamedTuple):
    version: str  # of this extension, such as 0.2.0
    wheel: Path | None  # of ravg; its requirements are taken from wheels in its folder
    online: bool  # whether requirements may come from the package index too

    def requirements(self) -> list[str]:
        """Return pip's arguments. FileNotFoundError or ValueError for a wrong wheel or none."""
        if self.wheel is None:  # ravg is on no package index, where anybody could publish the name
            raise ValueError(f"choose a wheel file of ravg, such as ravg-{self.version}-py3-none-any.whl")
        if not self.wheel.is_file():
            raise FileNotFoundError(f"no wheel file {self.wheel}")
        if not re.fullmatch(r"ravg-[^-]+-.+\.whl", self.wheel.name):
            raise ValueError(f"{self.wheel.name} is no wheel of ravg, expected a name like ravg-{self.version}-….whl")
        found = [f"--find-links={self.wheel.parent}", f"ravg[neural] @ {self.wheel.absolute().as_uri()}", "pyoidn"]
        return found if self.online else ["--no-index", *found]


def series(version: str) -> str:
    """The first two numbers of a version, which extension and ravg must share."""
    return ".".join(version.split(".")[:2])


def new_environment(home: Path) -> Path:
    """A folder for a new environment; the current one stays until the new one is complete."""
    numbers = [int(name.rpartition("-")[2]) for name in _environments(home)]
    # A short name: Windows takes paths of 259 letters. Torch needs 119 in site-packages, and a user's name may be long.
    return home / str(max(numbers, default=0) + 1)


def steps(environment: Path, source: Source) -> list[list[str]]:
    """The commands that make an environment, in their order; raises as `Source.requirements` does."""
    # Isolated (-I): ignore any ravg in Blender's folder or path.
    pip = [_program(environment, "python"), "-I", "-m", "pip", "install", "--no-input", "--disable-pip-version-check"]
    pip += ["--progress-bar=off", "--retries=1", "--timeout=15", *source.requirements()]
    make = [sys.executable, "-I", "-m", "venv", os.fspath(environment)]
    return [make, pip, [_program(environment, "ravg"), "--version"]]


def finish(home: Path, environment: Path) -> None:
    """Make an environment the current one, and remove all others."""
    mark = home / f"{_CURRENT}.new"
    mark.write_text(environment.name, encoding="utf-8")
    os.replace(mark, home / _CURRENT)
    for name in _environments(home):
        if name != environment.name:
            remove(home / name)


def remove(environment: Path) -> None:
    """Remove an environment; files in use may stay."""
    shutil.rmtree(environment, ignore_errors=True)


def installed(home: Path) -> str:
    """The command ravg of the current environment; empty if there is none."""
    try:
        name = (home / _CURRENT).read_text(encoding="utf-8")
    except OSError:
        return ""
    found = _program(home / name, "ravg")
    return found if os.path.isfile(found) else ""


def explain(log: str, *, online: bool) -> str:
    """Return in one line why pip failed."""
    errors = re.findall(r"^ERROR: (.*)", log, re.MULTILINE)
    if online and _NO_NETWORK.search(log):
        return "the package index cannot be reached: check the network, or put wheels of all requirements beside ravg's"
    lines = errors or [line for line in log.splitlines() if line.strip()] or ["no message"]
    missing = "" if online else " (Online Access is off: only wheels beside the chosen file were used)"
    return f"{lines[0]}{missing}"


def _environments(home: Path) -> list[str]:
    if not home.is_dir():
        return []
    # Earlier versions named them environment-1.
    return [path.name for path in home.iterdir() if re.fullmatch(r"(environment-)?\d+", path.name)]


def _program(environment: Path, name: str) -> str:
    folder, suffix = ("Scripts", ".exe") if sys.platform == "win32" else ("bin", "")
    return os.fspath(environment / folder / f"{name}{suffix}")
