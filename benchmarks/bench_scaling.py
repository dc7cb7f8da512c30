"""Growth of the cost of a preset with pixels, frames and the window, and its serial share, as JSON.

    python benchmarks/bench_scaling.py pixels    # 320×180 to 3840×2160
    python benchmarks/bench_scaling.py frames    # 1 to 300 frames of 320×180
    python benchmarks/bench_scaling.py window    # windows of 3 to 9 frames, with the network of `fast`
    python benchmarks/bench_scaling.py jobs      # one process and several, `--frames 40` or so
    python benchmarks/bench_scaling.py cores     # the serial share (Linux)

Runs are whole processes on the shot *pan* (`bench_shot.py`); each row but those of `cores` has the CPU seconds and the
peak memory of one run, with several processes that of the largest. `cores` runs the same command on one and on two
cores, `--pairs` times in turn. With s the serial and p the parallel seconds of a run, one core takes s + p and n cores
s + p / n (Amdahl): two measured times give both. The model uses the run on two cores alone: a core that waits costs no
CPU seconds, so a stage of W seconds and C CPU seconds has 2 W − C serial ones. It predicts C seconds on one core, to
compare with those measured. Seconds on 16 and 64 cores are computed, not measured.
"""

import argparse
import json
import os
import statistics
import sys
import tempfile
from collections.abc import Callable, Sequence
from functools import partial
from pathlib import Path

from bench_shot import measure, write_shot

from hybrid.run.records import read_records

SCALES = (1, 2, 4, 6, 8, 12)  # times 320×180
FRAMES = (1, 3, 10, 30, 100, 300)
WINDOWS = (3, 5, 7, 9)
JOBS = (1, 2, 4)


def run(folder: Path, frames: int, scale: int, options: Sequence[str]) -> dict[str, float]:
    """Denoise a shot of so many frames, which is written if it is not there, and measure the process."""
    shot = folder / f"{frames}x{scale}"
    pattern = str(shot / "pan.####.exr") if shot.exists() else write_shot("pan", shot, frames, scale)
    out = folder / "out"
    return measure([sys.executable, "-m", "hybrid.cli", "denoise", pattern, "-o", str(out), *options])


def network(folder: Path, frames: int) -> list[str]:
    """Options that run the network of `fast` on windows of another length; its pictures are of no use."""
    from network.checkpoint import load_model, save_model, shipped_weights
    from network.robust_unet import RobustUNet, RobustUNetConfig

    shipped = load_model(shipped_weights("balanced"))
    model = RobustUNet(RobustUNetConfig(frames, shipped.config.size))
    model.load_state_dict(shipped.state_dict())
    save_model(folder / f"{frames}.safetensors", model)
    return ["--weights", str(folder / f"{frames}.safetensors")]


def on_cores(count: int, command: Callable[[], dict[str, float]], out: Path) -> tuple[float, float, dict[str, float]]:
    """Run a command on so many cores; its seconds, CPU seconds, and the serial seconds of each stage by the model."""
    before, names = os.sched_getaffinity(0), ("NUMBA_NUM_THREADS", "OMP_NUM_THREADS")
    os.sched_setaffinity(0, sorted(before)[:count])
    os.environ.update(dict.fromkeys(names, str(count)))
    try:
        whole = command()
    finally:
        os.sched_setaffinity(0, before)
    *_, (_, report) = read_records(out)
    stages = {name: (each["seconds"], each["cpu_seconds"]) for name, each in report["stages"].items()}
    wall, cpu = whole["seconds"], whole["cpu_seconds"]
    stages["outside"] = wall - sum(each for each, _ in stages.values()), cpu - sum(each for _, each in stages.values())
    return wall, cpu, {name: round(max(2 * each - spent, 0.0), 2) for name, (each, spent) in stages.items()}


def serial_share(command: Callable[[], dict[str, float]], out: Path, pairs: int) -> dict[str, object]:
    """Serial share of a command by both ways, from medians over the pairs; seconds computed for many cores."""
    both = [[on_cores(count, command, out) for count in (1, 2)] for _ in range(pairs)]
    one, two = (statistics.median(pair[n][0] for pair in both) for n in (0, 1))
    cpu = statistics.median(pair[1][1] for pair in both)
    serial = 2 * two - one
    return {
        "seconds_on_one": round(one, 2),
        "seconds_on_two": round(two, 2),
        "serial_share": round(serial / one, 3),
        "model": {"seconds_on_one": round(cpu, 2), "serial_share": round((2 * two - cpu) / cpu, 3)},
        "serial_seconds_of_stages": both[-1][1][2],
        "computed": {cores: round(serial + (one - serial) / cores, 2) for cores in (16, 64)},
    }


def main(argv: list[str] | None = None) -> int:
    parser = argparse.ArgumentParser(description=__doc__.split("\n")[0])
    parser.add_argument("over", choices=("pixels", "frames", "window", "jobs", "cores"))
    parser.add_argument("--preset", default="balanced")
    parser.add_argument("--frames", type=int, default=5, help="of each run, but over frames (default: 5)")
    parser.add_argument("--scale", type=int, default=6, help="of 320×180, for window and cores (default: 6)")
    parser.add_argument("--values", type=int, nargs="+", help="scales, frames, windows or jobs, in place of all")
    parser.add_argument("--pairs", type=int, default=3, help="of runs on one and two cores (default: 3)")
    options = parser.parse_args(argv)
    preset = ["--preset", options.preset]
    with tempfile.TemporaryDirectory() as name:
        folder = Path(name)
        run(folder, 1, 1, preset)  # compiles
        if options.over == "cores":
            command = partial(run, folder, options.frames, options.scale, preset)
            print(json.dumps(serial_share(command, folder / "out", options.pairs)))
            return 0
        values = {"pixels": SCALES, "frames": FRAMES, "window": WINDOWS, "jobs": JOBS}
        for value in options.values or values[options.over]:
            frames, scale = options.frames, 1 if options.over == "frames" else options.scale
            frames, scale = {"pixels": (frames, value), "frames": (value, 1)}.get(options.over, (frames, scale))
            asked = [*preset, "--jobs", str(value)] if options.over == "jobs" else preset
            if options.over == "window":
                asked = network(folder, value)
                run(folder, 1, 1, asked)  # compiles loops for this length
            cost = run(folder, frames, scale, asked)
            print(json.dumps({options.over: value, **{key: round(each, 2) for key, each in cost.items()}}), flush=True)
    return 0


if __name__ == "__main__":
    raise SystemExit(main())
