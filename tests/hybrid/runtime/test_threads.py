"""How many threads the libraries use, and what those do that wait."""

import os
import subprocess
import sys

import pytest

from hybrid.cli import main
from hybrid.runtime.threads import SPINS, check_thread_counts

VARIABLES = "OMP_WAIT_POLICY", "GOMP_SPINCOUNT"


@pytest.mark.parametrize(
    ("given", "expected"),
    [
        ({}, ("PASSIVE", str(SPINS))),
        ({"OMP_WAIT_POLICY": "passive"}, ("passive", str(SPINS))),
        ({"OMP_WAIT_POLICY": "ACTIVE"}, ("ACTIVE", None)),
        ({"GOMP_SPINCOUNT": "0"}, ("PASSIVE", "0")),
    ],
)
def test_the_command_lets_waiting_threads_sleep_unless_told_otherwise(given, expected, monkeypatch, capsys):
    environment = {name: value for name, value in os.environ.items() if name not in VARIABLES}
    monkeypatch.setattr(os, "environ", environment | given)
    assert main(["--version"]) == 0
    assert tuple(os.environ.get(name) for name in VARIABLES) == expected


COUNTS = """
import cv2, loops.parallel
{first}
from hybrid.runtime.threads import limit_threads
limit_threads(1)
import torch
print(cv2.getNumThreads(), loops.parallel.thread_count(), torch.get_num_threads())
"""


@pytest.mark.neural
@pytest.mark.parametrize("first", ["import torch", ""])
def test_all_libraries_are_limited_whether_torch_is_there_already_or_not(first):
    code = COUNTS.format(first=first)
    environment = {name: value for name, value in os.environ.items() if name != "OMP_NUM_THREADS"}
    environment["NUMBA_NUM_THREADS"] = "3"
    done = subprocess.run([sys.executable, "-c", code], capture_output=True, text=True, env=environment, check=True)
    assert done.stdout.split() == ["1", "1", "1"]


@pytest.mark.parametrize("name", ["NUMBA_NUM_THREADS", "OMP_NUM_THREADS", "MKL_NUM_THREADS"])
@pytest.mark.parametrize("count", ["abc", "0", "-1", "1.5", "100000", "4,x", "9" * 5000])
def test_numbers_of_threads_that_are_none_are_one_line(name, count, shot_folder, monkeypatch, capsys):
    """numba gave a traceback in a warning, a segmentation fault, or a line that did not name the variable."""
    monkeypatch.setenv(name, count)
    assert main(["inspect", str(shot_folder)]) == 1
    said = capsys.readouterr().err.splitlines()
    assert len(said) == 1
    assert said[0].startswith(f"error: {name} is ")


def test_numbers_of_threads_that_the_libraries_take_are_left_alone(monkeypatch):
    monkeypatch.setenv("OMP_NUM_THREADS", "4, 2")
    monkeypatch.setenv("NUMBA_NUM_THREADS", " ")
    check_thread_counts()
    assert os.environ["OMP_NUM_THREADS"] == "4, 2"
    assert "NUMBA_NUM_THREADS" not in os.environ
