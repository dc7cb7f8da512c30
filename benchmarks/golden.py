"""Compare the frames of two checkouts of ravg, channel by channel and to the bit, over many configurations.

    python benchmarks/golden.py BASE                 # BASE: another checkout; this one is compared with it
    python benchmarks/golden.py BASE --only quality --keep /tmp/golden

Each checkout runs all configurations in one process, on shots written by this script. `--keep` keeps the results of
BASE for the next call. The exit code is 1 if a channel, a header or an exit code differs.
"""

import argparse
import contextlib
import io
import json
import os
import pickle
import shutil
import subprocess
import sys
import tempfile
from collections.abc import Iterator
from pathlib import Path

import cv2
import numpy as np
import OpenEXR

HERE = Path(__file__).resolve().parent.parent
SHOT = HERE / "tests" / "data" / "bathroom"
BF16, F32 = ["--precision", "bfloat16"], ["--precision", "float32"]
#: Name → shot and arguments.
CONFIGURATIONS: dict[str, tuple[str, list[str]]] = {
    "fast": ("plain", ["denoise", "--preset", "fast", *BF16]),
    "fast-float32": ("plain", ["denoise", "--preset", "fast", *F32]),
    "balanced": ("plain", ["denoise", "--preset", "balanced", *BF16]),
    "balanced-float32": ("plain", ["denoise", "--preset", "balanced", *F32]),
    "quality": ("plain", ["denoise", "--preset", "quality", *BF16]),
    "quality-float32": ("plain", ["denoise", "--preset", "quality", *F32]),
    "kernels": ("plain", ["denoise", "--weights", "tkpcn.safetensors", *F32]),
    "draft": ("plain", ["denoise", "--method", "classical", "--preset", "draft"]),
    "standard": ("plain", ["denoise", "--method", "classical", "--preset", "standard"]),
    "final": ("plain", ["denoise", "--method", "classical", "--preset", "final"]),
    "classical-sequence": (
        "plain",
        ["denoise", "--method", "classical", "--first-pass", "sequence/smooth.####.exr"],
    ),
    "nlm": ("plain", ["denoise", "--first-pass", "nlm", *F32]),
    "bundled": ("plain", ["denoise", "--first-pass", "bundled", *F32]),
    "sequence": ("plain", ["denoise", "--first-pass", "sequence/smooth.####.exr", *F32]),
    "oidn-best": ("plain", ["denoise", "--first-pass", "oidn-best", *F32]),
    "first-pass-none": ("plain", ["denoise", "--first-pass", "none", *F32]),
    "bands": ("tall", ["denoise", "--first-pass", "nlm", "--max-memory", "690M", *F32]),
    "bands-final": ("tall", ["denoise", "--method", "classical", "--preset", "final", "--max-memory", "370M"]),
    "views": ("views", ["denoise", *F32]),
    "aov-layers": ("aovs", ["denoise", "--aov", "all", *F32]),
    "aov-beauty": ("aovs", ["denoise", "--aov", "all", "--aov-sum", "beauty", *F32]),
    "passes": ("plain", ["denoise", "--passes", "2", *F32]),
    "stages-on": ("plain", ["denoise", "--stages", "dense-flow,outliers,fireflies", *F32]),
    "stages-off": ("plain", ["denoise", "--no-stages", "gate,demodulate,prefilter,blend-samples", *F32]),
    "missing": ("missing", ["denoise", "--keep-going", *F32]),
    "cut": ("cut", ["denoise", *F32]),
    "still": ("still", ["denoise", "--preset", "quality", *F32]),
    "no-vectors": ("bare", ["denoise", *F32]),
}
#: Header attributes that name the program or its files.
UNCOMPARED = ("ravg/versions", "ravg/settings", "ravg/command", "ravg/made-from", "ravg/preset")


def write_shots(folder: Path) -> None:
    frames = [_cropped(9 + index, slice(60, 124), slice(100, 196)) for index in range(5)]
    tall = [_cropped(9 + index, slice(0, 180), slice(60, 260)) for index in range(2)]
    tall = [{name: np.concatenate([layer] * 8) for name, layer in frame.items()} for frame in tall]
    _write(folder / "plain", frames)
    _write(folder / "tall", tall)
    _write(folder / "missing", frames, skipped={2})
    _write(folder / "cut", [*frames[:3], *({name: layer[::-1, ::-1] for name, layer in f.items()} for f in frames[3:])])
    still = {name: np.zeros_like(layer) if "Vector" in name else layer for name, layer in frames[0].items()}
    color = "ViewLayer.Combined"
    _write(folder / "still", [{**still, color: _noisy(still[color], seed)} for seed in range(3)])
    _write(folder / "bare", [{color: frame[color]} for frame in frames])
    _write(folder / "aovs", [_with_light_passes(frame) for frame in frames[:4]])
    two = [{**f, **{n.replace("ViewLayer", "Second"): layer[::-1] for n, layer in f.items()}} for f in frames[:3]]
    _write(folder / "views", two)
    (folder / "sequence").mkdir()
    for index, frame in enumerate(frames):
        smooth = cv2.GaussianBlur(frame[color].astype(np.float32), (0, 0), 2)  # as a denoiser of no detail
        _write_exr(folder / "sequence" / f"smooth.{index + 1:04d}.exr", {color: smooth})


def _cropped(number: int, rows: slice, columns: slice) -> dict[str, np.ndarray]:
    """Layers of a frame of *bathroom*, cropped."""
    with OpenEXR.File(str(SHOT / f"noisy.{number:04d}.exr")) as file:
        return {name: channel.pixels[rows, columns].copy() for name, channel in file.channels().items()}


def _noisy(layer: np.ndarray, seed: int) -> np.ndarray:
    """A layer under new multiplicative noise."""
    grain = np.random.default_rng(seed).gamma(4, 1 / 4, (*layer.shape[:2], 1))
    return (layer * grain).astype(layer.dtype)


def _with_light_passes(frame: dict[str, np.ndarray]) -> dict[str, np.ndarray]:
    """A frame with two light passes that add up to its color, and a mask."""
    light = frame["ViewLayer.Combined"][..., :3].astype(np.float32)
    share = np.linspace(0.2, 0.8, light.shape[1], dtype=np.float32)[None, :, None]
    passes = {"ViewLayer.DiffDir": light * share, "ViewLayer.GlossDir": light * (1 - share)}
    mask = {"ViewLayer.AO": np.repeat(share, light.shape[0], axis=0)[..., 0]}
    return {**frame, "ViewLayer.Combined": light, **passes, **mask}


def _write(folder: Path, frames: list[dict[str, np.ndarray]], skipped: frozenset[int] | set[int] = frozenset()) -> None:
    folder.mkdir()
    for index, layers in enumerate(frames):
        if index not in skipped:
            _write_exr(folder / f"noisy.{index + 1:04d}.exr", layers)


def _write_exr(path: Path, layers: dict[str, np.ndarray]) -> None:
    channels = {}
    for name, layer in layers.items():
        pixels = np.ascontiguousarray(layer)
        if pixels.ndim == 2:
            channels[name if "." in name[10:] else f"{name}.V"] = pixels
        else:
            for component, letter in enumerate("RGBA"[: pixels.shape[2]]):
                channels[f"{name}.{letter}"] = np.ascontiguousarray(pixels[..., component])
    header = {"compression": OpenEXR.ZIP_COMPRESSION, "type": OpenEXR.scanlineimage}
    header["BlenderMultiChannel"] = "Blender V2"
    OpenEXR.File(header, channels).write(str(path))


def run_all(names: list[str]) -> None:
    """Run configurations with the packages on the path, in the current folder; write results as a pickle."""
    from ravg.__main__ import main

    results = {}
    for name in names:
        shot, arguments = CONFIGURATIONS[name]
        command = [arguments[0], f"{shot}/noisy.####.exr", "-o", f"out/{name}/f.####.exr", *arguments[1:]]
        sys.argv = ["ravg", *command]
        said = io.StringIO()
        try:
            with contextlib.redirect_stdout(said), contextlib.redirect_stderr(said):
                code = main()
        except SystemExit as end:
            code = int(end.code or 0)
        results[name] = {"exit code": code, "said": said.getvalue()[-2000:], "frames": _read_all(Path("out") / name)}
        print(name, code, flush=True)
    Path("results.pickle").write_bytes(pickle.dumps(results))


def _read_all(folder: Path) -> dict[str, tuple[dict[str, np.ndarray], dict[str, str]]]:
    """Channels and ravg's header attributes of all frames of a folder."""
    frames = {}
    for path in sorted(folder.glob("*.exr")):
        with OpenEXR.File(str(path), separate_channels=True) as file:
            parts = enumerate(part.channels for part in file.parts)
            channels = {f"{number}:{n}": c.pixels.copy() for number, part in parts for n, c in part.items()}
            header = {k: str(v) for k, v in file.header().items() if k.startswith("ravg/") and k not in UNCOMPARED}
        frames[path.name] = channels, header
    return frames


def results_of(checkout: Path, folder: Path, names: list[str]) -> dict:
    work = folder / "work"
    work.mkdir()
    for shot in (folder / "shots").iterdir():
        (work / shot.name).symlink_to(shot)
    environment = {**os.environ, "PYTHONPATH": str(checkout), "PYTHONSAFEPATH": "1"}
    script = [sys.executable, str(Path(__file__).resolve()), str(checkout), "--run", *names]
    subprocess.run(script, check=True, cwd=work, env=environment)
    results = pickle.loads((work / "results.pickle").read_bytes())
    shutil.rmtree(work)
    return results


def differences(name: str, before: dict, after: dict) -> Iterator[str]:
    """Yield one line for each difference of a configuration."""
    if before["exit code"] != after["exit code"]:
        yield f"{name}: exit code {before['exit code']} → {after['exit code']}: {after['said'][-300:]}"
    if before["frames"].keys() != after["frames"].keys():
        yield f"{name}: frames {sorted(before['frames'])} → {sorted(after['frames'])}"
    for frame in before["frames"].keys() & after["frames"].keys():
        (old, old_header), (new, new_header) = before["frames"][frame], after["frames"][frame]
        if not old:
            yield f"{name} {frame}: nothing was read"
        if old.keys() != new.keys():
            yield f"{name} {frame}: channels {sorted(old.keys() ^ new.keys())} are in one of them"
        for channel in sorted(old.keys() & new.keys()):
            if not np.array_equal(old[channel], new[channel], equal_nan=True):
                with np.errstate(all="ignore"):
                    worst = np.nanmax(np.abs(old[channel].astype(np.float64) - new[channel]))
                yield f"{name} {frame}: {channel} differs by up to {worst:.3g}"
        if old_header != new_header:
            yield f"{name} {frame}: header {json.dumps(old_header)} → {json.dumps(new_header)}"


def main() -> int:
    parser = argparse.ArgumentParser(description=__doc__.split("\n")[0])
    parser.add_argument("base", type=Path, help="the other checkout")
    parser.add_argument("--only", action="append", choices=[*CONFIGURATIONS], help="this configuration; repeatable")
    parser.add_argument("--keep", type=Path, help="folder that keeps the results of BASE")
    parser.add_argument("--run", nargs="+", help=argparse.SUPPRESS)
    options = parser.parse_args()
    if options.run:
        run_all(options.run)
        return 0
    names = options.only or [*CONFIGURATIONS]
    with tempfile.TemporaryDirectory() as temporary:
        folder = options.keep or Path(temporary)
        if not (folder / "shots").exists():
            (folder / "shots").mkdir(parents=True)
            write_shots(folder / "shots")
            weights = next((options.base / "network").rglob("tkpcn.safetensors"))
            shutil.copy(weights, folder / "shots")
        kept = folder / "before.pickle"
        before = pickle.loads(kept.read_bytes()) if kept.exists() else {}
        if missing := [name for name in names if name not in before]:
            print(f"{options.base}:", flush=True)
            before |= results_of(options.base.resolve(), folder, missing)
            kept.write_bytes(pickle.dumps(before))
        print("this checkout:", flush=True)
        after_folder = Path(temporary) / "after"
        after_folder.mkdir()
        (after_folder / "shots").symlink_to((folder / "shots").resolve())
        after = results_of(HERE, after_folder, names)
    found = [line for name in names for line in differences(name, before[name], after[name])]
    print("\n".join(found) or f"{len(names)} configurations give the same frames")
    failed = [name for name in names if before[name]["exit code"] != 0]
    print(f"exit code other than 0 in both: {' '.join(failed) or 'none'}")
    return bool(found)


if __name__ == "__main__":
    raise SystemExit(main())
