"""The worth of a denoiser in samples: made-up errors whose answer is known."""

from pathlib import Path

import numpy as np
import pytest

from hybrid.comparison.samples import NoiseLaw, fit_floor, reference_floor
from hybrid.files.shots import open_shot
from tests.exr_files import write_layers
from tests.scenes import Scene

A, B = 0.24, 1e-4  # errors a/n + b


def levels(*samples: float, floor: float = 0.0) -> tuple[tuple[float, float], ...]:
    return tuple((n, A / n + floor) for n in samples)


def test_by_the_law_worth_is_the_ratio_of_errors() -> None:
    law = NoiseLaw(levels(8), samples=8)
    assert law.worth(A / 8) == pytest.approx(1)
    assert law.worth(A / 112) == pytest.approx(14)
    assert law.worth(A / 4) == pytest.approx(0.5)
    assert law.slope is None
    assert "not verified" in law.describe()


def test_a_render_without_error_is_described() -> None:
    """A shot that was compared with itself ended in "math domain error"."""
    assert "not verified" in NoiseLaw(((8, 0.0),), samples=8).describe()
    assert "8: ∞ dB, 32: 14.00 dB" in NoiseLaw(((8, 0.0), (32, 10**-1.4), (64, 10**-1.7)), samples=8).describe()


def test_levels_are_met_exactly_and_the_law_goes_on_beyond() -> None:
    # Between 8 and 32 the error falls as n^-0.5 only.
    law = NoiseLaw(((8, 0.04), (32, 0.02)), samples=8)
    assert law.slope == pytest.approx(-0.5)
    assert "not as 1/n" in law.describe()
    assert law.worth(0.02) == pytest.approx(4)
    assert law.worth(0.04 / np.sqrt(2)) == pytest.approx(2)
    assert law.worth(0.01) == pytest.approx(8)  # twice the samples of 32
    assert law.worth(0.08) == pytest.approx(0.5)


def test_the_references_noise_is_taken_off() -> None:
    law = NoiseLaw(levels(8, 32, floor=B), samples=8, floor=B)
    assert law.slope == pytest.approx(-1)
    assert "close to 1/n" in law.describe()
    assert law.worth(A / 80 + B) == pytest.approx(10)
    assert law.worth(B / 2) == np.inf  # better than can be told
    assert np.isnan(law.worth(float("nan")))


def test_the_floor_is_found_from_levels_or_from_the_references_samples() -> None:
    assert fit_floor(levels(4, 16, 64, floor=B)) == pytest.approx(B)
    assert fit_floor(levels(4, 16)) == pytest.approx(0, abs=1e-12)
    # a/n + a/m with n = 24 and m = 512
    assert reference_floor(A / 24 + A / 512, 24, 512) == pytest.approx(A / 512)


def test_samples_come_from_the_header(tmp_path: Path) -> None:
    path = tmp_path / "a.0001.exr"
    write_layers(path, Scene().clean(0))
    assert open_shot(path).samples is None
    bundled = Path(__file__).parents[3] / "examples" / "shot"
    assert open_shot(bundled / "noisy.####.exr").samples == 16
    assert open_shot(bundled / "reference_a.####.exr").samples == 96
