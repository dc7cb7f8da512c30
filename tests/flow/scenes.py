"""Pairs of pictures whose motion is known."""

from typing import NamedTuple

import cv2
import numpy as np

from flow.guide import GuidePair, make_guide, pair_guides
from flow.warp import warp

HEIGHT, WIDTH = 96, 128


class Shot(NamedTuple):
    """Guides of two frames, and the flow from the first to the second."""

    guides: GuidePair
    flow: np.ndarray


def texture(rng: np.random.Generator, channels: int) -> np.ndarray:
    """Smooth random blobs of two sizes, in [0.1, 0.9]."""
    octaves = [
        cv2.GaussianBlur(rng.normal(size=(HEIGHT, WIDTH, channels)).astype(np.float32), (0, 0), s) * s for s in (1.5, 5)
    ]
    return np.clip(0.5 + 0.35 * sum(octaves), 0.1, 0.9).reshape(HEIGHT, WIDTH, channels)


def moved(step: tuple[float, float] = (2.3, -1.6)) -> Shot:
    """A texture under a slow zoom and a shift by `step`, noisy and with its albedo."""
    rng = np.random.default_rng(0)
    neighbour = texture(rng, 3)
    y, x = np.mgrid[:HEIGHT, :WIDTH].astype(np.float32)
    flow = np.stack([step[0] + 0.01 * (x - WIDTH / 2), step[1] + 0.01 * (y - HEIGHT / 2)], axis=-1)
    albedos = warp(neighbour, flow, interpolation="bicubic")[0], neighbour
    # Gamma noise of relative deviation 0.35 (8 samples or so).
    colors = [3 * albedo * rng.gamma(8, 1 / 8, albedo.shape).astype(np.float32) for albedo in albedos]
    guides = (make_guide(color, albedo, exposure=1.5) for color, albedo in zip(colors, albedos, strict=True))
    return Shot(pair_guides(*guides), flow)


def plain(*planes: np.ndarray) -> GuidePair:
    """Two pictures (H, W) or (H, W, G) as guides without noise."""
    first, second = (picture.reshape(*picture.shape[:2], -1).astype(np.float32) for picture in planes)
    return GuidePair(first, second, np.zeros_like(first))


def error(flow: np.ndarray, truth: np.ndarray) -> float:
    """Mean length, pixels, of the difference, away from what leaves the frame."""
    return float(np.hypot(*np.moveaxis(flow - truth, -1, 0))[8:-8, 8:-8].mean())


def perturbation(rng: np.random.Generator, sigma: float) -> np.ndarray:
    """Noise of mean length 1.2 px, white or with blobs of `sigma` pixels."""
    noise = rng.normal(size=(HEIGHT, WIDTH, 2)).astype(np.float32)
    if sigma:
        noise = cv2.GaussianBlur(noise, (0, 0), sigma)
    return noise * (1.2 / np.hypot(*np.moveaxis(noise, -1, 0)).mean())
