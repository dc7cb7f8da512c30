"""CPU seconds and peak memory of whole processes at film size, beside OIDN's in the same run, as JSON.

    python benchmarks/bench_shot.py [--shots pan busy] [--frames 10] [--scale 4] [--commands "denoise --preset fast"]
    python benchmarks/bench_shot.py --write FOLDER    # the shots alone

Shots are made of the bundled one, which runs to and fro:

- *pan*: the clean frames enlarged, 1920×1080 at scale 4, with the noise of the noisy frames laid on anew in each, pixel
  by pixel. Vectors are enlarged and hold.
- *busy*: the same with a textured disc that flies through with the vectors of what is behind it, a shadow with a soft
  edge that moves, and noise in a part of the guides: refinement, gate and prefilter are called for.
- *tiled*: the noisy frames tiled, with seams in the motion.

Each command runs in a process of its own, as a user would run it; so does OIDN (`--oidn`), which reads the same
files, takes the guides as they are (*high*) or filters them first (*best*), and writes with the same code. Peak
memory is the operating system's count.
"""

import argparse
import json
import os
import subprocess
import sys
import tempfile
import time
from collections.abc import Sequence
from pathlib import Path

import cv2
import numpy as np

sys.path.insert(0, str(Path(__file__).resolve().parent.parent))

from hybrid.files.exr import read_exr
from hybrid.files.shots import open_shot, output_path
from hybrid.run.records import read_records
from tests.exr_files import write_layers

SHOT = Path(__file__).parent.parent / "examples" / "shot"
REPEAT = 4
VIEW = "ViewLayer"
SHOTS = ("pan", "busy", "tiled")
PREFILTERS = {"high": None, "best": "high"}


def tile_shot(folder: Path, frames: int, scale: int = REPEAT) -> None:
    """Write the bundled shot, each frame tiled; after its seven frames it runs backwards, and so on."""
    paths = sorted(SHOT.glob("noisy.*.exr"))
    for number, (index, *around) in enumerate(_to_and_fro(len(paths), frames), start=1):
        layers = _read(paths[index])
        layers[f"{VIEW}.Vector"] = _vectors(layers[f"{VIEW}.Vector"], index, around)
        tiled = {name: np.tile(layer, (scale, scale, 1)) for name, layer in layers.items()}
        write_layers(folder / f"tiled.{number:04d}.exr", tiled)


def enlarge_shot(folder: Path, frames: int, scale: int = REPEAT, *, busy: bool = False) -> None:
    """Write the bundled shot enlarged, with noise of the size of a pixel; `busy`: with what vectors do not explain."""
    clean = sorted(SHOT.glob("reference_a.*.exr"))
    noisy = [SHOT / path.name.replace("reference_a", "noisy") for path in clean]
    for number, (index, *around) in enumerate(_to_and_fro(len(noisy), frames), start=1):
        random = np.random.default_rng(number)
        small = _read(noisy[index])
        color, reference = small[f"{VIEW}.Combined"][..., :3], _read(clean[index])[f"{VIEW}.Combined"][..., :3]
        # Relative to the light; the floor, a fiftieth of the mean, keeps black from lending its noise to white.
        floor = np.float32(0.02 * reference.mean())
        noise = np.tile((color - reference) / (reference + floor), (scale, scale, 1))
        noise = np.roll(noise, tuple(random.integers(0, size) for size in color.shape[:2]), axis=(0, 1))
        layers = {name: _enlarge(layer, scale) for name, layer in small.items()}
        light = np.maximum(_enlarge(reference, scale), 0)
        layers[f"{VIEW}.Vector"] = scale * _vectors(layers[f"{VIEW}.Vector"], index, around)
        if busy:
            _disturb(layers, light, number, scale, random)
        light = np.maximum(light + noise * (light + floor), 0)
        layers[f"{VIEW}.Combined"] = np.dstack([light, layers[f"{VIEW}.Combined"][..., 3]])
        write_layers(folder / f"{'busy' if busy else 'pan'}.{number:04d}.exr", layers)


def _to_and_fro(count: int, frames: int) -> list[tuple[int, int, int]]:
    """The file that each frame shows, and those that the frames before and after it show."""
    order = [*range(count), *range(count - 2, 0, -1)]
    shown = [order[number % len(order)] for number in range(-1, frames + 1)]
    return list(zip(shown[1:-1], shown[:-2], shown[2:], strict=True))


def _vectors(vectors: np.ndarray, index: int, around: Sequence[int]) -> np.ndarray:
    """Blender's Vector of a frame whose neighbours are not those it was rendered between."""
    to_before, to_after = vectors[..., :2], -vectors[..., 2:]
    before, after = (to_after if neighbour > index else to_before for neighbour in around)
    return np.concatenate([before, -after], axis=-1)


def _disturb(
    layers: dict[str, np.ndarray], light: np.ndarray, number: int, scale: int, random: np.random.Generator
) -> None:
    """Lay a disc over a frame, darken a part of it, and put noise into the left two fifths of the guides."""
    albedo, normal = layers[f"{VIEW}.Denoising Albedo"], layers[f"{VIEW}.Denoising Normal"]
    height, width = light.shape[:2]
    y, x = np.mgrid[:height, :width].astype(np.float32) / np.float32(scale)
    shadow = np.hypot(x - (90 + 6 * number), y - 165)
    light *= (1 - 0.6 / (1 + np.exp((shadow - 60) / 6)))[..., None].astype(np.float32)
    left, top = x - (135 + 4 * number), y - (90 + number)
    inside = np.hypot(left, top) < 42
    checks = np.where((left // 10 + top // 10) % 2 > 0, np.float32(0.7), np.float32(0.2))
    stripes = 0.5 + 0.5 * np.sin(2 * left + top)
    light[inside] = np.float32(light.mean()) * (checks * (0.5 + stripes))[inside, None]
    albedo[inside], normal[inside] = checks[inside, None], (0, 0, 1)
    for guide, deviation in ((albedo, 0.05), (normal, 0.1)):
        part = guide[:, : 2 * width // 5]
        part += random.normal(0, deviation, part.shape).astype(np.float32)
    np.maximum(albedo, 0, out=albedo)
    normal /= np.maximum(np.linalg.norm(normal, axis=-1, keepdims=True), 1)  # a mean of unit vectors is no longer


def _read(path: Path) -> dict[str, np.ndarray]:
    image = read_exr(path)
    return {layer.name: image.pixels(layer.channels) for layer in image.layers}


def _enlarge(layer: np.ndarray, scale: int) -> np.ndarray:
    height, width, channels = layer.shape
    large = cv2.resize(layer, (width * scale, height * scale), interpolation=cv2.INTER_LINEAR)
    return np.asarray(large, np.float32).reshape(height * scale, width * scale, channels)


def write_shot(name: str, folder: Path, frames: int, scale: int) -> str:
    """Write one of `SHOTS`; its pattern."""
    folder.mkdir(parents=True, exist_ok=True)
    if name == "tiled":
        tile_shot(folder, frames, scale)
    else:
        enlarge_shot(folder, frames, scale, busy=name == "busy")
    return str(folder / f"{name}.####.exr")


def run_oidn(pattern: str, out: Path, mode: str) -> None:
    from hybrid.denoising.oidn import denoise_oidn

    shot = open_shot(pattern)
    out.mkdir(parents=True, exist_ok=True)
    for number in shot.numbers:
        frame = shot.read(number)
        color = denoise_oidn(frame.color, frame.albedo, frame.normal, prefilter=PREFILTERS[mode])
        shot.write(output_path(out, shot, number), number, {"color": color})


def measure(words: Sequence[str]) -> dict[str, float]:
    """Run a command; its seconds and peak memory as the operating system has counted them."""
    began = time.perf_counter()
    process = subprocess.Popen(words, stderr=subprocess.DEVNULL, stdout=subprocess.DEVNULL)
    _, status, usage = os.wait4(process.pid, 0)
    if status:
        raise subprocess.CalledProcessError(os.waitstatus_to_exitcode(status), words)
    return {
        "cpu_seconds": usage.ru_utime + usage.ru_stime,
        "seconds": time.perf_counter() - began,
        "peak_mib": usage.ru_maxrss / 2**10,
    }


def main(argv: list[str] | None = None) -> int:
    parser = argparse.ArgumentParser(description=__doc__.split("\n")[0])
    parser.add_argument("--shots", nargs="+", choices=SHOTS, default=["pan", "busy"])
    parser.add_argument("--frames", type=int, default=10)
    parser.add_argument("--scale", type=int, default=REPEAT, help="4 for 1920×1080")
    presets = [f"denoise --preset {preset}" for preset in ("fast", "balanced", "quality")]
    parser.add_argument("--commands", nargs="*", default=presets)
    parser.add_argument("--oidn", nargs="*", choices=sorted(PREFILTERS), default=["high", "best"])
    parser.add_argument("--write", type=Path, metavar="FOLDER", help="write the shots there, and measure nothing")
    parser.add_argument("--run-oidn", nargs=3, metavar=("SHOT", "OUT", "MODE"), help=argparse.SUPPRESS)
    options = parser.parse_args(argv)
    if options.run_oidn:
        pattern, out, mode = options.run_oidn
        run_oidn(pattern, Path(out), mode)
        return 0
    with tempfile.TemporaryDirectory() as name:
        for shot in options.shots:
            folder = (options.write or Path(name)) / shot
            pattern = write_shot(shot, folder, options.frames, options.scale)
            if options.write:
                continue
            facts = {"shot": shot, "frames": options.frames, "size": f"{480 * options.scale}x{270 * options.scale}"}
            for mode in options.oidn:
                words = [sys.executable, __file__, "--run-oidn", pattern, str(folder / "oidn"), mode]
                print(json.dumps({**facts, "command": f"OIDN {mode}", **_per_frame(measure(words), options.frames)}))
            for command in options.commands:
                first, *rest = command.split()
                out = folder / "out"
                cost = measure([sys.executable, "-m", "hybrid.cli", first, pattern, "-o", str(out), *rest])
                *_, (_, report) = read_records(out)
                result = {**facts, "command": command, **_per_frame(cost, options.frames)}
                spent = {stage: each["cpu_seconds"] for stage, each in report["stages"].items()}
                spent["outside"] = cost["cpu_seconds"] - sum(spent.values())
                result["stages"] = {stage: round(seconds / options.frames, 3) for stage, seconds in spent.items()}
                result["peaks"] = {n: round(each["peak_bytes"] / 2**20) for n, each in report["stages"].items()}
                print(json.dumps(result), flush=True)
    return 0


def _per_frame(cost: dict[str, float], frames: int) -> dict[str, float]:
    return {
        "cpu_seconds_per_frame": round(cost["cpu_seconds"] / frames, 2),
        "seconds_per_frame": round(cost["seconds"] / frames, 2),
        "peak_mib": round(cost["peak_mib"]),
    }


if __name__ == "__main__":
    raise SystemExit(main())
