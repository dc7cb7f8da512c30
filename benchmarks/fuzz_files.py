"""Damage EXR files at random and run the whole command on each: no crash, no hang, no output, one line.

    python benchmarks/fuzz_files.py [--cases 2000] [--seed 0] [--folder DAMAGED] [--json OUT]

Good files of every kind (compressions, tiles, parts, deep, subsampled) are cut short, have bits flipped, bytes of the
header overwritten, or pieces removed, inserted and exchanged; `ravg pseudoref` runs on each in a process of its own.
A case is *refused* (exit code 1, one line, no output), or *read* where what is left is a valid file (exit code 0, a
whole output); all else is a failure, as are more than 5 CPU seconds, or 1 GiB more than before. The same seed makes the
same files. `--folder` runs on every file of a folder instead of making some.
"""

from __future__ import annotations

import argparse
import json
import os
import re
import resource
import shutil
import signal
import struct
import sys
import tempfile
from collections import Counter
from collections.abc import Callable
from dataclasses import dataclass
from pathlib import Path

# A process is forked for each case, which OpenMP's threads would not survive.
os.environ.update(NUMBA_THREADING_LAYER="workqueue", NUMBA_NUM_THREADS="1", OMP_NUM_THREADS="1")

import numpy as np
import OpenEXR

from hybrid.records import FOLDER

SECONDS = 5
BYTES = 2**30
COMPRESSIONS = ("NO", "RLE", "ZIPS", "ZIP", "PIZ", "PXR24", "B44", "B44A", "DWAA", "DWAB")


@dataclass(frozen=True)
class Outcome:
    """How a case ended ("refused", "read", or what was wrong), its CPU time, memory beyond the start, and words."""

    verdict: str
    seconds: float
    bytes: int
    said: str


def good_files(folder: Path) -> dict[str, bytes]:
    """Name → a small file that is read, or refused for what it is, before anything is done to it."""
    rng = np.random.default_rng(0)
    made = {}

    def keep(name: str, parts: list[OpenEXR.Part]) -> None:
        path = folder / "good.exr"
        OpenEXR.File(parts).write(str(path))
        made[name] = path.read_bytes()

    def channels(size: tuple[int, int] = (20, 28)) -> dict[str, np.ndarray]:
        layers = {"Combined": "RGBA", "Denoising Albedo": "RGB", "Denoising Normal": "XYZ"}
        names = [f"ViewLayer.{layer}.{c}" for layer, components in layers.items() for c in components]
        planes = {name: rng.random(size).astype(np.float16) for name in names}
        planes |= {f"ViewLayer.Vector.{c}": rng.normal(size=size).astype(np.float32) for c in "XYZW"}
        planes["ViewLayer.Depth.Z"] = rng.random(size).astype(np.float32)
        return planes | {"id": np.arange(size[0] * size[1], dtype=np.uint32).reshape(size)}

    def header(compression: str = "ZIP", **more: object) -> dict[str, object]:
        kind = getattr(OpenEXR, f"{compression}_COMPRESSION")
        return {"compression": kind, "type": OpenEXR.scanlineimage, "owner": "nobody", "frame": 7, **more}

    for compression in COMPRESSIONS:
        keep(compression, [OpenEXR.Part(header(compression), channels(), "")])
    tiles = OpenEXR.TileDescription()
    tiles.xSize, tiles.ySize = 8, 8
    keep("tiled", [OpenEXR.Part(header(type=OpenEXR.tiledimage, tiles=tiles), channels(), "")])
    keep("parts", [OpenEXR.Part(header(), {n: p for n, p in channels().items() if layer in n}, f"ViewLayer.{layer}")
                   for layer in ("Combined", "Denoising Albedo", "Denoising Normal", "Vector")])  # fmt: skip
    deep = np.empty((6, 6), object)
    for index in np.ndindex(6, 6):
        deep[index] = rng.random(1 + sum(index) % 3).astype(np.float32)
    keep(
        "deep", [OpenEXR.Part({"compression": OpenEXR.ZIPS_COMPRESSION, "type": OpenEXR.deepscanline}, {"Z": deep}, "")]
    )
    half = {c: OpenEXR.Channel(c, rng.random((20, 28)).astype(np.float16), 2, 2) for c in ("BY", "RY")}
    keep("luminance-chroma", [OpenEXR.Part(header(), {"Y": rng.random((20, 28)).astype(np.float16), **half}, "")])
    return made


def header_size(data: bytes) -> int:
    """Bytes before the table of chunks, roughly: a header ends with an empty attribute name."""
    end = data.rfind(b"screenWindowWidth")
    return min(len(data), 8 + max(end, 64) + 40)


def cut(data: bytes, rng: np.random.Generator) -> bytes:
    """Only the beginning, and rarely less than the header."""
    first = 0 if rng.random() < 0.2 else header_size(data)
    return data[: int(rng.integers(first, len(data)))]


def flip(data: bytes, rng: np.random.Generator) -> bytes:
    """1 to 16 bits, anywhere."""
    out = bytearray(data)
    for position in rng.integers(0, len(out), 2 ** int(rng.integers(0, 5))):
        out[position] ^= 1 << int(rng.integers(8))
    return bytes(out)


def change_header(data: bytes, rng: np.random.Generator) -> bytes:
    """One to four bytes or 32-bit numbers of the header, by values that have broken readers before."""
    out = bytearray(data)
    numbers = (0, 1, 2, 255, 16384, 65535, 65536, 2**24, 2**30, 2**31 - 1, -1, -2, -(2**31))
    for _ in range(int(rng.integers(1, 5))):
        at = int(rng.integers(4, header_size(data) - 4))
        if rng.random() < 0.5:
            out[at] = int(rng.integers(256))
        else:
            out[at : at + 4] = struct.pack("<i", numbers[int(rng.integers(len(numbers)))])
    return bytes(out)


def change_size(data: bytes, rng: np.random.Generator) -> bytes:
    """The data window or the display window: huge, negative, inverted, moved far away."""
    out = bytearray(data)
    places = [match.end() for match in re.finditer(rb"(?:data|display)Window\0box2i\0\x10\0\0\0", data)]
    at = places[int(rng.integers(len(places)))] + 4 * int(rng.integers(4))
    size = int(2 ** rng.uniform(0, 31)) * int(rng.choice([-1, 1]))
    out[at : at + 4] = struct.pack("<i", max(min(size, 2**31 - 1), -(2**31)))
    return bytes(out)


def rearrange(data: bytes, rng: np.random.Generator) -> bytes:
    """Take out, double or exchange pieces of up to 64 bytes."""
    a, b = sorted(int(n) for n in rng.integers(0, len(data) - 64, 2))
    length = int(rng.integers(1, 65))
    kind = int(rng.integers(3))
    if kind == 0:
        return data[:a] + data[a + length :]
    if kind == 1:
        return data[:b] + data[a : a + length] + data[b:]
    b = max(b, a + length)
    return data[:a] + data[b : b + length] + data[a + length : b] + data[a : a + length] + data[b + length :]


DAMAGES: dict[str, Callable[[bytes, np.random.Generator], bytes]] = {
    "cut short": cut, "bits flipped": flip, "header changed": change_header, "size changed": change_size,
    "pieces moved": rearrange,
}  # fmt: skip


def run_case(source: Path, folder: Path) -> Outcome:
    """Run the command on one file in a process of its own."""
    from hybrid.cli import main
    from hybrid.files.exr import read_exr

    output, said = folder / "out", folder / "said"
    child = os.fork()
    if child == 0:
        with said.open("wb") as sink:
            os.dup2(sink.fileno(), 1)
            os.dup2(sink.fileno(), 2)
        resource.setrlimit(resource.RLIMIT_CORE, (0, 0))
        resource.setrlimit(resource.RLIMIT_CPU, (4 * SECONDS, 4 * SECONDS))  # what hangs is killed,
        signal.alarm(60)  # also where it waits
        before = resource.getrusage(resource.RUSAGE_SELF).ru_maxrss
        try:
            code = main(["pseudoref", str(source), "-o", str(output / "done.exr"), "--preset", "draft"])
        except BaseException as error:
            os.write(2, f"\nTraceback: {error!r}\n".encode())
            code = 99
        grown = resource.getrusage(resource.RUSAGE_SELF).ru_maxrss - before
        (folder / "grown").write_text(str(1024 * grown))
        sys.stdout.flush()
        os._exit(code)
    _, status, usage = os.wait4(child, 0)
    seconds = usage.ru_utime + usage.ru_stime
    grown = int((folder / "grown").read_text()) if (folder / "grown").exists() else 0
    text = said.read_text(errors="replace")
    left = sorted(path.name for path in output.glob("*") if path.name != FOLDER) if output.exists() else []
    errors = [line for line in text.splitlines() if line.startswith("error: ")]
    code = os.waitstatus_to_exitcode(status)
    if code < 0:
        verdict = f"killed by signal {-code}"
    elif seconds > SECONDS:
        verdict = f"took {seconds:.1f} s"
    elif grown > BYTES:
        verdict = f"took {grown / 2**20:.0f} MiB"
    elif code == 1:
        verdict = "refused"
        if left:
            verdict = f"left {left} behind"
        elif len(errors) != 1 or "Traceback" in text or not text.rstrip().splitlines()[-1].startswith("error: "):
            verdict = "did not end in one line"
    elif code == 0:
        verdict = "read"
        try:
            read_exr(output / "done.exr")
        except (ValueError, OSError) as error:
            verdict = f"wrote what cannot be read: {error}"
    else:
        verdict = f"exit code {code}"
    shutil.rmtree(output, ignore_errors=True)
    (folder / "grown").unlink(missing_ok=True)
    return Outcome(verdict, seconds, grown, text)


def fuzz(
    cases: int, seed: int, folder: Path, keep: Path | None = None
) -> tuple[dict[str, Counter[str]], list[Outcome]]:
    """Run seeded cases; count the outcomes of each kind of damage, and keep the files that failed in `keep`."""
    goods = good_files(folder)
    counts: dict[str, Counter[str]] = {name: Counter() for name in DAMAGES}
    outcomes = []
    source = folder / "case.exr"
    for number in range(cases):
        rng = np.random.default_rng((seed, number))
        damage = list(DAMAGES)[number % len(DAMAGES)]
        base = list(goods)[int(rng.integers(len(goods)))]
        source.write_bytes(DAMAGES[damage](goods[base], rng))
        outcome = run_case(source, folder)
        outcomes.append(outcome)
        good = outcome.verdict in ("refused", "read")
        counts[damage][outcome.verdict if good else "failed"] += 1
        if not good:
            print(f"case {number} ({damage}, {base}): {outcome.verdict}\n{outcome.said[-2000:]}", flush=True)
            if keep is not None:
                keep.mkdir(parents=True, exist_ok=True)
                (keep / f"{seed}.{number}.exr").write_bytes(source.read_bytes())
    return counts, outcomes


def main(argv: list[str] | None = None) -> int:
    parser = argparse.ArgumentParser(description=__doc__.split("\n")[0])
    parser.add_argument("--cases", type=int, default=2000)
    parser.add_argument("--seed", type=int, default=0)
    parser.add_argument("--folder", type=Path, help="run on the files of this folder")
    parser.add_argument("--keep", type=Path, help="folder for the files that failed")
    parser.add_argument("--json", type=Path, help="write the counts there too")
    options = parser.parse_args(argv)
    with tempfile.TemporaryDirectory() as name:
        folder = Path(name)
        # Once, so that every case starts with all code loaded, and its time and memory are its own.
        warm = folder / "warm.exr"
        warm.write_bytes(good_files(folder)["ZIP"])
        if (outcome := run_case_here(warm, folder)) != 0:
            print(f"the undamaged file ended with {outcome}")
            return 1
        if options.folder is not None:
            counts: dict[str, Counter[str]] = {"given": Counter()}
            outcomes = []
            for path in sorted(options.folder.iterdir()):
                outcomes.append(run_case(path, folder))
                good = outcomes[-1].verdict in ("refused", "read")
                counts["given"][outcomes[-1].verdict if good else "failed"] += 1
                if not good:
                    print(f"{path.name}: {outcomes[-1].verdict}\n{outcomes[-1].said[-2000:]}")
        else:
            counts, outcomes = fuzz(options.cases, options.seed, folder, options.keep)
    result = {
        "cases": len(outcomes),
        "seed": options.seed,
        "counts": {damage: dict(count) for damage, count in counts.items()},
        "failed": sum(count["failed"] for count in counts.values()),
        "longest_seconds": round(max(outcome.seconds for outcome in outcomes), 2),
        "most_mib": round(max(outcome.bytes for outcome in outcomes) / 2**20),
    }
    print(json.dumps(result))
    if options.json is not None:
        options.json.write_text(json.dumps(result, indent=2) + "\n", encoding="utf-8")
    return 1 if result["failed"] else 0


def run_case_here(source: Path, folder: Path) -> int:
    """Run the command in this very process."""
    from hybrid.cli import main

    stderr = os.dup(2)
    with (folder / "warm").open("wb") as sink:
        os.dup2(sink.fileno(), 2)
        code = main(["pseudoref", str(source), "-o", str(folder / "warm.out.exr"), "--preset", "draft"])
        os.dup2(stderr, 2)
    return code


if __name__ == "__main__":
    raise SystemExit(main())
