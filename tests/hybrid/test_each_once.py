"""How many times each stage runs while ten frames are denoised: once for a frame, a pair or a window."""

import collections

import pytest

from hybrid.alignment import align, flows, prepare
from hybrid.denoising import stabilize, stream
from hybrid.denoising.first_pass import PerFrame
from hybrid.denoising.plan import Rules
from hybrid.denoising.stabilize import Denoised
from hybrid.files.shots import Shot, open_shot
from tests.scenes import Function, Scene, denoise_view

FRAMES, RADIUS = 10, 2
# Neighbours one and two frames away that all windows have together; the flow to one two frames away, and its flow back,
# are composed.
NEXT, SECOND = 2 * (FRAMES - 1), 2 * (FRAMES - 2)
EXPECTED = {
    "read": FRAMES,
    "prepare": FRAMES,
    "remove_fireflies": FRAMES,
    "shrink": FRAMES,
    "measure_frame": FRAMES,
    "measure_pair": FRAMES - 1,
    "measure_flows": FRAMES - 1,
    "fixed_noise": FRAMES - 1,  # for the orientations
    "noise_correlation": FRAMES - 1,
    "first pass": FRAMES,
    "compose_flow": 2 * SECOND,
    "align": FRAMES,
    "clean_guide": FRAMES,
    "confidence_by_geometry": NEXT + SECOND,
    "measure_exposure": FRAMES,
    "denoise": FRAMES,
    "align_results": FRAMES,
    "find_bright": 2 * FRAMES,  # beyond the picture, and beyond the neighbours' samples
    "restore_mean": FRAMES,
    "blend_samples": FRAMES,
}


@pytest.fixture
def count(monkeypatch):
    """Count the calls of functions by their names."""
    counts: collections.Counter[str] = collections.Counter()

    def counted(name, function):
        def call(*arguments, **named):
            counts[name] += 1
            return function(*arguments, **named)

        return call

    def watch(owner, name):
        monkeypatch.setattr(owner, name, counted(name, getattr(owner, name)))

    measured = (
        "measure_frame",
        "measure_pair",
        "measure_flows",
        "fixed_noise",
        "noise_correlation",
        "correlation_alone",
    )
    for name in ("prepare", "remove_fireflies", "shrink", *measured):
        watch(stream, name)
    for name in ("align", "align_results", "find_bright", "restore_mean", "blend_samples"):
        watch(stabilize, name)
    watch(align, "confidence_by_geometry")
    watch(align, "clean_guide")
    watch(prepare, "measure_exposure")
    watch(flows, "compose_flow")
    watch(Shot, "read")
    return counts, counted


def test_each_stage_runs_once(tmp_path, count):
    counts, counted = count
    shot = open_shot(Scene(frames=FRAMES, noise=0.1).write(tmp_path / "in"))
    first_pass = PerFrame(counted("first pass", lambda frame: frame.color.copy()), turns=True)
    denoise = counted("denoise", lambda aligned: Denoised(aligned.first_pass[RADIUS] * aligned.modulation))
    for _ in denoise_view(shot, tmp_path / "out", Function(denoise, RADIUS), Rules(), first_pass):
        pass
    assert dict(counts) == EXPECTED
