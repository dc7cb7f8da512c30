"""The files of a report: all of them, whole, and refused before any is written where something does not fit."""

# ruff: noqa: E402 - skipped by name without the extra `compare`

from __future__ import annotations

import csv
import json
from collections.abc import Callable
from pathlib import Path

import cv2
import numpy as np
import pytest

for _package in ("jinja2", "resvg_py", "font_manrope"):
    pytest.importorskip(_package)

from hybrid.comparison.embedding import ReportImages
from hybrid.comparison.report import check_report, write_report
from hybrid.comparison.results import Comparison
from tests.hybrid.comparison.outcomes import RESULTS, SWEPT, result


def scene(level: float, shape: tuple[int, int] = (18, 32)) -> Callable[[int], np.ndarray]:
    """Flat pictures that grow brighter with the frame's number."""
    return lambda number: np.full((*shape, 3), level * (1 + 0.5 * (number - 8)), np.float32)


def test_every_file_is_written_and_readable(tmp_path: Path) -> None:
    page = write_report(tmp_path / "a" / "b", Comparison("Hall", RESULTS, {"Machine": "two cores"}))
    folder = page.parent
    names = {p.name for p in folder.iterdir()}
    assert names == {"report.html", "results.json", "results.csv", "results.md", "chart.png"}
    document = json.loads((folder / "results.json").read_text(encoding="utf-8"))
    assert document["fronts"]["psnr seconds_per_megapixel"] == ["noisy", "average", "final"]
    assert document["results"][3]["settings"] == {"window": "5"}
    rows = list(csv.DictReader((folder / "results.csv").open(encoding="utf-8", newline="")))
    assert [float(r["psnr_mean"]) for r in rows[:5]] == [22.0, 28.0, 27.0, 34.0, 33.0]
    assert rows[5]["absent_reason"] == "torch is not installed"
    picture = cv2.imread(str(folder / "chart.png"))
    assert picture is not None
    assert picture.shape[1] == 1600
    text = page.read_text(encoding="utf-8")
    assert "torch is not installed" in text
    assert "two cores" in text


def test_the_page_shows_stages_sweeps_and_other_shots(tmp_path: Path) -> None:
    other = Comparison("Yard", (result("final", 30.0, 1.0), result("average", 31.0, 1.0)))
    page = write_report(tmp_path, Comparison("Hall", SWEPT), others=[other])
    text = page.read_text(encoding="utf-8")
    assert "What each stage buys" in text
    assert "+1.00" in text
    assert "Sweep of Window: 2 settings" in text
    assert "All shots" in text
    assert "Yard" in text
    assert "Yard: PSNR" in (tmp_path / "results.md").read_text(encoding="utf-8")
    alone = write_report(tmp_path, Comparison("Hall", RESULTS)).read_text(encoding="utf-8")
    assert "What each stage buys" not in alone
    assert "All shots" not in alone


def test_what_does_not_fit_together_is_refused(tmp_path: Path) -> None:
    picture = [ReportImages("average", scene(1.0))]
    with pytest.raises(ValueError, match="'noisy' appears 2 times"):
        write_report(tmp_path, Comparison("x", (RESULTS[0], RESULTS[0])))
    with pytest.raises(ValueError, match="'nobody' belong to no result"):
        write_report(tmp_path, Comparison("x", RESULTS), [ReportImages("nobody", scene(1.0))], scene(1.0), [8])
    with pytest.raises(ValueError, match="need a reference"):
        write_report(tmp_path, Comparison("x", RESULTS), picture)
    with pytest.raises(ValueError, match=r"average has the shape \(18, 32, 3\), expected \(18, 30, 3\)"):
        write_report(tmp_path, Comparison("x", RESULTS), picture, scene(1.0, (18, 30)), [8])
    assert not any(tmp_path.iterdir())  # refused before anything was written


def test_what_no_comparison_has_left_is_not_written_over(tmp_path: Path) -> None:
    comparison = Comparison("Hall", RESULTS)
    (tmp_path / "results.csv").write_text("mine")
    with pytest.raises(ValueError, match=r"results\.csv is there, and of no earlier comparison"):
        write_report(tmp_path, comparison)
    assert [path.name for path in tmp_path.iterdir()] == ["results.csv"]
    (tmp_path / "results.csv").unlink()
    write_report(tmp_path, comparison)
    write_report(tmp_path, comparison)  # over its own
    with pytest.raises(ValueError, match=r"report .* would overwrite an input: results"):
        check_report(tmp_path, [tmp_path / "results.json"])
