"""The sources of a picture, to recognize later whether any of them has changed (`--resume`).

The header of each result holds the string `MADE_FROM`: JSON with ``files``, a mapping from the use of each file
(``frame 1001``, ``estimate 1001``) to its name, size in bytes, modification time in seconds, and a hash of its
content; and with all other facts that the pixels depend on, by name.
"""

import hashlib
import json
from collections.abc import Mapping
from contextlib import suppress
from dataclasses import dataclass, field
from importlib.metadata import PackageNotFoundError, version
from pathlib import Path
from typing import Any, Self

from hybrid.files.exr import ExrError, read_exr
from hybrid.files.replace import refuse_other_kinds

MADE_FROM = "ravg/made-from"
# Bytes of a larger file that are hashed, in blocks all over: two renders differ everywhere, and an edit in one place
# changes the time. Reading all of a file would take as long as half a frame.
HASHED = 2**20
_BLOCKS = 16
# Packages that all pixels depend on.
PACKAGES = ("ravg", "numpy", "numba", "opencv-contrib-python-headless")


@dataclass(frozen=True)
class Source:
    """A file as it was read: name, bytes, modification time, hash (`HASHED`), and inode, which is not recorded."""

    name: str
    size: int
    modified: float
    hash: str
    inode: int = field(default=0, compare=False)

    def same_as(self, other: Self) -> bool:
        """Whether size, hash and time are the same, the time to two seconds; names may differ."""
        same = self.size == other.size and self.hash == other.hash
        # Archives and older file systems keep times in steps of up to two seconds.
        return same and abs(self.modified - other.modified) <= 2


class ReadSources:
    """The files of a run as they were when they were first identified."""

    def __init__(self) -> None:
        self._sources: dict[Path, Source] = {}

    def identify(self, path: Path) -> Source:
        """Return a file as it was when this was first called for it."""
        if path not in self._sources:
            self._sources[path] = identify(path)
        return self._sources[path]

    def check_unchanged(self, path: Path) -> None:
        """Raise OSError if an identified file has been written again since, or is gone."""
        if (source := self._sources.get(path)) is None:
            return
        status = path.stat()
        changed = (status.st_size, _modified(status.st_mtime_ns)) != (source.size, source.modified)
        # Some network drives change the inodes of unchanged files: then the content decides.
        if not changed and status.st_ino != source.inode:
            self._sources[path] = now = identify(path)
            changed = now != source
        if changed:
            raise OSError(f"{path} has changed since it was read; --resume makes again what was made from it")


def _modified(nanoseconds: int) -> float:
    return round(nanoseconds / 1e9, 3)


def identify(path: Path) -> Source:
    """Return a file as it is now; raise OSError if it cannot be read."""
    refuse_other_kinds(path)
    status = path.stat()
    size = status.st_size
    found = hashlib.blake2b(digest_size=8)
    with path.open("rb") as file:
        if size <= HASHED:
            found.update(file.read())
        else:
            block = HASHED // _BLOCKS
            for index in range(_BLOCKS):
                file.seek((size - block) * index // (_BLOCKS - 1))
                found.update(file.read(block))
    return Source(path.name, size, _modified(status.st_mtime_ns), found.hexdigest(), status.st_ino)


def describe_sources(files: Mapping[str, Source], **facts: object) -> str:
    """Return JSON for `MADE_FROM`, of files by use and other facts that pixels depend on; alike to the byte."""
    listed = {use: [s.name, s.size, s.modified, s.hash] for use, s in files.items()}
    return json.dumps({**facts, "files": listed}, sort_keys=True)


def versions(*packages: str) -> dict[str, str]:
    """Return the versions of the installed packages among `packages`, without the build's name (torch 2.13.0+cpu).

    The wheels for Linux and Windows differ in that name alone, and machines of both may work on one shot.
    """
    found = {}
    for package in packages:
        with suppress(PackageNotFoundError):
            found[package] = version(package).partition("+")[0]
    return found


def why_stale(path: Path, attributes: Mapping[str, str], *, whole: bool = True) -> str | None:
    """Return why a result must be made again; "" if it is missing, None if it is whole and up to date.

    The attributes are header strings of a result made now, `MADE_FROM` among them. With `whole` the pixels are read
    too, to check that the file is not damaged.
    """
    try:
        header = read_exr(path, pixels=whole).parts[0].header
    except FileNotFoundError:
        return ""
    except (OSError, ExrError):
        return "it is damaged"
    for name, value in attributes.items():
        if name != MADE_FROM and header.get(name) != value:
            return _difference(name.rpartition("/")[2], header.get(name), value)
    old, new = parse_object(header.get(MADE_FROM)), parse_object(attributes.get(MADE_FROM))
    for name in sorted((old.keys() | new.keys()) - {"files"}):
        if old.get(name) != new.get(name):
            return _difference(name, old.get(name), new.get(name))
    before, now = (_files(document) for document in (old, new))
    for use in sorted(before.keys() | now.keys()):
        if use not in before:
            return f"{use} was not there"
        if use not in now:
            return f"{use} is not there any more"
        if not before[use].same_as(now[use]):
            return f"{use}, {now[use].name}, has changed"
    return None


def sources_in(path: Path) -> dict[str, Any]:
    """Return the `MADE_FROM` of a file; {} if it has none or cannot be read."""
    try:
        header = read_exr(path, pixels=False).parts[0].header
    except (OSError, ExrError):
        return {}
    return parse_object(header.get(MADE_FROM))


def _difference(name: str, old: Any, new: Any) -> str:
    """Say how a fact differs; for several facts in one JSON string, the first that does."""
    if old is None:
        return f"nothing says of which {name} it is"
    before, now = parse_object(old), parse_object(new)
    for key in sorted(before.keys() | now.keys()):
        if before.get(key) != now.get(key):
            return f"{key} was {_short(before.get(key))}, is {_short(now.get(key))}"
    return f"{name} was {_short(old)}, is {_short(new)}"


def _short(value: object) -> str:
    text = str(value)
    return text if len(text) <= 60 else f"{text[:57]}…"


def parse_object(text: object) -> dict[str, Any]:
    """Return the object in a JSON string; {} if it holds none."""
    try:
        document = json.loads(text) if isinstance(text, str) else text
    except (ValueError, RecursionError):
        return {}
    return document if isinstance(document, dict) else {}


def _files(document: Mapping[str, Any]) -> dict[str, Source]:
    """The files of a `MADE_FROM`; {} for a malformed one."""
    try:
        listed = document["files"].items()
        return {use: Source(str(n), int(s), float(m), str(h)) for use, (n, s, m, h) in listed}
    except (LookupError, TypeError, ValueError, AttributeError):
        return {}
