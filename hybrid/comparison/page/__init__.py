"""Templates of the report's page, which Jinja2 fills, and its style sheet and scripts, which the one file holds."""

from importlib.resources import files

from jinja2 import Environment, PackageLoader, StrictUndefined
from markupsafe import Markup

from hybrid import player
from hybrid.comparison import tables
from hybrid.comparison.results import settings_as_text

# In this order, after the player, they are one module script; each file is named after its part of the page.
SCRIPTS = ("figures.js", "chart.js", "pictures.js", "painter.js", "slices.js", "viewer.js", "animations.js", "start.js")

_templates = Environment(
    loader=PackageLoader("hybrid.comparison", "page"),
    autoescape=True,
    trim_blocks=True,
    lstrip_blocks=True,
    undefined=StrictUndefined,
)
_templates.policies["json.dumps_kwargs"] = {"ensure_ascii": False}  # without sorting keys
_templates.filters |= {
    "column_title": tables.column_title,
    "value": tables.format_value,
    "seconds": tables.format_seconds,
    "bytes": tables.format_bytes,
    "worth": tables.format_worth,
    "settings": settings_as_text,
}


def render(template: str, **values: object) -> Markup:
    """Fill a template of this folder; text is escaped, and a missing value raises `jinja2.UndefinedError`."""
    return Markup(_templates.get_template(template).render(values, style=_source("report.css"), script=script()))


def script() -> Markup:
    return Markup("\n").join([Markup(player.script()), *map(_source, SCRIPTS)])


def _source(name: str) -> Markup:
    """A file of ours, not escaped: it holds no names."""
    return Markup((files(__name__) / name).read_text(encoding="utf-8"))
