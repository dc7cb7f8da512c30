"""The U-Nets of Intel Open Image Denoise (OIDN), from which a network can start.

`Trunk` is the network, `read_tza` reads weights, `load_oidn` finds OIDN's in the library that the package ``pyoidn``
installs, and `denoise_picture` does with them what OIDN does. Nothing of OIDN's is part of this project.

References
----------
Áfra 2025, "Intel Open Image Denoise", https://www.openimagedenoise.org. Network, exposure and transfer curve are those
of ``training/`` in RenderKit/oidn, the weights those of RenderKit/oidn-weights; both are Apache-2.0 (see NOTICE).
"""

from __future__ import annotations

import copy
import hashlib
import importlib.util
import mmap
import struct
from collections.abc import Callable, Iterator, Sequence
from dataclasses import dataclass
from functools import partial
from itertools import chain
from math import log, prod
from pathlib import Path
from typing import cast

import torch
from torch import Tensor, nn
from torch.nn import functional

from network.cpu.convolution import can_fuse, convolve
from network.cpu.fused_ops import can_end, convolve_to_picture
from network.cpu.upsample_conv import Taps, add_taps, can_enlarge, convolve_enlarged

#: Channels of the convolutions at each scale of the encoder, finest first.
ENCODERS: dict[str, tuple[tuple[int, ...], ...]] = {
    "small": ((32, 32), (32,), (32,), (32,), (32, 32)),
    "base": ((32, 32), (48,), (64,), (80,), (96, 96)),
    "large": ((64, 64), (96, 96), (128, 128), (192, 192), (256, 256)),
}
#: The same of the decoder, coarsest first.
DECODERS: dict[str, tuple[tuple[int, ...], ...]] = {
    "small": ((64, 64), (64, 64), (64, 32), (32, 32)),
    "base": ((112, 112), (96, 96), (64, 64), (64, 32)),
    "large": ((192, 192), (128, 128), (96, 96), (64, 64)),
}
#: Bytes and SHA-256 of OIDN's weights, as version 2.5.1 has them.
OIDN_WEIGHTS = {
    "rt_hdr": (1830792, "a097e8fe9b1ba71ec43cde3e6df3fcf54fa4f8f2f4dd41eac01d0a76a16261e3"),
    "rt_hdr_small": (634568, "c9171947f2bceb4367725b7a0d5b4e0d663ac44108386af42f1b49e4361952e7"),
    "rt_hdr_alb": (1835976, "a8e4fbbd3a794e0098f88e23882faf5459840bda5b0ff39f22bcaaf2cfd03b5a"),
    "rt_hdr_alb_small": (638024, "1f3839dfc949e969bc5ad4d600e85bfa96187e0cb5ffee2f4715c791e6221fba"),
    "rt_hdr_alb_nrm": (1841160, "e586ef2ff48d7fbb7611986405220ed8fc5c13ca79bfc40be4dc742fbf959e1a"),
    "rt_hdr_alb_nrm_small": (641480, "980ea307e7825cae23ed8b1addf8de62ece84b61094795a5631ebf1c91b2e1a7"),
    "rt_hdr_calb_cnrm": (1841160, "d0057057bd76c64e3e67b449728ef8f4fd2f11ccfb74c1e59b9d50dafd50ee0e"),
    "rt_hdr_calb_cnrm_small": (641480, "a6c43bfdbff01bdd8a9c777e139720f9e58b872a50c8db07079bddd007482dc5"),
    "rt_hdr_calb_cnrm_large": (7698439, "08130cdc4f33b7a513d0073757f089ac830f900613bb5bad72ca42c52b934465"),
    "rt_alb": (1830792, "752c9a8d57884d660ae375a7c853cad8a44f77d559bb282f0ef39f8e758601a4"),
    "rt_alb_large": (7684615, "a8efbe6eed511f41c8f5ff9145923214cefb0703cf91a3b00a1dc131ade1600a"),
    "rt_nrm": (1830792, "fb8f7f5571332b602406f88a0b570d809dd3c06aebb530f5d048828f57490bc7"),
    "rt_nrm_large": (7684615, "8ac7705ec5ac303116b40ad2f0880cd741ed1f4280828bf2f18f7635c3377257"),
}


#: Rows of the finest layer that are worked on at a time, even: their features fit the caches of a processor.
ROWS = 64

# How a TZA file begins: magic and version.
_TZA = struct.pack("<HBB", 0x41D7, 2, 0)


@dataclass(frozen=True)
class TrunkConfig:
    """Sizes of a `Trunk`."""

    inputs: int = 9  # channels: color, then albedo, then normal
    size: str = "base"  # of ENCODERS

    def __post_init__(self) -> None:
        if self.inputs < 1:
            raise ValueError(f"inputs: expected at least one channel, got {self.inputs}")
        if self.size not in ENCODERS:
            raise ValueError(f"size: expected one of {', '.join(ENCODERS)}, got {self.size!r}")


class Trunk(nn.Module):
    """OIDN's U-Net: plain 3×3 convolutions, five scales, what enters each scale handed on to the decoder.

    Parameters
    ----------
    config : TrunkConfig
        0.32 M parameters ("small"), 0.92 M ("base") or 3.85 M ("large").
    """

    #: Height and width must be multiples of this.
    multiple = 16

    def __init__(self, config: TrunkConfig) -> None:
        super().__init__()
        self.config = config
        width, skips = config.inputs, []
        self.encoder, self.decoder = nn.ModuleList(), nn.ModuleList()
        for widths in ENCODERS[config.size]:
            skips.append(width)
            self.encoder.append(Convolutions(width, widths))
            width = widths[-1]
        for skip, widths in zip(reversed(skips[:-1]), DECODERS[config.size], strict=True):
            self.decoder.append(Convolutions(width + skip, widths))
            width = widths[-1]
        self.last = nn.Conv2d(width, 3, 3, padding=1)

    @property
    def first(self) -> nn.Conv2d:
        """The first convolution."""
        return cast(nn.Conv2d, cast(nn.Sequential, self.encoder[0])[0])

    @property
    def convolutions(self) -> Iterator[nn.Conv2d]:
        """All convolutions, in the order in which they run."""
        return (module for module in self.modules() if isinstance(module, nn.Conv2d))

    def forward(self, x: Tensor) -> Tensor:
        """Denoise a picture.

        Parameters
        ----------
        x : Tensor
            ``(N, C, H, W)`` in [0, 1], float32.

        Returns
        -------
        Tensor
            ``(N, 3, H, W)``.

        Raises
        ------
        ValueError
            If height or width is no multiple of 16.
        """
        for name, length in zip(("height", "width"), x.shape[2:], strict=True):
            if length == 0 or length % self.multiple:
                raise ValueError(f"x: expected a {name} that is a multiple of {self.multiple}, got {length}")
        bottleneck, skips = self.encode(x.to(self.first.weight.dtype, memory_format=torch.channels_last))
        skips[0] = x
        (picture,) = self.decode(bottleneck, skips, lambda features: [self.finish(features)])
        return picture

    def skip_of(self, x: Tensor) -> Tensor:
        """What enters the last scale of the decoder of a picture, ``(N, C, H, W)``: itself.

        In bfloat16 the color brings its low bits along, as three more channels (`round_trunk`).
        """
        rounded = x.to(self.first.weight.dtype, memory_format=torch.channels_last)
        if rounded.dtype != torch.bfloat16:
            return rounded
        return torch.cat([rounded, (x[:, :3] - rounded[:, :3]).to(rounded.dtype)], 1)

    def encode(self, x: Tensor) -> tuple[Tensor, list[Tensor]]:
        """Take a picture apart.

        Parameters
        ----------
        x : Tensor
            ``(N, C, H, W)``.

        Returns
        -------
        bottleneck : Tensor
            Features of the coarsest scale.
        skips : list of Tensor
            What entered each of the finer scales, finest first.
        """
        skips = []
        for stage in self.encoder[:-1]:
            skips.append(x)
            (x,) = in_strips(partial(_convolve_and_halve, cast(Convolutions, stage)), 2, x)
        return self.encoder[-1](x), skips

    def decode(
        self, x: Tensor, skips: Sequence[Tensor], finish: Callable[[Tensor], Sequence[Tensor]]
    ) -> Sequence[Tensor]:
        """Put a picture together again.

        Parameters
        ----------
        x : Tensor
            Features of the coarsest scale, from `encode`.
        skips : sequence of Tensor
            What entered the finer ones, from `encode`; the first is the picture, not rounded.
        finish : callable
            From the ``(N, width, H, W)`` features of the finest scale, or some rows of them, to what is asked for,
            ``(N, ., H, W)``; it may look one row around.

        Returns
        -------
        sequence of Tensor
            What it gives.
        """
        stages = (cast(Convolutions, stage) for stage in self.decoder)
        *coarse, (finest, picture) = zip(stages, reversed(skips), strict=True)
        for stage, skip in coarse:
            (x,) = in_strips(lambda x, skip, stage=stage: [stage.enlarged(x, skip)], 2, x, skip)
        return in_strips(lambda x, skip: finish(finest.enlarged(x, self.skip_of(skip))), 3, x, picture)

    def finish(self, x: Tensor) -> Tensor:
        """The picture, ``(N, 3, H, W)``, of the features of the finest scale; not rounded by any autocast."""
        if can_end(x):
            return convolve_to_picture(x, self.last.weight, cast(Tensor, self.last.bias))
        with torch.autocast(x.device.type, enabled=False):
            return cast(Tensor, self.last(x.to(self.last.weight.dtype)))


class Convolutions(nn.Sequential):
    """3×3 convolutions, a ReLU after each."""

    # The taps of the first one for `enlarged`, where they are rounded (`round_enlarged`).
    coarse: Tensor | None
    beside: Tensor | None

    def __init__(self, width: int, widths: Sequence[int]) -> None:
        layers: list[nn.Module] = []
        for following in widths:
            layers += [nn.Conv2d(width, following, 3, padding=1), nn.ReLU(inplace=True)]
            width = following
        super().__init__(*layers)
        for name in Taps._fields:
            self.register_buffer(name, None, persistent=False)

    def after_first(self, x: Tensor) -> Tensor:
        """Run what follows the first convolution on what it gave."""
        return self._run(torch.relu(x), list(self)[2:])

    def enlarged(self, x: Tensor, skip: Tensor) -> Tensor:
        """Run them on features at twice their size, and what was handed on beside these."""
        first = cast(nn.Conv2d, self[0])
        if torch.is_grad_enabled() or not can_enlarge(x, skip, first.weight):
            return self.forward(torch.cat([functional.interpolate(x, scale_factor=2.0, mode="nearest"), skip], 1))
        rounded = None if self.coarse is None or self.beside is None else Taps(self.coarse, self.beside)
        taps = rounded or add_taps(first.weight, x.shape[1])
        return self._run(convolve_enlarged(x, skip, taps, cast(Tensor, first.bias)), list(self)[2:])

    def round_enlarged(self, width: int) -> None:
        """Keep what `enlarged` asks for of `width` channels in bfloat16: sums of taps that are rounded themselves."""
        for name, taps in add_taps(cast(nn.Conv2d, self[0]).weight, width)._asdict().items():
            setattr(self, name, round_taps(taps).contiguous(memory_format=torch.channels_last))

    def forward(self, x: Tensor) -> Tensor:
        """Run them."""
        return self._run(x, list(self))

    @staticmethod
    def _run(x: Tensor, layers: list[nn.Module]) -> Tensor:
        fused = can_fuse(x)
        for layer in layers:
            if not fused:
                x = layer(x)
            elif isinstance(layer, nn.Conv2d):
                x = convolve(x, layer.weight, layer.bias)
        return x


def in_strips(
    run: Callable[..., Sequence[Tensor]], reach: int, *layers: Tensor, of_frames: bool = False
) -> list[Tensor]:
    """Run what sees a few rows around each on one strip of rows after the other; with gradients on all at once.

    A strip's features fit the caches of a processor, where a frame's do not: convolutions of 32 channels take 0.6 of
    the time. And no more than a strip of them is ever there.

    Parameters
    ----------
    run : callable
        From layers to layers.
    reach : int
        How many rows around each it sees, of the finest layer.
    *layers : Tensor
        ``(..., H, W)``; of coarser ones H is half as much, a quarter, ...
    of_frames : bool
        Whether features of all frames are there at once: then strips are half as high.

    Returns
    -------
    list of Tensor
        What it gives of all rows.
    """
    height = max(layer.shape[-2] for layer in layers)
    rows = ROWS // 2 if of_frames else ROWS
    if torch.is_grad_enabled() or height <= rows:
        return list(run(*layers))
    reach += reach % 2  # where the strip of a layer of half the size begins as well
    whole: list[Tensor] = []
    for top in range(0, height, rows):
        stop = min(top + rows, height)
        first, last = max(top - reach, 0), min(stop + reach, height)
        parts = run(*(_rows(layer, first, last, height) for layer in layers))
        if not whole:
            whole = [_empty_like(part, height * part.shape[-2] // (last - first)) for part in parts]
        for result, part in zip(whole, parts, strict=True):
            _rows(result, top, stop, height).copy_(_rows(part, top - first, stop - first, last - first))
    return whole


def _rows(layer: Tensor, first: int, last: int, height: int) -> Tensor:
    """Of a layer the rows that are these of one of that height."""
    return layer[..., first * layer.shape[-2] // height : last * layer.shape[-2] // height, :]


def _empty_like(part: Tensor, height: int) -> Tensor:
    """A layer of another height, laid out as this one."""
    last = part.is_contiguous(memory_format=torch.channels_last)
    layout = torch.channels_last if last else torch.contiguous_format
    return torch.empty(
        *part.shape[:-2], height, part.shape[-1], dtype=part.dtype, device=part.device, memory_format=layout
    )


def _convolve_and_halve(stage: Convolutions, x: Tensor) -> list[Tensor]:
    return [functional.max_pool2d(stage(x), 2)]


@torch.no_grad()
def round_trunk(trunk: Trunk) -> Trunk:
    """Copy of a trunk with weights in bfloat16, for processors that have it (AVX-512 bf16, AMX).

    Notes
    -----
    On the transfer curve the last of a bfloat16's eight bits is up to 3 % of a lamp's light. So the rounding errors of
    the nine taps between two channels cancel; the color that enters the last scale of the decoder brings its low bits
    along, as three channels with the weights of the color; and the last convolution is left in float32. Each network is
    then 63 to 66 dB from its float32 picture on the bundled shot, with a mean within 0.3 %; with weights cast
    as they are 58 to 59 dB, and up to 1.3 % too dark (`benchmarks/bench_trunk.py`).
    """
    rounded = copy.deepcopy(trunk)
    finest = cast(nn.Conv2d, cast(nn.Sequential, rounded.decoder[-1])[0])
    color = finest.weight[:, -rounded.config.inputs :][:, :3]
    finest.weight = nn.Parameter(torch.cat([finest.weight, color], 1))
    finest.in_channels += 3
    width = ENCODERS[rounded.config.size][-1][-1]
    for stage, widths in zip(rounded.decoder, DECODERS[rounded.config.size], strict=True):
        cast(Convolutions, stage).round_enlarged(width)
        width = widths[-1]
    *layers, _ = rounded.convolutions
    for layer in layers:
        weight = round_taps(layer.weight)
        layer.bfloat16().weight.data = weight.contiguous(memory_format=torch.channels_last)
    return rounded.eval().requires_grad_(False)


def round_taps(weight: Tensor) -> Tensor:
    """Weights in bfloat16, each tap taking over the error of greater ones, so that sums over taps are kept.

    Parameters
    ----------
    weight : Tensor
        ``(O, I, H, W)``.

    Returns
    -------
    Tensor
        As weight.
    """
    taps = weight.flatten(2)
    order = taps.abs().argsort(2, descending=True)
    rounded, error = torch.empty_like(taps, dtype=torch.bfloat16), torch.zeros_like(taps[..., 0])
    for tap in order.unbind(2):
        wanted = taps.gather(2, tap[..., None])[..., 0] + error
        rounded.scatter_(2, tap[..., None], wanted.bfloat16()[..., None])
        error = wanted - wanted.bfloat16()
    return rounded.view_as(weight)


def read_tza(data: bytes | memoryview, where: str = "TZA") -> dict[str, Tensor]:
    """Read the tensors of a TZA file, OIDN's archive of weights.

    Parameters
    ----------
    data : bytes
        The file, of version 2.
    where : str
        What errors call it.

    Returns
    -------
    dict of str to Tensor
        Float32, in the file's order, which is the order of the layers.

    Raises
    ------
    ValueError
        If it is not such a file, is cut short, or holds anything but finite numbers.

    Notes
    -----
    All little-endian. Magic 0x41D7 (uint16), version (2 × uint8), offset of the table (uint64); in the table the number
    of tensors (uint32), and for each the length of its name (uint16), the name, the number of dimensions (uint8), sizes
    (uint32), layout (a letter each), type (``f`` or ``h``), offset of the values (uint64).
    """
    position = 0

    def take(form: str) -> tuple[int, ...]:
        nonlocal position
        size = struct.calcsize("<" + form)
        if position + size > len(data):
            raise ValueError(f"{where}: expected {size} bytes at {position}, got {max(len(data) - position, 0)}")
        values = struct.unpack_from("<" + form, data, position)
        position += size
        return values

    def take_text(length: int) -> str:
        try:
            return bytes(take(f"{length}B")).decode("ascii")
        except UnicodeDecodeError as error:
            raise ValueError(f"{where}: expected ASCII at {position - length}") from error

    magic, major, _, position = take("HBBQ")
    if (magic, major) != (0x41D7, 2):
        raise ValueError(f"{where}: expected magic 0x41d7 and version 2, got {magic:#x} and {major}")
    tensors: dict[str, Tensor] = {}
    for _ in range(*take("I")):
        name = take_text(*take("H"))
        shape = take(f"{take('B')[0]}I")
        layout, kind = take_text(len(shape)), take_text(1)
        (offset,) = take("Q")
        if name in tensors or layout not in ("x", "oihw") or kind not in ("f", "h"):
            raise ValueError(f"{where}: expected a new tensor, x or oihw, f or h, got {name!r}, {layout!r}, {kind!r}")
        count, dtype = prod(shape), torch.float32 if kind == "f" else torch.float16
        if count == 0 or offset + count * dtype.itemsize > len(data):
            raise ValueError(f"{where}: {name} of shape {shape}: expected some values, all within the file")
        values = torch.frombuffer(bytearray(data[offset : offset + count * dtype.itemsize]), dtype=dtype).float()
        if not bool(values.isfinite().all()):
            raise ValueError(f"{where}: {name}: expected finite numbers, got others among them")
        tensors[name] = values.view(shape)
    return tensors


def make_trunk(tensors: dict[str, Tensor], where: str = "TZA") -> Trunk:
    """Trunk of the size that the tensors of a TZA file have, with their values.

    Parameters
    ----------
    tensors : dict of Tensor
        By name, in the file's order.
    where : str
        What an error calls the file.

    Returns
    -------
    Trunk
        Float32.

    Raises
    ------
    ValueError
        If they are those of no such network.
    """
    found = [tuple(value.shape) for value in tensors.values()]
    inputs = found[0][1] if found and len(found[0]) == 4 else 1
    # Built without memory, so that a file cannot ask for more of it than it brings.
    with torch.device("meta"):
        trunks = [Trunk(TrunkConfig(inputs, size)) for size in ENCODERS]
    for trunk in trunks:
        wanted = trunk.state_dict()
        if found == [tuple(value.shape) for value in wanted.values()]:
            trunk.load_state_dict(dict(zip(wanted, tensors.values(), strict=True)), assign=True)
            return trunk
    raise ValueError(f"{where}: expected the layers of a small, base or large U-Net, got {len(found)} other tensors")


def load_oidn(name: str) -> Trunk:
    """Trunk with OIDN's weights, read from the library of the installed package ``pyoidn``.

    Parameters
    ----------
    name : str
        Of `OIDN_WEIGHTS`.

    Returns
    -------
    Trunk
        Float32.

    Raises
    ------
    ValueError
        If there is no such name, or the library does not hold these weights.
    FileNotFoundError
        If there is no such library.
    """
    if name not in OIDN_WEIGHTS:
        raise ValueError(f"OIDN's weights: expected one of {', '.join(OIDN_WEIGHTS)}, got {name!r}")
    path = find_library()
    with path.open("rb") as file, mmap.mmap(file.fileno(), 0, access=mmap.ACCESS_READ) as library:
        return make_trunk(read_tza(_find_blob(library, name, path), name), name)


def find_library() -> Path:
    """Path of the library that holds OIDN's weights.

    Raises
    ------
    FileNotFoundError
        If ``pyoidn`` is not installed, or without it.
    """
    spec = importlib.util.find_spec("pyoidn")
    folders = [] if spec is None else spec.submodule_search_locations or []
    found = sorted(chain.from_iterable(Path(folder).rglob("*OpenImageDenoise_core.*") for folder in folders))
    if not found:
        raise FileNotFoundError("OIDN's weights: expected libOpenImageDenoise_core of the package pyoidn, found none")
    return found[0]


def _find_blob(library: mmap.mmap, name: str, path: Path) -> bytes:
    """The bytes of these weights, wherever in the library they lie."""
    size, digest = OIDN_WEIGHTS[name]
    start = library.find(_TZA)
    while start >= 0:
        blob = library[start : start + size]
        if len(blob) == size and hashlib.sha256(blob).hexdigest() == digest:
            return blob
        start = library.find(_TZA, start + 1)
    raise ValueError(f"OIDN's weights: expected {name} of OIDN 2.5.1 in {path.name}, found none of that SHA-256")


@torch.inference_mode()
def denoise_picture(
    trunk: Trunk,
    color: Tensor,
    albedo: Tensor | None = None,
    normal: Tensor | None = None,
    *,
    exposure: Tensor | None = None,
) -> Tensor:
    """Denoise pictures as OIDN does.

    Parameters
    ----------
    trunk : Trunk
        With weights for these inputs, in any precision; the last convolution may stay float32.
    color : Tensor
        ``(N, 3, H, W)`` linear radiance, float32; NaN and negative values count as 0.
    albedo, normal : Tensor, optional
        Likewise; albedo in [0, 1], normals in [−1, 1] in any fixed space, what lies beyond is clipped.
    exposure : Tensor, optional
        ``(N,)``, what color is multiplied by; without, its `autoexposure`. Part of a picture needs the whole's.

    Returns
    -------
    Tensor
        ``(N, 3, H, W)`` linear radiance, float32, at least 0.

    Raises
    ------
    ValueError
        If the inputs are not as many as the trunk's, or differ in shape.
    """
    scale = (autoexposure(color) if exposure is None else exposure).view(-1, 1, 1, 1)
    given = [("color", color), ("albedo", albedo), ("normal", normal)]
    ways: dict[str, Callable[[Tensor], Tensor]] = {
        "color": lambda x: pu_forward(_clip(x * scale, 0, _MOST)),
        "albedo": lambda x: _clip(x, 0, 1),
        "normal": lambda x: _clip(x, -1, 1) * 0.5 + 0.5,
    }
    layers = [(layer, ways[name]) for name, layer in given if layer is not None]
    return _run(trunk, layers, lambda x: pu_inverse(x.clamp_min(0)) / scale)


@torch.inference_mode()
def denoise_albedo(trunk: Trunk, albedo: Tensor) -> Tensor:
    """Denoise albedo by itself, as OIDN does; see `denoise_picture`.

    Parameters
    ----------
    trunk : Trunk
        With OIDN's weights for albedo.
    albedo : Tensor
        ``(N, 3, H, W)`` in [0, 1].

    Returns
    -------
    Tensor
        The same, without noise.
    """
    return _run(trunk, [(albedo, lambda x: srgb_forward(_clip(x, 0, 1)))], lambda x: srgb_inverse(x.clamp(0, 1)))


@torch.inference_mode()
def denoise_normal(trunk: Trunk, normal: Tensor) -> Tensor:
    """Denoise normals by themselves, as OIDN does; see `denoise_picture`.

    Parameters
    ----------
    trunk : Trunk
        With OIDN's weights for normals.
    normal : Tensor
        ``(N, 3, H, W)`` in [−1, 1].

    Returns
    -------
    Tensor
        The same, without noise.
    """
    return _run(trunk, [(normal, lambda x: _clip(x, -1, 1) * 0.5 + 0.5)], lambda x: x.clamp(0, 1) * 2 - 1)


def _run(
    trunk: Trunk, layers: Sequence[tuple[Tensor, Callable[[Tensor], Tensor]]], back: Callable[[Tensor], Tensor]
) -> Tensor:
    """The trunk on layers of any size, each brought to [0, 1], together, and its picture brought back; float32."""
    channels = sum(layer.shape[1] for layer, _ in layers)
    if channels != trunk.config.inputs:
        raise ValueError(f"inputs: expected {trunk.config.inputs} channels as the weights are for, got {channels}")
    height, width = layers[0][0].shape[2:]
    right, below = -width % trunk.multiple, -height % trunk.multiple

    def enter(*given: Tensor) -> list[Tensor]:
        parts = [to_unit(layer) for layer, (_, to_unit) in zip(given, layers, strict=True)]
        return [functional.pad(torch.cat(parts, 1), (0, right))]

    # Some rows at a time: what is made on the way is then small, and in the caches.
    (x,) = in_strips(enter, 0, *(layer for layer, _ in layers))
    picture = cast(Tensor, trunk(functional.pad(x, (0, 0, 0, below))))[..., :height, :width]
    (result,) = in_strips(lambda rows: [back(rows.float())], 0, picture)
    return result


def _clip(x: Tensor, low: float, high: float) -> Tensor:
    """x in [low, high], 0 for NaN."""
    return x.nan_to_num(0, high, low).clamp(low, high)


def autoexposure(color: Tensor) -> Tensor:
    """Factor by which OIDN brings a picture to middle gray.

    Parameters
    ----------
    color : Tensor
        ``(N, 3, H, W)`` linear; NaN and negative values count as 0.

    Returns
    -------
    Tensor
        ``(N,)``, positive; ``autoexposure(a·x) = autoexposure(x) / a``. 1 where nothing is above 1e-8.

    Notes
    -----
    ``0.18 / 2^mean(log2 L)``, L the mean luminances above 1e-8 of bins of at most 16×16 pixels.
    """
    # float64: a sum over a bin may exceed float32 where no pixel does.
    weights = torch.tensor([0.212671, 0.715160, 0.072169], dtype=torch.float64, device=color.device)
    (luminance,) = in_strips(lambda x: [torch.einsum("nchw,c->nhw", _clip(x, 0, _MOST).double(), weights)], 0, color)
    for axis in (1, 2):
        length = luminance.shape[axis]
        bins = -(-length // 16)
        edges = torch.arange(bins + 1, device=color.device) * length // bins
        luminance = torch.segment_reduce(
            luminance.movedim(axis, 0).contiguous(), "mean", lengths=edges.diff(), axis=0
        ).movedim(0, axis)
    lit = luminance > 1e-8
    logs = torch.where(lit, luminance, 1).log2().sum((1, 2)) / lit.sum((1, 2)).clamp_min(1)
    return torch.where(lit.any(2).any(1), 0.18 / logs.exp2(), 1).float()


# The greatest float32.
_MOST = torch.finfo(torch.float32).max
# A fit of the PU2 curve of Aydin, Mantiuk and Seidel 2008, doi:10.1117/12.765095, normalised at 100 cd/m², from OIDN's
# training/color.py: a line up to Y0, a power up to Y1, a logarithm above.
_A, _B, _C, _D, _E, _F, _G = (
    1.41283765e03, 1.64593172e00, 4.31384981e-01, -2.94139609e-03, 1.92653254e-01, 6.26026094e-03, 9.98620152e-01
)  # fmt: skip
_Y0, _Y1, _X0, _X1 = 1.57945760e-06, 3.22087631e-02, 2.23151711e-03, 3.70974749e-01
# What the greatest half, 65504, is mapped to before it is called 1.
_WHITE = _E * log(65504 + _F) + _G
#: All that `pu_forward` is made of, for loops that compute it themselves.
PU_CURVE = _Y0, _Y1, _A, _B, _C, _D, _E, _F, _G, _WHITE


def pu_forward(y: Tensor) -> Tensor:
    """Map radiance to a perceptually uniform scale.

    Parameters
    ----------
    y : Tensor
        Radiance in [0, ∞), 0.18 being middle gray.

    Returns
    -------
    Tensor
        65504, the greatest half, is 1.
    """
    x = torch.where(y <= _Y1, _B * y.clamp_min(_Y0) ** _C + _D, _E * (y + _F).log() + _G)
    return torch.where(y <= _Y0, _A * y, x) / _WHITE


def pu_inverse(x: Tensor) -> Tensor:
    """Inverse of `pu_forward`.

    Parameters
    ----------
    x : Tensor
        On the perceptually uniform scale.

    Returns
    -------
    Tensor
        Radiance.
    """
    x = x * _WHITE
    y = torch.where(x <= _X1, ((x.clamp_min(_X0) - _D) / _B) ** (1 / _C), ((x - _G) / _E).exp() - _F)
    return torch.where(x <= _X0, x / _A, y)


def srgb_forward(y: Tensor) -> Tensor:
    """sRGB curve (IEC 61966-2-1).

    Parameters
    ----------
    y : Tensor
        Linear, in [0, 1].

    Returns
    -------
    Tensor
        Encoded, in [0, 1].
    """
    return torch.where(y <= 0.0031308, 12.92 * y, 1.055 * y.clamp_min(0.0031308) ** (1 / 2.4) - 0.055)


def srgb_inverse(x: Tensor) -> Tensor:
    """Inverse of `srgb_forward`.

    Parameters
    ----------
    x : Tensor
        Encoded, in [0, 1].

    Returns
    -------
    Tensor
        Linear, in [0, 1].
    """
    return torch.where(x <= 0.04045, x / 12.92, ((x.clamp_min(0.04045) + 0.055) / 1.055) ** 2.4)
