"""Measure what the functions of `nlm` cost on synthetic frames, peers beside them; JSON on standard output.

    python benchmarks/bench_nlm.py --size 1920x1080 --repeats 5

CPU seconds of the process, after a warm-up: median, least and greatest of the repeats.
"""

from __future__ import annotations

import sys
from collections.abc import Callable
from functools import partial
from pathlib import Path

import cv2
import numpy as np
from skimage.restoration import denoise_nl_means

sys.path.insert(0, str(Path(__file__).resolve().parent.parent))

from benchmarks.cpu_time import arguments, report, size_of
from nlm.average import average, reject_outliers, robust_average
from nlm.gate import color_gate
from nlm.guided import guided_filter
from nlm.nonlocal_means import joint_nlm
from nlm.variance import prefilter_guide, variance_from_window

FRAMES, FEATURES, SEED = 5, 7, 0


def make_window(width: int, height: int) -> tuple[np.ndarray, np.ndarray, np.ndarray, np.ndarray]:
    """Aligned frames, their guides, confidence and the centre's clean picture."""
    rng = np.random.default_rng(SEED)
    y, x = np.mgrid[:height, :width].astype(np.float32)
    clean = np.stack([np.sin(x / (40 + 20 * c)) * np.cos(y / 60) + 1.5 for c in range(3)], -1)
    window = np.stack([clean * rng.gamma(4, 0.25, clean.shape).astype(np.float32) for _ in range(FRAMES)])
    guide = np.stack([((x // (30 + f) + y // 40) % 2) for f in range(FEATURES)], -1)
    guides = np.stack([guide + rng.normal(0, 0.01, guide.shape).astype(np.float32) for _ in range(FRAMES)])
    confidence = rng.uniform(0.7, 1, (FRAMES, height, width)).astype(np.float32)
    return window, guides, confidence, clean.astype(np.float32)


def main(argv: list[str]) -> int:
    options = arguments(__doc__).parse_args(argv)
    window, guides, confidence, clean = make_window(*size_of(options))
    features, noisy = guides[FRAMES // 2], window[FRAMES // 2]
    estimates = np.repeat(clean[None], FRAMES, axis=0)
    variance, frame = variance_from_window(window, confidence), average(window, confidence)
    wide = [np.clip(image * (65535 / 8), 0, 65535).astype(np.uint16) for image in window]
    narrow = [np.clip(image * (255 / 8), 0, 255).astype(np.uint8) for image in window]
    several = cv2.fastNlMeansDenoisingMulti
    nlm = {"patch_size": 7, "patch_distance": 10, "h": 0.3, "channel_axis": -1, "fast_mode": True}
    calls: dict[str, Callable[[], object]] = {
        "average": partial(average, window, confidence),
        "robust_average": partial(robust_average, window, confidence),
        "reject_outliers": partial(reject_outliers, window, confidence),
        "color_gate": partial(color_gate, estimates, noisy, 1.0),
        "variance_from_window": partial(variance_from_window, window, confidence),
        "prefilter_guide": partial(prefilter_guide, guides, confidence),
        **{
            f"guided_filter {name}": partial(guided_filter, frame, features, radius=8, subsample=subsample)
            for subsample, name in ((1, "full"), (2, "half"), (4, "quarter"))
        },
        **{
            f"joint_nlm radius {radius}": partial(joint_nlm, window, variance, features, confidence, radius=radius)
            for radius in (1, 3, 5)
        },
        "cv2.ximgproc.guidedFilter, 3 channels": partial(
            cv2.ximgproc.guidedFilter, np.ascontiguousarray(features[..., :3]), frame, 8, 0.01
        ),
        "cv2.fastNlMeansDenoisingMulti u8 7/21": partial(several, narrow, 2, FRAMES, [8.0]),
        "cv2.fastNlMeansDenoisingMulti u16 7/21": partial(several, wide, 2, FRAMES, [2000.0], normType=cv2.NORM_L1),
        "skimage.denoise_nl_means fast 7/10": partial(denoise_nl_means, noisy, **nlm),
    }
    return report(options, calls.items())


if __name__ == "__main__":
    raise SystemExit(main(sys.argv[1:]))
