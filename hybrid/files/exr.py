"""Read and write OpenEXR files: pixels and headers. `hybrid.files.layers` says which channels are what.

A file is read whole: its channels are compressed together, and reading 3 of 40 channels costs two thirds of the time
of reading all. `read_exr(path, pixels=False)` reads the headers alone, which takes no time.

Channels have *qualified* names: the name in the file, preceded in a multi-part file by the part's name unless the
channel already starts with it, so that one scheme covers both kinds (``ViewLayer.Combined.R``).
"""

import io
import os
import re
import sys
import tempfile
import threading
from collections.abc import Collection, Iterator, Mapping
from contextlib import contextmanager, suppress
from dataclasses import dataclass, replace
from functools import cached_property
from pathlib import Path
from typing import Any, TextIO

import numpy as np
import OpenEXR

from hybrid.files.replace import refuse_other_kinds, replace_file
from hybrid.files.strings import readable_copy, restore_strings, without_surrogates
from hybrid.runtime.streams import open_standard_streams

# 16384 × 16384: four times the area of the largest frames that are rendered (IMAX, LED walls), and small enough that a
# hundred-byte file which claims to be 2^31 pixels wide is refused before anything is allocated.
MAX_PIXELS = 2**28

HALF_MAX = float(np.finfo(np.float16).max)
# Compressions that change values each time they are written; PXR24 does not change values that it has written.
_LOSSY = {"B44_COMPRESSION", "B44A_COMPRESSION", "DWAA_COMPRESSION", "DWAB_COMPRESSION", "LJ2K_COMPRESSION"}
_MAGIC = b"\x76\x2f\x31\x01"


class ExrError(ValueError):
    """An OpenEXR file that cannot be used, or that lacks a layer. One line; names the file."""


@dataclass(frozen=True)
class Layer:
    """Channels that belong together, all of one part.

    `channels` are qualified names, in the order R G B A or X Y Z W, any others after those. `name` is their common part
    (``ViewLayer.Combined``); "" for the bare channels R, G, B, A, Z of a single-part file. `file` names the sidecar
    sequence that holds the layer. Gray that is read as a color is one channel three times.
    """

    name: str
    part: int
    view: str | None
    channels: tuple[str, ...]
    file: str = ""

    def __str__(self) -> str:
        components = [channel.rpartition(".")[2] for channel in dict.fromkeys(self.channels)]
        joined = ("" if all(len(c) == 1 for c in components) else ",").join(components)
        own = f"{self.name}.{joined}" if self.name else joined
        return f"{self.file}:{own}" if self.file else own


@dataclass(frozen=True, eq=False)
class Part:
    """One part of a file: its header as the binding gives it, and its channels under their own names."""

    name: str
    header: Mapping[str, Any]
    channels: Mapping[str, OpenEXR.Channel]

    @property
    def view(self) -> str | None:
        """The stereo view all of this part belongs to, if the part names one."""
        return self.header.get("view")

    @property
    def deep(self) -> bool:
        """Whether its pixels are lists of samples; such a part has no layers."""
        return self.header.get("type") in (OpenEXR.deepscanline, OpenEXR.deeptile)

    def would_lose(self, replaced: Collection[str]) -> str | None:
        """Return the lossy codec that would re-encode channels that are kept, alpha among them, or None."""
        compression = self.header["compression"].name
        # DWA and its like keep alpha exactly.
        exact = {name for name in self.channels if component_of(name) == "A" and not compression.startswith("B44")}
        kept = {name for name in self.channels if name not in replaced or component_of(name) == "A"} - exact
        return str(compression.removesuffix("_COMPRESSION")) if compression in _LOSSY and kept else None

    @property
    def data_window(self) -> tuple[int, int, int, int]:
        """First column, first row, last column, last row of the pixels that are stored."""
        low, high = self.header["dataWindow"]
        return int(low[0]), int(low[1]), int(high[0]), int(high[1])

    @property
    def display_window(self) -> tuple[int, int, int, int]:
        """First column, first row, last column, last row of the picture."""
        low, high = self.header["displayWindow"]
        return int(low[0]), int(low[1]), int(high[0]), int(high[1])

    @property
    def shape(self) -> tuple[int, int]:
        """Height and width of the data window."""
        left, top, right, bottom = self.data_window
        return bottom - top + 1, right - left + 1


@dataclass(frozen=True, eq=False)
class ExrImage:
    """The parts, channels and layers of a file."""

    path: Path
    parts: tuple[Part, ...]

    @cached_property
    def views(self) -> tuple[str, ...]:
        """Names of the stereo views, the default one first; () for an ordinary picture."""
        named = self.parts[0].header.get("multiView") or [p.view for p in self.parts if p.view]
        if not named:
            tokens = {token for p in self.parts for c in p.channels for token in c.split(".")[:-1]}
            named = ["left", "right"] if {"left", "right"} <= tokens else []
        return tuple(dict.fromkeys(named))

    @cached_property
    def _origin(self) -> dict[str, tuple[int, str]]:
        """Qualified name → (part, name in that part)."""
        origin: dict[str, tuple[int, str]] = {}
        for index, part in enumerate(self.parts):
            for name in () if part.deep else part.channels:
                qualified = self._qualify(part, name)
                if qualified in origin:  # parts "a" and "a.b" with channels "b.R" and "R"
                    qualified = f"{index}.{qualified}"
                origin[qualified] = index, name
        return origin

    def _qualify(self, part: Part, name: str) -> str:
        """The qualified name of a channel; the same for single-part and multi-part stereo."""
        if len(self.parts) == 1:
            return name
        # Part names are unique, so writers add the view to them: Blender "ViewLayer.Combined-left", with channels
        # "ViewLayer.Combined.R"; others "rgba_left", with channels "R". Where there is one view, Nuke calls it main.
        base = re.sub(rf"[-_.]{re.escape(part.view or 'main')}$", "", part.name)
        *layer, component = name.split(".")
        own = ".".join(layer)
        layer = [own] if own in (base, part.name) or own.startswith(base + ".") else [base, *layer]
        if part.view and part.view not in ".".join(layer).split("."):
            layer.append(part.view)
        return ".".join([*layer, component])

    def own_name(self, channel: str) -> str:
        """Return the name of a channel in its part."""
        return self._origin[channel][1]

    def recompressed(self, replaced: Collection[str]) -> dict[int, str]:
        """Return part index → compression of the parts that would lose kept channels (`Part.would_lose`)."""
        places = {self._origin[name] for name in replaced}
        lossy = {i: p.would_lose({own for at, own in places if at == i}) for i, p in enumerate(self.parts)}
        return {index: compression for index, compression in lossy.items() if compression is not None}

    @cached_property
    def layers(self) -> tuple[Layer, ...]:
        """All layers, in the order of the file."""
        groups: dict[tuple[str, int], list[str]] = {}
        for qualified, (part, _) in self._origin.items():
            groups.setdefault((qualified.rpartition(".")[0], part), []).append(qualified)
        found = [
            Layer(
                name,
                part,
                self.parts[part].view or next((view for view in self.views if view in name.split(".")), None),
                tuple(sorted(channels, key=_component_order)),
            )
            for (name, part), channels in groups.items()
        ]
        # Names of the default view may leave it out: R beside right.R, albedo.R beside albedo.right.R. Then all do.
        left_out = {"", *(without_view(layer) for layer in found if layer.view)}
        if self.views and any(layer.view is None and layer.name in left_out for layer in found):
            found = [replace(layer, view=layer.view or self.views[0]) for layer in found]
        return tuple(found)

    @cached_property
    def ending(self) -> str:
        """The word that ends the names of all layers (``.main`` of ``rgba.main`` and ``albedo.main``); "" for none."""
        names = {without_view(layer) for layer in self.layers} - {""}
        ends = {match[0] if (match := re.search(r"[._ -][^._ -]+$", name)) else "" for name in names}
        return ends.pop() if len(names) > 1 and len(ends) == 1 else ""

    @property
    def channel_names(self) -> tuple[str, ...]:
        """Qualified names of all channels that are not deep."""
        return tuple(self._origin)

    def part_of(self, name: str) -> Part:
        """Return the part that holds a channel; raise ExrError if there is none."""
        if name not in self._origin:
            raise ExrError(f"{self.path}: no channel {name!r}; {self.listing()}")
        return self.parts[self._origin[name][0]]

    def channel(self, name: str) -> np.ndarray:
        """Return the pixels of a channel: (H, W) float16, float32 or uint32, as in the file; not a copy."""
        part = self.part_of(name)
        pixels: np.ndarray | None = part.channels[self._origin[name][1]].pixels
        if pixels is None or pixels.shape != part.shape:
            raise ValueError(f"{self.path}: pixels were not read (pixels=False)")
        return pixels

    def pixels(self, channels: tuple[str, ...]) -> np.ndarray:
        """Return several channels of one part, stacked: (H, W, C) float32."""
        planes = [self.channel(name) for name in channels]
        out = np.empty((*planes[0].shape, len(planes)), np.float32)
        for index, plane in enumerate(planes):
            out[..., index] = plane
        return out

    def layer(self, name: str) -> Layer:
        """Return the layer with this name, or a channel as a layer; ExrError, with what is there, unless there is one.

        Tried in this order: the name of a layer (``RGBA`` or ``RGB`` for the bare channels), without its view, of a
        channel, of a layer with its channels (``ViewLayer.Combined.RGBA``, as listed), of a part; all of these in any
        case; the end of a layer's name (``DiffDir`` for ``ViewLayer.DiffDir``). The default stereo view goes before the
        others.
        """
        end = "." + name.lower()
        for fold in (str, str.lower):
            for known in self._known_names:
                if found := [layer for alias, layer in known if fold(alias) == fold(name)]:
                    return self._only(name, found)
        ends = [x for x in self.layers if any(n.lower().endswith(end) for n in (x.name, without_view(x)))]
        if not ends:
            raise ExrError(f"{self.path}: no layer {name!r}; {self.listing()}")
        return self._only(name, ends)

    @cached_property
    def _known_names(self) -> list[list[tuple[str, Layer]]]:
        """Lists of (name, layer), in the order in which `layer` tries them."""
        layers = self.layers
        bare = [(alias, layer) for layer in layers if not layer.name for alias in ("RGBA", "RGB")]
        return [
            [(layer.name, layer) for layer in layers if layer.name] + bare,
            [(without_view(layer), layer) for layer in layers],
            [(c, Layer(c, layer.part, layer.view, (c,))) for layer in layers for c in layer.channels],
            [(str(layer), layer) for layer in layers],
            [(self.parts[layer.part].name, layer) for layer in layers if len(self.parts) > 1],
        ]

    def _only(self, name: str, found: list[Layer]) -> Layer:
        """The only layer that a name fits, of the default view if there are several."""
        if len(found) > 1:
            found = [layer for layer in found if layer.view in (None, *self.views[:1])] or found
        if len(found) > 1:
            raise ExrError(f"{self.path}: layer {name!r} is ambiguous: {', '.join(map(str, found))}")
        return found[0]

    def again(self, layer: Layer) -> Layer:
        """Return a layer of another file of the shot as it is in this file; raise ExrError if a channel is missing."""
        for channel in layer.channels:
            self.part_of(channel)
        return replace(layer, part=self._origin[layer.channels[0]][0])

    def listing(self) -> str:
        """Return the names of the layers for an error message, at most 24."""
        names = [str(layer) for layer in self.layers]
        more = f" and {len(names) - 24} more" if len(names) > 24 else ""
        return f"it has {', '.join(names[:24])}{more}"


def _component_order(channel: str) -> tuple[int, str]:
    """Sort key that puts the components of a colour or vector in their order."""
    component = component_of(channel)
    order = "RGBAXYZWUV".find(component) if len(component) == 1 else -1
    return (order if order >= 0 else 99), channel


def component_of(channel: str) -> str:
    """R, G, B, A, X, … of a channel's name; V-Ray writes ``diffuse.red``, Cryptomatte ``r``."""
    component = channel.rpartition(".")[2].upper()
    return {"RED": "R", "GREEN": "G", "BLUE": "B", "ALPHA": "A"}.get(component, component)


def without_view(layer: Layer) -> str:
    """Return the layer's name without its view (``ViewLayer.Combined.left`` → ``ViewLayer.Combined``)."""
    tokens = layer.name.split(".")
    if layer.view in tokens:
        tokens.remove(layer.view)
    return ".".join(tokens)


def read_exr(path: str | Path, *, pixels: bool = True, max_pixels: int = MAX_PIXELS) -> ExrImage:
    """Read an OpenEXR file, of scan lines or tiles, one part or several, or its headers only.

    `max_pixels` is the largest data window accepted; memory is bounded by 64 bytes for each of these pixels. Raises
    OSError if the file cannot be opened; ExrError if it is no OpenEXR file, damaged (also where only one part is), too
    large, deep in all parts, mip-mapped or chroma-subsampled.
    """
    path = Path(path)
    refuse_other_kinds(path)
    with path.open("rb") as file:
        if file.read(4) != _MAGIC:
            raise ExrError(f"{path}: not an OpenEXR file")
    OpenEXR.setMaxImageSize(2**16, 2**16)
    OpenEXR.setMaxTileSize(2**13, 2**13)
    headers = _open(path, header_only=True)
    _refuse_unusable(path, headers, max_pixels)
    return ExrImage(path, _open(path, header_only=False) if pixels else headers)


def _open(path: Path, *, header_only: bool) -> tuple[Part, ...]:
    parts: tuple[Part, ...] = ()
    with _library_messages() as messages:
        try:
            try:
                parts = _load(path, {}, header_only=header_only)
            except UnicodeDecodeError:
                with readable_copy(path, header_only=header_only) as (copy, strings):
                    parts = _load(copy, strings, header_only=header_only)
        except Exception as error:  # the binding raises RuntimeError, UnicodeDecodeError, MemoryError, …
            reason = str(error).replace(f" '{path}'", "").removesuffix(" when attempting to open for read")
            messages.append(reason.replace("\n", " "))
    # The binding leaves out a part whose pixels cannot be read, with a message and no exception.
    if messages or not parts:
        reason = messages[0] if messages else "no parts"
        raise ExrError(f"{path}: damaged or truncated OpenEXR file ({reason})")
    return parts


def _load(path: Path, strings: Mapping[tuple[int, str], str], *, header_only: bool) -> tuple[Part, ...]:
    """The parts of a file; `strings`, by part and name, replace strings of their headers."""
    file = OpenEXR.File(_for_library(path), separate_channels=True, header_only=header_only)
    parts = []
    for index, part in enumerate(file.parts):
        own = {name: text for (where, name), text in strings.items() if where == index}
        header = {**part.header, **own} if own else part.header
        channels = header["channels"] if header_only else part.channels.values()
        parts.append(Part(header.get("name", ""), header, {channel.name: channel for channel in channels}))
    return tuple(parts)


def _for_library(path: Path) -> str | bytes:
    """A path for the library: bytes if it is not UTF-8, which the library refuses as a string."""
    name = str(path)
    return name if without_surrogates(name) == name else os.fsencode(name)


def _refuse_unusable(path: Path, parts: tuple[Part, ...], max_pixels: int) -> None:
    """Raise ExrError for a well-formed file that cannot be denoised, before memory is allocated for it."""
    total = 0
    if parts and all(part.deep for part in parts):
        raise ExrError(f"{path}: deep image, expected a flat one, or one with a flat part")
    for part in parts:
        tiles = part.header.get("tiles")
        if tiles is not None and tiles.mode != OpenEXR.ONE_LEVEL:
            raise ExrError(f"{path}: mip-mapped texture, not a rendered frame")
        for name, channel in part.channels.items():
            if (channel.xSampling, channel.ySampling) != (1, 1):
                raise ExrError(f"{path}: channel {name!r} is subsampled (luminance-chroma); convert to RGB")
        height, width = part.shape
        if height * width > max_pixels:
            raise ExrError(f"{path}: {width}x{height} pixels, more than the {max_pixels} accepted")
        total += height * width * 4 * len(part.channels)
    if not any(part.channels for part in parts):
        raise ExrError(f"{path}: no channels")
    if total > 64 * max_pixels:  # allows 16 float channels at MAX_PIXELS, 500 at 4K
        raise ExrError(f"{path}: decodes to {total / 2**30:.0f} GiB, too much")


class _Listener:
    """Replaces sys.stdout and records the output of one thread; other threads write to the stream as before."""

    def __init__(self, stream: TextIO | None) -> None:
        self._stream = stream or io.StringIO()  # None where the process was started without one
        self._thread = threading.get_ident()
        self.heard = ""

    def write(self, text: str) -> int:
        if threading.get_ident() != self._thread:
            return self._stream.write(text)
        self.heard += text
        return len(text)

    def __getattr__(self, name: str) -> Any:
        return getattr(self._stream, name)


_LIBRARY_LOCK = threading.Lock()
_own_stderr: int | None = None  # the process's stderr while descriptor 2 is captured


@contextmanager
def hold_library(seconds: float) -> Iterator[None]:
    """Block reading and writing of files, so that descriptor 2 is the process's own stderr.

    Waits up to `seconds` for a call that is running; after that its messages are no longer captured, as the process is
    about to end.
    """
    held = _LIBRARY_LOCK.acquire(timeout=seconds)
    if not held and _own_stderr is not None:
        with suppress(OSError):  # the call has ended meanwhile, and has restored descriptor 2 itself
            os.dup2(_own_stderr, 2)
    try:
        yield
    finally:
        if held:
            _LIBRARY_LOCK.release()


@contextmanager
def _library_messages() -> Iterator[list[str]]:
    """Capture OpenEXR's messages about a damaged file, which it prints instead of raising.

    The C library prints to file descriptor 2 and the binding to sys.stdout. Output of other threads to descriptor 2
    (decoding releases the GIL) is passed on afterwards. The list is filled on leaving.
    """
    global _own_stderr
    messages: list[str] = []
    open_standard_streams()
    with _LIBRARY_LOCK, tempfile.TemporaryFile() as sink:
        before, listener = sys.stdout, _Listener(sys.stdout)
        stderr = _own_stderr = os.dup(2)
        os.dup2(sink.fileno(), 2)
        sys.stdout = listener
        try:
            yield messages
        finally:
            if sys.stdout is listener:
                sys.stdout = before
            os.dup2(stderr, 2)
            _own_stderr = None
            os.close(stderr)
            sink.seek(0)
            printed = sink.readlines()
            for line in printed:
                if b"(EXR_ERR" not in line:
                    with suppress(OSError):  # its reader has gone
                        os.write(2, line)
            # The first line of the C library is the most precise.
            reasons = [
                line.decode(errors="replace").partition("(EXR_ERR")[2].partition(") ")[2].strip()
                for line in printed
                if b"(EXR_ERR" in line
            ]
            reasons += [line.rpartition(" - ")[2] for line in listener.heard.splitlines()]
            messages[:0] = reasons


def write_exr(
    path: str | Path,
    source: ExrImage,
    replaced: Mapping[str, np.ndarray],
    extra: Mapping[str, np.ndarray] | None = None,
    attributes: Mapping[str, str] | None = None,
) -> int:
    """Write a file again with some channels replaced; every other channel, part and attribute is kept.

    `path` may be the source itself; the file appears when all of it is written. `replaced` maps qualified channel names
    to (H, W), of the part's data window, which are converted to the source's pixel type; `extra` maps names of layers
    to add to (H, W) or (H, W, C), of some part's data window; `attributes` are strings for the first header. Returns
    how many finite values were too large for a half channel, and were written as ±65504 instead of Inf. A part that
    keeps channels, whose compression loses a little each time (DWA, B44), is written with ZIP.

    Raises ExrError if the source has no such channel, or an added layer already; ValueError if such a layer has more
    than four channels, or an attribute would replace one that is no string; OSError if the file cannot be written.
    """
    by_part: list[dict[str, OpenEXR.Channel]] = [dict(part.channels) for part in source.parts]
    clamped = 0
    for name, values in replaced.items():
        old = source.channel(name)
        at, own = source._origin[name]
        pixels, count = _convert(values, old.dtype)
        clamped += count
        channel = source.parts[at].channels[own]
        by_part[at][own] = OpenEXR.Channel(own, pixels, channel.xSampling, channel.ySampling, channel.pLinear)

    added: list[OpenEXR.Part] = []
    for name, values in (extra or {}).items():
        over = next(i for i, p in enumerate(source.parts) if p.shape == values.shape[:2] and not p.deep)
        channels = {n: OpenEXR.Channel(n, np.ascontiguousarray(v)) for n, v in _named(name, values).items()}
        if there := [n for n in channels if n in source.channel_names]:
            raise ExrError(f"{source.path}: channel {there[0]!r} is to be added, and is there already")
        if len(source.parts) == 1:
            by_part[over].update(channels)
        else:
            header = {k: v for k, v in source.parts[over].header.items() if k in _SHARED}
            added.append(OpenEXR.Part(header, channels, name))

    parts = []
    recompressed = source.recompressed(replaced)
    for index, part in enumerate(source.parts):
        # The binding makes the channel list, and cannot infer the type of empty lists.
        header = {k: v for k, v in part.header.items() if k != "channels" and not (isinstance(v, list) and not v)}
        if index in recompressed:
            header["compression"] = OpenEXR.ZIP_COMPRESSION
        for key, value in (attributes or {}).items() if index == 0 else ():
            if not isinstance(header.get(key, ""), str):
                raise ValueError(f"attribute {key!r} of {source.path} is not a string, and cannot be set")
            header[key] = value
        parts.append(OpenEXR.Part(header, by_part[index], without_surrogates(part.name)))
        if part.name:
            parts[-1].header["name"] = part.name
    _write(Path(path), parts + added)
    return clamped


# Attributes that an added part copies from the part of the same size.
_SHARED = (
    "compression",
    "dataWindow",
    "displayWindow",
    "pixelAspectRatio",
    "screenWindowCenter",
    "screenWindowWidth",
    "chromaticities",
    "timeCode",
    "view",
)


def _is_vector(name: str) -> bool:
    return name.lower().rpartition(".")[2].endswith(("normal", "vector", "motion", "position"))


def _named(name: str, values: np.ndarray) -> dict[str, np.ndarray]:
    """Channel name → (H, W), for the layer `name`."""
    count = 1 if values.ndim == 2 else values.shape[2] if values.ndim == 3 else 0
    if not 1 <= count <= 4:
        raise ValueError(f"layer {name!r} has shape {values.shape}, expected (H, W) or (H, W, 1 to 4)")
    if count == 1:
        components = "Z" if name.lower().rpartition(".")[2].endswith("depth") else "Y"
    else:
        components = "XYZW" if _is_vector(name) else "RGBA" if count > 2 else "XY"
    planes = values.reshape(*values.shape[:2], count)
    return {f"{name}.{c}" if name else c: planes[..., i] for i, c in enumerate(components[:count])}


def _convert(values: np.ndarray, kind: np.dtype) -> tuple[np.ndarray, int]:
    """Return `values` as contiguous pixels of this type, and how many finite values exceeded its range."""
    clamped = 0
    if kind == np.float16 and values.dtype != np.float16:
        # 65520 and above round to Inf. Values that are Inf or NaN already stay.
        beyond = (np.abs(values) > HALF_MAX) & np.isfinite(values)
        clamped = int(np.count_nonzero(beyond))
        if clamped:
            values = np.where(beyond, np.copysign(np.float32(HALF_MAX), values), values)
    elif kind == np.uint32 and values.dtype != np.uint32:
        # Through float64, which holds every uint32 exactly.
        values = np.clip(np.rint(np.nan_to_num(values.astype(np.float64))), 0, 2**32 - 1)
    return np.ascontiguousarray(values, dtype=kind), clamped


def _write(path: Path, parts: list[OpenEXR.Part]) -> None:
    """Write parts to a temporary file, then rename it to `path`."""
    odd = []
    for part in parts:
        texts = {name: value for name, value in part.header.items() if isinstance(value, str)}
        odd.append({name: text for name, text in texts.items() if without_surrogates(text) != text})
        part.header.update({name: without_surrogates(text) for name, text in odd[-1].items()})
    with replace_file(path) as temporary:
        with _library_messages() as messages:
            try:
                OpenEXR.File(parts).write(_for_library(temporary))
                if any(odd):
                    restore_strings(temporary, odd)
            except Exception as error:
                messages.append(str(error).replace(str(temporary), str(path)).replace("\n", " "))
        if messages:  # filled on leaving the block above
            raise OSError(f"{path}: cannot write: {messages[0]}")
