"""Whether --max-memory is kept at 3840×2160, and that the result does not depend on it.

The bundled shot is tiled to 3840×2160, and some of its frames are denoised with a limit, and with none, in a process of
its own; of several frames one is read and one is written meanwhile, as in a chunk of a farm. Peak memory is the
operating system's count of that process. ``pytest -rP`` shows it.
"""

import subprocess
import sys
from pathlib import Path

import numpy as np
import pytest

from hybrid.files.exr import read_exr
from hybrid.run.memory import parse_size
from hybrid.run.records import read_records
from tests.exr_files import write_layers

pytestmark = pytest.mark.reliability
SHOT = Path(__file__).parents[1] / "data" / "bathroom"
FRAMES, REPEAT = 5, 12


def tile_shot(folder: Path) -> None:
    """Write five frames of *bathroom*, each tiled, as float32: half would hide or magnify small differences."""
    for number, path in enumerate(sorted(SHOT.glob("noisy.*.exr"))[:FRAMES], start=1):
        image = read_exr(path)
        layers = {layer.name: np.tile(image.pixels(layer.channels), (REPEAT, REPEAT, 1)) for layer in image.layers}
        write_layers(folder / f"tiled.{number:04d}.exr", layers, half=False)


@pytest.fixture(scope="module")
def tiled(tmp_path_factory: pytest.TempPathFactory) -> Path:
    folder = tmp_path_factory.mktemp("tiled")
    tile_shot(folder)
    return folder


def run(command: str, frames: str, folder: Path, out: Path, *limit: str) -> tuple[int, np.ndarray] | str:
    """Run a command; its peak memory and the color of the third frame, or why it refused."""
    first, *rest = command.split()
    words = [first, str(folder / "tiled.####.exr"), "-o", str(out), "--frames", frames, *rest, *limit]
    done = subprocess.run([sys.executable, "-m", "hybrid.cli", *words], capture_output=True, text=True)
    if done.returncode == 1 and "max-memory" in done.stderr:
        return done.stderr.strip().splitlines()[-1]
    assert done.returncode == 0, done.stderr
    *_, (_, report) = read_records(out)
    image = read_exr(out / "tiled.0003.exr")
    print(words[-1], f"{report['peak_bytes'] / 2**30:.2f} GiB")
    return report["peak_bytes"], image.pixels(image.layer("ViewLayer.Combined").channels[:3])


@pytest.mark.parametrize("frames", ["3", "1-5"])
@pytest.mark.parametrize("command", ["denoise --preset draft", "denoise --first-pass none"])
def test_a_limit_is_kept_and_changes_no_picture(tiled: Path, tmp_path: Path, command: str, frames: str) -> None:
    whole = run(command, frames, tiled, tmp_path / "whole")
    assert not isinstance(whole, str)
    for limit in ("8G", "6G", "4G"):
        result = run(command, frames, tiled, tmp_path / limit, "--max-memory", limit)
        if not isinstance(result, str):  # too little for the fewest rows is refused
            assert result[0] <= parse_size(limit)
            assert np.abs(result[1] - whole[1]).max() <= 1e-5 * whole[1].mean()
