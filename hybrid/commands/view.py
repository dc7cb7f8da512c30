"""`ravg view`: a local page that plays frames, also while others are still being written."""

import os
import sys
import webbrowser
from typing import Annotated

import typer

from hybrid.commands.options import RateOption, of_input, of_output, of_resources
from hybrid.viewer.sequence import Sequence
from hybrid.viewer.server import ViewServer


def view(
    output: Annotated[str, typer.Argument(metavar="OUT", help="denoised frames: OUT.####.exr, or a folder")],
    beside: Annotated[
        list[str] | None,
        of_input(
            "frames to compare with, such as the noisy ones, or those of another denoiser; may be repeated",
            metavar="SHOT",
        ),
    ] = None,
    fps: RateOption = 24,
    port: Annotated[int, of_resources("port of the page; 0: any free port", min=0, max=65535)] = 0,
    browser: Annotated[bool, of_output("open the page in a browser, if there is a screen")] = True,
) -> None:
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
