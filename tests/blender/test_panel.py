"""The panel and the dialogs, drawn by Blender without a window into a layout that records them."""

import re
import shutil
import sys

import pytest

from tests.blender.session import DRAWN, FAILING, ROOT, VERSION

pytestmark = pytest.mark.cycles
pytest.importorskip("bpy", reason="runs Blender: pip install bpy==5.0.1")


def test_the_panel_of_a_new_scene_is_that_of_the_documentation(blender, blend):
    text = (ROOT / "docs" / "blender.md").read_text(encoding="utf-8")
    block = re.search(r"```\n(Denoising Data.*?)\n```", text, re.DOTALL)
    assert block
    code = f"""{DRAWN}
from bl_ext.user_default.ravg import forecast
forecast._path().unlink(missing_ok=True)
scene.cycles.use_denoising = True  # as in a new file
answer = draw()
"""
    assert blender.run(code, blend=blend) == block[1].splitlines()


def test_an_output_path_that_blender_cannot_read_leaves_the_panel_whole(blender, stub, rendered):
    code = DRAWN + "scene.render.filepath = '//{no_such}/x_'; answer = draw()"
    assert "Render and Denoise" in blender.run(code, blend=rendered, command=stub)


def test_the_panel_of_a_job_shows_how_far_it_is_and_a_way_to_stop_it(blender, stub, rendered):
    begin = "from bl_ext.user_default.ravg import scenes; jobs.begin(scene); scenes.override(scene, replace=True)"
    code = f"{DRAWN}{begin}; answer = draw()"
    drawn = blender.run(code, blend=rendered, command=stub)
    assert drawn == [*SETTINGS, "Rendering: 0 of 0 frames", "Stop"]


def test_the_panel_of_a_job_looks_at_no_frame(blender, shot, tmp_path):
    """It is drawn four times a second and more: looking at a thousand frames on a server would take longer."""
    tool = tmp_path / "ravg"
    listens = f"print('ravg {VERSION}')\nif 'denoise' in sys.argv: sys.stdin.read()\n"
    tool.write_text(f"#!{sys.executable}\nimport sys\n{listens}", encoding="utf-8")
    tool.chmod(0o755)
    code = f"""{DRAWN}
scene.frame_end = 7
job = jobs.begin(scene)
job.start()
jobs.follow()
looked = []
sys.addaudithook(lambda event, found: looked.append(str(found)) if event == "os.listdir" else None)
stat = Path.stat
Path.stat = lambda path, **how: looked.append(str(path)) or stat(path, **how)
answer = [draw()[-2:], [path for path in looked if "frames" in path]]
Path.stat = stat
jobs.stop_current()
"""
    drawn, looked = blender.run(code, blend=shot, command=str(tool))
    assert drawn == ["Denoising: 0 of 3 frames", "Stop"]
    assert looked == []


SETTINGS = ["Preset", "Light Passes", "Strength", "Noisy Frames", "Denoised Frames"]
BUTTONS = ["Show", "Compare", "Add to Compositor"]


def test_each_state_of_a_shot_has_a_panel_that_says_what_comes_next(blender, stub, shot):
    """Not saved, rendered, at work, denoised, composited, in this order."""
    code = f"""{DRAWN}
import shutil
from bl_ext.user_default.ravg import forecast, scenes
forecast._path().unlink(missing_ok=True)
answer = [draw()]
forecast.learn(scene, 2.0)
job = jobs.begin(scene)
job.to_render, job._started = 3, time.monotonic() - 20
bpy.app.handlers.render_write[-1](scene)
rendering = draw()
jobs.stop_current()
shutil.copytree(bpy.path.abspath("//frames"), bpy.path.abspath("//frames/denoised"))
answer += [rendering, draw()]
bpy.ops.ravg.add_to_compositor()
answer += [draw()]
bpy.ops.wm.read_homefile()
scene = bpy.context.scene
answer += [draw()]
"""
    rendered, rendering, denoised, composited, unsaved = blender.run(code, blend=shot, command=stub)
    first = "3 frames from Blender's denoised frames; the first run measures the time"
    begin = ["Render and Denoise", "Denoise Frames"]
    assert rendered == [*SETTINGS, first, *begin, "3 of 3 noisy frames are there, 0 are denoised", *BUTTONS]
    assert rendering == [*SETTINGS, "Rendering: 1 of 3 frames, 40 seconds left", "Stop"]
    again = ["3 frames, about 2 seconds each, 6 seconds, from Blender's denoised frames", *begin]
    again += ["3 of 3 noisy frames are there, 3 are denoised", *BUTTONS]
    assert denoised == [*SETTINGS, *again, "Render Animation renders the noisy scene"]
    assert composited == [*SETTINGS, *again, "Render Animation writes the denoised frames"]
    assert unsaved[0].startswith("File is not saved: save it")


def test_dialogs_say_what_exists_and_what_is_downloaded(blender):
    code = f"""{DRAWN}
from bl_ext.user_default.ravg import operators
answer = [draw(operators.Denoise, bl_rna=operator("denoise"))]
for online in (False, True):
    bpy.context.preferences.system.use_online_access = online
    for gpu in (False, True):
        answer += [draw(operators.Install, wheel="/a.whl", gpu=gpu, bl_rna=operator("install"))]
"""
    existing, offline, _, cpu, gpu = blender.run(code)
    assert existing == ["Keep Finished Frames", "Make All Again"]
    assert offline == ["Wheel", "Online Access is off: wheels of all requirements are needed beside it"]
    choice = ["For GPUs"] if sys.platform == "linux" else []
    assert cpu == ["Wheel", *choice, "Downloads about 0.4 GB, and takes 1.8 GB on disk"]
    assert (gpu != cpu) == (sys.platform == "linux")


def test_compare_plays_both_sequences_until_the_file_is_closed(blender, shot, tmp_path):
    """The command is a stub that waits, as `ravg view` does."""
    tool = tmp_path / "ravg"
    listens = "print(' '.join(sys.argv[1:]), flush=True)\nif 'view' in sys.argv: sys.stdin.read()\n"
    tool.write_text(f"#!{sys.executable}\nimport sys\n{listens}", encoding="utf-8")
    tool.chmod(0o755)
    shutil.copytree(shot.parent / "frames", shot.parent / "frames" / "denoised")
    code = """
    from bl_ext.user_default.ravg import jobs
    answer = [sorted(bpy.ops.ravg.compare())]
    first = jobs.viewer
    bpy.ops.ravg.compare()
    second = jobs.viewer
    while not second.log:
        time.sleep(0.05)
    answer += [second.log.strip(), first.code is not None, second.code]
    bpy.ops.wm.read_homefile()
    answer += [second.code is not None, jobs.viewer]
    """
    done, said, ended, running, closed, viewer = blender.run(code, blend=shot, command=str(tool))
    frames = shot.parent / "frames"
    assert (done, ended, running, closed, viewer) == (["FINISHED"], True, None, True, None)
    assert said == f"view {frames / 'denoised' / 'shot_####.exr'} --beside {frames / 'shot_####.exr'}"


def test_there_is_nothing_to_compare_before_it_has_run(blender, stub, shot):
    code = FAILING.replace("ravg.denoise()", "ravg.compare()")
    assert "no denoised frames" in blender.run(code, blend=shot, command=stub)[0]


@pytest.mark.parametrize(
    ("seconds", "text"),
    [(0.4, "0.4 seconds"), (4.2, "4.2 seconds"), (89, "89 seconds"), (1020, "17 minutes"), (9000, "2.5 hours")],
)
def test_times_are_one_number(blender, seconds, text):
    code = "from bl_ext.user_default.ravg import forecast; answer = forecast.duration(SECONDS)"
    assert blender.run(code, SECONDS=seconds) == text
