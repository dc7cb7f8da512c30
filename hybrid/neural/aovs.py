"""Light passes and other AOVs of a window: filtered, and kept consistent with the denoised color."""

from typing import NamedTuple

import cv2
import numpy as np
from numpy.typing import NDArray

from hybrid.alignment.prepare import ALPHA
from hybrid.alignment.transfer import compress
from hybrid.alignment.window import AlignedWindow
from hybrid.files.frame import Array
from hybrid.files.passes import BEAUTY
from hybrid.neural.oidn_networks import denoise_alpha
from nlm.average import average
from nlm.parts import add_light, filter_layers, split_light


class SharedLight(NamedTuple):
    """AOVs and color whose sums agree."""

    aovs: dict[str, Array]  # (H, W, C): radiance
    color: Array  # (H, W, 3): radiance
    parts: frozenset[str]  # names of the AOVs that are parts of a sum


def filter_aovs(aligned: AlignedWindow, irradiance: Array) -> dict[str, Array]:
    """Average the AOVs of a window over time, and filter each guided by the denoised light (H, W, 3), except alpha.

    Returns the AOVs by name; `BEAUTY`, where some sums are incomplete, is the color filtered alike.
    """
    means = {name: average(layer, aligned.confidence) for name, layer in aligned.aovs.items()}
    names = [name for name in means if name != ALPHA]
    if not names:
        return means
    for name in names:
        if aligned.aovs[name][aligned.middle].min() >= 0:
            np.maximum(means[name], 0, out=means[name])  # interpolation undershoots
    light = compress(irradiance.mean(axis=-1, keepdims=True), aligned.brightness.exposure)
    guide = np.concatenate([*([] if aligned.guide is None else [aligned.guide]), light], axis=-1)
    moments = aligned.brightness.moments[:, : guide.shape[-1]]
    if any(not total.complete for total in aligned.centre.frame.passes.sums):
        means[BEAUTY] = average(aligned.color, aligned.confidence)
        names.append(BEAUTY)
    return means | dict(zip(names, filter_layers([means[n] for n in names], guide, moments=moments), strict=True))


def share_out(aligned: AlignedWindow, filtered: dict[str, Array], irradiance: Array, *, add: bool) -> SharedLight:
    """Make filtered AOVs that are parts of the color, or of another AOV, add up to it.

    The AOVs, (H, W, C), are without texture where they are textured. With `add` the color becomes the sum of its parts;
    otherwise the parts are scaled to it.
    """
    sums, exposure = aligned.centre.frame.passes.sums, aligned.brightness.exposure
    pass_colors = aligned.centre.frame.pass_colors
    aovs = {name: layer for name, layer in filtered.items() if name != BEAUTY}
    filtered_color = filtered.get(BEAUTY, irradiance) * aligned.modulation
    factors = {name: _factor(name, aligned) for name in aovs}
    images = {name: add_light([part], [factors[name]]) for name, part in aovs.items()}
    images[BEAUTY] = irradiance * aligned.modulation
    # The color becomes one sum alone; other sums of the same light are scaled to it then.
    first = next((total for total in sums if total.whole == BEAUTY and total.complete), None) if add else None
    for total in ([first] if first else []) + [other for other in sums if other is not first]:
        parts, whole = [filtered[name] for name in total.parts], total.whole
        by = [factors[name] for name in total.parts]
        if total is first:
            images[BEAUTY] = add_light(parts, by)
            split = parts
        elif total.complete:
            bounds = [
                average(aligned.aovs[name], aligned.confidence) if name in pass_colors else None for name in total.parts
            ]
            split = split_light(parts, images[whole], exposure=exposure, factors=by, bounds=bounds)
        else:
            # The light that is in none of the parts is a further part.
            rest = np.maximum(filtered_color - add_light(parts, by), 0)
            split = split_light([*parts, rest], images[whole], exposure=exposure, factors=[*by, None])[:-1]
        for name, part, factor in zip(total.parts, split, by, strict=True):
            aovs[name] = part
            images[name] = add_light([part], [factor])
    for name in aovs:
        if name == ALPHA:
            centre_alpha = aligned.aovs[name][aligned.middle]
            clean = denoise_alpha(aovs[name]) if "clean-alpha" in aligned.stages else aovs[name]
            aovs[name] = np.where(_is_uniform(centre_alpha), centre_alpha, clean)
        elif name not in pass_colors and (factor := factors[name]) is not None:
            aovs[name] = aovs[name] * factor
    return SharedLight(aovs, images[BEAUTY], frozenset(name for total in sums for name in total.parts))


def _factor(name: str, aligned: AlignedWindow) -> Array | None:
    """Factor from a filtered AOV to radiance; None: 1."""
    frame = aligned.centre.frame
    if name in frame.pass_colors:
        return frame.pass_colors[name][aligned.sources.rows]
    if name not in frame.passes.textured:
        return None
    modulation = aligned.modulation
    return modulation if aligned.aovs[name].shape[-1] == 3 else modulation.mean(axis=-1, keepdims=True)


def _is_uniform(alpha: Array) -> NDArray[np.bool_]:
    """Where a pixel and its 3×3 neighbours are all opaque or all transparent: nothing to filter (H, W, 1)."""
    box = np.ones((3, 3), np.uint8)
    opaque, transparent = (cv2.erode((alpha[..., 0] == value).astype(np.uint8), box) > 0 for value in (1, 0))
    return np.logical_or(opaque, transparent)[..., None]
