"""Never silently wrong: what used to give wrong pictures, stale ones, or lost files, tried again.

    python benchmarks/reliability.py [--only ROW …] [--against CHECKOUT] [--json OUT]

Each case is a function that makes what it needs in a folder of its own, runs the command, and returns None where all is
as promised, or else what is not. The rows of the table are those of docs/reliability.md. With --against the same
cases run on another checkout, whose counts stand beside. It exits with 1 where something does not hold here.
"""

from __future__ import annotations

import json
import os
import re
import shutil
import socket
import subprocess
import sys
import threading
import time
from collections.abc import Callable, Sequence
from dataclasses import dataclass
from functools import partial
from itertools import product
from pathlib import Path
from typing import Any

import cv2
import numpy as np
import OpenEXR
from trial import (
    COMMAND,
    DRAFT,
    OFF,
    ON,
    OURS,
    PACKAGES,
    SIZE,
    STANDARD,
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

NOBODY = 65534


# --- 1: what one window has and no other


ODD = 6


def flare(factor: float, part: slice = slice(None)) -> Edit:
    def edit(index: int, layers: Layers) -> None:
        layers["ViewLayer.Combined"][part] *= factor if index == ODD else 1

    return edit


def switch(factor: float) -> Edit:
    def edit(index: int, layers: Layers) -> None:
        layers["ViewLayer.Combined"] *= np.float32(factor if index >= ODD else 1)

    return edit


def burst(index: int, layers: Layers) -> None:
    """From frame 7 to 9 the wall slides by three pixels per frame."""
    moved = wall(min(max(index - ODD, 0), 3), SIZE, (3, 0))
    layers |= moved
    layers["ViewLayer.Vector"][..., 0] = -3 if ODD < index <= ODD + 3 else 0
    layers["ViewLayer.Vector"][..., 1] = layers["ViewLayer.Vector"][..., 3] = 0
    layers["ViewLayer.Vector"][..., 2] = -3 if ODD <= index < ODD + 3 else 0


def cut(index: int, layers: Layers) -> None:
    if index >= ODD:
        for name in ("ViewLayer.Combined", "ViewLayer.Denoising Albedo"):
            layers[name] = np.ascontiguousarray(layers[name][::-1, ::-1])


def sparks(count: int, value: float = 5000) -> Edit:
    def edit(index: int, layers: Layers) -> None:
        if index == ODD:
            places = np.random.default_rng(count).integers(4, (SIZE[0] - 4, SIZE[1] - 4), (count, 2))
            layers["late"] = lambda late: [late["ViewLayer.Combined"].__setitem__((y, x), value) for y, x in places]  # type: ignore[assignment]

    return edit


EVENTS: dict[str, Edit] = {
    "a frame five times brighter": flare(5),
    "a frame at a fifth of its light": flare(0.2),
    "a light switched down": switch(0.2),
    "a light switched on": switch(5),
    "half of a frame four times brighter": flare(4, slice(0, SIZE[0] // 2)),
    "a tenth of a frame darker": flare(0.2, slice(0, 4)),
    "a burst of motion": burst,
    "a cut": cut,
    "a firefly": sparks(1),
    "five fireflies": sparks(5, 800),
}
FORCED = ON, "warp", ON, "gate", ON, "outliers"


def odd_window(edit: Edit, given: bool, folder: Path) -> str | None:
    """Planned, no frame is worse by more than 0.2 dB or 1 % of its mean than with what guards forced on."""
    noisy, clean = shot(folder / "in", 18, edit), shot(folder / "clean", 18, edit, noise=0)
    more = ["--estimate", blurred(folder / "single", noisy)] if given else []
    for out, forced in (("planned", ()), ("forced", FORCED)):
        done = ravg("pseudoref", noisy, "-o", folder / out, *more, *forced)
        if given and f"error: the estimate of frame {1001 + ODD}: it has" in done.said:
            return None  # what has spread a firefly's light all over a small picture is not believed
        if done.failed:
            return done.failed
    for index in range(ODD - 3, ODD + 4):
        name = f"shot.{1001 + index:04d}.exr"
        truth = color(clean / name)
        if truth.max() > 100:  # what the firefly is in
            truth = color(clean / "shot.1001.exr")
        planned, forced = (color(folder / out / name) for out in ("planned", "forced"))
        scale = float(truth.mean())
        error = [float(np.mean(np.square(x / (x + scale) - truth / (truth + scale)))) for x in (planned, forced)]
        decibels = 10 * np.log10((error[0] + 1e-9) / (error[1] + 1e-9))
        means = [abs(float(x.mean()) / scale - 1) for x in (planned, forced)]
        if decibels > 0.2 or means[0] - means[1] > 0.01:
            return f"{name}: {decibels:.2f} dB and {means[0] - means[1]:.1%} of its mean worse"
        if not 0.8 < planned.mean() / scale < 1.25:
            return f"{name}: {planned.mean() / scale:.2f} times its light"
    return None


def same_in_chunks(edit: Edit, folder: Path) -> str | None:
    noisy = shot(folder / "in", 18, edit)
    for out, frames in (("all", "1001-1018"), ("part", "1005-1007"), ("part", "1008")):
        if failed := ravg("pseudoref", noisy, "-o", folder / out, *DRAFT, "--frames", frames).failed:
            return failed
    return differ(folder / "part", folder / "all")


def told_where(edit: Edit, stage: str, frames: str, folder: Path) -> str | None:
    said = ravg("inspect", shot(folder, 18, edit)).words
    words = " ".join(said[said.find(stage) :].split()[:60])
    return None if frames in words else f"frames {frames} are not named with {stage}"


def row_1() -> Cases:
    for name, edit in EVENTS.items():
        for given in (False, True):
            yield f"{name}{', beside estimates' * given}", partial(odd_window, edit, given)
        yield f"{name}, in chunks", partial(same_in_chunks, edit)
    yield "inspect says where the light changes", partial(told_where, flare(5), "gate", "1005-1009")
    yield "inspect says where something moves", partial(told_where, burst, "warp", "1006-1011")
    yield "inspect says where fireflies are", partial(told_where, sparks(1), "fireflies", "1005-1009")


# --- 2: values that cannot be right


def pixel(layer: str, value: float) -> Edit:
    def edit(index: int, layers: Layers) -> None:
        if index == 2:
            layers["late"] = lambda late: late[f"ViewLayer.{layer}"].__setitem__((10, 20), value)  # type: ignore[assignment]

    return edit


def one_absurd_pixel(layer: str, value: float, folder: Path) -> str | None:
    """What is one pixel's is not a frame's."""
    for name, edit in (("plain", None), ("absurd", pixel(layer, value))):
        noisy = shot(folder / f"{name} in", 5, edit, step=(2, 1))
        if failed := ravg("pseudoref", noisy, "-o", folder / name, *DRAFT).failed:
            return failed
    for name in sorted(names(folder / "plain")):
        here, plain = color(folder / "absurd" / name), color(folder / "plain" / name)
        if not np.isfinite(here).all():
            return f"{name} is not finite"
        if abs(here.mean() / plain.mean() - 1) > 0.05:
            return f"{name} has {here.mean() / plain.mean():.2f} times its light"
    return None


def wrong_estimate(change: Callable[[np.ndarray], object], folder: Path) -> str | None:
    """Nothing is made of it, and the frame is named."""
    noisy = shot(folder / "in", 5, step=(2, 1))
    estimates = blurred(folder / "single", noisy)
    layers = wall(2, SIZE, (2, 1))
    change(layers["ViewLayer.Combined"])
    write(estimates / "shot.1003.exr", layers)
    done = ravg("pseudoref", noisy, "-o", folder / "out", *DRAFT, "--estimate", estimates)
    if done.code == 0:
        return "exit code 0"
    return done.refused or (None if "1003" in done.said else "the frame is not named")


def frames_that_are_not_there(asked: str, folder: Path) -> str | None:
    noisy = shot(folder / "in", 5)
    (noisy / "shot.1003.exr").unlink()
    return ravg("pseudoref", noisy, "-o", folder / "out", *DRAFT, "--frames", asked).refused


def absurd_weights(factor: float, folder: Path) -> str | None:
    from safetensors import safe_open
    from safetensors.numpy import save_file

    with safe_open(PACKAGES / "network" / "weights" / "fast.safetensors", "np") as file:
        tensors = {name: np.clip(file.get_tensor(name) * np.float16(factor), -6e4, 6e4) for name in list(file.keys())}
        save_file(tensors, folder / "w.safetensors", file.metadata())
    words = ["denoise", shot(folder / "in", 3, step=(2, 1)), "-o", folder / "out", "--estimate", "nlm"]
    done = ravg(*words, "--weights", folder / "w.safetensors")
    for path in (folder / "out").glob("*.exr"):
        made, given = color(path), color(folder / "in" / path.name)
        if not np.isfinite(made).all():
            return f"{path.name} is not finite"
        if not 1 / 3 < made.mean() / given.mean() < 3:
            return f"{path.name} has {made.mean() / given.mean():.2g} times its light"
    return done.refused if done.code else None


def row_2() -> Cases:
    for layer in ("Combined", "Denoising Albedo", "Denoising Normal", "Vector"):
        for value in (1e15, 1e30, -1e30, 3e38):
            yield f"a pixel of {value:g} in {layer}", partial(one_absurd_pixel, layer, value)
    wrong = {
        "nan": lambda x: x.fill(np.nan),
        "half nan": lambda x: x[:16].fill(np.nan),
        "of 1e30": lambda x: x.fill(1e30),
        "black": lambda x: x.fill(0),
        "four times too bright": lambda x: np.multiply(x, 4, out=x),
        "without red": lambda x: x[..., 0].fill(0),
    }
    for name, change in wrong.items():
        yield f"an estimate that is {name}", partial(wrong_estimate, change)
    for asked in ("1001-1005", "1003", "1004-1009", "1-3,1004"):
        yield f"--frames {asked} without 1003", partial(frames_that_are_not_there, asked)
    for factor in (30.0, 300.0, -30.0):
        yield f"weights times {factor:g}", partial(absurd_weights, factor)


# --- 3: names


def time_runs_forward(name: str, given: str, folder: Path) -> str | None:
    """Under whatever name, the frames are those of shot.####.exr."""
    plain, named = (
        shot(folder / out, 5, step=(3, 1), name=form, first=1)
        for out, form in (("plain", "shot.{:04d}.exr"), ("named", name))
    )
    for source, spec in ((plain, plain), (named, named / given if given else named)):
        if failed := ravg("pseudoref", spec, "-o", folder / f"{source.name} out", *DRAFT).failed:
            return failed
    for index in range(1, 6):
        one = color(folder / "plain out" / f"shot.{index:04d}.exr")
        other = folder / "named out" / name.format(index)
        if not other.exists() or not np.array_equal(one, color(other)):
            return f"frame {index} is another"
    return None


def several_pictures(layers: Sequence[str], kept: Sequence[str], folder: Path) -> str | None:
    """Each is denoised, but for those of a compositor; or all is refused."""

    def edit(index: int, found: Layers) -> None:
        for layer in layers:
            if layer not in found:
                found[layer] = found["ViewLayer.Combined"].copy()
            if not layer.startswith("ViewLayer"):
                group = layer.rpartition(".")[0]
                found |= {f"{group}.{n}": found[f"ViewLayer.{n}"] for n in ("Denoising Albedo", "Vector")}

    done = ravg("pseudoref", shot(folder / "in", 3, edit), "-o", folder / "out", *DRAFT)
    if done.code:
        return done.refused
    for layer in layers:
        same = np.array_equal(*(color(folder / x / "shot.1002.exr", layer) for x in ("in", "out")))
        if same != (layer in kept):
            return f"{layer} was {'not ' * same}denoised"
    return None


def aov_that_is_a_role(name: str, folder: Path) -> str | None:
    """It is refused, or leaves all else as it is without."""
    words = ["denoise", shot(folder / "in", 3, step=(2, 0)), "--estimate", "nlm"]
    done = ravg(*words, "-o", folder / "out", "--aov", name)
    if done.code:
        return done.refused
    if failed := ravg(*words, "-o", folder / "plain").failed:
        return failed
    return differ(folder / "plain", folder / "out")


def channels_in_doubt(extra: Sequence[str], folder: Path) -> str | None:
    """Two channels, or two layers, could be one thing: refused."""

    def edit(index: int, layers: Layers) -> None:
        for name in extra:
            layers[name] = layers["ViewLayer.Combined"].copy()
        if "color" in extra:
            del layers["ViewLayer.Combined"]

    return ravg("pseudoref", shot(folder / "in", 3, edit), "-o", folder / "out", *DRAFT).refused


def row_3() -> Cases:
    for name, given in {
        "shot-{:04d}.exr": "",
        "a_b-{:03d}.exr": "a_b-###.exr",
        "v2-{:d}.exr": "v2-#.exr",
        "-{:04d}.exr": "",
        "shot.{:04d}_final.exr": "",
        "7_{:04d}.exr": "7_%04d.exr",
        "shot - {:04d}.exr": "",
    }.items():
        yield f"frames called {name}", partial(time_runs_forward, name, given)
    both = ["ViewLayer.Combined", "Composite.Combined"]
    yield "the compositor's beside a view layer", partial(several_pictures, both, both[1:])
    yield "two view layers", partial(several_pictures, ["ViewLayer.Combined", "Fog.Combined"], [])
    yield "three view layers", partial(several_pictures, ["ViewLayer.Combined", "A.Combined", "Z.Combined"], [])
    for name in ("normal", "albedo", "Combined", "ViewLayer.Combined", "color"):
        yield f"--aov {name}", partial(aov_that_is_a_role, name)
    yield "color and beauty, neither a renderer's", partial(channels_in_doubt, ["color", "beauty"])
    yield "beauty, rgba and color", partial(channels_in_doubt, ["color", "beauty", "rgba"])


# --- 4: one seed for all frames


def seed_is_told(samples: int, moves: bool, fixed: bool, vectors: bool, shots: int, folder: Path) -> str | None:
    """Detail of a pixel's size correlates between frames as a fixed noise does."""
    size, step = (96, 128), (3, 1) if moves else (0, 0)
    detail = np.random.default_rng(shots).uniform(0.5, 1.5, (200, 200, 1)).astype(np.float32)
    for index in range(4):
        layers = wall(index, size, step)
        y, x = 40 - step[1] * index, 40 - step[0] * index
        clean = layers["ViewLayer.Combined"] * detail[y : y + 96, x : x + 128]
        layers["ViewLayer.Combined"] = grained(clean, (shots, 0 if fixed else index), 2 / samples**0.5)
        if not vectors:
            del layers["ViewLayer.Vector"]
        write(folder / f"shot.{1001 + index}.exr", layers)
    words = ravg("inspect", folder).words
    # In a table of several columns the words of one may stand a line apart.
    found = "one seed for all" in words
    return None if found == fixed else f"one seed is {'' if found else 'not '}said"


def row_4() -> Cases:
    for samples, moves, fixed, vectors in product((16, 256, 4096), (False, True), (False, True), (True, False)):
        for number in (1, 2):
            words = f"{samples} samples, {'moving' if moves else 'still'}, {'one seed' if fixed else 'many'}"
            words += ", no vectors" * (not vectors)
            yield words, partial(seed_is_told, samples, moves, fixed, vectors, number)


# --- 5: alpha


def covered(hole: Callable[[int], bool], share: float = 0.0) -> Edit:
    """An alpha that is opaque but for a hole in some frames."""

    def edit(index: int, layers: Layers) -> None:
        alpha = np.ones((*SIZE, 1), np.float32)
        if hole(index):
            alpha[8:16, 8:16] = share
            layers["ViewLayer.Combined"][8:16, 8:16] *= share
        layers["ViewLayer.Combined"] = np.concatenate([layers["ViewLayer.Combined"], alpha], axis=-1)

    return edit


def opaque_stays_opaque(edit: Edit, folder: Path) -> str | None:
    noisy = shot(folder / "in", 5, edit, step=(2, 0))
    if failed := ravg("denoise", noisy, "-o", folder / "out", "--estimate", "nlm").failed:
        return failed
    for name in sorted(names(folder / "out")):
        before, after = (read(folder / where / name)["ViewLayer.Combined.A"] for where in ("in", "out"))
        inside = cv2.erode((before == 1).astype(np.uint8), np.ones((5, 5), np.uint8)) == 1
        if not (after[inside] == 1).all():
            return f"{name}: what is opaque falls to {after[inside].min():.4f}"
        if after.min() < -1e-6 or after.max() > 1 + 1e-6:
            return f"{name}: alpha from {after.min():.3f} to {after.max():.3f}"
    return None


def alpha_of_some_frames(folder: Path) -> str | None:
    """The stage runs where there is something transparent, whatever the first frame has."""
    outs = []
    for first in (1001, 1005):
        noisy = shot(folder / "in", 8, covered(lambda index: index >= 5, 0.5), step=(2, 0))
        outs.append(folder / f"from {first}")
        done = ravg("denoise", noisy, "-o", outs[-1], "--estimate", "nlm", "--frames", f"{first}-1008")
        if done.failed:
            return done.failed
    return differ(outs[1], outs[0])


def stages_that_run(folder: Path) -> str | None:
    """pseudoref has no network, and says of no stage of one that it runs."""
    done = ravg("pseudoref", shot(folder / "in", 3, covered(lambda index: True)), "-o", folder / "out", *DRAFT)
    if done.failed:
        return done.failed
    found = re.search(r"\brun: (alpha|skip)", re.sub(r"not run: \w+", "", done.said))
    return f"it says that {found[1]} runs" if found else None


def row_5() -> Cases:
    for name, hole in {
        "every frame": lambda i: True,
        "the first": lambda i: i == 0,
        "a later one": lambda i: i == 3,
    }.items():
        for share in (0.0, 0.5):
            yield f"a hole of {share} in {name}", partial(opaque_stays_opaque, covered(hole, share))
    yield "chunks that begin before and after a hole", alpha_of_some_frames
    yield "pseudoref says what it runs", stages_that_run


# --- 6: --resume


@dataclass(frozen=True)
class Project:
    """A shot with estimates, denoised once; what is changed then must show in what --resume makes."""

    folder: Path

    @property
    def frames(self) -> Path:
        return self.folder / "in"

    @property
    def estimates(self) -> Path:
        return self.folder / "single"

    @property
    def out(self) -> Path:
        return self.folder / "out"

    def frame(self, number: int) -> Path:
        return self.frames / f"shot.{number}.exr"

    def run(self, out: Path, *more: object) -> Done:
        return ravg("pseudoref", self.frames, "-o", out, *DRAFT, "--estimate", self.estimates, *more)


def rendered_again(path: Path, seconds: float | None = None) -> None:
    """Other pixels in the same number of bytes, with the same time or another."""
    before = path.stat()
    data = read(path)
    value = data["ViewLayer.Combined.R"].reshape(-1)[::-1].copy().reshape(SIZE)
    stored = {name: OpenEXR.Channel(name, pixels) for name, pixels in {**data, "ViewLayer.Combined.R": value}.items()}
    kept = {k: v for k, v in header(path).items() if k != "channels"}
    OpenEXR.File([OpenEXR.Part(kept, stored, "")]).write(str(path))
    when = before.st_mtime if seconds is None else seconds
    os.utime(path, (when, when))


def resumed(change: Callable[[Project], object], more: Sequence[object], late: bool, folder: Path) -> str | None:
    """After the change, --resume leaves what a run into an empty folder makes."""
    project = Project(folder)
    options = {"compression": OpenEXR.NO_COMPRESSION}  # so that other pixels are as many bytes
    shot(project.frames, 8, step=(2, 1), **options)
    blurred(project.estimates, project.frames)
    if late:
        project.frame(1004).rename(folder / "late.exr")
    if failed := project.run(project.out).failed:
        return failed
    if late:
        (folder / "late.exr").rename(project.frame(1004))
    change(project)
    if failed := first_of(
        project.run(project.out, "--resume", *more).failed, project.run(folder / "fresh", *more).failed
    ):
        return failed
    return differ(folder / "fresh", project.out, names(folder / "fresh"))


def swapped(project: Project) -> None:
    """Two frames change places, with their times."""
    a, b, spare = project.frame(1003), project.frame(1006), project.folder / "spare"
    a.rename(spare), b.rename(a), spare.rename(b)


CHANGES: dict[str, Callable[[Project], object]] = {
    "a frame rendered again": lambda p: rendered_again(p.frame(1004), time.time() + 5),
    "a frame rendered again, of an older time": lambda p: rendered_again(p.frame(1004), 1e9),
    "a frame rendered again, of the same time and size": lambda p: rendered_again(p.frame(1004)),
    "the last frame rendered again, of the same time": lambda p: rendered_again(p.frame(1008)),
    "two frames swapped": swapped,
    "a frame that is gone": lambda p: p.frame(1008).unlink(),
    "estimates made again": lambda p: [rendered_again(x, time.time() + 5) for x in p.estimates.iterdir()],
    "an older estimate": lambda p: rendered_again(p.estimates / "shot.1004.exr", 1e9),
    "an estimate of the same time and size": lambda p: rendered_again(p.estimates / "shot.1004.exr"),
    "the noisy frames in the estimates' place": lambda p: [
        shutil.copy2(x, p.estimates / x.name) for x in p.frames.iterdir()
    ],
    "an output that is another frame's": lambda p: shutil.copy2(p.out / "shot.1005.exr", p.out / "shot.1004.exr"),
    "an output cut short": lambda p: os.truncate(p.out / "shot.1004.exr", 3000),
    "an empty output": lambda p: os.truncate(p.out / "shot.1004.exr", 0),
    "an output that is an input": lambda p: shutil.copy2(p.frame(1004), p.out / "shot.1004.exr"),
}
OPTIONS: dict[str, Sequence[object]] = {
    "a layer left out": ("--layer", "normal=Denoising Albedo"),
    "a stage forced on": (ON, "refine"),
    "a stage forced off": (OFF, "gate"),
    "another preset": ("--preset", "final", "--estimate", "none"),
    "no estimates": ("--estimate", "none"),
    "our own estimates": ("--estimate", "nlm"),
    "OIDN's estimates": ("--estimate", "oidn-fast"),
}


def weights_exchanged(folder: Path) -> str | None:
    noisy, weights = shot(folder / "in", 3, step=(2, 1)), folder / "w.safetensors"
    words = ["denoise", noisy, "--estimate", "nlm", "--weights", weights]
    shutil.copy(PACKAGES / "network" / "weights" / "fast.safetensors", weights)
    os.utime(weights, (1e9, 1e9))
    if failed := ravg(*words, "-o", folder / "out").failed:
        return failed
    shutil.copy(PACKAGES / "network" / "weights" / "balanced.safetensors", weights)
    os.utime(weights, (1e9, 1e9))
    for out in ("out", "fresh"):
        if failed := ravg(*words, "-o", folder / out, "--resume").failed:
            return failed
    return differ(folder / "fresh", folder / "out")


def says_why(folder: Path) -> str | None:
    project = Project(folder)
    shot(project.frames, 5)
    blurred(project.estimates, project.frames)
    project.run(project.out)
    rendered_again(project.estimates / "shot.1003.exr", 1e9)
    said = project.run(project.out, "--resume").said
    return None if "made again" in said and "shot.1003.exr" in said else "it does not say why"


def nothing_changed(change: Callable[[Project], Path], folder: Path) -> str | None:
    """What is the same is left alone."""
    project = Project(folder)
    shot(project.frames, 4)
    blurred(project.estimates, project.frames)
    if failed := project.run(project.out).failed:
        return failed
    stamps = {path: path.stat().st_mtime_ns for path in project.out.glob("*.exr")}
    moved = Project(change(project))
    if failed := moved.run(project.out, "--resume").failed:
        return failed
    return None if stamps == {path: path.stat().st_mtime_ns for path in stamps} else "frames are made again"


def moved_elsewhere(project: Project) -> Path:
    (project.folder / "elsewhere").mkdir()
    for path in (project.frames, project.estimates):
        path.rename(project.folder / "elsewhere" / path.name)
    return project.folder / "elsewhere"


def row_6() -> Cases:
    for name, change in CHANGES.items():
        yield name, partial(resumed, change, (), False)
    yield "a neighbour that comes late", partial(resumed, lambda p: None, (), True)
    yield (
        "a neighbour that comes late, of an old time",
        partial(resumed, lambda p: os.utime(p.frame(1004), (1e9, 1e9)), (), True),
    )
    for name, more in OPTIONS.items():
        yield name, partial(resumed, lambda p: None, more, False)
    yield "weights exchanged under one name", weights_exchanged
    yield "it says why", says_why
    yield "nothing has changed", partial(nothing_changed, lambda p: p.folder)
    yield "all lies elsewhere now", partial(nothing_changed, moved_elsewhere)


# --- 7: --keep-estimates


def kept(change: Callable[[Path], object], first: Sequence[str], then: Sequence[str], folder: Path) -> str | None:
    """Pictures that were kept never show in what would be made without."""
    shot(folder / "in", 4, step=(2, 1), compression=OpenEXR.NO_COMPRESSION)
    words = ["pseudoref", folder / "in", *DRAFT]
    if failed := ravg(*words, "-o", folder / "first", *first, "--keep-estimates", folder / "kept").failed:
        return failed
    change(folder)
    done = ravg(*words, "-o", folder / "out", *then, "--keep-estimates", folder / "kept")
    if done.code:
        return done.refused
    if failed := ravg(*words, "-o", folder / "fresh", *then).failed:
        return failed
    return differ(folder / "fresh", folder / "out")


def kept_where(place: Callable[[Path], Path], folder: Path) -> str | None:
    """No file that is somebody else's is written over."""
    noisy = shot(folder / "in", 4)
    where = place(folder)
    before = contents(noisy, where)
    done = ravg("pseudoref", noisy, "-o", folder / "out", *DRAFT, "--estimate", "oidn-fast", "--keep-estimates", where)
    after = {path: path.read_bytes() for path in before}
    return first_of(done.refused, None if after == before else "files have changed")


def linked_output(folder: Path) -> Path:
    (folder / "out").mkdir()
    (folder / "link").symlink_to(folder / "out")
    return folder / "link"


def row_7() -> Cases:
    modes = {mode: ["--estimate", mode] for mode in ("oidn", "oidn-fast", "oidn-clean", "oidn-best")}
    for one, other in (
        ("oidn", "oidn-best"),
        ("oidn-best", "oidn"),
        ("oidn-fast", "oidn-clean"),
        ("oidn-clean", "oidn"),
    ):
        yield f"{one}'s taken for {other}'s", partial(kept, lambda f: None, modes[one], modes[other])
    fast = modes["oidn-fast"]

    def frame(folder: Path) -> Path:
        return folder / "in" / "shot.1002.exr"

    changes: dict[str, Callable[[Path], object]] = {
        "a frame rendered again": lambda f: rendered_again(frame(f), time.time() + 5),
        "a frame of an older time": lambda f: rendered_again(frame(f), 1e9),
        "a frame of the same time and size": lambda f: rendered_again(frame(f)),
        "a kept picture cut short": lambda f: os.truncate(f / "kept" / "shot.1002.exr", 2000),
        "a kept picture of another frame": lambda f: shutil.copy2(
            f / "kept" / "shot.1001.exr", f / "kept" / "shot.1002.exr"
        ),
        "somebody else's picture in its place": lambda f: shutil.copy2(frame(f), f / "kept" / "shot.1002.exr"),
        "the output in its place": lambda f: shutil.copy2(f / "first" / "shot.1002.exr", f / "kept" / "shot.1002.exr"),
    }
    for name, change in changes.items():
        yield name, partial(kept, change, fast, fast)
    yield "another layer as albedo", partial(kept, lambda f: None, fast, [*fast, "--layer", "albedo=Denoising Normal"])
    yield "in the output", partial(kept_where, lambda f: f / "out")
    yield "in the output, by a link", partial(kept_where, linked_output)
    yield "in the input", partial(kept_where, lambda f: f / "in")
    yield "among another shot's frames", partial(kept_where, lambda f: shot(f / "other", 4, noise=0.1))


# --- 8: other people's files


def spared(words: Callable[[Path], Sequence[object]], folder: Path) -> str | None:
    """Whatever a command is told to write, nothing that was there before is another afterwards."""
    shot(folder / "in", 3)
    blurred(folder / "single", folder / "in")
    shutil.copy(PACKAGES / "network" / "weights" / "fast.safetensors", folder / "w.safetensors")
    given = [str(word) for word in words(folder)]
    before, kinds = contents(folder), {path: path.lstat().st_mode for path in folder.rglob("*")}
    done = ravg(*given, folder=folder)
    if "Traceback" in done.said or done.code == -9:
        return done.said.strip()[-200:] or "it hangs"
    for path, mode in kinds.items():
        if not path.is_symlink() and not path.exists():
            return f"{path.relative_to(folder)} is gone"
        if path.lstat().st_mode != mode:
            return f"{path.relative_to(folder)} is something else now"
    changed = [path for path, data in before.items() if path.read_bytes() != data]
    return f"{changed[0].relative_to(folder)} was written over" if changed else None


def pseudoref_with(option: str, make: Callable[[Path], object], folder: Path) -> Sequence[object]:
    estimate = ["--estimate", folder / "single"]
    return ["pseudoref", folder / "in", "-o", folder / "out", *DRAFT, *estimate, option, make(folder)]


def denoise_with(option: str, make: Callable[[Path], object], folder: Path) -> Sequence[object]:
    weights = ["--weights", folder / "w.safetensors", "--estimate", "nlm"]
    return ["denoise", folder / "in", "-o", folder / "out", *weights, option, make(folder)]


def device(folder: Path) -> Path:
    os.mknod(folder / "null.png", 0o020666, os.makedev(1, 3))
    return folder / "null.png"


def pipe(folder: Path) -> Path:
    os.mkfifo(folder / "pipe.png")
    return folder / "pipe.png"


def link(to: str, name: str = "soft.png") -> Callable[[Path], Path]:
    def make(folder: Path) -> Path:
        (folder / name).symlink_to(folder / to)
        return folder / name

    return make


def hard_link(to: str) -> Callable[[Path], Path]:
    def make(folder: Path) -> Path:
        os.link(folder / to, folder / "hard.png")
        return folder / "hard.png"

    return make


def own_json(name: str) -> Callable[[Path], Sequence[object]]:
    def words(folder: Path) -> Sequence[object]:
        path = folder / "out" / name
        path.parent.mkdir(parents=True)
        path.write_text('{"mine": true}')
        return ["pseudoref", folder / "in", "-o", folder / "out", *DRAFT]

    return words


def planted(folder: Path) -> Sequence[object]:
    """Links under all the names that temporary files could have, were they told by host and process."""
    (folder / "out").mkdir()
    (folder / "victim").write_text("mine")
    host = re.sub(r"\W", "_", socket.gethostname()) or "host"
    for number in range(1001, 1004):
        for process in range(os.getpid(), os.getpid() + 3000):
            name = f".shot.{number}.exr.{host}-{process}-{threading.get_ident()}.tmp"
            (folder / "out" / name).symlink_to(folder / "victim")
    return ["pseudoref", folder / "in", "-o", folder / "out", *DRAFT]


def outside(name: str, folder: Path) -> str | None:
    """A comparison writes into its folder alone, whatever its methods are called."""
    noisy, clean = shot(folder / "in", 3), shot(folder / "clean", 3, noise=0)
    (folder / "a" / "b").mkdir(parents=True)
    words = [
        "compare",
        noisy,
        "--reference",
        clean,
        "--methods",
        "draft",
        "--rounds",
        1,
        "-o",
        folder / "a" / "b" / "c",
    ]
    before = {path for path in folder.rglob("*")}
    done = alone(COMMAND, *words, "--external", f"{name}={clean}", folder=folder)
    if "Traceback" in done.said:
        return "traceback"
    inside = folder / "a" / "b" / "c"
    made = [path for path in folder.rglob("*") if path not in before and inside not in (path, *path.parents)]
    return f"{made[0].relative_to(folder)} was written" if made else (done.refused if done.code else None)


def row_8() -> Cases:
    targets: dict[str, Callable[[Path], object]] = {
        "a frame": lambda f: f / "in" / "shot.1002.exr",
        "an estimate": lambda f: f / "single" / "shot.1002.exr",
        "an estimate, by a link": link("single/shot.1002.exr"),
        "an estimate, by a hard link": hard_link("single/shot.1002.exr"),
        "a frame, by a folder's other name": lambda f: f / "single" / ".." / "in" / "shot.1001.exr",
        "a device": device,
        "a pipe": pipe,
        "the output": lambda f: f / "in" / ".." / "in" / "shot.1003.exr",
    }
    for name, make in targets.items():
        yield f"--preview over {name}", partial(spared, partial(pseudoref_with, "--preview", make))
    for name in ("a frame", "a device"):
        yield f"--breakdown over {name}", partial(spared, partial(denoise_with, "--breakdown", targets[name]))
    weights: dict[str, Callable[[Path], object]] = {
        "the weights": lambda f: f / "w.safetensors",
        "the weights, by a link": link("w.safetensors"),
        "the weights, by a hard link": hard_link("w.safetensors"),
    }
    for name, make in weights.items():
        for option in ("--preview", "--breakdown"):
            yield f"{option} over {name}", partial(spared, partial(denoise_with, option, make))
    for name, where in {"the estimates": "single", "the input": "in"}.items():
        words = partial(lambda where, f: [*pseudoref_with("-o", lambda f: f / where, f)], where)
        yield f"output over {name}", partial(spared, words)
    for name in ("ravg.json", "ravg", "ravg/shot.1001-1003.json"):
        yield f"a {name} of somebody's own in the output", partial(spared, own_json(name))
    yield "links planted under temporary names", partial(spared, planted)
    for name in ("../../evil", "../../../in/shot.1001", "/tmp/ravg-evil", "..", "a/../../../b", "x" * 300):
        yield f"--external {name[:20]}", partial(outside, name)


# --- 9: two containers on one folder


HOLD = """
import os, pathlib, sys
try:
    from hybrid.files.replace import replace_file, temporary_folder
except ImportError:
    from hybrid.files import replace_file, temporary_folder
kind, path, number = sys.argv[1], pathlib.Path(sys.argv[2]), int(sys.argv[3])
while os.getpid() < number:  # each child has the next number
    if child := os.fork():
        sys.exit(os.waitstatus_to_exitcode(os.waitpid(child, 0)[1]))
with (replace_file if kind == "file" else temporary_folder)(path) as temporary:
    inside = temporary if kind == "file" else temporary / "a.exr"
    inside.write_bytes(b"whole")
    print("begun", flush=True)
    sys.stdin.read(1)
    print(inside.read_bytes().decode(), flush=True)
"""


def _free_number() -> int:
    """The lowest number that no process has which is seen here: a process of another container may have it there."""
    return next(number for number in range(2, 10**6) if not Path(f"/proc/{number}").exists())


def other_container(kind: str, same_numbers: bool, folder: Path) -> str | None:
    """A process that this one cannot see keeps what it writes; a dead one's goes."""
    if os.geteuid() or shutil.which("unshare") is None:
        raise UntriedError("needs unshare, as root")
    noisy, out = shot(folder / "in", 2), folder / "out"
    out.mkdir()
    words = ["unshare", "--pid", "--fork", *(["--mount-proc"] if same_numbers else [])]
    child = subprocess.Popen(
        [*words, sys.executable, "-P", "-c", HOLD, kind, str(out / "other.0001.exr"), str(_free_number())],
        env={**os.environ, "PYTHONPATH": str(PACKAGES)},
        stdin=subprocess.PIPE,
        stdout=subprocess.PIPE,
        stderr=subprocess.STDOUT,
        text=True,
    )
    assert child.stdout is not None
    if child.stdout.readline() != "begun\n":
        return "it did not begin"
    done = ravg("pseudoref", noisy, "-o", out, *DRAFT)
    said, _ = child.communicate("x")
    if done.failed or child.returncode or "whole" not in said:
        return f"it was disturbed: {said.strip()[-200:]}{done.failed or ''}"
    return None


def dead_container(kind: str, folder: Path) -> str | None:
    noisy, out = shot(folder / "in", 2), folder / "out"
    out.mkdir()
    child = subprocess.Popen(
        [sys.executable, "-P", "-c", HOLD, kind, str(out / "other.0001.exr"), "0"],
        env={**os.environ, "PYTHONPATH": str(PACKAGES)},
        stdin=subprocess.PIPE,
        stdout=subprocess.PIPE,
        text=True,
    )
    assert child.stdout is not None
    child.stdout.readline()
    child.kill()
    child.communicate()
    if failed := ravg("pseudoref", noisy, "-o", out, *DRAFT).failed:
        return failed
    left = [path.name for path in out.iterdir() if path.name.startswith(".")]
    return f"{left[0]} is left" if left else None


def row_9() -> Cases:
    for kind in ("file", "folder"):
        for same in (False, True):
            yield (
                f"a {kind} of another container{' with a /proc of its own' * same}",
                partial(other_container, kind, same),
            )
        yield f"a {kind} of a process that was killed", partial(dead_container, kind)


# --- 10: where nothing may be written


# The interpreter itself may be root's alone: what it needs is loaded before.
AS_NOBODY = """
import contextlib, importlib, json, os, sys
for name in json.loads(open(os.environ["MODULES"]).read()):
    with contextlib.suppress(Exception):
        importlib.import_module(name)
import numba
numba.njit(lambda x: 2 * x)(1)
os.setegid(65534), os.seteuid(65534)
sys.path.insert(0, os.environ["INSTALLED"])
from hybrid.cli import main
sys.exit(main(sys.argv[1:]))
"""


def installed(folder: Path, *, compiled: bool) -> Path:
    """The packages as an administrator installs them: not for the user to write to."""
    for name in OURS:
        ignore = None if compiled else shutil.ignore_patterns("__pycache__")
        shutil.copytree(PACKAGES / name, folder / "installed" / name, ignore=ignore)
    return folder / "installed"


def read_only(words: Callable[[Path], Sequence[object]], temporary: bool, folder: Path) -> str | None:
    """A farm's user, with no home, and an installation of root's."""
    if os.geteuid():
        raise UntriedError("needs root, to be somebody else")
    packages = installed(folder, compiled=False)
    (folder / "tmp").mkdir()
    for path in (folder, folder / "tmp"):
        path.chmod(0o777)
    environment = {"HOME": "/nonexistent", "XDG_CACHE_HOME": "/nonexistent", "INSTALLED": str(packages)}
    environment |= {"TMPDIR": str(folder / "tmp" if temporary else folder / "none")}
    ours = (*OURS, "__")
    (folder / "modules.json").write_text(json.dumps([name for name in sys.modules if not name.startswith(ours)]))
    environment["MODULES"] = str(folder / "modules.json")
    return alone(AS_NOBODY, *words(folder), packages=Path("/nonexistent"), **environment).failed


def cut_short(pattern: str, share: float, folder: Path) -> str | None:
    """What was compiled and is half there is compiled again."""
    packages, noisy = installed(folder, compiled=True), shot(folder / "in", 1)
    files = sorted((packages / "nlm" / "__pycache__").glob(pattern))
    if not files:
        raise UntriedError("nothing is compiled yet")
    for path in files:
        os.truncate(path, int(share * path.stat().st_size))
    words = ["pseudoref", noisy, "-o", folder / "out", *DRAFT]
    return alone(COMMAND, *words, packages=packages).failed


def row_10() -> Cases:
    for temporary in (True, False):
        where = "temporary files" if temporary else "no temporary files"
        yield f"--help, {where}", partial(read_only, lambda f: ["--help"], temporary)
        yield f"inspect, {where}", partial(read_only, lambda f: ["inspect", shot(f / "in", 1)], temporary)
    yield "status", partial(read_only, lambda f: ["status", "--help"], True)
    for kind in ("nbi", "nbc"):
        for share in (0, 0.5, 0.99):
            yield f"compiled loops cut to {share}, {kind}", partial(cut_short, f"average*.{kind}", share)


# --- 11: weights


def hostile_weights(change: Callable[[dict[str, str]], object], base: str, folder: Path) -> str | None:
    """Refused in a line, at once, with next to no memory."""
    from safetensors import safe_open
    from safetensors.numpy import save_file

    with safe_open(PACKAGES / "network" / "weights" / f"{base}.safetensors", "np") as file:
        metadata = dict(file.metadata())
        change(metadata)
        save_file({name: file.get_tensor(name) for name in list(file.keys())}, folder / "w.safetensors", metadata)
    words = ["denoise", shot(folder / "in", 1), "-o", folder / "out", "--estimate", "auto"]
    done = ravg(*words, "--weights", folder / "w.safetensors", seconds=60, memory=3 * 2**30)
    error = next((line for line in done.said.splitlines() if line.startswith("error: ")), "")
    return first_of(
        done.refused,
        None if error else "no line of error",
        f"a line of {len(error)} characters" if len(error) > 600 else None,
    )


def described(**changes: object) -> Callable[[dict[str, str]], object]:
    def change(metadata: dict[str, str]) -> None:
        description = json.loads(metadata["description"])
        description["config"] |= changes
        metadata["description"] = json.dumps(description)

    return change


def nested(depth: int) -> Callable[[dict[str, str]], object]:
    def change(metadata: dict[str, str]) -> None:
        kernel = {"frames": 5, "size": 5, "threshold": 0.5, "activation": "relu"}
        inner: object = {"model": "RAUNet", "config": {"kernel": kernel, "widths": [16, 32, 64], "ra_scales": [1]}}
        for _ in range(depth):
            inner = {"model": "MultiScale", "scales": 2, "base": inner}
        metadata["description"] = json.dumps(inner)

    return change


def row_11() -> Cases:
    for depth in (2, 12, 25, 400):
        yield f"scales of scales, {depth} deep", partial(hostile_weights, nested(depth), "fast")
    for changes in ({"conv_size": 99}, {"width": 10**9}, {"width": 10**400}, {"blocks": 255}, {"temporal_blocks": 255}):
        yield f"{str(changes)[:40]}", partial(hostile_weights, described(**changes), "tkpcn")
    for changes in (
        {"frames": 255},
        {"frames": 5.0},
        {"widths": [256] * 100},
        {"widths": [2**40]},
        {"cell": 0},
        {"cell": 10**6},
    ):
        yield f"{str(changes)[:40]}", partial(hostile_weights, described(**changes), "fast")
    for entry in ("description", "version", "format"):
        long = partial(lambda entry, metadata: metadata.update({entry: "x\n" * 500_000}), entry)
        yield f"a megabyte of {entry}", partial(hostile_weights, long, "fast")
    for text in ("[" * 10**5, '{"a":' * 10**5, "null", "1e999", '{"model": "RobustUNet", "config": null}'):
        other = partial(lambda text, metadata: metadata.update({"description": text}), text)
        yield f"a description {text[:12]}", partial(hostile_weights, other, "fast")


# --- 12: crash, hang, memory


def refused(words: Callable[[Path], Sequence[object]], folder: Path, **limits: Any) -> str | None:
    shot(folder / "in", 3)
    given = words(folder)
    return ravg(*given, folder=folder, **limits).refused


def loop(folder: Path) -> Path:
    (folder / "a").symlink_to(folder / "b")
    (folder / "b").symlink_to(folder / "a")
    return folder / "a"


def special(kind: str, command: str, folder: Path) -> str | None:
    """Among the frames lies something that is no file: refused, or left out, and never waited for."""
    noisy = shot(folder / "in", 5)
    path = noisy / "shot.1003.exr"
    path.unlink()
    if kind == "pipe":
        os.mkfifo(path)
    elif kind == "socket":
        with socket.socket(socket.AF_UNIX) as server:
            server.bind(str(path))
    elif kind == "device":
        os.mknod(path, 0o020666, os.makedev(1, 5))  # /dev/zero: without end
    elif kind == "loop":
        path.symlink_to(path)
    elif kind == "folder":
        path.mkdir()
    words = {"inspect": [], "pseudoref": ["-o", folder / "out", *DRAFT]}[command]
    done = ravg(command, noisy, *words, seconds=60)
    if done.code == -9:
        return "it hangs"
    return "traceback" if "Traceback" in done.said else None


def pseudoref(folder: Path, *words: object) -> Sequence[object]:
    return ["pseudoref", folder / "in", "-o", folder / "out", *DRAFT, *words]


def hostile_results(text: str, folder: Path) -> str | None:
    (folder / "report").mkdir()
    (folder / "report" / "results.json").write_text(text)
    return ravg("compare", "--beside", folder / "report", "-o", folder / "page", seconds=60).refused


def markup(name: str, folder: Path) -> str | None:
    """A name is shown as it is."""
    noisy, clean = shot(folder / "in", 2), shot(folder / "clean", 2, noise=0)
    words = ["compare", noisy, "--reference", clean, "--methods", "draft", "--rounds", 1]
    done = alone(COMMAND, *words, "--external", f"{name}={clean}")
    if done.code:
        return done.refused
    shown = "".join(done.said.split())
    return None if "".join(name.split())[:12] in shown else "the name is not shown"


WITHOUT_LIBRARY = """
import sys, types
class Broken:
    def find_spec(self, name, path=None, target=None):
        return None
broken = types.ModuleType("pyoidn")
broken.__spec__ = __import__("importlib.machinery").machinery.ModuleSpec("pyoidn", None)
def absent(name):
    if name.startswith("__"):
        raise AttributeError(name)
    raise OSError("libOpenImageDenoise.so.2: cannot open shared object file")
broken.__getattr__ = absent
sys.modules["pyoidn"] = broken
from hybrid.cli import main
sys.exit(main(sys.argv[1:]))
"""


def no_library(estimate: str, folder: Path) -> str | None:
    """pyoidn is there, and the library that it loads is not: auto does without, and says so."""
    words = ["denoise", shot(folder / "in", 2), "-o", folder / "out", "--estimate", estimate]
    done = alone(WITHOUT_LIBRARY, *words)
    if estimate != "auto":
        return done.refused
    return done.failed or (
        None if re.search(r"first pass: (nlm|bundled)\b", done.said) else "it does not say what it took"
    )


def row_12() -> Cases:
    for kind in ("pipe", "socket", "device", "loop", "folder"):
        for command in ("inspect", "pseudoref"):
            yield f"a {kind} among the frames, {command}", partial(special, kind, command)
    yield "a loop of links as the shot", partial(refused, lambda f: ["inspect", loop(f)])
    yield "a loop of links as the output", partial(refused, lambda f: [*pseudoref(f)[:2], "-o", loop(f) / "x"])
    yield "a loop of links as the preview", partial(refused, lambda f: pseudoref(f, "--preview", loop(f) / "x.png"))
    for size in ("9" * 400, "1" + "0" * 400 + "G", "9" * 400 + ".5T", "1e400"):
        yield (
            f"--max-memory of {len(size)} characters",
            partial(refused, lambda f, s=size: pseudoref(f, "--max-memory", s)),
        )
    for count in (50, 300):
        big = partial(lambda f: ["pseudoref", shot(f / "big", 3, size=(1500, 2000), noise=0), "-o", f / "out", *DRAFT])
        yield f"{count} MiB of memory", partial(refused, big, memory=count * 2**20)
    for name in ("[red]x[/blue]", "[/]", "[link=http://a]b", "\x1b[2J", "[bold]"):
        yield f"--external {name!r}", partial(markup, name)
    for text in (
        "", "null", "[]", "{}", "[" * 10**5, '{"results": 1}', '{"shot": 1, "results": [{}], "facts": {}}',
        '{"shot": "x", "results": [{"metrics": []}], "facts": {}}', '{"shot": "x", "results": "abc", "facts": {}}',
        '{"shot": "x", "results": [null], "facts": null}', "\\ud800", '{"results": [{"metrics": {"psnr": 0}}]}',
    ):  # fmt: skip
        yield f"results.json: {text[:30]}", partial(hostile_results, text)
    for estimate in ("auto", "oidn", "oidn-best"):
        yield f"pyoidn without its library, {estimate}", partial(no_library, estimate)


# --- 13: words


def attribute(value: bytes, folder: Path) -> str | None:
    """A string in a header is kept to the byte, whatever its encoding."""
    noisy = shot(folder / "in", 2, owner="A" * len(value))
    for path in noisy.iterdir():
        data = path.read_bytes()
        assert data.count(b"A" * len(value)) == 1
        path.write_bytes(data.replace(b"A" * len(value), value))
    if failed := ravg("pseudoref", noisy, "-o", folder / "out", *DRAFT).failed:
        return failed
    made = (folder / "out" / "shot.1001.exr").read_bytes()
    return None if b"owner\0string\0" + len(value).to_bytes(4, "little") + value in made else "it is another"


def odd_folder(name: str, pattern: bool, folder: Path) -> str | None:
    noisy = shot(folder / name / "in", 2)
    spec = noisy / "shot.####.exr" if pattern else noisy
    out = folder / name / "out"
    target = out / "made.####.exr" if pattern else out
    if failed := ravg("pseudoref", spec, "-o", target, *DRAFT).failed:
        return failed
    return None if len(names(out)) == 2 else "its frames are not there"


def ascii_only(words: Callable[[Path], Sequence[object]], folder: Path) -> str | None:
    return alone(COMMAND, *words(folder), PYTHONIOENCODING="ascii", LC_ALL="C").failed


def usage(words: Sequence[object], folder: Path) -> str | None:
    """Bad usage, exit code 2, and nothing is made."""
    given = ["pseudoref", shot(folder / "in", 3), *DRAFT, *words]
    if "-o" not in words:
        given += ["-o", folder / "out"]
    before = set(folder.rglob("*"))
    done = ravg(*given, folder=folder)
    if made := set(folder.rglob("*")) - before:
        return f"{made.pop().relative_to(folder)} was made"
    return None if done.code == 2 and "Traceback" not in done.said else f"exit code {done.code}"


def row_13() -> Cases:
    values = {"Latin-1": "Ærø Müller".encode("latin-1"), "Shift-JIS": "レンダー太郎".encode("shift_jis")}
    values |= {"UTF-8": "Zoë 渲染".encode(), "bytes of no encoding": b"\xff\xfe\x80abc\x81"}
    for name, value in values.items():
        yield f"{name} in a header", partial(attribute, value)
    for name in (
        "a#b",
        "####",
        "a@b",
        "@@@@",
        "%04d",
        "$F4",
        "<frame04>",
        "[1]",
        "a[1-3]b",
        "a*b",
        "a?b",
        "{x}",
        "ä 渲",
        " a",
    ):
        for pattern in (False, True):
            yield f"a folder called {name!r}{', and a pattern' * pattern}", partial(odd_folder, name, pattern)
    yield "inspect in ASCII", partial(ascii_only, lambda f: ["inspect", shot(f / "in", 2)])
    yield "pseudoref in ASCII", partial(ascii_only, lambda f: ["pseudoref", shot(f / "ä", 2), "-o", f / "ö", *DRAFT])
    yield "help in ASCII", partial(ascii_only, lambda f: ["denoise", "--help"])
    for words in (
        ["--max-memory", "0"], ["--max-memory", "0G"], ["-o", ""], ["-o", "x.tif"], ["-o", "x.####.png"],
        ["--layer", "color="], ["--layer", "=x"], ["--layer", "nonsense=x"], ["--layer", "albedo"],
        ["--max-memory", ""], ["--max-memory", "-1G"], ["--preset", "best"], ["--frames", ""], ["--frames", "1-x"],
        ["--stages", "magic"], ["--preview", "x.tif"], ["--max-pixels", "0"],
    ):  # fmt: skip
        yield f"usage: {' '.join(map(str, words))}", partial(usage, words)


# --- 14: fireflies


def ring(value: float, estimate: str, count: int, folder: Path) -> str | None:
    """A spark leaves no ring of light around it: 9×9, without its own pixel."""
    place = [(12, 16), (20, 34), (8, 40), (25, 8)][:count]

    def burnt(index: int, layers: Layers) -> None:
        if index == 2:
            layers["late"] = lambda late: [late["ViewLayer.Combined"].__setitem__(at, value) for at in place]  # type: ignore[assignment]

    words = ["--estimate", estimate, "--preset", STANDARD]
    for name, edit in (("plain", None), ("burnt", burnt)):
        noisy = shot(folder / f"{name} in", 5, edit, step=(1, 0))
        if failed := ravg("pseudoref", noisy, "-o", folder / name, *words).failed:
            return failed
    for number in (1002, 1003, 1004):
        plain, made = (color(folder / name / f"shot.{number}.exr") for name in ("plain", "burnt"))
        for y, x in place:
            block = slice(y - 4, y + 5), slice(x - 6, x + 7)
            if (share := made[block].mean() / plain[block].mean()) > 1.1:
                return f"frame {number}: {share:.2f} times the light around it"
            if (peak := made[block].max() / plain[block].max()) > 1.5:
                return f"frame {number}: a peak of {peak:.1f}"
    return None


def lamp(step: tuple[int, int], value: float, folder: Path) -> str | None:
    """A light of one pixel that is there in every frame stays."""

    def lit(index: int, layers: Layers) -> None:
        at = 16 + step[1] * index, 20 + step[0] * index
        layers["late"] = lambda late: late["ViewLayer.Combined"].__setitem__(at, value)  # type: ignore[assignment]

    noisy = shot(folder / "in", 5, lit, step=step)
    if failed := ravg("pseudoref", noisy, "-o", folder / "out", *DRAFT, "--estimate", "oidn").failed:
        return failed
    for index in range(5):
        made = color(folder / "out" / f"shot.{1001 + index}.exr")
        y, x = 16 + step[1] * index, 20 + step[0] * index
        light = float(made[y - 3 : y + 4, x - 3 : x + 4].mean(axis=-1).sum())
        if not 0.5 * value < light < 2 * value:
            return f"frame {1001 + index}: {light / value:.2f} of its light is there"
    return None


def on_record(folder: Path) -> str | None:
    def burnt(index: int, layers: Layers) -> None:
        if index == 1:
            layers["late"] = lambda late: late["ViewLayer.Combined"].__setitem__((12, 16), 5000)  # type: ignore[assignment]

    if failed := ravg("pseudoref", shot(folder / "in", 3, burnt), "-o", folder / "out", *DRAFT).failed:
        return failed
    records = [json.loads(path.read_text()) for path in (folder / "out").rglob("*.json")]
    share = max((e.get("light_removed", 0) for r in records for e in dict(r.get("frames", {})).values()), default=0)
    true = 5000 * 3 / color(folder / "in" / "shot.1002.exr").sum()
    if abs(share / true - 1) > 0.1:
        return f"{share:.3f} on record, {true:.3f} taken out"
    noted = [record["mean"] for record in records if "mean" in record]
    lost = 5000 / color(folder / "in" / "shot.1002.exr")[..., 0].size / 3
    known = noted and abs((noted[0]["with_fireflies"] - noted[0]["without"]) / lost - 1) < 0.1
    return None if known else "the means of the shot with and without are not on record"


def row_14() -> Cases:
    for estimate in ("none", "nlm", "oidn", "oidn-fast", "oidn-best"):
        for value in (300.0, 20_000.0, 60_000.0):
            yield f"a spark of {value:g}, {estimate}", partial(ring, value, estimate, 1)
    for estimate in ("none", "oidn"):
        yield f"four sparks, {estimate}", partial(ring, 5000.0, estimate, 4)
    for step in ((0, 0), (2, 1)):
        for value in (50.0, 5000.0):
            yield f"a lamp of {value:g}{' that moves' * any(step)}", partial(lamp, step, value)
    yield "what was taken out is on record", on_record


ROWS: dict[int, tuple[str, Callable[[], Cases]]] = {
    1: ("what one window has and no other is found there", row_1),
    2: ("absurd values make no picture; frames not made are no success", row_2),
    3: ("names mean one thing, or are refused", row_3),
    4: ("one seed is told from detail", row_4),
    5: ("what is opaque stays opaque", row_5),
    6: ("--resume makes again what would be another", row_6),
    7: ("kept estimates are those that would be made", row_7),
    8: ("nobody else's file is written over", row_8),
    9: ("two containers leave each other's files alone", row_9),
    10: ("a home that is read-only, compiled loops cut short", row_10),
    11: ("weights that ask for too much", row_11),
    12: ("no crash, no hang: one line", row_12),
    13: ("words of any encoding, folders of any name, usage", row_13),
    14: ("fireflies go, lamps stay", row_14),
}


if __name__ == "__main__":
    raise SystemExit(run(ROWS, __file__, __doc__ or ""))
