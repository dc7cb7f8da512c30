"""Whether the comparison's timing can be trusted: the ratios of methods, measured twice, as JSON.

    python benchmarks/bench_compare.py [--rounds 5] [--crop 160x90] [--methods "aligned average" draft "OIDN high"]

Runs the harness of `ravg compare` two times on three frames of the bundled shot, whatever else the machine does
meanwhile, and compares every method's time over the first method's between the two. "disagreement" is the largest
factor between the two, minus one: 0.1 is 10 %.
"""

from __future__ import annotations

import argparse
import json
import os
import tempfile
from operator import attrgetter
from pathlib import Path

from hybrid.comparison.methods import METHODS
from hybrid.comparison.running import summarize_runs, time_methods
from hybrid.files.exr import read_exr, write_layers
from hybrid.files.frames import open_shot

SHOT = Path(__file__).parent.parent / "examples" / "shot"
FRAMES = (10, 11, 12)


def crop_shot(folder: Path, width: int, height: int) -> None:
    """Write the middle of three frames."""
    for number in FRAMES:
        image = read_exr(SHOT / f"noisy.{number:04d}.exr")
        layers = {layer.name: image.pixels(layer.channels) for layer in image.layers}
        top, left = (180 - height) // 2, (320 - width) // 2
        cut = {name: layer[top : top + height, left : left + width] for name, layer in layers.items()}
        write_layers(folder / f"crop.{number:04d}.exr", cut)


def main(argv: list[str] | None = None) -> int:
    parser = argparse.ArgumentParser(description=__doc__.split("\n")[0])
    parser.add_argument("--rounds", type=int, default=5)
    parser.add_argument("--crop", default="320x180", help="WIDTHxHEIGHT, of 320x180")
    parser.add_argument(
        "--methods", nargs="+", default=["aligned average", "draft", "balanced", "final", "OIDN high"],
    )  # fmt: skip
    options = parser.parse_args(argv)
    width, height = map(int, options.crop.split("x"))
    methods = {name: METHODS[name] for name in options.methods}
    times = []
    with tempfile.TemporaryDirectory() as name:
        folder = Path(name)
        crop_shot(folder, width, height)
        load = os.getloadavg()[0]
        for _ in range(2):
            runs, absent = time_methods(methods, open_shot(folder), options.rounds)
            if absent:
                raise SystemExit(f"absent: {absent}")
            times.append({name: summarize_runs(series) for name, series in runs.items()})
    base = options.methods[0]
    report: dict[str, object] = {
        "rounds": options.rounds,
        "crop": options.crop,
        "load_average_at_start": round(load, 1),
    }
    for clock, figure in (("wall", attrgetter("median")), ("cpu", attrgetter("cpu"))):
        ratios = [{n: figure(t[n]) / figure(t[base]) for n in options.methods[1:]} for t in times]
        report[clock] = {
            "seconds_per_megapixel": [{n: round(figure(t[n]), 3) for n in options.methods} for t in times],
            "ratios": [{n: round(r, 3) for n, r in ratio.items()} for ratio in ratios],
            "disagreement": round(
                max(max(a / b, b / a) for a, b in zip(*(r.values() for r in ratios), strict=True)) - 1, 3
            ),
        }
    print(json.dumps(report, indent=1))
    return 0


if __name__ == "__main__":
    raise SystemExit(main())
