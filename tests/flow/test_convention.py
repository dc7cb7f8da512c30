"""Which convention vectors follow: what right and wrong readings leave, and what pictures cannot tell."""

from collections.abc import Callable
from dataclasses import replace

import cv2
import numpy as np
import pytest

from flow.convention import PARTS, Choice, choose_convention
from flow.motion import CYCLES, MotionConvention
from flow.patches import FramePair, Patches

HEIGHT, WIDTH = 90, 140
SIZES = WIDTH, HEIGHT, WIDTH, HEIGHT
PLAIN = MotionConvention()


def grid() -> tuple[np.ndarray, np.ndarray]:
    y, x = np.mgrid[:HEIGHT, :WIDTH].astype(np.float32)
    return x, y


class Film:
    """Frames of a wall that a camera moves along and towards, or of a disc that passes before it.

    Parameters
    ----------
    pan : (float, float)
        How far the wall, or the disc alone, goes from frame 0 to frame 1, pixels.
    zoom : float
        How much larger it gets meanwhile.
    faster : float
        How many times as far it goes from each frame to the next.
    """

    def __init__(
        self,
        pan: tuple[float, float] = (0, 0),
        zoom: float = 0,
        *,
        faster: float = 1.0,
        noise: float = 0.2,
        frames: int = 3,
        disc: bool = False,
    ) -> None:
        rng = np.random.default_rng(3)
        coarse = rng.uniform(0.2, 1, (2 * HEIGHT // 6, 2 * WIDTH // 6, 3)).astype(np.float32)
        self.wall = cv2.resize(coarse, (2 * WIDTH, 2 * HEIGHT))
        self.pan, self.zoom, self.faster, self.disc = np.float32(pan), zoom, faster, disc
        shape = 1 / max(noise, 1e-3) ** 2
        self.colors = []
        for n in range(frames):
            grain = rng.gamma(shape, 1 / shape, (HEIGHT, WIDTH, 1)).astype(np.float32)
            self.colors.append(self.clean(n) * grain)

    def _progress(self, n: int) -> float:
        """How far the camera has come at frame n, in steps from frame 0 to frame 1."""
        return sum(self.faster**k for k in range(n)) - sum(self.faster**-k for k in range(1, -n + 1))

    def _wall(self, n: int, place: np.ndarray) -> np.ndarray:
        """Where on the wall, from its centre, a place of frame n is."""
        return (place - self._progress(n) * self.pan) / np.float32(1 + self.zoom) ** self._progress(n)

    def flow(self, a: int, b: int) -> np.ndarray:
        x, y = grid()
        place = np.stack([x - WIDTH / 2, y - HEIGHT / 2], axis=-1)
        wall = self._wall(a, place)
        there = wall * np.float32(1 + self.zoom) ** self._progress(b) + self._progress(b) * self.pan
        return np.where(self._covered(wall)[..., None], there - place, np.float32(0))

    def _covered(self, wall: np.ndarray) -> np.ndarray:
        return np.hypot(wall[..., 0], wall[..., 1]) < (25 if self.disc else np.inf)

    def clean(self, n: int) -> np.ndarray:
        x, y = grid()
        place = np.stack([x - WIDTH / 2, y - HEIGHT / 2], axis=-1)
        wall = self._wall(n, place)
        columns, rows = np.moveaxis(np.float32(wall + np.float32([WIDTH, HEIGHT])), -1, 0)
        moving = cv2.remap(self.wall, columns, rows, cv2.INTER_LINEAR)
        return np.where(self._covered(wall)[..., None], moving, np.float32(0.5))

    def previous(self, n: int) -> np.ndarray:
        return self.flow(n, n - 1)

    def next(self, n: int) -> np.ndarray:
        return self.flow(n, n + 1)

    def pairs(self, vectors: Callable[[int], np.ndarray]) -> list[Patches]:
        return [
            Patches(FramePair(self.colors[n], self.colors[n + 1], vectors(n), vectors(n + 1), (HEIGHT, WIDTH)))
            for n in range(len(self.colors) - 1)
        ]


def means(choice: Choice, expected: MotionConvention) -> None:
    assert choice.convention is not None
    x, y = choice.convention.factors((HEIGHT, WIDTH))
    assert (choice.convention.direction, choice.convention.encoding) == (expected.direction, expected.encoding)
    np.testing.assert_allclose((x, y), expected.factors((HEIGHT, WIDTH)), rtol=1e-6)


MOVES = {"pan": (2.5, 3.5), "zoom": 0.06}


@pytest.mark.parametrize(
    ("expected", "write"),
    [
        (PLAIN, lambda film, n: film.previous(n)),
        (MotionConvention(y="up"), lambda film, n: film.previous(n) * [1, -1]),
        (MotionConvention("next"), lambda film, n: film.next(n)),
        (MotionConvention("next", "ndc", y="up"), lambda film, n: film.next(n) / [WIDTH, -HEIGHT]),
        (MotionConvention("next", "half-ndc"), lambda film, n: film.next(n) / [WIDTH / 2, HEIGHT / 2]),
        (MotionConvention("next", "screen"), lambda film, n: film.next(n) / WIDTH),
        (MotionConvention("next", scale=2), lambda film, n: film.next(n) / 2),
        (MotionConvention(scale=-1), lambda film, n: -film.previous(n)),
        (CYCLES, lambda film, n: np.dstack([film.previous(n), -film.next(n)]) * [1, -1, 1, -1]),
        (MotionConvention("both"), lambda film, n: np.dstack([film.previous(n), film.next(n)])),
        (MotionConvention("both", "ndc"), lambda film, n: np.dstack([film.previous(n), film.next(n)]) / SIZES),
    ],
    ids=lambda value: str(value) if isinstance(value, MotionConvention) else "",
)  # fmt: skip
def test_the_convention_is_found_from_the_pictures_alone(expected, write):
    film = Film(**MOVES, faster=1.5)
    assumed = CYCLES if expected.pair else PLAIN
    choice = choose_convention(film.pairs(lambda n: np.float32(write(film, n))), assumed, ())
    means(choice, expected)


def test_a_length_that_is_no_plain_number_is_found_too() -> None:
    film = Film(**MOVES, faster=1.5)
    choice = choose_convention(film.pairs(lambda n: film.next(n) / np.float32(7.3)), PLAIN, ())
    assert choice.convention is not None
    assert (choice.convention.direction, choice.convention.y) == ("next", "down")
    # Noise hides a fiftieth of 7 px.
    assert choice.convention.scale == pytest.approx(7.3, rel=0.02)


def test_gray_and_direction_with_length_are_told_by_their_values() -> None:
    film = Film(**MOVES, faster=1.5)
    gray = choose_convention(film.pairs(lambda n: 0.5 + 0.5 * film.next(n) / 32), PLAIN, ())
    assert gray.convention is not None
    assert (gray.convention.direction, gray.convention.encoding) == ("next", "gray")
    assert gray.convention.scale == pytest.approx(32, rel=0.02)

    film = Film((2, 4), 0.06, frames=2)
    gray = choose_convention(film.pairs(lambda n: np.float32(0.5 + 0.5 * film.next(n) / 56)), PLAIN, ())
    assert gray.convention is not None
    # Half the picture, 70 and 45 pixels, was preferred; of two frames the length is known to a fiftieth or two.
    assert gray.convention.factors((HEIGHT, WIDTH)) == pytest.approx((56, 56), rel=0.04)

    film = Film(**MOVES, faster=1.5)

    def magnitude(n: int) -> np.ndarray:
        v = film.next(n) / np.float32([WIDTH, HEIGHT])
        length = np.linalg.norm(v, axis=-1, keepdims=True)
        return np.concatenate([0.5 + 0.5 * v / length, length], axis=-1)

    means(choose_convention(film.pairs(magnitude), PLAIN, ()), MotionConvention("next", "ndc", encoding="magnitude"))


@pytest.mark.parametrize("wrong", [-1, 0.5, 2, [1, -1], [-1, 1]], ids=str)
def test_what_was_stated_is_overruled_by_pictures_that_say_otherwise(wrong) -> None:
    film = Film(**MOVES, faster=1.5)
    choice = choose_convention(film.pairs(lambda n: film.previous(n) * np.float32(wrong)), PLAIN)
    assert choice.convention is not None
    np.testing.assert_allclose(choice.convention.factors((HEIGHT, WIDTH)), 1 / np.broadcast_to(np.float32(wrong), 2))
    stated = next(trial for trial in choice.trials if trial.convention == PLAIN)
    assert stated.unexplained > 5 * choice.unexplained


def test_other_readings_are_not_tried_where_what_was_stated_is_good() -> None:
    film = Film(**MOVES)
    choice = choose_convention(film.pairs(film.previous), PLAIN)
    assert [trial.convention for trial in choice.trials] == [PLAIN]
    assert choice.convention == PLAIN
    assert choice.unexplained < 0.02 < 0.3 < choice.still


@pytest.mark.parametrize(
    "vectors",
    [
        lambda film, n: 0 * film.previous(n),
        lambda film, n: film.previous(n)[..., ::-1] * [0, 1] + [0.3, 0],
        lambda film, n: np.random.default_rng(n).normal(0, 4, (HEIGHT, WIDTH, 2)),
        lambda film, n: film.previous(n)[..., ::-1],
    ],
    ids=["black", "constant", "noise", "transposed"],
)
@pytest.mark.parametrize("settled", [PARTS, ()], ids=["stated", "unknown"])
def test_vectors_that_no_reading_explains_are_not_taken(vectors, settled) -> None:
    film = Film((0, 2), 0.1)
    choice = choose_convention(film.pairs(lambda n: np.float32(vectors(film, n))), PLAIN, settled)
    assert choice.convention is None
    assert choice.open == ()


def test_where_nothing_moves_what_was_assumed_is_taken_and_nothing_is_settled() -> None:
    film = Film()
    for assumed in (PLAIN, MotionConvention("next", "ndc", "up")):
        choice = choose_convention(film.pairs(film.previous), assumed, ())
        assert choice.convention == assumed
        assert choice.open == PARTS
        assert choice.still < 0.02
    # But vectors that tell of motion where there is none are wrong.
    noise = np.random.default_rng(0).normal(0, 4, (HEIGHT, WIDTH, 2)).astype(np.float32)
    assert choose_convention(film.pairs(lambda n: noise), PLAIN).convention is None


def test_a_change_of_light_that_no_motion_explains_leaves_vectors_as_they_are() -> None:
    film = Film()
    film.colors = [color * 3.0**n for n, color in enumerate(film.colors)]
    choice = choose_convention(film.pairs(film.previous), PLAIN)
    assert choice.still > 0.5
    assert choice.found is not None
    assert choice.convention == PLAIN


def in_shadows(film: Film) -> tuple[list[Patches], Callable[[], list[Patches]]]:
    """Stripes of shadow pass over a film, its vectors are right: pairs of what is lit, and of the wall itself."""
    surfaces = film.pairs(film.previous)
    x, _ = grid()
    for n, color in enumerate(film.colors):
        film.colors[n] = color * np.where((x + 4 * n) % 28 < 14, np.float32(1), np.float32(0.15))[..., None]
    return film.pairs(film.previous), lambda: surfaces


@pytest.mark.parametrize("film", [Film((0.4, 0.2)), Film()], ids=["slow", "still"])
def test_right_vectors_are_believed_where_shadows_move_otherwise(film) -> None:
    light, surfaces = in_shadows(film)
    assert choose_convention(light, PLAIN).convention != PLAIN  # it would be what follows the shadows
    choice = choose_convention(light, PLAIN, surfaces=surfaces)
    assert choice.convention == PLAIN
    assert choice.by_surfaces
    assert choice.unexplained < 0.05


@pytest.mark.parametrize(
    "wrong",
    [
        lambda v: 0 * v,
        lambda v: 0 * v + [0, 3],  # not along the shadows' way
        lambda v: v[..., ::-1],
        lambda v: np.random.default_rng(0).normal(0, 4, v.shape),
    ],
    ids=["black", "constant", "transposed", "noise"],
)
@pytest.mark.parametrize("settled", [PARTS, ()], ids=["stated", "unknown"])
def test_wrong_vectors_are_not_believed_in_moving_shadows(wrong, settled) -> None:
    film = Film((0.2, 1.5), 0.04)
    film.previous = lambda n, right=film.previous: np.float32(wrong(right(n)))  # type: ignore[method-assign]
    light, surfaces = in_shadows(film)
    assert choose_convention(light, PLAIN, settled, surfaces).convention is None


def test_surfaces_tell_how_vectors_are_meant_where_shadows_move_otherwise() -> None:
    film = Film((1, 1.5), 0.04, faster=1.5)
    film.previous = lambda n, right=film.previous: right(n) * np.float32([1, -1])  # type: ignore[method-assign]
    light, surfaces = in_shadows(film)
    choice = choose_convention(light, PLAIN, surfaces=surfaces)
    assert choice.convention == MotionConvention(y="up")


def test_surfaces_without_structure_confirm_nothing() -> None:
    film = Film()
    light, _ = in_shadows(film)
    flat, vectors = np.full_like(film.colors[0], 0.5), film.previous(0)
    blank = Patches(FramePair(flat, flat, vectors, vectors, (HEIGHT, WIDTH)))
    choice = choose_convention(light, PLAIN, surfaces=lambda: [blank])
    assert choice.convention is None
    assert not choice.by_surfaces


def test_surfaces_are_asked_only_where_light_leaves_a_doubt() -> None:
    film = Film(**MOVES)
    choose_convention(film.pairs(film.previous), PLAIN, surfaces=lambda: pytest.fail("asked"))


def test_what_a_pan_cannot_tell_is_said() -> None:
    sideways = Film((3, 0))
    choice = choose_convention(sideways.pairs(sideways.previous), PLAIN, ())
    assert choice.convention == PLAIN
    assert "y" in choice.open  # nothing moves up or down
    assert "direction" in choice.open  # backward to the previous is forward to the next
    # As fast in both directions, and faster every frame: all is told.
    told = Film((3, 2), faster=1.6)
    choice = choose_convention(told.pairs(told.previous), PLAIN, ())
    assert choice.convention == PLAIN
    assert choice.open == ()


@pytest.mark.parametrize("film", [Film(zoom=0.08), Film((4, 3), disc=True, noise=0.1)], ids=["zoom", "object"])
def test_a_zoom_and_a_moving_object_before_a_static_camera_tell(film) -> None:
    choice = choose_convention(film.pairs(lambda n: film.previous(n) * np.float32([1, -1])), PLAIN, ())
    assert choice.convention is not None
    assert choice.convention.factors((HEIGHT, WIDTH)) == (1, -1)


def test_two_frames_are_enough() -> None:
    film = Film(**MOVES, frames=2)
    choice = choose_convention(film.pairs(lambda n: film.next(n) / np.float32(WIDTH)), PLAIN, ())
    assert choice.convention is not None
    assert choice.convention.direction == "next"
    assert choice.convention.unit == "screen"


def test_vectors_span_one_frame_whatever_lies_between_the_two() -> None:
    film = Film(**MOVES)
    pair = FramePair(film.colors[0], film.colors[1], film.previous(0) / 2, film.previous(1) / 2, (HEIGHT, WIDTH), 2)
    choice = choose_convention([Patches(pair)], PLAIN)
    assert [trial.convention for trial in choice.trials] == [PLAIN]


def test_it_depends_neither_on_exposure_nor_on_broken_pixels() -> None:
    film = Film(**MOVES, faster=1.5)
    choice = choose_convention(film.pairs(film.next), PLAIN, ())
    film.colors = [1e4 * color for color in film.colors]
    assert choose_convention(film.pairs(film.next), PLAIN, ()).convention == choice.convention
    film.colors[1][10:13, 20:30], film.colors[0][50] = np.nan, np.inf

    def broken(n: int) -> np.ndarray:
        vectors = film.next(n)
        vectors[5:9], vectors[20] = np.nan, 1e10
        return vectors

    assert choose_convention(film.pairs(broken), PLAIN, ()).convention == choice.convention


def test_a_picture_smaller_than_a_patch() -> None:
    color, still = np.ones((3, 5, 3), np.float32), np.zeros((3, 5, 2), np.float32)
    choice = choose_convention([Patches(FramePair(color, color, still, still, (3, 5)))], PLAIN)
    assert choice.convention == PLAIN


def test_no_pairs() -> None:
    with pytest.raises(ValueError, match="pairs is empty"):
        choose_convention([], PLAIN)


@pytest.mark.parametrize("share", [0.02, 0.2])
@pytest.mark.parametrize("vectors_everywhere", [True, False])
def test_what_is_empty_explains_nothing(share, vectors_everywhere):
    """Beside a render region all is black: readings that throw the region out of the picture explained all of it."""
    rng = np.random.default_rng(3)
    height, width = 180, 320
    texture = cv2.GaussianBlur(rng.random((height, width, 3)).astype(np.float32), (0, 0), 2)
    texture = (texture - texture.min()) / np.ptp(texture)
    side = np.sqrt(share)
    inside = np.zeros((height, width), bool)
    top, left = int(height * (1 - side) / 2), int(width * (1 - side) / 2)
    inside[top : height - top, left : width - left] = True
    earlier = np.where(inside[..., None], texture, 0).astype(np.float32)
    later = np.where(inside[..., None], np.roll(texture, 3, axis=1), 0).astype(np.float32)
    vectors = np.zeros((height, width, 4), np.float32)
    vectors[inside | vectors_everywhere] = -3, 0, -3, 0
    pair = FramePair(earlier, later, vectors, vectors, (height, width))
    choice = choose_convention([Patches(pair)], CYCLES, frozenset({"direction", "unit", "y", "scale", "encoding"}))
    assert choice.convention == CYCLES
    assert choice.unexplained < 0.05 < 0.2 < choice.still


DOCUMENTED = {
    "cycles": (CYCLES, lambda back, on: np.dstack([back, -on]) * [1, -1, 1, -1]),
    "next, ndc": (MotionConvention("next", "ndc", y="up"), lambda back, on: on / [WIDTH, -HEIGHT]),
    "half-ndc": (MotionConvention("next", "half-ndc", y="up"), lambda back, on: on / [WIDTH / 2, -HEIGHT / 2]),
    "pixels": (PLAIN, lambda back, on: back),
}


def block_on_black(n: int, side: int, step: int, *, around: float = 0.0) -> np.ndarray:
    rng = np.random.default_rng(8)
    texture = cv2.resize(rng.uniform(0.2, 1, (side // 4 + 1, side // 4 + 1, 3)).astype(np.float32), (side, side))
    picture = np.full((HEIGHT, WIDTH, 3), around, np.float32)
    picture[30 : 30 + side, 40 + n * step : 40 + n * step + side] = texture
    return picture


def block_vectors(write: Callable, n: int, side: int, step: int, outside: float = 0.0) -> np.ndarray:
    back = np.zeros((HEIGHT, WIDTH, 2), np.float32)
    back[..., 0] = -step
    vectors = np.float32(write(back, -back))
    empty = np.ones((HEIGHT, WIDTH), bool)
    empty[30 : 30 + side, 40 + n * step : 40 + n * step + side] = False
    vectors[empty] = outside * np.random.default_rng(n).normal(0, 9, vectors[empty].shape)
    return vectors


@pytest.mark.parametrize("side", [12, 24, 45])
@pytest.mark.parametrize("outside", [0, 1], ids=["none", "garbage"])
@pytest.mark.parametrize(("stated", "write"), DOCUMENTED.values(), ids=DOCUMENTED)
def test_vectors_of_an_object_on_black_are_taken_as_documented(stated, write, side, outside) -> None:
    layers = [block_vectors(write, n, side, 3, outside) for n in (0, 1)]
    pictures = [block_on_black(n, side, 3) for n in (0, 1)]
    choice = choose_convention([Patches(FramePair(*pictures, *layers, (HEIGHT, WIDTH)))], stated)
    assert choice.convention == stated


def test_a_cropped_object_gives_the_figures_of_the_same_object_on_black() -> None:
    side = 24
    box = np.s_[30 : 30 + side, 40 : 40 + side + 3]
    layers = [block_vectors(lambda back, on: back, n, side, 3) for n in (0, 1)]
    pictures = [block_on_black(n, side, 3) for n in (0, 1)]
    whole = choose_convention([Patches(FramePair(*pictures, *layers, (HEIGHT, WIDTH)))], PLAIN)
    small = [layer[box] for layer in (*pictures, *layers)]
    cropped = choose_convention([Patches(FramePair(*small, (HEIGHT, WIDTH)))], PLAIN)
    assert cropped.convention == whole.convention
    # The patches do not lie at the same places.
    assert (cropped.unexplained, cropped.still) == pytest.approx((whole.unexplained, whole.still), abs=0.1)


REGIONS = [np.s_[:, :70], np.s_[:, 70:], np.s_[:45], np.s_[45:], np.s_[20:70, 30:110], np.s_[10:80]]


@pytest.mark.parametrize("region", REGIONS, ids=["left", "right", "top", "bottom", "middle", "letterbox"])
def test_what_a_renderer_documents_holds_beside_a_render_region(region) -> None:
    film = Film((8, 3))

    def cut(layer: np.ndarray) -> np.ndarray:
        inside = np.zeros_like(layer)
        inside[region] = layer[region]
        return inside

    layers = [cut(np.float32(np.dstack([film.previous(n), -film.next(n)]) * [1, -1, 1, -1])) for n in range(3)]
    pairs = [
        Patches(FramePair(cut(film.colors[n]), cut(film.colors[n + 1]), layers[n], layers[n + 1], (HEIGHT, WIDTH)))
        for n in range(2)
    ]
    choice = choose_convention(pairs, CYCLES)
    assert choice.convention == CYCLES
    assert choice.unexplained < 0.05 < 0.2 < choice.still


@pytest.mark.parametrize("lit", [0.1, 0.3])
@pytest.mark.parametrize("pan", [(0, 0), (8, 3)])
def test_black_pixels_of_few_samples_contradict_nothing(pan, lit) -> None:
    """Most of a patch was black by chance, and the mean of the rest was taken for that of all of it."""
    film, rng = Film(pan, noise=0), np.random.default_rng(6)
    colors = [color * (rng.random((HEIGHT, WIDTH, 1)) < lit).astype(np.float32) / lit for color in film.colors]
    layers = [np.float32(np.dstack([film.previous(n), -film.next(n)]) * [1, -1, 1, -1]) for n in range(3)]
    pairs = [Patches(FramePair(colors[n], colors[n + 1], layers[n], layers[n + 1], (HEIGHT, WIDTH))) for n in range(2)]
    assert choose_convention(pairs, CYCLES).convention == CYCLES


def test_a_moving_sky_without_vectors_counts_for_nothing() -> None:
    rng = np.random.default_rng(2)
    pictures, layers = [block_on_black(n, 30, 3) for n in (0, 1)], []
    for n, picture in enumerate(pictures):
        sky = cv2.resize(rng.uniform(0.2, 1, (20, 30, 3)).astype(np.float32), (WIDTH, HEIGHT))
        picture[picture == 0] = sky[picture == 0]
        layers.append(block_vectors(lambda back, on: back, n, 30, 3))
    choice = choose_convention([Patches(FramePair(*pictures, *layers, (HEIGHT, WIDTH)))], PLAIN)
    assert choice.convention == PLAIN


def test_a_black_frame_contradicts_nothing() -> None:
    film = Film((8, 3))
    black = np.zeros_like(film.colors[0])
    pair = FramePair(black, black, film.previous(0), film.previous(1), (HEIGHT, WIDTH))
    assert choose_convention([Patches(pair)], PLAIN).convention == PLAIN


def test_typed_parts_are_obeyed_though_the_pictures_contradict_them() -> None:
    film = Film(**MOVES, faster=1.5)
    pairs = film.pairs(lambda n: -film.previous(n))
    choice = choose_convention(pairs, PLAIN, typed=PARTS)
    assert choice.convention == PLAIN
    assert choice.contradicted
    assert choose_convention(pairs, PLAIN).convention == replace(PLAIN, scale=-1.0)
