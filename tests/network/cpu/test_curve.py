"""The transfer curve from tables is that of the functions."""

import numpy as np
import torch

from network import transfer
from network.cpu.curve import can_tabulate, decode, encode


def pictures(values: np.ndarray) -> tuple[torch.Tensor, np.ndarray]:
    """A picture of three channels of these values, channels last, and the values as they are in it."""
    values = values[: len(values) // 3 * 3].astype(np.float32)
    return torch.from_numpy(values.reshape(1, 1, -1, 3)).permute(0, 3, 1, 2), values.astype(np.float64)


def test_the_curve_is_as_exact_as_float32() -> None:
    """From nothing to beyond the sun; at the ends of the table, and where the pieces of the curve meet."""
    ends = np.float32([2.0**-20, 2.0**16])
    special = [0, *ends, *np.nextafter(ends, np.float32(0)), transfer._Y0, transfer._Y1, 1e9, 3e38]
    light, exact = pictures(np.concatenate([special, np.geomspace(1e-12, 1e12, 5000)]))
    with torch.no_grad():
        assert can_tabulate(light)
        found = encode(light).permute(0, 2, 3, 1).numpy().ravel()
    exact = transfer.pu_forward(torch.from_numpy(exact)).numpy()
    # Plain float32 arithmetic is as far away.
    np.testing.assert_allclose(found, exact, rtol=3e-7, atol=1.5e-7)


def test_the_inverse_is_exact_to_a_hundred_thousandth() -> None:
    """From below nothing to beyond white; where the pieces of the curve meet, and at the ends of the table."""
    ends = np.float32([2.0**-11, 2])
    special = [-1, 0, *ends, *np.nextafter(ends, np.float32(0)), 7.1178e-4, 0.11833, 2.2]
    encoded, exact = pictures(np.concatenate([special, np.linspace(0, 1.9, 50000)]))
    with torch.no_grad():
        found = decode(encoded).permute(0, 2, 3, 1).numpy().ravel()
        assert torch.isnan(decode(torch.full((1, 3, 1, 1), torch.nan))).all()
    exact = transfer.pu_inverse(torch.from_numpy(exact).clamp_min(0)).numpy()
    # 1024 entries for each power of two: the squared step times the curvature, over eight.
    np.testing.assert_allclose(found, exact, rtol=4e-5, atol=1e-9)


def test_tables_are_used_where_they_can_be() -> None:
    """Without gradients, and in float32."""
    x = torch.rand(1, 3, 4, 5)
    assert not can_tabulate(x)
    assert torch.equal(encode(x), transfer.pu_forward(x))
    assert torch.equal(decode(-x), torch.zeros_like(x))
    with torch.no_grad():
        assert not can_tabulate(x.double())
