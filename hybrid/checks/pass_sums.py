"""Classification of AOVs: parts that add up to the beauty, light of their own, or layers without noise."""

from collections.abc import Iterator, Sequence

import numpy as np

from hybrid.alignment.transfer import measure_exposure
from hybrid.files.frame import Array, Frame
from hybrid.files.passes import BEAUTY, Passes, Sum
from nlm.average import replace_nonfinite
from nlm.parts import few_differ, find_sums, is_noisy, is_textured, share_outside, shares_noise


def sample_rows(frame: Frame) -> Frame:
    """Return color, albedo and AOVs of a frame, finite; of a tall frame bands of 27 rows, about 540 rows in all."""
    height = frame.color.shape[0]
    rows = np.arange(height) // 27 % -(-height // 540) == 0

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
    """Classify the AOVs of a shot by some frames, from `sample_rows`; with words on how each is denoised, and why.

    Parts are found by adding up noisy pixels (`nlm.parts.find_sums`), not by names: sets of AOVs that add up to the
    beauty, and sets of others that add up to one of those. If no set is complete, an AOV is a part if it is nowhere
    above the beauty and has its noise. An AOV that is no part and has no noise is kept.
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
    parts = {name for total in sums for name in total.parts}
    complete = any(total.whole == BEAUTY for total in sums)
    reasons = {name: _part_of(total, name) for total in sums for name in total.parts}
    kept, textured = list[str](), list[str]()
    for name in names:
        layers = [frame.aovs[name] for frame in frames]
        if name not in parts and not any(map(is_noisy, layers)):
            kept.append(name)
            reasons[name] = "kept: it has no noise, and is no part of the beauty"
            continue
        albedos = [frame.albedo for frame in frames if frame.albedo is not None]
        has_color = any(name in frame.pass_colors for frame in frames)
        if len(albedos) == len(layers) and not has_color and is_textured(*map(np.concatenate, (layers, albedos))):
            textured.append(name)
        if name in parts:
            continue
        reasons[name] = "denoised separately: no set of AOVs with it adds up to the beauty"
        if name not in lights:
            reasons[name] = f"denoised separately: it has {layers[0].shape[-1]} channels, the beauty 3"
        elif not few_differ(share := share_outside(lights[name], color, exposure)):
            reasons[name] = f"denoised separately: it is above the beauty, or negative, in {share:.0%} of the picture"
        elif complete:
            reasons[name] = "denoised separately: the beauty is the sum of other AOVs"
        elif all(shares_noise(_radiance_of(frame, name), frame.color) for frame in frames):
            sums.append(Sum(BEAUTY, (name,), complete=False))
            reasons[name] = "part of the beauty, the rest of which is in no AOV: its share of the denoised beauty"
    level = float(color.mean(dtype=np.float64))
    light = sum(float(lights[name].mean(dtype=np.float64)) for name in lights if name not in kept)
    passes = Passes(tuple(sums), tuple(textured), tuple(kept), light / level if level > 0 else 0.0)
    return passes, {name: reasons[name] for name in names}


def _radiance_of(frame: Frame, name: str) -> Array:
    """An AOV of a frame times its pass color, if it has one (H, W, C)."""
    pass_color = frame.pass_colors.get(name)
    return frame.aovs[name] if pass_color is None else frame.aovs[name] * pass_color


def _find_all(lights: dict[str, Array], color: Array, exposure: float) -> Iterator[Sum]:
    """Yield the sums that make the beauty, then sums of the remaining AOVs that make one of these, and so on."""
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
                total = Sum(name, tuple(others[k] for k in chosen))
                yield total
                parts |= {part: left.pop(part) for part in total.parts}
        wholes = parts


def _part_of(total: Sum, name: str) -> str:
    whole = "the beauty" if total.whole == BEAUTY else f"aov {total.whole}"
    if len(total.parts) == 1:
        return f"equal to {whole}: denoised like it"
    others = ", ".join(part for part in total.parts if part != name)
    return f"part of {whole}, with {others}: its share of the denoised sum"
