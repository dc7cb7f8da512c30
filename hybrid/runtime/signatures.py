"""Signatures of the loops that `balanced` calls, so that they can be compiled before they are called.

`signatures.json` maps the name of each loop to the types of its arguments; ``python -m tests.signatures`` writes it.
"""

import json
from collections.abc import Iterator
from importlib import import_module
from pathlib import Path
from typing import Any

import numpy as np
from numba import types
from numba.np.numpy_support import from_dtype

FILE = Path(__file__).with_name("signatures.json")


def listed_loops() -> Iterator[tuple[Any, tuple[Any, ...]]]:
    """Import the loops of `signatures.json`; each with the types of its arguments, those that a run needs late first.

    The order of a run is about that of the alphabet: it aligns frames, filters them and blends samples.
    """
    for name, arguments in reversed(json.loads(FILE.read_text(encoding="utf-8")).items()):
        yield _find(name), tuple(parse_type(argument) for argument in arguments)


def count_listed() -> int:
    """Return the number of loops in `signatures.json`."""
    return len(json.loads(FILE.read_text(encoding="utf-8")))


def parse_type(described: Any) -> Any:
    """Return the numba type of a description.

    A scalar is the name of its dtype, an array ``"float32[3]"``, with ``A`` behind it if it is not C-contiguous, a
    tuple a list, a named tuple ``{"module.Class": [...]}``.
    """
    if isinstance(described, dict):
        ((name, parts),) = described.items()
        return _tuple_of(parts, _find(name))
    if isinstance(described, list):
        return _tuple_of(described)
    name, _, rest = described.partition("[")
    scalar = from_dtype(np.dtype(name))
    if not rest:
        return scalar
    ndim, _, layout = rest.partition("]")
    return types.Array(scalar, int(ndim), layout or "C")


def _tuple_of(parts: list[Any], named: Any = None) -> Any:
    return types.BaseTuple.from_types([parse_type(part) for part in parts], named)  # type: ignore[no-untyped-call]


def _find(name: str) -> Any:
    module, _, attribute = name.rpartition(".")
    return getattr(import_module(module), attribute)
