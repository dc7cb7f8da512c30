"""Denoise frames in memory, without files."""

from __future__ import annotations  # `help` then shows the names of types, not what they stand for

import warnings
from collections.abc import Callable, Collection, Iterator, Mapping, Sequence
from dataclasses import dataclass
from difflib import get_close_matches
from numbers import Integral
from typing import Self, cast

import numpy as np

from flow.convention import choose_convention
from flow.motion import MotionConvention
from flow.patches import FramePair, Patches
from hybrid.checks.pass_sums import classify_passes, sample_rows
from hybrid.denoising.denoisers import open_stream
from hybrid.denoising.first_pass import SPECS
from hybrid.denoising.plan import Plan
from hybrid.denoising.stabilize import FrameDenoiser
from hybrid.files.frame import Array, Frame
from hybrid.files.passes import BEAUTY, NO_PASSES
from hybrid.files.profile import parse_motion
from hybrid.files.shots import Shot
from hybrid.run.job import DEFAULTS, DenoiseOptions, choose_first_pass, open_denoiser, prepare_process, replace_options

Layers = Sequence[Mapping[str, Array]] | Mapping[int, Mapping[str, Array]]  # layers of each frame, by index or number
# Names of layers that are no AOVs.
LAYERS = ("color", "albedo", "normal", "depth", "motion", "variance", "alpha", "estimate")


class ArrayFrames:
    """Frames in memory with the interface of a shot; parameters as for `denoise_arrays`."""

    def __init__(self, frames: Layers, motion: str | None = None) -> None:
        listed = range(len(frames)) if isinstance(frames, Sequence) else ()
        numbers = tuple(frames) if isinstance(frames, Mapping) else tuple(listed)
        if not numbers or not all(isinstance(number, Integral) for number in numbers):
            raise ValueError("frames: expected a list of at least one frame, or a mapping of numbers to frames")
        self.numbers = tuple(sorted(map(int, numbers)))
        self.step = int(np.gcd.reduce(np.diff(self.numbers))) if len(self.numbers) > 1 else 1
        if motion in ("auto", "none"):
            raise ValueError(f"motion is {motion!r}, expected a convention such as 'next,pixels,y-down'")
        self.passes = NO_PASSES
        self._frames = frames
        self.convention = None if motion is None else MotionConvention(**parse_motion(motion))
        first = self.read(self.numbers[0])
        self.aovs, self.shape = tuple(first.aovs), first.color.shape[:2]
        if self.aovs:
            self.passes, _ = classify_passes([sample_rows(self.read(number)) for number in self.numbers[:2]])

    def with_neighbours(self, reach: int) -> Self:
        """The same frames: all of them are there."""
        return self

    def layers(self, number: int) -> Frame:
        """The layers of a frame; `estimate` is None where there is none."""
        return self.read(number)

    def has(self, number: int) -> bool:
        return number in self.numbers

    def kept(self, number: int) -> dict[str, Array]:
        """The AOVs of a frame that have no noise, which are not denoised."""
        layers = self._arrays(number)
        return {name: _as_aov(layers[name]) for name in self.passes.kept if name in layers}

    def read(self, number: int) -> Frame:
        """A frame; ValueError where a layer does not fit the others."""
        layers = self._arrays(number)
        for name in layers:
            # A known name with a slip is this similar: "albdeo" has 0.83, "diffuse" 0.3.
            if name not in LAYERS and (near := get_close_matches(str(name).lower(), LAYERS, 1, 0.8)):
                raise ValueError(f"frame {number}: layer {name!r} is unknown, expected {near[0]}? (or an AOV's name)")
        if "color" not in layers:
            raise ValueError(f"frame {number}: expected the layer color, got {', '.join(layers) or 'none'}")
        if "motion" in layers:
            if self.convention is None:
                raise ValueError(f"frame {number} has the layer motion, expected its convention as `motion`")
            got, expected = layers["motion"].shape, (*layers["color"].shape[:2], self.convention.channels)
            if got != expected:
                raise ValueError(f"frame {number}: motion is {got}, expected {expected} for {self.convention}")
        try:
            frame = Frame(
                number,
                **{name: layers[name] for name in LAYERS if name in layers},  # type: ignore[arg-type]
                motion_convention=self.convention if "motion" in layers else None,
                aovs={name: _as_aov(layers[name]) for name in layers if name not in (*LAYERS, *self.passes.kept)},
                passes=self.passes,
            )
        except ValueError as error:
            raise ValueError(f"frame {number}: {error}") from None
        if frame.color.size == 0:
            raise ValueError(f"frame {number} has shape {frame.color.shape[:2]}, expected at least one pixel")
        if number != self.numbers[0] and frame.color.shape[:2] != self.shape:
            raise ValueError(f"frame {number} has shape {frame.color.shape[:2]}, expected {self.shape}")
        return frame

    def _arrays(self, number: int) -> dict[str, Array]:
        """The layers of a frame in float32."""
        layers = self._frames[number]
        if not isinstance(layers, Mapping):
            raise ValueError(f"frame {number} is a {type(layers).__name__}, expected names of layers and their arrays")
        arrays = {name: np.asarray(layer) for name, layer in layers.items()}
        for name, layer in arrays.items():
            if layer.dtype.kind != "f":
                expected = "float radiance, scene-linear" if name in ("color", "estimate") else "float"
                raise ValueError(f"frame {number}: {name} has type {layer.dtype}, expected {expected}")
        # Compiled loops take no read-only arrays, and torch takes no negative strides.
        return {name: np.require(layer, np.float32, ["C", "W"]) for name, layer in arrays.items()}


def _as_aov(layer: Array) -> Array:
    """A layer (H, W, C), also of (H, W)."""
    return layer if layer.ndim == 3 else layer[..., None]


def _doubt_vectors(shot: ArrayFrames, number: int) -> str | None:
    """Report if a frame and the next, or else the one before, match along the vectors in no sign; None if they do."""
    starts = [n for n in (number, number - shot.step) if shot.has(n) and shot.has(n + shot.step)]
    if shot.convention is None or not starts:
        return None
    earlier, later = shot.read(starts[0]), shot.read(starts[0] + shot.step)
    if earlier.motion is None or later.motion is None:
        return None
    vectors = earlier.motion, later.motion

    def patches(*roles: str) -> list[Patches]:
        layers = [(getattr(earlier, role), getattr(later, role), role) for role in roles]
        return [
            Patches(FramePair(here, there, *vectors, shot.shape, shot.step, float(role == "normal")))
            for here, there, role in layers
            if here is not None and there is not None
        ]

    choice = choose_convention(patches("color"), shot.convention, surfaces=lambda: patches("albedo", "normal"))
    if choice.convention == shot.convention:
        return None
    pair = f"motion: frames {earlier.number} and {later.number} match"
    if choice.convention is not None:
        return f"{pair} along {choice.convention}, not along {shot.convention}; expected the former as `motion`"
    left, still = f"{choice.unexplained:.1%}", f"{choice.still:.1%}"
    return f"{pair} along the vectors in no sign or unit (the best leaves {left}, no motion {still}); check the vectors"


@dataclass(frozen=True)
class ArrayResult:
    """A denoised frame, with the reasons of the stages that ran."""

    number: int  # the frame's key, or its index
    layers: Mapping[str, Array]  # "color", linear radiance, and AOVs and alpha, (H, W, C) each
    plan: Plan


def denoise_arrays(
    frames: Layers,
    options: DenoiseOptions | None = None,
    *,
    motion: str | None = None,
    numbers: Collection[int] | None = None,
    progress: Callable[[ArrayResult], bool | None] | None = None,
    **changes: object,
) -> Iterator[ArrayResult]:
    """Denoise frames in memory.

    The pixels are those that `ravg.denoise_shot` computes from the same layers. AOVs that add up to the color are
    scaled to do so again. At most a window of frames is held. Options are checked at once; frames are denoised, and
    their layers checked, while the iterator is consumed.

    Parameters
    ----------
    frames : sequence or mapping of int to mapping of str to array
        Layers of each frame, all of one size: "color" (H, W, 3), linear radiance; optional "albedo", "normal",
        "variance" of the color's mean, "estimate", an image denoised already, (H, W, 3) each; "depth", "alpha" (H, W);
        "motion" (H, W, C) with the channels of its convention. Any other name is an AOV (H, W, C), which a network
        denoises along, as the alpha. All are of a float type. Keys of a mapping are frame numbers, and its frames may
        be computed when they are looked up.
    options : DenoiseOptions, optional
        All but those of files, passes and memory: `budget`, `keep_first_pass`, `passes`, `breakdown`, `max_memory`,
        `resume`, `keep_going` and `strict` must be as by default.
    motion : str, optional
        Convention of the vectors in words of ``ravg --motion`` (docs/renderers.md), such as "next,pixels,y-down";
        needed with the layer "motion".
    numbers : collection of int, optional
        Frames to denoise; default: all. The others are neighbours.
    progress : callable, optional, called with each result; if it returns False, the work ends there
    **changes : object, fields of `DenoiseOptions`, in place of those of `options`

    Yields
    ------
    ArrayResult

    Raises
    ------
    ValueError
        If a layer or an option is not as expected.
    ImportError
        If OIDN is asked for and pyoidn is not installed.

    Warns
    -----
    UserWarning
        If two frames do not match along the vectors (once), or if no pixel of a frame is finite.

    Examples
    --------
    >>> import numpy as np
    >>> from ravg import denoise_arrays
    >>> noisy = [{"color": np.random.default_rng(n).gamma(4, 0.25, (32, 48, 3))} for n in range(3)]
    >>> [result.layers["color"].shape for result in denoise_arrays(noisy)]
    [(32, 48, 3), (32, 48, 3), (32, 48, 3)]
    """
    chosen = replace_options(options, changes)
    for name in ("budget", "keep_first_pass", "passes", "breakdown", "max_memory", "resume", "keep_going", "strict"):
        if getattr(chosen, name) != DEFAULTS[name]:
            raise ValueError(f"{name} is {getattr(chosen, name)!r}, expected none for frames in memory")
    if chosen.first_pass not in SPECS:
        raise ValueError(f"first_pass is {chosen.first_pass!r}, expected one of {', '.join(SPECS)}")
    shot = ArrayFrames(frames, motion)
    if chosen.method != "network" and shot.aovs:
        raise ValueError(f"{shot.aovs[0]!r} is an AOV, expected none, as {chosen.method} denoises the color alone")
    if chosen.aov_sum == "beauty" and not any(total.whole == BEAUTY and total.complete for total in shot.passes.sums):
        raise ValueError("aov_sum is 'beauty', expected AOVs of which the color is the sum")
    if not (numbers is None or isinstance(numbers, Collection)):
        raise ValueError(f"numbers is {numbers!r}, expected a list of frame numbers")
    wanted = shot.numbers if numbers is None else tuple(sorted(numbers))
    if missing := [number for number in wanted if not shot.has(number)]:
        raise ValueError(f"numbers: frame {missing[0]} is not there, expected some of {shot.numbers}")

    def results() -> Iterator[ArrayResult]:
        prepare_process(chosen)
        denoiser = open_denoiser(chosen)
        source = choose_first_pass(cast("Shot", shot), chosen, denoiser)
        stream = open_stream(shot, chosen.rules, source.first_pass, denoiser)
        denoise = FrameDenoiser(stream, denoiser, strength=chosen.strength)
        if wanted and (doubt := _doubt_vectors(shot, wanted[0])) is not None:
            warnings.warn(doubt, stacklevel=2)
        for number in wanted:
            frame = denoise.make(number)
            layers = {"color": frame.denoised.color, **frame.denoised.aovs, **shot.kept(number)}
            result = ArrayResult(number, layers, frame.plan)
            yield result
            if progress is not None and progress(result) is False:
                return

    return results()
