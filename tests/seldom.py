"""Cases of a ladder beside those that run each time."""

from typing import Any

import pytest


def seldom(*values: object) -> list[Any]:
    """Values of a parameter that only `pytest -m reliability` tries."""
    return [pytest.param(value, marks=pytest.mark.reliability) for value in values]
