"""The standard streams of the process: descriptors 0, 1 and 2."""

import os


def open_standard_streams() -> None:
    """Open the null device on closed standard descriptors, or libraries would print into the next opened file."""
    for number in range(3):
        try:
            os.fstat(number)
        except OSError:
            os.open(os.devnull, os.O_RDWR)  # gets the lowest free number, which is this one
