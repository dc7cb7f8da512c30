"""From pictures to tensors and back, and a picture as tiles."""

from __future__ import annotations

from collections.abc import Iterator

import numpy as np
import torch
from numpy.typing import NDArray

Array = NDArray[np.float32]
Block = tuple[slice, slice]


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


def pad(window: Array, multiple: int) -> Array:
    """Repeat the edges of a window up to the size that a network needs.

    Parameters
    ----------
    window : (T, H, W, C) array
        Layers.
    multiple : int
        Of height and width.

    Returns
    -------
    (T, H', W', C) array
        No smaller.
    """
    bottom, right = (-size % multiple for size in window.shape[1:3])
    return np.pad(window, ((0, 0), (0, bottom), (0, right), (0, 0)), mode="edge") if bottom or right else window


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
