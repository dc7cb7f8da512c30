"""From denoised frames to the movie: what an artist does next, and what Blender then writes."""

import shutil
from pathlib import Path

import numpy as np
import pytest

from tests.blender.session import COMPOSE, PROBLEMS, Blender, channels, needs_ravg, picture

pytestmark = pytest.mark.cycles
SINCE_5 = pytest.importorskip("bpy", reason="runs Blender: pip install bpy==5.0.1").app.version >= (5, 0, 0)

# The denoised frames are half as bright as the noisy ones, so that a picture tells which of both it shows.
LOOK = 0.5
MOVIE = """
def add():
    try:
        return sorted(bpy.ops.ravg.add_to_compositor())
    except RuntimeError as error:
        return str(error).strip()
def ours():
    return [node for _, node in scenes.nodes(scene) if node.type == "IMAGE"]
def said():
    return [problem.text for problem in (*scenes.problems(scene), *compositor.problems(scene))]
from bl_ext.user_default.ravg import compositor, scenes
"""


def darken(shot: Path) -> Path:
    """Write denoised frames as ravg would, but with half the light."""
    import OpenEXR

    made = shot.parent / "frames" / "denoised"
    made.mkdir()
    for path in sorted((shot.parent / "frames").glob("*.exr")):
        with OpenEXR.File(str(path), separate_channels=True) as file:
            for part in file.parts:
                for name, channel in part.channels.items():
                    if ".Combined." in name and not name.endswith(".A"):
                        channel.pixels = (channel.pixels * LOOK).astype(np.float32)
            file.write(str(made / path.name))
    return shot


@pytest.fixture
def denoised(shot: Path) -> Path:
    """A scene with noisy and denoised frames; the path of its file."""
    return darken(shot)


def mean(path: Path) -> float:
    """The mean of what a movie's frame shows."""
    found = channels(path)
    return float(np.mean([found[c] for c in "RGB"]))


def test_a_project_that_was_moved_still_shows_its_frames(blender: Blender, denoised: Path, tmp_path: Path):
    expected = picture(denoised.parent / "frames" / "denoised" / "shot_0005.exr").mean()
    code = f"{MOVIE}{COMPOSE}\nbpy.ops.wm.save_mainfile()\nanswer = [node.image.filepath for node in ours()]"
    assert blender.run(code, blend=denoised) == ["//frames/denoised/shot_0004.exr"]
    moved = Path(shutil.move(denoised.parent, tmp_path / "elsewhere"))
    again = f"{MOVIE}movie('movie')\nanswer = [add(), said(), [n.outputs[0].is_linked for n in ours()]]\nmovie('again')"
    assert blender.run(again, blend=moved / denoised.name) == [["FINISHED"], [], [True]]
    for name in ("movie", "again"):
        assert mean(moved / name / "0005.exr") == pytest.approx(expected, rel=1e-3)


def test_nodes_of_an_earlier_version_are_found_in_a_project_that_was_moved(blender, denoised, tmp_path):
    """It wrote absolute paths, and no mark but the label."""
    expected = picture(denoised.parent / "frames" / "denoised" / "shot_0005.exr").mean()
    old = f"""{MOVIE}{COMPOSE}
scene.ravg.noisy = bpy.path.abspath(scene.ravg.noisy)
for node in ours():
    del node["ravg"]
    node.image.filepath = bpy.path.abspath(node.image.filepath)
bpy.ops.wm.save_mainfile(relative_remap=False)
answer = scene.ravg.noisy
"""
    assert blender.run(old, blend=denoised) == "//frames/shot_"
    moved = Path(shutil.move(denoised.parent, tmp_path / "elsewhere"))
    code = f"""{MOVIE}
bpy.ops.wm.open_mainfile(filepath=bpy.data.filepath)  # with the extension switched on, as it is from then on
scene = bpy.context.scene
movie('movie')
answer = [said(), [node.image.filepath for node in ours()]]
"""
    assert blender.run(code, blend=moved / denoised.name) == [[], ["//frames/denoised/shot_0004.exr"]]
    assert mean(moved / "movie" / "0005.exr") == pytest.approx(expected, rel=1e-3)


def test_a_path_outside_the_folder_of_the_file_stays_absolute(blender, denoised, tmp_path):
    code = """
    scene.ravg.noisy, scene.ravg.folder = OUTSIDE, "//mine"
    bpy.ops.wm.save_mainfile()
    answer = [scene.ravg.noisy, scene.ravg.folder]
    """
    outside = str(tmp_path / "farm" / "shot_")
    assert blender.run(code, blend=denoised, OUTSIDE=outside) == [outside, "//mine"]


def test_frames_that_are_gone_are_named_before_the_movie_is_transparent(blender, denoised):
    code = f"""{MOVIE}{COMPOSE}
answer = [said()]
Path(bpy.path.abspath("//frames/denoised/shot_0005.exr")).unlink()
answer += [said()]
scene.frame_end = 9
answer += [[text.partition(":")[0] for text in said()]]
scene.ravg.folder = "//elsewhere"
answer += [[text.partition(" in ")[0] for text in said()], add()]
"""
    whole, gap, longer, elsewhere, refused = blender.run(code, blend=denoised)
    assert whole == []
    assert gap == ["Frames 5 are not denoised: the movie is transparent there, Denoise Frames"]
    assert longer[-1] == "The compositor shows frames 4-6, the scene has others"
    assert elsewhere[-1] == "The compositor does not show the frames"
    assert "no denoised frames in" in refused


def test_adding_again_uses_the_nodes_that_are_there(blender, denoised):
    code = f"""{MOVIE}
first = [add(), len(ours())]
scene.frame_end = 5
second = [add(), len(ours()), said()]
tree = getattr(scene, "compositing_node_group", None) or scene.node_tree
for node in ours():
    tree.nodes.remove(node)
removed = [compositor.movie(scene), add(), len(ours()), compositor.movie(scene)]
end = end_of(tree)
tree.links.remove(end.inputs[0].links[0])
tree.links.new(tree.nodes.new("CompositorNodeRGB").outputs[0], end.inputs[0])
answer = [first, second, removed, [add(), len(ours()), compositor.movie(scene)]]
"""
    first, second, removed, unread = blender.run(code, blend=denoised)
    assert first == [["FINISHED"], 1]
    assert second == [["FINISHED"], 1, []]
    shown = "Render Animation writes the denoised frames"
    assert removed == ["Render Animation renders the noisy scene", ["FINISHED"], 1, shown]
    assert "nothing reads the node Denoised" in unread[0]
    assert unread[1:] == [1, "Render Animation renders the noisy scene"]


def test_another_folder_is_shown_after_the_frames_are_denoised_into_it(blender, denoised, stub):
    """`conclude`, which follows a run, lets the nodes show the result."""
    code = f"""{MOVIE}{COMPOSE}
import shutil
scene.ravg.folder = "//second"
shutil.copytree(bpy.path.abspath("//frames/denoised"), bpy.path.abspath("//second"))
before = said()
bpy.ops.ravg.denoise(existing="KEEP")
answer = [len(before), said(), [node.image.filepath for node in ours()]]
"""
    assert blender.run(code, blend=denoised, command=stub) == [1, [], ["//second/shot_0004.exr"]]


def test_compositing_that_is_off_is_said_and_switched_on(blender, denoised):
    code = f"""{MOVIE}{COMPOSE}
scene.render.use_compositing = False
answer = [compositor.movie(scene), add(), compositor.movie(scene)]
"""
    off, done, on = blender.run(code, blend=denoised)
    assert off == "Render Animation renders the noisy scene: Compositing is off"
    assert (done, on) == (["FINISHED"], "Render Animation writes the denoised frames")


@needs_ravg
def test_the_denoised_file_stands_for_the_render_layer(blender, blend):
    """Mist, alpha and a matte in one picture: the same through Render Layers and through the denoised frames."""
    code = f"""{MOVIE}
scene.frame_end, scene.render.film_transparent, scene.ravg.preset = 5, True, "average"
bpy.data.objects["Plane"].scale = 0.2, 0.2, 0.2
layer = scene.view_layers[0]
layer.use_pass_mist = layer.use_pass_diffuse_direct = layer.use_pass_cryptomatte_object = True
bpy.ops.ravg.denoise(render=True)
tree, end = empty_compositor()
render, matte, three = (tree.nodes.new(f"CompositorNode{{x}}") for x in ("RLayers", "CryptomatteV2", "CombineColor"))
matte.matte_id = "Sphere"
tree.links.new(render.outputs["Image"], matte.inputs[0])
for index, output in enumerate((render.outputs["Mist"], render.outputs["Alpha"], matte.outputs["Matte"])):
    tree.links.new(output, three.inputs[index])
tree.links.new(three.outputs[0], end.inputs[0])
sockets = [output.name for output in render.outputs if output.enabled]
movie("rendered")
added = add()
movie("denoised")
(image,) = [node for node in ours()]
found = [output.name for output in image.outputs]
answer = [added, set(sockets) - set(found) - {{"Image", "Noisy Image"}}, render.mute, said(), compositor.movie(scene)]
answer[1] = sorted(answer[1])
"""
    added, lacking, muted, said, movie = blender.run(code, blend=blend)
    assert (added, lacking, muted, said) == (["FINISHED"], [], True, [])
    assert movie == "Render Animation writes the denoised frames"
    for frame in (4, 5):
        rendered, denoised = (channels(blend.parent / x / f"{frame:04d}.exr") for x in ("rendered", "denoised"))
        for c, pass_name in zip("RGB", ("mist", "alpha", "matte"), strict=True):
            assert 0.01 < rendered[c].mean() < 0.99, pass_name
            np.testing.assert_allclose(denoised[c], rendered[c], atol=2e-3, err_msg=pass_name)


@pytest.mark.skipif(not SINCE_5, reason="before Blender 5.0 groups hold no Render Layers")
def test_render_layers_within_a_group_are_replaced_too(blender, denoised):
    expected = picture(denoised.parent / "frames" / "denoised" / "shot_0005.exr").mean()
    code = f"""{MOVIE}
tree, end = empty_compositor()
group = bpy.data.node_groups.new("Group", "CompositorNodeTree")
group.interface.new_socket("Image", in_out="OUTPUT", socket_type="NodeSocketColor")
group.links.new(group.nodes.new("CompositorNodeRLayers").outputs["Image"], group.nodes.new("NodeGroupOutput").inputs[0])
outer = tree.nodes.new("CompositorNodeGroup")
outer.node_tree = group
tree.links.new(outer.outputs[0], end.inputs[0])
before = compositor.movie(scene)
answer = [before, add(), compositor.movie(scene)]
movie("movie")
"""
    before, done, after = blender.run(code, blend=denoised)
    assert before == "Render Animation renders the noisy scene"
    assert (done, after) == (["FINISHED"], "Render Animation writes the denoised frames")
    assert mean(denoised.parent / "movie" / "0005.exr") == pytest.approx(expected, rel=1e-3)


def test_a_stereo_scene_is_told_that_the_movie_is_noisy(blender, denoised):
    code = f"""{MOVIE}
scene.render.use_multiview = True
answer = [said(), add(), compositor.movie(scene)]
"""
    said, refused, movie = blender.run(code, blend=denoised)
    assert [text.partition(":")[0] for text in said] == ["Stereo"]
    assert said[0] in refused
    assert "Render Animation renders the noisy scene" in said[0]
    assert movie == "Render Animation renders the noisy scene"


def test_another_frame_step_is_named_with_its_remedy(blender, rendered):
    code = f"{PROBLEMS}\nscene.frame_step = 2\nanswer = [problem.text for problem in scenes.problems(scene)]"
    (text,) = blender.run(code, blend=rendered)
    assert text.startswith("Frame Step is not 1: the Vector pass leads to frames that are missing")
    assert "set it to 1" in text


@pytest.mark.parametrize("noisy", ["//frames/shot_", "//frames/shot_####.png"])
def test_pictures_without_passes_are_refused_by_name(blender, stub, blend, noisy):
    (blend.parent / "frames").mkdir()
    for frame in (4, 5, 6):
        (blend.parent / "frames" / f"shot_{frame:04d}.png").write_bytes(b"\x89PNG\r\n\x1a\n")
    code = f"""{MOVIE}
scene.ravg.noisy = NOISY
answer = [said()[0]]
try:
    bpy.ops.ravg.denoise()
except RuntimeError as error:
    answer += [str(error)]
"""
    said, refused = blender.run(code, blend=blend, command=stub, NOISY=noisy)
    reason = "shot_0004.png is no noisy frame: ravg reads passes, which only OpenEXR MultiLayer files have"
    assert said.startswith(reason)
    assert reason in refused


def test_a_movie_that_would_mix_with_the_frames_is_named(blender, rendered):
    code = f"""{PROBLEMS}
answer = []
for scene.render.filepath in ("//frames/shot_", "//frames/denoised/x_", "//movie/shot_"):
    scene.render.image_settings.file_format = "PNG"
    answer += [texts()]
"""
    mixes = ["Output Path leads into the folder of ravg's frames"]
    assert blender.run(code, blend=rendered) == [mixes, mixes, []]


def test_persistent_data_renders_right_after_the_passes_were_set_up(blender: Blender, blend: Path):
    """Blender renders wrong images from kept data if the passes change, up to 15 % brighter."""
    code = f"""{MOVIE}
scene.frame_end, scene.render.use_persistent_data = 4, True
movie("before")
bpy.ops.ravg.set_up()
scene.cycles.use_denoising = scene.cycles.use_animated_seed = False
movie("after")
scene.view_layers[0].use_pass_z = True
scene.ravg.noisy = "//frames/"
scenes.override(scene, replace=True)
bpy.ops.render.render(animation=True)
answer = scene.render.use_persistent_data
"""
    assert blender.run(code, blend=blend) is True
    before, after = mean(blend.parent / "before" / "0004.exr"), mean(blend.parent / "after" / "0004.exr")
    assert after == pytest.approx(before, rel=1e-5)
    assert picture(blend.parent / "frames" / "0004.exr").mean() == pytest.approx(before, rel=1e-5)


def test_relative_paths_are_set_without_a_warning(blender, blend):
    code = """
    import warnings
    with warnings.catch_warnings(record=True) as caught:
        warnings.simplefilter("always")
        scene.ravg.noisy, scene.ravg.folder = "//frames/shot_", "//denoised"
    answer = [str(warning.message) for warning in caught]
    """
    assert blender.run(code, blend=blend) == []


def test_denoised_frames_are_replaced_only_where_that_was_chosen(blender, denoised, stub, tmp_path):
    """The stub stands for ravg, and writes down what it is asked for."""
    said = tmp_path / "said"
    tool = tmp_path / "ravg"
    tool.write_text(
        Path(stub).read_text(encoding="utf-8")
        + f"import sys\nopen({str(said)!r}, 'a').write(' '.join(sys.argv[1:]) + '\\n')\n"
    )
    tool.chmod(0o755)
    code = """
    def denoise(**how):
        try:
            return sorted(bpy.ops.ravg.denoise(**how))
        except RuntimeError as error:
            return str(error).strip()
    answer = [denoise(), denoise(existing="KEEP"), denoise(existing="REPLACE")]
    """
    refused, kept, replaced = blender.run(code, blend=denoised, command=str(tool))
    assert "denoised frames 4-6 are there already: choose existing='KEEP' or 'REPLACE'" in refused
    assert kept == replaced == ["FINISHED"]
    runs = [line for line in said.read_text(encoding="utf-8").splitlines() if line.startswith("denoise")]
    assert ["--resume" in run for run in runs] == [True, False]
