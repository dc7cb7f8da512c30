"""PNG files, and the sRGB encoding of their pixels."""

from pathlib import Path
from typing import Any

import cv2
import numpy as np
from numpy.typing import NDArray

from hybrid.files.frame import Array
from hybrid.files.replace import write_file

Image8 = NDArray[np.uint8]
CELLS = 48


def encode_srgb(linear: NDArray[Any]) -> Array:
    """Clip to [0, 1] and encode as sRGB; any shape."""
    linear = np.clip(linear, 0, 1)
    return np.where(linear <= 0.0031308, 12.92 * linear, 1.055 * linear ** (1 / 2.4) - 0.055).astype(np.float32)


def encode_filmic(linear: NDArray[Any]) -> Array:
    """Encode light (..., 3) as film shows it, much as AgX: eight stops of highlights, and bright colors turn white.

    sRGB of y / (y + k) with y = (0.85 x + 0.15 mean x)^1.25, where k keeps middle gray, 0.18, as it is.
    """
    light = np.maximum(linear, 0).astype(np.float32)
    mixed = (0.85 * light + 0.15 * light.mean(axis=-1, keepdims=True)) ** 1.25
    k = 0.18**1.25 * (1 / 0.18 - 1)
    return encode_srgb(1 - k / (mixed + k))  # 1 for infinity


def display_exposure(light: NDArray[Any]) -> float:
    """Divisor that shows the geometric mean of the lit cells of a finite picture (H, W, C) as middle gray, 0.18.

    A mean is that of windows and lamps where they are in view. There are at most `CELLS` a side, as the logarithm of
    noise is no measure of light. That of a picture without light counts as 1.
    """
    gray = np.maximum(light, 0).mean(axis=-1, dtype=np.float32, keepdims=True)
    cells = fit(gray, CELLS)
    lit = cells[cells > 0].astype(np.float64)
    return float(np.exp(np.log(lit).mean()) if lit.size else 1.0) / 0.18


# From 16 bits to 8; near black a step of 16 linear bits is a twentieth of a step of 8 sRGB bits.
_CODES = np.round(encode_srgb(np.arange(2**16) / (2**16 - 1)) * 255).astype(np.uint8)


def encode_bytes(linear: NDArray[Any]) -> Image8:
    """Clip finite values to [0, 1] and encode them as sRGB of 8 bits, in half the time of `encode_srgb`; any shape."""
    scaled = np.clip(linear, 0, 1, dtype=np.float32)
    scaled *= np.float32(2**16 - 1)
    scaled += np.float32(0.5)
    return np.asarray(_CODES[scaled.astype(np.uint16)])


def fit(picture: NDArray[Any], side: int) -> NDArray[Any]:
    """Reduce a picture (H, W, C) to at most `side` pixels of its longer side."""
    height, width = picture.shape[:2]
    scale = min(1.0, side / max(height, width))
    size = max(1, round(width * scale)), max(1, round(height * scale))
    return picture if scale == 1 else cv2.resize(picture, size, interpolation=cv2.INTER_AREA)


def write_label(picture: Image8, text: str, *, right: bool = False) -> None:
    """Write white text with a black rim, readable on any picture, into its lower left or right corner."""
    font, size = cv2.FONT_HERSHEY_SIMPLEX, 0.45
    (width, _), _ = cv2.getTextSize(text, font, size, 1)
    at = picture.shape[1] - width - 6 if right else 6, picture.shape[0] - 8
    for thickness, gray in ((3, 0), (1, 255)):
        cv2.putText(picture, text, at, font, size, (gray, gray, gray), thickness, cv2.LINE_AA)


def write_png(path: Path, picture: NDArray[Any]) -> None:
    """Write a picture (H, W, 3), encoded, in [0, 1], with 8 bits, and make its folder."""
    _, data = cv2.imencode(".png", np.round(picture[..., ::-1] * 255).astype(np.uint8))
    path.parent.mkdir(parents=True, exist_ok=True)
    write_file(path, data.tobytes())
