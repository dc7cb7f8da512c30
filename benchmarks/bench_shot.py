"""Seconds and peak memory of whole runs at film size, as JSON.

    python benchmarks/bench_shot.py [--frames 6] [--commands "pseudoref --preset standard" "denoise"]

The bundled shot is tiled 6×6 to 1920×1080 (its motion is then that of a film frame, with seams in it), and each command
runs on it in a process of its own, as a user would run it. Peak memory is the operating system's count.
"""

from __future__ import annotations

import argparse
import json
import resource
import subprocess
import sys
import tempfile
from pathlib import Path

import numpy as np

from hybrid.files.exr import read_exr, write_layers
from hybrid.records import read_records

SHOT = Path(__file__).parent.parent / "examples" / "shot"
REPEAT = 6


def tile_shot(folder: Path, frames: int) -> None:
    """Write the bundled shot, each frame tiled; after its seven frames it runs backwards, and so on."""
    paths = sorted(SHOT.glob("noisy.*.exr"))
    order = [*range(len(paths)), *range(len(paths) - 2, 0, -1)]
    for number in range(frames):
        image = read_exr(paths[order[number % len(order)]])
        layers = {layer.name: np.tile(image.pixels(layer.channels), (REPEAT, REPEAT, 1)) for layer in image.layers}
        write_layers(folder / f"tiled.{number + 1:04d}.exr", layers)


def main(argv: list[str] | None = None) -> int:
    parser = argparse.ArgumentParser(description=__doc__.split("\n")[0])
    parser.add_argument("--frames", type=int, default=6)
    parser.add_argument("--commands", nargs="+", default=["pseudoref --preset standard", "denoise"])
    options = parser.parse_args(argv)
    with tempfile.TemporaryDirectory() as name:
        folder = Path(name)
        tile_shot(folder, options.frames)
        for command in options.commands:
            first, *rest = command.split()
            out = folder / "out"
            words = [sys.executable, "-m", "hybrid.cli", first, str(folder / "tiled.####.exr"), "-o", str(out), *rest]
            before = resource.getrusage(resource.RUSAGE_CHILDREN)
            subprocess.run(words, check=True, stderr=subprocess.DEVNULL)
            after = resource.getrusage(resource.RUSAGE_CHILDREN)
            *_, (_, report) = read_records(out)
            stages = {
                stage: {
                    "seconds": round(cost["seconds"] / options.frames, 3),
                    "cpu_seconds": round(cost["cpu_seconds"] / options.frames, 3),
                    "peak_mib": round(cost["peak_bytes"] / 2**20),
                }
                for stage, cost in report["stages"].items()
            }
            cpu = after.ru_utime + after.ru_stime - before.ru_utime - before.ru_stime
            result = {
                "command": command,
                "frames": options.frames,
                "size": "1920x1080",
                "peak_mib": round(report["peak_bytes"] / 2**20),
                "cpu_seconds_per_frame_with_start": round(cpu / options.frames, 2),
                "per_frame": stages,
            }
            print(json.dumps(result))
    return 0


if __name__ == "__main__":
    raise SystemExit(main())
