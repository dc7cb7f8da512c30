"""Training clips on disk, and the batches drawn from them."""

# ruff: noqa: E402 - nothing of network can be imported before it is known that torch is there

from __future__ import annotations

from dataclasses import replace
from pathlib import Path

import numpy as np
import pytest

torch = pytest.importorskip("torch")

from network.clips import Clip, Sampler, SamplerConfig, load_clips, split_by_shot, whole_frame

pytestmark = pytest.mark.neural

PLAIN = SamplerConfig(crop=16, drop_estimate=0, drop_frames=0, fireflies=0, exposure_stops=0)


def make_clip(height: int = 24, width: int = 32, frames: int = 3, shot: str = "a", seed: int = 0) -> Clip:
    rng = np.random.default_rng(seed)
    window = (frames, height, width, 3)
    return Clip(
        color=rng.gamma(2, 0.5, window).astype(np.float32),
        albedo=rng.uniform(0, 1, window).astype(np.float32),
        normal=rng.uniform(-1, 1, window).astype(np.float32),
        confidence=rng.uniform(0, 1, window[:3]).astype(np.float32),
        modulation=rng.uniform(0.1, 1, window[1:]).astype(np.float32),
        estimate=rng.uniform(0, 2, window).astype(np.float32),
        target=rng.uniform(0, 2, window[1:]).astype(np.float32),
        target_kind="noisy",
        shot=shot,
    )


ARRAYS = ("color", "albedo", "normal", "confidence", "modulation", "estimate", "target")


def test_a_clip_comes_back_in_half_precision(tmp_path: Path) -> None:
    clip = make_clip()
    clip.color[0, 0, 0, 0] = 1e6
    clip.save(tmp_path / "clip.npz")
    loaded = Clip.load(tmp_path / "clip.npz")
    for name in ARRAYS:
        expected = np.clip(getattr(clip, name), None, 65504)
        assert getattr(loaded, name).dtype == np.float16
        np.testing.assert_allclose(getattr(loaded, name), expected, rtol=2**-11, atol=2**-25)  # half an ulp
    assert (loaded.target_kind, loaded.shot) == ("noisy", "a")
    assert [path.name for path in tmp_path.iterdir()] == ["clip.npz"]


def test_a_file_that_is_missing_cut_short_or_no_clip_is_an_error(tmp_path: Path) -> None:
    with pytest.raises(FileNotFoundError, match=r"clip: no file .*none\.npz"):
        Clip.load(tmp_path / "none.npz")
    make_clip().save(tmp_path / "clip.npz")
    whole = (tmp_path / "clip.npz").read_bytes()
    for length in (0, 3, 1000, len(whole) - 10):
        (tmp_path / "cut.npz").write_bytes(whole[:length])
        with pytest.raises(ValueError, match="no clip, or cut short"):
            Clip.load(tmp_path / "cut.npz")
    np.savez(tmp_path / "other.npz", a=np.zeros(3))
    with pytest.raises(ValueError, match="no clip, or cut short"):
        Clip.load(tmp_path / "other.npz")
    np.savez(tmp_path / "pickle.npz", **{name: np.array([{}]) for name in (*ARRAYS, "target_kind", "shot")})
    with pytest.raises(ValueError, match="no clip, or cut short"):
        Clip.load(tmp_path / "pickle.npz")


@pytest.mark.parametrize("name", ARRAYS)
def test_a_clip_checks_its_arrays(name: str) -> None:
    clip = make_clip()
    with pytest.raises(ValueError, match=f"{name}: expected shape"):
        replace(clip, **{name: getattr(clip, name)[..., 1:, :1]})
    broken = getattr(clip, name).copy()
    broken.flat[5] = np.nan
    with pytest.raises(ValueError, match=f"{name}: expected finite"):
        replace(clip, **{name: broken})


def test_clips_of_a_folder_come_in_order(tmp_path: Path) -> None:
    with pytest.raises(FileNotFoundError, match=r"clips: no \*\.npz"):
        load_clips(tmp_path)
    for shot in ("b", "a"):
        make_clip(shot=shot).save(tmp_path / f"{shot}.npz")
    assert [clip.shot for clip in load_clips(tmp_path)] == ["a", "b"]


def test_no_shot_is_on_both_sides_of_the_split() -> None:
    clips = [make_clip(shot=shot, seed=i) for i, shot in enumerate("aabbc")]
    training, validation = split_by_shot(clips, ["b"])
    assert [clip.shot for clip in training] == ["a", "a", "c"]
    assert [clip.shot for clip in validation] == ["b", "b"]
    with pytest.raises(ValueError, match=r"validation: expected shots among \['a', 'b', 'c'\], got \['d'\]"):
        split_by_shot(clips, ["d"])
    with pytest.raises(ValueError, match="validation: expected a shot left"):
        split_by_shot(clips, ["a", "b", "c"])


def test_a_batch_has_the_networks_layout() -> None:
    batch = Sampler([make_clip()], PLAIN, 0).batch(2)
    assert {name: tuple(value.shape) for name, value in batch.items()} == {
        "color": (2, 3, 3, 16, 16),
        "albedo": (2, 3, 3, 16, 16),
        "normal": (2, 3, 3, 16, 16),
        "confidence": (2, 3, 1, 16, 16),
        "modulation": (2, 3, 16, 16),
        "target": (2, 3, 16, 16),
        "estimate": (2, 3, 3, 16, 16),
        "present": (2,),
        "exposure": (2,),
    }
    assert {value.dtype for value in batch.values()} == {torch.float32}


def test_the_same_seed_draws_the_same_batches() -> None:
    clips = [make_clip(shot="a"), make_clip(shot="b", seed=1)]
    config = SamplerConfig(crop=16, drop_estimate=0.5, drop_frames=0.5, fireflies=0.5)
    first, second, other = (Sampler(clips, config, seed) for seed in (1, 1, 2))
    for _ in range(3):
        a, b, c = first.batch(2), second.batch(2), other.batch(2)
        assert all(torch.equal(a[name], b[name]) for name in a)
        assert not torch.equal(a["color"], c["color"])


def test_layers_stay_registered_through_all_variations() -> None:
    """One picture in all layers: flips, transposition and channel permutation must move them alike."""
    base = np.random.default_rng(0).uniform(0.1, 1, (24, 32, 3)).astype(np.float32)
    window = np.repeat(base[None], 3, 0)
    clip = Clip(window, window, window, window[..., 0], base, window, base, "noisy", "a")
    sampler = Sampler([clip], PLAIN, 0)
    seen = set()
    for _ in range(40):
        batch = {name: value[0] for name, value in sampler.batch(1).items()}
        for name in ("albedo", "estimate"):
            assert torch.equal(batch[name][0], batch["color"][0])
        for name in ("modulation", "target"):
            assert torch.equal(batch[name], batch["color"][0])
        # The confidence is the first channel's picture; the permutation moved that channel somewhere.
        assert sum(torch.equal(batch["confidence"][0, 0], batch["color"][0, c]) for c in range(3)) == 1
        # The normal is a signed permutation of the same channels.
        magnitudes = sorted(batch["normal"][0, :, 0, 0].abs().tolist())
        assert magnitudes == sorted(batch["color"][0, :, 0, 0].tolist())
        seen.add((batch["color"][0, 0, 0, 0].item(), batch["normal"][0, 0, 0, 0].item()))
    assert len(seen) > 30  # corners, orientations, channels and signs do vary


def test_crops_are_crops_of_the_clip() -> None:
    """Undo the orientations: each crop is found in the clip, at one of its corners."""
    clip = make_clip()
    batch = Sampler([clip], PLAIN, 3).batch(1)
    crop = batch["confidence"][0, :, 0].numpy()
    found = 0
    for candidate in (crop, crop.transpose(0, 2, 1)):
        for flipped in (candidate, candidate[:, ::-1], candidate[:, :, ::-1], candidate[:, ::-1, ::-1]):
            for y in range(9):
                for x in range(17):
                    found += np.array_equal(flipped, clip.confidence[:, y : y + 16, x : x + 16])
    assert found == 1


def test_important_places_come_up_more_often_and_no_place_never() -> None:
    clip = make_clip(16, 64)
    flat = replace(
        clip,
        color=np.ones_like(clip.color),
        albedo=np.ones_like(clip.albedo),
        estimate=np.ones_like(clip.estimate),
        modulation=np.ones_like(clip.modulation),
        target=np.ones_like(clip.target),
        confidence=np.broadcast_to(np.linspace(0, 1, 64, dtype=np.float32), (3, 16, 64)),  # tells where a crop is
    )
    flat.color[1, :, 48:] = 3  # far from its target on the right
    sampler = Sampler([flat], PLAIN, 0)
    places = np.array([float(sampler.batch(1)["confidence"].mean()) for _ in range(300)])
    left, right = np.mean(places < 0.3), np.mean(places > 0.7)
    assert right > 2 * left > 0


def test_shots_come_up_evenly_however_many_clips_they_have() -> None:
    clips = [make_clip(shot="a", seed=i) for i in range(9)] + [
        replace(make_clip(shot="b"), confidence=np.ones((3, 24, 32)))
    ]
    sampler = Sampler(clips, PLAIN, 0)
    share = np.mean([bool((sampler.batch(1)["confidence"] == 1).all()) for _ in range(200)])
    assert 0.38 < share < 0.62  # half; 0.035 is the standard deviation


def test_estimates_are_dropped_as_often_as_asked() -> None:
    sampler = Sampler([make_clip()], replace(PLAIN, drop_estimate=0.25), 0)
    present = np.array([float(sampler.batch(1)["present"]) for _ in range(300)])
    assert set(present) == {0, 1}
    assert 0.65 < present.mean() < 0.85  # 0.75; 0.025 is the standard deviation


def test_a_dropped_frame_is_the_centre_without_confidence() -> None:
    sampler = Sampler([make_clip(frames=5)], replace(PLAIN, drop_frames=1), 0)
    dropped = kept = 0
    for _ in range(20):
        batch = {name: value[0] for name, value in sampler.batch(1).items()}
        assert bool((batch["confidence"][2] > 0).any())
        for frame in (0, 1, 3, 4):
            if bool((batch["confidence"][frame] == 0).all()):
                dropped += 1
                for name in ("color", "albedo", "normal", "estimate"):
                    assert torch.equal(batch[name][frame], batch[name][2])
            else:
                kept += 1
    assert dropped > 10
    assert kept > 10


def test_fireflies_are_few_bright_and_only_in_the_input() -> None:
    clip = make_clip()
    sampler = Sampler([clip], replace(PLAIN, fireflies=1), 0)
    for _ in range(10):
        batch = sampler.batch(1)
        bright = batch["color"] > clip.color.max() + 5
        assert 1 <= int(bright.any(2).sum()) <= 8
        assert float(batch["target"].max()) <= clip.target.max()
        assert int(bright.flatten(2).any(2).sum()) == 1  # all in one frame


def test_the_exposure_is_the_clips_up_to_the_variation() -> None:
    clip = make_clip()
    plain = Sampler([clip], PLAIN, 0).batch(8)["exposure"]
    expected = whole_frame(clip, 1)["exposure"]
    torch.testing.assert_close(plain, expected.expand(8))  # of the whole window, not of the crop
    varied = torch.log2(Sampler([clip], replace(PLAIN, exposure_stops=1), 0).batch(50)["exposure"] / expected)
    assert -1 <= float(varied.min()) < -0.5
    assert 0.5 < float(varied.max()) <= 1


def test_a_whole_frame_is_cut_to_the_multiple() -> None:
    clip = make_clip(22, 31)
    batch = whole_frame(clip, 4)
    assert batch["color"].shape == (1, 3, 3, 20, 28)
    np.testing.assert_array_equal(batch["target"][0].permute(1, 2, 0).numpy(), clip.target[:20, :28])
    np.testing.assert_array_equal(batch["color"][0].permute(0, 2, 3, 1).numpy(), clip.color[:, :20, :28])
    np.testing.assert_array_equal(batch["estimate"][0].permute(0, 2, 3, 1).numpy(), clip.estimate[:, :20, :28])
    np.testing.assert_array_equal(batch["confidence"][0, :, 0].numpy(), clip.confidence[:, :20, :28])


def test_clips_that_cannot_be_sampled_are_an_error() -> None:
    with pytest.raises(ValueError, match="clips: expected at least one"):
        Sampler([], PLAIN, 0)
    with pytest.raises(ValueError, match="clips: expected 3 frames of at least 16 pixels"):
        Sampler([make_clip(), make_clip(12, 32)], PLAIN, 0)
    with pytest.raises(ValueError, match="clips: expected 3 frames"):
        Sampler([make_clip(), make_clip(frames=5)], PLAIN, 0)
    with pytest.raises(ValueError, match="crop: expected a positive"):
        SamplerConfig(crop=0)
    with pytest.raises(ValueError, match="drop_estimate: expected a probability"):
        SamplerConfig(drop_estimate=1.5)
