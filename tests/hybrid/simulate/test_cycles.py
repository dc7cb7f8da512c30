"""Cycles itself, tiny: what a shot's files hold, vectors, levels, effects. Skipped where bpy is not installed."""

import json
import subprocess
import sys
import time
from pathlib import Path

import numpy as np
import OpenEXR
import pytest

from hybrid.simulate.run import simulate
from hybrid.simulate.shot import RANDOM, ShotSettings

pytestmark = pytest.mark.cycles
pytest.importorskip("bpy", reason="renders with Cycles: pip install bpy==5.0.1")

SIZE = (64, 36)
SCENES = Path(__file__).parents[3] / "examples" / "scenes"

# A textured floor and wall, a cube that moves 3 px a frame to the right, one lamp, no glossy or glass anything.
SCENE = """
import bpy, sys
bpy.ops.wm.read_factory_settings(use_empty=True)
scene = bpy.context.scene
def surface(scale):
    made = bpy.data.materials.new("m"); made.use_nodes = True
    tree = made.node_tree
    shader = tree.nodes["Principled BSDF"]
    shader.inputs["Specular IOR Level"].default_value = 0
    noise, where = tree.nodes.new("ShaderNodeTexNoise"), tree.nodes.new("ShaderNodeTexCoord")
    noise.inputs["Scale"].default_value = scale
    tree.links.new(where.outputs["Object"], noise.inputs["Vector"])
    tree.links.new(noise.outputs["Color"], shader.inputs["Base Color"])
    return made
def add(location, size, material):
    bpy.ops.mesh.primitive_cube_add(size=1, location=location)
    item = bpy.context.active_object
    item.scale = size
    item.data.materials.append(material)
    return item
add((0, 5, 0), (20, 1, 20), surface(1.0))
cube = add((0, 1, 0), (1.2, 1.2, 1.2), surface(2.0))
camera = bpy.data.objects.new("camera", bpy.data.cameras.new("camera"))
scene.collection.objects.link(camera)
camera.location, camera.rotation_euler, scene.camera = (0, -5, 0), (1.5707963, 0, 0), camera
camera.data.type, camera.data.ortho_scale = "ORTHO", 6.4
for frame in range(-2, 6):
    cube.location.x = 0.3 * (frame - 2)
    cube.keyframe_insert("location", frame=frame)
lamp = bpy.data.objects.new("lamp", bpy.data.lights.new("lamp", "SUN"))
scene.collection.objects.link(lamp)
lamp.data.energy, lamp.rotation_euler = 3, (0.9, 0, 0.5)
bpy.ops.wm.save_as_mainfile(filepath=sys.argv[1])
"""


@pytest.fixture(scope="module")
def scene(tmp_path_factory):
    path = tmp_path_factory.mktemp("scene") / "cube.blend"
    subprocess.run([sys.executable, "-c", SCENE, str(path)], check=True, capture_output=True)
    return path


@pytest.fixture(scope="module")
def rendered(scene, tmp_path_factory):
    """Render the cube once with two equal levels, one lower, half buffers, and a reference."""
    out = tmp_path_factory.mktemp("shot")
    levels = {"a": 8, "b": 8, "c": 4}
    shot = ShotSettings(str(scene), 1, (1, 2), SIZE, levels, reference=32, reference_frames=(2,), halves=True)
    simulate([(shot, out)], threads=2)
    return out


@pytest.fixture(scope="module")
def blurred(scene, tmp_path_factory):
    """Render the cube's first frame with the shutter open, with more samples than the guides' own pass has."""
    out = tmp_path_factory.mktemp("blurred")
    simulate([(ShotSettings(str(scene), 1, (1,), SIZE, {"noisy": 24}, motion_blur=True), out)], threads=2)
    return out


def read(path):
    with OpenEXR.File(str(path), separate_channels=True) as file:
        return {name: channel.pixels.astype(np.float64) for name, channel in file.channels().items()}


def layer(channels, name, parts="RGB"):
    return np.stack([channels[f"ViewLayer.{name}.{part}"] for part in parts], axis=-1)


@pytest.mark.parametrize("film", [(1920, 1080), (2048, 1152), (2560, 1440), (200, 100)])
def test_a_crop_has_the_size_that_was_asked_for_wherever_it_is(film):
    """Blender holds borders as 32-bit floats, and rounds down to whole pixels."""
    import bpy

    from hybrid.simulate.motion import set_crop

    render, sizes = bpy.context.scene.render, set()
    for step in range(200):
        set_crop(render, film, (96, 54), (step / 199, 1 - step / 199))
        x0, x1 = (int(border * film[0]) for border in (render.border_min_x, render.border_max_x))
        y0, y1 = (int(border * film[1]) for border in (render.border_min_y, render.border_max_y))
        sizes.add((x1 - x0, y1 - y0))
    assert sizes == {(96, 54)}


def test_every_frame_and_level_has_the_layers_that_a_user_s_own_render_has(rendered):
    names = sorted(path.name for path in rendered.glob("*.exr"))
    references = [f"{name}.0002.exr" for name in ("reference", "reference_a", "reference_b")]
    assert names == sorted([f"{level}.{frame:04d}.exr" for level in "abc" for frame in (1, 2)] + references)
    channels = read(rendered / "a.0002.exr")
    for name in ("Combined.R", "Denoising Albedo.R", "Denoising Normal.X", "Depth.Z", "Vector.X", "Vector.W"):
        assert channels[f"ViewLayer.{name}"].shape == SIZE[::-1]
    assert not any("Position" in name or "UV" in name for name in channels), "passes nobody asked for"
    assert not list(rendered.glob(".*.exr")), "temporary files"


def test_meta_says_what_is_needed_to_render_it_again(rendered):
    meta = json.loads((rendered / "meta.json").read_text())
    assert meta["shot"]["seed"] == 1
    assert meta["plan"]["cycles"]["cycles.glossy_bounces"] == 0
    assert meta["plan"]["facts"]["glossy"] == 0
    assert meta["plan"]["facts"]["motion_pixels"] == pytest.approx(3, abs=0.2)
    assert {"a.0001.exr", "reference.0002.exr"} <= set(meta["seconds"])


def test_headers_say_how_many_samples_the_picture_has(rendered, blurred):
    """Put together of halves, of two references, of a blurred picture and sharp guides."""
    names = {"a.0002": 8, "c.0002": 4, "reference_a.0002": 16, "reference.0002": 32}
    paths = {rendered / f"{name}.exr": samples for name, samples in names.items()} | {blurred / "noisy.0001.exr": 24}
    for path, samples in paths.items():
        with OpenEXR.File(str(path), header_only=True) as file:
            assert file.header()["cycles.ViewLayer.samples"] == str(samples), path.name


def test_noise_levels_are_independent(rendered):
    """The mean squared difference of two levels is the sum of their variances; a shared seed would give less."""
    a, b, c = (layer(read(rendered / f"{level}.0002.exr"), "Combined") for level in "abc")
    truth = layer(read(rendered / "reference.0002.exr"), "Combined")
    apart = [((x - y) ** 2).mean() for x, y in ((a, b), (a, c))]
    # Against a reference of 32 samples each variance counts 1/32 too much: taken off.
    variance = [((x - truth) ** 2).mean() * spp / (spp + spp**2 / 32) for x, spp in ((a, 8), (b, 8), (c, 4))]
    # 64·36·3 values: the mean of squares is known to a few percent; the correction above to some more.
    assert apart[0] == pytest.approx(variance[0] + variance[1], rel=0.15)
    assert apart[1] == pytest.approx(variance[0] + variance[2], rel=0.15)


def test_the_halves_of_a_reference_have_seeds_of_their_own(rendered):
    """Their mean squared difference is that of two levels, by samples; halves of one seed would be equal."""
    half_a, half_b = (layer(read(rendered / f"reference_{half}.0002.exr"), "Combined") for half in "ab")
    a, b = (layer(read(rendered / f"{level}.0002.exr"), "Combined") for level in "ab")
    # 16 samples against 8: half of it if the samples were not stratified, a little less as they are.
    assert 0.3 < ((half_a - half_b) ** 2).mean() / ((a - b) ** 2).mean() < 0.6


def test_measured_depth_limits_are_in_the_plan_and_in_the_scene(scene, monkeypatch):
    import bpy

    from hybrid.simulate import cycles, effects

    measured = effects.EffectDecision("diffuse bounces", True, 1, "", "", {"cycles.diffuse_bounces": 1})
    monkeypatch.setattr(cycles, "needed_bounces", lambda *_: [measured])
    plan = cycles.make_plan(ShotSettings(str(scene), 1, (1,), SIZE, {"n": 1}), 2)
    assert plan["cycles"]["cycles.diffuse_bounces"] == bpy.context.scene.cycles.diffuse_bounces == 1
    assert str(measured) in plan["printed"]


def test_frames_have_the_settings_of_the_plan_in_the_process_that_plans_and_in_a_worker(tmp_path):
    """The exposure of a random shot is one of them, and the only one that shows in all pixels alike."""
    shot = ShotSettings("random", 1, (1,), SIZE, {"noisy": 4}, film=(480, 270), effects="all")
    simulate([(shot, tmp_path / "planned")], threads=2)
    meta = json.loads((tmp_path / "planned" / "meta.json").read_text())
    exposure = meta["plan"]["cycles"]["cycles.film_exposure"]
    assert abs(exposure - 1) > 0.1
    pictures = [layer(read(tmp_path / "planned" / "noisy.0001.exr"), "Combined")]
    for factor in (1, 2):
        meta["plan"]["cycles"]["cycles.film_exposure"] = factor * exposure
        folder = tmp_path / f"worker{factor}"
        folder.mkdir()
        (folder / "meta.json").write_text(json.dumps(meta))
        simulate([(shot, folder)], threads=2)
        pictures.append(layer(read(folder / "noisy.0001.exr"), "Combined"))
    planned, same, brighter = pictures
    np.testing.assert_array_equal(planned, same)
    np.testing.assert_allclose(brighter, 2 * same, rtol=1e-3, atol=1e-6)  # half floats


def test_half_buffers_average_to_the_picture_and_tell_its_variance(rendered):
    channels = read(rendered / "a.0002.exr")
    color, half_a, half_b = (layer(channels, name) for name in ("Combined", "Half A", "Half B"))
    # Half floats hold 11 bits.
    np.testing.assert_allclose(color, (half_a + half_b) / 2, rtol=1e-3, atol=1e-4)
    b = layer(read(rendered / "b.0002.exr"), "Combined")
    estimated, true = ((half_a - half_b) ** 2).mean() / 4, ((color - b) ** 2).mean() / 2
    # Cycles' samples are stratified: 8 are better than twice as good as 4, so halves of few samples err upwards
    # (1.26 measured here, 1.00 at 16 samples in a scene with more noise).
    assert 0.8 < estimated / true < 1.6


def test_vectors_lead_to_the_same_point_one_frame_on(rendered):
    """The cube moves 3 px a frame to the right, the wall not at all."""
    vector = layer(read(rendered / "a.0001.exr"), "Vector", "XYZW")
    middle = vector[16:20, 27:33]  # well inside the cube
    # The previous frame is at (x + X, y − Y), the next at (x − Z, y + W).
    np.testing.assert_allclose(middle[..., 0], -3, atol=0.05)
    np.testing.assert_allclose(-middle[..., 2], 3, atol=0.05)
    np.testing.assert_allclose(vector[:4], 0, atol=0.02)


def errors_of_vectors(scene, channels):
    """Return how far vectors are from where the objects' transforms take what is seen, in pixels: (2, N).

    Previous and next frame. Deforming objects have no such transform, and are left out, as is all that is behind hair:
    Blender's rays pass it.
    """
    from hybrid.simulate.effects import film_pixel, visible_points

    render, frame = scene.render, scene.frame_current
    vector, depth = layer(channels, "Vector", "XYZW"), channels["ViewLayer.Depth.Z"]
    left, bottom = render.border_min_x * render.resolution_x, render.border_min_y * render.resolution_y

    def pixel(position):
        """Return row and column of the rendered region, and how far off the point is that is seen there."""
        column, row = (film_pixel(scene, position) - (int(left), int(bottom))).astype(int)
        behind = -(scene.camera.matrix_world.inverted() @ position).z
        return vector.shape[0] - 1 - row, column, depth[vector.shape[0] - 1 - row, column] / behind

    seen = [
        (item.original, item.matrix_world.inverted_safe() @ position, film_pixel(scene, position))
        for position, item in visible_points(scene, 30, 17)
        if getattr(item.original.data, "shape_keys", None) is None and abs(pixel(position)[2] - 1) < 0.02
    ]
    assert len(seen) > 120, "of 510"
    errors = []
    for step, x, y in ((-1, vector[..., 0], vector[..., 1]), (1, -vector[..., 2], -vector[..., 3])):
        scene.frame_set(frame + step)
        there = [film_pixel(scene, item.matrix_world @ local) for item, local, _ in seen]
        scene.frame_set(frame)
        here = np.array([pixel for *_, pixel in seen])
        column, row = (here - (int(left), int(bottom))).astype(int).T
        row = vector.shape[0] - 1 - row
        moved = np.array(there) - here
        errors.append(np.hypot(x[row, column] - moved[:, 0], y[row, column] - moved[:, 1]))
    return np.array(errors)


@pytest.mark.parametrize(
    "name",
    [
        "random:3003 room, pan", "random:3007 studio, dolly", "random:23 outdoor, pan", "random:3008 night, pan",
        "random:31 wall, pan", "hard:4203 glass and metal", "table.blend", "night.blend", "garden.blend",
        "closeup.blend", "lamps.blend", "shadow.blend", "volume.blend", "file",
    ],
)  # fmt: skip
@pytest.mark.parametrize("blur", [False, True])
def test_vectors_follow_what_moves_in_every_kind_of_scene(name, blur, scene, tmp_path):
    """Against the motion that the transforms of objects and camera make, with and without motion blur."""
    import bpy

    from hybrid.simulate import cycles

    kind, _, rest = name.partition(":")
    where = {"random": kind, "hard": kind, "file": str(scene)}.get(kind, str(SCENES / name))
    seed = int(rest.split()[0]) if kind in RANDOM else 1
    shot = ShotSettings(
        where, seed, (4, 5), SIZE, {"n": 4}, film=(1920, 1080), motion_blur=blur,
        center=(0.5, 0.5) if name.endswith(".blend") else None,
    )  # fmt: skip
    cycles.build(shot, 0, 2)
    cycles.apply(bpy.context.scene, {"render.use_motion_blur": blur, "cycles.max_bounces": 1})
    bpy.context.scene.frame_set(4)
    cycles.render_level(bpy.context.scene, shot, tmp_path / "n.exr", 4, 1)
    errors = errors_of_vectors(bpy.context.scene, read(tmp_path / "n.exr"))
    # Vectors are means over a pixel's samples, and a point is somewhere in its pixel: 0.007 at most were measured in
    # the middle, 0.05 in the upper fifth, on motion of up to 19 px. At edges vectors mix two motions.
    assert np.median(errors, axis=1).max() < 0.05
    assert np.quantile(errors, 0.8, axis=1).max() < 0.5


@pytest.mark.parametrize("blur", [False, True])
def test_vectors_follow_what_bends_and_hair(blur, scene, tmp_path):
    """A sheet whose shape key moves every vertex by a known amount a frame, and fur that flies: 10 px are a unit."""
    import bpy

    from hybrid.simulate import cycles, random_assets

    shot = ShotSettings(str(scene), 1, (1, 2), SIZE, {"n": 16}, motion_blur=blur)
    cycles.build(shot, 0, 2)
    bpy.ops.mesh.primitive_grid_add(x_subdivisions=40, y_subdivisions=40, size=3, location=(-1.6, -1, 0))
    sheet = bpy.context.active_object
    sheet.rotation_euler = (np.pi / 2, 0, 0)  # its y is up
    sheet.shape_key_add(name="basis")
    bent = sheet.shape_key_add(name="bent")
    for point, vertex in zip(bent.data, sheet.data.vertices, strict=True):
        x, y, _ = vertex.co
        point.co = (x + 0.2 * np.sin(2 * y), y + 0.1 * x, 0)
    bent.slider_min, bent.slider_max = -5, 5
    fur = random_assets.hair_ball(np.random.default_rng(1), sheet.active_material)
    fur.scale = (3, 3, 3)
    for frame in range(-3, 6):
        bent.value = frame - 1
        bent.keyframe_insert("value", frame=frame)
        fur.location = (1.7 - 0.2 * (frame - 1), -2, 0.1 * (frame - 1))
        fur.keyframe_insert("location", frame=frame)
    cycles.apply(bpy.context.scene, {"render.use_motion_blur": blur})
    bpy.context.scene.frame_set(1)
    cycles.render_level(bpy.context.scene, shot, tmp_path / "n.exr", 16, 1)
    vector = layer(read(tmp_path / "n.exr"), "Vector", "XYZW")
    rows, columns = np.mgrid[6:30, 4:28]  # inside the sheet
    x, y = (columns + 0.5 - 32) / 10 + 1.6, (18 - rows - 0.5) / 10
    moved = np.stack([2 * np.sin(2 * y), x], axis=-1)  # px to the right, and up
    np.testing.assert_allclose(vector[rows, columns], -np.concatenate([moved, moved], axis=-1), atol=0.05)
    # Between strands there is the wall, which stands still: of 16 samples, so many meet the fur.
    hair = vector[12:24, 43:55].reshape(-1, 4)
    share = hair @ [2, -1, 2, -1] / 10
    np.testing.assert_allclose(hair, np.round(16 * share)[:, None] * [2, -1, 2, -1] / 16, atol=0.01)
    assert 0.5 < np.median(share) < 1


def test_what_blender_keeps_between_frames_changes_no_picture(tmp_path):
    """With persistent data, which shots are rendered with, a thing that flies and one that bends are as without."""
    import bpy

    from hybrid.simulate import cycles

    shot = ShotSettings(str(SCENES / "garden.blend"), 1, (1, 4), SIZE, {"n": 2})
    pictures = []
    for keep in (True, False):
        cycles.build(shot, 0, 2)
        bpy.context.scene.render.use_persistent_data = keep
        for frame in shot.frames:
            bpy.context.scene.frame_set(frame)
            cycles.render_level(bpy.context.scene, shot, tmp_path / f"{keep}.{frame:04d}.exr", 2, 1)
        pictures.append([read(tmp_path / f"{keep}.{frame:04d}.exr") for frame in shot.frames])
    for kept, fresh in zip(*pictures, strict=True):
        for name in kept:
            np.testing.assert_array_equal(kept[name], fresh[name], err_msg=name)
    assert np.any(pictures[0][0]["ViewLayer.Combined.R"] != pictures[0][1]["ViewLayer.Combined.R"]), "something moves"


def test_with_motion_blur_vectors_come_from_an_unblurred_pass(rendered, blurred):
    smeared, sharp = read(blurred / "noisy.0001.exr"), read(rendered / "a.0001.exr")
    # Other samples of the same edges: half of the pixels have no edge.
    difference = np.abs(layer(smeared, "Vector", "XYZW") - layer(sharp, "Vector", "XYZW")).max(axis=-1)
    assert np.median(difference) < 0.02
    assert (difference > 0.5).mean() < 0.1
    assert set(smeared) == {name for name in sharp if ".Half " not in name}
    meta = json.loads((blurred / "meta.json").read_text())
    assert meta["plan"]["cycles"]["render.use_motion_blur"]


def test_what_is_left_out_does_not_change_the_picture(scene, rendered, tmp_path):
    """The same seed with everything on: what the missing effects would have brought is all the difference."""
    shot = ShotSettings(str(scene), 1, (1,), SIZE, {"a": 8}, effects="all")
    simulate([(shot, tmp_path)], threads=2)
    lean, full = (layer(read(folder / "a.0001.exr"), "Combined") for folder in (rendered, tmp_path))
    assert lean.mean() == pytest.approx(full.mean(), rel=0.005)


def test_the_scenes_of_the_examples_move_and_hold_every_effect(tmp_path):
    """Small and without a pilot: which rules switch what on is a question to the scenes alone."""
    found = {}
    for path in sorted(SCENES.glob("*.blend")):
        out = tmp_path / path.stem
        shot = ShotSettings(str(path), 1, (2,), SIZE, {"noisy": 2}, film=(384, 216), center=(0.5, 0.5), effects="all")
        simulate([(shot, out)], threads=2)
        plan = json.loads((out / "meta.json").read_text())["plan"]
        assert "motion" not in plan["description"], "a scene that moves gets no other motion"
        color = layer(read(out / "noisy.0002.exr"), "Combined")
        assert np.isfinite(color).all(), path.stem
        assert 0.02 < color.mean() < 2, path.stem
        assert color.std() > 0.3 * color.mean(), path.stem
        found[path.stem] = plan["facts"]
    facts = found.values()
    kinds = ("glossy", "mirrors", "transmissive", "transparent", "subsurface", "volumes", "hair", "small_lights")
    assert all(any(fact[kind] for fact in facts) for kind in (*kinds, "moving_lights"))
    assert all(fact["motion_pixels"] > 0.1 for fact in facts), "pixels of a film of 384"
    assert found["lens"]["aperture_pixels"] > 3
    assert (found["garden"]["world"], found["closeup"]["world"], found["night"]["world"]) == ("sky", "image", "none")
    assert found["lamps"]["lights"] >= 60


def facts_at(name, seed=1):
    """Build a shot as it is rendered, a sixth of a film's picture; return the scene, its facts and description."""
    import bpy

    from hybrid.simulate import cycles, effects

    shot = ShotSettings(name, seed, tuple(range(1, 8)), (320, 180), {"noisy": 1}, film=(1920, 1080))
    description = cycles.build(shot, 0, 2)
    return bpy.context.scene, effects.facts_of(bpy.context.scene, shot.frames), description


@pytest.mark.parametrize(
    ("seed", "kinds"), [(4203, ["glass", "metal"]), (4206, ["dim", "volume"]), (4209, ["hair", "lens"])]
)
def test_hard_shots_hold_what_they_say_and_are_else_the_random_shots_of_their_seeds(seed, kinds):
    _, plain, random = facts_at("random", seed)
    scene, facts, hard = facts_at("hard", seed)
    assert hard["hard"] == kinds
    assert (hard["set"], hard["film"]) == (random["set"], random["film"])
    assert "hard" not in random
    if "glass" in kinds:
        assert facts.transmissive > plain.transmissive
    if "metal" in kinds:
        assert any(item["motion"] == "turn" for item in hard["added"])
        assert facts.glossy > plain.glossy
    if "dim" in kinds:
        assert facts.world == "none"
        lamps = [item.data for item in scene.objects if item.type == "LIGHT"]
        assert lamps
        assert all(lamp.type in ("POINT", "SPOT") for lamp in lamps)
    if "volume" in kinds:
        assert facts.volumes > plain.volumes
        assert any(item.type == "LIGHT" and item.data.type == "SPOT" for item in scene.objects), "a beam"
    if "hair" in kinds:
        assert facts.hair >= plain.hair + 2
    if "lens" in kinds:
        assert facts.aperture_pixels > 2 > plain.aperture_pixels


def test_a_random_shot_shows_something_and_is_the_same_twice(tmp_path):
    # effects="all" leaves out the pilot, which takes longer than these pictures.
    shot = ShotSettings("random", 1, (1,), SIZE, {"noisy": 4}, film=(480, 270), effects="all")
    for name in ("once", "twice"):
        simulate([(shot, tmp_path / name)], threads=2)
    once, twice = (layer(read(tmp_path / name / "noisy.0001.exr"), "Combined") for name in ("once", "twice"))
    np.testing.assert_array_equal(once, twice)
    assert np.isfinite(once).all()
    assert (once.mean(axis=-1) > 0).mean() > 0.5
    assert once.std() > 0.05 * once.mean()


@pytest.mark.posix
def test_a_renderer_ends_with_the_process_that_started_it(scene, tmp_path):
    """Killed, `ravg simulate` left it rendering for hours."""
    words = [str(scene), "-o", str(tmp_path / "shot"), "--frames", "1-4", "--film", "64x36"]
    words += ["--size", "64x36", "--levels", "s=65536", "--python", sys.executable]
    run = subprocess.Popen([sys.executable, "-m", "hybrid.cli", "simulate", *words])
    children = Path(f"/proc/{run.pid}/task/{run.pid}/children")
    until(lambda: list((tmp_path / "shot").glob("meta.json")))  # it renders now
    (renderer,) = (int(word) for word in children.read_text().split())
    run.kill()
    run.wait()
    until(lambda: not Path(f"/proc/{renderer}").exists())


def until(holds):
    """Wait for a condition, a minute at most."""
    for _ in range(600):
        if holds():
            return
        time.sleep(0.1)
    raise AssertionError("it did not come true in a minute")
