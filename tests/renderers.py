"""One rendered shot, rewritten as other renderers would have written it: names, conventions, units, files."""

from collections.abc import Callable, Mapping
from dataclasses import dataclass, field
from pathlib import Path

import cv2
import numpy as np
import OpenEXR

from flow.motion import MotionConvention
from hybrid.files.shots import open_shot

# Rendered with Cycles at 24 samples: the camera moves, and three objects cross its picture.
SHOT = Path(__file__).parent / "data" / "objects"
SAMPLES = 24

Channels = dict[str, np.ndarray]


@dataclass(frozen=True)
class Truth:
    """The layers of a frame in ravg's own conventions."""

    number: int
    color: np.ndarray
    alpha: np.ndarray
    albedo: np.ndarray
    normal: np.ndarray
    depth: np.ndarray
    previous: np.ndarray
    following: np.ndarray

    @property
    def variance(self) -> np.ndarray:
        """Variance of a pixel, as the picture shows it."""
        kernel = np.array([1, -2, 1], np.float32)
        return cv2.blur((cv2.sepFilter2D(self.color, -1, kernel, kernel) / 6) ** 2, (9, 9))

    @property
    def size(self) -> np.ndarray:
        """Width and height."""
        return np.array(self.color.shape[1::-1], np.float32)


def truths(part: tuple[slice, slice] = np.s_[:, :]) -> list[Truth]:
    """The frames of the shot, or a part of each."""
    shot = open_shot(SHOT / "noisy.####.exr")
    found = []
    for number in shot.numbers:
        frame = shot.read(number)
        motion = frame.flows()
        assert frame.alpha is not None and frame.albedo is not None and frame.normal is not None  # noqa: PT018
        assert motion is not None and motion.to_previous is not None and motion.to_next is not None  # noqa: PT018
        assert frame.depth is not None
        layers = frame.color, frame.alpha, frame.albedo, frame.normal, frame.depth
        found.append(Truth(number, *(x[part] for x in (*layers, motion.to_previous.flow, motion.to_next.flow))))
    return found


def layer(name: str, components: str, *arrays: np.ndarray) -> Channels:
    """Channels ``name.R`` and so on; components of several letters are separated by commas."""
    planes = np.dstack(arrays)
    letters = components.split(",") if "," in components else list(components)
    assert len(letters) == planes.shape[2]
    return {f"{name}.{c}" if name else c: planes[..., i] for i, c in enumerate(letters)}


def save(path: Path, channels: Channels, attributes: Mapping[str, object] | None = None) -> None:
    """Write one file."""
    path.parent.mkdir(parents=True, exist_ok=True)
    header = {"compression": OpenEXR.ZIP_COMPRESSION, "type": OpenEXR.scanlineimage, **(attributes or {})}
    pixels = {name: np.ascontiguousarray(plane, np.float32) for name, plane in channels.items()}
    OpenEXR.File([OpenEXR.Part(header, pixels, "")]).write(str(path))


def plain(truth: Truth, roles: str = "albedo normal depth", direction: str = "both") -> Channels:
    """The layers by ravg's own names, with what one renderer writes of them."""
    made = layer("color", "RGBA", truth.color, truth.alpha)
    if "albedo" in roles:
        made |= layer("albedo", "RGB", truth.albedo)
    if "normal" in roles:
        made |= layer("normal", "XYZ", truth.normal)
    if "depth" in roles:
        made |= layer("depth", "Z", truth.depth)
    if "variance" in roles:
        made |= layer("variance", "RGB", truth.variance)
    vectors = {"both": (truth.previous, truth.following), "previous": (truth.previous,), "next": (truth.following,)}
    if direction in vectors:
        made |= layer("motion", "XYZW" if direction == "both" else "XY", *vectors[direction])
    return made


def cycles_vector(truth: Truth) -> np.ndarray:
    """Blender's Vector: the previous frame at (x + X, y - Y), the next at (x - Z, y + W)."""
    return np.dstack([truth.previous * [1, -1], truth.following * [-1, 1]])


def magnitude(vectors: np.ndarray) -> np.ndarray:
    """A direction in [0, 1] and a length."""
    length = np.linalg.norm(vectors, axis=-1, keepdims=True)
    with np.errstate(invalid="ignore"):
        direction = np.where(length > 0, 0.5 + 0.5 * vectors / length, 0)
    return np.concatenate([direction, length], axis=-1)


@dataclass(frozen=True)
class Renderer:
    """The output of one renderer for a frame.

    Attributes
    ----------
    profile : str
        What ravg should say it is.
    files : callable
        From a frame to its files: name with ``####`` for the number → channels.
    roles, direction : str
        What is left of the layers, and of the motion.
    attributes : mapping
        Of the header.
    spec : str
        What the user types, in the folder.
    """

    profile: str
    files: Callable[[Truth], dict[str, Channels]]
    roles: str = "albedo normal depth"
    direction: str = "none"
    attributes: Mapping[str, object] = field(default_factory=dict)
    spec: str = "shot.####.exr"

    def write(self, folder: Path, frames: list[Truth]) -> Path:
        """Write the shot; returns what the user types."""
        for truth in frames:
            for name, channels in self.files(truth).items():
                save(folder / name.replace("####", f"{truth.number:04d}"), channels, self.attributes)
        return folder / self.spec

    def write_plain(self, folder: Path, frames: list[Truth]) -> Path:
        """The same by plain names; `convention` says what its vectors mean."""
        for truth in frames:
            save(folder / f"plain.{truth.number:04d}.exr", plain(truth, self.roles, self.direction))
        return folder / "plain.####.exr"

    @property
    def convention(self) -> MotionConvention:
        """Convention of the vectors by plain names."""
        return MotionConvention(self.direction if self.direction != "none" else "previous")


def one(channels: Callable[[Truth], Channels]) -> Callable[[Truth], dict[str, Channels]]:
    """All layers in one file."""
    return lambda truth: {"shot.####.exr": channels(truth)}


UP = np.array([1, -1], np.float32)

RENDERERS = {
    "cycles": Renderer("Cycles", one(lambda t: layer("ViewLayer.Combined", "RGBA", t.color, t.alpha)
        | layer("ViewLayer.Denoising Albedo", "RGB", t.albedo) | layer("ViewLayer.Denoising Normal", "XYZ", t.normal)
        | layer("ViewLayer.Depth", "Z", t.depth) | layer("ViewLayer.Vector", "XYZW", cycles_vector(t))),
        direction="both", attributes={"cycles.ViewLayer.samples": str(SAMPLES)}),
    # A shutter of 180 degrees: vectors are half as long.
    "arnold": Renderer("Arnold", one(lambda t: layer("", "RGBA", t.color, t.alpha)
        | layer("denoise_albedo", "RGB", t.albedo) | layer("N", "XYZ", t.normal) | layer("", "Z", t.depth)
        | layer("motionvector", "RG", 0.5 * t.following * UP) | layer("variance", "RGB", t.variance)),
        roles="albedo normal depth variance", direction="next", attributes={"arnold/version": "7.3"}),
    "arnold, direction and length": Renderer("Arnold", one(lambda t: layer("", "RGBA", t.color, t.alpha)
        | layer("denoise_albedo", "RGB", t.albedo) | layer("N", "XYZ", t.normal)
        | layer("motionvector", "RGB", magnitude(t.following * UP))), roles="albedo normal", direction="next",
        attributes={"arnold/version": "7.3"}),
    "renderman": Renderer("RenderMan", one(lambda t: layer("Ci", "rgb", t.color) | layer("", "a", t.alpha)
        | layer("albedo", "rgb", t.albedo) | layer("normal", "rgb", t.normal) | layer("zfiltered", "z", t.depth)
        | layer("mse", "rgb", t.variance) | layer("sampleCount", "y", np.full_like(t.alpha, SAMPLES))
        | layer("forward", "rg", t.following * UP) | layer("backward", "rg", t.previous * UP)),
        roles="albedo normal depth variance", direction="both"),
    # The beauty, and the denoiser's variance file beside it.
    "renderman, apart": Renderer("RenderMan", lambda t: {"shot.####.exr": layer("Ci", "rgb", t.color)
        | layer("", "a", t.alpha), "shot_variance.####.exr": layer("albedo", "rgb", t.albedo)
        | layer("normal", "rgb", t.normal) | layer("zfiltered", "z", t.depth) | layer("mse", "rgb", t.variance)
        | layer("sampleCount", "y", np.full_like(t.alpha, SAMPLES)) | layer("forward", "rg", t.following * UP)
        | layer("backward", "rg", t.previous * UP)}, roles="albedo normal depth variance", direction="both"),
    "vray": Renderer("V-Ray", one(lambda t: layer("", "RGBA", t.color, t.alpha)
        | layer("diffuseFilter", "red,green,blue", t.albedo) | layer("normals", "X,Y,Z", t.normal) | {"zDepth": t.depth}
        | layer("velocity", "RGB", t.following, t.depth * 0)), direction="next", attributes={"vrayInfo/camera": "cam"}),
    "vray, prefixed": Renderer("V-Ray", one(lambda t: layer("", "RGBA", t.color, t.alpha)
        | layer("VRayDiffuseFilter", "RGB", t.albedo) | layer("VRayNormals", "RGB", t.normal)
        | layer("VRayZDepth", "R", t.depth) | layer("VRayVelocity", "RGB", t.following * UP, t.depth * 0)),
        direction="next"),
    "karma": Renderer("Karma", one(lambda t: layer("C", "RGBA", t.color, t.alpha) | layer("albedo", "RGB", t.albedo)
        | layer("N", "XYZ", t.normal) | {"hitPz": t.depth}
        | layer("motionvectors", "XYZ", t.following / t.size * UP, t.depth * 0)), direction="next",
        attributes={"husk:render_stats": "{}"}),
    "redshift": Renderer("Redshift", one(lambda t: layer("", "RGBA", t.color, t.alpha)
        | layer("DiffuseFilter", "RGB", t.albedo) | layer("Normals", "RGB", t.normal) | layer("Z", "Z", t.depth)
        | layer("MotionVectors", "RG", t.following * UP)), direction="next"),
    "octane": Renderer("Octane", one(lambda t: layer("Beauty", "RGBA", t.color, t.alpha)
        | layer("Diffuse filter info", "RGB", t.albedo) | layer("Shading normal", "RGB", t.normal)
        | layer("Z-depth", "Z", t.depth) | layer("Motion vector", "RGB", t.following / t.size[0] * UP, t.depth * 0)),
        direction="next"),
    "mitsuba": Renderer("Mitsuba", one(lambda t: layer("my_image", "RGBA", t.color, t.alpha)
        | layer("alb", "RGB", t.albedo) | layer("nn", "XYZ", t.normal) | layer("dd", "T", t.depth))),
    "pbrt": Renderer("pbrt", one(lambda t: layer("", "RGB", t.color) | layer("Albedo", "RGB", t.albedo)
        | layer("N", "XYZ", t.normal) | layer("Ns", "XYZ", t.normal) | layer("Variance", "RGB", t.variance * SAMPLES)
        | layer("RelativeVariance", "RGB", t.variance)), roles="albedo normal variance",
        attributes={"samplesPerPixel": SAMPLES}),
    "moonray": Renderer("MoonRay", one(lambda t: layer("", "RGBA", t.color, t.alpha) | layer("albedo", "RGB", t.albedo)
        | layer("normal", "XYZ", t.normal) | {"depth": t.depth}
        | layer("motionvec", "XY", t.following / t.size * 2 * UP * t.alpha[..., None])), direction="next"),
    "appleseed": Renderer("appleseed", one(lambda t: layer("beauty", "RGBA", t.color, t.alpha)
        | layer("albedo", "RGB", t.albedo) | layer("shading_normal", "RGB", t.normal) | layer("depth", "Z", t.depth)
        | layer("screen_space_velocity", "RGB", magnitude(t.following / t.size))), direction="next"),
    "nuke": Renderer("Nuke", one(lambda t: layer("", "RGBA", t.color, t.alpha) | layer("albedo", "RGB", t.albedo)
        | layer("normal", "XYZ", t.normal) | layer("depth", "Z", t.depth) | layer("forward", "uv", t.following * UP)
        | layer("backward", "uv", t.previous * UP)), direction="both", attributes={"nuke/version": "15.0"}),
    "luxcore": Renderer("LuxCore", lambda t: {"RGB_IMAGEPIPELINE_####.exr": layer("", "RGB", t.color),
        "ALBEDO_####.exr": layer("", "RGB", t.albedo), "AVG_SHADING_NORMAL_####.exr": layer("", "RGB", t.normal),
        "DEPTH_####.exr": {"Y": t.depth}}, spec=""),
    "unreal": Renderer("Unreal", lambda t: {"shot.FinalImage.####.exr": layer("", "RGBA", t.color, t.alpha),
        "shot.FinalImageMovieRenderQueue_WorldNormal.####.exr": layer("", "RGB", t.normal),
        "shot.FinalImageMovieRenderQueue_WorldDepth.####.exr": layer("", "R", t.depth),
        "shot.FinalImageMovieRenderQueue_MotionVectors.####.exr": layer("", "RG", t.following / t.size * UP)},
        roles="normal depth", direction="next", attributes={"unreal/jobName": "shot"}, spec=""),
    "3delight": Renderer("common names", one(lambda t: layer("RGBA", "RGBA", t.color, t.alpha)
        | layer("albedo", "RGB", t.albedo) | layer("N", "XYZ", t.normal) | layer("", "Z", t.depth))),
}  # fmt: skip
