"""Results as text: formatted numbers, and tables for a terminal and for Markdown."""

import math
from collections.abc import Mapping, Sequence
from dataclasses import dataclass
from typing import Self

from rich.box import SIMPLE_HEAD
from rich.markup import escape
from rich.table import Table

from hybrid.comparison.ladder import RIVAL, Factor, factors
from hybrid.comparison.results import (
    CHART_METRICS,
    MARKDOWN_METRICS,
    METRICS,
    Comparison,
    Cost,
    Ladder,
    MethodResult,
    Metric,
    best_and_ties,
    present_metrics,
)


def format_value(value: float, metric: Metric) -> str:
    """Format a value with the digits of its metric, "–" for NaN."""
    if not math.isfinite(value):
        return "–" if math.isnan(value) else "∞" if value > 0 else "−∞"
    text = f"{value:.3g}" if metric.logarithmic else f"{value:.{metric.digits}f}"
    return text.replace("-", "−")


def format_change(value: float, metric: Metric) -> str:
    """Format a difference of two values, with its sign."""
    text = format_value(value, metric)
    return f"+{text}" if value > 0 else text


def format_seconds(value: float | None) -> str:
    """Format seconds with three significant digits, "–" where unknown."""
    if value is None:
        return "–"
    return "0" if value == 0 else f"{value:.3g}" if value < 100 else f"{value:.0f}"


def format_bytes(value: int | None) -> str:
    """Format memory in MiB or GiB, "–" where unknown."""
    if value is None:
        return "–"
    return f"{value / 2**20:.0f} MiB" if value < 2**30 else f"{value / 2**30:.2f} GiB"


def format_worth(value: float | None) -> str:
    """Format the worth in samples, "–" where unknown."""
    return "–" if value is None or math.isnan(value) else f"{value:.2g}×" if value < 10 else f"{value:.0f}×"


def format_factor(factor: Factor | None) -> str:
    """Format a factor on samples: "2.3×", ">16×" for more than it, "–" where unknown."""
    sign = {"": "", "more than": ">", "less than": "<"}
    return "–" if factor is None else sign[factor.bound] + format_worth(factor.value)


def column_title(metric: Metric) -> str:
    return f"{metric.label} ({metric.unit})" if metric.unit else metric.label


@dataclass(frozen=True)
class _Columns:
    """Columns of measures of one shot: results by name, and for each measure the best method and its ties."""

    results: Mapping[str, MethodResult]
    verdicts: Sequence[tuple[Metric, str | None, set[str]]]

    @classmethod
    def of(cls, results: Sequence[MethodResult], keys: Sequence[str]) -> Self:
        """The columns of the measures among `keys` that some result has."""
        metrics = [m for m in present_metrics(results, METRICS) if m.key in keys]
        return cls({r.name: r for r in results}, [(m, *best_and_ties(results, m)) for m in metrics])

    def cells(self, name: str, best: str, tie: str) -> list[str]:
        """Formatted means of a method; `best` and `tie` are formats of marked ones, such as "≈{}"."""
        cells = []
        for metric, best_name, ties in self.verdicts:
            statistic = self.results[name].metrics.get(metric.key) if name in self.results else None
            text = "–" if statistic is None else format_value(statistic.mean, metric)
            cells.append(best.format(text) if name == best_name else tie.format(text) if name in ties else text)
        return cells


def result_table(results: Sequence[MethodResult]) -> Table:
    """Build the terminal's table: the best of a column bold, ties marked "≈", reasons of absent methods below."""
    columns = _Columns.of(results, CHART_METRICS)
    # Within 80 columns names break between words, and numbers do not break.
    table = Table("method", box=SIMPLE_HEAD, padding=0, show_edge=False)
    for heading in (*(column_title(m) for m, *_ in columns.verdicts), "s / MP", "CPU-s / MP", "peak", "worth"):
        widest = len("1.23 GiB") if heading == "peak" else max(map(len, heading.split()))
        table.add_column(heading, justify="right", min_width=widest)
    for r in results:
        if r.absent_reason is not None:
            table.add_row(escape(r.name), *("–" for _ in table.columns[1:]), style="dim")
            continue
        costs = format_seconds(r.seconds_per_megapixel), format_seconds(r.cpu_seconds_per_megapixel)
        # Columns stay in line where a terminal lacks the sign.
        cells = [cell.replace("∞", "inf") for cell in columns.cells(r.name, "[bold]{}[/]", "≈{}")]
        table.add_row(escape(r.name), *cells, *costs, format_bytes(r.peak_bytes), format_worth(r.worth))
    absent = [f"{r.name}: {r.absent_reason}" for r in results if r.absent_reason is not None]
    if absent:
        table.caption = escape("absent – " + "; ".join(absent))
    return table


def ladder_rows(ladder: Ladder) -> list[list[str]]:
    """Return head and rows by method and measure: how many times its samples `RIVAL` needs; [] without it."""
    tables = {metric.label: factors(ladder[metric.key]) for metric in METRICS if metric.key in ladder}
    names = dict.fromkeys(name for table in tables.values() for name in table)
    counts = sorted({n for table in tables.values() for found in table.values() for n in found})
    rows = [
        [name, label, *(format_factor(table[name].get(n)) for n in counts)]
        for name in names
        for label, table in tables.items()
        if name in table
    ]
    head = [f"times its samples that {RIVAL} needs to equal", "by", *(f"{n:g} spp" for n in counts)]
    return [head, *rows] if rows else []


def ladder_table(rows: Sequence[Sequence[str]]) -> Table:
    (first, *titles), *cells = rows
    table = Table(first, box=SIMPLE_HEAD, padding=0, show_edge=False)
    for index, title in enumerate(titles):
        table.add_column(title, justify="right" if index else "left", no_wrap=True)
    for row in cells:
        table.add_row(*map(escape, row))
    return table


def markdown_table(comparisons: Sequence[Comparison], cost: Cost) -> str:
    """Write the README's table: measures on each shot, best bold, ties "≈", and the costs on the first one."""
    shots = [_Columns.of(c.results, MARKDOWN_METRICS) for c in comparisons]
    cpu = cost == "cpu_seconds_per_megapixel"
    heads = [
        f"{c.shot}: {' / '.join(column_title(m) for m, *_ in shot.verdicts)}"
        for c, shot in zip(comparisons, shots, strict=True)
    ]
    spent = f"{'CPU-s' if cpu else 's'} per megapixel-frame"
    titles = ["method", *heads, spent, "peak memory", "worth in samples"]
    rows, absent = [titles, ["---"] * len(titles)], []
    for name in dict.fromkeys(name for shot in shots for name in shot.results):
        present = [shot.results[name] for shot in shots if name in shot.results]
        first = present[0]
        if all(r.absent_reason is not None for r in present):
            absent.append([name, f"absent: {first.absent_reason}", *("" for _ in titles[2:])])
            continue
        measures = [" / ".join(shot.cells(name, "**{}**", "≈ {}")) for shot in shots]
        seconds = format_seconds(first.cpu_seconds_per_megapixel if cpu else first.seconds_per_megapixel)
        rows.append([name, *measures, seconds, format_bytes(first.peak_bytes), format_worth(first.worth)])
    return markdown_rows([*rows, *absent])


def markdown_rows(rows: Sequence[Sequence[str]]) -> str:
    """Return rows of cells as Markdown, without line breaks, escaped; a table's second row is its rule."""
    escapes = str.maketrans({"\\": "\\\\", "|": "\\|", "<": "&lt;"})
    return "".join(f"| {' | '.join(' '.join(c.split()).translate(escapes) for c in row)} |\n" for row in rows)
