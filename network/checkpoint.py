"""A model in one safetensors file: weights, and in its metadata what to build and where it comes from."""

from __future__ import annotations

import json
import math
import os
import stat
from collections.abc import Iterator, Mapping
from contextlib import contextmanager
from dataclasses import asdict, fields
from pathlib import Path
from typing import Any, TypeVar, cast

import torch
from safetensors import SafetensorError, safe_open
from safetensors.torch import save_file

from network.models import (
    TKPCN,
    KernelConfig,
    Model,
    MultiScale,
    MultiScaleConfig,
    RAResNet,
    RAResNetConfig,
    RAUNet,
    RAUNetConfig,
    TKPCNConfig,
)
from network.robust_unet import RobustUNet, RobustUNetConfig

Config = TypeVar("Config")

FORMAT = "ravg-network"
#: Raised when a change makes older weights give other kernels. Files say which one they were written for.
VERSION = 3
#: The greatest number in a description that is read: three times the width of any network here.
LARGEST = 256


#: The greatest weight that is read: a thousand times that of any network here. What is heavier makes NaN of pictures.
HEAVIEST = 5e3
#: Bounds of single numbers in it, two to four times what any network here has.
BOUNDS = {"frames": 15, "size": 21, "conv_size": 15, "scales": 8, "blocks": 64, "temporal_blocks": 16}
#: How deep they may lie: a network within scales, its configuration, that of its kernels, a list.
DEEPEST = 5
#: How many weights a network may have: twenty times those of the largest here.
PARAMETERS = 10**8
#: Characters of a description, or of the notes on a training of weeks; and what a message quotes of them.
LONGEST, QUOTED = 2**24, 160
#: Networks by name, with their configurations.
CLASSES: dict[str, tuple[Any, Any]] = {
    "RAUNet": (RAUNet, RAUNetConfig),
    "RAResNet": (RAResNet, RAResNetConfig),
    "TKPCN": (TKPCN, TKPCNConfig),
    "RobustUNet": (RobustUNet, RobustUNetConfig),
}


def describe(model: Model) -> dict[str, Any]:
    """What is needed to build the model anew.

    Parameters
    ----------
    model : Model
        Any.

    Returns
    -------
    dict
        Plain JSON values.
    """
    if isinstance(model, MultiScale):
        return {"model": "MultiScale", "scales": model.config.scales, "base": describe(model.base)}
    return {"model": type(model).__name__, "config": asdict(model.config)}


def build(description: Mapping[str, Any]) -> Model:
    """Build the model of a description, with initial weights.

    Parameters
    ----------
    description : mapping
        From `describe`.

    Returns
    -------
    Model
        In training layout.

    Raises
    ------
    ValueError
        If the description is not one of `describe`.
    """
    try:
        name = description["model"]
        if name == "MultiScale":
            if description["base"]["model"] == "MultiScale":
                raise ValueError("expected scales of a network that has one, got scales of scales")
            base = cast(RAUNet | RAResNet, build(description["base"]))
            return MultiScale(MultiScaleConfig(base.config, description["scales"]))
        if name not in CLASSES:
            raise ValueError(f"expected model MultiScale, {', '.join(CLASSES)}, got {name!r}")
        network, configuration = CLASSES[name]
        values = dict(description["config"])
        values = {key: tuple(value) if isinstance(value, list) else value for key, value in values.items()}
        if "kernel" in values:
            values["kernel"] = _configure(KernelConfig, values["kernel"])
        return cast(Model, network(_configure(configuration, values)))
    except (AttributeError, KeyError, TypeError, ValueError, RuntimeError) as error:
        raise ValueError(f"model description: {error!r}") from error


def _configure(kind: type[Config], values: Mapping[str, Any]) -> Config:
    """A configuration of checked types: 5.0 frames pass every comparison, and fail when they are counted."""
    values = dict(values)
    for item in fields(kind):  # type: ignore[arg-type]
        if type(item.default) is int and type(values.get(item.name, 0)) is not int:
            raise TypeError(f"{item.name}: expected a whole number, got {values[item.name]!r}")
    return kind(**values)


def save_model(path: str | os.PathLike[str], model: Model, notes: Mapping[str, Any] | None = None) -> None:
    """Write a model in half precision; the file appears whole or not at all.

    Parameters
    ----------
    path : path
        The safetensors file.
    model : Model
        The model, in any precision.
    notes : mapping, optional
        Where the weights come from (training configuration, validation), as JSON values.

    Raises
    ------
    ValueError
        If a weight is not finite, or more than `HEAVIEST`.
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
    """An empty file beside `path` to write to, to be renamed to it; what an earlier process has left there is gone.

    It is made anew, so that nothing is written through a link that somebody has put there.

    Raises
    ------
    OSError
        If `path` is there and no file, or the folder cannot be written to.
    """
    if path.exists() and not path.is_file():
        raise OSError(f"{path} is there and no file, expected a file or a new name")
    partial = path.with_name(path.name + ".part")
    partial.unlink(missing_ok=True)
    partial.touch(exist_ok=False)  # O_EXCL follows no link
    return partial


def write_tensors(path: Path, tensors: Mapping[str, torch.Tensor], metadata: Mapping[str, str]) -> None:
    """Write tensors in place of an empty file of `new_partial`, with its mode.

    safetensors replaces the file by one that only its owner may read, whatever the umask.

    Parameters
    ----------
    path : Path
        The empty file.
    tensors : mapping of str to Tensor
        By name.
    metadata : mapping of str to str
        For the file's header.
    """
    mode = stat.S_IMODE(path.stat().st_mode)
    save_file(dict(tensors), path, dict(metadata))
    path.chmod(mode)


def load_model(path: str | os.PathLike[str]) -> Model:
    """Read a model.

    Parameters
    ----------
    path : path
        File from `save_model`.

    Returns
    -------
    Model
        Float32, in training layout; see `network.models.for_inference`.

    Raises
    ------
    FileNotFoundError
        If there is no such file.
    ValueError
        If the file is cut short, no safetensors file, not ours, of another version, or its weights are not
        those of the model it names.
    """
    where = f"weights {os.fspath(path)!r}"
    with _open(path) as (file, metadata):
        try:
            description = _parse(metadata, "description")
            _refuse_huge(description)
            with torch.device("meta"):  # shapes alone, which take no memory
                wanted = {name: tuple(value.shape) for name, value in build(description).state_dict().items()}
        except (KeyError, ValueError, RecursionError) as error:
            raise ValueError(f"{where}: {_short(error)}") from error
        found = {name: tuple(file.get_slice(name).get_shape()) for name in file.keys()}  # noqa: SIM118 (no mapping)
        if wanted != found:
            name = min(key for key in wanted.keys() | found.keys() if wanted.get(key) != found.get(key))
            got = f"expected shape {wanted.get(name)}, got {found.get(name)}"
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
    """Raise ValueError for a description that would take all memory, or for ever, to build or to run."""
    if isinstance(value, Mapping | list):
        if depth == DEEPEST:
            raise ValueError(f"model description: expected values within at most {DEEPEST} others, got more")
        if len(value) > LARGEST:
            raise ValueError(f"model description: expected at most {LARGEST} values together, got {len(value)}")
        for key, item in value.items() if isinstance(value, Mapping) else ((name, item) for item in value):
            _refuse_huge(item, key, depth + 1)
    elif isinstance(value, int | float) and not abs(value) <= (bound := BOUNDS.get(name, LARGEST)):
        raise ValueError(f"model description: {name}: expected a number up to {bound}, got {_short(value)}")


def _parse(metadata: Mapping[str, str], name: str) -> Any:
    """The JSON value of an entry of a file's metadata."""
    if len(text := metadata[name]) > LONGEST:
        raise ValueError(f"{name}: expected at most {LONGEST} characters, got {len(text)}")
    return json.loads(text)


def _short(words: object) -> str:
    """What a message quotes of a file: a line at most."""
    text = " ".join(str(words).split())
    return text if len(text) <= QUOTED else f"{text[:QUOTED]}…"


def load_notes(path: str | os.PathLike[str]) -> dict[str, Any]:
    """Read where weights come from.

    Parameters
    ----------
    path : path
        File from `save_model`.

    Returns
    -------
    dict
        The notes given to `save_model`.

    Raises
    ------
    FileNotFoundError, ValueError
        As `load_model`.
    """
    with _open(path) as (_, metadata):
        try:
            notes: dict[str, Any] = _parse(metadata, "notes")
        except (KeyError, ValueError, RecursionError) as error:
            raise ValueError(f"weights {os.fspath(path)!r}: {_short(repr(error))}") from error
    return notes


@contextmanager
def _open(path: str | os.PathLike[str]) -> Iterator[tuple[Any, dict[str, str]]]:
    """A file and its metadata, if it is one of ours; nothing else has been read yet."""
    where = f"weights {os.fspath(path)!r}"
    if not Path(path).is_file():
        raise FileNotFoundError(f"{where}: no such file")
    try:
        with safe_open(path, framework="pt") as file:
            metadata = file.metadata() or {}
            if metadata.get("format") != FORMAT:
                raise ValueError(f"{where}: expected format {FORMAT!r}, got {_short(repr(metadata.get('format')))}")
            if metadata.get("version") != str(VERSION):
                raise ValueError(f"{where}: expected version {VERSION}, got {_short(metadata.get('version'))}")
            yield file, metadata
    except SafetensorError as error:
        raise ValueError(f"{where}: no safetensors file, or cut short ({_short(error)})") from error


def shipped_weights(preset: str) -> Path:
    """Path of the weights that come with the package.

    Parameters
    ----------
    preset : str
        Name.

    Returns
    -------
    Path
        The file.

    Raises
    ------
    ValueError
        If there is no such preset; names those there are.
    """
    folder = Path(__file__).parent / "weights"
    path = folder / f"{preset}.safetensors"
    if not path.is_file():
        known = ", ".join(sorted(p.stem for p in folder.glob("*.safetensors"))) or "none"
        raise ValueError(f"preset is {preset!r}, expected one of: {known}")
    return path
