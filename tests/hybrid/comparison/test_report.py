"""The files of a report: all of them, whole, and refused before any is written where something does not fit."""

# ruff: noqa: E402 - skipped by name without the extra `compare`

import json
from collections.abc import Callable
from pathlib import Path

import cv2
import numpy as np
import pytest

for _package in ("jinja2", "matplotlib"):
    pytest.importorskip(_package)

from hybrid.comparison.embedding import MethodImages, ShotImages
from hybrid.comparison.report import Report, check_report, write_report
from hybrid.comparison.results import COSTS, Comparison, Cost, read_comparison
from tests.hybrid.comparison.outcomes import RESULTS, result


def scene(level: float, shape: tuple[int, int] = (18, 32)) -> Callable[[int], np.ndarray]:
    """Flat pictures that grow brighter with the frame's number."""
    return lambda number: np.full((*shape, 3), level * (1 + 0.5 * (number - 8)), np.float32)


def test_every_file_is_written_and_readable(tmp_path: Path) -> None:
    page = write_report(tmp_path / "a" / "b", Report(Comparison("Hall", RESULTS, {"Machine": "two cores"})))
    folder = page.parent
    names = {p.name for p in folder.iterdir()}
    assert names == {"report.html", "results.json", "chart.png"}
    document = json.loads((folder / "results.json").read_text(encoding="utf-8"))
    assert document["fronts"]["psnr seconds_per_megapixel"] == ["noisy", "average", "final"]
    assert document["results"][3]["settings"] == {"window": "5"}
    picture = cv2.imread(str(folder / "chart.png"))
    assert picture is not None
    assert picture.shape[1] == 1600
    text = page.read_text(encoding="utf-8")
    assert "torch is not installed" in text
    assert "two cores" in text


def test_the_page_shows_other_shots(tmp_path: Path) -> None:
    other = Comparison("Yard", (result("final", 30.0, 1.0), result("average", 31.0, 1.0)))
    page = write_report(tmp_path, Report(Comparison("Hall", RESULTS), others=[other]))
    text = page.read_text(encoding="utf-8")
    assert "All shots" in text
    assert "Yard" in text
    alone = write_report(tmp_path, Report(Comparison("Hall", RESULTS))).read_text(encoding="utf-8")
    assert "All shots" not in alone


@pytest.mark.parametrize(("cost", "figure"), [("seconds_per_megapixel", "4"), ("cpu_seconds_per_megapixel", "7")])
def test_the_head_of_the_page_has_the_time_that_was_asked_for(tmp_path: Path, cost: Cost, figure: str) -> None:
    results = (RESULTS[0], result("final", 34.0, 4.0, cpu_seconds_per_megapixel=7.0))
    text = write_report(tmp_path, Report(Comparison("Hall", results), cost=cost)).read_text(encoding="utf-8")
    head = text.partition("</header>")[0]
    assert f"<dt>{COSTS[cost]}</dt><dd>{figure}<small>" in head


def test_page_and_picture_show_a_ladder(tmp_path: Path) -> None:
    curves = {"OIDN best": ((8, 0.4), (32, 0.1)), "<ours>": ((8, 0.2), (32, 0.05))}
    ladder = {"psnr": curves, "flip": {"OIDN best": ((8, 0.3),), "<ours>": ((8, 0.4),)}}
    page = write_report(tmp_path / "a", Report(Comparison("Hall", RESULTS, ladder=ladder)))
    text = page.read_text(encoding="utf-8")
    assert "Error against samples" in text
    assert "samples per pixel →" in text
    ours = '<tr><th scope="row">&lt;ours&gt;</th>'
    assert f"{ours}<td>PSNR</td><td>2×</td><td>&gt;1×</td></tr>" in text
    assert f"{ours}<td>FLIP</td><td>&lt;1×</td><td>–</td></tr>" in text
    picture = cv2.imread(str(page.parent / "ladder.png"))
    assert picture is not None
    assert picture.shape[1] == 1600
    assert read_comparison(page.parent / "results.json").ladder == ladder
    alone = write_report(tmp_path / "b", Report(Comparison("Hall", RESULTS))).read_text(encoding="utf-8")
    assert "Error against samples" not in alone
    assert not (tmp_path / "b" / "ladder.png").exists()


def test_the_page_leads_to_the_movies(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr("hybrid.comparison.report.write_movies", lambda folder, images, rate: {"ours": f"{rate}.mp4"})
    images = ShotImages([MethodImages(RESULTS[0].name, scene(0.4))], scene(0.5), (1, 2, 3))
    write_report(tmp_path, Report(Comparison("shot", RESULTS), images, rate=25, movies=True))
    page = (tmp_path / "report.html").read_text(encoding="utf-8")
    assert '<a href="movies/25.mp4">ours</a>' in page


def test_what_no_comparison_has_left_is_not_written_over(tmp_path: Path) -> None:
    comparison = Report(Comparison("Hall", RESULTS))
    (tmp_path / "chart.png").write_text("mine")
    with pytest.raises(ValueError, match=r"chart\.png exists and was not written by ravg compare"):
        write_report(tmp_path, comparison)
    assert [path.name for path in tmp_path.iterdir()] == ["chart.png"]
    (tmp_path / "chart.png").unlink()
    write_report(tmp_path, comparison)
    write_report(tmp_path, comparison)  # over its own
    with pytest.raises(ValueError, match=r"report .* would overwrite an input: results"):
        check_report(tmp_path, [tmp_path / "results.json"])
