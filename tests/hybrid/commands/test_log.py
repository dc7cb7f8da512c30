"""The log of a command: lines, JSON, Open Job Description; closed pipes and terminals that print only ASCII."""

import json
import os
import subprocess
import sys
import time
from pathlib import Path

import pytest

from hybrid.cli import main
from hybrid.commands.log import LOG, Progress, end_log, one_line, start_log

ROOT = Path(__file__).parents[3]


@pytest.fixture
def log():
    """Start the log, and end it whatever happens."""
    yield start_log
    end_log()


def work(total=4):
    progress = Progress("denoise", total)
    for number in range(total):
        progress.advance(message=f"frame {number}", frame=number, seconds=1.5)


def test_progress_is_lines_where_there_is_no_terminal(log, capsys):
    log()
    work()
    lines = capsys.readouterr().err.splitlines()
    assert lines[0] == "denoise: 0 of 4 frames, 0 %"
    assert lines[2].startswith("frame 1: 2 of 4 frames, 50 %, about ")
    assert len(lines) == 5


def test_the_time_left_is_that_of_the_steps_after_the_first(log, capsys, monkeypatch):
    """The first frame of ten reads a whole window, and compiles: seven minutes were left of two."""
    log()
    now = iter([0.0, 60.0, 70.0, 80.0])
    monkeypatch.setattr(time, "monotonic", lambda: next(now))
    progress = Progress("denoise", 4)
    for _ in range(3):
        progress.advance()
    assert capsys.readouterr().err.splitlines() == [
        "denoise: 0 of 4 frames, 0 %",
        "denoise: 1 of 4 frames, 25 %",
        "denoise: 2 of 4 frames, 50 %, about 20 s left",
        "denoise: 3 of 4 frames, 75 %, about 10 s left",
    ]


def test_a_bar_that_hardly_moves_fills_no_log(log, capsys):
    log()
    bar = Progress("train", 10_000, "steps")
    for _ in range(10_000):
        bar.advance()
    assert len(capsys.readouterr().err.splitlines()) == 101


def test_json_lines_hold_the_facts(log, capsys):
    log("json")
    work()
    LOG.warning("careful")
    documents = [json.loads(line) for line in capsys.readouterr().err.splitlines()]
    expected = {"time": "", "level": "info", "message": "frame 1", "done": 2, "total": 4, "percent": 50}
    expected |= {"frame": 1, "seconds": 1.5, "seconds_left": 0}
    assert documents[2] | {"time": "", "seconds_left": 0} == expected
    assert documents[-1]["level"] == "warning"


def test_open_job_description_is_told_percent_and_status(log, capsys):
    log("openjd")
    work()
    LOG.error("out of rays")
    lines = capsys.readouterr().err.splitlines()
    assert [line for line in lines if line.startswith("openjd_progress: ")][-1] == "openjd_progress: 100.0"
    assert any(line.startswith("openjd_status: frame 3: 4 of 4 frames") for line in lines)
    assert lines[-1] == "openjd_fail: out of rays"


def test_quiet_and_verbose(log, capsys):
    for options, seen in (
        ({"quiet": True}, "warning: w\n"),
        ({}, "i\nwarning: w\n"),
        ({"verbose": True}, "d\ni\nwarn"),
    ):
        log(**options)
        LOG.debug("d")
        LOG.info("i")
        LOG.warning("w")
        assert capsys.readouterr().err.startswith(seen)


def test_a_log_file_is_added_to_and_never_takes_the_place_of_another_file(log, tmp_path, capsys):
    path = tmp_path / "log.txt"
    for _ in range(2):
        log(file=path, quiet=True)
        LOG.info("hello")
    assert [line.split(" ", 1)[1] for line in path.read_text().splitlines()] == ["hello", "hello"]
    assert capsys.readouterr().err == ""
    picture = tmp_path / "shot.exr"
    picture.write_bytes(b"\x76\x2f\x31\x01\0\0")
    with pytest.raises(ValueError, match="is there and no text"):
        log(file=picture)
    assert picture.stat().st_size == 6


def test_errors_are_records_too(tmp_path, capsys):
    assert main(["inspect", str(tmp_path / "no.####.exr"), "--log-format", "json"]) == 1
    document = json.loads(capsys.readouterr().err)
    assert document["level"] == "error"
    assert "no.####.exr" in document["message"]


def test_a_log_file_that_cannot_be_written_is_an_error_as_any(tmp_path, capsys):
    assert main(["status", str(tmp_path), "--log-file", str(tmp_path / "no" / "log")]) == 1
    assert capsys.readouterr().err.startswith(f"error: {tmp_path / 'no' / 'log'}")


def ravg(*arguments, **options):
    return [sys.executable, "-m", "hybrid.cli", *map(str, arguments)], {"cwd": ROOT, **options}


@pytest.mark.parametrize("stream", ["stdout", "stderr"])
def test_a_closed_pipe_does_not_end_the_work(shot_folder, tmp_path, stream):
    command, options = ravg("denoise", shot_folder, "-o", tmp_path / "out", "--preset", "draft")
    read, write = os.pipe()
    os.close(read)  # whoever read it has gone before the first word
    other = "stderr" if stream == "stdout" else "stdout"
    done = subprocess.run(command, **options, **{stream: write, other: subprocess.DEVNULL}, check=False)
    os.close(write)
    assert done.returncode == 0
    assert len(list((tmp_path / "out").glob("*.exr"))) == 3


@pytest.mark.posix
def test_streams_that_were_never_open(shot_folder):
    command, options = ravg("inspect", shot_folder, "-v")
    script = 'exec "$0" "$@" >&- 2>&-'
    assert subprocess.run(["sh", "-c", script, *command], **options, check=False).returncode == 0


@pytest.mark.parametrize(
    "environment",
    [
        {"PYTHONIOENCODING": "ascii"},
        pytest.param({"LC_ALL": "C", "PYTHONCOERCECLOCALE": "0"}, marks=pytest.mark.posix),  # Windows ignores it
    ],
)
def test_terminals_that_know_only_ascii(shot_folder, environment):
    command, options = ravg("inspect", shot_folder, "-v", env={**os.environ, **environment, "PYTHONUTF8": "0"})
    done = subprocess.run(command, **options, capture_output=True, check=False)
    assert done.returncode == 0, done.stderr
    assert b"56x40" in done.stdout
    assert done.stdout.isascii()


def test_tables_stay_in_line_where_signs_are_replaced(shot_folder):
    """The encoding of pipes on Windows has no "≤"; two letters in its place shifted the columns behind it."""
    command, options = ravg("inspect", shot_folder, "-v", env={**os.environ, "PYTHONIOENCODING": "cp1252"})
    printed = subprocess.run(command, **options, capture_output=True, check=True).stdout.decode("cp1252")
    rows = [line for line in printed.partition("Plan")[2].splitlines() if line.startswith("|") and "-+-" not in line]
    assert any(" <= " in row for row in rows)
    assert len({tuple(i for i, sign in enumerate(row) if sign == "|") for row in rows}) == 1


def test_the_first_run_says_that_it_compiles_and_later_ones_do_not(shot_folder, tmp_path):
    cache = {**os.environ, "NUMBA_CACHE_DIR": str(tmp_path / "cache")}
    command, options = ravg("inspect", shot_folder, env=cache)
    said = [subprocess.run(command, **options, capture_output=True, text=True, check=True).stderr for _ in range(2)]
    assert ["compiling for this processor" in words for words in said] == [True, False]
    assert said[0].count("compiling") == 1


def test_an_error_quotes_no_more_than_some_lines_of_a_path():
    """A path of 6,000 characters stood in the message, twice."""
    for error in (OSError(36, "File name too long", "x" * 6000), ValueError("x" * 6000 + " File name too long")):
        said = one_line(error)
        assert len(said) < 2100
        assert said.endswith("File name too long")
