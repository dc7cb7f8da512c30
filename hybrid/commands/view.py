"""`ravg view`: a local page that plays frames, also while others are still being written."""

import os
import sys
import webbrowser

import typer

from hybrid.commands.log import LOG, one_line
from hybrid.commands.options import command
from hybrid.viewer.sequence import Sequence
from hybrid.viewer.server import ViewServer


@command("view")
def view(output: str, beside: list[str] | None = None, fps: float = 24, port: int = 0, browser: bool = True) -> None:
    """Serve the page until Ctrl-C."""
    sequences = [Sequence(output, finished=True), *(Sequence(spec, finished=False) for spec in beside or ())]
    if not any(sequence.files() for sequence in sequences):
        raise FileNotFoundError(f"no frames in {' or '.join(sequence.spec for sequence in sequences)}")
    for sequence in sequences[1:]:
        if not sequence.files():
            raise FileNotFoundError(f"no frames in {sequence.spec}")
    for sequence in sequences:
        sequence.check_sizes()
    with ViewServer(sequences, rate=fps, port=port, report=lambda error: LOG.error(one_line(error))) as server:
        typer.echo(f"{server.url}\nCtrl-C ends it")
        screen = sys.platform in ("darwin", "win32") or {"DISPLAY", "WAYLAND_DISPLAY"} & os.environ.keys()
        if browser and screen:
            webbrowser.open(server.url)
        try:
            server.serve_forever()
        except KeyboardInterrupt:
            typer.echo("")
