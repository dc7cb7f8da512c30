from dataclasses import replace

import numpy as np

from hybrid.alignment.align import align
from hybrid.alignment.measure import least_outline_noise
from hybrid.alignment.transfer import ALBEDO_FLOOR
from hybrid.denoising.first_pass import PerFrame
from hybrid.denoising.stream import FrameStream
from hybrid.files.shots import open_shot
from tests.scenes import Scene, only

STAGES = {"demodulate", "outliers", "warp"}
SCENE = Scene(frames=5)
MIDDLE = SCENE.first + 2


def window(folder, **options):
    return FrameStream(open_shot(folder), only(STAGES), **options).align(MIDDLE)


def test_estimates_are_aligned_as_the_frames_are(tmp_path):
    """An estimate that is the clean frame itself becomes the clean centre wherever a frame shows it."""
    clean = open_shot(SCENE.write(tmp_path / "clean", clean=True))
    source = PerFrame(lambda frame: clean.read(frame.number).color)
    aligned = window(SCENE.write(tmp_path / "noisy"), first_pass=source)
    layers = SCENE.clean(2)
    light = layers["ViewLayer.Combined"] / (layers["ViewLayer.Denoising Albedo"] + ALBEDO_FLOOR)
    for estimate, confidence in zip(aligned.first_pass, aligned.confidence, strict=True):
        sure = confidence > 0.5
        assert sure.mean() > 0.5
        # Whole-pixel vectors: nothing is interpolated; files are float32.
        np.testing.assert_allclose(estimate[sure], light[sure], rtol=1e-4)


def test_each_frame_is_released_after_it_is_read(tmp_path):
    """Frames in files took the memory of the whole window."""
    clean = open_shot(SCENE.write(tmp_path / "clean", clean=True))
    source = PerFrame(lambda frame: clean.read(frame.number).color)
    stream = FrameStream(open_shot(SCENE.write(tmp_path / "noisy")), only(STAGES), source)
    released = []
    window = replace(stream.window(MIDDLE), release=lambda: released.append(1))
    aligned = align(window)
    assert len(released) == 4 + 4  # each neighbour, and its first pass
    for read in (lambda: aligned.residual, lambda: aligned.albedo):
        released.clear()
        read()
        assert len(released) == 5
    assert stream.window(MIDDLE).release == stream.keeper.release


def test_a_part_of_a_frame_is_that_part_of_the_whole(tmp_path):
    folder = Scene(height=448, width=40, frames=3).write(tmp_path)
    number = SCENE.first + 1
    whole, part = (
        FrameStream(open_shot(folder), only(STAGES), radius=1).align(number, rows) for rows in (None, slice(64, 128))
    )
    assert part.color.shape[1] < 448
    for name in ("color", "albedo", "normal", "confidence"):
        np.testing.assert_array_equal(getattr(part, name)[:, part.inner], getattr(whole, name)[:, 64:128])
    np.testing.assert_array_equal(part.modulation[part.inner], whole.modulation[64:128])
    assert part.brightness.exposure == whole.brightness.exposure
    np.testing.assert_array_equal(part.brightness.moments, whole.brightness.moments)


def test_a_part_of_a_frame_has_the_variance_of_its_rows(tmp_path):
    """Each band of rows had the variance of the whole frame, whose first rows are those of another band."""
    folder = Scene(height=448, width=40, frames=1).write(tmp_path)
    window = FrameStream(open_shot(folder), only(STAGES), radius=0).window(SCENE.first)
    variance = np.random.default_rng(0).random((448, 40, 3), np.float32)
    window = replace(window, frames=(replace(window.centre, variance=variance),))
    whole, part = align(window), align(window, slice(300, 400))
    np.testing.assert_array_equal(part.variance[part.inner], whole.variance[300:400])


def test_frames_that_are_missing_have_no_confidence(tmp_path):
    folder = SCENE.write(tmp_path)
    (folder / f"shot.{MIDDLE + 1}.exr").unlink()
    aligned = window(folder)
    assert not aligned.confidence[3:].any()
    np.testing.assert_array_equal(aligned.color[3], aligned.color[2])
    assert aligned.confidence[1].mean() > 0.5


def test_detail_that_all_neighbours_lack_takes_their_confidence(tmp_path):
    """Means over 9×9 pixels are alike: the color gate lets them pass."""
    scene = replace(SCENE, step=(0, 0), noise=0.02)

    def checkered(color):
        y, x = np.indices(color.shape[:2])
        color[:, :24] *= np.where((x + y) % 2, 0.9, 1.1).astype(np.float32)[:, :24, None]

    def edit(index, layers):
        if index == MIDDLE - scene.first:
            checkered(layers["ViewLayer.Combined"])

    def estimate(frame):
        errors = np.random.default_rng(frame.number).normal(1, 0.004, frame.color.shape).astype(np.float32)
        clean = scene.clean(frame.number - scene.first)["ViewLayer.Combined"] * errors
        if frame.number == MIDDLE:
            checkered(clean)
        return clean

    shot = open_shot(scene.write(tmp_path, edit=edit))
    aligned = FrameStream(shot, only({"warp", "gate"}), first_pass=PerFrame(estimate)).align(MIDDLE)
    neighbours = aligned.confidence[[0, 1, 3, 4]]
    assert neighbours[..., :16].max() < 0.1
    assert neighbours[..., 44:].min() > 0.5
    assert aligned.confidence[2].min() == 1


def test_samples_keep_their_light_where_the_albedo_has_their_noise(tmp_path):
    """In moving glass each sample shows its own surface: a third of the light was lost, and samples below 0 pooled."""

    def mix(index, layers):
        bright = np.random.default_rng(index).random((SCENE.height, SCENE.width, 1)) < 0.5
        layers["ViewLayer.Denoising Albedo"][:] = bright
        layers["ViewLayer.Combined"][:] = 2 * bright

    shot = open_shot(SCENE.write(tmp_path, edit=mix))
    right = PerFrame(lambda frame: np.ones_like(frame.color))
    exact, lenient = (
        FrameStream(shot, only(stages), right).align(MIDDLE) for stages in ({"demodulate"}, {"demodulate", "prefilter"})
    )
    light = (exact.first_pass + exact.sources.residual()) * exact.modulation
    np.testing.assert_allclose(light[2], shot.read(MIDDLE).color, atol=1e-3)
    light = (lenient.first_pass + lenient.sources.residual()) * lenient.modulation
    assert 0.6 < light.mean() < 1.05  # −1.6 over each frame's own albedo


def test_noise_of_guides_at_outlines_is_measured_and_forgiven(tmp_path):
    """Textured surfaces of a render of few samples were trusted half as much."""
    found = {}
    for samples in (8, 512):

        def speckle(index, layers, samples=samples):
            albedo = layers["ViewLayer.Denoising Albedo"]
            column = np.indices(albedo.shape[:2])[1][..., None] % 6
            mixed = np.random.default_rng(index).binomial(samples, 0.5, albedo.shape[:2])[..., None] / samples
            albedo[:] = np.where(column < 2, 0.2, np.where(column % 3 == 2, 0.2 + 0.6 * mixed, 0.8))

        folder = replace(SCENE, step=(0, 0)).write(tmp_path / str(samples), edit=speckle)
        stream = FrameStream(open_shot(folder), only(STAGES))
        noise = stream.window(MIDDLE).outline_noise[0]
        pairs = stream.measurements(stream.around(MIDDLE))[1]
        assert noise == min(pair.outline_noise[0] for pair in pairs) == least_outline_noise(pairs)[0]
        found[samples] = noise, stream.align(MIDDLE).confidence[1].mean()

        def move(index, layers, speckle=speckle):
            speckle(index, layers)
            layers["ViewLayer.Vector"][:] = -0.3, 0, -0.3, 0
            layers["ViewLayer.Vector"][:, [20, 23]] = 0  # outlines on next to nothing of the picture

        stream = FrameStream(open_shot(SCENE.write(tmp_path / f"{samples} between", edit=move)), only(STAGES))
        assert stream.window(MIDDLE).outline_noise == (0, 0)
        assert least_outline_noise(stream.measurements(stream.around(MIDDLE))[1]) is None
    assert found[8][0] > 8 * found[512][0] > 0
    assert found[8][1] > 0.8
