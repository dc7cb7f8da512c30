import os
import stat
from dataclasses import fields, replace
from pathlib import Path

import numpy as np
import pytest
import torch
from safetensors.torch import save_file
from torch.utils.data import DataLoader

from network.training.clips import (
    FIELDS,
    INPUTS,
    Clip,
    Clips,
    Samples,
    importance,
    important_places,
    noise_pairs,
    open_clips,
    split_by_shot,
    whole_frames,
    write_shards,
)
from network.training.config import SamplerConfig

#: Nothing random but the clip, the level, the target and the orientation.
PLAIN = SamplerConfig(crop=16, sets=1, fireflies=0, exposure_stops=0)
SPP = (8, 8, 2)


def make_clip(seed: int = 0, size: tuple[int, int] = (16, 16), frames: int = 3) -> Clip:
    generator = torch.Generator().manual_seed(seed)

    def uniform(*shape: int) -> torch.Tensor:
        return torch.rand(*shape, *size, generator=generator)

    return Clip(
        color=uniform(3, frames, 3) + 0.1,
        albedo=uniform(3, frames, 3),
        normal=uniform(3, frames, 3) * 2 - 1,
        estimate=uniform(3, frames, 3) + 0.1,
        residual=uniform(3, frames, 3) - 0.5,
        confidence=uniform(3, frames, 1),
        modulation=uniform(3, 3) + 0.1,
        clean_albedo=uniform(3, 3),
        clean_normal=uniform(3, 3) * 2 - 1,
        noisy=uniform(3, 3) + 0.1,
        pseudo_reference=uniform(3, 3) + 0.1,
        exposure=torch.tensor([0.5, 1.0, 2.0]),
        gain=torch.tensor([0.4, 0.2, 0.1]),
        to_next=uniform(3, 2) * 4 - 2,
        linked=torch.zeros(3),
    )


def folder_of(path: Path, shots: dict[str, int], **options: object) -> Clips:
    path.mkdir(exist_ok=True)
    for number, (shot, count) in enumerate(shots.items()):
        write_shards(path, shot, SPP, [make_clip(100 * number + i, **options) for i in range(count)])
    return open_clips(path)


# Pairs


def test_where_there_is_a_reference_it_is_the_only_target(tmp_path: Path) -> None:
    clean = torch.rand(3, 3, 16, 16) + 0.5
    write_shards(tmp_path, "clean", SPP, [replace(make_clip(), reference=clean)])
    write_shards(tmp_path, "noisy", SPP, [make_clip(1)])
    clips = open_clips(tmp_path)
    assert clips.pairs(0) == [[(0, "reference")], [(1, "reference")], [(2, "reference")]]
    assert clips.pairs(1) == noise_pairs(SPP)
    target = clips.read(0, 2, (2, "reference")).target.float()
    torch.testing.assert_close(target, clean[2] / 2, rtol=2**-10, atol=0)  # over the last level's exposure, in half
    with pytest.raises(ValueError, match="reference: expected shape"):
        replace(make_clip(), reference=clean[:2])


def test_the_error_is_that_of_the_clips_better_input(tmp_path: Path) -> None:
    clip = make_clip()
    bright = 1.1 * clip.noisy[:, None] / clip.modulation[:, None]
    write_shards(tmp_path, "a", SPP, [replace(clip, estimate=bright.expand_as(clip.estimate), reference=clip.noisy)])
    sample = Samples(open_clips(tmp_path), PLAIN, 0)[0]
    # Ten per cent too bright; relmse divides by the mean of the channels and a floor of a third of the exposure.
    assert 0.1 * 0.1**2 < float(sample.error) < 1.2 * 0.1**2


def test_targets_are_never_noisier_than_the_input_and_always_independent() -> None:
    pairs = noise_pairs((8, 8, 2))
    assert pairs[0] == [(1, "noisy"), (1, "pseudo_reference")]
    assert pairs[1] == [(0, "noisy"), (0, "pseudo_reference")]
    assert pairs[2] == [(0, "noisy"), (0, "pseudo_reference"), (1, "noisy"), (1, "pseudo_reference")]
    for samples in ((24, 8, 4), (4, 24, 8), (4, 4, 4)):
        for level, targets in enumerate(noise_pairs(samples)):
            for other, kind in targets:
                assert samples[other] >= samples[level]
                assert other != level or (kind == "pseudo_reference" and len(targets) == 1)


def test_a_level_without_an_independent_one_is_trained_towards_its_own_pseudo_reference() -> None:
    assert noise_pairs((16,)) == [[(0, "pseudo_reference")]]
    assert noise_pairs((16, 4))[0] == [(0, "pseudo_reference")]


def test_one_table_has_every_field_and_samples_have_those_that_are_inputs() -> None:
    clip = make_clip()
    assert set(FIELDS) == {field.name for field in fields(Clip)}
    assert list(INPUTS) == [name for name in FIELDS if name in INPUTS]
    assert set(FIELDS) - set(INPUTS) == {"noisy", "linked", "pseudo_reference", "reference", "rendered"}
    for name, value in clip.values().items():
        assert FIELDS[name].shape(3, 3, 16, 16) == value.shape


# Shards


def test_clips_come_back_from_their_shards(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr("network.training.clips.SHARD_BYTES", 3 * 16 * 16 * 2 * 3 * 20)  # two or three clips a shard
    clips = folder_of(tmp_path, {"hall": 5})
    assert len(list(tmp_path.glob("hall.*.safetensors"))) > 1
    assert (len(clips), clips.shots, clips.frames, clips.size) == (5, ["hall"], 3, 16)
    for index in range(5):
        clip = make_clip(index)
        values = clips.read(index, 2, (1, "noisy"))
        for name in ("albedo", "normal", "confidence", "modulation"):
            torch.testing.assert_close(
                getattr(values, name).float(), getattr(clip, name)[2], rtol=1e-3, atol=1e-4
            )  # half
        # Radiance is over the exposure of the last level, 2; the target is another level's.
        torch.testing.assert_close(values.color.float(), clip.color[2] / 2, rtol=1e-3, atol=1e-4)
        torch.testing.assert_close(values.target.float(), clip.noisy[1] / 2, rtol=1e-3, atol=1e-4)
        assert float(values.exposure) == 1
        assert float(clips.read(index, 0, (1, "noisy")).exposure) == 0.25


@pytest.mark.parametrize("scale", [1e-6, 1e6])
def test_what_is_stored_does_not_depend_on_the_units_of_the_radiance(tmp_path: Path, scale: float) -> None:
    clip = make_clip()
    names = ("color", "estimate", "noisy", "pseudo_reference", "exposure")
    scaled = replace(clip, **{name: getattr(clip, name) * scale for name in names})
    write_shards(tmp_path, "s", SPP, [scaled])
    values = open_clips(tmp_path).read(0, 2, (1, "noisy"))
    torch.testing.assert_close(values.color.float(), clip.color[2] / 2, rtol=1e-3, atol=1e-4)


def test_fireflies_beyond_a_half_are_stored_as_its_largest(tmp_path: Path) -> None:
    clip = make_clip()
    clip.color[0, 0, 0, 0, 0] = 1e9
    write_shards(tmp_path, "s", SPP, [clip])
    values = open_clips(tmp_path).read(0, 0, (1, "noisy"))
    assert float(values.color.max()) == 65504


@pytest.mark.posix
@pytest.mark.skipif(os.name == "nt", reason="Windows has no umask")
def test_clips_have_the_mode_that_the_umask_gives(tmp_path: Path) -> None:
    before = os.umask(0o027)
    try:
        [path] = write_shards(tmp_path, "s", SPP, [make_clip()])
    finally:
        os.umask(before)
    assert stat.S_IMODE(path.stat().st_mode) == 0o640


def test_of_longer_windows_the_middle_is_taken(tmp_path: Path) -> None:
    write_shards(tmp_path, "s", SPP, [make_clip(frames=5)])
    whole, middle = (open_clips(tmp_path, frames).read(0, 1, (0, "noisy")) for frames in (None, 3))
    assert open_clips(tmp_path, 3).of(["s"]).frames == 3
    for name in ("color", "albedo", "normal", "estimate", "residual", "confidence"):
        assert torch.equal(getattr(middle, name), getattr(whole, name)[1:4])
    assert torch.equal(middle.target, whole.target)
    for frames in (7, 2):
        with pytest.raises(ValueError, match=f"expected an odd number of frames up to the clips' 5, got {frames}"):
            open_clips(tmp_path, frames)


def test_clips_know_their_neighbours(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr("network.training.clips.SHARD_BYTES", 1)  # a shard each: neighbours are found across them
    clips = [replace(make_clip(i), linked=torch.full((3,), float(i < 2))) for i in range(4)]
    write_shards(tmp_path, "s", SPP, clips)
    found = open_clips(tmp_path)
    assert [found.neighbours(i) for i in range(4)] == [(0, 1), (1, 2), (1, 2), None]
    assert not bool(make_clip(size=(32, 32)).crop(0, 8, 16).linked.any())


def test_an_interrupted_shot_leaves_nothing(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr("network.training.clips.SHARD_BYTES", 1)

    def clips():  # type: ignore[no-untyped-def]
        yield make_clip()
        yield make_clip(1)
        raise KeyboardInterrupt

    with pytest.raises(KeyboardInterrupt):
        write_shards(tmp_path, "s", SPP, clips())
    assert not list(tmp_path.iterdir())


def test_clips_that_do_not_fit_are_an_error() -> None:
    clip = make_clip()
    with pytest.raises(ValueError, match=r"confidence: expected shape \(3, 3, 1, 16, 16\)"):
        replace(clip, confidence=clip.confidence[:, :2])
    with pytest.raises(ValueError, match="noisy: expected finite values"):
        replace(clip, noisy=clip.noisy * torch.inf)


def test_files_that_are_no_clips_are_an_error(tmp_path: Path) -> None:
    with pytest.raises(FileNotFoundError, match="expected what ravg make-clips writes"):
        open_clips(tmp_path)
    (path,) = write_shards(tmp_path, "s", SPP, [make_clip()])
    whole = path.read_bytes()
    path.write_bytes(whole[:50])
    with pytest.raises(ValueError, match="no safetensors file, or cut short"):
        open_clips(tmp_path)
    save_file({"color": torch.zeros(1)}, path)
    with pytest.raises(ValueError, match="expected format 'ravg-clips', got None"):
        open_clips(tmp_path)
    path.write_bytes(whole)
    write_shards(tmp_path, "t", SPP, [make_clip(frames=5)])
    with pytest.raises(ValueError, match="expected windows of 3 frames, got 5"):
        open_clips(tmp_path)


def test_sets_are_split_by_shot(tmp_path: Path) -> None:
    clips = folder_of(tmp_path, {"a": 2, "b": 3, "c": 1})
    training, validation = split_by_shot(clips, ["b"])
    assert (training.shots, len(training), validation.shots, len(validation)) == (["a", "c"], 3, ["b"], 3)
    with pytest.raises(ValueError, match=r"expected shots among \['a', 'b', 'c'\], got \['d'\]"):
        split_by_shot(clips, ["d"])
    with pytest.raises(ValueError, match="expected a shot left to train on"):
        split_by_shot(clips, ["a", "b", "c"])


# Places


def test_importance_is_noise_detail_and_motion_and_not_flat_sky() -> None:
    flat, one = torch.full((3, 8, 8), 0.5), torch.ones(3, 1, 8, 8)
    assert not bool(importance(flat, flat, flat, one).any())
    noisy, edge, moved = flat.clone(), flat.clone(), one.clone()
    noisy[:, 2, 2] = 3
    edge[:, 4:] = 1
    moved[0, 0, 6, 6] = 0
    for image, place in (
        (importance(noisy, flat, flat, one), (2, 2)),
        (importance(flat, flat, edge, one), (4, 3)),
        (importance(flat, flat, flat, moved), (6, 6)),
    ):
        assert image[place] > 0
        assert image[0, 0] == 0


def test_tiles_gather_where_it_is_important_and_lie_apart() -> None:
    image = torch.full((64, 96), 1e-4)
    image[:32, :32] = 1
    firsts = [important_places(image, 16, 1, np.random.default_rng(seed))[0] for seed in range(200)]
    inside = np.mean([y < 32 and x < 32 for y, x in firsts])
    assert 0.4 < inside < 0.8  # half by importance, all of it there; a fourteenth of the even half too
    places = important_places(image, 16, 100, np.random.default_rng(0))
    assert len(places) > 10  # all over, once the important ones are taken
    for i, (y, x) in enumerate(places):
        assert 0 <= y <= 48
        assert 0 <= x <= 80
        assert all(abs(y - v) >= 8 or abs(x - u) >= 8 for v, u in places[:i])


# Samples


def test_epochs_take_disjoint_sets_and_each_clip_once(tmp_path: Path) -> None:
    samples = Samples(folder_of(tmp_path, {"a": 7, "b": 4}), replace(PLAIN, sets=3), seed=0)
    cycle = [samples.clip_of(number) for number in range(11)]
    assert sorted(cycle) == list(range(11))
    again = [samples.clip_of(number) for number in range(11, 22)]
    assert sorted(again) == list(range(11))
    assert again != cycle
    for first, last in ((0, 4), (4, 8), (8, 11)):  # the same three sets
        assert set(cycle[first:last]) == set(again[first:last])


def test_a_sample_is_a_function_of_seed_and_number(tmp_path: Path) -> None:
    clips = folder_of(tmp_path, {"a": 5})
    one, other = Samples(clips, SamplerConfig(crop=16), 3), Samples(clips, SamplerConfig(crop=16), 3)
    one[7]  # whatever came before does not matter
    assert all(torch.equal(*pair) for pair in zip(one[4], other[4], strict=True))
    assert not torch.equal(one[4].color, Samples(clips, SamplerConfig(crop=16), 4)[4].color)


def test_samples_are_drawn_from_all_noise_levels_and_all_targets(tmp_path: Path) -> None:
    """A level is trained towards all of its pairs, about equally often; one of few samples is drawn less often."""
    clip = make_clip()
    for level in range(3):  # told apart by their modulation, and by their target
        clip.modulation[level] = level + 1
        clip.noisy[level] = 10 * (level + 1)
        clip.pseudo_reference[level] = 10 * (level + 1) + 5
    write_shards(tmp_path, "s", SPP, [clip])
    clips = open_clips(tmp_path)
    samples = Samples(clips, PLAIN, 0)
    drawn: dict[tuple[int, tuple[int, str]], int] = {}
    for number in range(900):
        sample = samples[number]
        level = round(float(sample.modulation[0, 0, 0])) - 1
        value = 2 * float(sample.target[0, 0, 0])  # over the last level's exposure, 2
        target = round(value // 10) - 1, "noisy" if value % 10 < 2.5 else "pseudo_reference"
        drawn[level, target] = drawn.get((level, target), 0) + 1
    pairs = {(level, target) for level, targets in enumerate(noise_pairs(SPP)) for target in targets}
    assert set(drawn) == pairs
    for (level, _), count in drawn.items():
        expected = (400, 400, 100)[level] / len(noise_pairs(SPP)[level])
        assert count == pytest.approx(expected, abs=4 * expected**0.5)  # four standard deviations


def test_processes_that_read_make_the_same_batches(tmp_path: Path) -> None:
    samples = Samples(folder_of(tmp_path, {"a": 3}), SamplerConfig(crop=16), 0)
    batches = [next(iter(DataLoader(samples, batch_sampler=[[0, 1, 2]], num_workers=workers))) for workers in (0, 1)]
    assert batches[0].color.shape == (3, 3, 3, 16, 16)
    assert batches[0].exposure.shape == (3,)
    assert all(torch.equal(*pair) for pair in zip(*batches, strict=True))


def test_images_of_a_sample_stay_together(tmp_path: Path) -> None:
    """A clip whose images are all one image: after any variation they still are, normals up to order and sign."""
    image = torch.rand(3, 16, 16, generator=torch.Generator().manual_seed(0)) + 0.1
    window = image.expand(1, 3, 3, 16, 16).clone()
    centre, one = window[:, 1], torch.ones(1)
    clip = Clip(*[window] * 5, window[:, :, :1], *[centre] * 4, one, one, centre[:, :2], one, pseudo_reference=centre)
    write_shards(tmp_path, "s", [4], [clip])
    samples = Samples(open_clips(tmp_path), PLAIN, 0)
    seen = set()
    for number in range(40):
        sample = samples[number]
        for name in ("albedo", "estimate", "residual"):
            torch.testing.assert_close(getattr(sample, name), sample.color)
        for name in ("modulation", "clean_albedo", "target"):
            torch.testing.assert_close(getattr(sample, name), sample.color[1])
        torch.testing.assert_close(sample.clean_normal, sample.normal[1])
        channel = [i for i in range(3) if torch.equal(sample.color[0, i], sample.confidence[0, 0])]
        assert len(channel) == 1  # turned alike, wherever the red channel has gone
        sizes = sample.normal.abs()
        assert all(any(torch.equal(sizes[:, i], sample.color[:, j]) for j in range(3)) for i in range(3))
        corner = int((sample.confidence[0, 0] == image[0, 0, 0].half().float()).nonzero()[0][0])
        seen.add((channel[0], corner))
    assert len(seen) > 4


def test_crops_of_larger_clips_are_drawn_by_importance(tmp_path: Path) -> None:
    clip = make_clip(size=(32, 48))
    for name in ("color", "albedo", "estimate", "modulation"):
        getattr(clip, name)[:] = 0.5
    clip.confidence[:] = 1
    clip.color[..., :16, :16] = 8.0
    write_shards(tmp_path, "s", SPP, [clip])
    samples = Samples(open_clips(tmp_path), PLAIN, 0)
    hits = np.mean([bool((samples[number].color * samples.config.crop > 16).any()) for number in range(300)])
    # Half by importance, all of it there, and half evenly: 4 of 15 places touch it. 0.63, standard deviation 0.03.
    assert 0.55 < hits < 0.72
    assert samples[0].color.shape == (3, 3, 16, 16)


def test_variations_do_what_they_say(tmp_path: Path) -> None:
    clips = folder_of(tmp_path, {"a": 2})
    bright = Samples(clips, replace(PLAIN, fireflies=1), 0)[0].color
    assert float(bright.max()) > 2  # without, below 1.1 / 2
    away = [float(Samples(clips, replace(PLAIN, exposure_stops=2), 0)[n].exposure) for n in range(20)]
    assert 0.25 * 0.25 <= min(away) < max(away) <= 4


def test_a_target_is_a_pseudo_reference_as_often_as_is_asked_for(tmp_path: Path) -> None:
    clip = make_clip()
    targets = {"reference": torch.full_like(clip.noisy, 4.0), "rendered": torch.full_like(clip.noisy, 8.0)}
    write_shards(tmp_path, "s", SPP, [replace(clip, pseudo_reference=None, **targets)])
    clips = open_clips(tmp_path)
    assert clips.pairs(0)[1] == [(1, "reference"), (1, "rendered")]
    for pseudo, wanted in ((1.0, 2.0), (0.0, 4.0)):  # over the last level's exposure, 2
        drawn = [Samples(clips, replace(PLAIN, pseudo=pseudo), 0)[n].target for n in range(10)]
        assert all(bool((target == wanted).all()) for target in drawn)
    drawn = [float(Samples(clips, replace(PLAIN, pseudo=0.25), 0)[n].target.mean()) for n in range(400)]
    assert np.mean([value == 2 for value in drawn]) == pytest.approx(0.25, abs=0.09)  # four standard deviations


def test_neighbours_are_varied_alike_and_their_motion_with_them(tmp_path: Path) -> None:
    """A picture that moves by (3, −2) pixels: along the turned vectors the second sample is the first."""
    scene = torch.rand(3, 64, 64, generator=torch.Generator().manual_seed(0)) + 0.1
    first, second = scene[:, 10:42, 10:42], scene[:, 12:44, 7:39]
    clips = []
    for picture in (first, second):
        image = picture.expand(1, 3, -1, -1)
        window = image[:, None].expand(1, 3, 3, -1, -1)
        confidence, one = torch.ones_like(window[:, :, :1]), torch.ones(1)
        to_next = torch.tensor([3.0, -2.0])[None, :, None, None].expand(1, 2, 32, 32)
        clips.append(
            Clip(*[window] * 5, confidence, *[image] * 4, one, one, to_next, one, pseudo_reference=image.clone())
        )
    clips[1] = replace(clips[1], linked=torch.zeros(1))
    write_shards(tmp_path, "s", [4], clips)
    samples = Samples(open_clips(tmp_path), PLAIN, 0, neighbours=True)
    ways = set()
    for number in range(30):
        sample = samples[number]
        assert sample.color.shape == (2, 3, 3, 16, 16)
        x, y = (int(value) for value in sample.to_next[0, :, 0, 0])
        here, there = sample.target
        rows, columns = (slice(max(0, -d), 16 - max(0, d)) for d in (y, x))
        moved = there[:, rows.start + y : rows.stop + y, columns.start + x : columns.stop + x]
        torch.testing.assert_close(here[:, rows, columns], moved)
        ways.add((x, y))
    assert len(ways) == 8
    # Beyond a cut there is none: such clips are left out, and where all are there is nothing to train on.
    write_shards(tmp_path, "t", [4], [replace(clips[0], linked=torch.zeros(1))])
    samples = Samples(open_clips(tmp_path), PLAIN, 0, neighbours=True)
    assert {samples.clip_of(number) for number in range(20)} == {0, 1}
    with pytest.raises(ValueError, match="expected neighbouring frames, as whole frames have"):
        Samples(open_clips(tmp_path).of(["t"]), PLAIN, 0, neighbours=True)


def test_clips_that_cannot_be_sampled_are_an_error(tmp_path: Path) -> None:
    clips = folder_of(tmp_path, {"a": 1})
    with pytest.raises(ValueError, match="expected at least 17 pixels each way, got 16"):
        Samples(clips, replace(PLAIN, crop=17), 0)


def test_whole_frames_are_every_level_towards_the_cleanest(tmp_path: Path) -> None:
    clips = folder_of(tmp_path, {"a": 1}, size=(18, 21))
    batches = whole_frames(clips, 0, 4)
    assert len(batches) == 3
    for level, batch in enumerate(batches):
        assert batch.color.shape == (1, 3, 3, 16, 20)
        assert batch.confidence.shape == (1, 3, 1, 16, 20)
        assert batch.target.shape == (1, 3, 16, 20)
        assert batch.exposure.shape == (1,)
        target = make_clip(size=(18, 21)).noisy[1 if level == 0 else 0, :, :16, :20] / 2
        torch.testing.assert_close(batch.target[0], target, rtol=1e-3, atol=1e-4)
