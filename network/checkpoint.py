"""A model in one safetensors file: weights, and in its metadata what to build and where it comes from."""

from __future__ import annotations

import json
import os
from collections.abc import Mapping
from dataclasses import asdict, fields
from pathlib import Path
from typing import Any, TypeVar, cast

import torch
from safetensors import SafetensorError, safe_open
from safetensors.torch import save_file
from torch import Tensor

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
from network.stabilizer import Stabilizer, StabilizerConfig

Config = TypeVar("Config")

FORMAT = "ravg-network"
#: Raised when a change makes older weights give other kernels. Files say which one they were written for.
VERSION = 3
#: The greatest number in a description that is read: three times the width of any network here.
LARGEST = 256


#: Networks by name, with their configurations.
CLASSES: dict[str, tuple[Any, Any]] = {
    "RAUNet": (RAUNet, RAUNetConfig),
    "RAResNet": (RAResNet, RAResNetConfig),
    "TKPCN": (TKPCN, TKPCNConfig),
    "Stabilizer": (Stabilizer, StabilizerConfig),
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
        If a weight is not finite in half precision.
    """
    tensors = {name: value.detach().to("cpu", torch.float16).contiguous() for name, value in model.state_dict().items()}
    for name, value in tensors.items():
        if not bool(torch.isfinite(value).all()):
            raise ValueError(f"{name}: expected finite weights in half precision, got NaN or infinity")
    metadata = {
        "format": FORMAT,
        "version": str(VERSION),
        "description": json.dumps(describe(model)),
        "notes": json.dumps(dict(notes or {})),
    }
    path = Path(path)
    partial = new_partial(path)
    try:
        save_file(tensors, partial, metadata)
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
    os.close(os.open(partial, os.O_WRONLY | os.O_CREAT | os.O_EXCL | os.O_NOFOLLOW, 0o666))
    return partial


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
    metadata, tensors = _read(path)
    where = f"weights {os.fspath(path)!r}"
    try:
        description = json.loads(metadata["description"])
        _refuse_huge(description)
        model = build(description)
    except (KeyError, ValueError, RecursionError) as error:
        raise ValueError(f"{where}: {error}") from error
    wanted = {name: tuple(value.shape) for name, value in model.state_dict().items()}
    found = {name: tuple(value.shape) for name, value in tensors.items()}
    if wanted != found:
        name = min(key for key in wanted.keys() | found.keys() if wanted.get(key) != found.get(key))
        raise ValueError(f"{where}: {name}: expected shape {wanted.get(name)}, got {found.get(name)}")
    for name, value in tensors.items():
        if not value.is_floating_point() or not bool(torch.isfinite(value).all()):
            raise ValueError(f"{where}: {name}: expected finite numbers, got {value.dtype} with others among them")
    model.load_state_dict({name: value.float() for name, value in tensors.items()})
    return model


def _refuse_huge(value: Any) -> None:
    """Raise ValueError for a description that would take all memory, or for ever, to build."""
    if isinstance(value, Mapping | list):
        if len(value) > LARGEST:
            raise ValueError(f"model description: expected at most {LARGEST} values together, got {len(value)}")
        for item in value.values() if isinstance(value, Mapping) else value:
            _refuse_huge(item)
    elif isinstance(value, int | float) and not abs(value) <= LARGEST:
        raise ValueError(f"model description: expected numbers up to {LARGEST}, got {value}")


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
    metadata, _ = _read(path)
    try:
        notes: dict[str, Any] = json.loads(metadata["notes"])
    except (KeyError, ValueError, RecursionError) as error:
        raise ValueError(f"weights {os.fspath(path)!r}: {error!r}") from error
    return notes


def _read(path: str | os.PathLike[str]) -> tuple[dict[str, str], dict[str, Tensor]]:
    """Metadata and tensors of a file, if it is one of ours."""
    where = f"weights {os.fspath(path)!r}"
    if not Path(path).is_file():
        raise FileNotFoundError(f"{where}: no such file")
    try:
        with safe_open(path, framework="pt") as file:
            metadata = file.metadata() or {}
            tensors = {name: file.get_tensor(name) for name in file.keys()}  # noqa: SIM118 (no mapping)
    except SafetensorError as error:
        raise ValueError(f"{where}: no safetensors file, or cut short ({error})") from error
    if metadata.get("format") != FORMAT:
        raise ValueError(f"{where}: expected format {FORMAT!r}, got {metadata.get('format')!r}")
    if metadata.get("version") != str(VERSION):
        raise ValueError(f"{where}: expected version {VERSION}, got {metadata.get('version')}")
    return metadata, tensors
