"""The extension's side of the process that it starts; needs no Blender."""

import os
import stat
import sys
import time
from pathlib import Path

import pytest

from tests.blender.wheels import load_module

command = load_module("command")


def run(code: str, tmp_path: Path, outputs: list[Path] | None = None) -> command.Run:
    """Start Python in the place of ravg."""
    return command.Run([sys.executable, "-c", code], outputs or [], tmp_path / "log")


def test_a_command_is_found_by_path_and_by_name(tmp_path, monkeypatch):
    tool = tmp_path / ("ravg.exe" if sys.platform == "win32" else "ravg")
    tool.write_text("#!/bin/sh\n", encoding="ascii")
    tool.chmod(tool.stat().st_mode | stat.S_IXUSR)
    monkeypatch.setenv("PATH", str(tmp_path))
    # The last is an empty preference: the default. As paths, since Windows writes the suffix in capitals.
    for name in (str(tool), str(tmp_path / "ravg"), "ravg", " "):
        assert Path(command.find_command(name)) == tool


def test_a_command_that_is_not_there_is_named(tmp_path):
    with pytest.raises(FileNotFoundError, match=r"no command 'gone': .*Preferences"):
        command.find_command("gone")
    (tmp_path / "text").write_text("no program", encoding="ascii")
    with pytest.raises(FileNotFoundError):
        command.find_command(str(tmp_path / "text"))


def test_frames_count_when_they_are_whole_and_new(tmp_path):
    """An old frame of an earlier run counts when it has been replaced; one half written never does."""
    old, kept, new, half = (tmp_path / f"{name}.exr" for name in ("old", "kept", "new", "half"))
    old.write_bytes(b"before")
    kept.write_bytes(b"before")
    code = """
import os
for name in ("old", "new"):
    with open(f".{name}.tmp", "wb") as file:
        file.write(b"after")
    os.replace(f".{name}.tmp", f"{name}.exr")
open(".half.tmp", "wb").write(b"ha")
"""
    made = run(f"import os; os.chdir({str(tmp_path)!r})\n{code}", tmp_path, [old, kept, new, half])
    assert made.wait() == 0
    assert (made.finished, made.total) == (2, 4)


@pytest.mark.parametrize(
    ("last", "count"),
    [
        ("Passes      color, 1 of 2 frames", 0),
        ("denoise: 0 of 3 frames, 0 %", 0),
        ("frame 5 was there: 2 of 3 frames, 67 %, about 0 s left", 2),
        ("error: stopped: 2 of 3 frames are finished, the last is 5; --resume goes on from there", 2),
    ],
)
def test_frames_that_were_there_count_when_the_log_tells_of_them(tmp_path, last, count):
    there = tmp_path / "there.exr"
    there.write_bytes(b"before")
    resumed = run(f"print('denoise: 0 of 3 frames, 0 %'); print({last!r})", tmp_path, [there, tmp_path / "gone.exr"])
    assert resumed.wait() == 0
    assert resumed.finished == count


def test_what_goes_wrong_is_told_in_one_line(tmp_path):
    failed = run(
        "import sys; print('stages: warp'); print('error: out of luck', file=sys.stderr); sys.exit(1)", tmp_path
    )
    assert failed.wait() == 1
    assert failed.error == "out of luck"
    assert failed.log.splitlines() == ["stages: warp", "error: out of luck"]


def test_the_last_line_stands_for_an_error_that_is_not_marked(tmp_path):
    crashed = run("raise RuntimeError('a bug')", tmp_path)
    assert crashed.wait() != 0
    assert crashed.error == "RuntimeError: a bug"
    silent = run("import os; os._exit(3)", tmp_path)
    silent.wait()
    assert silent.error == "ravg ended with code 3"


def test_usage_errors_are_read_out_of_their_frame(tmp_path):
    pytest.importorskip("typer")
    usage = command.Run([sys.executable, "-m", "hybrid.cli", "denoise", "--no-such-option"], [], tmp_path / "log")
    assert usage.wait() == 2
    assert usage.error.startswith("No such option")


@pytest.mark.parametrize("frame", ["│{}│\n╰────╯", "| {} |\n+------+", "│ {} │\n└──────┘"])
def test_the_frame_of_an_error_is_stripped_on_all_systems(tmp_path, frame):
    text = frame.format("No such option: --x-y")
    failed = run(f"import sys; print({text!r}); sys.exit(2)", tmp_path)
    failed.wait()
    assert failed.error == "No such option: --x-y"


def test_warnings_are_collected(tmp_path):
    warned = run(
        "print('warning: one seed'); print('no warning: this'); print('  warning: frame 3 is missing')", tmp_path
    )
    assert warned.wait() == 0
    assert warned.warnings == ["one seed", "frame 3 is missing"]


def test_what_is_left_is_what_it_has_said_last(tmp_path):
    """As `ravg` writes where there is no terminal; `test_extension.py` sees it do so."""
    lines = [
        "denoise: 0 of 3 frames, 0 %",
        "frame 1 9.0 s: 1 of 3 frames, 33 %, about 18 s left",
        "frame 2: 1 fireflies",
    ]
    told = run(f"print({lines[0]!r})", tmp_path)
    told.wait()
    assert told.remaining == ""
    told = run(f"print({chr(10).join(lines)!r})", tmp_path)
    told.wait()
    assert told.remaining == "18 s"


def test_letters_of_all_kinds_reach_the_log(tmp_path, monkeypatch):
    monkeypatch.setenv("LC_ALL", "C")
    spoken = run("print('1920×1080 – ≈')", tmp_path)
    assert spoken.wait() == 0
    assert spoken.log.strip() == "1920×1080 – ≈"


LISTENS = "import os, sys; assert os.environ['RAVG_STOP_WITH_STDIN'] == '1'; "


def test_it_stops_when_its_input_closes_and_not_before(tmp_path):
    """As on Windows, where a process without a console gets no signal."""
    made = run(LISTENS + "sys.stdin.read(); print('stopped: 0 of 1 frames are finished'); sys.exit(130)", tmp_path)
    time.sleep(0.2)
    assert made.code is None
    made.stop()
    made.stop()
    assert made.stopped
    assert made.wait() == 130
    assert "stopped" in made.log


@pytest.mark.parametrize("limit", ["TERMINATED_AFTER", "KILLED_AFTER"])
def test_a_process_that_does_not_listen_is_ended(tmp_path, monkeypatch, limit):
    monkeypatch.setattr(command, limit, 0.0)
    ready = tmp_path / "ready"
    code = "import pathlib, signal, time; signal.signal(signal.SIGINT, signal.SIG_IGN); "
    made = run(code + f"pathlib.Path({str(ready)!r}).touch(); time.sleep(60)", tmp_path)
    while not ready.exists():
        assert made.code is None
    made.stop()
    assert made.wait() not in (None, 0)


def test_errors_of_the_system_do_not_leave_stop(tmp_path, monkeypatch):
    """Windows raises them for a process that has just ended."""
    made = run(LISTENS + "sys.stdin.read()", tmp_path)

    def fail() -> None:
        raise OSError(6, "the handle is invalid")

    with monkeypatch.context() as changed:
        changed.setattr(command, "TERMINATED_AFTER", 0.0)
        changed.setattr(made._process, "terminate", fail)
        made.stop()
        while made.code is None:
            time.sleep(0.01)
    assert made.wait() == 0


def test_a_command_that_cannot_start_is_an_error_of_the_system(tmp_path):
    with pytest.raises(FileNotFoundError):
        command.Run([os.fspath(tmp_path / "gone")], [], tmp_path / "log")
