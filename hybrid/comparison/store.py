"""Arrays of a comparison on disk, as frames of long shots do not fit in memory: frames, reference, flows and maps."""

import hashlib
from dataclasses import dataclass
from pathlib import Path

import numpy as np
from numpy.typing import NDArray

from hybrid.comparison.metrics import Reference
from hybrid.files.frame import Array

REFERENCE = "reference"
HALVES = ("half a", "half b")  # of a reference that is given in halves
FLOW = "flow"
FLIP_MAP = "FLIP"
CHANGE_MAP = "Change between frames"
MAP_TITLES = (FLIP_MAP, CHANGE_MAP)


@dataclass(frozen=True)
class FrameStore:
    """Arrays by owner (a method's name, or `REFERENCE`), frame number and title, in a new or empty folder."""

    folder: Path

    def save(self, owner: str, number: int, image: NDArray[np.floating], title: str = "color") -> None:
        """Write an array: (H, W, 3) linear radiance, or an (H, W) map."""
        path = self._path(owner, number, title)
        path.parent.mkdir(parents=True, exist_ok=True)
        np.save(path, image)

    def load(self, owner: str, number: int, title: str = "color", *, lazily: bool = False) -> Array:
        """Read an array; `lazily`: as a memory map."""
        image: Array = np.load(self._path(owner, number, title), mmap_mode="r" if lazily else None)
        return image

    def has(self, owner: str, number: int, title: str = "color") -> bool:
        return self._path(owner, number, title).exists()

    def load_reference(self, number: int) -> Reference:
        """Read the reference of a frame, as two halves if it was given in halves."""
        if not self.has(REFERENCE, number, HALVES[0]):
            return self.load(REFERENCE, number)
        return self.load(REFERENCE, number, HALVES[0]), self.load(REFERENCE, number, HALVES[1])

    def _path(self, owner: str, number: int, title: str) -> Path:
        # Names of methods may hold any character, and differ in case alone.
        folders = (hashlib.sha256(name.encode()).hexdigest()[:16] for name in (owner, title))
        return self.folder.joinpath(*folders, f"{number}.npy")
