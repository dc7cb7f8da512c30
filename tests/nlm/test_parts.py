"""Parts of the light, which add up before and after."""

from __future__ import annotations

import numpy as np
import pytest

from nlm.parts import add_light, adds_up, is_part, split_light

SIZE = (48, 64)


def lights(seed: int = 0) -> tuple[list[np.ndarray], list[np.ndarray]]:
    """Two parts of a picture, clean and noisy: a smooth one, and one with an edge in its middle."""
    rng = np.random.default_rng(seed)
    y, x = np.mgrid[: SIZE[0], : SIZE[1]].astype(np.float32)
    smooth = np.repeat((0.5 + x / SIZE[1])[..., None], 3, axis=-1) * np.float32([1, 0.8, 0.6])
    edge = np.repeat(np.where(y < 20, 0.2, 1.5)[..., None], 3, axis=-1)
    clean = [np.float32(smooth), np.float32(edge)]
    return clean, [np.float32(part * rng.gamma(4, 0.25, (*SIZE, 1))) for part in clean]


def test_parts_that_add_up_do_so_in_the_end() -> None:
    clean, noisy = lights()
    whole, denoised = np.sum(noisy, axis=0), np.sum(clean, axis=0) * np.float32(1.01)
    found = split_light(noisy, whole, denoised, None, exposure=1.0)
    assert np.abs(np.sum(found, axis=0) - denoised).max() < 1e-5 * denoised.mean()
    for part, truth, given in zip(found, clean, noisy, strict=True):
        assert np.sqrt(np.mean((part - truth) ** 2)) < 0.3 * np.sqrt(np.mean((given - truth) ** 2))


def test_parts_without_their_color_add_up_with_it() -> None:
    clean, noisy = lights()
    color = np.full((*SIZE, 3), 0.3, np.float32)
    color[:, :20] = 0  # where it is black there is none of this light
    factors = [color, None]
    whole, denoised = (color * first + second for first, second in (noisy, clean))
    assert adds_up(noisy, whole, factors)
    assert not adds_up(noisy, whole + 1, factors)
    found = split_light(noisy, None, denoised, None, exposure=1.0, factors=factors)
    assert np.abs(color * found[0] + found[1] - denoised).max() < 1e-5 * denoised.mean()
    for part, truth, given in zip(found, clean, noisy, strict=True):
        assert np.sqrt(np.mean((part - truth) ** 2)) < 0.3 * np.sqrt(np.mean((given - truth) ** 2))


def test_a_picture_that_gives_way_is_the_sum_of_its_parts() -> None:
    clean, noisy = lights()
    whole = np.sum(noisy, axis=0)
    found, picture = add_light(noisy, None, 3 * np.sum(clean, axis=0), None)
    np.testing.assert_allclose(np.sum(found, axis=0), picture, rtol=1e-6)
    assert picture.mean() == pytest.approx(whole.mean(), rel=0.01)
    # With one part alone, what is in none counts too.
    (first,), all_of_it = add_light(noisy[:1], whole, np.sum(clean, axis=0), None)
    assert all_of_it.mean() == pytest.approx(whole.mean(), rel=0.01)
    assert first.mean() == pytest.approx(noisy[0].mean(), rel=0.01)


def test_a_part_alone_leaves_the_rest_to_others() -> None:
    clean, noisy = lights()
    (found,) = split_light(noisy[:1], np.sum(noisy, axis=0), np.sum(clean, axis=0), None, exposure=1.0)
    assert np.sqrt(np.mean((found - clean[0]) ** 2)) < 0.3 * np.sqrt(np.mean((noisy[0] - clean[0]) ** 2))
    (same,) = split_light([np.sum(noisy, axis=0)], np.sum(noisy, axis=0), np.sum(clean, axis=0), None, exposure=1.0)
    np.testing.assert_allclose(same, np.sum(clean, axis=0), rtol=1e-5)  # what is the color comes out as the color


@pytest.mark.parametrize("scale", [1e-6, 1e6])
def test_it_scales_with_the_radiance(scale: float) -> None:
    clean, noisy = lights()
    whole, denoised = np.sum(noisy, axis=0), np.sum(clean, axis=0)
    plain = split_light(noisy, whole, denoised, None, exposure=1.0)
    scaled = split_light(
        [part * np.float32(scale) for part in noisy],
        whole * np.float32(scale),
        denoised * np.float32(scale),
        None,
        exposure=scale,
    )
    for a, b in zip(plain, scaled, strict=True):
        np.testing.assert_allclose(b, a * np.float32(scale), rtol=1e-3)


def test_where_there_is_no_light_parts_have_none() -> None:
    black = np.zeros((*SIZE, 3), np.float32)
    for part in split_light([black, black], black, black, None, exposure=1.0):
        assert (part == 0).all()


def test_what_is_light_is_told_from_what_is_not() -> None:
    _, noisy = lights()
    _, other = lights(1)
    whole = np.sum(noisy, axis=0)
    mean = [0.5 * (a + b) for a, b in zip(noisy, other, strict=True)]
    assert all(is_part(layer, average, whole, 1.0) for layer, average in zip(noisy, mean, strict=True))
    mask = np.zeros((*SIZE, 3), np.float32)
    mask[10:20] = 0.1
    assert not is_part(mask, mask, whole, 1.0)  # it has no noise
    assert not is_part(3 * whole, 3 * mean[0], whole, 1.0)  # more than all light
    assert not is_part(-noisy[0], -mean[0], whole, 1.0)
    assert not is_part(noisy[0][..., :1], mean[0][..., :1], whole, 1.0)


def test_another_shape_is_an_error() -> None:
    clean, noisy = lights()
    with pytest.raises(ValueError, match="parts: expected shape"):
        split_light([noisy[0][:-1]], np.sum(noisy, axis=0), np.sum(clean, axis=0), None, exposure=1.0)
