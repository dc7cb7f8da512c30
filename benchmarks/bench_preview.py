"""Seconds and bytes of previews of a long shot at film size, as JSON.

    python benchmarks/bench_preview.py [--frames 100] [--names a.mp4 a.webp sheet.png]

The bundled shot is tiled 6×6 to 1920×1080; its noisy frames stand for the denoised ones too, which takes the longest:
noise is what video compresses worst. Beside the wall time stand the CPU time of the process and that of reading
the frames alone, since nothing can be shown of files that were not read.
"""

from __future__ import annotations

import argparse
import json
import shutil
import sys
import tempfile
import time
from pathlib import Path

sys.path.insert(0, str(Path(__file__).resolve().parent.parent))

from benchmarks.bench_shot import tile_shot
from hybrid.files.frames import open_shot
from hybrid.preview import write_contact_sheet, write_preview

# The bundled shot there and back; a longer one shows the same files again.
PERIOD = 12


def main(argv: list[str] | None = None) -> int:
    parser = argparse.ArgumentParser(description=__doc__.split("\n")[0])
    parser.add_argument("--frames", type=int, default=100)
    parser.add_argument("--names", nargs="+", default=["a.mp4", "a.webp", "sheet.png"])
    options = parser.parse_args(argv)
    with tempfile.TemporaryDirectory() as name:
        noisy, denoised = Path(name) / "noisy", Path(name) / "denoised"
        noisy.mkdir()
        tile_shot(noisy, PERIOD)
        shutil.copytree(noisy, denoised)
        for folder in (noisy, denoised):
            for number in range(PERIOD + 1, options.frames + 1):
                (folder / f"tiled.{number:04d}.exr").symlink_to(f"tiled.{(number - 1) % PERIOD + 1:04d}.exr")
        shot = open_shot(noisy, frames=f"1-{options.frames}", keep=0)
        wall, cpu = time.perf_counter(), time.process_time()
        for number in shot.numbers[:PERIOD]:
            shot.read_color(number)
        pairs = PERIOD / 2  # two files are read for a frame of a preview
        reading = {"wall": (time.perf_counter() - wall) / pairs, "cpu": (time.process_time() - cpu) / pairs}
        for target in (Path(name) / wanted for wanted in options.names):
            wall, cpu = time.perf_counter(), time.process_time()
            (write_contact_sheet if target.suffix == ".png" else write_preview)(shot, denoised, target)
            wall, cpu = time.perf_counter() - wall, time.process_time() - cpu
            result = {
                "preview": target.name,
                "frames": options.frames,
                "seconds_per_frame": round(wall / options.frames, 3),
                "cpu_seconds_per_frame": round(cpu / options.frames, 3),
                "of_it_reading": {clock: round(seconds, 3) for clock, seconds in reading.items()},
                "megabytes": round(target.stat().st_size / 1e6, 2),
            }
            print(json.dumps(result), flush=True)
    return 0


if __name__ == "__main__":
    raise SystemExit(main())
