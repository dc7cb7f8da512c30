"""Frames on disk: read as they were kept, whatever they are called."""

from pathlib import Path

import numpy as np
import pytest

from hybrid.comparison.store import FLIP_MAP, HALVES, REFERENCE, FrameStore


@pytest.mark.parametrize("name", ["OIDN balanced + clean guides", "..", "../up", "a/b", "é", "%2E"])
def test_arrays_are_read_back_and_stay_inside_the_folder(tmp_path: Path, name: str) -> None:
    store = FrameStore(tmp_path / "kept")
    image = np.arange(24, dtype=np.float32).reshape(2, 4, 3)
    assert not store.has(name, 5)
    store.save(name, 5, image)
    store.save(name, 5, image[..., 0], FLIP_MAP)
    np.testing.assert_array_equal(store.load(name, 5), image)
    np.testing.assert_array_equal(store.load(name, 5, FLIP_MAP), image[..., 0])
    assert store.has(name, 5, FLIP_MAP)
    assert not store.has(name, 6)
    assert [path.name for path in tmp_path.iterdir()] == ["kept"]


def test_names_that_are_alike_are_kept_apart(tmp_path: Path) -> None:
    store = FrameStore(tmp_path)
    names = ["a", "a/b", "a%2Fb", "A", "a ", "a."]
    for value, name in enumerate(names):
        store.save(name, 1, np.full((1, 1, 3), value, np.float32))
    assert [store.load(name, 1)[0, 0, 0] for name in names] == list(range(len(names)))


def test_a_reference_is_in_halves_where_it_came_so(tmp_path: Path) -> None:
    store = FrameStore(tmp_path)
    store.save(REFERENCE, 1, np.ones((2, 2, 3), np.float32))
    assert isinstance(store.load_reference(1), np.ndarray)
    for value, half in enumerate(HALVES):
        store.save(REFERENCE, 1, np.full((2, 2, 3), value, np.float32), half)
    a, b = store.load_reference(1)
    assert (a.max(), b.min()) == (0, 1)


def test_folders_differ_where_case_and_spaces_at_the_end_do_not_count(tmp_path: Path) -> None:
    """On Windows and macOS the frames of one method replaced those of another."""
    store = FrameStore(tmp_path)
    for name in ("a", "A", "a ", "con", "é", "É"):
        store.save(name, 1, np.ones((1, 1, 3), np.float32))
    names = [path.name for path in tmp_path.iterdir()]
    assert len({name.casefold().rstrip(" .") for name in names}) == 6
    assert "con" not in names
    assert all(name.isascii() for name in names)
