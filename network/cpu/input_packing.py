"""Inputs of the final stage from an aligned window in one pass over memory, for inference on CPUs.

`network.robust_unet.pool_samples` and `network.robust_unet.pack_inputs` define the result; torch makes some sixty
passes over the frames for it, and copies of them that are mirrored beyond their borders. Here each pixel is read once,
where it lies, and each input of a convolution is written once.
"""

from collections.abc import Callable
from typing import NamedTuple

import numpy as np
import torch
from numba import njit
from numpy.typing import NDArray
from torch import Tensor

from loops.parallel import Floats, run_bands
from network.cpu.curve import encoding_table, on_curve
from network.windows import FRAME_CHANNELS, SHARED_CHANNELS, STATIC_CHANNELS, PackedInputs, UNetWindow
from nlm.pooling import RESIDUAL_LIMIT

Indices = NDArray[np.int64]


class _Source(NamedTuple):
    """Layers of one window, channels last; the residual from row `top` on; guides that are missing have no rows."""

    first_pass: Floats
    residual: Floats
    confidence: Floats
    modulation: Floats
    albedo: Floats
    normal: Floats


class _Target(NamedTuple):
    """Rows of the inputs of all windows, channels last."""

    frames: Floats
    shared: Floats
    static: Floats
    average: Floats


def can_pack(window: UNetWindow) -> bool:
    """Whether `packer` takes a window: all of its layers float32 on a CPU."""
    layers = [layer for layer in window if layer is not None]
    return all(layer.dtype == torch.float32 and layer.device.type == "cpu" for layer in layers)


def packer(
    window: UNetWindow, columns: Indices, residual: Callable[[slice], Floats] | None = None
) -> Callable[[Indices], PackedInputs]:
    """Make a function that packs rows of a window: it maps h row numbers to inputs of h×w pixels.

    `columns` has the column of the window for each column of the inputs; layers whose channels are not last are copied.
    `residual` is as for `network.robust_unet.denoise_window`.
    """
    first_pass, confidence, modulation = map(_pixels, (window.first_pass, window.confidence, window.modulation))
    batch, count = first_pass.shape[:2]
    whole = None if window.residual is None else _pixels(window.residual)
    missing = np.empty((batch, 0, 0, 3), np.float32)
    guides = [missing if guide is None else _pixels(guide) for guide in (window.albedo, window.normal)]
    each = tuple(range(count))
    scales = np.stack([window.exposure.numpy(), window.gain.numpy()], axis=1)

    def pack(rows: Indices) -> PackedInputs:
        size = len(rows), len(columns)
        frames = np.empty((count, batch, *size, FRAME_CHANNELS), np.float32)
        channels = SHARED_CHANNELS, STATIC_CHANNELS, 3
        shared, static, average = (np.empty((batch, *size, depth), np.float32) for depth in channels)
        if whole is None:
            assert residual is not None
            top = int(rows.min())
            strips = residual(slice(top, int(rows.max()) + 1))[None]  # one window at a time
        else:
            top, strips = 0, whole
        for n in range(batch):
            source = _Source(first_pass[n], strips[n], confidence[n], modulation[n], *(guide[n] for guide in guides))
            target = _Target(frames[:, n], shared[n], static[n], average[n])
            run_bands(_pack, size[0], source, scales[n], rows, columns, target, encoding_table(), top, each)
        flat = frames.reshape(count * batch, *size, FRAME_CHANNELS)
        return PackedInputs(
            *(torch.from_numpy(pixels).permute(0, 3, 1, 2) for pixels in (flat, shared, static, average))
        )

    return pack


def _pixels(layer: Tensor) -> Floats:
    """A layer with its channels last, copied only where they are not."""
    return layer.movedim(-3, -1).contiguous().numpy()


@njit(cache=True, nogil=True, error_model="numpy")
def _pack(
    first: int, last: int, source: _Source, scales: Floats, rows: Indices, columns: Indices, target: _Target,
    curve: Floats, top: int, each: tuple[int, ...],
) -> None:  # fmt: skip
    # `each` has a number for each frame: the compiler knows the length of a tuple, and unrolls loops over frames.
    first_pass, residual, confidence, modulation, albedo, normal = source
    frames, shared, static, average = target
    exposure, gain = scales[0], scales[1]
    T, zero, one, half = len(each), np.float32(0), np.float32(1), np.float32(0.5)
    centre = T // 2
    trust, share, held = np.empty(T, np.float32), np.empty(T, np.float32), np.empty((T, 3), np.float32)
    value = np.empty(1, np.float32)
    bits = value.view(np.uint32)  # of the same four bytes
    for y in range(np.uintp(first), np.uintp(last)):
        row = np.uintp(rows[y])
        strip = np.uintp(rows[y] - top)
        for x in range(np.uintp(len(columns))):
            column = np.uintp(columns[x])
            total = zero
            for t in range(T):
                trust[t] = confidence[t, row, column, 0]
                total += trust[t]
            if not total > 0:
                trust[:] = zero
                trust[centre] = total = one
            squares = zero
            for t in range(T):
                share[t] = trust[t] / total
                squares += share[t] * share[t]
                level, excess = zero, zero
                for c in range(3):
                    level += first_pass[t, row, column, c]
                    excess += residual[t, strip, column, c]
                limit = RESIDUAL_LIMIT * (max(level / np.float32(3), zero) + exposure)
                kept = limit / max(abs(excess / np.float32(3)), limit)
                for c in range(3):
                    held[t, c] = residual[t, strip, column, c] * kept
            samples = one / squares / np.float32(T)
            guides = shared[y, x]
            for c in range(3):
                guides[c] = min(max(albedo[row, column, c], zero), one) if len(albedo) else half
                guides[3 + c] = min(max(normal[row, column, c], -one), one) * half + half if len(normal) else half
            for c in range(3):
                light, noisy_light = zero, zero
                for t in range(T):
                    light += share[t] * first_pass[t, row, column, c]
                    noisy_light += share[t] * (first_pass[t, row, column, c] + held[t, c])
                average[y, x, c] = light
                scale = modulation[row, column, c] * gain
                centre_noise, mean = held[centre, c], zero
                for t in range(T):
                    linear = max((light + centre_noise + trust[t] * (held[t, c] - centre_noise)) * scale, zero)
                    value[0] = linear
                    encoded = on_curve(linear, bits[0], curve)
                    frames[t, y, x, c] = encoded
                    mean += encoded
                value[0] = max(noisy_light * scale, zero)
                pooled = on_curve(value[0], bits[0], curve)
                shift = pooled - mean / np.float32(T)
                for t in range(T):
                    frames[t, y, x, c] += shift
                static[y, x, c] = pooled
                value[0] = max(light * scale, zero)
                shared[y, x, 6 + c] = on_curve(value[0], bits[0], curve)
            for c in range(6):
                static[y, x, 3 + c] = guides[c]
            shared[y, x, 9] = samples
            for t in range(T):
                frames[t, y, x, 3] = trust[t]
