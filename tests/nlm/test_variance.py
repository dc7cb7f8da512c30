import numpy as np
import pytest

from nlm.variance import (
    prefilter_guide,
    smooth_variance,
    variance_from_halves,
    variance_from_residual,
    variance_from_window,
)


@pytest.fixture
def rng() -> np.random.Generator:
    return np.random.default_rng(5)


def test_halves_give_the_variance_of_their_mean(rng):
    a, b = rng.normal(1, 0.4, (2, 64, 64, 3)).astype(np.float32)
    # 12288 values of one degree of freedom: the mean is good to 1.3 %, four deviations
    assert variance_from_halves(a, b).mean() == pytest.approx(0.4**2 / 2, rel=0.05)


def test_window_gives_the_variance_of_the_centre(rng):
    window = rng.normal(1, 0.4, (5, 64, 64, 3)).astype(np.float32)
    window += np.linspace(0, 5, 64, dtype=np.float32)[None, None, :, None]  # what does not move is no noise
    variance = variance_from_window(window, np.ones((5, 64, 64), np.float32))
    # 0.7 instead of 1 for frames that no warp has softened: 6 % too much; statistics as above
    assert variance.mean() == pytest.approx(0.4**2, rel=0.1)


def test_warping_hardly_changes_it(rng):
    window = rng.normal(1, 0.4, (5, 64, 65, 3)).astype(np.float32)
    window = (window[:, :, 1:] + window[:, :, :-1]) / 2  # half a pixel
    centre = rng.normal(1, 0.4, (64, 64, 3)).astype(np.float32)
    window[2] = centre
    variance = variance_from_window(window, np.ones((5, 64, 64), np.float32))
    assert variance.mean() == pytest.approx(0.4**2, rel=0.1)


def test_residual_gives_the_variance_and_ignores_ramps(rng):
    ramp = np.linspace(0, 50, 64, dtype=np.float32)[None, :, None] + np.zeros((64, 1, 3), np.float32)
    ramp[20:] += 7  # and edges along an axis
    noisy = ramp + rng.normal(0, 0.4, ramp.shape).astype(np.float32)
    assert variance_from_residual(noisy).mean() == pytest.approx(0.4**2, rel=0.1)
    # rounding of 50 in float32: 4e-6, squared and weighted
    assert variance_from_residual(ramp).max() < 1e-9


def test_too_few_frames_fall_back_to_the_residual(rng):
    window = rng.normal(1, 0.4, (5, 32, 32, 3)).astype(np.float32)
    confidence = np.zeros((5, 32, 32), np.float32)
    confidence[2], confidence[1] = 1, 0.9
    window[0], window[4] = 100, np.nan
    np.testing.assert_array_equal(variance_from_window(window, confidence), variance_from_residual(window[2]))


def test_one_outlier_has_a_bounded_influence(rng):
    window = rng.normal(1, 0.4, (5, 32, 32, 3)).astype(np.float32)
    window[3, 16, 16] = 1e6
    variance = variance_from_window(window, np.ones((5, 32, 32), np.float32))
    # the cap: a pixel adds 16/25 of the level around it; the level itself is noisy by a third
    assert variance.max() < 4 * 0.4**2


def test_scale_constants_and_order():
    rng = np.random.default_rng(9)
    window = rng.normal(1, 0.4, (3, 16, 16, 3)).astype(np.float32)
    confidence = np.ones((3, 16, 16), np.float32)
    np.testing.assert_allclose(
        variance_from_window(window * 8, confidence), variance_from_window(window, confidence) * 64, rtol=1e-6
    )
    np.testing.assert_array_equal(variance_from_window(np.ones_like(window), confidence), 0)
    flat = np.full((16, 16, 7), 0.3, np.float32)
    np.testing.assert_allclose(smooth_variance(flat), 0.3, rtol=1e-6)


def prefilter_window(guides, confidence):
    return prefilter_guide(guides[len(guides) // 2], lambda rows: guides[:, rows], confidence)


def test_guides_without_noise_come_out_as_they_went_in(rng):
    y, x = np.mgrid[:48, :48]
    guide = np.stack([(x // 7 + y // 5) % 2, np.sin(x / 3), rng.random((48, 48))], -1).astype(np.float32)
    guides = np.repeat(guide[None], 5, axis=0)
    result = prefilter_window(guides, np.ones((5, 48, 48), np.float32))
    np.testing.assert_allclose(result, guide, atol=1e-3)


def test_noisy_guides_lose_their_noise_and_keep_their_edges(rng):
    clean = np.zeros((48, 48, 3), np.float32)
    clean[:, 24:] = 0.6
    guides = clean + rng.normal(0, 0.05, (5, 48, 48, 3)).astype(np.float32)
    result = prefilter_window(guides, np.ones((5, 48, 48), np.float32))
    # 45 samples at best, so a seventh of the deviation; a fifth allows for weights below 1
    assert (result - clean)[:, 4:20].std() < 0.2 * 0.05
    edge = result[:, 24].mean() - result[:, 23].mean()
    assert edge == pytest.approx(0.6, abs=0.02)


def test_only_tiles_whose_guides_are_noisy_are_filtered(rng):
    clean = np.full((96, 40, 3), 0.5, np.float32)
    guides = np.repeat(clean[None], 5, axis=0)
    guides[:, 70:] += rng.normal(0, 0.05, (5, 26, 40, 3)).astype(np.float32)
    guides[2, :32] += 1e-4  # which the filter would average away
    result = prefilter_window(guides, np.ones((5, 96, 40), np.float32))
    np.testing.assert_array_equal(result[:32], guides[2, :32])
    assert np.abs(result[70:] - clean[70:]).mean() < 0.5 * np.abs(guides[2, 70:] - clean[70:]).mean()


def test_only_rows_around_noise_are_read(rng):
    guides = np.full((3, 300, 24, 3), 0.5, np.float32)
    guides[:, 100:110] += rng.normal(0, 0.05, (3, 10, 24, 3)).astype(np.float32)
    guides[:, 299] += rng.normal(0, 0.05, (3, 24, 3)).astype(np.float32)
    confidence, rows = np.ones(guides.shape[:3], np.float32), []
    result = prefilter_guide(guides[1], lambda part: rows.append(part) or guides[:, part], confidence)
    assert rows == [slice(64, 160), slice(256, 300)]
    np.testing.assert_array_equal(result, prefilter_window(guides, confidence))
    assert np.abs(result[100:110] - 0.5).mean() < 0.8 * np.abs(guides[1, 100:110] - 0.5).mean()


@pytest.mark.parametrize("share", [0.0, 1.0])
def test_columns_are_filtered_alike_in_parts_and_in_the_whole(rng, monkeypatch, share):
    guides = np.full((3, 40, 400, 3), 0.5, np.float32)
    for columns in (np.s_[:64], np.s_[300:]):
        guides[:, :, columns] += rng.normal(0, 0.1, guides[:, :, columns].shape).astype(np.float32)
    confidence = np.ones(guides.shape[:3], np.float32)
    found = prefilter_window(guides, confidence)
    monkeypatch.setattr("nlm.variance._MOST_COLUMNS", share)
    # Tiles begin elsewhere, and their running sums round otherwise.
    np.testing.assert_allclose(prefilter_window(guides, confidence), found, atol=1e-4)
    assert np.abs(found[:, :64] - guides[1, :, :64]).max() > 0.05
    np.testing.assert_array_equal(found[:, 150:250], guides[1, :, 150:250])


def test_shapes_are_checked():
    with pytest.raises(ValueError, match=r"^b:"):
        variance_from_halves(np.zeros((4, 4, 3), np.float32), np.zeros((4, 5, 3), np.float32))
    with pytest.raises(ValueError, match=r"^confidence:"):
        variance_from_window(np.zeros((3, 4, 4, 3), np.float32), np.zeros((3, 4, 5), np.float32))
