import json
import math
from dataclasses import replace
from pathlib import Path

import pytest

from hybrid.comparison.results import (
    Comparison,
    MethodResult,
    Metric,
    Statistic,
    best_and_ties,
    join,
    leading_pair,
    opening_pair,
    pareto_front,
    read_comparison,
    summarize,
    to_document,
    to_json,
)
from tests.hybrid.comparison.outcomes import PSNR, RELMSE, RESULTS, result


def test_a_difference_smaller_than_its_scatter_is_a_tie_and_a_steady_one_is_not() -> None:
    base = [30.0, 35.0, 31.0, 36.0, 30.5, 35.5]
    scattered = [b + d for b, d in zip(base, [-0.4, 0.3, -0.3, 0.4, -0.35, 0.3], strict=True)]
    steady = [b - 0.1 for b in base]  # far inside the scatter over frames, but the same on every frame
    best, ties = best_and_ties([result("a", base, 1), result("b", scattered, 1), result("c", steady, 1)], PSNR)
    assert best == "a"
    assert ties == {"b"}


def test_without_frames_overlapping_intervals_tie() -> None:
    a, b, c = Statistic(30, 29, 31, 29.5, 30.5), Statistic(29.4, 28, 30, 29, 29.6), Statistic(28, 27, 29, 27.5, 28.5)
    methods = [MethodResult(n, metrics={"psnr": s}) for n, s in zip("abc", (a, b, c), strict=True)]
    assert best_and_ties(methods, PSNR) == ("a", {"b"})


def test_two_perfect_scores_tie_and_a_lost_frame_never_wins() -> None:
    perfect, nan = [math.inf, math.inf], [math.nan, math.nan]
    methods = [result("a", perfect, 1), result("b", perfect, 1), result("c", nan, 1)]
    best, ties = best_and_ties(methods, PSNR)
    assert {best} | ties == {"a", "b"}


def test_lower_and_nearest_to_zero_are_better_where_the_metric_says_so() -> None:
    bias = Metric("bias", "Bias", better="zero")
    methods = [MethodResult(str(v), metrics={"bias": summarize([v])}) for v in (-0.5, 0.1, 0.3)]
    assert best_and_ties(methods, bias)[0] == "0.1"
    assert best_and_ties(RESULTS, RELMSE)[0] == "final"


def test_the_front_holds_what_nothing_cheaper_beats() -> None:
    assert pareto_front(RESULTS, PSNR, "seconds_per_megapixel") == ["noisy", "average", "final"]
    assert pareto_front(RESULTS, RELMSE, "peak_bytes") == ["average", "final"]
    # Equal cost: only the better one stays.
    assert pareto_front([result("a", 30.0, 1.0), result("b", 31.0, 1.0)], PSNR, "seconds_per_megapixel") == ["b"]


def test_several_shots_are_put_together_over_those_that_all_have() -> None:
    a = Comparison("A", (result("x", [30.0, 31.0], 1.0, peak_bytes=5, worth=4.0), result("y", [20.0, 21.0], 2.0)))
    b = Comparison("B", (result("x", [40.0, 41.0, 42.0, 43.0], 3.0, peak_bytes=9, worth=16.0),))
    (joined,) = join([a, b])
    assert joined.metrics["psnr"].mean == pytest.approx((30.5 + 41.5) / 2)  # of the shots, however long they are
    assert joined.metrics["psnr"].shots == (2, 4)
    assert (joined.seconds_per_megapixel, joined.peak_bytes, joined.worth) == (2.0, 9, pytest.approx(8.0))
    # On one shot x is better by 1, on the other y is: nothing is known of a third shot.
    c = Comparison("C", (result("x", [30.0, 30.1], 1.0), result("y", [29.0, 29.1], 1.0)))
    d = Comparison("D", (result("x", [39.5, 39.6], 1.0), result("y", [40.0, 40.1], 1.0)))
    assert best_and_ties(c.results, PSNR) == ("x", set())
    assert best_and_ties(join([c, d]), PSNR) == ("x", {"y"})


def test_results_are_read_back_as_they_were(tmp_path: Path) -> None:
    perfect = result("perfect", [math.inf, math.inf], 1.0)
    comparison = Comparison("Hall", (*RESULTS, perfect), {"Machine": "two cores"})
    (tmp_path / "results.json").write_text(to_json(to_document(comparison)))
    again = read_comparison(tmp_path / "results.json")
    assert again.facts == comparison.facts
    for before, after in zip(comparison.results, again.results, strict=True):
        assert replace(before, settings={}) == replace(after, settings={})


@pytest.mark.parametrize(
    "text",
    [
        '{"shot": "x"}',
        "",
        "null",
        "[" * 100_000,
        '{"shot": "x", "results": [{"metrics": []}], "facts": {}}',
        '{"shot": "x", "results": "abc", "facts": {}}',
        '{"shot": "x", "results": [null], "facts": null}',
        '{"shot": "x", "results": [], "facts": []}',
        '{"results": [{"metrics": {"psnr": 0}}]}',
        "\\ud800",
    ],
    ids=lambda text: text[:40],
)
def test_a_file_that_is_no_result_is_said_to_be_none(tmp_path: Path, text: str) -> None:
    """Lists where a mapping was expected, and lists of lists of lists, ended in a traceback."""
    (tmp_path / "results.json").write_text(text)
    with pytest.raises(ValueError, match="is no result of a comparison") as caught:
        read_comparison(tmp_path / "results.json")
    assert len(str(caught.value)) < 600


@pytest.mark.parametrize(
    ("entry", "value"), [("peak_bytes", "much"), ("spread", [1]), ("seconds_per_megapixel", {}), ("settings", 3)]
)
def test_a_result_with_a_value_of_another_kind_is_none(tmp_path: Path, entry: str, value: object) -> None:
    document = json.loads(to_json(to_document(Comparison("Hall", tuple(RESULTS)))))
    document["results"][0][entry] = value
    (tmp_path / "results.json").write_text(json.dumps(document))
    with pytest.raises(ValueError, match="is no result of a comparison"):
        read_comparison(tmp_path / "results.json")


def test_numbers_that_are_not_finite_survive_json() -> None:
    document = to_document(Comparison("x", (result("a", [math.inf, math.nan], 1.0),)))
    statistic = json.loads(to_json(document))["results"][0]["metrics"]["psnr"]
    assert [float(v) for v in statistic["values"]] == pytest.approx([math.inf, math.nan], nan_ok=True)


def test_the_strongest_rival_is_of_the_other_side() -> None:
    ours = [result("fast", 30, 1), result("quality", 33, 4)]
    theirs = [result("OIDN", 31, 1, family="OIDN"), result("mine", 29, None, family="External")]
    noisy = result("noisy", 20, 0, family="Input")
    assert leading_pair([noisy, *ours, *theirs], PSNR) == ("quality", "OIDN")
    assert leading_pair([noisy, ours[0], *theirs], PSNR) == ("OIDN", "fast")
    assert leading_pair([noisy, *ours], PSNR) == ("quality", "fast")
    assert leading_pair([noisy, ours[1]], PSNR) == ("quality", "noisy")
    assert leading_pair([ours[1]], PSNR) is None
    assert leading_pair([], PSNR) is None


def test_a_page_opens_with_the_noisy_frames_beside_our_best_method() -> None:
    ours = [result("fast", 30, 1), result("quality", 33, 4)]
    noisy, theirs = result("noisy", 20, 0, family="Input"), result("OIDN", 35, 1, family="OIDN")
    assert opening_pair([noisy, theirs, *ours], PSNR) == ("noisy", "quality")
    assert opening_pair([noisy, theirs], PSNR) == ("noisy", "OIDN")
    assert opening_pair([theirs, *ours], PSNR) is None
    assert opening_pair([noisy], PSNR) is None
