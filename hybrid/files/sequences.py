"""Numbered files: patterns such as ``shot.####.exr`` in the notation of any program, folders, and frame ranges."""

import glob
import os
import re
import unicodedata
from collections.abc import Iterable, Iterator, Mapping
from contextlib import suppress
from dataclasses import dataclass, replace
from fnmatch import fnmatchcase
from itertools import pairwise
from pathlib import Path

from fileseq.frameset import FrameSet

# Place of the number: #### (Nuke, RV), @@@@, %04d (ffmpeg, Nuke), $F4 (Houdini), <frame04> and <F4> (Maya, Karma).
_PLACE = re.compile(r"(#+|@+)|%(\d*)d|\$(?:F(\d*)|\{F(\d*)\})|<(?:frame|f)(\d*)>", re.IGNORECASE)
_RANGE = r"\d+(?:--?\d+(?:[x:y]\d+)?)?(?:,-?\d+(?:--?\d+(?:[x:y]\d+)?)?)*"


@dataclass(frozen=True)
class Pattern:
    """The names of a sequence: `before`, a number of at least `digits` digits, `after`. Without digits: one name."""

    folder: Path
    before: str
    digits: int
    after: str = ""

    def path(self, number: int) -> Path:
        return self._names(number)[0] if self.digits else self.single

    def _names(self, number: int) -> list[Path]:
        """The possible names of a frame: the sign counts as a digit (``%04d``: -002), or not (Blender: -0002)."""
        texts = [f"{number:0{self.digits}d}", f"{'-' * (number < 0)}{abs(number):0{self.digits}d}"]
        return [self.folder / f"{self.before}{text}{self.after}" for text in dict.fromkeys(texts)]

    @property
    def single(self) -> Path:
        """The file of a pattern without a number."""
        return self.folder / self.before

    def files(self) -> dict[int, Path]:
        """Return frame number → existing file. If their numbers differ in width, the pattern's width decides.

        A name without a number is frame 1. Raises ValueError if two files have one number, or if a hyphen may be a sign
        or a part of the name.
        """
        if not self.digits:
            return {1: self.single} if self.single.is_file() else {}
        names = _names(self.folder)
        found = [(n, path) for path in names if (n := self.number(path.name)) is not None] or [*self._spelled(names)]
        shortest = min((len(path.name) for _, path in found), default=0) - len(self.before) - len(self.after)
        padded = replace(self, digits=max(shortest, 1))
        if any(path not in padded._names(n) for n, path in found):
            found = [(n, path) for n, path in found if path in self._names(n)]
        files: dict[int, Path] = {}
        for number, path in sorted(found):
            if number in files:
                raise ValueError(
                    f"{self}: frame {number} is {files[number].name} and {path.name}, expected one of them"
                )
            files[number] = path
        plain = replace(self, before=self.before.removesuffix("-"))
        signed = replace(self, before=f"{plain.before}-")
        if not _sign(plain.before) and any(plain.number(path.name) is not None for path in names):
            for path in names:
                if (count := signed.number(path.name)) is not None:
                    said = f"{path.name} may be frame {-count} of {plain} or frame {count} of {signed}"
                    raise ValueError(f"{self.folder}: {said}, expected a dot before the numbers, or two folders")
        return files

    def number(self, name: str) -> int | None:
        """Return the number in a file's name; None if it does not fit the pattern."""
        if not self.digits:
            return None
        match = re.fullmatch(f"{re.escape(self.before)}({_sign(self.before)}[0-9]+){re.escape(self.after)}", name)
        return int(match[1]) if match else None

    def _spelled(self, names: list[Path]) -> Iterator[tuple[int, Path]]:
        """Files whose names the file system takes for this pattern's, as Windows and macOS ignore case and accents."""
        before, after = _fold(self.before), _fold(self.after)
        for name in names:
            match = re.fullmatch(f"{re.escape(before)}({_sign(before)}[0-9]+){re.escape(after)}", _fold(name.name))
            if match and (path := self.folder / f"{self.before}{match[1]}{self.after}").exists():
                yield int(match[1]), path

    def __str__(self) -> str:
        return f"{self.before}{'#' * self.digits}{self.after}"


def find_files(spec: str) -> tuple[dict[int, Path], str | None]:
    """Find a sequence: return frame number → file of all existing frames, and the range in `spec`, if any.

    `spec` is a pattern (``shot.####.exr``, ``%04d``, ``$F4``, ``<frame04>``), with a range (``shot.####.exr 8-12`` as
    in Nuke, ``shot.8-12####.exr``), a folder that holds one sequence, a file, or a glob. Raises FileNotFoundError, with
    the sequences of the folder, if nothing matches; ValueError if several sequences match, `spec` is both a file and
    the pattern of others, or its hyphen would be a sign.
    """
    path = Path(spec)
    if path.is_dir():
        return _only(_patterns(_names(path)), spec, path).files(), None
    if path.is_file():
        if (called := parse_pattern(spec)[0]).digits and called.files():
            raise ValueError(f"{spec} is a file, and a pattern that others match; expected one or the other")
        number = pattern_of(path).number(path.name)
        return {1 if number is None else number: path}, None
    pattern, frames = parse_pattern(spec)
    if pattern.digits:
        bare = replace(pattern, before=pattern.before.removesuffix("-"))
        if bare != pattern and _sign(bare.before):
            raise ValueError(f"{spec}: the hyphen is the sign of negative numbers, expected the pattern {bare}")
        if files := pattern.files():
            return files, frames
        # A range within the name, unless a file has that name.
        match = re.fullmatch(rf"(.*?)((?:(?<![^\W_])-)?{_RANGE})", pattern.before)
        if match and "-" in match[2]:
            bare = Pattern(pattern.folder, match[1], pattern.digits, pattern.after)
            if files := bare.files():
                return files, match[2]
        raise FileNotFoundError(f"{spec}: no frame matches; {_listing(path.parent)}")
    names = _names(path.parent)
    fold = _fold if _ignores_case(names) else str
    matching = [name for name in names if fnmatchcase(fold(name.name), fold(path.name))]
    if matching:
        # All files of the sequence: neighbours need not match.
        pattern = _only(_patterns(matching), spec, path.parent)
        numbers = [number for name in matching if (number := pattern.number(name.name)) is not None]
        return pattern.files(), format_frames(numbers or [1])
    raise FileNotFoundError(f"{spec}: no such file; {_listing(path.parent)}")


def parse_pattern(spec: str) -> tuple[Pattern, str | None]:
    """Split a pattern at the last place for a number in its name; return also the range that follows it."""
    match = re.fullmatch(rf"(.*\S)\s+(-?{_RANGE})", spec)
    frames = match[2] if match and _PLACE.search(Path(match[1]).name) else None
    path = Path(match[1] if match and frames else spec)
    places = list(_PLACE.finditer(path.name))
    if not places:
        return Pattern(path.parent, path.name, 0), frames
    place = places[-1]
    digits = len(place[1]) if place[1] else int(next(filter(None, place.groups()[1:]), "1"))
    return Pattern(path.parent, path.name[: place.start()], max(digits, 1), path.name[place.end() :]), frames


def _fold(name: str) -> str:
    """A name without case, accents composed."""
    return unicodedata.normalize("NFC", name).casefold()


def _ignores_case(names: list[Path]) -> bool:
    """Whether the file system finds existing files by names in another case, as on Windows and macOS."""
    swapped = [name.with_name(name.name.swapcase()) for name in names[:1]]
    return any(path.name not in {name.name for name in names} and path.exists() for path in swapped)


def _names(folder: Path) -> list[Path]:
    if not folder.is_dir():
        return []
    with os.scandir(folder) as entries:
        names = [e.name for e in entries if e.name.lower().endswith(".exr") and not e.is_dir(follow_symlinks=False)]
    return sorted(folder / name for name in names if not name.startswith("."))


def find_views(spec: str) -> list[str]:
    """Return the stereo views with files for a pattern with %V (left) or %v (l), left first; [] for other patterns.

    Raises FileNotFoundError if no view has files.
    """
    if name_view(spec, "xx") == spec:
        return []
    pattern, _ = parse_pattern(spec)
    called = f"{pattern.folder / pattern.before}"
    expression = re.escape(called).replace("%V", "(?P<long>[A-Za-z]{2,})", 1).replace("%v", "(?P<short>[A-Za-z])", 1)
    expression = expression.replace("%V", "(?P=long)").replace("%v", "(?P=short)")
    expression += (rf"{_sign(pattern.before)}\d+" if pattern.digits else "") + re.escape(pattern.after)
    loose = glob.escape(called).replace("%V", "*").replace("%v", "?")
    loose += ("*" if pattern.digits else "") + glob.escape(pattern.after)
    found = [match for path in glob.glob(loose) if (match := re.fullmatch(expression, path))]
    if not found:
        # Where the file system ignores case, files in another case are those of the pattern.
        drive, rest = os.path.splitdrive(loose)
        rest = re.sub("[A-Za-z]", lambda letter: f"[{letter[0].lower()}{letter[0].upper()}]", rest)
        paths = glob.glob(drive + rest)
        found = [match for path in paths if (match := re.fullmatch(expression, path, re.IGNORECASE))]
        found = [match for match in found if Path(_respell(match, called, pattern.after)).exists()]
    views = {_view(match) for match in found}
    if not views:
        raise FileNotFoundError(
            f"{spec}: no view is there, expected files with left and right, or l and r, for %V or %v"
        )
    return sorted(views)


def _view(match: re.Match[str]) -> str:
    """The name of the view in a match of `find_views`, or its first letter."""
    return match.groupdict().get("long") or match.groupdict()["short"]


def _respell(match: re.Match[str], before: str, after: str) -> str:
    """The path of a match of `find_views` as the pattern spells it."""
    before = name_view(before, _view(match))
    return before + match[0][len(before) : len(match[0]) - len(after)] + after


def name_view(text: str, view: str) -> str:
    """Replace %V in a pattern by the name of a view, %v by its first letter."""
    return text.replace("%V", view).replace("%v", view[0])


def list_patterns(folder: Path) -> list[Pattern]:
    return _patterns(_names(folder))


def _patterns(paths: Iterable[Path]) -> list[Pattern]:
    """The sequences that files belong to."""
    groups: dict[tuple[str, str], list[tuple[Pattern, Path]]] = {}
    for path in paths:
        pattern = pattern_of(path)
        groups.setdefault((pattern.before, pattern.after), []).append((pattern, path))
    found: set[Pattern] = set()
    for group in groups.values():
        least = min((pattern for pattern, _ in group), key=lambda pattern: pattern.digits)
        same = all(path in least._names(least.number(path.name) or 0) for _, path in group)
        # Numbers that are padded differently are of different sequences.
        found |= {least} if same else {pattern for pattern, _ in group}
    return sorted(found, key=str)


def pattern_of(path: Path) -> Pattern:
    """Return the sequence of a file: its number is the last one in its name."""
    match = re.fullmatch(r"(.*?)([0-9]+)([^0-9]*)", path.name)
    if match is None:
        return Pattern(path.parent, path.name, 0)
    before, digits = match[1], len(match[2])
    if before.endswith("-") and _sign(before[:-1]):
        before, digits = before[:-1], digits + 1  # as "%04d" counts: -002, -001, 0000
    return Pattern(path.parent, before, digits, match[3])


def _sign(before: str) -> str:
    """A hyphen is a sign where it separates no name from its number: in a.-001, a -001 and -001, not in a-001."""
    return "" if before[-1:].isalnum() else "-?"


def _only(patterns: list[Pattern], spec: str, folder: Path) -> Pattern:
    if not patterns:
        raise FileNotFoundError(f"{spec}: no EXR files in this folder")
    if len(patterns) > 1:
        raise ValueError(f"{spec} holds several sequences, name one: {_listing(folder)}")
    return patterns[0]


def _listing(folder: Path) -> str:
    """The sequences of a folder for an error message, at most 8."""
    if not folder.is_dir():
        return f"there is no folder {str(folder)!r}"
    names = [_describe(pattern) for pattern in _patterns(_names(folder))]
    more = f" and {len(names) - 8} more" if len(names) > 8 else ""
    return f"{str(folder)!r} has {', '.join(sorted(names)[:8]) or 'no EXR files'}{more}"


def _describe(pattern: Pattern) -> str:
    """A pattern with the range of its frames, unless their numbers are ambiguous."""
    with suppress(ValueError):
        return f"{pattern} {format_frames(pattern.files())}" if pattern.digits else str(pattern)
    return str(pattern)


def parse_frames(frames: str) -> list[int]:
    """Return the frame numbers of a range like 1001-1010x2, ascending; raise ValueError if it is none."""
    try:
        numbers = list(FrameSet(frames))
    except (ValueError, ArithmeticError):  # the latter for numbers of hundreds of digits
        numbers = []
    if not numbers or any(number != int(number) for number in numbers):
        shown = frames if len(frames) < 60 else f"{frames[:56]}…"
        raise ValueError(f"frames {shown!r} is not a range of frames, expected one like 1001-1010x2")
    return sorted({int(number) for number in numbers})


def format_frames(numbers: Iterable[int] | Mapping[int, Path]) -> str:
    """Return the range of some frame numbers, such as 1001-1010x2."""
    return str(FrameSet(sorted(numbers)))


def name_holes(numbers: Iterable[int], step: int) -> str:
    """Name the ranges missing between frames, `step` apart; by their ends, as numbers that are dates leave millions."""
    holes = [range(a + step, b, step) for a, b in pairwise(sorted(numbers)) if b - a > step]
    names = [f"{h[0]}-{h[-1]}{f'x{step}' if step > 1 else ''}" if len(h) > 1 else f"{h[0]}" for h in holes]
    return ",".join(names[:8]) + (f" and {len(names) - 8} more ranges" if len(names) > 8 else "")
