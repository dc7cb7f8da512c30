"""The weights that are shipped, on the shot that is bundled."""

import re
from functools import lru_cache
from pathlib import Path

import numpy as np
import pytest
import torch

from hybrid.comparison.metrics import mean_bias, psnr
from hybrid.denoising.first_pass import NETWORKS, Classical
from hybrid.denoising.plan import Rules
from hybrid.denoising.pseudo_reference import FINAL, filter_window, gated_average
from hybrid.denoising.stream import FrameStream
from hybrid.files.shots import open_shot
from hybrid.neural import open_network
from network.checkpoint import find_weights, load_model, save_model, shipped_weights
from network.presets import build_preset
from network.robust_average import RobustAverage
from nlm.average import robust_average
from tests.seldom import seldom

SHOT = Path(__file__).parents[2] / "data" / "bathroom"
FRAME = 11


@lru_cache
def window(radius=2):
    shot = open_shot(SHOT / "noisy.####.exr")
    return FrameStream(shot, Rules(), radius=radius, first_pass=Classical(FINAL)).align(FRAME)


def picture(denoiser):
    return denoiser(window(denoiser.radius)).color


@lru_cache
def picture_of(preset):
    return picture(open_network(find_weights(preset)))


@lru_cache
def final():
    return filter_window(window(), FINAL)


@pytest.fixture(scope="module")
def reference():
    return open_shot(SHOT / "reference.####.exr").read(FRAME).color


def test_final_gains_what_is_promised_on_the_bathroom(reference):
    aligned = window()
    gained = psnr(final(), reference)
    robust = psnr(robust_average(aligned.color, aligned.confidence) * aligned.modulation, reference)
    assert gained > psnr(aligned.color[2] * aligned.modulation, reference) + 6
    assert gained > robust + 2


@pytest.mark.parametrize("preset", [*NETWORKS, "ra", "tkpcn", "multiscale"])
def test_weights_reach_what_their_card_says(reference, preset):
    path = find_weights(preset)
    card = path.with_suffix(".md").read_text(encoding="utf-8")
    promised = float(re.search(r"frame 11 of the bundled shot: (\d+\.\d+) dB", card)[1])
    image = picture_of(preset)
    # bfloat16 or float32, one processor or another: hundredths of a decibel
    assert psnr(image, reference) == pytest.approx(promised, abs=0.1)
    assert preset not in NETWORKS or psnr(image, reference) > psnr(final(), reference)
    assert abs(mean_bias(image, reference)) < 0.01


@pytest.mark.parametrize(("preset", "frames"), [("fast", 5), ("balanced", 5), ("quality", 7)])
def test_windows_are_as_long_as_is_promised_and_as_trainings_begin_with(preset, frames):
    shipped = load_model(shipped_weights(preset))
    assert shipped.frames == frames
    assert shipped.config == build_preset(preset).config


def decibels(image, number=FRAME):
    """PSNR against two independent references, whose noise cancels in the product of both differences."""
    shots = [open_shot(SHOT / f"{name}.####.exr").read(number).color for name in ("reference", "reference_b")]
    seen, *clean = (np.maximum(x, 0) / (1 + np.maximum(x, 0)) for x in (image, *shots))
    return float(-10 * np.log10(np.mean((seen - clean[0]) * (seen - clean[1]))))


# Measured: 0.76 and 1.18 dB.
@pytest.mark.parametrize(("preset", "gain"), [("balanced", 0.5), ("quality", 0.9)])
def test_the_network_is_worth_more_than_the_average_it_starts_from(preset, gain):
    """Put `gated_average` in its place, and something must be missing."""
    average = gated_average(window(open_network(shipped_weights(preset)).radius))
    assert decibels(picture_of(preset)) > decibels(average) + gain


def centre_alone(self, window):
    weights = torch.zeros_like(window.confidence)
    weights[:, weights.shape[1] // 2] = 1
    return weights


@pytest.mark.parametrize(("preset", "loss"), [("fast", 0.2), ("balanced", 0.15), ("quality", 0.9)])
def test_the_robust_average_block_is_worth_something(preset, loss, monkeypatch):
    """Put the centre in its place, and something must be missing."""
    denoiser = open_network(shipped_weights(preset))
    whole = decibels(picture_of(preset))
    monkeypatch.setattr(RobustAverage, "is_prior", False)
    monkeypatch.setattr(RobustAverage, "forward", centre_alone)
    assert whole > decibels(picture(denoiser)) + loss


@pytest.mark.parametrize("preset", ["fast", *seldom("balanced")])
def test_a_correction_by_the_block_changes_the_image(preset, tmp_path):
    """Computed at full size, as for trained weights, a correction of 0 changes nothing."""
    model = load_model(shipped_weights(preset))
    images = {}
    for bias in (0.0, 1e-7, -2.0):
        torch.nn.init.constant_(model.robust_average.correction[-1].bias, bias)
        path = tmp_path / f"{bias}.safetensors"
        save_model(path, model)
        images[bias] = picture(open_network(path, precision="float32"))  # bfloat16 rounds a ten-millionth up or down
    np.testing.assert_allclose(images[1e-7], images[0.0], rtol=1e-4, atol=1e-5)
    assert psnr(images[-2.0], images[0.0]) < 55
