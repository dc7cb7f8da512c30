"""Arrays that outlive a window: in files, the same values, and gone with their last reference."""

import gc
import mmap
import sys
import weakref
from dataclasses import dataclass
from typing import NamedTuple

import numpy as np
import pytest

from hybrid.runtime import kept
from hybrid.runtime.kept import Keeper


class Pair(NamedTuple):
    """Two arrays."""

    one: np.ndarray
    other: np.ndarray | None


@dataclass(frozen=True)
class Holder:
    """Arrays as frames hold them."""

    number: int
    layer: np.ndarray
    pair: Pair
    named: dict[str, np.ndarray]


@pytest.fixture(autouse=True)
def small(monkeypatch):
    monkeypatch.setattr(kept, "SMALLEST", 16)


def mapping_of(array):
    while isinstance(array, np.ndarray):
        array = array.base
    return getattr(array, "obj", array)


def test_values_are_the_same_and_lie_in_files():
    layer = np.arange(24, dtype=np.float32).reshape(2, 4, 3)
    mask, tiny = np.arange(40).reshape(4, 10) % 3 == 0, np.zeros(1)
    given = Holder(7, layer, Pair(layer, None), {"mask": mask[:, ::2], "tiny": tiny})
    keeper = Keeper(in_files=True)
    found = keeper.keep(given)
    assert found.number == 7
    assert isinstance(mapping_of(found.layer), mmap.mmap)
    assert found.pair.one is found.layer  # shared as before
    assert found.named["tiny"] is tiny
    np.testing.assert_array_equal(found.layer, layer)
    np.testing.assert_array_equal(found.named["mask"], mask[:, ::2])
    keeper.release()
    np.testing.assert_array_equal(found.layer, layer)
    assert keeper.keep(found) is found  # moved once
    assert keeper.keep(found.layer[1:]).base is not None  # a view of a mapping stays a view


def test_what_has_no_arrays_is_left_alone():
    value = ("words", {"a": 1.0}, frozenset({"b"}))
    assert Keeper(in_files=True).keep(value) is value
    assert Keeper().keep(given := np.ones((8, 8))) is given  # without files nothing is copied


@pytest.mark.parametrize("in_files", [False, True])
def test_freed_memory_is_returned_where_that_is_asked_for(monkeypatch, in_files):
    calls = []
    monkeypatch.setattr("hybrid.runtime.kept.return_freed_memory", lambda: calls.append("freed"))
    keeper = Keeper(in_files=in_files)
    monkeypatch.setattr(keeper, "release", lambda: calls.append("pages"))
    keeper.trim()
    assert calls == (["pages", "freed"] if in_files else [])


def test_a_mapping_ends_with_its_array():
    keeper = Keeper(in_files=True)
    array = keeper.keep(np.ones((8, 8), np.float32))
    gone = weakref.ref(mapping_of(array))
    del array
    gc.collect()
    assert gone() is None


@pytest.mark.skipif(sys.platform == "win32", reason="there a file has a name until its mapping ends")
def test_files_have_no_name(tmp_path, monkeypatch):
    """Nothing is left behind, however the process ends."""
    monkeypatch.setattr("tempfile.tempdir", str(tmp_path))
    keeper = Keeper(in_files=True)
    held = keeper.keep(np.ones((8, 8), np.float32)), keeper.empty((8, 8), np.dtype(np.float32))
    held[1][:] = 3
    keeper.release()
    assert held[0].sum() == 64
    assert held[1].sum() == 192
    assert not list(tmp_path.iterdir())
