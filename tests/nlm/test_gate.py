import cv2
import numpy as np
import pytest

from nlm.gate import SHARE, agreement_weight, color_gate, color_gates


@pytest.fixture
def rng() -> np.random.Generator:
    return np.random.default_rng(6)


def test_matches_the_formula_in_a_flat_picture():
    estimates = np.full((3, 40, 40, 3), 1, np.float32)
    estimates[0] = 1.02
    noisy = np.full((40, 40, 3), 1.1, np.float32)
    tone = lambda x: x / (x + 1)  # noqa: E731
    q = 0.3 * (tone(1.1) - tone(1)) + 0.004
    d = tone(1.02) - tone(1)
    weight = color_gate(estimates, noisy, 1.0)
    np.testing.assert_allclose(weight[0], np.exp(-((d / q) ** 2)), rtol=1e-4)  # 1 - 1/x in float32
    np.testing.assert_array_equal(weight[1:], 1)


def test_shuts_on_moving_light_and_stays_open_on_noise(rng):
    centre = np.full((48, 48, 3), 0.5, np.float32)
    noisy = centre + rng.normal(0, 0.1, centre.shape).astype(np.float32)
    estimates = np.stack([centre] * 3) + rng.normal(0, 0.005, (3, 48, 48, 3)).astype(np.float32)
    estimates[0, :, :16] *= 0.5  # a shadow that was there before
    weight = color_gate(estimates, noisy, 0.5)
    assert weight[0, :, :10].max() < 0.01
    assert weight[0, :, 28:].min() > 0.8
    assert weight[2].min() > 0.8
    assert weight.max() <= 1


def test_stays_open_on_errors_of_single_pixels(rng):
    """The weight must not choose the frames whose errors are the centre's."""
    estimates = np.full((3, 40, 40, 3), 0.5, np.float32)
    estimates += rng.choice([-0.08, 0.08], estimates.shape)
    noisy = estimates[1] + rng.normal(0, 0.1, estimates.shape[1:]).astype(np.float32)
    # Means of 9×9 pixels differ by 0.006 in tone-mapped units, a third of the gate's scale; pixels by twice the scale.
    assert color_gate(estimates, noisy, 0.5).mean() > 0.8


def test_of_two_shares_the_greater_passes_more(rng):
    estimates = rng.uniform(0.4, 0.6, (3, 40, 40, 3)).astype(np.float32)
    noisy = estimates[1] + rng.normal(0, 0.1, estimates.shape[1:]).astype(np.float32)
    strict, mild = color_gates(estimates, noisy, 0.5, (SHARE, 1.0))
    np.testing.assert_array_equal(strict, color_gate(estimates, noisy, 0.5))
    assert (strict <= mild).all()
    assert strict[0].mean() < mild[0].mean() - 0.05


def test_does_not_depend_on_the_exposure(rng):
    estimates, noisy = rng.random((3, 20, 20, 3), np.float32), rng.random((20, 20, 3), np.float32)
    np.testing.assert_allclose(
        color_gate(estimates * 512, noisy * 512, 128.0), color_gate(estimates, noisy, 0.25), rtol=1e-6
    )


def test_hard_values_do_not_spread(rng):
    estimates = rng.uniform(0.49, 0.5, (3, 40, 40, 3)).astype(np.float32)
    noisy = rng.random((40, 40, 3), np.float32)
    clean = color_gate(estimates, noisy, 1.0)
    estimates[0, 5, 5], estimates[1, 30, 30], noisy[10, 10] = np.nan, np.inf, 1e30
    weight = color_gate(estimates, noisy, 1.0)
    assert np.isfinite(weight).all()
    assert weight[0, 5, 5] == 0
    assert weight[2, 30, 30] == 0
    far = np.s_[:, 20:25, 12:20]
    np.testing.assert_allclose(weight[far], clean[far], rtol=1e-4)
    assert np.isfinite(color_gate(np.zeros_like(estimates), np.zeros_like(noisy), 1.0)).all()


@pytest.mark.parametrize(
    ("name", "arguments"),
    [
        ("estimates", (np.zeros((2, 8, 8, 3)), np.zeros((8, 8, 3)), 1.0)),
        ("noisy", (np.zeros((3, 8, 8, 3)), np.zeros((8, 9, 3)), 1.0)),
        ("noisy", (np.zeros((3, 8, 8, 1)), np.zeros((8, 8, 1)), 1.0)),
        ("exposure", (np.zeros((3, 8, 8, 3)), np.zeros((8, 8, 3)), 0.0)),
    ],
)
def test_arguments_are_checked(name, arguments):
    with pytest.raises(ValueError, match=f"^{name}:"):
        color_gate(*arguments)


def test_a_line_between_light_that_came_and_light_that_went_is_no_way_through() -> None:
    """On it the mean difference is 0: stripes of shadow that move by half their period."""
    _, x = np.mgrid[:48, :96].astype(np.float32)
    stripes = [np.where((x + shift) % 32 < 16, 1.0, 0.3) for shift in (0, 16)]
    there, here = (np.repeat(image[..., None], 3, axis=-1).astype(np.float32) for image in stripes)
    window = np.stack([there, here, here])
    noisy = here * np.random.default_rng(0).gamma(4, 0.25, here.shape).astype(np.float32)
    weight = color_gate(window, noisy, 0.5)
    assert weight[0][:, 8:-8].max() < 0.1
    assert (weight[1] == 1).all()
    np.testing.assert_allclose(weight[2], 1)


def test_a_strict_gate_sees_detail_whose_mean_is_the_same(rng):
    stripes = np.tile(np.float32([0.6, 0.45, 0.45]), 15)[None, :, None]  # with one mean in each nine columns
    estimates = np.stack([np.broadcast_to(np.roll(stripes, shift, axis=1), (40, 45, 3)) for shift in (1, 0, 0)])
    noisy = estimates[1] + rng.normal(0, 0.02, estimates.shape[1:]).astype(np.float32)
    inside = np.s_[0, 12:-12, 12:-12]  # the ends of the pattern do not fit
    assert color_gates(estimates, noisy, 0.5, (0.3,))[0][inside].min() > 0.95
    (weight,) = color_gates(estimates, noisy, 0.5, (0.3,), detail=2.0)
    assert weight[inside].max() < 1e-3
    np.testing.assert_array_equal(weight[2], 1)


def agreement_by_loops(estimates, noisy, confidence, exposure):
    """`agreement_weight` in plain numpy."""
    tone = lambda x: np.maximum(x, 0) / (np.maximum(x, 0) + exposure)  # noqa: E731
    box = lambda x, size: cv2.blur(x, (size, size))  # noqa: E731
    estimates, noisy, c = (x.astype(np.float64) for x in (estimates, noisy, confidence))
    middle = len(estimates) // 2
    others = [t for t in range(len(estimates)) if t != middle]
    c, d = c[others, ..., None], tone(estimates[others]) - tone(estimates[middle])
    total = c.sum(0)
    mean = (c * d).sum(0) / total
    repeat = ((c**2).sum(0) / total)[..., 0]
    total = total[..., 0]
    spread = (c * (d - mean) ** 2).sum(0).mean(-1)
    variance = box(spread, 15) / (box(total, 15) - box(repeat, 15))
    count = box(total, 15) / box(repeat, 15)
    square = box(total * (mean**2).mean(-1), 9) / box(total, 9)
    noise = box(((tone(noisy) - tone(estimates[middle])) ** 2).mean(-1), 15)
    error = np.maximum(square - noise - 1.2 * variance * (1 + 1 / count), 0)
    return variance / (variance + count * error)


@pytest.fixture
def outlines(rng) -> tuple[np.ndarray, np.ndarray]:
    """Five estimates with errors of their own; the others lack detail that the centre shows. And the noisy centre."""
    centre = rng.uniform(0.2, 0.8, (64, 64, 3)).astype(np.float32)
    estimates = np.stack([cv2.blur(centre, (3, 3))] * 5)
    estimates[2] = centre
    estimates[:, :, 40:] = 0.5
    estimates += rng.normal(0, 0.004, estimates.shape).astype(np.float32)
    return estimates, estimates[2] + rng.normal(0, 0.02, centre.shape).astype(np.float32)


def test_agreement_matches_plain_numpy(rng, outlines):
    estimates, noisy = outlines
    confidence = rng.uniform(0.2, 1, estimates.shape[:3]).astype(np.float32)
    weight = agreement_weight(estimates, noisy, confidence, 0.5)
    # The sum of squares and the square of the sum cancel to 1e-4 of themselves in float32.
    np.testing.assert_allclose(weight, agreement_by_loops(estimates, noisy, confidence, 0.5), rtol=2e-2, atol=1e-3)


def test_what_all_neighbours_lack_is_seen_and_errors_are_not(outlines):
    estimates, noisy = outlines
    weight = agreement_weight(estimates, noisy, np.ones(estimates.shape[:3], np.float32), 0.5)
    assert weight[:, :24].max() < 0.05
    assert weight[:, 52:].min() == 1


def test_a_difference_below_the_noise_of_the_samples_is_the_centres_own(outlines):
    estimates, _ = outlines
    noisy = estimates[2] + np.where(np.indices(estimates.shape[1:]).sum(0) % 2, 0.4, -0.4).astype(np.float32)
    assert agreement_weight(estimates, noisy, np.ones(estimates.shape[:3], np.float32), 0.5).min() == 1


def test_agreement_needs_two_neighbours(outlines):
    estimates, noisy = outlines
    confidence = np.zeros(estimates.shape[:3], np.float32)
    confidence[2:4] = 1
    assert agreement_weight(estimates, noisy, confidence, 0.5).min() == 1
    confidence[:] = 0
    assert agreement_weight(estimates, noisy, confidence, 0.5).min() == 1


def test_agreement_does_not_depend_on_the_exposure(outlines):
    estimates, noisy = outlines
    confidence = np.ones(estimates.shape[:3], np.float32)
    np.testing.assert_allclose(
        agreement_weight(estimates * 512, noisy * 512, confidence, 256.0),
        agreement_weight(estimates, noisy, confidence, 0.5),
        rtol=1e-5,
    )


@pytest.mark.parametrize("value", [np.nan, np.inf, 1e38])
def test_a_pixel_that_is_not_finite_changes_only_what_is_near(outlines, value):
    """A running sum would carry it through the rest of the picture."""
    estimates, noisy = outlines
    confidence = np.ones(estimates.shape[:3], np.float32)
    clean = agreement_weight(estimates, noisy, confidence, 0.5)
    estimates[0, 4, 4] = value
    estimates[2, 4, 4] = value
    confidence[:, 4, 8] = 1e-41  # as a product of gates may be
    weight = agreement_weight(estimates, noisy, confidence, 0.5)
    assert np.isfinite(weight).all()
    assert 0 <= weight.min() <= weight.max() <= 1
    np.testing.assert_allclose(weight[:, 20:], clean[:, 20:], rtol=1e-4, atol=1e-6)


@pytest.mark.parametrize(
    ("change", "message"),
    [
        ({"noisy": np.zeros((3, 4, 3))}, "noisy: expected shape"),
        ({"confidence": np.zeros((3, 2, 4))}, "confidence: expected shape"),
        ({"estimates": np.zeros((3, 4, 4, 2)), "noisy": np.zeros((4, 4, 2))}, "noisy: expected shape"),
        ({"exposure": 0.0}, "exposure: expected a positive number"),
    ],
)
def test_agreement_refuses_what_does_not_fit(change, message):
    given = {"estimates": np.zeros((3, 4, 4, 3)), "noisy": np.zeros((4, 4, 3)), "confidence": np.zeros((3, 4, 4))}
    with pytest.raises(ValueError, match=message):
        agreement_weight(**{**given, "exposure": 1.0, **change})
