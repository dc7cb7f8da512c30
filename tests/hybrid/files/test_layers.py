"""Which channels are what, and what is refused because it could be several."""

from pathlib import Path

import numpy as np
import pytest

from flow import motion
from flow.motion import MotionConvention
from hybrid.files.exr import ExrError, ExrImage, read_exr
from hybrid.files.layers import describe_layers, find_layers
from hybrid.files.shots import open_matching_sequence, open_shot, output_path
from tests.exr_files import write_layers
from tests.hybrid.files.test_exr import CYCLES, cycles_names, planes, save, save_parts
from tests.seldom import seldom

SIZE = 4, 6


def headers(folder: Path, names: list[str], **attributes) -> ExrImage:
    return read_exr(save(folder / "a.exr", planes(names), **attributes), pixels=False)


def layer(value: float, count: int = 3) -> np.ndarray:
    return np.full((*SIZE, count), value, np.float32)


# --- what is found


def test_cycles_layers_are_found(tmp_path):
    layers = find_layers(read_exr(save(tmp_path / "a.exr", planes(cycles_names())), pixels=False))
    assert str(layers.color) == "ViewLayer.Combined.RGB"
    assert layers.target == layers.color
    assert str(layers.alpha) == "ViewLayer.Combined.A"
    assert str(layers.albedo) == "ViewLayer.Denoising Albedo.RGB"
    assert str(layers.normal) == "ViewLayer.Denoising Normal.XYZ"
    assert str(layers.depth) == "ViewLayer.Denoising Depth.Z"
    assert str(layers.motion) == "ViewLayer.Vector.XYZW"
    assert (layers.motion_convention, layers.variance, layers.estimate) == (motion.CYCLES, None, None)


def test_where_cycles_has_denoised_combined_is_the_estimate_and_is_replaced(tmp_path):
    names = cycles_names({**CYCLES, "Noisy Image": "RGBA"})
    layers = find_layers(read_exr(save(tmp_path / "a.exr", planes(names)), pixels=False))
    assert str(layers.color) == "ViewLayer.Noisy Image.RGB"
    assert str(layers.alpha) == "ViewLayer.Noisy Image.A"
    assert str(layers.estimate) == str(layers.target) == "ViewLayer.Combined.RGB"


@pytest.mark.parametrize(
    ("names", "color"),
    [
        ("Y", "Y"),
        ("Y A Z", "Y"),
        ("L", "L"),
        ("R", "R"),
        ("beauty.Y albedo.Y N.X N.Y N.Z", "beauty.Y"),
        ("ViewLayer.Combined.V ViewLayer.Depth.Z", "ViewLayer.Combined.V"),
    ],
)
def test_gray_is_a_color_of_one_channel(tmp_path, names, color):
    layers = find_layers(headers(tmp_path, names.split()))
    assert str(layers.color) == color
    assert layers.color.channels == (color,) * 3
    assert str(layers.albedo) == ("albedo.Y" if "albedo" in names else "None")


@pytest.mark.parametrize("names", ["Z", "A", "X Y Z", "N.X N.Y N.Z", "depth.Y", "Y RY BY"])
def test_a_map_is_no_gray_color(tmp_path, names):
    image = headers(tmp_path, names.split())
    with pytest.raises(ExrError, match="no color layer"):
        find_layers(image)
    assert find_layers(headers(tmp_path, ["mine.Y", "x.Z"]), {"color": "mine"}).color.channels == ("mine.Y",) * 3


@pytest.mark.parametrize("group", ["", "ViewLayer."])
def test_of_a_file_output_node_the_image_is_replaced(tmp_path, group):
    """The Noisy Image was, which nobody opens."""
    names = cycles_names({**CYCLES, "Image": "RGBA", "Noisy Image": "RGBA"}, group)
    names = [name for name in names if "Combined" not in name]
    layers = find_layers(headers(tmp_path, names))
    assert str(layers.color) == f"{group}Noisy Image.RGB"
    assert str(layers.estimate) == str(layers.target) == f"{group}Image.RGB"
    alone = find_layers(headers(tmp_path, [name for name in names if "Noisy" not in name]))
    assert str(alone.color) == str(alone.target) == f"{group}Image.RGB"
    with pytest.raises(ExrError, match=r"color can be .*Combined.RGB, .*Image.RGB"):
        find_layers(headers(tmp_path, cycles_names({**CYCLES, "Image": "RGBA"}, group)))


@pytest.mark.parametrize("end", [".main", "_main", "-main"])
def test_parts_that_are_named_after_the_only_view(tmp_path, end):
    parts = {f"rgba{end}": "RGBA", f"albedo{end}": "RGB", f"N{end}": "XYZ", f"depth{end}": "Z", f"motion{end}": "XY"}
    image = read_exr(save_parts(tmp_path / "a.exr", {n: planes([*c]) for n, c in parts.items()}), pixels=False)
    layers = find_layers(image)
    found = {role: str(getattr(layers, role)) for role in ("color", "albedo", "normal", "depth", "motion")}
    assert found == {
        "color": "rgba.RGB", "albedo": "albedo.RGB", "normal": "N.XYZ", "depth": "depth.Z", "motion": "motion.XY"
    }  # fmt: skip
    assert find_layers(image, {"color": f"rgba{end}"}).color == layers.color


@pytest.mark.parametrize("word", ["main", "v2", *seldom("MAIN", "left")])
@pytest.mark.parametrize("separator", "._- ")
@pytest.mark.parametrize("kind", ["parts", "qualified parts", "one part"])
def test_one_word_behind_the_names_of_all_layers(tmp_path, word, separator, kind):
    """Guides of such files were left out, in some spellings without a word."""
    layers = {
        f"{n}{separator}{word}": c for n, c in {"rgba": "RGBA", "albedo": "RGB", "N": "XYZ", "depth": "Z"}.items()
    }
    own = {n: planes([c if kind == "parts" else f"{n}.{c}" for c in channels]) for n, channels in layers.items()}
    one = {name: plane for part in own.values() for name, plane in part.items()}
    path = save(tmp_path / "a.exr", one) if kind == "one part" else save_parts(tmp_path / "a.exr", own)
    found = find_layers(read_exr(path, pixels=False))
    names = [getattr(found, role).name for role in ("color", "albedo", "normal", "depth", "alpha")]
    assert [name.split(separator)[0] for name in names] == ["rgba", "albedo", "N", "depth", "rgba"]
    assert found.notes == ()
    assert find_layers(read_exr(path, pixels=False), {"color": f"rgba{separator}{word}"}).color == found.color


def test_a_word_behind_all_names_that_names_a_layer_is_no_ending(tmp_path):
    """Two view layers with nothing but their pictures are two colors still."""
    image = headers(tmp_path, [f"{layer}.Combined.{c}" for layer in ("ViewLayer", "Second") for c in "RGBA"])
    with pytest.raises(ExrError, match="color can be"):
        find_layers(image)


def test_layers_that_look_like_guides_and_are_not_taken_are_named(tmp_path):
    """They were left unused without a word."""
    names = "R G B N_mine.X N_mine.Y N_mine.Z myAlbedo.R myAlbedo.G myAlbedo.B Z_mine.Z world_velocity.X albedo_mse.R"
    notes = find_layers(headers(tmp_path, names.split())).notes
    assert notes == (
        "myAlbedo.RGB is not used; if it is the albedo: --layer albedo=myAlbedo",
        "world_velocity.X is not used; if it is the motion: --layer motion=world_velocity",
    )
    names = "R G B A Z albedo.R albedo.G albedo.B second_albedo.R depth_mine.Z N.X N.Y N.Z normal_mine.X"
    assert find_layers(headers(tmp_path, names.split())).notes == ()
    assert find_layers(headers(tmp_path, cycles_names())).notes == ()


@pytest.mark.parametrize("qualified", [True, False])
def test_multi_part_file_has_the_same_names_as_single_part(tmp_path, qualified):
    single = read_exr(save(tmp_path / "a.exr", planes(cycles_names())), pixels=False)
    parts = {
        f"ViewLayer.{layer}": planes([f"ViewLayer.{layer}.{c}" if qualified else c for c in components])
        for layer, components in CYCLES.items()
    }
    multi = read_exr(save_parts(tmp_path / "b.exr", parts), pixels=False)
    assert sorted(multi.channel_names) == sorted(single.channel_names)
    for role in ("color", "albedo", "normal", "depth", "motion", "alpha"):
        assert str(getattr(find_layers(multi), role)) == str(getattr(find_layers(single), role))


@pytest.mark.parametrize(
    ("names", "expected"),
    [
        (
            ["color.R", "color.G", "color.B", "albedo.R", "albedo.G", "albedo.B", "normal.X", "normal.Y",
             "normal.Z", "depth.Z", "motion.X", "motion.Y", "variance.R", "variance.G", "variance.B"],
            {"color": "color.RGB", "albedo": "albedo.RGB", "normal": "normal.XYZ", "depth": "depth.Z",
             "motion": "motion.XY", "variance": "variance.RGB"},
        ),
        (
            ["R", "G", "B", "A", "Z", "N.X", "N.Y", "N.Z", "denoise_albedo.R", "denoise_albedo.G",
             "denoise_albedo.B", "variance.Y", "diffuse.R", "diffuse.G", "diffuse.B"],
            {"color": "RGB", "alpha": "A", "depth": "Z", "normal": "N.XYZ", "albedo": "denoise_albedo.RGB",
             "variance": "variance.Y"},
        ),
        (
            ["Ci.r", "Ci.g", "Ci.b", "Albedo.red", "Albedo.green", "Albedo.blue"],
            {"color": "Ci.rgb", "albedo": "Albedo.red,green,blue"},
        ),
    ],
    ids=["plain", "arnold", "other-letters"],
)  # fmt: skip
def test_other_names_are_found(tmp_path, names, expected):
    layers = find_layers(read_exr(save(tmp_path / "a.exr", planes(names)), pixels=False))
    roles = ("color", "albedo", "normal", "depth", "motion", "variance", "alpha", "estimate")
    found = {role: str(getattr(layers, role)) for role in roles if getattr(layers, role)}
    assert found == expected
    if "motion" in expected:
        assert layers.motion_convention == MotionConvention()


def test_unnamed_channels_of_other_parts_are_not_guessed_at(tmp_path):
    parts = {"beauty": planes(["R", "G", "B"]), "mask": planes(["Y"]), "spec": planes(["R", "G", "B"])}
    layers = find_layers(read_exr(save_parts(tmp_path / "a.exr", parts), pixels=False))
    assert str(layers.color) == "beauty.RGB"
    assert (layers.depth, layers.variance, layers.albedo) == (None, None, None)


def test_stereo_takes_the_default_view_and_overrides_any(tmp_path):
    names = [f"ViewLayer.{x}.{view}.{c}" for x in ("Combined", "Albedo") for view in "lr" for c in "RGB"]
    names = [name.replace(".l.", ".left.").replace(".r.", ".right.") for name in names]
    single = read_exr(save(tmp_path / "a.exr", planes(names), multiView=["right", "left"]), pixels=False)
    parts = {
        f"ViewLayer.{x}-{view}": planes([f"ViewLayer.{x}.{c}" for c in "RGB"])
        for view in ("right", "left")
        for x in ("Combined", "Albedo")
    }
    headers = {name: {"view": name.partition("-")[2]} for name in parts}
    multi = read_exr(save_parts(tmp_path / "b.exr", parts, headers), pixels=False)
    for image in (single, multi):
        layers = find_layers(image)
        assert (layers.view, layers.views) == ("right", ("right", "left"))
        assert layers.color.channels[0] == "ViewLayer.Combined.right.R"
        assert layers.albedo.channels[0] == "ViewLayer.Albedo.right.R"
        layers = find_layers(image, {"color": "Combined.left"})
        assert layers.view == "left"
        assert layers.albedo.channels[0] == "ViewLayer.Albedo.left.R"


@pytest.mark.parametrize("kept", ["", ".left"])
def test_names_of_the_default_view_may_leave_it_out(tmp_path, kept):
    """The standard leaves it out of R, G, B; Nuke of every layer."""
    names = [f"{x}{view}.{c}" for x in ("albedo", "diffuse") for view in (kept, ".right") for c in "RGB"]
    names += [*"RGBAZ", *(f"right.{c}" for c in "RGBA"), "mist.Z"]
    path = save(tmp_path / "a.exr", planes(names), multiView=["left", "right"])
    left, right = (view.layers(1) for view in open_shot(path, aovs=["all"]).views)
    assert (left.view, str(left.color), str(left.alpha), str(left.depth)) == ("left", "RGB", "A", "Z")
    assert (str(left.albedo), str(left.aovs["diffuse"])) == (f"albedo{kept}.RGB", f"diffuse{kept}.RGB")
    assert (right.view, str(right.color), str(right.alpha), right.depth) == ("right", "right.RGB", "right.A", None)
    assert (str(right.albedo), str(right.aovs["diffuse"])) == ("albedo.right.RGB", "diffuse.right.RGB")


def test_a_color_that_both_views_share_is_one_picture(tmp_path):
    """It was denoised twice, into the same channels."""
    names = [f"{x}.{c}" for x in ("color", "albedo.left", "albedo.right") for c in "RGB"]
    (one,) = open_shot(save(tmp_path / "a.exr", planes(names), multiView=["left", "right"])).views
    assert str(one.layers(1).albedo) == "albedo.left.RGB"


@pytest.mark.parametrize("left", ["", ".left"])
def test_named_layers_are_those_of_each_view(tmp_path, left):
    """The right eye had the guides of the left one, and wrote its own light passes over that one's."""
    names = [f"{x}{view}.{c}" for x in ("beauty", "mine", "key") for view in (left, ".right") for c in "RGB"]
    names += [f"far{view}.{c}" for view in (left, ".right") for c in "XZ"]
    path = save(tmp_path / "a.exr", planes(names), multiView=["left", "right"])
    layers = {"albedo": "mine", "depth": "far.Z" if not left else "far"}
    for view, end in zip(open_shot(path, layers=layers, aovs=["key"]).views, (left, ".right"), strict=True):
        found = view.layers(1)
        assert str(found.color) == f"beauty{end}.RGB"
        assert str(found.albedo) == f"mine{end}.RGB"
        assert found.depth.channels == (f"far{end}.Z",)
        assert str(found.aovs["key"]) == f"key{end}.RGB"
    for view in open_shot(path, layers={"albedo": "mine.right"}).views:
        assert str(view.layers(1).albedo) == "mine.right.RGB"


def test_a_layer_that_two_views_would_write_is_refused(tmp_path):
    names = [f"{view}.{x}.{c}" for view in ("Front", "Back") for x in ("Combined", "Albedo") for c in "RGB"]
    path = save(tmp_path / "a.exr", planes([*names, "key.R", "key.G", "key.B"]))
    with pytest.raises(ExrError, match=r"Back\.Combined\.RGB, Front\.Combined\.RGB would all write key\.B, expected"):
        _ = open_shot(path, aovs=["key"]).views
    assert len(open_shot(path, layers={"color": "Front.Combined"}, aovs=["key"]).views) == 1


def test_overrides_win_and_say_what_there_is(tmp_path):
    names = [*"RGBA", "RGBA_key.R", "RGBA_key.G", "RGBA_key.B", "m.u", "m.v", "P.X", "P.Y", "P.Z"]
    image = read_exr(save(tmp_path / "a.exr", planes(names)), pixels=False)
    layers = find_layers(image, {"color": "rgba_KEY", "motion": "m", "depth": "P.Z", "alpha": "A"})
    assert str(layers.color) == "RGBA_key.RGB"
    assert layers.motion.channels == ("m.u", "m.v")
    assert layers.motion_convention == MotionConvention()
    assert layers.depth.channels == ("P.Z",)
    assert layers.alpha.channels == ("A",)
    with pytest.raises(ExrError, match=r"no layer 'beauty'; it has RGBA, .*P\.XYZ, RGBA_key\.RGB, m\.uv"):
        find_layers(image, {"color": "beauty"})
    with pytest.raises(ExrError, match=r"m\.uv cannot be used as color: it needs channels R, G and B"):
        find_layers(image, {"color": "m"})
    with pytest.raises(ValueError, match="role 'colour' is unknown, expected one of color"):
        find_layers(image, {"colour": "m"})


def test_layer_by_the_end_of_its_name_must_be_the_only_one(tmp_path):
    image = read_exr(save(tmp_path / "a.exr", planes(["a.key.R", "b.key.R", "b.fill.R"])), pixels=False)
    assert image.layer("fill").name == "b.fill"
    with pytest.raises(ExrError, match=r"'key' is ambiguous: a\.key\.R, b\.key\.R"):
        image.layer("key")


def test_listing_is_shortened(tmp_path):
    image = read_exr(save(tmp_path / "a.exr", planes([f"l{i:03}.R" for i in range(100)])), pixels=False)
    with pytest.raises(ExrError, match="and 76 more") as caught:
        image.layer("x")
    assert len(str(caught.value)) < 400


def test_description_names_what_is_taken_and_what_is_missing(tmp_path):
    names = cycles_names({"Combined": "RGB", "Vector": "XYZW"})
    rows = describe_layers(find_layers(read_exr(save(tmp_path / "a.exr", planes(names)), pixels=False)))
    by_role = {role: rest for role, *rest in rows}
    assert by_role["color"] == ["ViewLayer.Combined.RGB", ""]
    assert by_role["motion"] == ["ViewLayer.Vector.XYZW", "convention: cycles,pixels,y-up"]
    assert by_role["albedo"][0] == "missing"
    assert all(note for _, taken, note in rows if taken == "missing")


# --- what could be several


def test_of_several_view_layers_none_is_guessed_at(tmp_path):
    """The alphabetically first was taken, which left the other noisy."""
    image = headers(tmp_path, cycles_names({"Combined": "RGBA"}, "Back.") + cycles_names(CYCLES, "Front."))
    with pytest.raises(ExrError, match=r"color can be Back\.Combined\.RGB, Front\.Combined\.RGB, expected one"):
        find_layers(image)
    assert find_layers(image, {"color": "Back.Combined"}).normal is None
    front = find_layers(image, {"color": "Front.Combined"})
    assert str(front.normal) == "Front.Denoising Normal.XYZ"


def test_one_view_layer_that_was_denoised_does_not_decide_between_two(tmp_path):
    names = cycles_names({"Combined": "RGBA"}, "Back.") + cycles_names({**CYCLES, "Noisy Image": "RGB"}, "Front.")
    with pytest.raises(ExrError, match=r"Back\.Combined\.RGB, Front\.Noisy Image\.RGB"):
        find_layers(headers(tmp_path, names))


def test_what_the_compositor_made_is_not_the_color_and_inspect_says_so(tmp_path):
    """It came first in the alphabet, was taken for the color, and all guides were missing."""
    layers = find_layers(headers(tmp_path, cycles_names({"Combined": "RGBA"}, "Composite.") + cycles_names()))
    assert str(layers.color) == str(layers.target) == "ViewLayer.Combined.RGB"
    assert str(layers.normal) == "ViewLayer.Denoising Normal.XYZ"
    assert layers.notes == ("Composite.Combined.RGB stays as it is: the compositor's",)
    assert ("color", "ViewLayer.Combined.RGB", layers.notes[0]) in describe_layers(layers)
    alone = find_layers(headers(tmp_path, cycles_names({"Combined": "RGBA"}, "Composite.")))
    assert (str(alone.color), alone.notes) == ("Composite.Combined.RGB", ())


@pytest.mark.parametrize(
    "names",
    [
        ["R", "G", "B", "beauty.R", "beauty.G", "beauty.B"],
        ["R", "G", "B", "key.color.R", "key.color.G", "key.color.B"],
        ["Beauty.R", "Beauty.G", "Beauty.B", "beauty.R", "beauty.G", "beauty.B"],
        [f"{group}.color.{c}" for group in ("key", "fill") for c in "RGB"],
        [*cycles_names(), "R", "G", "B"],
    ],
    ids=["bare and beauty", "bare and a light's", "case", "two lights'", "bare and Cycles"],
)
def test_two_colors_are_refused_where_nothing_says_whose_they_are(tmp_path, names):
    plain = [name.replace("Denoising ", "") for name in names]  # which would say that Cycles wrote them
    with pytest.raises(ExrError, match=r"color can be .*, .*, expected one \(--layer color=NAME\)"):
        find_layers(headers(tmp_path, plain))


def test_what_a_known_renderer_calls_its_color_goes_before_what_others_do(tmp_path):
    names = [*cycles_names(), *(f"ViewLayer.color.{c}" for c in "RGB")]
    assert str(find_layers(headers(tmp_path, names)).color) == "ViewLayer.Combined.RGB"


def test_guides_that_differ_by_case_alone_are_refused_and_one_can_be_named(tmp_path):
    names = [*"RGB", *(f"{name}.{c}" for name in ("Albedo", "albedo") for c in "RGB")]
    image = headers(tmp_path, names)
    with pytest.raises(ExrError, match=r"albedo can be Albedo\.RGB, albedo\.RGB"):
        find_layers(image)
    assert str(find_layers(image, {"albedo": "albedo"}).albedo) == "albedo.RGB"
    with pytest.raises(ExrError, match=r"'ALBEDO' is ambiguous"):
        image.layer("ALBEDO")


def test_the_guide_of_the_colors_own_view_layer_goes_before_one_of_none(tmp_path):
    names = [f"{layer}.{c}" for layer in ("ViewLayer.Combined", "ViewLayer.Albedo", "Albedo") for c in "RGB"]
    assert str(find_layers(headers(tmp_path, names)).albedo) == "ViewLayer.Albedo.RGB"


def test_a_layer_of_red_and_r_is_refused(tmp_path):
    with pytest.raises(ExrError, match=r"layer c\.\S+ has two channels for R"):
        find_layers(headers(tmp_path, ["c.R", "c.red", "c.G", "c.B"]))


def test_a_part_of_several_layers_is_no_name_for_one(tmp_path):
    parts = {"main": planes([f"{x}.{c}" for x in ("key", "fill") for c in "RGB"]), "other": planes(["Y"])}
    image = read_exr(save_parts(tmp_path / "a.exr", parts), pixels=False)
    with pytest.raises(ExrError, match=r"'main' is ambiguous: main\.fill\.RGB, main\.key\.RGB"):
        image.layer("main")


def test_layers_can_be_named_as_they_are_listed(tmp_path):
    image = headers(tmp_path, cycles_names())
    assert find_layers(image, {"color": "ViewLayer.Combined.RGBA"}).color == find_layers(image).color


def test_bare_depth_of_another_part_is_not_guessed_at(tmp_path):
    parts = {"beauty": planes(["R", "G", "B", "Z"]), "mask": planes(["Z"]), "fog": planes(["Z"])}
    layers = find_layers(read_exr(save_parts(tmp_path / "a.exr", parts), pixels=False))
    assert layers.depth.channels == ("beauty.Z",)
    del parts["beauty"]["Z"]
    assert find_layers(read_exr(save_parts(tmp_path / "a.exr", parts), pixels=False)).depth is None


def test_the_color_is_no_guide_for_itself(tmp_path):
    """Light divided by itself is 1 everywhere: the picture of it was."""
    image = headers(tmp_path, cycles_names())
    with pytest.raises(ExrError, match=r"Combined\.RGB is taken for both color and albedo"):
        find_layers(image, {"albedo": "Combined"})


def test_views_that_are_left_alone_are_named(tmp_path):
    names = [f"ViewLayer.Combined.{view}.{c}" for view in ("left", "right") for c in "RGB"]
    layers = find_layers(headers(tmp_path, names, multiView=["left", "right"]))
    assert layers.notes == ("view left is denoised; right stays as it is",)


# --- layers that are denoised along


@pytest.mark.parametrize("name", ["Combined", "combined", "ViewLayer.Combined", "ViewLayer.Combined.R", "Combined.A"])
def test_the_color_is_no_aov(tmp_path, name):
    """`--aov Combined` wrote the average of the noisy pictures over the denoised one."""
    image = headers(tmp_path, cycles_names())
    with pytest.raises(ExrError, match=r"aov '.*' is ViewLayer\.Combined.*, which is written as the color|no layer"):
        find_layers(image, aovs=[name])


def test_one_layer_is_one_aov(tmp_path):
    image = headers(tmp_path, cycles_names())
    with pytest.raises(ExrError, match=r"aov 'ViewLayer\.Normal' is .*, which is written as aov 'normal'"):
        find_layers(image, aovs=["normal", "ViewLayer.Normal"])
    with pytest.raises(ExrError, match="written as aov 'normal'"):
        find_layers(image, aovs=["normal", "ViewLayer.Normal.X"])


@pytest.mark.parametrize("role", ["color", "alpha"])
def test_an_aov_that_is_called_like_what_is_written_needs_its_whole_name(tmp_path, role):
    """These are the names of written layers; an AOV of that name took the picture's place."""
    image = headers(tmp_path, [*cycles_names(), f"light.{role}.R", f"light.{role}.G", f"light.{role}.B"])
    with pytest.raises(ExrError, match=rf"aov '{role}' is also a role, expected the whole name: light\.{role}\.RGB"):
        find_layers(image, aovs=[role])
    assert str(find_layers(image, aovs=[f"light.{role}"]).aovs[f"light.{role}"]) == f"light.{role}.RGB"


def test_all_is_every_layer_with_a_name_for_a_part_of_the_light(tmp_path):
    lights = ["DiffDir", "DiffInd", "GlossDir", "TransInd", "VolumeDir", "Emit", "Env", "Combined_key"]
    others = ["DiffCol", "GlossCol", "AO", "Shadow", "Mist", "UV"]
    names = [*cycles_names(), *(f"ViewLayer.{name}.{c}" for name in (*lights, *others) for c in "RGB")]
    layers = find_layers(headers(tmp_path, names), aovs=["all", "AO"])
    assert list(layers.aovs) == [*sorted(f"ViewLayer.{name}" for name in lights), "AO"]
    tinted = {"ViewLayer.DiffDir": "DiffCol", "ViewLayer.DiffInd": "DiffCol", "ViewLayer.GlossDir": "GlossCol"}
    assert {name: tint.name for name, tint in layers.pass_colors.items()} == {
        name: f"ViewLayer.{tint}" for name, tint in tinted.items()
    }


def test_all_takes_sums_of_parts_too_but_no_denoised_picture(tmp_path):
    """Arnold's diffuse is the sum of diffuse_direct and diffuse_indirect; its alpha stays, and so does RGBA_denoise."""
    parts = ["diffuse_direct", "diffuse_indirect", "specular", "emission"]
    names = [*"RGBA", *(f"{name}.{c}" for name in (*parts, "diffuse", "RGBA_key", "RGBA_denoise") for c in "RGBA")]
    layers = find_layers(headers(tmp_path, names), aovs=["all"])
    assert {*layers.aovs} == {*parts, "diffuse", "RGBA_key"}
    assert {len(layer.channels) for layer in layers.aovs.values()} == {3}
    with pytest.raises(ExrError, match="aov all: no layer has a name for a part of the light"):
        find_layers(headers(tmp_path, cycles_names()), aovs=["all"])


def test_identifiers_are_not_averaged(tmp_path):
    names = [*cycles_names(), *(f"ViewLayer.CryptoObject00.{c}" for c in "RGBA")]
    image = headers(tmp_path, names, **{"cryptomatte/3fa1c/name": "ViewLayer.CryptoObject"})
    with pytest.raises(ExrError, match="a cryptomatte, of which averages mean nothing"):
        find_layers(image, aovs=["CryptoObject00"])
    channels = planes(cycles_names()) | planes(["id.Y"], kind="u4")
    save(tmp_path / "b.0001.exr", channels)
    with pytest.raises(ExrError, match=r"aov 'id' is id\.Y, whole numbers"):
        open_shot(tmp_path / "b.####.exr", aovs=["id"]).read(1)


def test_an_aov_is_written_where_it_was_read(tmp_path):
    """`--aov normal` was read from Normal, and written over Denoising Normal."""
    layers = {"ViewLayer.Combined": layer(1), "ViewLayer.Denoising Normal": layer(2), "ViewLayer.Normal": layer(3)}
    write_layers(tmp_path / "a.0001.exr", layers)
    shot = open_shot(tmp_path, aovs=["normal"])
    assert (shot.read(1).aovs["normal"] == 3).all()
    shot.write(tmp_path / "out.exr", 1, {"color": layer(5), "normal": layer(6)})
    image = read_exr(tmp_path / "out.exr")
    values = {str(x): image.channel(x.channels[0])[0, 0] for x in image.layers}
    assert values == {"ViewLayer.Combined.RGB": 5, "ViewLayer.Denoising Normal.XYZ": 2, "ViewLayer.Normal.XYZ": 6}


def test_a_layer_that_is_there_is_not_taken_for_a_new_one(tmp_path):
    """A weight map of the user's was overwritten by ours."""
    write_layers(tmp_path / "a.0001.exr", {"color": layer(1), "weight.centre": layer(7, 1)})
    shot = open_shot(tmp_path)
    with pytest.raises(ExrError, match=r"'weight\.centre\.Y' is to be added, and is there already"):
        shot.write(tmp_path / "out.exr", 1, {"color": layer(2)}, {"weight.centre": layer(0.5, 1)[..., 0]})
    assert not (tmp_path / "out.exr").exists()


# --- one shot, one choice


def test_frames_whose_color_is_another_layer_are_refused(tmp_path):
    """Frames without a Noisy Image were denoised a second time, as if they were noisy."""
    noisy = {"ViewLayer.Noisy Image": layer(1), "ViewLayer.Combined": layer(2)}
    for number in (1, 2):
        write_layers(tmp_path / f"a.{number:04d}.exr", noisy)
    write_layers(tmp_path / "a.0003.exr", {"ViewLayer.Combined": layer(2)})
    shot = open_shot(tmp_path)
    assert (shot.read(2).color == 1).all()
    with pytest.raises(ExrError, match=r"a\.0003\.exr: color is ViewLayer\.Combined\.RGB, that of frame 1 is .*Noisy"):
        shot.read(3)


def test_a_guide_may_be_missing_but_not_be_another_layer(tmp_path):
    both = {"ViewLayer.Combined": layer(1), "ViewLayer.Normal": layer(2), "ViewLayer.Denoising Normal": layer(3)}
    for number, without in enumerate(["", "Denoising", "Normal"], 1):
        layers = {name: array for name, array in both.items() if not without or without not in name}
        write_layers(tmp_path / f"a.{number:04d}.exr", layers)
    shot = open_shot(tmp_path)
    assert shot.read(3).normal is None
    with pytest.raises(ExrError, match=r"normal is ViewLayer\.Normal\.XYZ, that of frame 1 is ViewLayer\.Denoising"):
        shot.read(2)


def test_what_was_written_is_read_back_from_where_it_was_written(tmp_path):
    """The preview, and estimates that are kept, showed the first view layer, whichever had been denoised."""
    layers = {f"{view}.Combined": layer(value) for view, value in (("Back", 1), ("Front", 2))}
    (tmp_path / "in").mkdir()
    for number in (1, 2):
        write_layers(tmp_path / "in" / f"a.{number:04d}.exr", layers)
    shot = open_shot(tmp_path / "in", layers={"color": "Front.Combined"})
    path = output_path(tmp_path / "a.####.exr", shot, 2)
    shot.write(path, 2, {"color": layer(9)})
    assert (shot.reopened({2: path}).read(2).color == 9).all()


def test_another_sequence_follows_the_choice_made_for_the_shot(tmp_path):
    layers = {f"{view}.Combined": layer(value) for view, value in (("Back", 1), ("Front", 2))}
    write_layers(tmp_path / "a.0001.exr", layers)
    write_layers(tmp_path / "b.0001.exr", layers)
    write_layers(tmp_path / "c.0001.exr", {"": layer(7)})
    shot = open_shot(tmp_path / "a.0001.exr", layers={"color": "Front.Combined"})
    assert (open_matching_sequence(tmp_path / "b.0001.exr", shot).read(1).color == 2).all()
    assert (open_matching_sequence(tmp_path / "c.0001.exr", shot).read(1).color == 7).all()
