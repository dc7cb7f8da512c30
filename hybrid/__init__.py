"""The part that users touch: EXR files, shots, the plan, the pipeline, comparison, the command.

For other programs: `open_shot` finds the frames of a shot, `denoise_shot` denoises and writes them as the command does,
and `DenoiseOptions` describes how; `denoise_arrays` denoises arrays without files. They are imported when they are
first used, so that ``import hybrid`` is quick.
"""

from importlib import import_module
from typing import TYPE_CHECKING, Any

if TYPE_CHECKING:
    from hybrid.files.shots import open_shot
    from hybrid.run.arrays import denoise_arrays
    from hybrid.run.job import DenoiseOptions, denoise_shot

__all__ = ["DenoiseOptions", "denoise_arrays", "denoise_shot", "open_shot"]

_MODULES = {
    "DenoiseOptions": "hybrid.run.job",
    "denoise_arrays": "hybrid.run.arrays",
    "denoise_shot": "hybrid.run.job",
    "open_shot": "hybrid.files.shots",
}


def __getattr__(name: str) -> Any:
    if name not in _MODULES:
        raise AttributeError(f"module {__name__!r} has no attribute {name!r}")
    return getattr(import_module(_MODULES[name]), name)
