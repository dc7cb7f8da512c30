import numpy as np
import pytest

from nlm.parts import (
    add_light,
    filter_layers,
    find_sums,
    is_noisy,
    is_textured,
    share_outside,
    shares_noise,
    split_light,
    sums_to,
)

SIZE = (48, 64)


def lights(seed: int = 0) -> tuple[list[np.ndarray], list[np.ndarray]]:
    """Two parts of a picture, clean and noisy: a smooth one, and one with an edge in its middle."""
    rng = np.random.default_rng(seed)
    y, x = np.mgrid[: SIZE[0], : SIZE[1]].astype(np.float32)
    smooth = np.repeat((0.5 + x / SIZE[1])[..., None], 3, axis=-1) * np.float32([1, 0.8, 0.6])
    edge = np.repeat(np.where(y < 20, 0.2, 1.5)[..., None], 3, axis=-1)
    clean = [np.float32(smooth), np.float32(edge)]
    return clean, [np.float32(part * rng.gamma(4, 0.25, (*SIZE, 1))) for part in clean]


def split(noisy, denoised, exposure=1.0, **given):
    return split_light(filter_layers(noisy, denoised), denoised, exposure=exposure, **given)


def test_parts_that_add_up_do_so_in_the_end() -> None:
    clean, noisy = lights()
    denoised = np.sum(clean, axis=0) * np.float32(1.01)
    found = split(noisy, denoised)
    assert np.abs(np.sum(found, axis=0) - denoised).max() < 1e-5 * denoised.mean()
    for part, truth, given in zip(found, clean, noisy, strict=True):
        assert np.sqrt(np.mean((part - truth) ** 2)) < 0.3 * np.sqrt(np.mean((given - truth) ** 2))


def test_parts_without_their_color_add_up_with_it() -> None:
    clean, noisy = lights()
    color = np.full((*SIZE, 3), 0.3, np.float32)
    color[:, :20] = 0  # where it is black there is none of this light
    denoised = color * clean[0] + clean[1]
    found = split(noisy, denoised, factors=[color, None], bounds=[noisy[0], None])
    assert np.abs(color * found[0] + found[1] - denoised).max() < 1e-5 * denoised.mean()
    for part, truth, given in zip(found, clean, noisy, strict=True):
        assert np.sqrt(np.mean((part - truth) ** 2)) < 0.3 * np.sqrt(np.mean((given - truth) ** 2))


def test_a_color_of_next_to_nothing_makes_no_spike() -> None:
    """A direct light of 734 came out where the surface's color was 0, of a pass that has 2 at most."""
    clean, noisy = lights()
    color = np.full((*SIZE, 3), 0.3, np.float32)
    color[:, :20] = 1e-6
    denoised = color * clean[0]
    denoised[:, :20] += 0.5  # the picture's own blur
    (found,) = split(noisy[:1], denoised, factors=[color], bounds=[noisy[0]])
    assert noisy[0].min() <= found.min() <= found.max() <= noisy[0].max()


def test_negative_light_adds_up() -> None:
    clean, noisy = lights()
    clean, noisy = [clean[0], clean[1], -0.2 * clean[0]], [noisy[0], noisy[1], -0.2 * noisy[0]]
    denoised = np.sum(clean, axis=0) * np.float32(1.01)
    found = split(noisy, denoised)
    assert np.abs(np.sum(found, axis=0) - denoised).max() < 1e-5 * denoised.mean()
    assert (found[2] < 0).all()


def test_the_filter_keeps_each_layers_mean() -> None:
    clean, noisy = lights()
    found = filter_layers([*noisy, noisy[0][..., :1]], np.sum(clean, axis=0))
    assert [layer.shape[-1] for layer in found] == [3, 3, 1]
    for layer, given in zip(found, noisy, strict=False):
        assert layer.mean() == pytest.approx(given.mean(), rel=0.01)
    assert filter_layers([], clean[0]) == []


@pytest.mark.parametrize("scale", [1e-6, 1e6])
def test_it_scales_with_the_radiance(scale: float) -> None:
    clean, noisy = lights()
    denoised, by = np.sum(clean, axis=0), np.float32(scale)
    plain = split(noisy, denoised)
    scaled = split([part * by for part in noisy], denoised * by, exposure=scale)
    for part, other in zip(plain, scaled, strict=True):
        np.testing.assert_allclose(other, part * by, rtol=1e-3)
    whole = np.sum(noisy, axis=0)
    assert find_sums([part * by for part in noisy], whole * by, scale) == [(0, 1)]


def test_where_there_is_no_light_parts_have_none() -> None:
    black = np.zeros((*SIZE, 3), np.float32)
    for part in split([black, black], black):
        assert (part == 0).all()


def test_what_is_light_is_told_from_what_is_not() -> None:
    _, noisy = lights()
    whole = np.sum(noisy, axis=0)
    assert sums_to(noisy, whole, 1.0)
    assert not sums_to(noisy, 1.1 * whole, 1.0)
    assert not sums_to(noisy[:1], whole, 1.0)
    assert share_outside(noisy[0], whole, 1.0) == 0
    assert share_outside(3 * whole, whole, 1.0) == share_outside(-whole, whole, 1.0) == 1
    mask = np.zeros((*SIZE, 3), np.float32)
    mask[10:20] = 0.1
    assert is_noisy(noisy[0])
    assert not is_noisy(mask)
    assert shares_noise(noisy[0], whole)
    assert not shares_noise(lights(5)[1][0], whole)


def test_what_was_multiplied_by_the_albedo_shows_its_texture() -> None:
    _, (smooth, _) = lights()
    albedo = np.random.default_rng(1).uniform(0.2, 0.8, (12, 16, 3)).repeat(4, axis=0).repeat(4, axis=1)
    albedo = np.float32(albedo)
    assert is_textured(smooth * albedo, albedo)
    assert not is_textured(smooth, albedo)
    assert not is_textured(smooth, 0 * albedo)


def test_of_twenty_layers_in_two_sums_both_are_found() -> None:
    rng = np.random.default_rng(3)
    whole = np.float32(rng.gamma(4, 0.25, (*SIZE, 3)))
    sums = [
        [np.float32(share[..., None] * whole) for share in np.moveaxis(rng.dirichlet([1] * 10, SIZE), -1, 0)]
        for _ in "ab"
    ]
    assert find_sums([*sums[0], *sums[1]], whole, 1.0) == [tuple(range(10)), tuple(range(10, 20))]


def test_parts_are_added_with_their_factors() -> None:
    one = np.ones((*SIZE, 3), np.float32)
    assert (add_light([one, one], [None, 3 * one]) == 4).all()


def test_another_shape_is_an_error() -> None:
    clean, noisy = lights()
    with pytest.raises(ValueError, match="parts: expected shape"):
        split_light([noisy[0][:-1]], np.sum(clean, axis=0), exposure=1.0)
