"""Previews show the right frames, on the right side, exposed alike."""

import shutil
from pathlib import Path

import cv2
import numpy as np
import pytest
from PIL import Image

from hybrid.cli import main
from hybrid.files.png import encode_srgb
from hybrid.files.shots import open_shot
from hybrid.run.preview import (
    LABELLED,
    SHEET_WIDTH,
    SHORTEST,
    check_preview,
    divide,
    write_contact_sheet,
    write_preview,
)
from tests.commands import words_in
from tests.scenes import Scene

DEFAULTS = Path(__file__).parents[2] / "data" / "defaults"


@pytest.fixture
def pair(tmp_path):
    """A shot whose frame k is of gray 0.18·k, and "denoised" frames that are a tenth darker."""

    def gray(index, layers):
        layers["ViewLayer.Combined"][:] = 0.18 * (index + 1)

    def darker(index, layers):
        layers["ViewLayer.Combined"][:] = 0.9 * 0.18 * (index + 1)

    noisy = Scene().write(tmp_path / "noisy", edit=gray)
    denoised = Scene().write(tmp_path / "denoised", edit=darker)
    return open_shot(noisy), denoised


def level(linear):
    """Radiance in 8-bit sRGB; the middle frame of `pair`, of 0.36, is exposed to 0.18."""
    return float(np.round(encode_srgb(np.float32(linear / 2)) * 255))


def test_a_png_has_the_middle_frame_noisy_and_denoised(pair, tmp_path):
    shot, denoised = pair
    write_preview(shot, denoised, tmp_path / "a.png")
    picture = cv2.imread(str(tmp_path / "a.png"))
    assert picture.shape == (40, 112, 3)
    assert picture[5, 5] == pytest.approx(level(0.36), abs=1)
    assert picture[5, -5] == pytest.approx(level(0.9 * 0.36), abs=1)


def test_a_preview_names_both_sides_where_there_is_room(tmp_path):
    def flat(index, layers):
        layers["ViewLayer.Combined"][:] = 0.18

    folders = [Scene(height=40, width=LABELLED).write(tmp_path / name, edit=flat) for name in ("noisy", "denoised")]
    write_preview(open_shot(folders[0]), folders[1], tmp_path / "a.png")
    noisy, denoised = np.split(cv2.imread(str(tmp_path / "a.png")), 2, axis=1)
    for side, here, there in ((noisy, slice(0, 80), slice(80, None)), (denoised, slice(-80, None), slice(0, -80))):
        assert side[:, here].std() > 0
        assert side[:, there].std() == 0


def test_a_movie_plays_all_frames_with_one_exposure_and_a_divider_that_moves(pair, tmp_path):
    shot, denoised = pair
    write_preview(shot, denoised, tmp_path / "a.webp", rate=24)
    with Image.open(tmp_path / "a.webp") as image:
        assert image.n_frames == SHORTEST  # three frames, sixteen times
        frames = []
        for index in range(image.n_frames):
            image.seek(index)
            frames.append(np.asarray(image.convert("L"), np.float32))
    for index, frame in enumerate(frames):
        number = index % 3 + 1
        left, right = frame[10:30, 0].mean(), frame[10:30, -1].mean()
        # At either end of its way the divider leaves the outermost columns to one side. Tolerance: lossy compression.
        if 1 <= index <= 20:
            assert left == pytest.approx(level(0.18 * number), abs=4)
        if 28 <= index <= 44:
            assert right == pytest.approx(level(0.9 * 0.18 * number), abs=4)
    assert frames[0][20, 28] > 200, "the divider begins in the middle"
    assert frames[12][:, -4:].mean() == pytest.approx(level(0.18), abs=4), "a quarter later all is noisy"
    assert frames[36][:, :4].mean() == pytest.approx(level(0.9 * 0.18), abs=4), "and then all is denoised"


def test_a_sheet_has_frames_from_the_first_to_the_last(tmp_path):
    scene = Scene(frames=50, height=18, width=32, step=(0, 0))

    def ramp(index, layers):
        layers["ViewLayer.Combined"][:] = (index + 1) / 50

    folder = scene.write(tmp_path / "shot", edit=ramp)
    denoised = shutil.copytree(folder, tmp_path / "denoised")
    write_contact_sheet(open_shot(folder), denoised, tmp_path / "sheet.png")
    sheet = cv2.imread(str(tmp_path / "sheet.png")).astype(np.float32)
    height = SHEET_WIDTH * 18 // 32
    assert sheet.shape == (5 * height, 5 * SHEET_WIDTH, 3)  # 24 frames, and a white place that is left
    corners = sheet[10::height, 10::SHEET_WIDTH, 0].ravel()
    assert (np.diff(corners[:24]) > 0).all()
    assert corners[24] == 255
    exposure = 0.18 / (26 / 50)  # of the middle frame
    assert corners[0] == pytest.approx(255 * encode_srgb(np.float32(exposure / 50)), abs=1)
    assert corners[23] == pytest.approx(255 * encode_srgb(np.float32(exposure)), abs=1)


def test_a_divider_leaves_both_sides_where_they_are():
    left, right = np.zeros((4, 10, 3), np.uint8), np.full((4, 10, 3), 100, np.uint8)
    assert (divide(left, right, 0.0) == right).all()
    assert (divide(left, right, 1.0) == left).all()
    half = divide(left, right, 0.5)
    assert half[0, :, 0].tolist() == [0, 0, 0, 0, 255, 255, 100, 100, 100, 100]
    assert left.max() == 0, "the picture given was not drawn on"


def test_the_denoised_side_of_what_blender_has_denoised_is_ours(tmp_path, capsys):
    """Such a file keeps its Noisy Image, which a new look would take for the picture again."""
    source = Path(shutil.copytree(DEFAULTS, tmp_path / "in"))
    words = ["denoise", "--method=classical", str(source / "noisy.####.exr"), "-o", str(tmp_path / "out")]
    words += ["--first-pass", "auto"]
    assert main([*words, "--preview", str(tmp_path / "a.png")]) == 0, capsys.readouterr().err
    picture = cv2.imread(str(tmp_path / "a.png")).astype(np.float32)
    noisy, denoised = np.split(picture, 2, axis=1)
    assert np.abs(np.diff(denoised, axis=1)).mean() < 0.7 * np.abs(np.diff(noisy, axis=1)).mean()


def test_a_layer_that_was_named_is_the_one_that_is_shown(tmp_path, capsys):
    def another(index, layers):
        layers["ViewLayer.Beauty"] = layers["ViewLayer.Combined"] * 0 + 0.5
        layers["ViewLayer.Combined"][:, ::2] *= 4

    folder = Scene().write(tmp_path / "in", edit=another)
    words = ["denoise", str(folder), "-o", str(tmp_path / "out"), "--layer", "color=Beauty", "--preset", "draft"]
    assert main([*words, "--preview", str(tmp_path / "a.png")]) == 0, capsys.readouterr().err
    picture = cv2.imread(str(tmp_path / "a.png")).astype(np.float32)
    assert picture.std() < 5, "of one gray, noisy and denoised"


@pytest.mark.parametrize(("option", "name"), [("--preview", "a.gif"), ("--preview", "a"), ("--contact-sheet", "a.mp4")])
def test_what_is_no_preview_is_refused_before_anything_is_made(shot_folder, tmp_path, capsys, option, name):
    code = main(
        ["denoise", "--method=classical", str(shot_folder), "-o", str(tmp_path / "out"), option, str(tmp_path / name)]
    )
    assert code == 2
    assert "expected a name that ends in .png" in words_in(capsys.readouterr().err)
    assert not (tmp_path / "out").exists()


def test_a_missing_library_is_said_before_anything_is_made(monkeypatch, tmp_path):
    monkeypatch.setattr("hybrid.files.movies.importlib.util.find_spec", lambda name: None)
    with pytest.raises(ImportError, match='pip install "av"'):
        check_preview(tmp_path / "a.mp4")


def test_both_are_written_by_one_command(shot_folder, tmp_path, capsys):
    words = ["denoise", str(shot_folder), "-o", str(tmp_path / "out"), "--preset", "draft", "--fps", "12"]
    code = main([*words, "--preview", str(tmp_path / "a.webp"), "--contact-sheet", str(tmp_path / "sheet.png")])
    assert code == 0, capsys.readouterr().err
    with Image.open(tmp_path / "a.webp") as image:
        image.seek(image.n_frames - 1)
        image.load()
        assert image.info["timestamp"] + image.info["duration"] == SHORTEST / 12 * 1000
    assert cv2.imread(str(tmp_path / "sheet.png")).shape[1] == 2 * SHEET_WIDTH


@pytest.mark.parametrize("jobs", ["1", "2"])
def test_pictures_have_the_frames_that_are_there(jobs, tmp_path, capsys):
    """With --keep-going none was written where a frame had failed, without a word."""
    folder, sheet = Scene(frames=4).write(tmp_path / "in"), tmp_path / "sheet.png"
    victim = folder / "shot.1004.exr"
    victim.write_bytes(victim.read_bytes()[:-2000])
    words = ["denoise", str(folder), "-o", str(tmp_path / "out"), "--preset", "draft", "--keep-going", "--jobs", jobs]
    assert main([*words, "--preview", str(tmp_path / "a.png"), "--contact-sheet", str(sheet)]) == 1
    assert {path.name for path in (tmp_path / "out").glob("*.exr")} == {f"shot.{n}.exr" for n in (1001, 1002, 1003)}
    assert cv2.imread(str(sheet)).shape[1] == 2 * SHEET_WIDTH  # two columns
    assert (tmp_path / "a.png").is_file()
    assert f"wrote {sheet}" in words_in(capsys.readouterr().err)
