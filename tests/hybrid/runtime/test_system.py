"""The differences between systems, on whichever the tests run."""

import os
import subprocess
import sys
import threading
import time
from pathlib import Path

import pytest

from hybrid.runtime import system
from hybrid.runtime.system import (
    expand_home,
    is_reserved,
    load_average,
    lock_file,
    open_file,
    process_lives,
    processor_name,
    replace_path,
    same_file,
    start_context,
    thread_clock,
)


def test_a_new_file_is_made_once_and_an_old_one_is_opened_again(tmp_path):
    path = tmp_path / "a"
    with pytest.raises(FileNotFoundError):
        open_file(path, new=False)
    os.close(open_file(path, new=True))
    with pytest.raises(FileExistsError):
        open_file(path, new=True)
    os.close(open_file(path, new=False))


@pytest.mark.skipif(sys.platform != "win32", reason="paths are limited on Windows alone")
@pytest.mark.parametrize("error", [3, 206])  # path not found, name too long
def test_a_path_that_is_too_long_for_windows_is_named_as_the_reason(tmp_path, monkeypatch, error):
    """Wine takes paths of any length, so the answer of Windows is given here."""
    monkeypatch.setattr(system.ctypes, "get_last_error", lambda: error)
    long, short = tmp_path / "gone" / ("a" * 250), tmp_path / "gone" / "a"
    with pytest.raises(OSError, match=f"the path has {len(str(long))} characters, Windows takes 259"):
        open_file(long, new=True)
    with pytest.raises(OSError) as raised:
        open_file(short, new=True)
    assert "characters" not in str(raised.value)


def test_a_locked_file_is_read_written_renamed_and_removed_by_its_name(tmp_path):
    """Locks of Windows are mandatory, and its files are not shared unless that is asked for."""
    path = tmp_path / "a"
    descriptor = open_file(path, new=True)
    try:
        lock_file(descriptor)
        path.write_bytes(b"frame")
        assert path.read_bytes() == b"frame"
        replace_path(path, tmp_path / "b")
        assert (tmp_path / "b").read_bytes() == b"frame"
        (tmp_path / "b").unlink()
    finally:
        os.close(descriptor)
    assert list(tmp_path.iterdir()) == []


def test_a_lock_is_held_by_one_until_the_file_is_closed(tmp_path):
    path = tmp_path / "a"
    one, other = open_file(path, new=True), open_file(path, new=False)
    try:
        lock_file(one)
        with pytest.raises(BlockingIOError):
            lock_file(other)
        os.close(one)
        lock_file(other)
    finally:
        os.close(other)


def test_a_file_that_another_program_has_open_is_replaced_when_it_is_closed(tmp_path, monkeypatch):
    """As by Windows, which refuses that with WinError 5 or 32."""
    (tmp_path / "a").write_text("new")
    refusals = iter([PermissionError(13, "in use", str(tmp_path / "a"))] * 3)
    replace = os.replace

    def refuse(source, target):
        if error := next(refusals, None):
            raise error
        replace(source, target)

    monkeypatch.setattr(system.sys, "platform", "win32")
    monkeypatch.setattr(system.os, "replace", refuse)
    monkeypatch.setattr(system.time, "sleep", lambda seconds: None)
    replace_path(tmp_path / "a", tmp_path / "b")
    assert (tmp_path / "b").read_text() == "new"


def test_a_file_that_stays_open_is_an_error_in_the_end(tmp_path, monkeypatch):
    def refuse(source, target):
        raise PermissionError(13, "in use", str(source))

    clock = iter(range(100))
    monkeypatch.setattr(system.sys, "platform", "win32")
    monkeypatch.setattr(system.os, "replace", refuse)
    monkeypatch.setattr(system.time, "sleep", lambda seconds: None)
    monkeypatch.setattr(system.time, "monotonic", lambda: next(clock))
    with pytest.raises(PermissionError, match="in use"):
        replace_path(tmp_path / "a", tmp_path / "b")


def test_a_read_only_file_is_called_so(tmp_path, monkeypatch):
    """Windows refuses to replace it, with "access is denied"."""

    def refuse(source, target):
        raise PermissionError(13, "access is denied", str(source))

    (tmp_path / "b").write_text("old")
    (tmp_path / "b").chmod(0o444)
    monkeypatch.setattr(system.sys, "platform", "win32")
    monkeypatch.setattr(system.os, "replace", refuse)
    with pytest.raises(PermissionError, match="the file there is read-only"):
        replace_path(tmp_path / "a", tmp_path / "b")


def test_files_without_inodes_or_with_other_ones_are_taken_for_the_same(tmp_path):
    """Some network drives of Windows have no inodes, and some change them."""
    for name in "ab":
        (tmp_path / name).write_text(name)
    os.utime(tmp_path / "a", ns=(1, 1))
    one, other = (tmp_path / "a").stat(), (tmp_path / "b").stat()
    assert same_file(one, one)
    assert not same_file(one, other)
    unnumbered = os.stat_result([0 if n == 1 else value for n, value in enumerate(other)])
    assert same_file(one, unnumbered)
    os.utime(tmp_path / "b", ns=(1, 1))
    assert same_file(one, (tmp_path / "b").stat())


def test_a_process_is_asked_about_without_a_signal():
    """A signal of number 0 is Ctrl-C on Windows."""
    code = "import sys; print('begun', flush=True); sys.stdin.read()"
    pipe = subprocess.PIPE
    with subprocess.Popen([sys.executable, "-c", code], stdin=pipe, stdout=pipe, text=True) as child:
        assert child.stdout is not None
        assert child.stdout.readline() == "begun\n"
        assert process_lives(child.pid)
        assert child.poll() is None
        child.communicate()
        assert child.returncode == 0
    assert not process_lives(child.pid)
    assert process_lives(os.getpid())


@pytest.mark.parametrize("platform", [sys.platform, "win32"])
def test_the_time_of_a_thread_is_seen_from_another(monkeypatch, platform):
    """By the clock of Linux, and by what psutil lists elsewhere."""
    monkeypatch.setattr(system.sys, "platform", platform)
    clocks, ended = [], threading.Event()

    def burn():
        clocks.append(thread_clock())
        while time.thread_time() < 0.3:
            pass
        clocks.append(None)
        ended.wait(60)

    thread = threading.Thread(target=burn)
    thread.start()
    while len(clocks) < 2:
        time.sleep(0.01)
    seen = clocks[0]()
    ended.set()
    thread.join()
    assert seen == pytest.approx(0.3, abs=0.05)  # counted in hundredths elsewhere


def test_processes_are_forked_from_a_server_on_linux_alone(monkeypatch):
    expected = "forkserver" if sys.platform == "linux" else "spawn"
    assert start_context("hybrid.runtime.system").get_start_method() == expected
    for platform in ("darwin", "win32"):
        monkeypatch.setattr(system.sys, "platform", platform)
        assert start_context("hybrid.runtime.system").get_start_method() == "spawn"


def test_the_load_is_unknown_on_windows(monkeypatch):
    monkeypatch.setattr(system.sys, "platform", "win32")
    assert load_average() is None


def test_the_processor_has_a_name(monkeypatch):
    """Not only an architecture: reports and records of two machines differ in it."""
    assert len(processor_name()) > len("x86_64")
    asked = []
    monkeypatch.setattr(system.sys, "platform", "darwin")
    monkeypatch.setattr(system.subprocess, "check_output", lambda command, **_: asked.append(command) or "Apple M4\n")
    assert processor_name() == "Apple M4"
    assert asked == [["sysctl", "-n", "machdep.cpu.brand_string"]]

    def fail(*_, **__):
        raise FileNotFoundError("sysctl")

    monkeypatch.setattr(system.subprocess, "check_output", fail)
    monkeypatch.setattr(system.platform, "machine", lambda: "arm64")
    assert processor_name() == "arm64"


@pytest.mark.parametrize("name", ["aux.exr", "con", "COM1.exr", "nul"])
def test_names_that_windows_keeps_for_itself(monkeypatch, name):
    monkeypatch.setattr(system.sys, "platform", "win32")
    assert is_reserved(Path(name))
    assert not is_reserved(Path("auxiliary.0001.exr"))


def test_the_users_folder_is_put_in_where_no_shell_does_it(monkeypatch):
    words = ["denoise", "~/shot.####.exr", "~\\out", "a~/b", "~", "~name"]
    monkeypatch.setattr(system.os.path, "expanduser", lambda word: "C:\\Users\\me" + word[1:])
    monkeypatch.setattr(system.sys, "platform", "linux")
    assert expand_home(words) == words
    monkeypatch.setattr(system.sys, "platform", "win32")
    here = "C:\\Users\\me"
    assert expand_home(words) == ["denoise", f"{here}/shot.####.exr", f"{here}\\out", "a~/b", here, "~name"]
