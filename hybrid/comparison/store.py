"""The frames of a comparison on disk: what each method gave, the reference, flows and maps.

A long shot does not fit into the memory of the process that compares.
"""

from __future__ import annotations

from dataclasses import dataclass
from pathlib import Path

import numpy as np
from numpy.typing import NDArray

from hybrid.comparison.metrics import Reference

Array = NDArray[np.float32]

_PLAIN = b"abcdefghijklmnopqrstuvwxyz0123456789-"

REFERENCE = "reference"
HALVES = ("half a", "half b")  # of a reference that comes in halves
FLOW = "flow"
FLIP_MAP = "FLIP"
CHANGE_MAP = "Change between frames"
MAP_TITLES = (FLIP_MAP, CHANGE_MAP, "Confidence", "Temporal contribution")


@dataclass(frozen=True)
class FrameStore:
    """Arrays by owner, frame number and title.

    Attributes
    ----------
    folder : Path
        A new one, or an empty one.
    """

    folder: Path

    def save(self, owner: str, number: int, image: NDArray[np.floating], title: str = "color") -> None:
        """Keep an array.

        Parameters
        ----------
        owner : str
            A method's name, or `REFERENCE`.
        number : int
            Of the frame.
        image : (H, W, 3) or (H, W) array
            Linear radiance, or a map.
        title : str
            What it is of the frame.
        """
        path = self._path(owner, number, title)
        path.parent.mkdir(parents=True, exist_ok=True)
        np.save(path, image)

    def load(self, owner: str, number: int, title: str = "color", *, lazily: bool = False) -> Array:
        """Read what `save` has kept: at once, or each part where it is looked at."""
        image: Array = np.load(self._path(owner, number, title), mmap_mode="r" if lazily else None)
        return image

    def has(self, owner: str, number: int, title: str = "color") -> bool:
        """Whether `save` has kept it."""
        return self._path(owner, number, title).exists()

    def load_reference(self, number: int) -> Reference:
        """Read the reference of a frame, in halves where it came so."""
        if not self.has(REFERENCE, number, HALVES[0]):
            return self.load(REFERENCE, number)
        return self.load(REFERENCE, number, HALVES[0]), self.load(REFERENCE, number, HALVES[1])

    def map_titles(self, owner: str, number: int) -> list[str]:
        """Name the maps that are kept of a frame."""
        return [title for title in MAP_TITLES if self.has(owner, number, title)]

    def _path(self, owner: str, number: int, title: str) -> Path:
        return self.folder / _folder_name(owner) / _folder_name(title) / f"{number}.npy"


def _folder_name(name: str) -> str:
    """A folder name that differs for each name, also where case and a space at the end are ignored (Windows, macOS)."""
    # The mark in front makes no name a device of Windows, such as "con".
    return "_" + "".join(chr(byte) if byte in _PLAIN else f"%{byte:02X}" for byte in name.encode())
