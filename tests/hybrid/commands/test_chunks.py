import os
import re
import signal
import subprocess
import sys
import threading
import time
from pathlib import Path

import pytest

from hybrid.cli import main
from hybrid.commands import chunks
from hybrid.commands.chunks import Chunk, run_jobs
from loops import parallel
from tests.scenes import Scene

ROOT = Path(__file__).parents[3]
FRAMES = 5
OPTIONS = ["--preset", "draft"]


@pytest.fixture(scope="module")
def shot(tmp_path_factory):
    return Scene(frames=FRAMES).write(tmp_path_factory.mktemp("shot") / "noisy")


def contents(folder):
    return {path.name: path.read_bytes() for path in folder.glob("*.exr")}


def summary(said):
    """Label → text, of the lines of a summary."""
    found = re.findall(r"^([A-Z][a-z ]+?) {2,}(.*)", said, re.MULTILINE)
    assert len(found) == len(dict(found)) >= 7
    return dict(found)


def test_several_processes_make_the_same_bytes_as_one(shot, tmp_path, capsys):
    assert main(["denoise", str(shot), "-o", str(tmp_path / "one"), *OPTIONS]) == 0
    one = summary(capsys.readouterr().err)
    preview = tmp_path / "look.png"
    words = ["denoise", str(shot), "-o", str(tmp_path / "two"), *OPTIONS, "--jobs", "2", "--preview", str(preview)]
    assert main(words) == 0
    assert contents(tmp_path / "two") == contents(tmp_path / "one")
    said = capsys.readouterr().err
    assert "5 of 5 frames, 100 %" in said
    two = summary(said)
    assert [*two] == [*one]
    assert "peak memory" in two.pop("Total")
    assert str(tmp_path / "two" / "ravg") in two.pop("Details")
    assert two == {label: words.replace("/one", "/two") for label, words in one.items() if label in two}
    assert preview.is_file()
    assert len(list((tmp_path / "two" / "ravg").glob("*.json"))) == 2  # a record of each process


def test_processes_share_frames_cores_and_memory(shot, tmp_path, monkeypatch):
    started = []

    def run(arguments, stopped, add, *, environment):
        started.append((sorted(word for word in arguments if word[:6] in ("--fram", "--max-", "--jobs")), environment))
        return ""

    monkeypatch.setattr(chunks, "run_command", run)
    monkeypatch.setattr(parallel, "thread_count", lambda: 9)
    words = ["denoise", str(shot), "-o", str(tmp_path), *OPTIONS, "--jobs", "2", "--max-memory", "1G"]
    assert main(words) == 0
    threads = {"NUMBA_NUM_THREADS": "4", "OMP_NUM_THREADS": "4"}
    assert sorted(started, key=str) == [
        (["--frames=1001-1003", "--max-memory=512.000M"], threads),
        (["--frames=1004-1005", "--max-memory=512.000M"], threads),
    ]


@pytest.mark.posix
def test_the_process_has_the_variables_and_hands_on_its_log(monkeypatch):
    records = []
    monkeypatch.setenv("RAVG_LOG_FILE", "all.log")
    popen = chunks.subprocess.Popen

    def start(words, **options):
        script = 'echo \'{"level": "warning", "message": "odd"}\' >&2; echo "$THREADS$RAVG_LOG_FILE" >&2; exit 3'
        return popen(["sh", "-c", script], **options)

    monkeypatch.setattr(chunks.subprocess, "Popen", start)
    fault = chunks.run_command(["denoise", "--", "shot"], lambda: False, records.append, environment={"THREADS": "4"})
    assert fault == "ended with 3: 4"
    assert records == [{"level": "warning", "message": "odd"}]


PARENT = """
import sys
from hybrid.commands import chunks
popen = chunks.subprocess.Popen
chunks.subprocess.Popen = lambda _, **options: popen([sys.executable, "-c", *sys.argv[1:]], **options)
chunks.run_command(["denoise", "--", "shot"], lambda: False, lambda record: None)
"""
CHILD = """
import pathlib, sys, time
from hybrid.runtime.interrupt import stop_with_stdin
stop_with_stdin()
try:
    pathlib.Path(sys.argv[1], "begun").touch()
    for _ in range(600):
        time.sleep(0.1)
except KeyboardInterrupt:
    pathlib.Path(sys.argv[1], "ended").touch()
"""


def test_a_chunk_ends_with_the_process_that_started_it(tmp_path):
    environment = {**os.environ, "PYTHONPATH": os.pathsep.join([str(ROOT), *sys.path])}
    parent = subprocess.Popen([sys.executable, "-c", PARENT, CHILD, str(tmp_path)], env=environment)
    for name, end in (("begun", lambda: None), ("ended", parent.kill)):
        end()
        for _ in range(600):
            if (tmp_path / name).exists():
                break
            time.sleep(0.05)
        assert (tmp_path / name).exists()
    parent.wait()


def with_damaged_frame(shot, folder):
    """Copy a shot, frame 1005 cut in half."""
    folder.mkdir()
    for path in shot.glob("*.exr"):
        data = path.read_bytes()
        (folder / path.name).write_bytes(data[: len(data) // 2] if "1005" in path.name else data)
    return folder


def test_a_chunk_fails_alone(shot, tmp_path, capsys):
    broken = with_damaged_frame(shot, tmp_path / "noisy")
    words = ["denoise", str(broken), "-o", str(tmp_path / "out"), *OPTIONS, "--no-stages", "stabilize"]
    assert main([*words, "--frames", "1001,1005", "--jobs", "2"]) == 1
    said = capsys.readouterr().err
    assert re.search(r"error: 1005: .*shot\.1005\.exr: damaged", said)
    assert "ended with" not in said, "the error says why"
    assert "error: 1 of 2 chunks failed: 1005" in said
    assert [*contents(tmp_path / "out")] == ["shot.1001.exr"]


def test_the_reasons_why_frames_failed_are_told_once(shot, tmp_path, capsys):
    """With --keep-going nothing said why: ended with 1: frames not made."""
    broken = with_damaged_frame(shot, tmp_path / "noisy")
    assert main(["denoise", str(broken), "-o", str(tmp_path / "out"), *OPTIONS, "--keep-going", "--jobs", "2"]) == 1
    said = capsys.readouterr().err
    reasons = re.findall(r"error: (.*): frame (\d+): .*shot\.1005\.exr: damaged", said)
    assert reasons == [("1004-1005", "1005")]
    assert said.splitlines()[-1] == "error: frames not made: 1005"


@pytest.mark.posix
def test_ctrl_c_stops_all_processes(monkeypatch):
    """It said that the same command went on, which makes all frames again."""
    ended, said, begun, wait = [], [], threading.Event(), chunks.wait

    def run(arguments, stopped, add, *, environment):
        if arguments == ["second"]:
            begun.wait()
            os.kill(os.getpid(), signal.SIGINT)
        while not stopped():
            time.sleep(0.01)
        ended.append(arguments)
        return "stopped"

    def wait_for_chunks(*tasks, **options):
        begun.set()
        return wait(*tasks, **options)

    monkeypatch.setattr(chunks, "run_command", run)
    monkeypatch.setattr(chunks, "wait", wait_for_chunks)
    monkeypatch.setattr(chunks.LOG, "error", said.append)
    with pytest.raises(chunks.typer.Exit) as exit_:
        run_jobs(2, "denoise", {name: Chunk([name], 1) for name in ("first", "second", "third")})
    assert exit_.value.exit_code == 130
    assert sorted(ended) == [["first"], ["second"]]  # the third never began
    assert said == ["stopped: what is finished is kept; --resume goes on from there"]


def test_one_machine_and_one_process_at_a_time_are_asked_for(shot, tmp_path, capsys):
    for words in (["--scheduler", "tcp://here:1"], ["--budget", "10s"]):
        assert main(["denoise", str(shot), "-o", str(tmp_path), "--jobs", "2", *words]) == 2
        assert "--jobs" in capsys.readouterr().err
