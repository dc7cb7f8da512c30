"""An exponential that a compiler computes for several values at once."""

import numpy as np
import pytest
from numba import njit

from loops.decay import decay


@njit
def _decay_all(values: np.ndarray, out: np.ndarray) -> None:
    for x in range(len(values)):
        out[x] = decay(values[x])


def decayed(*values: float) -> np.ndarray:
    """`decay` of values, as a loop computes it."""
    out = np.empty(len(values), np.float32)
    _decay_all(np.array(values, np.float32), out)
    return out


def test_it_is_the_exponential() -> None:
    values = np.linspace(0, 10, 10001, dtype=np.float32)
    np.testing.assert_allclose(decayed(*values), np.exp(-values.astype(np.float64)), rtol=2e-5)


def test_it_falls_everywhere_and_has_no_weight_far_off() -> None:
    values = np.append(np.linspace(0, 100, 100001, dtype=np.float32), [1e4, 1e30, np.inf])
    found = decayed(*values)
    assert (np.diff(found) <= 0).all()
    assert (found >= 0).all()
    assert not found[values >= 80].any()


@pytest.mark.parametrize(("value", "expected"), [(0.0, 1.0), (-0.0, 1.0), (np.nan, 0.0)])
def test_nothing_is_kept_whole_and_what_is_unknown_has_no_weight(value: float, expected: float) -> None:
    assert decayed(value)[0] == expected
