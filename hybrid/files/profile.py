"""Profiles: what each renderer calls its layers, what its vectors and its variance mean, and how its files are known.

A profile is a TOML file. Those in `profiles/` come with ravg; the user's own are in the folder `profiles` of ravg's
configuration folder, or given with `--profile`. docs/renderers.md tells how to write one.
"""

from __future__ import annotations

import tomllib
from collections.abc import Iterable, Mapping
from contextlib import suppress
from dataclasses import dataclass, field, fields, replace
from fnmatch import fnmatchcase
from functools import lru_cache
from pathlib import Path
from typing import Any

from flow.motion import CYCLES, DIRECTIONS, ENCODINGS, UNITS, VERTICAL, MotionConvention
from hybrid.files.exr import ExrImage

# What a layer may be to a denoiser.
ROLES = (
    "color",
    "albedo",
    "normal",
    "depth",
    "motion",
    "motion_next",
    "variance",
    "half_a",
    "half_b",
    "alpha",
    "estimate",
)
_SHIPPED = Path(__file__).parent / "profiles"
# What layers are called where no profile is found, and after what a profile calls them.
COMMON = "common"
_PARTS = tuple(part.name for part in fields(MotionConvention))
_MEANINGS = ("mean", "sample")


@dataclass(frozen=True)
class Profile:
    """What one renderer writes.

    Attributes
    ----------
    name : str
        Of the renderer.
    attributes : tuple of str
        Header attributes that its files have, as ``name`` or ``name=value``; ``*`` stands for anything.
    known_layers : tuple of str
        Names of layers that hardly any other renderer writes.
    layers : mapping of str to tuple of str
        Role → names, the preferred first; "" for the bare channels of a file.
    affixes : tuple of str
        What may stand before or after these names.
    files : mapping of str to str
        Role → name of the sequence that holds it, where that is not the color's: ``{name}`` stands for the color's.
    motion : mapping of str to object
        Parts of `flow.motion.MotionConvention` that are documented.
    motion_assumed : mapping of str to object
        Parts that were only inferred.
    variance : str or None
        "mean": the variance of a pixel; "sample": of its samples; None where that is not known.
    samples : str or None
        The header attribute that holds the samples of a pixel; ``*`` stands for anything.
    why : str
        Why it was taken.
    typed : frozenset of str
        The parts of `motion` that the user has stated.
    """

    name: str
    attributes: tuple[str, ...] = ()
    known_layers: tuple[str, ...] = ()
    layers: Mapping[str, tuple[str, ...]] = field(default_factory=dict)
    affixes: tuple[str, ...] = ()
    files: Mapping[str, str] = field(default_factory=dict)
    motion: Mapping[str, Any] = field(default_factory=dict)
    motion_assumed: Mapping[str, Any] = field(default_factory=dict)
    variance: str | None = None
    samples: str | None = None
    why: str = "asked for"
    typed: frozenset[str] = frozenset()

    def convention(self, channels: int) -> MotionConvention:
        """What vectors of so many channels mean, as far as is known or assumed."""
        stated = {**self.motion_assumed, **self.motion}
        if channels >= 4 and "direction" not in stated:
            # Two vectors a pixel; Blender writes them so, and nobody else is known to.
            stated = {"direction": CYCLES.direction, "y": CYCLES.y, **stated}
        return MotionConvention(**stated)

    @property
    def settled(self) -> frozenset[str]:
        """The parts of the convention that are documented."""
        # Nobody is known to shift vectors otherwise than their encoding tells, and MoonRay alone to multiply them.
        return frozenset({*self.motion, "offset", "premultiplied"})

    def with_motion(self, words: str) -> Profile:
        """The same with motion as the user says it (`parse_motion`); with "auto", nothing of it is settled.

        Raises
        ------
        ValueError
            If the words are none of a convention.
        """
        if words == "auto":
            return replace(self, motion={}, motion_assumed={**self.motion_assumed, **self.motion})
        parts = parse_motion(words)
        MotionConvention(**{**self.motion_assumed, **self.motion, **parts})
        return replace(self, motion={**self.motion, **parts}, typed=frozenset(parts))

    def own_names(self, role: str) -> tuple[str, ...]:
        """What the renderer calls layers of a role, plain (`plain_name`), the preferred first."""
        own = self.layers.get(role, ())
        affixed = [text for name in own if name for affix in self.affixes for text in (affix + name, name + affix)]
        return tuple(dict.fromkeys(plain_name(name) for name in (*own, *affixed)))

    def names(self, role: str) -> tuple[str, ...]:
        """The same, and after that what others call them."""
        common = read_profiles()[COMMON].layers.get(role, ())
        return tuple(dict.fromkeys((*self.own_names(role), *map(plain_name, common))))


def parse_motion(words: str) -> dict[str, Any]:
    """Parts of a `flow.motion.MotionConvention`, from words such as ``next,ndc,y-up,scale=2``.

    Raises
    ------
    ValueError
        If a word is unknown, or says what another has said.
    """
    tables = {"direction": DIRECTIONS, "unit": UNITS, "encoding": ENCODINGS}
    known: dict[str, tuple[str, Any]] = {word: (part, word) for part, table in tables.items() for word in table}
    known |= {f"y-{side}": ("y", side) for side in VERTICAL} | {"premultiplied": ("premultiplied", True)}
    parts: dict[str, Any] = {}
    for word in filter(None, (text.strip() for text in words.split(","))):
        part, value = known.get(word, ("", ""))
        name, equals, number = word.partition("=")
        if equals and name in ("scale", "offset"):
            with suppress(ValueError):
                part, value = name, float(number)
        if not part:
            expected = f"{', '.join(known)}, scale=NUMBER, offset=NUMBER, auto or none"
            raise ValueError(f"motion has {word!r}, expected some of {expected}")
        if part in parts:
            raise ValueError(f"motion says its {part} twice, expected one of {parts[part]} and {value}")
        parts[part] = value
    MotionConvention(**parts)  # refuses numbers that are none of a convention
    return parts


def plain_name(name: str) -> str:
    """A name without what differs from one exporter to the next: case, blanks, hyphens and underscores."""
    return "".join(c for c in name.lower() if c not in " _-")


def read_profile(path: str | Path) -> Profile:
    """Read a profile.

    Raises
    ------
    OSError
        If there is no such file.
    ValueError
        If it is no TOML, is nested too deeply, or has a key, a role or a value that profiles do not have; names the
        file.
    """
    path = Path(path)
    try:
        table = tomllib.loads(path.read_text(encoding="utf-8"))
    except (tomllib.TOMLDecodeError, UnicodeDecodeError, RecursionError) as error:
        raise ValueError(f"{path}: not a profile: {error}") from None
    try:
        return _profile(path.stem, table)
    except (ValueError, TypeError) as error:
        raise ValueError(f"{path}: {error}") from None


def _profile(stem: str, table: dict[str, Any]) -> Profile:
    name = table.pop("name", stem)
    found, layers, files, motion, variance = (
        _table(table, key) for key in ("found", "layers", "files", "motion", "variance")
    )
    _refuse_rest(table, "profile", ("name", "found", "layers", "files", "motion", "variance"))
    attributes, known = _texts(found, "attributes"), _texts(found, "layers")
    _refuse_rest(found, "[found]", ("attributes", "layers"))
    affixes = _texts(layers, "affixes")
    _refuse_rest(dict.fromkeys(set(layers) - set(ROLES)), "[layers]", ("affixes", *ROLES))
    _refuse_rest(dict.fromkeys(set(files) - set(ROLES)), "[files]", ROLES)
    assumed = _table(motion, "assumed")
    for part in (motion, assumed):
        _refuse_rest(dict.fromkeys(set(part) - set(_PARTS)), "[motion]", ("assumed", *_PARTS))
    of, samples = variance.pop("of", None), variance.pop("samples", None)
    _refuse_rest(variance, "[variance]", ("of", "samples"))
    if of is not None and of not in _MEANINGS:
        raise ValueError(f"variance is of {of!r}, expected one of {', '.join(_MEANINGS)}")
    MotionConvention(**{**assumed, **motion})  # refuses what is no convention
    return Profile(
        name=str(name),
        attributes=attributes,
        known_layers=known,
        layers={role: _texts(layers, role) for role in list(layers)},
        affixes=affixes,
        files={role: str(pattern) for role, pattern in files.items()},
        motion=motion,
        motion_assumed=assumed,
        variance=of,
        samples=None if samples is None else str(samples),
    )


def _table(table: dict[str, Any], key: str) -> dict[str, Any]:
    value = table.pop(key, {})
    if not isinstance(value, dict):
        raise ValueError(f"{key} is {value!r}, expected a table, [{key}]")
    return value


def _texts(table: dict[str, Any], key: str) -> tuple[str, ...]:
    value = table.pop(key, [])
    if not isinstance(value, list) or not all(isinstance(item, str) for item in value):
        raise ValueError(f"{key} is {value!r}, expected a list of names")
    return tuple(value)


def _refuse_rest(table: Mapping[str, Any], where: str, known: Iterable[str]) -> None:
    for key in sorted(table):
        raise ValueError(f"{where} has {key!r}, expected some of {', '.join(known)}")


def user_folder() -> Path:
    """Where the user's own profiles are looked for."""
    import typer

    return Path(typer.get_app_dir("ravg")) / "profiles"


@lru_cache(maxsize=1)
def read_profiles() -> dict[str, Profile]:
    """All profiles by the names of their files: the user's own, then those that come with ravg."""
    own, shipped = (sorted(folder.glob("*.toml")) for folder in (user_folder(), _SHIPPED))
    return {path.stem: read_profile(path) for path in [*shipped, *own]}


def open_profile(spec: str) -> Profile:
    """The profile with this name, or in this file.

    Raises
    ------
    ValueError
        If there is none, or the file is no profile.
    """
    if spec in read_profiles():
        return read_profiles()[spec]
    if Path(spec).is_file():
        return read_profile(spec)
    raise ValueError(f"profile is {spec!r}, expected a file, or one of {', '.join(sorted(read_profiles()))}")


def find_profile(image: ExrImage) -> Profile:
    """The profile that fits a file best; it says why.

    Notes
    -----
    An attribute of the header counts most, then the names of layers that only one renderer writes. Among equals it is
    the one that knows what more of the layers are, then the user's own.
    """
    header = {name: f"{name}={value}" for part in image.parts for name, value in part.header.items()}
    names = {plain_name(token) for layer in image.layers for token in _tails(layer.name)}
    names |= {plain_name(channel.rpartition(".")[2]) for channel in image.channel_names}
    best, why, score = read_profiles()[COMMON], "no renderer is known by its header or its layers", (0, 0, 0)
    for profile in read_profiles().values():
        known = sorted(
            name
            for name, said in header.items()
            if any(fnmatchcase(said if "=" in pattern else name, pattern) for pattern in profile.attributes)
        )
        typical = [name for name in profile.known_layers if plain_name(name) in names]
        roles = sum(any(name in names for name in map(plain_name, own)) for own in profile.layers.values())
        this = len(known[:1]), len(typical), roles
        if this[:2] > (0, 0) and this >= score:
            best, score = profile, this
            why = f"header attribute {known[0]}" if known else f"layer {typical[0]}"
    return replace(best, why=why)


def _tails(name: str) -> list[str]:
    tail = name.rpartition(".")[2]
    return [tail] if tail else []
