"""The command ``ravg``."""

from __future__ import annotations

import os
import sys
from collections.abc import Sequence
from importlib.metadata import version
from typing import Annotated, Any

import typer
from typer.core import TyperCommand

from hybrid.commands.compare import compare
from hybrid.commands.denoise import denoise, pseudoref
from hybrid.commands.inspect import inspect
from hybrid.commands.log import LOG, end_log, lasting_streams, logged, one_line, start_log
from hybrid.commands.simulate import simulate
from hybrid.commands.status import status
from hybrid.commands.train import prepare, train
from hybrid.commands.view import view
from hybrid.runtime.interrupt import INTERRUPTED, is_interrupt, stop_with_stdin
from hybrid.runtime.system import expand_home
from hybrid.runtime.threads import check_thread_counts, let_waiting_threads_sleep

# Where numba looks for a folder for compiled loops: its own list, and after that ours.
FOLDERS = "UserProvidedCacheLocator,InTreeCacheLocator,UserWideCacheLocator,hybrid.runtime.compiled.Fallback"


class Command(TyperCommand):
    """A command that says what to do where a shell has replaced a pattern by the names of files."""

    def parse_args(self, ctx: Any, args: list[str]) -> list[str]:
        """Parse the arguments; of several files where one was expected, say that the pattern is to be quoted."""
        files = [argument for argument in args if argument.lower().endswith(".exr")]
        try:
            return super().parse_args(ctx, args)
        except typer.BadParameter:
            raise
        except Exception as error:
            if len(files) > 1 and "unexpected extra argument" in str(getattr(error, "message", "")):
                said = f"{len(files)} files, of which {files[1]}"
                raise typer.BadParameter(f"expected one pattern in quotes, such as '*.exr', got {said}") from None
            raise


app = typer.Typer(
    no_args_is_help=True,
    pretty_exceptions_enable=False,
    context_settings={"help_option_names": ["-h", "--help"]},
)
for command, panel in (
    (inspect, "Frames"),
    (denoise, "Frames"),
    (pseudoref, "Frames"),
    (view, "Frames"),
    (status, "Frames"),
    (compare, "Frames"),
    (prepare, "Networks"),
    (train, "Networks"),
    (simulate, "Networks"),
):
    app.command(cls=Command, rich_help_panel=panel)(logged(command))


def _show_version(asked: bool) -> None:
    if asked:
        typer.echo(f"ravg {version('ravg')}")
        raise typer.Exit


@app.callback()
def ravg(
    version: Annotated[
        bool, typer.Option("--version", is_eager=True, callback=_show_version, help="Show the version, and no more.")
    ] = False,
) -> None:
    """Denoise rendered animation, in time as well as in space."""


def main(argv: Sequence[str] | None = None) -> int:
    """Run the command; 0: done, 1: bad data (one line on standard error), 2: bad usage. A bug shows its traceback.

    Parameters
    ----------
    argv : sequence of str, optional
        Arguments; the process's own without.
    """
    os.environ.setdefault("NUMBA_CACHE_LOCATOR_CLASSES", FOLDERS)
    let_waiting_threads_sleep()
    with lasting_streams():
        start_log()  # until a command has read how it is to tell things
        try:
            return _run(argv)
        finally:
            end_log()


def _run(argv: Sequence[str] | None) -> int:
    try:
        stop_with_stdin()
        check_thread_counts()
        # Patterns are for ravg itself: on Windows typer would put the names of files in their place.
        app(args=expand_home(sys.argv[1:] if argv is None else argv), prog_name="ravg", windows_expand_args=False)
    except SystemExit as stop:  # typer's way to return a code; it has shown usage errors itself
        return stop.code if isinstance(stop.code, int) else 0
    except (KeyboardInterrupt, SystemError) as error:
        if not is_interrupt(error):
            raise
        return INTERRUPTED
    except ModuleNotFoundError:
        raise  # a broken installation, not something optional that is missing
    except Exception as error:
        if _is_lack_of_memory(error):
            words = one_line(error)  # numpy says how much it was; others say nothing
            said = f" ({words})" if words else ""
            LOG.error(f"not enough memory{said}: --max-memory works on a part of a frame at a time")
            return 1
        if not isinstance(error, ValueError | OSError | ImportError):
            raise
        LOG.error(one_line(error))
        return 1
    return 0


def _is_lack_of_memory(error: Exception) -> bool:
    """Whether memory was refused; OpenCV and torch have errors of their own for that."""
    return isinstance(error, MemoryError) or (
        (type(error).__module__ == "cv2" or isinstance(error, RuntimeError))
        and any(words in str(error) for words in ("Insufficient memory", "can't allocate memory", "out of memory"))
    )


if __name__ == "__main__":
    sys.exit(main())
