"""`ravg status`: the frames that runs have finished, and that are left."""

import json
import time
from pathlib import Path

import typer

from hybrid.commands import options as opt
from hybrid.commands.log import duration, print_table, printable
from hybrid.files.sequences import format_frames, parse_frames, parse_pattern
from hybrid.run.records import (
    NAMELESS,
    STATES,
    UNTRIED,
    Status,
    gather_status,
    is_running,
    recorded_sequences,
    sequence_name,
)


@opt.command("status")
def status(output: str, frames: str | None = None, as_json: bool = False) -> None:
    """Print the status of the runs; exit with 1 if frames are left."""
    folder, name = Path(output), None
    if not folder.is_dir():
        if folder.suffix != ".exr":
            raise FileNotFoundError(
                f"{output} is no folder, expected the output folder of ravg denoise, or OUT.####.exr"
            )
        pattern, _ = parse_pattern(output)
        folder, name = pattern.folder, sequence_name(pattern.path(1))
    with opt.usage():
        asked = None if frames is None else parse_frames(frames)
    names = recorded_sequences(folder)
    if name is not None and (name or NAMELESS) not in names:
        raise FileNotFoundError(f"{folder} has no records of {name or NAMELESS}, expected one of {', '.join(names)}")
    found = {n: gather_status(folder, n, asked) for n in (names if name is None else [name or NAMELESS])}
    if as_json:
        typer.echo(json.dumps({"sequences": [{"name": n, **_document(each)} for n, each in found.items()]}, indent=1))
    else:
        for sequence, each in found.items():
            _show(sequence, each)
    if any(each.left for each in found.values()):
        raise typer.Exit(1)


def _document(found: Status) -> dict[str, object]:
    """The status as JSON: lists of frames, and those with reasons by frame."""
    with_reasons = "failed", UNTRIED
    return {
        "asked": sorted(found.frames),
        **{state: found.numbers(state) if state in with_reasons else [*found.numbers(state)] for state in STATES},
        "workers": found.workers,
        "seconds_per_frame": found.seconds_per_frame,
        "seconds_left": found.seconds_left if found.left else 0.0,
        "records": found.records,
    }


def _show(name: str, found: Status) -> None:
    """Print a table of the runs of a sequence, and the state of its frames."""
    rows = []
    for record in found.records:
        made = [entry["seconds"] for entry in record["frames"].values() if entry["state"] == "made"]
        row = (
            format_frames(record["asked"]),
            record["state"] if record["state"] != "running" or is_running(record) else "process gone",
            f"{len(made)} of {len(record['asked'])}",
            f"{sum(made) / len(made):.2f}" if made else "–",
            f"{record.get('peak_bytes', 0) / 2**20:.0f} MiB",
            str(record["host"]),
            time.strftime("%m-%d %H:%M:%S", time.localtime(record.get("updated", record["started"]))),
        )
        rows.append(row)
    print_table(("frames", "state", "made", "s a frame", "peak", "host", "last update"), rows, printable(name))
    for state in STATES:
        reasons = found.numbers(state)
        for reason in dict.fromkeys(reasons.values()):
            numbers = [number for number, why in reasons.items() if why == reason]
            words = f"{state}: {len(numbers)} of {len(found.frames)} frames, {format_frames(numbers)}"
            typer.echo(f"{words}: {printable(reason)}" if reason else words)
    if found.seconds_per_frame is not None:
        words = f"{found.seconds_per_frame:.2f} s a frame"
        if found.left and found.seconds_left is not None:
            words += f"; about {duration(found.seconds_left)} left with {max(found.workers, 1)} running"
        typer.echo(words)
