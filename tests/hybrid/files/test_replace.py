"""Files are written whole or not at all, and never over somebody else's file."""

import errno
import os
import socket
import stat
from pathlib import Path

import cv2
import numpy as np
import pytest

from hybrid.files import replace
from hybrid.files.exr import read_exr
from hybrid.files.movies import write_movie
from hybrid.files.png import write_png
from hybrid.files.replace import check_outputs, remove_leftovers, replace_file, temporary_folder, write_file
from tests.exr_files import write_layers


@pytest.mark.posix
def test_a_temporary_name_cannot_be_guessed_and_is_not_opened_through_a_link(tmp_path, monkeypatch):
    """Names were made of host, process and thread; a link of such a name was written through."""
    precious = tmp_path / "precious"
    precious.write_text("precious")
    tokens = iter(["0" * 16, "1" * 16])
    monkeypatch.setattr(replace.secrets, "token_hex", lambda count: next(tokens))
    planted = tmp_path / f".a.ravg-{16 * '0'}.tmp"
    planted.symlink_to(precious)
    write_file(tmp_path / "a", "new")  # takes the second name
    assert precious.read_text() == "precious"
    assert (tmp_path / "a").read_text() == "new"
    assert planted.is_symlink()
    monkeypatch.undo()
    names = set()
    for _ in range(3):
        with replace_file(tmp_path / "a") as temporary:
            names.add(temporary.name)
    assert len(names) == 3


def test_a_temporary_file_that_was_exchanged_is_not_put_in_place(tmp_path):
    def exchange():
        with replace_file(tmp_path / "a") as temporary:
            temporary.unlink()
            temporary.write_text("somebody else's")

    with pytest.raises(OSError, match="a: cannot write: its temporary file was exchanged"):
        exchange()
    assert not (tmp_path / "a").exists()


@pytest.mark.posix
def test_a_link_is_replaced_and_not_written_through(tmp_path):
    precious = tmp_path / "precious"
    precious.write_text("precious")
    (tmp_path / "a").symlink_to(precious)
    write_file(tmp_path / "a", "new")
    assert precious.read_text() == "precious"
    assert not (tmp_path / "a").is_symlink()


def make(kind: str, path: Path) -> None:
    if kind == "pipe":
        os.mkfifo(path)
    elif kind == "socket":
        with socket.socket(socket.AF_UNIX) as listener:
            listener.bind(str(path))
    elif kind == "device":
        path.symlink_to("/dev/null")
    else:
        path.mkdir()


@pytest.mark.posix
@pytest.mark.parametrize("kind", ["pipe", "socket", "device", "folder"])
def test_what_is_no_file_is_not_replaced(tmp_path, kind, monkeypatch):
    """A preview to /dev/null, as root, made a file of the device."""
    monkeypatch.chdir(tmp_path)  # names of sockets are short
    make(kind, Path("a"))
    before = os.lstat("a")
    with pytest.raises(OSError, match=f"a is a {kind}, expected a file or a new name"):
        write_file(Path("a"), "new")
    with pytest.raises(OSError, match=f"a is a {kind}"):
        check_outputs([("preview", Path("a"))], [])
    assert os.path.samestat(before, os.lstat("a"))
    assert [path.name for path in tmp_path.iterdir()] == ["a"]


def test_files_have_the_rights_that_others_have(tmp_path):
    (tmp_path / "plain").touch()
    write_file(tmp_path / "ours", b"")
    assert stat.S_IMODE((tmp_path / "ours").stat().st_mode) == stat.S_IMODE((tmp_path / "plain").stat().st_mode)


@pytest.mark.parametrize("named", [True, False])
def test_an_error_while_writing_names_the_file(tmp_path, named):
    """A full disk was told of as "[Errno 28] No space left on device", and no more."""
    with (
        pytest.raises(OSError, match="cannot write: No space left") as error,
        replace_file(tmp_path / "a") as temporary,
    ):
        raise OSError(errno.ENOSPC, "No space left on device", *([str(temporary)] if named else []))
    assert error.value.filename == str(tmp_path / "a")
    assert list(tmp_path.iterdir()) == []


def test_a_long_name_is_no_obstacle(tmp_path):
    for name in ("x" * 255, "\u00e9" * 127):
        write_file(tmp_path / name, "whole")
        assert (tmp_path / name).read_text() == "whole"


def test_every_kind_of_file_is_written_to_the_temporary_one_itself(tmp_path):
    """A library that renames into place of its own accord would be taken for somebody who exchanges files."""
    image = np.full((8, 8, 3), 0.5, np.float32)
    write_layers(tmp_path / "a.exr", {"color": image})
    write_png(tmp_path / "a.png", image)
    write_movie(tmp_path / "a.webp", [np.zeros((8, 8, 3), np.uint8)] * 2, 24)
    assert read_exr(tmp_path / "a.exr").channel_names
    assert cv2.imread(str(tmp_path / "a.png")) is not None
    assert sorted(path.name for path in tmp_path.iterdir()) == ["a.exr", "a.png", "a.webp"]
    pytest.importorskip("av")
    write_movie(tmp_path / "a.mp4", [np.zeros((8, 8, 3), np.uint8)] * 2, 24)
    assert (tmp_path / "a.mp4").stat().st_size > 100


def test_where_nothing_can_be_locked_nothing_is_cleared(tmp_path, monkeypatch):
    def unsupported(*_):
        raise OSError(95, "Operation not supported")

    monkeypatch.setattr(replace, "lock_file", unsupported)
    with replace_file(tmp_path / "a") as temporary:
        temporary.write_text("whole")
        remove_leftovers(tmp_path)
        assert temporary.exists()
    assert (tmp_path / "a").read_text() == "whole"


@pytest.mark.posix
def test_a_folder_whose_lock_is_gone_is_cleared_and_links_to_folders_are_not(tmp_path):
    other = tmp_path / "other"
    other.mkdir()
    (other / "precious").touch()
    left = tmp_path / f".pass1.ravg-{16 * 'a'}.tmp"
    left.mkdir()
    (left / "frame").touch()
    (tmp_path / f".pass1.ravg-{16 * 'b'}.tmp").symlink_to(other)
    with temporary_folder(tmp_path / "pass1") as ours:
        assert ours.is_dir()
        assert not left.exists()
    assert (other / "precious").exists()


# --- what may not be written


@pytest.mark.posix
def test_an_output_is_no_input_by_any_name(tmp_path):
    source = tmp_path / "in" / "a"
    source.parent.mkdir()
    source.write_text("given")
    (tmp_path / "soft").symlink_to(source)
    (tmp_path / "folder").symlink_to(source.parent)
    os.link(source, tmp_path / "hard")
    names = [source, tmp_path / "soft", tmp_path / "hard", tmp_path / "folder" / "a", source.parent / ".." / "in" / "a"]
    for name in names:
        with pytest.raises(ValueError, match=r"preview .* would overwrite an input: weights"):
            check_outputs([("preview", name)], [("weights", source)])
    check_outputs([("preview", tmp_path / "new"), ("output", tmp_path / "other")], [("weights", source)])
    loop = tmp_path / "loop"
    loop.symlink_to(loop)
    check_outputs([("preview", loop)], [("weights", loop / "x")])
    with pytest.raises(ValueError, match="would overwrite an input"):
        check_outputs([("preview", loop)], [("weights", loop)])


@pytest.mark.posix
def test_two_outputs_are_two_files(tmp_path):
    (tmp_path / "in").mkdir()
    (tmp_path / "link").symlink_to(tmp_path / "in")
    with pytest.raises(ValueError, match=r"breakdown .*link/a' would overwrite preview .*in/a'"):
        check_outputs([("preview", tmp_path / "in" / "a"), ("breakdown", tmp_path / "link" / "a")], [])


def test_a_name_that_windows_keeps_for_itself_is_named(tmp_path, monkeypatch):
    monkeypatch.setattr(replace, "is_reserved", lambda path: path.name.startswith("aux"))
    with pytest.raises(OSError, match=r"aux\.0001\.exr: Windows does not take 'aux\.0001\.exr' as a name"):
        check_outputs([("output", tmp_path / "aux.0001.exr")], [])
    check_outputs([("output", tmp_path / "shot.0001.exr")], [])
