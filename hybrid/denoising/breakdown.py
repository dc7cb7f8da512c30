"""Contribution of each frame of the window to a result: layers, statistics, and an image."""

from collections.abc import Iterator, Sequence
from pathlib import Path

import numpy as np

from hybrid.alignment.window import AlignedWindow
from hybrid.files.frame import Array
from hybrid.files.png import display_exposure, encode_srgb, fit, write_png
from hybrid.files.shots import Shot, output_path
from nlm.average import average, replace_nonfinite

PICTURE_SIDE = 480  # pixels of the longer side of a frame in the image, at most: up to seven are side by side


def frame_names(frames: int) -> list[str]:
    """Return the names of a window's frames in time order: before2, before1, centre, after1, after2."""
    offsets = range(-(frames // 2), frames // 2 + 1)
    return [f"before{-k}" if k < 0 else f"after{k}" if k else "centre" for k in offsets]


class Breakdown:
    """Statistics of the frames' weights over all pixels and frames of a shot, as in the paper's table 1."""

    def __init__(self) -> None:
        self.pixels = 0
        self._sum = self._least = self._greatest = np.zeros(0)

    def add(self, weights: Array) -> None:
        """Add the weights ``(T, H, W)`` of one more frame."""
        flat = weights.reshape(len(weights), -1).astype(np.float64)
        if not self.pixels:
            self._sum = np.zeros(len(flat))
            self._least, self._greatest = np.full(len(flat), np.inf), np.full(len(flat), -np.inf)
        self._sum = self._sum + flat.sum(1)
        self._least = np.minimum(self._least, flat.min(1))
        self._greatest = np.maximum(self._greatest, flat.max(1))
        self.pixels += flat.shape[1]

    def rows(self) -> Iterator[tuple[str, str, str, str]]:
        """Yield name, average, minimum and maximum weight of each frame, formatted; nothing before the first `add`."""
        if not self.pixels:
            return
        values = (self._sum / self.pixels, self._least, self._greatest)
        for name, *figures in zip(frame_names(len(self._sum)), *values, strict=True):
            yield (name, *(f"{figure:.4f}" for figure in figures))  # type: ignore[misc]


def layers_of(parts: Array, weights: Array) -> dict[str, Array]:
    """Return layers ``contribution.before2`` … of radiance (T, H, W, 3), and ``weight.before2`` … that sum to 1."""
    names = frame_names(len(parts))
    layers = {f"contribution.{name}": part for name, part in zip(names, parts, strict=True)}
    return {**layers, **{f"weight.{name}": weight for name, weight in zip(names, weights, strict=True)}}


def stage_layers(aligned: AlignedWindow, irradiance: Array) -> dict[str, Array]:
    """Return layers (H, W), in [0, 1], that show the effect of each stage on the result of a window.

    ``stage.align`` and ``stage.gate``: mean confidence of the neighbours that exist, by geometry, and by light too.
    ``stage.network``: difference r of the result from the average a of first passes (else colors), |r − a| / (a +
    exposure).
    """
    assert aligned.geometric_confidence is not None
    sides = [i for i, own in enumerate(aligned.geometric_confidence) if i != aligned.middle and own.any()]
    mean = average(aligned.color if aligned.first_pass is None else aligned.first_pass, aligned.confidence)
    light = np.maximum(mean, 0).mean(axis=-1) + aligned.brightness.exposure
    changed = np.abs(irradiance - mean).mean(axis=-1) / light
    nothing = np.zeros(irradiance.shape[:2], np.float32)
    return {
        "stage.align": aligned.geometric_confidence[sides].mean(axis=0) if sides else nothing,
        "stage.gate": aligned.confidence[sides].mean(axis=0) if sides else nothing,
        "stage.network": np.asarray(np.minimum(changed, 1), np.float32),
    }


def write_breakdown(pictures: Sequence[Shot], output: str | Path, frames: int, path: Path) -> None:
    """Write a PNG of the middle frame: noisy and denoised, the contributions in time order, and below their weights.

    The views of the shot's files are below each other. Weights are black at 0 and white at 1; all other images have one
    exposure and are sRGB encoded.
    """
    sheets = [_sheet(shot, output, frame_names(frames)) for shot in pictures]
    width = max(sheet.shape[1] for sheet in sheets)
    wide = [np.pad(sheet, ((0, 0), (0, width - sheet.shape[1]), (0, 0)), constant_values=1) for sheet in sheets]
    write_png(path, np.vstack(wide))


def _sheet(shot: Shot, output: str | Path, names: Sequence[str]) -> Array:
    """The rows of one view, in [0, 1]."""
    number = shot.numbers[len(shot.numbers) // 2]
    kinds = [[shot.own_name(f"{kind}.{name}") for name in names] for kind in ("contribution", "weight")]
    denoised = shot.reopened({number: output_path(output, shot, number)}, aovs=[*kinds[0], *kinds[1]]).read(number)
    noisy, _ = replace_nonfinite(shot.read(number).color)
    exposure = np.float32(display_exposure(noisy))
    rows = [
        [encode_srgb(image / exposure) for image in (noisy, denoised.color)],
        [encode_srgb(denoised.aovs[name] / exposure) for name in kinds[0]],
        [np.repeat(np.clip(denoised.aovs[name], 0, 1), 3, axis=-1) for name in kinds[1]],
    ]
    small = [[fit(image, PICTURE_SIDE) for image in row] for row in rows]
    columns, white = max(map(len, rows)), np.ones_like(small[0][0])
    return np.vstack([np.hstack(row + [white] * (columns - len(row))) for row in small])
