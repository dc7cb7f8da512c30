"""HDR-FLIP against the authors' own code, and where that has nothing to say."""

import cv2
import numpy as np
import pytest
from numpy.typing import NDArray

from hybrid.comparison import flip
from hybrid.comparison.flip import find_exposures, flip_maps

Array = NDArray[np.float32]


def flip_map(image: Array, reference: Array) -> Array:
    return flip_maps([image], reference)[0]


@pytest.fixture(params=[(40, 56), (41, 55)])  # an even and an odd number of pixels: medians differ
def pictures(request: pytest.FixtureRequest) -> tuple[Array, Array]:
    """A noisy picture and its reference, with black, lamps, and structure down to a few pixels."""
    rng = np.random.default_rng(5)
    noise = cv2.GaussianBlur(rng.normal(size=(*request.param, 3)), (0, 0), 2.0)
    reference = np.exp(noise / noise.std() * 0.7).astype(np.float32)
    reference[:9, :9] = 0
    reference[20, 20:23] = 60
    image = reference * rng.gamma(4, 0.25, reference.shape).astype(np.float32) * np.float32(2)
    image[3, 3], image[30:, :5] = 0.5, -1
    return image, reference


def test_is_that_of_its_authors_with_the_reference_first(pictures: tuple[Array, Array]) -> None:
    flip_evaluator = pytest.importorskip("flip_evaluator")
    image, reference = pictures

    def evaluate(first: Array, second: Array) -> tuple[Array, dict[str, float]]:
        given = [np.maximum(v, 0) for v in (first, second)]
        errors, _, chosen = flip_evaluator.evaluate(*given, "HDR", applyMagma=False)
        return errors[..., 0], chosen

    theirs, chosen = evaluate(reference, image)
    exposures = find_exposures(reference)
    assert len(exposures) == chosen["numExposures"]
    np.testing.assert_allclose(exposures[[0, -1]], [chosen["startExposure"], chosen["stopExposure"]], atol=1e-4)
    ours = flip_map(image, reference)
    # Single precision: where a small error meets the exponents of color and features a pixel differs by more.
    np.testing.assert_allclose(ours, theirs, atol=2e-4)
    assert ours.mean() == pytest.approx(theirs.mean(), rel=1e-5)
    assert np.abs(theirs - evaluate(image, reference)[0]).max() > 0.01  # the order matters


def test_pictures_share_the_reference_and_nothing_else(pictures: tuple[Array, Array]) -> None:
    image, reference = pictures
    lost = image.copy()
    lost[5, 5, 1] = np.nan
    given = [image, lost, reference, image * np.float32(0.5)]
    together = flip_maps(given, reference)
    for picture, errors in zip(given, together, strict=True):
        np.testing.assert_array_equal(errors, flip_map(picture, reference))
    assert np.isnan(together[1]).all()
    assert not together[2].any()


def test_strips_leave_no_seam(pictures: tuple[Array, Array], monkeypatch: pytest.MonkeyPatch) -> None:
    image, reference = pictures
    whole = flip_map(image, reference)
    monkeypatch.setattr(flip, "ROWS", 7)
    np.testing.assert_allclose(flip_map(image, reference), whole, atol=1e-6)  # of float32


@pytest.mark.parametrize("light", [0.0, 0.5])
def test_a_reference_of_one_light_is_compared_too(light: float) -> None:
    """Its exposures are all one, or none brings it to light: the authors' code ends the process."""
    reference = np.full((30, 30, 3), light, np.float32)
    errors = flip_map(reference + np.float32(0.2), reference)
    assert np.isfinite(errors).all()
    assert 0 < errors.min() <= errors.max() <= 1
    assert not flip_map(reference, reference).any()


def test_a_reference_that_is_not_finite_is_an_error() -> None:
    image = np.ones((20, 20, 3), np.float32)
    with pytest.raises(ValueError, match="must be finite, 1 of"):
        flip_map(image, np.where(np.arange(1200).reshape(20, 20, 3) == 7, np.inf, image))
    with pytest.raises(ValueError, match="alike"):
        flip_map(image, image[1:])
