"""How many times its samples a rival needs: made-up curves whose answer is known."""

import pytest

from hybrid.comparison.ladder import LEAST_ERROR, Factor, build_ladder, factors, join_ladders, samples_factor
from hybrid.comparison.results import Curve, summarize

CURVE = ((8, 0.4), (32, 0.1), (128, 0.05))  # n^-1, then n^-0.5


def test_a_factor_lies_on_the_line_between_two_levels() -> None:
    assert samples_factor(CURVE, 8, 0.4).value == pytest.approx(1)
    assert samples_factor(CURVE, 8, 0.2).value == pytest.approx(2)
    assert samples_factor(CURVE, 8, 0.1).value == pytest.approx(4)
    assert samples_factor(CURVE, 8, 0.1 / 2**0.5).value == pytest.approx(8)
    assert samples_factor(CURVE, 32, 0.05).value == pytest.approx(4)
    assert samples_factor(CURVE, 128, 0.1).value == pytest.approx(0.25)
    assert {samples_factor(CURVE, 8, e).bound for e in (0.4, 0.2, 0.1, 0.05)} == {""}


def test_beyond_the_levels_a_factor_is_a_bound() -> None:
    assert samples_factor(CURVE, 32, 0.01) == Factor(4, "more than")
    assert samples_factor(CURVE, 32, 0.5) == Factor(0.25, "less than")


def test_one_level_is_equal_or_a_bound() -> None:
    one = ((32, 0.1),)
    assert samples_factor(one, 32, 0.1) == Factor(1)
    assert samples_factor(one, 32, 0.09) == Factor(1, "more than")
    assert samples_factor(one, 32, 0.11) == Factor(1, "less than")


def test_the_nearest_samples_count_where_the_error_does_not_fall() -> None:
    bent = ((8, 0.4), (32, 0.1), (128, 0.4), (512, 0.1))
    assert samples_factor(bent, 8, 0.2).value == pytest.approx(2)
    assert samples_factor(bent, 128, 0.2).value == pytest.approx(2)
    assert samples_factor(bent, 32, 0.2).value == pytest.approx(0.5)
    assert samples_factor(bent, 512, 0.2).value == pytest.approx(0.5)
    assert samples_factor(bent, 512, 0.09) == Factor(1, "more than")


def test_a_rival_that_is_beaten_everywhere_has_bounds_alone_at_the_end() -> None:
    ours: Curve = tuple((n, e / 4) for n, e in CURVE)
    found = factors({"noisy": CURVE, "OIDN best": CURVE, "ours": ours})
    assert found.keys() == {"ours"}
    assert found["ours"][8].value == pytest.approx(4)
    assert found["ours"][32] == Factor(4, "more than")
    assert found["ours"][128] == Factor(1, "more than")
    assert factors({"noisy": CURVE, "ours": ours}) == {}
    assert factors({"OIDN best": CURVE[:1], "ours": ours})["ours"] == {8: Factor(1, "more than")}


def test_errors_come_from_decibels_by_rising_samples() -> None:
    def metrics(*psnr: float) -> dict[str, object]:
        return {"psnr": summarize(psnr), "flip": summarize([0.2, 0.4]), "ssim": summarize([0.5])}

    measured = {32: {"a": metrics(30, float("inf"))}, 8: {"a": metrics(20, 10), "b": metrics(float("nan"))}}
    ladder = build_ladder(measured)
    assert ladder.keys() == {"psnr", "flip"}
    assert ladder["psnr"].keys() == {"a"}
    assert ladder["psnr"]["a"] == ((8, pytest.approx(0.055)), (32, pytest.approx(0.0005)))
    assert ladder["flip"]["b"] == ((8, pytest.approx(0.3)),)
    assert build_ladder({8: {"a": metrics(90)}})["psnr"]["a"] == ((8, LEAST_ERROR),)


def test_shots_are_joined_by_the_mean_of_their_decibels() -> None:
    one = {"psnr": {"a": ((8, 0.1), (32, 0.01)), "b": ((8, 0.1),)}, "flip": {"a": ((8, 0.1),)}}
    two = {"psnr": {"a": ((8, 0.001), (128, 0.01))}}
    assert join_ladders([one, two]) == {"psnr": {"a": ((8, pytest.approx(0.01)),)}}
    assert join_ladders([]) == join_ladders([one, {}]) == {}
