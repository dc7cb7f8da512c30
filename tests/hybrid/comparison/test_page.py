"""The page's templates: whatever a name holds stays text."""

from __future__ import annotations

import json
from html.parser import HTMLParser
from importlib.resources import files
from pathlib import Path

import numpy as np
import pytest

jinja2 = pytest.importorskip("jinja2")

from hybrid.comparison import page  # noqa: E402
from hybrid.comparison.embedding import ReportImages  # noqa: E402
from hybrid.comparison.report import write_report  # noqa: E402
from hybrid.comparison.results import Comparison, MethodResult, summarize  # noqa: E402

HOSTILE = [
    "<script>alert(1)</script>",
    "</script><img src=x onerror=alert(1)>",
    "\"' onmouseover='alert(1)' x=\"",
    "--></style><b>",
    "{{ data }}{% raw %}{# ",
    "&lt;b&gt; & \\u003cb\\u003e",
]


class Outline(HTMLParser):
    """Elements of a page with the names of their attributes, and the text of those that hold data."""

    def __init__(self, text: str) -> None:
        super().__init__()
        self.elements: list[tuple[str, tuple[str, ...]]] = []
        self.data = ""
        self._inside = ""
        self.feed(text)

    def handle_starttag(self, tag: str, attrs: list[tuple[str, str | None]]) -> None:
        if tag != "text":  # names that find room on the chart
            self.elements.append((tag, tuple(name for name, _ in attrs)))
        self._inside = dict(attrs).get("id") or "" if tag == "script" else ""

    def handle_data(self, data: str) -> None:
        if self._inside == "data":
            self.data += data


def write(folder: Path, name: str) -> Outline:
    """A page in which everything that has a name has this one."""

    def result(suffix: str, **more: object) -> MethodResult:
        metrics = {"psnr": summarize([30.0, 31.0]), "temporal_psnr": summarize([29.0])}
        settings = {"settings": {name: name}, "family": name + suffix, "metrics": metrics, **more}
        return MethodResult(name + suffix, name + suffix, seconds_per_megapixel=1.0, peak_bytes=1 << 20, **settings)

    results = (
        result(""),
        result(" 2"),
        result(" 3", sweep=name, base=name),
        result(" 4", sweep="Stages", base=name, settings={name: "off"}),
        MethodResult("gone", name, absent_reason=name),
    )
    pictures = ReportImages(
        name,
        lambda number: np.ones((18, 32, 3), np.float32),
        {name: lambda number: np.zeros((18, 32), np.float32)},
    )
    path = write_report(
        folder,
        Comparison(name, results, {name: name}),
        [pictures],
        lambda number: np.ones((18, 32, 3), np.float32),
        [1, 2],
        others=[Comparison(name, results[:2])],
    )
    return Outline(path.read_text(encoding="utf-8"))


@pytest.mark.parametrize("name", HOSTILE)
def test_a_name_makes_no_element_and_no_attribute(tmp_path: Path, name: str) -> None:
    plain, hostile = write(tmp_path / "plain", "a name"), write(tmp_path / "hostile", name)
    assert len(plain.elements) > 200
    assert hostile.elements == plain.elements
    # The script reads the name as it is.
    data = json.loads(hostile.data)
    assert data["shot"] == name
    assert data["pictures"]["sources"][1] == {"name": name, "label": name, "maps": [name]}


def test_every_script_is_on_the_page_once() -> None:
    folder = files("hybrid.comparison.page")
    assert sorted(page.SCRIPTS) == sorted(item.name for item in folder.iterdir() if item.name.endswith(".js"))
    assert page.script().count("function startViewer(") == 1


def test_a_template_that_misses_something_is_an_error() -> None:
    with pytest.raises(jinja2.UndefinedError, match="chart"):
        page.render("chart.svg")
