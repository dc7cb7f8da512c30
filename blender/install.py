"""A Python environment for ravg, made with Blender's Python and pip. Independent of Blender."""

import itertools
import os
import re
import shutil
import sys
from contextlib import suppress
from pathlib import Path
from typing import NamedTuple

_CURRENT = "current.txt"  # holds the name of the complete environment
# pip's output, after its retries, when no package index was reached.
_NO_NETWORK = re.compile(
    "NewConnectionError|ConnectTimeout|ReadTimeout|ProxyError|SSLError|Failed to establish a new connection"
    "|[Nn]ame resolution|getaddrinfo failed|Network is unreachable|Connection refused|No address associated"
)


# The package index has torch with CUDA alone for Linux; PyTorch's own index has it for CPUs.
_TORCH_FOR_CPUS = "https://download.pytorch.org/whl/cpu"
# GB to download and on disk, measured on Linux, except the 3 GB for GPUs, which are an estimate.
_FOR_CPUS, _FOR_GPUS = (0.4, 1.8), (3.0, 6.3)


class Source(NamedTuple):
    version: str  # of this extension, such as 1.0.0
    wheel: Path | None  # of ravg; its requirements are taken from wheels in its folder
    online: bool  # whether requirements may come from the package index too
    gpu: bool  # whether torch is to compute on GPUs: on Linux alone, pip's torch for other systems is for CPUs

    @property
    def sizes(self) -> tuple[float, float]:
        """GB to download and on disk."""
        return _FOR_GPUS if self.gpu and sys.platform == "linux" else _FOR_CPUS

    def requirements(self) -> list[list[str]]:
        """Return pip's arguments for each of its runs. FileNotFoundError or ValueError for a wrong wheel or none."""
        if self.wheel is None:  # ravg is on no package index, where anybody could publish the name
            raise ValueError(f"choose a wheel file of ravg, such as ravg-{self.version}-py3-none-any.whl")
        if not self.wheel.is_file():
            raise FileNotFoundError(f"no wheel file {self.wheel}")
        if not re.fullmatch(r"ravg-[^-]+-.+\.whl", self.wheel.name):
            raise ValueError(f"{self.wheel.name} is no wheel of ravg, expected a name like ravg-{self.version}-….whl")
        links = f"--find-links={self.wheel.parent}"
        ravg = [links, f"ravg[neural] @ {self.wheel.absolute().as_uri()}", "pyoidn"]
        if not self.online:
            return [["--no-index", *ravg]]
        if sys.platform == "linux" and not self.gpu:
            return [[f"--index-url={_TORCH_FOR_CPUS}", links, "torch"], ravg]
        return [ravg]


def series(version: str) -> str:
    """The first two numbers of a version, which extension and ravg must share."""
    return ".".join(version.split(".")[:2])


def bundled_wheel() -> Path | None:
    """The wheel that the extension came with; None in a clone."""
    return next(iter(sorted((Path(__file__).parent / "wheels").glob("ravg-*.whl"))), None)


def new_environment(home: Path) -> Path:
    """A new folder for an environment; the current one stays until the new one is complete."""
    _remove_others(home, _current(home))  # left by Blender's end during an installation
    # A short name: Windows takes paths of 259 letters. Torch needs 119 in site-packages, and a user's name may be long.
    made = next(path for path in (home / str(number) for number in itertools.count(1)) if not path.exists())
    temporary(made).mkdir(parents=True)
    return made


def temporary(environment: Path) -> Path:
    """The folder of pip's downloads: /tmp may be small, and the environment is removed as a whole."""
    return environment / "tmp"


def size(environment: Path) -> float:
    """GB of an environment so far."""
    total = 0
    for folder, _, names in os.walk(environment):
        for name in names:
            with suppress(OSError):  # removed meanwhile
                total += os.lstat(os.path.join(folder, name)).st_size
    return total / 1e9


def steps(environment: Path, source: Source) -> list[list[str]]:
    """The commands that make an environment, in their order; raises as `Source.requirements` does."""
    # Isolated (-I): ignore any ravg in Blender's folder or path.
    pip = [_program(environment, "python"), "-I", "-m", "pip", "install", "--no-input", "--disable-pip-version-check"]
    pip += ["--progress-bar=off", "--retries=1", "--timeout=15"]
    make = [sys.executable, "-I", "-m", "venv", os.fspath(environment)]
    runs = [[*pip, *words] for words in source.requirements()]
    return [make, *runs, [_program(environment, "ravg"), "--version"]]


def finish(home: Path, environment: Path) -> None:
    """Make an environment the current one, and remove all others."""
    remove(temporary(environment))
    mark = home / f"{_CURRENT}.new"
    mark.write_text(environment.name, encoding="utf-8")
    os.replace(mark, home / _CURRENT)
    _remove_others(home, environment.name)


def remove(environment: Path) -> None:
    """Remove an environment; files in use may stay."""
    shutil.rmtree(environment, ignore_errors=True)


def installed(home: Path) -> str:
    """The command ravg of the current environment; empty if there is none."""
    name = _current(home)
    found = _program(home / name, "ravg")
    return found if name and os.path.isfile(found) else ""


def _current(home: Path) -> str:
    try:
        return (home / _CURRENT).read_text(encoding="utf-8")
    except OSError:
        return ""


def explain(log: str, *, online: bool) -> str:
    """Return in one line why pip failed."""
    errors = re.findall(r"^ERROR: (.*)", log, re.MULTILINE)
    if online and _NO_NETWORK.search(log):
        return "the package index cannot be reached: check the network, or put wheels of all requirements beside ravg's"
    lines = errors or [line for line in log.splitlines() if line.strip()] or ["no message"]
    missing = "" if online else " (Online Access is off: only wheels beside the chosen file were used)"
    return f"{lines[0]}{missing}"


def _remove_others(home: Path, name: str) -> None:
    """Remove all environments but one."""
    for path in home.iterdir() if home.is_dir() else ():
        if path.is_dir() and path.name != name:
            remove(path)


def _program(environment: Path, name: str) -> str:
    folder, suffix = ("Scripts", ".exe") if sys.platform == "win32" else ("bin", "")
    return os.fspath(environment / folder / f"{name}{suffix}")
