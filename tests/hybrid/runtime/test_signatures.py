"""Signatures: the list is that of the loops which a run calls, and each type is read as it was written."""

import json

import numpy as np
import pytest
from numba import typeof, types

from hybrid.runtime.signatures import FILE, listed_loops, parse_type
from nlm.samples import SampleMean
from tests.signatures import called_loops, describe_type

PLANE, PICTURE = np.zeros((2, 3), np.float32), np.zeros((2, 3, 3), np.float32)
VALUES = {
    "int64": 1,
    "float64": 1.0,
    "float32": np.float32(1),
    "bool": True,
    "float32[3]": PICTURE,
    "bool[2]": PLANE > 0,
    "uint32[1]": np.zeros(2, np.uint32),
    "float32[2]A": PICTURE[..., 0],
}
TUPLES = [
    ([1, np.float32(1)], ["int64", "float32"]),
    ([PLANE, PLANE], ["float32[2]", "float32[2]"]),
    (
        SampleMean(PICTURE, PLANE, PLANE, PLANE),
        {"nlm.samples.SampleMean": ["float32[3]", "float32[2]", "float32[2]", "float32[2]"]},
    ),
]


@pytest.mark.parametrize("described", VALUES)
def test_a_scalar_or_an_array_has_a_short_form(described):
    assert describe_type(typeof(VALUES[described])) == described
    assert parse_type(described) == typeof(VALUES[described])


@pytest.mark.parametrize(("value", "described"), TUPLES)
def test_a_tuple_has_those_of_its_parts(value, described):
    type_ = typeof(tuple(value) if isinstance(value, list) else value)
    assert describe_type(type_) == described
    assert parse_type(json.loads(json.dumps(described))) == type_


def test_a_type_without_a_short_form_is_refused():
    """An array that cannot be written to has another type: its loop would be compiled for nobody."""
    fixed = np.broadcast_to(PLANE[:1], (4, 3))
    for type_ in (typeof(fixed), types.unicode_type):
        with pytest.raises(ValueError, match="expected a scalar, an array that can be written to, or a tuple"):
            describe_type(type_)


def test_each_listed_loop_is_there():
    listed = [f"{loop.__module__}.{loop.__name__}" for loop, _ in listed_loops()]
    assert listed == [*json.loads(FILE.read_text())][::-1]


def test_the_list_is_that_of_the_loops_which_a_run_calls(tmp_path):
    """A loop of another type, or one that is called no more, would be compiled in vain.

    After a change of a loop's arguments ``python -m tests.signatures`` writes the list anew.
    """
    pytest.importorskip("torch")
    assert called_loops(tmp_path) == [*json.loads(FILE.read_text()).items()]
