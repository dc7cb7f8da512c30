"""What rendering only what a scene calls for saves, and that the picture stays the same.

    python benchmarks/bench_simulate.py SCENE.blend … random:SEED … --size 96x54 --spp 16 [--json FILE]

For each scene, in a process of its own (needs bpy): CPU seconds with everything on and with what the scene calls
for, and with each effect alone switched to what the scene calls for; the mean of the picture with the same seed;
the two-seed test, MSE(full, lean) / (variance of full + variance of lean), on T(x) = x / (x + mean), which keeps a
firefly from being the whole figure; the same ratio for two levels of noise; how far the next frame is from this
one before and after warping along the vectors, on the albedo; and the same with motion blur on. Prints Markdown.
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
    "caustics": ("cycles.caustics_reflective", "cycles.caustics_refractive"),
    "light tree": ("cycles.use_light_tree",),
    "sky": ("world.cycles.sampling_method",),
    "depth of field": ("camera.dof.use_dof",),
}
KINDS = ("diffuse", "glossy", "transmission", "volume", "transparent_max", "max")
WARPED = ("albedo_unwarped", "albedo_warped", "albedo_warped_blurred", "albedo_noise")


def warp(image: np.ndarray, x: np.ndarray, y: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
    """Sample an (H, W, C) image at (x, y), bilinear; also return where that is inside."""
    h, w = image.shape[:2]
    inside = (x >= 0) & (x <= w - 1) & (y >= 0) & (y <= h - 1)
    x, y = np.clip(x, 0, w - 1.001), np.clip(y, 0, h - 1.001)
    x0, y0 = np.floor(x).astype(int), np.floor(y).astype(int)
    fx, fy = (x - x0)[..., None], (y - y0)[..., None]
    rows = [image[y0 + k, x0] * (1 - fx) + image[y0 + k, x0 + 1] * fx for k in (0, 1)]
    return rows[0] * (1 - fy) + rows[1] * fy, inside


def tone(image: np.ndarray, mean: float) -> np.ndarray:
    return np.asarray(image / (image + mean))


def two_seed_ratio(a: list[np.ndarray], b: list[np.ndarray]) -> float:
    """Return the mean squared difference of two kinds of picture over the sum of their variances."""
    mean = float(np.mean(a))
    a, b = ([tone(picture, mean) for picture in some] for some in (a, b))
    variances = sum(np.mean(np.var(some, axis=0, ddof=1)) for some in (a, b))
    # All pairs, so that no one picture's luck decides.
    return float(np.mean([((x - y) ** 2).mean() for x in a for y in b]) / variances)


def measure(name: str, size: tuple[int, int], film: tuple[int, int], spp: int) -> dict[str, Any]:
    """Measure one scene; runs where bpy is."""
    import bpy

    from hybrid.simulate import cycles
    from hybrid.simulate.effects import EVERYTHING, PASSES, SceneFacts, effects_of, settings_of
    from hybrid.simulate.shot import ShotSettings

    scene_name, _, seed = name.partition(":")
    shot = ShotSettings(scene_name, int(seed or 1), (4, 5), size, {"n": spp}, film=film)
    started = time.process_time()
    plan = cycles.make_plan(shot, 1)
    planning = time.process_time() - started
    scene = bpy.context.scene
    lean = plan["cycles"]
    exposure = {key: lean[key] for key in ("cycles.film_exposure",) if key in lean}
    full = {
        **EVERYTHING,
        **dict.fromkeys(PASSES, False),
        "render.use_motion_blur": False,
        "camera.dof.use_dof": scene.camera.data.dof.use_dof,
        **exposure,
    }
    by_rule = settings_of(effects_of(SceneFacts(**plan["facts"])))
    folder = Path(tempfile.mkdtemp())

    def picture(settings: dict[str, Any], seed: int, samples: int = spp, frame: int = 4) -> tuple[dict, float]:
        cycles.apply(scene, settings)
        scene.frame_set(frame)
        before = time.process_time()
        cycles.render_frame(scene, folder / "p.exr", samples, seed)
        seconds = time.process_time() - before
        channels = cycles.read_channels(folder / "p.exr")[1]
        return {key.partition(".")[2]: values.astype(np.float64) for key, values in channels.items()}, seconds

    def color(channels: dict) -> np.ndarray:
        return np.stack([channels[f"Combined.{c}"] for c in "RGB"], axis=-1)

    picture(full, 9)  # the first picture also builds the scene
    # Turn about, so that what else the machine does weighs on both alike.
    fulls, leans = [], []
    for number in (1, 2, 3, 4):
        fulls.append(picture(full, number))
        leans.append(picture(lean, number))
    full_cpu, lean_cpu = (float(np.median([seconds for _, seconds in some])) for some in (fulls, leans))
    leans += [picture(lean, number) for number in (5, 6, 7, 8)]
    lows = [picture(lean, number, max(int(spp / np.e), 1)) for number in (9, 10, 11, 12)]

    effects = {}
    for group, keys in GROUPS.items():
        if keys is None:
            bounces = {key for key in EVERYTHING if key.endswith("_bounces")}
            source = by_rule if "causes" in group else lean
            change = {key: source[key] for key in bounces if "brings" not in group or by_rule[key] != 0}
            change = {key: value for key, value in change.items() if value != full[key]}
        else:
            change = {k: v for k, v in lean.items() if k.startswith(keys) and k in full and v != full[k]}
        if change:
            trial = {**full, **change}
            turns = [(picture(full, number)[1], picture(trial, number)[1]) for number in (1, 2, 3)]
            effects[group] = 1 - float(np.median([after / before for before, after in turns]))

    def albedo(channels: dict) -> np.ndarray:
        return np.stack([channels[f"Denoising Albedo.{c}"] for c in "RGB"], axis=-1)

    def apart(vectors: dict, here: dict, there: dict) -> tuple[float, float]:
        """Return the mean difference of two frames' albedo, as they are and along the vectors."""
        y, x = np.mgrid[: size[1], : size[0]].astype(float)
        moved, inside = warp(albedo(there), x - vectors["Vector.Z"], y + vectors["Vector.W"])
        before, after = (np.abs(albedo(here) - other).mean(axis=-1)[inside] for other in (albedo(there), moved))
        return float(before.mean()), float(after.mean())

    this, following = leans[0][0], picture(lean, 7, spp, 5)[0]
    unwarped, after = apart(this, this, following)
    noise = float(np.abs(albedo(this) - albedo(leans[1][0])).mean())
    blurred = ShotSettings(scene_name, shot.seed, (4, 5), size, {"n": spp}, film=film, motion_blur=True)
    cycles.apply(scene, {**lean, "render.use_motion_blur": True, "render.use_persistent_data": False})
    scene.frame_set(4)
    cycles.render_picture(scene, blurred, folder / "b.exr", spp, 8)
    smeared = {k.partition(".")[2]: v.astype(np.float64) for k, v in cycles.read_channels(folder / "b.exr")[1].items()}
    _, after_blur = apart(smeared, smeared, following)
    motion = np.hypot(this["Vector.Z"], this["Vector.W"])
    return {
        "scene": Path(scene_name).stem + (f":{seed}" if seed else ""),
        "depths": {k.split(".")[1].removesuffix("_bounces"): v for k, v in lean.items() if k.endswith("_bounces")},
        "decisions": plan["printed"],
        "plan_cpu_s": planning,
        "full_cpu_s": full_cpu,
        "lean_cpu_s": lean_cpu,
        "saved": 1 - lean_cpu / full_cpu,
        "saved_by": effects,
        "mean_change": float(np.mean([color(p) for p, _ in leans[:4]]) / np.mean([color(p) for p, _ in fulls]) - 1),
        "two_seeds": two_seed_ratio([color(p) for p, _ in fulls], [color(p) for p, _ in leans[4:]]),
        "two_levels": two_seed_ratio([color(p) for p, _ in leans[:4]], [color(p) for p, _ in lows]),
        "motion_px": float(np.median(motion)),
        "albedo_unwarped": unwarped,
        "albedo_warped": after,
        "albedo_warped_blurred": after_blur,
        "albedo_noise": noise,
        "msamples_per_cpu_s": size[0] * size[1] * spp / 1e6 / lean_cpu,
    }


def markdown(results: list[dict[str, Any]]) -> str:
    rows = [
        "| scene | depths d/g/t/v/transp/all | CPU s full | lean | saved | mean, same seed | two seeds | two levels |",
        "|---|---|---|---|---|---|---|---|",
    ]
    for r in results:
        depths = "/".join(
            str(r["depths"][k]) for k in ("diffuse", "glossy", "transmission", "volume", "transparent_max", "max")
        )
        rows.append(
            f"| {r['scene']} | {depths} | {r['full_cpu_s']:.2f} | {r['lean_cpu_s']:.2f} | {100 * r['saved']:.0f} % "
            f"| {100 * r['mean_change']:+.2f} % | {r['two_seeds']:.3f} | {r['two_levels']:.3f} |"
        )
    rows += ["", "| scene | " + " | ".join(GROUPS) + " |", "|---" * (len(GROUPS) + 1) + "|"]
    for r in results:
        cells = [f"{100 * r['saved_by'][g]:.0f} %" if g in r["saved_by"] else "–" for g in GROUPS]
        rows.append(f"| {r['scene']} | " + " | ".join(cells) + " |")
    rows += [
        "",
        "| scene | motion, px | unwarped | warped | warped, blurred shot | noise alone |",
        "|---|---|---|---|---|---|",
    ]
    for r in results:
        figures = " | ".join(
            f"{r[k]:.4f}" for k in ("albedo_unwarped", "albedo_warped", "albedo_warped_blurred", "albedo_noise")
        )
        rows.append(f"| {r['scene']} | {r['motion_px']:.2f} | {figures} |")
    return "\n".join(rows)


def main(argv: list[str]) -> int:
    parser = argparse.ArgumentParser(description=__doc__.split("\n")[0])
    parser.add_argument("scenes", nargs="+")
    parser.add_argument("--size", default="96x54")
    parser.add_argument("--film", help="of the whole camera; what is rendered is a crop of it")
    parser.add_argument("--spp", type=int, default=16)
    parser.add_argument("--json", type=Path)
    parser.add_argument("--one", action="store_true", help=argparse.SUPPRESS)
    options = parser.parse_args(argv)
    size = tuple(map(int, options.size.split("x")))
    film = tuple(map(int, options.film.split("x"))) if options.film else size
    if options.one:
        print("RESULT " + json.dumps(measure(options.scenes[0], size, film, options.spp)), flush=True)
        return 0
    results = []
    for scene in options.scenes:
        command = [sys.executable, __file__, scene, "--one", "--size", options.size, "--spp", str(options.spp)]
        command += ["--film", options.film] if options.film else []
        done = subprocess.run(command, capture_output=True, text=True, check=False)
        lines = [line for line in done.stdout.splitlines() if line.startswith("RESULT ")]
        if not lines:
            print(f"{scene}: {done.stderr.strip().splitlines()[-1:]}", file=sys.stderr)
            return 1
        results.append(json.loads(lines[0].removeprefix("RESULT ")))
        print(f"{scene}: saved {100 * results[-1]['saved']:.0f} %", file=sys.stderr)
    about = {
        "size": options.size,
        "film": options.film,
        "spp": options.spp,
        "threads": 1,
        "python": platform.python_version(),
    }
    if options.json:
        options.json.write_text(json.dumps({**about, "scenes": results}, indent=1) + "\n")
    print(markdown(results))
    return 0


if __name__ == "__main__":
    sys.path.insert(0, str(Path(__file__).parents[1]))
    raise SystemExit(main(sys.argv[1:]))
