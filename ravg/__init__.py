"""Denoise rendered animation from other programs.

`open_shot` finds the frames of a shot: names of layers, conventions and a range are its arguments. `denoise_shot`
denoises and writes them, as ``ravg denoise`` does. `denoise_arrays` denoises numpy arrays, without files. The options
of both are keywords, or a `DenoiseOptions`.

    from ravg import denoise_shot, open_shot

    shot = open_shot("noisy.####.exr", frames="1001-1010")
    for frame in denoise_shot(shot, "out/denoised.####.exr", preset="quality"):
        print(frame.number, frame.path)

These names are imported when they are first used, so that ``import ravg`` is quick.
"""

from importlib import import_module
from importlib.metadata import version
from importlib.util import find_spec
from pathlib import Path
from typing import TYPE_CHECKING, Any

if TYPE_CHECKING:
    from hybrid.files.shots import open_shot
    from hybrid.run.arrays import denoise_arrays
    from hybrid.run.job import DenoiseOptions, denoise_shot

    __version__: str

__all__ = ["DenoiseOptions", "__version__", "check_packages", "denoise_arrays", "denoise_shot", "open_shot"]

_MODULES = {
    "DenoiseOptions": "hybrid.run.job",
    "denoise_arrays": "hybrid.run.arrays",
    "denoise_shot": "hybrid.run.job",
    "open_shot": "hybrid.files.shots",
}


def check_packages() -> None:
    """Check that the packages installed with this one are those that Python imports.

    Raises
    ------
    ImportError
        If another package of the same name comes first on the path or is imported already, or if one is missing.
    """
    place = Path(__file__).resolve().parent.parent
    for name in ("loops", "flow", "nlm", "network", "hybrid"):
        spec = find_spec(name)
        expected = place / name / "__init__.py"
        if spec is None or not spec.origin or Path(spec.origin).resolve() != expected:
            found = spec.origin or "a folder without __init__.py" if spec else "nothing"
            advice = "install ravg again, in an environment of its own"
            raise ImportError(f"ravg needs its own package {name}, expected {expected}, found {found}: {advice}")


def __dir__() -> list[str]:
    return sorted({*__all__, *(name for name in globals() if name.startswith("__"))})


def __getattr__(name: str) -> Any:
    if name == "__version__":
        return version("ravg")
    if name not in _MODULES:
        raise AttributeError(f"module {__name__!r} has no attribute {name!r}")
    check_packages()
    from hybrid.runtime.threads import prepare_libraries

    prepare_libraries()
    return getattr(import_module(_MODULES[name]), name)
