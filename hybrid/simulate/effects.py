"""The contents of a scene, and the effects of Cycles that it needs.

`facts_of` reads a Blender scene into plain numbers, `effects_of` turns the numbers into decisions, each with its
figure, threshold and reason, and `needed_bounces` measures with a few samples how deep light paths have to be. Only
`facts_of` needs Blender: the rules are functions of plain data.
"""

from collections.abc import Callable, Iterable
from dataclasses import dataclass
from typing import Any

import numpy as np

DEEP = 32  # bounces, as in Cycles' own preset "Full Global Illumination"
BOUNCE_KINDS = ("diffuse", "glossy", "transmission", "volume")
PASSES = (
    *(f"layer.use_pass_{name}" for name in ("position", "normal", "mist", "uv", "object_index")),
    "layer.cycles.pass_debug_sample_count",
)
# All that a scene might need, switched on.
EVERYTHING: dict[str, Any] = {
    **{f"cycles.{kind}_bounces": DEEP for kind in ("max", *BOUNCE_KINDS)},
    "cycles.transparent_max_bounces": DEEP,
    "cycles.caustics_reflective": True,
    "cycles.caustics_refractive": True,
    "cycles.use_light_tree": True,
    **dict.fromkeys(PASSES, True),
}

BLUR_PIXELS = 0.1  # a tenth of the pixel filter's width cannot be seen through it
SMALL_LIGHT = 0.1  # radius over distance to the camera: below, a reflection of the light is a caustic
MIRROR_ROUGHNESS = 0.2  # at roughness 0.2 the lobe is some 5° wide: light it focuses is still sharp

# The cost of truncated paths: six figures of 0.05 % stay well within the 0.5 % by which all of them together may
# change the mean; a tenth of the noise is not significant in a two-seed test of ten frames.
MEAN_FRACTION = 0.0005
NOISE_FRACTION = 0.1
BLOCK = 8  # pixels
PILOT_SAMPLES = 8


@dataclass(frozen=True)
class SceneFacts:
    """The contents of a scene, as seen by one camera over a range of frames.

    Each material that a rendered object uses is counted once. Motion and blur are in pixels of the rendered image.
    """

    motion_pixels: float = 0.0  # fastest visible motion, per frame
    moving_lights: int = 0
    blur_asked: bool = False
    shutter: float = 0.5  # frames
    aperture_pixels: float = 0.0  # largest visible circle of confusion
    glossy: int = 0  # materials with any glossy lobe
    mirrors: int = 0  # glossy or transmissive materials smoother than MIRROR_ROUGHNESS
    transmissive: int = 0
    transparent: int = 0  # alpha below one: leaves, curtains
    subsurface: int = 0
    volumes: int = 0  # materials, and the world
    hair: int = 0  # objects
    lamps: int = 0  # of nonzero size: indirect rays pass through a lamp as through a transparent surface
    lights: int = 0  # lamps, emissive objects, and the world unless black
    small_lights: int = 0  # smaller than SMALL_LIGHT times their distance
    world: str = "none"  # none, constant, image, sky


@dataclass(frozen=True)
class EffectDecision:
    """Whether a scene needs an effect, why, and the settings of Cycles that follow."""

    effect: str
    on: bool
    figure: float | str
    threshold: float | str
    reason: str
    settings: dict[str, Any]

    def __str__(self) -> str:
        figure = f"{self.figure:.3g}" if isinstance(self.figure, float) else self.figure
        return f"{'+' if self.on else '-'} {self.effect:<15} {figure} (threshold {self.threshold}): {self.reason}"


def effects_of(facts: SceneFacts) -> list[EffectDecision]:
    """Decide which effects a scene needs; `settings_of` merges the settings of the decisions.

    No rule changes the image: a kind of bounce gets depth 0 only if no material can cause it. Whether a *possible*
    bounce is worth its time is measured by `needed_bounces`.
    """
    blurred = float(facts.motion_pixels * facts.shutter)
    moves = blurred >= BLUR_PIXELS or facts.moving_lights > 0
    opens, defocus = facts.blur_asked and moves, facts.aperture_pixels >= BLUR_PIXELS
    blur_reason = ("moves while the shutter is open" if moves else "nothing moves") if facts.blur_asked else ""
    surfaces, sharp = facts.glossy + facts.transmissive, facts.mirrors + facts.transmissive
    caustics = {"cycles.caustics_reflective": facts.glossy > 0, "cycles.caustics_refractive": facts.transmissive > 0}
    many, lit = facts.lights >= 2, facts.world != "none"  # with one light there is nothing to choose between
    return [
        EffectDecision("motion blur", opens, blurred, f"{BLUR_PIXELS:g} px", blur_reason or "not asked for",
                       {"render.use_motion_blur": opens}),
        EffectDecision("depth of field", defocus, float(facts.aperture_pixels), f"{BLUR_PIXELS:g} px",
                       "largest circle of confusion in the image", {"camera.dof.use_dof": defocus}),
        _counted("glossy paths", facts.glossy, "materials with a glossy lobe", "cycles.glossy_bounces"),
        _counted("transmission", facts.transmissive, "transmissive materials", "cycles.transmission_bounces"),
        EffectDecision(
            "caustics", surfaces > 0, surfaces, 1,
            f"{sharp} mirror-like or refractive materials, {facts.small_lights} small lights; kept, as a pilot of few "
            "samples cannot find rare paths"
            if surfaces
            else "no surface reflects or refracts light onto another",
            caustics,
        ),
        # Depth 0 would also end every path at the first lamp that it passes through, and lose the light behind.
        _counted("transparency", facts.transparent + facts.lamps,
                 "materials with alpha below one, or lamps that rays pass through", "cycles.transparent_max_bounces"),
        _counted("volumes", facts.volumes, "materials with a volume, or the world", "cycles.volume_bounces"),
        _counted("subsurface", facts.subsurface, "materials; Cycles needs no switch for it"),
        _counted("hair", facts.hair, "objects; Cycles needs no switch for it"),
        EffectDecision("light tree", many, facts.lights, 2, "lights to choose between",
                       {"cycles.use_light_tree": many}),
        EffectDecision("sky", lit, facts.world, "shines",
                       "the world is sampled as a light" if lit else "the world is black",
                       {} if lit else {"world.cycles.sampling_method": "NONE"}),
        EffectDecision("more passes", False, len(PASSES), "asked for",
                       "colour, guides, depth and vectors are enough", dict.fromkeys(PASSES, False)),
    ]  # fmt: skip


def _counted(effect: str, count: int, what: str, depth: str | None = None) -> EffectDecision:
    """An effect that is on where something causes it; `depth` names the setting that is 0 otherwise."""
    settings = {depth: 0} if depth and not count else {}
    return EffectDecision(effect, count > 0, count, 1, what if count else f"no {what}", settings)


def settings_of(decisions: Iterable[EffectDecision], base: dict[str, Any] | None = None) -> dict[str, Any]:
    """Return the Cycles settings of `decisions`, applied over `base` (None: `EVERYTHING`)."""
    settings = dict(EVERYTHING if base is None else base)
    for decision in decisions:
        settings.update(decision.settings)
    return settings


def needed_bounces(
    render: Callable[[dict[str, Any], int], np.ndarray], settings: dict[str, Any], target_samples: int
) -> list[EffectDecision]:
    """Measure how many bounces an image needs: all together, and of each kind that `settings` allow.

    `render(settings, seed)` returns a pilot, (H, W, 3) float32 linear radiance, of `PILOT_SAMPLES` per pixel; the
    same seed must give the same paths. `target_samples` are those of the cleanest image to be rendered.

    With one seed, an image of depth d and one of unlimited depth share all paths up to d, so their difference Δ is the
    light from deeper paths, without the noise of the rest. A depth is enough if

        |mean(Δ)| + 2 s(Δ)/√N ≤ MEAN_FRACTION · mean(I)   and
        mean_b |Δ_b| ≤ NOISE_FRACTION · mean |A − B| / √2 · √(m/n)

    with s(Δ) the standard deviation over the N pixels, Δ_b the means of 8×8 blocks, A and B two seeds, m and n the
    samples of the pilot and of the image. Light from deep paths is rare and strong, so a few samples may have missed
    most of it: hence the standard error in the bound. The second criterion uses first moments, because one firefly
    would dominate second ones. All bounces together are decided first, which leaves few depths to try for each kind.
    """
    full = render(settings, 1)
    noise = float(np.mean(np.abs(full - render(settings, 2)))) / np.sqrt(2) * np.sqrt(PILOT_SAMPLES / target_samples)
    mean = float(np.mean(full))

    def lost(complete: np.ndarray, trial: dict[str, Any]) -> tuple[float, float]:
        """Return the light that the trial may lose, as fractions of the mean and of the noise."""
        missing = complete - render(trial, 1)
        pixels = missing.mean(axis=-1)
        bound = abs(float(pixels.mean())) + 2 * float(pixels.std()) / np.sqrt(pixels.size)
        blocks = float(np.abs(_block_means(missing)).mean())
        return bound / mean if mean > 0 else 0.0, blocks / noise if noise > 0 else 0.0  # 0/0 of a black image

    decisions: list[EffectDecision] = []
    lean, complete = dict(settings), full
    for kind in ("max", *BOUNCE_KINDS, "transparent"):
        name = "cycles.transparent_max_bounces" if kind == "transparent" else f"cycles.{kind}_bounces"
        if settings[name] == 0:
            continue
        # No kind of bounce can happen more often than all together; transparent ones are counted separately.
        deepest = settings[name] if kind in ("max", "transparent") else lean["cycles.max_bounces"]
        # The shallowest sufficient one is taken.
        depths = [depth for depth in (0, 1, 2, 3, 4, 6, 8, 12, 16, 24) if depth < deepest]
        base = {**settings, "cycles.max_bounces": lean["cycles.max_bounces"]}
        low, high, figures = 0, len(depths), (0.0, 0.0)
        while low < high:  # bisection: the lost light falls with the depth
            middle = (low + high) // 2
            trial = lost(complete, {**base, name: depths[middle]})
            if trial[0] <= MEAN_FRACTION and trial[1] <= NOISE_FRACTION:
                high, figures = middle, trial
            else:
                low = middle + 1
        enough = depths[high] if high < len(depths) else deepest
        lean[name] = enough
        if kind == "max" and enough < deepest:
            complete = render(lean, 1)
        effect = f"{kind} bounces" if kind != "max" else "all bounces"
        threshold = f"{100 * MEAN_FRACTION:g} % of the mean, {NOISE_FRACTION:g} of the noise"
        reason = f"deeper paths bring at most {100 * figures[0]:.2g} % of the mean, {figures[1]:.2g} of the noise"
        decisions.append(EffectDecision(effect, enough > 0, enough, threshold, reason, {name: enough}))
    return decisions


def _block_means(image: np.ndarray) -> np.ndarray:
    """Return the means of whole blocks of an (H, W, C) image; of all of it where it is smaller than one."""
    h, w = (n // BLOCK * BLOCK if n >= BLOCK else n for n in image.shape[:2])
    bh, bw = min(BLOCK, h), min(BLOCK, w)
    return np.asarray(image[:h, :w].reshape(h // bh, bh, w // bw, bw, -1).mean(axis=(1, 3)))


# Reading a Blender scene


def facts_of(scene: Any, frames: Iterable[int], blur_asked: bool = False) -> SceneFacts:
    """Read what a Blender scene with a camera contains over the frames that will be rendered."""
    frames = list(frames)
    scene.frame_set(frames[len(frames) // 2])
    objects = [item for item in scene.objects if not item.hide_render]
    counts = dict.fromkeys(("glossy", "mirrors", "transmissive", "transparent", "subsurface", "volumes"), 0)
    emissive: set[str] = set()
    for material in {slot.material for item in objects for slot in item.material_slots if slot.material}:
        lobes = _lobes(material.node_tree)
        if "emission" in lobes:
            emissive.add(material.name)
        for kind in counts:
            counts[kind] += kind in lobes
    eye = scene.camera.matrix_world.translation
    lamps = [item for item in objects if item.type == "LIGHT" and item.data.energy > 0]
    glowing = [o for o in objects if any(s.material and s.material.name in emissive for s in o.material_slots)]
    world = _world_kind(scene.world)
    if scene.world is not None and scene.world.node_tree is not None:
        counts["volumes"] += "volumes" in _lobes(scene.world.node_tree)
    motion, moving_lights = _motion(scene, frames)
    return SceneFacts(
        motion_pixels=motion,
        moving_lights=moving_lights,
        blur_asked=blur_asked,
        shutter=scene.render.motion_blur_shutter,
        aperture_pixels=_circle_of_confusion(scene) if scene.camera.data.dof.use_dof else 0.0,
        hair=sum(o.type == "CURVES" or len(getattr(o, "particle_systems", ())) > 0 for o in objects),
        lamps=sum(_radius(item) > 0 for item in lamps),
        lights=len(lamps) + len(glowing) + (world != "none"),
        small_lights=sum(_radius(item) < SMALL_LIGHT * (item.matrix_world.translation - eye).length for item in lamps),
        world=world,
        **counts,
    )


# The shader nodes that have a lobe. The Principled shader has those whose input is above 0.
NODES_OF_LOBE = {
    "glossy": {"BSDF_GLOSSY", "BSDF_METALLIC", "BSDF_GLASS", "BSDF_SHEEN", "BSDF_HAIR", "BSDF_HAIR_PRINCIPLED"},
    "transmissive": {"BSDF_GLASS", "BSDF_REFRACTION", "BSDF_TRANSLUCENT", "BSDF_HAIR", "BSDF_HAIR_PRINCIPLED"},
    "transparent": {"BSDF_TRANSPARENT"},
    "subsurface": {"SUBSURFACE_SCATTERING"},
    "emission": {"EMISSION"},
    "volumes": {"VOLUME_SCATTER", "VOLUME_ABSORPTION", "PRINCIPLED_VOLUME", "VOLUME_COEFFICIENTS"},
}
LOBE_OF_INPUT = {
    **dict.fromkeys(("Metallic", "Specular IOR Level", "Coat Weight", "Sheen Weight"), "glossy"),
    "Transmission Weight": "transmissive",
    "Subsurface Weight": "subsurface",
    "Emission Strength": "emission",
}


def _lobes(tree: Any) -> set[str]:
    """Return the lobes of the shaders of a node tree, and of the groups in it."""
    found: set[str] = set()
    for node in tree.nodes if tree is not None else ():
        if node.type == "GROUP":
            found |= _lobes(node.node_tree)
            continue
        if node.mute or not any(output.is_linked for output in node.outputs):
            continue
        lobes = {lobe for lobe, types in NODES_OF_LOBE.items() if node.type in types}
        if node.type == "BSDF_PRINCIPLED":
            lobes |= {lobe for name, lobe in LOBE_OF_INPUT.items() if _largest(node.inputs[name]) > 0}
            if node.inputs["Alpha"].is_linked or node.inputs["Alpha"].default_value < 1:
                lobes.add("transparent")
        rough = node.inputs.get("Roughness")
        sharp = rough is not None and not rough.is_linked and rough.default_value < MIRROR_ROUGHNESS
        if sharp and lobes & {"glossy", "transmissive"}:
            lobes.add("mirrors")
        found |= lobes
    return found


def _largest(socket: Any) -> float:
    """Return the value of a socket; 1 if it is linked."""
    return 1.0 if socket.is_linked else float(socket.default_value)


def _radius(lamp: Any) -> float:
    """Return the radius of a lamp; of a sun, as seen from a distance of one."""
    data = lamp.data
    if data.type in ("SUN", "AREA"):
        return float((data.angle if data.type == "SUN" else data.size) / 2)
    return float(data.shadow_soft_size)


def _world_kind(world: Any) -> str:
    """Return which kind of light the world gives, as in `SceneFacts.world`."""
    if world is None:
        return "none"
    if world.node_tree is None:
        return "constant" if max(world.color) > 0 else "none"
    linked = [node for node in world.node_tree.nodes if any(output.is_linked for output in node.outputs)]
    for kind, type_ in (("sky", "TEX_SKY"), ("image", "TEX_ENVIRONMENT")):
        if any(node.type == type_ for node in linked):
            return kind
    for node in linked:
        if node.type in ("BACKGROUND", "EMISSION"):
            color, strength = node.inputs["Color"], node.inputs["Strength"]
            if _largest(strength) > 0 and (color.is_linked or max(color.default_value[:3]) > 0):
                return "constant"
    return "none"


def visible_points(scene: Any, across: int = 12, down: int = 8) -> list[tuple[Any, Any]]:
    """Return where a grid of camera rays over the rendered region first hits a surface (no hair), and the object."""
    import bpy

    render, camera = scene.render, scene.camera
    x0, x1, y0, y1 = 0.0, 1.0, 0.0, 1.0
    if render.use_border:
        x0, x1, y0, y1 = render.border_min_x, render.border_max_x, render.border_min_y, render.border_max_y
    top_right, bottom_right, bottom_left, _ = (camera.matrix_world @ v for v in camera.data.view_frame(scene=scene))
    eye = camera.matrix_world.translation
    forward, flat = -camera.matrix_world.to_3x3().col[2], camera.data.type == "ORTHO"
    graph = bpy.context.evaluated_depsgraph_get()
    found = []
    for j in range(down):
        for i in range(across):
            x, y = x0 + (x1 - x0) * (i + 0.5) / across, y0 + (y1 - y0) * (j + 0.5) / down
            target = bottom_left + x * (bottom_right - bottom_left) + y * (top_right - bottom_right)
            start, toward = (target - forward * (target - eye).dot(forward), forward) if flat else (eye, target - eye)
            hit, position, _, _, item, _ = scene.ray_cast(graph, start, toward.normalized())
            if hit:
                found.append((position.copy(), item))
    return found


def film_pixel(scene: Any, position: Any) -> np.ndarray:
    """Return the (x, y) of a world position in the whole image, in pixels; NaN behind the camera."""
    from bpy_extras.object_utils import world_to_camera_view

    render = scene.render
    scale = render.resolution_percentage / 100
    view = world_to_camera_view(scene, scene.camera, position)
    if view.z <= 0:
        return np.full(2, np.nan)
    return np.array([view.x * render.resolution_x * scale, view.y * render.resolution_y * scale])


def point_motion(scene: Any, frame: int) -> np.ndarray:
    """Return how far visible points move, with objects but without deformation, to the next frame: (N,) pixels."""
    scene.frame_set(frame)
    points = visible_points(scene)
    local = [item.matrix_world.inverted_safe() @ position for position, item in points]
    before = [film_pixel(scene, position) for position, _ in points]
    scene.frame_set(frame + 1)
    after = [film_pixel(scene, item.matrix_world @ p) for p, (_, item) in zip(local, points, strict=True)]
    scene.frame_set(frame)
    moved = np.linalg.norm(np.array(after).reshape(-1, 2) - np.array(before).reshape(-1, 2), axis=1)
    return np.asarray(moved[np.isfinite(moved)])


def _motion(scene: Any, frames: list[int]) -> tuple[float, int]:
    """Return the fastest motion in pixels per frame, and how many lights move."""
    lamps = [item for item in scene.objects if item.type == "LIGHT" and not item.hide_render]
    fastest, moving = 0.0, set()
    for frame in sorted({frames[0], frames[len(frames) // 2], frames[-1]}):
        motion = point_motion(scene, frame)
        fastest = max(fastest, float(motion.max())) if motion.size else fastest
        before = {lamp.name: (lamp.matrix_world.copy(), lamp.data.energy) for lamp in lamps}
        scene.frame_set(frame + 1)
        moving |= {lamp.name for lamp in lamps if (lamp.matrix_world, lamp.data.energy) != before[lamp.name]}
        # The transform of a deforming mesh does not show its motion; its shape keys and modifiers do.
        for item in scene.objects:
            keys = getattr(item.data, "shape_keys", None) if item.type == "MESH" else None
            waves = any(modifier.type in ("WAVE", "ARMATURE", "CLOTH") for modifier in item.modifiers)
            if waves or (keys is not None and keys.animation_data is not None):
                fastest = max(fastest, 1.0)  # unknown, but not nothing
    scene.frame_set(frames[len(frames) // 2])
    return fastest, len(moving)


def _circle_of_confusion(scene: Any) -> float:
    """Return the diameter of the largest circle of confusion in the image, in pixels."""
    camera, data = scene.camera, scene.camera.data
    eye, forward = camera.matrix_world.translation, camera.matrix_world.to_3x3().col[2] * -1
    focus = data.dof.focus_distance
    if data.dof.focus_object is not None:
        focus = (data.dof.focus_object.matrix_world.translation - eye).dot(forward)
    lens = data.lens / 1000 / data.dof.aperture_fstop  # metres, as Cycles takes it
    pixels = scene.render.resolution_x * scene.render.resolution_percentage / 100 / (data.sensor_width / data.lens)
    distances = [max((position - eye).dot(forward), 1e-6) for position, _ in visible_points(scene)] or [1e6]
    return float(max(lens * abs(1 / focus - 1 / distance) * pixels for distance in distances))
