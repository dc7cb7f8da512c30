"""OIDN as we call it: right modes, checked input, clear errors."""

import json
import sys
from importlib.util import find_spec
from types import ModuleType

import cv2
import numpy as np
import pytest
from numpy.typing import NDArray

from hybrid.alignment.transfer import autoexposure
from hybrid.cli import main
from hybrid.denoising import oidn
from hybrid.denoising.oidn import denoise_oidn
from hybrid.files.exr import read_exr
from hybrid.run.records import read_records
from tests.scenes import Scene

Image = NDArray[np.float32]
needs_oidn = [pytest.mark.oidn, pytest.mark.skipif(find_spec("pyoidn") is None, reason="pyoidn is not installed")]


@pytest.fixture
def scene() -> tuple[Image, Image, Image, Image]:
    """A textured plane under smooth light: clean radiance, noisy radiance, albedo, normal, 64 × 96."""
    rng = np.random.default_rng(3)
    y, x = np.mgrid[:64, :96].astype(np.float32)
    albedo = np.where(((x // 12 + y // 12) % 2 == 0)[..., None], [0.8, 0.3, 0.2], [0.2, 0.4, 0.7])
    normal = np.zeros((64, 96, 3))
    normal[..., 2] = 1
    clean = albedo * (0.5 + np.exp(-((x - 40) ** 2 + (y - 30) ** 2) / 800))[..., None]
    color = clean * rng.gamma(4, 0.25, (64, 96, 1))  # mean 1, standard deviation 0.5, white light
    clean, color, albedo, normal = (v.astype(np.float32) for v in (clean, color, albedo, normal))
    return clean, color, albedo, normal


def rms(a: Image, b: Image) -> float:
    return float(np.sqrt(np.mean((a - b) ** 2)))


@pytest.fixture
def forgotten():
    """Clear the cached facts about OIDN, before and after."""
    caches = oidn.why_no_oidn, oidn._device
    for cache in caches:
        cache.cache_clear()
    yield
    for cache in caches:
        cache.cache_clear()


@pytest.mark.parametrize("how", ["absent", "broken", "old"])
def test_where_its_library_is_missing_auto_does_without_and_says_so(monkeypatch, tmp_path, capsys, forgotten, how):
    """The package was there, and the library that it loads was not: the first frame ended in an error."""

    class Broken(ModuleType):
        def __getattr__(self, name: str) -> None:
            raise OSError("libOpenImageDenoise.so.2: no such file") if how == "broken" else AttributeError(name)

    monkeypatch.setitem(sys.modules, "pyoidn", None if how == "absent" else Broken("pyoidn"))
    folder = Scene(frames=1).write(tmp_path / "in")
    words = ["denoise", str(folder), "-o", str(tmp_path / "out"), "--preset", "draft", "--first-pass"]
    assert main([*words, "auto"]) == 0
    said = capsys.readouterr().err
    expected = {"absent": "pyoidn is not installed", "broken": "libOpenImageDenoise.so.2: no such file"}
    assert "First pass  nlm (no denoised picture in the file, and " in said
    assert expected.get(how, "pyoidn does not work here: Device") in said
    assert main([*words, "oidn"]) == 1
    assert "error: first pass oidn: pyoidn" in capsys.readouterr().err


class TestDenoise:
    pytestmark = needs_oidn

    @pytest.mark.parametrize("quality", ["high", "balanced", "fast"])
    def test_removes_noise_and_leaves_the_input_alone(self, scene, quality) -> None:
        clean, *images = scene
        before = [v.copy() for v in images]
        result = denoise_oidn(*images, quality=quality)
        assert result.shape == clean.shape
        assert result.dtype == np.float32
        # Measured over three seeds and all qualities: 0.22 to 0.25.
        assert rms(result, clean) < 0.35 * rms(images[0], clean)
        for now, then in zip(images, before, strict=True):
            np.testing.assert_array_equal(now, then)

    def test_hdr_is_scale_equivariant(self, scene) -> None:
        _, color, albedo, normal = scene
        result = denoise_oidn(color, albedo, normal)
        scaled = denoise_oidn(64 * color, albedo, normal)
        # Its exposure comes from the picture; an LDR filter would clip at 1.
        np.testing.assert_allclose(scaled, 64 * result, rtol=2e-3)

    @pytest.mark.parametrize("guides", [0, 2])
    def test_a_part_needs_the_scale_of_the_whole(self, scene, guides) -> None:
        _, color, *rest = scene
        images = [color, *rest[:guides]]
        whole = denoise_oidn(*images)
        # OIDN's own measurement, in float32.
        np.testing.assert_allclose(denoise_oidn(*images, scale=autoexposure(color)), whole, rtol=1e-4)
        assert rms(denoise_oidn(*images, scale=0.5 * autoexposure(color)), whole) > 1e-3

    def test_prefilter_pays_when_guides_are_noisy(self, scene) -> None:
        clean, color, albedo, normal = scene
        rng = np.random.default_rng(4)
        albedo = np.clip(albedo + 0.4 * rng.normal(size=albedo.shape), 0, 1).astype(np.float32)
        normal = (normal + 0.4 * rng.normal(size=normal.shape)).astype(np.float32)
        normal /= np.linalg.norm(normal, axis=-1, keepdims=True)
        given = denoise_oidn(color, albedo, normal)
        best = denoise_oidn(color, albedo, normal, prefilter="high")
        # Measured over three seeds: 0.84 to 0.91.
        assert rms(best, clean) < 0.95 * rms(given, clean)

    def test_guides_are_optional(self, scene) -> None:
        clean, color, albedo, _ = scene
        errors = [rms(denoise_oidn(color, *guides), clean) for guides in ([], [albedo])]
        assert errors[1] < errors[0] < rms(color, clean)
        np.testing.assert_array_equal(denoise_oidn(color, prefilter="high"), denoise_oidn(color))

    @pytest.mark.parametrize("size", [(1, 1), (3, 5), (17, 33)])
    def test_any_size_and_layout(self, scene, size) -> None:
        images = [cv2.flip(v, 1)[: size[0], : size[1]][:, ::-1] for v in scene[1:]]
        result = denoise_oidn(*images)
        assert result.shape == (*size, 3)
        assert np.isfinite(result).all()

    def test_error_of_the_library_is_raised(self, scene) -> None:
        with pytest.raises(RuntimeError, match="OIDN: unsupported combination"):
            oidn._execute({"color": scene[1], "normal": scene[3]}, "high", "cpu", hdr=True)


def test_bad_images_are_errors(scene) -> None:
    _, color, albedo, normal = scene
    with pytest.raises(ValueError, match="albedo must be"):
        denoise_oidn(color, albedo[1:], normal)
    with pytest.raises(ValueError, match="color must be"):
        denoise_oidn(color[..., :2])
    color[1, 2, 0] = np.inf
    with pytest.raises(ValueError, match="color must be finite, 1 of"):
        denoise_oidn(color, albedo, normal)


def test_a_missing_package_is_named(scene, monkeypatch: pytest.MonkeyPatch) -> None:
    oidn._device.cache_clear()
    monkeypatch.setitem(sys.modules, "pyoidn", None)
    with pytest.raises(ImportError, match='expected: pip install "pyoidn"'):
        denoise_oidn(scene[1])


class TestDevices:
    pytestmark = needs_oidn

    def test_a_processor_is_there_and_auto_is_one_of_those_there(self):
        assert oidn.find_device("cpu") == "cpu"
        assert oidn._has_device(oidn.find_device("auto"))

    def test_the_first_that_is_there_is_taken(self, monkeypatch):
        monkeypatch.setattr(oidn, "_has_device", lambda kind: kind in {"sycl", "cpu"})
        assert oidn.find_device("auto") == "sycl"
        monkeypatch.setattr(oidn, "_has_device", lambda kind: kind in {"metal", "cpu"})
        assert oidn.find_device("auto") == "cpu"  # nobody has run Metal
        assert oidn.find_device("metal") == "metal"
        monkeypatch.setattr(oidn, "_has_device", lambda kind: kind in {"sycl", "cpu"})
        assert oidn.find_device("cpu") == "cpu"
        with pytest.raises(
            ValueError, match=r"device is 'cuda', expected one that OIDN can use here: auto, sycl, cpu$"
        ):
            oidn.find_device("cuda")

    def test_one_that_is_not_there_is_never_computed_on(self, scene):
        """Whichever are missing here; no machine has all of them."""
        missing = [kind for kind in oidn.DEVICES if not oidn._has_device(kind)]
        assert missing
        for kind in missing:
            with pytest.raises(RuntimeError, match="unsupported device type"):
                denoise_oidn(scene[1], device=kind)
        with pytest.raises(ValueError, match="device is 'gpu', expected one of"):
            denoise_oidn(scene[1], device="gpu")

    def test_a_device_that_cannot_read_our_memory_is_given_copies(self, scene, monkeypatch):
        _, color, albedo, normal = scene
        expected = denoise_oidn(color, albedo, normal, prefilter="balanced")
        asked = []
        monkeypatch.setattr(oidn, "_reads_memory", lambda device: bool(asked.append(device)))
        np.testing.assert_array_equal(denoise_oidn(color, albedo, normal, prefilter="balanced"), expected)
        assert len(asked) == 3  # two guides and the picture

    def test_the_command_names_what_was_asked_for_and_what_is_there(self, tmp_path, capsys):
        missing = next(kind for kind in oidn.DEVICES if not oidn._has_device(kind))
        shot, out = Scene(frames=3).write(tmp_path / "in"), tmp_path / "out"
        words = ["denoise", str(shot), "-o", str(out), "--preset", "draft", "--first-pass", "oidn-fast", "-q"]
        assert main([*words, "--device", missing]) == 1
        line = capsys.readouterr().err.splitlines()[-1]
        assert line.startswith(f"error: device is '{missing}', expected one that OIDN can use here: auto, ")
        assert not list(out.glob("*.exr"))
        assert main([*words, "--device", "gpu"]) == 2

    def test_the_record_and_the_file_say_where_it_ran(self, tmp_path):
        shot, out = Scene(frames=1).write(tmp_path / "in"), tmp_path / "out"
        words = ["denoise", str(shot), "-o", str(out), "--preset", "draft", "-q", "--first-pass"]
        for estimate, expected in (("oidn-fast", {"oidn": "cpu"}), ("none", {})):
            assert main([*words, estimate, "--device", "cpu"]) == 0
            *_, (_, record) = read_records(out)
            assert record["options"]["device"] == expected
            (path,) = out.glob("*.exr")
            assert json.loads(read_exr(path).parts[0].header["ravg/settings"])["device"] == expected
