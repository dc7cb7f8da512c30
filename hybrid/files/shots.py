"""Shots: numbered EXR files, read lazily, a window of neighbouring frames at a time."""

from __future__ import annotations  # `help` then shows the names of types, not what they stand for

import math
from collections.abc import Iterable, Mapping, Sequence
from contextlib import suppress
from dataclasses import dataclass, replace
from functools import cached_property
from itertools import pairwise
from pathlib import Path
from typing import NamedTuple, Self

import numpy as np

from hybrid.files.exr import MAX_PIXELS, ExrError, ExrImage, Layer, write_exr
from hybrid.files.frame import Frame
from hybrid.files.layers import Layers, find_colors
from hybrid.files.passes import Passes
from hybrid.files.profile import Profile
from hybrid.files.reader import Interpretation, ShotFiles, ShotHeaders, ShotReader, sizes_differ
from hybrid.files.replace import identities
from hybrid.files.sequences import find_files, format_frames, name_holes, parse_frames, parse_pattern, pattern_of
from hybrid.files.sidecars import SidecarSequence, find_companions, gather_folder, names_sequence, open_sidecar


@dataclass(frozen=True, eq=False)
class Shot:
    """Frames of a sequence of files. Made by `open_shot`.

    Neighbours come from all files, also those outside `numbers`: denoising every second frame, or the last ten, gives
    the same pictures as denoising all of them.

    Attributes
    ----------
    numbers : tuple of int
        The frames that were asked for and exist, ascending.
    step : int
        Distance between neighbouring frames: 1, or 2 where only every second frame was rendered. A renderer's
        motion vectors usually span one frame, whatever the step.
    reader : ShotReader
        Reads and holds frames.
    missing : tuple of int
        The frames that were asked for and do not exist.
    warnings : tuple of str
        One line each.
    view : str
        Name of the color of this view layer or stereo view (`views`); "" for the only one.
    """

    numbers: tuple[int, ...]
    step: int
    reader: ShotReader
    missing: tuple[int, ...] = ()
    warnings: tuple[str, ...] = ()
    view: str = ""

    def __len__(self) -> int:
        return len(self.numbers)

    @property
    def files(self) -> Mapping[int, Path]:
        """Frame number → file, of all files, asked for or not."""
        return self.reader.files.files

    @property
    def available(self) -> tuple[int, ...]:
        """Numbers of all files, asked for or not, ascending."""
        return tuple(sorted(self.files))

    @property
    def aovs(self) -> tuple[str, ...]:
        """Names of the AOVs that are read."""
        return self.reader.files.aovs

    @property
    def passes(self) -> Passes:
        """How the AOVs add up to the beauty."""
        return self.reader.interpretation.passes

    @property
    def max_pixels(self) -> int:
        """The limit of `hybrid.files.exr.read_exr`."""
        return self.reader.files.max_pixels

    @property
    def shape(self) -> tuple[int, int]:
        """Height and width of every frame, from the headers."""
        return self.reader.headers.canvas.shape

    @property
    def profile(self) -> Profile:
        """The renderer's names and conventions."""
        return self.reader.headers.profile

    @property
    def samples(self) -> float | None:
        """Samples per pixel, from the header of the first frame, where its renderer states them."""
        return self.reader.first_layers.samples

    def has(self, number: int) -> bool:
        """Whether this frame has a file, asked for or not."""
        return number in self.files

    def is_input(self, path: Path) -> bool:
        """Whether `path` is one of the shot's files, asked for or not, by any name."""
        return not self.reader.headers.identities.isdisjoint(identities(path))

    def path(self, number: int) -> Path:
        """Return the file of a frame; raise FileNotFoundError if it is missing."""
        return self.reader.files.path(number)

    def paths(self, number: int) -> tuple[Path, ...]:
        """Return the files that a frame is read from, its own first."""
        return self.reader.files.paths(number)

    def neighbours(self, number: int, reach: int) -> list[int]:
        """Return the existing frames up to `reach` steps before and after `number`, which is included."""
        numbers = range(number - reach * self.step, number + reach * self.step + 1, self.step)
        return [n for n in numbers if n in self.files]

    def with_neighbours(self, reach: int) -> Self:
        """Return the shot that also asks for the existing frames up to `reach` steps before and after."""
        numbers = {n for number in self.numbers for n in self.neighbours(number, reach)}
        return replace(self, numbers=tuple(sorted(numbers)))

    def reopened(self, files: Mapping[int, Path], *, aovs: Sequence[str] | None = None) -> Self:
        """Return the same frames, all or some, from files that `write` made: the denoised picture is the color."""
        reader = self.reader
        numbers = tuple(n for n in self.numbers if n in files) or tuple(sorted(files))
        reopened = replace(
            reader.files,
            files=dict(files),
            first=numbers[0],
            layers={**reader.files.layers, "color": reader.first_layers.target},
            profile=self.profile,
            motion=None,
            aovs=reader.files.aovs if aovs is None else tuple(aovs),
            canvas=reader.headers.canvas,  # frames that are cropped differently lie on the same canvas again
        )
        made = ShotReader(ShotHeaders(reopened), reader.interpretation, reader.keep)
        return replace(self, numbers=numbers, reader=made, warnings=())

    def reinterpreted(self, interpretation: Interpretation) -> Self:
        """Return the shot with layers read by `interpretation`, less the roles that are already left out."""
        reader = self.reader
        left_out = reader.interpretation.left_out | interpretation.left_out
        interpretation = replace(interpretation, left_out=left_out)
        return replace(self, reader=ShotReader(reader.headers, interpretation, reader.keep))

    @cached_property
    def views(self) -> tuple[Self, ...]:
        """This shot once for each view layer and stereo view of its files; itself if the color was chosen.

        Raises ExrError if there are several, and sidecars, as which view these belong to is unknown, or a layer that
        two of them would write.
        """
        reader = self.reader
        if "color" in reader.files.layers:
            return (self,)
        image = self.header(reader.files.first)
        colors = find_colors(image, self.profile)
        if len(colors) < 2:
            return (self,)
        if reader.files.sidecars:
            names = ", ".join(map(str, colors))
            raise ExrError(f"{image.path}: {names}, and layers in other files: expected one (--layer color=NAME)")
        views = tuple(self._with_color(color) for color in colors)
        written: set[str] = set()
        for view in views:
            layers = view.layers(reader.files.first)
            own = {c for x in (layers.target, layers.alpha, *layers.aovs.values()) if x is not None for c in x.channels}
            if twice := sorted(own & written):
                names = ", ".join(map(str, colors))
                raise ExrError(f"{image.path}: {names} would all write {twice[0]}, expected one (--layer color=NAME)")
            written |= own
        return views

    def _with_color(self, color: Layer) -> Self:
        reader = self.reader
        files = replace(reader.files, layers={**reader.files.layers, "color": color})
        headers = ShotHeaders(files, reader.headers.sources)
        made = ShotReader(headers, reader.interpretation, reader.keep)
        return replace(self, reader=made, view=color.name or str(color))

    def header(self, number: int) -> ExrImage:
        """Read parts and channels of a frame's file, without pixels."""
        return self.reader.headers.header(number)

    def layers(self, number: int) -> Layers:
        """Return the layers of a frame; raise ExrError if a layer is missing, or is not that of the first frame."""
        return self.reader.layers(number)

    def read(self, number: int) -> Frame:
        """Read a frame, or return it from memory.

        Raises FileNotFoundError if it is missing, ExrError if the file is damaged, or lacks a layer, and ValueError if
        its size is not that of the first frame.
        """
        return self.reader.read(number)

    def write(
        self,
        path: str | Path,
        number: int,
        images: Mapping[str, np.ndarray],
        extra: Mapping[str, np.ndarray] | None = None,
        attributes: Mapping[str, str] | None = None,
        others: Iterable[tuple[Self, Mapping[str, np.ndarray], Mapping[str, np.ndarray]]] = (),
    ) -> int:
        """Write a frame's file again with some layers replaced (`write_exr`); return how many values were clamped.

        `images` maps "color" (`Layers.target`), "alpha" or the name of one of `aovs` to (H, W, C) or (H, W), of the
        size of `Frame.color`; channels beyond C stay as they are. `extra` maps names of layers to add (`own_name`) to
        such images, `attributes` are strings for the header; `others` are other `views` of the same files with their
        `images` and `extra`.
        """
        reader = self.reader
        reader.check_unchanged([number])
        source = reader.headers.open(self.path(number))
        part = source.parts[reader.layers_in(source).color.part]
        replaced: dict[str, np.ndarray] = {}
        added: dict[str, np.ndarray] = {}
        for shot, pictures, layers in ((self, images, extra or {}), *others):
            replaced |= shot.reader.replaced_channels(source, pictures)
            added |= {shot.own_name(name): shot.reader.cut(layer, part) for name, layer in layers.items()}
        return write_exr(path, source, replaced, added, attributes)

    def recompressed_parts(self, others: Iterable[Self] = ()) -> list[str]:
        """Name the parts of the first file that `write`, with `others`, stores with ZIP to keep their layers."""
        first = self.numbers[0]
        image, views = self.header(first), [shot.layers(first) for shot in (self, *others)]
        replaced = [c for found in views for layer in (found.target, *found.aovs.values()) for c in layer.channels]
        return [
            f"{image.parts[index].name or 'files'}: {compression} would change layers that are kept, written with ZIP"
            for index, compression in image.recompressed(replaced).items()
        ]

    def own_name(self, layer: str) -> str:
        """Return the name of a layer that is added for this view: ``ViewLayer.Combined.left.NAME``."""
        return f"{self.view}.{layer}" if self.view else layer


class _Sequence(NamedTuple):
    """The files of a shot, the range named with them, and the profile and sidecars of a folder."""

    files: Mapping[int, Path]
    frames: str | None = None
    profile: Profile | None = None
    sidecars: list[SidecarSequence] | None = None


class _Selection(NamedTuple):
    files: Mapping[int, Path]
    numbers: tuple[int, ...]
    step: int
    missing: tuple[int, ...]
    warnings: list[str]


def open_shot(
    spec: str | Path,
    *,
    frames: str | None = None,
    layers: Mapping[str, str | Layer] | None = None,
    profile: Profile | None = None,
    motion: str | None = None,
    aovs: Sequence[str] = (),
    keep: int = 0,
    max_pixels: int = MAX_PIXELS,
) -> Shot:
    """Find the files of a shot. No pixels are read.

    Parameters
    ----------
    spec : str or Path
        A sequence as `hybrid.files.sequences.find_files` takes it: ``shot.####.exr``, a folder, one file, ….
    frames : str, optional, a range such as ``1001-1010x2``; default: the range in `spec`, or all
    layers : mapping of str to str or Layer, optional
        Role → name of a layer in the files (`hybrid.files.layers.find_layers`), or a sequence that holds it:
        ``path/alb.####.exr``, ``path/alb.####.exr:layer``.
    profile : Profile, optional, names and conventions of the renderer; default: the profile that fits the files
    motion : str, optional
        Convention of motion vectors that the profile does not state (`hybrid.files.profile.Profile.with_motion`);
        "none" ignores them.
    aovs : sequence of str
        Names of layers to read into `Frame.aovs`.
    keep : int, how many frames `Shot.read` holds in memory, to return them again
    max_pixels : int
        Pixels of the largest accepted frame, see `hybrid.files.exr.read_exr`.

    Raises
    ------
    FileNotFoundError
        If nothing matches; names the pattern and the files of the folder.
    ValueError
        If the folder has several sequences, `frames` is not a range, or another argument is not as described.
    """
    if isinstance(aovs, str):
        raise ValueError(f"aovs is {aovs!r}, expected a list of names: [{aovs!r}]")
    if not isinstance(profile, Profile | None):
        raise ValueError(f"profile is {profile!r}, expected a Profile, as hybrid.files.profile.open_profile returns it")
    if not isinstance(keep, int) or keep < 0:
        raise ValueError(f"keep is {keep!r}, expected a number of frames, at least 0")
    layers = dict(layers or {})
    sequences = {role: x for role, x in layers.items() if isinstance(x, str) and names_sequence(x)}
    if "color" in sequences:
        raise ValueError(f"color is {sequences['color']!r}, expected that sequence as the shot, which is written over")
    found = _find_sequence(str(spec))
    if found.sidecars is None:
        found = _Sequence(found.files, found.frames, *find_companions(found.files, {*layers}))
    sidecars = [open_sidecar(role, value) for role, value in sequences.items()]
    sidecars += [other for other in found.sidecars or () if other.role not in layers]
    chosen = _select_frames(found.files, found.frames if frames is None else frames)
    for other in sidecars:
        other.expect(sorted(chosen.files))
    files = ShotFiles(
        chosen.files,
        chosen.numbers[0],
        layers={role: value for role, value in layers.items() if role not in sequences},
        sidecars={other.role: other for other in sidecars},
        profile=profile or found.profile,
        motion=motion,
        aovs=tuple(aovs),
        max_pixels=max_pixels,
    )
    interpretation = Interpretation(left_out=frozenset({"motion"} if motion == "none" else ()))
    reader = ShotReader(ShotHeaders(files), interpretation, keep)
    warnings = (*chosen.warnings, *_warn_of_one_file(spec))
    return Shot(chosen.numbers, chosen.step, reader, chosen.missing, warnings)


def _find_sequence(spec: str) -> _Sequence:
    try:
        return _Sequence(*find_files(spec))
    except (ValueError, FileNotFoundError):
        if not Path(spec).is_dir() or (folder := gather_folder(Path(spec))) is None:
            raise
        files, profile, sidecars = folder
        return _Sequence(files, None, profile, sidecars)


def _select_frames(files: Mapping[int, Path], frames: str | None) -> _Selection:
    """Choose the frames of a range, and leave out files of another size; raise FileNotFoundError if none is left."""
    wanted = sorted(files) if frames is None else parse_frames(frames)
    numbers, warnings = tuple(number for number in wanted if number in files), []
    if not numbers:
        folder = next(iter(files.values())).parent
        raise FileNotFoundError(f"none of the frames {frames} is there; {folder} has {format_frames(files)}")
    if other_sizes := sizes_differ({n: files[n] for n in files.keys() - wanted}, files[numbers[0]]):
        files = {number: path for number, path in files.items() if number not in other_sizes}
        warnings.append(f"frames {format_frames(other_sizes)} differ in size from those asked for: left out")
    # From the files alone, so that a frame is the same in every chunk of a shot.
    step = math.gcd(*(b - a for a, b in pairwise(sorted(files)))) or 1
    missing = tuple(number for number in wanted if number not in files)
    holes = format_frames(missing) if missing else name_holes(files, step) if frames is None else ""
    if holes:
        warnings.append(f"missing frames {holes}: the windows beside them are narrower")
    return _Selection(dict(files), numbers, step, missing, warnings)


def _warn_of_one_file(spec: str | Path) -> list[str]:
    """Warn if one file of a sequence was given, which has no neighbours then."""
    if Path(spec).is_file() and (sequence := pattern_of(Path(spec))).digits:
        with suppress(ValueError):  # no sequence if its numbers are ambiguous
            if len(files := sequence.files()) > 1:
                others = f"{sequence.folder / str(sequence)} {format_frames(files)}"
                return [f"{spec} is taken alone; {others} would take its neighbours too"]
    return []


def open_matching_sequence(spec: str | Path, shot: Shot, *, frames: str | None = None) -> Shot:
    """Open another sequence of the frames of a shot: a reference, or the result of another denoiser.

    The shot's color is chosen if the other's layers leave a choice, as between two view layers. Errors are those of
    `open_shot`.
    """
    opened = open_shot(spec, frames=frames, max_pixels=shot.max_pixels)
    with suppress(ExrError):
        opened.layers(opened.numbers[0])
        return opened
    target = shot.layers(shot.numbers[0]).target
    with suppress(ExrError):
        opened.header(opened.numbers[0]).again(target)
        return open_shot(spec, frames=frames, layers={"color": target}, max_pixels=shot.max_pixels)
    return opened


def output_path(
    pattern: str | Path, shot: Shot, number: int, *, include_context: bool = False, option: str = "output"
) -> Path:
    """Return the file of a frame's result; with `include_context` frames that were not asked for get files too.

    The pattern is ``OUT.####.exr``, ``OUT.%04d.exr``, one file name for a shot of one frame, or a folder (an existing
    one, or any name without ``.exr``), which keeps the input's file names. Raises ValueError, which names the `option`,
    if several frames would get one name, an input file would be overwritten, or a name with a place for the number does
    not end in ``.exr``.
    """
    pattern = str(pattern)
    names, _ = parse_pattern(pattern)
    if names.digits and not names.after.lower().endswith(".exr") and not Path(pattern).is_dir():
        raise ValueError(f"{option} {pattern!r} does not end in .exr, expected {pattern}.exr, or a folder without ####")
    if Path(pattern).is_dir() or names.path(number).suffix.lower() != ".exr":
        path = Path(pattern) / shot.path(number).name
    else:
        count = len(shot.files if include_context else shot)
        if not names.digits and count > 1:
            raise ValueError(f"{option} {pattern!r} names one file for {count} frames, expected OUT.####.exr")
        path = names.path(number)
    # Not only its own input: frames still to come need the noisy neighbours.
    if shot.is_input(path):
        raise ValueError(f"{option} {str(path)!r} would overwrite an input frame")
    return path
