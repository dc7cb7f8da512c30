"""The boundary to torch: layout, tiles, precision; kernels go in, images come out.

The only module outside `network` that imports torch. Here HWC becomes NCHW, and nowhere else at run time.
"""

from __future__ import annotations

from collections.abc import Iterator
from pathlib import Path

import numpy as np
import torch
from numpy.typing import NDArray

import network
from hybrid.estimates import choose_estimate
from hybrid.frames import Shot
from hybrid.pipeline import Denoised
from hybrid.plan import plan_shot
from hybrid.pseudo_reference import ALPHA, AlignedWindow, Aligner, gated_average
from hybrid.timing import Timings
from network.checkpoint import load_model
from network.clips import Clip
from network.inputs import window_exposure
from network.models import denoise_tile, for_inference
from network.train import main as train_main
from nlm.average import replace_nonfinite

Array = NDArray[np.float32]

# Pixels of context around a tile. The U-Net's receptive field is wider in principle; beyond this its effect
# on a trained net is below half a float's precision.
HALO = 32
__all__ = ["Denoiser", "shipped_weights", "train_main", "write_clips"]

PRECISIONS = ("auto", "float32", "bfloat16")


def shipped_weights(preset: str) -> Path:
    """Path of the weights that come with the package.

    Raises
    ------
    ValueError
        If there is no such preset; names those there are.
    """
    folder = Path(network.__file__).parent / "weights"
    path = folder / f"{preset}.safetensors"
    if not path.is_file():
        known = ", ".join(sorted(p.stem for p in folder.glob("*.safetensors"))) or "none"
        raise ValueError(f"preset is {preset!r}, expected one of: {known}")
    return path


def has_bfloat16() -> bool:
    """Whether this processor computes in bfloat16 faster than in float32 (AVX-512 bf16 or AMX)."""
    capabilities = torch.cpu.get_capabilities() if hasattr(torch.cpu, "get_capabilities") else {}
    return bool(capabilities.get("avx512_bf16") or capabilities.get("amx_bf16"))


class Denoiser:
    """Runs a Robust Average network on aligned windows; an estimator for `hybrid.pipeline.denoise_shot`.

    Parameters
    ----------
    weights : Path
        A file written by training.
    tile : int
        Side of the squares that the network sees at once, pixels; a `HALO` is added around each.
    precision : str
        One of `PRECISIONS`; "auto" takes bfloat16 where the processor has it.
    threshold : float, optional
        t·K of the kernels, in [0, 1); higher stays closer to the input. Without: what it was trained with.
    timings : Timings, optional
        Where to count the stages of the estimate, and "network".

    Raises
    ------
    ValueError
        A bad option, or a file that holds no such model.
    """

    def __init__(
        self,
        weights: Path,
        *,
        tile: int = 256,
        precision: str = "auto",
        threshold: float | None = None,
        timings: Timings | None = None,
    ) -> None:
        if precision not in PRECISIONS:
            raise ValueError(f"precision is {precision!r}, expected one of {', '.join(PRECISIONS)}")
        if tile < 16:
            raise ValueError(f"tile is {tile}, expected at least 16 pixels")
        if threshold is not None and not 0 <= threshold < 1:
            raise ValueError(f"threshold is {threshold}, expected 0 <= threshold < 1, in units of 1/K")
        half = precision == "bfloat16" or (precision == "auto" and has_bfloat16())
        self.model = for_inference(load_model(weights), half)
        self.tile = tile
        self.threshold = threshold
        self.timings = timings or Timings()

    @property
    def radius(self) -> int:
        """Frames on each side that the network looks at."""
        return self.model.config.kernel.frames // 2

    def __call__(self, aligned: AlignedWindow) -> Denoised:
        """Denoise the centre of an aligned window."""
        with self.timings.stage("network"):
            return self._run(aligned)

    def _run(self, aligned: AlignedWindow) -> Denoised:
        color = aligned.mixed(aligned.color)
        height, width = color.shape[1:3]
        layers = {"color": color, "confidence": aligned.confidence[..., None]}
        if aligned.albedo is not None:
            layers["albedo"] = aligned.mixed(aligned.albedo)
        if aligned.normal is not None:
            layers["normal"] = aligned.mixed(aligned.normal)
        if aligned.estimate is not None:
            layers["estimate"] = aligned.estimate
        if aligned.aovs:
            layers["aovs"] = np.concatenate([aligned.mixed(layer) for layer in aligned.aovs.values()], axis=-1)
        exposure = window_exposure(_tensor(color))
        irradiance = np.empty(color.shape[1:], np.float32)
        channels = sum(layer.shape[-1] for layer in aligned.aovs.values())
        filtered = np.empty((height, width, channels), np.float32)
        for inner, outer, offset in _tiles(height, width, self.tile, self.model.multiple):
            # Where nothing varies in time nor in space, not even by rounding, the mean is the pixel.
            if "skip" in aligned.effects and not aligned.variance[outer].any():
                irradiance[inner] = color[aligned.centre][inner]
                if filtered.size:
                    filtered[inner] = layers["aovs"][aligned.centre][inner]
                continue
            cut = {name: _tensor(_pad(layer[:, *outer], self.model.multiple)) for name, layer in layers.items()}
            out, _, aovs = denoise_tile(
                self.model,
                cut["color"],
                cut.get("albedo"),
                cut.get("normal"),
                cut["confidence"],
                exposure,
                cut.get("estimate"),
                threshold=self.threshold,
                aovs=cut.get("aovs"),
            )
            irradiance[inner] = _image(out)[offset]
            if aovs is not None:
                filtered[inner] = _image(aovs)[offset]
        aovs_out, start = {}, 0
        for name, layer in aligned.aovs.items():
            stop = start + layer.shape[-1]
            light = filtered[..., start:stop]
            if name == ALPHA:
                aovs_out[name] = light
            elif stop - start == 3:
                aovs_out[name] = light * aligned.modulation
            else:
                aovs_out[name] = light * aligned.modulation.mean(axis=-1, keepdims=True)
            start = stop
        return Denoised(irradiance * aligned.modulation, aovs_out)


def write_clips(
    shot: Shot,
    target: Shot,
    folder: Path,
    name: str,
    *,
    radius: int = 2,
    estimate: str = "auto",
    pseudo_reference: bool = False,
) -> Iterator[Path]:
    """Write a training clip for each frame that two renders of one shot have in common.

    Parameters
    ----------
    shot : Shot
        What the network is to see.
    target : Shot
        The same frames with independent noise, and not more of it (Noise2Noise: the mean of the target is clean).
    folder : Path
        Where ``NAME.NUMBER.npz`` is written.
    name : str
        Of the clips. What comes before its first dot is the shot's: sets are split by it.
    radius : int
        Frames on each side of the centre.
    estimate : str
        Where the estimates come from (`hybrid.estimates.choose_estimate`); not "none".
    pseudo_reference : bool
        Take the gated average of the target's estimates, of the same kind, instead of its noisy frame.

    Yields
    ------
    Path
        After each clip.

    Raises
    ------
    ValueError
        If the two have no frame in common, or there are no estimates.

    References
    ----------
    Lehtinen et al. 2018, Noise2Noise, arXiv:1803.04189; paper, section "Training Data".
    """
    numbers = [number for number in shot.numbers if target.has(number)]
    if not numbers:
        raise ValueError(f"target: expected frames {shot.numbers[0]}-{shot.numbers[-1]}, got none of them")
    aligner, target_aligner = (
        Aligner(s, plan_shot(s).effects, radius=radius, estimate=choose_estimate(estimate, s).estimate)
        for s in (shot, target)
    )
    for number in numbers:
        aligned = aligner.align(number)
        if aligned.estimate is None:
            raise ValueError(f"estimate is {estimate!r}, expected one that gives pictures: clips hold estimates")
        color = aligned.mixed(aligned.color)
        if pseudo_reference:
            wanted = gated_average(target_aligner.align(number))
        else:
            wanted, _ = replace_nonfinite(target.read(number).color)
        clip = Clip(
            color=color,
            albedo=np.zeros_like(color) if aligned.albedo is None else aligned.mixed(aligned.albedo),
            normal=np.zeros_like(color) if aligned.normal is None else aligned.mixed(aligned.normal),
            confidence=aligned.confidence,
            modulation=aligned.modulation,
            estimate=aligned.estimate,
            target=wanted,
            target_kind="pseudo_reference" if pseudo_reference else "noisy",
            shot=name.partition(".")[0],
        )
        path = folder / f"{name}.{number:04d}.npz"
        clip.save(path)
        yield path


def _tensor(window: Array) -> torch.Tensor:
    """(T, H, W, C) to (1, T, C, H, W)."""
    return torch.from_numpy(np.ascontiguousarray(window.transpose(0, 3, 1, 2)))[None]


def _image(tensor: torch.Tensor) -> Array:
    """(1, C, H, W) to (H, W, C)."""
    return tensor[0].permute(1, 2, 0).float().numpy()


def _pad(window: Array, multiple: int) -> Array:
    """Repeat the last row and column until height and width are what the network needs."""
    bottom, right = (-window.shape[1] % multiple, -window.shape[2] % multiple)
    return np.pad(window, ((0, 0), (0, bottom), (0, right), (0, 0)), mode="edge") if bottom or right else window


Block = tuple[slice, slice]


def _tiles(height: int, width: int, tile: int, multiple: int) -> Iterator[tuple[Block, Block, Block]]:
    """Cover the image: where each tile's result goes, what it is computed from, and where in that the result is."""
    # The halo starts on a multiple, so that every tile samples its coarse scales where the whole image would.
    halo = -(-HALO // multiple) * multiple
    tile = -(-tile // multiple) * multiple
    for top in range(0, height, tile):
        for left in range(0, width, tile):
            inner, outer, offset = [], [], []
            for start, size in ((top, height), (left, width)):
                stop = min(start + tile, size)
                first, last = max(start - halo, 0), min(stop + halo, size)
                inner.append(slice(start, stop))
                outer.append(slice(first, last))
                offset.append(slice(start - first, stop - first))
            yield (inner[0], inner[1]), (outer[0], outer[1]), (offset[0], offset[1])
