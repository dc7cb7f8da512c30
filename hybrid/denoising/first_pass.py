"""First passes: a denoised picture of each single frame, from which windows are made stable over time.

A first pass comes from the file (Cycles keeps the ``Noisy Image`` beside the denoised one), from any finished sequence,
from OIDN where it is installed, or from the classical chain.
"""

import hashlib
import re
from collections.abc import Callable
from dataclasses import dataclass, replace
from functools import partial
from pathlib import Path
from typing import Any, NamedTuple

import cv2
import numpy as np

from hybrid.alignment.align import align
from hybrid.alignment.fireflies import REACH
from hybrid.alignment.noise import FIXED_NOISE_ABOVE
from hybrid.alignment.transfer import BLACK, measure_gain
from hybrid.checks.validation import STRAY, find_lost_light, find_other_frame, find_sequence_grade
from hybrid.denoising.oidn import HOLDS, HOLDS_FAST, denoise_oidn, find_device, why_no_oidn
from hybrid.denoising.pseudo_reference import FINAL, ClassicalPreset, filter_window
from hybrid.denoising.stream import FirstPass, FrameStream
from hybrid.files.frame import Array, Frame
from hybrid.files.shots import Shot, open_matching_sequence, output_path
from hybrid.files.sources import MADE_FROM, describe_sources, sources_in, versions, why_stale
from nlm.average import replace_nonfinite
from nlm.fireflies import Highlights, clamp_halos

GUIDE_RADIUS = 1  # frames on each side that show whether a frame's guides hold noise
# Each frame is denoised in one of eight orientations, by its number: the errors of a network in an image and in the
# image turned differ, and average out over a window. Noise that stands still is not averaged.
ORIENTATIONS = 8
# Pixels on each side of the smallest image that OIDN takes as it is: of an image of one pixel it leaves a twentieth of
# the light, as all around it is black.
LEAST_SIDE = 16

# Quality of each mode of OIDN, and of the filters that its guides go through first.
OIDN_MODES: dict[str, dict[str, Any]] = {
    "oidn": {"quality": "high"},
    "oidn-fast": {"quality": "fast"},
    "oidn-clean": {"quality": "high", "prefilter": "balanced"},
    "oidn-best": {"quality": "high", "prefilter": "high"},
}
# Names of first passes; any other is the pattern of a finished sequence.
SPECS = ("auto", "none", "nlm", "bundled", *OIDN_MODES)
# Presets of networks that ship, the fastest first, and the mode of OIDN that "auto" takes for all networks: with "oidn"
# none gains more than 0.2 dB. With "oidn-clean", whose network is the large one, `fast` gains 0.8 to 1.1 dB and
# `balanced` 0.5 to 0.6; `quality`, which has that network itself, is 0.3 to 0.5 dB better still.
NETWORKS = ("fast", "balanced", "quality")
OIDN_MODE_OF_NETWORKS = "oidn-fast"
# The same of a frame alone, which no average improves: over "oidn-fast" `fast` gains 0.5 dB and `quality` 0.1 (eight
# shots, 8 and 128 samples).
OIDN_MODE_ALONE = "oidn"


@dataclass(frozen=True)
class PerFrame(FirstPass):
    """A first pass that is a function of the frame alone."""

    # from a frame to its denoised radiance (H, W, 3), or None where it has none
    function: Callable[[Frame], Array | None]
    turns: bool = False  # whether the function denoises a frame in its orientation
    reads_frame = True

    def make(self, stream: FrameStream, number: int) -> Array | None:
        prepared = stream.frame(number)
        frame = stream.as_read(number)
        frame = replace(frame, orientation=_orientation(stream, number)) if self.turns else frame
        with stream.timings.stage("estimate"):
            return _checked(self.function(frame), frame, None if prepared is None else prepared.highlights)


@dataclass(frozen=True)
class GuideAware(FirstPass):
    """A first pass by a denoiser whose settings depend on the noise of its guides."""

    # from a frame (number, color, albedo and normal alone, all finite), and whether its guides hold noise, to its
    # denoised radiance (H, W, 3)
    function: Callable[[Frame, bool], Array]

    def reach(self, radius: int) -> int:
        return radius + GUIDE_RADIUS

    def make(self, stream: FrameStream, number: int) -> Array | None:
        prepared = stream.frame(number)
        assert prepared is not None
        noisy = "prefilter" in stream.plan(stream.around(number, GUIDE_RADIUS)).stages
        orientation = _orientation(stream, number)
        frame = Frame(number, prepared.radiance, prepared.albedo, prepared.normal, orientation=orientation)
        with stream.timings.stage("estimate"):
            return _checked(self.function(frame, noisy), frame)


@dataclass(frozen=True)
class Classical(FirstPass):
    """A first pass by the classical chain, from the window of noisy frames around each frame."""

    preset: ClassicalPreset  # the settings of the chain
    from_noisy = True

    def reach(self, radius: int) -> int:
        return 2 * radius

    def make(self, stream: FrameStream, number: int) -> Array:
        window = align(stream.window(number, noisy=True), timings=stream.timings)
        return filter_window(window, self.preset, timings=stream.timings)


class Backends(NamedTuple):
    """Functions that stand for `hybrid.denoising.oidn.denoise_oidn`, with its parameters."""

    torch: Callable[..., Array] | None = None  # runs OIDN's networks on a processor in less time
    bundled: Callable[..., Array] | None = None  # runs a network that ships with ravg, where OIDN is not installed
    # the bytes that either takes on frames of this height and width
    memory: Callable[[tuple[int, int]], int] = lambda _: 0


NO_BACKENDS = Backends()


@dataclass(frozen=True)
class FirstPassSource:
    name: str  # of the source; written to the header of the output
    first_pass: FirstPass | None  # for a `FrameStream`; None for none
    reason: str  # why this one
    files: Shot | None = None  # the finished sequence that it is read from, if it is one
    kept: tuple[Path, ...] = ()  # where its pictures are kept, if they are
    device: str | None = None  # OIDN's device, if OIDN runs


def find_first_pass(
    spec: str,
    shot: Shot,
    *,
    classical: ClassicalPreset = FINAL,
    mode: str = "oidn-clean",
    kept: str | None = None,
    forced: str = "",
    backends: Backends = NO_BACKENDS,
    device: str = "cpu",
) -> FirstPassSource:
    """Find a first pass by its name.

    "auto" is the denoised picture in the file, else `mode` where OIDN is installed, else the bundled network, else the
    classical chain; others are "none", "nlm" (the classical chain on each frame's window), "bundled" (of the quality of
    `mode`), the `OIDN_MODES`, or the pattern of a finished sequence. `kept` is a pattern or a folder that keeps OIDN's
    pictures; those that would be the same, under the same `forced` stages, are read.

    Raises ImportError if OIDN is asked for by name and not installed; FileNotFoundError if there is no such sequence;
    ValueError if a sequence lacks frames or has each in its neighbour's place, `kept` is one file, or OIDN lacks the
    device.
    """
    if spec not in SPECS:
        source = _sequence(spec, shot)
    elif spec == "auto" and shot.layers(shot.numbers[0]).estimate is not None:
        source = FirstPassSource("file", PerFrame(lambda frame: frame.estimate), "the file holds a denoised picture")
    else:
        keep = None if kept is None else partial(_KeptPictures, shot, kept, forced)
        source = named_first_pass(spec, classical=classical, mode=mode, keep=keep, backends=backends, device=device)
    if kept is not None and source.name not in OIDN_MODES:
        return replace(source, reason=f"{source.reason}; nothing of it is kept, as OIDN's pictures would be")
    return source


def named_first_pass(
    spec: str,
    *,
    classical: ClassicalPreset = FINAL,
    mode: str = "oidn-clean",
    keep: Callable[[str, bool, str], "_KeptPictures"] | None = None,
    backends: Backends = NO_BACKENDS,
    device: str = "cpu",
) -> FirstPassSource:
    """Find a first pass that is made of frames alone, as `find_first_pass`; `keep` opens the pictures of a mode."""
    if spec == "none":
        return FirstPassSource("none", None, "asked for")
    if spec in OIDN_MODES or (spec == "auto" and why_no_oidn() is None):
        if spec != "auto" and (lacking := why_no_oidn()) is not None:
            raise ImportError(f'first pass {spec}: {lacking}; expected: pip install "pyoidn"')
        device = find_device(device)
        reason, run = "asked for", partial(_run_oidn, device=device)
        in_torch = spec == "auto" and backends.torch is not None and device == "cpu"
        if spec == "auto":
            why = "its networks run in torch" if in_torch else "OIDN is installed"
            reason = f"no denoised picture in the file; {why}"
        name = mode if spec == "auto" else spec
        store = None if keep is None else keep(name, in_torch, device)
        source = _oidn(name, (backends.torch or run) if in_torch else run, in_torch, store)
        return replace(source, reason=reason, device=device)
    if spec == "bundled" or (spec == "auto" and backends.bundled is not None):
        if backends.bundled is None:
            raise ImportError("first pass bundled: expected another one, as this command runs without torch")
        run = partial(_denoise_turned, denoise=backends.bundled, quality=OIDN_MODES[mode]["quality"])
        reason = "asked for" if spec == "bundled" else f"{why_no_oidn()}; a network comes with ravg"
        return FirstPassSource("bundled", PerFrame(run, turns=True), reason)
    reason = "asked for" if spec == "nlm" else f"no denoised picture in the file, and {why_no_oidn()}"
    return FirstPassSource("nlm", Classical(classical), reason)


def _sequence(spec: str, shot: Shot) -> FirstPassSource:
    """A finished sequence, in the grade of the shot."""
    sequence = open_matching_sequence(spec, shot)
    missing = [number for number in shot.numbers if not sequence.has(number)]
    if missing:
        raise ValueError(f"first pass {spec}: expected frame {missing[0]}, which the shot has, got none")

    def read(number: int) -> Array | None:
        return read_denoised(sequence, number) if sequence.has(number) else None

    other = find_other_frame(shot, read)
    if other is not None:
        raise ValueError(f"first pass {spec}: each picture belongs to {other}, expected those of the shot's own frames")
    grade = find_sequence_grade(shot, read)
    if grade is not None and grade.factors is None:
        raise ValueError(f"first pass {spec}: it {grade.message}, expected pictures of the shot's own light")
    factors = None if grade is None else grade.factors

    def denoised(frame: Frame) -> Array | None:
        # Neighbours outside the requested frames may be missing: these count for nothing.
        picture = read(frame.number)
        return picture if picture is None or factors is None else picture * np.array(factors, np.float32)

    why = "asked for" if grade is None else f"it {grade.message}: brought to that"
    return FirstPassSource("sequence", PerFrame(denoised, files=sequence), why, sequence)


def _oidn(mode: str, denoise: Callable[..., Array], in_torch: bool, store: "_KeptPictures | None") -> FirstPassSource:
    """A mode of OIDN, by this function, with its pictures kept or not."""
    run: Callable[..., Array] = partial(_run_mode, mode, denoise=denoise)
    if store is not None:
        run = partial(store.read_or_run, run=run)
    # Networks in torch work on a strip at a time.
    holds = 0 if in_torch else HOLDS_FAST if mode == "oidn-fast" else HOLDS
    first_pass = GuideAware(run, holds=holds) if mode == "oidn-clean" else PerFrame(run, turns=True, holds=holds)
    return FirstPassSource(mode, first_pass, "", kept=() if store is None else tuple(store.places.values()))


class _KeptPictures:
    """OIDN's pictures on disk, each with a record of its sources.

    `spec` is a pattern or a folder; for one of several views, a folder of its own there. `mode` is a key of
    `OIDN_MODES`; `in_torch` networks are less exact. Raises ValueError if `spec` is one name for several frames,
    neighbours among them, or would overwrite an input.
    """

    def __init__(self, shot: Shot, spec: str, forced: str, mode: str, in_torch: bool, device: str) -> None:
        path = Path(spec)
        if shot.view:
            name = _folder_name(shot.view)
            path = path.with_name(name) / path.name if path.suffix.lower() == ".exr" else path / name
        # Neighbours of the requested frames are kept too.
        self.places = {
            number: output_path(path, shot, number, include_context=True, option="keep-first-pass")
            for number in shot.files
        }
        self._shot = shot
        self._facts = {
            "estimate": mode,
            "orientations": ORIENTATIONS,
            "quicker": in_torch,
            "device": device,
            "forced": forced,
            **versions("pyoidn"),
        }
        # Frames on each side by which fireflies are found, those that show whether guides hold noise, and one whose
        # noise is compared with that of the last.
        self._support = REACH + (GUIDE_RADIUS if mode == "oidn-clean" else 0) + 1

    def read_or_run(self, frame: Frame, *noisy_guides: bool, run: Callable[..., Array]) -> Array:
        """Read a kept picture that would be the same now, else make and keep it; ValueError for another file there."""
        path, shot = self.places[frame.number], self._shot
        files = shot.reader.sources(shot.neighbours(frame.number, self._support))
        layers = shot.reader.layer_summary(frame.number)
        made_from = describe_sources(files, frame=frame.number, layers=layers, **self._facts)
        if why_stale(path, {MADE_FROM: made_from}, whole=False) is not None:
            if path.exists() and "estimate" not in sources_in(path):
                raise ValueError(
                    f"{path} exists and was not written by --keep-first-pass: expected another folder or pattern"
                )
            path.parent.mkdir(parents=True, exist_ok=True)
            shot.write(path, frame.number, {"color": run(frame, *noisy_guides)}, attributes={MADE_FROM: made_from})
        # Also a picture just written is read back, as it may be half: every run then sees the same.
        return shot.reopened({frame.number: path}).read(frame.number).color


def _folder_name(picture: str) -> str:
    """A folder's name for a picture: its own, or where no folder can be called so, one that no other picture has."""
    plain = re.sub(r"[^\w.-]|^\.", "_", picture)
    digest = hashlib.sha256(picture.encode(errors="surrogateescape")).hexdigest()[:8]
    return plain if plain == picture else f"{plain}-{digest}"


def _run_oidn(color: Array, *guides: Array | None, **mode: Any) -> Array:
    """Run OIDN with a factor of ours: its own depends on the unit of dark pictures."""
    return denoise_oidn(color, *guides, scale=measure_gain(color, dark=BLACK), **mode)


def _run_mode(mode: str, frame: Frame, noisy_guides: bool = True, *, denoise: Callable[..., Array]) -> Array:
    """Run a mode of OIDN; guides without noise are declared clean as they are."""
    settings = OIDN_MODES[mode] if noisy_guides else {**OIDN_MODES[mode], "prefilter": None, "clean": True}
    return _denoise_turned(frame, denoise, **settings)


def _orientation(stream: FrameStream, number: int) -> int:
    """The orientation of a frame's number; 0 where its noise is that of a frame beside it, or cannot be compared.

    The errors of frames with equal noise would differ, and flicker.
    """
    if "fireflies" not in stream.rules.allowed:  # neighbours are read for these
        return 0
    beside = [n for n in stream.around(number, 1) if n != number and stream.shot.has(n)]
    held = any(stream.same_noise(*sorted((number, n))) > FIXED_NOISE_ABOVE for n in beside)
    return 0 if held else number % ORIENTATIONS


def _denoise_turned(frame: Frame, denoise: Callable[..., Array], **mode: Any) -> Array:
    """Run OIDN on a frame in its orientation."""
    mirrored, turns = divmod(frame.orientation, 4)

    def turn(image: Array) -> Array:
        return _rotate(np.asarray(cv2.flip(image, 1), np.float32) if mirrored else image, turns)

    albedo, normal = (None if layer is None else turn(layer) for layer in (frame.albedo, frame.normal))
    turned = Frame(frame.number, turn(frame.color), albedo=albedo, normal=normal)
    image = _rotate(denoise_frame_oidn(turned, denoise, **mode), -turns % 4)
    return np.asarray(cv2.flip(image, 1), np.float32) if mirrored else image


def _rotate(image: Array, turns: int) -> Array:
    """An image (H, W, 3) turned counterclockwise by 0 to 3 quarters."""
    codes = cv2.ROTATE_90_COUNTERCLOCKWISE, cv2.ROTATE_180, cv2.ROTATE_90_CLOCKWISE
    return np.asarray(cv2.rotate(image, codes[turns - 1]), np.float32) if turns else image


def _checked(picture: Array | None, frame: Frame, highlights: Highlights | None = None) -> Array | None:
    """A first pass that fits its frame, finite, without highlights that are not in the frame, and their halos."""
    if picture is None:
        return None
    what = f"the first pass of frame {frame.number}"
    if picture.shape != frame.color.shape:
        raise ValueError(f"{what} has shape {picture.shape}, expected {frame.color.shape}")
    filled, lost = replace_nonfinite(picture)
    noisy, bad = replace_nonfinite(frame.color)
    # Pixels that the renderer has lost as well do not count.
    if (count := np.count_nonzero(lost & ~bad)) > STRAY * lost.size:
        raise ValueError(f"{what}: {count} of {lost.size} pixels are not finite, where the frame is")
    filled = np.maximum(filled, 0)
    if highlights is not None:
        filled = clamp_halos(filled, highlights.pixels)
    if fault := find_lost_light(filled, noisy, ~bad):
        raise ValueError(f"{what}: {fault}")
    return filled


def denoise_frame_oidn(frame: Frame, denoise: Callable[..., Array] | None = None, **mode: Any) -> Array:
    """Run OIDN, or its replacement, on a frame made finite, with its guides: (H, W, 3) linear radiance."""
    color = _extended(replace_nonfinite(frame.color)[0])
    if not color.max() > 0:
        return np.zeros_like(frame.color)  # networks leave 1e-4 on black
    layers = (frame.albedo, frame.normal)
    guides = [None if layer is None else _extended(replace_nonfinite(layer)[0]) for layer in layers]
    albedo, normal = guides if guides[0] is not None else (None, None)  # OIDN takes no normal alone
    height, width = frame.color.shape[:2]
    return (denoise or denoise_oidn)(color, albedo, normal, **mode)[:height, :width]


def _extended(image: Array) -> Array:
    """An image of at least `LEAST_SIDE` pixels a side, its last row and column repeated."""
    beyond = [(0, max(0, LEAST_SIDE - side)) for side in image.shape[:2]]
    return np.pad(image, [*beyond, (0, 0)], mode="edge") if min(image.shape[:2]) < LEAST_SIDE else image


def read_denoised(sequence: Shot, number: int) -> Array:
    """Read the denoised picture (H, W, 3) of a frame, linear radiance, wherever its file has it.

    That is the estimate, where the color is the noisy picture beside it; else the color, as in every file that ravg has
    written over it.
    """
    frame = sequence.read(number)
    if frame.estimate is None:
        return frame.color
    layers = sequence.layers(number)
    replaced = layers.target == layers.color and MADE_FROM in sequence.header(number).parts[0].header
    return frame.color if replaced else frame.estimate
