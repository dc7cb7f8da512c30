"""Layers that lie in sequences of their own: a file for each AOV, a folder for each, RenderMan's variance file."""

from __future__ import annotations

import re
from collections.abc import Mapping, Sequence
from contextlib import suppress
from dataclasses import dataclass, replace
from itertools import takewhile
from pathlib import Path

from hybrid.files.exr import ExrError, ExrImage, Layer, read_exr
from hybrid.files.layers import fit_alone
from hybrid.files.profile import COMMON, ROLES, Profile, find_profile, plain_name, read_profiles
from hybrid.files.sequences import Pattern, find_files, format_frames, list_patterns, pattern_of


@dataclass(frozen=True)
class Apart:
    """A sequence that holds one layer of the shot.

    Attributes
    ----------
    role : str
        What the layer is to a denoiser.
    spec : str
        What names the sequence.
    files : mapping of int to Path
        Frame number → file.
    layer : str or None
        Name of the layer, where the files have several.
    """

    role: str
    spec: str
    files: Mapping[int, Path]
    layer: str | None = None

    def find(self, image: ExrImage, profile: Profile) -> Layer:
        """The layer in one of the files.

        Raises
        ------
        ExrError
            If there is none, or several could be it.
        """
        return replace(fit_alone(image, self.role, self.layer, profile), file=self.spec)

    def expect(self, numbers: Sequence[int]) -> None:
        """Raise FileNotFoundError unless all these frames are there."""
        if missing := [number for number in numbers if number not in self.files]:
            there = f"it has {format_frames(self.files)}"
            raise FileNotFoundError(f"{self.role} ({self.spec}): no frame {format_frames(missing)}; {there}")


def names_sequence(value: str) -> bool:
    """Whether a layer that the user names is a sequence: ``path/alb.####.exr``, with ``:layer``, or a folder's path."""
    return re.search(r"\.exr(:|\s|$)", value, re.IGNORECASE) is not None or (
        len(Path(value).parts) > 1 and Path(value).is_dir()
    )


def open_apart(role: str, value: str) -> Apart:
    """Find the sequence that the user names for a layer.

    Parameters
    ----------
    role : str
        Of the layer.
    value : str
        ``path/alb.####.exr`` or ``path/alb.####.exr:layer``.

    Returns
    -------
    Apart

    Raises
    ------
    FileNotFoundError
        If there is none.
    """
    match = re.fullmatch(r"(.*\.exr):(.+)", value, re.IGNORECASE)
    spec, layer = (match[1], match[2]) if match else (value, None)
    return Apart(role, value, find_files(spec)[0], layer)


def find_companions(files: Mapping[int, Path]) -> tuple[Profile | None, list[Apart]]:
    """Sequences that a renderer writes beside the color's, under names made from its name.

    Returns
    -------
    Profile or None
        The renderer, which its other file tells where the color's may not.
    list of Apart
        A layer each; those that the other files do not have are left out.
    """
    own = pattern_of(files[min(files)])
    stem = own.before.rstrip("._-")
    for profile in read_profiles().values() if own.digits and stem else ():
        found: list[Apart] = []
        for name in dict.fromkeys(profile.files.values()):
            beside = replace(own, before=name.replace("{name}", stem) + own.before[len(stem) :])
            numbered = beside.files()
            if not numbered:
                continue
            image = read_exr(numbered[min(numbered)], pixels=False)
            if find_profile(image).name != profile.name:
                continue
            for role in [role for role, own_name in profile.files.items() if own_name == name]:
                with suppress(ExrError):  # not every file has every layer
                    apart = Apart(role, str(beside), numbered)
                    apart.find(image, profile)
                    found.append(apart)
        if found:
            return replace(profile, why=f"{found[0].spec} beside it"), found
    return None, []


def gather_folder(folder: Path) -> tuple[dict[int, Path], Profile, list[Apart]] | None:
    """Gather a shot that lies in a folder as a sequence, or a folder, for each AOV, known by their names.

    Parameters
    ----------
    folder : Path
        Of files.

    Returns
    -------
    tuple of dict, Profile and list of Apart, optional
        Its files, whose names they are, and the others. None where no sequence is known as the color by its name.

    Raises
    ------
    ValueError
        If several sequences have the name of one layer.
    """
    direct = list_patterns(folder)
    if len(direct) == 2:
        for color, other in (direct, direct[::-1]):
            profile, apart = find_companions(color.files())
            if profile is not None and {companion.spec for companion in apart} == {str(other)}:
                return color.files(), profile, apart
    sequences = _label(folder, direct)
    best: tuple[Profile, dict[str, list[Pattern]]] | None = None
    score = (0, 0)
    for profile in read_profiles().values():
        roles = {role: [p for label, p in sequences if label and label in profile.names(role)] for role in ROLES}
        if not roles["color"]:
            roles["color"] = [pattern for label, pattern in sequences if not label]
        labels = [label for label, _ in sequences]
        typical = sum(plain_name(name) in labels for name in profile.known_layers)
        this = typical, sum(map(bool, roles.values()))
        if roles["color"] and this > score:
            best, score = (profile, {role: found for role, found in roles.items() if found}), this
    if best is None or score[1] < 2:
        return None
    profile, found = best
    for role, several in found.items():
        if len(several) > 1:
            raise ValueError(f"{folder}: {role} can be {', '.join(map(str, several))}, expected one sequence")
    (color,) = found.pop("color")
    apart = [Apart(role, str(pattern), pattern.files()) for role, (pattern,) in found.items()]
    known = find_profile(read_exr(next(iter(color.files().values())), pixels=False))
    names = ", ".join(str(pattern) for pattern in (color, *(p for (p,) in found.values())))
    taken = known if known.name != read_profiles()[COMMON].name else replace(profile, why=f"sequences {names}")
    return color.files(), taken, apart


def _label(folder: Path, direct: Sequence[Pattern]) -> list[tuple[str, Pattern]]:
    """The sequences in a folder, or in its folders, each with the part of its name that tells it from the others."""
    if len(direct) > 1:
        stems = [pattern.before.removesuffix(".exr").rstrip("._-") for pattern in direct]
        alike = "".join(
            letters[0] for letters in takewhile(lambda letters: len({*letters}) == 1, zip(*stems, strict=False))
        )
        # Whole words only: albedo and alpha begin alike.
        start = max(alike.rfind(separator) for separator in "._-") + 1
        return [(plain_name(stem[start:]), pattern) for stem, pattern in zip(stems, direct, strict=True)]
    found = []
    for sub in sorted(path for path in folder.iterdir() if path.is_dir() and not path.name.startswith(".")):
        inside = list_patterns(sub)
        if len(inside) == 1:
            found.append((plain_name(sub.name), inside[0]))
    return found
