"""Intel Open Image Denoise, frame by frame, by the optional package ``pyoidn``: a peer, and a source of estimates."""

from collections.abc import Iterator
from contextlib import contextmanager
from functools import lru_cache
from typing import Any, Literal

import numpy as np
from numpy.typing import NDArray

Quality = Literal["high", "balanced", "fast"]
# About what OIDN may take for itself; above about 1000×1000 pixels it works in tiles, which overlap. Always the same,
# or its pictures would depend on the memory that happens to be allowed. Its small networks take no longer with half
# of it, at 1920×1080 and to the same bits; the others a quarter longer.
MEMORY_MB = {"high": 1024, "balanced": 1024, "fast": 512}
# Bytes that it then takes at most, its code and buffers included, by measurement; and with quality fast.
HOLDS, HOLDS_FAST = 1400 * 2**20, 700 * 2**20
# In the order in which "auto" takes them, but for Metal, which nobody has run: it is taken by its name alone.
DEVICES = ("cuda", "hip", "sycl", "metal", "cpu")


def denoise_oidn(
    color: NDArray[np.float32],
    albedo: NDArray[np.float32] | None = None,
    normal: NDArray[np.float32] | None = None,
    *,
    quality: Quality = "high",
    prefilter: Quality | None = None,
    clean: bool = False,
    scale: float | None = None,
    device: str = "cpu",
) -> NDArray[np.float32]:
    """Denoise one frame (H, W, 3) with OIDN's ray-tracing filter in HDR mode (https://www.openimagedenoise.org).

    The color is linear radiance, finite; OIDN counts negative values as 0. Albedo is in [0, 1], normals in [−1, 1], in
    any fixed space, beside an albedo only. `prefilter` denoises these first, with this quality, and declares them clean
    (``cleanAux``): "high" is OIDN's best mode and Blender's default, at seven times the cost; "balanced" takes four
    times, for pictures that are 0.07 dB worse (mean over 13 shots of 4 to 54 samples). `clean` declares them clean as
    they are. `scale` multiplies the color before the network, measured by OIDN if not given; part of a frame needs the
    whole frame's (`hybrid.alignment.transfer.autoexposure`).

    Raises ImportError if pyoidn is not installed; ValueError if shapes differ or values are not finite; RuntimeError if
    OIDN reports an error, or has no such device here.
    """
    guides = {name: image for name, image in (("albedo", albedo), ("normal", normal)) if image is not None}
    images = {name: _as_input(image, name, color) for name, image in {"color": color, **guides}.items()}
    if prefilter is not None:
        for name in guides:
            images[name] = _execute({name: images[name]}, prefilter, device)
    clean = (prefilter is not None or clean) and bool(guides)
    return _execute(images, quality, device, scale, hdr=True, cleanAux=clean)


@lru_cache(maxsize=1)
def why_no_oidn() -> str | None:
    """Say why OIDN cannot be had here: None where it can."""
    try:
        _device("cpu")
    except ImportError as error:
        # The package may be there, and its imports not.
        return "pyoidn is not installed" if isinstance(error.__cause__, ModuleNotFoundError) else f"pyoidn: {error}"
    except (OSError, RuntimeError, AttributeError) as error:  # the library is not there, is another's, or has no device
        return f"pyoidn does not work here: {' '.join(str(error).split())[:200]}"
    return None


def _as_input(image: NDArray[Any], name: str, color: NDArray[Any]) -> NDArray[np.float32]:
    """A contiguous float32 image, checked: OIDN reads raw memory."""
    if image.shape != color.shape or image.ndim != 3 or image.shape[2] != 3 or image.size == 0:
        raise ValueError(f"{name} must be (H, W, 3) like color, is {image.shape}; color is {color.shape}")
    lost = image.size - int(np.isfinite(image).sum())
    if lost:
        raise ValueError(f"{name} must be finite, {lost} of its {image.size} values are not")
    return np.ascontiguousarray(image, np.float32)


def _execute(
    images: dict[str, NDArray[np.float32]], quality: str, where: str, scale: float | None = None, **flags: bool
) -> NDArray[np.float32]:
    oidn, device = _device(where)
    qualities = {"high": oidn.OIDN_QUALITY_HIGH, "balanced": oidn.OIDN_QUALITY_BALANCED,
                 "fast": oidn.OIDN_QUALITY_FAST}  # fmt: skip
    output = np.empty_like(next(iter(images.values())))
    rt = oidn.Filter(device, oidn.OIDN_FILTER_TYPE_RT)
    try:  # not `with`: pyoidn 2.5.1's __exit__ returns true, which swallows the exception
        with _reachable(oidn, device, {**images, "output": output}) as given:
            for name, image in given.items():
                height, width = output.shape[:2]
                rt.set_image(name, image, oidn.OIDN_FORMAT_FLOAT3, width, height)
            for flag, value in flags.items():
                rt.set_bool(flag, value)
            if scale is not None:
                rt.set_float("inputScale", scale)
            rt.set_quality(qualities[quality])
            rt.set_int("maxMemoryMB", MEMORY_MB[quality])
            rt.commit()
            rt.execute()
            _check(device)
            if given["output"] is not output:
                given["output"].read(0, output.nbytes, output)
                _check(device)
    finally:
        rt.release()
    return output


@contextmanager
def _reachable(oidn: Any, device: Any, images: dict[str, NDArray[np.float32]]) -> Iterator[dict[str, Any]]:
    """The images where the device can reach them: as they are, or copied to buffers of its own."""
    if _reads_memory(device):
        yield dict(images)
        return
    buffers = {name: oidn.Buffer(device, image.nbytes) for name, image in images.items()}
    try:
        for name, buffer in buffers.items():
            buffer.write(0, images[name].nbytes, images[name])
        _check(device)
        yield buffers
    finally:
        for buffer in buffers.values():
            buffer.release()


def _reads_memory(device: Any) -> bool:
    """Whether a device reads what a program has allocated, as processors and few others do."""
    return bool(device.get_bool("systemMemorySupported"))


def find_device(name: str) -> str:
    """Find a device of OIDN: cuda, hip, sycl, cpu, metal, or "auto", the first that is there of the former four.

    Raises ImportError if pyoidn is not installed; ValueError, with those that are there, if the device is not.
    """
    for kind in [kind for kind in DEVICES if kind != "metal"] if name == "auto" else [name]:
        if _has_device(kind):
            return kind
    devices = [kind for kind in DEVICES if _has_device(kind)]
    raise ValueError(f"device is {name!r}, expected one that OIDN can use here: auto, {', '.join(devices)}")


def _has_device(kind: str) -> bool:
    try:
        _device(kind)
    except RuntimeError:
        return False
    return True


@lru_cache(maxsize=2)
def _device(kind: str) -> tuple[Any, Any]:
    """The module and a device, on all cores or OIDN_NUM_THREADS; to open one costs as much as a small frame."""
    if kind not in DEVICES:
        raise ValueError(f"device is {kind!r}, expected one of {', '.join(DEVICES)}")
    try:
        import pyoidn  # an optional peer
    except ImportError as error:
        raise ImportError('OIDN needs the package pyoidn; expected: pip install "pyoidn"') from error
    device = pyoidn.Device(getattr(pyoidn, f"OIDN_DEVICE_TYPE_{kind.upper()}"))
    _check(device)
    device.commit()
    _check(device)
    return pyoidn, device


def _check(device: Any) -> None:
    message = device.get_error()
    if message is not None:
        raise RuntimeError(f"OIDN: {message}")
