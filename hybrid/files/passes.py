"""How AOVs relate to the beauty: parts that add up to it, light of their own, or no light."""

from collections.abc import Mapping
from dataclasses import dataclass, replace
from typing import Self

import numpy as np
from numpy.typing import NDArray

from nlm.parts import few_differ, share_outside, sums_to

Array = NDArray[np.float32]

BEAUTY = ""  # stands for the beauty among the names of AOVs


@dataclass(frozen=True)
class Sum:
    """AOVs `parts` that add up to `whole`: `BEAUTY` or an AOV; not `complete` if some light is in no AOV."""

    whole: str
    parts: tuple[str, ...]
    complete: bool = True


@dataclass(frozen=True)
class Passes:
    """How the AOVs of a shot relate to its beauty."""

    # no AOV is a part twice; the sum that makes an AOV comes after those that this AOV is a part of
    sums: tuple[Sum, ...] = ()
    textured: tuple[str, ...] = ()  # AOVs that were multiplied by the surfaces' albedo
    kept: tuple[str, ...] = ()  # AOVs without noise, which are not denoised
    light: float = 0.0  # mean of all AOVs of light together, as a share of the beauty's

    def in_frame(self, color: Array, lights: Mapping[str, Array], exposure: float) -> Self:
        """Return the passes without the sums that do not hold in a frame: their parts are denoised by themselves.

        `color` (H, W, 3) is the noisy beauty, finite; `lights` are AOVs times their pass colors; `exposure` is the
        radiance of middle brightness.
        """
        sums = []
        for found in self.sums:
            if not {*found.parts, found.whole} <= {*lights, BEAUTY}:
                continue
            whole = color if found.whole == BEAUTY else lights[found.whole]
            parts = [lights[name] for name in found.parts]
            if found.complete:
                holds = sums_to(parts, whole, exposure)
            else:
                holds = all(few_differ(share_outside(part, whole, exposure)) for part in parts)
            sums += [found] if holds else []
        return replace(self, sums=tuple(sums))


NO_PASSES = Passes()
