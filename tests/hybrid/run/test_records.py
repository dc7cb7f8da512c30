import json
import os
import platform
from pathlib import Path

import pytest

from hybrid.cli import main
from hybrid.run.records import FOLDER, Record, gather_status, read_records, recorded_sequences, sequence_name
from hybrid.runtime.timing import Timings


def made(folder, record, *numbers, seconds=2.0):
    for number in numbers:
        name = f"shot.{number}.exr"
        (folder / name).touch()
        record.add(number, "made", file=name, seconds=seconds)
    record.write(Timings())


def test_runs_of_one_shot_write_one_record_each(tmp_path):
    for first in (1, 4, 7):
        made(tmp_path, Record(tmp_path, "shot", range(first, first + 3), command="denoise"), first)
    made(tmp_path, Record(tmp_path, "other", [1]), 1)
    assert sorted(path.name for path, _ in read_records(tmp_path)) == [
        "other.1.json",
        "shot.1-3.json",
        "shot.4-6.json",
        "shot.7-9.json",
    ]
    assert recorded_sequences(tmp_path) == ["other", "shot"]
    status = gather_status(tmp_path, "shot")
    assert [*status.frames] == [*range(1, 10)]
    assert [*status.numbers("finished")] == [1, 4, 7]
    assert [*status.numbers("running")] == [2, 3, 5, 6, 8, 9]
    assert status.workers == 3
    assert status.seconds_per_frame == 2
    assert status.seconds_left == 6 * 2 / 3


@pytest.mark.posix
def test_what_ended_is_not_running(tmp_path):
    for state, why in (("finished", ""), ("stopped", "the run was stopped")):
        record = Record(tmp_path, state, [1, 2])
        made(tmp_path, record, 1)
        record.write(Timings(), state)
        assert gather_status(tmp_path, state).numbers("not tried") == {2: why}
    record = Record(tmp_path, "killed", [1, 2])
    made(tmp_path, record, 1)
    document = json.loads(record.path.read_text())
    child = os.fork()
    if child == 0:
        os._exit(0)
    os.waitpid(child, 0)  # a process that is no more
    gone = f"the process of the run is gone ({child} on {platform.node()})"
    for host, state in ((platform.node(), ("not tried", gone)), ("elsewhere", ("running", ""))):
        record.path.write_text(json.dumps({**document, "process": child, "host": host}))
        assert gather_status(tmp_path, "killed").frames[2] == state


def test_a_later_run_overrules(tmp_path):
    first = Record(tmp_path, "shot", [1, 2, 3])
    made(tmp_path, first, 1)
    first.add(2, "failed", error="shot.2.exr: damaged")
    first.write(Timings())
    failed, status = ("failed", "shot.2.exr: damaged"), gather_status(tmp_path, "shot")
    assert (status.frames[2], status.frames[3]) == (failed, ("running", ""))
    first.write(Timings(), "failed", error="no space left")
    status = gather_status(tmp_path, "shot")
    assert (status.frames[2], status.frames[3]) == (failed, ("not tried", "the run ended: no space left"))
    second = Record(tmp_path, "shot", [2, 3])
    made(tmp_path, second, 2, 3)
    second.write(Timings(), "finished")
    status = gather_status(tmp_path, "shot")
    assert [*status.numbers("finished")] == [1, 2, 3]
    assert not status.left
    (tmp_path / "shot.3.exr").unlink()  # somebody has tidied up
    assert [*gather_status(tmp_path, "shot").numbers("missing")] == [3]


def test_frames_that_no_run_was_asked_for_are_not_tried_where_they_are_named(tmp_path):
    made(tmp_path, Record(tmp_path, "shot", [1, 2]), 1, 2)
    assert gather_status(tmp_path, "shot").left == 0
    assert gather_status(tmp_path, "shot", frames=range(1, 5)).numbers("not tried") == {3: "", 4: ""}
    assert [*gather_status(tmp_path, "shot", frames=[2]).frames] == [2]


def test_long_lists_of_frames_have_short_and_different_names(tmp_path):
    primes = [2, 3, 5, 7, 11, 13, 17, 19, 23, 29, 31, 37, 41, 43, 47, 53, 59, 61, 67, 71, 73, 79, 83, 89, 97]
    names = {Record(tmp_path, "shot", numbers).path.name for numbers in (primes, [*primes[:-2], 90, 97])}
    assert len(names) == 2
    assert all(len(name) < 40 for name in names)


def test_another_file_is_not_overwritten(tmp_path):
    path = Record(tmp_path, "shot", [1]).path
    path.parent.mkdir()
    path.write_text('{"frames": "mine"}')
    with pytest.raises(ValueError, match="no record of ravg"):
        Record(tmp_path, "shot", [1])
    assert path.read_text() == '{"frames": "mine"}'
    with pytest.raises(FileNotFoundError, match="no records"):
        recorded_sequences(tmp_path)


@pytest.mark.parametrize(
    "change",
    [
        lambda d: d.update(asked=None),
        lambda d: d.update(asked=[]),
        lambda d: d.update(asked=["1"]),
        lambda d: d.update(asked=[10**400]),
        lambda d: d.update(frames=[]),
        lambda d: d.update(started="yesterday"),
        lambda d: d.update(started=float("inf")),
        lambda d: d.update(state={}),
        lambda d: d.update(host=None),
        lambda d: d.update(process=-1),
        lambda d: d.update(process=10**30),
        lambda d: d.update(peak_bytes="much"),
        lambda d: d.update(error=[]),
        lambda d: d["frames"].update({"x": {"state": "made"}}),
        lambda d: d["frames"].update({"1": {"state": "made", "file": 3, "seconds": 1}}),
        lambda d: d["frames"].update({"1": {"state": "made", "file": "../1.exr", "seconds": 1}}),
        lambda d: d["frames"].update({"1": {"state": "made", "file": "/dev/null", "seconds": 1}}),
        lambda d: d["frames"].update({"1": {"state": "made", "file": "a\0", "seconds": 1}}),
        lambda d: d["frames"].update({"1": {"state": "made", "file": "..\\1.exr", "seconds": 1}}),
        lambda d: d["frames"].update({"1": {"state": "made", "file": "C:1.exr", "seconds": 1}}),
        lambda d: d["frames"].update({"1": {"state": "made", "file": "1.exr", "seconds": "x"}}),
        lambda d: d["frames"].update({"2": d["frames"]["1"]}),
        lambda d: d["frames"].update({"1": {"state": "failed"}}),
        lambda d: d["frames"].update({"1": None}),
    ],
)
def test_a_record_that_says_what_cannot_be_is_none(tmp_path, change):
    """Status ended in tracebacks, and believed in frames that lay elsewhere."""
    (tmp_path / "1.exr").touch()
    record = Record(tmp_path, "shot", [1])
    record.add(1, "made", file="shot.1.exr", seconds=1.0)
    record.write(Timings())
    assert len(list(read_records(tmp_path))) == 1
    document = json.loads(record.path.read_text())
    change(document)
    record.path.write_text(json.dumps(document))
    assert list(read_records(tmp_path)) == []
    with pytest.raises(ValueError, match="no record of ravg"):
        Record(tmp_path, "shot", [1])


@pytest.mark.parametrize("text", [b"", b"null", b"{}", b"[" * 100_000, b"\xff\xfe", b'{"ravg": 1, "asked": [1e999]}'])
def test_a_text_that_is_no_record_is_left_out(tmp_path, text):
    made(tmp_path, Record(tmp_path, "shot", [1]), 1)
    (tmp_path / FOLDER / "other.1.json").write_bytes(text)
    assert [*gather_status(tmp_path, "shot").numbers("finished")] == [1]


@pytest.mark.posix
@pytest.mark.parametrize("kind", ["pipe", "folder", "link to itself", "device"])
def test_what_is_no_file_among_the_records_is_left_out(tmp_path, kind):
    made(tmp_path, Record(tmp_path, "shot", [1]), 1)
    path = tmp_path / FOLDER / "other.1.json"
    if kind == "pipe":
        os.mkfifo(path)
    elif kind == "folder":
        path.mkdir()
    else:
        path.symlink_to("/dev/zero" if kind == "device" else path)
    assert [*gather_status(tmp_path, "shot").numbers("finished")] == [1]


@pytest.mark.parametrize(
    ("file", "name"), [("a.0001.exr", "a"), ("a_v2-7.exr", "a_v2"), ("done.exr", "done"), ("0001.exr", "")]
)
def test_names_of_sequences(tmp_path, file, name):
    assert sequence_name(tmp_path / file) == name


DRAFT = "--preset", "draft"


def run(capsys, *arguments):
    code = main([str(argument) for argument in arguments])
    captured = capsys.readouterr()
    return code, captured.out, captured.err


def test_status_prints_no_control_character_of_a_record(tmp_path, capsys):
    record = Record(tmp_path, "shot", [1])
    record.add(1, "failed", error="\x07\n[red]")
    record.write(Timings(), "failed")
    code, text, _ = run(capsys, "status", tmp_path)
    assert code == 1
    assert "[red]" in text
    assert all(sign.isprintable() or sign == "\n" for sign in text)


def test_status_of_two_chunks(shot_folder, tmp_path, capsys):
    out = tmp_path / "out" / "done.####.exr"
    words = ["denoise", shot_folder, "-o", out, "--preset", "draft"]
    assert run(capsys, *words, "--frames", "1001-1002")[0] == 0
    code, text, _ = run(capsys, "status", out)
    assert code == 0
    assert "finished: 2 of 2 frames, 1001-1002" in text
    code, text, _ = run(capsys, "status", out, "--frames", "1001-1003")
    assert code == 1
    assert "not tried: 1 of 3 frames, 1003" in text
    (shot_folder / "shot.1003.exr").write_bytes(b"damaged")
    assert run(capsys, *words, "--frames", "1003")[0] == 1
    code, text, _ = run(capsys, "status", out.parent, "--json")
    (document,) = json.loads(text)["sequences"]
    assert code == 1
    assert document["name"] == "done"
    assert document["finished"] == [1001, 1002]
    assert "shot.1003.exr" in document["not tried"]["1003"]  # it ended before its first frame
    first = document["records"][0]
    assert first["host"] == platform.node()
    assert {"ravg", "numpy", "numba"} <= first["versions"].keys()
    assert first["input"] == str(shot_folder)
    assert "color" in first["layers"]
    assert first["stages"]["write"]["peak_bytes"] > 0
    assert len(first["plan"]) > 5
    assert run(capsys, "status", tmp_path)[0] == 1
    assert FOLDER not in [path.name for path in tmp_path.iterdir()]


def test_sequences_of_one_folder_are_named_and_counted_apart(shot_folder, tmp_path, capsys):
    """Their frames were counted together: those of one hid that those of another had failed."""
    out = tmp_path / "out"
    for name, frames in (("left", "1001-1003"), ("right", "1001")):
        assert run(capsys, "denoise", shot_folder, "-o", out / f"{name}.####.exr", *DRAFT, "--frames", frames)[0] == 0
    victim = shot_folder / "shot.1002.exr"
    victim.write_bytes(victim.read_bytes()[:-2000])
    assert run(capsys, "denoise", shot_folder, "-o", out / "right.####.exr", *DRAFT, "--frames", "1001-1003")[0] == 1
    code, text, _ = run(capsys, "status", out)
    assert code == 1
    left, right = text.split("right", 1)
    assert left.startswith("left")
    assert "finished: 3 of 3 frames, 1001-1003" in left
    assert "failed: 1 of 3 frames, 1001" in right
    assert "not tried: 2 of 3 frames, 1002-1003: the run ended at frame 1001\n" in right
    assert run(capsys, "status", out / "other.####.exr")[2].endswith(
        "no records of other, expected one of left, right\n"
    )


@pytest.mark.parametrize(
    ("names", "expected"),
    [
        ("shot.0001 shot.-002 shot.1000", "shot"),
        ("shot0001 shot-0002", "shot"),
        ("0001 -0002", ""),
        ("0001.beauty -0001.beauty 0010.beauty", "beauty"),
        ("view.0001.beauty view.-0001.beauty", "view.beauty"),
        ("v2_final", "v2_final"),
        ("v2.beauty.0001", "v2.beauty"),
    ],
)
def test_all_files_of_a_sequence_have_one_name(names, expected):
    """Where more stands behind the number, each frame was of a sequence of its own."""
    assert {sequence_name(Path(f"{name}.exr")) for name in names.split()} == {expected}
