"""`ravg status`: the frames that runs have finished, and that are left."""

import json
import time
from pathlib import Path

import typer

from hybrid.commands import options as opt
from hybrid.commands.log import duration, print_table, printable
from hybrid.files.sequences import format_frames, parse_frames, parse_pattern
from hybrid.records import Status, gather_status, is_running, sequence_name


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
    found = gather_status(folder, name, asked)
    left = found.asked - found.finished
    if as_json:
        document = {
            **{name: sorted(getattr(found, name)) for name in ("asked", "finished", "running", "missing")},
            "failed": {str(number): found.failed[number] for number in sorted(found.failed)},
            "workers": found.workers,
            "seconds_per_frame": found.seconds_per_frame,
            "seconds_left": found.seconds_left if left else 0.0,
            "records": found.records,
        }
        typer.echo(json.dumps(document, indent=1))
    else:
        _show(found)
        for state, numbers in (("finished", found.finished), ("running", found.running), ("missing", found.missing)):
            if numbers:
                typer.echo(f"{state}: {len(numbers)} of {len(found.asked)} frames, {format_frames(numbers)}")
        for error in dict.fromkeys(found.failed.values()):
            numbers = {number for number, other in found.failed.items() if other == error}
            listed = f"{len(numbers)} of {len(found.asked)} frames, {format_frames(numbers)}"
            typer.echo(f"failed: {listed}: {printable(error)}")
        if found.seconds_per_frame is not None:
            words = f"{found.seconds_per_frame:.2f} s a frame"
            if left and found.seconds_left is not None:
                words += f"; about {duration(found.seconds_left)} left with {max(found.workers, 1)} running"
            typer.echo(words)
    if left:
        raise typer.Exit(1)


def _show(found: Status) -> None:
    rows = []
    for record in found.records:
        made = [entry["seconds"] for entry in record["frames"].values() if entry["state"] == "made"]
        state = record["state"] if record["state"] != "running" or is_running(record) else "died"
        row = (
            format_frames(record["asked"]),
            state,
            f"{len(made)} of {len(record['asked'])}",
            f"{sum(made) / len(made):.2f}" if made else "–",
            f"{record.get('peak_bytes', 0) / 2**20:.0f} MiB",
            str(record["host"]),
            time.strftime("%m-%d %H:%M:%S", time.localtime(record.get("updated", record["started"]))),
        )
        rows.append(row)
    print_table(("frames", "state", "made", "s a frame", "peak", "host", "last update"), rows)
