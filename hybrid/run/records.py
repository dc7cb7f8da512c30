"""Records of runs, one JSON file each, and the status of a folder from all its records.

A farm makes a shot in chunks, on many machines at once. Every run writes a file of its own,
``OUT/ravg/NAME.RANGE.json``, after every frame, so that nothing is overwritten and nothing is lost when a machine dies.
"""

import hashlib
import json
import os
import platform
import re
import time
from collections.abc import Collection, Iterator, Mapping, Sequence
from dataclasses import dataclass, field
from pathlib import Path
from typing import Any

from hybrid.files.replace import remove_leftovers, write_file
from hybrid.files.sequences import format_frames
from hybrid.files.sources import PACKAGES, versions
from hybrid.runtime.system import peak_memory, process_lives
from hybrid.runtime.timing import Timings

FOLDER = "ravg"
NAMELESS = "frames"  # name of a sequence whose file names are numbers alone
ALL_PACKAGES = (*PACKAGES, "OpenEXR", "pyoidn", "torch")  # all packages whose versions are recorded
UNTRIED = "not tried"
STATES = "finished", "running", "failed", "missing", UNTRIED  # of a frame; missing: finished, and its file is gone


class Record:
    """The record of one run, rewritten after each frame.

    `name` is that of the sequence without number and extension, `facts` are known at the start. Raises ValueError if
    another file has the record's name, or the folder for records is a link.
    """

    def __init__(self, folder: Path, name: str, numbers: Sequence[int], **facts: object) -> None:
        if (folder / FOLDER).is_symlink():
            raise ValueError(f"{folder / FOLDER} is a link, expected a folder for records, or none yet")
        self.path = record_path(folder, name, numbers)
        if self.path.exists() and _read(self.path) is None:
            raise ValueError(f"{self.path} is there and no record of ravg, expected a name of its own")
        self._start = time.time()
        self._written = False
        self._document: dict[str, Any] = {
            "ravg": versions(*ALL_PACKAGES).get("ravg", "unknown"),
            **facts,
            "asked": list(numbers),
            "host": platform.node(),
            "process": os.getpid(),
            "python": platform.python_version(),
            "machine": platform.machine(),
            "versions": versions(*ALL_PACKAGES),
            "started": self._start,
            "state": "running",
            "frames": {},
        }

    def numbers(self, *states: str) -> list[int]:
        """Return the frames in one of these states (`add`), in the order in which they were added."""
        return [int(n) for n, entry in self._document["frames"].items() if entry["state"] in states]

    @property
    def frames(self) -> Mapping[int, Mapping[str, Any]]:
        """Frame → its state and facts (`add`)."""
        return {int(number): entry for number, entry in self._document["frames"].items()}

    def add(self, number: int, state: str, **facts: object) -> None:
        """Add a frame, whose state is "made", "there" (made by an earlier run) or "failed"."""
        self._document["frames"][str(number)] = {"state": state, **facts}

    def write(self, timings: Timings, state: str = "running", **facts: object) -> None:
        """Write the record; `state` is "running", "finished", "failed" or "stopped"."""
        now = time.time()
        self._document |= facts
        document = {
            **self._document,
            "state": state,
            "updated": now,
            "seconds": round(now - self._start, 3),
            "stages": timings.figures(),
            "peak_bytes": peak_memory(),
        }
        if not self._written:
            self.path.parent.mkdir(parents=True, exist_ok=True)
            remove_leftovers(self.path.parent)
            self._written = True
        write_file(self.path, json.dumps(document, indent=1, default=str) + "\n")


@dataclass
class Status:
    """State of the frames of a sequence, from the records of a folder."""

    # frame that some run was asked for → one of `STATES`, and the reason for it
    frames: dict[int, tuple[str, str]] = field(default_factory=dict)
    seconds: list[float] = field(default_factory=list)  # time of each frame that was made
    workers: int = 0  # number of live runs
    records: list[dict[str, Any]] = field(default_factory=list)  # oldest first

    def numbers(self, state: str) -> dict[int, str]:
        """Return the frames in this state, ascending, each with the reason for it."""
        return {n: why for n, (found, why) in sorted(self.frames.items()) if found == state}

    @property
    def left(self) -> int:
        """Number of frames that are not finished."""
        return len(self.frames) - len(self.numbers("finished"))

    @property
    def seconds_per_frame(self) -> float | None:
        """Mean time of the frames that were made; None if none was."""
        return sum(self.seconds) / len(self.seconds) if self.seconds else None

    @property
    def seconds_left(self) -> float | None:
        """Time for the unfinished frames with the current number of runs, or with one."""
        return None if self.seconds_per_frame is None else self.left * self.seconds_per_frame / max(self.workers, 1)


def record_path(folder: Path, name: str, numbers: Sequence[int]) -> Path:
    """Return the file of a run's record, as for `Record`."""
    return folder / FOLDER / f"{name or NAMELESS}.{_range(numbers)}.json"


def read_records(folder: Path, name: str | None = None) -> Iterator[tuple[Path, dict[str, Any]]]:
    """Yield the records in a folder of frames, or of a sequence there, with their files, oldest first."""
    paths = sorted((folder / FOLDER).glob("*.json")) if (folder / FOLDER).is_dir() else []
    if name is not None:
        paths = [path for path in paths if _sequence_of(path) == (name or NAMELESS)]
    records = [(path, document) for path in paths if (document := _read(path)) is not None]
    yield from sorted(records, key=lambda item: item[1]["started"])


def recorded_sequences(folder: Path) -> list[str]:
    """Return the names of the sequences in a folder that have records; FileNotFoundError if there are none."""
    if names := sorted({_sequence_of(path) for path, _ in read_records(folder)}):
        return names
    raise FileNotFoundError(
        f"{folder} has no records of runs in {folder / FOLDER}, expected the output folder of ravg denoise"
    )


def gather_status(folder: Path, name: str, frames: Collection[int] | None = None) -> Status:
    """Return the status of a sequence in a folder, of these frames or those that its runs were asked for."""
    status = Status(dict.fromkeys(frames or (), (UNTRIED, "")))
    for _, document in read_records(folder, name):
        status.records.append(document)
        alive = is_running(document)
        status.workers += alive
        for number in document["asked"] if frames is None else {*document["asked"]} & {*frames}:
            entry, before = document["frames"].get(str(number)), status.frames.get(number, (UNTRIED, ""))
            if entry is None and alive and before[0] != "finished":
                state = "running", ""
            elif entry is None:
                state = (UNTRIED, _why_untried(document)) if before[0] == UNTRIED else before
            elif entry["state"] == "failed":
                state = "failed", entry["error"]
            else:
                state = "finished" if (folder / entry["file"]).is_file() else "missing", ""
            status.frames[number] = state
            if entry is not None and entry["state"] == "made":
                status.seconds.append(entry["seconds"])
    return status


def _why_untried(document: Mapping[str, Any]) -> str:
    """Why a run that has ended did not come to a frame."""
    if document["state"] == "running":
        return f"the process of the run is gone ({document['process']} on {document['host']})"
    if "error" in document:
        last = [n for n, entry in document["frames"].items() if entry.get("error") == document["error"]]
        return f"the run ended at frame {last[-1]}" if last else f"the run ended: {document['error']}"
    return "the run was stopped" if document["state"] == "stopped" else ""


def _sequence_of(path: Path) -> str:
    return path.stem.rpartition(".")[0]


def is_running(document: Mapping[str, Any]) -> bool:
    """Return whether a run that has not recorded its end is alive; a run on another machine counts as alive."""
    if document["state"] != "running":
        return False
    return document["host"] != platform.node() or process_lives(document["process"])


def _read(path: Path) -> dict[str, Any] | None:
    """A record; None if the file is no record, or holds invalid values."""
    try:
        if not path.is_file():  # a pipe would be waited for
            return None
        document = json.loads(path.read_text(encoding="utf-8"))
        return document if _is_record(document) else None
    except (OSError, ValueError, RecursionError):
        return None


def _is_record(document: Any) -> bool:
    """Whether a document has all entries of a `Record` that are read elsewhere, with valid types and values."""
    if not isinstance(document, dict):
        return False
    get = document.get
    return (
        all(isinstance(text, str) for text in (get("state"), get("host"), get("ravg"), get("error", "")))
        and all(_is_amount(number) for number in (get("started"), get("updated", 0), get("peak_bytes", 0)))
        and type(get("process")) is int
        and 0 < document["process"] < 2**31
        and isinstance(get("asked"), list)
        and len(document["asked"]) > 0
        and all(type(number) is int and abs(number) < 2**63 for number in document["asked"])
        and isinstance(get("frames"), dict)
        and all(_is_entry(number, entry) for number, entry in document["frames"].items())
        and len(files := [e["file"] for e in document["frames"].values() if e["state"] != "failed"]) == len({*files})
    )


def _is_entry(number: str, entry: Any) -> bool:
    if not (re.fullmatch("-?[0-9]{1,19}", number) and isinstance(entry, dict)):
        return False
    if entry.get("state") == "failed":
        return isinstance(entry.get("error"), str)
    file = entry.get("file")
    # A bare name: a file in another folder is no frame of this one.
    plain = isinstance(file, str) and file not in ("", ".", "..") and not {"/", "\\", ":", "\0"} & {*file}
    return entry.get("state") in ("made", "there") and plain and _is_amount(entry.get("seconds"))


def _is_amount(value: Any) -> bool:
    """Whether this is a number of seconds or bytes."""
    return isinstance(value, int | float) and not isinstance(value, bool) and 0 <= value < 2**63


def _range(numbers: Sequence[int]) -> str:
    """The frames in the record's name: a long list by its ends and a hash."""
    text = format_frames(numbers).replace(":", "y")
    if len(text) <= 60:
        return text
    return f"{numbers[0]}-{numbers[-1]}_{hashlib.sha256(text.encode()).hexdigest()[:8]}"


def sequence_name(file: Path) -> str:
    """Return the name of a file's sequence: without number and extension."""
    behind = re.fullmatch(r"(|.*?[._-])-?[0-9]+[._-]([^0-9]*)", file.stem)  # 0001.beauty, view.0001.beauty
    return f"{behind[1]}{behind[2]}" if behind else re.sub(r"[._-]?-?[0-9]+$", "", file.stem)
