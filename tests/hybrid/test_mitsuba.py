"""Shots of Mitsuba 3: its AOV integrator's files need no option, and noise that its default filter spreads is found.

The second is `tests/data/mitsuba`, rendered beforehand by `tests/data/render_mitsuba.py`.
"""

from importlib.util import find_spec
from pathlib import Path

import numpy as np
import pytest

from hybrid.cli import main
from hybrid.comparison.metrics import psnr
from hybrid.denoising.oidn import denoise_oidn
from hybrid.denoising.plan import Rules
from hybrid.denoising.stream import FrameStream
from hybrid.files.shots import open_shot
from ravg import denoise_shot

FRAMES = range(1, 4)
GAUSSIAN = Path(__file__).resolve().parent.parent / "data" / "mitsuba"


def scene(frame: int, samples: int) -> object:
    """A ball of two colors that turns past a lamp, before a wall, seen by a camera that moves aside."""
    import mitsuba

    transform = mitsuba.ScalarTransform4f
    board = {"type": "checkerboard", "to_uv": transform().scale([6, 6, 1])}
    return mitsuba.load_dict(
        {
            "type": "scene",
            "integrator": {
                "type": "aov",
                "aovs": "alb:albedo,nn:sh_normal,dd:depth",
                "my_image": {"type": "path", "max_depth": 4},
            },
            "sensor": {
                "type": "perspective",
                "to_world": transform().look_at([0.1 * frame, 0.5, 5], [0, 0, 0], [0, 1, 0]),
                "film": {
                    "type": "hdrfilm",
                    "width": 96,
                    "height": 64,
                    "pixel_format": "rgba",
                    "rfilter": {"type": "box"},
                },
                "sampler": {"type": "independent", "sample_count": samples, "seed": 100 * samples + frame},
            },
            "lamp": {
                "type": "sphere",
                "center": [3, 4, 3],
                "emitter": {"type": "area", "radiance": {"type": "rgb", "value": [20, 20, 20]}},
            },
            "wall": {"type": "rectangle", "to_world": transform().translate([0, 0, -1.5]).scale([6, 6, 1])},
            "ball": {
                "type": "sphere",
                "to_world": transform().translate([0.1 * frame - 0.3, 0, 0]).rotate([0, 1, 0], 5 * frame),
                "bsdf": {"type": "diffuse", "reflectance": board},
            },
        }
    )


def render(folder: Path, name: str, samples: int, frames: range = FRAMES) -> Path:
    import mitsuba

    mitsuba.set_variant("scalar_rgb")
    for frame in frames:
        made = scene(frame, samples)
        mitsuba.render(made)
        made.sensors()[0].film().bitmap().write(str(folder / f"{name}.{frame:04d}.exr"))
    return folder / f"{name}.####.exr"


@pytest.mark.mitsuba
def test_what_mitsuba_renders_is_found_and_denoised(tmp_path: Path, capsys: pytest.CaptureFixture[str]) -> None:
    pytest.importorskip("mitsuba", reason="mitsuba is not installed")
    spec = render(tmp_path, "noisy", 8)
    layers = open_shot(spec).layers(2)
    assert (layers.profile, layers.reason) == ("Mitsuba", "header attribute generatedBy")
    found = [str(layer) for layer in (layers.color, layers.alpha, layers.albedo, layers.normal, layers.depth)]
    assert found == ["RGB", "A", "alb.RGB", "nn.XYZ", "dd.T"]
    assert layers.motion is None
    assert main(["denoise", str(spec), "-o", str(tmp_path / "out"), "--frames", "2", "--preset", "draft"]) == 0
    assert "warning" not in capsys.readouterr().err
    reference = open_shot(render(tmp_path, "reference", 256, range(2, 3))).read(2).color
    noisy = open_shot(spec).read(2).color
    denoised = open_shot(tmp_path / "out").read(2).color
    assert np.isfinite(denoised).all()
    assert psnr(denoised, reference) > psnr(noisy, reference) + 3


@pytest.mark.oidn
@pytest.mark.skipif(find_spec("pyoidn") is None, reason="pyoidn is not installed")
@pytest.mark.parametrize("name", ["noisy.####.exr", "noisy.0003.exr"])
def test_noise_that_the_default_filter_spreads_is_removed_from_a_shot_and_a_single_frame(
    tmp_path: Path, name: str
) -> None:
    shot = open_shot(GAUSSIAN / name)
    stream = FrameStream(shot, Rules())
    (facts,), _ = stream.measurements([3])
    assert facts.noise_correlation is not None
    along_x, along_y = facts.noise_correlation
    assert min(along_x[0], along_y[0]) > 0.3  # by the kernel 0.42; 100 tiles and fewer err by 0.05
    assert (facts.noise_correlation_alone is not None) == (len(shot.numbers) == 1)
    list(denoise_shot(shot, str(tmp_path / "frame.####.exr"), preset="fast"))
    denoised = open_shot(tmp_path).read(3).color
    noisy = shot.read(3)
    references = tuple(open_shot(GAUSSIAN / f"reference_{half}.####.exr").read(3).color for half in "ab")
    best = denoise_oidn(noisy.color, noisy.albedo, noisy.normal, prefilter="high")
    assert psnr(denoised, references) > psnr(best, references) + 3  # OIDN takes the noise for detail
