"""Whether --max-memory is kept at 3840×2160, and that the result does not depend on it.

    python benchmarks/bench_memory.py [--commands "denoise --preset draft"] [--limits 6G 8G] [--repeat 12]
        [--frames 3]

The bundled shot is tiled to 3840×2160, and its third frame is denoised with each limit, and with none, in a process of
its own. With `--frames 1-5` all are, as in a chunk of a farm: a frame is read and one is written meanwhile. Peak memory
is the operating system's count of that process. The exit code is 1 where a limit was broken, or where the pictures
differ by more than 1e-5 of their mean.
"""

from __future__ import annotations

import argparse
import json
import subprocess
import sys
import tempfile
from pathlib import Path

import numpy as np

sys.path.insert(0, str(Path(__file__).resolve().parent.parent))

from hybrid.files.exr import read_exr
from hybrid.memory import parse_size
from hybrid.records import read_records
from tests.exr_files import write_layers

SHOT = Path(__file__).parent.parent / "examples" / "shot"
FRAMES = 5


def tile_shot(folder: Path, repeat: int) -> None:
    """Write five frames of the bundled shot, each tiled, as float32: half would hide or magnify small differences."""
    for number, path in enumerate(sorted(SHOT.glob("noisy.*.exr"))[:FRAMES], start=1):
        image = read_exr(path)
        layers = {layer.name: np.tile(image.pixels(layer.channels), (repeat, repeat, 1)) for layer in image.layers}
        write_layers(folder / f"tiled.{number:04d}.exr", layers, half=False)


def run(command: str, frames: str, folder: Path, out: Path, limit: str | None) -> dict[str, object]:
    """Run a command; its peak memory, or why it refused."""
    first, *rest = command.split()
    words = [
        sys.executable,
        "-m",
        "hybrid.cli",
        first,
        str(folder / "tiled.####.exr"),
        "-o",
        str(out),
        "--frames",
        frames,
        *rest,
    ]
    done = subprocess.run([*words, *(["--max-memory", limit] if limit else [])], capture_output=True, text=True)
    if done.returncode == 1 and "max-memory" in done.stderr:
        return {"refused": done.stderr.strip().splitlines()[-1]}
    if done.returncode != 0:
        raise RuntimeError(done.stderr)
    *_, (_, report) = read_records(out)
    seconds = sum(stage["cpu_seconds"] for stage in report["stages"].values())
    return {"peak_gib": round(report["peak_bytes"] / 2**30, 2), "cpu_seconds": round(seconds, 1)}


def main(argv: list[str] | None = None) -> int:
    parser = argparse.ArgumentParser(description=__doc__.split("\n")[0])
    parser.add_argument("--commands", nargs="+", default=["denoise --preset draft", "denoise --first-pass none"])
    parser.add_argument("--limits", nargs="*", default=["8G", "6G", "4G"])
    parser.add_argument("--frames", default="3", help="of the five that there are, the third among them")
    parser.add_argument(
        "--repeat", type=int, default=12, help="tiles along each side: 12 for 3840×2160, 6 for 1920×1080"
    )
    parser.add_argument("--json", type=Path, help="write the result there too")
    options = parser.parse_args(argv)
    results, kept = [], True
    with tempfile.TemporaryDirectory() as name:
        folder = Path(name)
        tile_shot(folder, options.repeat)
        for command in options.commands:
            whole = None
            for limit in (None, *options.limits):
                out = folder / "out"
                result = {
                    "command": command,
                    "size": f"{320 * options.repeat}x{180 * options.repeat}",
                    "limit": limit,
                    "frames": options.frames,
                    **run(command, options.frames, folder, out, limit),
                }
                if "peak_gib" in result:
                    image = read_exr(out / "tiled.0003.exr")
                    color = image.pixels(image.layer("ViewLayer.Combined").channels[:3])
                    whole = color if whole is None else whole
                    result["difference"] = float(np.abs(color - whole).max() / whole.mean())
                    result["kept"] = limit is None or float(str(result["peak_gib"])) * 2**30 <= parse_size(limit)
                    kept = kept and bool(result["kept"]) and result["difference"] <= 1e-5
                results.append(result)
                print(json.dumps(result), flush=True)
    if options.json is not None:
        options.json.write_text(json.dumps(results, indent=2) + "\n", encoding="utf-8")
    return 0 if kept else 1


if __name__ == "__main__":
    raise SystemExit(main())
