"""Shots: numbered EXR files, read lazily, a window of neighbouring frames at a time."""

from __future__ import annotations

import math
from collections import OrderedDict
from collections.abc import Collection, Iterable, Mapping, Sequence
from contextlib import suppress
from copy import copy
from dataclasses import replace
from functools import cached_property
from itertools import pairwise
from pathlib import Path

import numpy as np

from flow.motion import MotionConvention
from hybrid.files.exr import MAX_PIXELS, ExrError, ExrImage, Layer, Part, read_exr, write_exr
from hybrid.files.frame import Frame
from hybrid.files.layers import Layers, find_colors, find_layers, samples_of, summarize_layers
from hybrid.files.passes import NO_PASSES, Passes
from hybrid.files.profile import ROLES, Profile, find_profile
from hybrid.files.replace import identities
from hybrid.files.sequences import find_files, format_frames, name_holes, parse_frames, parse_pattern, pattern_of
from hybrid.files.sidecars import SidecarSequence, find_companions, gather_folder, names_sequence, open_sidecar
from hybrid.files.sources import Source, identify
from nlm.variance import variance_from_halves

# No light is brighter: the squares of so much, summed over all pixels of the largest frame, still fit float32. One
# pixel of 1e30 made NaN of all frames around it.
LARGEST = 1e14
LIMITED = frozenset({"color", "albedo", "normal", "variance", "half_a", "half_b", "estimate"})


class Shot:
    """The frames of a shot. Made by `open_shot`.

    Attributes
    ----------
    numbers : tuple of int
        The frames that were asked for and are there, ascending.
    step : int
        Distance between neighbouring frames: 1, or 2 where only every second frame was rendered. A renderer's
        motion vectors usually span one frame, whatever the step.
    missing : tuple of int
        The frames that were asked for and are not there.
    warnings : list of str
        One line each.
    view : str
        Which of several `pictures` of the files it is: the name of its color; "" for the only one.

    Notes
    -----
    Neighbours come from all the files there are, also those outside `numbers`: denoising every second frame,
    or the last ten, gives the same pictures as denoising all of them.

    At most `keep` frames are held, so memory does not grow with the shot; a window that slides along it reads
    each file once.

    Renderers may crop each frame to what is not empty, so that data windows differ from frame to frame, and
    from part to part. Frames are therefore read onto the smallest window that holds those of all frames,
    with 0 where a file has nothing, as OpenEXR defines it; `write` cuts them again.
    """

    def __init__(
        self,
        files: Mapping[int, Path],
        *,
        frames: str | None = None,
        layers: Mapping[str, str | Layer] | None = None,
        apart: Iterable[SidecarSequence] = (),
        profile: Profile | None = None,
        motion: str | None = None,
        aovs: Sequence[str] = (),
        keep: int = 2,
        max_pixels: int = MAX_PIXELS,
    ) -> None:
        wanted = sorted(files) if frames is None else parse_frames(frames)
        self.numbers = tuple(number for number in wanted if number in files)
        self.warnings: list[str] = []
        self.view = ""
        if not self.numbers:
            folder = next(iter(files.values())).parent
            raise FileNotFoundError(f"none of the frames {frames} is there; {folder} has {format_frames(files)}")
        if stale := _of_another_size({n: files[n] for n in files.keys() - wanted}, files[self.numbers[0]]):
            files = {number: path for number, path in files.items() if number not in stale}
            self.warnings.append(f"frames {format_frames(stale)} differ in size from those asked for: left out")
        # Of the files alone, or a frame would be another with other frames asked for: as it is in a chunk.
        self.step = math.gcd(*(b - a for a, b in pairwise(sorted(files)))) or 1
        self.missing = tuple(asked := [number for number in wanted if number not in files])
        if missing := format_frames(asked) if asked else name_holes(files, self.step) if frames is None else "":
            self.warnings.append(f"missing frames {missing}: the windows beside them are narrower")
        self._files = dict(files)
        self._overrides = dict(layers or {})
        self._apart = {other.role: other for other in apart}
        for other in self._apart.values():
            other.expect(sorted(files))
        self._profile = profile
        self._motion = motion
        self._left_out: frozenset[str] = frozenset({"motion"} if motion == "none" else ())
        self._convention: MotionConvention | None = None
        self._variance_scale: float | None = None
        self._estimate_factors: tuple[float, float, float] | None = None
        self._aovs = tuple(aovs)
        self.passes = NO_PASSES
        self._keep = keep
        self._max_pixels = max_pixels
        self._held: OrderedDict[int, Frame] = OrderedDict()
        self._states: dict[Path, Source] = {}
        self._known: dict[object, Layers] = {}
        self._kinds: dict[Path, object] = {}

    def __len__(self) -> int:
        return len(self.numbers)

    def has(self, number: int) -> bool:
        """Whether there is a file for this frame, asked for or not."""
        return number in self._files

    @property
    def aovs(self) -> tuple[str, ...]:
        """Names of the further layers that are loaded."""
        return self._aovs

    @property
    def available(self) -> tuple[int, ...]:
        """Numbers of all the files there are, asked for or not, ascending."""
        return tuple(sorted(self._files))

    @property
    def count(self) -> int:
        """How many files there are, asked for or not."""
        return len(self._files)

    @property
    def shape(self) -> tuple[int, int]:
        """Height and width of every frame, from the headers."""
        left, top, right, bottom = self._canvas
        return bottom - top + 1, right - left + 1

    @property
    def files(self) -> Mapping[int, Path]:
        """Frame number → file, of all there are, asked for or not."""
        return self._files

    def reads(self, path: Path) -> bool:
        """Whether this is one of the shot's files, asked for or not, by whatever name."""
        return not self._identities.isdisjoint(identities(path))

    def neighbours(self, number: int, reach: int) -> list[int]:
        """The frames that are there up to `reach` steps before and after one, itself among them."""
        numbers = range(number - reach * self.step, number + reach * self.step + 1, self.step)
        return [n for n in numbers if n in self._files]

    def with_neighbours(self, reach: int) -> Shot:
        """The same shot, asked also for the frames up to `reach` steps before and after, where they are there."""
        wider = copy(self)
        wider.numbers = tuple(sorted({near for number in self.numbers for near in self.neighbours(number, reach)}))
        return wider

    def reopened(self, files: Mapping[int, Path], *, aovs: Sequence[str] | None = None) -> Shot:
        """The same frames from files that `write` has made of these: the denoised picture is now the color.

        Parameters
        ----------
        files : mapping of int to Path
            Those of the frames that are made, all or some.
        aovs : sequence of str, optional
            Names of further layers to load; those of this shot without.
        """
        made = Shot(
            files,
            layers={**self._overrides, "color": self._first_layers.target},
            apart=self._apart.values(),
            profile=self.profile,
            aovs=self._aovs if aovs is None else aovs,
            keep=self._keep,
            max_pixels=self._max_pixels,
        )
        made.missing, made.view = self.missing, self.view
        made.numbers, made.step = tuple(n for n in self.numbers if n in files) or made.numbers, self.step
        made._canvas = self._canvas  # frames that are cropped differently lie on the same one again
        taken = self._left_out, self._convention, self._variance_scale
        return made.reinterpreted(*taken, self.passes, self._estimate_factors)

    def reinterpreted(
        self,
        left_out: Collection[str],
        convention: MotionConvention | None,
        variance_scale: float | None,
        passes: Passes | None = None,
        estimate_factors: tuple[float, float, float] | None = None,
    ) -> Shot:
        """The same shot, read otherwise than its files and their profile say (`hybrid.validation`).

        Parameters
        ----------
        left_out : collection of str
            Roles of layers that are not read.
        convention : MotionConvention, optional
            What the motion vectors mean; None: as the profile says.
        variance_scale : float, optional
            What the variance is multiplied by; None: as the profile says.
        passes : Passes, optional
            What the further layers are to the picture; None: nothing is known of them.
        estimate_factors : (float, float, float), optional
            What the denoised picture is multiplied by, channel by channel; None: nothing.
        """
        other = copy(self)
        other._held = OrderedDict()
        other.__dict__.pop("_first_layers", None)
        other._left_out = self._left_out | set(left_out)
        other._convention, other._variance_scale = convention, variance_scale
        other.passes = NO_PASSES if passes is None else passes
        other._estimate_factors = estimate_factors
        return other

    def path(self, number: int) -> Path:
        """The file of a frame.

        Raises
        ------
        FileNotFoundError
            If there is none.
        """
        if number not in self._files:
            raise FileNotFoundError(f"frame {number} is not there; the shot has {format_frames(self._files)}")
        return self._files[number]

    def sources(self, numbers: Iterable[int], what: str = "frame") -> dict[str, Source]:
        """The files of some frames as they were when they were read, or if they have not been yet, as they are now.

        Parameters
        ----------
        numbers : iterable of int
            Frame numbers.
        what : str
            What to call them: ``frame 1001``, with the roles of the layers that a file holds alone.
        """
        found = {}
        for number in numbers:
            for path in self.paths(number):
                if path not in self._states:
                    self._states[path] = identify(path)
                # Not by the file's name: sequences in folders of their own have the same names.
                roles = sorted(role for role, other in self._apart.items() if other.files[number] == path)
                found[" ".join([what, str(number), *roles])] = self._states[path]
        return found

    def check_unchanged(self, numbers: Iterable[int]) -> None:
        """Refuse to go on where a file is another than the one that was read.

        Raises
        ------
        OSError
            If one of them has been written again since, or is gone.
        """
        for path in (path for number in numbers for path in self.paths(number)):
            if (state := self._states.get(path)) is None:
                continue
            status = path.stat()
            now = status.st_size, round(status.st_mtime_ns / 1e9, 3), status.st_ino
            if now != (state.size, state.modified, state.inode):
                raise OSError(f"{path} has changed since it was read; --resume makes again what was made from it")

    def source(self, number: int) -> ExrImage:
        """Everything in the file of a frame; not kept."""
        return self._read(self.path(number))

    def layers(self, number: int) -> Layers:
        """Which channels of a frame's file are taken for what; reads the header only, if it has not been read yet.

        Raises
        ------
        ExrError
            If the file cannot be read, lacks a layer, or has another one where the first frame has its own.
        """
        path = self.path(number)
        kind = self._kinds.get(path)
        return self._find(self.header(number)) if kind not in self._known else self._like_first(path, self._known[kind])

    def layer_summary(self, number: int) -> str:
        """What is taken for what of a frame, and how it is read, in words: where these differ, so does the picture."""
        layers = self.layers(number)
        said = f"{summarize_layers(layers)}; motion {layers.motion_convention}; variance {layers.variance_scale}"
        if layers.estimate_factors is not None:
            said += f"; estimate times {layers.estimate_factors}"
        return f"{said}; {self.passes}" if layers.aovs else said

    @cached_property
    def profile(self) -> Profile:
        """Whose names and conventions are taken: the one asked for, or that which fits the first of all files."""
        taken = self._profile or find_profile(self._read(self._files[min(self._files)], pixels=False))
        return taken if self._motion in (None, "none") else taken.with_motion(self._motion)

    def _find(self, image: ExrImage) -> Layers:
        """The layers of a file, which must be those of the first frame; a guide may be missing."""
        return self._like_first(image.path, self._known[self._kind(image)])

    def _like_first(self, path: Path, found: Layers) -> Layers:
        layers, first = self._as_judged(found), self._first_layers
        for role in (*ROLES, "target"):
            here, there = getattr(layers, role), getattr(first, role)
            if here is not None and there is not None and here.channels != there.channels:
                raise ExrError(f"{path}: {role} is {here}, that of frame {self.numbers[0]} is {there}")
        return layers

    def _find_alone(self, image: ExrImage) -> Layers:
        return self._as_judged(self._known[self._kind(image)])

    def _kind(self, image: ExrImage) -> object:
        """What a file has, by which its layers are known: found once, not with every header that is read."""
        channels = tuple((part.name, part.view, tuple(part.channels)) for part in image.parts)
        kind = channels, samples_of(image, self.profile)
        if kind not in self._known:
            self._known[kind] = find_layers(image, self._overrides, self.profile, self._aovs, self._elsewhere)
        self._kinds[image.path] = kind
        return kind

    def _as_judged(self, layers: Layers) -> Layers:
        found = layers.without(self._left_out).without_aovs(self.passes.kept)
        if found.motion is not None and self._convention is not None:
            found = replace(found, motion_convention=self._convention)
        if self._estimate_factors is not None:
            found = replace(found, estimate_factors=self._estimate_factors)
        return found if self._variance_scale is None else replace(found, variance_scale=self._variance_scale)

    @cached_property
    def _elsewhere(self) -> dict[str, Layer]:
        """The layers that lie in sequences of their own, as their first files have them."""
        return {
            role: other.find(self._read(other.files[min(self._files)], pixels=False), self.profile)
            for role, other in self._apart.items()
        }

    @cached_property
    def views(self) -> tuple[Shot, ...]:
        """This shot, once for each view layer and stereo view in its files; as it is where the color was chosen.

        Raises
        ------
        ExrError
            If there are several, and layers that lie in other files: whose they are is not known.
        """
        if "color" in self._overrides:
            return (self,)
        image = self.header(self.numbers[0])
        colors = find_colors(image, self.profile)
        if len(colors) < 2:
            return (self,)
        if self._apart:
            names = ", ".join(map(str, colors))
            raise ExrError(f"{image.path}: {names}, and layers in other files: expected one (--layer color=NAME)")
        return tuple(self._picture(color) for color in colors)

    def _picture(self, color: Layer) -> Shot:
        other = copy(self)
        for name in ("_first_layers", "_size", "_canvas", "views"):
            other.__dict__.pop(name, None)
        other._held, other._known = OrderedDict(), {}
        other._overrides = {**self._overrides, "color": color}
        other.view = color.name or str(color)
        return other

    def paths(self, number: int) -> tuple[Path, ...]:
        """The files that a frame is read from, its own first."""
        return (self.path(number), *dict.fromkeys(other.files[number] for other in self._apart.values()))

    @cached_property
    def _first_layers(self) -> Layers:
        """Those of the first frame that was asked for."""
        return self._find_alone(self.header(self.numbers[0]))

    def header(self, number: int) -> ExrImage:
        """Parts and channels of a frame's file, without pixels."""
        return self._read(self.path(number), pixels=False)

    def read(self, number: int) -> Frame:
        """A frame, from memory if it was read lately.

        Raises
        ------
        FileNotFoundError
            If it is not there.
        ExrError
            If the file is damaged, or lacks a layer.
        ValueError
            If its size is not that of the first frame.
        """
        if number in self._held:
            self._held.move_to_end(number)
            return self._held[number]
        image, layers = self._open(number)
        frame = replace(
            _frame(image, layers, self._canvas, number, self._open_apart(number, layers)), passes=self.passes
        )
        self.check_unchanged([number])
        self._held[number] = frame
        while len(self._held) > self._keep:
            self._held.popitem(last=False)
        return frame

    def read_color(self, number: int) -> np.ndarray:
        """The color alone of a frame, as `read` gives it, in half its time; not kept."""
        image, layers = self._open(number)
        self.check_unchanged([number])
        return _pixels(image, layers.color, self._canvas)

    def write(
        self,
        path: str | Path,
        number: int,
        images: Mapping[str, np.ndarray],
        extra: Mapping[str, np.ndarray] | None = None,
        attributes: Mapping[str, str] | None = None,
        others: Iterable[tuple[Shot, Mapping[str, np.ndarray], Mapping[str, np.ndarray]]] = (),
    ) -> int:
        """Write a frame's file again with some layers replaced (`hybrid.files.exr.write_exr`).

        Parameters
        ----------
        path : str or Path
            The file to write.
        number : int
            Frame number.
        images : mapping of str to array
            "color", "alpha" or the name of one of `aovs` → (H, W, C) or (H, W), of the size of `Frame.color`.
            "color" goes where the denoised picture belongs (`Layers.target`). Channels beyond C stay as they are.
        extra : mapping of str to array, optional
            Layers to add; name → (H, W, C) or (H, W), of the same size. Of one of several `pictures` they are named
            after it: ``ViewLayer.Combined.left.NAME``.
        attributes : mapping of str to str, optional
            Strings for the header.
        others : iterable of (Shot, mapping of str to array, mapping of str to array)
            Further `pictures` of the same files, what replaces layers of theirs, and what is added.

        Returns
        -------
        int
            How many values were too large for a half channel.
        """
        self.check_unchanged([number])
        source = self.source(number)
        home = source.parts[self._find(source).color.part]
        replaced: dict[str, np.ndarray] = {}
        added: dict[str, np.ndarray] = {}
        for picture, theirs, new in ((self, images, extra or {}), *others):
            replaced |= picture._replace(source, theirs)
            added |= {picture.own_name(name): picture._cut(image, home) for name, image in new.items()}
        return write_exr(path, source, replaced, added, attributes)

    def recompressed_parts(self, others: Iterable[Shot] = ()) -> list[str]:
        """Say of each part of the first file that `write` compresses otherwise, as its layers are kept to the bit.

        Parameters
        ----------
        others : iterable of Shot
            Further `pictures` of the same files that are written.
        """
        image = self.header(self.numbers[0])
        taken = [picture.layers(self.numbers[0]) for picture in (self, *others)]
        replaced = [channel for x in taken for layer in (x.target, *x.aovs.values()) for channel in layer.channels]
        return [
            f"{image.parts[index].name or 'files'}: {compression} would change layers that are kept, written with ZIP"
            for index, compression in image.recompressed(replaced).items()
        ]

    def own_name(self, layer: str) -> str:
        """What a layer is called that is added to the files for this picture."""
        return f"{self.view}.{layer}" if self.view else layer

    def _replace(self, source: ExrImage, images: Mapping[str, np.ndarray]) -> dict[str, np.ndarray]:
        """The channels of a file that pictures by role or AOV take the place of."""
        layers = self._find(source)
        places = {**layers.aovs, "color": layers.target, "alpha": layers.alpha}
        replaced: dict[str, np.ndarray] = {}
        for name, image in images.items():
            layer = places.get(name)
            if layer is None:
                raise ValueError(f"{source.path}: nothing was read as {name!r}, expected one of {', '.join(places)}")
            part = source.parts[layer.part]
            cut = self._cut(image, part)
            if len({*layer.channels}) == 1 and cut.ndim == 3:
                cut = cut.mean(axis=2)  # one channel that was read as red, green and blue
            # Another part may reach beyond the color of all frames; what is there was not read, and stays.
            inside = self._cut(np.ones(image.shape[:2], bool), part)
            planes = [cut] if cut.ndim == 2 else list(np.moveaxis(cut, 2, 0))
            for channel, plane in zip(layer.channels, planes, strict=False):
                replaced[channel] = plane if inside.all() else np.where(inside, plane, source.channel(channel))
        return replaced

    def _cut(self, image: np.ndarray, part: Part) -> np.ndarray:
        """What lies on the data window of a part, of an image on the shot's."""
        (left, top, right, bottom), (x, y, _, _) = self._canvas, _data_window(part)
        if image.shape[:2] != (bottom - top + 1, right - left + 1):
            raise ValueError(
                f"image has shape {image.shape}, expected {(bottom - top + 1, right - left + 1)} and channels"
            )
        return _placed(image, (left - x, top - y), part.shape)

    def _open(self, number: int) -> tuple[ExrImage, Layers]:
        """The file of a frame, and what is taken for what; refuses one of another size than the first frame's."""
        self.sources([number])
        image = self.source(number)
        layers = self._find(image)
        size = _size(image.parts[layers.color.part])
        if size != self._size:
            first, second = ("x".join(map(str, s)) for s in (self._size, size))
            raise ValueError(f"frames differ in size: frame {self.numbers[0]} is {first}, frame {number} is {second}")
        return image, layers

    def _open_apart(self, number: int, layers: Layers) -> dict[str, ExrImage]:
        """The files of the layers that lie in sequences of their own, by role; each is read once."""
        images: dict[Path, ExrImage] = {}
        found = {}
        for role, other in self._apart.items():
            layer, path = getattr(layers, role), other.files[number]
            if layer is None:
                continue
            image = images.setdefault(path, images.get(path) or self._read(path))
            if (size := _size(image.parts[image.again(layer).part])) != self._size:
                first, second = ("x".join(map(str, s)) for s in (self._size, size))
                raise ValueError(f"{path}: {role} is {second}, expected the size of the color, {first}")
            found[role] = image
        return found

    def _read(self, path: Path, *, pixels: bool = True) -> ExrImage:
        return read_exr(path, pixels=pixels, max_pixels=self._max_pixels)

    @cached_property
    def _identities(self) -> frozenset[object]:
        return frozenset(known for n in self._files for file in self.paths(n) for known in identities(file))

    @cached_property
    def _size(self) -> tuple[int, int]:
        """Width and height of the first frame's display window."""
        return _size(self.header(self.numbers[0]).parts[self._first_layers.color.part])

    @cached_property
    def _canvas(self) -> tuple[int, int, int, int]:
        """The window, relative to the display window, that holds the color of every frame; from headers."""
        boxes, size = [], self._size
        for path in self._files.values():
            # A file that cannot be read, or is of another size, is an error when its turn comes, not now.
            with suppress(ExrError, OSError):
                image = self._read(path, pixels=False)
                home = image.parts[self._find(image).color.part]
                if _size(home) == size:
                    boxes.append(_data_window(home))
        lefts, tops, rights, bottoms = zip(*boxes, strict=True)
        left, top, right, bottom = min(lefts), min(tops), max(rights), max(bottoms)
        width, height = right - left + 1, bottom - top + 1
        if width * height > self._max_pixels:
            raise ExrError(
                f"{self._files[min(self._files)].parent}: the data windows of all frames lie within {width}x{height} "
                f"pixels, more than the {self._max_pixels} accepted"
            )
        return left, top, right, bottom


def open_shot(
    spec: str | Path,
    *,
    frames: str | None = None,
    layers: Mapping[str, str | Layer] | None = None,
    profile: Profile | None = None,
    motion: str | None = None,
    aovs: Sequence[str] = (),
    keep: int = 2,
    max_pixels: int = MAX_PIXELS,
) -> Shot:
    """Find the files of a shot. None is opened yet.

    Parameters
    ----------
    spec : str or Path
        A sequence as `hybrid.files.sequences.find_files` takes it: ``shot.####.exr``, a folder, one file, ….
    frames : str, optional
        A range such as ``1001-1010x2``; else the one that `spec` names, or all.
    layers : mapping of str to str or Layer, optional
        Role → name of a layer in the files (`hybrid.files.layers.find_layers`), or a sequence that holds it:
        ``path/alb.####.exr``, ``path/alb.####.exr:layer``.
    profile : Profile, optional
        Whose names and conventions to take; without, the one that fits the files.
    motion : str, optional
        What vectors mean, where the profile does not say so or is wrong (`hybrid.files.profile.Profile.with_motion`);
        "none": they are not used.
    aovs : sequence of str
        Names of further layers to load into `Frame.aovs`.
    keep : int
        How many frames to hold in memory; whoever aligns windows keeps what is made of a frame.
    max_pixels : int
        Of the largest frame that is read, see `hybrid.files.exr.read_exr`.

    Raises
    ------
    FileNotFoundError
        If nothing matches; names the pattern and what the folder has.
    ValueError
        If the folder has several sequences, or `frames` is not a range.
    """
    said = {role: value for role, value in (layers or {}).items() if isinstance(value, str) and names_sequence(value)}
    if "color" in said:
        raise ValueError(f"color is {said['color']!r}, expected that sequence as the shot, over whose files is written")
    files, named, beside = _gather(str(spec))
    known, companions = beside or find_companions(files, {*(layers or {})})
    own = [open_sidecar(role, value) for role, value in said.items()]
    apart = [other for other in companions if other.role not in {*(layers or {})}]
    shot = Shot(
        files,
        frames=named if frames is None else frames,
        layers={role: value for role, value in (layers or {}).items() if role not in said},
        apart=[*own, *apart],
        profile=profile or known,
        motion=motion,
        aovs=aovs,
        keep=keep,
        max_pixels=max_pixels,
    )
    if Path(spec).is_file() and (sequence := pattern_of(Path(spec))).digits:
        with suppress(ValueError):  # whose numbers are ambiguous is no sequence
            if len(there := sequence.files()) > 1:
                others = f"{sequence.folder / str(sequence)} {format_frames(there)}"
                shot.warnings.append(f"{spec} is taken alone; {others} would take its neighbours too")
    return shot


def _gather(spec: str) -> tuple[dict[int, Path], str | None, tuple[Profile, list[SidecarSequence]] | None]:
    """The files of the color, the range named with them, and the sequences that a folder has for other layers."""
    try:
        return *find_files(spec), None
    except (ValueError, FileNotFoundError):
        gathered = gather_folder(Path(spec)) if Path(spec).is_dir() else None
        if gathered is None:
            raise
        files, profile, apart = gathered
        return files, None, (profile, apart)


def open_matching_sequence(spec: str | Path, shot: Shot, *, frames: str | None = None) -> Shot:
    """Open another sequence of the frames of a shot: a reference, or what another denoiser has made.

    Errors are those of `open_shot`.

    Parameters
    ----------
    spec : str or Path
        As for `open_shot`.
    shot : Shot
        Where the other's own layers leave a choice, as between two view layers, the choice made for this one holds.
    frames : str, optional
        As for `open_shot`.

    Returns
    -------
    Shot
    """
    opened = open_shot(spec, frames=frames, keep=0)
    with suppress(ExrError):
        opened.layers(opened.numbers[0])
        return opened
    target = shot.layers(shot.numbers[0]).target
    with suppress(ExrError):
        opened.header(opened.numbers[0]).again(target)
        return open_shot(spec, frames=frames, layers={"color": target}, keep=0)
    return opened


def output_path(pattern: str | Path, shot: Shot, number: int, *, include_context: bool = False) -> Path:
    """Where the result for a frame goes.

    Parameters
    ----------
    pattern : str or Path
        ``OUT.####.exr``, ``OUT.%04d.exr``, one file name for a shot of one frame, or a folder (one that is
        there, or any name without ``.exr``), which keeps the input's file names.
    shot : Shot
        The shot.
    number : int
        Frame number.
    include_context : bool
        Frames that were not asked for get files too.

    Raises
    ------
    ValueError
        If several frames would get one name, an input file would be overwritten, or a name with a place for the number
        does not end in ``.exr``.
    """
    pattern = str(pattern)
    names, _ = parse_pattern(pattern)
    if names.digits and not names.after.lower().endswith(".exr") and not Path(pattern).is_dir():
        raise ValueError(f"output {pattern!r} does not end in .exr, expected {pattern}.exr, or a folder without ####")
    if Path(pattern).is_dir() or names.path(number).suffix.lower() != ".exr":
        path = Path(pattern) / shot.path(number).name
    else:
        count = shot.count if include_context else len(shot)
        if not names.digits and count > 1:
            raise ValueError(f"output {pattern!r} names one file for {count} frames, expected OUT.####.exr")
        path = names.path(number)
    # Not only its own input: frames still to come need the noisy neighbours.
    if shot.reads(path):
        raise ValueError(f"output {str(path)!r} would overwrite an input frame")
    return path


def _of_another_size(files: Mapping[int, Path], first: Path) -> list[int]:
    """The numbers of the files whose display window is not of the size of the first one's; from headers."""
    if not files:
        return []
    expected = _size_of(first)
    sizes = {number: _size_of(path) for number, path in sorted(files.items())}
    return [number for number, size in sizes.items() if None not in (size, expected) and size != expected]


def _size_of(path: Path) -> tuple[int, int] | None:
    """The size of a file's display window; None where it cannot be read, which is an error when its turn comes."""
    with suppress(ExrError, OSError):
        return _size(read_exr(path, pixels=False, max_pixels=2**62).parts[0])  # whatever its size
    return None


def _size(part: Part) -> tuple[int, int]:
    """Width and height of the display window."""
    left, top, right, bottom = part.display_window
    return right - left + 1, bottom - top + 1


def _data_window(part: Part) -> tuple[int, int, int, int]:
    """The data window relative to the display window's first pixel."""
    x, y = part.display_window[:2]
    left, top, right, bottom = part.data_window
    return left - x, top - y, right - x, bottom - y


def _frame(
    image: ExrImage,
    layers: Layers,
    canvas: tuple[int, int, int, int],
    number: int,
    others: Mapping[str, ExrImage],
) -> Frame:
    """A frame from its own file, and from `others` that hold the layer of a role."""
    for name, layer in layers.aovs.items():
        if any(image.channel(channel).dtype == np.uint32 for channel in layer.channels):
            raise ExrError(f"{image.path}: aov {name!r} is {layer}, whole numbers, of which averages mean nothing")
    taken = {
        role: _pixels(others.get(role, image), layer, canvas)
        for role in ROLES
        if (layer := getattr(layers, role)) is not None
    }
    for role in {"depth", "alpha"} & taken.keys():
        taken[role] = np.ascontiguousarray(taken[role][..., 0])
    if "variance" in taken and taken["variance"].shape[2] == 1:
        taken["variance"] = np.repeat(taken["variance"], 3, axis=2)
    if "variance" in taken and layers.variance_scale not in (None, 1):
        taken["variance"] = taken["variance"] * np.float32(layers.variance_scale)
    if "estimate" in taken and layers.estimate_factors is not None:
        taken["estimate"] = taken["estimate"] * np.array(layers.estimate_factors, np.float32)
    following = taken.pop("motion_next", None)
    if following is not None and layers.motion_convention is not None:
        one = layers.motion_convention.channels // 2
        taken["motion"] = np.concatenate([taken["motion"][..., :one], following[..., :one]], axis=-1)
    convention = layers.motion_convention
    if convention is not None and convention.premultiplied:
        convention = replace(convention, premultiplied=False)
        if (alpha := taken.get("alpha")) is not None:
            np.divide(taken["motion"], alpha[..., None], out=taken["motion"], where=alpha[..., None] > 0)
    # Of float32 it is the result of a division, and as lost as NaN.
    half = all(image.channel(channel).dtype == np.float16 for channel in layers.color.channels)
    beyond = taken["color"] == np.inf if half else None
    for role in LIMITED & taken.keys():
        taken[role] = _limited(taken[role], LARGEST**2 if role == "variance" else LARGEST)
    halves = taken.pop("half_a", None), taken.pop("half_b", None)
    if "variance" not in taken and halves[0] is not None and halves[1] is not None:
        taken["variance"] = variance_from_halves(halves[0], halves[1])
    return Frame(
        number=number,
        **taken,  # type: ignore[arg-type]
        motion_convention=convention,
        resolution=_size(image.parts[layers.color.part])[::-1],
        aovs={name: _pixels(image, layer, canvas) for name, layer in layers.aovs.items()},
        pass_colors={name: _pixels(image, layer, canvas) for name, layer in layers.pass_colors.items()},
        source=image.path,
        beyond=None if beyond is None or not beyond.any() else beyond,
    )


def _limited(layer: np.ndarray, largest: float) -> np.ndarray:
    """A layer whose values beyond these bounds are NaN, as lost as those that are not finite."""
    beyond = (layer > largest) | (layer < -largest)
    return np.where(beyond, np.float32(np.nan), layer) if beyond.any() else layer


def _pixels(image: ExrImage, layer: Layer, canvas: tuple[int, int, int, int]) -> np.ndarray:
    """A layer on the window of the shot, (H, W, C)."""
    left, top, right, bottom = canvas
    x, y = _data_window(image.parts[layer.part])[:2]
    size = bottom - top + 1, right - left + 1
    return _placed(image.pixels(layer.channels), (x - left, y - top), size)


def _placed(array: np.ndarray, shift: tuple[int, int], size: tuple[int, int]) -> np.ndarray:
    """`array` moved right and down by `shift`, cut or filled with 0 to `size` (H, W)."""
    if shift == (0, 0) and array.shape[:2] == size:
        return array
    out = np.zeros((*size, *array.shape[2:]), array.dtype)
    x, y = shift
    top, bottom = max(0, y), min(size[0], y + array.shape[0])
    left, right = max(0, x), min(size[1], x + array.shape[1])
    if top < bottom and left < right:
        out[top:bottom, left:right] = array[top - y : bottom - y, left - x : right - x]
    return out
