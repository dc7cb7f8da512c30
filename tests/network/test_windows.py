"""Windows have the channels that are said."""

import pytest

pytest.importorskip("torch")

from network.robust_unet import AUX_CHANNELS, pack_inputs
from network.windows import FRAME_CHANNELS, SHARED_CHANNELS, STATIC_CHANNELS
from tests.network.test_robust_unet import make_window

pytestmark = pytest.mark.neural


def test_packed_inputs_have_the_channels_that_are_said() -> None:
    inputs = pack_inputs(make_window())
    assert [layer.shape[1] for layer in inputs] == [FRAME_CHANNELS, SHARED_CHANNELS, STATIC_CHANNELS, 3]
    assert FRAME_CHANNELS + SHARED_CHANNELS == STATIC_CHANNELS + AUX_CHANNELS
