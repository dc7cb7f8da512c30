"""Judging the further layers of a shot: what adds up to the picture, what has light of its own, what has no noise."""

from __future__ import annotations

from collections.abc import Iterator, Sequence

import numpy as np
from numpy.typing import NDArray

from hybrid.alignment.transfer import measure_exposure
from hybrid.files.frame import Frame
from hybrid.files.passes import BEAUTY, Passes, Sum
from nlm.average import replace_nonfinite
from nlm.parts import few_differ, find_sums, is_noisy, is_textured, share_outside, shares_noise

Array = NDArray[np.float32]

# Frames are looked at in bands of so many rows, of at most so many rows together.
_BAND, _ROWS = 27, 540


def sample_rows(frame: Frame) -> Frame:
    """Color, albedo and further layers of a frame, of tall ones some bands of rows; finite."""
    height = frame.color.shape[0]
    rows = np.arange(height) // _BAND % -(-height // _ROWS) == 0

    def cut(layer: Array) -> Array:
        return replace_nonfinite(layer[rows])[0]

    return Frame(
        frame.number,
        cut(frame.color),
        albedo=None if frame.albedo is None else np.maximum(cut(frame.albedo), 0),
        aovs={name: cut(layer) for name, layer in frame.aovs.items()},
        pass_colors={name: np.maximum(cut(tint), 0) for name, tint in frame.pass_colors.items()},
    )


def classify_passes(frames: Sequence[Frame]) -> tuple[Passes, dict[str, str]]:
    """Find out what the further layers of a shot are.

    Parameters
    ----------
    frames : sequence of Frame
        Some frames of it, from `sample_rows`; all have the same layers.

    Returns
    -------
    passes : Passes
        What was found.
    words : dict of str to str
        What is done with each layer, and why, by its name.

    Notes
    -----
    Which layers are parts is found by adding up their noisy pixels (`nlm.parts.find_sums`), not by their names: sets of
    layers that add up to the picture, and sets of others that add up to one of those. Where no set is complete, a layer
    is a part that is nowhere above the picture and has its noise. Without noise, a layer that is no part is kept.
    """
    color = np.concatenate([frame.color for frame in frames])
    exposure = measure_exposure(color)
    names = [name for name in frames[0].aovs if all(name in frame.aovs for frame in frames)]
    lights = {
        name: np.concatenate([_radiance_of(frame, name) for frame in frames])
        for name in names
        if frames[0].aovs[name].shape == frames[0].color.shape
    }
    sums = list(_find_all(lights, color, exposure))
    among = {name for found in sums for name in found.parts}
    complete = {found.parts for found in sums if found.whole == BEAUTY}
    words = {name: _part_of(found, name) for found in sums for name in found.parts}
    kept, textured = list[str](), list[str]()
    for name in names:
        own = [frame.aovs[name] for frame in frames]
        if name not in among and not any(map(is_noisy, own)):
            kept.append(name)
            words[name] = "kept as it is: it has no noise, and is no part of the beauty"
            continue
        albedos = [frame.albedo for frame in frames]
        known = [albedo for albedo in albedos if albedo is not None]
        tinted = any(name in frame.pass_colors for frame in frames)
        if len(known) == len(own) and not tinted and is_textured(np.concatenate(own), np.concatenate(known)):
            textured.append(name)
        if name in among:
            continue
        words[name] = "denoised by itself: it adds up to the beauty with no others"
        if name not in lights:
            words[name] = f"denoised by itself: it has {own[0].shape[-1]} channels, the beauty 3"
        elif not few_differ(share := share_outside(lights[name], color, exposure)):
            words[name] = f"denoised by itself: it is above the beauty, or negative, in {share:.0%} of the picture"
        elif complete:
            words[name] = "denoised by itself: the beauty is the sum of others"
        elif all(shares_noise(_radiance_of(frame, name), frame.color) for frame in frames):
            sums.append(Sum(BEAUTY, (name,), complete=False))
            words[name] = "part of the beauty, the rest of which is in no layer: shared out of it"
    level = float(color.mean(dtype=np.float64))
    light = sum(float(lights[name].mean(dtype=np.float64)) for name in lights if name not in kept)
    passes = Passes(tuple(sums), tuple(textured), tuple(kept), light / level if level > 0 else 0.0)
    return passes, {name: words[name] for name in names}


def _radiance_of(frame: Frame, name: str) -> Array:
    """A layer of a frame, multiplied by its color where it is written without (H, W, C)."""
    tint = frame.pass_colors.get(name)
    return frame.aovs[name] if tint is None else frame.aovs[name] * tint


def _find_all(lights: dict[str, Array], color: Array, exposure: float) -> Iterator[Sum]:
    """The sums that are the picture, then of what is left those that are a layer, and so on."""
    wholes = {BEAUTY: color}
    left = dict(lights)
    while wholes:
        parts: dict[str, Array] = {}
        for name, whole in wholes.items():
            if not whole.any():
                continue
            others = [other for other in left if other != name]
            level = exposure if name == BEAUTY else measure_exposure(whole)
            for chosen in find_sums([left[other] for other in others], whole, level):
                found = Sum(name, tuple(others[k] for k in chosen))
                yield found
                parts |= {part: left.pop(part) for part in found.parts}
        wholes = parts


def _part_of(found: Sum, name: str) -> str:
    whole = "the beauty" if found.whole == BEAUTY else f"aov {found.whole}"
    if len(found.parts) == 1:
        return f"equal to {whole}: denoised as that is"
    others = ", ".join(part for part in found.parts if part != name)
    return f"part of {whole}, to which it adds up with {others}: shared out of it"
