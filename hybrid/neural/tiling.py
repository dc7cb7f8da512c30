"""From pictures to tensors and back, and a picture as tiles."""

from __future__ import annotations

from collections.abc import Iterator
from typing import Literal

import numpy as np
import torch
from numpy.typing import NDArray

Array = NDArray[np.float32]
Block = tuple[slice, slice]
Borders = tuple[tuple[int, int], tuple[int, int]]
PadMode = Literal["edge", "reflect"]


def tensor_of(window: Array, *, copied: bool = True) -> torch.Tensor:
    """From layers to a tensor.

    Parameters
    ----------
    window : (T, H, W, C) array
        Layers.
    copied : bool
        Whether they are laid out plane by plane; else the tensor looks at the array, and whoever reads it copies it.

    Returns
    -------
    Tensor
        ``(1, T, C, H, W)``.
    """
    planes = window.transpose(0, 3, 1, 2)
    return torch.from_numpy(np.ascontiguousarray(planes) if copied else planes)[None]


def image_of(tensor: torch.Tensor) -> Array:
    """(1, C, H, W) to (H, W, C)."""
    return tensor[0].permute(1, 2, 0).float().cpu().numpy()


def pad(window: Array, multiple: int, borders: Borders = ((0, 0), (0, 0)), mode: PadMode = "edge") -> Array:
    """Add to a window what a network wants around it, and up to the size that it needs.

    Parameters
    ----------
    window : (T, H, W, C) array
        Layers.
    multiple : int
        Of height and width.
    borders : pairs of int
        Rows before and after, columns before and after.
    mode : str
        "edge" or "reflect", of `numpy.pad`.

    Returns
    -------
    (T, H', W', C) array
        No smaller.
    """
    (top, bottom), (left, right) = borders
    bottom += -(window.shape[1] + top + bottom) % multiple
    right += -(window.shape[2] + left + right) % multiple
    if not (top or bottom or left or right):
        return window
    return np.pad(window, ((0, 0), (top, bottom), (left, right), (0, 0)), mode=mode)


def tiles(
    rows: slice, height: int, width: int, tile: int, halo: int, multiple: int
) -> Iterator[tuple[Block, Block, Block]]:
    """Cover some rows of an image with tiles.

    Parameters
    ----------
    rows : slice
        To be covered.
    height, width : int
        Of the image.
    tile : int
        Pixels on a side of a tile, rounded up to `multiple`.
    halo : int
        Pixels around a tile that its result depends on, rounded up to `multiple`.
    multiple : int
        Where tiles may start, so that each samples its coarse scales where the whole image would.

    Yields
    ------
    tuple of three pairs of slices
        Where a tile's result goes, what it is computed from, and where in that the result is.
    """
    # The halo starts on a multiple, so that every tile samples its coarse scales where the whole image would.
    halo = -(-halo // multiple) * multiple
    tile = -(-tile // multiple) * multiple
    for top in range(rows.start, rows.stop, tile):
        for left in range(0, width, tile):
            inner, outer, offset = [], [], []
            for start, end, size in ((top, rows.stop, height), (left, width, width)):
                stop = min(start + tile, end)
                first, last = max(start - halo, 0), min(stop + halo, size)
                inner.append(slice(start, stop))
                outer.append(slice(first, last))
                offset.append(slice(start - first, stop - first))
            yield (inner[0], inner[1]), (outer[0], outer[1]), (offset[0], offset[1])
