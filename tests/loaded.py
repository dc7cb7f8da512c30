"""Load and compile all that commands need: for the process that `tests.commands` forks from."""

import contextlib
import os
import tempfile
from pathlib import Path

import cv2

from tests.commands import import_all
from tests.scenes import Scene

cv2.setNumThreads(1)
import_all()
with contextlib.suppress(ImportError):
    import torch

    torch.set_num_threads(1)

from hybrid.cli import main  # noqa: E402 - as the command itself comes last

_kept = [os.dup(descriptor) for descriptor in (1, 2)]
with tempfile.TemporaryDirectory() as _folder, open(os.devnull, "w") as _nowhere:
    for _descriptor in (1, 2):
        os.dup2(_nowhere.fileno(), _descriptor)
    _noisy = str(Scene().write(Path(_folder, "in")))
    for _preset in ("draft", "standard", "final"):
        main(["denoise", _noisy, "-o", str(Path(_folder, _preset)), "--preset", _preset])
    for _words in (["denoise", "--help"], ["inspect", _noisy]):
        main(_words)
for _descriptor, _original in zip((1, 2), _kept, strict=True):
    os.dup2(_original, _descriptor)
    os.close(_original)
