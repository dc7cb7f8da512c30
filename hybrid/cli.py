"""The command ``ravg``."""

from __future__ import annotations

import sys
from collections.abc import Sequence

import typer

from hybrid.commands.compare import compare
from hybrid.commands.denoise import denoise, pseudoref
from hybrid.commands.inspect import inspect
from hybrid.commands.options import printable
from hybrid.commands.simulate import simulate_command
from hybrid.commands.train import prepare_command, train_command
from hybrid.interrupt import INTERRUPTED, is_interrupt

app = typer.Typer(
    help="Denoise rendered animation, in time as well as in space.",
    no_args_is_help=True,
    add_completion=False,
    pretty_exceptions_enable=False,
)
for command in (inspect, pseudoref, denoise, compare):
    app.command()(command)
app.command("prepare")(prepare_command)
app.command("train")(train_command)
app.command("simulate")(simulate_command)


def main(argv: Sequence[str] | None = None) -> int:
    """Run the command; 0: done, 1: bad data (one line on standard error), 2: bad usage. A bug shows its traceback.

    Parameters
    ----------
    argv : sequence of str, optional
        Arguments; the process's own without.
    """
    try:
        app(args=None if argv is None else list(argv), prog_name="ravg")
    except SystemExit as stop:  # typer's way to return a code; it has shown usage errors itself
        return stop.code if isinstance(stop.code, int) else 0
    except (KeyboardInterrupt, SystemError) as error:
        if not is_interrupt(error):
            raise
        return INTERRUPTED
    except ModuleNotFoundError:
        raise  # a broken installation, not something optional that is missing
    except (ValueError, OSError, ImportError) as error:
        typer.echo(f"error: {_one_line(error)}", err=True)
        return 1
    return 0


def _one_line(error: Exception) -> str:
    if isinstance(error, OSError) and error.strerror and error.filename is not None:
        return printable(f"{error.filename}: {error.strerror}")
    return printable(" ".join(str(error).split()))


if __name__ == "__main__":
    sys.exit(main())
