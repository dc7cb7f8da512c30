"""Every denoiser that is opened by options is the one that was asked for."""

import numpy as np
import pytest

from hybrid.denoising.denoisers import AverageDenoiser, ClassicalDenoiser
from hybrid.denoising.pseudo_reference import CLASSICAL_PRESETS
from hybrid.run.job import DenoiseOptions, open_denoiser


@pytest.mark.parametrize("preset", [*CLASSICAL_PRESETS])
def test_the_classical_chain_takes_noisy_frames(preset):
    denoiser = open_denoiser(DenoiseOptions(preset=preset))
    assert isinstance(denoiser, ClassicalDenoiser)
    assert denoiser.preset is CLASSICAL_PRESETS[preset]
    assert not denoiser.needs_first_pass


def test_with_a_first_pass_it_is_the_gated_average():
    denoiser = open_denoiser(DenoiseOptions(method="classical", first_pass="nlm"))
    assert isinstance(denoiser, AverageDenoiser)
    assert denoiser.needs_first_pass


@pytest.mark.neural
@pytest.mark.parametrize("preset", ["fast", "balanced", "quality"])
def test_a_network_says_what_its_pixels_depend_on(preset):
    denoiser = open_denoiser(DenoiseOptions(preset=preset, tile=64, precision="float32", device="cpu"))
    assert denoiser.settings == {"tile": 64, "threshold": None, "precision": "float32"}
    assert denoiser.radius == (3 if preset == "quality" else 2)
    assert denoiser.needs_first_pass
    assert denoiser.packages == ("torch",)
    assert (denoiser.memory((64, 64)) > 0) == (preset != "fast")
    assert np.isfinite(denoiser.memory((2160, 3840)))
