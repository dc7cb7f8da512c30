"""Windows as the final stage takes them: aligned frames, and the inputs of its convolutions."""

from typing import NamedTuple

from torch import Tensor

#: Channels of `PackedInputs`: of each frame its image and confidence; of all frames together the centre's albedo and
#: normal, the average of the first passes and the number of pooled samples; of the skip connection the pooled image,
#: albedo and normal.
FRAME_CHANNELS, SHARED_CHANNELS, STATIC_CHANNELS = 4, 10, 9


class UNetWindow(NamedTuple):
    """An aligned window of T frames, float32."""

    first_pass: Tensor  # ``(N, T, 3, H, W)`` irradiance: each frame denoised by itself
    # ``(N, T, 3, H, W)`` irradiance of the noisy frames minus `first_pass`, each frame's in its own place, aligned to
    # the nearest pixel; None where `network.robust_unet.denoise_window` gets a function for it
    residual: Tensor | None
    confidence: Tensor  # ``(N, T, 1, H, W)``, at least 0
    modulation: Tensor  # ``(N, 3, H, W)``; radiance is irradiance times modulation
    exposure: Tensor  # ``(N,)``, positive: brightness of the irradiance of whole frames
    # ``(N,)``, positive: factor of radiance before the transfer curve (`hybrid.alignment.transfer.measure_gain`)
    gain: Tensor
    # ``(N, 3, H, W)`` guides of the centre, in [0, 1] and [−1, 1]
    albedo: Tensor | None = None
    normal: Tensor | None = None


class PackedInputs(NamedTuple):
    """Inputs of a `network.robust_unet.RobustUNet`, and the average that its image is blended with."""

    frames: Tensor  # ``(T·N, 4, H, W)``, time first: image on the transfer curve, confidence
    shared: Tensor  # ``(N, 10, H, W)``: albedo, normal, average of the first passes on the curve, pooled samples over T
    static: Tensor  # ``(N, 9, H, W)``: pooled image on the curve, albedo, normal, in [0, 1]
    average: Tensor  # ``(N, 3, H, W)`` irradiance: average of the first passes by confidence
