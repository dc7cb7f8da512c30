"""Which channels of a file are what: the layers of a renderer, found by their names."""

from __future__ import annotations

import fnmatch
import re
from collections.abc import Collection, Iterator, Mapping, Sequence
from dataclasses import dataclass, field, replace

from flow.motion import MotionConvention
from hybrid.files.exr import ExrError, ExrImage, Layer, component_of, without_view
from hybrid.files.profile import ROLES, Profile, find_profile, plain_name

# Blender's name for what its compositor has made of the view layers: graded, blurred, glowing.
COMPOSITE = "Composite"
# What Blender calls the picture that it has denoised, beside its Noisy Image: in a render, and in the files of a File
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
# What stands for every layer that is known to be a part of the light.
ALL = "all"
# One lobe's direct or indirect light, as Cycles and others name it; and names of parts that are there as a whole.
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
    """Which channels of a file are taken for what; None where there is nothing.

    A layer here holds just the channels that are used: three for `color`, `albedo`, `normal`, `estimate`, one
    or three for `variance`, one for `depth` and `alpha`, two to four for `motion`; vectors to the next frame may lie in
    a layer of their own, `motion_next`. `half_a` and `half_b` are the color of two independent halves of the samples,
    whose difference gives the variance.

    `target` is where the denoised picture belongs: the color itself, except where Cycles denoised already:
    there the color is ``Noisy Image``, which stays, and ``Combined`` is replaced.

    `profile` says whose names and conventions were taken, `reason` why. Of `motion_convention`, its parts `settled` are
    documented, of which the user has stated those `typed`, the others assumed. `variance_of` says of what the variance
    is, "mean" or "sample", `variance_scale` what it is multiplied by to be that of a pixel, `samples` how many samples
    a pixel has; None where nobody has said. The estimate is multiplied by `estimate_factors`, where they were measured.

    `views` are the names of the stereo views; those other than `view` are not denoised.

    `aovs` are the further layers that were asked for, by the names they were asked for by, or all
    that have a name for light.
    `pass_colors` are the colors by which those of them are multiplied that a renderer writes without. `notes` say what
    was left alone that a user might think is denoised; one line each.
    """

    color: Layer
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
    profile: str = ""
    reason: str = ""
    motion_convention: MotionConvention | None = None
    settled: frozenset[str] = frozenset()
    typed: frozenset[str] = frozenset()
    variance_of: str | None = None
    variance_scale: float | None = None
    estimate_factors: tuple[float, float, float] | None = None
    samples: float | None = None
    view: str | None = None
    views: tuple[str, ...] = ()
    aovs: Mapping[str, Layer] = field(default_factory=dict)
    pass_colors: Mapping[str, Layer] = field(default_factory=dict)
    notes: tuple[str, ...] = ()

    def without(self, roles: Collection[str]) -> Layers:
        """The same with some roles left out, and what they are made from."""
        gone = {*roles}
        gone |= {"motion_next"} if "motion" in gone else set()
        gone |= {"half_a", "half_b"} if "variance" in gone else set()
        kept = None if "motion" in gone else self.motion_convention
        return replace(self, **dict.fromkeys(gone), motion_convention=kept)  # type: ignore[arg-type]

    def without_aovs(self, names: Collection[str]) -> Layers:
        """The same with some further layers left out."""
        aovs = {name: layer for name, layer in self.aovs.items() if name not in names}
        pass_colors = {name: layer for name, layer in self.pass_colors.items() if name not in names}
        return replace(self, aovs=aovs, pass_colors=pass_colors)


def find_layers(
    image: ExrImage,
    overrides: Mapping[str, str | Layer] | None = None,
    profile: Profile | None = None,
    aovs: Collection[str] = (),
    elsewhere: Mapping[str, Layer] | None = None,
) -> Layers:
    """Say which channels of a file are the color, albedo, normal, depth, motion, variance, alpha, estimate.

    Reading and writing both go by what this returns, so that what was read as a layer is written as that layer.

    Parameters
    ----------
    image : ExrImage
        From `read_exr`; pixels are not needed.
    overrides : mapping of str to str or Layer, optional
        Role → name of a layer, as `ExrImage.layer` takes it, or a layer that was found in such a file before; goes
        before what would be found.
    profile : Profile, optional
        Whose names to look for; without, that of the renderer that the file seems to be from.
    aovs : collection of str
        Names of further layers that are to be denoised along.
    elsewhere : mapping of str to Layer, optional
        Role → layer of another file, which goes before what would be found.

    Raises
    ------
    ExrError
        If there is no color, if more than one layer can be meant, if an override names a layer that is not there or
        cannot play the role, or if an AOV is one of the layers that are written anyway.
    ValueError
        If an override names an unknown role.

    Notes
    -----
    Where Cycles denoised at render time, ``Noisy Image`` is the color and ``Combined`` an estimate (``Image``, where
    Blender's File Output node has written them). The other layers are taken from the color's own view layer and stereo
    view only. Gray is read as a color, of one channel three times, where there is no other.

    What could be the color twice over (two view layers; ``beauty`` beside bare R, G, B) is refused: whichever was
    taken, the other would stay noisy in the file. What a known renderer calls its color goes before names that
    others use.
    """
    overrides = overrides or {}
    if unknown := set(overrides) - set(ROLES):
        raise ValueError(f"layer role {sorted(unknown)[0]!r} is unknown, expected one of {', '.join(ROLES)}")
    taken = profile or find_profile(image)

    found: dict[str, Layer | None] = {**(elsewhere or {})}
    for role, name in overrides.items():
        layer = image.layer(name) if isinstance(name, str) else image.again(name)
        found[role] = _fit(image, role, layer, named=True) or (_as_gray(layer) if role == "color" else None)
        if found[role] is None:
            raise ExrError(f"{image.path}: layer {layer} cannot be used as {role}: {_NEEDS[role]}")

    notes: list[str] = []
    color = found.get("color") or _find_color(image, taken, notes) or _only_picture(image, taken)
    if color is None and (gray := _name_grays(image, taken, image.views[0] if image.views else None)):
        color = _only(image, "color", gray)
    if color is None:
        raise ExrError(f"{image.path}: no color layer (--layer color=NAME); {image.listing()}")
    found["color"] = found["target"] = color
    for role in ROLES[1:]:
        if role not in found:
            found[role] = _find_guide(image, role, color, taken)
    if found["alpha"] is None:
        whole = [x for x in image.layers if x.part == color.part and set(color.channels) <= set(x.channels)]
        found["alpha"] = _fit(image, "alpha", whole[0], named=False) if whole else None
    if "estimate" not in overrides and "noisyimage" in _tails(image, color):
        near = _same_group(image, color)
        combined = [x for name in _DENOISED for x in near if name in _tails(image, x) and _group(x) == _group(color)]
        found["estimate"] = _fit(image, "estimate", combined[0], named=True) if combined else None
        found["target"] = found["estimate"] or color
    for role in ROLES[1:]:
        guide = found[role]
        if guide is not None and not guide.file and set(guide.channels) & set(color.channels):
            raise ExrError(f"{image.path}: {guide} is taken for both color and {role}, expected two layers")
    view = color.view or (image.views[0] if image.views else None)
    if len(image.views) > 1 and not isinstance(overrides.get("color"), Layer):
        notes.append(f"view {view} is denoised; {', '.join(v for v in image.views if v != view)} stays as it is")
    notes += _find_unused(image, color, {**found, "motion": found["motion"] or found["motion_next"]})
    convention, samples = _convention(found, taken), samples_of(image, taken)
    written = [layer for layer in (found["target"], found["alpha"]) if layer is not None]
    guides = [guide for role in ROLES if (guide := found[role]) is not None and not guide.file]
    further = _find_aovs(image, aovs, color, written, guides)
    if ALL in aovs and (others := _others(image, color, [*written, *guides, *further.values()])):
        notes.append(f"aov all: kept as they are, without a name for light (--aov NAME): {', '.join(others)}")
    return Layers(
        **found,  # type: ignore[arg-type]
        profile=taken.name,
        reason=taken.why,
        motion_convention=convention,
        settled=taken.settled,
        typed=taken.typed,
        variance_of=taken.variance,
        variance_scale={"mean": 1.0, "sample": None if samples is None else 1 / samples}.get(taken.variance or ""),
        samples=samples,
        view=view,
        views=image.views,
        aovs=further,
        pass_colors=_find_tints(image, further, color),
        notes=tuple(notes),
    )


def fit_alone(image: ExrImage, role: str, name: str | None, profile: Profile) -> Layer:
    """Find the layer of a file that is there for one role.

    Parameters
    ----------
    image : ExrImage
        The file.
    role : str
        What it is there for.
    name : str, optional
        Of the layer.
    profile : Profile
        Of the renderer, with the names of the role.

    Returns
    -------
    Layer
        The one with this name, with one of the role's, or that fits.

    Raises
    ------
    ExrError
        If there is none, or several could be it.
    """
    layers = list(image.layers) if name is None else [image.layer(name)]
    fitting = {layer: fitted for layer in layers if (fitted := _fit_file(image, role, layer))}
    known = [fitted for layer, fitted in fitting.items() if set(profile.names(role)) & {*_tails(image, layer)} - {""}]
    candidates = known or [*fitting.values()]
    if not candidates:
        raise ExrError(f"{image.path}: no layer for {role}: {_NEEDS[role]}; {image.listing()}")
    return _only(image, role, candidates)


def _fit_file(image: ExrImage, role: str, layer: Layer) -> Layer | None:
    """As `_fit`; of a map that was saved as a picture its first channel will do."""
    fitted = _fit(image, role, layer, named=True)
    if fitted is None and role in ("depth", "alpha") and (picture := _fit(image, "color", layer, named=True)):
        return replace(picture, channels=picture.channels[:1])
    return fitted


def find_colors(image: ExrImage, profile: Profile) -> list[Layer]:
    """Find the colors of all the pictures in a file: of each stereo view, of each of its view layers.

    Parameters
    ----------
    image : ExrImage
        The file.
    profile : Profile
        Of the renderer.

    Returns
    -------
    list of Layer

    Raises
    ------
    ExrError
        If there is none in a view, or if several could be the color of one picture.
    """
    colors = []
    for view in image.views or (None,):
        named = _name_colors(image, profile, view, []) or _name_grays(image, profile, view)
        groups = {_group(layer) for layer in named}
        # Layers of no view layer beside those of one are no picture of their own, but in doubt.
        split = [named] if "" in groups else [[x for x in named if _group(x) == group] for group in sorted(groups)]
        colors += [_only(image, "color", layers) for layers in split if layers]
    return colors


def _find_color(image: ExrImage, profile: Profile, notes: list[str]) -> Layer | None:
    """The one layer that has a name for the color, in the default view."""
    named = _name_colors(image, profile, image.views[0] if image.views else None, notes)
    return _only(image, "color", named) if named else None


def _name_colors(image: ExrImage, profile: Profile, view: str | None, notes: list[str]) -> list[Layer]:
    """The layers of a view that have a name for the color; of the renderer's own names, or else of common ones."""
    seen = [layer for layer in image.layers if layer.view in (None, view)]
    for names in (profile.own_names("color"), profile.names("color")):
        # Bare channels are a file's, not those of any of its parts.
        named = [x for x in seen if ({*_tails(image, x)} - {""} if x.name else {""}) & {*names}]
        fitting = {layer: fitted for layer in named if (fitted := _fit(image, "color", layer, named=True))}
        if not fitting:
            continue
        groups = {_group(layer) for layer in fitting}
        if COMPOSITE in groups and len(groups) > 1:
            notes += [f"{x} stays as it is: the compositor's" for x in fitting.values() if _group(x) == COMPOSITE]
            groups.remove(COMPOSITE)
        chosen: list[Layer] = []
        for group in sorted(groups):
            own = {layer: fitted for layer, fitted in fitting.items() if _group(layer) == group}
            plain = {_tails(image, layer)[0] for layer in own}
            if "noisyimage" in plain and plain <= {"noisyimage", *_DENOISED}:
                own = {x: fitted for x, fitted in own.items() if "noisyimage" in _tails(image, x)}
            chosen += own.values()
        return chosen
    return []


def _find_guide(image: ExrImage, role: str, color: Layer, profile: Profile) -> Layer | None:
    """The layer whose name comes first in the profile, in the color's view layer rather than in none."""
    layers: list[tuple[set[str], Layer]] = []
    for layer in _same_group(image, color):
        # Bare channels are those beside the color's: those of other parts can be anything.
        bare = not layer.name or (layer.part == color.part and "" in _paths(image, layer))
        layers.append(({*_tails(image, layer)} - {""} | ({""} if bare else set()), layer))
        if not layer.name:  # one alone may have a name too: depth, a
            layers += [({plain_name(c)}, Layer("", layer.part, layer.view, (c,))) for c in layer.channels]
    near = [(tails, layer) for tails, layer in layers if _group(layer) == _group(color)]
    for name in profile.names(role):
        for scope in (near, layers):
            matching = [layer for tails, layer in scope if name in tails]
            fitting = [fitted for layer in matching if (fitted := _fit(image, role, layer, named=bool(name)))]
            if fitting:
                return _only(image, role, fitting)
    return None


def _find_unused(image: ExrImage, color: Layer, found: Mapping[str, Layer | None]) -> Iterator[str]:
    """Name the layers that look like a guide that was not found; a line each."""
    taken = {channel for layer in found.values() if layer is not None for channel in layer.channels}
    for role, words in _LOOKS_LIKE.items():
        if found.get(role) is not None:
            continue
        for layer in _same_group(image, color):
            names = [tail for tail in _tails(image, layer) if not _NO_GUIDE.search(tail)]
            alike = any(len(m[0]) > 2 or m[0] == name for name in names for m in words.finditer(name))
            if alike and not taken & {*layer.channels}:
                yield f"{layer} is not used; if it is the {role}: --layer {role}={layer.name or layer}"


def _is_light(layer: Layer) -> bool:
    """Whether a layer has a name for light; its pixels say what it is a part of (`hybrid.passes`)."""
    plain = plain_name(without_view(layer).rpartition(".")[2])
    return bool(_PASS.fullmatch(plain) or _LIGHT_GROUP.match(plain))


def _find_lights(image: ExrImage, color: Layer, written: Sequence[Layer]) -> dict[str, Layer]:
    """All layers that have a name for light."""
    taken = {channel for layer in written for channel in layer.channels}
    there = [x for x in _same_group(image, color) if _is_light(x) and not taken & {*x.channels}]
    fitting = {without_view(x): _fit(image, "color", x, named=True) for x in there}
    return {name: layer for name, layer in fitting.items() if layer is not None}


def _others(image: ExrImage, color: Layer, taken: Sequence[Layer]) -> list[str]:
    """The names of all other layers beside the color that have its three channels."""
    known = {channel for layer in taken for channel in layer.channels}
    beside = [layer for layer in _same_group(image, color) if layer.name and not known & {*layer.channels}]
    return sorted(without_view(layer) for layer in beside if _fit(image, "color", layer, named=False))


def _lobes(image: ExrImage, layer: Layer) -> set[str]:
    """The lobe whose direct or indirect light a layer is, if it is."""
    found = [match for tail in _tails(image, layer) if (match := _LOBE.fullmatch(tail))]
    return {match["lobe"] or match["other"] for match in found}


def _find_tints(image: ExrImage, aovs: Mapping[str, Layer], color: Layer) -> dict[str, Layer]:
    """The color of each layer of light that is written without: (direct + indirect) · color, as Cycles has them."""
    pass_colors = {}
    for name, light in aovs.items():
        named = {lobe + word for lobe in _lobes(image, light) for word in ("col", "color")}
        for layer in _same_group(image, color):
            if named & {*_tails(image, layer)} and _group(layer) == _group(light):
                pass_colors[name] = replace(layer, channels=layer.channels[:3])
    return pass_colors


def _find_aovs(
    image: ExrImage, names: Collection[str], color: Layer, written: Sequence[Layer], guides: Sequence[Layer]
) -> dict[str, Layer]:
    """The layers that are denoised along; each channel of a file is written once."""
    taken: dict[str, str] = {channel: "the color or its alpha" for layer in written for channel in layer.channels}
    # Hashes of names: an average of two is the name of a third thing.
    hashed = [str(v) for p in image.parts for k, v in p.header.items() if re.fullmatch(r"cryptomatte/\w+/name", k)]
    aovs = {}
    found = _find_lights(image, color, [*written, *guides]) if ALL in names else {}
    if ALL in names and not found:
        raise ExrError(f"{image.path}: aov all: no layer has a name for a part of the light; {image.listing()}")
    for name in [*found, *(name for name in names if name != ALL)]:
        layer = found.get(name) or image.layer(name)
        if name in ("color", "alpha"):
            raise ExrError(f"{image.path}: aov {name!r} is also a role, expected the whole name: {layer}")
        if clash := next((taken[channel] for channel in layer.channels if channel in taken), None):
            raise ExrError(f"{image.path}: aov {name!r} is {layer}, which is written as {clash}")
        if any(layer.name.startswith(base) for base in hashed):
            raise ExrError(f"{image.path}: aov {name!r} is {layer}, a cryptomatte, of which averages mean nothing")
        taken |= dict.fromkeys(layer.channels, f"aov {name!r}")
        aovs[name] = layer
    return aovs


def _only(image: ExrImage, role: str, layers: Sequence[Layer]) -> Layer:
    """The one layer of a list; raise ExrError if it has several."""
    if len(layers) > 1:
        names = ", ".join(map(str, layers))
        raise ExrError(f"{image.path}: {role} can be {names}, expected one (--layer {role}=NAME)")
    return layers[0]


def _convention(found: dict[str, Layer | None], profile: Profile) -> MotionConvention | None:
    """What the vectors mean; where one of two layers is missing, the other is `motion` afterwards."""
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
    """Find how many samples a pixel has.

    Parameters
    ----------
    image : ExrImage
        A file, or its header alone.
    profile : Profile
        Which attribute tells it.

    Returns
    -------
    float or None
        At least 1; None where the header does not tell.
    """
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
    """The one layer with R, G, B and A, or else with R, G and B, that no role has a name for; None of several."""
    named = {name for role in ROLES for name in profile.names(role) if name}
    layers = [x for x in image.layers if x.view in (None, *image.views[:1]) and not named & set(_tails(image, x))]
    pictures = [layer for layer in layers if _fit(image, "color", layer, named=True)]
    opaque = [layer for layer in pictures if _fit(image, "alpha", layer, named=False)]
    only = opaque if len(opaque) == 1 else pictures
    return _fit(image, "color", only[0], named=True) if len(only) == 1 else None


def _name_grays(image: ExrImage, profile: Profile, view: str | None) -> list[Layer]:
    """The gray layers of a view that have a name for the color."""
    seen = [layer for layer in image.layers if layer.view in (None, view)]
    named = [x for x in seen if ({*_tails(image, x)} - {""} or {""}) & {*profile.names("color"), *image.views}]
    grays = [gray for layer in named if (gray := _as_gray(layer))]
    return [gray for gray in grays if component_of(gray.channels[0]) in _LUMINANCE]


# What the channel of a gray picture is called; a Z alone is a depth.
_LUMINANCE = ("Y", "L", "V", "R", "GRAY", "GREY", "LUMINANCE")


def _as_gray(layer: Layer) -> Layer | None:
    """A layer of one channel, or with a Y beside A and Z, as a color that has it three times."""
    by_component = {component_of(channel): channel for channel in layer.channels}
    alone = layer.channels[0] if len(layer.channels) == 1 else by_component.get("Y")
    gray = alone is not None and (len(layer.channels) == 1 or by_component.keys() <= {"Y", "A", "Z"})
    return replace(layer, channels=(alone,) * 3) if gray and alone is not None else None


_NEEDS = {
    "color": "it needs channels R, G and B, or one channel",
    "albedo": "it needs channels R, G and B, or one channel",
    "estimate": "it needs channels R, G and B, or one channel",
    "normal": "it needs channels X, Y and Z, or R, G and B",
    "depth": "it needs one channel, or Z",
    "motion": "it needs channels X and Y, U and V, or R and G, or X, Y, Z and W",
    "motion_next": "it needs channels X and Y, U and V, or R and G",
    "variance": "it needs channels R, G and B, or one channel",
    "half_a": "it needs channels R, G and B",
    "half_b": "it needs channels R, G and B",
    "alpha": "it needs one channel, or A",
}


_COMPONENTS = {
    "color": ["RGB"],
    "albedo": ["RGB"],
    "estimate": ["RGB"],
    "normal": ["XYZ", "RGB"],
    "depth": ["Z"],
    "motion": ["XYZW", "XYZ", "XY", "UV", "RGB", "RG"],
    "motion_next": ["XYZ", "XY", "UV", "RGB", "RG"],
    "variance": ["RGB"],
    "half_a": ["RGB"],
    "half_b": ["RGB"],
    "alpha": ["A"],
}


def _fit(image: ExrImage, role: str, layer: Layer, *, named: bool) -> Layer | None:
    """The layer with just the channels that the role uses; None if it has not got them.

    In a layer that is `named` for the role, one channel will do whatever it is called.
    """
    by_component: dict[str, str] = {}
    twice = {component_of(c) for c in layer.channels if by_component.setdefault(component_of(c), c) != c}
    for components in _COMPONENTS[role]:
        if all(c in by_component for c in components):
            if named and twice & set(components):  # R beside r or red
                raise ExrError(f"{image.path}: layer {layer} has two channels for {min(twice & set(components))}")
            return Layer(layer.name, layer.part, layer.view, tuple(by_component[c] for c in components))
    if named and role in ("depth", "variance", "alpha") and len(layer.channels) == 1:
        return layer
    return _as_gray(layer) if named and role in ("albedo", "estimate") else None


def _group(layer: Layer) -> str:
    """The view layer that a layer belongs to, as Cycles names them; "" for none."""
    return without_view(layer).rpartition(".")[0]


def _same_group(image: ExrImage, color: Layer) -> list[Layer]:
    """The layers of the color's view layer (or of none) and of its stereo view (or of none)."""
    group = _group(color)
    view = color.view or (image.views[0] if image.views else None)
    return [
        layer
        for layer in image.layers
        if layer.view in (None, view) and {p.rpartition(".")[0] for p in _paths(image, layer)} & {group, ""}
    ]


def _paths(image: ExrImage, layer: Layer) -> list[str]:
    """The names to know a layer by: the qualified one, and the one inside its part."""
    own = image.own_name(layer.channels[0]).rpartition(".")[0]
    return [without_view(layer), ".".join(token for token in own.split(".") if token != layer.view)]


def _tails(image: ExrImage, layer: Layer) -> list[str]:
    return [plain_name(path.rpartition(".")[2]) for path in _paths(image, layer)]


# What each role is for, that is, what happens without it.
_LACK = {
    "albedo": "textures are filtered together with the light: blur, about 2 dB",
    "normal": "edges between surfaces of one color are held by color alone",
    "depth": "where vectors lead backward only, the nearer of two surfaces is told by speed",
    "motion": "flow is estimated from the picture: slower, and less exact",
    "variance": "noise is estimated from half buffers where there are two, else from the window",
    "alpha": "nothing, if the picture has no transparent parts",
    "estimate": "single frames are denoised by OIDN, or by our own filters",
}


def summarize_layers(layers: Layers) -> str:
    """Say in one line what was taken."""
    taken = [f"{role} {getattr(layers, role)}" for role in ROLES if getattr(layers, role) is not None]
    taken += [f"aov {name} {layer}" for name, layer in layers.aovs.items()]
    taken += [] if layers.target == layers.color else [f"result to {layers.target}"]
    return f"{layers.profile} ({layers.reason}): {', '.join(taken)}"


def describe_layers(layers: Layers) -> list[tuple[str, str, str]]:
    """Rows for `ravg inspect`: role, channels taken or "missing", and what it means.

    The third item says what the lack costs; for motion that is there, its convention; for the color, what beside it
    stays as it is; else it is empty.
    """
    rows = []
    for role in ROLES:
        layer = getattr(layers, role)
        if layer is None and role in ("half_a", "half_b", "motion_next"):
            continue  # rare: nothing is wrong without them
        if layer is None:
            rows.append((role, "missing", _LACK[role]))
        else:
            notes = [f"convention: {layers.motion_convention}"] if role == "motion" else []
            note = "; ".join(layers.notes if role == "color" else notes)
            rows.append((role, str(layer), note))
    return rows
