import math
import os
import signal
from collections.abc import Callable
from dataclasses import replace
from itertools import pairwise
from pathlib import Path

import numpy as np
import pytest
import torch

import network.training.loop
from network.checkpoint import load_model
from network.presets import Model
from network.robust_average import UNetWindow
from network.robust_unet import RobustUNet, RobustUNetConfig, UNetOutput
from network.training import losses
from network.training.clips import Clip, Clips, Sample, Samples, open_clips, split_by_shot, whole_frames, write_shards
from network.training.config import LOSSES, TERMS, SamplerConfig, TrainConfig
from network.training.loop import batch_loss, image_loss, predict, train, validate
from network.training.perceptual import VGG19, Perceptual
from tests.network.small import MODELS, make_model, make_robust, notes_of
from tests.seldom import seldom


def make_clip(seed: int, clean_target: bool = False, size: int = 40, sharp: bool = False) -> Clip:
    """A smooth picture under strong noise, or a sharp one under slight; two renders of it, and a poor estimate."""
    rng = np.random.default_rng(seed)
    y, x = np.mgrid[:size, :size].astype(np.float32) / size
    waves = [1 + np.sin(5 * x * rng.uniform(-1, 1) + 5 * y * rng.uniform(-1, 1) + rng.uniform(0, 6)) for _ in range(3)]
    clean = np.stack(waves) + 0.1
    clean = np.where(clean > 1.1, 2.0, 0.2) if sharp else clean
    shape = 200 if sharp else 2
    noisy = clean * rng.gamma(shape, 1 / shape, (2, 3, 1, size, size))
    flat = np.broadcast_to(clean.mean((1, 2), keepdims=True), noisy.shape)
    images = {
        "color": noisy,
        "albedo": np.zeros_like(noisy),
        "normal": np.zeros_like(noisy),
        "estimate": flat,
        "residual": noisy - flat,
        "confidence": np.ones((2, 3, 1, size, size)),
        "modulation": np.ones((2, 3, size, size)),
        "clean_albedo": np.ones((2, 3, size, size)),
        "clean_normal": np.zeros((2, 3, size, size)),
        "noisy": np.broadcast_to(clean, (2, *clean.shape)) if clean_target else noisy[:, 1],
        "pseudo_reference": clean * rng.gamma(8, 0.125, (2, 1, size, size)),
        "exposure": noisy.mean((1, 2, 3, 4)),
        "gain": 0.18 / noisy.mean((1, 2, 3, 4)),
        "to_next": np.zeros((2, 2, size, size)),
        "linked": np.zeros(2),
    }
    return Clip(**{name: torch.from_numpy(np.array(image, np.float32)) for name, image in images.items()})


@pytest.fixture(scope="module")
def clips(tmp_path_factory: pytest.TempPathFactory) -> Clips:
    """Four shots of one clip at two independent levels of the same noise; a fifth whose targets are clean."""
    folder = tmp_path_factory.mktemp("clips")
    for seed in range(4):
        write_shards(folder, f"shot{seed}", (4, 4), [make_clip(seed)])
    write_shards(folder, "clean", (4, 4), [make_clip(3, clean_target=True)])
    return open_clips(folder)


@pytest.fixture(scope="module")
def sets(clips: Clips) -> tuple[Clips, Clips]:
    """Three shots to train on, one to validate on."""
    return split_by_shot(clips.of([f"shot{seed}" for seed in range(4)]), ["shot3"])


CONFIG = TrainConfig(
    steps=6, batch=2, rate=3e-3, warmup=3, ema=0.9, float32=True, device="cpu", sampler=SamplerConfig(crop=16, sets=1)
)
AGAINST_START = replace(CONFIG, against="start")


def a_batch(clips: Clips, config: TrainConfig, count: int) -> Sample:
    samples = Samples(clips, config.sampler, 7)
    return torch.utils.data.default_collate([samples[number] for number in range(count)])


def equal_weights(a: Model, b: Model) -> bool:
    return all(torch.equal(p, q) for p, q in zip(a.parameters(), b.parameters(), strict=True))


@pytest.mark.parametrize("name", [name for name in LOSSES if name != "perceptual"])
def test_every_loss_that_can_be_asked_for_is_there(name: str) -> None:
    assert image_loss(replace(CONFIG, loss=name)) is getattr(losses, name)


@pytest.mark.parametrize("clean", [False, True])
def test_a_network_that_relies_on_its_guides_is_trained_with_those_without_noise(clips: Clips, clean: bool) -> None:
    batch, seen = a_batch(clips, CONFIG, 2), []
    model = RobustUNet(RobustUNetConfig(3, "small", clean_guides=clean))

    def spy(window: UNetWindow) -> UNetOutput:
        seen.append(window)
        return model(window)

    predict(model, batch, run=spy)
    wanted = batch.clean_albedo if clean else batch.albedo[:, 1]  # ones and zeros
    torch.testing.assert_close(seen[0].albedo, wanted)


def test_differences_of_neighbours_count_along_the_motion(tmp_path: Path) -> None:
    """Pictures that are off by the same amount do not flicker; the same errors with another sign in each do."""
    config = replace(CONFIG, differences=1.0, loss="l1")
    one = make_clip(0)
    clip = replace(one, color=one.estimate, residual=0 * one.residual)
    values = []
    for sign in (1, -1):
        folder = tmp_path / str(sign)
        folder.mkdir()
        targets = [one.estimate[:, 1] * (1 + 0.1 * factor) for factor in (1, sign)]
        pair = [replace(clip, reference=target, linked=torch.ones(2)) for target in targets]
        pair[1] = replace(pair[1], linked=torch.zeros(2))
        write_shards(folder, "s", (4, 4), pair)
        sampler = replace(config.sampler, fireflies=0, exposure_stops=0)
        samples = Samples(open_clips(folder), sampler, 0, image_loss(config), neighbours=True)
        batch = torch.utils.data.default_collate([samples[0]])
        plain = Sample(*(pair.flatten(0, 1) for pair in batch))
        plain_loss = batch_loss(make_model(), plain, replace(config, differences=0), image_loss(config))
        values.append((batch_loss(make_model(), batch, config, image_loss(config)) - plain_loss).item())
    # An image that is nearly the estimate is off by a tenth, its input too: twice that from one frame to the next.
    assert values[0] < 0.1
    assert values[1] > 0.5


# Settings that the loss depends on


def one_batch(clips: Clips, **fixed: float) -> Sample:
    sampler = replace(CONFIG.sampler, fireflies=0, **fixed)
    return torch.utils.data.default_collate([Samples(clips, sampler, 7)[0]])


def sharp(model: Model) -> Model:
    """A network that is not at the mean of its window, so that parts of the window give other images."""
    with torch.no_grad():
        model.head.window.weight.mul_(30)
        model.head.window.bias[4] = 5
    return model


@pytest.mark.parametrize("terms", TERMS)
def test_the_loss_has_the_terms_that_are_asked_for(clips: Clips, terms: str) -> None:
    """All of them, with the weight of the whole window, as counted by hand."""
    batch, model, config = one_batch(clips), sharp(make_model()), replace(CONFIG, terms=terms, whole=0.25, loss="l1")
    subsets = {
        "temporal": [((1,), 1.0), ((0, 2), 1.0), ((0, 1, 2), 0.25)],
        "spatial": [((0, 1, 2), 1.0)],
        "power": [(s, 1.0) for s in ((0,), (1,), (2,), (0, 1), (0, 2), (1, 2), (0, 1, 2))],
    }[terms]
    with torch.no_grad():
        filtered = predict(model, batch)
        facts = batch.color, batch.target, batch.modulation, batch.exposure
        expected = torch.log1p(losses.temporal_loss(losses.l1, filtered, *facts, subsets) / batch.error).item()
        assert batch_loss(model, batch, config, losses.l1).item() == pytest.approx(expected, rel=1e-5)
        whole = batch_loss(model, batch, replace(config, whole=4.0), losses.l1).item()
    assert (whole != pytest.approx(expected, rel=1e-3)) == (terms == "temporal")


@pytest.mark.parametrize("make", [make_model, make_robust])
def test_the_slope_weighs_errors_beyond_the_target(clips: Clips, make: Callable[[], Model]) -> None:
    batch, model = one_batch(clips), make()
    with torch.no_grad():
        plain, steep = (batch_loss(model, batch, replace(CONFIG, slope=s), losses.l1).item() for s in (1.0, 3.0))
    assert plain * 1.01 < steep
    assert math.expm1(steep) <= 3 * math.expm1(plain) * (1 + 1e-5)


@pytest.mark.parametrize("make", [make_model, make_robust])
def test_losses_are_over_those_of_the_clips_best_input(clips: Clips, make: Callable[[], Model]) -> None:
    batch, model = one_batch(clips), make()
    with torch.no_grad():
        once, half = (
            batch_loss(model, batch._replace(error=factor * batch.error), CONFIG, losses.l1).item() for factor in (1, 2)
        )
    assert math.expm1(once) == pytest.approx(2 * math.expm1(half), rel=1e-4)


@pytest.mark.parametrize(
    ("before", "after", "expected"),
    [
        (0.4, 0.3, 0.0),  # a gain beyond 15 % counts nothing
        (0.4, 0.4, 0.15**2),
        (0.4, 0.5, 0.4**2),
        (0.4, 0.8, 1.15 - 0.25),  # a line from 0.5 on
        (0.001, 0.05, 0.15**2),  # an error at the start below 0.05 counts as that
    ],
)
def test_losses_are_over_those_of_the_network_at_the_start(clips, before, after, expected):
    """The network at the start is the one whose images have no gradients."""
    batch, start = one_batch(clips), make_model().requires_grad_(False)

    def loss(prediction: torch.Tensor, *others: torch.Tensor | None) -> torch.Tensor:
        return batch.error * (after if prediction.requires_grad else before)

    value = batch_loss(make_model(), batch, CONFIG, loss, start=start).item()
    assert value == pytest.approx(expected, rel=1e-4)


@pytest.mark.parametrize("float32", [True, False])
def test_a_training_against_its_start_begins_at_the_loss_of_no_gain(float32, sets, tmp_path, monkeypatch):
    """Both networks compute alike, in bfloat16 too."""
    monkeypatch.setattr("network.training.loop.has_bfloat16", lambda device: True)
    config = replace(AGAINST_START, steps=3, float32=float32, backbone_rate=1.0)
    values = train(sets[0], sets[0].of([]), make_robust(), config, tmp_path / "w.safetensors")
    assert values[0] == pytest.approx(0.15**2, rel=1e-5)
    assert values[2] != pytest.approx(0.15**2, rel=1e-3)  # the start stays as it was


def test_the_perceptual_loss_is_vgg19s(sets, tmp_path, monkeypatch):
    torch.manual_seed(0)
    vgg, read = VGG19().eval().requires_grad_(False), []
    monkeypatch.setattr(network.training.loop, "load_vgg19", lambda source: read.append(source) or vgg)
    config = replace(CONFIG, steps=1, loss="perceptual", vgg="vgg.pth")
    loss = image_loss(config)
    assert isinstance(loss, Perceptual)
    assert loss.vgg is vgg
    used: list[torch.Tensor] = []
    vgg.register_forward_hook(lambda module, inputs, output: used.append(inputs[0]))
    train(sets[0], sets[0].of([]), make_model(), config, tmp_path / "w.safetensors")
    assert read == ["vgg.pth"] * 2
    assert used


# Training


def test_training_on_noisy_targets_approaches_the_clean_image(clips, sets, tmp_path):
    """Noise2Noise: no clean picture is ever shown, and still the error against it falls."""
    # Without fireflies: to reject those takes longer to learn, and until then they rule the loss.
    sampler = replace(CONFIG.sampler, fireflies=0)
    model, config = make_model(), replace(CONFIG, steps=60, warmup=10, loss="l1", sampler=sampler)
    with torch.no_grad():
        model.head.window.bias[4] = 20  # it starts with nearly all weight on the pixels themselves
    batch, clean = a_batch(sets[0], config, 16), clips.of(["clean"])
    loss = image_loss(config)
    loss_before, before = batch_loss(model, batch, config, loss).item(), validate(model, clean)
    train(sets[0], clips.of([]), model, config, tmp_path / "w.safetensors")
    assert batch_loss(model, batch, config, loss).item() < loss_before
    after = validate(load_model(tmp_path / "w.safetensors"), clean)
    assert after["denoised"] > before["denoised"] + 3
    assert after["denoised"] > after["noisy"] + 5


def test_a_training_on_neighbours_asks_for_them(clips: Clips, tmp_path: Path) -> None:
    config = replace(CONFIG, steps=1, differences=1.0)
    with pytest.raises(ValueError, match="expected neighbouring frames, as whole"):
        train(clips, clips.of([]), make_model(), config, tmp_path / "w.safetensors")
    pair = [replace(make_clip(seed), linked=torch.full((2,), float(seed == 0))) for seed in range(2)]
    (tmp_path / "pair").mkdir()
    write_shards(tmp_path / "pair", "s", (4, 4), pair)
    found = open_clips(tmp_path / "pair")
    (loss,) = train(found, found.of([]), make_robust(), config, tmp_path / "w.safetensors")
    assert np.isfinite(loss)


@pytest.mark.parametrize("share", [0.0, 0.1, 1.0])
def test_a_pretrained_backbone_is_trained_with_its_share_of_the_rate(share, sets, tmp_path):
    """The first step of Adam moves each weight by the learning rate."""
    model = make_robust()
    torch.nn.init.normal_(model.robust_average.correction[-1].weight)
    torch.nn.init.constant_(model.backbone.last.bias, 0.5)
    before = {name: value.detach().clone() for name, value in model.named_parameters()}
    train(sets[0], sets[0].of([]), model, replace(CONFIG, steps=1, backbone_rate=share), tmp_path / "w.safetensors")
    moved = {name: float((value - before[name]).detach().abs().max()) for name, value in model.named_parameters()}
    backbone = max(value for name, value in moved.items() if name.startswith("backbone."))
    others = max(value for name, value in moved.items() if not name.startswith("backbone."))
    assert others > 1e-4
    assert backbone == pytest.approx(share * others, rel=0.05)


def test_the_moving_average_is_saved_and_validated(sets, tmp_path, monkeypatch):
    out, model, first = tmp_path / "w.safetensors", make_model(), make_model()
    validated: list[Model] = []
    monkeypatch.setattr(network.training.loop, "validate", lambda model, clips: validated.append(model) or {})
    train(*sets, model, replace(CONFIG, steps=1, rate=0.1, warmup=0, ema=0.9), out)
    assert len(validated) == 1
    models = model, first, load_model(out), validated[0]
    weights = zip(*(each.parameters() for each in models), strict=True)
    for last, initial, saved, average in weights:
        expected = torch.lerp(last, initial, 0.1).detach()  # after one step a tenth of the first weights
        torch.testing.assert_close(saved, expected, rtol=2e-3, atol=2e-4)  # stored as halves
        torch.testing.assert_close(average, expected, rtol=1e-4, atol=1e-6)
    assert not equal_weights(validated[0], model)


def test_gradients_are_clipped(sets: tuple[Clips, Clips], tmp_path: Path) -> None:
    """Far below the epsilon of Adam, which is blind to the scale of gradients, nothing moves."""
    moved = []
    for norm in (1.0, 1e-13):
        model, before = make_model(), make_model()
        train(sets[0], sets[0].of([]), model, replace(CONFIG, steps=1, clip_norm=norm), tmp_path / "w.safetensors")
        pairs = zip(model.parameters(), before.parameters(), strict=True)
        moved.append(max(float((p - q).detach().abs().max()) for p, q in pairs))
    assert moved[1] < 0.01 * moved[0]


def test_a_training_is_determined_by_its_seed(sets: tuple[Clips, Clips], tmp_path: Path) -> None:
    none = sets[0].of([])
    runs = [train(sets[0], none, make_model(), CONFIG, tmp_path / f"{i}.safetensors") for i in range(2)]
    assert runs[0] == runs[1]
    other = train(sets[0], none, make_model(), replace(CONFIG, seed=1), tmp_path / "c.safetensors")
    assert other != runs[0]


def test_bfloat16_training_stays_near_float32(sets, tmp_path, monkeypatch):
    none = sets[0].of([])
    monkeypatch.setattr("network.training.loop.has_bfloat16", lambda device: True)
    full = train(sets[0], none, make_model(), CONFIG, tmp_path / "a.safetensors")
    half = train(sets[0], none, make_model(), replace(CONFIG, float32=False), tmp_path / "b.safetensors")
    assert half != full
    assert half == pytest.approx(full, rel=0.02)  # 8 bits in the features, averaged over all pixels


def test_a_device_without_bfloat16_trains_in_float32(sets, tmp_path, monkeypatch):
    none = sets[0].of([])
    full = train(sets[0], none, make_model(), CONFIG, tmp_path / "a.safetensors")
    monkeypatch.setattr("network.training.loop.has_bfloat16", lambda device: False)
    same = train(sets[0], none, make_model(), replace(CONFIG, float32=False), tmp_path / "b.safetensors")
    assert same == full


def test_a_compiled_network_trains_alike(sets, tmp_path, monkeypatch):
    """Traced in one piece as for a GPU, but run by torch itself: compiling takes minutes and shows no more of ours."""
    plain = train(sets[0], sets[0].of([]), make_model(), replace(CONFIG, steps=2), tmp_path / "a")
    compiling = torch.compile
    monkeypatch.setattr(torch, "compile", lambda model: compiling(model, backend="eager", fullgraph=True))
    traced = train(sets[0], sets[0].of([]), make_model(), replace(CONFIG, steps=2, compile=True), tmp_path / "b")
    assert traced == pytest.approx(plain, rel=1e-4)  # operations may be grouped otherwise


@pytest.mark.parametrize(
    ("name", "terms"), [*((name, "temporal") for name in MODELS), ("unet", "power"), ("unet", "spatial")]
)
def test_every_model_learns_with_all_of_its_weights(name, terms, sets, tmp_path):
    model = MODELS[name]()
    if isinstance(model, RobustUNet):  # as after some steps: what starts as a constant hides what is before it
        torch.nn.init.normal_(model.robust_average.correction[-1].weight)
        torch.nn.init.constant_(model.backbone.last.bias, 0.5)  # else by chance all is black, without gradients
    before = [p.clone() for p in model.parameters()]
    config = replace(CONFIG, steps=2, terms=terms, slope=2.0, backbone_rate=1.0)
    losses = train(sets[0], sets[0].of([]), model, config, tmp_path / "w.safetensors")
    assert np.isfinite(losses).all()
    assert all(not torch.equal(p, q) for p, q in zip(model.parameters(), before, strict=True))


@pytest.mark.parametrize("name", ["resnet", *seldom("tkpcn")])
def test_a_training_ends_with_weights_better_than_it_began(name: str, tmp_path: Path) -> None:
    """On a shot that it was not trained on: a network begins with means over 3×3 pixels, and learns of edges."""
    for seed in range(4):
        write_shards(tmp_path, f"shot{seed}", (4, 4), [make_clip(seed, clean_target=True, sharp=True)])
    training, validation = split_by_shot(open_clips(tmp_path), ["shot3"])
    before = validate(MODELS[name](), validation)
    config = replace(CONFIG, steps=60, rate=1e-2)
    train(training, validation, MODELS[name](), config, tmp_path / "w.safetensors")
    after = validate(load_model(tmp_path / "w.safetensors"), validation)
    assert after["denoised"] > before["denoised"] + 3


def test_what_is_logged_tells_how_it_goes(sets: tuple[Clips, Clips], tmp_path: Path) -> None:
    logged: list[tuple[int, dict[str, float]]] = []
    losses = train(*sets, make_model(), CONFIG, tmp_path / "w", log=lambda step, values: logged.append((step, values)))
    steps = [values for _, values in logged if "done" in values]
    assert [values["train/loss"] for values in steps] == losses
    assert [values["done"] for values in steps] == [pytest.approx(step / 6) for step in range(1, 7)]
    assert all(a["seconds"] < b["seconds"] for a, b in pairwise(steps))
    assert "validation/denoised" in logged[-1][1]  # at the end, always
    assert notes_of(tmp_path / "w")["validation"][-1]["step"] == 6


def _train_in_a_group(rank: int, folder: str, out: str) -> None:
    torch.set_num_threads(1)
    torch.distributed.init_process_group("gloo", init_method=f"file://{folder}/meet", rank=rank, world_size=2)
    clips = open_clips(folder)
    train(clips, clips.of([]), make_model(), replace(CONFIG, steps=3, batch=4), out)
    os._exit(0)  # after the last barrier; torch's threads can abort an interpreter that ends while they run


def test_two_processes_train_as_one_does_on_the_whole_batch(tmp_path: Path) -> None:
    for seed in range(3):
        write_shards(tmp_path, f"shot{seed}", (4, 4), [make_clip(seed)])
    clips, together = open_clips(tmp_path), tmp_path / "together"
    torch.multiprocessing.spawn(_train_in_a_group, (str(tmp_path), str(together)), nprocs=2)
    alone = make_model()
    train(clips, clips.of([]), alone, replace(CONFIG, steps=3, batch=4), tmp_path / "alone")
    moved = 0.0
    for (name, p), q, first in zip(
        load_model(together).named_parameters(),
        load_model(tmp_path / "alone").parameters(),
        make_model().parameters(),
        strict=True,
    ):
        # Means of two means, in float32, three steps of Adam; weights are stored as halves. They have moved by more.
        torch.testing.assert_close(p, q, rtol=2e-3, atol=2e-4, msg=name)
        moved = max(moved, float((q - first).abs().max().detach()))
    assert moved > 2e-3


def test_a_batch_that_cannot_be_shared_is_an_error(sets, tmp_path, monkeypatch):
    monkeypatch.setattr(network.training.loop, "_in_group", lambda: True)
    monkeypatch.setattr(torch.distributed, "get_rank", lambda: 0)
    monkeypatch.setattr(torch.distributed, "get_world_size", lambda: 4)
    with pytest.raises(ValueError, match="batch: expected a multiple of the 4 processes, got 2"):
        train(*sets, make_model(), CONFIG, tmp_path / "w")


def _train_and_be_killed(rank: int, folder: str, out: str) -> None:
    """With a checkpoint after every step, killed after the fifth and before its checkpoint."""
    torch.set_num_threads(1)

    def log(step: int, values: dict[str, float]) -> None:
        if step == 5:
            os.kill(os.getpid(), signal.SIGKILL)

    train(*_sets_of(folder), make_model(), replace(AGAINST_START, validate_minutes=0.0), out, log=log)


def _sets_of(folder: str | Path) -> tuple[Clips, Clips]:
    return split_by_shot(open_clips(folder), ["shot1"])


@pytest.mark.posix
def test_a_training_that_is_killed_is_resumed_as_if_nothing_had_happened(tmp_path: Path) -> None:
    (tmp_path / "clips").mkdir()
    for seed in range(2):
        write_shards(tmp_path / "clips", f"shot{seed}", (4, 4), [make_clip(seed)])
    sets, out = _sets_of(tmp_path / "clips"), tmp_path / "w.safetensors"
    unbroken_model = make_model()
    unbroken = train(*sets, unbroken_model, AGAINST_START, out)
    assert not Path(f"{out}.state").exists()  # nothing to resume
    unbroken_average = load_model(out)
    out.unlink()

    with pytest.raises(torch.multiprocessing.ProcessExitedException, match="SIGKILL"):
        torch.multiprocessing.spawn(_train_and_be_killed, (str(tmp_path / "clips"), str(out)))
    model = make_model(seed=9)  # other weights: they must come from the file
    assert train(*sets, model, AGAINST_START, out, resume=True) == unbroken[4:]
    assert equal_weights(model, unbroken_model)
    assert equal_weights(load_model(out), unbroken_average)
    assert not Path(f"{out}.state").exists()


def test_a_state_that_is_missing_cut_short_or_of_another_training_is_an_error(sets, tmp_path):
    out = tmp_path / "w.safetensors"
    with pytest.raises(FileNotFoundError, match="resume: no file"):
        train(*sets, make_model(), CONFIG, out, resume=True)
    state = Path(f"{out}.state")
    every_step = replace(CONFIG, validate_minutes=0.0)
    kept = tmp_path / "kept"

    def keep(step: int, values: dict[str, float]) -> None:
        if state.exists():
            kept.write_bytes(state.read_bytes())

    train(*sets, make_model(), every_step, out, log=keep)
    state.write_bytes(kept.read_bytes()[:2000])
    with pytest.raises(ValueError, match="no training state, or cut short"):
        train(*sets, make_model(), CONFIG, out, resume=True)
    state.write_bytes(kept.read_bytes())
    with pytest.raises(ValueError, match="expected the same model and configuration"):
        train(*sets, make_model(), replace(CONFIG, rate=1e-5), out, resume=True)


def test_validation_measures_what_it_says(tmp_path: Path) -> None:
    clip = make_clip(0)
    same = clip.color[:, 1].mean(0, keepdim=True).expand(2, -1, -1, -1)
    window = same[:, None].expand(2, 3, -1, -1, -1)
    write_shards(tmp_path, "s", (4, 4), [replace(clip, color=window, estimate=window, noisy=same)])
    model, clips = make_robust(), open_clips(tmp_path)
    values = validate(model, clips)
    # All are the target, but for the half precision of what is stored; 120 is the floor.
    assert values["noisy"] == values["estimate"] == pytest.approx(values["gated"], abs=0.1)
    assert values["noisy"] > 100
    batch = whole_frames(clips, 0, model.multiple)[0]
    with torch.no_grad():
        image = predict(model, batch).irradiance
    assert values["denoised"] == pytest.approx(float(losses.tone_mapped_psnr(image, batch.target)), abs=0.1)
    assert values["mean"] == pytest.approx(float(image.sum() / batch.target.sum()), abs=0.01)
    assert values["side"] == pytest.approx(2 / 3, abs=0.02)  # of three frames of full confidence


def test_the_learning_rate_warms_up_and_falls() -> None:
    config = replace(CONFIG, steps=1000, warmup=100)
    rates = [network.training.loop._rate(config, step, step / 1000) for step in range(1000)]
    assert rates[0] == pytest.approx(0.01, rel=1e-3)
    assert max(rates) == pytest.approx(rates[99]) == pytest.approx(1, abs=0.03)
    assert all(b < a for a, b in pairwise(rates[99:]))
    assert rates[-1] == pytest.approx(0.01, abs=1e-4)
