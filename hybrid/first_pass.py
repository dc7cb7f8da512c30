"""Per-frame estimates: pictures that are denoised already, each by itself, which time makes stable.

An estimate comes from the file (Cycles keeps the ``Noisy Image`` beside what it has denoised), from any finished
sequence, from OIDN where it is installed, or from our own pseudo-reference.
"""

from __future__ import annotations

import hashlib
import re
from collections.abc import Callable
from dataclasses import dataclass, replace
from functools import partial
from pathlib import Path
from typing import Any

import numpy as np
from numpy.typing import NDArray

from hybrid.alignment.align import align
from hybrid.alignment.fireflies import REACH
from hybrid.files.frame import Frame
from hybrid.files.shots import Shot, open_matching_sequence, output_path
from hybrid.files.sources import MADE_FROM, describe_sources, sources_in, versions, why_stale
from hybrid.oidn import HOLDS, HOLDS_FAST, denoise_oidn, find_device, why_no_oidn
from hybrid.pseudo_reference import FINAL, ClassicalPreset, filter_window
from hybrid.stream import FirstPass, FrameStream
from hybrid.validation import LOST, find_lost_light, find_other_frame, find_sequence_grade
from nlm.average import replace_nonfinite
from nlm.fireflies import Highlights, clamp_halos

Array = NDArray[np.float32]

# Frames on each side that tell whether a frame's guides hold noise.
GUIDE_RADIUS = 1

# Quality of each mode of OIDN, and of the filters that its guides go through first.
OIDN_MODES: dict[str, dict[str, Any]] = {
    "oidn": {"quality": "high"},
    "oidn-fast": {"quality": "fast"},
    "oidn-clean": {"quality": "high", "prefilter": "balanced"},
    "oidn-best": {"quality": "high", "prefilter": "high"},
}
# What is asked for by these names; by any other, a finished sequence.
SPECS = ("auto", "none", "nlm", "bundled", *OIDN_MODES)
# What "auto" takes of them for a preset of the network, which looks at the samples again: what the first look is
# matters little. With "oidn" `fast`, which keeps half of it, gains 0.2 dB, and 0.2 in time, on eight validation shots,
# and takes 1.49 to 1.56 times OIDN's high mode where 1.5 is the bound; the two others gain next to nothing.
OIDN_MODE_OF_PRESET = {"fast": "oidn-fast", "balanced": "oidn-fast", "quality": "oidn-fast"}


@dataclass(frozen=True)
class PerFrame:
    """A first pass that is a function of the frame alone.

    Attributes
    ----------
    function : callable
        From a frame to its denoised radiance (H, W, 3), or None where it has none.
    holds : int
        Bytes that it takes for itself.
    files : Shot or None
        The finished sequence that it reads, if it does.
    """

    function: Callable[[Frame], Array | None]
    holds: int = 0
    files: Shot | None = None
    from_noisy = False
    reads_frame = True

    def reach(self, radius: int) -> int:
        """See `hybrid.stream.FirstPass`."""
        return radius

    def make(self, stream: FrameStream, number: int) -> Array | None:
        """See `hybrid.stream.FirstPass`."""
        frame, prepared = stream.as_read(number), stream.frame(number)
        with stream.timings.stage("estimate"):
            return _checked(self.function(frame), frame, None if prepared is None else prepared.highlights)


@dataclass(frozen=True)
class GuideAware:
    """A first pass by a denoiser whose settings depend on the noise of its guides.

    Attributes
    ----------
    function : callable
        From a frame (number, color, albedo and normal alone, all finite), and whether its guides hold noise, to its
        denoised radiance (H, W, 3).
    holds : int
        Bytes that it takes for itself.
    """

    function: Callable[[Frame, bool], Array]
    holds: int = 0
    files = None
    from_noisy = False
    reads_frame = False

    def reach(self, radius: int) -> int:
        """See `hybrid.stream.FirstPass`."""
        return radius + GUIDE_RADIUS

    def make(self, stream: FrameStream, number: int) -> Array | None:
        """See `hybrid.stream.FirstPass`."""
        prepared = stream.frame(number)
        assert prepared is not None
        noisy = "prefilter" in stream.plan(stream.around(number, GUIDE_RADIUS)).stages
        frame = Frame(number, prepared.radiance, prepared.albedo, prepared.normal)
        with stream.timings.stage("estimate"):
            return _checked(self.function(frame, noisy), frame)


@dataclass(frozen=True)
class Classical:
    """A first pass by the classical chain, from the window of noisy frames around each frame.

    Attributes
    ----------
    preset : ClassicalPreset
        The settings of the chain.
    """

    preset: ClassicalPreset
    holds = 0
    files = None
    from_noisy = True
    reads_frame = False

    def reach(self, radius: int) -> int:
        """See `hybrid.stream.FirstPass`."""
        return 2 * radius

    def make(self, stream: FrameStream, number: int) -> Array:
        """See `hybrid.stream.FirstPass`."""
        window = align(stream.window(number, noisy=True), timings=stream.timings)
        return filter_window(window, self.preset, timings=stream.timings)


@dataclass(frozen=True)
class FirstPassSource:
    """Where the estimates of a shot come from.

    Attributes
    ----------
    name : str
        What was taken; written to the header of the output.
    first_pass : FirstPass or None
        For a `FrameStream`; None for none.
    reason : str
        Why this one.
    files : Shot or None
        The finished sequence it is read from, if it is one.
    kept : tuple of Path
        Where pictures are kept, if they are.
    device : str or None
        What OIDN computes on, if it does.
    """

    name: str
    first_pass: FirstPass | None
    reason: str
    files: Shot | None = None
    kept: tuple[Path, ...] = ()
    device: str | None = None


def find_first_pass(
    spec: str,
    shot: Shot,
    *,
    own: ClassicalPreset = FINAL,
    kept: str | None = None,
    mode: str = "oidn-clean",
    forced: str = "",
    quicker: Callable[..., Array] | None = None,
    bundled: Callable[..., Array] | None = None,
    device: str = "cpu",
) -> FirstPassSource:
    """Find the estimates that are asked for.

    Parameters
    ----------
    spec : str
        "auto": what is in the file, else `mode` where OIDN is installed, else our own. "oidn" (quality high,
        guides as given), "oidn-fast", "oidn-clean" (guides prefiltered with OIDN's balanced networks, in frames where
        they hold noise), "oidn-best" (with its largest, in all), "nlm" (our own, from each frame's window), "bundled"
        (`bundled`, by itself), "none", or the pattern of a finished sequence of the same frames.
    shot : Shot
        The noisy shot.
    own : ClassicalPreset
        Of our own estimate.
    kept : str, optional
        Where OIDN's pictures are kept, and taken from if they are there and would be made the same: a pattern or a
        folder. Where none are made, the reason says that none are kept.
    mode : str
        Of OIDN, for "auto"; "bundled" has its quality.
    forced : str
        What the user has forced (`hybrid.plan.Rules.forced`), on which guides and fireflies depend: pictures are kept
        for that.
    quicker : callable, optional
        What "auto" has in the place of `hybrid.oidn.denoise_oidn` on a processor, with the same parameters.
    bundled : callable, optional
        What "auto" has where OIDN is not installed, before our own, with the same parameters.
    device : str
        Of OIDN, as for `hybrid.oidn.find_device`.

    Returns
    -------
    FirstPassSource

    Raises
    ------
    ImportError
        If OIDN is asked for by name and not installed.
    ValueError
        If a sequence lacks frames of the shot, or has each in the place of its neighbour; if `kept` is one file for
        several, neighbours among them; if OIDN is to run on a device that is not there.
    FileNotFoundError
        If there is no such sequence.
    """
    keep = None if kept is None else partial(Kept, shot, kept, forced)
    source = _choose(spec, shot, own, mode, keep, quicker, bundled, device)
    if kept is not None and source.name not in OIDN_MODES:
        return replace(source, reason=f"{source.reason}; nothing of it is kept, as OIDN's pictures would be")
    return source


def _choose(
    spec: str,
    shot: Shot,
    own: ClassicalPreset,
    mode: str,
    keep: Callable[[str, bool, str], Kept] | None,
    quicker: Callable[..., Array] | None,
    bundled: Callable[..., Array] | None,
    device: str,
) -> FirstPassSource:
    if spec == "auto":
        if shot.layers(shot.numbers[0]).estimate is not None:
            return FirstPassSource("file", PerFrame(_from_file), "the file holds a denoised picture")
        if (lacking := why_no_oidn()) is None:
            if quicker is not None and find_device(device) == "cpu":
                return _oidn(mode, keep, "OIDN is installed; its networks run in torch", "cpu", quicker)
            return _oidn(mode, keep, "OIDN is installed", device)
        if bundled is not None:
            return _bundled(mode, bundled, f"{lacking}; a network comes with ravg")
        return FirstPassSource("nlm", Classical(own), f"no denoised picture in the file, and {lacking}")
    if spec == "none":
        return FirstPassSource("none", None, "asked for")
    if spec == "nlm":
        return FirstPassSource("nlm", Classical(own), "asked for")
    if spec == "bundled":
        if bundled is None:
            raise ImportError("estimate bundled: torch is needed, which this command does without; expected another")
        return _bundled(mode, bundled, "asked for")
    if spec in OIDN_MODES:
        if (lacking := why_no_oidn()) is not None:
            raise ImportError(f'estimate {spec}: {lacking}; expected: pip install "pyoidn"')
        return _oidn(spec, keep, "asked for", device)
    sequence = open_matching_sequence(spec, shot)
    missing = [number for number in shot.numbers if not sequence.has(number)]
    if missing:
        raise ValueError(f"estimate {spec}: expected frame {missing[0]}, which the shot has, got none")
    other = find_other_frame(shot, lambda number: read_denoised(sequence, number) if sequence.has(number) else None)
    if other is not None:
        raise ValueError(f"estimate {spec}: each picture belongs to {other}, expected those of the shot's own frames")
    grade = find_sequence_grade(shot, lambda n: read_denoised(sequence, n) if sequence.has(n) else None)
    if grade is not None and grade.factors is None:
        raise ValueError(f"estimate {spec}: it {grade.message}, expected pictures of the shot's own light")
    factors, why = (None, "asked for") if grade is None else (grade.factors, f"it {grade.message}: brought to that")
    read = PerFrame(partial(_read_sequence, sequence, factors), files=sequence)
    return FirstPassSource("sequence", read, why, sequence)


def _bundled(mode: str, run: Callable[..., Array], reason: str) -> FirstPassSource:
    quality = OIDN_MODES[mode]["quality"]
    return FirstPassSource("bundled", PerFrame(partial(denoise_frame_oidn, denoise=run, quality=quality)), reason)


def _oidn(
    mode: str,
    keep: Callable[[str, bool, str], Kept] | None,
    reason: str,
    device: str,
    quicker: Callable[..., Array] | None = None,
) -> FirstPassSource:
    device = find_device(device)
    run: Callable[..., Array] = partial(_run_mode, mode, denoise=quicker or partial(denoise_oidn, device=device))
    kept = None if keep is None else keep(mode, quicker is not None, device)
    if kept is not None:
        run = partial(kept.read_or_run, run=run)
    most = HOLDS_FAST if mode == "oidn-fast" else HOLDS
    holds = most if quicker is None else 0  # networks in torch work on a strip at a time
    estimates = GuideAware(run, holds) if mode == "oidn-clean" else PerFrame(run, holds)
    places = () if kept is None else tuple(kept.places.values())
    return FirstPassSource(mode, estimates, reason, kept=places, device=device)


class Kept:
    """OIDN's pictures on disk, each with a record of what it was made from.

    Parameters
    ----------
    shot : Shot
        The noisy shot.
    spec : str
        Where they are: a pattern or a folder; those of one of several pictures in a folder of its own there.
    forced : str
        As for `find_first_pass`.
    mode : str
        A key of `OIDN_MODES`.
    quicker : bool
        Whether OIDN's networks run elsewhere, less exactly.
    device : str
        What they run on.

    Raises
    ------
    ValueError
        If it is one name for several frames, neighbours among them, or would overwrite an input.
    """

    def __init__(self, shot: Shot, spec: str, forced: str, mode: str, quicker: bool, device: str) -> None:
        # Of neighbours too that were not asked for.
        path = Path(spec)
        if shot.view:
            name = _folder_name(shot.view)
            path = path.with_name(name) / path.name if path.suffix.lower() == ".exr" else path / name
        self.places = {number: output_path(path, shot, number, include_context=True) for number in shot.files}
        self._shot = shot
        self._facts = {"estimate": mode, "quicker": quicker, "device": device, "forced": forced, **versions("pyoidn")}
        # Frames on each side that fireflies are told by, and those that tell whether guides hold noise.
        self._reach = REACH + (GUIDE_RADIUS if mode == "oidn-clean" else 0)

    def read_or_run(self, frame: Frame, *known: bool, run: Callable[..., Array]) -> Array:
        """What an earlier run has left of this frame, if it would be the same now; else what is left there now.

        Raises
        ------
        ValueError
            If another file is there, which no run has left as an estimate.
        """
        path, shot = self.places[frame.number], self._shot
        files = shot.sources(shot.neighbours(frame.number, self._reach))
        made_from = describe_sources(files, frame=frame.number, layers=shot.layer_summary(frame.number), **self._facts)
        if why_stale(path, {MADE_FROM: made_from}, whole=False) is not None:
            if path.exists() and "estimate" not in sources_in(path):
                raise ValueError(f"{path} is there, and no estimate that was kept: expected another place for them")
            path.parent.mkdir(parents=True, exist_ok=True)
            shot.write(path, frame.number, {"color": run(frame, *known)}, attributes={MADE_FROM: made_from})
        # Read back also what was just written, half as it may be: every run then sees the same.
        return shot.reopened({frame.number: path}).read(frame.number).color


def _folder_name(picture: str) -> str:
    """A folder's name for a picture: its own, or where no folder can be called so, one that no other picture has."""
    plain = re.sub(r"[^\w.-]|^\.", "_", picture)
    known = hashlib.sha256(picture.encode(errors="surrogateescape")).hexdigest()[:8]
    return plain if plain == picture else f"{plain}-{known}"


def _run_mode(mode: str, frame: Frame, noisy_guides: bool = True, *, denoise: Callable[..., Array]) -> Array:
    """Run a mode of OIDN; guides without noise are declared clean as they are."""
    settings = OIDN_MODES[mode] if noisy_guides else {**OIDN_MODES[mode], "prefilter": None, "clean": True}
    return denoise_frame_oidn(frame, denoise, **settings)


def _checked(found: Array | None, frame: Frame, highlights: Highlights | None = None) -> Array | None:
    """An estimate that fits its frame and is finite, without highlights that are not in the frame, and their halos."""
    if found is None:
        return None
    what = f"the estimate of frame {frame.number}"
    if found.shape != frame.color.shape:
        raise ValueError(f"{what} has shape {found.shape}, expected {frame.color.shape}")
    filled, lost = replace_nonfinite(found)
    noisy, bad = replace_nonfinite(frame.color)
    # What the renderer has lost as well counts for nothing.
    if (count := np.count_nonzero(lost & ~bad)) > LOST * lost.size:
        raise ValueError(f"{what}: {count} of {lost.size} pixels are not finite, where the frame is")
    filled = np.maximum(filled, 0)
    if highlights is not None:
        filled = clamp_halos(filled, highlights.pixels)
    if fault := find_lost_light(filled, noisy, ~bad):
        raise ValueError(f"{what}: {fault}")
    return filled


def _from_file(frame: Frame) -> Array | None:
    return frame.estimate


def denoise_frame_oidn(frame: Frame, denoise: Callable[..., Array] | None = None, **mode: Any) -> Array:
    """Run OIDN, or what stands for it, on a frame with what guides it has.

    Parameters
    ----------
    frame : Frame
        Pixels that are not finite are replaced.
    denoise : callable, optional
        What stands for `denoise_oidn`, with the same parameters.
    **mode : object
        As for `denoise_oidn`.

    Returns
    -------
    (H, W, 3) array of float32
        Linear radiance.
    """
    clean = [None if layer is None else replace_nonfinite(layer)[0] for layer in (frame.albedo, frame.normal)]
    albedo, normal = clean if clean[0] is not None else (None, None)  # OIDN takes no normal alone
    return (denoise or denoise_oidn)(replace_nonfinite(frame.color)[0], albedo, normal, **mode)


def _read_sequence(sequence: Shot, factors: tuple[float, float, float] | None, frame: Frame) -> Array | None:
    # Neighbours outside the frames that were asked for may be missing: they then count for nothing.
    if not sequence.has(frame.number):
        return None
    picture = read_denoised(sequence, frame.number)
    return picture if factors is None else picture * np.array(factors, np.float32)


def read_denoised(sequence: Shot, number: int) -> Array:
    """Read the denoised picture of a frame, wherever its file has it.

    Parameters
    ----------
    sequence : Shot
        Finished frames.
    number : int
        Of a frame that is there.

    Returns
    -------
    (H, W, 3) array of float32
        Linear radiance: the estimate, where the color is the noisy picture beside it; else the color, as in every file
        that ravg has written over it.
    """
    found = sequence.read(number)
    if found.estimate is None:
        return found.color
    layers = sequence.layers(number)
    replaced = layers.target == layers.color and MADE_FROM in sequence.header(number).parts[0].header
    return found.color if replaced else found.estimate
