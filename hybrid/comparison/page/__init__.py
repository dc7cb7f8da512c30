"""Templates, style and scripts of the page that a comparison leaves.

Jinja2 fills the templates and escapes whatever a name may hold. The page is one file: its style sheet and its scripts
are put into it.
"""

from __future__ import annotations

from importlib.resources import files

from jinja2 import Environment, PackageLoader, StrictUndefined
from markupsafe import Markup

from hybrid.comparison.results import settings_as_text
from hybrid.comparison.tables import (
    column_title,
    format_bytes,
    format_change,
    format_seconds,
    format_value,
    format_worth,
)

# In this order they are one module script: each file is named after the part of the page that it runs.
SCRIPTS = ("dom.js", "chart.js", "pictures.js", "painter.js", "stage.js", "slices.js", "viewer.js", "controls.js",
           "loops.js", "start.js")  # fmt: skip

_templates = Environment(
    loader=PackageLoader("hybrid.comparison", "page"),
    autoescape=True,
    trim_blocks=True,
    lstrip_blocks=True,
    undefined=StrictUndefined,
)
_templates.policies["json.dumps_kwargs"] = {"ensure_ascii": False}  # keys stay in their order
_templates.filters |= {
    "column_title": column_title,
    "value": format_value,
    "change": format_change,
    "seconds": format_seconds,
    "bytes": format_bytes,
    "worth": format_worth,
    "settings": settings_as_text,
    "px": lambda length: f"{length:.1f}",
}


def render(template: str, **values: object) -> Markup:
    """Fill a template of this folder.

    Parameters
    ----------
    template : str
        The name of its file.
    **values : object
        What it asks for, by name. Text is escaped unless it is `markupsafe.Markup`.

    Returns
    -------
    Markup

    Raises
    ------
    jinja2.UndefinedError
        If it asks for something that is not given.
    """
    return Markup(_templates.get_template(template).render(values))


def style() -> Markup:
    """Return the page's style sheet."""
    return _source("report.css")


def script() -> Markup:
    """Return the page's scripts as the text of one module script."""
    return Markup("\n").join(_source(name) for name in SCRIPTS)


def _source(name: str) -> Markup:
    """A file of ours as it is: it holds no names."""
    return Markup((files(__name__) / name).read_text(encoding="utf-8"))
