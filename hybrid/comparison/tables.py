"""Results as text: figures printed for people, and tables for a terminal, for Markdown and for spreadsheets."""

from __future__ import annotations

import csv
import io
import math
import re
from collections.abc import Sequence

from rich.box import SIMPLE_HEAD
from rich.markup import escape
from rich.table import Table

from hybrid.comparison.results import (
    CHART_METRICS,
    MARKDOWN_METRICS,
    METRICS,
    Comparison,
    Cost,
    MethodResult,
    Metric,
    best_and_ties,
    present_metrics,
    settings_as_text,
    to_json,
)

# Figures


def format_value(value: float, metric: Metric) -> str:
    """Print a figure as its metric asks for, "–" for NaN.

    Parameters
    ----------
    value : float
        The figure.
    metric : Metric
        Which says how many digits.

    Returns
    -------
    str
    """
    if not math.isfinite(value):
        return "–" if math.isnan(value) else "∞" if value > 0 else "−∞"
    text = f"{value:.3g}" if metric.logarithmic else f"{value:.{metric.digits}f}"
    return text.replace("-", "−")


def format_change(value: float, metric: Metric) -> str:
    """Print a difference of two figures, with its sign.

    Parameters
    ----------
    value : float
        The difference.
    metric : Metric
        Of the figures.

    Returns
    -------
    str
    """
    text = format_value(value, metric)
    return f"+{text}" if value > 0 else text


def format_seconds(value: float | None) -> str:
    """Print seconds with three significant digits, "–" where not known."""
    if value is None:
        return "–"
    return "0" if value == 0 else f"{value:.3g}" if value < 100 else f"{value:.0f}"


def format_bytes(value: int | None) -> str:
    """Print an amount of memory in MiB or GiB, "–" where not known."""
    if value is None:
        return "–"
    return f"{value / 2**20:.0f} MiB" if value < 2**30 else f"{value / 2**30:.2f} GiB"


def format_worth(value: float | None) -> str:
    """Print how many times the samples a method is worth, "–" where not known."""
    return "–" if value is None or math.isnan(value) else f"{value:.2g}×" if value < 10 else f"{value:.0f}×"


def column_title(metric: Metric) -> str:
    """Return the metric's label with its unit."""
    return f"{metric.label} ({metric.unit})" if metric.unit else metric.label


# Tables


def result_table(results: Sequence[MethodResult]) -> Table:
    """Lay the results of a shot out for a terminal.

    Parameters
    ----------
    results : sequence of MethodResult
        In the order of the rows.

    Returns
    -------
    rich.table.Table
        The best of a column bold, what ties with it marked "≈"; why methods are absent below.
    """
    columns = [m for m in present_metrics(results, METRICS) if m.key in CHART_METRICS]
    verdicts = {m.key: best_and_ties(results, m) for m in columns}
    # Within 80 columns names break between words, and no figure breaks.
    table = Table("method", box=SIMPLE_HEAD, padding=0, show_edge=False)
    for heading in (*map(column_title, columns), "s / MP", "CPU-s / MP", "peak", "worth"):
        widest = len("1.23 GiB") if heading == "peak" else max(map(len, heading.split()))
        table.add_column(heading, justify="right", min_width=widest)
    for r in results:
        if r.absent_reason is not None:
            table.add_row(escape(r.label), *("–" for _ in table.columns[1:]), style="dim")
            continue
        cells = []
        for m in columns:
            text = format_value(r.metrics[m.key].mean, m) if m.key in r.metrics else "–"
            best, ties = verdicts[m.key]
            cells.append(f"[bold]{text}[/]" if r.name == best else f"≈{text}" if r.name in ties else text)
        costs = format_seconds(r.seconds_per_megapixel), format_seconds(r.cpu_seconds_per_megapixel)
        table.add_row(escape(r.label), *cells, *costs, format_bytes(r.peak_bytes), format_worth(r.worth))
    absent = [f"{r.label}: {r.absent_reason}" for r in results if r.absent_reason is not None]
    if absent:
        table.caption = escape("absent – " + "; ".join(absent))
    return table


def markdown_table(comparisons: Sequence[Comparison], cost: Cost) -> str:
    """Lay the results of several shots out as the README's table.

    Parameters
    ----------
    comparisons : sequence of Comparison
        The shots: PSNR and temporal PSNR on each, then the costs on the first. Points of a sweep are left out.
    cost : str
        One of `COSTS`: CPU time, or another, with which wall time is shown.

    Returns
    -------
    str
        Markdown. The best of a column is bold, what ties with it is marked "≈"; absent methods follow with the reason.
    """
    columns = [m for m in METRICS if m.key in MARKDOWN_METRICS]
    tables = [{r.name: r for r in c.results if not r.sweep} for c in comparisons]
    shown = [present_metrics(list(table.values()), columns) for table in tables]
    verdicts = [
        {m.key: best_and_ties(list(table.values()), m) for m in row} for table, row in zip(tables, shown, strict=True)
    ]
    heads = [f"{c.shot}: {' / '.join(map(column_title, row))}" for c, row in zip(comparisons, shown, strict=True)]
    unit = {"cpu_seconds_per_megapixel": "CPU-s"}.get(cost, "s")
    titles = ["method", *heads, f"{unit} per megapixel-frame", "peak memory", "worth in samples"]
    lines = [titles, ["---", *("---" for _ in titles[1:])]]
    missing = []
    for name in dict.fromkeys(name for table in tables for name in table):
        first = next(table[name] for table in tables if name in table)
        if all(table[name].absent_reason is not None for table in tables if name in table):
            missing.append([first.label, f"absent: {first.absent_reason}", *("" for _ in titles[2:])])
            continue
        cells = [first.label]
        for table, row, verdict in zip(tables, shown, verdicts, strict=True):
            figures = []
            for m in row:
                statistic = table[name].metrics.get(m.key) if name in table else None
                text = "–" if statistic is None else format_value(statistic.mean, m)
                best, ties = verdict[m.key]
                figures.append(f"**{text}**" if name == best else f"≈ {text}" if name in ties else text)
            cells.append(" / ".join(figures))
        spent = first.cpu_seconds_per_megapixel if unit == "CPU-s" else first.seconds_per_megapixel
        cells += [format_seconds(spent), format_bytes(first.peak_bytes)]
        lines.append([*cells, format_worth(first.worth)])
    return "".join(f"| {' | '.join(_markdown_cell(c) for c in line)} |\n" for line in [*lines, *missing])


def _markdown_cell(text: str) -> str:
    return re.sub(r"\s+", " ", text).replace("\\", "\\\\").replace("|", "\\|").replace("<", "&lt;")


def to_csv(results: Sequence[MethodResult], metrics: Sequence[Metric]) -> str:
    """Write one row per method: settings as JSON, five columns per measure.

    Parameters
    ----------
    results : sequence of MethodResult
        The rows.
    metrics : sequence of Metric
        The measures.

    Returns
    -------
    str
        CSV with a head.
    """
    parts = ("mean", "minimum", "maximum", "low", "high")
    out = io.StringIO()
    writer = csv.writer(out, lineterminator="\n")
    facts = ["name", "label", "family", "sweep", "base", "absent_reason", "settings"]
    costs = ["seconds_per_megapixel", "seconds_low", "seconds_high", "cpu_seconds_per_megapixel", "peak_bytes", "worth"]
    writer.writerow([*facts, *costs, *(f"{m.key}_{part}" for m in metrics for part in parts)])
    for r in results:
        row: list[object] = [r.name, r.label, r.family, r.sweep, r.base, r.absent_reason]
        row += [to_json(settings_as_text(r)).strip(), r.seconds_per_megapixel]
        row += [*(r.spread or (None, None)), r.cpu_seconds_per_megapixel, r.peak_bytes, r.worth]
        for m in metrics:
            row += [getattr(r.metrics[m.key], p) if m.key in r.metrics else None for p in parts]
        writer.writerow(row)
    return out.getvalue()
