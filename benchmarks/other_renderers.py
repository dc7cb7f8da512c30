"""Render a small shot with Mitsuba 3 or LuxCore, whose pixel filters make neighbouring pixels share noise.

    python benchmarks/other_renderers.py mitsuba OUT [--filter gaussian] [--samples 32] [--references 512]
    python benchmarks/other_renderers.py luxcore-bidir OUT [--filter BLACKMANHARRIS]

Needs ``pip install mitsuba`` or ``pip install pyluxcore``. Writes OUT/sNNN.####.exr, NNN the samples, and
OUT/reference_a and reference_b, two independent renders with the same filter, in the form that `benchmarks/ladder.py`
reads. Without `--filter` each renderer uses its default: Mitsuba a Gaussian, and LuxCore a Blackman-Harris filter,
which its engine BIDIRCPU (`luxcore-bidir`) splats and PATHCPU (`luxcore-path`) samples.

Spheres of metal, glass and clay lie on a checkered floor before a wall; the camera moves around them. Neither renderer
writes motion vectors: they are computed from the first surface at the middle of each pixel.
"""

import argparse
import os
import sys
import tempfile
import time
from collections.abc import Iterator
from pathlib import Path
from typing import Any, NamedTuple

import numpy as np

sys.path.insert(0, str(Path(__file__).resolve().parent.parent))

from hybrid.files.exr import read_exr
from hybrid.files.frame import Array
from tests.exr_files import write_layers

WIDTH, HEIGHT, FIELD = 192, 108, 50.0  # pixels, and horizontal degrees
SPHERES = {
    "metal": ((-0.8, 0.3, 0.5), 0.5),
    "glass": ((0.35, -0.5, 0.35), 0.35),
    "clay": ((0.7, 0.9, 0.6), 0.6),
    "lamp": ((-1.5, -1.5, 2.5), 0.35),
}
EXTENT, WALL = 7.0, 2.4  # half the sides of floor and wall, and the distance of the wall
CHECKS = 20
COLORS = {"light": (0.5, 0.45, 0.35), "dark": (0.2, 0.22, 0.3), "wall": (0.45, 0.5, 0.55), "clay": (0.6, 0.25, 0.15)}
LAMP, SKY = (30.0, 27.0, 22.0), (0.1, 0.12, 0.16)
DEPTH = 8  # bounces
RENDERERS = ("mitsuba", "luxcore-path", "luxcore-bidir")
REFERENCE_FRAMES = 3, 4, 5
FRAMES = range(1, 8)


class Camera(NamedTuple):
    """A camera in one frame: its place, and its axes to the right, up and forward."""

    origin: np.ndarray
    axes: np.ndarray

    @classmethod
    def of(cls, frame: int) -> "Camera":
        angle = 0.3 + 0.05 * frame
        origin = np.array([3.0 * np.sin(angle), -3.0 * np.cos(angle), 1.3])
        forward = TARGET - origin
        forward /= np.linalg.norm(forward)
        right = np.cross(forward, (0, 0, 1))
        right /= np.linalg.norm(right)
        return cls(origin, np.stack([right, np.cross(right, forward), forward]))

    def project(self, points: np.ndarray) -> np.ndarray:
        """Pixels (..., 2) of points (..., 3), x to the right, y down."""
        right, up, forward = np.moveaxis((points - self.origin) @ self.axes.T, -1, 0)
        scale = WIDTH / 2 / np.tan(np.radians(FIELD / 2))
        return np.stack([WIDTH / 2 + scale * right / forward, HEIGHT / 2 - scale * up / forward], axis=-1)

    def first_hits(self) -> np.ndarray:
        """The first surface (H, W, 3) at the middle of each pixel."""
        y, x = np.mgrid[:HEIGHT, :WIDTH] + 0.5
        scale = np.tan(np.radians(FIELD / 2)) / (WIDTH / 2)
        rays = np.stack([(x - WIDTH / 2) * scale, (HEIGHT / 2 - y) * scale, np.ones_like(x)], axis=-1) @ self.axes
        distance = np.full(x.shape, np.inf)
        for axis, plane in ((2, 0.0), (1, WALL)):
            with np.errstate(divide="ignore"):
                there = (plane - self.origin[axis]) / rays[..., axis]
            distance = np.where((there > 0) & (there < distance), there, distance)
        for center, radius in SPHERES.values():
            offset, square = self.origin - center, np.square(rays).sum(-1)
            half = rays @ offset
            root = half**2 - square * (offset @ offset - radius**2)
            there = (-half - np.sqrt(np.maximum(root, 0))) / square
            distance = np.where((root > 0) & (there > 0) & (there < distance), there, distance)
        return np.asarray(self.origin + distance[..., None] * rays)


TARGET = np.array([0.0, 0.1, 0.5])


def motion(frame: int) -> dict[str, Array]:
    """Vectors of a frame to the frame before and the frame after, pixels, y down."""
    points = Camera.of(frame).first_hits()
    here = Camera.of(frame).project(points)
    steps = {"motion": frame - 1, "motion_next": frame + 1}
    return {name: np.asarray(Camera.of(there).project(points) - here, np.float32) for name, there in steps.items()}


# Mitsuba.


def mitsuba_scene(frame: int, pixel_filter: str | None) -> dict[str, Any]:
    """The scene as a dictionary of Mitsuba."""
    import mitsuba as mi

    transform, camera = mi.ScalarTransform4f, Camera.of(frame)

    def color(values: tuple[float, ...]) -> dict[str, Any]:
        return {"type": "rgb", "value": list(values)}

    def diffuse(reflectance: dict[str, Any]) -> dict[str, Any]:
        return {"type": "twosided", "bsdf": {"type": "diffuse", "reflectance": reflectance}}

    checks = {
        "type": "checkerboard",
        "color0": color(COLORS["light"]),
        "color1": color(COLORS["dark"]),
        "to_uv": transform().scale(CHECKS),
    }
    surfaces = {
        "metal": {"type": "roughconductor", "material": "Cu", "alpha": 0.12},
        "glass": {"type": "dielectric"},
        "clay": {"type": "diffuse", "reflectance": color(COLORS["clay"])},
    }
    spheres = {
        name: {"type": "sphere", "center": list(center), "radius": radius}
        | ({"surface": surfaces[name]} if name in surfaces else {"light": {"type": "area", "radiance": color(LAMP)}})
        for name, (center, radius) in SPHERES.items()
    }
    view = transform().look_at(origin=list(camera.origin), target=list(TARGET), up=[0, 0, 1])
    film = {"type": "hdrfilm", "width": WIDTH, "height": HEIGHT, "pixel_format": "rgb", "component_format": "float32"}
    if pixel_filter is not None:
        film["rfilter"] = {"type": pixel_filter}
    return {
        "type": "scene",
        "integrator": {
            "type": "aov",
            "aovs": "albedo:albedo,nn:sh_normal",
            "path": {"type": "path", "max_depth": DEPTH},
        },
        "sensor": {"type": "perspective", "fov": FIELD, "to_world": view, "film": film},
        "floor": {"type": "rectangle", "to_world": transform().scale(EXTENT), "surface": diffuse(checks)},
        "wall": {
            "type": "rectangle",
            "to_world": transform().translate([0, WALL, 0]).rotate([1, 0, 0], 90).scale(EXTENT),
            "surface": diffuse(color(COLORS["wall"])),
        },
        "sky": {"type": "constant", "radiance": color(SKY)},
        **spheres,
    }


def render_mitsuba(frame: int, pixel_filter: str | None, samples: int, seed: int) -> dict[str, Array]:
    """Color, albedo and normal of a frame, under the names of Mitsuba."""
    import mitsuba as mi

    if mi.variant() is None:
        mi.set_variant("scalar_rgb")
    image = np.array(mi.render(mi.load_dict(mitsuba_scene(frame, pixel_filter)), spp=samples, seed=seed))
    return {"": image[..., :3], "albedo": image[..., 3:6], "nn": image[..., 6:9]}


# LuxCore.


def _sphere(center: tuple[float, ...], radius: float, sides: int = 64) -> tuple[Any, ...]:
    """Vertices, triangles and normals of a sphere, on circles of latitude."""
    rings = sides // 2
    latitude, longitude = np.meshgrid(
        np.linspace(0, np.pi, rings + 1), np.linspace(0, 2 * np.pi, sides + 1), indexing="ij"
    )
    normals = np.stack(
        [np.sin(latitude) * np.cos(longitude), np.sin(latitude) * np.sin(longitude), np.cos(latitude)], axis=-1
    ).reshape(-1, 3)
    corner = (np.arange(rings)[:, None] * (sides + 1) + np.arange(sides)).ravel()
    below = corner + sides + 1
    triangles = np.concatenate(
        [np.stack([corner, below, below + 1], axis=1), np.stack([corner, below + 1, corner + 1], axis=1)]
    )
    return _mesh(np.array(center) + radius * normals, triangles, normals, np.zeros((len(normals), 2)))


def _plane(corners: list[tuple[float, ...]], normal: tuple[float, ...]) -> tuple[Any, ...]:
    """Vertices, triangles and normals of a rectangle."""
    edges = np.array([(0, 0), (1, 0), (1, 1), (0, 1)])
    return _mesh(np.array(corners), np.array([(0, 1, 2), (0, 2, 3)]), np.array([normal] * 4), edges)


def _mesh(*parts: np.ndarray) -> tuple[Any, ...]:
    """Arrays as LuxCore takes them."""
    return tuple([tuple(row) for row in part.tolist()] for part in parts)


def luxcore_scene(frame: int) -> Any:
    """The scene as an object of LuxCore."""
    import pyluxcore

    scene, camera = pyluxcore.Scene(), Camera.of(frame)

    def words(values: Any) -> str:
        return " ".join(f"{value:.6f}" for value in values)

    lines = [
        "scene.camera.type = perspective",
        f"scene.camera.lookat.orig = {words(camera.origin)}",
        f"scene.camera.lookat.target = {words(TARGET)}",
        "scene.camera.up = 0 0 1",
        f"scene.camera.fieldofview = {FIELD}",
        "scene.textures.checks.type = checkerboard2d",
        f"scene.textures.checks.texture1 = {words(COLORS['light'])}",
        f"scene.textures.checks.texture2 = {words(COLORS['dark'])}",
        "scene.textures.checks.mapping.type = uvmapping2d",
        f"scene.textures.checks.mapping.uvscale = {2 * CHECKS} {2 * CHECKS}",
        "scene.textures.copper.type = fresnelcolor",
        "scene.textures.copper.kr = 0.95 0.64 0.54",
        "scene.materials.floor.type = matte",
        "scene.materials.floor.kd = checks",
        "scene.materials.wall.type = matte",
        f"scene.materials.wall.kd = {words(COLORS['wall'])}",
        "scene.materials.metal.type = metal2",
        "scene.materials.metal.fresnel = copper",
        "scene.materials.metal.uroughness = 0.12",
        "scene.materials.metal.vroughness = 0.12",
        "scene.materials.glass.type = glass",
        "scene.materials.glass.interiorior = 1.5",
        "scene.materials.clay.type = matte",
        f"scene.materials.clay.kd = {words(COLORS['clay'])}",
        "scene.materials.lamp.type = matte",
        "scene.materials.lamp.kd = 0 0 0",
        f"scene.materials.lamp.emission = {words(LAMP)}",
        "scene.lights.sky.type = constantinfinite",
        f"scene.lights.sky.color = {words(SKY)}",
    ]
    e = EXTENT
    meshes = {name: _sphere(*place) for name, place in SPHERES.items()}
    meshes["floor"] = _plane([(-e, -e, 0), (e, -e, 0), (e, e, 0), (-e, e, 0)], (0, 0, 1))
    meshes["wall"] = _plane([(-e, WALL, -e), (e, WALL, -e), (e, WALL, e), (-e, WALL, e)], (0, -1, 0))
    for name, mesh in meshes.items():
        scene.DefineMesh(f"mesh_{name}", *mesh, None, None)
        lines += [f"scene.objects.{name}.shape = mesh_{name}", f"scene.objects.{name}.material = {name}"]
    properties = pyluxcore.Properties()
    properties.SetFromString("\n".join(lines))
    scene.Parse(properties)
    return scene


def render_luxcore(engine: str, frame: int, pixel_filter: str | None, samples: int, seed: int) -> dict[str, Array]:
    """Color, albedo and normal of a frame, under the names that Blender's add-on gives them."""
    import pyluxcore

    pyluxcore.Init(lambda _: None)
    outputs = {"Combined": "RGB_IMAGEPIPELINE", "ALBEDO": "ALBEDO", "AVG_SHADING_NORMAL": "AVG_SHADING_NORMAL"}
    with tempfile.TemporaryDirectory() as folder:
        lines = [
            f"renderengine.type = {engine}",
            f"renderengine.seed = {seed}",
            "sampler.type = SOBOL",
            *(f"{name} = {DEPTH}" for name in ("path.pathdepth.total", "path.maxdepth", "light.maxdepth")),
            f"film.width = {WIDTH}",
            f"film.height = {HEIGHT}",
            "film.imagepipelines.0.0.type = NOP",
            f"batch.haltspp = {samples}",
            *([] if pixel_filter is None else [f"film.filter.type = {pixel_filter}"]),
        ]
        for index, output in enumerate(outputs.values()):
            lines += [f"film.outputs.{index}.type = {output}", f"film.outputs.{index}.filename = {folder}/{output}.exr"]
        properties = pyluxcore.Properties()
        properties.SetFromString("\n".join(lines))
        session = pyluxcore.RenderSession(pyluxcore.RenderConfig(properties, luxcore_scene(frame)))
        session.Start()
        while not session.HasDone():
            time.sleep(0.05)
            session.UpdateStats()
        session.Stop()
        session.GetFilm().Save()
        layers = {}
        for name, output in outputs.items():
            image = read_exr(Path(folder) / f"{output}.exr")
            layers[f"ViewLayer.{name}"] = image.pixels(image.layers[0].channels)[..., :3]
    return layers


def render(renderer: str, frame: int, pixel_filter: str | None, samples: int, seed: int) -> dict[str, Array]:
    """Layers of a frame by one of `RENDERERS`."""
    if renderer == "mitsuba":
        return render_mitsuba(frame, pixel_filter, samples, seed)
    engine = {"luxcore-path": "PATHCPU", "luxcore-bidir": "BIDIRCPU"}[renderer]
    return render_luxcore(engine, frame, pixel_filter, samples, seed)


def renders(samples: int, references: int) -> Iterator[tuple[str, int, int, int]]:
    """Name, frame, samples and seed of each render; every seed is another one."""
    for frame in FRAMES:
        yield f"s{samples:03d}", frame, samples, 1000 + frame
    for half, seed in (("a", 2000), ("b", 3000)):
        for frame in REFERENCE_FRAMES:
            yield f"reference_{half}", frame, references, seed + frame


def main() -> int:
    parser = argparse.ArgumentParser(description=__doc__.split("\n")[0])
    parser.add_argument("renderer", choices=RENDERERS)
    parser.add_argument("out", type=Path)
    parser.add_argument("--filter", help="name of a pixel filter of the renderer; default: its own")
    parser.add_argument("--samples", type=int, default=32)
    parser.add_argument("--references", type=int, default=512, help="samples of each reference")
    options = parser.parse_args()
    options.out.mkdir(parents=True, exist_ok=True)
    attributes = {"generatedBy": "Mitsuba"} if options.renderer == "mitsuba" else {}
    for name, frame, samples, seed in renders(options.samples, options.references):
        path = options.out / f"{name}.{frame:04d}.exr"
        if path.exists():
            continue
        layers = render(options.renderer, frame, options.filter, samples, seed) | motion(frame)
        write_layers(path.with_suffix(".part"), layers, attributes=attributes)
        path.with_suffix(".part").replace(path)
        print(path, flush=True)
    if options.renderer.startswith("luxcore"):
        os._exit(0)  # pyluxcore may crash while the interpreter ends
    return 0


if __name__ == "__main__":
    raise SystemExit(main())
