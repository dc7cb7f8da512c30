"""`ravg view`: a local page that plays frames, also while others are still being written."""

import os
import sys
import webbrowser

import typer

from hybrid.commands.options import command
from hybrid.viewer.sequence import Sequence
from hybrid.viewer.server import ViewServer


@command("view")
def view(output: str, beside: list[str] | None = None, fps: float = 24, port: int = 0, browser: bool = True) -> None:
    """Play denoised frames beside noisy ones in a browser, also while they are being made.

    OUT may still be empty: frames appear as they are finished. The page is served to this machine alone and loads
    nothing from elsewhere. Ctrl-C ends the server.

    Example:

    ravg view out --beside "shot.####.exr"
    """
    sequences = [Sequence(output, finished=True), *(Sequence(spec, finished=False) for spec in beside or ())]
    if not any(sequence.files() for sequence in sequences):
        raise FileNotFoundError(f"no frames in {' or '.join(sequence.spec for sequence in sequences)}")
    for sequence in sequences[1:]:
        if not sequence.files():
            raise FileNotFoundError(f"no frames in {sequence.spec}")
    for sequence in sequences:
        sequence.check_sizes()
    with ViewServer(sequences, rate=fps, port=port) as server:
        typer.echo(f"{server.url}\nCtrl-C ends it")
        screen = sys.platform in ("darwin", "win32") or {"DISPLAY", "WAYLAND_DISPLAY"} & os.environ.keys()
        if browser and screen:
            webbrowser.open(server.url)
        try:
            server.serve_forever()
        except KeyboardInterrupt:
            typer.echo("")
