import numpy as np

from hybrid.alignment.align import align
from hybrid.alignment.guides import average_guides
from hybrid.denoising.first_pass import PerFrame
from hybrid.denoising.stream import FrameStream
from hybrid.files.shots import open_shot
from tests.scenes import Scene, only

SHAPE = (12, 16)
ROWS = slice(2, 10)


def window(*shifts: tuple[float, float]) -> tuple[list[dict[str, np.ndarray]], list[np.ndarray | None]]:
    """Guides of the centre and a frame on each side, which have moved by whole pixels, and the flows to them."""
    rng = np.random.default_rng(0)
    wall = rng.random((30, 30, 3), np.float32)
    frames, flows = [], []
    for x, y in (shifts[0], (0, 0), shifts[1]):
        left, top = 8 - round(x), 8 - round(y)
        frames.append({"albedo": wall[top : top + SHAPE[0], left : left + SHAPE[1]].copy()})
        flows.append(np.full((8, SHAPE[1], 2), (x, y), np.float32))
    return frames, [flows[0], None, flows[2]]


def test_frames_are_averaged_along_whole_pixels_and_not_between_them() -> None:
    guides, flows = window((2, -1), (-3, 0))
    guides[0]["albedo"] = guides[0]["albedo"] + np.float32(0.3)
    guides[2]["albedo"] = guides[2]["albedo"] - np.float32(0.6)
    trust = np.ones((3, 8, SHAPE[1]), np.float32)
    trust[0] = 0.5
    own = guides[1]["albedo"][ROWS]
    inside = np.s_[:, 4:-4]
    found = average_guides(guides, flows, trust, ROWS)["albedo"]
    np.testing.assert_allclose(found[inside], own[inside] + (0.5 * 0.3 - 0.6) / 2.5, atol=1e-5)
    for moved in (0.125, 0.5):
        between = [flows[0] + np.float32(moved), None, flows[2] - np.float32(moved)]
        np.testing.assert_allclose(average_guides(guides, between, trust, ROWS)["albedo"], own, atol=1e-6)
    near = [flows[0], None, flows[2] + np.float32(1 / 16)]  # counts half
    found = average_guides(guides, near, trust, ROWS)["albedo"]
    np.testing.assert_allclose(found[inside], own[inside] + (0.5 * 0.3 - 0.5 * 0.6) / 2, atol=1e-5)


def test_the_centre_is_kept_where_nothing_is_trusted_and_filled_where_it_is_not_measured() -> None:
    guides, flows = window((2, -1), (-3, 0))
    trust = np.zeros((3, 8, SHAPE[1]), np.float32)
    found = average_guides(guides, flows, trust, ROWS)["albedo"]
    np.testing.assert_array_equal(found, guides[1]["albedo"][ROWS])
    trust[2] = 1
    guides[1]["albedo"] = np.full((*SHAPE, 3), 9, np.float16)
    found = average_guides([None, guides[1], guides[2]], flows, trust, ROWS)["albedo"]
    np.testing.assert_allclose(found[:, 4:], guides[2]["albedo"][ROWS, 1:-3], atol=1e-6)
    assert found.dtype == np.float32


def test_a_stream_filters_each_frame_once_for_those_who_ask(tmp_path) -> None:
    """The networks that filter guides took as much time as the one that read them."""
    scene, filtered = Scene(frames=5, step=(0, 0)), []
    shot = open_shot(scene.write(tmp_path))

    def halve(guides):
        filtered.append(guides)
        return {name: guide / 2 for name, guide in guides.items()}

    stages = {"demodulate", "warp", "clean-guides"}
    first_pass = PerFrame(lambda frame: frame.color)
    stream = FrameStream(shot, only(stages), first_pass, radius=1, filter_guides=halve)
    for number in range(scene.first + 1, scene.first + 4):
        aligned = stream.align(number)
        assert set(aligned.centre.filtered_guides) == {"albedo", "normal"}
        np.testing.assert_allclose(
            aligned.centre.filtered_guides["albedo"], aligned.centre.guides["albedo"] / 2, rtol=1e-3
        )
    assert len(filtered) == 5
    band = align(stream.window(scene.first + 2), slice(0, 8))
    whole = align(stream.window(scene.first + 2))
    for name, guide in band.centre.filtered_guides.items():
        np.testing.assert_array_equal(guide[band.inner], whole.centre.filtered_guides[name][:8])
    for others in (
        FrameStream(shot, only(stages - {"clean-guides"}), first_pass, filter_guides=halve),
        FrameStream(shot, only(stages), first_pass),  # its plan has no such stage, which it could not run
        FrameStream(shot, only(stages), filter_guides=halve),
    ):
        assert others.align(scene.first + 2).centre.filtered_guides is None
    assert "clean-guides" in stream.align(scene.first + 2).stages
    assert "clean-guides" not in FrameStream(shot, only(stages), first_pass).align(scene.first + 2).stages
