"""What rendering only what a scene calls for saves, and that the picture stays the same.

    python benchmarks/bench_simulate.py SCENE … --size 160x90 --spp 24 [--json FILE]
    python benchmarks/bench_simulate.py SCENE … --vectors --film 1920x1080

A scene is `FILE.blend`, `FILE.blend@CAMERA`, `random:SEED` or `validation:NAME`; each is measured in a process of
its own (needs bpy), with motion blur asked for. *Everything on* means 32 bounces of every kind, all caustics, the
light tree, six more passes, and the shutter open even where nothing moves.

Time and sameness: CPU seconds per picture, everything on against what the scene calls for, and each effect alone,
always in turn, as what else the machine does changes by the minute; the median of the ratios of such pairs, and as the
error half of their range; the change of the mean radiance; the two-seed test, MSE(full, lean) / (variance of full +
variance of lean); the same ratio for two levels of noise, with the seeds that shots have and, to see that it can fail,
with a common one. Squared differences are taken on T(x) = x / (x + mean), which keeps a firefly from being the whole
figure.

Vectors (`--vectors`): how far the next frame is from this one before and after warping along the vectors, on the
albedo; and the same with motion blur on. Prints Markdown.
"""

from __future__ import annotations

import argparse
import json
import platform
import subprocess
import sys
import tempfile
import time
from pathlib import Path
from typing import Any

import numpy as np

GROUPS = {
    "bounces that nothing causes": None,  # by the rules
    "bounces that bring nothing": None,  # by the pilot
    "caustics": ("cycles.caustics",),
    "light tree": ("cycles.use_light_tree",),
    "sky": ("world.cycles",),
    "motion blur": ("render.use_motion_blur",),
    "more passes": ("layer.",),
}
KINDS = ("diffuse", "glossy", "transmission", "volume", "transparent_max", "max")
PAIRS = 5  # pictures of each kind


def warp(image: np.ndarray, x: np.ndarray, y: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
    """Sample an (H, W, C) image at (x, y), bilinear; also return where that is inside."""
    h, w = image.shape[:2]
    inside = (x >= 0) & (x <= w - 1) & (y >= 0) & (y <= h - 1)
    x, y = np.clip(x, 0, w - 1.001), np.clip(y, 0, h - 1.001)
    x0, y0 = np.floor(x).astype(int), np.floor(y).astype(int)
    fx, fy = (x - x0)[..., None], (y - y0)[..., None]
    rows = [image[y0 + k, x0] * (1 - fx) + image[y0 + k, x0 + 1] * fx for k in (0, 1)]
    return rows[0] * (1 - fy) + rows[1] * fy, inside


def two_seed_ratio(a: np.ndarray, b: np.ndarray) -> float:
    """Return the mean squared difference of two kinds of picture, (N, …), over the sum of their variances.

    All pairs, so that no one picture's luck decides.
    """
    variances = np.var(a, axis=0, ddof=1).mean() + np.var(b, axis=0, ddof=1).mean()
    return float(np.mean([((x - y) ** 2).mean() for x in a for y in b]) / variances)


def level_ratio(a: np.ndarray, b: np.ndarray) -> float:
    """Return the same for two levels of noise, of the pairs a[i], b[i] alone: 1 − 2 covariance / sum of variances.

    The levels' means are taken off, as T bends them differently.
    """
    a, b = a - a.mean(axis=0), b - b.mean(axis=0)
    return float(1 - 2 * (a * b).mean() / ((a**2).mean() + (b**2).mean()))


def saving(pairs: list[tuple[float, float]]) -> tuple[float, float]:
    """Return what is saved, of (full, lean) seconds rendered one after the other: the median, and half of the range."""
    saved = [1 - lean / full for full, lean in pairs]
    return float(np.median(saved)), (max(saved) - min(saved)) / 2


def shot_of(name: str, size: tuple[int, int], film: tuple[int, int] | None, spp: int, blur: bool) -> Any:
    """Return the settings of a shot of two frames, 4 and 5, of a scene as it is named here."""
    from hybrid.simulate.shot import ShotSettings

    file, _, camera = name.partition("@")
    seed = int(name.partition(":")[2]) if name.startswith("random:") else 1
    scene = "random" if name.startswith("random:") else file
    return ShotSettings(scene, seed, (4, 5), size, {"n": spp}, film=film, camera=camera or None, motion_blur=blur)


def picture(folder: Path, shot: Any, seed: int, samples: int, frame: int = 4) -> tuple[dict[str, np.ndarray], float]:
    """Render a picture as shots are; return its channels and the CPU seconds it took."""
    import bpy

    from hybrid.simulate import cycles

    scene = bpy.context.scene
    scene.frame_set(frame)
    before = time.process_time()
    cycles.render_picture(scene, shot, folder / "p.exr", samples, seed)
    seconds = time.process_time() - before
    channels = cycles.read_channels(folder / "p.exr")[1]
    return {key.partition(".")[2]: values.astype(np.float64) for key, values in channels.items()}, seconds


def layer(channels: dict[str, np.ndarray], name: str) -> np.ndarray:
    """Return a coloured layer, (H, W, 3)."""
    return np.stack([channels[f"{name}.{c}"] for c in "RGB"], axis=-1)


def measure_time(name: str, size: tuple[int, int], film: tuple[int, int] | None, spp: int) -> dict[str, Any]:
    """Measure what is saved in one scene, and what is lost; runs where bpy is."""
    import bpy

    from hybrid.simulate import cycles
    from hybrid.simulate.effects import EVERYTHING, SceneFacts, effects_of, settings_of
    from hybrid.simulate.shot import frame_seed

    shot = shot_of(name, size, film, spp, blur=True)
    started = time.process_time()
    plan = cycles.make_plan(shot, 1)
    planning = time.process_time() - started
    scene = bpy.context.scene
    # Passes and motion blur change between pictures here, which Blender 5.0.1 survives only without this.
    scene.render.use_persistent_data = False
    lean = plan["cycles"]
    full = {**lean, "world.cycles.sampling_method": scene.world.cycles.sampling_method if scene.world else "NONE"}
    if full["world.cycles.sampling_method"] == "NONE":
        full["world.cycles.sampling_method"] = "AUTOMATIC"
    full |= {**EVERYTHING, "render.use_motion_blur": True}
    by_rule = settings_of(effects_of(SceneFacts(**plan["facts"])))
    folder = Path(tempfile.mkdtemp())

    def render(settings: dict[str, Any], seed: int, samples: int = spp) -> tuple[np.ndarray, float]:
        cycles.apply(scene, settings)
        channels, seconds = picture(folder, shot, seed, samples)
        return layer(channels, "Combined"), seconds

    render(full, 99)  # the first picture also loads and compiles
    fulls, leans = [], []
    for number in range(PAIRS):  # turn about, so that what else the machine does weighs on both alike
        fulls.append(render(full, number))
        leans.append(render(lean, number))
    means = np.array([b.mean() / a.mean() - 1 for (a, _), (b, _) in zip(fulls, leans, strict=True)])

    few = max(int(spp / np.e), 1)
    a, own, common = (
        [render(lean, frame_seed(number, level, 4), samples)[0] for number in range(PAIRS)]
        for level, samples in (("a", spp), ("c", few), ("a", few))
    )
    scale = float(np.mean(a))
    a, own, common, first, second = (
        np.stack([image / (image + scale) for image in images])
        for images in (a, own, common, [image for image, _ in fulls], a)
    )

    effects = {}
    for group, keys in GROUPS.items():
        if keys is None:
            bounces = {key for key in EVERYTHING if key.endswith("_bounces")}
            source = by_rule if "causes" in group else lean
            change = {key: source[key] for key in bounces if "bring" not in group or by_rule[key] != 0}
        else:
            change = {key: value for key, value in lean.items() if key.startswith(keys)}
        change = {key: value for key, value in change.items() if value != full.get(key)}
        if change:
            settings = {**full, **change}
            effects[group] = saving([(render(full, k)[1], render(settings, k)[1]) for k in range(PAIRS)])

    full_cpu, lean_cpu = (min(seconds for _, seconds in some) for some in (fulls, leans))
    saved = saving([(a, b) for (_, a), (_, b) in zip(fulls, leans, strict=True)])
    return {
        "scene": Path(name).stem if ":" not in name else name,
        "depths": [lean[f"cycles.{kind}_bounces"] for kind in KINDS],
        "decisions": plan["printed"],
        "plan_cpu_s": planning,
        "full_cpu_s": full_cpu,
        "lean_cpu_s": lean_cpu,
        "saved": saved,
        "saved_by": effects,
        "mean_change": float(means.mean()),
        "mean_change_error": float(means.std(ddof=1) / np.sqrt(PAIRS)),
        "two_seeds": two_seed_ratio(first, second),
        "two_levels": level_ratio(a, own),
        "common_seed": level_ratio(a, common),
        "msamples_per_cpu_s": size[0] * size[1] * spp / 1e6 / lean_cpu,
    }


def measure_vectors(name: str, size: tuple[int, int], film: tuple[int, int] | None, spp: int) -> dict[str, Any]:
    """Measure how well vectors lead from one frame to the next, without and with motion blur; runs where bpy is."""
    import bpy

    from hybrid.simulate import cycles

    folder = Path(tempfile.mkdtemp())
    sharp, blurred = (shot_of(name, size, film, spp, blur) for blur in (False, True))
    cycles.build(sharp, 0, 1)
    scene = bpy.context.scene
    scene.render.use_persistent_data = False
    # Light does not matter here.
    cycles.apply(scene, {"cycles.max_bounces": 4, "cycles.diffuse_bounces": 0})
    (here, _), (again, _), (there, _) = (picture(folder, sharp, seed, spp, 4 + (seed == 3)) for seed in (1, 2, 3))
    scene.render.use_motion_blur = True
    smeared, _ = picture(folder, blurred, 4, spp)
    albedo, following = layer(here, "Denoising Albedo"), layer(there, "Denoising Albedo")
    y, x = np.mgrid[: size[1], : size[0]].astype(float)

    def apart(vectors: dict[str, np.ndarray]) -> float:
        moved, inside = warp(following, x - vectors["Vector.Z"], y + vectors["Vector.W"])
        return float(np.abs(albedo - moved).mean(axis=-1)[inside].mean())

    motion = np.hypot(here["Vector.Z"], here["Vector.W"])
    return {
        "scene": Path(name).stem if ":" not in name else name,
        "motion_px": float(np.median(motion)),
        "fastest_px": float(motion.max()),
        "albedo_unwarped": float(np.abs(albedo - following).mean()),
        "albedo_warped": apart(here),
        "albedo_warped_blurred": apart(smeared),
        "albedo_noise": float(np.abs(albedo - layer(again, "Denoising Albedo")).mean()),
    }


def percent(saved: tuple[float, float]) -> str:
    """Write a saving and its error."""
    return f"{100 * saved[0]:.0f} ± {100 * saved[1]:.0f} %"


def markdown(results: list[dict[str, Any]]) -> str:
    """Return the tables of the results."""
    if "saved" not in results[0]:
        rows = [
            "| scene | motion, px: median, largest | unwarped | warped | warped, blurred shot | noise alone |",
            "|---|---|---|---|---|---|",
        ]
        for r in results:
            keys = ("albedo_unwarped", "albedo_warped", "albedo_warped_blurred", "albedo_noise")
            figures = " | ".join(f"{r[key]:.4f}" for key in keys)
            rows.append(f"| {r['scene']} | {r['motion_px']:.2f}, {r['fastest_px']:.1f} | {figures} |")
        return "\n".join(rows)
    rows = [
        "| scene | depths d/g/t/v/transp/all | CPU s full | lean | saved | mean changes by | two seeds | two levels, "
        "own seeds | common seed |",
        "|---|---|---|---|---|---|---|---|---|",
    ]
    for r in results:
        rows.append(
            f"| {r['scene']} | {'/'.join(map(str, r['depths']))} | {r['full_cpu_s']:.2f} | {r['lean_cpu_s']:.2f} "
            f"| {percent(r['saved'])} "
            f"| {100 * r['mean_change']:+.2f} ± {100 * r['mean_change_error']:.2f} % "
            f"| {r['two_seeds']:.3f} | {r['two_levels']:.3f} | {r['common_seed']:.3f} |"
        )
    rows += ["", "| scene | " + " | ".join(GROUPS) + " |", "|---" * (len(GROUPS) + 1) + "|"]
    for r in results:
        cells = [percent(r["saved_by"][g]) if g in r["saved_by"] else "–" for g in GROUPS]
        rows.append(f"| {r['scene']} | " + " | ".join(cells) + " |")
    return "\n".join(rows)


def main(argv: list[str]) -> int:
    parser = argparse.ArgumentParser(description=__doc__.split("\n")[0])
    parser.add_argument("scenes", nargs="+")
    parser.add_argument("--size", default="160x90")
    parser.add_argument("--film", help="of the whole camera; what is rendered is a crop of it")
    parser.add_argument("--spp", type=int, default=24)
    parser.add_argument("--vectors", action="store_true")
    parser.add_argument("--json", type=Path)
    parser.add_argument("--one", action="store_true", help=argparse.SUPPRESS)
    options = parser.parse_args(argv)
    size = tuple(map(int, options.size.split("x")))
    film = tuple(map(int, options.film.split("x"))) if options.film else None
    if options.one:
        measure = measure_vectors if options.vectors else measure_time
        print("RESULT " + json.dumps(measure(options.scenes[0], size, film, options.spp)), flush=True)
        return 0
    results = []
    for scene in options.scenes:
        command = [sys.executable, __file__, scene, "--one", "--size", options.size, "--spp", str(options.spp)]
        command += ["--film", options.film] if options.film else []
        command += ["--vectors"] if options.vectors else []
        done = subprocess.run(command, capture_output=True, text=True, check=False)
        lines = [line for line in done.stdout.splitlines() if line.startswith("RESULT ")]
        if not lines:
            print(f"{scene}: {done.stderr.strip().splitlines()[-1:]}", file=sys.stderr)
            return 1
        results.append(json.loads(lines[0].removeprefix("RESULT ")))
        print(f"{scene}: done", file=sys.stderr)
        about = {"size": options.size, "film": options.film, "spp": options.spp, "python": platform.python_version()}
        if options.json:
            options.json.write_text(json.dumps({**about, "scenes": results}, indent=1) + "\n")
    print(markdown(results))
    return 0


if __name__ == "__main__":
    sys.path.insert(0, str(Path(__file__).parents[1]))
    raise SystemExit(main(sys.argv[1:]))
