"""What the further layers of a shot are to its picture: parts that add up to it, light of their own, or no light."""

from __future__ import annotations

from collections.abc import Iterator, Mapping
from dataclasses import dataclass, replace

import numpy as np
from numpy.typing import NDArray

from nlm.parts import above, may_differ, sums_to

Array = NDArray[np.float32]

# The picture's own name among those of its layers.
BEAUTY = ""


@dataclass(frozen=True)
class Sum:
    """Layers that add up to the picture, or to one of its layers.

    Attributes
    ----------
    whole : str
        `BEAUTY`, or the name of a layer.
    parts : tuple of str
        Names of layers.
    complete : bool
        False where there is further light, which is in no layer.
    """

    whole: str
    parts: tuple[str, ...]
    complete: bool = True


@dataclass(frozen=True)
class Passes:
    """What is known of the further layers of a shot.

    Attributes
    ----------
    sums : tuple of Sum
        No layer is a part twice; a sum that is a layer comes after those that this layer is a part of.
    textured : tuple of str
        Layers that were multiplied by the surfaces' color.
    kept : tuple of str
        Layers without noise, which are not denoised.
    light : float
        Mean of all layers of light together, as a share of the picture's.
    """

    sums: tuple[Sum, ...] = ()
    textured: tuple[str, ...] = ()
    kept: tuple[str, ...] = ()
    light: float = 0.0

    def in_frame(self, color: Array, lights: Mapping[str, Array], exposure: float) -> Passes:
        """The same, without the sums that are none in a frame, whose parts are then denoised by themselves.

        Parameters
        ----------
        color : (H, W, 3) array
            As rendered, finite.
        lights : mapping of str to (H, W, 3) array
            Layers, multiplied by their color where they are written without.
        exposure : float
            Radiance of middle brightness.
        """
        return replace(self, sums=tuple(self._holding(color, lights, exposure)))

    def _holding(self, color: Array, lights: Mapping[str, Array], exposure: float) -> Iterator[Sum]:
        for found in self.sums:
            if not {*found.parts, found.whole} <= {*lights, BEAUTY}:
                continue
            whole = color if found.whole == BEAUTY else lights[found.whole]
            parts = [lights[name] for name in found.parts]
            if found.complete:
                holds = sums_to(parts, whole, exposure)
            else:
                holds = all(may_differ(above(part, whole, exposure)) for part in parts)
            if holds:
                yield found


NO_PASSES = Passes()
