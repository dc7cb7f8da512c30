"""The extension in Blender itself, without a window: built, validated, installed, used on a small shot.

Skipped where bpy is not installed; what runs `ravg`, which lives in another environment than bpy, needs its path in
the environment variable RAVG_COMMAND.
"""

import json
import re
import shutil
import sys
import zipfile
from pathlib import Path

import numpy as np
import OpenEXR
import pytest

from tests.blender.session import (
    COMPOSE,
    DRAWN,
    EXTENSION,
    FAILING,
    NAME,
    PROBLEMS,
    ROOT,
    VERSION,
    blender_extension,
    channels,
    needs_ravg,
    picture,
)
from tests.blender.wheels import write_wheel

pytestmark = pytest.mark.cycles
SINCE_5 = pytest.importorskip("bpy", reason="runs Blender: pip install bpy==5.0.1").app.version >= (5, 0, 0)

# --- the archive ---------------------------------------------------------------------------------------


def test_blender_validates_the_archive(blender):
    done = blender_extension("validate", str(blender.archive))
    assert done.returncode == 0, done.stdout + done.stderr
    with zipfile.ZipFile(blender.archive) as archive:
        assert not [name for name in archive.namelist() if "__pycache__" in name]


def test_blender_would_refuse_a_wrong_one(tmp_path):
    """The validation of the test above is strict: one tag that Blender does not know fails it."""
    copy = Path(shutil.copytree(EXTENSION, tmp_path / "ravg"))
    manifest = copy / "blender_manifest.toml"
    manifest.write_text(manifest.read_text(encoding="utf-8").replace('"Render"', '"Denoising"'), encoding="utf-8")
    assert blender_extension("validate", str(copy)).returncode != 0


def test_it_comes_and_goes_without_a_trace(blender):
    code = """
    HANDLERS = ("load_pre", "load_post", "save_pre", "render_init", "render_write", "render_complete", "render_cancel")
    def traces():
        handlers = bpy.app.handlers
        return [hasattr(bpy.types.Scene, "ravg"), hasattr(bpy.types, "RAVG_PT_output"),
                "denoise" in dir(bpy.ops.ravg), sum(len(getattr(handlers, n)) for n in HANDLERS)]
    there = traces()
    addon_utils.disable(NAME)
    gone = traces()
    addon_utils.enable(NAME)
    answer = [there, gone, traces()]
    """
    there, gone, again = blender.run(code, NAME=NAME)
    assert there[:3] == [True, True, True]
    assert gone == [False, False, False, there[3] - 8]
    assert again == there


def test_blender_loads_no_torch(blender):
    assert not blender.run("answer = [name for name in sys.modules if name in ('torch', 'hybrid', 'network')]")


# --- what a scene lacks --------------------------------------------------------------------------------


def test_a_new_scene_is_told_what_it_lacks_and_set_up(blender, blend):
    code = PROBLEMS + "answer = [texts(), list(bpy.ops.ravg.set_up()), texts(), scenes.set_up(scene)]"
    before, done, after, again = blender.run(code, blend=blend)
    assert before == ["Denoising Data", "Vector pass", "Seed", "Render > Denoise"]
    assert done == ["FINISHED"]
    assert after == again == []


@pytest.mark.parametrize(
    ("change", "warned"),
    [
        ("scene.render.use_motion_blur = True", ["Motion Blur leaves the Vector pass empty"]),
        ("scene.render.use_motion_blur = True; scenes.set_up(scene)", ["Motion Blur"]),
        ("scene.cycles.use_animated_seed = False", ["Seed"]),
        ("scene.cycles.use_animated_seed = False; scene.cycles.driver_add('seed')", []),
        ("scene.cycles.use_animated_seed = False; scene.cycles.keyframe_insert('seed', frame=1)", []),
        ("scene.view_layers.new('second')", ["Denoising Data", "Vector pass"]),
        ("scene.view_layers.new('second').use = False", []),
        ("scene.copy().ravg.noisy = '//frames/other_'", []),
        ("scene.copy()", ["Scene Scene.001 has these Noisy Frames too"]),
        (
            "scene.name = 'A b'; scene.ravg.noisy = ''; scene.copy().name = 'A.b'",
            ["Scene A.b has these Noisy Frames too"],
        ),
        ("scene.render.engine = ENGINE", ["Engine"]),
        ("scenes.with_denoiser, scene.cycles.use_denoising = False, True", ["Render > Denoise"]),
        ("scenes.with_denoiser, scene.cycles.use_denoising = False, True; scenes.set_up(scene)", []),
    ],
)
def test_what_spoils_the_result_is_warned_of(blender, rendered, change, warned):
    eevee = "ENGINE = next(e for e in ('BLENDER_EEVEE', 'BLENDER_EEVEE_NEXT') if e in ENGINES)"
    engines = "ENGINES = [i.identifier for i in bpy.types.RenderSettings.bl_rna.properties['engine'].enum_items]"
    code = f"{PROBLEMS}{engines}\n{eevee}\n{change}\nanswer = texts()"
    assert blender.run(code, blend=rendered) == warned


def test_motion_blur_leaves_the_vectors_empty_as_the_panel_says(blender, shot):
    code = """
    from bl_ext.user_default.ravg import scenes
    scene.render.use_motion_blur, scene.frame_end, scene.ravg.noisy = True, 4, "//blurred/"
    scenes.override(scene, replace=False)
    bpy.ops.render.render(animation=True)
    """
    blender.run(code, blend=shot)
    moving, empty = (channels(shot.parent / name)["Vector.X"] for name in ("frames/shot_0004.exr", "blurred/0004.exr"))
    assert moving.min() > 0.5
    assert not empty.any()


def test_the_rendered_frames_hold_what_ravg_reads(rendered):
    frames = sorted((rendered.parent / "frames").iterdir())
    assert [path.name for path in frames] == ["shot_0004.exr", "shot_0005.exr", "shot_0006.exr"]
    assert {"Combined.R", "Denoising Albedo.R", "Denoising Normal.X", "Vector.W"} <= channels(frames[0]).keys()


@pytest.mark.parametrize(
    ("filepath", "pattern", "fifth"),
    [
        ("//frames/shot_", "frames/shot_####.exr", "frames/shot_0005.exr"),
        ("//frames/shot.####.exr", "frames/shot.####.exr", "frames/shot.0005.exr"),
        ("//sh#t/v1_", "sh#t/v1_####.exr", "sh#t/v1_0005.exr"),
        ("//12/00##_a", "12/00##_a.exr", "12/0005_a.exr"),
        ("//", "####.exr", "0005.exr"),
        ("//a.EXR", "a####.exr", "a0005.exr"),
    ],
)
def test_frames_are_looked_for_where_blender_writes_them(blender, rendered, filepath, pattern, fifth):
    code = f"""{PROBLEMS}
scene.ravg.noisy = PATH
scenes.override(scene, replace=True)
assert scene.render.frame_path(frame=5) == str(scenes.noisy_files(scene)[5])
answer = [scenes.noisy_pattern(scene), scenes.noisy_files(scene)[5]]
"""
    found = blender.run(code, blend=rendered, PATH=filepath)
    assert found == [str(rendered.parent / pattern), str(rendered.parent / fifth)]


@pytest.mark.parametrize(
    ("saved", "noisy", "folder", "reason"),
    [
        (False, "", "", "File is not saved"),
        (False, "//frames/", "", "File is not saved"),
        (False, "frames/shot_", "", "File is not saved"),
        (False, "", "/tmp/denoised", "File is not saved"),
        (False, "/tmp/noisy_", "//denoised", "File is not saved"),
        (False, "/tmp/noisy_", "denoised", "File is not saved"),
        (False, "/tmp/noisy_", "", ""),
        (False, "/tmp/noisy_", "/tmp/denoised", ""),
        (True, "//frames/shot_", "//denoised", ""),
        (True, "//frames/shot_", "//frames/", "Denoised Frames is the folder of the noisy frames"),
        (True, "//{blend_name}/shot_", "", "Noisy Frames has { or }"),
        (True, "/tmp/shot}_", "", "Noisy Frames has { or }"),
    ],
)
def test_paths_that_lead_elsewhere_are_refused(blender, stub, blend, saved, noisy, folder, reason):
    code = f"""{PROBLEMS}
from bl_ext.user_default.ravg import jobs
scene.ravg.noisy, scene.ravg.folder = NOISY, FOLDER
answer = [[problem.text for problem in scenes.problems(scene)], ""]
try:
    jobs.begin(scene)
except FileNotFoundError as error:
    answer[1] = str(error)
"""
    said, refused = blender.run(code, blend=blend if saved else None, command=stub, NOISY=noisy, FOLDER=folder)
    assert refused.partition(":")[0] == reason
    assert ([refused] == said) == bool(reason)


def test_braces_in_the_folder_of_the_file_are_no_variables(blender, blend):
    folder = blend.parent / "{blend_name}"
    folder.mkdir()
    code = f"""{PROBLEMS}
scenes.override(scene, replace=True)
answer = [scenes.misplaced(scene), scene.render.frame_path(frame=5)]
"""
    written = str(folder / "ravg" / "shot" / "noisy" / "Scene_0005.exr")
    assert blender.run(code, blend=Path(shutil.copy(blend, folder))) == ["", written]


# --- from one button to the picture --------------------------------------------------------------------


@needs_ravg
def test_the_script_of_the_documentation_renders_denoises_and_loads(blender, blend):
    script = re.search(r"```python\n(.*?)```", (ROOT / "docs" / "blender.md").read_text(encoding="utf-8"), re.DOTALL)
    assert script
    code = f"""
    editor = bpy.context.window_manager.windows[0].screen.areas[0]
    editor.type = "IMAGE_EDITOR"
    exec({script[1]!r})
    image, user = editor.spaces.active.image, editor.spaces.active.image_user
    answer = [bpy.path.abspath(image.filepath), image.source,
              [user.frame_start, user.frame_duration, user.frame_offset], bpy.data.texts["ravg.log"].as_string()]
    """
    path, source, shown, log = blender.run(code, blend=blend)
    noisy, made = blend.parent / "ravg" / "shot" / "noisy", blend.parent / "ravg" / "shot" / "denoised"
    assert Path(path) == made / "Scene_0004.exr"
    assert source == "SEQUENCE"
    assert shown == [4, 3, 3]  # frame 4 of the scene shows file 4 - 4 + 1 + 3
    assert "(3 frames)" in log
    assert sorted(p.name for p in made.glob("*.exr")) == ["Scene_0004.exr", "Scene_0005.exr", "Scene_0006.exr"]
    code = """
    from bl_ext.user_default.ravg import scenes
    scene.cycles.samples, scene.ravg.noisy = 256, "//clean/"
    bpy.ops.ravg.set_up()
    scene.cycles.use_denoising = False
    scenes.override(scene, replace=False)
    bpy.ops.render.render(animation=True)
    """
    blender.run(code, blend=blend)
    for frame in (4, 5, 6):
        files = (
            noisy / f"Scene_{frame:04d}.exr",
            made / f"Scene_{frame:04d}.exr",
            blend.parent / f"clean/{frame:04d}.exr",
        )
        before, (after, clean) = picture(files[0], "Noisy Image"), (picture(path) for path in files[1:])
        assert ((after - clean) ** 2).mean() < 0.5 * ((before - clean) ** 2).mean()
    with OpenEXR.File(str(made / "Scene_0005.exr"), header_only=True) as file:
        assert file.header()["ravg/preset"] == "fast"


@needs_ravg
def test_the_compositor_shows_each_denoised_frame_at_its_time(blender, shot):
    """Blender itself reads the frames: what its compositor writes is what ravg has made."""
    code = """
    scene.ravg.preset = "average"
    scene.ravg.strength = 0.5
    bpy.ops.ravg.denoise()
    exec(COMPOSE)
    movie("composed")
    """
    blender.run(code, blend=shot, COMPOSE=COMPOSE)
    for frame in (4, 5, 6):
        composed = shot.parent / "composed" / f"{frame:04d}.exr"
        with OpenEXR.File(str(composed)) as file:
            seen = file.channels()["RGB" if "RGB" in file.channels() else "RGBA"].pixels[..., :3]
        denoised = picture(shot.parent / "frames" / "denoised" / f"shot_{frame:04d}.exr")
        np.testing.assert_allclose(seen, denoised, rtol=1e-3, atol=1e-4)
    with OpenEXR.File(str(shot.parent / "frames" / "denoised" / "shot_0004.exr"), header_only=True) as file:
        assert json.loads(file.header()["ravg/settings"])["strength"] == 0.5


FOLLOWED = """
from bl_ext.user_default.ravg import jobs
job = jobs.begin(scene)
{start}
seen = []
while (pause := jobs.follow()) is not None:
    seen.append(job.text)
    {between}
    time.sleep(pause)
job.advance()
answer = [sorted(set(seen)), jobs.current is None, bpy.ops.ravg.denoise.poll(), job.run.code, job.run.finished,
          job.text]
"""


@needs_ravg
def test_a_timer_follows_it_to_its_end(blender, shot):
    """As with a window: Blender goes on, the panel shows how far it is."""
    code = FOLLOWED.format(start="job.start()", between="assert not bpy.ops.ravg.denoise.poll()")
    seen, over, free, status, finished, last = blender.run("scene.ravg.preset = 'average'\n" + code, blend=shot)
    assert any(text.startswith("Denoising: 0 of 3 frames") for text in seen)
    assert last == "Denoising: 3 of 3 frames, 0 s left"
    assert (over, free, status, finished) == (True, True, 0, 3)


def test_with_a_window_the_result_is_reported_by_a_modal_operator(blender):
    """Blender shows no reports of an operator that Python has called, and raises errors into the timer."""
    code = """
    from types import SimpleNamespace
    from bl_ext.user_default.ravg import operators
    operators.bpy = SimpleNamespace(app=SimpleNamespace(background=False))
    called = []
    manager = SimpleNamespace(
        event_timer_add=lambda step, window: called.append("timer"),
        event_timer_remove=lambda timer: called.append("no timer"),
        modal_handler_add=lambda operator: called.append("modal"),
    )
    context = SimpleNamespace(window_manager=manager, window=None)
    operator = SimpleNamespace(execute=lambda context: called.append("concluded") or {"FINISHED"})
    results = [f(operator, context, None) for f in (operators.Conclude.invoke, operators.Conclude.modal)]
    answer = [called, [list(result) for result in results]]
    """
    called, results = blender.run(code)
    assert called == ["timer", "modal", "no timer", "concluded"]
    assert results == [["RUNNING_MODAL"], ["FINISHED"]]


@needs_ravg
def test_it_starts_when_blender_has_rendered(blender, shot):
    code = """
    scene.ravg.preset = "average"
    from bl_ext.user_default.ravg import jobs, scenes
    count = len(bpy.app.handlers.render_complete)
    job = jobs.begin(scene)
    scenes.override(scene, replace=True)
    waiting = [job.text, job.ended, jobs.follow() is not None]
    bpy.ops.render.render(animation=True)
    jobs.follow()
    started = job.run is not None
    while (pause := jobs.follow()) is not None:
        time.sleep(pause)
    answer = [waiting, started, job.run.code, len(bpy.app.handlers.render_complete) - count]
    """
    assert blender.run(code, blend=shot) == [["Rendering: 0 of 0 frames", False, True], True, 0, 0]


@needs_ravg
def test_stop_leaves_whole_frames_and_no_process(blender, shot):
    limits = "command.TERMINATED_AFTER = command.KILLED_AFTER = 60"
    start = f"from bl_ext.user_default.ravg import command; {limits}; job.start()"
    code = FOLLOWED.format(start=start, between="bpy.ops.ravg.cancel()")
    _, over, free, status, finished, _ = blender.run("scene.ravg.preset = 'average'\n" + code, blend=shot)
    assert (over, free) == (True, True)
    assert status == 130, "its input was closed, and no signal was sent"
    made = [path for path in (shot.parent / "frames").rglob("*") if path.parent.name == "denoised"]
    assert len(made) == finished < 3


@needs_ravg
def test_another_file_stops_it_as_it_stops_a_render(blender, shot):
    code = """
    from bl_ext.user_default.ravg import command, jobs
    command.TERMINATED_AFTER = command.KILLED_AFTER = 60
    job = jobs.begin(scene)
    job.start()
    bpy.ops.wm.read_homefile()
    answer = [job.run.code, jobs.current]
    """
    status, current = blender.run(code, blend=shot)
    assert status == 130
    assert current is None


@needs_ravg
def test_finished_frames_are_left_alone_where_they_are_kept(blender, shot):
    code = """
    scene.ravg.preset = "average"
    bpy.ops.ravg.denoise()
    made = Path(bpy.path.abspath("//frames/denoised"))
    first = {p.name: p.stat().st_mtime_ns for p in made.glob("*.exr")}
    (made / "shot_0005.exr").unlink()
    from bl_ext.user_default.ravg import jobs
    job = jobs.begin(scene, keep=True)
    job.start()
    jobs.wait()
    bpy.ops.ravg.conclude()
    second = {p.name: p.stat().st_mtime_ns for p in made.glob("*.exr")}
    answer = [sorted(second), sorted(name for name in second if first[name] == second[name]), job.run.finished]
    """
    there, kept, finished = blender.run(code, blend=shot)
    assert there == ["shot_0004.exr", "shot_0005.exr", "shot_0006.exr"]
    assert kept == ["shot_0004.exr", "shot_0006.exr"]
    assert finished == 3


# The light passes of two kinds, direct, indirect and color.
KINDS = [("DiffDir", "DiffInd", "DiffCol"), ("GlossDir", "GlossInd", "GlossCol")]  # before Blender 5.0
if SINCE_5:
    KINDS = [(f"{kind} Direct", f"{kind} Indirect", f"{kind} Color") for kind in ("Diffuse", "Glossy")]


@needs_ravg
def test_light_passes_are_denoised_along_and_add_up_as_before(blender, blend):
    code = f"""{PROBLEMS}
layer = scene.view_layers[0]
scene.ravg.light_passes, scene.frame_end = True, 5
bpy.ops.ravg.set_up()
said = texts()
for kind in ("diffuse", "glossy"):
    for part in ("direct", "indirect", "color"):
        setattr(layer, f"use_pass_{{kind}}_{{part}}", True)
more = texts()
scene.ravg.preset = "average"
most = texts()
scene.ravg.preset = "fast"
bpy.ops.ravg.denoise(render=True)
answer = [said, more, most]
"""
    assert blender.run(code, blend=blend) == [["Light Passes"], [], ["Light Passes"]]

    def total(found: dict[str, np.ndarray], c: str) -> np.ndarray:
        kinds = [[found[f"{name}.{c}"] for name in names] for names in KINDS]
        return np.sum([(direct + indirect) * color for direct, indirect, color in kinds], axis=0)

    for frame in (4, 5):
        noisy, denoised = (
            channels(blend.parent / f"ravg/shot/{x}/Scene_{frame:04d}.exr") for x in ("noisy", "denoised")
        )
        for name in (*KINDS[0][:2], KINDS[1][0]):
            assert not np.array_equal(noisy[f"{name}.G"], denoised[f"{name}.G"]), name
        for before, kind in ((noisy, "Noisy Image"), (denoised, "Combined")):
            assert abs(total(before, "G") - before[f"{kind}.G"]).mean() < 0.01 * before[f"{kind}.G"].mean()


BLURRED = """
scene.camera.animation_data_clear()
for frame in (1, 10):
    scene.camera.location.x = 0.5 * (frame - 5)
    scene.camera.keyframe_insert("location", frame=frame)
action = scene.camera.animation_data.action
curves = getattr(action, "fcurves", None) or action.layers[0].strips[0].channelbags[0].fcurves
for curve in curves:
    for key in curve.keyframe_points:
        key.interpolation = "LINEAR"
scene.render.motion_blur_shutter = 0.5
scene.cycles.samples = 16
scene.view_layers[0].use_pass_z = True
bpy.ops.ravg.denoise(render=True)
bpy.ops.ravg.add_to_compositor()
movie("sharp")
tree = getattr(scene, "compositing_node_group", None) or scene.node_tree
image = next(node for node in tree.nodes if node.type == "IMAGE")
blur = tree.nodes.new("CompositorNodeVecBlur")
if "Shutter" in blur.inputs:
    blur.inputs["Shutter"].default_value = scene.render.motion_blur_shutter
else:  # before Blender 5.0, in exposures of two frames
    blur.factor = scene.render.motion_blur_shutter / 2
for index, output in enumerate(("Combined", "Depth", "Vector")):
    names = (("Image",), ("Z",), ("Speed", "Vector"))[index]
    tree.links.new(image.outputs[output], next(x for x in blur.inputs if x.name in names))
tree.links.new(blur.outputs["Image"], end_of(tree).inputs[0])
movie("blurred")
scene.render.use_compositing = False
scene.render.use_motion_blur, scene.cycles.samples, scene.cycles.use_denoising = True, 512, False
movie("real")
"""


@needs_ravg
def test_motion_blur_is_added_after_denoising_as_the_documentation_says(blender, blend):
    blender.run(BLURRED, blend=blend)

    def shown(name: str, frame: int) -> np.ndarray:
        found = channels(blend.parent / name / f"{frame:04d}.exr")
        return np.stack([found[c] for c in "RGB"], axis=-1)[4:-4, 12:-12]  # what enters at the borders is not known

    for frame in (4, 5, 6):
        sharp, blurred, real = (shown(name, frame) for name in ("sharp", "blurred", "real"))
        print(frame, [float(((x - real) ** 2).mean()) for x in (sharp, blurred)])  # shown where it fails
        assert ((blurred - real) ** 2).mean() < 0.5 * ((sharp - real) ** 2).mean()


# --- without a window ----------------------------------------------------------------------------------


@pytest.mark.parametrize(
    ("arguments", "code", "says"),
    [
        ([], 0, "3 of 3 frames, 100 %"),
        (["--render"], 1, "noisy frames 4-6 are there already: choose --keep or --replace"),
        (["--render", "--keep"], 0, "3 of 3 frames, 100 %"),
        (["--render", "--keep", "--replace"], 2, "not allowed with argument"),
        (["--no-such"], 2, "unrecognized arguments"),
        (["--help"], 0, "usage: blender --background FILE --command ravg"),
    ],
)
@needs_ravg
def test_the_command_line_ends_with_a_code_and_no_traceback(blender, shot, arguments, code, says):
    script = """
    import contextlib, io
    from bl_ext.user_default.ravg import terminal
    scene.ravg.preset = "average"
    printed = io.StringIO()
    with contextlib.redirect_stdout(printed), contextlib.redirect_stderr(printed):
        code = terminal.run(ARGUMENTS)
    answer = [code, printed.getvalue()]
    """
    found, printed = blender.run(script, blend=shot, ARGUMENTS=arguments)
    assert found == code
    assert "Traceback" not in printed
    assert says in printed


# --- nothing is written over ---------------------------------------------------------------------------


def contents(folder: Path) -> dict[str, bytes]:
    """The files of a folder."""
    return {path.name: path.read_bytes() for path in sorted(folder.iterdir()) if path.is_file()}


@needs_ravg
def test_noisy_frames_outlive_the_movie_that_is_made_of_the_denoised_ones(blender, blend):
    """Render, denoise, composite, render the animation, denoise again: each set of frames stays whole."""
    code = f"""
    import shutil
    bpy.ops.ravg.denoise(render=True)
    shutil.copytree(bpy.path.abspath("//ravg/shot"), bpy.path.abspath("//first"))
    exec({COMPOSE!r})
    # what Render and Denoise used to leave behind
    choose_format(scene.render.image_settings, "MULTI_LAYER_IMAGE", "OPEN_EXR_MULTILAYER")
    bpy.ops.render.render(animation=True)
    bpy.ops.ravg.denoise(existing="REPLACE")
    answer = scene.render.filepath
    """
    assert blender.run(code, blend=blend) == "//movie/shot_"
    first, now = blend.parent / "first", blend.parent / "ravg" / "shot"
    assert len(contents(now / "noisy")) == 3
    assert contents(now / "noisy") == contents(first / "noisy")
    movie = sorted((blend.parent / "movie").iterdir())
    assert [path.name for path in movie] == ["shot_0004.exr", "shot_0005.exr", "shot_0006.exr"]
    for path, again in zip(movie, sorted((now / "denoised").glob("*.exr")), strict=True):
        before = picture(first / "denoised" / again.name)
        assert before.mean() > 0.1
        np.testing.assert_array_equal(picture(again), before)
        composed = np.stack([channels(path)[f"Composite.Combined.{c}"] for c in "RGB"], axis=-1)
        np.testing.assert_allclose(composed, before, rtol=1e-3, atol=1e-4)


FORMATS = """
def settings_of(scene):
    names = ("media_type", "file_format", "color_mode", "color_depth", "exr_codec", "views_format", "color_management")
    image, render = scene.render.image_settings, scene.render
    return [getattr(image, name, None) for name in names] + [render.filepath, render.use_overwrite,
            render.use_placeholder, render.use_file_extension, render.use_compositing, render.use_sequencer]
def choose(kind, file_format, depth, mode):
    choose_format(scene.render.image_settings, kind, file_format, depth)
    scene.render.image_settings.color_mode = mode
"""


CHOSEN = [
    ("IMAGE", "PNG", "16", "BW"),
    ("IMAGE", "JPEG", "", "RGB"),
    ("IMAGE", "OPEN_EXR", "16", "RGB"),
    ("MULTI_LAYER_IMAGE", "OPEN_EXR_MULTILAYER", "16", "RGBA"),
    ("VIDEO", "FFMPEG", "", "RGB"),
]
# The ends of a render that was begun.
ENDS = {
    "finished": "bpy.ops.ravg.denoise(render=True, existing='REPLACE')",
    "failed": "scene.camera = None; bpy.ops.ravg.denoise(render=True, existing='REPLACE')",
    "cancelled": """
job = jobs.begin(scene)
scenes.override(scene, replace=True)
assert settings_of(scene) != before
for handler in list(bpy.app.handlers.render_cancel): handler(scene)
job.advance()
bpy.ops.ravg.conclude()
""",
    "reopened": """
scenes.override(scene, replace=True)
bpy.ops.wm.save_mainfile()
bpy.ops.wm.open_mainfile(filepath=bpy.data.filepath)
scene = bpy.context.scene
""",
    "switched off": """
jobs.begin(scene)
scenes.override(scene, replace=True)
jobs.stop_current()
""",
}


@pytest.mark.parametrize("end", ENDS)
def test_the_scene_gets_its_output_settings_back(blender, stub, blend, end):
    code = f"""{FORMATS}
from bl_ext.user_default.ravg import jobs, scenes
answer = []
for chosen in CHOSEN:
    scene.frame_end = 4
    scene.render.use_overwrite, scene.render.use_placeholder = False, True
    choose(*chosen)
    before = settings_of(scene)
    try:
        exec(END)
    except RuntimeError:
        pass
    answer.append([before, settings_of(scene), scene.ravg.lent])
"""
    for before, after, lent in blender.run(code, blend=blend, command=stub, CHOSEN=CHOSEN, END=ENDS[end]):
        assert after == before
        assert lent == ""


def test_a_second_render_leaves_the_frames_of_the_first_until_it_is_asked_for(blender, stub, shot):
    code = """
    def stamps():
        return {p.name: p.stat().st_mtime_ns for p in Path(bpy.path.abspath("//frames")).glob("*.exr")}
    def render(**how):
        try:
            bpy.ops.ravg.denoise(render=True, **how)
        except RuntimeError as error:
            return str(error).strip()
    first = stamps()
    error = render()
    refused = stamps() == first
    Path(bpy.path.abspath("//frames/shot_0005.exr")).unlink()
    render(existing="KEEP")
    kept = stamps()
    render(existing="REPLACE")
    replaced = stamps()
    answer = [error, refused, [n for n in first if kept[n] != first[n]], [n for n in first if replaced[n] == kept[n]]]
    """
    error, refused, made, old = blender.run(code, blend=shot, command=stub)
    assert "noisy frames 4-6 are there already" in error
    assert refused
    assert made == ["shot_0005.exr"]
    assert old == []


@pytest.mark.parametrize("name", ["frames", "frames/denoised"])
def test_blenders_own_render_does_not_write_over_the_frames_of_ravg(blender, shot, name):
    """The output path is that of the frames: the panel says so, and the render skips those that are there."""
    shutil.copytree(shot.parent / "frames", shot.parent / "frames" / "denoised")
    before = contents(shot.parent / name)
    code = f"""{FORMATS}{PROBLEMS}
scene.render.filepath = "//{name}/shot_"
choose("MULTI_LAYER_IMAGE", "OPEN_EXR_MULTILAYER", "32", "RGBA")
said = texts()
bpy.ops.render.render(animation=True)
answer = [said, scene.render.use_overwrite, scene.ravg.lent]
"""
    said, overwrite, lent = blender.run(code, blend=shot)
    assert said == ["Output Path"]
    assert contents(shot.parent / name) == before
    assert (overwrite, lent) == (True, "")


def test_a_file_output_node_does_not_write_over_the_frames_of_ravg(blender, shot):
    """The node's files have the names of the noisy frames: the panel says so, and the node is muted for the render."""
    shutil.copytree(shot.parent / "frames", shot.parent / "frames" / "denoised")
    before = contents(shot.parent / "frames")
    code = f"""{PROBLEMS}
exec({COMPOSE!r})
files = file_output(tree)
files.name = 'Out.001 "mine"'
tree.links.new(next(n for n in tree.nodes if n.type == "IMAGE").outputs["Combined"], files.inputs[0])
answer = []
for directory in ("//else/", "//frames/"):
    aim(files, directory, "shot_")
    scene.render.filepath = f"//movie/{{len(answer)}}_"
    answer += [[problem.text for problem in scenes.problems(scene)]]
    bpy.ops.render.render(animation=True)
answer += [files.mute, scene.render.use_overwrite, scene.ravg.lent]
"""
    clean, warned, *after = blender.run(code, blend=shot)
    assert {path.name for path in (shot.parent / "else").iterdir()} == before.keys()
    assert len(list((shot.parent / "movie").iterdir())) == 6
    assert clean == []
    assert len(warned) == 1
    assert warned[0].startswith('Out.001 "mine": the folder is that of ravg\'s frames')
    assert contents(shot.parent / "frames") == before
    assert after == [False, True, ""]


@pytest.mark.skipif(not SINCE_5, reason="before Blender 5.0 paths hold no variables, and names are in slots")
@pytest.mark.parametrize(
    ("directory", "name", "found"),
    [
        ("//", "frames/shot_", True),
        ("//frames", "", True),
        ("//frames/", "denoised/", True),
        ("//frames/denoised/extra", "../shot_", True),
        ("//frames\\denoised\\", "/shot_", True),
        ("//frames", "de{node_name}/shot_", True),
        ("//{scene_name}/", "shot_", True),
        ("//frames/", "extra/shot_", False),
        ("//frames/{scene_name}/extra", "shot_", False),
        ("//else", "frames_", False),
        ("", "frames/shot_", False),
    ],
)
def test_a_file_output_node_is_found_by_folder_and_name_within_groups_too(blender, shot, directory, name, found):
    code = f"""{PROBLEMS}
outer, inner = (bpy.data.node_groups.new(name, "CompositorNodeTree") for name in ("Outer", "Inner"))
scene.compositing_node_group = outer
for _ in range(2):
    outer.nodes.new("CompositorNodeGroup").node_tree = inner
files = inner.nodes.new("CompositorNodeOutputFile")
files.directory, files.file_name = DIRECTORY, FILE_NAME
said = [problem.text for problem in scenes.problems(scene)]
scenes.keep_existing(scene)
muted = files.mute
scenes.restore(scene)
answer = [said, muted, files.mute]
"""
    said, muted, after = blender.run(code, blend=shot, DIRECTORY=directory, FILE_NAME=name)
    assert [text.partition(":")[0] for text in said] == ["File Output"] * found
    assert (muted, after) == (found, False)


def test_a_file_output_node_inside_a_group_does_not_write_over_the_frames_of_ravg(blender, shot):
    before = contents(shot.parent / "frames")
    code = f"""
exec({COMPOSE!r})
group = bpy.data.node_groups.new("Group", "CompositorNodeTree")
group.interface.new_socket("Image", in_out="INPUT", socket_type="NodeSocketColor")
files = file_output(group)
group.links.new(group.nodes.new("NodeGroupInput").outputs[0], files.inputs[0])
outer = tree.nodes.new("CompositorNodeGroup")
outer.node_tree = group
tree.links.new(next(n for n in tree.nodes if n.type == "IMAGE").outputs["Combined"], outer.inputs[0])
for directory, name in (("//else/", "shot_"), ("//", "frames/shot_")):
    aim(files, directory, name)
    scene.render.filepath = f"//movie/{{name.replace('/', '')}}"
    bpy.ops.render.render(animation=True)
answer = files.mute
"""
    shutil.copytree(shot.parent / "frames", shot.parent / "frames" / "denoised")
    assert blender.run(code, blend=shot) is False
    assert contents(shot.parent / "else").keys() == before.keys()
    assert contents(shot.parent / "frames") == before


@pytest.mark.skipif(SINCE_5, reason="Blender 5.0 and later have other settings")
def test_file_output_nodes_of_blender_before_5_are_found_too(blender, shot):
    code = """
    from bl_ext.user_default.ravg import scenes
    tree, _ = empty_compositor()
    files = file_output(tree)
    files.base_path = "//a/b_"
    layers = list(scenes._folders(files))
    files.format.file_format, files.base_path = "OPEN_EXR", "//"
    for slot in ("c/", "d"):
        files.file_slots.new(slot)
    files.file_slots[0].path = "a/b_"
    answer = [[str(Path(path).relative_to(bpy.path.abspath("//"))) for path in paths]
              for paths in (layers, scenes._folders(files))]
    """
    assert blender.run(code, blend=shot) == [["a"], ["a", "c", "."]]


@pytest.mark.parametrize("change", ["files.name = 'Renamed'", "tree.nodes.remove(files)", "tree.nodes.clear()"])
def test_other_settings_are_restored_where_a_muted_node_is_gone(blender, shot, change):
    code = f"""{PROBLEMS}
tree, _ = empty_compositor()
files = file_output(tree)
aim(files, "//frames/", "x_")
scene.render.filepath = "//frames/shot_"
choose_format(scene.render.image_settings, "MULTI_LAYER_IMAGE", "OPEN_EXR_MULTILAYER")
scenes.keep_existing(scene)
lent = [scene.render.use_overwrite, files.mute]
{change}
scenes.restore(scene)
answer = [lent, scene.render.use_overwrite, scene.ravg.lent]
"""
    assert blender.run(code, blend=shot) == [[False, True], True, ""]


def test_buttons_are_free_after_a_job_whose_end_fails(blender, stub, rendered):
    code = """
    from bl_ext.user_default.ravg import jobs
    def fail(report):
        raise RuntimeError("conclude")
    jobs.begin(scene).conclude = fail
    try:
        jobs.stop_current()
    except RuntimeError as error:
        answer = [str(error), bpy.ops.ravg.denoise.poll()]
    """
    assert blender.run(code, blend=rendered, command=stub) == ["conclude", True]


@pytest.mark.parametrize("end", ["render_complete", "render_cancel", ""])
def test_a_render_during_a_job_keeps_its_protection_to_its_own_end(blender, stub, shot, end):
    code = f"""{FORMATS}
from bl_ext.user_default.ravg import jobs
scene.render.filepath = "//frames/shot_"
choose("MULTI_LAYER_IMAGE", "OPEN_EXR_MULTILAYER", "32", "RGBA")
def call(name):
    for handler in list(getattr(bpy.app.handlers, name)): handler(scene)
    return scene.render.use_overwrite
job = jobs.begin(scene)
job.start()
answer = [call("render_init")]
if END:
    answer += [call(END), job.rendered, job.cancelled, job.run.stopped]
    call("render_init")
job.run.wait()
jobs.current = None
job.conclude(lambda *_: None)
answer += [scene.render.use_overwrite, call("render_complete"), scene.ravg.lent]
"""
    ended = [True, False, False, False] if end else []
    assert blender.run(code, blend=shot, command=stub, END=end) == [False, *ended, False, True, ""]


# Contents of an artist's file: nodes on two view layers, a File Output node, a strip in the sequencer.
NODES = """
layers = [scene.view_layers[0].name, scene.view_layers.new("fog bank").name]
tree, end = empty_compositor()
renders = []
for name in layers:
    renders.append(tree.nodes.new("CompositorNodeRLayers"))
    renders[-1].layer = name
tree.links.new(renders[0].outputs["Image"], end.inputs[0])
files = file_output(tree)
aim(files, "//extra/", "fog_")
tree.links.new(renders[1].outputs["Image"], files.inputs[0])
add_strip()
"""


@needs_ravg
def test_a_file_with_nodes_view_layers_and_strips_is_rendered_denoised_and_composited_right(blender, blend):
    code = f"""{PROBLEMS}
exec(NODES)
scene.frame_end = 5
bpy.ops.ravg.denoise(render=True)
early = Path(bpy.path.abspath("//extra")).exists()
said = texts()
scene.render.use_sequencer = False
bpy.ops.ravg.add_to_compositor()
started = time.monotonic()
movie("movie")
answer = [early, said, texts(), [node.mute for node in renders]]
"""
    early, said, after, muted = blender.run(code, blend=blend, NODES=NODES)
    assert not early, "File Output nodes run with the movie, not with the noisy frames"
    assert (said, after, muted) == (["Sequencer has strips"], [], [True, True])
    for frame in (4, 5):
        noisy, denoised = (
            channels(blend.parent / f"ravg/shot/{x}/Scene_{frame:04d}.exr") for x in ("noisy", "denoised")
        )
        assert not [name for name in noisy if name.startswith("Composite.")]
        extra = next(path for path in (blend.parent / "extra").iterdir() if f"{frame:04d}" in path.name)
        for path, layer in ((blend.parent / f"movie/{frame:04d}.exr", ""), (extra, "fog bank.")):
            names = [f"{layer}Combined.{c}" for c in "RGB"]
            assert not any(np.array_equal(noisy[name], denoised[name]) for name in names)
            seen = {name.rpartition(".")[2]: pixels for name, pixels in channels(path).items()}
            expected = np.stack([denoised[name] for name in names], axis=-1)
            assert expected.mean() > 0.1
            np.testing.assert_allclose(np.stack([seen[c] for c in "RGB"], axis=-1), expected, rtol=1e-5, atol=1e-6)


def eyes(path: Path, name: str) -> list[np.ndarray]:
    """A channel of the left and of the right view."""
    with OpenEXR.File(str(path), separate_channels=True) as file:
        if not SINCE_5:  # one part, in which names hold the view: ViewLayer.Combined.left.R
            before, _, component = name.rpartition(".")
            views = (f"{before}.{view}.{component}" for view in ("left", "right"))
            return [file.parts[0].channels[view].pixels for view in views]
        parts = [part for part in file.parts if name in part.channels]
        return [
            part.channels[name].pixels for view in ("left", "right") for part in parts if part.header["view"] == view
        ]


@needs_ravg
def test_both_eyes_of_a_stereo_scene_are_denoised_and_the_compositor_is_refused(blender, blend):
    code = """
    scene.render.use_multiview, scene.frame_end = True, 5
    bpy.ops.ravg.denoise(render=True)
    try:
        bpy.ops.ravg.add_to_compositor()
    except RuntimeError as error:
        from bl_ext.user_default.ravg import scenes
        answer = [str(error), [problem.text for problem in scenes.problems(scene)]]
    """
    refused, said = blender.run(code, blend=blend)
    assert "shows the left eye's image in both" in refused
    assert [text.partition(":")[0] for text in said] == ["Stereo"]
    for frame in (4, 5):
        noisy, denoised = (blend.parent / f"ravg/shot/{x}/Scene_{frame:04d}.exr" for x in ("noisy", "denoised"))
        left, right = eyes(denoised, "ViewLayer.Combined.R")
        assert not np.array_equal(left, right)
        for before, after in zip(eyes(noisy, "ViewLayer.Noisy Image.R"), (left, right), strict=True):
            assert not np.array_equal(before, after)
            assert abs(before.mean() - after.mean()) < 0.05 * before.mean()


NO_NOISY_FRAMES = {
    "composited": ("exec(COMPOSE)", "compositor"),
    "black": ("exec(COMPOSE); [tree.nodes.remove(n) for n in list(tree.nodes) if n != end_of(tree)]", "compositor"),
    "without passes": ("scene.view_layers[0].cycles.denoising_store_passes = False", "no pass Denoising Albedo"),
    "a single layer": ("FORMAT = ('IMAGE', 'OPEN_EXR')", "no Combined pass"),
}


@pytest.mark.parametrize("kind", NO_NOISY_FRAMES)
def test_frames_that_are_no_noisy_renders_are_refused_with_the_reason(blender, stub, shot, kind):
    change, reason = NO_NOISY_FRAMES[kind]
    shutil.copytree(shot.parent / "frames", shot.parent / "frames" / "denoised")
    code = f"""{PROBLEMS}{FAILING}"""
    script = f"""
FORMAT = ("MULTI_LAYER_IMAGE", "OPEN_EXR_MULTILAYER")
{change}
choose_format(scene.render.image_settings, *FORMAT)
scene.render.filepath = "//other/shot_"
bpy.ops.render.render(animation=True)
scene.ravg.noisy = "//other/shot_"
scene.render.filepath = "//movie/shot_"
{code}
answer += [texts()]
"""
    error, free, _, said = blender.run(script, blend=shot, command=stub, COMPOSE=COMPOSE)
    assert "shot_0004.exr is no noisy frame" in error
    assert reason in error
    assert free
    assert said[0].startswith("shot_0004.exr")


def test_a_link_to_nothing_is_named_as_a_frame_that_cannot_be_read(blender, stub, shot):
    frame = shot.parent / "frames" / "shot_0005.exr"
    frame.unlink()
    frame.symlink_to("gone.exr")
    error, free, _, said = blender.run(f"{PROBLEMS}{FAILING}\nanswer += [texts()]", blend=shot, command=stub)
    assert "shot_0005.exr is no noisy frame: it cannot be read (No such file or directory)" in error
    assert free
    assert said == ["shot_0005.exr"]


# --- installing ravg -----------------------------------------------------------------------------------


@pytest.fixture
def wheels(tmp_path: Path) -> Path:
    """A wheel of ravg that does nothing but say its version, with one for its requirement beside it."""
    code = f"print('ravg {VERSION}')"
    write_wheel(tmp_path, "pyoidn", "2.5.1", code)
    return write_wheel(tmp_path, "ravg", VERSION, code, "Provides-Extra: neural\n")


INSTALLING = """
from bl_ext.user_default.ravg import jobs, settings
def install(**how):
    try:
        return sorted(bpy.ops.ravg.install(**how))
    except RuntimeError as error:
        return str(error).strip()
def there():
    return sorted(path.name for path in settings.home().iterdir() if path.name != "rates.json")
def ran():
    return subprocess.run([settings.executable(), "--version"], capture_output=True, text=True).stdout.strip()
import os, subprocess
os.environ["PIP_CONFIG_FILE"] = os.devnull
"""


def test_ravg_is_installed_from_a_wheel_replaced_and_kept_where_that_fails(blender, wheels, tmp_path):
    bad = tmp_path / "bad"
    bad.mkdir()
    shutil.copy(wheels.parent / "pyoidn-2.5.1-py3-none-any.whl", bad)
    write_wheel(bad, "ravg", VERSION, "", "Provides-Extra: neural\nRequires-Dist: gone-for-good\n")
    code = (
        INSTALLING
        + """
bpy.context.preferences.system.use_online_access = False
answer = [install(wheel=GOOD), there(), ran(), jobs.ravg_problem(wait=True), install(wheel=GOOD), there(),
          install(wheel=BAD), there(), ran()]
"""
    )
    first, one, version, problem, second, two, failed, left, still = blender.run(
        code, command="", GOOD=str(wheels), BAD=str(bad / f"ravg-{VERSION}-py3-none-any.whl")
    )
    assert (first, one) == (["FINISHED"], ["1", "current.txt"])
    assert (version, problem) == (f"ravg {VERSION}", "")
    assert (second, two) == (["FINISHED"], ["2", "current.txt"])
    assert "ravg is not installed: " in failed
    assert "gone-for-good" in failed
    assert "Online Access is off" in failed
    assert (left, still) == (["2", "current.txt"], f"ravg {VERSION}")


def test_the_wheel_of_the_extension_is_installed_and_repairs_what_is_broken(blender, wheels, tmp_path):
    """Blender's update removes the Python that an environment's commands begin with."""
    code = (
        INSTALLING
        + """
import shutil
from bl_ext.user_default.ravg import install as module
bundled = Path(module.__file__).parent / "wheels"
bpy.context.preferences.system.use_online_access = False
shutil.copytree(WHEELS, bundled)
try:
    answer = [install(), ran()]
    tool = Path(settings.executable())
    tool.write_text("#!/gone/python3\\n" + tool.read_text().partition("\\n")[2])
    answer += [jobs.ravg_problem(wait=True), install(), ran(), jobs.ravg_problem(wait=True)]
finally:
    shutil.rmtree(bundled)
"""
    )
    done, version, problem, again, repaired, fine = blender.run(code, command="", WHEELS=str(wheels.parent))
    assert done == again == ["FINISHED"]
    assert version == repaired == f"ravg {VERSION}"
    assert "does not start as ravg" in problem
    assert "press Install ravg" in problem
    assert fine == ""


def test_an_installation_can_be_stopped_and_leaves_what_was_there(blender, wheels):
    """The index does not answer, so that pip waits."""
    code = (
        INSTALLING
        + """
import socket
from bl_ext.user_default.ravg import command
silent = socket.create_server(("127.0.0.1", 0))
os.environ["PIP_INDEX_URL"] = f"http://127.0.0.1:{silent.getsockname()[1]}/"
bpy.context.preferences.system.use_online_access = False
answer = [install(wheel=WHEEL), there()]
bpy.context.preferences.system.use_online_access = True
command.TERMINATED_AFTER = 0
job = jobs.begin_install(WHEEL, gpu=True)  # the index for CPUs is another
while job._step == 0 or not job.run.log:
    job.advance()
    time.sleep(0.05)
answer += [job.text, job.factor, there()]
bpy.ops.ravg.cancel()
while not job.ended:
    time.sleep(0.05)
answer += [sorted(bpy.ops.ravg.conclude()), there(), ran()]
"""
    )
    done, one, text, factor, two, stopped, left, version = blender.run(code, command="", WHEEL=str(wheels))
    assert done == ["FINISHED"]
    assert re.fullmatch(r"Installing ravg, \d+%: \S.*", text)
    assert 0 < factor < 1
    assert len(two) == len(one) + 1
    assert (stopped, left, version) == (["CANCELLED"], one, f"ravg {VERSION}")


def test_without_a_wheel_or_a_network_the_error_says_so(blender, tmp_path):
    needy = write_wheel(tmp_path, "ravg", VERSION, "", "Provides-Extra: neural\nRequires-Dist: torch\n")
    code = (
        INSTALLING
        + """
before = there() if settings.home().exists() else []
bpy.context.preferences.system.use_online_access = True
os.environ["PIP_INDEX_URL"] = "http://127.0.0.1:9/"
answer = [install(), install(wheel=WHEEL, gpu=True), before, there()]  # the index for CPUs is another
"""
    )
    without, failed, before, left = blender.run(code, command="", WHEEL=str(needy))
    assert "choose a wheel file of ravg" in without
    assert "the package index cannot be reached: check the network" in failed
    assert left == before


@pytest.mark.parametrize(
    ("says", "reason"),
    [
        ("ravg 99.2.5", f"ravg 99.2.5 is not of this extension's version, {VERSION.rpartition('.')[0]}"),
        ("Python 3", "does not start as ravg (Python 3)"),
    ],
)
def test_another_version_is_seen_before_the_button_and_refused(blender, shot, tmp_path, says, reason):
    tool = tmp_path / "ravg"
    tool.write_text(f"#!{sys.executable}\nprint({says!r})\n", encoding="utf-8")
    tool.chmod(0o755)
    code = f"""{DRAWN}{FAILING}
draw()
while not jobs._version.known:
    time.sleep(0.05)
answer += [draw()]
"""
    error, free, _, drawn = blender.run(code, blend=shot, command=str(tool))
    assert reason in error
    assert free
    assert any(reason in text for text in drawn)
    assert "Install ravg" in drawn


@pytest.mark.parametrize(("replaced", "seen"), [(True, [True, False]), (False, [True, True])])
def test_a_command_that_was_updated_is_asked_again(blender, shot, tmp_path, replaced, seen):
    """The panel sees a new file; the button asks again too, as the file of an editable clone stays the same."""
    tool, text = tmp_path / "ravg", tmp_path / "text"
    tool.write_text(f"#!{sys.executable}\nprint(open({str(text)!r}).read())\n", encoding="utf-8")
    tool.chmod(0o755)
    text.write_text("ravg 99.2.5", encoding="ascii")
    code = f"""
    from bl_ext.user_default.ravg import jobs
    tool = Path({str(tool)!r})
    def drawn():
        jobs.ravg_problem(wait=False)
        while not jobs._version.known:
            time.sleep(0.05)
        return bool(jobs.ravg_problem(wait=False))
    answer = [drawn()]
    Path({str(text)!r}).write_text("ravg {VERSION}")
    if REPLACED:
        tool.with_name("new").write_text(tool.read_text())
        tool.with_name("new").chmod(0o755)
        tool.with_name("new").replace(tool)
    answer += [drawn(), jobs.ravg_problem(wait=True)]
    """
    assert blender.run(code, blend=shot, command=str(tool), REPLACED=replaced) == [*seen, ""]


# --- what goes wrong -----------------------------------------------------------------------------------


def test_a_command_that_is_not_there_is_an_error_in_blender(blender, shot):
    error, free, _ = blender.run(FAILING, blend=shot, command="no-such-ravg")
    assert "no command 'no-such-ravg': press Install ravg, or name its path in Preferences" in error
    assert free


def test_frames_that_are_not_there_are_an_error_in_blender(blender, stub, blend):
    error, free, _ = blender.run(FAILING, blend=blend, command=stub)
    assert "Render and Denoise renders them" in error
    assert free


@needs_ravg
def test_an_error_of_ravg_is_an_error_in_blender(blender, shot):
    error, free, log = blender.run("scene.ravg.folder = '//shot.blend'\n" + FAILING, blend=shot)
    assert "shot.blend" in error
    assert "ravg.log" in error
    assert free
    assert log


@pytest.mark.parametrize(
    ("running", "answer", "reason"),
    [
        (True, {"RUNNING_MODAL"}, "Blender is rendering: wait for its end, or stop it"),
        (False, {"CANCELLED"}, "Blender has not rendered the frames: its console may say why"),
    ],
)
def test_a_render_that_does_not_start_is_an_error_and_leaves_the_settings(
    blender, stub, blend, running, answer, reason
):
    code = """
    from types import SimpleNamespace
    from bl_ext.user_default.ravg import jobs, operators
    rendered, reports = [], []
    def render(*how, **options):
        rendered.append(scene.render.filepath)
        return ANSWER
    app = SimpleNamespace(is_job_running=lambda kind: RUNNING)
    operators.bpy = SimpleNamespace(app=app, ops=SimpleNamespace(render=SimpleNamespace(render=render)))
    operator = SimpleNamespace(render=True, wait=False, existing="ASK", report=lambda kind, text: reports.append(text))
    operator._existing = lambda scene: ""
    operator._begin = lambda scene: operators.Denoise._begin(operator, scene)
    done = operators.Denoise.execute(operator, bpy.context)
    answer = [list(done), reports, len(rendered), scene.render.filepath, scene.ravg.lent, jobs.current]
    """
    found = blender.run(code, blend=blend, command=stub, RUNNING=running, ANSWER=answer)
    assert found == [["CANCELLED"], [reason], 0 if running else 1, "//movie/shot_", "", None]


def test_there_is_nothing_to_show_before_it_has_run(blender, shot):
    code = FAILING.replace("ravg.denoise()", "ravg.show()")
    assert "no denoised frames" in blender.run(code, blend=shot)[0]
