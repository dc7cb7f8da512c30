"""Measure what functions of `flow`, `nlm` and `network`, and OIDN, cost on synthetic frames; JSON on standard output.

    OMP_WAIT_POLICY=PASSIVE python benchmarks/bench_functions.py --only flow nlm --size 1920x1080 --threads 1

CPU seconds of the process, after a warm-up: median, least and greatest of the repeats. Beside `nlm` stand functions of
OpenCV and scikit-image, beside OIDN its networks in torch, in float32 and bfloat16. Parts of networks are measured in
inference at the size of its tiles, and in training at the size of its crops.
"""

from __future__ import annotations

import argparse
import json
import os
import platform
import statistics
import subprocess
import sys
import time
from collections.abc import Callable, Iterator
from functools import partial
from importlib.metadata import version
from itertools import chain
from pathlib import Path

import cv2
import numba
import numpy as np
import torch
from skimage.restoration import denoise_nl_means
from torch import Tensor

sys.path.insert(0, str(Path(__file__).resolve().parent.parent))

from flow.confidence import estimate_confidence, mix_centre
from flow.guide import make_guide, pair_guides
from flow.motion import CYCLES, compose_flow, forward_backward_error, invert_flow, normalize_motion
from flow.selection import select_flow
from flow.tvl1 import dense_flow, refine_flow
from flow.warp import warp
from hybrid.oidn import denoise_oidn
from hybrid.runtime.allocator import reuse_freed_memory
from network.bfloat16 import round_unet
from network.oidn_weights import load_oidn
from network.paper.blocks import RobustAverage
from network.paper.kernels import apply_kernels, predict_kernel, threshold_kernel
from network.paper.models import for_inference as prepare_kernels
from network.presets import PRESETS, build_preset
from network.robust_average import ravg
from network.robust_unet import RobustUNet, channels_last, for_inference
from network.training.clips import Sample
from network.training.config import TrainConfig
from network.training.loop import batch_loss, predict
from network.training.losses import relmse
from network.unet import denoise_color
from nlm.average import average, reject_outliers, robust_average
from nlm.gate import color_gate
from nlm.guided import guided_filter
from nlm.nonlocal_means import joint_nlm
from nlm.variance import prefilter_guide, variance_from_window

PACKAGES = ("numpy", "numba", "opencv-contrib-python-headless", "scikit-image", "torch")
FRAMES, FEATURES = 5, 7
#: Networks of OIDN, with its quality, and whether guides are declared clean.
OIDN = {
    "rt_hdr_alb_nrm_small": ("fast", False),
    "rt_hdr_alb_nrm": ("high", False),
    "rt_hdr_calb_cnrm": ("balanced", True),
    "rt_hdr_calb_cnrm_large": ("high", True),
}
Calls = Iterator[tuple[str, Callable[[], object]]]


def flow_calls(options: argparse.Namespace) -> Calls:
    """Yield the stages of `flow` on a textured frame and its neighbour, which moves smoothly by a few pixels."""
    rng, (height, width) = np.random.default_rng(0), options.shape
    noise = rng.normal(size=(height, width, 3)).astype(np.float32)
    albedo = np.clip(0.5 + 0.3 * sum(cv2.GaussianBlur(noise, (0, 0), s) * s for s in (1, 3, 9)), 0, 1)
    y, x = np.mgrid[:height, :width].astype(np.float32)
    flow = np.stack([3 + 0.002 * (x - width / 2), -2 + 0.002 * (y - height / 2)], axis=-1)
    neighbour = warp(albedo, -flow)[0]
    color, other = (a * rng.gamma(4, 0.25, a.shape).astype(np.float32) for a in (albedo, neighbour))
    normal = np.dstack([np.zeros_like(albedo[..., :2]), np.ones_like(x)])
    guides = pair_guides(make_guide(color, albedo, exposure=0.5), make_guide(other, neighbour, exposure=0.5))
    luminance = pair_guides(make_guide(color, exposure=0.5), make_guide(other, exposure=0.5))
    start = flow + rng.normal(size=flow.shape).astype(np.float32)
    stack, vectors = np.dstack([color, albedo, normal, color[..., :1]]), np.dstack([-flow * [1, -1], flow * [-1, 1]])
    warped, inside = warp(albedo, flow)
    layers = {"inside": inside, "reverse": -flow, "albedo": albedo, "other_albedo": albedo}
    yield "normalize_motion", partial(normalize_motion, vectors, CYCLES)
    yield "compose_flow", partial(compose_flow, flow, flow)
    yield "invert_flow", partial(invert_flow, flow)
    yield "forward_backward_error", partial(forward_backward_error, flow, -flow)
    yield "warp bilinear 3", partial(warp, color, flow)
    yield "warp bilinear 10", partial(warp, stack, flow)
    yield "warp bicubic 10", partial(warp, stack, flow, interpolation="bicubic")
    yield "make_guide", partial(make_guide, color, albedo, exposure=0.5)
    for steps, settings in {"3/3/30": {}, "2/2/15": {"scales": 2, "warps": 2, "iterations": 15}}.items():
        yield f"refine_flow {steps}", partial(refine_flow, luminance, start, **settings)
        yield f"refine_flow {steps}, 2 guides", partial(refine_flow, guides, start, **settings)
    yield "select_flow", partial(select_flow, [flow, start], guides)
    yield "dense_flow", partial(dense_flow, guides)
    yield "estimate_confidence", partial(estimate_confidence, flow, normal=normal, other_normal=normal, **layers)
    yield "mix_centre", partial(mix_centre, warped, albedo, inside.astype(np.float32))


def nlm_calls(options: argparse.Namespace) -> Calls:
    """Yield the functions of `nlm` on aligned noisy frames, and those of other libraries."""
    rng, (height, width) = np.random.default_rng(0), options.shape
    y, x = np.mgrid[:height, :width].astype(np.float32)
    clean = np.stack([np.sin(x / (40 + 20 * c)) * np.cos(y / 60) + 1.5 for c in range(3)], -1).astype(np.float32)
    window = np.stack([clean * rng.gamma(4, 0.25, clean.shape).astype(np.float32) for _ in range(FRAMES)])
    guide = np.stack([((x // (30 + f) + y // 40) % 2) for f in range(FEATURES)], -1)
    guides = np.stack([guide + rng.normal(0, 0.01, guide.shape).astype(np.float32) for _ in range(FRAMES)])
    confidence = rng.uniform(0.7, 1, (FRAMES, height, width)).astype(np.float32)
    features, noisy, estimates = guides[FRAMES // 2], window[FRAMES // 2], np.repeat(clean[None], FRAMES, axis=0)
    variance, frame = variance_from_window(window, confidence), average(window, confidence)
    wide = [np.clip(image * (65535 / 8), 0, 65535).astype(np.uint16) for image in window]
    narrow = [np.clip(image * (255 / 8), 0, 255).astype(np.uint8) for image in window]
    yield "average", partial(average, window, confidence)
    yield "robust_average", partial(robust_average, window, confidence)
    yield "reject_outliers", partial(reject_outliers, window, confidence)
    yield "color_gate", partial(color_gate, estimates, noisy, 1.0)
    yield "variance_from_window", partial(variance_from_window, window, confidence)
    yield "prefilter_guide", partial(prefilter_guide, guides, confidence)
    for subsample, name in ((1, "full"), (2, "half"), (4, "quarter")):
        yield f"guided_filter {name}", partial(guided_filter, frame, features, radius=8, subsample=subsample)
    for radius in (1, 3, 5):
        yield f"joint_nlm radius {radius}", partial(joint_nlm, window, variance, features, confidence, radius=radius)
    three, several = np.ascontiguousarray(features[..., :3]), cv2.fastNlMeansDenoisingMulti
    yield "cv2.ximgproc.guidedFilter, 3 channels", partial(cv2.ximgproc.guidedFilter, three, frame, 8, 0.01)
    yield "cv2.fastNlMeansDenoisingMulti u8 7/21", partial(several, narrow, 2, FRAMES, [8.0])
    yield (
        "cv2.fastNlMeansDenoisingMulti u16 7/21",
        partial(several, wide, 2, FRAMES, [2000.0], normType=cv2.NORM_L1),
    )
    settings = {"patch_size": 7, "patch_distance": 10, "h": 0.3, "channel_axis": -1, "fast_mode": True}
    yield "skimage.denoise_nl_means fast 7/10", partial(denoise_nl_means, noisy, **settings)


def oidn_calls(options: argparse.Namespace) -> Calls:
    """Yield OIDN's modes, by itself and by its networks in torch."""
    rng, shape = np.random.default_rng(0), (*options.shape, 3)
    images = [rng.random(shape, np.float32) for _ in range(3)]
    layers = [torch.from_numpy(image).permute(2, 0, 1)[None] for image in images]
    for name, (quality, clean) in OIDN.items():
        exact = load_oidn(name)
        yield f"{name}, OIDN", partial(denoise_oidn, *images, quality=quality, clean=clean)
        yield f"{name}, float32", partial(denoise_color, exact, *layers, exposure=1.0)
        yield f"{name}, bfloat16", partial(denoise_color, round_unet(exact), *layers, exposure=1.0)


def training(function: Callable[[Tensor], Tensor | tuple[Tensor, ...]], x: Tensor) -> None:
    y = function(x.detach().requires_grad_())
    (y if isinstance(y, Tensor) else y[0]).sum().backward()


def network_calls(options: argparse.Namespace) -> Calls:
    """Yield parts of networks on random tensors, and whole networks of the presets."""
    for size, mode, name in ((options.tile, torch.no_grad()(lambda f, x: f(x)), ""), (128, training, ", training")):
        x = torch.randn(5, 32, size // 2, size // 2).bfloat16().contiguous(memory_format=torch.channels_last)
        block = RobustAverage(32).bfloat16().to(memory_format=torch.channels_last)
        yield f"ravg of four{name}", partial(mode, lambda x: ravg(list(x.chunk(5))[:4]), x)
        yield f"RA block{name}", partial(mode, lambda x, block=block: block(x, 5), x)
        weights, frames = torch.rand(1, 125, size, size), torch.rand(1, 5, 3, size, size)
        yield f"predict_kernel{name}", partial(mode, partial(predict_kernel, centre=62), weights)
        yield f"threshold_kernel{name}", partial(mode, partial(threshold_kernel, centre=62), weights)
        yield f"apply_kernels{name}", partial(mode, lambda x, f=frames: apply_kernels(x, f), weights)
    for name in options.presets:
        for bfloat16 in (False, True):
            model = build_preset(name)
            model = (for_inference if isinstance(model, RobustUNet) else prepare_kernels)(model, bfloat16)
            run = partial(torch.no_grad()(predict), model, batch_of(1, options.tile, model.frames))
            yield f"{name}, {'bfloat16' if bfloat16 else 'float32'}", run
        for count in (1, 2):
            model = channels_last(build_preset(name))
            loss = partial(batch_loss, model, batch_of(count, 128, model.frames), TrainConfig(steps=1), relmse)
            yield f"{name}, training, batch of {count}", lambda loss=loss: loss().backward()


def batch_of(count: int, size: int, frames: int) -> Sample:
    """Return samples of noise."""
    window, image = torch.rand(count, frames, 3, size, size), torch.rand(count, 3, size, size)
    one = torch.ones(count)
    return Sample(*[window] * 5, window[:, :, :1], *[image] * 3, one, one, image[:, :2], image, one)


def measure(function: Callable[[], object], repeats: int) -> dict[str, float]:
    """Return median, least and most CPU seconds of a call, after one to warm up (which compiles)."""
    function()
    seconds = []
    for _ in range(repeats):
        start = time.process_time()
        function()
        seconds.append(time.process_time() - start)
    return {"median": statistics.median(seconds), "min": min(seconds), "max": max(seconds)}


PARTS = {"flow": flow_calls, "nlm": nlm_calls, "oidn": oidn_calls, "network": network_calls}


def main(argv: list[str]) -> int:
    parser = argparse.ArgumentParser(description=__doc__.split("\n")[0])
    parser.add_argument("--only", nargs="+", choices=PARTS, default=[*PARTS])
    parser.add_argument("--size", default="1920x1080", help="WIDTHxHEIGHT of a frame, for flow, nlm and oidn")
    parser.add_argument("--tile", type=int, default=256, help="pixels on a side of networks' tiles")
    parser.add_argument("--presets", nargs="*", choices=PRESETS, default=["fast"], help="paper takes a minute")
    parser.add_argument("--threads", type=int, default=1)
    parser.add_argument("--repeats", type=int, default=5, help="measured runs of each")
    options = parser.parse_args(argv)
    facts = {**vars(options), "machine": platform.processor() or platform.machine()}
    facts |= {package: version(package) for package in PACKAGES}
    facts["commit"] = subprocess.run(["git", "rev-parse", "HEAD"], capture_output=True, text=True).stdout.strip()
    options.shape = tuple(map(int, options.size.split("x")))[::-1]
    reuse_freed_memory()  # as the commands do
    os.environ["OIDN_NUM_THREADS"] = str(options.threads)
    cv2.setNumThreads(options.threads)
    torch.set_num_threads(options.threads)
    numba.set_num_threads(min(options.threads, numba.get_num_threads()))
    results = {}
    for name, call in chain.from_iterable(PARTS[part](options) for part in options.only):
        results[name] = measure(call, options.repeats)
        print(f"{name:44} {results[name]['median']:8.3f} CPU-s", file=sys.stderr)
    print(json.dumps({**facts, "cpu_seconds": results}, indent=2))
    return 0


if __name__ == "__main__":
    sys.exit(main(sys.argv[1:]))
