"""Windows on their way to the final stage: guides, and frames without light."""

from dataclasses import replace

import cv2
import numpy as np
import pytest

from hybrid.alignment.window import WarpSources
from hybrid.denoising.first_pass import Classical, PerFrame
from hybrid.denoising.plan import Rules
from hybrid.denoising.pseudo_reference import DRAFT, gated_average
from hybrid.denoising.stabilize import Denoised, FrameDenoiser, WindowDenoiser
from hybrid.denoising.stream import FrameStream
from hybrid.files.shots import open_shot
from hybrid.neural import open_network, unet_denoiser
from hybrid.neural.unet_denoiser import clean_guides
from network.checkpoint import shipped_weights
from network.robust_unet import RobustUNet
from tests.scenes import Scene, denoise_view, only

SCENE = Scene(height=40, width=48, frames=5)


def align(folder, *stages):
    return FrameStream(open_shot(folder), only({"warp", *stages}), first_pass=Classical(DRAFT)).align(SCENE.first + 2)


def test_a_black_frame_stays_black(tmp_path, monkeypatch):
    """No network runs on it: there is no exposure to run it at."""

    def darken(index, layers):
        layers["ViewLayer.Combined"][:] = 0

    window = align(SCENE.write(tmp_path, edit=darken))
    monkeypatch.setattr(RobustUNet, "denoise", None)
    assert not open_network(shipped_weights("balanced"))(window).color.any()


def test_guides_are_cleaned_where_they_have_noise(tmp_path, monkeypatch):
    folder = SCENE.write(tmp_path)
    plain = align(folder)
    assert clean_guides(plain) is plain.centre.guides
    noisy = align(folder, "prefilter")
    monkeypatch.setattr(unet_denoiser, "has_oidn_networks", lambda: False)
    ours = clean_guides(noisy)
    np.testing.assert_array_equal(np.concatenate(list(ours.values()), axis=-1), noisy.guide)
    filtered = {name: -guide for name, guide in noisy.centre.guides.items()}
    assert clean_guides(replace(noisy, centre=replace(noisy.centre, filtered_guides=filtered))) is filtered


def test_only_a_network_that_relies_on_clean_guides_has_them_filtered(monkeypatch):
    for has, preset, filters in ((True, "quality", True), (False, "quality", False), (True, "balanced", False)):
        monkeypatch.setattr(unet_denoiser, "has_oidn_networks", lambda has=has: has)
        found = open_network(shipped_weights(preset)).filter_guides
        assert found is (unet_denoiser.prefilter_guides if filters else None)


def test_a_shot_of_few_samples_is_denoised_with_filtered_guides(tmp_path):
    """From the denoiser to the network: the pipeline gives its stream the filter."""
    asked = []

    class Denoiser(WindowDenoiser):
        def filter_guides(self, guides):
            asked.append(guides)
            return guides

        def __call__(self, aligned):
            assert (aligned.centre.filtered_guides is not None) == ("clean-guides" in aligned.stages)
            return Denoised(aligned.centre.irradiance * aligned.modulation)

    for stages in ({"warp"}, {"warp", "clean-guides"}):
        shot = open_shot(SCENE.write(tmp_path / "in"))
        made = list(denoise_view(shot, tmp_path / str(len(stages)), Denoiser(), only(stages), Classical(DRAFT)))
        assert len(made) == SCENE.frames
        assert len(asked) == SCENE.frames * ("clean-guides" in stages)


def test_an_average_has_no_noisy_guides_filtered_but_for_aovs(tmp_path):
    """From the denoiser to the plan: `fast` took 1.08 times the CPU time for an albedo that cancels in its average."""
    for reads, aovs, expected in ((False, (), False), (False, ("ViewLayer.Env",), True), (True, (), True)):

        class Denoiser(WindowDenoiser):
            reads_guides, filtered = reads, expected

            def __call__(self, aligned):
                assert ("prefilter" in aligned.stages) == self.filtered
                return Denoised(aligned.centre.irradiance * aligned.modulation)

        def blur(index, layers):
            noise = np.random.default_rng(index).normal(0, 0.1, layers["ViewLayer.Denoising Albedo"].shape)
            layers["ViewLayer.Denoising Albedo"] += noise.astype(np.float32)
            layers["ViewLayer.Env"] = 0.1 * layers["ViewLayer.Combined"]

        shot = open_shot(SCENE.write(tmp_path / "in", edit=blur), aovs=aovs)
        out = tmp_path / f"{reads} {len(aovs)}"
        made = list(denoise_view(shot, out, Denoiser(), Rules(), Classical(DRAFT)))
        assert len(made) == SCENE.frames


@pytest.mark.parametrize("preset", ["fast", "balanced", "quality"])
def test_over_noise_that_stands_still_first_passes_are_averaged_and_no_samples_used(preset, tmp_path):
    """The noise of one seed, warped and pooled, passed for detail: a slow pan lost 2 to 12 dB of given frames."""
    truth = {SCENE.first + index: SCENE.clean(index)["ViewLayer.Combined"] for index in range(SCENE.frames)}
    shot = open_shot(SCENE.write(tmp_path))
    for stages, neighbours in (({"warp", "blend-samples"}, True), ({"warp", "blend-samples", "fixed-noise"}, False)):
        stream = FrameStream(shot, only(stages), PerFrame(lambda frame: 1.1 * truth[frame.number]))
        window = stream.align(SCENE.first + 2)
        assert window.neighbours.samples.trust.any() == neighbours
        assert window.confidence[:2].any()
        made = open_network(shipped_weights(preset), precision="float32")(window).color
        if not neighbours:
            np.testing.assert_allclose(made, gated_average(window), rtol=1e-5)


def test_a_slow_pan_with_one_seed_is_no_worse_than_given_frames(tmp_path):
    """The frames share half of their noise at equal pixels, and no value."""
    pan, given, truth = replace(SCENE, height=96, width=128, step=(1, 0)), {}, {}

    def one_seed(index, layers):
        common, own = (np.random.default_rng(seed).normal(size=(96, 128, 1)) for seed in (5, 6 + index))
        noise = np.float32(0.35 * (common + own))
        clean = truth[pan.first + index] = pan.clean(index)["ViewLayer.Combined"]
        layers["ViewLayer.Combined"] = clean * np.maximum(1 + noise, 0)
        given[pan.first + index] = clean * (1 + cv2.GaussianBlur(noise, (0, 0), 2)[..., None])

    shot = open_shot(pan.write(tmp_path / "in", edit=one_seed))
    for preset in ("fast", "balanced"):
        denoiser = open_network(shipped_weights(preset), precision="float32")
        first_pass = PerFrame(lambda frame: given[frame.number])
        for frame in denoise_view(shot, tmp_path / preset, denoiser, Rules(), first_pass):
            assert "fixed-noise" in frame.plan.stages
            made, clean = open_shot(frame.path).read(frame.number).color, truth[frame.number]
            assert np.square(made - clean).mean() < np.square(given[frame.number] - clean).mean()


def test_only_a_network_without_a_unet_reads_no_guides():
    assert [open_network(shipped_weights(name)).reads_guides for name in ("fast", "balanced")] == [False, True]


@pytest.mark.parametrize("preset", ["balanced", "quality"])
def test_only_a_network_that_relies_on_clean_guides_gets_them(preset, tmp_path, monkeypatch):
    folder = SCENE.write(tmp_path)
    denoiser = open_network(shipped_weights(preset), precision="float32")
    seen = []
    monkeypatch.setattr(unet_denoiser, "clean_guides", lambda aligned: seen.append(aligned) or aligned.centre.guides)
    aligner = FrameStream(open_shot(folder), only({"warp"}), radius=denoiser.radius, first_pass=Classical(DRAFT))
    denoiser(aligner.align(SCENE.first + 2))
    assert bool(seen) == (preset == "quality")


def test_a_window_is_guided_where_the_network_reads_its_guide(monkeypatch):
    """Its confidence by geometry and its clean albedo took eight planes that no other network reads."""
    for has, preset, guided in ((True, "quality", False), (False, "quality", True), (False, "balanced", False)):
        monkeypatch.setattr(unet_denoiser, "has_oidn_networks", lambda has=has: has)
        assert open_network(shipped_weights(preset)).guided == guided


def test_without_a_network_the_image_is_the_average_of_first_passes(tmp_path):
    window = align(SCENE.write(tmp_path))
    denoised = open_network(shipped_weights("fast"))(window)
    np.testing.assert_allclose(denoised.color, gated_average(window), rtol=1e-6)


def test_residuals_are_made_once_for_the_samples_and_once_for_the_network(tmp_path, monkeypatch):
    """The range that the result is clamped to is found with the former."""
    made, residual = [], WarpSources.residual

    def count(sources, *part, limited=False):
        made.append(limited)
        return residual(sources, *part, limited=limited)

    monkeypatch.setattr(WarpSources, "residual", count)
    stream = FrameStream(open_shot(SCENE.write(tmp_path)), only({"warp", "blend-samples"}), first_pass=Classical(DRAFT))
    FrameDenoiser(stream, open_network(shipped_weights("balanced"))).make(SCENE.first + 2)
    assert sorted(made) == [False, True]
