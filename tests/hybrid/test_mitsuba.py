"""Shots of Mitsuba 3: its AOV integrator's files need no option."""

from pathlib import Path

import numpy as np
import pytest

from hybrid.cli import main
from hybrid.comparison.metrics import psnr
from hybrid.files.shots import open_shot

FRAMES = range(1, 4)


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
