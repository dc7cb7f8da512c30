"""Profiles: what each renderer's files are known by, and what is refused."""

from dataclasses import replace
from pathlib import Path

import numpy as np
import OpenEXR
import pytest

from flow.motion import CYCLES, MotionConvention
from hybrid.files import profile as profiles
from hybrid.files.exr import ExrError, ExrImage, read_exr
from hybrid.files.layers import Layers, find_layers, summarize_layers
from hybrid.files.profile import (
    ROLES,
    find_profile,
    open_profile,
    parse_motion,
    plain_name,
    read_profile,
    read_profiles,
    user_folder,
)


def image(folder: Path, channels: str, **attributes: str) -> ExrImage:
    """A file with channels such as ``RGBA N.XYZ depth``: those of one letter stand in one word."""
    names: list[str] = []
    for word in channels.split():
        layer, dot, components = word.rpartition(".")
        letters = components.upper() in ("RGB", "RGBA", "XYZ", "XYZW", "XY", "UV", "RG")
        names += [f"{layer}{dot}{c}" for c in (components if letters else [components])]
    header = {"compression": OpenEXR.ZIP_COMPRESSION, "type": OpenEXR.scanlineimage}
    header |= {name.replace("__", "/"): value for name, value in attributes.items()}
    pixels = {name: np.zeros((4, 6), np.float32) for name in names}
    path = folder / "a.exr"
    OpenEXR.File([OpenEXR.Part(header, pixels, "")]).write(str(path))
    return read_exr(path, pixels=False)


def taken(layers: Layers) -> dict[str, str]:
    return {role: str(getattr(layers, role)) for role in ROLES if getattr(layers, role) is not None}


# Files as each renderer writes them by default are in tests/renderers.py.
@pytest.mark.parametrize(
    ("profile", "channels", "attributes", "expected"),
    [
        (
            "Cycles", "V.Combined.RGBA V.Vector.XYZW V.Depth.Z", {"BlenderMultiChannel": "Blender"},
            {"color": "V.Combined.RGB", "alpha": "V.Combined.A", "motion": "V.Vector.XYZW", "depth": "V.Depth.Z"},
        ),
        (
            "V-Ray", "RGBA VRayDiffuseFilter.RGB VRayNormals.RGB VRayZDepth.Z VRayVelocity.RGB", {},
            {"color": "RGB", "alpha": "A", "albedo": "VRayDiffuseFilter.RGB", "normal": "VRayNormals.RGB",
             "depth": "VRayZDepth.Z", "motion": "VRayVelocity.RGB"},
        ),
        (
            "pbrt", "RGB Albedo.RGB N.XYZ Ns.XYZ Variance.RGB RelativeVariance.RGB", {},
            {"color": "RGB", "albedo": "Albedo.RGB", "normal": "Ns.XYZ", "variance": "Variance.RGB"},
        ),
        (
            "Unreal", "FinalImage.RGBA FinalImageMovieRenderQueue_WorldDepth.R", {},
            {"color": "FinalImage.RGB", "alpha": "FinalImage.A", "depth": "FinalImageMovieRenderQueue_WorldDepth.R"},
        ),
        (
            "Arnold", "RGB denoise_albedo_noice.RGB N_noice.XYZ Z_noice motionvector.RG", {"arnold__version": "7"},
            {"color": "RGB", "albedo": "denoise_albedo_noice.RGB", "normal": "N_noice.XYZ", "depth": "Z_noice",
             "motion": "motionvector.RG"},
        ),
        (
            "Arnold", "RGB N_noice.XYZ Z_noice.R", {},
            {"color": "RGB", "normal": "N_noice.XYZ", "depth": "Z_noice.R"},
        ),
        (
            "Karma", "RGBA denoise_albedo.RGB N_denoise.RGB Z_denoise", {"husk:render_time": "1"},
            {"color": "RGB", "alpha": "A", "albedo": "denoise_albedo.RGB", "normal": "N_denoise.RGB",
             "depth": "Z_denoise"},
        ),
        (
            "Octane", "RGBA DifF.RGB ShN.XYZ MV.RGB Z", {},
            {"color": "RGB", "alpha": "A", "albedo": "DifF.RGB", "normal": "ShN.XYZ", "motion": "MV.RGB", "depth": "Z"},
        ),
        (
            "common names", "color.RGB albedo.RGB motion.XY", {},
            {"color": "color.RGB", "albedo": "albedo.RGB", "motion": "motion.XY"},
        ),
    ],
    ids=lambda value: value if isinstance(value, str) and len(value) < 15 else "",
)  # fmt: skip
def test_further_files_of_renderers_are_known(tmp_path, profile, channels, attributes, expected):
    layers = find_layers(image(tmp_path, channels, **attributes))
    assert layers.profile == profile
    assert taken(layers) == expected


def test_the_reason_names_the_attribute_or_the_layer(tmp_path):
    assert find_profile(image(tmp_path, "RGBA", arnold__version="7")).why == "header attribute arnold/version"
    assert find_profile(image(tmp_path, "RGBA RelativeVariance.RGB")).why == "layer RelativeVariance"
    assert find_profile(image(tmp_path, "RGBA")).why == "no renderer is known by its header or its layers"


def test_an_attribute_counts_more_than_a_layer(tmp_path):
    assert find_profile(image(tmp_path, "RGBA MotionVectors.RG DiffuseFilter.RGB", vrayInfo__w="8")).name == "V-Ray"


NEVER_OPEN = {"offset", "premultiplied"}


def test_what_is_documented_is_settled_and_the_rest_is_to_be_measured(tmp_path):
    cycles = find_layers(image(tmp_path, "V.Combined.RGB V.Vector.XYZW V.Noisy_Image.RGB"))
    assert cycles.motion_convention == CYCLES
    arnold = find_layers(image(tmp_path, "RGBA motionvector.RG", arnold__version="7"))
    assert arnold.motion_convention == MotionConvention("next")
    assert arnold.settled == {"direction", *NEVER_OPEN}
    appleseed = find_layers(image(tmp_path, "RGBA screen_space_velocity.RGB"))
    assert appleseed.motion_convention == MotionConvention("next", "ndc", encoding="magnitude")
    assert appleseed.settled == {"direction", "unit", "encoding", *NEVER_OPEN}
    octane = find_layers(image(tmp_path, "Beauty.RGB Motion_vector.RG"))
    assert octane.motion_convention == MotionConvention("next", "screen", "up")
    assert octane.settled == NEVER_OPEN
    moonray = find_layers(image(tmp_path, "RGBA motionvec.XY"))
    assert moonray.motion_convention == MotionConvention(unit="half-ndc", premultiplied=True)


def test_of_vectors_to_both_neighbours_one_layer_is_enough(tmp_path):
    both = find_layers(image(tmp_path, "RGBA forward.uv backward.uv"))
    assert both.motion_convention.direction == "both"
    back = find_layers(image(tmp_path, "RGBA backward.uv"))
    assert back.motion_convention.direction == "previous"
    assert taken(back)["motion"] == "backward.uv"
    forth = find_layers(image(tmp_path, "RGBA forward.uv"))
    assert forth.motion_convention.direction == "next"
    assert taken(forth)["motion"] == "forward.uv"
    assert forth.motion_next is None


def test_the_variance_of_samples_becomes_that_of_a_pixel_where_their_number_is_known(tmp_path):
    channels = "RGB Variance.RGB RelativeVariance.RGB"
    assert find_layers(image(tmp_path, channels)).variance_scale is None
    counted = image(tmp_path, channels)
    counted.parts[0].header["samplesPerPixel"] = 64
    assert find_layers(counted).variance_scale == 1 / 64
    counted.parts[0].header["samplesPerPixel"] = "many"
    assert find_layers(counted).variance_scale is None
    mean = replace(open_profile("pbrt"), variance="mean", samples=None)
    assert find_layers(counted, profile=mean).variance_scale == 1


def test_the_only_picture_is_the_color_and_of_several_none_is(tmp_path):
    assert str(find_layers(image(tmp_path, "render.RGBA spec.RGB albedo.RGB")).color) == "render.RGB"
    assert str(find_layers(image(tmp_path, "render.RGB albedo.RGB N.XYZ")).color) == "render.RGB"
    with pytest.raises(ExrError, match="no color layer"):
        find_layers(image(tmp_path, "one.RGBA two.RGBA"))
    with pytest.raises(ExrError, match="no color layer"):
        find_layers(image(tmp_path, "mse.RGB albedo.RGB"))


def test_names_are_compared_without_case_blanks_and_underscores():
    assert plain_name("Diffuse_Filter") == plain_name("diffuse filter") == plain_name("DiffuseFilter")


def test_a_users_profile_is_found_by_itself_and_goes_before_those_that_come_with_ravg(tmp_path, monkeypatch):
    monkeypatch.setattr(profiles, "user_folder", lambda: tmp_path / "profiles")
    read_profiles.cache_clear()
    try:
        (tmp_path / "profiles").mkdir()
        (tmp_path / "profiles" / "studio.toml").write_text(
            'name = "Studio"\n[found]\nattributes = ["studio/*"]\nlayers = ["motionvec"]\n'
            '[layers]\ncolor = ["main"]\nmotion = ["flow"]\n[motion]\ndirection = "next"\nunit = "ndc"\n'
        )
        layers = find_layers(image(tmp_path, "main.RGB flow.XY RGBA", studio__show="x"))
        assert (layers.profile, str(layers.color)) == ("Studio", "main.RGB")
        assert layers.motion_convention == MotionConvention("next", "ndc")
        # As good a match as MoonRay's.
        assert find_profile(image(tmp_path, "RGBA motionvec.XY albedo.RGB")).name == "MoonRay"
        assert open_profile("studio").name == "Studio"
    finally:
        read_profiles.cache_clear()


def test_the_users_folder_is_the_usual_one(monkeypatch):
    monkeypatch.setenv("XDG_CONFIG_HOME", "/elsewhere")
    assert user_folder().parts[-2:] == ("ravg", "profiles")


@pytest.mark.parametrize(
    ("text", "message"),
    [
        ("name = ", "not a profile"),
        ("name = " + 20000 * "[", "not a profile"),
        ("colour = 1", "profile has 'colour', expected some of name, found, layers"),
        ("layers = 3", r"layers is 3, expected a table, \[layers\]"),
        ('[layers]\ncolour = ["a"]', r"\[layers\] has 'colour', expected some of affixes, color"),
        ('[layers]\ncolor = "a"', "color is 'a', expected a list of names"),
        ('[found]\nchannels = ["a"]', r"\[found\] has 'channels', expected some of attributes, layers"),
        ('[motion]\ndirection = "up"', "direction of motion is 'up', expected one of previous"),
        ("[motion]\nlength = 2", r"\[motion\] has 'length', expected some of assumed, direction"),
        ("[motion]\nscale = true", "scale of motion is True, expected a number"),
        ('[variance]\nof = "pixel"', "variance is of 'pixel', expected one of mean, sample"),
    ],
)
def test_what_is_no_profile_is_refused_in_one_line(tmp_path, text, message):
    path = tmp_path / "mine.toml"
    path.write_text(text)
    with pytest.raises(ValueError, match=message) as caught:
        read_profile(path)
    assert str(caught.value).startswith(f"{path}: ")
    assert "\n" not in str(caught.value)


def test_a_profile_is_asked_for_by_name_or_by_file(tmp_path):
    (tmp_path / "mine.toml").write_text('[layers]\ncolor = ["x"]\n')
    mine = open_profile(str(tmp_path / "mine.toml"))
    assert (mine.name, mine.why) == ("mine", "asked for")
    assert open_profile("arnold").name == "Arnold"
    with pytest.raises(ValueError, match=r"profile is 'maya', expected a file, or one of 3delight, appleseed, arnold"):
        open_profile("maya")


def test_motion_is_said_in_words():
    assert parse_motion("next, ndc,y-up,scale=2,offset=-0.5,gray") == {
        "direction": "next", "unit": "ndc", "y": "up", "scale": 2.0, "offset": -0.5, "encoding": "gray",
    }  # fmt: skip
    assert parse_motion("") == {}
    with pytest.raises(ValueError, match="motion has 'forward', expected some of previous, next, both"):
        parse_motion("forward")
    with pytest.raises(ValueError, match="motion has 'scale=x'"):
        parse_motion("scale=x")
    with pytest.raises(ValueError, match="motion says its unit twice"):
        parse_motion("ndc,pixels")
    with pytest.raises(ValueError, match="scale of motion is 0"):
        parse_motion("scale=0")


def test_what_is_multiplied_by_alpha_is_said_in_a_word():
    assert parse_motion("next,premultiplied") == {"direction": "next", "premultiplied": True}
    assert str(MotionConvention(premultiplied=True)) == "previous,pixels,y-down,premultiplied"
    with pytest.raises(ValueError, match="premultiplied of motion is 1, expected true or false"):
        MotionConvention(premultiplied=1)


def test_what_the_user_says_of_motion_goes_before_the_profile():
    arnold = open_profile("arnold")
    told = arnold.with_motion("previous,y-up")
    assert told.convention(2) == MotionConvention("previous", y="up")
    assert told.settled == {"direction", "y", *NEVER_OPEN}
    measured = open_profile("cycles").with_motion("auto")
    assert measured.convention(4) == CYCLES
    assert measured.settled == NEVER_OPEN


def test_one_line_says_what_was_taken(tmp_path):
    layers = find_layers(image(tmp_path, "RGBA motionvector.RG Z", arnold__version="7"))
    said = "Arnold (header attribute arnold/version): color RGB, depth Z, motion motionvector.RG, alpha A"
    assert summarize_layers(layers) == said
    left = layers.without({"motion", "alpha"})
    assert (left.motion, left.motion_convention, left.alpha) == (None, None, None)
    assert str(left.depth) == "Z"


def test_an_attribute_may_be_asked_for_with_its_value(tmp_path):
    assert find_profile(image(tmp_path, "RGBA", generatedBy="Mitsuba version 3.9.1")).name == "Mitsuba"
    assert find_profile(image(tmp_path, "RGBA", generatedBy="something else")).name == "common names"


DOCUMENT = (Path(__file__).parents[3] / "docs" / "renderers.md").read_text(encoding="utf-8")


def test_the_profile_of_the_documentation_is_one(tmp_path):
    path = tmp_path / "studio.toml"
    path.write_text(DOCUMENT.partition("```toml\n")[2].partition("```")[0], encoding="utf-8")
    profile = read_profile(path)
    assert (profile.name, profile.samples, profile.files) == ("Studio", "studio/spp", {"variance": "{name}_stats"})
    assert profile.settled == {"unit", "y", *NEVER_OPEN}


@pytest.mark.parametrize("name", sorted(set(read_profiles()) - {"common"}))
def test_every_renderer_is_documented(name):
    assert f"| {read_profiles()[name].name.replace('Cycles', 'Blender Cycles').replace('pbrt', 'pbrt-v4')}" in DOCUMENT
