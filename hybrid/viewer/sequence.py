"""A sequence of EXR files for the viewer: frames as they appear, and their layers as 8-bit images."""

import math
import os
import threading
from collections import OrderedDict
from collections.abc import Callable, Hashable, Mapping
from contextlib import suppress
from pathlib import Path
from typing import Any

import cv2
import numpy as np
from numpy.typing import NDArray

from hybrid.files.decode import Window, data_window, display_size, place
from hybrid.files.exr import MAX_PIXELS, ExrError, ExrImage, Layer, component_of, read_exr
from hybrid.files.layers import Layers, find_colors, find_layers
from hybrid.files.png import Image8, display_exposure, encode_filmic, encode_srgb
from hybrid.files.profile import find_profile
from hybrid.files.sequences import Pattern, find_files, list_patterns, parse_frames, pattern_of
from hybrid.files.sources import MADE_FROM, parse_object
from hybrid.run.records import read_records, sequence_name
from nlm.average import replace_nonfinite

# Cache of decoded layers, so that another exposure takes milliseconds.
CACHE_BYTES = 512 * 2**20
LARGEST_SIDE = 65500  # pixels of a JPEG


# How radiance is encoded.
VIEWS: dict[str, Callable[[NDArray[Any]], NDArray[Any]]] = {"srgb": encode_srgb, "filmic": encode_filmic}


class Sequence:
    """Frames, if any yet, of a pattern, folder or file; of `finished` ones the denoised layer is the first choice.

    `pattern` is that of one sequence of a folder; None for the first one there.
    """

    def __init__(self, spec: str, *, finished: bool, pattern: Pattern | None = None) -> None:
        self.spec = spec  # with the pattern if the folder has several
        self.finished = finished
        self._given, self._pattern = spec, pattern
        self._files: dict[int, Path] = {}
        self._cache: OrderedDict[Hashable, NDArray[Any]] = OrderedDict()
        self._ranges: dict[str, tuple[float, float]] = {}
        self._lock = threading.Lock()

    def files(self) -> dict[int, Path]:
        """Return the files that exist now, by frame number."""
        try:
            found, frames = (self._in_folder(), None) if Path(self._given).is_dir() else find_files(self._given)
        except FileNotFoundError:
            found, frames = {}, None
        wanted = found.keys() if frames is None else found.keys() & set(parse_frames(frames))
        self._files = {number: found[number] for number in wanted}
        return self._files

    def _in_folder(self) -> dict[int, Path]:
        folder = Path(self._given)
        if not (patterns := list_patterns(folder)):
            return {}
        own = self._pattern
        self._pattern = next(
            (p for p in patterns if own and (p.before, p.after) == (own.before, own.after)), patterns[0]
        )
        if len(patterns) > 1:
            self.spec = str(folder / str(self._pattern))
        return self._pattern.files()

    @property
    def key(self) -> tuple[Path, str, str] | None:
        """The folder and the name around the number, by which sequences differ; None without frames."""
        path = next(iter(self._files.values()), None)
        return None if path is None else (path.parent.resolve(), pattern_of(path).before, pattern_of(path).after)

    def others(self) -> "list[Sequence]":
        """Return all sequences of the folder, if it is one."""
        folder, finished = Path(self._given), self.finished
        patterns = list_patterns(folder) if folder.is_dir() else []
        return [Sequence(self._given, finished=finished, pattern=pattern) for pattern in patterns]

    def versions(self) -> dict[int, str]:
        """Return a version of each file, by frame number, that changes when the file is replaced."""
        found = {}
        for number, path in self.files().items():
            with suppress(OSError):  # deleted since the folder was listed
                found[number] = _version(path.stat())
        return found

    def layers(self, number: int) -> tuple[list[str], str]:
        """Return the names of a frame's layers, and the name of the first choice; reads the header only."""
        image = read_exr(self._path(number), pixels=False)
        taken = _layers(image)
        first = taken.target if self.finished else taken.color
        return [_name(layer) for layer in image.layers], _name(first)

    def check_sizes(self) -> None:
        """Raise ExrError if the display window of the first frame is too large for the viewer."""
        for path in list(self.files().values())[:1]:
            try:
                image = read_exr(path, pixels=False)
            except (OSError, ExrError):  # incomplete so far
                continue
            _refuse_large_display(image)

    def exposure(self, number: int) -> float:
        """Return the divisor that brings middle gray of a frame's color to 0.18."""
        image = read_exr(self._path(number))
        color, _ = replace_nonfinite(image.pixels(_layers(image).color.channels))
        return display_exposure(color)

    def picture(self, number: int, name: str, gain: float, ev: float, view: str = "srgb") -> Image8:
        """Return a layer of a frame as an (H, W, 3) 8-bit image on the display window, black outside the data.

        Radiance is multiplied by `gain`, albedo and single channels are brightened by `ev` stops; radiance is encoded
        by the `view`, one of `VIEWS`, albedo by sRGB. Vectors have their zero at middle gray. Single channels are gray:
        in [0, 1] unchanged, others scaled, like vectors, by the range of the first frame that was shown. KeyError if
        there is no such frame, layer or view; OSError or ExrError if the file cannot be read, for instance because it
        is incomplete so far.
        """
        image, layer, pixels = self._read_layer(number, name)
        part = image.parts[layer.part]
        width, height = display_size(part)
        encoded = self._encode(pixels, layer, _layers(image), gain, ev, VIEWS[view])
        return place(encoded, data_window(part), Window(0, 0, width - 1, height - 1))

    def values(self, number: int, name: str, x: int, y: int) -> dict[str, float | None]:
        """Return a pixel's values by component, None if not finite, {} outside; (0, 0) is the display's top left."""
        image, layer, pixels = self._read_layer(number, name)
        part = image.parts[layer.part]
        column, row = x - data_window(part).left, y - data_window(part).top
        if not (0 <= row < pixels.shape[0] and 0 <= column < pixels.shape[1]):
            return {}
        found = (float(value) for value in pixels[row, column])
        return {component_of(c): v if math.isfinite(v) else None for c, v in zip(layer.channels, found, strict=True)}

    def _read_layer(self, number: int, name: str) -> tuple[ExrImage, Layer, NDArray[Any]]:
        """A frame's file, a layer of it, and its pixels (H, W, C), from the cache if they are there."""
        path = self._path(number)
        key = path, _version(path.stat()), name
        with self._lock:
            pixels = self._cache.get(key)
        image = read_exr(path, pixels=pixels is None)
        layer = {_name(layer): layer for layer in image.layers}[name]
        _refuse_large_display(image)
        if pixels is None:
            pixels = image.pixels(layer.channels)
            with self._lock:
                self._cache[key] = pixels
                while len(self._cache) > 1 and sum(cached.nbytes for cached in self._cache.values()) > CACHE_BYTES:
                    self._cache.popitem(last=False)
        return image, layer, pixels

    def facts(self, number: int) -> dict[str, Any]:
        """Return the header's facts on the denoising, and the mean weight of each frame of the window, if present."""
        path = self._path(number)
        image = read_exr(path, pixels=False)
        header = image.parts[0].header
        ours = [key for key in header if key.startswith("ravg/") and key != MADE_FROM]
        made = {key.removeprefix("ravg/"): str(header[key]) for key in ours}
        # A view's layers have its name: Back.Combined.weight.before1.
        weights = {
            layer.name.replace("weight.", ""): layer
            for layer in image.layers
            if "weight" in layer.name.split(".")[-2:-1]
        }
        if weights:
            image = read_exr(path)
        ordered = sorted(weights, key=_time_of)
        means = {name: float(image.pixels(weights[name].channels).mean()) for name in ordered}
        return {"file": path.name, "made": _in_words(made), "weights": means}

    def record(self) -> dict[str, Any]:
        """Return the record of the latest run: stages with their cost, and the plan; {} if there is none."""
        path = next(iter(self._files.values()), None)
        records = [] if path is None else list(read_records(path.parent, sequence_name(path)))
        return records[-1][1] if records else {}

    def _path(self, number: int) -> Path:
        return self._files[number] if number in self._files else self.files()[number]

    def _encode(
        self,
        pixels: NDArray[Any],
        layer: Layer,
        taken: Layers,
        gain: float,
        ev: float,
        encode: Callable[[NDArray[Any]], NDArray[Any]],
    ) -> Image8:
        components = [component_of(channel) for channel in layer.channels]
        roles = {kind.name: role for role, kind in vars(taken).items() if isinstance(kind, Layer)}
        shown: NDArray[Any]
        if components[:3] == ["R", "G", "B"]:
            is_albedo = roles.get(layer.name) == "albedo"
            light = pixels[..., :3] * np.float32(2**ev if is_albedo else gain)
            shown = (encode_srgb if is_albedo else encode)(light)
        elif len(components) > 1:
            vectors = pixels[..., : 3 if len(components) == 3 else 2]  # the last two of four point to another frame
            low, high = self._range(layer.name, vectors)
            shown = np.full((*pixels.shape[:2], 3), 0.5, np.float32)
            shown[..., : vectors.shape[2]] += vectors / max(2 * max(high, -low), 1e-30)  # gray where all is zero
        else:
            low, high = self._range(layer.name, pixels)
            brightness = 2**ev / max(high - low, 1e-30)  # black for a constant
            shown = np.repeat((pixels - low) * brightness, 3, axis=2)
        return np.round(np.clip(np.nan_to_num(shown), 0, 1) * 255).astype(np.uint8)

    def _range(self, name: str, pixels: NDArray[Any]) -> tuple[float, float]:
        """Black and white level of a layer: the same for all frames, or they would flicker."""
        with self._lock:
            if name not in self._ranges:
                finite = pixels[np.isfinite(pixels)]
                low, high = np.percentile(finite, (0.5, 99.5)) if finite.size else (0.0, 1.0)
                inside = finite.size and finite.min() >= 0 and finite.max() <= 1
                self._ranges[name] = (0.0, 1.0) if inside else (float(low), float(high))
            return self._ranges[name]


def _in_words(made: Mapping[str, str]) -> dict[str, str]:
    """The facts of a header that say how a frame was made, by names that are read."""
    settings, versions = (parse_object(made.get(key)) for key in ("settings", "versions"))
    device, aovs = settings.get("device"), settings.get("aovs")
    facts = {
        "method": settings.get("method"),
        "preset": made.get("preset"),
        "first pass": made.get("first-pass"),
        "passes": None if settings.get("passes") == 1 else settings.get("passes"),
        "light passes": ", ".join(map(str, aovs)) if isinstance(aovs, list) else None,
        "forced stages": made.get("forced"),
        "averaged with": made.get("beside"),
        "computed on": ", ".join(dict.fromkeys(map(str, device.values()))) if isinstance(device, dict) else None,
        "precision": settings.get("precision"),
        "ravg": versions.get("ravg"),
    }
    return {name: str(fact) for name, fact in facts.items() if fact not in (None, "", False)}


def _version(status: os.stat_result) -> str:
    """A text that changes when a file is replaced or written, also with the same size and time."""
    return f"{status.st_mtime_ns:x}-{status.st_size:x}-{status.st_ino:x}-{status.st_ctime_ns:x}"


def _layers(image: ExrImage) -> Layers:
    """The layers by their roles; of files with several views, of the first view."""
    try:
        return find_layers(image)
    except ExrError:
        profile = find_profile(image)
        return find_layers(image, {"color": find_colors(image, profile)[0]}, profile)


def _time_of(name: str) -> tuple[str, int]:
    """View and offset in time of a weight: before2 is -2, the centre 0 (`hybrid.denoising.breakdown.frame_names`)."""
    picture, _, name = name.rpartition(".")
    digits = name.strip("abcdefghijklmnopqrstuvwxyz")
    return picture, (-1 if name.startswith("before") else 1) * int(digits or 0)


def _name(layer: Layer) -> str:
    return layer.name or "RGBA"


def _refuse_large_display(image: ExrImage) -> None:
    """Raise ExrError for a display window that is too large, however few pixels are stored."""
    for part in image.parts:
        width, height = display_size(part)
        if max(width, height) > LARGEST_SIDE or width * height > MAX_PIXELS:
            raise ExrError(
                f"{image.path}: display window of {width}x{height} pixels, expected sides up to {LARGEST_SIDE} and "
                f"{MAX_PIXELS} pixels"
            )


def encode_picture(picture: Image8, suffix: str) -> bytes:
    """Encode an 8-bit image (H, W, 3) for a browser, as "png" (lossless), or "jpg" (small and fast)."""
    settings = {
        "png": [cv2.IMWRITE_PNG_COMPRESSION, 1],
        "jpg": [cv2.IMWRITE_JPEG_QUALITY, 92, cv2.IMWRITE_JPEG_SAMPLING_FACTOR, cv2.IMWRITE_JPEG_SAMPLING_FACTOR_444],
    }
    _, data = cv2.imencode(f".{suffix}", picture[..., ::-1], settings[suffix])
    return data.tobytes()
