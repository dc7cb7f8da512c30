"""What all tests share: few threads, and a small shot on disk."""

# ruff: noqa: E402 - the libraries read their numbers of threads when they are imported

from __future__ import annotations

import os

# The pictures are small: threads gain nothing, and on a busy machine they wait for each other, ten times as long.
for _name in ("OMP_NUM_THREADS", "NUMBA_NUM_THREADS"):
    os.environ.setdefault(_name, "1")

from pathlib import Path

import pytest

from tests.scenes import Scene


@pytest.fixture
def shot_folder(tmp_path: Path) -> Path:
    """Three noisy frames on disk."""
    return Scene().write(tmp_path / "noisy")
