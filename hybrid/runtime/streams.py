"""The standard streams of the process: descriptors 0, 1 and 2."""

from __future__ import annotations

import os


def open_standard_streams() -> None:
    """Open the null device on each standard descriptor that is closed, as after ``2>&-``.

    Otherwise the next file that is opened takes that number, and what libraries print goes into it.
    """
    for number in range(3):
        try:
            os.fstat(number)
        except OSError:
            os.open(os.devnull, os.O_RDWR)  # takes the lowest number that is free, which is this one
