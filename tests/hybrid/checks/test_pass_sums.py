"""The passes that renderers write, by their names and with their arithmetic: each keeps its light."""

from dataclasses import dataclass, field

import numpy as np
import pytest

from hybrid.checks.pass_sums import classify_passes, sample_rows
from hybrid.checks.validation import validate_layers
from hybrid.cli import main
from hybrid.denoising.first_pass import Classical
from hybrid.denoising.pseudo_reference import DRAFT
from hybrid.denoising.stream import FrameStream
from hybrid.files.shots import open_shot
from tests.exr_files import write_layers
from tests.scenes import only

Layers = dict[str, np.ndarray]

SIZE = HEIGHT, WIDTH = 48, 64


def textured() -> np.ndarray:
    """A color for each 6×6 pixels, in [0.2, 0.8]."""
    wall = np.random.default_rng(7).uniform(0.2, 0.8, (HEIGHT // 6, -(-WIDTH // 6), 3))
    return np.float32(wall.repeat(6, axis=0).repeat(6, axis=1)[:, :WIDTH])


def light(index: int, seed: int, level: float = 0.3) -> np.ndarray:
    """Light that rises across the picture, with noise of a deviation of a half."""
    rise = np.linspace(0.5, 1.5, WIDTH)[None, :, None] * np.float32([1, 0.9, 0.8])
    grain = np.random.default_rng((seed, index)).gamma(4, 0.25, (HEIGHT, WIDTH, 1))
    return np.float32(level * rise * grain)


@dataclass(frozen=True)
class Renderer:
    """A renderer's list of passes: the sums it keeps, and what belongs to none."""

    color: str
    partitions: tuple[tuple[str, ...], ...]
    alone: tuple[str, ...] = ()
    kept: tuple[str, ...] = ()
    colors: dict[str, str] = field(default_factory=dict)

    def layers(self, index: int) -> Layers:
        """Those of a frame: the first sum makes the beauty, others share it out."""
        albedo = textured()
        colors = {name: albedo for name in self.colors.values()}
        made: Layers = {}
        for k, name in enumerate(self.partitions[0]):
            made[name] = light(index, k) * (1 if name in self.colors or k % 2 else albedo)
        beauty = np.sum(
            [made[name] * (colors[self.colors[name]] if name in self.colors else 1) for name in self.partitions[0]],
            axis=0,
            dtype=np.float32,
        )
        for number, names in enumerate(self.partitions[1:]):
            shares = np.random.default_rng((number, index)).dirichlet([3] * len(names), SIZE).astype(np.float32)
            made |= {name: shares[..., k, None] * beauty for k, name in enumerate(names)}
        made |= {name: 4 * light(index, 100 + k) for k, name in enumerate(self.alone)}
        made |= {name: np.full((*SIZE, 3), 0.5, np.float32) for name in self.kept}
        return made | colors | {self.color: beauty}


RENDERERS = {
    "arnold": Renderer(
        "RGBA",
        (
            ("diffuse_direct", "diffuse_indirect", "specular_direct", "specular_indirect", "coat", "sss", "emission"),
            ("RGBA_key", "RGBA_fill", "RGBA_default"),
            ("direct", "indirect"),
        ),
        alone=("shadow_matte",),
        kept=("shadow_mask",),
    ),
    "vray": Renderer(
        "",
        (
            ("VRayLighting", "VRayGlobalIllumination", "VRayReflection", "VRayRefraction", "VRaySpecular", "VRaySSS2"),
            ("VRayLightSelect_sun", "VRayLightSelect_dome"),
        ),
        alone=("VRayExtraTex_AO",),
        kept=("VRayMtlID",),
    ),
    "renderman": Renderer(
        "Ci",
        (("directDiffuse", "indirectDiffuse", "directSpecular", "indirectSpecular", "subsurface", "emissive"),),
        alone=("occlusion",),
    ),
    "redshift": Renderer(
        "",
        (("DiffuseLighting", "GlobalIllumination", "SpecularLighting", "Reflections", "Refractions", "Emission"),),
        alone=("AO",),
        kept=("PuzzleMatte",),
    ),
    "cycles": Renderer(
        "ViewLayer.Combined",
        (
            tuple(f"ViewLayer.{name}" for name in ("DiffDir", "DiffInd", "GlossDir", "GlossInd", "Emit", "Env")),
            ("ViewLayer.Combined_key", "ViewLayer.Combined_fill"),
        ),
        alone=("ViewLayer.AO", "ViewLayer.Shadow Catcher"),
        colors={
            f"ViewLayer.{lobe}{way}": f"ViewLayer.{lobe}Col" for lobe in ("Diff", "Gloss") for way in ("Dir", "Ind")
        },
    ),
}


def judged(folder, names):
    shot = open_shot(folder, aovs=names)
    return validate_layers(shot).apply(shot)


def write(folder, layers, frames=3):
    folder.mkdir(exist_ok=True)
    for index in range(frames):
        write_layers(folder / f"shot.{index + 1:04d}.exr", layers(index), half=False)
    return folder


def denoised(folder, names, preset="fast"):
    """The AOVs and the picture of the middle frame, and the frame itself."""
    pytest.importorskip("torch")
    from hybrid.neural import open_network
    from network.checkpoint import shipped_weights

    shot = judged(folder, names)
    window = FrameStream(shot, only({"demodulate", "warp"}), first_pass=Classical(DRAFT)).align(2)
    return open_network(shipped_weights(preset), precision="float32")(window), open_shot(folder, aovs=names).read(2)


@pytest.mark.neural
@pytest.mark.parametrize("name", RENDERERS)
def test_each_pass_of_a_renderer_keeps_its_light(name, tmp_path):
    renderer = RENDERERS[name]
    parts = [part for names in renderer.partitions for part in names]
    write(tmp_path, renderer.layers)
    shot = judged(tmp_path, (*parts, *renderer.alone, *renderer.kept))
    assert {frozenset(found.parts) for found in shot.passes.sums} == {frozenset(p) for p in renderer.partitions}
    assert {*shot.passes.kept} == {*renderer.kept}
    made, frame = denoised(tmp_path, (*parts, *renderer.alone, *renderer.kept))
    assert {*made.aovs} == {*parts, *renderer.alone}
    rendered = [judged(tmp_path, (*parts, *renderer.alone)).read(number) for number in (1, 2, 3)]
    for part, layer in made.aovs.items():
        mean = np.mean([one.aovs[part] for one in rendered])
        assert layer.mean() == pytest.approx(mean, rel=0.03), part  # of three frames' noise
    for names in renderer.partitions:
        total = sum(made.aovs[part] * frame.pass_colors.get(part, np.float32(1)) for part in names)
        assert np.abs(total - made.color).max() < 1e-3 * made.color.mean()


def sums_of(beauty, parts, frames=2):
    """The sums found among layers, given as functions of the frame's index."""
    from hybrid.files.frame import Frame

    made = [
        Frame(k, np.float32(beauty(k)), aovs={name: np.float32(part(k)) for name, part in parts.items()})
        for k in range(frames)
    ]
    passes, words = classify_passes([sample_rows(frame) for frame in made])
    assert {*words} == {*parts}
    return {(found.whole, frozenset(found.parts), found.complete) for found in passes.sums}, {*passes.kept}


def a(k):
    return light(k, 1)


def b(k):
    return light(k, 2, 0.2)


def c(k):
    return light(k, 3, 0.1)


def both(k):
    return a(k) + b(k)


def spark(k):
    layer = a(k).copy()
    layer[5, 7] = 60000
    return layer


def hole(k):
    layer = a(k).copy()
    layer[3:5, 3] = np.nan
    return layer


def saturated(k):
    return np.float32(np.float16(np.minimum(1e6 * (a(k) - 0.05), 65504)))


def coarse(k):
    return np.float32(np.linspace(0, 1, WIDTH // 2).repeat(2)[None, :, None] * np.ones((HEIGHT, 1, 3)))


AB = ("", frozenset("ab"), True)


@pytest.mark.parametrize(
    ("beauty", "parts", "expected"),
    [
        (both, {"a": a, "b": b}, {AB}),
        (both, {"a": a, "b": b, "copy": a}, {AB, ("a", frozenset({"copy"}), True)}),
        (both, {"a": a, "b": b, "whole": both}, {AB, ("", frozenset({"whole"}), True)}),
        (both, {"a": a, "b": b, "black": lambda k: 0 * a(k)}, {AB}),
        (both, {"a": a, "b": b, "other": c}, {AB}),
        (both, {"a": a, "b": b, "mask": coarse}, {AB}),
        (both, {"a": a, "b": b, "gray": lambda k: a(k)[..., :1]}, {AB}),
        (b, {"a": a, "b": b}, {("", frozenset("b"), True)}),
        (
            lambda k: both(k) - c(k),
            {"a": a, "b": b, "minus": lambda k: -c(k)},
            {("", frozenset({"a", "b", "minus"}), True)},
        ),
        (lambda k: spark(k) + b(k), {"a": spark, "b": b}, {AB}),
        (both, {"a": spark, "b": b}, {AB}),
        (both, {"a": hole, "b": b}, {AB}),
        (lambda k: saturated(k), {"a": saturated}, {("", frozenset("a"), True)}),
        (
            lambda k: both(k) + c(k),
            {"sum": both, "c": c, "a": a, "b": b},
            {("", frozenset({"sum", "c"}), True), ("sum", frozenset("ab"), True)},
        ),
        (lambda k: both(k) + 1e-3 * c(k), {"a": a, "b": b, "dim": lambda k: 1e-3 * c(k)}, {AB, "dim"}),
        (both, {"a": a}, {("", frozenset("a"), False)}),
        (lambda k: 0.5 * both(k), {"a": a, "b": b}, set()),
        (lambda k: 0 * a(k), {"a": a}, set()),
    ],
)
def test_sums_are_found_by_adding_up(beauty, parts, expected):
    found, _ = sums_of(beauty, parts)
    if "dim" in expected:
        expected = {("", frozenset({"a", "b", "dim"}), True)}
    assert found == expected


def test_one_frame_alone_is_judged_as_well():
    assert sums_of(both, {"a": a, "b": b}, frames=1)[0] == {AB}


def test_a_layer_without_noise_is_kept():
    _, kept = sums_of(both, {"a": a, "b": b, "mask": coarse})
    assert kept == {"mask"}


def test_only_what_was_multiplied_by_the_albedo_is_divided_by_it():
    from hybrid.files.frame import Frame

    albedo = textured()
    frames = [
        Frame(k, a(k) * albedo + b(k), albedo=albedo, aovs={"diffuse": a(k) * albedo, "emission": b(k), "ao": c(k)})
        for k in range(2)
    ]
    passes, _ = classify_passes([sample_rows(frame) for frame in frames])
    assert passes.textured == ("diffuse",)


@pytest.mark.neural
def test_a_beauty_is_no_sum_of_what_does_not_add_up_to_it(tmp_path, capsys):
    write(tmp_path / "in", lambda k: {"RGBA": 0.5 * both(k), "RGBA_key": a(k), "RGBA_fill": b(k)})
    command = ["denoise", str(tmp_path / "in"), "-o", str(tmp_path / "out"), "--aov", "all"]
    assert main([*command, "--aov-sum", "beauty"]) == 1
    assert "together have 2.00 times its light" in capsys.readouterr().err
    assert not list((tmp_path / "out").glob("*.exr"))
    assert main(command) == 0
    for name, given in (("RGBA_key", a), ("RGBA_fill", b)):
        made = open_shot(tmp_path / "out", aovs=(name,)).read(2).aovs[name]
        assert made.mean() == pytest.approx(np.mean([given(k).mean() for k in range(3)]), rel=0.02)
