"""Attacks of another kind than those of `reliability.py`: on resuming, records, numbering, odd frames, odd places.

    python benchmarks/attacks.py [--only ROW …] [--against CHECKOUT] [--json OUT]

The rows go on where those of `reliability.py` end.
"""

# ruff: noqa: E501 - tables of cases, one a line

from __future__ import annotations

import atexit
import json
import os
import shutil
import socket
import subprocess
import sys
import tempfile
import threading
import time
import urllib.request
from collections.abc import Callable, Sequence
from functools import lru_cache, partial
from pathlib import Path

import numpy as np
import OpenEXR
from reliability import rendered_again
from trial import (
    DRAFT,
    PACKAGES,
    SIZE,
    Cases,
    Done,
    Edit,
    Layers,
    UntriedError,
    alone,
    blurred,
    color,
    contents,
    differ,
    first_of,
    grained,
    header,
    names,
    ravg,
    read,
    run,
    shot,
    wall,
    write,
)

ALBEDO = "ViewLayer.Denoising Albedo"


def apart(folder: Path, layer: str, *, seed: int = 0, count: int = 6, name: str = "{:04d}.exr") -> Path:
    """A sequence that holds one layer."""
    for index in range(count):
        found = wall(index, SIZE, (2, 1))[layer]
        noise = np.random.default_rng((seed, index)).normal(0, 0.02 * bool(seed), found.shape)
        path = folder / name.format(1001 + index)
        write(path, {"": (found + noise).astype(np.float32)}, compression=OpenEXR.NO_COMPRESSION)
        os.utime(path, (1.7e9, 1.7e9))
    return folder


# --- 15: resuming with what else may have changed


def as_fresh(
    before: Sequence[object],
    after: Sequence[object],
    change: Callable[[Path], object],
    folder: Path,
    command: Sequence[object] = ("pseudoref", *DRAFT),
    edit: Edit | None = None,
) -> str | None:
    """After another run with --resume the frames are those of a run into an empty folder."""
    shot(folder / "in", 6, edit, step=(2, 1), compression=OpenEXR.NO_COMPRESSION)
    apart(folder / "albedo", ALBEDO)
    (folder / "mine.toml").write_text(MINE)
    shutil.copy(PACKAGES / "network" / "weights" / "fast.safetensors", folder / "w.safetensors")
    name, *options = command
    words = [name, "in", *options]
    if failed := ravg(*words, "-o", "out", *before, folder=folder).failed:
        return failed
    change(folder)
    for out in ("out", "fresh"):
        if failed := ravg(*words, "-o", out, *after, *(["--resume"] if out == "out" else []), folder=folder).failed:
            return failed
    return differ(folder / "fresh", folder / "out", names(folder / "fresh"))


MINE = """
[layers]
color = ["Combined"]
albedo = ["Denoising Albedo"]
normal = ["Denoising Normal"]
motion = ["Vector"]
[motion]
direction = "both"
y = "up"
"""


def nothing(folder: Path) -> None:
    """As it was."""


def newer(path: str, text: str) -> Callable[[Path], object]:
    return lambda folder: (folder / path).write_text(text)


def two_layers(index: int, layers: Layers) -> None:
    layers |= {name.replace("ViewLayer", "Fog"): layer.copy() for name, layer in layers.items()}


def second_layer_rendered_again(folder: Path) -> None:
    """Only the second view layer of a frame changes, in the same number of bytes, at the same time."""
    path = folder / "in" / "shot.1003.exr"
    stamp, data = path.stat().st_mtime, read(path)
    data["Fog.Combined.R"] = data["Fog.Combined.R"][::-1].copy()
    kept = {k: v for k, v in header(path).items() if k != "channels"}
    stored = {name: OpenEXR.Channel(name, pixels) for name, pixels in data.items()}
    OpenEXR.File([OpenEXR.Part(kept, stored, "")]).write(str(path))
    os.utime(path, (stamp, stamp))


def row_15() -> Cases:
    albedo = ["--layer", "albedo=albedo/####.exr"]
    for name, before, after, change in (
        ("--motion none", [], ["--motion", "none"], nothing),
        ("--motion next", [], ["--motion", "next,y-up"], nothing),
        ("--motion, another scale", ["--motion", "both,y-up"], ["--motion", "both,y-up,scale=2"], nothing),
        ("a profile instead of none", [], ["--profile", "mine.toml"], nothing),
        (
            "a profile that was edited",
            ["--profile", "mine.toml"],
            ["--profile", "mine.toml"],
            newer("mine.toml", MINE.replace('"up"', '"down"')),
        ),
        ("albedo from elsewhere", [], albedo, nothing),
        ("albedo from elsewhere made again, at the same time", albedo, albedo, lambda f: apart(f / "albedo", ALBEDO, seed=3)),
        ("albedo from elsewhere, another sequence", albedo, ["--layer", "albedo=in/shot.####.exr:ViewLayer.Combined"], nothing),
        ("a part of the frames first", ["--frames", "1002-1003"], [], nothing),
        ("every second frame first", ["--frames", "1001-1005x2"], [], nothing),
        ("with and without --max-memory", ["--max-memory", "4G"], [], nothing),
        ("frames renumbered by one", [], [], lambda f: [p.rename(p.with_name(f"shot.{int(p.name[5:9]) + 1}.exr")) for p in sorted((f / "in").iterdir(), reverse=True)]),
        ("the first frame gone", [], [], lambda f: (f / "in" / "shot.1001.exr").unlink()),
        ("a frame in the middle gone", [], [], lambda f: (f / "in" / "shot.1003.exr").unlink()),
        ("another compression, the same pixels", [], [], lambda f: write(f / "in" / "shot.1002.exr", _layers_of(f / "in" / "shot.1002.exr"))),
        ("outputs that were exchanged", [], [], lambda f: _exchange(f / "out" / "shot.1002.exr", f / "out" / "shot.1005.exr")),
        ("an output made read-only and old", [], ["--preset", "draft", "--no-stages", "gate"], lambda f: os.chmod(f / "out" / "shot.1002.exr", 0o444)),
    ):  # fmt: skip
        yield name, partial(as_fresh, before, after, change)
    layered = partial(as_fresh, [], [], edit=two_layers)
    yield "two view layers", partial(layered, nothing)
    yield "two view layers, of which one is rendered again", partial(layered, second_layer_rendered_again)
    yield (
        "two view layers, then one alone",
        partial(as_fresh, [], ["--layer", "color=Fog.Combined"], nothing, edit=two_layers),
    )
    kernels = ["denoise", "--preset", "tkpcn"]
    yield "another threshold", partial(as_fresh, [], ["--threshold", "0.3"], nothing, command=kernels)
    network = ["denoise", "--estimate", "nlm", "--weights", "w.safetensors"]
    for name, before, after, change in (
        ("another precision", ["--precision", "bfloat16"], ["--precision", "float32"], nothing),
        ("a layer denoised along", [], ["--aov", "ViewLayer.Denoising Albedo"], nothing),
        ("two passes", [], ["--passes", "2"], nothing),
        ("two passes, and a frame rendered again", ["--passes", "2"], ["--passes", "2"], lambda f: rendered_again(f / "in" / "shot.1001.exr")),
        ("two passes, and then one", ["--passes", "2"], [], nothing),
        ("other weights under one name", [], [], lambda f: shutil.copy(PACKAGES / "network/weights/quality.safetensors", f / "w.safetensors")),
    ):  # fmt: skip
        yield name, partial(as_fresh, before, after, change, command=network)


def _layers_of(path: Path) -> Layers:
    found = read(path)
    groups = dict.fromkeys(name.rpartition(".")[0] for name in found)
    order = "RGBAXYZW"
    return {
        g: np.stack([found[c] for c in sorted((c for c in found if c.rpartition(".")[0] == g), key=lambda c: order.find(c[-1]))], -1)
        for g in groups
    }  # fmt: skip


def _exchange(a: Path, b: Path) -> None:
    spare = a.with_name("spare")
    a.rename(spare)
    b.rename(a)
    spare.rename(b)


# --- 16: estimates from a sequence that does not fit


def estimates_that_do_not_fit(
    change: Callable[[Path], object], more: Sequence[object], fits: bool, folder: Path
) -> str | None:
    shot(folder / "in", 8, step=(2, 1))
    blurred(folder / "single", folder / "in")
    change(folder / "single")
    done = ravg("pseudoref", "in", "-o", "out", *DRAFT, "--estimate", "single", *more, folder=folder)
    if fits:
        return done.failed
    return first_of(done.refused, f"{len(names(folder / 'out'))} frames were made" if names(folder / "out") else None)


def resized(path: Path) -> None:
    layers = {name: layer[:-2] for name, layer in wall(0).items()}
    write(path, layers)


def row_16() -> Cases:
    def gone(*numbers: int) -> Callable[[Path], object]:
        return lambda f: [(f / f"shot.{n}.exr").unlink() for n in numbers]

    def renumbered(by: int) -> Callable[[Path], object]:
        return lambda f: [p.rename(f / f"x.{int(p.name[5:9]) + by}.exr") for p in sorted(f.iterdir())]

    for name, change, more, fits in (
        ("one frame missing", gone(1003), [], False),
        ("a frame missing that was not asked for", gone(1008), ["--frames", "1002-1003"], True),
        ("a neighbour missing", gone(1004), ["--frames", "1002-1003"], True),
        ("a frame missing that was asked for", gone(1003), ["--frames", "1002-1003"], False),
        ("all missing but one", gone(*range(1002, 1009)), [], False),
        ("frames of other numbers", renumbered(100), [], False),
        ("frames numbered from one", renumbered(-1000), [], False),
        ("one frame of another size", lambda f: resized(f / "shot.1001.exr"), [], False),
        ("two sequences", lambda f: shutil.copy(f / "shot.1001.exr", f / "other.1001.exr"), [], False),
        ("an empty folder", gone(*range(1001, 1009)), [], False),
        ("a pipe in a frame's place", lambda f: [(f / "shot.1001.exr").unlink(), os.mkfifo(f / "shot.1001.exr")], [], False),
        ("a text in a frame's place", lambda f: (f / "shot.1001.exr").write_text("x"), [], False),
        ("a frame without color", lambda f: write(f / "shot.1001.exr", {"Depth": np.ones(SIZE, np.float32)}), [], False),
    ):  # fmt: skip
        yield name, partial(estimates_that_do_not_fit, change, more, fits)


# --- 17: records


@lru_cache(maxsize=1)
def _denoised() -> Path:
    """A shot of two frames, denoised, to be copied."""
    folder = Path(tempfile.mkdtemp(prefix="ravg-made-"))
    atexit.register(shutil.rmtree, folder, ignore_errors=True)
    shot(folder / "in", 2)
    if ravg("pseudoref", "in", "-o", "out", *DRAFT, folder=folder).failed or not [*folder.rglob("*.json")]:
        raise UntriedError("there are no records")
    return folder


def hostile_record(text: str | Callable[[dict], object], folder: Path) -> str | None:
    """`ravg status` says what it can, and a run goes on; neither crashes."""
    shutil.copytree(_denoised(), folder, dirs_exist_ok=True)
    (record,) = (folder / "out").rglob("*.json")
    if isinstance(text, str):
        record.write_bytes(text.encode("utf-8", "surrogateescape"))
    else:
        document = json.loads(record.read_text())
        text(document)
        record.write_text(json.dumps(document))
    for words in (["status", "out"], ["status", "out/shot.####.exr", "--json", "--frames", "1001-1002"]):
        done = ravg(*words, folder=folder, seconds=30, memory=2 * 2**30)
        if "Traceback" in done.said or done.code not in (0, 1):
            return f"{' '.join(words)}: exit code {done.code}: {done.said.strip()[-150:]}"
        if any(not c.isprintable() and c != "\n" for c in done.said):
            return "what would command a terminal is shown"
    return None


def set_to(value: object, *keys: str) -> Callable[[dict], object]:
    def change(document: dict) -> None:
        at = document
        for key in keys[:-1]:
            at = at[key]
        at[keys[-1]] = value

    return change


def no_success(change: Callable[[dict], object], folder: Path) -> str | None:
    """Frames that are not there are not finished, whatever a record says."""
    shutil.copytree(_denoised(), folder, dirs_exist_ok=True)
    (record,) = (folder / "out").rglob("*.json")
    document = json.loads(record.read_text())
    (folder / "outside.exr").write_text("x")
    (folder / "out" / "shot.1002.exr").unlink()
    change(document)
    record.write_text(json.dumps(document))
    done = ravg("status", "out", folder=folder)
    return None if done.code == 1 and "Traceback" not in done.said else f"exit code {done.code}: {done.said[-200:]}"


def special_record(make: Callable[[Path], object], folder: Path) -> str | None:
    shot(folder / "in", 2)
    (folder / "out" / "ravg").mkdir(parents=True)
    make(folder / "out" / "ravg" / "shot.1001-1002.json")
    make(folder / "out" / "ravg" / "other.1.json")
    for words in (["status", "out"], ["pseudoref", "in", "-o", "out", *DRAFT]):
        done = ravg(*words, folder=folder, seconds=60)
        if done.code == -9:
            return f"{words[0]} hangs"
        if "Traceback" in done.said:
            return f"{words[0]}: traceback"
    return None


def row_17() -> Cases:
    for text in (
        "",
        "null",
        "[]",
        "{}",
        "[" * 10**5,
        '{"a":' * 10**5,
        "\udcff\udcfe",
        '{"ravg": 1, "asked": [1e999], "frames": {}, "started": 0, "state": "running"}',
    ):
        yield f"a record {text[:10].encode('utf-8', 'replace')!r}", partial(hostile_record, text)
    for keys in (
        ("asked",),
        ("frames",),
        ("started",),
        ("state",),
        ("host",),
        ("process",),
        ("updated",),
        ("peak_bytes",),
    ):
        for value in (None, "x", [{}], 10**400):
            yield f"{'.'.join(keys)} is {str(value)[:12]}", partial(hostile_record, set_to(value, *keys))
    for value in (
        None,
        "x",
        [],
        {},
        {"state": "made"},
        {"state": "made", "seconds": "x", "file": 3},
        {"state": "failed"},
        {"state": "failed", "error": "\x1b[2J\n[red]"},
    ):
        yield f"a frame's entry is {str(value)[:30]}", partial(hostile_record, set_to(value, "frames", "1001"))
    yield "a frame called x", partial(hostile_record, set_to({"state": "made"}, "frames", "x"))
    yield "markup as host", partial(hostile_record, set_to("[red]\x1b[2J", "host"))
    for name in ("../outside.exr", "../../outside.exr", "shot.1001.exr", ".", "", "/dev/null", "a\0b"):
        change = partial(lambda name, d: d["frames"]["1002"].update(file=name), name)
        yield f"the file of a frame is {name!r}", partial(no_success, change)
    yield "a record that is a pipe", partial(special_record, lambda p: os.mkfifo(p))
    yield "a record that is a folder", partial(special_record, lambda p: p.mkdir())
    yield "a record that links to itself", partial(special_record, lambda p: p.symlink_to(p))
    yield "a record that links to a device", partial(special_record, lambda p: p.symlink_to("/dev/zero"))


# --- 18: the viewer


def watched(name: bytes, prepare: Callable[[Path], object], folder: Path) -> str | None:
    """The page answers: its state, and a frame, whatever the folder is called and whatever else lies there."""
    out = Path(os.fsdecode(os.fsencode(folder) + b"/" + name))
    shot(folder / "plain", 2).rename(out)  # the library writes to no name that is not UTF-8
    prepare(out)
    words = [sys.executable, "-P", "-m", "hybrid.cli", "view", os.fsencode(out), "--no-browser"]
    environment = {**os.environ, "PYTHONPATH": str(PACKAGES), "PYTHONUNBUFFERED": "1"}
    child = subprocess.Popen(words, env=environment, stdout=subprocess.PIPE, stderr=subprocess.STDOUT)
    assert child.stdout is not None
    try:
        line = child.stdout.readline().decode("utf-8", "replace").strip()
        if not line.startswith("http://"):
            return line + child.stdout.read(500).decode("utf-8", "replace")
        with urllib.request.urlopen(f"{line}state", timeout=30) as answer:
            state = json.loads(answer.read())
        sequence = state["sequences"][0]
        if len(sequence["frames"]) < 2:
            return f"frames {sequence['frames']}"
        layer = urllib.request.quote(sequence["layer"])  # type: ignore[attr-defined]
        with urllib.request.urlopen(f"{line}frame/0/1002.png?ev=0&layer={layer}", timeout=30) as answer:
            return None if answer.read(4)[1:] == b"PNG" else "no picture"
    finally:
        child.terminate()
        child.wait(30)


def row_18() -> Cases:
    for name in (
        b"a#b",
        b"%04d",
        b"[1]",
        b"a b ",
        b"caf\xe9",
        "渲染".encode(),
        b"a'b\"c",
        b"<script>",
        b"a\nb",
        b"?x=1&y",
        b"..x",
    ):
        yield f"a folder called {name!r}", partial(watched, name, nothing)
    yield (
        "a record that is a pipe",
        partial(watched, b"x", lambda f: [(f / "ravg").mkdir(), os.mkfifo(f / "ravg" / "shot.1.json")]),
    )
    yield (
        "a record that is hostile",
        partial(
            watched,
            b"x",
            lambda f: [
                (f / "ravg").mkdir(),
                (f / "ravg" / "shot.1.json").write_text(
                    '{"ravg": 1, "asked": 1, "frames": [], "started": [], "state": {}}'
                ),
            ],
        ),
    )
    yield "a picture of Windows' desktop", partial(watched, b"x", lambda f: (f / "desktop.ini").write_bytes(b"\xff"))


# --- 19: odd places


def one_place(words: Callable[[Path], Sequence[object]], ends: str, folder: Path) -> str | None:
    """What is there stays there; it works, or it is refused."""
    shot(folder / "in", 3)
    blurred(folder / "single", folder / "in")
    given = words(folder)
    before = contents(folder / "in", folder / "single")
    done = ravg(*given, folder=folder, seconds=60)
    if any(not path.exists() or path.read_bytes() != data for path, data in before.items()):
        return "a file that was there is another now"
    if "Traceback" in done.said or done.code == -9:
        return done.said.strip()[-200:] or "it hangs"
    wanted = {"works": done.failed, "refused": done.refused, "either": done.refused if done.code else None}
    return wanted[ends]


def linked(folder: Path, name: str, to: str) -> str:
    (folder / name).symlink_to(folder / to)
    return name


def row_19() -> Cases:
    def base(*words: object) -> list[object]:
        return ["pseudoref", "in", *DRAFT, *words]

    for name, words, ends in (
        ("an output by a link to a folder", lambda f: [(f / "real").mkdir(), base("-o", linked(f, "out", "real"))][1], "works"),
        ("an output by a link to the input", lambda f: base("-o", linked(f, "out", "in")), "refused"),
        ("an output by a dangling link", lambda f: base("-o", linked(f, "out", "none")), "either"),
        ("an output within the input", lambda f: base("-o", "in/out"), "works"),
        ("another name in the input's folder", lambda f: ["pseudoref", "in/shot.####.exr", *DRAFT, "-o", "in/done.####.exr"], "works"),
        ("the input's name in other letters", lambda f: ["pseudoref", "in/shot.####.exr", *DRAFT, "-o", "in/SHOT.####.EXR"], "either"),
        ("the input, padded otherwise", lambda f: ["pseudoref", "in/shot.####.exr", *DRAFT, "-o", "in/shot.#.exr"], "refused"),
        ("the input by ./", lambda f: base("-o", "./in/../in/./shot.####.exr"), "refused"),
        ("hard links as frames", lambda f: [(f / "in/shot.1004.exr").hardlink_to(f / "in/shot.1001.exr"), base("-o", "out")][1], "works"),
        ("links as frames", lambda f: [(f / "in/shot.1004.exr").symlink_to("shot.1001.exr"), base("-o", "out")][1], "works"),
        ("an output that links to a frame", lambda f: [(f / "out").mkdir(), (f / "out/shot.1002.exr").symlink_to(f / "in/shot.1001.exr"), base("-o", "out")][2], "refused"),
        ("an output that links to a stranger's", lambda f: [(f / "out").mkdir(), (f / "single/x").write_text("x"), (f / "out/shot.1002.exr").symlink_to(f / "single/x"), base("-o", "out")][3], "either"),
        ("an output that is a folder", lambda f: [(f / "out/shot.1002.exr").mkdir(parents=True), base("-o", "out")][1], "refused"),
        ("an output that is a pipe", lambda f: [(f / "out").mkdir(), os.mkfifo(f / "out/shot.1002.exr"), base("-o", "out")][2], "refused"),
        ("a preview that is an output", lambda f: base("-o", "out", "--preview", "out/shot.1002.exr"), "refused"),
        ("a preview without an extension", lambda f: base("-o", "out", "--preview", "out/x"), "refused"),
        ("a preview in a folder that is not there", lambda f: base("-o", "out", "--preview", "no/such/x.png"), "either"),
        ("a preview and a sheet in one file", lambda f: base("-o", "out", "--preview", "x.png", "--contact", "./x.png"), "refused"),
        ("a log that is a frame", lambda f: base("-o", "out", "--log-file", "in/shot.1002.exr"), "refused"),
        ("a log that is an output", lambda f: base("-o", "out", "--log-file", "out/shot.1002.exr"), "refused"),
        ("a log that is the preview", lambda f: base("-o", "out", "--log-file", "x.png", "--preview", "x.png"), "refused"),
        ("a log that is the record", lambda f: base("-o", "out", "--log-file", "out/ravg/shot.1001-1003.json"), "refused"),
        ("a log that is a pipe", lambda f: [os.mkfifo(f / "pipe"), base("-o", "out", "--log-file", "pipe")][1], "refused"),
        ("a log that is a folder", lambda f: base("-o", "out", "--log-file", "in"), "refused"),
        ("records in a folder that is a file", lambda f: [(f / "out").mkdir(), (f / "out/ravg").write_text("x"), base("-o", "out")][2], "refused"),
        ("estimates that are the input", lambda f: base("-o", "out", "--estimate", "in"), "either"),
        ("estimates in the output", lambda f: base("-o", "single", "--estimate", "single"), "refused"),
        ("a very long name", lambda f: base("-o", "x" * 240 + ".####.exr"), "either"),
        ("a name that is too long", lambda f: base("-o", "x" * 300 + ".####.exr"), "refused"),
        ("a path that is too long", lambda f: base("-o", "/".join(["x" * 200] * 30)), "refused"),
        ("a name with a zero", lambda f: base("-o", "a\0b"), "refused"),
        ("a pattern with two places", lambda f: base("-o", "out_##/x.####.exr"), "works"),
        ("one name for several frames", lambda f: base("-o", "out/x.exr"), "refused"),
        ("the root", lambda f: base("-o", "/proc/x"), "refused"),
    ):  # fmt: skip
        yield name, partial(one_place, words, ends)


# --- 20: numbers


def numbered(numbers: Sequence[int | str], more: Sequence[object], ends: str, folder: Path) -> str | None:
    """Each frame is made, under its own number, once; or all is refused."""
    for index, number in enumerate(numbers):
        layers = wall(index, SIZE, (2, 1))
        layers["ViewLayer.Combined"] = grained(layers["ViewLayer.Combined"], index)
        write(folder / "in" / (number if isinstance(number, str) else f"shot.{number:04d}.exr"), layers)
    done = ravg(
        "pseudoref",
        *(["in"] if not more or str(more[0]).startswith("-") else []),
        *more,
        "-o",
        "out",
        *DRAFT,
        folder=folder,
        seconds=60,
        memory=2 * 2**30,
    )
    if done.code == -9:
        return "it hangs"
    if done.code:
        return done.refused if ends != "works" else done.failed
    if ends == "refused":
        return "it is not refused"
    missing = names(folder / "in") - names(folder / "out") if "--frames" not in more else set()
    return f"{sorted(missing)} are not made" if missing else None


def row_20() -> Cases:
    for name, numbers, more, ends in (
        ("a gap", [1, 2, 3, 7, 8], [], "works"),
        ("every second", [2, 4, 6, 8], [], "works"),
        ("every fifth, and one odd", [5, 10, 15, 17], [], "works"),
        ("negative numbers", ["shot.-002.exr", "shot.-001.exr", "shot.0000.exr", "shot.0001.exr"], [], "works"),
        ("frame 0 alone", [0], [], "works"),
        ("of nine digits", [10**8 + 1, 10**8 + 2], [], "works"),
        ("dates", [20260101, 20260301, 20261231], [], "works"),
        ("far apart", [1, 10**12], [], "works"),
        ("more than 64 bits", [f"shot.{10**25}.exr", f"shot.{10**25 + 1}.exr"], [], "either"),
        ("thousands of digits", ["shot." + "1" * 200 + ".exr", "shot." + "1" * 199 + "2.exr"], [], "either"),
        ("padded and not", ["shot.1.exr", "shot.2.exr", "shot.0001.exr"], [], "refused"),
        ("the same number twice", ["shot.01.exr", "shot.1.exr"], [], "refused"),
        ("two sequences", ["a.1.exr", "b.1.exr"], [], "refused"),
        ("numbers alone", ["0001.exr", "0002.exr"], [], "works"),
        ("numbers before and behind", ["2shot1.exr", "2shot2.exr"], [], "works"),
        ("in other letters", ["shot.1.EXR", "shot.2.EXR"], [], "works"),
        ("mixed letters", ["shot.1.exr", "shot.2.EXR"], [], "either"),
        ("other digits", ["shot.١.exr", "shot.٢.exr"], [], "either"),
        ("a range without end", [1, 2, 3], ["--frames", "1-100000000000"], "either"),
        ("a range of steps", [1, 2, 3], ["--frames", "1-3x2"], "works"),
        ("a range backwards", [1, 2, 3], ["--frames", "3-1"], "either"),
        ("a step of nothing", [1, 2, 3], ["--frames", "1-3x0"], "refused"),
        ("a frame twice", [1, 2, 3], ["--frames", "2,2,1-2"], "works"),
        ("digits of another script", [1, 2, 3], ["--frames", "١-٣"], "either"),
        ("a range of 400 digits", [1, 2], ["--frames", "1-" + "9" * 400], "either"),
        ("a step of 400 digits", [1, 2], ["--frames", "1-2x" + "9" * 400], "either"),
        ("thirty million commas", [1, 2], ["--frames", "1," * 100_000 + "2"], "either"),
        ("a glob", [1, 2, 3], ["in/shot.*.exr"], "works"),
        ("a glob of some", [1, 2, 3, 12], ["in/shot.000[12].exr", "--frames", "1-2"], "works"),
        ("a range within the name", [1, 2, 3], ["in/shot.1-2####.exr", "--frames", "1-2"], "works"),
    ):  # fmt: skip
        yield name, partial(numbered, numbers, more, ends)


# --- 21: a frame that is not like the others


def unlike(change: Callable[[Path, Layers], object], ends: str, folder: Path) -> str | None:
    """Refused by its name, or the others are as without it and it keeps what it had."""
    shot(folder / "in", 5, step=(2, 1))
    path = folder / "in" / "shot.1003.exr"
    layers = _layers_of(path)
    change(path, layers)
    done = ravg("pseudoref", "in", "-o", "out", *DRAFT, folder=folder, seconds=60)
    if done.code:
        if ends == "works":
            return done.failed
        named = "1003" in done.said
        return first_of(done.refused, None if named else f"it is not named: {done.said.strip()[-150:]}")
    if ends == "refused":
        return "it is not refused"
    for name in sorted(names(folder / "in")):
        before, after = read(folder / "in" / name), read(folder / "out" / name)
        if {k: (v.dtype, v.shape) for k, v in before.items()} != {k: (v.dtype, v.shape) for k, v in after.items()}:
            return f"{name}: other channels, types or sizes"
        made = next(v for k, v in after.items() if k.endswith("Combined.R") or k == "R")
        given = next(v for k, v in before.items() if k.endswith("Combined.R") or k == "R")
        if not np.isfinite(made).all() or not 0.7 < made.mean() / given.mean() < 1.4:
            return f"{name}: {made.mean() / given.mean():.2f} times its light"
        kept = [k for k in before if not k.endswith(("Combined.R", "Combined.G", "Combined.B")) and k not in "RGB"]
        if any(not np.array_equal(before[k], after[k], equal_nan=True) for k in kept):
            return f"{name}: what was not denoised is another"
    return None


def stored(path: Path, layers: Layers, kind: type = np.float32, parts: bool = False, **head: object) -> None:
    """Write the layers as halves, as parts, in tiles, with another window."""
    settings = {"compression": OpenEXR.ZIP_COMPRESSION, "type": OpenEXR.scanlineimage, **head}
    files = []
    for name, layer in layers.items():
        letters = "XYZW" if name.endswith(("Vector", "Normal")) else "RGBA"
        planes = np.moveaxis(layer, 2, 0)
        files.append(
            (name, {f"{name}.{c}": np.ascontiguousarray(p.astype(kind)) for c, p in zip(letters, planes, strict=False)})
        )
    if parts:
        made = [OpenEXR.Part(dict(settings), channels, name) for name, channels in files]
    else:
        made = [OpenEXR.Part(settings, {k: v for _, channels in files for k, v in channels.items()}, "")]
    OpenEXR.File(made).write(str(path))


def tiles() -> OpenEXR.TileDescription:
    found = OpenEXR.TileDescription()
    found.xSize = found.ySize = 16
    return found


def without(*left_out: str) -> Callable[[Path, Layers], object]:
    return lambda p, x: write(p, {k: v for k, v in x.items() if not any(word in k for word in left_out)})


def window(data: tuple[int, int, int, int], display: tuple[int, int, int, int]) -> dict[str, object]:
    return {
        "dataWindow": (np.array(data[:2], np.int32), np.array(data[2:], np.int32)),
        "displayWindow": (np.array(display[:2], np.int32), np.array(display[2:], np.int32)),
    }


def cropped(p: Path, x: Layers) -> None:
    part = {k: np.ascontiguousarray(v[4:20, 8:40]) for k, v in x.items()}
    stored(p, part, **window((8, 4, 39, 19), (0, 0, SIZE[1] - 1, SIZE[0] - 1)))


def moved(p: Path, x: Layers) -> None:
    stored(
        p, x, **window((100, 50, 100 + SIZE[1] - 1, 50 + SIZE[0] - 1), (100, 50, 100 + SIZE[1] - 1, 50 + SIZE[0] - 1))
    )


def row_21() -> Cases:
    for name, change, ends in (
        ("half as large", lambda p, x: write(p, {k: np.ascontiguousarray(v[::2, ::2]) for k, v in x.items()}), "refused"),
        ("one row less", lambda p, x: write(p, {k: np.ascontiguousarray(v[:-1]) for k, v in x.items()}), "refused"),
        ("turned by 90 degrees", lambda p, x: write(p, {k: np.ascontiguousarray(v.swapaxes(0, 1)) for k, v in x.items()}), "refused"),
        ("cropped", cropped, "either"),
        ("of another origin", moved, "works"),
        ("of halves", lambda p, x: stored(p, x, np.float16), "works"),
        ("in parts", lambda p, x: stored(p, x, parts=True), "works"),
        ("in tiles", lambda p, x: stored(p, x, type=OpenEXR.tiledimage, tiles=tiles()), "works"),
        ("of another compression", lambda p, x: stored(p, x, compression=OpenEXR.PIZ_COMPRESSION), "works"),
        ("uncompressed", lambda p, x: stored(p, x, compression=OpenEXR.NO_COMPRESSION), "works"),
        ("of PXR24", lambda p, x: stored(p, x, compression=OpenEXR.PXR24_COMPRESSION), "either"),
        ("without an albedo", without("Albedo"), "refused"),
        ("without a normal", without("Normal"), "either"),
        ("without vectors", without("Vector"), "works"),
        ("without any guide", without("Albedo", "Normal", "Vector"), "refused"),
        ("without a color", without("Combined"), "refused"),
        ("with a layer more", lambda p, x: write(p, {**x, "ViewLayer.Mist": x["ViewLayer.Combined"][..., 0]}), "works"),
        ("with another view layer too", lambda p, x: write(p, {**x, "Fog.Combined": x["ViewLayer.Combined"]}), "either"),
        ("of another view layer", lambda p, x: write(p, {k.replace("ViewLayer", "Fog"): v for k, v in x.items()}), "refused"),
        ("with an alpha", lambda p, x: write(p, {**x, "ViewLayer.Combined": np.concatenate([x["ViewLayer.Combined"], np.ones((*SIZE, 1), np.float32)], -1)}), "either"),
        ("of one channel", lambda p, x: write(p, {"": x["ViewLayer.Combined"][..., 0]}), "refused"),
        ("that is black", lambda p, x: write(p, {**x, "ViewLayer.Combined": 1e-20 + 0 * x["ViewLayer.Combined"]}), "either"),
        ("of vectors that are not finite", lambda p, x: write(p, {**x, "ViewLayer.Vector": np.nan * x["ViewLayer.Vector"]}), "works"),
        ("of vectors of a million", lambda p, x: write(p, {**x, "ViewLayer.Vector": 1e6 + x["ViewLayer.Vector"]}), "works"),
        ("with normals of zero", lambda p, x: write(p, {**x, "ViewLayer.Denoising Normal": 0 * x["ViewLayer.Denoising Normal"]}), "works"),
        ("with a negative albedo", lambda p, x: write(p, {**x, ALBEDO: -x[ALBEDO]}), "works"),
        ("with an albedo of zero", lambda p, x: write(p, {**x, ALBEDO: 0 * x[ALBEDO]}), "works"),
        ("with an albedo of a thousand", lambda p, x: write(p, {**x, ALBEDO: 1000 * x[ALBEDO]}), "works"),
        ("a thousand times brighter", lambda p, x: write(p, {**x, "ViewLayer.Combined": 1000 * x["ViewLayer.Combined"]}), "works"),
        ("a millionth as bright", lambda p, x: write(p, {**x, "ViewLayer.Combined": 1e-6 * x["ViewLayer.Combined"]}), "works"),
        ("of negative light", lambda p, x: write(p, {**x, "ViewLayer.Combined": -x["ViewLayer.Combined"]}), "either"),
        ("cut short", lambda p, x: os.truncate(p, p.stat().st_size - 500), "refused"),
        ("that is empty", lambda p, x: os.truncate(p, 0), "refused"),
    ):  # fmt: skip
        yield f"a frame {name}", partial(unlike, change, ends)


# --- 22: several runs at once


def together(words: Sequence[Sequence[object]], folder: Path) -> str | None:
    """Runs that write into one folder at once leave the frames of one of them, whole."""
    shot(folder / "in", 6, step=(2, 1))
    script = "import sys; from hybrid.cli import main; sys.exit(main(sys.argv[1:]))"
    environment = {**os.environ, "PYTHONPATH": str(PACKAGES)}
    running = [
        subprocess.Popen(
            [sys.executable, "-P", "-c", script, "pseudoref", "in", "-o", "out", *map(str, more)],
            cwd=folder, env=environment, stdout=subprocess.DEVNULL, stderr=subprocess.PIPE, text=True,
        )
        for more in words
    ]  # fmt: skip
    said = [process.communicate(timeout=300)[1] for process in running]
    if failed := [text.strip()[-200:] for text, process in zip(said, running, strict=True) if process.returncode]:
        return failed[0]
    for index, more in enumerate(words):
        options = [word for word in more if word != "--frames" and not str(word).startswith("100")]
        if failed := ravg("pseudoref", "in", "-o", f"alone{index}", *options, folder=folder).failed:
            return str(failed)
    for name in sorted(names(folder / "in")):
        if all(differ(folder / f"alone{index}", folder / "out", {name}) for index in range(len(words))):
            return f"{name} is neither's"
    left = [path.name for path in (folder / "out").iterdir() if path.name.startswith(".")]
    return f"{left[0]} is left" if left else None


def on_a_cluster(stale: bool, folder: Path) -> str | None:
    """Chunks that are handed out make again what was made from something else."""
    if shutil.which("dask", path=str(Path(sys.executable).parent)) is None:
        raise UntriedError("needs distributed")
    shot(folder / "in", 6, step=(2, 1), compression=OpenEXR.NO_COMPRESSION)
    with socket.socket() as free:
        free.bind(("127.0.0.1", 0))
        port = free.getsockname()[1]
    address = f"tcp://127.0.0.1:{port}"
    environment = {**os.environ, "PYTHONPATH": str(PACKAGES)}
    dask = [
        sys.executable,
        "-m",
        "distributed.cli.dask_scheduler",
        "--host",
        "127.0.0.1",
        "--port",
        str(port),
        "--no-dashboard",
    ]
    worker = [sys.executable, "-m", "distributed.cli.dask_worker", address, "--nthreads", "1", "--no-dashboard"]
    quiet = {"env": environment, "cwd": folder, "stdout": subprocess.DEVNULL, "stderr": subprocess.DEVNULL}
    running = [subprocess.Popen(words, **quiet) for words in (dask, worker)]  # type: ignore[call-overload]
    try:
        time.sleep(5)
        words = ["pseudoref", "in", "-o", "out", *DRAFT, "--scheduler", address, "--chunk", "2"]
        if failed := _alone(words, folder).failed:
            return str(failed)
        if stale:
            rendered_again(folder / "in" / "shot.1004.exr")
        else:
            os.truncate(folder / "out" / "shot.1004.exr", 1000)
        if failed := _alone(words, folder).failed:
            return str(failed)
    finally:
        for process in running:
            process.terminate()
            process.wait(20)
    if failed := ravg("pseudoref", "in", "-o", "fresh", *DRAFT, folder=folder).failed:
        return str(failed)
    return differ(folder / "fresh", folder / "out", names(folder / "fresh"))


def _alone(words: Sequence[object], folder: Path) -> Done:
    return alone("import sys; from hybrid.cli import main; sys.exit(main(sys.argv[1:]))", *words, folder=folder)


def row_22() -> Cases:
    yield "the same twice", partial(together, [DRAFT, DRAFT])
    yield "two presets", partial(together, [DRAFT, ("--preset", "final")])
    yield "both with --resume", partial(together, [(*DRAFT, "--resume"), (*DRAFT, "--resume")])
    yield "halves of a shot", partial(together, [(*DRAFT, "--frames", "1001-1004"), (*DRAFT, "--frames", "1003-1006")])
    for stale in (True, False):
        yield (
            f"--scheduler, {'a frame rendered again' if stale else 'an output cut short'}",
            partial(on_a_cluster, stale),
        )


# --- 23: stereo


def stereo(change: Callable[[Path], object], after: Sequence[object], folder: Path) -> str | None:
    """Both views of %V, each by itself; what one is made from is not the other's."""
    for index, view in enumerate(("left", "right")):
        shot(
            folder / "in", 4, step=(2 + index, 1), name=f"shot.{view}.{{:04d}}.exr", compression=OpenEXR.NO_COMPRESSION
        )
    words = ["pseudoref", "in/shot.%V.####.exr", *DRAFT]
    if failed := ravg(*words, "-o", "out/done.%V.####.exr", folder=folder).failed:
        return failed
    change(folder)
    for out in ("out", "fresh"):
        done = ravg(
            *words, "-o", f"{out}/done.%V.####.exr", *after, *(["--resume"] if out == "out" else []), folder=folder
        )
        if done.failed:
            return done.failed
    wanted = names(folder / "fresh")
    return first_of(
        None if len(wanted) == 8 else f"{len(wanted)} frames", differ(folder / "fresh", folder / "out", wanted)
    )


def stereo_refused(output: str, folder: Path) -> str | None:
    for view in ("left", "right"):
        shot(folder / "in", 2, name=f"shot.{view}.{{:04d}}.exr")
    return ravg("pseudoref", "in/shot.%V.####.exr", *DRAFT, "-o", output, folder=folder).refused


def views_in_a_file(edit: Edit, folder: Path) -> str | None:
    """Two views as layers of one file are both denoised, also where a run is resumed."""
    shot(folder / "in", 3, edit, step=(2, 1))
    for more in ([], ["--resume"]):
        if failed := ravg("pseudoref", "in", "-o", "out", *DRAFT, *more, folder=folder).failed:
            return failed
    for view in ("left", "right"):
        if np.array_equal(*(color(folder / x / "shot.1002.exr", f"ViewLayer.Combined.{view}") for x in ("in", "out"))):
            return f"{view} is not denoised"
    return None


def both_views(index: int, layers: Layers) -> None:
    for name in list(layers):
        layer = layers.pop(name)
        group, _, last = name.rpartition(".")
        for seed, view in enumerate(("left", "right")):
            shown = grained(layer, (index, seed)) if last == "Combined" else layer
            layers[f"{group}.{last}.{view}"] = shown


def row_23() -> Cases:
    yield "nothing changes", partial(stereo, nothing, [])
    yield (
        "the right view is rendered again",
        partial(stereo, lambda f: rendered_again(f / "in" / "shot.right.1002.exr"), []),
    )
    yield (
        "the views are exchanged",
        partial(
            stereo,
            lambda f: [
                _exchange(f / "in" / f"shot.left.{n}.exr", f / "in" / f"shot.right.{n}.exr") for n in range(1001, 1005)
            ],
            [],
        ),
    )
    yield "another option", partial(stereo, nothing, ["--no-stages", "warp"])
    for output in ("out.####.exr", "in/shot.%V.####.exr", "out.exr"):
        yield f"stereo to {output}", partial(stereo_refused, output)
    yield "two views in one file", partial(views_in_a_file, both_views)


# --- 24: two things taken for one


VIEWED = "%V/shot.####.exr"


def two_views(more: Sequence[object], folder: Path) -> str | None:
    """What is given once for both views is neither's: refused."""
    for view in ("left", "right"):
        shot(folder / view, 3)
    given = dict(zip(more[::2], more[1::2], strict=True))
    words = [word for option in {"-o": "out/%V", **given}.items() for word in option]
    return first_of(
        (done := ravg("pseudoref", VIEWED, *DRAFT, *words, folder=folder)).refused, "made" if done.code == 0 else None
    )


def pictures_called_alike(folder: Path) -> str | None:
    """The estimates that are kept of two view layers lie apart, whatever these are called."""

    def edit(index: int, layers: Layers) -> None:
        for name in list(layers):
            layer = layers.pop(name)
            layers |= {name.replace("ViewLayer", other): layer.copy() for other in ("A B", "A_B")}

    shot(folder / "in", 2, edit)
    words = ["--estimate", "oidn-fast", "--keep-estimates", "kept"]
    if failed := ravg("pseudoref", "in", "-o", "out", *DRAFT, *words, folder=folder).failed:
        return failed
    kept = len([*(folder / "kept").rglob("*.exr")])
    return None if kept == 4 else f"{kept} of 4 pictures are kept"


def neighbours_pictures(by: int, folder: Path) -> str | None:
    """Estimates, each of the frame beside the one that it is called after, are refused."""
    shot(folder / "in", 6, step=(3, 1))
    for index in range(6):
        picture = wall(index + by, SIZE, (3, 1))["ViewLayer.Combined"]
        write(folder / "single" / f"shot.{1001 + index}.exr", {"ViewLayer.Combined": picture})
    done = ravg("pseudoref", "in", "-o", "out", *DRAFT, "--estimate", "single", folder=folder)
    return done.refused if done.code else ("each frame is another" if by else None)


def asked_otherwise(frames: str, folder: Path) -> str | None:
    """Of every second frame the pictures are the same, whatever range is asked for."""
    noisy = shot(folder / "in", 7, step=(1, 0))
    for number in (1002, 1004, 1006):
        (noisy / f"shot.{number}.exr").unlink()
    if failed := ravg("pseudoref", "in", "-o", "all", *DRAFT, folder=folder).failed:
        return failed
    ravg("pseudoref", "in", "-o", "part", *DRAFT, "--frames", frames, "--keep-going", folder=folder)
    return differ(folder / "part", folder / "all", names(folder / "part"))


PROGRAM = """
import json, sys
from hybrid import denoise_shot, open_shot
out, options = sys.argv[1], json.loads(sys.argv[2])
print(sum(not frame.resumed for frame in denoise_shot(open_shot("in"), out, resume=True, **options)))
"""


def other_program(first: dict[str, object], then: dict[str, object], folder: Path) -> str | None:
    """What a program has made with `denoise_shot` is resumed by its options too."""
    shot(folder / "in", 3, step=(2, 1))
    shutil.copy(PACKAGES / "tests" / "data" / "small.safetensors", folder / "w.safetensors")
    for out, options in (("out", first), ("out", then), ("fresh", then)):
        if failed := alone(PROGRAM, out, json.dumps(options), folder=folder).failed:
            return failed
    return differ(folder / "fresh", folder / "out")


def exchanged_while_it_runs(folder: Path) -> str | None:
    """A frame that is exchanged for another of its size and time while it is used ends the run, or is used as a whole."""
    for name, noise in (("in", 0.3), ("other", 0.5)):
        shot(folder / name, 12, size=(160, 240), step=(2, 1), noise=noise, compression=OpenEXR.NO_COMPRESSION)
    old, new = (folder / name / "shot.1008.exr" for name in ("in", "other"))
    status = old.stat()
    os.utime(new, ns=(status.st_atime_ns, status.st_mtime_ns))

    def exchange() -> None:
        while not (folder / "out" / "shot.1006.exr").exists():
            time.sleep(0.002)
        new.replace(old)

    threading.Thread(target=exchange, daemon=True).start()
    done = _alone(["pseudoref", "in", "-o", "out", *DRAFT], folder)
    return done.refused if done.code else "exit code 0"


def row_24() -> Cases:
    for more in (
        ["--keep-estimates", "kept", "--estimate", "oidn-fast"],
        ["--preview", "x.png"],
        ["--contact", "x.png"],
        ["--estimate", "left/shot.####.exr"],
        ["--layer", "albedo=left/shot.####.exr"],
        ["-o", "out"],
    ):
        yield f"{' '.join(more[:2])} for two views", partial(two_views, more)
    yield "view layers called alike", pictures_called_alike
    for by in (-1, 0, 1):
        yield f"estimates of the frames {by:+d}", partial(neighbours_pictures, by)
    for frames in ("1001-1007", "1003-1006", "1005"):
        yield f"every second frame, asked for as {frames}", partial(asked_otherwise, frames)
    draft: dict[str, object] = {"preset": "draft"}
    for then in ({"no_stages": ["warp"]}, {"stages": ["refine"]}, {"estimate": "nlm"}, {"weights": "w.safetensors"}):
        yield f"a program's {then}", partial(other_program, draft, draft | then)
    yield "a frame exchanged while it is used", exchanged_while_it_runs


ROWS = {
    15: ("resuming with another option, profile, layer or weights", row_15),
    16: ("estimates from a sequence that does not fit", row_16),
    17: ("records that are hostile or damaged", row_17),
    18: ("the viewer, in odd folders", row_18),
    19: ("outputs in odd places", row_19),
    20: ("gaps, negative numbers, ranges", row_20),
    21: ("a frame that is not like the others", row_21),
    22: ("several runs at once, and chunks on a cluster", row_22),
    23: ("stereo", row_23),
    24: ("two things taken for one: views, view layers, neighbouring frames, ranges, programs", row_24),
}


if __name__ == "__main__":
    raise SystemExit(run(ROWS, __file__, __doc__ or ""))
