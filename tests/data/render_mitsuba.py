"""Render tests/data/mitsuba, a shot of Mitsuba 3 (3.9.1) with its default pixel filter, a Gaussian that is splatted.

    pip install mitsuba && python tests/data/render_mitsuba.py

The scene is that of `benchmarks/other_renderers.py`, with larger checks, in 104×64 pixels: three frames of 16 samples,
each with another seed, and of the middle one two independent references of 512 samples, color alone. As Mitsuba writes
them, they have no vectors.
"""

import sys
from pathlib import Path

sys.path.insert(0, str(Path(__file__).resolve().parents[2]))

from benchmarks import other_renderers
from tests.exr_files import write_layers

FOLDER = Path(__file__).resolve().parent / "mitsuba"
SAMPLES, REFERENCE = 16, 512

if __name__ == "__main__":
    other_renderers.WIDTH, other_renderers.HEIGHT, other_renderers.CHECKS = 104, 64, 8
    FOLDER.mkdir(exist_ok=True)
    for frame in (2, 3, 4):
        layers = other_renderers.render_mitsuba(frame, None, SAMPLES, 1000 + frame)
        write_layers(FOLDER / f"noisy.{frame:04d}.exr", layers, attributes={"generatedBy": "Mitsuba"})
    for half, seed in (("a", 2003), ("b", 3003)):
        image = other_renderers.render_mitsuba(3, None, REFERENCE, seed)[""]
        write_layers(FOLDER / f"reference_{half}.0003.exr", {"": image})
