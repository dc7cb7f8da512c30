"""Sidecar sequences that hold one layer each: a file or a folder for each AOV, RenderMan's variance file."""

import os
import re
from collections.abc import Collection, Iterator, Mapping, Sequence
from contextlib import suppress
from dataclasses import dataclass, replace
from pathlib import Path

from hybrid.files.exr import ExrError, ExrImage, Layer, read_exr
from hybrid.files.layers import find_layers, fit_sidecar
from hybrid.files.profile import COMMON, ROLES, Profile, find_profile, plain_name, read_profiles
from hybrid.files.sequences import Pattern, find_files, format_frames, list_patterns, pattern_of

# Roles that are read from a sequence that the user has not named: no other picture of the frame.
GUIDES = ("albedo", "normal", "depth", "motion", "motion_next", "variance")


@dataclass(frozen=True)
class SidecarSequence:
    """A sequence, named by `spec`, that holds the layer of one role; `layer` is its name if the files have several."""

    role: str
    spec: str
    files: Mapping[int, Path]
    layer: str | None = None

    def find(self, image: ExrImage, profile: Profile) -> Layer:
        """Return the layer in one of the files (`fit_sidecar`)."""
        return replace(fit_sidecar(image, self.role, self.layer, profile), file=self.spec)

    def expect(self, numbers: Sequence[int]) -> None:
        """Raise FileNotFoundError unless all these frames are there."""
        if missing := [number for number in numbers if number not in self.files]:
            there = f"it has {format_frames(self.files)}, expected all frames of the color"
            raise FileNotFoundError(f"{self.role} ({self.spec}): no frame {format_frames(missing)}; {there}")


def names_sequence(value: str) -> bool:
    """Whether a layer named by the user is a sequence: ``path/alb.####.exr``, also with ``:layer``, or a folder."""
    return re.search(r"\.exr(:|\s|$)", value, re.IGNORECASE) is not None or (
        len(Path(value).parts) > 1 and Path(value).is_dir()
    )


def open_sidecar(role: str, value: str) -> SidecarSequence:
    """Find a role's sequence, ``path/alb.####.exr`` or ``path/alb.####.exr:layer``; FileNotFoundError if missing."""
    match = re.fullmatch(r"(.*\.exr):(.+)", value, re.IGNORECASE)
    spec, layer = (match[1], match[2]) if match else (value, None)
    return SidecarSequence(role, value, find_files(spec)[0], layer)


def find_companions(
    files: Mapping[int, Path], named: Collection[str] = ()
) -> tuple[Profile | None, list[SidecarSequence]]:
    """Find the sidecars that a renderer writes next to the color's files, under names made from the color's name.

    Roles whose layers the user has `named`, and layers that the color's files hold themselves, are left out. The
    profile is that of the renderer, which a sidecar may reveal although the color's header does not. Raises ValueError
    if several sequences have the name of one layer.
    """
    color = pattern_of(files[min(files)])
    stem = color.before.rstrip("._-")
    for profile in read_profiles().values() if color.digits and stem else ():
        found: list[SidecarSequence] = []
        for name in dict.fromkeys(profile.files.values()):
            pattern = replace(color, before=name.replace("{name}", stem) + color.before[len(stem) :])
            numbered = pattern.files()
            if not numbered:
                continue
            image = read_exr(numbered[min(numbered)], pixels=False)
            if find_profile(image).name != profile.name:
                continue
            for role in [role for role, own_name in profile.files.items() if own_name == name]:
                with suppress(ExrError):  # not every file has every layer
                    sidecar = SidecarSequence(role, str(pattern), numbered)
                    sidecar.find(image, profile)
                    found.append(sidecar)
        if found:
            return replace(profile, why=f"{found[0].spec} beside it"), found
    return _find_elements(color, files, named)


def _find_elements(
    color: Pattern, files: Mapping[int, Path], named: Collection[str]
) -> tuple[Profile | None, list[SidecarSequence]]:
    """Guides in the color's folder, a sequence each, under names of their own (`_label_beside`)."""
    for sequences in _label_beside(color) if color.digits else ():
        assigned = _assign(sequences)
        if assigned is not None and (("", color) in sequences or color in assigned[1]["color"]):
            break
    else:
        return None, []
    try:
        image = read_exr(files[min(files)], pixels=False)
        known = find_layers(image)
    except (ExrError, OSError):  # raised again when the layers are needed
        return None, []
    profile, roles = assigned
    wanted = {role for role in GUIDES if role not in named and getattr(known, role) is None}
    missing = {role: found for role, found in roles.items() if role in wanted}
    sidecars = _only_each(color.folder, missing)
    why = f"{', '.join(other.spec for other in sidecars)} beside it"
    return (_profile_of(image, profile, why) if sidecars else None), sidecars


def _label_beside(color: Pattern) -> Iterator[list[tuple[str, Pattern]]]:
    """The color and the sequences in its folder, labeled by their own parts of their names.

    First those that begin with all of its name (``view.####.exr``, ``view.normals.####.exr``), then those that share
    less and less of its words (``sh_RGB.####.exr``, ``sh_ALBEDO.####.exr``).
    """
    beside = [p for p in list_patterns(color.folder) if (p.before, p.after) != (color.before, color.after)]
    yield [("", color), *((plain_name(rest), p) for p in beside if (rest := _rest(p, color)))]
    stem = _stem(color)
    for start in sorted({0, *(match.end() for match in re.finditer("[._-]", stem))}, reverse=True):
        others = [p for p in beside if _stem(p).startswith(stem[:start]) and p.after == color.after]
        yield [(plain_name(_stem(p)[start:]), p) for p in (color, *others)]


def gather_folder(folder: Path) -> tuple[dict[int, Path], Profile, list[SidecarSequence]] | None:
    """Find a shot in a folder that holds a sequence, or a folder, for each AOV, known by their names.

    Returns the color's files, the profile with these names, and the sidecars; None if no sequence has a name of the
    color. Raises ValueError if several sequences have the name of one layer.
    """
    direct = list_patterns(folder)
    if len(direct) == 2:
        for color, other in (direct, direct[::-1]):
            profile, sidecars = find_companions(color.files())
            if profile is not None and {companion.spec for companion in sidecars} == {str(other)}:
                return color.files(), profile, sidecars
    assigned = _assign(_label(folder, direct))
    if assigned is None:
        return None
    profile, roles = assigned
    first, *others = _only_each(folder, roles)  # the color, as in `ROLES`
    image = read_exr(first.files[min(first.files)], pixels=False)
    names = ", ".join(other.spec for other in (first, *others))
    return dict(first.files), _profile_of(image, profile, f"sequences {names}"), others


def _assign(sequences: Sequence[tuple[str, Pattern]]) -> tuple[Profile, dict[str, list[Pattern]]] | None:
    """The sequences by role, with the profile that names most of them; None without a color and another one."""
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
    """The only sequence of each role; raise ValueError if there are several."""
    for role, several in roles.items():
        if len(several) > 1:
            raise ValueError(f"{folder}: {role} can be {', '.join(map(str, several))}, expected one sequence")
    return [SidecarSequence(role, str(pattern), pattern.files()) for role, (pattern,) in roles.items()]


def _profile_of(image: ExrImage, profile: Profile, why: str) -> Profile:
    """The profile that fits the color's header, or else the one that has the names."""
    known = find_profile(image)
    return known if known.name != read_profiles()[COMMON].name else replace(profile, why=why)


def _stem(pattern: Pattern) -> str:
    """The name of a sequence without number and separator."""
    return pattern.before.removesuffix(".exr").rstrip("._-")


def _rest(pattern: Pattern, other: Pattern) -> str:
    """The part of a sequence's name that another lacks, before or after the number; "" if the other is no prefix."""
    name, stem = _stem(pattern), _stem(other)
    if pattern.after == other.after and stem and name.startswith((f"{stem}.", f"{stem}_", f"{stem}-")):
        return name[len(stem) :].lstrip("._-")
    if pattern.before == other.before and pattern.after.endswith(other.after):
        return pattern.after.removesuffix(other.after).strip("._-")
    return ""


def _label(folder: Path, direct: Sequence[Pattern]) -> list[tuple[str, Pattern]]:
    """The sequences in a folder, or in its folders, each with the part of its name that differs."""
    if len(direct) > 1:
        stems = [_stem(pattern) for pattern in direct]
        for color in direct:
            # The color may have no name of its own: view.####.exr beside view.normals.####.exr.
            rests = {pattern: _rest(pattern, color) for pattern in direct if pattern != color}
            if all(rests.values()):
                return [("", color), *((plain_name(rest), pattern) for pattern, rest in rests.items())]
        alike = os.path.commonprefix(stems)  # noqa: RUF071 - letter by letter
        # Whole words only: albedo and alpha begin alike.
        start = max(alike.rfind(separator) for separator in "._-") + 1
        return [(plain_name(stem[start:]), pattern) for stem, pattern in zip(stems, direct, strict=True)]
    found = []
    for sub in sorted(path for path in folder.iterdir() if path.is_dir() and not path.name.startswith(".")):
        inside = list_patterns(sub)
        if len(inside) == 1:
            found.append((plain_name(sub.name), inside[0]))
    return found
