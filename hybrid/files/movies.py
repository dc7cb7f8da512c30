"""Movies: MP4 by PyAV, animated WebP by Pillow."""

import importlib.util
from collections.abc import Iterable, Iterator
from fractions import Fraction
from itertools import chain
from pathlib import Path

import numpy as np
from PIL import Image

from hybrid.files.png import Image8, fit
from hybrid.files.replace import replace_file

# The largest width or height of a picture: a movie fills a screen, a loop stands in a page.
LARGEST = {".mp4": 1920, ".webp": 960}


def check_movie(path: Path) -> None:
    """Raise ValueError for a name that does not end in .mp4 or .webp, ImportError if PyAV is needed and missing."""
    if path.suffix.lower() not in LARGEST:
        raise ValueError(f"{path} is no movie, expected a name that ends in {' or '.join(LARGEST)}")
    if path.suffix.lower() == ".mp4" and importlib.util.find_spec("av") is None:
        raise ImportError(f'{path} needs PyAV, which is not installed; expected: pip install "av"')


def write_movie(path: Path, pictures: Iterable[Image8], rate: float) -> None:
    """Write sRGB pictures (H, W, 3) of one size as a movie, and make its folder; errors are those of `check_movie`.

    The name ends in .mp4 (H.264, for any player and browser) or .webp (loops in a page). Sizes above `LARGEST` are
    reduced.
    """
    check_movie(path)
    path.parent.mkdir(parents=True, exist_ok=True)
    suffix = path.suffix.lower()
    fitted = (fit(picture, LARGEST[suffix]) for picture in pictures)
    with replace_file(path) as temporary:
        if suffix == ".mp4":
            _write_mp4(temporary, fitted, rate)
        else:
            _write_webp(temporary, fitted, rate)


def _write_mp4(path: Path, pictures: Iterator[Image8], rate: float) -> None:
    import av
    from av.video.reformatter import ColorRange, Colorspace

    first = next(pictures)
    # H.264 with chroma at half resolution, the format that all players decode, needs even sizes.
    height, width = (side + side % 2 for side in first.shape[:2])
    with av.open(str(path), "w", format="mp4", options={"movflags": "faststart"}) as container:
        stream = container.add_stream("libx264", rate=Fraction(rate).limit_denominator(1001))
        stream.width, stream.height, stream.pix_fmt = width, height, "yuv420p"
        stream.options = {"crf": "20", "preset": "veryfast"}
        context = stream.codec_context
        context.color_range, context.colorspace = ColorRange.MPEG, Colorspace.ITU709
        context.color_primaries = context.color_trc = 1  # BT.709, as the matrix above
        for picture in chain([first], pictures):
            padding = ((0, height - picture.shape[0]), (0, width - picture.shape[1]), (0, 0))
            even = np.pad(picture, padding, mode="edge") if (height, width) != picture.shape[:2] else picture
            frame = av.VideoFrame.from_ndarray(np.ascontiguousarray(even), format="rgb24").reformat(
                format="yuv420p",
                src_color_range=ColorRange.JPEG,
                dst_color_range=ColorRange.MPEG,
                dst_colorspace=Colorspace.ITU709,
            )
            container.mux(stream.encode(frame))
        container.mux(stream.encode())


def _write_webp(path: Path, pictures: Iterator[Image8], rate: float) -> None:
    first, *later = (Image.fromarray(picture) for picture in pictures)
    # Durations in whole milliseconds that add up to the exact time.
    ends = np.round(np.arange(len(later) + 2) * 1000 / rate).astype(int)
    first.save(
        path,
        format="webp",
        save_all=True,
        append_images=later,
        duration=np.diff(ends).tolist(),
        loop=0,
        quality=75,
        method=2,
    )
