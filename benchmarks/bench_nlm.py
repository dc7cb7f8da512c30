"""What averaging costs: CPU seconds of the functions of ``nlm`` on synthetic frames, peers beside them.

    python benchmarks/bench_nlm.py --size 1920x1080 --repeat 5 --output nlm.json

Everything runs in one thread and is timed in process CPU time, so a busy machine does little harm. Each
function runs once unmeasured, to compile.
"""

from __future__ import annotations

import argparse
import json
import platform
import sys
from collections.abc import Callable
from pathlib import Path

import cv2
import numba
import numpy as np
import skimage
from skimage.restoration import denoise_nl_means

sys.path.insert(0, str(Path(__file__).resolve().parent.parent))

from benchmarks.cpu_time import measure
from nlm.average import average, reject_outliers, robust_average
from nlm.gate import color_gate
from nlm.guided import guided_filter
from nlm.nonlocal_means import joint_nlm
from nlm.variance import prefilter_guide, variance_from_window

FRAMES, FEATURES, SEED = 5, 7, 0


def make_window(height: int, width: int) -> tuple[np.ndarray, np.ndarray, np.ndarray, np.ndarray]:
    """Aligned frames, their guides, confidence and the centre's clean picture."""
    rng = np.random.default_rng(SEED)
    y, x = np.mgrid[:height, :width].astype(np.float32)
    clean = np.stack([np.sin(x / (40 + 20 * c)) * np.cos(y / 60) + 1.5 for c in range(3)], -1)
    window = np.stack([clean * rng.gamma(4, 0.25, clean.shape).astype(np.float32) for _ in range(FRAMES)])
    guide = np.stack([((x // (30 + f) + y // 40) % 2) for f in range(FEATURES)], -1)
    guides = np.stack([guide + rng.normal(0, 0.01, guide.shape).astype(np.float32) for _ in range(FRAMES)])
    confidence = rng.uniform(0.7, 1, (FRAMES, height, width)).astype(np.float32)
    return window, guides, confidence, clean.astype(np.float32)


def run(height: int, width: int, repeat: int) -> dict[str, dict[str, float]]:
    window, guides, confidence, clean = make_window(height, width)
    features = guides[FRAMES // 2]
    estimates = np.repeat(clean[None], FRAMES, axis=0)
    variance = variance_from_window(window, confidence)
    frame = average(window, confidence)
    results: dict[str, dict[str, float]] = {}

    def add(name: str, function: Callable[[], object]) -> None:
        results[name] = measure(function, repeat)
        median, least, most = (results[name][key] for key in ("median", "min", "max"))
        print(f"{name:44} {median:8.3f} CPU-s ({least:.3f} to {most:.3f})", file=sys.stderr)

    def nlm(radius: int) -> Callable[[], object]:
        return lambda: joint_nlm(window, variance, features, confidence=confidence, radius=radius)

    add("average", lambda: average(window, confidence))
    add("robust_average", lambda: robust_average(window, confidence))
    add("reject_outliers", lambda: reject_outliers(window, confidence))
    add("color_gate", lambda: color_gate(estimates, window[FRAMES // 2], 1.0))
    add("variance_from_window", lambda: variance_from_window(window, confidence))
    add("prefilter_guide", lambda: prefilter_guide(guides, confidence))
    for subsample, name in ((1, "full"), (2, "half"), (4, "quarter")):
        add(f"guided_filter {name}", lambda s=subsample: guided_filter(frame, features, radius=8, subsample=s))
    for radius in (1, 3, 5):
        add(f"joint_nlm radius {radius}", nlm(radius))
    offsets = FRAMES * (7**2 - 3**2)
    per_offset = (results["joint_nlm radius 3"]["median"] - results["joint_nlm radius 1"]["median"]) / offsets
    results["joint_nlm per offset"] = {"median": per_offset}

    wide = [np.clip(image * (65535 / 8), 0, 65535).astype(np.uint16) for image in window]
    narrow = [np.clip(image * (255 / 8), 0, 255).astype(np.uint8) for image in window]
    add(
        "cv2.ximgproc.guidedFilter, 3 channels",
        lambda: cv2.ximgproc.guidedFilter(np.ascontiguousarray(features[..., :3]), frame, 8, 0.01),
    )
    add("cv2.fastNlMeansDenoisingMulti u8 7/21", lambda: cv2.fastNlMeansDenoisingMulti(narrow, 2, FRAMES, [8.0]))
    add(
        "cv2.fastNlMeansDenoisingMulti u16 7/21",
        lambda: cv2.fastNlMeansDenoisingMulti(wide, 2, FRAMES, [2000.0], normType=cv2.NORM_L1),
    )
    add(
        "skimage.denoise_nl_means fast 7/10",
        lambda: denoise_nl_means(window[2], patch_size=7, patch_distance=10, h=0.3, channel_axis=-1, fast_mode=True),
    )
    for name in [name for name in results if name.startswith(("robust", "joint_nlm r", "guided"))]:
        for peer in [peer for peer in results if peer.startswith(("cv2", "skimage"))]:
            results[name][f"share of {peer}"] = results[name]["median"] / results[peer]["median"]
    return results


def main(argv: list[str] | None = None) -> int:
    parser = argparse.ArgumentParser(description=__doc__.split("\n")[0] if __doc__ else None)
    parser.add_argument("--size", default="1920x1080", help="WIDTHxHEIGHT")
    parser.add_argument("--repeat", type=int, default=3, help="measured runs of each")
    parser.add_argument("--output", help="JSON file; standard output if not given")
    arguments = parser.parse_args(argv)
    width, height = map(int, arguments.size.split("x"))
    numba.set_num_threads(1)
    cv2.setNumThreads(1)
    report = {
        "size": [width, height],
        "frames": FRAMES,
        "features": FEATURES,
        "seed": SEED,
        "repeat": arguments.repeat,
        "threads": 1,
        "python": platform.python_version(),
        "numpy": np.__version__,
        "numba": numba.__version__,
        "opencv": cv2.__version__,
        "scikit-image": skimage.__version__,
        "machine": platform.processor(),
        "cpu_seconds": run(height, width, arguments.repeat),
    }
    text = json.dumps(report, indent=1)
    if arguments.output:
        with open(arguments.output, "w", encoding="utf-8") as file:
            file.write(text + "\n")
    else:
        print(text)
    return 0


if __name__ == "__main__":
    raise SystemExit(main())
