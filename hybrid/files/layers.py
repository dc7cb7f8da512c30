"""Layers by role: which channels of a file are the color, albedo, normal, …, found by a renderer's names."""

import fnmatch
import re
from collections.abc import Collection, Iterator, Mapping, Sequence
from dataclasses import dataclass, field, replace
from functools import lru_cache
from typing import Self

from flow.motion import MotionConvention
from hybrid.files.exr import ExrError, ExrImage, Layer, component_of, without_view
from hybrid.files.profile import ROLE_FACTS, ROLES, Profile, find_profile, plain_name, read_profiles

COMPOSITE = "Composite"  # Blender's name for its compositor's result: graded, blurred, glowing
# Blender's names for the picture that it has denoised, beside its Noisy Image: in a render, and in the files of a File
# Output node.
_DENOISED = ("combined", "image")
# Words in the names of layers that may be a guide, of up to two letters whole names; and words in names of no guide.
_LOOKS_LIKE = {
    "albedo": re.compile("albedo|basecolor|diff(?:use)?filter|reflectance"),
    "normal": re.compile("normal|nrml|n"),
    "depth": re.compile("depth|z"),
    "motion": re.compile("motion|velocity|vector|mvec|mv"),
}
_NO_GUIDE = re.compile("variance|mse|error|deviation|crypto")
ALL = "all"  # stands for every layer that is known to be a part of the light
# One lobe's direct or indirect light, as Cycles and others name it; and names of undivided parts.
_LOBES = (
    "diff(?:use)?|gloss(?:y)?|trans(?:mission)?|volume|subsurface|sss|spec(?:ular)?|coat|sheen|reflect(?:ion)?s?|"
    "refract(?:ion)?s?|caustics"
)
_COMPONENT = "dir|direct|ind|indirect"
_LOBE = re.compile(f"(?P<lobe>{_LOBES})(?:{_COMPONENT})|(?:direct|indirect)(?P<other>{_LOBES})")
# After them those of V-Ray (with its prefix), Redshift and RenderMan.
_PASS = re.compile(
    f"{_LOBE.pattern}|{_LOBES}|direct|indirect|emit|emission|emissive|env|environment|background|"
    "(?:vray)?(?:raw)?(?:lighting|totallighting|gi|globalillumination|reflection|refraction|specular|sss2?|caustics|"
    "selfillumination|atmosphere|background)|(?:diffuse|specular)lighting(?:raw)?|globalillumination(?:raw)?|"
    "subsurfacescatter|volumelighting|transmissionlighting|emissive"
)
# Blender's Combined_key, Arnold's RGBA_key; no picture that a renderer's own denoiser has made.
_LIGHT_GROUP = re.compile("(?:combined|rgba|(?:vray)?light(?:group|select|mix))(?!denois|noice).")


@dataclass(frozen=True)
class Layers:
    """Channels of a file by role; None for a missing layer.

    A layer here holds only the channels that are used: three for `color`, `albedo`, `normal`, `estimate`, one or three
    for `variance`, one for `depth` and `alpha`, two to four for `motion`. Vectors to the next frame may lie in a layer
    of their own, `motion_next`. `half_a` and `half_b` are the color of two independent halves of the samples, whose
    difference gives the variance.
    """

    color: Layer
    # layer that the denoised picture replaces: the color, except where Cycles denoised: there the color is ``Noisy
    # Image``, which stays, and ``Combined`` is replaced
    target: Layer
    albedo: Layer | None = None
    normal: Layer | None = None
    depth: Layer | None = None
    motion: Layer | None = None
    motion_next: Layer | None = None
    variance: Layer | None = None
    half_a: Layer | None = None
    half_b: Layer | None = None
    alpha: Layer | None = None
    estimate: Layer | None = None
    # name of the profile, and why it was chosen
    profile: str = ""
    reason: str = ""
    # its parts `settled` are documented, the parts `typed` stated by the user, the others assumed
    motion_convention: MotionConvention | None = None
    settled: frozenset[str] = frozenset()
    typed: frozenset[str] = frozenset()
    variance_of: str | None = None  # "mean" or "sample"
    variance_scale: float | None = None  # factor that makes the variance that of a pixel
    estimate_factors: tuple[float, float, float] | None = None  # measured factors of the estimate
    samples: float | None = None  # samples per pixel
    view: str | None = None  # stereo view, one of `views`; the others are not denoised
    views: tuple[str, ...] = ()
    aovs: Mapping[str, Layer] = field(default_factory=dict)  # by the names that were asked for
    # colors by which AOVs are multiplied that are written without color
    pass_colors: Mapping[str, Layer] = field(default_factory=dict)
    notes: tuple[str, ...] = ()  # layers left alone that a user might expect to be denoised; one line each

    @property
    def aov_channels(self) -> int:
        """Number of channels of AOVs and alpha."""
        return sum(len(layer.channels) for layer in self.aovs.values()) + (self.alpha is not None)

    @property
    def one_way(self) -> bool:
        """Whether vectors are known to lead to one neighbour alone."""
        return self.motion_convention is not None and not self.motion_convention.pair

    def without(self, roles: Collection[str]) -> Self:
        """Return the layers without some roles, and without the layers these are made from."""
        gone = {*roles}
        gone |= {"motion_next"} if "motion" in gone else set()
        gone |= {"half_a", "half_b"} if "variance" in gone else set()
        convention = None if "motion" in gone else self.motion_convention
        return replace(self, **dict.fromkeys(gone), motion_convention=convention)  # type: ignore[arg-type]

    def without_aovs(self, names: Collection[str]) -> Self:
        aovs = {name: layer for name, layer in self.aovs.items() if name not in names}
        pass_colors = {name: layer for name, layer in self.pass_colors.items() if name not in names}
        return replace(self, aovs=aovs, pass_colors=pass_colors)


def find_layers(
    image: ExrImage,
    overrides: Mapping[str, str | Layer] | None = None,
    profile: Profile | None = None,
    aovs: Collection[str] = (),
    sidecars: Mapping[str, Layer] | None = None,
) -> Layers:
    """Find the layer of each role by its name; a file's pixels are not needed.

    `overrides` maps roles to names (`ExrImage.layer`) or to layers found in such a file before; `aovs` are names of
    further layers to denoise, or `ALL`; `sidecars` maps roles to layers of other files. Without a profile the one that
    fits the file is used.

    Where Cycles denoised at render time, ``Noisy Image`` is the color and ``Combined`` an estimate (``Image``, where
    Blender's File Output node has written them). Other layers come from the color's own view layer and stereo view
    only. Two layers that could be the color (of two view layers; ``beauty`` beside bare R, G, B) are refused: one would
    stay noisy in the file. A known renderer's name of its color goes before names that others use.

    Raises ExrError if there is no color, if a role fits several layers, if an override names a missing layer or one
    without the role's channels, or if an AOV is a layer that is written anyway; ValueError for an unknown role.
    """
    overrides = overrides or {}
    if unknown := set(overrides) - set(ROLES):
        raise ValueError(f"layer role {sorted(unknown)[0]!r} is unknown, expected one of {', '.join(ROLES)}")
    profile = profile or find_profile(image)
    notes: list[str] = []
    named = overrides.get("color")
    color = _find_any_color(image, profile, notes) if named is None else _fit_override(image, "color", named, None)
    found: dict[str, Layer | None] = {**(sidecars or {}), "color": color}
    found |= {role: _fit_override(image, role, x, color.view) for role, x in overrides.items() if role != "color"}
    for role in ROLES[1:]:
        if role not in found:
            found[role] = _find_guide(image, role, color, profile)
    whole = [x for x in image.layers if x.part == color.part and {*color.channels} <= {*x.channels}]
    found["alpha"] = found["alpha"] or (_fit(image, "alpha", whole[0], named=False) if whole else None)
    found["target"] = color
    if "estimate" not in overrides and "noisyimage" in _tails(image, color):
        found["estimate"] = _find_denoised(image, color)
        found["target"] = found["estimate"] or color
    guides = {role: layer for role in ROLES[1:] if (layer := found[role]) is not None and not layer.file}
    for role, guide in guides.items():
        if {*guide.channels} & {*color.channels}:
            raise ExrError(f"{image.path}: {guide} is taken for both color and {role}, expected two layers")

    view = _view_of(image, color)
    if len(image.views) > 1 and not isinstance(overrides.get("color"), Layer):
        notes.append(f"view {view} is denoised; {', '.join(v for v in image.views if v != view)} stays as it is")
    notes += _find_unused(image, color, {**found, "motion": found["motion"] or found["motion_next"]})
    written = [layer for layer in (found["target"], found["alpha"]) if layer is not None]
    read = [color, *guides.values()]
    further = _find_aovs(image, aovs, color, written, read)
    if ALL in aovs and (others := _others(image, color, [*written, *read, *further.values()])):
        notes.append(f"aov all: kept as they are, without a name for light (--aov NAME): {', '.join(others)}")
    convention, samples = _convention(found, profile), samples_of(image, profile)
    return Layers(
        **found,  # type: ignore[arg-type]
        profile=profile.name,
        reason=profile.why,
        motion_convention=convention,
        settled=profile.settled,
        typed=profile.typed,
        variance_of=profile.variance,
        variance_scale={"mean": 1.0, "sample": None if samples is None else 1 / samples}.get(profile.variance or ""),
        samples=samples,
        view=view,
        views=image.views,
        aovs=further,
        pass_colors=_find_pass_colors(image, further, color),
        notes=tuple(notes),
    )


def _fit_override(image: ExrImage, role: str, named: str | Layer, view: str | None) -> Layer:
    """The layer that the user names, of the color's view, with the channels of its role."""
    layer = _find_named(image, named, view) if isinstance(named, str) else image.again(named)
    fitted = _fit(image, role, layer, named=True) or (_as_gray(layer) if role == "color" else None)
    if fitted is None:
        raise ExrError(f"{image.path}: layer {layer} cannot be used as {role}: {ROLE_FACTS[role]['needs']}")
    return fitted


def _find_named(image: ExrImage, name: str, view: str | None) -> Layer:
    """The layer of this name; that of the color's view where it is another's and the name does not say so."""
    found = image.layer(name)
    if view is None or found.view in (None, view) or found.view in name.split("."):
        return found
    whole = next(layer for layer in image.layers if {*found.channels} <= {*layer.channels})
    ends = {component_of(channel) for channel in found.channels}
    for layer in image.layers:
        if layer.view == view and without_view(layer) == without_view(whole):
            return replace(layer, channels=tuple(c for c in layer.channels if component_of(c) in ends))
    return found


def _find_any_color(image: ExrImage, profile: Profile, notes: list[str]) -> Layer:
    """The color of the default view: by its name, as the only picture, or as a gray picture."""
    named = _name_colors(image, profile, image.views[0] if image.views else None, notes)
    color = _only(image, "color", named) if named else _only_picture(image, profile)
    if color is None and (gray := _name_grays(image, profile, image.views[0] if image.views else None)):
        color = _only(image, "color", gray)
    if color is None:
        raise ExrError(f"{image.path}: no color layer (--layer color=NAME); {image.listing()}")
    return color


def _find_denoised(image: ExrImage, color: Layer) -> Layer | None:
    """The picture that Cycles denoised, beside its Noisy Image."""
    near = [x for x in _same_group(image, color) if _group(image, x) == _group(image, color)]
    combined = [x for name in _DENOISED for x in near if name in _tails(image, x)]
    return _fit(image, "estimate", combined[0], named=True) if combined else None


def fit_sidecar(image: ExrImage, role: str, name: str | None, profile: Profile) -> Layer:
    """Find a file's layer of one role by `name`, the role's names, or its channels; ExrError if not one fits."""
    layers = list(image.layers) if name is None else [image.layer(name)]
    fitting = {layer: fitted for layer in layers if (fitted := _fit_file(image, role, layer))}
    named = [fitted for layer, fitted in fitting.items() if set(profile.names(role)) & {*_tails(image, layer)} - {""}]
    candidates = named or [*fitting.values()]
    if not candidates:
        raise ExrError(f"{image.path}: no layer for {role}: {ROLE_FACTS[role]['needs']}; {image.listing()}")
    return _only(image, role, candidates)


def _fit_file(image: ExrImage, role: str, layer: Layer) -> Layer | None:
    """As `_fit`; of a depth or alpha that was saved as a picture, the first channel."""
    fitted = _fit(image, role, layer, named=True)
    if fitted is None and role in ("depth", "alpha") and (picture := _fit(image, "color", layer, named=True)):
        return replace(picture, channels=picture.channels[:1])
    return fitted


def find_colors(image: ExrImage, profile: Profile) -> list[Layer]:
    """Find the color of each stereo view and view layer; ExrError if several could be the color of one of them.

    A color that several stereo views share is one picture.
    """
    colors = []
    for view in image.views or (None,):
        named = _name_colors(image, profile, view, []) or _name_grays(image, profile, view)
        of = {layer: _group(image, layer) for layer in named}
        groups = sorted({*of.values()})
        # Layers of no view layer beside those of one are no view of their own, but ambiguous.
        split = [named] if "" in groups else [[x for x in named if of[x] == group] for group in groups]
        colors += [_only(image, "color", layers) for layers in split if layers]
    return list(dict.fromkeys(colors))


def _view_of(image: ExrImage, color: Layer) -> str | None:
    """The stereo view of the color."""
    return color.view or (image.views[0] if image.views else None)


def _visible(image: ExrImage, view: str | None) -> list[Layer]:
    """The layers of a stereo view, and those of none."""
    return [layer for layer in image.layers if layer.view in (None, view)]


def _name_colors(image: ExrImage, profile: Profile, view: str | None, notes: list[str]) -> list[Layer]:
    """The layers of a view that have one of the renderer's names for the color, or else a common one."""
    visible = _visible(image, view)
    for names in (profile.own_names("color"), profile.names("color")):
        # Bare channels are a file's, not those of any of its parts.
        named = [x for x in visible if ({*_tails(image, x)} - {""} if without_view(x) else {""}) & {*names}]
        fitting = {layer: fitted for layer in named if (fitted := _fit(image, "color", layer, named=True))}
        if not fitting:
            continue
        of = {layer: _group(image, layer) for layer in fitting}
        groups = {*of.values()}
        if COMPOSITE in groups and len(groups) > 1:
            notes += [f"{x} stays as it is: the compositor's" for layer, x in fitting.items() if of[layer] == COMPOSITE]
            groups.remove(COMPOSITE)
        chosen: list[Layer] = []
        for group in sorted(groups):
            colors = {layer: fitted for layer, fitted in fitting.items() if of[layer] == group}
            plain = {_tails(image, layer)[0] for layer in colors}
            if "noisyimage" in plain and plain <= {"noisyimage", *_DENOISED}:
                colors = {x: fitted for x, fitted in colors.items() if "noisyimage" in _tails(image, x)}
            chosen += colors.values()
        return chosen
    return []


def _find_guide(image: ExrImage, role: str, color: Layer, profile: Profile) -> Layer | None:
    """The layer whose name comes first in the profile, in the color's view layer rather than in none."""
    layers: list[tuple[set[str], Layer]] = []
    for layer in _same_group(image, color):
        # Bare channels are those beside the color's: those of other parts can be anything.
        bare = not without_view(layer) or (layer.part == color.part and "" in _paths(image, layer))
        layers.append(({*_tails(image, layer)} - {""} | ({""} if bare else set()), layer))
        if not without_view(layer):  # a single bare channel may have a name too: depth, a
            layers += [({plain_name(c.rpartition(".")[2])}, replace(layer, channels=(c,))) for c in layer.channels]
    near = [(tails, layer) for tails, layer in layers if _group(image, layer) == _group(image, color)]
    for name in profile.names(role):
        for scope in (near, layers):
            matching = [layer for tails, layer in scope if name in tails]
            fitting = [fitted for layer in matching if (fitted := _fit(image, role, layer, named=bool(name)))]
            if fitting:
                return _only(image, role, fitting)
    return None


def _find_unused(image: ExrImage, color: Layer, found: Mapping[str, Layer | None]) -> Iterator[str]:
    """Name the layers that look like a guide that was not found; one line each."""
    used = {channel for layer in found.values() if layer is not None for channel in layer.channels}
    for role, words in _LOOKS_LIKE.items():
        if found.get(role) is not None:
            continue
        for layer in _same_group(image, color):
            names = [tail for tail in _tails(image, layer) if not _NO_GUIDE.search(tail)]
            alike = any(len(m[0]) > 2 or m[0] == name for name in names for m in words.finditer(name))
            if alike and not used & {*layer.channels}:
                yield f"{layer} is not used; if it is the {role}: --layer {role}={layer.name or layer}"


def _is_light(image: ExrImage, layer: Layer) -> bool:
    """Whether a layer has a name for light; its pixels decide what it is a part of (`hybrid.checks.pass_sums`)."""
    plain = _tails(image, layer)[0]
    return bool(_PASS.fullmatch(plain) or _LIGHT_GROUP.match(plain))


def _find_lights(image: ExrImage, color: Layer, written: Sequence[Layer]) -> dict[str, Layer]:
    used = {channel for layer in written for channel in layer.channels}
    lights = [x for x in _same_group(image, color) if _is_light(image, x) and not used & {*x.channels}]
    fitting = {without_view(x): _fit(image, "color", x, named=True) for x in lights}
    return {name: layer for name, layer in fitting.items() if layer is not None}


def _others(image: ExrImage, color: Layer, used: Sequence[Layer]) -> list[str]:
    """The names of all other layers of the color's view layer that have its three channels."""
    channels = {channel for layer in used for channel in layer.channels}
    unused = [layer for layer in _same_group(image, color) if layer.name and not channels & {*layer.channels}]
    return sorted(without_view(layer) for layer in unused if _fit(image, "color", layer, named=False))


def _lobes(image: ExrImage, layer: Layer) -> set[str]:
    """The lobes whose direct or indirect light a layer has a name for."""
    found = [match for tail in _tails(image, layer) if (match := _LOBE.fullmatch(tail))]
    return {match["lobe"] or match["other"] for match in found}


def _find_pass_colors(image: ExrImage, aovs: Mapping[str, Layer], color: Layer) -> dict[str, Layer]:
    """The color of each AOV that is written without color: light = (direct + indirect) · color, as in Cycles."""
    pass_colors = {}
    for name, light in aovs.items():
        named = {lobe + word for lobe in _lobes(image, light) for word in ("col", "color")}
        for layer in _same_group(image, color):
            if named & {*_tails(image, layer)} and _group(image, layer) == _group(image, light):
                pass_colors[name] = replace(layer, channels=layer.channels[:3])
    return pass_colors


def _find_aovs(
    image: ExrImage, names: Collection[str], color: Layer, written: Sequence[Layer], guides: Sequence[Layer]
) -> dict[str, Layer]:
    """The AOVs by name; each channel of a file is written once."""
    used: dict[str, str] = {channel: "the color or its alpha" for layer in written for channel in layer.channels}
    # Cryptomattes hold hashes of names: an average of two hashes is a third name.
    hashed = [str(v) for p in image.parts for k, v in p.header.items() if re.fullmatch(r"cryptomatte/\w+/name", k)]
    aovs = {}
    found = _find_lights(image, color, [*written, *guides]) if ALL in names else {}
    if ALL in names and not found:
        raise ExrError(f"{image.path}: aov all: no layer has a name for a part of the light; {image.listing()}")
    for name in [*found, *(name for name in names if name != ALL)]:
        layer = found.get(name) or _find_named(image, name, color.view)
        if name in ("color", "alpha"):
            raise ExrError(f"{image.path}: aov {name!r} is also a role, expected the whole name: {layer}")
        if clash := next((used[channel] for channel in layer.channels if channel in used), None):
            raise ExrError(f"{image.path}: aov {name!r} is {layer}, which is written as {clash}")
        if any(layer.name.startswith(base) for base in hashed):
            raise ExrError(f"{image.path}: aov {name!r} is {layer}, a cryptomatte, of which averages mean nothing")
        used |= dict.fromkeys(layer.channels, f"aov {name!r}")
        aovs[name] = layer
    return aovs


def _only(image: ExrImage, role: str, layers: Sequence[Layer]) -> Layer:
    """The one layer of a list; raise ExrError if it has several."""
    if len(layers) > 1:
        names = ", ".join(map(str, layers))
        raise ExrError(f"{image.path}: {role} can be {names}, expected one (--layer {role}=NAME)")
    return layers[0]


def _convention(found: dict[str, Layer | None], profile: Profile) -> MotionConvention | None:
    """The convention of the vectors; a single motion layer of either direction becomes `motion` in `found`."""
    motion, following = found["motion"], found["motion_next"]
    if motion is None and following is None:
        return None
    if motion is not None and following is not None:
        return replace(profile.convention(len(motion.channels)), direction="both")
    found["motion"], found["motion_next"] = motion or following, None
    convention = profile.convention(len((motion or following).channels))  # type: ignore[union-attr]
    if following is not None:
        return replace(convention, direction="next")
    return replace(convention, direction="previous") if profile.layers.get("motion_next") else convention


def samples_of(image: ExrImage, profile: Profile) -> float | None:
    """Return the samples per pixel, at least 1; None if the header has no such attribute."""
    for part in image.parts:
        for name in fnmatch.filter(part.header, profile.samples or ""):
            try:
                count = float(part.header[name])
            except (TypeError, ValueError):
                continue
            if 1 <= count < float("inf"):
                return count
    return None


def _only_picture(image: ExrImage, profile: Profile) -> Layer | None:
    """The only layer with R, G, B and A, or else with R, G and B, that no role has a name for."""
    named = {name for role in ROLES for name in profile.names(role) if name}
    layers = [x for x in image.layers if x.view in (None, *image.views[:1]) and not named & set(_tails(image, x))]
    pictures = [layer for layer in layers if _fit(image, "color", layer, named=True)]
    opaque = [layer for layer in pictures if _fit(image, "alpha", layer, named=False)]
    only = opaque if len(opaque) == 1 else pictures
    return _fit(image, "color", only[0], named=True) if len(only) == 1 else None


def _name_grays(image: ExrImage, profile: Profile, view: str | None) -> list[Layer]:
    """The gray layers of a view that have a name for the color."""
    visible = _visible(image, view)
    named = [x for x in visible if ({*_tails(image, x)} - {""} or {""}) & {*profile.names("color"), *image.views}]
    grays = [gray for layer in named if (gray := _as_gray(layer))]
    return [gray for gray in grays if component_of(gray.channels[0]) in _LUMINANCE]


# Names of the channel of a gray picture; a Z alone is a depth.
_LUMINANCE = ("Y", "L", "V", "R", "GRAY", "GREY", "LUMINANCE")


def _as_gray(layer: Layer) -> Layer | None:
    """A layer of one channel, or of Y with A and Z, as a color that has that channel three times."""
    by_component = {component_of(channel): channel for channel in layer.channels}
    alone = layer.channels[0] if len(layer.channels) == 1 else by_component.get("Y")
    gray = alone is not None and (len(layer.channels) == 1 or by_component.keys() <= {"Y", "A", "Z"})
    return replace(layer, channels=(alone,) * 3) if gray and alone is not None else None


def _fit(image: ExrImage, role: str, layer: Layer, *, named: bool) -> Layer | None:
    """The layer with the role's channels alone, if `named` also with one of any name; None if it lacks them."""
    by_component: dict[str, str] = {}
    twice = {component_of(c) for c in layer.channels if by_component.setdefault(component_of(c), c) != c}
    for components in ROLE_FACTS[role]["components"]:
        if all(c in by_component for c in components):
            if named and twice & set(components):  # R beside r or red
                raise ExrError(f"{image.path}: layer {layer} has two channels for {min(twice & set(components))}")
            return Layer(layer.name, layer.part, layer.view, tuple(by_component[c] for c in components))
    if named and role in ("depth", "variance", "alpha") and len(layer.channels) == 1:
        return layer
    return _as_gray(layer) if named and role in ("albedo", "estimate") else None


def _group(image: ExrImage, layer: Layer) -> str:
    """The view layer that a layer belongs to, as Cycles names them; "" for none."""
    return _plain_path(image, layer).rpartition(".")[0]


def _same_group(image: ExrImage, color: Layer) -> list[Layer]:
    """The layers of the color's view layer (or of none) and of its stereo view (or of none)."""
    group = _group(image, color)
    visible = _visible(image, _view_of(image, color))
    return [layer for layer in visible if {p.rpartition(".")[0] for p in _paths(image, layer)} & {group, ""}]


def _paths(image: ExrImage, layer: Layer) -> list[str]:
    """The names of a layer: the qualified one, and the one inside its part."""
    own = image.own_name(layer.channels[0]).rpartition(".")[0]
    return [_plain_path(image, layer), ".".join(token for token in own.split(".") if token != layer.view)]


def _plain_path(image: ExrImage, layer: Layer) -> str:
    """The name of a layer without its view, and without the word that ends all names, unless it names a layer."""
    name, word = without_view(layer), plain_name(image.ending[1:])
    return name if not word or _names_layer(word) else name.removesuffix(image.ending)


@lru_cache(maxsize=64)
def _names_layer(word: str) -> bool:
    """Whether a plain name is that of a role or of a part of the light."""
    named = any(word in profile.own_names(role) for profile in read_profiles().values() for role in ROLES)
    return named or _PASS.fullmatch(word) is not None


def _tails(image: ExrImage, layer: Layer) -> list[str]:
    return [plain_name(path.rpartition(".")[2]) for path in _paths(image, layer)]


def summarize_layers(layers: Layers) -> str:
    """Return the layers of all roles in one line."""
    words = [f"{role} {getattr(layers, role)}" for role in ROLES if getattr(layers, role) is not None]
    words += [f"aov {name} {layer}" for name, layer in layers.aovs.items()]
    words += [] if layers.target == layers.color else [f"result to {layers.target}"]
    return f"{layers.profile} ({layers.reason}): {', '.join(words)}"


def describe_layers(layers: Layers) -> list[tuple[str, str, str]]:
    """Return rows for `ravg inspect`: role, channels or "missing", and a note.

    The note of a missing role is its consequence; the note of motion is its convention; the note of the color lists
    layers that stay as they are.
    """
    rows = []
    for role in ROLES:
        layer = getattr(layers, role)
        if layer is None and "lack" not in ROLE_FACTS[role]:
            continue  # rarely written
        if layer is None:
            rows.append((role, "missing", ROLE_FACTS[role]["lack"]))
        else:
            notes = [f"convention: {layers.motion_convention}"] if role == "motion" else []
            note = "; ".join(layers.notes if role == "color" else notes)
            rows.append((role, str(layer), note))
    return rows
