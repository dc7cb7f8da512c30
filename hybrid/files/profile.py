"""Profiles: a renderer's names of layers, its conventions of vectors and variance, and how its files are recognized.

A profile is a TOML file. Those in `profiles/` come with ravg; the user's own are in the folder `profiles` of ravg's
configuration folder, or given with `--profile`. docs/renderers.md explains how to write one.
"""

import tomllib
from collections.abc import Mapping, Sequence
from contextlib import suppress
from dataclasses import dataclass, field, fields, replace
from fnmatch import fnmatchcase
from functools import lru_cache
from pathlib import Path
from typing import Any, Self

from flow.motion import CYCLES, DIRECTIONS, ENCODINGS, UNITS, VERTICAL, MotionConvention
from hybrid.files.exr import ExrImage

# Roles of layers, with what is said of them (`roles.toml`).
ROLE_FACTS: dict[str, dict[str, Any]] = tomllib.loads((Path(__file__).parent / "roles.toml").read_text("utf-8"))
ROLES = tuple(ROLE_FACTS)
_SHIPPED = Path(__file__).parent / "profiles"
# Names of layers if no profile is found, and after a profile's own names.
COMMON = "common"
_PARTS = tuple(part.name for part in fields(MotionConvention))
_MEANINGS = ("mean", "sample")
# Tables of a profile, with their keys.
_KEYS: dict[str, tuple[str, ...]] = {
    "found": ("attributes", "layers"),
    "layers": ("affixes", *ROLES),
    "files": ROLES,
    "motion": ("assumed", *_PARTS),
    "variance": ("of", "samples"),
}


@dataclass(frozen=True)
class Profile:
    """Names and conventions of one renderer."""

    name: str
    # header attributes of its files, as ``name`` or ``name=value``; ``*`` matches anything
    attributes: tuple[str, ...] = ()
    known_layers: tuple[str, ...] = ()  # names of layers that hardly any other renderer writes
    # role → names, the preferred first; "" for the bare channels of a file
    layers: Mapping[str, tuple[str, ...]] = field(default_factory=dict)
    affixes: tuple[str, ...] = ()  # text before or after these names
    # role → name of its sidecar sequence; ``{name}`` stands for the color's name
    files: Mapping[str, str] = field(default_factory=dict)
    # parts of `flow.motion.MotionConvention` that are documented, and that are inferred
    motion: Mapping[str, Any] = field(default_factory=dict)
    motion_assumed: Mapping[str, Any] = field(default_factory=dict)
    variance: str | None = None  # "mean": the variance of a pixel; "sample": of its samples; None if unknown
    samples: str | None = None  # header attribute of the samples per pixel; ``*`` matches anything
    why: str = "asked for"  # why the profile was chosen
    typed: frozenset[str] = frozenset()  # parts of `motion` that the user states
    file: Path | None = None

    def convention(self, channels: int) -> MotionConvention:
        """Return the convention of vectors with so many channels, as far as documented or assumed."""
        stated = {**self.motion_assumed, **self.motion}
        if channels >= 4 and "direction" not in stated:
            # Two vectors a pixel; only Blender is known to write them.
            stated = {"direction": CYCLES.direction, "y": CYCLES.y, **stated}
        return MotionConvention(**stated)

    @property
    def settled(self) -> frozenset[str]:
        """The parts of the convention that are documented."""
        # No renderer is known to shift vectors otherwise than by their encoding, and only MoonRay premultiplies them.
        return frozenset({*self.motion, "offset", "premultiplied"})

    def with_motion(self, words: str) -> Self:
        """Return the profile with the user's motion convention (`parse_motion`); "auto" settles no part of it."""
        if words == "auto":
            return replace(self, motion={}, motion_assumed={**self.motion_assumed, **self.motion})
        parts = parse_motion(words)
        MotionConvention(**{**self.motion_assumed, **self.motion, **parts})
        return replace(self, motion={**self.motion, **parts}, typed=frozenset(parts))

    def own_names(self, role: str) -> tuple[str, ...]:
        """Return the renderer's names of a role, plain (`plain_name`), the preferred first."""
        own = self.layers.get(role, ())
        affixed = [text for name in own if name for affix in self.affixes for text in (affix + name, name + affix)]
        return tuple(dict.fromkeys(plain_name(name) for name in (*own, *affixed)))

    def names(self, role: str) -> tuple[str, ...]:
        """Return `own_names`, and after them the common names."""
        common = read_profiles()[COMMON].layers.get(role, ())
        return tuple(dict.fromkeys((*self.own_names(role), *map(plain_name, common))))


def parse_motion(words: str) -> dict[str, Any]:
    """Return parts of a `MotionConvention` from words such as ``next,ndc,y-up,scale=2``; ValueError if impossible."""
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
    MotionConvention(**parts)  # refuses invalid numbers
    return parts


def plain_name(name: str) -> str:
    """Return a name in lower case without blanks, hyphens and underscores, which differ between exporters."""
    return "".join(c for c in name.lower() if c not in " _-")


def read_profile(path: str | Path) -> Profile:
    """Read a profile; raise ValueError if it is no TOML, too deeply nested, or has an unknown key, role or value."""
    path = Path(path)
    try:
        table = tomllib.loads(path.read_text(encoding="utf-8"))
    except (tomllib.TOMLDecodeError, UnicodeDecodeError, RecursionError) as error:
        raise ValueError(f"{path}: not a profile: {error}") from None
    try:
        return replace(_profile(path.stem, table), file=path)
    except (ValueError, TypeError) as error:
        raise ValueError(f"{path}: {error}") from None


def _profile(stem: str, table: dict[str, Any]) -> Profile:
    parts: dict[str, dict[str, Any]] = {key: table.get(key, {}) for key in _KEYS}
    parts["motion.assumed"] = assumed = parts["motion"].pop("assumed", {}) if isinstance(parts["motion"], dict) else {}
    _refuse_others(table, "profile", ("name", *_KEYS))
    for key, part in parts.items():
        if not isinstance(part, dict):
            raise ValueError(f"{key} is {part!r}, expected a table, [{key}]")
        _refuse_others(part, f"[{key}]", _KEYS[key.partition(".")[0]])
    found, layers, motion, variance = (parts[key] for key in ("found", "layers", "motion", "variance"))
    if (of := variance.get("of")) not in (None, *_MEANINGS):
        raise ValueError(f"variance is of {of!r}, expected one of {', '.join(_MEANINGS)}")
    MotionConvention(**{**assumed, **motion})  # refuses invalid conventions
    return Profile(
        name=str(table.get("name", stem)),
        attributes=_texts(found, "attributes"),
        known_layers=_texts(found, "layers"),
        layers={role: _texts(layers, role) for role in layers if role in ROLES},
        affixes=_texts(layers, "affixes"),
        files={role: str(pattern) for role, pattern in parts["files"].items()},
        motion=motion,
        motion_assumed=assumed,
        variance=of,
        samples=str(variance["samples"]) if "samples" in variance else None,
    )


def _texts(table: dict[str, Any], key: str) -> tuple[str, ...]:
    value = table.get(key, [])
    if not isinstance(value, list) or not all(isinstance(item, str) for item in value):
        raise ValueError(f"{key} is {value!r}, expected a list of names")
    return tuple(value)


def _refuse_others(table: Mapping[str, Any], where: str, known: Sequence[str]) -> None:
    for key in sorted(table.keys() - {*known}):
        raise ValueError(f"{where} has {key!r}, expected some of {', '.join(known)}")


def user_folder() -> Path:
    import typer

    return Path(typer.get_app_dir("ravg")) / "profiles"


@lru_cache(maxsize=1)
def read_profiles() -> dict[str, Profile]:
    """Return all profiles by the names of their files; the user's own replace those that come with ravg."""
    own, shipped = (sorted(folder.glob("*.toml")) for folder in (user_folder(), _SHIPPED))
    return {path.stem: read_profile(path) for path in [*shipped, *own]}


def open_profile(spec: str) -> Profile:
    """Return the profile with this name, or in this file; raise ValueError if there is none."""
    if spec in read_profiles():
        return read_profiles()[spec]
    if Path(spec).is_file():
        return read_profile(spec)
    raise ValueError(f"profile is {spec!r}, expected a file, or one of {', '.join(sorted(read_profiles()))}")


def find_profile(image: ExrImage) -> Profile:
    """Return the profile that fits a file best, with the reason in `why`.

    A header attribute counts most, then the names of layers that only one renderer writes. Among equals the profile
    that names more roles wins, then the user's own.
    """
    header = {name: f"{name}={value}" for part in image.parts for name, value in part.header.items()}
    names = {plain_name(tail) for layer in image.layers if (tail := layer.name.rpartition(".")[2])}
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
