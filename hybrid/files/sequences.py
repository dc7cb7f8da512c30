"""Numbered files: patterns such as ``shot.####.exr``, folders, and ranges of frames."""

from __future__ import annotations

from collections.abc import Iterable
from pathlib import Path

import fileseq

# One "#" or "@" is one digit, as in Nuke, RV and ffmpeg's %04d.
PADDING = fileseq.PAD_STYLE_HASH1


def find_files(spec: str) -> dict[int, Path]:
    """Frame number → file."""
    path = Path(spec)
    if path.is_dir():
        sequences = _sequences(path)
        if not sequences:
            raise FileNotFoundError(f"{spec}: no EXR files in this folder")
        if len(sequences) > 1:
            raise ValueError(f"{spec} holds several sequences, name one: {_listing(path)}")
        return _files(sequences[0])
    sequence = fileseq.FileSequence(spec, pad_style=PADDING)
    if path.is_file():
        return {int(sequence.start()) if sequence.frameSet() else 1: path}
    if not sequence.padding() or sequence.frameSet():
        raise FileNotFoundError(f"{spec}: no such file; {_listing(path.parent)}")
    for strict in (False, True):  # files with one name and two widths of numbers: the pattern's width decides
        try:
            return _files(fileseq.FileSequence.findSequenceOnDisk(spec, strictPadding=strict, pad_style=PADDING))
        except fileseq.FileSeqException:
            continue
    raise FileNotFoundError(f"{spec}: no frame matches; {_listing(path.parent)}")


def _sequences(folder: Path) -> list[fileseq.FileSequence]:
    found = fileseq.FileSequence.findSequencesOnDisk(str(folder), pad_style=PADDING)
    return [sequence for sequence in found if sequence.extension().lower() == ".exr"]


def _files(sequence: fileseq.FileSequence) -> dict[int, Path]:
    numbers = sequence.frameSet()
    if numbers is None:
        return {1: Path(str(sequence))}
    return {int(number): Path(sequence.frame(number)) for number in numbers}


def _listing(folder: Path) -> str:
    """What a folder has, for an error message; shortened if there is much of it."""
    if not folder.is_dir():
        return f"there is no folder {str(folder)!r}"
    names = [f"{s.basename()}{s.padding()}{s.extension()} {s.frameRange()}".strip() for s in _sequences(folder)]
    more = f" and {len(names) - 8} more" if len(names) > 8 else ""
    return f"{str(folder)!r} has {', '.join(sorted(names)[:8]) or 'no EXR files'}{more}"


def parse_frames(frames: str) -> list[int]:
    """Ascending frame numbers of a range like 1001-1010x2."""
    try:
        numbers = list(fileseq.FrameSet(frames))
    except ValueError:
        numbers = []
    if not numbers or any(number != int(number) for number in numbers):
        raise ValueError(f"frames {frames!r} is not a range of frames, expected one like 1001-1010x2")
    return sorted({int(number) for number in numbers})


def format_frames(numbers: Iterable[int]) -> str:
    return str(fileseq.FrameSet(sorted(numbers)))
