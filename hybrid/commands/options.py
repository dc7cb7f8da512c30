"""How parameters of commands become options, and options that commands share. Loads neither numpy nor rich."""

import inspect
import math
import re
from collections.abc import Callable, Iterator
from contextlib import contextmanager
from dataclasses import MISSING, dataclass, fields
from functools import wraps
from pathlib import Path
from typing import Annotated, Any, Literal, TypeVar, get_args, get_origin, get_type_hints

import typer

from hybrid.commands.log import LogFormat, start_log
from hybrid.run.option_texts import option_texts

Thing = TypeVar("Thing")
Device = Literal["auto", "cpu", "cuda", "hip", "sycl", "metal"]

# Suffixes of images and movies that no folder has: an output named so asks for a format that is not written.
_OTHER_KINDS = re.compile(r"\.(avi|bmp|dpx|gif|hdr|jpe?g|mkv|mov|mp4|pfm|png|tga|tiff?|webp)", re.IGNORECASE)


@dataclass(frozen=True)
class LogOptions:
    """Options of the log that every command has."""

    log_format: LogFormat = "text"
    log_file: Path | None = None
    quiet: bool = False
    verbose: bool = False


def command(name: str, *configs: type) -> Callable[[Callable[..., None]], Callable[..., None]]:
    """Make a function a command: with options for its parameters and for fields of dataclasses, and with a log.

    `hybrid.run.option_texts` describes the options; a field without an entry or a default is none. The function gets
    the values of fields by keyword. A function in the `Annotated` of a parameter checks its value.
    """
    texts = option_texts(name)

    def decorate(function: Callable[..., None]) -> Callable[..., None]:
        own = inspect.signature(function, eval_str=True).parameters

        @wraps(function)
        def run(context: typer.Context, **arguments: Any) -> None:
            options = LogOptions(**take(LogOptions, arguments))
            if options.quiet and options.verbose:
                raise typer.BadParameter("expected --quiet or --verbose, got both")
            start_log(options.log_format, options.log_file, quiet=options.quiet, verbose=options.verbose)
            function(**arguments, **({"context": context} if "context" in own else {}))

        keyword = inspect.Parameter.KEYWORD_ONLY
        parameters = {item.name: item for item in own.values() if item.kind is not inspect.Parameter.VAR_KEYWORD}
        for config in (*configs, LogOptions):
            hints = get_type_hints(config, include_extras=True)
            for item in fields(config):
                if item.name in texts and item.name not in parameters and item.default is not MISSING:
                    field = inspect.Parameter(item.name, keyword, default=item.default, annotation=hints[item.name])
                    parameters[item.name] = field
        context = inspect.Parameter("context", keyword, annotation=typer.Context)
        options = [_as_option(item, dict(texts[key])) for key, item in parameters.items() if key != "context"]
        run.__signature__ = inspect.Signature([*options, context])  # type: ignore[attr-defined]
        return run

    return decorate


def _as_option(parameter: inspect.Parameter, settings: dict[str, Any]) -> inspect.Parameter:
    """Give a parameter the annotation that typer reads."""
    annotation = parameter.annotation
    kind, *checks = get_args(annotation) if get_origin(annotation) is Annotated else (annotation,)
    panel, names = settings.pop("panel"), settings.pop("names", [f"--{parameter.name.replace('_', '-')}"])
    settings["callback"] = next(iter(checks), None)
    if panel == "Arguments":
        option = typer.Argument(**settings)
    else:
        option = typer.Option(*names, rich_help_panel=panel, show_default=parameter.default != "", **settings)
    return parameter.replace(annotation=Annotated[kind, option])


def take(config: type, settings: dict[str, Any]) -> dict[str, Any]:
    """Remove the values of a dataclass's fields from a command's settings, and return them."""
    return {item.name: settings.pop(item.name) for item in fields(config) if item.name in settings}


def check_output(output: str) -> str:
    """Refuse a name that is neither a sequence of EXR files nor a folder."""
    if not output.strip():
        raise typer.BadParameter("it is empty, expected OUT.####.exr, or a folder")
    if _OTHER_KINDS.fullmatch(Path(output).suffix) and not Path(output).is_dir():
        raise typer.BadParameter(f"it is {output!r}, expected OUT.####.exr, or a folder: frames are written as OpenEXR")
    return output


def check_first_pass(spec: str) -> str:
    """Refuse a first pass as `hybrid.run.job.check_first_pass`."""
    from hybrid.run.job import check_first_pass as check

    with usage():
        check(spec)
    return spec


def choose(table: dict[str, Thing], name: str, option: str) -> Thing:
    """Return an entry of a table; BadParameter with its keys where there is none."""
    if name not in table:
        raise typer.BadParameter(f"--{option} is {name!r}, expected one of {', '.join(table)}")
    return table[name]


def split_number(item: str) -> tuple[str, float | None]:
    """Split NAME=NUMBER at the last "="; None in place of what is no number above 0."""
    name, _, text = item.rpartition("=")
    try:
        number = float(text)
    except ValueError:
        number = math.nan
    return name, number if 0 < number < math.inf else None


@contextmanager
def usage() -> Iterator[None]:
    """Turn ValueError about an option into bad usage, exit code 2."""
    try:
        yield
    except ValueError as error:
        raise typer.BadParameter(str(error)) from None
