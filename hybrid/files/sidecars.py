"""Layers that lie in sequences of their own: a file for each AOV, a folder for each, RenderMan's variance file."""

from __future__ import annotations

import re
from collections.abc import Collection, Mapping, Sequence
from contextlib import suppress
from dataclasses import dataclass, replace
from itertools import takewhile
from pathlib import Path

from hybrid.files.exr import ExrError, ExrImage, Layer, read_exr
from hybrid.files.layers import find_layers, fit_sidecar
from hybrid.files.profile import COMMON, ROLES, Profile, find_profile, plain_name, read_profiles
from hybrid.files.sequences import Pattern, find_files, format_frames, list_patterns, pattern_of

# What is taken from a sequence that the user has not named: no other picture of the frame.
GUIDES = ("albedo", "normal", "depth", "motion", "motion_next", "variance")


@dataclass(frozen=True)
class SidecarSequence:
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
        return replace(fit_sidecar(image, self.role, self.layer, profile), file=self.spec)

    def expect(self, numbers: Sequence[int]) -> None:
        """Raise FileNotFoundError unless all these frames are there."""
        if missing := [number for number in numbers if number not in self.files]:
            there = f"it has {format_frames(self.files)}, expected all frames of the color"
            raise FileNotFoundError(f"{self.role} ({self.spec}): no frame {format_frames(missing)}; {there}")


def names_sequence(value: str) -> bool:
    """Whether a layer that the user names is a sequence: ``path/alb.####.exr``, with ``:layer``, or a folder's path."""
    return re.search(r"\.exr(:|\s|$)", value, re.IGNORECASE) is not None or (
        len(Path(value).parts) > 1 and Path(value).is_dir()
    )


def open_sidecar(role: str, value: str) -> SidecarSequence:
    """Find the sequence that the user names for a layer.

    Parameters
    ----------
    role : str
        Of the layer.
    value : str
        ``path/alb.####.exr`` or ``path/alb.####.exr:layer``.

    Returns
    -------
    SidecarSequence

    Raises
    ------
    FileNotFoundError
        If there is none.
    """
    match = re.fullmatch(r"(.*\.exr):(.+)", value, re.IGNORECASE)
    spec, layer = (match[1], match[2]) if match else (value, None)
    return SidecarSequence(role, value, find_files(spec)[0], layer)


def find_companions(
    files: Mapping[int, Path], named: Collection[str] = ()
) -> tuple[Profile | None, list[SidecarSequence]]:
    """Sequences that a renderer writes beside the color's, under names made from its name.

    Parameters
    ----------
    files : mapping of int to Path
        Those of the color.
    named : collection of str
        Roles whose layers the user names, which are not searched for.

    Returns
    -------
    Profile or None
        The renderer, which its other file tells where the color's may not.
    list of SidecarSequence
        A layer each; those that the other files do not have, or that the color's files have themselves, are left out.

    Raises
    ------
    ValueError
        If several sequences have the name of one layer.
    """
    own = pattern_of(files[min(files)])
    stem = own.before.rstrip("._-")
    for profile in read_profiles().values() if own.digits and stem else ():
        found: list[SidecarSequence] = []
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
                    apart = SidecarSequence(role, str(beside), numbered)
                    apart.find(image, profile)
                    found.append(apart)
        if found:
            return replace(profile, why=f"{found[0].spec} beside it"), found
    return _find_elements(own, files, named)


def _find_elements(
    own: Pattern, files: Mapping[int, Path], named: Collection[str]
) -> tuple[Profile | None, list[SidecarSequence]]:
    """Guides that lie beside the color, a sequence each, under its name and their own (``view.normals.####.exr``)."""
    beside = [(plain_name(rest), p) for p in list_patterns(own.folder) if (rest := _rest(p, own))]
    if not own.digits or not beside:
        return None, []
    try:
        image = read_exr(files[min(files)], pixels=False)
        known = find_layers(image)
    except (ExrError, OSError):  # said where the layers are needed
        return None, []
    assigned = _assign([("", own), *beside])
    if assigned is None:
        return None, []
    profile, roles = assigned
    wanted = {role for role in GUIDES if role not in named and getattr(known, role) is None}
    missing = {role: found for role, found in roles.items() if role in wanted}
    apart = _only_each(own.folder, missing)
    why = f"{', '.join(other.spec for other in apart)} beside it"
    return (_told_by(image, profile, why) if apart else None), apart


def gather_folder(folder: Path) -> tuple[dict[int, Path], Profile, list[SidecarSequence]] | None:
    """Gather a shot that lies in a folder as a sequence, or a folder, for each AOV, known by their names.

    Parameters
    ----------
    folder : Path
        Of files.

    Returns
    -------
    tuple of dict, Profile and list of SidecarSequence, optional
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
    assigned = _assign(_label(folder, direct))
    if assigned is None:
        return None
    profile, roles = assigned
    first, *others = _only_each(folder, roles)  # the color, as in `ROLES`
    image = read_exr(first.files[min(first.files)], pixels=False)
    names = ", ".join(other.spec for other in (first, *others))
    return dict(first.files), _told_by(image, profile, f"sequences {names}"), others


def _assign(sequences: Sequence[tuple[str, Pattern]]) -> tuple[Profile, dict[str, list[Pattern]]] | None:
    """The sequences by their roles, as the profile has them that knows most; None without a color and another."""
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
    return best if score[1] > 1 else None


def _only_each(folder: Path, roles: Mapping[str, Sequence[Pattern]]) -> list[SidecarSequence]:
    """The one sequence of each role; raise ValueError where there are several."""
    for role, several in roles.items():
        if len(several) > 1:
            raise ValueError(f"{folder}: {role} can be {', '.join(map(str, several))}, expected one sequence")
    return [SidecarSequence(role, str(pattern), pattern.files()) for role, (pattern,) in roles.items()]


def _told_by(image: ExrImage, profile: Profile, why: str) -> Profile:
    """The profile that the color's header tells, or else the one that knows the names, and why."""
    known = find_profile(image)
    return known if known.name != read_profiles()[COMMON].name else replace(profile, why=why)


def _stem(pattern: Pattern) -> str:
    """The name of a sequence, without its number and without what separates them."""
    return pattern.before.removesuffix(".exr").rstrip("._-")


def _rest(pattern: Pattern, other: Pattern) -> str:
    """What the name of a sequence has beyond that of another, before or behind the number; "" where that has more."""
    name, stem = _stem(pattern), _stem(other)
    if pattern.after == other.after and stem and name.startswith((f"{stem}.", f"{stem}_", f"{stem}-")):
        return name[len(stem) :].lstrip("._-")
    if pattern.before == other.before and pattern.after.endswith(other.after):
        return pattern.after.removesuffix(other.after).strip("._-")
    return ""


def _label(folder: Path, direct: Sequence[Pattern]) -> list[tuple[str, Pattern]]:
    """The sequences in a folder, or in its folders, each with the part of its name that tells it from the others."""
    if len(direct) > 1:
        stems = [_stem(pattern) for pattern in direct]
        for color in direct:
            # It has no name of its own: view.####.exr beside view.normals.####.exr.
            rests = {pattern: _rest(pattern, color) for pattern in direct if pattern != color}
            if all(rests.values()):
                return [("", color), *((plain_name(rest), pattern) for pattern, rest in rests.items())]
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
