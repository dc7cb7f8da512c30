"""The command ``ravg``."""

import sys
from collections.abc import Sequence
from importlib import import_module
from importlib.metadata import version
from typing import Annotated, Any, NamedTuple

import typer
from typer.core import TyperCommand, TyperGroup

from hybrid.commands.log import LOG, end_log, one_line, start_log, tolerant_streams
from hybrid.run.option_texts import TEXTS
from hybrid.runtime.interrupt import INTERRUPTED, is_interrupt, stop_with_stdin, terminable
from hybrid.runtime.system import expand_home
from hybrid.runtime.threads import check_thread_counts, prepare_libraries


class Entry(NamedTuple):
    """A command: its function ``module:name``, its group in the help of all commands, and its own help."""

    function: str
    panel: str
    help: str

    @property
    def summary(self) -> str:
        return self.help.partition("\n")[0]


COMMANDS = {name: Entry(**entry) for name, entry in TEXTS["commands"].items()}


class Command(TyperCommand):
    """A command that recognises a pattern that a shell has expanded."""

    def parse_args(self, ctx: Any, args: list[str]) -> list[str]:
        """Parse the arguments; several files where one was expected ask for quotes."""
        files = [argument for argument in args if argument.lower().endswith(".exr")]
        try:
            return super().parse_args(ctx, args)
        except typer.BadParameter:
            raise
        except Exception as error:
            if len(files) > 1 and "unexpected extra argument" in str(getattr(error, "message", "")):
                said = f"{len(files)} files, of which {files[1]}"
                raise typer.BadParameter(f'expected one pattern in quotes, such as "*.exr", got {said}') from None
            raise


class LazyCommand(TyperCommand):
    """A command whose module is imported when it is run, or asked for its help; its line in the help needs neither."""

    def __init__(self, name: str, entry: Entry) -> None:
        super().__init__(name, help=entry.summary, rich_help_panel=entry.panel)
        self._entry = entry

    def load(self) -> Any:
        module, _, function = self._entry.function.partition(":")
        command = getattr(import_module(f"hybrid.commands.{module}"), function)
        single = typer.Typer(add_completion=False)
        single.command(self.name, cls=Command, help=self._entry.help)(command)
        loaded: Any = typer.main.get_command(single)
        for parameter in loaded.params:
            if getattr(parameter, "is_flag", False):
                parameter.metavar = " "  # no "<bool>" behind the name of a flag
        return loaded

    def make_context(self, info_name: str | None, args: list[str], parent: Any = None, **extra: Any) -> Any:
        return self.load().make_context(info_name, args, parent, **extra)


class Commands(TyperGroup):
    """The commands of `COMMANDS`."""

    def list_commands(self, ctx: Any) -> list[str]:
        return [*COMMANDS]

    def get_command(self, ctx: Any, cmd_name: str) -> Any:
        """A command; not yet imported."""
        return LazyCommand(cmd_name, COMMANDS[cmd_name]) if cmd_name in COMMANDS else None


app = typer.Typer(
    cls=Commands,
    no_args_is_help=True,
    pretty_exceptions_enable=False,
    context_settings={"help_option_names": ["-h", "--help"]},
)


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
    """Run the command; 0: done, 1: bad data (one line on standard error), 2: bad usage. A bug shows its traceback."""
    prepare_libraries()
    with tolerant_streams():
        start_log()  # until a command has read its options of the log
        try:
            return _run(argv)
        finally:
            end_log()


def _run(argv: Sequence[str] | None) -> int:
    try:
        stop_with_stdin()
        check_thread_counts()
        # Patterns are for ravg itself: on Windows typer would put the names of files in their place.
        with terminable():
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
