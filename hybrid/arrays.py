"""Denoise frames in memory, without files."""

from collections.abc import Callable, Collection, Iterator, Mapping, Sequence
from dataclasses import dataclass
from numbers import Integral
from typing import Self, cast

import numpy as np

from flow.motion import MotionConvention
from hybrid.files.frame import Array, Frame
from hybrid.files.passes import BEAUTY, NO_PASSES
from hybrid.files.profile import parse_motion
from hybrid.files.shots import Shot
from hybrid.first_pass import SPECS
from hybrid.job import DEFAULTS, DenoiseOptions, choose_first_pass, open_denoiser, prepare_process, replace_options
from hybrid.pass_sums import classify_passes, sample_rows
from hybrid.plan import Plan
from hybrid.stabilize import FrameDenoiser
from hybrid.stream import FrameStream

Layers = Sequence[Mapping[str, Array]] | Mapping[int, Mapping[str, Array]]  # layers of each frame, by index or number
# Names of layers that are no AOVs.
LAYERS = ("color", "albedo", "normal", "depth", "motion", "variance", "alpha", "estimate")


class ArrayFrames:
    """Frames in memory, read as those of a shot; parameters are those of `denoise_arrays`."""

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
        self._convention = None if motion is None else MotionConvention(**parse_motion(motion))
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
        if "color" not in layers:
            raise ValueError(f"frame {number}: expected the layer color, got {', '.join(layers) or 'none'}")
        if ("motion" in layers) and self._convention is None:
            raise ValueError(f"frame {number} has the layer motion, expected its convention as `motion`")
        frame = Frame(
            number,
            **{name: layers[name] for name in LAYERS if name in layers},  # type: ignore[arg-type]
            motion_convention=self._convention if "motion" in layers else None,
            aovs={name: _as_aov(layers[name]) for name in layers if name not in (*LAYERS, *self.passes.kept)},
            passes=self.passes,
        )
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
        found = {name: np.asarray(layer) for name, layer in layers.items()}
        for name, layer in found.items():
            if layer.dtype.kind not in "buif":
                raise ValueError(f"frame {number}: {name} has type {layer.dtype}, expected real numbers")
        return {name: np.asarray(layer, np.float32) for name, layer in found.items()}


def _as_aov(layer: Array) -> Array:
    """A layer (H, W, C), also of (H, W)."""
    return layer if layer.ndim == 3 else layer[..., None]


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

    The pixels are those that `hybrid.denoise_shot` computes from the same layers; layers are not validated. AOVs that
    add up to the color are scaled to do so again. At most a window of frames is held.

    Parameters
    ----------
    frames : sequence or mapping of int to mapping of str to array
        Layers of each frame, all of one size: "color" (H, W, 3), linear radiance; optional "albedo", "normal",
        "variance" of the color's mean, "estimate", an image denoised already, (H, W, 3) each; "depth", "alpha" (H, W);
        "motion" (H, W, 2 or 4). Any other name is an AOV (H, W, C), which a network denoises along, as the alpha. Keys
        of a mapping are frame numbers, and its frames may be computed when they are looked up.
    options : DenoiseOptions, optional, what is asked for; options about files, passes and memory are refused
    motion : str, optional
        Convention of the vectors in words of ``ravg --motion`` (docs/renderers.md), such as "next,pixels,y-down".
    numbers : collection of int, optional
        Frames to denoise; all without. The others are neighbours.
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

    Examples
    --------
    >>> import numpy as np
    >>> from hybrid import denoise_arrays
    >>> noisy = [{"color": np.random.default_rng(n).gamma(4, 0.25, (32, 48, 3))} for n in range(3)]
    >>> [result.layers["color"].shape for result in denoise_arrays(noisy, preset="draft")]
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
    if chosen.aov_sum == "beauty" and not any(found.whole == BEAUTY and found.complete for found in shot.passes.sums):
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
        stream = FrameStream(
            shot, chosen.rules, source.first_pass, radius=denoiser.radius, filter_guides=denoiser.filter_guides
        )
        denoise = FrameDenoiser(stream, denoiser, strength=chosen.strength)
        for number in wanted:
            made = denoise.make(number)
            layers = {"color": made.denoised.color, **made.denoised.aovs, **shot.kept(number)}
            result = ArrayResult(number, layers, made.plan)
            yield result
            if progress is not None and progress(result) is False:
                return

    return results()
