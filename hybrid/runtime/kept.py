"""Where arrays lie that outlive the work on a window: where they were made, or in temporary files.

Copies in mappings in memory left the allocator fewer holes, and took a tenth more CPU time and no less memory.
"""

import math
import mmap
import sys
import tempfile
import weakref
from collections.abc import Mapping
from dataclasses import fields, is_dataclass, replace
from typing import IO, Any, TypeVar

import numpy as np

from hybrid.runtime.allocator import return_freed_memory

Value = TypeVar("Value")

# Bytes of the smallest array that gets a file of its own: a mapping takes whole pages, and calls of the system.
SMALLEST = 2**20


class Keeper:
    """With `in_files`, moves arrays to temporary files without a name, each mapped as long as the array is referred to.

    The system removes the files however the process ends. Pages that have been read stay in memory until `release`.
    """

    def __init__(self, *, in_files: bool = False) -> None:
        self.in_files = in_files
        self._mappings: weakref.WeakSet[mmap.mmap] = weakref.WeakSet()

    def keep(self, value: Value) -> Value:
        """Return the value with large arrays moved: an array, or what dataclasses, tuples and mappings hold of them.

        An array that is there twice stays one; those moved before stay where they are. Raises OSError where a file
        cannot be written.
        """
        if not self.in_files:
            return value
        kept: Value = self._keep(value, {})
        self.release()
        return kept

    def empty(self, shape: tuple[int, ...], dtype: np.dtype[Any]) -> np.ndarray:
        """Return a large array to be written, in a file of its own if arrays lie in files."""
        size = math.prod(shape) * dtype.itemsize
        if not self.in_files or size < SMALLEST:
            return np.empty(shape, dtype)
        with tempfile.TemporaryFile(prefix="ravg-") as file:
            for start in range(0, size, SMALLEST):  # a file with holes would end the process on a full disk
                file.write(bytes(min(SMALLEST, size - start)))
            return self._mapped(file, size, dtype).reshape(shape)

    def release(self) -> None:
        """Let the system take back the pages of files that have been read; they are read again when they are used."""
        if self.in_files and sys.platform != "win32":  # which does so by itself when memory is short
            for mapping in list(self._mappings):
                mapping.madvise(mmap.MADV_DONTNEED)

    def trim(self) -> None:
        """Release pages, and return freed memory to the system: before each stage that takes much of it.

        At the end of a stage half of the process's memory is free, in pieces that blocks of the next may not fit in.
        `fast` at 1920×1080 takes 1.1 times the CPU time with it, and 1.5 times where glibc returns all blocks of more
        than 4 MiB as they are freed.
        """
        if self.in_files:
            self.release()
            return_freed_memory()

    def _keep(self, value: Any, moved: dict[int, Any]) -> Any:
        if isinstance(value, np.ndarray):
            if value.nbytes < SMALLEST or _is_mapped(value):
                return value
            if id(value) not in moved:
                moved[id(value)] = self._move(value)
            return moved[id(value)]
        if is_dataclass(value) and not isinstance(value, type):
            given = {field.name: getattr(value, field.name) for field in fields(value) if field.init}
            found = {name: self._keep(part, moved) for name, part in given.items()}
            changed = {name: part for name, part in found.items() if part is not given[name]}
            return replace(value, **changed) if changed else value
        if isinstance(value, Mapping):
            parts = {name: self._keep(part, moved) for name, part in value.items()}
            return parts if any(part is not value[name] for name, part in parts.items()) else value
        if isinstance(value, tuple):
            items = [self._keep(part, moved) for part in value]
            if all(one is other for one, other in zip(items, value, strict=True)):
                return value
            return type(value)(*items) if hasattr(value, "_fields") else tuple(items)
        return value

    def _move(self, array: np.ndarray) -> np.ndarray:
        """Copy an array to a file of its own."""
        with tempfile.TemporaryFile(prefix="ravg-") as file:
            file.write(np.ascontiguousarray(array).data.cast("B"))
            return self._mapped(file, array.nbytes, array.dtype).reshape(array.shape)

    def _mapped(self, file: IO[bytes], size: int, dtype: np.dtype[Any]) -> np.ndarray:
        """Map a file, which stays without its handle as long as the array."""
        file.flush()
        mapping = mmap.mmap(file.fileno(), size)
        self._mappings.add(mapping)
        return np.frombuffer(mapping, dtype)


def _is_mapped(array: np.ndarray) -> bool:
    """Whether an array, or what it is a view of, lies in a mapping."""
    base: Any = array
    while isinstance(base, np.ndarray):
        base = base.base
    return isinstance(base.obj if isinstance(base, memoryview) else base, mmap.mmap)
