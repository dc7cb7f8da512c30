"""Reading the files of a shot: each header and source once, and a few frames held in memory."""

from collections import OrderedDict
from collections.abc import Iterable, Mapping
from contextlib import suppress
from dataclasses import dataclass, field, replace
from functools import cached_property
from pathlib import Path

import numpy as np

from flow.motion import MotionConvention
from hybrid.files.decode import Window, data_window, decode_frame, decode_layer, display_size, place
from hybrid.files.exr import MAX_PIXELS, ExrError, ExrImage, Layer, Part, read_exr
from hybrid.files.frame import Frame
from hybrid.files.layers import Layers, find_layers, samples_of, summarize_layers
from hybrid.files.passes import NO_PASSES, Passes
from hybrid.files.profile import ROLES, Profile, find_profile
from hybrid.files.replace import identities
from hybrid.files.sequences import format_frames
from hybrid.files.sidecars import SidecarSequence
from hybrid.files.sources import ReadSources, Source


@dataclass(frozen=True)
class Interpretation:
    """How layers are read where that differs from their profile (`hybrid.checks.validation`)."""

    left_out: frozenset[str] = frozenset()  # roles that are not read
    motion: MotionConvention | None = None  # convention of the motion vectors
    variance_scale: float | None = None  # factor of the variance
    passes: Passes = NO_PASSES  # how AOVs add up to the beauty
    estimate_factors: tuple[float, float, float] | None = None  # factors of the denoised picture, by channel

    def apply(self, layers: Layers) -> Layers:
        found = layers.without(self.left_out).without_aovs(self.passes.kept)
        if found.motion is not None and self.motion is not None:
            found = replace(found, motion_convention=self.motion)
        if self.estimate_factors is not None:
            found = replace(found, estimate_factors=self.estimate_factors)
        return found if self.variance_scale is None else replace(found, variance_scale=self.variance_scale)


@dataclass(frozen=True)
class ShotFiles:
    """The files of a shot, and by which names their layers are found."""

    files: Mapping[int, Path]  # frame number → file
    first: int  # the frame that fixes the layers and the size
    layers: Mapping[str, str | Layer] = field(default_factory=dict)  # role → layer that the user names
    sidecars: Mapping[str, SidecarSequence] = field(default_factory=dict)  # role → sequence of its own
    profile: Profile | None = None  # None: the profile that fits the files
    motion: str | None = None  # convention that the user states (`Profile.with_motion`), or "none"
    aovs: tuple[str, ...] = ()  # names of AOVs
    max_pixels: int = MAX_PIXELS  # limit of `read_exr`
    canvas: Window | None = None  # None: the smallest window that holds the color of every frame

    def path(self, number: int) -> Path:
        if number not in self.files:
            raise FileNotFoundError(f"frame {number} is not there; the shot has {format_frames(self.files)}")
        return self.files[number]

    def paths(self, number: int) -> tuple[Path, ...]:
        return (self.path(number), *dict.fromkeys(other.files[number] for other in self.sidecars.values()))


class ShotHeaders:
    """Layers, size and canvas of a shot's files, from their headers."""

    def __init__(self, files: ShotFiles, sources: ReadSources | None = None) -> None:
        self.files = files
        self.sources = ReadSources() if sources is None else sources
        self._layers: dict[Path, Layers] = {}
        self._layers_of_kind: dict[object, Layers] = {}

    def open(self, path: Path, *, pixels: bool = True) -> ExrImage:
        return read_exr(path, pixels=pixels, max_pixels=self.files.max_pixels)

    def header(self, number: int) -> ExrImage:
        return self.open(self.files.path(number), pixels=False)

    def layers_at(self, number: int) -> Layers:
        """Return the layers of a frame; read its header unless its layers are known."""
        path = self.files.path(number)
        return self._layers[path] if path in self._layers else self.layers_in(self.header(number))

    def layers_in(self, image: ExrImage) -> Layers:
        """Return the layers of a file; they are searched once for all files with the same channels and samples."""
        channels = tuple((part.name, part.view, tuple(part.channels)) for part in image.parts)
        kind = channels, samples_of(image, self.profile)
        if kind not in self._layers_of_kind:
            names = self.files
            found = find_layers(image, names.layers, self.profile, names.aovs, self._sidecar_layers)
            self._layers_of_kind[kind] = found
        self._layers[image.path] = self._layers_of_kind[kind]
        return self._layers[image.path]

    @cached_property
    def profile(self) -> Profile:
        """The profile that was asked for, or that fits the first of all files."""
        files = self.files
        chosen = files.profile or find_profile(self.open(files.files[min(files.files)], pixels=False))
        return chosen if files.motion in (None, "none") else chosen.with_motion(files.motion)

    @cached_property
    def size(self) -> tuple[int, int]:
        """Width and height of the first frame's display window."""
        return display_size(self.header(self.files.first).parts[self.layers_at(self.files.first).color.part])

    @cached_property
    def canvas(self) -> Window:
        """The smallest window that holds the color of every frame."""
        if self.files.canvas is not None:
            return self.files.canvas
        windows, size = [], self.size  # raises for layers that no frame has
        for path in self.files.files.values():
            # A file that cannot be read, or is of another size, raises when it is read for its pixels.
            with suppress(ExrError, OSError):
                image = self.open(path, pixels=False)
                part = image.parts[self.layers_in(image).color.part]
                if display_size(part) == size:
                    windows.append(data_window(part))
        lefts, tops, rights, bottoms = zip(*windows, strict=True)
        canvas = Window(min(lefts), min(tops), max(rights), max(bottoms))
        height, width = canvas.shape
        if width * height > self.files.max_pixels:
            raise ExrError(
                f"{self.files.files[min(self.files.files)].parent}: the data windows of all frames lie within "
                f"{width}x{height} pixels, more than the {self.files.max_pixels} accepted"
            )
        return canvas

    @cached_property
    def identities(self) -> frozenset[object]:
        """Identities of all files, sidecars included."""
        numbers = self.files.files
        return frozenset(known for n in numbers for path in self.files.paths(n) for known in identities(path))

    @cached_property
    def _sidecar_layers(self) -> dict[str, Layer]:
        """Role → layer, from the first file of each sidecar."""
        first = min(self.files.files)
        return {
            role: other.find(self.open(other.files[first], pixels=False), self.profile)
            for role, other in self.files.sidecars.items()
        }


class ShotReader:
    """Reads frames; holds at most `keep` of them, so memory does not grow with the shot.

    Renderers may crop each frame to what is not empty, so that data windows differ from frame to frame, and from part
    to part. Frames are read onto one canvas, with 0 where a file has nothing, as OpenEXR defines it.
    """

    def __init__(self, headers: ShotHeaders, interpretation: Interpretation, keep: int) -> None:
        self.headers, self.interpretation, self.keep = headers, interpretation, keep
        self.files = headers.files
        self._frames: OrderedDict[int, Frame] = OrderedDict()

    @cached_property
    def first_layers(self) -> Layers:
        return self.interpretation.apply(self.headers.layers_at(self.files.first))

    def layers(self, number: int) -> Layers:
        """Return the layers of a frame, which must be those of the first frame; a guide may be missing."""
        return self._checked(self.files.path(number), self.headers.layers_at(number))

    def layers_in(self, image: ExrImage) -> Layers:
        """As `layers`, from the file itself."""
        return self._checked(image.path, self.headers.layers_in(image))

    def _checked(self, path: Path, found: Layers) -> Layers:
        layers = self.interpretation.apply(found)
        for role in (*ROLES, "target"):
            here, there = getattr(layers, role), getattr(self.first_layers, role)
            if here is not None and there is not None and here.channels != there.channels:
                raise ExrError(f"{path}: {role} is {here}, that of frame {self.files.first} is {there}")
        return layers

    def layer_summary(self, number: int) -> str:
        """Describe how the layers of a frame are read: if two texts differ, the pictures differ."""
        layers = self.layers(number)
        text = f"{summarize_layers(layers)}; motion {layers.motion_convention}; variance {layers.variance_scale}"
        if layers.estimate_factors is not None:
            text += f"; estimate times {layers.estimate_factors}"
        return f"{text}; {self.interpretation.passes}" if layers.aovs else text

    def sources(self, numbers: Iterable[int], name: str = "frame") -> dict[str, Source]:
        """Return the sources of frames, by ``frame 1001`` and the roles of the layers that a file holds alone."""
        found = {}
        for number in numbers:
            for path in self.files.paths(number):
                # Not by the file's name: sequences in folders of their own have the same names.
                roles = sorted(role for role, other in self.files.sidecars.items() if other.files[number] == path)
                found[" ".join([name, str(number), *roles])] = self.headers.sources.identify(path)
        return found

    def check_unchanged(self, numbers: Iterable[int]) -> None:
        """Raise OSError if a file of these frames has changed since it was read."""
        for number in numbers:
            for path in self.files.paths(number):
                self.headers.sources.check_unchanged(path)

    def open_frame(self, number: int) -> tuple[ExrImage, Layers]:
        """Read the file of a frame; raise ValueError if its size is not that of the first frame."""
        self.sources([number])
        image = self.headers.open(self.files.path(number))
        layers = self.layers_in(image)
        size = display_size(image.parts[layers.color.part])
        if size != self.headers.size:
            first, second = ("x".join(map(str, s)) for s in (self.headers.size, size))
            raise ValueError(f"frames differ in size: frame {self.files.first} is {first}, frame {number} is {second}")
        return image, layers

    def read(self, number: int) -> Frame:
        if number in self._frames:
            self._frames.move_to_end(number)
            return self._frames[number]
        image, layers = self.open_frame(number)
        sidecars = self._open_sidecars(number, layers)
        frame = decode_frame(image, layers, self.headers.canvas, number, sidecars)
        frame = replace(frame, passes=self.interpretation.passes)
        self.check_unchanged([number])
        self._frames[number] = frame
        while len(self._frames) > self.keep:
            self._frames.popitem(last=False)
        return frame

    def read_color(self, number: int) -> np.ndarray:
        """Read the color of a frame alone, in half the time of `read`; not held."""
        image, layers = self.open_frame(number)
        self.check_unchanged([number])
        return decode_layer(image, layers.color, self.headers.canvas)

    def _open_sidecars(self, number: int, layers: Layers) -> dict[str, ExrImage]:
        """Role → file of its own; each file is read once."""
        images: dict[Path, ExrImage] = {}
        found = {}
        for role, other in self.files.sidecars.items():
            layer, path = getattr(layers, role), other.files[number]
            if layer is None:
                continue
            image = images.setdefault(path, images.get(path) or self.headers.open(path))
            if (size := display_size(image.parts[image.again(layer).part])) != self.headers.size:
                first, second = ("x".join(map(str, s)) for s in (self.headers.size, size))
                raise ValueError(f"{path}: {role} is {second}, expected the size of the color, {first}")
            found[role] = image
        return found

    def replaced_channels(self, image: ExrImage, pictures: Mapping[str, np.ndarray]) -> dict[str, np.ndarray]:
        """Return qualified channel → (H, W) for pictures by "color", "alpha" or the name of an AOV."""
        layers = self.layers_in(image)
        places = {**layers.aovs, "color": layers.target, "alpha": layers.alpha}
        replaced: dict[str, np.ndarray] = {}
        for name, picture in pictures.items():
            layer = places.get(name)
            if layer is None:
                raise ValueError(f"{image.path}: nothing was read as {name!r}, expected one of {', '.join(places)}")
            part = image.parts[layer.part]
            cut = self.cut(picture, part)
            if len({*layer.channels}) == 1 and cut.ndim == 3:
                cut = cut.mean(axis=2)  # one channel that was read as red, green and blue
            # Another part may reach beyond the color of all frames: its pixels there were not read, and stay.
            inside = self.cut(np.ones(picture.shape[:2], bool), part)
            planes = [cut] if cut.ndim == 2 else list(np.moveaxis(cut, 2, 0))
            for channel, plane in zip(layer.channels, planes, strict=False):
                replaced[channel] = plane if inside.all() else np.where(inside, plane, image.channel(channel))
        return replaced

    def cut(self, picture: np.ndarray, part: Part) -> np.ndarray:
        """Cut a picture on the canvas to the data window of a part."""
        canvas = self.headers.canvas
        if picture.shape[:2] != canvas.shape:
            raise ValueError(f"image has shape {picture.shape}, expected {canvas.shape} and channels")
        return place(picture, canvas, data_window(part))


def sizes_differ(files: Mapping[int, Path], first: Path) -> list[int]:
    """Return the numbers of files whose display window is not of the size of the first one's; from headers."""
    if not files:
        return []
    expected = _size_of(first)
    sizes = {number: _size_of(path) for number, path in sorted(files.items())}
    return [number for number, size in sizes.items() if None not in (size, expected) and size != expected]


def _size_of(path: Path) -> tuple[int, int] | None:
    """Size of a file's display window; None if it cannot be read, which is an error when its pixels are needed."""
    with suppress(ExrError, OSError):
        return display_size(read_exr(path, pixels=False, max_pixels=2**62).parts[0])  # whatever its size
    return None
