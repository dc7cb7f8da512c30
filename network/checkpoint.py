"""A model in a safetensors file: weights, its description and notes on its training, all untrusted when read."""

from __future__ import annotations

import json
import math
import os
import stat
from collections.abc import Iterator, Mapping
from contextlib import contextmanager
from dataclasses import asdict, fields
from pathlib import Path
from typing import TYPE_CHECKING, Any, TypeVar

import torch
from safetensors import SafetensorError, safe_open
from safetensors.torch import save_file

from network.robust_unet import RobustUNet, RobustUNetConfig

if TYPE_CHECKING:
    from network.presets import Model

Config = TypeVar("Config")

FORMAT = "ravg-network"
#: Raised when older weights would give other images; and the versions that are read. A `RobustUNet` before version 5
#: averaged features of the frames.
VERSION = 5
READ = ("3", "4", "5")
#: Folders of the weights of presets, and of the paper's networks.
SHIPPED, RESEARCH = Path(__file__).parent / "weights", Path(__file__).parent / "paper" / "weights"
#: The greatest weight that is read: a thousand times that of any network here. Greater weights give NaN images.
HEAVIEST = 5e3
#: Bounds of numbers in a description: two to four times those of any network here. And of all others.
BOUNDS = {"frames": 15, "size": 21, "conv_size": 15, "scales": 8, "blocks": 64, "temporal_blocks": 16}
LARGEST = 256
#: Nesting of a description: a network within scales, its configuration, that of its kernels, a list.
DEEPEST = 5
#: Parameters of a network: twenty times those of the largest here.
PARAMETERS = 10**8
#: Characters of a description, and of what a message quotes.
LONGEST, QUOTED = 2**24, 160


def describe(model: Model) -> dict[str, Any]:
    """Description of a model, as plain JSON values, from which `build` can build it again."""
    name = type(model).__name__
    if name == "MultiScale":
        return {"model": name, "scales": model.config.scales, "base": describe(model.base)}  # type: ignore
    return {"model": name, "config": asdict(model.config)}


def build(description: Mapping[str, Any]) -> Model:
    """Build the model of a description, with initial weights; ValueError unless it is one of `describe`."""
    try:
        if description["model"] == "RobustUNet":
            return RobustUNet(_configure(RobustUNetConfig, description["config"]))
        return _build_paper(description)
    except (AttributeError, KeyError, TypeError, ValueError, RuntimeError) as error:
        raise ValueError(f"model description: {error!r}") from error


def _build_paper(description: Mapping[str, Any]) -> Model:
    """Build one of the paper's networks."""
    from network.paper import models as paper  # here, since no preset needs them

    name = description["model"]
    if name == "MultiScale":
        if description["base"]["model"] == "MultiScale":
            raise ValueError("expected scales of a network that has one, got scales of scales")
        base: Any = _build_paper(description["base"])
        return paper.MultiScale(paper.MultiScaleConfig(base.config, description["scales"]))
    if name not in ("RAUNet", "RAResNet", "TKPCN"):
        raise ValueError(f"expected model RobustUNet, MultiScale, RAUNet, RAResNet or TKPCN, got {name!r}")
    values = dict(description["config"])
    if "kernel" in values:
        # Earlier versions wrote the only activation that is left.
        kernel = {key: value for key, value in values["kernel"].items() if (key, value) != ("activation", "relu")}
        values["kernel"] = _configure(paper.KernelConfig, kernel)
    model: Model = getattr(paper, name)(_configure(getattr(paper, f"{name}Config"), values))
    return model


def _configure(kind: type[Config], values: Mapping[str, Any]) -> Config:
    """A configuration of JSON values; 5.0 frames would pass every comparison, and fail when they are counted."""
    values = {key: tuple(value) if isinstance(value, list) else value for key, value in values.items()}
    for item in fields(kind):  # type: ignore[arg-type]
        if type(item.default) is int and type(values.get(item.name, 0)) is not int:
            raise TypeError(f"{item.name}: expected a whole number, got {values[item.name]!r}")
    return kind(**values)


def save_model(path: str | os.PathLike[str], model: Model, notes: Mapping[str, Any] | None = None) -> None:
    """Write a model in half precision, with JSON notes on its origin; the file appears whole or not at all.

    Raises ValueError if a weight is not finite, or more than `HEAVIEST`.
    """
    tensors = {name: value.detach().to("cpu", torch.float16).contiguous() for name, value in model.state_dict().items()}
    for name, value in tensors.items():
        if not bool((value.abs() <= HEAVIEST).all()):
            raise ValueError(f"{name}: expected finite weights up to {HEAVIEST:g}, got others")
    metadata = {
        "format": FORMAT,
        "version": str(VERSION),
        "description": json.dumps(describe(model)),
        "notes": json.dumps(dict(notes or {})),
    }
    path = Path(path)
    partial = new_partial(path)
    try:
        write_tensors(partial, tensors, metadata)
        os.replace(partial, path)
    finally:
        partial.unlink(missing_ok=True)


def new_partial(path: Path) -> Path:
    """Create an empty file beside `path`, to be written and renamed to it; removes one of an earlier process.

    Exclusively, so that nothing is written through a link. OSError if `path` is no file, or the folder not writable.
    """
    if path.exists() and not path.is_file():
        raise OSError(f"{path} is there and no file, expected a file or a new name")
    partial = path.with_name(path.name + ".part")
    partial.unlink(missing_ok=True)
    partial.touch(exist_ok=False)  # O_EXCL follows no link
    return partial


def write_tensors(path: Path, tensors: Mapping[str, torch.Tensor], metadata: Mapping[str, str]) -> None:
    """Write tensors over an empty file of `new_partial`, and keep its mode, which safetensors would narrow."""
    mode = stat.S_IMODE(path.stat().st_mode)
    save_file(dict(tensors), path, dict(metadata))
    path.chmod(mode)


def load_model(path: str | os.PathLike[str]) -> Model:
    """Load a model of `save_model`, in float32; FileNotFoundError, or ValueError for another or damaged file."""
    where = f"weights {os.fspath(path)!r}"
    with _open(path) as (file, metadata):
        try:
            if len(text := metadata["description"]) > LONGEST:
                raise ValueError(f"description: expected at most {LONGEST} characters, got {len(text)}")
            description, old = json.loads(text), metadata["version"] != str(VERSION)
            _refuse_huge(description)
            if isinstance(description, dict) and description.get("model") == "RobustUNet" and old:
                raise ValueError(
                    f"expected version {VERSION} of a RobustUNet, got {metadata['version']}, which averages features; "
                    "train it anew (ravg train --init oidn)"
                )
            with torch.device("meta"):  # shapes alone, which take no memory
                expected = {name: tuple(value.shape) for name, value in build(description).state_dict().items()}
        except (KeyError, ValueError, RecursionError) as error:
            raise ValueError(f"{where}: {_short(error)}") from error
        found = {name: tuple(file.get_slice(name).get_shape()) for name in file.keys()}  # noqa: SIM118 (no mapping)
        if expected != found:
            name = min(key for key in expected.keys() | found.keys() if expected.get(key) != found.get(key))
            got = f"expected shape {expected.get(name)}, got {found.get(name)}"
            raise ValueError(f"{where}: {_short(name)}: {got}")
        if (count := sum(math.prod(shape) for shape in found.values())) > PARAMETERS:
            raise ValueError(f"{where}: expected at most {PARAMETERS:g} parameters, got {count}")
        tensors = {name: file.get_tensor(name) for name in found}
    for name, value in tensors.items():
        if not value.is_floating_point() or not bool((value.abs() <= HEAVIEST).all()):
            raise ValueError(f"{where}: {name}: expected finite numbers up to {HEAVIEST:g}, got others")
    model = build(description)
    model.load_state_dict({name: value.float() for name, value in tensors.items()})
    return model


def _refuse_huge(value: Any, name: str = "", depth: int = 0) -> None:
    """Raise ValueError for a description that would take excessive memory or time to build or to run."""
    if isinstance(value, Mapping | list):
        if depth == DEEPEST:
            raise ValueError(f"model description: expected values within at most {DEEPEST} others, got more")
        if len(value) > LARGEST:
            raise ValueError(f"model description: expected at most {LARGEST} values together, got {len(value)}")
        for key, item in value.items() if isinstance(value, Mapping) else ((name, item) for item in value):
            _refuse_huge(item, key, depth + 1)
    elif isinstance(value, int | float) and not abs(value) <= (bound := BOUNDS.get(name, LARGEST)):
        raise ValueError(f"model description: {name}: expected a number up to {bound}, got {_short(value)}")


def _short(words: object) -> str:
    """Text from a file, shortened to one line for a message."""
    text = " ".join(str(words).split())
    return text if len(text) <= QUOTED else f"{text[:QUOTED]}…"


@contextmanager
def _open(path: str | os.PathLike[str]) -> Iterator[tuple[Any, dict[str, str]]]:
    """A file and its metadata, if format and version are ours."""
    where = f"weights {os.fspath(path)!r}"
    if not Path(path).is_file():
        raise FileNotFoundError(f"{where}: no such file")
    try:
        with safe_open(path, framework="pt") as file:
            metadata = file.metadata() or {}
            if metadata.get("format") != FORMAT:
                raise ValueError(f"{where}: expected format {FORMAT!r}, got {_short(repr(metadata.get('format')))}")
            if metadata.get("version") not in READ:
                raise ValueError(f"{where}: expected version {VERSION}, got {_short(metadata.get('version'))}")
            yield file, metadata
    except SafetensorError as error:
        raise ValueError(f"{where}: no safetensors file, or cut short ({_short(error)})") from error


def find_weights(name: str) -> Path:
    """Path of a file of weights, or of those of a preset or a network for research; ValueError for another name."""
    if Path(name).suffix:
        return Path(name)
    path = RESEARCH / f"{name}.safetensors"
    return path if path.is_file() else shipped_weights(name)


def shipped_weights(preset: str) -> Path:
    """Path of the weights of a preset that ships; ValueError, with the names of those that ship, for any other."""
    path = SHIPPED / f"{preset}.safetensors"
    if path.is_file():
        return path
    if (RESEARCH / path.name).is_file():
        raise ValueError(f"preset is {preset!r}, a network for research, expected --weights {preset}")
    shipped = ", ".join(sorted(p.stem for p in SHIPPED.glob("*.safetensors"))) or "none"
    raise ValueError(f"preset is {preset!r}, expected one of: {shipped}")
