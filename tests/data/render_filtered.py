"""Render tests/data/mitsuba and tests/data/luxcore, shots whose renderers splat samples through a pixel filter.

    pip install mitsuba pyluxcore && python tests/data/render_filtered.py

Mitsuba 3 (3.9.1) has its default filter, a Gaussian; LuxCore (2.11.2, the engine BIDIRCPU) Blackman-Harris. The scene
is that of `benchmarks/other_renderers.py`, with larger checks, in 104×64 pixels: three frames of 16 samples, each with
another seed, and of the middle one two independent references of 512 samples, color alone. As the renderers write
them, they have no vectors.
"""

import sys
from pathlib import Path

sys.path.insert(0, str(Path(__file__).resolve().parents[2]))

from benchmarks import other_renderers
from tests.exr_files import write_layers

SHOTS = {"mitsuba": ("mitsuba", {"generatedBy": "Mitsuba"}), "luxcore": ("luxcore-bidir", {})}
SAMPLES, REFERENCE = 16, 512

if __name__ == "__main__":
    other_renderers.WIDTH, other_renderers.HEIGHT, other_renderers.CHECKS = 104, 64, 8
    for name, (renderer, attributes) in SHOTS.items():
        folder = Path(__file__).resolve().parent / name
        folder.mkdir(exist_ok=True)
        for frame in (2, 3, 4):
            layers = other_renderers.render(renderer, frame, None, SAMPLES, 1000 + frame)
            write_layers(folder / f"noisy.{frame:04d}.exr", layers, attributes=attributes)
        for half, seed in (("a", 2003), ("b", 3003)):
            layers = other_renderers.render(renderer, 3, None, REFERENCE, seed)
            write_layers(folder / f"reference_{half}.0003.exr", dict([next(iter(layers.items()))]))
