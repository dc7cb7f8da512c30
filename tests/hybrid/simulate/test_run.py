"""`ravg simulate` around the renderer: settings, levels, processes, going on where it stopped. No Blender."""

import json
import subprocess
import sys
from dataclasses import replace
from pathlib import Path

import pytest

from hybrid.cli import main
from hybrid.simulate.run import (
    SimulationError,
    check_blender,
    parse_center,
    parse_size,
    read_meta,
    samples_left,
    shots_of,
    simulate,
)
from hybrid.simulate.shot import ShotSettings, frame_seed, parse_levels, parse_samples
from tests.commands import words_in

ROOT = Path(__file__).parents[3]
SHOT = ShotSettings("random", 3, (1, 2, 3), (64, 36), {"a": 8, "b": 8, "c": 2})

# Stands in for a Python with bpy: says that it has it, and "renders" empty files in the way the worker does.
STUB = """
import json, os, sys, time
if sys.argv[1] == "-c":
    sys.exit({found})
job = json.load(open(sys.argv[3]))
if {fail}:
    sys.exit("RuntimeError: out of rays")
if job["plan"] is None:
    print(json.dumps({{"plan": {{"attempt": 0, "description": {{}}, "printed": []}}}}))
for frame in job["frames"]:
    for name, spp in job["shot"]["levels"].items():
        path = os.path.join(job["out"], f"{{name}}.{{frame:04d}}.exr")
        if not os.path.exists(path):
            open(path, "w").write(str(os.getpid()))
            print(json.dumps({{"file": os.path.basename(path), "samples": spp, "seconds": 0.5}}))
"""


@pytest.fixture
def stub(tmp_path):
    if sys.platform == "win32":
        pytest.skip("the stub is a script of a shell")

    def make(found=0, fail="False"):
        script = tmp_path / "stub.py"
        script.write_text(STUB.format(found=found, fail=fail))
        python = tmp_path / "python"
        python.write_text(f'#!/bin/sh\nexec "{sys.executable}" "{script}" "$@"\n')
        python.chmod(0o755)
        return str(python)

    return make


def test_levels_as_the_issue_has_them():
    assert parse_levels("n,n/e,4", 32) == {"a": 32, "b": 11, "c": 4}
    assert parse_levels("n, n ,n/e", 9) == {"a": 9, "b": 9, "c": 3}
    assert parse_levels("n", 16) == {"noisy": 16}
    assert parse_levels("noisy=n,half=n/2,few=4", 16) == {"noisy": 16, "half": 8, "few": 4}
    assert parse_levels("n/e", 2) == {"noisy": 1}, "rounded down to nothing would be no picture"


@pytest.mark.parametrize("text", ["", "n/0", "m", "n*2", "a=n,a=4", "reference=n", "a b=n/x", "-4"])
def test_levels_that_are_none_are_refused(text):
    with pytest.raises(ValueError, match="levels"):
        parse_levels(text, 16)


def test_samples_are_drawn_from_a_range_by_the_seed():
    drawn = [parse_samples("8-64", seed) for seed in range(400)]
    assert drawn == [parse_samples("8-64", seed) for seed in range(400)]
    assert min(drawn) == 8
    assert max(drawn) <= 64
    # Uniform in the logarithm: the median of 8 … 64 is √(8·65) ≈ 22.8; of 400 draws within ±3 with 99 %.
    assert abs(sorted(drawn)[200] - 22.8) < 4
    assert parse_samples("16", 5) == 16
    for wrong in ("0", "8-4", "x"):
        with pytest.raises(ValueError, match="spp"):
            parse_samples(wrong, 1)


def test_seeds_differ_between_frames_levels_and_shots():
    seeds = {frame_seed(s, level, f) for s in range(10) for level in ("a", "b", "c") for f in range(10)}
    assert len(seeds) == 300
    assert all(0 <= seed < 2**31 for seed in seeds), "Blender holds a signed 32-bit seed"


def test_frames_and_sizes():
    assert parse_size("320x180", "size") == (320, 180)
    with pytest.raises(ValueError, match="film: got '320'"):
        parse_size("320", "film")
    assert parse_center("0.25,1") == (0.25, 1)
    for wrong in ("0.5", "0.5,", "0.5,1.5", "a,b", "-0.1,0"):
        with pytest.raises(ValueError, match=f"center: got '{wrong}', expected X,Y"):
            parse_center(wrong)


@pytest.mark.parametrize(
    ("name", "value"), [("levels", {"a": 0}), ("size", (4, 4)), ("film", (32, 36)), ("reference_frames", (4,))]
)
def test_settings_that_cannot_be_are_refused(name, value):
    with pytest.raises(ValueError, match=name.rstrip("s").replace("_", " ")):
        ShotSettings(**{**SHOT.to_json(), name: value})


def test_settings_survive_json():
    shot = replace(SHOT, reference=16, reference_frames=(2,))
    assert ShotSettings.from_json(json.loads(json.dumps(shot.to_json()))) == shot


def test_only_the_frames_that_are_named_get_a_reference():
    some = replace(SHOT, reference=16, reference_frames=(2,))
    assert ["reference" in some.renders(frame) for frame in some.frames] == [False, True, False]
    assert all("reference" in replace(SHOT, reference=16).renders(frame) for frame in SHOT.frames)
    assert SHOT.renders(1) == SHOT.levels, "no reference was asked for"


def settings(spp, levels):
    """Return what makes settings of a scene and a seed, as the command does."""
    return lambda scene, seed: replace(
        SHOT, scene=scene, seed=seed, levels=parse_levels(levels, parse_samples(spp, seed))
    )


def test_a_data_set_is_many_seeds_each_in_its_folder(tmp_path):
    shots = shots_of("random", tmp_path, 3, 3, settings("8-64", "n,n,n/e"))
    assert [folder.name for _, folder in shots] == ["random_0003", "random_0004", "random_0005"]
    assert all(shot.levels["a"] == shot.levels["b"] > shot.levels["c"] for shot, _ in shots)
    assert shots_of("random", tmp_path, 3, 1, settings("8", "n"))[0][1] == tmp_path
    hard = shots_of("hard", tmp_path, 3, 2, settings("8", "n"))
    assert [(shot.scene, folder.name) for shot, folder in hard] == [("hard", "hard_0003"), ("hard", "hard_0004")]


def test_a_shot_is_rendered_and_described(tmp_path, stub):
    events = []
    simulate([(SHOT, tmp_path / "s")], python=stub(), on_event=lambda *event: events.append(event))
    assert len(list((tmp_path / "s").glob("*.exr"))) == 9
    meta = json.loads((tmp_path / "s" / "meta.json").read_text())
    assert ShotSettings.from_json(meta["shot"]) == SHOT
    assert meta["plan"]["attempt"] == 0
    assert len(meta["seconds"]) == 9
    assert [kind for kind, *_ in events] == ["plan"] + ["frame"] * 9


def test_going_on_leaves_finished_frames_untouched(tmp_path, stub):
    python, out = stub(), tmp_path / "s"
    simulate([(SHOT, out)], python=python)
    before = {path.name: path.read_text() for path in out.glob("*.exr")}
    (out / "b.0002.exr").unlink()
    assert [samples_left(SHOT, out, frame) for frame in SHOT.frames] == [0, 8, 0]
    simulate([(SHOT, out)], python=python)
    after = {path.name: path.read_text() for path in out.glob("*.exr")}
    assert before.pop("b.0002.exr") != after.pop("b.0002.exr")
    assert before == after
    assert len(json.loads((out / "meta.json").read_text())["seconds"]) == 9


def test_several_jobs_share_the_frames_of_one_shot_under_one_plan(tmp_path, stub):
    plans = []
    simulate([(SHOT, tmp_path)], jobs=3, python=stub(), on_event=lambda kind, *_: plans.append(kind == "plan"))
    assert sum(plans) == 1
    assert len({path.read_text() for path in tmp_path.glob("*.exr")}) == 3


def test_a_folder_of_another_shot_is_refused(tmp_path, stub):
    python = stub()
    simulate([(SHOT, tmp_path)], python=python)
    other = ShotSettings(**{**SHOT.to_json(), "seed": 4})
    with pytest.raises(ValueError, match=r"seed 3, expected 4"):
        simulate([(other, tmp_path)], python=python)


def test_a_folder_of_an_earlier_version_is_continued(tmp_path, stub):
    """Until 0.2 the setting `moving_objects` was called `movers`."""
    shot = replace(SHOT, moving_objects=2)
    simulate([(shot, tmp_path)], python=stub())
    path = tmp_path / "meta.json"
    path.write_text(path.read_text().replace('"moving_objects": 2', '"movers": 2'))
    assert read_meta(shot, tmp_path)["shot"] == json.loads(json.dumps(shot.to_json()))
    with pytest.raises(ValueError, match="moving_objects 2, expected None"):
        read_meta(SHOT, tmp_path)


def test_options_reach_the_settings_of_the_shot(tmp_path, stub):
    words = ["simulate", "random", "-o", str(tmp_path), "--frames", "1-2", "--levels", "n", "--spp", "2", "--python"]
    words += [stub(), "--film", "640x360", "--center", "0.25,0.5", "--seed", "7", "--halves", "--motion-blur"]
    words += ["--effects", "all", "--animate", "add", "--camera", "random", "--reference", "4"]
    assert main([*words, "--reference-frames", "2", "--moving-objects", "3"]) == 0
    found = ShotSettings.from_json(json.loads((tmp_path / "meta.json").read_text())["shot"])
    assert found == ShotSettings(
        "random", 7, (1, 2), (320, 180), {"noisy": 2}, reference=4, reference_frames=(2,), film=(640, 360),
        center=(0.25, 0.5), camera="random", motion="add", moving_objects=3, motion_blur=True, halves=True,
        effects="all",
    )  # fmt: skip


def test_half_buffers_need_two_samples_of_each_level(tmp_path, capsys):
    assert main(["simulate", "random", "-o", str(tmp_path), "--spp", "2", "--levels", "n,n/2", "--halves"]) == 2
    error = words_in(capsys.readouterr().err)
    assert "level b: got 1 sample per pixel, expected at least 2 for half buffers" in error


def test_finished_pictures_of_another_shot_are_not_those_asked_for(tmp_path, stub, capsys):
    """The command has nothing to render then, and must not say that all is there."""
    words = ["-o", str(tmp_path / "shot"), "--frames", "1-2", "--levels", "n", "--spp", "2", "--python", stub()]
    assert main(["simulate", "hard", *words]) == 0
    assert main(["simulate", "hard", *words]) == 0
    assert "all 2 renders exist" in capsys.readouterr().err
    assert main(["simulate", "random", *words]) == 1
    assert "holds a shot with scene 'hard', expected 'random'" in capsys.readouterr().err


def test_what_a_folder_says_of_its_shot_must_be_readable(tmp_path, stub):
    (tmp_path / "meta.json").write_text("{")
    with pytest.raises(ValueError, match=r"meta\.json: expected what ravg simulate writes"):
        simulate([(SHOT, tmp_path)], python=stub())


def test_a_renderer_that_fails_is_reported_with_its_last_word(tmp_path, stub):
    with pytest.raises(SimulationError, match="out of rays"):
        simulate([(SHOT, tmp_path)], python=stub(fail="True"))


# A renderer behind a launcher, as in Windows' virtual environments: its number is not that of the process that was
# started. It leaves an unfinished file when it is killed.
LAUNCHED = """
import json, os, sys, time
if sys.argv[1] == "-c":
    sys.exit(0)
job, launcher = json.load(open(sys.argv[3])), os.getppid()
open(os.path.join(job["out"], f".{job['mark']}-1-a.0001.exr"), "w").close()
print(json.dumps({"plan": {"attempt": 0, "description": {}, "printed": []}}), flush=True)
while os.getppid() == launcher:
    time.sleep(0.05)
"""


@pytest.mark.posix
def test_unfinished_files_of_a_renderer_behind_a_launcher_are_removed(tmp_path):
    script, python = tmp_path / "stub.py", tmp_path / "python"
    script.write_text(LAUNCHED)
    python.write_text(f'#!/bin/sh\n"{sys.executable}" "{script}" "$@"\n')
    python.chmod(0o755)
    there = []

    def interrupt(kind, out, message):
        there.extend(path.name for path in out.glob(".*.exr"))
        raise KeyboardInterrupt

    with pytest.raises(KeyboardInterrupt):
        simulate([(SHOT, tmp_path / "s")], python=str(python), on_event=interrupt)
    assert len(there) == 1
    assert not list((tmp_path / "s").glob(".*.exr"))


def test_without_blender_the_message_says_how_to_get_it(stub):
    with pytest.raises(SimulationError, match=r"pip install \"bpy==5\.0\.1\".*Python 3\.11.*--python"):
        check_blender(stub(found=3))
    with pytest.raises(SimulationError, match="cannot run"):
        check_blender("/no/such/python")


def test_a_missing_scene_is_one_line(tmp_path, capsys):
    assert main(["simulate", "no.blend", "-o", str(tmp_path)]) == 1
    error = capsys.readouterr().err
    assert error == "error: scene: no file no.blend; expected a .blend file, random or hard\n"


def test_importing_the_command_loads_no_renderer():
    code = "import sys, hybrid.commands.simulate; print(*sorted({m.split('.')[0] for m in sys.modules}))"
    loaded = subprocess.run([sys.executable, "-c", code], capture_output=True, text=True, check=True, cwd=ROOT).stdout
    assert "typer" in loaded.split()
    assert not {"bpy", "mathutils", "OpenEXR", "cv2", "torch", "numba", "numpy", "rich"} & set(loaded.split())
