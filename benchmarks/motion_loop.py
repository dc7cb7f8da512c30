"""The loop that the README opens with: `python benchmarks/motion_loop.py NAME=FRAMES… -o docs/images/motion.webp`.

    python examples/render_shot.py modern_hall.blend hall --center 0.62,0.45 --levels noisy=16 --movers 2 --seed 13 \\
        --frames 1-24 --threads 1 --compact
    ravg denoise "hall/noisy.####.exr 1-16" -o hall_ravg --preset balanced --estimate oidn --keep-estimates hall_oidn
    python benchmarks/motion_loop.py "noisy, 16 samples=hall/noisy.####.exr 1-16" OIDN=hall_oidn ravg=hall_ravg \\
        -o docs/images/motion.webp --brighter 1.6

Sequences of the same frames stand side by side with their names, play there and back, and are exposed alike: the first
frame of the first one has a mean of 0.18.
"""

from __future__ import annotations

import argparse
import sys
from pathlib import Path

import numpy as np
from PIL import Image, ImageDraw, ImageFont

sys.path.insert(0, str(Path(__file__).resolve().parent.parent))

from hybrid.alignment.transfer import measure_exposure
from hybrid.files.frames import open_shot
from hybrid.files.movies import write_movie
from hybrid.files.pictures import encode_srgb
from nlm.average import replace_nonfinite

GAP = 4  # white pixels between two pictures


def main(argv: list[str] | None = None) -> int:
    parser = argparse.ArgumentParser(description=__doc__.split("\n")[0])
    parser.add_argument("sequences", nargs="+", metavar="NAME=FRAMES")
    parser.add_argument("-o", "--output", type=Path, required=True, help="a .webp, or a .mp4")
    parser.add_argument("--fps", type=float, default=24)
    parser.add_argument("--brighter", type=float, default=1, help="than a mean of 0.18: a factor")
    options = parser.parse_args(argv)
    named = [item.partition("=") for item in options.sequences]
    shots = {name: open_shot(frames, keep=0) for name, _, frames in named}
    numbers = sorted(set.intersection(*(set(shot.numbers) for shot in shots.values())))
    first, _ = replace_nonfinite(next(iter(shots.values())).read_color(numbers[0]))
    gain = np.float32(0.18 * options.brighter / measure_exposure(first))

    def picture(number: int) -> np.ndarray:
        panels = []
        for name, shot in shots.items():
            color, _ = replace_nonfinite(shot.read_color(number))
            panel = np.round(encode_srgb(color * gain) * 255).astype(np.uint8)
            labelled = Image.fromarray(panel)
            place, font = (8, panel.shape[0] - 8), ImageFont.load_default(16)
            # White with a black rim is read on any picture.
            ImageDraw.Draw(labelled).text(place, name, "white", font, anchor="ls", stroke_width=2, stroke_fill="black")
            panel = np.asarray(labelled)
            panels += [np.full((panel.shape[0], GAP, 3), 255, np.uint8), panel]
        return np.concatenate(panels[1:], axis=1)

    forward = [picture(number) for number in numbers]
    write_movie(options.output, forward + forward[-2:0:-1], options.fps)
    print(f"{options.output}: {options.output.stat().st_size / 1e6:.2f} MB, {2 * len(numbers) - 2} pictures")
    return 0


if __name__ == "__main__":
    raise SystemExit(main())
