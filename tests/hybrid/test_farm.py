"""Frames in chunks, on many machines, are the frames of the shot: the same bytes, whoever makes them, in any order."""

import json
import re
import shutil
import subprocess
import sys
from pathlib import Path

import pytest

from hybrid.cli import main
from hybrid.run.job import METHOD_OF_PRESET
from hybrid.run.records import read_records
from tests.scenes import Scene

ROOT = Path(__file__).parents[2]
TEMPLATE = ROOT / "examples" / "farm" / "denoise.openjd.yaml"
FRAMES = 10


def odd(index, layers):
    """One frame is brighter, one holds a firefly, in the last three nothing moves: windows differ in their plans."""
    if index == 3:
        layers["ViewLayer.Combined"] *= 3
    if index == 5:
        layers["ViewLayer.Combined"][20, 30] = 5000
    if index >= 7:
        layers["ViewLayer.Vector"][:] = 0


@pytest.fixture(scope="module")
def shot(tmp_path_factory):
    return Scene(frames=FRAMES).write(tmp_path_factory.mktemp("shot") / "noisy", edit=odd)


OPTIONS = ["--preset", "draft"]


@pytest.fixture(scope="module")
def whole(shot, tmp_path_factory):
    """The bytes of every frame, made in one run."""
    out = tmp_path_factory.mktemp("whole") / "out"
    assert main(["denoise", str(shot), "-o", str(out), *OPTIONS]) == 0
    # Or the tests would show nothing.
    ((_, record),) = read_records(out)
    assert len({tuple(entry["stages"]) for entry in record["frames"].values()}) > 1
    frames = contents(out)
    assert len(frames) == FRAMES
    return frames


def contents(folder):
    return {path.name: path.read_bytes() for path in folder.glob("*.exr")}


def test_frame_by_frame_and_backwards(shot, whole, tmp_path, capsys):
    out = tmp_path / "out"
    for number in reversed(range(1001, 1001 + FRAMES)):
        assert main(["denoise", str(shot), "-o", str(out), *OPTIONS, "--frames", str(number)]) == 0
    assert contents(out) == whole
    assert len(list((out / "ravg").glob("*.json"))) == FRAMES
    capsys.readouterr()
    assert main(["status", str(out), "--json"]) == 0
    assert json.loads(capsys.readouterr().out)["sequences"][0]["finished"] == list(range(1001, 1001 + FRAMES))


@pytest.mark.reliability
def test_chunks_of_three_by_four_processes_at_once(shot, whole, tmp_path):
    out = tmp_path / "out"
    command = [sys.executable, "-m", "hybrid.cli", "denoise", str(shot), "-o", str(out), *OPTIONS]
    chunks = ["1010", "1007-1009", "1004-1006", "1001-1003"]
    running = [subprocess.Popen([*command, "--frames", chunk, "--quiet"], cwd=ROOT) for chunk in chunks]
    assert [process.wait() for process in running] == [0] * 4
    assert contents(out) == whole


@pytest.fixture
def openjd():
    command = Path(sys.executable).with_name("openjd")
    if not command.exists() and shutil.which("openjd") is None:
        pytest.skip("openjd-cli is not installed")
    return str(command) if command.exists() else "openjd"


@pytest.mark.openjd
def test_the_template_is_valid(openjd):
    done = subprocess.run([openjd, "check", str(TEMPLATE)], capture_output=True, text=True, check=False)
    assert done.returncode == 0, done.stdout + done.stderr


@pytest.mark.posix
@pytest.mark.openjd
@pytest.mark.neural
def test_open_job_description_runs_chunks_and_reads_their_progress(openjd, tmp_path):
    shot, out = Scene(frames=3).write(tmp_path / "noisy"), tmp_path / "out"
    ravg = tmp_path / "ravg"
    ravg.write_text(f'#!/bin/sh\ncd "{ROOT}" && exec "{sys.executable}" -m hybrid.cli "$@"\n')
    ravg.chmod(0o755)
    parameters = {
        "InputFolder": shot,
        "InputName": "shot.####.exr",
        "OutputFolder": out,
        "OutputName": "done.####.exr",
        "Frames": "1001-1003",
        "FramesPerTask": 2,
        "FirstPass": "nlm",
        "Ravg": ravg,
    }
    words = [word for name, value in parameters.items() for word in ("-p", f"{name}={value}")]
    command = [openjd, "run", str(TEMPLATE), "--step", "Denoise", *words, "--verbose"]
    done = subprocess.run(command, capture_output=True, text=True, check=False)
    assert done.returncode == 0, done.stdout + done.stderr
    assert "Chunks run: 2" in done.stdout
    for words in ("openjd_progress: 50.0", "openjd_progress: 100.0", "openjd_status: frame 1003"):
        assert words in done.stdout
    at_once = tmp_path / "whole"
    assert main(["denoise", str(shot), "-o", str(at_once / "done.####.exr"), "--first-pass", "nlm"]) == 0
    assert contents(out) == contents(at_once)
    assert len(contents(out)) == 3


def test_the_template_asks_for_frames_that_the_command_knows(capsys):
    """The command's options, as the template has them, where openjd-cli is not installed too."""
    text = TEMPLATE.read_text(encoding="utf-8")
    options = {line.split()[1] for line in text.splitlines() if line.strip().startswith("- --")}
    assert options == {"--output", "--frames", "--preset", "--first-pass", "--resume", "--keep-going", "--log-format"}
    assert main(["denoise", "--help"]) == 0
    shown = capsys.readouterr().out
    assert all(option in shown for option in options)
    (presets,) = re.findall(r"allowedValues: \[(.*)\]", text)
    assert {*presets.split(", ")} <= METHOD_OF_PRESET.keys()
