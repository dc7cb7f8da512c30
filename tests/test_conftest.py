"""The parts into which the tests are divided."""

import argparse
from pathlib import Path
from types import SimpleNamespace

import pytest

from tests.conftest import pytest_addoption, pytest_collection_modifyitems


def option(*words):
    """The value of --part."""
    parser = argparse.ArgumentParser()
    pytest_addoption(SimpleNamespace(addoption=parser.add_argument))
    return parser.parse_args(words).part


def taken(part, expression=""):
    """The names of the tests that are left of forty, half of them marked."""
    marker = SimpleNamespace(name="reliability")
    items = [
        SimpleNamespace(
            nodeid=f"test_a.py::test_a[{n}]",
            path=Path("test_a.py"),
            get_closest_marker=lambda name, n=n: marker if n % 2 and name == marker.name else None,
        )
        for n in range(40)
    ]
    gone = []
    config = SimpleNamespace(
        option=SimpleNamespace(markexpr=expression),
        getoption={"part": part}.get,
        hook=SimpleNamespace(pytest_deselected=lambda items: gone.extend(items)),
    )
    pytest_collection_modifyitems(config, items)
    assert len(items) + len(gone) == 40
    return [int(item.nodeid.split("[")[1][:-1]) for item in items]


def test_parts_are_the_same_each_time_and_together_all_tests():
    parts = [taken(option("--part", f"{number}/3"), "hard or reliability") for number in (1, 2, 3)]
    assert parts[0] == [2, 9, 10, 11, 13, 14, 18, 19, 21, 27, 28, 30, 33, 36, 38]
    assert sorted(number for part in parts for number in part) == [*range(40)]
    assert taken(option()) == [*range(0, 40, 2)]
    assert taken(option("--part", "1/3")) == [number for number in parts[0] if number % 2 == 0]


@pytest.mark.parametrize("text", ["", "1", "0/5", "6/5", "1/0", "-1/5", "a/b", "1/2/3"])
def test_what_is_no_part_is_refused(text, capsys):
    with pytest.raises(SystemExit):
        option(f"--part={text}")
    assert "expected K/N, where 1 <= K <= N" in capsys.readouterr().err
