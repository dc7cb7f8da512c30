import torch

from network.transfer import clip, pu_forward, pu_inverse, srgb_forward, srgb_inverse


def test_curves_and_their_inverses() -> None:
    y = torch.logspace(-8, 5, 400)
    x = pu_forward(y)
    assert bool((x.diff() > 0).all())
    torch.testing.assert_close(pu_forward(torch.tensor([65504.0])), torch.ones(1))
    torch.testing.assert_close(pu_inverse(x), y, rtol=2e-4, atol=1e-9)  # the curve's constants have nine digits
    assert pu_forward(torch.zeros(1)).item() == 0
    assert pu_inverse(torch.zeros(1)).item() == 0
    y = torch.linspace(0, 1, 400)
    torch.testing.assert_close(srgb_inverse(srgb_forward(y)), y, rtol=0, atol=1e-6)


def test_clipping_leaves_nothing_that_is_not_finite() -> None:
    values = torch.tensor([float("nan"), float("inf"), -float("inf"), 0.5, 3.0])
    assert clip(values, -1, 1).tolist() == [0, 1, -1, 0.5, 1]
