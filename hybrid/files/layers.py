"""Which channels of a file are what: the layers of a renderer, found by their names."""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import dataclass

from flow.motion import CYCLES, MotionConvention
from hybrid.files.exr import ExrError, ExrImage, Layer, component_of, without_view

# The last component of a layer's name, in order of preference, whatever the case. Cycles; then our own plain
# names, which others use too; then Arnold (noice: RGBA, denoise_albedo, diffuse_albedo, N, Z, variance),
# RenderMan (denoise: Ci, albedo, normal, mse), Karma (C, N), V-Ray (diffuse filter, normals, zDepth).
# "" are the bare channels of a file, or of its first part with such. Motion is not guessed beyond these two:
# the others' conventions differ, and wrong vectors are worse than none (--layer motion=… takes any).
_NAMES: dict[str, tuple[str, ...]] = {
    "color": ("noisy image", "combined", "color", "beauty", "rgba", "rgb", "ci", "c", ""),
    "albedo": ("denoising albedo", "albedo", "denoise_albedo", "diffuse_albedo", "diffusefilter"),
    "normal": ("denoising normal", "normal", "n", "normals"),
    "depth": ("denoising depth", "depth", "z", "zdepth", ""),
    "motion": ("vector", "motion"),
    "variance": ("variance", "mse"),
    "half_a": ("half a", "half_a"),
    "half_b": ("half b", "half_b"),
    "alpha": (),
    "estimate": ("denoised", "estimate"),
}
ROLES = tuple(_NAMES)


@dataclass(frozen=True)
class Layers:
    """Which channels of a file are taken for what; None where there is nothing.

    A layer here holds just the channels that are used: three for `color`, `albedo`, `normal`, `estimate`, one
    or three for `variance`, one for `depth` and `alpha`, four or two for `motion`. `half_a` and `half_b` are the color
    of two independent halves of the samples, whose difference gives the variance.

    `target` is where the denoised picture belongs: the color itself, except where Cycles denoised already:
    there the color is ``Noisy Image``, which stays, and ``Combined`` is replaced.

    `motion_convention` is Blender's for four channels, and for two the plain one: the offset in pixels, x right and y
    down, from a pixel of this frame to where it was in the previous one.

    `views` are the names of the stereo views; those other than `view` are not denoised.
    """

    color: Layer
    target: Layer
    albedo: Layer | None = None
    normal: Layer | None = None
    depth: Layer | None = None
    motion: Layer | None = None
    variance: Layer | None = None
    half_a: Layer | None = None
    half_b: Layer | None = None
    alpha: Layer | None = None
    estimate: Layer | None = None
    motion_convention: MotionConvention | None = None
    view: str | None = None
    views: tuple[str, ...] = ()


def find_layers(image: ExrImage, overrides: Mapping[str, str] | None = None) -> Layers:
    """Say which channels of a file are the color, albedo, normal, depth, motion, variance, alpha, estimate.

    Parameters
    ----------
    image
        From `read_exr`; pixels are not needed.
    overrides
        Role → name of a layer, as `ExrImage.layer` takes it; goes before what would be found.

    Raises
    ------
    ExrError
        If there is no color, or an override names a layer that is not there or cannot play the role.
    ValueError
        If an override names an unknown role.

    Notes
    -----
    Where Cycles denoised at render time, ``Noisy Image`` is the color and ``Combined`` an estimate. The
    other layers are taken from the color's own view layer and stereo view only.
    """
    overrides = overrides or {}
    if unknown := set(overrides) - set(ROLES):
        raise ValueError(f"layer role {sorted(unknown)[0]!r} is unknown, expected one of {', '.join(ROLES)}")

    found: dict[str, Layer | None] = {}
    for role, name in overrides.items():
        layer = image.layer(name)
        found[role] = _fit(role, layer, named=True)
        if found[role] is None:
            raise ExrError(f"{image.path}: layer {layer} cannot be used as {role}: {_NEEDS[role]}")

    color = found.get("color") or _search(image, "color", None)
    if color is None:
        raise ExrError(f"{image.path}: no color layer (--layer color=NAME); {image.listing()}")
    found["color"] = found["target"] = color
    for role in ROLES[1:]:
        if role not in found:
            found[role] = _search(image, role, color)
    if "alpha" not in overrides:
        whole = [x for x in image.layers if x.part == color.part and set(color.channels) <= set(x.channels)]
        found["alpha"] = _fit("alpha", whole[0], named=False) if whole else None
    if "estimate" not in overrides and "noisy image" in _tails(image, color):
        combined = [x for x in _same_group(image, color) if "combined" in _tails(image, x)]
        found["estimate"] = _fit("estimate", combined[0], named=True) if combined else None
        found["target"] = found["estimate"] or color

    motion = found["motion"]
    convention = None if motion is None else CYCLES if len(motion.channels) == 4 else MotionConvention()
    view = color.view or (image.views[0] if image.views else None)
    return Layers(**found, motion_convention=convention, view=view, views=image.views)  # type: ignore[arg-type]


_NEEDS = {
    "color": "it needs channels R, G and B",
    "albedo": "it needs channels R, G and B",
    "estimate": "it needs channels R, G and B",
    "normal": "it needs channels X, Y and Z, or R, G and B",
    "depth": "it needs one channel, or Z",
    "motion": "it needs channels X, Y, Z and W, or two (X Y, U V or R G)",
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
    "motion": ["XYZW", "XY", "UV", "RG"],
    "variance": ["RGB"],
    "half_a": ["RGB"],
    "half_b": ["RGB"],
    "alpha": ["A"],
}


def _fit(role: str, layer: Layer, *, named: bool) -> Layer | None:
    """The layer with just the channels that the role uses; None if it has not got them.

    In a layer that is `named` for the role, one channel will do whatever it is called.
    """
    by_component = {component_of(channel): channel for channel in reversed(layer.channels)}
    for components in _COMPONENTS[role]:
        if all(c in by_component for c in components):
            return Layer(layer.name, layer.part, layer.view, tuple(by_component[c] for c in components))
    if named and role in ("depth", "variance", "alpha") and len(layer.channels) == 1:
        return layer
    return None


def _search(image: ExrImage, role: str, color: Layer | None) -> Layer | None:
    """The layer whose name comes first in the table; the first of the file among equals."""
    if color is None:
        layers = [layer for layer in image.layers if layer.view in (None, *image.views[:1])]
    else:
        layers = _same_group(image, color)
    for name in _NAMES[role]:
        for layer in layers:
            if name in _tails(image, layer) and (fitted := _fit(role, layer, named=bool(name))):
                return fitted
    return None


def _same_group(image: ExrImage, color: Layer) -> list[Layer]:
    """The layers of the color's view layer (or of none) and of its stereo view (or of none)."""
    group = without_view(color).rpartition(".")[0]
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
    return [path.rpartition(".")[2].lower() for path in _paths(image, layer)]


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


def describe_layers(layers: Layers) -> list[tuple[str, str, str]]:
    """Rows for `ravg inspect`: role, channels taken or "missing", and what it means.

    The third item says what the lack costs; for motion that is there, its convention; else it is empty.
    """
    rows = []
    for role in ROLES:
        layer = getattr(layers, role)
        if layer is None and role in ("half_a", "half_b"):
            continue  # rare: nothing is wrong without them
        if layer is None:
            rows.append((role, "missing", _LACK[role]))
        else:
            note = f"convention: {layers.motion_convention}" if role == "motion" else ""
            rows.append((role, str(layer), note))
    return rows
