"""Strings in the headers of OpenEXR files, kept to the byte whatever their encoding.

Studios write Latin-1 and Shift-JIS; the library's binding reads and writes UTF-8 alone. The binding reads a copy in
which each byte that is not UTF-8 is a question mark; the bytes themselves are kept as lone surrogates (PEP 383), as
Python keeps such names of files.
"""

import os
import tempfile
from collections.abc import Iterator, Sequence
from contextlib import contextmanager
from pathlib import Path

_HEADERS = 2**24  # headers and tables of offsets lie within so many bytes; reading headers needs nothing behind them


def find_strings(data: bytes) -> Iterator[tuple[int, str, slice]]:
    """Yield part, name and byte range of each string attribute up to where the data is truncated or malformed."""
    # A bit of the version field: several parts, each with a header, and one more that is empty.
    several = bool(int.from_bytes(data[4:8], "little") & 0x1000)
    part, at = 0, 8
    while at < len(data):
        if data[at] == 0:  # the end of a header; an empty header ends the last part
            part, at = part + 1, at + 1
            if not several or data[at : at + 1] in (b"\0", b""):
                return
            continue
        name_end = data.find(b"\0", at, at + 256)
        kind_end = data.find(b"\0", name_end + 1, name_end + 257)
        if name_end < 0 or kind_end < 0:
            return
        start = kind_end + 5
        end = start + int.from_bytes(data[kind_end + 1 : start], "little")
        if end > len(data):
            return
        if data[name_end + 1 : kind_end] == b"string":
            yield part, data[at:name_end].decode("utf-8", "surrogateescape"), slice(start, end)
        at = end


@contextmanager
def readable_copy(path: Path, *, header_only: bool) -> Iterator[tuple[Path, dict[tuple[int, str], str]]]:
    """Yield a copy, or its headers, with UTF-8 strings, and (part, name) → original string of the changed ones."""
    with path.open("rb") as file:
        data = bytearray(file.read(_HEADERS if header_only else -1))
    strings = {}
    for part, name, where in [*find_strings(bytes(data))]:
        text = bytes(data[where]).decode("utf-8", "surrogateescape")
        if (plain := without_surrogates(text)) != text:
            strings[part, name] = text
            data[where] = plain.encode()
    # In a folder: Windows opens no temporary file a second time by its name.
    with tempfile.TemporaryDirectory() as folder:
        copy = Path(folder) / "copy.exr"
        copy.write_bytes(data)
        os.truncate(copy, path.stat().st_size)
        yield copy, strings


def restore_strings(path: Path, headers: Sequence[dict[str, str]]) -> None:
    """Put strings, by name for each part, into a file that was written without their surrogates."""
    with path.open("r+b") as file:
        for part, name, where in find_strings(file.read(_HEADERS)):
            if name in headers[part]:
                file.seek(where.start)
                file.write(headers[part][name].encode("utf-8", "surrogateescape"))


def without_surrogates(text: str) -> str:
    """Replace each byte that is not UTF-8 by a question mark; the length in bytes stays."""
    return "".join("?" if "\udc80" <= sign <= "\udcff" else sign for sign in text)
