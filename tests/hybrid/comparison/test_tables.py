import io
import math
from dataclasses import replace

import pytest
from rich.console import Console

from hybrid.comparison.results import CHART_METRICS, METRICS, Comparison, MethodResult, Metric, summarize
from hybrid.comparison.tables import (
    format_bytes,
    format_change,
    format_seconds,
    format_value,
    format_worth,
    ladder_rows,
    ladder_table,
    markdown_table,
    result_table,
)
from tests.hybrid.comparison.outcomes import EVIL, PSNR, RELMSE, RESULTS, SECONDS, result


def test_markdown_marks_the_best_and_keeps_a_name_in_its_cell() -> None:
    evil = replace(RESULTS[1], name=EVIL)
    other = Comparison("Other", (result("final", 30.0, 1.0), result("average", 31.0, 1.0)))
    rows = markdown_table([Comparison("Hall", (*RESULTS, evil)), other], SECONDS).splitlines()
    assert "| **34.00** | **" not in rows[5]
    assert "| **34.00** | 30.00 | 4 |" in rows[5]  # the costs are the first shot's
    assert "14×" in rows[5]
    assert "| 28.00 | **31.00** |" in rows[3]
    assert "<" not in rows[7]
    assert "absent: torch is not installed" in rows[8]
    bars = {row.replace("\\|", "").count("|") for row in rows}
    assert len(bars) == 1  # every row has as many cells as the head


def printed(results: tuple[MethodResult, ...]) -> str:
    console = Console(width=200, record=True, file=io.StringIO())
    console.print(result_table(results))
    return console.export_text()


def test_a_terminal_sees_every_method_and_why_one_is_absent() -> None:
    text = printed(RESULTS)
    for r in RESULTS:
        assert f"{r.name} " in text
    assert "absent – gone: torch is not installed" in text
    row = next(line for line in text.splitlines() if line.startswith("final "))
    assert "34.00" in row
    assert " 4 " in row
    assert "600 MiB" in row
    assert "14×" in row


def test_no_figure_and_no_word_breaks_at_80_columns() -> None:
    shown = [m for m in METRICS if m.key in CHART_METRICS]
    assert len(shown) == 4
    values = {"psnr": 42.27, "temporal_psnr": 44.92, "relmse": 0.0123, "flip": 0.0456}
    full = replace(
        result("aligned robust average", 42.27, 1.0),
        metrics={m.key: summarize([values[m.key]]) for m in shown},
        seconds_per_megapixel=24.7,
        cpu_seconds_per_megapixel=48.1,
        peak_bytes=int(1.23 * 2**30),
        worth=14.0,
    )
    console = Console(width=80, record=True, file=io.StringIO())
    console.print(result_table([full, replace(full, name="other")]))  # they tie, which takes a sign more
    lines = console.export_text().splitlines()
    figures = ["≈42.27", "≈44.92", "≈0.0123", "≈0.0456", "24.7", "48.1", "1.23 GiB", "14×"]
    assert any(all(figure in line for figure in figures) for line in lines)
    assert all(word in "\n".join(lines) for word in ("aligned", "robust", "average", "Temporal", "worth"))
    assert "…" not in "\n".join(lines)


def test_a_ladder_has_a_column_for_each_level_and_a_factor_for_each_measure() -> None:
    rival, ours = ((8, 0.4), (32, 0.1)), ((8, 0.2), (32, 0.05))
    rows = ladder_rows({"flip": {"OIDN best": rival, "a": ours}, "psnr": {"OIDN best": rival, "a": ours[:1]}})
    head = ["times its samples that OIDN best needs to equal", "by", "8 spp", "32 spp"]
    assert rows == [head, ["a", "PSNR", "2×", "–"], ["a", "FLIP", "2×", ">1×"]]
    console = Console(width=60, record=True, file=io.StringIO())
    console.print(ladder_table(rows))
    assert [line.split() for line in console.export_text().splitlines()][-2:] == rows[1:]
    assert ladder_rows({"psnr": {"noisy": rival, "a": ours}}) == ladder_rows({}) == []


@pytest.mark.parametrize("name", ["[/bold] [red]", "[link=x]y", "a\\[b]"])
def test_markup_in_a_name_is_shown_as_it_is(name: str) -> None:
    """It raised an error, or took a part of the name away."""
    text = printed((result(name, 30.0, 1.0), MethodResult(f"{name} 2", absent_reason=name)))
    assert [line.startswith(f"{name} ") for line in text.splitlines()].count(True) == 2
    assert f"absent – {name} 2: {name}" in text


def test_figures_are_printed_as_their_metric_asks() -> None:
    digits = Metric("x", "X", digits=4)
    assert [format_value(v, PSNR) for v in (34.126, -1.0, math.inf, -math.inf, math.nan)] == [
        "34.13", "−1.00", "∞", "−∞", "–",
    ]  # fmt: skip
    assert (format_value(0.123456, digits), format_value(0.00123456, RELMSE)) == ("0.1235", "0.00123")
    assert [format_change(v, PSNR) for v in (1.0, -1.0, 0.0, math.nan)] == ["+1.00", "−1.00", "0.00", "–"]
    assert [format_seconds(v) for v in (None, 0, 1.2345, 99.96, 1234.5)] == ["–", "0", "1.23", "100", "1234"]
    assert [format_bytes(v) for v in (None, 77 << 20, 3 << 29)] == ["–", "77 MiB", "1.50 GiB"]
    assert [format_worth(v) for v in (None, math.nan, 4.26, 14.2)] == ["–", "–", "4.3×", "14×"]
