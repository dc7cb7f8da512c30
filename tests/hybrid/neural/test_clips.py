"""Training clips: what they hold is what the network is given, and what it should say."""

import numpy as np
import pytest
import torch

from hybrid.denoising import first_pass, pseudo_reference
from hybrid.denoising.first_pass import Classical, find_first_pass
from hybrid.denoising.plan import Rules
from hybrid.denoising.pseudo_reference import FINAL, gated_average, pool_and_denoise
from hybrid.denoising.stream import FrameStream
from hybrid.files.shots import open_shot
from hybrid.neural import clips as module
from hybrid.neural import open_network, unet_denoiser
from hybrid.neural.clips import ClipSource, write_clips
from network.checkpoint import save_model
from network.presets import build_preset
from network.robust_average import RobustAverage
from network.training.clips import Clip, Sample, open_clips
from network.training.loop import centre_of
from tests.scenes import Scene

SCENE = Scene(height=70, width=90, frames=5)
MIDDLE = SCENE.first + 2


def bright_window(index, layers):
    """A dim room: a twentieth of the picture is 300 times as bright as the rest."""
    layers["ViewLayer.Combined"][10:25, 20:41] *= 300


@pytest.fixture
def dim(tmp_path):
    """A shot whose brightness one measures one way or another: five times as much, or as little."""
    return open_shot(SCENE.write(tmp_path / "dim", edit=bright_window))


def prepare(shot, monkeypatch, tmp_path, **options) -> list[Clip]:
    """Clips of a shot, before they are packed into files."""
    found: list[Clip] = []
    monkeypatch.setattr(module, "write_shards", lambda folder, name, samples, clips: found.extend(clips) or [])
    write_clips(ClipSource("dim", {"noisy": shot}, [4], **options), tmp_path, tile=0, estimate="nlm")
    return found


@pytest.fixture(scope="module")
def middle(tmp_path_factory):
    """The clip of the middle frame, and the window that it is made of."""
    folder = tmp_path_factory.mktemp("dim")
    shot = open_shot(SCENE.write(folder / "dim", edit=bright_window), frames=str(MIDDLE))
    with pytest.MonkeyPatch.context() as patch:
        (clip,) = prepare(shot, patch, folder)
    return clip, FrameStream(shot, Rules(), first_pass=Classical(FINAL)).align(MIDDLE)


def test_a_clip_holds_what_the_network_is_given_when_it_runs(middle, tmp_path, monkeypatch):
    """The exposure too, which used to be measured in two ways."""
    clip, window = middle
    given = {}

    def spy(block, window):
        given.update(window._asdict())
        raise StopIteration

    monkeypatch.setattr(RobustAverage, "is_prior", False)
    monkeypatch.setattr(RobustAverage, "forward", spy)
    save_model(tmp_path / "w.safetensors", build_preset("balanced"))
    with pytest.raises(StopIteration):
        open_network(tmp_path / "w.safetensors", precision="float32")(window)
    given |= {
        name: torch.from_numpy(window.centre.guides[name]).permute(2, 0, 1)[None] for name in ("albedo", "normal")
    }
    for name, value in given.items():
        wanted = getattr(clip, "estimate" if name == "first_pass" else name)
        if name in ("albedo", "normal"):
            wanted = centre_of(wanted)
        np.testing.assert_array_equal(value, wanted, err_msg=name)


def test_frames_that_are_not_trusted_show_the_centre(middle):
    """In proportion to the confidence, color and guides alike."""
    clip, window = middle
    color, confidence = window.color, window.confidence[..., None]
    expected = confidence * color + (1 - confidence) * color[2]
    assert np.abs(expected - color).max() > 0.1 * color.mean()  # some are not trusted
    np.testing.assert_allclose(clip.color[0].permute(0, 2, 3, 1).numpy(), expected, rtol=1e-4, atol=1e-5)
    for name in ("albedo", "normal"):
        guide = getattr(window, name)
        expected = confidence * guide + (1 - confidence) * guide[2]
        np.testing.assert_allclose(getattr(clip, name)[0].permute(0, 2, 3, 1).numpy(), expected, rtol=1e-4, atol=1e-5)


def test_the_pseudo_reference_is_the_gated_average_and_no_noisy_frame(middle):
    clip, window = middle
    image = clip.pseudo_reference[0].permute(1, 2, 0).numpy()
    np.testing.assert_array_equal(image, gated_average(window))
    layers = SCENE.clean(2)
    bright_window(2, layers)
    truth, noisy = layers["ViewLayer.Combined"], clip.noisy[0].permute(1, 2, 0).numpy()
    assert np.median(np.abs(image - truth) / truth) < 0.5 * np.median(np.abs(noisy - truth) / truth)


def test_the_bundled_network_makes_first_passes(dim, tmp_path):
    shot = open_shot(tmp_path / "dim", frames=str(MIDDLE))
    assert write_clips(ClipSource("dim", {"noisy": shot}, [4]), tmp_path, tile=0, estimate="bundled")


def test_beside_estimates_by_oidn_the_pseudo_reference_is_gathered(dim, tmp_path, monkeypatch):
    found: list[Clip] = []
    monkeypatch.setattr(module, "write_shards", lambda folder, name, samples, clips: found.extend(clips) or [])
    monkeypatch.setattr(first_pass, "why_no_oidn", lambda: None)
    monkeypatch.setattr(first_pass, "denoise_oidn", lambda color, *_, **__: 0.5 * color)
    monkeypatch.setattr(pseudo_reference, "denoise_oidn", lambda color, *_, **__: 0.25 * color)
    shot = open_shot(tmp_path / "dim", frames=str(MIDDLE))
    write_clips(ClipSource("dim", {"noisy": shot}, [4]), tmp_path, tile=0, estimate="oidn-fast")
    window = FrameStream(shot, Rules(), first_pass=find_first_pass("oidn-fast", shot).first_pass).align(MIDDLE)
    image = found[0].pseudo_reference[0].permute(1, 2, 0).numpy()
    np.testing.assert_array_equal(image, pool_and_denoise(window))
    assert np.abs(image - gated_average(window)).max() > 0.01 * image.mean()


def test_clips_hold_what_the_network_is_given_and_what_it_should_say(tmp_path):
    noisy = open_shot(SCENE.write(tmp_path / "noisy"))
    clean = open_shot(SCENE.write(tmp_path / "clean", clean=True))
    frames = []
    levels = {"noisy": noisy, "clean": clean}
    source = ClipSource("wall", levels, [4, 64])
    write_clips(source, tmp_path, tile=0, estimate="nlm", advance=lambda: frames.append(1))
    clips = open_clips(tmp_path)
    assert len(clips) == len(frames) == SCENE.frames
    assert clips.shots == ["wall"]
    assert clips.pairs(2) == [[(1, "noisy"), (1, "pseudo_reference")], [(1, "pseudo_reference")]]
    values = Sample(*(value.float().numpy() for value in clips.read(2, 0, (1, "noisy"))))
    truth = SCENE.clean(2)["ViewLayer.Combined"].transpose(2, 0, 1)
    unit = truth.mean() / values.target.mean()  # radiance is stored over the exposure of the cleanest level
    np.testing.assert_allclose(values.target * unit, truth, rtol=2e-3)  # half has 11 bits
    # The division by the albedo and the multiplication by the modulation are inverse where guides have no noise.
    radiance = values.color[2] * values.modulation * unit
    np.testing.assert_allclose(radiance, SCENE.noisy(2)["ViewLayer.Combined"].transpose(2, 0, 1), rtol=1e-2)


def test_a_clip_holds_the_guides_without_noise_that_a_network_is_given_when_it_runs(dim, tmp_path, monkeypatch):
    assert module.clean_guides is unet_denoiser.clean_guides
    monkeypatch.setattr(module, "clean_guides", lambda aligned: {"albedo": np.full_like(aligned.color[0], 0.25)})
    (clip,) = prepare(open_shot(tmp_path / "dim", frames=str(MIDDLE)), monkeypatch, tmp_path)
    assert bool((clip.clean_albedo == 0.25).all())
    assert not bool(clip.clean_normal.any())  # as where there are none


def test_levels_are_trained_towards_the_pseudo_reference_of_another_render(dim, tmp_path, monkeypatch):
    only = str(MIDDLE)
    other = SCENE.write(tmp_path / "other", clean=True, edit=bright_window)
    shot, target = open_shot(tmp_path / "dim", frames=only), open_shot(other, frames=only)
    (clip,) = prepare(shot, monkeypatch, tmp_path, target=target)
    window = FrameStream(open_shot(other, frames=only), Rules(), first_pass=Classical(FINAL)).align(MIDDLE)
    assert clip.pseudo_reference is None
    assert len(clip.reference) == len(clip.noisy) == 1
    np.testing.assert_array_equal(clip.reference[0].permute(1, 2, 0).numpy(), gated_average(window))
    np.testing.assert_array_equal(clip.rendered[0].permute(1, 2, 0).numpy(), target.read(MIDDLE).color)


def test_targets_are_half_the_teachers_and_as_bright_as_the_cleanest_render(tmp_path, monkeypatch):
    """A teacher sees the window of each level; where targets are too dark, the render of most samples says so."""
    only = str(MIDDLE)
    noisy, clean = (open_shot(SCENE.write(tmp_path / n, clean=n == "clean"), frames=only) for n in ("noisy", "clean"))
    truth = clean.read(MIDDLE).color
    seen = []

    def dark_teacher(aligned):
        seen.append(aligned.color[2])
        return np.float32(0.5) * truth

    found: list[Clip] = []
    monkeypatch.setattr(module, "write_shards", lambda folder, name, samples, clips: found.extend(clips) or [])
    source = ClipSource("wall", {"noisy": noisy, "clean": clean}, [4, 64], reference=clean)
    write_clips(source, tmp_path, tile=0, estimate="nlm", teacher=dark_teacher)
    assert len(seen) == 2
    assert np.abs(seen[0] - seen[1]).max() > 0.1
    assert found[0].pseudo_reference is None
    for target in found[0].reference:  # three quarters of the truth before its means are restored
        np.testing.assert_allclose(target.permute(1, 2, 0).numpy(), truth, rtol=5e-3)
    with pytest.raises(ValueError, match="teacher: expected references beside it, got none of wall"):
        write_clips(ClipSource("wall", {"noisy": noisy}, [4]), tmp_path, tile=0, estimate="nlm", teacher=dark_teacher)


def test_restored_means_keep_black_black_and_mind_no_firefly():
    image = np.zeros((60, 80, 3), np.float32)
    image[:, 40:] = 1
    render = 1.25 * image
    np.testing.assert_allclose(module._with_means(image, render), render, rtol=0.02)
    render[30, 60] = 1e6
    with_firefly = module._with_means(image, render)
    assert not with_firefly[:, :40].any()
    assert with_firefly.max() < 1.5
    for scale in (1e-4, 1e4):
        np.testing.assert_allclose(module._with_means(scale * image, scale * render), scale * with_firefly, rtol=1e-3)


def test_clips_of_whole_frames_know_the_way_to_the_next(tmp_path, monkeypatch):
    shot = open_shot(SCENE.write(tmp_path / "noisy"))
    found = prepare(shot, monkeypatch, tmp_path)
    assert [float(clip.linked) for clip in found] == [1, 1, 1, 1, 0]
    aligner = FrameStream(shot, Rules(), first_pass=Classical(FINAL))
    aligner.align(MIDDLE)
    flow, valid = aligner.flow(MIDDLE, MIDDLE + 1)
    np.testing.assert_array_equal(found[2].to_next[0].permute(1, 2, 0).numpy(), flow * valid[..., None])
    assert float(np.abs(flow[valid]).max()) > 0.5
    assert not bool(found[4].to_next.any())


def test_tiles_are_cut_from_the_frames_and_keep_their_exposure(tmp_path):
    shot = open_shot(SCENE.write(tmp_path / "noisy"), frames=str(SCENE.first + 2))
    (tmp_path / "clips").mkdir()
    write_clips(ClipSource("whole", {"noisy": shot}, [4]), tmp_path / "clips", tile=0, estimate="nlm")
    write_clips(ClipSource("tiles", {"noisy": shot}, [4]), tmp_path / "clips", tile=32, tiles=3, estimate="nlm")
    clips = open_clips(tmp_path / "clips")
    whole = clips.of(["whole"]).read(0, 0, (0, "pseudo_reference"))
    tiles = clips.of(["tiles"])
    assert len(tiles) == 3
    for index in range(3):
        tile = tiles.read(index, 0, (0, "pseudo_reference"))
        assert tile.color.shape == (5, 3, 32, 32)
        assert float(tile.exposure) == float(whole.exposure)
        windows = whole.color[2].unfold(1, 32, 1).unfold(2, 32, 1).permute(1, 2, 0, 3, 4)
        assert bool((windows == tile.color[2]).all(-1).all(-1).all(-1).any())  # it is one of them
    with pytest.raises(ValueError, match="tile: expected at most the frame's 90×70 pixels, got 80"):
        write_clips(ClipSource("large", {"noisy": shot}, [4]), tmp_path, tile=80, estimate="nlm")
