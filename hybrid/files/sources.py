"""What a picture was made from: enough to tell later whether any of it has changed.

It stands in the header of each picture that is made, as the string `MADE_FROM`: JSON with ``files``, a mapping from
what each was for (``frame 1001``, ``estimate 1001``) to its name, size in bytes, time of its last change in seconds,
and a hash of its content; and with whatever else decided, by name.
"""

from __future__ import annotations

import hashlib
import json
from collections.abc import Mapping
from contextlib import suppress
from dataclasses import dataclass, field
from importlib.metadata import PackageNotFoundError, version
from pathlib import Path
from typing import Any

from hybrid.files.exr import ExrError, read_exr
from hybrid.files.replace import refuse_other_kinds

MADE_FROM = "ravg/made-from"
# Of larger files so many bytes are hashed, in blocks all over: two renders differ everywhere, and what an editor has
# changed in one place has another time. Reading all of it would take as long as half a frame.
HASHED = 2**20
_BLOCKS = 16
# Packages that all pixels depend on.
PACKAGES = ("ravg", "numpy", "numba", "opencv-contrib-python-headless", "scikit-image")
# Archives and older file systems keep times in steps of up to two seconds.
_SECONDS = 2.0


@dataclass(frozen=True)
class Source:
    """A file as it was when it was read.

    Attributes
    ----------
    name : str
        Of the file, without its folder.
    size : int
        Bytes.
    modified : float
        When it was last changed, seconds.
    hash : str
        Of its content, or of blocks all over it (`HASHED`).
    inode : int
        Which file of that name it was; means nothing later, and is not recorded.
    """

    name: str
    size: int
    modified: float
    hash: str
    inode: int = field(default=0, compare=False)

    def same_as(self, other: Source) -> bool:
        """Whether nothing but the name is different; times to two seconds."""
        same = self.size == other.size and self.hash == other.hash
        return same and abs(self.modified - other.modified) <= _SECONDS


def identify(path: Path) -> Source:
    """Say what a file is now.

    Raises
    ------
    OSError
        If it cannot be read.
    """
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
    return Source(path.name, size, round(status.st_mtime_ns / 1e9, 3), found.hexdigest(), status.st_ino)


def describe_sources(files: Mapping[str, Source], **facts: object) -> str:
    """Describe what a frame was made from, for its header.

    Parameters
    ----------
    files : mapping of str to Source
        What a frame was made from, by what it is.
    **facts : object
        What else its pixels depend on, by name.

    Returns
    -------
    str
        JSON: the same for the same files and facts, to the byte.
    """
    listed = {what: [s.name, s.size, s.modified, s.hash] for what, s in files.items()}
    return json.dumps({**facts, "files": listed}, sort_keys=True)


def versions(*packages: str) -> dict[str, str]:
    """Versions of those of some packages that are installed, without the name of the build (torch 2.13.0+cpu).

    The wheels for Linux and Windows differ in that name alone, and machines of both may work on one shot.
    """
    found = {}
    for package in packages:
        with suppress(PackageNotFoundError):
            found[package] = version(package).partition("+")[0]
    return found


def why_stale(path: Path, attributes: Mapping[str, str], *, whole: bool = True) -> str | None:
    """Say why a picture has to be made again.

    Parameters
    ----------
    path : Path
        The picture.
    attributes : mapping of str to str
        What would stand in its header if it was made now, `MADE_FROM` among them.
    whole : bool
        Read all of it, to see that it can be read; else the header alone.

    Returns
    -------
    str or None
        The reason, "" if it is not there; None if it is whole and would be the same.
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
    old, new = _parse(header.get(MADE_FROM)), _parse(attributes.get(MADE_FROM))
    for name in sorted((old.keys() | new.keys()) - {"files"}):
        if old.get(name) != new.get(name):
            return _difference(name, old.get(name), new.get(name))
    before, now = (_files(document) for document in (old, new))
    for what in sorted(before.keys() | now.keys()):
        if what not in before:
            return f"{what} was not there"
        if what not in now:
            return f"{what} is not there any more"
        if not before[what].same_as(now[what]):
            return f"{what}, {now[what].name}, has changed"
    return None


def sources_in(path: Path) -> dict[str, Any]:
    """What a picture says it was made from; {} where it does not say so, or is none."""
    try:
        header = read_exr(path, pixels=False).parts[0].header
    except (OSError, ExrError):
        return {}
    return _parse(header.get(MADE_FROM))


def _difference(name: str, old: Any, new: Any) -> str:
    """What is different of an option or a fact; of several in one string, which."""
    if old is None:
        return f"nothing says of which {name} it is"
    before, now = _parse(old), _parse(new)
    for key in sorted(before.keys() | now.keys()):
        if before.get(key) != now.get(key):
            return f"{key} was {_short(before.get(key))}, is {_short(now.get(key))}"
    return f"{name} was {_short(old)}, is {_short(new)}"


def _short(value: object) -> str:
    text = str(value)
    return text if len(text) <= 60 else f"{text[:57]}…"


def _parse(text: object) -> dict[str, Any]:
    """The object that a header's string holds; {} where it holds none."""
    try:
        document = json.loads(text) if isinstance(text, str) else text
    except (ValueError, RecursionError):
        return {}
    return document if isinstance(document, dict) else {}


def _files(document: Mapping[str, Any]) -> dict[str, Source]:
    """The files of a record; a hostile one has none."""
    try:
        listed = document["files"].items()
        return {what: Source(str(n), int(s), float(m), str(h)) for what, (n, s, m, h) in listed}
    except (LookupError, TypeError, ValueError, AttributeError):
        return {}
