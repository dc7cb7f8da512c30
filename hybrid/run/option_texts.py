"""Names and help texts of the commands' options, for the command line and for Python: ``options.toml``."""

import tomllib
from importlib.resources import files
from typing import Any

TEXTS: dict[str, Any] = tomllib.loads((files("hybrid.run") / "options.toml").read_text(encoding="utf-8"))


def option_texts(command: str) -> dict[str, dict[str, Any]]:
    """Return the settings of each option that a command may have, by parameter: panel, help, and others of typer's."""
    texts = {}
    for table in (TEXTS["shared"], TEXTS.get(command, {})):
        for panel, entries in table.items():
            for name, entry in entries.items():
                settings = {"help": entry} if isinstance(entry, str) else entry
                texts[name] = {"panel": panel, **settings}
    return texts
