"""Classical denoisers of an aligned window; training targets are made by them too."""

from dataclasses import dataclass

import numpy as np

from hybrid.alignment.transfer import compress, measure_gain
from hybrid.alignment.window import AlignedWindow
from hybrid.denoising.oidn import denoise_oidn
from hybrid.files.frame import Array
from hybrid.runtime.timing import Timings
from nlm.average import average, robust_average
from nlm.guided import guided_filter
from nlm.nonlocal_means import joint_nlm

# Weight of OIDN's result on the pooled samples against the average of first passes: errors of two images that are made
# differently cancel in part. 0.12 dB over all of it, in the mean of thirteen shots.
SECOND_LOOK = 0.8


@dataclass(frozen=True)
class ClassicalPreset:
    """A measured point of accuracy against time."""

    name: str  # as in ``--preset``
    # search radius and patch radius of the non-local means, pixels; search radius 0: the robust average alone
    nlm_radius: int
    nlm_patch_radius: int
    guided_eps: float  # regularisation of the guided filter that follows, relative to the guides' scale


DRAFT = ClassicalPreset("draft", 0, 0, guided_eps=1e-3)
STANDARD = ClassicalPreset("standard", 3, 2, guided_eps=1e-2)
FINAL = ClassicalPreset("final", 5, 2, guided_eps=1e-2)
CLASSICAL_PRESETS = {preset.name: preset for preset in (DRAFT, STANDARD, FINAL)}


def filter_window(
    aligned: AlignedWindow, preset: ClassicalPreset = STANDARD, *, timings: Timings | None = None
) -> Array:
    """Denoise the centre of a window from its noisy frames alone; radiance (H, W, 3), finite.

    Confidence-weighted robust average or joint non-local means over the window, then a guided filter, all on
    irradiance, which is multiplied by the centre's albedo at the end (paper, section "Training Data").
    """
    timings = timings or Timings()
    if preset.nlm_radius == 0:
        with timings.stage("average"):
            irradiance = robust_average(aligned.color, aligned.confidence)
    else:
        # A frame of a few pixels is searched as a whole.
        most = max(aligned.color.shape[1:3])
        with timings.stage("nlm"):
            irradiance = joint_nlm(
                aligned.color,
                aligned.variance,
                aligned.guide,
                confidence=aligned.confidence,
                radius=min(preset.nlm_radius, most),
                patch_radius=min(preset.nlm_patch_radius, most),
            )
    with timings.stage("guided"):
        guides = [] if aligned.guide is None else [aligned.guide]
        if preset.nlm_radius:
            # Edges of shadows and highlights are in no guide, but in the result of the non-local means. Without this
            # channel the filter lost 2 dB on a sunlit shot.
            light = irradiance.mean(axis=-1, keepdims=True)
            guides.append(compress(light, aligned.brightness.exposure))
        if guides:
            guide = np.concatenate(guides, axis=-1)
            irradiance = guided_filter(
                irradiance,
                guide,
                radius=1,
                eps=preset.guided_eps,
                moments=aligned.brightness.moments[:, : guide.shape[-1]],
            )
    return irradiance * aligned.modulation


def gated_average(aligned: AlignedWindow, *, timings: Timings | None = None) -> Array:
    """Average the first passes, ValueError without, of frames that show the same light; radiance (H, W, 3), finite.

    ``Σ c_t e_t / Σ c_t``, c the confidence: the greater of geometry's, times the color gate (`nlm.gate`) where the plan
    has it, and 0.3 times the gate. Colors show which pixels of an outline are alike, geometry does not.
    """
    if aligned.first_pass is None:
        raise ValueError("aligned: expected a window with first passes, got none")
    timings = timings or Timings()
    with timings.stage("average"):
        return average(aligned.first_pass, aligned.confidence) * aligned.modulation


def pool_and_denoise(aligned: AlignedWindow) -> Array:
    """Pool the samples of a window at its centre, and denoise them with OIDN; radiance (H, W, 3), finite.

    Raises ValueError without a first pass, of which the cheapest suffices (`oidn-fast`); ImportError without pyoidn.

    With G the gated average of the first passes, b the pooled image (`nlm.pooling`) and O = OIDN(b) with clean guides,
    the result is G + 0.8 (O − G). A weight found by cross-validation (both made once more without the centre, whose
    noisy image is then regressed on their difference) takes a third run of OIDN, and was worth 0.05 dB less than the
    constant on thirteen shots.
    """
    if aligned.centre.first_pass is None:
        raise ValueError("aligned: expected a window with first passes, got none")
    pooled = aligned.pool()
    mean = pooled.average * aligned.modulation
    albedo, normal = aligned.centre.guides.get("albedo"), aligned.centre.guides.get("normal")
    noisy_guides = "prefilter" in aligned.stages
    denoised = denoise_oidn(
        np.maximum(pooled.image * aligned.modulation, 0),
        albedo,
        None if albedo is None else normal,  # OIDN accepts no normal alone
        prefilter="balanced" if noisy_guides else None,
        clean=not noisy_guides,
        scale=measure_gain(aligned.centre.first_pass),
    )
    return np.asarray(mean + np.float32(SECOND_LOOK) * (denoised - mean), np.float32)
