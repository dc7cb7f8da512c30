"""Accuracy and stability of presets and of OIDN on shots at several numbers of samples, as JSON, table and chart.

    python benchmarks/ladder.py FOLDER [FOLDER ...] -o ladder.json [--methods oidn-best balanced] [--chart ladder.png]

A folder holds LEVEL.####.exr, or several levels of a shot, and reference_a.####.exr and reference_b.####.exr, two
independent renders of the frames to judge, as `ravg simulate --levels s008=8,s032=32 --second-reference` writes them.
Frames without a reference serve as neighbours. Figures are PSNR and temporal PSNR (at most 65 dB, where the noise of
references begins) on x / (1 + x), means over the frames, and CPU seconds a frame. Figures that are in the JSON file
already are kept.
"""

import argparse
import json
import re
import sys
import tempfile
import time
from collections.abc import Iterator
from itertools import pairwise
from pathlib import Path

import numpy as np

sys.path.insert(0, str(Path(__file__).resolve().parent.parent))

from hybrid.comparison.evaluation import motion_between
from hybrid.comparison.metrics import psnr, temporal_psnr
from hybrid.denoising.oidn import denoise_oidn
from hybrid.files.frame import Array
from hybrid.files.shots import Shot
from ravg import denoise_shot, open_shot

OIDN = {"oidn-high": None, "oidn-best": "high"}
# Networks and averages from noisy frames alone, by the options of `denoise_shot`.
NOISY_ALONE: dict[str, dict[str, str]] = {
    "final": {"method": "classical", "preset": "final"},
    "ra": {"weights": "ra"},
    "tkpcn": {"weights": "tkpcn"},
}
PRESETS = ("fast", "balanced", "quality")
METHODS = ("noisy", *OIDN, *PRESETS, *NOISY_ALONE)
MOST = 65.0


def denoise(shot: Shot, method: str, **options: object) -> list[Array]:
    """The frames of a shot by a method or a file of weights; options are those of `denoise_shot`."""
    frames = [shot.read(number) for number in shot.numbers]
    if method == "noisy":
        return [frame.color for frame in frames]
    if method == "given":
        return [frame.estimate for frame in frames]  # type: ignore
    if method in OIDN:
        return [denoise_oidn(f.color, f.albedo, f.normal, prefilter=OIDN[method]) for f in frames]  # type: ignore
    chosen = NOISY_ALONE.get(method, {"weights" if method.endswith(".safetensors") else "preset": method})
    with tempfile.TemporaryDirectory() as folder:
        pattern = f"{folder}/frame.####.exr"
        list(denoise_shot(shot, pattern, **chosen, **options))  # type: ignore
        made = open_shot(pattern)
        frames = [made.read(number) for number in shot.numbers]
    # Files that keep the noisy image beside the denoised one are read as it.
    return [frame.color if frame.estimate is None else frame.estimate for frame in frames]


def levels(folder: Path) -> Iterator[str]:
    """Names of the levels of a shot."""
    found = {re.sub(r"\.-?\d+\.exr$", "", path.name) for path in folder.glob("*.exr")}
    yield from sorted(name for name in found if not name.startswith("reference"))


class Truth:
    """Two references of the frames of a shot that are judged, and the motion between its frames."""

    def __init__(self, folder: Path) -> None:
        self.folder = folder
        halves = [open_shot(f"{folder}/reference_{half}.####.exr") for half in "ab"]
        self.numbers = halves[0].numbers
        self.references = [(halves[0].read(number).color, halves[1].read(number).color) for number in self.numbers]

    def shot(self, level: str) -> Shot:
        """The frames of a level that have references."""
        return open_shot(f"{self.folder}/{level}.####.exr", frames=f"{self.numbers[0]}-{self.numbers[-1]}")

    def frames(self, images: list[Array]) -> list[float]:
        """PSNR of each image, dB."""
        return [round(float(min(psnr(*pair), MOST)), 3) for pair in zip(images, self.references, strict=True)]

    def judge(self, shot: Shot, images: list[Array]) -> list[float]:
        """PSNR of the images of a shot, and temporal PSNR where there are vectors: means over the frames, dB."""
        figures = [np.mean(self.frames(images))]
        frames = [shot.read(number) for number in shot.numbers]
        motion = [motion_between(*pair) for pair in pairwise(frames)]
        if motion and None not in motion:
            flows, valid = zip(*motion, strict=True)
            figures.append(np.mean(np.minimum(temporal_psnr(images, self.references, flows, valid), MOST)))
        return [round(float(figure), 3) for figure in figures]


def judge(folder: Path, methods: list[str], results: dict[str, list[float]], out: Path) -> None:
    """Add the figures of a shot to the results, and write these after each method."""
    truth = Truth(folder)
    for level in levels(folder):
        shot = truth.shot(level)
        for method in methods:
            if (key := f"{folder.name} {level} {method}") in results:
                continue
            begun = time.process_time()
            images = denoise(shot, method)
            seconds = (time.process_time() - begun) / len(images)
            results[key] = [*truth.judge(shot, images), round(seconds, 2)]
            out.write_text(json.dumps(results, indent=0), encoding="utf-8")
            print(key, *results[key], flush=True)


def medians(results: dict[str, list[float]]) -> dict[str, float]:
    """CPU seconds a frame of each method, the median of all shots and levels."""
    methods = dict.fromkeys(key.split(" ")[2] for key in results)
    return {m: float(np.median([v[-1] for key, v in results.items() if key.endswith(f" {m}")])) for m in methods}


def table(results: dict[str, list[float]]) -> str:
    """Means of each level and method, in Markdown."""
    rows = [key.split(" ") for key in results]
    names = list(dict.fromkeys(level for _, level, _ in rows))
    lines = ["| method | " + " | ".join(names) + " | CPU time |", "|---" * (len(names) + 2) + "|"]
    for method in dict.fromkeys(method for *_, method in rows):
        cells = []
        for level in names:
            figures = [v[:-1] for key, v in results.items() if key.endswith(f" {level} {method}")]
            cells.append(" / ".join(f"{np.mean(column):.2f}" for column in zip(*figures, strict=True)))
        cells.append(f"{medians(results)[method]:.2f} s")
        lines.append(f"| {method} | " + " | ".join(cells) + " |")
    return "\n".join(lines)


def draw(results: dict[str, list[float]], seconds: dict[str, float], path: Path) -> None:
    """Draw both figures against the samples that names of levels end with, such as s032, and PSNR against CPU time.

    `seconds` are CPU seconds a frame of each method; those without any are left out of the third chart.
    """
    import matplotlib

    matplotlib.use("svg")
    from matplotlib import pyplot

    _, axes = pyplot.subplots(1, 3, figsize=(13, 3.4), layout="constrained")
    for axis in axes[:2]:
        axis.set_xscale("log")  # sets ticks of its own
    for method in dict.fromkeys(key.split(" ")[2] for key in results):
        points: dict[int, list[list[float]]] = {}
        for key, figures in results.items():
            _, level, name = key.split(" ")
            if name == method:
                points.setdefault(int(level.lstrip("s")), []).append(figures)
        style = ":" if method == "noisy" else "--" if method in OIDN else "-"
        for index, axis in enumerate(axes[:2]):
            means = [np.mean([figures[index] for figures in shots]) for shots in points.values()]
            axis.plot(list(points), means, style, marker=".", label=method)
            axis.set_xticks(sorted(points), [str(count) for count in sorted(points)], minor=False)
        if method in seconds:
            accuracy = np.mean([figures[0] for shots in points.values() for figures in shots])
            (line,) = axes[0].lines[-1:]
            axes[2].plot(seconds[method], accuracy, "o", color=line.get_color())
            axes[2].annotate(method, (seconds[method], accuracy), xytext=(5, 4), textcoords="offset points", fontsize=8)
    for axis, title in zip(axes, ("PSNR, dB", "temporal PSNR, dB", "PSNR, dB, mean of all levels"), strict=True):
        axis.set(xlabel="samples per pixel", title=title)
        axis.minorticks_off()
        axis.grid(alpha=0.3)
    axes[2].margins(0.15)
    axes[2].set(xlabel="CPU seconds a frame", xlim=(0, None))
    axes[0].legend(frameon=False, fontsize=8)
    pyplot.savefig(path, dpi=110)


def main() -> int:
    parser = argparse.ArgumentParser(description=__doc__.split("\n")[0])
    parser.add_argument("folders", nargs="+", type=Path)
    parser.add_argument("-o", "--output", type=Path, required=True, help="JSON, continued if it is there")
    parser.add_argument("--methods", nargs="+", choices=METHODS, default=["noisy", *OIDN, *PRESETS])
    parser.add_argument("--chart", type=Path)
    options = parser.parse_args()
    results = json.loads(options.output.read_text(encoding="utf-8")) if options.output.exists() else {}
    for folder in options.folders:
        judge(folder, options.methods, results, options.output)
    print(table(results))
    if options.chart:
        draw(results, medians(results), options.chart)
    return 0


if __name__ == "__main__":
    raise SystemExit(main())
