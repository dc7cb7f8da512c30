"""The script that the report of `ravg compare` and the page of `ravg view` share: a player of two pictures."""

from importlib.resources import files


def script() -> str:
    """Return the text of the script; it defines `Player`, and functions for elements of a page."""
    return (files(__name__) / "player.js").read_text(encoding="utf-8")
