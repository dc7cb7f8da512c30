"""`ravg view` as a command: its address, what it refuses, how it ends."""

import json
import os
import re
import signal
import subprocess
import sys
import urllib.error
import urllib.request
from pathlib import Path

import numpy as np
import OpenEXR
import pytest

from hybrid.cli import main
from tests.scenes import Scene

ROOT = Path(__file__).parents[3]


@pytest.mark.skipif(sys.platform == "win32", reason="Windows has no SIGINT for other processes")
@pytest.mark.usefixtures("interrupts")
@pytest.mark.parametrize("number", [signal.SIGINT, signal.SIGTERM])
def test_it_serves_until_ctrl_c_or_sigterm(tmp_path, number):
    """The result may be empty: it is watched while it is being made."""
    noisy = Scene().write(tmp_path / "noisy")
    words = ["view", str(tmp_path / "out"), "--beside", str(noisy), "--no-browser"]
    process = subprocess.Popen(
        [sys.executable, "-m", "hybrid.cli", *words], stdout=subprocess.PIPE, text=True, cwd=ROOT, env=os.environ
    )
    try:
        assert process.stdout is not None
        url = process.stdout.readline().strip()
        assert re.fullmatch(r"http://127\.0\.0\.1:\d+/[\w-]{20,}/", url)
        with urllib.request.urlopen(url + "state", timeout=30) as answer:
            assert b'"1003"' in answer.read()
        process.send_signal(number)
        assert process.wait(timeout=30) == 0
    finally:
        process.kill()


def test_without_any_frame_there_is_nothing_to_view(tmp_path, capsys):
    assert main(["view", str(tmp_path / "a.####.exr")]) == 1
    assert "no frames in" in capsys.readouterr().err


def test_a_sequence_beside_must_be_there(shot_folder, tmp_path, capsys):
    assert main(["view", str(shot_folder), "--beside", str(tmp_path / "gone")]) == 1
    assert f"no frames in {tmp_path / 'gone'}" in " ".join(capsys.readouterr().err.split())


@pytest.mark.skipif(sys.platform == "win32", reason="Windows has no SIGINT for other processes")
@pytest.mark.usefixtures("interrupts")
def test_a_second_sequence_is_offered_and_errors_are_one_line_in_the_terminal(shot_folder):
    """A folder with two was refused, and one that came later ended the page, without a word in the terminal."""
    words = [sys.executable, "-m", "hybrid.cli", "view", str(shot_folder), "--no-browser"]
    process = subprocess.Popen(
        words, stdout=subprocess.PIPE, stderr=subprocess.PIPE, text=True, cwd=ROOT, env=os.environ
    )
    try:
        assert process.stdout is not None
        url = process.stdout.readline().strip()

        def names():
            with urllib.request.urlopen(url + "state", timeout=30) as answer:
                return [sequence["name"] for sequence in json.load(answer)["sequences"]]

        assert names() == ["noisy"]
        damaged = shot_folder / "also.1001.exr"
        damaged.write_bytes((shot_folder / "shot.1001.exr").read_bytes()[:-2000])
        assert names() == ["shot.####.exr", "also.####.exr"]
        for _ in range(2):
            with pytest.raises(urllib.error.HTTPError, match="409"):
                urllib.request.urlopen(f"{url}frame/1/1001.png?layer=ViewLayer.Combined&ev=0", timeout=30)
        process.send_signal(signal.SIGINT)
        _, said = process.communicate(timeout=30)
        assert process.returncode == 0
        assert re.fullmatch(f"error: {damaged}: damaged .*\n", said)
    finally:
        process.kill()


def test_frames_that_are_too_large_to_be_shown_end_it_in_one_line(tmp_path, capsys):
    window = {"dataWindow": ((0, 0), (1, 1)), "displayWindow": ((0, 0), (59999, 59999))}
    plane = np.ones((2, 2), np.float32)
    header = {**window, "compression": OpenEXR.ZIP_COMPRESSION}
    OpenEXR.File(header, dict.fromkeys("RGB", plane)).write(str(tmp_path / "a.1.exr"))
    assert main(["view", str(tmp_path), "--no-browser"]) == 1
    assert len(capsys.readouterr().err.splitlines()) == 1
