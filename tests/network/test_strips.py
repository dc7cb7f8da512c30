"""Pictures made strip by strip are those made at once."""

import pytest
import torch

from network import strips as module
from tests.network.oidn_like import made_up_unet


def test_strips_and_the_whole_are_one_picture(monkeypatch: pytest.MonkeyPatch) -> None:
    """Without gradients it goes over some rows at a time."""
    picture = torch.rand(2, 9, 48, 32, generator=torch.Generator().manual_seed(3))
    made_up = made_up_unet()
    with torch.no_grad():
        whole = made_up(picture)
        monkeypatch.setattr(module, "ROWS", 6)
        strips = made_up(picture)
    # A sum may be taken in another order where there are fewer pixels.
    torch.testing.assert_close(strips, whole, rtol=1e-5, atol=1e-6)
