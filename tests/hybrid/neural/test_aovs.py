"""Layers that are parts of the light add up to it, denoised."""

import numpy as np
import pytest

from hybrid.checks.validation import validate_layers
from hybrid.denoising.first_pass import Classical
from hybrid.denoising.pseudo_reference import DRAFT
from hybrid.denoising.stream import FrameStream
from hybrid.files.shots import open_shot
from hybrid.neural import open_network
from network.checkpoint import shipped_weights
from tests.scenes import Scene, only

STAGES = {"demodulate", "outliers", "warp"}
SCENE = Scene(height=70, width=90, frames=5)


def align(folder, **options):
    shot = open_shot(folder, **options)
    return FrameStream(validate_layers(shot).apply(shot), only(STAGES), first_pass=Classical(DRAFT)).align(
        SCENE.first + 2
    )


def test_layers_that_add_up_to_the_color_still_do(tmp_path):
    """And a layer that is the color comes out as the color: it was 4 dB worse, and two halves missed it by 18 %."""

    def split(index, layers):
        color = layers["ViewLayer.Combined"]
        share = np.random.default_rng(index).uniform(0.2, 0.5, (SCENE.height, SCENE.width, 1)).astype(np.float32)
        layers["diffuse"], layers["glossy"], layers["same"] = share * color, (1 - share) * color, color.copy()

    folder = SCENE.write(tmp_path, edit=split)
    denoiser = open_network(shipped_weights("balanced"), precision="float32")
    made = denoiser(align(folder, aovs=("diffuse", "glossy")))
    together = made.aovs["diffuse"] + made.aovs["glossy"]
    assert np.abs(together - made.color).max() < 1e-4 * made.color.mean()
    alone = denoiser(align(folder, aovs=("same",)))
    np.testing.assert_allclose(alone.aovs["same"], alone.color, rtol=1e-4)


def cycles_passes(index: int, layers: dict[str, np.ndarray]) -> None:
    """Direct and indirect light without its color, emission, and two groups of lamps, as Cycles writes them."""
    combined, size = layers["ViewLayer.Combined"], (SCENE.height, SCENE.width)
    rng = np.random.default_rng(index)
    emission = np.zeros_like(combined)
    emission[10:20, 10:20] = 0.5
    shares = rng.dirichlet([3, 2, 2, 1], size).astype(np.float32)
    colors = {"Diff": layers["ViewLayer.Denoising Albedo"].copy(), "Gloss": np.full_like(combined, 0.04)}
    colors["Gloss"][:, 60:] = 0  # no gloss there, nor light of it
    shares[:, 60:, 2:] = 0
    total = emission.copy()
    for k, (lobe, kind) in enumerate((a, b) for a in colors for b in ("Dir", "Ind")):
        light = shares[..., k, None] * combined / np.maximum(colors[lobe], 0.02)
        layers[f"ViewLayer.{lobe}{kind}"] = light
        total += light * colors[lobe]
    layers |= {f"ViewLayer.{lobe}Col": color for lobe, color in colors.items()}
    key = rng.uniform(0.3, 0.8, (*size, 1)).astype(np.float32)
    layers |= {"ViewLayer.Emit": emission, "ViewLayer.Combined": total}
    layers |= {"ViewLayer.Combined_key": key * total, "ViewLayer.Combined_fill": (1 - key) * total}


@pytest.mark.parametrize("give_way", ["layers", "beauty"])
def test_all_of_cycles_passes_and_light_groups_add_up(give_way, tmp_path):
    window = align(SCENE.write(tmp_path, edit=cycles_passes), aovs=("all",))
    passes = {f"ViewLayer.{lobe}{kind}": f"{lobe}Col" for lobe in ("Diff", "Gloss") for kind in ("Dir", "Ind")}
    groups = {"ViewLayer.Combined_key", "ViewLayer.Combined_fill"}
    assert {*window.aovs} == {*passes, *groups, "ViewLayer.Emit"}
    denoiser = open_network(shipped_weights("balanced"), precision="float32", add_layers=give_way == "beauty")
    made = denoiser(window)
    assert all((layer >= 0).all() and np.isfinite(layer).all() for layer in made.aovs.values())
    frame = open_shot(tmp_path, aovs=("DiffCol", "GlossCol")).read(SCENE.first + 2)
    together = made.aovs["ViewLayer.Emit"] + sum(made.aovs[name] * frame.aovs[tint] for name, tint in passes.items())
    within = 1e-4 * made.color.mean()
    assert np.abs(together - made.color).max() < within
    assert np.abs(sum(made.aovs[name] for name in groups) - made.color).max() < within
    alone = open_network(shipped_weights("balanced"), precision="float32")(align(tmp_path)).color
    assert (np.abs(made.color - alone).max() < within) == (give_way == "layers")
    # A picture that is the sum of its parts is denoised too: its noise has a deviation of 0.3.
    assert np.std(made.color - alone) < 0.1 * np.mean(alone)
