"""What the user touches: EXR files, shots, the plan, the pipeline, comparison, the command.

For other programs: `open_shot` finds the frames of a shot, `denoise_shot` does what the command does. Both are imported
when they are asked for, so that ``import hybrid`` is quick.
"""

from __future__ import annotations

from typing import TYPE_CHECKING, Any

if TYPE_CHECKING:
    from hybrid.denoising import denoise_shot
    from hybrid.files.shots import open_shot

__all__ = ["denoise_shot", "open_shot"]


def __getattr__(name: str) -> Any:
    if name == "open_shot":
        from hybrid.files.shots import open_shot

        return open_shot
    if name == "denoise_shot":
        from hybrid.denoising import denoise_shot

        return denoise_shot
    raise AttributeError(f"module {__name__!r} has no attribute {name!r}")
