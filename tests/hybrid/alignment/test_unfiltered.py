"""Suns beyond half, negative light of wide gamuts and gray pictures come out as they were rendered."""

from dataclasses import replace
from pathlib import Path

import cv2
import numpy as np
import OpenEXR
import pytest

from hybrid.alignment.prepare import prepare
from hybrid.alignment.unfiltered import find_region, mirror_region, split_unfiltered
from hybrid.cli import main
from hybrid.denoising.first_pass import PerFrame
from hybrid.denoising.plan import Rules
from hybrid.denoising.pseudo_reference import gated_average
from hybrid.denoising.stabilize import Denoised, FrameDenoiser
from hybrid.denoising.stream import FrameStream
from hybrid.files.exr import HALF_MAX, read_exr
from hybrid.files.frame import Frame
from hybrid.files.shots import open_shot
from tests.exr_files import write_layers
from tests.scenes import Function, Scene

SIZE = (40, 56)
COMMANDS = [["denoise", "--preset", "draft"], ["denoise", "--preset", "balanced"]]
BLOCK = slice(12, 28), slice(16, 36)


def colors() -> list[np.ndarray]:
    """Three still frames of 0.5 under gamma-distributed noise."""
    rng = np.random.default_rng(3)
    return [np.repeat(rng.gamma(16, 0.5 / 16, (*SIZE, 1)), 3, axis=2).astype(np.float32) for _ in range(3)]


def denoised(folder: Path, frames: list[np.ndarray], command: list[str], name: str = "color", half: bool = True) -> str:
    """Run a command on frames; what it has said is left to the caller's capture."""
    (folder / "in").mkdir()
    for number, color in enumerate(frames):
        albedo = np.full((*SIZE, 3), 0.5, np.float32)
        albedo[BLOCK] = 0.8
        layers = {name: color, "albedo": albedo, "motion": np.zeros((*SIZE, 4), np.float32)}
        write_layers(folder / "in" / f"a.{number:04d}.exr", layers, half=half)
    if command[0] == "denoise":
        pytest.importorskip("torch")
    assert main([command[0], str(folder / "in"), "-o", str(folder / "out"), *command[1:]]) == 0
    return str(folder / "out" / "a.0001.exr")


@pytest.mark.parametrize("command", COMMANDS)
def test_a_sun_of_inf_becomes_the_largest_half(tmp_path, capsys, command):
    """It was filled in from its surroundings like NaN."""
    y, x = np.mgrid[: SIZE[0], : SIZE[1]]
    sun = (y - 20) ** 2 + (x - 28) ** 2 < 20
    frames = colors()
    for frame in frames:
        frame[sun] = np.inf
        frame[5, 5], frame[30, 9] = np.inf, np.nan  # a firefly, and a lost pixel
        frame[20, 28, 2] = 900
    found = read_exr(denoised(tmp_path, frames, command)).pixels(("color.R", "color.G", "color.B"))
    assert (found[sun][:, :2] == HALF_MAX).all()
    assert found[20, 28, 2] == 900
    assert found[~sun].max() < 1  # and it does not shine over the rest
    values = 3 * np.count_nonzero(sun) - 1
    said = " ".join(capsys.readouterr().err.split())
    assert f"frame 1: {values} values too large for half, written as 65504" in said
    assert "frame 1: 2 pixels were not finite or beyond 1e14, filled in" in said


def test_inf_of_floats_and_other_infinities_are_lost(tmp_path):
    color = colors()[0]
    color[10:20, 10:20] = np.inf
    write_layers(tmp_path / "a.0001.exr", {"color": color}, half=False)
    frame = open_shot(tmp_path).read(1)
    assert frame.beyond is None
    assert np.isnan(frame.color[12, 12]).all()
    beyond = np.zeros((*SIZE, 3), bool)
    beyond[10:20, 10:20] = True
    color[beyond] = np.nan
    prepared = prepare(Frame(1, color, beyond=beyond))
    assert (prepared.repaired, prepared.unfiltered.count, int((~prepared.valid).sum())) == (0, 300, 100)
    lost = beyond.copy()
    lost[..., 0] = False  # red is NaN in the file itself
    prepared = prepare(Frame(1, color, beyond=lost))
    assert (prepared.repaired, prepared.unfiltered.count) == (100, 0)


@pytest.mark.parametrize("command", COMMANDS)
@pytest.mark.parametrize("scale", [1.0, 64.0])
def test_negative_light_of_a_wide_gamut_is_kept_in_the_mean(tmp_path, command, scale):
    """It was cut off at 0."""
    frames = [frame * np.float32(scale) for frame in colors()]
    for frame in frames:
        frame[BLOCK][..., 0] *= -0.125
    found = read_exr(denoised(tmp_path, frames, command, half=False)).pixels(("color.R", "color.G", "color.B"))
    inner = found[15:25, 19:33]
    assert inner[..., 0].mean() == pytest.approx(-0.0625 * scale, rel=0.05)
    assert inner[..., 1].mean() == pytest.approx(0.5 * scale, rel=0.05)
    outside = np.delete(found[..., 0], np.s_[9:31], axis=0)
    assert outside.min() > 0.4 * scale


def test_what_a_filter_leaves_beside_a_lamp_is_no_color():
    """Negative in all channels: spread over its surroundings it would darken them."""
    color = colors()[0]
    color[20, 20] = -30, -40, -20
    color[30, 30] = -30, 0.25, -0.125
    left, unfiltered = split_unfiltered(Frame(1, color))
    negative = unfiltered.negative["color"]
    assert np.count_nonzero(negative) == 2
    np.testing.assert_array_equal(negative[30, 30], [-0.25, 0, -0.125])
    np.testing.assert_array_equal(left + negative, color)
    assert split_unfiltered(Frame(1, np.abs(color)))[1].negative == {}


def test_parts_keep_their_negative_light(tmp_path):
    """The parts of a beauty of -0.05 came out at 0."""
    pytest.importorskip("torch")
    (tmp_path / "in").mkdir()
    for number, color in enumerate(colors()):
        color[BLOCK][..., 0] *= -0.125
        layers = {"RGBA": color, "RGBA_key": color * np.float32(0.25), "RGBA_fill": color * np.float32(0.75)}
        write_layers(tmp_path / "in" / f"a.{number:04d}.exr", layers, half=False)
    assert main(["denoise", str(tmp_path / "in"), "-o", str(tmp_path / "out"), "--aov", "all"]) == 0
    image = read_exr(tmp_path / "out" / "a.0001.exr")
    for name, mean in (("RGBA", -0.0625), ("RGBA_key", -0.015625), ("RGBA_fill", -0.046875)):
        assert image.channel(f"{name}.R")[15:25, 19:33].mean() == pytest.approx(mean, rel=0.06)


@pytest.mark.parametrize("command", COMMANDS)
def test_gray_stays_gray(tmp_path, command):
    """Networks that learned from colors tinted it by half a percent."""
    found = read_exr(denoised(tmp_path, colors(), command, half=False)).pixels(("color.R", "color.G", "color.B"))
    np.testing.assert_array_equal(found, np.repeat(found[..., :1], 3, axis=2))
    assert found.mean() == pytest.approx(0.5, rel=0.02)


def test_both_views_of_a_gray_stereo_file_are_denoised(tmp_path):
    """The right one stayed as it was."""
    for number, (left, right) in enumerate(zip(colors(), colors()[::-1], strict=True)):
        header = {"compression": OpenEXR.ZIP_COMPRESSION, "type": OpenEXR.scanlineimage, "multiView": ["left", "right"]}
        channels = {"left.Y": left[..., 0].copy(), "right.Y": right[..., 0].copy()}
        OpenEXR.File([OpenEXR.Part(header, channels, "")]).write(str(tmp_path / f"a.{number:04d}.exr"))
    assert main(["denoise", str(tmp_path), "-o", str(tmp_path / "out"), "--preset", "draft"]) == 0
    before, after = (read_exr(folder / "a.0001.exr") for folder in (tmp_path, tmp_path / "out"))
    for name in ("left.Y", "right.Y"):
        assert after.channel(name).std() < 0.95 * before.channel(name).std()


def test_of_layers_only_those_that_are_gray_everywhere_count():
    color = colors()[0]
    color[3, 4] = np.nan
    tinted = color.copy()
    tinted[20, 20, 1] *= 1.01
    frame = Frame(1, color, aovs={"tinted": tinted, "gray": color * 2, "one": color[..., :1]})
    assert split_unfiltered(frame)[1].gray == {"color", "gray"}
    assert split_unfiltered(replace(frame, color=tinted))[1].gray == {"gray"}


@pytest.mark.parametrize("command", COMMANDS)
@pytest.mark.parametrize("name", ["", "beauty", "ViewLayer.Combined"])
def test_a_file_of_luminance_alone_is_denoised(tmp_path, command, name):
    """The error proposed a layer that was refused."""
    frames = [frame[..., 0] for frame in colors()]
    image = read_exr(denoised(tmp_path, frames, command, name=name))
    channel = f"{name}.Y" if name else "Y"
    assert [n for n in image.channel_names if n.endswith("Y") and "motion" not in n] == [channel]
    found = image.channel(channel).astype(float)
    assert found.mean() == pytest.approx(0.5, rel=0.02)
    assert found.std() < 0.5 * frames[1].std()


class TestRegion:
    """Beside a render region a frame is black, and no pixel of the region is mixed with that."""

    @staticmethod
    def cut(color, rows, columns):
        inside = np.zeros_like(color)
        inside[rows, columns] = color[rows, columns]
        return inside

    @pytest.mark.parametrize(
        ("rows", "columns"),
        [
            (slice(8, 30), slice(12, 40)),
            (slice(0, 40), slice(12, 56)),
            (slice(0, 25), slice(0, 56)),
            (slice(20, 40), slice(36, 56)),
        ],
    )
    def test_a_region_is_found_and_mirrored(self, rows, columns):
        color = np.random.default_rng(1).uniform(0.1, 1, (40, 56, 3)).astype(np.float32)
        region = find_region(self.cut(color, rows, columns))
        assert region == (rows, columns)
        frame = mirror_region(Frame(1, self.cut(color, rows, columns), normal=self.cut(color, rows, columns)), region)
        np.testing.assert_array_equal(frame.color[rows, columns], color[rows, columns])
        np.testing.assert_array_equal(frame.color, frame.normal)
        if columns.start:
            np.testing.assert_array_equal(frame.color[rows, columns.start - 1], color[rows, columns.start])
        if rows.stop < 40:
            np.testing.assert_array_equal(frame.color[rows.stop, columns], color[rows.stop - 1, columns])

    def test_what_is_no_rectangle_is_no_region(self):
        y, x = np.mgrid[:40, :56]
        balls = [(np.hypot(y - 20, x - 28) < r)[..., None] * np.ones(3, np.float32) for r in (1, 3, 8, 10, 15)]
        for color in (*balls, np.ones((40, 56, 3), np.float32), np.zeros((40, 56, 3), np.float32)):
            assert find_region(color) is None

    def test_noise_that_leaves_pixels_black_hides_no_region(self):
        rng = np.random.default_rng(2)
        color = np.zeros((40, 56, 3), np.float32)
        color[8:30, 12:40] = (rng.random((22, 28, 1)) < 0.6) * rng.random((22, 28, 3))
        assert find_region(color) == (slice(8, 30), slice(12, 40))

    def test_the_edge_of_a_region_has_its_own_light_and_all_beside_it_is_black(self, tmp_path):
        """Averages over space mixed black into the outermost pixels: they were a third too dark."""
        scene = Scene(height=48, width=64, frames=3, step=(0, 0), noise=0.1)

        def crop(index, layers):
            for name in ("Combined", "Denoising Albedo", "Denoising Normal"):
                layers[f"ViewLayer.{name}"] = self.cut(layers[f"ViewLayer.{name}"], slice(12, 36), slice(16, 48))

        shot = open_shot(scene.write(tmp_path, edit=crop))
        blur = PerFrame(lambda frame: cv2.blur(frame.color, (7, 7)))
        maker = FrameDenoiser(
            FrameStream(shot, Rules(off=frozenset({"restore-mean", "blend-samples"})), first_pass=blur),
            Function(lambda aligned: Denoised(gated_average(aligned))),
        )
        color = maker.make(scene.first + 1).denoised.color
        truth = scene.clean(1)["ViewLayer.Combined"]
        mirrored = np.pad(truth[12:36, 16:48], ((3, 3), (3, 3), (0, 0)), mode="symmetric")
        wanted = cv2.blur(mirrored, (7, 7))[3:-3, 3:-3]
        np.testing.assert_allclose(color[12:36, 16].mean(axis=0), wanted[:, 0].mean(axis=0), rtol=0.03)
        outside = np.ones((48, 64), bool)
        outside[12:36, 16:48] = False
        assert not color[outside].any()


def object_on_nothing(frames: int = 3) -> tuple[Scene, np.ndarray]:
    """A scene, and where a disk is in all of its frames."""
    y, x = np.mgrid[:48, :64]
    return Scene(height=48, width=64, frames=frames, step=(0, 0), noise=0.1), np.hypot(y - 24, x - 30) < 12


@pytest.mark.parametrize("told_by", ["guides", "alpha"])
def test_black_stays_black_where_nothing_is(tmp_path, told_by):
    """A denoiser spreads the light of an object over the pixels beside it."""
    scene, disk = object_on_nothing()

    def cut_out(index, layers):
        layers["ViewLayer.Combined"] *= disk[..., None]
        if told_by == "guides":
            for name in ("Denoising Albedo", "Denoising Normal"):
                layers[f"ViewLayer.{name}"] *= disk[..., None]
        else:
            layers["ViewLayer.Combined"] = np.dstack([layers["ViewLayer.Combined"], disk.astype(np.float32)])

    shot = open_shot(scene.write(tmp_path, edit=cut_out))
    blur = PerFrame(lambda frame: cv2.blur(frame.color, (5, 5)))
    stream = FrameStream(shot, Rules(), first_pass=blur)
    maker = FrameDenoiser(stream, Function(lambda aligned: Denoised(gated_average(aligned))))
    color = maker.make(scene.first + 1).denoised.color
    assert not color[~disk].any()
    assert (color[disk] > 0).all()


def test_pixels_that_few_samples_leave_black_are_not_empty():
    rng = np.random.default_rng(4)
    for share in (0.1, 0.01):
        smoke = (rng.random((48, 128, 1)) < share) * np.ones(3, np.float32)
        smoke = smoke.astype(np.float32)
        assert split_unfiltered(Frame(1, smoke, albedo=smoke, normal=smoke))[1].empty is None
        smoke[:, 40:] = 0
        empty = split_unfiltered(Frame(1, smoke, albedo=smoke, normal=smoke))[1].empty
        assert empty[:, 71:].all()
        assert not empty[:, :40].any()
    surface = np.ones((48, 128, 3), np.float32)  # black because no light reaches it
    assert split_unfiltered(Frame(1, smoke, albedo=surface, normal=smoke))[1].empty is None
    assert split_unfiltered(Frame(1, smoke))[1].empty is None
