"""Noise that a renderer's pixel filter spreads is found and removed (`tests/data/render_filtered.py`)."""

from importlib.util import find_spec
from pathlib import Path

import pytest

from hybrid.comparison.metrics import psnr
from hybrid.denoising.oidn import denoise_oidn
from hybrid.denoising.plan import Rules
from hybrid.denoising.stream import FrameStream
from hybrid.files.shots import open_shot
from ravg import denoise_shot

DATA = Path(__file__).resolve().parent.parent / "data"


@pytest.mark.oidn
@pytest.mark.skipif(find_spec("pyoidn") is None, reason="pyoidn is not installed")
@pytest.mark.parametrize("name", ["noisy.####.exr", "noisy.0003.exr"])
@pytest.mark.parametrize("renderer", ["mitsuba", "luxcore"])
def test_noise_that_the_default_filter_spreads_is_removed_from_a_shot_and_a_single_frame(
    tmp_path: Path, renderer: str, name: str
) -> None:
    folder = DATA / renderer
    shot = open_shot(folder / name)
    stream = FrameStream(shot, Rules())
    (facts,), _ = stream.measurements([3])
    assert facts.noise_correlation is not None
    along_x, along_y = facts.noise_correlation
    # By the kernels 0.42 and 0.46; 100 tiles and fewer err by 0.05.
    assert min(along_x[0], along_y[0]) > 0.3
    assert (facts.noise_correlation_alone is not None) == (len(shot.numbers) == 1)
    list(denoise_shot(shot, str(tmp_path / "frame.####.exr"), preset="fast"))
    denoised = open_shot(tmp_path).read(3).color
    noisy = shot.read(3)
    references = tuple(open_shot(folder / f"reference_{half}.####.exr").read(3).color for half in "ab")
    best = denoise_oidn(noisy.color, noisy.albedo, noisy.normal, prefilter="high")
    assert psnr(denoised, references) > psnr(best, references) + 3  # OIDN takes the noise for detail
