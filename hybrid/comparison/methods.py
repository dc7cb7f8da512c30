"""The denoisers that a comparison knows: what our parts reach alone and together, and peers.

`METHODS` is the one place to add one. A method is a function from a shot to its finished frames; `sweep` varies the
settings of some of them.
"""

from __future__ import annotations

import math
from collections.abc import Callable, Iterator, Mapping, Sequence
from dataclasses import dataclass, field, replace
from functools import lru_cache, partial
from typing import TYPE_CHECKING, Any

import cv2
import numpy as np
from numpy.typing import NDArray
from skimage.restoration import denoise_nl_means, estimate_sigma

from flow.tvl1 import refine_flow
from hybrid.alignment.transfer import compress, expand, measure_exposure
from hybrid.alignment.window import AlignedWindow
from hybrid.files.frame import Frame, MappedShot
from hybrid.files.shots import Shot
from hybrid.first_pass import OIDN_MODE_OF_PRESET, denoise_frame_oidn, find_first_pass, read_denoised
from hybrid.oidn import Quality
from hybrid.plan import Rules
from hybrid.pseudo_reference import CLASSICAL_PRESETS, ClassicalPreset, filter_window, gated_average, gather_and_denoise
from hybrid.stabilize import FrameDenoiser
from hybrid.stream import FrameStream
from nlm.average import average, replace_nonfinite, robust_average

if TYPE_CHECKING:
    from hybrid.neural import Denoiser

Array = NDArray[np.float32]
Run = Callable[[Shot], Iterator[tuple[int, Array]]]
Maps = Callable[[Shot, Sequence[int]], Iterator[tuple[int, dict[str, Array]]]]
DenoiseWindow = Callable[[AlignedWindow], Array]


@dataclass(frozen=True)
class Method:
    """What a comparison runs.

    Attributes
    ----------
    run : callable
        From a shot to (number, (H, W, 3) radiance) of each of its frames. It runs in another process: a module's
        function, or a `functools.partial` of one. An `ImportError` lists it as absent.
    family : str
        What the chart draws alike.
    maps : callable, optional
        From a shot and numbers of frames to (number, (H, W) maps in [0, 1] by title), to be looked at.
    cost : float, optional
        Seconds where they are not measured: 0 for what is there anyway, None where they are not known. NaN: measured.
    threads : int
        How many the method may use; 0 leaves it to the machine.
    given : Shot, optional
        The frames, where another denoiser has left them in files: they can be checked before anything runs.
    settings : mapping of str to object
        What the report tells of it; in a sweep, what differs from `base`.
    sweep, base : str
        What is varied, and the method that is varied.
    """

    run: Run
    family: str
    maps: Maps | None = None
    cost: float | None = math.nan
    threads: int = 0
    given: Shot | None = None
    settings: Mapping[str, object] = field(default_factory=dict)
    sweep: str = ""
    base: str = ""

    @property
    def timed(self) -> bool:
        """Whether the time is to be measured."""
        return self.cost is not None and math.isnan(self.cost)


# What is there already


def noisy(shot: Shot) -> Iterator[tuple[int, Array]]:
    """The frames as they are, non-finite pixels replaced."""
    for number in shot.numbers:
        yield number, _finite(shot.read(number).color)


def finished(shot: Shot, *, other: Shot) -> Iterator[tuple[int, Array]]:
    """The frames that a denoiser has left in files (`hybrid.first_pass.read_denoised`).

    Parameters
    ----------
    shot : Shot
        The noisy shot.
    other : Shot
        The finished frames.

    Yields
    ------
    (int, (H, W, 3) array)
        Number and linear radiance of each frame.
    """
    for number in shot.numbers:
        if other.has(number):
            yield number, read_denoised(other, number)


def external(other: Shot) -> Method:
    """A finished sequence as a method; its time is not known."""
    return Method(partial(finished, other=other), "External", cost=None, given=other)


# Ours, on aligned windows


def _aligner(
    shot: Shot,
    *,
    radius: int = 2,
    source: str = "none",
    rules: Rules | None = None,
    vectors: bool = True,
    solver: Mapping[str, Any] | None = None,
) -> FrameStream:
    """What aligns windows with the stages that they call for.

    `source` is that of the estimates (`hybrid.first_pass`), `rules` have stages forced; without `vectors` those of the
    renderer are not looked at; `solver` has settings of TV-L1, and has it run.
    """
    seen = shot if vectors else _blind(shot)
    rules = rules or Rules()
    if solver:
        rules = replace(rules, on=rules.on | {"refine"})
    refine = partial(refine_flow, **(solver or {}))
    bundled = _small_network() if source == "bundled" else None
    chosen = find_first_pass(source, shot, mode=OIDN_MODE_OF_PRESET["fast"], bundled=bundled)
    return FrameStream(seen, rules, chosen.first_pass, radius=radius, refine=refine)


def _windows(shot: Shot, numbers: Sequence[int], **window: Any) -> Iterator[AlignedWindow]:
    """The aligned windows of some frames of a shot, with the settings of `_aligner`."""
    aligner = _aligner(shot, **window)
    for number in numbers:
        yield aligner.align(number)


def _small_network() -> Callable[..., Array]:
    from hybrid.neural import denoise_bundled  # torch may be absent

    return denoise_bundled


def classical(shot: Shot, *, denoise: DenoiseWindow, **window: Any) -> Iterator[tuple[int, Array]]:
    """Make an estimate of every aligned window without a network.

    Parameters
    ----------
    shot : Shot
        The noisy shot.
    denoise : callable
        From an `AlignedWindow` to (H, W, 3) radiance.
    **window : object
        Settings of `_aligner`, by name.

    Yields
    ------
    (int, (H, W, 3) array)
        Number and linear radiance of each frame.
    """
    for aligned in _windows(shot, shot.numbers, **window):
        yield aligned.number, denoise(aligned)


def aligned_average(aligned: AlignedWindow) -> Array:
    """The mean over time, weighted by confidence."""
    return average(aligned.color, aligned.confidence) * aligned.modulation


def aligned_robust_average(aligned: AlignedWindow) -> Array:
    """The same without the darkest and the brightest frame."""
    return robust_average(aligned.color, aligned.confidence) * aligned.modulation


@lru_cache(maxsize=1)
def _denoiser(preset: str, tile: int | None, precision: str, threshold: float | None) -> Denoiser:
    """The network with the weights of a preset, loaded once."""
    from hybrid import neural  # torch may be absent

    return neural.Denoiser(neural.shipped_weights(preset), tile=tile, precision=precision, threshold=threshold)


def network(
    shot: Shot,
    *,
    preset: str,
    tile: int | None = None,
    precision: str = "auto",
    threshold: float | None = None,
    **window: Any,
) -> Iterator[tuple[int, Array]]:
    """Run a network with the weights of a preset.

    Parameters
    ----------
    shot : Shot
        The noisy shot.
    preset : str
        Whose weights it takes.
    tile : int, optional
        Pixels on a side of what it works on at a time.
    precision : str
        Of its convolutions, as for `Denoiser`.
    threshold : float, optional
        Of its kernels, in units of 1/K; the weights' own without.
    **window : object
        Settings of `_aligner`, by name.

    Yields
    ------
    (int, (H, W, 3) array)
        Number and linear radiance of each frame.
    """
    denoiser = _denoiser(preset, tile, precision, threshold)
    frames = FrameDenoiser(_aligner(shot, radius=denoiser.radius, **window), denoiser)
    for number in shot.numbers:
        yield number, frames.make(number).denoised.color


def classical_maps(
    shot: Shot, numbers: Sequence[int], *, denoise: DenoiseWindow, **window: Any
) -> Iterator[tuple[int, dict[str, Array]]]:
    """Map the confidence, and the temporal contribution to a classical estimate.

    Parameters
    ----------
    shot : Shot
        The noisy shot.
    numbers : sequence of int
        Of the frames to map.
    denoise : callable
        From an `AlignedWindow` to (H, W, 3) radiance.
    **window : object
        Settings of `_aligner`, by name.

    Yields
    ------
    (int, dict of str to (H, W) array)
        Number and `window_maps` of each frame.
    """
    for aligned in _windows(shot, numbers, **window):
        yield aligned.number, window_maps(aligned, denoise)


def network_maps(
    shot: Shot, numbers: Sequence[int], *, preset: str, **window: Any
) -> Iterator[tuple[int, dict[str, Array]]]:
    """Map the confidence, and the temporal contribution to what a network gives.

    Parameters
    ----------
    shot : Shot
        The noisy shot.
    numbers : sequence of int
        Of the frames to map.
    preset : str
        Whose weights the network takes.
    **window : object
        Settings of `_aligner`, by name.

    Yields
    ------
    (int, dict of str to (H, W) array)
        Number and `window_maps` of each frame.
    """
    denoiser = _denoiser(preset, None, "float32", None)  # the difference of two runs must not be rounding
    for aligned in _windows(shot, numbers, radius=denoiser.radius, **window):
        yield aligned.number, window_maps(aligned, lambda seen: denoiser(seen).color)


def window_maps(aligned: AlignedWindow, denoise: DenoiseWindow) -> dict[str, Array]:
    """Show what a denoiser makes of time.

    Parameters
    ----------
    aligned : AlignedWindow
        Of at least three frames.
    denoise : callable
        From the window to (H, W, 3) radiance.

    Returns
    -------
    dict of str to (H, W) array
        "Confidence": the mean of the other frames' confidence; "Temporal contribution": the share of the result that
        comes from the other frames. Both in [0, 1].

    Notes
    -----
    The contribution is by how many per cent the result brightens when the other frames do by one: for a weighted
    mean that is the share of their weight in the light, and it is defined for any denoiser.
    """
    side = np.arange(len(aligned.confidence)) != aligned.centre
    # Small enough to change no decision, and large enough to stand far above the rounding of float32.
    step = np.float32(1 / 256)
    part = np.where(side, step, 0).astype(np.float32)[:, None, None]
    first_pass = aligned.first_pass
    if first_pass is not None:
        first_pass = first_pass * (1 + part[..., None])
    brighter = replace(aligned, aligned_color=aligned.color * (1 + part[..., None]), first_pass=first_pass)
    before, after = (denoise(window).mean(axis=-1) for window in (aligned, brighter))
    change = step * before  # which underflows where it is all but black
    share = np.divide(after - before, change, out=np.zeros_like(before), where=change > 0)
    return {
        "Confidence": aligned.confidence[side].mean(axis=0),
        "Temporal contribution": np.clip(share, 0, 1).astype(np.float32),
    }


# Peers


def oidn(shot: Shot, *, quality: Quality = "high", prefilter: Quality | None = None) -> Iterator[tuple[int, Array]]:
    """Run OIDN on each frame by itself.

    Parameters
    ----------
    shot : Shot
        The noisy shot.
    quality, prefilter : str
        As for `denoise_oidn`.

    Yields
    ------
    (int, (H, W, 3) array)
        Number and linear radiance of each frame.
    """
    for number in shot.numbers:
        yield number, denoise_frame_oidn(shot.read(number), quality=quality, prefilter=prefilter)


def oidn_then_average(shot: Shot) -> Iterator[tuple[int, Array]]:
    """OIDN's best mode on each frame, then the aligned robust average of what it gave."""
    aligner = FrameStream(MappedShot(shot, _denoised), Rules())
    for number in shot.numbers:
        yield number, aligned_robust_average(aligner.align(number))


def _denoised(frame: Frame) -> Frame:
    return replace(frame, color=denoise_frame_oidn(frame, prefilter="high"), variance=None)


def skimage_nlm(shot: Shot) -> Iterator[tuple[int, Array]]:
    """scikit-image's non-local means on each tone-mapped frame, by its documentation's advice (h = 0.8 σ)."""
    for number in shot.numbers:
        tone, exposure = _tone_mapped(shot, number)
        sigma = _noise_of(tone)
        filtered = denoise_nl_means(
            tone, patch_size=5, patch_distance=6, h=0.8 * sigma, sigma=sigma, fast_mode=True, channel_axis=-1
        )
        yield number, _radiance(filtered, exposure)


def opencv_nlm(shot: Shot) -> Iterator[tuple[int, Array]]:
    """OpenCV's non-local means over five tone-mapped frames, which it does not align (16 bit, L1)."""
    radius = 2
    for number in shot.numbers:
        tone, exposure = _tone_mapped(shot, number)
        numbers = [number + k * shot.step for k in range(-radius, radius + 1)]
        # The filter wants as many frames before as after: at the ends the frame itself stands in.
        frames = [_tone_mapped(shot, n)[0] if shot.has(n) else tone for n in numbers]
        codes = [np.rint(frame * 65535).astype(np.uint16) for frame in frames]
        strength = [float(65535 * _noise_of(tone))]
        filtered = cv2.fastNlMeansDenoisingMulti(
            codes, radius, 2 * radius + 1, h=strength, templateWindowSize=5, searchWindowSize=13, normType=cv2.NORM_L1
        )
        yield number, _radiance(filtered / np.float32(65535), exposure)


def _tone_mapped(shot: Shot, number: int) -> tuple[Array, float]:
    """A frame in [0, 1) by x / (1 + x), x relative to the first frame's exposure."""
    exposure = measure_exposure(_finite(shot.read(shot.numbers[0]).color))
    return compress(_finite(shot.read(number).color), exposure), exposure


def _radiance(tone: NDArray[np.floating], exposure: float) -> Array:
    """Back to radiance; filters may leave the range by rounding."""
    return expand(np.clip(tone, 0, 65534 / 65535).astype(np.float32), exposure)


def _noise_of(tone: Array) -> float:
    """Standard deviation of the noise of a picture."""
    return float(estimate_sigma(tone, average_sigmas=True, channel_axis=-1))


def _finite(image: Array) -> Array:
    """Non-finite pixels replaced as the pipeline does it, so that no method is judged by them."""
    return replace_nonfinite(image)[0]


def _blind(shot: Shot) -> MappedShot:
    """The shot without its vectors."""
    return MappedShot(shot, lambda frame: replace(frame, motion=None, motion_convention=None))


def _aligned(family: str, denoise: DenoiseWindow, *, radius: int = 2, source: str = "none", **told: object) -> Method:
    """An estimator of aligned windows as a method, with its maps where the window has neighbours."""
    window: dict[str, Any] = {"radius": radius, "source": source}
    run = partial(classical, denoise=denoise, **window)
    maps = partial(classical_maps, denoise=denoise, **window)
    settings = {"window": 2 * radius + 1, **({} if source == "none" else {"estimates": source}), **told}
    return Method(run, family, maps if radius else None, settings=settings)


def _preset(family: str, preset: ClassicalPreset, radius: int = 2) -> Method:
    told = {key.replace("_", " "): value for key, value in vars(preset).items() if key != "name"}
    return _aligned(family, partial(filter_window, preset=preset), radius=radius, **told)


def _network(preset: str, source: str) -> Method:
    run = partial(network, preset=preset, source=source)
    maps = partial(network_maps, preset=preset, source=source)
    return Method(run, "Networks", maps, settings={"weights": preset, "estimates": source})


def _oidn(quality: Quality, prefilter: Quality | None = None) -> Method:
    guides = "prefiltered, cleanAux" if prefilter else "as given"
    run = partial(oidn, quality=quality, prefilter=prefilter)
    return Method(run, "OIDN", settings={"quality": quality, "guides": guides})


METHODS: dict[str, Method] = {
    "noisy": Method(noisy, "Input", cost=0.0),
    "aligned average": _aligned("Averages", aligned_average),
    "aligned robust average": _aligned("Averages", aligned_robust_average),
    # One frame, one filter: what the stages are worth without time.
    "NLM alone": _preset("Stages alone", ClassicalPreset("NLM", 5, 2, 0, 0), radius=0),
    "guided alone": _preset("Stages alone", ClassicalPreset("guided", 0, 0, 5, 1e-2), radius=0),
    **{name: _preset("Pseudo-references", preset) for name, preset in CLASSICAL_PRESETS.items()},
    "gated": _aligned("Gated averages", gated_average, source="nlm"),
    "gated OIDN fast": _aligned("Gated averages", gated_average, source="oidn-fast"),
    "gated OIDN": _aligned("Gated averages", gated_average, source="oidn"),
    "gated OIDN clean": _aligned("Gated averages", gated_average, source="oidn-clean"),
    "gated OIDN best": _aligned("Gated averages", gated_average, source="oidn-best"),
    "gathered": _aligned("Gated averages", gather_and_denoise, source="oidn-fast"),
    "network without OIDN": _network("fast", "bundled"),
    **{f"network {preset}": _network(preset, mode) for preset, mode in OIDN_MODE_OF_PRESET.items()},
    "tKPCN": _network("tkpcn", "none"),
    "OIDN fast": _oidn("fast"),
    "OIDN high": _oidn("high"),
    "OIDN balanced": _oidn("balanced"),
    "OIDN best": _oidn("high", prefilter="high"),
    "OIDN balanced + clean guides": _oidn("balanced", prefilter="balanced"),
    "OIDN best + robust average": Method(oidn_then_average, "OIDN"),
    "scikit-image NLM": Method(skimage_nlm, "Libraries"),
    "OpenCV temporal NLM": Method(opencv_nlm, "Libraries"),
}
