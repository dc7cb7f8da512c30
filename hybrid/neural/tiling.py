"""From arrays to tensors and back, and an image as tiles."""

from collections.abc import Iterator

import numpy as np
import torch

from hybrid.files.frame import Array

Block = tuple[slice, slice]


def tensor_of(window: Array, *, copied: bool = True) -> torch.Tensor:
    """Convert layers (T, H, W, C) to a tensor ``(1, T, C, H, W)``, a view of the array unless `copied`."""
    planes = window.transpose(0, 3, 1, 2)
    if copied:
        planes = np.ascontiguousarray(planes)
    # torch warns of an array that is read-only, as those of callers may be.
    return torch.from_numpy(planes if planes.flags.writeable else planes.copy())[None]


def image_of(tensor: torch.Tensor) -> Array:
    """Convert ``(1, C, H, W)`` to (H, W, C)."""
    return tensor[0].permute(1, 2, 0).float().cpu().numpy()


def pad(window: Array, multiple: int) -> Array:
    """Repeat the bottom and right edges of layers (T, H, W, C) up to multiples of a size."""
    bottom, right = (-size % multiple for size in window.shape[1:3])
    return np.pad(window, ((0, 0), (0, bottom), (0, right), (0, 0)), mode="edge") if bottom or right else window


def tiles(
    rows: slice, height: int, width: int, tile: int, halo: int, multiple: int
) -> Iterator[tuple[Block, Block, Block]]:
    """Cover some rows of an image with tiles: their part of the image, their input with the halo, the part within the
    input.

    `halo` is how many pixels around a tile its result depends on. Tiles and halos start at multiples of `multiple`, to
    which both sizes are rounded up, so that every tile samples its coarse scales where the whole image would.
    """
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
