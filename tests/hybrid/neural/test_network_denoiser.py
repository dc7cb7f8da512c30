import cv2
import numpy as np
import pytest
import torch

from hybrid.checks.validation import validate_layers
from hybrid.denoising.breakdown import Breakdown
from hybrid.denoising.first_pass import Classical
from hybrid.denoising.pseudo_reference import DRAFT
from hybrid.denoising.stream import FrameStream
from hybrid.files.shots import open_shot
from hybrid.neural import open_network
from network.checkpoint import save_model, shipped_weights
from network.presets import build_preset
from tests.scenes import Scene, only

STAGES = {"demodulate", "outliers", "warp"}
SCENE = Scene(height=70, width=90, frames=5)


@pytest.fixture(scope="module", params=["balanced", "unet"])
def weights(request, tmp_path_factory):
    """The final stage that ships; and kernels never trained: what they make of their input, they make everywhere."""
    if request.param == "balanced":
        return shipped_weights("balanced")
    path = tmp_path_factory.mktemp("weights") / "untrained.safetensors"
    model = build_preset("unet", seed=3)
    with torch.no_grad():  # stronger than at the start of training, so that kernels differ from pixel to pixel
        model.head.window.weight.mul_(20)
    save_model(path, model)
    return path


@pytest.fixture(scope="module")
def folder(tmp_path_factory):
    return SCENE.write(tmp_path_factory.mktemp("shot"))


def align(folder, **options):
    shot = open_shot(folder, **options)
    return FrameStream(validate_layers(shot).apply(shot), only(STAGES), first_pass=Classical(DRAFT)).align(
        SCENE.first + 2
    )


def test_tiles_give_what_the_whole_image_gives(tmp_path, weights):
    """In a picture that is wider than a tile with its halo: tiles in the middle see neither of its ends."""
    scene = Scene(height=40, width=420, frames=5)
    shot = open_shot(scene.write(tmp_path))
    window = FrameStream(shot, only(STAGES), first_pass=Classical(DRAFT)).align(scene.first + 2)
    whole = open_network(weights, tile=512, precision="float32")(window).color
    denoiser = open_network(weights, tile=32, precision="float32")
    assert 2 * denoiser.halo + 32 < scene.width
    # The receptive field of the U-Net is wider than the halo; what lies beyond has next to no influence: 4e-7 here.
    np.testing.assert_allclose(denoiser(window).color, whole, rtol=0, atol=1e-5 * whole.mean())
    assert np.abs(whole - window.color[2] * window.modulation).max() > 0.1  # it does something
    denoiser.halo = 0
    assert np.abs(denoiser(window).color - whole).max() > 0.1 * whole.mean()  # seams; measured: a sixth and a third


def test_aovs_are_filtered_with_the_same_kernels(tmp_path, weights):
    def split(index, layers):
        layers["direct"] = 0.25 * layers["ViewLayer.Combined"]
        layers["mask"] = np.ones((SCENE.height, SCENE.width), np.float32)
        layers["ao"] = np.random.default_rng(index).uniform(0.5, 1.5, (SCENE.height, SCENE.width)).astype(np.float32)

    denoiser = open_network(weights, precision="float32")
    window = align(SCENE.write(tmp_path, edit=split), aovs=("direct", "mask", "ao"))
    aovs = denoiser(window).aovs
    assert aovs["direct"].shape == (SCENE.height, SCENE.width, 3)
    assert "mask" not in aovs  # it has no noise
    # The kernels sum to 1, so nothing is lost.
    assert np.isfinite(aovs["ao"]).all()
    assert aovs["ao"].mean() == pytest.approx(1, rel=0.05)


def test_alpha_is_filtered_but_not_as_light(tmp_path, weights):
    def cut_out(index, layers):
        alpha = np.random.default_rng(index).uniform(0.4, 0.6, (SCENE.height, SCENE.width, 1)).astype(np.float32)
        layers["ViewLayer.Combined"] = np.concatenate([layers["ViewLayer.Combined"], alpha], axis=-1)

    shot = open_shot(SCENE.write(tmp_path, edit=cut_out))
    window = FrameStream(shot, only(STAGES | {"alpha"}), first_pass=Classical(DRAFT)).align(SCENE.first + 2)
    alpha = open_network(weights, precision="float32")(window).aovs["alpha"]
    assert alpha.shape == (SCENE.height, SCENE.width, 1)
    assert 0.4 <= alpha.min() <= alpha.max() <= 0.6  # kernels are convex
    assert alpha.std() < 0.5 * window.aovs["alpha"][2].std()


def test_noise_of_alpha_is_filtered_in_space(tmp_path):
    """Grain of a shadow catcher stayed: alpha was averaged over time alone, here over the one frame there is."""
    clean = np.clip(np.linspace(-0.5, 1.5, 128, dtype=np.float32), 0, 1)[None, :, None]

    def catch(index, layers):
        noise = np.random.default_rng(index).normal(0, 0.3, (96, 128, 1)) * np.sqrt(clean * (1 - clean))
        alpha = np.clip(clean + noise, 0, 1).astype(np.float32)
        layers["ViewLayer.Combined"] = np.concatenate([layers["ViewLayer.Combined"], alpha], axis=-1)

    scene = Scene(frames=1, height=96, width=128)
    stages = STAGES | {"alpha"}
    rms = {}
    for stage in ("clean-alpha", "skip"):
        stream = FrameStream(
            open_shot(scene.write(tmp_path, edit=catch)), only(stages | {stage}), first_pass=Classical(DRAFT), radius=2
        )
        window = stream.align(scene.first)
        alpha = open_network(shipped_weights("balanced"))(window).aovs["alpha"]
        assert 0 <= alpha.min() <= alpha.max() <= 1
        np.testing.assert_array_equal(alpha[:, :30], 0)
        np.testing.assert_array_equal(alpha[:, -30:], 1)
        rms[stage] = float(np.sqrt(np.mean((alpha - clean) ** 2)))
    assert rms["clean-alpha"] < 0.4 * rms["skip"]


def test_what_is_opaque_stays_opaque(tmp_path, weights):
    """Interpolated outlines of neighbours used to leave 0.99 where the frame itself covers all."""

    def disc(index, layers):
        y, x = np.mgrid[: SCENE.height, : SCENE.width]
        alpha = ((y - 15) ** 2 + (x - 20 - 1.4 * index) ** 2 < 90).astype(np.float32)[..., None]
        layers["ViewLayer.Combined"] = np.concatenate([layers["ViewLayer.Combined"], alpha], axis=-1)

    window = FrameStream(
        open_shot(SCENE.write(tmp_path, edit=disc)), only(STAGES | {"alpha"}), first_pass=Classical(DRAFT)
    ).align(SCENE.first + 2)
    given = window.aovs["alpha"][2][..., 0]
    alpha = open_network(weights, precision="float32")(window).aovs["alpha"][..., 0]
    for value in (0, 1):
        inside = cv2.erode((given == value).astype(np.uint8), np.ones((3, 3), np.uint8)) > 0
        assert inside.any()
        assert (alpha[inside] == value).all()
    assert (alpha != given).any()  # outlines are filtered


def test_tiles_without_noise_are_left_as_they_are(tmp_path, weights):
    def blank(index, layers):
        layers["ViewLayer.Combined"][:, 40:] = 0

    scene = Scene(height=40, width=320, frames=5)  # wide enough for tiles whose halo holds no edge
    shot = open_shot(scene.write(tmp_path, edit=blank))
    denoiser = open_network(weights, tile=64, precision="float32")
    aligners = [FrameStream(shot, only(STAGES | extra), first_pass=Classical(DRAFT)) for extra in (set(), {"skip"})]
    images = [denoiser(aligner.align(SCENE.first + 2)).color for aligner in aligners]
    # Lit pixels are mirrored by 32 pixels. A trunk leaves next to nothing where there is nothing: 0.002 beside an edge.
    np.testing.assert_allclose(images[1], images[0], atol=1e-6 if weights.stem == "untrained" else 5e-3)
    assert images[1][:, 100:].max() < 1e-3
    assert (images[1][:, 240:] == 0).all()  # exactly what was there


def test_contributions_sum_to_what_is_made_of_them_and_weights_to_one(folder, weights):
    window, counted = align(folder), Breakdown()
    denoised = open_network(weights, precision="float32", tile=32, breakdown=counted)(window)
    names = ["before2", "before1", "centre", "after1", "after2"]
    added = [f"{kind}.{name}" for kind in ("contribution", "weight") for name in names]
    assert list(denoised.extra) == [*added, "stage.align", "stage.gate", "stage.network"]
    parts, whole = sum(denoised.extra[f"contribution.{name}"] for name in names), denoised.color
    if weights.stem == "balanced":  # whose pictures are made of what the frames give together
        whole = window.pool().image * window.modulation
    np.testing.assert_allclose(parts, whole, rtol=1e-4, atol=1e-5)  # of mean_of's epsilon, 1e-6
    shares = np.stack([denoised.extra[f"weight.{name}"] for name in names])
    np.testing.assert_allclose(shares.sum(0), 1, rtol=1e-5)
    rows = list(counted.rows())
    assert [row[0] for row in rows] == names
    for row, share in zip(rows, shares, strict=True):
        assert [float(figure) for figure in row[1:]] == pytest.approx(
            [share.mean(), share.min(), share.max()], abs=1e-4
        )
