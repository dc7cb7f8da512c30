"""Make every table, chart and animation of README.md and docs/results.md from one revision.

    python benchmarks/figures.py WORK [--parts ladder second blender filters times] [--scenes FOLDER] [--python FILE]
    python benchmarks/figures.py WORK --write

WORK/shots holds the shots of `LADDER` and others, one folder each; those that are not there are rendered, the real
scenes from the .blend files in FOLDER, with Blender's Python module in the interpreter FILE. Figures go to
WORK/figures.json as they are measured, so that a run may be stopped and continued. Parts of another revision of the
code are measured anew; those that are not named keep the published figures, with their own revision. `--write` copies
the file to docs/figures.json, writes the blocks of the pages between ``<!-- figures: NAME -->`` and ``<!-- end -->``,
and draws the pictures. `tests/test_figures.py` compares the pages with the file.
"""

import argparse
import hashlib
import json
import platform
import re
import subprocess
import sys
import tempfile
from collections import Counter
from collections.abc import Callable, Iterable
from datetime import UTC, datetime
from functools import partial
from importlib.metadata import version
from itertools import pairwise, product
from pathlib import Path
from typing import Any

import cv2
import numpy as np

sys.path.insert(0, str(Path(__file__).resolve().parent))
sys.path.insert(0, str(Path(__file__).resolve().parent.parent))

import ladder
from bench_shot import REPEAT, measure, write_shot

from hybrid.alignment.transfer import measure_exposure
from hybrid.comparison.metrics import psnr
from hybrid.files.exr import read_exr, write_exr
from hybrid.files.frame import Array
from hybrid.files.movies import write_movie
from hybrid.files.png import display_exposure, encode_bytes, write_label, write_png
from hybrid.files.shots import Shot
from nlm.average import channel_mean
from ravg import open_shot

ROOT = Path(__file__).resolve().parent.parent
CODE = ("flow", "hybrid", "loops", "network", "nlm", "setup.cfg", "constraints.txt")
RESEARCH = ("network/paper", "network/training")  # no figure depends on these
PAGES = ("README.md", "docs/results.md")
FIGURES = ROOT / "docs" / "figures.json"
IMAGES = ROOT / "docs" / "images"
MOVES = ("--camera", "random", "--moving-objects", "2")
# Scene and options of each shot of the ladder.
LADDER: dict[str, tuple[str, ...]] = {
    "hard31001": ("hard", "--seed", "31001"),
    "hard31002": ("hard", "--seed", "31002"),
    "hard31004": ("hard", "--seed", "31004"),
    "random31002": ("random", "--seed", "31002"),
    "table": ("table.blend",),
    "garden": ("garden.blend",),
    "staircase": ("wooden_staircase.blend", *MOVES),
    "classroom": ("classroom.blend", *MOVES),
    "kitchen": ("country_kitchen.blend", *MOVES),
    "chalice": ("chalice.blend", "--camera", "random", "--moving-objects", "1"),
}
RENDER = (
    *("--film", "1920x1080", "--size", "192x108", "--frames", "1-7", "--levels", "s008=8,s032=32,s128=128,s512=512"),
    *("--reference", "512", "--reference-frames", "3,4,5"),
)
# Scenes of `benchmarks/scenes.py`, of small bright lamps and glass; one rule was chosen with them in view.
SECOND = ("neon", "headlamps", "water")
SECOND_LEVELS = {"s008": 8, "s032": 32, "s128": 128}
RENDER_SECOND = (
    *("--film", "320x180", "--size", "192x108", "--frames", "4-10", "--levels", "s008=8,s032=32,s128=128"),
    *("--reference", "384", "--reference-frames", "6,7,8"),
)
# Shots with the defaults of Blender 5.0, whose files hold its denoised frames too: scene and options of each.
BLENDER: dict[str, tuple[str, ...]] = {
    "blender-staircase": ("wooden_staircase.blend", "--moving-objects", "2"),
    "blender-classroom": ("classroom.blend", "--moving-objects", "2"),
    "blender-kitchen": ("country_kitchen.blend", "--moving-objects", "2"),
    "blender-chalice": ("chalice.blend", "--moving-objects", "1"),
    "blender-neon": ("neon.blend",),
    "blender-headlamps": ("headlamps.blend",),
}
BLENDER_LEVELS = {"s008": 8, "s064": 64}
RENDER_BLENDER = (
    *("--defaults", "--film", "480x270", "--size", "192x108", "--frames", "4-10", "--levels", "s008=8,s064=64"),
    *("--reference", "160", "--reference-frames", "6-8", "--second-reference"),
)
SAMPLES = {"s008": 8, "s032": 32, "s128": 128, "s512": 512}
NAMES = {
    "noisy": "noisy",
    "oidn-high": "OIDN high",
    "oidn-best": "OIDN best",
    "fast": "`fast`",
    "balanced": "`balanced`",
    "quality": "`quality`",
}
RIVALS = {"fast": "oidn-high", "balanced": "oidn-best", "quality": "oidn-best"}
# Shots whose noise is correlated by the kernel [r 1 r] in both directions, at 32 samples.
FILTERED = ("classroom", "staircase")
RADII = (0.1, 0.2, 0.3, 0.45)
SPREAD = ("s032", "reference_a", "reference_b")
# Shots of other renderers (`benchmarks/other_renderers.py`): level and options of each.
OTHERS: dict[str, tuple[str, ...]] = {
    "mitsuba": ("s032", "mitsuba"),
    "luxcore-bidir": ("s016", "luxcore-bidir", "--samples", "16"),
    "mitsuba-box": ("s032", "mitsuba", "--filter", "box"),
    "luxcore-path": ("s016", "luxcore-path", "--samples", "16"),
}
LIGHT = ("Combined", "Denoising Albedo", "Denoising Normal")
TIMED_FRAMES = 8
# Exposures beyond which light is a lamp, whose rims are judged by themselves.
RIM = 4.0
Results = dict[str, Any]


def state() -> str:
    """Hash of the committed code that the figures depend on; exits where files of it are changed."""
    paths = [*CODE, *(f":!{path}" for path in RESEARCH)]
    changed = subprocess.check_output(["git", "status", "--porcelain", "--", *paths], cwd=ROOT, text=True)
    if changed:
        raise SystemExit(f"figures: expected committed code, got changes in {changed.split()[1]}")
    files = subprocess.check_output(["git", "ls-tree", "-r", "HEAD", *CODE], cwd=ROOT, text=True).splitlines()
    kept = [line for line in files if not line.partition("\t")[2].startswith(RESEARCH)]
    return hashlib.sha256("\n".join(kept).encode()).hexdigest()[:16]


def processor() -> str:
    """Name of the processor, and its instructions that matter for speed."""
    info = Path("/proc/cpuinfo")
    text = info.read_text(encoding="utf-8") if info.exists() else ""
    name = re.search(r"model name\s*: (.*)", text)
    best = next((word for word in ("amx_tile", "avx512_bf16", "avx512f", "avx2") if word in text), "")
    return " ".join(part for part in (name[1] if name else platform.machine(), best.upper().replace("_", " ")) if part)


def provenance() -> Results:
    """Revision, date, processor and versions of a run."""
    revision = subprocess.check_output(["git", "rev-parse", "--short", "HEAD"], cwd=ROOT, text=True).strip()
    return {
        "state": state(),
        "version": version("ravg"),
        "revision": revision,
        "date": datetime.now(UTC).date().isoformat(),
        "processor": processor(),
        "libraries": {name: version(name) for name in ("torch", "pyoidn", "opencv-contrib-python-headless")},
    }


class Record:
    """Figures by part and key, written to a file after each of them; parts that are not measured stay as published."""

    def __init__(self, path: Path, parts: Iterable[str]) -> None:
        self._path = path
        self.values: Results = json.loads((path if path.exists() else FIGURES).read_text(encoding="utf-8"))
        for part in parts:
            if self.values["about"].get(part, {}).get("state") != state():
                self.values[part], self.values["about"][part] = {}, provenance()

    def add(self, part: str, key: str, figures: Callable[[], list[float]]) -> None:
        """Measure the figures of a key, unless they are there."""
        if key not in self.values[part]:
            self.values[part][key] = figures()
            self._path.write_text(json.dumps(self.values, indent=0), encoding="utf-8")
            print(part, key, *self.values[part][key], flush=True)


def find_scene(scene: str, options: argparse.Namespace) -> str:
    """Path of a .blend file, written if it is one of `SECOND`; any other scene as it is."""
    if scene.removesuffix(".blend") in SECOND:
        script, out = ROOT / "benchmarks" / "scenes.py", options.work / "shots"
        subprocess.run([str(options.python or sys.executable), str(script), str(out), scene[:-6]], check=True)
        return str(out / scene)
    if (own := ROOT / "examples" / "scenes" / scene).exists() or not scene.endswith(".blend"):
        return str(own) if own.exists() else scene
    if options.scenes is None:
        raise SystemExit(f"figures: expected --scenes with {scene}, got none")
    return str(options.scenes / scene)


def find_shot(name: str, options: argparse.Namespace) -> Path:
    """The folder of a shot: seven frames of each level, and references of three; rendered unless all are there."""
    folder: Path = options.work / "shots" / name
    counts = Counter(path.name.partition(".")[0] for path in folder.glob("*.exr"))
    levels = [count for name, count in counts.items() if name.startswith("s")]
    if counts["reference_b"] >= 3 and set(levels) == {7}:
        return folder
    if name in OTHERS:
        _, renderer, *words = OTHERS[name]
        script = str(ROOT / "benchmarks" / "other_renderers.py")
        subprocess.run([sys.executable, script, renderer, str(folder), *words, "--references", "256"], check=True)
    elif name in BLENDER:
        scene, *words = BLENDER[name]
        script = str(ROOT / "examples" / "render_shot.py")
        python = str(options.python or sys.executable)
        subprocess.run([python, script, find_scene(scene, options), str(folder), *words, *RENDER_BLENDER], check=True)
    else:
        scene, *words = LADDER.get(name, (f"{name}.blend", *RENDER_SECOND))
        words += RENDER if name in LADDER else ()
        python = [] if options.python is None else ["--python", str(options.python)]
        command = ["-m", "hybrid.cli", "simulate", find_scene(scene, options), "-o", str(folder), *words, *python]
        subprocess.run([sys.executable, *command], check=True, cwd=ROOT)
    return folder


def judge(record: Record, part: str, key: str, truth: ladder.Truth, level: str, methods: Iterable[str]) -> None:
    """Add PSNR and temporal PSNR of methods on a level of a shot."""
    shot = truth.shot(level)
    for method in methods:
        record.add(part, f"{key} {method}", lambda m=method: truth.judge(shot, ladder.denoise(shot, m)))


def measure_ladder(record: Record, options: argparse.Namespace) -> None:
    for name in LADDER:
        truth = ladder.Truth(find_shot(name, options))
        for level in SAMPLES:
            judge(record, "ladder", f"{name} {level}", truth, level, NAMES)


def measure_second(record: Record, options: argparse.Namespace) -> None:
    """PSNR and temporal PSNR, then PSNR at rims of lamps, elsewhere, and of each frame."""
    for name, level in product(SECOND, SECOND_LEVELS):
        truth = ladder.Truth(find_shot(name, options))
        shot = truth.shot(level)

        def figures(method: str, shot: Shot = shot, truth: ladder.Truth = truth) -> list[float]:
            images = ladder.denoise(shot, method)
            return [*truth.judge(shot, images), *_at_rims(truth, images), *truth.frames(images)]

        for method in NAMES:
            record.add("second", f"{name} {level} {method}", partial(figures, method))


def _at_rims(truth: ladder.Truth, images: list[Array]) -> list[float]:
    """PSNR of the pixels within two of light beyond `RIM` exposures, and of all others."""
    errors: list[list[float]] = [[], []]
    for image, (a, b) in zip(images, truth.references, strict=True):
        light = channel_mean((a + b) / 2)
        lamp = (light > RIM * measure_exposure(a, b)).astype(np.uint8)
        rim = cv2.dilate(lamp, np.ones((5, 5), np.uint8)) > 0
        for found, region in zip(errors, (rim, ~rim), strict=True):
            shown = np.where(region[..., None], image, a)  # without an error elsewhere
            found.append(10 ** (-psnr(shown, (a, b)) / 10) / region.mean())
    return [round(float(-10 * np.log10(np.mean(found))), 3) for found in errors]


def measure_blender(record: Record, options: argparse.Namespace) -> None:
    """Blender's own denoised frames, and presets that start from them; PSNR of each frame follows the means."""
    for name, level in product(BLENDER, BLENDER_LEVELS):
        truth = ladder.Truth(find_shot(name, options))
        shot = truth.shot(level)

        def figures(method: str, truth: ladder.Truth = truth, shot: Shot = shot) -> list[float]:
            images = ladder.denoise(shot, method)
            return [*truth.judge(shot, images), *truth.frames(images)]

        for method in ("noisy", "given", *RIVALS):
            record.add("blender", f"{name} {level} {method}", partial(figures, method))


def spread(folder: Path, out: Path, radius: float, names: Iterable[str]) -> None:
    """Write the frames of some names in a folder as a pixel filter [r 1 r] shows them."""
    kernel = np.array([radius, 1, radius], np.float32) / np.float32(1 + 2 * radius)
    out.mkdir(parents=True, exist_ok=True)
    for path in (path for name in names for path in sorted(folder.glob(f"{name}.*.exr"))):
        image, replaced = read_exr(path), {}
        for layer in image.layers:
            if layer.name.rpartition(".")[2] in LIGHT or len(image.layers) == 1:
                pixels = image.pixels(layer.channels)
                spread_out = cv2.sepFilter2D(pixels, -1, kernel, kernel, borderType=cv2.BORDER_REFLECT_101)
                planes = np.moveaxis(spread_out.reshape(pixels.shape), -1, 0)
                replaced |= dict(zip(layer.channels, planes, strict=True))
        write_exr(out / path.name, image, replaced)


def measure_filters(record: Record, options: argparse.Namespace) -> None:
    for name, (level, *_) in OTHERS.items():
        judge(record, "filters", name, ladder.Truth(find_shot(name, options)), level, NAMES)
    for name, radius in product(FILTERED, RADII):
        if f"{name} {radius} quality" not in record.values.get("filters", {}):
            with tempfile.TemporaryDirectory() as folder:
                spread(find_shot(name, options), Path(folder), radius, SPREAD)
                judge(record, "filters", f"{name} {radius}", ladder.Truth(Path(folder)), "s032", NAMES)


def measure_times(record: Record, options: argparse.Namespace) -> None:
    """CPU seconds a frame and peak memory, GiB, of whole processes at 1920×1080."""
    folder = options.work / "busy"
    pattern = str(folder / "busy.####.exr")
    if len(list(folder.glob("busy.*.exr"))) < TIMED_FRAMES:
        write_shot("busy", folder, TIMED_FRAMES, REPEAT)
    bench = str(ROOT / "benchmarks" / "bench_shot.py")

    def cost(method: str) -> list[float]:
        with tempfile.TemporaryDirectory() as out:
            words = [sys.executable, "-m", "hybrid.cli", "denoise", pattern, "-o", f"{out}/x", "--preset", method]
            if method in ladder.OIDN:
                words = [sys.executable, bench, "--run-oidn", pattern, out, method.removeprefix("oidn-")]
            spent = measure(words)
        return [round(spent["cpu_seconds"] / TIMED_FRAMES, 2), round(spent["peak_mib"] / 1024, 2)]

    for method in (name for name in NAMES if name != "noisy"):
        record.add("times", method, partial(cost, method))


# Tables, as Markdown of the figures.


def _pair(figures: Iterable[float], digits: int = 1, *, signed: bool = False) -> str:
    """PSNR / temporal PSNR; without a sign on 0."""
    words = [f"{value:{'+' if signed else ''}.{digits}f}" for value in figures]
    return " / ".join(re.sub(r"^[+-](0\.0+)$", r"\1", word).replace("-", "−") for word in words)


def _rows(head: Iterable[str], rows: Iterable[Iterable[str]]) -> str:
    lines = [list(head), *map(list, rows)]
    lines.insert(1, ["---"] * len(lines[0]))
    return "\n".join(
        f"| {' | '.join(line)} |" if index != 1 else f"|{'|'.join(line)}|" for index, line in enumerate(lines)
    )


def _of(results: Results, level: str, method: str) -> dict[str, list[float]]:
    """Figures of each shot at a level."""
    found = {name: results["ladder"].get(f"{name} {level} {method}") for name in LADDER}
    return {name: figures for name, figures in found.items() if figures}


def _mean(figures: dict[str, list[float]]) -> list[float]:
    return [float(np.mean(column)) for column in zip(*figures.values(), strict=True)]


def _gains(results: Results, level: str, method: str) -> dict[str, list[float]]:
    """Gains of a preset over its rival on each shot."""
    rival = _of(results, level, RIVALS[method])
    return {n: [a - b for a, b in zip(v, rival[n], strict=True)] for n, v in _of(results, level, method).items()}


def _worst(gains: dict[str, list[float]]) -> tuple[str, list[float]]:
    name = min(gains, key=lambda name: gains[name][0])
    return name, gains[name]


def _cost(results: Results, method: str) -> tuple[str, str]:
    seconds, memory = results["times"].get(method, (None, None))
    return ("–", "–") if seconds is None else (f"{seconds:.1f} s", f"{memory:.1f} GiB")


def summary(results: Results) -> str:
    """README: accuracy and stability at 32 samples, time and memory."""
    worst, _ = _worst(_gains(results, "s032", "quality"))
    names = NAMES | {"balanced": "`balanced` (default)", "oidn-best": "OIDN best, as in Blender"}
    shown = {names[method]: (_of(results, "s032", method), _cost(results, method)) for method in NAMES}
    rows = ([name, _pair(_mean(figures)), _pair(figures[worst]), *cost] for name, (figures, cost) in shown.items())
    gain = _pair(_mean(_gains(results, "s032", "balanced")), signed=True)
    share = results["times"]["balanced"][0] / results["times"]["oidn-best"][0]
    claim = f"ravg's default preset gains {gain} dB over OIDN best, in {share:.2f} of its CPU time.\n\n"
    return claim + _rows(("method", "mean", f"worst shot (*{worst}*)", "CPU time", "memory"), rows)


def samples(results: Results) -> str:
    """Results: means at each number of samples, and the worst shot of each preset."""
    rows = [[NAMES[method], *(_pair(_mean(_of(results, level, method)), 2) for level in SAMPLES)] for method in NAMES]
    for method, rival in RIVALS.items():
        worst = [_worst(_gains(results, level, method)) for level in SAMPLES]
        rows.append(
            [
                f"worst of {NAMES[method]} over {NAMES[rival]}",
                *(f"{_pair(gain, signed=True)} *{name}*" for name, gain in worst),
            ]
        )
    return _rows(("samples per pixel", *map(str, SAMPLES.values())), rows)


def shots(results: Results) -> str:
    """Results: each shot at 32 samples."""
    return _rows(
        ("", *LADDER),
        ([NAMES[method], *(_pair(figures) for figures in _of(results, "s032", method).values())] for method in NAMES),
    )


def second(results: Results) -> str:
    """Results: the second ladder."""
    keys = {f"*{name}*, {n} samples": f"{name} {level}" for name in SECOND for level, n in SECOND_LEVELS.items()}
    rows = ([shot, *(_pair(results["second"][f"{key} {m}"][:2]) for m in NAMES)] for shot, key in keys.items())
    return _rows(("shot", *NAMES.values()), rows)


def rims(results: Results) -> str:
    """Results: gains over OIDN best on the second ladder, by region and of the worst frame."""
    rows = []
    for name, method in product(SECOND, ("balanced", "quality")):
        row = [f"*{name}*, {NAMES[method]}"]
        for level in SECOND_LEVELS:
            own, best = (results["second"][f"{name} {level} {m}"][2:] for m in (method, RIVALS[method]))
            at_rims, elsewhere, *frames = (a - b for a, b in zip(own, best, strict=True))
            row.append(_pair((at_rims, elsewhere, min(frames)), signed=True))
        rows.append(row)
    return _rows(("shot", *(f"{count} samples" for count in SECOND_LEVELS.values())), rows)


def _blender_gains(results: Results, level: str, method: str) -> dict[str, list[float]]:
    """Gains of a preset over Blender's own frames on each shot, the means first and then each frame's."""
    found = {name: [results["blender"][f"{name} {level} {m}"] for m in (method, "given")] for name in BLENDER}
    return {name: [a - b for a, b in zip(*pair, strict=True)] for name, pair in found.items()}


def blender(results: Results) -> str:
    """Results: presets that start from Blender's own frames."""
    names = NAMES | {"given": "Blender's"}
    shown = list(product(BLENDER_LEVELS, ("given", "balanced", "quality")))
    head = (f"{names[method]}, {BLENDER_LEVELS[level]}" for level, method in shown)
    rows = [
        [f"*{name.removeprefix('blender-')}*", *(_pair(results["blender"][f"{name} {lv} {m}"][:2]) for lv, m in shown)]
        for name in BLENDER
    ]
    return _rows(("shot", *head), rows)


def default_settings(results: Results) -> str:
    """README: gains over Blender's own frames."""
    rows = []
    for method in RIVALS:
        gains = [_blender_gains(results, level, method) for level in BLENDER_LEVELS]
        least = min(value for each in gains for shot in each.values() for value in shot[2:])
        means = (_pair(_mean(each)[:2], signed=True) for each in gains)
        rows.append([NAMES[method], *means, _pair([least], signed=True)])
    head = (f"{number} samples" for number in BLENDER_LEVELS.values())
    return _rows(("preset", *head, "worst frame"), rows)


def filters(results: Results) -> str:
    """Results: shots whose pixels share noise, and the two renderers' shots where they do not."""
    names = list(dict.fromkeys(key.rpartition(" ")[0] for key in results["filters"]))
    rows = [
        [re.sub(r"^(\w+) ([\d.]+)$", r"*\1*, r = \2", name), *(_pair(results["filters"][f"{name} {m}"]) for m in NAMES)]
        for name in names
    ]
    return _rows(("shot", *NAMES.values()), rows)


def times(results: Results) -> str:
    """Results: CPU time and memory of whole processes."""
    high, best = (results["times"][f"oidn-{mode}"][0] for mode in ("high", "best"))
    rows = []
    for method, (seconds, _) in results["times"].items():
        rows.append([NAMES[method], *_cost(results, method), f"{seconds / high:.2f}", f"{seconds / best:.2f}"])
    return _rows(("method", "CPU time a frame", "peak memory", "of OIDN high", "of OIDN best"), rows)


# Tables, and the parts that their figures are of.
BLOCKS: dict[str, tuple[Callable[[Results], str], tuple[str, ...]]] = {
    "summary": (summary, ("ladder", "times")),
    "samples": (samples, ("ladder",)),
    "shots": (shots, ("ladder",)),
    "second": (second, ("second",)),
    "rims": (rims, ("second",)),
    "blender": (blender, ("blender",)),
    "default_settings": (default_settings, ("blender",)),
    "filters": (filters, ("filters",)),
    "times": (times, ("times",)),
}


def origin(about: Results) -> str:
    """The line under each block."""
    libraries = ", ".join(f"{name} {number}" for name, number in about["libraries"].items())
    return (
        f"*ravg {about['version']}, revision {about['revision']}, {about['date']}, {about['processor']}, {libraries}.*"
    )


def fill(text: str, results: Results) -> str:
    """A page with its blocks written anew."""

    def block(match: re.Match[str]) -> str:
        make, parts = BLOCKS[match["name"]]
        origins = "\n".join(dict.fromkeys(origin(results["about"][part]) for part in parts))
        return f"<!-- figures: {match['name']} -->\n{make(results)}\n\n{origins}\n<!-- end -->"

    return re.sub(r"<!-- figures: (?P<name>\w+) -->\n.*?<!-- end -->", block, text, flags=re.DOTALL)


# Pictures.


def _beside(images: dict[str, Array], exposure: float) -> Array:
    """Labelled images side by side, each pixel as 2×2, over `exposure`."""
    shown = {
        name: encode_bytes(np.repeat(np.repeat(image, 2, 0), 2, 1) * np.float32(1 / exposure))
        for name, image in images.items()
    }
    for name, image in shown.items():
        write_label(image, NAMES.get(name, name).strip("`"))
    return np.concatenate(list(shown.values()), 1)


def draw_motion(options: argparse.Namespace) -> None:
    """README: seven frames of *kitchen* at 8 samples as they play."""
    shot = open_shot(f"{find_shot('kitchen', options)}/s008.####.exr")
    images = {method: ladder.denoise(shot, method) for method in ("noisy", "oidn-best", "balanced")}
    exposure = display_exposure(images["oidn-best"][0])
    frames = [_beside({m: row[i] for m, row in images.items()}, exposure) for i in range(len(shot.numbers))]
    write_movie(IMAGES / "motion.webp", iter([*frames, *frames[-2:0:-1]]), 8.0)


def draw_flicker(options: argparse.Namespace) -> None:
    """Results: twenty-five times the difference of two frames after motion compensation, of *kitchen*, 32 samples."""
    truth = ladder.Truth(find_shot("kitchen", options))
    shot = truth.shot("s032")
    frames = [shot.read(number) for number in shot.numbers]
    (flow, valid), *_ = (ladder.motion_between(*pair) for pair in pairwise(frames))
    y, x = np.mgrid[: flow.shape[0], : flow.shape[1]].astype(np.float32)
    images = {}
    for method in ("oidn-high", "oidn-best", "balanced", "quality"):
        first, second, *_ = ladder.denoise(shot, method)
        light = float(np.mean(first))
        curves = [image / (image + np.float32(light)) for image in (first, second)]
        moved = cv2.remap(
            curves[1], x + flow[..., 0], y + flow[..., 1], cv2.INTER_CUBIC, borderMode=cv2.BORDER_REPLICATE
        )
        images[method] = np.clip(0.214 + 25 * 0.214 * (moved - curves[0]) * valid[..., None], 0, 1)
    write_png(IMAGES / "flicker.png", _beside(images, 1) / 255)


def draw_filter(options: argparse.Namespace) -> None:
    """README: *classroom* with the filter r = 0.3, 32 samples."""
    with tempfile.TemporaryDirectory() as name:
        folder = Path(name)
        spread(find_shot("classroom", options), folder, 0.3, SPREAD)
        truth = ladder.Truth(folder)
        shot = truth.shot("s032")
        images = {method: ladder.denoise(shot, method)[1] for method in ("noisy", "oidn-best", "balanced")}
        images["1024 samples"] = sum(truth.references[1]) / np.float32(2)
        write_png(IMAGES / "filter.png", _beside(images, display_exposure(images["1024 samples"])) / 255)


PICTURES = {"motion.webp": draw_motion, "flicker.png": draw_flicker, "filter.png": draw_filter}


def write(record: Record, options: argparse.Namespace) -> None:
    """Write the file of figures, the blocks of the pages and the pictures."""
    seconds = {method: cost for method, (cost, _) in record.values["times"].items()}
    ladder.draw(record.values["ladder"], seconds, IMAGES / "ladder.png")
    for draw in PICTURES.values():
        draw(options)
    names = ("ladder.png", *PICTURES)
    hashes = {name: hashlib.sha256((IMAGES / name).read_bytes()).hexdigest() for name in names}
    results = record.values | {"pictures": hashes}
    FIGURES.write_text(json.dumps(results, indent=0) + "\n", encoding="utf-8")
    for page in PAGES:
        path = ROOT / page
        path.write_text(fill(path.read_text(encoding="utf-8"), results), encoding="utf-8")


PARTS = {
    "ladder": measure_ladder,
    "second": measure_second,
    "blender": measure_blender,
    "filters": measure_filters,
    "times": measure_times,
}


def main() -> int:
    parser = argparse.ArgumentParser(description=__doc__.split("\n")[0])
    parser.add_argument("work", type=Path, help="folder of shots and of figures.json")
    parser.add_argument("--parts", nargs="*", choices=PARTS, default=list(PARTS))
    parser.add_argument("--scenes", type=Path, metavar="FOLDER", help="real scenes as .blend files")
    parser.add_argument("--python", type=Path, metavar="FILE", help="Python interpreter with bpy")
    parser.add_argument("--write", action="store_true", help="write pages and pictures")
    options = parser.parse_args()
    options.work.mkdir(parents=True, exist_ok=True)
    record = Record(options.work / "figures.json", options.parts)
    for part in options.parts:
        PARTS[part](record, options)
    if options.write:
        write(record, options)
    return 0


if __name__ == "__main__":
    raise SystemExit(main())
